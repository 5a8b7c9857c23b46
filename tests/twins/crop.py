"""Slow twin of the selection of points near the views."""

from __future__ import annotations

import numpy as np


def kept_rows(points, lines):
    """Twin of `edgeperc.crop.fill_rows`: the rows of the points between the lines."""
    x, y = points[:, :2].T.astype(np.float64)
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(np.all([a * x + b * y >= c for a, b, c in lines], axis=0))


def spread(rows, labels, in_view, n):
    """Twin of `edgeperc.crop.fill_spread`."""
    all_labels, all_in_view = np.zeros(n, np.uint8), np.zeros(n, bool)
    all_labels[rows], all_in_view[rows] = labels, in_view
    return all_labels, all_in_view
