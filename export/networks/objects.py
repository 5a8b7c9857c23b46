"""The object network: class and box of a candidate from its points, after PointNet (Qi et al., 2017)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import relu

from edgeperc.objects.crops import N_POINT_FEATURES

LOOK_STRIDE = 4
# With 0.15 in place of 0.4, 1.7 times as many candidates get a close look, and AP on the folds is the same.
LEAST = math.log(0.4 / 0.6)
"""Logit of the least probability for a close look."""
SURE = 12.0
LOOK, CLOSE = "look_", "close_"  # before the names of the first look's and the other tensors of an exported network


class Parts(NamedTuple):
    """Outputs of the network by their meaning; c: classes of objects, without the background."""

    classes: Tensor  # (B, 1 + c) logits, the background first
    place: Tensor  # (B, 3) x, y of the middle in the candidate's frame, and of the bottom above the ground [m]
    sizes: Tensor  # (B, c, 3) of each class: logarithm of length, width and height, each divided by the usual one
    axis: Tensor  # (B, 2) cosine and sine of twice the yaw in the candidate's frame
    # (B, 2) vector in the candidate's frame; its component along a heading is the logit that the front is there
    front: Tensor
    iou: Tensor  # (B,) logit of the overlap in space with the object


def parts_of(outputs: Tensor, n_classes: int) -> Parts:
    """Outputs (B, n) by their meaning; ``n_classes`` with the background."""
    c = n_classes - 1
    classes, place, sizes, axis, front, iou = torch.split(outputs, [n_classes, 3, 3 * c, 2, 2, 1], dim=1)
    return Parts(classes, place, sizes.reshape(-1, c, 3), axis, front, iou[:, 0])


def _by_candidate(flat: Tensor, like: Tensor) -> Tensor:
    """Values of points (B * n_points, n) as (B, n_points, n)."""
    return flat.reshape(like.shape[0], like.shape[1], flat.shape[1])


class FirstLook(nn.Module):
    """Whether a candidate may be an object, from a quarter of its points: the logit, (B,)."""

    def __init__(self, n_channels: int) -> None:
        super().__init__()
        self.point1, self.point2 = nn.Linear(n_channels, 24), nn.Linear(24, 48)
        self.head1, self.head2 = nn.Linear(48 + n_channels - N_POINT_FEATURES, 32), nn.Linear(32, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Points of candidates (B, n_points, n_channels) to logits (B,)."""
        few = x[:, ::LOOK_STRIDE]
        points = relu(self.point2(relu(self.point1(few.flatten(0, 1)))))
        hidden = relu(self.head1(torch.cat([_by_candidate(points, few).amax(1), x[:, 0, N_POINT_FEATURES:]], dim=1)))
        return self.head2(hidden)[:, 0]


class ObjectNet(nn.Module):
    """Layers for each point, with the largest value of each channel over the points, and layers for the candidate.

    n_channels : the first `objects.crops.N_POINT_FEATURES` differ from point to point.
    look : the exported network looks at a candidate closely only if this gives it a probability of `LEAST` or more.
    """

    def __init__(self, n_channels: int, n_classes: int, dropout: float = 0.1) -> None:
        super().__init__()
        n_candidate = n_channels - N_POINT_FEATURES
        self.point1, self.point2 = nn.Linear(n_channels, 48), nn.Linear(48, 96)
        self.point3, self.together = nn.Linear(96, 128), nn.Linear(96, 128)
        self.point4, self.norm = nn.Linear(128, 224), nn.LayerNorm(224)
        self.head1, self.head2 = nn.Linear(224 + n_candidate, 192), nn.Linear(192, 192)
        self.dropout = nn.Dropout(dropout)
        self.head3 = nn.Linear(192, n_classes + 3 + 3 * (n_classes - 1) + 2 + 2 + 1)
        self.look = FirstLook(n_channels)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Points of candidates (B, n_points, n_channels) to outputs (B, n), for `parts_of`, and logits of `look`."""
        return self.closely(x), self.look(x)

    def closely(self, x: Tensor) -> Tensor:
        """Outputs (B, n) of all candidates."""
        device = x.device.type
        candidate = x[:, 0, N_POINT_FEATURES:]
        flat = x.flatten(0, 1)  # engines compute matrix products of two axes with their offsets at once
        with torch.autocast(device, enabled=False):  # bfloat16 holds centimeters up to 2 m only
            first = relu(self.point1(flat))
        second = relu(self.point2(first))
        around = self.together(_by_candidate(second, x).amax(1))
        third = relu(_by_candidate(self.point3(second), x) + around[:, None])
        pooled = _by_candidate(self.point4(third.flatten(0, 1)), x).amax(1)
        with torch.autocast(device, enabled=False):
            pooled = relu(self.norm(pooled.float()))
            hidden = self.dropout(relu(self.head1(torch.cat([pooled, candidate], dim=1))))
            return self.head3(relu(self.head2(hidden)))

    def detect(self, x: Tensor) -> Tensor:
        """Outputs (B, n) as the exported network gives them: `rejected` where the first look sees no object."""
        outputs, look = self(x)
        return torch.where((look >= LEAST)[:, None], outputs, rejected(outputs.shape[1]))


def rejected(n: int) -> Tensor:
    """Outputs (n,) of a candidate that is not looked at closely: background without any overlap."""
    outputs = torch.zeros(n)
    outputs[0], outputs[-1] = SURE, -SURE
    return outputs
