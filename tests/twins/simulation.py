"""Slow twins of the simulator's kernels (`edgeperc.simulation.raycast`)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from edgeperc.simulation.ray_draws import CLUMPS


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
        half, root = o @ d, (o @ d) ** 2 - (d @ d) * (o @ o - 1)
        if root < 0:
            return None
        enter, leave = max(enter, (-half - root**0.5) / (d @ d)), min(leave, (-half + root**0.5) / (d @ d))
    return (enter, leave) if enter <= leave else None


def cosine(primitive: np.ndarray, direction: np.ndarray, t: float) -> float:
    """Cosine between a ray and the normal of a primitive's surface where it enters: its most binding constraint."""
    kind, matrix = int(primitive[0]), primitive[7:16].reshape(3, 3)
    front, rear, side = primitive[16:19] / 2.0
    x, y, z = place = matrix @ (t * direction - primitive[4:7])
    ends = [(abs(z) - 1.0, np.array([0.0, 0.0, np.sign(z)]))]
    if kind == 2:
        surfaces = [(0.0, place)]
    elif kind == 1:
        surfaces = [*ends, (math.hypot(x, y) - 1.0, np.array([x, y, 0.0]))]
    else:
        surfaces = [
            *ends,
            (x + front * (z + 1) - 1, np.array([1.0, 0.0, front])),
            (-x + rear * (z + 1) - 1, np.array([-1.0, 0.0, rear])),
            (abs(y) + side * (z + 1) - 1, np.array([0.0, np.sign(y), side])),
        ]
    normal = matrix.T @ max(surfaces, key=lambda each: each[0])[1]
    return abs(normal @ direction) / np.linalg.norm(normal)


def placed(primitives: np.ndarray, poses: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Twin of `placed` of `raycast`."""
    out = primitives.copy()
    for row in out:
        x, y, z, yaw = poses[int(row[19])] if row[19] >= 0 else np.zeros(4)
        turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1.0]])
        row[4:7] = pose[:3, :3].T @ (turn @ row[4:7] + [x, y, z] - pose[:3, 3])
        row[7:16] = (row[7:16].reshape(3, 3) @ turn.T @ pose[:3, :3]).ravel()
    return out


def distance_to_segment(a: np.ndarray, b: np.ndarray) -> float:
    """Distance of the origin from a segment in the plane."""
    way = b - a
    share = np.clip(-(a @ way) / max(way @ way, 1e-300), 0.0, 1.0)
    return float(np.linalg.norm(a + share * way))


def bounds(primitives: np.ndarray) -> np.ndarray:
    """Twin of `fill_bounds`: from the eight corners, and the segments between each two of them seen from above."""
    out = np.full((len(primitives), 5), np.inf)
    for row, wanted in zip(primitives, out, strict=True):
        if not np.isfinite(row[4:16]).all():
            continue
        matrix = row[7:16].reshape(3, 3)
        half = matrix / (matrix**2).sum(axis=1, keepdims=True)
        corners = row[4:7] + np.array([*itertools.product((-1.0, 1.0), repeat=3)]) @ half
        middle = math.atan2(row[5], row[4])
        turns = (np.arctan2(corners[:, 1], corners[:, 0]) - middle + math.pi) % (2 * math.pi) - math.pi
        first, last, near = turns.min(), turns.max(), 0.0
        if last - first < math.pi:
            near = min(distance_to_segment(a[:2], b[:2]) for a, b in itertools.combinations(corners, 2))
        else:
            first, last = -math.pi, math.pi
        closest, farthest = max(near, 1e-3), np.hypot(corners[:, 0], corners[:, 1]).max()
        low, high = corners[:, 2].min(), corners[:, 2].max()
        lowest, highest = low / (closest if low < 0 else farthest), high / (closest if high > 0 else farthest)
        wanted[:] = middle + first, last - first, lowest, highest, near
    return out


def columns(bounds: np.ndarray, n_columns: int, reach: float) -> list[list[int]]:
    """Twin of `columns_of`: the primitives of each column."""
    lists: list[list[int]] = [[] for _ in range(n_columns)]
    step = 2 * math.pi / n_columns
    for k, (azimuth, width, _, _, near) in enumerate(bounds):
        if near < reach:
            first, count = math.floor(azimuth / step) - 1, math.ceil(width / step) + 4
            for column in range(first, first + min(count, n_columns)):
                lists[column % n_columns].append(k)
    return lists


def drivable(scene: Any, pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Twin of the road of `SimulatedScan.top_view_labels`."""
    with np.errstate(invalid="ignore"):
        places = np.stack(np.broadcast_arrays(x[:, None], y[None, :], -pose[2, 3]), axis=-1) @ pose[:3, :3].T
        outside, _, islands, *_ = road_places(scene, *(places + pose[:3, 3])[..., :2].transpose(2, 0, 1))
        return (np.maximum(outside, -islands) < 0).astype(np.uint8)


def tile_at(tile: np.ndarray, x: np.ndarray, y: np.ndarray, cell_m: float) -> np.ndarray:
    """The noise tile between its cells, by bilinear interpolation; it repeats."""
    size = len(tile)
    row, column = np.floor(y / cell_m).astype(int), np.floor(x / cell_m).astype(int)
    b, a = y / cell_m - row, x / cell_m - column
    return sum(
        wy * wx * tile[(row + i) % size, (column + j) % size]
        for i, wy in ((0, 1 - b), (1, b))
        for j, wx in ((0, 1 - a), (1, a))
    )


def road_places(scene: Any, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
    """Distance outside roads, bays and islands, and u, s along the first road, for arrays of x and y."""
    rounding = scene.terrain[15]
    outside, bays, islands = (np.full(np.shape(x), 1e9) for _ in range(3))
    for k, (x0, y0, cos, sin, curvature, right, left, first, last, kind) in enumerate(scene.strips):
        s, across = cos * (x - x0) + sin * (y - y0), cos * (y - y0) - sin * (x - x0)
        u = (across - curvature * s * s / 2) / np.sqrt(1 + (curvature * s) ** 2)
        d = np.max([u - left, right - u, first - s, s - last], axis=0)
        if kind > 0:
            bays = np.minimum(bays, d)
        elif kind < 0:
            islands = np.minimum(islands, d)
        elif k == 0:
            outside, u_first, s_first = d, u, s
        else:
            outside = np.minimum(outside, d) - np.maximum(rounding - abs(outside - d), 0) ** 2 / (4 * rounding)
    return outside, bays, islands, u_first, s_first


def ground(scene: Any, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `ground_at`, its height and its distance outside the roads, for arrays of x and y."""
    slope_x, slope_y, ax, kx, px, ay, ky, py = scene.terrain[:8]
    kerb, pavement, crown, bank, rise, rough, ditch, _ = scene.terrain[8:16]
    outside, bays, islands, across, along = road_places(scene, x, y)
    z = slope_x * x + slope_y * y + ax * np.sin(kx * x + px) + ay * np.sin(ky * y + py)
    d = np.minimum(outside, bays)
    inside = crown * np.minimum(-d, 4.0) + scene.terrain[23] * (outside > 0)
    inside = inside + np.where(islands < 0, max(kerb, 0.08) * np.minimum(-islands / 0.05, 1.0), 0.0)
    dropped = ((along + scene.terrain[21]) / 23.0) % 1.0 < 0.15
    driveway = 0.25 + 0.75 * np.clip((d - 0.6) / 0.9, 0.0, 1.0)
    verge = kerb * np.where(dropped, driveway, 1.0) * np.minimum(d / 0.05, 1.0) + 0.02 * np.minimum(d, pavement)
    e = d - pavement
    sides = [
        np.minimum(grade * e, height) if height > 0 else np.maximum(-grade * e, height)
        for grade, height in ((bank, rise), scene.terrain[25:27])
    ]
    slope = np.where(across > 0, sides[1], sides[0])
    noise = tile_at(scene.tile, x, y, 0.3)
    grass = slope - ditch * np.maximum(1 - ((e - 1.6) / 1.2) ** 2, 0) + np.minimum(e / 0.3, 1) * rough * (1 + noise)
    return z + np.where(d <= 0, inside, verge + np.where(e > 0, grass, 0.0)), np.where(
        d <= 0, np.maximum(outside, -islands), outside
    )


def path_at(plant: int, place: np.ndarray) -> float:
    """Twin of `_path_at`."""
    cell = np.floor(place).astype(int)
    path = 0.0
    for corner in itertools.product((0, 1), repeat=3):
        i, j, k = (int(each) + 4096 for each in cell + corner)
        share = np.prod(np.where(corner, place - cell, 1.0 - (place - cell)))
        path -= share * math.log(uniform_draw(mixed(plant ^ (i << 32 | j << 16) ^ k)))
    return path


def clumped_path(primitive: np.ndarray, place: np.ndarray, path: float) -> float:
    """Twin of `_clumped_path`; ``place``: where the ray meets the plant."""
    matrix = primitive[7:16].reshape(3, 3)
    local = matrix @ (place - primitive[4:7]) / np.linalg.norm(matrix, axis=1)
    plant = mixed(int(primitive[3] * 1e12))
    own = 0.03 + 0.8 * uniform_draw(mixed(plant)) ** 2
    clump = sum(weight * path_at(plant, local / length) for weight, length in CLUMPS)
    return (1.0 - own) * clump + own * path


def cast(primitives: np.ndarray, scene: Any, pose: np.ndarray, rays: Any) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `fill_cast`: tries every primitive near the ray, and walks over the ground in steps of 5 mm."""
    elevations, azimuths, reach, key, clumped = rays
    shape = (len(elevations), len(azimuths))
    centers = primitives[:, 4:7]
    with np.errstate(invalid="ignore"):
        radii = np.sqrt((1.0 / (primitives[:, 7:16].reshape(-1, 3, 3) ** 2).sum(axis=2)).sum(axis=1))
    ranges, hits = np.full(shape, float(reach)), np.full(shape, -2)
    for b, row in enumerate(np.broadcast_to(elevations, shape)):
        for column, (elevation, azimuth) in enumerate(zip(row, azimuths, strict=True)):
            level = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
            direction = np.array([*level, np.sin(elevation)])
            steps = np.arange(0.0, reach, 0.005)
            world = pose[:3, :3] @ np.outer(direction, steps) + pose[:3, 3:4]
            below = np.flatnonzero(world[2] < ground(scene, world[0], world[1])[0])
            if len(below):
                ranges[b, column], hits[b, column] = steps[below[0]], -1
            ray = mixed((int(key) + b * len(azimuths) + column) & (2**64 - 1))
            for k in np.flatnonzero(np.linalg.norm(np.cross(centers, direction), axis=1) <= radii):
                primitive = primitives[k]
                found = crossing(primitive, direction)
                if found is None or found[1] <= 0:
                    continue
                t, draw = found[0], uniform_draw(mixed(ray ^ (int(k) + 1)))
                if primitive[1] == 4:  # leaves: a free path
                    t, path = max(t, 0.0), -np.log(draw)
                    t += (clumped_path(primitive, t * direction, path) if clumped else path) / primitive[3]
                    if t >= found[1]:
                        continue
                elif t <= 0 or (primitive[1] == 5 and draw > primitive[3]):  # inside it, or through a gap
                    continue
                if t < ranges[b, column]:
                    ranges[b, column], hits[b, column] = t, k
    return ranges, hits


def normal_draw(bits: int) -> float:
    return (sum((bits >> shift) & 0xFFFF for shift in (0, 16, 32, 48)) / 65536.0 - 2.0) * math.sqrt(3.0)


def ground_remission(scene: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Twin of `_ground_remission`."""
    terrain = scene.terrain
    pavement, asphalt, paving, grass, marking, lane = terrain[[9, 16, 17, 18, 19, 20]]
    wear, bay = terrain[[22, 24]]
    outside, bays, islands, u, s = road_places(scene, x, y)
    outside = np.where(np.minimum(outside, bays) <= 0, np.maximum(outside, -islands), outside)
    stain, patch = tile_at(scene.tile, x, y, 0.11), tile_at(scene.tile, x + 31.0, y + 17.0, 1.7)
    right, left = scene.strips[0, 5], scene.strips[0, 6]
    to_line = abs(u / lane - np.floor(u / lane + 0.5)) * lane
    dashed = (to_line < 0.06) & ((s / 9.0) % 1.0 < 0.4) & (abs(u - left) > 1.0) & (abs(u - right) > 1.0)
    edge = np.minimum(abs(u - left + 0.25), abs(u - right - 0.25)) < 0.06
    road = np.where(
        (edge | dashed) & (marking > 0), marking + 0.1 * stain, asphalt * (1 + wear * (0.4 * stain + 0.6 * patch))
    )
    return np.select(
        [outside < 0, bays < 0, outside < pavement],
        [road, bay * (1 + 0.15 * patch), paving * (1 + 0.1 * stain + 0.1 * patch)],
        grass * (1 + 0.25 * stain + 0.1 * patch),
    )


def ground_kinds(scene: Any, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `fill_ground_kinds`."""
    kinds, remissions = np.full(len(xy), 2, np.uint8), np.full(len(xy), np.nan)
    with np.errstate(invalid="ignore"):
        near = (abs(xy) < 1e6).all(axis=1)
    x, y = xy[near].T
    outside, bays, islands, *_ = road_places(scene, x, y)
    outside = np.where(np.minimum(outside, bays) <= 0, np.maximum(outside, -islands), outside)
    kinds[near] = np.select([outside < 0, (bays < 0) | (outside < scene.terrain[9])], [0, 1], 2)
    remissions[near] = ground_remission(scene, x, y)
    return kinds, remissions


def in_ego_shadow(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Twin of `_in_ego_shadow`."""
    a = (azimuth + math.pi) % (2 * math.pi) - math.pi
    behind, ahead = math.pi - abs(a), abs(a)
    roof = np.select(
        [behind < 0.26, behind < 0.44, behind < 0.61, (behind > 0.84) & (behind < 1.02), ahead < 0.17, ahead < 0.45],
        [-0.32, -0.355, -0.40, -0.375, -0.35, -0.375 - 0.08 * (ahead - 0.17)],
        np.nan,
    )
    mast = ((a + 1.24) / 0.18) ** 2 + ((elevation + 0.335) / 0.075) ** 2 < 1
    return np.where(np.isnan(roof), mast, elevation < roof)


def points(
    primitives: np.ndarray, scene: Any, pose: Any, rays: np.ndarray, found: np.ndarray, receiver: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `fill_points`: the returns (n, 4) float32 and the object of each, all rays at once."""
    elevations, azimuths, reach, key, _ = rays
    ranges, hits, exits, cosines = found
    range_offsets, remission_offsets, min_range, noise, ego_shadow = receiver
    beam, column = np.nonzero((hits > -2) & np.isfinite(ranges))
    hit, t, leave, cos = (of[beam, column] for of in (hits, ranges, exits, cosines))
    t = t.copy()

    def draws(seeds: Iterable[int]) -> np.ndarray:
        return np.array([mixed(int(seed)) for seed in seeds], dtype=object)

    first = draws(
        (int(key) ^ 0x5DEECE66D ^ (b * hits.shape[1] + c) << 20) & (2**64 - 1)
        for b, c in zip(beam.tolist(), column.tolist(), strict=True)
    )
    second = draws(first)
    third = draws(second)
    luck, other = (np.array([uniform_draw(int(bits)) for bits in of], float) for of in (first, third))
    spread = np.array([normal_draw(int(bits)) for bits in second], float)
    last_spread = np.array([normal_draw(int(bits)) for bits in draws(int(bits) ^ 0xABCDEF for bits in third)], float)

    elevation = np.broadcast_to(elevations, hits.shape)[beam, column]
    level = np.cos(elevation)
    direction = np.stack([level * np.cos(azimuths)[column], level * np.sin(azimuths)[column], np.sin(elevation)], 1)
    world = (t[:, None] * direction) @ pose[:3, :3].T + pose[:3, 3]
    shapes = np.zeros((len(t), 20))
    shapes[hit >= 0] = primitives[hit[hit >= 0]]
    material, density = np.where(hit >= 0, shapes[:, 1], -1), shapes[:, 3]
    earth, paint, glass, retro, leaves, facade = (material == kind for kind in (-1, 1, 2, 3, 4, 6))

    value, lost = shapes[:, 2].copy(), np.full(len(t), 0.006)
    if earth.any():
        fade = np.clip((cos[earth] - 0.04) / 0.034, 0, 1)
        value[earth] = ground_remission(scene, world[earth, 0], world[earth, 1]) * fade
    lost = np.where(earth, lost + np.clip((0.045 - cos) / 0.04, 0, 0.85), lost)
    coat = value * (0.5 + 0.5 * cos)
    coat += 0.5 * np.maximum((cos - 0.97) / 0.03, 0) * (0.25 + coat) - 0.11
    value = np.where(paint, coat, value)
    lost = np.where(paint, lost + 0.06 + density * (1 - 0.7 * cos) + np.clip((t - 28) * 0.02, 0, 0.6), lost)
    through = glass & (other < 0.6)
    lost = np.where(glass, lost + density, lost)
    value = np.where(glass, np.where(through, 0.04, 0.02), value)
    t = np.where(through, t + (0.15 + 0.8 * other / 0.6) * np.maximum(leave - t - 0.05, 0), t)
    value = np.where(retro, value * (0.4 + 0.6 * cos), value)
    # Facades: the coordinate along the wall that the ray hits, and windows on a grid.
    a, b = abs(shapes[:, 7]), abs(shapes[:, 8])
    first_wall = abs((shapes[:, 7:9] * direction[:, :2]).sum(1)) < abs((shapes[:, 10:12] * direction[:, :2]).sum(1))
    across = np.where(first_wall, (shapes[:, 7:9] * world[:, :2]).sum(1), b * world[:, 0] + a * world[:, 1])
    across = across / np.maximum(np.hypot(a, b), 1e-9)
    storey = (world[:, 2] - 0.9) / 2.9
    window = facade & ((across / np.where(facade, density, 1)) % 1 < 0.42) & (storey % 1 < 0.5)
    lost = np.where(window, lost + 0.35, lost)
    recess = 0.12 / np.maximum(cos, 0.2) + np.where(other > 0.75, 2.5 * (other - 0.75) / 0.25, 0)
    t = np.where(window, t + recess, t)
    value = np.where(window, 0.3 * value, value)
    value = np.where(leaves, value * (0.75 + 0.5 * other), value)
    value = np.where(~(earth | paint | glass | retro | leaves), value * (0.55 + 0.45 * cos), value)
    dull = ~(earth | retro)
    value = np.where(dull, value * np.clip(1 - 0.022 * (t - 18), 0.35, 1), value)
    lost = np.where(dull, lost + np.clip((t - 35) * 0.004, 0, 0.3), lost)

    kept = np.ones(len(t), bool)
    if ego_shadow:
        kept = ~in_ego_shadow(azimuths[column] + 0.01 * spread, elevation + 0.016 * (other - 0.5))
    if noise:
        jitter = np.where(leaves, 1.6, 1.0)
        kept &= luck <= 1 - lost
        t = t + range_offsets[beam] + 0.01 * jitter * spread
        value = (
            value
            + remission_offsets[beam] * np.minimum(1, 0.2 + 4 * np.maximum(value, 0))
            + 0.05 * jitter * last_spread
        )
        value = np.where((value < 0.01 + 0.1 * luck) | (other > 0.965), 0, value)
    kept &= (t >= min_range) & (t < reach)
    value = np.floor(np.clip(value, np.where(retro, 0.3, 0), 0.99) * 100 + 0.5) / 100
    returns = np.column_stack([t[:, None] * direction, value]).astype(np.float32)
    return returns[kept], np.where(hit >= 0, shapes[:, 19], -1)[kept].astype(np.int32)
