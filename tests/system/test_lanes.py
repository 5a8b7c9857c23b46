from __future__ import annotations

import os
import threading
import traceback
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from edgeperc.system.lanes import Lanes, Once, Stopwatch

if not hasattr(os, "sched_getaffinity"):
    pytest.skip("cores are chosen on Linux", allow_module_level=True)


@pytest.fixture
def cores() -> Iterator[set[int]]:
    """Cores of this thread, two or more; given back at the end."""
    before = os.sched_getaffinity(0)
    if len(before) < 2:
        pytest.skip("one core")
    yield before
    os.sched_setaffinity(0, before)


def met(first: Callable[[], Any], second: Callable[[], Any]) -> tuple[Any, Any]:
    """What two functions give on two lanes that run at the same time."""
    barrier = threading.Barrier(2, timeout=20.0)

    def together(function: Callable[[], Any]) -> Any:
        barrier.wait()
        return function()

    watch = Stopwatch()
    one, two = (Once(together, function, stage="check", watch=watch) for function in (first, second))
    LANES.run([one], [two])
    return one(), two()


LANES = Lanes(2)


def own_cores() -> set[int]:
    return os.sched_getaffinity(0)


def test_lanes_share_no_core(cores: set[int]) -> None:
    for _ in range(3):
        mine, others = met(own_cores, own_cores)
        assert mine
        assert others
        assert not mine & others
        assert mine | others == cores
        assert own_cores() == cores


def test_an_error_gives_the_cores_back(cores: set[int]) -> None:
    def fail() -> None:
        raise ValueError("no")

    for functions in ((fail, own_cores), (own_cores, fail)):
        with pytest.raises(ValueError, match="no"):
            met(*functions)
        assert own_cores() == cores


@pytest.mark.parametrize("n", [1, 2])
def test_an_error_is_told_where_it_happened(n: int) -> None:
    """Not by each of the values that need the one that failed; and what comes after it is not computed."""
    watch, computed = Stopwatch(), []

    def fail() -> None:
        raise ValueError("no")

    value: Once[object] = Once(fail, stage="check", watch=watch)
    for k in range(30):
        other = Once(computed.append, k, stage="check", watch=watch)
        value = Once(lambda *given: given, value, other, stage="check", watch=watch)
    with pytest.raises(ValueError, match="no") as raised:
        Lanes(n).run([value], [])
    frames = [frame.name for frame in traceback.extract_tb(raised.value.__traceback__)]
    assert frames[-1] == "fail"
    assert len(frames) < 8
    assert computed == []


def test_a_caller_on_one_core_stays_there(cores: set[int]) -> None:
    one = {min(cores)}
    os.sched_setaffinity(0, one)
    mine, others = met(own_cores, own_cores)
    assert mine == own_cores() == one
    assert others
    os.sched_setaffinity(0, cores)
    mine, others = met(own_cores, own_cores)
    assert not mine & others


def test_cores_that_may_not_be_chosen(monkeypatch: pytest.MonkeyPatch, cores: set[int]) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("sandbox")

    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    assert met(lambda: 1, lambda: 2) == (1, 2)
    monkeypatch.delattr(os, "sched_setaffinity")
    assert met(lambda: 1, lambda: 2) == (1, 2)
    monkeypatch.undo()
    assert own_cores() == cores
