"""The tracker: the motion of the sensor, the life of tracks, wrong input."""

from __future__ import annotations

import copy
import functools
import math
import pickle
from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import edgeperc
import twins.tracking
from edgeperc import Box, OptionError, StampError, Tracker, TrackingError
from edgeperc.tracking import lives
from edgeperc.tracking.egomotion import fit_motion, nearest_detection, support
from edgeperc.tracking.jpda import Detections
from edgeperc.tracking.tracks import PARAMETERS
from edgeperc.tracking.ukf import CTRV, move
from edgeperc.types.frame import ModelFrame
from edgeperc.types.perception import Perception
from edgeperc_bench.peers.tracking import crossing

STANDING = np.eye(4)  # without poses, the motion of a single object cannot be separated from the sensor's


def some_places(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.column_stack([rng.uniform(-20.0, 20.0, (n, 2)), rng.uniform(0.05, 1.0, n), rng.integers(0, 2, n)])


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 3), (3, 0), (1, 1), (8, 9), (20, 20)])
def test_the_fit_of_the_motion_is_its_twin(n: int, m: int) -> None:
    rng = np.random.default_rng(n + 10 * m)
    prior, spread = np.array([0.5, 0.0, 0.02]), np.array([1.0, 0.1, 0.01])
    for strange in (False, True):
        places = some_places(rng, n), some_places(rng, m)
        if strange and m:
            places[1][::3, 0] = np.nan  # the tracker lets none in; it must be nobody's detection
        for _ in range(5):
            motion = prior + rng.normal(0.0, 1.0, 3) * [1.0, 0.3, 0.1]
            wanted = twins.tracking.motion_support(*places, prior, spread, motion)
            assert support(*places, prior, spread, motion) == pytest.approx(wanted)
            which, squared = twins.tracking.nearest(*places, motion)
            for landmark, index, distance in zip(places[0], which, squared, strict=True):
                assert nearest_detection(landmark, places[1], motion) == (index, pytest.approx(distance))
        motion, covariance = np.empty(3), np.empty((3, 3))
        n_pairs = fit_motion(*places, prior, spread, motion, covariance)
        wanted_motion, wanted_covariance, wanted_pairs = twins.tracking.fitted_motion(*places, prior, spread)
        np.testing.assert_allclose(motion, wanted_motion, atol=1e-8)
        np.testing.assert_allclose(covariance, wanted_covariance, rtol=1e-6, atol=1e-12)
        assert n_pairs == wanted_pairs
        if n == 0 or m == 0:
            np.testing.assert_allclose(motion, prior)


def fitted(places: np.ndarray, detections: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, int]:
    marked = [np.column_stack([of, np.full(len(of), 0.02), np.zeros(len(of))]) for of in (places, detections)]
    motion, covariance = np.empty(3), np.empty((3, 3))
    return motion, fit_motion(*marked, np.zeros(3), spread**2, motion, covariance)


def test_the_fit_finds_the_motion_among_objects_that_move() -> None:
    rng = np.random.default_rng(4)
    true = np.array([1.7, 0.1, 0.04])
    places = rng.uniform(-30.0, 30.0, (12, 2))
    cos, sin = math.cos(true[2]), math.sin(true[2])
    detections = (places - true[:2]) @ np.array([[cos, -sin], [sin, cos]]) + rng.normal(0.0, 0.02, (12, 2))
    detections[:4] += rng.uniform(1.0, 3.0, (4, 2))  # a third of them drives off
    motion, n_pairs = fitted(places, detections, np.array([1.5, 0.1, 0.03]))
    assert n_pairs >= 8
    assert (np.abs(motion - true) < [0.05, 0.05, 0.004]).all()


def test_one_far_landmark_that_moves_aside_speaks_for_a_turn() -> None:
    turn = 0.08  # moves it by twenty of its standard deviations
    landmark = np.array([[40.0, 10.0]])
    detection = landmark @ np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    motion, n_pairs = fitted(landmark, detection, np.array([0.5, 0.1, 0.05]))
    assert n_pairs == 1
    assert motion[2] == pytest.approx(turn, abs=0.01)
    assert (np.abs(motion[:2]) < 0.3).all()


def drive(n_scans: int, seed: int = 0) -> Iterator[tuple[list[Box], np.ndarray]]:
    """A street of parked cars and an oncoming one, seen from a car that pulls off and turns: boxes and poses."""
    rng = np.random.default_rng(seed)
    parked = np.column_stack([rng.uniform(5.0, 90.0, 24), rng.choice([-6.0, 6.0, 9.0], 24)])
    x = y = heading = 0.0
    for k in range(n_scans):
        speed, turn = min(10.0, 0.5 * k), 0.15 if 40 <= k < 60 else 0.0
        x, y, heading = x + 0.1 * speed * math.cos(heading), y + 0.1 * speed * math.sin(heading), heading + 0.1 * turn
        pose = np.eye(4)
        pose[:2, :2] = [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
        pose[:2, 3] = x, y
        oncoming = np.array([[120.0 - 1.2 * k, 2.0]])
        there = (np.vstack([parked, oncoming]) - [x, y]) @ pose[:2, :2] + rng.normal(0.0, 0.04, (25, 2))
        seen = np.flatnonzero((np.hypot(*there.T) < 50.0) & (rng.random(25) < 0.95))
        turned = np.where(np.arange(25) == 24, math.pi, 0.0) - heading + rng.normal(0.0, 0.01, 25)
        yield [box("car", *there[j], yaw=turned[j]) for j in seen], pose


def box(label: str, x: float, y: float, *, yaw: float = 0.0, score: float = 0.9, z: float = -0.9) -> Box:
    sizes = {"pedestrian": (0.8, 0.6, 1.7), "cyclist": (1.8, 0.6, 1.7)}
    return Box(label, score, (float(x), float(y), z), sizes.get(label, (4.2, 1.8, 1.5)), float(yaw))


@pytest.mark.parametrize("tilt_and_turn", [(0.0, 0.0, 0.0), (0.0, 15.0, -90.0), (180.0, 0.0, 110.0)])
def test_without_poses_the_sensors_motion_is_found(tilt_and_turn: tuple[float, float, float]) -> None:
    tracker, posed = Tracker(), Tracker()
    mounting = edgeperc.Mounting(1.73, *tilt_and_turn)
    frame, R = ModelFrame(mounting), mounting.rotation()
    for k, (boxes, pose) in enumerate(drive(100)):
        tracks = tracker.update(frame.boxes_back(boxes), 0.1 * k, mounting=mounting)
        known = posed.update(boxes, 0.1 * k, pose)
    way = R @ tracks.T_world_sensor[:3, 3]
    assert np.hypot(*(way[:2] - pose[:2, 3])) < 2.0  # of some 90 m driven
    assert abs(way[2]) < 1.5
    turn = R @ tracks.T_world_sensor[:3, :3] @ R.T
    assert abs(math.atan2(turn[1, 0], turn[0, 0]) - math.atan2(pose[1, 0], pose[0, 0])) < 0.03
    assert len(known) > 3
    for track in known:
        assert np.hypot(*track.velocity) < 1.0


def test_a_sensor_beside_the_origin_of_its_frame_has_the_same_tracks() -> None:
    """What is far, hidden or out of view is so from the sensor: seen from the origin, other tracks were reported."""
    there = edgeperc.Mounting(1.73, 0.0, 0.0, 0.0, (12.0, -5.0))
    T_there_here = np.eye(4)
    T_there_here[:2, 3] = there.origin_m
    here, aside = Tracker(field_of_view_deg=(40.0, -40.0)), Tracker(field_of_view_deg=(40.0, -40.0))
    for k, (boxes, pose) in enumerate(drive(60)):
        seen = [box for j, box in enumerate(boxes) if (j + k) % 4]
        moved = [replace(box, center=(box.center[0] + 12.0, box.center[1] - 5.0, box.center[2])) for box in seen]
        wanted = here.update(seen, 0.1 * k, pose)
        tracks = aside.update(moved, 0.1 * k, pose @ np.linalg.inv(T_there_here), mounting=there)
        assert tracks.ids.tolist() == wanted.ids.tolist()
        np.testing.assert_allclose(tracks.scores, wanted.scores, atol=1e-6)
        np.testing.assert_allclose(tracks.boxes[:, :3] - [12.0, -5.0, 0.0], wanted.boxes[:, :3], atol=1e-6)


def test_another_clock_world_and_order_of_the_boxes_give_the_same_tracks() -> None:
    """Turned by half: at other angles the sigma points lie elsewhere, which moves tracks by some millimeters."""
    T_there_here = np.diag([-1.0, -1.0, 1.0, 1.0])
    T_there_here[:3, 3] = 300.0, -200.0, 40.0
    here, there, chance = Tracker(), Tracker(), np.random.default_rng(0)
    for k, (seen, pose) in enumerate(drive(40)):
        # Of two equals in one place, the first one stays.
        boxes = [replace(box, score=chance.uniform(0.6, 0.95)) for box in seen]
        shuffled = [boxes[j] for j in chance.permutation(len(boxes))]
        found, other = here.update(boxes, 0.1 * k, pose), there.update(shuffled, 1e4 + 0.1 * k, T_there_here @ pose)
        wanted, rows = (
            np.column_stack([tracks.boxes, tracks.scores, [track.state[2] for track in tracks]])[
                np.argsort(tracks.boxes[:, 0])
            ]
            for tracks in (found, other)
        )
        np.testing.assert_allclose(rows, wanted, atol=1e-3)


def test_without_poses_traffic_that_moves_one_way_does_not_take_the_sensor_along() -> None:
    rng, tracker = np.random.default_rng(0), Tracker()
    parked = np.column_stack([rng.uniform(5.0, 60.0, 12), rng.choice([-6.0, 9.0], 12)])
    flowing = np.column_stack([rng.uniform(5.0, 50.0, 8), np.full(8, 4.0)])
    for k in range(20):
        flowing[:, 0] += 1.6
        places = np.vstack([parked, flowing]) + rng.normal(0.0, 0.04, (20, 2))
        tracks = tracker.update([box("car", *place) for place in places if place[0] < 80.0], 0.4 * k)
        assert np.hypot(*tracks.T_world_sensor[:2, 3]) < 0.8  # of 30 m that the traffic drives


def test_with_poses_what_stands_still_stands_still_in_the_world() -> None:
    tracker, paths, speeds = Tracker(), {}, {}
    for k, (boxes, pose) in enumerate(drive(60)):
        for track in tracker.update(boxes, 0.1 * k, pose):
            paths.setdefault(track.id, []).append(track.world_box.center[:2])
            speeds[track.id] = track.state[2]
            x, y, _ = (np.linalg.inv(pose) @ [*track.world_box.center, 1.0])[:3]
            assert track.box.center[:2] == pytest.approx((x, y))
    moved = {name: np.hypot(*(np.array(path[-1]) - path[0])) for name, path in paths.items() if len(path) > 10}
    assert sorted(moved.values())[-2] < 0.4  # all but the oncoming car
    (oncoming,) = [name for name, distance in moved.items() if distance > 5.0]
    assert abs(speeds[oncoming]) == pytest.approx(12.0, abs=0.5)


def test_birth_confirmation_coasting_memory_and_death() -> None:
    tracker = Tracker()
    assert len(tracker.update([box("car", 10.0, 0.0, score=0.8)], 0.0, STANDING)) == 0  # one look is not enough
    (track,) = tracker.update([box("car", 10.5, 0.0, score=0.8)], 0.1, STANDING)
    assert (track.id, track.label, track.hits, track.coasting) == (1, "car", 2, False)
    for k in range(2, 12):
        (track,) = tracker.update([box("car", 10.0 + 0.5 * k, 0.0, score=0.8)], 0.1 * k, STANDING)
    assert track.velocity == pytest.approx((5.0, 0.0), abs=0.3)
    assert track.age_s == pytest.approx(1.1)
    for k in range(12, 15):  # overlooked, in plain sight
        (track,) = tracker.update([], 0.1 * k, STANDING)
        assert track.coasting
        assert track.box.center[0] == pytest.approx(10.0 + 0.5 * k, abs=0.3)
    for k in range(15, 18):
        assert len(tracker.update([], 0.1 * k, STANDING)) == 0  # too often to be reported
    (track,) = tracker.update([box("car", 19.0, 0.0, score=0.95)], 1.8, STANDING)
    assert track.id == 1  # but not forgotten
    with pytest.warns(UserWarning, match="4.5 s after one at 1.8 s: every track ended"):  # as with ms
        assert len(tracker.update([], 4.5, STANDING)) == 0
    tracker.update([box("car", 21.0, 0.0)], 4.6, STANDING)
    (track,) = tracker.update([box("car", 21.0, 0.0)], 4.7, STANDING)
    assert track.id == 2


def test_a_hidden_track_is_reported_for_longer() -> None:
    """One pedestrian walks past behind a car for a second; another one is no longer found beside it."""
    tracker = Tracker()
    for k in range(33):
        y = -3.2 + 0.2 * k
        boxes = [box("car", 10.0, 0.0, score=0.99)]
        boxes += [box("pedestrian", 14.0, y, yaw=math.pi / 2)] if abs(y) > 1.2 else []
        boxes += [box("pedestrian", 14.0, 8.0)] if k < 8 else []
        tracks = tracker.update(boxes, 0.1 * k, STANDING)
        walking = [track for track in tracks if track.label == "pedestrian" and track.box.center[1] < 6.0]
        assert len(walking) == (k > 0)
        assert len(tracks) == 1 + (0 if k == 0 else 2 if k < 11 else 1)
    assert walking[0].id == 2
    assert walking[0].box.center[1] == pytest.approx(y, abs=0.2)


def test_a_track_is_worth_more_hidden_than_overlooked() -> None:
    scores = []
    for x in (10.0, 30.0):  # before the pedestrian, and behind
        tracker = Tracker()
        for k in range(12):
            boxes = [box("car", x, 0.0, score=0.99)]
            boxes += [box("pedestrian", 14.0, 0.0)] if k < 9 else []
            tracks = tracker.update(boxes, 0.1 * k, STANDING)
        scores.append(tracks.scores[tracks.labels.index("pedestrian")])
    assert scores[0] > scores[1] + 0.01


def test_a_sure_detection_is_reported_at_once_and_a_doubtful_one_begins_no_track() -> None:
    parameters = {"car": replace(PARAMETERS["car"], birth_score=0.3)}
    tracker = Tracker(parameters)
    tracks = tracker.update([box("car", 10.0, 0.0, score=0.99), box("car", 20.0, 0.0, score=0.2)], 0.0, STANDING)
    assert [track.box.center[0] for track in tracks] == [10.0]
    assert tracks.n_tentative == 0
    assert 0.5 < tracks[0].score < 0.99


def test_the_score_grows_with_every_detection_and_shrinks_without() -> None:
    tracker = Tracker()
    scores = [tracker.update([box("car", 10.0, 0.0, score=0.98)], 0.1 * k, STANDING)[0].score for k in range(10)]
    assert scores == sorted(scores)
    assert tracker.update([], 1.0, STANDING)[0].score < scores[-1]


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (180.0, 0.0), (10.0, 30.0)])
@given(st.tuples(*(st.floats(-b, b) for b in (50.0, math.pi, 2.0))), st.floats(0.0, 5.0))
def test_a_track_is_predicted_as_its_filter_does(
    tilt: tuple[float, float], motion: tuple[float, float, float], ahead_s: float
) -> None:
    """On the arc of constant turn rate and velocity, in the world and as the sensor sees it."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = edgeperc.Mounting(None, *tilt).rotation(), (3.0, -2.0, 1.0)
    (track,) = track_seen_from(tuple(map(tuple, pose)))
    state = np.array([*track.world_box.center[:2], *motion])
    track = replace(track, state=state.copy(), world_box=replace(track.world_box, yaw=motion[1] + math.pi))
    move(CTRV, state, ahead_s)
    predicted = track.predicted(ahead_s, world=True)
    assert predicted.center == pytest.approx((*state[:2], track.world_box.center[2]), abs=1e-6)
    assert math.cos(predicted.yaw - state[3] - math.pi) == pytest.approx(1.0)
    assert (predicted.label, predicted.size, predicted.front) == ("car", track.box.size, track.box.front)
    seen = track.predicted(ahead_s)
    assert pose[:3, :3] @ seen.center + pose[:3, 3] == pytest.approx(predicted.center, abs=1e-6)
    ahead = pose[:3, :3].T @ [math.cos(predicted.yaw), math.sin(predicted.yaw), 0.0]
    assert seen.yaw == pytest.approx(math.atan2(ahead[1], ahead[0]))
    later = track.predicted(2.0)
    assert track.predicted(np.float16(2.0)) == later  # not rounded to that type
    assert track.to_dict()["predicted"][1] == pytest.approx([*later.center, later.yaw], abs=1e-4)


@functools.cache
def track_seen_from(pose: tuple[tuple[float, ...], ...]) -> edgeperc.Tracks:
    return Tracker().update([box("car", 10.0, 0.0, score=0.99)], 0.0, pose)


@pytest.mark.parametrize("ahead_s", [-0.1, math.nan, math.inf, 61.0, "1", None])
def test_a_time_that_is_none_is_refused(ahead_s: Any) -> None:
    (track,) = track_seen_from(tuple(map(tuple, STANDING)))
    with pytest.raises(OptionError, match="ahead_s"):
        track.predicted(ahead_s)


def test_a_box_seen_from_behind_is_the_same_box() -> None:
    tracker = Tracker()
    for k in range(20):
        tracks = tracker.update([box("car", 10.0 + k, 0.0, yaw=math.pi if k % 3 == 2 else 0.0)], 0.1 * k, STANDING)
    (track,) = tracks
    assert track.box.yaw == pytest.approx(0.0, abs=0.05)
    assert track.velocity == pytest.approx((10.0, 0.0), abs=0.5)
    tracker = Tracker()
    for k in range(20):  # found the wrong way round more often than not, but it drives
        tracks = tracker.update([box("car", 10.0 + k, 0.0, yaw=0.0 if k % 5 < 2 else math.pi)], 0.1 * k, STANDING)
    assert abs(tracks[0].box.yaw) == pytest.approx(0.0, abs=0.1)


def drives(xs: list[float], yaw: float = 0.0, front: float | None = None, label: str = "car") -> list[edgeperc.Tracks]:
    """Track one object at these places, 0.1 s apart."""
    tracker = Tracker()
    boxes = [replace(box(label, x, 0.0, yaw=yaw), front=front) for x in xs]
    return [tracker.update([each], 0.1 * k, STANDING) for k, each in enumerate(boxes)]


def test_motion_shows_the_front_and_a_parked_car_keeps_it() -> None:
    """The boxes are the wrong way round. The car drives, brakes, and parks."""
    moving = np.cumsum([0.0, *[0.8] * 20]) + 10.0
    tracks = drives([*moving, *[moving[-1]] * 40], yaw=math.pi)
    assert tracks[1][0].box.front is None  # not before two scans with a certain motion
    for k in (15, 20, 60):
        (track,) = tracks[k]
        assert track.box.yaw == pytest.approx(0.0, abs=0.1)
        assert track.world_box.front == track.box.front == tracks[k].fronts[0] > 0.9
    assert tracks[60][0].to_dict()["front"] > 0.9
    (parked,) = drives([10.0] * 30, yaw=math.pi)[-1]
    assert parked.box.front is None
    assert abs(parked.box.yaw) == pytest.approx(math.pi, abs=0.05)  # as the detections say


def test_a_reversing_car_turns_around_unless_its_front_is_seen() -> None:
    there = np.cumsum([0.0, *[0.5] * 20, *[-0.3] * 40]) + 20.0
    tracks = drives(there.tolist())
    assert tracks[20][0].yaw == pytest.approx(0.0, abs=0.1)
    assert abs(tracks[60][0].yaw) == pytest.approx(math.pi, abs=0.1)
    assert tracks[60][0].box.front > 0.9
    seen = drives(there.tolist(), front=0.9)
    assert seen[60][0].yaw == pytest.approx(0.0, abs=0.1)
    assert seen[60][0].box.front > 0.9


def test_detections_that_know_the_front_vote() -> None:
    """Log odds are added: 0.7 and 0.7 are 0.84, one scan of three is wrong."""
    tracks = drives([10.0, 10.0], front=0.7)
    assert tracks[1].fronts[0] == pytest.approx(0.49 / (0.49 + 0.09), abs=0.01)
    (turned,) = drives([10.0] * 3, front=0.2)[-1]
    assert abs(turned.yaw) == pytest.approx(math.pi, abs=0.05)
    tracker = Tracker()
    for k in range(9):
        (track,) = tracker.update(
            [replace(box("car", 10.0, 0.0, yaw=math.pi * (k % 3 == 2), score=0.99), front=0.8)], k
        )
    assert track.yaw == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(("n", "m"), [(0, 0), (1, 0), (0, 2), (1, 1), (20, 3)])
def test_fronts_are_those_of_the_twin(n: int, m: int) -> None:
    rng = np.random.default_rng(n + m)
    state, detections = 3.0 * rng.normal(0.0, 1.0, (n, 5)), rng.normal(0.0, 2.0, (m, 3))
    beta, told = rng.dirichlet(np.ones(m + 1), n).reshape(n, m + 1), rng.normal(0.0, 3.0, m)
    fronts = rng.uniform([-4, -8, -10], [4, 8, 10], (n, 3))
    sigma, limit = rng.uniform(0.1, 2.0, n), rng.uniform(0.5, 2.0, n)
    wanted = twins.tracking.updated_fronts(state, sigma, limit, beta, detections, told, fronts)
    lives.update_fronts(state, sigma, limit, beta, detections, told, fronts)
    np.testing.assert_allclose(fronts, wanted)
    if n > 1:  # a track that is not finite leaves the others unchanged
        state[0] = np.nan
        before = fronts.copy()
        lives.update_fronts(state, sigma, limit, beta, detections, told, fronts)
        lives.update_fronts(state[1:], sigma[1:], limit[1:], beta[1:], detections, told, before[1:])
        np.testing.assert_array_equal(fronts[1:], before[1:])


def test_a_copy_of_a_tracker_goes_its_own_way() -> None:
    tracker = Tracker()
    for each, label in ((copy.copy(tracker), "tram"), (tracker, "bus"), (copy.deepcopy(tracker), "tram")):
        assert each.update([box(label, 10.0, 0.0, score=0.99)], 0.0, STANDING).labels == [label]


def test_tracks_name_their_detections() -> None:
    tracker = Tracker()
    boxes = [box("car", 30.0, 9.0, score=0.99), box("car", 10.0, 0.0, score=0.99)]
    tracker.update(boxes, 0.0, STANDING)
    assert tracker.update(boxes[::-1], 0.1, STANDING).sources.tolist() == [1, 0]
    assert pickle.loads(pickle.dumps(tracker.update(boxes[:1], 0.2, STANDING), 0)).sources.tolist() == [0, -1]


def test_far_tracks_score_higher_and_coasting_ones_lower_if_the_class_says_so() -> None:
    plain = replace(PARAMETERS["car"], far_logit=0.0, coasting_logit=0.0, latest=0.0)
    logits = []
    for changed in ({}, {"far_logit": 0.6}, {"coasting_logit": 0.4}, {"latest": 0.5}):
        parameters = replace(plain, **changed)
        tracker = Tracker({"car": parameters})
        for k in range(7):
            boxes = [box("car", 30.0, 0.0, score=0.99)] if k < 5 else []
            score = tracker.update(boxes, 0.1 * k, STANDING).scores[0]
        logits.append(math.log(score / (1.0 - score)))
    assert logits[1] == pytest.approx(logits[0] + 0.6, abs=0.01)  # range_m is 30 m
    assert logits[2] == pytest.approx(logits[0] - 0.8, abs=0.01)  # two scans
    # Five of seven scans, and ten doubtful ones: the mean is 5 / 17 of the last detection's log odds.
    assert logits[0] == pytest.approx(math.log(99.0) * 5 / 17, abs=0.01)
    assert logits[3] == pytest.approx(math.log(99.0) * (0.5 * 5 / 17 + 0.5), abs=0.01)


def test_labels_of_one_group_share_a_track_and_the_majority_names_it() -> None:
    tracker = Tracker()
    for k in range(9):
        tracks = tracker.update([box("van" if k % 3 else "car", 10.0, 0.0)], 0.1 * k, STANDING)
        assert len(tracks) <= 1
    assert (tracks[0].id, tracks[0].label) == (1, "van")
    tracker = Tracker()
    for k in range(5):
        tracks = tracker.update([box("tram", 10.0, 0.0), box("car", 10.0, 8.0)], 0.1 * k, STANDING)
    assert tracks.labels == ["tram", "car"]


def test_an_object_detected_as_two_classes_is_reported_once() -> None:
    tracker = Tracker()
    for k in range(6):
        boxes = [box("pedestrian", 10.0, 0.0, score=0.8), box("cyclist", 10.1, 0.0, score=0.95)]
        tracks = tracker.update(boxes, 0.1 * k, STANDING)
    assert tracks.labels == ["cyclist"]
    assert tracks.n_tentative == 1


def test_a_track_that_leaves_the_field_of_view_is_no_longer_reported() -> None:
    tracker, all_around = Tracker(field_of_view_deg=(45.0, -45.0)), Tracker()
    for k in range(8):
        boxes = [box("car", 12.0 - k, 9.0)] if k < 5 else []
        seen, reported = tracker.update(boxes, 0.1 * k, STANDING), all_around.update(boxes, 0.1 * k, STANDING)
        assert len(seen) == len(reported) == (k > 0) or k >= 5
    assert len(seen) == 0
    assert len(reported) == 1


@pytest.mark.parametrize("edges", [(220.0, 140.0), (-140.0, -220.0), (225.0, 135.0), (360.0, 0.0), (540.0, 180.0)])
def test_a_view_to_the_rear_reports_what_coasts_on_either_side(edges: tuple[float, float]) -> None:
    tracker, all_around = Tracker(field_of_view_deg=edges), Tracker()
    for k in range(8):
        boxes = [box("car", -20.0, y) for y in (-8.0, 0.0, 8.0)] if k < 7 else []
        seen, reported = tracker.update(boxes, 0.1 * k, STANDING), all_around.update(boxes, 0.1 * k, STANDING)
    assert seen.ids.tolist() == reported.ids.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    "options",
    [
        *({"field_of_view_deg": edges} for edges in [(-140.0, 140.0), (0.0, 0.0), (math.nan, 0.0), (40.0,), None]),
        *({"max_tracks": n} for n in [-1, 1.5, "9"]),
        *({"parameters": given} for given in [{"car": {"gate": 4.0}}, PARAMETERS["car"]]),
    ],
    ids=str,
)
def test_options_that_would_lose_tracks_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=rf"{next(iter(options))}(\[0\])? is "):
        Tracker(**options)


def test_crossing_pedestrians_keep_their_identities() -> None:
    tracker, rng, owners = Tracker(), np.random.default_rng(2), [set(), set()]
    for k in range(60):
        s = -3.0 + 0.1 * k
        places = np.array([[10.0 + s, s], [10.0 + s, -s]]) + rng.normal(0.0, 0.03, (2, 2))
        hidden = 28 <= k <= 32  # one stands before the other
        boxes = [box("pedestrian", *places[0], yaw=math.pi / 4)]
        boxes += [] if hidden else [box("pedestrian", *places[1], yaw=-math.pi / 4)]
        tracks = tracker.update(boxes, 0.1 * k, STANDING)
        if not 25 <= k <= 35:
            for track in tracks:
                off = np.hypot(*(places - track.box.center[:2]).T)
                assert off.min() < 0.5
                owners[int(off.argmin())].add(track.id)
    assert [len(of) for of in owners] == [1, 1]
    assert owners[0] != owners[1]


def test_two_hundred_crossing_targets_in_clutter() -> None:
    """Half of them overlooked now and then, a hundred false alarms a scan: bounded, and most keep one identity."""
    tracker = Tracker(max_tracks=500)
    owners: list[list[int]] = [[] for _ in range(200)]
    for k, (boxes, places) in enumerate(crossing(40)):
        tracks = tracker.update(boxes, 0.1 * k, STANDING)
        assert len(tracks) + tracks.n_tentative <= 500
        assert np.isfinite(tracks.boxes).all()
        if k > 10:
            off = np.hypot(*(places[:, None] - tracks.boxes[None, :, :2]).transpose(2, 0, 1))
            for j in np.flatnonzero(off.min(axis=1) < 1.0):
                owners[j].append(int(tracks.ids[off[j].argmin()]))
    kept = [max(map(of.count, of)) / 29 for of in owners if of]
    assert np.mean(kept) > 0.8
    assert len(kept) > 190


def test_memory_stays_flat() -> None:
    rng, tracker = np.random.default_rng(8), Tracker(max_tracks=64)
    sizes = []
    for k in range(250):
        boxes = [box("car", *rng.uniform(-40.0, 40.0, 2), yaw=rng.uniform(-3.0, 3.0)) for _ in range(12)]
        tracks = tracker.update(boxes, 0.1 * k)
        assert len(tracks) + tracks.n_tentative <= 64
        sizes.append(len(pickle.dumps(tracker)))  # traced memory grows by what numba keeps of its first 2,000 calls
    assert max(sizes[100:]) < 1.1 * max(sizes[:100])


BAD_BOXES = [
    replace(box("car", 10.0, 0.0), center=(math.nan, 0.0, 0.0)),
    replace(box("car", 10.0, 0.0), size=(4.0, math.inf, 1.5)),
    replace(box("car", 10.0, 0.0), size=(4.0, 0.0, 1.5)),
    replace(box("car", 10.0, 0.0), yaw=math.nan),
    replace(box("car", 10.0, 0.0), score=1.5),
    replace(box("car", 10.0, 0.0), score=math.nan),
    *(replace(box("car", 10.0, 0.0), front=front) for front in (math.nan, -0.1, 1.5, "ahead")),
    "car",
]


def same(a: edgeperc.Tracks, b: edgeperc.Tracks) -> bool:
    return a.ids.tolist() == b.ids.tolist() and np.array_equal(a.boxes, b.boxes) and np.array_equal(a.scores, b.scores)


@pytest.mark.parametrize("posed", [False, True])
def test_errors_leave_the_tracker_as_it_was(posed: bool) -> None:
    tracker, untroubled = Tracker(), Tracker()
    for k, (boxes, pose) in enumerate(drive(25)):
        given_pose = pose if posed else None
        with patch("edgeperc.tracking.tracker.Tracks", side_effect=KeyboardInterrupt), pytest.raises(KeyboardInterrupt):
            tracker.update(boxes, 0.1 * k, given_pose)
        reported = tracker.update(boxes, 0.1 * k, given_pose)
        assert same(reported, untroubled.update(boxes, 0.1 * k, given_pose))
        for bad in BAD_BOXES:
            with pytest.raises(TrackingError, match="got"):
                tracker.update([*boxes, bad], 0.1 * k + 0.05, given_pose)  # type: ignore[list-item]
        for stamp_s in (math.nan, math.inf, -math.inf, 1.7e18):
            with pytest.raises(StampError, match="got a scan at"):
                tracker.update(boxes, stamp_s, given_pose)
        with pytest.raises(TrackingError, match="unlike those before"):
            tracker.update(boxes, 0.1 * k + 0.05, None if posed else pose)
        with pytest.raises(OptionError, match=r"mounting is 1\.9; expected a Mounting"):
            tracker.update(boxes, 0.1 * k + 0.05, given_pose, mounting=1.9)  # type: ignore[arg-type]
    for no_boxes in (None, 1, [None], "box"):
        with pytest.raises(TrackingError, match=r"pass edgeperc\.Box objects"):
            Tracker().update(no_boxes, 0.0)  # type: ignore[arg-type]
    for no_time in (None, "3", [], 10**400):
        with pytest.raises(StampError, match=r"stamp_s is .*; expected the time of the scan"):
            Tracker().update([], no_time)  # type: ignore[arg-type]


def test_what_comes_out_is_the_callers() -> None:
    tracker, untroubled = Tracker(), Tracker()
    for k, (boxes, _) in enumerate(drive(12)):
        tracks = tracker.update(boxes, 0.1 * k)
        assert same(tracks, untroubled.update(boxes, 0.1 * k))
        tracks.T_world_sensor[:] = tracks.boxes[:] = tracks.ids[:] = 0
        for track in tracks:
            track.state[:] = track.covariance[:] = 0.0


def test_empty_scans_gaps_and_a_new_recording() -> None:
    tracker = Tracker()
    assert len(tracker.update([], 5.0)) == 0
    for k in range(3):
        tracks = tracker.update([box("car", 10.0, 0.0)], 5.1 + 0.1 * k)
    assert len(tracks) == 1
    with pytest.warns(UserWarning, match="the clock jumped"):
        assert len(tracker.update([], 1e6)) == 0  # days later
    assert len(tracker.update([box("car", 10.0, 0.0, score=0.99)], 1e6 + 1e-6)) == 1
    tracker.reset()
    (track,) = tracker.update([box("car", 10.0, 0.0, score=1.0)], 0.0, np.eye(4))
    assert track.id == 1
    tracker.update([box("car", 10.0, 0.0, score=0.0)], 0.1, np.eye(4))


def test_a_tracker_takes_perceptions() -> None:
    def perception(stamp_s: float | None) -> Perception:
        return Perception(5, 0, None, None, (box("car", 10.0, 0.0),), {}, {}, (), stamp_s)

    tracker = Tracker()
    assert len(tracker(perception(1.0))) == 0
    tracks = tracker(perception(1.1))
    assert tracks[0].label == tracks[-1].label == "car"
    assert [track.id for track in tracks[:1]] == [1]
    assert all(track in tracks and tracks.index(track) == k for k, track in enumerate(tracks))
    assert tracks.stamp_s == 1.1
    assert sum(tracks[0].modes.values()) == pytest.approx(1.0)
    with pytest.raises(StampError, match="no stamp_s"):
        tracker(perception(None))


@pytest.mark.filterwarnings("ignore:.*every track ended")
@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_any_boxes_at_any_times_make_finite_tracks(seed: int) -> None:
    rng, tracker, stamp_s = np.random.default_rng(seed), Tracker(), 0.0
    known: set[int] = set()
    for _ in range(15):
        stamp_s += float(10.0 ** rng.uniform(-6, 1.5))
        n = int(rng.integers(0, 8))
        boxes = [
            Box(
                str(rng.choice(["car", "van", "pedestrian", "cyclist", "dog"])),
                float(rng.random()),
                tuple(10.0 ** rng.uniform(-3, 5) * rng.normal(0.0, 1.0, 3)),
                tuple(10.0 ** rng.uniform(-2, 2, 3)),
                float(rng.uniform(-9.0, 9.0)),
            )
            for _ in range(n)
        ]
        tracks = tracker.update(boxes * int(rng.integers(1, 3)), stamp_s)
        assert np.isfinite(tracks.boxes).all()
        assert (tracks.boxes[:, 3:6] > 0.0).all()
        assert ((tracks.scores >= 0.0) & (tracks.scores <= 1.0)).all()
        assert len({*tracks.ids.tolist()}) == len(tracks)
        for track in tracks:
            assert np.isfinite(track.covariance).all()
            assert (np.linalg.eigvalsh(track.covariance) > -1e-6 * np.trace(track.covariance)).all()
        known |= {*tracks.ids.tolist()}
    assert all(name >= 1 for name in known)


@pytest.mark.parametrize(("n", "m"), [(0, 0), (1, 0), (0, 2), (5, 4), (20, 3)])
def test_shapes_hiding_and_rivals_are_those_of_the_twins(n: int, m: int) -> None:
    rng = np.random.default_rng(n + m)
    state = rng.normal(0.0, 1.0, (n, 5))
    beta, shapes, sigmas = rng.dirichlet(np.ones(m + 1), n), rng.uniform(1, 3, (m, 4)), rng.uniform(0.1, 1, (n, 4))
    shape, variance = rng.uniform(1, 3, (n, 4)), rng.uniform(0.1, 1, (n, 4))
    walk = np.array([0.1, 0.2, 0.3, 0.4])
    wanted = twins.tracking.updated_shapes(beta, shapes, sigmas, walk, shape, variance)
    lives.update_shapes(beta, shapes, sigmas, walk, shape, variance)
    for got, want in zip((shape, variance), wanted, strict=True):
        np.testing.assert_allclose(got, want)
    seen, sensor, shares = rng.random(n) < 0.7, np.array([3.0, -8.0]), np.empty(n)
    lives.fill_hidden(10.0 * state, shape, seen, sensor, shares)
    np.testing.assert_allclose(shares, twins.tracking.hidden(10.0 * state, shape, seen, sensor))
    strength, reported = rng.permutation(n).astype(float), rng.random(n) < 0.8
    wanted_rows = twins.tracking.rivals(state, shape, strength, reported)
    lives.mark_rivals(state, shape, np.argsort(-strength, kind="stable"), reported)
    assert np.flatnonzero(reported).tolist() == wanted_rows


@pytest.mark.parametrize(("n", "m"), [(0, 0), (1, 0), (0, 2), (6, 4)])
def test_births_lives_and_views_are_those_of_the_twins(n: int, m: int) -> None:
    rng = np.random.default_rng(7 * n + m)
    tracker = Tracker()
    kinds = tracker.kinds_of(["car", "pedestrian", "cyclist"])[rng.integers(0, 3, n)]
    of = tracker.class_table[kinds]
    detections, shapes = rng.normal(0.0, 9.0, (n, 3)), rng.uniform(0.5, 4.0, (n, 4))
    logits, fronts, ranges = rng.normal(0.0, 3.0, n), rng.normal(0.0, 3.0, n), rng.uniform(0.0, 60.0, n)
    born = Detections(detections, shapes, logits, fronts, kinds, of["group"].copy(), ranges, np.arange(n))
    wanted = twins.tracking.newborn(5, born, of)
    tracks = np.zeros(n, lives.TRACK)
    lives.fill_newborn(5, born, of, tracks)
    assert_same_tracks(tracks, wanted)

    for _ in range(4):
        beta = rng.dirichlet(np.full(m + 1, 0.2), n)
        seen = beta, rng.random(n), rng.normal(0.0, 3.0, m), rng.integers(0, 3, m), 0.1
        wanted = twins.tracking.lives(tracks, of, *seen)
        lives.update_lives(tracks, of, *seen)
        assert_same_tracks(tracks, wanted)

    pose = np.array([[0.8, -0.6, 0, 3.0], [0.6, 0.8, 0, -4.0], [0, 0, 1, 0], [0, 0, 0, 1]])
    reported = rng.random(n) < 0.8
    stays = reported & ((tracks["misses"] == 0) | twins.tracking.in_view(tracks, pose, 0.9, -0.7))
    lives.mark_out_of_view(tracks, pose, -0.7, 0.9 + 0.7, reported)
    assert reported.tolist() == stays.tolist()


def assert_same_tracks(tracks: np.ndarray, wanted: np.ndarray) -> None:
    for name in tracks.dtype.names:
        np.testing.assert_allclose(tracks[name], wanted[name], atol=1e-9, err_msg=name)


@pytest.mark.parametrize(
    "changes",
    [
        *({"detection": value} for value in (1.0, 0.0, math.nan, "0.8")),
        *({"memory_s": value} for value in (math.nan, -1.0, 86_400.0, math.inf)),
        *({"birth_score": 2.0}, {"along_m": 0.0}, {"gate": -1.0}, {"range_m": 0.0}, {"clutter": 0.0}),
        *({"shape_m": value} for value in ((0.1, 0.1, 0.1), (0.1, 0.1, 0.1, math.nan), 0.1)),
    ],
    ids=str,
)
def test_parameters_that_would_lose_tracks_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=rf"{next(iter(changes))}.* is .*; expected"):
        replace(PARAMETERS["car"], **changes)
