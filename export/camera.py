"""The task of a camera's networks: a class for every pixel of an image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from edgeperc.card import CameraGeometry, InputSpec, ModelCard

from .cards import card_of
from .losses import cross_entropy, lovasz_softmax
from .recipe import Recipe

__all__ = ["CLASS_SHARES", "Camera", "ImageOutputs", "class_weights", "upsampled"]

ImageOutputs: TypeAlias = "Tensor | tuple[Tensor, ...]"
"""Logits (B, C, h, w), or in training a tuple of these and of early logits, at any resolutions."""

CLASS_SHARES = (0.169, 0.233, 0.010, 0.317, 0.045, 0.097, 0.012, 0.011, 0.059, 0.006, 0.003)
"""Shares of CamVid's classes among the pixels of the training images."""
# Of the Lovasz-softmax loss: every fourth row and column, from a random first one. Sorting all pixels of all classes
# would take longer than the network.
LOVASZ_STRIDE = 4


@dataclass(frozen=True)
class Camera:
    """A class for every pixel of an image.

    Attributes
    ----------
    recipe : Recipe
    card : ModelCard
        View, input, classes and outputs, as the exported model has them.
    """

    recipe: Recipe
    card: ModelCard

    @classmethod
    def of(cls, recipe: Recipe) -> Camera:
        """The task of a recipe."""
        return cls(recipe, card_of(recipe, version="0"))

    @property
    def view(self) -> CameraGeometry:
        """The size of the network's input."""
        assert isinstance(self.card.view, CameraGeometry)
        return self.card.view

    @property
    def input(self) -> InputSpec:
        """The channels of the network's input."""
        return self.card.input

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes of the network's pixels."""
        return self.card.classes

    def loss(self, outputs: ImageOutputs, targets: tuple[Tensor, ...] | list[Tensor]) -> Tensor:
        """Cross-entropy (categorical, as in the comparison) and, by the recipe, `lovasz_softmax` and early logits.

        Logits are interpolated to the labels (B, H, W). Early logits count with cross-entropy alone.
        """
        recipe, (labels,) = self.recipe, targets
        weights = _weights(labels.device) if recipe.class_weights else None
        logits, *early = [outputs] if isinstance(outputs, Tensor) else outputs
        size = labels.shape[1:]
        logits = upsampled(logits, size)
        loss = cross_entropy(logits, labels, weights)
        if recipe.lovasz_weight > 0.0:
            row, col = torch.randint(LOVASZ_STRIDE, (2,)).tolist()
            few = (..., slice(row, None, LOVASZ_STRIDE), slice(col, None, LOVASZ_STRIDE))
            loss = loss + recipe.lovasz_weight * lovasz_softmax(logits[few], labels[few])
        for one in early:
            loss = loss + recipe.deep_supervision * cross_entropy(upsampled(one, size), labels, weights)
        return loss


def class_weights() -> tuple[float, ...]:
    """Weights of the classes in the cross-entropy: 1 / log(1.1 + share) (Paszke et al., 2016, with 1.02), mean 1."""
    weights = [1.0 / math.log(1.1 + share) for share in CLASS_SHARES]
    return tuple(weight * len(weights) / sum(weights) for weight in weights)


@cache
def _weights(device: torch.device) -> Tensor:
    """`class_weights` on a device; kept, because copying them there waits for it."""
    return torch.tensor(class_weights(), device=device)


def upsampled(logits: Tensor, size: torch.Size | tuple[int, ...]) -> Tensor:
    """Logits (B, C, h, w) interpolated bilinearly to rows and columns, as at run time; float32."""
    logits = logits.float()
    if logits.shape[2:] == torch.Size(size):
        return logits
    return F.interpolate(logits, (size[0], size[1]), mode="bilinear", align_corners=False)
