"""The int8 variant of a model: written only if it is faster on this computer and as accurate.

Weights become int8 per channel, activations uint8. Of the pairs that onnxruntime's CPU provider supports, u8s8 has the
fast kernels (u8u8 took twice as long). Nearly all of the noise is of activations: with ssadnet's inner convolutions in
int8 it is 32 dB below the outputs, with weights alone 44 dB. The range of a tensor is the one that makes least noise,
clipping included; clipping one value in ten thousand instead gives 29 dB. The first and last convolutions stay in fp32,
and also those that make most noise for the time they take.

A top view is mostly empty, and all its empty cells have the same values, so rounding shifts them all in the same
direction. Where the noise is above the limit, the bias of each convolution is corrected by the mean shift (Nagel et
al., "Data-Free Quantization Through Weight Equalization and Bias Correction", 2019, section 4.2), and the channels of a
tensor get the same size before (`equalize`). Together they lower ssadnet's noise from 29 to 34 dB with all inner
convolutions in int8.
"""

from __future__ import annotations

import copy
import hashlib
import re
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationMethod, QDQQuantizer, QuantType
from onnxruntime.quantization.calibrate import TensorsData
from tqdm import tqdm

from edgeperc.datasets.images import LabeledImages, image_hash
from edgeperc.datasets.kitti import SEQUENCE_DRIVES, KittiObjects, SemanticKitti, scan_hash
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.datasets.splits import in_split
from edgeperc.errors import EdgepercError, ModelError, OptionError, PointsError, SplitError
from edgeperc.evaluation.camvid import evaluate_images
from edgeperc.evaluation.evaluate import evaluate
from edgeperc.evaluation.judge import NETWORK_ALONE, Judge
from edgeperc.evaluation.tables import Record
from edgeperc.evaluation.tables import figures as figures_of
from edgeperc.evaluation.truth import Truth
from edgeperc.inference.session import Session
from edgeperc.preprocess.findings import check_fitness
from edgeperc.preprocess.fitness import FitnessProfile
from edgeperc.readers.files import read_points
from edgeperc.simulation import samples
from edgeperc.simulation.samples import simulated_scan
from edgeperc.system.names import SCAN_SUFFIXES
from edgeperc.types.card import ModelCard
from edgeperc.types.points import Floats, Floats32, Ints64

from ..data.beams import drawn_sensor, taken_by
from ..data.scan_sets import check_trains, read_scan_set
from ..data.scans import TRAINING_SENSOR, LabeledScan
from ..data.simulate import parity_samples
from .int8_graph import equalize, repeat_pixels
from .to_onnx import halve, pixel_labels, sets_of, terms_of, views, write_checked

# Operators that onnxruntime's CPU provider computes in int8. It has no int8 kernel for ConvTranspose, Elu or Equal.
ROUNDED_OPS = (
    *("Add", "Concat", "Conv", "DepthToSpace", "MaxPool", "Mul", "Relu", "Reshape", "Resize", "Sigmoid", "Transpose"),
)
FIRST_SEED = 3 * 10**9  # seeds of training start at 0, of parity scans at 10**9, of evaluation at 2 * 10**9
N_PROBES = 8
# Powers of the channels' sizes that are made equal before the shift is corrected; None: neither. The first that keeps
# the noise below the limit is taken, else the one with least noise.
STRENGTHS = (None, 0.0, 0.5, 1.0)
# Limit of `_noise`, 33 dB below the outputs of the probes. ssadnet has 4.4e-4 with all inner convolutions in int8, and
# loses 1 of 255 boxes on the validation drives.
MAX_NOISE = 5e-4
# A loss counts if it is larger than this, and if its 95 % interval over drives is above 0. One lost box of 255 on the
# validation drives changes F1 by 0.002; eleven-point AP changes by 0.09 where it costs the last level of recall.
MAX_LOSS = 0.01
N_RESAMPLES = 200
CLIPPED_TO = tuple(np.geomspace(0.02, 1.0, 48).tolist())  # shares of the largest value that are tried as a range
BIN_BITS = 13  # of a float32: sign, exponent and four bits of the mantissa
N_RUNS = 40
DRIVE = re.compile(r"\d{4}_\d\d_\d\d_drive_\d{4}")

T = TypeVar("T")
Ranges = Mapping[str, tuple[float, float]]
"""Smallest and largest value of tensors, by name."""
Race = Callable[[Path, Path, "int | None"], tuple[Floats, Floats]]


class RefusedError(EdgepercError):
    """The int8 model is not faster on this computer, or less accurate; nothing was written."""


class Calibration(NamedTuple):
    """What the ranges of tensors are measured on."""

    scans: Sequence[NDArray[Any] | LabeledScan]
    """(n, 4) float32, or as a training sees them; of a camera's model images (H, W, 3) uint8."""
    frames: Mapping[str, str] = MappingProxyType({})
    """Names of the real ones (`sets_of`) -> `scan_hash` or `image_hash`: the model is never evaluated on them."""


@dataclass(frozen=True, slots=True)
class LabeledSets:
    """What two models are compared on."""

    kitti: Path | None = None  # its validation drives; the card's figures are of its test drives
    semantickitti: Path | None = None  # its roads
    camvid: Path | None = None  # its validation images
    n_simulated: int = 48  # scans, other than those of the calibration


Losses = Mapping[str, tuple[float, float, float, float]]
"""Name of a score -> the score in fp32 and in int8, and the 95 % interval of the loss."""


def calibration_scans(
    paths: Sequence[Path] = (),
    sets: Sequence[ScanFolder] = (),
    *,
    kitti: Path | None = None,
    n_simulated: int = 0,
    fitness: FitnessProfile | None = None,
    sparse: bool = False,
) -> Calibration:
    """Scans to calibrate on: files or folders, like those of ``fitness``; 64 of the training drives of KITTI and of
    each set; simulated. ``sparse``: as sparse sensors take them. Raises SplitError, PointsError.
    """
    files = [file for path in paths for file in (_scans_in(path) if path.is_dir() else [path])]
    for file in files:
        drive = _drive(file)
        if drive is not None and not in_split(drive, "train"):
            raise SplitError(f"{file} is of drive {drive}, which is kept for evaluation; calibrate on other drives")
    scans: list[NDArray[Any] | LabeledScan] = []
    frames: dict[str, str] = {}
    for file in files:
        points = read_points(file)
        found = check_fitness(points, fitness, TRAINING_SENSOR) if fitness is not None else ()
        if gross := next((finding for finding in found if finding.gross), None):
            raise PointsError(
                f"{file} is not as the network sees scans ({gross}) Give scans of another sensor as --scans FOLDER, "
                "with a scans.json that describes it (docs/howto/train.md)"
            )
        number = scan_hash(points)
        name = number if _drive(file) is not None else f"scans to calibrate on/{number}"
        scans += [points] if name not in frames else []  # the same scan once
        frames[name] = number
    if kitti is not None:
        objects = KittiObjects(kitti)
        for frame in map(objects.frame, few(objects.names("train", grades="AB"))):
            scans.append(frame.points)
            frames[frame.name] = scan_hash(frame.points)
    for folder in sets:
        check_trains(folder, "train")
        of_set, _, own = read_scan_set(folder, "train")
        scans += few(of_set)
        frames |= dict(few([*own.items()]))
    scans += [simulated_scan(FIRST_SEED + k).points for k in range(n_simulated)]
    if not scans:
        asked = f"{len(paths)} paths, KITTI root {kitti}, {n_simulated} simulated scans"
        raise PointsError(f"no scan to calibrate on in {asked}; name scans, a root with training drives, or simulate")
    if sparse:
        rng = np.random.default_rng(FIRST_SEED)
        every = [scan if isinstance(scan, LabeledScan) else LabeledScan.unlabeled(scan) for scan in scans]
        scans = [taken_by(drawn_sensor(rng, sparse=True), scan, rng, of_any=True) for scan in every]
    return Calibration(scans, frames)


def _scans_in(folder: Path) -> list[Path]:
    files = sorted(file for file in folder.rglob("*") if file.name.lower().endswith(SCAN_SUFFIXES))
    if not files:
        raise PointsError(f"no scan to calibrate on in {folder}; expected files named {', '.join(SCAN_SUFFIXES)}")
    return files


def few(each: Sequence[T], most: int | None = 64) -> Sequence[T]:
    """At most so many, evenly spread; None: all."""
    n = len(each) if most is None else min(most, len(each))
    return [each[k * len(each) // n] for k in range(n)]


def calibration_images(camvid: Path) -> Calibration:
    """64 training images of CamVid, evenly spread."""
    data = LabeledImages(camvid)
    images = {file.stem: data.read(file)[0] for file in few(data.files("train"))}
    return Calibration([*images.values()], {name: image_hash(image) for name, image in images.items()})


def _drive(file: Path) -> str | None:
    """The KITTI drive of a scan; None if its folders do not show it."""
    file = file.resolve()
    if named := DRIVE.search(str(file)):
        return named[0]
    if file.parent.parent.parent.name == "sequences":
        return SEQUENCE_DRIVES.get(file.parent.parent.name)
    root = file.parent.parent.parent
    return KittiObjects(root).drives.get(file.stem) if (root / "frames.csv").exists() else None


def folded(path: Path) -> onnx.ModelProto:
    """The graph with folded constants (half-precision weights become fp32), and a name for every node."""
    with tempfile.TemporaryDirectory() as folder:
        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        options.optimized_model_filepath = f"{folder}/folded.onnx"
        options.log_severity_level = 3
        onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
        model = onnx.load(options.optimized_model_filepath)
    for k, node in enumerate(model.graph.node):
        node.name = node.name or f"node_{k}"
    used = {node.domain for node in model.graph.node}
    kept = [entry for entry in model.opset_import if entry.domain in used]
    del model.opset_import[:]
    model.opset_import.extend(kept)
    return onnx.shape_inference.infer_shapes(model)


@dataclass(frozen=True)
class Calibrated:
    """A network in fp32, the ranges of its tensors, its outputs for some images, and means of convolutions."""

    card: ModelCard
    model: onnx.ModelProto
    ranges: Ranges
    images: Sequence[Floats32]
    means: Mapping[str, Floats]
    probes: Sequence[Floats32]
    outputs: Sequence[Mapping[str, Floats32]]
    seven_bits: bool

    @classmethod
    def on(
        cls,
        path: Path,
        card: ModelCard,
        scans: Sequence[NDArray[Any] | LabeledScan],
        seven_bits: bool = True,
        strength: float | None = None,
    ) -> Calibrated:
        """Calibrate the model of a file on scans, or images, with one of `STRENGTHS`."""
        model, images = folded(path), [image[None] for image, _ in views(card, scans)]
        probes = few(images, N_PROBES)
        outputs = _outputs(model, card, probes)
        names = [name for node in model.graph.node for name in node.output if name]
        if strength:
            sizes = {name: np.zeros(1) for name in names}
            for tensors in inner_tensors(model, card, images, names):
                sizes |= {name: np.maximum(sizes[name], _by_channel(abs(v)).max(1)) for name, v in tensors.items()}
            equalize(model, {name: size**strength for name, size in sizes.items()})
        made = [node.output[0] for node in model.graph.node if node.op_type == "Conv"]
        means = {} if strength is None else channel_means(model, card, images, made)
        return cls(card, model, _ranges(model, card, images), images, means, probes, outputs, seven_bits)

    def rounded(self, convolutions: Collection[str]) -> onnx.ModelProto:
        """The network with these convolutions, and the operators between them, in int8."""
        model = copy.deepcopy(self.model)
        biases = {each.name: each for each in model.graph.initializer}
        corrected = [node for node in model.graph.node if node.name in convolutions and node.output[0] in self.means]
        for node in [node for node in corrected if len(node.input) > 2]:
            rounded = self._rounded(model, convolutions)
            (made,) = (each.output[0] for each in rounded.graph.node if each.name == node.name)
            shift = channel_means(rounded, self.card, self.images, [made])[made] - self.means[node.output[0]]
            bias = biases[node.input[2]]
            values = onnx.numpy_helper.to_array(bias)
            bias.CopyFrom(onnx.numpy_helper.from_array((values - shift).astype(values.dtype), bias.name))
        rounded = self._rounded(model, convolutions)
        repeat_pixels(rounded)
        return rounded

    def _rounded(self, fp32: onnx.ModelProto, convolutions: Collection[str]) -> onnx.ModelProto:
        return in_int8(fp32, _between(fp32.graph, convolutions), self.ranges, ROUNDED_OPS, self.seven_bits)

    def noise(self, convolutions: Collection[str]) -> float:
        """`_noise` of the outputs if these convolutions are in int8."""
        return _noise(_outputs(self.rounded(convolutions), self.card, self.probes), self.outputs)


def _ranges(model: onnx.ModelProto, card: ModelCard, images: Sequence[Floats32]) -> Ranges:
    """The range of every tensor of a network, from a histogram of its values over all images."""
    names = [card.input.name, *(name for node in model.graph.node for name in node.output if name)]
    counts = {name: np.zeros(1 << BIN_BITS, np.int64) for name in names}
    for tensors in tqdm(inner_tensors(model, card, images, names), desc="calibrating", total=len(images), unit="scan"):
        for name, values in tensors.items():
            if values.dtype == np.float32:
                bins = np.ascontiguousarray(values).view(np.uint32).ravel() >> (32 - BIN_BITS)
                counts[name] += np.bincount(bins, minlength=1 << BIN_BITS)
    return {name: range_of(count) for name, count in counts.items()}


def in_int8(
    fp32: onnx.ModelProto,
    names: Collection[str],
    ranges: Ranges,
    kinds: Sequence[str],
    seven_bits: bool,
    settings: Mapping[str, Any] | None = None,
) -> onnx.ModelProto:
    """A graph with the operators of these names and kinds in int8; ``settings`` are onnxruntime's."""
    if not names:
        return copy.deepcopy(fp32)
    bounds = {name: tuple(np.array(bound, np.float32) for bound in of) for name, of in ranges.items()}
    given: Sequence[Any]
    given = QuantType.QInt8, QuantType.QUInt8, TensorsData(CalibrationMethod.MinMax, bounds), [*names], [], [*kinds]
    quantizer = QDQQuantizer(copy.deepcopy(fp32), True, seven_bits, *given, dict(settings or {}))
    quantizer.quantize_model()
    rounded: onnx.ModelProto = quantizer.model.model
    _unround(rounded.graph, names)
    return rounded


def inner_tensors(
    model: onnx.ModelProto, card: ModelCard, images: Sequence[Floats32], names: Sequence[str]
) -> Iterator[dict[str, NDArray[Any]]]:
    """Inner tensors of a network by their names, for one image after the other."""
    augmented = copy.deepcopy(model)
    known = {each.name for each in (*model.graph.input, *model.graph.output)}
    augmented.graph.output.extend(onnx.helper.make_empty_tensor_value_info(name) for name in names if name not in known)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(augmented.SerializeToString(), options, providers=["CPUExecutionProvider"])
    inner = [name for name in names if name != card.input.name]
    for image in images:
        own = {card.input.name: image} if len(inner) < len(names) else {}
        yield own | dict(zip(inner, session.run(inner, {card.input.name: image}), strict=True))


def _by_channel(values: NDArray[Any]) -> NDArray[Any]:
    """The values of a tensor (1, C, ...) as (C, n)."""
    return values.reshape(values.shape[1], -1) if values.ndim > 1 else values.reshape(1, -1)


def channel_means(
    model: onnx.ModelProto, card: ModelCard, images: Sequence[Floats32], names: Sequence[str]
) -> dict[str, Floats]:
    """Mean of each channel of some tensors (1, C, ...) over all images."""
    sums: dict[str, Floats] = {}
    for tensors in inner_tensors(model, card, images, names):
        for name, values in tensors.items():
            sums[name] = sums.get(name, 0.0) + _by_channel(values).mean(axis=1, dtype=np.float64) / len(images)
    return sums


def range_of(counts: Ints64) -> tuple[float, float]:
    """The range that makes least noise in 8 bits: squares of what is clipped, and of what is rounded inside."""
    taken = np.flatnonzero(counts)
    middle = (taken.astype(np.uint32) << np.uint32(32 - BIN_BITS)) + np.uint32(1 << (31 - BIN_BITS))
    values, weights = middle.view(np.float32).astype(np.float64), counts[taken]
    usual = np.isfinite(values) & (np.abs(values) > 1e-30)  # the rest are zeros
    values, weights = values[usual], weights[usual]
    least, most = min(values.min(initial=0.0), 0.0), max(values.max(initial=0.0), 0.0)
    lows = np.multiply(least, CLIPPED_TO if least < 0.0 else (1.0,))[:, None]
    highs = np.multiply(most, CLIPPED_TO if most > 0.0 else (1.0,))
    steps, below, above = (highs - lows) / 255.0, values < 0.0, values > 0.0
    noise = _noise_of_side(-values[below], weights[below], -lows, steps)
    noise = noise + _noise_of_side(values[above], weights[above], highs, steps)
    low, high = np.unravel_index(noise.argmin(), noise.shape)
    return float(lows[low, 0]), float(highs[high])


def _noise_of_side(sizes: Floats, weights: Ints64, bounds: Floats, steps: Floats) -> Floats:
    """Noise of the values on one side of zero, by their sizes, if a bound clips them and a step rounds them."""
    order = np.argsort(sizes)
    sizes, weights = sizes[order], weights[order]
    squares, n = (np.concatenate(([0], np.cumsum(each))) for each in (weights * sizes**2, weights))
    inside = np.searchsorted(sizes, bounds, "right")
    kept = np.minimum(inside, np.searchsorted(sizes, steps / 12.0**0.5))  # smaller than their rounding
    clipped = [weights[k:] @ (sizes[k:] - bound) ** 2 for k, bound in zip(inside.flat, bounds.flat, strict=True)]
    return np.reshape(clipped, bounds.shape) + squares[kept] + steps**2 / 12.0 * (n[inside] - n[kept])


def _between(graph: onnx.GraphProto, convolutions: Collection[str]) -> set[str]:
    """The convolutions, and the operators whose inputs all come from rounded operators."""
    constants = {"", *(weight.name for weight in graph.initializer)}
    names: set[str] = set()
    tensors: set[str] = set()
    for node in graph.node:
        inner = node.op_type in ROUNDED_OPS and node.op_type != "Conv"
        if node.name in convolutions or (inner and set(node.input) - constants <= tensors):
            names.add(node.name)
            tensors |= {*node.output}
    return names


def _unround(graph: onnx.GraphProto, rounded: Collection[str]) -> None:
    """Connect operators in fp32 to outputs in fp32: SSADNet's unpooling compares a tensor with its maxima."""
    maker = {output: node for node in graph.node for output in node.output}
    origin = {}
    for node in graph.node:
        if node.op_type == "DequantizeLinear" and (quantize := maker.get(node.input[0])) is not None:
            made_by = maker.get(quantize.input[0])
            if made_by is None or made_by.name not in rounded:
                origin[node.output[0]] = quantize.input[0]
    for node in graph.node:
        if node.name not in rounded and node.op_type not in ("QuantizeLinear", "DequantizeLinear"):
            node.input[:] = [origin.get(name, name) for name in node.input]


def _outputs(model: onnx.ModelProto, card: ModelCard, images: Sequence[Floats32]) -> list[dict[str, Floats32]]:
    """Raw outputs by kind, without the batch axis."""
    runs = inner_tensors(model, card, images, [o.name for o in card.outputs])
    return [{o.kind: run[o.name][0] for o in card.outputs} for run in runs]


def _noise(outputs: Sequence[Mapping[str, Floats32]], expected: Sequence[Mapping[str, Floats32]]) -> float:
    """Squared error as a share of the squares, of the worst output; it hardly depends on single labels or boxes."""
    shares = []
    for kind in expected[0]:
        pairs = [(one[kind].astype(np.float64), other[kind]) for one, other in zip(expected, outputs, strict=True)]
        error = sum(float(((right - own) ** 2).sum()) for right, own in pairs)
        shares.append(error / max(sum(float((right**2).sum()) for right, _ in pairs), 1e-30))
    return max(shares)


def find_candidates(graph: onnx.GraphProto, exclude: Collection[str]) -> list[str]:
    """Convolutions that may be rounded: not excluded, not the first after an input or the last before an output."""
    unknown = set(exclude) - {node.name for node in graph.node}
    if unknown:
        raise OptionError(f"no node is called {', '.join(sorted(unknown))}; expected names of the graph's nodes")
    inputs, maker = {i.name for i in graph.input}, {output: node for node in graph.node for output in node.output}
    last, pending = set(), [o.name for o in graph.output]
    while pending:
        node = maker.get(pending.pop())
        if node is not None and node.op_type == "Conv":
            last.add(node.name)
        elif node is not None:
            pending += node.input
    convolutions = [node for node in graph.node if node.op_type == "Conv" and node.name not in last | set(exclude)]
    return [node.name for node in convolutions if node.input[0] not in inputs]


def _multiplications(model: onnx.ModelProto) -> dict[str, int]:
    """Multiplications of each convolution, by its name."""
    sizes = {weight.name: tuple(weight.dims) for weight in model.graph.initializer}
    for value in (*model.graph.value_info, *model.graph.output):
        sizes[value.name] = tuple(dim.dim_value for dim in value.type.tensor_type.shape.dim)
    convolutions = [node for node in model.graph.node if node.op_type == "Conv"]
    return {node.name: int(np.prod(sizes[node.input[1]]) * np.prod(sizes[node.output[0]][2:])) for node in convolutions}


def _choose(fp32: Calibrated, candidates: Sequence[str], limit: float, noise: float) -> tuple[list[str], float]:
    """The convolutions to round, and their noise: all, which make ``noise``, or as many as the limit allows; those with
    most noise for their time are left out first. At most n + log2(n) trials for n convolutions.
    """
    if noise <= limit:
        return [*candidates], noise
    times = _multiplications(fp32.model)
    alone = {
        name: fp32.noise([name]) / times[name] for name in tqdm(candidates, desc="rounding one at a time", unit="layer")
    }
    ranked = sorted(candidates, key=lambda name: alone[name])
    fewest, most, kept = 0, len(ranked), 0.0
    while most - fewest > 1:
        middle = (fewest + most) // 2
        noise = fp32.noise(ranked[:middle])
        if noise <= limit:
            fewest, kept = middle, noise
        else:
            most = middle
    if fewest == 0 and ranked:
        quiet = min(ranked, key=lambda name: alone[name] * times[name])
        least = alone[quiet] * times[quiet]
        if least > limit:
            raise RefusedError(
                f"no layer became int8: rounding the quietest of {len(ranked)} layers alone, {quiet}, makes noise of "
                f"{least:.1e} of the outputs, above the limit of {limit:.0e}; calibrate on more scans, of your sensor"
            )
        return [quiet], least
    return ranked[:fewest], kept


def race(
    one: Path, other: Path, n_threads: int | None, n_runs: int = N_RUNS, batches: Sequence[Floats32] = ()
) -> tuple[Floats, Floats]:
    """Times of runs of two networks [ms], in turn, for one batch of rows after the other; the first is a warm-up."""
    sessions = [Session(path, "cpu", n_threads=n_threads) for path in (one, other)]
    times = np.empty((2, n_runs))
    for run in range(n_runs):
        rows = batches[run % len(batches)] if batches else sessions[0].input[:1]
        for k, session in enumerate(sessions):
            session.input[: len(rows)] = rows
            session.run(len(rows))
            start = time.perf_counter()
            session.run(len(rows))
            times[k, run] = 1e3 * (time.perf_counter() - start)
    return times[0], times[1]


def _scores(figures: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """IoU of each class of points and cells, and F1 of boxes and road, over all ranges, by name."""
    scores = {}
    for block, of in figures.items():
        for name, row in of.get("points", {}).get("all", {}).items():
            scores[f"{block} {name} IoU"] = row["iou"]
        for table, bands in of.get("segmentation", {}).items():
            scores |= {f"{block} {table} {name} IoU": iou for name, iou in bands["all"]["iou"].items()}
        for kind, bands in of.get("boxes", {}).items():
            row = bands["all"]["vehicle"]
            if row["precision"] and row["recall"]:
                scores[f"{block} {kind} vehicle F1"] = 2.0 / (1.0 / row["precision"] + 1.0 / row["recall"])
        if road := of.get("road"):
            scores[f"{block} road F1"] = road["all"]["f1"]
        if block == "images":
            scores["image mean IoU"] = of["all"]["mean_iou"]
    return {name: score for name, score in scores.items() if score is not None and np.isfinite(score)}


def _compared(before: Path, after: Path, labeled: LabeledSets) -> list[dict[str, list[Record]]]:
    """Counts of both models on KITTI's validation drives, on SemanticKITTI's roads and on simulated scans, by set."""
    judges = [Judge([path], NETWORK_ALONE) for path in (before, after)]
    read = judges[1]  # it was also calibrated on scans, which must not be among these

    truths: list[tuple[str, Callable[[Any], Truth], Any]]  # made one after the other
    truths = [("simulated", read.simulated, samples.FIRST_SEED + k) for k in range(labeled.n_simulated)]
    if labeled.kitti is not None:
        objects = KittiObjects(labeled.kitti)
        names = objects.names("validation") or objects.names("test")  # a set of other drives has no validation drives
        truths += [("real", lambda name: read.kitti(objects.frame(name)), name) for name in names]
    if labeled.semantickitti is not None and read.from_above is not None:
        roads = SemanticKitti(labeled.semantickitti)
        truths += [("road", lambda name: read.semantickitti(roads.frame(name)), name) for name in roads.names("all")]
    records: list[dict[str, list[Record]]] = [{}, {}]
    for block, truth_of, name in tqdm(truths, desc="comparing", unit="scan"):
        truth = truth_of(name)
        for judge, of in zip(judges, records, strict=True):
            of.setdefault(block, []).append(judge.record(truth)[0])
    return records


def losses_of(before: Mapping[str, Sequence[Record]], after: Mapping[str, Sequence[Record]]) -> Losses:
    """Compare the scores of both models, resampled by drive alike; with one drive the interval is the loss."""
    losses = {}
    for block in before:
        pairs = [_by_drive(of[block]) for of in (before, after)]
        n_drives = len(pairs[0])
        draws = np.random.default_rng(0).integers(n_drives, size=(N_RESAMPLES if n_drives > 1 else 0, n_drives))
        whole, *drawn = (
            [_scores({block: figures_of([drives[k] for k in draw], 0)}) for drives in pairs]
            for draw in (np.arange(n_drives), *draws)
        )
        for name, score in whole[0].items():
            own = whole[1].get(name, 0.0)
            differences = [one[name] - other.get(name, 0.0) for one, other in drawn if name in one] or [score - own]
            low, high = np.percentile(differences, (2.5, 97.5))
            losses[name] = score, own, float(low), float(high)
    return losses


def _by_drive(records: Sequence[Record]) -> list[Record]:
    """The sum of the records of each drive."""
    sums: dict[str, dict[tuple[str, ...], Any]] = {}
    for record in records:
        own = sums.setdefault(record.drive, {})
        own |= {key: own[key] + tally if key in own else tally for key, tally in record.tallies.items()}
    return [Record(drive, drive, tallies) for drive, tallies in sums.items()]


def quantize(
    path: Path,
    out: Path,
    calibration: Calibration,
    labeled: LabeledSets,
    *,
    exclude: Sequence[str] = (),
    seven_bits: bool = True,
    n_threads: int | None = None,
    max_noise: float = MAX_NOISE,
    race: Race = race,
) -> ModelCard:
    """Write the int8 variant of a model if it is faster here (``race``) and as accurate; "auto" takes it only after
    `release.agree`. Above ``max_noise``, convolutions stay in fp32. Raises RefusedError, ModelError, OptionError.
    """
    if not calibration.scans:
        raise PointsError("no scan to calibrate on; expected at least one")
    card = Session(path, "cpu").card
    camera = card.view.kind == "camera"
    if camera and labeled.camvid is None:
        raise OptionError(f"{path} is of a camera; give --camvid to calibrate and evaluate it on")
    check_fp32(path, card)
    model, chosen, kept, noise = _rounded(path, card, calibration.scans, exclude, seven_bits, max_noise)

    def compared(trial: Path) -> dict[str, Any]:
        share = f"{len(chosen)} of {len(chosen) + len(kept)} convolutions in int8"
        speed = speed_of(path, share, race(path, trial, n_threads))
        figures, losses = (_evaluated_on_images if camera else _evaluated_on_scans)(path, trial, out.name, labeled)
        lines = {
            name: f"{name} {score:.3f} to {own:.3f} (loss {low:.3f} to {high:.3f})"
            for name, (score, own, low, high) in losses.items()
        }
        worse = [lines[name] for name, (score, own, low, _) in losses.items() if score - own > MAX_LOSS and low > 0.0]
        if worse:
            raise RefusedError(f"{path}: more than {MAX_LOSS} lost with {share}: {'; '.join(worse)} ({speed})")
        worst = lines[max(losses, key=lambda name: losses[name][0] - losses[name][1])] if losses else "none"
        return {"parity": {**_parity(path, trial), "speed": speed, "largest_loss": worst}, "metrics": figures}

    made = {"left_alone": kept, "noise": noise, "weight_bits": 7 if seven_bits else 8}
    return write_int8(path, out, model, replace(card, metrics={}), calibration, made, compared)


def check_fp32(path: Path, card: ModelCard) -> None:
    """Raise `ModelError` if a model is not in fp32, or of pillars, whose calibration is not made here."""
    if card.view.kind == "pillars":
        raise ModelError(f"{path} is of pillars; expected a network of range images, top views, objects or a camera")
    if card.precision != "fp32":
        raise ModelError(f"{path} is in {card.precision}; quantize the model in fp32")


def write_int8(
    path: Path,
    out: Path,
    model: onnx.ModelProto,
    card: ModelCard,
    calibration: Calibration,
    made: Mapping[str, Any],
    compared: Callable[[Path], dict[str, Any]],
) -> ModelCard:
    """Write the rounded graph of a model with its card, if ``compared`` with it raises nothing (`write_checked`)."""
    (scans, real), camera = calibration, card.view.kind == "camera"
    kinds = f"{len(real)} real and {len(scans) - len(real)} simulated scans"
    quantized = {
        "from": f"{card.name} {card.version}",
        "graph_sha256": hashlib.sha256(onnx.load(path).graph.SerializeToString(deterministic=True)).hexdigest(),
        "calibration": f"{len(real)} images" if camera else kinds,
        **made,
    }
    seen = card.training.get("frames")
    seen = seen if isinstance(seen, Mapping) else {}
    new = terms_of(sets_of(real, camera) - sets_of(seen, camera))
    licence = "; ".join(terms for terms in (card.training.get("licence", ""), new) if terms)
    training = dict(card.training) | {"frames": {**real, **seen}, "licence": licence, "quantized": quantized}
    model.producer_name, model.producer_version = "edgeperc", ""
    halve(model.graph)
    int8 = replace(card, precision="int8", precisions={}, training=training, parity={})
    return write_checked(model, int8, out, compared)


def _rounded(
    path: Path,
    card: ModelCard,
    scans: Sequence[NDArray[Any] | LabeledScan],
    exclude: Sequence[str],
    seven_bits: bool,
    limit: float,
) -> tuple[onnx.ModelProto, list[str], list[str], float]:
    """The model in int8, its convolutions in int8 and in fp32, and the noise of its outputs."""
    tried: list[tuple[float, Calibrated]] = []
    for strength in STRENGTHS:
        fp32 = Calibrated.on(path, card, scans, seven_bits, strength)
        candidates = find_candidates(fp32.model.graph, exclude)
        if not candidates:
            raise RefusedError(
                f"{path}: no layer became int8: the first convolution, the last ones and those of --exclude stay in "
                "fp32, and the network has no other"
            )
        tried.append((fp32.noise(candidates), fp32))
        if tried[-1][0] <= limit:
            break
    noise, fp32 = min(tried, key=lambda each: each[0])
    chosen, noise = _choose(fp32, candidates, limit, noise)
    model = fp32.rounded(chosen)
    kept = [n.name for n in fp32.model.graph.node if n.op_type == "Conv" and n.name not in chosen]
    return model, chosen, kept, noise


def speed_of(path: Path, share: str, times: tuple[Floats, Floats]) -> str:
    """The times of both models in words. Raises RefusedError if int8 is not faster."""
    one, other = times
    ratios = np.sort(other / one)
    half, middle = int(np.ceil(0.98 * np.sqrt(len(ratios)))), len(ratios) // 2  # 95 % interval, by order statistics
    least, most = ratios[max(0, middle - half)], ratios[min(len(ratios) - 1, middle + half)]
    speed = (
        f"{np.median(one):.1f} ms in fp32, {np.median(other):.1f} in int8, "
        f"{np.median(ratios):.2f} times as long ({least:.2f} to {most:.2f})"
    )
    if most >= 1.0:
        raise RefusedError(f"{path}: not faster here with {share}: {speed}; expected an interval below 1")
    return speed


def _evaluated_on_images(path: Path, trial: Path, name: str, labeled: LabeledSets) -> tuple[dict[str, Any], Losses]:
    """Figures of the int8 model on CamVid's validation images, and what it loses."""
    assert labeled.camvid is not None
    figures, before = (evaluate_images([labeled.camvid], each, split="validation") for each in (trial, path))
    fp32_scores, int8_scores = (_scores({"images": each["images"]}) for each in (before, figures))
    losses = {
        each: (score, own := int8_scores.get(each, 0.0), score - own, score - own)
        for each, score in fp32_scores.items()
    }
    return figures | {"command": f"edgeperc eval CAMVID --split validation --model {name}"}, losses


def _evaluated_on_scans(path: Path, trial: Path, name: str, labeled: LabeledSets) -> tuple[dict[str, Any], Losses]:
    """Figures of the int8 model on the test drives, and what it loses on the validation drives."""
    losses = losses_of(*_compared(path, trial, labeled))
    simulated = f"simulation:{labeled.n_simulated}"
    given = {"KITTI": labeled.kitti, "SEMANTICKITTI": labeled.semantickitti, simulated: simulated}
    datasets = {name: root for name, root in given.items() if root is not None}
    figures = evaluate([*datasets.values()], [trial], NETWORK_ALONE)[0]
    command = " ".join(["edgeperc eval", *datasets, f"--model {name}", "--no-agreement"])
    return figures | {"command": command}, losses


def _parity(path: Path, rounded: Path) -> dict[str, float]:
    """Smallest share of pixels with the same label as in fp32, on simulated scans outside training and calibration."""
    sessions, agreement = [Session(each, "cpu") for each in (path, rounded)], 1.0
    card = sessions[0].card
    scans = parity_samples(card.view.kind)
    for image, _ in views(card, scans):
        labels = []
        for session in sessions:
            session.input[:] = image
            kind = next(o.kind for o in card.outputs if not o.kind.startswith("box_"))
            labels.append(pixel_labels(session.run()[kind], kind))
        agreement = min(agreement, float((labels[0] == labels[1]).mean()))
    return {"n_scans": len(scans), "label_agreement": agreement}
