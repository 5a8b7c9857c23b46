"""How scans arrive: back to back, or paced at a sensor's rate. This module knows no models, processes or reports.

A scenario takes a callable, scans and a clock. It ends when both the minimum number of scans and the minimum time are
reached.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from edgeperc.types.points import Floats32

Perceive = Callable[[Floats32], Any]


class Clock:
    """The computer's monotonic clock; tests replace it."""

    def now(self) -> float:
        """Seconds since a moment that is the same for all processes of this computer."""
        return time.perf_counter()

    def sleep_until(self, due_s: float) -> None:
        """Sleep until a moment on this clock, so that cores can idle."""
        if (left := due_s - self.now()) > 0.0:
            time.sleep(left)


@dataclass(frozen=True)
class Limits:
    """How long a scenario lasts: until all limits are reached."""

    min_scans: int = 100
    min_seconds: float = 10.0
    warm_up_scans: int = 20  # before the first one that counts
    stride: int = 1  # every ``stride``-th scan leaves a sample: those of a long run would be memory growth


@dataclass
class Timings:
    """Measurements of one scenario, one number per sampled scan, in order."""

    n: int = 0  # scans perceived, without the warm-up
    stride: int = 1
    first_s: float = 0.0  # when the first scan that counts arrived, on the clock
    start_s: list[float] = field(default_factory=list)  # since then
    ms: list[float] = field(default_factory=list)  # from scan to result
    # from the arrival of the scan; ``ms`` if scans do not arrive at a rate
    age_ms: list[float] = field(default_factory=list)
    stage_ms: dict[str, list[float]] = field(default_factory=dict)  # 0 for a scan without this stage
    warm_up_ms: list[float] = field(default_factory=list)
    missed: int = 0  # results that were not complete when the next scan arrived
    skipped: int = 0  # scans that a newer one overtook; they have no sample

    def add(self, start_s: float, ms: float, age_ms: float, stage_ms: Mapping[str, float]) -> None:
        """Record one call."""
        self.n += 1
        if (self.n - 1) % self.stride:
            return
        for stage in {**self.stage_ms, **stage_ms}:  # some scans need no adaptation
            self.stage_ms.setdefault(stage, [0.0] * len(self.ms)).append(stage_ms.get(stage, 0.0))
        self.start_s.append(start_s)
        self.ms.append(ms)
        self.age_ms.append(age_ms)


KeepGoing = Callable[[Timings], bool]
"""Called after every scan, including the warm-up; False ends the scenario and keeps its measurements."""


def back_to_back(
    perceive: Perceive,
    scans: Sequence[Floats32],
    limits: Limits,
    *,
    rate_hz: float | None = None,
    clock: Clock | None = None,
    keep_going: KeepGoing = lambda timings: True,
    on_start: Callable[[], None] = lambda: None,
) -> Timings:
    """Perceive one scan after the other, the next as soon as there is a result (MLPerf's single stream), or, by
    ``rate_hz``, as they arrive: scan k at the first one's time plus k / rate, so that the schedule does not drift.
    Until then the thread sleeps, as in a vehicle; after a late result the newest scan is next. ``on_start`` is called
    between the warm-up, always back to back, and the first scan that counts.
    """
    clock = clock or Clock()
    timings = Timings(stride=limits.stride)
    for k in range(limits.warm_up_scans):
        began = clock.now()
        perceive(scans[k % len(scans)])
        timings.warm_up_ms.append(1e3 * (clock.now() - began))
        if not keep_going(timings):
            break
    on_start()
    first = timings.first_s = clock.now()
    k = 0
    while keep_going(timings) and (timings.n < limits.min_scans or clock.now() - first < limits.min_seconds):
        due = None
        if rate_hz is not None:
            newest = max(k, math.floor((clock.now() - first) * rate_hz + 1e-9))
            timings.skipped += newest - k
            k = newest
            due = first + k / rate_hz
            clock.sleep_until(due)
        began = clock.now()
        perception = perceive(scans[k % len(scans)])
        done, arrived = clock.now(), began if due is None else due
        timings.missed += rate_hz is not None and done > arrived + 1.0 / rate_hz
        timings.add(began - first, 1e3 * (done - began), 1e3 * (done - arrived), perception.stage_ms)
        k += 1
    return timings


def throughput(calls: Sequence[tuple[Sequence[float], Sequence[float]]]) -> tuple[float, float]:
    """Scans per second of processes' calls (start_s, ms) while all ran, NaN if they never did; for how long [s]."""
    ends = [np.asarray(start) + np.asarray(ms) / 1e3 for start, ms in calls]
    if not ends or not all(map(len, ends)):
        return math.nan, 0.0
    begin, end = max(start[0] for start, _ in calls), min(float(e[-1]) for e in ends)
    if end <= begin:
        return math.nan, 0.0
    n = 0.0
    for (start, _), finish in zip(calls, ends, strict=True):
        # A call that is partly outside the window counts with its share inside.
        shares = (np.minimum(finish, end) - np.maximum(start, begin)) / (finish - np.asarray(start))
        n += float(np.clip(shares, 0.0, 1.0).sum())
    return n / (end - begin), end - begin
