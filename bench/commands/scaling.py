"""``edgeperc-bench scaling``: how time grows with points, objects, image size and processes."""

from __future__ import annotations

import argparse
import importlib.util
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc import ModelError
from edgeperc.cli.output import make_places
from edgeperc.system.atomic import write_atomic
from edgeperc.system.extras import require

from .. import plots
from ..document import latency, stage_medians
from ..options import add_command, add_limits, numbers
from ..render import LiveTable, number
from ..samples import trend
from ..worker import Job, Scenario
from .common import job_of, limits_of, new_document

POINT_COUNTS = (10_000, 20_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000)
CAR_COUNTS = (0, 4, 8, 16, 28)
SIZES = (50, 100, 200, 400)
Curve = list[tuple[float, float]]


def add_parser(subparsers: Any) -> None:
    add = add_command(
        subparsers,
        "scaling",
        run_command,
        ("model", "engine", "output"),
        help="measure how the time grows with points, cars, image size and processes",
        description="Measure how the time of a scan grows with its number of points, with the number of cars in it, "
        "with the size of the networks' images and with the number of processes.",
    )
    add_limits(add, min_scans=20, min_seconds=1.0, repeats=1)

    def add_counts(option: str, least: int, most: int | None, default: Sequence[int] | None, text: str) -> None:
        shown = "1, 2, 4 .. up to the cores" if default is None else ",".join(map(str, default))
        help = f"{text}, with commas between them (default: {shown})"
        add(f"{option} N,N", help, type=numbers(least, most), default=default)

    add_counts("--points", 100, None, POINT_COUNTS, "numbers of points in a scan")
    add_counts("--cars", 0, CAR_COUNTS[-1], CAR_COUNTS, f"numbers of cars in a scan, {CAR_COUNTS[-1]} at most")
    sizes = "image sizes in per cent of the model's own pixels, with random weights (needs the extra 'export')"
    add_counts("--sizes", 25, 1600, SIZES, sizes)
    add_counts("--processes", 1, None, None, "numbers of concurrent processes")
    add("--plot FILE", "draw the curves to a .svg or .png file (needs the extra 'view')")


def run_command(arguments: argparse.Namespace) -> int:
    """Measure the four curves."""
    from .. import inputs
    from ..measure import new_setting, offline, repeat

    if arguments.plot:
        require("matplotlib", "view", "Drawing the curves")
    make_places(arguments.plot)
    limits = replace(limits_of(arguments), warm_up_scans=min(arguments.warm_up, 5))
    with new_document("scaling", arguments) as (document, live, folder):
        live.note("simulating scans")
        scenarios = {}
        for kind, counts, make in (("points", arguments.points, inputs.sized), ("cars", arguments.cars, inputs.crowd)):
            for n in counts:
                file = inputs.store(folder, f"{kind}{n}", make(n, arguments.sensor))
                scenarios[kind, n] = Scenario(f"{n:,} {kind}", (file,), limits)
        job = job_of(arguments)
        setting = new_setting(job, document)
        repeat(setting, replace(job, scenarios=tuple(scenarios.values())), arguments.repeats, document, live)
        curves: dict[str, Curve] = {}
        for kind, unit, per in (("points", "1,000 points", 1000.0), ("cars", "car", 1.0)):
            settings = [(n, setting, scenarios[of, n].name) for of, n in scenarios if of == kind]
            curves[kind] = _add_table(document, kind, settings, unit, per)
        scan = scenarios[min(scenarios, key=lambda key: (key[0] != "points", abs(key[1] - 100_000)))].scans[0]
        curves["pixels %"] = _growth_with_images(document, live, job, arguments, folder, scan)
        cores = document["machine"]["usable_cores"]
        for n in arguments.processes or sorted({*(2**k for k in range(cores.bit_length())), cores}):
            offline(setting, job, [scan], n, limits, document, live)
        curves["processes"] = [(each["processes"], each["scans_per_s"] or math.nan) for each in setting["offline"]]
        one = dict(curves["processes"]).get(1, math.nan)
        rows = [[f"{n}", number(rate), number(rate / one)] for n, rate in curves["processes"]]
        head = ["processes", "scans/s", "times one"]
        document["tables"].append({"title": "Growth with processes", "sentences": [], "head": head, "rows": rows})
        if arguments.plot:
            _plot(curves, arguments.plot)
    return 0


def _add_table(
    document: dict[str, Any],
    kind: str,
    settings: Sequence[tuple[int, Mapping[str, Any], str]],
    unit: str,
    per: float = 1.0,
    sentences: Sequence[str] = (),
) -> Curve:
    """Add the table of one curve, (count, setting, scenario) by row, with a straight line through its medians."""
    rows, curve = [], []
    for n, setting, scenario in settings:
        measured, stages = latency(setting, scenario), stage_medians(setting, scenario)
        beside = sum(ms for stage, ms in stages.items() if stage != "infer")
        rows.append([f"{n:,}", number(measured["p50"]), number(measured["p90"]), number(beside)])
        curve.append((float(n), math.nan if measured["p50"] is None else float(measured["p50"])))
    line = trend(*(np.array(curve, np.float64).reshape(-1, 2) / (per, 1.0)).T)
    fitted = f"{line.intercept:.2f} ms + {line.slope:.4f} ms per {unit} (+- {line.error:.4f}), R2 {line.r2:.4f}"
    said = [*sentences, *([] if math.isnan(line.slope) else [f"a straight line through the medians: {fitted}"])]
    head = [kind, "p50 ms", "p90 ms", "beside the network ms"]
    document["tables"].append({"title": f"Growth with {kind}", "sentences": said, "head": head, "rows": rows})
    return curve


def _growth_with_images(
    document: dict[str, Any], live: LiveTable, job: Job, arguments: argparse.Namespace, folder: Path, scan: Path
) -> Curve:
    """The same networks, for views of more or fewer pixels."""
    from ..measure import new_setting, repeat

    unit = "per cent of the model's own image"
    if not all(importlib.util.find_spec(name) for name in ("torch", "onnx")):
        return _add_table(document, "pixels %", [], unit, sentences=["not measured: pip install 'edgeperc[export]'"])
    from ..peers.networks import resized

    limits, settings = limits_of(arguments), []
    live.note("making networks for more and fewer pixels")
    try:
        made = {n: tuple(str(resized(name, n / 100.0, folder)) for name in job.models) for n in arguments.sizes}
    except ModelError as exc:  # a network made elsewhere
        return _add_table(document, "pixels %", [], unit, sentences=[f"not measured: {exc}"])
    for percent, models in made.items():
        scenario = Scenario(f"{percent} % of the pixels", (scan,), limits)
        own = replace(job, models=models, precision=job.precision.replace("int8", "fp32"), scenarios=(scenario,))
        setting = new_setting(own, document)
        repeat(setting, own, arguments.repeats, document, live)
        settings.append((percent, setting, scenario.name))
    said = "new networks with random weights, stored in fp32; those without an image as they are"
    return _add_table(document, "pixels %", settings, unit, sentences=[said])


def _plot(curves: Mapping[str, Curve], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.6), layout="constrained")
    for axes, (kind, curve) in zip(figure.subplots(1, len(curves)), curves.items(), strict=True):
        axes.plot(*np.array(curve, np.float64).reshape(-1, 2).T, marker="o", color=plots.BLUE)
        axes.set(xlabel=kind, ylabel="scans a second" if kind == "processes" else "median ms", ylim=(0.0, None))
    if path.suffix == ".svg":
        write_atomic(path, plots.as_svg(figure).encode())
    else:
        figure.savefig(path, dpi=150)
