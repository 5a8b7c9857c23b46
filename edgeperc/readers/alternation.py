"""Scans of several sensors that come by turns on one topic, with one frame: told by which scans are alike."""

from __future__ import annotations

import statistics
import warnings
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from ..types.points import Floats, Ints64, Points
from .times import TimedScan

_SECTORS, _BANDS, _REACH_DEG = 24, 8, 30.0  # cells of azimuth and elevation
_SAMPLE, _FEWEST, _NEAREST_M = 10_000, 3, 1.0
# How unlike the n-th scan is, for each scan between them that is the most alike: 0.99 and more in real and simulated
# scans of one sensor. Of two simulated sensors, at most 0.5 at up to 3 m/s, and mostly at 10 m/s.
_ALIKE, _UNLIKE, _IN_A_ROW, _LOOKED_AT = 0.6, 0.03, 6, 300
# At speed, means over many scans differ between sensors, 1.6 to 8 times as much as between other halves of the same
# scans for two simulated ones at 15 m/s; of one sensor, at most 0.7 times.
_MANY, _APART, _LEAST_APART = (24, 48), 1.25, 0.05


def told_apart(scans: Iterator[TimedScan], say: Callable[[str], None]) -> Iterator[TimedScan]:
    """The scans; ``say`` is called once if every second or third of them is alike, and those between are not."""
    recent = deque[Floats](maxlen=4)
    sketches = list[Floats]()
    ratios = {n: deque[float](maxlen=_IN_A_ROW) for n in (2, 3)}
    is_said = False
    for k, scan in enumerate(scans):
        sketch = _sketch(scan.points) if k < _LOOKED_AT and not is_said else None
        if sketch is not None and not np.isnan(sketch).all():
            recent.append(sketch)
            sketches += [sketch] if len(sketches) < _MANY[-1] else []
            for n, latest in ratios.items():
                latest.append(_ratio([*recent][-n - 1 :]) if len(recent) > n else 1.0)
                is_alike = len(latest) == _IN_A_ROW and statistics.median(latest) < _ALIKE
                if (is_alike or (k + 1 in _MANY and _differ(sketches, n))) and not is_said:
                    is_said = True
                    say(
                        f"every {'second' if n == 2 else 'third'} scan is alike, and those between are not: {n} "
                        "sensors share the topic and the frame, or each message has a part of a turn. They are "
                        "read as one sensor; record each on a topic of its own"
                    )
        yield scan


def _sketch(points: Points) -> Floats:
    """The mean logarithm of the distance in each cell; NaN without points."""
    x, y, z = points[:: len(points) // _SAMPLE + 1, :3].T.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        flat = np.hypot(x, y)
        used = np.isfinite(flat + z) & (flat > _NEAREST_M)
    x, y, z, flat = x[used], y[used], z[used], flat[used]
    sector = np.floor((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(np.int64) % _SECTORS
    band = np.clip((np.degrees(np.arctan2(z, flat)) / _REACH_DEG + 1.0) * 0.5 * _BANDS, 0, _BANDS - 1)
    cell = sector * _BANDS + band.astype(np.int64)
    count = np.bincount(cell, minlength=_SECTORS * _BANDS)
    total = np.bincount(cell, np.log(flat), minlength=_SECTORS * _BANDS)
    return np.where(count >= _FEWEST, total / np.maximum(count, 1), np.nan)


def _ratio(sketches: list[Floats]) -> float:
    """How unlike the last one is to the first one, as a share of the least among the other pairs."""
    n = len(sketches) - 1
    pairs = [(j, k) for k in range(n + 1) for j in range(k) if (j, k) != (0, n)]
    least = min(_difference(sketches[j], sketches[k]) for j, k in pairs)
    return _difference(sketches[0], sketches[n]) / least if least > _UNLIKE else 1.0


def _differ(sketches: list[Floats], n: int) -> bool:
    """Whether the means of every n-th sketch differ, more than where neighbors are together."""
    values, k = np.array(sketches), np.arange(len(sketches))
    values = values[:, np.isnan(values).mean(axis=0) < 0.5]

    def between(part: Ints64) -> float:
        means = [np.nanmean(values[part == one], axis=0) for one in range(n)]
        pairs = [_difference(means[one], means[other]) for one in range(n) for other in range(one)]
        return float(np.mean(pairs))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a cell that one part never sees is NaN
        apart = between(k % n)
        return apart > max(_LEAST_APART, _APART * between(k // n % n), _APART * between(k // (2 * n) % n))


def _difference(one: Floats, other: Floats) -> float:
    there = ~(np.isnan(one) & np.isnan(other))
    off = np.nan_to_num(np.minimum(np.abs(one - other), 1.0), nan=1.0)  # points in one alone
    return float(off[there].mean()) if there.any() else 0.0
