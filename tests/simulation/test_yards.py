"""Simulated yards: vehicles in all directions, none where the sensor is, and walls that are no vehicles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgeperc.errors import PointsError
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.samples import simulated_scan
from edgeperc.simulation.yards import TRUCKS, yard
from edgeperc.types.geometry import oriented_iou, rectangles
from edgeperc.types.perception import Box


@settings(max_examples=30)
@given(st.integers(0, 2**40))
def test_vehicles_of_a_yard_are_apart_and_clear_of_the_own_one(seed: int) -> None:
    scene, place = yard(seed)
    again, same = yard(seed)
    assert place == same
    np.testing.assert_array_equal(scene.primitives, again.primitives)
    own = Box("car", 1.0, (0.0, 0.0, 0.0), (4.6, 1.9, 1.5), place[2])
    boxes = [own, *(Box(each.label, 1.0, each.center, each.size, each.yaw) for each in scene.objects)]
    assert (np.triu(oriented_iou(rectangles(boxes), rectangles(boxes)), 1) == 0.0).all()


def test_many_vehicles_are_trucks_and_as_many_stand_across_as_along() -> None:
    objects = [each for seed in range(60) for each in yard(seed)[0].objects if each.label != "pedestrian"]
    trucks = np.mean([each.label == "truck" for each in objects])
    assert 0.7 * TRUCKS < trucks <= TRUCKS  # there is less room for them
    across = [abs(np.sin(each.yaw - np.arctan2(each.center[1], each.center[0]))) for each in objects]
    assert np.mean(np.array(across) > 0.9) > 0.5


def test_walls_of_a_yard_have_returns_and_belong_to_no_object() -> None:
    scan = simulated_scan(3, "vlp-16", where="yard")
    assert sum(scan.box_points) == np.count_nonzero(scan.objects >= 0) > 0
    assert np.count_nonzero((scan.objects < 0) & (scan.points[:, 2] > -1.0)) > 200


def test_other_places_are_refused() -> None:
    with pytest.raises(PointsError, match="expected one of street, hall, yard"):
        simulated_scan(0, where="forest")
    with pytest.raises(PointsError, match="moon"):
        random_scene(0, "moon")
