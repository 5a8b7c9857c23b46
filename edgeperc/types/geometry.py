"""Rectangles on the ground: overlap, suppression, drawing, points inside.

A rectangle is a row ``x, y, length, width, yaw``: center [m], extent along and across the heading [m], heading about
+z from +x [rad].
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import OptionError, PointsError
from ..system.kernels import njit
from .perception import Box
from .points import Floats, Ints64, Labels, Mask, Records, read_only
from .views import TopViewGeometry

# A box as kernels take it.
BOX = np.dtype(
    [
        ("x", np.float64),  # of the middle [m]
        ("y", np.float64),
        ("half_length", np.float64),  # [m]
        ("half_width", np.float64),
        ("cos", np.float64),  # of the yaw
        ("sin", np.float64),
        ("top", np.float64),  # greatest height of its points above the ground [m]
        ("score", np.float64),
        ("label", np.int64),  # of its cells or points
    ]
)


class Grid(NamedTuple):
    """The cells of a top view as kernels take them."""

    # x of the far edge and y of the left edge [m]
    far: float
    left: float
    cell: float  # edge of a cell [m]


Angle = TypeVar("Angle", float, Floats)


def wrapped(angle: Angle) -> Angle:
    """Wrap an angle, or each of an array, to -pi..pi [rad]."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def draw_footprints(labels: Labels, boxes: Iterable[Box], view: TopViewGeometry, classes: Sequence[str]) -> None:
    """Draw the footprints of boxes of the classes over top-view labels, in place (SSADNet 3.1.2).

    A cell belongs to a box if its center lies in the footprint; the nearer of two boxes wins.
    """
    number = {name: k for k, name in enumerate(classes)}
    known = [box for box in boxes if box.label in number]
    known.sort(key=lambda box: -math.hypot(box.center[0], box.center[1]))
    drawn = np.require(labels, np.uint8, ["C", "W"])
    fill_footprints(box_records(known, [number[box.label] for box in known]), grid_of(view), drawn)
    if drawn is not labels:
        labels[:] = drawn


def footprints(boxes: Sequence[Box], view: TopViewGeometry) -> Mask:
    """Cells, (rows, columns) bool, with their centers in the footprint of a box. OptionError without one."""
    for box in boxes:
        if not (min(box.size[:2]) > 0.0 and math.isfinite(math.hypot(*box.center[:2], *box.size[:2], box.yaw))):
            raise OptionError(f"got {box}; expected finite numbers, and a length and a width: drop such boxes first")
    drawn = np.zeros((view.height, view.width), np.uint8)
    fill_footprints(box_records(boxes, [1] * len(boxes)), grid_of(view), drawn)
    return drawn.view(np.bool_)


def grid_of(view: TopViewGeometry) -> Grid:
    """The cells of a top view as kernels take them."""
    return Grid(float(view.x_range_m[1]), float(view.y_range_m[1]), float(view.cell_m))


def box_records(boxes: Sequence[Box], labels: Sequence[int], margin_m: float = 0.0, above_m: float = 0.0) -> Records:
    """Boxes as kernels take them, (m,) `BOX`.

    margin_m, above_m : by which footprints grow on every side, and tops upwards [m].
    """
    rows = [
        (
            *box.center[:2],
            0.5 * box.size[0] + margin_m,
            0.5 * box.size[1] + margin_m,
            math.cos(box.yaw),
            math.sin(box.yaw),
            box.size[2] + above_m,
            box.score,
            label,
        )
        for box, label in zip(boxes, labels, strict=True)
    ]
    return np.array(rows, BOX)


def rectangles(boxes: Iterable[Box]) -> Floats:
    """Footprints of boxes, (n, 5): x, y, length, width [m], yaw [rad]."""
    rows = [(*box.center[:2], *box.size[:2], box.yaw) for box in boxes]
    return np.array(rows, dtype=np.float64).reshape(-1, 5)


def oriented_iou(a: ArrayLike, b: ArrayLike) -> Floats:
    """Intersection over union (n, m) of rectangles ``a`` (n, 5) with ``b`` (m, 5): x, y, length, width [m], yaw [rad]
    (SSADNet equation A1). One that is not finite or has no area overlaps nothing, not even itself.
    """
    first, second = _as_rectangles(a), _as_rectangles(b)
    iou = np.empty((len(first), len(second)))
    fill_oriented_iou(first, second, iou)
    return iou


def shared_area(iou: Floats, a: Floats, b: Floats) -> Floats:
    """Area [m2] that rectangles share, from their overlap: ``iou = shared / (area of a + area of b - shared)``."""
    areas = np.add.outer(a[:, 2] * a[:, 3], b[:, 2] * b[:, 3])
    return np.asarray(iou / (1.0 + iou) * areas, np.float64)


def suppress_overlaps(
    rectangles: ArrayLike, scores: ArrayLike, iou_threshold: ArrayLike, *, max_inside: float = math.inf
) -> Ints64:
    """Greedy non-maximum suppression of oriented rectangles: rows kept, best score first, the earlier row on ties. Rows
    that are not finite overlap nothing, so they are kept.

    iou_threshold : a rectangle is dropped if it overlaps a kept one with a better score by more than this; with one
        threshold a rectangle, by more than the lower one of the two.
    max_inside : it is also dropped if the area shared with a better one is more than this share of the smaller one's
        area.
    """
    rows = _as_rectangles(rectangles)
    values = np.asarray(scores, dtype=np.float64)
    if values.shape != (len(rows),):
        raise PointsError(f"got scores of shape {values.shape} for {len(rows)} rectangles; pass one score a rectangle")
    limits = np.asarray(iou_threshold, dtype=np.float64)
    if limits.shape not in ((), values.shape):
        raise PointsError(f"got thresholds of shape {limits.shape} for {len(rows)} rectangles; pass one, or one each")
    limits = np.broadcast_to(limits, values.shape)
    order = np.argsort(-values, kind="stable")
    keep = np.empty(len(rows), np.bool_)
    mark_nms(read_only(rows[order], np.float64), read_only(limits[order], np.float64), max_inside, keep)
    return order[keep]


def bounding_rectangles(rectangles: ArrayLike) -> Floats:
    """Axis-aligned bounds of rectangles (n, 5), as rectangles of yaw 0."""
    rows = _as_rectangles(rectangles)
    cos, sin = np.abs(np.cos(rows[:, 4])), np.abs(np.sin(rows[:, 4]))
    bounds = np.zeros_like(rows)
    bounds[:, :2] = rows[:, :2]
    bounds[:, 2] = rows[:, 2] * cos + rows[:, 3] * sin
    bounds[:, 3] = rows[:, 2] * sin + rows[:, 3] * cos
    return bounds


def _as_rectangles(given: ArrayLike) -> Floats:
    rows = read_only(given, np.float64)
    if rows.size == 0:
        rows = rows.reshape(0, 5)
    if rows.ndim != 2 or rows.shape[1] != 5:
        raise PointsError(f"got rectangles of shape {rows.shape}; expected (n, 5): x, y, length, width, yaw")
    return rows


@njit(cache=True, nogil=True)
def fill_footprints(boxes: Records, grid: Grid, labels: Labels) -> None:
    """Write the label of each `BOX`, (m,), into the cells whose centers lie in its footprint, one after the other."""
    x_far, y_left, cell_m = grid
    n_rows, n_cols = labels.shape
    for k in range(boxes.shape[0]):
        box = boxes[k]
        x, y, cos, sin = box["x"], box["y"], abs(box["cos"]), abs(box["sin"])
        reach_x = cos * box["half_length"] + sin * box["half_width"]
        reach_y = sin * box["half_length"] + cos * box["half_width"]
        # A cell more on each side; the view's size bounds them before they become whole numbers.
        first_row = int(min(max((x_far - x - reach_x) / cell_m - 1.0, 0.0), n_rows))
        last_row = int(min(max((x_far - x + reach_x) / cell_m + 1.0, -1.0), n_rows - 1.0))
        first_col = int(min(max((y_left - y - reach_y) / cell_m - 1.0, 0.0), n_cols))
        last_col = int(min(max((y_left - y + reach_y) / cell_m + 1.0, -1.0), n_cols - 1.0))
        for row in range(first_row, last_row + 1):
            for col in range(first_col, last_col + 1):
                if is_inside(box, x_far - (row + 0.5) * cell_m, y_left - (col + 0.5) * cell_m):
                    labels[row, col] = box["label"]


@njit(cache=True, nogil=True)
def is_inside(box: np.void, x: float, y: float) -> bool:
    """Whether a place [m] lies in the footprint of a `BOX`."""
    dx, dy = x - box["x"], y - box["y"]
    along, across = box["cos"] * dx + box["sin"] * dy, box["cos"] * dy - box["sin"] * dx
    return bool((abs(along) <= box["half_length"]) & (abs(across) <= box["half_width"]))


@njit(cache=True, nogil=True)
def cell_at(grid: Grid, shape: tuple[int, int], x: float, y: float) -> tuple[int, int]:
    """Row and column of the cell that holds a place [m]; -1, -1 out of view."""
    row, col = (grid.far - x) / grid.cell, (grid.left - y) / grid.cell
    if not ((row >= 0.0) & (row < shape[0]) & (col >= 0.0) & (col < shape[1])):
        return -1, -1
    return int(row), int(col)


@njit(cache=True, nogil=True)
def fill_oriented_iou(a: Floats, b: Floats, iou: Floats) -> None:
    """Compute the overlap (IoU) of every pair.

    b : (m, 5) float64, C-contiguous; x, y, length, width [m], yaw [rad].
    """
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            iou[i, j] = pair_iou(a[i], b[j])


@njit(cache=True, nogil=True)
def mark_nms(rectangles: Floats, limits: Floats, max_inside: float, keep: Mask) -> None:
    """Mark the rectangles, best first, that overlap no better kept rectangle by more than the lower of their limits
    (IoU), or than ``max_inside`` of the smaller area of two.
    """
    for i in range(rectangles.shape[0]):
        keep[i] = True
        area = rectangles[i, 2] * rectangles[i, 3]
        for j in range(i):
            if not keep[j]:
                continue
            iou = pair_iou(rectangles[j], rectangles[i])
            other = rectangles[j, 2] * rectangles[j, 3]
            limit = min(limits[i], limits[j])
            if iou > limit or iou / (1.0 + iou) * (other + area) > max_inside * min(other, area):
                keep[i] = False
                break


@njit(cache=True, nogil=True)
def pair_iou(a: Floats, b: Floats) -> float:
    """IoU of two rectangles (5,); the second is clipped by the first in the frame of the first."""
    area_a = a[2] * a[3]
    area_b = b[2] * b[3]
    if not (a[2] > 0.0 and a[3] > 0.0 and b[2] > 0.0 and b[3] > 0.0 and area_a + area_b < math.inf):
        return 0.0
    dx = b[0] - a[0]
    dy = b[1] - a[1]
    reach = 0.5 * (math.hypot(a[2], a[3]) + math.hypot(b[2], b[3]))
    if not dx * dx + dy * dy < reach * reach or not math.isfinite(a[4] + b[4]):
        return 0.0
    cos_a, sin_a = math.cos(a[4]), math.sin(a[4])
    center_x = dx * cos_a + dy * sin_a
    center_y = dy * cos_a - dx * sin_a
    cos_r, sin_r = math.cos(b[4] - a[4]), math.sin(b[4] - a[4])
    # Four clips leave at most 8 corners, and at most 20 with rounding.
    # Source and target alternate between columns 0, 1 and columns 2, 3.
    corners = np.empty((20, 4))
    for k in range(4):
        along = 0.5 * b[2] if k == 0 or k == 3 else -0.5 * b[2]
        across = 0.5 * b[3] if k < 2 else -0.5 * b[3]
        corners[k, 0] = center_x + along * cos_r - across * sin_r
        corners[k, 1] = center_y + along * sin_r + across * cos_r
    n = 4
    source = 0
    for side in range(4):
        axis = side // 2
        sign = 1.0 if side % 2 == 0 else -1.0
        limit = 0.5 * a[2 + axis]
        target = 2 - source
        m = 0
        for k in range(n):
            last = n - 1 if k == 0 else k - 1
            gap = limit - sign * corners[k, source + axis]
            gap_last = limit - sign * corners[last, source + axis]
            if (gap >= 0.0) != (gap_last >= 0.0):
                share = gap_last / (gap_last - gap)
                for c in range(2):
                    start = corners[last, source + c]
                    corners[m, target + c] = start + share * (corners[k, source + c] - start)
                m += 1
            if gap >= 0.0:
                corners[m, target] = corners[k, source]
                corners[m, target + 1] = corners[k, source + 1]
                m += 1
        n = m
        source = target
    twice = 0.0
    for k in range(n):
        last = n - 1 if k == 0 else k - 1
        twice += corners[last, source] * corners[k, source + 1] - corners[k, source] * corners[last, source + 1]
    # Rounding may give a sliver a negative area, and two equal rectangles a shared area above their own.
    shared = min(max(0.5 * twice, 0.0), area_a, area_b)
    return float(shared / (area_a + area_b - shared))


def inside(box: Box, points: NDArray[Any], margin_m: float = 0.0) -> Mask:
    """Find the points inside a box that is grown by a margin on every side [m]; not finite ones are outside."""
    half = np.asarray(box.size) / 2.0 + margin_m
    # Most points are out of reach along x already: a scan and a box take 0.1 in place of 0.5 ms.
    center = np.asarray(box.center, np.float32)
    near = np.flatnonzero(np.abs(points[:, 0] - center[0]) <= 1.001 * np.hypot(half[0], half[1]) + 0.001)
    offset = points[near, :3] - center
    cos, sin = np.cos(box.yaw), np.sin(box.yaw)
    along = offset[:, 0] * cos + offset[:, 1] * sin
    across = offset[:, 1] * cos - offset[:, 0] * sin
    found = np.zeros(len(points), np.bool_)
    found[near] = (np.abs(along) <= half[0]) & (np.abs(across) <= half[1]) & (np.abs(offset[:, 2]) <= half[2])
    return found
