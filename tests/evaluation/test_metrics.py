from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import scenes
from edgeperc.errors import PointsError
from edgeperc.evaluation import metrics
from edgeperc.types.perception import Box

box = partial(scenes.box, size=(4.0, 2.0, 1.5), z=-1.0)


def test_scores_of_a_table_made_by_hand() -> None:
    confusion = metrics.Confusion(("background", "car", "pedestrian", "cyclist"))
    # truth:      0  0  0  0  1  1  1  2  2  ignored
    # predicted:  0  0  0  1  1  1  0  2  1  3
    confusion.update([[0, 0, 0, 1, 1], [1, 0, 2, 1, 3]], [[0, 0, 0, 0, 1], [1, 1, 2, 2, 255]])
    assert confusion.counts.tolist() == [[3, 1, 0, 0], [1, 2, 0, 0], [0, 1, 1, 0], [0, 0, 0, 0]]
    np.testing.assert_allclose(confusion.precision(), [3 / 4, 2 / 4, 1.0, np.nan])
    np.testing.assert_allclose(confusion.recall(), [3 / 4, 2 / 3, 1 / 2, np.nan])
    np.testing.assert_allclose(confusion.iou(), [3 / 5, 2 / 5, 1 / 2, np.nan])
    assert confusion.accuracy() == pytest.approx(6 / 9)
    assert confusion.mean_iou() == pytest.approx(0.5)
    assert confusion.weighted_precision() == pytest.approx((4 * 0.75 + 3 * 0.5 + 2 * 1.0) / 9)


def test_updates_add_up_and_nothing_has_no_score() -> None:
    confusion = metrics.Confusion(("a", "b"))
    assert math.isnan(confusion.accuracy())
    assert np.isnan(confusion.iou()).all()
    assert math.isnan(confusion.mean_iou())
    assert math.isnan(confusion.weighted_precision())
    confusion.update(np.zeros(0, dtype=np.uint8), np.zeros(0, dtype=np.uint8))
    confusion.update(np.uint8([1, 1, 0]), np.uint8([1, 0, 255]))
    confusion.update(np.int64([1]), np.uint8([1]))
    assert confusion.counts.tolist() == [[0, 1], [0, 2]]
    # "a" occurs and was never predicted: no precision, but a recall and an IoU of 0.
    np.testing.assert_allclose(confusion.precision(), [np.nan, 2 / 3])
    np.testing.assert_allclose(confusion.recall(), [0.0, 1.0])
    np.testing.assert_allclose(confusion.iou(), [0.0, 2 / 3])


@given(st.lists(st.tuples(st.integers(0, 3), st.sampled_from([0, 1, 2, 3, 255])), max_size=40))
def test_scores_are_those_of_sets(pairs: list[tuple[int, int]]) -> None:
    confusion = metrics.Confusion("abcd")
    predicted, truth = np.array(pairs, dtype=np.uint8).reshape(-1, 2).T
    confusion.update(predicted, truth)
    for k in range(4):
        p = {i for i, (a, b) in enumerate(pairs) if a == k and b != 255}
        g = {i for i, (a, b) in enumerate(pairs) if b == k}
        expected = len(p & g) / len(p | g) if p | g else math.nan
        np.testing.assert_allclose(confusion.iou()[k], expected)


def test_labels_that_cannot_be_counted_raise() -> None:
    confusion = metrics.Confusion(("a", "b"))
    with pytest.raises(PointsError, match=r"\(2,\) and truth \(3,\)"):
        confusion.update([0, 0], [0, 0, 0])
    with pytest.raises(PointsError, match=r"predicted labels from 0 to 2; expected 0\.\.1"):
        confusion.update([0, 2], [0, 1])
    with pytest.raises(PointsError, match="truth labels from -1"):
        confusion.update([0, 1], [-1, 1])
    assert confusion.counts.sum() == 0


def test_coarser_classes() -> None:
    confusion = metrics.Confusion(("other", "road", "car", "van"))
    confusion.update([0, 1, 2, 3, 2, 3, 1], [0, 0, 2, 2, 3, 1, 1])
    coarse = confusion.merged({"ground": ["other", "road"], "vehicle": ["car", "van"]})
    assert coarse.classes == ("ground", "vehicle")
    assert coarse.counts.tolist() == [[3, 1], [0, 3]]
    assert confusion.merged({"vehicle": ["van", "car"]}).counts.tolist() == [[3]]
    with pytest.raises(PointsError, match="expected the same classes"):
        confusion + coarse


def eleven_points(scores: Sequence[float], hits: Sequence[bool], n_truth: int) -> float:
    """As SSADNet's appendix has it, at each threshold of the score."""
    taken = np.array(scores) >= np.array(scores)[:, None]
    found = (taken & np.array(hits)).sum(axis=1)
    precision = found / taken.sum(axis=1)
    return np.mean([max(precision[found * 10 >= step * n_truth], default=0.0) for step in range(11)])


@given(st.lists(st.tuples(st.sampled_from([0.2, 0.5, 0.9]), st.booleans()), min_size=1), st.integers(0, 5))
def test_average_precision_is_what_its_definition_says(predictions: list[tuple[float, bool]], n_missed: int) -> None:
    scores, hits = zip(*predictions, strict=True)
    n_truth = sum(hits) + n_missed
    if n_truth:
        assert metrics.average_precision(scores, hits, n_truth) == pytest.approx(eleven_points(scores, hits, n_truth))


def test_average_precision_by_hand() -> None:
    # Precision after each: 1, 1/2, 2/3, 3/4, 3/5; recall 1/4, 1/4, 1/2, 3/4, 3/4.
    scores, hits = [0.9, 0.8, 0.7, 0.6, 0.5], [True, False, True, True, False]
    expected = (3 * 1.0 + 5 * 0.75) / 11  # recalls 0, .1, .2 reach 1; .3 to .7 reach 3/4; .8 to 1 nothing
    assert metrics.average_precision(scores, hits, 4) == pytest.approx(expected)
    shuffled = [3, 0, 4, 2, 1]
    again = metrics.average_precision([scores[k] for k in shuffled], [hits[k] for k in shuffled], 4)
    assert again == pytest.approx(expected)


def test_average_precision_at_its_ends() -> None:
    assert metrics.average_precision([0.5, 0.4], [True, True], 2) == 1.0
    assert metrics.average_precision([0.5, 0.4], [False, False], 2) == 0.0
    assert metrics.average_precision([], [], 3) == 0.0
    assert math.isnan(metrics.average_precision([0.5], [False], 0))
    # A recall of exactly 0.3 counts for the four levels 0 to 0.3, whatever 0.1 * 3 rounds to.
    assert metrics.average_precision([0.9, 0.8, 0.7], [True] * 3, 10) == pytest.approx(4 / 11)
    # Of equal scores none is the better.
    assert metrics.average_precision([0.5, 0.5], [True, False], 1) == 0.5
    assert metrics.average_precision([0.5, 0.5], [False, True], 1) == 0.5


def test_sweep_by_hand() -> None:
    sweep = metrics.ProbabilitySweep()
    assert math.isnan(sweep.max_f1())
    assert math.isnan(sweep.average_precision())
    sweep.update([0.9, 0.8, 0.7, 0.6], [True, False, True, False])
    # Taken from above: 1 of 1, 1 of 2, 2 of 3, 2 of 4; there are 2.
    assert sweep.max_f1() == pytest.approx(2 * 2 / (3 + 2))
    assert sweep.average_precision() == pytest.approx((6 * 1.0 + 5 * 2 / 3) / 11)
    other = metrics.ProbabilitySweep()
    other.update([[1.0, 0.0]], [[False, True]])
    both = sweep + other
    assert both.counts.sum() == 6
    assert both.counts[0, 255] == both.counts[1, 0] == 1
    # From above, with 3 to find: 0 of 1, 1 of 2, 1 of 3, 2 of 4, 2 of 5, and everything: 3 of 6.
    assert both.max_f1() == pytest.approx(2 * 3 / (6 + 3))
    assert both.average_precision() == pytest.approx(0.5)


@given(st.lists(st.tuples(st.integers(0, 255), st.booleans()), min_size=1, max_size=30))
def test_sweep_takes_the_best_threshold(cells: list[tuple[int, bool]]) -> None:
    level, truth = np.array(cells).T
    truth = truth.astype(bool)
    sweep = metrics.ProbabilitySweep()
    sweep.update(level / 255, truth)
    if truth.any():
        f1 = [2 * (truth & (level >= t)).sum() / ((level >= t).sum() + truth.sum()) for t in range(256)]
        assert sweep.max_f1() == pytest.approx(max(f1))


def test_boxes_by_hand() -> None:
    evaluator = metrics.BoxEvaluator(0.5)
    truth = [box(10.0, 0.0), box(20.0, 0.0), box(30.0, 5.0, "van")]
    predicted = [
        box(10.5, 0.0, score=0.9),  # 3.5 of 4.5 m: IoU 7/9
        box(20.0, 0.5, score=0.8),  # 1.5 of 2.5 m: 3/5
        box(20.0, 0.0, score=0.7),  # the truth is taken
        box(30.0, 5.0, "car", score=0.6),  # a van, called a car
        box(40.0, -5.0, "truck", score=0.5),  # nothing there
    ]
    evaluator.update(predicted, truth)
    everything = evaluator.overall()
    assert (everything.n_truth, everything.n_predicted, everything.n_hits) == (3, 5, 3)
    assert everything.precision == pytest.approx(3 / 5)
    assert everything.recall == pytest.approx(1.0)
    assert everything.mean_iou_50 == pytest.approx((7 / 9 + 3 / 5 + 1.0) / 3)
    assert everything.mean_iou_70 == pytest.approx((7 / 9 + 1.0) / 2)
    # Precision at recalls 1/3, 2/3, 1: 1, 1, 3/4.
    assert everything.ap == pytest.approx((7 * 1.0 + 4 * 0.75) / 11)
    scores = evaluator.per_class()
    assert set(scores) == {"car", "van", "truck"}
    assert (scores["car"].n_truth, scores["car"].n_predicted, scores["car"].n_hits) == (2, 4, 2)
    assert scores["car"].ap == 1.0
    assert scores["van"].ap == 0.0
    assert math.isnan(scores["van"].precision)
    assert math.isnan(scores["truck"].ap)
    assert scores["truck"].precision == 0.0


def test_scans_add_up_and_do_not_mix() -> None:
    evaluator = metrics.BoxEvaluator()
    evaluator.update([box(10.0, 0.0, score=0.3)], [])
    evaluator.update([], [box(10.0, 0.0)])
    scores = evaluator.overall()
    assert (scores.n_truth, scores.n_predicted, scores.n_hits) == (1, 1, 0)
    assert scores.ap == scores.precision == scores.recall == 0.0
    assert math.isnan(scores.mean_iou_50)
    empty = metrics.BoxEvaluator()
    empty.update([], [])
    assert empty.per_class() == {}
    assert math.isnan(empty.overall().ap)


def test_boxes_by_range() -> None:
    evaluator = metrics.BoxEvaluator()
    truth = [box(10.0, 0.0), box(28.0, 0.0), box(40.0, 0.0)]
    predicted = [box(10.0, 0.0, score=0.9), box(28.5, 0.0, score=0.8), box(12.0, 5.0, score=0.7)]
    pairs = evaluator.update(predicted, truth)
    assert pairs == [(predicted[0], truth[0]), (predicted[1], truth[1]), (predicted[2], None), (None, truth[2])]
    counts = [(s.n_truth, s.n_predicted, s.n_hits) for s in map(evaluator.overall, ((0, 15), (15, 28.2), (28.2, 50)))]
    assert counts == [(1, 2, 1), (1, 1, 1), (1, 0, 0)]
    assert evaluator.per_class((0, 15))["car"].precision == 0.5
    assert evaluator.per_class((15, 28.2))["car"].ap == 1.0
    assert math.isnan(evaluator.per_class((50, 60))["car"].ap)
    # A box is as far as its truth: this one lies beyond 28.2 m, and is a hit of the band before.
    assert evaluator.overall((28.2, 28.6)).n_predicted == 0


def test_what_is_excused_is_in_no_pair() -> None:
    evaluator = metrics.BoxEvaluator()
    assert evaluator.update([box(20.0, 0.0)], [], ignored=[box(20.0, 0.0)]) == []


SOME_BOXES = st.lists(
    st.tuples(st.integers(0, 20), st.integers(0, 3), st.sampled_from(["car", "van"]), st.sampled_from([0.2, 0.5, 0.9])),
    max_size=4,
)


@given(st.lists(st.tuples(SOME_BOXES, SOME_BOXES), min_size=2, max_size=4), st.integers(1, 3), st.booleans())
def test_evaluators_put_together_say_what_one_says(
    scans: list[tuple[list[Box], list[Box]]], split: int, oriented: bool
) -> None:
    whole, first, second = (metrics.BoxEvaluator(oriented=oriented) for _ in range(3))
    for k, (predicted, truth) in enumerate(scans):
        scan = [box(*each) for each in predicted], [box(*each) for each in truth]
        whole.update(*scan)
        (first if k < split else second).update(*scan)
    both = first + second
    for within_m in ((0.0, math.inf), (5.0, 12.0)):
        assert repr(both.per_class(within_m)) == repr(whole.per_class(within_m))  # NaN is not equal to itself
        assert repr(both.overall(within_m)) == repr(whole.overall(within_m))


def test_overall_puts_together_what_it_is_told_to() -> None:
    truth = [box(10.0, 0.0, "van"), box(20.0, 0.0, "pedestrian"), box(30.0, 0.0, "car")]
    evaluator = metrics.BoxEvaluator(0.5, together=("car", "van"))
    pairs = evaluator.update([box(10.0, 0.0), box(20.0, 0.0), box(30.0, 0.0, "pedestrian")], truth)
    assert [(guess is not None, right is not None) for guess, right in pairs] == [(True, True)] * 3
    for scores in (evaluator.overall(), (evaluator + metrics.BoxEvaluator(0.5, together=("car", "van"))).overall()):
        assert (scores.n_truth, scores.n_predicted, scores.n_hits) == (2, 2, 1)


def test_better_scores_choose_first_and_take_what_fits_best() -> None:
    truth = [box(10.0, 0.0), box(11.0, 0.0)]
    evaluator = metrics.BoxEvaluator(0.5)
    # Listed worst first. The better prediction overlaps both; it takes the nearer, and leaves the other.
    evaluator.update([box(10.1, 0.0, score=0.2), box(10.8, 0.0, score=0.9)], truth)
    assert evaluator.overall().n_hits == 2
    assert evaluator.overall().mean_iou_50 == pytest.approx((3.8 / 4.2 + 3.9 / 4.1) / 2)


def test_ignored_boxes_make_neither_right_nor_wrong() -> None:
    evaluator = metrics.BoxEvaluator(0.5)
    evaluator.update(
        [
            box(10.0, 0.0, score=0.9),
            box(20.0, 0.0, score=0.8),  # an ignored object
            box(20.0, 0.3, "van", score=0.7),  # on the same, of another class
            box(33.0, 0.0, score=0.5),
        ],
        [box(10.0, 0.0)],
        ignored=[box(20.0, 0.0)],
    )
    scores = evaluator.overall()
    assert (scores.n_truth, scores.n_predicted, scores.n_hits) == (1, 2, 1)
    # A truth is taken before an ignored box is thought of.
    close = metrics.BoxEvaluator(0.5)
    close.update([box(10.0, 0.0)], [box(10.5, 0.0)], ignored=[box(10.0, 0.0)])
    assert close.overall().n_hits == 1


def test_axis_aligned_bounds_are_what_the_paper_compares() -> None:
    turned = [box(10.0, 0.0, yaw=math.pi / 4.0)]
    other = [box(10.0, 0.0, yaw=-math.pi / 4.0)]
    oriented, aligned = metrics.BoxEvaluator(0.5), metrics.BoxEvaluator(0.5, oriented=False)
    oriented.update(other, turned)
    aligned.update(other, turned)
    assert oriented.overall().n_hits == 0  # two bars that cross: 4 of 12 m2
    assert aligned.overall().mean_iou_50 == pytest.approx(1.0)
    # Front and rear are the same footprint.
    oriented.update([box(10.0, 0.0, yaw=-3.0 * math.pi / 4.0)], turned)
    assert oriented.overall().n_hits == 1


def test_headings_by_hand() -> None:
    square = {"size": (2.0, 2.0, 1.5)}
    truth = [box(10.0 * k, 0.0, yaw=yaw, **square) for k, yaw in enumerate((0.0, 0.0, 0.0, 3.1, 0.0))]
    predicted = [
        box(0.0, 0.0, yaw=0.7, **square),  # 40 degrees
        box(10.0, 0.0, yaw=math.pi, **square),  # front for rear
        box(20.0, 0.0, yaw=-math.pi / 2, **square),  # across
        box(30.0, 0.0, yaw=-3.1, **square),  # 5 degrees, beyond half a turn
        box(99.0, 0.0, **square),  # no match
        box(40.0, 0.0, yaw=math.nan, **square),  # overlaps nothing
    ]
    evaluator = metrics.BoxEvaluator()
    evaluator.update(predicted, truth)
    scores = evaluator.overall()
    assert (scores.n_hits, scores.heading, scores.axis, scores.front_known) == (4, 2 / 4, 3 / 4, 0.0)
    known = metrics.BoxEvaluator()
    known.update([replace(predicted[0], front=0.9), predicted[1], replace(predicted[4], front=0.9)], truth)
    assert known.overall().front_known == 1 / 2
    near = evaluator.per_class((0.0, 15.0))["car"]
    assert (near.n_hits, near.heading, near.axis) == (2, 1 / 2, 1.0)
    nobody = evaluator.overall((50.0, 60.0))
    assert nobody.n_hits == nobody.n_found == 0
    assert math.isnan(nobody.heading)
    assert math.isnan(nobody.axis)


@given(st.lists(st.tuples(st.integers(-700, 700), st.integers(-700, 700)), max_size=5))
def test_headings_are_those_of_unit_vectors(degrees: list[tuple[int, int]]) -> None:
    side = {"size": (2.0, 2.0, 1.5)}
    degrees = [(a, b) for a, b in degrees if (a - b) % 90 != 45]  # exactly 45 degrees depends on rounding
    truth = [box(10.0 * k, 0.0, yaw=math.radians(b), **side) for k, (_, b) in enumerate(degrees)]
    evaluator = metrics.BoxEvaluator()
    evaluator.update([box(10.0 * k, 0.0, yaw=math.radians(a), **side) for k, (a, _) in enumerate(degrees)], truth)
    cosines = np.cos(np.radians([a - b for a, b in degrees]))
    scores = evaluator.overall()
    assert scores.n_hits == len(degrees)  # a turned square shares at least 2 (sqrt 2 - 1) of 4 - that with itself
    if degrees:
        assert scores.heading == pytest.approx(np.mean(cosines > math.sqrt(0.5)))
        assert scores.axis == pytest.approx(np.mean(np.abs(cosines) > math.sqrt(0.5)))


def test_an_object_counts_once_a_drive() -> None:
    evaluator = metrics.BoxEvaluator()
    one, other = box(10.0, 0.0, size=(4.123, 2.0, 1.5)), box(30.0, 0.0, size=(4.13, 2.0, 1.5))
    moved = box(14.0, 3.0, size=(4.1249, 2.0, 1.5), yaw=0.4)
    assert metrics.object_key("a", one) == metrics.object_key("a", moved) == ("a", "car", 4.12, 2.0, 1.5)
    assert metrics.object_key("a", one) != metrics.object_key("a", other)
    assert metrics.object_key("a", one) != metrics.object_key("b", one)
    evaluator.update([one], [one, other], drive="a")
    evaluator.update([moved], [moved], drive="a")
    evaluator.update([], [one], drive="b")
    scores = evaluator.overall()
    assert (scores.n_truth, scores.n_objects, scores.n_drives) == (4, 3, 2)
    assert (scores.n_hits, scores.n_found) == (2, 1)
    both = (evaluator + evaluator).per_class()["car"]
    assert (both.n_truth, both.n_objects, both.n_drives, both.n_hits, both.n_found) == (8, 3, 2, 4, 1)
    far = evaluator.overall((20.0, 40.0))
    assert (far.n_truth, far.n_objects, far.n_drives, far.n_found) == (1, 1, 1, 0)


def test_a_mean_leaves_nan_out() -> None:
    assert metrics.mean([0.5, math.nan, 1.0]) == 0.75
    assert math.isnan(metrics.mean([]))
    assert math.isnan(metrics.mean([math.nan]))
