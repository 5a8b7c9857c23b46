"""Work spread over processes."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

CONTEXT = "fork" if sys.platform == "linux" else "spawn"
"""How processes start. A forked process shares the scans; where forking is not safe, each process gets a copy."""


@contextmanager
def mapped(function: Callable[[Item], Result], items: Iterable[Item], n_workers: int) -> Iterator[Iterator[Result]]:
    """``map(function, items)`` in ``n_workers`` processes, in the order of the items; with 0 in this process. After an
    error or a signal, items that no process has taken are left.
    """
    if not n_workers:
        yield map(function, items)
        return
    with ProcessPoolExecutor(n_workers, multiprocessing.get_context(CONTEXT)) as pool:
        try:
            yield pool.map(function, items)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
