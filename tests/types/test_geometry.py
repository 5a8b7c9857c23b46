from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

import twins.decode
from edgeperc.errors import PointsError
from edgeperc.types.geometry import (
    bounding_rectangles,
    draw_footprints,
    oriented_iou,
    rectangles,
    shared_area,
    suppress_overlaps,
)
from edgeperc.types.perception import Box
from edgeperc.types.views import TopViewGeometry


def some_rectangles(rng: np.random.Generator, n: int) -> np.ndarray:
    rows = np.empty((n, 5))
    rows[:, :2] = rng.uniform(-4.0, 4.0, (n, 2))
    rows[:, 2:4] = rng.uniform(0.2, 6.0, (n, 2))
    rows[:, 4] = rng.uniform(-4.0, 4.0, n)
    return rows


def shapely_iou(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    first = np.array([shapely.Polygon(twins.decode.rectangle_corners(r)) for r in a])[:, None]
    second = np.array([shapely.Polygon(twins.decode.rectangle_corners(r)) for r in b])[None, :]
    return shapely.area(shapely.intersection(first, second)) / shapely.area(shapely.union(first, second))


def test_iou_agrees_with_shapely_and_with_the_twin() -> None:
    rng = np.random.default_rng(1)
    a, b = some_rectangles(rng, 40), some_rectangles(rng, 50)
    iou = oriented_iou(a, b)
    assert 0.2 < np.mean(iou > 0.0) < 1.0
    np.testing.assert_allclose(iou, shapely_iou(a, b), atol=1e-12)
    np.testing.assert_allclose(iou, twins.decode.oriented_iou(a, b), atol=1e-12)
    np.testing.assert_allclose(iou, oriented_iou(b, a).T, atol=1e-12)


@given(
    st.lists(
        st.tuples(st.integers(-3, 3), st.integers(-3, 3), st.integers(0, 4), st.integers(0, 4), st.integers(-8, 8)),
        max_size=6,
    )
)
def test_iou_of_aligned_touching_and_equal_rectangles(rows: list[tuple[int, ...]]) -> None:
    rectangles = np.array(rows, dtype=np.float64).reshape(-1, 5) * [1.0, 1.0, 1.0, 1.0, np.pi / 4.0]
    iou = oriented_iou(rectangles, rectangles)
    assert ((iou >= 0.0) & (iou <= 1.0)).all()
    np.testing.assert_allclose(np.diag(iou), (rectangles[:, 2:4] > 0.0).all(axis=1), atol=1e-12)
    np.testing.assert_allclose(iou, twins.decode.oriented_iou(rectangles, rectangles), atol=1e-12)


def test_iou_by_hand() -> None:
    square = [0.0, 0.0, 2.0, 2.0, 0.0]
    others = [
        [1.0, 0.0, 2.0, 2.0, 0.0],  # half: 2 / 6
        [0.0, 0.0, 1.0, 1.0, 0.3],  # inside: 1 / 4
        [2.0, 0.0, 2.0, 2.0, 0.0],  # an edge in common
        [0.0, 0.0, 2.0, 2.0, np.pi / 4.0],  # the octagon
        [0.0, 0.0, 4.0, 1.0, np.pi / 2.0],  # a cross: 2 / 6
    ]
    octagon = 8.0 * (np.sqrt(2.0) - 1.0)
    np.testing.assert_allclose(
        oriented_iou([square], others)[0], [1 / 3, 1 / 4, 0.0, octagon / (8.0 - octagon), 1 / 3], atol=1e-12
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 1e200])
@pytest.mark.parametrize("column", range(5))
def test_impossible_rectangles_overlap_nothing(value: float, column: int) -> None:
    strange = np.array([0.0, 0.0, 2.0, 2.0, 0.0])
    strange[column] = value
    iou = oriented_iou([strange], [strange, [0.5, 0.5, 2.0, 2.0, 0.1]])
    assert np.isfinite(iou).all()
    if not np.isfinite(value) or (value < 0.0 and column in (2, 3)):
        assert (iou == 0.0).all()
    assert suppress_overlaps([strange, strange], [0.5, 0.5], 0.5)[0] == 0


def test_empty_and_misshapen() -> None:
    assert oriented_iou([], np.zeros((3, 5))).shape == (0, 3)
    assert suppress_overlaps([], [], 0.5).shape == (0,)
    assert bounding_rectangles([]).shape == (0, 5)
    with pytest.raises(PointsError, match=r"\(3, 4\).*\(n, 5\)"):
        oriented_iou(np.zeros((3, 4)), [])
    with pytest.raises(PointsError, match="one score a rectangle"):
        suppress_overlaps(np.zeros((3, 5)), [0.1], 0.5)
    with pytest.raises(PointsError, match=r"thresholds of shape \(2,\) for 3 rectangles; pass one, or one each"):
        suppress_overlaps(np.zeros((3, 5)), [0.1, 0.2, 0.3], [0.5, 0.5])


def test_suppression_agrees_with_the_twin() -> None:
    rng = np.random.default_rng(2)
    for n in (1, 2, 30):
        rectangles, scores = some_rectangles(rng, n), rng.integers(0, 5, n) / 5.0
        for threshold in (0.0, 0.2, 1.0, rng.choice([0.0, 0.1, 0.3], n)):
            order = np.argsort(-scores, kind="stable")
            ordered = np.broadcast_to(threshold, n)[order]
            expected = order[twins.decode.nms(rectangles[order], ordered)]
            np.testing.assert_array_equal(suppress_overlaps(rectangles, scores, threshold), expected)
            expected = order[twins.decode.nms(rectangles[order], ordered, 0.5)]
            np.testing.assert_array_equal(suppress_overlaps(rectangles, scores, threshold, max_inside=0.5), expected)


def test_suppression_keeps_the_earlier_of_equals_and_chains_greedily() -> None:
    row = [[0.0, 0.0, 4.0, 2.0, 0.0], [2.0, 0.0, 4.0, 2.0, 0.0], [4.0, 0.0, 4.0, 2.0, 0.0]]
    # The middle one overlaps both others by a third; beaten by the first, it does not beat the last.
    assert suppress_overlaps(row, [0.9, 0.8, 0.7], 0.3).tolist() == [0, 2]
    assert suppress_overlaps(row, [0.8, 0.9, 0.7], 0.3).tolist() == [1]
    assert suppress_overlaps(row, [0.5, 0.5, 0.5], 0.3).tolist() == [0, 2]
    assert suppress_overlaps(row, [0.5, 0.5, 0.5], 0.34).tolist() == [0, 1, 2]
    assert suppress_overlaps([row[0], row[0]], [0.5, 0.5], 0.99).tolist() == [0]
    # The lower one of two thresholds counts.
    assert suppress_overlaps(row, [0.9, 0.8, 0.7], [0.5, 0.5, 0.3]).tolist() == [0, 1]
    assert suppress_overlaps(row, [0.9, 0.8, 0.7], [0.3, 0.5, 0.5]).tolist() == [0, 2]


def test_suppression_of_small_rectangles_in_large_ones() -> None:
    rows = [[0.0, 0.0, 10.0, 10.0, 0.0], [1.0, 1.0, 1.0, 1.0, 0.3], [5.1, 0.0, 1.0, 1.0, 0.0]]
    assert suppress_overlaps(rows, [0.9, 0.8, 0.7], 0.1).tolist() == [0, 1, 2]
    assert suppress_overlaps(rows, [0.9, 0.8, 0.7], 0.1, max_inside=0.5).tolist() == [0, 2]


def test_bounds_hold_the_corners_tightly() -> None:
    rectangles = some_rectangles(np.random.default_rng(3), 20)
    for bounds, rectangle in zip(bounding_rectangles(rectangles), rectangles, strict=True):
        corners = twins.decode.rectangle_corners(rectangle)
        np.testing.assert_allclose(bounds[:2] + bounds[2:4] / 2.0, corners.max(axis=0), atol=1e-12)
        np.testing.assert_allclose(bounds[:2] - bounds[2:4] / 2.0, corners.min(axis=0), atol=1e-12)
        assert bounds[4] == 0.0


def test_rectangles_are_the_boxes_footprints() -> None:
    boxes = [Box("car", 1.0, (10.0, -2.0, -1.0), (4.0, 1.7, 1.5), 0.3), Box("van", 0.5, (7, 3, 0), (5, 2, 2), -1)]
    np.testing.assert_array_equal(rectangles(boxes), [[10.0, -2.0, 4.0, 1.7, 0.3], [7, 3, 5, 2, -1]])
    assert rectangles([]).shape == (0, 5)
    assert rectangles(iter(boxes)).dtype == np.float64


def test_shared_area_follows_from_iou() -> None:
    a = np.array([[0.0, 0.0, 4.0, 2.0, 0.0]])
    b = np.array([[1.0, 0.0, 4.0, 2.0, 0.0], [0.0, 0.0, 2.0, 1.0, 0.0], [9.0, 9.0, 4.0, 2.0, 0.0]])
    np.testing.assert_allclose(shared_area(oriented_iou(a, b), a, b), [[6.0, 2.0, 0.0]], rtol=1e-12)
    rng = np.random.default_rng(1)
    c, d = some_rectangles(rng, 20), some_rectangles(rng, 20)
    shared = shared_area(oriented_iou(c, d), c, d)
    assert (shared <= np.minimum.outer(c[:, 2] * c[:, 3], d[:, 2] * d[:, 3]) * (1.0 + 1e-12)).all()


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("layout", ["C", "F"])
def test_footprints_agree_with_the_twin(seed: int, layout: Literal["C", "F"]) -> None:
    rng = np.random.default_rng(seed)
    view = TopViewGeometry((2.0, 22.0), (-7.0, 9.0), cell_m=0.5)
    boxes = [
        Box(name, 0.5, (*rng.uniform(-15.0, 40.0, 2), 0.0), (*rng.uniform(0.1, 14.0, 2), 1.5), yaw)
        for name, yaw in zip(rng.choice(["car", "van", "bus"], 12), rng.uniform(-4.0, 4.0, 12), strict=True)
    ]
    if seed == 0:
        boxes = []
    elif seed == 1:
        boxes.append(Box("car", 0.5, (1e300, 0.0, 0.0), (4.0, 2.0, 1.5), 0.0))
        boxes.append(Box("van", 0.5, (12.0, 1.0, 0.0), (1e300, 1e300, 1.5), 0.3))
    labels = np.require(rng.integers(0, 2, (view.height, view.width)).astype(np.uint8), None, layout)
    expected = labels.copy()
    draw_footprints(labels, boxes, view, ("none", "road", "car", "van"))
    twins.decode.footprints(expected, boxes, view, ("none", "road", "car", "van"))
    np.testing.assert_array_equal(labels, expected)
