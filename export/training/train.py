"""The training loop of all networks.

Each step draws its samples and its dropout from ``(seed, step)`` alone. A run that is stopped and resumed from its
checkpoint therefore ends with the same weights, bit for bit, as an uninterrupted one.
"""

from __future__ import annotations

import copy
import json
import math
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from edgeperc.datasets.kitti import KittiObjects
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.simulation.scene import POINT_CLASSES
from edgeperc.system.atomic import open_atomic

from ..data.scan_sets import read_scan_set
from ..data.scans import LabeledScan
from ..networks import build
from ..recipe import Recipe
from .camera import Camera
from .checkpoint import build_network, read_checkpoint
from .images import ImageSamples, ImageWatch, camvid_samples
from .ranks import Ranks
from .samples import RealScans, Samples, loaded, real_scans
from .start import start
from .task import Task, task_of
from .teacher import OnnxTeacher, pseudo_labeled, teach, unlabeled_scans
from .watch import Watch

WARM_UP_STEPS = 100

# Of a drive with more frames than this, every sixth is enough to validate on, because neighboring frames look alike.
FEW_FRAMES = 6
VALIDATION_STRIDE = 6
# Batches that the statistics of batch norm are computed from, if a run starts from an exported model.
STATISTICS_BATCHES = 8


def train(
    recipe: Recipe,
    out: Path,
    *,
    kitti: Path | None,
    simulated: Path | None,
    camvid: Path | None = None,
    scan_sets: Sequence[ScanFolder] = (),
    given: RealScans | None = None,
    fold: int | None = None,
    start_from: Path | None = None,
    teacher: Path | None = None,
    n_threads: int | None = None,
    n_workers: int = 0,
    compiled: bool = False,
    checkpoint_every: int = 100,
    save_every_s: float = 0.0,
) -> Path:
    """Train the network of a recipe, or resume its training.

    Under ``torchrun`` the processes share each batch (`training.ranks`): the samples are the same, and the
    weights equal those of one process up to rounding. The first process writes the files; all read the checkpoint.

    out : folder for ``checkpoint.pt`` and ``log.jsonl``. A checkpoint of the same recipe in it is resumed.
    kitti : folder of a KITTI object set. Frames of test drives are not used; validation drives are for the curve
        only. With a ``simulated_share`` of 1, all training drives are for validation only.
    simulated : folder of scans written by ``edgeperc-export simulate``.
    camvid : folder of CamVid, for a camera's networks: they are trained on its training images, and the curve is of
        its validation images.
    scan_sets : more real scans, of any sensor; their drives for training are trained on, those for validation are
        watched.
    given : real scans in place of those of ``kitti``.
    fold : fold of the training drives to validate on instead of training on it. Every ``checkpoint_every`` steps the
        averaged network is evaluated on it, and the best weights are kept (early stopping).
    start_from : a checkpoint or an exported model (.onnx) whose weights a new run starts from. Weights that the
        networks do not share are ignored.
    teacher : a checkpoint or an exported model (.onnx) of the network to distil from. If the recipe does not distil:
        a checkpoint of a network that labels the unlabeled points of real scans.
    n_threads : number of CPU threads; None leaves it to torch.
    n_workers : number of processes that make the samples; 0: this one makes them between the steps. Each has one
        thread.
    compiled : use `torch.compile`, which takes a minute and a C++ compiler; PointSeg then trains a third faster.
    checkpoint_every : steps between checkpoints, and between points of the curve; an epoch if the recipe has a
        ``stop_after``.
    save_every_s : seconds between checkpoints, at least; the last one is always written. Large networks take seconds
        to write.
    Returns: The checkpoint.
    Raises ValueError, FloatingPointError, RankError.
    """
    ranks = Ranks()
    ranks.check(recipe.batch, recipe.accumulate, compiled)
    with ranks.together():
        return _train(
            recipe,
            out,
            ranks,
            kitti=kitti,
            simulated=simulated,
            camvid=camvid,
            scan_sets=scan_sets,
            given=given,
            fold=fold,
            start_from=start_from,
            teacher=teacher,
            n_threads=n_threads,
            n_workers=n_workers,
            compiled=compiled,
            checkpoint_every=checkpoint_every,
            save_every_s=save_every_s,
        )


def _train(
    recipe: Recipe,
    out: Path,
    ranks: Ranks,
    *,
    kitti: Path | None,
    simulated: Path | None,
    camvid: Path | None,
    scan_sets: Sequence[ScanFolder],
    given: RealScans | None,
    fold: int | None,
    start_from: Path | None,
    teacher: Path | None,
    n_threads: int | None,
    n_workers: int,
    compiled: bool,
    checkpoint_every: int,
    save_every_s: float,
) -> Path:
    """`train` in one of the ranks."""
    out.mkdir(parents=True, exist_ok=True)
    if n_threads is not None:
        torch.set_num_threads(n_threads)
    device = ranks.device
    torch.backends.cudnn.benchmark = True  # inputs have one size
    if recipe.task == "camera":
        data = _image_data(recipe, camvid, device)
    else:
        data = _scan_data(
            recipe, device, kitti, simulated, scan_sets, given=given, fold=fold, teacher=teacher, n_workers=n_workers
        )
    task, samples, watch, hashes = data.task, data.samples, data.watch, data.hashes
    teacher_network, n_real = data.teacher, data.n_real
    # Where no real scan or image is trained on, or other scans are given, the validation decides which step is best.
    stops = fold is not None or given is not None or recipe.simulated_share == 1.0 or recipe.stop_after > 0
    epoch = max(1, n_real // recipe.batch)
    if recipe.stop_after:
        checkpoint_every = epoch

    network = build(recipe)
    before: list[dict[str, Any]] = []
    checkpoint, step = out / "checkpoint.pt", 0
    if start_from is not None and not checkpoint.exists():
        images = [torch.as_tensor(samples.batch(k)[0]).cpu() for k in range(STATISTICS_BATCHES)]
        before, frames = start(network, recipe, start_from, images)
        hashes = frames | hashes
    network = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]  # not in its stubs
    ranks.share(network)
    averaged = copy.deepcopy(network).eval()
    optimizer = _optimizer(recipe, network)
    best, since_best, halvings = None, 0, 0
    best_figure, lowest_loss = -1.0, math.inf
    curve: list[dict[str, Any]] = []
    if checkpoint.exists():
        state = read_checkpoint(checkpoint, device)
        if state["recipe"] != recipe:
            raise ValueError(f"{checkpoint} is of another recipe: {state['recipe']}; give an empty folder")
        before, curve, hashes = state["before"], state["curve"], state["frames"]
        network.load_state_dict(state["network"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
        step, best = state["step"], state["best"]
        best_figure, lowest_loss, since_best, halvings = state["watched"]
        samples.odds = {name: odds.cpu().numpy() for name, odds in state["odds"].items()}

    def save() -> None:
        with open_atomic(checkpoint) as file:
            torch.save(
                {
                    "recipe": json.dumps(asdict(recipe)),
                    "before": json.dumps(before),
                    "step": step,
                    "network": network.state_dict(),
                    "averaged": averaged.state_dict(),
                    "best": best,
                    "watched": (best_figure, lowest_loss, since_best, halvings),
                    "optimizer": optimizer.state_dict(),
                    "curve": json.dumps(curve),
                    "frames": json.dumps(hashes),
                    "fold": -1 if fold is None else fold,
                    "n_simulated": len(samples.simulated),
                    "odds": {name: torch.from_numpy(odds) for name, odds in samples.odds.items()},
                },
                file,
            )

    # The compiled network shares its weights with the original, which is averaged and saved.
    forward = torch.compile(network) if compiled else network
    progress = tqdm(total=recipe.steps, initial=step, desc=recipe.network, unit="step", disable=not ranks.is_first)
    losses: list[float] = []
    saved_s = time.monotonic()
    with (out / "log.jsonl" if ranks.is_first else Path(os.devnull)).open("a") as log, progress:
        if isinstance(samples, ImageSamples):
            batches: Iterator[Sequence[Tensor]] = samples.batches(step, _last(recipe, curve, epoch))
        else:
            batches = loaded(samples, step, recipe.steps, n_workers, ranks)
        for arrays in batches:
            for group in optimizer.param_groups:
                group["lr"] = recipe.learning_rate * _schedule(recipe, step) * 0.5**halvings
            torch.manual_seed((recipe.seed << 32) + step)
            network.train()
            if recipe.head_only:
                network.segmentation.requires_grad_(False).eval()
            optimizer.zero_grad(set_to_none=True)
            total = torch.zeros((), device=device)
            for inputs, *others in zip(*(array.chunk(recipe.accumulate) for array in arrays), strict=True):
                x = ranks.part(inputs).contiguous(memory_format=torch.channels_last)
                y = others[: samples.n_targets]
                taught: tuple[Any, ...] = tuple(others[samples.n_targets :])
                with torch.autocast(device.type, torch.bfloat16):
                    outputs = ranks.whole(forward(x))
                loss = task.loss(outputs, y)
                if teacher_network is not None and recipe.distil > 0.0:
                    taught = ranks.whole(teach(teacher_network, x, task.input, mirror=recipe.seen_twice))
                if taught and isinstance(task, Task):
                    loss = loss + recipe.distil * task.distillation(outputs, *taught)
                loss = loss * (len(inputs) / len(arrays[0]))
                torch.autograd.backward(loss)
                total += loss.detach()
            ranks.add_gradients(network)
            losses.append(total.item())
            if not math.isfinite(losses[-1]):
                raise FloatingPointError(f"the loss is {losses[-1]} at step {step}; lower --learning-rate")
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimizer.step()
            step += 1
            _average(averaged, network, min(recipe.ema, (1 + step) / (10 + step)))
            progress.update()
            progress.set_postfix(loss=f"{losses[-1]:.3f}")
            if isinstance(samples, Samples) and recipe.redraw_every and step % recipe.redraw_every == 0:
                if ranks.is_first:
                    samples.redraw(averaged, step)
                samples.odds = ranks.from_first(samples.odds)
            if step % checkpoint_every == 0 or step == recipe.steps:
                line: dict[str, Any] = {"step": step, "samples": step * recipe.batch}
                line["loss"] = round(float(np.mean(losses)), 5)
                losses.clear()
                if watch is not None:
                    validated = watch.validate(averaged) if ranks.is_first else None
                    figure, watched_loss, figures = ranks.from_first(validated) or (0.0, 0.0, {})
                    line |= {"validation_loss": round(watched_loss, 5), "validation": figures}
                    if figure > best_figure and stops:
                        best_figure, best = figure, copy.deepcopy(averaged.state_dict())
                    since_best = 0 if watched_loss < lowest_loss else since_best + checkpoint_every
                    lowest_loss = min(lowest_loss, watched_loss)
                    if recipe.halve_after and since_best >= recipe.halve_after * epoch:
                        halvings, since_best = halvings + 1, 0
                curve.append(line)
                log.write(json.dumps(line) + "\n")
                log.flush()
                over = step >= _last(recipe, curve, epoch)
                if ranks.is_first and (over or time.monotonic() - saved_s >= save_every_s):
                    save()
                    saved_s = time.monotonic()
                if over:
                    break
    return checkpoint


class _Data(NamedTuple):
    """What a network is trained on and watched on."""

    task: Task | Camera
    samples: Samples | ImageSamples
    watch: Watch | ImageWatch | None
    hashes: dict[str, str]
    n_real: int
    teacher: nn.Module | None = None


def _image_data(recipe: Recipe, camvid: Path | None, device: torch.device) -> _Data:
    """The training images of CamVid; the validation images are watched."""
    if camvid is None:
        raise ValueError(f"no images to train {recipe.network} on; give --camvid")
    task = Camera.of(recipe)
    samples, watch = camvid_samples(task, camvid, device)
    return _Data(task, samples, watch, samples.images.hashes, len(samples.images.hashes))


def _scan_data(
    recipe: Recipe,
    device: torch.device,
    kitti: Path | None,
    simulated: Path | None,
    scan_sets: Sequence[ScanFolder],
    *,
    given: RealScans | None,
    fold: int | None,
    teacher: Path | None,
    n_workers: int,
) -> _Data:
    """Real and simulated scans, and the teacher; parameters are those of `train`."""
    task = task_of(recipe)
    objects = KittiObjects(kitti) if kitti else None
    real, weights, hashes, watched = (
        _real(recipe, objects, scan_sets, fold)
        if given is None
        else (given.scans, [1.0] * len(given.scans), given.hashes, given.watched)
    )
    if recipe.distil > 0.0 and teacher is None:
        raise ValueError(f"the recipe distils ({recipe.distil:g}) but there is no teacher; give --teacher")
    if teacher is not None and recipe.distil == 0.0 and (objects is None or recipe.task != "points"):
        raise ValueError("the teacher is not used; give --distil, or train a network that labels points on --kitti")
    onnx_teacher = OnnxTeacher(teacher, task) if teacher is not None and teacher.suffix == ".onnx" else None
    if onnx_teacher is not None and recipe.distil == 0.0:
        raise ValueError(f"{teacher}: an exported teacher does not label scans; give its checkpoint.pt, or --distil")
    teacher_network = None if teacher is None or onnx_teacher else _teacher(teacher, task).to(device)
    if teacher_network is not None and objects is not None and recipe.distil == 0.0:
        extra = unlabeled_scans(objects, fold)
        real = pseudo_labeled(teacher_network.cpu(), task, [*real, *extra])
        weights += [len(extra) ** -0.5] * len(extra)
    paths = sorted(simulated.glob("*.npz")) if simulated else []
    samples = Samples(recipe, real, weights, paths, onnx_teacher, n_workers)
    watch = Watch(samples, watched) if watched else None
    return _Data(task, samples, watch, hashes, len(real), teacher_network)


def _real(
    recipe: Recipe, kitti: KittiObjects | None, scan_sets: Sequence[ScanFolder], fold: int | None
) -> tuple[list[LabeledScan], list[float], dict[str, str], list[LabeledScan]]:
    """The real scans to train on, their weights and hashes, and the scans to watch."""
    scans: list[LabeledScan] = []
    weights: list[float] = []
    hashes: dict[str, str] = {}
    watched: list[LabeledScan] = []
    only_simulated = recipe.simulated_share == 1.0
    if kitti is not None:
        names = kitti.names("train") if only_simulated else kitti.names("validation", fold=fold)
        chosen = _few_of_each_drive(names, [kitti.drives[name] for name in names])
        watched += real_scans(kitti, chosen, classes=recipe.classes)[0]
        if not only_simulated:
            names = kitti.names("train", fold=fold)
            scans, weights, hashes = real_scans(kitti, names, drawn=recipe.drawn_roads, classes=recipe.classes)
    classes = recipe.classes or POINT_CLASSES
    for folder in scan_sets:
        if not only_simulated:
            more, more_weights, more_hashes = read_scan_set(folder, "train", fold, classes=classes)
            scans, weights, hashes = scans + more, weights + more_weights, hashes | more_hashes
        watched += read_scan_set(folder, "validation", fold, classes=classes)[0]
    return scans, weights, hashes, watched


def _few_of_each_drive(names: Sequence[str], drives: Sequence[str]) -> list[str]:
    """The names without most frames of long drives."""
    chosen, seen = [], Counter[str]()
    n_frames = Counter(drives)
    for name, drive in zip(names, drives, strict=True):
        if n_frames[drive] <= FEW_FRAMES or seen[drive] % VALIDATION_STRIDE == 0:
            chosen.append(name)
        seen[drive] += 1
    return chosen


def _last(recipe: Recipe, curve: Sequence[dict[str, Any]], epoch: int) -> int:
    """The last step: that of the recipe, or where the validation figure has not improved for ``stop_after`` epochs."""
    figures = [row["validation"]["mean"] or 0.0 for row in curve] if recipe.stop_after else []
    if figures:
        since = len(figures) - 1 - int(np.argmax(figures))  # each row is of an epoch
        if since >= recipe.stop_after:
            return int(curve[-1]["step"])
    return recipe.steps


def _schedule(recipe: Recipe, step: int) -> float:
    """Factor of the learning rate: warm-up, constant, cosine."""
    begin = round(recipe.steps * (1.0 - recipe.cooldown))
    if step >= begin:
        return float(0.5 * (1.0 + np.cos(np.pi * (step - begin) / max(1, recipe.steps - begin))))
    return min(1.0, (step + 1) / WARM_UP_STEPS) if recipe.cooldown else 1.0


def _optimizer(recipe: Recipe, network: nn.Module) -> torch.optim.Optimizer:
    if recipe.optimizer == "adagrad":
        return torch.optim.Adagrad(network.parameters(), lr=recipe.learning_rate)
    if recipe.optimizer == "adam":
        return torch.optim.Adam(network.parameters(), lr=recipe.learning_rate)
    if recipe.optimizer != "adamw":
        raise ValueError(f"optimizer is {recipe.optimizer!r}; expected adamw, adam or adagrad")
    decayed = [p for p in network.parameters() if p.ndim > 1]
    kept = [p for p in network.parameters() if p.ndim <= 1]
    return torch.optim.AdamW(
        [{"params": decayed, "weight_decay": recipe.weight_decay}, {"params": kept, "weight_decay": 0.0}],
        lr=recipe.learning_rate,
    )


class _Teacher(nn.Module):
    """A network that sees some channels of another network's input."""

    def __init__(self, network: nn.Module, channels: Sequence[int]) -> None:
        super().__init__()
        self.network, self.channels = network, list(channels)

    def forward(self, x: Tensor) -> Any:
        return self.network(x[:, self.channels])


def _teacher(checkpoint: Path, task: Task) -> nn.Module:
    """The network of a checkpoint with the same view as the task, and with the same channels or fewer."""
    state = read_checkpoint(checkpoint)
    recipe = state["recipe"]
    seen, own = (
        list(zip(spec.channels, spec.mean, spec.std, strict=True)) for spec in (task.input, task_of(recipe).input)
    )
    if task_of(recipe).view != task.view or not set(own) <= set(seen):
        raise ValueError(f"{checkpoint} is of {recipe.network}, which sees another view than {task.recipe.network}")
    return _Teacher(build_network(state, checkpoint), [seen.index(channel) for channel in own]).eval()


@torch.no_grad()
def _average(averaged: nn.Module, network: nn.Module, decay: float) -> None:
    """One step of the exponential moving average of weights; counters are copied."""
    pairs = list(zip(averaged.state_dict().values(), network.state_dict().values(), strict=True))
    floating = [(slow, fast) for slow, fast in pairs if slow.dtype.is_floating_point]
    # All at once: on a GPU, a call for each tensor takes longer than the averaging.
    torch._foreach_lerp_([slow for slow, _ in floating], [fast for _, fast in floating], 1.0 - decay)
    for slow, fast in pairs:
        if not slow.dtype.is_floating_point:
            slow.copy_(fast)
