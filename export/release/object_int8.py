"""The object network in int8: the matrix products of points, which take most of its time.

Weights and inputs of the products of `ROUNDED` are rounded; their results, and all else, stay in fp32: engines take
the largest values over points, and add, as fast in fp32.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from edgeperc.errors import ModelError, PointsError
from edgeperc.inference.session import Session
from edgeperc.types.card import ModelCard

from .object_parity import candidate_inputs
from .quantize import N_RUNS, Calibration, folded, saturates, speed_of, training_of
from .to_onnx import halve, with_golden, write_card

ROUNDED = ("close_point2.weight", "close_point3.weight", "close_point4.weight")
MOST = 0.99995  # quantile of a tensor's values that the largest 8-bit number stands for
N_VALUES = 20_000  # of each tensor and batch
BATCH = 64


def quantize_objects(
    path: Path,
    out: Path,
    calibration: Calibration,
    *,
    seven_bits: bool | None = None,
    n_threads: int | None = None,
) -> ModelCard:
    """Write an object network in int8, if it is faster on this computer; parameters as of `quantize`, of scans with
    clusters. Raises RefusedError, ModelError, PointsError.
    """
    card = ModelCard.read(path)
    if card.precision != "fp32":
        raise ModelError(f"{path} is in {card.precision}; quantize the model in fp32")
    batches = list(candidate_batches(card, calibration.scans))
    if not batches:
        raise PointsError(f"no candidate in {len(calibration.scans)} scans to calibrate on; name scans with objects")
    seven_bits = saturates() if seven_bits is None else seven_bits
    model = rounded(folded(path), batches, card.input.name, seven_bits=seven_bits)
    model.producer_name, model.producer_version = "edgeperc", ""
    left_alone = ["the first layer of points", "the first look", "the layers of a candidate"]
    made = {"left_alone": left_alone, "weight_bits": 7 if seven_bits else 8}
    card = replace(
        card, precision="int8", precisions={}, training=training_of(path, card, calibration, made), parity={}
    )
    halve(model.graph, exactly=True)
    card = with_golden(model, card)
    trial = out.with_name(f".{out.name}.trial.onnx")
    try:
        write_card(model, card, trial)
        share = f"{len(ROUNDED)} products in int8, {len(batches[0])} candidates"
        speed = speed_of(path, share, _race(path, trial, batches, n_threads))
        parity = {
            "n_scans": len(calibration.scans),
            "label_agreement": _agreement(path, trial, batches, len(card.classes)),
            "speed": f"{speed}, {len(batches[0])} candidates",
        }
        card = replace(card, parity=parity)
        write_card(model, card, out)
    finally:
        trial.unlink(missing_ok=True)
    return card


def _agreement(one: Path, other: Path, batches: Sequence[NDArray[np.float32]], n_classes: int) -> float:
    """Share of the candidates to which two networks give the same class."""
    classes = []
    for session in (Session(path, "cpu") for path in (one, other)):
        found = []
        for batch in batches:
            session.input[: len(batch)] = batch
            found.append(session.run(len(batch))["objects"][: len(batch), :n_classes].argmax(axis=1))
        classes.append(np.concatenate(found))
    return float((classes[0] == classes[1]).mean())


def _race(
    one: Path, other: Path, batches: Sequence[NDArray[np.float32]], n_threads: int | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times of runs of two networks [ms], in turn, for one batch after the other."""
    sessions = [Session(path, "cpu", n_threads=n_threads) for path in (one, other)]
    times = np.empty((2, N_RUNS))
    for run in range(N_RUNS):
        batch = batches[run % len(batches)]
        for k, session in enumerate(sessions):
            session.input[: len(batch)] = batch
            session.run(len(batch))
            start = time.perf_counter()
            session.run(len(batch))
            times[k, run] = 1e3 * (time.perf_counter() - start)
    return times[0], times[1]


def candidate_batches(card: ModelCard, scans: Sequence[NDArray[np.float32]]) -> Iterator[NDArray[np.float32]]:
    """Inputs of the clusters of scans, (n, points, channels), at most `BATCH` of each."""
    for scan in scans:
        features, _, _ = candidate_inputs(card, scan)
        if len(features):
            yield features[:: max(1, len(features) // BATCH)][:BATCH]


def rounded(
    model: onnx.ModelProto, batches: Sequence[NDArray[np.float32]], input_name: str, *, seven_bits: bool = False
) -> onnx.ModelProto:
    """A folded graph of `with_first_look` with the products of `ROUNDED` in int8: weights by output channel, inputs by
    their range in the batches.
    """
    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    graph = _Graph(copy.graph)
    products = [node for node in copy.graph.node if node.op_type == "Gemm" and node.input[1] in ROUNDED]
    if len(products) != len(ROUNDED):
        raise ValueError(f"the graph has {len(products)} of the {len(ROUNDED)} products; export the network again")
    ranges = _ranges(model, batches, input_name, [node.input[0] for node in products])
    for node in products:
        low, high = ranges[node.input[0]]
        graph.round_weights(node, (high - low) / 255.0, 63 if seven_bits else 127)
        graph.round_input(node, low, high)
    graph.sort()
    return copy


def _ranges(
    model: onnx.ModelProto, batches: Sequence[NDArray[np.float32]], input_name: str, names: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """Smallest and largest value of inner tensors that count; 0 is between them."""
    watched = onnx.ModelProto()
    watched.CopyFrom(model)
    watched.graph.output.extend(helper.make_empty_tensor_value_info(name) for name in names)
    session = onnxruntime.InferenceSession(watched.SerializeToString(), providers=["CPUExecutionProvider"])
    values: Mapping[str, list[NDArray[np.float32]]] = {name: [] for name in names}
    for batch in batches:
        for name, value in zip(names, session.run(list(names), {input_name: batch}), strict=True):
            flat = value.reshape(-1)
            values[name].append(flat[:: max(1, len(flat) // N_VALUES)])
    found = {}
    for name, parts in values.items():
        every = np.concatenate(parts)
        low, high = np.quantile(every, 1.0 - MOST), np.quantile(every, MOST)
        found[name] = (min(float(low), 0.0), max(float(high), 1e-6))
    return found


@dataclass
class _Graph:
    """A graph that is changed."""

    graph: onnx.GraphProto

    def round_input(self, node: onnx.NodeProto, low: float, high: float) -> None:
        """Quantize the input of a product, and dequantize it: engines compute what is between in int8."""
        name, scale = node.input[0], np.float32((high - low) / 255.0)
        self._constant(f"{name}_scale", np.array(scale))
        self._constant(f"{name}_zero", np.array(np.clip(np.round(-low / scale), 0, 255), np.uint8))
        steps = [f"{name}_scale", f"{name}_zero"]
        self.graph.node.extend(
            [
                helper.make_node("QuantizeLinear", [name, *steps], [f"{name}_q"]),
                helper.make_node("DequantizeLinear", [f"{name}_q", *steps], [f"{name}_rounded"]),
            ]
        )
        node.input[0] = f"{name}_rounded"

    def round_weights(self, node: onnx.NodeProto, of_input: float, most: int) -> None:
        """Weights (outputs, inputs) in int8 by output, and offsets in int32, in steps of both scales."""
        values = {weight.name: numpy_helper.to_array(weight) for weight in self.graph.initializer}
        weight, offset = (values[name].astype(np.float64) for name in node.input[1:3])
        scale = (np.maximum(np.abs(weight).max(axis=1), 1e-9) / most).astype(np.float32)
        of_sums = scale * np.float32(of_input)
        numbers: list[tuple[NDArray[Any], NDArray[np.float32]]] = [
            (np.round(weight / scale[:, None]).astype(np.int8), scale),
            (np.round(offset / of_sums).astype(np.int32), of_sums),
        ]
        for k, (integers, steps) in enumerate(numbers, start=1):
            name = node.input[k]
            self._constant(f"{name}_q", integers)
            self._constant(f"{name}_scale", steps)
            self._constant(f"{name}_zero", np.zeros(len(steps), integers.dtype))
            given = [f"{name}_q", f"{name}_scale", f"{name}_zero"]
            self.graph.node.append(helper.make_node("DequantizeLinear", given, [f"{name}_rounded"], axis=0))
            node.input[k] = f"{name}_rounded"

    def sort(self) -> None:
        """Remove weights that nothing reads, and let each node follow what it reads."""
        used = {name for node in self.graph.node for name in node.input}
        weights = [weight for weight in self.graph.initializer if weight.name in used]
        del self.graph.initializer[:]
        self.graph.initializer.extend(weights)
        known = {"", *(weight.name for weight in weights), *(given.name for given in self.graph.input)}
        left, ordered = list(self.graph.node), []
        while left:
            ready = [node for node in left if known.issuperset(node.input)]
            if not ready:
                raise ValueError("the graph has a circle; export the network again")
            ordered += ready
            known |= {name for node in ready for name in node.output}
            left = [node for node in left if not known.issuperset(node.output)]
        del self.graph.node[:]
        self.graph.node.extend(ordered)

    def _constant(self, name: str, value: NDArray[Any]) -> None:
        self.graph.initializer.append(numpy_helper.from_array(value, name))
