"""What a trained network teaches another: labels for what nobody labelled, and probabilities where there are labels.

Real scans are labelled ahead only, and some not at all; yet each holds a street on every side. A teacher, trained on
simulation or on labels, names what it is sure of (Lee's pseudo-labels, 2013); everything else stays unknown.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm import tqdm

from edgeperc.evaluation.datasets import KittiObjects
from edgeperc.projection import make_projector
from edgeperc.readers.files import read_points
from edgeperc.simulation.samples import IGNORE

from .cards import LABELS_POINTS, RANGE_IMAGE, RANGE_IMAGE_INPUT
from .scans import SURFACE, LabelledScan, turned

__all__ = ["pseudo_labelled", "taught", "unlabelled_scans"]

SURE = 0.9

# Four looks of 90 degrees cover the circle; half a step more each way, so that nothing lies on an edge alone.
LOOKS = np.radians([0.0, 80.0, 160.0, 200.0, 280.0])


def unlabelled_scans(objects: KittiObjects, fold: int | None) -> list[LabelledScan]:
    """The scans of the training drives that nobody labelled."""
    scans = []
    for name in objects.unlabelled("train", fold=fold):
        points = read_points(objects.root / "training/velodyne" / f"{name}.bin")
        points = points[np.isfinite(points).all(axis=1)]
        unknown = np.full((SURFACE.height, SURFACE.width), IGNORE, np.uint8)
        scans.append(LabelledScan(points, np.full(len(points), IGNORE, np.uint8), (), (), unknown))
    return scans


def pseudo_labelled(network: nn.Module, scans: Iterable[LabelledScan], sure: float = SURE) -> list[LabelledScan]:
    """The scans with labels all around: their own where they have one, else the network's where it is sure."""
    projector = make_projector(RANGE_IMAGE, RANGE_IMAGE_INPUT)
    network.eval()
    done = []
    for scan in tqdm(list(scans), desc="labelling", leave=False):
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
def taught(network: nn.Module, image: Tensor, kind: str, *, mirror: bool) -> tuple[Tensor, Tensor | None]:
    """What a network says of a batch of inputs: class probabilities (B, C, H, W), and boxes where it finds any.

    With ``mirror`` the probabilities are an average over the scene and its mirror image. ``kind`` is the network's
    name; the y of those that label points changes its sign in a mirror.
    """
    with torch.autocast(image.device.type, torch.bfloat16):
        answer = network(image)
        logits, boxes = answer if isinstance(answer, tuple) else (answer, None)
        p = logits.float().softmax(1)
        if mirror:
            mirrored = image.flip(-1)
            if kind in LABELS_POINTS:
                mirrored = mirrored.clone()
                mirrored[:, RANGE_IMAGE_INPUT.channels.index("y")] *= -1.0
            answer = network(mirrored)
            other = answer[0] if isinstance(answer, tuple) else answer
            p = 0.5 * (p + other.float().softmax(1).flip(-1))
    return p, boxes
