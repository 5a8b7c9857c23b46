"""A second thread for what need not be done one after the other."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

__all__ = ["SideThread", "returns"]

_Result = TypeVar("_Result")


class SideThread:
    """A thread that takes one function after the other.

    It is kept: to start one for each scan took 0.2 ms of the front and 1.3 ms of a full turn. It starts with the first
    function; a forked process has its own.
    """

    def __init__(self) -> None:
        self._threads: dict[int, ThreadPoolExecutor] = {}

    def __call__(self, function: Callable[[], _Result]) -> Callable[[], _Result]:
        """Call a function in the thread; what is returned waits for its result, or raises what it raised.

        Where no thread can be started, as while the interpreter ends, the function is called when its result is asked
        for.
        """
        process = os.getpid()
        if process not in self._threads:
            self._threads[process] = ThreadPoolExecutor(1, thread_name_prefix="edgeperc-network")
        try:
            return self._threads[process].submit(function).result
        except RuntimeError:
            del self._threads[process]  # it would call the function later, too
            return function

    def wait(self) -> None:
        """Wait until nothing is left to do in the thread."""
        if os.getpid() in self._threads:
            self(lambda: None)()


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
