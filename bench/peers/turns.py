"""Run the contenders in turns, each in a process of its own."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from edgeperc import ModelCard, ModelError, Perceiver
from edgeperc.inference.session import Session
from edgeperc.types.sensor import get_sensor
from edgeperc.zoo import DEFAULT, listed

from ..context import conditions, disturbances, rss_mb, version_of
from ..samples import elapsed_ms
from ..worker import Prediction
from . import projection
from .arithmetic import matrix_product, memory_copy
from .camera import NumpyCamera, small_unet
from .contenders import ANSWERS, METHODS, Contender, Measured, groups, methods, why_missing
from .engines import open_engine
from .ground import ground_finders, tree_clusters
from .numpy_pipeline import NumpyPipeline
from .pillars import fill_pillars, random_weights
from .tables import floor_table, latency_table, methods_table

# From which libraries take their number of threads when a process starts.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
PAUSE_S = 0.02  # threads of the previous contender spin for some milliseconds
Calls = list[Callable[[], object]]
Prepare = Callable[[Any], Callable[[], object]]
"""What makes the call that is timed of a scan, or an image."""


# What runs in a contender's process


def make_perceiver(contender: Contender, sensor: str, n_threads: int) -> Perceiver:
    """edgeperc: a contender's models with boxes from networks and without rules, as the numpy pipelines; or, of
    `ANSWERS`, as by default, in two threads at most. Without a number of threads, networks run concurrently.
    """
    chosen: dict[str, Any] = {"full_turn": contender.kind == "full turn"}
    concurrent = n_threads > 1
    if contender.kind not in ANSWERS:
        chosen = {"models": list(contender.paths), "boxes_from": "network", "agree": False}
        concurrent = contender.kind == "default"
    return Perceiver(
        sensor=sensor,
        provider=contender.engine,
        precision=contender.precision,
        n_threads=None if concurrent else n_threads,
        on_mismatch="ignore",
        **chosen,
    )


def prepare(contender: Contender, sensor: str, n_threads: int) -> Prepare:
    """A contender's part in its own process; what an untrained network answers means nothing and is not compared."""
    kind, how = contender.kind, (contender.engine, contender.precision)
    if kind == "projection":
        return lambda scan: projection.contenders(np.ascontiguousarray(scan))[contender.engine]
    if kind == "clusters":  # of what Patchwork++ leaves; both know one thread only
        finders = ground_finders({"pypatchworkpp": import_module("pypatchworkpp")}, get_sensor(sensor))
        find_ground = finders["Patchwork++"]
        return lambda scan: partial(lambda ground: tree_clusters(scan[~ground()]), find_ground(scan))
    cards = [ModelCard.from_json(card) for card in contender.cards]
    if kind == "unet":
        return partial(partial, small_unet(cards[0], contender.precision, n_threads))
    if kind in ("edgeperc", "default", *ANSWERS):
        perceive = make_perceiver(contender, sensor, n_threads)
        return (lambda image: partial(perceive, image=image)) if contender.inputs else partial(partial, perceive)
    if kind == "session":
        networks: list[Any] = [Session(p, how[0], precision=how[1], n_threads=n_threads) for p in contender.paths]
    else:
        networks = [open_engine(*how, path, n_threads) for path in contender.paths]
    if kind == "pipeline":
        if contender.inputs:
            return partial(partial, NumpyCamera(cards[0], *networks))
        return partial(partial, NumpyPipeline(cards, networks, get_sensor(sensor)))
    if kind == "pillars":
        (network,), weights = networks, random_weights()
        return lambda scan: lambda: (fill_pillars(scan, weights, network.input), network.run())
    assert contender.image is not None  # networks alone, one after the other
    for network in networks:
        network.input[:] = np.load(contender.image)
    return lambda scan: lambda: [network.run() for network in networks]


def make_calls(contender: Contender, scans: Sequence[NDArray[Any]], sensor: str, n_threads: int) -> Calls:
    """What a contender does in a turn: one call per scan, or a peak of the machine."""
    if contender.kind == "peak" and contender.engine == "copy":
        return [memory_copy(n_threads)]
    if contender.kind == "peak":
        return [matrix_product(contender.engine, contender.precision, n_threads)] * 2
    call_of = prepare(contender, sensor, n_threads)
    return [call_of(scan) for scan in scans]


def serve(connection: Any, contender: Contender, files: Sequence[Path], sensor: str, n_threads: int) -> None:
    """Main function of a contender's process: get ready, send the predictions, and take turns until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it too, and ends this process
    warnings.simplefilter("ignore")  # deprecations of the libraries
    try:
        calls = make_calls(contender, [np.load(file) for file in files], sensor, n_threads)
        results: list[Any] = [call() for call in calls]
        predictions = [Prediction(r.points, r.top_view, r.boxes, r.image) for r in results if hasattr(r, "top_view")]
        connection.send(("ready", predictions, rss_mb()))
        del results, predictions
        while connection.recv() == "turn":
            calls[-1]()
            connection.send(("took", [round(elapsed_ms(call), 4) for call in calls], rss_mb()))
    except (EOFError, ConnectionError):
        return  # the parent has ended
    except Exception as exc:  # the libraries' errors share no base but Exception
        connection.send(("failed", f"{type(exc).__name__}: {' '.join(str(exc).split())[:160]}", 0.0))


# The parent's side


def measure(
    contenders: Sequence[Contender],
    files: Sequence[Path],
    *,
    sensor: str = "hdl-64e",
    n_threads: int = 1,
    n_rounds: int = 1,
    note: Callable[[str], None] = print,
    measured: list[Measured] | None = None,
) -> list[Measured]:
    """Let contenders take turns on .npy scans, filling ``measured``, so that results survive an interruption."""
    measured = [] if measured is None else measured
    spawn, rng = multiprocessing.get_context("spawn"), np.random.default_rng(0)
    running: list[tuple[Measured, Any, Any]] = []
    try:
        for contender in contenders:
            measured.append(contest := Measured(contender, missing=why_missing(contender)))
            if contest.missing:
                continue
            note(contender.name)
            here, there = spawn.Pipe()
            inputs = contender.inputs or tuple(files)
            process = spawn.Process(target=serve, args=(there, contender, inputs, sensor, n_threads))
            with patch.dict(os.environ, dict.fromkeys(THREADS, str(n_threads))):
                process.start()
            there.close()
            running.append((contest, here, process))
            if (content := _receive(contest, here)) is not None:
                contest.predictions = content
        for _ in range(n_rounds):
            for k in rng.permutation(len(running)):
                contest, here, _ = running[k]
                if contest.missing:
                    continue
                time.sleep(PAUSE_S)
                here.send("turn")
                if (content := _receive(contest, here)) is not None:
                    contest.rounds.append(content)
    finally:
        for _, here, _ in running:
            here.close()
        for _, _, process in running:
            process.join(timeout=5.0)
            if process.is_alive():
                process.kill()
                process.join()
    return measured


def _receive(each: Measured, here: Any) -> Any:
    try:
        kind, content, mb = here.recv()
    except (EOFError, ConnectionResetError):
        kind, content, mb = "failed", "its process died", 0.0
    if kind == "failed":
        each.missing = f"failed: {content}"
        return None
    each.rss_mb = mb
    return content


def run(
    document: dict[str, Any],
    files: Sequence[Path],
    folder: Path,
    arguments: argparse.Namespace,
    note: Callable[[str], None],
) -> None:
    """Measure the ``tables`` of the command's arguments ("engines": the same networks elsewhere; "methods": others),
    and record them in a document.
    """
    models = arguments.model or [str(variant) for variant in listed() if variant.name in DEFAULT]
    n_threads = arguments.threads or document["machine"]["usable_cores"]
    measuring: dict[str, list[Contender]] = {}
    document["peers"] = {}
    for package in ("mnn", "ncnn", "onnx", "openvino", "pypatchworkpp", "scipy", "torch"):
        if version := version_of(package):
            document["software"][package] = version
    if "engines" in arguments.tables:
        measuring = groups(models, arguments.provider, arguments.precision, folder, files[0], arguments.sensor)
        if arguments.model and not measuring:
            raise ModelError(f"no other engine runs {', '.join(models)}; pass a range-image, top-view or camera model")
    if "methods" in arguments.tables:
        note("writing the networks of others with random weights")
        measuring[METHODS] = methods(folder)
    for title, contenders in measuring.items():
        note(f"{title}: {len(contenders)} contenders")
        before, spent_s, measured = conditions(), _cpu_s(), list[Measured]()
        try:
            measure(
                contenders,
                files,
                sensor=arguments.sensor,
                n_threads=n_threads,
                n_rounds=arguments.rounds,
                note=lambda name: note(f"  starting {name}"),
                measured=measured,
            )
        finally:
            own_s = _cpu_s() - spent_s
            document["disturbances"] += [
                f"{title}: {each}" for each in disturbances(document["machine"], before, conditions(), own_s)
            ]
            document["peers"][title] = [
                asdict(replace(each.contender, paths=(), cards=(), inputs=(), image=None))
                | {"models": [path.name for path in each.contender.paths]}
                | {"rounds": each.rounds, "rss_mb": each.rss_mb, "missing": each.missing}
                for each in measured
            ]
            if any(each.rounds for each in measured):
                table = methods_table if title == METHODS else latency_table
                document["tables"].append(table(title, measured, n_threads))
                if any(each.contender.kind == "peak" for each in measured):
                    document["tables"].append(floor_table(title, measured))


def _cpu_s() -> float:
    """CPU time of this process and of its ended children [s]."""
    return sum(os.times()[:4])
