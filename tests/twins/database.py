"""Slow twins of drawing a scan from above."""

from __future__ import annotations

import math

import numpy as np


def picture(points: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc_export.database.files.picture`, point by point: round, clamp, keep the highest."""
    image, highest = np.zeros((400, 200, 3), np.uint8), {}
    for x, y, z, remission in points.astype(np.float64):
        if not (6 <= x <= 46 and -10 <= y <= 10 and -2.5 <= z <= 2.5 and np.isfinite(remission)):
            continue
        row = 399 - min(max(math.floor((x - 6) / 0.1 + 0.5), 0), 399)
        col = 199 - min(max(math.floor((y + 10) / 0.1 + 0.5), 0), 199)
        if z > highest.get((row, col), -math.inf):
            highest[row, col] = z
            shares = (math.hypot(x, y) / math.hypot(46, 10), (z + 2.5) / 5, min(max(remission, 0.0), 1.0))
            image[row, col] = [round(255 * share) for share in shares]
    return image
