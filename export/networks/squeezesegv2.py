"""SqueezeSegV2: segmentation of a range image (Wu et al., 2018), and KUL-Seg, which extends it.

It has SqueezeSeg's fire layers and three of the paper's four additions: context aggregation, the mask of returns, and
batch norm. The fourth is the focal loss (`edgeperc_export.training.losses.cross_entropy`).

What differs from the paper, and why:

* The network computes the mask itself: a pixel has a return if any channel is not 0. So the input remains x, y, z,
  remission and range.
* Batch norm comes before the ReLU instead of after it, so that it can be folded into the convolution on export.
* SqueezeSeg's recurrent CRF is left out. KUL-Seg's section 4 does not mention one. With it, cars gain 3.7 points of
  IoU, and pedestrians and cyclists lose 1.0 and 1.3 (PointSeg's Table 1). The runtime corrects labels itself, by a vote
  of neighbors and RANSAC (`edgeperc.objects.refine`).
* The widths of the fire layers are those of the authors' released network.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .pointseg import Fire, FireDeconv, conv_bn_relu, initialize, pool

REACH = 7
"""Rows and columns of the max-pooling window of context aggregation."""


class ContextAggregation(nn.Module):
    """Scale each channel of each pixel by its surroundings, which reduces the effect of missing returns: the maximum of
    7x7 pixels is squeezed to a sixteenth of the channels and expanded again; its sigmoid is the scale.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, channels // 16, 1)
        self.expand = nn.Conv2d(channels // 16, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        # Rows, then columns: the same maxima from 14 instead of 49 values.
        around = F.max_pool2d(x, (1, REACH), stride=1, padding=(0, REACH // 2))
        around = F.max_pool2d(around, (REACH, 1), stride=1, padding=(REACH // 2, 0))
        return x * torch.sigmoid(self.expand(F.relu(self.squeeze(around))))


class SqueezeSegV2(nn.Module):
    """Labels every pixel of a range image of any height, and any width divisible by 16. Pixels without a return are 0
    in every channel. ``dropout`` is of a channel before the last convolution.
    """

    def __init__(self, *, n_channels: int = 5, n_classes: int = 4, dropout: float = 0.25) -> None:
        super().__init__()
        self.fire1 = conv_bn_relu(n_channels + 1, 64, 3, stride=(1, 2))
        self.skip1 = conv_bn_relu(n_channels + 1, 64, 1)
        self.context1, self.context2, self.context3 = (ContextAggregation(c) for c in (64, 128, 128))
        self.fire2, self.fire3 = Fire(64, 128, 16), Fire(128, 128, 16)
        self.fire4, self.fire5 = Fire(128, 256, 32), Fire(256, 256, 32)
        self.fire6, self.fire7 = Fire(256, 384, 48), Fire(384, 384, 48)
        self.fire7b: nn.Module = nn.Identity()
        self.fire8, self.fire9 = Fire(384, 512, 64), Fire(512, 512, 64)
        self.deconv10, self.deconv11 = FireDeconv(512, 256, 64), FireDeconv(256, 128, 32)
        self.deconv12, self.deconv13 = FireDeconv(128, 64, 16), FireDeconv(64, 64, 16)
        self.dropout = nn.Dropout2d(dropout)
        self.classifier = nn.Conv2d(64, n_classes, 3, padding=1)
        initialize(self, self.classifier)

    def forward(self, x: Tensor) -> Tensor:
        returned = (x.abs().amax(1, keepdim=True) > 0.0).to(x.dtype)  # (B, 1, 64, 512)
        x = torch.cat([x, returned], dim=1)
        skip1 = self.skip1(x)  # (B, 64, 64, 512)
        near = self.context1(self.fire1(x))  # (B, 64, 64, 256)
        half = self.context3(self.fire3(self.context2(self.fire2(pool(near)))))  # (B, 128, 64, 128)
        quarter = self.fire5(self.fire4(pool(half)))  # (B, 256, 64, 64)
        x = self.fire7b(self.fire7(self.fire6(pool(quarter))))  # (B, 384, 64, 32)
        x = self.fire9(self.fire8(x))  # (B, 512, 64, 32)

        x = self.deconv10(x) + quarter  # (B, 256, 64, 64)
        x = self.deconv11(x) + half  # (B, 128, 64, 128)
        x = self.deconv12(x) + near  # (B, 64, 64, 256)
        x = self.deconv13(x) + skip1  # (B, 64, 64, 512)
        return self.classifier(self.dropout(x))  # (B, 4, 64, 512)


class KULSeg(SqueezeSegV2):
    """SqueezeSegV2 with a Fire 7_b between Fire 7 and Fire 8 (Kim et al., 2024, section 4): the variant "single 7b
    (same)" of its Table 3, one more fire layer with as many filters as Fire 7.
    """

    def __init__(self, *, n_channels: int = 5, n_classes: int = 4, dropout: float = 0.25) -> None:
        super().__init__(n_channels=n_channels, n_classes=n_classes, dropout=dropout)
        self.fire7b = Fire(384, 384, 48)
        initialize(self.fire7b)
