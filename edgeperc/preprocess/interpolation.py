"""Points between the beams of a sensor that has fewer than the training sensor."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..errors import PointsError
from ..system.kernels import njit
from ..types.mounting import MODEL_HEIGHT_M
from ..types.points import Floats, Floats32, Ints, Ints64, Points
from ..types.sensor import SensorProfile
from ..types.views import RangeImageGeometry

# Two returns lie on one surface if the line between them is at least MIN_ANGLE_DEG off the ray and their ranges differ
# by at most MAX_STEP_M. On objects in 48 simulated scans of three sensors, 5 to 7 % of the interpolated points are more
# than 0.3 m from the true surface. With steps up to 2 m it would be 8 to 13 %.
MIN_ANGLE_DEG = 5.0
MAX_STEP_M = 0.5
# Neighboring rings on the road are meters apart. They are joined if both are near the ground and the line between them
# is level.
GROUND_M = 0.3
GROUND_PER_M = 0.02  # of range; neither the sensor nor the road is exactly level
GROUND_SLOPE = 0.1
# Neighboring beams or columns that are at most this many pixels apart leave no gap to fill.
NO_GAP = 1.1
# Points of a pattern lie at random, not on beams: the next one in a row may be so many columns away. With 2, as with 8,
# mean IoU is 0 to 6 points lower on twelve streets (Mid-360 of 0.2 and 0.5 s, HAP, Avia).
_SCATTER = 4.0


class Gaps(NamedTuple):
    """Where a view has gaps between the beams of a sensor."""

    row_slopes: Floats  # tangent of each row's elevation
    directions: Floats  # (2, W) cosine and sine of each column's azimuth
    row_reach: Ints64  # how many rows below each row the next beam's return may be
    col_reach: int  # how many columns to the right the next return may be
    ground_z: float  # of the ground in the frame of the points [m]


class Interpolator:
    """Fills the pixels of a range image between neighboring beams and columns of a coarser sensor (KUL-Seg 5), if it is
    coarser than some part of the view (``needed``).
    """

    def __init__(self, view: RangeImageGeometry, sensor: SensorProfile) -> None:
        rows = np.array(view.row_elevations_deg)
        column_deg = (view.azimuth_left_deg - view.azimuth_right_deg) / view.width
        azimuths = np.radians(view.azimuth_left_deg - (np.arange(view.width) + 0.5) * column_deg)
        # Row coordinates of the beams; then the reach of each row.
        beams = np.array(sensor.elevations_deg)
        if sensor.pattern is not None:  # such beams may be anywhere, however it is mounted
            step_deg = (sensor.fov_up_deg - sensor.fov_down_deg) / (sensor.n_beams - 1)
            beams = step_deg * np.arange(math.floor(90.0 / step_deg), -math.ceil(90.0 / step_deg), -1)
        places = np.interp(-beams, -rows, np.arange(len(rows)), left=-1.0, right=len(rows))
        row_reach = np.zeros(len(rows), np.int64)
        for upper, lower in pairwise(places.tolist()):
            if lower - upper > NO_GAP and upper >= 0.0 and lower < len(rows):
                between = row_reach[math.floor(upper) : math.ceil(lower) + 1]
                between[:] = np.maximum(between, math.ceil(lower - upper) + 1)
        step = (1.0 if sensor.pattern is None else _SCATTER) * sensor.azimuth_resolution_deg / column_deg
        col_reach = math.floor(step) + 1 if step > NO_GAP else 0
        directions = np.stack([np.cos(azimuths), np.sin(azimuths)])
        self._gaps = Gaps(np.tan(np.radians(rows)), directions, row_reach, col_reach, -MODEL_HEIGHT_M)
        self.shape = (view.height, view.width)
        self.needed = bool(row_reach.any() or col_reach)

    def fill(self, points: Points, index: Ints) -> tuple[Floats32, Ints]:
        """The points with interpolated ones behind them, each on the line between two neighbors in the middle of its
        pixel, and their rows at each pixel.
        """
        if points.ndim != 2 or points.shape[1] != 4 or points.dtype != np.float32:
            raise PointsError(f"got points of shape {points.shape} and {points.dtype}; expected (n, 4) float32")
        if index.shape != self.shape or (index.size and int(index.max()) >= len(points)):
            raise PointsError(
                f"got index of shape {index.shape} for {len(points)} points; expected {self.shape}, "
                "rows of these points"
            )
        n = len(points)
        dense = np.empty((n + np.count_nonzero(index < 0), 4), np.float32)
        dense[:n] = points
        filled = np.array(index, np.int32, order="C")
        return dense[: fill_between(dense, n, filled, self._gaps)], filled


@njit(cache=True, nogil=True)
def on_one_surface(points: Points, i: int, j: int, ground_z: float) -> bool:
    """Whether two neighboring returns lie on one surface, or both on the ground."""
    xi, yi, zi = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
    xj, yj, zj = np.float64(points[j, 0]), np.float64(points[j, 1]), np.float64(points[j, 2])
    range_i = math.sqrt(xi * xi + yi * yi + zi * zi)
    range_j = math.sqrt(xj * xj + yj * yj + zj * zj)
    dx, dy, dz = xj - xi, yj - yi, zj - zi
    apart = math.sqrt(dx * dx + dy * dy + dz * dz)
    step = abs(range_j - range_i)
    if step <= MAX_STEP_M and step <= math.cos(math.radians(MIN_ANGLE_DEG)) * apart:
        return True
    return bool(
        abs(zi - ground_z) <= GROUND_M + GROUND_PER_M * range_i
        and abs(zj - ground_z) <= GROUND_M + GROUND_PER_M * range_j
        and abs(dz) <= GROUND_SLOPE * apart
    )


@njit(cache=True, nogil=True)
def fill_between(points: Points, n: int, index: Ints, gaps: Gaps) -> int:
    """Fill empty pixels between two returns of one surface, along rows, then columns; returns the number of points.

    points : the first ``n`` rows are the input, those after them are overwritten.
    """
    row_slopes, directions, row_reach, col_reach, ground_z = gaps
    height, width = index.shape
    for row in range(height if col_reach > 1 else 0):
        last = -1
        for col in range(width):
            if index[row, col] < 0:
                continue
            if last >= 0 and 1 < col - last <= col_reach:
                i, j = index[row, last], index[row, col]
                if on_one_surface(points, i, j, ground_z):
                    for k in range(last + 1, col):
                        cos, sin = directions[0, k], directions[1, k]
                        # Signed distances of the two returns from the vertical plane through the middle of the column.
                        side_i = np.float64(points[i, 0]) * sin - np.float64(points[i, 1]) * cos
                        side_j = np.float64(points[j, 0]) * sin - np.float64(points[j, 1]) * cos
                        if side_i * side_j < 0.0:
                            put_between(points, n, i, j, side_i / (side_i - side_j))
                            index[row, k] = n
                            n += 1
            last = col
    lasts = np.full(width, -1, np.int64)  # row by row, because the pixels of a row lie beside each other
    for row in range(height):
        for col in range(width):
            if index[row, col] < 0:
                continue
            last, lasts[col] = lasts[col], row
            if last < 0 or not 1 < row - last <= row_reach[last]:
                continue
            i, j = index[last, col], index[row, col]
            if on_one_surface(points, i, j, ground_z):
                flat_i = math.hypot(np.float64(points[i, 0]), np.float64(points[i, 1]))
                flat_j = math.hypot(np.float64(points[j, 0]), np.float64(points[j, 1]))
                for k in range(last + 1, row):
                    above_i = np.float64(points[i, 2]) - row_slopes[k] * flat_i
                    above_j = np.float64(points[j, 2]) - row_slopes[k] * flat_j
                    if above_i * above_j < 0.0:
                        put_between(points, n, i, j, above_i / (above_i - above_j))
                        index[k, col] = n
                        n += 1
    return n


@njit(cache=True, nogil=True)
def put_between(points: Points, n: int, i: int, j: int, share: float) -> None:
    """Write point ``n``, at a share of the way from one point to another."""
    for axis in range(4):
        start = np.float64(points[i, axis])
        points[n, axis] = start + share * (np.float64(points[j, axis]) - start)
