"""``edgeperc-bench run``: latency of one setting in every scenario."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

from .. import loadgen
from ..options import SINGLE_STREAM, add_command, add_limits, scenario
from ..worker import Scenario
from .common import job_of, limits_of, new_document, prepare_input

DEFAULT_SCENARIOS = (SINGLE_STREAM, "paced:10", "paced:20", "offline", "cold-start")


def add_parser(subparsers: Any) -> None:
    add = add_command(
        subparsers,
        "run",
        run_command,
        ("model", "scans", "engine", "output", "page"),
        help="measure one setting (the default command)",
        description="Measure the latency of one setting, each scenario in fresh processes, and compare its results "
        "with fp32 on the CPU.",
    )
    add_limits(add, min_scans=100, min_seconds=10.0, repeats=3)
    add(
        "--scenario S",
        f"{SINGLE_STREAM} (back to back), paced:HZ (scans arrive at this rate), offline or offline:PROCESSES "
        "(throughput of several processes), cold-start (from starting a process to its first answer); may be repeated "
        f"(default: {', '.join(DEFAULT_SCENARIOS)})",
        action="append",
        type=scenario,
    )
    add("--full-turn", "run the range-image model on all four quarters of the turn (default: only the quarter ahead)")
    add("--loadgen DIR", "measure with MLPerf LoadGen, too, and keep its logs in DIR (needs the extra 'loadgen')")


def run_command(arguments: argparse.Namespace) -> int:
    """Measure the scenarios one after the other."""
    from ..measure import accuracy_of, cold_starts, new_setting, offline, reference, repeat

    if arguments.loadgen:
        loadgen.load()
        arguments.loadgen.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(arguments.scenario or DEFAULT_SCENARIOS))
    limits = limits_of(arguments)
    with new_document("run", arguments) as (document, live, folder):
        scans = prepare_input(arguments, folder, document, live)
        scenarios = tuple(
            Scenario(name, scans.files, limits, float(name.partition(":")[2]) if name != SINGLE_STREAM else None)
            for name in names
            if name == SINGLE_STREAM or name.startswith("paced")
        )
        job = replace(job_of(arguments), scenarios=scenarios)
        setting = new_setting(job, document)
        live.note(f"{arguments.repeats} repeats of {', '.join(s.name for s in scenarios) or 'nothing but the start'}")
        predictions = repeat(setting, replace(job, predict=scans.files), arguments.repeats, document, live)
        live.note("comparing the results with fp32 on the CPU provider")
        setting["accuracy"] = accuracy_of(reference(job, scans.files), predictions, scans.truth)
        for name in names:
            kind, _, value = name.partition(":")
            if kind == "offline":
                n = int(value or document["machine"]["usable_cores"])
                offline(setting, job, scans.files, n, limits, document, live)
            elif kind == "cold-start":
                live.note("cold starts")
                setting["cold_start"] = cold_starts(job, scans.files[0], 1 + arguments.repeats)
        if arguments.loadgen:
            logs = arguments.loadgen
            live.note(f"MLPerf LoadGen, logs in {logs}")
            driven = replace(job, scenarios=(Scenario("loadgen", scans.files, limits),), loadgen=logs)
            scratch = new_setting(driven)
            repeat(scratch, driven, 1, document, live)
            samples = scratch["repeats"][0]["scenarios"]["loadgen"]
            setting["loadgen"] = loadgen.read_summary(logs) | {"samples": samples}
    return 0
