"""This Python, for processes that are started or forked from it."""

from __future__ import annotations

import ctypes
import os
import sys
import weakref
from typing import TypeVar

Thing = TypeVar("Thing")

_with_threads: weakref.WeakSet[object] = weakref.WeakSet()
_is_watched = False


def kept_in_forks(thing: Thing) -> Thing:
    """Return ``thing``, which is destroyed as usual in this process, and never in one that is forked from it.

    Its destructor would wait for threads that a fork does not copy.
    """
    global _is_watched
    _with_threads.add(thing)
    if not _is_watched and hasattr(os, "register_at_fork"):
        _is_watched = True
        os.register_at_fork(after_in_child=_keep)
    return thing


def _keep() -> None:
    for thing in list(_with_threads):  # a reference that nobody gives back outlives the interpreter
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))


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
