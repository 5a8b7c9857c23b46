"""SSADNet and PointSeg for small computers: the same inputs and outputs, with a seventh of the arithmetic.

They keep the papers' views, classes and boxes, and avoid what is slow on small computers: many channels at full
resolution, unpooling by position, and dilations wider than the map. Instead, the encoder halves the resolution twice,
residual blocks form the context, and the decoder moves channels to pixels. Numbers of channels are multiples of 16, the
width of a vector register: 24 channels took as long as 32. Batch norm is folded into its convolution on export, and
ReLU by the engine.
"""

from __future__ import annotations

import math

import torch.nn.functional as F
from torch import Tensor, nn

from edgeperc.card import N_DENSE_CHANNELS, N_FRONT_CHANNELS

from .pointseg import conv_bn_relu, initialize
from .ssadnet import HEAT_PRIOR

__all__ = ["PointSegEdge", "SSADNetEdge", "spread"]

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
    """Encoder, context and decoder: down to an eighth of the input's columns, and back to its resolution.

    Parameters
    ----------
    n_channels, n_classes : int
        Channels of the input; classes of the output.
    stride : (int, int)
        Stride of the stem, (rows, columns).
    fine, middle, coarse : int
        Channels at the stem's resolution, at half and at a quarter of it.
    """

    def __init__(
        self, n_channels: int, n_classes: int, stride: tuple[int, int], fine: int, middle: int, coarse: int
    ) -> None:
        super().__init__()
        self.stride = stride
        self.stem = conv_bn_relu(n_channels, fine, 3, stride=stride)
        self.down1 = nn.Sequential(conv_bn_relu(fine, middle, 3, stride=(2, 2)), conv_bn_relu(middle, middle, 3))
        self.down2 = conv_bn_relu(middle, coarse, 3, stride=(2, 2))
        self.context = nn.Sequential(*(Residual(coarse, dilation) for dilation in CONTEXT_DILATIONS))
        self.up1 = nn.Conv2d(coarse, middle, 1)
        self.merge1 = conv_bn_relu(middle, middle, 3)
        self.up2 = nn.Conv2d(middle, 4 * fine, 1)
        self.merge2 = conv_bn_relu(fine, fine, 3)
        self.classifier = nn.Conv2d(fine, n_classes * stride[0] * stride[1], 1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B, n_classes, H, W) and the features at half the stem's resolution."""
        fine = self.stem(x)
        middle = self.down1(fine)
        coarse = self.context(self.down2(middle))
        up = F.interpolate(self.up1(coarse), size=middle.shape[-2:], mode="nearest")
        middle = self.merge1(F.relu(up + middle))
        fine = self.merge2(F.relu(spread(self.up2(middle), (2, 2)) + fine))
        return spread(self.classifier(fine), self.stride), middle


def _channels(width: float) -> tuple[int, int, int]:
    """Channels at the stem's resolution, at half and at a quarter of it: multiples of 16."""
    fine, middle, coarse = (16 * max(1, round(channels * width / 16)) for channels in (16, 64, 112))
    return fine, middle, coarse


def spread(x: Tensor, block: tuple[int, int]) -> Tensor:
    """Move channels to pixels: (B, C x rows x columns, H, W) to (B, C, H x rows, W x columns)."""
    rows, cols = block
    if rows == cols:
        return F.pixel_shuffle(x, rows)
    batch, channels, height, width = x.shape
    x = x.reshape(batch, channels // (rows * cols), rows, cols, height, width).permute(0, 1, 4, 2, 5, 3)
    return x.reshape(batch, channels // (rows * cols), height * rows, width * cols)


class PointSegEdge(nn.Module):
    """Labels every pixel of a range image, like `PointSeg`, with 0.9 instead of 7.2 GMAC.

    Parameters
    ----------
    n_channels, n_classes : int
        Channels of the input; classes of the output.
    width : float
        Factor of the numbers of channels in between.

    Notes
    -----
    In: (B, n_channels, 64, 512) float32; any height divisible by 4 and width divisible by 8.
    Out: logits (B, 4, 64, 512) float32.
    """

    def __init__(self, *, n_channels: int = 5, n_classes: int = 4, width: float = 1.0) -> None:
        super().__init__()
        self.trunk = Trunk(n_channels, n_classes, (1, 2), *_channels(width))
        initialize(self, self.trunk.classifier)

    def forward(self, x: Tensor) -> Tensor:
        logits: Tensor = self.trunk(x)[0]
        return logits


class SSADNetEdge(nn.Module):
    """Labels every cell of a top view and detects the vehicles, like `SSADNet` with head "dense".

    It takes 1.5 instead of 8.9 GMAC.

    Parameters
    ----------
    n_channels, n_classes : int
        Channels of the input; classes of the segmentation map.
    front : bool
        Also predict which end of a vehicle is its front.
    width : float
        Factor of the numbers of channels in between.

    Notes
    -----
    In: (B, 3, 400, 200) float32; any height and width divisible by 8.
    Out: segmentation logits (B, 5, 400, 200) and boxes (B, 9 or 11, 100, 50), in the format of `DenseHead`, float32.
    """

    def __init__(self, *, n_channels: int = 3, n_classes: int = 5, front: bool = False, width: float = 1.0) -> None:
        super().__init__()
        fine, middle, coarse = _channels(width)
        self.trunk = Trunk(n_channels, n_classes, (2, 2), fine, middle, coarse)
        self.detection = nn.Sequential(conv_bn_relu(middle, middle, 3), conv_bn_relu(middle, middle, 3))
        self.predict = nn.Conv2d(middle, N_DENSE_CHANNELS + N_FRONT_CHANNELS * front, 1)
        initialize(self, self.trunk.classifier, self.predict)
        assert self.predict.bias is not None
        self.predict.bias.data[0] = -math.log(1.0 / HEAT_PRIOR - 1.0)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        logits, features = self.trunk(x)
        return logits, self.predict(self.detection(features))
