"""The figures of tracking: by hand, against twins and motmetrics."""

from __future__ import annotations

import itertools
import math
import operator
from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import twins.kitti_ap
import twins.tracking
from edgeperc import TrackingError
from edgeperc.evaluation.tracking_metrics import (
    FrameTracks,
    FrameTruth,
    TrackingScores,
    box_iou,
    count_breaks,
    evaluate_tracks,
    fill_assignment,
    fill_pairs,
    recall_thresholds,
)


def row(x: float, y: float = 0.0) -> list[float]:
    return [x, y, 0.0, 4.0, 2.0, 1.5, 0.0]


def truth_of(*objects: tuple[int, float], ignored: tuple[int, ...] = ()) -> FrameTruth:
    ids = np.array([name for name, _ in objects], np.int64)
    boxes = np.array([row(x) for _, x in objects]).reshape(-1, 7)
    return FrameTruth(ids, boxes, np.isin(ids, ignored))


def tracks_of(*objects: tuple[int, float], score: float = 0.9, excused: tuple[int, ...] = ()) -> FrameTracks:
    ids = np.array([name for name, _ in objects], np.int64)
    boxes = np.array([row(x) for _, x in objects]).reshape(-1, 7)
    return FrameTracks(ids, boxes, np.full(len(ids), score), np.isin(ids, excused))


def test_box_iou() -> None:
    a = [row(0.0), [0.0, 0.0, 0.75, 4.0, 2.0, 1.5, 0.0], [0.0, 0.0, 0.0, 4.0, 2.0, 1.5, math.pi]]
    iou = box_iou(a, [row(0.0), row(2.0), row(9.0), [math.nan] * 7])
    np.testing.assert_allclose(iou[0], [1.0, 1.0 / 3.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(iou[1, 0], 0.5 / 1.5)
    np.testing.assert_allclose(iou[2], iou[0], atol=1e-9)
    assert box_iou(np.zeros((0, 7)), a).shape == (0, 3)


@settings(max_examples=60)
@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 10**6))
def test_assignment_gains_the_most(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    gain = rng.random((n, m)) * (rng.random((n, m)) < 0.7)
    column = np.empty(n, np.int64)
    fill_assignment(gain, column)
    made = np.flatnonzero(column >= 0)
    assert len({*column[made].tolist()}) == len(made)
    assert (gain[made, column[made]] > 0.0).all()
    assert gain[made, column[made]].sum() == pytest.approx(twins.tracking.best_gain(gain))
    frames = [gain, gain.T, gain[:1], gain[:, :1]]
    pair = np.empty(sum(len(each) for each in frames), np.int64)
    gains = np.concatenate([each.ravel() for each in frames])
    fill_pairs(np.array([each.shape for each in frames]), gains, pair)
    pairs, begun = iter(pair.tolist()), 0
    for each in frames:
        own = [k for k in itertools.islice(pairs, len(each)) if k >= 0]
        assert all(begun <= k < begun + each.size for k in own)
        assert gains[own].sum() == pytest.approx(twins.tracking.best_gain(each))
        begun += each.size


def test_gains_that_are_not_finite_or_not_positive_make_no_pair() -> None:
    gain = np.array([[np.nan, 0.5], [-1.0, np.nan]])
    column = np.empty(2, np.int64)
    fill_assignment(gain, column)
    assert column.tolist() == [1, -1]
    assert twins.tracking.best_gain(np.maximum(np.nan_to_num(gain), 0.0)) == 0.5


def test_pairs_are_made_within_a_frame() -> None:
    gain = np.array([[0.3, 0.0], [0.9, 0.3], [0.0, 0.2]])
    pair = np.empty(5, np.int64)
    fill_pairs(np.array([[3, 2], [1, 0], [0, 4], [1, 1]]), np.array([*gain.ravel(), 0.5]), pair)
    assert pair.tolist() == [-1, 2, 5, -1, 6]


def test_matches_are_as_many_as_can_be() -> None:
    """The best pair of all would leave the other box and the other track with nothing."""
    truth = truth_of((1, 0.0), (2, 2.0))
    tracks = tracks_of((5, 1.2), (6, 3.9))
    iou = box_iou(truth.boxes, tracks.boxes)
    assert iou[1, 0] > max(iou[0, 0], iou[1, 1]) > 0.25 > iou[0, 1]
    best = evaluate_tracks([([truth] * 3, [tracks] * 3)]).best
    assert (best.n_found, best.n_missed, best.n_false) == (6, 0, 0)
    assert best.motp == pytest.approx((iou[0, 0] + iou[1, 1]) / 2.0)


@settings(max_examples=100)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(-1, 2), st.booleans()), max_size=30))
def test_breaks_are_counted_as_the_twin_does(frames: list[tuple[int, int, bool]]) -> None:
    truth, ids = (np.array([frame[k] for frame in frames], np.int64) for k in (0, 1))
    ignored = np.array([frame[2] for frame in frames], bool)
    for late in (False, True):
        assert count_breaks(truth, ids, ignored, late) == twins.tracking.breaks(truth, ids, ignored, late)


def test_breaks_by_hand() -> None:
    def count(ids: list[int], ignored: tuple[int, ...] = (), late: bool = False) -> tuple[int, int]:
        hidden = np.isin(np.arange(len(ids)), ignored)
        return count_breaks(np.zeros(len(ids), np.int64), np.array(ids), hidden, late)

    assert count([1, 1, 1, 1]) == (0, 0)
    assert count([1, 1, 2, 2]) == (1, 1)
    assert count([1, 1, -1, 1, 1]) == (0, 1)  # lost and taken up again
    assert count([1, 1, -1, 2, 2]) == (0, 1)
    assert count([1, 1, -1, -1]) == (0, 0)
    assert count([1, 1, 2, 2], ignored=(1,)) == (0, 0)  # an ignored box makes a new beginning
    assert count([-1, -1, 1]) == (0, 0)
    assert count([-1, -1, 1], late=True) == (0, 1)  # first found in the last frame
    assert count([-1, 1, 1], late=True) == (0, 0)
    assert count([1, 1, 2], late=True) == count([1, 1, 2]) == (1, 1)


@settings(max_examples=100)
@given(st.lists(st.floats(-5.0, 5.0), max_size=120), st.integers(0, 40))
def test_recall_thresholds_are_those_of_kittis_walk(scores: list[float], n_missed: int) -> None:
    """Rounding decides between two ranks at the same distance, as in KITTI's program, which adds up recalls."""
    thresholds, recalls = recall_thresholds(scores, len(scores) + n_missed)
    assert thresholds.tolist() == twins.kitti_ap.get_thresholds(scores, len(scores) + n_missed)[1:]
    np.testing.assert_allclose(recalls, np.arange(1, len(thresholds) + 1) / 40)


def test_a_perfect_tracker_has_full_marks() -> None:
    frames = [truth_of((1, k), (2, 20.0 + k)) for k in range(50)]
    tracks = [tracks_of((7, k), (8, 20.0 + k)) for k in range(50)]
    scores = evaluate_tracks([(frames, tracks)])
    assert (scores.best.mota, scores.best.motp, scores.samota) == pytest.approx((1.0, 1.0, 1.0))
    assert (scores.hota.hota, scores.hota.deta, scores.hota.assa) == pytest.approx((1.0, 1.0, 1.0))
    assert (scores.n_frames, scores.n_objects) == (50, 2)
    # At recall r MOTA is r, so its mean over 1/40 .. 1 is 41/80; the first two tracks enter together.
    assert scores.amotp == pytest.approx(1.0)


def test_clear_by_hand() -> None:
    """Missed, false, switched, ignored and excused boxes, counted on paper."""
    truth = [truth_of((1, 0.0), (2, 30.0), (3, 60.0), ignored=(3,)) for _ in range(10)]
    tracks = []
    for k in range(10):
        objects = [(5 if k < 5 else 6, 0.0), (7, 60.0), (8, 90.0), (9, 120.0)]  # switch, ignored, false, excused
        tracks.append(tracks_of(*objects, excused=(9,)))
    scores = evaluate_tracks([(truth, tracks)])
    best = scores.best
    assert (best.n_truth, best.n_found, best.n_false, best.n_missed) == (20, 20, 10, 10)
    assert (best.n_switches, best.n_fragments) == (1, 1)
    assert best.mota == pytest.approx(1.0 - 21.0 / 20.0)
    assert best.motp == pytest.approx(1.0)
    assert best.scaled_mota(0.5) == 0.0
    assert replace(best, n_false=1).scaled_mota(0.5) == pytest.approx(1.0 - (12.0 - 10.0) / 10.0)
    # TP 10, FN 10, FP 10; the object's ten matches fall to two tracks of five frames.
    assert scores.hota.deta == pytest.approx(1.0 / 3.0)
    assert scores.hota.assa == pytest.approx(0.5)
    assert scores.hota.hota == pytest.approx(math.sqrt(0.5 / 3.0))


def test_scores_part_good_tracks_from_bad_ones() -> None:
    truth = [truth_of((1, 0.0)) for _ in range(80)]
    good, bad = [tracks_of((5, 0.0), score=0.9)] * 80, [tracks_of((6, 50.0), score=0.3)] * 80
    both = [
        FrameTracks(*(np.concatenate([getattr(a, f), getattr(b, f)]) for f in ("ids", "boxes", "scores", "excused")))
        for a, b in zip(good, bad, strict=True)
    ]
    scores = evaluate_tracks([(truth, both)])
    assert (scores.best.mota, scores.best.n_false, scores.samota) == pytest.approx((1.0, 0, 1.0))
    assert scores.best.threshold == pytest.approx(0.9)


def test_nothing_at_all_has_no_marks() -> None:
    empty = [truth_of()] * 3, [tracks_of()] * 3
    scores = evaluate_tracks([empty])
    assert math.isnan(scores.best.mota)
    assert math.isnan(scores.hota.hota)
    assert np.isnan([scores.samota, scores.amota, scores.amotp]).all()
    ignored = [truth_of((1, 0.0), ignored=(1,))] * 9, [tracks_of((5, 0.0))] * 9
    for as_ab3dmot in (False, True):
        scores = evaluate_tracks([ignored], as_ab3dmot=as_ab3dmot)  # matches, but nothing to find
        assert np.isnan([scores.samota, scores.amota, scores.amotp, scores.best.mota]).all()
    missed = evaluate_tracks([([truth_of((1, 0.0))] * 3, [tracks_of()] * 3)])
    assert (missed.best.mota, missed.best.n_missed, missed.hota.hota) == (0.0, 3, 0.0)
    with pytest.raises(TrackingError, match="got 2 frames"):
        evaluate_tracks([([truth_of()] * 3, [tracks_of()] * 2)])


def test_ab3dmots_program_loses_a_track_at_its_own_threshold() -> None:
    """Ten times 0.3 is less than 3 in float64, and ten times the mean of that is less than it again."""

    def mean_of_ten(value: float) -> float:
        return reduce(operator.add, [value] * 10) / 10  # from Python 3.12 on, `sum` makes up for what rounding loses

    mean = mean_of_ten(0.3)
    assert mean_of_ten(mean) < mean < 0.3
    truth = [truth_of((1, 0.0))] * 10

    def evaluated(score: float, as_ab3dmot: bool) -> TrackingScores:
        return evaluate_tracks([(truth, [tracks_of((5, 0.0), score=score)] * 10)], as_ab3dmot=as_ab3dmot)

    # Ten matches make nine thresholds after recall 0, and all boxes are found at each.
    assert evaluated(0.3, False).samota == pytest.approx(9 / 40)
    assert evaluated(0.5, True).samota == pytest.approx(9 / 40)  # sums of 0.5 are exact
    lost = evaluated(0.3, True)
    assert (lost.samota, lost.amota, lost.amotp) == pytest.approx((0.0, 0.0, 0.0))
    assert lost.best.mota == 1.0  # no threshold is better than all tracks
    assert evaluated(0.3000001, True).samota == lost.samota  # six digits of each score
    assert evaluated(9.8585675, True).samota == lost.samota  # written as 9.858567, which loses; np.round gives 9.858568


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.booleans())
def test_any_tracks_have_finite_figures_or_none(seed: int, as_ab3dmot: bool) -> None:
    rng = np.random.default_rng(seed)
    truth, tracks = [], []
    for _ in range(int(rng.integers(1, 12))):
        there = [(j, 9.0 * j) for j in range(int(rng.integers(0, 4)))]
        found = [(j, 9.0 * j + rng.normal(0.0, 2.0)) for j in range(int(rng.integers(0, 4)))]
        truth.append(truth_of(*there, ignored=(2,)))
        tracks.append(tracks_of(*found, score=float(rng.normal()), excused=(1,)))
    scores = evaluate_tracks([(truth, tracks)], as_ab3dmot=as_ab3dmot)
    averages = [scores.samota, scores.amota, scores.amotp]
    assert np.isfinite(averages).all() if scores.all_tracks.n_truth else np.isnan(averages).all()
    if scores.all_tracks.n_truth:
        assert 0.0 <= scores.samota <= 1.0
        assert scores.best.n_missed >= scores.all_tracks.n_missed
        assert scores.amota <= max(scores.best.mota, 0.0) + 1e-9  # recalls that are not reached count as 0


def test_clear_agrees_with_motmetrics() -> None:
    motmetrics = pytest.importorskip("motmetrics")
    rng = np.random.default_rng(1)
    truth, tracks, theirs = [], [], motmetrics.MOTAccumulator(auto_id=True)
    for k in range(60):
        there = [(j, 12.0 * j + 0.2 * k) for j in range(5)]
        found = [(j + 10 * (k > 30 and j == 2), x + rng.normal(0.0, 0.2)) for j, x in there if rng.random() < 0.9]
        found += [(100 + k, -50.0 - 5.0 * k)] if rng.random() < 0.3 else []
        truth.append(truth_of(*there))
        tracks.append(tracks_of(*found))
        distance = 1.0 - box_iou(truth[-1].boxes, tracks[-1].boxes)
        theirs.update(truth[-1].ids, tracks[-1].ids, np.where(distance <= 0.75, distance, np.nan))
    wanted = motmetrics.metrics.create().compute(
        theirs, metrics=["num_false_positives", "num_misses", "num_switches", "motp"], name="all"
    )
    ours = evaluate_tracks([(truth, tracks)]).best
    assert ours.n_false == wanted["num_false_positives"]["all"]
    assert ours.n_missed == wanted["num_misses"]["all"]
    assert wanted["num_switches"]["all"] == 1
    assert ours.motp == pytest.approx(1.0 - wanted["motp"]["all"])


@pytest.mark.parametrize("score", [0.1, 0.7, 0.9, 0.95])
def test_tracks_of_one_score_stay_together(score: float) -> None:
    """The mean of 0.9 over three frames is rounded above it: tracks were ordered by their lengths."""
    frames = [[(name, 10.0 * name) for name in range(12) if frame < 3 + name] for frame in range(20)]
    tracks = [tracks_of(*objects, score=score) for objects in frames]
    assert evaluate_tracks([([truth_of(*objects) for objects in frames], tracks)]).amota == pytest.approx(1.0)
