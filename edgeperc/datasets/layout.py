"""The layout of a folder of labeled scans, as its description (scans.json) says it."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..errors import PointsError, SensorError
from ..simulation.samples import IGNORE
from ..simulation.scene import POINT_CLASS_OF, POINT_CLASSES, SCENE_CLASSES
from ..system.fields import Fields
from ..system.names import check_name, nearest
from ..types.choices import STATIC
from ..types.mounting import Mounting
from ..types.points import Bytes
from ..types.sensor import SensorProfile, get_sensor
from .splits import in_split

BOX_COLUMNS = ("class", "x", "y", "z", "l", "w", "h", "yaw")
BOX_FILES = {
    "kitti": "label_2/{}.txt",
    "labelcloud": "labels/{}.json",
    "sustechpoints": "label/{}.json",
    "cvat": "annotations/default.json",
}
COARSE = {"van": "car", "truck": "car", "person_sitting": "pedestrian", "drivable": "road"}
# Parts of the background. Some sets tell poles from walls, some do not: theirs is "static object".
PARTS = (*STATIC, "static object")
SCHEMA = 1
LAYOUTS = Path(__file__).with_name("layouts")
BACKGROUND, DRIVABLE, IGNORED, ANY = "background", "drivable", "ignore", "*"
WITH_RIDER = ".with_rider"  # after the class of a box, by its attribute in nuScenes' tables
_SENSOR_KEYS = {"like", "name", "elevations_deg", "columns", "remission_range", "min_range_m", "max_range_m"}
_CLASS_NAME = re.compile(r"[a-z][a-z0-9 _-]{0,30}")
_FIELDS = Fields("the description", PointsError, "write what docs/howto/sensor.md lists", optional=("*",), exact=True)
_MOUNTING = Fields("mounting", SensorError, optional=("*",), exact=True)


def class_number(name: str, classes: Sequence[str] = POINT_CLASSES) -> int:
    """Label of a description's class in a network's ``classes``: that of a coarser one if they lack it (`COARSE`), 0
    for a part of the background if they have none, `IGNORE` for what they do not have.
    """
    name = name if name in classes else COARSE.get(name, name)
    if name in classes:
        return classes.index(name)
    return 0 if name == BACKGROUND or (name in PARTS and not tells_parts(classes)) else IGNORE


def tells_parts(classes: Sequence[str]) -> bool:
    """Whether classes tell parts of the background apart: of what is in no box, boxes then say nothing."""
    return not set(PARTS).isdisjoint(classes)


def numbers_of_scene(classes: Sequence[str] = POINT_CLASSES) -> Bytes:
    """`class_number` of each of `SCENE_CLASSES`, by its index, (256,) uint8; other numbers stay as they are."""
    numbers = np.arange(256, dtype=np.uint8)
    numbers[: len(SCENE_CLASSES)] = [class_number(name, classes) for name in SCENE_CLASSES]
    return numbers


@dataclass(frozen=True)
class ScanLayout:
    """What ``scans.json`` says of the scans of a folder. ``boxes`` and ``points`` map classes of label files, in lower
    case, to ours, a new name or "ignore" (nothing is known of them); the key ``*`` stands for all others.
    """

    name: str  # in tables and in cards
    sensor: SensorProfile  # with what is known of its mounting
    boxes: Mapping[str, str]
    points: Mapping[str, str]  # also ``drivable`` and the `PARTS` of the background
    # "semantickitti": its tree; scans are called SEQ/NAME. Those behind it: theirs, or the plain one
    files: Literal[
        "plain",
        "semantickitti",
        "argoverse2",
        "kitti-raw",
        "kitti-tracking",
        "nuscenes",
        "once",
        "pandaset",
        "vod",
        "waymo",
    ] = "plain"
    # "plain": label/NAME.txt; others: `BOX_FILES`
    box_format: Literal["plain", "kitti", "labelcloud", "sustechpoints", "cvat"] = "plain"
    image_size: tuple[int, int] | None = None  # width and height [px], of "kitti" boxes; None: those of KITTI's images
    # of ``label/NAME.txt``; others than `BOX_COLUMNS`, and those after them, are skipped
    box_columns: tuple[str, ...] = BOX_COLUMNS
    point_names: Mapping[int, str] | None = None  # of the numbers in ``semseg``; None: semseg_classes.json has them
    labeled_deg: tuple[float, float] = (-180.0, 180.0)  # azimuths between which all objects have boxes
    labeled_m: float = math.inf  # up to where all objects have boxes
    min_points: int = 1  # a box with fewer need not be detected, and its object is not counted
    drives: Literal["table", "scan", "one"] = "table"  # each by frames.csv (or scan without it), each scan, or all one
    # drives by split; ``*``: all that are not listed
    splits: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def from_json(cls, text: str, folder: Path | None = None) -> ScanLayout:
        """Read a description; a profile that ``sensor`` names lies in ``folder``. Raises PointsError, SensorError."""
        given = _FIELDS.document(text, SCHEMA)
        boxes, points = (_classes(given, key) for key in ("boxes", "points"))
        if DRIVABLE in boxes.values():
            raise PointsError("boxes: a class of boxes cannot be drivable; give the area in drivable/, or by points")
        values = {"name": "scans", **given, "sensor": _sensor(given, folder), "boxes": boxes, "points": points}
        if "point_names" in given:
            values["point_names"] = point_names_of(given["point_names"], "point_names")
        return _FIELDS.read(cls, {key: value for key, value in values.items() if key not in ("about", "mounting")})

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[\w.-]{1,40}", self.name):
            _FIELDS.refuse("name", self.name, "1 to 40 letters, digits, '.', '_' or '-'")
        check_name("name", self.name, PointsError)
        if missing := [column for column in BOX_COLUMNS if self.box_columns.count(column) != 1]:
            _FIELDS.refuse("box_columns", self.box_columns, f"{', '.join(missing)} once each")
        low, high = self.labeled_deg
        if not -360.0 <= low < high <= 360.0 or high - low > 360.0:
            _FIELDS.refuse("labeled_deg", [low, high], "the right and the left end, up to 360 apart")
        if not self.labeled_m > 0.0:
            _FIELDS.refuse("labeled_m", self.labeled_m, "a distance above 0")
        _FIELDS.whole("min_points", self.min_points, 0, 10**6)
        if self.image_size is not None and not all(0 < pixels <= 2**15 for pixels in self.image_size):
            _FIELDS.refuse("image_size", self.image_size, "width and height in pixels, 1 to 32768")
        if not self.splits.keys() <= {"train", "validation", "test"}:
            _FIELDS.refuse("splits", [*self.splits], "train, validation and test")
        drives = [drive for listed in self.splits.values() for drive in listed]
        if twice := sorted({drive for drive in drives if drives.count(drive) > 1}):
            raise PointsError(f"splits lists {', '.join(twice)[:80]} twice; whole drives belong to one split")

    def in_split(self, drive: str, split: str, fold: int | None = None) -> bool:
        """As `splits.in_split`, the description's own lists first; with a ``fold``, its validation drives stay out."""
        unlisted = in_split(drive, split, fold)  # checks the arguments too
        listed = next((key for key, drives in self.splits.items() if drive in drives), None)
        listed = listed or next((key for key, drives in self.splits.items() if ANY in drives), None)
        if listed is None:
            return unlisted
        return split == "all" or (split == listed and not (listed == "validation" and fold is not None))


def box_label(name: str, labels: Collection[str]) -> str:
    """Class of a detection in a set that tells ``labels`` apart: a van is a car in a set without vans."""
    return name if name in labels else COARSE.get(name, name)


def known_layouts() -> tuple[str, ...]:
    """Names of the public sets that have a description."""
    return tuple(sorted(path.stem for path in LAYOUTS.glob("*.json")))


def read_layout(layout: str | Path) -> ScanLayout:
    """The description of a public set by name, or of a Path or a str in ``.json``. Raises PointsError, SensorError."""
    if isinstance(layout, str) and not layout.endswith(".json"):
        known = known_layouts()
        if layout not in known:
            raise PointsError(
                f"no layout {layout!r}{nearest(layout, known)}; expected {', '.join(known)}, or a .json file"
            )
        layout = LAYOUTS / f"{layout}.json"
    path = Path(layout)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as exc:
        raise PointsError(f"{path}: the description cannot be read ({exc})") from exc
    try:
        return ScanLayout.from_json(text, path.parent)
    except (PointsError, SensorError) as exc:
        raise type(exc)(f"{path}: {exc}") from exc


def point_class_names(layout: ScanLayout) -> tuple[str, ...]:
    """Classes of points by number, ``ignore`` first."""
    return (IGNORED, *sorted(set(layout.points.values()) - {IGNORED}))


def class_of_name(name: str, classes: Mapping[str, str], path: Path, kind: str) -> str:
    """The class that a description gives to a name in a label file."""
    key = next((each for each in (name.lower(), name.lower().removesuffix(WITH_RIDER)) if each in classes), ANY)
    if key not in classes:
        raise PointsError(
            f"{path}: no class for {name!r:.60}; add it to {kind} of the description, with a class or 'ignore', or add "
            "'*' for all others"
        )
    return classes[key]


def _classes(given: Mapping[str, Any], key: str) -> Mapping[str, str]:
    entries = given.get(key, {})
    if not isinstance(entries, dict) or not all(isinstance(value, str) for value in entries.values()):
        _FIELDS.refuse(key, entries, 'classes of the labels with ours, such as {"Car": "car"}')
    classes = {name.lower(): value for name, value in entries.items()}
    if len(classes) < len(entries):
        raise PointsError(f"{key} has a class twice, in lower and upper case; give it once")
    for name, value in entries.items():
        if not _CLASS_NAME.fullmatch(value):
            raise PointsError(
                f"{key}: {name!r:.60} is mapped to {value!r:.60}; expected {', '.join(POINT_CLASS_OF)}, {BACKGROUND}, "
                f"{DRIVABLE} (points), {IGNORED}, or a new name of lower-case letters, digits, spaces, _ and -"
            )
    return classes


def _sensor(given: Mapping[str, Any], folder: Path | None) -> SensorProfile:
    named = given.get("sensor")
    if isinstance(named, str) and named.isprintable():
        sensor = get_sensor(named if not named.endswith(".json") or folder is None else folder / named)
    elif isinstance(named, dict) and named.keys() <= _SENSOR_KEYS:
        values = {key: value for key, value in named.items() if key != "like"}
        if "like" in named:
            sensor = replace(get_sensor(str(named["like"])), **values)
        elif {"name", "elevations_deg", "columns"} <= values.keys():
            sensor = SensorProfile(**values)
        else:
            raise PointsError("sensor: expected 'like' with the name of a sensor, or name, elevations_deg and columns")
    else:
        expected = "the name of a sensor, the .json file of a profile, or an object with some of "
        _FIELDS.refuse("sensor", named, expected + ", ".join(sorted(_SENSOR_KEYS)))
    if "mounting" in given:
        sensor = replace(sensor, mounting=_MOUNTING.read(Mounting, given["mounting"], "mounting"))
    return sensor


def point_names_of(given: object, source: str) -> Mapping[int, str]:
    """Names of points by number, checked."""
    if not isinstance(given, dict) or not all(
        isinstance(name, str) and re.fullmatch(r"[0-9]{1,5}", str(number)) and int(number) <= 0xFFFF
        for number, name in given.items()
    ):
        _FIELDS.refuse(source, given, 'names by number up to 65535, such as {"1": "Road"}')
    return {int(number): name for number, name in given.items()}
