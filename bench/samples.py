"""Statistics of samples: percentiles, run-to-run noise, comparison of two runs, a trend with its error.

A percentile p is the smallest sample such that at least p per cent of the samples do not exceed it (nearest rank), so
it is a measured time. It is shown only if at least ten samples are expected above it, n >= 10 / (1 - p): 20 for the
median, 100 for p90, 1,000 for p99, 10,000 for p99.9. The number of samples above a percentile is binomial: ten of them
fix the share of the tail to within a third (1 / sqrt(10)); with one or two, a single outlier decides. MLPerf's early
stopping asks for 64, 662 and 6,636 queries for p90, p99 and p99.9.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter_ns

import numpy as np
from numpy.typing import ArrayLike

from edgeperc.types.points import Floats

PERCENTILES = (50.0, 90.0, 99.0, 99.9)
SAMPLES_ABOVE = 10
N_BLOCKS = 20
N_RESAMPLES = 2000


def elapsed_ms(call: Callable[[], object]) -> float:
    """Wall time of one call [ms]."""
    start = perf_counter_ns()
    call()
    return (perf_counter_ns() - start) / 1e6


def percentile(values: ArrayLike, p: float) -> float:
    """The smallest value that at least ``p`` per cent of the values do not exceed; NaN without values."""
    ordered = np.sort(np.asarray(values, np.float64))
    # Rounded, because 99.9 / 100 * 10,000 comes out slightly above 9,990.
    return float(ordered[max(math.ceil(round(p * len(ordered) / 100.0, 9)), 1) - 1]) if len(ordered) else math.nan


def supported(p: float, n: int) -> bool:
    """Whether ``n`` samples are enough for percentile ``p``."""
    return n * (100.0 - p) >= 100.0 * SAMPLES_ABOVE - 1e-6


def summary(values: ArrayLike) -> dict[str, float | int | None]:
    """``n``, ``p50``, ``p90``, ``p99``, ``p99.9`` and ``max``; None if there are too few samples."""
    array = np.asarray(values, np.float64)
    figures: dict[str, float | int | None] = {"n": len(array)}
    figures |= {f"p{p:g}": percentile(array, p) if supported(p, len(array)) else None for p in PERCENTILES}
    return figures | {"max": float(array.max()) if len(array) else None}


def noise_floor(repeats: Sequence[ArrayLike]) -> float | None:
    """Largest difference between the medians of repeated runs, as a share of their median; None for fewer than two."""
    medians = [percentile(repeat, 50.0) for repeat in repeats if np.size(repeat)]
    return (max(medians) - min(medians)) / float(np.median(medians)) if len(medians) > 1 else None


@dataclass(frozen=True)
class Verdict:
    """A run B compared with a run A."""

    word: str  # {"faster", "slower", "no difference", "unusable"}
    ratio: float  # median of B over that of A
    interval: tuple[float, float]  # 95 % bootstrap interval of the ratio
    noise: float  # the larger `noise_floor` of the two runs; NaN if a run was not repeated


def compare(a: Sequence[ArrayLike], b: Sequence[ArrayLike], seed: int = 0) -> Verdict:
    """Compare the repeats of run B with those of run A; "unusable" with fewer than two, which have no noise."""
    noises = [noise_floor(a), noise_floor(b)]
    if None in noises:
        return Verdict("unusable", math.nan, (math.nan, math.nan), math.nan)
    noise = max(n for n in noises if n is not None)
    rng = np.random.default_rng(seed)
    ratio = _middle(b) / _middle(a)
    low, high = np.percentile(_resampled(b, rng) / _resampled(a, rng), [2.5, 97.5])
    word = "no difference"
    # The bootstrap, of blocks because neighbors in time are correlated, alone is overconfident with three repeats.
    if not low <= 1.0 <= high and abs(ratio - 1.0) > noise:
        word = "slower" if ratio > 1.0 else "faster"
    return Verdict(word, ratio, (float(low), float(high)), noise)


def _middle(repeats: Sequence[ArrayLike]) -> float:
    return float(np.median([percentile(repeat, 50.0) for repeat in repeats if np.size(repeat)]))


def _resampled(repeats: Sequence[ArrayLike], rng: np.random.Generator) -> Floats:
    """Bootstrap medians, (N_RESAMPLES,)."""
    arrays = [np.asarray(repeat, np.float64) for repeat in repeats if np.size(repeat)]
    n_blocks = min(N_BLOCKS, *map(len, arrays))
    blocks = np.array([[np.median(block) for block in np.array_split(array, n_blocks)] for array in arrays])
    drawn = rng.integers(len(arrays), size=(N_RESAMPLES, len(arrays), 1))
    return np.median(
        np.median(blocks[drawn, rng.integers(n_blocks, size=(*drawn.shape[:2], n_blocks))], axis=2), axis=1
    )


@dataclass(frozen=True)
class Trend:
    """A straight line through samples."""

    slope: float
    error: float  # half of the slope's 95 % interval
    intercept: float
    r2: float  # share of the variance that the line explains; NaN if the variance is 0


def trend(x: ArrayLike, y: ArrayLike) -> Trend:
    """Fit a line by least squares; all NaN for fewer than three samples. Consecutive samples are not independent: with
    a lag-1 correlation r of the residuals, n samples count as n (1 - r) / (1 + r).
    """
    t, values = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if len(t) < 3 or np.ptp(t) == 0.0:
        return Trend(math.nan, math.nan, math.nan, math.nan)
    centered = t - t.mean()
    spread, variance = float(centered @ centered), float(np.sum((values - values.mean()) ** 2))
    slope = float(centered @ values) / spread
    left = values - values.mean() - slope * centered
    squares = float(left @ left)
    correlation = min(max(float(left[1:] @ left[:-1]) / squares, 0.0), 0.99) if squares > 0.0 else 0.0
    n_free = max(len(t) * (1.0 - correlation) / (1.0 + correlation) - 2.0, 1.0)  # neighbors are not independent
    error = 1.96 * math.sqrt(squares / n_free / spread)
    explained = 1.0 - squares / variance if variance > 0.0 else math.nan
    return Trend(slope, error, float(values.mean() - slope * t.mean()), explained)
