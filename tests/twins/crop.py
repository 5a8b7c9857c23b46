"""Slow twin of the selection of points near the views."""

from __future__ import annotations

import numpy as np


def kept_rows(points, regions):
    """Twin of `edgeperc.crop.fill_rows`: the rows of the points that lie in a region."""
    x, y = points[:, :2].T.astype(np.float64)
    with np.errstate(invalid="ignore"):
        inside = [np.all([a * x + b * y >= c for a, b, c in region], axis=0) for region in regions]
    return np.flatnonzero(np.any(inside, axis=0)) if len(points) else np.zeros(0, np.int64)
