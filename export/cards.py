"""Views and inputs of this project's networks, and their model cards."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar, cast

from edgeperc.objects.boxes import OBJECT_SIZE_M
from edgeperc.objects.crops import FEATURES
from edgeperc.simulation.scene import POINT_CLASSES, TOP_VIEW_CLASSES
from edgeperc.simulation.street import CAMERA_CLASSES
from edgeperc.types.card import InputSpec, ModelCard, OutputSpec
from edgeperc.types.choices import VEHICLES
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import CameraGeometry, ObjectGeometry, RangeImageGeometry, TopViewGeometry

from .recipe import EDGE_BLOCKS, Recipe


def _with_channel(spec: InputSpec, name: str, mean: float, std: float) -> InputSpec:
    return replace(spec, channels=(*spec.channels, name), mean=(*spec.mean, mean), std=(*spec.std, std))


ROAD_CLASSES = TOP_VIEW_CLASSES[:2]
"""LoDNN's classes; the ground under a vehicle is background."""

OBJECT_CLASSES = ("background", *VEHICLES, "pedestrian", "cyclist")
BOX_SIZES = {name: OBJECT_SIZE_M[name] for name in OBJECT_CLASSES[1:]}
"""Usual length, width and height [m] of objects, from which the object network's sizes start."""

TOP_VIEW = TopViewGeometry()
OBJECT_VIEW = ObjectGeometry(n_points=48)
RANGE_IMAGE = RangeImageGeometry(get_sensor("hdl-64e").elevations_deg)
# SSADNet 2.1.2 scales every channel to its range; the farthest corner of the view is 47.07 m away.
TOP_VIEW_INPUT = InputSpec("top_view", ("distance", "remission", "height"), (0.0, 0.0, -2.5), (47.07, 1.0, 5.0))
# Means and standard deviations of the returns in the front 90 degrees of 27 training scans.
RANGE_IMAGE_INPUT = InputSpec(
    "range_image",
    ("x", "y", "z", "remission", "range"),
    (12.95, 0.0, -1.31, 0.234, 14.51),
    (11.35, 7.86, 0.82, 0.148, 12.27),
)
# With the height above the ground: mean and standard deviation of 718,139 returns ahead in 26 training scans.
HEIGHT_INPUT = _with_channel(RANGE_IMAGE_INPUT, "height_above_ground", 0.41, 0.72)
# With the curvature: rounded, of 789,768 returns ahead in training scans.
CURVED_INPUT = _with_channel(HEIGHT_INPUT, "curvature", 0.2, 0.24)

# Means and standard deviations, rounded, of the features of 30,000 training samples.
OBJECT_INPUT = InputSpec(
    "candidates",
    FEATURES,
    (0.0, 0.0, 1.0, 0.2, -0.8, -0.4, 0.7, 0.0, 1.5, -0.5, 0.0, 25.0, 4.0),
    (1.5, 1.0, 0.8, 0.2, 1.2, 0.8, 0.8, 0.8, 0.9, 0.7, 0.7, 16.0, 1.5),
)

# Means and standard deviations of the 367 training images.
CAMERA_INPUT = InputSpec("image", ("red", "green", "blue"), (105.0, 108.5, 110.3), (78.3, 79.4, 78.3))
# The comparison of networks on CamVid divides by 255 (Jebamikyous, 2021, section 4.2).
PLAIN_CAMERA_INPUT = InputSpec("image", ("red", "green", "blue"), (0.0, 0.0, 0.0), (255.0, 255.0, 255.0))


def card_of(recipe: Recipe, **facts: Any) -> ModelCard:
    """The card of a recipe's network; ``facts`` are further arguments of `ModelCard`, at least ``version``."""
    facts = {"name": recipe.network, **facts}
    block = EDGE_BLOCKS.get(recipe.network, (1, 1)) if recipe.edge else (1, 1)
    view: CameraGeometry | ObjectGeometry | RangeImageGeometry | TopViewGeometry = TOP_VIEW
    input, outputs = TOP_VIEW_INPUT, [OutputSpec("segmentation", "class_logits", block=block)]
    classes: tuple[str, ...] = TOP_VIEW_CLASSES
    if recipe.task == "objects":
        view, input, outputs = OBJECT_VIEW, OBJECT_INPUT, [OutputSpec("objects", "objects")]
        classes = OBJECT_CLASSES
        # On the folds, the F1 of cars is 0.79 with 0.5 and 0.65 with 0.3; AP is the same.
        facts = {"score_threshold": 0.5, "box_classes": classes[1:], "box_size_priors": BOX_SIZES, **facts}
    elif recipe.task == "camera":
        view = CameraGeometry(recipe.image_width, recipe.image_height)
        input = CAMERA_INPUT if recipe.network == "camseg" else PLAIN_CAMERA_INPUT
        outputs, classes = [OutputSpec("logits", "camera_logits")], CAMERA_CLASSES
    elif recipe.task == "points":
        view, input = RANGE_IMAGE, HEIGHT_INPUT if recipe.height_above_ground else RANGE_IMAGE_INPUT
        input = CURVED_INPUT if recipe.curvature else input
        outputs, classes = [OutputSpec("logits", "class_logits", block=block)], recipe.classes or POINT_CLASSES
    elif recipe.task == "road":
        outputs, classes = [OutputSpec("segmentation", "class_logits")], ROAD_CLASSES
    else:
        outputs.append(OutputSpec("boxes", "box_dense" if recipe.head == "dense" else "box_slots", recipe.front))
        # Length, width, height: geometric means, and standard deviations of the logarithms, of 28,963 labels of KITTI
        # without test drives.
        facts = {
            "box_classes": VEHICLES,
            "box_size_priors": {"car": (3.86, 1.63, 1.52), "van": (5.0, 1.9, 2.18), "truck": (10.02, 2.58, 3.2)},
            "box_size_spreads": {
                "car": (0.11, 0.06, 0.084),
                "van": (0.164, 0.087, 0.143),
                "truck": (0.291, 0.09, 0.144),
            },
            **facts,
        }
    return ModelCard(view=view, input=input, outputs=tuple(outputs), classes=classes, **facts)


_View = TypeVar("_View")
_T = TypeVar("_T", bound="Carded[Any]")


@dataclass(frozen=True)
class Carded(Generic[_View]):
    """What the task of every network has."""

    recipe: Recipe
    card: ModelCard  # view, input, classes and outputs, as the exported model has them

    @classmethod
    def of(cls: type[_T], recipe: Recipe) -> _T:
        """The task of a recipe."""
        return cls(recipe, card_of(recipe, version="0"))

    @property
    def view(self) -> _View:
        """What the network sees."""
        return cast("_View", self.card.view)

    @property
    def input(self) -> InputSpec:
        """The channels of the network's input."""
        return self.card.input

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes of the network's output; of objects, the background first."""
        return self.card.classes
