"""Measure in fresh processes.

Every repeat is a process of its own (spawned, never forked), so that the noise includes the differences between
processes: memory layout and the cores of the threads. A process holds a Perceiver and the scans, and nothing of its
parent.
"""

from __future__ import annotations

import json
import multiprocessing
import signal
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import edgeperc.errors
from edgeperc.errors import EdgepercError

from .context import EnergyMeter, conditions, peak_rss_mb, rss_mb
from .loadgen import single_stream
from .scenarios import Limits, Timings, back_to_back

if TYPE_CHECKING:
    from edgeperc import Perceiver

TICK_S = 0.25
MEMORY_SAMPLES = 500  # at most, in a scenario: a longer list would itself be memory growth
# Time for a process to end its scan and send its results after it was asked to stop.
STOP_S = 30.0


class WorkerError(EdgepercError):
    """A measuring process died."""


@dataclass(frozen=True)
class Scenario:
    """How scans arrive."""

    name: str
    scans: tuple[Path, ...]  # .npy files, (n, 4) float32, with remission in the sensor's raw unit
    limits: Limits
    rate_hz: float | None = None  # None: back to back
    application: bool = False  # also stream, track, write JSON and draw, as `Application` does


@dataclass(frozen=True)
class Job:
    """The work of one process; options as of `Perceiver`."""

    models: tuple[str, ...]
    provider: str = "auto"
    precision: str = "auto"
    n_threads: int | None = None
    sensor: str = "hdl-64e"
    full_turn: bool = False
    scenarios: tuple[Scenario, ...] = ()  # one after the other
    predict: tuple[Path, ...] = ()  # scans whose predictions are returned; perceived after everything else
    loadgen: Path | None = None  # folder of MLPerf LoadGen's logs; then LoadGen drives the scenarios


@dataclass(frozen=True)
class Prediction:
    """The parts of a perception that are compared with another's."""

    points: edgeperc.PointLabels | None
    top_view: edgeperc.TopView | None
    boxes: tuple[edgeperc.Box, ...]
    image: edgeperc.ImageLabels | None = None


OnTick = Callable[[str, Sequence[float]], None]


def settings_of(job: Job) -> dict[str, Any]:
    """The arguments of a job's Perceiver that a report names, as JSON types."""
    names = ("provider", "precision", "n_threads", "sensor", "full_turn")
    return {"models": list(job.models), **{name: getattr(job, name) for name in names}}


def make_perceiver(job: Job) -> Perceiver:
    """Make a job's Perceiver: the time is of interest even for scans that are too large or sparse for the models."""
    from edgeperc import Perceiver

    return Perceiver(**settings_of(job), on_mismatch="warn")


def serve(connection: Any, job: Job) -> None:
    """Main function of a measuring process: get ready, wait for the start, measure, and send the results."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it too, and asks for the results so far
    try:
        try:
            connection.send(("done", work(connection, job)))
        except EdgepercError as exc:
            connection.send(("failed", (type(exc).__name__, str(exc))))
    except (BrokenPipeError, ConnectionResetError, EOFError):
        return  # the parent has ended


def work(connection: Any, job: Job) -> dict[str, Any]:
    """Do one job and return what it measured."""
    # Here, before anything is timed: without them, a start of the command takes 0.4 in place of 1.2 s.
    from .application import Application

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        began = time.perf_counter()
        perceive = make_perceiver(job)
        result: dict[str, Any] = {"construct_s": time.perf_counter() - began, "first_call_ms": None}
        named = [path for scenario in job.scenarios for path in scenario.scans]
        scans = {path: np.load(path) for path in dict.fromkeys((*named, *job.predict))}
        if scans:
            began = time.perf_counter()
            perceive(next(iter(scans.values())))
            result["first_call_ms"] = 1e3 * (time.perf_counter() - began)
        result |= {"engines": active_engines(perceive), "scenarios": {}, "interrupted": False, "predictions": []}
        result["scans_mb"] = sum(scan.nbytes for scan in scans.values()) / 1e6
        connection.send(("ready", None))
        stopped = connection.recv() == "stop"
        for scenario in job.scenarios:
            if stopped:
                break
            watch = _Watch(connection, scenario)
            inputs = [scans[path] for path in scenario.scans]
            run: Callable[..., Timings] = partial(back_to_back, rate_hz=scenario.rate_hz)
            if job.loadgen is not None:
                run = partial(single_stream, folder=job.loadgen)
            with closing(Application(perceive)) if scenario.application else nullcontext(perceive) as called:
                timings = run(called, inputs, limits=scenario.limits, keep_going=watch, on_start=watch.start)
            result["scenarios"][scenario.name] = watch.record(timings)
            stopped = watch.stopped
        result |= {"interrupted": stopped, "rss_mb": rss_mb(), "peak_rss_mb": peak_rss_mb()}
        if not stopped:
            perceive.reset_mounting()  # as the reference, whose scans are its first
            found = [perceive(scans[path]) for path in job.predict]
            result["predictions"] = [Prediction(each.points, each.top_view, each.boxes) for each in found]
    result["warnings"] = list(dict.fromkeys(str(each.message) for each in caught))
    return result


def active_engines(perceive: Perceiver) -> list[dict[str, Any]]:
    """The active engines, one record per network."""
    names = ("sha256", "digest", "provider", "precision", "description", "options")
    return [
        {"name": session.card.name, "variant": session.card.precision, "version": session.card.version}
        | {name: getattr(session, name) for name in names}
        | {"golden_deviation": None if np.isnan(session.golden_deviation) else session.golden_deviation}
        for session in perceive.sessions
    ]


class _Watch:
    """Reports to the parent between calls, a few times a second, and asks whether to stop."""

    def __init__(self, connection: Any, scenario: Scenario) -> None:
        self.connection, self.scenario, self.stopped = connection, scenario, False
        self.rss: list[tuple[int, float]] = []
        self._n_sent = 0
        self._next_s = time.perf_counter() + TICK_S
        self.start()

    def start(self) -> None:
        """Begin with the first scan that counts."""
        self.rss.clear()
        self.energy = EnergyMeter()
        self.before = conditions()
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()

    def __call__(self, timings: Timings) -> bool:
        now = time.perf_counter()
        if now >= self._next_s:
            self._next_s = now + TICK_S
            self.energy.tick()
            if not self.rss or timings.n >= self.rss[-1][0] + self.scenario.limits.min_scans / MEMORY_SAMPLES:
                self.rss.append((timings.n, round(rss_mb(), 3)))
            self.connection.send(("tick", (self.scenario.name, timings.ms[self._n_sent :])))
            self._n_sent = len(timings.ms)
            self.stopped = self.stopped or (self.connection.poll() and self.connection.recv() == "stop")
        return not self.stopped

    def record(self, timings: Timings) -> dict[str, Any]:
        """The record of the scenario."""
        cpu_s, wall_s = time.process_time() - self._cpu_s, time.perf_counter() - self._wall_s
        self.energy.tick()
        self.rss.append((timings.n, round(rss_mb(), 3)))
        return {
            "rate_hz": self.scenario.rate_hz,
            "limits": asdict(self.scenario.limits),
            **json.loads(json.dumps(asdict(timings)), parse_float=lambda text: round(float(text), 6)),
            "wall_s": wall_s,
            "cpu_s": cpu_s,
            "rss_mb": [list(each) for each in self.rss],
            "energy_j": self.energy.joules or None,
            "before": self.before,
            "after": conditions(),
            "interrupted": self.stopped,
        }


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Ctrl-C: the first is kept in the list, the second raises, so that the first does not cut a message in two."""
    asked: list[int] = []

    def note(number: int, _: Any) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    old = signal.signal(signal.SIGINT, note)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, old)


def measure(jobs: Sequence[Job], on_tick: OnTick = lambda name, ms: None) -> list[dict[str, Any]]:
    """Run jobs concurrently, each in a fresh process; all start when all are ready. Ctrl-C asks for their results so
    far, a second one ends them. Call this from the main thread. Raises EdgepercError.
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
                pending: dict[Any, int] = {here: k for k, (_, here) in enumerate(workers) if k not in results}
                for ready in wait(list(pending), timeout=TICK_S):
                    k = pending[ready]
                    kind, content = receive(workers[k][1], workers[k][0])
                    if kind == "ready":
                        n_ready += 1
                        if n_ready == len(jobs):
                            for _, each in workers:
                                each.send("go")
                    elif kind == "tick":
                        on_tick(*content)
                    else:
                        results[k] = content
                if interrupts and not stop_by_s:
                    stop_by_s = time.perf_counter() + STOP_S
                    for each in pending:
                        with suppress(OSError):  # the process has just ended
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


def receive(connection: Any, process: Any) -> tuple[str, Any]:
    """The next message of a worker, or the error of one that ended."""
    try:
        kind, content = connection.recv()
    except EOFError as exc:
        process.join()
        raise WorkerError(
            f"a measuring process ended with exit code {process.exitcode} before it had a result; see its "
            "messages above, and check whether memory ran out"
        ) from exc
    if kind == "failed":
        name, message = content
        error = getattr(edgeperc.errors, name, EdgepercError)
        raise EdgepercError(message) if error is edgeperc.errors.MissingExtraError else error(message)
    return kind, content
