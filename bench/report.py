"""A document as sections of sentences and tables, for `render`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from edgeperc.system.printable import many

from .document import latency, pooled, scenario_names, setting_label, stage_medians
from .render import QUANTILES, Section, number, share
from .samples import percentile, supported


def sections(document: Mapping[str, Any]) -> list[Section]:
    """Every section of a document, in the order in which they are shown."""
    sentences = [] if document["complete"] else ["interrupted: only what was measured before is shown"]
    sentences += [f"disturbed: {sentence}" for sentence in document["disturbances"]]
    warned = [text for setting in document["settings"] for r in setting["repeats"] for text in r["warnings"]]
    sentences += [f"warning: {text}" for text in dict.fromkeys(warned)]
    parts = [Section("Reliability", sentences or ["no disturbance was seen"])]
    if document["kind"] == "matrix":
        parts.append(_matrix(document))
    runs = document["settings"] if document["kind"] == "run" else []
    for setting in runs:
        parts += _setting(setting)
    for table in document["tables"]:
        parts.append(Section(table["title"], table["sentences"], [table["head"], *table["rows"]]))
    if document["soak"]:
        parts.append(Section("Memory over a long run", document["soak"]["sentences"]))
    verdicts = filter(None, map(verdict, runs))
    return [*parts, *_context(document), *(Section("Verdict", [sentence]) for sentence in verdicts)]


def verdict(setting: Mapping[str, Any]) -> str:
    """Which rates a setting keeps, every result complete before the next scan arrives, with how much to spare of 99 %
    of them, or of all if they are too few; 10 Hz by scans back to back without a paced scenario. Empty without samples.
    """
    figures = {name: latency(setting, name) for name in scenario_names(setting)}
    judged = [t for t in figures.values() if t["rate_hz"]] or [*figures.values()][:1]
    parts = []
    for t in judged:
        rate_hz, n = t["rate_hz"] or 10.0, t["n"] + t["skipped"]
        slow_ms = t["age"]["max"] if t["age"]["p99"] is None else t["age"]["p99"]
        if slow_ms is None:
            continue
        spare, late = 1.0 - slow_ms * rate_hz / 1e3, t["missed"] + t["skipped"]
        if late == 0 and spare >= 0.0:
            parts.append(f"keeps {rate_hz:g} Hz with {100.0 * spare:.0f} % to spare")
        elif late:
            parts.append(f"does not keep {rate_hz:g} Hz: {late:,} of {n:,} scans were answered late or skipped")
        else:
            parts.append(f"does not keep {rate_hz:g} Hz: a scan takes {slow_ms:.0f} ms of {1e3 / rate_hz:.0f}")
    back_to_back = " (judged by scans back to back)" if parts and not judged[0]["rate_hz"] else ""
    return f"{setting_label(setting)}: {'; '.join(parts)}{back_to_back}" if parts else ""


def _setting(setting: Mapping[str, Any]) -> list[Section]:
    names = scenario_names(setting)
    figures = {name: latency(setting, name) for name in names}
    parts: list[Section] = []
    if names:
        head = ["scenario", "scans", *QUANTILES, "noise", "CPU s/scan", "cores", "RSS MB"]
        rows = []
        for name, t in figures.items():
            costs = number(t["cpu_s_per_scan"], 4), number(t["cores"]), number(t["rss_mb"], 0)
            rows.append([name, f"{t['n']:,}", *(number(t[q]) for q in QUANTILES), share(t["noise"]), *costs])
        n = len(setting["repeats"])
        sentences = [
            f"from scan to result in ms; {many(n, 'repeat')}, each in a fresh process; a dash: too few samples "
            "for this percentile; noise: spread of the repeats' medians"
        ]
        used = {name: t["energy_j_per_scan"] for name, t in figures.items() if t["energy_j_per_scan"]}
        for name, joules in used.items():
            rails = ", ".join(f"{rail} {each:.3f} J" for rail, each in joules.items())
            what = "of the whole package or board with everything that ran on it"
            sentences.append(f"energy of a scan, {name}, {what}: {rails}")
        sentences += [] if used else ["energy: this machine has no counter that can be read"]
        parts.append(Section("Latency", sentences, [head, *rows]))
    paces = {name: t for name, t in figures.items() if t["rate_hz"]}
    if paces:
        head = ["scenario", *QUANTILES, "missed", "skipped", "start late, max"]
        rows = []
        for name, t in paces.items():
            late = [age - ms for age, ms in zip(pooled(setting, name, "age_ms"), pooled(setting, name), strict=True)]
            counts = [f"{t['missed']:,}", f"{t['skipped']:,}", number(max(late, default=None))]
            rows.append([name, *(number(t["age"][q]) for q in QUANTILES), *counts])
        sentences = [
            "age of a result when it is complete, in ms since its scan arrived; missed: not complete when the next "
            "scan arrived; skipped: overtaken by a newer scan; between scans the process sleeps on an absolute "
            "schedule"
        ]
        parts.append(Section("Paced", sentences, [head, *rows]))
    if names:
        parts += [_stages(setting, names), _starts(setting)]
    if setting["offline"]:
        head = ["processes", "threads each", "scans/s", "seconds", "scans", "CPU s/scan"]
        rows = []
        for o in setting["offline"]:
            rate = number(o["scans_per_s"]), number(o["seconds"], 1), f"{o['n_scans']:,}"
            rows.append([str(o["processes"]), str(o["n_threads"]), *rate, number(o["cpu_s_per_scan"], 4)])
        sentences = ["several concurrent processes, each back to back; counted while all of them run"]
        parts.append(Section("Offline", sentences, [head, *rows]))
    if setting["cold_start"]:
        steps = ("interpreter_s", "import_s", "read_s", "construct_s", "first_call_s", "total_s")
        head = ["start", *(step.removesuffix("_s").replace("_", " ") for step in steps), "peak RSS MB"]
        rows = [
            [start["start"], *(number(start[step], 3) for step in steps), number(start["peak_rss_mb"], 0)]
            for start in setting["cold_start"]
        ]
        sentences = [
            "seconds from starting a process to its first result; the first start finds empty caches of kernels and "
            "models; the peak RSS is without the helper processes that compile a part of the kernels"
        ]
        parts.append(Section("Cold start", sentences, [head, *rows]))
    if setting["loadgen"]:
        summary = setting["loadgen"]
        n = summary["samples"]["n"]
        shown = [key for key in summary if key.startswith("p") and supported(float(key[1:]), n)]
        quantiles = ", ".join(f"{key} {summary[key]:.2f} ms" for key in shown)
        parts.append(Section("MLPerf LoadGen, single stream", [f"result {summary['result']}: {quantiles}"]))
    if setting["accuracy"]:
        parts.append(Section("Accuracy of these results", accuracy_sentences(setting["accuracy"])))
    return parts


def _stages(setting: Mapping[str, Any], names: Sequence[str]) -> Section:
    rows = [["stage", *(f"{name}, {word}" for name in names for word in ("p50", "share"))]]
    medians = {name: stage_medians(setting, name) for name in names}
    for stage in dict.fromkeys(stage for stages in medians.values() for stage in stages):
        row = [stage]
        for stages in medians.values():
            total = sum(stages.values())
            row += [number(stages.get(stage)), share(stages[stage] / total if stage in stages and total else None)]
        rows.append(row)
    return Section("Stages", ["medians in ms"], rows)


def _starts(setting: Mapping[str, Any]) -> Section:
    rows = [["repeat", "construct s", "first call ms", "warm-up scans", "warm-up p50 ms", "peak RSS MB", "scans MB"]]
    for k, repeat in enumerate(setting["repeats"], start=1):
        warm = [ms for scenario in repeat["scenarios"].values() for ms in scenario["warm_up_ms"]]
        start = number(repeat["construct_s"], 3), number(repeat["first_call_ms"])
        memory = number(repeat["peak_rss_mb"], 0), number(repeat["scans_mb"], 0)
        rows.append([str(k), *start, f"{len(warm):,}", number(percentile(warm, 50.0)), *memory])
    return Section("Start and warm-up", ["not part of the figures above"], rows)


def accuracy_sentences(accuracy: Mapping[str, Any]) -> list[str]:
    """Sentences on how far the results of a setting agree with the reference and the ground truth."""
    agreement = accuracy["agreement"]
    parts = []
    for kind in ("points", "cells"):
        if agreement[kind] is not None:
            equal, iou = (share(agreement[kind][name]) for name in ("equal", "mean_iou"))
            parts.append(f"{equal} of the {kind}' labels equal, mean IoU {iou}")
    if agreement["boxes"] is not None:
        parts.append(
            "{n_both} common boxes of {n_found} found and {n_reference} of the reference".format(**agreement["boxes"])
        )
    reference = "; ".join(accuracy["reference"])
    sentences = [f"compared with {reference} on {agreement['n_scans']} scans: {'; '.join(parts)}"]
    if accuracy["truth"] is None:
        return [*sentences, "these scans have no ground truth; edgeperc eval evaluates labeled scans"]
    for name, kept in (("ground truth", "truth"), ("ground truth, reference", "reference_truth")):
        figures = [f"{key.replace('_', ' ')} {share(v)}" for key, v in accuracy[kept].items() if v is not None]
        sentences.append(f"{name}: " + ", ".join(figures))
    return [*sentences, "a few scans only check an engine; edgeperc eval evaluates a model"]


def _matrix(document: Mapping[str, Any]) -> Section:
    head = ["model", "ran as", "p50", "p90", "p99", "noise", "CPU s/scan", "peak RSS MB", "labels equal", "agrees"]
    rows = [head]
    for setting in document["settings"]:
        for name in scenario_names(setting):
            t, accuracy = latency(setting, name), setting["accuracy"]
            same = [part["equal"] for kind in ("points", "cells") if (part := accuracy["agreement"][kind])]
            peaks = [repeat["peak_rss_mb"] or math.nan for repeat in setting["repeats"]]
            times = *(number(t[q]) for q in ("p50", "p90", "p99")), share(t["noise"]), number(t["cpu_s_per_scan"], 4)
            end = number(max(peaks), 0), share(min(same, default=None)), "yes" if accuracy["agrees"] else "no"
            rows.append(["+".join(setting["models"]), setting_label(setting), *times, *end])
    sentences = [f"skipped: {sentence}" for sentence in document["skipped"]]
    sentences += [f"recommended for {sentence['name']}: {sentence['text']}" for sentence in document["recommended"]]
    return Section("Settings, back to back, ms", sentences, rows if len(rows) > 1 else [])


def _context(document: Mapping[str, Any]) -> list[Section]:
    rows = [["what", "how"]]
    engines = {
        (e["sha256"], e["precision"], e["provider"], str(e["options"])): e
        for setting in document["settings"]
        for repeat in setting["repeats"]
        for e in repeat["engines"]
    }
    for e in engines.values():
        options = ", ".join(f"{key} {value}" for key, value in e["options"].items())
        how = f"{e['precision']}, {e['provider']}, {options}, SHA-256 {e['sha256']}"
        rows.append([f"{e['name']}:{e['variant']} {e['version']}", how])
    if document["input"]:
        rows.append(["input", f"{document['input']['source']}; sensor {document['input']['sensor']}"])
        points = document["input"]["n_points"]
        rows.append(["points per scan", f"{min(points):,} to {max(points):,}"])
        rows.append(["input SHA-256", document["input"]["sha256"]])
    for group in ("machine", "software"):
        rows += [[key.replace("_", " "), _shown(value)] for key, value in document[group].items()]
    rows.append(["command", document["command"]])
    return [Section("Context", rows=rows)]


def _shown(value: Any) -> str:
    if value is None:
        return "not exposed"
    if isinstance(value, dict):
        return ", ".join(f"{k}={v}" for k, v in value.items()) or "none set"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
