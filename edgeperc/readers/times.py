"""Times of the points of a scan, by the fields that drivers store them in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Best first: of Ouster's and Velodyne's drivers, of Hesai's, RoboSense's and Livox', of others.
_NAMES = ("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset", "time_offset_ns")

# How long a scan takes [s]. The longest is 1,000 times the shortest, as each unit is of the next, so one unit at most
# gives a duration between them.
_SHORTEST_S, _LONGEST_S = 2e-3, 2.0
_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)


class TimedScan(NamedTuple):
    """A scan and the time of each of its points, for `edgeperc.deskew`.

    Attributes
    ----------
    stamp_s : float or None
        Time of the scan, as `edgeperc.read_scans` yields it [s].
    points : (n, 4) float32
        As `edgeperc.read_scans` yields them.
    times_s : (n,) float64 or None
        Time of each point on the sensor's clock [s], that of ``stamp_s`` if the source stores times from the beginning
        or end of a scan. None if the source holds no times of points.
    """

    stamp_s: float | None
    points: NDArray[np.float32]
    times_s: NDArray[np.float64] | None


def time_name(names: Iterable[str]) -> str | None:
    """The field with the times of points among fields by `edgeperc.types.points.plain_name`; None if there is none."""
    present = set(names)
    return next((name for name in _NAMES if name in present), None)


def point_times(
    fields: Mapping[str, NDArray[Any]], points: NDArray[np.float32], stamp_s: float | None
) -> NDArray[np.float64] | None:
    """Find the times of points in a scan's fields.

    Drivers store seconds, milli-, micro- or nanoseconds, and no field says which. A scan takes 2 ms to 2 s, so the
    difference between its first and its last time shows the unit. Times of less than 2 s count from ``stamp_s``.

    fields : mapping of str to (n,) array; columns by `edgeperc.types.points.plain_name`.
    points : (n, 4) float32; times of points without a return, which are not finite or lie in the origin, do not show
        the unit.
    stamp_s : None counts from 0.
    Returns (n,) float64 or None: [s]; None without such a field, or if no unit gives a duration of 2 ms to 2 s, as
        where all times are 0.
    """
    name = time_name(fields)
    if name is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        moments = fields[name].astype(np.float64)
    xyz = points[:, :3]
    known = moments[np.isfinite(moments) & np.isfinite(xyz).all(axis=1) & (xyz != 0.0).any(axis=1)]
    if not len(known):
        return None
    first, last = float(known.min()), float(known.max())
    for unit in _UNITS_S:
        if _SHORTEST_S <= (last - first) * unit < _LONGEST_S:
            counted = max(abs(first), abs(last)) * unit < _LONGEST_S
            with np.errstate(over="ignore", invalid="ignore"):
                return moments * unit + (stamp_s or 0.0 if counted else 0.0)
    return None
