"""This Python: its end, and processes that are started or forked from it."""

from __future__ import annotations

import atexit
import ctypes
import os
import sys
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

Thing = TypeVar("Thing")

LONGEST_CALL_S = 60.0  # that the end waits for

_with_threads: weakref.WeakSet[object] = weakref.WeakSet()


class _Calls:
    """Calls into a library of C++ that run now. A daemon thread that returns from one while the interpreter ends is
    unwound through its frames, which ends the process with SIGABRT.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._n, self.is_over = 0, False
        self._is_watched = False

    @contextmanager
    def one(self) -> Iterator[None]:
        """Surround a call into a library of C++, such as onnxruntime: the interpreter ends after it. Not nested.

        The main thread ends the interpreter itself, and signals may interrupt it here: it takes no lock, and no part.
        """
        if threading.current_thread() is threading.main_thread():
            yield
            return
        with self._changed:
            if not self._is_watched:
                self._is_watched = True
                atexit.register(self._end)
            is_late = self.is_over
            self._n += not is_late
        if is_late:
            threading.Event().wait()  # until the interpreter has ended, and this thread with it
        try:
            yield
        finally:
            with self._changed:
                self._n -= 1
                self._changed.notify_all()

    def forget(self) -> None:
        """In a forked process, whose other threads are gone."""
        self._changed, self._n = threading.Condition(), 0

    def _end(self) -> None:
        with self._changed:
            self.is_over = True
            self._changed.wait_for(lambda: self._n == 0, LONGEST_CALL_S)


_calls = _Calls()
native_call = _calls.one


def is_ending() -> bool:
    """Whether the interpreter ends, and no other thread than the main one returns from a `native_call`."""
    return _calls.is_over


def kept_in_forks(thing: Thing) -> Thing:
    """Return ``thing``, which is destroyed as usual in this process, and never in one that is forked from it.

    Its destructor would wait for threads that a fork does not copy.
    """
    _with_threads.add(thing)
    return thing


def _begin_child() -> None:
    _calls.forget()
    for thing in list(_with_threads):  # a reference that nobody gives back outlives the interpreter
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_child)


def interpreter() -> str | None:
    """The Python with which other processes are started; None where that is unknown.

    Where Python is embedded or frozen, `sys.executable` may be the application itself, which must not start again. Such
    an application can name another with `multiprocessing.set_executable`.
    """
    from multiprocessing import spawn  # takes 20 ms

    own, named = sys.executable or "", os.fsdecode(spawn.get_executable() or b"")
    others = [path for path in (own, named) if not (getattr(sys, "frozen", False) and path == own)]
    return next((path for path in others if Path(path).stem.startswith("python")), None)


def interpreter_flags() -> list[str]:
    """Flags with which another Python runs no more code at its start than this one did, and compiles the same bytecode.

    ``-I``, ``-s`` and ``-S`` keep out the user's packages, whose ``.pth`` files are code.
    """
    flags = sys.flags
    kept = ["-O"] * flags.optimize + ["-B"] * sys.dont_write_bytecode + ["-S"] * flags.no_site
    if flags.isolated:
        return [*kept, "-I"]
    is_safe = getattr(flags, "safe_path", False)  # since Python 3.11
    return [*kept, *["-E"] * flags.ignore_environment, *["-s"] * flags.no_user_site, *["-P"] * is_safe]
