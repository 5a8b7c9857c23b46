"""Slow twin of what is counted of window and weather."""

from __future__ import annotations

import math

import numpy as np


def sectors(
    points: np.ndarray, eye: np.ndarray, step: int, tans: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Twin of `health.fill_sectors`, with the true arc tangent: counts (72, 4), ranges (256,) and the numbers."""
    counts, ranges, n, n_low = np.zeros((72, 4)), np.zeros(256), 0, 0
    for point in points[::step].astype(np.float64):
        x, y, z = point[:3] - eye
        r = math.sqrt(x * x + y * y + z * z) if np.isfinite([x, y, z]).all() else math.nan
        if not 0.3 < r < math.inf:
            continue
        n += 1
        ranges[int(min(r, 255.0))] += 1
        tan = z / math.hypot(x, y) if math.hypot(x, y) > 0.0 else math.copysign(math.inf, z)
        band = 0 if tan < tans[0] else 1 if tan < tans[1] else 2
        n_low += z <= tans[2] * math.hypot(x, y)
        sector = min(int((math.atan2(y, x) % (2.0 * math.pi)) * 72 / (2.0 * math.pi)), 71)
        counts[sector, band] += 1
        counts[sector, 3] += 1
    return counts, ranges, n, n_low


def isolated(
    points: np.ndarray, eye: np.ndarray, wedge: float, most: int, dim: float, radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `health.mark_isolated`: counts (4, 3), and the points with at most ``most`` others in other
    places."""
    counts, mark = np.zeros((4, 3), np.int64), np.zeros(len(points), np.bool_)
    xyz = points[:, :3].astype(np.float64) - eye
    with np.errstate(invalid="ignore", over="ignore"):
        flat = np.sort(np.abs(xyz[:, :2]), axis=1)
        chosen = (flat[:, 0] <= wedge * flat[:, 1]) & ((xyz**2).sum(axis=1) < 100.0)
    for i in np.flatnonzero(chosen):
        x, y, z = xyz[i]
        side = (0 if x > 0.0 else 2) if abs(x) >= abs(y) else (1 if y > 0.0 else 3)
        around = max(radius[0] * math.sqrt(x * x + y * y + z * z), radius[1])
        squares = ((points[chosen, :3].astype(np.float64) - points[i, :3].astype(np.float64)) ** 2).sum(axis=1)
        counts[side, 0] += 1
        is_dim = bool(points[i, 3] < dim)
        if np.count_nonzero((squares > 0.0) & (squares <= around * around)) <= most + is_dim:
            counts[side, 1] += 1
            counts[side, 2] += is_dim
            mark[i] = True
    return counts, mark


def lacking(counts: np.ndarray, fewest: np.ndarray) -> np.ndarray:
    """Twin of `health.fill_lacking`."""
    lacks = np.zeros(counts.shape, np.bool_)
    for column in range(counts.shape[1]):
        seen = sorted(counts[counts[:, column] > 0.0, column])
        usual = seen[len(seen) // 2] if seen else 0.0
        expected = np.minimum(usual, fewest[:, column])
        lacks[:, column] = (expected >= 6.0) & (counts[:, column] <= 0.1 * expected)
    return lacks
