"""Losses of the networks."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from edgeperc.simulation.samples import IGNORE

from ..data.targets import REGRESSED_FROM

# Offsets, log sizes and the doubled angle have errors of similar size in an untrained head. z and height count half,
# because no metric uses them.
GEOMETRY_WEIGHTS = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.5, 0.5)
FRONT_WEIGHT = 0.5
"""Weight of the front's cross-entropy among the errors of a box, which it is as large as before training."""
N_GEOMETRY = 1 + len(GEOMETRY_WEIGHTS)
NEGLIGIBLE_ERROR = 1e-3  # of a pixel, in the Lovasz-softmax loss


def cross_entropy(
    logits: Tensor, labels: Tensor, class_weights: Tensor | None = None, *, focal_gamma: float = 0.0
) -> Tensor:
    """Cross-entropy averaged over the labeled pixels (SSADNet equation 4, where all pixels are labeled).

    logits : (B, C, H, W) float
    labels : (B, H, W) integer; `IGNORE` in unlabeled pixels. Without a labeled pixel the loss is 0.
    class_weights : (C,) float; weights of the average, by true class.
    focal_gamma : scale each pixel by (1 - probability of its true class) ** focal_gamma.
    """
    log_p = F.log_softmax(logits.float(), dim=1)
    labels = labels.long()
    known = labels != IGNORE
    truth = labels.masked_fill(~known, 0)
    log_p_true = log_p.gather(1, truth.unsqueeze(1)).squeeze(1)
    weights = known.float() if class_weights is None else class_weights.float()[truth] * known
    loss = -log_p_true
    if focal_gamma > 0.0:
        # Clamped, because the slope of a power below 1 is infinite at 0.
        loss = loss * (1.0 - log_p_true.exp()).clamp(min=1e-6) ** focal_gamma
    return (weights * loss).sum() / weights.sum().clamp(min=1e-6)


def lovasz_softmax(logits: Tensor, labels: Tensor) -> Tensor:
    """A differentiable bound of 1 - mean IoU over the classes present (Berman et al., 2018).

    Shapes as for `cross_entropy`; the batch counts as one image.
    """
    if logits.is_cuda:
        return lovasz_at_once(logits, labels)
    known = labels != IGNORE
    probabilities = logits.float().softmax(1).movedim(1, -1)[known]  # (n, C)
    labels = labels[known].long()
    losses = []
    for index in range(logits.shape[1]):
        total = (labels == index).sum()
        if not total:
            continue
        truth = (labels == index).float()
        errors = (truth - probabilities[:, index]).abs()
        # Sorting takes most of the time. Small errors change the loss by at most their size, the gradient by 0.01 %.
        kept = errors > NEGLIGIBLE_ERROR
        errors, order = errors[kept].sort(descending=True)
        truth = truth[kept][order]
        # The Jaccard loss if the first 1, 2, ... pixels were wrong; its increments weight the errors.
        intersection = total - truth.cumsum(0)
        union = total + (1.0 - truth).cumsum(0)
        jaccard = 1.0 - intersection / union
        steps = torch.cat([jaccard[:1], jaccard[1:] - jaccard[:-1]])
        losses.append(errors @ steps)
    return torch.stack(losses).mean() if losses else logits.float().sum() * 0.0


def lovasz_at_once(logits: Tensor, labels: Tensor) -> Tensor:
    """`lovasz_softmax` of all classes and all errors at once: it sorts more, but never waits for the GPU."""
    known, n_classes = (labels != IGNORE).flatten(), logits.shape[1]
    probabilities = logits.float().softmax(1).movedim(1, 0).flatten(1)  # (C, n)
    truth = (labels.flatten() == torch.arange(n_classes, device=labels.device)[:, None]).float()
    # Unlabeled pixels have no error, so they are sorted behind all others and change nothing.
    errors, order = ((truth - probabilities).abs() * known).sort(dim=1, descending=True)
    truth = truth.gather(1, order)
    total = truth.sum(1, keepdim=True)
    jaccard = 1.0 - (total - truth.cumsum(1)) / (total + (1.0 - truth).cumsum(1))
    steps = jaccard.diff(dim=1, prepend=jaccard.new_zeros((n_classes, 1)))
    present = total[:, 0] > 0
    return ((errors * steps).sum(1) * present).sum() / present.sum().clamp(min=1)


def pointseg_loss(
    logits: Tensor,
    labels: Tensor,
    class_weights: Tensor | None = None,
    *,
    focal_gamma: float = 0.0,
    lovasz_weight: float = 0.0,
) -> Tensor:
    """`cross_entropy` plus ``lovasz_weight`` times `lovasz_softmax`. Parameters are those of `cross_entropy`."""
    loss = cross_entropy(logits, labels, class_weights, focal_gamma=focal_gamma)
    return loss + lovasz_weight * lovasz_softmax(logits, labels) if lovasz_weight > 0.0 else loss


def road_loss(logits: Tensor, labels: Tensor, lovasz_weight: float = 0.0) -> Tensor:
    """Cross-entropy of a road map plus ``lovasz_weight`` times `lovasz_softmax` of every fourth cell.

    Every fourth, because sorting all cells would take a tenth of a training step. Shapes as for `cross_entropy`.
    """
    loss = cross_entropy(logits, labels)
    if lovasz_weight > 0.0:
        loss = loss + lovasz_weight * lovasz_softmax(logits[:, :, ::2, ::2], labels[:, ::2, ::2])
    return loss


def distillation_loss(logits: Tensor, probabilities: Tensor) -> Tensor:
    """Mean cross-entropy of the pixels towards a teacher's probabilities (B, C, H, W) (Hinton et al., 2015)."""
    return -(probabilities * F.log_softmax(logits.float(), dim=1)).sum(1).mean()


def box_distillation_loss(predicted: Tensor, teacher: Tensor) -> Tensor:
    """Difference of dense boxes (B, 9 or 11, H, W) from a teacher's: cross-entropy of the heat maps, and box errors.

    Both are divided by the sum of the teacher's heat, which also weights the errors (`dense_loss`). Fronts count if
    both networks predict them.
    """
    predicted, teacher = predicted.float(), teacher.float()
    heat = teacher[:, 0].sigmoid()
    heat_loss = F.binary_cross_entropy_with_logits(predicted[:, 0], heat, reduction="sum")
    share = heat * (heat >= REGRESSED_FROM)
    # The likelier of the two headings that the teacher's doubled angle allows, and its probability.
    yaw = 0.5 * torch.atan2(teacher[:, 5], teacher[:, 6])
    front, heading = teacher[:, N_GEOMETRY:], torch.stack([yaw.cos(), yaw.sin()], dim=1)
    likely = (front * heading).sum(1, keepdim=True).sigmoid() if front.shape[1] else None
    error = _box_error(predicted, teacher, heading, likely)
    return (heat_loss + (error * share).sum()) / share.sum().clamp(min=1.0)


def slots_loss(predicted: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Loss of the presence and of the boxes of slots that each have a square of the view.

    Both are (B, n_slots, 5), the target from `slot_targets`. The presence's loss is the cross-entropy of its logits in
    the slots that are learned, the boxes' loss the error in the slots with an object: the distances of the centers
    in shares of the true width and height, the differences of the logarithms of width and height, and 1 - IoU. Both
    are sums divided by the number of objects. The paper's squared errors of shares of the whole image are near zero for
    any box that is roughly in place: 1 m beside a car is an error of 0.0025.
    """
    predicted = predicted.float()
    presence, share = target[..., 4], (target[..., 4] == 1.0).float()
    n = share.sum().clamp(min=1.0)
    cross = F.binary_cross_entropy_with_logits(predicted[..., 4], share, reduction="none")
    # Slots without an object are compared with a box of any size, which keeps their unused errors finite.
    true_size = torch.where(share[..., None] > 0.0, target[..., 2:4], 1.0)
    size = predicted[..., 2:4].clamp(1e-4, 1e4)
    apart = (predicted[..., :2] - target[..., :2]).abs()
    error = (apart / true_size + (size / true_size).log().abs()).sum(-1)
    shared = (0.5 * (size + true_size) - apart).clamp(min=0.0).minimum(size).minimum(true_size).prod(-1)
    iou = shared / (size.prod(-1) + true_size.prod(-1) - shared)
    return (cross * (presence >= 0.0)).sum() / n, ((error + 1.0 - iou) * share).sum() / n


def paper_slots_loss(predicted: Tensor, target: Tensor) -> Tensor:
    """Mean squared errors of x, y, width and height, summed (SSADNet equations 5 and 6).

    Both are (B, n_slots, 4). The mean is over the batch, as printed, and over the slots, which the paper does not
    mention. Slots with a negative target are not learned.
    """
    known = (target >= 0.0).all(2, keepdim=True).float()
    squared = known * (predicted.float() - target) ** 2
    return squared.sum() / known.sum().clamp(min=1.0)


def dense_loss(predicted: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Loss of the heat map (penalty-reduced focal loss; Zhou et al., 2019) and of the geometry (L1).

    The prediction is (B, 9 or 11, H, W), the target (B, 11, H, W) from `dense_targets`. The heat map's loss is a sum
    divided by the number of boxes. An error of the geometry is the sum of a cell's absolute errors, weighted by
    `GEOMETRY_WEIGHTS`, plus `FRONT_WEIGHT` times the cross-entropy of the front if it is predicted. The geometry's loss
    is the mean error of the cells with a heat of at least `REGRESSED_FROM`, weighted by the heat.
    """
    predicted = predicted.float()
    logit, heat = predicted[:, 0], target[:, 0]
    center, known = heat == 1.0, heat >= 0.0
    p = logit.sigmoid()
    hit = (1.0 - p) ** 2 * F.logsigmoid(logit)
    miss = (1.0 - heat) ** 4 * p**2 * F.logsigmoid(-logit)
    heat_loss = -(torch.where(center, hit, miss) * known).sum() / center.sum().clamp(min=1)

    share = heat * (heat >= REGRESSED_FROM)
    error = _box_error(predicted, target, target[:, N_GEOMETRY:], torch.ones_like(heat[:, None]))
    geometry_loss = (error * share).sum() / share.sum().clamp(min=1.0)
    return heat_loss, geometry_loss


def _box_error(predicted: Tensor, target: Tensor, heading: Tensor, likely: Tensor | None) -> Tensor:
    """Error of each cell's box, (B, H, W).

    ``heading``: unit vectors (B, 2, H, W); ``likely``: probability (B, 1, H, W) that the front is there, if known.
    """
    apart = (predicted[:, 1:N_GEOMETRY] - target[:, 1:N_GEOMETRY]).abs()
    error = (apart * predicted.new_tensor(GEOMETRY_WEIGHTS).view(1, -1, 1, 1)).sum(1)
    front = predicted[:, N_GEOMETRY:]
    if likely is not None and front.shape[1]:
        logit = (front * heading).sum(1, keepdim=True)
        error = error + FRONT_WEIGHT * F.binary_cross_entropy_with_logits(logit, likely, reduction="none")[:, 0]
    return error


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

    logits, boxes : outputs of the network.
    labels : (B, H, W) integer; as for `cross_entropy`.
    box_targets : (B, n_slots, 5) from `slot_targets`, (B, n_slots, 4) from `paper_slot_targets`, or (B, 11, H/4, W/4)
        from `dense_targets`.
    lw_seg, lw_det : weights of the two losses (Table 2).
    class_weights : (C,) float; not in the paper.
    lovasz_weight : weight of `lovasz_softmax` in the segmentation's loss. Not in the paper.
    Returns parts: Detached losses: "seg", and "det" (the paper's slots), "presence" and "geometry" (slots) or "heat"
        and "geometry" (dense).
    """
    seg = cross_entropy(logits, labels, class_weights)
    if lovasz_weight > 0.0:
        # Every fourth cell, because sorting all of them would take a tenth of a training step.
        seg = seg + lovasz_weight * lovasz_softmax(logits[:, :, ::2, ::2], labels[:, ::2, ::2])
    parts = {"seg": seg}
    if boxes.ndim == 4:
        parts["heat"], parts["geometry"] = dense_loss(boxes, box_targets)
        det = parts["heat"] + parts["geometry"]
    elif boxes.shape[2] == 5:
        parts["presence"], parts["geometry"] = slots_loss(boxes, box_targets)
        det = parts["presence"] + parts["geometry"]
    else:
        det = parts["det"] = paper_slots_loss(boxes, box_targets)
    return lw_seg * seg + lw_det * det, {name: part.detach() for name, part in parts.items()}
