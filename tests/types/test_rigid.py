"""Rigid transforms are accepted as callers compute them, and nothing else is."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from edgeperc import Calibration, CalibrationError, Motion, Mounting, SensorError, Tracker, TrackingError, Trajectory
from edgeperc.preprocess.motion import merge
from edgeperc.types.rigid import rigid

K = np.array([[700.0, 0.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]])
TAKERS: dict[str, tuple[Callable[[Any], object], type[Exception]]] = {
    "tracker": (lambda pose: Tracker().update([], 0.0, pose), TrackingError),
    "motion": (lambda pose: Motion.between(pose, 0.0, pose, 0.1), TrackingError),
    "trajectory": (lambda pose: Trajectory([0.0, 1.0], [np.eye(4), pose]), TrackingError),
    "merge": (lambda pose: merge(2 * [np.ones((1, 3))], [np.eye(4), pose]), SensorError),
    "mounting": (Mounting.from_matrix, SensorError),
    "calibration": (lambda pose: Calibration(K, pose, 640, 480), CalibrationError),
}


def turned(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    pose = np.eye(4)
    for axis, angle in enumerate((roll, pitch, yaw)):
        a, b = [k for k in range(3) if k != axis]
        step = np.eye(4)
        step[[a, a, b, b], [a, b, a, b]] = math.cos(angle), -math.sin(angle), math.sin(angle), math.cos(angle)
        pose = pose @ step
    pose[:3, 3] = roll, pitch, yaw
    return pose


ANGLES = st.tuples(*[st.floats(-1.4, 1.4)] * 3)


@settings(max_examples=30)
@given(first=ANGLES, second=ANGLES, seed=st.integers(0, 99))
def test_what_rounding_leaves_is_rigid(first: tuple[float, ...], second: tuple[float, ...], seed: int) -> None:
    """Products and inverses, in double and in single, and a last row that is 1e-16 off."""
    A, B = turned(*first), turned(*second)
    noise = np.random.default_rng(seed).uniform(-1e-16, 1e-16, (4, 4))
    for pose in (np.linalg.inv(A) @ B, np.linalg.inv(A.astype(np.float32)) @ B.astype(np.float32), A + noise):
        for take, _ in TAKERS.values():
            take(pose)
            take(pose.tolist())


WRONG: dict[str, object] = {
    "mirrored": np.diag([1.0, 1.0, -1.0, 1.0]),
    "scaled": np.diag([1.01, 1.0, 1.0, 1.0]),
    "projective": np.eye(4) + np.outer([0, 0, 0, 1], [1e-3, 0, 0, 0]),
    "without a 1": np.diag([1.0, 1.0, 1.0, 0.0]),
    "huge": np.full((4, 4), 1e200),
    "not a number": np.full((4, 4), np.nan),
    "3 x 3": np.eye(3),
    "empty": np.zeros((0, 4)),
    "text": "pose",
    "nothing": None,
    "endless": [[10**400] * 4] * 4,
}


@pytest.mark.parametrize(
    ("taker", "wrong"),
    [pair for pair in itertools.product(TAKERS, WRONG) if pair != ("tracker", "nothing")],  # it works without poses
)
def test_what_is_not_rigid_is_refused(taker: str, wrong: str) -> None:
    (take, error), pose = TAKERS[taker], WRONG[wrong]
    with pytest.raises(error, match=r"^(T_\w+_\w+|pose \d|the extrinsic matrix|got poses).*expected"):
        take(pose)


def test_the_last_row_becomes_exact() -> None:
    given_pose = np.eye(4)
    given_pose[3] += 1e-9
    assert rigid("pose", given_pose, TrackingError)[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert given_pose[3, 0] == 1e-9  # the caller's array is not changed
    made = Calibration(K + 1e-12, given_pose, 640, 480)
    assert made.T_camera_sensor[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert (made.K[0, 1], made.K[2].tolist()) == (0.0, [0.0, 0.0, 1.0])
