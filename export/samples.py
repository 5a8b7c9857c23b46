"""Training samples: scans drawn at random, augmented and projected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from edgeperc.evaluation.datasets import KittiObjects, scan_hash
from edgeperc.projection import Projection, make_projector

from .augment import ObjectBank, augmented, swapped
from .recipe import Recipe
from .roads import drawn_roads, sure_surface, with_road
from .scans import LabeledScan
from .task import Targets, task_of

__all__ = ["RealScans", "Samples", "real_scans"]

# Scans whose objects are cut out for pasting; each holds about five.
BANK_SCANS = 400


class Samples:
    """Network inputs and targets, from real and simulated scans.

    Parameters
    ----------
    recipe : Recipe
    real : sequence of LabeledScan
    real_weights : sequence of float
        How often each real scan is drawn, relative to the others.
    simulated : sequence of Path
        Files written by `LabeledScan.save`.

    Raises
    ------
    ValueError
        There are neither real nor simulated scans.
    """

    def __init__(
        self, recipe: Recipe, real: Sequence[LabeledScan], real_weights: Sequence[float], simulated: Sequence[Path]
    ) -> None:
        if not real and not simulated:
            raise ValueError("no scans to train on; give --kitti, --simulated or both")
        self.task, self.recipe = task_of(recipe), recipe
        self.real, self.simulated = real, simulated
        self.projector = make_projector(self.task.view, self.task.input)
        weights = np.asarray(real_weights, np.float64)
        self.real_odds = weights / weights.sum() if len(weights) else weights
        share = recipe.simulated_share if real else 1.0
        self.simulated_share = share if simulated else 0.0
        self.bank: ObjectBank | None = None
        if recipe.n_pasted > 0.0:
            stride = max(1, len(simulated) // BANK_SCANS)
            self.bank = ObjectBank.of([*real, *(LabeledScan.load(path) for path in simulated[::stride])])

    def batch(self, step: int) -> Targets:
        """Inputs (B, C, H, W) float32 and targets of one step. The same step always gives the same batch."""
        rng = np.random.default_rng((self.recipe.seed, step))
        drawn = [self.sample(self._drawn(rng)) for _ in range(self.recipe.batch)]
        return tuple(np.stack(parts) for parts in zip(*drawn, strict=True))

    def project(self, scan: LabeledScan) -> Projection:
        """A scan projected into the network's view."""
        return self.projector.project(np.ascontiguousarray(scan.points, np.float32))

    def sample(self, scan: LabeledScan) -> Targets:
        """One input (C, H, W) float32 and its targets."""
        projected = self.project(scan)
        return projected.image, *self.task.target(scan, projected)

    def _drawn(self, rng: np.random.Generator) -> LabeledScan:
        recipe, odds = self.recipe, dict(self.task.paste_odds)
        scan = self._scan(rng)
        if not recipe.augment:
            return scan
        if recipe.paste_cars > 0.0:
            others = {name: share * (1.0 - recipe.paste_cars) for name, share in odds.items()}
            odds = {**others, "car": recipe.paste_cars}
        change = partial(
            augmented,
            rng=rng,
            bank=self.bank,
            n_pasted=recipe.n_pasted,
            odds=odds,
            turn_to_rare=recipe.turn_to_rare,
            turn_anywhere=recipe.turn_anywhere,
            weather=recipe.weather,
        )
        scan = change(scan)
        if self.task.swaps_sectors and rng.random() < recipe.swap:
            scan = swapped(scan, change(self._scan(rng)), rng)
        return scan

    def _scan(self, rng: np.random.Generator) -> LabeledScan:
        if rng.random() < self.simulated_share:
            return LabeledScan.load(self.simulated[int(rng.integers(len(self.simulated)))])
        return self.real[int(rng.choice(len(self.real), p=self.real_odds))]


class RealScans(NamedTuple):
    """Real scans with labels that are not in KITTI's files, for instance hand-drawn roads.

    Attributes
    ----------
    scans : list of LabeledScan
        Scans to train on.
    hashes : dict of str to str
        Name of each scan -> its `edgeperc.evaluation.datasets.scan_hash`, for the card.
    watched : list of LabeledScan
        Scans to validate on.
    """

    scans: list[LabeledScan]
    hashes: dict[str, str]
    watched: list[LabeledScan]


def real_scans(
    kitti: KittiObjects, names: Sequence[str], *, drawn: bool = False
) -> tuple[list[LabeledScan], list[float], dict[str, str]]:
    """Read labeled scans of KITTI.

    Parameters
    ----------
    kitti : KittiObjects
    names : sequence of str
    drawn : bool
        Replace the ground truth by the hand-drawn road where a scan has one.

    Returns
    -------
    scans : list of LabeledScan
    weights : list of float
        How often to draw each scan, relative to the others.
    hashes : dict of str to str
        Name of each scan -> its `edgeperc.evaluation.datasets.scan_hash`.
    """
    scans: list[LabeledScan] = []
    weights: list[float] = []
    hashes: dict[str, str] = {}
    roads: dict[str, NDArray[np.uint8]] = drawn_roads() if drawn else {}
    frames = [kitti.frame(name) for name in tqdm(names, desc="reading real scans", leave=False)]
    drives = [frame.drive for frame in frames]
    for frame in frames:
        scan = LabeledScan.from_frame(frame, sure_surface)
        hashes[frame.name] = digest = scan_hash(frame.points)
        if digest in roads:
            scan = replace(scan, surface=with_road(scan.surface, roads[digest]))
        scans.append(scan)
        # The weight of a drive is the square root of its number of frames, because neighboring frames look alike (a
        # drive has up to 154). A scan with a drawn road weighs as much as a drive with one frame, because its ground is
        # known everywhere.
        weights.append(1.0 if digest in roads else drives.count(frame.drive) ** -0.5)
    return scans, weights, hashes
