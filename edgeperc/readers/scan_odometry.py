"""Poses of a sensor from its scans alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..system.extras import require
from ..types.points import Floats, as_points


class Odometry:
    """Poses of the sensor, scan by scan, by KISS-ICP (Vizzo et al., 2023), in one thread; needs the extra ``slam``.

    Attributes
    ----------
    is_settled : bool
        Whether the motion between the poses is known. It takes the sensor to stand before its first scan, and misses
        the first steps of one that moves: False until the fourth scan.

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
        self._odometry, self._n_scans = self._made(self._settings), 0

    @property
    def is_settled(self) -> bool:
        """See the class."""
        return self._n_scans > 3

    def __call__(self, points: ArrayLike) -> Floats:
        """The pose of the next scan in the frame of the first one, (4, 4) float64.

        Parameters
        ----------
        points : (n, 4) or (n, 3) array_like
            x, y, z [m] in the frame of the sensor. Rows that are not finite do not count; a scan without others leaves
            the sensor where it was.

        Raises
        ------
        PointsError
            ``points`` is not a scan.
        """
        scan = as_points(points)[:, :3]
        scan = scan[np.isfinite(scan).all(axis=1)]
        self._n_scans += 1
        if len(scan):
            self._odometry.register_frame(scan.astype(np.float64), np.zeros(0))
        return np.array(self._odometry.last_pose, np.float64)
