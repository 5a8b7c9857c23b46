"""Real scans with 3-D boxes in KITTI's layout, and the truth that SSADNet and PointSeg are trained on.

Labels cover the left colour camera's field of view only: outside it, truth is unknown, not background.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgeperc.card import TopViewGeometry
from edgeperc.errors import PointsError
from edgeperc.perception import Box
from edgeperc.points import read_points

IGNORE = 255
# PointSeg's car holds every vehicle with a box; pedestrians sit down too.
POINT_CLASS_OF = {"car": 1, "van": 1, "truck": 1, "pedestrian": 2, "person_sitting": 2, "cyclist": 3}
IMAGE_SIZE = (1242, 375)

# Validation drives: 21 checked frames of three drives, with cars, vans, trucks, pedestrians and cyclists; and all of
# SemanticKITTI at hand (2011_10_03_drive_0027). Neither their scans nor their layouts are ever trained on.
VALIDATION_DRIVES = ("2011_09_26_drive_0011", "2011_09_26_drive_0015", "2011_09_26_drive_0032", "2011_10_03_drive_0027")


@dataclass(frozen=True)
class Calibration:
    """Where the camera is, and how it sees.

    Attributes
    ----------
    T_cam_velo : (4, 4) float64
        Sensor frame to rectified camera frame.
    P2 : (3, 4) float64
        Rectified camera frame to the left colour image.
    """

    T_cam_velo: NDArray[np.float64]
    P2: NDArray[np.float64]

    @classmethod
    def read(cls, path: Path) -> Calibration:
        """Read a KITTI object or tracking calibration file."""
        values = {}
        for line in path.read_text().splitlines():
            key, _, numbers = line.replace(":", " ", 1).partition(" ")
            if numbers.strip():
                values[key] = np.array([float(v) for v in numbers.split()])
        rectify, from_velo = np.eye(4), np.eye(4)
        try:
            rectify[:3, :3] = values.get("R0_rect", values.get("R_rect")).reshape(3, 3)
            from_velo[:3] = values.get("Tr_velo_to_cam", values.get("Tr_velo_cam")).reshape(3, 4)
            return cls(rectify @ from_velo, values["P2"].reshape(3, 4))
        except (AttributeError, KeyError, ValueError) as exc:
            raise PointsError(f"{path} holds no KITTI calibration; expected P2, R0_rect and Tr_velo_to_cam") from exc

    def to_image(self, points: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels (n, 2) and depth (n,) [m] of points (n, 3+) in the sensor frame."""
        cam = np.asarray(points[:, :3], np.float64) @ self.T_cam_velo[:3, :3].T + self.T_cam_velo[:3, 3]
        image = cam @ self.P2[:, :3].T + self.P2[:, 3]
        depth = image[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return image[:, :2] / depth[:, None], depth

    def in_image(self, points: NDArray) -> NDArray[np.bool_]:
        """Which points the camera sees, (n,) bool."""
        pixel, depth = self.to_image(points)
        return (depth > 0.1) & (pixel >= 0).all(axis=1) & (pixel[:, 0] < IMAGE_SIZE[0]) & (pixel[:, 1] < IMAGE_SIZE[1])


@dataclass(frozen=True)
class Frame:
    """One scan with everything labelled in it.

    Attributes
    ----------
    name, drive : str
    grade : str
        ``"A"`` where the boxes were checked to fit the scan.
    points : (n, 4) float32
    boxes : tuple of Box
        In the sensor frame, labels in lower case (car, van, truck, pedestrian, person_sitting, cyclist, tram, misc).
    unlabelled : (k, 4) float64
        Image rectangles (left, top, right, bottom) whose objects nobody labelled (DontCare).
    calibration : Calibration
    """

    name: str
    drive: str
    grade: str
    points: NDArray[np.float32]
    boxes: tuple[Box, ...]
    unlabelled: NDArray[np.float64]
    calibration: Calibration

    @cached_property
    def judged(self) -> NDArray[np.bool_]:
        """Points whose truth is known, (n,) bool: seen by the camera, outside DontCare."""
        return self.judges(self.points)

    def judges(self, points: NDArray) -> NDArray[np.bool_]:
        """Whether truth is known at each of these places (n, 3+), sensor frame."""
        known = self.calibration.in_image(points)
        pixel, _ = self.calibration.to_image(points)
        for left, top, right, bottom in self.unlabelled:
            known &= ~((pixel[:, 0] >= left) & (pixel[:, 0] <= right) & (pixel[:, 1] >= top) & (pixel[:, 1] <= bottom))
        return known

    def point_labels(self) -> NDArray[np.uint8]:
        """PointSeg's truth, (n,) uint8: a point in a box has the box's class, `IGNORE` where nobody labelled."""
        labels = np.where(self.judged, 0, IGNORE).astype(np.uint8)
        for box in self.boxes:
            labels[inside(box, self.points)] = POINT_CLASS_OF.get(box.label, IGNORE)
        return labels


def read_objects(label_path: Path, calibration: Calibration) -> tuple[tuple[Box, ...], NDArray[np.float64]]:
    """Boxes of a KITTI label file in the sensor frame, and its DontCare rectangles (SSADNet 3.1.1)."""
    boxes, unlabelled = [], []
    T_velo_cam = np.linalg.inv(calibration.T_cam_velo)
    for line in label_path.read_text().splitlines():
        values = line.split()
        if not values:
            continue
        kind, numbers = values[0], [float(v) for v in values[1:15]]
        if kind == "DontCare":
            unlabelled.append(numbers[3:7])
            continue
        height, width, length, x, y, z, turn = numbers[7:14]
        # KITTI gives the middle of the bottom face; y points down in the camera frame.
        center = T_velo_cam[:3, :3] @ np.array([x, y - height / 2.0, z]) + T_velo_cam[:3, 3]
        heading = T_velo_cam[:3, :3] @ np.array([np.cos(turn), 0.0, -np.sin(turn)])
        boxes.append(
            Box(
                label=kind.lower(),
                score=1.0,
                center=(float(center[0]), float(center[1]), float(center[2])),
                size=(length, width, height),
                yaw=float(np.arctan2(heading[1], heading[0])),
            )
        )
    return tuple(boxes), np.array(unlabelled, np.float64).reshape(-1, 4)


def inside(box: Box, points: NDArray, margin_m: float = 0.0) -> NDArray[np.bool_]:
    """Points (n, 3+) within a box grown by a margin, (n,) bool."""
    offset = points[:, :3] - np.asarray(box.center, np.float32)
    cos, sin = np.cos(box.yaw), np.sin(box.yaw)
    along = offset[:, 0] * cos + offset[:, 1] * sin
    across = offset[:, 1] * cos - offset[:, 0] * sin
    half = np.asarray(box.size) / 2.0 + margin_m
    return (np.abs(along) <= half[0]) & (np.abs(across) <= half[1]) & (np.abs(offset[:, 2]) <= half[2])


class KittiObjects:
    """The labelled scans below a KITTI root (``training/velodyne``, ``label_2``, ``calib``), by drive.

    A ``frames.csv`` beside ``training`` says which drive each scan is of (columns ``name``, ``drive`` and, where there
    are any, ``grade``, ``crop``); without one, each scan counts as a drive of its own and nothing is held back.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        table = self.root / "frames.csv"
        if table.exists():
            with table.open(newline="") as file:
                rows = list(csv.DictReader(file))
        else:
            rows = [{"name": p.stem, "drive": p.stem} for p in sorted((self.root / "training/label_2").glob("*.txt"))]
        self.rows = [r for r in rows if (self.root / "training/label_2" / f"{r['name']}.txt").exists()]
        if not self.rows:
            raise PointsError(f"{self.root} holds no training/label_2/*.txt; expected the root of a KITTI object set")

    def names(self, split: str, grades: str = "AB", crops: bool = True) -> list[str]:
        """Names of the ``"train"``, ``"validation"`` or ``"all"`` frames; drives are never shared between splits."""
        if split not in ("train", "validation", "all"):
            raise ValueError(f"split is {split!r}; expected train, validation or all")
        return [
            r["name"]
            for r in self.rows
            if (split == "all" or (r["drive"] in VALIDATION_DRIVES) == (split == "validation"))
            and r.get("grade", "A") in grades
            and (crops or r.get("crop", "0") == "0")
        ]

    def frame(self, name: str) -> Frame:
        """Read one frame whole."""
        row = next(r for r in self.rows if r["name"] == name)
        calibration = Calibration.read(self.root / "training/calib" / f"{name}.txt")
        boxes, unlabelled = read_objects(self.root / "training/label_2" / f"{name}.txt", calibration)
        points = read_points(self.root / "training/velodyne" / f"{name}.bin")
        return Frame(name, row["drive"], row.get("grade", "A"), points, boxes, unlabelled, calibration)


def layouts(root: Path | str) -> Iterator[tuple[Box, ...]]:
    """Boxes of every KITTI label file below ``root`` that is of no validation drive: real scenes to simulate."""
    root = Path(root)
    with (root / "frames.csv").open(newline="") as file:
        names = [r["name"] for r in csv.DictReader(file) if r["drive"] not in VALIDATION_DRIVES]
    for name in names:
        calibration = Calibration.read(root / "calib" / f"{name}.txt")
        yield read_objects(root / "label_2" / f"{name}.txt", calibration)[0]


@dataclass(frozen=True)
class RoadFrame:
    """A SemanticKITTI scan whose road is known (validation only).

    Attributes
    ----------
    points : (n, 4) float32
    road : (n,) uint8
        1 on road (raw ids 40 road, 60 lane marking), 0 elsewhere, `IGNORE` where unlabelled.
    """

    name: str
    points: NDArray[np.float32]
    road: NDArray[np.uint8]

    def top_view(self, geometry: TopViewGeometry) -> NDArray[np.uint8]:
        """Road truth of the observed cells, (rows, cols) uint8: 1 where most labelled returns of a cell are road.

        `IGNORE` where no labelled return fell: what the sensor did not see, nobody can call right or wrong.
        """
        p, known = self.points, self.road != IGNORE
        row = np.floor((geometry.x_range_m[1] - p[:, 0]) / geometry.cell_m).astype(np.int64)
        col = np.floor((geometry.y_range_m[1] - p[:, 1]) / geometry.cell_m).astype(np.int64)
        known &= (row >= 0) & (row < geometry.height) & (col >= 0) & (col < geometry.width)
        known &= (p[:, 2] >= geometry.z_range_m[0]) & (p[:, 2] <= geometry.z_range_m[1])
        cell = row[known] * geometry.width + col[known]
        size = geometry.height * geometry.width
        total = np.bincount(cell, minlength=size)
        road = np.bincount(cell, weights=self.road[known] == 1, minlength=size)
        truth = np.where(total == 0, IGNORE, 2 * road > total).astype(np.uint8)
        return truth.reshape(geometry.height, geometry.width)


def road_frames(root: Path | str) -> Iterator[RoadFrame]:
    """Every SemanticKITTI scan with point labels below ``root/sequences``."""
    for path in sorted(Path(root).glob("sequences/*/velodyne/*.bin")):
        raw = np.fromfile(path.parents[1] / "labels" / f"{path.stem}.label", np.uint32) & 0xFFFF
        road = np.where(raw == 0, IGNORE, np.isin(raw, (40, 60))).astype(np.uint8)
        yield RoadFrame(f"{path.parents[1].name}/{path.stem}", read_points(path), road)
