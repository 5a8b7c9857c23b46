"""What was measured, as a document: JSON that holds every sample, and tables and pages made from it.

The JSON (``schema`` 1) has ``kind`` (run, matrix, scaling, soak, peers), ``command``, ``complete``, ``machine``,
``software``, ``input``, ``spoilers`` and, by kind, ``settings`` (a list: models, provider, threads, ``repeats`` with
all samples, ``accuracy``, ``offline``, ``cold_start``, ``loadgen``), ``skipped``, ``recommended``, ``tables``, ``soak``
or ``peers`` (by table, of each contender the samples of each round). All that is shown is computed from it.
"""

from __future__ import annotations

import html
import io
import json
import math
import re
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from edgeperc import EdgepercError, MissingExtraError

from .samples import noise_floor, percentile, summary

__all__ = [
    "LiveTable",
    "ReportError",
    "Section",
    "html_page",
    "latency",
    "markdown",
    "pooled",
    "read_report",
    "repeats_ms",
    "require_matplotlib",
    "scenario_names",
    "sections",
    "text",
    "write_report",
]

SCHEMA = 1
KINDS = ("run", "matrix", "scaling", "soak", "peers")
WORDY = 24  # characters from which a column holds words, not numbers
QUANTILES = ("p50", "p90", "p99", "p99.9", "max")


class ReportError(EdgepercError):
    """A file is no report, or one of another schema."""


def write_report(document: Mapping[str, Any], path: Path) -> None:
    """Write a document as JSON."""
    path.write_text(json.dumps(document, allow_nan=False) + "\n", encoding="utf-8")


def read_report(path: Path) -> dict[str, Any]:
    """Read what `write_report` wrote.

    Raises
    ------
    ReportError
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as exc:
        raise ReportError(f"{path} cannot be read as a report: {exc}") from exc
    if not isinstance(document, dict) or document.get("schema") != SCHEMA or document.get("kind") not in KINDS:
        raise ReportError(f"{path} is no report of schema {SCHEMA}; expected what edgeperc-bench wrote with --json")
    return document


def scenario_names(setting: Mapping[str, Any]) -> list[str]:
    """Of one setting, in the order of measuring."""
    return list(dict.fromkeys(name for repeat in setting["repeats"] for name in repeat["scenarios"]))


def repeats_ms(setting: Mapping[str, Any], scenario: str, key: str = "ms") -> list[list[float]]:
    """Samples of each repeat that has any."""
    found = [repeat["scenarios"][scenario][key] for repeat in setting["repeats"] if scenario in repeat["scenarios"]]
    return [samples for samples in found if samples]


def pooled(setting: Mapping[str, Any], scenario: str, key: str = "ms") -> list[float]:
    """Samples of all repeats, put together."""
    return [value for samples in repeats_ms(setting, scenario, key) for value in samples]


def latency(setting: Mapping[str, Any], scenario: str) -> dict[str, Any]:
    """Everything that is told of one scenario in one number each; None for what is unknown or not supported."""
    parts = [repeat["scenarios"][scenario] for repeat in setting["repeats"] if scenario in repeat["scenarios"]]
    ms = pooled(setting, scenario)
    n, wall_s = sum(part["n"] for part in parts), sum(part["wall_s"] for part in parts)
    rails = {rail for part in parts for rail in part["energy_j"] or {}}
    return summary(ms) | {
        "noise": noise_floor(repeats_ms(setting, scenario)),
        "cpu_s_per_scan": sum(part["cpu_s"] for part in parts) / n if n else None,
        "cores": sum(part["cpu_s"] for part in parts) / wall_s if wall_s else None,
        "rss_mb": max((part["rss_mb"][-1][1] for part in parts if part["rss_mb"]), default=None),
        "energy_j_per_scan": {r: sum(part["energy_j"][r] for part in parts) / n for r in sorted(rails)} if n else {},
        "age": summary(pooled(setting, scenario, "age_ms")),
        "missed": sum(part["missed"] for part in parts),
        "skipped": sum(part["skipped"] for part in parts),
        "rate_hz": parts[0]["rate_hz"] if parts else None,
    }


@dataclass(frozen=True)
class Section:
    """A piece of a report, however it is shown: sentences, then a table whose first row is its head."""

    title: str
    sentences: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


def text(parts: Iterable[Section]) -> str:
    """For a terminal."""
    lines: list[str] = []
    for part in parts:
        lines += ["", part.title, *(f"  {sentence}" for sentence in part.sentences)]
        lines += _aligned(part.rows)
    return "\n".join(lines[1:])


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    if not rows:
        return []
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    right = [k > 0 and width <= WORDY for k, width in enumerate(widths)]
    cells = [
        [
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(row, widths, right, strict=True)
        ]
        for row in rows
    ]
    return [f"  {'  '.join(row)}".rstrip() for row in cells]


def markdown(parts: Iterable[Section], title: str) -> str:
    """For a repository."""

    def plain(cell: str) -> str:
        return re.sub(r"([\\`*_{}\[\]<>|#])", r"\\\1", cell)

    lines = [f"# {plain(title)}"]
    for part in parts:
        lines += ["", f"## {plain(part.title)}", *([""] if part.sentences else [])]
        lines += [f"- {plain(sentence)}" for sentence in part.sentences]
        if part.rows:
            head, *body = part.rows
            lines += ["", f"| {' | '.join(map(plain, head))} |", "|---" + "|---:" * (len(head) - 1) + "|"]
            lines += [f"| {' | '.join(map(plain, row))} |" for row in body]
    return "\n".join(lines) + "\n"


STYLE = """body{font:15px/1.45 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;color:#1c2430}
h2{margin-top:2.2rem}table{border-collapse:collapse;font-variant-numeric:tabular-nums}
td,th{padding:.2rem .7rem;border-bottom:1px solid #d8dee6;text-align:right}
td:first-child,th:first-child,.words{text-align:left}
svg{max-width:100%;height:auto}"""


def html_page(parts: Iterable[Section], title: str, pictures: Sequence[str] = ()) -> str:
    """A page that needs nothing from elsewhere.

    Parameters
    ----------
    parts : iterable of Section
    title : str
    pictures : sequence of str
        ``<svg>`` elements; shown after the second section.
    """
    say = html.escape
    body = [f"<h1>{say(title)}</h1>"]
    for k, part in enumerate(parts):
        body.append(f"<h2>{say(part.title)}</h2>")
        body += [f"<p>{say(sentence)}</p>" for sentence in part.sentences]
        if part.rows:
            rows = [
                "<tr>" + "".join(_cell(tag, cell) for cell in row) + "</tr>"
                for row, tag in zip(part.rows, ["th", *["td"] * (len(part.rows) - 1)], strict=True)
            ]
            body.append(f"<table>{''.join(rows)}</table>")
        if k == 1:
            body += [f"<figure>{picture}</figure>" for picture in pictures]
    head = f'<meta charset="utf-8"/><title>{say(title)}</title><style>{STYLE}</style>'
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>\n' + "\n".join(body) + "\n</body></html>\n"


def _cell(tag: str, words: str) -> str:
    style = ' class="words"' if len(words) > WORDY else ""
    return f"<{tag}{style}>{html.escape(words)}</{tag}>"


def number(value: float | None, digits: int = 2) -> str:
    """A number of a table; a dash for what is unknown or not supported by the samples."""
    return "-" if value is None or math.isnan(value) else f"{value:,.{digits}f}"


def share(value: float | None) -> str:
    """A share in per cent, or a dash."""
    return "-" if value is None or math.isnan(value) else f"{100.0 * value:.1f} %"


def sections(document: Mapping[str, Any]) -> list[Section]:
    """A document in words and tables."""
    parts = [_reliability(document)]
    if document["kind"] == "matrix":
        parts.append(_matrix(document))
    for setting in document.get("settings", ()) if document["kind"] == "run" else ():
        parts += _setting(setting)
    for table in document.get("tables", ()):
        parts.append(Section(table["title"], table["sentences"], [table["head"], *table["rows"]]))
    if document.get("soak"):
        parts.append(Section("Memory over a long run", document["soak"]["sentences"]))
    return [*parts, *_context(document)]


def _reliability(document: Mapping[str, Any]) -> Section:
    sentences = [] if document["complete"] else ["interrupted: what follows is what there was by then"]
    sentences += [f"disturbed: {words}" for words in document["spoilers"]]
    return Section("How far to trust this", sentences or ["nothing was seen that disturbs the measurement"])


def _setting(setting: Mapping[str, Any]) -> list[Section]:
    names = scenario_names(setting)
    told = {name: latency(setting, name) for name in names}
    parts: list[Section] = []
    if names:
        head = ["scenario", "scans", *QUANTILES, "noise", "CPU s/scan", "cores", "RSS MB"]
        rows = [
            [
                *(name, f"{t['n']:,}", *(number(t[q]) for q in QUANTILES), share(t["noise"])),
                *(number(t["cpu_s_per_scan"], 4), number(t["cores"]), number(t["rss_mb"], 0)),
            ]
            for name, t in told.items()
        ]
        n = len(setting["repeats"])
        words = [
            f"scan in, answer out, in ms; {n} repeat{'s' * (n != 1)}, each a fresh process; a dash where the samples "
            "support no such percentile; noise: spread of the repeats' medians"
        ]
        for name, t in told.items():
            if t["energy_j_per_scan"]:
                rails = ", ".join(f"{rail} {joules:.3f} J" for rail, joules in t["energy_j_per_scan"].items())
                words.append(f"energy a scan, {name}, the whole package or board with all that ran on it: {rails}")
        if all(not t["energy_j_per_scan"] for t in told.values()):
            words.append("energy: this machine exposes no counter that can be read")
        parts.append(Section("Latency", words, [head, *rows]))
    paces = {name: t for name, t in told.items() if t["rate_hz"]}
    if paces:
        head = ["scenario", *QUANTILES, "missed", "skipped", "start late, max"]
        rows = []
        for name, t in paces.items():
            late = [age - ms for age, ms in zip(pooled(setting, name, "age_ms"), pooled(setting, name), strict=True)]
            counts = [f"{t['missed']:,}", f"{t['skipped']:,}", number(max(late, default=None))]
            rows.append([name, *(number(t["age"][q]) for q in QUANTILES), *counts])
        words = [
            "age of an answer when it is there, in ms since its scan arrived; missed: not there when the next scan "
            "came; skipped: overtaken by a newer scan; between scans the process sleeps, on an absolute monotonic "
            "schedule"
        ]
        parts.append(Section("Paced", words, [head, *rows]))
    if names:
        parts += [_stages(setting, names), _starts(setting)]
    if setting.get("offline"):
        head = ["processes", "threads each", "scans/s", "seconds", "scans", "CPU s/scan"]
        rows = [
            [
                *(str(o["processes"]), str(o["n_threads"]), number(o["scans_per_s"]), number(o["seconds"], 1)),
                *(f"{o['n_scans']:,}", number(o["cpu_s_per_scan"], 4)),
            ]
            for o in setting["offline"]
        ]
        parts.append(
            Section("Offline", ["several processes at once, back to back, while all of them run"], [head, *rows])
        )
    if setting.get("cold_start"):
        steps = ("interpreter_s", "import_s", "read_s", "construct_s", "first_call_s", "total_s")
        head = ["start", *(step.removesuffix("_s").replace("_", " ") for step in steps), "peak RSS MB"]
        rows = [
            [each["start"], *(number(each[step], 3) for step in steps), number(each["peak_rss_mb"], 0)]
            for each in setting["cold_start"]
        ]
        words = ["seconds from starting a process to its first answer; the first start finds no compiled kernels"]
        parts.append(Section("Cold start", words, [head, *rows]))
    if setting.get("loadgen"):
        told_by = setting["loadgen"]
        quantiles = ", ".join(f"{key} {value:.2f} ms" for key, value in told_by.items() if key.startswith("p"))
        parts.append(Section("MLPerf LoadGen, single stream", [f"result {told_by['result']}: {quantiles}"]))
    if setting.get("accuracy"):
        parts.append(Section("Accuracy of these answers", accuracy_sentences(setting["accuracy"])))
    return parts


def _stages(setting: Mapping[str, Any], names: Sequence[str]) -> Section:
    rows = [["stage", *(f"{name}, {word}" for name in names for word in ("p50", "share"))]]
    medians = {name: stage_medians(setting, name) for name in names}
    for stage in dict.fromkeys(stage for of in medians.values() for stage in of):
        row = [stage]
        for of in medians.values():
            total = sum(of.values())
            row += [number(of.get(stage)), share(of[stage] / total if stage in of and total else None)]
        rows.append(row)
    return Section("Stages", ["medians in ms"], rows)


def stage_medians(setting: Mapping[str, Any], name: str) -> dict[str, float]:
    """Median milliseconds of each stage; ``outside`` is what a call takes beyond its stages."""
    parts = [repeat["scenarios"][name] for repeat in setting["repeats"] if name in repeat["scenarios"]]
    stages = dict.fromkeys(stage for part in parts for stage in part["stage_ms"])
    values = {stage: [v for part in parts for v in part["stage_ms"].get(stage, ())] for stage in stages}
    outside = [ms - sum(of[k] for of in part["stage_ms"].values()) for part in parts for k, ms in enumerate(part["ms"])]
    return {stage: percentile(v, 50.0) for stage, v in (values | {"outside": outside}).items() if v}


def _starts(setting: Mapping[str, Any]) -> Section:
    rows = [
        ["repeat", "construct s", "first call ms", "warm-up scans", "warm-up p50 ms", "peak RSS MB", "of it scans MB"]
    ]
    for k, repeat in enumerate(setting["repeats"], start=1):
        warm = [ms for each in repeat["scenarios"].values() for ms in each["warm_up_ms"]]
        rows.append(
            [
                *(str(k), number(repeat["construct_s"], 3), number(repeat["first_call_ms"]), f"{len(warm):,}"),
                *(number(percentile(warm, 50.0)), number(repeat["peak_rss_mb"], 0), number(repeat["scans_mb"], 0)),
            ]
        )
    return Section("Before the samples", ["none of this is part of the figures above"], rows)


def accuracy_sentences(accuracy: Mapping[str, Any]) -> list[str]:
    """Of one setting."""
    told = accuracy["agreement"]
    words = []
    for kind in ("points", "cells"):
        if told[kind] is not None:
            words.append(
                f"{share(told[kind]['equal'])} of the {kind}' labels equal, mean IoU {share(told[kind]['mean_iou'])}"
            )
    if told["boxes"] is not None:
        words.append(
            "{n_both} boxes in common of {n_found} found and {n_reference} of the reference".format(**told["boxes"])
        )
    sentences = [f"against fp32 on the stock CPU provider, {told['n_scans']} scans: " + "; ".join(words)]
    if accuracy["truth"] is None:
        return [*sentences, "no truth is known of these scans: edgeperc eval has figures on labelled ones"]
    for name, kept in (("against the truth", "truth"), ("the reference against the truth", "reference_truth")):
        figures = [f"{key.replace('_', ' ')} {share(v)}" for key, v in accuracy[kept].items() if v is not None]
        sentences.append(f"{name}: " + ", ".join(figures))
    return [*sentences, "a few scans check an engine; how good a model is, edgeperc eval tells"]


def _matrix(document: Mapping[str, Any]) -> Section:
    rows = [
        [
            "model",
            "provider",
            "threads",
            "p50",
            "p90",
            "p99",
            "noise",
            "CPU s/scan",
            "peak RSS MB",
            "labels equal",
            "agrees",
        ]
    ]
    for setting in document["settings"]:
        for name in scenario_names(setting):
            t, accuracy = latency(setting, name), setting["accuracy"]
            equal = [
                accuracy["agreement"][kind]["equal"] for kind in ("points", "cells") if accuracy["agreement"][kind]
            ]
            peaks = [repeat["peak_rss_mb"] or math.nan for repeat in setting["repeats"]]
            rows.append(
                [
                    *("+".join(setting["models"]), setting["provider"], str(setting["n_threads"] or "its choice")),
                    *(number(t["p50"]), number(t["p90"]), number(t["p99"]), share(t["noise"])),
                    *(number(t["cpu_s_per_scan"], 4), number(max(peaks), 0), share(min(equal, default=None))),
                    "yes" if accuracy["agrees"] else "no",
                ]
            )
    words = [f"skipped: {each}" for each in document["skipped"]]
    words += [f"recommended for {each['name']}: {each['words']}" for each in document["recommended"]]
    return Section("Settings, back to back, ms", words, rows if len(rows) > 1 else [])


def _context(document: Mapping[str, Any]) -> list[Section]:
    rows = [["what", "how"]]
    engines = {
        (e["name"], e["sha256"], e["provider"], str(e["options"])): e
        for setting in document.get("settings", ())
        for repeat in setting["repeats"]
        for e in repeat["engines"]
    }
    for e in engines.values():
        options = ", ".join(f"{key} {value}" for key, value in e["options"].items())
        how = f"{e['provider']}, {options}, SHA-256 {e['sha256']}"
        rows.append([f"{e['name']} {e['version']}", how])
    rows += (
        [["input", f"{document['input']['source']}; sensor {document['input']['sensor']}"]] if document["input"] else []
    )
    if document["input"]:
        points = document["input"]["n_points"]
        rows.append(["points a scan", f"{min(points):,} to {max(points):,}"])
        rows.append(["input SHA-256", document["input"]["sha256"]])
    for group in ("machine", "software"):
        rows += [[key.replace("_", " "), _told(value)] for key, value in document[group].items()]
    rows.append(["command", document["command"]])
    heard = [words for setting in document.get("settings", ()) for r in setting["repeats"] for words in r["warnings"]]
    return [Section("Context", list(dict.fromkeys(heard)), rows)]


def _told(value: Any) -> str:
    if value is None:
        return "not exposed"
    if isinstance(value, dict):
        return ", ".join(f"{k}={v}" for k, v in value.items()) or "none set"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def require_matplotlib() -> None:
    """Raise `MissingExtraError` before anything is measured that could not be drawn."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as exc:
        raise MissingExtraError("matplotlib", "view", "A page with plots") from exc


def pictures(document: Mapping[str, Any]) -> list[str]:
    """A figure for each setting of a run, as ``<svg>``: histograms, stages, and the samples over time."""
    return [
        _picture(setting) for setting in document["settings"] if document["kind"] == "run" and scenario_names(setting)
    ]


def _picture(setting: Mapping[str, Any]) -> str:
    from matplotlib.figure import Figure

    names = [name for name in scenario_names(setting) if pooled(setting, name)]
    figure = Figure(figsize=(13.0, 2.6 * len(names) + 0.4), layout="constrained")
    for row, name in zip(figure.subplots(max(len(names), 1), 3, squeeze=False), names, strict=False):
        histogram, bars, series = row
        ms = np.asarray(pooled(setting, name))
        # The longest hiccup would squeeze everything else into one bar: it counts with the last.
        most = 3.0 * float(np.median(ms))
        n_beyond = int(np.count_nonzero(ms > most))
        histogram.hist(np.minimum(ms, most), bins=min(60, max(10, len(ms) // 10)), color="#3b6ea8")
        histogram.axvline(percentile(ms, 50.0), color="#b3452c", linewidth=1.0)
        beyond = f" ({n_beyond:,} beyond {most:.0f})" if n_beyond else ""
        histogram.set(title=f"{name}: {len(ms):,} scans", xlabel=f"ms{beyond}", ylabel="scans", xlim=(0.0, None))
        medians = stage_medians(setting, name)
        drawn = bars.barh(list(medians)[::-1], list(medians.values())[::-1], color="#3b6ea8")
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


@dataclass
class LiveTable:
    """The samples so far, on a terminal; where there is none, a line whenever something is done."""

    stream: TextIO = field(default_factory=lambda: sys.stderr)
    ms: dict[str, list[float]] = field(default_factory=dict)
    _lines: int = 0
    _next_s: float = 0.0

    def __call__(self, name: str, ms: Sequence[float]) -> None:
        """Take in the milliseconds of some calls of a scenario, and show it twice a second."""
        self.ms.setdefault(name, []).extend(ms)
        now = time.perf_counter()
        if self.stream.isatty() and now >= self._next_s:
            self._next_s = now + 0.5
            self.clear()
            rows = [["scenario", "scans", *QUANTILES, "last"]]
            for each, values in self.ms.items():
                told = summary(values)
                rows.append(
                    [
                        each,
                        f"{len(values):,}",
                        *(number(told[q]) for q in QUANTILES),
                        number(values[-1] if values else None),
                    ]
                )
            lines = _aligned(rows)
            self.stream.write("\n".join(lines) + "\n")
            self.stream.flush()
            self._lines = len(lines)

    def say(self, words: str) -> None:
        """A line that stays."""
        self.clear()
        self.stream.write(f"edgeperc-bench: {words}\n")
        self.stream.flush()

    def clear(self) -> None:
        """Take the table away again."""
        if self._lines:
            self.stream.write(f"\x1b[{self._lines}A\x1b[J")
            self.stream.flush()
        self._lines = 0
