"""Slow twins of rendering remission and filling between beams."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np


def rendered(points: np.ndarray, function: Any, remission_range: tuple[float, float]) -> np.ndarray:
    """Twin of `edgeperc.preprocess.condition.render`."""
    low, high = remission_range
    out = points.copy()
    for i, raw in enumerate(points[:, 3].astype(np.float64)):
        x = (raw - low) / (high - low) * function.full_scale
        if not np.isfinite(x):
            out[i, 3] = np.nan
        elif function.kind == "logarithm":
            a, b = function.coefficients
            out[i, 3] = np.clip(a + b * np.log1p(max(x, 0.0)), 0.0, 1.0)
        elif function.kind == "power":
            a, b = function.coefficients
            out[i, 3] = np.clip(a * max(x, 0.0) ** b, 0.0, 1.0)
        else:
            out[i, 3] = np.clip(sum(c * x**k for k, c in enumerate(function.coefficients)), 0.0, 1.0)
    return out


def one_surface(p: np.ndarray, q: np.ndarray, ground_z: float) -> bool:
    """Whether a point may be put between two: KUL-Seg 5, never across a depth edge."""
    far, near = max(np.linalg.norm(p[:3]), np.linalg.norm(q[:3])), min(np.linalg.norm(p[:3]), np.linalg.norm(q[:3]))
    apart = np.linalg.norm(q[:3] - p[:3])
    if far - near <= 0.5 and far - near <= np.cos(np.radians(5.0)) * apart:
        return True
    at_ground = all(abs(r[2] - ground_z) <= 0.3 + 0.02 * np.linalg.norm(r[:3]) for r in (p, q))
    return at_ground and abs(q[2] - p[2]) <= 0.1 * apart


def between(
    points: np.ndarray,
    index: np.ndarray,
    elevations: np.ndarray,
    azimuths: np.ndarray,
    row_reach: Callable[..., Any],
    col_reach: Callable[..., Any],
    ground_z: float,
) -> tuple[np.ndarray, np.ndarray, list[tuple[Any, Any]]]:
    """Twin of `Interpolator.fill`: points, index, and the two neighbors of every new point."""
    points, index, parents = [p.astype(np.float64) for p in points], index.copy(), []
    height, width = index.shape

    def fill(line: list[tuple[int, int]], reach: Callable[[tuple[int, int]], int], offset: Callable[..., Any]) -> None:
        """Along one line of pixels (row, col); ``offset`` is how far a point lies from the middle of a pixel."""
        full = [k for k, at in enumerate(line) if index[at] >= 0]
        for start, stop in pairwise(full):
            i, j = index[line[start]], index[line[stop]]
            if not 1 < stop - start <= reach(line[start]) or not one_surface(points[i], points[j], ground_z):
                continue
            for at in line[start + 1 : stop]:
                one, other = offset(points[i], at), offset(points[j], at)
                if one * other < 0.0:
                    mixed = points[i] + one / (one - other) * (points[j] - points[i])
                    index[at] = len(points)
                    points.append(mixed.astype(np.float32).astype(np.float64))
                    parents.append((i, j))

    for row in range(height):
        fill(
            [(row, col) for col in range(width)],
            lambda at: col_reach,
            lambda p, at: p[0] * np.sin(azimuths[at[1]]) - p[1] * np.cos(azimuths[at[1]]),
        )
    for col in range(width):
        fill(
            [(row, col) for row in range(height)],
            lambda at: row_reach[at[0]],
            lambda p, at: p[2] - np.tan(elevations[at[0]]) * np.hypot(p[0], p[1]),
        )
    return np.array(points, np.float32).reshape(-1, 4), index, parents
