"""ModelCard: geometry, normalization, classes and origin of a model. The only reader and writer of the card's JSON.

A card is stored in the model file, under one ``metadata_props`` key, so that it cannot be separated from the weights.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import reprlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from ..errors import CardError
from ..system.fields import Fields
from ..system.names import check_name, check_text
from .choices import VEHICLES
from .detector import ANCHOR_KINDS, CENTER_KINDS, HEADS, MAX_GROUPS, MAX_VALUES, AnchorHead, CenterHead, PillarGeometry
from .onnx_file import read_metadata
from .views import CameraGeometry, ObjectGeometry, RangeImageGeometry, TopViewGeometry

CARD_KEY = "edgeperc.card"
Precision = Literal["fp32", "int8"]
SCHEMA = 3
MAX_CHARACTERS = 16 * 10**6
MAX_DEPTH = 32
MAX_TEXT = 100_000  # characters of one text of the free-form metadata
MAX_CHANNELS = 16
MAX_BLOCK = 16
MAX_REMISSION_STD = 10.0
MIN_GOLDEN_VALUES, MAX_GOLDEN_VALUES = 16, 100_000
OUTPUT_KINDS = (
    *("class_logits", "class_probabilities", "box_slots", "box_dense", "camera_logits", "objects"),
    *(*ANCHOR_KINDS, *CENTER_KINDS),
)
CHANNELS = {
    "camera": ("red", "green", "blue"),
    "top_view": ("distance", "remission", "height"),
    "range_image": ("x", "y", "z", "remission", "range", "height_above_ground", "curvature"),
    "objects": (
        *("x", "y", "height_above_ground", "remission", "beyond_length", "beyond_width"),
        *("length", "width", "top", "sensor_ahead", "sensor_left", "range", "n_points"),
    ),
    "pillars": (
        *("x", "y", "z", "remission", "time"),
        *("from_mean_x", "from_mean_y", "from_mean_z", "from_center_x", "from_center_y", "from_center_z", "range"),
    ),
}
KNOWN_CLASSES = ("background", "drivable", "road", *VEHICLES, "pedestrian", "cyclist")
N_DENSE_CHANNELS, N_FRONT_CHANNELS = 9, 2
N_OBJECT_VALUES = 8  # in addition to the classes and the sizes: place, axis, front, overlap
FIELDS = Fields(
    "the card", CardError, "export the model again", optional=("front", "block", "head", "range_m")
)  # earlier cards lack them
VIEWS = {
    "top_view": TopViewGeometry,
    "range_image": RangeImageGeometry,
    "camera": CameraGeometry,
    "objects": ObjectGeometry,
    "pillars": PillarGeometry,
}
Geometry = TopViewGeometry | RangeImageGeometry | CameraGeometry | ObjectGeometry | PillarGeometry


@dataclass(frozen=True, slots=True)
class InputSpec:
    """The network's input: ``(raw - mean) / std`` per channel; 0 in every channel of a pixel without a return.

    The raw values of a camera are 0..255 in ``"red"``, ``"green"`` and ``"blue"``, in the order that the network takes.
    """

    name: str  # name of the input in the graph
    channels: tuple[str, ...]
    # one value per channel, in the channel's unit
    mean: tuple[float, ...]
    std: tuple[float, ...]

    @property
    def needs_ground(self) -> bool:
        """Whether a channel is the height above the ground, which must be found before the input can be made."""
        return "height_above_ground" in self.channels

    def __post_init__(self) -> None:
        if not len(self.channels) == len(self.mean) == len(self.std) or not self.channels:
            raise CardError(
                f"input has {len(self.channels)} channels, {len(self.mean)} means and {len(self.std)} standard "
                "deviations; expected as many of each, at least one"
            )
        FIELDS.whole("the number of input channels", len(self.channels), 1, MAX_CHANNELS)
        check_text("input.name", self.name, CardError)
        FIELDS.numbers("input.mean", self.mean, None, -1e6, 1e6)
        FIELDS.numbers("input.std", self.std, None, 1e-6, 1e6)
        for name, std in zip(self.channels, self.std, strict=True):
            if name == "remission" and std > MAX_REMISSION_STD:
                raise CardError(
                    f"input.std of the remission is {std:g}; it is 0 to 1 before the division, and nearly nothing "
                    f"after it: a network that was trained with 0 to 255 has 1/255, {1 / 255:.17g}"
                )


@dataclass(frozen=True, slots=True)
class OutputSpec:
    """One output of the graph; ``kind`` picks the function in ``decode.py`` that reads it."""

    name: str  # name of the output in the graph
    kind: str  # one of ``OUTPUT_KINDS``
    # of kind ``"box_dense"``: it has two more channels, a vector towards the front of a box. Its component along a
    # heading is the logit that the front is there.
    front: bool = False
    # of a class output: rows and columns of the pixels whose values are channels of one position. Value of class c in
    # pixel (row, column): channel ``(c * rows + row % rows) * columns + column % columns``, at position ``(row // rows,
    # column // columns)``.
    block: tuple[int, int] = (1, 1)

    def __post_init__(self) -> None:
        if self.kind not in OUTPUT_KINDS:
            raise CardError(
                f"output {reprlib.repr(self.name)} is of kind {reprlib.repr(self.kind)}; "
                f"expected one of {', '.join(OUTPUT_KINDS)}"
            )
        if self.front and self.kind != "box_dense":
            raise CardError(f"output {reprlib.repr(self.name)} of kind {self.kind} has a front; only box_dense may")
        if len(self.block) != 2 or not all(1 <= n <= MAX_BLOCK for n in self.block):
            raise CardError(f"output.block is {reprlib.repr(self.block)}; expected two numbers from 1 to {MAX_BLOCK}")
        if self.block != (1, 1) and not self.kind.startswith("class_"):
            raise CardError(
                f"output {reprlib.repr(self.name)} of kind {self.kind} has blocks; only outputs of classes may"
            )
        check_text("output.name", self.name, CardError)


@dataclass(frozen=True, slots=True)
class Golden:
    """A known input, and the outputs that the exporting computer got for it.

    The input is uniform noise in -1..1 from ``numpy.random.PCG64(seed)``. Each output is stored at sampled flat
    positions, so that any runtime can be compared with the exporter's: at 16 or more different positions, or at all
    positions of a smaller output.
    """

    seed: int
    input_sha256: str  # SHA-256 of the input as float32 bytes in C order
    # output name to ``{"sha256": str, "std": float, "positions": [int], "values": [float]}``
    outputs: Mapping[str, Mapping[str, Any]]

    def __post_init__(self) -> None:
        FIELDS.whole("golden.seed", self.seed, 0, 2**64 - 1)
        FIELDS.whole("the length of golden.input_sha256", len(self.input_sha256), 0, 64)
        FIELDS.whole("the number of golden.outputs", len(self.outputs), 1, MAX_GROUPS * len(CENTER_KINDS))
        for name, record in self.outputs.items():
            field = f"golden.outputs[{reprlib.repr(name)}]"
            missing = {"std", "positions", "values"} - record.keys()
            if missing:
                raise CardError(f"{field} lacks {', '.join(sorted(missing))}; export the model again")
            positions, values = record["positions"], record["values"]
            if not isinstance(positions, list) or not isinstance(values, list) or len(positions) != len(values):
                raise CardError(f"{field} holds positions and values that are not lists of one length")
            FIELDS.whole(f"the number of {field}.values", len(values), 1, MAX_GOLDEN_VALUES)
            FIELDS.number(f"{field}.std", record["std"], 0.0, 1e30)
            for index, (position, value) in enumerate(zip(positions, values, strict=True)):
                FIELDS.whole(f"{field}.positions[{index}]", position, 0, 2**40)
                FIELDS.number(f"{field}.values[{index}]", value, -1e30, 1e30)

    def check_output(self, name: str, size: int) -> None:
        """Check the record of an output against the number of its values."""
        positions = self.outputs[name]["positions"]
        field, fewest = f"golden.outputs[{reprlib.repr(name)}]", min(MIN_GOLDEN_VALUES, size)
        if max(positions) >= size:
            raise CardError(f"{field} has position {max(positions)}; the output has {size} values")
        if len({*positions}) < fewest:
            raise CardError(f"{field} has {len({*positions})} different positions; expected {fewest} or more")


@dataclass(frozen=True, slots=True)
class ModelCard:
    """What a model is, how its input is made and what its outputs mean.

    Attributes
    ----------
    name, version : str
        The name may become that of files and of models on a server: see `edgeperc.system.names.check_name`.
    precision : {"fp32", "int8"}
        Precision of the stored weights. ``"int8"``: weights and activations are 8-bit integers.
    view : TopViewGeometry, RangeImageGeometry, CameraGeometry, ObjectGeometry or PillarGeometry
    input : InputSpec
    outputs : tuple of OutputSpec
        A camera model has one output of kind ``"camera_logits"``, float32 of shape (1, classes, h, w): logits on a grid
        whose h and w divide the height and the width of the view.
    classes : tuple of str
        Index 0 is the background; a camera model has none.
    box_classes : tuple of str
        Classes that boxes may have; a subset of ``classes``. Of a detector, that of each class of its head, in the
        head's order; several may be one. Of a range image, if empty, all but those of the surroundings.
    box_size_priors : mapping
        Class to usual (length, width, height) [m].
    box_size_spreads : mapping
        Class to the standard deviations of the logarithms of these sizes; empty if size does not decide the class.
    score_threshold, nms_iou : float
        Defaults for boxes.
    mount_height_m : float
        Height of the training sensor above the road [m]: scans are moved there before the network sees them.
    fitness : mapping or None
        Statistics of the training scans (`edgeperc.preprocess.fitness.FitnessProfile`); None if they were not measured.
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
        AP in percentage points, 0 if neither is lower), ``by`` (engine and processor) and ``command``; of int8
        ``weight_bits``: what has 7 is as exact, and fast, on x86 without a dot product of bytes.
    head : AnchorHead, CenterHead or None
        What the outputs of a detector on pillars mean (`edgeperc.types.detector`); None for other views.
    """

    name: str
    version: str
    view: Geometry
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
    head: AnchorHead | CenterHead | None = None

    def __post_init__(self) -> None:
        if self.precision not in ("fp32", "int8"):
            raise CardError(f"precision is {self.precision!r}; expected fp32 or int8, as the weights are stored")
        check_name("name", self.name, CardError)
        check_text("version", self.version, CardError)
        if not 2 <= len(self.classes) <= 255 or len(set(self.classes)) != len(self.classes):
            raise CardError(
                f"classes {reprlib.repr(self.classes)}; expected 2 to 255 different names, the background first"
            )
        for name in self.classes:
            check_text("class", name, CardError)
        if self.view.kind != "camera":
            self._check_class_names()
        unknown = [c for c in self.input.channels if c not in CHANNELS[self.view.kind]]
        if unknown:
            raise CardError(
                f"input channels {reprlib.repr(unknown)} are unknown to a {self.view.kind}; "
                f"expected some of {', '.join(CHANNELS[self.view.kind])}"
            )
        if (self.head is None) == (self.view.kind == "pillars"):
            given = "is missing" if self.head is None else "is given"
            raise CardError(f"head {given} in a card of {self.view.kind}; expected one for pillars alone")
        kinds = [o.kind for o in self.outputs]
        if self.view.kind == "camera":
            self._check_camera(kinds)
        elif self.view.kind == "objects":
            self._check_objects(kinds)
        elif self.view.kind == "pillars":
            self._check_pillars(kinds)
        elif (
            sum(k.startswith("class_") for k in kinds) != 1
            or len(kinds) != len(set(kinds))
            or {"camera_logits", "objects", *ANCHOR_KINDS, *CENTER_KINDS} & {*kinds}
        ):
            raise CardError(f"output kinds {kinds}; expected one class output and at most one of each box kind")
        for rows, cols in (output.block for output in self.outputs if output.block != (1, 1)):
            assert not isinstance(self.view, ObjectGeometry)  # only outputs of classes have blocks
            if self.view.height % rows or self.view.width % cols:
                raise CardError(
                    f"output.block is {(rows, cols)}; expected divisors of the view's {self.view.height} rows and "
                    f"{self.view.width} columns"
                )
        if any(k in ("box_slots", "box_dense") for k in kinds):
            if self.view.kind != "top_view":
                raise CardError(f"output kinds {kinds} in a {self.view.kind}; boxes need a top_view")
            if not self.box_classes:
                raise CardError("a box output without box_classes; expected the classes that boxes may have")
        for name in ("box_classes", "box_size_priors"):
            if unlisted := [c for c in getattr(self, name) if c not in self.classes]:
                raise CardError(f"{name} has {reprlib.repr(unlisted)}, not among the classes {self.classes}")
        if self.classes[0] in self.box_classes:
            raise CardError(
                f"box_classes {reprlib.repr(self.box_classes)} hold {reprlib.repr(self.classes[0])}, the first of the "
                "classes, which is the background; list the background first in classes, and no box has it"
            )
        sized = self.box_size_spreads.keys() & self.box_size_priors.keys()
        if self.box_size_spreads and not {*self.box_classes} <= sized:
            raise CardError(
                f"box_size_spreads of {[*self.box_size_spreads]}; expected a spread and a prior for each box class"
            )
        for name, sizes in self.box_size_priors.items():
            FIELDS.numbers(f"box_size_priors[{reprlib.repr(name)}]", sizes, 3, 0.01, 100.0)
        for name, spreads in self.box_size_spreads.items():
            FIELDS.numbers(f"box_size_spreads[{reprlib.repr(name)}]", spreads, 3, 1e-6, 10.0)
        FIELDS.number("score_threshold", self.score_threshold, 0.0, 1.0)
        FIELDS.number("nms_iou", self.nms_iou, 0.0, 1.0)
        FIELDS.number("mount_height_m", self.mount_height_m, -100.0, 100.0)
        for name, record in self.precisions.items():
            check_text("the precision", name, CardError)
            if "loss" in record:
                FIELDS.number(f"precisions.{name}.loss", record["loss"], 0.0, 100.0)
            if "weight_bits" in record:
                FIELDS.number(f"precisions.{name}.weight_bits", record["weight_bits"], 2.0, 8.0)
        if self.golden is not None:
            for output in self.outputs:
                shape = self.shape_of(output)
                if output.name in self.golden.outputs and None not in shape:
                    self.golden.check_output(output.name, math.prod(n for n in shape if n is not None))

    def _check_class_names(self) -> None:
        """Raise CardError for a name under which a class would be taken for another one, or for nothing known."""
        if misspelt := next((c for c in self.classes if c not in KNOWN_CLASSES and c.lower() in KNOWN_CLASSES), None):
            raise CardError(
                f"class {misspelt!r} would be a class of its own; write {misspelt.lower()!r}, as edgeperc calls it, in "
                "classes and box_classes"
            )
        begins_wrong = "background" in self.classes[1:] or self.classes[0] in {*KNOWN_CLASSES} - {"background"}
        if begins_wrong and self.view.kind != "pillars":  # theirs are refused by their boxes
            raise CardError(
                f"classes {reprlib.repr(self.classes)} begin with {self.classes[0]!r}, which would be the background; "
                "expected the background first, in the graph's outputs, too"
            )
        if self.view.kind == "top_view" and "road" in self.classes and "drivable" not in self.classes:
            raise CardError("class 'road' of a top view would be no drivable area; write 'drivable'")

    def _check_camera(self, kinds: list[str]) -> None:
        if kinds != ["camera_logits"]:
            raise CardError(f"output kinds {kinds} of a camera; expected one, camera_logits")
        if sorted(self.input.channels) != sorted(CHANNELS["camera"]):
            raise CardError(
                f"input channels {self.input.channels} of a camera; expected red, green and blue, each once"
            )
        if self.fitness is not None:
            raise CardError("fitness is given for a camera model; expected null")

    def _check_objects(self, kinds: list[str]) -> None:
        if kinds != ["objects"]:
            raise CardError(f"output kinds {kinds} of candidates; expected one, objects")
        if self.input.channels != CHANNELS["objects"]:
            raise CardError(
                f"input channels {self.input.channels} of candidates; expected {', '.join(CHANNELS['objects'])}"
            )
        if self.box_classes != self.classes[1:] or not set(self.box_classes) <= self.box_size_priors.keys():
            raise CardError(
                f"box_classes {self.box_classes} of candidates; expected all classes but the background, each with a "
                "box_size_prior"
            )
        if self.fitness is not None:
            raise CardError("candidates with a fitness, which is of scans; expected null")

    def _check_pillars(self, kinds: list[str]) -> None:
        view, head = self.view, self.head
        assert isinstance(view, PillarGeometry)
        assert head is not None
        head.check_kinds(kinds)
        if view.height % head.stride or view.width % head.stride:
            raise CardError(
                f"head.stride is {head.stride}; expected a divisor of the view's {view.height} rows and {view.width} "
                "columns"
            )
        if len(self.box_classes) != len(head.classes):
            raise CardError(
                f"box_classes {reprlib.repr(self.box_classes)} of a detector of {len(head.classes)} classes "
                f"{reprlib.repr(head.classes)}; expected a class of boxes for each, in this order"
            )
        for own, name in zip(head.classes, self.box_classes, strict=True):
            if own.lower() != name and own.lower() in self.box_classes:
                raise CardError(
                    f"box_classes {reprlib.repr(self.box_classes)} call the network's {own!r} {name!r}; expected what "
                    f"edgeperc calls each of head.classes {reprlib.repr(head.classes)}, in their order"
                )
        if isinstance(head, AnchorHead) and len(head.anchors) == len(head.classes):
            ranks = {"pedestrian": 0, "cyclist": 1, **dict.fromkeys(VEHICLES, 2)}
            known = [
                (ranks[name], name, anchor.size_m[0])
                for name, anchor in zip(self.box_classes, head.anchors, strict=True)
                if name in ranks
            ]
            for (rank, shorter, m), (other, longer, n) in itertools.permutations(known, 2):
                if rank < other and m > n:
                    raise CardError(
                        f"head.anchors have {m:g} m for a {shorter} and {n:g} m for a {longer}; expected an anchor of "
                        "each class, in the order of head.classes"
                    )
        n_values = view.max_pillars * view.max_points * len(self.input.channels)
        if n_values > MAX_VALUES:
            raise CardError(f"the input has {n_values} values (view.max_pillars); expected at most {MAX_VALUES}")
        names = [self.input.name, view.coords, *filter(None, [view.num_points])]
        for what, given in (("inputs", names), ("outputs", [output.name for output in self.outputs])):
            if len(given) != len({*given}):
                raise CardError(f"the {what} are named {reprlib.repr(given)}; expected different names")

    @property
    def input_shape(self) -> tuple[int | None, ...]:
        """Shape of the input, with the batch: (1, channels, rows, columns); of candidates and of pillars (any, points,
        channels).
        """
        if isinstance(self.view, ObjectGeometry):
            return (None, self.view.n_points, len(self.input.channels))
        if isinstance(self.view, PillarGeometry):
            return (None, self.view.max_points, len(self.input.channels))
        return (1, len(self.input.channels), self.view.height, self.view.width)

    def shape_of(self, output: OutputSpec) -> tuple[int | None, ...]:
        """`output_shape` of one of `outputs`; a detector may have several of a kind."""
        if self.head is None:
            return self.output_shape(output.kind)
        assert isinstance(self.view, PillarGeometry)
        alike = [each.name for each in self.outputs if each.kind == output.kind]
        n = self.head.n_channels(output.kind, alike.index(output.name), len(alike))
        rows, columns = self.view.height // self.head.stride, self.view.width // self.head.stride
        return (1, rows, columns, n) if self.head.channels_last else (1, n, rows, columns)

    def output_shape(self, kind: str) -> tuple[int | None, ...]:
        """Shape of the output of a kind, with the batch; None where any length is allowed."""
        if kind == "objects":
            n_classes = len(self.classes)
            return (None, n_classes + 3 * (n_classes - 1) + N_OBJECT_VALUES)
        if isinstance(self.view, ObjectGeometry | PillarGeometry):
            raise CardError(f"a card of {self.view.kind} has no output of kind {kind}")
        if kind == "box_slots":
            return (1, None, None)
        if kind == "camera_logits":
            return (1, len(self.classes), None, None)
        if kind == "box_dense":
            n_channels = N_DENSE_CHANNELS + N_FRONT_CHANNELS * any(output.front for output in self.outputs)
            return (1, n_channels, self.view.height // 4, self.view.width // 4)
        rows, cols = next((output.block for output in self.outputs if output.kind == kind), (1, 1))
        return (1, len(self.classes) * rows * cols, self.view.height // rows, self.view.width // cols)

    def to_json(self) -> str:
        """Canonical JSON: sorted keys, no blanks, no NaN."""
        document: dict[str, Any] = {"schema": SCHEMA, **asdict(self)}
        document["view"]["kind"] = self.view.kind
        if self.head is None:
            del document["head"]
        else:
            document["head"]["kind"] = self.head.kind
        return json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> ModelCard:
        """Read the card of an .onnx file; needs no onnxruntime, and takes less than a millisecond.

        Raises
        ------
        ModelFileError
            The file cannot be read, or is not a complete .onnx file.
        CardError
            The file has no card, or has a card that `from_json` refuses.
        """
        text = read_metadata(path, CARD_KEY)
        if text is None:
            raise CardError(f"{os.fspath(path)} has no card; write one: edgeperc-export card MODEL CARD.json OUT")
        try:
            return cls.from_json(text)
        except CardError as exc:
            raise CardError(f"{os.fspath(path)}: {exc}") from exc

    @classmethod
    def from_json(cls, text: str, *, exact: bool = False) -> ModelCard:
        """Read a card; unknown keys are ignored, or refused with ``exact``, as misspelt by hand.

        Raises
        ------
        CardError
            Not JSON, another schema, or a key that is missing, of another type or out of its bounds.
        """
        if isinstance(text, str | bytes) and len(text) > MAX_CHARACTERS:
            raise CardError(f"the card has {len(text)} characters; expected at most {MAX_CHARACTERS}")
        document, known = FIELDS.document(text, SCHEMA), replace(FIELDS, exact=exact)
        _check_tree(document)
        for name, kinds in {"view": VIEWS, "head": HEADS}.items():
            if name == "head" and document.get(name) is None:
                continue
            entries = {**FIELDS.entry(Mapping[str, Any], document.get(name), name)}
            kind = entries.pop("kind", None)
            if kind not in [*kinds]:
                FIELDS.refuse(f"{name}.kind", kind, " or ".join(kinds))
            document[name] = known.entry(kinds[kind], entries, name)
        return known.read(cls, document)


def _check_tree(document: Any) -> None:
    """Refuse values anywhere in the document that JSON allows and a card does not."""
    level = [document]
    for _ in range(MAX_DEPTH):
        inner: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                inner += value.keys()
                inner += value.values()
            elif isinstance(value, list):
                inner += value
            elif isinstance(value, str):
                if len(value) > MAX_TEXT:
                    raise CardError(f"the card has a text of {len(value)} characters; expected at most {MAX_TEXT}")
                if not value.isascii() and any("\ud800" <= character <= "\udfff" for character in value):
                    raise CardError(f"the card has a text that is not valid Unicode: {reprlib.repr(value)}")
            elif isinstance(value, int | float) and not -1e300 <= value <= 1e300:
                raise CardError(f"the card has the number {reprlib.repr(value)}; expected finite ones below 1e300")
        level = inner
        if not level:
            return
    raise CardError(f"the card is nested more than {MAX_DEPTH} deep; export the model again")
