"""Threads: values of one scan that are computed once, on one lane or two, and calls that are given a time."""

from __future__ import annotations

import heapq
import os
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

from ..errors import EdgepercError
from .interpreter import is_ending

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


class Calls:
    """The calls of ``what``, of which one at a time may use its buffers."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._locks: dict[int, threading.RLock] = {}
        self._process: int | None = None  # that of the call at work

    @contextmanager
    def one(self) -> Iterator[None]:
        """Wait for the calls of other threads. EdgepercError inside of another one of this thread, which would be
        waited for for ever.
        """
        process = os.getpid()  # after a fork, the thread that held the parent's lock may be missing
        with self._locks.setdefault(process, threading.RLock()):
            if self._process == process:
                raise EdgepercError(
                    f"{self._what} was called again inside of its own call, as by a signal handler or a finalizer; "
                    "let these set a flag or fill a queue, and call it afterwards, or give them one of their own"
                )
            self._process = process
            try:
                yield
            finally:
                self._process = None


class Once(Generic[_Value]):
    """A value that `Lanes` compute once, after the values that it needs: of an argument that is a `Once`, the function
    gets the value. The time counts for a stage of the stopwatch. Calling it gives the value.
    """

    __slots__ = ("_arguments", "_function", "_options", "_value", "_watch", "needed", "stage")

    def __init__(
        self, function: Callable[..., _Value], *arguments: object, stage: str, watch: Stopwatch, **options: object
    ) -> None:
        self._function, self._arguments, self._options = function, arguments, options
        self.stage, self._watch = stage, watch
        self.needed = [each for each in (*arguments, *options.values()) if isinstance(each, Once)]
        self._value: Any = None

    def __call__(self) -> _Value:
        return self._value

    def compute(self) -> None:
        """Compute the value from those that it needs."""
        self._value = self._function(
            *(_value_of(argument) for argument in self._arguments),
            **{name: _value_of(option) for name, option in self._options.items()},
        )
        self._watch.lap(self.stage)


def _value_of(given: object) -> object:
    return given._value if isinstance(given, Once) else given


class Values(list[Once[Any]]):
    """The values of a scan: each after those that it needs, and before those that are less urgent."""

    def __init__(self, watch: Stopwatch) -> None:
        super().__init__()
        self.watch = watch

    def __call__(self, stage: str, function: Callable[..., Any], *arguments: object, **options: object) -> Once[Any]:
        """One more value, which counts for a stage of the stopwatch."""
        self.append(Once(function, *arguments, stage=stage, watch=self.watch, **options))
        return self[-1]


class Lanes:
    """The calling thread and, where ``n`` is 2, a second one: both compute the values of a scan.

    The second thread is reused: starting one per scan took 0.2 ms of the front view and 1.3 ms of a full turn. It
    starts with the first scan; a forked process has its own.
    """

    def __init__(self, n: int) -> None:
        self.n = min(n, 2)
        self._threads: dict[int, _Beside] = {}

    def run(self, values: Values) -> None:
        """Compute all values, each after those that it needs, which stand before it; after an error no other one.

        Two lanes take the first one that is ready whenever they have finished one, so what takes long stands first.
        The second lane is done when this returns or raises, so buffers may be overwritten afterwards.
        """
        schedule, beside = _Schedule(values), None
        interrupt: BaseException | None = None  # of a signal, which comes to the caller alone
        try:
            if self.n == 2 and (beside := self._beside()) is not None:
                beside.submit(schedule)
            schedule.compute(values.watch)
        finally:
            while beside is not None:
                try:
                    beside.end(schedule)
                    beside = None
                except BaseException as exc:
                    interrupt = exc
            if interrupt is not None:
                raise interrupt
        schedule.tell()

    def _beside(self) -> _Beside | None:
        """The second thread of this process; None if it cannot be started, or while the interpreter ends."""
        if is_ending():
            return None
        process = os.getpid()
        try:
            return self._threads.get(process) or self._threads.setdefault(process, _Beside())
        except RuntimeError:
            return None


class _Schedule:
    """Which of some values is next, for threads that compute them together.

    A signal may interrupt the caller anywhere. One that comes while it enters a `Condition`, a method of Python, leaves
    that locked for ever; one that comes while it enters the lock itself does not.
    """

    def __init__(self, values: Sequence[Once[Any]]) -> None:
        self._values, self._left, self._last = values, len(values), ""
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._error: BaseException | None = None  # of the second thread
        self.is_left = False  # by the second thread
        places = {value: place for place, value in enumerate(values)}
        self._users: list[list[int]] = [[] for _ in values]
        for place, value in enumerate(values):
            for each in value.needed:
                self._users[places[each]].append(place)
        self._missing = [len(value.needed) for value in values]
        self._ready = [place for place, missing in enumerate(self._missing) if missing == 0]  # a heap

    def compute(self, watch: Stopwatch | None = None) -> None:
        """Compute values until none is left; the time without one that is ready counts for what is waited for."""
        place = self._next(watch)
        while place is not None:
            try:
                self._values[place].compute()
            except BaseException as exc:
                self.stop()
                if isinstance(exc, SystemError) and exc.__cause__ is not None:
                    raise _first_cause(exc) from None
                raise
            with self._lock:
                for user in self._users[place]:
                    self._missing[user] -= 1
                    if self._missing[user] == 0:
                        heapq.heappush(self._ready, user)
                self._left -= 1
                self._last = self._values[place].stage
                self._changed.notify()
            place = self._next(watch)

    def compute_beside(self) -> None:
        """The same in the second thread; `tell` raises its error."""
        try:
            self.compute()
        except BaseException as exc:
            self._error = exc
        self.is_left = True

    def tell(self) -> None:
        """Raise the error of the second thread, if it had one."""
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _next(self, watch: Stopwatch | None) -> int | None:
        with self._lock:
            while self._left > 0 and not self._ready:
                self._changed.wait()
                if watch is not None:
                    watch.lap(self._last)
            return heapq.heappop(self._ready) if self._left > 0 else None

    def stop(self) -> None:
        """No thread computes another value."""
        with self._lock:
            self._left = 0
            self._changed.notify_all()


def _first_cause(error: BaseException) -> BaseException:
    """What a signal's handler raised while numba made objects of Python from what a kernel returns: it then raises
    SystemError from that.
    """
    while error.__cause__ is not None:
        error = error.__cause__
    return error


class _Beside:
    """A thread that shares no core with the one that gives it work, as long as it works.

    Linux wakes a thread on the core of the one that wakes it if the others seem taken, as idle ones of a virtual
    machine do. Of scans at 10 Hz, the median then took 22 ms, and 17 on cores of their own. So the caller gets every
    other core that it may use, and the thread the rest.
    """

    def __init__(self) -> None:
        # Not an executor: a signal to the caller within its locks, which are conditions, would block the thread.
        self._tasks = SimpleQueue[Callable[[], None] | None]()
        thread = threading.Thread(target=_work, args=(self._tasks,), name="edgeperc-lane", daemon=True)
        thread.start()
        assert thread.native_id is not None
        self._id = thread.native_id
        self._cores: set[int] = set()  # of the caller
        self._lent: set[int] = set()  # those of them that it keeps while the thread works; none if all of them
        weakref.finalize(self, self._tasks.put, None).atexit = False

    def submit(self, schedule: _Schedule) -> None:
        """Let the thread compute, too; then `end`, also if this was interrupted."""
        try:
            self._part(os.sched_getaffinity(0))
        except (AttributeError, OSError):  # not Linux; a sandbox may refuse it
            self._lent = set()
        self._tasks.put(schedule.compute_beside)

    def end(self, schedule: _Schedule) -> None:
        """Wait until the thread has left the schedule, and run on all cores again. Again, if it was interrupted."""
        schedule.stop()
        if not schedule.is_left:
            reached = threading.Lock()
            reached.acquire()
            self._tasks.put(reached.release)
            with reached:
                pass
        if self._lent:
            with suppress(OSError):
                os.sched_setaffinity(0, self._cores)

    def _part(self, cores: set[int]) -> None:
        if cores != self._cores:
            kept, others = {*sorted(cores)[::2]}, {*sorted(cores)[1::2]}
            self._cores, self._lent = cores, kept if others else set()
            if others:
                os.sched_setaffinity(self._id, others)
        if self._lent:
            os.sched_setaffinity(0, self._lent)


def _work(tasks: SimpleQueue[Callable[[], None] | None]) -> None:
    """Do tasks until there is a None; the last one is not kept, nor its scan."""
    for task in iter(tasks.get, None):
        task()
        del task


def returns(call: Callable[[], object], limit_s: float, failure: str = "") -> bool:
    """Whether a call of a library, which may wait for others for ever, returns in time; else it is left behind, and a
    warning says so, if there are words for the ``failure``. Signals act while it runs. What it raises is raised here.
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
    if failure and thread.is_alive():
        warnings.warn(f"{failure} within {limit_s:.0f} s and was left behind", RuntimeWarning, stacklevel=3)
    return not thread.is_alive()
