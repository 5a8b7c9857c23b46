"""PointSeg: segmentation of a range image (Wang et al., 2018, section 4).

What the paper leaves open, and the choices made here:

* Channels are not stated. They follow SqueezeSeg, which PointSeg extends: 64 after the first convolution, 128, 256, 384
  and 512 in the fire layers; each fire layer squeezes to a quarter of its input (section 4.1).
* Fire1 is SqueezeNet's first convolution, as in SqueezeSeg. It halves the width, and each of three poolings halves it
  again, so the enlargement layer's input is 64 x 32 (section 4.2). The last layer of each resolution is a reweighting:
  SR-1 before the second pooling, SR-2 before the third, SR-3 before the enlargement layer, which replaces a fourth.
* Equation 4 is not used as printed, with "X = sigmoid(chi)": the two fully connected layers would have no input, and
  the feature map would be lost. The choice is that of squeeze-and-excitation and of the paper's Figure 6:
  Scale = sigmoid(FC(relu(FC(chi)))), Y = X * Scale. The first FC squeezes to a quarter.
* Each branch of the enlargement layer has 80 channels; "compress to 1/4" is read as a quarter of the layer's input.
* Convolutions are followed by batch norm, which is folded into them on export.
"""

from __future__ import annotations

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

ENLARGEMENT_RATES = (6, 9, 12)


def conv_bn_relu(
    c_in: int, c_out: int, kernel: int | tuple[int, int], *, stride: tuple[int, int] = (1, 1), dilation: int = 1
) -> nn.Sequential:
    """A convolution without bias, batch norm and ReLU; with stride 1 it keeps the resolution."""
    rows, cols = (kernel, kernel) if isinstance(kernel, int) else kernel
    padding = (dilation * (rows // 2), dilation * (cols // 2))
    return nn.Sequential(
        nn.Conv2d(c_in, c_out, kernel, stride=stride, padding=padding, dilation=dilation, bias=False),
        nn.BatchNorm2d(c_out),
        nn.ReLU(),
    )


def pool(x: Tensor) -> Tensor:
    """Halve the width, never the height (section 4.4)."""
    return F.max_pool2d(x, 3, stride=(1, 2), padding=1)


class Fire(nn.Module):
    """Squeeze, by default to a quarter, and expand by 1x1 and 3x3 (section 4.1; Figure 4, left)."""

    doubles: ClassVar[bool] = False

    def __init__(self, c_in: int, c_out: int, c_mid: int | None = None) -> None:
        super().__init__()
        c_mid = c_in // 4 if c_mid is None else c_mid
        self.squeeze = conv_bn_relu(c_in, c_mid, 1)
        self.deconv = nn.Sequential()
        if self.doubles:
            self.deconv.append(nn.ConvTranspose2d(c_mid, c_mid, (1, 4), stride=(1, 2), padding=(0, 1), bias=False))
            self.deconv.extend([nn.BatchNorm2d(c_mid), nn.ReLU()])
        self.expand1 = conv_bn_relu(c_mid, c_out // 2, 1)
        self.expand3 = conv_bn_relu(c_mid, c_out // 2, 3)

    def forward(self, x: Tensor) -> Tensor:
        x = self.deconv(self.squeeze(x))
        return torch.cat([self.expand1(x), self.expand3(x)], dim=1)


class FireDeconv(Fire):
    """A fire layer that doubles the width between squeeze and expand (Figure 4, right)."""

    doubles = True


class SqueezeReweight(nn.Module):
    """Scale each channel by a function of all channels' means (section 4.3, equations 3 and 4)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fc1 = nn.Conv2d(channels, channels // 4, 1)
        self.fc2 = nn.Conv2d(channels // 4, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        chi = x.mean((2, 3), keepdim=True)  # (B, C, 1, 1)
        scale = torch.sigmoid(self.fc2(F.relu(self.fc1(chi))))
        return x * scale


class Enlargement(nn.Module):
    """A large receptive field without pooling: 1x1, three dilated 3x3 and the image's mean, compressed to 1/4 (4.2)."""

    def __init__(self, c_in: int, width: int) -> None:
        super().__init__()
        self.point = conv_bn_relu(c_in, width, 1)
        self.dilated = nn.ModuleList(conv_bn_relu(c_in, width, 3, dilation=rate) for rate in ENLARGEMENT_RATES)
        # No batch norm: the mean is one pixel for each image, and the statistics of so few pixels are noise.
        self.average = nn.Sequential(nn.Conv2d(c_in, width, 1), nn.ReLU())
        self.compress = conv_bn_relu(width * (2 + len(ENLARGEMENT_RATES)), c_in // 4, 1)

    def forward(self, x: Tensor) -> Tensor:
        average = self.average(x.mean((2, 3), keepdim=True)).expand(-1, -1, x.shape[2], x.shape[3])
        branches = [self.point(x), *(conv(x) for conv in self.dilated), average]
        return self.compress(torch.cat(branches, dim=1))


class PointSeg(nn.Module):
    """Labels every pixel of a range image of any height, and any width divisible by 16 (a full turn: 2048).

    dropout : of a channel before the last convolution, as in SqueezeSeg.
    deep_supervision : in training, also return early logits from the decoder at a quarter of the width.
    """

    def __init__(
        self, *, n_channels: int = 5, n_classes: int = 4, dropout: float = 0.25, deep_supervision: bool = False
    ) -> None:
        super().__init__()
        self.fire1 = conv_bn_relu(n_channels, 64, 3, stride=(1, 2))
        self.skip1 = conv_bn_relu(n_channels, 64, 1)
        self.fire2, self.fire3, self.sr1 = Fire(64, 128), Fire(128, 128), SqueezeReweight(128)
        self.fire4, self.fire5, self.sr2 = Fire(128, 256), Fire(256, 256), SqueezeReweight(256)
        self.fire6, self.fire7 = Fire(256, 384), Fire(384, 384)
        self.fire8, self.fire9, self.sr3 = Fire(384, 512), Fire(512, 512), SqueezeReweight(512)
        self.enlarge = Enlargement(512, 80)
        self.deconv1_enlarged = FireDeconv(128, 128)
        self.deconv1 = FireDeconv(512, 128)
        self.deconv2 = FireDeconv(256, 128)
        self.deconv3 = FireDeconv(128, 64)
        self.deconv4 = FireDeconv(64, 64)
        self.dropout = nn.Dropout2d(dropout)
        self.classifier = nn.Conv2d(64, n_classes, 3, padding=1)
        self.early = nn.Conv2d(128, n_classes, 1) if deep_supervision else None
        initialize(self, self.classifier)

    def forward(self, x: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        skip1 = self.skip1(x)  # (B, 64, 64, 512)
        conv1 = self.fire1(x)  # (B, 64, 64, 256)
        sr1 = self.sr1(self.fire3(self.fire2(pool(conv1))))  # (B, 128, 64, 128)
        sr2 = self.sr2(self.fire5(self.fire4(pool(sr1))))  # (B, 256, 64, 64)
        x = self.fire7(self.fire6(pool(sr2)))  # (B, 384, 64, 32)
        sr3 = self.sr3(self.fire9(self.fire8(x)))  # (B, 512, 64, 32)
        enlarged = self.enlarge(sr3)  # (B, 128, 64, 32)

        x = torch.cat([self.deconv1_enlarged(enlarged), self.deconv1(sr3)], dim=1)  # (B, 256, 64, 64)
        x = self.deconv2(x + sr2) + sr1  # (B, 128, 64, 128)
        early = self.early(x) if self.early is not None and self.training else None
        x = self.deconv3(x) + conv1  # (B, 64, 64, 256)
        x = self.deconv4(x) + skip1  # (B, 64, 64, 512)
        logits = self.classifier(self.dropout(x))  # (B, 4, 64, 512)
        return logits if early is None else (logits, early)


def initialize(network: nn.Module, *last: nn.Conv2d) -> None:
    """He initialization of all layers, and small weights in the output layers ``last``."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            if module.bias is not None:
                nn.init.zeros_(module.bias)
        elif isinstance(module, nn.ConvTranspose2d):
            # An output pixel gets two of the four taps.
            nn.init.normal_(module.weight, std=(2.0 / (2 * module.in_channels)) ** 0.5)
    for module in last:
        nn.init.normal_(module.weight, std=0.01)
