"""Dirt, rain, snow, dust, spray and fog in a scan of clear air, as published models have them.

Functions take and return points (n, 4) float32: x, y, z [m] about the sensor, remission in 0..1, finite; they never
modify their input. The rows keep their order, and lost returns are left out. Only beams that had a return in clear air
can have one of a drop: the directions of the others are not in a scan.

Drops and flakes: the sizes of Marshall and Palmer (1948) and Gunn and Marshall (1958), and which of them outshines the
target, after Kilic et al., "Lidar Light Scattering Augmentation (LISA)", 2021. Attenuation in rain: Goodin et al.,
"Predicting the Influence of Rain on LIDAR in ADAS", 2019, whose noise of ranges is left out. Fog: Hahner et al., "Fog
Simulation on Real LiDAR Point Clouds for 3D Object Detection in Adverse Weather", 2021.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..types.points import Floats, Floats32, Points
from .scene import LEAST, NUMBERS

DIVERGENCE_RAD = 3e-3  # of the beam
MAX_RANGE_M = 120.0  # of the sensor
DROP_REMISSION = 0.02  # of water and ice at normal incidence
LEAST_REMISSION, LEAST_OF_DROP = 0.05, 0.9  # of what a sensor sees at its longest range; after LISA for drops
_RATES_MM_H = (0.001, 1e4)  # without rain, a scan is of clear air
_TARGET = 1e-6 / math.pi  # differential reflectivity of a hard target (Hahner et al.)
_PULSE_S, _LIGHT_M_PER_S = 20e-9, 299792458.0
_CROSSOVER_M = (0.9, 1.0)  # between which the receiver begins to see the beam


def dirty(points: Points, left_deg: float, right_deg: float, lost: float = 1.0, *, seed: int = 0) -> Floats32:
    """Dirt on the window from an azimuth to another one on its right, which keeps a share of the returns away."""
    for name, number_deg in (("left_deg", left_deg), ("right_deg", right_deg)):
        NUMBERS.number(name, number_deg)
    NUMBERS.number("lost", lost, 0.0, 1.0)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    behind = (left_deg - azimuth) % 360.0 <= (left_deg - right_deg) % 360.0
    return points[~(behind & (np.random.default_rng(seed).random(len(points)) < lost))].astype(np.float32)


def rain(points: Points, rate_mm_h: float, *, seed: int = 0) -> Floats32:
    """Rain: drops in the beams, and lost returns."""
    NUMBERS.number("rate_mm_h", rate_mm_h, *_RATES_MM_H)
    slope, per_m = 4.1 * rate_mm_h**-0.21, 0.01 * rate_mm_h**0.6
    return _fallen(points, (8000.0, slope, per_m), seed)


def snow(points: Points, rate_mm_h: float, *, seed: int = 0) -> Floats32:
    """Snow, by its rate as water: flakes in the beams, and lost returns."""
    NUMBERS.number("rate_mm_h", rate_mm_h, *_RATES_MM_H)
    n0, slope = 7.6e3 * rate_mm_h**-0.87, 2.55 * rate_mm_h**-0.48
    # The cross-sections of all flakes take from the beam: pi/4 times the second moment of their sizes.
    per_m = math.pi / 4.0 * 2.0 * n0 / slope**3 * 1e-6
    return _fallen(points, (n0, slope, per_m), seed)


def cloud(
    points: Points, center_m: tuple[float, float, float], radius_m: float, per_m: float, *, seed: int = 0
) -> Floats32:
    """A ball of dust, spray or exhaust: a beam through it returns from inside with this probability a meter."""
    NUMBERS.numbers("center_m", center_m, 3)
    NUMBERS.number("radius_m", radius_m, 0.0)
    NUMBERS.number("per_m", per_m, LEAST)
    rng, ranges, rays = _beams(points, seed)
    along = rays @ np.array(center_m)
    half = np.sqrt(np.maximum(radius_m**2 - (np.dot(center_m, center_m) - along**2), 0.0))
    first = np.maximum(along - half, 0.5)
    at = first + rng.exponential(1.0 / per_m, len(points))
    return _with_drops(points, rays, ranges, np.where((half > 0.0) & (at < along + half), at, np.inf))


def fog(points: Points, visibility_m: float, *, seed: int = 0) -> Floats32:
    """Fog by its visibility (meteorological optical range): attenuated returns, and those of the fog itself."""
    NUMBERS.number("visibility_m", visibility_m, 1.0)
    rng, ranges, rays = _beams(points, seed)
    per_m, backscatter = math.log(20.0) / visibility_m, 0.046 / visibility_m
    reach, time = np.arange(0.5, 30.0, 0.1), np.linspace(0.0, 2.0 * _PULSE_S, 161)
    from_m = np.maximum(reach[:, None] - 0.5 * _LIGHT_M_PER_S * time, 1e-3)
    crossed = np.clip((from_m - _CROSSOVER_M[0]) / (_CROSSOVER_M[1] - _CROSSOVER_M[0]), 0.0, 1.0)
    pulse = np.sin(math.pi * time / (2.0 * _PULSE_S)) ** 2 * crossed * np.exp(-2.0 * per_m * from_m) / from_m**2
    response = pulse.sum(axis=1) * (time[1] - time[0])
    at = reach[int(response.argmax())]
    remission = np.maximum(points[:, 3], LEAST_REMISSION)
    hard = remission * np.exp(-2.0 * per_m * ranges)
    soft = remission * ranges**2 * backscatter / _TARGET * response.max()
    is_soft = (soft > hard) & (ranges > at)
    scattered = at * rng.uniform(0.5, 1.5, len(points))
    is_lost = hard / np.maximum(ranges, 1e-9) ** 2 < LEAST_REMISSION / MAX_RANGE_M**2
    foggy = _with_drops(points, rays, ranges, np.where(is_soft, scattered, np.inf))
    foggy[:, 3] = np.where(is_soft, np.minimum(soft, 1.0), points[:, 3] * np.exp(-2.0 * per_m * ranges))
    return foggy[is_soft | ~is_lost]


def _beams(points: Points, seed: int) -> tuple[np.random.Generator, Floats, Floats]:
    """Random numbers, the ranges of the returns (n,), and the directions of their beams (n, 3)."""
    ranges = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    return np.random.default_rng(seed), ranges, points[:, :3] / np.maximum(ranges, 1e-9)[:, None]


def _fallen(points: Points, sizes: tuple[float, float, float], seed: int) -> Floats32:
    """sizes : number of drops per m3 and mm of diameter that the exponential begins with, its slope [1/mm], and the
        attenuation [1/m].
    Returns of drops that are nearer than the target and bright enough; targets that are too dim are lost.
    """
    n0, slope, per_m = sizes
    rng, ranges, rays = _beams(points, seed)
    least = LEAST_REMISSION / MAX_RANGE_M**2
    reach = np.arange(0.5, 40.0, 0.05)
    width_mm = 1e3 * DIVERGENCE_RAD * reach
    # The smallest that is seen; one larger than the beam returns no more than all of it.
    seen_mm = width_mm * reach * np.sqrt(LEAST_OF_DROP / MAX_RANGE_M**2 / DROP_REMISSION) * np.exp(per_m * reach)
    seen_mm = np.where(seen_mm <= width_mm, seen_mm, np.inf)
    per_beam = n0 / slope * np.exp(-slope * seen_mm) * math.pi / 4.0 * (1e-3 * width_mm) ** 2
    expected = np.cumsum(per_beam) * 0.05
    at = np.interp(rng.exponential(1.0, len(points)), expected, reach, right=np.inf)
    power = np.maximum(points[:, 3], LEAST_REMISSION) * np.exp(-2.0 * per_m * ranges) / np.maximum(ranges, 1e-9) ** 2
    wet = _with_drops(points, rays, ranges, at)
    return wet[(at < ranges) | (power >= least)]


def _with_drops(points: Points, rays: NDArray[np.floating], ranges: NDArray[np.floating], at: Floats) -> Floats32:
    """Points whose beams meet a drop before their target are at the drop, with its low remission."""
    wet = points.astype(np.float32)
    nearer = at < ranges
    wet[nearer, :3] = (rays[nearer] * at[nearer, None]).astype(np.float32)
    wet[nearer, 3] = np.minimum(wet[nearer, 3], DROP_REMISSION)
    return wet
