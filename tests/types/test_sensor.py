"""Sensor profiles are possible sensors; scans unlike the training's are reported, ordinary ones are not."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import twins.fitness
from edgeperc.datasets.layout import known_layouts, read_layout
from edgeperc.errors import CardError, PointsError, SensorError
from edgeperc.preprocess.findings import check_fitness
from edgeperc.preprocess.fitness import SUMS, FitnessProfile, Histograms, Rows, fill_scan_sums
from edgeperc.readers.files import read_points
from edgeperc.types.sensor import PUBLIC_SENSORS, SENSORS, SensorProfile, get_sensor
from scenes import urban


def test_built_in_profiles() -> None:
    beams = {name: profile.n_beams for name, profile in SENSORS.items() if profile.pattern is None}
    assert beams == {
        **{"hdl-64e": 64, "hdl-32e": 32, "vlp-16": 16, "vlp-32c": 32, "pandar64": 64, "pandarxt-32": 32},
        **{f"{model}-{n}": n for model in ("os0", "os1", "os2") for n in (32, 64, 128)},
    }
    for name, profile in SENSORS.items():
        assert get_sensor(name) is profile
        assert profile.name == name
        assert profile.fov_up_deg > 0 > profile.fov_down_deg
        assert profile.azimuth_resolution_deg * profile.columns == pytest.approx(360)
        raw = np.array(profile.remission_range)
        np.testing.assert_allclose((raw + profile.remission_offset) * profile.remission_scale, [0, 1])


@pytest.mark.parametrize(
    ("name", "points_per_s", "width_deg", "fov_deg"),
    [("mid-360", 200_000, 360, (-7, 52)), ("hap", 452_000, 120, (-12.5, 12.5)), ("avia", 240_000, 70.4, (-38.6, 38.6))],
)
def test_sensors_without_beams_show_more_the_longer_they_gather(
    name: str, points_per_s: float, width_deg: float, fov_deg: tuple[float, float]
) -> None:
    profile = get_sensor(name)
    assert (profile.pattern.points_per_s, profile.pattern.width_deg) == (points_per_s, width_deg)
    assert (profile.fov_down_deg, profile.fov_up_deg) == fov_deg
    assert profile.accumulated(profile.pattern.accumulate_s) == profile
    short, long = profile.accumulated(0.1), profile.accumulated(0.4)
    assert long.pattern == replace(profile.pattern, accumulate_s=0.4)
    assert long.n_beams == pytest.approx(2 * short.n_beams, abs=1.5)
    assert long.columns == pytest.approx(2 * short.columns, abs=1.5)
    cells = short.n_beams * short.columns * width_deg / 360.0
    assert 0.1 * points_per_s == pytest.approx(4.0 * cells, rel=0.05)
    assert SensorProfile.from_json(long.to_json()) == long


@pytest.mark.parametrize("seconds", [0.0, -0.1, 11.0, float("nan"), "0.1", True, None])
def test_times_over_which_nothing_is_gathered(seconds: Any) -> None:
    with pytest.raises(SensorError, match=r"pattern.accumulate_s is .*; expected a number from 0.01 to 10"):
        get_sensor("mid-360").accumulated(seconds)


@pytest.mark.parametrize("name", ["hdl-64e", "vlp-16", "lyft"])
def test_turns_are_not_gathered(name: str) -> None:
    with pytest.raises(SensorError, match=f"sensor '{name}' spins: each of its turns is a scan"):
        get_sensor(name).accumulated(0.2)


@pytest.mark.parametrize(
    ("name", "value"),
    [("points_per_s", 0.0), ("width_deg", 361.0), ("turns_hz", (1.0,)), ("turns_hz", (1.0, float("inf")))],
)
def test_patterns_that_are_none(name: str, value: Any) -> None:
    pattern = get_sensor("avia").pattern
    with pytest.raises(SensorError, match=f"pattern.{name}"):
        replace(pattern, **{name: value})
    with pytest.raises(SensorError, match="pattern is a ScanPattern or None"):
        replace(get_sensor("avia"), pattern="rosette")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", known_layouts())
def test_a_public_set_is_a_sensor(name: str) -> None:
    """By the name of its layout, with the profile of its layout, and never beside the built-in ones."""
    assert get_sensor(name) is PUBLIC_SENSORS[name]
    assert read_layout(name).sensor == PUBLIC_SENSORS[name]
    assert name not in SENSORS
    assert {*PUBLIC_SENSORS} == {*known_layouts()}


def test_vlp_16_is_evenly_spaced() -> None:
    np.testing.assert_allclose(get_sensor("vlp-16").elevations_deg, np.arange(15, -16, -2))


def test_own_and_changed_profiles() -> None:
    own = SensorProfile.uniform("mine", 40, 7.0, -16.0, columns=1800, remission_range=(10, 110))
    assert get_sensor(own) is own
    assert (own.n_beams, own.fov_up_deg, own.fov_down_deg) == (40, 7.0, -16.0)
    assert (60 + own.remission_offset) * own.remission_scale == 0.5
    assert replace(own, remission_range=(0, 65535)).remission_scale == 1 / 65535
    assert SensorProfile("list", [1, -1], 10).elevations_deg == (1.0, -1.0)
    with pytest.raises(FrozenInstanceError):
        own.columns = 3


def test_a_profile_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    """Editors of Windows write one."""
    (tmp_path / "own.json").write_text(SENSORS["vlp-16"].to_json(), "utf-8-sig")
    assert get_sensor(tmp_path / "own.json") == SENSORS["vlp-16"]


@pytest.mark.parametrize("name", ["hdl64", "HDL-64E", "", None, ["vlp-16"]])
def test_an_unknown_sensor_lists_the_known(name: Any) -> None:
    with pytest.raises(SensorError, match=r"hdl-64e.*pandarxt-32"):
        get_sensor(name)


@pytest.mark.parametrize(
    "change",
    [
        {"name": ""},
        {"elevations_deg": ()},
        {"elevations_deg": (1.0, 1.0)},
        {"elevations_deg": (-1.0, 1.0)},
        {"elevations_deg": (90.0, 1.0)},
        {"elevations_deg": (1.0, float("nan"))},
        {"elevations_deg": ("up", "down")},
        {"elevations_deg": 3},
        {"columns": 0},
        {"columns": 1.5},
        {"columns": float("nan")},
        {"remission_range": (1, 0)},
        {"remission_range": (0, float("inf"))},
        {"remission_range": (0, 1, 2)},
        {"min_range_m": -1.0},
        {"max_range_m": 0.5},
        {"max_range_m": float("inf")},
        {"max_range_m": None},
    ],
)
def test_impossible_sensors_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(SensorError):
        replace(get_sensor("vlp-16"), **change)


@pytest.mark.parametrize("beams", [0, -1, 2.0, True, 5000])
def test_impossible_numbers_of_beams_are_refused(beams: Any) -> None:
    with pytest.raises(SensorError, match=r"1\.\.4096"):
        SensorProfile.uniform("mine", beams, 1, -1)
    with pytest.raises(SensorError, match="finite"):
        SensorProfile.uniform("mine", 3, float("nan"), -1)


SENSOR = get_sensor("hdl-64e")


@pytest.fixture(scope="module")
def streets() -> list[np.ndarray]:
    return [urban(seed).points for seed in range(6)]


@pytest.fixture(scope="module")
def profile(streets: list[np.ndarray]) -> FitnessProfile:
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


FAULTS = {
    "x and y swapped": (lambda p: p[:, [1, 0, 2, 3]], "as if the road ran along y"),
    "nuScenes' axes": (in_nuscenes_axes, "--turn -90"),
    "a camera's axes": (in_camera_axes, "pass z, -x, -y"),
    "upside down": (rescaled([1, -1, -1, 1]), "upside down"),
    "ground at zero": (lambda p: p + np.float32([0, 0, 1.73, 0]), "another height"),
    "millimeters": (rescaled([1e3, 1e3, 1e3, 1]), "millimeters"),
    "kilometers": (rescaled([1e-3, 1e-3, 1e-3, 1]), "kilometers"),
    "a crop turned away": (lambda p: in_nuscenes_axes(cropped(p)), "Only 0% of the model's view"),
    "remission to 255": (rescaled([1, 1, 1, 255]), r"remission_range is \(0, 255\)"),
    "remission to 65535": (rescaled([1, 1, 1, 65535]), r"remission_range is \(0, 65535\)"),
    "remission scaled twice": (rescaled([1, 1, 1, 1 / 255]), "hardly exceeds"),
    "negative remission": (lambda p: p - np.float32([0, 0, 0, 0.5]), "Remission runs from -0.5"),
    "no remission": (rescaled([1, 1, 1, 0]), "Remission is 0 for 100%"),
    "constant remission": (lambda p: columns(p[:, :3], np.full(len(p), 0.4)), "the same for 100%"),
    "dark remission": (lambda p: columns(p[:, :3], p[:, 3] / np.where(p[:, 3] < 0.4, 8, 1)), "median remission"),
    "almost empty": (lambda p: p[::100], "is the scan complete"),
    "a hundred points": (lambda p: p[::500], "is the scan complete"),
    "many turns": (lambda p: np.tile(p, (8, 1)), "one turn"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_reported(streets: list[np.ndarray], profile: FitnessProfile, fault: str) -> None:
    spoil, expected_text = FAULTS[fault]
    for scan in streets[3:]:
        findings = check_fitness(np.ascontiguousarray(spoil(scan)), profile, SENSOR)
        assert findings
        assert re.search(expected_text, " ".join(findings)), findings


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
        assert check_fitness(scan, profile, SENSOR) == ()
        assert check_fitness(rng.permutation(scan), profile, SENSOR) == ()
        assert check_fitness(cropped(scan), profile, SENSOR) == ()
        spoilt = np.insert(scan, slice(0, None, 20), np.float32(np.nan), axis=0)
        assert check_fitness(spoilt, profile, SENSOR) == ()


def test_scan_without_finite_points_is_reported(profile: FitnessProfile) -> None:
    for scan in (np.empty((0, 4), np.float32), np.full((9, 4), np.nan, np.float32)):
        assert "no finite point" in check_fitness(scan, profile, SENSOR)[0]
    assert check_fitness(np.zeros((1, 4), np.float32), profile, SENSOR)
    with pytest.raises(PointsError, match="shape"):
        check_fitness(np.zeros((5, 3), np.float32), profile, SENSOR)


def test_profile_is_read_back_from_json(profile: FitnessProfile) -> None:
    assert FitnessProfile.from_dict(json.loads(json.dumps(profile.to_dict(), allow_nan=False))) == profile
    crops_only = FitnessProfile.from_scans([cropped(urban(1).points)])
    assert crops_only.road_ahead is None
    assert FitnessProfile.from_dict(json.loads(json.dumps(crops_only.to_dict(), allow_nan=False))) == crops_only
    assert check_fitness(urban(2).points, crops_only, SENSOR) == ()


@pytest.mark.parametrize(
    "change", [{"beams": None}, {"beams": 3}, {"beams": [1, "x"]}, {"beams": [1, float("nan")]}, {"more": [0, 1]}]
)
def test_a_damaged_profile_is_refused(profile: FitnessProfile, change: dict[str, Any]) -> None:
    with pytest.raises(CardError):
        FitnessProfile.from_dict(profile.to_dict() | change)
    with pytest.raises(CardError):
        FitnessProfile.from_dict({})


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
        if (findings := check_fitness(scan, kitti_profile, SENSOR))
    }
    more = sorted((semantickitti_root / "sequences" / "00" / "velodyne").glob("*.bin"))
    assert len(more) == 16
    found |= {
        path.name: findings for path in more if (findings := check_fitness(read_points(path), kitti_profile, SENSOR))
    }
    assert found == {}


def test_kitti_scans_turned_by_90_degrees_are_mostly_reported(
    kitti_scans: tuple[list[dict[str, Any]], list[np.ndarray]], kitti_profile: FitnessProfile
) -> None:
    full = [scan for frame, scan in zip(*kitti_scans, strict=True) if frame["crop"] == "0"]
    found = sum(bool(check_fitness(in_nuscenes_axes(scan), kitti_profile, SENSOR)) for scan in full)
    assert found / len(full) > 0.85


@pytest.mark.parametrize(
    "fault",
    [
        "a camera's axes",
        "upside down",
        "ground at zero",
        "millimeters",
        "remission to 255",
        "no remission",
        "almost empty",
    ],
)
def test_corrupted_kitti_scans_are_reported(
    kitti_scans: tuple[list[dict[str, Any]], list[np.ndarray]], kitti_profile: FitnessProfile, fault: str
) -> None:
    spoil, expected_text = FAULTS[fault]
    for frame, scan in list(zip(*kitti_scans, strict=True))[:154:5]:
        findings = check_fitness(np.ascontiguousarray(spoil(scan)), kitti_profile, SENSOR)
        expected = "another height|not the sensor" if fault == "ground at zero" else expected_text
        assert re.search(expected, " ".join(findings)), (frame["name"], findings)


def test_nuscenes_sweep_is_reported(data_root: Callable[[str], Path], kitti_profile: FitnessProfile) -> None:
    (path,) = (data_root("other_sensors") / "nuscenes_sweep").glob("*.bin")
    findings = " ".join(check_fitness(read_points(path), kitti_profile, SENSOR))
    for expected_text in ("--turn -90", "(0, 255)", "rows of points"):
        assert expected_text in findings
