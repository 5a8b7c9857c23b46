"""Figures watched during training, and early stopping."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from edgeperc.decode import decode_top_view
from edgeperc.evaluation.metrics import BoxEvaluator, Confusion
from edgeperc.perception import Box
from edgeperc.simulation.scene import POINT_CLASSES, TOP_VIEW_CLASSES

from .cards import ROAD_CLASSES, TOP_VIEW, card_of
from .objective import loss_of
from .recipe import Recipe
from .samples import FEWEST, Samples
from .scans import LabelledScan

__all__ = ["Watch"]


class Watch:
    """Judges a network on real frames that it is not trained on: pixel labels, and boxes where it finds any.

    Parameters
    ----------
    recipe : Recipe
    samples : Samples
        Makes the inputs.
    scans : sequence of LabelledScan
        What to judge by.
    """

    def __init__(self, recipe: Recipe, samples: Samples, scans: Sequence[LabelledScan]) -> None:
        self.recipe, self.card = recipe, card_of(recipe.network, recipe.head, version="0")
        self.inputs = [samples.sample(scan) for scan in scans]
        self.scans = scans

    def judge(self, network: nn.Module) -> tuple[float, float, dict[str, float | None]]:
        """The figure that decides (mean IoU of objects, or AP of boxes), the mean loss, and every figure by name."""
        losses, road_alone = [], self.recipe.network == "lodnn"
        classes = POINT_CLASSES if self.recipe.labels_points else ROAD_CLASSES if road_alone else TOP_VIEW_CLASSES
        pixels, boxes = Confusion(classes), BoxEvaluator()
        device = next(network.parameters()).device
        for (image, *targets), scan in zip(self.inputs, self.scans, strict=True):
            with torch.no_grad():
                outputs = network(torch.from_numpy(image[None]).to(device))
            losses.append(float(loss_of(self.recipe, outputs, [torch.from_numpy(t[None]).to(device) for t in targets])))
            if self.recipe.labels_points or road_alone:
                pixels.update(outputs[0].argmax(0).cpu().numpy(), targets[0])
                continue
            logits, regressed = (output[0].cpu().numpy() for output in outputs)
            answers = {"class_logits": logits, f"box_{self.recipe.head}": regressed}
            labels, found = decode_top_view(self.card, image, answers, self.card.score_threshold)
            pixels.update(labels, targets[0])
            _update(boxes, found, scan)
        figures = {name: _rounded(iou) for name, iou in zip(classes, pixels.iou(), strict=True)}
        if self.recipe.labels_points or road_alone:
            return float(np.nanmean(pixels.iou()[1:])), float(np.mean(losses)), figures
        scores = boxes.overall()
        figures |= {"ap": _rounded(scores.ap), "recall": _rounded(scores.recall)}
        return scores.ap, float(np.mean(losses)), figures


def _update(evaluator: BoxEvaluator, found: Sequence[Box], scan: LabelledScan) -> None:
    """Count boxes whose centre is where truth is known."""
    labelled = scan.labelled(TOP_VIEW)

    def judged(box: Box) -> bool:
        row = int((TOP_VIEW.x_range_m[1] - box.center[0]) / TOP_VIEW.cell_m)
        col = int((TOP_VIEW.y_range_m[1] - box.center[1]) / TOP_VIEW.cell_m)
        return 0 <= row < TOP_VIEW.height and 0 <= col < TOP_VIEW.width and bool(labelled[row, col])

    truth, ignored = [], []
    for box, count in zip(scan.boxes, scan.counts, strict=True):
        wanted = box.label in TOP_VIEW_CLASSES[2:] and count >= FEWEST and judged(box)
        (truth if wanted else ignored).append(box)
    evaluator.update([b for b in found if judged(b)], truth, ignored=ignored)


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(float(value), 4)
