"""Training with the fields of `Data` and `Run` by name, for tests."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from edgeperc_export import make as make_module
from edgeperc_export.recipe import Recipe
from edgeperc_export.training import ablation
from edgeperc_export.training import train as training
from edgeperc_export.training.train import Data, Run


@contextmanager
def interrupted_in_step(step: int, task: type) -> Iterator[None]:
    """A training of a task is interrupted in this step, counted from 1."""
    loss, steps = task.loss, itertools.count(1)  # type: ignore[attr-defined]  # every task has one

    def interrupted(*given: Any) -> Any:
        if next(steps) == step:
            raise KeyboardInterrupt
        return loss(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(task, "loss", interrupted)
        with pytest.raises(KeyboardInterrupt):
            yield


def of_train(settings: dict[str, Any]) -> tuple[Data, Run, dict[str, Any]]:
    """The records, and the settings of neither."""
    data, run = ({f.name for f in fields(kind)} & settings.keys() for kind in (Data, Run))
    others = {name: settings[name] for name in settings.keys() - data - run}
    return Data(**{name: settings[name] for name in data}), Run(**{name: settings[name] for name in run}), others


def train(recipe: Recipe, out: Path, **settings: Any) -> Path:
    data, run, others = of_train({"n_threads": 1, **settings})
    assert not others
    return training.train(recipe, out, data, run)


def make(name: str, out: Path, **settings: Any) -> Path:
    data, run, others = of_train(settings)
    return make_module.make(name, out, data, run, **others)


def ablate(network: str, out: Path, **settings: Any) -> list[dict[str, Any]]:
    data, run, others = of_train(settings)
    return ablation.ablate(network, out, data, run, **others)


def losses_of_steps(
    network: nn.Module, loss_of: Callable[[nn.Module], Tensor], n_steps: int, rate: float
) -> list[float]:
    """Train a network on one batch; returns the loss before each step."""
    optimizer, losses = torch.optim.AdamW(network.parameters(), lr=rate), []
    for _ in range(n_steps):
        loss = loss_of(network)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return losses
