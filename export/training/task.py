"""Tasks of networks: classes of points, vehicles and drivable area in a top view, or drivable area alone.

A task has a view, an input and classes. It makes the training targets of a scan, and computes the loss and the
validation figures of a network's outputs. All code but `networks.build` depends on the task, not on the network's name.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgeperc.evaluation.metrics import FEWEST_RETURNS, BoxEvaluator, Confusion, boxes_to_find, mean
from edgeperc.inference.decode import decode_top_view
from edgeperc.inference.projection import Projection
from edgeperc.simulation.samples import IGNORE
from edgeperc.types.card import ModelCard
from edgeperc.types.perception import Box
from edgeperc.types.views import RangeImageGeometry, TopViewGeometry

from ..cards import Carded
from ..data.scans import LabeledScan
from ..data.targets import dense_targets, paper_slot_targets, slot_targets
from ..recipe import Recipe
from .losses import box_distillation_loss, distillation_loss, pixel_loss, ssadnet_loss

Outputs: TypeAlias = "Tensor | tuple[Tensor, Tensor]"
"""What a network returns: logits (B, C, H, W), or logits and boxes, or PointSeg's logits and early logits."""
Targets: TypeAlias = "tuple[NDArray[Any], ...]"
"""Labels (H, W) uint8, and box targets if the network has boxes; in a batch, stacked along a new first axis."""

# Vehicles are 4 % of the labeled pixels, pedestrians and cyclists 0.2 %.
POINT_WEIGHTS = {"background": 1.0, "car": 2.0, "pedestrian": 4.0, "cyclist": 4.0}
OWN_WEIGHT = 2.0  # of a class that is not among these
TOP_VIEW_WEIGHTS = (1.0, 1.0, 2.0, 4.0, 4.0)

# The paper's slots: its weight (Table 2). The others: their losses, sums for each box, are about ten times as large as
# the segmentation's, a mean over cells.
BOX_WEIGHT = {"slots-paper": 0.1, "slots": 0.2, "dense": 0.2}
N_SLOTS = 16


@dataclass
class Tally:
    """Counts of a network's labels, and of its boxes if it has some, compared with the ground truth."""

    pixels: Confusion
    boxes: BoxEvaluator | None = None

    def decisive(self) -> float:
        """The figure that decides which weights are kept: AP of the boxes, else mean IoU without background."""
        return mean(self.pixels.iou()[1:]) if self.boxes is None else self.boxes.overall().ap

    def figures(self) -> dict[str, float | None]:
        """IoU of each class; AP, recall and share of right headings of the boxes. None where one is not defined."""
        found = dict(zip(self.pixels.classes, map(float, self.pixels.iou()), strict=True))
        if self.boxes is not None:
            scores = self.boxes.overall()
            found |= {"ap": scores.ap, "recall": scores.recall, "heading": scores.heading}
        return {name: None if math.isnan(value) else round(value, 4) for name, value in found.items()}


@dataclass(frozen=True)
class Task(Carded[RangeImageGeometry | TopViewGeometry], ABC):
    """The task of a recipe's network: its input, targets, loss and validation. Objects are pasted into scans by odds;
    swapped sectors replace points and their labels, but neither boxes nor the ground.
    """

    paste_odds: ClassVar[Mapping[str, float]]
    swaps_sectors: ClassVar[bool] = False

    @abstractmethod
    def target(self, scan: LabeledScan, projected: Projection) -> Targets:
        """The targets of a scan in `view`: labels (H, W) uint8, `IGNORE` where unknown, and box targets if any."""

    @abstractmethod
    def loss(self, outputs: Outputs, targets: Sequence[Tensor]) -> Tensor:
        """The loss of a batch: a network's outputs compared with the stacked targets of `target`."""

    def distillation(self, outputs: Outputs, probabilities: Tensor, boxes: Tensor | None = None) -> Tensor:
        """The distillation loss of a batch towards a teacher's class probabilities (B, C, H, W) and boxes."""
        return distillation_loss(_logits(outputs), probabilities)

    def tally(self) -> Tally:
        """An empty tally, for `count` to add to."""
        return Tally(Confusion(self.classes))

    def count(self, outputs: Outputs, projected: Projection, targets: Targets, scan: LabeledScan, tally: Tally) -> None:
        """Add the outputs for one scan (a batch of one) to a tally."""
        tally.pixels.update(_logits(outputs)[0].argmax(0).cpu().numpy(), targets[0])


class Points(Task):
    """A class for every pixel of a range image, and so for every point."""

    paste_odds: ClassVar[Mapping[str, float]] = {"pedestrian": 0.4, "cyclist": 0.35, "van": 0.15, "truck": 0.1}
    swaps_sectors = True

    def target(self, scan: LabeledScan, projected: Projection) -> Targets:
        """The label of the point in each pixel."""
        return (np.append(scan.labels, np.uint8(IGNORE))[projected.index],)  # the index of an empty pixel is -1

    def loss(self, outputs: Outputs, targets: Sequence[Tensor]) -> Tensor:
        """`pixel_loss`; with deep supervision, plus that of the early logits."""
        recipe, (labels,) = self.recipe, targets
        weights = None
        if recipe.class_weights:
            weights = torch.tensor([POINT_WEIGHTS.get(c, OWN_WEIGHT) for c in self.classes], device=labels.device)
        one = partial(
            pixel_loss, class_weights=weights, focal_gamma=recipe.focal_gamma, lovasz_weight=recipe.lovasz_weight
        )
        if isinstance(outputs, Tensor):
            return one(outputs, labels)
        logits, early = outputs
        # Every fourth column, because labels cannot be averaged.
        coarse = labels[:, :, 1 :: labels.shape[2] // early.shape[3]]
        return one(logits, labels) + recipe.deep_supervision * one(early, coarse)


class Vehicles(Task):
    """A class for every cell of a top view, and boxes around the vehicles."""

    paste_odds: ClassVar[Mapping[str, float]] = {"car": 0.3, "van": 0.4, "truck": 0.3}

    def target(self, scan: LabeledScan, projected: Projection) -> Targets:
        """The class of each cell, and slots or dense maps of the vehicles."""
        view, kinds = _top_view(self.card), self.card.box_classes
        vehicles = [(box, n) for box, n in zip(scan.boxes, scan.counts, strict=True) if box.label in kinds]
        to_find, unclear = (
            np.array([[*b.center, *b.size, b.yaw] for b, n in vehicles if (n >= FEWEST_RETURNS) == wanted], np.float64)
            for wanted in (True, False)
        )
        if self.recipe.head == "slots-paper":
            boxes = paper_slot_targets(to_find, view, N_SLOTS)
        else:
            targets = slot_targets if self.recipe.head == "slots" else dense_targets
            boxes = targets(to_find, view, labeled=scan.boxed(view), unsure=unclear)
        return scan.top_view_truth(view), boxes

    def loss(self, outputs: Outputs, targets: Sequence[Tensor]) -> Tensor:
        """`ssadnet_loss`."""
        (logits, boxes), (labels, box_targets) = outputs, targets
        weights = torch.tensor(TOP_VIEW_WEIGHTS, device=labels.device) if self.recipe.class_weights else None
        lw_det, lovasz_weight = BOX_WEIGHT[self.recipe.head], self.recipe.lovasz_weight
        return ssadnet_loss(
            logits, boxes, labels, box_targets, lw_det=lw_det, class_weights=weights, lovasz_weight=lovasz_weight
        )

    def distillation(self, outputs: Outputs, probabilities: Tensor, boxes: Tensor | None = None) -> Tensor:
        """Towards the teacher's classes, and towards its boxes if the head is dense."""
        loss = super().distillation(outputs, probabilities, boxes)
        if self.recipe.head == "dense":
            if boxes is None or boxes.ndim != 4 or boxes.shape[2:] != outputs[1].shape[2:]:
                raise ValueError('the teacher has no dense boxes; give --teacher a network with head "dense"')
            loss = loss + BOX_WEIGHT["dense"] * box_distillation_loss(outputs[1], boxes)
        return loss

    def tally(self) -> Tally:
        """An empty tally of labels and boxes. Slots are upright boxes, so they are compared with upright ones."""
        return Tally(Confusion(self.classes), BoxEvaluator(oriented=self.recipe.head == "dense"))

    def count(self, outputs: Outputs, projected: Projection, targets: Targets, scan: LabeledScan, tally: Tally) -> None:
        """Labels and boxes as the runtime decodes them; boxes count where the scan is labeled."""
        view = _top_view(self.card)
        kinds = [output.kind for output in self.card.outputs]
        raw = {kind: output[0].cpu().numpy() for kind, output in zip(kinds, outputs, strict=True)}
        labels, found = decode_top_view(self.card, projected.index >= 0, raw, self.card.score_threshold)
        tally.pixels.update(labels, targets[0])
        labeled = scan.boxed(view)

        def known(box: Box) -> bool:
            x, y = box.center[:2]
            row, col = int((view.x_range_m[1] - x) / view.cell_m), int((view.y_range_m[1] - y) / view.cell_m)
            return view.holds(x, y) and bool(labeled[min(row, view.height - 1), min(col, view.width - 1)])

        truth = zip(scan.boxes, scan.counts, strict=True)
        to_find, ignored = boxes_to_find(truth, view, self.card.box_classes, known=known)
        assert tally.boxes is not None
        tally.boxes.update([box for box in found if known(box)], to_find, ignored=ignored)


class Road(Task):
    """Whether each cell of a top view is drivable; ground under a vehicle is not."""

    paste_odds = Vehicles.paste_odds

    def target(self, scan: LabeledScan, projected: Projection) -> Targets:
        """1 for drivable cells, 0 for others."""
        truth = scan.top_view_truth(_top_view(self.card))
        return (np.where(truth == IGNORE, IGNORE, truth == 1).astype(np.uint8),)

    def loss(self, outputs: Outputs, targets: Sequence[Tensor]) -> Tensor:
        """`pixel_loss`."""
        return pixel_loss(_logits(outputs), targets[0], lovasz_weight=self.recipe.lovasz_weight, stride=2)

    def distillation(self, outputs: Outputs, probabilities: Tensor, boxes: Tensor | None = None) -> Tensor:
        """Towards the teacher's drivable class; all its other classes, vehicles included, count as one."""
        drivable = probabilities[:, 1]
        return distillation_loss(_logits(outputs), torch.stack([1.0 - drivable, drivable], dim=1))


def task_of(recipe: Recipe) -> Task:
    """The task of a recipe's network."""
    tasks: dict[str, type[Task]] = {"points": Points, "vehicles": Vehicles, "road": Road}
    return tasks[recipe.task].of(recipe)


def _logits(outputs: Outputs) -> Tensor:
    return outputs if isinstance(outputs, Tensor) else outputs[0]


def _top_view(card: ModelCard) -> TopViewGeometry:
    assert isinstance(card.view, TopViewGeometry)
    return card.view
