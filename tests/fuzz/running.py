"""Run the cases of a kind: count outcomes, find slow cases and failures, survive a process that hangs or dies.

A case depends on the kind, the seed and its index alone, so that ``--seed S --case INDEX`` repeats it. Each job is a
process. It writes the case it works on to a small shared file, and its counts to a JSON file every second. If it dies
or a case exceeds the hard time limit, the case is a failure, and a new process goes on behind it.
"""

from __future__ import annotations

import json
import mmap
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from edgeperc.errors import EdgepercError
from edgeperc.system.atomic import write_atomic

HANG_FACTOR = 6.0  # a case that takes this many times the limit is stopped from outside
MAX_FAILURES = 200  # kept in a state file; all are counted
NOW = struct.Struct("<qd")  # index of the current case, -1 before the first; monotonic time at its start


class Failure(AssertionError):  # noqa: N818 - it is the name of an outcome
    """An answer is invalid, or a limit was exceeded."""


def check(condition: object, what: str) -> None:
    """Raise `Failure` unless the condition holds."""
    if not condition:
        raise Failure(what)


@dataclass
class Case:
    """One case: its random numbers, a folder of its own, and the files that describe it if it fails."""

    kind: str
    seed: int
    index: int
    folder: Path
    rng: np.random.Generator
    evidence: dict[str, bytes | Callable[[], bytes]] = field(default_factory=dict)
    died: list[str] = field(default_factory=list)
    """How processes ended that may die, such as the one that decodes a capture."""
    peak_mb: float = 0.0
    """Highest memory of another process that worked on the case."""

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def pick(self, values: Any) -> Any:
        return values[int(self.rng.integers(len(values)))]


def one_of(ways: list[Callable[[Case], str]], case: Case) -> str:
    """Go one of the ways; an error of the library with a short message is an answer."""
    way = case.pick(ways)
    try:
        return f"{way.__name__}: {way(case)}"
    except EdgepercError as exc:
        check(len(str(exc)) < 20_000, f"a message of {len(str(exc))} characters")
        return f"{way.__name__}: {type(exc).__name__}"


class Kind(Protocol):
    """What a module of this package provides: made once for a process, then run for each case."""

    name: str
    limit_s: float
    limit_mb: float

    def run(self, case: Case) -> str:
        """Run a case and name its outcome. Errors of edgeperc are outcomes too; other exceptions are failures."""


@dataclass
class State:
    """Counts of one job, or of all."""

    kind: str
    seed: int
    cases: int = 0
    next: int = 0
    seconds: float = 0.0
    outcomes: Counter[str] = field(default_factory=Counter)
    died: Counter[str] = field(default_factory=Counter)
    n_failures: int = 0
    failures: list[dict[str, Any]] = field(default_factory=list)
    slowest: dict[str, float] = field(default_factory=lambda: {"ms": 0.0, "case": -1})
    highest: dict[str, float] = field(default_factory=lambda: {"mb": 0.0, "case": -1})
    skip: list[int] = field(default_factory=list)

    def to_json(self) -> bytes:
        return (json.dumps(vars(self), indent=1, sort_keys=True) + "\n").encode()

    @classmethod
    def read(cls, path: Path) -> State:
        document = json.loads(path.read_text("utf-8"))
        state = cls(**document)
        state.outcomes, state.died = Counter(document["outcomes"]), Counter(document["died"])
        return state

    def fail(self, record: Mapping[str, Any]) -> None:
        self.n_failures += 1
        if len(self.failures) < MAX_FAILURES:
            self.failures.append(dict(record))


def reset_peak() -> None:
    """Let the peak of this process's memory begin anew (Linux)."""
    try:
        with open("/proc/self/clear_refs", "w") as file:  # noqa: PTH123 - a thousand times a second
            file.write("5")
    except OSError:
        pass


def peak_mb() -> float:
    status = Path("/proc/self/status")
    if status.exists():  # getrusage's peak is also that of the process which started this one, and cannot be reset
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) / 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def _waited_s() -> float:
    """Time that this process wanted a processor and had none [s] (Linux); a busy computer makes no case slow."""
    try:
        return int(os.pread(_schedstat(os.getpid()), 99, 0).split()[1]) / 1e9
    except OSError:
        return 0.0


@cache
def _schedstat(pid: int) -> int:
    """The open file, for it is read thousands of times a second."""
    return os.open(f"/proc/{pid}/schedstat", os.O_RDONLY)


def _highest_mb() -> float:
    """The peak of this process's memory, which never falls; a hundred times faster than `peak_mb`."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def attempt(kind: Kind, case: Case) -> tuple[str, dict[str, Any] | None, float, float]:
    """Run a case.

    Returns
    -------
    outcome : str
    failure : dict or None
    ms : float
        Time it took, without the time that the process waited for a processor.
    mb : float
        Highest resident memory; 0 if an earlier case of this process took as much.
    """
    highest = _highest_mb()
    start = time.perf_counter() - _waited_s()
    failure: dict[str, Any] | None = None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # numpy's warnings are of operations that edgeperc did not foresee.
            warnings.simplefilter("error", RuntimeWarning)
            outcome = kind.run(case)
    except EdgepercError as exc:
        outcome = type(exc).__name__
    except Exception as exc:
        outcome = "failure"
        frames = traceback.extract_tb(exc.__traceback__)
        failure = {
            "error": f"{type(exc).__name__}: {exc}"[:500],
            "where": " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(frames[-6:])),
            "traceback": traceback.format_exc()[-4000:],
        }
    seconds = time.perf_counter() - _waited_s() - start
    mb = max(_highest_mb() if _highest_mb() > highest else 0.0, case.peak_mb)
    if mb > kind.limit_mb:
        reset_peak()
    if failure is None and seconds > kind.limit_s:
        failure = {"error": f"took {seconds:.1f} s; the limit is {kind.limit_s:g} s", "where": "", "traceback": ""}
    if failure is None and mb > kind.limit_mb:
        failure = {"error": f"took {mb:.0f} MB; the limit is {kind.limit_mb:g} MB", "where": "", "traceback": ""}
    return outcome, failure, 1e3 * seconds, mb


def new_case(kind: str, seed: int, index: int, folder: Path) -> Case:
    return Case(kind, seed, index, folder, np.random.default_rng([seed, index]))


def keep(case: Case, failure: dict[str, Any], out: Path) -> dict[str, Any]:
    """Write what a failed case consists of."""
    record = {"kind": case.kind, "seed": case.seed, "case": case.index, **failure}
    folder = out / "failures" / f"{case.kind}-{case.seed}-{case.index}"
    folder.mkdir(parents=True, exist_ok=True)
    again = f"python -m tests.fuzz {case.kind} --seed {case.seed} --case {case.index}"
    (folder / "case.json").write_text(json.dumps({**record, "again": again}, indent=1) + "\n")
    for name, content in case.evidence.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content())
    return {name: value for name, value in record.items() if name != "traceback"}


def run_job(
    make: Callable[[], Kind],
    state: State,
    *,
    cases: int,
    jobs: int = 1,
    seconds: float = float("inf"),
    out: Path | None = None,
    file: Path | None = None,
    now: mmap.mmap | None = None,
) -> State:
    """Run the cases ``state.next``, ``state.next + jobs``, ... below ``cases``; the state goes to ``file`` at times."""
    kind, folder = make(), Path(tempfile.mkdtemp(prefix="edgeperc-fuzz-"))
    reset_peak()
    start = written = time.monotonic()
    before = state.seconds
    cwd = Path.cwd()
    try:
        while state.next < cases and time.monotonic() - start < seconds:
            index, state.next = state.next, state.next + jobs
            if index in state.skip:
                continue
            if now is not None:
                now[: NOW.size] = NOW.pack(index, time.monotonic())
            case = new_case(kind.name, state.seed, index, folder)
            outcome, failure, ms, mb = attempt(kind, case)
            state.cases += 1
            state.outcomes[outcome] += 1
            state.died.update(case.died)
            if ms > state.slowest["ms"]:
                state.slowest = {"ms": round(ms, 1), "case": index}
            if mb > state.highest["mb"]:
                state.highest = {"mb": round(mb, 1), "case": index}
            if failure is not None:
                state.fail(keep(case, failure, out) if out else {"case": index, **failure})
            for entry in folder.iterdir():
                shutil.rmtree(entry, ignore_errors=True) if entry.is_dir() else entry.unlink(missing_ok=True)
            if file is not None and time.monotonic() - written > 1.0:
                written = time.monotonic()
                state.seconds = round(before + written - start, 1)
                write_atomic(file, state.to_json())
    finally:
        os.chdir(cwd)
        shutil.rmtree(folder, ignore_errors=True)
        state.seconds = round(before + time.monotonic() - start, 1)
        if file is not None:
            write_atomic(file, state.to_json())
    return state


def supervise(
    command: list[str],
    kind: str,
    limit_s: float,
    *,
    seed: int,
    cases: int,
    jobs: int,
    seconds: float,
    out: Path,
    progress: Callable[[State], None],
) -> State:
    """Run the jobs as processes, start those again that die, and merge their states.

    ``command`` starts a job; the state's file, the shared file, the number of jobs and the seconds are appended.
    """
    out.mkdir(parents=True, exist_ok=True)
    workers: list[dict[str, Any]] = []
    end = time.monotonic() + seconds
    for job in range(jobs):
        file, shared = out / f"{kind}-{seed}-{job}of{jobs}.json", out / f"{kind}-{seed}-{job}of{jobs}.now"
        if not file.exists():
            write_atomic(file, State(kind, seed, next=job).to_json())
        shared.write_bytes(NOW.pack(-1, 0.0))
        workers.append({"file": file, "shared": shared, "process": None, "done": False})
    shown = time.monotonic()
    try:
        while not all(w["done"] for w in workers):
            for worker in workers:
                if not worker["done"]:
                    _tend(worker, command, limit_s, cases, jobs, end, kind, seed, out)
            time.sleep(0.1)
            if time.monotonic() - shown > 15.0:
                shown = time.monotonic()
                progress(summary_of([State.read(w["file"]) for w in workers]))
    finally:
        for worker in workers:
            if worker["process"] is not None and worker["process"].poll() is None:
                worker["process"].send_signal(signal.SIGINT)
                worker["process"].wait(10.0)
            worker["shared"].unlink(missing_ok=True)
    return summary_of([State.read(w["file"]) for w in workers])


def _tend(
    worker: dict[str, Any], command: list[str], limit_s: float, cases: int, jobs: int, end: float, kind: str, seed: int,
    out: Path
) -> None:  # fmt: skip
    process = worker["process"]
    left = end - time.monotonic()
    if process is None:
        if left <= 0.0 or State.read(worker["file"]).next >= cases:
            worker["done"] = True
            return
        worker["shared"].write_bytes(NOW.pack(-1, 0.0))
        arguments = ["--worker", str(worker["file"]), str(worker["shared"]), str(jobs), str(left)]
        worker["process"] = subprocess.Popen([*command, *arguments])
        return
    index, since = NOW.unpack(worker["shared"].read_bytes()[: NOW.size])
    hangs = index >= 0 and time.monotonic() - since > HANG_FACTOR * limit_s
    if hangs:
        process.kill()
        process.wait()
    elif process.poll() is None:
        return
    worker["process"] = None
    if process.returncode == 0:
        worker["done"] = time.monotonic() >= end
        return
    if index < 0:
        raise RuntimeError(f"the process of {kind} ended with {process.returncode} before its first case")
    state = State.read(worker["file"])
    how = "hangs" if hangs else f"the process died ({process.returncode})"
    case = new_case(kind, seed, index, out)
    state.fail(keep(case, {"error": how, "where": "", "traceback": ""}, out))
    state.skip.append(index)
    state.cases += 1
    state.outcomes["failure"] += 1
    write_atomic(worker["file"], state.to_json())


def summary_of(states: list[State]) -> State:
    """The counts of several jobs in one."""
    first = states[0]
    whole = State(first.kind, first.seed, next=min(s.next for s in states))
    for state in states:
        whole.cases += state.cases
        whole.seconds = max(whole.seconds, state.seconds)
        whole.outcomes += state.outcomes
        whole.died += state.died
        whole.n_failures += state.n_failures
        whole.failures += state.failures
        whole.slowest = max(whole.slowest, state.slowest, key=lambda s: s["ms"])
        whole.highest = max(whole.highest, state.highest, key=lambda s: s["mb"])
    return whole
