"""A spinning-LiDAR simulator for the demo, the benchmark, tests and training.

`drawn` makes random scenes, and `layouts` makes scenes around real boxes, from the parts in
`street`, `roadside`, `vehicles` and `people`, which consist of the primitives in `shapes`.
`scene` turns a scene into a labeled scan with the ray-casting kernels of `raycast`. `samples` makes the scans for
training and evaluation, with point labels from boxes as in KITTI. A number out of its range is an OptionError.
"""

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
