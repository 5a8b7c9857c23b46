"""Training samples: scans drawn, augmented and projected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from edgeperc.evaluation.datasets import KittiObjects, scan_hash
from edgeperc.projection import make_projector
from edgeperc.simulation.samples import IGNORE
from edgeperc.simulation.scene import TOP_VIEW_CLASSES

from .augment import ObjectBank, augmented, swapped
from .cards import RANGE_IMAGE, RANGE_IMAGE_INPUT, TOP_VIEW, TOP_VIEW_INPUT
from .recipe import Recipe
from .roads import drawn_roads, sure_surface, with_road
from .scans import LabelledScan
from .targets import dense_targets, slot_targets

__all__ = ["FEWEST", "RealScans", "Samples", "real_scans"]

# Three returns are the fewest that any network could tell from clutter.
FEWEST = 3
N_SLOTS = 16

# Scans whose objects are cut out for pasting; each holds about five.
BANK_SCANS = 400
PASTE_ODDS = {
    "points": {"pedestrian": 0.4, "cyclist": 0.35, "van": 0.15, "truck": 0.1},
    "top_view": {"car": 0.3, "van": 0.4, "truck": 0.3},
}


class Samples:
    """Real and simulated scans as network inputs and targets.

    Parameters
    ----------
    recipe : Recipe
    real : sequence of LabelledScan
    real_weights : sequence of float
        How often each real scan is drawn; frames of a long drive look alike and deserve less.
    simulated : sequence of Path
        Files that `LabelledScan.save` wrote.
    """

    def __init__(
        self, recipe: Recipe, real: Sequence[LabelledScan], real_weights: Sequence[float], simulated: Sequence[Path]
    ) -> None:
        if not real and not simulated:
            raise ValueError("no scans to train on; give --kitti, --simulated or both")
        self.recipe, self.real, self.simulated = recipe, real, simulated
        view = (RANGE_IMAGE, RANGE_IMAGE_INPUT) if recipe.labels_points else (TOP_VIEW, TOP_VIEW_INPUT)
        self.projector = make_projector(*view)
        weights = np.asarray(real_weights, np.float64)
        self.real_odds = weights / weights.sum() if len(weights) else weights
        share = recipe.simulated_share if real else 1.0
        self.simulated_share = share if simulated else 0.0
        self.bank: ObjectBank | None = None
        if recipe.n_pasted > 0.0:
            every = max(1, len(simulated) // BANK_SCANS)
            self.bank = ObjectBank.of([*real, *(LabelledScan.load(path) for path in simulated[::every])])

    def batch(self, step: int) -> tuple[NDArray, ...]:
        """Inputs (B, C, H, W) and targets of one step; the same for the same step, always."""
        rng = np.random.default_rng((self.recipe.seed, step))
        drawn = [self.sample(self._drawn(rng)) for _ in range(self.recipe.batch)]
        return tuple(np.stack(parts) for parts in zip(*drawn, strict=True))

    def _drawn(self, rng: np.random.Generator) -> LabelledScan:
        recipe = self.recipe
        scan = self._scan(rng)
        if not recipe.augment:
            return scan
        odds = PASTE_ODDS["points" if recipe.labels_points else "top_view"]
        if recipe.paste_cars > 0.0:
            others = {name: share * (1.0 - recipe.paste_cars) for name, share in odds.items()}
            odds = {**others, "car": recipe.paste_cars}
        changes = {
            "bank": self.bank,
            "n_pasted": recipe.n_pasted,
            "odds": odds,
            "turn_to_rare": recipe.turn_to_rare,
            "turn_anywhere": recipe.turn_anywhere,
            "weather": recipe.weather,
        }
        scan = augmented(scan, rng, **changes)
        if recipe.labels_points and rng.random() < recipe.swap:
            scan = swapped(scan, augmented(self._scan(rng), rng, **changes), rng)
        return scan

    def _scan(self, rng: np.random.Generator) -> LabelledScan:
        if rng.random() < self.simulated_share:
            return LabelledScan.load(self.simulated[rng.integers(len(self.simulated))])
        return self.real[rng.choice(len(self.real), p=self.real_odds)]

    def sample(self, scan: LabelledScan) -> tuple[NDArray, ...]:
        """One input (C, H, W) and its targets."""
        points = np.ascontiguousarray(scan.points, np.float32)
        if self.recipe.labels_points:
            seen = self.projector.project(points)
            truth = np.append(scan.labels, np.uint8(IGNORE))[seen.index]  # an empty pixel's index is -1
            return seen.image, truth
        seen = self.projector.project(points)
        truth = scan.top_view_truth(TOP_VIEW)
        if self.recipe.network == "lodnn":
            return seen.image, np.where(truth == IGNORE, IGNORE, truth == 1).astype(np.uint8)
        vehicles = [b for b in zip(scan.boxes, scan.counts, strict=True) if b[0].label in TOP_VIEW_CLASSES[2:]]
        found, unsure = (
            np.array([[*b.center, *b.size, b.yaw] for b, n in vehicles if (n >= FEWEST) == hit], np.float64)
            for hit in (True, False)
        )
        if self.recipe.head == "slots":
            boxes = slot_targets(found, TOP_VIEW, N_SLOTS)
        else:
            boxes = dense_targets(found, TOP_VIEW, labelled=scan.labelled(TOP_VIEW), unsure=unsure)
        return seen.image, truth, boxes


class RealScans(NamedTuple):
    """Real scans that somebody labelled otherwise than KITTI does, as with roads drawn by hand.

    Attributes
    ----------
    scans : list of LabelledScan
        To train on.
    hashes : dict of str to str
        The name of each and its `edgeperc.evaluation.datasets.scan_hash`, for the card.
    watched : list of LabelledScan
        To stop and to lower the learning rate by.
    """

    scans: list[LabelledScan]
    hashes: dict[str, str]
    watched: list[LabelledScan]


def real_scans(
    kitti: KittiObjects, names: Sequence[str], *, drawn: bool = False
) -> tuple[list[LabelledScan], list[float], dict[str, str]]:
    """Labelled scans, how often to draw each, and the SHA-256 of each file; ``drawn``: with roads drawn by hand."""
    scans, weights, hashes = [], [], {}
    roads = drawn_roads() if drawn else {}
    frames = [kitti.frame(n) for n in tqdm(names, desc="reading real scans", leave=False)]
    drives = [f.drive for f in frames]
    for frame in frames:
        scan = LabelledScan.from_frame(frame, sure_surface)
        hashes[frame.name] = digest = scan_hash(frame.points)
        if digest in roads:
            scan = replace(scan, surface=with_road(scan.surface, roads[digest]))
        scans.append(scan)
        # A drive counts with the square root of its frames: 154 neighbours are not 154 scenes. A drawn road counts
        # as a drive of its own, for its truth is whole.
        weights.append(1.0 if digest in roads else drives.count(frame.drive) ** -0.5)
    return scans, weights, hashes
