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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
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


class Worker:
    """A process that does items; what is common to those of this computer and those of Ray."""

    def __init__(self) -> None:
        self.numbers: deque[int] = deque()  # of the items that it has
        self.has_begun = False

    def send(self, number: int, item: Any) -> None:
        """Give it an item."""
        self.numbers.append(number)
        self.begin(pickle.dumps(item))

    def receive(self) -> tuple[int, Any] | None:
        """The number and the result of its first item; None: it has begun. Raises EOFError, OSError, EdgepercError."""
        answer = pickle.loads(self.answer())
        if self.has_begun:
            return self.numbers.popleft(), answer
        if answer is not None:
            raise EdgepercError(f"a worker process could not start: {answer}")
        self.has_begun = True
        return None

    @property
    def end(self) -> Any:
        """What `map_to_workers` waits for; None: it has nothing to do."""
        raise NotImplementedError

    def begin(self, item: bytes) -> None:
        """Let it do a pickled item after those that it has."""
        raise NotImplementedError

    def answer(self) -> bytes:
        """The next one, which is there. Raises EOFError or OSError if the process died."""
        raise NotImplementedError

    def died_of(self) -> Sequence[int]:
        """The numbers of the items of which it may have died."""
        raise NotImplementedError

    def stop(self) -> None:
        """End the process."""
        raise NotImplementedError


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
    return map_to_workers(partial(_Process, start), wait, items, workers or max(1, usable_cores() // n_threads))


def map_to_workers(
    start: Callable[[], Worker], wait_for: Callable[[list[Any]], Sequence[Any]], items: Sequence[Any], n: int
) -> Iterator[Any]:
    """Map items to results, in their order, in at most ``n`` worker processes.

    wait_for : from ends of workers to those with an answer, at least one.
    """
    n = min(n, len(items))
    pool: list[Worker] = []
    todo, results, deaths = deque(range(len(items))), {}, Counter[int]()
    due = 0
    try:
        while due < len(items):
            pool += [start() for _ in range(min(n, len(todo)) - len(pool))]
            for worker in sorted(pool, key=lambda each: len(each.numbers)):
                while todo and _takes(worker, pool, todo, deaths) and todo[0] - due < max(MOST_KEPT, n * AHEAD):
                    worker.send(todo[0], items[todo[0]])
                    todo.popleft()
            for end in wait_for([worker.end for worker in pool if worker.end is not None]):
                worker = next(each for each in pool if each.end == end)
                try:
                    answer = worker.receive()
                except (EOFError, OSError):
                    pool.remove(worker)
                    todo.extendleft(reversed(worker.numbers))
                    for number in worker.died_of():
                        deaths[number] += 1
                        if deaths[number] >= MOST_DEATHS:
                            todo.remove(number)
                            results[number] = Lost(DIED)
                    worker.stop()
                    continue
                if answer is not None:
                    results[answer[0]] = answer[1]
            while due in results:
                yield results.pop(due)
                due += 1
    finally:
        for worker in pool:
            worker.stop()


def _takes(worker: Worker, pool: Sequence[Worker], todo: Sequence[int], deaths: Mapping[int, int]) -> bool:
    """Whether a worker gets the next item. One of which a process died is done alone; no worker waits while another has
    two.
    """
    if not worker.has_begun or not worker.numbers:
        return worker.has_begun
    is_alone = any(deaths.get(number) for number in (todo[0], *worker.numbers))
    return len(worker.numbers) < AHEAD and not is_alone and len(todo) > sum(not each.numbers for each in pool)


class _Process(Worker):
    def __init__(self, start: bytes) -> None:
        super().__init__()
        context = multiprocessing.get_context("spawn")
        self._end, other = context.Pipe()
        self._process = context.Process(target=_work, args=(other, start), daemon=True)
        self._process.start()
        other.close()

    @property
    def end(self) -> Connection:
        return self._end

    def begin(self, item: bytes) -> None:
        with contextlib.suppress(OSError):  # of a process that died: the driver learns of it when it reads
            self._end.send_bytes(item)

    def answer(self) -> bytes:
        return self._end.recv_bytes()

    def died_of(self) -> Sequence[int]:
        """Its first item: what it did before was written into the pipe."""
        self._process.join(LAST_S)
        if not self.has_begun or not self.numbers:
            raise EdgepercError(f"a worker process ended before its work (exit code {self._process.exitcode})")
        return [self.numbers[0]]

    def stop(self) -> None:
        self._end.close()
        self._process.join(LAST_S if not self.numbers else 0.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


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
