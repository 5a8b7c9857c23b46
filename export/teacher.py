"""A teacher network's outputs as training targets: labels for unlabeled points, and class probabilities to distil from.

KITTI labels only what its camera sees, and some scans not at all, but each scan covers the street on all sides. The
teacher labels the points whose class it is sure of (pseudo-labels; Lee, 2013); all others stay unknown.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm import tqdm

from edgeperc.card import InputSpec
from edgeperc.evaluation.datasets import KittiObjects
from edgeperc.projection import make_projector
from edgeperc.readers.files import read_points
from edgeperc.simulation.samples import IGNORE

from .scans import SURFACE, LabeledScan, turned
from .task import Task

__all__ = ["pseudo_labeled", "teach", "unlabeled_scans"]

SURE = 0.9
"""Smallest probability of a pseudo-label."""

# The view covers 90 degrees. The directions overlap, so that no object lies only at the edge of a view.
DIRECTIONS = np.radians([0.0, 80.0, 160.0, 200.0, 280.0])


def unlabeled_scans(objects: KittiObjects, fold: int | None) -> list[LabeledScan]:
    """The unlabeled scans of the training drives without those of ``fold``; every label is `IGNORE`."""
    scans = []
    for name in objects.unlabeled("train", fold=fold):
        points = read_points(objects.root / "training/velodyne" / f"{name}.bin")
        points = points[np.isfinite(points).all(axis=1)]
        unknown = np.full((SURFACE.height, SURFACE.width), IGNORE, np.uint8)
        scans.append(LabeledScan(points, np.full(len(points), IGNORE, np.uint8), (), (), unknown))
    return scans


def pseudo_labeled(
    network: nn.Module, task: Task, scans: Iterable[LabeledScan], sure: float = SURE
) -> list[LabeledScan]:
    """The scans, labeled by a network on all sides.

    Parameters
    ----------
    network : nn.Module
        A network that labels points.
    task : Task
        The network's task.
    scans : iterable of LabeledScan
        Their own labels are kept.
    sure : float
        An unlabeled point gets the network's label if its probability is at least this.
    """
    projector = make_projector(task.view, task.input)
    network.eval()
    labeled = []
    for scan in tqdm(list(scans), desc="labeling", leave=False):
        labels = scan.labels.copy()
        for angle in DIRECTIONS:
            projected = projector.project(np.ascontiguousarray(turned(scan, float(angle)).points))
            with torch.no_grad():
                p = network(torch.from_numpy(projected.image[None])).float().softmax(1)[0].numpy()
            best: NDArray[np.uint8] = p.argmax(0).astype(np.uint8)
            trusted = (p.max(0) >= sure) & (projected.index >= 0)
            at = projected.index[trusted]
            labels[at] = np.where(labels[at] == IGNORE, best[trusted], labels[at])
        labeled.append(replace(scan, labels=labels, azimuths=(-np.pi, np.pi)))
    return labeled


@torch.no_grad()
def teach(network: nn.Module, image: Tensor, inputs: InputSpec, *, mirror: bool) -> tuple[Tensor, Tensor | None]:
    """A network's class probabilities (B, C, H, W) for a batch of inputs, and its boxes or None.

    ``mirror`` averages the probabilities over each scene and its mirror image. In the mirror image, the channel y
    changes its sign.
    """
    with torch.autocast(image.device.type, torch.bfloat16):
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
