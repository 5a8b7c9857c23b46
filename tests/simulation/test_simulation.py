"""The simulator against its slow twin, and against what must hold in any street."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import twins.simulation
from edgeperc.errors import PointsError
from edgeperc.simulation import drawn, ray_draws, raycast
from edgeperc.simulation.drawn import ENVIRONMENTS, random_scene
from edgeperc.simulation.layouts import scene_from_boxes
from edgeperc.simulation.raycast import (
    BANK_SLOPE_LEFT,
    FACADE,
    GLASS,
    LEAVES,
    MATTE,
    PAINT,
    POROUS,
    ROUGH,
    Hits,
    Rays,
    Receiver,
    ground_at,
)
from edgeperc.simulation.roadside import add_cafe
from edgeperc.simulation.samples import IGNORE, in_models_frame, labels_by_boxes, labels_of_scene, simulated_scan
from edgeperc.simulation.scene import (
    POINT_CLASS_OF,
    SCENE_CLASSES,
    TOP_VIEW_CLASSES,
    Scene,
    SceneObject,
    SimulatedScan,
    place_shapes,
    sensor_pose,
    simulate,
    simulate_sequence,
)
from edgeperc.simulation.shapes import block
from edgeperc.simulation.street import SIZES
from edgeperc.types.choices import STATIC
from edgeperc.types.geometry import inside
from edgeperc.types.mounting import Mounting
from edgeperc.types.perception import Box
from edgeperc.types.sensor import SensorProfile, get_sensor
from edgeperc.types.views import TopViewGeometry

SMALL = SensorProfile.uniform("small", 24, 4.0, -24.0, columns=240)
TALL = SensorProfile.uniform("tall", 48, 20.0, -24.0, columns=360)
LABELS = tuple(SIZES)


def street(*boxes: Box, seed: int = 0) -> Scene:
    """Objects on a straight road without anything beside it."""
    scene = scene_from_boxes(boxes, seed)
    mine = scene.primitives[:, 19]
    keep = (mine >= 0) & (mine < len(boxes))
    return replace(scene, objects=scene.objects[: len(boxes)], primitives=scene.primitives[keep])


def flat(scene: Scene) -> Scene:
    """The scene on a level street; what stood on the ground still does."""
    terrain = np.zeros_like(scene.terrain)
    terrain[15:BANK_SLOPE_LEFT] = scene.terrain[15:BANK_SLOPE_LEFT]
    leveled = replace(scene, terrain=terrain)
    rise = [leveled.ground_height(*o.center[:2]) - scene.ground_height(*o.center[:2]) for o in scene.objects]
    moved = [replace(o, center=(*o.center[:2], o.center[2] + up)) for o, up in zip(scene.objects, rise, strict=True)]
    return replace(leveled, objects=tuple(moved))


def box(label: str, x: float, y: float, yaw: float = 0.0) -> Box:
    size = {"car": (3.9, 1.6, 1.5), "van": (5.0, 1.9, 2.2), "truck": (9.0, 2.5, 3.2)}.get(label, (1.2, 0.6, 1.75))
    return Box(label, 1.0, (x, y, size[2] / 2 - 1.73), size, yaw)


def plate(
    x: float, size: tuple[float, float, float], z: float = 0.0, material: int = 0, density: float = 1.0
) -> np.ndarray:
    return np.array(block(material, 0.4, (x, 0.0, z), size, density=density))


KEY = np.uint64(99)


def cast(scene: Scene, pose: np.ndarray, rays: Rays, n_sectors: int = 0) -> tuple[np.ndarray, Hits]:
    """Primitives in the sensor frame, nearest first; what the rays hit."""
    shapes = place_shapes(scene, pose, n_sectors or len(rays.azimuths), rays.reach)
    shape = (len(rays.elevations), len(rays.azimuths))
    hits = Hits(np.empty(shape), np.empty(shape, np.int32), np.empty(shape), np.empty(shape))
    raycast.fill_cast(shapes, scene.ground, pose, rays, hits)
    return shapes.primitives, hits


def near_scene(seed: int, environment: str | None = None) -> Scene:
    """Half of the shapes within 40 m, on ground without tufts of grass."""
    scene = random_scene(seed, environment)
    near = np.hypot(*scene.primitives[:, 4:6].T) < 40.0
    scene = replace(scene, primitives=scene.primitives[near | (scene.primitives[:, 19] >= 0)][::2].copy())
    # The kernel misses tufts between two of its samples, by design.
    scene.terrain[ROUGH] = 0.0
    return scene


@pytest.mark.parametrize(
    ("seed", "tilt", "clumped"), [(0, 0.0, False), (0, 0.0, True), (1, 0.03, False), (2, 0.03, True)]
)
def test_cast_is_its_twin(seed: int, tilt: float, clumped: bool) -> None:
    scene = near_scene(seed)
    rng = np.random.default_rng(seed)
    azimuths = np.arange(20) * 2 * np.pi / 20
    elevations = np.sort(np.radians(rng.uniform(-24, 8, 6)))[::-1].copy()
    pose = sensor_pose(scene, SMALL, 1.0, 0.3, yaw=0.2, pitch=tilt, roll=-tilt)
    rays = Rays(elevations[:, None], azimuths, 40.0, KEY, clumped)
    placed, (ranges, hits, exits, cosines) = cast(scene, pose, rays)
    slow_ranges, slow_hits = twins.simulation.cast(placed, scene, pose, rays)
    # Where a ray all but grazes the ground, a kerb between two samples may be missed too.
    grazing = ((hits == -1) & (ranges > 18.0)) | ((slow_hits == -1) & (slow_ranges > 18.0))
    close = (hits != slow_hits) & (np.abs(ranges - slow_ranges) < 0.02)  # within a step of the twin's walk
    np.testing.assert_array_equal(hits[~grazing & ~close], slow_hits[~grazing & ~close])
    shapes = (hits >= 0) & (hits == slow_hits)
    np.testing.assert_allclose(ranges[shapes], slow_ranges[shapes], rtol=0, atol=1e-7)
    earth = (hits == -1) & (slow_hits == -1) & ~grazing
    off = np.abs(ranges[earth] - slow_ranges[earth])
    # The kernel may miss the edge of a bank between two of its samples, by design.
    assert (off > 0.02).mean() < 0.1
    assert off.max() < 0.5
    assert shapes.sum() > 10
    assert earth.sum() > 10
    assert close.mean() < 0.02
    assert ((cosines >= 0) & (cosines <= 1)).all()
    for b, column in np.argwhere(hits >= 0):
        shape, t = placed[hits[b, column]], ranges[b, column]
        level = np.array([np.cos(azimuths[column]), np.sin(azimuths[column])]) * np.cos(elevations[b])
        direction = np.array([*level, np.sin(elevations[b])])
        _, leave = twins.simulation.crossing(shape, direction)
        assert exits[b, column] == pytest.approx(leave, abs=1e-6)
        expected = 0.7 if shape[1] == LEAVES else twins.simulation.cosine(shape, direction, t)
        assert cosines[b, column] == pytest.approx(expected, abs=1e-6)


def test_cast_without_shapes_and_with_shapes_that_are_not_finite() -> None:
    scene = flat(street())
    empty = replace(scene, primitives=np.zeros((0, 20)))
    pose = sensor_pose(scene, SMALL)
    for beams, n_columns in (((-0.2,), 1), ((0.1, -0.1, -0.3), 5)):
        azimuths = np.arange(n_columns) * 2 * np.pi / n_columns
        rays = Rays(np.array(beams)[:, None], azimuths, 40.0, KEY)
        placed, found = cast(empty, pose, rays)
        slow_ranges, slow_hits = twins.simulation.cast(placed, empty, pose, rays)
        np.testing.assert_array_equal(found[1], slow_hits)
        np.testing.assert_allclose(found[0], slow_ranges, rtol=0, atol=0.02)
        assert set(found[1].ravel()) <= {-1, -2}
    strange = np.stack([plate(8.0, (0.2, 30.0, 20.0), material=material) for material in (0, LEAVES, POROUS)])
    for k, column, value in ((0, 4, np.nan), (1, 5, np.inf), (2, 7, np.nan)):
        strange[k, column] = value
    rays = Rays(np.array([[0.0], [-0.1]]), np.arange(8) * np.pi / 4, 40.0, KEY)
    plain = cast(empty, pose, rays)[1]
    for got, wanted in zip(cast(replace(scene, primitives=strange), pose, rays)[1], plain, strict=True):
        np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize("n", [0, 1, 30])
def test_placing_is_its_twin(n: int) -> None:
    rng = np.random.default_rng(n)
    primitives, poses = rng.normal(0.0, 3.0, (n, 20)), rng.normal(0.0, 9.0, (3, 4))
    primitives[:, 19] = rng.integers(-1, 3, n)
    primitives[1::5, 5] = np.nan
    pose = sensor_pose(flat(street()), SMALL, 3.0, -2.0, yaw=0.7, pitch=0.03, roll=-0.02)
    placed = raycast.placed(primitives, poses, pose)
    np.testing.assert_allclose(placed, twins.simulation.placed(primitives, poses, pose), atol=1e-9)


def test_bounds_and_columns_are_their_twins() -> None:
    scene = near_scene(4, "urban")
    pose = sensor_pose(scene, SMALL, yaw=0.3, pitch=0.02, roll=0.01)
    placed = place_shapes(scene, pose, 1, 80.0).primitives
    around = np.array(block(0, 0.4, (0.1, 0.2, 0.0), (2.0, 2.0, 2.0)))  # the sensor stands in it
    placed = np.vstack([placed[::4], around, np.full(20, np.nan)])
    for primitives in (placed, placed[:1], placed[:0]):
        bounds = np.empty((len(primitives), 5))
        raycast.fill_bounds(primitives, bounds)
        np.testing.assert_allclose(bounds, twins.simulation.bounds(primitives), rtol=1e-7, atol=1e-7)
        for n_columns, reach in ((1, 80.0), (36, 80.0), (720, 20.0)):
            starts, rows = raycast.columns_of(bounds, n_columns, reach)
            lists = twins.simulation.columns(bounds, n_columns, reach)
            assert [rows[a:b].tolist() for a, b in pairwise(starts)] == lists


def test_drivable_cells_are_those_of_the_twin() -> None:
    for seed, tilt in ((0, 0.0), (5, 0.05)):
        scene = random_scene(seed)
        pose = sensor_pose(scene, SMALL, 2.0, -1.0, yaw=0.3, pitch=tilt, roll=tilt)
        scan = replace(simulate(scene, SensorProfile("one", (-10.0,), 1), 0, pose), boxes=())
        for view in (
            TopViewGeometry(cell_m=0.4),
            TopViewGeometry(x_range_m=(0.0, 1.0), y_range_m=(-1.0, 1.0), cell_m=1.0),
        ):
            x, y = (centers.ravel() for centers in view.cell_centers())
            np.testing.assert_array_equal(scan.top_view_labels(view), twins.simulation.drivable(scene, pose, x, y))


def test_clumped_paths_are_those_of_the_twin() -> None:
    rng = np.random.default_rng(5)
    for _ in range(40):
        size, center = tuple(rng.uniform(0.5, 8.0, 3)), tuple(rng.uniform(-20.0, 20.0, 3))
        plant = np.array(block(LEAVES, 0.4, center, size, yaw=rng.uniform(-3, 3), density=rng.uniform(0.3, 12.0)))
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        t, path = rng.uniform(0.0, 40.0), rng.exponential()
        expected = twins.simulation.clumped_path(plant, t * direction, path)
        assert ray_draws.clumped_path(plant, t, tuple(direction.tolist()), path) == pytest.approx(expected, abs=1e-9)


def test_neighbors_meet_the_same_leaves_where_they_are_clumped() -> None:
    """A hedge then bends less than half as much from ray to ray, and is entered as deep."""
    hedges = np.array([block(LEAVES, 0.4, (10.0, 0.0, 100.0), (4.0, 3.0, 3.0), density=3.0 + k) for k in range(30)])
    azimuths = np.linspace(-0.1, 0.1, 129)
    bends, depths = {}, {}
    for clumped in (False, True):
        found = []
        for hedge in hedges:
            scene = replace(random_scene(1), primitives=hedge[None], objects=())
            pose = np.eye(4)
            pose[2, 3] = 100.0  # the ground is out of reach
            _, hits = cast(scene, pose, Rays(np.zeros((1, 1)), azimuths, 40.0, KEY, clumped))
            found.append(hits.ranges[0] * np.cos(azimuths) - 8.0)
        depth = np.array(found)
        assert (depth > 0.0).all()
        bends[clumped] = np.median(np.abs(np.diff(depth, 2)))
        depths[clumped] = (depth.mean(axis=1) * hedges[:, 3]).mean()
    assert bends[True] < 0.4 * bends[False]
    assert depths[True] == pytest.approx(depths[False], rel=0.15)


def check_points(
    placed: np.ndarray, scene: Scene, pose: np.ndarray, rays: Rays, hits: Hits, receiver: Receiver
) -> None:
    """Hold `fill_points` against its twin."""
    points, objects = np.empty((hits.rows.size, 4), np.float32), np.empty(hits.rows.size, np.int32)
    n = raycast.fill_points(placed, scene.ground, pose, rays, hits, receiver, points, objects)
    slow_points, slow_objects = twins.simulation.points(placed, scene, pose, rays, hits, receiver)
    assert n == len(slow_points)
    np.testing.assert_array_equal(objects[:n], slow_objects)
    np.testing.assert_allclose(points[:n], slow_points, rtol=0, atol=2e-5)
    assert np.isfinite(points[:n]).all()


@pytest.mark.parametrize(("seed", "noise"), [(3, False), (4, True)])
def test_points_are_those_of_the_twin(seed: int, noise: bool) -> None:
    scene = random_scene(seed, ("urban", "residential")[seed % 2])
    rng = np.random.default_rng(seed)
    around = SensorProfile.uniform("around", 32, 15.0, -24.0, columns=60)
    pose = sensor_pose(scene, around, 1.0, 0.2, yaw=0.1, pitch=0.01, roll=-0.01)
    for sensor, reach in ((around, 80.0), (SensorProfile("one", (-10.0,), 1), 80.0), (SMALL, 1.0)):
        azimuths = np.arange(0.0, 2 * np.pi, 2 * np.pi / sensor.columns)
        rays = Rays(np.radians(sensor.elevations_deg)[:, None], azimuths, reach, KEY)
        placed, hits = cast(scene, pose, rays)
        hits.ranges[:1, ::7] = np.nan  # no return, whatever it hit
        receiver = Receiver(*rng.normal(0.0, 0.02, (2, sensor.n_beams)), 0.9, noise, noise)
        check_points(placed, scene, pose, rays, hits, receiver)
        if sensor is around:
            materials = placed[hits.rows[hits.rows >= 0], 1].astype(int)
            assert {*materials.tolist()} >= {MATTE, PAINT, GLASS, LEAVES, FACADE}


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 2]))
def test_bounds_hold_every_ray_that_hits(seed: int, kind: int) -> None:
    rng = np.random.default_rng(seed)
    center, size = rng.normal(0, 6, 3), rng.uniform(0.05, 8, 3)
    taper = tuple(rng.uniform(0, 0.9, 3)) if kind == 0 else (0.0, 0.0, 0.0)
    row = np.array([block(0, 0.4, tuple(center), tuple(size), yaw=rng.uniform(-4, 4), taper=taper, kind=kind)])
    bounds = np.empty((1, 5))
    raycast.fill_bounds(row, bounds)
    first, width, low, high, near = bounds[0]
    for _ in range(40):
        target = center + rng.normal(0, 0.3, 3) * size
        direction = target / np.linalg.norm(target)
        found = twins.simulation.crossing(row[0], direction)
        enter, leave, _ = raycast.crossing(row[0], *direction)
        assert (found is None) == (enter > leave)
        if found is None or found[0] <= 0:
            continue
        np.testing.assert_allclose((enter, leave), found, rtol=1e-6, atol=1e-7)
        assert (math.atan2(direction[1], direction[0]) - first) % (2 * math.pi) <= width
        assert low <= direction[2] / math.hypot(direction[0], direction[1]) <= high
        assert near <= enter * math.hypot(direction[0], direction[1]) + 1e-9


def test_ground_equals_twin() -> None:
    rng = np.random.default_rng(0)
    for seed in range(6):
        scene = random_scene(seed)
        xy = rng.uniform(-60, 60, (300, 2))
        fast = np.array([ground_at(scene.ground, x, y)[:2] for x, y in xy])
        slow = np.stack(twins.simulation.ground(scene, xy[:, 0], xy[:, 1]), axis=1)
        np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-9)


def test_draws_equal_twin() -> None:
    for value in (0, 1, 2**63, 2**64 - 1):
        bits = np.uint64(ray_draws.mixed_bits(np.uint64(value)))
        assert int(bits) == twins.simulation.mixed(value)
        assert ray_draws.uniform_draw(bits) == pytest.approx(twins.simulation.uniform_draw(int(bits)), abs=1e-15)
        assert ray_draws.normal_draw(bits) == pytest.approx(twins.simulation.normal_draw(int(bits)), abs=1e-12)
    normals = [ray_draws.normal_draw(np.uint64(ray_draws.mixed_bits(np.uint64(k)))) for k in range(4000)]
    assert abs(np.mean(normals)) < 0.06
    assert abs(np.std(normals) - 1.0) < 0.05


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_a_scan_is_consistent(environment: str) -> None:
    scene = random_scene(3, environment)
    scan = simulate(scene, SMALL, 5)
    assert scan.points.dtype == np.float32
    assert scan.points.shape == (len(scan.labels), 4)
    assert np.isfinite(scan.points).all()
    distance = np.linalg.norm(scan.points[:, :3].astype(np.float64), axis=1)
    assert distance.max() < 80.0
    assert distance.min() >= SMALL.min_range_m - 1e-6
    assert len(scan.points) > 0.4 * SMALL.n_beams * SMALL.columns
    assert ((scan.points[:, 3] >= 0) & (scan.points[:, 3] <= 0.99)).all()
    np.testing.assert_allclose(scan.points[:, 3] * 100, np.round(scan.points[:, 3] * 100), atol=1e-4)
    assert len(scan.boxes) == len(scan.box_ids) == len(scan.box_points) == len(scene.objects)
    assert len(set(scan.box_ids)) == len(scan.box_ids)
    for k, each in enumerate(scan.boxes):
        mine = scan.objects == k
        assert int(mine.sum()) == scan.box_points[k]
        assert (scan.labels[mine] == POINT_CLASS_OF.get(each.label, 0)).all()
        assert inside(each, scan.points[mine], 0.12).all()
    assert (scan.labels[scan.objects < 0] == 0).all()


@settings(max_examples=25)
@example("truck", 1.0, 0.0, 0.0, 0.25, 0)
@example("person_sitting", 0.0, 0.0, 0.0, 1.0, 93)
@example("cyclist", -1.0, -1.0, -1.0, -0.43247780315099105, 19)
@given(
    st.sampled_from(LABELS),
    st.floats(-1, 1),
    st.floats(-1, 1),
    st.floats(-1, 1),
    st.floats(-3.1, 3.1),
    st.integers(0, 99),
)
def test_shapes_fill_their_boxes(label: str, a: float, b: float, c: float, yaw: float, seed: int) -> None:
    mean, spread = SIZES[label]
    size = tuple(m + 2 * s * v for m, s, v in zip(mean, spread, (a, b, c), strict=True))
    # Its end is never so near that it fills the view.
    each = Box(label, 1.0, (7.0 + size[0] / 2, 2.0, size[2] / 2 - 1.73), size, yaw)
    scan = simulate(flat(street(each, seed=seed)), TALL, seed, noise=False)
    mine = scan.points[scan.objects == 0]
    assert len(mine) > 5
    # Handlebars stick out of the narrowest cyclists by 4.3 cm, elbows out of pedestrians by 3.2 cm (of 1,500 shapes).
    assert inside(scan.boxes[0], mine, 0.05 if label in ("cyclist", "pedestrian") else 0.03).all()
    # It reaches near its own top, and what shows is not a sliver of the box.
    assert np.ptp(mine[:, 2]) > 0.6 * size[2]
    assert math.hypot(np.ptp(mine[:, 0]), np.ptp(mine[:, 1])) > 0.4 * min(size[0], size[1])


def test_same_seeds_same_bits() -> None:
    first, second = (simulate(random_scene(11), SMALL, 4) for _ in range(2))
    assert first.points.tobytes() == second.points.tobytes()
    assert first.objects.tobytes() == second.objects.tobytes()
    assert first.boxes == second.boxes
    assert simulate(random_scene(11), SMALL, 5).points.tobytes() != first.points.tobytes()
    assert simulate(random_scene(12), SMALL, 4).points.tobytes() != first.points.tobytes()
    boxes = [box("car", 12, 2), box("cyclist", 9, -3)]
    first, second = (simulate(scene_from_boxes(boxes, 3), SMALL, 4) for _ in range(2))
    assert first.points.tobytes() == second.points.tobytes()


@pytest.mark.parametrize("roll_deg", [0.0, 180.0])
def test_points_run_laser_by_laser_from_the_top(roll_deg: float) -> None:
    sensor = replace(SMALL, mounting=Mounting(roll_deg=roll_deg))
    scan = simulate(street(), sensor, 0, noise=False)
    azimuth, elevation = angles_deg(scan.points)
    beam = np.abs(elevation[:, None] - np.array(sensor.elevations_deg)).argmin(axis=1)
    assert (np.diff(beam) >= 0).all()
    azimuth = (azimuth + 1e-3) % 360.0
    assert (np.diff(azimuth)[np.diff(beam) == 0] > 0).all()


def test_nothing_is_seen_through_a_wall() -> None:
    scene = flat(street(box("car", 15, 0)))
    assert simulate(scene, SMALL, 0).box_points[0] > 5
    wall = plate(8.0, (0.2, 30.0, 20.0))
    hidden = simulate(replace(scene, primitives=np.vstack([scene.primitives, wall])), SMALL, 0)
    assert hidden.box_points == (0,)
    assert (hidden.labels == 0).all()
    ahead = hidden.points[np.abs(hidden.points[:, 1]) < hidden.points[:, 0]]
    assert 7.8 < ahead[:, 0].max() < 8.0
    assert len(hidden.boxes) == 1  # there all the same


@pytest.mark.parametrize(("material", "density"), [(LEAVES, 0.3), (POROUS, 0.4)])
def test_leaves_and_fences_let_some_rays_through(material: int, density: float) -> None:
    scene = flat(street(box("van", 15, 0)))
    seen = simulate(scene, SMALL, 0, noise=False).box_points[0]
    screen = plate(8.0, (2.0, 30.0, 20.0), material=material, density=density)
    scan = simulate(replace(scene, primitives=np.vstack([scene.primitives, screen])), SMALL, 0, noise=False)
    assert 0.2 * seen < scan.box_points[0] < 0.9 * seen


def test_bare_ground() -> None:
    scan = simulate(flat(street()), SMALL, 0, noise=False)
    assert scan.boxes == ()
    assert (scan.objects == -1).all()
    np.testing.assert_allclose(scan.points[:, 2], -1.73, atol=2e-3)
    for elevation in SMALL.elevations_deg:
        away = 1.73 / math.tan(math.radians(-elevation)) if elevation < 0 else math.inf
        ring = np.abs(np.hypot(scan.points[:, 0], scan.points[:, 1]) - away) < 0.02 * away
        assert ring.sum() == (SMALL.columns if away < 79.9 else 0)


def test_noise_drop_out_and_shadow_take_points_away() -> None:
    scene = flat(street())
    exact = simulate(scene, SMALL, 0, noise=False)
    noisy = simulate(scene, SMALL, 0, ego_shadow=False)
    assert len(simulate(scene, SMALL, 0).points) < len(noisy.points) < len(exact.points)
    near = np.hypot(noisy.points[:, 0], noisy.points[:, 1]) < 10.0
    assert 0.001 < np.std(noisy.points[near, 2] + 1.73) < 0.03


def test_a_sensor_below_the_ground_or_in_a_box_does_not_fail() -> None:
    scene = street(box("truck", 0.0, 0.0))
    for z in (-3.0, 0.0, 1.0, 50.0):
        pose = np.eye(4)
        pose[2, 3] = z
        assert np.isfinite(simulate(scene, SMALL, 0, pose).points).all()


def test_one_beam_one_column() -> None:
    scan = simulate(flat(street()), SensorProfile("one", (-10.0,), 1), 0, noise=False)
    np.testing.assert_allclose(scan.points[:, :3], [[1.73 / math.tan(math.radians(10.0)), 0.0, -1.73]], atol=1e-3)


@pytest.mark.parametrize("mounting", [Mounting(1.73, 0.0, 0.0), Mounting(1.73, 180.0, 0.0), Mounting(1.9, -175.0, 4.0)])
def test_poses_move_points_and_boxes_alike(mounting: Mounting) -> None:
    scene = flat(street(box("car", 14, 1.5, 0.4), box("van", 9, -4, -2.0)))
    sensor = replace(SMALL.upright(mounting), mounting=mounting)
    pose = sensor_pose(scene, sensor, 3.0, 0.5, yaw=0.7, pitch=0.02, roll=-0.03)
    scan = simulate(scene, sensor, 0, pose, noise=False)
    moved = in_models_frame(scan, sensor)
    for k, each in enumerate(moved.boxes):
        assert scan.box_points[k] > 20
        assert inside(each, moved.points[scan.objects == k], 0.15).all()
    world = scan.points[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(world[scan.objects < 0, 2], 0.0, atol=5e-3)


ON_ITS_SIDE = np.eye(4)[[0, 2, 1, 3]] * [[1.0], [-1.0], [1.0], [1.0]]


@pytest.mark.parametrize("pose", [np.eye(3), np.full((4, 4), np.nan), np.diag([2.0, 2, 2, 1]), "here", ON_ITS_SIDE])
def test_a_pose_that_is_none_is_refused(pose: Any) -> None:
    with pytest.raises(PointsError, match="T_world_sensor"):
        simulate(street(), SMALL, 0, pose)


@pytest.mark.compiled
def test_top_view_labels() -> None:
    car, truck = box("car", 20, 0.5, 0.3), box("truck", 35, -3.0, 0.0)
    scan = simulate(flat(street(car, truck, box("pedestrian", 10, 6))), SMALL, 0)
    view = TopViewGeometry()
    labels = scan.top_view_labels(view)
    assert labels.shape == (view.height, view.width)
    assert labels.dtype == np.uint8
    for row in range(0, view.height, 7):
        for col in range(0, view.width, 3):
            x, y = view.x_range_m[1] - (row + 0.5) * view.cell_m, view.y_range_m[1] - (col + 0.5) * view.cell_m
            here = np.array([[x, y, 0.0]])
            expected = int(twins.simulation.ground(scan.scene, np.array([x]), np.array([y]))[1][0] < 0)
            for each in (car, truck):
                if inside(replace(each, center=(*each.center[:2], 0.0)), here)[0]:
                    expected = TOP_VIEW_CLASSES.index(each.label)
            assert labels[row, col] == expected
    cells = np.count_nonzero(labels == 2) * view.cell_m**2
    assert cells == pytest.approx(3.9 * 1.6, rel=0.03)
    assert set(np.unique(labels)) == {0, 1, 2, 4}


def test_islands_are_raised_and_not_drivable() -> None:
    scene = flat(street())
    scene.strips[0, :5] = 0.0, 0.0, 1.0, 0.0, 0.0
    scene.strips[0, 5:9] = -4.0, 8.0, -200.0, 200.0
    island = (0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 3.0, 10.0, 16.0, -1.0)
    scene = replace(scene, strips=np.vstack([scene.strips[:1], island]))
    assert not scene.on_road(13.0, 2.0)
    assert scene.on_road(13.0, 0.5)
    assert scene.on_road(20.0, 2.0)
    assert scene.ground_height(13.0, 2.0) >= 0.08
    assert scene.ground_height(13.0, 0.5) == pytest.approx(0.0, abs=1e-9)
    labels = simulate(scene, SMALL, 0, noise=False).top_view_labels()
    x, y = np.broadcast_arrays(*TopViewGeometry().cell_centers())
    on_island = (x > 10.0) & (x < 16.0) & (y > 1.0) & (y < 3.0)
    assert (labels[on_island] == 0).all()
    assert (labels[(y > -3.9) & (y < 0.9)] == 1).all()


@pytest.mark.compiled
def test_islands_have_poles_and_no_traffic() -> None:
    scenes = [scene for scene in map(random_scene, range(40)) if (scene.strips[:, 9] < 0.0).any()]
    assert len(scenes) > 4
    for scene in scenes:
        for each in scene.objects:
            if each.label in ("car", "van", "truck", "tram", "cyclist"):
                x, y = np.array([each.center[0]]), np.array([each.center[1]])
                assert twins.simulation.road_places(scene, x, y)[2][0] > 0.0


def test_trams_and_trailers_belong_to_no_class() -> None:
    tram, trailer = box("tram", 20.0, 4.0), Box("misc", 1.0, (12.0, -3.0, -0.83), (3.0, 1.6, 1.8), 0.0)
    tram = replace(tram, size=(14.0, 2.5, 3.4))
    scan = simulate(flat(street(tram, trailer, box("person_sitting", 9.0, 1.0))), SMALL, 0)
    labels, view = labels_by_boxes(scan), scan.top_view_labels()
    for k in (0, 1):
        assert scan.box_points[k] > 20
        assert (scan.labels[scan.objects == k] == 0).all()
        assert (labels[scan.objects == k] == IGNORE).mean() > 0.95
    assert (labels[scan.objects == 2] == 2).all()
    x, y = np.broadcast_arrays(*TopViewGeometry().cell_centers())
    assert (view[(np.abs(x - 20.0) < 6.5) & (np.abs(y - 4.0) < 1.0)] == 0).all()


@pytest.mark.compiled
def test_the_background_has_parts() -> None:
    seen = set[str]()
    for seed in range(3):
        scan = simulated_scan(seed)
        labels, objects = labels_of_scene(scan), labels_by_boxes(scan)
        np.testing.assert_array_equal(labels[objects > 0], objects[objects > 0])
        told = labels[objects == 0]
        assert not np.isin(told, [1, 2, 3]).any()
        ground = np.isin(labels, [SCENE_CLASSES.index(name) for name in ("road", "sidewalk", "terrain")])
        assert (scan.surfaces[ground] == -1).all()
        assert ground[(scan.surfaces == -1) & (objects == 0)].all()
        seen |= {SCENE_CLASSES[k] for k in np.unique(told)}
    assert seen == {"background", *STATIC}


@pytest.mark.compiled
@pytest.mark.parametrize(("height_m", "pitch_deg", "roll_deg"), [(1.4, 3.0, 0.0), (2.2, -3.0, 2.0)])
def test_scans_of_other_mountings(height_m: float, pitch_deg: float, roll_deg: float) -> None:
    mounting = Mounting(height_m=height_m, pitch_deg=pitch_deg, roll_deg=roll_deg)
    upright, scan = simulated_scan(6, SMALL), simulated_scan(6, replace(SMALL, mounting=mounting))
    turn = upright.T_world_sensor[:3, :3].T @ scan.T_world_sensor[:3, :3]
    np.testing.assert_allclose(turn, mounting.rotation(), atol=1e-12)
    assert scan.T_world_sensor[2, 3] - upright.T_world_sensor[2, 3] == pytest.approx(height_m - SMALL.mount_height_m)
    assert scan.scene.objects == upright.scene.objects
    world = scan.points[:, :3] @ scan.T_world_sensor[:3, :3].T + scan.T_world_sensor[:3, 3]
    above = world[:, 2] - twins.simulation.ground(scan.scene, world[:, 0], world[:, 1])[0]
    assert (np.abs(above) < 0.05).mean() > 0.4  # most returns are from the ground


def test_the_own_vehicle_stands_clear_of_objects() -> None:
    for seed in range(30):
        for each in simulated_scan(seed, SMALL).boxes:
            dx, dy = -each.center[0], -each.center[1]
            cos, sin = math.cos(each.yaw), math.sin(each.yaw)
            away = max(abs(cos * dx + sin * dy) - each.size[0] / 2, abs(cos * dy - sin * dx) - each.size[1] / 2)
            assert away > 0.9 or abs(each.center[2]) > 4.0, (seed, each)


def test_posts_stand_beside_the_roads() -> None:
    for seed, environment in enumerate(ENVIRONMENTS * 2):
        scene = random_scene(100 + seed, environment)
        static = scene.primitives[scene.primitives[:, 19] < 0]
        assert np.isfinite(static).all()
        upright = static[(static[:, 0] == 1) & (np.abs(static[:, 13:15]).sum(axis=1) < 1e-9)]
        feet = [row[6] - 1.0 / abs(row[15]) - scene.ground_height(*row[4:6]) for row in upright]
        standing = upright[np.array(feet) < -0.1]
        assert len(standing) > 3
        assert not any(scene.on_road(*row[4:6]) for row in standing)


def test_rows_of_a_layout_stand_in_bays_where_they_look_parked() -> None:
    parked = [box("car", 12.0 + 6.0 * k, -4.5) for k in range(3)]
    moving = [box("car", 15.0, 0.0), box("car", 10.0, 3.2, math.pi), box("car", 40.0, 3.2, math.pi)]
    scenes = [scene_from_boxes([*parked, *moving], seed) for seed in range(20)]
    in_bays = [scene.strips[-1, 9] > 0.0 for scene in scenes]
    assert 10 <= sum(in_bays) < 20
    for scene, bay in zip(scenes, in_bays, strict=True):
        # Not only the cars: the whole strip is no road.
        assert all(scene.on_road(x, -4.5) != bay for x in (9.0, 12.0, 21.0))
        assert all(scene.on_road(*each.center[:2]) for each in moving)


def test_layout_keeps_its_boxes() -> None:
    boxes = [
        box("car", 12, 3.2, 3.1),
        box("car", 25, 3.0, 3.1),
        box("tram", 40, 9.0, 0.0),
        box("van", 30, -5.5),
        box("pedestrian", 14, -7.0, 1.0),
    ]
    scene = scene_from_boxes(boxes, 2)
    for made, given_box in zip(scene.objects, boxes, strict=False):
        assert made.label == given_box.label
        assert made.size == given_box.size
        np.testing.assert_allclose(made.center[:2], given_box.center[:2])
        assert made.yaw == pytest.approx(given_box.yaw)
        ground = scene.ground_height(*made.center[:2])
        assert made.center[2] - made.size[2] / 2 == pytest.approx(ground)
    assert all(scene.on_road(*each.center[:2]) for each in boxes if each.label in ("car", "van"))
    scan = simulate(scene, SMALL, 0)
    near = [math.hypot(*each.center[:2]) < 35.0 for each in boxes]  # the one beyond is as small as a person
    assert all(points > 0 for points, close in zip(scan.box_points, near, strict=False) if close)


def test_roadside_stands_clear_of_objects_and_roads() -> None:
    for seed in range(4):
        scene = random_scene(seed, "urban")
        solid = scene.primitives[(scene.primitives[:, 19] < 0) & (scene.primitives[:, 1] == FACADE)]
        for x, y in solid[:, 4:6]:
            assert not scene.on_road(x, y)
            assert all(math.hypot(x - o.center[0], y - o.center[1]) > 1.0 for o in scene.objects)


def test_people_sit_at_tables_beside_the_road(monkeypatch: pytest.MonkeyPatch) -> None:
    def seated(share: float) -> list[Scene]:
        monkeypatch.setattr(drawn, "add_cafe", lambda street, _: add_cafe(street, share))
        return [random_scene(seed, "urban") for seed in range(6)]

    for bare, scene in zip(seated(0.0), seated(1.0), strict=True):
        assert scene.objects[: len(bare.objects)] == bare.objects
        people = scene.objects[len(bare.objects) :]
        tables = scene.primitives[(scene.primitives[:, 19] == -1.0) & (scene.primitives[:, 1] == MATTE), 4:6]
        for person in people:
            assert person.label == "person_sitting"
            assert not scene.on_road(*person.center[:2])
            ahead = person.center[0] + 0.7 * math.cos(person.yaw), person.center[1] + 0.7 * math.sin(person.yaw)
            assert np.hypot(*(tables - ahead).T).min() < 0.5  # faces a table
    assert sum(len(scene.objects) for scene in seated(1.0)) > 20 + sum(len(scene.objects) for scene in seated(0.0))


def test_objects_move_on() -> None:
    still = SceneObject("car", (10.0, 0.0, 0.75), (4.0, 1.6, 1.5), 0.0, 7)
    straight = replace(still, speed_mps=5.0)
    turning = replace(still, speed_mps=math.pi, yaw_rate_rps=math.pi / 2)  # a circle of radius 2
    scene = replace(flat(street()), objects=(still, straight, turning))
    after = scene.at(1.0).objects
    assert after[0] == still
    np.testing.assert_allclose(after[1].center, (15.0, 0.0, 0.75))
    np.testing.assert_allclose(after[2].center, (12.0, 2.0, 0.75), atol=1e-9)
    assert after[2].yaw == pytest.approx(math.pi / 2)
    np.testing.assert_allclose(scene.at(4.0).objects[2].center, still.center, atol=1e-9)


def test_sequence() -> None:
    scene = flat(street(box("car", 15, 0.0)))
    scene = replace(scene, objects=(replace(scene.objects[0], speed_mps=8.0, yaw=0.0),), strips=scene.strips.copy())
    scene.strips[0, 2:5] = 1.0, 0.0, 0.0
    scans: list[tuple[float, np.ndarray, SimulatedScan]] = list(simulate_sequence(scene, SMALL, 3, 10.0, 5.0, seed=1))
    for k, (stamp_s, pose, scan) in enumerate(scans):
        assert stamp_s == pytest.approx(0.1 * k)
        np.testing.assert_allclose(pose[:3, 3], (0.5 * k, 0.0, 1.73), atol=1e-9)
        assert scan.box_ids == (scene.objects[0].track_id,)
        assert scan.boxes[0].center[0] == pytest.approx(15.0 + 0.8 * k - 0.5 * k)
        assert scan.box_points[0] > 0
    assert list(simulate_sequence(scene, SMALL, 0)) == []


def patterned(name: str, duration_s: float = 0.02, start_s: float = 0.0) -> SimulatedScan:
    """What a sensor without beams sees of a hall that is all around, so that every ray returns."""
    scene = flat(street())
    around = [plate(x, size, z=0.0) for x, size in ((20.0, (2.0, 90.0, 90.0)), (-20.0, (2.0, 90.0, 90.0)))]
    ends = [np.array(block(0, 0.4, (0.0, y, 0.0), (90.0, 2.0, 90.0))) for y in (20.0, -20.0)]
    roof = [np.array(block(0, 0.4, (0.0, 0.0, 30.0), (90.0, 90.0, 2.0)))]
    hall = replace(scene, primitives=np.stack([*around, *ends, *roof]))
    return simulate(hall, name, 0, noise=False, start_s=start_s, duration_s=duration_s)


def angles_deg(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    flat_m = np.hypot(points[:, 0], points[:, 1])
    return np.degrees(np.arctan2(points[:, 1], points[:, 0])), np.degrees(np.arctan2(points[:, 2], flat_m))


@pytest.mark.parametrize("name", ["mid-360", "hap", "avia"])
def test_a_pattern_fills_its_field_of_view_and_does_not_repeat(name: str) -> None:
    sensor = get_sensor(name)
    first, second = patterned(name, 0.1), patterned(name, 0.1, 0.1)
    assert len(first.points) == pytest.approx(0.1 * sensor.pattern.points_per_s, rel=0.01)
    azimuth, elevation = angles_deg(first.points)
    half_deg = sensor.pattern.width_deg / 2.0
    assert np.abs(azimuth).max() == pytest.approx(half_deg, rel=0.02)
    assert elevation.min() == pytest.approx(sensor.fov_down_deg, abs=0.5)
    assert elevation.max() == pytest.approx(sensor.fov_up_deg, abs=0.5)

    def cells(points: np.ndarray, deg: float) -> set[tuple[int, int]]:
        columns, rows = (np.floor(angle / deg).astype(int) for angle in angles_deg(points))
        inside = np.hypot(columns * deg / half_deg, rows * deg / sensor.fov_up_deg) < 0.7
        return {*zip(columns[inside].tolist(), rows[inside].tolist(), strict=True)}

    # Even: in the middle, nearly every cell of five degrees has points; new: of fine cells, the next scan has others.
    assert len(cells(first.points, 5.0) ^ cells(second.points, 5.0)) < 0.1 * len(cells(first.points, 5.0))
    fine, next_fine = cells(first.points, 0.2), cells(second.points, 0.2)
    assert len(fine & next_fine) < 0.7 * len(fine)


@pytest.mark.parametrize("name", ["mid-360", "hap", "avia"])
def test_parts_of_a_pattern_make_the_whole(name: str) -> None:
    whole = patterned(name, 0.03).points
    parts = [patterned(name, 0.01, start_s).points for start_s in (0.0, 0.01, 0.02)]
    # On the ground, within what its samples allow.
    np.testing.assert_allclose(np.concatenate(parts)[:, :3], whole[:, :3], rtol=0, atol=5e-3)


def test_a_sequence_of_a_pattern_goes_on_from_scan_to_scan() -> None:
    scene = random_scene(3)
    steps = list(simulate_sequence(scene, "mid-360", 3, 100.0, 10.0))
    assert [round(stamp_s, 3) for stamp_s, _, _ in steps] == [0.0, 0.01, 0.02]
    for k, (stamp_s, pose, scan) in enumerate(steps):
        again = simulate(scene.at(stamp_s), "mid-360", k, pose, start_s=stamp_s, duration_s=0.01)
        np.testing.assert_array_equal(scan.points, again.points)
        assert 0 < len(scan.points) <= 2000


@pytest.mark.kernel
@pytest.mark.parametrize(("seed", "n"), [(0, 60), (1, 1), (2, 0)])
def test_rays_of_their_own_elevations_are_cast_as_by_the_twins(seed: int, n: int) -> None:
    scene = near_scene(seed)
    rng = np.random.default_rng(seed)
    pose = sensor_pose(scene, SMALL, 1.0, 0.3, yaw=0.2)
    rays = Rays(rng.uniform(-0.4, 0.2, (1, n)), np.sort(rng.uniform(0.0, 2 * np.pi, n)), 40.0, KEY)
    for n_sectors in (1, 36):
        placed, hits = cast(scene, pose, rays, n_sectors)
        slow_ranges, slow_hits = twins.simulation.cast(placed, scene, pose, rays)
        sure = (slow_ranges < 18.0) & (np.abs(hits.ranges - slow_ranges) < 0.5)
        np.testing.assert_array_equal(hits.rows[sure], slow_hits[sure])
        np.testing.assert_allclose(hits.ranges[sure], slow_ranges[sure], rtol=0, atol=0.03)
        assert sure.sum() >= 0.9 * (slow_ranges < 18.0).sum()
        check_points(placed, scene, pose, rays, hits, Receiver(np.zeros(1), np.zeros(1), 0.5, True, True))
