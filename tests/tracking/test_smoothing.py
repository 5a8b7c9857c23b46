"""Tracks in hindsight."""

from __future__ import annotations

import math
import pickle
import warnings

import numpy as np
import pytest

import twins.tracking
from edgeperc import Box, Tracker, TrackingError, Tracks, smooth_tracks

STANDING = np.eye(4)


def car(x: float, y: float, yaw: float = 0.0, *, length: float = 4.2, label: str = "car", score: float = 0.9) -> Box:
    return Box(label, score, (x, y, -0.9), (length, 1.8, 1.5), yaw)


def curve(t: float) -> tuple[float, float, float]:
    """Place and heading of a car that drives 8 m/s, straight on at first, then on an arc."""
    turn = 0.3 * max(t - 2.0, 0.0)
    straight = min(t, 2.0) * 8.0
    return -10.0 + straight + 8.0 / 0.3 * math.sin(turn), 10.0 + 8.0 / 0.3 * (1.0 - math.cos(turn)), turn


def street(n_scans: int, seed: int = 0, step_s: float = 0.1) -> tuple[Tracker, list[Tracks]]:
    """A car on a curve and a parked one, each found in nine of ten scans, 0.3 m wrong, and what is false."""
    rng, tracker, online = np.random.default_rng(seed), Tracker(), []
    for k in range(n_scans):
        places = [place for place in (curve(step_s * k), (5.0, -6.0, 1.0)) if rng.random() < 0.9]
        boxes = [car(x + rng.normal(0.0, 0.3), y + rng.normal(0.0, 0.3), yaw) for x, y, yaw in places]
        online.append(tracker.update([*boxes, car(*rng.uniform(20.0, 60.0, 2), score=0.3)], step_s * k, STANDING))
    return tracker, online


def errors_m(recording: list[Tracks], number: int) -> np.ndarray:
    found = [(k, track) for k, tracks in enumerate(recording) for track in tracks if track.id == number]
    return np.array([math.dist(track.center[:2], curve(0.1 * k)[:2]) for k, track in found])


def test_places_come_nearer_to_the_truth() -> None:
    before, after = [], []
    for seed in range(5):
        online = street(60, seed)[1]
        (number,) = {
            track.id for tracks in online[20:] for track in tracks if track.center[1] > 0.0 and track.score > 0.6
        }
        before.append(errors_m(online, number))
        after.append(errors_m(smooth_tracks(online), number))
    assert np.concatenate(after).mean() < 0.6 * np.concatenate(before).mean()
    assert sum(map(len, after)) > sum(map(len, before))  # from its first detection on


@pytest.mark.parametrize("step_s", [0.1, 1.0])
def test_a_step_back_is_its_twin(step_s: float) -> None:
    tracker, online = street(40, step_s=step_s)
    smoothed = smooth_tracks(online)
    n_compared = 0
    for k in range(38):
        later = {int(row["id"]): row for row in smoothed[k + 1].rows}
        for mine in smoothed[k].rows:
            row = online[k].every[online[k].every["id"] == mine["id"]][0]
            if int(mine["id"]) in later:
                of, dt = tracker.class_table[0], online[k + 1].stamp_s - online[k].stamp_s
                state, covariance, z = twins.tracking.retraced(row, later[int(mine["id"])], of, dt)
                np.testing.assert_allclose(mine["state"], state, atol=1e-9)
                np.testing.assert_allclose(mine["covariance"], covariance, atol=1e-9)
                assert mine["shape"][0] == pytest.approx(z)
                assert (np.linalg.eigvalsh(mine["covariance"]) > 0.0).all()
                n_compared += 1
            else:
                np.testing.assert_array_equal(mine["state"], row["state"])
    assert n_compared > 50


def test_a_track_lasts_from_its_first_detection_to_its_last() -> None:
    """It is reported late, hidden for a while, of two classes and sizes, and of two headings."""
    tracker, online = Tracker(), []
    for k in range(24):
        is_found = 2 <= k < 8 or 12 <= k < 18
        late = {"label": "van", "length": 5.0} if k >= 14 else {}
        boxes = [car(10.0, 4.0, math.pi * (k == 3), score=0.7, **late)] if is_found else []
        online.append(tracker.update(boxes, 0.1 * k, STANDING))
    smoothed = smooth_tracks(online)
    assert [len(online[k]) for k in (3, 6, 18)] == [0, 1, 1]
    assert [len(tracks) for tracks in smoothed] == [0] * 2 + [1] * 16 + [0] * 6
    life = [tracks[0] for tracks in smoothed[2:18]]
    assert [track.coasting for track in life] == [not (k < 8 or k >= 12) for k in range(2, 18)]
    assert {(track.id, track.label) for track in life} == {(1, "car")}
    assert len({track.size for track in life}) == 1
    assert 4.2 < life[0].size[0] < 5.0
    assert all(abs(track.yaw) < 0.1 for track in life)
    for before, after in zip(online, smoothed, strict=True):
        assert (before.stamp_s, before.session) == (after.stamp_s, after.session)
        assert after.n_tentative == len(before) + before.n_tentative - len(after)


def test_what_stood_for_long_keeps_its_class_and_points_where_it_drives() -> None:
    tracker, online = Tracker(), []
    for k in range(180):
        boxes = [car(10.0 + 0.4 * max(k - 150, 0), 4.0, math.pi, label="van" if k >= 150 else "car")]
        online.append(tracker.update(boxes, 0.1 * k, STANDING))
    assert {(t.label, round(t.yaw, 1)) for tracks in smooth_tracks(online) for t in tracks} == {("car", 0.0)}


def test_what_was_never_reported_and_what_stands_in_anothers_place_stay_out() -> None:
    tracker, online = Tracker(), []
    for k in range(10):
        boxes = [car(10.0, 0.0), *([car(30.0, 5.0, score=0.3)] if k == 4 else [])]
        boxes += [car(10.1, 0.1, label="bicycle", length=1.8, score=0.6)] if k > 4 else []
        online.append(tracker.update(boxes, 0.1 * k, STANDING))
    assert [[track.label for track in tracks] for tracks in smooth_tracks(online)] == [["car"]] * 10


def test_each_session_is_smoothed_by_itself_and_late_scans_stay() -> None:
    tracker, online = Tracker(), []
    stamps = [0.0, 0.1, 0.2, 0.2, 0.3, 100.0, 100.1, 100.2, 0.0, 0.1]  # doubled, another drive, its first again
    with warnings.catch_warnings():  # each says once what became of the stamp
        warnings.simplefilter("ignore")
        for k, stamp_s in enumerate(stamps):
            online.append(tracker.update([car(10.0 + k, 0.0)], stamp_s, STANDING))
    smoothed = smooth_tracks(online)
    assert [len(tracks) for tracks in smoothed] == [1, 1, 1, 0, 1, 1, 1, 1, 1, 1]
    assert smoothed[3] is online[3]
    assert [tracks[0].id for tracks in smoothed if tracks] == [1] * 4 + [2] * 3 + [3] * 2
    alone = smooth_tracks(online[5:8])
    for tracks, wanted in zip(alone, smoothed[5:8], strict=True):
        np.testing.assert_array_equal(tracks.boxes, wanted.boxes)


def test_a_recording_may_be_empty_and_come_from_a_pickle() -> None:
    assert smooth_tracks([]) == []
    _, online = street(5)
    for tracks, again in zip(smooth_tracks(online), smooth_tracks(pickle.loads(pickle.dumps(online))), strict=True):
        np.testing.assert_array_equal(tracks.boxes, again.boxes)
    empty = Tracker().update([], 0.0)
    assert [*smooth_tracks([empty])[0]] == []


def test_what_is_no_recording_is_an_error() -> None:
    tracker, online = street(12)
    wrong = [[*online, *online], online[::-1]]
    for label, n_empty in (("car", 0), ("car", 1), ("bicycle", 1)):  # ids go on, come again, have other classes
        tracker.reset()
        found = [*[[]] * n_empty, *[[car(5.0, 5.0, label=label)]] * 3]
        wrong.append([*online, *(tracker.update(boxes, 2.0 + 0.1 * k, STANDING) for k, boxes in enumerate(found))])
    for recording in wrong:
        with pytest.raises(TrackingError, match="expected one recording"):
            smooth_tracks(recording)
    for bad in (smooth_tracks(online), [online[-1][0]], None):
        with pytest.raises(TrackingError, match="as it was"):
            smooth_tracks(bad)  # type: ignore[arg-type]
