"""One plain layout for labeled scans of any sensor, and its description ``scans.json``.

::

    FOLDER/scans.json             the description (`ScanLayout`), unless another one is named
    FOLDER/velodyne/NAME.bin      scans, in any format that `read_points` reads
    FOLDER/label/NAME.txt         boxes: class x y z l w h yaw [points], in the frame of the scan; or those of a tool
    FOLDER/semseg/NAME.u8         a class for every point, uint8; or NAME.label, uint32 as in SemanticKITTI
    FOLDER/semseg_classes.json    names of these classes by their numbers
    FOLDER/drivable/NAME.json     the drivable area: a list of polygons [[x, y], ...] or [[x, y, z], ...]
    FOLDER/frames.csv             columns name and drive

A scan is labeled if it has at least one of the three label files. ``layouts/`` beside this module has descriptions of
public sets. With ``"files": "semantickitti"`` in the description, the folder is SemanticKITTI's root instead:
``sequences/SEQ/velodyne/NAME.bin`` and ``sequences/SEQ/labels/NAME.label``.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError, SensorError
from ..readers.files import read_points
from ..simulation.samples import IGNORE
from ..simulation.scene import POINT_CLASS_OF, POINT_CLASSES
from ..system.names import check_name
from ..types.geometry import inside
from ..types.mounting import Mounting
from ..types.perception import Box
from ..types.sensor import SensorProfile, get_sensor
from .annotations import read_datumaro, read_labelcloud, read_sustechpoints
from .kitti import IMAGE_SIZE, SEQUENCE_DRIVES, KittiCalibration, KittiLabels, label_objects, read_labels
from .splits import in_split

__all__ = [
    "SCHEMA",
    "ScanFolder",
    "ScanFrame",
    "ScanLayout",
    "box_label",
    "class_number",
    "known_layouts",
    "read_layout",
]

SCHEMA = 1
LAYOUTS = Path(__file__).with_name("layouts")

BACKGROUND, DRIVABLE, IGNORED, ANY = "background", "drivable", "ignore", "*"
BOX_COLUMNS = ("class", "x", "y", "z", "l", "w", "h", "yaw")
SUFFIXES = (".pcd.bin", ".bin", ".npy", ".npz", ".pcd", ".ply")
_BOX_FILES = {
    "kitti": "label_2/{}.txt",
    "labelcloud": "labels/{}.json",
    "sustechpoints": "label/{}.json",
    "cvat": "annotations/default.json",
}
MARGIN_M = 0.05  # a label box is often a little smaller than its object

_COARSE = {"van": "car", "truck": "car", "person_sitting": "pedestrian"}
_SENSOR_KEYS = {"like", "name", "elevations_deg", "columns", "remission_range", "min_range_m", "max_range_m"}
_CLASS_NAME = re.compile(r"[a-z][a-z0-9 _-]{0,30}")
_KEYS = {
    *("schema", "name", "about", "files", "sensor", "mounting", "boxes", "box_format", "box_columns"),
    *("points", "point_names", "labeled_deg", "labeled_m", "min_points", "drives", "splits"),
}


def class_number(name: str, classes: Sequence[str] = POINT_CLASSES) -> int:
    """Label of a class of a description among the classes of points of a network.

    Parameters
    ----------
    name : str
        A value of `ScanLayout.boxes` or `ScanLayout.points`.
    classes : sequence of str
        Classes of the network, the background first.

    Returns
    -------
    int
        Its index. Vans and trucks count as cars and sitting persons as pedestrians, if ``classes`` lacks them;
        ``drivable`` is background. `IGNORE` for a class that the network does not have.
    """
    if name in classes:
        return classes.index(name)
    if name in (BACKGROUND, DRIVABLE):
        return 0
    coarse = _COARSE.get(name)
    return classes.index(coarse) if coarse in classes else IGNORE


@dataclass(frozen=True)
class ScanLayout:
    """What ``scans.json`` says of the scans of a folder.

    Attributes
    ----------
    name : str
        Name of the set, in tables and in cards.
    files : str
        ``"plain"``, or ``"semantickitti"``: the tree of that set; a scan is called ``SEQ/NAME``, and its drive is that
        of its sequence (`datasets.SEQUENCE_DRIVES`).
    sensor : SensorProfile
        Its ``mounting`` is what is known of the mounting.
    boxes, points : mapping of str to str
        Class of a label file, in lower case -> class of edgeperc: ``car``, ``van``, ``truck``, ``pedestrian``,
        ``person_sitting``, ``cyclist``, ``background``, a new name, or ``ignore`` (objects and points of which nothing
        is known); for points also ``drivable``. The key ``*`` stands for all other classes.
    box_format : str
        ``"plain"``: ``label/NAME.txt``; ``"kitti"``: ``label_2/NAME.txt`` with ``calib/NAME.txt``; or what an
        annotation tool saves: ``"labelcloud"``: ``labels/NAME.json``, ``"sustechpoints"``: ``label/NAME.json``,
        ``"cvat"``: ``annotations/default.json`` of its format "Datumaro 3D".
    box_columns : tuple of str
        Columns of ``label/NAME.txt``. Columns that are not among `BOX_COLUMNS` are skipped; columns after the listed
        ones are too.
    point_names : mapping of int to str, or None
        Names of the numbers in ``semseg``; None: ``semseg_classes.json`` has them.
    labeled_deg : tuple of 2 float
        Sector in which all objects have boxes, as azimuths counter-clockwise from x [deg].
    labeled_m : float
        Distance up to which all objects have boxes [m].
    min_points : int
        A box with fewer points need not be detected, and its object is not counted.
    drives : str
        ``"table"``: ``frames.csv`` names them, and without that file each scan is a drive of its own; ``"scan"``: each
        scan is a drive of its own; ``"one"``: all scans are of one drive.
    splits : mapping of str to tuple of str
        ``"train"``, ``"validation"`` or ``"test"`` -> drives; ``*`` stands for all drives that are not listed. Drives
        that no entry covers are for training and testing, as in `splits.in_split`.
    """

    name: str
    sensor: SensorProfile
    boxes: Mapping[str, str]
    points: Mapping[str, str]
    files: str = "plain"
    box_format: str = "plain"
    box_columns: tuple[str, ...] = BOX_COLUMNS
    point_names: Mapping[int, str] | None = None
    labeled_deg: tuple[float, float] = (-180.0, 180.0)
    labeled_m: float = math.inf
    min_points: int = 1
    drives: str = "table"
    splits: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def from_json(cls, text: str, folder: Path | None = None) -> ScanLayout:
        """Read a description.

        Parameters
        ----------
        text : str
            JSON.
        folder : Path or None
            Folder of the profile that ``sensor`` names, if it is a file.

        Raises
        ------
        PointsError
            Not JSON, another schema, or an entry that is missing, unknown or of another type.
        SensorError
            The sensor is unknown, or the mounting impossible.
        """
        try:
            given = json.loads(text)
        except (RecursionError, ValueError) as exc:
            raise PointsError(f"the description is not JSON ({exc}); expected an object with schema {SCHEMA}") from exc
        if not isinstance(given, dict) or given.get("schema") != SCHEMA:
            found = given.get("schema") if isinstance(given, dict) else type(given).__name__
            raise PointsError(f"the description has schema {found!r:.60}; this edgeperc reads an object with {SCHEMA}")
        if unknown := sorted(given.keys() - _KEYS):
            raise PointsError(
                f"unknown entries {', '.join(unknown)[:200]}; expected some of {', '.join(sorted(_KEYS))}"
            )
        boxes, points = (_classes(given, key) for key in ("boxes", "points"))
        if DRIVABLE in boxes.values():
            raise PointsError("boxes: a class of boxes cannot be drivable; give the area in drivable/, or by points")
        name = given.get("name", "scans")
        if not isinstance(name, str) or not re.fullmatch(r"[\w.-]{1,40}", name):
            raise PointsError(f"name is {name!r:.60}; expected 1 to 40 letters, digits, '.', '_' or '-'")
        check_name("name", name, PointsError)
        own: dict[str, Any] = {"name": name, "sensor": _sensor(given, folder), "boxes": boxes, "points": points}
        allowed = {"files": ("plain", "semantickitti"), "box_format": ("plain", *_BOX_FILES)}
        for key, choices in {**allowed, "drives": ("table", "scan", "one")}.items():
            if key in given and given[key] not in choices:
                raise PointsError(f"{key} is {given[key]!r:.60}; expected {' or '.join(choices)}")
            own |= {key: given[key]} if key in given else {}
        if "box_columns" in given:
            own["box_columns"] = columns = tuple(map(str, _listed(given, "box_columns", str)))
            if missing := [column for column in BOX_COLUMNS if columns.count(column) != 1]:
                raise PointsError(f"box_columns is {columns}; expected {', '.join(missing)} once each")
        if "point_names" in given:
            own["point_names"] = _point_names(given["point_names"], "point_names")
        if "labeled_deg" in given:
            low, high = own["labeled_deg"] = _pair(given, "labeled_deg")
            if not -360.0 <= low < high <= 360.0 or high - low > 360.0:
                raise PointsError(f"labeled_deg is {[low, high]}; expected the right and the left end, up to 360 apart")
        if "labeled_m" in given:
            own["labeled_m"] = _number(given["labeled_m"], "labeled_m")
            if own["labeled_m"] <= 0.0:
                raise PointsError(f"labeled_m is {given['labeled_m']}; expected a distance above 0")
        if "min_points" in given:
            own["min_points"] = least = given["min_points"]
            if isinstance(least, bool) or not isinstance(least, int) or not 0 <= least <= 10**6:
                raise PointsError(f"min_points is {least!r:.60}; expected a whole number from 0")
        if "splits" in given:
            own["splits"] = _splits(given["splits"])
        return cls(**own)

    def in_split(self, drive: str, split: str, fold: int | None = None) -> bool:
        """Whether a drive belongs to a split, as `splits.in_split` says, with the description's own lists first.

        Drives that a description lists are in no fold: with a ``fold``, its validation drives stay out.
        """
        unlisted = in_split(drive, split, fold)  # checks the arguments too
        listed = next((key for key, drives in self.splits.items() if drive in drives), None)
        listed = listed or next((key for key, drives in self.splits.items() if ANY in drives), None)
        if listed is None:
            return unlisted
        return split == "all" or (split == listed and not (listed == "validation" and fold is not None))


@dataclass(frozen=True)
class ScanFrame:
    """One scan of a `ScanFolder` and its labels, in the frame of the scan.

    Attributes
    ----------
    name, drive : str
    layout : ScanLayout
    points : (n, 4) float32
        x, y, z [m], remission in the sensor's raw unit.
    boxes : tuple of Box
        With the classes of edgeperc and of the description; ``"ignore"`` for objects of which nothing is known.
    point_classes : (n,) uint8 or None
        Index into `class_names`; None if the points of this scan are not labeled.
    drivable : tuple of (k, 2) float64, or None
        Polygons of the drivable area [m]; None if this scan has none.
    calibration : KittiCalibration or None
        Of the camera in whose image objects are labeled, if the labels are KITTI's.
    unlabeled : (k, 4) float64
        DontCare rectangles of that image [px].
    image_labels : KittiLabels or None
        KITTI's rows, with the classes of `boxes`.
    """

    name: str
    drive: str
    layout: ScanLayout
    points: NDArray[np.float32]
    boxes: tuple[Box, ...] | None
    point_classes: NDArray[np.uint8] | None
    drivable: tuple[NDArray[np.float64], ...] | None
    calibration: KittiCalibration | None = None
    unlabeled: NDArray[np.float64] | None = None
    image_labels: KittiLabels | None = None

    @cached_property
    def class_names(self) -> tuple[str, ...]:
        """Classes of `point_classes`."""
        return _point_class_names(self.layout)

    @cached_property
    def returns(self) -> tuple[int, ...]:
        """Number of points in each box; 0 if it has fewer than the description's ``min_points``, or is ignored."""
        counts = [(box.label, int(np.count_nonzero(inside(box, self.points, 0.1)))) for box in self.boxes or ()]
        return tuple(n if n >= self.layout.min_points and label != IGNORED else 0 for label, n in counts)

    @property
    def azimuths(self) -> tuple[float, float]:
        """Right and left end of the sector in which all objects have boxes [rad], counter-clockwise from x."""
        if self.calibration is None:
            low, high = self.layout.labeled_deg
            return math.radians(low), math.radians(high)
        focal, middle = self.calibration.P2[0, 0], self.calibration.P2[0, 2]
        return -math.atan2(IMAGE_SIZE[0] - middle, focal), math.atan2(middle, focal)

    def known_at(self, places: NDArray[Any]) -> NDArray[np.bool_]:
        """Whether all objects at places (n, 3+) [m] have boxes, (n,) bool."""
        if self.boxes is None:
            return np.zeros(len(places), np.bool_)
        low, high = self.layout.labeled_deg
        with np.errstate(invalid="ignore"):
            azimuth = np.degrees(np.arctan2(places[:, 1], places[:, 0]))
            known = np.asarray((azimuth - low) % 360.0 <= high - low, np.bool_)
            known &= np.hypot(places[:, 0], places[:, 1]) <= self.layout.labeled_m
        if self.calibration is not None and self.unlabeled is not None:
            known &= self.calibration.labeled_at(places, self.unlabeled)
        return known

    def labels(self, classes: Sequence[str] = POINT_CLASSES, *, by: str | None = None) -> NDArray[np.uint8]:
        """True class of each point, (n,) uint8: index into ``classes``, `IGNORE` where unknown.

        Parameters
        ----------
        classes : sequence of str
            As in `class_number`.
        by : {"points", "boxes"} or None
            Labels of points, or the class of the box around a point. None: of points if the scan has them, else by
            boxes; all unknown if it has neither.

        Raises
        ------
        PointsError
            The scan has no such labels.
        """
        if by is None and self.point_classes is None and self.boxes is None:
            return np.full(len(self.points), IGNORE, np.uint8)
        by = by or ("boxes" if self.point_classes is None else "points")
        if by == "points" and self.point_classes is not None:
            numbers = np.array([class_number(name, classes) for name in self.class_names], np.uint8)
            return numbers[self.point_classes]
        if by != "boxes" or self.boxes is None:
            raise PointsError(f"scan {self.name} has no labels by {by}; expected points, or boxes, that it has")
        labels = np.where(self.known_at(self.points), 0, IGNORE).astype(np.uint8)
        # Ignored boxes first: a box of a rider alone lies in that of the cyclist.
        for box in sorted(self.boxes, key=lambda box: box.label != IGNORED):
            labels[inside(box, self.points, MARGIN_M)] = class_number(box.label, classes)
        return labels

    def road_labels(self) -> NDArray[np.uint8] | None:
        """Index into `datasets.ROAD_CLASSES` of each point, (n,) uint8, `IGNORE` where unknown.

        None if the points are not labeled, or no class of theirs is drivable.
        """
        if self.point_classes is None or DRIVABLE not in self.class_names:
            return None
        numbers = {DRIVABLE: 1, "car": 2, "van": 2, "truck": 2, IGNORED: IGNORE}
        return np.array([numbers.get(name, 0) for name in self.class_names], np.uint8)[self.point_classes]


def box_label(name: str, labels: Collection[str]) -> str:
    """Class of a detection in a set that tells ``labels`` apart: a van is a car in a set without vans."""
    return name if name in labels else _COARSE.get(name, name)


class ScanFolder:
    """The labeled scans of a folder in the plain layout.

    Parameters
    ----------
    root : str or Path
    layout : str, Path, ScanLayout or None
        The description: the name of a public set (`known_layouts`), a file, or a `ScanLayout`. None: ``scans.json`` in
        the folder.

    Attributes
    ----------
    layout : ScanLayout
    drives : dict of str to str
        Name of each labeled scan -> its drive.

    Raises
    ------
    PointsError
        There is no description, it does not fit the folder, or the folder has no labeled scans.
    SensorError
        The description names an unknown sensor or an impossible mounting.
    """

    def __init__(self, root: Path | str, layout: str | Path | ScanLayout | None = None) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise PointsError(f"{self.root}: there is no such folder; expected one with scans in velodyne/")
        if layout is None:
            layout = self.root / "scans.json"
            if not layout.is_file():
                raise PointsError(
                    f"{self.root} has no scans.json, which describes its sensor and its classes; write one "
                    f"(docs/howto/train.md), or name a public set: FOLDER:{', FOLDER:'.join(known_layouts())}"
                )
        self.layout = layout if isinstance(layout, ScanLayout) else read_layout(layout)
        self.scans = self._scans()
        self._annotated = read_datumaro(self.root / _BOX_FILES["cvat"]) if self.layout.box_format == "cvat" else {}
        self.drives = self._drives()
        self._point_numbers: NDArray[np.uint8] | None = None

    @classmethod
    def parse(cls, text: str | Path) -> ScanFolder:
        """Open ``PATH``, or ``PATH:LAYOUT`` with the name of a public set or the ``.json`` file of a description."""
        path, colon, layout = str(text).rpartition(":")
        if colon and path and (layout in known_layouts() or layout.endswith(".json")):
            return cls(path, layout)
        if colon and path and not Path(text).exists() and Path(path).is_dir():
            raise PointsError(f"no layout {layout!r}; expected {', '.join(known_layouts())}, or a .json file")
        return cls(str(text))

    def names(self, split: str, *, fold: int | None = None) -> list[str]:
        """Names of the labeled scans of a split (`ScanLayout.in_split`), drive by drive."""
        of_split = [name for name, drive in self.drives.items() if self.layout.in_split(drive, split, fold)]
        return sorted(of_split, key=lambda name: (self.drives[name], name))

    def frame(self, name: str) -> ScanFrame:
        """Read a scan and its labels.

        Raises
        ------
        PointsError
            There is no such scan, or one of its files cannot be read.
        """
        if name not in self.drives:
            raise PointsError(f"{self.root} has no labeled scan {name!r}; its names are those of the files in velodyne")
        points = read_points(self.scans[name])
        calibration = unlabeled = boxes = image_labels = None
        path = self._path("boxes", name)
        if path is not None and self.layout.box_format == "kitti":
            calibration = KittiCalibration.read(self.root / "calib" / f"{name}.txt")
            rows = read_labels(path)
            found, unlabeled = label_objects(rows, calibration)
            boxes = self._renamed(found, path)
            kinds = [k if k == "dontcare" else _class_of(k, self.layout.boxes, path, "boxes") for k in rows.kinds]
            image_labels = KittiLabels(tuple(kinds), rows.numbers)
        elif path is not None:
            boxes = self._renamed(self._read_boxes(path, name), path)
        classes = self._path("points", name)
        area = self._path("drivable", name)
        return ScanFrame(
            name,
            self.drives[name],
            self.layout,
            points,
            boxes,
            None if classes is None else self._read_classes(classes, len(points)),
            None if area is None else _read_polygons(area),
            calibration,
            unlabeled,
            image_labels,
        )

    def _path(self, kind: str, name: str) -> Path | None:
        """The label file of a scan: boxes, points or drivable; None if the scan has none."""
        boxes = _BOX_FILES.get(self.layout.box_format, "label/{}.txt").format(name)
        sequence, _, stem = name.rpartition("/")
        if sequence:
            path = self.root / "sequences" / sequence / "labels" / f"{stem}.label"
            return path if kind == "points" and path.is_file() else None
        candidates = {
            "boxes": (boxes,),
            "points": (f"semseg/{name}.u8", f"semseg/{name}.label"),
            "drivable": (f"drivable/{name}.json",),
        }[kind]
        if kind == "boxes" and self.layout.box_format == "cvat" and name not in self._annotated:
            return None
        return next((self.root / path for path in candidates if (self.root / path).is_file()), None)

    def _scans(self) -> dict[str, Path]:
        scans: dict[str, Path] = {}
        nested = self.layout.files == "semantickitti"
        found = self.root.glob("sequences/*/velodyne/*" if nested else "velodyne/*")
        for path in sorted(found):
            if path.name.startswith("."):
                continue
            suffix = next((end for end in SUFFIXES if path.name.lower().endswith(end)), None)
            if suffix is None:
                raise PointsError(f"{path}: no scan by its name; expected {', '.join(SUFFIXES)} in velodyne/")
            name = path.name[: -len(suffix)]
            name = f"{path.parts[-3]}/{name}" if nested else name
            if name in scans:
                raise PointsError(f"{path} and {scans[name].name} have one name; give each scan a name of its own")
            scans[name] = path
        if not scans:
            expected = "sequences/SEQ/velodyne/NAME.bin" if nested else "velodyne/NAME.bin"
            raise PointsError(f"{self.root} has no scans; expected {expected}")
        return scans

    def _drives(self) -> dict[str, str]:
        for kind, folders in (("boxes", "label or label_2"), ("points", "semseg")):
            if not getattr(self.layout, kind) and any(self._path(kind, name) for name in self.scans):
                raise PointsError(
                    f"{self.root} has label files in {folders}, but the description has no {kind!r}; map their classes "
                    f'there, such as {{"{kind}": {{"Car": "car", "*": "ignore"}}}}'
                )
        labeled = [name for name in self.scans if any(self._path(k, name) for k in ("boxes", "points", "drivable"))]
        if not labeled:
            raise PointsError(
                f"{self.root} has no labels for its scans ({next(iter(self.scans))}, ...); expected label/NAME.txt, "
                "semseg/NAME.u8 or drivable/NAME.json (with box_format kitti: label_2/NAME.txt and calib/NAME.txt)"
            )
        if self.layout.files == "semantickitti":
            sequences = {name: name.partition("/")[0] for name in labeled}
            return {name: SEQUENCE_DRIVES.get(sequence, sequence) for name, sequence in sequences.items()}
        if self.layout.drives == "one":
            return dict.fromkeys(labeled, self.layout.name)
        table = self.root / "frames.csv"
        if self.layout.drives == "scan" or not table.exists():
            return {name: name for name in labeled}
        try:
            with table.open(newline="", encoding="utf-8") as file:
                rows = list(csv.DictReader(file))
        except (OSError, UnicodeDecodeError, csv.Error) as exc:
            raise PointsError(f"{table} cannot be read ({exc}); expected columns name and drive") from exc
        drives = {row.get("name") or "": row.get("drive") or "" for row in rows}
        if not rows or "" in drives or "" in drives.values():
            raise PointsError(f"{table}: expected columns name and drive, both filled in every row")
        if missing := [name for name in labeled if name not in drives]:
            raise PointsError(f"{table} has no drive of {', '.join(missing[:5])}; add a row for every labeled scan")
        return {name: drives[name] for name in labeled}

    def _read_boxes(self, path: Path, name: str) -> list[Box]:
        """Boxes of a scan with the classes of its label file."""
        if self.layout.box_format == "cvat":
            return self._annotated[name]
        if self.layout.box_format == "labelcloud":
            return read_labelcloud(path)
        if self.layout.box_format == "sustechpoints":
            return read_sustechpoints(path)
        return _read_boxes(path, self.layout.box_columns)

    def _renamed(self, boxes: Sequence[Box], path: Path) -> tuple[Box, ...]:
        """Boxes with the classes of the description; boxes of background are left out."""
        renamed = (replace(box, label=_class_of(box.label, self.layout.boxes, path, "boxes")) for box in boxes)
        return tuple(box for box in renamed if box.label != BACKGROUND)

    def _read_classes(self, path: Path, n_points: int) -> NDArray[np.uint8]:
        data = np.fromfile(path, np.uint8)
        raw: NDArray[Any] = data
        if path.suffix == ".label":
            if data.size % 4:
                raise PointsError(f"{path}: {data.size} bytes are no uint32 labels; expected 4 bytes for each point")
            raw = data.view("<u4") & 0xFFFF  # the upper 16 bits are the instance
        if len(raw) != n_points:
            raise PointsError(
                f"{path} has {len(raw)} labels for a scan of {n_points} points; expected one for each point"
            )
        if self._point_numbers is None:
            self._point_numbers = self._numbers()
        found = np.unique(raw)
        known = found < len(self._point_numbers)
        known[known] = self._point_numbers[found[known]] != IGNORE
        if not known.all():
            raise PointsError(
                f"{path}: no name for {', '.join(map(str, found[~known][:5]))}; add it to semseg_classes.json or, in "
                "the description, to point_names"
            )
        return self._point_numbers[raw]

    def _numbers(self) -> NDArray[np.uint8]:
        """Raw number of a class -> index into the description's classes, `IGNORE` if it has no name."""
        names, source = self.layout.point_names, self.root / "semseg_classes.json"
        if names is None:
            try:
                document = json.loads(source.read_text(encoding="utf-8"))
            except (OSError, RecursionError, UnicodeDecodeError, ValueError) as exc:
                raise PointsError(
                    f"{source} cannot be read ({exc}); expected names by number, or point_names in the description"
                ) from exc
            names = _point_names(document, str(source))
        classes = _point_class_names(self.layout)
        numbers = np.full(max(names, default=0) + 1, IGNORE, np.uint8)
        numbers[0] = classes.index(IGNORED)  # 0 is unlabeled, unless it has a name
        for number, name in names.items():
            numbers[number] = classes.index(_class_of(name, self.layout.points, source, "points"))
        return numbers


def known_layouts() -> tuple[str, ...]:
    """Names of the public sets that have a description."""
    return tuple(sorted(path.stem for path in LAYOUTS.glob("*.json")))


def read_layout(layout: str | Path) -> ScanLayout:
    """Read a description by the name of a public set, or from a file (a Path, or a str that ends in ``.json``).

    Raises
    ------
    PointsError, SensorError
        As `ScanLayout.from_json`; the file cannot be read, or no public set has this name.
    """
    if isinstance(layout, str) and not layout.endswith(".json"):
        if layout not in known_layouts():
            raise PointsError(f"no layout {layout!r}; expected {', '.join(known_layouts())}, or a .json file")
        layout = LAYOUTS / f"{layout}.json"
    path = Path(layout)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise PointsError(f"{path}: the description cannot be read ({exc})") from exc
    try:
        return ScanLayout.from_json(text, path.parent)
    except SensorError as exc:
        raise SensorError(f"{path}: {exc}") from exc
    except PointsError as exc:
        raise PointsError(f"{path}: {exc}") from exc


def _point_class_names(layout: ScanLayout) -> tuple[str, ...]:
    """Classes of points by number, ``ignore`` first."""
    return (IGNORED, *sorted(set(layout.points.values()) - {IGNORED}))


def _class_of(name: str, classes: Mapping[str, str], path: Path, kind: str) -> str:
    key = name.lower()
    if key not in classes and ANY not in classes:
        raise PointsError(
            f"{path}: no class for {name!r:.60}; add it to {kind} of the description, with a class or 'ignore', or add "
            "'*' for all others"
        )
    return classes[key] if key in classes else classes[ANY]


def _read_boxes(path: Path, columns: Sequence[str]) -> list[Box]:
    """Boxes of a label file, with the classes in it."""
    boxes: list[Box] = []
    place = {column: columns.index(column) for column in BOX_COLUMNS}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as exc:
        raise PointsError(f"{path}: the labels cannot be read ({exc})") from exc
    for number, line in enumerate(lines, 1):
        values = line.split()
        if not values:
            continue
        try:
            x, y, z, length, width, height, yaw = (float(values[place[column]]) for column in BOX_COLUMNS[1:])
        except (IndexError, ValueError) as exc:
            raise PointsError(f"{path}, line {number}: {line[:100]!r}; expected {' '.join(columns)}") from exc
        if not all(map(math.isfinite, (x, y, z, length, width, height, yaw))) or min(length, width, height) <= 0.0:
            raise PointsError(f"{path}, line {number}: {line[:100]!r}; expected finite numbers and sizes above 0")
        boxes.append(Box(values[place["class"]], 1.0, (x, y, z), (length, width, height), yaw))
    return boxes


def _read_polygons(path: Path) -> tuple[NDArray[np.float64], ...]:
    try:
        polygons = [np.array(ring, np.float64) for ring in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, RecursionError, TypeError, UnicodeDecodeError, ValueError) as exc:
        raise PointsError(f"{path}: no polygons ({exc}); expected a list of lists of corners [x, y]") from exc
    for ring in polygons:
        if ring.ndim != 2 or len(ring) < 3 or ring.shape[1] not in (2, 3) or not np.isfinite(ring).all():
            raise PointsError(
                f"{path}: a polygon of shape {ring.shape}; expected three corners [x, y] or [x, y, z] or more, finite"
            )
    return tuple(polygons)


# --- entries of a description -----------------------------------------------------------------------------------------


def _classes(given: Mapping[str, Any], key: str) -> Mapping[str, str]:
    entries = given.get(key, {})
    if not isinstance(entries, dict) or not all(isinstance(value, str) for value in entries.values()):
        raise PointsError(
            f'{key} is {entries!r:.80}; expected classes of the labels with ours, such as {{"Car": "car"}}'
        )
    classes = {name.lower(): value for name, value in entries.items()}
    if len(classes) < len(entries):
        raise PointsError(f"{key} has a class twice, in lower and upper case; give it once")
    for name, value in entries.items():
        if not _CLASS_NAME.fullmatch(value):
            raise PointsError(
                f"{key}: {name!r:.60} is mapped to {value!r:.60}; expected {', '.join(POINT_CLASS_OF)}, {BACKGROUND}, "
                f"{DRIVABLE} (points), {IGNORED}, or a new name of lower-case letters, digits, spaces, _ and -"
            )
    return MappingProxyType(classes)


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
        raise PointsError(
            f"sensor is {named!r:.80}; expected the name of a sensor, the .json file of a profile, or an object with "
            f"some of {', '.join(sorted(_SENSOR_KEYS))}"
        )
    if "mounting" in given:
        known, names = given["mounting"], {each.name for each in fields(Mounting)}
        if not isinstance(known, dict) or not known.keys() <= names:
            raise PointsError(f"mounting is {known!r:.80}; expected what is known of {', '.join(sorted(names))}")
        sensor = replace(sensor, mounting=Mounting(**known))
    return sensor


def _splits(given: object) -> Mapping[str, tuple[str, ...]]:
    if not isinstance(given, dict) or not given.keys() <= {"train", "validation", "test"}:
        raise PointsError(f"splits is {given!r:.80}; expected lists of drives for train, validation and test")
    splits = {split: tuple(map(str, _listed(given, split, str))) for split in given}
    drives = [drive for of_split in splits.values() for drive in of_split]
    if twice := sorted({drive for drive in drives if drives.count(drive) > 1}):
        raise PointsError(f"splits lists {', '.join(twice)[:80]} twice; whole drives belong to one split")
    return MappingProxyType(splits)


def _point_names(given: object, source: str) -> Mapping[int, str]:
    valid = isinstance(given, dict) and all(
        isinstance(name, str) and re.fullmatch(r"[0-9]{1,5}", str(number)) and int(number) <= 0xFFFF
        for number, name in given.items()
    )
    if not valid:
        raise PointsError(f'{source}: {given!r:.80}; expected names by number up to 65535, such as {{"1": "Road"}}')
    assert isinstance(given, dict)
    return MappingProxyType({int(number): name for number, name in given.items()})


def _listed(given: Mapping[str, Any], key: str, kind: type) -> list[Any]:
    values = given[key]
    if not isinstance(values, list) or not all(isinstance(value, kind) for value in values):
        raise PointsError(f"{key} is {values!r:.80}; expected a list of {kind.__name__}")
    return values


def _pair(given: Mapping[str, Any], key: str) -> tuple[float, float]:
    values = given[key]
    if not isinstance(values, list) or len(values) != 2:
        raise PointsError(f"{key} is {values!r:.80}; expected two numbers")
    return _number(values[0], key), _number(values[1], key)


def _number(value: object, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e9:
        raise PointsError(f"{key} is {value!r:.60}; expected a number")
    return float(value)
