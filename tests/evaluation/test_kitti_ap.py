"""KITTI's average precision: scenes made by hand, and the development kit's steps on random scenes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from edgeperc.cli.evaluation.box_tables import box_table_lines
from edgeperc.datasets.kitti import KittiCalibration, KittiLabels
from edgeperc.evaluation import kitti_ap
from edgeperc.evaluation.metrics import Listed
from edgeperc.evaluation.tables import Record, figures
from edgeperc.types.perception import Box
from twins import kitti_ap as twin

# The camera is at the sensor and looks along x; y of the image points down.
CAMERA = KittiCalibration(
    np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
    np.array([[720.0, 0, 621, 0], [0, 720, 187, 0], [0, 0, 1, 0]]),
)
SIZES = {"car": (4.0, 1.8, 1.5), "van": (5.0, 2.0, 2.2), "pedestrian": (0.8, 0.6, 1.7), "cyclist": (1.8, 0.6, 1.7)}
SIZES |= {"person_sitting": (0.8, 0.6, 1.2), "truck": (9.0, 2.5, 3.2)}
Scan = tuple[KittiLabels, list[Box]]


def box(label: str, x: float, y: float, score: float = 1.0, yaw: float = 0.0) -> Box:
    return Box(label, score, (x, y, -1.0), SIZES[label], yaw)


def label_row(right: Box, truncation: float = 0.0, occlusion: int = 0) -> list[float]:
    """Numbers of a label file for a box: its rectangle is its projection, as for detections."""
    rows = np.array([[*right.center, *right.size, right.yaw]])
    (ahead, left, up, length, width, height, yaw) = CAMERA.in_camera(rows)[0]
    rectangle = CAMERA.image_rectangles(rows)[0].tolist()
    turn = -math.pi / 2.0 - yaw
    place = [-left, height / 2.0 - up, ahead]
    return [truncation, occlusion, 0.0, *rectangle, height, width, length, *place, turn]


DONT_CARE = [-1.0, -1.0, -10.0, 0.0, 0.0, 1242.0, 375.0, -1.0, -1.0, -1.0, -1000.0, -1000.0, -1000.0, -10.0]


def labels(*rows: tuple[str, list[float]]) -> KittiLabels:
    return KittiLabels(tuple(kind for kind, _ in rows), np.array([n for _, n in rows], np.float64).reshape(-1, 14))


def table_of(*scans: Scan) -> Listed:
    table = Listed()
    for k, (of_scan, boxes) in enumerate(scans):
        table += kitti_ap.count_in_image(kitti_ap.FrontTruth(of_scan, CAMERA), boxes, f"drive {k}")
    return table


def scores(table: Listed, label: str, overlap: str, level: str) -> tuple[float, float, float]:
    return kitti_ap.average_precisions(table[label, overlap, level])


def street(n: int) -> list[Box]:
    """n cars in a row of lanes, all wholly in the image and apart."""
    return [box("car", 12.0 + 5.0 * (k // 3), -4.0 + 4.0 * (k % 3)) for k in range(n)]


def test_forty_found_cars_reach_every_recall_position_but_the_first() -> None:
    cars = [street(9) for _ in range(6)]  # 54 cars
    scans = [(labels(*(("car", label_row(car)) for car in each)), each) for each in cars]
    assert scores(table_of(*scans), "car", "3-D 0.7", "easy") == (1.0, 1.0, 1.0)


def test_few_objects_leave_recall_positions_empty_as_in_the_development_kit() -> None:
    cars = street(5)
    table = table_of((labels(*(("car", label_row(car)) for car in cars)), cars))
    # Five thresholds for positions 0 to 4 of 40; the whole curve is perfect.
    assert scores(table, "car", "bird's eye 0.7", "moderate") == (4 / 40, 2 / 11, 1.0)


def test_half_of_the_cars_and_a_better_false_one_give_a_known_precision() -> None:
    cars = street(9)
    wrong = box("car", 14.5, 11.0, score=0.99)
    scan = labels(*(("car", label_row(car)) for car in cars))
    table = table_of(*[(scan, [replace(car, score=0.5) for car in cars[:3]] + [wrong])] * 14)
    # All scores are equal: 42 hits of 126 cars, 14 false; so one precision of 0.75 up to a recall of a third.
    r40, _, curve = scores(table, "car", "bird's eye 0.7", "easy")
    assert curve == pytest.approx(13 / 40 * 0.75)  # recalls 1/40 .. 13/40
    assert r40 == pytest.approx(14 / 40 * 0.75)  # the kit takes the nearest hit, 42 of 126, for position 14 as well


def test_neighbors_hidden_and_small_objects_count_neither_way() -> None:
    car, van, truck = box("car", 15, 0), box("van", 15, 6), box("truck", 30, -6)
    hidden, cut, far = box("car", 22, 0), box("car", 22, 6), box("car", 60, 2)
    rows = [("car", label_row(car)), ("van", label_row(van)), ("truck", label_row(truck))]
    rows += [("car", label_row(hidden, occlusion=2)), ("car", label_row(cut, truncation=0.4)), ("car", label_row(far))]
    guesses = [replace(each, label="car", score=0.5) for each in (car, van, truck, hidden, cut, far)]
    table = table_of((labels(*rows), guesses))
    counts = {level: table["car", "3-D 0.7", level][0] for level in kitti_ap.LEVELS}
    assert {level: len(each.objects) for level, each in counts.items()} == {"easy": 1, "moderate": 1, "hard": 3}
    # The truck's detection is the only false positive; the far car is 18 px high.
    assert {level: each.steps for level, each in counts.items()} == {
        "easy": ((0.5, 1, 1),),
        "moderate": ((0.5, 1, 1),),
        "hard": ((0.5, 3, 1),),
    }


def test_detections_outside_the_image_are_not_submitted() -> None:
    car = box("car", 15, 0)
    behind, beside = box("car", -15, 0, score=0.9), box("car", 5, 30, score=0.9)
    half = box("car", 12, 11.5, score=0.9)  # partly in the image
    table = table_of((labels(("car", label_row(car))), [car, behind, beside, half]))
    assert table["car", "bird's eye 0.7", "easy"][0].steps == ((1.0, 1, 0), (0.9, 0, 1))


def test_dont_care_regions_excuse_nothing_from_above() -> None:
    car, wrong = box("car", 15, 0), box("car", 20, 5)
    table = table_of((labels(("car", label_row(car)), ("dontcare", DONT_CARE)), [car, wrong]))
    assert table["car", "3-D 0.7", "hard"][0].steps == ((1.0, 1, 1),)


def test_ranges_count_objects_and_false_positives_in_them_alone() -> None:
    near, far = box("car", 10, 0), box("car", 14.9, 5)
    scan = labels(("car", label_row(near)), ("car", label_row(far)))  # the second at 15.7 m
    table = table_of((scan, [near, replace(far, center=(14.0, 5.0, -1.0)), box("car", 20, 0)]))
    counts = {band: table["car", "bird's eye 0.5", band][0] for band in ("0-15 m", "15-30 m")}
    assert [len(each.objects) for each in counts.values()] == [1, 1]
    # The shifted detection of the far car lies nearer than 15 m, and is its hit all the same.
    assert [each.steps for each in counts.values()] == [((1.0, 1, 0),), ((1.0, 1, 1),)]


def test_the_size_of_the_image_follows_from_the_day_of_the_drive() -> None:
    assert kitti_ap.image_size_of("2011_09_28_drive_0016") == (1224, 370)
    assert kitti_ap.image_size_of("mine") == (1242, 375)


def test_all_round_boxes_of_unknown_objects_may_be_found_and_others_may_not() -> None:
    car, few, truck = box("car", -15, 0), box("car", -30, 0), box("truck", 15, 0)
    unknown = Box("ignore", 1.0, (0.0, 20.0, -1.0), SIZES["car"], 0.0)
    guesses = [replace(each, label="car", score=0.5) for each in (car, few, truck, unknown)]
    table = kitti_ap.count_all_round(guesses, [car, truck], [few, unknown], "a")
    (counts,) = table["car", "3-D 0.7", "all round"]
    assert (len(counts.objects), counts.steps) == (1, ((0.5, 1, 1),))


def test_without_objects_there_is_no_precision_and_without_detections_none_is_right() -> None:
    empty = labels()
    assert all(math.isnan(value) for value in scores(table_of((empty, [])), "car", "3-D 0.7", "hard"))
    assert all(math.isnan(v) for v in scores(table_of((empty, [box("car", 10, 0)])), "car", "3-D 0.7", "hard"))
    car = box("car", 15, 0)
    assert scores(table_of((labels(("car", label_row(car))), [])), "car", "3-D 0.7", "hard") == (0.0, 0.0, 0.0)


def test_candidates_of_any_class_cover_objects_of_a_level() -> None:
    car, person, far, van = box("car", 15, 0), box("pedestrian", 15, 5), box("car", 80, 0), box("van", 20, -5)
    scan = labels(*((each.label, label_row(each)) for each in (car, person, far, van)))
    rough = Box("cluster", 0.05, (15.8, 0.2, -1.0), (3.0, 1.6, 1.4), 0.1)
    found = kitti_ap.best_candidates(kitti_ap.FrontTruth(scan, CAMERA), [rough, box("truck", 40, 8)], "a")
    assert [each.label for each in found] == ["car", "pedestrian"]
    assert found[0].range_m == pytest.approx(15.0)
    assert 0.3 < found[0].iou < 0.8
    assert found[1].iou < 0.3
    assert [each.iou for each in kitti_ap.best_candidates(kitti_ap.FrontTruth(scan, CAMERA), [], "a")] == [0.0, 0.0]


@st.composite
def scans(draw: st.DrawFn) -> Scan:
    """Objects near one another, and detections near them: some cut by the image's edge, small, or of another class."""
    places = st.tuples(st.floats(6.0, 55.0), st.floats(-14.0, 14.0), st.floats(-3.1, 3.1))
    names = st.sampled_from(sorted(SIZES))
    rows, boxes = [], []
    for _ in range(draw(st.integers(0, 7))):
        label, (x, y, yaw) = draw(names), draw(places)
        right = box(label, x, y, yaw=yaw)
        cut, occluded = draw(st.sampled_from([0.0, 0.15, 0.2, 0.4, 0.6])), draw(st.integers(0, 3))
        rows.append((label, label_row(right, cut, occluded)))
        for _ in range(draw(st.integers(0, 3))):
            dx, dy, turn = (draw(st.floats(-limit, limit)) for limit in (0.4, 0.3, 0.3))
            near = replace(right, center=(x + dx, y + dy, -1.0 + 0.3 * dx), yaw=yaw + turn)
            boxes.append(replace(near, score=draw(st.integers(0, 8)) / 8, label=draw(st.sampled_from([label, "car"]))))
    boxes += [box(draw(names), *draw(places)[:2], score=0.5) for _ in range(draw(st.integers(0, 2)))]
    if draw(st.booleans()):
        rows.append(("dontcare", DONT_CARE))
    return labels(*rows), boxes


def submitted(boxes: list[Box]) -> list[twin.Object]:
    """Detections as rows of a submission."""
    found = []
    for each in boxes:
        numbers = label_row(each)
        if numbers[5] > numbers[3] and numbers[6] > numbers[4]:
            found.append(replace(twin.read_row(each.label, numbers), thresh=each.score))
    return found


@settings(max_examples=30)
@given(st.lists(scans(), min_size=1, max_size=4))
def test_the_development_kit_step_by_step_gives_the_same_numbers(given_scans: list[Scan]) -> None:
    table = table_of(*given_scans)
    read = [
        ([twin.read_row(kind, row) for kind, row in zip(of.kinds, of.numbers, strict=True)], submitted(boxes))
        for of, boxes in given_scans
    ]
    for label, (least_ious, _) in kitti_ap.CLASSES.items():
        for metric in ("bird's eye", "3-D"):
            for least_iou in least_ious:
                for level in kitti_ap.LEVELS:
                    counts = table[label, f"{metric} {least_iou:g}", level]
                    n_truth, r40, r11 = (
                        twin.eval_class(read, label, level, metric, least_iou)
                        if any(each.objects for each in counts)
                        else (0, math.nan, math.nan)
                    )
                    assert sum(len(each.objects) for each in counts) == n_truth
                    assert kitti_ap.average_precisions(counts)[:2] == pytest.approx((r40, r11), abs=1e-12, nan_ok=True)


@settings(max_examples=100)
@given(st.integers(1, 400), st.integers(0, 2**32 - 1))
def test_thresholds_of_the_recall_positions_are_those_of_the_kit(n_truth: int, seed: int) -> None:
    from edgeperc.evaluation.metrics import recall_positions

    rng = np.random.default_rng(seed)
    hits: NDArray[np.float64] = np.sort(rng.random(rng.integers(0, n_truth + 1)))[::-1]
    assert [hits[k] for k in recall_positions(len(hits), n_truth)] == twin.get_thresholds(hits.tolist(), n_truth)


def test_a_missing_table_says_why() -> None:
    """Pre-labels have the occlusion 3, unknown."""
    unknown = labels(("car", label_row(box("car", 20.0, 0.0), occlusion=3)))
    record = Record("a", "drive", {("kitti",): table_of((unknown, []))})
    (line,) = filter(None, box_table_lines(figures([record])))
    assert line == "no car, pedestrian or cyclist is to find: with enough points, and within KITTI's image limits"
