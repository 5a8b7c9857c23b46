"""``edgeperc-bench run``: latency of one setting in every scenario."""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from edgeperc.zoo import DEFAULT

from .. import context, loadgen, report
from ..options import DEFAULT_SCENARIOS, SINGLE_STREAM
from ..scenarios import Limits
from ..worker import Job, Scenario
from .common import new_document, prepare_input

__all__ = ["measure_offline", "run_command"]

# run


def run_command(arguments: argparse.Namespace) -> int:
    from ..measure import cold_starts, judged, new_setting, reference, repeat

    if arguments.loadgen:
        loadgen.require()
        arguments.loadgen.mkdir(parents=True, exist_ok=True)
    wanted = list(dict.fromkeys(arguments.scenario or DEFAULT_SCENARIOS))
    limits = Limits(arguments.min_scans, arguments.min_seconds, arguments.warm_up)
    with new_document("run", arguments) as (document, live), tempfile.TemporaryDirectory() as folder:
        given = prepare_input(arguments, Path(folder), document, live)
        arriving = tuple(
            Scenario(name, given.files, limits, float(name.partition(":")[2]) if name != SINGLE_STREAM else None)
            for name in wanted
            if name == SINGLE_STREAM or name.startswith("paced")
        )
        job = Job(tuple(arguments.model or DEFAULT), arguments.provider, arguments.threads, arguments.sensor, arriving)
        setting = new_setting(job)
        document["settings"].append(setting)
        live.say(f"{arguments.repeats} repeats of {', '.join(s.name for s in arriving) or 'nothing but the start'}")
        answers = repeat(setting, replace(job, answers=given.files), arguments.repeats, document, live)
        live.say("comparing the answers with fp32 on the stock CPU provider")
        setting["accuracy"] = judged(reference(job, given.files), answers, given.truth)
        for name in wanted:
            kind, _, value = name.partition(":")
            if kind == "offline":
                n = int(value or document["machine"]["usable_cores"] or os.cpu_count() or 1)
                measure_offline(setting, job, given.files, n, limits, document, live)
            elif kind == "cold-start":
                live.say("cold starts")
                setting["cold_start"] = cold_starts(job, given.files[0], 1 + arguments.repeats)
        if arguments.loadgen:
            _loadgen(setting, job, given.files, limits, arguments.loadgen, live)
    return 0


def measure_offline(
    setting: dict[str, Any],
    job: Job,
    files: Sequence[Path],
    n: int,
    limits: Limits,
    document: dict[str, Any],
    live: report.LiveTable,
) -> None:
    from ..measure import offline

    live.say(f"offline, {n} processes")
    told = offline(job, files, n, limits, live)
    setting["offline"].append(told)
    cpu_s = sum(part["cpu_s"] for part in told["parts"])
    for words in context.spoilers(document["machine"], told["before"], told["after"], cpu_s):
        # What the processes take to get ready is other processes' work by this count.
        if not words.startswith("other processes"):
            document["spoilers"].append(f"offline x {n}: {words}")
    if told["interrupted"]:
        raise KeyboardInterrupt


def _loadgen(
    setting: dict[str, Any], job: Job, files: Sequence[Path], limits: Limits, folder: Path, live: report.LiveTable
) -> None:
    from ..measure import new_setting, repeat

    live.say(f"MLPerf LoadGen, logs in {folder}")
    driven = replace(job, scenarios=(Scenario("loadgen", tuple(files), limits),), loadgen=folder)
    scratch = new_setting(driven)
    repeat(scratch, driven, 1, {"machine": {"logical_cores": os.cpu_count()}, "spoilers": []}, live)
    setting["loadgen"] = loadgen.told(folder) | {"samples": scratch["repeats"][0]["scenarios"]["loadgen"]}
