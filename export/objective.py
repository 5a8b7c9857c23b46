"""The loss of every network."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .losses import box_distillation_loss, distillation_loss, pointseg_loss, road_loss, ssadnet_loss
from .recipe import Recipe
from .teacher import taught

__all__ = ["distilled", "loss_of"]

# Vehicles are 4 % of the labelled pixels, pedestrians and cyclists 0.2 %.
POINT_WEIGHTS = (1.0, 2.0, 4.0, 4.0)
TOP_VIEW_WEIGHTS = (1.0, 1.0, 2.0, 4.0, 4.0)

# The dense head's loss is a sum a box, ten times the segmentation's per pixel.
LW_DET_DENSE = 0.2


def loss_of(recipe: Recipe, outputs: Tensor | tuple[Tensor, Tensor], targets: Sequence[Tensor]) -> Tensor:
    """The loss of a recipe."""
    if recipe.labels_points:
        weights = torch.tensor(POINT_WEIGHTS, device=targets[0].device) if recipe.class_weights else None
        how = {"focal_gamma": recipe.focal_gamma, "lovasz_weight": recipe.lovasz_weight}
        if not isinstance(outputs, tuple):
            return pointseg_loss(outputs, targets[0], weights, **how)
        logits, early = outputs
        # The nearest of every four columns: a mean of labels would be none.
        coarse = targets[0][:, :, 1 :: targets[0].shape[2] // early.shape[3]]
        loss = pointseg_loss(logits, targets[0], weights, **how)
        return loss + recipe.deep_supervision * pointseg_loss(early, coarse, weights, **how)
    if recipe.network == "lodnn":
        assert isinstance(outputs, Tensor)
        return road_loss(outputs, targets[0], recipe.lovasz_weight)
    weights = torch.tensor(TOP_VIEW_WEIGHTS, device=targets[0].device) if recipe.class_weights else None
    lw_det = LW_DET_DENSE if recipe.head == "dense" else 0.1
    how = {"lw_det": lw_det, "class_weights": weights, "lovasz_weight": recipe.lovasz_weight}
    return ssadnet_loss(*outputs, *targets, **how)[0]


def distilled(recipe: Recipe, teacher: nn.Module, x: Tensor, outputs: Tensor | tuple[Tensor, Tensor]) -> Tensor:
    probabilities, boxes = taught(teacher, x, recipe.network, mirror=recipe.seen_twice)
    logits = outputs[0] if isinstance(outputs, tuple) else outputs
    if recipe.network == "lodnn":  # its teacher tells vehicles from the rest, too
        probabilities = torch.stack([1.0 - probabilities[:, 1], probabilities[:, 1]], dim=1)
    loss = distillation_loss(logits, probabilities)
    if recipe.network == "ssadnet" and recipe.head == "dense":
        loss = loss + LW_DET_DENSE * box_distillation_loss(outputs[1], boxes)
    return loss
