"""Labeled simulated scans for evaluation and training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..errors import PointsError
from ..types.choices import PLACES
from ..types.frame import ModelFrame
from ..types.geometry import inside
from ..types.mounting import UNKNOWN_MOUNTING
from ..types.perception import Box
from ..types.points import Bytes
from ..types.sensor import SensorProfile
from .camera import CAMERA_CLASSES, true_classes
from .drawn import random_scene
from .halls import CLEAR_M, hall
from .layouts import scene_from_boxes
from .scene import POINT_CLASS_OF, SCENE_CLASSES, Scene, SimulatedScan, sensor_pose, simulate
from .yards import yard

IGNORE = 255

# Measured: height of the bottom of KITTI's boxes above the ground around them (median of 720 boxes).
BOX_ABOVE_GROUND_M = 0.03

_TREE = CAMERA_CLASSES.index("Tree")  # CamVid counts grass as trees
_OF_SURFACE = np.zeros(256, np.uint8)  # of `CAMERA_CLASSES`, among `SCENE_CLASSES`
_OF_SURFACE[[CAMERA_CLASSES.index(n) for n in ("Road", "Pavement", "Building", "Tree", "Pole", "SignSymbol")]] = [
    SCENE_CLASSES.index(n) for n in ("road", "sidewalk", "building", "vegetation", "pole", "pole")
]


def simulated_scan(
    seed: int,
    sensor: str | SensorProfile = "hdl-64e",
    boxes: Sequence[Box] | None = None,
    *,
    where: str = "street",
    clumped_leaves: bool = False,
) -> SimulatedScan:
    """Simulate one scan of a new scene. The vehicle is slightly pitched and rolled, beside the middle of its lane.

    sensor : mounted on it as its profile says. Points and boxes are in its frame (`in_models_frame`).
    boxes : a real layout to build the scene around (`layouts.scene_from_boxes`); by default the scene is random.
    where : one of `edgeperc.types.choices.PLACES`; a sensor that is as high as the ceiling of a hall hangs below it.
    clumped_leaves : as of `scene.simulate`.
    """
    if where not in PLACES:
        raise PointsError(f"got where={where!r}; expected one of {', '.join(PLACES)}")
    rng = np.random.default_rng((seed, 1))
    highest_m = math.inf
    if where == "hall":
        scene, (x, y, yaw), highest_m = hall(seed)
    elif where == "yard":
        scene, (x, y, yaw) = yard(seed)
    elif boxes is None:
        scene = random_scene(seed)
        x = y = 0.0
        yaw = rng.normal(0.0, 0.05)
        for _ in range(8):
            place = rng.normal(0.0, 4.0), rng.normal(0.0, 0.5)
            if _is_free(scene, *place, yaw):
                x, y = place
                break
    else:
        scene, x, y, yaw = scene_from_boxes(boxes, seed), 0.0, 0.0, 0.0
    # Measured: the road is pitched by 0.4 and rolled by 0.75 degrees (medians) against the sensor.
    pitch, roll = rng.normal(0.0, 0.006), rng.normal(0.0, 0.013)
    pose = sensor_pose(scene, sensor, x, y, yaw=yaw, pitch=pitch, roll=roll)
    pose[2, 3] = min(pose[2, 3], scene.ground_height(x, y) + highest_m - CLEAR_M)
    # Vehicles differ in what they hide. KITTI's car is one of them.
    return simulate(scene, sensor, seed, pose, ego_shadow=bool(rng.random() < 0.85), clumped_leaves=clumped_leaves)


def _is_free(scene: Scene, x: float, y: float, yaw: float) -> bool:
    """Whether the own vehicle (4.8 x 2.2 m) at x, y [m] is clear of the objects of a scene."""
    for each in scene.objects:
        reach = math.hypot(2.4, 1.1) + math.hypot(each.size[0], each.size[1]) / 2
        if math.hypot(each.center[0] - x, each.center[1] - y) > reach:
            continue
        cos, sin = math.cos(each.yaw), math.sin(each.yaw)
        for ahead in (-2.7, -1.35, 0.0, 1.05, 2.1):
            for left in (-1.1, 0.0, 1.1):
                dx = x + ahead * math.cos(yaw) - left * math.sin(yaw) - each.center[0]
                dy = y + ahead * math.sin(yaw) + left * math.cos(yaw) - each.center[1]
                if (
                    abs(cos * dx + sin * dy) < each.size[0] / 2 + 0.3
                    and abs(cos * dy - sin * dx) < each.size[1] / 2 + 0.3
                ):
                    return False
    return True


def in_models_frame(scan: SimulatedScan, sensor: SensorProfile) -> SimulatedScan:
    """The scan of a sensor whose profile says how it is mounted in the frame of the models; else as it is. Boxes have
    no tilt, so that only there they hold what a tilted sensor sees of their objects.
    """
    if sensor.mounting == UNKNOWN_MOUNTING:
        return scan
    frame = ModelFrame(replace(sensor.mounting, height_m=sensor.mount_height_m, origin_m=(0.0, 0.0)))
    T_model_sensor = np.eye(4)
    T_model_sensor[:3, :3], T_model_sensor[:3, 3] = frame.R, frame.t
    pose = scan.T_world_sensor @ np.linalg.inv(T_model_sensor)
    return replace(scan, points=frame.move(scan.points), boxes=frame.move_boxes(scan.boxes), T_world_sensor=pose)


def labels_by_boxes(scan: SimulatedScan) -> Bytes:
    """Label the points of a simulated scan by its boxes, as in KITTI: index into `POINT_CLASSES`.

    Every point in a box gets the class of the object, including ground points, if the object itself has returns. Points
    of objects without a class (trams and "misc" objects) get `IGNORE`.
    """
    labels = scan.labels.copy()
    for box, returns in zip(scan.boxes, scan.box_points, strict=True):
        if returns:
            raised = replace(box, center=(box.center[0], box.center[1], box.center[2] + BOX_ABOVE_GROUND_M))
            labels[inside(raised, scan.points)] = POINT_CLASS_OF.get(box.label, IGNORE)
    return labels


def labels_of_scene(scan: SimulatedScan) -> Bytes:
    """As `labels_by_boxes`, with the background told apart by its surfaces: index into `SCENE_CLASSES`."""
    labels, surface = labels_by_boxes(scan), true_classes(scan)
    lawn = (surface == _TREE) & (scan.surfaces == -1)
    return np.where(labels == 0, np.where(lawn, np.uint8(SCENE_CLASSES.index("terrain")), _OF_SURFACE[surface]), labels)


FIRST_SEED = 2 * 10**9  # seeds of evaluated scenes; training scenes start at 0, scenes that verify exports at 10**9
