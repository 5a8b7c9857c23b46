"""Ground truth of one scan, from KITTI's labels, SemanticKITTI's labels or the simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..card import TopViewGeometry
from ..geometry import draw_footprints, inside
from ..perception import Box
from ..simulation.samples import IGNORE, labels_by_boxes, simulated_scan
from ..simulation.scene import TOP_VIEW_CLASSES
from .datasets import ROAD_CLASSES, Frame, RoadFrame
from .tables import VEHICLES

__all__ = ["Truth", "kitti_truth", "semantickitti_truth", "simulated_truth"]

GROUND_Z_M = -1.5  # height at which a cell is looked up in the camera image

# Tables of the top view. Do not average them: each has its own ground truth.
BY_BOXES, OBSERVED, EVERY_CELL = "vehicles from 3-D boxes", "observed cells", "every cell"
Cells = dict[str, tuple[tuple[str, ...], NDArray[np.uint8]]]


@dataclass(frozen=True)
class Truth:
    """A scan and its ground truth.

    Attributes
    ----------
    name, drive : str
    points : (n, 4) float32
        x, y, z [m] in the sensor frame, remission.
    labels : (n,) uint8 or None
        Index into `POINT_CLASSES`, `IGNORE` where unknown; None if points and objects are not labeled.
    boxes : tuple of Box
        In the sensor frame.
    returns : tuple of int
        Number of returns from each box's object.
    known : callable
        Takes places (k, 3) [m] in the sensor frame and returns whether objects are labeled there, (k,) bool.
    cells : mapping
        By name of a table: its classes, and the true class of each cell (rows, columns) uint8, `IGNORE` where unknown.
    road : tuple of 2 str, or None
        The table, and its class that counts as drivable.
    """

    name: str
    drive: str
    points: NDArray[np.float32]
    labels: NDArray[np.uint8] | None
    boxes: tuple[Box, ...]
    returns: tuple[int, ...]
    known: Callable[[NDArray[np.float64]], NDArray[np.bool_]]
    cells: Cells
    road: tuple[str, str] | None = None


def kitti_truth(frame: Frame, view: TopViewGeometry | None, road: tuple[str, NDArray[np.bool_]] | None = None) -> Truth:
    """Ground truth of a KITTI frame: boxes, points and cells in the camera's field of view, outside DontCare.

    Parameters
    ----------
    frame : Frame
    view : TopViewGeometry or None
        Grid of the cells; None: no cells.
    road : tuple of str and (rows, columns) bool, optional
        Name and drivable cells of a second table, which combines this road with the labeled vehicles (SSADNet 3.1.2).
    """
    cells: Cells = {}
    if view is not None:
        vehicles, unclear = np.zeros((2, view.height, view.width), np.uint8)
        draw_footprints(vehicles, frame.boxes, view, TOP_VIEW_CLASSES)
        # Cells of trams and "misc" objects are ignored: they belong to no class, but are not background.
        strange = [replace(box, label="car") for box in frame.boxes if box.label in ("tram", "misc")]
        draw_footprints(unclear, strange, view, TOP_VIEW_CLASSES)
        known = frame.known_at(_cell_places(view)).reshape(vehicles.shape) & (unclear == 0)
        by_boxes = np.where(vehicles > 0, vehicles - 1, 0)
        cells[BY_BOXES] = ("background", *VEHICLES), np.where(known, by_boxes, IGNORE).astype(np.uint8)
        if road is not None:
            title, drivable = road
            surface = np.where(vehicles > 0, vehicles, drivable)
            cells[title] = TOP_VIEW_CLASSES, np.where(known, surface, IGNORE).astype(np.uint8)
    returns = tuple(int(np.count_nonzero(inside(box, frame.points, 0.1))) for box in frame.boxes)
    labels = frame.point_labels()
    return Truth(frame.name, frame.drive, frame.points, labels, frame.boxes, returns, frame.known_at, cells)


def semantickitti_truth(frame: RoadFrame, view: TopViewGeometry | None) -> Truth:
    """Ground truth of a SemanticKITTI frame: cells with labeled returns."""
    cells: Cells = {} if view is None else {OBSERVED: (ROAD_CLASSES, frame.top_view(view))}
    return Truth(frame.name, frame.drive, frame.points, None, (), (), _everywhere, cells, (OBSERVED, "road"))


def simulated_truth(seed: int, view: TopViewGeometry | None) -> Truth:
    """Ground truth of a simulated scene, where everything is known. Each scene counts as a drive of its own."""
    name, scan = f"scene {seed}", simulated_scan(seed)
    cells: Cells = {} if view is None else {EVERY_CELL: (TOP_VIEW_CLASSES, scan.top_view_labels(view))}
    labels, road = labels_by_boxes(scan), (EVERY_CELL, "drivable")
    return Truth(name, name, scan.points, labels, scan.boxes, scan.box_points, _everywhere, cells, road)


def _cell_places(view: TopViewGeometry) -> NDArray[np.float64]:
    """Centers of the cells near the ground, (rows * columns, 3) float64 [m]."""
    x, y = np.broadcast_arrays(*view.cell_centers())
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_Z_M)], axis=1)


def _everywhere(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.ones(len(places), np.bool_)
