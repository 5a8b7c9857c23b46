"""The place of the sensor in a scan whose coordinates are those of a map.

Seen from where the sensor was, the points of each beam have one elevation, and from anywhere else they have not. The
place is searched whose elevations stand out most, first roughly by how evenly the points lie around it.
"""

from __future__ import annotations

import math

import numpy as np

from ..errors import PointsError
from ..types.points import Floats, Ints64

_N_POINTS = 16_000  # that are looked at
_N_SECTORS = 90  # of a turn, which has as many points everywhere around the sensor
_ROUGH_STEPS_M = ((24.0, 4.0), (4.0, 1.0), (1.0, 0.5))  # reach and step of the rough search, around the last place
_FEWEST = 2000
_REACH_M = 1000.0  # of any LiDAR; damaged coordinates lie farther from the others
# The sensor is 0.4 to 9 m above the ground, and at most 2 m from the roughly known place.
_ASIDE_M, _ASIDE_STEP_M = 2.0, 0.4
_HEIGHTS_M = np.arange(0.4, 9.1, 0.1)
_FAR_M, _N_FAR = 12.0, 6000  # points that show the height, while the place is not known well
_WIDTH_DEG, _BAND_DEG = 0.1, 1.2  # of a bin of elevations, and of the band in which it should stand out
_UP_DEG = 45.0
_TILTS = ((1.5, 0.1), (0.1, 0.02))  # reach and step [deg]
# Steps of the last search in place [m] and tilt [deg], with the nearest points that it uses [m].
_FINE = ((0.2, 0.5, 8.0), (0.1, 0.2, 6.0), (0.05, 0.1, 4.0), (0.025, 0.05, 3.0), (0.0125, 0.025, 3.0))
# Contrast of the elevations, and how much more it is than half a meter aside. In 130 scans of 11 sensors, level and
# leaning, 83 places were found so, all within 0.25 m; of the others, refused, most were wrong.
_LEAST_CONTRAST, _LEAST_GAIN = 0.5, 2.7


def find_place(xyz: Floats) -> tuple[float, float, float]:
    """Find where the sensor, nearly upright, was in the map when it took a scan, mostly to a centimeter.

    xyz : (n, 3) at least 2000 finite points of one turn, from one place: not moved point by point. Raises PointsError:
        The elevations stand out nowhere, as in most scans of a sensor that leans by half a degree.
    """
    finite = xyz[np.isfinite(xyz).all(axis=1)]
    if len(finite) < _FEWEST:
        raise _unknown(f"it has {len(finite):,} finite points, expected at least {_FEWEST:,}")
    middle = np.median(finite, axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        finite = finite[(np.abs(finite - middle) < _REACH_M).all(axis=1)]
    if len(finite) < _FEWEST:
        raise _unknown(f"{len(finite):,} points are within {_REACH_M:g} m of most, expected at least {_FEWEST:,}")
    sample = np.random.default_rng(0).permutation(finite)[:_N_POINTS] - middle
    x, y = _rough_place(sample)
    place = _far_place(sample, x, y)
    tilt = _tilt(sample, place)
    place, _, contrast = _fine_place(sample, place, tilt)
    if not math.isfinite(contrast):
        raise _unknown("no place is one from which its elevations are those of beams")
    found = (middle + place).tolist()
    return found[0], found[1], found[2]


def _unknown(reason: str) -> PointsError:
    return PointsError(
        f"the place of the sensor cannot be told from the scan: {reason}; pass it: origin_m=(x, y, z) or --origin X Y Z"
    )


def _rough_place(sample: Floats) -> tuple[float, float]:
    """x, y around which the points are spread most evenly over azimuths."""
    x = y = 0.0
    for reach_m, step_m in _ROUGH_STEPS_M:
        offsets = np.arange(-reach_m, reach_m + step_m / 2.0, step_m)
        places = [(x + dx, y + dy) for dx in offsets.tolist() for dy in offsets.tolist()]
        x, y = min(places, key=lambda place: _unevenness(sample, *place))
    return x, y


def _unevenness(sample: Floats, x: float, y: float) -> float:
    counts = np.bincount(_sectors(sample, x, y, _N_SECTORS), minlength=_N_SECTORS)
    return float(counts.std())


def _sectors(sample: Floats, x: float, y: float, n: int) -> Ints64:
    turn = np.arctan2(sample[:, 1] - y, sample[:, 0] - x) / (2.0 * np.pi) + 0.5
    return np.asarray(np.minimum(turn * n, n - 1.0), np.int64)


def _far_place(sample: Floats, x: float, y: float) -> Floats:
    """The place near x, y from which the elevations of far points stand out most in each sector."""
    across = np.hypot(sample[:, 0] - x, sample[:, 1] - y)
    near_z = sample[across < 15.0, 2]
    if len(near_z) < 100:
        raise _unknown("it shows no ground around one")
    counts, edges = np.histogram(near_z, np.arange(near_z.min(), near_z.max() + 0.4, 0.2))
    heights = float(edges[counts.argmax()]) + 0.1 + _HEIGHTS_M
    far = sample[across > _FAR_M][:_N_FAR]
    offsets = np.arange(-_ASIDE_M, _ASIDE_M + 0.1, _ASIDE_STEP_M)
    best, place = -1.0, np.zeros(3)
    rows = np.arange(len(heights))[:, None]
    for dx in offsets.tolist():
        for dy in offsets.tolist():
            flat = np.hypot(far[:, 0] - x - dx, far[:, 1] - y - dy)
            elevation = np.degrees(np.arctan2(far[None, :, 2] - heights[:, None], flat[None]))
            contrasts = _contrasts(elevation, rows, len(heights), _WIDTH_DEG)
            if contrasts.max() > best:
                best, place = float(contrasts.max()), np.array([x + dx, y + dy, heights[int(contrasts.argmax())]])
    return place


def _contrasts(elevation: Floats, row: Ints64, n_rows: int, width_deg: float) -> Floats:
    """How much the bins of the elevations of each row stand out from the band around them, (n_rows,)."""
    n_bins = int(2.0 * _UP_DEG / width_deg)
    place = (elevation + _UP_DEG) / width_deg
    bins = np.where((place >= 0.0) & (place < n_bins), place, n_bins).astype(np.int64)  # the last is left out
    counts = np.bincount((row * (n_bins + 1) + bins).ravel(), minlength=n_rows * (n_bins + 1))
    counts = counts.reshape(n_rows, n_bins + 1)[:, :-1].astype(np.float64)
    half = int(_BAND_DEG / width_deg / 2.0)
    total = np.cumsum(np.pad(counts, ((0, 0), (half + 1, half))), axis=1)
    band = (total[:, 2 * half + 1 :] - total[:, : -2 * half - 1]) / (2 * half + 1)
    # Random counts stand out by their own number.
    return np.asarray(
        (((counts - band) ** 2).sum(axis=1) - counts.sum(axis=1)) / np.maximum((band**2).sum(axis=1), 1.0)
    )


def _contrast(sample: Floats, place: Floats, tilt: Floats) -> float:
    """The contrast of the elevations about an axis that leans by ``tilt`` (2,) [deg] towards x and y."""
    x, y, z = (sample - place).T
    lean_x, lean_y = np.radians(tilt)
    elevation = np.degrees(np.arctan2(z + lean_x * x + lean_y * y, np.hypot(x - lean_x * z, y - lean_y * z)))
    return float(_contrasts(elevation, np.zeros(1, np.int64), 1, _WIDTH_DEG / 2.0)[0])


def _tilt(sample: Floats, place: Floats) -> Floats:
    """The tilt [deg] from which the elevations stand out most."""
    far = sample[np.hypot(*(sample - place)[:, :2].T) > _FAR_M][:_N_FAR]
    best = np.zeros(2)
    for reach_deg, step_deg in _TILTS:
        offsets = np.arange(-reach_deg, reach_deg + step_deg / 2.0, step_deg)
        tilts = [best + np.array([along, across]) for along in offsets for across in offsets]
        best = max(tilts, key=lambda tilt: _contrast(far, place, tilt))
    return best


def _fine_place(sample: Floats, place: Floats, tilt: Floats) -> tuple[Floats, Floats, float]:
    """The place and tilt from which the elevations stand out most, and by how much; NaN if not enough."""
    steps = np.array([-1.0, 0.0, 1.0])
    shifts = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    leans = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    for step_m, step_deg, near_m in _FINE:
        used = sample[np.hypot(*(sample - place)[:, :2].T) > near_m]
        for _ in range(3):
            place = max(place + step_m * shifts, key=lambda each: _contrast(used, each, tilt))
            tilt = max(tilt + step_deg * leans, key=lambda each: _contrast(used, place, each))
    contrast = _contrast(used, place, tilt)
    beside = max(_contrast(used, place + shift, tilt) for shift in 0.5 * shifts if np.abs(shift).sum() == 0.5)
    is_sure = contrast >= _LEAST_CONTRAST and contrast >= _LEAST_GAIN * beside
    return place, tilt, contrast if is_sure else math.nan
