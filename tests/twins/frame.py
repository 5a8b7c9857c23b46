"""Twin of `edgeperc.frame`."""

from __future__ import annotations

import numpy as np


def moved(points, R, t):
    """Points moved by a rotation and a translation, one after another."""
    rows = []
    for x, y, z, remission in np.asarray(points, np.float64):
        with np.errstate(over="ignore", invalid="ignore"):
            rows.append([*(R[:, 0] * x + R[:, 1] * y + R[:, 2] * z + t), remission])
    with np.errstate(over="ignore"):
        return np.array(rows, np.float64).reshape(-1, 4).astype(np.float32)
