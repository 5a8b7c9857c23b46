"""camseg: a class for every pixel of a camera's image, on the processor of a small computer.

It follows this package's networks for small computers (`edge`): the stem quarters the resolution at once, most of the
arithmetic is at an eighth and a sixteenth of it, and the decoder goes back to a quarter. Convolutions are plain 3 x 3
and 1 x 1 with multiples of 16 channels, followed by batch norm, which is folded on export, and ReLU; engines have int8
kernels for all of them. Residual blocks squeeze their channels (He et al., 2016, section 4.1) and dilate the 3 x 3,
so that the last ones see the whole image; the image's mean is added as in `pointseg.Enlargement`. In training, early
logits from the encoder are supervised too, as in BiSeNet V2 (Yu et al., 2021, section 5.1); they are dropped on export.

All weights start from random values: weights trained on other data sets have other licenses.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from .pointseg import conv_bn_relu, initialize

# Half of the channels, too, is a multiple of 16: for dilated convolutions of 72 channels, torch 2.13 on a CPU computes
# wrong gradients of the weights in bf16 (relative error 0.47, or not finite); with 48, 64, 80 or 96 they are right.
FINE, MIDDLE, COARSE = 64, 128, 128
"""Channels at a quarter, an eighth and a sixteenth of the resolution."""
# Dilations of the residual blocks at each of these resolutions. With 0.90 million parameters, half-precision weights
# take less than 2 MB; the arithmetic that remains below 3 GMAC is spent where it needs few parameters.
FINE_DILATIONS = (1, 1)
MIDDLE_DILATIONS = (1, 2, 1, 2)
COARSE_DILATIONS = (1, 2, 4, 1, 4)


class Bottleneck(nn.Module):
    """Squeeze to half of the channels, convolve 3 x 3, expand, and add to a shortcut."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        half = channels // 2
        self.squeeze = conv_bn_relu(channels, half, 1)
        self.convolve = conv_bn_relu(half, half, 3, dilation=dilation)
        self.expand = nn.Conv2d(half, channels, 1, bias=False)
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.norm(self.expand(self.convolve(self.squeeze(x)))))


class CamSeg(nn.Module):
    """Labels an image (B, n_channels, H, W), H and W divisible by 4, at a quarter of its resolution: logits.

    dropout : of a channel before the last convolution.
    deep_supervision : in training, also return early logits from the encoder, at 1/8 and 1/16 of the resolution.
    """

    def __init__(
        self, *, n_channels: int = 3, n_classes: int = 11, dropout: float = 0.1, deep_supervision: bool = False
    ) -> None:
        super().__init__()
        half = FINE // 2
        self.stem = conv_bn_relu(n_channels, half, 3, stride=(2, 2))
        self.down1 = conv_bn_relu(half, FINE, 3, stride=(2, 2))
        self.fine = nn.Sequential(*(Bottleneck(FINE, dilation) for dilation in FINE_DILATIONS))
        self.down2 = conv_bn_relu(FINE, MIDDLE, 3, stride=(2, 2))
        self.middle = nn.Sequential(*(Bottleneck(MIDDLE, dilation) for dilation in MIDDLE_DILATIONS))
        self.down3 = conv_bn_relu(MIDDLE, COARSE, 3, stride=(2, 2))
        self.coarse = nn.Sequential(*(Bottleneck(COARSE, dilation) for dilation in COARSE_DILATIONS))
        # No batch norm: the mean is one pixel for each image, and the statistics of so few pixels are noise.
        self.average = nn.Sequential(nn.Conv2d(COARSE, COARSE, 1), nn.ReLU())
        self.up1 = nn.Conv2d(COARSE, MIDDLE, 1)
        self.merge1 = conv_bn_relu(MIDDLE, FINE, 3)
        self.merge2 = conv_bn_relu(FINE, FINE, 3)
        self.dropout = nn.Dropout2d(dropout)
        self.classifier = nn.Conv2d(FINE, n_classes, 1)
        self.early = nn.ModuleList(nn.Conv2d(c, n_classes, 1) for c in (MIDDLE, COARSE) if deep_supervision)
        initialize(self, self.classifier, *self.early)
        for module in self.modules():
            if isinstance(module, Bottleneck):
                nn.init.zeros_(module.norm.weight)  # an untrained block is the identity

    def forward(self, x: Tensor) -> Tensor | tuple[Tensor, Tensor, Tensor]:
        fine = self.fine(self.down1(self.stem(x)))
        middle = self.middle(self.down2(fine))
        coarse = self.coarse(self.down3(middle))
        coarse = coarse + self.average(coarse.mean((2, 3), keepdim=True))
        merged = self.merge1(F.relu(_resized(self.up1(coarse), middle) + middle))
        logits: Tensor = self.classifier(self.dropout(self.merge2(_resized(merged, fine) + fine)))
        if not self.early or not self.training:
            return logits
        return logits, self.early[0](middle), self.early[1](coarse)


def _resized(x: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(x, size=like.shape[2:], mode="bilinear", align_corners=False)
