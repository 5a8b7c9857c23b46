"""What the networks are trained towards: the targets made from boxes (numpy) and the losses (torch)."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from edgeperc.card import TopViewGeometry
from edgeperc.datasets import IGNORE

__all__ = [
    "box_distillation_loss",
    "cross_entropy",
    "dense_loss",
    "dense_targets",
    "distillation_loss",
    "lovasz_softmax",
    "pointseg_loss",
    "road_loss",
    "slot_targets",
    "slots_loss",
    "ssadnet_loss",
]

STRIDE = 4
"""Top-view cells along the edge of an output cell of head "dense"."""

REGRESSED_FROM = 0.5
"""Cells whose heat is at least this learn the box's geometry, weighted by the heat. The peak found may be a neighbour
of the true one, whose geometry must then be right too."""

# Offsets, log sizes and the doubled angle err by about as much in an untrained head; height above ground, which no
# metric here looks at, counts half.
GEOMETRY_WEIGHTS = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.5, 0.5)


# --- Targets ---------------------------------------------------------------------------------------------------------


def slot_targets(boxes: ArrayLike, view: TopViewGeometry, n_slots: int) -> NDArray[np.float32]:
    """Upright boxes around rotated footprints, nearest first (SSADNet 3.1.1).

    Parameters
    ----------
    boxes : (m, 7) array_like
        x, y, z of the centre, length, width, height [m], yaw [rad], in the sensor frame.
    view : TopViewGeometry
    n_slots : int
        The nearest this many are kept.

    Returns
    -------
    (n_slots, 4) float32
        Centre column, centre row, width and height as shares of the image's width and height; zeros in empty slots.
        Boxes whose centre is outside the view are left out.

    Raises
    ------
    ValueError
        A length, width or height is not positive.
    """
    boxes, rows, cols = _boxes_in_view(boxes, view)
    length, width, yaw = boxes[:, 3], boxes[:, 4], boxes[:, 6]
    across = np.abs(length * np.sin(yaw)) + np.abs(width * np.cos(yaw))
    along = np.abs(length * np.cos(yaw)) + np.abs(width * np.sin(yaw))
    found = np.stack(
        [cols / view.width, rows / view.height, across / view.cell_m / view.width, along / view.cell_m / view.height],
        axis=1,
    )
    nearest = np.argsort(-rows, kind="stable")[:n_slots]
    target = np.zeros((n_slots, 4), np.float32)
    target[: len(nearest)] = found[nearest]
    return target


def dense_targets(
    boxes: ArrayLike,
    view: TopViewGeometry,
    *,
    labelled: NDArray[np.bool_] | None = None,
    unsure: ArrayLike | None = None,
) -> NDArray[np.float32]:
    """Heat map and geometry for head "dense".

    Parameters
    ----------
    boxes : (m, 7) array_like
        As for `slot_targets`.
    view : TopViewGeometry
        Height and width divisible by 4.
    labelled : (height, width) bool, optional
        False where a box would not have been labelled, as outside the camera's view.
    unsure : (k, 7) array_like, optional
        Boxes that are neither to be found nor to be missed, such as those without a single point in them.

    Returns
    -------
    (9, height/4, width/4) float32
        Channel 0: 1 in the output cell that holds a box's centre, falling off as a Gaussian shaped like the box (its
        edges are three standard deviations away); -1 where nothing is to be learned. Channels 1 to 8: the geometry of
        the box with the highest heat, in the format of box_dense, where that heat is at least `REGRESSED_FROM`; else 0.
    """
    height, width = view.height // STRIDE, view.width // STRIDE
    target = np.zeros((9, height, width), np.float32)
    heat = target[0]

    boxes, rows, cols = _boxes_in_view(boxes, view)
    for box, row, col in zip(boxes, rows / STRIDE, cols / STRIDE, strict=True):
        bump = _gaussian(box, row, col, (height, width), view.cell_m * STRIDE)
        cell_rows, cell_cols = np.nonzero((bump > heat) & (bump >= REGRESSED_FROM))
        double_yaw = 2.0 * box[6]
        target[1, cell_rows, cell_cols] = row - (cell_rows + 0.5)
        target[2, cell_rows, cell_cols] = col - (cell_cols + 0.5)
        target[3:, cell_rows, cell_cols] = np.array(
            [np.log(box[3]), np.log(box[4]), np.sin(double_yaw), np.cos(double_yaw), box[2], np.log(box[5])]
        )[:, None]
        np.maximum(heat, bump, out=heat)

    unlearned = np.zeros((height, width), bool)
    if labelled is not None:
        unlearned |= ~labelled.reshape(height, STRIDE, width, STRIDE).all((1, 3))
    if unsure is not None:
        boxes, rows, cols = _boxes_in_view(unsure, view)
        for box, row, col in zip(boxes, rows / STRIDE, cols / STRIDE, strict=True):
            unlearned |= _gaussian(box, row, col, (height, width), view.cell_m * STRIDE) > 0.1
    heat[unlearned & (heat < REGRESSED_FROM)] = -1.0
    return target


def _boxes_in_view(
    boxes: ArrayLike, view: TopViewGeometry
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Boxes whose centre is in the view, and the row and column [cells, from the far left corner] of those centres."""
    boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
    if not (boxes[:, 3:6] > 0.0).all():
        raise ValueError("a box is without extent; expected length, width and height above 0 m")
    rows = (view.x_range_m[1] - boxes[:, 0]) / view.cell_m
    cols = (view.y_range_m[1] - boxes[:, 1]) / view.cell_m
    inside = (rows >= 0) & (rows < view.height) & (cols >= 0) & (cols < view.width)
    return boxes[inside], rows[inside], cols[inside]


def _gaussian(
    box: NDArray[np.float64], row: float, col: float, shape: tuple[int, int], cell_m: float
) -> NDArray[np.float32]:
    """A bump of height 1 in the output cell that holds (row, col), as long and wide as the box."""
    forward = int(row) - np.arange(shape[0])[:, None]  # rows grow backwards, columns to the right
    left = int(col) - np.arange(shape[1])[None, :]
    cos, sin = np.cos(box[6]), np.sin(box[6])
    along, across = cos * forward + sin * left, cos * left - sin * forward
    # No narrower than half a cell, or a bump would be one cell and hard to hit.
    sigma_along, sigma_across = max(box[3] / cell_m / 6.0, 0.5), max(box[4] / cell_m / 6.0, 0.5)
    return np.exp(-0.5 * ((along / sigma_along) ** 2 + (across / sigma_across) ** 2)).astype(np.float32)


# --- Losses ----------------------------------------------------------------------------------------------------------


def cross_entropy(
    logits: Tensor, labels: Tensor, class_weights: Tensor | None = None, *, focal_gamma: float = 0.0
) -> Tensor:
    """Cross-entropy averaged over labelled pixels (SSADNet equation 4, where every pixel is labelled).

    Parameters
    ----------
    logits : (B, C, H, W) float
    labels : (B, H, W) integer
        `IGNORE` where not labelled. Without a labelled pixel the loss is 0.
    class_weights : (C,) float, optional
        Weights of the average, by true class.
    focal_gamma : float
        Scale each pixel by (1 - probability of its true class) ** focal_gamma.
    """
    log_p = F.log_softmax(logits.float(), dim=1)
    labels = labels.long()
    known = labels != IGNORE
    truth = labels.masked_fill(~known, 0)
    log_p_true = log_p.gather(1, truth.unsqueeze(1)).squeeze(1)
    weights = known.float() if class_weights is None else class_weights.float()[truth] * known
    loss = -log_p_true
    if focal_gamma > 0.0:
        # Clamped, for below 1 the power's slope at 0 is infinite.
        loss = loss * (1.0 - log_p_true.exp()).clamp(min=1e-6) ** focal_gamma
    return (weights * loss).sum() / weights.sum().clamp(min=1e-6)


def lovasz_softmax(logits: Tensor, labels: Tensor) -> Tensor:
    """A convex stand-in for 1 - mean IoU over the classes present (Berman et al., 2018).

    Shapes as for `cross_entropy`; the batch counts as one image.
    """
    known = labels != IGNORE
    probabilities = logits.float().softmax(1).movedim(1, -1)[known]  # (n, C)
    labels = labels[known].long()
    losses = []
    for index in labels.unique():
        truth = (labels == index).float()
        errors, order = (truth - probabilities[:, index]).abs().sort(descending=True)
        truth = truth[order]
        # The Jaccard loss if the 1st, the first 2, ... pixels were the wrong ones; its steps weigh the errors.
        intersection = truth.sum() - truth.cumsum(0)
        union = truth.sum() + (1.0 - truth).cumsum(0)
        jaccard = 1.0 - intersection / union
        steps = torch.cat([jaccard[:1], jaccard[1:] - jaccard[:-1]])
        losses.append(errors @ steps)
    return torch.stack(losses).mean() if losses else logits.float().sum() * 0.0


def pointseg_loss(
    logits: Tensor,
    labels: Tensor,
    class_weights: Tensor | None = None,
    *,
    focal_gamma: float = 0.0,
    lovasz_weight: float = 0.0,
) -> Tensor:
    """Class-weighted cross-entropy, `focal_gamma` included, plus ``lovasz_weight`` times `lovasz_softmax`."""
    loss = cross_entropy(logits, labels, class_weights, focal_gamma=focal_gamma)
    return loss + lovasz_weight * lovasz_softmax(logits, labels) if lovasz_weight > 0.0 else loss


def road_loss(logits: Tensor, labels: Tensor, lovasz_weight: float = 0.0) -> Tensor:
    """Cross-entropy of a map of roads, plus so many times `lovasz_softmax` of every fourth cell.

    Of every fourth: sorting all of them would take a tenth of a training step.
    """
    loss = cross_entropy(logits, labels)
    if lovasz_weight > 0.0:
        loss = loss + lovasz_weight * lovasz_softmax(logits[:, :, ::2, ::2], labels[:, ::2, ::2])
    return loss


def distillation_loss(logits: Tensor, probabilities: Tensor) -> Tensor:
    """Mean cross-entropy of pixels towards a teacher's probabilities (B, C, H, W) (Hinton et al., 2015)."""
    return -(probabilities * F.log_softmax(logits.float(), dim=1)).sum(1).mean()


def box_distillation_loss(predicted: Tensor, taught: Tensor) -> Tensor:
    """Distance of dense boxes (B, 9, H, W) from a teacher's: cross-entropy of the heat maps and L1 of the geometry.

    Both count by the teacher's heat: the first is a sum a box, as in `dense_loss`, the second a weighted mean.
    """
    predicted, taught = predicted.float(), taught.float()
    heat = taught[:, 0].sigmoid()
    heat_loss = F.binary_cross_entropy_with_logits(predicted[:, 0], heat, reduction="sum")
    share = heat * (heat >= REGRESSED_FROM)
    error = (predicted[:, 1:] - taught[:, 1:]).abs() * predicted.new_tensor(GEOMETRY_WEIGHTS).view(1, -1, 1, 1)
    total = share.sum().clamp(min=1.0)
    return (heat_loss + (error.sum(1) * share).sum()) / total


def slots_loss(predicted: Tensor, target: Tensor) -> Tensor:
    """Mean squared errors of x, y, width and height, summed (SSADNet equations 5 and 6).

    Both are (B, n_slots, 4). The mean is taken over the batch, as printed, and over the slots, of which the paper does
    not speak. Slots with a negative target are not learned.
    """
    known = (target >= 0.0).all(2, keepdim=True).float()
    squared = known * (predicted.float() - target) ** 2
    return squared.sum() / known.sum().clamp(min=1.0)


def dense_loss(predicted: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Loss of the heat map (penalty-reduced focal loss; Zhou et al., 2019) and of the geometry (L1).

    Both arguments are (B, 9, H, W), the target from `dense_targets`. The heat map's is a sum a box; the geometry's an
    average over the cells that learn it, weighted by their heat and summed over channels by `GEOMETRY_WEIGHTS`.
    """
    predicted = predicted.float()
    logit, heat = predicted[:, 0], target[:, 0]
    centre, known = heat == 1.0, heat >= 0.0
    p = logit.sigmoid()
    hit = (1.0 - p) ** 2 * F.logsigmoid(logit)
    miss = (1.0 - heat) ** 4 * p**2 * F.logsigmoid(-logit)
    heat_loss = -(torch.where(centre, hit, miss) * known).sum() / centre.sum().clamp(min=1)

    share = heat * (heat >= REGRESSED_FROM)
    error = (predicted[:, 1:] - target[:, 1:]).abs() * predicted.new_tensor(GEOMETRY_WEIGHTS).view(1, -1, 1, 1)
    geometry_loss = (error.sum(1) * share).sum() / share.sum().clamp(min=1.0)
    return heat_loss, geometry_loss


def ssadnet_loss(
    logits: Tensor,
    boxes: Tensor,
    labels: Tensor,
    box_targets: Tensor,
    *,
    lw_seg: float = 1.0,
    lw_det: float = 0.1,
    class_weights: Tensor | None = None,
    lovasz_weight: float = 0.0,
) -> tuple[Tensor, dict[str, Tensor]]:
    """lw_seg x segmentation + lw_det x detection (SSADNet equation 3).

    Parameters
    ----------
    logits, boxes : Tensor
        What the network returned.
    labels : (B, H, W) integer
    box_targets : Tensor
        Shaped like ``boxes``: (B, n_slots, 4) from `slot_targets`, or (B, 9, H/4, W/4) from `dense_targets`.
    lw_seg, lw_det : float
        Table 2.
    class_weights : (C,) float, optional
        Not in the paper.
    lovasz_weight : float
        Adds so many times `lovasz_softmax` to the segmentation's loss. Not in the paper.

    Returns
    -------
    total : Tensor
    parts : dict
        Detached: "seg", and "det" or "heat" and "geometry".
    """
    seg = cross_entropy(logits, labels, class_weights)
    if lovasz_weight > 0.0:
        # Every fourth cell: sorting all of them would take a tenth of a training step.
        seg = seg + lovasz_weight * lovasz_softmax(logits[:, :, ::2, ::2], labels[:, ::2, ::2])
    parts = {"seg": seg}
    if boxes.ndim == 4:
        parts["heat"], parts["geometry"] = dense_loss(boxes, box_targets)
        det = parts["heat"] + parts["geometry"]
    else:
        det = parts["det"] = slots_loss(boxes, box_targets)
    return lw_seg * seg + lw_det * det, {name: part.detach() for name, part in parts.items()}
