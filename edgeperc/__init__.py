"""A LiDAR scan in, perception out: drivable area, boxes, a class for every point, and tracks.

::

    import edgeperc

    points = edgeperc.read_points("000123.bin")
    perceive = edgeperc.Perceiver(sensor="hdl-64e")
    perception = perceive(points)
    perception.to_dict()
    edgeperc.draw(perception, points, "000123.png")

`models`, `sensors` and `providers` list the available models, sensor profiles and execution providers.

Importing this package compiles nothing, starts no thread and reads no file. A name is looked up in its module on first
use, because importing numpy and numba takes half a second. onnxruntime is an optional extra, because only one of its
builds can be installed at a time. Without it, everything works except running a model: `Perceiver` raises
`MissingExtraError`, whose message gives the install command.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from .errors import (
    CalibrationError,
    CardError,
    CardMismatchError,
    EdgepercError,
    FitnessError,
    ImageError,
    InferenceError,
    MissingExtraError,
    ModelError,
    ModelFileError,
    MountingError,
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
    from .camera.calibration import Calibration
    from .camera.painting import camera_road, paint
    from .inference.listing import ModelInfo, ProviderInfo, SensorInfo, models, providers, sensors
    from .live import Answer, Stream, stream
    from .perceiver import Perceiver
    from .preprocess.motion import Motion, Trajectory, deskew, merge
    from .readers.captures import read_scans, read_timed_scans, sensor_of
    from .readers.files import find_origin, read_points
    from .readers.images import read_image
    from .readers.scan_odometry import Odometry
    from .readers.times import TimedScan, accumulate
    from .road.ahead import FreeAhead, RoadAhead, free_ahead, road_ahead
    from .road.grid import OccupancyGrid, occupancy_grid
    from .road.rolling import RollingGrid
    from .road.sweeps import SweepPerceiver, Sweeps
    from .tracking import Track, Tracker, Tracks, smooth_tracks
    from .tracking.moving import movable_points, moving_points
    from .tracking.zones import Crossing, Line, Zone
    from .types.card import ModelCard
    from .types.frame import ModelFrame
    from .types.mounting import Mounting
    from .types.perception import (
        Box,
        DroppedPoints,
        GroundSurface,
        ImageLabels,
        Perception,
        PointLabels,
        SensorHealth,
        TopView,
    )
    from .types.sensor import ScanPattern, SensorProfile
    from .view import draw

__all__ = [
    "Answer",
    "Box",
    "Calibration",
    "CalibrationError",
    "CardError",
    "CardMismatchError",
    "Crossing",
    "DroppedPoints",
    "EdgepercError",
    "FitnessError",
    "FreeAhead",
    "GroundSurface",
    "ImageError",
    "ImageLabels",
    "InferenceError",
    "Line",
    "MissingExtraError",
    "ModelCard",
    "ModelError",
    "ModelFileError",
    "ModelFrame",
    "ModelInfo",
    "Motion",
    "Mounting",
    "MountingError",
    "OccupancyGrid",
    "Odometry",
    "OptionError",
    "Perceiver",
    "Perception",
    "PointLabels",
    "PointsError",
    "ProviderError",
    "ProviderInfo",
    "RoadAhead",
    "RollingGrid",
    "ScanPattern",
    "SensorError",
    "SensorHealth",
    "SensorInfo",
    "SensorProfile",
    "SettingsError",
    "SplitError",
    "StampError",
    "Stream",
    "SweepPerceiver",
    "Sweeps",
    "TimedScan",
    "TopView",
    "Track",
    "Tracker",
    "TrackingError",
    "Tracks",
    "Trajectory",
    "Zone",
    "__version__",
    "accumulate",
    "camera_road",
    "deskew",
    "draw",
    "find_origin",
    "free_ahead",
    "merge",
    "models",
    "movable_points",
    "moving_points",
    "occupancy_grid",
    "paint",
    "providers",
    "read_image",
    "read_points",
    "read_scans",
    "read_timed_scans",
    "road_ahead",
    "sensor_of",
    "sensors",
    "smooth_tracks",
    "stream",
]

__version__ = "0.2.0"

_NAMES = {
    "camera.calibration": ("Calibration",),
    "camera.painting": ("camera_road", "paint"),
    "inference.listing": ("ModelInfo", "ProviderInfo", "SensorInfo", "models", "providers", "sensors"),
    "live": ("Answer", "Stream", "stream"),
    "perceiver": ("Perceiver",),
    "preprocess.motion": ("Motion", "Trajectory", "deskew", "merge"),
    "readers.scan_odometry": ("Odometry",),
    "readers.captures": ("read_scans", "read_timed_scans", "sensor_of"),
    "readers.files": ("find_origin", "read_points"),
    "readers.images": ("read_image",),
    "readers.times": ("TimedScan", "accumulate"),
    "road.ahead": ("FreeAhead", "RoadAhead", "free_ahead", "road_ahead"),
    "road.grid": ("OccupancyGrid", "occupancy_grid"),
    "road.rolling": ("RollingGrid",),
    "road.sweeps": ("SweepPerceiver", "Sweeps"),
    "tracking": ("Track", "Tracker", "Tracks", "smooth_tracks"),
    "tracking.moving": ("movable_points", "moving_points"),
    "tracking.zones": ("Crossing", "Line", "Zone"),
    "types.card": ("ModelCard",),
    "types.frame": ("ModelFrame",),
    "types.mounting": ("Mounting",),
    "types.perception": (
        "Box",
        "DroppedPoints",
        "GroundSurface",
        "ImageLabels",
        "Perception",
        "PointLabels",
        "SensorHealth",
        "TopView",
    ),
    "types.sensor": ("ScanPattern", "SensorProfile"),
    "view": ("draw",),
}
MODULES = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in MODULES:
        raise AttributeError(f"module 'edgeperc' has no attribute {name!r}")
    found: object = getattr(import_module(f"edgeperc.{MODULES[name]}"), name)
    globals()[name] = found  # the next use finds it without this function
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
