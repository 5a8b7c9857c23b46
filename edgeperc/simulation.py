"""A spinning-LiDAR simulator: streets whose every point, box and drivable cell is known.

A `Scene` is a height field (`_ground_at`: roads, kerbs, pavements, verges) and a table of primitives (boxes with
slanted sides, cylinders, ellipsoids), some of them grouped into objects that move. `simulate` casts one ray a beam and
azimuth step. All rays of one azimuth lie in a plane, so each primitive is tested in its azimuth interval only, and the
ground is solved once an azimuth, from the lowest beam up.

World frame: x forward, y left, z up, metres; the road at the origin is near z = 0.
Numbers called "measured" are from KITTI scans (HDL-64E, 16 drives) and SemanticKITTI sequence 00.
"""

# ruff: noqa: N803 - T_target_source, as everywhere
from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from .card import TopViewGeometry
from .errors import PointsError
from .geometry import draw_footprints
from .perception import Box
from .sensors import SensorProfile, get_sensor

__all__ = [
    "ENVIRONMENTS",
    "POINT_CLASSES",
    "TOP_VIEW_CLASSES",
    "Scene",
    "SceneObject",
    "SimulatedScan",
    "random_scene",
    "scene_from_boxes",
    "sensor_pose",
    "simulate",
    "simulate_sequence",
]

POINT_CLASSES = ("background", "car", "pedestrian", "cyclist")
TOP_VIEW_CLASSES = ("background", "drivable", "car", "van", "truck")
ENVIRONMENTS = ("urban", "residential", "junction", "rural", "highway")

_POINT_LABELS = {"car": 1, "van": 1, "truck": 1, "pedestrian": 2, "cyclist": 3}
_VEHICLES = ("car", "van", "truck")

# A primitive is a row of float64: kind, material, remission, density, centre (3), rows of the matrix that takes an
# offset from the centre into the unit shape (9), taper of the front, rear and sides (3), object (-1: none).
_BOX, _CYLINDER, _ELLIPSOID = 0, 1, 2
_MATTE, _PAINT, _GLASS, _RETRO, _LEAVES, _POROUS, _FACADE = 0, 1, 2, 3, 4, 5, 6
_ROW = 20

# Columns of Scene.strips: origin x, y, cos and sin of the direction, curvature, u range, s range, 1 for a parking bay.
_STRIP = 10
# Entries of Scene.terrain.
(
    _SLOPE_X, _SLOPE_Y, _WAVE_X, _WAVE_X_K, _WAVE_X_0, _WAVE_Y, _WAVE_Y_K, _WAVE_Y_0, _KERB, _PAVEMENT, _CROWN,
    _BANK_SLOPE, _BANK_RISE, _ROUGH, _DITCH, _ROUNDING, _ASPHALT, _PAVING, _GRASS, _MARKING, _LANE, _DROPPED, _WEAR,
    _LIP, _BAY, _TERRAIN,
) = range(26)  # fmt: skip
_TILE = 256  # cells of the noise tile a side; 0.3 m each

_GROUND, _NOTHING = -1, -2  # in place of a primitive's row


@dataclass(frozen=True, slots=True)
class SceneObject:
    """Something with a box that may move.

    Attributes
    ----------
    label : str
        ``"car"``, ``"van"``, ``"truck"``, ``"pedestrian"`` or ``"cyclist"``.
    center : tuple of 3 float
        Middle of the box [m], world frame.
    size : tuple of 3 float
        Length, width, height [m].
    yaw : float
        Heading about +z from +x [rad].
    track_id : int
        The same for as long as the scene lives.
    speed_mps, yaw_rate_rps : float
        Along the heading [m/s]; [rad/s].
    """

    label: str
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float
    track_id: int
    speed_mps: float = 0.0
    yaw_rate_rps: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The world at one moment.

    Attributes
    ----------
    objects : tuple of SceneObject
    primitives : (n, 20) float64
        Shapes; those of an object in the frame of the object (origin in the middle of the footprint, on the ground).
    strips : (k, 10) float64
        Road surfaces and parking bays; the first is the road the sensor is on.
    terrain : (25,) float64
        What the ground is like.
    tile : (256, 256) float64
        Noise in -1..1 that repeats; roughness and stains.
    """

    objects: tuple[SceneObject, ...]
    primitives: NDArray[np.float64]
    strips: NDArray[np.float64]
    terrain: NDArray[np.float64]
    tile: NDArray[np.float64]

    def at(self, t_s: float) -> Scene:
        """The scene ``t_s`` seconds later: objects go on with constant speed and turn rate, over the ground."""
        moved = []
        for each in self.objects:
            turn = each.yaw_rate_rps * t_s
            # Chord of the arc; sinc is 1 for a straight way.
            way = each.speed_mps * t_s * float(np.sinc(turn / (2.0 * math.pi)))
            x = each.center[0] + way * math.cos(each.yaw + turn / 2.0)
            y = each.center[1] + way * math.sin(each.yaw + turn / 2.0)
            z = each.center[2] + self.ground_height(x, y) - self.ground_height(each.center[0], each.center[1])
            moved.append(replace(each, center=(x, y, z), yaw=_wrapped(each.yaw + turn)))
        return replace(self, objects=tuple(moved))

    def ground_height(self, x: float, y: float) -> float:
        """Height of the ground [m] at x, y, world frame."""
        return float(_ground_at(self.strips, self.terrain, self.tile, float(x), float(y))[0])

    def on_road(self, x: float, y: float) -> bool:
        """Whether x, y lies on a road surface (parking bays are none)."""
        return bool(_ground_at(self.strips, self.terrain, self.tile, float(x), float(y))[1] < 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedScan:
    """One turn of the sensor and the truth about it, in the sensor frame.

    Attributes
    ----------
    points : (n, 4) float32
        x, y, z [m], remission 0..0.99 in steps of 0.01; laser by laser from the top, each counter-clockwise from ahead.
    labels : (n,) uint8
        Index into `POINT_CLASSES`.
    objects : (n,) int32
        Index into ``boxes``; -1 for the background.
    boxes : tuple of Box
        Every object of the scene, seen or not.
    box_ids : tuple of int
        Track id of each box.
    box_points : tuple of int
        Points on each box's object.
    T_world_sensor : (4, 4) float64
    scene : Scene
    """

    points: NDArray[np.float32]
    labels: NDArray[np.uint8]
    objects: NDArray[np.int32]
    boxes: tuple[Box, ...]
    box_ids: tuple[int, ...]
    box_points: tuple[int, ...]
    T_world_sensor: NDArray[np.float64]
    scene: Scene

    def top_view_labels(self, geometry: TopViewGeometry | None = None) -> NDArray[np.uint8]:
        """Truth for every cell of a top view, seen or not.

        Parameters
        ----------
        geometry : TopViewGeometry, optional

        Returns
        -------
        (rows, columns) uint8
            Index into `TOP_VIEW_CLASSES`, by the cell's centre: road surface, over it the footprints of vehicles
            (the nearer vehicle wins).
        """
        view = TopViewGeometry() if geometry is None else geometry
        x, y = view.cell_centres()
        labels = np.zeros((view.height, view.width), dtype=np.uint8)
        strips, terrain, tile = self.scene.strips, self.scene.terrain, self.scene.tile
        fill_drivable(strips, terrain, tile, self.T_world_sensor, x.ravel(), y.ravel(), labels)
        draw_footprints(labels, self.boxes, view, TOP_VIEW_CLASSES)
        return labels


def sensor_pose(
    scene: Scene,
    sensor: str | SensorProfile,
    x: float = 0.0,
    y: float = 0.0,
    *,
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
) -> NDArray[np.float64]:
    """``T_world_sensor`` of a sensor at its mounting height above the ground at x, y.

    Returns
    -------
    (4, 4) float64
        Turned by roll about x, then pitch about y (nose down is positive), then yaw about z [rad].
    """
    T_world_sensor = np.eye(4)
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    cr, sr = math.cos(roll), math.sin(roll)
    T_world_sensor[:3, :3] = (
        np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
        @ np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
        @ np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    )
    T_world_sensor[:3, 3] = x, y, scene.ground_height(x, y) + get_sensor(sensor).mount_height_m
    return T_world_sensor


def simulate(
    scene: Scene,
    sensor: str | SensorProfile,
    seed: int,
    T_world_sensor: ArrayLike | None = None,
    *,
    max_range_m: float = 80.0,
    noise: bool = True,
    ego_shadow: bool = True,
) -> SimulatedScan:
    """Turn the sensor once.

    Parameters
    ----------
    scene : Scene
    sensor : str or SensorProfile
    seed : int
        Of noise, drop-out and leaves; the same seed gives the same bits.
    T_world_sensor : (4, 4) array_like, optional
        By default level, looking along +x, ``mount_height_m`` above the ground at the origin. Tilts up to a few
        degrees are meant.
    max_range_m : float
        Nothing farther returns, nor anything beyond the sensor's own range. KITTI's files end at 80 m.
    noise : bool
        False: exact ranges and azimuths, no drop-out, no beam offsets.
    ego_shadow : bool
        Lower beams meet the roof of the sensor's own vehicle, as on KITTI's car. Never where ``noise`` is False.

    Returns
    -------
    SimulatedScan

    Raises
    ------
    PointsError
        ``T_world_sensor`` is no finite (4, 4) matrix.
    """
    profile = get_sensor(sensor)
    pose = sensor_pose(scene, profile) if T_world_sensor is None else np.array(T_world_sensor, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise PointsError(f"T_world_sensor has shape {pose.shape}; expected a finite (4, 4) matrix")
    rng = np.random.default_rng((int(seed) & 0x7FFFFFFFFFFFFFFF, 7919))
    n_beams, n_columns = profile.n_beams, profile.columns
    step = 2.0 * math.pi / n_columns
    azimuths = np.arange(n_columns, dtype=np.float64) * np.float64(step)
    range_offsets, remission_offsets = np.zeros(n_beams), np.zeros(n_beams)
    if noise:
        azimuths += rng.normal(0.0, 0.08, n_columns) * step
        # Measured: a flat road's points lie 0.008 m off their neighbours of the same laser; lasers differ by more.
        range_offsets = rng.normal(0.0, 0.012, n_beams)
        # Measured: mean remission of the road by laser spreads by 0.08, a few lasers almost blind.
        remission_offsets = np.clip(rng.normal(-0.01, 0.075, n_beams), -0.25, 0.1)
    elevations = np.radians(np.asarray(profile.elevations_deg))
    reach = min(float(max_range_m), profile.max_range_m)

    primitives = np.empty_like(scene.primitives)
    poses = np.array([(*o.center[:2], o.center[2] - o.size[2] / 2.0, o.yaw) for o in scene.objects]).reshape(-1, 4)
    fill_placed(scene.primitives, poses, pose, primitives)
    bounds = np.empty((len(primitives), 5))
    fill_bounds(primitives, bounds)
    near_first = np.argsort(bounds[:, 4], kind="stable")
    primitives, bounds = np.ascontiguousarray(primitives[near_first]), np.ascontiguousarray(bounds[near_first])
    starts = np.zeros(n_columns + 1, dtype=np.int64)
    fill_column_counts(bounds, n_columns, reach, starts)
    rows = np.empty(starts[-1], dtype=np.int32)
    fill_column_rows(bounds, n_columns, reach, starts, rows)

    shape = (n_beams, n_columns)
    ranges, exits, cosines = np.empty(shape), np.empty(shape), np.empty(shape)
    hits = np.empty(shape, dtype=np.int32)
    key = np.uint64(rng.integers(0, 2**63))
    fill_cast(
        primitives, bounds, starts, rows, scene.strips, scene.terrain, scene.tile, pose,
        elevations, azimuths, reach, key, ranges, hits, exits, cosines,
    )  # fmt: skip
    points = np.empty((n_beams * n_columns, 4), dtype=np.float32)
    objects = np.empty(n_beams * n_columns, dtype=np.int32)
    n = fill_points(
        primitives, scene.strips, scene.terrain, scene.tile, pose, elevations, azimuths, range_offsets,
        remission_offsets, ranges, hits, exits, cosines, profile.min_range_m, reach, key, noise, noise and ego_shadow,
        points, objects,
    )  # fmt: skip
    points, objects = points[:n].copy(), objects[:n].copy()
    boxes = tuple(_box_in_sensor(each, pose) for each in scene.objects)
    lookup = np.array([*(_POINT_LABELS[each.label] for each in scene.objects), 0], dtype=np.uint8)
    counts = np.bincount(objects[objects >= 0], minlength=len(boxes))
    return SimulatedScan(
        points=points,
        labels=lookup[objects],  # -1 finds the last entry, the background
        objects=objects,
        boxes=boxes,
        box_ids=tuple(each.track_id for each in scene.objects),
        box_points=tuple(int(c) for c in counts),
        T_world_sensor=pose,
        scene=scene,
    )


def simulate_sequence(
    scene: Scene,
    sensor: str | SensorProfile,
    n_scans: int,
    rate_hz: float = 10.0,
    ego_speed_mps: float = 0.0,
    seed: int = 0,
) -> Iterator[tuple[float, NDArray[np.float64], SimulatedScan]]:
    """Drive along the scene's first road from the origin.

    Yields
    ------
    stamp_s : float
    T_world_sensor : (4, 4) float64
    scan : SimulatedScan
        ``scan.box_ids`` tell which object is which from scan to scan.
    """
    curvature = float(scene.strips[0, 4])
    heading = math.atan2(scene.strips[0, 3], scene.strips[0, 2])
    for k in range(n_scans):
        stamp_s = k / rate_hz
        way = ego_speed_mps * stamp_s
        turn = curvature * way
        chord = way * float(np.sinc(turn / (2.0 * math.pi)))
        x, y = chord * math.cos(heading + turn / 2.0), chord * math.sin(heading + turn / 2.0)
        T_world_sensor = sensor_pose(scene, sensor, x, y, yaw=heading + turn)
        yield stamp_s, T_world_sensor, simulate(scene.at(stamp_s), sensor, seed + k, T_world_sensor)


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def _box_in_sensor(each: SceneObject, T_world_sensor: NDArray[np.float64]) -> Box:
    rotation = T_world_sensor[:3, :3]
    x, y, z = rotation.T @ (np.asarray(each.center) - T_world_sensor[:3, 3])
    ahead = rotation.T @ np.array([math.cos(each.yaw), math.sin(each.yaw), 0.0])
    return Box(each.label, 1.0, (float(x), float(y), float(z)), each.size, math.atan2(ahead[1], ahead[0]))


# --- kernels ----------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _mixed(value: np.uint64) -> np.uint64:
    # splitmix64: a draw depends on its ray and purpose alone, not on the order of the rays.
    value = np.uint64(value + np.uint64(0x9E3779B97F4A7C15))
    value = np.uint64((value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9))
    value = np.uint64((value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB))
    return np.uint64(value ^ (value >> np.uint64(31)))


@njit(cache=True, nogil=True)
def _uniform(bits: np.uint64) -> float:
    """In (0, 1)."""
    return (float(bits >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True)
def _normal(bits: np.uint64) -> float:
    # Sum of four 16-bit uniforms, scaled to variance 1: within 3.5 sigma, and one hash a draw.
    total = 0.0
    for k in range(4):
        total += float((bits >> np.uint64(16 * k)) & np.uint64(0xFFFF))
    return (total / 65536.0 - 2.0) * 1.7320508075688772


@njit(cache=True, nogil=True)
def _tile_at(tile: NDArray[np.float64], x: float, y: float, cell_m: float) -> float:
    column, row = x / cell_m, y / cell_m
    left, below = math.floor(column), math.floor(row)
    a, b = column - left, row - below
    i, j = int(below) & (_TILE - 1), int(left) & (_TILE - 1)
    i1, j1 = (i + 1) & (_TILE - 1), (j + 1) & (_TILE - 1)
    return (1.0 - b) * ((1.0 - a) * tile[i, j] + a * tile[i, j1]) + b * ((1.0 - a) * tile[i1, j] + a * tile[i1, j1])


@njit(cache=True, nogil=True)
def _ground_at(
    strips: NDArray[np.float64], terrain: NDArray[np.float64], tile: NDArray[np.float64], x: float, y: float
) -> tuple[float, float, float, float, float]:
    """Height [m], distance out of the roads, out of the bays, and u (left of the first road's axis), s along it [m]."""
    outside, outside_bays, u_first, s_first = 1e9, 1e9, 0.0, 0.0
    for k in range(strips.shape[0]):
        dx, dy = x - strips[k, 0], y - strips[k, 1]
        s = strips[k, 2] * dx + strips[k, 3] * dy
        bend = strips[k, 4] * s
        u = (strips[k, 2] * dy - strips[k, 3] * dx - 0.5 * bend * s) / math.sqrt(1.0 + bend * bend)
        d = max(max(u - strips[k, 6], strips[k, 5] - u), max(strips[k, 7] - s, s - strips[k, 8]))
        if strips[k, 9] > 0.0:
            outside_bays = min(outside_bays, d)
        elif k == 0:
            outside, u_first, s_first = d, u, s
        else:
            # Smooth minimum: rounds the kerbs where roads meet.
            blend = max(terrain[_ROUNDING] - abs(outside - d), 0.0)
            outside = min(outside, d) - blend * blend / (4.0 * terrain[_ROUNDING])
    z = terrain[_SLOPE_X] * x + terrain[_SLOPE_Y] * y
    z += terrain[_WAVE_X] * math.sin(terrain[_WAVE_X_K] * x + terrain[_WAVE_X_0])
    z += terrain[_WAVE_Y] * math.sin(terrain[_WAVE_Y_K] * y + terrain[_WAVE_Y_0])
    d = min(outside, outside_bays)
    if d <= 0.0:
        z += terrain[_CROWN] * min(-d, 4.0)
        if outside > 0.0:
            z += terrain[_LIP]
        return z, outside, outside_bays, u_first, s_first
    kerb = terrain[_KERB]
    along = (s_first + terrain[_DROPPED]) / 23.0
    if along - math.floor(along) < 0.15:
        kerb *= 0.25  # dropped for a driveway
    z += kerb * min(d / 0.05, 1.0) + 0.02 * min(d, terrain[_PAVEMENT])
    e = d - terrain[_PAVEMENT]
    if e > 0.0:
        z += (
            min(terrain[_BANK_SLOPE] * e, terrain[_BANK_RISE])
            if terrain[_BANK_RISE] > 0.0
            else (max(-terrain[_BANK_SLOPE] * e, terrain[_BANK_RISE]))
        )
        basin = (e - 1.6) / 1.2
        z -= terrain[_DITCH] * max(1.0 - basin * basin, 0.0)
        z += min(e / 0.3, 1.0) * terrain[_ROUGH] * (1.0 + _tile_at(tile, x, y, 0.3))
    return z, outside, outside_bays, u_first, s_first


@njit(cache=True, nogil=True)
def fill_drivable(
    strips: NDArray[np.float64],
    terrain: NDArray[np.float64],
    tile: NDArray[np.float64],
    T_world_sensor: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    labels: NDArray[np.uint8],
) -> None:
    """Write 1 into ``labels`` (rows, columns) where a road surface lies below the cell's centre, 0 elsewhere."""
    T = T_world_sensor
    for i in range(x.shape[0]):
        for j in range(y.shape[0]):
            # The ground is about this far below; only a tilted sensor notices.
            z = -T[2, 3]
            xw = T[0, 0] * x[i] + T[0, 1] * y[j] + T[0, 2] * z + T[0, 3]
            yw = T[1, 0] * x[i] + T[1, 1] * y[j] + T[1, 2] * z + T[1, 3]
            labels[i, j] = 1 if _ground_at(strips, terrain, tile, xw, yw)[1] < 0.0 else 0


@njit(cache=True, nogil=True)
def fill_placed(
    primitives: NDArray[np.float64],
    poses: NDArray[np.float64],
    T_world_sensor: NDArray[np.float64],
    placed: NDArray[np.float64],
) -> None:
    """Write the primitives in the sensor frame into ``placed`` (n, 20); ``poses`` (m, 4): x, y, z, yaw of objects."""
    T = T_world_sensor
    for k in range(primitives.shape[0]):
        placed[k] = primitives[k]
        x, y, z, cos, sin = 0.0, 0.0, 0.0, 1.0, 0.0
        o = int(primitives[k, 19])
        if o >= 0:
            x, y, z, cos, sin = poses[o, 0], poses[o, 1], poses[o, 2], math.cos(poses[o, 3]), math.sin(poses[o, 3])
        cx, cy, cz = primitives[k, 4], primitives[k, 5], primitives[k, 6]
        dx = cos * cx - sin * cy + x - T[0, 3]
        dy = sin * cx + cos * cy + y - T[1, 3]
        dz = cz + z - T[2, 3]
        for i in range(3):
            placed[k, 4 + i] = T[0, i] * dx + T[1, i] * dy + T[2, i] * dz
            ax, ay, az = primitives[k, 7 + 3 * i], primitives[k, 8 + 3 * i], primitives[k, 9 + 3 * i]
            wx, wy = cos * ax - sin * ay, sin * ax + cos * ay
            for j in range(3):
                placed[k, 7 + 3 * i + j] = wx * T[0, j] + wy * T[1, j] + az * T[2, j]


@njit(cache=True, nogil=True)
def fill_bounds(primitives: NDArray[np.float64], bounds: NDArray[np.float64]) -> None:
    """Write azimuth from, azimuth width, tan of elevation from, to, and horizontal distance into ``bounds`` (n, 5)."""
    corners = np.empty((8, 3))
    for k in range(primitives.shape[0]):
        p = primitives[k]
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
            # Distance of the outline seen from above: the best separating line along an edge or facing a corner.
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


@njit(cache=True, nogil=True)
def _columns_of(bounds: NDArray[np.float64], k: int, n_columns: int) -> tuple[int, int]:
    # One more to either side: azimuths jitter by a fraction of a step.
    step = 2.0 * math.pi / n_columns
    first = math.floor(bounds[k, 0] / step) - 1
    count = math.ceil(bounds[k, 1] / step) + 4
    return first, min(count, n_columns)


@njit(cache=True, nogil=True)
def fill_column_counts(bounds: NDArray[np.float64], n_columns: int, reach: float, starts: NDArray[np.int64]) -> None:
    """Write where the list of each azimuth step begins into ``starts`` (n_columns + 1,)."""
    starts[:] = 0
    for k in range(bounds.shape[0]):
        if bounds[k, 4] < reach:
            first, count = _columns_of(bounds, k, n_columns)
            for c in range(count):
                starts[(first + c) % n_columns + 1] += 1
    for c in range(n_columns):
        starts[c + 1] += starts[c]


@njit(cache=True, nogil=True)
def fill_column_rows(
    bounds: NDArray[np.float64], n_columns: int, reach: float, starts: NDArray[np.int64], rows: NDArray[np.int32]
) -> None:
    """Write the primitives of each azimuth step, in the order of ``bounds``, into ``rows``."""
    ends = starts.copy()
    for k in range(bounds.shape[0]):
        if bounds[k, 4] < reach:
            first, count = _columns_of(bounds, k, n_columns)
            for c in range(count):
                column = (first + c) % n_columns
                rows[ends[column]] = k
                ends[column] += 1


@njit(cache=True, nogil=True)
def _crossing(p: NDArray[np.float64], dx: float, dy: float, dz: float) -> tuple[float, float, int]:
    """Where a ray from the origin enters and leaves a primitive, and through which face; enters > leaves: it misses."""
    ox = -(p[7] * p[4] + p[8] * p[5] + p[9] * p[6])
    oy = -(p[10] * p[4] + p[11] * p[5] + p[12] * p[6])
    oz = -(p[13] * p[4] + p[14] * p[5] + p[15] * p[6])
    ux = p[7] * dx + p[8] * dy + p[9] * dz
    uy = p[10] * dx + p[11] * dy + p[12] * dz
    uz = p[13] * dx + p[14] * dy + p[15] * dz
    enter, leave, face = -1e9, 1e9, -1
    kind = int(p[0])
    if kind == _ELLIPSOID:
        a = ux * ux + uy * uy + uz * uz
        b = ox * ux + oy * uy + oz * uz
        c = ox * ox + oy * oy + oz * oz - 1.0
        root = b * b - a * c
        if root < 0.0:
            return 1.0, 0.0, -1
        root = math.sqrt(root)
        return (-b - root) / a, (-b + root) / a, 6
    if kind == _CYLINDER:
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
def _cosine(p: NDArray[np.float64], face: int, t: float, dx: float, dy: float, dz: float) -> float:
    """Cosine of the angle between ray and surface normal."""
    nx, ny, nz = 0.0, 0.0, 0.0
    if face == 6:
        qx, qy, qz = t * dx - p[4], t * dy - p[5], t * dz - p[6]
        nx = p[7] * qx + p[8] * qy + p[9] * qz
        ny = p[10] * qx + p[11] * qy + p[12] * qz
        if int(p[0]) == _ELLIPSOID:
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


@njit(cache=True, nogil=True)
def _height_above(
    strips: NDArray[np.float64],
    terrain: NDArray[np.float64],
    tile: NDArray[np.float64],
    T: NDArray[np.float64],
    x: float,
    y: float,
    z: float,
) -> float:
    """Height [m] above the ground of a point in the sensor frame."""
    xw = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    yw = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    zw = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    return zw - _ground_at(strips, terrain, tile, xw, yw)[0]


@njit(cache=True, nogil=True)
def fill_cast(
    primitives: NDArray[np.float64],
    bounds: NDArray[np.float64],
    starts: NDArray[np.int64],
    rows: NDArray[np.int32],
    strips: NDArray[np.float64],
    terrain: NDArray[np.float64],
    tile: NDArray[np.float64],
    T_world_sensor: NDArray[np.float64],
    elevations: NDArray[np.float64],
    azimuths: NDArray[np.float64],
    reach: float,
    key: np.uint64,
    ranges: NDArray[np.float64],
    hits: NDArray[np.int32],
    exits: NDArray[np.float64],
    cosines: NDArray[np.float64],
) -> None:
    """Find what each ray meets first.

    Parameters
    ----------
    primitives : (n, 20) float64
        Sensor frame, nearest first.
    bounds, starts, rows
        From `fill_bounds`, `fill_column_counts`, `fill_column_rows`.
    elevations : (beams,) float64
        Top to bottom [rad].
    azimuths : (columns,) float64
        [rad].
    reach : float
        Longest ray [m].
    key : uint64
        Seed of leaves and fences.
    ranges, hits, exits, cosines : (beams, columns), overwritten
        Range [m]; row of ``primitives``, -1 the ground, -2 nothing; range where the ray leaves that primitive again;
        cosine of the angle of incidence.
    """
    n_beams, n_columns = elevations.shape[0], azimuths.shape[0]
    tangents = np.tan(elevations)
    T = T_world_sensor
    # Radii from well inside the lowest beam's ring, growing by 3 %: at 30 m a third of the way between two rings.
    height = _height_above(strips, terrain, tile, T, 0.0, 0.0, 0.0)
    innermost = min(max(0.3, 0.4 * height / max(-tangents[n_beams - 1], 0.05)), 5.0)
    n_radii = int(math.log(max(reach / innermost, 2.0)) / math.log(1.03)) + 2
    radii, heights = np.empty(n_radii), np.empty(n_radii)
    for i in range(n_radii):
        radii[i] = innermost * 1.03**i
    straight = abs(T[2, 2]) > 0.999999999
    for column in range(n_columns):
        ca, sa = math.cos(azimuths[column]), math.sin(azimuths[column])
        z = -T[2, 3]
        for i in range(n_radii):
            r = radii[i]
            # One Newton step; exact where the sensor stands straight.
            z -= _height_above(strips, terrain, tile, T, r * ca, r * sa, z) / T[2, 2]
            if not straight:
                z -= _height_above(strips, terrain, tile, T, r * ca, r * sa, z) / T[2, 2]
            heights[i] = z
        # A higher beam meets the ground no nearer than a lower one, so one pass over the radii serves all beams.
        i = 0
        for b in range(n_beams - 1, -1, -1):
            tan = tangents[b]
            while i < n_radii and heights[i] < radii[i] * tan:
                i += 1
            ce = math.cos(elevations[b])
            dx, dy, dz = ce * ca, ce * sa, math.sin(elevations[b])
            best, hit, leave_best, face_best = reach, _NOTHING, reach, -1
            cosine = 0.0
            if i < n_radii:
                low = 0.0 if i == 0 else radii[i - 1]
                high = radii[i]
                above = 0.1 if i == 0 else low * tan - heights[i - 1]
                below = high * tan - heights[i]
                r = high
                for _ in range(24):
                    if above - below < 1e-12:
                        break
                    # False position, halved when it creeps: a kerb is a corner.
                    share = above / (above - below)
                    share = min(max(share, 0.1), 0.9) if high - low > 0.02 else share
                    r = low + share * (high - low)
                    gap = _height_above(strips, terrain, tile, T, r * ca, r * sa, r * tan)
                    if abs(gap) < 1e-4:
                        break
                    if gap > 0.0:
                        low, above = r, gap
                    else:
                        high, below = r, gap
                    if high - low < 1e-4:
                        break
                t = r / ce
                if t < best:
                    best, hit, leave_best = t, _GROUND, t
                    # Slope along the ray, over 4 cm.
                    rise = _height_above(strips, terrain, tile, T, (r - 0.02) * ca, (r - 0.02) * sa, r * tan)
                    rise -= _height_above(strips, terrain, tile, T, (r + 0.02) * ca, (r + 0.02) * sa, r * tan)
                    rise /= 0.04
                    cosine = abs(rise * ce - dz) / math.sqrt(1.0 + rise * rise)
            ray = _mixed(np.uint64(key + np.uint64(b * n_columns + column)))
            for e in range(starts[column], starts[column + 1]):
                k = rows[e]
                if bounds[k, 4] >= best:
                    break
                if tan < bounds[k, 2] or tan > bounds[k, 3]:
                    continue
                p = primitives[k]
                enter, leave, face = _crossing(p, dx, dy, dz)
                if enter > leave or leave <= 0.0:
                    continue
                material = int(p[1])
                if material == _LEAVES:
                    # Free path in a cloud of leaves.
                    draw = _uniform(_mixed(np.uint64(ray ^ np.uint64(k + 1))))
                    t = max(enter, 0.0) - math.log(draw) / p[3]
                    if t < leave and t < best:
                        best, hit, leave_best, face_best = t, k, leave, -1
                elif enter > 0.0 and enter < best:
                    if material == _POROUS and _uniform(_mixed(np.uint64(ray ^ np.uint64(k + 1)))) > p[3]:
                        continue
                    best, hit, leave_best, face_best = enter, k, leave, face
            if hit >= 0:
                cosine = 0.7 if face_best < 0 else _cosine(primitives[hit], face_best, best, dx, dy, dz)
            ranges[b, column] = best
            hits[b, column] = hit
            exits[b, column] = leave_best
            cosines[b, column] = cosine


@njit(cache=True, nogil=True)
def _ground_remission(
    strips: NDArray[np.float64], terrain: NDArray[np.float64], tile: NDArray[np.float64], x: float, y: float
) -> float:
    _, outside, outside_bays, u, s = _ground_at(strips, terrain, tile, x, y)
    stain = _tile_at(tile, x, y, 0.11)
    patch = _tile_at(tile, x + 31.0, y + 17.0, 1.7)
    if outside < 0.0:
        value = terrain[_ASPHALT] * (1.0 + terrain[_WEAR] * (0.4 * stain + 0.6 * patch))
        if terrain[_MARKING] > 0.0:
            lane = terrain[_LANE]
            to_line = abs(u / lane - math.floor(u / lane + 0.5)) * lane
            edge = min(abs(u - strips[0, 6] + 0.25), abs(u - strips[0, 5] - 0.25))
            dash = s / 9.0 - math.floor(s / 9.0)
            inner = abs(u - strips[0, 6]) > 1.0 and abs(u - strips[0, 5]) > 1.0
            if edge < 0.06 or (to_line < 0.06 and dash < 0.4 and inner):
                value = terrain[_MARKING] + 0.1 * stain
        return value
    if outside_bays < 0.0:
        return terrain[_BAY] * (1.0 + 0.15 * patch)
    if outside < terrain[_PAVEMENT]:
        return terrain[_PAVING] * (1.0 + 0.1 * stain + 0.1 * patch)
    return terrain[_GRASS] * (1.0 + 0.25 * stain + 0.1 * patch)


@njit(cache=True, nogil=True)
def _in_ego_shadow(azimuth: float, elevation: float) -> bool:
    # Measured on KITTI: where nothing ever returns. The roof behind, its rear edges, its front, a mast to the right.
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
    primitives: NDArray[np.float64],
    strips: NDArray[np.float64],
    terrain: NDArray[np.float64],
    tile: NDArray[np.float64],
    T_world_sensor: NDArray[np.float64],
    elevations: NDArray[np.float64],
    azimuths: NDArray[np.float64],
    range_offsets: NDArray[np.float64],
    remission_offsets: NDArray[np.float64],
    ranges: NDArray[np.float64],
    hits: NDArray[np.int32],
    exits: NDArray[np.float64],
    cosines: NDArray[np.float64],
    min_range: float,
    reach: float,
    key: np.uint64,
    noise: bool,
    ego_shadow: bool,
    points: NDArray[np.float32],
    objects: NDArray[np.int32],
) -> int:
    """Turn hits into returns, laser by laser, and count them.

    Parameters
    ----------
    range_offsets, remission_offsets : (beams,) float64
        Calibration errors of the beams.
    ranges, hits, exits, cosines : (beams, columns)
        From `fill_cast`.
    points : (beams * columns, 4) float32, first rows overwritten
    objects : (beams * columns,) int32, first rows overwritten
        Object of each point, -1 none.
    """
    n_beams, n_columns = hits.shape
    T = T_world_sensor
    n = 0
    for b in range(n_beams):
        ce, se = math.cos(elevations[b]), math.sin(elevations[b])
        for column in range(n_columns):
            k = hits[b, column]
            if k == _NOTHING:
                continue
            t, cosine = ranges[b, column], cosines[b, column]
            ray = _mixed(np.uint64(key ^ np.uint64(0x5DEECE66D) ^ (np.uint64(b * n_columns + column) << np.uint64(20))))
            luck = _uniform(ray)
            ray = _mixed(ray)
            spread = _normal(ray)
            ray = _mixed(ray)
            other = _uniform(ray)
            if ego_shadow and _in_ego_shadow(azimuths[column] + 0.01 * spread, elevations[b] + 0.016 * (other - 0.5)):
                continue
            ca, sa = math.cos(azimuths[column]), math.sin(azimuths[column])
            dx, dy, dz = ce * ca, ce * sa, se
            lost = 0.006
            o = -1
            jitter = 1.0
            floor = 0.0
            if k == _GROUND:
                x, y, z = t * dx, t * dy, t * dz
                value = _ground_remission(
                    strips,
                    terrain,
                    tile,
                    T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
                    T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
                )
                # Measured: the road keeps its remission up to 20 m, has 0.07 at 25..40 m, 0.00 beyond; and thins out.
                value *= min(max((cosine - 0.04) / 0.034, 0.0), 1.0)
                lost += min(max((0.045 - cosine) / 0.04, 0.0), 0.85)
            else:
                p = primitives[k]
                o = int(p[19])
                material = int(p[1])
                value = p[2]
                if material == _PAINT:
                    # Clear coat over a dark or light base; a mirror off the normal.
                    value *= 0.5 + 0.5 * cosine
                    value += 0.5 * max((cosine - 0.97) / 0.03, 0.0) * (0.25 + value) - 0.11
                    # Measured: half as many returns on a near car as its surface would give, a fifth beyond 45 m.
                    lost += 0.06 + p[3] * (1.0 - 0.7 * cosine) + min(max((t - 28.0) * 0.02, 0.0), 0.6)
                elif material == _GLASS:
                    lost += p[3]
                    if other < 0.6:  # the far side or a seat behind the pane
                        t += (0.15 + 0.8 * other / 0.6) * max(exits[b, column] - t - 0.05, 0.0)
                        value = 0.04
                    else:
                        value = 0.02
                elif material == _RETRO:
                    value *= 0.4 + 0.6 * cosine
                elif material == _FACADE:
                    # Windows on a grid, recessed; most of them mirror the ray away.
                    qx, qy, qz = t * dx, t * dy, t * dz
                    wx = T[0, 0] * qx + T[0, 1] * qy + T[0, 2] * qz + T[0, 3]
                    wy = T[1, 0] * qx + T[1, 1] * qy + T[1, 2] * qz + T[1, 3]
                    wz = T[2, 0] * qx + T[2, 1] * qy + T[2, 2] * qz + T[2, 3]
                    across = (abs(p[8]) * wx + abs(p[7]) * wy) / max(math.hypot(p[7], p[8]), 1e-9)
                    if abs(p[7] * dx + p[8] * dy) < abs(p[10] * dx + p[11] * dy):
                        across = (p[7] * wx + p[8] * wy) / max(math.hypot(p[7], p[8]), 1e-9)
                    fraction = across / p[3] - math.floor(across / p[3])
                    storey = (wz - 0.9) / 2.9 - math.floor((wz - 0.9) / 2.9)
                    if fraction < 0.42 and storey < 0.5:
                        lost += 0.35
                        value *= 0.3
                        t += 0.12 / max(cosine, 0.2) + (2.5 * (other - 0.75) / 0.25 if other > 0.75 else 0.0)
                    value *= 0.55 + 0.45 * cosine
                elif material == _LEAVES:
                    jitter = 1.6
                    value *= 0.75 + 0.5 * other
                else:
                    value *= 0.55 + 0.45 * cosine
                if material != _RETRO:
                    # Measured on facades: 0.43 near, 0.31 at 25..40 m, 0.22 beyond; leaves 0.36, 0.23, 0.11.
                    value *= min(1.0, max(1.0 - 0.022 * (t - 18.0), 0.35))
                    lost += min(max((t - 35.0) * 0.004, 0.0), 0.3)
                else:
                    floor = 0.3
            if noise:
                if luck > 1.0 - lost:
                    continue
                t += range_offsets[b] + 0.01 * jitter * spread
                spread = _normal(_mixed(np.uint64(ray ^ np.uint64(0xABCDEF))))
                value += remission_offsets[b] * min(1.0, 0.2 + 4.0 * max(value, 0.0)) + 0.05 * jitter * spread
                # Measured: hardly anything between 0 and 0.1, and 57 % of a car's returns at 0: a weak echo reads 0.
                if value < 0.01 + 0.1 * luck or other > 0.965:
                    value = 0.0
            if not min_range <= t < reach:
                continue
            points[n, 0] = t * dx
            points[n, 1] = t * dy
            points[n, 2] = t * dz
            points[n, 3] = math.floor(min(max(value, floor), 0.99) * 100.0 + 0.5) / 100.0
            objects[n] = o
            n += 1
    return n


# --- shapes -----------------------------------------------------------------------------------------------------------

_Row = tuple[float, ...]
_Vector = tuple[float, float, float]


def _block(
    material: int,
    remission: float,
    center: _Vector,
    size: _Vector,
    *,
    yaw: float = 0.0,
    density: float = 1.0,
    taper: _Vector = (0.0, 0.0, 0.0),
    kind: int = _BOX,
) -> _Row:
    """An upright primitive; ``taper`` is how far front, rear and sides lean in at the top, in half sizes."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    a, b, c = (2.0 / max(edge, 1e-3) for edge in size)
    return (
        kind, material, remission, density, *center, a * cos, a * sin, 0.0, -b * sin, b * cos, 0.0, 0.0, 0.0, c,
        *taper, -1.0,
    )  # fmt: skip


def _blob(material: int, remission: float, center: _Vector, size: _Vector, density: float = 1.0) -> _Row:
    return _block(material, remission, center, size, density=density, kind=_ELLIPSOID)


def _rod(remission: float, start: _Vector, end: _Vector, radius: float, material: int = _MATTE) -> _Row:
    """A cylinder from point to point."""
    along = [e - s for s, e in zip(start, end, strict=True)]
    length = math.sqrt(sum(v * v for v in along))
    ax, ay, az = (v / length for v in along)
    # Any two axes square to the first will do.
    ux, uy, uz = (0.0, az, -ay) if abs(ax) < 0.8 else (-az, 0.0, ax)
    norm = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / norm, uy / norm, uz / norm
    vx, vy, vz = ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux
    r, h = 1.0 / radius, 2.0 / length
    middle = [(s + e) / 2.0 for s, e in zip(start, end, strict=True)]
    return (
        _CYLINDER, material, remission, 1.0, *middle, r * ux, r * uy, r * uz, r * vx, r * vy, r * vz,
        h * ax, h * ay, h * az, 0.0, 0.0, 0.0, -1.0,
    )  # fmt: skip


def _wheels(length: float, width: float, xs: Sequence[float], radius: float) -> list[_Row]:
    side = width / 2.0 - 0.14
    return [_rod(0.03, (x, y - 0.11, radius), (x, y + 0.11, radius), radius) for x in xs for y in (-side, side)]


def _lights(length: float, width: float, z: float, rng: np.random.Generator) -> list[_Row]:
    rows = []
    for end in (-1.0, 1.0):
        x = end * (length / 2.0 - 0.02)
        rows.append(_block(_RETRO, 0.97, (x, 0.0, z - 0.12), (0.04, 0.5, 0.11)))
        if end < 0.0 or rng.random() < 0.4:  # tail lights are reflectors, headlights seldom
            edge = 0.75 if end < 0.0 else 0.45
            rows += [
                _block(_RETRO, edge, (x - end * 0.03, s * (width / 2.0 - 0.2), z + 0.08), (0.08, 0.2, 0.16))
                for s in (-1.0, 1.0)
            ]
    return rows


def _paint(rng: np.random.Generator, light_share: float) -> tuple[float, float]:
    """Remission and drop-out of a coat of paint."""
    # Measured: mean remission of cars 0.01, 0.06, 0.11, 0.18, 0.27 (5, 25, 50, 75, 95 %), of vans 0.24 in the middle.
    if rng.random() < light_share:
        return float(rng.uniform(0.35, 0.6)), float(rng.uniform(0.0, 0.2))
    return float(rng.uniform(0.0, 0.22)), float(rng.uniform(0.1, 0.75))


def _cloth(rng: np.random.Generator) -> float:
    # Measured: mean remission of people 0.29..0.47 with a twelfth at zero; most cloth is bright in the near infrared.
    return float(rng.uniform(0.0, 0.15) if rng.random() < 0.06 else rng.uniform(0.3, 0.6))


def _car(size: _Vector, rng: np.random.Generator) -> list[_Row]:
    length, width, height = size[0] - 0.04, size[1] - 0.04, size[2]
    paint, lost = _paint(rng, 0.3)
    clearance = 0.16 + 0.06 * rng.random()
    belt = height * rng.uniform(0.57, 0.64)
    hood = belt * rng.uniform(0.84, 0.95)
    style = rng.integers(0, 4)  # saloon, hatchback, estate, van-like
    nose = length * (rng.uniform(0.18, 0.25) if style < 3 else rng.uniform(0.28, 0.36))  # where the screen starts
    tail = length * (-0.36 if style == 0 else -0.485)
    sides = rng.uniform(0.14, 0.24)
    screen = rng.uniform(0.45, 0.75) if style < 3 else 0.55
    back = rng.uniform(0.35, 0.6) if style == 0 else rng.uniform(0.08, 0.3)
    half = (nose - tail) / 2.0
    middle = (nose + tail) / 2.0
    roof = height - 0.07
    rise = roof - belt
    rows = [
        _block(_PAINT, paint, (0, 0, (clearance + hood) / 2), (length, width, hood - clearance), density=lost,
               taper=(0.05, 0.04, 0.05)),
        _block(_PAINT, paint, ((nose - length / 2) / 2 - 0.02, 0, (hood + belt) / 2),
               (nose + length / 2 - 0.08, width * 0.97, belt - hood), density=lost, taper=(0.1, 0.02, 0.02)),
        _block(_GLASS, 0.03, (middle, 0, (belt + roof) / 2), (2 * half, width * 0.93, rise),
               density=rng.uniform(0.5, 0.97), taper=(screen * rise / half * 1.6, back * rise / half * 1.6, sides)),
        _block(_PAINT, paint, (0, 0, 0), (1, 1, 1), density=lost),
    ]  # fmt: skip
    # The roof lies on the glass; pillars stand inside its edges.
    front, rear = half * (1 - screen * rise / half * 1.6), half * (1 - back * rise / half * 1.6)
    rows[3] = _block(
        _PAINT, paint, (middle + (front - rear) / 2, 0, (roof + height) / 2),
        (front + rear, width * 0.93 * (1 - sides), height - roof), density=lost, taper=(0.15, 0.1, 0.15),
    )  # fmt: skip
    for x_low, x_high in (
        (middle + half, middle + front),
        (middle - half, middle - rear),
        (middle - 0.05, middle + 0.02),
    ):
        for s in (-1.0, 1.0):
            low = (x_low, s * (width * 0.465 - 0.02), belt)
            high = (x_high, s * (width * 0.465 * (1 - sides) - 0.02), roof)
            rows.append(_rod(paint * 0.7, low, high, 0.045))
    radius = min(0.36, max(0.27, 0.075 * length))
    rows += _wheels(length, width, (-0.3 * length, 0.32 * length), radius)
    return rows + _lights(length, width, 0.62 * belt + 0.1, rng)


def _van(size: _Vector, rng: np.random.Generator) -> list[_Row]:
    length, width, height = size[0] - 0.04, size[1] - 0.04, size[2]
    paint, lost = _paint(rng, 0.65)
    clearance, belt = 0.22, height * rng.uniform(0.5, 0.58)
    nose = length * (0.5 - rng.uniform(0.1, 0.2))
    screen = length * rng.uniform(0.1, 0.16)
    rows = [
        _block(_PAINT, paint, (0, 0, (clearance + belt * 0.9) / 2), (length, width, belt * 0.9 - clearance),
               density=lost, taper=(0.05, 0.0, 0.02)),
        _block(_PAINT, paint, ((nose - length / 2) / 2 + 0.06, 0, belt * 0.95), (nose + length / 2 + 0.12, width * 0.98,
               belt * 0.1), density=lost, taper=(0.05, 0.0, 0.0)),
    ]  # fmt: skip
    glazed = rng.random() < 0.45  # a minibus rather than a panel van
    back = -length / 2 + 0.02
    door = nose - screen - (0.9 if not glazed else 0.0)
    if not glazed:
        rows.append(
            _block(_PAINT, paint, ((back + door) / 2, 0, (belt + height) / 2), (door - back, width * 0.97,
                   height - belt), density=lost, taper=(0.0, 0.01, 0.06))
        )  # fmt: skip
    left = door if not glazed else back
    span = nose - left
    rows.append(
        _block(_GLASS, 0.03, ((nose + left) / 2, 0, (belt + height - 0.12) / 2),
               (span, width * 0.95, height - 0.12 - belt), density=rng.uniform(0.5, 0.97),
               taper=(2 * screen / span, 0.02, 0.08))
    )  # fmt: skip
    rows.append(
        _block(_PAINT, paint, ((nose - screen + back) / 2, 0, height - 0.06), (nose - screen - back, width * 0.9, 0.12),
               density=lost, taper=(0.05, 0.02, 0.05))
    )  # fmt: skip
    for x in (back + 0.05, *((back + nose) * np.array([0.35, 0.65]) if glazed else ())):
        rows += [
            _rod(paint * 0.7, (x, s * (width * 0.475 - 0.02), belt), (x, s * (width * 0.44 - 0.02), height - 0.1), 0.05)
            for s in (-1.0, 1.0)
        ]
    return rows + _wheels(length, width, (-0.3 * length, 0.34 * length), 0.34) + _lights(length, width, 0.9, rng)


def _truck(size: _Vector, rng: np.random.Generator) -> list[_Row]:
    length, width, height = size[0] - 0.04, size[1] - 0.04, size[2]
    paint, lost = _paint(rng, 0.6)
    cargo = float(rng.uniform(0.15, 0.6))
    cab = min(2.3, 0.35 * length)
    cab_height = min(height, 0.75 * height + 0.5)
    front = length / 2
    box_end = front - cab - 0.35
    rows = [
        _block(_PAINT, paint, (front - cab / 2, 0, (0.4 + cab_height) / 2), (cab, width * 0.97, cab_height - 0.4),
               density=lost, taper=(0.12, 0.0, 0.04)),
        _block(_GLASS, 0.03, (front - cab * 0.08 - 0.03, 0, cab_height * 0.66), (0.1, width * 0.85, cab_height * 0.26),
               density=0.7),
        _block(_MATTE, 0.1, (-0.1, 0, 0.75), (length - 0.4, width * 0.4, 0.3)),
    ]  # fmt: skip
    if rng.random() < 0.8:
        rows.append(
            _block(_PAINT if rng.random() < 0.5 else _MATTE, cargo, ((box_end - front) / 2, 0, (1.0 + height) / 2),
                   (box_end + front, width, height - 1.0), density=0.1)
        )  # fmt: skip
    else:  # a tipper or flat bed
        top = 1.0 + (height - 1.0) * rng.uniform(0.3, 0.6)
        bed = (box_end + front, width, top - 1.0)
        rows.append(_block(_MATTE, cargo, ((box_end - front) / 2, 0, (1.0 + top) / 2), bed))
        rows.append(_block(_MATTE, cargo, (box_end - 0.05, 0, (1.0 + height) / 2), (0.1, width, height - 1.0)))
    axles = [front - min(1.3, 0.2 * length), -front + 0.2 * length]
    axles += [-front + 0.2 * length + 1.2] if length > 7.5 else []
    return rows + _wheels(length, width, axles, 0.48) + _lights(length, width, 0.95, rng)


def _pedestrian(size: _Vector, rng: np.random.Generator) -> list[_Row]:
    length, width, h = size
    cloth, trousers, skin = _cloth(rng), _cloth(rng), float(rng.uniform(0.4, 0.55))
    stride = max(0.02, length / 2 - 0.15) * rng.uniform(0.2, 1.0)
    half = max(0.12, width / 2 - 0.1)
    hip, shoulder = 0.5 * h, 0.82 * h
    swing = stride * rng.uniform(0.3, 0.9)
    rows = []
    for s in (-1.0, 1.0):
        foot = (s * stride, s * 0.09, 0.05)
        rows.append(_rod(trousers, (0.0, s * 0.08, hip), foot, 0.09))
        rows.append(_block(_MATTE, 0.2, (foot[0] + 0.04, foot[1], 0.05), (0.2, 0.09, 0.1)))
        hand = (max(-length / 2 + 0.06, min(length / 2 - 0.06, -s * swing)), s * half, 0.47 * h)
        elbow = (hand[0] * 0.3 - 0.03, s * half, 0.63 * h)
        rows.append(_rod(cloth, (0.0, s * half * 0.82, shoulder), elbow, 0.06))
        rows.append(_rod(cloth, elbow, hand, 0.05))
    girth = rng.uniform(0.2, 0.27)
    rows.append(_blob(_MATTE, cloth, (0.0, 0.0, 0.66 * h), (girth * 1.1, min(0.46, 2 * half), 0.42 * h)))
    rows.append(_block(_MATTE, cloth, (0, 0, 0.66 * h), (girth, min(0.4, 1.7 * half), 0.34 * h), kind=_CYLINDER))
    if rng.random() < 0.25:  # a coat or skirt
        rows.append(_block(_MATTE, cloth, (0, 0, 0.42 * h), (0.3, min(0.38, width - 0.04), 0.3 * h), kind=_CYLINDER))
    rows.append(_blob(_MATTE, skin, (0.02, 0.0, 0.93 * h), (0.19, 0.16, 0.14 * h)))
    if rng.random() < 0.3 and length > 0.6:  # a rucksack
        rows.append(_block(_MATTE, 0.3, (-0.2, 0, 0.68 * h), (0.16, 0.28, 0.26 * h)))
    return rows


def _bicycle(length: float, half: float, rng: np.random.Generator, y: float = 0.0) -> list[_Row]:
    r = min(0.35, 0.2 * length)
    axle = length / 2 - r

    def to(a: float, b: float, z: float) -> _Vector:
        return (a, y + b, z)

    rows = []
    for s in (-1.0, 1.0):
        # A wheel is spokes and a rim: most rays pass.
        spokes = _rod(0.2, to(s * axle, -0.02, r), to(s * axle, 0.02, r), r, _POROUS)
        rows.append((*spokes[:3], 0.4, *spokes[4:]))
    seat, head, pedals = to(-0.2 * length, 0, 0.85), to(0.28 * length, 0, 0.85), to(-0.06 * length, 0, 0.3)
    for a, b in ((to(-axle, 0, r), seat), (seat, head), (pedals, head), (head, to(axle, 0, r)), (seat, pedals)):
        rows.append(_rod(0.25, a, b, 0.022))
    rows.append(_rod(0.2, to(0.24 * length, -half, 1.0), to(0.24 * length, half, 1.0), 0.02))
    rows.append(_block(_MATTE, 0.1, to(-0.2 * length, 0, 0.92), (0.25, 0.14, 0.07)))
    if rng.random() < 0.5:
        rows.append(_block(_RETRO, 0.6, to(-0.42 * length, 0, 0.55), (0.05, 0.07, 0.07)))
    return rows


def _cyclist(size: _Vector, rng: np.random.Generator) -> list[_Row]:
    length, width, h = size
    cloth, trousers = _cloth(rng), _cloth(rng)
    half = min(0.24, width / 2 - 0.08)
    hip, lean = (-0.16 * length, 0.0, 0.55 * h), rng.uniform(0.08, 0.24)
    shoulder = (hip[0] + lean * length, 0.0, 0.83 * h)
    rows = _bicycle(length, min(0.27, width / 2 - 0.02), rng)
    crank = rng.uniform(-0.13, 0.13)
    for s in (-1.0, 1.0):
        knee = (0.1 * length + s * crank * 0.5, s * 0.12, 0.45 * h + s * crank * 0.6)
        rows.append(_rod(trousers, (hip[0], s * 0.09, hip[2]), knee, 0.08))
        rows.append(_rod(trousers, knee, (-0.04 * length, s * 0.12, 0.22 + s * crank), 0.055))
        elbow = ((shoulder[0] + 0.24 * length) / 2 - 0.03, s * half, 0.69 * h)
        rows.append(_rod(cloth, (shoulder[0], s * 0.19, shoulder[2]), elbow, 0.05))
        rows.append(_rod(cloth, elbow, (0.24 * length, s * half, 1.02), 0.04))
    rows.append(_rod(cloth, hip, shoulder, min(0.17, width / 2 - 0.02)))
    middle = tuple((a + b) / 2 for a, b in zip(hip, shoulder, strict=True))
    rows.append(_blob(_MATTE, cloth, (middle[0], 0.0, middle[2]), (0.34, min(0.42, width - 0.02), 0.4 * h)))
    rows.append(_blob(_MATTE, 0.45, (shoulder[0] + 0.06, 0, 0.93 * h), (0.22, 0.18, 0.14 * h)))
    return rows


_SHAPES: dict[str, Callable[[_Vector, np.random.Generator], list[_Row]]] = {
    "car": _car,
    "van": _van,
    "truck": _truck,
    "pedestrian": _pedestrian,
    "cyclist": _cyclist,
}
# Mean and spread of length, width, height: KITTI labels. Limits are two spreads.
_SIZES: dict[str, tuple[_Vector, _Vector]] = {
    "car": ((3.9, 1.63, 1.52), (0.42, 0.1, 0.13)),
    "van": ((5.0, 1.9, 2.18), (0.7, 0.13, 0.3)),
    "truck": ((9.5, 2.55, 3.2), (2.8, 0.15, 0.35)),
    "pedestrian": ((0.82, 0.66, 1.76), (0.22, 0.13, 0.1)),
    "cyclist": ((1.76, 0.6, 1.74), (0.12, 0.1, 0.08)),
}


# --- streets ----------------------------------------------------------------------------------------------------------


class _Street:
    """A scene in the making: puts things beside and on its roads, where nothing stands yet."""

    def __init__(self, rng: np.random.Generator, strips: list[_Row], terrain: NDArray[np.float64]) -> None:
        self.rng = rng
        self.strips = np.array(strips, dtype=np.float64).reshape(-1, _STRIP)
        self.terrain = terrain
        self.tile = _noise_tile(rng)
        self.objects: list[SceneObject] = []
        self.rows: list[_Row] = []
        self.taken: list[tuple[float, float, float, float, float, float, float]] = []

    def scene(self) -> Scene:
        rows = np.array(self.rows, dtype=np.float64).reshape(-1, _ROW)
        return Scene(tuple(self.objects), rows, self.strips, self.terrain, self.tile)

    def ground(self, x: float, y: float) -> tuple[float, float]:
        """Height, and distance out of the roads."""
        z, outside, _, _, _ = _ground_at(self.strips, self.terrain, self.tile, float(x), float(y))
        return z, outside

    def edge(self, road: int, side: float) -> float:
        """How far a road reaches to the left (1) or right (-1) of its axis [m]; bays along the first one count."""
        beside = self.strips[:, 9] > 0.0 if road == 0 else np.zeros(len(self.strips), np.bool_)
        beside[road] = True
        return float((side * self.strips[beside, 6 if side > 0 else 5]).max())

    def on_strip(self, s: float, u: float, strip: int = 0) -> _Vector:
        """x, y and direction of the road at s along, u to the left of a strip's axis."""
        x0, y0, cos, sin, curvature = self.strips[strip, :5]
        slope = curvature * s
        turn = math.atan(slope)
        a, b = s - u * math.sin(turn), 0.5 * slope * s + u * math.cos(turn)
        return x0 + cos * a - sin * b, y0 + sin * a + cos * b, math.atan2(sin, cos) + turn

    def free(self, x: float, y: float, length: float, width: float, yaw: float, gap: float = 0.25) -> bool:
        """Whether a rectangle touches nothing that stands already, the sensor's vehicle included."""
        a, b = length / 2 + gap, width / 2 + gap
        cos, sin = math.cos(yaw), math.sin(yaw)
        reach = math.hypot(a, b)
        for x2, y2, cos2, sin2, a2, b2, reach2 in self.taken:
            dx, dy = x2 - x, y2 - y
            if dx * dx + dy * dy > (reach + reach2) ** 2:
                continue
            c, s = abs(cos * cos2 + sin * sin2), abs(cos * sin2 - sin * cos2)
            # Separating axes of two rectangles.
            if (
                abs(cos * dx + sin * dy) <= a + c * a2 + s * b2
                and abs(cos * dy - sin * dx) <= b + s * a2 + c * b2
                and abs(cos2 * dx + sin2 * dy) <= a2 + c * a + s * b
                and abs(cos2 * dy - sin2 * dx) <= b2 + s * a + c * b
            ):
                return False
        return True

    def take(self, x: float, y: float, length: float, width: float, yaw: float) -> None:
        a, b = length / 2, width / 2
        self.taken.append((x, y, math.cos(yaw), math.sin(yaw), a, b, math.hypot(a, b)))

    def add_object(
        self,
        label: str,
        x: float,
        y: float,
        yaw: float,
        size: _Vector | None = None,
        speed_mps: float = 0.0,
        yaw_rate_rps: float = 0.0,
        *,
        force: bool = False,
    ) -> bool:
        if size is None:
            mean, spread = _SIZES[label]
            shift = np.clip(self.rng.normal(size=3), -2, 2)
            size = tuple(m + d * s for m, d, s in zip(mean, shift.tolist(), spread, strict=True))
        if not force and not self.free(x, y, size[0], size[1], yaw):
            return False
        self.take(x, y, size[0], size[1], yaw)
        index = float(len(self.objects))
        z, _ = self.ground(x, y)
        center = (float(x), float(y), float(z + size[2] / 2))
        size = (float(size[0]), float(size[1]), float(size[2]))
        self.objects.append(
            SceneObject(label, center, size, _wrapped(float(yaw)), len(self.objects), float(speed_mps), yaw_rate_rps)
        )
        self.rows += [(*row[:-1], index) for row in _SHAPES[label](size, self.rng)]
        return True

    def add_static(
        self, rows: list[_Row], x: float, y: float, length: float, width: float, yaw: float, off_road: float = 0.1
    ) -> bool:
        """Rows are in a frame at x, y on the ground, turned by yaw. Stays clear of roads and of what stands there."""
        cos, sin = math.cos(yaw), math.sin(yaw)
        steps = max(1, math.ceil(length / 4.0))
        for k in range(-steps, steps + 1):
            for side in (-0.5, 0.5):
                a, b = k / steps * length / 2, side * width
                if self.ground(x + cos * a - sin * b, y + sin * a + cos * b)[1] < off_road:
                    return False
        if not self.free(x, y, length, width, yaw, 0.1):
            return False
        self.take(x, y, length, width, yaw)
        z, _ = self.ground(x, y)
        for row in rows:
            cx, cy, cz = row[4:7]
            axes = []
            for i in (7, 10, 13):
                axes += [cos * row[i] - sin * row[i + 1], sin * row[i] + cos * row[i + 1], row[i + 2]]
            self.rows.append((*row[:4], x + cos * cx - sin * cy, y + sin * cx + cos * cy, z + cz, *axes, *row[16:]))
        return True

    # What stands beside a road.

    def tree(self, x: float, y: float) -> bool:
        rng = self.rng
        height, bole, radius = rng.uniform(4, 13), rng.uniform(1.4, 3.2), rng.uniform(0.07, 0.28)
        spread = rng.uniform(1.2, 3.4)
        rows = [_rod(rng.uniform(0.25, 0.45), (0, 0, -0.3), (rng.normal(0, 0.1), rng.normal(0, 0.1), bole + 1), radius)]
        if rng.random() < 0.15:  # a conifer
            for level in np.linspace(0.6, height, 6):
                w = 2 * spread * (1.05 - level / height)
                rows.append(_blob(_LEAVES, 0.34, (0, 0, level), (w, w, height / 4), 1.6))
        else:
            leaf, density = rng.uniform(0.32, 0.46), rng.uniform(0.4, 1.6)
            for _ in range(int(rng.integers(5, 14))):
                turn, away = rng.uniform(0, 2 * math.pi), spread * math.sqrt(rng.random()) * 0.8
                level = rng.uniform(bole + 0.5, height)
                w = spread * rng.uniform(0.35, 1.1)
                center = (away * math.cos(turn), away * math.sin(turn), level)
                rows.append(_blob(_LEAVES, leaf, center, (w, w, 0.9 * w), density))
        return self.add_static(rows, x, y, 2 * radius, 2 * radius, 0.0, 0.35)

    def bush(self, x: float, y: float, size: float) -> bool:
        rng = self.rng
        leaf = rng.uniform(0.3, 0.46)
        rows = []
        for _ in range(int(rng.integers(3, 10))):
            w, h = size * rng.uniform(0.2, 0.9), size * rng.uniform(0.3, 0.9)
            x_off, y_off = (rng.normal(0, 0.25, 2) * size).tolist()
            center = (x_off, y_off, 0.4 * h + rng.uniform(0.0, 0.4) * size)
            rows.append(_blob(_LEAVES, leaf, center, (w, w * rng.uniform(0.6, 1.4), h), rng.uniform(0.8, 5)))
        return self.add_static(rows, x, y, size * 0.8, size * 0.8, 0.0, 0.3)

    def pole(self, x: float, y: float, yaw: float) -> bool:
        rng = self.rng
        kind = rng.integers(0, 5)
        if kind == 0:  # a lamp
            rows = [_rod(0.3, (0, 0, 0), (0, 0, rng.uniform(5, 9)), rng.uniform(0.06, 0.11))]
        elif kind <= 2:  # a traffic sign
            top = rng.uniform(2.0, 2.9)
            rows = [_rod(0.3, (0, 0, 0), (0, 0, top + 0.3), 0.035)]
            edge = rng.uniform(0.45, 0.8)
            rows.append(_block(_RETRO, 0.99, (-0.05, 0, top), (0.03, edge, edge * rng.uniform(0.6, 1.5))))
        elif kind == 3:  # a bollard or reflector post
            rows = [_rod(0.4, (0, 0, 0), (0, 0, rng.uniform(0.8, 1.1)), rng.uniform(0.05, 0.1))]
            rows.append(_block(_RETRO, 0.9, (-0.06, 0, 0.75), (0.05, 0.06, 0.15)))
        else:  # a cabinet, a bin or a post box
            h = rng.uniform(0.9, 1.5)
            size = (rng.uniform(0.3, 0.6), rng.uniform(0.4, 1.2), h)
            rows = [_block(_MATTE, rng.uniform(0.1, 0.6), (0, 0, h / 2), size)]
        return self.add_static(rows, x, y, 0.3, 0.4, yaw, 0.2)

    def building(self, x: float, y: float, yaw: float, length: float, depth: float) -> bool:
        rng = self.rng
        height, wall = rng.uniform(3.2, 11.0), rng.uniform(0.34, 0.55)
        rows = [
            _block(_FACADE, wall, (0, 0, height / 2 - 1), (length, depth, height + 2), density=rng.uniform(1.6, 3.4)),
            _block(_MATTE, 0.25, (0, 0, height + 1.3), (length + 0.5, depth + 0.7, 2.6), taper=(0.0, 0.0, 0.9)),
        ]
        for _ in range(int(rng.integers(0, 3))):  # porches, bays, steps
            w, h = rng.uniform(0.8, 2.5), rng.choice([0.4, 2.4, height])
            rows.append(
                _block(_MATTE, wall, (rng.uniform(-0.4, 0.4) * length, -rng.choice([-1, 1]) * depth / 2, h / 2),
                       (w, rng.uniform(0.6, 1.6), h))
            )  # fmt: skip
        return self.add_static(rows, x, y, length + 0.4, depth + 1.4, yaw, 0.8)

    def barrier(self, kind: str, x: float, y: float, yaw: float, length: float, off_road: float = 0.15) -> bool:
        rng = self.rng
        if kind == "hedge":
            h, w = rng.uniform(0.9, 2.2), rng.uniform(0.5, 1.1)
            rows = [_block(_LEAVES, rng.uniform(0.32, 0.46), (0, 0, h / 2), (length, w, h), density=rng.uniform(4, 10))]
        elif kind == "wall":
            h, w = rng.uniform(0.5, 2.2), 0.25
            rows = [_block(_MATTE, rng.uniform(0.3, 0.5), (0, 0, h / 2 - 0.2), (length, w, h + 0.4))]
        elif kind == "rail":
            h, w = 0.75, 0.12
            rows = [_block(_MATTE, 0.35, (0, 0, 0.6), (length, 0.08, 0.3))]
            posts = np.arange(-length / 2, length / 2, 4.0)
            rows += [_block(_MATTE, 0.35, (a, -0.08, 0.35), (0.06, 0.1, 0.7)) for a in posts]
        else:
            h, w = rng.uniform(0.9, 1.8), 0.06
            rows = [_block(_POROUS, 0.3, (0, 0, h / 2), (length, 0.04, h), density=rng.uniform(0.2, 0.7))]
            rows += [_rod(0.3, (a, 0, 0), (a, 0, h + 0.05), 0.04) for a in np.arange(-length / 2, length / 2, 2.5)]
        return self.add_static(rows, x, y, length, w, yaw, off_road)


def _noise_tile(rng: np.random.Generator) -> NDArray[np.float64]:
    # Three octaves that wrap round: fine, half and eighth resolution.
    tile = rng.uniform(-1.0, 1.0, (_TILE, _TILE))
    for scale in (2, 8):
        coarse = rng.uniform(-1.0, 1.0, (_TILE // scale, _TILE // scale))
        smooth = np.repeat(np.repeat(coarse, scale, axis=0), scale, axis=1)
        for axis in (0, 1):
            smooth = sum((np.roll(smooth, k, axis) for k in range(scale)), np.zeros_like(smooth)) / scale
        tile = tile + smooth * (1.0 if scale == 2 else 1.6)
    return np.ascontiguousarray(np.clip(tile / 2.2, -1.0, 1.0))


def _terrain(rng: np.random.Generator, environment: str) -> NDArray[np.float64]:
    terrain = np.zeros(_TERRAIN)
    open_land = environment in ("rural", "highway")
    terrain[[_SLOPE_X, _SLOPE_Y]] = rng.normal(0.0, 0.008, 2)
    terrain[[_WAVE_X, _WAVE_Y]] = rng.uniform(0.0, 0.25 if open_land else 0.12, 2)
    terrain[[_WAVE_X_K, _WAVE_Y_K]] = 2.0 * math.pi / rng.uniform(45.0, 140.0, 2)
    # Waves that are zero at the origin.
    terrain[[_WAVE_X_0, _WAVE_Y_0]] = rng.choice([0.0, math.pi], 2)
    terrain[_CROWN] = rng.uniform(0.0, 0.025)
    terrain[_KERB] = 0.0 if open_land else rng.choice([0.03, 0.08, 0.12, 0.15, 0.18], p=[0.15, 0.2, 0.3, 0.25, 0.1])
    terrain[_PAVEMENT] = rng.uniform(0.0, 0.7) if open_land else rng.uniform(1.2, 4.5)
    terrain[_BANK_SLOPE] = abs(rng.normal(0.0, 0.12 if open_land else 0.03))
    terrain[_BANK_RISE] = rng.uniform(0.2, 1.6) * (1.0 if rng.random() < 0.65 else -1.0)
    terrain[_ROUGH] = rng.uniform(0.02, 0.12) if open_land else rng.uniform(0.01, 0.06)
    terrain[_DITCH] = rng.uniform(0.0, 0.5) if open_land and rng.random() < 0.5 else 0.0
    terrain[_ROUNDING] = rng.uniform(3.0, 9.0)
    # Measured: asphalt 0.2..0.3 by road, pavement and parking 0.30, grass 0.37.
    terrain[_ASPHALT] = rng.uniform(0.19, 0.33)
    terrain[_PAVING] = rng.uniform(0.24, 0.36)
    terrain[_GRASS] = rng.uniform(0.33, 0.45)
    terrain[_MARKING] = rng.uniform(0.35, 0.6) if rng.random() < (0.9 if open_land else 0.55) else 0.0
    terrain[_LANE] = 3.4
    terrain[_DROPPED] = rng.uniform(0.0, 23.0)
    terrain[_WEAR] = rng.uniform(0.1, 0.35)
    # Of parking bays: paved like the pavement with a lip, or the road's own asphalt behind a line.
    terrain[_LIP] = rng.uniform(0.0, 0.04)
    terrain[_BAY] = terrain[_PAVING if rng.random() < 0.5 else _ASPHALT]
    return terrain


def _strip(
    x: float, y: float, yaw: float, curvature: float, right: float, left: float,
    s_range: tuple[float, float] = (-200.0, 200.0), bay: bool = False,
) -> _Row:  # fmt: skip
    return (x, y, math.cos(yaw), math.sin(yaw), curvature, right, left, *s_range, float(bay))


# A row of parked cars is as wide as this, and as often as this no part of the road: SemanticKITTI tells them apart.
_ROW_WIDTH_M = 2.1
_ROW_RANGE_M = (-70.0, 78.0)
_IN_BAYS = 0.75
_ROW_GAP_M = 9.0  # from one parked car's middle to the next one's


def random_scene(seed: int, environment: str | None = None) -> Scene:
    """A street that might be.

    Parameters
    ----------
    seed : int
        The same seed gives the same scene.
    environment : str, optional
        One of `ENVIRONMENTS`; drawn by default.

    Raises
    ------
    PointsError
        ``environment`` is none of `ENVIRONMENTS`.
    """
    rng = np.random.default_rng((int(seed) & 0x7FFFFFFFFFFFFFFF, 104729))
    place = str(rng.choice(ENVIRONMENTS, p=[0.32, 0.28, 0.2, 0.12, 0.08])) if environment is None else environment
    if place not in ENVIRONMENTS:
        raise PointsError(f"got environment {place!r}; expected one of {', '.join(ENVIRONMENTS)}")
    terrain = _terrain(rng, place)
    lane = float(rng.uniform(2.7, 3.7) if place != "highway" else rng.uniform(3.5, 3.9))
    terrain[_LANE] = lane
    same, oncoming = 1, 1
    if place == "highway":
        same, oncoming = int(rng.integers(2, 4)), 0
    elif place in ("urban", "junction"):
        same, oncoming = ((1, 1), (1, 0), (2, 1), (2, 2))[int(rng.integers(0, 4))]
    park_right = park_left = 0.0
    if place in ("urban", "residential", "junction"):
        park_right, park_left = (_ROW_WIDTH_M if rng.random() < 0.5 else 0.0 for _ in range(2))
    in_bays = rng.random() < _IN_BAYS
    ego_lane = int(rng.integers(0, same))  # from the right
    sway = float(rng.normal(0.0, 0.25))
    right = -lane / 2 - ego_lane * lane - park_right + sway - rng.uniform(0.0, 0.6)
    left = lane / 2 + (same - 1 - ego_lane + oncoming) * lane + park_left + sway + rng.uniform(0.0, 0.6)
    curvature = float(rng.normal(0.0, 0.004)) if rng.random() < 0.6 else 0.0
    heading = float(rng.normal(0.0, 0.03))
    strips = [_strip(0, 0, heading, curvature, right, left)]
    crossings: list[float] = []
    if place == "junction" or (place != "highway" and rng.random() < 0.3):
        for _ in range(int(rng.integers(1, 3))):
            s = float(rng.uniform(8.0, 60.0) * rng.choice([1.0, 1.0, -1.0]))
            if any(abs(s - other) < 20.0 for other in crossings):
                continue
            crossings.append(s)
            x, y, turn = math.cos(heading) * s, math.sin(heading) * s + curvature * s * s / 2, heading + curvature * s
            across = turn + math.pi / 2 + float(rng.normal(0.0, 0.2))
            width = float(rng.uniform(2.6, 5.5))
            ends = ((-200.0, 200.0), (0.0, 200.0), (-200.0, 0.0))[int(rng.integers(0, 3))]
            strips.append(_strip(x, y, across, float(rng.normal(0, 0.004)), -width, width, ends))
    if in_bays:
        right, left = right + park_right, left - park_left
        strips[0] = _strip(0, 0, heading, curvature, right, left)
        for edge, width in ((right - park_right, park_right), (left, park_left)):
            if width > 0.0:
                strips.append(_strip(0, 0, heading, curvature, edge, edge + width, _ROW_RANGE_M, True))
        park_right = park_left = 0.0
    if place in ("urban", "residential") and strips[-1][9] == 0.0 and rng.random() < 0.5:
        side = float(rng.choice([-1.0, 1.0]))
        start = float(rng.uniform(-30.0, 30.0))
        edge = left if side > 0 else -right
        deep = float(rng.choice([2.3, 5.0]))
        bay = (edge, edge + deep) if side > 0 else (-edge - deep, -edge)
        strips.append(_strip(0, 0, heading, curvature, *bay, (start, start + float(rng.uniform(10.0, 45.0))), True))
    street = _Street(rng, strips, terrain)
    street.take(-0.3, 0.0, 4.8, 2.2, 0.0)  # the sensor's own vehicle
    _add_traffic(street, place, lane, same, oncoming, ego_lane, sway, crossings)
    _add_parked(street, park_right > 0.0, park_left > 0.0, crossings, place)
    _add_people(street, place)
    _add_roadside(street, place)
    return street.scene()


def _add_traffic(
    street: _Street,
    place: str,
    lane: float,
    same: int,
    oncoming: int,
    ego_lane: int,
    sway: float,
    crossings: Sequence[float],
) -> None:
    rng = street.rng
    density = {"urban": 0.022, "residential": 0.008, "junction": 0.022, "rural": 0.008, "highway": 0.016}[place]
    density *= rng.uniform(0.1, 1.8)
    pace = {"urban": 9.0, "residential": 7.0, "junction": 7.0, "rural": 18.0, "highway": 27.0}[place]
    for number in range(-ego_lane, same - ego_lane + oncoming):
        u = sway + number * lane
        against = number >= same - ego_lane
        for _ in range(int(rng.poisson(density * 150.0))):
            s = float(rng.uniform(-70.0, 80.0))
            x, y, yaw = street.on_strip(s, u + float(rng.normal(0.0, 0.25)))
            label = _any_vehicle(rng, 0.12 if place == "highway" else 0.05)
            speed = pace * rng.uniform(0.3, 1.2) if rng.random() < 0.8 else 0.0
            turn = float(street.strips[0, 4]) * speed * (-1.0 if against else 1.0)
            yaw += math.pi * against + float(rng.normal(0.0, 0.03))
            street.add_object(label, x, y, yaw, None, speed, turn)
    for k in range(1, len(street.strips)):
        if street.strips[k, 9] > 0.0:
            continue
        for _ in range(int(rng.poisson(2.5))):
            s = float(rng.uniform(street.strips[k, 7], street.strips[k, 8])) * 0.2
            against = bool(rng.random() < 0.5)
            u = street.strips[k, 6] * 0.5 * (1.0 if against else -1.0)
            x, y, yaw = street.on_strip(s, u, k)
            if street.ground(x, y)[1] < -1.0:
                label = _any_vehicle(rng, 0.05)
                street.add_object(label, x, y, yaw + math.pi * against, None, float(rng.choice([0.0, 5.0])))
    if place != "highway":
        for _ in range(int(rng.poisson(1.6))):
            left = bool(rng.random() < 0.35)
            edge = street.strips[0, 6] if left else street.strips[0, 5]
            s = float(rng.uniform(-30.0, 45.0))
            x, y, yaw = street.on_strip(s, edge + float(rng.uniform(0.4, 2.6)) * (-1 if left else 1))
            yaw += math.pi * left + float(rng.normal(0, 0.15))
            street.add_object("cyclist", x, y, yaw, None, float(rng.uniform(1.0, 7.0)))


def _any_vehicle(rng: np.random.Generator, trucks: float) -> str:
    return str(rng.choice(["car", "van", "truck"], p=[0.84 - trucks, 0.16, trucks]))


def _add_parked(street: _Street, right: bool, left: bool, crossings: Sequence[float], place: str) -> None:
    rng = street.rng
    for on, side in ((right, -1.0), (left, 1.0)):
        fill = rng.uniform(0.2, 0.95)
        edge = abs(float(street.strips[0, 6 if side > 0 else 5]))
        shift = rng.uniform(-0.9, 0.1) if on else rng.uniform(0.3, 1.3)  # else: half on the pavement, now and then
        if not on and (rng.random() > 0.25 or place in ("rural", "highway")):
            continue
        s = -70.0
        while s < 78.0:
            label = _any_vehicle(rng, 0.02)
            length = _SIZES[label][0][0]
            s += length / 2
            if rng.random() < fill and all(abs(s - c) > 9.0 for c in crossings):
                x, y, yaw = street.on_strip(s, side * (edge + shift - 0.9 + float(rng.normal(0, 0.12))))
                yaw += math.pi * bool(rng.random() < (0.12 if side < 0 else 0.75)) + float(rng.normal(0, 0.03))
                street.add_object(label, x, y, yaw)
            s += length / 2 + rng.uniform(0.5, 1.6)
    for k in range(1, len(street.strips)):
        u0, u1, s0, s1, bay = street.strips[k, 5:10]
        if bay == 0.0:
            continue
        deep, fill = u1 - u0 > 4.0, rng.uniform(0.1, 0.95)
        for s in np.arange(s0 + 1.3, s1 - 1.0, 2.6 if deep else 5.6):
            if rng.random() < fill:
                x, y, yaw = street.on_strip(s, float((u0 + u1) / 2 + rng.normal(0, 0.15)), k)
                if street.ground(x, y)[1] < 0.0:
                    continue  # where another road crosses
                turn = math.pi / 2 if deep else 0.0
                yaw += turn + math.pi * bool(rng.random() < 0.5) + float(rng.normal(0, 0.04))
                street.add_object("car" if rng.random() < 0.85 else "van", x, y, yaw)
    if place in ("urban", "residential", "junction"):  # cars in drives and yards
        for _ in range(int(rng.poisson(3.0))):
            side = float(rng.choice([-1.0, 1.0]))
            edge = street.edge(0, side) + street.terrain[_PAVEMENT]
            x, y, yaw = street.on_strip(float(rng.uniform(-50, 70)), side * float(edge + rng.uniform(2.5, 9.0)))
            if street.ground(x, y)[1] > 2.0:
                street.add_object("car", x, y, yaw + float(rng.choice([0.0, 0.5, 1.0, 1.5]) * math.pi))


def _add_people(street: _Street, place: str) -> None:
    rng = street.rng
    mean = {"urban": 7.0, "residential": 3.0, "junction": 7.0, "rural": 0.4, "highway": 0.0}[place]
    for _ in range(int(rng.poisson(mean))):
        side = float(rng.choice([-1.0, 1.0]))
        edge = street.edge(0, side)
        s = float(rng.uniform(-30.0, 50.0))
        u = side * (edge + float(rng.uniform(0.4, max(0.8, street.terrain[_PAVEMENT]))))
        if rng.random() < 0.1:
            u = float(rng.uniform(-edge, edge))  # on the road
        x, y, yaw = street.on_strip(s, u)
        yaw += float(rng.choice([0.0, math.pi])) if rng.random() < 0.75 else float(rng.uniform(-math.pi, math.pi))
        speed = float(rng.uniform(0.6, 1.8)) if rng.random() < 0.75 else 0.0
        for _ in range(1 + int(rng.integers(1, 4)) * bool(rng.random() < 0.3)):  # alone, or in a group
            px, py = x + float(rng.normal(0, 0.5)), y + float(rng.normal(0, 0.5))
            street.add_object("pedestrian", px, py, yaw + float(rng.normal(0, 0.2)), None, speed)
    for _ in range(int(rng.poisson(1.0 if place in ("urban", "junction") else 0.2))):  # bicycles without a rider
        side = float(rng.choice([-1.0, 1.0]))
        edge = street.edge(0, side)
        x, y, yaw = street.on_strip(float(rng.uniform(-20, 40)), side * (edge + float(rng.uniform(0.6, 3.0))))
        yaw += float(rng.choice([0.0, math.pi / 2])) + float(rng.normal(0, 0.1))
        rows: list[_Row] = []
        n = int(rng.integers(1, 6))
        for k in range(n):
            rows += _bicycle(1.75, 0.27, rng, (k - (n - 1) / 2) * 0.5)
        street.add_static(rows, x, y, 1.8, 0.5 * n, yaw)


def _add_roadside(street: _Street, place: str) -> None:
    rng = street.rng
    pavement = float(street.terrain[_PAVEMENT])
    built = {"urban": 0.85, "residential": 0.65, "junction": 0.6, "rural": 0.06, "highway": 0.0}[place]
    built *= rng.uniform(0.3, 1.1)
    n_roads = int(np.count_nonzero(street.strips[:, 9] == 0.0))
    for k in range(n_roads):
        for side in (-1.0, 1.0):
            edge = street.edge(k, side)
            setback = pavement + (rng.uniform(0.1, 7.0) if place == "urban" else rng.uniform(3.0, 16.0))
            border = str(rng.choice(["hedge", "wall", "fence", "none"], p=[0.3, 0.2, 0.2, 0.3]))
            if place == "highway":
                border = "rail"
            green = {"urban": 0.35, "residential": 1.0, "junction": 0.6, "rural": 1.4, "highway": 0.8}[place]
            green *= rng.uniform(0.2, 1.8)
            low, high = max(-85.0, street.strips[k, 7]), min(85.0, street.strips[k, 8])
            s = low
            while s < high:
                if rng.random() < built:
                    length, depth = rng.uniform(7.0, 22.0), rng.uniform(6.0, 11.0)
                    u = side * (edge + setback + depth / 2 + rng.normal(0, 0.3))
                    x, y, yaw = street.on_strip(s + length / 2, u, k)
                    street.building(x, y, yaw, length, depth)
                    s += length + (0.3 if rng.random() < 0.6 else rng.uniform(2.0, 9.0))
                else:
                    s += rng.uniform(5.0, 15.0)
            if border != "none":
                u = side * (edge + (pavement + 0.4 if border != "rail" else max(0.6, pavement)))
                s = low
                while s < high:
                    length = 8.0 if border == "rail" else float(rng.uniform(3.0, 11.0))
                    x, y, yaw = street.on_strip(s + length / 2, u, k)
                    if border == "rail" or rng.random() < 0.6:
                        street.barrier(border, x, y, yaw, length)
                    s += length
            for _ in range(int(rng.poisson(14 * green))):
                away = pavement + abs(rng.normal(0.3, 6.0)) if place != "urban" else rng.uniform(0.5, pavement + 1)
                x, y, _ = street.on_strip(rng.uniform(low, high), side * (edge + away + 0.4), k)
                street.tree(x, y)
            for _ in range(int(rng.poisson(22 * green))):
                away = pavement + abs(rng.normal(0.0, 7.0))
                x, y, _ = street.on_strip(rng.uniform(low, high), side * (edge + away + 0.5), k)
                street.bush(x, y, rng.uniform(0.4, 3.0))
            for _ in range(int(rng.poisson(9 if place != "rural" else 3))):
                u = side * (edge + rng.uniform(0.3, max(pavement, 1.0)))
                x, y, yaw = street.on_strip(rng.uniform(low, high), u, k)
                street.pole(x, y, yaw + (0.0 if side < 0 else math.pi))
    for _ in range(int(rng.integers(15, 50))):  # the background
        turn, away = rng.uniform(0, 2 * math.pi), rng.uniform(25.0, 75.0)
        x, y = away * math.cos(turn), away * math.sin(turn)
        if rng.random() < 0.25 and built > 0.0:
            street.building(x, y, turn, rng.uniform(8, 20), rng.uniform(8, 14))
        else:
            street.tree(x, y)


def scene_from_boxes(boxes: Sequence[Box], seed: int, *, mount_height_m: float = 1.73) -> Scene:
    """A street around a real layout of objects.

    Parameters
    ----------
    boxes : sequence of Box
        In a sensor frame whose origin is ``mount_height_m`` above the road. Boxes whose label is none of car, van,
        truck, pedestrian and cyclist become obstacles of the background.
    seed : int
        Of everything the boxes do not say: the road's edges, what stands beside it, what lies outside the view.
    mount_height_m : float

    Returns
    -------
    Scene
        Its first objects are ``boxes`` of the five labels, in order, standing on the scene's ground (so that their
        height differs a little from the given one).
    """
    rng = np.random.default_rng((int(seed) & 0x7FFFFFFFFFFFFFFF, 15485863))
    vehicles = [box for box in boxes if box.label in _VEHICLES]
    heading, curvature = _road_direction(vehicles)
    lane = float(rng.uniform(2.9, 3.6))
    # Those along the road widen it; those across stand on another road or in a yard.
    beside: list[tuple[float, float, float, float]] = []
    across: list[float] = []
    for box in vehicles:
        s, u = _along(box, heading, curvature)
        turn = box.yaw - heading - curvature * s
        if abs(math.sin(turn)) < 0.35 and abs(u) < 9.5:
            beside.append((s, u, box.size[1] / 2, math.cos(turn)))
        elif abs(math.sin(turn)) > 0.8 and abs(u) < 9.0 and s > 5.0:
            across.append(s)
    right = min([-lane / 2 - 0.2, *(u - w - 0.3 for _, u, w, _ in beside)])
    left = max([lane / 2 + 0.2, *(u + w + 0.3 for _, u, w, _ in beside)])
    if left < 3.0 and rng.random() < 0.7:
        left += lane  # an empty lane for oncoming traffic
    right -= float(rng.uniform(0.0, 0.8))
    left += float(rng.uniform(0.0, 0.8))
    on_foot = any(box.label == "pedestrian" for box in boxes)
    fast = len(beside) > 0 and not on_foot and rng.random() < 0.15
    place = str(rng.choice(["urban", "residential"])) if not fast else str(rng.choice(["rural", "highway"]))
    bays: list[_Row] = []
    if rng.random() < _IN_BAYS:
        right, left, bays = _parking_rows(beside, lane, right, left, heading, curvature)
    strips = [_strip(0, 0, heading, curvature, right, left)]
    crossings: list[float] = []
    if across or rng.random() < 0.2:
        s = float(np.median(across)) if across else float(rng.uniform(10.0, 55.0))
        crossings.append(s)
        x, y = s * math.cos(heading), s * math.sin(heading) + curvature * s * s / 2
        width = float(rng.uniform(3.0, 5.5))
        strips.append(_strip(x, y, heading + curvature * s + math.pi / 2, 0.0, -width, width))
    strips += bays
    terrain = _terrain(rng, place)
    terrain[_LANE] = lane
    bottoms = np.array([(b.center[0], b.center[1], b.center[2] - b.size[2] / 2 + mount_height_m) for b in vehicles])
    if len(bottoms) >= 3:
        # Slopes that the boxes tell, drawn towards level by 1,000 m2.
        xy = bottoms[:, :2]
        slopes = np.linalg.solve(xy.T @ xy + 1000.0 * np.eye(2), xy.T @ bottoms[:, 2])
        terrain[[_SLOPE_X, _SLOPE_Y]] = np.clip(slopes, -0.04, 0.04)
    street = _Street(rng, strips, terrain)
    street.take(-0.3, 0.0, 4.8, 2.2, 0.0)
    for box in boxes:
        if box.label in _SHAPES:
            s, _ = _along(box, heading, curvature)
            ahead = math.cos(box.yaw - heading - curvature * s)
            moving = box.label in ("pedestrian", "cyclist") or ahead > 0.5
            pace = {"pedestrian": 1.3, "cyclist": 4.0}.get(box.label, 9.0)
            speed = float(pace * rng.uniform(0.5, 1.2)) if moving and rng.random() < 0.6 else 0.0
            street.add_object(box.label, *box.center[:2], box.yaw, box.size, speed, force=True)
        else:
            length, width, height = box.size
            rows = [
                _block(_PAINT, 0.4, (0, 0, 0.25 + height * 0.3), (length, width, height * 0.5), density=0.1),
                _block(_GLASS if height > 2.2 else _MATTE, 0.2, (0, 0, height * 0.75),
                       (length, width * 0.96, height * 0.5), density=0.6),
            ]  # fmt: skip
            street.take(*box.center[:2], length, width, box.yaw)
            z, _ = street.ground(*box.center[:2])
            for row in rows:
                turned = _block(int(row[1]), row[2], (box.center[0], box.center[1], z + row[6]),
                                (2 / row[7], 2 / row[11], 2 / row[15]), yaw=box.yaw, density=row[3])  # fmt: skip
                street.rows.append(turned)
    # What is labelled was seen: mostly nothing new may stand in between.
    for box in boxes:
        away = math.hypot(box.center[0], box.center[1])
        if away > 8.0 and rng.random() < 0.85:
            share = 0.5 + 2.0 / away
            x, y = box.center[0] * share, box.center[1] * share
            street.take(x, y, away - 4.0, 1.0, math.atan2(box.center[1], box.center[0]))
    # Behind the sensor and far to the sides nothing is labelled: mirror what is seen, thinned.
    for s, u, _, ahead in beside:
        if rng.random() < 0.7:
            x, y, yaw = street.on_strip(-s + float(rng.normal(0, 3.0)), u)
            yaw += math.pi * (ahead < 0.0)
            street.add_object(_any_vehicle(rng, 0.03), x, y, yaw)
    _add_unlabelled_people(street, boxes)
    _add_roadside(street, place)
    return street.scene()


def _parking_rows(
    beside: Sequence[tuple[float, float, float, float]],
    lane: float,
    right: float,
    left: float,
    heading: float,
    curvature: float,
) -> tuple[float, float, list[_Row]]:
    """The road's edges without the outermost row of vehicles, where it looks parked, and bays for those rows.

    Parked looks a row of two and more, some of them close behind each other, clear of the sensor's own lane.
    """
    edges, bays = {-1.0: -right, 1.0: left}, []
    for side in edges:
        own = [(s, side * u, w) for s, u, w, _ in beside if side * u - w > lane / 2 + 0.3]
        outermost = max((u for _, u, _ in own), default=0.0)
        row = sorted((s, u, w) for s, u, w in own if outermost - u < 0.8)
        gaps = np.diff([s for s, _, _ in row])
        if len(row) < 2 or gaps.min() > _ROW_GAP_M:
            continue
        inner = min(u - w for _, u, w in row) - 0.2
        bay = (inner, edges[side]) if side > 0 else (-edges[side], -inner)
        bays.append(_strip(0, 0, heading, curvature, *bay, _ROW_RANGE_M, True))
        edges[side] = inner
    return -edges[-1.0], edges[1.0], bays


def _add_unlabelled_people(street: _Street, boxes: Sequence[Box]) -> None:
    rng = street.rng
    for box in boxes:
        if box.label in ("pedestrian", "cyclist") and rng.random() < 0.7:
            x, y = -box.center[0] + float(rng.normal(0, 2)), box.center[1] + float(rng.normal(0, 0.3))
            street.add_object(box.label, x, y, box.yaw, box.size, 1.0)


def _along(box: Box, heading: float, curvature: float) -> tuple[float, float]:
    cos, sin = math.cos(heading), math.sin(heading)
    s = cos * box.center[0] + sin * box.center[1]
    return s, cos * box.center[1] - sin * box.center[0] - curvature * s * s / 2


def _road_direction(vehicles: Sequence[Box]) -> tuple[float, float]:
    """Heading and curvature of the road that the vehicles near the sensor's lane suggest."""
    leaning = []
    for box in vehicles:
        turn = _wrapped(2.0 * box.yaw) / 2.0  # modulo pi
        if abs(turn) < 0.45 and abs(box.center[1]) < 4.0 + 0.35 * abs(box.center[0]):
            leaning.append((box.center[0], turn))
    if not leaning:
        return 0.0, 0.0
    s, turn = np.array(leaning).T
    if len(leaning) >= 3 and np.ptp(s) > 15.0:
        # Straight ahead at the sensor, more or less: the ego vehicle follows the road.
        weights = np.array([[60.0 + len(s) * 4.0, s.sum()], [s.sum(), (s * s).sum() + 3000.0]])
        heading, curvature = np.linalg.solve(weights, np.array([turn.sum(), (s * turn).sum()]))
        return float(np.clip(heading, -0.08, 0.08)), float(np.clip(curvature, -0.012, 0.012))
    return float(np.clip(np.median(turn) * 0.5, -0.08, 0.08)), 0.0
