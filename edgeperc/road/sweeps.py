"""The last scans of a sensor as seen from its newest one: more points on what stands still.

Detectors of nuScenes' scans perceive ten sweeps at once (Caesar et al., 2020). What moves would be smeared by it, so it
is left out of the earlier scans: people, vehicles that may move, and places through which beams of the newest scan
pass. An odometry of few beams misses how the sensor tilts, so the ground of each scan is laid on that of the newest.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..errors import OptionError, StampError, TrackingError
from ..ground.planes import fit_ground, heights_above
from ..preprocess.returns import returns
from ..system.clock import as_seconds
from ..system.fields import OPTIONS
from ..system.kernels import njit
from ..tracking import Track, Tracks
from ..tracking.moving import PEOPLE, inside_boxes, movable_points
from ..types.frame import OF_MODELS, ModelFrame, moved_points
from ..types.perception import Box, Perception, scan_of
from ..types.points import Floats, Floats32, Mask, Points, as_points, read_only
from ..types.rigid import rigid

MAX_SWEEPS = 20
MAX_AGE_S = 3.0  # older scans are left out, as those before a pause or of another drive
MARGIN_M = 0.3  # around people and what may move
STANDING_MPS = 0.7
NO_TRACK = -1
COLUMN_RAD = math.radians(0.4)  # directions in which a beam tells what is there: two steps of most spinning sensors
# How far behind a point a beam ends that passed it. The gap between beams is at least so large where there are many.
BEYOND_M, LEAST_GAP_RAD = 0.6, math.radians(0.4)
GROUND_STEP = 6  # one point in so many is looked at for the ground
# Ground that counts: so near, and so near to that of the newest scan; at least so many points.
GROUND_REACH_M, GROUND_OFF_M, LEAST_GROUND = 30.0, 0.7, 50
# Largest share of the heights that may remain. With KISS-ICP's poses in two drives of KITTI, ground 15 to 25 m away and
# 0.9 s ago is off by 0.117 and 0.041 m (median) on a VLP-16, 0.029 and 0.016 so; on a Mid-360 by 0.011 and 0.009 m, so
# 0.014 and 0.009, and 0.029 and 0.020 if all of it were taken off.
GAIN = 0.8

NOTHING = read_only(np.empty((0, 4), np.float32))


class _Sweep(NamedTuple):
    """A scan without people in the frame of the sensor at that time, some points of its ground, its tracks, and what
    may have moved in it, with the track.
    """

    points: Points
    ground: Points
    tracks: Tracks
    boxes: list[tuple[Box, int]]


class Sweeps:
    """The scans before the newest one, for `Perceiver`: sparse sensors then see more of what stands still.

    Call `earlier` with each scan before it is perceived, and `add` after it was tracked::

        perceive, tracker, sweeps = Perceiver(sensor="vlp-16"), Tracker(), Sweeps()
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

    def __init__(self, n: int = 10) -> None:
        self._sweeps = deque[_Sweep](maxlen=OPTIONS.whole("n", n, 2, MAX_SWEEPS) - 1)
        self._gap_rad, self._eye, self._frame = LEAST_GAP_RAD, np.zeros(2), OF_MODELS
        self._still_there(NOTHING, NOTHING)  # compile here, not in the first call

    def reset(self) -> None:
        """Forget all scans, for another drive."""
        self._sweeps.clear()

    def earlier(self, points: ArrayLike, stamp_s: float, T_world_sensor: ArrayLike | None) -> Floats32:
        """The points of earlier scans where the newest scan would have them, for ``Perceiver(..., earlier=...)``.

        Parameters
        ----------
        points : (n, 4) or (n, 3) array_like
            The newest scan: x, y, z [m] in the frame of the sensor.
        stamp_s : float
            Its time [s], on the clock of the tracked scans.
        T_world_sensor : (4, 4) array_like or None
            Its rigid pose, in the world of the poses with which the earlier scans were tracked, as an odometry finds it
            (`Odometry`). A tracker's own estimate is not exact enough. Without a pose, all earlier scans are forgotten.

        Returns
        -------
        (m, 4) float32
            Without people and what moves; read-only. Empty without earlier scans.

        Raises
        ------
        PointsError, StampError, TrackingError
            The scan, its time or its pose is malformed.
        """
        if T_world_sensor is None:
            self.reset()
            return NOTHING
        scan, stamp_s = as_points(points), as_seconds(stamp_s)
        if not math.isfinite(stamp_s):
            raise StampError(f"got a scan at {stamp_s} s; expected a finite time in seconds")
        T_sensor_world = np.linalg.inv(rigid("T_world_sensor", T_world_sensor, TrackingError))
        sweeps = [sweep for sweep in self._sweeps if 0.0 < stamp_s - sweep.tracks.stamp_s <= MAX_AGE_S]
        if not sweeps:
            return NOTHING
        standing = {track.id for track in self._sweeps[-1].tracks if _stands(track)}
        moved = []
        motions = [T_sensor_world @ sweep.tracks.T_world_sensor for sweep in sweeps]
        for sweep, T in zip(sweeps, self._on_its_ground(scan, sweeps, motions), strict=True):
            boxes = [box for box, track in sweep.boxes if track not in standing]
            moved.append(_moved(sweep.points[~inside_boxes(boxes, sweep.points, MARGIN_M)], T))
        seen = np.concatenate(moved)
        return read_only(seen[self._still_there(scan, seen)])

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
        self._frame, self._eye = ModelFrame(perception.mounting), np.array(perception.mounting.origin_m)
        some = scan[::GROUND_STEP]
        ground = some[heights_above(perception.ground, self._frame.move(some)).mask]
        if perception.sensor is not None:
            scan = returns(scan, perception.sensor, perception.mounting.origin_m)[0]  # without the own vehicle
            self._gap_rad = max(LEAST_GAP_RAD, math.radians(perception.sensor.median_gap_deg))
        self._sweeps.append(_Sweep(scan[~left_out & np.isfinite(scan[:, 0])], ground, tracks, found))

    def _on_its_ground(self, scan: Points, sweeps: Sequence[_Sweep], motions: Sequence[Floats]) -> list[Floats]:
        """The motions (4, 4) of earlier scans, each turned and raised so that their ground lies on that of a scan."""
        to_model = np.eye(4)
        to_model[:3, :3], to_model[:3, 3] = self._frame.R, self._frame.t
        moved = [_moved(sweep.ground, to_model @ T) for sweep, T in zip(sweeps, motions, strict=True)]
        surface = fit_ground(self._frame.move(scan)).surface()
        heights = heights_above(surface, np.concatenate(moved)).height_m
        ends = np.cumsum([len(points) for points in moved])[:-1]
        return [
            np.linalg.inv(to_model) @ _leveling(points, height) @ to_model @ T
            for points, height, T in zip(moved, np.split(heights, ends), motions, strict=True)
        ]

    def _still_there(self, scan: Points, earlier: Points) -> Mask:
        """Which earlier points (n, 4) no beam of a scan contradicts, (n,)."""
        is_there = np.empty(len(earlier), np.bool_)
        step = np.array([COLUMN_RAD, 0.5 * self._gap_rad])
        mark_still_there(read_only(scan), read_only(earlier), self._eye, step, BEYOND_M, is_there)
        return is_there


class SweepPerceiver:
    """Perceives each scan with those before it, and tracks its boxes.

    Both are made to be called by `edgeperc.stream`::

        perceive = SweepPerceiver(Perceiver(sensor="vlp-16"), Tracker(), Odometry())
        with stream("udp:2368", perceive, perceive.track) as live:
            ...

    Parameters
    ----------
    perceiver : Perceiver
    tracker : Tracker
        Its poses are those of the odometry.
    odometry : callable
        ``odometry(points, stamp_s) -> pose``, (4, 4), of the sensor in a fixed world, or None where it is not known,
        such as an `Odometry`. A scan without a pose is perceived alone, and has no tracks.
    n : int
        As in `Sweeps`.

    Raises
    ------
    OptionError
        ``n`` is not a whole number from 2 to 20.
    """

    def __init__(
        self,
        perceiver: Callable[..., Perception],
        tracker: Callable[..., Tracks],
        odometry: Callable[[ArrayLike, float], ArrayLike | None],
        n: int = 10,
    ) -> None:
        self._perceiver, self._tracker, self._odometry = perceiver, tracker, odometry
        self._sweeps = Sweeps(n)
        self._points: ArrayLike = NOTHING
        self._pose: ArrayLike | None = None
        self._untimed: StampError | None = None

    @property
    def sensor(self) -> Any:
        """That of the perceiver."""
        return getattr(self._perceiver, "sensor", None)

    def __call__(self, points: ArrayLike, stamp_s: float) -> Perception:
        """Perceive the next scan; arguments and errors are those of the `Perceiver`."""
        self._points, self._pose, self._untimed = points, None, None
        try:
            self._pose = self._odometry(points, stamp_s)
        except StampError as exc:
            self._untimed = exc
        return self._perceiver(points, stamp_s=stamp_s, earlier=self._sweeps.earlier(points, stamp_s, self._pose))

    def track(self, perception: Perception) -> Tracks | None:
        """Track the boxes of the scan that was perceived last; None if its pose is not known.

        Raises
        ------
        StampError
            The scan has no usable time.
        """
        if self._untimed is not None:
            raise self._untimed
        if self._pose is None:
            return None
        tracks = self._tracker(perception, self._pose)
        self._sweeps.add(self._points, perception, tracks)
        return tracks


def _moved(points: Points, T: Floats) -> Floats32:
    return moved_points(points, (T[:3, :3].copy(), T[:3, 3].copy()))


def _leveling(ground: Points, height_m: Floats32) -> Floats:
    """The small rotation about x and y and the shift along z (4, 4) that take heights off points of the ground: a plane
    is fitted to them, three times, the last two without what is far from it. None where that gains little: the pose is
    then better than what little ground there is.
    """
    near = np.hypot(ground[:, 0], ground[:, 1]) < GROUND_REACH_M
    near &= np.abs(height_m) < GROUND_OFF_M  # False for NaN
    leveling = np.eye(4)
    if np.count_nonzero(near) < LEAST_GROUND:
        return leveling
    places = np.column_stack([ground[near, :2], np.ones(np.count_nonzero(near))]).astype(np.float64)
    heights, kept = height_m[near].astype(np.float64), np.ones(len(places), np.bool_)
    for _ in range(3):
        of_kept = places[kept]
        a, b, c = np.linalg.lstsq(of_kept.T @ of_kept, of_kept.T @ heights[kept], rcond=None)[0].tolist()
        off_m = np.abs(heights - places @ (a, b, c))
        kept = off_m < max(3.7 * _median(off_m[kept]), 0.03)  # 2.5 standard deviations
    if _median(off_m) > GAIN * _median(np.abs(heights)):
        return leveling
    leveling[:3, :3] = [[1.0, 0.0, a], [0.0, 1.0, b], [-a, -b, 1.0]]
    leveling[:3, :3] /= np.linalg.norm(leveling[:3, :3], axis=0)
    leveling[2, 3] = -c
    return leveling


def _median(values: Floats) -> float:
    """The upper one of the two in the middle; `np.median` takes 0.1 ms, and 45 of them are needed for a scan."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


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
                for away in range(3 if is_passed else 0):  # most points are not passed, by the first beam that tells
                    j = row + side * away
                    if 0 <= j < n_rows and nearest[(column + k) % n_columns, j] < np.inf:
                        n_sides += 1
                        is_passed = nearest[(column + k) % n_columns, j] > range_m + beyond_m
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
