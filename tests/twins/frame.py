"""Twin of `edgeperc.types.frame`."""

from __future__ import annotations

import numpy as np


def moved(points: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Points moved by a rotation and a translation, one after another."""
    rows = []
    for x, y, z, remission in np.asarray(points, np.float64):
        with np.errstate(over="ignore", invalid="ignore"):
            rows.append([*(R[:, 0] * x + R[:, 1] * y + R[:, 2] * z + t), remission])
    with np.errstate(over="ignore"):
        return np.array(rows, np.float64).reshape(-1, 4).astype(np.float32)


def turned(points: np.ndarray, angle_rad: float) -> np.ndarray:
    """Twin of `edgeperc.types.frame.turned`, one operation of numpy after another."""
    found = points.copy()
    cos, sin = np.float32(np.cos(angle_rad)), np.float32(np.sin(angle_rad))
    with np.errstate(over="ignore", invalid="ignore"):
        found[:, 0] = cos * points[:, 0] + sin * points[:, 1]
        found[:, 1] = cos * points[:, 1] - sin * points[:, 0]
    return found
