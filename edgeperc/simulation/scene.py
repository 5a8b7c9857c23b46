"""Scenes, and simulated scans of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..errors import OptionError, PointsError
from ..system.fields import Fields
from ..types.choices import STATIC, VEHICLES
from ..types.geometry import draw_footprints, wrapped
from ..types.perception import Box
from ..types.points import Bytes, Floats, Ints, Labels, Points
from ..types.rigid import rigid
from ..types.sensor import ScanPattern, SensorProfile, get_sensor
from ..types.views import TopViewGeometry
from . import raycast

NUMBERS = Fields("the simulation", OptionError)
"""How the numbers of all simulations are checked."""
POINT_CLASSES = ("background", "car", "pedestrian", "cyclist")
# Classes of what a street is made of; the background is what is none of the others, such as walls and fences.
SCENE_CLASSES = (*POINT_CLASSES, *STATIC)
TOP_VIEW_CLASSES = ("background", "drivable", *VEHICLES)
LEAST = 1e-6  # of numbers that are above 0
_SECTORS = 1800  # of the shapes that rays of a pattern may hit
MOST_TILT_DEG = 75.0  # rays of one azimuth meet the ground one after the other; on its side, a sensor sees it twice
_TURNED_OVER = np.diag([1.0, -1.0, -1.0, 1.0])
# Point class of an object: PointSeg's car includes all vehicles. KITTI also labels sitting people. Trams and "misc"
# objects (trailers, parked motorcycles) belong to no class: real labels ignore their points.
POINT_CLASS_OF = {**dict.fromkeys(VEHICLES, 1), "pedestrian": 2, "person_sitting": 2, "cyclist": 3}


@dataclass(frozen=True, slots=True)
class SceneObject:
    """A static or moving object with a box.

    Attributes
    ----------
    label : str
        ``"car"``, ``"van"``, ``"truck"``, ``"pedestrian"``, ``"person_sitting"``, ``"cyclist"``, ``"tram"`` or
        ``"misc"``.
    center : tuple of 3 float
        Center of the box [m], world frame.
    size : tuple of 3 float
        Length, width, height [m].
    yaw : float
        Heading about +z from +x [rad].
    track_id : int
        Identity of the object at all times.
    speed_mps, yaw_rate_rps : float
        Speed along the heading [m/s], turn rate [rad/s].
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
    """The simulated world at one time.

    Attributes
    ----------
    objects : tuple of SceneObject
    primitives : (n, 20) float64
        Shapes; columns as in `raycast`. Shapes of an object are in its frame: origin at the center of the footprint, on
        the ground.
    strips : (k, 10) float64
        Road surfaces, parking bays and islands; columns as in `raycast`. The first is the sensor's road.
    terrain : (27,) float64
        Parameters of the ground, by the constants of `raycast`.
    tile : (256, 256) float64
        Periodic noise in -1..1, for roughness and stains.
    """

    objects: tuple[SceneObject, ...]
    primitives: Floats
    strips: Floats
    terrain: Floats
    tile: Floats

    @property
    def ground(self) -> raycast.Ground:
        """The ground, as kernels take it."""
        return raycast.Ground(self.strips, self.terrain, self.tile)

    def at(self, t_s: float) -> Scene:
        """Move the objects by ``t_s`` [s] on the ground, with constant speed and turn rate; return the new scene."""
        NUMBERS.number("t_s", t_s)
        moved = []
        for each in self.objects:
            turn = each.yaw_rate_rps * t_s
            # Chord of the arc; sinc is 1 for a straight line.
            way = each.speed_mps * t_s * float(np.sinc(turn / (2.0 * math.pi)))
            x = each.center[0] + way * math.cos(each.yaw + turn / 2.0)
            y = each.center[1] + way * math.sin(each.yaw + turn / 2.0)
            z = each.center[2] + self.ground_height(x, y) - self.ground_height(each.center[0], each.center[1])
            moved.append(replace(each, center=(x, y, z), yaw=wrapped(each.yaw + turn)))
        return replace(self, objects=tuple(moved))

    def ground_height(self, x: float, y: float) -> float:
        """Height of the ground [m] at x, y, world frame."""
        return float(raycast.ground_at(self.ground, float(x), float(y))[0])

    def on_road(self, x: float, y: float) -> bool:
        """Whether x, y [m], world frame, is on a road surface; parking bays are not."""
        return bool(raycast.ground_at(self.ground, float(x), float(y))[1] < 0.0)

    def surface(self, xy: Floats) -> tuple[Bytes, Floats]:
        """Kind of the ground (0 road, 1 bay or pavement, 2 grass) and remission at places (..., 2), world frame."""
        kinds, remissions = np.empty(xy.shape[:-1], np.uint8), np.empty(xy.shape[:-1])
        raycast.fill_ground_kinds(
            self.ground, np.ascontiguousarray(xy).reshape(-1, 2), kinds.reshape(-1), remissions.reshape(-1)
        )
        return kinds, remissions


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedScan:
    """One scan and its ground truth, in the sensor frame.

    Attributes
    ----------
    points : (n, 4) float32
        x, y, z [m], remission 0..0.99 in steps of 0.01. Beam by beam from the top, counter-clockwise from +x.
    labels : (n,) uint8
        Index into `POINT_CLASSES`; trams and ``"misc"`` objects are background.
    objects : (n,) int32
        Index into ``boxes``; -1 for the background.
    surfaces : (n,) int32
        Row of ``scene.primitives`` that returned the point; -1 for the ground.
    boxes : tuple of Box
        All objects of the scene, including hidden ones.
    box_ids : tuple of int
        Track id of each box.
    box_points : tuple of int
        Number of points on each box's object.
    T_world_sensor : (4, 4) float64
        Pose of the sensor.
    scene : Scene
    """

    points: Points
    labels: Labels
    objects: Ints
    surfaces: Ints
    boxes: tuple[Box, ...]
    box_ids: tuple[int, ...]
    box_points: tuple[int, ...]
    T_world_sensor: Floats
    scene: Scene

    def top_view_labels(self, geometry: TopViewGeometry | None = None) -> Bytes:
        """True class of each cell of a top view, including hidden cells.

        Parameters
        ----------
        geometry : TopViewGeometry, optional

        Returns
        -------
        (rows, columns) uint8
            Index into `TOP_VIEW_CLASSES` at the center of the cell: the footprint of the nearest vehicle, else the road
            surface. Below trams and ``"misc"`` objects is background.
        """
        view = TopViewGeometry() if geometry is None else geometry
        (x, y), T = view.cell_centers(), self.T_world_sensor
        # An approximate height of the ground; it matters only if the sensor is tilted.
        xy = [T[i, 0] * x + T[i, 1] * y + T[i, 2] * -T[2, 3] + T[i, 3] for i in (0, 1)]
        kinds, _ = self.scene.surface(np.stack(xy, axis=-1))
        labels = (kinds == 0).astype(np.uint8)
        others = [replace(box, label="background") for box in self.boxes if box.label in ("tram", "misc")]
        draw_footprints(labels, [*others, *self.boxes], view, TOP_VIEW_CLASSES)
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
) -> Floats:
    """Make ``T_world_sensor`` for a sensor that is mounted as its profile says, on a vehicle at x, y [m], world frame,
    that is rotated by roll about x, then by pitch about y (nose down is positive), then by yaw about z [rad].
    """
    T_world_sensor, profile = np.eye(4), get_sensor(sensor)
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    cr, sr = math.cos(roll), math.sin(roll)
    T_world_sensor[:3, :3] = (
        np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
        @ np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
        @ np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
        @ profile.mounting.rotation()
    )
    T_world_sensor[:3, 3] = x, y, scene.ground_height(x, y) + profile.mount_height_m
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
    start_s: float = 0.0,
    duration_s: float | None = None,
    clumped_leaves: bool = False,
) -> SimulatedScan:
    """Simulate one scan.

    Parameters
    ----------
    scene : Scene
    sensor : str or SensorProfile
    seed : int
        Seed of noise, drop-out and leaves. The result is the same bit for bit for the same seed.
    T_world_sensor : (4, 4) array_like, optional
        Pose of the sensor, tilted by at most 75 degrees, or so much from upside down. Default: above the ground at the
        origin, mounted as its profile says, by default level, along +x.
    max_range_m : float
        Longest range; the sensor's range limits it too. KITTI's files end at 80 m.
    noise : bool
        False: exact ranges and azimuths, without drop-out and beam offsets.
    ego_shadow : bool
        Whether the ego vehicle hides some directions of the lower beams, as on KITTI's car. Ignored if ``noise`` is
        False.
    start_s, duration_s : float
        Of a sensor with a `ScanPattern`: when the scan begins, which decides its directions, and how long it is
        gathered from this one place [s]; by default as long as its profile says. A moving sensor gathers several short
        scans (`simulate_sequence`).
    clumped_leaves : bool
        Whether neighboring rays meet the same leaves, as on real plants: so are training scans. Else each ray has its
        own free path, and plants are three times as rough; so are the streets that figures are measured on.

    Returns
    -------
    SimulatedScan

    Raises
    ------
    PointsError
        ``T_world_sensor`` is not a rotation and a translation, or tilts the sensor more.
    """
    NUMBERS.number("max_range_m", max_range_m, 0.1, math.inf)
    NUMBERS.number("start_s", start_s)
    if duration_s is not None:
        NUMBERS.number("duration_s", duration_s, LEAST)
    profile = get_sensor(sensor)
    pose = sensor_pose(scene, profile)
    if T_world_sensor is not None:
        pose = rigid("T_world_sensor", T_world_sensor, PointsError)
    hangs, tilt_deg = pose[2, 2] < 0.0, math.degrees(math.acos(min(abs(pose[2, 2]), 1.0)))
    if tilt_deg > MOST_TILT_DEG:
        raise PointsError(
            f"the sensor is tilted by {tilt_deg:.0f} degrees, which is not simulated; expected at most "
            f"{MOST_TILT_DEG:g} from upright or from upside down, in T_world_sensor or the mounting of the profile"
        )
    rng = np.random.default_rng((int(seed) & 0x7FFFFFFFFFFFFFFF, 7919))
    if profile.pattern is None:
        step = 2.0 * math.pi / profile.columns
        azimuths = np.arange(profile.columns, dtype=np.float64) * np.float64(step)
        elevations = np.radians(np.asarray(profile.elevations_deg))[:, None]
    else:
        azimuths, elevations = _pattern_rays(profile, profile.pattern, start_s, duration_s)
    upright = pose @ _TURNED_OVER if hangs else pose  # the frame in which rays are cast
    if hangs:
        azimuths, elevations = -azimuths[::-1], -elevations[::-1, ::-1]
    n_beams, n_columns = len(elevations), len(azimuths)
    range_offsets, remission_offsets = np.zeros(n_beams), np.zeros(n_beams)
    if noise and profile.pattern is None:
        azimuths += rng.normal(0.0, 0.08, n_columns) * step
        # Measured: points on a flat road are 0.008 m off their neighbors of the same beam; beams differ by more.
        range_offsets = rng.normal(0.0, 0.012, n_beams)
        # Measured: the mean remission of the road differs by 0.08 between beams; a few beams return almost none.
        remission_offsets = np.clip(rng.normal(-0.01, 0.075, n_beams), -0.25, 0.1)
    reach = min(float(max_range_m), profile.max_range_m)

    shapes = place_shapes(scene, upright, _SECTORS if profile.pattern else n_columns, reach)
    shape = (n_beams, n_columns)
    hits = raycast.Hits(np.empty(shape), np.empty(shape, np.int32), np.empty(shape), np.empty(shape))
    rays = raycast.Rays(elevations, azimuths, reach, np.uint64(rng.integers(0, 2**63)), clumped_leaves)
    raycast.fill_cast(shapes, scene.ground, upright, rays, hits)
    receiver = raycast.Receiver(range_offsets, remission_offsets, profile.min_range_m, noise, noise and ego_shadow)
    points = np.empty((n_beams * n_columns, 4), dtype=np.float32)
    surfaces = np.empty(n_beams * n_columns, dtype=np.int32)
    n = raycast.fill_points(shapes.primitives, scene.ground, upright, rays, hits, receiver, points, surfaces)
    points, surfaces = points[:n].copy(), surfaces[:n].copy()
    if hangs:  # from the sensor's top
        points, surfaces = points[::-1] * np.array([1, -1, -1, 1], np.float32), surfaces[::-1].copy()
    # Shapes that are not part of an object have a negative number; -1 is the last entry, the ground.
    objects = np.maximum([*scene.primitives[:, 19], -1.0], -1.0).astype(np.int32)[surfaces]
    boxes = tuple(_box_in_sensor(each, pose) for each in scene.objects)
    lookup = np.array([*(POINT_CLASS_OF.get(each.label, 0) for each in scene.objects), 0], dtype=np.uint8)
    counts = np.bincount(objects[objects >= 0], minlength=len(boxes))
    return SimulatedScan(
        points=points,
        labels=lookup[objects],  # -1 is the last entry, the background
        objects=objects,
        surfaces=surfaces,
        boxes=boxes,
        box_ids=tuple(each.track_id for each in scene.objects),
        box_points=tuple(int(c) for c in counts),
        T_world_sensor=pose,
        scene=scene,
    )


def _pattern_rays(
    profile: SensorProfile, pattern: ScanPattern, start_s: float, duration_s: float | None
) -> tuple[Floats, Floats]:
    """Azimuths (n,) and elevations (1, n) of a pattern [rad], in the order of time: of a turn while the beam goes up
    and down, or of two prisms that turn at different rates, so that the beam draws a rosette.
    """
    duration_s = pattern.accumulate_s if duration_s is None else duration_s
    first = round(start_s * pattern.points_per_s)
    times = np.arange(first, first + round(duration_s * pattern.points_per_s)) / pattern.points_per_s
    a, b = (2.0 * math.pi * ((turns_hz * times) % 1.0) for turns_hz in pattern.turns_hz)
    middle, half = (math.radians(profile.fov_up_deg + sign * profile.fov_down_deg) / 2.0 for sign in (1, -1))
    if pattern.width_deg == 360.0:
        return a, (middle + half * (np.abs(b / math.pi - 1.0) * 2.0 - 1.0))[None]
    across, up = (np.cos(a) + np.cos(b)) / 2.0, (np.sin(a) + np.sin(b)) / 2.0
    return math.radians(pattern.width_deg) / 2.0 * across, (middle + half * up)[None]


def place_shapes(scene: Scene, T_world_sensor: Floats, n_columns: int, reach_m: float) -> raycast.Shapes:
    """Sort the shapes of a scene by the directions, ``n_columns`` counter-clockwise from +x, in which rays from a
    sensor may hit them. The last column of the returned primitives is their row of ``scene.primitives``.
    """
    poses = np.array([(*o.center[:2], o.center[2] - o.size[2] / 2.0, o.yaw) for o in scene.objects]).reshape(-1, 4)
    primitives = raycast.placed(scene.primitives, poses, T_world_sensor)
    bounds = np.empty((len(primitives), 5))
    raycast.fill_bounds(primitives, bounds)
    near_first = np.argsort(bounds[:, 4], kind="stable")
    primitives, bounds = np.ascontiguousarray(primitives[near_first]), np.ascontiguousarray(bounds[near_first])
    primitives[:, 19] = near_first
    return raycast.Shapes(primitives, bounds, *raycast.columns_of(bounds, n_columns, reach_m))


def simulate_sequence(
    scene: Scene,
    sensor: str | SensorProfile,
    n_scans: int,
    rate_hz: float = 10.0,
    ego_speed_mps: float = 0.0,
    seed: int = 0,
) -> Iterator[tuple[float, Floats, SimulatedScan]]:
    """Simulate scans of a sensor that moves along the scene's first road, from the origin.

    Each is taken from one place. That of a sensor with a pattern lasts until the next one, so a high rate shows how
    motion bends what is gathered.

    Yields T_world_sensor: (4, 4) float64.
    Yields scan: ``scan.box_ids`` identify objects across scans.
    """
    NUMBERS.number("rate_hz", rate_hz, LEAST, 1.0 / LEAST)
    NUMBERS.number("ego_speed_mps", ego_speed_mps)
    curvature = float(scene.strips[0, 4])
    heading = math.atan2(scene.strips[0, 3], scene.strips[0, 2])
    for k in range(n_scans):
        stamp_s = k / rate_hz
        way = ego_speed_mps * stamp_s
        turn = curvature * way
        chord = way * float(np.sinc(turn / (2.0 * math.pi)))
        x, y = chord * math.cos(heading + turn / 2.0), chord * math.sin(heading + turn / 2.0)
        T_world_sensor = sensor_pose(scene, sensor, x, y, yaw=heading + turn)
        scan = simulate(scene.at(stamp_s), sensor, seed + k, T_world_sensor, start_s=stamp_s, duration_s=1.0 / rate_hz)
        yield stamp_s, T_world_sensor, scan


def _box_in_sensor(each: SceneObject, T_world_sensor: Floats) -> Box:
    rotation = T_world_sensor[:3, :3]
    x, y, z = rotation.T @ (np.asarray(each.center) - T_world_sensor[:3, 3])
    ahead = rotation.T @ np.array([math.cos(each.yaw), math.sin(each.yaw), 0.0])
    return Box(each.label, 1.0, (float(x), float(y), float(z)), each.size, math.atan2(ahead[1], ahead[0]))
