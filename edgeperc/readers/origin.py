"""The place of the sensor in a scan whose coordinates are those of a map.

Seen from where the sensor was, the points of each beam have one elevation, and from anywhere else they have not. The
place is searched whose elevations stand out most, first roughly by how evenly the points lie around it.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..system.kernels import njit
from ..types.points import Floats

_N_POINTS = 16_000  # that are looked at
_N_SECTORS = 90  # of a turn, which has as many points everywhere around the sensor
_ROUGH_STEPS_M = ((24.0, 4.0), (4.0, 1.0), (1.0, 0.5))  # reach and step of the rough search, around the last place
_FEWEST = 2000
_REACH_M = 1000.0  # of any LiDAR; damaged coordinates lie farther from the others
# The sensor is 0.4 to 9 m above the ground, and at most 2 m from the roughly known place.
_ASIDE_M, _ASIDE_STEP_M = 2.0, 0.4
_HEIGHTS_M = np.arange(0.4, 9.1, 0.1)
_FAR_M, _N_FAR = 12.0, 6000  # points that show the height, while the place is not known well
_UP_DEG, _BAND_DEG = 45.0, 1.2  # of the elevations, and of the band in which a bin should stand out
_COARSE_DEG, _FINE_DEG = 0.1, 0.05  # widths of a bin
_TILTS = ((1.5, 0.1), (0.1, 0.02))  # reach and step [deg]
# Steps of the last search in place [m] and tilt [deg], with the nearest points that it uses [m].
_STEPS = ((0.2, 0.5, 8.0), (0.1, 0.2, 6.0), (0.05, 0.1, 4.0), (0.025, 0.05, 3.0), (0.0125, 0.025, 3.0))
# Contrast of the elevations, and how much more it is than half a meter aside. In 130 scans of 11 sensors, level and
# leaning, 83 places were found so, all within 0.25 m; of the others, refused, most were wrong.
_LEAST_CONTRAST, _LEAST_GAIN = 0.5, 2.7


class Bins(NamedTuple):
    """Bins of elevations, from -45 to 45 degrees."""

    tangents: Floats  # (n + 1,), of their edges
    first: NDArray[np.uint16]  # the bin of a slope from -1 to 1, in equal steps
    half: int  # bins on each side of the band around one


@cache
def bins_of(width_deg: float) -> Bins:
    """Bins of this width."""
    tangents = np.tan(np.radians(np.linspace(-_UP_DEG, _UP_DEG, round(2.0 * _UP_DEG / width_deg) + 1)))
    slopes = np.linspace(-1.0, 1.0, 16 * len(tangents), endpoint=False)
    first = np.maximum(np.searchsorted(tangents, slopes, "right") - 1, 0).astype(np.uint16)
    return Bins(tangents, first, int(_BAND_DEG / width_deg / 2.0))


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
    place, _, contrast = _fine_place(sample, place, _tilt(sample, place))
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
    turn = np.arctan2(sample[:, 1] - y, sample[:, 0] - x) / (2.0 * np.pi) + 0.5
    sectors = np.minimum(turn * _N_SECTORS, _N_SECTORS - 1.0).astype(np.int64)
    return float(np.bincount(sectors, minlength=_N_SECTORS).std())


def _far_place(sample: Floats, x: float, y: float) -> Floats:
    """The place near x, y from which the elevations of far points stand out most in each sector."""
    across = np.hypot(sample[:, 0] - x, sample[:, 1] - y)
    near_z = sample[across < 15.0, 2]
    if len(near_z) < 100:
        raise _unknown("it shows no ground around one")
    counts, edges = np.histogram(near_z, np.arange(near_z.min(), near_z.max() + 0.4, 0.2))
    heights = float(edges[counts.argmax()]) + 0.1 + _HEIGHTS_M
    offsets = np.arange(-_ASIDE_M, _ASIDE_M + 0.1, _ASIDE_STEP_M)
    places = _grid(x + offsets, y + offsets, heights)
    contrasts = _contrasts(sample[across > _FAR_M][:_N_FAR], places, np.zeros(2), _COARSE_DEG)
    return places[contrasts.argmax()]


def _grid(*axes: Floats) -> Floats:
    """All combinations of values, the last axis fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _contrasts(sample: Floats, places: Floats, tilts_deg: Floats, width_deg: float) -> Floats:
    """The contrast of the elevations seen from places (n, 3), about axes that lean by tilts (n, 2) or (2,)."""
    places = np.atleast_2d(places)
    leans = np.radians(np.atleast_2d(tilts_deg))
    seen_from = np.empty((max(len(places), len(leans)), 5))
    seen_from[:, :3], seen_from[:, 3:] = places, leans
    contrasts = np.empty(len(seen_from))
    fill_contrasts(sample, seen_from, bins_of(width_deg), contrasts)
    return contrasts


@njit(cache=True, nogil=True)
def fill_contrasts(points: Floats, seen_from: Floats, bins: Bins, contrasts: Floats) -> None:
    """How much the bins of the elevations of points (n, 3) stand out from the band around them.

    seen_from : (m, 5), x, y, z [m], and the lean of the axis towards x and y [rad].
    """
    tangents, first, half = bins
    n_points, n_bins, scale = points.shape[0], tangents.shape[0] - 1, 0.5 * first.shape[0]
    counts = np.empty(n_bins, np.int64)
    for m in range(seen_from.shape[0]):
        x, y, z, lean_x, lean_y = seen_from[m]
        counts[:] = 0
        for i in range(n_points):
            dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            flat_x, flat_y = dx - lean_x * dz, dy - lean_y * dz
            flat = max(math.sqrt(flat_x * flat_x + flat_y * flat_y), 1e-9)
            slope = (dz + lean_x * dx + lean_y * dy) / flat
            if tangents[0] <= slope < tangents[n_bins]:
                k = int(first[int((slope + 1.0) * scale)])
                while slope >= tangents[k + 1]:
                    k += 1
                counts[k] += 1
        total, within, differences, squares = 0, 0, 0.0, 0.0
        for k in range(-half, n_bins):
            if k + half < n_bins:
                within += counts[k + half]
            if k > half:
                within -= counts[k - half - 1]
            if k >= 0:
                band = within / (2 * half + 1)
                total += counts[k]
                differences += (counts[k] - band) ** 2
                squares += band * band
        # Random counts stand out by their own number.
        contrasts[m] = (differences - total) / max(squares, 1.0)


def _tilt(sample: Floats, place: Floats) -> Floats:
    """The tilt [deg] from which the elevations stand out most."""
    far = sample[np.hypot(*(sample - place)[:, :2].T) > _FAR_M][:_N_FAR]
    best = np.zeros(2)
    for reach_deg, step_deg in _TILTS:
        offsets = np.arange(-reach_deg, reach_deg + step_deg / 2.0, step_deg)
        tilts = best + _grid(offsets, offsets)
        best = tilts[_contrasts(far, place, tilts, _FINE_DEG).argmax()]
    return best


def _fine_place(sample: Floats, place: Floats, tilt: Floats) -> tuple[Floats, Floats, float]:
    """The place and tilt from which the elevations stand out most, and by how much; NaN if not enough."""
    steps = np.array([-1.0, 0.0, 1.0])
    shifts, leans = _grid(steps, steps, steps), _grid(steps, steps)
    for step_m, step_deg, near_m in _STEPS:
        used = sample[np.hypot(*(sample - place)[:, :2].T) > near_m]
        for _ in range(3):
            places = place + step_m * shifts
            place = places[_contrasts(used, places, tilt, _FINE_DEG).argmax()]
            tilts = tilt + step_deg * leans
            tilt = tilts[_contrasts(used, place, tilts, _FINE_DEG).argmax()]
    contrast = float(_contrasts(used, place, tilt, _FINE_DEG)[0])
    beside = _contrasts(used, place + 0.5 * shifts[np.abs(shifts).sum(axis=1) == 1.0], tilt, _FINE_DEG).max()
    is_sure = contrast >= _LEAST_CONTRAST and contrast >= _LEAST_GAIN * beside
    return place, tilt, contrast if is_sure else math.nan
