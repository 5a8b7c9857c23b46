"""torch -> ONNX with a card, and the proof that nothing changed on the way.

A file is written only when onnxruntime, through the whole runtime, gives the network's own answers: raw outputs within
`MAX_DEVIATION`, the same labels and boxes after post-processing, on every scan tried.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import nn

from edgeperc.atomic import open_atomic
from edgeperc.card import CARD_KEY, Golden, ModelCard
from edgeperc.decode import decode_classes, decode_top_view
from edgeperc.errors import EdgepercError
from edgeperc.fitness import FitnessProfile
from edgeperc.projection import make_projector
from edgeperc.session import Session, golden_input

from .cards import card_of
from .networks import build
from .recipe import Recipe

__all__ = ["ParityError", "export", "load", "to_graph", "verify", "with_golden", "write_card"]

OPSET = 18
# fp32 convolutions summed in another order were seen to differ by 1e-4 of the outputs' deviation; a wrong operator
# differs by 0.1 and more.
MAX_DEVIATION = 0.03
# Where the two largest of a pooling window are equal but for rounding, unpooling may put one in the other's place, and
# the cells around it differ, by 0.011 in a trained network and by 0.5 in one of random weights. Such places are few.
COMPARED = 0.999
# Rounding weights moved 0.07 % of an untrained network's labels, which lie close, and 0.006 % of a trained one's.
MIN_AGREEMENT = 0.999
# Biases and scales are few, and stay as they are.
FEWEST_HALVED = 1024
N_GOLDEN_VALUES = 64


class ParityError(EdgepercError):
    """The exported graph does not give the network's answers; nothing was written."""


def load(checkpoint: Path) -> tuple[nn.Module, Recipe, dict[str, Any]]:
    """The averaged network of a checkpoint, ready to answer; its recipe; and what it was trained on."""
    state = torch.load(checkpoint, weights_only=True, map_location="cpu")
    recipe = Recipe(**json.loads(state["recipe"]))
    network = build(recipe)
    # A training aid (deep supervision) is no part of what is exported.
    network.load_state_dict(state["best"] or state["averaged"])
    notes = {"frames": json.loads(state["frames"]), "n_simulated": state["n_simulated"], "step": state["step"]}
    notes |= {"before": json.loads(state["before"]), "curve": json.loads(state["curve"])}
    return network.eval(), recipe, notes


def _training(recipe: Recipe, notes: Mapping[str, Any]) -> dict[str, Any]:
    """What the card says of how the weights came about."""
    frames = notes["frames"]
    simulated = f"{notes['n_simulated']} simulated scans"
    return {
        "data": f"{len(frames)} real frames (KITTI), {simulated}" if frames else f"{simulated}, no real frame",
        "frames": frames,
        "licence": "CC BY-NC-SA 3.0, as KITTI's, on which it was trained" if frames else notes["licence"],
        "recipe": {n: getattr(recipe, n) for n in Recipe.__dataclass_fields__},
        "steps": notes["step"],
        "started_from": notes["before"],
        "curve": notes["curve"],
    }


def to_graph(network: nn.Module, card: ModelCard) -> onnx.ModelProto:
    """The network as an ONNX graph: weights inside, nothing of this computer in it, no card yet."""
    example = torch.from_numpy(golden_input(0, (1, len(card.input.channels), card.view.height, card.view.width)))
    with warnings.catch_warnings():  # the exporter speaks of its own future, which is not the user's affair
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            network.eval(),
            (example,),
            input_names=[card.input.name],
            output_names=[o.name for o in card.outputs],
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    # The exporter keeps stack traces, with this computer's paths, beside every node.
    stripped = [model, model.graph, *model.graph.node, *model.graph.value_info, *model.graph.input]
    for holder in [*stripped, *model.graph.output, *model.graph.initializer, *model.functions]:
        if hasattr(holder, "metadata_props"):
            del holder.metadata_props[:]
        if hasattr(holder, "doc_string"):
            holder.doc_string = ""
    model.producer_name, model.producer_version = "edgeperc", ""
    # Where maxima are put back in their places, a rounded weight can move one: by 0.12 deviations, it was seen.
    if card.view.kind == "range_image":
        _halve(model.graph)
    return model


def _halve(graph: onnx.GraphProto) -> None:
    """Keep large weights in half precision: half the file, and engines turn them back when they load it."""
    casts = []
    for weight in graph.initializer:
        values = onnx.numpy_helper.to_array(weight)
        if values.dtype != np.float32 or values.size < FEWEST_HALVED:
            continue
        name = weight.name
        weight.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), f"{name}_half"))
        casts.append(onnx.helper.make_node("Cast", [weight.name], [name], to=onnx.TensorProto.FLOAT))
    kept = list(graph.node)
    del graph.node[:]
    graph.node.extend([*casts, *kept])


def write_card(model: onnx.ModelProto, card: ModelCard, path: Path) -> None:
    """Write a graph with its card, last of all, and read it back through onnxruntime.

    Any network with a range-image or top-view input and class or box outputs of a kind the card can name will do.

    Raises
    ------
    CardError, CardMismatchError, ModelFileError
        Nothing is written, or left, in the place of ``path``.
    """
    kept = [p for p in model.metadata_props if p.key != CARD_KEY]
    del model.metadata_props[:]
    model.metadata_props.extend(kept)
    model.metadata_props.add(key=CARD_KEY, value=card.to_json())
    with open_atomic(path) as file:
        file.write(model.SerializeToString(deterministic=True))
        file.flush()
        session = Session(Path(file.name), "cpu")
        if session.card.to_json() != card.to_json():
            raise ParityError(f"{path}: the card read back is not the card written")


def with_golden(model: onnx.ModelProto, card: ModelCard) -> ModelCard:
    """The card with a known input and this computer's answers to it."""
    import onnxruntime

    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    x = golden_input(0, (1, len(card.input.channels), card.view.height, card.view.width))
    answers = session.run([o.name for o in card.outputs], {card.input.name: x})
    outputs = {}
    for spec, answer in zip(card.outputs, answers, strict=True):
        few = answer.size <= N_GOLDEN_VALUES
        at = np.arange(answer.size) if few else np.random.default_rng(0).integers(answer.size, size=N_GOLDEN_VALUES)
        outputs[spec.name] = {
            "sha256": hashlib.sha256(answer.tobytes()).hexdigest(),
            "std": float(answer.std()),
            "positions": [int(i) for i in at],
            "values": [float(v) for v in answer.reshape(-1)[at]],
        }
    return replace(card, golden=Golden(0, hashlib.sha256(x.tobytes()).hexdigest(), outputs))


def verify(network: nn.Module, path: Path, scans: Sequence[NDArray[np.float32]]) -> dict[str, float]:
    """Hold an exported model against the network it was made of, through post-processing.

    Parameters
    ----------
    network : nn.Module
    path : Path
        The .onnx.
    scans : sequence of (n, 4) float32
        Real or simulated, remission in 0..1.

    Returns
    -------
    dict
        ``n_scans``; ``max_deviation``, what 99.9 % of the raw outputs stay within, in standard deviations of the
        output; ``label_agreement``, the least share of pixels with the same label; ``box_deviation``, the largest
        difference of any number of a box.

    Raises
    ------
    ParityError
    """
    session = Session(path, "cpu")
    card = session.card
    projector = make_projector(card.view, card.input)
    worst, agreement, box_deviation = 0.0, 1.0, 0.0
    for points in scans:
        seen = projector.project(np.ascontiguousarray(points))
        image = seen.image
        with torch.no_grad():
            answers = network.eval()(torch.from_numpy(image[None]))
        answers = answers if isinstance(answers, tuple) else (answers,)
        session.input[:] = image
        here = session.run()
        wanted = {o.kind: a[0].numpy() for o, a in zip(card.outputs, answers, strict=True)}
        for kind, want in wanted.items():
            apart = np.quantile(np.abs(here[kind] - want), COMPARED)
            worst = max(worst, float(apart) / max(float(want.std()), 1e-6))
        if card.view.kind == "top_view":
            (here_labels, mine), (labels, theirs) = (
                decode_top_view(card, seen.index >= 0, a, card.score_threshold) for a in (here, wanted)
            )
            if [b.label for b in mine] != [b.label for b in theirs]:
                raise ParityError(f"{path}: onnxruntime finds {len(mine)} boxes, torch {len(theirs)}, or others")
            for box, other in zip(mine, theirs, strict=True):
                apart = np.abs(np.array([*box.center, *box.size]) - np.array([*other.center, *other.size]))
                box_deviation = max(box_deviation, float(apart.max()))
        else:
            ((kind, logits),) = wanted.items()
            here_labels, labels = (decode_classes(a, kind)[0] for a in (here[kind], logits))
        agreement = min(agreement, float((here_labels == labels).mean()))
    if worst > MAX_DEVIATION or agreement < MIN_AGREEMENT or box_deviation > 0.05:
        raise ParityError(
            f"{path}: raw outputs differ by {worst:.3g} standard deviations (at most {MAX_DEVIATION}), labels "
            f"agree on {agreement:.4%} of the pixels (at least {MIN_AGREEMENT:.2%}), boxes differ by up to "
            f"{box_deviation:.3g} m (at most 0.05)"
        )
    return {
        "n_scans": len(scans),
        "max_deviation": worst,
        "label_agreement": agreement,
        "box_deviation": box_deviation,
    }


def export(
    checkpoint: Path,
    path: Path,
    *,
    scans: Sequence[NDArray[np.float32]],
    fitness: FitnessProfile | None,
    name: str | None = None,
    version: str = "1.0.0",
    metrics: Mapping[str, Any] | None = None,
    licence: str = "Apache-2.0",
) -> ModelCard:
    """Export a checkpoint, prove it, and write it with its card.

    Raises
    ------
    ParityError
        The graph does not give the network's answers; ``path`` is left as it was.
    """
    network, recipe, notes = load(checkpoint)
    card = card_of(
        recipe.network,
        recipe.head,
        name=name or recipe.network,
        version=version,
        fitness=None if fitness is None else fitness.to_dict(),
        training=_training(recipe, notes | {"licence": licence}),
        metrics=dict(metrics or {}),
    )
    model = to_graph(network, card)
    card = with_golden(model, card)
    trial = path.with_name(f".{path.name}.trial.onnx")
    try:
        write_card(model, card, trial)
        card = replace(card, parity=verify(network, trial, scans))
        write_card(model, card, path)
    finally:
        trial.unlink(missing_ok=True)
    return card
