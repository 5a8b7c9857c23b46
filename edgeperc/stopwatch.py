"""The time that each stage of a perception takes."""

from __future__ import annotations

import time

__all__ = ["STAGES", "Stopwatch"]

STAGES = ("check", "project", "infer", "decode", "refine", "cluster", "agree")


class Stopwatch:
    """Sum of the wall time of each stage [ms].

    Attributes
    ----------
    ms : dict of str to float
    """

    def __init__(self) -> None:
        self.ms = dict.fromkeys(STAGES, 0.0)
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = time.perf_counter()
        self.ms[stage] = self.ms.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now
