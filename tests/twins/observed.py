"""Slow twins of the observed cells."""

from __future__ import annotations

import numpy as np


def lowest_returns(points, bounds, grid, shape):
    """Twin of `edgeperc.observed.fill_lowest_returns`."""
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


def rays(lowest, ring_m, z_beams, first_gradient, max_apart):
    """Twin of `edgeperc.observed.follow_rays`: first the returns on the ground, then what lies between two of them."""
    middles = (np.arange(lowest.shape[1]) + 0.5) * ring_m
    level, seen = np.empty_like(lowest), np.zeros(lowest.shape, bool)
    for z_of, level_of, seen_of in zip(lowest.astype(np.float64), level, seen, strict=True):
        ground, below = [(-1, 0.0, -1.73)], []
        for ring in np.flatnonzero(np.isfinite(z_of)).tolist():
            _, x_last, z_last = ground[-1]
            rise, limit = z_of[ring] - z_last, 0.1 + 0.1 * min(middles[ring] - x_last, 5.0)
            seen_of[ring] = rise <= 2.0
            if abs(rise) <= limit:
                ground.append((ring, middles[ring], z_of[ring]))
            elif rise < 0.0:
                below.append(ring)
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
    return level, seen


def cells(points, index, bin_of_cell, level, seen):
    """Twin of `edgeperc.observed.mark_cells`."""
    flat = index.reshape(-1)
    top = np.full(flat.shape, np.inf)
    top[flat >= 0] = points[flat[flat >= 0], 2]
    near = top - level.reshape(-1)[bin_of_cell].astype(np.float64) <= 2.0
    return (seen.reshape(-1)[bin_of_cell] | near).reshape(index.shape)
