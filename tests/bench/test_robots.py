"""Low sensors and robots: scans of each kind are as they are said to be, and are perceived."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from edgeperc import Mounting
from edgeperc.ground.leveling import MountingEstimator
from edgeperc_bench import robots

pytest.importorskip("onnxruntime")
pytestmark = pytest.mark.compiled


@pytest.mark.parametrize(("height_m", "seed"), [(0.3, 3), (0.5, 5), (0.8, 6)])
@pytest.mark.parametrize("place", robots.PLACES)
def test_the_mounting_of_a_robot_is_found(place: str, height_m: float, seed: int) -> None:
    scan = robots.scan_of(seed, robots.sensor_of("os1-64"), height_m, place)
    assert len(scan.points) == len(scan.labels) == len(scan.objects)
    found = MountingEstimator(Mounting()).add(scan.points).mounting()
    assert found.height_m == pytest.approx(height_m, abs=0.15)
    assert math.hypot(found.roll_deg or 0.0, found.pitch_deg or 0.0) < 4.0


def test_places_differ() -> None:
    sensor = robots.sensor_of("vlp-16")
    road, slope, half, box = (robots.scan_of(3, sensor, 0.5, place) for place in ("road", "slope", "half", "box"))
    assert half.points[:, 0].min() >= 0.0
    assert np.count_nonzero(road.points[:, 0] >= 0.0) == len(half.points)
    behind = box.points[box.points[:, 0] < 0.0]
    assert np.isclose(behind[:, 0], -robots.BOX_BEHIND_M, atol=1e-5).sum() > 0.2 * len(behind)
    tilt_deg = np.degrees(np.arccos(slope.T_world_sensor[2, 2]))
    assert tilt_deg == pytest.approx(robots.SLOPE_DEG)


def test_a_table_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    robots.main(["--scans", "1", "--sensors", "vlp-16", "--heights", "0.5", "--places", "road", "box-given"])
    rows = capsys.readouterr().out.strip().splitlines()[2:]
    assert [row.split("|")[2:4] for row in rows] == [
        [f" 0.5 m, {place} ", f" {word} "] for place in ("road", "box-given") for word in ("given", "found")
    ]
    assert all("1 of 1" in row for row in rows)


def test_programs_say_what_is_wrong() -> None:
    wrong = {"robots --sensors nosuch": "no sensor 'nosuch'", "surroundings .:nosuch": "no layout 'nosuch'"}
    for typed, said in (wrong | {"conditions --clean . vlp-16": ". holds no scan"}).items():
        command = f"{sys.executable} -m edgeperc_bench.{typed}".split()
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, done.stderr.startswith(f"edgeperc_bench.{typed.split()[0]}: {said}")) == (2, True)
