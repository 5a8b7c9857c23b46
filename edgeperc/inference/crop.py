"""Leave out the points of a scan that no view shows and that belong to no object in a view.

A network that looks ahead sees a quarter of the turn. The ground is found with all points. What follows has half as
many: none behind the vehicle or far beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..ground.observed import FARTHER
from ..system.kernels import njit
from ..types.perception import PointLabels
from ..types.points import Bytes, Floats, Floats32, Ints, Labels, Mask, Points, Rows, read_only
from ..types.views import RangeImageGeometry, TopViewGeometry

MARGIN_M = 5.0
"""Points up to this far beside a range image are kept [m]: a car at its edge is clustered as a whole.

With it, no answer to 61 scans of KITTI changes, nor a figure of `edgeperc eval` on PandaSet, Argoverse 2, View of Delft
and DDAD.
"""
BOX_BESIDE_M = 2.2  # how far a car reaches whose middle is at the side of a top view, turned by any angle
ROUNDING_M = 0.01  # of a point, when its scan is turned


class Crop:
    """Select the points that matter for some views: those between two lines, left and right. One instance per thread.

    Of a range image, the sector and ``margin_m`` beside it are kept. Of a top view, what `observed.Observer` uses: up
    to 1.4 times as far as the view, between the directions of its sides; and 2.2 m beside it, where boxes reach.
    Everything is kept without a view, for a sector of more than 180 degrees, and for a top view alone that is not ahead
    of the sensor. ``turn_rad`` turns the views to the left.
    """

    def __init__(
        self,
        views: Sequence[RangeImageGeometry | TopViewGeometry],
        *,
        margin_m: float = MARGIN_M,
        turn_rad: float = 0.0,
    ) -> None:
        self._lines: Floats | None = None
        self._rows, self._kept = np.empty(0, np.int32), np.empty((0, 4), np.float32)
        ahead = [_ahead(view) for view in views if isinstance(view, TopViewGeometry)]
        ranged = [view for view in views if isinstance(view, RangeImageGeometry)]
        sectors = [
            (math.radians(view.azimuth_left_deg), math.radians(view.azimuth_right_deg)) for view in ranged
        ] or ahead
        left = max((sector[0] for sector in sectors), default=math.inf)
        right = min((sector[1] for sector in sectors), default=0.0)
        if left - right <= math.pi:
            inward = np.array([(math.sin(left), -math.cos(left)), (-math.sin(right), math.cos(right))])
            hulls = [_hull(view, margin_m) for view in views]
            nearest = [(inward @ corners.T - beside).min(axis=1) for corners, beside in hulls]
            cos, sin = math.cos(turn_rad), math.sin(turn_rad)
            self._lines = np.column_stack([inward @ np.array([(cos, sin), (-sin, cos)]), np.min(nearest, axis=0)])

    def select(self, points: Points) -> tuple[Floats32, Ints | None]:
        """The points that matter, in their order, overwritten by the next call, and their rows in ``points``;
        ``points`` and None if all matter. Rows that are not finite are left out.
        """
        if self._lines is None:
            return points, None
        if len(points) >= len(self._rows):
            room = len(points) + 1  # the kernel writes every point, then decides whether to keep it
            self._rows, self._kept = np.empty(room, np.int32), np.empty((room, 4), np.float32)
        n = fill_rows(read_only(points), self._lines, self._rows, self._kept)
        return read_only(self._kept[:n]), self._rows[:n]


def sectors_of_turn(view: RangeImageGeometry) -> list[tuple[float, Crop]]:
    """The sectors of a full turn: angle of each to the left of the first [rad], and what selects its points."""
    width_deg = view.azimuth_left_deg - view.azimuth_right_deg
    turns_rad = [math.radians(k * width_deg) for k in range(math.ceil(360.0 / width_deg))]
    return [(turn_rad, Crop([view], margin_m=ROUNDING_M, turn_rad=turn_rad)) for turn_rad in turns_rad]


def spread(parts: Sequence[tuple[PointLabels, Ints | None]], n: int) -> PointLabels:
    """Labels of all ``n`` points of a scan from those of parts of it, with their rows from `Crop.select`.

    A point in view of several parts has the label of the first one; one in no part is out of view.
    """
    first, first_rows = parts[0]
    if len(parts) == 1 and first_rows is None:
        return first
    labels, in_view = np.zeros(n, np.uint8), np.zeros(n, np.bool_)
    for part, rows in reversed(parts):
        every = np.arange(n, dtype=np.int32) if rows is None else rows
        fill_spread(every, read_only(part.labels, np.uint8), read_only(part.in_view, np.bool_), labels, in_view)
    return PointLabels(labels, in_view, first.classes)


def _ahead(view: TopViewGeometry) -> tuple[float, float]:
    """Azimuths between which all cells lie [rad]; the full turn for a view that is not ahead."""
    if view.x_range_m[0] <= 0.0:
        return math.pi, -math.pi
    azimuths = [math.atan2(y, x) for x in view.x_range_m for y in view.y_range_m]
    return max(azimuths), min(azimuths)


def _hull(view: RangeImageGeometry | TopViewGeometry, margin_m: float) -> tuple[Floats, Floats]:
    """Corners of the least region that must be kept between two lines, and the margin around each [m]."""
    if isinstance(view, RangeImageGeometry):
        return np.zeros((1, 2)), np.array([margin_m])  # the sector's own edges are the directions of the lines
    x, y = view.x_range_m, view.y_range_m
    if x[0] <= 0.0:
        x, y = (x[0], max(x[1], 0.0)), (min(y[0], 0.0), max(y[1], 0.0))
    corners = np.array([(each_x, each_y) for each_x in x for each_y in y])
    hull = np.concatenate([np.zeros((1, 2)), FARTHER * corners, corners])
    return hull, np.repeat([view.cell_m, BOX_BESIDE_M], [5, 4])


@njit(cache=True, nogil=True)
def fill_rows(points: Points, lines: Floats, rows: Rows, kept: Floats32) -> int:
    """Copy the points with a x + b y >= c for both lines (a, b, c), and their rows; returns their number."""
    a, b, c = lines[0]
    d, e, f = lines[1]
    n = 0
    for i in range(points.shape[0]):  # without a branch: a third of the time
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        rows[n] = i
        kept[n, 0], kept[n, 1], kept[n, 2], kept[n, 3] = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
        n += 1 if (a * x + b * y >= c) & (d * x + e * y >= f) else 0
    return n


@njit(cache=True, nogil=True)
def fill_spread(rows: Rows, labels: Labels, in_view: Mask, all_labels: Bytes, all_in_view: Mask) -> None:
    """Write the labels of points in view to their rows in a whole scan.

    all_in_view : (n,) bool, modified; true at these rows.
    """
    for k in range(rows.shape[0]):
        if in_view[k]:
            all_labels[rows[k]] = labels[k]
            all_in_view[rows[k]] = True
