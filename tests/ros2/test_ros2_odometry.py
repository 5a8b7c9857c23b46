"""Poses of an odometry, by time: between two, at the ends, and what is no pose."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rosbags")

from ros2_helpers import MESSAGES, odometry

from edgeperc import Mounting, OptionError
from edgeperc.ros2.odometry import Poses, Rolling


@given(st.floats(-3.0, 3.0), st.floats(-2.9, 2.9), st.floats(0.0, 1.0), st.booleans())
def test_a_pose_between_two(yaw: float, turn: float, share: float, flipped: bool) -> None:
    poses, step_ns = Poses(MESSAGES), 10**8
    poses.receive(odometry(10**18, 1.0, 2.0, yaw))
    half = (yaw + turn) / 2.0
    sign = -1.0 if flipped else 1.0
    turned = {"z": sign * math.sin(half), "w": sign * math.cos(half)}  # both are the same rotation
    poses.receive(odometry(10**18 + step_ns, 3.0, 1.0, 0.0, **turned))
    pose = poses.at(10**18 + round(share * step_ns))
    np.testing.assert_allclose(pose[:3, 3], [1.0 + 2.0 * share, 2.0 - share, 0.0], atol=1e-6)
    ahead = math.atan2(pose[1, 0], pose[0, 0])
    assert abs(math.remainder(ahead - yaw - share * turn, math.tau)) < 1e-6
    assert (poses.frame_id, poses.child_frame_id) == ("odom", "base_link")


def test_times_without_a_pose() -> None:
    poses = Poses(MESSAGES)
    assert poses.at(5) is None
    for k in range(3):
        poses.receive(odometry(10**9 + k * 10**8, float(k), 0.0, 0.0))
    assert poses.at(10**9 - 1) is None
    for stamp_ns, x in ((10**9, 0.0), (1_200_000_000, 2.0), (1_400_000_000, 4.0)):  # which goes on as before
        assert poses.at(stamp_ns)[0, 3] == pytest.approx(x)
    assert poses.at(1_400_000_001) is None


@pytest.mark.parametrize("every_s", [0.005, 0.1])
def test_after_the_newest_pose_the_motion_of_the_last_tenth_of_a_second_goes_on(every_s: float) -> None:
    """Not that between the last two poses, which a fast odometry knows to a few millimeters alone."""
    poses, n = Poses(MESSAGES), round(0.4 / every_s)
    for k in range(n + 1):
        jitter_m = 0.002 * (k % 2)
        poses.receive(
            odometry(10**18 + round(k * every_s * 1e9), 10.0 * k * every_s + jitter_m, 0.0, 0.5 * k * every_s)
        )
    pose = poses.at(10**18 + 550_000_000)
    np.testing.assert_allclose(pose[:2, 3], [5.5, 0.0], atol=0.01)
    assert math.atan2(pose[1, 0], pose[0, 0]) == pytest.approx(0.5 * 0.55, abs=1e-3)


def test_a_recording_that_begins_again() -> None:
    poses = Poses(MESSAGES)
    for stamp_s, x in ((5, 50.0), (6, 60.0), (6, 61.0), (1, 10.0), (2, 20.0)):
        poses.receive(odometry(stamp_s * 10**9, x, 0.0, 0.0))
    middle = poses.at(15 * 10**8)
    assert middle[0, 3] == 15.0
    assert poses.at(6 * 10**9) is None


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"garbage",
        odometry(1, math.nan, 0.0, 0.0),
        odometry(1, 0.0, math.inf, 0.0),
        odometry(1, 0.0, 0.0, 0.0, z=0.0, w=0.0),
        odometry(1, 0.0, 0.0, 0.0, w=math.nan),
        odometry(1, 0.0, 0.0, 0.0)[:100],
    ],
)
def test_what_is_no_pose_is_counted(data: bytes) -> None:
    poses = Poses(MESSAGES)
    poses.receive(data)
    assert poses.n_failed == 1
    assert poses.at(1) is None


def test_where_the_sensor_is_without_a_pose_of_its_own() -> None:
    """By the frames' names: that of the cloud itself, or above the vehicle's frame as the perceiver says."""
    mounting = Mounting(2.0, 0.0, 0.0, 90.0)
    np.testing.assert_array_equal(Rolling().base_from_sensor("lidar", "lidar", mounting), np.eye(4))
    above = Rolling().base_from_sensor("base_link", "lidar", mounting)
    np.testing.assert_allclose(above @ [3.0, 0.0, 0.0, 1.0], [0.0, 3.0, 2.0, 1.0], atol=1e-12)
    given = Rolling(sensor_pose=(1, 2, 3, 180, 0, 0)).base_from_sensor("lidar", "lidar", mounting)
    np.testing.assert_allclose(given @ [0.0, 1.0, 1.0, 1.0], [1.0, 1.0, 2.0, 1.0], atol=1e-12)


@pytest.mark.parametrize("wrong", [(1, 2, 3), (0, 0, 0, 0, 0, math.nan), (0, 0, 0, 0, 0, 361.0), ("x",) * 6, 3.0])
def test_no_pose_of_a_sensor(wrong: Any) -> None:
    with pytest.raises(OptionError, match="sensor_pose is"):
        Rolling(sensor_pose=wrong)
    with pytest.raises(OptionError, match="not a name of ROS 2"):
        Rolling(topic="a b")
