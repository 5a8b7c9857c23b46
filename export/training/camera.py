"""The task of a camera's networks: a class for every pixel of an image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from edgeperc.types.views import CameraGeometry

from ..cards import Carded
from .losses import cross_entropy, lovasz_softmax

ImageOutputs: TypeAlias = "Tensor | tuple[Tensor, ...]"
"""Logits (B, C, h, w), or in training a tuple of these and of early logits, at any resolutions."""

CLASS_SHARES = (0.169, 0.233, 0.010, 0.317, 0.045, 0.097, 0.012, 0.011, 0.059, 0.006, 0.003)
"""Shares of CamVid's classes among the pixels of the training images."""
# Rows and columns of which one is compared, from a random first one: of logits coarser than the labels, whose
# neighbors are alike, in the cross-entropy, and of all logits in the Lovasz-softmax loss, which sorts them. With all
# pixels, the losses would take longer than a small network.
COARSE_STRIDE, LOVASZ_STRIDE, EARLY_STRIDE = 2, 4, 4


@dataclass(frozen=True)
class Camera(Carded[CameraGeometry]):
    """A class for every pixel of an image."""

    def loss(self, outputs: ImageOutputs, targets: tuple[Tensor, ...] | list[Tensor]) -> Tensor:
        """Cross-entropy and, by the recipe, `lovasz_softmax`, of logits interpolated to the labels (every second row
        and column if they are coarser); and cross-entropy of early logits at a quarter of the resolution.
        """
        recipe, (labels,) = self.recipe, targets
        weights = on_device(class_weights(), labels.device) if recipe.class_weights else None
        logits, *early = [outputs] if isinstance(outputs, Tensor) else outputs
        coarse = logits.shape[2:] != labels.shape[1:]
        logits = upsampled(logits, labels.shape[1:])
        few: Any = _every(COARSE_STRIDE) if coarse else ...
        loss = cross_entropy(logits[few], labels[few], weights)
        if recipe.lovasz_weight > 0.0:
            few = _every(LOVASZ_STRIDE)
            loss = loss + recipe.lovasz_weight * lovasz_softmax(logits[few], labels[few])
        few = (..., slice(EARLY_STRIDE // 2, None, EARLY_STRIDE), slice(EARLY_STRIDE // 2, None, EARLY_STRIDE))
        for one in early:
            one = upsampled(one, labels[few].shape[1:])
            loss = loss + recipe.deep_supervision * cross_entropy(one, labels[few], weights)
        return loss


def _every(stride: int) -> tuple[Any, ...]:
    """An index that takes one row and column in ``stride`` of the last two axes, from a random first one."""
    row, col = torch.randint(stride, (2,)).tolist()
    return (..., slice(row, None, stride), slice(col, None, stride))


def class_weights() -> tuple[float, ...]:
    """Weights of the classes in the cross-entropy: 1 / log(1.1 + share) (Paszke et al., 2016, with 1.02), mean 1."""
    weights = [1.0 / math.log(1.1 + share) for share in CLASS_SHARES]
    return tuple(weight * len(weights) / sum(weights) for weight in weights)


@cache
def on_device(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Constants on a device; kept, because copying them there waits for it."""
    return torch.tensor(values, device=device)


def upsampled(logits: Tensor, size: torch.Size | tuple[int, ...]) -> Tensor:
    """Logits (B, C, h, w) interpolated bilinearly to rows and columns, as at run time; float32."""
    logits = logits.float()
    if logits.shape[2:] == torch.Size(size):
        return logits
    return F.interpolate(logits, (size[0], size[1]), mode="bilinear", align_corners=False)
