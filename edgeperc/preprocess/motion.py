"""Scans of moving sensors: removal of the distortion by the own motion, and several sensors in one scan."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..errors import EdgepercError, OptionError, PointsError, SensorError, StampError, TrackingError
from ..system.clock import as_seconds
from ..system.fields import OPTIONS, SCANS, Fields
from ..system.kernels import njit
from ..types.frame import fill_moved, poses_of
from ..types.mounting import UNKNOWN_MOUNTING, Mounting
from ..types.points import MAX_ROUNDING_M, Floats, Floats32, Points, as_points, read_only
from ..types.rigid import numbers_of, rigid, times_of
from ..types.sensor import MAX_ACCUMULATE_S
from .returns import blank_too_near

_POSES, _WAY = Fields("the poses", SensorError), Fields("the poses", TrackingError)
MAX_RATE = 1e4  # of m/s and rad/s
MAX_TURN = 3.1  # rad; the axis of half a turn has no sign
MAX_BYTES = 1 << 28  # of a file of poses; a line has about 100
STRAIGHTER, STRAIGHT = 4.0, 0.0005  # how much more one way keeps its direction than another, of 1
IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # x, y, z and the quaternion of a pose
MIN_STEP_M, MIN_WAY_M = 1.0, 5.0  # of a trajectory, until its directions of travel count
FASTEST_MPS = 150.0  # of a trajectory; trains are slower
UPRIGHT, FORWARD, SAME_WAY = 0.7, 0.7, 0.95  # cosines: z is up, x is ahead; the way keeps its direction in the sensor
OUTSIDE_S = 0.2  # the motion at the ends of a trajectory holds for two scans of 10 Hz
LONGEST_GAP_S = 2.0  # between poses of a moving sensor: whoever stands still may write none
LONGEST_S = 60.0  # of a constant motion; a tenth of a second in nanoseconds would be three years of standing still


@dataclass(frozen=True, slots=True)
class Motion:
    """Constant motion of a sensor, in its own frame.

    Attributes
    ----------
    velocity_mps : tuple of 3 float
        Velocity of the sensor over ground along its own x, y, z [m/s].
    rate_radps : tuple of 3 float
        Turn rate about its own x, y, z [rad/s]; the third is positive in a turn to the left.

    Raises
    ------
    OptionError
        Not three numbers each, or one is not finite or over 10,000.
    """

    velocity_mps: tuple[float, float, float]
    rate_radps: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("velocity_mps", "rate_radps"):
            object.__setattr__(self, name, OPTIONS.numbers(name, getattr(self, name), 3, -MAX_RATE, MAX_RATE))

    @classmethod
    def between(cls, T_world_first: ArrayLike, first_s: float, T_world_second: ArrayLike, second_s: float) -> Motion:
        """The constant motion that leads from one pose of the sensor to another.

        Parameters
        ----------
        T_world_first, T_world_second : (4, 4) array_like
            Poses of the sensor, such as `Tracks.T_world_sensor` of two scans.
        first_s, second_s : float
            Their times [s].

        Returns
        -------
        Motion

        Raises
        ------
        TrackingError
            A pose is not rigid, or between the poses is about half a turn or more.
        StampError
            A time is not finite, or the second is not later, or later by more than a minute.
        """
        first = rigid("T_world_first", T_world_first, TrackingError)
        second = rigid("T_world_second", T_world_second, TrackingError)
        first_s, second_s = as_seconds(first_s, "first_s"), as_seconds(second_s, "second_s")
        if not 0.0 < second_s - first_s <= LONGEST_S:
            raise StampError(
                f"got poses at {first_s} s and {second_s} s, {second_s - first_s:g} s apart; expected a second one "
                f"that is later, by up to {LONGEST_S:g} s: are the times in another unit?"
            )
        return cls._of(first, second, second_s - first_s)

    @classmethod
    def _of(cls, first: Floats, second: Floats, duration: float) -> Motion:
        """`between` of rigid poses, however long it takes: whoever stands may write no pose for minutes."""
        R = first[:3, :3].T @ second[:3, :3]
        axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        sine = 0.5 * float(np.linalg.norm(axis))
        angle = math.atan2(sine, 0.5 * (float(np.trace(R)) - 1.0))
        if angle > MAX_TURN:
            raise TrackingError(
                f"the sensor turns by {math.degrees(angle):.0f} degrees between the poses; expected less than 178"
            )
        turn = 0.5 * axis if sine < 1e-9 else axis * (0.5 * angle / sine)
        # The inverse of the matrix that integrates the velocity over the turn.
        cross = np.cross(np.eye(3), turn)
        share = 1.0 / 12.0 if angle < 1e-4 else (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / angle**2
        way = (np.eye(3) - 0.5 * cross + share * cross @ cross) @ first[:3, :3].T @ (second[:3, 3] - first[:3, 3])
        (x, y, z), (roll, pitch, yaw) = (way / duration).tolist(), (turn / duration).tolist()
        return cls((x, y, z), (roll, pitch, yaw))

    def _after(self, seconds: float) -> Floats:
        """The pose (4, 4) that it leads to, seen from the first one."""
        turn = np.array(self.rate_radps) * seconds
        cross, angle = np.cross(np.eye(3), turn), float(np.linalg.norm(turn))
        a, b, c = 1.0, 0.5, 1.0 / 6.0
        if angle > 1e-4:
            a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
            c = (1.0 - a) / angle**2
        pose = np.eye(4)
        pose[:3, :3] += a * cross + b * cross @ cross
        pose[:3, 3] = (np.eye(3) + b * cross + c * cross @ cross) @ self.velocity_mps * seconds
        return pose


@dataclass(frozen=True, eq=False, slots=True)
class Trajectory:
    """Poses of a sensor over ground, by time.

    Attributes
    ----------
    times_s : (n,) float64
        Rising, on the clock of the scans [s]; at least two.
    T_world_sensor : (n, 4, 4) float64

    Raises
    ------
    TrackingError
        A pose is not rigid, or there is not one for each time.
    StampError
        Fewer than two times, or they do not rise.
    """

    times_s: Floats
    T_world_sensor: Floats

    def __post_init__(self) -> None:
        times = numbers_of("got times of poses that are not numbers", self.times_s, StampError, "seconds")
        poses = numbers_of("got poses that are not matrices", self.T_world_sensor, TrackingError, "(n, 4, 4) numbers")
        if times.ndim != 1 or len(times) < 2 or not np.isfinite(times).all() or (np.diff(times) <= 0.0).any():
            raise StampError(f"got {times.size} times of poses; expected two or more finite ones that rise")
        if poses.shape != (len(times), 4, 4):
            raise TrackingError(
                f"got poses of shape {poses.shape} for {len(times)} times; expected ({len(times)}, 4, 4)"
            )
        object.__setattr__(self, "times_s", times)
        object.__setattr__(
            self, "T_world_sensor", np.array([rigid(f"pose {k}", pose, TrackingError) for k, pose in enumerate(poses)])
        )

    @classmethod
    def from_tum(
        cls,
        path: str | os.PathLike[str],
        *,
        quaternion: Literal["xyzw", "wxyz"] | None = None,
        maps_from: Literal["sensor", "world"] | None = None,
        mounting: Mounting = UNKNOWN_MOUNTING,
    ) -> Trajectory:
        """Read a file in TUM's format, as kiss-icp, evo and others write it.

        Parameters
        ----------
        path : str or path
            Lines of time [s], x, y, z [m] and the quaternion of T_world_sensor; ``#`` begins a comment.
        quaternion : str, optional
            Order of the quaternion: ``"xyzw"`` (TUM) or ``"wxyz"`` (EuRoC, nuScenes, COLMAP). By default it is
            ``"xyzw"``, unless the poses contradict that.
        maps_from : str, optional
            ``"sensor"``: the poses are T_world_sensor (TUM); ``"world"``: they are its inverse (COLMAP, OpenCV). By
            default they are T_world_sensor, unless they contradict that.
        mounting : Mounting
            Of the sensor, whose axes are then told from those of the vehicle: one that looks aside or hangs drives, as
            any, along the vehicle's x axis with z up.

        Raises
        ------
        TrackingError
            The file cannot be read, a line is not such eight numbers, or the sensor moves at more than 150 m/s. Or
            order and direction are not given, and only with others does the vehicle's z axis point up and its x axis
            along its way.
        StampError
            Fewer than two lines, or their times do not rise.
        OptionError
            ``quaternion`` or ``maps_from`` is neither.
        """
        if quaternion not in (None, "xyzw", "wxyz"):
            raise OptionError(f"quaternion is {quaternion!r}; expected 'xyzw' or 'wxyz'")
        if maps_from not in (None, "sensor", "world"):
            raise OptionError(f"maps_from is {maps_from!r}; expected 'sensor' or 'world'")
        path, content, rows = _read(path, 8, "time, x, y, z, qx, qy, qz, qw")
        norm = np.linalg.norm(rows[:, 4:], axis=1)
        is_right = (np.abs(norm - 1.0) < 1e-2) & np.isfinite(rows[:, 1:4]).all(axis=1)
        if not is_right.all():
            line = _line(content, int(np.argmin(is_right)))
            raise TrackingError(f"{path}: the quaternion of line {line} has not length 1, or its place is not finite")
        rises = rows[1:, 0] > rows[:-1, 0]
        if not rises.all():
            line = _line(content, int(np.argmin(rises)) + 1)
            raise StampError(f"{path}: the time of line {line} is not later than that before; expected times that rise")
        if quaternion is None and np.abs(rows[0, 1:] - IDENTITY).max() < 1e-9:  # w first, it would look back
            quaternion = "xyzw"
        units, read_as = rows[:, 4:] / norm[:, None], (quaternion or "xyzw", maps_from or "sensor")
        readings = {("xyzw", "sensor"): poses_of(rows[:, 1:4], units)}
        readings["wxyz", "sensor"] = poses_of(rows[:, 1:4], np.roll(units, -1, axis=1))
        readings |= {(order, "world"): _inverse(poses) for (order, _), poses in readings.items()}
        poses = readings[read_as]
        axes = np.eye(4)
        axes[:3, :3] = mounting.rotation().T
        of_vehicle = {key: each @ axes for key, each in readings.items()}
        usual = of_vehicle[read_as]
        others = [key for key in readings if quaternion in (None, key[0]) and maps_from in (None, key[1])]
        others = [key for key in others if _fits_better(of_vehicle[key], usual, rows[:, 0])]
        if others:
            likeness = {key: _likeness(of_vehicle[key]) for key in others}
            best = max(others, key=lambda key: (likeness[key][0], round(sum(likeness[key][1:]), 2)))
            raise TrackingError(
                f"{path}: read as {_reading(*read_as)}, the poses are those of a vehicle whose z axis points "
                f"{_directions(usual)}; read as {_reading(*best)}, {_directions(of_vehicle[best])}. Say which is "
                "right: quaternion= or --quaternion, xyzw or wxyz; maps_from= or --poses-from, sensor or world"
            )
        speed = _speed(poses, rows[:, 0])
        if FASTEST_MPS < speed < math.inf:
            raise TrackingError(
                f"{path}: by its poses, the sensor moves at {speed:,.0f} m/s; expected positions in meters and times "
                "in seconds"
            )
        try:
            return cls(rows[:, 0], poses)
        except EdgepercError as exc:
            raise type(exc)(f"{path}: {exc}") from exc

    @classmethod
    def from_kitti(
        cls, path: str | os.PathLike[str], times_s: ArrayLike, *, T_camera_sensor: ArrayLike | None = None
    ) -> Trajectory:
        """Read poses in KITTI's format, which SemanticKITTI and many odometries write, too.

        Parameters
        ----------
        path : str or path
            Lines of the upper three rows of a pose (4, 4), row by row; ``#`` begins a comment.
        times_s : (n,) array_like
            The time of each line [s], such as those of ``times.txt``.
        T_camera_sensor : (4, 4) array_like, optional
            The place of the sensor in the camera whose poses they are, as KITTI's. None: they are the sensor's, with x
            ahead and z up.

        Returns
        -------
        Trajectory
            Seen from where the sensor is if the camera is at the origin.

        Raises
        ------
        TrackingError
            The file cannot be read, a line is not such twelve numbers, a pose is not rigid, or by their way they are
            those of a camera and no place is given, or the other way round.
        StampError
            There is not one time for each line, or they do not rise.
        """
        path, _, rows = _read(path, 12, "the upper three rows of a pose")
        times = numbers_of("got times of poses that are not numbers", times_s, StampError, "seconds")
        if times.shape != (len(rows),):
            raise StampError(f"{path} has {len(rows):,} poses; expected a time for each, got {times.size:,}")
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3] = rows.reshape(-1, 3, 4)
        of_camera = _OF_CAMERA @ poses @ _OF_CAMERA.T
        if T_camera_sensor is not None:
            place = rigid("T_camera_sensor", T_camera_sensor, TrackingError)
            of_sensor, poses = poses, np.linalg.inv(place) @ poses @ place
            if _fits_better(of_sensor, poses, times):
                raise TrackingError(f"{path}: by their way, these are poses of the sensor; leave T_camera_sensor out")
        elif _fits_better(of_camera, poses, times):
            raise TrackingError(
                f"{path}: by their way, these are poses of a camera (z ahead); pass T_camera_sensor=, or for --poses "
                "KITTI's calib.txt beside the poses or the times"
            )
        try:
            return cls(times, poses)
        except EdgepercError as exc:
            raise type(exc)(f"{path}: {exc}") from exc

    def motion(self, first_s: float, last_s: float) -> Motion:
        """The motion during a scan, between the poses around it.

        Parameters
        ----------
        first_s, last_s : float
            Times of the scan's first and last point [s].

        Raises
        ------
        StampError
            The times are not finite, or more than 0.2 s outside those of the poses; or the poses around them are more
            than 2 s and 1 m apart.
        TrackingError
            As `pose`.
        """
        before, after = self._around(first_s, last_s)
        poses, times_s = self.T_world_sensor, self.times_s
        return Motion._of(poses[before], poses[after], float(times_s[after] - times_s[before]))

    def pose(self, at_s: float) -> Floats:
        """T_world_sensor (4, 4) at a time [s], such as for a `Tracker` or a `RollingGrid`: by the `motion` between the
        poses around it.

        Raises
        ------
        StampError
            As `motion`, of a scan at this time.
        TrackingError
            Between the poses around it is about half a turn or more.
        """
        before, _ = self._around(at_s, at_s)
        motion = self.motion(at_s, at_s)
        return np.asarray(self.T_world_sensor[before] @ motion._after(as_seconds(at_s) - self.times_s[before]))

    def _around(self, first_s: float, last_s: float) -> tuple[int, int]:
        """The last pose before a scan and the first one after it; errors as `motion`."""
        begin, end = float(self.times_s[0]), float(self.times_s[-1])
        first_s, last_s = as_seconds(first_s, "the time"), as_seconds(last_s, "the time")
        if not begin - OUTSIDE_S <= first_s <= last_s <= end + OUTSIDE_S:
            raise StampError(
                f"the poses are of {begin:.3f}..{end:.3f} s, the scan of {first_s:.3f}..{last_s:.3f} s; expected "
                "poses around it, on its clock"
            )
        before = int(np.clip(np.searchsorted(self.times_s, first_s, "right") - 1, 0, len(self.times_s) - 2))
        after = int(np.clip(np.searchsorted(self.times_s, last_s, "left"), before + 1, len(self.times_s) - 1))
        times_s, poses = self.times_s[before : after + 1], self.T_world_sensor[before : after + 1]
        for k in np.flatnonzero(np.diff(times_s) > LONGEST_GAP_S):
            if math.dist(poses[k, :3, 3], poses[k + 1, :3, 3]) > MIN_STEP_M:
                raise StampError(
                    f"there is no pose from {times_s[k]:.3f} to {times_s[k + 1]:.3f} s, and the sensor moved; expected "
                    f"poses at most {LONGEST_GAP_S:g} s apart around the scan of {first_s:.3f}..{last_s:.3f} s"
                )
        return before, after


def deskew(
    points: ArrayLike, times: ArrayLike, motion: Motion, *, at_s: float | None = None, min_range_m: float = 0.0
) -> Floats32:
    """Move each point of a scan to where a sensor that stands still would have seen it.

    A spinning sensor takes about 0.1 s for a scan. At 20 m/s it moves by 2 m in this time.

    Parameters
    ----------
    points : (n, 4) or (n, 3) array_like, or a structured array
        x, y, z [m] in the frame of the sensor at the time of each point, and remission.
    times : (n,) array_like
        Time of each point [s], on any clock.
    motion : Motion
        Of the sensor, constant during the scan.
    at_s : float, optional
        Time of the pose in whose frame the result lies, on the same clock; by default the last time.
    min_range_m : float
        Points at most so far from the sensor are not returns, but beams without one [m]
        (`SensorProfile.min_range_m`). With 0, those at (0, 0, 0) are.

    Returns
    -------
    (n, 4) float32
        In input order. Points or times that are not finite give points that are not finite. Beams without a return stay
        as they are, so that the result still shows which they are.

    Raises
    ------
    PointsError
        ``points`` is not a scan, or there is not one time for each point.
    StampError
        ``at_s`` is not finite, or half of the times are more than 10 s from it: in another unit, or on another clock.
        Or they are in float32 and so large that it rounds them by milliseconds, such as times of today.
    OptionError
        ``motion`` is not a `Motion`, or ``min_range_m`` is not a number of meters from 0.

    Notes
    -----
    The velocity and the turn rate are constant in the frame of the sensor, so its path is a screw, and a point moves by
    the exponential of both times the time from ``at_s``. Objects that move themselves stay distorted.
    """
    rows = as_points(points)
    seen = blank_too_near(rows, OPTIONS.number("min_range_m", min_range_m, 0.0))
    moments = times_of(times, len(rows))
    if not isinstance(motion, Motion):
        raise OptionError(f"motion is {motion!r:.200}; expected a Motion")
    known = moments[np.isfinite(moments)]
    at = (float(known.max()) if len(known) else 0.0) if at_s is None else as_seconds(at_s, "at_s")
    if not math.isfinite(at):
        raise StampError(f"at_s is {at_s}; expected finite seconds")
    if len(known) and np.median(np.abs(known - at)) > MAX_ACCUMULATE_S:
        raise StampError(
            f"got times of {known.min():.6g} to {known.max():.6g} for the pose at {at:.6g}; expected seconds on one "
            f"clock, and those of a scan, up to {MAX_ACCUMULATE_S:g} s"
        )
    moved = np.empty(rows.shape, np.float32)
    fill_deskewed(
        seen, read_only(moments - at, np.float64), np.array(motion.velocity_mps), np.array(motion.rate_radps), moved
    )
    if not np.shares_memory(seen, rows):
        blank = np.isnan(seen[:, 0])
        moved[blank] = rows[blank]
    return moved


def merge(
    scans: Iterable[ArrayLike], T_vehicle_sensor: Iterable[ArrayLike], *, min_range_m: float | Sequence[float] = 0.0
) -> Floats32:
    """Join the scans of several sensors to one scan in the frame of the vehicle.

    Parameters
    ----------
    scans : iterable of (n, 4) or (n, 3) array_like, or structured arrays
        Taken at the same time, each in the frame of its sensor. `deskew` moves scans to one time.
    T_vehicle_sensor : iterable of (4, 4) array_like
        Pose of each sensor: maps its points to the frame of the vehicle, whose z is 0 on the road.
    min_range_m : float or sequence of float
        Nearest range of the sensors, or of each [m]; as in `deskew`. In the merged scan, it can no longer be told.

    Returns
    -------
    (n, 4) float32
        The points of the first scan, then those of the second, and so on, with their own remission. Beams without a
        return are NaN.

    Raises
    ------
    PointsError
        A scan is not points, or there is no scan.
    SensorError
        There is not one pose for each scan, or one is not rigid, or so far away, as in a map, that points are rounded.
    OptionError
        ``min_range_m`` is not one number of meters from 0, or one for each scan.
    """
    rows = [as_points(scan) for scan in SCANS.iterator("scans", scans, "a list of scans")]
    poses = [*_POSES.iterator("T_vehicle_sensor", T_vehicle_sensor, "a list of 4 x 4 matrices")]
    if not rows:
        raise PointsError("got no scan; expected at least one")
    if len(poses) != len(rows):
        raise SensorError(f"got {len(poses)} poses for {len(rows)} scans; expected one for each")
    ranges_m = min_range_m if isinstance(min_range_m, Sequence) or np.ndim(min_range_m) else [min_range_m] * len(rows)
    ranges_m = OPTIONS.numbers("min_range_m, one for each scan,", ranges_m, len(rows), 0.0)
    merged = np.empty((sum(map(len, rows)), 4), np.float32)
    parts = np.split(merged, np.cumsum([*map(len, rows)])[:-1])
    for k, (scan, given, range_m, part) in enumerate(zip(rows, poses, ranges_m, parts, strict=True)):
        pose = rigid(f"T_vehicle_sensor[{k}]", given, SensorError)
        if (away_m := np.abs(pose[:3, 3]).max()) >= MAX_ROUNDING_M * 2**24:
            raise SensorError(
                f"T_vehicle_sensor[{k}] puts the sensor at {away_m:,.0f} m, where float32 rounds points by more than "
                f"{1e3 * MAX_ROUNDING_M:g} mm; expected its place on the vehicle: subtract the vehicle's in the map"
            )
        fill_moved(blank_too_near(scan, range_m), np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy(), part)
    return merged


_OF_CAMERA = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def _read(path: str | os.PathLike[str], n: int, expected: str) -> tuple[Path, bytes, Floats]:
    """A file of poses: its content, and its numbers, (rows, n). Raises TrackingError."""
    path = _WAY.path("the poses", path)
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1).removeprefix(b"\xef\xbb\xbf")
        return path, content, _rows(content, n)
    except (OSError, ValueError) as exc:
        raise TrackingError(f"{path} cannot be read as poses ({exc}); expected lines of {expected}") from exc


def _rows(content: bytes, n: int) -> Floats:
    """The numbers in a file of poses, (rows, n); ValueError says what else it holds."""
    text = content[:MAX_BYTES].decode("latin-1")
    first = next((line for line in text.splitlines() if line.partition("#")[0].strip()), "")
    if not first:
        raise ValueError("no line of numbers")
    if "," in first:
        raise ValueError("its values are separated by commas, as EuRoC's, whose times are nanoseconds")
    rows = np.loadtxt(io.StringIO(text), np.float64, ndmin=2)
    if len(content) > MAX_BYTES or rows.shape[1] != n:
        kind = {8: ", as TUM's", 12: ", as KITTI's poses, which have no times"}.get(rows.shape[1], "")
        raise ValueError(f"{len(content):,} bytes, {rows.shape[1]} numbers in a line{kind}")
    return rows


def _line(content: bytes, k: int) -> int:
    """The number of the line of a text with the k-th row of numbers, from 1."""
    rows = [n for n, line in enumerate(content.splitlines(), start=1) if line.partition(b"#")[0].strip()]
    return rows[k] if k < len(rows) else k + 1


def _inverse(poses: Floats) -> Floats:
    inverse = poses.copy()
    inverse[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    with np.errstate(all="ignore"):
        inverse[:, :3, 3] = -np.einsum("kij,kj->ki", inverse[:, :3, :3], poses[:, :3, 3])
    return inverse


def _reading(quaternion: str, maps_from: str) -> str:
    return f"{', '.join(quaternion)}{' and from the world to the sensor' if maps_from == 'world' else ''}"


def _speed(poses: Floats, times_s: Floats) -> float:
    with np.errstate(all="ignore"):
        speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / np.diff(times_s)
    return float(np.median(speeds)) if len(speeds) else 0.0


def _fits_better(other: Floats, poses: Floats, times_s: Floats) -> bool:
    """Whether one reading of the same poses is that of a vehicle, and the second is not; what is too fast is none.
    Where neither is, as for a camera's axes, or both, a way that keeps its direction in the sensor decides.
    """
    too_fast = [_speed(each, times_s) > FASTEST_MPS for each in (other, poses)]
    if any(too_fast):
        return too_fast == [False, True]
    (is_other, other_keeps, other_up), (is_vehicle, keeps, up) = _likeness(other), _likeness(poses)
    if min(up, other_up) > UPRIGHT:  # a sensor may look back; the inverse of bends and of noise is less straight
        for one, another, answer in ((other_keeps, keeps, True), (keeps, other_keeps, False)):
            if one > SAME_WAY and 1.0 - another > STRAIGHTER * (1.0 - one) + STRAIGHT:
                return answer
    if max(keeps, other_keeps) < SAME_WAY and up < -UPRIGHT:  # to and fro, and on the roof
        return other_up > UPRIGHT
    if is_other != is_vehicle:
        return is_other and not keeps > SAME_WAY > other_keeps
    return other_keeps > SAME_WAY > keeps and (is_vehicle or up < UPRIGHT)


def _likeness(poses: Floats) -> tuple[bool, float, float]:
    """Whether the poses are a vehicle's, how well its way keeps its direction in it, 0 to 1, and how upright it is."""
    up, way = _up_and_way(poses)
    is_vehicle = up > UPRIGHT and (way is None or way[0] > FORWARD)
    return is_vehicle, SAME_WAY if way is None else float(np.linalg.norm(way)), up


def _up_and_way(poses: Floats) -> tuple[float, Floats | None]:
    """The mean of the z axes along z of the world, and of the directions of travel in the sensor; None if it stands."""
    up = float(poses[:, 2, 2].mean())
    kept = [0]
    for k, position in enumerate(poses[:, :3, 3]):
        if math.dist(position, poses[kept[-1], :3, 3]) >= MIN_STEP_M:
            kept.append(k)
    steps = np.diff(poses[kept, :3, 3], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    if lengths.sum() < MIN_WAY_M:
        return up, None
    middle = poses[kept[:-1], :3, :3] + poses[kept[1:], :3, :3]  # the way between two poses is a chord
    ways = np.einsum("kji,kj->ki", middle, steps)
    return up, (ways / np.linalg.norm(ways, axis=1, keepdims=True).clip(1e-9)).mean(axis=0)


def _directions(poses: Floats) -> str:
    up, way = _up_and_way(poses)
    tilt = f"{math.degrees(math.acos(min(1.0, max(-1.0, up)))):.0f} deg from up"
    return tilt if way is None else f"{tilt} and that travels along {np.round(way, 1).tolist()}"


@njit(cache=True, nogil=True)
def fill_deskewed(points: Points, after_s: Floats, velocity: Floats, rate: Floats, moved: Points) -> None:
    """Move points by the motion of the sensor in its own frame (Rodrigues' formula for the turn and for its integral),
    of the time of each after the pose of the result [s].
    """
    wx, wy, wz = rate[0], rate[1], rate[2]
    squared = wx * wx + wy * wy + wz * wz
    speed = math.sqrt(squared)
    for i in range(points.shape[0]):
        x, y, z, s = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2]), after_s[i]
        angle = speed * s
        if not abs(angle) >= 1e-4:  # the error of these series is below 1e-16
            a, b, c = s, 0.5 * s * s, s * s * s / 6.0
        else:
            a, b = math.sin(angle) / speed, (1.0 - math.cos(angle)) / squared
            c = (s - a) / squared
        # The point turns to p + a w x p + b w x (w x p), and moves by s v + b w x v + c w x (w x v). Together, that is
        # p + s v + w x (u + w x g), with g = b p + c v and u = a p + b v.
        gx, gy, gz = b * x + c * velocity[0], b * y + c * velocity[1], b * z + c * velocity[2]
        ux, uy, uz = a * x + b * velocity[0], a * y + b * velocity[1], a * z + b * velocity[2]
        hx, hy, hz = wy * gz - wz * gy, wz * gx - wx * gz, wx * gy - wy * gx
        hx, hy, hz = hx + ux, hy + uy, hz + uz
        moved[i, 0] = x + s * velocity[0] + wy * hz - wz * hy
        moved[i, 1] = y + s * velocity[1] + wz * hx - wx * hz
        moved[i, 2] = z + s * velocity[2] + wx * hy - wy * hx
        moved[i, 3] = points[i, 3]
