"""SegNet (Badrinarayanan et al., 2017): an encoder as VGG-16's, and a decoder that unpools by the encoder's positions.

What the comparison on CamVid (Jebamikyous, 2021, section 3.1.1) leaves open, and the choices made here:

* 13 + 13 convolutions, each followed by batch norm and ReLU, except for the last one, which makes the logits. The
  decoder mirrors the encoder; its last convolution at each resolution makes the channels of the next.
* Poolings of odd sizes round up, as in the authors' network (360 rows become 23 after four poolings), and unpooling
  restores the size before.
* Dropout is where Bayesian SegNet has it (Kendall et al., 2017): at the end of the three deepest encoders and of the
  three deepest decoders.
* Weights start from He's initialization; the authors start from VGG-16 trained on ImageNet.
"""

from __future__ import annotations

from itertools import pairwise

import torch.nn.functional as F
from torch import Tensor, nn

from .pointseg import conv_bn_relu, initialize

VGG_16 = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Channels of VGG-16's 13 convolutions, by resolution (Simonyan and Zisserman, 2015, configuration D)."""
N_DROPPED = 3


def unpool(x: Tensor, positions: Tensor, size: tuple[int, int]) -> Tensor:
    """Put pooled values back at the positions of `torch.nn.functional.max_pool2d`; all other values are 0."""
    batch, channels = x.shape[:2]
    flat = x.new_zeros((batch, channels, size[0] * size[1]))
    return flat.scatter(2, positions.flatten(2), x.flatten(2)).view(batch, channels, *size)


class SegNet(nn.Module):
    """Labels every pixel of an image of any size; ``dropout`` is of a value."""

    def __init__(self, *, n_channels: int = 3, n_classes: int = 11, dropout: float = 0.0) -> None:
        super().__init__()
        self.encoders, self.decoders = nn.ModuleList(), nn.ModuleList()
        c_in = n_channels
        for widths in VGG_16:
            self.encoders.append(_convolutions([c_in, *widths]))
            c_in = widths[-1]
        for level in reversed(range(len(VGG_16))):
            # The last convolution of all is the classifier.
            finer = [VGG_16[level - 1][-1]] if level else []
            self.decoders.append(_convolutions([*VGG_16[level], *finer]))
        self.dropout = nn.Dropout(dropout)
        self.classifier = nn.Conv2d(VGG_16[0][0], n_classes, 3, padding=1)
        initialize(self, self.classifier)

    def forward(self, x: Tensor) -> Tensor:
        pooled: list[tuple[Tensor, tuple[int, int]]] = []
        size: tuple[int, int]
        for level, encoder in enumerate(self.encoders):
            x = encoder(x)
            size = (x.shape[2], x.shape[3])
            x, positions = F.max_pool2d(x, 2, ceil_mode=True, return_indices=True)
            pooled.append((positions, size))
            if level >= len(self.encoders) - N_DROPPED:
                x = self.dropout(x)
        for level, decoder in enumerate(self.decoders):
            x = decoder(unpool(x, *pooled.pop()))
            if level < N_DROPPED:
                x = self.dropout(x)
        return self.classifier(x)


def _convolutions(widths: list[int]) -> nn.Sequential:
    return nn.Sequential(*(conv_bn_relu(a, b, 3) for a, b in pairwise(widths)))
