from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import twins.cluster
from edgeperc.errors import PointsError
from edgeperc.objects import boxes as object_boxes
from edgeperc.objects import linkage
from edgeperc.objects.boxes import OBJECT_SIZE_M, classes_of_boxes, join_boxes, objects_from_points
from edgeperc.objects.cluster import find_clusters, group_points, labels_of_groups, sort_points
from edgeperc.types.geometry import oriented_iou, rectangles
from edgeperc.types.perception import Box
from edgeperc.types.points import Cloud, read_only

CLASSES = ("background", "car", "pedestrian", "cyclist")


def as_points(xyz: Any) -> np.ndarray:
    return np.column_stack([xyz, np.zeros(len(xyz))]).astype(np.float32)


def side(
    start: tuple[float, float] | np.ndarray,
    end: tuple[float, float] | np.ndarray,
    z: tuple[float, float] = (-1.5, -0.3),
    spacing: float = 0.1,
) -> np.ndarray:
    """Points on an upright rectangle between two places, as a spinning sensor leaves them."""
    n = max(round(math.dist(start, end) / spacing), 1) + 1
    line = np.linspace(start, end, n)
    return np.array([[x, y, height] for height in np.linspace(z[1], z[0], 6) for x, y in line])


def car_points(
    x: float, y: float, yaw: float, *, front: bool = True, flank: bool = True, size: tuple[float, float] = (3.89, 1.63)
) -> np.ndarray:
    """The sides of a car that are turned to the sensor at the origin, and the place of its middle."""
    along, across = size[0] / 2, size[1] / 2
    cos, sin = math.cos(yaw), math.sin(yaw)
    corners = np.array([[along, across], [-along, across], [-along, -across], [along, -across]])
    corners = corners @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    edges = [(corners[k], corners[(k + 1) % 4], k % 2 == 0) for k in range(4)]  # even: flanks
    seen = []
    for start, end, is_flank in edges:
        outward = (start + end) / 2 - (x, y)
        if outward @ ((start + end) / 2) < 0 and (flank if is_flank else front):
            seen.append(side(start, end))
    return np.concatenate(seen)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("per_m", [0.0, 0.02, 0.1])
def test_clusters_match_a_test_of_every_pair(seed: int, per_m: float) -> None:
    rng, near = np.random.default_rng(seed), 0.4 if seed % 2 else 0.5
    centers = rng.uniform(-30, 30, (25, 3)) * [1, 1, 0.1]
    points = as_points(centers[rng.integers(0, 25, 700)] + rng.normal(0, 0.1 * (seed + 1), (700, 3)))
    points[rng.integers(0, 700, 9), rng.integers(0, 3, 9)] = [np.nan, np.inf, -np.inf] * 3
    among = rng.random(700) > 0.1
    found = find_clusters(
        points, among=among, min_distance_m=near, distance_per_m=per_m, max_range_m=28.0, min_points=seed % 3 + 1
    )
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, twins.cluster.clusters(points, among, near, per_m, 28.0, seed % 3 + 1))


# Multiples of the distance's parts, so that points lie on edges of columns and pairs exactly at the distance.
places = st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0, 0.3, -0.2, 0.35, 5.0, -7.5, 99.9, 100.0, 200.0, np.nan, np.inf])


@settings(max_examples=300)
@given(st.lists(st.tuples(places, places, places), max_size=30), st.sampled_from([0.0, 0.05]), st.integers(1, 3))
def test_random_scans_match_the_twin(rows: list[tuple[float, float, float]], per_m: float, min_points: int) -> None:
    points = as_points(np.array(rows).reshape(-1, 3))
    among = np.ones(len(points), bool)
    found = find_clusters(points, min_distance_m=0.5, distance_per_m=per_m, min_points=min_points)
    np.testing.assert_array_equal(found, twins.cluster.clusters(points, among, 0.5, per_m, 100.0, min_points))


def hostile(kind: str, rng: np.random.Generator, n: int) -> np.ndarray:
    """Points that make a clustering by distances up to 0.5 m slow, or lie just inside or outside of it."""
    k = np.arange(n)
    edge = math.ceil(n ** (1 / 3))
    cube = np.column_stack([k % edge, k // edge % edge, k // edge // edge]) - edge / 2
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    on_sphere = rng.normal(size=(n, 3))
    on_sphere /= np.linalg.norm(on_sphere, axis=1)[:, None]
    first = (k % 2)[:, None]
    if kind == "tall column":
        return rng.uniform(0, 1, (n, 3)) * [0.6, 0.6, 200] - [0, 0, 100]
    if kind == "towers":
        return np.column_stack([k % 2 * 0.25, k // 2 % 2 * 0.25, k // 4 * 0.36 % 190 - 95]) + 5
    if kind == "row number for z":
        return np.column_stack([rng.uniform(-3, 3, (n, 2)), k])
    if kind == "identical":
        return np.full((n, 3), 3.3)
    if kind == "line":
        return np.linspace(-1, 1, n)[:, None] * rng.uniform(0, 60, 3)
    if kind == "lattice":
        return cube * rng.choice([0.25, 0.2887, 0.3499, 0.3501, 0.499, 0.5, 0.501, 0.7072])
    if kind == "chains":
        return cube * [0.5005, 0.5005, 0.36] + rng.normal(0, 0.002, (n, 3))
    if kind == "far shell":
        return on_sphere * rng.uniform(0.97, 1.0, (n, 1)) * rng.choice([34.0, 53.0, 66.0, 99.0])
    if kind == "ball":
        return on_sphere * rng.uniform(0, 1, (n, 1)) * rng.choice([1e-3, 0.3, 2.0]) + 4
    if kind == "tilted slabs":
        return np.column_stack([k % 2 * 0.501, rng.uniform(-1, 1, (n, 2))]) @ turn + 5
    if kind == "skew lines":
        place = np.linspace(-0.1, 0.1, n)[:, None]
        return np.where(first, place * [0, 1, 0], place * [0, 0, 1] + [0.5003, 0, 0]) @ turn + 4
    if kind == "arc and axis":  # every point of one is nearly at the distance of every point of the other
        angle, gap = rng.uniform(0, 6.3, n), rng.choice([1e-3, 1e-5])
        arc = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) * (0.5 + gap)
        return np.where(first, arc, np.outer(rng.uniform(-1, 1, n), [0, 0, math.sqrt(gap)])) @ turn
    assert kind == "many scales"
    return np.exp(rng.uniform(-80, 5, (n, 3))) * rng.choice([-1, 1], (n, 3))


KINDS = (
    "tall column", "towers", "row number for z", "identical", "line", "lattice", "chains", "far shell", "ball",
    "tilted slabs", "skew lines", "arc and axis", "many scales",
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=5)
@given(st.integers(0, 2**31), st.sampled_from([0.0, 0.014, 0.1, 1.0]))
def test_hostile_scans_match_the_twin(kind: str, seed: int, per_m: float) -> None:
    points = as_points(hostile(kind, np.random.default_rng(seed), 160))
    found = find_clusters(points, distance_per_m=per_m, min_points=1)
    every = np.ones(len(points), bool)
    np.testing.assert_array_equal(found, twins.cluster.clusters(points, every, 0.5, per_m, 100.0, 1))


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=3)
@given(st.integers(0, 2**31), st.sampled_from([0.014, 0.1]))
def test_the_work_on_hostile_scans_is_bounded(kind: str, seed: int, per_m: float) -> None:
    points = read_only(as_points(hostile(kind, np.random.default_rng(seed), 20_000)))
    every = read_only(np.ones(len(points)), np.bool_)
    clusters, work = np.empty(len(points), np.int32), np.empty(1, linkage.WORK)
    options = every, read_only(np.full(len(points), 3), np.uint8), np.zeros(1), 1
    linkage.fill_clusters(sort_points(points, distance_per_m=per_m), *options, clusters, work)
    assert work["n_compared"] <= 100 * len(points)
    assert work["n_tests"] <= 2 * linkage.TESTS_PER_POINT * len(points)
    again = np.empty_like(clusters)
    linkage.fill_clusters(sort_points(points, distance_per_m=per_m), *options, again, work)
    np.testing.assert_array_equal(again, clusters)


def test_a_scan_that_needs_too_many_tests_is_split_where_no_link_was_found_and_warns() -> None:
    rng = np.random.default_rng(0)
    shell = hostile("far shell", rng, 20_000)
    shell *= (0.5 + 2e-4) / np.linalg.norm(shell, axis=1)[:, None]
    middle = rng.normal(0, 2e-5, (20_000, 3))
    near = np.array([[9.0, 0, 0], [9.4, 0, 0]])
    points = as_points(np.concatenate([shell, middle, near]))
    with pytest.warns(UserWarning, match="64 tests a point"):
        found = find_clusters(points, min_points=1)
    assert found.tolist() == [0] * 20_000 + [1] * 20_000 + [2, 2]


def blobs(seed: int) -> tuple[np.random.Generator, np.ndarray, np.ndarray]:
    """Points around twelve places, and which."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-12, 12, (12, 3)) * [1, 1, 0.1]
    of = rng.integers(0, 12, 200)
    return rng, as_points(centers[of] + rng.normal(0, rng.choice([0.1, 0.4]), (200, 3))), of


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.floats(0.0, 1.0), st.sampled_from([0.0, 0.1]), st.sampled_from([0.0, 0.3, 0.7, 1.0]))
def test_clusters_with_enough_seeds_are_kept(seed: int, share: float, per_m: float, min_share: float) -> None:
    rng, points, of = blobs(seed)
    seeds = (rng.random(200) < share) | (of % 3 == 0)
    among = rng.random(200) > 0.1
    options = {"among": among, "distance_per_m": per_m, "min_points": 3}
    found = find_clusters(points, seeds=seeds, min_share=min_share, **options)
    everything = find_clusters(points, **options)
    expected, number = np.full(200, -1), 0
    for k in range(everything.max(initial=-1) + 1):
        if seeds[everything == k].mean() > min_share:
            expected[everything == k] = number
            number += 1
    np.testing.assert_array_equal(found, expected)


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.sampled_from([(-1.0, -1.0), (0.3, 0.6), (0.6, 0.1), (1.0, 1.0)]))
def test_clusters_with_enough_votes_are_kept(seed: int, min_share: tuple[float, float]) -> None:
    rng, points, of = blobs(seed)
    votes = np.where(rng.random(200) < rng.random(12)[of], rng.choice([0, 1, 3, 5, 7], 200), 1).astype(np.uint8)
    seeds = rng.random(200) < 0.3
    found = find_clusters(points, seeds=seeds, votes=votes, min_share=min_share, min_points=1)
    everything = find_clusters(points, min_points=1)
    expected = np.full(200, -1)
    for k in range(everything.max(initial=-1) + 1):
        own = everything == k
        counted = max(np.count_nonzero(votes[own] & 1), 1)
        shares = [np.count_nonzero(votes[own] & bit) / counted for bit in (2, 4)]
        enough = any(share > least for share, least in zip(shares, min_share, strict=True))
        expected[own] = (k if enough else -2) if seeds[own].any() else -1
    kept, numbers = np.unique(expected[expected >= 0], return_inverse=True)
    expected[expected >= 0] = numbers
    is_certain = (expected != -2) | seeds  # of dropped clusters, some points are not looked at
    np.testing.assert_array_equal(found[is_certain], expected[is_certain])
    assert (found[~is_certain] < 0).all()
    assert found.max(initial=-1) == len(kept) - 1


def test_clusters_are_those_of_dbscan_with_one_sample() -> None:
    csgraph, spatial = pytest.importorskip("scipy.sparse.csgraph"), pytest.importorskip("scipy.spatial")
    rng = np.random.default_rng(1)
    points = as_points(rng.uniform(-6, 6, (800, 3)) * [1, 1, 0.3])
    tree = spatial.cKDTree(points[:, :3].astype(np.float64))
    graph = tree.sparse_distance_matrix(tree, 0.5, output_type="coo_matrix")
    _, components = csgraph.connected_components(graph)
    first = [np.flatnonzero(components == component)[0] for component in components]
    found = find_clusters(points, distance_per_m=0.0, min_points=1)
    np.testing.assert_array_equal([np.flatnonzero(found == number)[0] for number in found], first)


def test_far_points_may_be_farther_apart() -> None:
    pairs = as_points([[5, 0, 0], [5, 0.8, 0], [60, 0, 0], [60, 0.8, 0]])
    assert find_clusters(pairs, min_points=1).tolist() == [0, 1, 2, 2]
    assert find_clusters(pairs, min_points=1, distance_per_m=0.0).tolist() == [0, 1, 2, 3]


def test_clusters_are_numbered_by_their_first_points() -> None:
    rng = np.random.default_rng(2)
    points = as_points(np.repeat(rng.uniform(-50, 50, (40, 3)), 6, axis=0))
    order = rng.permutation(len(points))
    found = find_clusters(points[order])
    assert found.max() == 39
    assert [np.flatnonzero(found == k)[0] for k in range(40)] == sorted(
        np.flatnonzero(found == k)[0] for k in range(40)
    )
    renamed = find_clusters(points)[order]
    assert len({*zip(found.tolist(), renamed.tolist(), strict=True)}) == 40


@pytest.mark.parametrize("points", [np.zeros((0, 4)), np.full((7, 4), np.nan), np.full((3, 4), np.inf)])
def test_scan_without_finite_points_has_no_clusters(points: np.ndarray) -> None:
    assert (find_clusters(points.astype(np.float32), min_points=1) == -1).all()
    assert objects_from_points(points.astype(np.float32), np.zeros(len(points), np.uint8), CLASSES) == ()


def test_one_point_is_a_cluster_if_min_points_is_1() -> None:
    point = as_points([[3.0, 1.0, 0.0]])
    assert find_clusters(point, min_points=1).tolist() == [0]
    assert find_clusters(point).tolist() == [-1]


@pytest.mark.parametrize(
    "options",
    [
        {"min_distance_m": 0.0},
        {"min_distance_m": np.nan},
        {"min_distance_m": 0.001},
        {"distance_per_m": -0.1},
        {"max_range_m": np.inf},
        {"max_range_m": 0.0},
        {"among": np.ones(3, bool)},
        {"seeds": np.ones(3, bool)},
    ],
)
def test_impossible_options_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(PointsError, match="expected"):
        find_clusters(np.zeros((2, 4), np.float32), **options)
    with pytest.raises(PointsError, match="expected"):
        find_clusters(np.zeros((2, 2), np.float32))


def test_clusters_have_their_most_frequent_class() -> None:
    clusters = np.repeat(np.array([0, 1, 2, 3, -1], np.int32), 10)
    labels = np.array([1] * 8 + [0] * 2 + [1] * 7 + [0] * 3 + [2] * 5 + [3] * 5 + [0] * 10 + [1] * 10, np.uint8)
    classes, shares = labels_of_groups(group_points(clusters), labels)
    assert classes.tolist() == [1, 1, 2, 0]
    np.testing.assert_allclose(shares, [0.8, 0.7, 0.5, 0.0])


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.integers(1, 400), st.sampled_from([2, 4, 256]))
def test_votes_agree_with_the_twin(seed: int, n: int, n_labels: int) -> None:
    rng = np.random.default_rng(seed)
    clusters = rng.integers(-1, max(n // 10, 1), n).astype(np.int32)
    labels = rng.integers(0, n_labels, n).astype(np.uint8)
    classes, shares = labels_of_groups(group_points(clusters), labels)
    expected, expected_shares = twins.cluster.votes(clusters, labels)
    np.testing.assert_array_equal(classes, expected)
    np.testing.assert_array_equal(shares, expected_shares)


def test_no_cluster_has_no_class() -> None:
    for clusters in (np.zeros(0, np.int32), np.full(4, -1, np.int32)):
        classes, shares = labels_of_groups(group_points(clusters), np.zeros(len(clusters), np.uint8))
        assert classes.shape == shares.shape == (0,)


@settings(max_examples=60)
@given(st.integers(1, 700), st.integers(0, 2**31), st.booleans())
def test_rectangles_agree_with_the_twin(n: int, seed: int, l_shaped: bool) -> None:
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, np.pi)
    members = (
        rng.uniform(-1, 1, (n, 2))
        * [2.0, 0.8]
        @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    )
    points = np.c_[members + rng.uniform(-30, 30, 2), rng.uniform(-2, 1, n)].astype(np.float32)
    height, rows = rng.uniform(-1, 2, n).astype(np.float32), rng.permutation(n)[: rng.integers(1, n + 1)]
    rectangle, levels = np.empty(5), np.empty(len(rows))
    args = Cloud(read_only(points), read_only(height)), rows.astype(np.int32), l_shaped
    assert object_boxes.fill_rectangle(*args, rectangle, levels) == points[rows, 2].max()
    expected = twins.cluster.rectangle(points[rows, :2].astype(np.float64), l_shaped)
    np.testing.assert_allclose(rectangle, expected, atol=1e-8)
    np.testing.assert_array_equal(levels, points[rows, 2].astype(np.float64) - height[rows])


@pytest.mark.parametrize("where", [(12.0, 5.0), (-9.0, 7.0), (-15.0, -4.0), (8.0, -20.0)])
@pytest.mark.parametrize("yaw", [0.0, 0.5, 1.2, -0.9])
def test_a_car_gets_its_box_all_around_the_vehicle(where: tuple[float, float], yaw: float) -> None:
    points = as_points(car_points(*where, yaw))
    (box,) = objects_from_points(points, np.ones(len(points), np.uint8), CLASSES)
    assert box.label == "car"
    truth = (*where, 3.89, 1.63, yaw)
    assert oriented_iou([truth], [(*box.center[:2], *box.size[:2], box.yaw)])[0, 0] > 0.9
    assert -math.pi / 2 <= box.yaw <= math.pi / 2


@pytest.mark.parametrize("part", [{"flank": False}, {"front": False}])
@pytest.mark.parametrize("x", [15.0, -15.0])
def test_hidden_side_is_extended_to_the_usual_length(part: dict[str, bool], x: float) -> None:
    points = as_points(car_points(x, 6.0, 0.0, **part))
    (box,) = objects_from_points(points, np.ones(len(points), np.uint8), CLASSES)
    np.testing.assert_allclose(box.size[:2], OBJECT_SIZE_M["car"][:2], atol=0.06)
    np.testing.assert_allclose(box.center[:2], (x, 6.0), atol=0.06)
    assert abs(box.yaw) < 0.03


@pytest.mark.parametrize("where", [(15.0, 2.0), (-40.0, -3.5), (1.0, 18.0)])
@pytest.mark.parametrize(("width", "depth"), [(1.6, 1.4), (1.9, 1.75), (2.2, 1.5), (1.5, 2.0)])
def test_what_is_seen_of_a_car_from_behind_is_its_width(where: tuple[float, float], width: float, depth: float) -> None:
    """A broad rear and a part of a flank: the flank continues away from the sensor."""
    x, y = where
    heading = 0.0 if abs(x) > abs(y) else math.pi / 2
    points = car_points(x, y, heading, size=(depth, width))
    (box,) = objects_from_points(as_points(points), np.ones(len(points), np.uint8), CLASSES)
    off = (box.yaw - heading + math.pi / 2) % math.pi - math.pi / 2
    assert abs(off) < 0.05
    np.testing.assert_allclose(box.size[:2], (OBJECT_SIZE_M["car"][0], max(width, OBJECT_SIZE_M["car"][1])), atol=0.06)
    near, truth = (np.hypot(*at) - along / 2 for at, along in ((box.center[:2], box.size[0]), (where, depth)))
    assert near == pytest.approx(truth, abs=0.1)


@pytest.mark.parametrize(
    ("size", "height_m", "label", "completed"),
    [
        ((3.9, 1.6), 1.7, "car", (3.9, 1.63, 1.7)),
        ((3.9, 1.6), 1.9, "van", (5.07, 1.91, 2.2)),
        ((3.9, 1.6), 2.5, "truck", (5.07, 1.91, 2.5)),
        ((11.0, 2.5), 1.7, "truck", (11.0, 2.5, 2.2)),
    ],
)
def test_vans_and_trucks_are_known_by_their_size(
    size: tuple[float, float], height_m: float, label: str, completed: tuple[float, ...]
) -> None:
    x, y, _ = car_points(12.0, 6.0, 0.0, size=size).T
    z = np.linspace(-1.73, height_m - 1.73, 40)
    points = as_points(np.column_stack([np.repeat(x, 40), np.repeat(y, 40), np.tile(z, len(x))]))
    for classes, expected in ((CLASSES, label), ((*CLASSES, "truck"), "car"), (("background", "bus"), "bus")):
        (box,) = objects_from_points(points, np.ones(len(points), np.uint8), classes)
        assert box.label == expected
        assert box.label in classes_of_boxes(classes)
        if classes is CLASSES:
            np.testing.assert_allclose(box.size, completed, atol=0.1)


@pytest.mark.parametrize(("x", "y", "yaw"), [(14.0, 9.0, 0.4), (20.0, -6.0, 0.0), (5.0, 18.0, 1.2)])
def test_what_stands_beside_a_vehicle_does_not_widen_its_box(x: float, y: float, yaw: float) -> None:
    beside = np.array([-math.sin(yaw), math.cos(yaw)])
    beside *= math.copysign(1.0, beside @ (x, y))  # away from the sensor
    car = car_points(x, y, yaw, size=(5.07, 1.91))
    stray = side((x, y) + 2.3 * beside, (x, y) + 3.3 * beside, z=(-1.5, -1.0))
    points = as_points(np.concatenate([car, stray]))
    labels = np.ones(len(points), np.uint8)
    clusters = np.zeros(len(points), np.int32)
    (alone,) = objects_from_points(as_points(car), labels[: len(car)], CLASSES, clusters=clusters[: len(car)])
    (box,) = objects_from_points(points, labels, CLASSES, clusters=clusters)
    assert min(cluster_extents(points, box.yaw)) > object_boxes.MAX_WIDTH_M
    assert oriented_iou(rectangles([box]), rectangles([alone]))[0, 0] > 0.8
    # A class that is no vehicle may be as wide as its points.
    (wide,) = objects_from_points(points, labels, ("background", "shed"), clusters=clusters)
    assert min(wide.size[:2]) > object_boxes.MAX_WIDTH_M


def cluster_extents(points: np.ndarray, yaw: float) -> np.ndarray:
    """How far points reach along and across a heading [m]."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.ptp(points[:, :2] @ np.array([[cos, -sin], [sin, cos]]), axis=0)


@pytest.mark.parametrize("n", [2, 3, 500])
def test_a_cluster_as_wide_as_a_street_gets_a_finite_box(n: int) -> None:
    rng = np.random.default_rng(n)
    points = as_points(rng.uniform([10.0, -20.0, -1.5], [50.0, 20.0, 0.0], (n, 3)))
    clusters, labels = np.zeros(n, np.int32), np.ones(n, np.uint8)
    for box in objects_from_points(points, labels, CLASSES, clusters=clusters, min_points=1, min_score=0.0):
        assert np.isfinite([box.score, *box.center, *box.size, box.yaw]).all()


def test_boxes_stand_on_the_ground() -> None:
    points = as_points(car_points(12.0, 6.0, 0.0))
    height = points[:, 2] + np.float32(1.73)
    (box,) = objects_from_points(points, np.ones(len(points), np.uint8), CLASSES, height_m=height)
    assert box.center[2] - box.size[2] / 2 == pytest.approx(-1.73, abs=1e-5)
    assert box.size[2] == pytest.approx(OBJECT_SIZE_M["car"][2])


def test_ground_points_do_not_join_objects() -> None:
    cars = [car_points(12.0, y, 0.0) for y in (5.0, 9.0)]
    x, y = np.meshgrid(np.arange(5.0, 20.0, 0.3), np.arange(0.0, 15.0, 0.3))
    floor = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.73)])
    points = as_points(np.concatenate([*cars, floor]))
    on_ground = np.arange(len(points)) >= len(points) - len(floor)
    labels = np.where(on_ground, 0, 1).astype(np.uint8)
    assert len(objects_from_points(points, labels, CLASSES, among=~on_ground)) == 2
    assert objects_from_points(points, labels, CLASSES) == ()


def test_a_cluster_is_judged_by_its_points_in_view() -> None:
    points = as_points(car_points(12.0, 6.0, 0.0))
    rank = np.argsort(np.argsort(points[:, 0], kind="stable"))

    def boxes(seen: float, labeled: float = 1.0) -> tuple[Box, ...]:
        in_view = rank < seen * len(points)
        labels = (rank < seen * labeled * len(points)).astype(np.uint8)
        return objects_from_points(points, labels, CLASSES, in_view=in_view)

    (whole,) = boxes(1.0)
    for seen in (0.9, 0.7, 0.5, 0.3):
        (box,) = boxes(seen)
        assert replace(box, score=1.0) == replace(whole, score=1.0)
        n, n_seen = len(points), np.count_nonzero(rank < seen * len(points))
        assert box.score == pytest.approx(whole.score * n_seen / (n_seen + 10) * (n + 10) / n)
    assert boxes(0.8, 0.8) != ()
    assert boxes(0.8, 0.6) == ()  # background in view
    assert boxes(30 / len(points)) != ()
    assert boxes(3 / len(points)) == ()
    labels = np.ones(len(points), np.uint8)
    apart = np.where(rank < 3, 0, 2).astype(np.int32)  # no point has number 1
    assert len(objects_from_points(points, labels, CLASSES, clusters=apart, in_view=labels > 0)) == 1


@pytest.mark.parametrize("x", [12.0, 40.0])
def test_what_lies_between_returns_does_not_lower_the_score(x: float) -> None:
    """Of a car 40 m away, two beams may meet 0.6 m of its height."""
    points = car_points(x, 6.0, 0.0)
    points = as_points(points[np.isin(points[:, 2].round(2), (-1.02, -0.78, -0.54))])
    height = points[:, 2] + np.float32(1.73)
    found = objects_from_points(points, np.ones(len(points), np.uint8), CLASSES, height_m=height)
    closer = objects_from_points(points, np.ones(len(points), np.uint8), CLASSES, height_m=height, distance_per_m=0.0)
    top = 1.73 - 0.54
    n = len(points) / (len(points) + 10.0)
    reach = 0.015 * math.hypot(x, 6.0)
    assert found[0].score == pytest.approx(n * min((top + reach) / 1.53, 1.0) ** 2, rel=0.02)
    assert closer[0].score == pytest.approx(n * (top / 1.53) ** 2, rel=0.02)


def test_pieces_of_one_object_are_one_box() -> None:
    points = car_points(20.0, 6.0, 0.0)
    points = as_points(points[(points[:, 0] < 19.6) | (points[:, 0] > 20.4)])  # a pole in front
    assert find_clusters(points).max() == 1
    assert len(objects_from_points(points, np.ones(len(points), np.uint8), CLASSES)) == 1


def test_what_lies_inside_a_better_box_is_no_further_object() -> None:
    """Returns from inside a car, seen through its windows: completed away from the sensor, they would reach beyond."""
    shell = car_points(20.0, 6.0, 0.0)
    inside = side((20.3, 6.2), (21.3, 6.2), z=(-1.4, -0.4))
    points = as_points(np.concatenate([shell, inside]))
    labels = np.ones(len(points), np.uint8)
    clusters = np.repeat(np.array([0, 1], np.int32), [len(shell), len(inside)])
    alone = as_points(inside), labels[len(shell) :], CLASSES
    one = np.zeros(len(inside), np.int32)
    (ghost,) = objects_from_points(*alone, clusters=one)
    (car,) = objects_from_points(points, labels, CLASSES, clusters=clusters)
    assert math.dist(car.center[:2], (20.0, 6.0)) < 0.1
    assert len(join_boxes([car], [ghost])) == 2  # the boxes hardly overlap
    # The same for a box of another source, if it has the better score.
    assert objects_from_points(*alone, clusters=one, others=[replace(car, score=ghost.score + 0.01)]) == ()
    assert objects_from_points(*alone, clusters=one, others=[replace(car, score=ghost.score)]) == (ghost,)
    away = replace(car, center=(20.0, 16.0, 0.0))
    assert objects_from_points(*alone, clusters=one, others=[away]) == (ghost,)


def test_every_class_has_boxes_and_better_ones_come_first() -> None:
    person = side((8.0, -6.0), (8.0, -5.5), z=(-1.7, 0.0))
    points = as_points(np.concatenate([person, car_points(12.0, 6.0, 0.0)]))
    labels = np.array([2] * len(person) + [1] * (len(points) - len(person)), np.uint8)
    boxes = objects_from_points(points, labels, CLASSES)
    assert [box.label for box in boxes] == ["car", "pedestrian"]
    assert 1.0 > boxes[0].score > boxes[1].score > 0.0
    np.testing.assert_allclose(boxes[1].size[1::-1], OBJECT_SIZE_M["pedestrian"][:2], atol=0.01)
    assert objects_from_points(points, labels, CLASSES) == boxes


def test_at_most_1000_clusters_get_a_box() -> None:
    person = side((0.0, -0.3), (0.0, 0.3), z=(-1.7, 0.0), spacing=0.2)
    x, y = np.meshgrid(np.arange(-60.0, 60.0, 3.0), np.arange(-60.0, 60.0, 3.0))
    places = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    points = as_points((places[:, None] + person).reshape(-1, 3))
    boxes = objects_from_points(points, np.full(len(points), 2, np.uint8), CLASSES, min_score=0.0)
    assert find_clusters(points).max() + 1 == x.size > len(boxes) == object_boxes.MAX_OBJECTS == 1000


def test_objects_below_the_ground_are_dropped() -> None:
    points = as_points(side((8.0, -6.0), (8.0, -5.5), z=(-3.5, -2.5)))
    height = points[:, 2] + np.float32(1.73)
    for label in (1, 2):
        assert objects_from_points(points, np.full(len(points), label, np.uint8), CLASSES, height_m=height) == ()


def test_pole_scores_lower_than_a_person() -> None:
    def score(top: float, label: int) -> float:
        points = as_points(side((8.0, -6.0), (8.0, -5.3), z=(-1.7, top)))
        boxes = objects_from_points(points, np.full(len(points), label, np.uint8), CLASSES, min_score=0.0)
        return boxes[0].score

    for person in (2, 3):
        assert score(0.0, person) > 1.3 * score(0.5, person) > 1.3 * score(0.7, person) > 0.0
    assert score(0.0, 1) == score(0.7, 1)  # as tall as a van


def test_class_without_usual_size_has_the_size_of_its_points() -> None:
    points = as_points(side((8.0, -6.0), (8.0, -4.0), z=(-1.7, 0.0)))
    (box,) = objects_from_points(points, np.ones(len(points), np.uint8), ("background", "sign"))
    np.testing.assert_allclose(box.size, (2.0, object_boxes.MIN_SIDE_M, 1.7), atol=1e-5)
    assert abs(box.yaw) == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(
    ("labels", "options", "message"),
    [
        (np.zeros(3, np.uint8), {}, "one value a point"),
        (np.full(4, 9, np.uint8), {}, "label 9 for 4 classes"),
        (np.zeros(4, np.uint8), {"in_view": np.ones(3, bool)}, "in_view of shape"),
        (np.zeros(4, np.uint8), {"among": np.zeros(3, bool)}, "among"),
        (np.zeros(4, np.uint8), {"height_m": np.zeros(5, np.float32)}, "height_m"),
    ],
)
def test_arrays_of_another_scan_are_refused(labels: np.ndarray, options: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(PointsError, match=message):
        objects_from_points(np.zeros((4, 4), np.float32), labels, CLASSES, **options)
