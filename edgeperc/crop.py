"""Leave out the points of a scan that no view shows and that belong to no object in a view.

A network that looks ahead sees a quarter of the turn. The ground is found with all points. What follows takes half the
time without the points behind and beside the vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .card import RangeImageGeometry, TopViewGeometry
from .kernel_cache import njit
from .observed import FARTHER
from .perception import PointLabels
from .points import read_only

__all__ = ["MARGIN_M", "Crop", "fill_rows", "spread"]

MARGIN_M = 5.0
"""Points up to this far beside a range image are kept [m]: a car at its edge is clustered as a whole."""

HalfPlane = tuple[float, float, float]
"""a, b and c: points with a x + b y >= c are kept."""
_EVERYTHING = (0.0, 0.0, -math.inf)


class Crop:
    """Select the points that matter for some views.

    The selected points are kept in buffers that are used again, so use one instance per thread.

    Parameters
    ----------
    views : sequence of RangeImageGeometry or TopViewGeometry
        Of a range image, the sector and `MARGIN_M` beside it are kept. Of a top view, what `edgeperc.observed.Observer`
        uses: up to 1.4 times as far as the view, between the directions of its sides. Without a view, all is kept.
    """

    def __init__(self, views: Sequence[RangeImageGeometry | TopViewGeometry]) -> None:
        regions: list[list[HalfPlane]] = []
        for view in views:
            regions += _sector(view) if isinstance(view, RangeImageGeometry) else [_ahead(view)]
        most = max(map(len, regions), default=0)
        padded = [[*region, *[_EVERYTHING] * (most - len(region))] for region in regions]
        self._regions = np.array(padded, np.float64).reshape(len(regions), most, 3)
        self._keeps_all = most == 0 or not all(map(len, regions))
        self._rows, self._kept = np.empty(0, np.int32), np.empty((0, 4), np.float32)

    def select(self, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32] | None]:
        """The points that matter, in their order.

        Parameters
        ----------
        points : (n, 4) float32
            x, y, z [m] in the frame of the models, remission. Rows that are not finite are left out.

        Returns
        -------
        kept : (m, 4) float32
            Overwritten by the next call, unless it is ``points``.
        rows : (m,) int32 or None
            Their rows in ``points``. None if all points matter; ``kept`` is then ``points``.
        """
        if self._keeps_all:
            return points, None
        if len(points) > len(self._rows):
            self._rows, self._kept = np.empty(len(points), np.int32), np.empty((len(points), 4), np.float32)
        n = fill_rows(read_only(points), self._regions, self._rows, self._kept)
        return read_only(self._kept[:n]), self._rows[:n]


def spread(points: PointLabels, rows: NDArray[np.int32], n: int) -> PointLabels:
    """Labels of a whole scan of ``n`` points, from those of its ``rows``; the others are out of view."""
    labels, in_view = np.zeros(n, np.uint8), np.zeros(n, np.bool_)
    labels[rows], in_view[rows] = points.labels, points.in_view
    return PointLabels(labels, in_view, points.classes)


def _sector(view: RangeImageGeometry) -> list[list[HalfPlane]]:
    """The regions that a range image and its margin consist of; a region without half planes is everything."""
    left, right = math.radians(view.azimuth_left_deg), math.radians(view.azimuth_right_deg)
    if left - right >= 2.0 * math.pi:
        return [[]]
    within_left = math.sin(left), -math.cos(left), -MARGIN_M
    within_right = -math.sin(right), math.cos(right), -MARGIN_M
    return [[within_left, within_right]] if left - right <= math.pi else [[within_left], [within_right]]


def _ahead(view: TopViewGeometry) -> list[HalfPlane]:
    """The region that the rays to a top view's cells cross, and the cells behind them."""
    (near, far), (low, high) = view.x_range_m, view.y_range_m
    bounds = [
        (1.0, 0.0, FARTHER * min(near, 0.0)),
        (-1.0, 0.0, -FARTHER * max(far, 0.0)),
        (0.0, 1.0, FARTHER * min(low, 0.0)),
        (0.0, -1.0, -FARTHER * max(high, 0.0)),
    ]
    if near <= 0.0:  # rays in all directions, or backwards
        return bounds
    left, right = (math.atan2(y, near if y * side > 0.0 else far) for y, side in ((high, 1.0), (low, -1.0)))
    edge = -view.cell_m  # against rounding
    return [*bounds, (math.sin(left), -math.cos(left), edge), (-math.sin(right), math.cos(right), edge)]


@njit(cache=True, nogil=True)
def fill_rows(
    points: NDArray[np.float32], regions: NDArray[np.float64], rows: NDArray[np.int32], kept: NDArray[np.float32]
) -> int:
    """Copy the points that lie in a region.

    Parameters
    ----------
    points : (n, 4) float32, C-contiguous
    regions : (k, half planes, 3) float64
        a, b and c of the half planes a x + b y >= c. A point lies in a region if it lies in all of its half planes.
    rows : (n or more,) int32, overwritten
        Rows of the points that lie in a region.
    kept : (n or more, 4) float32, overwritten
        Those points.

    Returns
    -------
    int
        Number of these points.
    """
    n = 0
    for i in range(points.shape[0]):
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        for k in range(regions.shape[0]):
            is_inside = True
            for h in range(regions.shape[1]):
                is_inside &= regions[k, h, 0] * x + regions[k, h, 1] * y >= regions[k, h, 2]
            if is_inside:
                rows[n] = i
                for c in range(4):
                    kept[n, c] = points[i, c]
                n += 1
                break
    return n
