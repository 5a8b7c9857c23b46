"""A spinning-LiDAR simulator for the demo, the benchmark, tests and training.

`drawn` and `layouts` make scenes, `scene` casts them into labelled scans with the kernels of `raycast`, and `samples`
labels the scans as evaluation and training do.
"""

from __future__ import annotations

from .drawn import ENVIRONMENTS, random_scene
from .layouts import scene_from_boxes
from .scene import POINT_CLASSES, TOP_VIEW_CLASSES, Scene, SceneObject, SimulatedScan, simulate, simulate_sequence

__all__ = [
    "ENVIRONMENTS",
    "POINT_CLASSES",
    "TOP_VIEW_CLASSES",
    "Scene",
    "SceneObject",
    "SimulatedScan",
    "random_scene",
    "scene_from_boxes",
    "simulate",
    "simulate_sequence",
]
