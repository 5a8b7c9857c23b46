"""The spinning LiDAR: kernels that cast rays and turn hits into points."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..system.kernels import njit
from ..types.points import Bytes, Floats, Ints, Ints64, Points, Rows
from .ray_draws import clumped_path, mixed_bits, normal_draw, uniform_draw

# A primitive is a row of float64: kind, material, remission, density, center (3), rows of the matrix that maps an
# offset from the center into the unit shape (9), taper of the front, rear and sides (3), object. Below 0, the last is a
# static shape: -1 of no class, -2 - k of class k of `camera`.
BOX, CYLINDER, ELLIPSOID = 0, 1, 2
MATTE, PAINT, GLASS, RETRO, LEAVES, POROUS, FACADE = 0, 1, 2, 3, 4, 5, 6
ROW = 20

# Columns of Scene.strips: origin x, y, cos and sin of the direction, curvature, u range, s range, and the kind: 0 for a
# road, 1 for a parking bay, -1 for a raised island in a road.
STRIP = 10

# Entries of Scene.terrain.
(
    SLOPE_X, SLOPE_Y, WAVE_X, WAVE_X_K, WAVE_X_0, WAVE_Y, WAVE_Y_K, WAVE_Y_0, KERB, PAVEMENT, CROWN,
    BANK_SLOPE, BANK_RISE, ROUGH, DITCH, ROUNDING, ASPHALT, PAVING, GRASS, MARKING, LANE, DROPPED, WEAR,
    LIP, BAY, BANK_SLOPE_LEFT, BANK_RISE_LEFT, TERRAIN,
) = range(28)  # fmt: skip
TILE = 256  # cells along each side of the noise tile; 0.3 m each
_GROUND, _NOTHING = -1, -2  # hits that are not rows of primitives


class Ground(NamedTuple):
    """The ground of a scene (`Scene`)."""

    strips: Floats  # (k, 10)
    terrain: Floats  # (27,)
    tile: Floats  # (256, 256)


class Shapes(NamedTuple):
    """Primitives in the sensor frame, nearest first, and those that the rays of each sector of the turn may hit."""

    primitives: Floats  # (n, 20)
    bounds: Floats  # (n, 5), from `fill_bounds`
    starts: Ints64  # (sectors + 1,), where each sector's list begins in `rows`
    rows: Rows  # rows of `primitives`


class Rays(NamedTuple):
    """The rays of a sensor at the origin: one for each beam and column."""

    # (beams, 1), or (beams, columns) where those of a beam differ; in each column from top to bottom [rad].
    elevations: Floats
    azimuths: Floats  # (columns,) [rad]
    reach: float  # length [m]
    key: np.uint64  # seed of all draws
    clumped: bool = False  # whether neighboring rays meet the same leaves (`ray_draws.clumped_path`)


class Hits(NamedTuple):
    """The first hit of each ray, (beams, columns)."""

    ranges: Floats  # [m]; not finite: no return
    rows: Rows  # of the primitives, -1 for the ground, -2 for no hit
    exits: Floats  # range at which the ray leaves the primitive [m]
    cosines: Floats  # of the angle of incidence


class Receiver(NamedTuple):
    """What a sensor makes of hits."""

    range_offsets: Floats  # (beams,), calibration errors [m]
    remission_offsets: Floats  # (beams,), calibration errors
    min_range: float  # [m]
    noise: bool  # noise and drop-out
    ego_shadow: bool  # the ego vehicle hides the directions that KITTI's car hides


class Echo(NamedTuple):
    """What returns along a ray, before noise."""

    range: float  # [m]
    remission: float
    lost: float  # probability of no return
    jitter: float  # factor of the noise
    least: float  # the remission reads no less


@njit(cache=True, nogil=True)
def _tile_at(tile: Floats, x: float, y: float, cell_m: float) -> float:
    column, row = x / cell_m, y / cell_m
    left, below = math.floor(column), math.floor(row)
    a, b = column - left, row - below
    i, j = int(below) & (TILE - 1), int(left) & (TILE - 1)
    i1, j1 = (i + 1) & (TILE - 1), (j + 1) & (TILE - 1)
    return (1.0 - b) * ((1.0 - a) * tile[i, j] + a * tile[i, j1]) + b * ((1.0 - a) * tile[i1, j] + a * tile[i1, j1])


@njit(cache=True, nogil=True)
def ground_at(ground: Ground, x: float, y: float) -> tuple[float, float, float, float, float]:
    """Evaluate the ground at x, y [m], world frame: height, distance outside the roads and the bays (negative inside;
    an island is outside), and u and s in the first road's frame [m], s along its axis, u to its left.
    """
    strips, terrain = ground.strips, ground.terrain
    outside, outside_bays, outside_islands, u_first, s_first = 1e9, 1e9, 1e9, 0.0, 0.0
    for k in range(strips.shape[0]):
        dx, dy = x - strips[k, 0], y - strips[k, 1]
        s = strips[k, 2] * dx + strips[k, 3] * dy
        bend = strips[k, 4] * s
        u = (strips[k, 2] * dy - strips[k, 3] * dx - 0.5 * bend * s) / math.sqrt(1.0 + bend * bend)
        d = max(max(u - strips[k, 6], strips[k, 5] - u), max(strips[k, 7] - s, s - strips[k, 8]))
        if strips[k, 9] > 0.0:
            outside_bays = min(outside_bays, d)
        elif strips[k, 9] < 0.0:
            outside_islands = min(outside_islands, d)
        elif k == 0:
            outside, u_first, s_first = d, u, s
        else:
            # Smooth minimum, which rounds the kerbs where roads meet.
            blend = max(terrain[ROUNDING] - abs(outside - d), 0.0)
            outside = min(outside, d) - blend * blend / (4.0 * terrain[ROUNDING])
    z = terrain[SLOPE_X] * x + terrain[SLOPE_Y] * y
    z += terrain[WAVE_X] * math.sin(terrain[WAVE_X_K] * x + terrain[WAVE_X_0])
    z += terrain[WAVE_Y] * math.sin(terrain[WAVE_Y_K] * y + terrain[WAVE_Y_0])
    d = min(outside, outside_bays)
    if d <= 0.0:
        z += terrain[CROWN] * min(-d, 4.0)
        if outside > 0.0:
            z += terrain[LIP]
        if outside_islands < 0.0:
            z += max(terrain[KERB], 0.08) * min(-outside_islands / 0.05, 1.0)
        return z, max(outside, -outside_islands), outside_bays, u_first, s_first
    kerb = terrain[KERB]
    along = (s_first + terrain[DROPPED]) / 23.0
    if along - np.floor(along) < 0.15:
        kerb *= 0.25 + 0.75 * min(max((d - 0.6) / 0.9, 0.0), 1.0)  # dropped for a driveway
    z += kerb * min(d / 0.05, 1.0) + 0.02 * min(d, terrain[PAVEMENT])
    e = d - terrain[PAVEMENT]
    if e > 0.0:
        slope, rise = terrain[BANK_SLOPE], terrain[BANK_RISE]
        if u_first > 0.0:
            slope, rise = terrain[BANK_SLOPE_LEFT], terrain[BANK_RISE_LEFT]
        z += min(slope * e, rise) if rise > 0.0 else max(-slope * e, rise)
        basin = (e - 1.6) / 1.2
        z -= terrain[DITCH] * max(1.0 - basin * basin, 0.0)
        z += min(e / 0.3, 1.0) * terrain[ROUGH] * (1.0 + _tile_at(ground.tile, x, y, 0.3))
    return z, outside, outside_bays, u_first, s_first


@np.errstate(invalid="ignore")
def placed(primitives: Floats, poses: Floats, T_world_sensor: Floats) -> Floats:
    """Primitives (n, 20), of the frame of their object or of the world, in the sensor frame.

    poses : (m, 4) float64; x, y, z [m], yaw [rad] of the objects.
    """
    T, result = T_world_sensor, primitives.copy()
    of_world = [0.0, 0.0, 0.0, 1.0, 0.0]
    frames = np.array([*([x, y, z, math.cos(yaw), math.sin(yaw)] for x, y, z, yaw in poses.tolist()), of_world])
    x, y, z, cos, sin = frames[np.maximum(primitives[:, 19], -1.0).astype(np.int64)].T
    cx, cy, cz = primitives[:, 4:7].T
    dx, dy, dz = cos * cx - sin * cy + x - T[0, 3], sin * cx + cos * cy + y - T[1, 3], cz + z - T[2, 3]
    for i in range(3):
        result[:, 4 + i] = T[0, i] * dx + T[1, i] * dy + T[2, i] * dz
        ax, ay, az = primitives[:, 7 + 3 * i : 10 + 3 * i].T
        wx, wy = cos * ax - sin * ay, sin * ax + cos * ay
        for j in range(3):
            result[:, 7 + 3 * i + j] = wx * T[0, j] + wy * T[1, j] + az * T[2, j]
    return result


@njit(cache=True, nogil=True)
def fill_bounds(primitives: Floats, bounds: Floats) -> None:
    """Compute bounds of the rays from the origin that can hit each primitive: first azimuth, width in azimuth [rad],
    lowest and highest tangent of the elevation, horizontal distance [m], infinite if the primitive is not finite.
    """
    corners = np.empty((8, 3))
    for k in range(primitives.shape[0]):
        p = primitives[k]
        if not np.isfinite(p[4:16]).all():
            bounds[k] = np.inf
            continue
        for c in range(8):
            for j in range(3):
                corners[c, j] = p[4 + j]
            for i in range(3):
                ax, ay, az = p[7 + 3 * i], p[8 + 3 * i], p[9 + 3 * i]
                # Row i of the matrix is the axis over its half length; the half axis is the row over its square.
                sign = (1.0 if (c >> i) & 1 else -1.0) / (ax * ax + ay * ay + az * az)
                corners[c, 0] += sign * ax
                corners[c, 1] += sign * ay
                corners[c, 2] += sign * az
        middle = math.atan2(p[5], p[4])
        first, last, far, low, high = 10.0, -10.0, 0.0, 1e9, -1e9
        for c in range(8):
            turn = math.atan2(corners[c, 1], corners[c, 0]) - middle
            turn -= 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
            first, last = min(first, turn), max(last, turn)
            far = max(far, math.hypot(corners[c, 0], corners[c, 1]))
            low, high = min(low, corners[c, 2]), max(high, corners[c, 2])
        near = 0.0
        if last - first < math.pi:
            # Distance of the convex outline seen from above: its largest separation, normal to an edge or to a corner.
            for candidate in range(14):
                if candidate < 8:
                    nx, ny = corners[candidate, 0], corners[candidate, 1]
                else:
                    i = (candidate - 8) // 2
                    sign = 1.0 if candidate % 2 == 0 else -1.0
                    nx, ny = -sign * p[8 + 3 * i], sign * p[7 + 3 * i]
                length = math.hypot(nx, ny)
                if length > 1e-9:
                    least = 1e9
                    for c in range(8):
                        least = min(least, (nx * corners[c, 0] + ny * corners[c, 1]) / length)
                    near = max(near, least)
        else:
            first, last = -math.pi, math.pi
        floor = max(near, 1e-3)
        bounds[k, 0] = middle + first - 1e-9
        bounds[k, 1] = last - first + 2e-9
        bounds[k, 2] = low / (floor if low < 0.0 else far) - 1e-9
        bounds[k, 3] = high / (floor if high > 0.0 else far) + 1e-9
        bounds[k, 4] = near


def columns_of(bounds: Floats, n_columns: int, reach: float) -> tuple[Ints64, Rows]:
    """Primitives that rays of each column may hit, in the order of ``bounds``: starts (n_columns + 1,) and rows."""
    near = np.flatnonzero(bounds[:, 4] < reach)
    step = 2.0 * math.pi / n_columns
    # One more column on each side, because azimuths jitter by a fraction of a step.
    first = np.floor(bounds[near, 0] / step).astype(np.int64) - 1
    count = np.minimum(np.ceil(bounds[near, 1] / step).astype(np.int64) + 4, n_columns)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    columns = (np.repeat(first, count) + within) % n_columns
    starts = np.concatenate([[0], np.cumsum(np.bincount(columns, minlength=n_columns))])
    # Numbers of 16 bits are sorted ten times as fast.
    order = np.argsort(columns.astype(np.uint16 if n_columns < 2**16 else np.int64), kind="stable")
    return starts, np.repeat(near, count)[order].astype(np.int32)


@njit(cache=True, nogil=True)
def crossing(p: Floats, dx: float, dy: float, dz: float) -> tuple[float, float, int]:
    """Intersect a ray from the origin with a primitive: ranges of entry and exit [m], and face. entry > exit: miss."""
    ox = -(p[7] * p[4] + p[8] * p[5] + p[9] * p[6])
    oy = -(p[10] * p[4] + p[11] * p[5] + p[12] * p[6])
    oz = -(p[13] * p[4] + p[14] * p[5] + p[15] * p[6])
    ux = p[7] * dx + p[8] * dy + p[9] * dz
    uy = p[10] * dx + p[11] * dy + p[12] * dz
    uz = p[13] * dx + p[14] * dy + p[15] * dz
    enter, leave, face = -1e9, 1e9, -1
    kind = int(p[0])
    if kind == ELLIPSOID:
        a = ux * ux + uy * uy + uz * uz
        b = ox * ux + oy * uy + oz * uz
        c = ox * ox + oy * oy + oz * oz - 1.0
        root = b * b - a * c
        if root < 0.0:
            return 1.0, 0.0, -1
        root = math.sqrt(root)
        return (-b - root) / a, (-b + root) / a, 6
    if kind == CYLINDER:
        a = ux * ux + uy * uy
        b = ox * ux + oy * uy
        c = ox * ox + oy * oy - 1.0
        if a > 1e-18:
            root = b * b - a * c
            if root < 0.0:
                return 1.0, 0.0, -1
            root = math.sqrt(root)
            enter, leave, face = (-b - root) / a, (-b + root) / a, 6
        elif c > 0.0:
            return 1.0, 0.0, -1
        n_faces = 2
    else:
        n_faces = 6
    # Half-spaces: bottom, top, then (boxes) front, rear, left, right, which lean in by the tapers.
    for k in range(n_faces):
        if k == 0:
            rate, gap = -uz, 1.0 + oz
        elif k == 1:
            rate, gap = uz, 1.0 - oz
        elif k == 2:
            lean = 0.5 * p[16]
            rate, gap = ux + lean * uz, 1.0 - ox - lean * (oz + 1.0)
        elif k == 3:
            lean = 0.5 * p[17]
            rate, gap = -ux + lean * uz, 1.0 + ox - lean * (oz + 1.0)
        else:
            lean = 0.5 * p[18]
            side = 1.0 if k == 4 else -1.0
            rate, gap = side * uy + lean * uz, 1.0 - side * oy - lean * (oz + 1.0)
        if rate > 1e-12:
            leave = min(leave, gap / rate)
        elif rate < -1e-12:
            t = gap / rate
            if t > enter:
                enter, face = t, k
        elif gap < 0.0:
            return 1.0, 0.0, -1
        if enter > leave:
            return 1.0, 0.0, -1
    return enter, leave, face


@njit(cache=True, nogil=True)
def _cosine(p: Floats, face: int, t: float, dx: float, dy: float, dz: float) -> float:
    """Cosine of the angle between ray and surface normal."""
    nx, ny, nz = 0.0, 0.0, 0.0
    if face == 6:
        qx, qy, qz = t * dx - p[4], t * dy - p[5], t * dz - p[6]
        nx = p[7] * qx + p[8] * qy + p[9] * qz
        ny = p[10] * qx + p[11] * qy + p[12] * qz
        if int(p[0]) == ELLIPSOID:
            nz = p[13] * qx + p[14] * qy + p[15] * qz
    elif face == 0:
        nz = -1.0
    elif face == 1:
        nz = 1.0
    elif face == 2:
        nx, nz = 1.0, 0.5 * p[16]
    elif face == 3:
        nx, nz = -1.0, 0.5 * p[17]
    else:
        ny, nz = (1.0 if face == 4 else -1.0), 0.5 * p[18]
    wx = p[7] * nx + p[10] * ny + p[13] * nz
    wy = p[8] * nx + p[11] * ny + p[14] * nz
    wz = p[9] * nx + p[12] * ny + p[15] * nz
    length = math.sqrt(wx * wx + wy * wy + wz * wz)
    return min(abs(wx * dx + wy * dy + wz * dz) / max(length, 1e-12), 1.0)


# Inlined, as calls from the loops of rays take an eighth longer in all.
@njit(cache=True, nogil=True, inline="always")
def _height_above(ground: Ground, T: Floats, x: float, y: float, z: float) -> float:
    """Height above the ground [m] of a point in the sensor frame."""
    xw = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    yw = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    zw = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    return zw - ground_at(ground, xw, yw)[0]


@njit(cache=True, nogil=True)
def fill_cast(shapes: Shapes, ground: Ground, T_world_sensor: Floats, rays: Rays, hits: Hits) -> None:
    """Find the first hit of each ray; ``hits`` are overwritten."""
    T = T_world_sensor
    n_beams, n_columns = rays.elevations.shape[0], rays.azimuths.shape[0]
    tangents = np.tan(rays.elevations)
    differ = 1 if tangents.shape[1] > 1 else 0
    n_sectors = shapes.starts.shape[0] - 1
    lowest = 0.0
    for column in range(tangents.shape[1]):
        lowest = min(lowest, tangents[n_beams - 1, column])
    # Radii of ground samples start inside the ring of the lowest beam and grow by 3 %: at 30 m, by a third of the
    # distance between two rings.
    height = _height_above(ground, T, 0.0, 0.0, 0.0)
    innermost = min(max(0.3, 0.4 * height / max(-lowest, 0.05)), 5.0)
    n_radii = int(math.log(max(rays.reach / innermost, 2.0)) / math.log(1.03)) + 2
    radii, heights = np.empty(n_radii), np.empty(n_radii)
    for i in range(n_radii):
        radii[i] = innermost * 1.03**i
    extent, n_met = _extent(ground), n_radii
    for column in range(n_columns):
        level = math.cos(rays.azimuths[column]), math.sin(rays.azimuths[column])
        sector = math.floor(rays.azimuths[column] * (n_sectors / (2.0 * math.pi))) % n_sectors
        if n_beams == 1 and T[2, 2] > 0.9:  # a pattern: most of its rays are soon above all ground, or below it
            farthest = min(_farthest(ground, extent, T, level, tangents[0, differ * column]), rays.reach)
            n_met = min(int(math.log(max(farthest / innermost, 1.0)) / math.log(1.03)) + 2, n_radii)
        _fill_profile(ground, T, level, radii[:n_met], heights)
        # Higher beams meet the ground no nearer than lower ones, so one pass over the radii is enough for all beams.
        i = 0
        for b in range(n_beams - 1, -1, -1):
            tan, elevation = tangents[b, differ * column], rays.elevations[b, differ * column]
            while i < n_met and heights[i] < radii[i] * tan:
                i += 1
            ce = math.cos(elevation)
            direction = ce * level[0], ce * level[1], math.sin(elevation)
            # The ground is met between two samples. Behind a shape it is not looked for: a sixth of the time less.
            nearest, limit = 0.0, rays.reach
            if i < n_met:
                nearest, limit = (0.999999 * radii[i - 1] / ce if i else 0.0), min(1.000001 * radii[i] / ce, limit)
            ray = mixed_bits(np.uint64(rays.key + np.uint64(b * n_columns + column)))
            best, row, leave, face = _first_shape(shapes, sector, direction, tan, ray, limit, rays.clumped)
            cosine = 0.0
            if row >= 0:
                cosine = 0.7 if face < 0 else _cosine(shapes.primitives[row], face, best, *direction)
            if i < n_met and best > nearest:
                r = _ground_radius(ground, T, level, tan, radii, heights, i)
                if r / ce <= best and r / ce < rays.reach:
                    best = leave = r / ce
                    rise = _ground_rise(ground, T, level, tan, r)
                    row, cosine = _GROUND, abs(rise * ce - direction[2]) / math.sqrt(1.0 + rise * rise)
            hits.ranges[b, column] = best
            hits.rows[b, column] = row
            hits.exits[b, column] = leave
            hits.cosines[b, column] = cosine


@njit(cache=True, nogil=True)
def _extent(ground: Ground) -> float:
    """The most by which the ground is above or below the slopes of its terrain, and half a meter [m]."""
    t = ground.terrain
    if t[BANK_SLOPE] < 0.0 or t[BANK_SLOPE_LEFT] < 0.0:
        return math.inf
    road = 4.0 * abs(t[CROWN]) + abs(t[LIP]) + max(abs(t[KERB]), 0.08) + 0.02 * abs(t[PAVEMENT])
    land = max(abs(t[BANK_RISE]), abs(t[BANK_RISE_LEFT])) + abs(t[DITCH]) + 2.0 * abs(t[ROUGH])
    return abs(t[WAVE_X]) + abs(t[WAVE_Y]) + road + land + 0.5


@njit(cache=True, nogil=True)
def _farthest(ground: Ground, extent: float, T: Floats, level: tuple[float, float], tan: float) -> float:
    """Horizontal distance [m] beyond which a ray of slope ``tan`` is above all ground, or below it."""
    x_slope, y_slope = ground.terrain[SLOPE_X], ground.terrain[SLOPE_Y]
    above, rate = T[2, 3] - x_slope * T[0, 3] - y_slope * T[1, 3], 0.0
    for k in range(3):
        way = level[0] if k == 0 else level[1] if k == 1 else tan
        rate += way * (T[2, k] - x_slope * T[0, k] - y_slope * T[1, k])
    return (extent - (above if rate > 0.0 else -above)) / max(abs(rate), 1e-9)


@njit(cache=True, nogil=True)
def _fill_profile(ground: Ground, T: Floats, level: tuple[float, float], radii: Floats, heights: Floats) -> None:
    """Heights (n,) of the ground in the sensor frame at radii (n,) along an azimuth, overwritten [m].

    level : cosine and sine of the azimuth.
    """
    straight = abs(T[2, 2]) > 0.999999999
    z = -T[2, 3]
    for i in range(radii.shape[0]):
        x, y = radii[i] * level[0], radii[i] * level[1]
        # One Newton step, which is exact for an upright sensor.
        z -= _height_above(ground, T, x, y, z) / T[2, 2]
        if not straight:
            z -= _height_above(ground, T, x, y, z) / T[2, 2]
        heights[i] = z


@njit(cache=True, nogil=True)
def _ground_radius(
    ground: Ground, T: Floats, level: tuple[float, float], tan: float, radii: Floats, heights: Floats, i: int
) -> float:
    """Horizontal distance [m] at which a ray of slope ``tan`` meets the ground, between samples i - 1 and i."""
    low = 0.0 if i == 0 else radii[i - 1]
    high = radii[i]
    above = 0.1 if i == 0 else low * tan - heights[i - 1]
    below = high * tan - heights[i]
    r = high
    for _ in range(24):
        if above - below < 1e-12:
            break
        # False position; the limits keep it from converging slowly at a kerb, which is a corner.
        share = above / (above - below)
        share = min(max(share, 0.1), 0.9) if high - low > 0.02 else share
        r = low + share * (high - low)
        gap = _height_above(ground, T, r * level[0], r * level[1], r * tan)
        if abs(gap) < 1e-4:
            break
        if gap > 0.0:
            low, above = r, gap
        else:
            high, below = r, gap
        if high - low < 1e-4:
            break
    return r


@njit(cache=True, nogil=True)
def _ground_rise(ground: Ground, T: Floats, level: tuple[float, float], tan: float, r: float) -> float:
    """Slope of the ground along a ray of slope ``tan`` that meets it at ``r`` [m], over 4 cm."""
    rise = _height_above(ground, T, (r - 0.02) * level[0], (r - 0.02) * level[1], r * tan)
    rise -= _height_above(ground, T, (r + 0.02) * level[0], (r + 0.02) * level[1], r * tan)
    return rise / 0.04


@njit(cache=True, nogil=True)
def _first_shape(
    shapes: Shapes,
    sector: int,
    direction: tuple[float, float, float],
    tan: float,
    ray: np.uint64,
    reach: float,
    clumped: bool,
) -> tuple[float, int, float, int]:
    """Find the first primitive that a ray hits within ``reach`` [m]: range, row (-2: none), exit [m], face."""
    best, row, leave_best, face_best = reach, _NOTHING, reach, -1
    for e in range(shapes.starts[sector], shapes.starts[sector + 1]):
        k = shapes.rows[e]
        if shapes.bounds[k, 4] >= best:
            break
        if tan < shapes.bounds[k, 2] or tan > shapes.bounds[k, 3]:
            continue
        p = shapes.primitives[k]
        enter, leave, face = crossing(p, *direction)
        if enter > leave or leave <= 0.0:
            continue
        material = int(p[1])
        if material == LEAVES:
            # Random free path through the leaves.
            path = -math.log(uniform_draw(mixed_bits(np.uint64(ray ^ np.uint64(k + 1)))))
            enter = max(enter, 0.0)
            t = enter + (clumped_path(p, enter, direction, path) if clumped else path) / p[3]
            if t < leave and t < best:
                best, row, leave_best, face_best = t, k, leave, -1
        elif enter > 0.0 and enter < best:
            if material == POROUS and uniform_draw(mixed_bits(np.uint64(ray ^ np.uint64(k + 1)))) > p[3]:
                continue
            best, row, leave_best, face_best = enter, k, leave, face
    return best, row, leave_best, face_best


@njit(cache=True, nogil=True)
def _ground_remission(ground: Ground, x: float, y: float) -> float:
    strips, terrain, tile = ground
    _, outside, outside_bays, u, s = ground_at(ground, x, y)
    stain = _tile_at(tile, x, y, 0.11)
    patch = _tile_at(tile, x + 31.0, y + 17.0, 1.7)
    if outside < 0.0:
        value = terrain[ASPHALT] * (1.0 + terrain[WEAR] * (0.4 * stain + 0.6 * patch))
        if terrain[MARKING] > 0.0:
            lane = terrain[LANE]
            to_line = abs(u / lane - math.floor(u / lane + 0.5)) * lane
            edge = min(abs(u - strips[0, 6] + 0.25), abs(u - strips[0, 5] - 0.25))
            dash = s / 9.0 - math.floor(s / 9.0)
            inner = abs(u - strips[0, 6]) > 1.0 and abs(u - strips[0, 5]) > 1.0
            if edge < 0.06 or (to_line < 0.06 and dash < 0.4 and inner):
                value = terrain[MARKING] + 0.1 * stain
        return value
    if outside_bays < 0.0:
        return terrain[BAY] * (1.0 + 0.15 * patch)
    if outside < terrain[PAVEMENT]:
        return terrain[PAVING] * (1.0 + 0.1 * stain + 0.1 * patch)
    return terrain[GRASS] * (1.0 + 0.25 * stain + 0.1 * patch)


@njit(cache=True, nogil=True)
def fill_ground_kinds(ground: Ground, xy: Floats, kinds: Bytes, remissions: Floats) -> None:
    """Write the ground's kind (n,) at x, y [m], world frame, (n, 2), and its remission.

    Kinds are 0 for a road, 1 for a bay or a pavement, 2 for grass and for places that are not finite.
    """
    for i in range(xy.shape[0]):
        kinds[i], remissions[i] = 2, math.nan
        if not (abs(xy[i, 0]) < 1e6 and abs(xy[i, 1]) < 1e6):
            continue
        _, outside, outside_bays, _, _ = ground_at(ground, xy[i, 0], xy[i, 1])
        kinds[i] = 0 if outside < 0.0 else 1 if outside_bays < 0.0 or outside < ground.terrain[PAVEMENT] else 2
        remissions[i] = _ground_remission(ground, xy[i, 0], xy[i, 1])


@njit(cache=True, nogil=True)
def _in_ego_shadow(azimuth: float, elevation: float) -> bool:
    # Measured on KITTI, directions without returns: roof behind, its rear edges, its front, a mast to the right.
    a = azimuth - 2.0 * math.pi * math.floor((azimuth + math.pi) / (2.0 * math.pi))
    behind = math.pi - abs(a)
    if behind < 0.26:
        return elevation < -0.32
    if behind < 0.44:
        return elevation < -0.355
    if behind < 0.61:
        return elevation < -0.40
    if 0.84 < behind < 1.02:
        return elevation < -0.375
    if abs(a) < 0.17:
        return elevation < -0.35
    if abs(a) < 0.45:
        return elevation < -0.375 - 0.08 * (abs(a) - 0.17)
    return ((a + 1.24) / 0.18) ** 2 + ((elevation + 0.335) / 0.075) ** 2 < 1.0


@njit(cache=True, nogil=True)
def fill_points(
    primitives: Floats,
    ground: Ground,
    T_world_sensor: Floats,
    rays: Rays,
    hits: Hits,
    receiver: Receiver,
    points: Points,
    objects: Ints,
) -> int:
    """Convert hits to returns, beam by beam, with the object of each, -1 for none; returns their number."""
    n_beams, n_columns = hits.rows.shape
    differ = 1 if rays.elevations.shape[1] > 1 else 0
    n = 0
    for b in range(n_beams):
        for column in range(n_columns):
            k, t = hits.rows[b, column], hits.ranges[b, column]
            if k == _NOTHING or not math.isfinite(t):
                continue
            number = np.uint64(b * n_columns + column) << np.uint64(20)
            ray = mixed_bits(np.uint64(rays.key ^ np.uint64(0x5DEECE66D) ^ number))
            luck = uniform_draw(ray)
            ray = mixed_bits(ray)
            spread = normal_draw(ray)
            ray = mixed_bits(ray)
            other = uniform_draw(ray)
            azimuth, elevation = rays.azimuths[column], rays.elevations[b, differ * column]
            if receiver.ego_shadow and _in_ego_shadow(azimuth + 0.01 * spread, elevation + 0.016 * (other - 0.5)):
                continue
            ce = math.cos(elevation)
            direction = ce * math.cos(azimuth), ce * math.sin(azimuth), math.sin(elevation)
            cosine, leave, o = hits.cosines[b, column], hits.exits[b, column], -1
            if k == _GROUND:
                echo = _ground_echo(ground, T_world_sensor, direction, t, cosine)
            else:
                o = int(primitives[k, 19])
                echo = _shape_echo(primitives[k], T_world_sensor, direction, t, leave, cosine, other)
            t, value = echo.range, echo.remission
            if receiver.noise:
                if luck > 1.0 - echo.lost:
                    continue
                t += receiver.range_offsets[b] + 0.01 * echo.jitter * spread
                spread = normal_draw(mixed_bits(np.uint64(ray ^ np.uint64(0xABCDEF))))
                gain = min(1.0, 0.2 + 4.0 * max(value, 0.0))
                value += receiver.remission_offsets[b] * gain + 0.05 * echo.jitter * spread
                # Measured: few values between 0 and 0.1, and 57 % of a car's returns at 0: weak echoes read 0.
                if value < 0.01 + 0.1 * luck or other > 0.965:
                    value = 0.0
            if not receiver.min_range <= t < rays.reach:
                continue
            for axis in range(3):
                points[n, axis] = t * direction[axis]
            points[n, 3] = math.floor(min(max(value, echo.least), 0.99) * 100.0 + 0.5) / 100.0
            objects[n] = o
            n += 1
    return n


@njit(cache=True, nogil=True, inline="always")
def _ground_echo(ground: Ground, T: Floats, direction: tuple[float, float, float], t: float, cosine: float) -> Echo:
    """Echo of the ground at the range ``t`` [m]."""
    x, y, z = t * direction[0], t * direction[1], t * direction[2]
    xw = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    yw = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    # Measured: road remission is constant up to 20 m, 0.07 at 25..40 m, 0.00 beyond, with fewer returns.
    value = _ground_remission(ground, xw, yw) * min(max((cosine - 0.04) / 0.034, 0.0), 1.0)
    return Echo(t, value, 0.006 + min(max((0.045 - cosine) / 0.04, 0.0), 0.85), 1.0, 0.0)


@njit(cache=True, nogil=True, inline="always")
def _shape_echo(
    p: Floats, T: Floats, direction: tuple[float, float, float], t: float, leave: float, cosine: float, draw: float
) -> Echo:
    """Echo of a primitive (20,) between the ranges ``t`` and ``leave`` [m]; ``draw`` is uniform in 0..1."""
    material, value, lost, jitter = int(p[1]), p[2], 0.006, 1.0
    if material == PAINT:
        # Clear coat over a dark or light base; specular, so brightest along the normal.
        value *= 0.5 + 0.5 * cosine
        value += 0.5 * max((cosine - 0.97) / 0.03, 0.0) * (0.25 + value) - 0.11
        # Measured: half of the rays on a near car return, a fifth beyond 45 m.
        lost += 0.06 + p[3] * (1.0 - 0.7 * cosine) + min(max((t - 28.0) * 0.02, 0.0), 0.6)
    elif material == GLASS:
        lost += p[3]
        value = 0.02
        if draw < 0.6:  # the far side or a seat behind the pane
            t += (0.15 + 0.8 * draw / 0.6) * max(leave - t - 0.05, 0.0)
            value = 0.04
    elif material == RETRO:
        return Echo(t, value * (0.4 + 0.6 * cosine), lost, jitter, 0.3)
    elif material == LEAVES:
        jitter = 1.6
        value *= 0.75 + 0.5 * draw
    else:
        if material == FACADE and _in_window(p, T, direction, t):
            lost += 0.35
            value *= 0.3
            t += 0.12 / max(cosine, 0.2) + (2.5 * (draw - 0.75) / 0.25 if draw > 0.75 else 0.0)
        value *= 0.55 + 0.45 * cosine
    # Measured: facades 0.43 nearby, 0.31 at 25..40 m, 0.22 beyond; leaves 0.36, 0.23, 0.11.
    value *= min(1.0, max(1.0 - 0.022 * (t - 18.0), 0.35))
    return Echo(t, value, lost + min(max((t - 35.0) * 0.004, 0.0), 0.3), jitter, 0.0)


@njit(cache=True, nogil=True)
def _in_window(p: Floats, T: Floats, direction: tuple[float, float, float], t: float) -> bool:
    """Whether a ray meets a facade in one of its recessed windows, most of which reflect it away from the sensor."""
    dx, dy, dz = direction
    qx, qy, qz = t * dx, t * dy, t * dz
    wx = T[0, 0] * qx + T[0, 1] * qy + T[0, 2] * qz + T[0, 3]
    wy = T[1, 0] * qx + T[1, 1] * qy + T[1, 2] * qz + T[1, 3]
    wz = T[2, 0] * qx + T[2, 1] * qy + T[2, 2] * qz + T[2, 3]
    across = (abs(p[8]) * wx + abs(p[7]) * wy) / max(math.hypot(p[7], p[8]), 1e-9)
    if abs(p[7] * dx + p[8] * dy) < abs(p[10] * dx + p[11] * dy):
        across = (p[7] * wx + p[8] * wy) / max(math.hypot(p[7], p[8]), 1e-9)
    fraction = across / p[3] - math.floor(across / p[3])
    storey = (wz - 0.9) / 2.9 - math.floor((wz - 0.9) / 2.9)
    return fraction < 0.42 and storey < 0.5
