"""edgeperc beside what else one could run: torch, other engines, a pipeline in numpy, two networks in place of one.

Every contender is a process of its own, so that libraries do not meet in one address space and memory can be told. The
contenders of a table take turns, in an order drawn anew each round, so that whatever drifts treats them all alike. In
its turn a contender handles every scan once, after one that does not count: others ran meanwhile, and their threads
may still be spinning. Machine peaks are measured by contenders too, in the same rounds as the networks.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from edgeperc import ModelCard
from edgeperc.adapt import condition
from edgeperc.projection import make_projector
from edgeperc.sensor import get_sensor
from edgeperc.session import Session, available_providers
from edgeperc.zoo import DEFAULT, listed, model_path

from ..samples import percentile
from ..worker import Answer

__all__ = ["INSTALL", "OPENVINO", "Contender", "Found", "absent", "default_models", "groups"]

INSTALL = "not installed: pip install 'edgeperc[peers]'"
TORCH = ("torch:fp32", "torch.compile:fp32", "torch:bf16", "torch.compile:bf16")
OPENVINO = ("openvino:fp32", "openvino:bf16")
NEEDS = {"openvino": ("openvino",), "torch": ("torch", "onnx"), "torch.compile": ("torch", "onnx")}
PEAKS = ("numpy:fp32", "torch:fp32", "torch:bf16", "torch:int8", "openvino:fp32", "openvino:bf16")


@dataclass(frozen=True)
class Contender:
    """One row of a table.

    Attributes
    ----------
    name : str
    kind : str
        A key of `MAKERS`.
    engine : str
        A provider for kind ``"edgeperc"``, else as `open_engine` or `matrix_product` have it.
    paths : tuple of Path
        Models.
    cards : tuple of str
        Of the models, JSON.
    image : Path or None
        Input of a network alone, .npy.
    """

    name: str
    kind: str
    engine: str = ""
    paths: tuple[Path, ...] = ()
    cards: tuple[str, ...] = ()
    image: Path | None = None


@dataclass
class Found:
    """What was measured of a contender: milliseconds by round, memory, answers, or why there are none."""

    contender: Contender
    rounds: list[list[float]] = field(default_factory=list)
    rss_mb: float | None = None
    answers: list[Answer] = field(default_factory=list)
    why_not: str = ""

    @property
    def ms(self) -> list[float]:
        return [ms for each in self.rounds for ms in each]

    @property
    def p50(self) -> float:
        return percentile(self.ms, 50.0)


def absent(contender: Contender) -> str:
    """Why a contender cannot run here; empty where it can."""
    library = contender.engine.partition(":")[0]
    if contender.kind == "edgeperc":
        known = library in ("auto", *available_providers())
        return "" if known else "onnxruntime offers no such provider on this computer"
    needed = NEEDS.get(library, ())
    # Networks cut out of others are only there where onnx is.
    here = all(importlib.util.find_spec(name) for name in needed) and all(path.exists() for path in contender.paths)
    return "" if here else INSTALL


# Who is measured


def default_models() -> list[str]:
    """The shipped models that are measured unless others are named."""
    return [str(variant) for variant in listed() if variant.name in DEFAULT]


def groups(models: Sequence[str], provider: str, folder: Path, scan: Path, sensor: str) -> dict[str, list[Contender]]:
    """All contenders, by the title of their table.

    Parameters
    ----------
    models : sequence of str
        Names or paths; those of a range image are paired with those of a top view, first with first.
    provider : str
        edgeperc's own.
    folder : Path
        For inputs and for the two networks in place of one.
    scan : Path
        What networks alone see.
    sensor : str
    """
    profile, points = get_sensor(sensor), np.load(scan)
    views: dict[str, list[tuple[str, Path, ModelCard]]] = {"range_image": [], "top_view": []}
    for name in models:
        path = Path(name) if name.endswith(".onnx") else model_path(name)
        card = Session(path, "cpu").card
        views[card.view.kind].append((f"{card.name}-{card.precision}", path, card))
    told: dict[str, list[Contender]] = {}
    for name, path, card in (*views["range_image"], *views["top_view"]):
        image = folder / f"{name}-input.npy"
        projector = make_projector(card.view, card.input)
        np.save(image, projector.project(condition(points, profile)[0]).image)
        alone = [Contender("onnxruntime CPU, network alone", "session", "cpu", (path,), image=image)]
        if provider not in ("auto", "cpu"):
            alone.append(Contender(f"onnxruntime {provider}, network alone", "session", provider, (path,), image=image))
        for engine in OPENVINO:
            alone.append(Contender(f"OpenVINO API {engine[9:]}, network alone", "network", engine, (path,), (), image))
        peaks = [Contender(f"peak {engine}", "peak", engine) for engine in (*PEAKS, "copy")]
        full = [model for model in views[card.view.kind] if name.startswith(f"{model[0]}-edge") and model[0] in DEFAULT]
        told[f"Scan to answer: {name}"] = [*whole([(name, path, card)], provider), *larger(full), *alone, *peaks]
    for pair in zip(views["range_image"], views["top_view"], strict=False):
        told[f"Scan to answer: {pair[0][0]} and {pair[1][0]}"] = whole(pair, provider)
    for view in ("range image", "top view"):
        rows = ("edgeperc, numba", view), ("numpy", f"{view}, numpy")
        told[f"Projection: {view}"] = [Contender(name, "projection", call) for name, call in rows]
    for name, path, card in views["top_view"]:
        if any(o.kind == "box_dense" for o in card.outputs):
            told[f"One network or two: {name}"] = one_or_two(name, path, card, folder)
    return told


def whole(models: Sequence[tuple[str, Path, ModelCard]], provider: str) -> list[Contender]:
    """Ways from scan to answer; the first is edgeperc's, to which all others are held."""
    paths, cards = tuple(path for _, path, _ in models), tuple(card.to_json() for _, _, card in models)
    own = dict.fromkeys((provider, "cpu", *OPENVINO))
    if provider == "auto" and available_providers() == ("cpu",):
        del own["cpu"]  # it is what auto takes
    rounded = any(card.training.get("precision") == "int8" for _, _, card in models)
    rivals = ("onnxruntime", *OPENVINO, *(() if rounded else TORCH))  # torch has no such networks
    return [
        *(Contender(f"edgeperc, {name}", "edgeperc", name, paths) for name in own),
        *(Contender(f"numpy + {name}", "rival", name, paths, cards) for name in rivals),
    ]


def larger(models: Sequence[tuple[str, Path, ModelCard]]) -> list[Contender]:
    """The full network in torch, beside the one for small computers that was made of it."""
    return [
        Contender(f"numpy + {TORCH[0]}, {name}", "rival", TORCH[0], (path,), (card.to_json(),))
        for name, path, card in models
    ]


def one_or_two(name: str, path: Path, card: ModelCard, folder: Path) -> list[Contender]:
    """SSADNet, and two networks of its very parts: segmentation alone, and detection on a trunk of its own.

    Together they give SSADNet's own answers. Whoever would give a detector less has the third row: the boxes' head on
    the bare input, without a trunk, its weights random.
    """
    image = folder / f"{name}-input.npy"
    segmentation, detection, lean = (folder / f"{name}-{part}.onnx" for part in ("segmentation", "detection", "lean"))
    if not absent(Contender("", "network", "torch")):
        import onnx

        from edgeperc_export.networks.ssadnet import DenseHead
        from edgeperc_export.to_onnx import to_graph

        extractor = onnx.utils.Extractor(onnx.load(path))
        classes, boxes = sorted(card.outputs, key=lambda output: output.kind.startswith("box_"))
        onnx.save(extractor.extract_model([card.input.name], [classes.name]), segmentation)
        onnx.save(extractor.extract_model([card.input.name], [boxes.name]), detection)
        onnx.save(to_graph(DenseHead(len(card.input.channels)), replace(card, outputs=(classes,))), lean)
    parts = {
        "one network": (path,),
        "two networks": (segmentation, detection),
        "two, the detector without a trunk": (segmentation, lean),
        "segmentation alone": (segmentation,),
        "detection alone": (detection,),
    }
    return [Contender(words, "network", "onnxruntime", files, image=image) for words, files in parts.items()]
