"""SSADNet: segmentation and detection in one pass over a top view (Lee and Park, 2020, section 2.2).

What the paper leaves open, and the choices made here:

* Channels are not stated. They follow LoDNN, which the segmentation branch extends: 32 in the encoder and the decoder,
  128 in the context module, spatial dropout 0.25. The feature extractor's 16, 32, 64, 128, 128 are chosen here: full
  resolution is expensive, and the bridge already provides 32 channels of features.
* "Additional 3x3 convolution after each F.E. block except the first and last": it follows the block's pooling and has
  the block's batch norm and ELU.
* "Each B.B.R. block repeats the dropout and ELU on the 1x1 convolution": 1x1, ReLU, then twice (1x1, dropout, ELU),
  then a 1x1 to one value for each slot, averaged over the image. Without this last linear layer the slots would be
  limited to ELU's range. Averaging comes last, as in network-in-network.
* The number of boxes for each pass is not stated: ``n_slots``.
* Neither is the order of the slots. Head "slots-paper" has the nearest object first, and averages over the image as
  printed. It learns eight scans by heart (AP50 100), but found 1 of 49 boxes of other drives: every target moves to
  another slot when a nearer object appears, the average contains no positions, the zeros of empty slots pull all
  boxes towards the corner, and no output separates an empty slot from an uncertain one. In head "slots", each slot
  belongs to a square of the image: the average is left out, each of the 12 x 6 features predicts the box centered in
  its square, and a fifth B.B.R. block predicts whether there is one.
* ``batch_norm`` adds batch norm after every convolution of the segmentation branch (not in the paper): without it, the
  network did not separate the classes after 240 steps; with it, it did. It is folded into the convolutions on export.
* Head "dense" replaces the regressor (not in the paper): one prediction every four cells, so that boxes are predicted
  where they are, in any number.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edgeperc.types.card import N_DENSE_CHANNELS, N_FRONT_CHANNELS

from ..data.targets import SLOT_CELLS

CONTEXT_DILATIONS = ((1, 1), (1, 2), (2, 4), (4, 8), (8, 16), (16, 32), (32, 64))
"""Table 1, as printed: (width, height). torch's ``dilation`` is (height, width)."""

HEAT_PRIOR = 0.1
"""Value of the untrained heat map everywhere (as in CenterNet; a logit of -2.19)."""

SLOT_PRIORS = (math.log(0.1), math.log(0.1), -math.log(1.0 / 0.05 - 1.0))
"""Log width, log height [shares of the image] and logit of the presence of every slot before training."""

# Var(x) / E[elu(x)^2] for a standard normal x: He's gain, which is 2 for ReLU.
ELU_GAIN = 1.55


def max_pool_with_mask(x: Tensor) -> tuple[Tensor, Tensor]:
    """2x2 max-pooling with stride 2 of even height and width, and a mask of the maxima, one in each window: of equal
    ones the first, like the indices of `torch.nn.MaxPool2d`. Ties are common, because empty cells are equal.

    `torch.nn.MaxUnpool2d` exports as a scatter, which few engines run fast. Pooling, comparing and multiplying run
    everywhere.
    """
    pooled = F.max_pool2d(x, 2)
    with torch.no_grad():
        order = x.new_tensor([[4.0, 3.0], [2.0, 1.0]]).repeat(x.shape[-2] // 2, x.shape[-1] // 2)
        candidate = torch.where(x == _double(pooled), order, 0.0)
        mask = candidate == _double(F.max_pool2d(candidate, 2))
    return pooled, mask


def max_unpool(x: Tensor, mask: Tensor) -> Tensor:
    """Put each value (B, C, H/2, W/2) back where `max_pool_with_mask` took it from; zero elsewhere (B, C, H, W)."""
    return _double(x) * mask


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")


def conv_elu(c_in: int, c_out: int) -> nn.Sequential:
    """A 3x3 convolution that keeps the resolution, and ELU."""
    return nn.Sequential(nn.Conv2d(c_in, c_out, 3, padding=1), nn.ELU())


def conv_bn_elu(c_in: int, c_out: int) -> nn.Sequential:
    """A 3x3 convolution that keeps the resolution, batch norm and ELU."""
    return nn.Sequential(nn.Conv2d(c_in, c_out, 3, padding=1, bias=False), nn.BatchNorm2d(c_out), nn.ELU())


def norm(channels: int, batch_norm: bool) -> list[nn.Module]:
    return [nn.BatchNorm2d(channels)] if batch_norm else []


class ContextModule(nn.Module):
    """Seven dilated 3x3 convolutions with a receptive field of 129 x 255 pooled cells, and a 1x1 (Table 1)."""

    def __init__(self, channels: int = 32, width: int = 128, dropout: float = 0.25, batch_norm: bool = False) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        c_in = channels
        for across, along in CONTEXT_DILATIONS:
            dilation = (along, across)
            layers.append(nn.Conv2d(c_in, width, 3, padding=dilation, dilation=dilation))
            layers += [*norm(width, batch_norm), nn.Dropout2d(dropout), nn.ELU()]
            c_in = width
        self.dilated = nn.Sequential(*layers)
        self.project = nn.Sequential(nn.Conv2d(width, channels, 1), *norm(channels, batch_norm), nn.ELU())

    def forward(self, x: Tensor) -> Tensor:
        return self.project(self.dilated(x))


def init_elu(network: nn.Module, context: ContextModule, classifier: nn.Conv2d, dropout: float) -> None:
    """Preserve the variance through ELU and dropout, so that nine layers without batch norm can be trained."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            fan_in = module.in_channels * module.kernel_size[0] * module.kernel_size[1]
            nn.init.normal_(module.weight, std=math.sqrt(ELU_GAIN / fan_in))
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    for module in context.dilated:
        if isinstance(module, nn.Conv2d):
            # Spatial dropout scales the kept channels, and so raises the variance, by 1 / (1 - p).
            module.weight.data.mul_(math.sqrt(1.0 - dropout))
    nn.init.normal_(classifier.weight, std=0.01)


class SegmentationBranch(nn.Module):
    """Encoder, context module, decoder and pixel classifier (Figure 5)."""

    def __init__(self, n_channels: int, n_classes: int, context_width: int, dropout: float, batch_norm: bool) -> None:
        super().__init__()
        conv = conv_bn_elu if batch_norm else conv_elu
        self.encoder = nn.Sequential(conv(n_channels, 32), conv(32, 32))
        self.context = ContextModule(32, context_width, dropout, batch_norm)
        self.decoder = nn.Sequential(conv(32, 32), conv(32, 32))
        self.classifier = nn.Conv2d(32, n_classes, 1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        x = self.encoder(x)  # (B, 32, 400, 200)
        x, mask = max_pool_with_mask(x)  # (B, 32, 200, 100)
        x = self.context(x)  # (B, 32, 200, 100)
        x = max_unpool(x, mask)  # (B, 32, 400, 200)
        features = self.decoder(x)  # (B, 32, 400, 200)
        return self.classifier(features), features


class FeatureBlock(nn.Module):
    """F.E. block: two 3x3 convolutions with batch norm and ELU, then 2x2 max-pooling (Figure 6a); ``extra`` adds a
    third convolution after the pooling.
    """

    def __init__(self, c_in: int, c_out: int, extra: bool) -> None:
        super().__init__()
        self.convs = nn.Sequential(conv_bn_elu(c_in, c_out), conv_bn_elu(c_out, c_out))
        self.extra = conv_bn_elu(c_out, c_out) if extra else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return self.extra(F.max_pool2d(self.convs(x), 2))


class BoxRegressor(nn.Module):
    """B.B.R. block: one number for each slot (Figure 6b), an average over the image; without ``n_slots``, each feature
    of the image has a slot.
    """

    def __init__(self, channels: int, n_slots: int | None, dropout: float) -> None:
        super().__init__()
        self.by_place = n_slots is None
        layers: list[nn.Module] = [nn.Conv2d(channels, channels, 1), nn.ReLU()]
        for _ in range(2):
            layers += [nn.Conv2d(channels, channels, 1), nn.Dropout(dropout), nn.ELU()]
        self.layers = nn.Sequential(*layers, nn.Conv2d(channels, n_slots or 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        values = self.layers(x)
        return values[:, 0] if self.by_place else values.mean((2, 3))  # (B, 12, 6) or (B, n_slots)


class SlotsHead(nn.Module):
    """The paper's detection branch: five F.E. blocks, four or five B.B.R. blocks (Figure 7).

    Out: (B, n_slots, 4), each row the center column, center row, width and height of an upright box in the top view,
    as shares of its width and height; zeros in empty slots. Without ``n_slots`` there is one slot for each square of
    32 cells, by rows from the far left one, and a fifth column: the logit that there is an object.
    """

    def __init__(self, c_in: int, n_slots: int | None, dropout: float) -> None:
        super().__init__()
        self.features = nn.Sequential(
            FeatureBlock(c_in, 16, extra=False),  # -> (B, 16, 200, 100)
            FeatureBlock(16, 32, extra=True),  # -> (B, 32, 100, 50)
            FeatureBlock(32, 64, extra=True),  # -> (B, 64, 50, 25)
            FeatureBlock(64, 128, extra=True),  # -> (B, 128, 25, 12)
            FeatureBlock(128, 128, extra=False),  # -> (B, 128, 12, 6)
        )
        self.regressors = nn.ModuleList(BoxRegressor(128, n_slots, dropout) for _ in ("xywh" if n_slots else "xywhp"))
        self.by_place = n_slots is None

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        x = self.features(x)
        if not self.by_place:
            return torch.stack([regressor(x) for regressor in self.regressors], dim=2)  # (B, n_slots, 4)
        # In float32 even under autocast: bfloat16 resolves only a hundredth of a car's width in shares of the image.
        col, row, log_w, log_h, presence = (regressor(x).float() for regressor in self.regressors)
        n_rows, n_cols = x.shape[-2:]
        rows, cols = torch.arange(n_rows, device=x.device), torch.arange(n_cols, device=x.device)
        boxes = [
            (cols + 0.5 + col) * (SLOT_CELLS / width),
            (rows[:, None] + 0.5 + row) * (SLOT_CELLS / height),
            log_w.exp(),
            log_h.exp(),
            presence,
        ]
        return torch.stack(boxes, dim=3).flatten(1, 2)  # (B, 72, 5)


class DenseHead(nn.Module):
    """An anchor-free regressor on F.E. blocks 1 to 3: one prediction every four cells.

    Out: (B, 9 or 11, H/4, W/4): heat-map logit; offset of the center from the output cell's center in rows, columns
    [output cells]; log length, log width [m]; sin and cos of twice the yaw; center z [m]; log height [m]; with
    ``front``, a vector (x, y) towards the front, whose component along a heading is the logit that the front is there.
    """

    def __init__(self, c_in: int, front: bool = False) -> None:
        super().__init__()
        self.fine = nn.Sequential(
            FeatureBlock(c_in, 16, extra=False),  # -> (B, 16, 200, 100)
            FeatureBlock(16, 32, extra=True),  # -> (B, 32, 100, 50)
        )
        self.coarse = nn.Sequential(
            FeatureBlock(32, 64, extra=True),  # -> (B, 64, 50, 25)
            # No further pooling, although trucks need a larger receptive field: 25 columns cannot be halved.
            conv_bn_elu(64, 64),
            conv_bn_elu(64, 64),
        )
        self.merge = nn.Sequential(conv_bn_elu(32 + 64, 64), conv_bn_elu(64, 64))  # -> (B, 64, 100, 50)
        self.predict = nn.Conv2d(64, N_DENSE_CHANNELS + N_FRONT_CHANNELS * front, 1)

    def forward(self, x: Tensor) -> Tensor:
        fine = self.fine(x)
        coarse = _double(self.coarse(fine))
        return self.predict(self.merge(torch.cat([fine, coarse], dim=1)))  # (B, 9 or 11, 100, 50)


class SSADNet(nn.Module):
    """Labels every cell of a top view and detects the vehicles in it; height and width divisible by 8 (slots: 32).

    head : ``"slots"`` is the paper's regressor with one slot for each square of 32 cells, ``"slots-paper"`` the same as
        published with ``n_slots``, ``"dense"`` one prediction every four cells.
    context_width : channels inside the context module, which takes most of the time: 18.5 of 22.6 GMAC at 128.
    dropout : spatial in the context module, of values in the B.B.R. blocks.
    batch_norm : use batch norm in the segmentation branch too.
    front : head "dense" also predicts which end of a vehicle is its front.
    """

    def __init__(
        self,
        head: str = "slots",
        *,
        n_channels: int = 3,
        n_classes: int = 5,
        n_slots: int = 16,
        context_width: int = 128,
        dropout: float = 0.25,
        batch_norm: bool = False,
        front: bool = False,
    ) -> None:
        super().__init__()
        self.segmentation = SegmentationBranch(n_channels, n_classes, context_width, dropout, batch_norm)
        bridge = n_channels + 32
        self.detection: nn.Module
        if head in ("slots", "slots-paper") and not front:
            self.detection = SlotsHead(bridge, n_slots if head == "slots-paper" else None, dropout)
        elif head == "dense":
            self.detection = DenseHead(bridge, front)
        else:
            raise ValueError(
                f'head is {head!r} with front={front}; expected "slots" or "slots-paper" without front, or "dense"'
            )
        init_elu(self, self.segmentation.context, self.segmentation.classifier, dropout)
        self._initialize()

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        logits, features = self.segmentation(x)
        # The bridge. Under autocast, the input must have the type of the features, or all 35 channels become float32.
        boxes = self.detection(torch.cat([x.to(features.dtype), features], dim=1))
        return logits, boxes

    def _initialize(self) -> None:
        if isinstance(self.detection, DenseHead):
            nn.init.normal_(self.detection.predict.weight, std=0.01)
            assert self.detection.predict.bias is not None
            self.detection.predict.bias.data[0] = -math.log(1.0 / HEAT_PRIOR - 1.0)
        elif isinstance(self.detection, SlotsHead) and self.detection.by_place:
            # Before training, each square has a box in its middle, a tenth of the image wide and long, as a car is.
            for regressor, value in zip(self.detection.regressors, (0.0, 0.0, *SLOT_PRIORS), strict=True):
                *_, last = regressor.modules()
                assert isinstance(last, nn.Conv2d)
                assert last.bias is not None
                nn.init.normal_(last.weight, std=0.01)
                nn.init.constant_(last.bias, value)
