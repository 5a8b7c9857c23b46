"""Compiled kernels on disk: checked before they are loaded, and never a reason for a start to fail.

numba keeps compiled functions as pickled machine code. Its own cache loads whatever the files hold, so a damaged file
raises an unrelated error or crashes the process. Here each file begins with a checksum. A damaged file is reported,
compiled again and replaced. The checksum protects against damage only. Against other users, a folder or file is used
only if it belongs to this user or to root and nobody else can write it.

Folders, in this order: ``NUMBA_CACHE_DIR``, if it is set; otherwise ``__pycache__`` next to the source, and ``kernels``
in `machine.cache_folder`. If none can be written, every start compiles again, and a warning in the log says so.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
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

from ..errors import SettingsError
from .atomic import write_atomic
from .compiling import tell_watchers
from .kernel_stamp import settings, stamp_of
from .machine import cache_folder, make_folder, unsafe_because, unusable_because

logger = logging.getLogger(__name__)

_numba: Any = numba.core  # internals, which have no types
FORMAT = 3  # of the files
_DIGEST_BYTES = hashlib.sha256().digest_size
reported: set[str] = set()


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit`, whose cache is a `KernelCache`: with ``cache=True`` the compiled function is kept on disk, unless
    it is defined inside another function and uses its variables.
    """
    kept = options.pop("cache", False)

    def decorate(function: Callable[..., Any]) -> Any:
        # Kernels are never called from C: without that wrapper, they compile faster.
        kernel = numba.njit(**{"no_cfunc_wrapper": True, "pipeline_class": Compiler, **options})(function)
        is_compiled = hasattr(kernel, "_cache")  # with NUMBA_DISABLE_JIT, the kernel is the function itself
        if kept and function.__closure__ is None and is_compiled:
            kernel._cache = KernelCache(kernel)
        return kernel

    return decorate


class Compiler(numba.core.compiler.CompilerBase):
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


def missing(kernels: Iterable[Any]) -> list[Any]:
    """Those of some kernels that no folder and no memory holds in compiled form, for any types."""
    left = {kernel._cache.name: kernel for kernel in kernels if _is_cached(kernel) and not kernel.signatures}
    for folder in dict.fromkeys(folder for kernel in left.values() for folder in kernel._cache.folders()):
        held = _held(folder, left) if left and unusable_because(folder) is None else ()
        left = {name: kernel for name, kernel in left.items() if (name, kernel._cache.stamp()) not in held}
    return [*left.values()]


def are_kept(kernels: Iterable[Any]) -> bool:
    """Whether compiled kernels are put into a cache, from which the next start loads them."""
    caches = [kernel._cache for kernel in kernels if _is_cached(kernel)]
    return bool(caches) and any(_can_be_written(each) and not unusable_because(each) for each in caches[0].folders())


def _is_cached(kernel: Any) -> bool:
    return isinstance(getattr(kernel, "_cache", None), KernelCache)


class KernelCache:
    """The compiled forms of one kernel on disk, in place of `numba.core.caching.FunctionCache`.

    One file holds the machine code for one signature, processor, version of Python and setting of numba. It begins with
    a SHA-256 of the rest and a stamp of what the machine code depends on (`system.kernel_stamp`). With another stamp it
    is compiled again and replaced.
    """

    def __init__(self, kernel: Any) -> None:
        self._kernel, self._function = kernel, kernel.py_func
        # In a frozen application there are no source files.
        is_frozen = getattr(sys, "frozen", False)
        self._source = Path(sys.executable if is_frozen else self._function.__code__.co_filename).absolute()

    def stamp(self, *, anew: bool = False) -> bytes | None:
        """Changes with everything that the machine code depends on; None, after a report, if that is not known."""
        try:
            stamp = stamp_of(self._kernel, Compiler.define_pipelines, anew=anew)
        except Exception as exc:  # a value of a kind that is not known
            _report("unknown", "the compiled kernel %s is not kept: %s", self.name, exc)
            return None
        return hashlib.sha256(b"%d %s" % (FORMAT, stamp)).digest()

    @property
    def cache_path(self) -> str | None:
        """The first folder that can be written, or holds this kernel already; None if there is none."""
        return next((str(each) for each in self._usable() if _can_be_written(each) or self._is_in(each)), None)

    def is_missing(self) -> bool:
        """Whether no folder holds a compiled form of this kernel, for any types, and one of them can be written."""
        usable = self._usable() if self.stamp() is not None else []
        return any(map(_can_be_written, usable)) and not any(map(self._is_in, usable))

    def _usable(self) -> list[Path]:
        return [folder for folder in self.folders() if unusable_because(folder) is None]

    def _is_in(self, folder: Path) -> bool:
        """Whether a folder holds a compiled form of this kernel, for any types."""
        return (self.name, self.stamp()) in _held(folder, [self.name])

    def flush(self) -> None:
        """Nothing: files of another stamp are replaced when they are met."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load a compiled form; None if there is none that can be used."""
        result = self._load(sig, target_context)
        if result is None:
            tell_watchers()
        return result

    def _load(self, sig: Any, target_context: Any) -> Any:
        if (stamp := self.stamp()) is None:
            return None
        try:
            # Machine code needs numba's memory allocator, but neither its compiler's tables of types and functions nor
            # scipy, which they import; if something is compiled, numba loads them. This saves 0.3 to 0.5 s a start.
            _numba.runtime.rtsys.initialize(target_context)
            name, known = self._key(sig, target_context.codegen())
        except Exception as exc:  # another numba
            _report("unknown", "compiled kernels cannot be loaded with numba %s: %s", numba.__version__, _text(exc))
            return None
        for folder in self.folders():
            file = folder / name
            try:
                if unusable_because(folder) is None and (content := _read(file)) is not None and content[0] == stamp:
                    found, defined, payload = pickle.loads(content[1])
                    if found == known:
                        return _rebuilt(target_context, defined, *payload)
            except Exception as exc:  # what a file holds, or what cannot be read, never stops the start
                message = "the compiled kernel %s cannot be used and is compiled again: %s"
                _report("damaged", message, file, _text(exc))
        return None

    def save_overload(self, sig: Any, result: Any) -> None:
        """Save a compiled form in the first folder that takes it; where that fails, a warning in the log says why.

        sig : tuple of types, Signature or str
        """
        self._save(sig, result)
        tell_watchers()

    def _save(self, sig: Any, result: Any) -> None:
        if (stamp := self.stamp()) is None:
            return
        if self.stamp(anew=True) != stamp:
            _report("unknown", "the compiled kernel %s is not kept: a value that it reads was set anew", self.name)
            return
        try:
            if result.library.has_dynamic_globals:  # addresses in this process
                return
            name, known = self._key(sig, result.codegen)
            module = result.library._get_module_for_linking()
            defined = [each.name for each in (*module.functions, *module.global_variables) if not each.is_declaration]
            reason = self._write(name, stamp + _numba.serialize.dumps((known, defined, result._reduce())))
        except Exception as exc:  # another numba
            reason = f"numba {numba.__version__}: {_text(exc)}"
        if reason is not None:
            _report(
                "not kept",
                "compiled kernels are not kept, and every start compiles them again (%s); set NUMBA_CACHE_DIR to a "
                "folder that exists and only you can write",
                reason,
            )

    def _write(self, name: str, content: bytes) -> str | None:
        """Write a file into the first folder that takes it; the reasons if none does."""
        reasons = []
        for folder in self.folders():
            try:
                make_folder(folder)
                reason = unusable_because(folder)
                if reason is None:
                    write_atomic(folder / name, hashlib.sha256(content).digest() + content, 0o644)
                    return None
            except OSError as exc:
                reason = exc.strerror or str(exc)
            reasons.append(f"{folder}: {reason}")
        return "; ".join(reasons) or "there is no home folder"

    def _key(self, sig: Any, codegen: Any) -> tuple[str, Any]:
        """The file's name for a signature; and the types that it is for."""
        # Under -OO, the code has no docstrings, and another stamp.
        function, tag = self._function, f"{sys.implementation.cache_tag}.opt-{sys.flags.optimize}"
        known = _numba.sigutils.normalize_signature(sig)
        processor = codegen.magic_tuple()
        what = repr((function.__qualname__, *map(str, known), processor, tag, settings())).encode()
        return f"{self.name}-{hashlib.sha256(what).hexdigest()[:16]}.kernel", known

    @property
    def name(self) -> str:
        """What the names of the files of this kernel begin with."""
        name = f"{self._source.stem}.{self._function.__qualname__}"
        return name.translate({ord("<"): None, ord(">"): None})[:80]

    def folders(self) -> Iterator[Path]:
        """Where compiled forms may lie, best first."""
        place = f"{self._source.parent.name}-{hashlib.sha256(bytes(self._source.parent)).hexdigest()[:16]}"
        if _numba.config.CACHE_DIR:
            yield Path(_numba.config.CACHE_DIR).absolute() / place
            return
        if not getattr(sys, "frozen", False) and self._source.is_file():  # not in an archive
            yield self._source.parent / "__pycache__"
        try:
            yield cache_folder() / "kernels" / place
        except SettingsError:  # there is no home folder
            return


def _rebuilt(target_context: Any, defined: Iterable[str], library: tuple[str, str, Any], *rest: Any) -> Any:
    """A compiled form from what ``CompileResult._reduce`` gave, and the names that its module defines.

    In addition to the machine code there is a module for kernels that call this one. It is parsed when such a kernel is
    compiled; at a start that would take as long as everything else here.
    """
    name, kind, content = library
    if kind != "object":
        return _numba.compiler.CompileResult._rebuild(target_context, library, *rest)
    code, for_callers = content
    symbols = target_context.codegen()._engine._defined_symbols
    added = {*defined} - symbols
    symbols |= added
    try:
        result = _numba.compiler.CompileResult._rebuild(target_context, (name, kind, (code, _empty_module())), *rest)
    except BaseException:
        symbols -= added  # the kernel is compiled, and defines them
        raise
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


def _held(folder: Path, names: Collection[str]) -> set[tuple[str, bytes]]:
    """Names and stamps of some kernels in a folder, whose files may be damaged; none of what cannot be read."""
    found = set()
    with suppress(OSError):  # in the home of another user, not even whether there is a folder
        for file in [each for each in folder.iterdir() if each.suffix == ".kernel"]:
            if (name := file.name.rpartition("-")[0]) in names:
                with suppress(OSError), file.open("rb") as opened:
                    found.add((name, opened.read(2 * _DIGEST_BYTES)[_DIGEST_BYTES:]))
    return found


def _can_be_written(folder: Path) -> bool:
    """Whether files can be put into a folder, which may not exist yet."""
    try:
        return os.access(next(parent for parent in (folder, *folder.parents) if parent.exists()), os.W_OK)
    except OSError:
        return False


def _text(exc: Exception) -> str:
    return f"{type(exc).__name__}: {exc}"


def _report(kind: str, message: str, *values: object) -> None:
    """Log a warning the first time in this process; further ones of its kind are logged as information."""
    level = logging.INFO if kind in reported else logging.WARNING
    reported.add(kind)
    logger.log(level, message, *values)
