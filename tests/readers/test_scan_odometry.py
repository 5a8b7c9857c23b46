"""Poses from the scans alone."""

from __future__ import annotations

import math
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from edgeperc import MissingExtraError, Odometry, PointsError, StampError
from edgeperc.readers.scan_odometry import first_shift, part_of
from edgeperc.simulation import random_scene, simulate_sequence


def test_a_drive_is_followed() -> None:
    """From its first step on, though the sensor moves already, and where scans are missing."""
    pytest.importorskip("kiss_icp", reason="the extra slam is not installed")
    true, found, odometry = [], [], Odometry()
    for k, (stamp_s, pose, scan) in enumerate(simulate_sequence(random_scene(3, "urban"), "os1-64", 13, 10.0, 12.0)):
        if k in (6, 7, 9):
            continue
        # Drawn ground is so smooth that its scan lines hold the estimate back.
        standing = np.where((scan.surfaces >= 0)[:, None], scan.points, np.float32(np.nan))
        true.append(pose)
        found.append(odometry(standing, stamp_s))
    steps = np.array([[np.linalg.inv(a) @ b for a, b in pairwise(poses)] for poses in (true, found)])
    np.testing.assert_allclose(steps[1, :, :3, 3], steps[0, :, :3, 3], atol=0.15)
    np.testing.assert_array_equal(odometry(np.zeros((0, 4)), stamp_s + 0.1), found[-1])
    np.testing.assert_array_equal(odometry(standing + np.float32(1.0), stamp_s), found[-1])  # late
    with pytest.raises(PointsError):
        odometry([[1.0]], 0.0)
    for wrong in (math.nan, 1e13, "now"):
        with pytest.raises(StampError):
            odometry(standing, wrong)  # type: ignore[arg-type]
    odometry.reset()
    np.testing.assert_array_equal(odometry(standing, 0.0), np.eye(4))


@pytest.mark.parametrize("later_s", [1.5, -50.0])
def test_after_a_pause_the_motion_is_found_anew(later_s: float) -> None:
    """The place goes on as before a pause; the clock may also step back, as where a recording begins again."""
    pytest.importorskip("kiss_icp", reason="the extra slam is not installed")
    odometry, walls = Odometry(), posts()
    scans = [walls - [0.4 * k, 0.0, 0.0, 0.0] for k in range(12)]
    poses = [odometry(scans[k], 100.0 + 0.1 * k) for k in range(8)]
    assert odometry.T_world_sensor[0, 3] == pytest.approx(2.8, abs=0.1)
    with pytest.warns(UserWarning, match=f"{later_s:.1f} s from one scan to the next"):
        assert odometry(scans[7], 100.7 + later_s) is None
    way_m = 4.0 * later_s if later_s > 0.0 else 0.0
    np.testing.assert_allclose(odometry.T_world_sensor[:3, 3], poses[7][:3, 3] + [way_m, 0.0, 0.0], atol=0.1)
    again = [odometry(scans[7 + k], 100.7 + later_s + 0.1 * k) for k in range(1, 5)]
    for before, after in pairwise([odometry.T_world_sensor, *again][1:]):
        np.testing.assert_allclose((np.linalg.inv(before) @ after)[:3, 3], [0.4, 0.0, 0.0], atol=0.05)


def posts() -> NDArray[np.float64]:
    """Thirty posts, three meters high, around the sensor."""
    x, y = np.random.default_rng(0).uniform(-20.0, 20.0, (2, 30))
    z = np.arange(-1.5, 1.5, 0.1)
    return np.column_stack([*(np.repeat(a, len(z)) for a in (x, y)), np.tile(z, 30), np.ones(30 * len(z))])


@given(st.integers(-10, 10), st.integers(-10, 10), st.booleans())
def test_the_first_shift_is_that_of_what_stands(x: int, y: int, is_hanging: bool) -> None:
    """The road does not count, whose lines move with the sensor, nor which way is up."""
    road = np.column_stack([np.random.default_rng(1).uniform(-20.0, 20.0, (5000, 2)), np.full(5000, -1.7)])
    before = np.vstack([posts()[:, :3], road])
    now = np.vstack([posts()[:, :3] - [0.5 * x, 0.5 * y, 0.0], road])
    up = np.array([1.0, 1.0, -1.0 if is_hanging else 1.0])
    np.testing.assert_array_equal(first_shift(before * up, now * up), [0.5 * x, 0.5 * y])
    for nothing in (now[:0], np.full((5, 3), 1e9)):
        np.testing.assert_array_equal(first_shift(before, nothing), [0.0, 0.0])
        np.testing.assert_array_equal(first_shift(nothing, now), [0.0, 0.0])


@given(st.floats(-3.0, 3.0), st.floats(-2.0, 2.0), st.floats(0.0, 20.0))
@example(0.0, 0.5, 2.0)
def test_a_share_of_a_motion_is_that_of_its_turn_and_way(x: float, turn: float, share: float) -> None:
    def motion(x: float, turn: float) -> NDArray[np.float64]:
        cos, sin = math.cos(turn), math.sin(turn)
        return np.array([[cos, -sin, 0, x], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)

    np.testing.assert_allclose(part_of(motion(x, turn), share), motion(share * x, share * turn), atol=1e-9)


def test_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", None)
    with pytest.raises(MissingExtraError, match=r"edgeperc\[slam\]"):
        Odometry()
