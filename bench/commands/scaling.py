"""``edgeperc-bench scaling``: how time grows with points, objects, image size and processes."""

from __future__ import annotations

import argparse
import importlib.util
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc.zoo import DEFAULT

from .. import report
from ..samples import percentile, trend
from ..scenarios import Limits
from ..worker import Job, Scenario
from .common import new_document
from .run import measure_offline

__all__ = ["scaling_command"]

# scaling


def scaling_command(arguments: argparse.Namespace) -> int:
    from .. import inputs
    from ..measure import new_setting, repeat

    if arguments.plot:
        report.require_matplotlib()
        arguments.plot.parent.mkdir(parents=True, exist_ok=True)
    limits = Limits(arguments.min_scans, arguments.min_seconds, min(arguments.warm_up, 5))
    with new_document("scaling", arguments) as (document, live), tempfile.TemporaryDirectory() as folder:
        live.say("simulating scans")
        makers = [("points", n, inputs.sized) for n in arguments.points] + [
            ("cars", n, inputs.crowd) for n in arguments.cars
        ]
        files = {
            (kind, n): inputs.store(Path(folder), f"{kind}{n}", make(n, arguments.sensor)) for kind, n, make in makers
        }
        scenarios = {key: Scenario(f"{key[1]:,} {key[0]}", (file,), limits) for key, file in files.items()}
        job = Job(tuple(arguments.model or DEFAULT), arguments.provider, arguments.threads, arguments.sensor)
        setting = new_setting(job)
        document["settings"].append(setting)
        repeat(setting, replace(job, scenarios=tuple(scenarios.values())), arguments.repeats, document, live)
        curves: dict[str, list[tuple[float, float]]] = {}
        for kind, unit in (("points", "1,000 points"), ("cars", "car")):
            counts = [n for of, n in scenarios if of == kind]
            ms = [percentile(report.pooled(setting, scenarios[kind, n].name), 50.0) for n in counts]
            curves[kind] = list(zip(counts, ms, strict=True))
            rows = []
            for n in counts:
                told = report.latency(setting, scenarios[kind, n].name)
                own = report.stage_medians(setting, scenarios[kind, n].name)
                beside = sum(took for stage, took in own.items() if stage != "infer")
                rows.append([f"{n:,}", *(report.number(told[q]) for q in ("p50", "p90")), report.number(beside)])
            words = _line(curves[kind], unit, 1000.0 if kind == "points" else 1.0)
            head = [kind, "p50 ms", "p90 ms", "beside the network ms"]
            document["tables"].append({"title": f"Growth with {kind}", "sentences": words, "head": head, "rows": rows})
        middle = min(files, key=lambda key: (key[0] != "points", abs(key[1] - 100_000)))
        curves["pixels %"] = _growth_with_images(document, live, job, arguments, Path(folder), files[middle], limits)
        most = document["machine"]["usable_cores"] or os.cpu_count() or 1
        counts = arguments.processes or sorted({*(2**k for k in range(most.bit_length())), most})
        for n in counts:
            measure_offline(setting, job, [files[middle]], n, limits, document, live)
        curves["processes"] = [(told["processes"], told["scans_per_s"] or math.nan) for told in setting["offline"]]
        one = curves["processes"][0][1] / curves["processes"][0][0]
        rows = [[str(n), report.number(rate), report.number(rate / one)] for n, rate in curves["processes"]]
        head = ["processes", "scans/s", "times one"]
        document["tables"].append({"title": "Growth with processes", "sentences": [], "head": head, "rows": rows})
        if arguments.plot:
            _plot(curves, arguments.plot)
    return 0


def _growth_with_images(
    document: dict[str, Any],
    live: report.LiveTable,
    job: Job,
    arguments: argparse.Namespace,
    folder: Path,
    scan: Path,
    limits: Limits,
) -> list[tuple[float, float]]:
    """The same networks, for views of more or fewer pixels."""
    from ..measure import new_setting, repeat

    head = ["pixels %", "p50 ms", "p90 ms", "beside the network ms"]
    table: dict[str, Any] = {"title": "Growth with image size", "sentences": [], "head": head, "rows": []}
    document["tables"].append(table)
    if not all(importlib.util.find_spec(name) for name in ("torch", "onnx")):
        table["sentences"] = ["not measured: pip install 'edgeperc[export]'"]
        return []
    from ..peers.networks import resized

    curve = []
    for percent in arguments.sizes:
        live.say(f"making networks for {percent} % of the pixels")
        models = tuple(str(resized(name, percent / 100.0, folder)) for name in job.models)
        scenario = Scenario(f"{percent} % of the pixels", (scan,), limits)
        setting = new_setting(own := replace(job, models=models, scenarios=(scenario,)))
        document["settings"].append(setting)
        repeat(setting, own, arguments.repeats, document, live)
        told, stages = report.latency(setting, scenario.name), report.stage_medians(setting, scenario.name)
        beside = sum(took for stage, took in stages.items() if stage != "infer")
        table["rows"].append([f"{percent}", *(report.number(told[q]) for q in ("p50", "p90")), report.number(beside)])
        curve.append((float(percent), float(told["p50"])))
    table["sentences"] = ["networks made anew, in fp32", *_line(curve, "per cent of the model's own image")]
    return curve


def _line(curve: Sequence[tuple[float, float]], unit: str, per: float = 1.0) -> list[str]:
    line = trend(*(np.array(curve, np.float64).reshape(-1, 2) / (per, 1.0)).T)
    if math.isnan(line.slope):
        return []
    told = f"{line.intercept:.2f} ms + {line.slope:.4f} ms per {unit} (+- {line.error:.4f}), R2 {line.r2:.4f}"
    return [f"a line through the medians: {told}"]


def _plot(curves: Mapping[str, Sequence[tuple[float, float]]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.6), layout="constrained")
    for axes, (kind, curve) in zip(figure.subplots(1, len(curves)), curves.items(), strict=True):
        axes.plot(*np.array(curve, np.float64).reshape(-1, 2).T, marker="o", color="#3b6ea8")
        axes.set(xlabel=kind, ylabel="scans a second" if kind == "processes" else "median ms", ylim=(0.0, None))
    if path.suffix == ".svg":
        path.write_text(report.as_svg(figure), encoding="utf-8")
    else:
        figure.savefig(path, dpi=150)
