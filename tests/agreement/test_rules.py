"""Agreement of labels, boxes and cells: kernels against twins, invariants on any input, scenes with known answers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from agreeing import agreed_cells, agreed_points, voters_of
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

import twins.rules
from edgeperc import Box, Perceiver, PointLabels, PointsError, TopView
from edgeperc.agreement import votes as voting
from edgeperc.agreement.cells import clear_cells, fill_marks
from edgeperc.agreement.rules import (
    RULES,
    Support,
    agree_on_boxes,
    as_rows,
    clear_columns,
    clear_ground,
    count_inside,
    fill_support,
    find_support,
    find_voters,
    stand_boxes,
    sum_inside,
)
from edgeperc.ground.planes import Ground, find_ground
from edgeperc.ground.scan import Scan
from edgeperc.objects.boxes import objects_from_points
from edgeperc.objects.cluster import find_clusters, sort_points
from edgeperc.types import choices
from edgeperc.types.geometry import Grid, inside
from edgeperc.types.points import Cloud, Labeled, read_only
from edgeperc.types.views import TopViewGeometry
from scenes import assert_same, urban

CLASSES = ("background", "car", "pedestrian", "cyclist")
ROLES = np.array([0, 1, 2, 2], np.uint8)
VIEW = TopViewGeometry((0.0, 20.0), (-8.0, 8.0), cell_m=0.5)
GROUND_Z = -1.73
BOUNDS = ["low_x", "low_y", "high_x", "high_y", "top"]  # of clusters

coordinates = st.floats(-9.0, 19.0, width=32) | st.sampled_from([0.0, -0.0, 60.0, 3e38, math.nan, math.inf, -math.inf])
heights = st.floats(-1.0, 7.0, width=32) | st.sampled_from([0.0, 0.3, 2.0, math.nan, math.inf, -math.inf])
rows = st.tuples(coordinates, coordinates, heights, st.booleans(), st.booleans(), st.integers(0, 3), st.integers(-1, 5))


def crowd(seed: int) -> list[tuple[float, float, float, bool, bool, int, int]]:
    """Eighty rows close to one another; hypothesis itself draws three on average."""
    rng = np.random.default_rng(seed)
    heights = np.where(rng.random(80) < 0.5, rng.uniform(-1.0, 7.0, 80), rng.choice([0.0, 0.05, 0.3, 1.0, 2.0], 80))
    flags, places = rng.random((2, 80)) < 0.5, rng.uniform([[-3.0], [-4.0]], [[7.0], [4.0]], (2, 80))
    columns = (*places, heights, *flags, rng.integers(0, 4, 80), rng.integers(-1, 6, 80))
    return list(zip(*(column.tolist() for column in columns), strict=True))


scenes = st.lists(rows, max_size=60) | st.integers(0, 2**32 - 1).map(crowd)
boxes_of = st.lists(
    st.builds(
        lambda x, y, length, width, yaw, score, label: Box(label, score, (x, y, -1.0), (length, width, 1.5), yaw),
        *(st.floats(-5.0, 15.0), st.floats(-6.0, 6.0), st.floats(0.3, 12.0), st.floats(0.3, 4.0)),
        *(st.floats(-3.2, 3.2), st.sampled_from([0.1, 0.3, 0.4, 0.5, 0.9]), st.sampled_from(["car", "van", "truck"])),
    ),
    max_size=4,
)


class Scene:
    """Arrays of a random scene, as the kernels take them."""

    def __init__(self, given: list[tuple[float, float, float, bool, bool, int, int]]) -> None:
        n = len(given)
        columns = list(zip(*given, strict=True)) if given else [()] * 7
        self.points = np.zeros((n, 4), np.float32)
        for k in range(2):
            self.points[:, k] = columns[k]
        self.height = np.array(columns[2], np.float32)
        self.points[:, 2] = self.height + np.float32(GROUND_Z)
        self.on_ground = np.array(columns[3], np.bool_) & (np.abs(self.height) < 0.2)
        self.in_view = np.array(columns[4], np.bool_) & np.isfinite(self.points).all(axis=1)
        self.labels = np.where(self.in_view, np.array(columns[5], np.uint8), 0).astype(np.uint8)
        self.clusters = np.where(self.on_ground | ~np.isfinite(self.points).all(axis=1), -1, columns[6]).astype(
            np.int32
        )
        self.points.flags.writeable = False

    @property
    def cloud(self) -> Cloud:
        return Cloud(self.points, read_only(self.height))

    @property
    def ground(self) -> Ground:
        return Ground(self.on_ground, self.height, (0.0, 0.0, GROUND_Z))

    @property
    def found(self) -> PointLabels:
        return PointLabels(self.labels, self.in_view, CLASSES)


def top_view(seed: int = 0, view: TopViewGeometry = VIEW) -> TopView:
    labels = np.random.default_rng(seed).integers(0, 5, (view.height, view.width)).astype(np.uint8)
    labels[::2] = 1
    names = ("background", "drivable", "car", "van", "truck")
    return TopView(labels, names, view.cell_m, view.x_range_m, view.y_range_m, np.ones(labels.shape, np.bool_))


@settings(max_examples=60)
@given(scenes)
def test_columns_match_the_twin(given: list) -> None:
    scene, limits = Scene(given), np.array([0.0, 0.0, 2.0, 2.2])
    found = scene.labels.copy()
    clear_columns(scene.points, read_only(scene.height), limits, found)
    np.testing.assert_array_equal(found, twins.rules.columns(scene.points, scene.height, limits, scene.labels))


@pytest.mark.parametrize("seed", range(4))
def test_dense_columns_match_the_twin(seed: int) -> None:
    """Poles, people and foliage, so that columns end at gaps of every size."""
    rng = np.random.default_rng(seed)
    n = 1500
    points = np.zeros((n, 4), np.float32)
    place = rng.integers(0, 30, n)
    points[:, :2] = place[:, None] * 0.7 - 5 + rng.normal(0, 0.1, (n, 2))
    height = (rng.random(n) * rng.uniform(1.0, 6.6, 30)[place]).astype(np.float32)
    labels, limits = rng.integers(0, 4, n).astype(np.uint8), np.array([0.0, 0.0, 2.0, 2.2])
    found = labels.copy()
    clear_columns(read_only(points), read_only(height), limits, found)
    np.testing.assert_array_equal(found, twins.rules.columns(points, height, limits, labels))
    assert np.count_nonzero(found != labels) > 0


@settings(max_examples=60)
@given(scenes, st.sampled_from([(0, 0), (40, 40)]))
def test_tallies_match_the_twin(given: list, shape: tuple[int, int]) -> None:
    scene = Scene(given)
    found = voting.Tallies(np.empty(6, voting.CLUSTER), np.empty((6, 5), np.int32))
    cells = np.random.default_rng(len(given)).integers(0, 5, shape).astype(np.uint8)
    view = voting.Cells(cells, np.arange(256) % 5 > 1, Grid(16.0, 8.0, 0.4))
    args = scene.cloud, scene.in_view, scene.labels, scene.clusters, view
    voting.fill_tallies(*args, found)
    counts, bounds, above = twins.rules.tallies(*args, 6, 4)
    np.testing.assert_array_equal(found.counts, counts)
    np.testing.assert_array_equal(structured_to_unstructured(found.clusters[BOUNDS]), bounds)
    held = found.clusters[["n_in_both", "n_in_vehicles", "n_points"]]
    np.testing.assert_array_equal(structured_to_unstructured(held), above)


@settings(max_examples=60)
@given(scenes, boxes_of)
def test_boxes_around_points_match_the_twin(given: list, boxes: list[Box]) -> None:
    scene, records = Scene(given), as_rows(boxes, [k % 3 + 1 for k in range(len(boxes))])
    support = Support(np.empty(len(scene.points), np.float32), np.empty(len(scene.points), np.uint8))
    among, labeled = scene.in_view & ~scene.on_ground, Labeled(scene.labels, ROLES)
    fill_support(scene.cloud, among, labeled, records, support)
    for own, right in zip(support, twins.rules.support(scene.cloud, ~among, labeled, records), strict=True):
        np.testing.assert_array_equal(own, right)
    counts, sums = np.empty((len(boxes), 3), np.int64), np.empty((len(boxes), 3))
    masks = scene.on_ground, scene.in_view
    count_inside(scene.cloud, *masks, labeled, records, counts)
    np.testing.assert_array_equal(counts, twins.rules.inside_counts(scene.cloud, *masks, labeled, records))
    sum_inside(scene.cloud, *masks, labeled, records, sums)
    np.testing.assert_array_equal(sums, twins.rules.inside_sums(scene.cloud, *masks, labeled, records))


@settings(max_examples=60)
@given(scenes, st.integers(0, 99))
def test_verdicts_match_the_twin(given: list, seed: int) -> None:
    scene, rng = Scene(given), np.random.default_rng(seed)
    n = len(scene.points)
    table = rng.integers(0, 4, (6, 4)).astype(np.uint8)
    scores, names = rng.random(n).astype(np.float32), rng.integers(0, 4, n).astype(np.uint8)
    in_view, clusters, labeled = scene.in_view, scene.clusters, Labeled(scene.labels, ROLES)
    found, votes = scene.labels.copy(), np.empty(n, np.uint8)
    voting.apply_verdicts(in_view, clusters, table, ROLES, scores, names, found)
    np.testing.assert_array_equal(found, twins.rules.verdicts(in_view, clusters, table, (scores, names), labeled))
    voting.fill_votes(in_view, labeled, scores, votes)
    np.testing.assert_array_equal(votes, twins.rules.votes(in_view, labeled, scores))


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.integers(0, 40), st.booleans(), st.booleans(), st.booleans())
def test_what_becomes_of_clusters_matches_the_twin(
    seed: int, n: int, by_share: bool, by_height: bool, is_filled: bool
) -> None:
    rules = by_share, by_height, is_filled
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 12, (n, 5)).astype(np.int32) * rng.integers(0, 2, (n, 5)).astype(np.int32)
    counts[:, 4] = counts[:, :4].sum(axis=1)
    sides = rng.choice([0.5, 2.9, 3.1, 9.0, 11.0, np.inf], (n, 2))
    bounds = np.column_stack([-sides / 2, sides / 2, rng.choice([-np.inf, 0.4, 0.9, 1.5, 2.2, 4.5], n)])
    bounds = bounds.astype(np.float32)
    parts, refused, found = np.array([[2, 3]]), rng.random(n) < 0.2, np.empty((n, 4), np.uint8)
    clusters = np.zeros(n, voting.CLUSTER)
    for name, column in zip(BOUNDS, bounds.T, strict=True):
        clusters[name] = column
    sight = voting.Sight(*rng.choice([(0.3, 0.035), (0.5, -0.1), (1.73, 0.2), (math.inf, 0.0)]).tolist())
    voting.fill_verdicts(voting.Tallies(clusters, counts), refused, ROLES, parts, voting.Applied(*rules), sight, found)
    right = twins.rules.verdict_table(counts, bounds, refused, ROLES, parts, rules, sight)
    np.testing.assert_array_equal(found, right)


def crowded(seed: int) -> tuple[NDArray[np.float32], PointLabels, Ground, list[Box]]:
    """Heaps of points with few, some or many labels, some of them out of view, and boxes around some of them."""
    rng = np.random.default_rng(seed)
    n, heaps = 900, 14
    of = rng.integers(0, heaps, n)
    places = rng.uniform(-14, 14, (heaps, 2))
    spread = rng.choice([0.2, 0.5, 1.5], heaps)
    height = rng.uniform(0.2, 1.0, n) * rng.uniform(0.4, 4.0, heaps)[of]
    points = np.zeros((n, 4), np.float32)
    points[:, :2] = places[of] + rng.normal(0, 1, (n, 2)) * spread[of][:, None]
    points[:, 2] = height + GROUND_Z
    share = rng.choice([0.0, 0.02, 0.09, 0.11, 0.5, 0.58, 0.62, 0.72, 0.77, 1.0], heaps)
    in_view = rng.random(n) < rng.choice([0.3, 1.0], heaps)[of]
    labels = np.where(in_view & (rng.random(n) < share[of]), rng.integers(1, 4, heaps)[of], 0).astype(np.uint8)
    on_ground = rng.random(n) < 0.05
    boxes = [
        Box("car", score, (*places[k], -1.0), (4.0 * spread[k], 2.0 * spread[k], 2.0), 0.3)
        for k, score in enumerate(rng.choice([0.2, 0.35, 0.6, 0.9], heaps // 2))
    ]
    ground = Ground(on_ground, height.astype(np.float32), (0.0, 0.0, GROUND_Z))
    return points, PointLabels(labels, in_view, CLASSES), ground, boxes


@pytest.mark.parametrize("seed", range(16))
@pytest.mark.parametrize("rules", [RULES, RULES - {"share"}, RULES - {"support"}])
def test_voters_give_the_results_of_complete_clusters(seed: int, rules: frozenset[str]) -> None:
    points, labels, ground, boxes = crowded(seed)
    complete = find_clusters(points, among=~ground.mask, seeds=labels.labels > 0, min_points=1)
    voters = voters_of(points, labels, ground, boxes, rules)
    expected = agreed_points(points, labels, ground, complete, boxes, rules=rules)
    agreed = agreed_points(points, labels, ground, voters, boxes, rules=rules)
    scan = Scan.of(points, ground, labels)
    strips = sort_points(points, ~ground.mask)
    sorted_first = find_voters(scan, labels, find_support(scan, labels, boxes, rules), strips, rules=rules)
    np.testing.assert_array_equal(sorted_first, voters)
    np.testing.assert_array_equal(agreed.labels, expected.labels)
    found = [
        objects_from_points(points, agreed.labels, CLASSES, height_m=ground.height_m, clusters=clusters)
        for clusters in (voters, complete)
    ]
    assert found[0] == found[1]


def test_a_forest_is_not_searched_because_of_a_few_labels() -> None:
    rng = np.random.default_rng(0)
    n = 60_000
    points = np.column_stack([rng.uniform(-12, 12, (n, 2)), rng.uniform(-1.0, 2.0, n), np.zeros(n)]).astype(np.float32)
    labels = np.zeros(n, np.uint8)
    labels[rng.choice(n, 60, replace=False)] = rng.integers(1, 4, 60)
    height = (points[:, 2] - np.float32(GROUND_Z)).astype(np.float32)
    ground = Ground(np.zeros(n, np.bool_), height, (0.0, 0.0, GROUND_Z))
    found = PointLabels(labels, np.ones(n, np.bool_), CLASSES)
    voters = voters_of(points, found, ground)
    assert (voters[labels > 0] == -2).all()
    assert np.count_nonzero(voters != -1) < n // 3
    assert not agreed_points(points, found, ground, voters).labels.any()


@settings(max_examples=60)
@given(scenes)
def test_cleared_ground_matches_the_twin(given: list) -> None:
    scene = Scene([(round(x) if abs(x) < 99 else x, 0.1, *rest) for x, _, *rest in given])  # many in one cell
    found = scene.labels.copy()
    on_ground = read_only(scene.on_ground, np.bool_)
    clear_ground(*scene.cloud, on_ground, ROLES, found)
    np.testing.assert_array_equal(found, twins.rules.ground(scene.cloud, on_ground, Labeled(scene.labels, ROLES)))


@settings(max_examples=60)
@given(scenes, st.booleans(), st.booleans(), st.booleans())
def test_cleared_cells_match_the_twin(given: list, by_height: bool, of_road: bool, of_vehicles: bool) -> None:
    scene, cells = Scene(given), top_view().labels
    found, grid = cells.copy(), Grid(VIEW.x_range_m[1], VIEW.y_range_m[1], VIEW.cell_m)
    is_vehicle = (np.arange(256) > 1) & of_vehicles
    in_box = np.random.default_rng(len(given)).random(cells.shape) < 0.3
    drivable, marks = 1 if of_road else 255, np.zeros(cells.shape, np.uint8)
    args = scene.cloud, scene.in_view, Labeled(scene.labels, ROLES), by_height, voting.Cells(cells, is_vehicle, grid)
    fill_marks(*args, marks)
    clear_cells(marks, np.flatnonzero(marks), drivable, is_vehicle, in_box, found)
    np.testing.assert_array_equal(found, twins.rules.cells(*args, drivable, in_box))


@settings(max_examples=60)
@given(scenes, boxes_of)
def test_points_keep_their_view_and_meet_the_rules(given: list, boxes: list[Box]) -> None:
    scene = Scene(given)
    agreed = agreed_points(scene.points, scene.found, scene.ground, scene.clusters, boxes)
    np.testing.assert_array_equal(scene.labels, scene.found.labels)  # the input is not modified
    assert agreed.classes == CLASSES
    assert agreed.labels.dtype == np.uint8
    np.testing.assert_array_equal(agreed.in_view, scene.in_view)
    assert not agreed.labels[~scene.in_view].any()
    boxed = np.zeros(len(scene.points), np.bool_)
    for box in boxes:
        own = twins.rules.inside(scene.cloud, scene.on_ground, as_rows([box])[0])
        boxed |= own & (box.score >= 0.3)
    for k in range(6):
        own = scene.clusters == k
        if not own.any():
            continue
        share = np.mean(scene.labels[own & scene.in_view] == 1) if (own & scene.in_view).any() else 0.0
        length = np.hypot(*(np.ptp(scene.points[own, c].astype(np.float64)) for c in range(2)))
        is_large = length > voting.MAX_LENGTH_M + 1e-3 or np.max(scene.height[own], initial=-np.inf) > voting.MAX_TOP_M
        if share < (voting.MIN_LARGE_SHARE if is_large else voting.MIN_VEHICLE_SHARE):
            assert not (agreed.labels[own & ~boxed] == 1).any()
    again = agreed_points(scene.points, scene.found, scene.ground, scene.clusters, boxes)
    np.testing.assert_array_equal(agreed.labels, again.labels)


@settings(max_examples=60)
@given(scenes, boxes_of)
def test_no_cell_below_an_object_is_drivable(given: list, boxes: list[Box]) -> None:
    scene, view = Scene(given), top_view()
    agreed = agreed_cells(view, scene.points, scene.found, scene.ground, boxes)
    x, y = np.broadcast_arrays(*VIEW.cell_centers())
    centers = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    for box in boxes:
        flat = replace(box, center=(*box.center[:2], 0.0), size=(box.size[0] - 1e-6, box.size[1] - 1e-6, 1.0))
        assert not agreed.road.ravel()[inside(flat, centers)].any()
    row, col, known = VIEW.cells(*scene.points[:, :2].T.astype(np.float64))
    assert not agreed.road[row[known & (scene.labels > 0)], col[known & (scene.labels > 0)]].any()
    assert not (agreed.road & ~view.road).any()
    other = ~view.road & (agreed.labels != view.labels)  # vehicle cells in which the scan shows something else
    assert not agreed.labels[other].any()
    assert (view.labels[other] > 1).all()
    hit = {*zip(row[known & scene.in_view], col[known & scene.in_view], strict=True)}
    assert {*zip(*np.nonzero(other), strict=True)} <= hit
    by_road_only = agreed_cells(view, scene.points, scene.found, scene.ground, boxes, rules=RULES - {"cells"})
    np.testing.assert_array_equal(by_road_only.labels[~view.road], view.labels[~view.road])
    np.testing.assert_array_equal(agreed.observed, view.observed)


@settings(max_examples=60)
@given(scenes, boxes_of)
def test_only_uncertain_boxes_without_labels_are_dropped(given: list, boxes: list[Box]) -> None:
    scene = Scene(given)
    kept = agree_on_boxes(boxes, Scan.of(scene.points, scene.ground), scene.found)
    assert [box for box in boxes if box in kept] == [*kept]
    for box in boxes:
        own = twins.rules.inside(scene.cloud, scene.on_ground, as_rows([box])[0])
        is_right = np.count_nonzero(own & (scene.labels == 1)) >= 0.1 * np.count_nonzero(own & scene.in_view)
        assert (box in kept) == (box.score >= 0.5 or (own.any() and (is_right or not (own & scene.in_view).any())))


@pytest.mark.parametrize("n", [0, 1])
def test_no_points_and_one_point(n: int) -> None:
    scene = Scene([(5.0, 0.0, 1.2, False, True, 1, 0)][:n])
    box = Box("car", 0.9, (5.0, 0.0, -1.0), (4.0, 1.6, 1.5), 0.0)
    agreed = agreed_points(scene.points, scene.found, scene.ground, scene.clusters, [box])
    assert agreed.labels.tolist() == [1] * n
    assert agree_on_boxes([box], Scan.of(scene.points, scene.ground), agreed) == (box,)
    unsure = replace(box, score=0.4)
    assert agree_on_boxes([unsure], Scan.of(scene.points, scene.ground), agreed) == (unsure,) * n
    assert agreed_cells(top_view(), scene.points, agreed, scene.ground, [box]).drivable.any()


def test_arrays_of_a_scan_must_agree() -> None:
    scene = Scene([(5.0, 0.0, 1.0, False, True, 1, 0)] * 3)
    with pytest.raises(PointsError, match=r"ground.height_m of shape \(3,\) for 2 points"):
        Scan.of(scene.points[:2], scene.ground)
    with pytest.raises(PointsError, match=r"got points of shape \(3,\)"):
        Scan.of(scene.points[:, 0], scene.ground)
    with pytest.raises(PointsError, match=r"labels.in_view of shape \(2,\) for 3 points"):
        Scan.of(scene.points, scene.ground, PointLabels(scene.labels, scene.in_view[:2], CLASSES))
    with pytest.raises(PointsError, match="got label 1 for 1 classes"):
        Scan.of(scene.points, scene.ground, PointLabels(scene.labels, scene.in_view, ("background",)))


def test_rules_are_those_of_the_command_line() -> None:
    assert tuple(sorted(RULES)) == choices.RULES


def block(
    x: float, y: float, size: tuple[float, float, float], label: int, spacing: float = 0.15
) -> NDArray[np.float64]:
    """Points x, y, height, label on the sides of a block that stands on the ground."""
    length, width, height = size
    rows = []
    for z in np.arange(0.2, height, spacing):
        for u in np.arange(-length / 2, length / 2 + 1e-9, spacing):
            rows += [(x + u, y - width / 2, z, label), (x + u, y + width / 2, z, label)]
        for v in np.arange(-width / 2, width / 2, spacing):
            rows += [(x - length / 2, y + v, z, label)]
    return np.array(rows)


def scan_of(rows: NDArray[np.float64], *, ground_m: float = GROUND_Z) -> tuple[Scan, PointLabels]:
    """A scan of rows x, y, height, label, none of them on the ground, which lies ``ground_m`` high, and its labels."""
    points = np.column_stack([rows[:, :2], rows[:, 2] + ground_m, np.zeros(len(rows))]).astype(np.float32)
    labels = PointLabels(rows[:, 3].astype(np.uint8), np.ones(len(rows), np.bool_), CLASSES)
    ground = Ground(np.zeros(len(rows), np.bool_), rows[:, 2].astype(np.float32), (0.0, 0.0, GROUND_Z))
    return Scan.of(points, ground, labels), labels


def agreed_scene(
    *parts: NDArray[np.float64],
    boxes: tuple[Box, ...] = (),
    view: TopView | None = None,
    sight: voting.Sight = voting.EVERYTHING,
    rules: frozenset[str] = RULES,
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Rows x, y, height, label of parts on a floor, and their labels after the agreement."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.0, 30.0, 0.35), np.arange(-15.0, 15.0, 0.35)))
    rows = np.concatenate([np.column_stack([x, y, np.zeros((x.size, 2))]), *parts])
    scan, labels = scan_of(rows)
    points, ground = scan.points, find_ground(scan.points)
    clusters = voters_of(points, labels, ground, boxes, rules)
    return rows, agreed_points(points, labels, ground, clusters, boxes, view=view, sight=sight, rules=rules).labels


CAR = (4.0, 1.7, 1.5)


def test_car_is_completed() -> None:
    car = block(12.0, 3.0, CAR, 1)
    car[: len(car) // 4, 3] = 0
    rows, labels = agreed_scene(car)
    own = rows[:, 2] > 0.0
    assert (labels[own] == 1).all()
    assert not labels[~own].any()


def test_wall_is_no_car() -> None:
    wall = block(12.0, 6.0, (14.0, 0.3, 2.5), 0)
    wall[wall[:, 0] > 11.0, 3] = 1
    assert not agreed_scene(wall)[1].any()
    assert agreed_scene(wall, rules=RULES - {"share"})[1].any()


def test_truck_with_trailer_is_kept() -> None:
    truck = block(14.0, 5.0, (16.0, 2.5, 3.9), 1)
    assert (agreed_scene(truck)[1] == 1).sum() == len(truck)


def test_car_beside_a_hedge_is_kept_where_a_box_is() -> None:
    car, hedge = block(12.0, 3.0, CAR, 1), block(12.0, 4.3, (9.0, 0.4, 1.6), 0)
    rows, labels = agreed_scene(car, hedge)
    assert not labels.any()
    box = Box("car", 0.6, (12.0, 3.0, -1.0), CAR, 0.0)
    rows, labels = agreed_scene(car, hedge, boxes=(box,))
    is_car = rows[:, 3] == 1
    assert (labels[is_car] == 1).all()
    assert not (labels[~is_car & (np.abs(rows[:, 1] - 4.3) < 0.21)]).any()


def without_vehicles(nearest_m: float) -> TopView:
    """A top view from this x on, all of it drivable."""
    geometry = TopViewGeometry((nearest_m, 40.0), (-10.0, 10.0), cell_m=0.2)
    return replace(top_view(view=geometry), labels=np.ones((geometry.height, geometry.width), np.uint8))


def test_block_without_a_cell_of_a_vehicle_is_no_car() -> None:
    """Where the top view has such a cell, a box, or not enough of the block to tell, the block stays a car."""
    car, box = block(12.0, 3.0, CAR, 1), Box("car", 0.4, (12.0, 3.0, -1.0), CAR, 0.0)
    empty = without_vehicles(6.0)
    assert not agreed_scene(car, view=empty)[1].any()
    touched = replace(empty, labels=empty.labels.copy())
    touched.labels[139, 30:40] = 2  # x from 12.0 to 12.2
    road_only = replace(empty, classes=("background", "drivable"))
    for view in (None, touched, without_vehicles(11.0), road_only):
        assert (agreed_scene(car, view=view)[1] == 1).sum() >= len(car)
    assert (agreed_scene(car, view=empty, boxes=(box,))[1] == 1).sum() >= len(car)
    assert (agreed_scene(car, view=empty, rules=RULES - {"cells"})[1] == 1).sum() >= len(car)


def test_pole_is_no_person_and_a_person_under_foliage_is_one() -> None:
    person, pole = block(8.0, 2.0, (0.4, 0.4, 1.75), 2, 0.1), block(8.0, -4.0, (0.2, 0.2, 1.8), 2, 0.1)
    above = block(8.0, -4.0, (0.2, 0.2, 3.5), 0, 0.1)
    foliage = block(8.0, 2.0, (3.0, 3.0, 4.0), 0, 0.2)
    rows, labels = agreed_scene(person, pole, above[above[:, 2] > 1.8], foliage[foliage[:, 2] > 2.4])
    own = (rows[:, 3] == 2) & (rows[:, 1] > 0.0)
    assert (labels[own] == 2).all()
    assert not labels[~own].any()


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_person_at_a_hedge_stays(yaw: float) -> None:
    hedge, person = block(12.0, 4.0, (14.0, 0.4, 1.6), 0, 0.1), block(10.0, 3.5, (0.5, 0.4, 1.7), 2, 0.1)
    for part in (hedge, person):
        part[:, :2] @= np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    rows, labels = agreed_scene(hedge, person)
    assert (labels[rows[:, 3] == 2] == 2).all()
    assert not labels[rows[:, 3] == 0].any()
    assert not agreed_scene(hedge, person, rules=RULES - {"person"})[1].any()


def test_person_at_a_hedge_has_a_box() -> None:
    hedge, person = block(12.0, 4.0, (14.0, 0.4, 1.6), 0, 0.1), block(10.0, 3.5, (0.5, 0.4, 1.7), 2, 0.1)
    rows = np.concatenate([hedge, person])
    scan, labels = scan_of(rows)
    points, ground = scan.points, scan.ground
    complete = find_clusters(points, seeds=labels.labels > 0, min_points=1)
    for clusters in (voters_of(points, labels, ground), complete):
        agreed = agreed_points(points, labels, ground, clusters)
        assert len({*clusters[rows[:, 3] == 2]} - {*clusters[rows[:, 3] == 0]}) == 1
        (box,) = objects_from_points(points, agreed.labels, CLASSES, height_m=ground.height_m, clusters=clusters)
        assert (box.label, np.hypot(box.center[0] - 10.0, box.center[1] - 3.5) < 0.2) == ("pedestrian", True)


def test_points_far_out_do_not_matter_to_a_person_at_a_hedge() -> None:
    person = block(10.0, 3.5, (0.5, 0.4, 1.7), 2, 0.1)
    far = np.array([(np.nan, 0.0, 1.0, 0), (3e38, 3e38, 1.0, 0), (-3e38, 3e38, np.inf, 0)])
    rows = np.concatenate([person, far])
    points, height = rows.astype(np.float32), rows[:, 2].astype(np.float32)
    for yaw in (0.0, 0.7, 2.4):
        points[: len(person), :2] = person[:, :2] @ [[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]]
        before, after = rows[:, 3].astype(np.uint8), np.zeros(len(rows), np.uint8)
        (own,) = voting.find_persons_alone(Cloud(points, height), ROLES, before, after)
        np.testing.assert_array_equal(own, np.arange(len(person)))
        for n in (0, 1, 29):
            few = Cloud(points[:n], height[:n])
            assert voting.find_persons_alone(few, ROLES, before[:n], after[:n]) == []


def test_parts_of_a_hedge_are_no_persons() -> None:
    hedge = block(12.0, 4.0, (14.0, 0.4, 1.6), 0, 0.1)
    sparse = block(10.0, 3.5, (0.4, 0.4, 1.7), 2, 0.4)[:20]
    for other in (block(10.0, 3.5, (0.5, 0.4, 1.2), 2, 0.1), block(10.0, 3.5, (2.6, 0.4, 1.7), 2, 0.2), sparse):
        rows, labels = agreed_scene(hedge, other)
        assert (rows[:, 3] == 2).any()
        assert not labels.any()
    hedge[(np.abs(hedge[:, 0] - 10.0) < 0.25) & (np.arange(len(hedge)) % 2 == 0), 3] = 2
    assert not agreed_scene(hedge)[1].any()


def test_kerb_is_no_car_and_ground_is_car_only_below_cars() -> None:
    kerb, car = block(3.5, 0.0, (1.0, 4.0, 0.3), 1), block(12.0, 3.0, CAR, 1)
    below = np.array([(12.0, 2.15, 0.0, 1), (3.0, -2.0, 0.0, 1), (20.0, 2.0, 0.0, 1)])
    rows, labels = agreed_scene(kerb, car, below)
    assert labels[-3:].tolist() == [1, 0, 0]
    assert not labels[rows[:, 0] < 5.0].any()


def test_road_beside_a_near_car_is_no_car() -> None:
    near, far = block(4.0, 3.0, CAR, 1), block(9.0, -3.0, CAR, 1)
    below = np.array([(4.0, 2.15, 0.0, 1), (9.0, -3.85, 0.0, 1)])
    rows, labels = agreed_scene(near, far, below)
    assert labels[-2:].tolist() == [0, 1]
    assert (labels[rows[:, 2] > 0.0] == 1).all()


def test_near_table_is_no_car() -> None:
    tables = [block(x, 3.0, (2.5, 1.5, 0.95), 1) for x in (10.0, 45.0)]
    rows, labels = agreed_scene(*tables)
    is_near = (rows[:, 2] > 0.0) & (rows[:, 0] < 20.0)
    assert not labels[is_near].any()
    assert (labels[(rows[:, 2] > 0.0) & ~is_near] == 1).all()


@pytest.mark.parametrize(
    ("sight", "n_kept"), [(voting.Sight(0.3, 0.035), 2), (voting.Sight(1.73, 0.035), 0), (voting.EVERYTHING, 0)]
)
def test_a_low_sensor_sees_the_lower_half_of_a_car_and_the_legs_of_a_person(sight: voting.Sight, n_kept: int) -> None:
    rows, labels = agreed_scene(
        block(8.0, 3.0, (3.9, 1.7, 0.55), 1), block(8.0, -4.0, (0.5, 0.4, 0.55), 2, 0.1), sight=sight
    )
    kept = {int(label) for label in labels[rows[:, 2] > 0.0]} - {0}
    assert len(kept) == n_kept


def test_doors_of_the_own_vehicle_are_no_cars_and_a_person_beside_it_stays() -> None:
    doors = [block(1.0, y, (1.0, 0.1, 1.4), 1) for y in (-1.4, 1.4)]
    van, person = block(1.0, 3.6, (5.0, 1.9, 2.0), 1), block(0.5, -2.2, (0.4, 0.4, 1.75), 2, 0.1)
    person[::2, 3] = 1  # doubtful
    rows, labels = agreed_scene(*doors, van, person)
    above = rows[:, 2] > 0.3
    assert not labels[above & (rows[:, 3] == 1) & (np.abs(rows[:, 1]) < 1.5)].any()
    assert (labels[above & (rows[:, 1] > 2.0)] == 1).all()
    assert labels[above & (rows[:, 1] < -1.9)].all()


def test_box_that_the_labels_contradict_labels_nothing() -> None:
    wall = block(12.0, 3.0, (14.0, 0.3, 2.5), 0)
    box = Box("van", 0.9, (12.0, 3.0, -1.0), (4.9, 1.9, 2.1), 0.0)
    assert not agreed_scene(wall, boxes=(box,))[1].any()
    own = np.abs(wall[:, 0] - 12.0) < 2.4
    wall[np.flatnonzero(own)[::8], 3] = 1
    labels = agreed_scene(wall, boxes=(box,))[1]
    assert (labels[-len(wall) :][own & (wall[:, 2] < 2.3)] == 1).all()


def test_rear_of_a_truck_beside_the_own_vehicle_is_no_door() -> None:
    rear = block(0.0, 1.8, (2.5, 0.3, 1.84), 1)
    assert (agreed_scene(rear)[1] == 1).sum() > 0.95 * len(rear)
    assert not agreed_scene(block(0.0, 1.8, (2.5, 0.3, 1.5), 1))[1].any()


@pytest.mark.parametrize(("label", "tall", "least"), [("car", 1.6, 1.4), ("car", 1.2, 1.4), ("van", 2.1, 1.75)])
def test_vehicles_stand_on_the_ground_below_them(label: str, tall: float, least: float) -> None:
    sides = block(12.0, 3.0, (4.0, 1.7, tall + 0.01), 1)
    tree = block(12.0, 3.0, (3.0, 1.0, 4.0), 0)
    rows = np.concatenate([sides, tree[tree[:, 2] > 3.0]])
    scan, found = scan_of(rows, ground_m=-2.3)  # the street is 0.57 m lower than around the sensor
    own, empty = (Box(label, 0.6, (x, 3.0, -0.9), (4.1, 1.8, 1.5), 0.1) for x in (12.0, 30.0))
    person = Box("pedestrian", 0.6, (12.0, 3.0, -0.9), (1.0, 1.0, 1.7), 0.0)
    standing, *others = stand_boxes([own, empty, person], scan, None)
    assert others == [empty, person]
    top = rows[rows[:, 2] < 2.5, 2].max()
    assert standing.size == pytest.approx((4.1, 1.8, max(top, least)), abs=1e-6)
    assert standing.center == pytest.approx((12.0, 3.0, -2.3 + 0.03 + standing.size[2] / 2), abs=1e-6)
    assert replace(standing, center=own.center, size=own.size) == own
    unseen = np.zeros(len(rows), np.bool_)
    for labels in (found, PointLabels(unseen.view(np.uint8), unseen, CLASSES)):
        assert stand_boxes([own], scan, labels) == (standing,)
    assert stand_boxes([own], scan, replace(found, labels=unseen.view(np.uint8))) == (own,)
    assert stand_boxes([own], scan, None, RULES - {"stand"}) == (own,)
    assert stand_boxes([own], Scan.of(scan.points, replace(scan.ground, plane=None)), None) == (own,)


@pytest.mark.parametrize("away", [2.0, 10.0, 20.0, 40.0])
def test_a_far_box_keeps_its_height_where_the_next_return_may_be_missing(away: float) -> None:
    sides = block(away, 0.0, (4.0, 1.7, 1.4), 1)
    box = Box("car", 0.6, (away, 0.0, -0.9), (4.1, 1.8, 1.6), 0.0)
    (standing,) = stand_boxes([box], scan_of(sides)[0], None)
    most = sides[:, 2].max() + 0.015 * away
    assert standing.size[2] == pytest.approx(min(max(most, 1.4), 1.6), abs=1e-6)
    assert (standing.size[2] == 1.6) == (away > 30.0)


def test_cyclist_is_one_object() -> None:
    rider = block(9.0, 1.0, (1.7, 0.5, 1.7), 2, 0.1)
    rider[::3, 3] = 3
    rows, labels = agreed_scene(rider)
    assert (labels[rows[:, 3] > 0] == 3).all()


def test_other_classes_are_not_changed() -> None:
    scene = Scene([(5.0, 0.0, 1.0, False, True, 2, 0)] * 9 + [(5.0, 0.0, 0.0, True, True, 2, -1)])
    found = PointLabels(scene.labels, scene.in_view, ("background", "sign", "road", "tree"))
    agreed = agreed_points(scene.points, found, scene.ground, scene.clusters)
    np.testing.assert_array_equal(agreed.labels, scene.labels)


def test_cells_of_dropped_boxes_are_no_vehicles() -> None:
    view = top_view()
    view.labels[:] = 2
    nothing = np.zeros((0, 4), np.float32)
    ground = Ground(np.zeros(0, np.bool_), np.zeros(0, np.float32), (0.0, 0.0, GROUND_Z))
    kept = Box("car", 0.9, (5.0, 0.0, -1.0), (4.0, 2.0, 1.5), 0.0)
    dropped = replace(kept, center=(7.0, 0.0, -1.0))
    cells = agreed_cells(view, nothing, None, ground, [kept], [dropped]).labels
    assert cells[VIEW.cells(5.1, 0.1)[:2]] == 2
    assert cells[VIEW.cells(6.6, 0.1)[:2]] == 2  # in both
    assert cells[VIEW.cells(8.1, 0.1)[:2]] == 0


@pytest.mark.parametrize("models", ["pointseg", "lodnn", ["ssadnet", "pointseg"]])
def test_perceivers_of_one_view_agree_too(models: str | list[str]) -> None:
    scan = urban(6).points
    options = {"provider": "cpu", "n_threads": 1, "on_mismatch": "ignore"}
    alone, agreed = Perceiver(models, agree=False, **options), Perceiver(models, **options)
    found, without = agreed(scan), alone(scan)
    assert_same(found, agreed(scan))
    assert without.stage_ms["agree"] == 0.0
    if found.points is not None:
        assert (found.points.labels != without.points.labels).any()
    if found.top_view is not None:
        assert (without.top_view.drivable & ~found.top_view.drivable).any()
    assert_same(agreed(scan[:0]), agreed(scan[:0]))
    broken = scan.copy()
    broken[::7] = np.nan
    assert agreed(broken).n_dropped == len(scan[::7])
