"""FIDNet, CENet and SFA3D, networks of residual blocks, to be measured against. They are never trained here.

FIDNet and CENet label range images (Zhao et al., 2021; Cheng et al., 2022): the outputs of a ResNet-34's four stages
are enlarged to the resolution of the input, concatenated and classified. CENet has convolutions of 3x3 pixels in place
of 1x1, fewer channels, and Hardswish. Its auxiliary heads serve the training only and are left out, as is the softmax.

SFA3D (Nguyen Mau Dung, 2020) finds boxes in a bird's-eye view of height, intensity and density: a ResNet-18 with the
keypoint feature pyramid of RTM3D. Widths and depths are those of the authors' released networks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .pointseg import conv_bn_relu

N_BOX_VALUES = {"heat": 3, "offset": 2, "direction": 2, "height": 1, "size": 3}
"""SFA3D's outputs, and the values of each; heat has three classes."""
Activation = Callable[[], nn.Module]


def conv_bn(c_in: int, c_out: int, kernel: int, stride: int = 1) -> list[nn.Module]:
    """A convolution without bias, and batch norm."""
    return [*conv_bn_relu(c_in, c_out, kernel, stride=(stride, stride))][:2]


class Residual(nn.Module):
    """Two convolutions of 3x3, added to the input, or to its 1x1 convolution where the shape changes."""

    def __init__(self, c_in: int, c_out: int, stride: int, activation: Activation) -> None:
        super().__init__()
        self.layers = nn.Sequential(*conv_bn(c_in, c_out, 3, stride), activation(), *conv_bn(c_out, c_out, 3))
        same = stride == 1 and c_in == c_out
        self.shortcut = nn.Sequential(*([] if same else conv_bn(c_in, c_out, 1, stride)))
        self.activation = activation()

    def forward(self, x: Tensor) -> Tensor:
        return self.activation(self.layers(x) + self.shortcut(x))


def stages(c_in: int, widths: Sequence[int], depths: Sequence[int], activation: Activation) -> nn.ModuleList:
    """Stages of a ResNet; all but the first halve the resolution."""
    made = nn.ModuleList()
    for k, (c_out, depth) in enumerate(zip(widths, depths, strict=True)):
        first = Residual(c_in, c_out, 2 if k else 1, activation)
        made.append(nn.Sequential(first, *(Residual(c_out, c_out, 1, activation) for _ in range(depth - 1))))
        c_in = c_out
    return made


def enlarged(x: Tensor, as_large: Tensor) -> Tensor:
    """Interpolated to the resolution of another tensor."""
    size = as_large.shape[2:]
    return x if x.shape[2:] == size else F.interpolate(x, size, mode="bilinear", align_corners=True)


class FIDNet(nn.Module):
    """Labels every pixel of a range image.

    In: (B, 5, 64, 2048) float32; any height and width.
    Out: logits (B, 20, 64, 2048) float32.

    n_channels, n_classes : channels of the input; classes of the output.
    """

    kernel: ClassVar[int] = 1
    stem_widths: ClassVar[tuple[int, ...]] = (64, 128, 256, 512)
    head_widths: ClassVar[tuple[int, ...]] = (512, 128)
    activation: ClassVar[Activation] = nn.LeakyReLU

    def __init__(self, *, n_channels: int = 5, n_classes: int = 20) -> None:
        super().__init__()
        widths, last = (128, 128, 128, 128), self.stem_widths[-1]
        self.stem = self._chain(n_channels, *self.stem_widths)
        self.stages = stages(last, widths, (3, 4, 6, 3), type(self).activation)
        self.head = self._chain(last + sum(widths), *self.head_widths)
        self.classifier = nn.Conv2d(self.head_widths[-1], n_classes, 1)

    def _chain(self, *widths: int) -> nn.Sequential:
        layers: list[nn.Module] = []
        for pair in pairwise(widths):
            layers += [*conv_bn(*pair, self.kernel), type(self).activation()]
        return nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        seen = [self.stem(x)]
        for stage in self.stages:
            seen.append(stage(seen[-1]))
        return self.classifier(self.head(torch.cat([enlarged(each, x) for each in seen], dim=1)))


class CENet(FIDNet):
    """Labels every pixel of a range image; input and output are those of `FIDNet`."""

    kernel = 3
    stem_widths = (64, 128, 128)
    head_widths = (256, 128)
    activation = nn.Hardswish


class PyramidHead(nn.Module):
    """``n`` values of a pixel: the sum over levels, weighted by their softmax, at the resolution of the last one."""

    def __init__(self, n: int, widths: Sequence[int]) -> None:
        super().__init__()
        layers = [[nn.Conv2d(c, 64, 3, padding=1), nn.ReLU(), nn.Conv2d(64, n, 1)] for c in widths]
        self.levels = nn.ModuleList(nn.Sequential(*each) for each in layers)

    def forward(self, levels: Sequence[Tensor]) -> Tensor:
        size = levels[-1].shape[2:]
        found = [layers(x) for layers, x in zip(self.levels, levels, strict=True)]
        stacked = torch.stack([x if x.shape[2:] == size else F.interpolate(x, size) for x in found])
        return (stacked * stacked.softmax(dim=0)).sum(dim=0)


class SFA3D(nn.Module):
    """Finds boxes: heat maps of their centers, and values at each pixel for a center there.

    In: (B, 3, 608, 608) float32; any height and width divisible by 32.
    Out: in the order of `N_BOX_VALUES`, each (B, n, 152, 152) float32.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(*conv_bn_relu(3, 64, 7, stride=(2, 2)), nn.MaxPool2d(3, stride=2, padding=1))
        self.stages = stages(64, (64, 128, 256, 512), (2, 2, 2, 2), nn.ReLU)
        widths = (256, 128, 64)
        self.ups = nn.ModuleList(nn.Conv2d(3 * c, c, 1) for c in widths)
        self.heads = nn.ModuleList(PyramidHead(n, widths) for n in N_BOX_VALUES.values())

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        seen = [self.stem(x)]  # (B, 64, 152, 152)
        for stage in self.stages:
            seen.append(stage(seen[-1]))
        x, levels = seen.pop(), []  # (B, 512, 19, 19)
        for up in self.ups:
            x = up(torch.cat([enlarged(x, seen[-1]), seen.pop()], dim=1))
            levels.append(enlarged(x, seen[-1]))
        return tuple(head(levels) for head in self.heads)
