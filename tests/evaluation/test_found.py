"""Sensors that are found, beside those that took the scans."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli_helpers import run
from edgeperc.errors import PointsError
from edgeperc.evaluation.transfer import compare_beams, find_sensors
from edgeperc.types.sensor import SENSORS, SensorProfile, get_sensor
from scenes import urban

VLP = SENSORS["vlp-16"]


@pytest.mark.parametrize(
    ("elevations_deg", "off_deg", "is_whole"),
    [
        (VLP.elevations_deg, 0.0, True),
        (VLP.elevations_deg[3:], 0.0, True),  # no return above
        (VLP.elevations_deg[:5] + VLP.elevations_deg[6:], 0.0, False),
        (tuple(e + 0.2 for e in VLP.elevations_deg), 0.2, True),
    ],
)
def test_beams_are_compared_with_those_next_to_them(
    elevations_deg: tuple[float, ...], off_deg: float, is_whole: bool
) -> None:
    error_deg, whole = compare_beams(replace(VLP, elevations_deg=elevations_deg), VLP)
    assert error_deg == pytest.approx(off_deg)
    assert whole == is_whole


def test_right_wrong_and_cannot_tell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urban(3, "vlp-16").points.tofile(tmp_path / "0.bin")
    np.random.default_rng(0).uniform(-20.0, 20.0, (5000, 4)).astype(np.float32).tofile(tmp_path / "1.bin")
    two = urban(3, "os1-64").points
    np.concatenate([two, two + np.array([1.4, 0.3, -0.2, 0.0], np.float32)]).tofile(tmp_path / "2.bin")
    file = tmp_path / "other.json"
    file.write_text(SensorProfile.uniform("other", 16, 14.0, -14.0).to_json())
    datasets = [f"vlp-16={tmp_path / '0.bin'}", f"{file}={tmp_path / '0.bin'}", f"vlp-16={tmp_path / '1.bin'}"]
    datasets.append(f"os1-64={tmp_path / '2.bin'}")
    figures = tmp_path / "figures.json"
    assert run("eval-sensors", "--find", *datasets, "--json", figures) == 1
    right, wrong, neither, dense = (json.loads(figures.read_text())[name] for name in datasets)
    assert (right["right"], right["found"], right["off_deg"]) == (1, ["vlp-16"], 0.0)
    assert (wrong["wrong"], wrong["off_deg"]) == (1, pytest.approx(1.0, abs=0.1))
    assert (neither["cannot_tell"], neither["found"], neither["off_deg"]) == (1, [], None)
    assert (dense["cannot_tell"], dense["wrong"], dense["found"], dense["off_deg"]) == (1, 0, ["beamless"], None)
    assert "found none; 0 right, 1 cannot tell, 0 wrong" in capsys.readouterr().out


def test_simulated_scans_are_found() -> None:
    (found,) = find_sensors(["pandarxt-32=simulation"]).values()
    assert (found["sensor"], found["n_scans"], found["right"]) == (get_sensor("pandarxt-32").name, 3, 4)


def test_an_unknown_source_says_what_is_expected(tmp_path: Path) -> None:
    with pytest.raises(PointsError, match="Expected SENSOR=simulation"):
        find_sensors([str(tmp_path / "none")])
