"""Tiny detectors on pillars as OpenPCDet builds and exports them, trained on simulated scans in seconds.

Pillar features, scatter and heads are in the graph: voxels, num_points and coords in, maps of the head out.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from edgeperc.inference.pillars import Pillarizer
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.card import InputSpec, ModelCard, OutputSpec
from edgeperc.types.detector import Anchor, AnchorHead, CenterHead, PillarGeometry
from edgeperc.types.perception import Box
from edgeperc_export.release.to_onnx import with_golden, write_card

CLASSES, KINDS = ("Car", "Pedestrian", "Cyclist"), ("car", "pedestrian", "cyclist")
STRIDE = 2
VIEW = PillarGeometry(
    (0.0, 25.6), (-12.8, 12.8), (-3.0, 1.0), 0.4, 8, 4000, 0.66, 0.0, "voxel_num_points", "voxel_coords"
)
RAW = ("x", "y", "z", "remission")
DECORATED = (*RAW, *(f"from_{of}_{axis}" for of in ("mean", "center") for axis in "xyz"))
ANCHORS = (
    Anchor((3.9, 1.6, 1.56), -1.78, (0.0, 1.57)),
    Anchor((0.8, 0.6, 1.73), -1.6, (0.0, 1.57)),
    Anchor((1.76, 0.6, 1.73), -1.6, (0.0, 1.57)),
)
ANCHOR_HEAD = AnchorHead(CLASSES, STRIDE, "logits", 4096, False, ANCHORS, False, True, 7, 2, 0.78539, 0.0)
CENTER_HEAD = CenterHead(CLASSES, STRIDE, "logits", 500, False, (3,), "sin_cos")
CENTER_OUTPUTS = {"heatmap": 3, "reg": 2, "height": 1, "dim": 3, "rot": 2, "vel": 2}


def card_of(kind: str, channels: Sequence[str] = RAW) -> ModelCard:
    """Of a detector with ``"anchors"`` or ``"centers"``."""
    names = ("cls_preds", "box_preds", "dir_cls_preds") if kind == "anchors" else (*CENTER_OUTPUTS,)
    return ModelCard(
        name=f"tiny-{kind}",
        version="1",
        view=VIEW if "from_mean_x" not in channels else replace(VIEW, num_points=""),  # of no use to the graph
        input=InputSpec("voxels", tuple(channels), (0.0,) * len(channels), (1.0,) * len(channels)),
        outputs=tuple(OutputSpec(name, name) for name in names),
        classes=("background", *KINDS),
        box_classes=KINDS,
        score_threshold=0.1,
        nms_iou=0.1,
        head=ANCHOR_HEAD if kind == "anchors" else CENTER_HEAD,
    )


class PillarNet(nn.Module):
    """PointPillars with few channels; with ``decorated``, the kernel has made all features of points."""

    def __init__(self, kind: str, *, decorated: bool = False) -> None:
        super().__init__()
        self.kind, self.decorated = kind, decorated
        self.linear, self.norm = nn.Linear(len(DECORATED), 16, bias=False), nn.BatchNorm1d(16)
        layers: list[nn.Module] = []
        for c_in, stride in ((16, STRIDE), (24, 1), (24, 1)):
            layers += [nn.Conv2d(c_in, 24, 3, stride, 1, bias=False), nn.BatchNorm2d(24), nn.ReLU()]
        self.backbone = nn.Sequential(*layers)
        counts = (18, 42, 12) if kind == "anchors" else tuple(CENTER_OUTPUTS.values())
        self.heads = nn.ModuleList(nn.Conv2d(24, n, 1) for n in counts)

    def forward(self, voxels: Tensor, num_points: Tensor, coords: Tensor) -> tuple[Tensor, ...]:
        x = voxels
        if not self.decorated:
            mean = voxels[:, :, :3].sum(dim=1, keepdim=True) / num_points.type_as(voxels).view(-1, 1, 1)
            cell = torch.stack([coords[:, 3], coords[:, 2], coords[:, 1]], dim=1).type_as(voxels)
            size = torch.tensor([VIEW.cell_m, VIEW.cell_m, 4.0])
            low = torch.tensor([VIEW.x_range_m[0], VIEW.y_range_m[0], VIEW.z_range_m[0]])
            center = (cell + 0.5) * size + low
            x = torch.cat([voxels, voxels[:, :, :3] - mean, voxels[:, :, :3] - center.unsqueeze(1)], dim=-1)
            used = num_points.int().unsqueeze(1) > torch.arange(voxels.shape[1], dtype=torch.int).unsqueeze(0)
            x = x * used.unsqueeze(-1).type_as(x)
        n, m, c = x.shape
        x = torch.relu(self.norm(self.linear(x.view(-1, c)))).view(n, m, -1).max(dim=1, keepdim=True)[0]
        x = x.squeeze()  # as OpenPCDet's PillarVFE: of a pillar alone, its axis goes, too
        canvas = torch.zeros(16, VIEW.height * VIEW.width, dtype=x.dtype)
        canvas[:, (coords[:, 1] + coords[:, 2] * VIEW.width + coords[:, 3]).long()] = x.t()
        x = self.backbone(canvas.view(1, 16, VIEW.height, VIEW.width))
        outputs = [head(x) for head in self.heads]
        return tuple(each.permute(0, 2, 3, 1) if self.kind == "anchors" else each for each in outputs)


class _WithSigmoid(PillarNet):
    def forward(self, voxels: Tensor, num_points: Tensor, coords: Tensor) -> tuple[Tensor, ...]:
        scores, *others = super().forward(voxels, num_points, coords)
        return (scores.sigmoid(), *others)


def with_sigmoid(network: PillarNet) -> PillarNet:
    """The same network, whose scores are probabilities."""
    other = _WithSigmoid(network.kind, decorated=network.decorated)
    other.load_state_dict(network.state_dict())
    return other.eval()


def inputs_of(card: ModelCard, points: NDArray[np.float32]) -> tuple[Tensor, ...]:
    """The pillars of a scan in the frame of the network, as tensors."""
    maker = Pillarizer(card.view, card.input)
    n = maker.fill(points)
    return tuple(torch.from_numpy(each[:n].copy()) for each in maker.pillars)


def target_of(boxes: Sequence[Box]) -> list[tuple[int, int, int, tuple[float, ...]]]:
    """Class, row, column and values of the boxes in view."""
    found = []
    shrink = STRIDE * VIEW.cell_m
    for box in boxes:
        column, row = (box.center[0] - VIEW.x_range_m[0]) / shrink, (box.center[1] - VIEW.y_range_m[0]) / shrink
        inside = 0 <= row < VIEW.height // STRIDE and 0 <= column < VIEW.width // STRIDE
        if inside and box.label in KINDS:
            values = (*box.center, *box.size, box.yaw)
            found.append((KINDS.index(box.label), int(row), int(column), values))
    return found


def loss_of(kind: str, outputs: Sequence[Tensor], boxes: Sequence[Box]) -> Tensor:
    """What is wrong with the outputs, at the cells of the centers alone; elsewhere there is no object."""
    loss, heat = torch.zeros(()), outputs[0]
    wanted = torch.zeros_like(heat)
    for label, row, column, (x, y, z, length, width, height, yaw) in target_of(boxes):
        if kind == "anchors":
            turned = int(abs(math.sin(yaw)) > abs(math.cos(yaw)))
            anchor, size = 2 * label + turned, ANCHORS[label].size_m
            wanted[0, row, column, anchor * 3 + label] = 1.0
            xs = np.linspace(*VIEW.x_range_m, VIEW.width // STRIDE)
            ys = np.linspace(*VIEW.y_range_m, VIEW.height // STRIDE)
            diagonal, bottom = math.hypot(*size[:2]), ANCHORS[label].bottom_m
            off = (yaw - 1.57 * turned + math.pi / 2) % math.pi - math.pi / 2
            sizes = [math.log(a / b) for a, b in zip((length, width, height), size, strict=True)]
            place = [(x - xs[column]) / diagonal, (y - ys[row]) / diagonal, (z - bottom - size[2] / 2) / size[2]]
            code = torch.tensor([*place, *sizes, off])
            loss = loss + (outputs[1][0, row, column, anchor * 7 : anchor * 7 + 7] - code).abs().sum()
            half = int(((yaw - 0.78539) % (2 * math.pi)) >= math.pi)
            bins = outputs[2][0, row, column, anchor * 2 : anchor * 2 + 2]
            loss = loss + nn.functional.cross_entropy(bins[None], torch.tensor([half]))
        else:
            wanted[0, label, row, column] = 1.0
            shrink = STRIDE * VIEW.cell_m
            values = [(x - VIEW.x_range_m[0]) / shrink - column, (y - VIEW.y_range_m[0]) / shrink - row, z]
            values += [math.log(length), math.log(width), math.log(height), math.sin(yaw), math.cos(yaw)]
            given = torch.cat([each[0, :, row, column] for each in outputs[1:5]])
            loss = loss + (given - torch.tensor(values)).abs().sum()
    weight = 1.0 + 200.0 * wanted
    return loss + nn.functional.binary_cross_entropy_with_logits(heat, wanted, weight=weight, reduction="sum") / 50.0


def trained(kind: str, *, decorated: bool = False, n_steps: int = 150, n_scans: int = 2) -> PillarNet:
    """A network that has seen a few simulated scans."""
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)  # they would wait for one another on busy cores
    torch.manual_seed(0)
    network = PillarNet(kind, decorated=decorated)
    card = card_of(kind, DECORATED if decorated else RAW)
    scans = [simulated_scan(seed) for seed in range(n_scans)]
    samples = [(inputs_of(card, scan.points), scan.boxes) for scan in scans]
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    for step in range(n_steps):
        inputs, boxes = samples[step % len(samples)]
        optimizer.zero_grad()
        loss_of(kind, network(*inputs), boxes).backward()
        optimizer.step()
    torch.set_num_threads(n_threads)
    return network.eval()


def exported(
    network: PillarNet,
    path: Path,
    card: ModelCard | None = None,
    *,
    n_pillars: int | None = None,
    whole: torch.dtype = torch.int32,
) -> Path:
    """An .onnx file with a card, written by torch's exporter of 2020 to 2024; ``n_pillars`` makes the graph static.

    whole : type of the numbers of points and of the places.
    """
    card = card_of(network.kind, DECORATED if network.decorated else RAW) if card is None else card
    example = tuple(each.clone() for each in inputs_of(card, simulated_scan(0).points))
    if n_pillars is not None:
        example = tuple(each[torch.arange(n_pillars) % len(each)] for each in example)
    example = (example[0], *(each.to(whole) for each in example[1:]))
    names = [card.input.name, "voxel_num_points", "voxel_coords"]
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            example,
            buffer,
            dynamo=False,
            opset_version=13,
            input_names=names,
            output_names=[output.name for output in card.outputs],
            dynamic_axes={} if n_pillars is not None else {name: {0: "pillars"} for name in names},
        )
    model = onnx.load_from_string(buffer.getvalue())
    write_card(model, with_golden(model, card), path)
    return path
