"""The contenders of ``peers``: edgeperc, torch, other engines, a pipeline in numpy, two networks in place of one.

Every contender is a process of its own, so that libraries do not share an address space and memory can be measured. The
contenders of a table take turns in a new random order each round, so that drift affects all of them equally. In its
turn, a contender processes every scan once, after a call that does not count, because threads of the previous contender
may still be spinning. The peaks of the machine are contenders, too, measured in the same rounds as the networks.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from edgeperc.camera.image import ImageScaler
from edgeperc.inference.projection import make_projector, project
from edgeperc.inference.providers import available_providers
from edgeperc.preprocess.condition import condition
from edgeperc.types.card import ModelCard
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import CameraGeometry
from edgeperc.zoo import Variant, resolve

from ..samples import percentile
from ..worker import Prediction
from .camera import camera_images
from .networks import OTHERS, POINTPILLARS, write_others

INSTALL = "not installed: pip install 'edgeperc[peers]'"
INSTALL_GEOMETRY = "not installed: pip install 'edgeperc[geometry]'"
METHODS = "Methods of others on the same scans"
TORCH = (("torch", "fp32"), ("torch.compile", "fp32"), ("torch", "bf16"), ("torch.compile", "bf16"))
OPENVINO = (("openvino", "fp32"), ("openvino", "bf16"))
# Engines for phones and small boards. They cannot run the int8 graphs: MNN 3.6 takes the weights of a dequantized
# convolution for an input, and pnnx has no translation.
SMALL = (("mnn", "fp32"), ("ncnn", "fp32"))
NEEDS = {
    "mnn": ("MNN", "onnx"),
    "ncnn": ("ncnn", "onnx", "pnnx"),
    "openvino": ("openvino",),
    "patchwork": ("pypatchworkpp", "scipy"),
    "torch": ("torch", "onnx"),
    "torch.compile": ("torch", "onnx"),
}
ANSWERS = ("front", "full turn")
NAMES = {"openvino": "OpenVINO API", "mnn": "MNN", "ncnn": "ncnn"}
PEAKS = (("numpy", "fp32"), ("torch", "fp32"), ("torch", "bf16"), ("torch", "int8"), *OPENVINO)


@dataclass(frozen=True)
class Contender:
    """One row of a table."""

    name: str
    kind: str  # as `turns.make_calls` takes it
    engine: str = ""  # a provider for edgeperc's own kinds, else as `open_engine` or `matrix_product` take it
    precision: str = ""  # as the provider or the engine takes it; empty if it has no choice
    paths: tuple[Path, ...] = ()
    cards: tuple[str, ...] = ()  # the models' cards, JSON
    image: Path | None = None  # input of a network alone, .npy
    inputs: tuple[Path, ...] = ()  # a camera's images, .npy, in place of the scans of the run
    timed: str = ""  # the part that is timed, where it differs within a table


@dataclass
class Measured:
    """Measurements of a contender: milliseconds by round, memory, predictions, or why there are none."""

    contender: Contender
    rounds: list[list[float]] = field(default_factory=list)
    rss_mb: float | None = None
    predictions: list[Prediction] = field(default_factory=list)
    missing: str = ""

    @property
    def ms(self) -> list[float]:
        """All milliseconds, in the order of measuring."""
        return [ms for each in self.rounds for ms in each]

    @property
    def p50(self) -> float:
        """Median of all milliseconds."""
        return percentile(self.ms, 50.0)


def why_missing(contender: Contender) -> str:
    """Why a contender cannot run here; empty if it can."""
    if contender.kind in ("edgeperc", "default", "session", *ANSWERS):
        known = contender.engine in ("auto", *available_providers())
        return "" if known else "onnxruntime offers no such provider on this computer"
    needed = NEEDS.get(contender.engine, ())
    # The parts of a network exist only if onnx is installed.
    here = all(importlib.util.find_spec(name) for name in needed) and all(path.exists() for path in contender.paths)
    return "" if here else INSTALL_GEOMETRY if contender.engine == "patchwork" else INSTALL


def groups(
    models: Sequence[str], provider: str, precision: str, folder: Path, scan: Path, sensor: str
) -> dict[str, list[Contender]]:
    """All contenders of some models, by the title of their table; a name stands for its fp32 file, and range-image
    models are paired with top-view models in order. ``scan`` is the input of networks alone.
    """
    points, _ = condition(np.load(scan), get_sensor(sensor), rendered=False)
    views: dict[str, list[Variant]] = {"range_image": [], "top_view": [], "camera": []}
    for name in models:
        variant = resolve(name)[0]
        views.setdefault(variant.card.view.kind, []).append(variant)
    tables: dict[str, list[Contender]] = {}
    for variant in (*views["range_image"], *views["top_view"], *views["camera"]):
        card, paths = variant.card, (variant.path,)
        image = folder / f"{variant.path.stem}-input.npy"
        images: tuple[Path, ...] = ()
        if isinstance(card.view, CameraGeometry):
            images = camera_images(card.view, folder)
            batch = np.empty((len(card.input.channels), card.view.height, card.view.width), np.float32)
            ImageScaler(card.view, card.input).fill(np.load(images[0]), batch)
            np.save(image, batch)
        else:
            np.save(image, project(make_projector(card.view, card.input), points).image)
        alone = [
            Contender(f"onnxruntime {own}, network alone", "session", own, "auto", paths, image=image)
            for own in dict.fromkeys(("cpu", provider))
            if own != "auto"
        ]
        alone += [
            Contender(f"{NAMES[engine]} {kind}, network alone", "network", engine, kind, paths, image=image)
            for engine, kind in (*OPENVINO, *(() if variant.precision == "int8" else SMALL))
        ]
        peaks = [
            Contender(f"peak {engine} {kind}".strip(), "peak", engine, kind) for engine, kind in (*PEAKS, ("copy", ""))
        ]
        pipelines = _pipelines([variant], provider, precision)
        if images:
            unet = Contender("", "unet", "torch", cards=(card.to_json(),))
            unets = [replace(unet, name=f"torch {kind}, small U-Net", precision=kind) for kind in ("fp32", "bf16")]
            pipelines = [replace(pipeline, inputs=images) for pipeline in (*pipelines, *unets)]
        tables[f"{'Image' if images else 'Scan'} to result: {variant}"] = [
            *pipelines, *_full_networks([variant]), *alone, *peaks
        ]  # fmt: skip
    for pair in zip(views["range_image"], views["top_view"], strict=False):
        at_once = Contender(
            "edgeperc, both at once, as by default", "default", provider, precision, tuple(each.path for each in pair)
        )
        pipelines = [*_pipelines(pair, provider, precision), at_once, *_full_networks(pair)]
        tables[f"Scan to result: {pair[0]} and {pair[1]}"] = pipelines
    for view in ("range image", "top view") if views["range_image"] or views["top_view"] else ():
        rows = ("edgeperc, numba", view), ("numpy", f"{view}, numpy")
        tables[f"Projection: {view}"] = [Contender(name, "projection", call) for name, call in rows]
    for variant in views["top_view"]:
        if any(output.kind == "box_dense" for output in variant.card.outputs):
            tables[f"One network or two: {variant}"] = _one_or_two(variant, folder)
    return tables


def methods(folder: Path) -> list[Contender]:
    """edgeperc's whole answers, others' networks with random weights (in ``folder``), clusters without a network."""
    rows = [
        Contender(f"edgeperc {view}, {label}", view, "cpu", precision, timed="scan to labels, cells and boxes")
        for precision, label in (("auto", "as by default"), ("fp32", "fp32"))
        for view in ANSWERS
    ]
    if not why_missing(Contender("", "network", "torch")):
        write_others(folder)
    for name, (_, outputs, _) in OTHERS.items():
        image, answers = folder / f"{name}.npy", "labels only" if outputs == ("logits",) else "boxes only"
        for kind in ("int8", "fp32"):
            row = Contender(f"{name} {kind}", "network", "onnxruntime", kind, (folder / f"{name} {kind}.onnx",))
            rows.append(replace(row, image=image, timed=f"network, {answers}"))
            if name == POINTPILLARS:
                rows.append(replace(row, kind="pillars", timed=f"scan to pillars, network, {answers}"))
    timed = "scan to ground and clusters only, one thread"
    return [*rows, Contender("Patchwork++, k-d tree", "clusters", "patchwork", timed=timed)]


def _pipelines(models: Sequence[Variant], provider: str, precision: str) -> list[Contender]:
    """All pipelines from scan to result. The first one is edgeperc's, the reference of the ratios."""
    paths, cards = tuple(model.path for model in models), tuple(model.card.to_json() for model in models)
    int8 = any(model.precision == "int8" for model in models)
    settings = dict.fromkeys(((provider, precision), ("cpu", "auto"), *([("openvino", "auto")] if int8 else OPENVINO)))
    if (provider, precision) == ("auto", "auto") and available_providers() == ("cpu",):
        del settings["cpu", "auto"]  # the same as auto
    others = (("onnxruntime", ""), *OPENVINO, *(() if int8 else (*SMALL, *TORCH)))  # torch cannot run the int8 graphs
    return [
        *(Contender(f"edgeperc, {_label(name, kind)}", "edgeperc", name, kind, paths) for name, kind in settings),
        *(Contender(f"numpy + {_label(name, kind)}", "pipeline", name, kind, paths, cards) for name, kind in others),
    ]


def _label(engine: str, precision: str) -> str:
    return f"{engine} {precision}".strip() if precision != "auto" else engine


def _full_networks(models: Sequence[Variant]) -> list[Contender]:
    """The papers' networks of the same tasks, in torch; only a source checkout has their files."""
    paths = tuple(model.path.parent / "research" / f"{model.name}-full.onnx" for model in models)
    if not all(path.exists() for path in paths):
        return []
    name, cards = " and ".join(path.stem for path in paths), tuple(ModelCard.read(path).to_json() for path in paths)
    return [Contender(f"numpy + torch fp32, {name}", "pipeline", "torch", "fp32", paths, cards)]


def _one_or_two(variant: Variant, folder: Path) -> list[Contender]:
    """SSADNet, two networks of its parts, and, as a lower bound for any detector, the box head on the bare input."""
    card, path = variant.card, variant.path
    image = folder / f"{path.stem}-input.npy"
    segmentation, detection, lean = (
        folder / f"{path.stem}-{part}.onnx" for part in ("segmentation", "detection", "lean")
    )
    if not why_missing(Contender("", "network", "torch")):
        import onnx

        from edgeperc_export.networks.ssadnet import DenseHead
        from edgeperc_export.release.to_onnx import to_graph

        extractor = onnx.utils.Extractor(onnx.load(path))
        classes, boxes = sorted(card.outputs, key=lambda output: output.kind.startswith("box_"))
        onnx.save(extractor.extract_model([card.input.name], [classes.name]), segmentation)
        onnx.save(extractor.extract_model([card.input.name], [boxes.name]), detection)
        head = DenseHead(len(card.input.channels), front=boxes.front)
        onnx.save(to_graph(head, replace(card, outputs=(replace(classes, block=(1, 1)),))), lean)
    parts = {
        "one network": (path,),
        "two networks": (segmentation, detection),
        "two, the detector without a trunk": (segmentation, lean),
        "segmentation alone": (segmentation,),
        "detection alone": (detection,),
    }
    return [Contender(name, "network", "onnxruntime", paths=paths, image=image) for name, paths in parts.items()]
