"""The document of a measurement: what `edgeperc-bench --json` writes and `compare` reads."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edgeperc import EdgepercError

from .samples import noise_floor, percentile, summary

__all__ = [
    "ReportError",
    "latency",
    "pooled",
    "read_report",
    "repeats_ms",
    "scenario_names",
    "stage_medians",
    "write_report",
]

SCHEMA = 1
KINDS = ("run", "matrix", "scaling", "soak", "peers")


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


def stage_medians(setting: Mapping[str, Any], name: str) -> dict[str, float]:
    """Median milliseconds of each stage; ``outside`` is what a call takes beyond its stages."""
    parts = [repeat["scenarios"][name] for repeat in setting["repeats"] if name in repeat["scenarios"]]
    stages = dict.fromkeys(stage for part in parts for stage in part["stage_ms"])
    values = {stage: [v for part in parts for v in part["stage_ms"].get(stage, ())] for stage in stages}
    outside = [ms - sum(of[k] for of in part["stage_ms"].values()) for part in parts for k, ms in enumerate(part["ms"])]
    return {stage: percentile(v, 50.0) for stage, v in (values | {"outside": outside}).items() if v}
