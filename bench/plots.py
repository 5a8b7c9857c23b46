"""Plots of a measurement (extra ``view``)."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from .document import pooled, scenario_names, stage_medians
from .samples import percentile

BLUE = "#3b6ea8"


def pictures(document: Mapping[str, Any]) -> list[str]:
    """A figure for each setting of a run, as ``<svg>``: histograms, stages, and the samples over time."""
    settings = document["settings"] if document["kind"] == "run" else []
    return [_picture(setting) for setting in settings if scenario_names(setting)]


def _picture(setting: Mapping[str, Any]) -> str:
    from matplotlib.figure import Figure

    names = [name for name in scenario_names(setting) if pooled(setting, name)]
    figure = Figure(figsize=(13.0, 2.6 * len(names) + 0.4), layout="constrained")
    for row, name in zip(figure.subplots(max(len(names), 1), 3, squeeze=False), names, strict=False):
        histogram, bars, series = row
        ms = np.asarray(pooled(setting, name))
        # One outlier would squeeze everything else into one bar: outliers count in the last bar.
        most = 3.0 * float(np.median(ms))
        n_beyond = int(np.count_nonzero(ms > most))
        histogram.hist(np.minimum(ms, most), bins=min(60, max(10, len(ms) // 10)), color=BLUE)
        histogram.axvline(percentile(ms, 50.0), color="#b3452c", linewidth=1.0)
        beyond = f" ({n_beyond:,} beyond {most:.0f})" if n_beyond else ""
        histogram.set(title=f"{name}: {len(ms):,} scans", xlabel=f"ms{beyond}", ylabel="scans", xlim=(0.0, None))
        medians = stage_medians(setting, name)
        drawn = bars.barh(list(medians)[::-1], list(medians.values())[::-1], color=BLUE)
        bars.bar_label(drawn, fmt="%.2f", padding=3, fontsize="small")
        bars.set(title="median of each stage", xlabel="ms")
        bars.margins(x=0.15)
        for k, repeat in enumerate(setting["repeats"], start=1):
            if name in repeat["scenarios"]:
                samples = repeat["scenarios"][name]
                series.plot(samples["start_s"], samples["ms"], linewidth=0.7, label=f"repeat {k}")
        series.set(title="over time", xlabel="s", ylabel="ms", ylim=(0.0, None))
        series.legend(fontsize="small")
    return as_svg(figure)


def as_svg(figure: Any) -> str:
    """A figure as one ``<svg>`` element."""
    from matplotlib import rc_context

    buffer = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "edgeperc"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    drawn = buffer.getvalue()
    return re.sub(r"<metadata>.*?</metadata>", "", drawn[drawn.index("<svg") :], flags=re.S)
