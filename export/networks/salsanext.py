"""SalsaNext: segmentation of a full turn's range image (Cortinhal et al., 2020, section III), to be measured against.

It is never trained here. What differs from the paper, and why:

* Batch norm comes before the leaky ReLU instead of after it, so that it can be folded into the convolution on export.
* Dropout is left out: it does nothing in inference.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def conv(c_in: int, c_out: int, kernel: int, *, dilation: int = 1) -> nn.Sequential:
    """A convolution that keeps the resolution, batch norm and leaky ReLU."""
    layer = nn.Conv2d(c_in, c_out, kernel, padding=dilation * (kernel - 1) // 2, dilation=dilation)
    return nn.Sequential(layer, nn.BatchNorm2d(c_out), nn.LeakyReLU())


class Context(nn.Module):
    """A receptive field of 3, then of 7 pixels, added to a 1x1 convolution."""

    def __init__(self, c_in: int, c_out: int) -> None:
        super().__init__()
        self.point = nn.Sequential(nn.Conv2d(c_in, c_out, 1), nn.LeakyReLU())
        self.around = nn.Sequential(conv(c_out, c_out, 3), conv(c_out, c_out, 3, dilation=2))

    def forward(self, x: Tensor) -> Tensor:
        x = self.point(x)
        return x + self.around(x)


class Dilated(nn.Module):
    """Three convolutions with growing receptive fields, 3, 7 and 9 pixels, whose outputs 1x1 fuses."""

    def __init__(self, c_in: int, c_out: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList([conv(c_in, c_out, 3), conv(c_out, c_out, 3, dilation=2)])
        self.layers.append(conv(c_out, c_out, 2, dilation=2))
        self.fuse = conv(3 * c_out, c_out, 1)

    def forward(self, x: Tensor) -> Tensor:
        seen = []
        for layer in self.layers:
            x = layer(x)
            seen.append(x)
        return self.fuse(torch.cat(seen, dim=1))


class Encoder(nn.Module):
    """Dilated convolutions and a residual connection; the decoder gets what stands before the pooling."""

    def __init__(self, c_in: int, c_out: int) -> None:
        super().__init__()
        self.point = nn.Sequential(nn.Conv2d(c_in, c_out, 1), nn.LeakyReLU())
        self.dilated = Dilated(c_in, c_out)

    def forward(self, x: Tensor) -> Tensor:
        return self.point(x) + self.dilated(x)


class Decoder(nn.Module):
    """Pixel shuffle, the encoder's features, and dilated convolutions."""

    def __init__(self, c_in: int, c_skip: int, c_out: int) -> None:
        super().__init__()
        self.dilated = Dilated(c_in // 4 + c_skip, c_out)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        return self.dilated(torch.cat([F.pixel_shuffle(x, 2), skip], dim=1))


class SalsaNext(nn.Module):
    """Labels every pixel of a range image (B, 5, H, W), H and W divisible by 16, as one of 20 classes."""

    def __init__(self, *, n_channels: int = 5, n_classes: int = 20) -> None:
        super().__init__()
        self.context = nn.Sequential(Context(n_channels, 32), Context(32, 32), Context(32, 32))
        widths = ((32, 64), (64, 128), (128, 256), (256, 256), (256, 256))
        self.encoders = nn.ModuleList(Encoder(*each) for each in widths)
        widths_up = ((256, 256, 128), (128, 256, 128), (128, 128, 64), (64, 64, 32))
        self.decoders = nn.ModuleList(Decoder(*each) for each in widths_up)
        self.classifier = nn.Conv2d(32, n_classes, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.context(x)  # (B, 32, 64, 2048)
        skips: list[Tensor] = []
        for encoder in self.encoders:
            if skips:
                x = F.avg_pool2d(x, 3, stride=2, padding=1)
            x = encoder(x)
            skips.append(x)
        x = skips.pop()  # (B, 256, 4, 128)
        for decoder in self.decoders:
            x = decoder(x, skips.pop())
        return self.classifier(x)  # (B, 20, 64, 2048)
