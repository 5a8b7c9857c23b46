"""Contenders run in turns, each in a process of its own."""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
import signal
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgeperc import ModelCard, Perceiver
from edgeperc.sensor import get_sensor
from edgeperc.session import Session

from ..context import conditions, rss_mb, spoilers
from ..worker import Answer
from . import projection
from .arithmetic import matrix_product, memory_copy
from .contenders import Contender, Found, absent, groups
from .engines import open_engine
from .numpy_pipeline import Rival
from .tables import floor_table, latency_table

__all__ = ["measure", "run"]

PAUSE_S = 0.02  # threads of the contender before go on spinning for some milliseconds
Calls = list[Callable[[], object]]


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
            network = Session(path, contender.engine, n_threads=n_threads)
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
