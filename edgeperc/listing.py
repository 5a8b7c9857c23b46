"""What there is to choose from: models, sensors and execution providers, as small records for printing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from .card import ModelCard
from .errors import MissingExtraError
from .sensor import SENSORS
from .session import PROVIDERS, available_providers
from .zoo import DEFAULT, listed

__all__ = ["ModelInfo", "ProviderInfo", "SensorInfo", "models", "providers", "purpose", "sensors"]

INSTALLED_BY: Mapping[str, str] = MappingProxyType(
    {
        "tensorrt-rtx": "pip install onnxruntime-ep-nv-tensorrt-rtx, beside edgeperc[cpu]",
        "tensorrt": "pip install 'edgeperc[gpu]', and NVIDIA TensorRT",
        "cuda": "pip install 'edgeperc[gpu]'",
        "openvino": "pip install 'edgeperc[openvino]'",
        "coreml": "pip install 'edgeperc[cpu]', on macOS",
        "directml": "pip install onnxruntime-directml, on Windows",
        "cpu": "pip install 'edgeperc[cpu]'",
    }
)


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """An installed model.

    Attributes
    ----------
    name : str
        For ``Perceiver(models=...)``.
    version : str
    purpose : str
        What it finds, e.g. ``"drivable area and boxes of car, van, truck"``.
    default : bool
        Whether it is one of the pair that ``models=None`` takes.
    path : Path
        The file of its first variant, which has fp32 weights where there is such a variant.
    variants : mapping of str to float
        Size of the file [MB] by precision of the weights; ``"NAME:PRECISION"`` asks for one of them.
    size_mb : float
        Size of ``path`` [MB].
    licence : str
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
        For ``Perceiver(sensor=...)``.
    beams, columns : int
        Beams, and azimuth steps in one turn.
    field_of_view_deg : tuple of 2 float
        Elevation of the lowest and the highest beam [deg].
    remission_range : tuple of 2 float
        Raw remission that means 0 and 1.
    range_m : tuple of 2 float
        Nearest and farthest return [m].
    mount_height_m : float
        Height above the road [m].
    rendered_as : str or None
        The sensor to whose remission its own is mapped; None where it is only scaled.
    """

    name: str
    beams: int
    columns: int
    field_of_view_deg: tuple[float, float]
    remission_range: tuple[float, float]
    range_m: tuple[float, float]
    mount_height_m: float
    rendered_as: str | None


@dataclass(frozen=True, slots=True)
class ProviderInfo:
    """An execution provider of onnxruntime.

    Attributes
    ----------
    name : str
        For ``Perceiver(provider=...)``.
    available : bool
        Whether the installed onnxruntime has it; False for all without onnxruntime.
    installed_by : str
        What installs it.
    """

    name: str
    available: bool
    installed_by: str


def models() -> tuple[ModelInfo, ...]:
    """The installed models, by name; reads the cards alone, without onnxruntime.

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
                variants=MappingProxyType(sizes),
                size_mb=sizes[card.precision],
                licence=str(card.training.get("licence", "not stated")),
            )
        )
    return tuple(found)


def purpose(card: ModelCard) -> str:
    """What a model finds, by its view and its classes."""
    if card.view.kind == "range_image":
        return f"a class for every point ({', '.join(card.classes[1:])})"
    found = ["drivable area"] if "drivable" in card.classes else []
    found += [f"boxes of {', '.join(card.box_classes)}"] if card.box_classes else []
    return " and ".join(found) or "classes of a top view"


def sensors() -> tuple[SensorInfo, ...]:
    """The built-in sensor profiles, by name; `edgeperc.sensor.get_sensor` gives the profile itself."""
    return tuple(
        SensorInfo(
            name=profile.name,
            beams=profile.n_beams,
            columns=profile.columns,
            field_of_view_deg=(profile.fov_down_deg, profile.fov_up_deg),
            remission_range=profile.remission_range,
            range_m=(profile.min_range_m, profile.max_range_m),
            mount_height_m=profile.mount_height_m,
            rendered_as=None if profile.remission is None else profile.remission.to,
        )
        for profile in SENSORS.values()
    )


def providers() -> tuple[ProviderInfo, ...]:
    """The execution providers that edgeperc knows, and which of them are available here.

    Raises
    ------
    ProviderError
        The plugin of a provider is installed but does not load.
    """
    try:
        present = available_providers()
    except MissingExtraError:
        present = ()
    return tuple(ProviderInfo(name, name in present, INSTALLED_BY[name]) for name in PROVIDERS)
