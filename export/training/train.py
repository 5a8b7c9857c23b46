"""The training loop of all networks.

Each step draws its samples and its dropout from ``(seed, step)`` alone. A run that is stopped and resumed from its
checkpoint therefore ends with the same weights, bit for bit, as an uninterrupted one.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout  # torch needs it, too
from torch import Tensor, nn
from tqdm import tqdm

from edgeperc.datasets.layout import BACKGROUND

from ..data.scan_sets import joined_hashes
from ..networks import build
from ..recipe import Recipe
from .bfloat16 import in_bfloat16
from .checkpoint import CheckpointError, frames_of, read_checkpoint, write_checkpoint, write_mean
from .log import TrainingLog
from .object_batches import ObjectBatches
from .ranks import Ranks
from .samples import Samples, loaded
from .sources import Data as Data
from .sources import read_source
from .start import start
from .task import Task
from .teacher import teach

WARM_UP_STEPS = 100
# Batches that the statistics of batch norm are computed from, if a run starts from an exported model.
STATISTICS_BATCHES = 8


@dataclass(frozen=True, slots=True)
class Run:
    """What a training run starts from, and how it is carried out."""

    start_from: Path | None = None  # a checkpoint or exported model; weights that the networks do not share are ignored
    teacher: Path | None = None  # to distil from; without distillation, a checkpoint that labels unlabeled points
    n_threads: int | None = None  # None leaves it to torch
    n_workers: int = 0  # processes that make samples, one thread each; 0: this one, between the steps
    compiled: bool = False  # by `torch.compile`: a minute and a C++ compiler; PointSeg then trains a third faster
    checkpoint_every: int = 100  # steps between checkpoints and points of the curve; an epoch with ``stop_after``
    tensorboard: bool = False  # write the log for it, too
    save_every_s: float = 0.0  # between checkpoints, at least, as large networks take seconds to write


def train(recipe: Recipe, out: Path, data: Data, run: Run = Run()) -> Path:  # it is immutable
    """Train the network of a recipe in a folder, or resume it; returns the checkpoint. ``torchrun``'s processes share
    each batch: weights equal those of one up to rounding. Several runs have folders of their own beside ``out``, which
    gets their mean. Raises ValueError, FloatingPointError, RankError.
    """
    recipe.check()
    if recipe.classes and recipe.classes[0] != BACKGROUND:
        raise ValueError(f"--classes begins with {recipe.classes[0]}; expected {BACKGROUND}, which is not looked for")
    ranks = Ranks()
    ranks.check(recipe.batch, recipe.accumulate, run.compiled)
    folders = [out] if recipe.runs == 1 else [out.with_name(f"{out.name}-run-{k}") for k in range(recipe.runs)]
    checkpoints = []
    with ranks.together():
        for k, folder in enumerate(folders):
            with _alone_in(folder, ranks):
                of_run = replace(recipe, runs=1, seed=recipe.seed + k)
                checkpoints.append(_Training(of_run, folder, data, run, ranks).finish())
        if recipe.runs == 1:
            return checkpoints[0]
        if ranks.is_first:
            out.mkdir(parents=True, exist_ok=True)
            write_mean(checkpoints, recipe, out / checkpoints[0].name)
        return out / checkpoints[0].name


@contextmanager
def _alone_in(folder: Path, ranks: Ranks) -> Iterator[None]:
    """Keep another training out of a folder, where both would write one checkpoint and one log. Raises ValueError."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".lock", timeout=0) if ranks.is_first else nullcontext():
            yield
    except Timeout:
        raise ValueError(f"another training runs in {folder}; wait for its end, or give another folder") from None


@dataclass(slots=True)
class _State:
    """How far a run is; a checkpoint keeps it."""

    hashes: dict[str, str]
    before: list[dict[str, Any]] = field(default_factory=list)
    curve: list[dict[str, Any]] = field(default_factory=list)
    step: int = 0
    best: dict[str, Any] | None = None
    best_figure: float = -1.0
    lowest_loss: float = math.inf
    since_best: int = 0
    halvings: int = 0


class _Training:
    """A run in one of the ranks."""

    def __init__(self, recipe: Recipe, out: Path, data: Data, run: Run, ranks: Ranks) -> None:
        self.recipe, self.run, self.ranks, self.fold = recipe, run, ranks, data.fold
        self.out, self.checkpoint = out, out / "checkpoint.pt"
        if run.n_threads is not None:
            torch.set_num_threads(run.n_threads)
        torch.backends.cudnn.benchmark = True  # inputs have one size
        self.source = read_source(recipe, out.parent, data, run.teacher, run.n_workers, ranks.device)
        self.made_of = {**self.source.made_of, "--teacher": _digest_of_file(run.teacher)}
        # Without weights that are kept, a resumed run does not read it.
        if recipe.kept > 0.0 or (run.start_from is not None and run.start_from.exists()):
            self.made_of["--start-from"] = _digest_of_file(run.start_from)
        self.epoch = max(1, self.source.n_real // recipe.batch)
        self.every = self.epoch if recipe.stop_after else run.checkpoint_every
        # Without a real scan or image, or with other scans, the validation decides which step is best.
        validated_elsewhere = data.fold is not None or data.given is not None
        self.stops = validated_elsewhere or recipe.simulated_share == 1.0 or recipe.stop_after > 0

        network, self.state = build(recipe), _State(hashes=self.source.hashes)
        if recipe.kept > 0.0 and run.start_from is None:
            raise ValueError(f"the recipe keeps weights ({recipe.kept:g}) but there are none; give --start-from")
        if not self.checkpoint.exists():
            for path in filter(None, (run.start_from, run.teacher)):
                self.state.hashes = joined_hashes(frames_of(path), self.state.hashes)
            if run.start_from is not None:
                self.state.before = self._start(network, run.start_from)
        self.network: Any = network.to(ranks.device, memory_format=torch.channels_last)  # type: ignore[call-overload]  # not in its stubs
        ranks.share(self.network)
        # The compiled network shares its weights with the original, which is averaged and saved.
        self.forward: Any = torch.compile(self.network) if run.compiled else self.network
        self.averaged = copy.deepcopy(self.network).eval()
        if isinstance(self.source.samples, ObjectBatches):
            self.source.samples.network = self.averaged
        self.optimizer = make_optimizer(recipe, self.network)
        if self.checkpoint.exists():
            self._resume()
        watched, known = self.source.watched, {*self.state.hashes.values()}
        if seen := [name for name in watched if watched[name] in known]:
            of = f"{len(seen)} of {len(watched)} validation scans or images, such as {seen[0]}, are of the training of"
            warnings.warn(f"{of} --start-from or --teacher, so the validation figures are too good", stacklevel=2)

    def finish(self) -> Path:
        """Make the steps that are left; returns the checkpoint."""
        recipe, run, ranks, state, samples = self.recipe, self.run, self.ranks, self.state, self.source.samples
        losses: list[float] = []
        began_s, began = time.monotonic(), state.step
        saved_s = began_s
        kept = TrainingLog(self.out, state.curve, tensorboard=run.tensorboard) if ranks.is_first else nullcontext()
        progress = tqdm(
            total=recipe.steps, initial=state.step, desc=recipe.network, unit="step", disable=not ranks.is_first
        )
        with kept as log, progress:
            for arrays in self._batches():
                losses.append(self._step([array.to(ranks.device, non_blocking=True) for array in arrays]))
                state.step += 1
                _average(self.averaged, self.network, min(recipe.ema, (1 + state.step) / (10 + state.step)))
                if recipe.kept > 0.0 and run.start_from is not None and state.step == recipe.steps:
                    begun = build(recipe)
                    self._start(begun, run.start_from)
                    _average(self.averaged, begun.to(ranks.device), 1.0 - recipe.kept)
                progress.update()
                rate = (state.step - began) * recipe.batch / max(time.monotonic() - began_s, 1e-9)
                figure_shown = {"best": f"{state.best_figure:.3f}"} if state.best_figure >= 0.0 else {}
                progress.set_postfix(loss=f"{losses[-1]:.3f}", samples_per_s=f"{rate:.1f}", **figure_shown)
                if isinstance(samples, Samples) and recipe.redraw_every and state.step % recipe.redraw_every == 0:
                    if ranks.is_first:
                        samples.redraw(self.averaged, state.step)
                    samples.odds = ranks.from_first(samples.odds)
                if state.step % self.every and state.step != recipe.steps:
                    continue
                loss = round(float(np.mean(losses)), 5)
                line = {"step": state.step, "samples": state.step * recipe.batch, "loss": loss}
                losses.clear()
                state.curve.append(line | self._validated())
                if log is not None:
                    log.write(state.curve[-1] | {"samples_per_s": round(rate, 2)})
                over = state.step >= last_step(recipe, state.curve, self.epoch)
                if ranks.is_first and (over or time.monotonic() - saved_s >= run.save_every_s):
                    self._save()
                    saved_s = time.monotonic()
                if over:
                    break
        return self.checkpoint

    def _batches(self) -> Iterator[Sequence[Tensor]]:
        recipe, state, samples = self.recipe, self.state, self.source.samples
        if isinstance(samples, Samples):
            return loaded(samples, state.step, recipe.steps, self.run.n_workers, self.ranks)
        return map(samples.batch, range(state.step, last_step(recipe, state.curve, self.epoch)))

    def _start(self, network: nn.Module, path: Path) -> list[dict[str, Any]]:
        """`start`, with the first batches for the statistics of batch norm."""
        images = [torch.as_tensor(self.source.samples.batch(k)[0]).cpu() for k in range(STATISTICS_BATCHES)]
        return start(network, self.recipe, path, images)

    def _step(self, arrays: Sequence[Tensor]) -> float:
        """One step of the optimizer on a batch; returns the loss."""
        recipe, ranks, source, task = self.recipe, self.ranks, self.source, self.source.samples.task
        for group in self.optimizer.param_groups:
            group["lr"] = recipe.learning_rate * make_schedule(recipe, self.state.step) * 0.5**self.state.halvings
        torch.manual_seed((recipe.seed << 32) + self.state.step)
        self.network.train()
        if recipe.head_only:
            self.network.segmentation.requires_grad_(False).eval()
        self.optimizer.zero_grad(set_to_none=True)
        total = torch.zeros((), device=ranks.device)
        for inputs, *others in zip(*(array.chunk(recipe.accumulate) for array in arrays), strict=True):
            x = ranks.part(inputs)
            x = x.contiguous(memory_format=torch.channels_last if x.ndim == 4 else torch.contiguous_format)
            y = others[: source.samples.n_targets]
            taught: tuple[Any, ...] = tuple(others[source.samples.n_targets :])
            with in_bfloat16(ranks.device.type):
                outputs = ranks.whole(self.forward(x))
            loss = task.loss(outputs, y)
            if source.teacher is not None and recipe.distil > 0.0:
                taught = ranks.whole(teach(source.teacher, x, task.input, mirror=recipe.seen_twice))
            if taught and isinstance(task, Task):
                loss = loss + recipe.distil * task.distillation(outputs, *taught)
            loss = loss * (len(inputs) / len(arrays[0]))
            torch.autograd.backward(loss)
            total += loss.detach()
        ranks.add_gradients(self.network)
        found = float(total.item())
        if not math.isfinite(found):
            raise FloatingPointError(f"the loss is {found} at step {self.state.step}; lower --learning-rate")
        nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
        self.optimizer.step()
        return found

    def _validated(self) -> dict[str, Any]:
        """The validation's part of a line of the log; the best weights are kept."""
        recipe, state, watch = self.recipe, self.state, self.source.watch
        if watch is None:
            return {}
        validated = watch.validate(self.averaged) if self.ranks.is_first else None
        figure, loss, figures = self.ranks.from_first(validated) or (0.0, 0.0, {})
        if not math.isfinite(loss):  # the last step's weights have no other
            raise FloatingPointError(f"the validation loss is {loss} at step {state.step}; lower --learning-rate")
        if figure > state.best_figure and self.stops:
            state.best_figure, state.best = figure, copy.deepcopy(self.averaged.state_dict())
        state.since_best = 0 if loss < state.lowest_loss else state.since_best + self.every
        state.lowest_loss = min(state.lowest_loss, loss)
        if recipe.halve_after and state.since_best >= recipe.halve_after * self.epoch:
            state.halvings, state.since_best = state.halvings + 1, 0
        return {"validation_loss": round(loss, 5), "validation": figures}

    def _save(self) -> None:
        state, samples = self.state, self.source.samples
        write_checkpoint(
            {
                "recipe": json.dumps(asdict(self.recipe)),
                "before": json.dumps(state.before),
                "step": state.step,
                "network": self.network.state_dict(),
                "averaged": self.averaged.state_dict(),
                "best": state.best,
                "watched": (state.best_figure, state.lowest_loss, state.since_best, state.halvings),
                "optimizer": self.optimizer.state_dict(),
                "curve": json.dumps(state.curve),
                "frames": json.dumps(state.hashes),
                "made_of": json.dumps(self.made_of),
                "fitness": json.dumps(self.source.fitness),
                "fold": -1 if self.fold is None else self.fold,
                "n_simulated": len(samples.simulated),
                "odds": {name: torch.from_numpy(odds) for name, odds in samples.odds.items()},
            },
            self.checkpoint,
        )

    def _resume(self) -> None:
        kept = read_checkpoint(self.checkpoint, self.ranks.device)
        if kept["recipe"] != self.recipe:
            pairs = zip(asdict(kept["recipe"]).items(), asdict(self.recipe).values(), strict=True)
            changed = (f"{name.replace('_', '-')} {old!r}, now {new!r}" for (name, old), new in pairs if old != new)
            raise ValueError(
                f"{self.checkpoint} is of another recipe: {'; '.join(changed)}; give the same options, or an empty "
                "folder"
            )
        self._check_data(kept)
        try:
            for name in ("network", "averaged", "optimizer"):
                getattr(self, name).load_state_dict(kept[name])
            self.source.samples.odds = {name: odds.cpu().numpy() for name, odds in kept["odds"].items()}
            self.state = _State(*(kept[k] for k in ("frames", "before", "curve", "step", "best")), *kept["watched"])
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as exc:
            reason = " ".join(str(exc).split())[:300]
            raise CheckpointError(f"{self.checkpoint} is damaged ({reason}); train again") from exc

    def _check_data(self, kept: Mapping[str, Any]) -> None:
        """Raise ValueError if a checkpoint's run was trained on other scans or images than this one."""
        frames, own, fold = kept["frames"], self.source.hashes, -1 if self.fold is None else self.fold
        joined = kept["before"] or self.made_of["--teacher"]
        alike = own.items() <= frames.items() if joined else own == frames
        n_simulated = len(self.source.samples.simulated)
        if not alike or (kept["fold"], kept["n_simulated"]) != (fold, n_simulated):
            raise ValueError(
                f"{self.checkpoint} is of a run on other data: {len(frames)} real scans or images (with those of the "
                f"runs before and the teacher), {kept['n_simulated']} simulated ones, fold {kept['fold']}; got "
                f"{len(own)}, {n_simulated}, fold {fold}. Give the same ones, or an empty folder"
            )
        made_of = ({} if kept["before"] else {"--start-from": ""}) | json.loads(kept.get("made_of", "{}"))
        for name, digest in made_of.items():  # earlier versions did not write it
            if self.made_of.get(name, digest) != digest:
                other = f"{'another' if digest else 'no'} {name}"
                raise ValueError(f"{self.checkpoint} is of a run with {other}; give the same or an empty folder")
        self.made_of = made_of | self.made_of


def _digest_of_file(path: Path | None) -> str:
    return "" if path is None else hashlib.sha256(path.read_bytes()).hexdigest()


def last_step(recipe: Recipe, curve: Sequence[dict[str, Any]], epoch: int) -> int:
    """The last step: that of the recipe, or where the validation figure has not improved for ``stop_after`` epochs."""
    figures = [row["validation"]["mean"] or 0.0 for row in curve] if recipe.stop_after else []
    if figures:
        since = len(figures) - 1 - int(np.argmax(figures))  # each row is of an epoch
        if since >= recipe.stop_after:
            return int(curve[-1]["step"])
    return recipe.steps


def make_schedule(recipe: Recipe, step: int) -> float:
    """Factor of the learning rate: warm-up, constant, cosine."""
    begin = round(recipe.steps * (1.0 - recipe.cooldown))
    if step >= begin:
        return float(0.5 * (1.0 + np.cos(np.pi * (step - begin) / max(1, recipe.steps - begin))))
    return min(1.0, (step + 1) / WARM_UP_STEPS) if recipe.cooldown else 1.0


def make_optimizer(recipe: Recipe, network: nn.Module) -> torch.optim.Optimizer:
    """The optimizer that the recipe names."""
    if recipe.optimizer in ("adagrad", "adam"):
        kind = torch.optim.Adagrad if recipe.optimizer == "adagrad" else torch.optim.Adam
        return kind(network.parameters(), lr=recipe.learning_rate)
    if recipe.optimizer != "adamw":
        raise ValueError(f"optimizer is {recipe.optimizer!r}; expected adamw, adam or adagrad")
    groups = [
        {"params": [p for p in network.parameters() if (p.ndim > 1) == decays], "weight_decay": decay}
        for decays, decay in ((True, recipe.weight_decay), (False, 0.0))
    ]
    return torch.optim.AdamW(groups, lr=recipe.learning_rate)


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
