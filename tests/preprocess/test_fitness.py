"""Which differences from the training scans are gross: results would be meaningless, and a scan is refused."""

from __future__ import annotations

import contextlib
import csv
import json
import pickle
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import permutations, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from garages import furnished_room, small_garage, truck_depot
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

import twins.fitness
from edgeperc import Perceiver
from edgeperc.errors import CardError, MountingError, PointsError
from edgeperc.ground.leveling import MountingEstimator, near_support, share_below
from edgeperc.preprocess.condition import condition
from edgeperc.preprocess.findings import (
    Finding,
    check_beams,
    check_fitness,
    check_ground,
    check_profiles,
    with_raw_remission,
)
from edgeperc.preprocess.fitness import SUMS, FitnessProfile, Histograms, Rows, fill_scan_sums
from edgeperc.preprocess.returns import returns
from edgeperc.readers.files import read_points
from edgeperc.simulation import random_scene
from edgeperc.simulation.samples import simulated_scan
from edgeperc.simulation.scene import SimulatedScan, sensor_pose, simulate
from edgeperc.types.frame import ModelFrame
from edgeperc.types.mounting import MODEL_MOUNTING, Mounting
from edgeperc.types.perception import DroppedPoints
from edgeperc.types.sensor import SENSORS, get_sensor
from edgeperc.zoo import listed
from scenes import urban

Points = NDArray[np.float32]

KITTI = get_sensor("hdl-64e")
# Those of two precisions, and of networks of the same scans, are one.
PROFILES = [*dict.fromkeys(FitnessProfile.from_dict(v.card.fitness) for v in listed() if v.card.fitness)]
SEEDS = range(4)


@cache
def scanned(seed: int, sensor: str) -> Points:
    points = simulated_scan(seed, sensor).points
    points.flags.writeable = False
    return points


@cache
def street(seed: int, sensor: str = "hdl-64e") -> Points:
    """A simulated scan, whose remission is in 0..1 for every sensor."""
    scaled = replace(get_sensor(sensor), remission_range=(0.0, 1.0), remission=None)
    return condition(scanned(seed, sensor), scaled)[0]


def beams_of(points: Points) -> NDArray[np.int64]:
    """The beam of each point, from the top."""
    x, y, z, _ = points.T
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    return np.abs(elevation[:, None] - np.array(KITTI.elevations_deg)).argmin(axis=1)


def gross(points: Points, sensor: str = "hdl-64e") -> list[str]:
    """The gross differences to the training scans of any shipped model."""
    scan = np.ascontiguousarray(points, np.float32)
    return [finding for finding in check_profiles(scan, PROFILES, get_sensor(sensor)) if finding.gross]


def test_a_finding_is_its_sentence() -> None:
    finding = Finding("The scan is empty.", True)
    assert finding == "The scan is empty."
    copy = pickle.loads(pickle.dumps(finding))
    assert (copy, copy.gross) == (finding, True)
    assert not Finding("few rows").gross


def test_a_sensor_whose_beams_all_look_up_is_to_hang() -> None:
    hung = replace(get_sensor("rs-bpearl"), mounting=Mounting(1.8, roll_deg=180.0, pitch_deg=0.0))
    hung = replace(hung, remission_range=(0.0, 1.0))
    assert any("another field of view" in sentence for sentence in gross(street(0, "rs-bpearl"), "rs-bpearl"))
    perceive = Perceiver("pointseg", sensor=hung, mounting=hung.mounting, on_mismatch="refuse")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert perceive(simulate(random_scene(0), hung, 0).points).points is not None


@pytest.mark.parametrize("sensor", [name for name in SENSORS if name != "rs-bpearl"])
def test_simulated_scans_of_every_built_in_sensor_are_accepted(sensor: str) -> None:
    points = scanned(0, sensor)
    assert gross(street(0, sensor), sensor) == []
    found, dropped = returns(points, get_sensor(sensor))
    assert dropped == DroppedPoints()
    assert np.shares_memory(found, points)


@settings(max_examples=15)
@given(st.sampled_from(SEEDS), st.floats(500.0, 2000.0))
def test_millimeters(seed: int, factor: float) -> None:
    found = gross(street(seed) * np.float32([factor, factor, factor, 1]))
    assert any("convert them to meters" in sentence for sentence in found)


@pytest.mark.parametrize("order", [*permutations(range(3))])
def test_swapped_axes(order: tuple[int, ...]) -> None:
    """Unless z still points up: then the scan is only turned or mirrored."""
    for seed, signs in enumerate(product([-1, 1], repeat=3)):
        points = street(seed % len(SEEDS))[:, [*order, 3]] * np.float32([*signs, 1])
        assert bool(gross(points)) == (order[2] != 2 or signs[2] < 0)


@settings(max_examples=15)
@given(st.sampled_from(SEEDS), st.floats(0.0, 360.0))
def test_upside_down(seed: int, turned_deg: float) -> None:
    cos, sin = np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))
    x, y, z, remission = street(seed).T
    assert gross(np.column_stack([cos * x + sin * y, sin * x - cos * y, -z, remission]))


@settings(max_examples=15)
@given(st.sampled_from(SEEDS), st.floats(0.05, 10.0), st.booleans())
def test_z_as_the_number_of_a_row(seed: int, scale: float, from_top: bool) -> None:
    points, row = street(seed).copy(), beams_of(street(seed))
    points[:, 2] = scale * (row if from_top else 63 - row)
    assert gross(points)


@pytest.mark.parametrize("factor", [3.28084, 3.2808333])
@pytest.mark.parametrize("seed", SEEDS)
def test_feet(seed: int, factor: float) -> None:
    """Of a sensor that was found high above the road, or by its range alone."""
    points = street(seed) * np.float32([factor, factor, factor, 1.0])
    near = replace(KITTI, max_range_m=np.quantile(np.linalg.norm(street(seed)[:, :3], axis=1), 0.999))
    assert any("feet" in finding for finding in check_fitness(points, PROFILES[0], near))
    assert not any("feet" in finding for finding in check_fitness(street(seed), PROFILES[0], near))


@pytest.mark.parametrize("seed", SEEDS)
def test_decimeters(seed: int) -> None:
    points = street(seed) * np.float32([10.0, 10.0, 10.0, 1.0])
    assert any("decimeters" in finding for finding in gross(points))


@settings(max_examples=15)
@given(st.sampled_from(SEEDS), st.floats(-1.0, 300.0))
def test_constant_remission(seed: int, value: float) -> None:
    points = street(seed).copy()
    points[:, 3] = value
    assert any("Remission" in sentence for sentence in gross(points))


@pytest.mark.parametrize("sensor", [name for name in SENSORS if get_sensor(name).remission is not None])
@pytest.mark.parametrize("brightest", [1.0, 0.3])
def test_a_remission_of_another_unit_is_not_called_missing(sensor: str, brightest: float) -> None:
    """A profile's logarithm maps 0..1 to nothing where it expects 0..255."""
    profile = get_sensor(sensor)
    raw = scanned(1, sensor).copy()
    raw[:, 3] *= brightest / raw[:, 3].max()
    scan = condition(raw, profile)[0]
    for fitness in PROFILES:
        found = with_raw_remission(check_fitness(scan, fitness, profile), raw, profile)
        about = [finding for finding in found if "emission" in finding]
        assert any(finding.gross for finding in about) or sensor == "pandar64"  # whose function is weaker
        assert not any("missing" in finding for finding in found)
        raw_range = f"{profile.remission_range[0]:g} to {profile.remission_range[1]:g}"
        assert any(raw_range in finding and "(0, 1)" in finding for finding in about)


@pytest.mark.parametrize("value", [0.0, np.nan, 7.0])
def test_a_missing_remission_is_called_so(value: float) -> None:
    profile = get_sensor("hdl-32e")
    raw = scanned(1, "hdl-32e").copy()
    raw[:, 3] = value
    zeros = (Finding("Remission is 0 for 100% of the points: the field is missing", True), Finding("another"))
    assert with_raw_remission(zeros, raw, profile) == zeros
    assert with_raw_remission((), raw, profile) == ()
    raw[::50, 3] = profile.remission_range[1]  # of whole numbers, nearly all 0: the unit is right
    assert with_raw_remission(zeros, raw, profile) == zeros


@pytest.mark.parametrize("sensor", ["vlp-16", "hdl-64e", "os1-128", "pandar64"])
@pytest.mark.parametrize("what", ["beam", "time or azimuth", "height", "distance"])
def test_a_remission_that_follows_from_the_place_is_refused(sensor: str, what: str) -> None:
    profile, points = get_sensor(sensor), scanned(1, sensor)
    raw = points[np.isfinite(points).all(axis=1) & (np.linalg.norm(points[:, :3], axis=1) > 1.0)]
    assert with_raw_remission((), raw, profile) == ()
    x, y, z, _ = raw.T
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    raw[:, 3] = {
        "beam": np.abs(elevation[:, None] - np.array(profile.elevations_deg)).argmin(axis=1),
        "time or azimuth": (np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * 0.1,
        "height": z,
        "distance": np.hypot(x, y),
    }[what]
    (found,) = with_raw_remission([Finding("Remission runs from 0 to 63", True)], raw, profile)
    assert found.gross
    assert what in found
    other = Finding("axes", True)
    assert with_raw_remission([other], raw, profile) == (other,)


@pytest.mark.parametrize("sensor", ["vlp-16", "hdl-64e", "os1-128"])
@pytest.mark.parametrize("per_m", [0.004, 0.02, 0.1])
def test_a_remission_that_falls_with_the_distance_is_a_simulators(sensor: str, per_m: float) -> None:
    profile, points = get_sensor(sensor), scanned(1, sensor)
    raw = points[np.isfinite(points).all(axis=1) & (np.linalg.norm(points[:, :3], axis=1) > 1.0)]
    raw[:, 3] = np.exp(-per_m * np.linalg.norm(raw[:, :3], axis=1))
    (found,) = with_raw_remission([], raw, profile)
    assert not found.gross
    assert "from the distance: the field holds nothing else" in found


@cache
def rays(sensor: str) -> NDArray[np.float64]:
    """Directions around a sensor, one beam after the other."""
    elevations = get_sensor(sensor).elevations_deg
    elevation, azimuth = np.radians(np.meshgrid(elevations, np.arange(-180.0, 180.0, 0.3), indexing="ij")).reshape(
        2, -1
    )
    level = np.cos(elevation)
    way = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    way.flags.writeable = False
    return way


def enclosed(size: tuple[float, float, float], height_m: float, sensor: str, shift: float = 0.1) -> Points:
    """The walls, floor and ceiling of a box, as a sensor above its floor sees them; also a floor that is ground."""
    way = rays(sensor)
    high = np.array([(0.5 + shift) * size[0], (0.5 - shift) * size[1], size[2] - height_m])
    low = high - size
    with np.errstate(divide="ignore"):
        distance = np.where(way > 0.0, high / way, np.where(way < 0.0, low / way, np.inf)).min(axis=1)
    rng = np.random.default_rng(7)
    points = way * (distance + rng.normal(0.0, 0.01, len(way)))[:, None]
    remission = rng.uniform(0.1, 0.6, len(way)) * get_sensor(sensor).remission_range[1]
    return np.column_stack([points, remission]).astype(np.float32)[distance < 100.0]


@pytest.mark.parametrize("sensor", ["hdl-64e", "vlp-16", "os1-64", "pandar64"])
@pytest.mark.parametrize("size", [(9.0, 7.0, 2.6), (14.0, 10.0, 3.2), (5.0, 4.0, 2.4), (4.0, 4.0, 2.4)])
@pytest.mark.parametrize("height_m", [0.4, 1.0, 1.7])
def test_rooms_whose_floor_is_ground(sensor: str, size: tuple[float, float, float], height_m: float) -> None:
    assert any("a room" in sentence for sentence in gross(enclosed(size, height_m, sensor), sensor))


def leveled(points: Points, sensor: str) -> list[Finding]:
    """What differs if the mounting is found from the ground, as a Perceiver does it; remission is in 0..1."""
    profile = replace(get_sensor(sensor), remission_range=(0.0, 1.0), remission=None)
    estimator = MountingEstimator(Mounting())
    with contextlib.suppress(MountingError):
        estimator = estimator.add(points)
    frame = ModelFrame(estimator.mounting())
    turned = check_beams(points, profile) or check_ground(points, near_support, share_below)
    return [*turned, *check_profiles(frame.move(points), PROFILES, profile, frame)]


def office(sensor: str, seed: int, window: float) -> Points:
    """A room with furniture, as a sensor 1 m above its floor sees it: a share of the rays that meet the upper half of
    one wall goes on through windows, and those that meet a door go on into a corridor.
    """
    rng = np.random.default_rng(seed)
    way = rays(sensor)
    across = np.ascontiguousarray(way.T)
    size = np.array([8.5, 6.5, 2.6])
    high = np.array([*(rng.uniform(0.3, 0.7, 2) * size[:2]), 1.6])
    low = high - size
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.where(way > 0.0, high / way, np.where(way < 0.0, low / way, np.inf))
        distance, wall = walls.min(axis=1), walls.argmin(axis=1)
        x, y, z = (way * distance[:, None]).T
        goes_on = (wall == 0) & (z > 0.0) & (z < 1.2) & (rng.random(len(x)) < window) & (x > 0.0)
        goes_on |= (wall == 1) & (y > 0.0) & (np.abs(x) < 0.5) & (z < 1.0)
        distance = np.where(goes_on, distance + rng.uniform(3.0, 30.0, len(x)), distance)
        for _ in range(15):
            corner, extent = rng.uniform(low, high), rng.uniform([0.3, 0.3, 0.4], [1.5, 1.2, 1.8])
            if np.hypot(*corner[:2]) > 2.0:
                corner[2] = low[2]
                sides = corner[:, None] / across, (corner + extent)[:, None] / across
                near, far = np.minimum(*sides).max(axis=0), np.maximum(*sides).min(axis=0)
                distance = np.where((near < far) & (near > 0.0), np.minimum(distance, near), distance)
    remission = rng.uniform(0.1, 0.6, len(way))
    return np.column_stack([way * distance[:, None], remission]).astype(np.float32)


@pytest.mark.parametrize("sensor", ["hdl-64e", "vlp-16", "os1-64", "pandar64", "os0-64", "hdl-32e"])
@pytest.mark.parametrize("window", [0.0, 0.4])
def test_rooms_with_furniture_windows_and_doors(sensor: str, window: float) -> None:
    for seed in SEEDS[:2]:
        assert any("a room" in finding for finding in leveled(office(sensor, seed, window), sensor) if finding.gross)


@pytest.mark.parametrize("place", [small_garage, furnished_room])
@pytest.mark.parametrize("sensor", ["os1-64", "os0-64"])
def test_a_garage_of_a_house_is_no_room(sensor: str, place: Callable[[int, str], SimulatedScan]) -> None:
    """A car fits around the sensor; what stands in a room would be inside it, or the sensor is lower."""
    for seed in range(20, 27):
        found = [f for f in leveled(place(seed, sensor).points, sensor) if "seems to be" in f]
        assert any(finding.gross for finding in found) == (place is furnished_room)


@pytest.mark.parametrize(
    ("size", "is_hall"),
    [
        ((400.0, 4.0, 6.0), False),
        ((300.0, 8.0, 5.0), False),
        ((200.0, 3.0, 7.0), False),
        ((60.0, 20.0, 4.5), False),
        ((26.0, 24.0, 3.0), True),
        ((20.0, 18.0, 4.0), True),
    ],
    ids=["alley", "tunnel", "narrow alley", "underpass", "garage", "hall"],
)
@pytest.mark.parametrize("sensor", ["hdl-64e", "hdl-32e", "vlp-16", "os1-64", "pandar64", "os0-64", "vlp-32c"])
def test_ceilings_and_walls_are_not_taken_for_the_ground(
    sensor: str, size: tuple[float, float, float], is_hall: bool
) -> None:
    """Most points may be on them; the road is below all the same."""
    points = enclosed(size, 1.73, sensor)
    assert not any("a room" in sentence for sentence in gross(points, sensor))
    found = leveled(points / np.float32([1, 1, 1, get_sensor(sensor).remission_range[1]]), sensor)
    assert [finding for finding in found if finding.gross] == []
    assert any("a garage or a hall" in finding for finding in found) or not is_hall


@pytest.mark.parametrize("width_m", [12.0, 16.0])
def test_a_street_of_which_the_own_body_hides_one_end_is_no_hall(width_m: float) -> None:
    x, y, *_ = (points := enclosed((200.0, width_m, 30.0), 1.2, "os1-64")).T
    found = [leveled(each / np.float32([1, 1, 1, 65535]), "os1-64") for each in (points, points[x > -np.abs(y)])]
    assert not any("hall" in finding for finding in [*found[0], *found[1]])


@pytest.mark.parametrize("crop_m", [8.0, 12.0, 20.0])
def test_a_street_that_is_cropped_is_no_room(crop_m: float) -> None:
    for seed in SEEDS:
        points = street(seed)
        assert not any("a room" in sentence for sentence in gross(points[np.hypot(*points[:, :2].T) < crop_m]))


@pytest.mark.parametrize("sensor", ["hdl-64e", "pandar64", "vlp-32c"])
def test_elevations_tell_up_from_down(sensor: str) -> None:
    points = enclosed((80.0, 30.0, 9.0), 1.73, sensor)
    assert not check_beams(points, get_sensor(sensor))
    for turned in (points * np.float32([1, -1, -1, 1]), points * np.float32([1, 1, -1, 1])):
        (finding,) = check_beams(turned, get_sensor(sensor))
        assert finding.gross
        assert "mounted upside down, or z points down" in finding
    symmetric = get_sensor("vlp-16")
    assert not check_beams(enclosed((80.0, 30.0, 9.0), 1.73, "vlp-16") * np.float32([1, -1, -1, 1]), symmetric)


@settings(max_examples=20)
@given(st.sampled_from(SEEDS), st.floats(-0.5, 0.5), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_ordinary_mountings_are_accepted(seed: int, raised_m: float, pitch_deg: float, roll_deg: float) -> None:
    """Before they are leveled, too."""
    pitch, roll = np.radians([pitch_deg, roll_deg])
    about_y = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    points = street(seed)
    moved = points[:, :3] @ (about_x @ about_y).T.astype(np.float32) + np.float32([0, 0, raised_m])
    assert gross(np.column_stack([moved, points[:, 3]])) == []


@settings(max_examples=30)
@given(st.sampled_from(SEEDS), st.floats(20.0, 60.0), st.integers(1, 3), st.randoms(use_true_random=False))
def test_crops_and_thinned_scans_are_accepted(seed: int, half_deg: float, every: int, chance: object) -> None:
    points = street(seed)
    ahead = np.abs(np.degrees(np.arctan2(points[:, 1], points[:, 0]))) < half_deg
    assert gross(points[ahead][::every]) == []


def test_no_real_scan_of_the_training_sensor_is_refused(kitti_root: Path, semantickitti_root: Path) -> None:
    files = [*kitti_root.glob("training/velodyne/*.bin"), *semantickitti_root.glob("sequences/00/velodyne/*.bin")]
    assert len(files) == 497
    assert {file.name: found for file in sorted(files)[::3] if (found := gross(read_points(file)))} == {}


@settings(max_examples=30)
@given(st.sampled_from(SEEDS), st.floats(0.0, 360.0), st.floats(60.0, 200.0))
def test_the_frame_of_a_map(seed: int, direction_deg: float, distance_m: float) -> None:
    away = distance_m * np.array([np.cos(np.radians(direction_deg)), np.sin(np.radians(direction_deg)), 0.0, 0.0])
    assert any("is not at the" in sentence for sentence in gross(street(seed) + away))


@pytest.mark.parametrize("place", [(512345.25, 5412345.5, 113.0), (4.1e6, 6e5, 4.8e6), (-3e5, 0.0, 0.0)])
def test_the_coordinates_of_a_map_as_float32(place: tuple[float, float, float]) -> None:
    """UTM, ECEF and others: neither millimeters nor another unit, and too late for the origin."""
    for seed in SEEDS:
        found = gross(street(seed) + np.float32([*place, 0.0]))
        assert found
        for sentence in found:
            assert "not at the origin, as in the frame of a map" in sentence
            assert "--origin X Y Z. As float32, they are rounded to 0." in sentence
        found = gross(street(seed) + np.float32([9000.0, -2000.0, 0.0, 0.0]))
        assert found
        assert not any("rounded" in sentence or "as in the frame of a map" not in sentence for sentence in found)


@pytest.mark.parametrize(
    ("sensor", "mounting"),
    [
        *(
            ("os1-64", Mounting(*given))
            for given in ((3.0,), (8.0,), (6.0, 0.0, 15.0), (6.0, 0.0, 30.0), (6.0, -20.0, 5.0))
        ),
        *(("vlp-16", Mounting(height_m)) for height_m in (3.0, 6.5)),
        ("hdl-64e", Mounting(5.0)),
        ("pandar64", Mounting(8.0)),
    ],
)
def test_sensors_that_are_high_or_lean_are_accepted_with_their_mounting(sensor: str, mounting: Mounting) -> None:
    """They see little of the ground near by, and objects from above; of one that leans, some beams point higher."""
    mounting = replace(mounting, yaw_deg=0.0)
    profile = replace(get_sensor(sensor), remission_range=(0.0, 1.0), remission=None, mounting=mounting)
    for seed in SEEDS[:2]:
        points, frame = condition(simulated_scan(seed, profile).points, profile)[0], ModelFrame(mounting)
        assert not any(finding.gross for finding in check_profiles(frame.move(points), PROFILES, profile, frame))
        wrong = ModelFrame(replace(mounting, height_m=mounting.height_m + 3.0))
        found = [finding for finding in check_profiles(wrong.move(points), PROFILES, profile, wrong) if finding.gross]
        assert any("another height" in finding or "above the sensor" in finding for finding in found)


TURNED = {
    "about x": np.float32([1, -1, -1, 1]),
    "about y": np.float32([-1, 1, -1, 1]),
    "z alone": np.float32([1, 1, -1, 1]),
}


@pytest.mark.parametrize("turn", TURNED)
@pytest.mark.parametrize("sensor", ["vlp-16", "os1-64", "os0-64", "os2-64", "pandarxt-32", "vlp-32c", "pandar64"])
def test_the_ground_tells_up_from_down(sensor: str, turn: str) -> None:
    """Beams that are as high as low do not."""
    for seed in SEEDS[:2]:
        points = street(seed, sensor)
        assert not check_ground(points, near_support, share_below)
        assert any("upside down" in finding for finding in leveled(points * TURNED[turn], sensor) if finding.gross)


@pytest.mark.parametrize("sensor", ["mid-360", "os0-32"])
def test_a_low_sensor_that_hangs_sees_all_below_its_ground(sensor: str) -> None:
    hanging, scene = replace(get_sensor(sensor), mounting=Mounting(height_m=0.3, roll_deg=180.0)), random_scene(5)
    points = simulate(scene, hanging, 1, sensor_pose(scene, hanging)).points
    assert check_ground(points, near_support, share_below, get_sensor(sensor))


@pytest.mark.parametrize("seed", [1, 8, 10])
def test_a_sensor_that_looks_up_is_the_right_way_up(seed: int) -> None:
    """Of an upright Mid-360, in streets in which it sees little road, or a roof above, and few rows."""
    sensor = replace(get_sensor("mid-360").accumulated(0.2), remission=None, remission_range=(0.0, 1.0))
    points = simulated_scan(2 * 10**9 + seed, replace(sensor, mounting=MODEL_MOUNTING)).points
    assert not check_ground(points, near_support, share_below, sensor)
    assert not [finding for finding in check_profiles(points, PROFILES, sensor) if finding.gross]
    hanging = points * TURNED["about x"]
    found = check_ground(hanging, near_support, share_below)
    assert check_ground(hanging, near_support, share_below, sensor) == found
    hdl = street(SEEDS[0], "hdl-64e") * TURNED["about x"]  # looks down: its profile excuses nothing
    assert check_ground(hdl, near_support, share_below, get_sensor("hdl-64e"))


@pytest.mark.parametrize("turn", TURNED)
@pytest.mark.parametrize("sensor", ["pandar64", "os1-64", "vlp-16"])
def test_an_origin_near_the_road_tells_up_from_down(sensor: str, turn: str) -> None:
    """It sees the road above and below as the same plane; on a bank, there is as much below it as above."""
    streets = [scanned(seed, sensor) + np.float32([0.0, 0.0, 1.55, 0.0]) for seed in SEEDS]
    assert not any(check_ground(points, near_support, share_below) for points in streets)
    assert sum(bool(check_ground(points * TURNED[turn], near_support, share_below)) for points in streets) >= 3


@pytest.mark.parametrize("seed", [100, 166, 7])
def test_a_ceiling_that_shows_more_than_the_floor_is_not_the_ground(seed: int) -> None:
    for sensor in ("os0-64", "os1-64", "os0-128"):
        assert not check_ground(truck_depot(seed, sensor).points, near_support, share_below)


def test_real_scans_that_are_upside_down_are_refused(kitti_root: Path) -> None:
    for file in sorted(kitti_root.glob("training/velodyne/*.bin"))[::24]:
        scan = read_points(file)
        assert not check_ground(scan, near_support, share_below), file.name
        for turn in TURNED.values():
            assert any(finding.gross for finding in leveled(scan * turn, "hdl-64e")), file.name


@pytest.mark.parametrize("points", [np.zeros((0, 4)), np.full((9, 4), np.nan), np.zeros((50, 4)), np.eye(4)])
def test_nothing_is_upside_down_in_a_scan_of_nothing(points: NDArray[np.float64]) -> None:
    assert check_ground(points.astype(np.float32), near_support, share_below) == ()


@pytest.fixture(scope="module")
def streets() -> list[Points]:
    return [urban(seed).points for seed in range(6)]


@pytest.fixture(scope="module")
def profile(streets: list[Points]) -> FitnessProfile:
    return FitnessProfile.from_scans(streets[:3])


def columns(*parts: np.ndarray) -> np.ndarray:
    return np.column_stack(parts).astype(np.float32)


def in_camera_axes(p: np.ndarray) -> np.ndarray:
    return columns(-p[:, 1], -p[:, 2], p[:, 0], p[:, 3])


def in_nuscenes_axes(p: np.ndarray) -> np.ndarray:
    return columns(-p[:, 1], p[:, 0], p[:, 2:])


def cropped(p: np.ndarray) -> np.ndarray:
    return p[(p[:, 0] > 0) & (np.abs(p[:, 1]) < 0.8 * p[:, 0]) & (p[:, 2] > -0.26 * p[:, 0])]


def rescaled(factors: Sequence[float]) -> Callable[[np.ndarray], np.ndarray]:
    return lambda p: p * np.float32(factors)


FAULTS: dict[str, tuple[Callable[[Points], Points], str]] = {
    "x and y swapped": (lambda p: p[:, [1, 0, 2, 3]], "as if the road ran along y"),
    "nuScenes' axes": (in_nuscenes_axes, "--turn -90"),
    "kilometers": (rescaled([1e-3, 1e-3, 1e-3, 1]), "kilometers"),
    "a crop turned away": (lambda p: in_nuscenes_axes(cropped(p)), "Only 0% of the model's view"),
    "remission scaled twice": (rescaled([1, 1, 1, 1 / 255]), "hardly exceeds"),
    "negative remission": (lambda p: p - np.float32([0, 0, 0, 0.5]), "Remission runs from -0.5"),
    "dark remission": (lambda p: columns(p[:, :3], p[:, 3] / np.where(p[:, 3] < 0.4, 8, 1)), "median remission"),
    "a hundred points": (lambda p: p[::500], "is the scan complete"),
    "many turns": (lambda p: np.tile(p, (8, 1)), "one turn"),
    "few beams": (lambda p: np.tile(p[beams_of(p) % 16 == 0], (16, 1)), "rows of points"),
}
# Whatever the model.
GROSS: dict[str, tuple[Callable[[Points], Points], str]] = {
    "a camera's axes": (in_camera_axes, "pass z, -x, -y"),
    "upside down": (rescaled([1, -1, -1, 1]), "upside down"),
    "ground at zero": (lambda p: p + np.float32([0, 0, 1.73, 0]), "another height|not the sensor"),
    "too low": (lambda p: p - np.float32([0, 0, 3.0, 0]), "another height"),
    "millimeters": (rescaled([1e3, 1e3, 1e3, 1]), "millimeters"),
    "remission to 255": (rescaled([1, 1, 1, 255]), r"remission_range is \(0, 255\)"),
    "remission to 65535": (rescaled([1, 1, 1, 65535]), r"remission_range is \(0, 65535\)"),
    "no remission": (rescaled([1, 1, 1, 0]), "Remission is 0 for 100%"),
    "constant remission": (lambda p: columns(p[:, :3], np.full(len(p), 0.4)), "the same for 100%"),
    "almost empty": (lambda p: p[::100], "is the scan complete"),
    "forty turns": (lambda p: np.tile(p, (40, 1)), "one turn"),
    "without the view": (lambda p: p[np.abs(p[:, 1]) > 1.5 * p[:, 0]], "of the model's view"),
    **{
        f"axes {a}{b}{c}": (lambda p, order=(a, b, c): p[:, [*order, 3]], "")
        for a, b, c in permutations(range(3))
        if c != 2
    },
}


@pytest.mark.parametrize("fault", FAULTS | GROSS)
def test_faults_are_reported(streets: list[Points], profile: FitnessProfile, fault: str) -> None:
    spoil, expected = (FAULTS | GROSS)[fault]
    for scan in streets[3:]:
        findings = check_fitness(np.ascontiguousarray(spoil(scan)), profile, KITTI)
        assert findings
        assert re.search(expected, " ".join(findings)), findings


@pytest.mark.parametrize("fault", [*GROSS, "few beams", "remission scaled twice"])
def test_gross_faults_are_refused(fault: str) -> None:
    spoil, expected = (FAULTS | GROSS)[fault]
    for seed in SEEDS:
        assert any(re.search(expected, finding) for finding in gross(spoil(street(seed))))


@pytest.mark.parametrize("fault", GROSS)
def test_spoilt_real_scans_are_refused(kitti_root: Path, fault: str) -> None:
    spoil, expected = GROSS[fault]
    for file in sorted(kitti_root.glob("training/velodyne/*.bin"))[:308:10]:
        assert re.search(expected, "; ".join(gross(spoil(read_points(file))) or ["nothing"])), file.name


@pytest.mark.parametrize(
    ("name", "expected_text"), [("vlp-16", "about 1[4-7] rows"), ("hdl-32e", "about (2[89]|3[0-3]) rows")]
)
def test_fewer_beams_are_reported(profile: FitnessProfile, name: str, expected_text: str) -> None:
    sensor = get_sensor(name)
    findings = " ".join(check_fitness(urban(9, name).points, profile, sensor))
    assert re.search(expected_text, findings), findings
    assert f"{name}: {sensor.n_beams}" in findings


def test_ordinary_scans_pass(streets: list[np.ndarray], profile: FitnessProfile) -> None:
    rng = np.random.default_rng(0)
    for scan in streets:
        assert check_fitness(scan, profile, KITTI) == ()
        assert check_fitness(rng.permutation(scan), profile, KITTI) == ()
        assert check_fitness(cropped(scan), profile, KITTI) == ()
        spoilt = np.insert(scan, slice(0, None, 20), np.float32(np.nan), axis=0)
        assert check_fitness(spoilt, profile, KITTI) == ()


def test_scan_without_finite_points_is_reported(profile: FitnessProfile) -> None:
    for scan in (np.empty((0, 4), np.float32), np.full((9, 4), np.nan, np.float32)):
        assert "no finite point" in check_fitness(scan, profile, KITTI)[0]
    assert check_fitness(np.zeros((1, 4), np.float32), profile, KITTI)
    with pytest.raises(PointsError, match="shape"):
        check_fitness(np.zeros((5, 3), np.float32), profile, KITTI)


def test_profile_is_read_back_from_json(profile: FitnessProfile) -> None:
    assert FitnessProfile.from_dict(json.loads(json.dumps(profile.to_dict(), allow_nan=False))) == profile
    crops_only = FitnessProfile.from_scans([cropped(urban(1).points)])
    assert crops_only.road_ahead is None
    assert FitnessProfile.from_dict(json.loads(json.dumps(crops_only.to_dict(), allow_nan=False))) == crops_only
    assert check_fitness(urban(2).points, crops_only, KITTI) == ()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("range_median_m", [0.0, 0.0]),
        ("range_median_m", [5.0, 1.0]),
        *[("beams", value) for value in ([np.nan, 1.0], [1, np.nan], [0.0, 1e308], [1, "x"], None, 3)],
        ("azimuth_deg", [-45.0, 45.0]),
        *[("n_scans", value) for value in (0, 10**300, "3")],
        ("ground_m", [10**400, 10**400]),
    ],
)
def test_a_damaged_profile_is_refused(name: str, value: object) -> None:
    profile = PROFILES[0].to_dict()
    assert FitnessProfile.from_dict(profile) == PROFILES[0]
    with pytest.raises(CardError, match=rf"fitness\.{name}(\[.\])? is .*expected"):
        FitnessProfile.from_dict(profile | {name: value})
    for wrong in ({}, profile | {"more": [0, 1]}):
        with pytest.raises(CardError):
            FitnessProfile.from_dict(wrong)


def test_a_profile_needs_scans() -> None:
    with pytest.raises(PointsError, match="training scans"):
        FitnessProfile.from_scans([np.empty((0, 4), np.float32)])


@pytest.mark.parametrize("azimuth_deg", [(45.0, -45.0), (180.0, -180.0), (120.0, -30.0)])
def test_the_view_holds_its_share_of_the_points(azimuth_deg: tuple[float, float]) -> None:
    scan = urban(4).points
    measured = FitnessProfile.from_scans([scan], azimuth_deg)
    azimuth = np.degrees(np.arctan2(scan[:, 1], scan[:, 0]))
    inside = np.count_nonzero((azimuth <= azimuth_deg[0]) & (azimuth >= azimuth_deg[1]))
    assert measured.points_in_view[0] == pytest.approx(inside, rel=0.03)
    assert measured.ground_m == pytest.approx((-1.73, -1.73), abs=0.11)
    assert measured.beams[0] == pytest.approx(64, abs=6)


def check_against_twin(points: np.ndarray, step: int, beam_step: int, view: Any) -> None:
    histograms = Histograms(*(np.full(size, 99, np.int64) for size in (258, 360, 200, (3, 100))))
    rows, sums = Rows(np.full((8, 1024), 99.0), np.full(8, 99, np.int64)), np.empty(1, SUMS)
    fill_scan_sums(points, step, beam_step, view, histograms, rows, sums)
    *expected, expected_rows, expected_sums = twins.fitness.scan_sums(points, step, beam_step, *view)
    for got, wanted in zip(histograms, expected, strict=True):
        np.testing.assert_array_equal(got, wanted)
    for row, count, wanted in zip(*rows, expected_rows, strict=True):
        np.testing.assert_allclose(row[:count], wanted, atol=1e-9)
    np.testing.assert_allclose(sums[0].tolist(), expected_sums, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("step", "beam_step"), [(1, 1), (7, 2)])
def test_scan_sums_agree_with_the_twin_on_a_street(step: int, beam_step: int) -> None:
    tenth = replace(get_sensor("vlp-16"), columns=180)  # interpreted, a whole scan takes long to simulate
    check_against_twin(urban(5, tenth).points.copy(), step, beam_step, (-0.5, 0.5))


@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(0, 20), st.just(4)),
        # Hundredths, off the edges of every bin, and whatever is not finite.
        elements=st.one_of(
            st.integers(-4000, 4000).map(lambda v: v / 100 + 0.0037),
            st.sampled_from([0.0, 1.0, np.inf, -np.inf, np.nan, 3e38]),
        ),
    ),
    st.integers(1, 3),
)
def test_scan_sums_agree_with_the_twin_on_random_scans(points: np.ndarray, step: int) -> None:
    with np.errstate(invalid="ignore", over="ignore"):
        check_against_twin(points, step, 1, (-0.5, 0.5))


@pytest.fixture(scope="module")
def kitti_scans(kitti_root: Path) -> tuple[list[dict[str, Any]], list[np.ndarray]]:
    with (kitti_root / "frames.csv").open() as file:
        frames = list(csv.DictReader(file))[::2]
    return frames, [read_points(kitti_root / "training" / "velodyne" / f"{frame['name']}.bin") for frame in frames]


@pytest.fixture(scope="module")
def kitti_profile(kitti_scans: tuple[list[dict[str, Any]], list[np.ndarray]]) -> FitnessProfile:
    return FitnessProfile.from_scans(kitti_scans[1][:77:5] + kitti_scans[1][127:154:4])


def test_every_kitti_scan_passes(
    kitti_scans: tuple[list[dict[str, Any]], list[np.ndarray]], kitti_profile: FitnessProfile, semantickitti_root: Path
) -> None:
    frames, scans = kitti_scans
    assert len(scans) == 157
    found = {
        frame["name"]: findings
        for frame, scan in zip(frames, scans, strict=True)
        if (findings := check_fitness(scan, kitti_profile, KITTI))
    }
    more = sorted((semantickitti_root / "sequences" / "00" / "velodyne").glob("*.bin"))
    assert len(more) == 16
    found |= {
        path.name: findings for path in more if (findings := check_fitness(read_points(path), kitti_profile, KITTI))
    }
    assert found == {}


def test_kitti_scans_turned_by_90_degrees_are_mostly_reported(
    kitti_scans: tuple[list[dict[str, Any]], list[np.ndarray]], kitti_profile: FitnessProfile
) -> None:
    full = [scan for frame, scan in zip(*kitti_scans, strict=True) if frame["crop"] == "0"]
    found = sum(bool(check_fitness(in_nuscenes_axes(scan), kitti_profile, KITTI)) for scan in full)
    assert found / len(full) > 0.85


def test_nuscenes_sweep_is_reported(data_root: Callable[[str], Path], kitti_profile: FitnessProfile) -> None:
    (path,) = (data_root("other_sensors") / "nuscenes_sweep").glob("*.bin")
    findings = " ".join(check_fitness(read_points(path), kitti_profile, KITTI))
    for expected_text in ("--turn -90", "(0, 255)", "rows of points"):
        assert expected_text in findings
