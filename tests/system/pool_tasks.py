"""What processes of a pool make: apart from the tests, because they would import those, too."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable


def scaled(factor: int, deadly: tuple[int, ...] = ()) -> Callable[[int], int]:
    """What processes make: items times a factor; of some items a process dies, and 7 and 11 cannot be scaled."""

    def function(item: int) -> int:
        if item in deadly:
            os._exit(3)
        if item == 7:
            raise ValueError("seven")
        if item == 11:
            raise OSError(errno.ENOSPC, "disk full")
        return factor * item

    return function


def slowest_first(seconds: float) -> Callable[[int], tuple[int, float]]:
    def function(item: int) -> tuple[int, float]:
        time.sleep(seconds if item == 0 else 0.0)
        return item, time.monotonic()

    return function


def without_pickle() -> Callable[[int], object]:
    return lambda item: (lambda: item) if item == 1 else item


def failing() -> Callable[[int], int]:
    raise ValueError("no such model")


def dying() -> Callable[[int], int]:
    os._exit(4)
