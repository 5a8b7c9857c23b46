"""The clock of scans: which scan continues a session of tracking, which one is late, and where the clock jumps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, SupportsFloat

import numpy as np

from ..errors import StampError

SHORTEST_STEP_S = 1e-6  # a stamp that is less than this later than the last one is of a doubled scan
LATE_S = 0.25  # a stamp that is earlier by more than this is not of a late scan
GAP_S = 60.0  # a stamp that is later by more than this does not continue the session
MOST_LATE = 2  # late scans in a row; another one shows that the clock itself stepped back
LATEST_S = 1e12  # a clock that counts nanoseconds since 1970 is at 1.7e18

Step = Literal["next", "late", "jump", "return"]


class Stamp(float):
    """A time [s] that knows the whole nanoseconds it was recorded with; a float holds times of today to 0.2 us."""

    ns: int

    def __new__(cls, seconds: float, ns: int) -> Stamp:
        stamp = super().__new__(cls, seconds)
        stamp.ns = ns
        return stamp

    def __reduce__(self) -> tuple[type[Stamp], tuple[float, int]]:
        return Stamp, (float(self), self.ns)


def as_seconds(stamp_s: object, name: str = "stamp_s") -> float:
    """A time [s] as a float; raises StampError for a date, a text or whatever else is no number of seconds."""
    if isinstance(stamp_s, float):  # a `Stamp` stays one
        return stamp_s
    try:
        # A text can be converted, too, and numpy's times, but to their own units.
        if not isinstance(stamp_s, SupportsFloat) or isinstance(stamp_s, np.datetime64 | np.timedelta64):
            raise TypeError
        return float(stamp_s)
    except (OverflowError, TypeError, ValueError):
        raise StampError(
            f"{name} is {stamp_s!r:.80}, a {type(stamp_s).__name__}; expected the time of the scan [s]"
        ) from None


def nanoseconds_of(stamp_s: float) -> int:
    """A time [s] in whole nanoseconds."""
    return stamp_s.ns if isinstance(stamp_s, Stamp) else round(stamp_s * 1e9)


def step_between(last_s: float, stamp_s: float, gap_s: float = GAP_S) -> Literal["next", "late", "jump"]:
    """What a scan at ``stamp_s`` is after one at ``last_s``: the next one, a late or doubled one, or after a jump."""
    if last_s - LATE_S <= stamp_s <= last_s or last_s < stamp_s < last_s + SHORTEST_STEP_S:
        return "late"
    return "next" if last_s < stamp_s <= last_s + gap_s else "jump"


def elapsed_s(last_s: float, stamp_s: float) -> float:
    """Time between two scans [s]; 0 if the second one is late, or if the clock jumps between them."""
    return stamp_s - last_s if step_between(last_s, stamp_s) == "next" else 0.0


@dataclass(frozen=True, slots=True)
class Clock:
    """The times of the scans so far, as far as they decide about the next one.

    A jump begins a new session, but the former one is remembered until the next scan: if that scan continues the former
    session, the jump was the wrong stamp of a single scan, and the step is a ``"return"``. After `MOST_LATE` late scans
    in a row, one that is earlier than the last tracked scan is a jump, so a clock that steps back by less than `LATE_S`
    stops tracking for a few scans only.
    """

    last_s: float | None = None  # time of the last scan of the session [s]; None before the first
    former_s: float | None = None  # the same of the session before the last jump, until the next scan confirms the jump
    n_late: int = 0  # number of late scans since the last scan of the session
    gap_s: float = GAP_S  # longest step forward within a session [s]

    def after(self, stamp_s: float) -> tuple[Step, Clock]:
        """What a scan at a finite time is, and the clock after it."""
        begun = replace(self, last_s=stamp_s, former_s=None, n_late=0)
        if self.last_s is None:
            return "next", begun
        step = step_between(self.last_s, stamp_s, self.gap_s)
        former_s = -math.inf if self.former_s is None else self.former_s
        may_return = step_between(former_s, stamp_s, self.gap_s) == "next"
        if may_return and (step != "next" or former_s > self.last_s):  # of two sessions it continues the later one
            return "return", begun
        if step == "next":
            return "next", begun
        if step == "late" and (self.n_late < MOST_LATE or stamp_s >= self.last_s):
            return "late", replace(self, n_late=self.n_late + 1)
        return "jump", replace(begun, former_s=self.last_s if self.former_s is None else self.former_s)
