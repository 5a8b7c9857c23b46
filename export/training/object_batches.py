"""Batches of the object network's training samples: drawn by class, object and source, and augmented."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from edgeperc.inference.object_network import AGAIN
from edgeperc.objects.candidate_boxes import SCORE, decode_objects, footprints
from edgeperc.objects.crops import fill_features
from edgeperc.preprocess.remission import NO_REMISSION
from edgeperc.types.points import Floats, Floats32, Ints64, Mask, Points

from ..cards import OBJECT_CLASSES
from ..networks.objects import LEAST, ObjectNet, Parts, parts_of
from .object_samples import BACKGROUND, DETECTED, GROUP, N_STORED, TRUE, ObjectSamples
from .object_sets import SIMULATED, SPARSE, varied
from .object_task import VEHICLE, Objects

# Shares of the classes in a batch.
SHARES = {BACKGROUND: 0.45, 1: 0.26, 2: 0.08, 3: 0.04, 4: 0.09, 5: 0.07, VEHICLE: 0.01}
# Of an object of simulation, pasted into scans of a set other than KITTI, or thinned as well, for one of KITTI.
SIMULATED_WEIGHT, PASTED_WEIGHT, SPARSE_WEIGHT = 0.02, 0.5, 2.0
SIMULATED_BACKGROUND = 0.3  # of walls, hedges and halls there are many kinds; real scans show those of few streets
ALIKE = 0.5  # samples of one object count as this power of their number

DETECTED_BACKGROUND, TRUE_WEIGHT = 2.0, 1.5
# Standard deviations of the errors added to a candidate's middle, along and across [m], its heading [rad], and the
# logarithms of its sides, by origin; twice as large for `MORE_ERRORS` of the detected and the true boxes.
ERRORS = {GROUP: (0.1, 0.08, 0.08, 0.03), DETECTED: (0.22, 0.15, 0.08, 0.05), TRUE: (0.4, 0.25, 0.15, 0.1)}
PERSON_ERRORS = (0.25, 0.25, 0.8, 0.1)  # of true boxes of people
MORE_ERRORS = 0.25
PERSONS = [OBJECT_CLASSES.index(name) for name in ("pedestrian", "cyclist")]
FEWEST = 3
NOISE_M = 0.01
WATCHED_BATCH = 512


@dataclass
class Drawn:
    """Samples of a batch; fields as in `ObjectSamples`, with ``valid`` points (B, N_STORED)."""

    points: Points
    valid: Mask
    counts: Floats
    rectangles: Floats
    level: Floats
    origin: NDArray[np.int8]
    classes: NDArray[np.int8]
    truth: Floats

    @classmethod
    def of(cls, samples: ObjectSamples, chosen: Ints64) -> Drawn:
        counts = samples.counts[chosen]
        return cls(
            samples.points[chosen].astype(np.float32),
            np.arange(N_STORED) < counts[:, None],
            counts.astype(np.float64),
            samples.rectangles[chosen].astype(np.float64),
            samples.level[chosen].astype(np.float64),
            samples.origin[chosen],
            samples.classes[chosen],
            samples.truth[chosen].astype(np.float64),
        )

    def rows(self, chosen: slice | Mask) -> Drawn:
        """Some of the samples."""
        return Drawn(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def move(self, ahead: Floats, left: Floats, turn: Floats) -> None:
        """Move and turn each candidate by as much in its own frame; its points stay where they are."""
        cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
        dx, dy = self.points[:, :, 0] - ahead[:, None], self.points[:, :, 1] - left[:, None]
        self.points[:, :, 0], self.points[:, :, 1] = cos * dx + sin * dy, cos * dy - sin * dx
        yaw = self.rectangles[:, 4]
        self.rectangles[:, 0] += np.cos(yaw) * ahead - np.sin(yaw) * left
        self.rectangles[:, 1] += np.sin(yaw) * ahead + np.cos(yaw) * left
        self.rectangles[:, 4] += turn

    def in_frames(self, xy: Floats) -> Floats:
        """Places (B, 2) of the scan in the candidates' frames."""
        cos, sin = np.cos(self.rectangles[:, 4]), np.sin(self.rectangles[:, 4])
        dx, dy = (xy - self.rectangles[:, :2]).T
        return np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=1)

    def box_targets(self) -> Floats32:
        """x, y in the candidate's frame, bottom above its ground, length, width, height, yaw, (B, 7)."""
        bottom = self.truth[:, 2] - 0.5 * self.truth[:, 5] - self.level
        yaw = self.truth[:, 6] - self.rectangles[:, 4]
        columns = [*self.in_frames(self.truth[:, :2]).T, bottom, *self.truth[:, 3:6].T, yaw]
        return np.stack(columns, axis=1).astype(np.float32)


class ObjectBatches:
    """Batches of samples of named sources; ``simulated`` has the length of simulated scans, ``odds`` is empty.

    network : finds the boxes that are candidates again, as at the second look; it changes while it is trained.
    """

    n_targets = 2

    def __init__(self, task: Objects, samples: ObjectSamples, names: Sequence[str]) -> None:
        self.task, self.recipe, self.samples = task, task.recipe, samples
        self.network: ObjectNet | None = None
        of_simulation = (samples.classes == BACKGROUND) & (samples.sources == [*names, SIMULATED].index(SIMULATED))
        self.simulated = range(len(np.unique(samples.objects[of_simulation])))
        self.odds: dict[str, Floats] = {}
        self._sums = np.cumsum(_weights(samples, names))

    def batch(self, step: int) -> tuple[Tensor, Tensor, Tensor]:
        """Input (B, n_points, channels), classes (B,) and boxes (B, 7) of one step, the same for the same step."""
        rng = np.random.default_rng((self.recipe.seed, step))
        drawn = self._draw(rng)
        if self.network is not None and self.recipe.found_again > 0.0:
            found = found_again(self.task, self.network, self._draw(rng), rng)
            n = min(round(self.recipe.found_again * self.recipe.batch), len(found.counts))
            drawn = joined(drawn.rows(slice(self.recipe.batch - n)), found.rows(slice(n)))
        return tensors(self.task, drawn, rng)

    def _draw(self, rng: np.random.Generator) -> Drawn:
        chosen = np.searchsorted(self._sums, rng.random(self.recipe.batch) * self._sums[-1], side="right")
        drawn = Drawn.of(self.samples, np.minimum(chosen, len(self._sums) - 1))
        if self.recipe.augment:
            _augment(drawn, rng)
        return drawn


def _of_source(name: str) -> float:
    """How often an object of a source counts, for one of KITTI."""
    if name == SIMULATED:
        return SIMULATED_WEIGHT
    weight = SPARSE_WEIGHT if name.endswith(f"-{SPARSE}") else 1.0
    return weight if name.startswith("kitti") or varied(name) == name else PASTED_WEIGHT * weight


def _weights(samples: ObjectSamples, names: Sequence[str]) -> Floats:
    """How often each sample is drawn: by class; within it by object, once each, and by source."""
    of_source = np.array([_of_source(name) for name in names])
    of_background = np.where(np.array(names) == SIMULATED, SIMULATED_BACKGROUND, of_source)
    _, inverse, n_alike = np.unique(samples.objects, return_inverse=True, return_counts=True)
    is_object = samples.classes != BACKGROUND
    weights = np.where(is_object, of_source[samples.sources], of_background[samples.sources])
    weights = np.where(is_object, weights * n_alike[inverse.ravel()] ** -ALIKE, weights)
    weights = np.where(is_object & (samples.origin == TRUE), TRUE_WEIGHT * weights, weights)
    weights = np.where(~is_object & (samples.origin == DETECTED), DETECTED_BACKGROUND * weights, weights)
    total = np.zeros_like(weights)
    for label, share in SHARES.items():
        own = samples.classes == label
        total[own] = share * weights[own] / max(weights[own].sum(), 1e-9)
    return total


def _augment(drawn: Drawn, rng: np.random.Generator) -> None:
    """Mirror, scale and thin the scan; move, turn and scale the candidate; change the remission."""
    n = len(drawn.counts)
    side = np.where(rng.random(n) < 0.5, -1.0, 1.0)
    scale = 1.0 + 0.05 * rng.uniform(-1.0, 1.0, n)
    points, rectangles, truth = drawn.points, drawn.rectangles, drawn.truth
    points[:, :, 1] *= side[:, None]
    points[:, :, :3] *= scale[:, None, None].astype(np.float32)
    for places in (rectangles, truth):
        places[:, 1] *= side
        places[:, -1] *= side
    rectangles[:, :4] *= scale[:, None]
    truth[:, :6] *= scale[:, None]
    drawn.level *= scale
    # The candidate's errors
    errors = np.array([ERRORS[origin] for origin in (GROUP, DETECTED, TRUE)])[drawn.origin]
    errors[(drawn.origin != GROUP) & (rng.random(n) < MORE_ERRORS)] *= 2.0
    errors[(drawn.origin == TRUE) & np.isin(drawn.classes, PERSONS)] = PERSON_ERRORS
    ahead, left, turn = (errors[:, :3] * rng.standard_normal((n, 3))).T
    turn += np.where(rng.random(n) < 0.5, math.pi, 0.0)
    drawn.move(ahead, left, turn)
    rectangles[:, 2:4] *= np.exp(errors[:, 3:] * rng.standard_normal((n, 2)))
    raised = 0.05 * rng.standard_normal(n)  # an error of the ground
    points[:, :, 2] += raised[:, None].astype(np.float32)
    drawn.level -= raised
    # Fewer points, as of another sensor or farther away
    kept = np.where(rng.random(n) < 0.5, rng.uniform(0.15, 1.0, n), 1.0)
    thinned = drawn.valid & (rng.random(drawn.valid.shape) < kept[:, None])
    enough = thinned.sum(axis=1) >= FEWEST
    drawn.valid = np.where(enough[:, None], thinned, drawn.valid)
    drawn.counts *= np.where(enough, kept, 1.0)
    points[:, :, :3] += (NOISE_M * rng.standard_normal((*points.shape[:2], 3), np.float32)).astype(np.float32)
    gain = np.exp(0.3 * rng.standard_normal(n)).astype(np.float32)
    points[:, :, 3] = np.minimum(points[:, :, 3] * gain[:, None], 1.0)
    points[rng.random(n) < 0.1, :, 3] = NO_REMISSION.coefficients[0]


@torch.no_grad()
def found_again(task: Objects, network: ObjectNet, drawn: Drawn, rng: np.random.Generator) -> Drawn:
    """The boxes that a network finds at candidates, seen from either end, as candidates of the second look: each stage
    of a cascade learns from what the one before finds (Cai and Vasconcelos, 2018, section 4).
    """
    device = next(network.parameters()).device
    outputs = network.closely(tensors(task, drawn, rng)[0].to(device)).float().cpu().numpy()
    boxes = decode_objects(task.card, outputs, drawn.rectangles, drawn.level)
    found = boxes[:, SCORE] >= AGAIN
    drawn, places = drawn.rows(found), footprints(boxes[found])
    ends = np.where(rng.random(len(places)) < 0.5, math.pi, 0.0)
    ahead, left = drawn.in_frames(places[:, :2]).T
    drawn.move(ahead, left, places[:, 4] - drawn.rectangles[:, 4] + ends)
    drawn.rectangles[:, 2:4] = places[:, 2:4]
    return drawn


def joined(first: Drawn, second: Drawn) -> Drawn:
    """Samples of two draws."""
    return Drawn(*(np.concatenate([getattr(part, field.name) for part in (first, second)]) for field in fields(Drawn)))


def tensors(task: Objects, drawn: Drawn, rng: np.random.Generator | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """The network's input and targets of samples; the points are drawn at random, without ``rng`` evenly."""
    view, n_slots = task.view, task.view.n_points
    along, across = 0.5 * drawn.rectangles[:, 2:4].T + view.margin_m
    near = (
        drawn.valid
        & (np.abs(drawn.points[:, :, 0]) < along[:, None])
        & (np.abs(drawn.points[:, :, 1]) < across[:, None])
    )
    n_near = near.sum(axis=1)
    near |= (n_near == 0)[:, None] & drawn.valid
    n_near = np.maximum(near.sum(axis=1), 1)
    first = np.where(near, rng.random(near.shape) if rng is not None else np.arange(near.shape[1]) / near.shape[1], 2.0)
    order = np.argsort(first, axis=1)
    slots = np.arange(n_slots)[None, :]
    if rng is not None:
        slots = slots % np.minimum(n_near, near.shape[1])[:, None]
    else:
        slots = np.where(n_near[:, None] > n_slots, slots * n_near[:, None] // n_slots, slots % n_near[:, None])
    rows = np.take_along_axis(order, slots, axis=1)
    points = np.take_along_axis(drawn.points, rows[:, :, None], axis=1)
    stored = np.maximum(np.minimum(drawn.counts, drawn.valid.sum(axis=1)), 1.0)
    counts = np.maximum(n_near * drawn.counts / stored, 1.0).astype(np.int32)
    spec = task.input
    features = np.empty((*points.shape[:2], len(spec.channels)), np.float32)
    scale = np.array([spec.mean, spec.std], np.float32)
    fill_features(np.ascontiguousarray(points), counts, drawn.rectangles, scale, features)
    labels = torch.from_numpy(drawn.classes.astype(np.int64))
    return torch.from_numpy(features), labels, torch.from_numpy(drawn.box_targets())


class ObjectWatch:
    """Validates the network on samples that it is not trained on, without true boxes as candidates."""

    def __init__(self, task: Objects, samples: ObjectSamples) -> None:
        kept = np.flatnonzero((samples.origin == GROUP) | ((samples.origin == DETECTED) & (samples.classes > 0)))
        self.task = task
        self._batches = [
            tensors(task, Drawn.of(samples, kept[first : first + WATCHED_BATCH]))
            for first in range(0, len(kept), WATCHED_BATCH)
        ]

    @torch.no_grad()
    def validate(self, network: nn.Module) -> tuple[float, float, dict[str, float | None]]:
        """Mean overlap in space of the boxes of all classes, mean loss, and recall, overlap and precision by name."""
        losses, right, overlaps = [], [], []
        device = next(network.parameters()).device
        for batch in self._batches:
            x, labels, boxes = (part.to(device) for part in batch)
            outputs = network(x)
            losses.append(float(self.task.loss(outputs, (labels, boxes))))
            parts = parts_of(outputs[0], len(self.task.classes))
            right.append(torch.stack([labels, parts.classes.argmax(1), (outputs[1] >= LEAST).long()]))
            known = labels > 0
            own = Parts(*(part[known] for part in parts))
            overlaps.append(torch.stack([labels[known].float(), self.task._overlaps(own, labels[known], boxes[known])]))
        true, found, close = torch.cat(right, dim=1).cpu().numpy()
        kinds, iou = torch.cat(overlaps, dim=1).cpu().numpy()
        figures: dict[str, float | None] = {}
        for k, name in enumerate(self.task.classes[1:], start=1):
            if (true == k).any():
                figures[name] = round(float((found == k)[true == k].mean()), 4)
                figures[f"{name} IoU"] = round(float(iou[kinds == k].mean()), 4)
        figures["objects looked at"] = round(float(close[true != 0].mean()), 4) if (true != 0).any() else None
        figures["background looked at"] = round(float(close[true == 0].mean()), 4) if (true == 0).any() else None
        figures["car IoU 0.7"] = round(float((iou[kinds == 1] > 0.7).mean()), 4) if (kinds == 1).any() else None
        figures["precision"] = round(float((true != 0)[found != 0].mean()), 4) if (found != 0).any() else None
        decisive = [value for name, value in figures.items() if name.endswith(" IoU") and value is not None]
        return float(np.mean(decisive)), float(np.mean(losses)), figures
