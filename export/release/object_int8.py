"""The object network in int8: the matrix products of points, which take most of its time.

Weights and inputs of the products of `ROUNDED` are rounded; their results, and all else, stay in fp32: engines take
the largest values over points, and add, as fast in fp32.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from edgeperc.errors import PointsError
from edgeperc.inference.session import Session
from edgeperc.types.card import ModelCard
from edgeperc.types.points import Floats32

from ..data.scans import LabeledScan
from .int8_graph import sort
from .object_parity import candidate_inputs, object_figures, objects_of
from .quantize import Calibration, check_fp32, few, folded, in_int8, inner_tensors, race, speed_of, write_int8

ROUNDED = ("close_point2.weight", "close_point3.weight", "close_point4.weight")
MOST = 0.99995  # quantile of a tensor's values that the largest 8-bit number stands for
N_VALUES = 20_000  # of each tensor and batch


def quantize_objects(
    path: Path,
    out: Path,
    calibration: Calibration,
    *,
    kitti: Path | None = None,
    seven_bits: bool = True,
    n_threads: int | None = None,
) -> ModelCard:
    """Write an object network in int8, if it is faster here; parameters and errors as of `quantize`. Its card has
    figures only with ``kitti``.
    """
    card = ModelCard.read(path)
    check_fp32(path, card)
    batches = list(candidate_batches(card, calibration.scans))
    if not batches:
        raise PointsError(f"no candidate in {len(calibration.scans)} scans to calibrate on; name scans with objects")

    def compared(trial: Path) -> dict[str, Any]:
        share = f"{len(ROUNDED)} products in int8, {len(batches[0])} candidates"
        speed = speed_of(path, share, race(path, trial, n_threads, batches=batches))
        one, other = (
            np.concatenate([objects_of(session, batch)[:, : len(card.classes)].argmax(axis=1) for batch in batches])
            for session in (Session(each, "cpu") for each in (path, trial))
        )
        parity = {
            "n_scans": len(calibration.scans),
            "label_agreement": float((one == other).mean()),
            "speed": f"{speed}, {len(batches[0])} candidates",
        }
        if kitti is None:
            return {"parity": parity, "metrics": {}}
        figures, command = object_figures(kitti, trial, f"{card.name}:int8")
        return {"parity": parity, "metrics": figures | {"command": command}}

    model = rounded(folded(path), card, batches, seven_bits=seven_bits)
    left_alone = ["the first layer of points", "the first look", "the layers of a candidate"]
    made = {"left_alone": left_alone, "weight_bits": 7 if seven_bits else 8}
    return write_int8(path, out, model, card, calibration, made, compared)


def candidate_batches(card: ModelCard, scans: Sequence[NDArray[Any] | LabeledScan]) -> Iterator[Floats32]:
    """Inputs of the clusters of scans, (n, points, channels), a `few` of each."""
    for scan in scans:
        features, _, _ = candidate_inputs(card, scan.points if isinstance(scan, LabeledScan) else scan)
        if len(features):
            yield features[few(range(len(features)))]


def rounded(
    model: onnx.ModelProto, card: ModelCard, batches: Sequence[Floats32], *, seven_bits: bool = True
) -> onnx.ModelProto:
    """A folded graph of `with_first_look` with the products of `ROUNDED` in int8, inputs by their range in batches."""
    products = [node for node in model.graph.node if node.op_type == "Gemm" and node.input[1] in ROUNDED]
    if len(products) != len(ROUNDED):
        raise ValueError(f"the graph has {len(products)} of the {len(ROUNDED)} products; export the network again")
    ranges = _ranges(model, card, batches, [node.input[0] for node in products])
    names, settings = [node.name for node in products], {"OpTypesToExcludeOutputQuantization": ["Gemm"]}
    made = in_int8(model, names, ranges, ["Gemm"], seven_bits, settings)
    sort(made.graph)
    return made


def _ranges(
    model: onnx.ModelProto, card: ModelCard, batches: Sequence[Floats32], names: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """Smallest and largest value of inner tensors that count; 0 is between them."""
    values: Mapping[str, list[Floats32]] = {name: [] for name in names}
    for tensors in inner_tensors(model, card, batches, names):
        for name, value in tensors.items():
            flat = value.reshape(-1)
            values[name].append(flat[:: max(1, len(flat) // N_VALUES)])
    found = {}
    for name, parts in values.items():
        every = np.concatenate(parts)
        low, high = np.quantile(every, 1.0 - MOST), np.quantile(every, MOST)
        found[name] = (min(float(low), 0.0), max(float(high), 1e-6))
    return found
