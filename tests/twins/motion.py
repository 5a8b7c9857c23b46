"""Slow twins of motion and zones."""

from __future__ import annotations

from fractions import Fraction

import numpy as np


def exponential(matrix: np.ndarray) -> np.ndarray:
    """Exponentials of matrices (..., n, n), by the series of a small part of each, squared as often as needed."""
    n = max(0, int(np.ceil(np.log2(np.abs(matrix).max(initial=0.0) + 1e-300)))) + 4
    term = total = np.eye(matrix.shape[-1])
    for k in range(1, 20):
        term = term @ matrix / (k * 2.0**n)
        total = total + term
    for _ in range(n):
        total = total @ total
    return total


def screw(velocity: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """The (4, 4) matrix whose exponential is the pose after one second."""
    x, y, z = rate
    return np.array([[0, -z, y, velocity[0]], [z, 0, -x, velocity[1]], [-y, x, 0, velocity[2]], [0, 0, 0, 0]], float)


def deskewed(points: np.ndarray, after_s: np.ndarray, velocity: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc.preprocess.motion.fill_deskewed`."""
    moved = points.copy()
    for i, seconds in enumerate(after_s):
        with np.errstate(invalid="ignore", over="ignore"):
            good = np.isfinite(points[i, :3]).all() and np.isfinite(seconds)
            pose = exponential(screw(velocity, rate) * seconds) if good else np.full((4, 4), np.nan)
            moved[i, :3] = (pose @ [*points[i, :3].astype(float), 1.0])[:3]
    return moved


def inside(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc.tracking.zones.mark_inside`: how often each point sees an edge above it, in fractions."""
    found = []
    for point in points.tolist():
        odd = False
        if np.isfinite(point).all():
            x, y = map(Fraction, point)
            for a, b in zip(polygon.tolist(), [*polygon.tolist()[1:], polygon.tolist()[0]], strict=True):
                (ax, ay), (bx, by) = sorted([tuple(map(Fraction, a)), tuple(map(Fraction, b))])
                if ax <= x < bx and y < ay + (by - ay) * (x - ax) / (bx - ax):
                    odd = not odd
        found.append(odd)
    return np.array(found, np.bool_)
