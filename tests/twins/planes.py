"""Slow twins of finding the ground."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np


def draws(draw: int) -> Any:
    """Twin of the draws in `edgeperc.ground.planes.find_plane`: numbers in 0..1 without end."""
    while True:
        draw = (draw * 1103515245 + 12345) & 0x7FFFFFFF
        yield draw / 2**31


def consensus_plane(
    residuals: np.ndarray, max_slope: float, max_shift: float, n_hypotheses: int, seed: int
) -> np.ndarray:
    """Twin of `edgeperc.ground.planes.find_plane`."""
    tested = residuals[:: -(-len(residuals) // 1024) or 1]

    def support(plane: np.ndarray) -> int:
        gap = tested[:, 2] - plane[0] * tested[:, 0] - plane[1] * tested[:, 1] - plane[2]
        return (abs(gap) <= 0.1).sum() - (gap < -0.1).sum()

    best = np.zeros(3)
    draw = draws(seed)
    for _ in range(n_hypotheses if len(tested) else 0):
        p, q, r = tested[[int(next(draw) * len(tested)) for _ in range(3)]]
        (x1, y1, z1), (x2, y2, z2) = q - p, r - p
        area = x1 * y2 - x2 * y1
        if abs(area) < 1.0:
            continue
        a, b = (z1 * y2 - z2 * y1) / area, (x1 * z2 - x2 * z1) / area
        plane = np.array([a, b, p[2] - a * p[0] - b * p[1]])
        if (abs(plane) <= [max_slope, max_slope, max_shift]).all() and support(plane) > support(best):
            best = plane
    return best


def refined_plane(
    residuals: np.ndarray, prior: float, max_slope: float, max_shift: float, plane: np.ndarray
) -> tuple[int, np.ndarray]:
    """Twin of `planes.refine_plane`: support and plane, by two more rows that say what no slope weighs."""
    on = abs(residuals[:, 2] - residuals[:, :2] @ plane[:2] - plane[2]) <= 0.1
    if not on.any():
        return 0, plane
    middle = residuals[on].mean(axis=0)
    rows = np.r_[residuals[on] - middle, np.sqrt(prior) * np.eye(3)[:2]]
    moments = rows[:, :2].T @ rows[:, :2]
    product = moments[0, 0] * moments[1, 1]
    if product == 0 or np.linalg.det(moments) < 1e-3 * product:
        return 0, plane
    slope = np.linalg.lstsq(rows[:, :2], rows[:, 2], rcond=None)[0]
    refined = np.array([*slope, middle[2] - slope @ middle[:2]])
    return on.sum(), refined if (abs(refined) <= [max_slope, max_slope, max_shift]).all() else plane


def ground_heights(
    points: np.ndarray, mount_height_m: float, regions: bool = True
) -> tuple[np.ndarray, np.ndarray | None]:
    """Twin of `edgeperc.ground.planes.find_ground`: heights (n,), and the first plane or None."""
    xyz = points[:, :3].astype(np.float64)
    finite = np.isfinite(xyz).all(axis=1)
    inside = finite & (abs(points[:, :2]) < np.float32(64.0)).all(axis=1)
    cell = np.full((len(points), 2), -1)
    cell[inside] = np.minimum(((points[inside, :2] + np.float32(64.0)) * np.float32(2.0)).astype(int), 255)
    lowest = {}
    for i in np.flatnonzero(inside):
        at = tuple(cell[i].tolist())
        if at not in lowest or points[i, 2] < points[lowest[at], 2]:
            lowest[at] = i

    def residuals(
        first_row: int, first_col: int, size: int, middle: Any, expected: np.ndarray, band: float, cone: float
    ) -> np.ndarray:
        area = [(r, c) for r in range(first_row, first_row + size) for c in range(first_col, first_col + size)]
        rows = xyz[[lowest[at] for at in area if at in lowest]].reshape(-1, 3)
        rows[:, :2] -= middle
        rows[:, 2] -= expected[0] * rows[:, 0] + expected[1] * rows[:, 1] + expected[2]
        return rows[abs(rows[:, 2]) <= band + cone * np.hypot(rows[:, 0], rows[:, 1])]

    first = np.array([0.0, 0.0, -mount_height_m])
    near = residuals(88, 88, 80, np.zeros(2), first, 0.5, 0.3)
    support, fitted = refined_plane(near, 0.0, 0.3, 0.5, consensus_plane(near, 0.3, 0.5, 100, 1))
    found = support >= 30
    if found:
        first = first + fitted
    if not (found and regions):
        heights = np.full(len(points), np.nan)
        heights[finite] = xyz[finite, 2] - xyz[finite, :2] @ first[:2] - first[2]
        return heights, first if found else None

    middles = (np.arange(16) + 0.5) * 8.0 - 64.0
    planes, solved = np.zeros((16, 16, 3)), np.zeros((16, 16))
    by_ring = sorted(np.ndindex(16, 16), key=lambda at: (max(abs(2 * at[0] - 15), abs(2 * at[1] - 15)), at))
    for r, q in by_ring:
        middle = middles[[r, q]]
        near_by = [at for at in np.ndindex(16, 16) if max(abs(at[0] - r), abs(at[1] - q)) <= 1]
        around = [] if {r, q} <= {7, 8} else [at for at in near_by if solved[at]]
        expected = np.array([*first[:2], first[2] + first[:2] @ middle])
        if around:
            moved = [[*planes[at][:2], planes[at][2] + planes[at][:2] @ (middle - middles[list(at)])] for at in around]
            expected = np.average(moved, axis=0, weights=[solved[at] for at in around])
        near = residuals(16 * r, 16 * q, 16, middle, expected, 0.8, 0.0)
        planes[r, q], solved[r, q] = expected, 1.0
        if len(near) >= 6:
            fitted = consensus_plane(near, 0.12, 0.5, 24, 16 * r + q)
            support, fitted = refined_plane(near, 4 * 64.0 / 12.0, 0.12, 0.5, fitted)
            if support >= 6:
                planes[r, q] += fitted
                solved[r, q] += support

    level, step = {}, {}
    for at, i in lowest.items():
        place = (np.array(at) + 0.5) * 0.5 - 64.0
        u, v = np.clip((place + 64.0) / 8.0 - 0.5, 0.0, 15.0)
        ground, slope = 0.0, np.zeros(2)
        for r, q in itertools.product({int(u), min(int(u) + 1, 15)}, {int(v), min(int(v) + 1, 15)}):
            weight = max(1 - abs(u - r), 0) * max(1 - abs(v - q), 0)
            ground += weight * (planes[r, q, 2] + planes[r, q, :2] @ (place - middles[[r, q]]))
            slope += weight * planes[r, q, :2]
        level[at] = ground
        off = xyz[i, 2] - ground - slope @ (xyz[i, :2] - place)
        if abs(off) <= 0.3:
            step[at] = off
    heights = np.full(len(points), np.nan)
    for i in np.flatnonzero(finite):
        at = tuple(cell[i].tolist())
        if inside[i]:
            window = [(r, c) for r in range(at[0] - 2, at[0] + 3) for c in range(at[1] - 2, at[1] + 3)]
            near = [step[r, c] for r, c in window if (r, c) in step]
            region, place = (at[0] // 16, at[1] // 16), (np.array(at) + 0.5) * 0.5 - 64.0
            ground = level[at] + (sum(near) / (len(near) + 1) if len(near) >= 3 else 0.0)
        else:
            region = tuple(np.clip((xyz[i, :2] + 64.0) / 8.0, 0, 15).astype(int))
            place, ground = middles[list(region)], planes[region][2]
        heights[i] = xyz[i, 2] - ground - planes[region][:2] @ (xyz[i, :2] - place)
    return heights, first
