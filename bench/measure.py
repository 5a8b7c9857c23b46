"""Repeats, accuracy, offline throughput and cold starts of one setting, put into a report's document as they come."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from edgeperc.simulation.scene import SimulatedScan

from .accuracy import agreement, agrees, correctness
from .context import conditions, spoilers
from .scenarios import Limits, throughput
from .worker import Answer, Job, OnTick, Scenario, WorkerError, measure

__all__ = ["cold_starts", "judged", "new_setting", "offline", "reference", "repeat"]


def new_setting(job: Job) -> dict[str, Any]:
    """The document of one setting, nothing measured yet."""
    return {
        "models": list(job.models),
        "provider": job.provider,
        "n_threads": job.n_threads,
        "sensor": job.sensor,
        "repeats": [],
        "accuracy": None,
        "offline": [],
        "cold_start": [],
        "loadgen": None,
    }


def repeat(
    setting: dict[str, Any], job: Job, n_repeats: int, document: dict[str, Any], on_tick: OnTick
) -> list[Answer]:
    """Do a job in as many fresh processes, one after the other; each goes into ``setting`` when it is done.

    Returns
    -------
    answers : list of Answer
        Of the first process.

    Raises
    ------
    KeyboardInterrupt
        After what was measured by then is in ``setting``.
    """
    answers: list[Answer] = []
    for k in range(n_repeats):
        (result,) = measure([job if k == 0 else replace(job, answers=())], on_tick)
        answers += result.pop("answers")
        setting["repeats"].append(result)
        for name, each in result["scenarios"].items():
            for words in spoilers(document["machine"], each["before"], each["after"], each["cpu_s"]):
                document["spoilers"].append(f"{name}, repeat {k + 1}: {words}")
        if result["interrupted"]:
            raise KeyboardInterrupt
    return answers


def reference(job: Job, files: Sequence[Path]) -> list[Answer]:
    """Answers of fp32 on onnxruntime's stock CPU provider."""
    (result,) = measure([Job(job.models, "cpu", None, job.sensor, answers=tuple(files))])
    if result["interrupted"]:
        raise KeyboardInterrupt
    answers: list[Answer] = result["answers"]
    return answers


def judged(right: Sequence[Answer], found: Sequence[Answer], truth: Sequence[SimulatedScan]) -> dict[str, Any]:
    """The accuracy that stands beside a setting's speed."""
    accuracy: dict[str, Any] = {
        "agreement": agreement(right, found),
        "truth": correctness(found, truth) if truth else None,
        "reference_truth": correctness(right, truth) if truth else None,
    }
    return accuracy | {"agrees": agrees(accuracy)}


def offline(job: Job, files: Sequence[Path], n_processes: int, limits: Limits, on_tick: OnTick) -> dict[str, Any]:
    """Several processes, each back to back; one thread each unless the job says otherwise."""
    name = f"offline x {n_processes}"
    own = replace(job, n_threads=job.n_threads or 1, scenarios=(Scenario(name, tuple(files), limits),))
    before = conditions()
    results = measure([own] * n_processes, on_tick)
    parts = [result["scenarios"][name] for result in results if name in result["scenarios"]]
    stamps = [([part["first_s"] + start for start in part["start_s"]], part["ms"]) for part in parts]
    scans_per_s, seconds = throughput(stamps)
    n_scans = sum(part["n"] for part in parts)
    return {
        "processes": n_processes,
        "n_threads": own.n_threads,
        "scans_per_s": None if math.isnan(scans_per_s) else scans_per_s,
        "seconds": seconds,
        "n_scans": n_scans,
        "cpu_s_per_scan": sum(part["cpu_s"] for part in parts) / n_scans if n_scans else None,
        "rss_mb": sum(result["rss_mb"] for result in results),
        "parts": parts,
        "before": before,
        "after": conditions(),
        "interrupted": any(result["interrupted"] for result in results),
    }


def cold_starts(job: Job, scan: Path, n: int) -> list[dict[str, Any]]:
    """Start a process, perceive one scan, and do it again: the first finds empty caches, the others what it left there.

    Caches are numba's and whatever keeps to the user's cache folder. The operating system has the files in memory.
    """
    told = []
    with tempfile.TemporaryDirectory() as folder:
        cache = {"NUMBA_CACHE_DIR": folder, "XDG_CACHE_HOME": folder, "LOCALAPPDATA": folder}
        for k in range(n):
            request = {"models": list(job.models), "provider": job.provider, "n_threads": job.n_threads}
            request |= {"sensor": job.sensor, "scan": str(scan), "spawned_s": time.perf_counter()}
            command = [sys.executable, "-m", "edgeperc_bench.start", json.dumps(request)]
            done = subprocess.run(command, env=os.environ | cache, capture_output=True, text=True)
            if done.returncode:
                raise WorkerError(
                    f"a fresh process ended with exit code {done.returncode} before its first answer: "
                    f"{done.stderr.strip()[-2000:] or 'it said nothing'}"
                )
            steps: Mapping[str, Any] = json.loads(done.stdout)
            told.append({"start": "first" if k == 0 else f"again ({k})", **steps})
    return told
