"""Kernels: compiled when the package was built, or by numba when they are first called.

A wheel may carry a library of compiled kernels (`.ci/kernels`), one for each level of the processor's instructions.
Then nothing is compiled on the user's computer and numba is not needed. A kernel of the library is used as long as its
code is what was compiled, for arguments of the types that were compiled; a wrong type would be read as another one, or
past its end. For everything else there is numba. A source checkout has no library.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, partial, update_wrapper
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from .extras import require

logger = logging.getLogger(__name__)

FOLDER = Path(__file__).parent / "compiled"
SETTING = "EDGEPERC_KERNELS"
"""Environment variable: ``jit`` leaves a library unused."""

# Instructions of numpy's names, best first; https://gitlab.com/x86-psABIs/x86-64-ABI.
LEVELS: Mapping[str, tuple[str, ...]] = {
    "x86_64_v3": ("AVX", "AVX2", "FMA3", "F16C"),
    "x86_64_v2": ("SSE42", "SSSE3", "POPCNT"),
    "aarch64": ("NEON", "ASIMD"),
}
ALIGNED, WRITEABLE, BY_ROWS, BY_COLUMNS = 0x100, 0x400, 0x1, 0x2  # of ndarray.flags.num


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit`: the decorator of every kernel; options as there."""
    library = _library()
    if library is None:
        require("numba", "jit", "edgeperc, without compiled kernels for this Python and processor,")
        from .kernel_cache import njit as jit

        return jit(**options)
    return partial(Kernel, library, options)


def kind_of(value: object) -> object:
    """What the machine code of a kernel depends on: types, and of arrays dimensions, layout and whether it may write.

    Returns (hashable): Equal for values that one compiled form takes.
    """
    kind = type(value)
    if kind is np.ndarray:
        assert isinstance(value, np.ndarray)
        flags = value.flags.num
        order = BY_ROWS if flags & BY_ROWS else flags & BY_COLUMNS
        return value.dtype, value.ndim, order | flags & (ALIGNED | WRITEABLE)
    if isinstance(value, tuple):
        return kind, tuple(map(kind_of, value))
    return (kind, value.dtype) if isinstance(value, np.void) else kind


def is_ahead() -> bool:
    """Whether kernels were compiled when the package was built."""
    return _library() is not None


class Kernel:
    """A kernel in a library, with what the package uses of numba's dispatchers."""

    __name__: str
    __qualname__: str
    __module__: str

    def __init__(self, library: Library, options: Mapping[str, Any], function: Callable[..., Any]) -> None:
        self.py_func, self.options = function, options
        self.targetoptions = {name: value for name, value in options.items() if name != "cache"}
        update_wrapper(self, function)
        self.library = library
        self._functions: dict[object, Callable[..., Any]] | None = None
        self.by_numba: Any = None  # once it was needed

    def __call__(self, *args: Any) -> Any:
        """Call the compiled form for these types."""
        functions = self._functions
        if functions is None:
            functions = self._functions = self.library.functions_of(self)
        form: Callable[..., Any] = functions.get(tuple(map(kind_of, args)), self._compile)
        return form(*args)

    def __reduce__(self) -> Any:
        return getattr, (import_module(self.__module__), self.__name__)

    @property
    def dispatcher(self) -> Any:
        """The same kernel by numba, for types that the library does not have."""
        if self.by_numba is None:
            why = "with arguments of unusual types" if self._functions else "whose code was not compiled"
            require("numba", "jit", f"{self.__module__}.{self.__name__}, {why},")
            from .kernel_cache import njit as jit

            _teach_numba()
            self.by_numba = jit(**self.options)(self.py_func)
        return self.by_numba

    def _compile(self, *args: Any) -> Any:
        logger.info("%s.%s has no compiled form for %s", self.__module__, self.__name__, [*map(kind_of, args)])
        return self.dispatcher(*args)


class Library:
    """A library of compiled kernels and its index: digests of each one's code, and its functions by types."""

    def __init__(self, module: Any, index: Mapping[str, Any]) -> None:
        self._module, self._index = module, index

    def functions_of(self, kernel: Kernel) -> dict[object, Callable[..., Any]]:
        """The compiled forms of a kernel by the kinds of their arguments; none if its code was edited."""
        from .kernel_stamp import code_of

        entry = self._index.get(f"{kernel.__module__}.{kernel.__name__}")
        if entry is None or code_of(kernel).hex() not in entry["codes"]:
            return {}
        return {tuple(map(read_kind, kinds)): getattr(self._module, name) for name, kinds in entry["forms"].items()}


def written(kind: Any) -> Any:
    """What `kind_of` gives, for JSON."""
    if isinstance(kind, type):
        return f"{kind.__module__}.{kind.__qualname__}"
    first, *rest = kind
    if isinstance(first, np.dtype):
        return ["array", _written_dtype(first), *rest]
    (last,) = rest
    if isinstance(last, np.dtype):
        return ["record", _written_dtype(last)]
    return ["tuple", written(first), *map(written, last)]


def _written_dtype(dtype: np.dtype[Any]) -> Any:
    if dtype.subdtype is not None:
        return [_written_dtype(dtype.subdtype[0]), dtype.shape]
    if dtype.names is None:
        return dtype.str
    fields = [dtype.fields[name] for name in dtype.names] if dtype.fields else []
    formats, offsets = [_written_dtype(field[0]) for field in fields], [field[1] for field in fields]
    layout = {"names": [*dtype.names], "formats": formats, "offsets": offsets, "itemsize": dtype.itemsize}
    return layout | {"aligned": dtype.isalignedstruct}


def _read_dtype(document: Any) -> np.dtype[Any]:
    if isinstance(document, list):
        base, shape = document
        document = _read_dtype(base), tuple(shape)
    elif isinstance(document, dict):
        document = {**document, "formats": [*map(_read_dtype, document["formats"])]}
    dtype: Any = np.dtype
    return dtype(document)


def read_kind(document: Any) -> Any:
    """What `written` wrote."""
    if isinstance(document, str):
        module, _, name = document.rpartition(".")
        return type(None) if name == "NoneType" else getattr(import_module(module), name)
    what, first, *rest = document
    if what == "tuple":
        return read_kind(first), tuple(map(read_kind, rest))
    dtype = _read_dtype(first)
    return (dtype, *rest) if what == "array" else (np.void, dtype)


@cache
def _library() -> Library | None:
    """The library for this processor and Python; None if there is none."""
    if os.environ.get(SETTING) == "jit" or not FOLDER.is_dir():
        return None
    features: Mapping[str, bool] = {}
    for umath in ("numpy._core._multiarray_umath", "numpy.core._multiarray_umath"):  # of numpy 2 and 1
        with suppress(ImportError):
            features = import_module(umath).__cpu_features__
            break
    for level, needed in LEVELS.items():
        if all(features.get(name, False) for name in needed):
            try:
                module = import_module(f".compiled.kernels_{level}", __package__)
                return Library(module, json.loads((FOLDER / f"kernels_{level}.json").read_text("utf-8")))
            except (ImportError, OSError, ValueError) as exc:
                logger.info("no compiled kernels for %s: %s", level, exc)
    return None


@cache
def _teach_numba() -> None:
    """A kernel that numba compiles may call kernels of the library; it compiles these, too."""
    from numba.core.typing.typeof import typeof_impl

    @typeof_impl.register(Kernel)
    def _(kernel: Kernel, _: Any) -> Any:
        return kernel.dispatcher._numba_type_
