"""U-Net (Ronneberger et al., 2015) in the variants of a comparison on CamVid (Jebamikyous, 2021, section 3).

The comparison names five variants. What it leaves open, and the choices made here:

* The original network has 23 convolutional layers and no batch norm. Convolutions are padded here ("same"), because
  input and labels of the comparison have the same size; nothing is then cropped. Images whose sides are not divisible
  by the deepest level's stride are padded with zeros at the right and at the bottom, and the logits are cropped.
* "Up-sampling and a 2 x 2 convolution" is the authors' up-convolution, a transposed 2 x 2 convolution of stride 2.
* The small U-Net has a quarter of the channels at every level: 16 to 256 instead of 64 to 1024.
* "Two layers on the contracting path and two on the expansive path" of the long U-Net are two levels of resolution,
  each with the two 3 x 3 convolutions of the others: the comparison explains its accuracy by its depth, and its images
  of 512 x 512 allow six poolings. Channels stay at 1024 in the added levels. Doubled further, to 4096, the network
  would have half a billion parameters.
* The slope of LeakyReLU is 0.01 (Maas et al., 2013).
* Dropout is at the end of the contracting path (Ronneberger et al., section 3.1), which in the authors' network means
  after the convolutions of the two deepest levels.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .pointseg import initialize

WIDEST = 16
"""Channels of the deepest levels, as a multiple of the first level's."""


class UNet(nn.Module):
    """Labels every pixel of an image of any size.

    width : channels of the first level; each level has twice as many as the one above, at most `WIDEST` times
        ``width``.
    n_levels : levels of resolution: 5 in the original, 7 in the long U-Net.
    dropout : of a value at the end of the two deepest levels of the contracting path.
    """

    def __init__(
        self,
        *,
        n_channels: int = 3,
        n_classes: int = 11,
        width: int = 64,
        n_levels: int = 5,
        leaky: bool = False,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        widths = [width * min(2**level, WIDEST) for level in range(n_levels)]

        def two(c_in: int, c_out: int) -> nn.Sequential:
            layers: list[nn.Module] = []
            for c in (c_in, c_out):
                layers += [nn.Conv2d(c, c_out, 3, padding=1), nn.LeakyReLU(0.01) if leaky else nn.ReLU()]
            return nn.Sequential(*layers)

        self.down = nn.ModuleList(two(a, b) for a, b in zip([n_channels, *widths], widths, strict=False))
        deeper = list(zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.up = nn.ModuleList(nn.ConvTranspose2d(a, b, 2, stride=2) for a, b in deeper)
        self.merge = nn.ModuleList(two(2 * b, b) for _, b in deeper)
        self.dropout = nn.Dropout(dropout)
        self.classifier = nn.Conv2d(width, n_classes, 1)
        initialize(self, self.classifier)

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        stride = 2 ** len(self.up)
        x = F.pad(x, (0, -width % stride, 0, -height % stride))
        levels: list[Tensor] = []
        for level, convolutions in enumerate(self.down):
            x = convolutions(F.max_pool2d(x, 2) if levels else x)
            if level >= len(self.down) - 2:
                x = self.dropout(x)
            levels.append(x)
        for up, merge, finer in zip(self.up, self.merge, levels[-2::-1], strict=True):
            x = merge(torch.cat([finer, up(x)], dim=1))
        return self.classifier(x)[..., :height, :width]
