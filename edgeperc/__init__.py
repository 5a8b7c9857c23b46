"""A LiDAR scan in, perception out: drivable area, vehicle boxes and a class for every point.

::

    import edgeperc

    points = edgeperc.read_points("000123.bin")
    perceive = edgeperc.Perceiver(["ssadnet", "pointseg"], sensor="hdl-64e")
    perception = perceive(points)

Importing this package does no work: no compiling, no thread, no file. A name is looked up in its module on first
use, for numba probes the cache folder of every kernel as it reads the kernel's decorator. onnxruntime is an extra,
for its builds exclude one another; without one everything but a model works, and constructing a `Perceiver` raises
`MissingExtraError`, which says which line installs it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from .errors import (
    CardError,
    CardMismatchError,
    EdgepercError,
    FitnessError,
    InferenceError,
    MissingExtraError,
    ModelError,
    ModelFileError,
    OptionError,
    PointsError,
    ProviderError,
    SensorError,
    SettingsError,
    SplitError,
    StampError,
    TrackingError,
)

if TYPE_CHECKING:
    from .card import ModelCard
    from .drivable import RoadAhead, road_ahead
    from .live import Answer, Stream, stream
    from .perceiver import Perceiver
    from .perception import Box, Perception, PointLabels, TopView
    from .readers.captures import read_scans
    from .readers.files import read_points
    from .sensor import SensorProfile
    from .tracking import Track, Tracker, Tracks

__all__ = [
    "Answer",
    "Box",
    "CardError",
    "CardMismatchError",
    "EdgepercError",
    "FitnessError",
    "InferenceError",
    "MissingExtraError",
    "ModelCard",
    "ModelError",
    "ModelFileError",
    "OptionError",
    "Perceiver",
    "Perception",
    "PointLabels",
    "PointsError",
    "ProviderError",
    "RoadAhead",
    "SensorError",
    "SensorProfile",
    "SettingsError",
    "SplitError",
    "StampError",
    "Stream",
    "TopView",
    "Track",
    "Tracker",
    "TrackingError",
    "Tracks",
    "__version__",
    "read_points",
    "read_scans",
    "road_ahead",
    "stream",
]

__version__ = "0.1.0"

_MODULES = {
    "Answer": "live",
    "Box": "perception",
    "ModelCard": "card",
    "Perceiver": "perceiver",
    "Perception": "perception",
    "PointLabels": "perception",
    "RoadAhead": "drivable",
    "SensorProfile": "sensor",
    "Stream": "live",
    "TopView": "perception",
    "Track": "tracking",
    "Tracker": "tracking",
    "Tracks": "tracking",
    "read_points": "readers.files",
    "read_scans": "readers.captures",
    "road_ahead": "drivable",
    "stream": "live",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'edgeperc' has no attribute {name!r}")
    found: object = getattr(import_module(f"edgeperc.{_MODULES[name]}"), name)
    globals()[name] = found  # the next use finds it without this function
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
