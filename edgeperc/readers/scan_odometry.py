"""Poses of a sensor from its scans alone."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike

from ..errors import StampError
from ..system.clock import LATEST_S, Clock, as_seconds, elapsed_s
from ..system.extras import require
from ..types.frame import pose_between, quaternion
from ..types.points import Floats, Ints64, as_points

# A scan that comes later after the last one begins anew: at 3 m/s2, the way is 1.5 m off then, and where the
# registration starts 2 m off, it may follow the wrong posts.
LONGEST_STEP_S = 1.0
# The first step is looked for among shifts of so many cells to each side, of what stands: columns of a meter that are
# so high. Lines of scan on the road move with the sensor and hold KISS-ICP back: without a hint it misses up to 2.7 m
# of a first step of 1.3 or 2.6 m (KITTI's drive 0001, thinned to 16 and 32 beams), with it at most 0.3 m.
CELL_M, REACH, STANDING_M = 0.5, 10, 0.6
SPACE = np.array([256, 256, 64])  # cells around the sensor
THRESHOLD_M = 0.5  # KISS-ICP's, for the step that was looked for, in place of 2 m


class Odometry:
    """Poses of the sensor, scan by scan, by KISS-ICP (Vizzo et al., 2023), in one thread; needs the extra ``slam``.

    The sensor may move when its first scan comes, and scans may be missing. Where more than 1 s is missing, or the
    clock jumps, it begins anew, with a scan whose pose is not known.

    Attributes
    ----------
    T_world_sensor : (4, 4) float64
        The last pose, also where it is not known: then as the motion before would have gone on. The world is the frame
        of the first scan.

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
        threshold = require("kiss_icp.threshold", "slam", "Odometry", package="kiss-icp").FixedThreshold
        self._first_threshold = threshold(THRESHOLD_M)
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
        finite: Floats = scan[np.isfinite(scan).all(axis=1)].astype(np.float64)
        last_s, is_known = self._clock.last_s, True
        step, clock = self._clock.after(stamp_s)
        if step != "late" and len(finite):
            if last_s is not None:
                is_known = self._expect(finite, last_s, stamp_s, step == "next")
            usual, self._n_scans = self._odometry.adaptive_threshold, self._n_scans + 1
            if self._n_scans == 2:
                self._odometry.adaptive_threshold = self._first_threshold
            self._odometry.register_frame(finite, np.zeros(0))
            self._odometry.adaptive_threshold = usual
            self.T_world_sensor = np.array(self._odometry.last_pose, np.float64)
        self._clock = clock if len(finite) else self._clock
        return self.T_world_sensor.copy() if is_known else None

    def _expect(self, scan: Floats, last_s: float, stamp_s: float, is_next: bool) -> bool:
        """Expect the next scan where the last motion leads until its time; whether it is known."""
        step_s, before_s = elapsed_s(last_s, stamp_s), self._step_s
        motion = part_of(self._odometry.last_delta, step_s / before_s) if before_s else np.eye(4)
        self._step_s = step_s
        if is_next:
            if self._n_scans == 1:
                to_sensor = np.linalg.inv(self.T_world_sensor)
                before = self._odometry.local_map.point_cloud() @ to_sensor[:3, :3].T + to_sensor[:3, 3]
                motion[:2, 3] = first_shift(before, self._odometry.voxelize(scan)[1])
            self._odometry.last_delta = motion
            return True
        warnings.warn(
            f"{stamp_s - last_s:.1f} s from one scan to the next: how the sensor moved is not known; expected at most "
            f"{LONGEST_STEP_S:g} s",
            stacklevel=3,
        )
        self._begin(self.T_world_sensor @ motion)
        return False


def first_shift(before: Floats, now: Floats) -> Floats:
    """The shift along x and y (2,) [m] after which most of what stands is where something stood: points (n, 3) of two
    scans, as each was seen.
    """
    there = np.zeros(SPACE, np.bool_)
    there[tuple(_cells(before).T)] = True
    steps = np.arange(-REACH, REACH + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    moved = _cells(now) @ [SPACE[1] * SPACE[2], SPACE[2], 1]
    hits = there.ravel()[moved[:, None] + (x * SPACE[1] + y) * SPACE[2]].sum(axis=0)
    best = np.argmax(hits - 1e-3 * np.hypot(x, y))  # of equal ones the shortest
    return CELL_M * np.array([x[best], y[best]], np.float64)


def _cells(points: Floats) -> Ints64:
    """Cells (n, 3) of the points that stand, so far from the edge that they stay inside."""
    columns = np.unique(np.floor(points[:, :2]).astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)
    low, high = np.full(len(points), np.inf), np.full(len(points), -np.inf)
    np.minimum.at(low, columns, points[:, 2])
    np.maximum.at(high, columns, points[:, 2])
    cells = np.floor(points / CELL_M).astype(np.int64) + SPACE // 2
    edge = np.array([REACH, REACH, 0])
    stands = (high - low)[columns] > STANDING_M
    return cells[stands & ((cells >= edge) & (cells < SPACE - edge)).all(axis=1)]


def part_of(motion: Floats, share: float) -> Floats:
    """The rigid motion (4, 4) over a share of its time, which may be more than all of it."""
    begin = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    return pose_between(begin, (motion[:3, 3], np.array(quaternion(motion[:3, :3]))), share)
