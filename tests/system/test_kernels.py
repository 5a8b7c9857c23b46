"""Kernels of a library that was built with the package; `make test-ahead` builds the package's own."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from checkout import REPOSITORY, printed
from edgeperc.errors import MissingExtraError
from edgeperc.ground import planes
from edgeperc.system import kernels
from edgeperc.system.kernel_stamp import code_of
from edgeperc.system.kernels import Kernel, Library, kind_of, njit, written
from edgeperc.tracking import zones


class Pair(NamedTuple):
    first: Any
    second: Any


class Twin(NamedTuple):
    first: Any
    second: Any


RECORD = np.dtype([("is_new", "?"), ("at", "f8", (2,)), ("n", "i4")], align=True)
SCALARS = (True, 3, 2.5, np.float32(1), np.float64(1), np.int32(2), np.int64(2), np.uint8(2), np.bool_(True), None)


@st.composite
def arrays(draw: st.DrawFn) -> NDArray[Any]:
    dtype = draw(st.sampled_from(["f4", "f8", ">f4", "i4", "i8", "u1", "?", RECORD, np.dtype([("n", "i4")])]))
    shape = draw(st.lists(st.integers(0, 3), min_size=1, max_size=3))
    array = np.zeros(shape, dtype)
    how = draw(st.sampled_from(["", "transposed", "every second", "read-only", "unaligned"]))
    if how == "transposed":
        array = array.T
    elif how == "every second":
        array = np.zeros([2 * shape[0], *shape[1:]], dtype)[::2]
    elif how == "read-only":
        array.setflags(write=False)
    elif how == "unaligned":
        size = array.dtype.itemsize * array.size
        array = np.zeros(size + 1, np.uint8)[1:].view(array.dtype).reshape(shape) if size else array
    return array


VALUES = st.recursive(
    st.one_of(arrays(), st.sampled_from(SCALARS)),
    lambda inner: st.one_of(st.builds(Pair, inner, inner), st.builds(Twin, inner, inner), st.tuples(inner)),
    max_leaves=3,
)


@given(VALUES, VALUES)
def test_values_of_one_kind_are_of_one_type(one: Any, other: Any) -> None:
    """What numba would compile apart is kept apart, so that no machine code reads another type than its own."""
    kinds = kind_of(one), kind_of(other)
    hash(kinds)
    if kinds[0] == kinds[1]:
        try:
            types = numba.typeof(one), numba.typeof(other)
        except (ValueError, numba.core.errors.NumbaError):  # such as numbers in the other byte order
            return
        assert types[0] == types[1]


@given(VALUES)
def test_kinds_are_read_as_they_were_written(value: Any) -> None:
    document = json.loads(json.dumps(written(kind_of(value))))
    assert kernels.read_kind(document) == kind_of(value)


class FakeModule:
    """An extension module whose functions say that they were called."""

    def __init__(self) -> None:
        self.called: list[tuple[Any, ...]] = []

    def f0(self, *args: Any) -> str:
        self.called.append(args)
        return "compiled"


def total(values: NDArray[np.float32], factor: float) -> float:
    result = 0.0
    for k in range(values.shape[0]):
        result += values[k] * factor
    return result


def library_of(function: Callable[..., Any], *args: Any) -> tuple[Kernel, FakeModule]:
    module, form = FakeModule(), [written(kind_of(value)) for value in args]
    code = code_of(njit(nogil=True)(function)).hex()
    index = {f"{function.__module__}.{function.__name__}": {"codes": [code], "forms": {"f0": form}}}
    return Kernel(Library(module, index), {"nogil": True}, function), module


def test_a_compiled_form_is_called_for_its_types_only() -> None:
    values = np.arange(4, dtype=np.float32)
    kernel, module = library_of(total, values, 2.0)
    assert kernel(values, 3.0) == "compiled"
    assert len(module.called) == 1
    others = [values.astype(np.float64), np.zeros(8, np.float32)[::2], values.astype(np.int32)]
    for other in others:
        assert kernel(other, 2.0) == 2.0 * other.sum()
    values.setflags(write=False)
    assert kernel(values, 2) == 12.0
    assert len(module.called) == 1


def test_results_of_another_process_need_no_other_form(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.pad(np.random.default_rng(0).uniform(-20.0, 20.0, (9999, 2)).astype(np.float32), ((0, 0), (0, 2)))
    zone, ground = zones.Zone([(0, 0), (1, 0), (0, 1)]), planes.fit_ground(points - [[0, 0, 1.73, 0]]).surface()
    kinds: list[object] = []
    for module, name in ((zones, "mark_inside"), (planes, "fill_levels"), (planes, "fill_heights")):
        monkeypatch.setattr(module, name, lambda *args: kinds.append([*map(kind_of, args)]))
    for may_write in (True, False):  # as a pickle gives arrays, and as shared memory does
        zone.polygon.flags.writeable = ground.planes.flags.writeable = may_write
        zone.mark(points)
        planes.heights_above(ground, points)
    assert (len(kinds), kinds[:3]) == (6, kinds[3:])


def test_an_edited_kernel_is_not_the_compiled_one() -> None:
    values = np.arange(4, dtype=np.float32)
    kernel, module = library_of(total, values, 2.0)
    other = Kernel(kernel.library, {"nogil": True, "error_model": "numpy"}, total)
    assert other(values, 2.0) == 12.0
    assert not module.called


def test_without_numba_other_types_name_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel, _ = library_of(total, np.zeros(1, np.float32), 2.0)
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(MissingExtraError, match=r"total, with arguments of unusual types.*edgeperc\[jit\]"):
        kernel(np.zeros(1), 2.0)
    with pytest.raises(MissingExtraError, match=r"without compiled kernels.*edgeperc\[jit\]"):
        njit(nogil=True)


def test_a_kernel_of_numba_may_call_one_of_a_library() -> None:
    inner, _ = library_of(total, np.zeros(1, np.float32), 2.0)

    @numba.njit
    def outer(values: NDArray[np.float64]) -> Any:
        return inner(values, 2.0) + 1.0

    assert outer(np.ones(3)) == 7.0


TOYS = """
import importlib.machinery, importlib.util, json, sys
from pathlib import Path

folder, tool = Path(sys.argv[1]), sys.argv[2]
loader = importlib.machinery.SourceFileLoader("tool", tool)
tool = importlib.util.module_from_spec(importlib.util.spec_from_loader("tool", loader))
loader.exec_module(tool)
called = tool.recorded()
sys.path.insert(0, str(folder))
import numpy as np
import toys

expected = toys.use()
tool.compile_library(called, "toy_library", folder, "")
(folder / "expected.json").write_text(json.dumps(expected))
"""
MODULE = """
from typing import NamedTuple
import numpy as np
from edgeperc.system.kernels import njit

class Pair(NamedTuple):
    values: object
    factor: float

@njit(cache=True, nogil=True)
def scaled(pair):
    "Not there under -OO."
    result = np.empty_like(pair.values)
    for k in range(len(result)):
        result[k] = pair.values[k] * pair.factor
    return result

@njit(cache=True, nogil=True, error_model="numpy")
def total(records, values):
    result = 0.0
    for k in range(records.shape[0]):
        result += scaled(Pair(values, records[k]["weight"]))[k] / records[k]["n"]
    return result, records.shape[0]

@njit(cache=True, nogil=True)
def quotient(a, b):
    if b == 0:
        raise ValueError("b is 0")
    return a // b

def use():
    records = np.zeros(3, np.dtype([("is_new", "?"), ("weight", "f8"), ("n", "i4")], align=True))
    records["weight"], records["n"] = (1.0, 2.0, 3.0), (1, 2, 0)
    results = [total(records[:2], np.arange(3.0)), quotient(7, 2), scaled(Pair(np.ones(2), 2.0)).tolist()]
    results.append(str(total(records, np.arange(3.0))[0]))
    try:
        quotient(7, 0)
    except ValueError as exc:
        results.append(str(exc))
    return json_of(results)

def json_of(results):
    return [list(value) if isinstance(value, tuple) else value for value in results]
"""
RUN = """
import json, sys
sys.modules["numba"] = sys.modules["llvmlite"] = None
sys.path.insert(0, sys.argv[1])
from edgeperc.system import kernels
import toy_library
with open(sys.argv[1] + "/toy_library.json") as file:
    library = kernels.Library(toy_library, json.load(file))
kernels._library = lambda: library
import toys
print(json.dumps(toys.use()))
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_library_answers_without_numba_as_numba_does(tmp_path: Path) -> None:
    """Records, tuples, kernels that call kernels, exceptions, and division by zero as each kernel wants it."""
    (tmp_path / "toys.py").write_text(MODULE)
    printed(TOYS, tmp_path, REPOSITORY / ".ci" / "kernels", flags=("-W", "ignore"), timeout=600)
    expected = json.loads((tmp_path / "expected.json").read_text())
    for flags in ((), ("-OO",)):
        assert json.loads(printed(RUN, tmp_path, flags=flags, timeout=600)) == expected
