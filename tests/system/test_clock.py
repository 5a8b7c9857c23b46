"""The clock of scans: any stamps are answered, and stamps that rise are taken as they come."""

from __future__ import annotations

import copy
import datetime
import json
import math
import pickle
import warnings
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgeperc import Box, StampError, Tracker, Tracks
from edgeperc.system.clock import (
    GAP_S,
    LATE_S,
    LATEST_S,
    MOST_LATE,
    Clock,
    Stamp,
    as_seconds,
    elapsed_s,
    nanoseconds_of,
    step_between,
)

POISON_S = 2147483651.0  # the year 2038: 2**31 - 1 s and 4e9 ns
STEPS_S = st.one_of(
    st.sampled_from([0.1, 0.1, 0.1, 0.0, 1e-9, 1e-6, -1e-9, -0.021, -0.1, -0.2, -2.0, 0.3, 59.0, 61.0, 1.7e9, -1.7e9]),
    st.floats(-1e3, 1e3),
)
STAMPS_S = st.one_of(st.floats(-LATEST_S, LATEST_S), st.sampled_from([0.0, 0.1, 100.0, 1.7e9, POISON_S, -1.0, 5e-324]))


@st.composite
def stamps_s(draw: st.DrawFn) -> list[float]:
    """Times that mostly rise by a scan's period, with steps of every kind among them."""
    times = [draw(STAMPS_S)]
    for step_s in draw(st.lists(STEPS_S, max_size=20)):
        jump = draw(st.integers(0, 9)) == 0
        times.append(draw(STAMPS_S) if jump else min(max(times[-1] + step_s, -LATEST_S), LATEST_S))
    return times


def kinds(times_s: Sequence[float]) -> list[str]:
    clock, found = Clock(), []
    for time_s in times_s:
        step, clock = clock.after(time_s)
        found.append(step)
    return found


def cars(k: int) -> list[Box]:
    """A car that drives and one that stands, at scan k."""
    return [Box("car", 0.99, (10.0 + x, y, -0.9), (4.2, 1.8, 1.5), 0.0) for x, y in ((0.3 * k, 2.0), (8.0, -4.0))]


def tracked(times_s: Sequence[float]) -> list[Tracks]:
    tracker = Tracker()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return [tracker.update(cars(k), time_s) for k, time_s in enumerate(times_s)]


@pytest.mark.parametrize(
    ("times_s", "expected"),
    [
        ([0.0, 0.1, 0.2, 0.1, 0.2, 0.3], "next next next late late next"),
        ([0.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.2], "next next late late late late next"),  # the same scan again and again
        ([0.0, 0.1, 0.079, 0.2], "next next late next"),
        ([5.0, 5.1, 3.2, 3.3, 3.4], "next next jump next next"),
        ([5.0, 5.1, 0.0, 5.2, 5.3], "next next jump return next"),
        ([5.0, 5.1, POISON_S, 5.2, 5.3], "next next jump return next"),
        ([5.0, 5.1, POISON_S, 9e9, 5.2, 5.3], "next next jump jump return next"),
        ([5.0, 5.1, POISON_S, POISON_S + 0.1, 5.2], "next next jump next jump"),
        ([0.0, 100.1, 100.2], "next jump next"),
        ([1.7e9, 100.1, 100.2], "next jump next"),
        ([0.0, 0.1, 0.2, 0.0, 0.1, 0.2, 0.0, 0.1], "next next next late late late jump next"),  # a short loop
        ([0.0, 0.5, 0.3, 0.31, 0.32, 0.33], "next next late late jump next"),  # a small step back of the clock
        ([0.0, 61.0, 122.0, 183.0], "next jump jump jump"),
    ],
)
def test_steps_of_a_clock(times_s: list[float], expected: str) -> None:
    assert kinds(times_s) == expected.split()


@given(st.lists(st.floats(1e-5, GAP_S), max_size=30), st.floats(-1e9, 1e9))
def test_times_that_rise_are_next(steps_s: list[float], first_s: float) -> None:
    times_s = np.cumsum([first_s, *steps_s]).tolist()
    assert {*kinds(times_s)} == {"next"}
    assert sum(elapsed_s(a, b) for a, b in pairwise(times_s)) == pytest.approx(times_s[-1] - first_s)


@given(stamps_s(), st.integers(-(10**6), 10**9))
def test_after_any_times_tracking_goes_on(times_s: list[float], start_s: int) -> None:
    later = [start_s + 0.1 * k for k in range(MOST_LATE + 10)]
    # The former session may go on, and doubled scans stay late until the clock has passed the last tracked scan.
    assert kinds([*times_s, *later])[-5:] == ["next"] * 5


@given(st.floats(-LATEST_S, LATEST_S), st.floats(-LATEST_S, LATEST_S))
def test_a_step_is_of_one_kind(last_s: float, stamp_s: float) -> None:
    step = step_between(last_s, stamp_s)
    if stamp_s <= last_s:
        assert step == ("late" if stamp_s >= last_s - LATE_S else "jump")
    assert step_between(last_s, last_s) == "late"
    assert (elapsed_s(last_s, stamp_s) > 0.0) == (step == "next")


def test_no_time_at_all_is_a_jump() -> None:
    assert {step_between(*pair) for pair in ((math.nan, 1.0), (1.0, math.nan), (1.0, math.inf))} == {"jump"}
    assert elapsed_s(math.inf, 1.0) == 0.0


@settings(max_examples=60)
@given(stamps_s())
def test_every_scan_has_an_answer_and_no_id_comes_again(times_s: list[float]) -> None:
    session_of: dict[int, int] = {}
    for tracks, time_s, kind in zip(tracked(times_s), times_s, kinds(times_s), strict=True):
        assert tracks.stamp_s == time_s
        assert tracks.is_late == (kind == "late")
        assert np.isfinite(tracks.boxes).all()
        assert not (tracks.is_late and len(tracks))
        for number in tracks.ids.tolist():
            assert session_of.setdefault(number, tracks.session) == tracks.session


@settings(max_examples=30)
@given(stamps_s())
def test_a_late_scan_changes_no_track(times_s: list[float]) -> None:
    """Without its late scans, a session has the same tracks."""
    every = tracked(times_s)
    tracker = Tracker()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for k, (tracks, time_s) in enumerate(zip(every, times_s, strict=True)):
            if tracks.session == 0 and not tracks.is_late:
                alone = tracker.update(cars(k), time_s)
                assert alone.session == 0
                assert len(alone.ids) == len(tracks.ids)  # ids differ by those that other sessions used
                assert np.array_equal(alone.boxes, tracks.boxes)
                assert np.array_equal(alone.T_world_sensor, tracks.T_world_sensor)


def test_one_wrong_stamp_costs_no_track() -> None:
    times_s = [100.0 + 0.1 * k for k in range(8)]
    right = tracked(times_s)
    for wrong_s in (POISON_S, 0.0, -5.0, 1e12):
        answers = tracked([*times_s[:4], wrong_s, *times_s[5:]])
        assert [tracks.session for tracks in answers] == [0, 0, 0, 0, 1, 0, 0, 0]
        assert answers[-1].ids.tolist() == right[-1].ids.tolist() == [1, 2]
        assert not {*answers[4].ids.tolist()} & {1, 2}


def test_a_jump_begins_new_tracks_and_each_case_is_said_once() -> None:
    tracker = Tracker()
    times_s = [5.0, 5.1, 5.1, 5.0, 5.2, 1.0, 1.1, 0.0, 0.1, 7.0, 0.2, 7.1, 0.3]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        ids = [tracker.update(cars(k), time_s).ids.tolist() for k, time_s in enumerate(times_s)]
    assert ids[:5] == [[1, 2], [1, 2], [], [], [1, 2]]
    assert ids[5] == ids[6] == [3, 4]
    texts = [str(warning.message) for warning in said]
    assert len(texts) == 4
    assert texts[0].startswith("got a scan at 5.1 s after one at 5.1 s: a late or doubled scan has no tracks")
    assert texts[1].startswith("got a scan at 1.0 s after one at 5.2 s: the clock jumped")
    assert texts[2].startswith("got a scan at 7.0 s after one at 0.1 s: every track ended")
    assert texts[3].startswith("got a scan at 7.1 s after one at 0.2 s: the stamp before was wrong")
    assert {warning.filename for warning in said} == {__file__}


def test_a_reset_forgets_sessions_and_what_was_said() -> None:
    tracker = Tracker()
    for _ in range(2):
        assert tracker.update(cars(0), 5.0).ids.tolist() == [1, 2]
        with pytest.warns(UserWarning, match="the clock jumped"):
            assert tracker.update(cars(0), 1.0).session == 1
        tracker.reset()


def test_poses_may_begin_or_end_with_a_session() -> None:
    tracker = Tracker()
    tracker.update(cars(0), 5.0, np.eye(4))
    with pytest.warns(UserWarning, match="jumped"):
        assert len(tracker.update(cars(0), 1.0)) == 2


@given(st.integers(0, 2**62))
def test_a_stamp_keeps_its_nanoseconds(ns: int) -> None:
    """A float of today's seconds is off by up to 0.2 us; what is computed with a stamp is a plain float again."""
    stamp = Stamp(ns * 1e-9, ns)
    for same in (stamp, copy.deepcopy(stamp), pickle.loads(pickle.dumps(stamp))):
        assert same == ns * 1e-9
        assert nanoseconds_of(same) == ns
    assert type(stamp + 0.0) is float
    assert nanoseconds_of(float(stamp)) == round(ns * 1e-9 * 1e9)


@pytest.mark.parametrize(
    "stamp_s",
    ["5.0", b"5", datetime.datetime(2025, 5, 1), np.datetime64(1, "ns"), np.timedelta64(1, "ns"), [1.0], 1j, 10**400],
)
def test_what_is_no_time_in_seconds_is_refused(stamp_s: object) -> None:
    with pytest.raises(StampError, match=r"stamp_s is .* expected the time of the scan \[s\]"):
        as_seconds(stamp_s)


@pytest.mark.parametrize("stamp_s", [5, 1.7e9, np.float32(3.0), np.int64(7), np.array(2.0), math.nan, True])
def test_any_number_is_a_time_of_json(stamp_s: Any) -> None:
    np.testing.assert_equal(json.loads(json.dumps(as_seconds(stamp_s))), float(stamp_s))
