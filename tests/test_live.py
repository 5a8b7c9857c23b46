"""Live sources: the newest scan wins, nothing queues up, and whatever goes wrong reaches the caller."""

from __future__ import annotations

import gc
import math
import os
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import edgeperc
from edgeperc import live
from edgeperc.errors import EdgepercError, InferenceError, OptionError, PointsError, StampError
from edgeperc.live import stream
from waiting import TIMEOUT_S, until


def scan(k: int) -> np.ndarray:
    return np.full((k, 4), k, np.float32)


def perceive(points: Any, stamp_s: float | None = None) -> Any:
    return SimpleNamespace(n_points=len(points), stamp_s=stamp_s)


def readers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "edgeperc-source"]


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    assert not readers()
    yield
    gc.collect()
    until(lambda: not readers())


class Source:
    """Scans given by hand: `give` returns once the stream has them."""

    def __init__(self) -> None:
        self.waiting, self.given = threading.Event(), threading.Event()
        self.next: Any = None

    def __iter__(self) -> Source:
        return self

    def __next__(self) -> Any:
        self.waiting.set()
        assert self.given.wait(TIMEOUT_S)
        self.given.clear()
        if isinstance(self.next, BaseException):
            raise self.next
        return self.next

    def give(self, item: Any, last: bool = False) -> None:
        assert self.waiting.wait(TIMEOUT_S)
        self.waiting.clear()
        self.next = item
        self.given.set()
        if not last:
            assert self.waiting.wait(TIMEOUT_S)  # asks for the next, so this one is taken


@pytest.fixture
def source() -> Iterator[Source]:
    source = Source()
    yield source
    source.next = StopIteration()
    source.given.set()


def test_every_scan_of_a_slow_source_is_answered(source: Source) -> None:
    with stream(source, perceive, lambda perception: ("tracks", perception.n_points)) as answers:
        for k in (1, 2, 3):
            source.give((0.1 * k, scan(k)))
            answer = next(answers)
            assert (answer.perception.n_points, answer.stamp_s, answer.n_scans, answer.n_dropped) == (k, 0.1 * k, k, 0)
            assert answer.perception.stamp_s == 0.1 * k
            assert answer.tracks == ("tracks", k)
            assert len(answer.points) == k
            assert answer.age_s >= 0.0
        source.give(StopIteration(), last=True)
        with pytest.raises(StopIteration):
            next(answers)
        with pytest.raises(StopIteration):
            next(answers)
    assert (answers.n_scans, answers.n_dropped) == (3, 0)


def test_the_newest_scan_wins(source: Source) -> None:
    """Five scans come while the first is perceived; the fifth is next, and four are counted."""
    perceiving, go_on = threading.Event(), threading.Event()

    def slowly(points: Any, stamp_s: float | None = None) -> Any:
        perceiving.set()
        assert go_on.wait(TIMEOUT_S)
        return perceive(points, stamp_s)

    answers = stream(source, slowly)
    source.give(scan(1))
    got: list[live.Answer] = []
    consumer = threading.Thread(target=lambda: got.extend(answers))
    consumer.start()
    assert perceiving.wait(TIMEOUT_S)
    for k in range(2, 7):
        source.give(scan(k))
    assert (answers.n_scans, answers.n_dropped) == (6, 4)
    go_on.set()
    until(lambda: len(got) == 2)
    source.give(StopIteration(), last=True)
    consumer.join(TIMEOUT_S)
    assert [answer.perception.n_points for answer in got] == [1, 6]
    assert [(answer.n_scans, answer.n_dropped) for answer in got] == [(1, 0), (6, 4)]


@pytest.mark.parametrize("n", [0, 1, 100])
def test_a_source_faster_than_anything_leaves_one_scan_behind(n: int) -> None:
    answers = stream([scan(k) for k in range(1, n + 1)], perceive)
    until(lambda: answers.n_scans == n)
    assert [answer.perception.n_points for answer in answers] == [n][:n]
    assert answers.n_dropped == max(0, n - 1)


def test_a_scan_is_held_no_longer_than_it_is_wanted() -> None:
    """What nobody looks at is let go of at once, so memory does not grow."""
    alive: list[int] = []

    class Watched:
        def __init__(self) -> None:
            alive.append(1)

        def __del__(self) -> None:
            alive.pop()

    answers = stream((Watched() for _ in range(1000)), perceive)
    until(lambda: answers.n_scans == 1000)
    assert len(alive) <= 2
    answers.close()


def test_health_goes_by_age(source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    now, ages = [100.0], iter([0.05, 0.25, 0.75])
    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def slowly(points: Any, stamp_s: float | None = None) -> Any:
        now[0] += next(ages)
        return perceive(points, stamp_s)

    with stream(source, slowly, rate_hz=10.0) as answers:
        assert (answers.late_after_s, answers.stale_after_s) == (0.2, 0.5)
        assert (answers.age_s, answers.health) == (np.inf, "STALE")
        answered = []
        for k in (1, 2, 3):
            source.give(scan(k))
            answered.append(next(answers))
        assert [answer.health for answer in answered] == ["OK", "LATE", "STALE"]
        assert [answer.age_s for answer in answered] == pytest.approx([0.05, 0.25, 0.75])
        assert answered[0].stamp_s == 100.0  # of its arrival
        assert answers.health == "STALE"
        ages = iter([0.0])
        source.give(scan(4))
        assert next(answers).health == answers.health == "OK"
        now[0] += 0.3  # the source has fallen silent
        assert answers.health == "LATE"
        now[0] += 0.3
        assert answers.health == "STALE"
        assert answers.age_s == pytest.approx(0.6)


def test_waiting_no_longer_than_told(source: Source) -> None:
    with stream(source, perceive) as answers:
        assert answers.take(timeout_s=0.0) is None
        source.give(scan(3))
        answer = answers.take(timeout_s=TIMEOUT_S)
        assert answer.perception.n_points == 3
        later = threading.Timer(0.05, source.give, [scan(4)])
        later.start()
        answer = answers.take(timeout_s=math.inf)
        assert answer.perception.n_points == 4
        assert answers.take(timeout_s=0.001) is None


@pytest.mark.parametrize("error", [OSError("cable pulled"), PointsError("no scan"), KeyboardInterrupt(), MemoryError()])
def test_an_error_of_the_source_is_handed_over_behind_the_last_scan(source: Source, error: BaseException) -> None:
    with stream(source, perceive) as answers:
        source.give(scan(2))
        source.give(error, last=True)
        until(lambda: not readers())
        assert next(answers).perception.n_points == 2
        with pytest.raises(type(error)) as caught:
            next(answers)
        assert caught.value is error
        with pytest.raises(StopIteration):
            next(answers)


def test_an_error_of_perceiver_or_tracker_leaves_the_stream_open(source: Source) -> None:
    def choosy(points: Any, stamp_s: float | None = None) -> Any:
        if len(points) == 1:
            raise InferenceError("answered with NaN")
        return perceive(points, stamp_s)

    def track(perception: Any) -> int:
        if perception.n_points == 2:
            raise ValueError("time runs backwards")
        return 7

    with stream(source, choosy, track) as answers:
        source.give(scan(1))
        with pytest.raises(InferenceError, match="NaN"):
            next(answers)
        source.give(scan(2))
        with pytest.raises(ValueError, match="backwards"):
            next(answers)
        assert answers.age_s == np.inf  # nothing has been answered
        source.give(scan(3))
        assert next(answers).tracks == 7


@pytest.mark.parametrize("item", [(1.0, scan(1), "more"), ("5.0", scan(1)), ([], scan(1)), (10**400, scan(1)), ()])
def test_a_tuple_that_is_no_scan(item: Any) -> None:
    with (
        stream([item], perceive) as answers,
        pytest.raises(PointsError, match=r"expected points or \(stamp_s, points\)"),
    ):
        next(answers)


@pytest.mark.parametrize("source", [7, None, object()])
def test_a_source_that_is_none(source: Any) -> None:
    with pytest.raises(PointsError, match="expected scans or a path"):
        stream(source, perceive)


def test_classes_in_place_of_what_they_make_are_refused() -> None:
    """They were called with the scan in place of their options."""
    for given in ((edgeperc.Perceiver,), (perceive, edgeperc.Tracker)):
        with pytest.raises(OptionError, match=r"<class '.*'>.*; expected a Perceiver, and a Tracker or None"):
            stream([], *given)


@pytest.mark.parametrize(
    "given",
    [
        {"rate_hz": 0.0},
        {"rate_hz": np.nan},
        {"rate_hz": np.inf},
        {"rate_hz": 10**400},
        {"rate_hz": "10"},
        {"late_after_s": "1"},
        {"late_after_s": 0.0},
        {"late_after_s": np.nan},
        {"late_after_s": 0.3, "stale_after_s": 0.2},
    ],
)
def test_ages_and_rates_that_are_none(given: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match="expected"):
        stream([], perceive, **given)


def test_leaving_stops_reading(source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "PATIENCE_S", TIMEOUT_S)
    with stream(source, perceive) as answers:
        source.give(scan(1))
        next(answers)
        monotone = answers.n_scans
        # The thread waits inside the source, and sees the end with the scan that comes next.
        threading.Thread(target=lambda: (until(answers.inbox.stopped.is_set), source.give(scan(2), last=True))).start()
    assert not readers()
    assert answers.n_scans == monotone
    with pytest.raises(StopIteration):
        next(answers)


def test_a_source_that_blocks_for_ever_holds_nobody_up(source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "PATIENCE_S", 0.01)
    answers = stream(source, perceive)
    assert answers.take(timeout_s=0.0) is None
    assert answers.health == "STALE"
    waiting = threading.Thread(target=lambda: list(answers))
    waiting.start()
    answers.close()
    answers.close()
    waiting.join(TIMEOUT_S)
    assert not waiting.is_alive()
    (reader,) = readers()
    assert reader.daemon  # the process can end
    source.give(scan(1), last=True)
    until(lambda: not reader.is_alive())
    assert answers.n_scans == 0
    monkeypatch.setattr(os, "getpid", lambda: 1)  # as in a child
    with pytest.raises(EdgepercError, match="make another one in its fork"):
        next(answers)


def test_a_stream_that_is_forgotten_stops(source: Source) -> None:
    held = [perceive]
    answers: live.Stream | None = stream(source, lambda points, stamp_s: held[0](points, stamp_s))
    source.give(scan(1))
    stopped = answers.inbox.stopped
    for _ in answers:
        break
    answers = None
    gc.collect()
    assert stopped.is_set()


def test_a_generator_is_left_where_it_stands() -> None:
    """Its thread lets go of it, so that what it holds open is closed."""
    closed = threading.Event()

    def drive() -> Iterator[np.ndarray]:
        try:
            for k in range(1, 1_000_000):
                yield scan(min(k, 9))
        finally:
            closed.set()

    with stream(drive(), perceive) as answers:
        next(answers)
    gc.collect()
    assert closed.wait(TIMEOUT_S)


class Waits:
    """Stands in for the event that stops a replay: notes how long it would wait, and turns the clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.waits = 50.0, []
        monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: self.now))

    def wait(self, seconds: float) -> bool:
        self.waits.append(round(seconds, 6))
        self.now += seconds
        return False


def test_a_folder_is_replayed_at_the_sensors_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Waits(monkeypatch)
    scans = [(None, scan(k)) for k in range(4)]
    stamps = [stamp for stamp, _ in live.paced(iter(scans), 20.0, clock)]
    assert stamps == pytest.approx([0.0, 0.05, 0.1, 0.15])
    assert clock.waits == [0.0, 0.05, 0.05, 0.05]


def test_a_capture_is_replayed_by_its_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan that is late comes at once, and those after it when they are due."""
    clock = Waits(monkeypatch)

    def read() -> Iterator[tuple[float, Any]]:
        for stamp_s, reading_s in ((7.0, 3.0), (7.1, 0.0), (7.3, 0.25), (7.4, 0.0), (7.35, 0.0), (9.0, 0.0)):
            clock.now += reading_s
            yield stamp_s, scan(1)

    assert [stamp for stamp, _ in live.paced(read(), 10.0, clock)] == [7.0, 7.1, 7.3, 7.4, 7.35, 9.0]
    assert clock.waits == pytest.approx([0.0, 0.1, 0.0, 0.05, 0.0, 1.6])


@pytest.mark.parametrize(
    ("stamps_s", "waits_s"),
    [
        ([100.0, 100.1, 1.7e9, 1.7e9 + 0.1, 1.7e9 + 0.2], [0.1] * 4),  # time since boot, then UTC
        ([0.0, 0.1, 3.15e7, 0.2, 0.3], [0.1] * 4),  # one wrong stamp
        ([0.0, 1e10, 1e300, math.nan, math.inf, 0.1, 0.2], [0.1] * 6),
        ([math.nan, 5.0, 5.1], [0.1] * 2),
        ([1e9, 1e9 + 0.1, 1.0, 1.1], [0.1] * 3),
        ([0.0, 1.9, 60.0, 60.1], [1.9, 0.1, 0.1]),  # a pause that is too long
        ([0.0, None, 0.2, None], [0.1] * 3),
    ],
)
def test_no_jump_of_the_clock_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, stamps_s: list[float | None], waits_s: list[float]
) -> None:
    clock = Waits(monkeypatch)
    stamps = [stamp for stamp, _ in live.paced(((stamp, scan(1)) for stamp in stamps_s), 10.0, clock)]
    np.testing.assert_equal(stamps, [0.1 * k if stamp is None else stamp for k, stamp in enumerate(stamps_s)])
    assert clock.waits == pytest.approx([0.0, *waits_s], abs=1e-5)


def test_scans_without_a_usable_time_are_answered_without_tracks() -> None:
    def source() -> Iterator[Any]:
        for stamp_s in (1.0, math.nan, math.inf, -1e300, 1.1, 1.1, 0.0, 1.2):
            yield stamp_s, scan(1)
            taken.acquire()

    def empty(points: Any, stamp_s: float | None = None) -> Any:
        return edgeperc.Perception(len(points), 0, None, None, (), {}, {}, (), stamp_s)

    taken, answers = threading.Semaphore(0), []
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with stream(source(), empty, edgeperc.Tracker()) as live_answers:
            for answer in live_answers:
                answers.append(answer.tracks)
                taken.release()
    assert [tracks is None for tracks in answers] == [False, True, True, True, *[False] * 4]
    assert [tracks.is_late for tracks in answers[4:]] == [False, True, False, False]
    assert [tracks.session for tracks in answers[4:]] == [0, 0, 1, 0]
    texts = [str(warning.message) for warning in said]
    assert sum("answered without tracks: got a scan at nan s" in text for text in texts) == 1
    assert len(texts) == 4


def save(folder: Path, n: int) -> Path:
    folder.mkdir()
    for k in range(1, n + 1):
        np.save(folder / f"{k:03}.npy", scan(k))
    return folder


@pytest.mark.parametrize(("accumulate_s", "expected"), [(0.05, 5), (0.15, 9), (0.25, 12), (None, 5)])
def test_scans_of_a_stream_are_gathered(accumulate_s: float | None, expected: int) -> None:
    scans = [(0.1 * k, scan(k)) for k in (2, 3, 4, 5)]
    with stream(iter(scans), perceive, accumulate_s=accumulate_s) as answers:
        last = [*answers][-1]
    assert (last.perception.n_points, last.stamp_s) == (expected, 0.5)


def test_scans_without_stamps_are_not_gathered() -> None:
    with (
        stream(iter([scan(1), scan(2)]), perceive, accumulate_s=0.2) as answers,
        pytest.raises(StampError, match="neither times of its points nor a stamp"),
    ):
        next(answers)


def test_a_folder_is_a_source(tmp_path: Path) -> None:
    with stream(save(tmp_path / "drive", 5), perceive, rate_hz=1000.0) as answers:
        got = list(answers)
    assert got[-1].perception.n_points == 5
    assert got[-1].stamp_s == pytest.approx(0.004)
    assert len(got) + answers.n_dropped == answers.n_scans == 5
    stamps = [answer.stamp_s for answer in got]
    assert stamps == sorted({*stamps})


def test_a_long_wait_for_the_next_scan_is_no_hindrance_to_leaving(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "PATIENCE_S", TIMEOUT_S)
    with stream(str(save(tmp_path / "drive", 2)), perceive, rate_hz=1e-6) as answers:
        assert next(answers).perception.n_points == 1
    assert not readers()


def test_paths_of_nothing(tmp_path: Path) -> None:
    with pytest.raises(PointsError, match="there is no such file or folder"):
        stream(tmp_path / "absent", perceive)
    with stream(tmp_path, perceive) as answers, pytest.raises(PointsError, match="no scan in this folder"):
        next(answers)
    (tmp_path / "a.npy").write_bytes(b"damaged")
    np.save(tmp_path / "0.npy", scan(1))
    with stream(tmp_path, perceive, rate_hz=1000.0) as answers:
        assert next(answers).perception.n_points == 1
        with pytest.raises(PointsError, match=r"a\.npy"):
            next(answers)
