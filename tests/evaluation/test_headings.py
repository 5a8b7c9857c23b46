"""Headings of tracks against labels, by hand."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest

from edgeperc import Tracker
from edgeperc.evaluation.headings import Headings, Standing, count_headings, speeds
from edgeperc.evaluation.tracking_metrics import FrameTruth
from scenes import box

SIZE = (4.0, 2.0, 1.5)
SCANS = 30


car = partial(box, score=0.99, size=SIZE)


def truth_of(places: list[tuple[float, float]], ignored: bool = False) -> FrameTruth:
    boxes = np.array([[x, y, -0.9, *SIZE, 0.0] for x, y in places]).reshape(-1, 7)
    return FrameTruth(np.arange(len(places)), boxes, np.full(len(places), ignored))


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
    found = count_headings(truth, tracks, ("car",), 0.25)
    # The window of five scans before and after is slower than 1.5 m/s from scan 25 on: one step of 0.8 m in a second.
    assert (found.moving.n_boxes, found.stopped.n_boxes, found.parked.n_boxes) == (24, 6, 30)
    assert found.moving.n_tracks == found.stopped.n_tracks == found.parked.n_tracks == 1
    assert found.moving.n_right == found.moving.n_resolved >= 20
    assert found.stopped.n_right == found.stopped.n_resolved == 6
    assert (found.parked.n_resolved, found.parked.n_right_of_all) == (0, 0)
    assert (found + found).moving.n_boxes == 48
    assert count_headings(truth, tracks, ("van",), 0.25) == Headings()


def test_ignored_lonely_and_missed_objects_do_not_count() -> None:
    tracker = Tracker()
    tracks = [tracker.update([car(10.0)], 0.1 * k, np.eye(4)) for k in range(3)]
    assert count_headings([truth_of([(10.0, 0.0)], ignored=True)] * 3, tracks, ("car",), 0.25) == Headings()
    once = [truth_of([(10.0, 0.0)]), truth_of([]), truth_of([])]
    assert np.isnan(speeds(once, tracks)[0]).all()
    assert count_headings(once, tracks, ("car",), 0.25) == Headings()
    assert count_headings([truth_of([(30.0, 0.0)])] * 3, tracks, ("car",), 0.25) == Headings()
    assert count_headings([], [], ("car",), 0.25) == Headings(Standing(), Standing(), Standing())
