"""Zones against shapely and their twin, and lines that known tracks cross."""

from __future__ import annotations

import math
from contextlib import suppress
from functools import partial
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from shapely import Point, Polygon

import twins.motion
from edgeperc import Crossing, Line, OptionError, PointsError, Tracker, Tracks, Zone
from edgeperc.tracking.zones import mark_inside
from scenes import box

WHOLE = st.integers(-6, 6).map(float)
QUARTERS = st.integers(-24, 24).map(lambda n: n / 4.0)


@given(
    npst.arrays(np.float64, st.tuples(st.integers(3, 8), st.just(2)), elements=WHOLE),
    npst.arrays(
        np.float64,
        st.tuples(st.integers(0, 9), st.just(2)),
        elements=st.one_of(QUARTERS, st.sampled_from([math.nan, math.inf, -math.inf])),
    ),
)
def test_points_are_inside_as_for_the_twin(polygon: NDArray[np.float64], points: NDArray[np.float64]) -> None:
    expected = twins.motion.inside(polygon, points)
    found = np.empty(len(points), np.bool_)
    mark_inside(polygon, points, found)
    slanting = len({*polygon[:, 0]}) > 2  # thirds are rounded
    assert (found == expected).all() or slanting
    shape = Polygon(polygon)
    if shape.is_valid:
        for point, there in zip(points, found, strict=True):
            if not np.isfinite(point).all():
                assert not there
            elif shape.boundary.distance(Point(point)) > 1e-9:
                assert there == shape.contains(Point(point))
    np.testing.assert_array_equal(Zone(polygon).mark(points), found)


def test_two_zones_share_their_edge() -> None:
    left, right = Zone([(0, 0), (4, 1), (4, 5), (0, 5)]), Zone([(0, 0), (0, -5), (4, -5), (4, 1)])
    x = np.random.default_rng(0).uniform(0.0, 4.0, 100)
    on_edge = np.column_stack([x, x / 4.0, x])
    assert (left.mark(on_edge) ^ right.mark(on_edge)).all()


car = partial(box, score=0.99)


def drive(*ways: Any, n: int = 30, pose: Any = lambda t: np.eye(4)) -> list[Tracks]:
    """Tracks of cars, each way a function from the time to x, y; without ``pose`` the sensor stands."""
    tracker = Tracker()
    return [tracker.update([car(*way(0.1 * k)) for way in ways], 0.1 * k, pose(0.1 * k)) for k in range(n)]


def forward(t: float) -> NDArray[np.float64]:
    """Of a vehicle that drives 10 m/s."""
    return np.array([[1, 0, 0, 10.0 * t], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def test_boxes_and_tracks_in_a_zone() -> None:
    zone = Zone([(10, -5), (20, -5), (20, 5), (10, 5)])
    assert zone.boxes([car(15, 0), car(25, 0), car(10.5, 4)]) == (car(15, 0), car(10.5, 4))
    last = drive(lambda t: (15.0, 0.0), lambda t: (30.0, 3.0))[-1]
    assert len(last) == 2
    (track,) = zone.tracks(last)
    assert track.center[0] == pytest.approx(15.0, abs=0.1)
    assert zone.boxes([]) == zone.tracks([]) == ()


def test_a_zone_in_the_world_stays_where_it_is() -> None:
    last = drive(lambda t: (40.0 - 10.0 * t, 0.0), pose=forward)[-1]  # stands in the world, 11 m ahead at the end
    (track,) = last
    assert [t.id for t in Zone([(8, -3), (14, -3), (14, 3), (8, 3)]).tracks(last)] == [track.id]
    assert [t.id for t in Zone([(37, -3), (43, -3), (43, 3), (37, 3)]).tracks(last, world=True)] == [track.id]
    assert Zone([(37, -3), (43, -3), (43, 3), (37, 3)]).tracks(last) == ()


def test_a_line_counts_by_identity_and_direction() -> None:
    line = Line((20, -10), (20, 10))  # looking along it, x below 20 is to the left
    away, oncoming, beside, parked = (
        lambda t: (15.0 + 5.0 * t, 0.0),
        lambda t: (25.0 - 5.0 * t, 5.0),
        lambda t: (15.0 + 5.0 * t, 15.0),
        lambda t: (20.0 + 0.1 * math.sin(9.0 * t), -5.0),
    )
    crossings = [crossing for tracks in drive(away, oncoming, beside, parked) for crossing in line.count(tracks)]
    assert (line.to_left, line.to_right) == (1, 1)
    assert sorted((crossing.label, crossing.to_left) for crossing in crossings) == [("car", False), ("car", True)]
    assert len({crossing.id for crossing in crossings}) == 2
    assert all(0.9 <= crossing.stamp_s <= 1.4 for crossing in crossings)


def test_a_track_counts_once_for_each_direction() -> None:
    line = Line((20, -10), (20, 10))
    seen = drive(lambda t: (20.0 - 2.0 * math.cos(2.0 * t), 0.0), n=90)
    assert [crossing.to_left for tracks in seen for crossing in line.count(tracks)] == [False, True]
    assert line.count(drive(lambda t: (50.0, 0.0), n=200)[-1]) == ()
    assert len(line.known) <= 1  # the others were not seen for 10 s


def test_a_count_that_a_signal_ends_can_be_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    line, one = Line((20, -10), (20, 10)), Crossing(1, "car", False, 1.0)
    made = Mock(side_effect=[one, KeyboardInterrupt, one, one])  # two cross in the same scan
    monkeypatch.setattr("edgeperc.tracking.zones.Crossing", made)
    for tracks in drive(lambda t: (15.0 + 5.0 * t, 0.0), lambda t: (15.0 + 5.0 * t, 5.0)):
        with suppress(KeyboardInterrupt):
            line.count(tracks)
        line.count(tracks)
    assert (line.to_left, line.to_right) == (0, 2)


@pytest.mark.filterwarnings("ignore:got a scan at")
@pytest.mark.parametrize(
    "wrong",
    [
        lambda k: 0.1 * k,
        lambda k: 0.1 * (k - (k % 3 == 0)),  # doubled
        lambda k: 1e9 if k % 7 == 3 else 0.1 * k,  # wrong stamps of single scans
        lambda k: -5.0 if k % 7 == 3 else 0.1 * k,
        lambda k: 0.1 * k - 50.0 * (k >= 5),  # a jump before the line
        lambda k: 0.1 * k - 50.0 * (k >= 25),  # and after it
    ],
)
def test_jumps_of_the_clock_count_no_track_twice(wrong: Any) -> None:
    tracker, line = Tracker(), Line((20, -10), (20, 10))
    crossings = []
    for k in range(30):
        crossings += line.count(tracker.update([car(30.0 - 0.8 * k, 0.0)], wrong(k), np.eye(4)))
    assert (line.to_left, line.to_right, len(crossings)) == (1, 0, 1)


@pytest.mark.filterwarnings("ignore:got a scan at")
def test_a_line_remembers_tracks_by_the_time_that_passed() -> None:
    tracker, line = Tracker(), Line((20, -10), (20, 10))
    for k in range(400):  # a recording of 2 s that plays again and again
        line.count(tracker.update([car(30.0 - 0.8 * (k % 20), 0.0)], 0.1 * (k % 20), np.eye(4)))
    assert line.to_left == 20
    assert len(line.known) <= 7


def test_a_line_of_the_vehicle_counts_what_it_passes() -> None:
    seen = drive(lambda t: (20.0 - 10.0 * t, 4.0), pose=forward)
    ahead, fixed = Line((8, -10), (8, 10), world=False), Line((8, -10), (8, 10))
    assert [sum(len(line.count(tracks)) for tracks in seen) for line in (ahead, fixed)] == [1, 0]


def test_errors_name_the_reason() -> None:
    for polygon in ([(0, 0), (1, 1)], [(0, 0, 0)] * 3, [(0, 0), (1, 1), (math.nan, 0)], "zone", 3.0):
        with pytest.raises(OptionError, match="a zone has"):
            Zone(polygon)  # type: ignore[arg-type]
    zone = Zone([(0, 0), (1, 0), (0, 1)])
    with pytest.raises(ValueError, match="read-only"):
        zone.polygon[0] = 1.0
    for points in (np.zeros(3), np.zeros((3, 1)), [("a", "b")]):
        with pytest.raises(PointsError, match="got points"):
            zone.mark(points)
    with pytest.raises(OptionError, match=r"boxes\[0\] is .*; expected a Box"):
        zone.boxes([car(0, 0).to_dict()])  # type: ignore[list-item]
    with pytest.raises(OptionError, match=r"tracks\[0\] is Box.*; expected a Track"):
        zone.tracks([car(0, 0)])  # type: ignore[list-item]
    for ends in (((0, 0), (0, 0)), ((0, 0), (math.inf, 0)), ((0, 0, 0), (1, 0, 0))):
        with pytest.raises(OptionError, match="a line"):
            Line(*ends)
    for margin_m in (-1.0, math.nan, "a"):
        with pytest.raises(OptionError, match="margin_m"):
            Line((0, 0), (1, 0), margin_m=margin_m)
    with pytest.raises(OptionError, match="got a list; expected the Tracks of a scan"):
        Line((0, 0), (1, 0)).count([])  # type: ignore[arg-type]
