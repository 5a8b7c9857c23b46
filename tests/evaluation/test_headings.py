"""Headings and predicted places of tracks against labels, by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest

from edgeperc import Tracker, Tracks
from edgeperc.evaluation.headings import COUNTS, MOTIONS, count_headings, matches, speeds
from edgeperc.evaluation.predictions import count_predictions
from edgeperc.evaluation.tracking_metrics import FrameTruth
from scenes import box

SIZE = (4.0, 2.0, 1.5)
SCANS = 30
NONE = {motion: dict.fromkeys(COUNTS, 0) for motion in MOTIONS}


car = partial(box, score=0.99, size=SIZE)


def truth_of(places: list[tuple[float, float]], ignored: bool = False) -> FrameTruth:
    boxes = np.array([[x, y, -0.9, *SIZE, 0.0] for x, y in places]).reshape(-1, 7)
    return FrameTruth(np.arange(len(places)), boxes, np.full(len(places), ignored))


def counted(count: Any, truth: Sequence[FrameTruth], tracks: Sequence[Tracks], label: str) -> Any:
    return count(truth, tracks, matches(truth, tracks, (label,), 0.25))


def driven(k: int) -> float:
    """Drives at 8 m/s for 20 scans, then stands."""
    return 10.0 + 0.8 * min(k, 20)


def test_headings_by_hand() -> None:
    """One car drives and stops, one is parked; every box is the wrong way round."""
    tracker, truth, tracks = Tracker(), [], []
    for k in range(SCANS):
        truth.append(truth_of([(driven(k), 0.0), (10.0, 6.0)]))
        tracks.append(tracker.update([car(driven(k), yaw=math.pi), car(10.0, 6.0, yaw=math.pi)], 0.1 * k, np.eye(4)))
    np.testing.assert_allclose([speed[0] for speed in speeds(truth, tracks)[:15]], 8.0)
    assert speeds(truth, tracks)[-1] == pytest.approx([0.0, 0.0])
    # The window of five scans before and after is slower than 1.5 m/s from scan 25 on: one step of 0.8 m in a second.
    moving, stopped, parked = counted(count_headings, truth, tracks, "car").values()
    assert [(each["n_boxes"], each["n_tracks"]) for each in (moving, stopped, parked)] == [(24, 1), (6, 1), (30, 1)]
    assert moving["n_right"] == moving["n_resolved"] >= 20
    assert stopped["n_right"] == stopped["n_resolved"] == 6
    assert (parked["n_resolved"], parked["n_right_of_all"]) == (0, 0)
    assert counted(count_headings, truth, tracks, "van") == NONE


def test_predictions_by_hand() -> None:
    """One car drives on a circle, others stand; the vehicle drives, too, with poses and without."""
    for posed in (True, False):
        tracker, truth, tracks = Tracker(), [], []
        for k in range(60):
            turn, pose = 0.03 * k, np.eye(4)
            pose[0, 3] = 0.5 * k
            turning = (20.0 + 30.0 * math.sin(turn) - 0.5 * k, 30.0 * (1.0 - math.cos(turn)))
            standing = [(20.0 + 6.0 * j - 0.5 * k, -8.0) for j in range(5)]
            frame = truth_of([turning, *standing])
            frame.boxes[0, 6] = turn
            truth.append(frame)
            boxes = [car(*turning, yaw=turn), *(car(*place) for place in standing)]
            tracks.append(tracker.update(boxes, 0.1 * k, pose if posed else None))
        by_time = counted(count_predictions, truth[15:], tracks[15:], "car")  # its turn rate is known
        assert [*by_time] == ["1 s", "2 s", "3 s"]
        for name, of in by_time.items():
            ahead_s = int(name[0])
            assert (of["n_objects"], of["n_predictions"]) == (1, 45 - 10 * ahead_s)
            assert of["straight_mm"] / of["n_predictions"] == pytest.approx(500.0 * 9.0 * 0.3 * ahead_s**2, rel=0.1)
            assert of["error_mm"] < 0.2 * of["straight_mm"]
    assert counted(count_predictions, truth, tracks, "van")["1 s"]["n_predictions"] == 0
    assert counted(count_predictions, [], [], "car")["3 s"]["n_objects"] == 0


def test_ignored_lonely_and_missed_objects_do_not_count() -> None:
    tracker = Tracker()
    tracks = [tracker.update([car(10.0)], 0.1 * k, np.eye(4)) for k in range(3)]
    assert counted(count_headings, [truth_of([(10.0, 0.0)], ignored=True)] * 3, tracks, "car") == NONE
    once = [truth_of([(10.0, 0.0)]), truth_of([]), truth_of([])]
    assert np.isnan(speeds(once, tracks)[0]).all()
    assert counted(count_headings, once, tracks, "car") == NONE
    assert counted(count_headings, [truth_of([(30.0, 0.0)])] * 3, tracks, "car") == NONE
    assert counted(count_headings, [], [], "car") == NONE
