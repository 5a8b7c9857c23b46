"""Poses from the scans alone."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from edgeperc import MissingExtraError, Odometry, PointsError, StampError
from edgeperc.readers.scan_odometry import part_of
from edgeperc.simulation import random_scene, simulate_sequence


def test_a_drive_is_followed() -> None:
    """Also where scans are missing: of 6 to 9, the first and the last one are."""
    pytest.importorskip("kiss_icp", reason="the extra slam is not installed")
    true, found, odometry = [], [], Odometry()
    for k, (stamp_s, pose, scan) in enumerate(simulate_sequence(random_scene(3, "urban"), "os1-64", 13, 10.0, 8.0)):
        if k in (6, 7, 9):
            continue
        # Drawn ground is so smooth that its scan lines hold the estimate back.
        standing = np.where((scan.surfaces >= 0)[:, None], scan.points, np.float32(np.nan))
        true.append(pose)
        found.append(odometry(standing, stamp_s))
        assert (found[-1] is None) == (k < 3)
    steps = [np.linalg.inv(poses[4]) @ poses[-1] for poses in (true, found)]
    np.testing.assert_allclose(steps[1][:3, 3], steps[0][:3, 3], atol=0.15)
    np.testing.assert_array_equal(odometry(np.zeros((0, 4)), stamp_s + 0.1), found[-1])
    np.testing.assert_array_equal(odometry(standing + np.float32(1.0), stamp_s), found[-1])  # late
    with pytest.raises(PointsError):
        odometry([[1.0]], 0.0)
    for wrong in (math.nan, 1e13, "now"):
        with pytest.raises(StampError):
            odometry(standing, wrong)  # type: ignore[arg-type]
    odometry.reset()
    assert odometry(standing, stamp_s) is None
    np.testing.assert_array_equal(odometry.T_world_sensor, np.eye(4))


@pytest.mark.parametrize("later_s", [1.5, -50.0])
def test_after_a_pause_the_motion_is_found_anew(later_s: float) -> None:
    """The place goes on as before a pause; the clock may also step back, as where a recording begins again."""
    pytest.importorskip("kiss_icp", reason="the extra slam is not installed")
    odometry = Odometry()
    walls = np.random.default_rng(0).uniform([-20, -20, -1, 0], [20, 20, 3, 1], (3000, 4))
    scans = [walls - [0.4 * k, 0.0, 0.0, 0.0] for k in range(12)]
    for k in range(8):
        pose = odometry(scans[k], 100.0 + 0.1 * k)
    assert pose is not None
    with pytest.warns(UserWarning, match=f"{later_s:.1f} s from one scan to the next"):
        assert odometry(scans[7], 100.7 + later_s) is None
    way_m = 4.0 * later_s if later_s > 0.0 else 0.0
    np.testing.assert_allclose(odometry.T_world_sensor[:3, 3], pose[:3, 3] + [way_m, 0.0, 0.0], atol=0.1)
    again = [odometry(scans[7 + k], 100.7 + later_s + 0.1 * k) for k in range(1, 5)]
    assert [pose is None for pose in again] == [True, True, False, False]
    assert again[3] is not None
    assert again[2] is not None
    np.testing.assert_allclose((np.linalg.inv(again[2]) @ again[3])[:3, 3], [0.4, 0.0, 0.0], atol=0.05)


@given(st.floats(-3.0, 3.0), st.floats(-0.5, 0.5), st.floats(0.0, 2.0))
def test_a_share_of_a_motion_is_that_of_its_turn_and_way(x: float, turn: float, share: float) -> None:
    def motion(x: float, turn: float) -> NDArray[np.float64]:
        cos, sin = math.cos(turn), math.sin(turn)
        return np.array([[cos, -sin, 0, x], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)

    np.testing.assert_allclose(part_of(motion(x, turn), share), motion(share * x, share * turn), atol=0.01)


def test_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", None)
    with pytest.raises(MissingExtraError, match=r"edgeperc\[slam\]"):
        Odometry()
