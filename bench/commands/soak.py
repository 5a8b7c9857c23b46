"""``edgeperc-bench soak``: test whether memory grows over many scans."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from edgeperc.cli.arguments import count

from ..options import add_command
from ..samples import trend
from ..scenarios import Limits
from ..worker import MEMORY_SAMPLES, Scenario
from .common import job_of, new_document

# Growth up to this counts as level [MB]: an allocator's pages vary by about as much.
LEVEL_MB = 1.0
# The share of the scans during which the allocator settles.
SETTLING_SHARE = 0.1


def add_parser(subparsers: Any) -> None:
    add = add_command(
        subparsers,
        "soak",
        run_command,
        ("model", "engine", "output"),
        help="tell whether memory grows over a long run",
        description="Run many simulated scans in one process and fit a line to its memory.",
    )
    least = partial(count, least=1000)
    add("--scans N", "the number of scans, 1000 at least (default: %(default)s)", type=least, default=20_000)
    add("--application", "also stream, track, write JSON and draw every 100th scan, as applications do (extra 'view')")


def run_command(arguments: argparse.Namespace) -> int:
    """Run the scans, and report on the memory even when they are interrupted."""
    from .. import inputs
    from ..measure import new_setting, repeat

    settling = round(SETTLING_SHARE * arguments.scans)
    with new_document("soak", arguments) as (document, live, folder):
        scans = inputs.simulated_input(folder, 8, arguments.sensor)
        document["input"] = scans.record
        limits = Limits(arguments.scans - settling, 0.0, settling, max(1, arguments.scans // MEMORY_SAMPLES))
        scenario = Scenario("soak", scans.files, limits, application=arguments.application)
        job = replace(job_of(arguments), scenarios=(scenario,))
        setting = new_setting(job, document)
        try:
            repeat(setting, job, 1, document, live)
        finally:
            for each in setting["repeats"]:
                if "soak" in each["scenarios"]:
                    document["soak"] = memory_growth(each["scenarios"]["soak"]["rss_mb"], settling)
    return 0


def memory_growth(rss_mb: Sequence[Sequence[float]], settling: int) -> dict[str, Any]:
    """Whether memory, samples of (scans done, MB), grew after settling: if the 95 % interval of a line's growth lies
    above 0 and the growth above `LEVEL_MB`; it is level if the interval ends below `LEVEL_MB`.
    """
    done, mb = np.asarray(rss_mb, np.float64).reshape(-1, 2).T
    line = trend(done, mb)
    if math.isnan(line.slope):
        unknown = dict.fromkeys(("growth_mb", "growth_error_mb", "last_minus_first_mb"))
        return {"verdict": "undecided", **unknown, "sentences": ["undecided: too few samples of the memory for a line"]}
    span = float(done[-1] - done[0])
    growth, error = line.slope * span, line.error * span
    verdict = "undecided"
    if growth + error <= LEVEL_MB:
        verdict = "level"
    elif growth - error > 0.0 and growth > LEVEL_MB:
        verdict = "grows"
    return {
        "verdict": verdict,
        "growth_mb": growth,
        "growth_error_mb": error,
        "last_minus_first_mb": float(mb[-1] - mb[0]),
        "sentences": [
            f"{verdict}: {growth:+.3f} MB (+- {error:.3f}) over {span:,.0f} scans, after {settling:,} to settle",
            f"resident memory: {mb[0]:.1f} MB first, {mb[-1]:.1f} MB last, {mb.max():.1f} MB at most; "
            f"slope {1e3 * line.slope:+.5f} MB per 1,000 scans (+- {1e3 * line.error:.5f}), from {len(mb):,} samples",
        ],
    }
