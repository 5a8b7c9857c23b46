"""One visible training loop for both networks.

Every step draws its samples and its dropout from ``(seed, step)`` alone, so that a run stopped anywhere and resumed
from its checkpoint ends, bit for bit, where an uninterrupted one ends.
"""

from __future__ import annotations

import copy
import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm import tqdm

from edgeperc.card import InputSpec, RangeImageGeometry, TopViewGeometry
from edgeperc.projection import make_projector
from edgeperc.sensors import get_sensor
from edgeperc.simulation import TOP_VIEW_CLASSES

from .augment import LabelledScan, augmented
from .kitti import IGNORE, KittiObjects
from .losses import dense_targets, pointseg_loss, slot_targets, ssadnet_loss
from .networks.pointseg import PointSeg
from .networks.ssadnet import SSADNet
from .road import sure_surface

TOP_VIEW = TopViewGeometry()
RANGE_IMAGE = RangeImageGeometry(get_sensor("hdl-64e").elevations_deg)
# SSADNet 2.1.2 scales every channel to its range; the farthest corner of the view is 47.07 m away.
TOP_VIEW_INPUT = InputSpec("top_view", ("distance", "remission", "height"), (0.0, 0.0, -2.5), (47.07, 1.0, 5.0))
# Means and deviations of the returns in the front 90 degrees of 27 training scans.
RANGE_IMAGE_INPUT = InputSpec(
    "range_image",
    ("x", "y", "z", "remission", "range"),
    (12.95, 0.0, -1.31, 0.234, 14.51),
    (11.35, 7.86, 0.82, 0.148, 12.27),
)

# Three returns are the fewest that any network could tell from clutter.
FEWEST = 3
N_SLOTS = 16
# Vehicles are 4 % of the labelled pixels, pedestrians and cyclists 0.2 %.
POINT_WEIGHTS = (1.0, 2.0, 8.0, 8.0)
TOP_VIEW_WEIGHTS = (1.0, 1.0, 2.0, 4.0, 4.0)
# The dense head's loss is a sum a box, ten times the segmentation's per pixel.
LW_DET_DENSE = 0.2


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a training run.

    Attributes
    ----------
    network : str
        ``"ssadnet"`` or ``"pointseg"``.
    head : str
        SSADNet's boxes: ``"slots"`` (the paper's) or ``"dense"``.
    steps, batch : int
    learning_rate, weight_decay : float
        Of AdamW; warmed up over 5 % of the steps, then a cosine to zero.
    simulated_share : float
        Part of the samples that are simulated; what is left is real.
    ema : float
        Decay of the averaged weights, which are what is exported.
    context_width : int
        Channels of SSADNet's context module.
    seed : int
    """

    network: str
    head: str = "dense"
    steps: int = 2000
    batch: int = 8
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    simulated_share: float = 0.6
    ema: float = 0.995
    context_width: int = 128
    seed: int = 0


def build(recipe: Recipe) -> nn.Module:
    """The network of a recipe, its weights drawn from the recipe's seed."""
    torch.manual_seed(recipe.seed)
    if recipe.network == "pointseg":
        return PointSeg()
    if recipe.network == "ssadnet":
        return SSADNet(head=recipe.head, context_width=recipe.context_width)
    raise ValueError(f"network is {recipe.network!r}; expected ssadnet or pointseg")


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
        view = (RANGE_IMAGE, RANGE_IMAGE_INPUT) if recipe.network == "pointseg" else (TOP_VIEW, TOP_VIEW_INPUT)
        self.projector = make_projector(*view)
        weights = np.asarray(real_weights, np.float64)
        self.real_odds = weights / weights.sum() if len(weights) else weights
        share = recipe.simulated_share if real else 1.0
        self.simulated_share = share if simulated else 0.0

    def batch(self, step: int) -> tuple[NDArray, ...]:
        """Inputs (B, C, H, W) and targets of one step; the same for the same step, always."""
        rng = np.random.default_rng((self.recipe.seed, step))
        drawn = [self._sample(augmented(self._scan(rng), rng)) for _ in range(self.recipe.batch)]
        return tuple(np.stack(parts) for parts in zip(*drawn, strict=True))

    def _scan(self, rng: np.random.Generator) -> LabelledScan:
        if rng.random() < self.simulated_share:
            return LabelledScan.load(self.simulated[rng.integers(len(self.simulated))])
        return self.real[rng.choice(len(self.real), p=self.real_odds)]

    def _sample(self, scan: LabelledScan) -> tuple[NDArray, ...]:
        """One input (C, H, W) and its targets."""
        points = np.ascontiguousarray(scan.points, np.float32)
        if self.recipe.network == "pointseg":
            seen = self.projector.project(points)
            truth = np.where(seen.index >= 0, scan.labels[seen.index], IGNORE).astype(np.uint8)
            return seen.image, truth
        seen = self.projector.project(points)
        truth = scan.top_view_truth(TOP_VIEW)
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


def loss_of(recipe: Recipe, outputs: Tensor | tuple[Tensor, Tensor], targets: Sequence[Tensor]) -> Tensor:
    """The loss of a recipe."""
    if recipe.network == "pointseg":
        weights = torch.tensor(POINT_WEIGHTS, device=targets[0].device)
        return pointseg_loss(outputs, targets[0], weights, lovasz_weight=1.0)
    weights = torch.tensor(TOP_VIEW_WEIGHTS, device=targets[0].device)
    lw_det = LW_DET_DENSE if recipe.head == "dense" else 0.1
    return ssadnet_loss(*outputs, *targets, lw_det=lw_det, class_weights=weights)[0]


def real_scans(kitti: KittiObjects, names: Sequence[str]) -> tuple[list[LabelledScan], list[float], dict[str, str]]:
    """Labelled scans, how often to draw each, and the SHA-256 of each file."""
    scans, weights, hashes = [], [], {}
    frames = [kitti.frame(n) for n in tqdm(names, desc="reading real scans", leave=False)]
    drives = [f.drive for f in frames]
    for frame in frames:
        scans.append(LabelledScan.from_frame(frame, sure_surface))
        # A drive counts with the square root of its frames: 154 neighbours are not 154 scenes.
        weights.append(drives.count(frame.drive) ** -0.5)
        hashes[frame.name] = hashlib.sha256(frame.points.tobytes()).hexdigest()[:16]
    return scans, weights, hashes


def train(
    recipe: Recipe,
    out: Path,
    *,
    kitti: Path | None,
    simulated: Path | None,
    start_from: Path | None = None,
    n_threads: int | None = None,
    checkpoint_every: int = 100,
) -> Path:
    """Train, or go on training, the network of a recipe.

    Parameters
    ----------
    recipe : Recipe
    out : Path
        Folder for ``checkpoint.pt`` and ``log.jsonl``. A checkpoint already there, of the same recipe, is resumed.
    kitti : Path or None
        Root of a KITTI object set; frames of validation drives are left out.
    simulated : Path or None
        Folder of scans from ``edgeperc-export simulate``.
    start_from : Path or None
        A checkpoint whose weights a new run starts from.
    n_threads : int or None
    checkpoint_every : int
        Steps between checkpoints.

    Returns
    -------
    Path
        Of the last checkpoint.
    """
    out.mkdir(parents=True, exist_ok=True)
    if n_threads is not None:
        torch.set_num_threads(n_threads)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    objects = KittiObjects(kitti) if kitti else None
    real, weights, hashes = real_scans(objects, objects.names("train", grades="A")) if objects else ([], [], {})
    samples = Samples(recipe, real, weights, sorted(simulated.glob("*.npz")) if simulated else [])

    network = build(recipe)
    before: list[dict[str, object]] = []
    if start_from is not None:
        state = torch.load(start_from, weights_only=True)
        network.load_state_dict(state["averaged"])
        before = [*json.loads(state["before"]), json.loads(state["recipe"])]
    network = network.to(device, memory_format=torch.channels_last)
    averaged = copy.deepcopy(network).eval()
    decayed = [p for p in network.parameters() if p.ndim > 1]
    kept = [p for p in network.parameters() if p.ndim <= 1]
    optimizer = torch.optim.AdamW(
        [{"params": decayed, "weight_decay": recipe.weight_decay}, {"params": kept, "weight_decay": 0.0}],
        lr=recipe.learning_rate,
    )
    checkpoint, step = out / "checkpoint.pt", 0
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True, map_location=device)
        if json.loads(state["recipe"]) != asdict(recipe):
            raise ValueError(f"{checkpoint} is of another recipe: {state['recipe']}; train into an empty folder")
        before = json.loads(state["before"])
        network.load_state_dict(state["network"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
        step = state["step"]

    def save() -> None:
        aside = checkpoint.with_suffix(".tmp")
        torch.save(
            {
                "recipe": json.dumps(asdict(recipe)),
                "before": json.dumps(before),
                "step": step,
                "network": network.state_dict(),
                "averaged": averaged.state_dict(),
                "optimizer": optimizer.state_dict(),
                "frames": json.dumps(hashes),
                "n_simulated": len(samples.simulated),
            },
            aside,
        )
        aside.replace(checkpoint)

    progress = tqdm(total=recipe.steps, initial=step, desc=recipe.network, unit="step")
    with (out / "log.jsonl").open("a") as log, progress:
        started = time.monotonic()
        for inputs, *targets in _ahead(samples, step, recipe.steps):
            for group in optimizer.param_groups:
                group["lr"] = recipe.learning_rate * _schedule(step, recipe.steps)
            torch.manual_seed((recipe.seed << 32) + step)
            x = torch.from_numpy(inputs).to(device, memory_format=torch.channels_last)
            y = [torch.from_numpy(t).to(device) for t in targets]
            network.train()
            with torch.autocast(device.type, torch.bfloat16):
                outputs = network(x)
            loss = loss_of(recipe, outputs, y)
            if not torch.isfinite(loss):
                raise FloatingPointError(f"the loss is {loss.item()} at step {step}; lower --learning-rate")
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimizer.step()
            step += 1
            _average(averaged, network, min(recipe.ema, (1 + step) / (10 + step)))
            progress.update()
            progress.set_postfix(loss=f"{loss.item():.3f}")
            if step % 10 == 0:
                line = {"step": step, "loss": round(loss.item(), 5), "s": round(time.monotonic() - started, 1)}
                log.write(json.dumps(line) + "\n")
                log.flush()
            if step % checkpoint_every == 0 or step == recipe.steps:
                save()
    return checkpoint


def _ahead(samples: Samples, start: int, stop: int) -> Iterator[tuple[NDArray, ...]]:
    """Batches, the next one made while the last one is learnt from."""
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(samples.batch, start) if start < stop else None
        for step in range(start, stop):
            assert coming is not None
            batch = coming.result()
            coming = pool.submit(samples.batch, step + 1) if step + 1 < stop else None
            yield batch


def _schedule(step: int, steps: int) -> float:
    warm = max(1, steps // 20)
    if step < warm:
        return (step + 1) / warm
    return float(0.5 * (1.0 + np.cos(np.pi * (step - warm) / max(1, steps - warm))))


@torch.no_grad()
def _average(averaged: nn.Module, network: nn.Module, decay: float) -> None:
    for slow, fast in zip(averaged.state_dict().values(), network.state_dict().values(), strict=True):
        if slow.dtype.is_floating_point:
            slow.lerp_(fast, 1.0 - decay)
        else:
            slow.copy_(fast)
