"""PointPillars' dense part: backbone and SSD head on the image of pillars (Lang et al., 2019), to be measured against.

It is never trained here. The pillars are those of the paper's network for cars, 0.16 m, in a range of 69.12 by 79.36 m
in place of 70.4 by 80 m, so that the image can be halved three times.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .pointseg import conv_bn_relu

# Layers, channels and the factor of the upsampling of each block (sections 2.2 and 3.1); each halves the resolution.
BLOCKS = ((4, 64, 1), (6, 128, 2), (6, 256, 4))
UPSAMPLED = 128
N_ANCHORS = 2
ANCHOR_VALUES = (1, 7, 2)
"""Of each anchor: class score, box, direction."""


class PointPillars(nn.Module):
    """Scores (B, 2, H/2, W/2), boxes (B, 14, ...) and directions (B, 4, ...) from features of pillars (B, 64, H, W)."""

    def __init__(self) -> None:
        super().__init__()
        self.blocks, self.ups, c_in = nn.ModuleList(), nn.ModuleList(), 64
        for n_layers, c_out, up in BLOCKS:
            layers: list[nn.Module] = []
            for k in range(n_layers):
                layers += conv_bn_relu(c_out if k else c_in, c_out, 3, stride=(1, 1) if k else (2, 2))
            larger = nn.ConvTranspose2d(c_out, UPSAMPLED, up, stride=up, bias=False)
            self.blocks.append(nn.Sequential(*layers))
            self.ups.append(nn.Sequential(larger, nn.BatchNorm2d(UPSAMPLED), nn.ReLU()))
            c_in = c_out
        self.heads = nn.ModuleList(nn.Conv2d(len(BLOCKS) * UPSAMPLED, N_ANCHORS * n, 1) for n in ANCHOR_VALUES)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        seen = []
        for block, up in zip(self.blocks, self.ups, strict=True):
            x = block(x)
            seen.append(up(x))
        x = torch.cat(seen, dim=1)  # (B, 384, 248, 216)
        return tuple(head(x) for head in self.heads)
