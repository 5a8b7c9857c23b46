"""Poses of a sensor from its scans alone."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike

from ..errors import StampError
from ..system.clock import LATEST_S, Clock, as_seconds, elapsed_s
from ..system.extras import require
from ..types.frame import pose_between, quaternion
from ..types.points import Floats, as_points

# A scan that comes later after the last one begins anew: at 3 m/s2, the way is 1.5 m off then, and where the
# registration starts 2 m off, it may follow the wrong posts.
LONGEST_STEP_S = 1.0
SETTLING = 3  # scans


class Odometry:
    """Poses of the sensor, scan by scan, by KISS-ICP (Vizzo et al., 2023), in one thread; needs the extra ``slam``.

    It takes the sensor to stand before its first scan, and misses the first steps of one that moves. So it is silent
    for three scans, also where more than 1 s is missing between two scans, or the clock jumps. Scans that are missing
    for less cost nothing: the motion goes on in between.

    Attributes
    ----------
    T_world_sensor : (4, 4) float64
        The last pose, also while the motion is not known. The world is the frame of the first scan.

    Raises
    ------
    MissingExtraError
        KISS-ICP is not installed.
    """

    def __init__(self) -> None:
        self._made = require("kiss_icp.kiss_icp", "slam", "Odometry", package="kiss-icp").KissICP
        self._settings = require("kiss_icp.config", "slam", "Odometry", package="kiss-icp").load_config(None)
        self._settings.data.deskew = False
        self._settings.registration.max_num_threads = 1
        self.reset()

    def reset(self) -> None:
        """Begin anew, with the next scan at the origin."""
        self._clock, self._step_s = Clock(gap_s=LONGEST_STEP_S), 0.0
        self._begin(np.eye(4))

    def _begin(self, T_world_sensor: Floats) -> None:
        self.T_world_sensor, self._n_scans = T_world_sensor, 0
        self._odometry = self._made(self._settings)
        self._odometry.last_pose = T_world_sensor

    def __call__(self, points: ArrayLike, stamp_s: float) -> Floats | None:
        """The pose of the next scan in the frame of the first one, (4, 4) float64; None while it is not known.

        Parameters
        ----------
        points : (n, 4) or (n, 3) array_like
            x, y, z [m] in the frame of the sensor. Rows that are not finite do not count; a scan without others leaves
            the sensor where it was.
        stamp_s : float
            Its time [s]. A scan that is late or comes twice has the pose of the last one.

        Raises
        ------
        PointsError
            ``points`` is not a scan.
        StampError
            ``stamp_s`` is no finite number, or beyond 1e12 s.

        Warns
        -----
        UserWarning
            More than 1 s is missing between two scans, or the clock jumped.
        """
        scan, stamp_s = as_points(points)[:, :3], as_seconds(stamp_s)
        if not abs(stamp_s) <= LATEST_S:
            raise StampError(f"got a scan at {stamp_s} s; expected a finite time in seconds, up to {LATEST_S:g}")
        scan = scan[np.isfinite(scan).all(axis=1)]
        if len(scan):
            last_s, (step, self._clock) = self._clock.last_s, self._clock.after(stamp_s)
            if step != "late":
                if last_s is not None:
                    self._go_on(last_s, stamp_s, step == "next")
                self._n_scans += 1
                self._odometry.register_frame(scan.astype(np.float64), np.zeros(0))
                self.T_world_sensor = np.array(self._odometry.last_pose, np.float64)
        return self.T_world_sensor.copy() if self._n_scans > SETTLING else None

    def _go_on(self, last_s: float, stamp_s: float, is_next: bool) -> None:
        """Expect the next scan where the last motion leads until its time."""
        step_s, before_s = elapsed_s(last_s, stamp_s), self._step_s
        self._step_s = step_s
        expected = part_of(self._odometry.last_delta, step_s / before_s) if before_s else np.eye(4)
        if is_next:
            self._odometry.last_delta = expected
            return
        warnings.warn(
            f"{stamp_s - last_s:.1f} s from one scan to the next: how the sensor moved is not known, and is found anew "
            f"from {SETTLING + 1} scans that follow within {LONGEST_STEP_S:g} s each",
            stacklevel=3,
        )
        self._begin(self.T_world_sensor @ expected)


def part_of(motion: Floats, share: float) -> Floats:
    """The rigid motion (4, 4) over a share of its time, which may be more than all of it."""
    begin = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    return pose_between(begin, (motion[:3, 3], np.array(quaternion(motion[:3, :3]))), share)
