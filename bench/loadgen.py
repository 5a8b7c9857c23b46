"""Measure with MLPerf LoadGen in place of `scenarios`: it draws the scans, measures and writes its own logs."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from edgeperc.system.extras import require
from edgeperc.types.points import Floats32

from .scenarios import KeepGoing, Limits, Perceive, Timings, back_to_back

SUMMARY = "mlperf_log_summary.txt"
# MLPerf's early stopping needs this many queries for a 99.9th percentile.
QUERIES_FOR_P999 = 6636


def load() -> Any:
    """Import the module of the package ``mlcommons-loadgen``; `MissingExtraError` if it is not installed."""
    return require("mlperf_loadgen", "loadgen", "--loadgen", package="mlcommons-loadgen")


def single_stream(
    perceive: Perceive,
    scans: Sequence[Floats32],
    limits: Limits,
    *,
    folder: Path,
    keep_going: KeepGoing = lambda timings: True,
    on_start: Callable[[], None] = lambda: None,
) -> Timings:
    """MLPerf's single stream: LoadGen draws a scan, waits for its answer, draws the next, and writes its logs to
    ``folder``. The timings are those measured here, for the stages. Otherwise as `back_to_back`, but it cannot be
    stopped.
    """
    loadgen = load()
    timings = back_to_back(perceive, scans, Limits(0, 0.0, limits.warm_up_scans), keep_going=keep_going)
    on_start()
    first = timings.first_s = time.perf_counter()
    failed: list[Exception] = []

    def issue(queries: Sequence[Any]) -> None:
        for query in queries:
            if not failed:
                began = time.perf_counter()
                try:
                    perception = perceive(scans[query.index])
                except Exception as exc:  # this is LoadGen's thread; raised below, in ours
                    failed.append(exc)
                else:
                    took_ms = 1e3 * (time.perf_counter() - began)
                    timings.add(began - first, took_ms, took_ms, perception.stage_ms)
            loadgen.QuerySamplesComplete([loadgen.QuerySampleResponse(query.id, 0, 0)])
        keep_going(timings)

    settings = loadgen.TestSettings()
    settings.scenario = loadgen.TestScenario.SingleStream
    settings.mode = loadgen.TestMode.PerformanceOnly
    settings.min_query_count = limits.min_scans
    settings.min_duration_ms = round(1e3 * limits.min_seconds)
    settings.single_stream_target_latency_percentile = 0.999 if limits.min_scans >= QUERIES_FOR_P999 else 0.9
    logs = loadgen.LogSettings()
    logs.log_output.outdir = str(folder)
    logs.log_output.copy_summary_to_stdout = False
    logs.enable_trace = False
    sut = loadgen.ConstructSUT(issue, lambda: None)
    library = loadgen.ConstructQSL(len(scans), len(scans), lambda indices: None, lambda indices: None)
    try:
        loadgen.StartTestWithLogSettings(sut, library, settings, logs)
    finally:
        loadgen.DestroyQSL(library)
        loadgen.DestroySUT(sut)
    if failed:
        raise failed[0]
    return timings


def read_summary(folder: Path) -> dict[str, Any]:
    """Read the percentiles [ms], LoadGen's result and its summary."""
    text = (folder / SUMMARY).read_text(encoding="utf-8", errors="replace")
    figures: dict[str, Any] = {
        f"p{float(p):g}": int(ns) / 1e6
        for p, ns in re.findall(r"^([\d.]+) percentile latency \(ns\)\s*: (\d+)", text, re.M)
    }
    verdict = re.search(r"^Result is\s*: (\w+)", text, re.M)
    return figures | {"result": verdict[1] if verdict else None, "summary": text}
