"""Candidates, their crops and the boxes of the object network: kernels against their twins, and what must hold."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import twins.objects
from edgeperc.errors import CardError, InferenceError, PointsError
from edgeperc.ground.planes import Ground
from edgeperc.ground.scan import Scan
from edgeperc.objects import candidates
from edgeperc.objects.candidate_boxes import (
    SCORE,
    boxes_of_objects,
    confirm_boxes,
    decode_objects,
    fill_merged,
    footprints,
    merge_boxes,
    with_footprints,
)
from edgeperc.objects.crops import FEATURES, Crops, crop_candidates, fill_features, with_points
from edgeperc.types.card import CHANNELS, InputSpec, ModelCard, OutputSpec
from edgeperc.types.geometry import oriented_iou
from edgeperc.types.perception import Box
from edgeperc.types.views import ObjectGeometry

RANGE_M = (0.1, 4.2)
SIZES = {"car": (3.9, 1.6, 1.5), "pedestrian": (0.8, 0.6, 1.7)}
CLASSES = ("background", *SIZES)
N_VALUES = len(CLASSES) + 3 + 3 * len(SIZES) + 2 + 2 + 1
Rows = NDArray[np.float64]


def object_card(**changes: Any) -> ModelCard:
    n = len(FEATURES)
    facts: dict[str, Any] = {
        "view": ObjectGeometry(n_points=8),
        "input": InputSpec("candidates", FEATURES, (0.0,) * n, (1.0,) * n),
        "outputs": (OutputSpec("objects", "objects"),),
        "classes": CLASSES,
        "box_classes": CLASSES[1:],
        "box_size_priors": SIZES,
    }
    return ModelCard(name="objects", version="1", **(facts | changes))


def scan_of(points: NDArray[np.float32], height: NDArray[np.float32]) -> Scan:
    return Scan.of(points, Ground(np.zeros(len(points), np.bool_), height, (0.0, 0.0, -1.73)))


def some_scan(rng: np.random.Generator, n: int) -> Scan:
    """Clusters and single points, some of them not finite, at the edge of the cells, or beyond."""
    middles = rng.uniform(-85.0, 85.0, (max(n // 20, 1), 2))
    points = np.zeros((n, 4), np.float32)
    points[:, :2] = middles[rng.integers(len(middles), size=n)] + rng.normal(0.0, 0.7, (n, 2))
    height = rng.uniform(-0.2, 5.0, n).astype(np.float32)
    points[:, 2] = height - 1.73 + rng.normal(0.0, 0.1, n)
    points[:, 3] = rng.random(n)
    bad = rng.random(n) < 0.02
    points[bad], height[bad] = np.nan, np.nan
    return scan_of(points, height)


def by_cell(cells: candidates.Cells) -> dict[int, list[int]]:
    return {
        int(flat): cells.rows[start:end].tolist()
        for flat, start, end in zip(cells.flat, cells.starts[:-1], cells.starts[1:], strict=True)
    }


def scans() -> list[Scan]:
    rng = np.random.default_rng(3)
    infinite = some_scan(rng, 40)
    points, height = infinite.points.copy(), infinite.ground.height_m.copy()
    points[::3, 0], points[1::3, 1], height[2::3] = np.inf, -np.inf, np.inf
    return [*(some_scan(rng, n) for n in (0, 1, 5, 100, 400)), scan_of(points, height)]


@pytest.mark.kernel
@pytest.mark.parametrize("distance_per_m", [0.015, 0.9], ids=["near", "far"])  # far: more than 64 cells to each side
@pytest.mark.parametrize("scan", scans(), ids=lambda scan: f"{len(scan.points)} points")
def test_cells_and_groups_agree_with_their_twins(scan: Scan, distance_per_m: float) -> None:
    cells = candidates.sort_into_cells(scan, RANGE_M)
    right = twins.objects.cells(scan.points, scan.ground.height_m, *RANGE_M)
    assert by_cell(cells) == right
    assert [*by_cell(cells)] == [*right]
    numbers = cells.number.ravel()
    assert (numbers >= 0).sum() == len(right)
    np.testing.assert_array_equal(numbers[cells.flat], np.arange(len(right)))
    wide: dict[int, list[set[int]]] = {}
    n_found = 0
    for k, per_m in candidates.links_of(distance_per_m):
        scale = candidates.SCALES[k]
        group, order = np.empty((2, len(right)), np.int32)
        first = np.empty(len(right) + 1, np.int32)
        n = candidates.fill_groups_of_cells(cells, k, scale.link_m, per_m, group, order, first)
        found = [{*cells.flat[order[first[g] : first[g + 1]]].tolist()} for g in range(n)]
        expected = twins.objects.groups(right, scan.ground.height_m, scale, per_m)
        assert found == expected
        around = wide.get(k, wide.get(0, []))
        for own in expected:
            outer = next((len(other) for other in around if own <= other), None)
            rows = [i for cell in own for i in right[cell]]
            n_found += twins.objects.is_candidate(scan.points, scan.ground.height_m, rows, scale, len(own), outer)
        wide.setdefault(k, expected)
    assert len(candidates.find_candidates(scan, cells, distance_per_m).rectangles) == n_found


@pytest.mark.kernel
def test_a_rectangle_holds_the_points_of_its_group() -> None:
    rng = np.random.default_rng(0)
    for yaw in np.linspace(0.0, 3.0, 13):
        u, v = rng.uniform(-2.0, 2.0, 200), np.full(200, -0.8)
        u[100:], v[100:] = -2.0, rng.uniform(-0.8, 0.8, 100)  # the side and the rear of a car
        points = np.zeros((200, 4), np.float32)
        points[:, 0] = 10.0 + math.cos(yaw) * u - math.sin(yaw) * v
        points[:, 1] = 3.0 + math.sin(yaw) * u + math.cos(yaw) * v
        scan = scan_of(points, np.linspace(0.3, 1.5, 200, dtype=np.float32))
        found = candidates.find_candidates(scan, candidates.sort_into_cells(scan, RANGE_M)).rectangles
        assert len(found) >= 1
        x, y, length, width, turn = found[0]
        along = np.abs(math.cos(turn) * (points[:, 0] - x) + math.sin(turn) * (points[:, 1] - y))
        across = np.abs(math.cos(turn) * (points[:, 1] - y) - math.sin(turn) * (points[:, 0] - x))
        assert along.max() <= 0.5 * length + 1e-4
        assert across.max() <= 0.5 * width + 1e-4
        assert oriented_iou([[10.0, 3.0, 4.0, 1.6, yaw]], [found[0]])[0, 0] > 0.9


def test_what_is_too_long_too_low_or_too_small_is_no_candidate() -> None:
    def n_found(length: float, top: float, n: int) -> int:
        points = np.zeros((n, 4), np.float32)
        points[:, 0] = np.linspace(10.0, 10.0 + length, n)
        scan = scan_of(points, np.linspace(0.25, top, n, dtype=np.float32))
        return len(candidates.find_candidates(scan, candidates.sort_into_cells(scan, RANGE_M)).rectangles)

    assert n_found(4.0, 1.5, 80) >= 1
    assert n_found(candidates.MAX_LENGTH_M + 0.5, 1.5, 200) == 0
    assert n_found(4.0, 0.4, 80) == 0
    assert n_found(0.1, 1.5, 3) == 0


def test_two_people_are_apart_where_beams_are() -> None:
    """1.2 m from each other, 25 m ahead of a sensor whose points are linked at up to 1.7 m there."""
    rng = np.random.default_rng(5)
    height = np.tile(np.linspace(0.5, 1.7, 4, dtype=np.float32), 8)
    points = np.zeros((32, 4), np.float32)
    points[:, 0] = 25.0 + rng.uniform(-0.1, 0.1, 32)
    points[:, 1] = np.repeat([0.0, 1.2], 16) + rng.uniform(-0.2, 0.2, 32)
    scan = scan_of(points, height)
    found = candidates.find_candidates(scan, candidates.sort_into_cells(scan, RANGE_M), 0.07).rectangles
    assert {round(y / 1.2) for _, y, length, _, _ in found if length < 0.6} == {0, 1}


def test_a_distance_is_in_radians() -> None:
    scan = some_scan(np.random.default_rng(1), 500)
    with pytest.raises(PointsError, match="distance_per_m=2"):
        candidates.find_candidates(scan, candidates.sort_into_cells(scan, RANGE_M), 2.0)


def test_one_buffer_serves_one_scan_after_the_other() -> None:
    buffer = candidates.CellBuffer()
    for scan in [*scans(), *reversed(scans())]:
        reused = buffer.sort(scan, RANGE_M)
        fresh = candidates.sort_into_cells(scan, RANGE_M)
        for a, b in zip(reused, fresh, strict=True):
            np.testing.assert_array_equal(a, b)


def some_places(rng: np.random.Generator, scan: Scan, n: int) -> Rows:
    places = np.column_stack(
        [rng.uniform(-90.0, 90.0, (n, 2)), rng.uniform(0.0, 12.0, (n, 2)), rng.uniform(-7.0, 7.0, n)]
    )
    if len(scan.points):
        near = rng.integers(len(scan.points), size=n)
        places[::2, :2] = np.nan_to_num(scan.points[near, :2], posinf=1e30, neginf=-1e30)[::2]
    return places


@pytest.mark.kernel
@pytest.mark.parametrize("scan", scans(), ids=lambda scan: f"{len(scan.points)} points")
def test_crops_and_features_agree_with_their_twins(scan: Scan) -> None:
    rng = np.random.default_rng(5)
    cells = candidates.sort_into_cells(scan, RANGE_M)
    places = some_places(rng, scan, 12)
    crops = crop_candidates(scan, candidates.Candidates(places, cells), 8, 0.8)
    for k, place in enumerate(places):
        points, n, level = twins.objects.crop(scan.points, scan.ground.height_m, by_cell(cells), place, 8, 0.8)
        assert crops.counts[k] == n
        np.testing.assert_allclose(crops.level[k], level, atol=1e-9)
        np.testing.assert_allclose(crops.points[k], points, atol=2e-5)
    scale = np.array([rng.normal(size=len(FEATURES)), rng.uniform(0.5, 2.0, len(FEATURES))], np.float32)
    found = np.empty((len(places), 8, len(FEATURES)), np.float32)
    fill_features(crops.points, crops.counts, places, scale, found)
    right = twins.objects.features(crops.points.astype(np.float64), crops.counts, places, scale)
    np.testing.assert_allclose(found, right, atol=1e-4)
    (kept, _), some = with_points(candidates.Candidates(places, cells), crops)
    assert len(kept) == len(some.counts) == (crops.counts >= 3).sum()
    nothing = crop_candidates(scan, candidates.Candidates(places[:0], cells), 8, 0.8)
    assert nothing.points.shape == (0, 8, 4)


def test_a_scan_and_its_candidates_may_be_turned_together() -> None:
    """Crops do not depend on where an object is; only range and direction to the sensor do."""
    rng = np.random.default_rng(2)
    scan = some_scan(rng, 600)
    scan = scan_of((0.5 * scan.points).astype(np.float32), scan.ground.height_m)  # within reach, turned too
    places = some_places(rng, scan, 6)
    places[:, :2] = np.nan_to_num(scan.points[:6, :2])
    angle = 0.7
    cos, sin = math.cos(angle), math.sin(angle)
    points = scan.points.copy()
    points[:, 0] = cos * scan.points[:, 0] - sin * scan.points[:, 1]
    points[:, 1] = sin * scan.points[:, 0] + cos * scan.points[:, 1]
    turned = places.copy()
    turned[:, :2] = places[:, :2] @ [[cos, sin], [-sin, cos]]
    turned[:, 4] += angle
    other = scan_of(points, scan.ground.height_m)
    first, second = (
        crop_candidates(s, candidates.Candidates(p, candidates.sort_into_cells(s, RANGE_M)), 512, 0.8)
        for s, p in ((scan, places), (other, turned))
    )
    np.testing.assert_array_equal(first.counts, second.counts)
    np.testing.assert_allclose(first.level, second.level, atol=1e-6)
    for k, n in enumerate(first.counts):
        own, its = (crops.points[k, :n][np.lexsort(crops.points[k, :n].T.round(2))] for crops in (first, second))
        np.testing.assert_allclose(own.sum(axis=0), its.sum(axis=0), atol=1e-2)


@pytest.mark.kernel
@pytest.mark.parametrize("n", [0, 1, 50])
def test_boxes_agree_with_their_twins(n: int) -> None:
    rng = np.random.default_rng(n)
    card = object_card()
    outputs = rng.normal(0.0, 2.0, (n, N_VALUES)).astype(np.float32)
    places = rng.uniform(-4.0, 4.0, (n, 5))
    level = rng.normal(-1.7, 0.1, n)
    found = decode_objects(card, outputs, places, level)
    right = twins.objects.boxes(outputs, places, level, np.array([*SIZES.values()]))
    np.testing.assert_allclose(found, right, atol=1e-5)
    rows = found[np.argsort(-found[:, SCORE], kind="stable")]
    iou = rng.random((n // 2, n))
    best = rows[: n // 2].copy()
    expected = twins.objects.merged(rows, iou, best)
    fill_merged(rows, iou, best)
    np.testing.assert_allclose(best, expected, atol=1e-9)


def test_outputs_that_are_not_finite_are_an_error() -> None:
    outputs = np.zeros((2, N_VALUES), np.float32)
    outputs[1, 3] = np.nan
    with pytest.raises(InferenceError, match="not finite"):
        decode_objects(object_card(), outputs, np.zeros((2, 5)), np.zeros(2))


def test_boxes_of_one_object_are_merged_and_others_are_kept() -> None:
    def row(x: float, y: float, yaw: float, score: float, label: int = 1) -> list[float]:
        length, width, height = SIZES[CLASSES[label]]
        return [x, y, -1.0, length, width, height, yaw, score, label, 0.9]

    rows = np.array(
        [
            row(10.0, 0.0, 0.0, 0.6),
            row(10.2, 0.1, math.pi - 0.02, 0.3),  # the same car, the other way round
            row(10.0, 0.6, 0.0, 0.2),  # a part of it
            row(10.0, 6.0, 0.0, 0.5),
            row(30.0, 0.0, 0.0, 0.4, 2),
            row(30.0, 0.5, 0.0, 0.35, 2),  # somebody beside that person
            row(50.0, 0.0, 0.0, 0.001),
        ]
    )
    merged = merge_boxes(rows, CLASSES)
    assert [box.label for box in boxes_of_objects(merged, CLASSES, 0.0)] == ["car", "car", "pedestrian", "pedestrian"]
    assert len(boxes_of_objects(merged, CLASSES, 0.45)) == 2
    best = merged[0]
    assert 10.0 < best[0] < 10.1
    assert abs(best[6]) < 0.02
    assert best[SCORE] == 0.6
    assert len(merge_boxes(rows[:0], CLASSES)) == 0


@pytest.mark.parametrize("n_looks", [1, 2])
@pytest.mark.parametrize("n", [0, 1, 40])
def test_a_box_is_the_mean_of_what_more_looks_show(n: int, n_looks: int) -> None:
    rng = np.random.default_rng(n)
    found = rng.uniform(0.1, 1.0, (n, 10)) * [40, 40, 1, 5, 2, 2, 3, 1, 3, 1]
    again = found + rng.normal(0.0, 0.1, (n_looks, n, 10)) * [1, 1, 1, 1, 1, 1, 1, 1, 0, 0]
    again[:, :, 6] += math.pi * rng.integers(0, 2, (n_looks, n))  # the other way round
    again[:, :, SCORE] = rng.uniform(0.0, 1.0, (n_looks, n))
    again[:, ::3, 0] += 5.0  # another object
    again[0, 1::3] = 0.0  # nothing
    confirmed = confirm_boxes(found, again)
    assert confirmed.shape == (n, 10)
    for k, both in enumerate(confirmed):
        looks = [look for look in again[:, k] if look[SCORE] > 0.0] or [found[k]]
        best = max(looks, key=lambda look: look[SCORE])
        near = [look for look in looks if oriented_iou(footprints(look[None]), footprints(best[None])) > 0.5]
        weights = [look[SCORE] for look in near]
        np.testing.assert_allclose(both[:6], np.average([look[:6] for look in near], axis=0, weights=weights))
        assert both[SCORE] == pytest.approx((found[k, SCORE] + again[:, k, SCORE].mean()) / 2)
        assert both[8:].tolist() == best[8:].tolist()
        assert abs(math.remainder(both[6] - best[6], 2.0 * math.pi)) < 0.5
    nothing = confirm_boxes(found, np.zeros((n_looks, n, 10)))
    np.testing.assert_allclose(nothing[:, :6], found[:, :6])
    np.testing.assert_allclose(nothing[:, SCORE], found[:, SCORE] / 2)


@pytest.mark.parametrize("n", [0, 1, 30])
def test_footprints_are_averaged_with_those_of_another_network(n: int) -> None:
    """Of those that overlap, by scores, whichever end they call the front; the rest of a box stays."""
    rng = np.random.default_rng(n)
    boxes = np.column_stack([np.arange(n) * 10.0, rng.uniform(-0.5, 0.5, (n, 9))])
    boxes[:, 3:6] = (4.0, 1.7, 1.5)
    boxes[:, SCORE] = rng.uniform(0.3, 1.0, n)
    shown = []
    for k, (x, y, _, length, width, _, yaw, *_) in enumerate(boxes[: 2 * n // 3].tolist()):
        away = 0.2 if k % 2 else 3.0  # the same place, or another one
        turned = yaw + 0.1 + math.pi * (k % 4 == 1)
        shown.append(Box("car", 0.1 + 0.8 * rng.random(), (x + away, y, 9.0), (length + 0.3, width, 5.0), turned))
    averaged = with_footprints(boxes, shown)
    for k, (own, box) in enumerate(zip(averaged, boxes, strict=True)):
        expected = box.copy()
        if k < len(shown) and k % 2:
            weight = shown[k].score / (shown[k].score + box[SCORE])
            expected[[0, 3, 6]] += weight * np.array([0.2, 0.3, 0.1])
        np.testing.assert_allclose(own, expected, atol=1e-12)
    np.testing.assert_allclose(with_footprints(boxes, ()), boxes, atol=1e-12)


def test_the_card_describes_candidates() -> None:
    card = object_card()
    assert ModelCard.from_json(card.to_json()) == card
    assert card.input_shape == (None, 8, len(FEATURES))
    assert card.output_shape("objects") == (None, N_VALUES)
    assert CHANNELS["objects"] == FEATURES
    for changes, message in (
        ({"box_classes": ("car",)}, "expected all classes"),
        ({"box_size_priors": {"car": SIZES["car"]}}, "box_size_prior"),
        ({"outputs": (OutputSpec("objects", "class_logits"),)}, "expected one, objects"),
        ({"fitness": {}}, "fitness"),
        ({"input": InputSpec("candidates", FEATURES[:2], (0.0, 0.0), (1.0, 1.0))}, "expected x, y"),
    ):
        with pytest.raises(CardError, match=message):
            object_card(**changes)
    for view, message in (
        ({"n_points": 0}, "n_points"),
        ({"margin_m": -1.0}, "margin_m"),
        ({"height_range_m": (1.0, 1.0)}, "height_range_m"),
        ({"height_range_m": (math.nan, 1.0)}, "height_range_m"),
    ):
        with pytest.raises(CardError, match=message):
            ObjectGeometry(**view)


def test_crops_of_no_candidate_are_empty() -> None:
    empty = Crops(np.empty((0, 8, 4), np.float32), np.empty(0, np.int32), np.empty(0))
    cells = candidates.sort_into_cells(scans()[0], RANGE_M)
    kept, crops = with_points(candidates.Candidates(np.empty((0, 5)), cells), empty)
    assert len(kept.rectangles) == len(crops.counts) == 0
