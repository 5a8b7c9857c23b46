"""Fresh processes that measure, and the parent's side of them.

Every repeat is a process of its own (spawned, never forked), so that repeats differ by what processes differ by: where
memory lies, which cores threads land on. What a process has resident is the Perceiver, the scans, and nothing of its
parent.
"""

from __future__ import annotations

import multiprocessing
import signal
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import edgeperc.errors
from edgeperc import EdgepercError, Perceiver

from .context import EnergyMeter, conditions, peak_rss_mb, rss_mb
from .loadgen import single_stream
from .scenarios import Limits, Perceive, Samples, back_to_back, paced

__all__ = ["MEMORY_SAMPLES", "Answer", "Job", "OnTick", "Scenario", "WorkerError", "measure"]

TICK_S = 0.25
MEMORY_SAMPLES = 500  # at most, in a scenario: a longer list would itself be growth
# What a process may take to end its scan and answer after it was asked to stop.
STOP_S = 30.0


class WorkerError(EdgepercError):
    """A measuring process died."""


@dataclass(frozen=True)
class Scenario:
    """One way of scans to arrive: back to back, or at a rate.

    Attributes
    ----------
    name : str
    scans : tuple of Path
        .npy files, (n, 4) float32 each, in the sensor's raw unit of remission.
    limits : Limits
    rate_hz : float or None
        None for back to back.
    """

    name: str
    scans: tuple[Path, ...]
    limits: Limits
    rate_hz: float | None = None


@dataclass(frozen=True)
class Job:
    """What a process is to do.

    Attributes
    ----------
    models : tuple of str
    provider, n_threads, sensor
        As `Perceiver` has them.
    scenarios : tuple of Scenario
        One after the other.
    answers : tuple of Path
        Scans whose answers are wanted after everything else.
    loadgen : Path or None
        Where MLPerf LoadGen's logs go; it then drives the first scenario in place of `back_to_back`.
    """

    models: tuple[str, ...]
    provider: str = "auto"
    n_threads: int | None = None
    sensor: str = "hdl-64e"
    scenarios: tuple[Scenario, ...] = ()
    answers: tuple[Path, ...] = ()
    loadgen: Path | None = None


@dataclass(frozen=True)
class Answer:
    """What of a perception is held against another's."""

    points: edgeperc.PointLabels | None
    top_view: edgeperc.TopView | None
    boxes: tuple[edgeperc.Box, ...]


OnTick = Callable[[str, Sequence[float]], None]


def make_perceiver(job: Job) -> Perceiver:
    """The Perceiver that a job asks for; every fault of the request is an `EdgepercError`."""
    return Perceiver(list(job.models), sensor=job.sensor, provider=job.provider, n_threads=job.n_threads)


def serve(connection: Any, job: Job) -> None:
    """What the process does: gets ready, waits for the word, measures, and sends what it has."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it too, and asks for what there is
    try:
        try:
            connection.send(("done", _work(connection, job)))
        except EdgepercError as exc:
            connection.send(("failed", (type(exc).__name__, str(exc))))
    except (BrokenPipeError, ConnectionResetError, EOFError):
        return  # the parent is gone


def _work(connection: Any, job: Job) -> dict[str, Any]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        began = time.perf_counter()
        perceive = make_perceiver(job)
        result: dict[str, Any] = {"construct_s": time.perf_counter() - began, "first_call_ms": None}
        scans = {path: np.load(path) for path in dict.fromkeys((*_paths(job), *job.answers))}
        if scans:
            began = time.perf_counter()
            perceive(next(iter(scans.values())))
            result["first_call_ms"] = 1e3 * (time.perf_counter() - began)
        result |= {"engines": _engines(perceive), "scenarios": {}, "interrupted": False, "answers": []}
        result["scans_mb"] = sum(scan.nbytes for scan in scans.values()) / 1e6
        connection.send(("ready", None))
        stopped = connection.recv() == "stop"
        for scenario in job.scenarios:
            if stopped:
                break
            watch = _Watch(connection, scenario)
            own = [scans[path] for path in scenario.scans]
            if job.loadgen is not None:
                run: Callable[..., Samples] = partial(single_stream, folder=job.loadgen)
            else:
                run = back_to_back if scenario.rate_hz is None else partial(paced, rate_hz=scenario.rate_hz)
            samples = run(perceive, own, limits=scenario.limits, keep_going=watch, on_start=watch.start)
            result["scenarios"][scenario.name] = watch.told(samples)
            stopped = watch.stopped
        result |= {"interrupted": stopped, "rss_mb": rss_mb(), "peak_rss_mb": peak_rss_mb()}
        if not stopped:
            result["answers"] = [_answer(perceive, scans[path]) for path in job.answers]
    result["warnings"] = list(dict.fromkeys(str(each.message) for each in caught))
    return result


def _paths(job: Job) -> Iterator[Path]:
    for scenario in job.scenarios:
        yield from scenario.scans


def _answer(perceive: Perceive, scan: NDArray[np.float32]) -> Answer:
    found = perceive(scan)
    return Answer(found.points, found.top_view, found.boxes)


def _engines(perceive: Perceiver) -> list[dict[str, Any]]:
    """What really runs, by network."""
    told = []
    for session in perceive.sessions:
        told.append(
            {
                "name": session.card.name,
                "version": session.card.version,
                "sha256": session.sha256,
                "provider": session.provider,
                "options": session.options,
                "golden_deviation": None if np.isnan(session.golden_deviation) else session.golden_deviation,
            }
        )
    return told


class _Watch:
    """Looks up from measuring a few times a second: tells the parent, and asks whether to stop. Never within a call."""

    def __init__(self, connection: Any, scenario: Scenario) -> None:
        self.connection, self.scenario, self.stopped = connection, scenario, False
        self.rss: list[tuple[int, float]] = []
        self._told = 0
        self._next_s = time.perf_counter() + TICK_S
        self.start()

    def start(self) -> None:
        self.rss.clear()
        self.energy = EnergyMeter()
        self.before = conditions()
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()

    def __call__(self, samples: Samples) -> bool:
        now = time.perf_counter()
        if now >= self._next_s:
            self._next_s = now + TICK_S
            self.energy.tick()
            if not self.rss or samples.n >= self.rss[-1][0] + self.scenario.limits.min_scans / MEMORY_SAMPLES:
                self.rss.append((samples.n, round(rss_mb(), 3)))
            self.connection.send(("tick", (self.scenario.name, samples.ms[self._told :])))
            self._told = len(samples.ms)
            self.stopped = self.stopped or (self.connection.poll() and self.connection.recv() == "stop")
        return not self.stopped

    def told(self, samples: Samples) -> dict[str, Any]:
        cpu_s, wall_s = time.process_time() - self._cpu_s, time.perf_counter() - self._wall_s
        self.energy.tick()
        self.rss.append((samples.n, round(rss_mb(), 3)))
        return {
            "rate_hz": self.scenario.rate_hz,
            "limits": asdict(self.scenario.limits),
            **_rounded(asdict(samples)),
            "wall_s": wall_s,
            "cpu_s": cpu_s,
            "rss_mb": [list(each) for each in self.rss],
            "energy_j": self.energy.joules or None,
            "before": self.before,
            "after": conditions(),
            "interrupted": self.stopped,
        }


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_rounded(inner) for inner in value]
    return round(value, 6) if isinstance(value, float) else value


class _Interrupts:
    """The first Ctrl-C is a request, the second one an exception: no message is cut in two by it."""

    def __init__(self) -> None:
        self.asked = False

    def __call__(self, *_: Any) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


@contextmanager
def _interrupts() -> Iterator[_Interrupts]:
    requests = _Interrupts()
    old = signal.signal(signal.SIGINT, requests)
    try:
        yield requests
    finally:
        signal.signal(signal.SIGINT, old)


def measure(jobs: Sequence[Job], on_tick: OnTick = lambda name, ms: None) -> list[dict[str, Any]]:
    """Do several jobs at once, each in a fresh process; all begin when all are ready.

    Ctrl-C asks the processes for what they have, which is returned with ``"interrupted"`` set; a second one ends them.
    To be called from the main thread.

    Parameters
    ----------
    jobs : sequence of Job
    on_tick : callable
        Told the name of a scenario and the milliseconds of calls since it was told last.

    Returns
    -------
    list of dict
        Of each job: ``engines``, ``construct_s``, ``first_call_ms``, ``scenarios``, ``rss_mb``, ``peak_rss_mb``,
        ``answers`` and so on.

    Raises
    ------
    EdgepercError
        Whatever a process raised, or `WorkerError` where it died.
    """
    spawn = multiprocessing.get_context("spawn")
    workers = []
    results: dict[int, dict[str, Any]] = {}
    try:
        with _interrupts() as interrupts:
            for job in jobs:
                here, there = spawn.Pipe()
                process = spawn.Process(target=serve, args=(there, job), daemon=True)
                process.start()
                there.close()
                workers.append((process, here))
            n_ready, stop_by_s = 0, 0.0
            while len(results) < len(jobs):
                pending = {here: k for k, (_, here) in enumerate(workers) if k not in results}
                for here in wait(list(pending), timeout=TICK_S):
                    kind, content = _receive(here, workers[pending[here]][0])
                    if kind == "ready":
                        n_ready += 1
                        if n_ready == len(jobs):
                            for _, each in workers:
                                each.send("go")
                    elif kind == "tick":
                        on_tick(*content)
                    else:
                        results[pending[here]] = content
                if interrupts.asked and not stop_by_s:
                    stop_by_s = time.perf_counter() + STOP_S
                    for each in pending:
                        with suppress(OSError):  # it has just ended
                            each.send("stop")
                if stop_by_s and time.perf_counter() > stop_by_s:
                    raise KeyboardInterrupt
            for process, _ in workers:
                process.join()
    finally:
        for process, here in workers:
            here.close()
            if process.is_alive():
                process.kill()
                process.join()
    return [results[k] for k in range(len(jobs))]


def _receive(connection: Any, process: Any) -> tuple[str, Any]:
    try:
        kind, content = connection.recv()
    except EOFError as exc:
        process.join()
        raise WorkerError(
            f"a measuring process ended with exit code {process.exitcode} before it had an answer; look at its last "
            "words above, or whether memory ran out"
        ) from exc
    if kind == "failed":
        name, message = content
        error = getattr(edgeperc.errors, name, EdgepercError)
        raise EdgepercError(message) if error is edgeperc.errors.MissingExtraError else error(message)
    return kind, content
