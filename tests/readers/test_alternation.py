"""Several sensors on one topic with one frame are said, one sensor never is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from capture_writers import write_clouds
from numpy.typing import NDArray

from edgeperc import read_scans
from edgeperc.readers.alternation import told_apart
from edgeperc.readers.times import TimedScan
from edgeperc.simulation import random_scene, simulate
from edgeperc.types.sensor import get_sensor

Mount = tuple[float, float, float, float]  # x, y, z, yaw
SENSOR = replace(get_sensor("vlp-16"), columns=600)  # as many points as are looked at of a scan of 1800 columns
LEFT, RIGHT, FRONT, REAR, LOW = (
    (0.0, 0.7, 1.8, 0.0),
    (0.0, -0.7, 1.8, 0.0),
    (1.5, 0.0, 1.8, 0.0),
    (-1.5, 0.0, 1.8, math.pi),
    (1.5, 0.0, 0.6, 0.0),
)


@cache
def drive(mounts: tuple[Mount, ...], speed_mps: float, seed: int, n: int = 12) -> list[NDArray[np.float32]]:
    """Scans of sensors that take turns."""
    scene, scans = random_scene(seed), []
    for k in range(n):
        x, y, z, yaw = mounts[k % len(mounts)]
        T = np.eye(4)
        T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        T[:3, 3] = x + speed_mps * 0.1 * k / len(mounts), y, z
        scans.append(simulate(scene, SENSOR, seed=k, T_world_sensor=T).points)
    return scans


def said(scans: Sequence[NDArray[np.float32]]) -> list[str]:
    texts: list[str] = []
    given = [TimedScan(0.1 * k, points, None) for k, points in enumerate(scans)]
    assert [*told_apart(iter(given), texts.append)] == given
    return texts


@pytest.mark.parametrize("mounts", [(LEFT, RIGHT), (FRONT, REAR), (FRONT, LOW), (REAR, LOW)])
@pytest.mark.parametrize("speed_mps", [0.0, 3.0])
def test_two_sensors_are_said_once(mounts: tuple[Mount, ...], speed_mps: float) -> None:
    (text,) = said(drive(mounts, speed_mps, 1) * 2)
    assert text.startswith("every second scan is alike, and those between are not: 2 sensors share the topic")


@pytest.mark.parametrize(("mounts", "speed_mps"), [((LEFT, RIGHT), 15.0), ((FRONT, REAR), 25.0), ((FRONT, LOW), 20.0)])
def test_two_sensors_at_speed_are_said_by_many_scans(mounts: tuple[Mount, ...], speed_mps: float) -> None:
    (text,) = said(drive(mounts, speed_mps, 1, 24))
    assert text.startswith("every second scan is alike")


@pytest.mark.parametrize("speed_mps", [3.0, 25.0])
def test_many_scans_of_one_sensor_are_not(speed_mps: float) -> None:
    assert said(drive((FRONT,), speed_mps, 2, 24)) == []


def test_three_sensors_are_said() -> None:
    (text,) = said(drive((LEFT, REAR, LOW), 2.0, 2))
    assert text.startswith("every third scan is alike, and those between are not: 3 sensors")


@pytest.mark.parametrize("speed_mps", [0.0, 3.0, 20.0, -5.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_one_sensor_is_not(speed_mps: float, seed: int) -> None:
    assert said(drive((FRONT,), speed_mps, seed)) == []


@pytest.mark.parametrize("n_points", [0, 1, 5000])
def test_scans_that_are_the_same_or_empty_are_not(n_points: int) -> None:
    points = drive((FRONT,), 0.0, 1)[0][:n_points]
    nothing = np.empty((0, 4), np.float32)
    assert said([points] * 20) == []
    assert said([points, points, nothing] * 9) == []
    assert said([np.full((n_points, 4), np.nan, np.float32), points] * 3) == []


@pytest.mark.usefixtures("in_this_process")
def test_a_bag_of_two_sensors_is_warned_of(tmp_path: Path) -> None:
    kind = [(name, "f4") for name in "xyzi"]
    scans = ((float(k), points.view(kind)[:, 0]) for k, points in enumerate(drive((FRONT, REAR), 3.0, 1)))
    path = write_clouds(tmp_path / "drive.bag", scans)
    with pytest.warns(UserWarning, match="bag: every second scan is alike"):
        assert len([*read_scans(path)]) == 12
