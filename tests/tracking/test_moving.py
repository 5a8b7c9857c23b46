"""Points on what moves, by tracks of known motion, and on what could move."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

import twins.moving
from edgeperc import Box, OptionError, Perception, PointLabels, PointsError, Tracker, Tracks
from edgeperc.tracking.moving import mark_in_boxes, movable_points, moving_points, moving_tracks
from edgeperc.tracking.tracks import PARAMETERS
from scenes import box

PLACES = st.one_of(st.integers(-12, 12).map(lambda n: n / 2.0), st.sampled_from([math.nan, math.inf, -math.inf]))


@given(
    npst.arrays(np.float64, st.tuples(st.integers(0, 4), st.just(6)), elements=st.integers(-3, 3).map(float)),
    st.lists(st.floats(-3.2, 3.2), min_size=4, max_size=4),
    npst.arrays(np.float32, st.tuples(st.integers(0, 9), st.just(4)), elements=PLACES.map(np.float32)),
)
def test_points_are_in_boxes_as_for_the_twin(
    places: NDArray[np.float64], yaws: list[float], points: NDArray[np.float32]
) -> None:
    yaw = np.array(yaws[: len(places)])
    boxes = np.column_stack([places[:, :3], np.abs(places[:, 3:]) + 0.3, np.cos(yaw), np.sin(yaw)])
    found = np.empty(len(points), np.bool_)
    mark_in_boxes(boxes, points, found)
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(found, twins.moving.in_boxes(boxes, points))


def perceived(n: int, boxes: Any = (), labels: PointLabels | None = None) -> Perception:
    return Perception(n, 0, labels, None, tuple(boxes), {}, {}, (), None)


car = partial(box, score=0.99)


def followed(
    *ways: Any, n: int = 20, ego_mps: float = 0.0, poses: bool = True, label: str = "car", parameters: Any = None
) -> Tracks:
    """Tracks of cars after ``n`` scans, each way a function from the time to x, y over ground."""
    tracker = Tracker(parameters)
    for k in range(n):
        t, pose = 0.1 * k, np.eye(4)
        pose[0, 3] = ego_mps * t
        boxes = [car(way(t)[0] - ego_mps * t, way(t)[1], label) for way in ways]
        tracks = tracker.update(boxes, t, pose if poses else None)
    return tracks


def on(tracks: Tracks, x: float, y: float) -> list[bool]:
    """Whether a point at the middle of a box, one below its floor and one a meter beside it are marked."""
    points = np.array([[x, y, -0.9], [x, y, -1.8], [x, y + 1.9, -0.9], [math.nan, y, 0.0]], np.float32)
    return moving_points(tracks, points).tolist()


@pytest.mark.parametrize("poses", [True, False])
def test_what_moves_over_ground_is_marked_from_a_moving_vehicle(poses: bool) -> None:
    parked = [lambda t, x=x, y=y: (x, y) for x, y in [(12, -6), (20, 6), (31, -6), (40, 6), (45, -6)]]
    tracks = followed(lambda t: (10.0 + 8.0 * t, 0.0), *parked, ego_mps=8.0, poses=poses)
    (moving,) = moving_tracks(tracks)
    assert moving.box.center[0] == pytest.approx(10.0, abs=0.3)  # it keeps its distance: still in the sensor's frame
    assert on(tracks, 10.0, 0.0) == [True, True, False, False]
    for track in tracks:
        if track.id != moving.id:
            assert not any(on(tracks, *track.center[:2]))


def test_a_speed_must_exceed_its_uncertainty_and_the_least_speed() -> None:
    way = [lambda t: (10.0 + 8.0 * t, 0.0)]
    assert moving_tracks(followed(*way, n=1)) == ()  # as yet any speed is possible
    (track,) = followed(*way)
    assert moving_tracks([track]) == (track,)
    doubtful = replace(track, covariance=track.covariance * 1e4)
    assert moving_tracks([doubtful]) == ()
    assert moving_tracks([doubtful], n_sigmas=0.0) == (doubtful,)
    assert moving_tracks([track], min_speed_mps=9.0) == ()
    state = track.state.copy()
    state[2] = -0.8
    backward = replace(track, state=state, covariance=np.zeros((5, 5)))
    assert moving_tracks([backward]) == ()  # slower than a car's 1 m/s, not than a pedestrian's 0.7 m/s
    own = {"forklift": replace(PARAMETERS["car"], moving_mps=0.3)}
    limits = [("car", None, 1.0), ("pedestrian", None, 0.7), ("forklift", None, 1.0), ("forklift", own, 0.3)]
    for label, parameters, moving_mps in limits:
        (each,) = followed(*way, label=label, parameters=parameters)
        assert each.moving_mps == moving_mps
        assert len(moving_tracks([replace(backward, moving_mps=each.moving_mps)])) == (moving_mps < 0.8)


def test_what_stands_is_not_marked() -> None:
    rng = np.random.default_rng(1)
    tracks = followed(*[lambda t, x=x: (x + rng.normal(0.0, 0.05), rng.normal(0.0, 0.05)) for x in (8.0, 15.0, 25.0)])
    assert len(tracks) == 3
    assert moving_tracks(tracks) == ()
    assert not moving_points(tracks, np.zeros((0, 4))).size


def test_what_could_move_is_marked_by_class_and_by_box() -> None:
    points = np.zeros((6, 4), np.float32)
    points[:, 0] = [0, 1, 2, 3, 20, 40]
    labels = PointLabels(
        np.array([0, 1, 2, 3, 0, 1], np.uint8),
        np.array([1, 1, 1, 1, 1, 0], np.bool_),
        ("background", "other-vehicle", "wall", "pedestrian"),  # SemanticKITTI's were in maps
    )
    perception = perceived(6, [car(20, 0), Box("cone", 0.9, (0, 0, 0), (1, 1, 1), 0.0)], labels)
    points[4, 2] = -0.9
    assert movable_points(perception, points).tolist() == [False, True, False, True, True, False]
    assert np.flatnonzero(movable_points(perception, points, classes={"cone", "wall"})).tolist() == [0, 2]
    assert movable_points(perceived(6, [car(20, 0)]), points).tolist() == [False] * 4 + [True, False]


def test_errors_name_the_reason() -> None:
    tracks, points = followed(lambda t: (9.0, 0.0)), np.zeros((3, 4), np.float32)
    for options in ({"margin_m": -1.0}, {"margin_m": math.nan}, {"n_sigmas": math.inf}, {"min_speed_mps": "a"}):
        with pytest.raises(OptionError, match=f"{next(iter(options))} is "):
            moving_points(tracks, points, **options)
    with pytest.raises(PointsError, match="expected"):
        moving_points(tracks, np.zeros((3, 2)))
    for classes, reason in (("cars", "classes is 'cars'"), ((1, 2), r"classes\[0\] is 1")):  # cars has car in it
        with pytest.raises(OptionError, match=reason):
            movable_points(perceived(3), points, classes=classes)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match=r"tracks\[0\] is Box.*; expected a Track"):
        moving_points([track.box for track in tracks], points)  # type: ignore[misc]
    with pytest.raises(PointsError, match="3 points and a perception of 4"):
        movable_points(perceived(4), points)
