"""Sensor profiles are possible sensors."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edgeperc.datasets.layout import known_layouts, read_layout
from edgeperc.errors import SensorError
from edgeperc.types.mounting import Mounting
from edgeperc.types.sensor import PUBLIC_SENSORS, SENSORS, SensorProfile, get_sensor


def test_built_in_profiles() -> None:
    beams = {name: profile.n_beams for name, profile in SENSORS.items() if profile.pattern is None}
    assert beams == {
        **{"hdl-64e": 64, "hdl-32e": 32, "vlp-16": 16, "vlp-32c": 32, "pandar64": 64, "pandarxt-32": 32},
        **{"vlp-16-hi-res": 16, "vls-128": 128, "pandar40p": 40, "pandarqt-64": 64, "pandarxt-32m": 32},
        **{"ot128": 128, "jt128": 128, "helios-32": 32, "helios-16": 16, "rs-bpearl": 32, "ruby-plus-128": 128},
        **{"at128": 128, "rs-m1": 125, "rs-e1": 144},
        **{f"{model}-{n}": n for model in ("os0", "os1", "os2") for n in (32, 64, 128)},
    }
    for name, profile in SENSORS.items():
        assert get_sensor(name) is profile
        assert profile.name == name
        assert profile.fov_up_deg > 0 > profile.fov_down_deg or name == "rs-bpearl"  # which looks up
        assert profile.azimuth_resolution_deg * profile.columns == pytest.approx(360)
        raw = np.array(profile.remission_range)
        np.testing.assert_allclose((raw + profile.remission_offset) * profile.remission_scale, [0, 1])


def test_sparse_sensors() -> None:
    """By their gaps, or by few beams where the range image looks: not those of a JT128 that hangs."""
    assert {name for name, profile in SENSORS.items() if profile.is_sparse} == {
        *("vlp-16", "vlp-16-hi-res", "os0-32", "os1-32", "pandarqt-64", "pandarxt-32m", "jt128", "helios-32"),
        *("helios-16", "rs-bpearl", "mid-360"),
    }
    assert not replace(SENSORS["jt128"], mounting=Mounting(2.0, roll_deg=180.0)).is_sparse
    assert not SENSORS["mid-360"].accumulated(0.5).is_sparse


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


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])  # editors of Windows write a byte order mark
def test_a_profile_is_read_back_from_its_file(tmp_path: Path, name: str, encoding: str) -> None:
    file = tmp_path / "own.json"
    file.write_text(SENSORS[name].to_json(), encoding)
    assert get_sensor(file) == get_sensor(str(file)) == SENSORS[name]


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
    with pytest.raises(SensorError, match=r"n_beams is .*; expected a whole number from 1 to 4096"):
        SensorProfile.uniform("mine", beams, 1, -1)
    for up in (float("nan"), "15"):
        with pytest.raises(SensorError, match="fov_up_deg is"):
            SensorProfile.uniform("mine", 3, up, -1)  # type: ignore[arg-type]
