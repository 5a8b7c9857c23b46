"""Slow twin of the grid for navigation."""

from __future__ import annotations

import math

import numpy as np


def standing(
    points: np.ndarray,
    height_m: np.ndarray,
    corner: tuple[float, float, float],
    lowest: np.ndarray,
    overhead: float,
    shape: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.road.grid.fill_standing`."""
    highest, tallest = np.full(shape, -1, np.int32), np.full(shape, np.nan, np.float32)
    for row, col in np.ndindex(shape):
        inside = [
            i
            for i, (x, y) in enumerate(points[:, :2].astype(float).tolist())
            if math.isfinite(x)
            and math.isfinite(y)
            and math.floor((corner[0] - x) / corner[2]) == row
            and math.floor((corner[1] - y) / corner[2]) == col
            and height_m[i] <= overhead
        ]
        if inside:
            best = max(inside, key=lambda i: height_m[i])
            highest[row, col] = best
            if height_m[best] > lowest:
                tallest[row, col] = height_m[best]
    return highest, tallest
