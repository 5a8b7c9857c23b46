from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import twins.refine
from edgeperc.errors import PointsError
from edgeperc.objects import refine
from edgeperc.objects.refine import label_points, remove_outliers

CLASSES = ("background", "car", "pedestrian", "cyclist")
RADII = np.array([0.0, *refine.OBJECT_RADIUS_M.values()])


def scene(ranges: np.ndarray, azimuth_step_deg: float = 0.5, elevation_step_deg: float = 0.4) -> tuple[np.ndarray, ...]:
    """Points behind every pixel of an (H, W) image of ranges [m], 0 for none: points, index, pixel."""
    height, width = ranges.shape
    azimuth = np.radians((np.arange(width)[None, :] - width / 2) * -azimuth_step_deg)
    elevation = np.radians((np.arange(height)[:, None] - height / 2) * -elevation_step_deg)
    image = np.stack(
        [
            ranges * np.cos(elevation) * np.cos(azimuth),
            ranges * np.cos(elevation) * np.sin(azimuth),
            ranges * np.sin(elevation) * np.ones_like(azimuth),
            np.zeros(ranges.shape),
        ],
        axis=-1,
    )
    pixel = np.flatnonzero(ranges).astype(np.int32)
    index = np.full(ranges.shape, -1, dtype=np.int32)
    index.reshape(-1)[pixel] = np.arange(len(pixel))
    return np.ascontiguousarray(image.reshape(-1, 4)[pixel], dtype=np.float32), index, pixel


def random_scene(rng: np.random.Generator, shape: tuple[int, int], n_classes: int = 4) -> tuple[np.ndarray, ...]:
    """Blocks at different ranges, some pixels empty, some points hidden behind others."""
    ranges = np.kron(rng.uniform(3.0, 40.0, (-(-shape[0] // 4), -(-shape[1] // 5))), np.ones((4, 5)))
    ranges = ranges[: shape[0], : shape[1]] + rng.normal(0.0, 0.3, shape)
    ranges[rng.random(shape) < 0.1] = 0.0
    points, index, pixel = scene(ranges)
    hidden = rng.integers(0, len(points), len(points) // 2) if len(points) else np.zeros(0, dtype=int)
    points = np.concatenate([points, points[hidden] * rng.uniform(1.0, 1.2, (len(hidden), 1)).astype(np.float32)])
    pixel = np.concatenate([pixel, pixel[hidden]]).astype(np.int32)
    pixel[rng.random(len(pixel)) < 0.1] = -1
    labels = np.kron(rng.integers(0, n_classes, (-(-shape[0] // 3), -(-shape[1] // 7))), np.ones((3, 7)))
    return points, pixel, index, np.ascontiguousarray(labels[: shape[0], : shape[1]], dtype=np.uint8)


def test_bleeding_onto_a_wall_is_removed_and_the_car_stays() -> None:
    ranges = np.full((20, 60), 22.0)
    car = (slice(6, 14), slice(20, 40))
    ranges[car] = 12.0
    points, index, _ = scene(ranges)
    labels = np.zeros(ranges.shape, dtype=np.uint8)
    labels[5:15, 18:42] = 1
    cleaned = remove_outliers(points, index, labels, CLASSES)
    expected = np.zeros_like(labels)
    expected[car] = 1
    np.testing.assert_array_equal(cleaned, expected)
    np.testing.assert_array_equal(remove_outliers(points, index, expected, CLASSES), expected)


@pytest.mark.parametrize("farther", [0.0, 6.0])
def test_two_cars_in_one_component_both_stay(farther: float) -> None:
    ranges = np.full((20, 80), 40.0)
    ranges[6:14, 10:40] = 15.0
    ranges[7:13, 40:70] = 15.0 + farther
    points, index, _ = scene(ranges, azimuth_step_deg=0.8)
    labels = np.where(ranges < 30.0, 1, 0).astype(np.uint8)
    np.testing.assert_array_equal(remove_outliers(points, index, labels, CLASSES), labels)


def test_pedestrian_in_front_of_a_car_loses_the_cars_points() -> None:
    ranges = np.full((20, 40), 9.0)
    ranges[3:17, 18:22] = 6.0
    points, index, _ = scene(ranges)
    labels = np.zeros(ranges.shape, dtype=np.uint8)
    labels[4:16, 8:34] = 1
    labels[2:18, 17:23] = 2
    cleaned = remove_outliers(points, index, labels, CLASSES)
    assert (cleaned[3:17, 18:22] == 2).all()
    assert (cleaned == 2).sum() == 14 * 4
    # What was taken from the pedestrian goes to the background, for nobody said that it is car.
    assert (cleaned[4:16, 17] == 0).all()
    assert (cleaned[labels == 1] == 1).all()


def test_classes_without_a_radius_and_pixels_without_a_point_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    ranges = np.full((6, 30), 10.0)
    ranges[:, 15:] = 40.0
    ranges[2, 3] = 0.0
    points, index, _ = scene(ranges)
    labels = np.full(ranges.shape, 1, dtype=np.uint8)
    np.testing.assert_array_equal(remove_outliers(points, index, labels, ("background", "drivable")), labels)
    with monkeypatch.context() as patch:
        patch.setattr(refine, "OBJECT_RADIUS_M", {"car": 100.0})
        np.testing.assert_array_equal(remove_outliers(points, index, labels, CLASSES), labels)
    assert not remove_outliers(points, index, 0 * labels, CLASSES).any()


def test_an_object_across_the_seam_is_one_object() -> None:
    ranges = np.full((12, 90), 30.0)
    ranges[4:8, [0, 1, 2, 87, 88, 89]] = 8.0
    labels = np.zeros(ranges.shape, dtype=np.uint8)
    labels[3:9, [0, 1, 2, 3, 86, 87, 88, 89]] = 2
    # The same object in the middle of the image, and cut in two by its edges.
    turned = np.concatenate([ranges[:, 45:], ranges[:, :45]], axis=1)
    points, index, _ = scene(turned, azimuth_step_deg=0.3)
    middle = np.concatenate([labels[:, 45:], labels[:, :45]], axis=1)
    expected = remove_outliers(points, index, middle, CLASSES)
    assert 0 < (expected == 2).sum() == 4 * 6
    rolled = np.concatenate([index[:, 45:], index[:, :45]], axis=1)
    cleaned = remove_outliers(points, rolled, labels, CLASSES, full_turn=True)
    np.testing.assert_array_equal(np.concatenate([cleaned[:, 45:], cleaned[:, :45]], axis=1), expected)


def test_a_rim_reaches_across_the_seam() -> None:
    ranges = np.full((12, 90), 30.0)
    ranges[2:10, :6] = 8.0
    labels = np.zeros(ranges.shape, dtype=np.uint8)
    labels[2:10, [88, 89, 0, 1, 2, 3, 4, 5]] = 1
    points, index, _ = scene(ranges)
    # Sixteen points of background bled into over the seam; without it they would be an object of their own.
    assert (remove_outliers(points, index, labels, CLASSES, full_turn=True) == 1).sum() == 8 * 6
    assert (remove_outliers(points, index, labels, CLASSES) == 1).sum() == 8 * 8


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1), (16, 40), (32, 64)])
@pytest.mark.parametrize("full_turn", [False, True])
def test_outliers_agree_with_the_twin(shape: tuple[int, int], full_turn: bool) -> None:
    rng = np.random.default_rng(shape[1])
    for n_classes in (2, 4):
        points, _, index, labels = random_scene(rng, shape, n_classes)
        cleaned = remove_outliers(points, index, labels, CLASSES, full_turn=full_turn)
        np.testing.assert_array_equal(cleaned, twins.refine.without_outliers(points, index, labels, RADII, full_turn))
        assert ((cleaned == labels) | (cleaned == 0)).all()
        again = remove_outliers(points, index, labels, CLASSES, full_turn=full_turn)
        np.testing.assert_array_equal(again, cleaned)


def test_a_component_larger_than_what_is_tested_agrees_with_the_twin() -> None:
    points, _, index, _ = random_scene(np.random.default_rng(8), (24, 64))
    labels = np.full(index.shape, 1, dtype=np.uint8)
    cleaned = remove_outliers(points, index, labels, CLASSES)
    np.testing.assert_array_equal(cleaned, twins.refine.without_outliers(points, index, labels, RADII, False))


def test_one_point_no_point_and_points_that_are_not_finite() -> None:
    one = np.array([[5.0, 0.0, 0.0, 0.1]], dtype=np.float32)
    index = np.full((3, 4), -1, dtype=np.int32)
    labels = np.full((3, 4), 2, dtype=np.uint8)
    none = np.zeros((0, 4), dtype=np.float32)
    np.testing.assert_array_equal(remove_outliers(none, index, labels, CLASSES), labels)
    index[1, 1] = 0
    np.testing.assert_array_equal(remove_outliers(one, index, labels, CLASSES), labels)
    assert remove_outliers(one * np.nan, index, labels, CLASSES)[1, 1] == 0
    empty = remove_outliers(none, index[:0], labels[:0], CLASSES)
    assert empty.shape == (0, 4)


def test_points_behind_a_car_s_edge_are_not_car() -> None:
    ranges = np.full((9, 30), 20.0)
    ranges[3:6, 10:20] = 10.0
    points, index, pixel = scene(ranges)
    labels = np.where(ranges < 15.0, 1, 0).astype(np.uint8)
    # Hidden behind the car's edge: one on the wall, one on the car itself, one on nothing near.
    behind = index[4, 10]
    hidden = np.stack([points[behind] * np.float32(f) for f in (2.0, 1.01, 1.5)])
    points = np.concatenate([points, hidden])
    pixel = np.concatenate([pixel, np.full(3, pixel[behind])])
    found = label_points(points, pixel, index, labels)
    np.testing.assert_array_equal(found[:-3], labels.reshape(-1))
    assert found[-3:].tolist() == [0, 1, 0]


def test_the_majority_of_the_nearest_five_wins_and_the_nearest_breaks_ties() -> None:
    ranges = np.zeros((1, 5))
    ranges[0] = [10.0, 10.2, 10.3, 10.4, 12.0]
    points, index, pixel = scene(ranges)
    points = np.concatenate([points, points[1:2] * np.float32(10.05 / 10.2)])
    pixel = np.concatenate([pixel, [2]]).astype(np.int32)
    labels = np.array([[3, 2, 2, 1, 1]], dtype=np.uint8)
    assert label_points(points, pixel, index, labels)[-1] == 2  # 3 is nearest, 2 has two votes, one 1 is too far
    labels = np.array([[3, 2, 2, 3, 1]], dtype=np.uint8)
    assert label_points(points, pixel, index, labels)[-1] == 3


def test_equal_ranges_vote_in_order_above_then_left() -> None:
    points = np.tile(np.float32([5.0, 0.0, 0.0, 0.1]), (10, 1))
    index = np.arange(9, dtype=np.int32).reshape(3, 3)
    pixel = np.array([*range(9), 4], dtype=np.int32)
    labels = np.array([[1, 1, 2], [2, 2, 3], [3, 3, 3]], dtype=np.uint8)
    assert label_points(points, pixel, index, labels)[-1] == 2
    assert twins.refine.point_labels(points, pixel, index, labels, False)[-1] == 2


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1), (16, 40)])
@pytest.mark.parametrize("full_turn", [False, True])
def test_point_labels_agree_with_the_twin(shape: tuple[int, int], full_turn: bool) -> None:
    points, pixel, index, labels = random_scene(np.random.default_rng(shape[0]), shape)
    found = label_points(points, pixel, index, labels, full_turn=full_turn)
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, twins.refine.point_labels(points, pixel, index, labels, full_turn))
    assert (found[pixel < 0] == 0).all()


@settings(max_examples=60)
@given(st.data())
def test_any_scan_gets_labels_that_were_there(data: st.DataObject) -> None:
    height, width = data.draw(st.integers(0, 4)), data.draw(st.integers(1, 5))
    n = data.draw(st.integers(0, 12))
    number = st.floats(width=32) | st.integers(-9, 9)
    points = np.array(data.draw(st.lists(st.tuples(*[number] * 4), min_size=n, max_size=n)), dtype=np.float32)
    points = points.reshape(n, 4)
    cells = st.lists(st.integers(-1, n - 1), min_size=height * width, max_size=height * width)
    index = np.array(data.draw(cells), dtype=np.int32).reshape(height, width)
    pixels = st.lists(st.integers(-1, height * width - 1), min_size=n, max_size=n)
    pixel = np.array(data.draw(pixels), dtype=np.int32)
    names = st.lists(st.integers(0, 3), min_size=height * width, max_size=height * width)
    labels = np.array(data.draw(names), dtype=np.uint8).reshape(height, width)
    full_turn = data.draw(st.booleans())
    cleaned = remove_outliers(points, index, labels, CLASSES, full_turn=full_turn)
    assert ((cleaned == labels) | (cleaned == 0)).all()
    found = label_points(points, pixel, index, cleaned, full_turn=full_turn)
    assert found.shape == (n,)
    assert set(found.tolist()) <= {0, *cleaned.reshape(-1).tolist()}


def test_arrays_that_disagree_raise() -> None:
    points, index, pixel = scene(np.full((3, 4), 5.0))
    labels = np.zeros((3, 4), dtype=np.uint8)
    with pytest.raises(PointsError, match=r"\(3, 3\).*\(3, 4\)"):
        remove_outliers(points, index, labels[:, :3], CLASSES)
    with pytest.raises(PointsError, match="index holds 11 for 5 points"):
        remove_outliers(points[:5], index, labels, CLASSES)
    with pytest.raises(PointsError, match="label 7 for 4 classes"):
        remove_outliers(points, index, labels + np.uint8(7), CLASSES)
    with pytest.raises(PointsError, match=r"\(12, 2\)"):
        label_points(points[:, :2], pixel, index, labels)
    with pytest.raises(PointsError, match="one pixel a point"):
        label_points(points, pixel[:5], index, labels)
    with pytest.raises(PointsError, match="one pixel a point"):
        label_points(points, pixel + np.int32(1), index, labels)
