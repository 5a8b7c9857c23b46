"""Training samples: scans drawn at random, augmented and projected, in worker processes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader
from tqdm import tqdm

from edgeperc.datasets.kitti import KittiObjects, scan_hash
from edgeperc.datasets.layout import numbers_of_scene, tells_parts
from edgeperc.inference.projection import make_projector
from edgeperc.simulation.samples import IGNORE
from edgeperc.simulation.scene import POINT_CLASSES
from edgeperc.types.points import Bytes

from ..data.augment import NEGATIVES, Augmentation, ObjectBank, augmented, swapped, with_ground_ahead
from ..data.beams import drawn_sensor
from ..data.processes import CONTEXT
from ..data.roads import drawn_roads, sure_surface, with_road
from ..data.scan_sets import Labeled, seen_by_network
from ..data.scans import LabeledScan
from ..recipe import Recipe
from .ranks import Ranks
from .task import Targets, task_of
from .teacher import OnnxTeacher

# Scans whose objects are cut out for pasting; each holds about five.
BANK_SCANS = 400
# How often an object of a class of one's own is pasted; those of `Task.paste_odds` have a sum of 1.
OWN_ODDS = 0.2
# Scans of each kind, real and simulated, that are labeled to find those with false objects, and how much more or less
# often one of them is drawn than by its weight alone.
REDRAWN_SCANS = 64
REDRAW_FACTORS = (0.5, 3.0)
# Samples that are kept to be used again: 1 MB each.
RECENT_SAMPLES = 2048


class Samples:
    """Network inputs and targets, from real scans, drawn by their weights and ``odds``, and files of simulated ones; a
    batch has the input, ``n_targets`` targets, and the teacher's answers. Raises ValueError without scans.
    """

    def __init__(
        self,
        recipe: Recipe,
        real: Sequence[LabeledScan],
        real_weights: Sequence[float],
        simulated: Sequence[Path],
        teacher: OnnxTeacher | None = None,
        n_workers: int = 0,
    ) -> None:
        if not real and not simulated:
            raise ValueError("no scans to train on; give --kitti, --scans, --simulated or several of them")
        self.task, self.recipe, self.teacher = task_of(recipe), recipe, teacher
        self.n_targets = len(self.task.card.outputs)
        self.real = [*real] if "road" in self.task.classes else [with_ground_ahead(scan) for scan in real]
        self.simulated = simulated
        self.projector = make_projector(self.task.view, self.task.input)
        self.weights = {"real": np.asarray(real_weights, np.float64), "simulated": np.ones(len(simulated))}
        self.odds = {name: np.ones(len(weights)) for name, weights in self.weights.items()}
        share = recipe.simulated_share if real else 1.0
        self.simulated_share = share if simulated else 0.0
        self._numbers = numbers_of_scene(recipe.classes or POINT_CLASSES)
        self.paste_odds = dict(self.task.paste_odds)
        if recipe.paste_cars > 0.0:
            others = {name: share * (1.0 - recipe.paste_cars) for name, share in self.paste_odds.items()}
            self.paste_odds = {**others, "car": recipe.paste_cars}
        self.paste_odds |= {name: OWN_ODDS for name in recipe.classes[1:] if name not in POINT_CLASSES}
        # A top view's road goes on under a pole, but not through a wall.
        self.negatives = NEGATIVES if recipe.task == "points" else {"pole": 1.0}
        settings = {f.name: getattr(recipe, f.name) for f in fields(Augmentation) if hasattr(recipe, f.name)}
        self.augmentation = Augmentation(odds=self.paste_odds, negatives=self.negatives, **settings)
        self.bank: ObjectBank | None = None
        if max(recipe.n_pasted, recipe.n_negatives) > 0.0:
            stride = max(1, len(simulated) // BANK_SCANS)
            scans = [*self.real, *(self.load(k) for k in range(0, len(simulated), stride))]
            scans = tqdm(scans, desc="cutting out objects", leave=False)
            self.bank = ObjectBank.of(scans, classes=recipe.classes or POINT_CLASSES, n_workers=n_workers)

    def batch(self, step: int) -> Targets:
        """Inputs (B, C, H, W), targets and the teacher's answers of a step, the same for the same step and `odds`."""
        rng = np.random.default_rng((self.recipe.seed, step))
        drawn = []
        for _ in range(self.recipe.batch):
            scan = self._drawn(rng)
            drawn.append((*self.sample(scan), *(self.teacher(scan) if self.teacher else ())))
        return tuple(np.stack(parts) for parts in zip(*drawn, strict=True))

    __getitem__ = batch

    def sample(self, scan: LabeledScan) -> Targets:
        """One input (C, H, W) float32 and its targets."""
        scan, projected = seen_by_network(self.projector, scan)
        return projected.image, *self.task.target(scan, projected)

    @torch.no_grad()
    def redraw(self, network: nn.Module, step: int) -> None:
        """Label some scans by a network, and draw those with many false objects more often (`odds`)."""
        rng, device = np.random.default_rng((self.recipe.seed, step, 1)), next(network.parameters()).device
        objects = np.array([name not in ("background", "drivable") for name in self.task.classes])
        if not objects.any():
            objects[1:] = True  # of a network that labels nothing but road
        for name, odds in self.odds.items():
            chosen = rng.permutation(len(odds))[:REDRAWN_SCANS]
            false = np.zeros(len(chosen))
            for k, number in enumerate(chosen):
                image, truth, *_ = self.sample(self.real[number] if name == "real" else self.load(number))
                outputs = network(torch.from_numpy(image[None]).to(device))
                logits: Tensor = outputs[0] if isinstance(outputs, tuple) else outputs
                labels = logits[0].argmax(0).cpu().numpy()
                background = (truth != IGNORE) & ~objects[np.where(truth == IGNORE, 0, truth)]
                false[k] = np.count_nonzero(objects[labels] & background)
            if false.any():
                odds[chosen] = np.clip(false / false.mean(), *REDRAW_FACTORS)

    def _drawn(self, rng: np.random.Generator) -> LabeledScan:
        recipe = self.recipe
        scan = self._scan(rng)
        if not recipe.augment:
            return scan
        sensor = drawn_sensor(rng, sparse=recipe.sparse) if rng.random() < recipe.beams else None
        scan = augmented(scan, rng, self.augmentation, self.bank, sensor)
        if self.task.swaps_sectors and rng.random() < recipe.swap:
            other = augmented(self._scan(rng), rng, self.augmentation, self.bank, sensor)
            scan = swapped(scan, other, rng) if other.sensor == scan.sensor else scan
        return scan

    def _scan(self, rng: np.random.Generator) -> LabeledScan:
        name = "simulated" if rng.random() < self.simulated_share else "real"
        odds = self.weights[name] * self.odds[name]
        number = int(rng.choice(len(odds), p=odds / odds.sum()))
        return self.load(number) if name == "simulated" else self.real[number]

    def load(self, number: int) -> LabeledScan:
        """A simulated scan, labeled with the classes of the training."""
        scan = LabeledScan.load(self.simulated[number])
        return replace(scan, labels=self._numbers[scan.labels])


class Watch:
    """Validates a network on scans that are not in its training set, with the inputs and targets of ``samples``."""

    def __init__(self, samples: Samples, scans: Sequence[LabeledScan]) -> None:
        self.task, self.scans = samples.task, scans
        seen = [seen_by_network(samples.projector, scan) for scan in scans]
        self.projected = [projected for _, projected in seen]
        self.targets = [self.task.target(scan, projected) for scan, projected in seen]

    def validate(self, network: nn.Module) -> tuple[float, float, dict[str, float | None]]:
        """Validate a network: the decisive figure (`Tally.decisive`), the mean loss, and all figures by name."""
        losses, tally = [], self.task.tally()
        device = next(network.parameters()).device
        for scan, projected, targets in zip(self.scans, self.projected, self.targets, strict=True):
            with torch.no_grad():
                outputs = network(torch.from_numpy(projected.image[None]).to(device))
            batch = [torch.from_numpy(target[None]).to(device) for target in targets]
            losses.append(float(self.task.loss(outputs, batch)))
            self.task.count(outputs, projected, targets, scan, tally)
        return tally.decisive(), float(np.mean(losses)), tally.figures()


def loaded(
    samples: Samples, start: int, stop: int, n_workers: int, ranks: Ranks | None = None
) -> Iterator[list[Tensor]]:
    """The batches of steps, made ahead by processes (with 0 workers when they are asked for), by the ranks in turn.
    Processes start anew every ``redraw_every`` steps, to see the new odds. With ``reuse``, one batch in so many is new.
    """
    recipe = samples.recipe
    every, ranks = recipe.redraw_every or stop, ranks or Ranks()
    device = ranks.device
    recent = Recent(RECENT_SAMPLES)
    while start < stop:
        end = min(stop, start - start % every + every)
        steps = range(start, end, recipe.reuse)
        new: DataLoader[list[Tensor]] = DataLoader(
            samples,  # type: ignore[arg-type]  # it has __getitem__, which is all that is needed
            batch_size=None,
            sampler=steps[ranks.rank :: ranks.world],
            num_workers=n_workers,
            prefetch_factor=4 if n_workers else None,
            multiprocessing_context=CONTEXT if n_workers else None,
            pin_memory=device.type == "cuda",
        )
        own = iter(new)
        for number, step in enumerate(steps):
            maker, batch = number % ranks.world, None
            if maker == ranks.rank:
                batch = [part.to(device, non_blocking=True) for part in next(own)]
            batch = ranks.from_rank(maker, batch)
            yield batch
            if recipe.reuse > 1:
                recent.add(batch)
            for again in range(step + 1, min(step + recipe.reuse, end)):
                yield recent.draw(recipe.batch, torch.Generator().manual_seed((recipe.seed << 32) + again))
        start = end


class Recent:
    """The newest samples, at most so many, rounded up to whole batches."""

    def __init__(self, size: int) -> None:
        self._size, self._n_added, self._n_kept = size, 0, 0
        self._parts: list[Tensor] = []

    def add(self, batch: Sequence[Tensor]) -> None:
        """Keep a batch; the oldest one is dropped if there is no more room."""
        n = len(batch[0])
        n_batches = -(-self._size // n)
        if not self._parts:
            self._parts = [part.new_empty((n_batches * n, *part.shape[1:])) for part in batch]
        at = self._n_added % n_batches * n
        for kept, part in zip(self._parts, batch, strict=True):
            kept[at : at + n] = part
        self._n_added += 1
        self._n_kept = min(self._n_added, n_batches) * n

    def draw(self, n: int, generator: torch.Generator) -> list[Tensor]:
        """``n`` different samples, drawn at random."""
        chosen = torch.randperm(self._n_kept, generator=generator)[:n].to(self._parts[0].device)
        return [part[chosen] for part in self._parts]


def real_scans(
    kitti: KittiObjects, names: Sequence[str], *, drawn: bool = False, classes: Sequence[str] = ()
) -> Labeled:
    """Labeled scans of KITTI (``drawn``: with the hand-drawn roads), their weights, and their hashes by name."""
    labeled = Labeled([], [], {})
    numbers = numbers_of_scene(classes or POINT_CLASSES)
    numbers[0] = IGNORE if tells_parts(classes) else 0  # KITTI has boxes alone
    roads: dict[str, Bytes] = drawn_roads() if drawn else {}
    frames = [kitti.frame(name) for name in tqdm(names, desc="reading real scans", leave=False)]
    drives = [frame.drive for frame in frames]
    for frame in frames:
        scan = LabeledScan.from_frame(frame, sure_surface)
        scan = replace(scan, labels=numbers[scan.labels])
        labeled.hashes[frame.name] = digest = scan_hash(frame.points)
        if digest in roads:
            scan = replace(scan, surface=with_road(scan.surface, roads[digest]))
        labeled.scans.append(scan)
        # The weight of a drive is the square root of its number of frames, because neighboring frames look alike (a
        # drive has up to 154). A scan with a drawn road weighs as much as a drive with one frame, because its ground is
        # known everywhere.
        labeled.weights.append(1.0 if digest in roads else drives.count(frame.drive) ** -0.5)
    return labeled
