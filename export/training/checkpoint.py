"""Read the checkpoints of training runs, which may be damaged, of another program, or made to do harm."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn

from edgeperc.errors import CardError, ModelError
from edgeperc.preprocess.fitness import FitnessProfile
from edgeperc.system.atomic import open_atomic
from edgeperc.system.fields import Fields
from edgeperc.types.card import ModelCard

from ..networks import build
from ..recipe import Recipe

_FIELDS = Fields("the checkpoint", ValueError, "train again", optional=("*",), exact=True)
_TEXTS = {"before": list, "curve": list, "frames": dict}  # entries that are JSON


class CheckpointError(ModelError):
    """A file is not a checkpoint of ``edgeperc-export train``, or is damaged."""


def read_checkpoint(path: Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """Read a checkpoint, its tensors to a device, with its texts decoded and checked; only tensors and plain values are
    unpickled. ``fitness`` and ``best`` may be None. Raises CheckpointError, OSError.
    """
    try:
        state = torch.load(path, weights_only=True, map_location=device)
    except Exception as exc:  # of torch, pickle, zipfile and struct
        if isinstance(exc, OSError) and exc.filename is not None:
            raise  # others are of a damaged file
        reason = " ".join(str(exc).split())[:200] or type(exc).__name__
        raise CheckpointError(f"{path} cannot be read as a checkpoint ({reason}); train again") from exc
    try:
        return {**state, "recipe": _recipe(state["recipe"]), **_checked(state)}
    except (CardError, KeyError, RecursionError, TypeError, ValueError) as exc:
        raise CheckpointError(
            f"{path} is not a checkpoint of edgeperc-export train ({type(exc).__name__}: {exc}); train again"
        ) from exc


def build_network(state: Mapping[str, Any], path: Path) -> nn.Module:
    """The averaged network of a checkpoint, of its best step; raises CheckpointError."""
    try:
        network = build(state["recipe"])
        network.load_state_dict(state["best"] or state["averaged"])
    except (AttributeError, RuntimeError, TypeError, ValueError) as exc:
        reason = " ".join(str(exc).split())[:300]
        raise CheckpointError(
            f"{path}: its weights do not fit {state['recipe'].network} ({reason}); train again"
        ) from exc
    return network


def frames_of(path: Path) -> dict[str, str]:
    """The hashes of the scans or images that a checkpoint or exported model was trained on, by name."""
    return dict((ModelCard.read(path).training if path.suffix == ".onnx" else read_checkpoint(path)).get("frames", {}))


def write_mean(paths: Sequence[Path], recipe: Recipe, out: Path) -> None:
    """Write a checkpoint of ``recipe`` with the mean of the averaged weights of runs, and all else of the first one."""
    state = torch.load(paths[0], weights_only=True, map_location="cpu")
    weights = [build_network(read_checkpoint(path), path).state_dict() for path in paths]
    mean = {name: torch.stack([of[name] for of in weights]).mean(dim=0) for name in weights[0]}
    write_checkpoint(state | {"recipe": json.dumps(asdict(recipe)), "averaged": mean, "best": None}, out)


def write_checkpoint(state: Mapping[str, Any], path: Path) -> None:
    """Write a checkpoint whole. Raises OSError, which torch hides behind one of its own if the disk is full."""
    with open_atomic(path) as file:
        try:
            torch.save(state, file)
        except RuntimeError as exc:
            raise (exc.__context__ if isinstance(exc.__context__, OSError) else exc) from None


def _recipe(text: str) -> Recipe:
    recipe = _FIELDS.read(Recipe, json.loads(text), "recipe")
    recipe.check()
    return recipe


def _checked(state: Mapping[str, Any]) -> dict[str, Any]:
    """The entries that are not tensors, and the weights once they are known to be tensors by name."""
    texts = {name: json.loads(state[name]) for name in _TEXTS}
    for name, content in texts.items():
        if not isinstance(content, _TEXTS[name]):
            raise TypeError(f"{name} is {str(content)[:60]}; expected a {_TEXTS[name].__name__}")
    for name in ("n_simulated", "step"):
        _FIELDS.read(int, state[name], name)
    for name, weights in (("averaged", state["averaged"]), ("best", state["best"] or {})):
        if not isinstance(weights, Mapping) or not all(
            isinstance(key, str) and isinstance(value, torch.Tensor) for key, value in weights.items()
        ):
            raise TypeError(f"{name} is {type(weights).__name__}; expected tensors by name")
    fitness = json.loads(state.get("fitness", "null"))
    return texts | {"fitness": None if fitness is None else FitnessProfile.from_dict(fitness)}
