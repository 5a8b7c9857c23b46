"""Simulated scans with labels, as evaluation and training use them."""

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

# Measured: the bottom of KITTI's boxes lies this far above the ground around them (median of 720 boxes).
BOX_ABOVE_GROUND_M = 0.03


def simulated_scan(
    seed: int, sensor: str | SensorProfile = "hdl-64e", boxes: Sequence[Box] | None = None
) -> SimulatedScan:
    """One scan of a scene of its own, the vehicle a little off its lane, pitched and rolled as on a real road.

    ``boxes`` gives the scene a real layout; without, everything is drawn from the seed.
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
    """A simulated scan's point labels (n,) as they would be in KITTI, where a box is all that is known of an object.

    What lies in the box of an object that was hit is the object, the ground at its feet included.
    """
    labels = scan.labels.copy()
    for box, returns in zip(scan.boxes, scan.box_points, strict=True):
        if returns:
            raised = replace(box, center=(box.center[0], box.center[1], box.center[2] + BOX_ABOVE_GROUND_M))
            labels[inside(raised, scan.points)] = POINT_CLASS_OF[box.label]
    return labels


FIRST_SEED = 2 * 10**9  # training draws its scenes from 0, proofs of exports from 10**9
