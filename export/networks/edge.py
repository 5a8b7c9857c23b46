"""SSADNet and PointSeg for small computers: the same inputs and outputs, with a seventh of the arithmetic.

They keep the papers' views, classes and boxes, and avoid what is slow on small computers: many channels at full
resolution, unpooling by position, and dilations wider than the map. The first convolution makes the features of a block
of pixels, residual blocks at half that resolution form the context, and the last convolution labels all pixels of a
block at once. So no layer moves pixels: with features at half resolution, moving them between channels and pixels took
a third of the time in int8. Numbers of channels are multiples of 16, the width of a vector register: 24 channels took
as long as 32. Batch norm is folded into its convolution on export, and ReLU by the engine.
"""

from __future__ import annotations

import math

import torch.nn.functional as F
from torch import Tensor, nn

from edgeperc.types.card import N_DENSE_CHANNELS, N_FRONT_CHANNELS

from ..recipe import EDGE_BLOCKS
from .pointseg import conv_bn_relu, initialize
from .ssadnet import HEAT_PRIOR

CONTEXT_DILATIONS = ((1, 2), (2, 4))
"""Dilations (rows, columns) of the residual blocks; range images are wide."""


class Residual(nn.Module):
    """Two 3x3 convolutions, the second dilated, added to a shortcut."""

    def __init__(self, channels: int, dilation: tuple[int, int]) -> None:
        super().__init__()
        self.first = conv_bn_relu(channels, channels, 3)
        self.second = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation, bias=False)
        self.norm = nn.BatchNorm2d(channels)
        nn.init.zeros_(self.norm.weight)  # an untrained block is the identity

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.norm(self.second(self.first(x))))


class Trunk(nn.Module):
    """Encoder, context and decoder, on blocks of pixels: a convolution with the stride of a block (rows, columns) makes
    its features, ``fine`` channels at their resolution and ``coarse`` ones at half of it.
    """

    def __init__(self, n_channels: int, block: tuple[int, int], fine: int, coarse: int) -> None:
        super().__init__()
        stem = conv_bn_relu(n_channels, fine, (block[0] + 1, block[1] + 1), stride=block)
        self.encoder = nn.Sequential(stem, conv_bn_relu(fine, fine, 3))
        self.down = conv_bn_relu(fine, coarse, 3, stride=(2, 2))
        self.context = nn.Sequential(*(Residual(coarse, dilation) for dilation in CONTEXT_DILATIONS))
        self.up = nn.Conv2d(coarse, fine, 1)
        self.decoder = nn.Sequential(conv_bn_relu(fine, fine, 3), conv_bn_relu(fine, fine, 3))

    def forward(self, x: Tensor) -> Tensor:
        """Features of each block, (B, fine, H / rows, W / columns)."""
        x = self.encoder(x)
        up = F.interpolate(self.up(self.context(self.down(x))), size=x.shape[-2:], mode="nearest")
        return self.decoder(F.relu(up + x))


def _channels(width: float) -> tuple[int, int]:
    """Channels at the resolution of the blocks and at half of it: multiples of 16."""
    fine, coarse = (16 * max(1, round(channels * width / 16)) for channels in (64, 112))
    return fine, coarse


def spread(x: Tensor, block: tuple[int, int]) -> Tensor:
    """Move channels to pixels: (B, C x rows x columns, H, W) to (B, C, H x rows, W x columns)."""
    rows, cols = block
    if rows == cols:
        return F.pixel_shuffle(x, rows)
    batch, channels, height, width = x.shape
    x = x.reshape(batch, channels // (rows * cols), rows, cols, height, width).permute(0, 1, 4, 2, 5, 3)
    return x.reshape(batch, channels // (rows * cols), height * rows, width * cols)


class PointSegEdge(nn.Module):
    """Labels every pixel of a range image, like `PointSeg`, with 1.0 instead of 7.2 GMAC; any height divisible by 4 and
    width divisible by 8. ``width``: factor of the numbers of channels in between.
    """

    block = EDGE_BLOCKS["pointseg"]

    def __init__(self, *, n_channels: int = 5, n_classes: int = 4, width: float = 1.0) -> None:
        super().__init__()
        fine, coarse = _channels(width)
        self.trunk = Trunk(n_channels, self.block, fine, coarse)
        self.classifier = nn.Conv2d(fine, n_classes * self.block[0] * self.block[1], 1)
        initialize(self, self.classifier)

    def blocks(self, x: Tensor) -> Tensor:
        """Logits before `spread`: those of a block's pixels are channels."""
        return self.classifier(self.trunk(x))

    def forward(self, x: Tensor) -> Tensor:
        return spread(self.blocks(x), self.block)


class SSADNetEdge(nn.Module):
    """Labels every cell of a top view and detects the vehicles, like `SSADNet` with head "dense", in the format of
    `DenseHead`, with 1.4 instead of 8.9 GMAC; any height and width divisible by 8.

    front : also predict which end of a vehicle is its front.
    width : factor of the numbers of channels in between.
    """

    block = EDGE_BLOCKS["ssadnet"]

    def __init__(self, *, n_channels: int = 3, n_classes: int = 5, front: bool = False, width: float = 1.0) -> None:
        super().__init__()
        fine, coarse = _channels(width)
        self.trunk = Trunk(n_channels, self.block, fine, coarse)
        self.classifier = nn.Conv2d(fine, n_classes * self.block[0] * self.block[1], 1)
        self.detection = conv_bn_relu(fine, fine, 3)
        self.predict = nn.Conv2d(fine, N_DENSE_CHANNELS + N_FRONT_CHANNELS * front, 1)
        initialize(self, self.classifier, self.predict)
        assert self.predict.bias is not None
        self.predict.bias.data[0] = -math.log(1.0 / HEAT_PRIOR - 1.0)

    def blocks(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Segmentation logits before `spread`: those of a block's cells are channels; and boxes."""
        features = self.trunk(x)
        return self.classifier(features), self.predict(self.detection(features))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        logits, boxes = self.blocks(x)
        return spread(logits, self.block), boxes
