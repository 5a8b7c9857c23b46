"""Labeled scans, and turning and mirroring them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc.datasets.kitti import Frame
from edgeperc.simulation.samples import IGNORE, labels_of_scene
from edgeperc.simulation.scene import TOP_VIEW_CLASSES, SimulatedScan
from edgeperc.system.atomic import open_atomic
from edgeperc.types.geometry import draw_footprints, inside
from edgeperc.types.perception import Box
from edgeperc.types.points import Bytes, Floats32, Labels, Mask, Points
from edgeperc.types.sensor import SENSORS, SensorProfile
from edgeperc.types.views import TopViewGeometry

# Wider and coarser than the network's view, so that a turned scan has ground truth everywhere in the view.
SURFACE = TopViewGeometry(x_range_m=(-50.0, 50.0), y_range_m=(-50.0, 50.0), cell_m=0.2)
TRAINING_SENSOR = SENSORS["hdl-64e"]
CAMERA_AZIMUTHS = (-0.70, 0.69)  # KITTI's left color camera sees 41.2 degrees to the right and 40.2 to the left


@dataclass(frozen=True)
class LabeledScan:
    """A scan and its ground truth."""

    points: Points  # (n, 4) x, y, z [m] in the frame of the models, remission in 0..1
    # (n,) the network's classes (PointSeg's, unless others are asked for), `IGNORE` where unknown
    labels: Labels
    boxes: tuple[Box, ...]
    counts: tuple[int, ...]  # number of returns from each box
    # (500, 500) 0 background, 1 drivable, `IGNORE` unknown, over `SURFACE`, as it was before ``turn`` and ``mirrored``
    surface: Bytes
    # smallest and largest azimuth of the labeled sector [rad], counterclockwise from +x
    azimuths: tuple[float, float] = (-np.pi, np.pi)
    turn: float = 0.0  # angle by which the points were turned about +z [rad]
    mirrored: bool = False  # whether left and right were swapped after that turn
    sensor: SensorProfile | None = None  # the sensor of the scan; None: the one that the models are trained for
    boxes_known: bool = True  # whether the objects in the labeled sector have boxes; False if only points are labeled

    @classmethod
    def from_frame(cls, frame: Frame, road: Callable[[Floats32], Bytes] | None = None) -> LabeledScan:
        """A KITTI frame; ``road`` computes its surface from the points. Without it the surface is unknown."""
        points = frame.points[np.isfinite(frame.points).all(axis=1)]
        frame = replace(frame, points=points)
        surface = np.full((SURFACE.height, SURFACE.width), IGNORE, np.uint8) if road is None else road(points)
        counts = tuple(int(np.count_nonzero(inside(box, points, 0.1))) for box in frame.boxes)
        return cls(points, frame.point_labels(), frame.boxes, counts, surface, CAMERA_AZIMUTHS)

    @classmethod
    def unlabeled(cls, points: Points) -> LabeledScan:
        """A scan of the training sensor of which nothing is known."""
        unknown = np.full((SURFACE.height, SURFACE.width), IGNORE, np.uint8)
        return cls(points, np.full(len(points), IGNORE, np.uint8), (), (), unknown)

    @classmethod
    def from_simulation(cls, scan: SimulatedScan) -> LabeledScan:
        """A simulated scan; everything is labeled, by `SCENE_CLASSES`."""
        surface = scan.top_view_labels(SURFACE)
        surface = np.where(surface == 1, 1, np.where(surface >= 2, IGNORE, 0)).astype(np.uint8)
        return cls(scan.points, labels_of_scene(scan), scan.boxes, scan.box_points, surface)

    def save(self, path: Path, place: str = "") -> None:
        """Write an .npz file, without pickles; ``place`` says where a simulated scan was taken."""
        boxes = np.array([[*b.center, *b.size, b.yaw] for b in self.boxes], np.float32).reshape(-1, 7)
        names = np.array([b.label for b in self.boxes], dtype="U32")
        with open_atomic(path) as file:
            np.savez(
                file,
                points=self.points,
                labels=self.labels,
                boxes=boxes,
                names=names,
                counts=np.array(self.counts, np.int64),
                surface=self.surface,
                azimuths=np.array(self.azimuths),
                sensor=np.array("" if self.sensor is None else self.sensor.to_json()),
                boxes_known=np.array(self.boxes_known),
                place=np.array(place),
            )

    @classmethod
    def load(cls, path: Path) -> LabeledScan:
        """Read a file written by `save`."""
        with opened(path) as data:
            numbers = zip(data["names"], data["boxes"].tolist(), strict=True)
            boxes = tuple(
                Box(str(name), 1.0, (x, y, z), (length, width, height), yaw)
                for name, (x, y, z, length, width, height, yaw) in numbers
            )
            low, high = (float(a) for a in data["azimuths"])
            profile = str(data["sensor"]) if "sensor" in data else ""  # files of earlier versions have none
            return cls(
                data["points"],
                data["labels"],
                boxes,
                tuple(map(int, data["counts"])),
                data["surface"],
                (low, high),
                sensor=SensorProfile.from_json(profile) if profile else None,
                boxes_known=bool(data["boxes_known"]) if "boxes_known" in data else True,
            )

    def labeled(self, geometry: TopViewGeometry) -> Mask:
        """Whether each cell is in the labeled sector, (rows, cols) bool."""
        x, y = geometry.cell_centers()
        low, high = self.azimuths  # of a scan that was turned, or looks back, beyond half a turn
        return np.asarray((np.arctan2(y, x) - low) % (2.0 * np.pi) <= high - low, np.bool_)

    def boxed(self, geometry: TopViewGeometry) -> Mask:
        """Whether all objects of each cell have boxes, (rows, cols) bool."""
        return self.labeled(geometry) & self.boxes_known

    def top_view_truth(self, geometry: TopViewGeometry) -> Bytes:
        """SSADNet's segmentation truth (3.1.2), (rows, cols) uint8: the surface with the vehicles drawn over it;
        `IGNORE` where it is unknown.
        """
        x, y = geometry.cell_centers()
        if self.mirrored:
            y = -y
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        row, col, covered = SURFACE.cells(cos * x + sin * y, cos * y - sin * x)
        truth = np.where(covered, self.surface[row % SURFACE.height, col % SURFACE.width], IGNORE).astype(np.uint8)
        draw_footprints(truth, self.boxes, geometry, TOP_VIEW_CLASSES)
        truth[~self.labeled(geometry)] = IGNORE
        return truth


@contextmanager
def opened(path: Path) -> Iterator[Mapping[str, Any]]:
    """Arrays of a file that `LabeledScan.save` wrote. Raises ValueError."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            yield data
    except Exception as exc:  # of numpy, zipfile and zlib
        raise ValueError(f"{path} is damaged or no simulated scan ({exc}); delete it, and simulate again") from exc


def turned(scan: LabeledScan, angle: float) -> LabeledScan:
    """The scan turned by ``angle`` [rad] about +z."""
    boxes = tuple(turned_box(b, angle) for b in scan.boxes)
    low, high = scan.azimuths
    full = high - low >= 2.0 * np.pi
    azimuths = (low, high) if full else (low + angle, high + angle)
    points = turned_points(scan.points, angle)
    return replace(scan, points=points, boxes=boxes, azimuths=azimuths, turn=scan.turn + angle)


def turned_points(points: Points, angle: float) -> Floats32:
    """The points turned by ``angle`` [rad] about +z."""
    cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    moved = points.copy()
    moved[:, 0], moved[:, 1] = cos * points[:, 0] - sin * points[:, 1], sin * points[:, 0] + cos * points[:, 1]
    return moved


def mirrored(scan: LabeledScan) -> LabeledScan:
    """The scan with left and right swapped."""
    points = scan.points * np.array([1, -1, 1, 1], np.float32)
    boxes = tuple(replace(b, center=(b.center[0], -b.center[1], b.center[2]), yaw=-b.yaw) for b in scan.boxes)
    low, high = scan.azimuths
    return replace(scan, points=points, boxes=boxes, azimuths=(-high, -low), mirrored=not scan.mirrored)


def turned_box(box: Box, angle: float) -> Box:
    """The box turned by ``angle`` [rad] about the sensor's z axis."""
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    x, y, z = box.center
    return replace(box, center=(cos * x - sin * y, sin * x + cos * y, z), yaw=box.yaw + float(angle))
