"""edgeperc beside what else one could run: torch, other engines, a pipeline in numpy, two networks in place of one.

Every contender is a process of its own, so that libraries do not meet in one address space and memory can be told. The
contenders of a table take turns, in an order drawn anew each round, so that whatever drifts treats them all alike. In
its turn a contender handles every scan once, after one that does not count: others ran meanwhile, and their threads
may still be spinning. Machine peaks are measured by contenders too, in the same rounds as the networks.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import math
import multiprocessing
import os
import signal
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgeperc import ModelCard, ModelError, Perceiver
from edgeperc.card import TopViewGeometry
from edgeperc.cli import SHIPPED
from edgeperc.models import model_path, shipped_models
from edgeperc.projection import make_projector
from edgeperc.sensors import get_sensor
from edgeperc.session import Session, available_providers

from . import projection
from .accuracy import agreement
from .arithmetic import COPY_BYTES, PRODUCT_SIZE, cost, matrix_product, memory_copy
from .context import conditions, rss_mb, spoilers
from .report import number, share
from .rivals import Rival, open_engine
from .samples import noise_floor, percentile, summary
from .worker import Answer

__all__ = [
    "Contender",
    "Found",
    "absent",
    "default_models",
    "floor_table",
    "groups",
    "latency_table",
    "measure",
    "resized",
    "run",
]

INSTALL = "not installed: pip install 'edgeperc[peers]'"
TORCH = ("torch:fp32", "torch.compile:fp32", "torch:bf16", "torch.compile:bf16")
OPENVINO = ("openvino:fp32", "openvino:bf16")
NEEDS = {"openvino": ("openvino",), "torch": ("torch", "onnx"), "torch.compile": ("torch", "onnx")}
PEAKS = ("numpy:fp32", "torch:fp32", "torch:bf16", "torch:int8", "openvino:fp32", "openvino:bf16")
PAUSE_S = 0.02  # threads of the contender before go on spinning for some milliseconds
Calls = list[Callable[[], object]]


@dataclass(frozen=True)
class Contender:
    """One row of a table.

    Attributes
    ----------
    name : str
    kind : str
        A key of `MAKERS`.
    engine : str
        A provider for kind ``"edgeperc"``, else as `open_engine` or `matrix_product` have it.
    paths : tuple of Path
        Models.
    cards : tuple of str
        Of the models, JSON.
    image : Path or None
        Input of a network alone, .npy.
    """

    name: str
    kind: str
    engine: str = ""
    paths: tuple[Path, ...] = ()
    cards: tuple[str, ...] = ()
    image: Path | None = None


@dataclass
class Found:
    """What was measured of a contender: milliseconds by round, memory, answers, or why there are none."""

    contender: Contender
    rounds: list[list[float]] = field(default_factory=list)
    rss_mb: float | None = None
    answers: list[Answer] = field(default_factory=list)
    why_not: str = ""

    @property
    def ms(self) -> list[float]:
        return [ms for each in self.rounds for ms in each]

    @property
    def p50(self) -> float:
        return percentile(self.ms, 50.0)


def absent(contender: Contender) -> str:
    """Why a contender cannot run here; empty where it can."""
    library = contender.engine.partition(":")[0]
    if contender.kind == "edgeperc":
        known = library in ("auto", *available_providers())
        return "" if known else "onnxruntime offers no such provider on this computer"
    needed = NEEDS.get(library, ())
    # Networks cut out of others are only there where onnx is.
    here = all(importlib.util.find_spec(name) for name in needed) and all(path.exists() for path in contender.paths)
    return "" if here else INSTALL


# What runs in a contender's process


def make_perceiver(contender: Contender, scans: Sequence[NDArray[np.float32]], sensor: str, n_threads: int) -> Calls:
    perceive = Perceiver(
        list(contender.paths),
        sensor=sensor,
        provider=contender.engine,
        n_threads=n_threads,
        on_mismatch="ignore",
        boxes_from="network",  # as the rivals
    )
    return [lambda scan=scan: perceive(scan) for scan in scans]  # type: ignore[misc]


def make_rival(contender: Contender, scans: Sequence[NDArray[np.float32]], sensor: str, n_threads: int) -> Calls:
    engines = [open_engine(contender.engine, path, n_threads) for path in contender.paths]
    rival = Rival([ModelCard.from_json(card) for card in contender.cards], engines, get_sensor(sensor))
    return [lambda scan=scan: rival(scan) for scan in scans]  # type: ignore[misc]


def make_network(contender: Contender, scans: Sequence[NDArray[np.float32]], sensor: str, n_threads: int) -> Calls:
    """Networks alone, one after the other, their input in place."""
    assert contender.image is not None
    image = np.load(contender.image)
    runs: Calls = []
    for path in contender.paths:
        # edgeperc's Session has `input` and `run` too
        network: Any
        if contender.kind == "session":
            network = Session(path, contender.engine, n_threads)
        else:
            network = open_engine(contender.engine, path, n_threads)
        network.input[:] = image
        runs.append(network.run)
    return [lambda: [run() for run in runs]] * len(scans)


def make_projection(contender: Contender, scans: Sequence[NDArray[np.float32]], sensor: str, n_threads: int) -> Calls:
    return [projection.contenders(np.ascontiguousarray(scan))[contender.engine] for scan in scans]


def make_peak(contender: Contender, scans: Sequence[NDArray[np.float32]], sensor: str, n_threads: int) -> Calls:
    if contender.engine == "copy":
        return [memory_copy(n_threads)]
    library, _, precision = contender.engine.partition(":")
    return [matrix_product(library, precision, n_threads)] * 2


MAKERS: Mapping[str, Callable[[Contender, Sequence[NDArray[np.float32]], str, int], Calls]] = {
    "edgeperc": make_perceiver,
    "rival": make_rival,
    "session": make_network,
    "network": make_network,
    "projection": make_projection,
    "peak": make_peak,
}


def serve(connection: Any, contender: Contender, files: Sequence[Path], sensor: str, n_threads: int) -> None:
    """Get ready, tell the answers, and take turns until told otherwise."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it too, and ends this process
    warnings.simplefilter("ignore")  # libraries speak of their own future
    try:
        calls = MAKERS[contender.kind](contender, [np.load(file) for file in files], sensor, n_threads)
        answers: list[Any] = [call() for call in calls]
        told = [Answer(a.points, a.top_view, a.boxes) for a in answers if hasattr(a, "top_view")]
        connection.send(("ready", told, rss_mb()))
        del answers, told
        while connection.recv() == "turn":
            calls[-1]()
            took = []
            for call in calls:
                began = time.perf_counter_ns()
                call()
                took.append(round((time.perf_counter_ns() - began) / 1e6, 4))
            connection.send(("took", took, rss_mb()))
    except EOFError:
        return  # the parent is gone
    except Exception as exc:  # rivals' errors share no base but Exception
        connection.send(("failed", f"{type(exc).__name__}: {' '.join(str(exc).split())[:160]}", 0.0))


# The parent's side


@contextmanager
def _threads(n: int) -> Iterator[None]:
    """Tell libraries that ask the environment, when a process starts, how many threads to use."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, str(n)))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def measure(
    contenders: Sequence[Contender],
    files: Sequence[Path],
    *,
    sensor: str = "hdl-64e",
    n_threads: int = 1,
    n_rounds: int = 1,
    say: Callable[[str], None] = print,
    found: list[Found] | None = None,
) -> list[Found]:
    """Let contenders take turns.

    Parameters
    ----------
    contenders : sequence of Contender
    files : sequence of Path
        Scans, .npy (n, 4), in the sensor's raw unit of remission.
    sensor : str
    n_threads : int
        For every library alike.
    n_rounds : int
    say : callable
        Told who gets ready.
    found : list, optional
        Filled as it goes, so that something is left after an interruption.

    Returns
    -------
    list of Found
        In the order of ``contenders``; who is absent, fails or dies says so in ``why_not``.
    """
    found = [] if found is None else found
    spawn, rng = multiprocessing.get_context("spawn"), np.random.default_rng(0)
    running: list[tuple[Found, Any, Any]] = []
    try:
        for contender in contenders:
            found.append(each := Found(contender, why_not=absent(contender)))
            if each.why_not:
                continue
            say(contender.name)
            here, there = spawn.Pipe()
            process = spawn.Process(target=serve, args=(there, contender, tuple(files), sensor, n_threads))
            with _threads(n_threads):
                process.start()
            there.close()
            running.append((each, here, process))
            if (content := _receive(each, here)) is not None:
                each.answers = content
        for _ in range(n_rounds):
            for k in rng.permutation(len(running)):
                each, here, _ = running[k]
                if each.why_not:
                    continue
                time.sleep(PAUSE_S)
                here.send("turn")
                if (content := _receive(each, here)) is not None:
                    each.rounds.append(content)
    finally:
        for _, here, _ in running:
            here.close()
        for _, _, process in running:
            process.join(timeout=5.0)
            if process.is_alive():
                process.kill()
                process.join()
    return found


def _receive(each: Found, here: Any) -> Any:
    try:
        word, content, mb = here.recv()
    except (EOFError, ConnectionResetError):
        word, content, mb = "failed", "its process died", 0.0
    if word == "failed":
        each.why_not = f"failed: {content}"
        return None
    each.rss_mb = mb
    return content


# Who is measured


def default_models() -> list[str]:
    """The shipped models that are measured unless others are named."""
    names = [f"{name}{suffix}" for suffix in ("", "-edge", "-edge-int8") for name in SHIPPED]
    return [name for name in names if name in shipped_models()]


def groups(models: Sequence[str], provider: str, folder: Path, scan: Path, sensor: str) -> dict[str, list[Contender]]:
    """All contenders, by the title of their table.

    Parameters
    ----------
    models : sequence of str
        Names or paths; those of a range image are paired with those of a top view, first with first.
    provider : str
        edgeperc's own.
    folder : Path
        For inputs and for the two networks in place of one.
    scan : Path
        What networks alone see.
    sensor : str
    """
    profile, points = get_sensor(sensor), np.load(scan)
    views: dict[str, list[tuple[str, Path, ModelCard]]] = {"range_image": [], "top_view": []}
    for name in models:
        path = Path(name) if name.endswith(".onnx") else model_path(name)
        card = Session(path, "cpu").card
        views[card.view.kind].append((card.name, path, card))
    told: dict[str, list[Contender]] = {}
    for name, path, card in (*views["range_image"], *views["top_view"]):
        image = folder / f"{name}-input.npy"
        projector = make_projector(card.view, card.input)
        np.save(image, projector.project(points, profile.remission_offset, profile.remission_scale).image)
        alone = [Contender("onnxruntime CPU, network alone", "session", "cpu", (path,), image=image)]
        if provider not in ("auto", "cpu"):
            alone.append(Contender(f"onnxruntime {provider}, network alone", "session", provider, (path,), image=image))
        for engine in OPENVINO:
            alone.append(Contender(f"OpenVINO API {engine[9:]}, network alone", "network", engine, (path,), (), image))
        peaks = [Contender(f"peak {engine}", "peak", engine) for engine in (*PEAKS, "copy")]
        full = [model for model in views[card.view.kind] if name.startswith(f"{model[0]}-edge") and model[0] in SHIPPED]
        told[f"Scan to answer: {name}"] = [*whole([(name, path, card)], provider), *larger(full), *alone, *peaks]
    for pair in zip(views["range_image"], views["top_view"], strict=False):
        told[f"Scan to answer: {pair[0][0]} and {pair[1][0]}"] = whole(pair, provider)
    for view in ("range image", "top view"):
        rows = ("edgeperc, numba", view), ("numpy", f"{view}, numpy")
        told[f"Projection: {view}"] = [Contender(name, "projection", call) for name, call in rows]
    for name, path, card in views["top_view"]:
        if any(o.kind == "box_dense" for o in card.outputs):
            told[f"One network or two: {name}"] = one_or_two(name, path, card, folder)
    return told


def whole(models: Sequence[tuple[str, Path, ModelCard]], provider: str) -> list[Contender]:
    """Ways from scan to answer; the first is edgeperc's, to which all others are held."""
    paths, cards = tuple(path for _, path, _ in models), tuple(card.to_json() for _, _, card in models)
    own = dict.fromkeys((provider, "cpu", *OPENVINO))
    if provider == "auto" and available_providers() == ("cpu",):
        del own["cpu"]  # it is what auto takes
    rounded = any(card.training.get("precision") == "int8" for _, _, card in models)
    rivals = ("onnxruntime", *OPENVINO, *(() if rounded else TORCH))  # torch has no such networks
    return [
        *(Contender(f"edgeperc, {name}", "edgeperc", name, paths) for name in own),
        *(Contender(f"numpy + {name}", "rival", name, paths, cards) for name in rivals),
    ]


def larger(models: Sequence[tuple[str, Path, ModelCard]]) -> list[Contender]:
    """The full network in torch, beside the one for small computers that was made of it."""
    return [
        Contender(f"numpy + {TORCH[0]}, {name}", "rival", TORCH[0], (path,), (card.to_json(),))
        for name, path, card in models
    ]


def one_or_two(name: str, path: Path, card: ModelCard, folder: Path) -> list[Contender]:
    """SSADNet, and two networks of its very parts: segmentation alone, and detection on a trunk of its own.

    Together they give SSADNet's own answers. Whoever would give a detector less has the third row: the boxes' head on
    the bare input, without a trunk, its weights random.
    """
    image = folder / f"{name}-input.npy"
    segmentation, detection, lean = (folder / f"{name}-{part}.onnx" for part in ("segmentation", "detection", "lean"))
    if not absent(Contender("", "network", "torch")):
        import onnx

        from edgeperc_export.networks.ssadnet import DenseHead
        from edgeperc_export.to_onnx import to_graph

        extractor = onnx.utils.Extractor(onnx.load(path))
        classes, boxes = sorted(card.outputs, key=lambda output: output.kind.startswith("box_"))
        onnx.save(extractor.extract_model([card.input.name], [classes.name]), segmentation)
        onnx.save(extractor.extract_model([card.input.name], [boxes.name]), detection)
        onnx.save(to_graph(DenseHead(len(card.input.channels)), replace(card, outputs=(classes,))), lean)
    parts = {
        "one network": (path,),
        "two networks": (segmentation, detection),
        "two, the detector without a trunk": (segmentation, lean),
        "segmentation alone": (segmentation,),
        "detection alone": (detection,),
    }
    return [Contender(words, "network", "onnxruntime", files, image=image) for words, files in parts.items()]


def resized(model: str, share: float, folder: Path) -> Path:
    """A model of the same network for a view of ``share`` times the pixels, its weights at random.

    A range image gets as many times the columns, a top view reaches as many times as far.

    Raises
    ------
    ModelError
        The card does not say how the network was made, or the network does not fit such an image.
    """
    from edgeperc_export.to_onnx import to_graph, write_card
    from edgeperc_export.train import Recipe, build

    path = Path(model) if model.endswith(".onnx") else model_path(model)
    card = Session(path, "cpu").card
    recipe = card.training.get("recipe")
    if not isinstance(recipe, dict):
        raise ModelError(f"the card of {path} has no training recipe, by which its network could be made again")
    view: Any = card.view
    if isinstance(view, TopViewGeometry):
        near, far = view.x_range_m
        view = replace(view, x_range_m=(near, near + share * (far - near)))
    else:
        view = replace(view, width=round(share * view.width))
    card = replace(card, view=view, golden=None)
    made = folder / f"{card.name}-{share:g}.onnx"
    write_card(to_graph(build(Recipe(**recipe)), card), card, made)
    return made


# What is told


def run(
    document: dict[str, Any],
    files: Sequence[Path],
    folder: Path,
    *,
    models: Sequence[str],
    provider: str,
    sensor: str,
    n_threads: int,
    n_rounds: int,
    say: Callable[[str], None],
) -> None:
    """Measure every table, one after the other, into a report's document."""
    document["peers"] = {}
    for package in ("onnx", "openvino", "torch"):
        with suppress(importlib.metadata.PackageNotFoundError):
            document["software"][package] = importlib.metadata.version(package)
    for title, contenders in groups(models, provider, folder, files[0], sensor).items():
        say(f"{title}: {len(contenders)} contenders")
        before, spent_s, found = conditions(), _cpu_s(), list[Found]()
        try:
            measure(
                contenders,
                files,
                sensor=sensor,
                n_threads=n_threads,
                n_rounds=n_rounds,
                say=lambda name: say(f"  starting {name}"),
                found=found,
            )
        finally:
            own_s = _cpu_s() - spent_s
            document["spoilers"] += [
                f"{title}: {words}" for words in spoilers(document["machine"], before, conditions(), own_s)
            ]
            document["peers"][title] = [
                asdict(replace(each.contender, paths=(), cards=(), image=None))
                | {"models": [path.name for path in each.contender.paths]}
                | {"rounds": each.rounds, "rss_mb": each.rss_mb, "why_not": each.why_not}
                for each in found
            ]
            if any(each.rounds for each in found):
                document["tables"].append(latency_table(title, found, n_threads))
                if any(each.contender.kind == "peak" for each in found):
                    document["tables"].append(floor_table(title, found))


def _cpu_s() -> float:
    """CPU time of this process and of those it has ended [s]."""
    return sum(os.times()[:4])


def latency_table(title: str, found: Sequence[Found], n_threads: int) -> dict[str, Any]:
    """Times of all contenders but the machine's peaks, beside those of the first."""
    shown = [each for each in found if each.contender.kind != "peak"]
    first = shown[0]
    rows = []
    for each in shown:
        told = summary(each.ms)
        agree = agreement(first.answers, each.answers) if first.answers and each.answers else {}
        equal = [agree[kind]["equal"] for kind in ("points", "cells") if agree.get(kind)]
        boxes = agree.get("boxes")
        rows.append(
            [
                *(each.contender.name, f"{told['n']:,}", *(number(told[q]) for q in ("p50", "p90", "p99"))),
                share(noise_floor([np.ravel(part) for part in np.array_split(np.array(each.rounds), 3)])),
                *(number(each.p50 / first.p50), share(min(equal, default=None))),
                f"{boxes['n_both']} of {boxes['n_reference']}" if boxes else "-",
                *(number(each.rss_mb, 0), each.why_not or "-"),
            ]
        )
    words = [
        f"ms; {n_threads} threads for every library; ratios are to the first row; noise: spread of the medians of "
        "three thirds; labels and boxes: those in common with the first row"
    ]
    if any(each.contender.kind == "rival" for each in shown):
        words.append("rivals leave out PointSeg's removal of outliers: they do less than edgeperc")
    for alone in (each for each in shown if each.contender.kind == "network" and each.contender.engine in OPENVINO):
        ratios = [
            f"{each.contender.name} {number(each.p50 / alone.p50)}"
            for each in shown
            if each.contender.kind == "edgeperc" and each.ms and alone.ms
        ]
        if ratios:
            words.append(f"whole way / {alone.contender.name}: {'; '.join(ratios)}")
    head = ["contender", "n", "p50", "p90", "p99", "noise", "x edgeperc", "labels equal", "boxes", "RSS MB", "note"]
    return {"title": title, "sentences": words, "head": head, "rows": rows}


def floor_table(title: str, found: Sequence[Found]) -> dict[str, Any]:
    """What the network of a table could take at least on this machine, and what it takes."""
    (path,) = found[0].contender.paths
    words, rows = [], []
    best_ms = {each.contender.engine: min(each.ms) for each in found if each.contender.kind == "peak" and each.ms}
    bytes_per_ms = 2.0 * COPY_BYTES / best_ms["copy"] if "copy" in best_ms else math.nan
    words.append(f"memory: {number(bytes_per_ms / 1e6, 1)} GB/s read and written by a copy")
    if absent(Contender("", "network", "torch")):
        words.append(f"multiplications are not counted: onnx is {INSTALL}")
    else:
        needs, rounded = cost(path), Session(path, "cpu").card.training.get("precision") == "int8"
        words.append(
            f"{needs.macs / 1e9:.2f} GMAC, {needs.padding_macs / 1e9:.2f} of them on padding, which the floor leaves "
            f"out; {needs.weights / 1e6:.1f} M weights; {needs.activations / 1e6:.1f} M activations"
        )
        for precision, n_bytes in (("fp32", 4), ("bf16", 2), ("int8", 1)):
            peaks = {name: ms for name, ms in best_ms.items() if name.endswith(precision)}
            library = min(peaks, key=lambda name: peaks[name], default="")
            rate = PRODUCT_SIZE**3 / peaks[library] if library else math.nan
            floor = (needs.macs - needs.padding_macs) / rate
            networks = [
                each
                for each in found
                if each.contender.kind in ("network", "session")
                and each.ms
                and ("int8" if rounded else precision_of(each.contender)) == precision
            ]
            fastest = min(networks, key=lambda each: each.p50, default=None)
            took = fastest.p50 if fastest else math.nan
            rows.append(
                [
                    *(precision, number(rate / 1e6, 0), library.partition(":")[0] or "-", number(floor)),
                    *(number(n_bytes * (needs.weights + needs.activations) / bytes_per_ms), number(took)),
                    *(fastest.contender.name if fastest else "-", share(floor / took)),
                ]
            )
    head = ["precision", "peak GMAC/s", "by", "floor ms", "traffic ms", "network ms", "by", "share of peak"]
    words.append(
        "peak: the fastest matrix product seen; traffic: every layer's numbers from and to memory once, which "
        "caches save"
    )
    return {"title": f"Floor: {title.partition(': ')[2]}", "sentences": words, "head": head, "rows": rows}


def precision_of(contender: Contender) -> str:
    return contender.engine.partition(":")[2] or "fp32"
