"""Sensors that do not spin: their scans are perceived, standing and driving, alone and four around a vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edgeperc import merge
from edgeperc.types.sensor import SensorProfile, get_sensor
from edgeperc_bench import solid_state

pytest.importorskip("onnxruntime")
pytestmark = pytest.mark.compiled


def brief(name: str) -> SensorProfile:
    """A sensor that is gathered for 20 ms alone: thousands of points, which take seconds less to simulate."""
    sensor = get_sensor(name)
    return sensor if sensor.pattern is None else replace(sensor, pattern=replace(sensor.pattern, accumulate_s=0.02))


@pytest.mark.parametrize(("title", "speed_mps"), [("mid-360-hanging, 0.2 s", 10.0), ("hap, 0.2 s", 0.0)])
def test_cars_are_found(title: str, speed_mps: float) -> None:
    rows = solid_state.sensors_of([title.partition(",")[0]])
    sensor, accumulate_s = next((sensor, time_s) for name, sensor, time_s in rows if name == title)
    _, classes, _, _ = solid_state.row_of(sensor, accumulate_s, speed_mps, 2).split("|")
    assert float(classes.split("/")[0]) >= 80.0


def test_a_street_is_gathered_on_the_way() -> None:
    sensor = get_sensor("mid-360").accumulated(0.2)
    standing, driving = (solid_state.gathered(5, sensor, 0.2, speed_mps) for speed_mps in (0.0, 10.0))
    for points, labels, last, returns in (standing, driving):
        assert len(points) == len(labels) > 1000
        assert len(returns) == len(last.boxes)
        assert sum(returns) == pytest.approx(np.count_nonzero(labels), rel=0.5)
    last = driving[2]
    np.testing.assert_array_equal(solid_state.gathered(5, sensor, 0.2, 10.0)[0], driving[0])
    assert last.T_world_sensor[0, 3] == pytest.approx(1.9, abs=0.3)


def test_four_around_see_all_sides() -> None:
    scans, poses = solid_state.around(3, brief("hap"))
    merged = merge(scans, poses)
    assert len(merged) == sum(map(len, scans))
    azimuth = np.degrees(np.arctan2(merged[:, 1], merged[:, 0]))
    assert (np.histogram(azimuth, 36, (-180.0, 180.0))[0] > 100).all()
    ground = merged[np.abs(merged[:, 2]) < 0.3]
    assert len(ground) > 0.1 * len(merged)  # z is 0 on the road


def test_the_commands(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solid_state, "get_sensor", brief)
    solid_state.main(["--turn", "avia", "--turns", "2"])
    header, _, row = capsys.readouterr().out.splitlines()
    assert len(row.split("|")) == len(header.split("|"))
    assert row.startswith("| avia | ")
    solid_state.main(["--scans", "1", "--sensors"])
    assert [line.split("|")[1].strip() for line in capsys.readouterr().out.splitlines()[2:]] == ["vlp-16"] * 2
