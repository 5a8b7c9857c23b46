"""Ceilings above the road, and vehicles that cannot be below them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from garages import parking_garage, small_garage, truck_depot
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from edgeperc import Box, Perceiver
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.ground.ceiling import Hall, find_ceiling, find_hall, without_impossible
from edgeperc.simulation.samples import simulated_scan
from edgeperc.simulation.scene import SimulatedScan
from edgeperc.types.choices import VEHICLES
from edgeperc.types.mounting import MODEL_HEIGHT_M, MODEL_MOUNTING, Mounting
from edgeperc.types.sensor import get_sensor
from scenes import box

SEEDS = (100, 101, 102)


@pytest.mark.parametrize("place", [parking_garage, truck_depot])
@pytest.mark.parametrize("sensor", ["os0-64", "os1-64", "os0-128"])
def test_a_ceiling_is_found_at_its_height(place: Callable[[int, str], SimulatedScan], sensor: str) -> None:
    for seed in SEEDS:
        scan = place(seed, sensor)
        highest_m = float(np.percentile(scan.points[:, 2], 99.8)) + 1.73
        assert find_ceiling(scan.points) == pytest.approx(highest_m, abs=0.5)


@pytest.mark.parametrize("sensor", ["hdl-64e", "vlp-16", "os1-64", "pandar64", "os0-64", "vlp-32c"])
def test_a_street_has_no_ceiling(sensor: str) -> None:
    for seed in SEEDS[:2]:
        assert find_ceiling(simulated_scan(seed, sensor).points) is None
    high = simulated_scan(1, replace(get_sensor(sensor), mounting=Mounting(6.0))).points
    assert find_ceiling(high + np.float32([0, 0, 4.27, 0]), 4.27) is None


def test_walls_that_end_where_the_rays_do_are_no_ceiling() -> None:
    """Rays that hardly rise meet bushes 3 to 8 m away at one height; behind a gap, a house stands above it."""
    rng = np.random.default_rng(5)
    azimuth, across = rng.uniform(-np.pi, np.pi, 6000), rng.uniform(3.0, 8.0, 6000)
    z = np.where(np.arange(6000) % 2, rng.uniform(0.3, 0.5, 6000), -1.73)
    far = np.abs(azimuth) < 0.05
    across, z = np.where(far, 30.0, across), np.where(far, 1.4, z)
    points = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z, z]).astype(np.float32)
    assert find_ceiling(points[~far]) == pytest.approx(2.13, abs=0.1)
    assert find_ceiling(points) is None
    assert find_ceiling(points[~far & (across > 4.0)]) is None  # the rays rise by 7 degrees at most


def test_a_real_street_has_no_ceiling(data_root: Callable[[str], Path]) -> None:
    """Below one of 2.1 m there would be no van."""
    streets = ScanFolder.parse(f"{data_root('other_roads')}/vod:vod")
    points = streets.frame("01047").points
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = Perceiver(sensor=streets.layout.sensor, full_turn=True)(points)
    assert not [sentence for sentence in found.fitness if "ceiling" in sentence]
    assert [
        box for box in found.boxes if box.label in VEHICLES and np.hypot(box.center[0] - 8.3, box.center[1] + 3.9) < 1
    ]


any_points = arrays(np.float32, st.tuples(st.integers(0, 60), st.just(4)), elements=st.floats(width=32))


@given(any_points)
def test_any_points_have_a_ceiling_or_none(points: NDArray[np.float32]) -> None:
    ceiling_m = find_ceiling(np.repeat(points, 9, axis=0))
    assert ceiling_m is None or ceiling_m >= 2.0


def below(height_m: float) -> NDArray[np.float32]:
    """What rays that rise by up to 45 degrees meet below a ceiling, and the road."""
    rng = np.random.default_rng(4)
    azimuth, across = rng.uniform(-np.pi, np.pi, 6000), rng.uniform(2.0, 12.0, 6000)
    z = np.where(np.arange(6000) % 2, height_m - 1.73, -1.73)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z, z]).astype(np.float32)


def hall(height_m: float) -> Hall:
    return find_hall(below(height_m), MODEL_MOUNTING)


@pytest.mark.parametrize("label", ["car", "van", "truck"])
def test_no_vehicle_is_around_the_sensor(label: str) -> None:
    around = box(1.0, 0.3, label, size=(6.0, 2.5, 2.0), z=-0.7, yaw=0.3)
    others = (box(8.0, 0.0, label), box(0.0, 0.0, "pedestrian", size=(0.8, 0.7, 1.7)))
    road = hall(0.0)
    assert without_impossible((around, *others), road, MODEL_MOUNTING) == others
    passing = (box(0.5, 0.2, label), *others)  # below a sensor on a pole
    assert without_impossible(passing, road, Mounting(4.0 + MODEL_HEIGHT_M)) == passing


@pytest.mark.parametrize(("place", "height_m", "is_own"), [(2.9, 1.73, True), (3.1, 1.73, False), (2.9, 0.9, False)])
def test_the_body_of_the_own_vehicle_is_no_other_one(place: float, height_m: float, is_own: bool) -> None:
    """A box that begins 0.9 m from a sensor on a roof is the own vehicle's; from one in a bumper, another's."""
    for boxes in ((box(-place, 0.1, size=(4.0, 1.8, 1.6)),), (box(0.0, place, yaw=1.57, size=(4.0, 1.8, 1.6)),)):
        assert without_impossible(boxes, hall(0.0), Mounting(height_m)) == (() if is_own else boxes)


@pytest.mark.parametrize("label", ["car", "van", "truck"])
@pytest.mark.parametrize("ceiling_m", [2.4, 3.1, 4.5])
def test_no_vehicle_reaches_the_ceiling(label: str, ceiling_m: float) -> None:
    def tall(height_m: float) -> Box:
        return box(9.0, 1.0, label, size=(5.0, 2.0, height_m), z=height_m / 2.0 - 1.73)

    person = box(5.0, 0.0, "pedestrian", size=(0.8, 0.7, ceiling_m), z=0.0)
    boxes = (tall(ceiling_m - 0.2), tall(ceiling_m), tall(ceiling_m + 0.5), person)
    assert without_impossible(boxes, hall(ceiling_m), MODEL_MOUNTING) == (boxes[0], person)
    assert without_impossible(boxes, hall(0.0), MODEL_MOUNTING) == boxes


# Of each, places in which walls, beams, pipes or the whole garage were taken for trucks.
@pytest.mark.parametrize(
    ("place", "seed", "sensor"),
    [
        (parking_garage, 106, "os0-64"),
        (parking_garage, 123, "pandar64"),
        (parking_garage, 173, "vlp-32c"),
        (parking_garage, 178, "os0-64"),
        (small_garage, 105, "pandar64"),
        (small_garage, 107, "vlp-32c"),
        (small_garage, 126, "hdl-64e"),
        (small_garage, 135, "pandar64"),
    ],
)
def test_in_garages_there_is_a_warning_and_no_truck(
    place: Callable[[int, str], SimulatedScan], seed: int, sensor: str
) -> None:
    points = place(seed, sensor).points * np.float32([1, 1, 1, get_sensor(sensor).remission_range[1]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = Perceiver(sensor=sensor, full_turn=True)(points)
    assert any("a garage" in sentence for sentence in found.fitness)
    assert not [each for each in found.boxes if each.label == "truck" and each.score >= 0.5]


def test_trucks_in_a_depot_are_found() -> None:
    scan = truck_depot(111, "pandar64")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = Perceiver(sensor="pandar64", full_turn=True)(scan.points * np.float32([1, 1, 1, 255]))
    near = [each for each, n in zip(scan.boxes, scan.box_points, strict=True) if n > 1000]
    trucks = [each for each in found.boxes if each.label == "truck" and each.score >= 0.5]
    assert len(near) >= 3
    for each in near:
        assert any(np.hypot(*np.subtract(each.center[:2], truck.center[:2])) < 2.0 for truck in trucks)


@pytest.mark.parametrize("label", ["car", "van", "truck"])
def test_no_vehicle_stands_behind_the_walls(label: str) -> None:
    """Below a ceiling, the points end at 12 m."""

    def tall(x: float, y: float, yaw: float = 0.0) -> Box:
        return box(x, y, label, size=(5.0, 2.0, 2.2), z=-0.6, yaw=yaw)

    between = (tall(9.0, 0.0), tall(0.0, -10.0, 1.5), box(20.0, 0.0, "cyclist", size=(1.8, 0.6, 2.2), z=-0.6))
    behind = (tall(-15.0, 0.0), tall(0.0, 13.0, 1.5), tall(11.0, 8.0, 0.6))
    assert without_impossible((*behind, *between), hall(2.6), MODEL_MOUNTING) == between
    assert without_impossible((*behind, *between), hall(0.0), MODEL_MOUNTING) == (*behind, *between)
