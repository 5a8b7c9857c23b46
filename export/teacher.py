"""What a trained network teaches another: labels for unlabeled points, and class probabilities to distil.

KITTI labels what its camera sees, and some scans not at all, but each scan holds the street on all sides. A teacher
labels the points that it is sure of (pseudo-labels; Lee, 2013); all others stay unknown.
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

# The view covers 90 degrees. These directions overlap, so that no object is seen at the edge of a view alone.
LOOKS = np.radians([0.0, 80.0, 160.0, 200.0, 280.0])


def unlabeled_scans(objects: KittiObjects, fold: int | None) -> list[LabeledScan]:
    """The unlabeled scans of the training drives."""
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
    """The scans with labels on all sides.

    Parameters
    ----------
    network : nn.Module
        Labels points.
    task : Task
        The network's own.
    scans : iterable of LabeledScan
        Their own labels are kept.
    sure : float
        Other points take the network's label if its probability is at least this.
    """
    projector = make_projector(task.view, task.input)
    network.eval()
    done = []
    for scan in tqdm(list(scans), desc="labeling", leave=False):
        labels = scan.labels.copy()
        for angle in LOOKS:
            seen = projector.project(np.ascontiguousarray(turned(scan, float(angle)).points))
            with torch.no_grad():
                p = network(torch.from_numpy(seen.image[None])).float().softmax(1)[0].numpy()
            best: NDArray[np.uint8] = p.argmax(0).astype(np.uint8)
            trusted = (p.max(0) >= sure) & (seen.index >= 0)
            at = seen.index[trusted]
            labels[at] = np.where(labels[at] == IGNORE, best[trusted], labels[at])
        done.append(replace(scan, labels=labels, azimuths=(-np.pi, np.pi)))
    return done


@torch.no_grad()
def teach(network: nn.Module, image: Tensor, inputs: InputSpec, *, mirror: bool) -> tuple[Tensor, Tensor | None]:
    """A network's class probabilities (B, C, H, W) for a batch of inputs, and its boxes if it has any.

    ``mirror`` averages the probabilities over each scene and its mirror image, in which a channel y changes its sign.
    """
    with torch.autocast(image.device.type, torch.bfloat16):
        answer = network(image)
        logits, boxes = answer if isinstance(answer, tuple) else (answer, None)
        p = logits.float().softmax(1)
        if mirror:
            mirrored = image.flip(-1)
            if "y" in inputs.channels:
                mirrored = mirrored.clone()
                mirrored[:, inputs.channels.index("y")] *= -1.0
            answer = network(mirrored)
            other = answer[0] if isinstance(answer, tuple) else answer
            p = 0.5 * (p + other.float().softmax(1).flip(-1))
    return p, boxes
