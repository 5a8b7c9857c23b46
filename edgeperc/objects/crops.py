"""The points of each candidate, as the input of the object network.

A crop holds the points in a candidate's rectangle and a margin around it, in the rectangle's frame, with their height
above the ground below it. `fill_features` makes the network's input of crops, at run time and in training.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..system.kernels import njit
from ..types.points import Floats, Floats32, Heights, Ints, Points
from .candidates import CELL_M, N_SIDE, REACH_M, Candidates, Cells

if TYPE_CHECKING:
    from ..ground.scan import Scan

FEATURES = (
    *("x", "y", "height_above_ground", "remission", "beyond_length", "beyond_width"),
    *("length", "width", "top", "sensor_ahead", "sensor_left", "range", "n_points"),
)
"""Channels of the input: of each point, then of its candidate.

``x``, ``y``: in the frame of the candidate's rectangle [m]. ``beyond_length``, ``beyond_width``: distance beyond its
sides, negative inside [m]. ``length``, ``width``, ``n_points``: natural logarithms, of meters and of the number of
points plus one. ``top``: height of the highest point inside [m]. ``sensor_ahead``, ``sensor_left``: direction to the
sensor, a unit vector. ``range``: distance of the middle from the sensor [m].
"""
N_POINT_FEATURES = 6
LEVEL_MARGIN_M = 0.3  # points this near to a rectangle say how high the ground below it is
TOP_MARGIN_M = 0.1
MIN_SIDE_M = 0.1
MIN_COUNT = 3  # points of a candidate


class Crops(NamedTuple):
    """Points near candidates."""

    # (m, n_points, 4) x, y in the rectangle's frame, height above `level` [m], remission. Where there are more points
    # than ``n_points``, evenly chosen ones; where there are fewer, they repeat.
    points: Points
    # (m,) number of points in the rectangle and its margin, chosen or not. 0: the points are all 0.
    counts: Ints
    level: Floats  # (m,) z of the ground below [m]


def crop_candidates(scan: Scan, candidates: Candidates, n_points: int, margin_m: float) -> Crops:
    """The points of the candidates in ``cells``; a candidate without any has a count of 0."""
    m = len(candidates.rectangles)
    crops = Crops(np.empty((m, n_points, 4), np.float32), np.empty(m, np.int32), np.empty(m))
    fill_crops(scan.points, scan.ground.height_m, candidates.cells, candidates.rectangles, margin_m, crops)
    return crops


def with_points(candidates: Candidates, crops: Crops) -> tuple[Candidates, Crops]:
    """The candidates with enough points, and their crops."""
    enough = crops.counts >= MIN_COUNT
    if enough.all():
        return candidates, crops
    kept = Crops(crops.points[enough], crops.counts[enough], crops.level[enough])
    return candidates._replace(rectangles=candidates.rectangles[enough]), kept


@njit(cache=True, nogil=True)
def fill_crops(
    points: Points, height: Heights, cells: Cells, rectangles: Floats, margin_m: float, crops: Crops
) -> None:
    """Write the points of each rectangle (m, 5), found by cells, into `Crops`."""
    number, starts, rows = cells.number, cells.starts, cells.rows
    chosen, counts, levels = crops.points, crops.counts, crops.level
    near = np.empty(rows.shape[0], np.int32)
    for k in range(rectangles.shape[0]):
        x, y = rectangles[k, 0], rectangles[k, 1]
        along, across = 0.5 * rectangles[k, 2] + margin_m, 0.5 * rectangles[k, 3] + margin_m
        cos, sin = math.cos(rectangles[k, 4]), math.sin(rectangles[k, 4])
        reach_x, reach_y = abs(cos) * along + abs(sin) * across, abs(sin) * along + abs(cos) * across
        n, n_core, level, core = 0, 0, 0.0, 0.0
        # The cells of the view bound the numbers before they become whole.
        first_row = int(min(max((x - reach_x + REACH_M) / CELL_M, 0.0), N_SIDE))
        last_row = int(min(max((x + reach_x + REACH_M) / CELL_M, -1.0), N_SIDE - 1.0))
        first_col = int(min(max((y - reach_y + REACH_M) / CELL_M, 0.0), N_SIDE))
        last_col = int(min(max((y + reach_y + REACH_M) / CELL_M, -1.0), N_SIDE - 1.0))
        for row in range(first_row, last_row + 1):
            for col in range(first_col, last_col + 1):
                cell = number[row, col]
                if cell < 0:
                    continue
                for at in range(starts[cell], starts[cell + 1]):
                    i = rows[at]
                    dx, dy = points[i, 0] - x, points[i, 1] - y
                    u, v = abs(cos * dx + sin * dy), abs(cos * dy - sin * dx)
                    if u < along and v < across:
                        near[n] = i
                        n += 1
                        below = np.float64(points[i, 2]) - height[i]
                        level += below
                        if u < along - margin_m + LEVEL_MARGIN_M and v < across - margin_m + LEVEL_MARGIN_M:
                            core += below
                            n_core += 1
        counts[k] = n
        levels[k] = core / n_core if n_core > 0 else level / max(n, 1)
        n_slots = chosen.shape[1]
        for slot in range(n_slots):
            if n == 0:
                for axis in range(4):
                    chosen[k, slot, axis] = 0.0
                continue
            i = near[slot * n // n_slots if n > n_slots else slot % n]
            dx, dy = points[i, 0] - x, points[i, 1] - y
            chosen[k, slot, 0] = cos * dx + sin * dy
            chosen[k, slot, 1] = cos * dy - sin * dx
            chosen[k, slot, 2] = points[i, 2] - levels[k]
            chosen[k, slot, 3] = points[i, 3]


@njit(cache=True, nogil=True)
def fill_features(points: Points, counts: Ints, rectangles: Floats, scale: Floats32, features: Floats32) -> None:
    """Write the network's input of crops (m, n_points, channels), by mean and standard deviation of the `FEATURES`."""
    raw = np.empty(features.shape[2], np.float32)
    for k in range(points.shape[0]):
        x, y = rectangles[k, 0], rectangles[k, 1]
        length, width = rectangles[k, 2], rectangles[k, 3]
        cos, sin = math.cos(rectangles[k, 4]), math.sin(rectangles[k, 4])
        away = max(math.hypot(x, y), 1e-6)
        top = 0.0
        for slot in range(points.shape[1]):
            u, v = abs(points[k, slot, 0]) - 0.5 * length, abs(points[k, slot, 1]) - 0.5 * width
            if u < TOP_MARGIN_M and v < TOP_MARGIN_M:
                top = max(top, points[k, slot, 2])
        raw[6], raw[7] = math.log(max(length, MIN_SIDE_M)), math.log(max(width, MIN_SIDE_M))
        raw[8] = top
        raw[9], raw[10] = -(cos * x + sin * y) / away, -(cos * y - sin * x) / away
        raw[11], raw[12] = away, math.log(counts[k] + 1.0)
        for slot in range(points.shape[1]):
            for axis in range(4):
                raw[axis] = points[k, slot, axis]
            raw[4] = abs(points[k, slot, 0]) - 0.5 * length
            raw[5] = abs(points[k, slot, 1]) - 0.5 * width
            for c in range(features.shape[2]):
                features[k, slot, c] = (raw[c] - scale[0, c]) / scale[1, c]
