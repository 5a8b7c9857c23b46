"""Lists of the available models, sensors and execution providers, as small records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from ..errors import MissingExtraError
from ..types.card import ModelCard
from ..types.choices import SPARSE_MODELS
from ..types.sensor import SENSORS
from ..zoo import DEFAULT, listed
from .providers import PROVIDERS, available_providers

INSTALLED_BY: Mapping[str, str] = MappingProxyType(
    {
        "tensorrt-rtx": "pip install onnxruntime-ep-nv-tensorrt-rtx, beside edgeperc[cpu]",
        "tensorrt": "pip install 'edgeperc[gpu]', and NVIDIA TensorRT",
        "cuda": "pip install 'edgeperc[gpu]'",
        "openvino": "pip install 'edgeperc[openvino]'",
        "coreml": "pip install 'edgeperc[cpu]', on macOS",
        "directml": "pip install onnxruntime-directml, on Windows",
        "qnn": "pip install onnxruntime-qnn, beside edgeperc[cpu]",
        "webgpu": "pip install onnxruntime-ep-webgpu, beside edgeperc[cpu]",
        "cpu": "pip install 'edgeperc[cpu]'",
    }
)


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """An installed model.

    Attributes
    ----------
    name : str
        Name for ``Perceiver(models=...)``.
    version : str
    purpose : str
        What it detects, e.g. ``"drivable area and boxes of car, van, truck"``.
    default : bool
        Whether it is one of those that ``models=None`` selects.
    path : Path
        File of its first variant: fp32, if there is an fp32 variant.
    variants : mapping of str to float
        Size of the file [MB] by precision of the weights. ``"NAME:PRECISION"`` selects a variant.
    size_mb : float
        Size of ``path`` [MB].
    licence : str
        Licence of the weights.
    """

    name: str
    version: str
    purpose: str
    default: bool
    path: Path
    variants: Mapping[str, float]
    size_mb: float
    licence: str


@dataclass(frozen=True, slots=True)
class SensorInfo:
    """A built-in sensor profile (`edgeperc.SensorProfile`).

    Attributes
    ----------
    name : str
        Name for ``Perceiver(sensor=...)``.
    beams, columns : int
        Beams, and azimuth steps in one turn; of a sensor that does not spin, those of one that would show as much.
    field_of_view_deg : tuple of 2 float
        Elevation of the lowest and the highest beam [deg].
    remission_range : tuple of 2 float
        Raw remissions that are scaled to 0 and 1.
    range_m : tuple of 2 float
        Nearest and farthest return [m].
    rendered_as : str or None
        Sensor whose remission scale the remission is mapped to; None if it is only scaled to 0..1.
    accumulate_s : float or None
        Time over which a scan is gathered of a sensor that does not spin [s]; None if it spins.
    """

    name: str
    beams: int
    columns: int
    field_of_view_deg: tuple[float, float]
    remission_range: tuple[float, float]
    range_m: tuple[float, float]
    rendered_as: str | None
    accumulate_s: float | None


@dataclass(frozen=True, slots=True)
class ProviderInfo:
    """An execution provider of onnxruntime.

    Attributes
    ----------
    name : str
        Name for ``Perceiver(provider=...)``.
    available : bool
        Whether the installed onnxruntime offers it; False without onnxruntime, and if its plugin does not load, which
        the log says.
    installed_by : str
        How to install it.
    """

    name: str
    available: bool
    installed_by: str


def models() -> tuple[ModelInfo, ...]:
    """List the installed models, by name. Reads their cards only, without onnxruntime.

    Raises
    ------
    CardError, ModelFileError
        A model file is damaged.
    """
    files: dict[str, list[tuple[Path, ModelCard]]] = {}
    for variant in listed():
        files.setdefault(variant.card.name, []).append((variant.path, variant.card))
    found = []
    for name, variants in files.items():
        path, card = variants[0]
        sizes: dict[str, float] = {own.precision: round(file.stat().st_size / 1e6, 2) for file, own in variants}
        found.append(
            ModelInfo(
                name=name,
                version=card.version,
                purpose=purpose(card),
                default=name in DEFAULT,
                path=path,
                variants=sizes,
                size_mb=sizes[card.precision],
                licence=str(card.training.get("licence", "not stated")),
            )
        )
    return tuple(found)


def purpose(card: ModelCard) -> str:
    """Describe what a model detects, from its view and its classes."""
    if card.view.kind == "range_image":
        sensors = " of sparse sensors" * (card.name in SPARSE_MODELS.values())
        return f"a class for every point{sensors} ({', '.join(card.classes[1:])})"
    if card.view.kind == "camera":
        return f"a class for every pixel of a camera's image ({len(card.classes)} classes)"
    if card.view.kind == "pillars":
        return f"boxes in its range, by pillars of points ({', '.join(dict.fromkeys(card.box_classes))})"
    if card.view.kind == "objects":
        return f"boxes all around, by their points ({', '.join(card.box_classes)})"
    found = ["drivable area"] if "drivable" in card.classes else []
    found += [f"boxes of {', '.join(card.box_classes)}"] if card.box_classes else []
    return " and ".join(found) or "classes of a top view"


def sensors() -> tuple[SensorInfo, ...]:
    """List the built-in sensor profiles, by name; `edgeperc.types.sensor.get_sensor` returns a profile."""
    return tuple(
        SensorInfo(
            name=profile.name,
            beams=profile.n_beams,
            columns=profile.columns,
            field_of_view_deg=(profile.fov_down_deg, profile.fov_up_deg),
            remission_range=profile.remission_range,
            range_m=(profile.min_range_m, profile.max_range_m),
            rendered_as=None if profile.remission is None else profile.remission.to,
            accumulate_s=None if profile.pattern is None else profile.pattern.accumulate_s,
        )
        for profile in SENSORS.values()
    )


def providers() -> tuple[ProviderInfo, ...]:
    """List the execution providers that edgeperc supports, and which of them are available here."""
    try:
        present = available_providers()
    except MissingExtraError:
        present = ()
    return tuple(ProviderInfo(name, name in present, INSTALLED_BY[name]) for name in PROVIDERS)
