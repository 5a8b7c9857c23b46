from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

import edgeperc
from edgeperc.system.lanes import Lanes, Stopwatch, Values

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

    value = Values(Stopwatch())
    one, two = (value("check", together, function) for function in (first, second))
    LANES.run(value)
    return one(), two()


LANES = Lanes(2)
ALL_LANES = {1: Lanes(1), 2: LANES}


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
    value, computed = Values(Stopwatch()), []

    def fail() -> None:
        raise ValueError("no")

    last = value("check", fail)
    for k in range(30):
        last = value("check", lambda k, _: computed.append(k), k, last)
    with pytest.raises(ValueError, match="no") as raised:
        Lanes(n).run(value)
    frames = [frame.name for frame in traceback.extract_tb(raised.value.__traceback__)]
    assert frames[-1] == "fail"
    assert len(frames) < 8
    assert computed == []


def test_an_interrupt_within_numba_stays_one() -> None:
    def interrupted() -> None:
        try:
            raise SystemError("unpickle returned a result with an exception set") from KeyboardInterrupt("Ctrl-C")
        except SystemError as exc:
            raise SystemError("the kernel returned a result with an exception set") from exc

    value = Values(Stopwatch())
    value("check", interrupted)
    with pytest.raises(KeyboardInterrupt, match="Ctrl-C"):
        Lanes(1).run(value)


@pytest.mark.parametrize("n", [1, 2])
def test_an_interrupt_ends_both_lanes(n: int) -> None:
    """Signals come to the thread that calls; the other one ends the value that it computes, and no more."""
    ended = threading.Event()
    meet = threading.Barrier(n, timeout=20.0)
    caller = threading.get_ident()

    def work(k: int) -> None:
        if k < n:
            meet.wait()
        if threading.get_ident() == caller:
            raise KeyboardInterrupt
        time.sleep(0.05)
        assert not ended.is_set()
        ended.set()

    lanes, value, more = Lanes(n), Values(Stopwatch()), Values(Stopwatch())
    for k in range(50):
        value("check", work, k)
    with pytest.raises(KeyboardInterrupt):
        lanes.run(value)
    assert ended.is_set() == (n == 2)
    again = more("check", int, "7")
    lanes.run(more)
    assert again() == 7


@given(st.lists(st.sets(st.integers(0, 11), max_size=4), max_size=12), st.integers(1, 2))
def test_each_value_is_computed_once_after_those_that_it_needs(needs: list[set[int]], n: int) -> None:
    value, order = Values(Stopwatch()), []

    def total(k: int, *needed: int) -> int:
        order.append(k)
        return 1 + sum(needed)

    expected: list[int] = []
    for k, places in enumerate(needs):
        needed = sorted(place for place in places if place < k)
        value("infer", total, k, *(value[place] for place in needed))
        expected.append(1 + sum(expected[place] for place in needed))
    ALL_LANES[n].run(value)
    assert [each() for each in value] == expected
    assert sorted(order) == [*range(len(needs))]
    assert n == 2 or order == sorted(order)


def test_an_earlier_value_is_more_urgent_and_no_lane_waits_for_what_another_one_computes() -> None:
    value, released = Values(Stopwatch()), threading.Event()
    order: list[str] = []

    def long() -> None:
        released.wait(20.0)
        order.append("long")

    def short(name: str) -> None:
        order.append(name)
        if name == "last":
            released.set()

    first = value("infer", long)
    value("decode", lambda _: order.append("needs it"), first)
    for name in ("a", "b", "last"):
        value("check", short, name)
    LANES.run(value)
    assert order == ["a", "b", "last", "long", "needs it"]


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
    monkeypatch.setattr(os, "sched_setaffinity", Mock(side_effect=PermissionError("sandbox")))
    assert met(lambda: 1, lambda: 2) == (1, 2)
    monkeypatch.delattr(os, "sched_setaffinity")
    assert met(lambda: 1, lambda: 2) == (1, 2)
    monkeypatch.undo()
    assert own_cores() == cores


@pytest.mark.parametrize("n", [1, 2])
def test_waiting_counts_for_what_is_waited_for(n: int) -> None:
    """Whichever lane computes it, the answer takes its time."""
    watch = Stopwatch()
    value = Values(watch)
    slow = value("infer", time.sleep, 0.1)
    value("check", int)
    value("agree", lambda _: None, slow)
    ALL_LANES[n].run(value)
    assert watch.ms["infer"] > 90.0 > watch.ms["check"] + watch.ms["agree"]


INTERRUPTED = """
import os, random, signal, sys
sys.path.insert(0, {root!r})
from edgeperc.system.interpreter import native_call
from edgeperc.system.lanes import Lanes, Stopwatch, Values

class Stop(Exception):
    pass

def stop(*_):
    raise Stop

def work(*needed):
    with native_call():
        return 1 + sum(sum(range(200)) * 0 + each for each in needed)

cores, lanes, draw, n = os.sched_getaffinity(0), Lanes(2), random.Random(7), 0
lanes.run(Values(Stopwatch()))
signal.signal(signal.SIGALRM, stop)
for k in range(4000):
    value = Values(Stopwatch())
    for _ in range(20):
        value("check", work, *value[-3::2])
    try:
        try:
            signal.setitimer(signal.ITIMER_REAL, draw.uniform(1e-5, 1e-3))
            lanes.run(value)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    except Stop:
        n += 1
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    assert os.sched_getaffinity(0) == cores, k
assert n > 100, n
print("ends")
"""


def test_signals_neither_block_the_second_lane_nor_keep_cores() -> None:
    """Wherever they come; nor does the end of the process wait for a call that they ended."""
    code = INTERRUPTED.format(root=str(Path(edgeperc.__file__).parent.parent))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=50.0)
    assert done.stdout == "ends\n", done.stderr
