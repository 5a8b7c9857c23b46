"""While kernels are compiled: who is told, and how rarely garbage is collected."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_collecting = threading.Lock()
_rarely: list[tuple[int, int, int]] = []  # the thresholds before, once for each `fewer_collections` that is active
RARE = 50_000  # objects; a collection takes 0.2 s once numba has built its tables

watchers: list[Callable[[], None]] = []
"""Called before a kernel is compiled, and when it was."""


def tell_watchers() -> None:
    """Call the `watchers`."""
    for watcher in tuple(watchers):
        watcher()


@contextmanager
def fewer_collections() -> Iterator[None]:
    """Let garbage be collected more rarely while kernels are compiled, which takes a seventh less time.

    Afterwards the thresholds are those from before. Where collection is off, it stays off.
    """
    with _collecting:
        _rarely.append(_rarely[0] if _rarely else gc.get_threshold())
        if len(_rarely) == 1 and 0 < _rarely[0][0] < RARE:
            gc.set_threshold(RARE, *_rarely[0][1:])
    try:
        yield
    finally:
        with _collecting:
            before = _rarely.pop()
            if not _rarely:
                gc.set_threshold(*before)
