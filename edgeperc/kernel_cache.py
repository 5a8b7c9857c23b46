"""Compiled kernels on disk: checked before they are loaded, and never a reason for a start to fail.

numba keeps compiled functions as pickled machine code. Its own cache loads whatever the files hold, so a damaged file
raises an unrelated error or crashes the process. Here each file begins with a checksum. A damaged file is reported,
compiled again and replaced. The checksum protects against damage only. Against other users, a folder or file is used
only if it belongs to this user or to root and nobody else can write it.

Folders, in this order: ``NUMBA_CACHE_DIR``, if it is set; otherwise ``__pycache__`` beside the source, and ``kernels``
in `edgeperc.tuning.cache_folder`. If none can be written, every start compiles again, and a warning in the log says so.
"""

from __future__ import annotations

import gc
import hashlib
import inspect
import logging
import os
import pickle
import stat
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba
import numba.core.compiler
import numba.core.config
import numba.core.runtime
import numba.core.serialize
import numba.core.sigutils
import numpy as np

from .atomic import write_atomic
from .errors import SettingsError
from .tuning import cache_folder, unsafe_because

__all__ = ["KernelCache", "fewer_collections", "njit"]

logger = logging.getLogger(__name__)

_numba: Any = numba.core  # internals, which have no types
FORMAT = 2  # of the files
_DIGEST_BYTES = hashlib.sha256().digest_size
_reported: set[str] = set()
_collecting = threading.Lock()
_rarely: list[tuple[int, int, int]] = []  # the thresholds before, once for each `fewer_collections` that is active
RARE = 50_000  # objects; a collection takes 0.2 s once numba has built its tables


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit`, whose cache is a `KernelCache`.

    Parameters
    ----------
    **options
        As `numba.njit`. With ``cache=True`` the compiled function is kept on disk, unless it is defined inside another
        function and uses its variables.

    Returns
    -------
    callable
        The decorator.
    """

    kept = options.pop("cache", False)

    def decorate(function: Callable[..., Any]) -> Any:
        # Kernels are never called from C: without that wrapper, they compile faster.
        kernel = numba.njit(**{"no_cfunc_wrapper": True, "pipeline_class": _Compiler, **options})(function)
        if (
            kept and function.__closure__ is None and hasattr(kernel, "_cache")
        ):  # with NUMBA_DISABLE_JIT, the kernel is the function itself
            kernel._cache = KernelCache(function)
        return kernel

    return decorate


class _Compiler(numba.core.compiler.CompilerBase):
    """numba's passes without those for what kernels do not have, which take a twentieth of the time.

    These are closures and comprehensions, and arithmetic with whole arrays.
    """

    def define_pipelines(self) -> list[Any]:
        """What `numba.core.compiler.CompilerBase` asks for: the passes in their order."""
        passes = _numba.compiler.PassManager("kernel")
        for each, name in _numba.compiler.DefaultPassBuilder.define_nopython_pipeline(self.state).passes:
            if each.__name__ not in ("InlineClosureLikes", "NopythonRewrites"):
                passes.add_pass(each, name)
        passes.finalize()
        return [passes]


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


class KernelCache:
    """The compiled forms of one kernel on disk, in place of `numba.core.caching.FunctionCache`.

    One file holds the machine code for one signature, processor and version of Python. It begins with a SHA-256 of the
    rest and a stamp of the source file and the versions of numba, llvmlite and numpy. With another stamp it is compiled
    again and replaced.

    Parameters
    ----------
    function : callable
        The Python function.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        # In a frozen application there are no source files.
        self._source = Path(sys.executable if getattr(sys, "frozen", False) else inspect.getfile(function)).absolute()
        # Of the source that was imported; the file may change while the process runs.
        self._stamp = _stamp(str(self._source))
        self._enabled = True

    @property
    def cache_path(self) -> str | None:
        """The first folder that can be written, or holds this kernel already; None if there is none."""
        usable = [folder for folder in self._folders() if _unusable(folder) is None]
        kept = (folder for folder in usable if _can_be_written(folder) or self._is_in(folder))
        return next(map(str, kept), None)

    def is_missing(self) -> bool:
        """Whether no folder holds a compiled form of this source, for any types, and one of them can be written."""
        can_write = False
        for folder in self._folders() if self._enabled and self._stamp is not None else ():
            if _unusable(folder) is not None:
                continue
            if self._is_in(folder):
                return False
            can_write |= _can_be_written(folder)
        return can_write

    def _is_in(self, folder: Path) -> bool:
        """Whether a folder holds a compiled form of this source, for any types."""
        return any(_stamp_of(file) == self._stamp for file in folder.glob(f"{self._name}-*.kernel"))

    def enable(self) -> None:
        """Load and save from now on."""
        self._enabled = True

    def disable(self) -> None:
        """Neither load nor save from now on."""
        self._enabled = False

    def flush(self) -> None:
        """Nothing: files of another stamp are replaced when they are met."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load a compiled form.

        Parameters
        ----------
        sig : tuple of types, Signature or str
        target_context : BaseContext
            numba's description of the processor.

        Returns
        -------
        CompileResult or None
            None if there is none that can be used.
        """
        stamp = self._stamp
        if stamp is None or not self._enabled:
            return None
        # Machine code needs numba's memory allocator, but neither its compiler's tables of types and functions nor
        # scipy, which they import; if something is compiled, numba loads them. This saves 0.3 to 0.5 s a start.
        _numba.runtime.rtsys.initialize(target_context)
        name, known = self._key(sig, target_context.codegen())
        for folder in self._folders():
            file = folder / name
            try:
                if _unusable(folder) is None and (content := _read(file)) is not None and content[0] == stamp:
                    found, defined, payload = pickle.loads(content[1])
                    if found == known:
                        return _rebuilt(target_context, defined, *payload)
            except Exception as exc:  # what a file holds, or what cannot be read, never stops the start
                reason = f"{type(exc).__name__}: {exc}"
                _report("damaged", "the compiled kernel %s cannot be used and is compiled again: %s", file, reason)
        return None

    def save_overload(self, sig: Any, result: Any) -> None:
        """Save a compiled form in the first folder that takes it.

        Parameters
        ----------
        sig : tuple of types, Signature or str
        result : CompileResult
        """
        if not self._enabled or result.library.has_dynamic_globals:  # addresses in this process
            return
        stamp, reasons = self._stamp, []
        if stamp is None:
            reasons.append(f"{self._source} cannot be read")
        else:
            name, known = self._key(sig, result.codegen)
            module = result.library._get_module_for_linking()
            defined = [each.name for each in (*module.functions, *module.global_variables) if not each.is_declaration]
            rest = stamp + _numba.serialize.dumps((known, defined, result._reduce()))
            for folder in self._folders():
                try:
                    # mkdir's mode, lessened by the umask, is that of the last folder only.
                    folder.parent.mkdir(0o755, parents=True, exist_ok=True)
                    folder.mkdir(0o755, exist_ok=True)
                    reason = _unusable(folder)
                    if reason is None:
                        write_atomic(folder / name, hashlib.sha256(rest).digest() + rest, 0o644)
                        return
                except OSError as exc:
                    reason = exc.strerror or str(exc)
                reasons.append(f"{folder}: {reason}")
        _report(
            "not kept",
            "compiled kernels are not kept, and every start compiles them again (%s); set NUMBA_CACHE_DIR to a folder "
            "that exists and only you can write",
            "; ".join(reasons) or "there is no home folder",
        )

    def _key(self, sig: Any, codegen: Any) -> tuple[str, Any]:
        """The file's name for a signature; and the function's place in its source and the types that it is for."""
        function, tag = self._function, sys.implementation.cache_tag
        known = function.__code__.co_firstlineno, *_numba.sigutils.normalize_signature(sig)
        what = repr((function.__qualname__, *map(str, known[1:]), codegen.magic_tuple(), tag)).encode()
        return f"{self._name}-{hashlib.sha256(what).hexdigest()[:16]}.kernel", known

    @property
    def _name(self) -> str:
        """What the names of the files of this kernel begin with."""
        name = f"{self._source.stem}.{self._function.__qualname__}"
        return name.translate({ord("<"): None, ord(">"): None})[:80]

    def _folders(self) -> Iterator[Path]:
        """Where compiled forms may lie, best first."""
        place = f"{self._source.parent.name}-{hashlib.sha256(bytes(self._source.parent)).hexdigest()[:16]}"
        if _numba.config.CACHE_DIR:
            yield Path(_numba.config.CACHE_DIR).absolute() / place
            return
        if not getattr(sys, "frozen", False):
            yield self._source.parent / "__pycache__"
        try:
            yield cache_folder() / "kernels" / place
        except SettingsError:  # there is no home folder
            return


def _rebuilt(target_context: Any, defined: Iterable[str], library: tuple[str, str, Any], *rest: Any) -> Any:
    """A compiled form from what ``CompileResult._reduce`` gave, and the names that its module defines.

    Beside the machine code there is a module for kernels that call this one. It is parsed when such a kernel is
    compiled; at a start that would take as long as everything else here.
    """
    name, kind, content = library
    if kind != "object":
        return _numba.compiler.CompileResult._rebuild(target_context, library, *rest)
    code, for_callers = content
    target_context.codegen()._engine._defined_symbols.update(defined)
    result = _numba.compiler.CompileResult._rebuild(target_context, (name, kind, (code, _empty_module())), *rest)
    loaded = result.library

    def parsed() -> Any:
        del loaded._get_module_for_linking
        loaded._shared_module = llvmlite.binding.parse_bitcode(for_callers)
        return loaded._shared_module

    loaded._get_module_for_linking = parsed
    return result


@cache
def _empty_module() -> bytes:
    return bytes(llvmlite.binding.parse_assembly("").as_bitcode())


def _read(file: Path) -> tuple[bytes, bytes] | None:
    """Stamp and content of a file; None if there is none. Raises ValueError or OSError."""
    try:
        with file.open("rb") as opened:
            reason = unsafe_because(os.fstat(opened.fileno()))
            content = opened.read()
    except (FileNotFoundError, NotADirectoryError):
        return None
    if reason is not None:
        raise ValueError(reason)
    digest, rest = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    if hashlib.sha256(rest).digest() != digest:
        raise ValueError(f"its {len(content)} bytes do not have the checksum that they were written with")
    return rest[:_DIGEST_BYTES], rest[_DIGEST_BYTES:]


def _stamp_of(file: Path) -> bytes:
    """The stamp of a file, which may be damaged; empty if it cannot be read."""
    try:
        with file.open("rb") as opened:
            return opened.read(2 * _DIGEST_BYTES)[_DIGEST_BYTES:]
    except OSError:
        return b""


def _can_be_written(folder: Path) -> bool:
    """Whether files can be put into a folder, which may not exist yet."""
    try:
        return os.access(next(each for each in (folder, *folder.parents) if each.exists()), os.W_OK)
    except OSError:
        return False


def _unusable(folder: Path) -> str | None:
    """Why a folder for kernels is not used: other users could write it, or replace it; None if it may be used."""
    for each in (folder, folder.parent):
        try:
            status = each.stat()
        except OSError:
            continue  # it does not exist, so it holds nothing
        reason = unsafe_because(status) if stat.S_ISDIR(status.st_mode) else "it is not a folder"
        if reason is not None:
            return reason if each == folder else f"in {each}, {reason}"
    return None


@cache
def _stamp(source: str) -> bytes | None:
    """Changes with the source file and everything else that the machine code depends on; None without a source."""
    try:
        text = Path(source).read_bytes()
    except OSError:
        return None
    versions = f"{FORMAT} {numba.__version__} {llvmlite.__version__} {np.__version__} {sys.version}"
    return hashlib.sha256(versions.encode() + b"\n" + text).digest()


def _report(kind: str, message: str, *values: object) -> None:
    """Log a warning the first time in this process; further ones of its kind are logged as information."""
    level = logging.INFO if kind in _reported else logging.WARNING
    _reported.add(kind)
    logger.log(level, message, *values)
