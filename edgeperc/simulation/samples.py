"""Labeled simulated scans for evaluation and training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..geometry import inside
from ..perception import Box
from ..sensor import SensorProfile
from .drawn import random_scene
from .layouts import scene_from_boxes
from .scene import POINT_CLASS_OF, SimulatedScan, sensor_pose, simulate

__all__ = ["FIRST_SEED", "IGNORE", "labels_by_boxes", "simulated_scan"]

IGNORE = 255

# Measured: height of the bottom of KITTI's boxes above the ground around them (median of 720 boxes).
BOX_ABOVE_GROUND_M = 0.03


def simulated_scan(
    seed: int, sensor: str | SensorProfile = "hdl-64e", boxes: Sequence[Box] | None = None
) -> SimulatedScan:
    """Simulate one scan of a new scene. The sensor is slightly pitched and rolled, beside the middle of its lane.

    Parameters
    ----------
    seed : int
        Seed of the scene, the pose and the noise.
    sensor : str or SensorProfile
    boxes : sequence of Box, optional
        A real layout to build the scene around (`layouts.scene_from_boxes`); by default the scene is random.
    """
    rng = np.random.default_rng((seed, 1))
    if boxes is None:
        scene = random_scene(seed)
        x, y, yaw = rng.normal(0.0, 4.0), rng.normal(0.0, 0.5), rng.normal(0.0, 0.05)
    else:
        scene, x, y, yaw = scene_from_boxes(boxes, seed), 0.0, 0.0, 0.0
    pitch, roll = rng.normal(0.0, 0.008, size=2)
    pose = sensor_pose(scene, sensor, x, y, yaw=yaw, pitch=pitch, roll=roll)
    return simulate(scene, sensor, seed, pose)


def labels_by_boxes(scan: SimulatedScan) -> NDArray[np.uint8]:
    """Label the points of a simulated scan by its boxes, as in KITTI: (n,) uint8, index into `POINT_CLASSES`.

    Every point in a box gets the class of the object, including ground points, if the object itself has returns.
    """
    labels = scan.labels.copy()
    for box, returns in zip(scan.boxes, scan.box_points, strict=True):
        if returns:
            raised = replace(box, center=(box.center[0], box.center[1], box.center[2] + BOX_ABOVE_GROUND_M))
            labels[inside(raised, scan.points)] = POINT_CLASS_OF[box.label]
    return labels


FIRST_SEED = 2 * 10**9  # seeds of evaluated scenes; training scenes start at 0, scenes that verify exports at 10**9
