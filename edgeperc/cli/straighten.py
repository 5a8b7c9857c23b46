"""Scans of ``edgeperc run``: their poses by ``--poses``, and with ``--deskew`` their points moved to where a standing
sensor would have seen them.
"""

from __future__ import annotations

import warnings

import numpy as np

from ..errors import PointsError
from ..preprocess.motion import Motion, Trajectory, deskew
from ..preprocess.returns import returns
from ..readers.times import middle_after
from ..tracking.tracks import Tracks
from ..types.points import Floats, Floats32
from ..types.sensor import SensorProfile


class Straightener:
    """Straightens scans, if it ``deskews``, by the poses of the sensor or the motion between tracked scans; places them
    otherwise. Raises TrackingError.
    """

    def __init__(self, trajectory: Trajectory | None, *, deskews: bool) -> None:
        self._trajectory, self._deskews = trajectory, deskews
        self._begin: Floats | None = None  # pose of the first scan
        self.pose: Floats | None = None  # that of the last scan, seen from the first one; None without a trajectory
        self._middle_s = -np.inf  # of the times of the last scan
        self._tracked: list[Tracks] = []

    def straighten(
        self,
        stamp_s: float | None,
        points: Floats32,
        times_s: Floats | None = None,
        *,
        sensor: SensorProfile | None = None,
    ) -> Floats32:
        """Points in the sensor's frame at the scan's stamp, or at its last point if the stamp is on another clock; what
        the sensor drops stays where it is: the own vehicle moves with it. Without poses, the first two scans stay.
        """
        if not self._deskews:
            self.place(stamp_s)
            return points
        if times_s is None:
            raise PointsError(
                "the scan has no times of points: no field t, time or timestamp, or its values do not span the 2 ms to "
                "2 s of a scan in any unit; leave out --deskew, or record them"
            )
        known = times_s[np.isfinite(times_s)]
        if not len(known):
            if stamp_s is not None:
                self.place(stamp_s)
            return points
        first_s, last_s = float(known.min()), float(known.max())
        if self._trajectory is not None:
            self._middle_s = middle_after(self._middle_s, stamp_s, first_s, last_s)
            motion = self._trajectory.motion(first_s, last_s)
        elif len(self._tracked) == 2:
            before, last = self._tracked
            motion = Motion.between(before.T_world_sensor, before.stamp_s, last.T_world_sensor, last.stamp_s)
        else:
            if not self._tracked:
                warnings.warn(
                    "--deskew: the first two scans stay as they are, also after a jump of the clock, for the tracker "
                    "has no motion yet; --poses straightens them too",
                    stacklevel=2,
                )
            return points
        # A driver rounds stamps, and drops beams: one just beside the times is still on their clock.
        beside_s = last_s - first_s
        is_near = stamp_s is not None and first_s - beside_s <= stamp_s <= last_s + beside_s
        at_s = stamp_s if is_near else last_s
        self.place(at_s)
        scan = points if sensor is None else returns(points, sensor)[0]
        straight = deskew(scan, times_s, motion, at_s=at_s)
        dropped = np.isnan(scan[:, 0])
        straight[dropped] = points[dropped]
        return straight

    def place(self, at_s: float | None) -> None:
        """Find the pose of a scan that stays as it is. PointsError without a time and with poses."""
        if self._trajectory is not None:
            if at_s is None:
                raise PointsError("the scan has no time, by which its pose is found; pass --times FILE")
            pose = self._trajectory.pose(at_s)
            self._begin = pose if self._begin is None else self._begin
            self.pose = np.linalg.inv(self._begin) @ pose

    def follow(self, tracks: Tracks) -> None:
        """Take the tracks of the last scan, for the motion during the next one. Motion needs two of one session."""
        if tracks.is_late:
            return
        self._tracked = [*(before for before in self._tracked[-1:] if before.session == tracks.session), tracks]
