"""How well classes of an image get to points, and its road to the top view, in simulated streets.

The image's classes are the true ones, so that only the geometry is judged: hidden points, the ground, the projection.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..camera.calibration import Calibration
from ..camera.painting import UNSEEN, camera_road, paint
from ..errors import OptionError
from ..simulation.camera import CAMERA_CLASSES, VOID, CameraImage, forward_camera, render, true_classes
from ..simulation.drawn import random_scene
from ..simulation.samples import FIRST_SEED
from ..simulation.scene import SimulatedScan, simulate
from ..types.mounting import Mounting
from ..types.perception import ImageLabels
from ..types.points import Labels, Mask
from ..types.sensor import SensorProfile, get_sensor

EDGE_PX = 3
"""Points within this many rows and columns of a pixel of another class are not judged."""
NEAR_M = 26.0  # where the rings of most sensors are close together


def evaluate_painting(
    sensor: str | os.PathLike[str] | SensorProfile,
    n_scenes: int,
    *,
    at_m: tuple[float, float, float] = (0.27, 0.0, -0.08),
    on_scene: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, int | float]:
    """Shares of points and observed cells that are painted rightly in simulated streets that no model was trained on,
    with the camera ``at_m`` in the LiDAR's frame. Raises OptionError, SensorError, CalibrationError.
    """
    if n_scenes < 1:
        raise OptionError(f"n_scenes is {n_scenes}; expected at least 1")
    calibration, profile, total = forward_camera(at_m=at_m), get_sensor(sensor), Counter[str]()
    profile = replace(profile, mounting=Mounting(profile.mounting.height_m))  # the ground is found from a level camera
    for k in range(n_scenes):
        scan = simulate(random_scene(FIRST_SEED + k), profile, FIRST_SEED + k)
        total += count_painting(scan, render(scan.scene, calibration, scan.T_world_sensor, k), calibration, profile)
        on_scene(k + 1, n_scenes)
    shares = {
        "points_right": ("right", "painted"),
        "points_right_untested": ("right_untested", "in_image"),
        "points_seen": ("seen", "visible"),
        "cells_right": ("cells_right", "cells"),
        "near_cells_right": ("near_right", "near_cells"),
        "road_iou": ("road_both", "road_either"),
        "road_seen": ("road_observed", "road"),
    }
    return {
        "n_scenes": n_scenes,
        "n_points": total["painted"],
        "n_cells": total["cells"],
        **{name: total[part] / max(total[whole], 1) for name, (part, whole) in shares.items()},
    }


def count_painting(
    scan: SimulatedScan, image: CameraImage, calibration: Calibration, sensor: str | os.PathLike[str] | SensorProfile
) -> Counter[str]:
    """Numbers of points and cells of a street that get their true class, by `evaluate_painting`'s names."""
    labels = ImageLabels(image.labels, CAMERA_CLASSES)
    painted, true = paint(labels, scan.points, calibration, sensor=sensor), true_classes(scan)
    u, v, depth = calibration.project(scan.points)
    with np.errstate(invalid="ignore"):
        inside = (u >= -0.5) & (u < calibration.width - 0.5) & (v >= -0.5) & (v < calibration.height - 0.5)
    row, col = (np.floor(each[inside] + 0.5).astype(np.int64) for each in (v, u))
    pixel, painted, true, depth = image.labels[row, col], painted[inside], true[inside], depth[inside]
    away = ~beside_edges(image.labels)[row, col] & (true != VOID) & (pixel != VOID)
    took = away & (painted != UNSEEN)
    visible = away & (depth <= 1.02 * image.depth_m[row, col] + 0.5)

    found = camera_road(labels, scan.points, calibration, sensor=sensor)
    cells = scan.top_view_labels(found.geometry)
    # Below vehicles, whether there is road depends on how far the camera sees under them.
    judged, road = found.observed & (cells < 2), cells == 1
    near = judged & (found.geometry.cell_centers()[0] < NEAR_M)
    masks = {
        "painted": took,
        "right": took & (painted == true),
        "in_image": away,
        "right_untested": away & (pixel == true),
        "visible": visible,
        "seen": visible & took,
        "cells": judged,
        "cells_right": judged & (found.road == road),
        "near_cells": near,
        "near_right": near & (found.road == road),
        "road_both": judged & found.road & road,
        "road_either": judged & (found.road | road),
        "road": road,
        "road_observed": judged & road,
    }
    return Counter({name: int(np.count_nonzero(mask)) for name, mask in masks.items()})


def beside_edges(labels: Labels) -> Mask:
    """Pixels with another class within `EDGE_PX` rows and columns."""
    least, most = labels.copy(), labels.copy()
    for axis in (0, 1):
        for extreme, pick in ((least, np.minimum), (most, np.maximum)):
            before = extreme.swapaxes(0, axis).copy()
            now = extreme.swapaxes(0, axis)
            for k in range(1, EDGE_PX + 1):
                pick(now[k:], before[:-k], out=now[k:])
                pick(now[:-k], before[k:], out=now[:-k])
    return np.asarray((least != labels) | (most != labels))
