"""Fit a sensor's remission function, offline, from scans of any street (KUL-Seg 5)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from ..errors import PointsError, SensorError
from ..types.points import Floats, Floats32, Ints64, Points
from ..types.sensor import REMISSION_KINDS, RemissionFunction, SensorProfile
from .returns import returns

# Strata in which remissions of similar streets are compared: by range [m], then by the cosine of the incidence. The
# last one is for points that are not on a surface (leaves, single beams). Quantiles are at the middles of equal shares.
RANGE_EDGES_M = (3.0, 10.0, 25.0, 60.0)
COSINE_EDGES = (0.0, 0.35, 1.0)
N_STRATA = (len(RANGE_EDGES_M) - 1) * len(COSINE_EDGES)
N_SHARES = 20
MIN_POINTS = 200  # points in a stratum
FOLDS = 10
CELL_M = 0.8  # cubes in which surfaces are fitted
# Remissions of a narrower range are taken in parts of it: of 0..1, ln(1 + x) would be nearly a line. With scans of DDAD
# and Argoverse 2, which have 0..1, functions are off by 0.026 and 0.040 in place of 0.052 and 0.050.
LEAST_SCALE = 255.0

# fmt: off
REFERENCES: Mapping[str, tuple[tuple[float, tuple[float, ...]], ...]] = MappingProxyType(
    {
        # From 28 scans of 13 KITTI drives of the training set.
        "hdl-64e": (
            (0.272, (0.00, 0.00, 0.05, 0.10, 0.16, 0.18, 0.19, 0.21, 0.23, 0.25,
                     0.27, 0.28, 0.29, 0.30, 0.31, 0.32, 0.34, 0.36, 0.38, 0.45)),
            (0.166, (0.00, 0.00, 0.02, 0.09, 0.16, 0.18, 0.21, 0.25, 0.27, 0.28,
                     0.29, 0.30, 0.32, 0.33, 0.34, 0.36, 0.38, 0.39, 0.43, 0.52)),
            (0.107, (0.00, 0.00, 0.00, 0.00, 0.04, 0.11, 0.16, 0.19, 0.23, 0.25,
                     0.28, 0.29, 0.31, 0.33, 0.34, 0.36, 0.38, 0.41, 0.46, 0.57)),
            (0.095, (0.00, 0.00, 0.09, 0.16, 0.18, 0.20, 0.22, 0.25, 0.27, 0.28,
                     0.29, 0.30, 0.31, 0.32, 0.34, 0.36, 0.38, 0.40, 0.43, 0.50)),
            (0.061, (0.00, 0.00, 0.16, 0.22, 0.26, 0.29, 0.31, 0.32, 0.34, 0.35,
                     0.36, 0.37, 0.38, 0.40, 0.41, 0.43, 0.46, 0.49, 0.54, 0.63)),
            (0.179, (0.00, 0.00, 0.11, 0.16, 0.18, 0.20, 0.22, 0.24, 0.26, 0.28,
                     0.29, 0.31, 0.32, 0.34, 0.36, 0.38, 0.41, 0.45, 0.50, 0.60)),
            (0.007, (0.00, 0.00, 0.00, 0.00, 0.12, 0.15, 0.17, 0.18, 0.20, 0.22,
                     0.23, 0.25, 0.27, 0.29, 0.30, 0.31, 0.32, 0.35, 0.38, 0.45)),
            (0.031, (0.00, 0.00, 0.00, 0.09, 0.14, 0.18, 0.20, 0.22, 0.25, 0.26,
                     0.28, 0.29, 0.30, 0.32, 0.32, 0.34, 0.35, 0.37, 0.39, 0.46)),
            (0.082, (0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.09, 0.12,
                     0.15, 0.17, 0.19, 0.21, 0.24, 0.27, 0.29, 0.32, 0.36, 0.46)),
        )
    }
)
"""For each training sensor: share of the points, and quantiles of remission (0..1), in every stratum."""


def _terms(kind: str, x: Floats) -> Floats:
    if kind == "linear":
        return np.stack([np.ones_like(x), x], axis=1)
    if kind == "polynomial":
        return np.stack([np.ones_like(x), x, x * x], axis=1)
    return np.stack([np.ones_like(x), np.log1p(np.maximum(x, 0.0))], axis=1)


_EXPONENTS = np.exp(np.linspace(math.log(0.1), math.log(4.0), 60))


def _fitted(kind: str, x: Floats, y: Floats) -> Floats:
    """Coefficients of a function of this kind with the least squares."""
    if kind != "power":
        terms = _terms(kind, x)
        size = np.abs(terms).max(axis=0) + 1e-30  # columns of very different size would lose digits
        return np.asarray(np.linalg.lstsq(terms / size, y, rcond=None)[0] / size, np.float64)
    most = max(float(x.max()), 1e-30)
    terms = np.maximum(x[:, None] / most, 0.0) ** _EXPONENTS
    factors = (terms * y[:, None]).sum(axis=0) / ((terms**2).sum(axis=0) + 1e-30)
    best = int(((factors * terms - y[:, None]) ** 2).mean(axis=0).argmin())
    return np.array([factors[best] / most ** _EXPONENTS[best], _EXPONENTS[best]])


def _values(kind: str, x: Floats, coefficients: Floats) -> Floats:
    if kind == "power":
        return np.asarray(coefficients[0] * np.maximum(x, 0.0) ** coefficients[1], np.float64)
    return np.asarray(_terms(kind, x) @ coefficients, np.float64)


def fit_functions(
    raw: ArrayLike, wanted: ArrayLike, *, full_scale: float, to: str, source: str
) -> tuple[RemissionFunction, ...]:
    """Fit a line, a parabola, a logarithm and a power to pairs of remissions, the best in cross-validation first.

    A parabola is never worse than a line on the pairs it is fitted to, but it is the worst on held-back pairs, as in
    the paper (KUL-Seg, Table 5).

    raw, wanted : of the sensor to adapt, from 0 on with a range of ``full_scale``, and of the other at the same places,
        0..1.
    """
    finer = max(LEAST_SCALE / full_scale, 1.0)
    x, y = finer * np.asarray(raw, np.float64).ravel(), np.asarray(wanted, np.float64).ravel()
    if len(x) != len(y):
        raise SensorError(f"got {len(x)} raw values and {len(y)} wanted ones; expected as many of each")
    good = np.isfinite(x) & np.isfinite(y)
    order = np.argsort(x[good], kind="stable")
    x, y = x[good][order], y[good][order]
    if len(x) < 4 or np.ptp(x) == 0.0:
        raise SensorError(
            f"{len(x)} finite pairs of {len(np.unique(x))} raw values; expected scans with remission, for 4 that differ"
        )
    fold = np.arange(len(x)) % FOLDS
    found = []
    for kind in REMISSION_KINDS:
        errors = np.empty(len(x))
        for held in (fold == k for k in range(min(len(x), FOLDS))):
            errors[held] = _values(kind, x[held], _fitted(kind, x[~held], y[~held])) - y[held]
        rmse = math.sqrt(float(np.mean(errors**2)))
        best = tuple(float(c) for c in _fitted(kind, x, y))
        found.append(RemissionFunction(kind, best, finer * full_scale, to, rmse, source))
    return tuple(sorted(found, key=lambda function: function.rmse))


def incidences(points: Points) -> Floats:
    """Compute the cosine of the incidence, between each ray and the normal of the surface around its point in cubes of
    `CELL_M`; NaN if these have fewer than six returns, or no surface (leaves).
    """
    # Column by column: over rows of three values, numpy takes several times as long.
    x, y, z = np.ascontiguousarray(points[:, :3].T, np.float64)
    cosines = np.full(len(points), np.nan)
    finite = np.flatnonzero((np.abs(x) < 1e5) & (np.abs(y) < 1e5) & (np.abs(z) < 1e5))
    if not len(finite):
        return cosines
    p = [axis[finite] for axis in (x, y, z)]
    row, col, level = (np.floor(axis / CELL_M).astype(np.int64) for axis in p)
    _, cell = np.unique((row << 40) + (col << 20) + level, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell).astype(np.float64)
    off = [axis - (np.bincount(cell, axis) / count)[cell] for axis in p]
    spread = np.empty((len(count), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            spread[:, i, j] = spread[:, j, i] = np.bincount(cell, off[i] * off[j]) / count
    flat = count >= 6
    values, vectors = np.linalg.eigh(spread[flat])
    # The middle eigenvalue separates surfaces from the line of one beam, the smallest one separates them from leaves.
    normals = np.full((3, len(count)), np.nan)
    on_surface = (values[:, 1] > 0.0025) & (values[:, 0] < 0.1 * values[:, 1])
    normals[:, flat] = np.where(on_surface, vectors[:, :, 0].T, np.nan)
    along = sum(axis * normal[cell] for axis, normal in zip(p, normals, strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        cosines[finite] = np.abs(along) / np.sqrt(sum(axis * axis for axis in p))
    return cosines


def stratify(scan: Points, n_points: int | None = None) -> tuple[Ints64, Floats]:
    """Stratum by range and incidence, and remission of points; of about ``n_points``: all in some of the cubes."""
    if scan.ndim != 2 or scan.shape[1] != 4:
        raise PointsError(f"got an array of shape {scan.shape}; expected (n, 4): x, y, z, remission")
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = scan[:, :3].T
        square = x * x + y * y + z * z  # an eighth of the time of sum(axis=1)
        used = (square >= RANGE_EDGES_M[0] ** 2) & (square < RANGE_EDGES_M[-1] ** 2) & np.isfinite(scan[:, 3])
        every = 1 if n_points is None else np.count_nonzero(used) // max(n_points, 1)
        if every > 1:
            # Consecutive products of odd numbers, in int32 with overflow, spread neighboring cells evenly.
            spread = np.zeros(len(scan), np.int32)
            for axis, factor in ((x, 73856093), (y, 19349663), (z, 83492791)):
                spread += np.floor(axis / np.float32(CELL_M)).astype(np.int32) * np.int32(factor)
            used &= (spread >> 8) % every == 0
    kept = scan[used]
    x, y, z = kept[:, :3].T.astype(np.float64)
    range_m = np.sqrt(x * x + y * y + z * z)
    cosine = np.nan_to_num(incidences(kept), nan=np.inf)
    by_range = sum((range_m >= edge).astype(np.int64) for edge in RANGE_EDGES_M[1:-1])
    by_cosine = sum((cosine > edge).astype(np.int64) for edge in COSINE_EDGES[1:])
    return by_range * len(COSINE_EDGES) + by_cosine, kept[:, 3].astype(np.float64)


def remission_strata(scans: Iterable[Floats32]) -> list[tuple[float, tuple[float, ...]]]:
    """Compute the share of the points and `N_SHARES` quantiles of their remission in each stratum, as in `REFERENCES`;
    one of fewer than 200 points has a share of 0 and no quantiles.
    """
    return quantiles_by_stratum([stratify(scan) for scan in scans])


def quantiles_by_stratum(samples: Sequence[tuple[Ints64, Floats]]) -> list[tuple[float, tuple[float, ...]]]:
    """Compute what `remission_strata` does, from what `stratify` returned for each scan."""
    stratum = np.concatenate([np.empty(0, np.int64), *(strata for strata, _ in samples)])
    remission = np.concatenate([np.empty(0), *(remissions for _, remissions in samples)])
    found: list[tuple[float, tuple[float, ...]]] = []
    for k in range(N_STRATA):
        own = remission[stratum == k]
        enough = len(own) >= MIN_POINTS
        found.append((len(own) / len(remission), tuple(quantiles(own).tolist())) if enough else (0.0, ()))
    return found


def quantiles(values: Floats) -> Floats:
    """`N_SHARES` quantiles of values, at least one, at the middles of equal shares, (N_SHARES,)."""
    ordered = np.sort(values)  # with this, a third of the time of np.quantile
    shares = (np.arange(N_SHARES) + 0.5) / N_SHARES
    return np.interp(shares * (len(ordered) - 1), np.arange(len(ordered)), ordered)


def match_quantiles(
    strata: Sequence[tuple[float, Sequence[float]]], reference: Sequence[tuple[float, Sequence[float]]]
) -> tuple[Floats, Floats]:
    """Match remissions of two sensors in similar streets by quantile (`remission_strata`); no common scene is needed.

    Each stratum is weighted by the smaller of its two shares, so that a wider road or a sensor that looks higher up has
    no influence. Matching within each stratum was worse: the least-squares curve through all strata is too flat, and
    car IoU on PandaSet was 0.44 instead of 0.56.
    """
    both = [
        (min(share, other_share), own, other)
        for (share, own), (other_share, other) in zip(strata, reference, strict=True)
        if share > 0.0 and other_share > 0.0
    ]
    if not both:
        return np.empty(0), np.empty(0)
    weights = np.repeat([weight for weight, _, _ in both], N_SHARES)
    raw, wanted = (_weighted_quantiles(np.concatenate([row[side] for row in both]), weights) for side in (1, 2))
    return raw, wanted


def _weighted_quantiles(values: Floats, weights: Floats) -> Floats:
    """Quantiles of weighted values at the middles of equal shares."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    shares = (np.arange(N_SHARES) + 0.5) / N_SHARES
    return np.asarray(values[order][np.searchsorted(total, shares * total[-1])], np.float64)


def fit_sensor(
    scans: Sequence[Floats32], sensor: SensorProfile, to: str = "hdl-64e"
) -> tuple[SensorProfile, tuple[RemissionFunction, ...]]:
    """Fit remission functions to scans of any street: ``sensor`` with the best that does not decrease, and all."""
    if to not in REFERENCES:
        raise SensorError(f"no reference remissions of {to!r}; known are {', '.join(REFERENCES)}")
    low, high = sensor.remission_range
    raw, wanted = match_quantiles(remission_strata(_returns_of(scans, sensor)), REFERENCES[to])
    source = f"quantiles by range and incidence of {len(scans)} scans"
    functions = fit_functions(raw - low, wanted, full_scale=high - low, to=to, source=source)
    return replace(sensor, remission=increasing(functions)), functions


def _returns_of(scans: Iterable[Floats32], sensor: SensorProfile) -> Iterator[Floats32]:
    for scan in scans:
        if scan.ndim != 2 or scan.shape[1] != 4:
            raise PointsError(f"got an array of shape {scan.shape}; expected (n, 4): x, y, z, remission")
        yield returns(scan, sensor)[0]


def increasing(functions: Sequence[RemissionFunction]) -> RemissionFunction:
    """The first function that does not decrease up to full scale; all but parabolas, fitted to quantiles, do not."""

    def increases(function: RemissionFunction) -> bool:
        if function.kind != "polynomial":
            return True
        _, b, c = function.coefficients
        return b >= 0.0 and b + 2.0 * c * function.full_scale >= 0.0

    return next(filter(increases, functions))
