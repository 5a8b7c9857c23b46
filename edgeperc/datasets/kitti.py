"""Readers of labeled real scans: KITTI objects and SemanticKITTI, for training and evaluation.

KITTI's object labels cover the field of view of the left color camera only. Outside it the truth is unknown.
"""

from __future__ import annotations

import csv
import hashlib
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.calibration import level_heading, read_kitti_calibration
from ..errors import PointsError
from ..readers.files import read_points
from ..simulation.samples import IGNORE
from ..simulation.scene import POINT_CLASS_OF
from ..system.names import check_file
from ..types.geometry import inside
from ..types.perception import Box
from ..types.points import Bytes, Floats, Labels, Mask, Points
from ..types.views import TopViewGeometry
from .splits import TEST_DRIVES, in_split

IMAGE_SIZE = (1242, 375)
IMAGE_SIZES = {
    "2011_09_26": IMAGE_SIZE,
    "2011_09_28": (1224, 370),
    "2011_09_29": (1238, 374),
    "2011_09_30": (1226, 370),
    "2011_10_03": (1241, 376),
}
"""Width and height of the rectified images [px], by the day of the drive."""


@dataclass(frozen=True)
class KittiCalibration:
    """Pose and projection of the left color camera."""

    T_cam_velo: Floats  # (4, 4), sensor frame to rectified camera frame
    P2: Floats  # (3, 4), rectified camera frame to the image

    @classmethod
    def read(cls, path: Path) -> KittiCalibration:
        """Read a file of `read_kitti_calibration`, whose errors this raises."""
        return cls(*read_kitti_calibration(path))

    def to_image(self, points: NDArray[Any]) -> tuple[Floats, Floats]:
        """Column and row (n, 2) [px] of points (n, 3+) in the sensor frame, not valid behind the camera; and their
        distance along the optical axis [m], negative there.
        """
        cam = np.asarray(points[:, :3], np.float64) @ self.T_cam_velo[:3, :3].T + self.T_cam_velo[:3, 3]
        image = cam @ self.P2[:, :3].T + self.P2[:, 3]
        depth = image[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return image[:, :2] / depth[:, None], depth

    def sensor_boxes(self, rows: Floats) -> Floats:
        """Boxes (n, 7) in the sensor frame (center, length, width, height, yaw) from KITTI's: height, width, length, x,
        y, z of the bottom face's center in the camera's frame [m], rotation about its y axis [rad].
        """
        T_velo_cam = np.linalg.inv(self.T_cam_velo)
        height, width, length, x, y, z, turn = rows.T
        # y points down in the camera frame.
        centers = np.stack([x, y - height / 2.0, z], axis=1) @ T_velo_cam[:3, :3].T + T_velo_cam[:3, 3]
        ahead = np.stack([np.cos(turn), np.zeros_like(turn), -np.sin(turn)], axis=1) @ T_velo_cam[:3, :3].T
        return np.column_stack([centers, length, width, height, np.arctan2(ahead[:, 1], ahead[:, 0])])

    def in_camera(self, rows: Floats) -> Floats:
        """Convert boxes (n, 7) to x ahead, y left, z up in the camera's frame: undoes `sensor_boxes`."""
        R, t = self.T_cam_velo[:3, :3], self.T_cam_velo[:3, 3]
        right, down, ahead = R @ rows[:, :3].T + t[:, None]
        heading = level_heading(R, rows[:, 6])
        return np.column_stack([ahead, -right, -down, rows[:, 3:6], np.arctan2(-heading[0], heading[2])])

    def image_rectangles(self, rows: Floats, image_size: tuple[int, int] = IMAGE_SIZE) -> Floats:
        """Left, top, right, bottom [px] of boxes (n, 7) in the sensor frame, clipped to the image; no area outside."""
        signs = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)])
        local = signs[None] * rows[:, None, 3:6]
        cos, sin = np.cos(rows[:, 6])[:, None], np.sin(rows[:, 6])[:, None]
        x = rows[:, :1] + cos * local[..., 0] - sin * local[..., 1]
        y = rows[:, 1:2] + sin * local[..., 0] + cos * local[..., 1]
        corners = np.stack([x, y, rows[:, 2:3] + local[..., 2]], axis=-1)
        pixel, depth = self.to_image(corners.reshape(-1, 3))
        pixel, depth = pixel.reshape(-1, 8, 2), depth.reshape(-1, 8)
        ahead = depth > 0.1  # a corner behind the camera has no pixel
        low = np.where(ahead[..., None], pixel, np.inf).min(axis=1).clip(0.0, image_size)
        high = np.where(ahead[..., None], pixel, -np.inf).max(axis=1).clip(0.0, image_size)
        return np.hstack([low, np.maximum(high, low)])

    def labeled_at(self, places: NDArray[Any], unlabeled: Floats, image_size: tuple[int, int] = IMAGE_SIZE) -> Mask:
        """Which places (n, 3+) in the sensor frame are in the image and in no ``unlabeled`` (k, 4) rectangle [px]."""
        pixel, depth = self.to_image(places)
        column, row = pixel.T
        labeled = (depth > 0.1) & (pixel >= 0).all(axis=1) & (column < image_size[0]) & (row < image_size[1])
        for left, top, right, bottom in unlabeled:
            labeled &= ~((column >= left) & (column <= right) & (row >= top) & (row <= bottom))
        return labeled


@dataclass(frozen=True)
class KittiLabels:
    """Rows of a KITTI label file, in its own frame."""

    kinds: tuple[str, ...]  # classes in lower case, "dontcare" among them
    numbers: Floats

    @property
    def is_object(self) -> Mask:
        return np.array([kind != "dontcare" for kind in self.kinds], np.bool_)

    @property
    def objects(self) -> tuple[list[str], Floats]:
        """Classes and numbers of the rows that are not DontCare regions."""
        return [kind for kind in self.kinds if kind != "dontcare"], self.numbers[self.is_object]


@dataclass(frozen=True)
class Frame:
    """One KITTI scan and its labels."""

    name: str
    drive: str
    grade: str  # "A" if the boxes were checked to fit the scan
    points: Points  # x, y, z [m] in the sensor frame, remission
    boxes: tuple[Box, ...]  # in the sensor frame, labels in lower case
    unlabeled: Floats  # (k, 4), DontCare: left, top, right, bottom [px] where objects are not labeled
    calibration: KittiCalibration
    labels: KittiLabels | None = None  # what ``boxes`` and ``unlabeled`` come from, if known

    @cached_property
    def known(self) -> Mask:
        """Which points have known labels, (n,) bool: those in the camera's field of view and outside DontCare."""
        return self.known_at(self.points)

    def known_at(self, points: NDArray[Any]) -> Mask:
        """Whether objects are labeled at places (n, 3+) in the sensor frame, (n,) bool."""
        return self.calibration.labeled_at(points, self.unlabeled)

    def point_labels(self) -> Bytes:
        """True class of each point, (n,) uint8: the class of the box around it, `IGNORE` where the truth is unknown."""
        labels = np.where(self.known, 0, IGNORE).astype(np.uint8)
        for box in self.boxes:
            labels[inside(box, self.points)] = POINT_CLASS_OF.get(box.label, IGNORE)
        return labels


def label_lines(path: Path) -> list[tuple[int, str]]:
    """Number and text of each line of a label file that is not blank. Raises PointsError."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as exc:
        raise PointsError(f"{path}: the labels cannot be read ({exc})") from exc
    return [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]


def read_labels(path: Path) -> KittiLabels:
    """Read the rows of a KITTI label file, copies once: nothing can find both. PointsError, which names the line."""
    return labels_of([(number, line.split()) for number, line in label_lines(path)], path)


def labels_of(lines: Iterable[tuple[int, Sequence[str]]], path: Path) -> KittiLabels:
    """The labels of one scan among the lines of a file, by their numbers: a class, and 14 values. As `read_labels`."""
    rows: dict[tuple[str, tuple[float, ...]], None] = {}
    for number, words in lines:
        try:
            values = [float(word) for word in words[1:15]]
        except ValueError as exc:
            raise PointsError(f"{path}, line {number}: {exc}; expected a class and 14 numbers") from exc
        if len(values) < 14:
            more = ", as labels of images have" if len(values) == 7 else ""
            raise PointsError(f"{path}, line {number}: expected a class and 14 finite numbers, got {len(values)}{more}")
        if wrong := wrong_in_label(words[0], values):
            raise PointsError(f"{path}, line {number}: {wrong}")
        rows[words[0].lower(), (*values,)] = None
    numbers = np.array([values for _, values in rows], np.float64).reshape(-1, 14)
    return KittiLabels(tuple(kind for kind, _ in rows), numbers)


def wrong_in_label(kind: str, numbers: Sequence[float]) -> str:
    """What is wrong with the 14 numbers of a label, as a sentence; empty if nothing is."""
    if not (np.abs(numbers) < 1e8).all():
        return "expected a class and 14 finite numbers below 1e8, got one that is not finite, or larger"
    left, top, right, bottom = numbers[3:7]
    if 0.0 <= right < left or 0.0 <= bottom < top:  # a side beyond the image may be at the other side of its edge
        return f"expected left, top, right and bottom of a rectangle, got {left:g}, {top:g}, {right:g} and {bottom:g}"
    if kind.lower() == "dontcare":
        return ""
    *size, _, _, _, turn = numbers[7:14]
    if not all(0.0 < meters < LARGEST_M for meters in size):
        return (
            f"expected a height, width and length above 0 m, got {', '.join(f'{each:g}' for each in size)}; an object "
            "without a box in 3-D is a DontCare"
        )
    return "" if abs(turn) <= WHOLE_TURN else f"expected a direction in radians, got {turn:g}, as if in degrees"


def check_in_image(labels: KittiLabels, size: tuple[int, int], path: Path) -> None:
    """Raise `PointsError` for rectangles beyond an image of this size: objects would count as not labeled there."""
    right, bottom = (float(column.max(initial=0.0)) for column in labels.numbers[:, 5:7].T)
    if right > size[0] + _BEYOND_PX or bottom > size[1] + _BEYOND_PX:
        raise PointsError(
            f"{path}: a rectangle reaches to pixel {right:g}, {bottom:g}, beyond an image of {size[0]} x {size[1]}; "
            'describe it in scans.json, with "box_format": "kitti" and the "image_size": [width, height] of its '
            "camera"
        )


LARGEST_M, WHOLE_TURN = 100.0, 6.3  # of KITTI's objects, a tram is the longest, 35 m
_BEYOND_PX = 2.0  # KITTI's images differ by the day


def label_objects(labels: KittiLabels, calibration: KittiCalibration) -> tuple[tuple[Box, ...], Floats]:
    """Boxes of labels in the sensor frame, and (k, 4) DontCare rectangles [px] (SSADNet 3.1.1)."""
    kinds, numbers = labels.objects
    placed = calibration.sensor_boxes(numbers[:, 7:14])
    boxes = tuple(
        Box(kind, 1.0, (x, y, z), (length, width, height), yaw)
        for kind, (x, y, z, length, width, height, yaw) in zip(kinds, placed.tolist(), strict=True)
    )
    return boxes, labels.numbers[~labels.is_object, 3:7]


def read_labeled(
    root: Path, name: str, image_size: tuple[int, int] = IMAGE_SIZE
) -> tuple[tuple[Box, ...], Floats, KittiCalibration, KittiLabels]:
    """`label_objects` of a scan by ``label_2`` and ``calib``, and what they come from, checked to be of that image."""
    calibration, path = KittiCalibration.read(root / "calib" / f"{name}.txt"), root / "label_2" / f"{name}.txt"
    labels = read_labels(path)
    check_in_image(labels, image_size, path)
    return *label_objects(labels, calibration), calibration, labels


def read_numbers(path: Path, n_points: int) -> NDArray[Any]:
    """Number of each point's class: uint32 in a ``.label``, with the instance above, else uint8. Raises PointsError."""
    numbers: NDArray[Any] = np.fromfile(path, np.uint8)
    if path.suffix == ".label":
        if numbers.size % 4:
            raise PointsError(f"{path}: {numbers.size} bytes are not uint32 labels; expected 4 bytes for each point")
        numbers = numbers.view("<u4") & 0xFFFF
    if len(numbers) != n_points:
        raise PointsError(
            f"{path} has {len(numbers)} labels for a scan of {n_points} points; expected one for each point"
        )
    return numbers


def scan_hash(points: Points) -> str:
    """Identify a scan in a model's card: the first 16 hexadecimal digits of the SHA-256 of its points."""
    return hashlib.sha256(points.tobytes()).hexdigest()[:16]


class KittiObjects:
    """The labeled scans below a KITTI root, by drive, as ``frames*.csv`` beside ``training`` says. A scan without a row
    is left out, as a model may know its drive; without a table, each scan is a drive. Raises PointsError.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        paths, table = sorted((self.root / "training/label_2").glob("[!.]*.txt")), _frame_rows(self.root)
        labeled = dict.fromkeys(path.stem for path in paths)
        rows = table or [{"name": name, "drive": name} for name in labeled]
        self.drives = {row["name"]: row["drive"] for row in rows}
        self.grades = {row["name"]: row.get("grade") or "A" for row in rows if row["name"] in labeled}
        self.has_table, n = bool(table), len(labeled) - len(self.grades)
        self.left_out = f"{root} has {n:,} labeled scans without a row in frames*.csv, which are left out" if n else ""
        if not self.grades:
            listed = f" of a scan in frames*.csv, such as {rows[0]['name']!r:.60}" if table else ""
            raise PointsError(f"{self.root} has no training/label_2/*.txt{listed}; expected a KITTI object set's root")

    def tell_left_out(self) -> None:
        """Warn of labeled scans without a row in the table."""
        if self.left_out:
            warnings.warn(self.left_out, stacklevel=3)

    def names(self, split: str, *, fold: int | None = None, grades: str = "A") -> list[str]:
        """Names of the labeled scans of a split (`splits.in_split`) that have one of the ``grades``."""
        of_split = [name for name in self.grades if in_split(self.drives[name], split, fold)]
        return [name for name in of_split if self.grades[name] in grades]

    def unlabeled(self, split: str, *, fold: int | None = None) -> list[str]:
        """Names of the scans of a split that have no label file."""
        names = [name for name, drive in self.drives.items() if in_split(drive, split, fold)]
        return [name for name in names if name not in self.grades and self.files(name)[0].exists()]

    def files(self, name: str) -> tuple[Path, Path]:
        """The scan of a name, and its calibration."""
        return self.root / "training/velodyne" / f"{name}.bin", self.root / "training/calib" / f"{name}.txt"

    def frame(self, name: str) -> Frame:
        """Read a labeled scan with its labels and calibration; raise `PointsError` if there is no such scan."""
        if name not in self.grades:
            raise PointsError(f"{self.root} has no labeled scan {name!r:.60}; its names are those of training/label_2")
        labeled = read_labeled(self.root / "training", name)
        return Frame(name, self.drives[name], self.grades[name], read_points(self.files(name)[0]), *labeled)


def _frame_rows(root: Path) -> list[dict[str, str]]:
    """Rows of ``frames.csv`` and ``frames-*.csv``; an empty list without a table. KITTI's kit adds _sync to drives."""
    tables = (table for table in (root / "frames.csv", *sorted(root.glob("frames-*.csv"))) if table.exists())
    rows = [row | {"drive": row["drive"].removesuffix("_sync")} for table in tables for row in read_drives(table)]
    _check_once(rows, root / "frames*.csv")
    for row in rows:
        check_file(f"{root}: a scan in frames.csv is called", row["name"], PointsError)
    return rows


def read_drives(table: Path) -> list[dict[str, str]]:
    """Rows of a table of scans, each with at least its ``name`` and its ``drive``. Raises PointsError."""
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            rows = [*csv.DictReader(file, skipinitialspace=True)]
    except (OSError, UnicodeDecodeError, csv.Error) as exc:
        raise PointsError(f"{table} cannot be read ({exc}); expected columns name and drive") from exc
    nowhere = next((row for row in rows if not (row.get("name") and row.get("drive"))), None)
    if nowhere is not None:
        raise PointsError(f"{table}: got {nowhere}; expected columns name and drive, both filled in every row")
    _check_once(rows, table)
    return rows


def _check_once(rows: Sequence[dict[str, str]], table: Path) -> None:
    """Raise `PointsError` for a scan with two rows, which would be of two drives or count twice."""
    seen: dict[str, str] = {}
    for row in rows:
        if row["name"] in seen:
            both = f"{seen[row['name']]} and {row['drive']}"
            raise PointsError(f"{table}: scan {row['name']!r:.60} has two rows, of drives {both:.80}; expected one")
        seen[row["name"]] = row["drive"]


def layouts(root: Path | str) -> Iterator[tuple[Box, ...]]:
    """Yield the boxes of each scan in the table of KITTI's labels, but for test drives; PointsError without one."""
    root = Path(root)
    names = [row["name"] for row in _frame_rows(root) if row["drive"] not in TEST_DRIVES]
    if not (names and (root / "label_2").is_dir()):
        raise PointsError(f"{root} lacks label_2, or frames.csv with drives to train on; expected KITTI's, with calib")
    for name in names:
        yield read_labeled(root, name)[0]


ROAD_CLASSES = ("other", "road", "vehicle")

# Raw ids of SemanticKITTI: road and lane marking; car, bus, truck and other vehicle, standing and moving; all others.
ROAD_IDS = (40, 60)
VEHICLE_IDS = (10, 13, 18, 20, 252, 257, 258, 259)
_OTHER_IDS = (0, 1, 11, 15, 16, 30, 31, 32, 44, 48, 49, 50, 51, 52, 70, 71, 72, 80, 81, 99, 253, 254, 255, 256)

# Raw drive of each odometry sequence with labels.
SEQUENCE_DRIVES = {
    "00": "2011_10_03_drive_0027",
    "01": "2011_10_03_drive_0042",
    "02": "2011_10_03_drive_0034",
    "03": "2011_09_26_drive_0067",
    "04": "2011_09_30_drive_0016",
    "05": "2011_09_30_drive_0018",
    "06": "2011_09_30_drive_0020",
    "07": "2011_09_30_drive_0027",
    "08": "2011_09_30_drive_0028",
    "09": "2011_09_30_drive_0033",
    "10": "2011_09_30_drive_0034",
}

# Raw drive of each tracking sequence, of those whose number of frames tells it.
TRACKING_DRIVES = {
    "0000": "2011_09_26_drive_0005",
    "0001": "2011_09_26_drive_0009",
    "0002": "2011_09_26_drive_0011",
    "0003": "2011_09_26_drive_0013",
    "0004": "2011_09_26_drive_0014",
    "0005": "2011_09_26_drive_0015",
    "0006": "2011_09_26_drive_0018",
    "0007": "2011_09_26_drive_0022",
    "0008": "2011_09_26_drive_0032",
    "0009": "2011_09_26_drive_0036",
    "0010": "2011_09_26_drive_0056",
    "0011": "2011_09_26_drive_0059",
    "0012": "2011_09_26_drive_0060",
    "0013": "2011_09_26_drive_0091",
    "0018": "2011_09_29_drive_0004",
    "0019": "2011_09_29_drive_0071",
    "0020": "2011_10_03_drive_0047",
}


@dataclass(frozen=True)
class RoadFrame:
    """One SemanticKITTI scan with labels of road and vehicles."""

    name: str
    drive: str
    points: Points  # x, y, z [m] in the sensor frame, remission
    labels: Labels  # index into `ROAD_CLASSES`, `IGNORE` for unlabeled points

    def top_view(self, geometry: TopViewGeometry) -> Bytes:
        """Index into `ROAD_CLASSES` of each cell: that of most of its labeled returns, `IGNORE` without one."""
        p, known = self.points, self.labels != IGNORE
        row, col, in_view = geometry.cells(p[:, 0], p[:, 1])
        known &= in_view
        known &= (p[:, 2] >= geometry.z_range_m[0]) & (p[:, 2] <= geometry.z_range_m[1])
        cell = row[known] * geometry.width + col[known]
        size = geometry.height * geometry.width
        counts = [np.bincount(cell, weights=self.labels[known] == k, minlength=size) for k in range(len(ROAD_CLASSES))]
        total = np.sum(counts, axis=0)
        truth = np.where(total == 0, IGNORE, 0).astype(np.uint8)
        for k in (1, 2):
            truth[2 * counts[k] > total] = k
        return truth.reshape(geometry.height, geometry.width)


class SemanticKitti:
    """The scans with point labels below a SemanticKITTI root (``sequences/00``), by drive. Raises PointsError."""

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        files = sorted(self.root.glob("sequences/[!.]*/labels/[!.]*.label"))
        if not files:
            raise PointsError(
                f"{self.root} has no sequences/*/labels/*.label; expected the root of a SemanticKITTI set"
            )
        self.drives = {
            f"{path.parts[-3]}/{path.stem}": SEQUENCE_DRIVES.get(path.parts[-3], path.parts[-3]) for path in files
        }

    def names(self, split: str, *, fold: int | None = None) -> list[str]:
        """Names of the scans of a split (`splits.in_split`), such as ``"00/000123"``."""
        return [name for name, drive in self.drives.items() if in_split(drive, split, fold)]

    def files(self, name: str) -> tuple[Path, Path]:
        """The scan of a name, and its labels."""
        sequence, stem = name.split("/")
        folder = self.root / "sequences" / sequence
        return folder / "velodyne" / f"{stem}.bin", folder / "labels" / f"{stem}.label"

    def frame(self, name: str) -> RoadFrame:
        """Read one scan and its labels; raise `PointsError` if their numbers differ, or a label is unknown."""
        scan, labels_of = self.files(name)
        points = read_points(scan)
        raw = read_numbers(labels_of, len(points))
        if unknown := np.setdiff1d(raw, [*ROAD_IDS, *VEHICLE_IDS, *_OTHER_IDS]).tolist():
            raise PointsError(
                f"{labels_of}: no class for {', '.join(map(str, unknown[:5]))}; expected SemanticKITTI's raw numbers "
                "(10: car, 40: road), not those of training; of a set with its own, pass FOLDER:DESCRIPTION.json"
            )
        labels = np.where(np.isin(raw, ROAD_IDS), 1, np.where(np.isin(raw, VEHICLE_IDS), 2, 0))
        return RoadFrame(name, self.drives[name], points, np.where(raw == 0, IGNORE, labels).astype(np.uint8))
