"""The document of a measurement, which ``edgeperc-bench --json`` writes and ``compare`` reads.

The JSON has ``schema``, ``kind`` (run, matrix, scaling, soak, peers), ``command``, ``complete``, ``machine``,
``software``, ``input``, ``disturbances`` and, by kind, ``settings`` (a list: models, provider, precision and threads as
asked for, ``repeats`` with the engines that really ran and all samples, ``accuracy``, ``offline``, ``cold_start``,
``loadgen``), ``skipped``, ``recommended``, ``tables``, ``soak`` or ``peers`` (by table, the samples of each contender
in each round). All reports are computed from this document.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edgeperc import EdgepercError
from edgeperc.system.atomic import write_atomic

from .samples import noise_floor, percentile, summary

SCHEMA = 2  # 2: provider and precision are two settings
KINDS = ("run", "matrix", "scaling", "soak", "peers")


class ReportError(EdgepercError):
    """A file is not a report, or has another schema, or two reports cannot be compared."""


def write_report(document: Mapping[str, Any], path: Path) -> None:
    """Write a document as JSON."""
    write_atomic(path, json.dumps(document, allow_nan=False).encode() + b"\n")


def read_report(path: Path) -> dict[str, Any]:
    """Read what `write_report` wrote; raises ReportError."""
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"), parse_constant=int)  # "NaN" is no int: ValueError
    except (OSError, RecursionError, ValueError) as exc:
        raise ReportError(f"{path} cannot be read as a report: {exc}") from exc
    if not isinstance(document, dict) or document.get("schema") != SCHEMA or document.get("kind") not in KINDS:
        raise ReportError(
            f"{path} is not a report of schema {SCHEMA}; expected a file that this version of edgeperc-bench wrote "
            "with --json; measure again"
        )
    return document


def scenario_names(setting: Mapping[str, Any]) -> list[str]:
    """The scenarios of one setting, in the order in which they were measured."""
    return list(dict.fromkeys(name for repeat in setting["repeats"] for name in repeat["scenarios"]))


def setting_label(setting: Mapping[str, Any]) -> str:
    """Label of a setting: each model with its active precision and provider, and the threads."""
    engines = [engine for repeat in setting["repeats"][:1] for engine in repeat["engines"]]
    ran = "; ".join(f"{engine['name']} {engine['precision']}, {engine['provider']}" for engine in engines)
    turn = ", full turn" if setting.get("full_turn") else ""
    return f"{ran or setting['provider']}, {setting['n_threads'] or 'default'} threads{turn}"


def _parts(setting: Mapping[str, Any], scenario: str) -> list[dict[str, Any]]:
    return [repeat["scenarios"][scenario] for repeat in setting["repeats"] if scenario in repeat["scenarios"]]


def repeats_ms(setting: Mapping[str, Any], scenario: str, key: str = "ms") -> list[list[float]]:
    """The samples of each repeat that has any."""
    return [part[key] for part in _parts(setting, scenario) if part[key]]


def pooled(setting: Mapping[str, Any], scenario: str, key: str = "ms") -> list[float]:
    """The samples of all repeats in one list."""
    return [value for samples in repeats_ms(setting, scenario, key) for value in samples]


def latency(setting: Mapping[str, Any], scenario: str) -> dict[str, Any]:
    """Statistics of one scenario; a value is None if it is unknown or if there are too few samples."""
    parts = _parts(setting, scenario)
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


def stage_medians(setting: Mapping[str, Any], name: str) -> dict[str, float]:
    """Median milliseconds of each stage; ``outside`` is the part of a call outside its stages."""
    parts = _parts(setting, name)
    stages = dict.fromkeys(stage for part in parts for stage in part["stage_ms"])
    values = {stage: [v for part in parts for v in part["stage_ms"].get(stage, ())] for stage in stages}
    outside = [
        ms - sum(times[k] for times in part["stage_ms"].values()) for part in parts for k, ms in enumerate(part["ms"])
    ]
    return {stage: percentile(v, 50.0) for stage, v in (values | {"outside": outside}).items() if v}
