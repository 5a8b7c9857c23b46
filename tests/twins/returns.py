"""Slow twin of what is a return of the world."""

from __future__ import annotations

import numpy as np


def returns(
    points: np.ndarray,
    min_range_m: float,
    origin: tuple[float, float] = (0.0, 0.0),
    ego_box: tuple[float, ...] | None = None,
) -> tuple[np.ndarray, tuple[int, ...]]:
    """Twin of `returns.returns`: the points, and the number that are not finite, too near and of the ego."""
    out = points.copy()
    counts = [0, 0, 0]
    for i, (x, y, z, _) in enumerate(points.astype(np.float64)):
        place = np.array([x - origin[0], y - origin[1], z])
        if not np.isfinite([x, y, z]).all():
            kind = 0
        elif (place**2).sum() <= (min_range_m * (1.0 + 1e-6)) ** 2:
            kind = 1
        elif ego_box is not None and all(low <= v <= high for v, (low, high) in zip(place, ego_box, strict=True)):
            kind = 2
        else:
            continue
        counts[kind] += 1
        out[i] = np.nan
    known = np.sort([r for *_, r in out if np.isfinite(r)])
    for row in out:
        if np.isfinite(row[:3]).all() and not np.isfinite(row[3]):
            row[3] = np.median(np.asarray(known, np.float64)) if len(known) else 0.0
    return out, tuple(counts)
