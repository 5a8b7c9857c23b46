"""``edgeperc-bench soak``: does memory grow over many scans?"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc.zoo import DEFAULT

from ..samples import trend
from ..scenarios import Limits
from ..worker import MEMORY_SAMPLES, Job, Scenario
from .common import new_document

__all__ = ["soak_command"]

# Memory that a run may gain and still be called level [MB]; an allocator's pages come and go by about so much.
LEVEL_MB = 1.0

# Of a long run, the share that counts as warm-up of the allocator.
SETTLING_SHARE = 0.1


# soak


def soak_command(arguments: argparse.Namespace) -> int:
    from .. import inputs
    from ..measure import new_setting, repeat

    settling = round(SETTLING_SHARE * arguments.scans)
    with new_document("soak", arguments) as (document, live), tempfile.TemporaryDirectory() as folder:
        given = inputs.simulate(Path(folder), 8, arguments.sensor)
        document["input"] = given.told
        scenario = Scenario(
            "soak",
            given.files,
            Limits(arguments.scans - settling, 0.0, settling, max(1, arguments.scans // MEMORY_SAMPLES)),
        )
        job = Job(
            tuple(arguments.model or DEFAULT), arguments.provider, arguments.threads, arguments.sensor, (scenario,)
        )
        setting = new_setting(job)
        document["settings"].append(setting)
        try:
            repeat(setting, job, 1, document, live)
        finally:
            for each in setting["repeats"]:
                if "soak" in each["scenarios"]:
                    document["soak"] = memory_growth(each["scenarios"]["soak"]["rss_mb"], settling)
    return 0


def memory_growth(rss_mb: Sequence[Sequence[float]], settling: int) -> dict[str, Any]:
    """Whether memory grew.

    Parameters
    ----------
    rss_mb : sequence of (scans done, MB)
    settling : int
        Scans before the first of these.

    Returns
    -------
    dict
        ``verdict`` (grows, level, undecided), ``growth_mb`` over the run by a straight line and its ``growth_error_mb``
        (half of a 95 % interval), ``last_minus_first_mb``, ``sentences``. It grows where the interval lies above 0 and
        the growth above `LEVEL_MB`; it is level where the interval ends below `LEVEL_MB`.
    """
    done, mb = np.asarray(rss_mb, np.float64).reshape(-1, 2).T
    line = trend(done, mb)
    told: dict[str, Any] = {
        "verdict": "undecided",
        "growth_mb": None,
        "growth_error_mb": None,
        "last_minus_first_mb": None,
    }
    if math.isnan(line.slope):
        return told | {"sentences": ["undecided: too few samples of the memory for a line"]}
    span = float(done[-1] - done[0])
    growth, error = line.slope * span, line.error * span
    if growth + error <= LEVEL_MB:
        told["verdict"] = "level"
    elif growth - error > 0.0 and growth > LEVEL_MB:
        told["verdict"] = "grows"
    told |= {"growth_mb": growth, "growth_error_mb": error, "last_minus_first_mb": float(mb[-1] - mb[0])}
    sentences = [
        f"{told['verdict']}: {growth:+.3f} MB (+- {error:.3f}) over {span:,.0f} scans, after {settling:,} to settle",
        f"resident {mb[0]:.1f} MB first, {mb[-1]:.1f} MB last, {mb.max():.1f} MB at most; "
        f"slope {1e3 * line.slope:+.5f} MB per 1,000 scans (+- {1e3 * line.error:.5f}), from {len(mb):,} samples",
    ]
    return told | {"sentences": sentences}
