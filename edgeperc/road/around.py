"""The road on all sides of the vehicle, from points that have a class of their own for it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..types.perception import ROADS, PointLabels
from ..types.points import Heights, Mask, Points
from ..types.views import TopViewGeometry

OTHER_GROUND = ("sidewalk", "terrain")
SECTOR_DEG = 0.5
RING_M = 0.2
ON_GROUND_M = 0.3
"""Points labeled as ground count up to this height above it [m]: labels bleed onto walls and legs."""


def knows_road(labels: PointLabels | None) -> bool:
    """Whether labels of points have a class on which a vehicle may drive."""
    return labels is not None and not set(ROADS).isdisjoint(labels.classes)


def nearest_is_road(points: Points, labels: PointLabels, height_m: Heights, view: TopViewGeometry) -> tuple[Mask, Mask]:
    """Cells whose nearest return of the ground, along their azimuth, is of the road; azimuths with points in view."""
    of_class = [1 if name in ROADS else -1 if name in OTHER_GROUND else 0 for name in labels.classes]
    side = np.array(of_class)[labels.labels]
    known = np.flatnonzero((side != 0) & labels.in_view & (np.abs(height_m) <= ON_GROUND_M))
    x, y = np.broadcast_arrays(*view.cell_centers())
    n_sectors, n_rings = round(360.0 / SECTOR_DEG), math.ceil(float(np.hypot(x, y).max()) / RING_M) + 1

    def bins(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.intp]:
        """Sector and ring of each place, as one number."""
        sector = np.floor(np.degrees(np.arctan2(y, x)) / SECTOR_DEG).astype(np.intp) % n_sectors
        return sector * n_rings + np.minimum(np.hypot(x, y) / RING_M, n_rings - 1).astype(np.intp)

    shape, rows = (n_sectors, n_rings), bins(points[known, 0], points[known, 1])
    votes = np.bincount(rows, side[known], minlength=n_sectors * n_rings).reshape(shape)
    has_returns = np.bincount(rows, minlength=n_sectors * n_rings).reshape(shape) > 0
    ring = np.arange(n_rings)
    inner = np.maximum.accumulate(np.where(has_returns, ring, -n_rings), axis=1)
    outer = np.minimum.accumulate(np.where(has_returns, ring, 3 * n_rings)[:, ::-1], axis=1)[:, ::-1]
    nearest = np.where(ring - inner <= outer - ring, inner, outer)
    exists = (nearest >= 0) & (nearest < n_rings)
    is_road = exists & (np.take_along_axis(votes, np.where(exists, nearest, 0), axis=1) > 0)
    at, shown = bins(x, y), points[labels.in_view & np.isfinite(height_m)].astype(np.float64)
    told = np.isin(np.arange(n_sectors), bins(shown[:, 0], shown[:, 1]) // n_rings)
    return is_road.reshape(-1)[at], told[at // n_rings]
