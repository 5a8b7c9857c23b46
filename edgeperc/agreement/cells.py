"""Make the cells of a top view agree with boxes and points: the last part of `edgeperc.agreement.rules`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from ..ground.scan import Scan
from ..system.kernels import njit
from ..types.geometry import cell_at, draw_footprints
from ..types.perception import Box, PointLabels, TopView
from ..types.points import Bytes, Cloud, Ints64, Labeled, Mask
from .rules import RULES, cells_of, roles_of
from .votes import VEHICLE, Cells

OBSTACLE_M = (0.3, 2.0)  # heights of returns that block a cell
_NO_BOX = _NO_CLASS = 255


def agree_on_cells(
    view: TopView,
    labels: PointLabels | None,
    boxes: Sequence[Box],
    dropped: Sequence[Box],
    marks: Bytes,
    rules: Collection[str] = RULES,
) -> TopView:
    """Correct the cells of a top view by boxes, points and obstacles (docs/concepts/agreement.md).

    dropped : boxes of the top-view network that `agree_on_boxes` dropped; their vehicle cells become background.
    """
    of_road, of_vehicles = "road" in rules, "cells" in rules and labels is not None
    if not (of_road or of_vehicles):
        return view
    drivable = view.classes.index("drivable") if of_road and "drivable" in view.classes else _NO_CLASS
    is_vehicle = cells_of(view).is_vehicle
    cells = view.labels.copy()
    covered = _footprints(view, boxes)
    marked = np.flatnonzero(marks != 0)  # flatnonzero of a bool array is five times as fast as of uint8
    clear_cells(marks, marked, drivable, is_vehicle & of_vehicles, covered != _NO_BOX, cells)
    covered, flat = covered.reshape(-1), cells.reshape(-1)
    below = np.flatnonzero(covered != _NO_BOX)
    below = below[flat[below] == drivable]
    flat[below] = np.where(covered[below] < len(view.classes), covered[below], 0)
    if dropped and of_road:
        freed = np.flatnonzero((_footprints(view, dropped).reshape(-1) != _NO_BOX) & (covered == _NO_BOX))
        flat[freed[is_vehicle[flat[freed]]]] = 0
    return replace(view, labels=cells)


def mark_cells(view: TopView, scan: Scan, labels: PointLabels | None, rules: Collection[str] = RULES) -> Bytes:
    """What the points show in each cell of a top view, in bits: 1 with an obstacle, 2 with a second one or an object, 4
    with a vehicle's point, 8 with another point in view in a vehicle's cell.
    """
    if labels is None:
        nothing = np.zeros(len(scan.points), np.uint8)
        in_view, labeled = nothing.view(np.bool_), Labeled(nothing, np.zeros(1, np.uint8))
    else:
        in_view, labeled = labels.in_view, Labeled(labels.labels, roles_of(labels.classes))
    cells = cells_of(view)
    marks = np.zeros(cells.labels.shape, np.uint8)
    counted = cells._replace(is_vehicle=cells.is_vehicle & ("cells" in rules and labels is not None))
    fill_marks(scan.cloud, in_view, labeled, scan.ground.plane is not None, counted, marks)
    return marks


def _footprints(view: TopView, boxes: Sequence[Box]) -> Bytes:
    """Class of the box over each cell; beyond those of the view if it has no such class; `_NO_BOX` without a box."""
    names = (*view.classes, *sorted({box.label for box in boxes} - {*view.classes}))
    drawn = np.full(view.labels.shape, _NO_BOX, np.uint8)
    draw_footprints(drawn, boxes, view.geometry, names)
    return drawn


@njit(cache=True, nogil=True)
def fill_marks(cloud: Cloud, in_view: Mask, labeled: Labeled, by_height: bool, view: Cells, marks: Bytes) -> None:
    """Write what the points show in each cell into ``marks``, zeros before, by roles 1 (vehicles) and 2 (persons)."""
    points, height, labels, roles = cloud.points, cloud.height, labeled.labels, labeled.roles
    cells, is_vehicle, grid = view.labels, view.is_vehicle, view.grid
    n_rows, n_cols = cells.shape
    lowest, highest = OBSTACLE_M
    least_x, least_y = grid.far - (n_rows + 1) * grid.cell, grid.left - (n_cols + 1) * grid.cell
    most_x, most_y = grid.far + grid.cell, grid.left + grid.cell
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        if not ((x >= least_x) & (x <= most_x) & (y >= least_y) & (y <= most_y)):  # saves divisions for most points
            continue
        r, c = cell_at(grid, cells.shape, np.float64(x), np.float64(y))
        if r < 0:
            continue
        role = roles[labels[i]]
        if role != 0:
            marks[r, c] |= 6 if role == VEHICLE else 2
        elif by_height and (height[i] >= lowest) & (height[i] <= highest):
            marks[r, c] |= 2 if marks[r, c] & 1 else 1
        if role != VEHICLE and is_vehicle[cells[r, c]] and in_view[i]:
            marks[r, c] |= 8


@njit(cache=True, nogil=True)
def clear_cells(marks: Bytes, marked: Ints64, drivable: int, is_vehicle: Mask, in_box: Mask, cells: Bytes) -> None:
    """Make background of drivable cells with objects or obstacles, and of vehicle cells that the points contradict,
    unless ``in_box``; only the flat numbers ``marked`` have marks.
    """
    n_rows, n_cols = cells.shape
    for at in marked:
        row, col = at // n_cols, at % n_cols
        own = marks[row, col]
        is_road = cells[row, col] == drivable and own & 3 != 0
        is_doubted = is_vehicle[cells[row, col]] and own & 12 == 8 and not in_box[row, col]
        if not (is_road or is_doubted):
            continue
        n, votes = 0, 0
        for r in range(max(row - 1, 0), min(row + 2, n_rows)):
            for c in range(max(col - 1, 0), min(col + 2, n_cols)):
                n += min(marks[r, c] & 3, 2)
                votes |= marks[r, c] & 4
        if (is_road and n >= 2) or (is_doubted and votes == 0):
            cells[row, col] = 0
