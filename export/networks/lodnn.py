"""LoDNN: the road in a top view (Caltagirone et al., 2017), and its new version LoDNN-I (Electronics 12, 3165, 2023).

Both are the same network: an encoder, a context module of dilated convolutions, and a decoder with unpooling. The
input of LoDNN is six statistics of each cell (number of returns, mean remission; mean, deviation, minimum and maximum
of the height). The input of LoDNN-I is three channels (distance, height, remission). LoDNN-I keeps all layers and
improves the training: hand-drawn roads with variations, cross-validation in five folds, and a search for the learning
rate, the number of epochs and the batch size.

What the papers leave open, and the choices made here:

* The decoder's second convolution gives the classes and has no ELU: softmax follows, and after an ELU no logit could be
  below -1.
* ``batch_norm`` adds batch norm after all other convolutions, as in SSADNet, whose segmentation branch extends LoDNN.

`LoDNNEdge` is for small computers: its context module works at a quarter of the image's resolution instead of half.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from .pointseg import conv_bn_relu, initialize
from .ssadnet import CONTEXT_DILATIONS, ContextModule, conv_bn_elu, conv_elu, init_elu, max_pool_with_mask, max_unpool

EDGE_DILATIONS = CONTEXT_DILATIONS[:-1]
"""Dilations (width, height) at a quarter of the resolution. Their receptive field, 65 x 127 cells of 0.4 m, covers
26 x 51 m, as much as the 129 x 255 cells of 0.2 m of `CONTEXT_DILATIONS` at half the resolution."""


class LoDNN(nn.Module):
    """Labels every cell of a top view of any even height and width as road or not.

    n_channels : 3 for LoDNN-I, 6 for LoDNN.
    context_width : channels inside the context module; 128 in the papers, where the module takes 18.5 of 20.1 GMAC.
    dropout : spatial, in the context module.
    batch_norm : after every convolution but the last.
    """

    def __init__(
        self,
        *,
        n_channels: int = 3,
        n_classes: int = 2,
        context_width: int = 128,
        dropout: float = 0.25,
        batch_norm: bool = False,
    ) -> None:
        super().__init__()
        conv = conv_bn_elu if batch_norm else conv_elu
        self.encoder = nn.Sequential(conv(n_channels, 32), conv(32, 32))
        self.context = ContextModule(32, context_width, dropout, batch_norm)
        self.decoder = conv(32, 32)
        self.classifier = nn.Conv2d(32, n_classes, 3, padding=1)
        init_elu(self, self.context, self.classifier, dropout)

    def forward(self, x: Tensor) -> Tensor:
        x = self.encoder(x)  # (B, 32, 400, 200)
        x, mask = max_pool_with_mask(x)  # (B, 32, 200, 100)
        x = self.context(x)  # (B, 32, 200, 100)
        x = max_unpool(x, mask)  # (B, 32, 400, 200)
        return self.classifier(self.decoder(x))  # (B, 2, 400, 200)


class LoDNNEdge(nn.Module):
    """LoDNN at a quarter of the resolution: two strided convolutions, the context module, and channels moved to pixels.
    It takes 0.73 instead of 20.1 GMAC. Height and width are divisible by 4.
    """

    def __init__(self, *, n_channels: int = 3, n_classes: int = 2) -> None:
        super().__init__()
        fine, context_width = 16, 48  # channels at half and at a quarter of the resolution
        self.stem = conv_bn_relu(n_channels, fine, 3, stride=(2, 2))
        self.down = conv_bn_relu(fine, context_width, 3, stride=(2, 2))
        self.context = nn.Sequential(*(Dilated(context_width, (along, across)) for across, along in EDGE_DILATIONS))
        self.up = nn.Conv2d(context_width, 4 * fine, 1)
        self.merge = conv_bn_relu(fine, fine, 3)
        self.classifier = nn.Conv2d(fine, 4 * n_classes, 1)
        initialize(self, self.classifier)

    def forward(self, x: Tensor) -> Tensor:
        fine = self.stem(x)  # (B, 16, 200, 100)
        coarse = self.context(self.down(fine))  # (B, 48, 100, 50)
        fine = self.merge(F.relu(F.pixel_shuffle(self.up(coarse), 2) + fine))
        return F.pixel_shuffle(self.classifier(fine), 2)  # (B, 2, 400, 200)


class Dilated(nn.Module):
    """A dilated 3x3 convolution added to a shortcut. Before training, the block is the identity."""

    def __init__(self, channels: int, dilation: tuple[int, int]) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation, bias=False)
        self.norm = nn.BatchNorm2d(channels)
        nn.init.zeros_(self.norm.weight)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.norm(self.conv(x)))
