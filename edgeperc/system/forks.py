"""What a forked process must not destroy: the destructor would wait for threads that a fork does not copy."""

from __future__ import annotations

import ctypes
import os
import weakref
from typing import TypeVar

Thing = TypeVar("Thing")

_with_threads: weakref.WeakSet[object] = weakref.WeakSet()
_is_watched = False


def kept_in_forks(thing: Thing) -> Thing:
    """Return ``thing``, which is destroyed as usual in this process, and never in one that is forked from it."""
    global _is_watched
    _with_threads.add(thing)
    if not _is_watched and hasattr(os, "register_at_fork"):
        _is_watched = True
        os.register_at_fork(after_in_child=_keep)
    return thing


def _keep() -> None:
    for thing in list(_with_threads):  # a reference that nobody gives back outlives the interpreter
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))
