"""The last scans of a sensor as seen from its newest one: more points on what stands still.

Detectors of nuScenes' scans perceive ten sweeps at once (Caesar et al., 2020). What moves would be smeared by it, so it
is left out of the earlier scans: people, tracks that move, and places through which beams of the newest scan pass.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..errors import OptionError, StampError, TrackingError
from ..system.clock import as_seconds
from ..system.fields import OPTIONS
from ..system.kernels import njit
from ..types.frame import fill_moved
from ..types.perception import Box, Perception, scan_of
from ..types.points import Floats, Floats32, Mask, Points, as_points, read_only
from ..types.rigid import rigid
from ..types.sensor import SensorProfile
from .moving import PEOPLE, inside_boxes, movable_points
from .tracks import Track, Tracks

MAX_SWEEPS = 20
MAX_AGE_S = 3.0  # older scans are left out, as those before a pause or of another drive
MARGIN_M = 0.3  # around people and what may move
STANDING_MPS = 0.7
NO_TRACK = -1
COLUMN_RAD = math.radians(0.4)  # directions in which a beam tells what is there: two steps of most spinning sensors
# How far behind a point a beam ends that passed it. The gap between beams is at least so large where there are many.
BEYOND_M, LEAST_GAP_RAD = 0.6, math.radians(0.4)


class _Sweep(NamedTuple):
    """A scan without people in the frame of the sensor at that time, and what may have moved in it, with its track."""

    points: Points
    tracks: Tracks
    boxes: list[tuple[Box, int]]


class Sweeps:
    """The scans before the newest one, for `Perceiver`: sparse sensors then see more of what stands still.

    Call `earlier` with each scan before it is perceived, and `add` after it was tracked::

        perceive, tracker, sweeps = Perceiver(sensor="vlp-16"), Tracker(), Sweeps(5)
        for stamp_s, points, pose in drive:
            earlier = sweeps.earlier(points, stamp_s, pose)
            perception = perceive(points, stamp_s, earlier=earlier)
            tracks = tracker(perception, pose)
            sweeps.add(points, perception, tracks)

    Parameters
    ----------
    n : int
        Scans that count, with the newest one, 2 to 20. Those more than 3 s older than the newest one never count.

    Raises
    ------
    OptionError
        ``n`` is not a whole number from 2 to 20.
    """

    def __init__(self, n: int = 5) -> None:
        self._sweeps = deque[_Sweep](maxlen=OPTIONS.whole("n", n, 2, MAX_SWEEPS) - 1)
        self._gap_rad, self._eye = LEAST_GAP_RAD, np.zeros(2)
        nothing = read_only(np.empty((0, 4), np.float32))
        self._still_there(nothing, nothing)  # compile here, not in the first call

    def reset(self) -> None:
        """Forget all scans, for another drive."""
        self._sweeps.clear()

    def earlier(self, points: ArrayLike, stamp_s: float, T_world_sensor: ArrayLike) -> Floats32:
        """The points of earlier scans where the newest scan would have them, for ``Perceiver(..., earlier=...)``.

        Parameters
        ----------
        points : (n, 4) or (n, 3) array_like
            The newest scan: x, y, z [m] in the frame of the sensor.
        stamp_s : float
            Its time [s], on the clock of the tracked scans.
        T_world_sensor : (4, 4) array_like
            Its rigid pose, in the world of the poses with which the earlier scans were tracked. It has to be right to a
            few centimeters a scan, as those of an odometry are; a tracker's own estimate is not (see the how-to on
            sensors).

        Returns
        -------
        (m, 4) float32
            Without people and what moves; read-only. Empty without earlier scans.

        Raises
        ------
        PointsError, StampError, TrackingError
            The scan, its time or its pose is malformed.
        """
        scan, stamp_s = as_points(points), as_seconds(stamp_s)
        if not math.isfinite(stamp_s):
            raise StampError(f"got a scan at {stamp_s} s; expected a finite time in seconds")
        T_sensor_world = np.linalg.inv(rigid("T_world_sensor", T_world_sensor, TrackingError))
        found = [np.empty((0, 4), np.float32)]
        last = self._sweeps[-1].tracks if self._sweeps else ()
        standing = {track.id for track in last if _stands(track)}
        for sweep in self._sweeps:
            if not 0.0 < stamp_s - sweep.tracks.stamp_s <= MAX_AGE_S:
                continue
            boxes = [box for box, track in sweep.boxes if track not in standing]
            then = sweep.points[~inside_boxes(boxes, sweep.points, MARGIN_M)]
            T = T_sensor_world @ sweep.tracks.T_world_sensor
            seen = np.empty(then.shape, np.float32)
            fill_moved(read_only(then), T[:3, :3].copy(), T[:3, 3].copy(), seen)
            found.append(seen[self._still_there(scan, seen)])
        return read_only(np.concatenate(found))

    def add(self, points: ArrayLike, perception: Perception, tracks: Tracks) -> None:
        """Remember a scan that was perceived and tracked.

        Parameters
        ----------
        points : (n, 4) or (n, 3) array_like
            The scan, as it was perceived.
        perception : Perception
        tracks : Tracks
            Of a tracker that got the scan's pose. After a jump of the clock, all earlier scans are forgotten.

        Raises
        ------
        OptionError
            ``tracks`` is not the answer of a tracker.
        PointsError
            ``points`` is not the scan of the perception.
        """
        scan = scan_of(perception, points)
        if not isinstance(tracks, Tracks):
            raise OptionError(f"tracks is a {type(tracks).__name__}; expected what a Tracker returned for this scan")
        if tracks.is_late or perception.health.has_drops:  # rain and snow are elsewhere in the next scan
            return
        if self._sweeps and self._sweeps[-1].tracks.session != tracks.session:
            self._sweeps.clear()
        left_out = movable_points(perception, scan, classes=PEOPLE, margin_m=MARGIN_M)
        found = [(track.box, track.id) for track in tracks]
        found += [(box, NO_TRACK) for k, box in enumerate(perception.boxes) if k not in tracks.sources]
        if perception.sensor is not None:
            left_out |= _not_of_the_world(scan, perception.sensor, self._eye)
            self._eye = np.array(perception.mounting.origin_m)
            self._gap_rad = max(LEAST_GAP_RAD, math.radians(perception.sensor.median_gap_deg))
        self._sweeps.append(_Sweep(read_only(scan[~left_out & np.isfinite(scan[:, 0])]), tracks, found))

    def _still_there(self, scan: Points, earlier: Points) -> Mask:
        """Which earlier points (n, 4) no beam of a scan contradicts, (n,)."""
        is_there = np.empty(len(earlier), np.bool_)
        step = np.array([COLUMN_RAD, 0.5 * self._gap_rad])
        mark_still_there(read_only(scan), read_only(earlier), self._eye, step, BEYOND_M, is_there)
        return is_there


def _not_of_the_world(scan: Points, sensor: SensorProfile, eye: Floats) -> Mask:
    """Mark what is too near to a sensor, or of the vehicle that carries it: it goes along."""
    about = scan[:, :3].astype(np.float64) - [*eye, 0.0]
    found = np.linalg.norm(about, axis=1) <= sensor.min_range_m
    if sensor.ego_box is not None:
        lows, highs = np.array(sensor.ego_box).T
        found |= ((lows <= about) & (about <= highs)).all(axis=1)
    return np.asarray(found)


def _stands(track: Track) -> bool:
    """Whether a track surely stands: people hardly ever do, and a new track has no certain speed."""
    sigma_mps = math.sqrt(max(float(track.covariance[2, 2]), 0.0))
    return track.label not in PEOPLE and max(abs(float(track.state[2])), sigma_mps) < STANDING_MPS


@njit(cache=True, nogil=True)
def mark_still_there(scan: Points, earlier: Points, eye: Floats, step: Floats, beyond_m: float, is_there: Mask) -> None:
    """Mark the earlier points but those in free space: in all directions within a column that tell, the next beam of
    the scan above them and the next one below, at most two rows away, end more than ``beyond_m`` farther away.

    eye : x, y of the sensor [m]
    step : width of a column, and half of the gap between beams, the height of a row [rad]
    """
    n_columns, n_rows = int(2.0 * math.pi / step[0]), int(math.pi / step[1]) + 1
    nearest = np.full((n_columns, n_rows), np.inf)
    for i in range(scan.shape[0]):
        range_m, column, row = place_of(scan[i], eye, n_columns, step[1])
        if range_m > 0.0:
            nearest[column, row] = min(nearest[column, row], range_m)
    for i in range(earlier.shape[0]):
        range_m, column, row = place_of(earlier[i], eye, n_columns, step[1])
        n_open, is_passed = 0, range_m > 0.0
        for k in range(-1, 2):
            n_sides = 0
            for side in (-1, 1):
                for away in range(3):
                    j = row + side * away
                    if 0 <= j < n_rows and nearest[(column + k) % n_columns, j] < np.inf:
                        n_sides += 1
                        is_passed &= nearest[(column + k) % n_columns, j] > range_m + beyond_m
                        break
            n_open += n_sides == 2
        is_there[i] = not (is_passed and n_open > 0)


@njit(cache=True, nogil=True)
def place_of(point: Floats32, eye: Floats, n_columns: int, row_rad: float) -> tuple[float, int, int]:
    """Distance from the sensor's axis [m], column and row of a point; a distance of 0 for one that is not finite."""
    x, y, z = point[0] - eye[0], point[1] - eye[1], np.float64(point[2])
    range_m = math.sqrt(x * x + y * y)
    if not (range_m < np.inf and abs(z) < np.inf):
        return 0.0, 0, 0
    column = int((math.atan2(y, x) + math.pi) / (2.0 * math.pi) * n_columns) % n_columns
    return range_m, column, int((math.atan2(z, range_m) + 0.5 * math.pi) / row_rad)
