"""AB3DMOT's method, by hand."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scenes
from edgeperc import Box
from edgeperc.evaluation.ab3dmot import Ab3dmot, Settings, generalized_iou

CAR = (4.0, 2.0, 1.5)


def row(x: float, z: float = 0.0, yaw: float = 0.0) -> list[float]:
    return [x, 0.0, z, *CAR, yaw]


box = partial(scenes.box, score=0.9, size=CAR, z=0.0)


def follow(tracker: Ab3dmot, *frames: list[Box]) -> list[list[int]]:
    return [tracker.update(boxes, [2.0] * len(boxes))[0].tolist() for boxes in frames]


def test_generalized_iou_by_hand() -> None:
    a = np.array([row(0.0)])
    b = np.array([row(0.0), row(4.0), row(8.0), row(50.0), row(0.0, z=1.5), row(0.0, z=3.0), row(0.0, yaw=math.pi)])
    # Side by side: the hull is both. A gap of one length: it is half as large again. 50 m: as good as nothing.
    np.testing.assert_allclose(generalized_iou(a, b)[0], [1.0, 0.0, -1 / 3, -1.0, 0.0, -1 / 3, 1.0], atol=1e-9)
    crossed = generalized_iou(a, np.array([row(0.0, yaw=math.pi / 2)]))[0, 0]
    # Cross of two 4 x 2 boxes: 4 shared, 12 together; its hull is an octagon, 16 less four triangles of 1/2.
    assert crossed == pytest.approx(4 / 12 - 2 / 14)
    assert generalized_iou(np.zeros((0, 7)), b).shape == (0, 7)


@settings(max_examples=40)
@given(st.integers(0, 10**6))
def test_generalized_iou_has_the_hull_of_scipy(seed: int) -> None:
    spatial = pytest.importorskip("scipy.spatial")
    rng = np.random.default_rng(seed)
    a, b = rng.uniform([-2, -2, 0, 1, 1, 1, -4], [2, 2, 0, 4, 4, 2, 4], (2, 1, 7))
    corners = np.vstack([Box("x", 1.0, tuple(r[:3]), tuple(r[3:6]), r[6]).corners() for r in (a[0], b[0])])
    from edgeperc.evaluation.tracking_metrics import box_iou

    iou = box_iou(a, b)[0, 0]
    union = (a[0, 3:6].prod() + b[0, 3:6].prod()) / (1.0 + iou)
    around = spatial.ConvexHull(corners).volume * max(a[0, 5], b[0, 5])
    assert generalized_iou(a, b)[0, 0] == pytest.approx(iou - (around - union) / around, abs=1e-9)


def test_a_track_is_shown_after_its_hits_and_dies_after_its_misses() -> None:
    tracker = Ab3dmot(Settings(by_distance=False, greedy=False, least=-0.2, min_hits=3, max_age=2))
    assert follow(tracker, [], [], [], []) == [[]] * 4
    assert follow(tracker, [box(10.0)], [box(10.5)], [box(11.0)]) == [[], [], [1]]
    assert follow(tracker, [], [box(12.0)], [], [], [box(13.5)]) == [[1], [1], [1], [], []]
    early = Ab3dmot(tracker.settings)  # in the first scans every track is shown
    assert follow(early, [box(10.0)], [box(10.5)]) == [[1], [1]]


def test_state_follows_a_steady_car() -> None:
    tracker = Ab3dmot(Settings(by_distance=False, greedy=False, least=-0.2, min_hits=1, max_age=3))
    for k in range(30):  # found the wrong way round in every third scan
        ids, rows, scores, sources = tracker.update([box(10.0 + k, yaw=math.pi * (k % 3 == 0))], [float(k)])
    np.testing.assert_allclose(rows[0, :6], [39.0, 0.0, 0.0, *CAR], atol=0.05)
    assert abs(math.sin(rows[0, 6])) < 1e-6
    assert (ids.tolist(), scores.tolist(), sources.tolist()) == ([1], [29.0], [0])
    ids, rows, scores, sources = tracker.update([], [])
    assert rows[0, 0] == pytest.approx(40.0, abs=0.1)
    assert (scores.tolist(), sources.tolist()) == ([29.0], [-1])


@pytest.mark.parametrize(
    ("tracks", "found", "least", "best_sum", "greedily"),
    [
        ((0.0, 1.9), (2.0, 1.0), -1.5, [1, 0], [1, 0]),  # 1.9 takes 2; then both find a partner either way
        ((0.0, 3.0), (1.4, 4.6), -1.7, [0, 1], [0, 1]),  # 0 and 4.6 are too far apart; so are 1.4 and 3 for the sum
        ((0.0, 3.0), (2.0, 6.0), -3.5, [0, 1], [-1, 0, 1]),  # the track at 3 takes 2, and 6 is too far from 0
    ],
)
def test_greedy_takes_the_best_pair_and_the_other_the_best_sum(
    tracks: tuple[float, ...], found: tuple[float, ...], least: float, best_sum: list[int], greedily: list[int]
) -> None:
    for greedy, expected in ((False, best_sum), (True, greedily)):
        tracker = Ab3dmot(Settings(by_distance=True, greedy=greedy, least=least, min_hits=1, max_age=3))
        follow(tracker, [box(x) for x in tracks])
        assert tracker.update([box(x) for x in found], [0.0, 0.0])[3].tolist() == expected


def test_boxes_that_are_not_finite_overlap_nothing() -> None:
    assert generalized_iou(np.array([row(math.nan)]), np.array([row(0.0)]))[0, 0] <= 0.0
