"""Slow twins of casting rays."""

from __future__ import annotations

import numpy as np


def mixed(value: int) -> int:
    """splitmix64."""
    mask = 2**64 - 1
    value = (value + 0x9E3779B97F4A7C15) & mask
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & mask
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & mask
    return value ^ (value >> 31)


def uniform_draw(bits: int) -> float:
    return ((bits >> 11) + 0.5) / 2.0**53


def crossing(primitive: np.ndarray, direction: np.ndarray) -> tuple[float, float] | None:
    """Where a ray from the origin enters and leaves one primitive of `edgeperc.simulation.raycast`."""
    kind, matrix = int(primitive[0]), primitive[7:16].reshape(3, 3)
    front, rear, side = primitive[16:19] / 2.0
    start, way = matrix @ -primitive[4:7], matrix @ direction
    if kind == 2:  # the unit ball
        normals, curved = np.zeros((0, 3)), [0, 1, 2]
    elif kind == 1:  # the unit cylinder
        normals, curved = np.array([[0, 0, -1], [0, 0, 1.0]]), [0, 1]
    else:
        curved = []
        normals = np.array(
            [[0, 0, -1], [0, 0, 1], [1, 0, front], [-1, 0, rear], [0, 1, side], [0, -1, side]], dtype=float
        )
    offsets = 1.0 - np.concatenate([[0.0, 0.0], [front, rear, side, side]])[: len(normals)]
    enter, leave = -np.inf, np.inf
    for normal, offset in zip(normals, offsets, strict=True):
        rate, gap = normal @ way, offset - normal @ start
        if rate > 0:
            leave = min(leave, gap / rate)
        elif rate < 0:
            enter = max(enter, gap / rate)
        elif gap < 0:
            return None
    if curved:
        o, d = start[curved], way[curved]
        roots = np.roots([d @ d, 2 * o @ d, o @ o - 1])
        if np.iscomplex(roots).any():
            return None
        enter, leave = max(enter, roots.real.min()), min(leave, roots.real.max())
    return (enter, leave) if enter <= leave else None


def ground(scene, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height of the ground, and how far out of the roads, for arrays of x and y."""
    slope_x, slope_y, ax, kx, px, ay, ky, py = scene.terrain[:8]
    kerb, pavement, crown, bank, rise, rough, ditch, rounding = scene.terrain[8:16]
    outside, bays = np.full(np.shape(x), np.inf), np.full(np.shape(x), np.inf)
    for k, (x0, y0, cos, sin, curvature, right, left, first, last, is_bay) in enumerate(scene.strips):
        s, across = cos * (x - x0) + sin * (y - y0), cos * (y - y0) - sin * (x - x0)
        u = (across - curvature * s * s / 2) / np.sqrt(1 + (curvature * s) ** 2)
        d = np.max([u - left, right - u, first - s, s - last], axis=0)
        if is_bay:
            bays = np.minimum(bays, d)
        elif k == 0:
            outside, along = d, s
        else:
            outside = np.minimum(outside, d) - np.maximum(rounding - abs(outside - d), 0) ** 2 / (4 * rounding)
    z = slope_x * x + slope_y * y + ax * np.sin(kx * x + px) + ay * np.sin(ky * y + py)
    d = np.minimum(outside, bays)
    inside = crown * np.minimum(-d, 4.0) + scene.terrain[23] * (outside > 0)
    dropped = ((along + scene.terrain[21]) / 23.0) % 1.0 < 0.15
    verge = kerb * np.where(dropped, 0.25, 1.0) * np.minimum(d / 0.05, 1.0) + 0.02 * np.minimum(d, pavement)
    e = d - pavement
    slope = np.minimum(bank * e, rise) if rise > 0 else np.maximum(-bank * e, rise)
    size = len(scene.tile)
    row, column = np.floor(y / 0.3).astype(int), np.floor(x / 0.3).astype(int)
    b, a = y / 0.3 - row, x / 0.3 - column
    noise = sum(
        wy * wx * scene.tile[(row + i) % size, (column + j) % size]
        for i, wy in ((0, 1 - b), (1, b))
        for j, wx in ((0, 1 - a), (1, a))
    )
    grass = slope - ditch * np.maximum(1 - ((e - 1.6) / 1.2) ** 2, 0) + np.minimum(e / 0.3, 1) * rough * (1 + noise)
    return z + np.where(d <= 0, inside, verge + np.where(e > 0, grass, 0.0)), outside


def cast(primitives, scene, pose, elevations, azimuths, reach, key):
    """What each ray meets first, by trying every primitive and walking over the ground in steps of 5 mm."""
    shape = (len(elevations), len(azimuths))
    ranges, hits = np.full(shape, float(reach)), np.full(shape, -2)
    for b, elevation in enumerate(elevations):
        for column, azimuth in enumerate(azimuths):
            level = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
            direction = np.array([*level, np.sin(elevation)])
            steps = np.arange(0.0, reach, 0.005)
            world = pose[:3, :3] @ np.outer(direction, steps) + pose[:3, 3:4]
            below = np.flatnonzero(world[2] < ground(scene, world[0], world[1])[0])
            if len(below):
                ranges[b, column], hits[b, column] = steps[below[0]], -1
            ray = mixed((int(key) + b * len(azimuths) + column) & (2**64 - 1))
            for k, primitive in enumerate(primitives):
                found = crossing(primitive, direction)
                if found is None or found[1] <= 0:
                    continue
                t, draw = found[0], uniform_draw(mixed(ray ^ (k + 1)))
                if primitive[1] == 4:  # leaves: a free path
                    t = max(t, 0.0) - np.log(draw) / primitive[3]
                    if t >= found[1]:
                        continue
                elif t <= 0 or (primitive[1] == 5 and draw > primitive[3]):  # inside it, or through a gap
                    continue
                if t < ranges[b, column]:
                    ranges[b, column], hits[b, column] = t, k
    return ranges, hits
