"""Twins of `edgeperc.camera.calibration` and `edgeperc.camera.painting`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def projected(points: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Twin of `fill_projected`."""
    u, v, depth = np.full((3, len(points)), np.nan)
    for i, row in enumerate(np.asarray(points, np.float64)):
        if np.isfinite(row[:3]).all():
            x, y, depth[i] = P @ [*row[:3], 1.0]
            if depth[i] > 0.0:
                u[i], v[i] = x / depth[i], y / depth[i]
    return u, v, depth


def nearest(
    points: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
    between: np.ndarray,
    half_up: np.ndarray,
    half_down: np.ndarray,
    half_side: np.ndarray,
    cell_h: int,
    cell_w: int,
    shape: tuple[int, ...],
    max_cells: int,
) -> np.ndarray:
    """Twin of `fill_nearest`: the window of each point as a slice of the buffer."""
    buffer = np.full(shape, np.inf, np.float32)
    for (x, y, z), column, row, d in zip(np.asarray(points, np.float64)[:, :3], u, v, depth, strict=True):
        if not 0.0 < d < np.inf:
            continue
        level = math.hypot(x, y)
        beam = sum(z < edge * level for edge in between.tolist())
        apart = math.sqrt(x * x + y * y + z * z) / d
        up, down = (min(half[beam] * apart, max_cells * cell_h) for half in (half_up, half_down))
        side = min(half_side * apart * level / d, max_cells * cell_w)
        ends = (row + 0.5 - up) / cell_h, (row + 0.5 + down) / cell_h
        sides = (column + 0.5 - side) / cell_w, (column + 0.5 + side) / cell_w
        top, bottom, left, right = np.clip(np.floor([*ends, *sides]), -1, 10**6).astype(int)
        window = buffer[max(top, 0) : max(bottom + 1, 0), max(left, 0) : max(right + 1, 0)]
        np.minimum(window, np.float32(d), out=window)
    return buffer


def painted(
    labels: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    depth: float,
    buffer: Any,
    cell_h: int,
    cell_w: int,
    slack_m: float,
    slack_share: float,
) -> np.ndarray:
    """Twin of `fill_painted`, all points at once."""
    with np.errstate(invalid="ignore"):
        row, column = np.floor(v + 0.5), np.floor(u + 0.5)
        inside = (row >= 0) & (row < labels.shape[0]) & (column >= 0) & (column < labels.shape[1])
        row, column = (np.where(inside, each, 0).astype(int) for each in (row, column))
        near = buffer[row // cell_h, column // cell_w].astype(np.float64)
        seen = inside & (depth <= near + slack_m + slack_share * near)
    return np.where(seen, labels[row, column], 255).astype(np.uint8)
