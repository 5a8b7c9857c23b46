"""Slow twins of the observed cells."""

from __future__ import annotations

import numpy as np


def lowest_returns(points: np.ndarray, bounds: np.ndarray, grid: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Twin of `edgeperc.ground.observed.fill_lowest_returns`."""
    first, per_unit, ring_m = grid
    x, y = points[:, :2].T.astype(np.float64)
    z = points[:, 2]
    inside = (x >= bounds[0, 0]) & (x <= bounds[0, 1]) & (y >= bounds[1, 0]) & (y <= bounds[1, 1])
    inside &= np.isfinite(z) & ((x != 0.0) | (y != 0.0))
    x, y, z = x[inside], y[inside], z[inside]
    azimuth = y / (np.abs(x) + np.abs(y))
    azimuth[x < 0.0] = np.copysign(2.0, y[x < 0.0]) - azimuth[x < 0.0]
    sector = (azimuth - first) * per_unit
    ring = np.sqrt(x * x + y * y) * (1.0 / ring_m)
    kept = (sector >= 0.0) & (sector < shape[0]) & (ring < shape[1])
    lowest = np.full(shape, np.inf, np.float32)
    np.minimum.at(lowest, (sector[kept].astype(int), ring[kept].astype(int)), z[kept])
    return lowest


def rays(lowest: np.ndarray, rays: np.ndarray, steps: np.ndarray, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `observed.follow_rays`: the returns on the ground, what lies between two of them, bridges."""
    ring_m, z_beams, first_gradient, max_apart = rays
    middles = (np.arange(lowest.shape[1]) + 0.5) * ring_m
    level, state = np.empty_like(lowest), np.zeros(lowest.shape, np.uint8)
    for z_of, level_of, state_of, tilted in zip(lowest.astype(np.float64), level, state, tilt, strict=True):
        seen_of = np.zeros(len(z_of), bool)
        ground, below, standing = [(-1, 0.0, -1.73)], [], []
        for ring in np.flatnonzero(np.isfinite(z_of)).tolist():
            _, x_last, z_last = ground[-1]
            rise, limit = z_of[ring] - z_last, 0.1 + 0.1 * min(middles[ring] - x_last, 5.0)
            seen_of[ring] = rise <= 2.0
            if abs(rise) <= limit:
                ground.append((ring, middles[ring], z_of[ring]))
            elif rise < 0.0:
                below.append(ring)
            elif rise <= 2.0:
                standing.append(ring)
        for k, (ring, x, z) in enumerate(ground):
            level_of[max(ring, 0) :] = z
            if k == 0:
                continue
            last, x_last, z_last = ground[k - 1]
            begin = max([last, *(r for r in below if last < r < ring)]) + 1
            level_of[last + 1 : begin] = z_last
            back = (x - middles[begin:ring]) / (x - x_last)
            level_of[begin:ring] = z - (z - z_last) * back
            gradient = first_gradient if k == 1 else (z_last - z_beams) / x_last
            if (z - z_beams) / x - gradient > max_apart:
                continue
            height = z_beams + (z - z_beams) * x_last / x - z_last
            seen_of[begin:ring] |= back <= (0.5 / height if height > 0.5 else 1.0)
        state_of[seen_of] = 1
        for k, (last, x_last, z_last) in enumerate(ground):
            end = ground[k + 1][0] if k + 1 < len(ground) else len(z_of)
            gradient = first_gradient if k == 0 else (z_last - z_beams) / x_last
            step = steps[min(max(int(-(gradient + tilted) / 0.005), 0), len(steps) - 1)]
            nexts = [r for r in standing if last < r < end]
            nexts = (nexts if k == 0 else nexts[:1]) + [end] * (end < len(z_of) and (k == 0 or not nexts))
            for ring in nexts:
                begin = max([last, *(r for r in below if last < r < ring)]) + 1
                x, z = middles[ring], z_of[ring]
                height, foot = z_beams + (z - z_beams) * x_last / x - z_last, 0.0 if ring == end else z - z_last
                close = k == 0 or (z - z_beams) / x - gradient <= step
                highest = 0.8 if close and k > 0 else 0.5
                if foot <= highest:
                    passing = foot + (height - foot) * (x - middles[begin:ring]) / (x - x_last)
                    state_of[begin:ring][(passing <= highest) & ~seen_of[begin:ring]] = 2 if close else 3
    return level, state


def sectors(state: np.ndarray) -> np.ndarray:
    """States with `PASSED` bins `BETWEEN` where both neighboring sectors are known."""
    known = (state == 1) | (state == 2)
    bridged = (state == 3) & np.pad(known, ((1, 0), (0, 0)))[:-1] & np.pad(known, ((0, 1), (0, 0)))[1:]
    return np.where(bridged, np.uint8(2), state)


def cells(
    points: np.ndarray, index: np.ndarray, bin_of_cell: np.ndarray, level: np.ndarray, state: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.ground.observed.mark_cells`."""
    flat = index.reshape(-1)
    top = np.full(flat.shape, np.inf)
    top[flat >= 0] = points[flat[flat >= 0], 2]
    near = top - level.reshape(-1)[bin_of_cell].astype(np.float64) <= 2.0
    state = sectors(state).reshape(-1)[bin_of_cell].reshape(index.shape)
    observed = (state == 1) | near.reshape(index.shape)
    return observed, (state == 2) & ~observed
