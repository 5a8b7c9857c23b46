"""``edgeperc-bench compare``: is one measurement slower than another?"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from .. import report
from ..options import complain
from ..samples import compare

__all__ = ["compare_command", "setting_label"]

# compare


def compare_command(arguments: argparse.Namespace) -> int:
    a, b = report.read_report(arguments.a), report.read_report(arguments.b)
    if not a["input"] or not b["input"] or a["input"]["sha256"] != b["input"]["sha256"]:
        complain("the reports are of different scans; measure both with the same --input, --scans and --sensor")
        return 2
    if a["machine"]["fingerprint"] != b["machine"]["fingerprint"]:
        print(f"other machines: A on {a['machine']['cpu']}, B on {b['machine']['cpu']}")
    found = []
    for one, other in _pairs(a["settings"], b["settings"]):
        for name in report.scenario_names(one):
            if name not in report.scenario_names(other):
                continue
            verdict = compare(report.repeats_ms(one, name), report.repeats_ms(other, name))
            found.append(verdict.word)
            words = f"{'+'.join(one['models'])}, {name}: {setting_label(one)} -> {setting_label(other)}: {verdict.word}"
            if verdict.word == "unusable":
                print(f"{words}; a run of one repeat says nothing of its noise: measure with --repeats 3")
                continue
            low, high = verdict.interval
            print(
                f"{words}; median x {verdict.ratio:.3f} (95 %: {low:.3f} to {high:.3f}), "
                f"noise {100.0 * verdict.noise:.1f} %"
            )
    for letter, document in (("A", a), ("B", b)):
        for words in document["spoilers"][:5]:
            print(f"{letter} was disturbed: {words}")
    if not found or "unusable" in found:
        complain("not everything could be compared" if found else "the reports have no setting and scenario in common")
        return 2
    return 1 if "slower" in found else 0


def _pairs(a: Sequence[dict[str, Any]], b: Sequence[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Settings that are compared: the same ones, or, where each report has but one, of the same models."""
    keys = ("models", "provider", "n_threads")
    same = [(one, other) for one in a for other in b if all(one[key] == other[key] for key in keys)]
    if same or len(a) != 1 or len(b) != 1:
        return same
    return [(a[0], b[0])] if a[0]["models"] == b[0]["models"] else []


def setting_label(setting: Mapping[str, Any]) -> str:
    return f"{setting['provider']}, {setting['n_threads'] or 'default'} threads"
