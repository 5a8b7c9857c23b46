"""Measure one setting (repeats, accuracy, offline throughput, cold starts) and record it in a document immediately."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from edgeperc.errors import SettingsError
from edgeperc.simulation.scene import SimulatedScan
from edgeperc.system.machine import settings_path

from .accuracy import agreement, agrees, correctness
from .context import conditions, disturbances
from .render import LiveTable
from .scenarios import Limits, throughput
from .worker import Job, OnTick, Prediction, Scenario, WorkerError, measure, settings_of


def new_setting(job: Job, document: dict[str, Any] | None = None) -> dict[str, Any]:
    """The record of one setting as asked for, with nothing measured yet; it is added to a document."""
    setting = settings_of(job) | {"repeats": [], "accuracy": None, "offline": [], "cold_start": [], "loadgen": None}
    if document is not None:
        document["settings"].append(setting)
    return setting


def repeat(
    setting: dict[str, Any], job: Job, n_repeats: int, document: dict[str, Any], on_tick: OnTick
) -> list[Prediction]:
    """Do a job in so many fresh processes, each recorded in ``setting`` when done; returns the first's predictions."""
    predictions: list[Prediction] = []
    for k in range(n_repeats):
        (result,) = measure([job if k == 0 else replace(job, predict=())], on_tick)
        predictions += result.pop("predictions")
        setting["repeats"].append(result)
        for name, scenario in result["scenarios"].items():
            states = scenario["before"], scenario["after"], scenario["cpu_s"]
            for disturbance in disturbances(document["machine"], *states):
                document["disturbances"].append(f"{name}, repeat {k + 1}: {disturbance}")
        if result["interrupted"]:
            raise KeyboardInterrupt
    return predictions


@dataclass(frozen=True)
class Reference:
    """Predictions to compare with, one per scan, and the engines that made them."""

    predictions: list[Prediction]
    engines: list[str]


def reference(job: Job, files: Sequence[Path]) -> Reference:
    """Predictions of a job's models in fp32 on the CPU provider; a model given by its path runs as it is stored."""
    models = tuple(
        model if Path(model).suffix == ".onnx" else f"{model.partition(':')[0]}:fp32" for model in job.models
    )
    (result,) = measure([Job(models, provider="cpu", sensor=job.sensor, full_turn=job.full_turn, predict=tuple(files))])
    if result["interrupted"]:
        raise KeyboardInterrupt
    return Reference(result["predictions"], [engine["description"] for engine in result["engines"]])


def accuracy_of(right: Reference, found: Sequence[Prediction], truth: Sequence[SimulatedScan]) -> dict[str, Any]:
    """The accuracy of a setting, which is reported with its speed."""
    accuracy: dict[str, Any] = {
        "reference": right.engines,
        "agreement": agreement(right.predictions, found),
        "truth": correctness(found, truth) if truth else None,
        "reference_truth": correctness(right.predictions, truth) if truth else None,
    }
    return accuracy | {"agrees": agrees(accuracy)}


def offline(
    setting: dict[str, Any],
    job: Job,
    files: Sequence[Path],
    n: int,
    limits: Limits,
    document: dict[str, Any],
    live: LiveTable,
) -> None:
    """Measure the throughput of several processes into ``setting``, each back to back, by default with one thread each;
    raises KeyboardInterrupt if it was interrupted.
    """
    live.note(f"offline, {n} processes")
    name = f"offline x {n}"
    own = replace(job, n_threads=job.n_threads or 1, scenarios=(Scenario(name, tuple(files), limits),))
    before = conditions()
    results = measure([own] * n, live)
    after = conditions()
    parts = [result["scenarios"][name] for result in results if name in result["scenarios"]]
    stamps = [([part["first_s"] + start for start in part["start_s"]], part["ms"]) for part in parts]
    scans_per_s, seconds = throughput(stamps)
    n_scans, cpu_s = sum(part["n"] for part in parts), sum(part["cpu_s"] for part in parts)
    interrupted = any(result["interrupted"] for result in results)
    setting["offline"].append(
        {
            "processes": n,
            "n_threads": own.n_threads,
            "scans_per_s": None if math.isnan(scans_per_s) else scans_per_s,
            "seconds": seconds,
            "n_scans": n_scans,
            "cpu_s_per_scan": cpu_s / n_scans if n_scans else None,
            "rss_mb": sum(result["rss_mb"] for result in results),
            "parts": parts,
            "before": before,
            "after": after,
            "interrupted": interrupted,
        }
    )
    for disturbance in disturbances(document["machine"], before, after, cpu_s):
        # The start-up of the measuring processes would count as work of other processes.
        if not disturbance.startswith("other processes"):
            document["disturbances"].append(f"{name}: {disturbance}")
    if interrupted:
        raise KeyboardInterrupt


def cold_starts(job: Job, scan: Path, n: int) -> list[dict[str, Any]]:
    """Start processes that perceive one scan: the first finds empty caches of kernels and compiled models, the others
    what it cached, and all the settings that were measured here. The operating system keeps the files in memory.
    """
    starts = []
    with tempfile.TemporaryDirectory() as folder:
        with suppress(OSError, SettingsError):  # there is none
            shutil.copy(settings_path(), folder)
        environment = os.environ | {"NUMBA_CACHE_DIR": folder, "EDGEPERC_CACHE_DIR": folder}
        # An installed package has its byte code; to compile a checkout's sources at every start takes 0.2 s.
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        for k in range(n):
            request = settings_of(job) | {"scan": str(scan), "spawned_s": time.perf_counter(), "on_mismatch": "warn"}
            command = [sys.executable, "-m", "edgeperc_bench.start", json.dumps(request)]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            if done.returncode:
                raise WorkerError(
                    f"a fresh process ended with exit code {done.returncode} before its first result: "
                    f"{done.stderr.strip()[-2000:] or 'it printed nothing'}"
                )
            steps: Mapping[str, Any] = json.loads(done.stdout)
            starts.append({"start": "first" if k == 0 else f"again ({k})", **steps})
    return starts
