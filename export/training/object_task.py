"""The task of the object network: class, box and overlap of a candidate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy, smooth_l1_loss

from edgeperc.system.kernels import njit
from edgeperc.types.geometry import pair_iou
from edgeperc.types.points import Floats
from edgeperc.types.views import ObjectGeometry

from ..cards import Carded
from ..networks.objects import Parts, parts_of

VEHICLE = -1
"""Class of a vehicle of unknown kind."""

# Weights of the losses, and their scales: an error of this size [m, or of the logarithm of a side] counts as one.
PLACE, BOTTOM, SIZE, AXIS, FRONT, IOU, LOOK = 0.25, 0.15, 0.12, 0.2, 0.2, 0.7, 1.0
PLACE_M = {"car": 0.4, "van": 0.4, "truck": 0.4, "pedestrian": 0.2, "cyclist": 0.2}
BOTTOM_M, SIZE_LOG, AXIS_SCALE = 0.2, 0.1, 0.25
PEDESTRIAN_AXIS = 0.3  # of a vehicle's weight: pedestrians turn on the spot
BACKGROUND_IOU = 0.3
SMOOTHING = 0.02
VAN = 2  # a vehicle of unknown kind has the sizes of a van


@dataclass(frozen=True)
class Objects(Carded[ObjectGeometry]):
    """Class, box and overlap of candidates."""

    def loss(self, outputs: tuple[Tensor, Tensor], targets: Sequence[Tensor]) -> Tensor:
        """The loss of a batch: outputs (B, n) and logits (B,) of the first look; classes (B,) or `VEHICLE`, and boxes
        (B, 7) in the candidate's frame, with the bottom above the ground.
        """
        (values, look), (labels, boxes) = outputs, targets
        parts = parts_of(values, len(self.classes))
        is_vehicle = labels == VEHICLE
        by_class = cross_entropy(parts.classes, labels.clamp(min=0), reduction="none", label_smoothing=SMOOTHING)
        any_vehicle = -torch.log(parts.classes.softmax(1)[:, 1:4].sum(1) + 1e-6)
        by_class = torch.where(is_vehicle, any_vehicle, by_class)
        is_object = labels != 0
        kinds = torch.where(is_vehicle, VAN, labels)[is_object]
        own, right = Parts(*(part[is_object] for part in parts)), boxes[is_object]
        priors = self._priors(values)[kinds - 1]
        walks = kinds == self.classes.index("pedestrian")
        place_m = torch.tensor([PLACE_M[name] for name in self.classes[1:]], device=labels.device)[kinds - 1]
        place = _huber(own.place[:, :2], right[:, :2], place_m[:, None], 0.25)
        bottom = _huber(own.place[:, 2:], right[:, 2:3], BOTTOM_M, 0.5)
        sides = own.sizes[torch.arange(len(kinds)), kinds - 1]
        size = _huber(sides, (right[:, 3:6] / priors).log(), SIZE_LOG, 0.5)
        yaw = right[:, 6]
        axis = _huber(own.axis, torch.stack([(2 * yaw).cos(), (2 * yaw).sin()], dim=1), AXIS_SCALE, 0.5)
        towards = (own.front * torch.stack([yaw.cos(), yaw.sin()], dim=1)).sum(1)
        front = binary_cross_entropy_with_logits(towards, torch.ones_like(towards), reduction="none")
        turning = (AXIS * axis + FRONT * front) * torch.where(walks, PEDESTRIAN_AXIS, 1.0)
        iou = torch.zeros_like(parts.iou)
        iou[is_object] = self._overlaps(own, kinds, right)
        overlap = binary_cross_entropy_with_logits(parts.iou, iou, reduction="none")
        overlap = torch.where(is_object, 1.0, BACKGROUND_IOU) * overlap
        of_boxes = (PLACE * place + BOTTOM * bottom + SIZE * size + turning).mean() if len(kinds) else 0.0
        first = binary_cross_entropy_with_logits(look.float(), is_object.float())
        return by_class.mean() + of_boxes + IOU * overlap.mean() + LOOK * first

    def boxes(self, parts: Parts, kinds: Tensor) -> Tensor:
        """Boxes (B, 7) in the candidates' frames, of the given classes, as the runtime decodes them."""
        sides = parts.sizes[torch.arange(len(kinds)), kinds - 1].clamp(-1.0, 1.0)
        axis = 0.5 * torch.atan2(parts.axis[:, 1], parts.axis[:, 0])
        towards = axis.cos() * parts.front[:, 0] + axis.sin() * parts.front[:, 1]
        yaw = torch.where(towards < 0.0, axis + math.pi, axis)
        return torch.cat([parts.place, self._priors(sides)[kinds - 1] * sides.exp(), yaw[:, None]], dim=1)

    @torch.no_grad()
    def _overlaps(self, parts: Parts, kinds: Tensor, right: Tensor) -> Tensor:
        """Overlap in space (IoU) of the decoded boxes with the true ones."""
        iou = np.empty(len(kinds))
        guesses, rights = (b.double().cpu().numpy() for b in (self.boxes(parts, kinds), right))
        fill_box_ious(np.ascontiguousarray(guesses), np.ascontiguousarray(rights), iou)
        return torch.from_numpy(iou).to(right)

    def _priors(self, like: Tensor) -> Tensor:
        return torch.tensor([self.card.box_size_priors[name] for name in self.classes[1:]]).to(like)


def _huber(found: Tensor, right: Tensor, scale: Tensor | float, beta: float) -> Tensor:
    """Sum over the last axis of the smooth L1 loss of errors in units of a scale."""
    return smooth_l1_loss(found / scale, right / scale, reduction="none", beta=beta).sum(1)


@njit(cache=True, nogil=True)
def fill_box_ious(a: Floats, b: Floats, iou: Floats) -> None:
    """Write the overlap in space of each box of ``a`` (n, 7: x, y, bottom, sizes, yaw) with that of ``b``."""
    first, second = np.empty(5), np.empty(5)
    for i in range(len(a)):
        for box, flat in ((a, first), (b, second)):
            flat[0], flat[1], flat[2], flat[3], flat[4] = box[i, 0], box[i, 1], box[i, 3], box[i, 4], box[i, 6]
        areas = a[i, 3] * a[i, 4], b[i, 3] * b[i, 4]
        above = pair_iou(first, second)
        tall = min(a[i, 2] + a[i, 5], b[i, 2] + b[i, 5]) - max(a[i, 2], b[i, 2])
        shared = above * (areas[0] + areas[1]) / (1.0 + above) * max(tall, 0.0)
        iou[i] = shared / (areas[0] * a[i, 5] + areas[1] * b[i, 5] - shared)
