"""A blocked window, drops in the air and fog are told from clear air; drops are no obstacles."""

from __future__ import annotations

import functools
import json
import math
import pickle
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

import twins.health
from edgeperc import Mounting, Perceiver, occupancy_grid
from edgeperc.preprocess.health import Normal, check_health, fill_lacking, fill_sectors, mark_isolated, without_drops
from edgeperc.records import scan_record
from edgeperc.simulation import weather
from edgeperc.types.frame import ModelFrame
from edgeperc.types.perception import SensorHealth
from edgeperc.types.sensor import SENSORS, SensorProfile, get_sensor
from scenes import urban

Points = NDArray[np.float32]
HDL = get_sensor("hdl-64e")
EYES = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.5), (0.1, -0.2, -0.9))
values = st.one_of(
    st.sampled_from([0.0, -0.0, 0.05, 0.1, -0.1, 9.99, 10.0, 3e38, 1e-45, np.nan, np.inf, -np.inf]),
    st.floats(-12.0, 12.0, width=32),
)
scans = hnp.arrays(np.float32, st.tuples(st.integers(0, 40), st.just(4)), elements=values)


def crowd(seed: int, n: int = 160, spread_m: float = 1.0) -> Points:
    """Points of which some have neighbors."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-9.0, 9.0, (n // 8, 3))[rng.integers(0, n // 8, n)]
    points = np.column_stack([places + rng.normal(0.0, 0.05 * spread_m, (n, 3)), rng.random(n)])
    return np.ascontiguousarray(points, np.float32)


def counted(points: Points, eye: Sequence[float], wedge: float, most: int) -> NDArray[np.bool_]:
    """What the kernel of isolated points marks, with lists that many cells share; the slow twin says the same."""
    counts, mark = np.empty((4, 3), np.int64), np.zeros(len(points), np.bool_)
    heads, buffers = np.empty(8, np.int32), np.empty((2, len(points)), np.int32)
    points = points.copy()
    points.flags.writeable = False
    radius = np.array([0.009, 0.06, 0.09])
    mark_isolated(points, np.array(eye), (wedge, most, most + 1, 0.3), radius, heads, buffers, mark, counts)
    wanted, marked = twins.health.isolated(points, np.array(eye), wedge, most, 0.3, radius)
    np.testing.assert_array_equal(mark, marked)
    np.testing.assert_array_equal(counts, wanted)
    return mark


@settings(max_examples=120)
@given(scans, st.sampled_from(EYES), st.sampled_from([0.05, 0.5, math.inf]), st.sampled_from([0, 1, 3]))
def test_isolated_points_are_those_of_the_slow_twin(
    points: Points, eye: tuple[float, float, float], wedge: float, most: int
) -> None:
    counted(points, eye, wedge, most)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("most", [0, 1, 2])
def test_crowds_and_lonely_points_are_told_apart(seed: int, most: int) -> None:
    points = crowd(seed, spread_m=1.0 + seed)
    assert 0 < counted(points, EYES[0], math.inf, most).sum() < len(points)


@settings(max_examples=120)
@given(scans, st.sampled_from(EYES), st.sampled_from([1, 3]))
def test_sectors_are_those_of_the_slow_twin(points: Points, eye: tuple[float, float, float], step: int) -> None:
    counts, ranges, tans = np.empty((72, 4)), np.empty(256), np.array([-0.3, -0.1, -0.35])
    given_points = points.copy()
    given_points.flags.writeable = False
    n = fill_sectors(given_points, np.array(eye), step, tans, counts, ranges)
    wanted, wanted_ranges, *wanted_n = twins.health.sectors(points, np.array(eye), step, tans)
    assert n == tuple(wanted_n)
    np.testing.assert_array_equal(ranges, wanted_ranges)
    # The kernel's arc tangent is up to 0.22 deg off: a point at an edge may count beside it.
    np.testing.assert_array_equal(counts[:, :3].sum(axis=1), counts[:, 3])
    np.testing.assert_array_equal(counts.sum(axis=0), wanted.sum(axis=0))
    both = np.abs(counts[:, 3] - wanted[:, 3])
    azimuths = np.degrees(np.arctan2(points[:, 1] - eye[1], points[:, 0] - eye[0])) % 5.0
    if not ((azimuths < 0.3) | (azimuths > 4.7)).any():
        assert not both.any()


@settings(max_examples=80)
@given(
    hnp.arrays(np.float64, (72, 4), elements=st.sampled_from([0.0, 1.0, 2.0, 20.0, 30.0])),
    hnp.arrays(np.float64, (72, 4), elements=st.sampled_from([0.0, 5.0, 25.0, math.inf])),
)
def test_sectors_that_lack_returns_are_those_of_the_slow_twin(
    counts: NDArray[np.float64], fewest: NDArray[np.float64]
) -> None:
    lacks = np.ones((72, 4), np.bool_)
    fill_lacking(counts, fewest, lacks)
    np.testing.assert_array_equal(lacks, twins.health.lacking(counts, fewest))


@settings(max_examples=60)
@given(scans, st.sampled_from(sorted(SENSORS)))
def test_any_scan_has_a_health(points: Points, sensor: str) -> None:
    before, normal = points.copy(), Normal()
    for _ in range(7):
        health, normal = check_health(points, get_sensor(sensor), normal)
    np.testing.assert_array_equal(points, before)
    assert 0.0 <= health.blocked <= 1.0
    assert 0.0 <= health.isolated <= 1.0
    assert pickle.loads(pickle.dumps((health, normal)))[0] == health
    json.dumps(health.to_dict(), allow_nan=False)
    kept, n = without_drops(points, get_sensor(sensor))
    assert n == np.count_nonzero(np.isnan(kept[:, 0]) & ~np.isnan(points[:, 0]))


def test_no_point_and_one_point() -> None:
    for n in (0, 1):
        health, normal = check_health(np.ones((n, 4), np.float32), HDL, Normal())
        assert (health.blocked_deg, health.has_drops, health.has_fog) == ((), False, False)
        assert len(normal.returns) == n


def clear(seed: int, sensor: str | SensorProfile = "hdl-64e") -> Points:
    return urban(seed, sensor).points


@functools.cache
def usual(sensor: str = "hdl-64e") -> Normal:
    """What is normal after five streets."""
    normal, profile = Normal(), get_sensor(sensor)
    for seed in range(20, 25):
        normal = check_health(clear(seed, sensor), profile, normal)[1]
    assert normal.is_complete
    assert check_health(clear(3, sensor), profile, normal)[1] is normal
    return normal


@pytest.mark.parametrize("sensor", ["hdl-64e", "vlp-16", "os1-64", "pandar64"])
@pytest.mark.parametrize("seed", [3, 4])
def test_clear_air_and_a_clean_window_are_not_warned_of(sensor: str, seed: int) -> None:
    for normal in (Normal(), usual(sensor)):
        assert check_health(clear(seed, sensor), get_sensor(sensor), normal)[0].findings == ()


@pytest.mark.parametrize(("left", "right"), [(60.0, 20.0), (-100.0, -140.0), (15.0, -15.0), (-170.0, 150.0)])
@pytest.mark.parametrize("sensor", ["hdl-64e", "vlp-16", "os1-64"])
def test_a_blocked_sector_is_found_in_its_first_scan(sensor: str, left: float, right: float) -> None:
    scan = weather.dirty(clear(3, sensor), left, right)
    health, _ = check_health(scan, get_sensor(sensor), Normal())
    ((found_left, found_right),) = health.blocked_deg
    assert abs((found_left - left + 180.0) % 360.0 - 180.0) <= 5.0
    assert abs((found_right - right + 180.0) % 360.0 - 180.0) <= 5.0
    (text,) = health.findings
    assert "Clean the window" in text
    if sensor == "hdl-64e" and abs(left) < 90.0:
        assert f"from {abs(right):g} degrees {'left' if right > 0 else 'right'} to {left:g} degrees left" in text
    assert health.blocked > 0.05


@pytest.mark.parametrize("width_deg", [12.0, 30.0, 90.0])
def test_a_window_that_gets_dirty_is_found_and_what_was_always_hidden_is_not(width_deg: float) -> None:
    dirty = [weather.dirty(clear(seed), 60.0, 60.0 - width_deg) for seed in range(20, 26)]
    assert check_health(dirty[-1], HDL, usual())[0].blocked_deg
    normal = Normal()
    for scan in dirty[:5]:
        normal = check_health(scan, HDL, normal)[1]
    assert not check_health(dirty[-1], HDL, normal)[0].blocked_deg


@pytest.mark.parametrize("half_deg", [30.0, 45.0, 60.0])
def test_a_scan_cropped_to_a_view_is_not_blocked(half_deg: float) -> None:
    scan = clear(4)
    ahead = scan[np.abs(np.degrees(np.arctan2(scan[:, 1], scan[:, 0]))) < half_deg]
    assert check_health(ahead, HDL, Normal())[0].findings == ()
    later, _ = check_health(ahead, HDL, usual())
    assert (later.blocked_deg, later.other_sensor_deg) == ((), None)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.85])
@pytest.mark.parametrize("sensor", ["hdl-64e", "vlp-16", "os1-64", "hdl-32e", "pandar64"])
def test_a_scan_without_its_lowest_beams_is_a_part_of_one(sensor: str, share: float) -> None:
    scan, profile = clear(3, sensor), get_sensor(sensor)
    elevations = np.array(profile.elevations_deg)
    first = min(round(share * len(elevations)), len(elevations) - 2)  # a file of beams from the top that is cut
    lowest = (elevations[first - 1] + elevations[first]) / 2.0
    steep = np.degrees(np.arctan2(scan[:, 2], np.hypot(scan[:, 0], scan[:, 1])))
    health, _ = check_health(scan[steep > lowest], profile, Normal())
    assert abs(health.beams_missing - (len(elevations) - first)) <= 1
    assert f"lowest {health.beams_missing} of the sensor's beams" in health.findings[0]
    assert "cut short" in health.findings[0]
    assert check_health(scan, profile, Normal())[0].beams_missing == 0


@pytest.mark.parametrize(("sensor", "later"), [("hdl-64e", "os1-64"), ("hdl-64e", "vlp-16"), ("vlp-16", "hdl-64e")])
def test_another_sensor_after_the_first_scans_is_told(sensor: str, later: str) -> None:
    health, _ = check_health(clear(4, later), get_sensor(sensor), usual(sensor))
    (text,) = health.findings
    assert "seems to be of another sensor" in text
    np.testing.assert_allclose(health.to_dict()["other_sensor_deg"][0], get_sensor(later).elevations_deg[-1], atol=2.0)


@pytest.mark.parametrize("height_m", [0.0, 0.3])
def test_beams_are_not_missing_where_the_origin_is_not_at_the_sensor(height_m: float) -> None:
    raised = clear(3) + np.array([0.0, 0.0, 1.73 - height_m, 0.0], np.float32)
    frame = ModelFrame(Mounting(height_m, 0.0, 0.0, 0.0))
    assert check_health(frame.move(raised), HDL, Normal(), frame.eye)[0].beams_missing == 0


WEATHER: dict[str, Callable[[Points], Points]] = {
    "rain": lambda scan: weather.rain(scan, 25.0),
    "snow": lambda scan: weather.snow(scan, 1.5),
    "fog": lambda scan: weather.fog(scan, 25.0),
    "spray": lambda scan: weather.cloud(scan, (8.0, 0.0, -1.0), 2.5, 0.5),
    "exhaust": lambda scan: weather.cloud(scan, (-4.0, -0.5, -1.2), 1.5, 0.3),
}


@pytest.mark.parametrize("kind", sorted({*WEATHER} - {"fog"}))
@pytest.mark.parametrize("seed", [5, 6])
def test_weather_is_found_in_its_first_scan(kind: str, seed: int) -> None:
    scan = WEATHER[kind](clear(seed))
    if kind in ("rain", "snow"):  # all round also for who looks ahead alone
        assert check_health(scan[scan[:, 0] > np.abs(scan[:, 1])], HDL, Normal())[0].has_drops
    health, _ = check_health(scan, HDL, Normal())
    assert health.has_drops or (health.has_cloud and kind in ("spray", "exhaust"))
    (text,) = health.findings
    assert ("spray, dust or exhaust" if health.has_cloud else "rain, snow, or dust all round") in text


def test_drops_are_found_where_both_returns_of_a_pulse_are_written() -> None:
    """A drop whose two returns are one seemed to have a neighbor: rain was clear air, and each drop an object."""
    scan = clear(9)
    wet = np.repeat(WEATHER["rain"](scan), 2, axis=0)
    assert check_health(wet, HDL, Normal())[0].has_drops
    assert check_health(np.repeat(scan, 2, axis=0), HDL, Normal())[0].findings == ()
    assert without_drops(wet, HDL)[1] > 1.7 * without_drops(wet[::2], HDL)[1]


@pytest.mark.parametrize("seed", [5, 6, 7])
def test_fog_is_a_range_that_shrank_and_a_narrow_street_is_not(seed: int) -> None:
    normal = usual()
    health, _ = check_health(weather.fog(clear(seed), 25.0), HDL, normal)
    assert health.has_fog
    assert health.range_m < 0.6 * health.normal_range_m
    assert any("fog" in text for text in health.findings)
    x, y, z, r = clear(seed).T
    across = np.abs(y) > 3.0
    factor = np.where(across, 3.0 / np.maximum(np.abs(y), 1e-6), 1.0).astype(np.float32)
    narrow = np.column_stack([x * factor, y * factor, z * factor, r]).astype(np.float32)  # walls 3 m beside
    assert not check_health(narrow, HDL, normal)[0].has_fog


@pytest.mark.parametrize("height_m", [0.5, 3.0])
def test_the_place_of_the_sensor_counts(height_m: float) -> None:
    frame = ModelFrame(Mounting(height_m, 0.0, 0.0, 0.0))
    profile = replace(HDL, mounting=Mounting(height_m))
    scan = frame.move(weather.dirty(clear(8, profile), -30.0, -70.0))
    health, _ = check_health(scan, profile, Normal(), tuple(frame.eye))
    assert len(health.blocked_deg) == 1
    assert check_health(frame.move(clear(8, profile)), profile, Normal(), tuple(frame.eye))[0].blocked_deg == ()


@pytest.mark.parametrize("kind", ["rain", "snow", "spray"])
def test_most_drops_are_left_out_and_hardly_anything_else(kind: str) -> None:
    scan = clear(9)
    wet = WEATHER[kind](scan)
    kept, n = without_drops(wet, HDL)
    removed = np.isnan(kept[:, 0])
    assert n == removed.sum()
    known = {tuple(row) for row in scan[:, :3].tolist()}
    is_drop = np.array([tuple(row) not in known for row in wet[:, :3].tolist()])
    near = np.linalg.norm(wet[:, :3], axis=1) < 10.0
    assert (removed & is_drop).sum() > 0.6 * (is_drop & near).sum()
    assert (removed & ~is_drop).sum() < 0.05 * (near & ~is_drop).sum()


# What a perceiver does with it


def test_a_perceiver_tells_of_each_kind_once_and_leaves_drops_out() -> None:
    perceive, scan = Perceiver(), clear(11)
    found = perceive(scan)
    assert (found.health.findings, found.health.n_drops) == ((), 0)
    for _ in range(5):
        perceive(scan)
    assert perceive.learned.is_settled
    bad = weather.dirty(weather.snow(scan, 2.5), 60.0, 20.0)
    bad = bad[np.linalg.norm(bad[:, :3], axis=1) > 1.0]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        snowy = perceive(bad)
    assert [str(each.message) for each in told] == list(snowy.health.findings if snowy.health else ())
    again = perceive(bad)
    assert again.health == snowy.health
    perceive.reset_mounting()
    with warnings.catch_warnings(record=True) as anew:
        warnings.simplefilter("always")
        perceive(bad)
    assert any("window of the sensor is blocked" in str(each.message) for each in anew)
    assert again.boxes == snowy.boxes
    np.testing.assert_array_equal(again.require_points().labels, snowy.require_points().labels)
    assert snowy.health.n_drops > 100
    record = scan_record(snowy)["sensor_health"]
    assert record["has_drops"]
    assert len(record["findings"]) == 2
    assert pickle.loads(pickle.dumps(snowy)).health == snowy.health
    out = np.flatnonzero(np.isnan(without_drops(bad, HDL)[0][:, 0]))
    assert not snowy.require_points().in_view[out].any()
    grid, worse = occupancy_grid(snowy, bad), occupancy_grid(replace(snowy, health=SensorHealth()), bad)
    assert grid.obstacle.sum() < worse.obstacle.sum()


@pytest.mark.parametrize("sensor", ["hdl-64e", "vlp-16"])
def test_what_the_own_body_hides_is_not_blocked_and_dirt_before_it_is(sensor: str) -> None:
    scan = clear(11, sensor).copy()
    behind = scan[:, 0] < -np.abs(scan[:, 1])
    scan[behind, :3] /= -scan[behind, :1]  # meets a wall 1 m behind the sensor
    box = ((-1.1, -0.9), (-1.1, 1.1), (-1.0, 1.0))
    perceive = Perceiver("pointseg", sensor=replace(get_sensor(sensor), ego_box=box), on_mismatch="ignore")
    perceive(clear(11, sensor))
    assert perceive(scan).health.returns_share == pytest.approx(1.0, abs=0.01)
    perceive.reset_mounting()
    found = perceive(scan)
    assert found.dropped.ego == behind.sum()
    assert (found.health.blocked_deg, found.health.beams_missing) == ((), 0)
    for left, right in ((60.0, 20.0), (-160.0, 160.0)):
        perceive.reset_mounting()
        assert perceive(weather.dirty(scan, left, right)).health.blocked_deg == ((left, right),)


def test_ignoring_mismatches_keeps_quiet_and_another_vehicle_is_learned_anew() -> None:
    perceive = Perceiver("pointseg", on_mismatch="ignore")
    found = perceive(weather.dirty(clear(11), 60.0, 10.0))
    assert found.health.blocked_deg
    assert len(perceive.learned.normal.returns) == 1
    other = Perceiver("pointseg", on_mismatch="ignore")
    other.start_from(perceive.learned)
    assert other.learned.normal is perceive.learned.normal
    perceive.reset_mounting()
    assert perceive.learned.normal.returns == ()


def test_drops_cost_no_drivable_area() -> None:
    scan = clear(12)
    clean, wet = Perceiver()(scan), weather.snow(scan, 2.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        snowy = Perceiver()(wet)
    assert snowy.require_top_view().drivable_area_m2 > 0.9 * clean.require_top_view().drivable_area_m2
    assert len(snowy.boxes) <= len(clean.boxes) + 2
