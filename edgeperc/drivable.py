"""The road in a top view for a planner: its outline as a polygon, the free distance, the lane width.

Everything is in the sensor frame [m]: x forward, y left. Only cells that the scan observed are drivable
(`TopView.observed`): where the sensor saw nothing, and outside the view, nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import PointsError
from .frame import ModelFrame
from .geometry import draw_footprints
from .kernel_cache import njit
from .perception import Box, TopView

__all__ = [
    "RoadAhead",
    "compile_kernels",
    "fill_corridor",
    "fill_free",
    "fill_rings",
    "mark_connected",
    "mark_kept",
    "road_ahead",
]

USUAL_LANE_M = 3.25
"""Lanes of towns and country roads are 2.75 to 3.75 m wide. A road is divided into lanes nearest to this width."""
LANE_RANGE_M = 20.0
BESIDE_M = 2.0
"""The corridor must begin within this distance of the sensor's axis."""


@dataclass(frozen=True, slots=True, eq=False)
class RoadAhead:
    """The road in a top view, in the frame of the models [m] (see `TopView`).

    Attributes
    ----------
    outline : (k, 2) float64
        Corners x, y of the connected road nearest to the sensor, counter-clockwise seen from above, the first not
        repeated. Cells that share only a corner are not connected. Shape (0, 2) if no cell is drivable.
    holes : tuple of (k, 2) float64
        Areas inside the outline that are not road, such as vehicles; clockwise.
    y_m : (columns,) float64
        Middles of the top view's columns, leftmost first.
    free_m : (columns,) float64
        x up to which each column is drivable without a gap, from the near edge of the view. It is the near edge if the
        nearest cell is not drivable, and the far edge if all cells are drivable. A cell that the scan did not observe
        ends it like an obstacle. With a VLP-16 this is often 14 to 20 m ahead, in the gap between two of its beams.
    x_m : (rows,) float64
        Middles of the top view's rows, nearest first.
    left_m, right_m : (rows,) float64
        y of the edges of the corridor ahead. In each row, the corridor is the run of drivable cells that continues the
        run of the row before. NaN before the corridor begins and after it ends, and everywhere if none begins within
        2 m of the sensor's axis. An edge may be the edge of the road, an object, or the edge of what the scan observed.
    lane_width_m : float
        Estimated from the corridor's width across its direction (median of the nearest 20 m of view), because the map
        has no lane markings. The width is divided by the number of lanes, at least one, that gives about 3.25 m. NaN if
        no row has both edges in view.
    """

    outline: NDArray[np.float64]
    holes: tuple[NDArray[np.float64], ...]
    y_m: NDArray[np.float64]
    free_m: NDArray[np.float64]
    x_m: NDArray[np.float64]
    left_m: NDArray[np.float64]
    right_m: NDArray[np.float64]
    lane_width_m: float

    @property
    def width_m(self) -> NDArray[np.float64]:
        """Width of the corridor along y in every row, (rows,); NaN where there is none."""
        return self.left_m - self.right_m

    def free_ahead_m(self, half_width_m: float = 1.0) -> float:
        """x [m] up to which a strip as wide as a vehicle is free: lowest `free_m` within ``half_width_m`` of the axis.

        NaN if the view has no column there.
        """
        near = np.abs(self.y_m) <= half_width_m
        return float(self.free_m[near].min()) if near.any() else math.nan


def road_ahead(top_view: TopView, boxes: Iterable[Box] = (), *, tolerance_m: float = 0.1) -> RoadAhead:
    """Measure the road in a top view: polygon, free distance and lane width.

    Parameters
    ----------
    top_view : TopView
        Cells that the scan did not observe are not free, whatever their label.
    boxes : iterable of Box
        Obstacles that are not road, such as `Perception.boxes`, in the frame of the scan: the top view has no class for
        pedestrians.
    tolerance_m : float
        Largest distance of the polygon from the edges of the cells [m] (Douglas and Peucker, 1973); 0 keeps every
        corner. The default is one cell of the shipped models, which removes the steps of a slanting edge. With more
        than one cell, edges of a ring may cross.

    Returns
    -------
    RoadAhead

    Raises
    ------
    PointsError
        The tolerance is negative or NaN.

    Examples
    --------
    >>> found = perceive(points)                            # doctest: +SKIP
    >>> road = road_ahead(found.top_view, found.boxes)      # doctest: +SKIP
    >>> road.free_ahead_m(), road.lane_width_m              # doctest: +SKIP
    (31.4, 3.1)
    """
    if not tolerance_m >= 0.0:
        raise PointsError(f"tolerance_m is {tolerance_m}; expected 0 or more meters")
    drivable = np.array(top_view.drivable, np.bool_, order="C")
    standing = ModelFrame(top_view.mounting).move_boxes(boxes)
    if standing:
        taken = np.zeros(drivable.shape, np.uint8)
        draw_footprints(taken, standing, top_view.geometry, ("free", *{box.label for box in standing}))
        drivable &= taken == 0
    height, width = drivable.shape
    cell_m, (x_near, x_far), y_left = top_view.cell_m, top_view.x_range_m, top_view.y_range_m[1]
    y_m = y_left - (np.arange(width, dtype=np.float64) + 0.5) * np.float64(cell_m)
    x_m = x_far - (np.arange(height, dtype=np.float64)[::-1] + 0.5) * np.float64(cell_m)

    free_rows = np.empty(width, np.int64)
    fill_free(drivable, free_rows)
    free_m = np.where(free_rows == height, x_far, x_near + free_rows * cell_m)

    bounds = np.empty((height, 2), np.int64)
    axis = y_left / cell_m  # the column where y is 0
    fill_corridor(drivable, axis - BESIDE_M / cell_m, axis + BESIDE_M / cell_m, bounds)
    bounds = bounds[::-1]
    there = bounds[:, 0] >= 0
    left_m = np.where(there, y_left - bounds[:, 0] * cell_m, np.nan)
    right_m = np.where(there, y_left - bounds[:, 1] * cell_m, np.nan)
    whole = there & (bounds[:, 0] > 0) & (bounds[:, 1] < width) & (x_m < x_near + LANE_RANGE_M)

    rings = [
        _simplified(np.column_stack([x_far - ring[:, 0] * cell_m, y_left - ring[:, 1] * cell_m]), float(tolerance_m))
        for ring in _rings(_nearest_part(drivable, y_m, x_m[::-1]))
    ]
    # Rings run with the road on their left, so only the outer ring has a positive area.
    areas = [_area(ring) for ring in rings]
    outer = int(np.argmax(areas)) if rings else -1
    return RoadAhead(
        outline=rings[outer] if rings else np.empty((0, 2)),
        holes=tuple(ring for k, ring in enumerate(rings) if k != outer),
        y_m=y_m,
        free_m=free_m,
        x_m=x_m,
        left_m=left_m,
        right_m=right_m,
        lane_width_m=_lane_width(x_m[whole], left_m[whole], right_m[whole]),
    )


def compile_kernels() -> None:
    """Compile what `road_ahead` calls. A `Perceiver` with a top view does this, so that the first call is fast."""
    cells = np.ones((2, 2), np.bool_)
    fill_free(cells, np.empty(2, np.int64))
    fill_corridor(cells, 0.0, 2.0, np.empty((2, 2), np.int64))
    for ring in _rings(_nearest_part(cells, np.zeros(2), np.zeros(2))):
        _simplified(ring.astype(np.float64), 0.0)


def _lane_width(x: NDArray[np.float64], left: NDArray[np.float64], right: NDArray[np.float64]) -> float:
    if len(x) == 0:
        return math.nan
    # A road at an angle is narrower than its width along y. The median slope is robust against vehicles on the road.
    half = len(x) // 2
    middle = 0.5 * (left + right)
    slope = float(np.median((middle[-half:] - middle[:half]) / (x[-half:] - x[:half]))) if half else 0.0
    width = float(np.median(left - right)) / math.hypot(1.0, slope)
    return width / max(1, round(width / USUAL_LANE_M))


def _nearest_part(drivable: NDArray[np.bool_], y: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The connected drivable cells around the one nearest to the sensor."""
    part = np.zeros(drivable.shape, np.bool_)
    rows, cols = np.nonzero(drivable)
    if len(rows):
        nearest = int(np.argmin(np.hypot(x[rows], y[cols])))
        mark_connected(drivable, int(rows[nearest]), int(cols[nearest]), part)
    return part


def _rings(part: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Rings of corners (row, column) around the cells of ``part``, with these cells on the left."""
    padded = np.pad(part, 1)
    n_sides = sum(int(np.count_nonzero(padded & ~np.roll(padded, shift, axis))) for axis in (0, 1) for shift in (1, -1))
    corners, ends = np.empty((n_sides, 2), np.int64), np.empty(n_sides // 4 + 1, np.int64)
    n_rings = fill_rings(padded, corners, ends)
    return [ring - 1 for ring in np.split(corners, ends[:n_rings])[:n_rings]]


def _simplified(ring: NDArray[np.float64], tolerance_m: float) -> NDArray[np.float64]:
    kept = np.empty(len(ring), np.bool_)
    mark_kept(ring, tolerance_m, kept)
    # Fewer than three corners are no ring.
    return ring[kept] if np.count_nonzero(kept) >= 3 else ring


def _area(ring: NDArray[np.float64]) -> float:
    x, y = ring[:, 0], ring[:, 1]
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


@njit(cache=True, nogil=True)
def fill_free(drivable: NDArray[np.bool_], free: NDArray[np.int64]) -> None:
    """Count the drivable cells of each column, from the last row up to the first gap.

    Parameters
    ----------
    drivable : (rows, columns) bool
    free : (columns,) int64, overwritten
    """
    height, width = drivable.shape
    for col in range(width):
        n = 0
        while n < height and drivable[height - 1 - n, col]:
            n += 1
        free[col] = n


@njit(cache=True, nogil=True)
def fill_corridor(drivable: NDArray[np.bool_], first: float, last: float, bounds: NDArray[np.int64]) -> None:
    """Follow the drivable cells ahead, row by row from the last one up.

    Parameters
    ----------
    drivable : (rows, columns) bool
    first, last : float
        Columns between which the corridor has to begin.
    bounds : (rows, 2) int64, overwritten
        First column of the corridor in each row, and one past its last; -1, -1 in rows without a corridor.

    Notes
    -----
    The corridor begins in the last row that has a run of drivable cells between ``first`` and ``last``. It continues
    with the run that shares most columns with the row before, the left one on ties, and ends where no run shares one.
    """
    height, width = drivable.shape
    bounds[:] = -1
    begun = False
    low, high = first, last
    for row in range(height - 1, -1, -1):
        most = 0.0
        col = 0
        while col < width:
            if not drivable[row, col]:
                col += 1
                continue
            start = col
            while col < width and drivable[row, col]:
                col += 1
            shared = min(np.float64(col), high) - max(np.float64(start), low)
            if shared > most:
                most = shared
                bounds[row, 0] = start
                bounds[row, 1] = col
        if most > 0.0:
            begun = True
            low, high = np.float64(bounds[row, 0]), np.float64(bounds[row, 1])
        elif begun:
            return


@njit(cache=True, nogil=True)
def mark_connected(cells: NDArray[np.bool_], row: int, col: int, part: NDArray[np.bool_]) -> None:
    """Mark the cells that are connected to a start cell over shared sides.

    Parameters
    ----------
    cells : (rows, columns) bool
    row, col : int
        A marked cell of ``cells``, where the search begins.
    part : (rows, columns) bool, overwritten
    """
    height, width = cells.shape
    part[:] = False
    pending = np.empty((height * width, 2), np.int32)
    pending[0, 0], pending[0, 1] = row, col
    part[row, col] = True
    n = 1
    while n > 0:
        n -= 1
        r, c = pending[n, 0], pending[n, 1]
        for k in range(4):
            dr = -1 if k == 0 else 1 if k == 1 else 0
            dc = -1 if k == 2 else 1 if k == 3 else 0
            if 0 <= r + dr < height and 0 <= c + dc < width and cells[r + dr, c + dc] and not part[r + dr, c + dc]:
                part[r + dr, c + dc] = True
                pending[n, 0], pending[n, 1] = r + dr, c + dc
                n += 1


@njit(cache=True, nogil=True)
def fill_rings(cells: NDArray[np.bool_], corners: NDArray[np.int64], ends: NDArray[np.int64]) -> int:
    """Trace the edges of marked cells, with the cells on the left.

    Parameters
    ----------
    cells : (rows, columns) bool
        None marked along the border.
    corners : (n, 2) int64, overwritten
        Row and column of the corners where the trace turns, ring after ring; a cell's upper left corner has its row and
        column. ``n`` is at least the number of sides between a marked and an unmarked cell.
    ends : (m,) int64, overwritten
        Where each ring ends in ``corners``; ``m`` at least a quarter of ``n``.

    Returns
    -------
    n_rings : int
    """
    height, width = cells.shape
    walked = np.zeros((height, width), np.bool_)  # lower sides
    n_corners, n_rings = 0, 0
    for top in range(height - 1):
        for left in range(width):
            if not cells[top, left] or cells[top + 1, left] or walked[top, left]:
                continue
            row, col, heading = top + 1, left, 0  # to the right along the lower side of the cell
            begun = False
            while not begun or row != top + 1 or col != left or heading != 0:
                begun = True
                if heading == 0:
                    walked[row - 1, col] = True
                    col += 1
                    ahead_left, ahead_right = cells[row - 1, col], cells[row, col]
                elif heading == 1:  # up
                    row -= 1
                    ahead_left, ahead_right = cells[row - 1, col - 1], cells[row - 1, col]
                elif heading == 2:  # left
                    col -= 1
                    ahead_left, ahead_right = cells[row, col - 1], cells[row - 1, col - 1]
                else:  # down
                    row += 1
                    ahead_left, ahead_right = cells[row, col], cells[row, col - 1]
                turn = 1 if not ahead_left else -1 if ahead_right else 0
                if turn != 0:
                    corners[n_corners, 0], corners[n_corners, 1] = row, col
                    n_corners += 1
                    heading = (heading + turn) % 4
            ends[n_rings] = n_corners
            n_rings += 1
    return n_rings


@njit(cache=True, nogil=True)
def mark_kept(ring: NDArray[np.float64], tolerance: float, kept: NDArray[np.bool_]) -> None:
    """Mark the corners that a simplified ring needs (Douglas and Peucker).

    Parameters
    ----------
    ring : (n, 2) float64
        At least one corner; the first is not repeated.
    tolerance : float
        Every corner left out lies within this distance of the edge that replaces it.
    kept : (n,) bool, overwritten
    """
    n = ring.shape[0]
    kept[:] = False
    # Split the ring into two lines: from its first corner to the corner farthest from it, and back.
    farthest, most = 0, 0.0
    for k in range(n):
        apart = math.hypot(ring[k, 0] - ring[0, 0], ring[k, 1] - ring[0, 1])
        if apart > most:
            farthest, most = k, apart
    kept[0] = True
    kept[farthest] = True
    pending = np.empty((n + 2, 2), np.int64)
    pending[0, 0], pending[0, 1] = 0, farthest
    pending[1, 0], pending[1, 1] = farthest, n
    n_pending = 2
    while n_pending > 0:
        n_pending -= 1
        begin, end = pending[n_pending, 0], pending[n_pending, 1]
        x, y = ring[begin, 0], ring[begin, 1]
        dx, dy = ring[end % n, 0] - x, ring[end % n, 1] - y
        length2 = dx * dx + dy * dy
        worst, most = -1, tolerance
        for k in range(begin + 1, end):
            ux, uy = ring[k, 0] - x, ring[k, 1] - y
            along = min(max((ux * dx + uy * dy) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
            off = math.hypot(ux - along * dx, uy - along * dy)
            if off > most:
                worst, most = k, off
        if worst >= 0:
            kept[worst] = True
            pending[n_pending, 0], pending[n_pending, 1] = begin, worst
            pending[n_pending + 1, 0], pending[n_pending + 1, 1] = worst, end
            n_pending += 2
