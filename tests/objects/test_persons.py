"""Boxes of persons: who is one person, and the kernels that find it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from agreeing import agreed_points, voters_of
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.recfunctions import structured_to_unstructured

import twins.persons
from edgeperc.agreement.rules import RULES, cells_of
from edgeperc.agreement.votes import CLUSTER, Tallies, fill_tallies, may_be_persons
from edgeperc.ground.planes import Ground
from edgeperc.objects import persons
from edgeperc.objects.boxes import OBJECT_SIZE_M, join_boxes, objects_from_points
from edgeperc.objects.cluster import RIDES, WALKS, Groups, fill_groups, find_clusters
from edgeperc.types.geometry import oriented_iou
from edgeperc.types.perception import Box, PointLabels
from edgeperc.types.points import Cloud, Labeled

CLASSES = ("background", "car", "pedestrian", "cyclist")
GROUND_Z = -1.73
BY_ANGLE = 0.014  # of an HDL-64E
ROLES = np.zeros(256, np.uint8)
ROLES[[2, 3, 4]] = WALKS, RIDES, persons.UNSEEN


def person(x: float, y: float, height: float = 1.75) -> np.ndarray:
    """What a sensor at the origin sees of a person: legs, a torso 0.5 m wide, and a head, as upright arcs."""
    away = math.hypot(x, y)
    heights = np.arange(0.15, height, max(0.007 * away, 0.02))
    found = []
    for z in heights:
        half = 0.12 if z > height - 0.25 else 0.25
        n = max(int(2 * half / (0.003 * away)), 2)
        across = np.linspace(-half, half, n)
        depth = 0.12 * (across / half) ** 2 - 0.12
        found.append(np.column_stack([depth, across, np.full(n, z + GROUND_Z)]))
    xyz = np.concatenate(found)
    cos, sin = x / away, y / away
    xyz[:, :2] = xyz[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return xyz


def upright(
    x: float, y: float, width: float, depth: float, z: tuple[float, float] = (0.2, 1.75), spacing: float = 0.06
) -> np.ndarray:
    """Points in an upright block, all around the place."""
    u, v = np.arange(-width / 2, width / 2 + 0.01, spacing), np.arange(-depth / 2, depth / 2 + 0.01, spacing)
    h = np.arange(*z, 0.07)
    return np.stack(np.meshgrid(v + x, u + y, h + GROUND_Z), -1).reshape(-1, 3)


def boxes_of(*parts: np.ndarray, labels: Sequence[int] | None = None, **options: Any) -> tuple[Box, ...]:
    """Boxes of parts whose points are all labeled; of pedestrians by default."""
    xyz = np.concatenate(parts)
    points = np.column_stack([xyz, np.zeros(len(xyz))]).astype(np.float32)
    own = np.repeat(labels or [2] * len(parts), [len(part) for part in parts]).astype(np.uint8)
    height = points[:, 2] - np.float32(GROUND_Z)
    options = {"height_m": height, "distance_per_m": BY_ANGLE} | options
    return objects_from_points(points, own, CLASSES, **options)


def one_cluster(*parts: np.ndarray) -> np.ndarray:
    return np.zeros(sum(map(len, parts)), np.int32)


def iou(
    box: Box, x: float, y: float, size: tuple[float, float] = OBJECT_SIZE_M["pedestrian"][:2], yaw: float = 0.0
) -> float:
    return oriented_iou([(*box.center[:2], *box.size[:2], box.yaw)], [(x, y, *size, yaw)])[0, 0]


@pytest.mark.parametrize("where", [(8.0, 0.0), (12.0, -9.0), (-14.0, 3.0), (0.0, 25.0)])
def test_a_person_seen_from_one_side_gets_a_box_of_a_persons_size_around_the_points(where: np.ndarray) -> None:
    xyz = person(*where)
    (box,) = boxes_of(xyz)
    assert box.label == "pedestrian"
    length, width, height = OBJECT_SIZE_M["pedestrian"]  # the longer side is that of the shoulders
    np.testing.assert_allclose(box.size, (width, length, height), atol=0.03)
    assert math.dist(box.center[:2], where) < 0.15
    cos, sin = math.cos(box.yaw), math.sin(box.yaw)
    offsets = (xyz[:, :2] - box.center[:2]) @ np.array([[cos, -sin], [sin, cos]])
    assert (np.abs(offsets) <= np.array(box.size[:2]) / 2 + 1e-6).all()
    assert box.center[2] - box.size[2] / 2 == pytest.approx(GROUND_Z, abs=1e-5)
    assert box.score > 0.7


@pytest.mark.parametrize("turn", [-1.4, -0.5, 0.0, 0.3, 1.1, 1.5])
@pytest.mark.parametrize("label", [2, 3])
def test_pedestrians_look_across_their_longer_side_and_riders_along_it(turn: float, label: int) -> None:
    rng = np.random.default_rng(5)
    cos, sin = math.cos(turn), math.sin(turn)
    xyz = rng.uniform((-0.35, -0.15, GROUND_Z), (0.35, 0.15, GROUND_Z + 1.75), (600, 3))
    xyz[:, :2] = xyz[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + (9.0, 1.0)
    (box,) = boxes_of(xyz, labels=[label])
    expected = turn + (math.pi / 2 if label == 2 else 0.0)
    assert math.sin(2 * (box.yaw - expected)) == pytest.approx(0.0, abs=0.2)
    assert math.cos(2 * (box.yaw - expected)) > 0.9
    assert (box.size[0] > box.size[1]) == (label == 3)


@pytest.mark.parametrize("away", [8.0, 15.0, 22.0])
@pytest.mark.parametrize("apart", [0.55, 0.7, 0.9])
@pytest.mark.parametrize("n", [2, 3, 5])
def test_people_side_by_side_have_a_box_each(away: float, apart: float, n: int) -> None:
    places = [(away, (k - (n - 1) / 2) * apart) for k in range(n)]
    boxes = boxes_of(*(person(*place) for place in places))
    assert [box.label for box in boxes] == ["pedestrian"] * n
    nearest = [min(math.dist(box.center[:2], place) for box in boxes) for place in places]
    assert max(nearest) < 0.25


@pytest.mark.parametrize(("apart", "n"), [(1.2, 1), (1.9, 2)])
def test_boxes_of_cyclists_do_not_overlap(apart: float, n: int) -> None:
    parts = [person(15.0, 0.0), person(15.0, apart)]
    clusters = np.repeat(np.array([0, 1], np.int32), [len(part) for part in parts])
    assert [box.label for box in boxes_of(*parts, labels=[3, 3], clusters=clusters)] == ["cyclist"] * n
    assert [box.label for box in boxes_of(*parts, labels=[2, 2], clusters=clusters)] == ["pedestrian"] * 2


def test_a_person_in_a_stride_is_one_person() -> None:
    foot = upright(10.0, 0.0, 1.0, 0.1, z=(0.15, 0.3))
    (box,) = boxes_of(np.concatenate([person(10.0, 0.0), foot]))
    assert box.label == "pedestrian"


def test_a_person_beside_a_wall_gets_a_box() -> None:
    wall = upright(12.4, 0.0, 8.0, 0.1, z=(0.2, 3.0))
    (box,) = boxes_of(wall, person(12.0, 1.0), labels=[0, 2], clusters=one_cluster(wall, person(12.0, 1.0)))
    assert box.label == "pedestrian"
    assert math.dist(box.center[:2], (12.0, 1.0)) < 0.2


def test_the_labeled_part_of_a_wall_scores_low() -> None:
    wall, part = upright(12.0, 0.0, 8.0, 0.1, z=(0.2, 3.0)), person(12.0, 1.0)
    (alone,) = boxes_of(part)
    together = one_cluster(wall, part[::4])
    sparse = boxes_of(wall, part[::4], labels=[0, 2], clusters=together, min_score=0.0)
    assert max(box.score for box in sparse) < 0.5 * alone.score


def test_a_person_of_whom_a_part_is_labeled_gets_a_whole_box() -> None:
    xyz = person(9.0, 2.0)
    low = xyz[:, 2] < GROUND_Z + 0.9
    (box,) = boxes_of(xyz[low], xyz[~low], labels=[0, 2])
    assert iou(box, 9.0, 2.0, yaw=math.atan2(2.0, 9.0) + math.pi / 2) > 0.5


@pytest.mark.parametrize("away", [10.0, 20.0])
@pytest.mark.parametrize("alike", [True, False])
def test_a_pedestrian_longer_than_a_stride_is_a_cyclist(away: float, alike: bool) -> None:
    bicycle = upright(away, 0.0, 1.7, 0.1, z=(0.15, 0.9))
    rider = upright(away, 0.1, 0.45, 0.2, z=(0.9, 1.65))
    walking, pair = person(away, -8.0), [person(away, 8.0), person(away, 8.6)]
    xyz = np.concatenate([walking, *pair, bicycle, rider])
    points = np.column_stack([xyz, np.zeros(len(xyz))]).astype(np.float32)
    is_rider = np.arange(len(xyz)) >= len(xyz) - len(bicycle) - len(rider)
    labels = np.where(is_rider & (np.arange(len(xyz)) % 5 == 0), 0 if alike else 3, 2).astype(np.uint8)
    found = PointLabels(labels, np.ones(len(labels), np.bool_), CLASSES)
    ground = Ground(np.zeros(len(labels), np.bool_), points[:, 2] - np.float32(GROUND_Z), (0.0, 0.0, GROUND_Z))
    clusters = voters_of(points, found, ground)
    agreed = agreed_points(points, found, ground, clusters)
    assert (agreed.labels == np.where(is_rider, 3, 2)).all()
    without = agreed_points(points, found, ground, clusters, rules=RULES - {"person", "fill"})
    assert without.labels.tolist() == labels.tolist()
    boxes = objects_from_points(points, agreed.labels, CLASSES, height_m=ground.height_m, clusters=clusters)
    (cyclist,) = (box for box in boxes if box.label == "cyclist")
    assert iou(cyclist, away, 0.0, OBJECT_SIZE_M["cyclist"][:2], math.pi / 2) > 0.6
    assert len(boxes) == 4


def test_a_board_is_no_row_of_people() -> None:
    assert boxes_of(upright(15.0, 0.0, 1.6, 0.05)) == ()
    people = boxes_of(*(person(15.0, y) for y in (-0.8, 0.0, 0.8)))
    assert len(people) == 3


def test_near_fragments_score_lower_than_persons() -> None:
    fragment = person(8.0, 0.0)[::15]
    scores = [boxes_of(fragment, min_score=0.0, distance_per_m=per_m)[0].score for per_m in (0.0, BY_ANGLE)]
    assert scores[1] < 0.6 * scores[0]
    assert boxes_of(person(8.0, 0.0))[0].score > 0.7


def test_a_person_is_kept_beside_a_vehicle_of_lower_score() -> None:
    standing = Box("pedestrian", 0.8, (10.0, 0.9, -0.8), (0.85, 0.66, 1.76), 0.0)
    for score, expected in ((0.6, ["pedestrian", "car"]), (0.9, ["car"])):
        car = Box("car", score, (10.0, 0.0, -1.0), (4.0, 1.8, 1.5), 0.0)
        assert [box.label for box in join_boxes([car], [standing])] == expected


def test_models_with_one_class_of_persons_use_it() -> None:
    xyz = upright(10.0, 0.0, 1.7, 0.1, z=(0.15, 1.6))[:, :3]
    points = np.column_stack([xyz, np.zeros(len(xyz))]).astype(np.float32)
    for name in ("pedestrian", "cyclist"):
        found = objects_from_points(points, np.ones(len(points), np.uint8), ("background", name), min_score=0.0)
        assert {box.label for box in found} == {name}


@pytest.mark.parametrize("n", [0, 1, 4])
def test_too_few_points_have_no_box(n: int) -> None:
    points = np.tile(np.array([[8.0, 1.0, -1.0, 0.0]], np.float32), (n, 1))
    assert objects_from_points(points, np.full(n, 2, np.uint8), CLASSES, min_score=0.0) == ()


def test_points_that_are_not_finite_are_in_no_box() -> None:
    xyz = np.concatenate([person(8.0, 0.0), np.full((4, 3), np.nan), [[np.inf, 0, 0], [0, -np.inf, 0]]])
    (box,) = boxes_of(xyz)
    assert np.isfinite([*box.center, *box.size, box.yaw, box.score]).all()
    points = np.column_stack([xyz, np.zeros(len(xyz))]).astype(np.float32)
    together = np.zeros(len(points), np.int32)
    assert objects_from_points(points, np.full(len(points), 2, np.uint8), CLASSES, clusters=together) == ()


def test_without_clusters_and_heights_the_boxes_are_the_same() -> None:
    xyz = person(8.0, 0.0)
    xyz[0, 2] = GROUND_Z
    points = np.column_stack([xyz, np.zeros(len(xyz))]).astype(np.float32)
    labels = np.full(len(points), 2, np.uint8)
    (known,) = objects_from_points(points, labels, CLASSES, clusters=find_clusters(points))
    assert objects_from_points(points, labels, CLASSES) == (known,)
    (on_ground,) = objects_from_points(points, labels, CLASSES, height_m=points[:, 2] - np.float32(GROUND_Z))
    np.testing.assert_allclose(on_ground.center, known.center, atol=1e-5)


def crowd(
    seed: int, n_people: int, per_cluster: int = 3, depth: float = 0.15
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """People at random places, with labels, heights and clusters; the rows are shuffled."""
    rng = np.random.default_rng(seed)
    middles = rng.uniform(-20, 20, (max(n_people // per_cluster, 1), 2))
    parts, of = [np.zeros((0, 3))], []
    for k in range(n_people):
        x, y = middles[k % len(middles)] + rng.uniform(-1.5, 1.5, 2)
        parts.append(rng.normal(0, 1, (int(rng.integers(1, 90)), 3)) * [depth, 0.15, 0.4] + (x, y, 1.0))
        of += [k % len(middles)] * len(parts[-1])
    xyz = np.concatenate(parts)
    shuffled = rng.permutation(len(xyz))
    points = np.column_stack([xyz, np.zeros(len(xyz))])[shuffled].astype(np.float32)
    height = (points[:, 2] + rng.normal(0, 0.02, len(points))).astype(np.float32)
    share = rng.choice([0.05, 0.4, 1.0], len(middles))
    clusters = np.array(of, np.int32)[shuffled]
    chosen = rng.random(len(points)) < share[clusters] if len(points) else np.zeros(0, bool)
    labels = np.where(chosen, rng.choice([2, 2, 2, 3], len(points)), 0).astype(np.uint8)
    clusters[rng.random(len(points)) < 0.03] = -1
    return points, height, labels, clusters


def grouped(clusters: np.ndarray) -> Groups:
    groups = Groups(np.empty(len(clusters), np.int32), np.empty(clusters.max(initial=-1) + 2, np.int64))
    fill_groups(clusters, groups)
    return Groups(groups.order[: groups.starts[-1]], groups.starts)


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.integers(0, 14))
def test_groups_agree_with_the_twin(seed: int, n_people: int) -> None:
    points, height, labels, clusters = crowd(seed, n_people)
    labels[np.random.default_rng(seed).random(len(labels)) < 0.05] = 4  # out of view
    order, starts = grouped(clusters)
    groups, loose = Groups(np.empty_like(order), np.empty_like(starts)), np.empty_like(order)
    labeled = Labeled(labels, ROLES)
    n, n_loose = persons.fill_person_groups(Cloud(points, height), labeled, Groups(order, starts), groups, loose)
    whole, others = twins.persons.groups(Cloud(points, height), labeled, clusters)
    found = [groups.order[groups.starts[k] : groups.starts[k + 1]].tolist() for k in range(n)]
    assert found == [members.tolist() for members in whole]
    assert loose[:n_loose].tolist() == others


@settings(max_examples=80)
@given(st.integers(0, 2**31), st.integers(0, 14), st.integers(1, 6))
def test_persons_agree_with_the_twin(seed: int, n_people: int, min_points: int) -> None:
    points, height, labels, clusters = crowd(seed, n_people)
    labels[np.random.default_rng(seed).random(len(labels)) < 0.05] = 4  # out of view
    order, starts = grouped(clusters)
    groups = [order[starts[k] : starts[k + 1]].copy() for k in range(len(starts) - 1) if starts[k] < starts[k + 1]]
    n_whole = len(groups) // 2
    given_order = np.concatenate([np.zeros(0, np.int32), *groups]).astype(np.int32)
    whole = Groups(given_order, np.cumsum([0, *map(len, groups)]))
    records, scan = np.empty(len(points), persons.PERSON), (Cloud(points, height), Labeled(labels, ROLES))
    n = persons.fill_persons(*scan, whole, n_whole, clusters, Groups(order, starts), min_points, records)
    found = structured_to_unstructured(records)
    expected = twins.persons.rows(*scan, groups, n_whole, clusters, min_points)
    assert n == len(expected)
    assert sorted(given_order.tolist()) == sorted(order.tolist())
    np.testing.assert_allclose(found[:n, :5], expected[:, :5], atol=1e-6)
    np.testing.assert_allclose(found[:n, 6:], expected[:, 6:], atol=1e-6)
    turns = np.abs(found[:n, 5] - expected[:, 5])
    assert (np.minimum(turns, math.pi - turns) < 1e-4)[found[:n, 3] > found[:n, 4] + 1e-3].all()


@settings(max_examples=80)
@given(st.integers(0, 2**31), st.integers(0, 14))
def test_completed_persons_agree_with_the_twin(seed: int, n_people: int) -> None:
    points, height, labels, clusters = crowd(seed, n_people, per_cluster=1, depth=0.4)
    in_view = np.random.default_rng(seed).random(len(points)) < 0.9
    n = clusters.max(initial=-1) + 1
    tallies, cloud = Tallies(np.empty(n, CLUSTER), np.empty((n, 5), np.int32)), Cloud(points, height)
    fill_tallies(cloud, in_view, labels, clusters, cells_of(None), tallies)
    expected = twins.persons.completed(cloud, in_view, clusters, 2, 3, labels)
    persons.complete_persons(cloud, in_view, clusters, may_be_persons(tallies, 2, 3), 2, 3, labels)
    np.testing.assert_array_equal(labels, expected)


@pytest.mark.parametrize("n", [0, 1, 3, 200])
def test_the_parts_of_the_kernel_agree_with_their_twins(n: int) -> None:
    rng = np.random.default_rng(n)
    points = (rng.normal(0, 1, (n, 4)) * [0.9, 0.2, 0.5, 0] + [7, 3, 1, 0]).astype(np.float32)
    height = points[:, 2].copy()
    members = rng.permutation(n).astype(np.int32)
    for above in (-math.inf, 1.0, 99.0):
        cloud = Cloud(points, height)
        found = persons.measure(cloud, members, above)
        np.testing.assert_allclose(found, twins.persons.measured(cloud, members, above), atol=1e-6)
        if n:
            own = persons.border_of(cloud, members, above, found)
            assert own == pytest.approx(twins.persons.border(cloud, members, above, found))
            own = persons.head_width(cloud, members, found)
            assert own == pytest.approx(twins.persons.heads(cloud, members, found))


def test_hostile_groups_are_bounded() -> None:
    rng = np.random.default_rng(0)
    points = (rng.uniform(-1, 1, (3000, 4)) * 1e30).astype(np.float32)
    height = np.ones(3000, np.float32)
    members = np.arange(3000, dtype=np.int32)
    found, of = np.empty(100, persons.PERSON), np.zeros(3000, np.int32)
    labeled = Labeled(np.full(3000, 2, np.uint8), ROLES)
    clusters = Groups(members, np.array([0, 3000]))

    def n_found() -> int:
        groups = Groups(members.copy(), clusters.starts)
        return persons.fill_persons(Cloud(points, height), labeled, groups, 1, of, clusters, 1, found)

    assert 0 < n_found() <= 100
    points[7, 0] = np.nan
    assert n_found() == 0
