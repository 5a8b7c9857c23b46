"""Average precision by the distance of centers: scenes made by hand, and nuScenes' steps on random scenes."""

from __future__ import annotations

import math
import random
from dataclasses import astuple, replace
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgeperc.evaluation.center_ap import CLASSES, center_scores, count_centers
from edgeperc.evaluation.metrics import BoxEvaluator, Listed
from edgeperc.types.perception import Box
from scenes import box
from twins import center_ap as twin

car = partial(box, size=(4.0, 2.0, 1.5))


def table_of(*scans: tuple[list[Box], list[Box]], ignored: tuple[Box, ...] = ()) -> Listed:
    table = Listed()
    for k, (rights, guesses) in enumerate(scans):
        table += count_centers(guesses, rights, ignored, f"drive {k}")
    return table


def test_perfect_boxes_have_a_precision_of_one_and_no_errors() -> None:
    cars = [car(10.0 + 5.0 * k) for k in range(6)]
    assert center_scores(table_of((cars, cars)), "car") == pytest.approx(
        {"ap": 1.0, "ap_0.5": 1.0, "ap_1": 1.0, "ap_2": 1.0, "ap_4": 1.0, "ate": 0.0, "ase": 0.0, "aoe": 0.0}
    )


def test_shifted_boxes_match_from_their_distance_on() -> None:
    cars = [car(10.0 + 9.0 * k) for k in range(4)]
    guesses = [replace(c, center=(c.center[0], 1.5, -1.0), size=(4.0, 2.0, 3.0), yaw=math.pi / 2) for c in cars]
    scores = center_scores(table_of((cars, guesses)), "car")
    assert [scores[f"ap_{d}"] for d in ("0.5", "1", "2", "4")] == [0.0, 0.0, pytest.approx(1.0), pytest.approx(1.0)]
    assert scores["ap"] == pytest.approx(0.5)
    assert (scores["ate"], scores["ase"], scores["aoe"]) == pytest.approx((1.5, 0.5, math.pi / 2))


def test_ignored_and_unknown_objects_excuse_a_detection_near_them() -> None:
    cars, few, unknown = [car(10.0)], car(20.0), car(30.0, label="ignore")
    guesses = [car(10.0), car(20.5), car(30.5), car(40.0)]
    table = table_of((cars, guesses), ignored=(few, unknown))
    assert [hit for _, hit, *_ in table["car", 2.0]] == [True, False]
    assert len(table["car"]) == 1


def test_objects_and_detections_beyond_the_range_of_the_class_do_not_count() -> None:
    table = table_of(([car(51.0), car(10.0)], [car(51.0), car(52.0)]))
    assert len(table["car"]) == 1
    assert table["car", 4.0] == ()


def test_without_objects_there_are_no_scores_and_without_hits_errors_are_one() -> None:
    assert all(math.isnan(v) for v in center_scores(table_of(([], [car(10.0)])), "car").values())
    scores = center_scores(table_of(([car(10.0)], [])), "car")
    assert (scores["ap"], scores["ate"], scores["ase"], scores["aoe"]) == (0.0, 1.0, 1.0, 1.0)


@st.composite
def scans(draw: st.DrawFn) -> tuple[list[Box], list[Box]]:
    rights, guesses = [], []
    for _ in range(draw(st.integers(0, 6))):
        label, x, y = draw(st.sampled_from(["car", "pedestrian"])), draw(st.floats(2, 55)), draw(st.floats(-9, 9))
        right = car(x, y, yaw=draw(st.floats(-3.1, 3.1)), label=label)
        rights.append(right)
        for _ in range(draw(st.integers(0, 2))):
            dx, dy, turn = (draw(st.floats(-2.5, 2.5)) for _ in range(3))
            size = (4.0 + 0.5 * dx, 2.0, 1.5)
            guess = replace(right, center=(x + dx, y + dy, -1.0), size=size, yaw=right.yaw + turn)
            guesses.append(replace(guess, score=draw(st.integers(1, 50)) / 50))
    return rights, guesses


@settings(max_examples=60)
@given(st.lists(scans(), min_size=1, max_size=4))
def test_the_steps_of_nuscenes_give_the_same_numbers(given_scans: list[tuple[list[Box], list[Box]]]) -> None:
    # Scores apart: where they are equal, its numbers depend on the order of the scans.
    n = 0
    apart = []
    for rights, guesses in given_scans:
        apart.append((rights, [replace(g, score=g.score - 1e-6 * (n + k)) for k, g in enumerate(guesses)]))
        n += len(guesses)
    table = table_of(*apart)
    for label in ("car", "pedestrian"):
        if table[label]:
            assert center_scores(table, label) == pytest.approx(twin.scores(apart, label, CLASSES[label]), abs=1e-9)


@settings(max_examples=60)
@given(st.lists(scans(), min_size=1, max_size=4), st.randoms(use_true_random=False))
def test_the_order_of_scans_and_boxes_is_of_no_account(
    given_scans: list[tuple[list[Box], list[Box]]], chance: random.Random
) -> None:
    """With the order of equal scores, such as of a drive that a resample holds twice, AP changed by up to 3 points."""
    coarse = [(rights, [replace(g, score=round(g.score, 1)) for g in guesses]) for rights, guesses in given_scans]
    other = [(chance.sample(rights, len(rights)), chance.sample(guesses, len(guesses))) for rights, guesses in coarse]
    chance.shuffle(other)
    figures = []
    for ordered in (coarse, other):
        evaluator = BoxEvaluator()
        for rights, guesses in ordered:
            evaluator.update(guesses, rights, drive="drive")
        of_centers = center_scores(table_of(*ordered), "car")
        figures.append([*of_centers.values(), *astuple(evaluator.overall())])
    assert figures[1] == pytest.approx(figures[0], nan_ok=True)
