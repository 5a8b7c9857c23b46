"""The models that come with edgeperc: .onnx files, each carrying its card; installed as ``edgeperc.zoo``.

A name refers to one network and its variants, which have the same weights in fp32 and in int8. Only `choose` decides
which variant runs on which provider, and in which precision.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from edgeperc.errors import ModelFileError, ProviderError
from edgeperc.system.names import nearest
from edgeperc.types import choices
from edgeperc.types.card import ModelCard
from edgeperc.types.onnx_file import read_model

__all__ = [
    "BF16_FEATURES",
    "CAMERA",
    "DEFAULT",
    "INT8_FEATURES",
    "MAX_LOSS",
    "OPEN",
    "SEVEN_BIT_FEATURES",
    "Variant",
    "choose",
    "digest",
    "listed",
    "model_path",
    "resolve",
    "shipped_models",
]

DEFAULT = choices.DEFAULT_MODELS
"""The best ones together: drivable area and vehicles ahead, a class for every point, and boxes all around."""

OPEN = choices.OPEN_MODELS
"""The same of weights that anyone may use, commercially too: trained on simulated streets and PandaSet (CC BY 4.0)."""

CAMERA = choices.CAMERA
"""The model of a camera's images."""

MAX_LOSS = 0.3
"""Largest loss of mean IoU or AP, in percentage points, that ``precision="auto"`` accepts for speed."""

# Processor flags (`machine.cpu_features`). Without a dot product of bytes, x86 adds pairs of products in 16 bits, which
# 8-bit weights saturate and 7-bit weights cannot.
INT8_FEATURES = frozenset({"avx512_vnni", "avx_vnni", "amx_int8", "asimddp"})
SEVEN_BIT_FEATURES = frozenset({"avx2"})
BF16_FEATURES = frozenset({"amx_bf16", "avx512_bf16"})
BF16_PROVIDERS = ("openvino",)
# The reduced precisions of a provider, the fastest first. Measured on two cores with avx512_vnni and avx512_bf16, fp32
# / bf16 / int8 in the fastest engine of each: pointseg 9.8 / 5.5 / 3.3 ms, ssadnet 15.5 / 8.4 / 5.2 ms.
FASTEST = {"cpu": ("int8",), "openvino": ("int8", "bf16"), "qnn": ("int8",)}
NPU_PROVIDERS = ("qnn",)
"""Providers that compute int8 on a device of its own, whatever the processor."""

RESEARCH = ("kulseg", "lodnn-paper", "pointseg-full", "pointseg-sim", "ssadnet-full", "ssadnet-paper", "ssadnet-sim")


@dataclass(frozen=True, slots=True)
class Variant:
    """A model file and its card."""

    path: Path
    card: ModelCard

    @property
    def name(self) -> str:
        """The network's name."""
        return self.card.name

    @property
    def precision(self) -> str:
        """Precision of the stored weights: ``"fp32"`` or ``"int8"``."""
        return self.card.precision

    def __str__(self) -> str:
        return f"{self.name}:{self.precision}"


def listed(network: str = "") -> tuple[Variant, ...]:
    """Every model file in this installation, by name, fp32 before int8.

    Parameters
    ----------
    network : str, optional
        Read only files whose name begins so.

    Raises
    ------
    CardError, ModelFileError
        A model file is damaged, or the package lies in an archive.
    """
    folder = resources.files(__name__)
    if not isinstance(folder, Path):
        raise ModelFileError(f"{folder} lies in an archive, in which no model can be opened; unpack it into a folder")
    paths = [path for path in folder.iterdir() if path.suffix == ".onnx" and path.name.startswith(network)]
    variants = (Variant(path, _card(path, path.stat().st_mtime_ns)) for path in paths)
    return tuple(sorted(variants, key=lambda variant: (variant.name, variant.precision)))


@functools.cache
def _card(path: Path, changed_ns: int) -> ModelCard:
    """The card of a file, read once as long as the file does not change."""
    return ModelCard.read(path)


def shipped_models() -> tuple[str, ...]:
    """Names of the networks in this installation, sorted."""
    return tuple(dict.fromkeys(variant.name for variant in listed()))


def resolve(model: str | os.PathLike[str]) -> tuple[Variant, ...]:
    """Find the variants of a model by its name or path.

    Parameters
    ----------
    model : str or Path
        ``"pointseg"`` for a network with all its variants, ``"pointseg:int8"`` for one of them, or the path of an
        .onnx file with a card.

    Returns
    -------
    variants : tuple of Variant
        At least one; fp32 before int8.

    Raises
    ------
    ModelFileError
        No model has this name, or the file cannot be read. The message lists the names.
    CardError
        The file has no card, or its card cannot be read.
    """
    if not isinstance(model, str) or Path(model).suffix == ".onnx":
        path = Path(model)
        return (Variant(path, ModelCard.read(path)),)
    name, _, precision = model.partition(":")
    of_name = tuple(variant for variant in listed(name) if variant.name == name)
    if not of_name:
        raise ModelFileError(_unknown(name))
    chosen = tuple(variant for variant in of_name if precision in ("", variant.precision))
    if not chosen:
        stored = " and ".join(map(str, of_name))
        raise ModelFileError(
            f"no model is called {model!r}; {name} comes as {stored}. bf16 is not a file: ask for precision 'bf16'"
        )
    return chosen


def _unknown(name: str) -> str:
    if name in RESEARCH:
        return (
            f"{name!r} is a research model and is not installed; give the path models/research/{name}.onnx "
            "in edgeperc's source distribution or repository"
        )
    known = ", ".join(shipped_models()) or "none in this installation"
    close = nearest(name, shipped_models())
    return f"no model is called {name!r}{close}. Shipped: {known}. Or give the path of an .onnx file."


def model_path(model: str | os.PathLike[str]) -> Path:
    """The file of one variant, such as ``"pointseg:int8"``; for the name of a network, its fp32 file.

    Raises
    ------
    CardError, ModelFileError
        As `resolve`.
    """
    return resolve(model)[0].path


def choose(
    variants: Sequence[Variant], provider: str, precision: str = "auto", features: Collection[str] = ()
) -> tuple[Variant, str]:
    """Choose the variant of a network, and the precision, for a provider.

    ``"auto"`` takes the fastest precision of the provider that this processor computes natively and whose loss,
    according to the card, is at most `MAX_LOSS`; else fp32. A network that exists only in int8 runs in int8.

    Parameters
    ----------
    variants : sequence of Variant
        Of one network, from `resolve`.
    provider : str
        A key of `edgeperc.inference.providers.PROVIDERS`.
    precision : {"auto", "fp32", "bf16", "int8"}
    features : collection of str
        Flags of the processor (`machine.cpu_features`); empty if they are not known. ``"auto"`` then takes
        no reduced precision.

    Returns
    -------
    variant : Variant
    precision : str
        ``"fp32"``, ``"bf16"`` (weights stored in fp32) or ``"int8"``.

    Raises
    ------
    ProviderError
        The network cannot run in this precision; the message lists those in which it can.
    """
    runs = {variant.precision: (variant, variant.precision) for variant in variants}
    if "fp32" in runs and provider in BF16_PROVIDERS and (not features or BF16_FEATURES & {*features}):
        runs["bf16"] = (runs["fp32"][0], "bf16")
    if precision != "auto":
        if precision not in runs:
            raise ProviderError(_not_in(variants[0].name, provider, precision, sorted(runs)))
        return runs[precision]
    for reduced in FASTEST.get(provider, ()):
        if reduced in runs:
            card = runs[reduced][0].card
            if _is_native(card, reduced, provider, features) and _loss(card, reduced) <= MAX_LOSS:
                return runs[reduced]
    return runs.get("fp32") or runs["int8"]


def _is_native(card: ModelCard, precision: str, provider: str, features: Collection[str]) -> bool:
    """Whether a processor with these flags, or a provider's own device, computes the model in this precision fast."""
    if precision == "bf16":
        return not BF16_FEATURES.isdisjoint(features)
    if provider in NPU_PROVIDERS or not INT8_FEATURES.isdisjoint(features):
        return True
    bits = card.precisions.get("int8", {}).get("weight_bits", 8)
    return provider == "cpu" and bits <= 7 and not SEVEN_BIT_FEATURES.isdisjoint(features)


def _loss(card: ModelCard, precision: str) -> float:
    """Percentage points lost compared with fp32 on real scans; infinite if not measured."""
    return float(card.precisions.get(precision, {}).get("loss", "inf"))


def _not_in(name: str, provider: str, precision: str, can: Sequence[str]) -> str:
    message = f"{name} cannot run in precision {precision!r} on provider {provider!r}, only in {' or '.join(can)}; "
    if precision == "bf16":
        needs = " or ".join(sorted(BF16_FEATURES))
        return f"{message}bf16 needs provider 'openvino', a model in fp32 and a processor with {needs}"
    if precision in ("fp32", "int8"):
        return f"{message}give a model whose weights are stored in {precision}, or precision 'auto'"
    return f"{message}expected auto, fp32, bf16 or int8"


def digest(variants: Sequence[Variant]) -> str:
    """Key of a network's measured settings: the SHA-256 of its file, or of the SHA-256s of its files.

    Raises
    ------
    ModelFileError
        A file cannot be read.
    """
    hashes = [hashlib.sha256(read_model(variant.path)).hexdigest() for variant in variants]
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()
