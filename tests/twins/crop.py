"""Slow twin of the selection of points near the views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def kept_rows(points: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc.inference.crop.fill_rows`: the rows of the points between the lines."""
    x, y = points[:, :2].T.astype(np.float64)
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(np.all([a * x + b * y >= c for a, b, c in lines], axis=0))


def spread(parts: Sequence[Any], n: int) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.inference.crop.spread`: the first part in whose view a point is."""
    labels, in_view = np.zeros(n, np.uint8), np.zeros(n, bool)
    for part, rows in parts:
        for k, row in enumerate(rows):
            if part.in_view[k] and not in_view[row]:
                labels[row], in_view[row] = part.labels[k], True
    return labels, in_view
