"""Poses from the scans alone."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from edgeperc import MissingExtraError, Odometry, PointsError
from edgeperc.simulation import random_scene, simulate_sequence


def test_a_drive_is_followed() -> None:
    pytest.importorskip("kiss_icp", reason="the extra slam is not installed")
    true, found, odometry = [], [], Odometry()
    for _, pose, scan in simulate_sequence(random_scene(3, "urban"), "os1-64", 12, 10.0, 5.0):
        # Drawn ground is so smooth that its scan lines hold the estimate back.
        standing = np.where((scan.surfaces >= 0)[:, None], scan.points, np.float32(np.nan))
        true.append(pose)
        found.append(odometry(standing))
        assert odometry.is_settled == (len(found) > 3)
    steps = [np.linalg.inv(poses[4]) @ poses[-1] for poses in (true, found)]
    np.testing.assert_allclose(steps[1][:3, 3], steps[0][:3, 3], atol=0.15)
    np.testing.assert_array_equal(odometry(np.zeros((0, 4))), found[-1])
    with pytest.raises(PointsError):
        odometry([[1.0]])
    odometry.reset()
    np.testing.assert_array_equal(odometry(standing), np.eye(4))
    assert not odometry.is_settled


def test_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", None)
    with pytest.raises(MissingExtraError, match=r"edgeperc\[slam\]"):
        Odometry()
