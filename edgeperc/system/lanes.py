"""Threads: values of one scan that are computed once, on one lane or two, and calls that are given a time."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Generic, TypeVar

STAGES = ("check", "project", "infer", "decode", "refine", "cluster", "agree")

_Value = TypeVar("_Value")


class Stopwatch:
    """Sum of the wall time of each stage [ms] in the thread that made it; other threads take no time of the answer.

    ms : dict of str to float
    """

    def __init__(self) -> None:
        self.ms = dict.fromkeys(STAGES, 0.0)
        self._thread, self._last = threading.get_ident(), time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        if threading.get_ident() == self._thread:
            now = time.perf_counter()
            self.ms[stage] = self.ms.get(stage, 0.0) + 1e3 * (now - self._last)
            self._last = now


class Once(Generic[_Value]):
    """A value that is computed when it is first asked for; another thread that asks waits for it, or gets its error. Of
    an argument that is a `Once`, the function gets the value; the time counts for a stage of the stopwatch.
    """

    __slots__ = ("_arguments", "_error", "_function", "_is_known", "_lock", "_options", "_stage", "_value", "_watch")

    def __init__(
        self, function: Callable[..., _Value], *arguments: object, stage: str, watch: Stopwatch, **options: object
    ) -> None:
        self._function, self._arguments, self._options = function, arguments, options
        self._stage, self._watch = stage, watch
        self._lock = threading.Lock()
        self._is_known = False
        self._error: Exception | None = None
        self._value: Any = None

    def __call__(self) -> _Value:
        """The value."""
        error = self._finish()
        if error is not None:
            raise error
        return self._value

    def _finish(self) -> Exception | None:
        """Compute the value, unless it is known; the error where there is none."""
        if not self._is_known:
            with self._lock:
                self._compute()
            self._watch.lap(self._stage)
        return self._error

    def start(self) -> None:
        """Compute the value, unless it is known or another thread computes it."""
        if not self._is_known and self._lock.acquire(blocking=False):
            try:
                self._compute()
            finally:
                self._lock.release()
            self._watch.lap(self._stage)

    def _compute(self) -> None:
        if self._is_known:  # another thread had the lock
            return
        needed = (each for each in (*self._arguments, *self._options.values()) if isinstance(each, Once))
        # An error is not raised by each value that needs the one that failed: the traceback would have a hundred lines.
        self._error = next((error for each in needed if (error := each._finish()) is not None), None)
        if self._error is None:
            try:
                self._value = self._function(
                    *(_value_of(argument) for argument in self._arguments),
                    **{name: _value_of(option) for name, option in self._options.items()},
                )
            except Exception as exc:
                self._error = exc
        self._is_known = True


def _value_of(given: object) -> object:
    return given._value if isinstance(given, Once) else given


class Lanes:
    """The calling thread and, where ``n`` is 2, a second one: both compute the values of a scan.

    The second thread is reused: starting one per scan took 0.2 ms of the front view and 1.3 ms of a full turn. It
    starts with the first scan; a forked process has its own.
    """

    def __init__(self, n: int) -> None:
        self.n = min(n, 2)
        self._threads: dict[int, _Beside] = {}

    def run(self, first: Sequence[Once[Any]], second: Sequence[Once[Any]]) -> None:
        """Compute all values: each lane its own, in order, and the calling thread what is left of the second's.

        The second lane is done when this returns or raises, so buffers may be overwritten afterwards.
        """
        stopped = threading.Event()
        process = os.getpid()

        def compute(values: Sequence[Once[Any]]) -> None:
            for value in values:
                if stopped.is_set():
                    return
                value.start()

        beside = waiting = None
        try:
            if self.n == 2:
                try:
                    beside = self._threads.get(process) or self._threads.setdefault(process, _Beside())
                    waiting = beside.submit(compute, second)
                except RuntimeError:  # no thread can be started, as while the interpreter ends
                    self._threads.pop(process, None)  # it would compute them later, too
            compute(first)
            if waiting is None:
                compute(second)
        except BaseException:
            stopped.set()
            raise
        finally:
            if waiting is not None:
                waiting.result()
            if beside is not None:
                beside.give_back()
        for value in (*first, *second):
            value()


class _Beside:
    """A thread that shares no core with the one that gives it work, as long as it works.

    Linux wakes a thread on the core of the one that wakes it if the others seem taken, as idle ones of a virtual
    machine do. Of scans at 10 Hz, the median then took 22 ms, and 17 on cores of their own. So the caller gets every
    other core that it may use, and the thread the rest.
    """

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="edgeperc-lane")
        self._id = self._executor.submit(threading.get_native_id).result()
        self._cores: set[int] = set()  # of the caller
        self._lent: set[int] = set()  # those of them that it keeps while the thread works; none if all of them

    def submit(self, compute: Callable[[Sequence[Once[Any]]], None], values: Sequence[Once[Any]]) -> Future[None]:
        """Let the thread compute values; then `give_back`."""
        try:
            self._part(os.sched_getaffinity(0))
        except (AttributeError, OSError):  # not Linux; a sandbox may refuse it
            self._lent = set()
        return self._executor.submit(compute, values)

    def _part(self, cores: set[int]) -> None:
        if cores != self._cores:
            kept, others = {*sorted(cores)[::2]}, {*sorted(cores)[1::2]}
            self._cores, self._lent = cores, kept if others else set()
            if others:
                os.sched_setaffinity(self._id, others)
        if self._lent:
            os.sched_setaffinity(0, self._lent)

    def give_back(self) -> None:
        """Let the caller run on all of its cores again."""
        if self._lent:
            with suppress(OSError):
                os.sched_setaffinity(0, self._cores)


def returns(call: Callable[[], object], limit_s: float) -> bool:
    """Whether a call of a library, which may wait for others for ever, returns in time; else it is left behind.

    Signals act while it runs. What it raises is raised here.
    """
    errors: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as exc:
            errors.append(exc)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(limit_s)
    if errors:
        raise errors[0]
    return not thread.is_alive()
