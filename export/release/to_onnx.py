"""Export of a torch network to ONNX with a card, and verification of the file.

A file is written only if onnxruntime reproduces the torch network's outputs on every scan tried: raw outputs within
`MAX_DEVIATION`, and the same labels and boxes after post-processing.
"""

from __future__ import annotations

import copy
import hashlib
import json
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from edgeperc.camera.image import ImageScaler
from edgeperc.errors import CardMismatchError, EdgepercError, ModelFileError
from edgeperc.inference.decode import decode_classes, decode_top_view
from edgeperc.inference.projection import make_projector, project
from edgeperc.inference.session import IN_FLOAT32, WHOLE, Session, golden_feed, golden_input, golden_shape
from edgeperc.system.atomic import open_atomic
from edgeperc.types.card import CARD_KEY, Golden, ModelCard
from edgeperc.types.frame import ModelFrame
from edgeperc.types.perception import Box
from edgeperc.types.points import Bytes, Floats32, Mask
from edgeperc.types.views import CameraGeometry, RangeImageGeometry, TopViewGeometry

from ..cards import card_of
from ..data.scan_sets import seen_by_network
from ..data.scans import LabeledScan
from ..data.simulate import fitness_of
from ..networks.lodnn import LoDNN
from ..networks.objects import ObjectNet
from ..networks.segnet import SegNet
from ..networks.ssadnet import SSADNet
from ..recipe import Recipe
from ..training.checkpoint import build_network, read_checkpoint
from .object_graph import with_first_look
from .object_parity import compare_objects

OPSET = 18
# In standard deviations of the output. Measured: 1e-4 for fp32 convolutions summed in another order, and 0.1 or more
# for a wrong operator.
MAX_DEVIATION = 0.03
# Quantile of the differences that is compared. If the two largest values of a pooling window differ by rounding only,
# unpooling may swap their places. The cells around them then differ by 0.011 in a trained network, and by 0.5 with
# random weights. Such places are few.
COMPARED = 0.999
# Weights in half precision changed 0.07 % of the labels of an untrained network, whose logits are close to each other,
# and 0.006 % of a trained one's.
MIN_AGREEMENT = 0.999
# Smaller tensors, such as biases and scales, stay in fp32.
FEWEST_HALVED = 1024
# Networks that unpool stay in fp32: a rounded weight can move a maximum to another cell, which changed outputs by up to
# 0.12 standard deviations.
UNPOOLING = (LoDNN, SegNet, SSADNet)
N_GOLDEN_VALUES = 64
CAMVID_SEQUENCES = ("0001TP_", "0006R0_", "0016E5_", "Seq05VD_")
"""With one of these, the names of its images begin."""
# Terms of weights by the data sets of the real frames and images.
TERMS = {
    "CamVid": (
        "terms of CamVid: free for research; cite Brostow, Fauqueur and Cipolla (2009), and Brostow et al. (2008)"
    ),
    "KITTI": "KITTI: CC BY-NC-SA 3.0",
    "av2": "Argoverse 2: CC BY-NC-SA 4.0",
    "ddad": "DDAD: CC BY-NC-SA 4.0",
    "lyft": "Lyft Level 5: CC BY-NC-SA 4.0",
    "pandaset": "CC BY 4.0, as PandaSet's (Hesai and Scale AI), with its terms of use",
    "semantickitti": "SemanticKITTI: CC BY-NC-SA 4.0",
    "vod": "View of Delft: research only",
}


class ParityError(EdgepercError):
    """The exported graph does not reproduce the network's outputs; nothing was written."""


def load(checkpoint: Path) -> tuple[nn.Module, Recipe, dict[str, Any]]:
    """The averaged network of a checkpoint in inference mode, its recipe, and notes on its training."""
    state = read_checkpoint(checkpoint)
    notes = {name: state[name] for name in ("frames", "n_simulated", "step", "before", "curve", "fitness")}
    return build_network(state, checkpoint).eval(), state["recipe"], notes


def sets_of(names: Iterable[str], camera: bool = False) -> set[str]:
    """The data sets of real frames, SET/NAME or KITTI's, or of a camera's images."""
    if camera:
        return {"CamVid" if name.startswith(CAMVID_SEQUENCES) else "images of another set" for name in names}
    return {name.partition("/")[0] if "/" in name else "KITTI" for name in names}


def terms_of(sets: Iterable[str]) -> str:
    """Terms of weights that were made with scans or images of these sets; empty without one."""
    return "; ".join(TERMS.get(name, f"{name}: terms of that set") for name in sorted(sets))


def _training(recipe: Recipe, notes: Mapping[str, Any]) -> dict[str, Any]:
    """The card's record of the training."""
    frames = notes["frames"]
    simulated = f"{notes['n_simulated']} simulated scans{' in the last run' if notes['before'] else ''}"
    data = f"{len(frames)} real frames, {simulated}" if frames else f"{simulated}, no real frame"
    camera = recipe.task == "camera"
    if camera:
        n_camvid = sum(name.startswith(CAMVID_SEQUENCES) for name in frames)
        of_set = ((n_camvid, "images of CamVid"), (len(frames) - n_camvid, "images of another set"))
        data = ", ".join(f"{n} {images}" for n, images in of_set if n)
    return {
        "data": data,
        "frames": frames,
        "licence": terms_of(sets_of(frames, camera)) or notes["licence"],
        "recipe": json.loads(json.dumps(asdict(recipe))),  # as a card is read again: without tuples
        "steps": notes["step"],
        "started_from": notes["before"],
        "curve": notes["curve"],
    }


def to_graph(network: nn.Module, card: ModelCard) -> onnx.ModelProto:
    """The network as an ONNX graph, without paths and card; it ends with ``blocks`` if the card's outputs have some."""
    example = torch.from_numpy(golden_input(0, golden_shape(card)))
    names = [o.name for o in card.outputs]
    if isinstance(network, ObjectNet):
        look = traced(network.look, "forward", example, card.input.name, names)
        model = with_first_look(look, traced(network, "closely", example, card.input.name, names))
        halve(model.graph)
        return model
    has_blocks = any(output.block != (1, 1) for output in card.outputs)
    model = traced(network, "blocks" if has_blocks else "forward", example, card.input.name, names)
    if not isinstance(network, UNPOOLING):
        halve(model.graph)
    return model


def traced(network: nn.Module, method: str, example: Tensor, input_name: str, names: Sequence[str]) -> onnx.ModelProto:
    """A method of a network as a graph with outputs of these names; the first two of three axes may have any length."""
    exported = network
    if method != "forward":
        exported = copy.copy(network)
        exported.forward = getattr(network, method)
    rows: tuple[Any, ...] = ({0: torch.export.Dim("candidates"), 1: torch.export.Dim("points")},)
    with warnings.catch_warnings():  # the exporter warns about its own future changes
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            exported.eval(),
            (example,),
            input_names=[input_name],
            output_names=[*names],
            opset_version=OPSET,
            dynamic_shapes=rows if example.ndim == 3 else None,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    # The exporter adds stack traces, with paths of this computer, to every node.
    stripped = [model, model.graph, *model.graph.node, *model.graph.value_info, *model.graph.input]
    for holder in [*stripped, *model.graph.output, *model.graph.initializer, *model.functions]:
        if hasattr(holder, "metadata_props"):
            del holder.metadata_props[:]
        if hasattr(holder, "doc_string"):
            holder.doc_string = ""
    model.producer_name, model.producer_version = "edgeperc", ""
    return model


def halve(graph: onnx.GraphProto) -> None:
    """Store large weights in half precision; engines convert them on loading."""
    casts = []
    for weight in graph.initializer:
        values = onnx.numpy_helper.to_array(weight)
        if values.dtype != np.float32 or values.size < FEWEST_HALVED:
            continue
        with np.errstate(over="ignore"):
            half = values.astype(np.float16)
        name = weight.name
        weight.CopyFrom(onnx.numpy_helper.from_array(half, f"{name}_half"))
        casts.append(onnx.helper.make_node("Cast", [weight.name], [name], to=onnx.TensorProto.FLOAT))
    kept = list(graph.node)
    del graph.node[:]
    graph.node.extend([*casts, *kept])


def write_card(model: onnx.ModelProto, card: ModelCard, path: Path, *, trusted: bool = False) -> None:
    """Write a graph, of any network whose view and outputs a card knows, with its card in place of one in it, and read
    it back by a `Session`. Raises CardError, CardMismatchError, ModelFileError, ParityError.
    """
    kept = [p for p in model.metadata_props if p.key != CARD_KEY]
    del model.metadata_props[:]
    model.metadata_props.extend(kept)
    model.metadata_props.add(key=CARD_KEY, value=card.to_json())
    with open_atomic(path) as file:
        file.write(model.SerializeToString(deterministic=True))
        file.flush()
        try:
            session = Session(Path(file.name), "cpu", trusted=trusted)
        except EdgepercError as exc:
            raise type(exc)(str(exc).replace(file.name, str(path))) from exc
        if session.card.to_json() != card.to_json():
            raise ParityError(f"{path}: the card read back differs from the card written")


def write_checked(
    model: onnx.ModelProto, card: ModelCard, path: Path, check: Callable[[Path], Mapping[str, Any]]
) -> ModelCard:
    """Write a graph with its card, a golden record, and what ``check`` of a trial file adds to the card, if it raises
    nothing. Raises as `write_card` and the check.
    """
    card = with_golden(model, card)
    trial = path.with_name(f".{path.name}.trial.onnx")
    try:
        write_card(model, card, trial)
        card = replace(card, **check(trial))
        write_card(model, card, path)
    finally:
        trial.unlink(missing_ok=True)
    return card


def with_golden(model: onnx.ModelProto, card: ModelCard) -> ModelCard:
    """The card with a golden record: a known input, and this computer's outputs for it."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # weights that are inputs, too, as mmdeploy leaves them, have a warning each
    try:
        session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    except Exception as exc:  # onnxruntime's errors share no base but Exception
        raise ModelFileError(f"onnxruntime {onnxruntime.__version__} cannot open the graph: {exc}") from exc
    feed = golden_feed(card, 0)
    x = feed[card.input.name]
    nodes = session.get_inputs()
    if {node.name for node in nodes} != {*feed}:
        raise CardMismatchError(f"card names inputs {[*feed]}, the graph has {[node.name for node in nodes]}")
    names, present = [o.name for o in card.outputs], [node.name for node in session.get_outputs()]
    if not {*names} <= {*present}:
        raise CardMismatchError(f"card names outputs {names}, the graph has {present}")
    for node in nodes:
        kind = WHOLE.get(node.type.removeprefix("tensor(").removesuffix(")"))
        if kind is None:
            raise CardMismatchError(f"{node.name!r} is {node.type} in the graph; {IN_FLOAT32}")
        n_more = max(node.shape[0] - len(x), 0) if len(feed) > 1 and isinstance(node.shape[0], int) else 0
        padding = [(0, n_more), *[(0, 0)] * (feed[node.name].ndim - 1)]
        feed[node.name] = np.pad(feed[node.name], padding, mode="edge").astype(kind)
    try:
        outputs = session.run(names, feed)
    except Exception as exc:  # as above
        shapes = {name: array.shape for name, array in feed.items()}
        raise CardMismatchError(f"the graph does not run on inputs as the card declares them, {shapes}: {exc}") from exc
    records = {}
    for spec, output in zip(card.outputs, outputs, strict=True):
        expected = card.shape_of(spec)
        if len(expected) != output.ndim or any(n not in (None, m) for n, m in zip(expected, output.shape, strict=True)):
            raise CardMismatchError(
                f"{spec.name!r} has shape {output.shape} in the graph; its card declares {expected}"
            )
        if not np.isfinite(output).all():
            raise CardMismatchError(
                f"the graph gives values of {spec.name!r} that are not finite for an input of noise in -1 to 1; look "
                "for NaN among its weights, and for logarithms, roots and divisions"
            )
        few = output.size <= N_GOLDEN_VALUES
        at = np.arange(output.size) if few else np.random.default_rng(0).integers(output.size, size=N_GOLDEN_VALUES)
        records[spec.name] = {
            "sha256": hashlib.sha256(output.tobytes()).hexdigest(),
            "std": float(output.std()),
            "positions": [int(i) for i in at],
            "values": [float(v) for v in output.reshape(-1)[at]],
        }
    return replace(card, golden=Golden(0, hashlib.sha256(x.tobytes()).hexdigest(), records))


def views(card: ModelCard, samples: Sequence[NDArray[Any] | LabeledScan]) -> Iterator[tuple[Floats32, Mask]]:
    """The network's input of each scan or image, (C, H, W) float32, and the pixels with a return, (H, W) bool."""
    if isinstance(card.view, CameraGeometry):
        scaler = ImageScaler(card.view, card.input)
        for sample in samples:
            image = np.empty(scaler.shape, np.float32)
            assert not isinstance(sample, LabeledScan)
            scaler.fill(sample, image)
            yield image, np.ones(image.shape[1:], np.bool_)
        return
    assert isinstance(card.view, RangeImageGeometry | TopViewGeometry)  # `compare_objects` makes inputs of objects
    projector, seen_from = make_projector(card.view, card.input), ModelFrame.of_training(card.mount_height_m)
    for sample in samples:
        projected = (
            seen_by_network(projector, sample, seen_from)[1]
            if isinstance(sample, LabeledScan)
            else project(projector, np.ascontiguousarray(sample, np.float32), seen_from)
        )
        yield projected.image.copy(), projected.index >= 0


def pixel_labels(raw: Floats32, kind: str) -> Bytes:
    """Labels (h, w) of raw outputs (C, h, w) of a kind of classes, at the outputs' own resolution."""
    return raw.argmax(0).astype(np.uint8) if kind == "camera_logits" else decode_classes(raw, kind)[0]


def verify(network: nn.Module, path: Path, scans: Sequence[NDArray[Any]]) -> dict[str, float]:
    """Compare an exported model with its torch network on scans or images: the 99.9 % quantile of differences in
    standard deviations, the smallest share of equal labels, the largest difference of boxes [m]. Raises ParityError.
    """
    session = Session(path, "cpu")
    if isinstance(network, ObjectNet):
        return _checked_parity(path, len(scans), *compare_objects(network, session, scans))
    card, worst, agreement, box_deviation = session.card, 0.0, 1.0, 0.0
    for image, returned in views(card, scans):
        with torch.no_grad():
            outputs = network.eval()(torch.from_numpy(image[None]))
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        session.input[:] = image
        actual = session.run()
        expected = {o.kind: output[0].numpy() for o, output in zip(card.outputs, outputs, strict=True)}
        for kind, values in expected.items():
            difference = np.quantile(np.abs(actual[kind] - values), COMPARED)
            worst = max(worst, float(difference) / max(float(values.std()), 1e-6))
        if card.view.kind == "top_view":
            (labels, boxes), (expected_labels, expected_boxes) = (
                decode_top_view(card, returned, raw, card.score_threshold) for raw in (actual, expected)
            )
            kinds, expected_kinds = (sorted(box.label for box in found) for found in (boxes, expected_boxes))
            if kinds != expected_kinds:
                raise ParityError(f"{path}: onnxruntime finds the boxes {kinds}, torch {expected_kinds}")
            box_deviation = max(box_deviation, _deviation(boxes, expected_boxes))
        else:
            ((kind, logits),) = expected.items()
            labels, expected_labels = (pixel_labels(raw, kind) for raw in (actual[kind], logits))
        agreement = min(agreement, float((labels == expected_labels).mean()))
    return _checked_parity(path, len(scans), worst, agreement, box_deviation)


def _checked_parity(path: Path, n_scans: int, worst: float, agreement: float, box_deviation: float) -> dict[str, float]:
    """What the card says of the differences; raises `ParityError` if one exceeds its limit."""
    if worst > MAX_DEVIATION or agreement < MIN_AGREEMENT or box_deviation > 0.05:
        raise ParityError(
            f"{path}: raw outputs differ by {worst:.3g} standard deviations (at most {MAX_DEVIATION}), labels "
            f"agree on {agreement:.4%} of the pixels or candidates (at least {MIN_AGREEMENT:.2%}), boxes differ by up "
            f"to {box_deviation:.3g} m (at most 0.05)"
        )
    return {"n_scans": n_scans, "max_deviation": worst, "label_agreement": agreement, "box_deviation": box_deviation}


def _deviation(boxes: Sequence[Box], expected: Sequence[Box]) -> float:
    """The largest difference of a center or a size [m]. Boxes of almost the same score may come in another order."""
    left, worst = list(boxes), 0.0
    for other in expected:
        difference, k = min(
            (float(np.abs(np.subtract([*box.center, *box.size], [*other.center, *other.size])).max()), k)
            for k, box in enumerate(left)
            if box.label == other.label
        )
        worst = max(worst, difference)
        del left[k]
    return worst


def export(
    checkpoint: Path,
    path: Path,
    *,
    scans: Sequence[NDArray[Any]],
    kitti: Path | None = None,
    name: str | None = None,
    version: str = "1.0.0",
    metrics: Mapping[str, Any] | None = None,
    licence: str = "Apache-2.0",
) -> ModelCard:
    """Export a checkpoint, verify the file on scans, and write it with its card; ``kitti``: scans to describe, of one
    that does not describe its real ones; ``licence``: of weights trained on simulation alone (others: `TERMS`). Raises
    ParityError.
    """
    network, recipe, notes = load(checkpoint)
    fitness = None if recipe.task in ("camera", "objects") else notes.pop("fitness") or fitness_of(kitti)
    card = card_of(
        recipe,
        name=name or recipe.network,
        version=version,
        fitness=None if fitness is None else fitness.to_dict(),
        training=_training(recipe, notes | {"licence": licence}),
        metrics=dict(metrics or {}),
    )
    return write_checked(to_graph(network, card), card, path, lambda trial: {"parity": verify(network, trial, scans)})
