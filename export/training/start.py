"""Start a training run from the weights of a checkpoint or of an exported model.

An exported model has no batch norm: it was folded into the convolutions. Here each batch norm gets the statistics of
its input on training scans, and the scale and offset that cancel them, so that the network equals the model and can be
trained further. Input channels, classes and box channels that the model lacks start with zero weights.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from edgeperc.errors import ModelError
from edgeperc.inference.session import golden_input, golden_shape
from edgeperc.types.card import ModelCard

from ..cards import card_of
from ..networks.objects import CLOSE, LOOK
from ..recipe import Recipe
from .checkpoint import read_checkpoint

OUTPUT_LAYERS = {"classifier", "early", "predict"}
"""Layers that may lack classes or box channels, or have them in another order; of others, all or nothing is shared."""
# Of the layers: networks of another structure have up to 0.19 in common by chance, those with another head 0.5 or more.
FEWEST_SHARED = 0.3


def start(network: nn.Module, recipe: Recipe, path: Path, images: Sequence[Tensor]) -> list[dict[str, Any]]:
    """Copy what a checkpoint or exported model (fp32) shares with the network; of a model, batch norm gets the
    statistics of ``images``. Returns earlier recipes. Raises ValueError, ModelError.
    """
    own_card = card_of(recipe, version="0")
    if path.suffix == ".onnx":
        card = ModelCard.read(path)
        if card.precision != "fp32":
            raise ModelError(f"{path} is in {card.precision}, without most weights in fp32; give the model in fp32")
        given, folded = folded_weights(path), True
        training = card.training
        before = [*training.get("started_from", ()), *([dict(training["recipe"])] if "recipe" in training else [])]
    else:
        state = read_checkpoint(path)
        card, folded = card_of(state["recipe"], version="0"), False
        given = state["best"] or state["averaged"]
        before = [*state["before"], asdict(state["recipe"])]
    pairs, first = _layers(network, torch.from_numpy(golden_input(0, golden_shape(own_card))))
    own = network.state_dict()
    common = {}
    for name, weight in given.items():
        value: Tensor | None = weight
        if name in own and name in first:
            value = _by_channel(weight, own[name], card, own_card, path)
        elif name in own and not OUTPUT_LAYERS.isdisjoint(name.split(".")):
            value = _by_class(weight, own[name], card.classes, own_card.classes)
        if name in own and value is not None and value.shape == own[name].shape:
            common[name] = value
    n_common, n_own, n_given = (sum(v.ndim > 1 for v in each.values()) for each in (common, own, given))
    if card.view.kind != own_card.view.kind or n_common < FEWEST_SHARED * min(n_own, n_given):
        raise ValueError(
            f"{path} is of another network, with {n_common} of its {n_given} layers in common with this one; expected "
            f"{recipe.network} with the same options, such as --edge and --width"
        )
    if unread := [name for name in card.input.channels if name not in own_card.input.channels]:
        warnings.warn(f"{path} sees {', '.join(unread)} too, which the network to train does not", stacklevel=2)
    network.load_state_dict(common, strict=False)
    if folded:
        shared = {conv: norm for conv, norm in pairs.items() if f"{conv}.weight" in common}
        _unfold(network, {norm: given.get(f"{conv}.weight_bias") for conv, norm in shared.items()}, images)
    return before


def folded_weights(path: Path) -> dict[str, Tensor]:
    """The weights of an exported model by name; ``NAME.weight_bias`` is the offset of a folded batch norm."""
    weights = {}
    for tensor in onnx.load(path).graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.dtype in (np.float16, np.float32):
            name = tensor.name.removesuffix("_half").removeprefix(CLOSE)
            name = f"look.{name.removeprefix(LOOK)}" if name.startswith(LOOK) else name
            weights[name] = torch.from_numpy(values.astype(np.float32))
    return weights


@torch.no_grad()
def _layers(network: nn.Module, image: Tensor) -> tuple[dict[str, str], set[str]]:
    """Each convolution that a batch norm follows -> the batch norm; and the weights of those that read the input."""
    made: dict[int, tuple[str, Tensor]] = {}
    pairs: dict[str, str] = {}
    first: set[str] = set()

    def convolved(name: str, module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        if torch.equal(inputs[0][:, : image.shape[1]], image):
            first.add(f"{name}.weight")
        made[id(output)] = (name, output)  # held, so that no other tensor gets its number

    def normed(name: str, module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        if id(inputs[0]) in made:
            pairs[made[id(inputs[0])][0]] = name

    hooks = []
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
            hooks.append(module.register_forward_hook(partial(convolved, name)))
        elif isinstance(module, nn.BatchNorm2d):
            hooks.append(module.register_forward_pre_hook(partial(normed, name)))
    _run(network, [image], hooks)
    return pairs, first


def _run(network: nn.Module, images: Sequence[Tensor], hooks: Sequence[RemovableHandle]) -> None:
    """Run a network as at run time, and remove its hooks."""
    training = network.training
    network.eval()
    for image in images:
        network(image)
    network.train(training)
    for hook in hooks:
        hook.remove()


def _by_channel(given: Tensor, own: Tensor, card: ModelCard, own_card: ModelCard, path: Path) -> Tensor | None:
    """The weights of a convolution that reads the input, channel by channel, and those of channels made from it."""
    theirs, ours = card.input, own_card.input
    n_made = own.shape[1] - len(ours.channels)
    if given[:, 0].shape != own[:, 0].shape or given.shape[1] - len(theirs.channels) != n_made:
        return None
    value = torch.zeros_like(own)
    value[:, len(ours.channels) :] = given[:, len(theirs.channels) :]
    for k, name in enumerate(ours.channels):
        if name not in theirs.channels:
            continue
        at = theirs.channels.index(name)
        if not np.allclose((theirs.mean[at], theirs.std[at]), (ours.mean[k], ours.std[k])):
            raise ValueError(
                f"{path} scales its channel {name} by {theirs.mean[at]:g} and {theirs.std[at]:g}; "
                f"expected {ours.mean[k]:g} and {ours.std[k]:g}"
            )
        value[:, k] = given[:, at]
    return value


def _by_class(given: Tensor, own: Tensor, classes: Sequence[str], own_classes: Sequence[str]) -> Tensor | None:
    """Weights of more or other outputs: class by class, or with zeros for the channels at the end; None if unlike."""
    if given.ndim != own.ndim or given.shape[1:] != own.shape[1:]:
        return None
    value = torch.zeros_like(own)
    each, own_each = len(given) / len(classes), len(own) / len(own_classes)
    if tuple(classes) != tuple(own_classes) and each == own_each == int(each):
        for k, name in enumerate(own_classes):
            if name in classes:
                at, size = list(classes).index(name), int(each)
                value[k * size : (k + 1) * size] = given[at * size : (at + 1) * size]
        return value
    if len(given) > len(own):
        return None
    value[: len(given)] = given
    return value


@torch.no_grad()
def _unfold(network: nn.Module, offsets: Mapping[str, Tensor | None], images: Sequence[Tensor]) -> None:
    """Give each batch norm its input's statistics and what cancels them; an offset that was folded may be None."""
    norms: dict[str, Any] = {name: network.get_submodule(name) for name, of in offsets.items() if of is not None}
    sums: dict[str, list[Tensor]] = {name: [] for name in norms}

    def watched(name: str, module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        values = inputs[0].transpose(0, 1).flatten(1).double()
        sums[name].append(torch.stack([values.mean(1), values.square().mean(1)]))

    hooks = []
    for name, norm in norms.items():
        nn.init.ones_(norm.weight)
        norm.bias.copy_(offsets[name])
        nn.init.zeros_(norm.running_mean)
        norm.running_var.fill_(1.0 - norm.eps)
        hooks.append(norm.register_forward_pre_hook(partial(watched, name)))
    _run(network, images, hooks)
    for name, norm in norms.items():
        mean, square = torch.stack(sums[name]).mean(0)
        variance = (square - mean.square()).clamp(min=0.0)
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
        norm.weight.copy_((variance + norm.eps).sqrt())
        norm.bias.copy_(offsets[name] + mean)
