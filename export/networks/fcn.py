"""FCN-16s and FCN-8s on VGG-16 (Long et al., 2015, section 4).

What the comparison on CamVid (Jebamikyous, 2021, section 3.1.2) leaves open, and the choices made here:

* VGG-16's fully connected layers are convolutions: 7 x 7 to 4096 channels, and 1 x 1. The 7 x 7 is padded by 3, which
  keeps the maps aligned; the authors pad the image by 100 pixels and crop.
* Upsampling layers are transposed convolutions that start as bilinear interpolation and are learned. Those of the
  fusions double the resolution; the last one, by 16 or 8, is fixed (section 4.3 and the authors' networks).
* Poolings of odd sizes round up, and what was upsampled is cropped to the size of what it is added to.
* The authors start from VGG-16 trained on ImageNet. These weights start from He's initialization, and there is no
  batch norm, which VGG-16 does not have.
* The variants with dropout have it where VGG-16 has it: after each of the two fully connected layers. Those without
  have none.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .pointseg import initialize
from .segnet import VGG_16

FULLY_CONNECTED = 4096
SKIPS = {16: (3,), 8: (3, 2)}
"""Stride of the last upsampling -> the poolings, counted from 0, whose scores are added, deepest first."""


def bilinear(n_channels: int, factor: int) -> Tensor:
    """Weights (n_channels, n_channels, 2 x factor, 2 x factor) of a transposed convolution that interpolates."""
    offsets = (torch.arange(2 * factor) + 0.5) / factor - 1.0
    ramp = 1.0 - offsets.abs()
    return torch.eye(n_channels)[:, :, None, None] * torch.outer(ramp, ramp)


class FCN(nn.Module):
    """Labels every pixel of an image of any size.

    stride : of the last upsampling: FCN-16s adds the scores of the fourth pooling, FCN-8s also those of the third.
    dropout : of a value after each fully connected layer.
    """

    def __init__(self, *, n_channels: int = 3, n_classes: int = 11, stride: int = 8, dropout: float = 0.0) -> None:
        super().__init__()
        self.stride = stride
        self.blocks = nn.ModuleList()
        c_in = n_channels
        for widths in VGG_16:
            pairs = zip([c_in, *widths], widths, strict=False)
            self.blocks.append(
                nn.Sequential(*(layer for a, b in pairs for layer in (nn.Conv2d(a, b, 3, padding=1), nn.ReLU())))
            )
            c_in = widths[-1]
        layers: list[nn.Module] = []
        for c, kernel in ((c_in, 7), (FULLY_CONNECTED, 1)):
            layers += [nn.Conv2d(c, FULLY_CONNECTED, kernel, padding=kernel // 2), nn.ReLU(), nn.Dropout(dropout)]
        self.fully_connected = nn.Sequential(*layers)
        self.score = nn.Conv2d(FULLY_CONNECTED, n_classes, 1)
        self.score_skips = nn.ModuleList(nn.Conv2d(VGG_16[k][-1], n_classes, 1) for k in SKIPS[stride])
        self.upsamplings = nn.ModuleList(
            nn.ConvTranspose2d(n_classes, n_classes, 4, stride=2, padding=1, bias=False) for _ in SKIPS[stride]
        )
        initialize(self, self.score, *self.score_skips)
        for layer in self.upsamplings:
            layer.weight.data.copy_(bilinear(n_classes, 2))  # type: ignore[operator]  # a module's attribute
        self.last: Tensor
        self.register_buffer("last", bilinear(n_classes, stride), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        pooled: list[Tensor] = []
        for block in self.blocks:
            x = F.max_pool2d(block(x), 2, ceil_mode=True)
            pooled.append(x)
        x = self.score(self.fully_connected(x))
        for k, score, upsampling in zip(SKIPS[self.stride], self.score_skips, self.upsamplings, strict=True):
            skip = score(pooled[k])
            x = upsampling(x)[..., : skip.shape[2], : skip.shape[3]] + skip
        x = F.conv_transpose2d(x, self.last, stride=self.stride, padding=self.stride // 2)
        return x[..., :height, :width]
