"""What the simulator draws for a ray: random numbers, and free paths through leaves."""

from __future__ import annotations

import math

import numpy as np

from ..system.kernels import njit
from ..types.points import Floats

# Weights and lengths [m] of the noise that makes leaves clumps. With them, returns of plants bend along a beam as those
# of PandaSet's training drive do: quartiles 1.4, 3.8, 9.4 cm at 4 to 10 m (there 1.4, 3.6, 8.1), 3.1, 7.9, 22 cm at 20
# to 40 m (4.1, 9.7, 25); leaves that are not clumped: 3.6, 11, 24 and 5.7, 16, 42 cm.
CLUMPS = ((0.3, 0.5), (0.35, 0.15), (0.35, 0.05))


@njit(cache=True, nogil=True)
def mixed_bits(value: np.uint64) -> np.uint64:
    """SplitMix64: a draw depends on its ray and purpose only, not on the order of the rays."""
    value = np.uint64(value + np.uint64(0x9E3779B97F4A7C15))
    value = np.uint64((value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9))
    value = np.uint64((value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB))
    return np.uint64(value ^ (value >> np.uint64(31)))


@njit(cache=True, nogil=True)
def uniform_draw(bits: np.uint64) -> float:
    """Convert random bits to a uniform number in (0, 1)."""
    return (float(bits >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True)
def normal_draw(bits: np.uint64) -> float:
    """Convert random bits to a number of the normal distribution."""
    # Sum of four 16-bit uniforms, scaled to variance 1: within 3.5 sigma, from one hash.
    total = 0.0
    for k in range(4):
        total += float((bits >> np.uint64(16 * k)) & np.uint64(0xFFFF))
    return (total / 65536.0 - 2.0) * 1.7320508075688772


@njit(cache=True, nogil=True)
def clumped_path(p: Floats, t: float, direction: tuple[float, float, float], path: float) -> float:
    """Free path, in mean free paths, of a ray that meets leaves at the range ``t`` [m]; ``path`` without clumps.

    It is noise over the place on the plant, and the ray's own path with a share that is drawn for each plant.
    """
    x, y, z = t * direction[0] - p[4], t * direction[1] - p[5], t * direction[2] - p[6]
    a = (p[7] * x + p[8] * y + p[9] * z) / math.sqrt(p[7] * p[7] + p[8] * p[8] + p[9] * p[9])
    b = (p[10] * x + p[11] * y + p[12] * z) / math.sqrt(p[10] * p[10] + p[11] * p[11] + p[12] * p[12])
    c = (p[13] * x + p[14] * y + p[15] * z) / math.sqrt(p[13] * p[13] + p[14] * p[14] + p[15] * p[15])
    plant = mixed_bits(np.uint64(p[3] * 1e12))
    clump = 0.0
    for weight, length in CLUMPS:
        clump += weight * _path_at(plant, a / length, b / length, c / length)
    own = uniform_draw(mixed_bits(plant))
    own = 0.03 + 0.8 * own * own
    return (1.0 - own) * clump + own * path


@njit(cache=True, nogil=True)
def _path_at(plant: np.uint64, a: float, b: float, c: float) -> float:
    """Interpolate draws of the exponential distribution of mean 1 between the corners of the unit cell of a place."""
    i, j, k = math.floor(a), math.floor(b), math.floor(c)
    a, b, c = a - i, b - j, c - k
    path = 0.0
    for corner in range(8):
        di, dj, dk = corner & 1, (corner >> 1) & 1, corner >> 2
        cell = np.uint64(int(i) + di + 4096) << np.uint64(32) | np.uint64(int(j) + dj + 4096) << np.uint64(16)
        draw = uniform_draw(mixed_bits(np.uint64(plant ^ cell ^ np.uint64(int(k) + dk + 4096))))
        share = (a if di else 1.0 - a) * (b if dj else 1.0 - b) * (c if dk else 1.0 - c)
        path -= share * math.log(draw)
    return path
