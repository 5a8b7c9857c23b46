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
    """Cross-entropy of logits (B, C, H, W) averaged over the labeled pixels (SSADNet equation 4), weighted by true
    class; 0 without a label. ``focal_gamma`` scales a pixel by (1 - probability of its true class) ** focal_gamma.
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
    """A differentiable bound of 1 - mean IoU of the classes present (Berman et al., 2018); a batch is one image."""
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


def pixel_loss(
    logits: Tensor,
    labels: Tensor,
    class_weights: Tensor | None = None,
    *,
    focal_gamma: float = 0.0,
    lovasz_weight: float = 0.0,
    stride: int = 1,
) -> Tensor:
    """`cross_entropy` plus ``lovasz_weight`` times `lovasz_softmax` of one row and column in ``stride``: sorting all
    cells of a top view would take a tenth of a training step.
    """
    loss = cross_entropy(logits, labels, class_weights, focal_gamma=focal_gamma)
    if lovasz_weight > 0.0:
        loss = loss + lovasz_weight * lovasz_softmax(logits[:, :, ::stride, ::stride], labels[:, ::stride, ::stride])
    return loss


def distillation_loss(logits: Tensor, probabilities: Tensor) -> Tensor:
    """Mean cross-entropy of the pixels towards a teacher's probabilities (B, C, H, W) (Hinton et al., 2015)."""
    return -(probabilities * F.log_softmax(logits.float(), dim=1)).sum(1).mean()


def box_distillation_loss(predicted: Tensor, teacher: Tensor) -> Tensor:
    """Cross-entropy of heat maps and box errors (B, 9 or 11, H, W) by a teacher's heat; fronts if both predict them."""
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
    """Losses of presence and boxes (B, n_slots, 5) of `slot_targets`, by object: errors of centers in shares of the
    true size, of log sizes, and 1 - IoU. The paper's, in shares of the whole image, are near 0 for any box.
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
    """Mean squared errors of x, y, width and height (B, n_slots, 4), summed (SSADNet equations 5 and 6), over the batch
    and, which the paper does not mention, the slots; negative targets are not learned.
    """
    known = (target >= 0.0).all(2, keepdim=True).float()
    squared = known * (predicted.float() - target) ** 2
    return squared.sum() / known.sum().clamp(min=1.0)


def dense_loss(predicted: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Losses of the heat map (penalty-reduced focal loss, by box; Zhou et al., 2019) and of the geometry (L1, by cells
    with a heat of `REGRESSED_FROM`, weighted by it), of (B, 9 or 11, H, W) and `dense_targets`.
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
    """Error of each cell's box, (B, H, W), with the front's cross-entropy by its probability, if ``heading`` is
    known.
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
    lw_det: float = 0.1,
    class_weights: Tensor | None = None,
    lovasz_weight: float = 0.0,
) -> Tensor:
    """Segmentation + lw_det x detection (SSADNet equation 3; weights of Table 2), of targets of slots, the paper's
    slots or dense maps. Class weights and `lovasz_softmax` are not in the paper.
    """
    seg = pixel_loss(logits, labels, class_weights, lovasz_weight=lovasz_weight, stride=2)
    if boxes.ndim == 4:
        heat, geometry = dense_loss(boxes, box_targets)
        det = heat + geometry
    elif boxes.shape[2] == 5:
        presence, geometry = slots_loss(boxes, box_targets)
        det = presence + geometry
    else:
        det = paper_slots_loss(boxes, box_targets)
    return seg + lw_det * det
