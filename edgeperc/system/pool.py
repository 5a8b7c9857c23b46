"""Map items to results in worker processes: of this computer, or of a Ray cluster."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from queue import SimpleQueue
from typing import Any

from ..errors import EdgepercError
from .machine import usable_cores

MOST_FIRST = 20
"""Scans that the driver perceives at most, until its perceiver has learned what workers start from. Usually five are
enough; a scan that shows no ground does not count."""

MOST_DEATHS = 2
"""How often the process of an item may die, before the item is given up."""

DIED = f"its worker process died {MOST_DEATHS} times, perhaps for lack of memory"
# Items that a process has: one is worked on, the next one waits, so that a process does not wait for its driver.
AHEAD = 2
# Items that are begun before an earlier one is done: the driver keeps so many results, whatever the number of items.
MOST_KEPT = 64
LAST_S = 5.0  # for a process to end by itself


@dataclass(frozen=True)
class Lost:
    """In place of a result."""

    reason: str  # what an exception says, with its traceback if nobody expected it; or that the worker process died
    error: EdgepercError | OSError | None = None  # the exception, if it was expected


def taken(answer: Any, what: str) -> Any:
    """A result; of one that is lost its error, or one about ``what``."""
    if not isinstance(answer, Lost):
        return answer
    raise answer.error or EdgepercError(f"{what} was not evaluated: {answer.reason}")


def attempt(function: Callable[[Any], Any], item: bytes) -> bytes:
    """The pickled result, or `Lost`, of a pickled item."""
    try:
        return pickle.dumps(function(pickle.loads(item)))
    except (EdgepercError, OSError) as exc:
        return pickle.dumps(Lost(str(exc), exc))
    except Exception:
        return pickle.dumps(Lost(traceback.format_exc()))


def map_in_processes(
    make: Callable[..., Callable[[Any], Any]],
    arguments: tuple[Any, ...],
    items: Sequence[Any],
    *,
    workers: int | None = None,
    n_threads: int = 1,
) -> Iterator[Any]:
    """Map items to results, in their order, in processes of this computer, which share nothing.

    Processes are spawned: a fork of a process that runs onnxruntime may hang. They end when this one does. `Lost`
    stands for a result if the function raised an exception, or if its process died twice; other items of a process that
    dies are done in the next one.

    make : called with ``arguments`` once in each process; returns a function from an item to its result.
    workers : number of processes; None: the number of usable cores divided by ``n_threads``.
    """
    start = pickle.dumps((make, arguments))
    n = min(workers or max(1, usable_cores() // n_threads), len(items))
    pool: list[_Process] = []
    todo, results, deaths = deque(range(len(items))), {}, Counter[int]()
    due = 0
    try:
        while due < len(items):
            pool += [_Process.start(start) for _ in range(min(n, len(todo)) - len(pool))]
            for process in sorted(pool, key=lambda each: len(each.numbers)):
                while todo and len(process.numbers) < AHEAD and todo[0] - due < max(MOST_KEPT, n * AHEAD):
                    process.send(todo[0], items[todo[0]])
                    todo.popleft()
            for end in wait([process.end for process in pool]):
                process = next(each for each in pool if each.end is end)
                try:
                    answer = process.receive()
                except (EOFError, OSError):
                    pool.remove(process)
                    todo.extendleft(reversed(process.numbers))
                    if process.died_of(deaths) >= MOST_DEATHS:
                        results[todo.popleft()] = Lost(DIED)
                    continue
                if answer is not None:
                    results[answer[0]] = answer[1]
            while due in results:
                yield results.pop(due)
                due += 1
    finally:
        for process in pool:
            process.stop()


@dataclass(eq=False)
class _Process:
    """A worker process, and the items that it has."""

    process: Any
    end: Connection
    numbers: deque[int] = field(default_factory=deque)
    has_begun: bool = False

    @classmethod
    def start(cls, start: bytes) -> _Process:
        context = multiprocessing.get_context("spawn")
        end, other = context.Pipe()
        process = context.Process(target=_work, args=(other, start), daemon=True)
        process.start()
        other.close()
        return cls(process, end)

    def send(self, number: int, item: Any) -> None:
        self.numbers.append(number)
        with contextlib.suppress(OSError):  # of a process that died: the driver learns of it when it reads
            self.end.send_bytes(pickle.dumps(item))

    def receive(self) -> tuple[int, Any] | None:
        """The number and the result of its first item; None: it has begun. Raises EOFError, OSError, EdgepercError."""
        answer = pickle.loads(self.end.recv_bytes())
        if self.has_begun:
            return self.numbers.popleft(), answer
        if answer is not None:
            raise EdgepercError(f"a worker process could not start: {answer}")
        self.has_begun = True
        return None

    def died_of(self, deaths: Counter[int]) -> int:
        """How often a process died of its first item, with this one. Raises EdgepercError."""
        self.process.join(LAST_S)
        ended = f"exit code {self.process.exitcode}"
        if not self.has_begun or not self.numbers:
            raise EdgepercError(f"a worker process ended before its work ({ended})")
        deaths[self.numbers[0]] += 1
        return deaths[self.numbers[0]]

    def stop(self) -> None:
        self.end.close()
        self.process.join(LAST_S if not self.numbers else 0.0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _work(end: Connection, start: bytes) -> None:
    """What a worker process does: results for items, until its driver closes the pipe or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver is interrupted too, and stops its processes
    items: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_take, args=(end, items), daemon=True).start()
    try:
        make, arguments = pickle.loads(start)
        function = make(*arguments)
    except Exception:
        end.send_bytes(pickle.dumps(traceback.format_exc()))
        return
    end.send_bytes(pickle.dumps(None))
    while True:
        end.send_bytes(attempt(function, items.get()))


def _take(end: Connection, items: SimpleQueue[bytes]) -> None:
    """Take items, so that no end waits for the other; without a driver, end at once: others may write its files."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            items.put(end.recv_bytes())
    os._exit(1)
