"""Simulated halls: what stands in them fits below the ceiling, and the sensor sees it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgeperc.ground.ceiling import find_ceiling
from edgeperc.simulation.halls import CLEAR_M, hall
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.geometry import oriented_iou, rectangles
from edgeperc.types.perception import Box


@settings(max_examples=30)
@given(st.integers(0, 2**40))
def test_vehicles_fit_into_a_hall(seed: int) -> None:
    scene, (x, y, yaw), height_m = hall(seed)
    again, place, _ = hall(seed)
    assert place == (x, y, yaw)
    np.testing.assert_array_equal(scene.primitives, again.primitives)
    assert all(each.size[2] < height_m for each in scene.objects)
    own = Box("car", 1.0, (x, y, 0.0), (4.6, 1.9, 1.5), yaw)
    others = [Box(each.label, 1.0, each.center, each.size, each.yaw) for each in scene.objects]
    assert not others or oriented_iou(rectangles([own]), rectangles(others)).max() == 0.0


@pytest.mark.parametrize("sensor", ["os0-64", "pandar64", "vlp-16", "mid-360"])
def test_a_sensor_hangs_below_the_ceiling_and_sees_no_farther_than_the_walls(sensor: str) -> None:
    found = []
    for seed in range(8):
        scan, (_, _, height_m) = simulated_scan(seed, sensor, where="hall"), hall(seed)
        above_m = float(scan.T_world_sensor[2, 3] - scan.scene.ground_height(*scan.T_world_sensor[:2, 3]))
        assert above_m <= height_m - CLEAR_M + 1e-6
        assert scan.points[:, 2].max() < height_m - above_m + 1.5  # the sensor is tilted
        assert sum(scan.box_points) == np.count_nonzero(scan.objects >= 0)
        found.append(find_ceiling(scan.points + np.float32([0, 0, above_m - 1.73, 0]), above_m - 1.73))
    assert sum(height is not None for height in found) >= (6 if sensor.startswith("os0") else 0)
