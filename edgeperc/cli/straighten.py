"""Scans of ``edgeperc run --deskew``: their points moved to where a standing sensor would have seen them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..motion import Motion, Trajectory, deskew
from ..readers.captures import read_timed_scans

if TYPE_CHECKING:
    from ..readers.times import TimedScan
    from ..tracking.tracks import Tracks

__all__ = ["Straightener"]


class Straightener:
    """Reads scans and straightens them, by poses or by what the tracker found of the scans before.

    Parameters
    ----------
    poses : Path, optional
        A file for `edgeperc.motion.Trajectory.from_tum`; by default the motion is that between the last two scans
        that were tracked.

    Raises
    ------
    TrackingError
        The file cannot be read.
    """

    def __init__(self, poses: Path | None) -> None:
        self._trajectory = None if poses is None else Trajectory.from_tum(poses)
        self._tracked: list[Tracks] = []

    def scans(self, path: Path, *, topic: str | None = None) -> Iterator[tuple[float | None, NDArray[np.float32]]]:
        """As `edgeperc.read_scans`, in the sensor's frame at the scan's stamp.

        Raises
        ------
        PointsError
            A scan has no times of points.
        TrackingError
            The poses do not cover a scan.

        Warns
        -----
        UserWarning
            Without poses: the tracker does not know the motion during the first two scans, which stay as they are.
        """
        for scan in read_timed_scans(path, topic=topic):
            yield scan.stamp_s, self._straight(path, scan)

    def follow(self, tracks: Tracks) -> None:
        """Take the tracks of the last scan, for the motion during the next one."""
        self._tracked = [*self._tracked[-1:], tracks]

    def _straight(self, path: Path, scan: TimedScan) -> NDArray[np.float32]:
        if scan.times_s is None:
            raise PointsError(
                f"{path}: the scan has no times of points; leave out --deskew, or record them: a field t, time or "
                "timestamp"
            )
        known = scan.times_s[np.isfinite(scan.times_s)]
        if not len(known):
            return scan.points
        first_s, last_s = float(known.min()), float(known.max())
        if self._trajectory is not None:
            motion = self._trajectory.motion(first_s, last_s)
        elif len(self._tracked) == 2:
            before, last = self._tracked
            motion = Motion.between(before.T_world_sensor, before.stamp_s, last.T_world_sensor, last.stamp_s)
        else:
            if not self._tracked:
                warnings.warn(
                    "--deskew: the first two scans stay as they are, for the tracker has no motion yet; --poses "
                    "straightens them too",
                    stacklevel=2,
                )
            return scan.points
        at_s = scan.stamp_s if scan.stamp_s is not None and first_s <= scan.stamp_s <= last_s else last_s
        return deskew(scan.points, scan.times_s, motion, at_s=at_s)
