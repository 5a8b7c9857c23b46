"""One plain layout for labeled scans of any sensor, and its description ``scans.json``.

::

    FOLDER/scans.json             the description (`ScanLayout`), unless another one is named
    FOLDER/velodyne/NAME.bin      scans, in any format that `read_points` reads
    FOLDER/label/NAME.txt         boxes: class x y z l w h yaw [points], in the frame of the scan; or those of a tool
    FOLDER/semseg/NAME.u8         a class for every point, uint8; or NAME.label, uint32 as in SemanticKITTI
    FOLDER/semseg_classes.json    names of these classes by their numbers
    FOLDER/drivable/NAME.json     the drivable area: a list of polygons [[x, y], ...] or [[x, y, z], ...]
    FOLDER/frames.csv             columns name and drive

A scan is labeled if it has at least one of the three label files. ``layouts/`` next to this module has descriptions of
public sets. With ``"files": "semantickitti"`` in the description, the folder is SemanticKITTI's root instead:
``sequences/SEQ/velodyne/NAME.bin`` and ``sequences/SEQ/labels/NAME.label``. With a name of `TREES`, a folder
without ``velodyne`` is the root of that set, as it is downloaded.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..readers.files import read_points
from ..simulation.samples import IGNORE
from ..simulation.scene import POINT_CLASSES
from ..system.names import SCAN_SUFFIXES, stem_of
from ..types.choices import VEHICLES
from ..types.geometry import inside
from ..types.perception import ROADS, Box
from ..types.points import Bytes, Floats, Mask, Points
from . import kitti
from .annotations import read_datumaro, read_json, read_labelcloud, read_sustechpoints
from .layout import (
    ANY,
    BACKGROUND,
    BOX_COLUMNS,
    BOX_FILES,
    IGNORED,
    ScanLayout,
    class_number,
    class_of_name,
    known_layouts,
    point_class_names,
    point_names_of,
    read_layout,
    tells_parts,
)
from .tree import Camera, Labeled, Tree
from .trees import TREES

__all__ = ["ScanFolder", "ScanFrame"]

_KITTI_LABELS = ("label_02", "label_2")  # of sets in their own tree, some of which have a folder velodyne
LABEL_FOLDERS = ("label", "label_2", "labels", "semseg", "drivable")
MARGIN_M = 0.05  # a label box is often a little smaller than its object


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
    points: Points
    boxes: tuple[Box, ...] | None
    point_classes: Bytes | None
    drivable: tuple[Floats, ...] | None
    calibration: kitti.KittiCalibration | None = None
    unlabeled: Floats | None = None
    image_labels: kitti.KittiLabels | None = None

    @cached_property
    def class_names(self) -> tuple[str, ...]:
        """Classes of `point_classes`."""
        return point_class_names(self.layout)

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
        x, y, _ = self.calibration.T_cam_velo[2, :3]  # the optical axis
        width, looks = (self.layout.image_size or kitti.IMAGE_SIZE)[0], math.atan2(y, x)
        return looks - math.atan2(width - middle, focal), looks + math.atan2(middle, focal)

    def known_at(self, places: NDArray[Any]) -> Mask:
        """Whether all objects at places (n, 3+) [m] have boxes, (n,) bool."""
        if self.boxes is None:
            return np.zeros(len(places), np.bool_)
        low, high = self.layout.labeled_deg
        with np.errstate(invalid="ignore"):
            azimuth = np.degrees(np.arctan2(places[:, 1], places[:, 0]))
            known = np.asarray((azimuth - low) % 360.0 <= high - low, np.bool_)
            known &= np.hypot(places[:, 0], places[:, 1]) <= self.layout.labeled_m
        if self.calibration is not None and self.unlabeled is not None:
            known &= self.calibration.labeled_at(places, self.unlabeled, self.layout.image_size or kitti.IMAGE_SIZE)
        return known

    def labels(self, classes: Sequence[str] = POINT_CLASSES, *, by: str | None = None) -> Bytes:
        """True class of each point, (n,) uint8: index into ``classes``, `IGNORE` where unknown.

        Parameters
        ----------
        classes : sequence of str
            As in `class_number`.
        by : {"points", "boxes"} or None
            Labels of points, or the class of the box around a point, where beside boxes is background, unknown if
            ``classes`` have parts of it. None: of points if the scan has them, else by boxes; all unknown without both.

        Raises
        ------
        PointsError
            The scan has no such labels.
        """
        if by is None and self.point_classes is None and self.boxes is None:
            return np.full(len(self.points), IGNORE, np.uint8)
        by = by or ("boxes" if self.point_classes is None else "points")
        if by == "points" and self.point_classes is not None:
            return np.array([class_number(name, classes) for name in self.class_names], np.uint8)[self.point_classes]
        if by != "boxes" or self.boxes is None:
            raise PointsError(f"scan {self.name} has no labels by {by}; expected points, or boxes, that it has")
        labels = np.where(self.known_at(self.points) & (not tells_parts(classes)), 0, IGNORE).astype(np.uint8)
        # Ignored boxes first: a box of a rider alone lies in that of the cyclist.
        for box in sorted(self.boxes, key=lambda box: box.label != IGNORED):
            labels[inside(box, self.points, MARGIN_M)] = class_number(box.label, classes)
        return labels

    def road_labels(self) -> Bytes | None:
        """Index into `datasets.ROAD_CLASSES` of each point, (n,) uint8, `IGNORE` where unknown.

        None if the points are not labeled, or no class of theirs is drivable.
        """
        if self.point_classes is None or not set(ROADS) & set(self.class_names):
            return None
        numbers = {**dict.fromkeys(ROADS, 1), **dict.fromkeys(VEHICLES, 2), IGNORED: IGNORE}
        return np.array([numbers.get(name, 0) for name in self.class_names], np.uint8)[self.point_classes]


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
        self._point_numbers: Bytes | None = None
        self._tree: Tree | None = None
        self._names_file = "semseg_classes.json"
        in_tree = not (self.root / "velodyne").is_dir() or any((self.root / name).is_dir() for name in _KITTI_LABELS)
        if self.layout.files in TREES and not in_tree:
            self.layout = replace(self.layout, files="plain")
        if self.layout.files in TREES:
            self._tree = TREES[self.layout.files](self.root)
            self._names_file = self._tree.names_file
            self.scans, self.drives = self._tree.scans, self._tree.drives
        else:
            self.scans = self._scans()
            self._annotated = read_datumaro(self.root / BOX_FILES["cvat"]) if self.layout.box_format == "cvat" else {}
            self.drives = self._drives()
        if isinstance(layout, Path) and layout == self.root / "scans.json":
            self._check_splits()

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
            some = ", ".join(map(repr, islice(self.drives, 3)))
            raise PointsError(f"{self.root} has no labeled scan {name!r}; it has {len(self.drives)}: {some}, …")
        points, labeled, numbers, drivable, camera = self._read(name) if self._tree is None else self._tree.read(name)
        path = self._path("boxes", name) or self.scans[name]
        boxes = None if labeled is None else self._checked(labeled, path)
        classes = None if numbers is None else self._classes_of(numbers, self._path("points", name) or self.scans[name])
        calibration = unlabeled = image_labels = None
        if camera is not None:
            calibration, unlabeled, rows = camera
            if rows is not None:
                kinds = [
                    k if k == "dontcare" else class_of_name(k, self.layout.boxes, path, "boxes") for k in rows.kinds
                ]
                image_labels = kitti.KittiLabels(tuple(kinds), rows.numbers)
        of_image = calibration, unlabeled, image_labels
        return ScanFrame(name, self.drives[name], self.layout, points, boxes, classes, drivable, *of_image)

    def _read(self, name: str) -> Labeled:
        """Read a scan of the plain layout."""
        points, boxes, camera = read_points(self.scans[name]), None, None
        path, classes, area = (self._path(kind, name) for kind in ("boxes", "points", "drivable"))
        if path is not None and self.layout.box_format == "kitti":
            found, unlabeled, calibration, rows = kitti.read_labeled(
                self.root, name, self.layout.image_size or kitti.IMAGE_SIZE
            )
            boxes, camera = [*found], Camera(calibration, unlabeled, rows)
        elif path is not None:
            boxes = self._read_boxes(path, name)
        numbers = None if classes is None else kitti.read_numbers(classes, len(points))
        return Labeled(points, boxes, numbers, None if area is None else _read_polygons(area), camera)

    def _path(self, kind: str, name: str) -> Path | None:
        """The label file of a scan: boxes, points or drivable; None if the scan has none."""
        boxes = BOX_FILES.get(self.layout.box_format, "label/{}.txt").format(name)
        sequence, _, stem = name.rpartition("/")
        if sequence:
            path = self.root / "sequences" / sequence / "labels" / f"{stem}.label"
            return path if kind == "points" and path.is_file() else None
        points, drivable = (f"semseg/{name}.u8", f"semseg/{name}.label"), (f"drivable/{name}.json",)
        candidates = {"boxes": (boxes,), "points": points, "drivable": drivable}[kind]
        if kind == "boxes" and self.layout.box_format == "cvat" and name not in self._annotated:
            return None
        return next((self.root / path for path in candidates if (self.root / path).is_file()), None)

    def _scans(self) -> dict[str, Path]:
        scans: dict[str, Path] = {}
        nested = self.layout.files == "semantickitti"
        for path in sorted(self.root.glob("sequences/[!.]*/velodyne/[!.]*" if nested else "velodyne/[!.]*")):
            stem, suffix = stem_of(path.name)
            if not suffix:
                raise PointsError(f"{path}: no scan by its name; expected {', '.join(SCAN_SUFFIXES)} in velodyne/")
            name = f"{path.parts[-3]}/{stem}" if nested else stem
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
        files = {name: [self._path(kind, name) for kind in ("boxes", "points", "drivable")] for name in self.scans}
        labeled = [name for name, paths in files.items() if any(paths)]
        if not labeled:
            expected = "label/NAME.txt, semseg/NAME.u8 or drivable/NAME.json (with box_format kitti: label_2/NAME.txt "
            expected += "and calib/NAME.txt)"
            if self.layout.files == "semantickitti":
                expected = "sequences/SEQ/labels/NAME.label, with the same NAMEs as in velodyne/"
            some = next(iter(self.scans))
            raise PointsError(f"{self.root} has no labels for its scans ({some}, ...); expected {expected}")
        read = {path for paths in files.values() for path in paths if path}
        places = {path.parent for path in read} | {self.root / name for name in LABEL_FOLDERS}
        if unread := {path for folder in places for path in folder.glob("[!._]*")} - read:
            told = f"{len(unread):,} label files of no scan or of another format, which are left out"
            warnings.warn(f"{self.root} has {told}, such as {min(unread).relative_to(self.root)}", stacklevel=2)
        if self.layout.files == "semantickitti":
            sequences = {name: name.partition("/")[0] for name in labeled}
            return {name: kitti.SEQUENCE_DRIVES.get(sequence, sequence) for name, sequence in sequences.items()}
        if self.layout.drives == "one":
            return dict.fromkeys(labeled, self.layout.name)
        table = self.root / "frames.csv"
        if self.layout.drives == "scan" or not table.exists():
            return {name: name for name in labeled}
        drives = {row["name"]: row["drive"] for row in kitti.read_drives(table)}
        if missing := [name for name in labeled if name not in drives]:
            listed = ", ".join(missing[:5])
            raise PointsError(f"{table} has no drive of {listed}; add a row, both filled in, for every labeled scan")
        return {name: drives[name] for name in labeled}

    def _check_splits(self) -> None:
        """A drive that ``splits`` misspells would be listed nowhere, which is for training and testing."""
        listed, drives = {d for of_split in self.layout.splits.values() for d in of_split}, {*self.drives.values()}
        absent, unlisted = sorted(listed - drives - {ANY}), sorted(drives - listed)
        if absent and unlisted and not any(ANY in self.layout.splits.get(of, ()) for of in ("validation", "test")):
            raise PointsError(
                f"{self.root}: splits lists the drive {absent[0]!r:.60}, which has no labeled scan, and not the drive "
                f"{unlisted[0]!r:.60}, which has some; correct the names (those of frames.csv; without it, of the "
                "scans), leave that one out, or keep all others back with '*' under test"
            )

    def _read_boxes(self, path: Path, name: str) -> list[Box]:
        """Boxes of a scan with the classes of its label file."""
        if self.layout.box_format == "cvat":
            return self._annotated[name]
        if self.layout.box_format == "labelcloud":
            return read_labelcloud(path)
        if self.layout.box_format == "sustechpoints":
            return read_sustechpoints(path)
        return _read_boxes(path, self.layout.box_columns)

    def _checked(self, boxes: Sequence[Box], path: Path) -> tuple[Box, ...]:
        """Boxes with the classes of the description, each once."""
        # A copy would be an object that nothing can find. Two files of Argoverse 2 have one, of a car each.
        renamed = self._renamed([*dict.fromkeys(boxes)], path)
        if huge := [box for box in renamed if box.label != IGNORED and max(box.size) >= kitti.LARGEST_M]:
            raise PointsError(f"{path}: a {huge[0].label} of {max(huge[0].size):g} m; expected less than 100 m")
        return renamed

    def _renamed(self, boxes: Sequence[Box], path: Path) -> tuple[Box, ...]:
        """Boxes with the classes of the description; boxes of background are left out."""
        renamed = (replace(box, label=class_of_name(box.label, self.layout.boxes, path, "boxes")) for box in boxes)
        return tuple(box for box in renamed if box.label != BACKGROUND)

    def _classes_of(self, raw: NDArray[Any], path: Path) -> Bytes:
        """Index into the description's classes of each point, by the numbers of a label file."""
        if self._point_numbers is None:
            self._point_numbers = self._numbers()
        numbers = np.unique(raw)
        known = numbers < len(self._point_numbers)
        known[known] = self._point_numbers[numbers[known]] != IGNORE
        if not known.all():
            raise PointsError(
                f"{path}: no name for {', '.join(map(str, numbers[~known][:5]))}; add it to {self._names_file} or, in "
                "the description, to point_names"
            )
        return self._point_numbers[raw]

    def _numbers(self) -> Bytes:
        """Raw number of a class -> index into the description's classes, `IGNORE` if it has no name."""
        names, source = self.layout.point_names, self.root / self._names_file
        if names is None and self._tree is not None:
            names = self._tree.point_names
        elif names is None:
            document = read_json(source, object, "names by number, or point_names in the description")
            names = point_names_of(document, str(source))
        classes = point_class_names(self.layout)
        numbers = np.full(max(names, default=0) + 1, IGNORE, np.uint8)
        numbers[0] = classes.index(IGNORED)  # 0 is unlabeled, unless it has a name
        for number, name in names.items():
            numbers[number] = classes.index(class_of_name(name, self.layout.points, source, "points"))
        return numbers


def _read_boxes(path: Path, columns: Sequence[str]) -> list[Box]:
    """Boxes of a label file, with the classes in it."""
    boxes: list[Box] = []
    place = {column: columns.index(column) for column in BOX_COLUMNS}
    for number, line in kitti.label_lines(path):
        values = line.split()
        try:
            x, y, z, length, width, height, yaw = (float(values[place[column]]) for column in BOX_COLUMNS[1:])
        except (IndexError, ValueError) as exc:
            raise PointsError(f"{path}, line {number}: {line[:100]!r}; expected {' '.join(columns)}") from exc
        if not all(map(math.isfinite, (x, y, z, length, width, height, yaw))) or min(length, width, height) <= 0.0:
            raise PointsError(f"{path}, line {number}: {line[:100]!r}; expected finite numbers and sizes above 0")
        if abs(yaw) > kitti.WHOLE_TURN:
            raise PointsError(f"{path}, line {number}: a yaw of {yaw:g}, as if in degrees; expected radians")
        boxes.append(Box(values[place["class"]], 1.0, (x, y, z), (length, width, height), yaw))
    return boxes


def _read_polygons(path: Path) -> tuple[Floats, ...]:
    try:
        polygons = [np.array(ring, np.float64) for ring in json.loads(path.read_text(encoding="utf-8-sig"))]
    except (OSError, RecursionError, TypeError, UnicodeDecodeError, ValueError) as exc:
        raise PointsError(f"{path}: no polygons ({exc}); expected a list of lists of corners [x, y]") from exc
    for ring in polygons:
        if ring.ndim != 2 or len(ring) < 3 or ring.shape[1] not in (2, 3) or not np.isfinite(ring).all():
            raise PointsError(
                f"{path}: a polygon of shape {ring.shape}; expected three corners [x, y] or [x, y, z] or more, finite"
            )
    return tuple(polygons)
