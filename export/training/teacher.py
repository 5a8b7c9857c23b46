"""A teacher network's outputs as training targets: labels for unlabeled points, and class probabilities to distil from.

KITTI labels only what its camera sees, and some scans not at all, but each scan covers the street on all sides. The
teacher labels the points whose class it is sure of (pseudo-labels; Lee, 2013); all others stay unknown.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from edgeperc.datasets.kitti import KittiObjects
from edgeperc.inference.projection import make_projector, project
from edgeperc.inference.session import Session
from edgeperc.readers.files import read_points
from edgeperc.simulation.samples import IGNORE
from edgeperc.types.card import InputSpec, ModelCard
from edgeperc.types.frame import ModelFrame
from edgeperc.types.points import Bytes, Floats32

from ..data.scan_sets import seen_by_network
from ..data.scans import LabeledScan, mirrored, turned
from .bfloat16 import in_bfloat16
from .checkpoint import build_network, read_checkpoint
from .task import Task, task_of

SURE = 0.9
"""Smallest probability of a pseudo-label."""

# The view covers 90 degrees. The directions overlap, so that no object lies only at the edge of a view.
DIRECTIONS = np.radians([0.0, 80.0, 160.0, 200.0, 280.0])


def unlabeled_scans(objects: KittiObjects, fold: int | None) -> list[LabeledScan]:
    """The unlabeled scans of the training drives without those of ``fold``; every label is `IGNORE`."""
    clouds = [read_points(objects.files(name)[0]) for name in objects.unlabeled("train", fold=fold)]
    return [LabeledScan.unlabeled(points[np.isfinite(points).all(axis=1)]) for points in clouds]


def pseudo_labeled(
    network: nn.Module, task: Task, scans: Iterable[LabeledScan], sure: float = SURE
) -> list[LabeledScan]:
    """The scans, labeled on all sides where a network of points is sure; they keep their own labels."""
    projector = make_projector(task.view, task.input)
    network.eval()
    labeled = []
    for scan in tqdm(list(scans), desc="labeling", leave=False):
        labels = scan.labels.copy()
        for angle in DIRECTIONS:
            projected = project(projector, np.ascontiguousarray(turned(scan, float(angle)).points))
            with torch.no_grad():
                p = network(torch.from_numpy(projected.image[None])).float().softmax(1)[0].numpy()
            best: Bytes = p.argmax(0).astype(np.uint8)
            trusted = (p.max(0) >= sure) & (projected.index >= 0)
            at = projected.index[trusted]
            labels[at] = np.where(labels[at] == IGNORE, best[trusted], labels[at])
        labeled.append(replace(scan, labels=labels, azimuths=(-np.pi, np.pi)))
    return labeled


class _OfChannels(nn.Module):
    """A network that sees some channels of another network's input."""

    def __init__(self, network: nn.Module, channels: Sequence[int]) -> None:
        super().__init__()
        self.network, self.channels = network, list(channels)

    def forward(self, x: Tensor) -> Any:
        return self.network(x[:, self.channels])


def teacher_network(checkpoint: Path, task: Task) -> nn.Module:
    """The network of a checkpoint with the same view as the task, and with the same channels or fewer."""
    state = read_checkpoint(checkpoint)
    recipe = state["recipe"]
    seen, own = (
        list(zip(spec.channels, spec.mean, spec.std, strict=True)) for spec in (task.input, task_of(recipe).input)
    )
    if task_of(recipe).view != task.view or not set(own) <= set(seen):
        raise ValueError(f"{checkpoint} is of {recipe.network}, which sees another view than {task.recipe.network}")
    _check_classes(checkpoint, task_of(recipe).classes, task)
    return _OfChannels(build_network(state, checkpoint), [seen.index(channel) for channel in own]).eval()


def _check_classes(path: Path, classes: Sequence[str], task: Task) -> None:
    """Raise ValueError for a teacher of other classes; those that follow the road count as one (`Road`)."""
    compared = classes[:2] if task.recipe.task == "road" else classes
    if tuple(compared) != tuple(task.classes):
        raise ValueError(f"{path} has the classes {', '.join(classes)}; expected {', '.join(task.classes)}")


class OnnxTeacher:
    """An exported network as the teacher, in the process that makes a sample, by its own channels. Raises
    ValueError.
    """

    def __init__(self, path: Path, task: Task) -> None:
        self.path, self.card = path, ModelCard.read(path)
        if self.card.view != task.view:
            raise ValueError(f"{path} sees another view than {task.recipe.network}")
        _check_classes(path, self.card.classes, task)
        self.mirror = task.recipe.seen_twice
        self.has_boxes = task.recipe.task == "vehicles" and task.recipe.head == "dense"
        if self.has_boxes and "box_dense" not in [output.kind for output in self.card.outputs]:
            raise ValueError(f'{path} has no dense boxes; give --teacher a network with head "dense"')
        self.projector = make_projector(self.card.view, self.card.input)
        self._session: Session | None = None

    def __call__(self, scan: LabeledScan) -> tuple[Floats32, ...]:
        """Class probabilities (C, H, W) float32, and dense boxes if the network to train has them."""
        if self._session is None:  # made in the process that uses it
            self._session = Session(self.path, "cpu", n_threads=1)
        p, boxes = self._answer(self._session, scan)
        if self.mirror:
            p = 0.5 * (p + self._answer(self._session, mirrored(scan))[0][:, :, ::-1])
        return (p, boxes) if boxes is not None else (p,)

    def _answer(self, session: Session, scan: LabeledScan) -> tuple[Floats32, Floats32 | None]:
        seen_from = ModelFrame.of_training(self.card.mount_height_m)
        session.input[:] = seen_by_network(self.projector, scan, seen_from)[1].image
        raw = session.run()
        p = np.array(raw["class_logits"] if "class_logits" in raw else raw["class_probabilities"])
        if "class_logits" in raw:
            p = np.exp(p - p.max(axis=0))
            p /= p.sum(axis=0)
        return p, np.array(raw["box_dense"]) if self.has_boxes else None


@torch.no_grad()
def teach(network: nn.Module, image: Tensor, inputs: InputSpec, *, mirror: bool) -> tuple[Tensor, Tensor | None]:
    """A network's class probabilities (B, C, H, W) for a batch of inputs, and its boxes or None. ``mirror`` averages
    them over each scene and its mirror image, in which the channel y changes its sign.
    """
    with in_bfloat16(image.device.type):
        outputs = network(image)
        logits, boxes = outputs if isinstance(outputs, tuple) else (outputs, None)
        p = logits.float().softmax(1)
        if mirror:
            mirrored = image.flip(-1)
            if "y" in inputs.channels:
                mirrored = mirrored.clone()
                mirrored[:, inputs.channels.index("y")] *= -1.0
            outputs = network(mirrored)
            other = outputs[0] if isinstance(outputs, tuple) else outputs
            p = 0.5 * (p + other.float().softmax(1).flip(-1))
    return p, boxes
