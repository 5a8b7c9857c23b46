"""What the machine code of a kernel depends on, as one digest.

numba compiles the bytecode of a function. It freezes the values of the globals that the function reads, whichever
module defines them, and the kernels that it calls. The digest covers all of these, and the versions of what compiles.
No file is read: an installation in an archive, without sources or with preserved dates is like any other, and the edit
of a comment changes nothing.
"""

from __future__ import annotations

import enum
import hashlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import version
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np

# Of numba, which the environment sets, for example NUMBA_BOUNDSCHECK.
SETTINGS = ("BOUNDSCHECK", "DEBUGINFO_DEFAULT", "LOOP_VECTORIZE", "OPT", "SLP_VECTORIZE", "USING_SVML")
VERSIONED = {*sys.stdlib_module_names, "llvmlite", "numba", "numpy"}
_WITHOUT_EFFECT = ("nopython", "no_cfunc_wrapper", "pipeline_class")  # on the machine code
_PLAIN = {bool, int, float, complex, str, bytes, type(None), type(...)}


class _Described(NamedTuple):
    """Digest of a function and the values that it reads; and the kernels that it calls."""

    digest: str
    called: tuple[Any, ...]


_described: dict[Any, _Described] = {}


@cache
def versions() -> str:
    """What compiles."""
    return f"{version('numba')} {version('llvmlite')} {np.__version__} {sys.version}"


def code_of(kernel: Any) -> bytes:
    """Digest of the code of a kernel, of those that it calls, and of the values that they read; 32 bytes."""
    return _digest(kernel, [], anew=False)


def stamp_of(kernel: Any, passes: Any = None, *, anew: bool = False) -> bytes:
    """Digest of all that the machine code of a kernel depends on, except types, processor and `settings`: 32 bytes, the
    same in every process. ``anew`` looks at the values as they are now, not when this was first asked.
    """
    return _digest(kernel, [versions(), "" if passes is None else repr(_fields(passes.__code__))], anew)


def _digest(kernel: Any, texts: list[str], anew: bool) -> bytes:
    kernels = [kernel]  # and those that are called, in the order in which they are met
    for each in kernels:
        digest, called = (
            _describe(each) if anew else _described.get(each) or _described.setdefault(each, _describe(each))
        )
        kernels.extend(other for other in called if other not in kernels)
        texts.append(f"{digest} {[kernels.index(other) for other in called]}")
    return hashlib.sha256("\n".join(texts).encode()).digest()


def called_by(kernel: Any) -> tuple[Any, ...]:
    """The kernels that a kernel calls itself; none are known of one that `stamp_of` refuses."""
    try:
        return _describe(kernel).called
    except TypeError:  # its cache reports it
        return ()


def settings() -> tuple[str, ...]:
    """The settings of numba that change the machine code of every kernel."""
    import numba.core.config

    config: Any = numba.core.config
    return tuple(f"{name}={getattr(config, name, None) or 0}" for name in SETTINGS)


def _describe(kernel: Any) -> _Described:
    function = getattr(kernel, "py_func", kernel)
    called: list[Any] = []
    values: list[tuple[str, object]] = []
    for name, value in _read_by(function.__code__, function):
        try:
            values.append((name, _value(value, function, called)))
        except TypeError as exc:
            raise TypeError(f"{function.__qualname__} reads {name}, {exc}") from None
    given = getattr(kernel, "targetoptions", {}).items()
    options = sorted((name, value) for name, value in given if value is not None and name not in _WITHOUT_EFFECT)
    defaults = function.__defaults__, function.__kwdefaults__
    text = repr((_fields(function.__code__), options, defaults, values)).encode("utf-8", "surrogatepass")
    return _Described(hashlib.sha256(text).hexdigest(), tuple(called))


def _read_by(code: CodeType, function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Globals, and variables of enclosing functions, that a function reads; names of its attributes count, too."""
    for name in code.co_names:
        if name in function.__globals__:
            yield name, function.__globals__[name]
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=False):
        yield name, cell.cell_contents
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _read_by(constant, function)


def _fields(code: CodeType) -> tuple[Any, ...]:
    """What a function does, wherever it is in its source."""
    constants = [_fields(each) if isinstance(each, CodeType) else _value(each) for each in code.co_consts]
    arguments = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    names = code.co_names, code.co_varnames, code.co_cellvars, code.co_freevars
    return arguments, names, code.co_code.hex(), getattr(code, "co_exceptiontable", b"").hex(), constants


def _value(value: Any, reader: FunctionType | None = None, called: list[Any] | None = None) -> Any:
    """A value as texts. A kernel joins those that are ``called``. Raises TypeError for what has no digest."""
    kind = type(value)
    if called is not None and hasattr(value, "py_func"):  # by numba, or of a library
        called.append(value)
        return len(called)
    return repr(value) if kind in _PLAIN else (kind.__module__, kind.__qualname__, _content(value, reader, called))


def _is_type_of_numba(kind: type) -> bool:
    return any((base.__module__, base.__name__) == ("numba.core.types.abstract", "Type") for base in kind.__mro__)


def _content(value: Any, reader: FunctionType | None, called: list[Any] | None) -> Any:
    def each_of(values: Iterable[Any]) -> list[Any]:
        return [_value(each, reader, called) for each in values]

    kind = type(value)
    if isinstance(value, ModuleType):  # whose attributes may be read
        if reader is None or value.__name__.partition(".")[0] in VERSIONED:
            return value.__name__
        return value.__name__, each_of((name, vars(value).get(name)) for name in reader.__code__.co_names)
    if isinstance(value, np.generic | np.ndarray) and not value.dtype.hasobject:
        layout = value.flags.c_contiguous, value.flags.f_contiguous, value.flags.writeable
        return str(value.dtype), value.shape, layout, hashlib.sha256(value.tobytes()).hexdigest()
    if isinstance(value, slice):  # a constant of code since Python 3.14
        return each_of((value.start, value.stop, value.step))
    if isinstance(value, tuple | list):
        return each_of(value)
    if isinstance(value, set | frozenset):
        return sorted(map(repr, each_of(value)))
    if isinstance(value, Mapping):
        return each_of(value.items())
    if isinstance(value, enum.EnumMeta):
        return each_of((name, member.value) for name, member in dict[str, Any](value.__members__).items())
    if isinstance(value, enum.Enum | np.dtype) or _is_type_of_numba(kind):
        return str(value)
    module = str(getattr(value, "__module__", None))
    is_called = isinstance(value, FunctionType) and module.partition(".")[0] not in VERSIONED
    if called is not None and is_called:
        called.append(value)
        return len(called)
    if not (name := getattr(value, "__qualname__", getattr(value, "__name__", None))):
        raise TypeError(f"a {type(value).__qualname__}, which has no digest")
    return module, name, getattr(value, "_fields", None)
