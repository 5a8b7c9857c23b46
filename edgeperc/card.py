"""ModelCard: geometry, normalization, classes and origin of a model. The only reader and writer of the card's JSON.

A card is stored in the model file, under one ``metadata_props`` key, so that it cannot be separated from the weights.
"""

from __future__ import annotations

import itertools
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import CardError
from .onnx_metadata import read_metadata

__all__ = ["CARD_KEY", "Golden", "InputSpec", "ModelCard", "OutputSpec", "RangeImageGeometry", "TopViewGeometry"]

CARD_KEY = "edgeperc.card"
Precision = Literal["fp32", "int8"]
SCHEMA = 3
OUTPUT_KINDS = ("class_logits", "class_probabilities", "box_slots", "box_dense")
CHANNELS = {
    "top_view": ("distance", "remission", "height"),
    "range_image": ("x", "y", "z", "remission", "range"),
}


@dataclass(frozen=True, slots=True)
class TopViewGeometry:
    """The ground ahead as an image (SSADNet 2.1.2). Row 0 is farthest ahead, column 0 leftmost.

    Attributes
    ----------
    x_range_m, y_range_m, z_range_m : tuple of 2 float
        Bounds of the view [m] in the sensor frame, lower first.
    cell_m : float
        Edge of a cell [m].
    """

    x_range_m: tuple[float, float] = (6.0, 46.0)
    y_range_m: tuple[float, float] = (-10.0, 10.0)
    z_range_m: tuple[float, float] = (-2.5, 2.5)
    cell_m: float = 0.1

    def __post_init__(self) -> None:
        for name in ("x_range_m", "y_range_m", "z_range_m"):
            low, high = getattr(self, name)
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise CardError(f"view.{name} is {(low, high)}; expected two finite numbers, the lower first")
        if not (math.isfinite(self.cell_m) and self.cell_m > 0.0):
            raise CardError(f"view.cell_m is {self.cell_m}; expected a positive number of meters")

    @property
    def kind(self) -> str:
        return "top_view"

    @property
    def height(self) -> int:
        """Rows, along x."""
        return round((self.x_range_m[1] - self.x_range_m[0]) / self.cell_m)

    @property
    def width(self) -> int:
        """Columns, along y."""
        return round((self.y_range_m[1] - self.y_range_m[0]) / self.cell_m)

    def holds(self, x: float, y: float) -> bool:
        """Whether a position x, y [m] in the sensor frame is in view."""
        (near, far), (right, left) = self.x_range_m, self.y_range_m
        return near <= x < far and right <= y < left

    def cells(self, x: ArrayLike, y: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Find the cells that contain some positions.

        Parameters
        ----------
        x, y : array_like
            Positions in the sensor frame [m]; their shapes must broadcast.

        Returns
        -------
        rows, cols : ndarray of int64
        in_view : ndarray of bool
            False if a position is out of view or not finite; its row and column are then not valid.
        """
        row = np.floor((self.x_range_m[1] - np.asarray(x)) / self.cell_m)
        col = np.floor((self.y_range_m[1] - np.asarray(y)) / self.cell_m)
        in_view = (row >= 0) & (row < self.height) & (col >= 0) & (col < self.width)
        with np.errstate(invalid="ignore"):  # NaN and what int64 cannot hold are out of view
            return row.astype(np.int64), col.astype(np.int64), in_view

    def cell_centers(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centers of the cells in the sensor frame [m]: x (rows, 1) and y (1, columns)."""
        # np.float64, because older type stubs of numpy widen the type of a product with a Python float
        cell_m = np.float64(self.cell_m)
        x = np.float64(self.x_range_m[1]) - (np.arange(self.height, dtype=np.float64)[:, None] + 0.5) * cell_m
        y = np.float64(self.y_range_m[1]) - (np.arange(self.width, dtype=np.float64)[None, :] + 0.5) * cell_m
        return x, y


@dataclass(frozen=True, slots=True)
class RangeImageGeometry:
    """The scan as seen from the sensor (PointSeg 3.1). Row 0 is the top beam, column 0 leftmost.

    Attributes
    ----------
    row_elevations_deg : tuple of float
        Elevation of every row [deg], top to bottom, strictly decreasing, not necessarily evenly spaced.
    width : int
        Columns, evenly spread over the azimuths.
    azimuth_left_deg, azimuth_right_deg : float
        Azimuths of the image's left and right edges [deg], counter-clockwise from +x; 180 and -180 for a full turn.
    """

    row_elevations_deg: tuple[float, ...]
    width: int = 512
    azimuth_left_deg: float = 45.0
    azimuth_right_deg: float = -45.0

    def __post_init__(self) -> None:
        rows = self.row_elevations_deg
        falling = all(a > b for a, b in itertools.pairwise(rows))
        if len(rows) < 2 or not falling or not all(-90.0 < e < 90.0 for e in rows):
            raise CardError(
                f"view.row_elevations_deg holds {len(rows)} values; expected two or more, strictly decreasing, "
                "between -90 and 90 degrees"
            )
        if self.width < 1:
            raise CardError(f"view.width is {self.width}; expected at least one column")
        if not -180.0 <= self.azimuth_right_deg < self.azimuth_left_deg <= 180.0:
            raise CardError(
                f"view azimuths are left {self.azimuth_left_deg}, right {self.azimuth_right_deg}; "
                "expected -180 <= right < left <= 180"
            )

    @property
    def kind(self) -> str:
        return "range_image"

    @property
    def height(self) -> int:
        """Rows, one per beam."""
        return len(self.row_elevations_deg)


@dataclass(frozen=True, slots=True)
class InputSpec:
    """The network's input: ``(raw - mean) / std`` per channel; 0 in every channel of a pixel without a return.

    Attributes
    ----------
    name : str
        Name of the input in the graph.
    channels : tuple of str
    mean, std : tuple of float
        One value per channel, in the channel's unit.
    """

    name: str
    channels: tuple[str, ...]
    mean: tuple[float, ...]
    std: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.channels) == len(self.mean) == len(self.std) or not self.channels:
            raise CardError(
                f"input has {len(self.channels)} channels, {len(self.mean)} means and {len(self.std)} standard "
                "deviations; expected as many of each, at least one"
            )
        if not all(math.isfinite(v) for v in self.mean) or not all(math.isfinite(v) and v > 0 for v in self.std):
            raise CardError(f"input mean {self.mean}, std {self.std}; expected finite means and positive deviations")


@dataclass(frozen=True, slots=True)
class OutputSpec:
    """One output of the graph; ``kind`` picks the function in ``decode.py`` that reads it."""

    name: str
    kind: str

    def __post_init__(self) -> None:
        if self.kind not in OUTPUT_KINDS:
            raise CardError(f"output {self.name!r} is of kind {self.kind!r}; expected one of {', '.join(OUTPUT_KINDS)}")


@dataclass(frozen=True, slots=True)
class Golden:
    """A known input, and the outputs that the exporting computer got for it.

    The input is uniform noise in -1..1 from ``numpy.random.PCG64(seed)``. Each output is stored at sampled flat
    positions, so that any runtime can be compared with the exporter's.

    Attributes
    ----------
    seed : int
    input_sha256 : str
        SHA-256 of the input as float32 bytes in C order.
    outputs : mapping
        Output name to ``{"sha256": str, "std": float, "positions": [int], "values": [float]}``.
    """

    seed: int
    input_sha256: str
    outputs: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class ModelCard:
    """What a model is, how its input is made and what its outputs mean.

    Attributes
    ----------
    name, version : str
    precision : {"fp32", "int8"}
        Precision of the stored weights. ``"int8"``: weights and activations are 8-bit integers.
    view : TopViewGeometry or RangeImageGeometry
    input : InputSpec
    outputs : tuple of OutputSpec
    classes : tuple of str
        Index 0 is the background.
    box_classes : tuple of str
        Classes that boxes may have; a subset of ``classes``.
    box_size_priors : mapping
        Class to usual (length, width, height) [m].
    box_size_spreads : mapping
        Class to the standard deviations of the logarithms of these sizes; empty if size does not decide the class.
    score_threshold, nms_iou : float
        Defaults for boxes.
    mount_height_m : float
        Height of the training sensor above the road [m].
    fitness : mapping or None
        Statistics of the training scans (`edgeperc.fitness.FitnessProfile`); None if they were not measured.
    training : mapping
        Free-form training metadata: data, licence, recipe, seed, hashes of the frames.
    metrics : mapping
        Measured accuracy.
    parity : mapping
        Measured differences between the exported graph and the network that it was made from.
    golden : Golden or None
    precisions : mapping
        For each precision in which this file can run, the measured agreement with fp32 on real scans after
        post-processing: ``n_scans``, ``label_agreement`` (share of pixels or cells), ``mean_iou`` and ``ap`` with
        ``fp32_mean_iou`` and ``fp32_ap`` (0..1; AP is None without boxes), ``loss`` (the larger loss of mean IoU and
        AP in percentage points, 0 if neither is lower), ``by`` (engine and processor) and ``command``.
    """

    name: str
    version: str
    view: TopViewGeometry | RangeImageGeometry
    input: InputSpec
    outputs: tuple[OutputSpec, ...]
    classes: tuple[str, ...]
    box_classes: tuple[str, ...] = ()
    box_size_priors: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    box_size_spreads: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    score_threshold: float = 0.3
    nms_iou: float = 0.2
    mount_height_m: float = 1.73
    fitness: Mapping[str, Any] | None = None
    training: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)
    parity: Mapping[str, Any] = field(default_factory=dict)
    golden: Golden | None = None
    precision: Precision = "fp32"
    precisions: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.precision not in ("fp32", "int8"):
            raise CardError(f"precision is {self.precision!r}; expected fp32 or int8, as the weights are stored")
        if not self.name or not self.version:
            raise CardError(f"name {self.name!r}, version {self.version!r}; expected both to be non-empty strings")
        if not 2 <= len(self.classes) <= 255 or len(set(self.classes)) != len(self.classes):
            raise CardError(f"classes {self.classes}; expected 2 to 255 different names, the background first")
        unknown = [c for c in self.input.channels if c not in CHANNELS[self.view.kind]]
        if unknown:
            raise CardError(
                f"input channels {unknown} are unknown to a {self.view.kind}; "
                f"expected some of {', '.join(CHANNELS[self.view.kind])}"
            )
        kinds = [o.kind for o in self.outputs]
        if sum(k.startswith("class_") for k in kinds) != 1 or len(kinds) != len(set(kinds)):
            raise CardError(f"output kinds {kinds}; expected one class output and at most one of each box kind")
        if any(k.startswith("box_") for k in kinds):
            if self.view.kind != "top_view":
                raise CardError(f"output kinds {kinds} in a {self.view.kind}; boxes need a top_view")
            if not self.box_classes:
                raise CardError("a box output without box_classes; expected the classes that boxes may have")
        unlisted = [c for c in (*self.box_classes, *self.box_size_priors) if c not in self.classes]
        if unlisted:
            raise CardError(f"box classes {unlisted} are not among the classes {self.classes}")
        if (
            self.box_size_spreads
            and not set(self.box_classes) <= self.box_size_spreads.keys() & self.box_size_priors.keys()
        ):
            raise CardError(
                f"box_size_spreads of {[*self.box_size_spreads]}; expected a spread and a prior for each box class"
            )
        if any(spread <= 0.0 for spreads in self.box_size_spreads.values() for spread in spreads):
            raise CardError(f"box_size_spreads are {self.box_size_spreads}; expected numbers above 0")
        for name in ("score_threshold", "nms_iou"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise CardError(f"{name} is {getattr(self, name)}; expected a number in 0..1")

    def to_json(self) -> str:
        """Canonical JSON: sorted keys, no blanks, no NaN."""
        view: dict[str, Any] = {"kind": self.view.kind}
        view |= {name: getattr(self.view, name) for name in type(self.view).__dataclass_fields__}
        document = {name: getattr(self, name) for name in type(self).__dataclass_fields__}
        document |= {
            "schema": SCHEMA,
            "view": view,
            "input": {name: getattr(self.input, name) for name in InputSpec.__dataclass_fields__},
            "outputs": [{"name": o.name, "kind": o.kind} for o in self.outputs],
            "golden": self.golden and {n: getattr(self.golden, n) for n in Golden.__dataclass_fields__},
        }
        return json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> ModelCard:
        """Read the card of an .onnx file; needs no onnxruntime, and takes less than a millisecond.

        Raises
        ------
        ModelFileError
            The file cannot be read.
        CardError
            The file is not a complete .onnx file, has no card, or has a card that `from_json` refuses.
        """
        text = read_metadata(path, CARD_KEY)
        if text is None:
            raise CardError(
                f"{os.fspath(path)} has no card; write one with: edgeperc-export card MODEL --card CARD.json"
            )
        try:
            return cls.from_json(text)
        except CardError as exc:
            raise CardError(f"{os.fspath(path)}: {exc}") from exc

    @classmethod
    def from_json(cls, text: str) -> ModelCard:
        """Read a card.

        Raises
        ------
        CardError
            Not JSON, no schema number, a newer schema, or a missing or malformed key. Unknown keys are ignored.
        """
        try:
            document = json.loads(text)
        except (RecursionError, ValueError) as exc:
            raise CardError(f"the card is not JSON ({exc}); export the model again") from exc
        if not isinstance(document, dict) or not isinstance(document.get("schema"), int):
            raise CardError("the card has no schema number; export the model again")
        if document["schema"] not in (2, SCHEMA):
            raise CardError(
                f"the card has schema {document['schema']}, this edgeperc reads {SCHEMA}; "
                + ("upgrade edgeperc" if document["schema"] > SCHEMA else "export the model again")
            )
        try:
            return _card(document)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as exc:
            raise CardError(f"the card is malformed: {type(exc).__name__} {exc}; export the model again") from exc


def _card(document: dict[str, Any]) -> ModelCard:
    view = dict(document["view"])
    kind = view.pop("kind")
    geometry: TopViewGeometry | RangeImageGeometry
    if kind == "top_view":
        geometry = TopViewGeometry(
            x_range_m=_pair(view["x_range_m"]),
            y_range_m=_pair(view["y_range_m"]),
            z_range_m=_pair(view["z_range_m"]),
            cell_m=float(view["cell_m"]),
        )
    elif kind == "range_image":
        geometry = RangeImageGeometry(
            row_elevations_deg=tuple(float(e) for e in view["row_elevations_deg"]),
            width=int(view["width"]),
            azimuth_left_deg=float(view["azimuth_left_deg"]),
            azimuth_right_deg=float(view["azimuth_right_deg"]),
        )
    else:
        raise CardError(f"view.kind is {kind!r}; expected top_view or range_image")
    fitness, golden = document["fitness"], document["golden"]
    if document["schema"] == 2:  # schema 2 has the precision in the free-form metadata, and no measured agreement
        precision, precisions = document["training"].get("precision", "fp32"), {}
    else:
        precision, precisions = document["precision"], document["precisions"]
    return ModelCard(
        name=str(document["name"]),
        version=str(document["version"]),
        precision=precision,
        view=geometry,
        input=InputSpec(
            name=str(document["input"]["name"]),
            channels=tuple(str(c) for c in document["input"]["channels"]),
            mean=tuple(float(v) for v in document["input"]["mean"]),
            std=tuple(float(v) for v in document["input"]["std"]),
        ),
        outputs=tuple(OutputSpec(name=str(o["name"]), kind=str(o["kind"])) for o in document["outputs"]),
        classes=tuple(str(c) for c in document["classes"]),
        box_classes=tuple(str(c) for c in document["box_classes"]),
        box_size_priors=_sizes(document["box_size_priors"]),
        box_size_spreads=_sizes(document["box_size_spreads"]),
        score_threshold=float(document["score_threshold"]),
        nms_iou=float(document["nms_iou"]),
        mount_height_m=float(document["mount_height_m"]),
        fitness=None if fitness is None else dict(fitness),
        training=dict(document["training"]),
        metrics=dict(document["metrics"]),
        parity=dict(document["parity"]),
        golden=None
        if golden is None
        else Golden(int(golden["seed"]), str(golden["input_sha256"]), dict(golden["outputs"])),
        precisions={str(name): dict(entry) for name, entry in precisions.items()},
    )


def _sizes(document: dict[str, Any]) -> dict[str, tuple[float, float, float]]:
    return {str(c): (float(length), float(width), float(height)) for c, (length, width, height) in document.items()}


def _pair(values: Any) -> tuple[float, float]:
    low, high = values
    return float(low), float(high)
