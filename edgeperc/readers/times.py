"""Times of the points of a scan, by the fields that drivers store them in."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError, PointsError, StampError
from ..system.clock import as_seconds
from ..system.fields import OPTIONS, SCANS
from ..types.points import Floats, Mask, Points, as_points
from ..types.rigid import times_of
from ..types.sensor import MAX_ACCUMULATE_S, MIN_ACCUMULATE_S

if TYPE_CHECKING:
    from ..preprocess.motion import Motion, Trajectory

# Best first: of Ouster's and Velodyne's drivers, of Hesai's, RoboSense's and Livox', of others.
_NAMES = ("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset", "time_offset_ns")

# How long a scan takes [s]. The longest is 1,000 times the shortest, as each unit is of the next, so one unit at most
# gives a duration between them.
_SHORTEST_S, LONGEST_S = 2e-3, 2.0
_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)

# How long a LiDAR takes for a turn [s]: 5 to 20 turns a second, with a margin.
_FASTEST_TURN_S, _SLOWEST_TURN_S = 1 / 30, 0.35
_SECTORS, _TURN_SECTORS = 36, 27  # sectors of azimuth, and how many of them a turn has points in
_TURN_FIT = 0.9  # length of the mean of directions that turn with time; 1 where azimuth and time agree

# Share of times on either side that may be damaged, and how far outside of the others they then lie [their duration].
_DAMAGED_SHARE, _DAMAGED_DISTANCE = 0.01, 1.0

# Clocks begin anew after a second, a minute, an hour, a day or a week [s], and counters after 32 bits. Where one does
# so during a scan, no point has a time of most of its range; nor where a value stands for no time.
_CLOCKS_S, _COUNTER, _EMPTY_SHARE = (1.0, 60.0, 3600.0, 86400.0, 604800.0), 2.0**32, 0.7

# A scan lasts no longer than it takes to the next one; stamps jitter.
_LONGEST_OF_INTERVAL, _INTERVALS = 1.5, 9

_WHOLE = 0.9  # share of the time over which a scan is gathered that its points must span


class TimedScan(NamedTuple):
    """A scan and the time of each of its points, for `edgeperc.deskew`.

    Attributes
    ----------
    stamp_s : float or None
        Time of the scan, as `edgeperc.read_scans` yields it [s]; of a file, the last of times on a clock.
    points : (n, 4) float32
        As `edgeperc.read_scans` yields them.
    times_s : (n,) float64 or None
        Time of each point on the sensor's clock [s], that of ``stamp_s`` if the source stores times from the beginning
        or end of a scan. None if the source holds no times of points.
    """

    stamp_s: float | None
    points: Points
    times_s: Floats | None


def time_name(names: Iterable[str]) -> str | None:
    """The field with the times of points among fields by `edgeperc.types.points.plain_name`; None if there is none."""
    present = set(names)
    return next((name for name in _NAMES if name in present), None)


def point_times(fields: Mapping[str, NDArray[Any]], points: Points, stamp_s: float | None) -> Floats | None:
    """Find the times of points in a scan's fields [s]; NaN where one is missing, or damaged and far from all others.

    Drivers store seconds, milli-, micro- or nanoseconds, and no field says which. A scan takes 2 ms to 2 s, so the
    difference between its first and its last time shows the unit. Times of less than 2 s count from ``stamp_s``, or 0.
    None without such a field, or if no unit gives such a duration, as where all times are 0. Points without a return,
    which are not finite or lie in the origin, do not show the unit.

    Raises PointsError if, by these times and the azimuths, the sensor takes less than 33 or more than 350 ms for a
    turn.
    """
    name = time_name(fields)
    if name is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        moments = fields[name].astype(np.float64)
    moments[np.isinf(moments)] = np.nan
    xyz = points[:, :3]
    shows = ~np.isnan(moments) & np.isfinite(xyz).all(axis=1) & (xyz != 0.0).any(axis=1)
    if not shows.any():
        return None
    _carry_on(moments, shows)
    shows &= ~np.isnan(moments)
    first, last = _range(moments[shows])
    for unit in _UNITS_S:
        if _SHORTEST_S <= (last - first) * unit < LONGEST_S:
            counted = max(abs(first), abs(last)) * unit < LONGEST_S
            beside = np.where(shows, 0.0, last - first)  # where nothing returned, drivers write no time: 0
            moments[(moments < first - beside) | (moments > last + beside)] = np.nan
            shows &= ~np.isnan(moments)
            _check_turn(xyz[shows], (moments[shows] - first) / (last - first), (last - first) * unit, name)
            with np.errstate(over="ignore", invalid="ignore"):
                return moments * unit + (stamp_s or 0.0 if counted else 0.0)
    return None


def _carry_on(moments: Floats, shows: Mask) -> None:
    """Carry on the times after their clock began anew, and remove a value that stands for no time."""
    first, last = _range(moments[shows])
    early = shows & (moments < 0.5 * (first + last))
    late = shows & ~early
    if not early.any():
        return
    ended, began = float(moments[early].max()), float(moments[late].min())
    if began - ended <= _EMPTY_SHARE * (last - first):
        return
    periods = ((unit, period) for unit in _UNITS_S for period in (*(clock / unit for clock in _CLOCKS_S), _COUNTER))
    for unit, period in periods:
        duration = ended + period - began
        is_clock = first >= 0.0 and last <= period and duration < (1.0 - _EMPTY_SHARE) * period
        if is_clock and _SHORTEST_S <= duration * unit < LONGEST_S:
            moments[moments <= ended] += period
            return
    is_one = [np.ptp(moments[side]) == 0.0 and np.count_nonzero(side) > 1 for side in (early, late)]
    if is_one[0] != is_one[1]:
        moments[moments <= ended if is_one[0] else moments >= began] = np.nan


def _range(moments: Floats) -> tuple[float, float]:
    """First and last of the times, without damaged ones far outside of the others."""
    n_damaged = int(_DAMAGED_SHARE * len(moments))
    ends = [0, n_damaged, len(moments) - 1 - n_damaged, len(moments) - 1]
    first, low, high, last = np.partition(moments, sorted({*ends}))[ends]
    reach = _DAMAGED_DISTANCE * (high - low)
    if reach > 0.0 and (first < low - reach or last > high + reach):
        kept = moments[(moments >= low - reach) & (moments <= high + reach)]
        first, last = kept.min(), kept.max()
    return float(first), float(last)


def _check_turn(xyz: Points, shares: Floats, duration_s: float, name: str) -> None:
    """Raise PointsError if the azimuth turns once in a time that no LiDAR takes for it; shares are of it, 0 to 1."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]).astype(np.float64)
    sectors = np.unique(np.floor((azimuth / (2 * np.pi) + 0.5) * _SECTORS).astype(np.int64) % _SECTORS)
    if len(sectors) < _TURN_SECTORS or _FASTEST_TURN_S <= duration_s <= _SLOWEST_TURN_S:
        return
    turned = 2j * np.pi * shares
    fit = max(abs(np.exp(1j * azimuth - turned).mean()), abs(np.exp(1j * azimuth + turned).mean()))
    if fit > _TURN_FIT:
        raise PointsError(
            f"by the field {name!r}, a turn of the sensor takes {duration_s:.3g} s; LiDARs take 0.05 to 0.2 s. The "
            "times are in another unit, or shares of a turn. Leave out --deskew, or pass the times in seconds to "
            "edgeperc.deskew"
        )


def middle_after(before_s: float, stamp_s: float | None, first_s: float, last_s: float) -> float:
    """The middle of the times of a scan; StampError if it has no stamp, and they begin before that of the last scan."""
    if stamp_s is None and last_s < LONGEST_S and first_s <= before_s:
        raise StampError(
            "the times of the points begin anew with each scan, and its file has no stamp; expected times on one "
            "clock: record them so, or add the time of each scan; --deskew --track without --poses needs none"
        )
    return 0.5 * (first_s + last_s)


def of_plausible_duration(scans: Iterable[TimedScan]) -> Iterator[TimedScan]:
    """The scans of a stream. Raises PointsError where, by its points' times, one lasts longer than to the next."""
    stamp_s: float | None = None
    intervals_s = deque[float](maxlen=_INTERVALS)
    for scan in scans:
        if stamp_s is not None and scan.stamp_s is not None and scan.stamp_s > stamp_s:
            intervals_s.append(scan.stamp_s - stamp_s)
        stamp_s = scan.stamp_s
        if scan.times_s is not None and np.isfinite(scan.times_s).any() and len(intervals_s) > 1:
            duration_s = float(np.nanmax(scan.times_s) - np.nanmin(scan.times_s))
            interval_s = statistics.median(intervals_s)
            if duration_s > _LONGEST_OF_INTERVAL * interval_s:
                raise PointsError(
                    f"the times of the points of a scan span {duration_s:.3g} s, and a scan comes every "
                    f"{interval_s:.3g} s: the times are in another unit, or several sensors share the topic. Leave out "
                    "--deskew, or pass the times in seconds to edgeperc.deskew"
                )
        yield scan


def accumulate(
    scans: Iterable[TimedScan],
    accumulate_s: float,
    motion: Motion | Trajectory | None = None,
    *,
    min_range_m: float = 0.0,
) -> Iterator[TimedScan]:
    """Gather the scans of a sensor that does not spin: with each one, the points of the last tenths of a second.

    Parameters
    ----------
    scans : iterable of TimedScan
        In the order of time, such as those of `edgeperc.read_timed_scans`. Points without times of their own count as
        taken at the stamp of their scan.
    accumulate_s : float
        How long a scan is gathered [s].
    motion : Motion or Trajectory, optional
        Motion of the sensor, constant or by its poses. It is taken out (`edgeperc.deskew`), so that the points are
        where a sensor that stands still at the last of them would have seen them. None: the sensor stands still. If it
        moves all the same, what it saw earlier lies beside what it saw later, by 1 m at 10 m/s and 0.1 s.
    min_range_m : float
        As in `edgeperc.deskew`.

    Yields
    ------
    stamp_s : float or None
        Of the last scan.
    points : (n, 4) float32
        From the oldest to the newest.
    times_s : (n,) float64
        As recorded. The scans at the beginning, and those after a step back of the clock, come when they span the time;
        of a shorter recording, all together come at its end.

    Raises
    ------
    PointsError
        A scan is not points, or has not one time for each of them.
    StampError
        A scan has neither times nor a finite stamp, or no pose of a trajectory is near its times. Or they begin anew
        with each scan without a stamp, or are beyond 1e12 s, or in a float32 that rounds them by milliseconds.
    OptionError
        ``accumulate_s`` is not 0.01 to 10 s, or ``motion`` is neither.
    """
    from ..preprocess.motion import Motion, Trajectory, deskew  # numba, which bags do without

    accumulate_s = OPTIONS.number("accumulate_s", accumulate_s, MIN_ACCUMULATE_S, MAX_ACCUMULATE_S)
    if not isinstance(motion, Motion | Trajectory | None):
        raise OptionError(f"motion is {motion!r:.200}; expected a Motion, a Trajectory or None")

    def joined(stamp_s: float | None) -> TimedScan:
        points, times_s = np.concatenate([each[0] for each in kept]), np.concatenate([each[1] for each in kept])
        recent = ~(times_s <= end_s - accumulate_s)
        points, times_s = points[recent], times_s[recent]
        if motion is not None:
            constant = motion if isinstance(motion, Motion) else motion.motion(float(np.nanmin(times_s)), end_s)
            points = deskew(points, times_s, constant, at_s=end_s, min_range_m=min_range_m)
        return TimedScan(stamp_s, points, times_s)

    kept = deque[tuple[Points, Floats, float]]()
    begin_s, end_s, middle_s = 0.0, 0.0, -np.inf
    last: float | None = None
    is_waiting = False
    for scan in SCANS.iterator("scans", scans, "an iterable of edgeperc.TimedScan"):
        if not isinstance(scan, tuple) or len(scan) != 3:
            raise PointsError(f"got a {type(scan).__name__}; expected each scan as edgeperc.TimedScan")
        stamp_s, points, times_s = scan
        points = as_points(points).copy()  # a driver may fill the same array with its next scan
        if times_s is None:
            if stamp_s is None or not np.isfinite(as_seconds(stamp_s)):
                raise StampError(
                    f"a scan has neither times of its points nor a stamp ({stamp_s}); expected one of them"
                )
            times_s = np.full(len(points), stamp_s)
        times_s = times_of(times_s, len(points))
        if np.isnan(times_s).all():
            continue
        first_s, newest_s = float(np.nanmin(times_s)), float(np.nanmax(times_s))
        middle_s = middle_after(middle_s, stamp_s, first_s, newest_s)
        if not kept or newest_s < end_s:
            kept.clear()
            begin_s, is_waiting = first_s, True
        kept.append((points, times_s, newest_s))
        end_s, last = newest_s, stamp_s
        while kept[0][2] <= end_s - accumulate_s:
            kept.popleft()
        if end_s - begin_s >= _WHOLE * accumulate_s:
            yield joined(stamp_s)
            is_waiting = False
    if is_waiting:
        yield joined(last)
