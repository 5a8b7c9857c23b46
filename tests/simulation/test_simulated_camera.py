"""The camera of the simulated street, against the LiDAR of the same street and against the scene."""

from __future__ import annotations

import math

import numpy as np
import pytest

import twins.simulation
from edgeperc import Calibration, CalibrationError
from edgeperc.simulation import raycast
from edgeperc.simulation.camera import (
    CAMERA_CLASSES,
    VOID,
    CameraImage,
    forward_camera,
    render,
    surface_classes,
    true_classes,
)
from edgeperc.simulation.drawn import ENVIRONMENTS, random_scene
from edgeperc.simulation.layouts import scene_from_boxes
from edgeperc.simulation.raycast import FACADE, LEAVES
from edgeperc.simulation.scene import Scene, SimulatedScan, simulate
from edgeperc.types.perception import Box

SEED = 2_000_000_006
CAMERA = forward_camera(320, 240)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(SEED, "residential")


@pytest.fixture(scope="module")
def scan(scene: Scene) -> SimulatedScan:
    return simulate(scene, "hdl-64e", SEED, noise=False)


@pytest.fixture(scope="module")
def image(scene: Scene, scan: SimulatedScan) -> CameraImage:
    return render(scene, CAMERA, scan.T_world_sensor, SEED)


def names_of(labels: np.ndarray) -> set[str]:
    return {CAMERA_CLASSES[k] for k in np.unique(labels[labels != VOID]).tolist()}


def test_the_camera_measures_as_the_lidar_does(scan: SimulatedScan) -> None:
    """A camera in the LiDAR's place: at the pixel of a return are its depth and its class, but at edges."""
    T = CAMERA.T_camera_sensor.copy()
    T[:3, 3] = 0.0
    camera = Calibration(2.0 * CAMERA.K - np.diag([0.0, 0.0, 1.0]), T, 640, 480)
    image = render(scan.scene, camera, scan.T_world_sensor, SEED)
    u, v, depth = camera.project(scan.points)
    inside = (u > 0.0) & (u < 639.0) & (v > 0.0) & (v < 479.0)
    row, col = np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int)
    apart = np.abs(image.depth_m[row, col] - depth[inside]) / depth[inside]
    assert inside.sum() > 5000
    assert np.median(apart) < 2e-3  # the ray of the pixel is up to half a pixel beside the LiDAR's
    assert np.mean(apart < 0.05) > 0.9
    assert np.mean(image.labels[row, col] == true_classes(scan)[inside]) > 0.95


def test_an_image_has_the_classes_of_the_scene(image: CameraImage) -> None:
    assert image.labels.shape == image.depth_m.shape == image.rgb.shape[:2] == (240, 320)
    assert (image.labels.dtype, image.depth_m.dtype, image.rgb.dtype) == (np.uint8, np.float32, np.uint8)
    assert {"Sky", "Road", "Pavement", "Tree", "Car"} <= names_of(image.labels)
    sky = image.labels == CAMERA_CLASSES.index("Sky")
    assert np.isinf(image.depth_m[sky]).all()
    assert np.isfinite(image.depth_m[~sky]).all()
    assert (image.depth_m > 0.0).all()
    assert sky[:20].mean() > 0.5
    assert not sky[150:].any()
    assert (image.labels[-1] == CAMERA_CLASSES.index("Road")).mean() > 0.3
    for name in ("Road", "Tree", "Car"):  # a picture, not one color
        assert image.rgb[image.labels == CAMERA_CLASSES.index(name)].std(axis=0).min() > 3.0


def test_the_same_seed_gives_the_same_image(scene: Scene, scan: SimulatedScan, image: CameraImage) -> None:
    again = render(scene, CAMERA, scan.T_world_sensor, SEED)
    for name in ("rgb", "labels", "depth_m"):
        np.testing.assert_array_equal(getattr(again, name), getattr(image, name))
    other = render(scene, CAMERA, scan.T_world_sensor, SEED + 1)
    assert (other.rgb != image.rgb).any()
    assert np.mean(other.labels == image.labels) > 0.95  # leaves differ


def test_a_car_is_where_its_box_is() -> None:
    box = Box("car", 1.0, (12.0, 1.0, 0.75 - 1.73), (3.9, 1.6, 1.5), 0.3)
    scene = scene_from_boxes([box], 0)
    labels = render(scene, CAMERA, simulate(scene, "hdl-64e", 0).T_world_sensor, 0).labels
    corners = np.column_stack([np.tile(box.corners(), (2, 1)), np.repeat([-1.73, -0.23], 4)])
    u, v, _ = CAMERA.project(corners)
    car = labels == CAMERA_CLASSES.index("Car")
    row, col = np.nonzero(car)
    within = (col > u.min() - 2) & (col < u.max() + 2) & (row > v.min() - 4) & (row < v.max() + 4)
    area = (u.max() - u.min()) * (v.max() - v.min())
    assert 0.5 * area < within.sum() < area
    assert labels[round(float(v.mean())), round(float(u.mean()))] == CAMERA_CLASSES.index("Car")


def test_a_tilted_camera_sees_more_of_the_road(scene: Scene, scan: SimulatedScan, image: CameraImage) -> None:
    def looking_down(degrees: float) -> Calibration:
        turn, tilt = math.radians(degrees), np.eye(4)
        tilt[1:3, 1:3] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
        return Calibration(CAMERA.K, tilt @ CAMERA.T_camera_sensor, 320, 240)

    road = CAMERA_CLASSES.index("Road")
    down = render(scene, looking_down(10.0), scan.T_world_sensor, SEED)
    assert np.mean(down.labels == road) > np.mean(image.labels == road) + 0.05
    for degrees in (30.0, 180.0, -90.0):
        with pytest.raises(CalibrationError, match="tilted by more than 20 degrees"):
            render(scene, looking_down(degrees), scan.T_world_sensor, SEED)


@pytest.mark.parametrize("place", ENVIRONMENTS)
def test_every_shape_has_its_class(place: str) -> None:
    for seed in range(3):
        scene = random_scene(seed, place)
        classes, static = surface_classes(scene), scene.primitives[:, 19] < 0.0
        assert classes.shape == (len(scene.primitives),)
        assert {*np.unique(classes).tolist()} <= {*range(len(CAMERA_CLASSES)), VOID}
        material = scene.primitives[:, 1]
        assert names_of(classes[static & (material == FACADE)]) <= {"Building"}
        assert names_of(classes[static & (material == LEAVES)]) <= {"Tree"}
        assert not (classes[static & (material == LEAVES)] == VOID).any()
        owner = scene.primitives[~static, 19].astype(int)
        wanted = {"pedestrian": "Pedestrian", "person_sitting": "Pedestrian", "cyclist": "Bicyclist", "car": "Car"}
        for label, name in wanted.items():
            mine = classes[~static][[scene.objects[k].label == label for k in owner]]
            assert names_of(mine) <= {name}
            assert not (mine == VOID).any()
        assert not names_of(classes) & {"Sky", "Road", "Pavement"}  # these are no shapes
        # What has no class is the least part.
        assert np.mean(classes == VOID) < 0.15


def test_true_classes_of_points(scan: SimulatedScan) -> None:
    true = true_classes(scan)
    assert true.shape == (len(scan.points),)
    for k, label in enumerate(("Car", "Pedestrian", "Bicyclist"), start=1):
        assert (true[scan.labels == k] == CAMERA_CLASSES.index(label)).all()
    owner = np.append(scan.scene.primitives[:, 19], -1.0)[scan.surfaces]
    np.testing.assert_array_equal(np.maximum(owner, -1.0), scan.objects)
    ground = scan.surfaces == -1
    assert ground.sum() > 10_000
    world = scan.points[ground, :3] @ scan.T_world_sensor[:3, :3].T + scan.T_world_sensor[:3, 3]
    some = np.random.default_rng(0).choice(len(world), 300, replace=False)
    on_road = np.array([scan.scene.on_road(*world[k, :2]) for k in some])
    np.testing.assert_array_equal(true[ground][some] == CAMERA_CLASSES.index("Road"), on_road)


@pytest.mark.parametrize("n", [0, 1, 300])
def test_kinds_of_the_ground_equal_twin(n: int) -> None:
    rng = np.random.default_rng(n)
    for seed in range(4):
        scene = random_scene(seed)
        xy = rng.uniform(-60.0, 60.0, (n, 2))
        xy[rng.random((n, 2)) < 0.02] = rng.choice([np.nan, np.inf, -np.inf, 1e300])
        kinds, remissions = np.empty(n, np.uint8), np.empty(n)
        raycast.fill_ground_kinds(scene.ground, xy, kinds, remissions)
        slow_kinds, slow_remissions = twins.simulation.ground_kinds(scene, xy)
        np.testing.assert_array_equal(kinds, slow_kinds)
        np.testing.assert_allclose(remissions, slow_remissions, rtol=1e-9)
