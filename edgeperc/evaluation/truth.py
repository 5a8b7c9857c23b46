"""Ground truth of one scan, from KITTI's or SemanticKITTI's labels, a folder of labeled scans or the simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..datasets.kitti import ROAD_CLASSES, Frame, KittiCalibration, KittiLabels, RoadFrame
from ..datasets.layout import class_number, numbers_of_scene
from ..datasets.scan_folder import ScanFrame
from ..errors import PointsError
from ..ground.observed import Observer
from ..simulation.samples import FIRST_SEED, IGNORE, labels_of_scene, simulated_scan
from ..simulation.scene import POINT_CLASS_OF, POINT_CLASSES, TOP_VIEW_CLASSES
from ..types.choices import VEHICLES
from ..types.frame import ModelFrame
from ..types.geometry import draw_footprints, inside
from ..types.mounting import Mounting
from ..types.perception import Box
from ..types.points import Bytes, Floats, Labels, Mask, Points, read_only
from ..types.views import TopViewGeometry
from .kitti_ap import FrontTruth, image_size_of

GROUND_Z_M = -1.5  # height at which a cell is looked up in the camera image

# Tables of the top view. Do not average them: each has its own ground truth.
BY_BOXES, OBSERVED, EVERY_CELL = "vehicles from 3-D boxes", "observed cells", "every cell"
Cells = dict[str, tuple[tuple[str, ...], Bytes]]


@dataclass(frozen=True)
class Truth:
    """A scan and its ground truth."""

    name: str
    drive: str
    points: Points  # x, y, z [m] in the sensor frame, remission
    labels: Labels | None  # index into ``classes``, `IGNORE` where unknown; None without labels
    boxes: tuple[Box, ...]  # in the sensor frame
    returns: tuple[int, ...]  # from each box's object
    # whether objects are labeled at places (k, 3) [m] in the sensor frame
    known: Callable[[Floats], Mask]
    cells: Cells  # by table: classes, and the true class of each cell, `IGNORE` where unknown
    road: tuple[str, str] | None = None  # a table, and its class that is drivable
    front: FrontTruth | None = None  # KITTI's labels of the image
    box_labels: frozenset[str] | None = None  # what the boxes of the set tell apart; None: all
    classes: tuple[str, ...] = POINT_CLASSES  # the background first

    def knows(self, box: Box) -> bool:
        """Whether objects are labeled at the center of a box."""
        return bool(self.known(np.array([box.center]))[0])

    @property
    def counted(self) -> list[tuple[Box, int]]:
        """Boxes, each with its returns."""
        return [*zip(self.boxes, self.returns, strict=True)]


def kitti_truth(frame: Frame, view: TopViewGeometry | None, road: tuple[str, Mask] | None = None) -> Truth:
    """Ground truth of a KITTI frame in the camera's field of view, outside DontCare; no cells without a view. ``road``:
    name and drivable cells of a second table, with the labeled vehicles (SSADNet 3.1.2).
    """
    cells: Cells = {}
    if view is not None:
        vehicles, known = _drawn(frame.boxes, view, frame.known_at)
        cells[BY_BOXES] = _by_boxes(vehicles, known)
        if road is not None:
            title, drivable = road
            surface = np.where(vehicles > 0, vehicles, drivable)
            cells[title] = TOP_VIEW_CLASSES, np.where(known, surface, IGNORE).astype(np.uint8)
    returns = tuple(int(np.count_nonzero(inside(box, frame.points, 0.1))) for box in frame.boxes)
    labels, front = frame.point_labels(), _front(frame.labels, frame.calibration, image_size_of(frame.drive))
    return Truth(
        frame.name, frame.drive, frame.points, labels, frame.boxes, returns, frame.known_at, cells, front=front
    )


def semantickitti_truth(frame: RoadFrame, view: TopViewGeometry | None) -> Truth:
    """Ground truth of a SemanticKITTI frame: cells with labeled returns."""
    cells: Cells = {} if view is None else {OBSERVED: (ROAD_CLASSES, frame.top_view(view))}
    return Truth(frame.name, frame.drive, frame.points, None, (), (), _everywhere, cells, (OBSERVED, "road"))


def folder_truth(
    frame: ScanFrame, mounting: Mounting, view: TopViewGeometry | None, classes: Sequence[str] = POINT_CLASSES
) -> Truth:
    """Ground truth of a scan of a `ScanFolder`, in the frame of the models with the mounting that the runtime used, in
    those of the classes that labels of the set tell apart: its cyclists are no mistakes where none are labeled.
    """
    model = ModelFrame(mounting)
    boxes = model.move_boxes(frame.boxes or ())
    box_labels = frozenset(frame.layout.boxes.values())
    numbers = {0, *(class_number(name, classes) for name in (*box_labels, *frame.layout.points.values()))}
    classes = tuple(name for k, name in enumerate(classes) if k in numbers)
    labels = None if frame.boxes is None and frame.point_classes is None else frame.labels(classes)

    def known(places: Floats) -> Mask:
        return frame.known_at((places[:, :3] - model.t) @ model.R)

    cells: Cells = {}
    road = None
    if view is not None:
        if frame.boxes is not None:
            cells[BY_BOXES] = _by_boxes(*_drawn(boxes, view, known), [name for name in VEHICLES if name in box_labels])
        surface = road_cells(frame, mounting, view)
        if surface is not None:
            cells[OBSERVED], road = (ROAD_CLASSES, surface), (OBSERVED, "road")
    size = frame.layout.image_size or image_size_of(frame.drive)
    points, front = model.move(frame.points), _front(frame.image_labels, frame.calibration, size)
    of_boxes = boxes, frame.returns, known
    return Truth(frame.name, frame.drive, points, labels, *of_boxes, cells, road, front, box_labels, classes=classes)


def road_cells(frame: ScanFrame, mounting: Mounting, view: TopViewGeometry) -> Bytes | None:
    """True surface of each cell of a view by the labels of points, or else polygons: index into `ROAD_CLASSES`,
    `IGNORE` where the scan did not observe it; None if the scan has no such labels.
    """
    model = ModelFrame(mounting)
    points, labels = model.move(frame.points), frame.road_labels()
    if labels is not None:
        return RoadFrame(frame.name, frame.drive, points, labels).top_view(view)
    if frame.drivable is None:
        return None
    height_m = mounting.height_m or 0.0
    polygons = []
    for ring in frame.drivable:
        corners = ring if ring.shape[1] == 3 else np.column_stack([ring, np.full(len(ring), -height_m)])
        polygons.append((corners @ model.R.T + model.t)[:, :2])
    vehicles, clear = _drawn(model.move_boxes(frame.boxes or ()), view)
    surface = np.where(vehicles > 0, 2, cells_inside(polygons, view)).astype(np.uint8)
    row, col, in_view = view.cells(points[:, 0], points[:, 1])
    in_view &= np.isfinite(points).all(axis=1)
    index = np.full(surface.shape, -1, np.int32)
    rising = np.flatnonzero(in_view)[np.argsort(points[in_view, 2], kind="stable")]
    index[row[rising], col[rising]] = rising
    sensor = frame.layout.sensor.upright(mounting)
    observed = Observer(view, sensor).observe(read_only(points), index, mounting).observed
    surface[~(observed & clear)] = IGNORE
    return surface


def cells_inside(polygons: Iterable[Floats], view: TopViewGeometry) -> Mask:
    """Cells whose center lies in a polygon (k, 2) of x, y [m], by the even-odd rule; (rows, columns) bool."""
    x, y = (centers.ravel() for centers in view.cell_centers())
    inside_any = np.zeros((len(x), len(y)), np.bool_)
    for ring in polygons:
        odd = np.zeros_like(inside_any)
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            rows = np.flatnonzero((x0 > x) != (x1 > x))  # rows that the edge crosses
            if len(rows):
                crossing = y0 + (x[rows] - x0) / (x1 - x0) * (y1 - y0)
                odd[rows] ^= y[None, :] < crossing[:, None]
        inside_any |= odd
    return inside_any


def check_different(datasets: Sequence[str | Path]) -> None:
    """Raise `PointsError` for a set that is given twice, whose scans would count twice; all simulated ones are one."""
    given: dict[str | Path, str | Path] = {}
    for dataset in datasets:
        kind = str(dataset).partition(":")[0]
        other = given.setdefault(kind if kind == "simulation" else Path(dataset).resolve(), dataset)
        if other is not dataset:
            raise PointsError(f"{other} and {dataset} have the same scans, which would count twice; leave out one")


def seeds_of(source: str) -> range:
    """The scenes of ``simulation`` or ``simulation:N``, which no model was trained on; PointsError for another N."""
    number = source.partition(":")[2] or "24"
    if not number.isdecimal() or number == "0":
        raise PointsError(f"got {source!r}; expected simulation, or simulation:N with a number of scans from 1")
    return range(FIRST_SEED, FIRST_SEED + int(number))


def simulated_truth(seed: int, view: TopViewGeometry | None, classes: tuple[str, ...] = POINT_CLASSES) -> Truth:
    """Ground truth of a simulated scene, where everything is known. Each scene counts as a drive of its own."""
    name, scan = f"scene {seed}", simulated_scan(seed)
    cells: Cells = {} if view is None else {EVERY_CELL: (TOP_VIEW_CLASSES, scan.top_view_labels(view))}
    labels, road = numbers_of_scene(classes)[labels_of_scene(scan)], (EVERY_CELL, "drivable")
    boxes = scan.boxes, scan.box_points, _everywhere
    return Truth(name, name, scan.points, labels, *boxes, cells, road, classes=classes)


def _front(
    labels: KittiLabels | None, calibration: KittiCalibration | None, size: tuple[int, int]
) -> FrontTruth | None:
    return None if labels is None or calibration is None else FrontTruth(labels, calibration, size)


def _by_boxes(vehicles: Bytes, known: Mask, told: Sequence[str] = VEHICLES) -> tuple[tuple[str, ...], Bytes]:
    classes = "background", *told
    numbers = [classes.index(name) if name in classes else 0 for name in TOP_VIEW_CLASSES]
    return classes, np.where(known, np.array(numbers)[vehicles], IGNORE).astype(np.uint8)


def _drawn(
    boxes: Sequence[Box], view: TopViewGeometry, known: Callable[[Floats], Mask] | None = None
) -> tuple[Bytes, Mask]:
    """Vehicle in each cell, index into `TOP_VIEW_CLASSES` or 0, and the known cells without an object of another class.

    Whether a cell is known is asked at its center near the ground.
    """
    vehicles, unclear = np.zeros((2, view.height, view.width), np.uint8)
    draw_footprints(vehicles, boxes, view, TOP_VIEW_CLASSES)
    # Cells of trams and "misc" objects are ignored: they belong to no class, but are not background.
    strange = [replace(box, label="car") for box in boxes if box.label not in POINT_CLASS_OF]
    draw_footprints(unclear, strange, view, TOP_VIEW_CLASSES)
    clear = unclear == 0
    if known is not None:
        x, y = np.broadcast_arrays(*view.cell_centers())
        places = np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_Z_M)], axis=1)
        clear &= known(places).reshape(clear.shape)
    return vehicles, clear


def _everywhere(places: Floats) -> Mask:
    return np.ones(len(places), np.bool_)
