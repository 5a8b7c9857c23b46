"""``edgeperc-bench compare``: test whether one measurement is slower than another."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edgeperc.cli.output import print_line

from ..document import ReportError, read_report, repeats_ms, scenario_names, setting_label
from ..options import add_command
from ..samples import compare


def add_parser(subparsers: Any) -> None:
    add = add_command(
        subparsers,
        "compare",
        run_command,
        help="tell whether report B is faster or slower than report A",
        description="Compare two reports of the same scans, setting by setting. A difference counts only if it is "
        "larger than the noise of both. Exit code: 0 no difference or faster, 1 slower, 2 not comparable.",
    )
    add("a A.json", "the report to compare with, written by --json", type=Path)
    add("b B.json", "the report that may be faster or slower", type=Path)


def run_command(arguments: argparse.Namespace) -> int:
    """Print a verdict for each setting and scenario that both reports have."""
    a, b = read_report(arguments.a), read_report(arguments.b)
    try:
        return _compared(a, b)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as exc:  # of a file that was edited
        raise ReportError(f"{arguments.a} or {arguments.b} is not as edgeperc-bench wrote it ({exc!r:.99})") from exc


def _compared(a: dict[str, Any], b: dict[str, Any]) -> int:
    if not a["input"] or not b["input"] or a["input"]["sha256"] != b["input"]["sha256"]:
        raise ReportError("the reports are of different scans; measure both with one --input, --scans and --sensor")
    if a["machine"]["fingerprint"] != b["machine"]["fingerprint"]:
        print_line(f"different machines: A on {a['machine']['cpu']}, B on {b['machine']['cpu']}")
    if a["input"]["sensor"] != b["input"]["sensor"]:
        print_line(f"different sensors: A as of {a['input']['sensor']}, B as of {b['input']['sensor']}")
    verdicts = []
    for one, other in _pairs(a["settings"], b["settings"]):
        for name in (each for each in scenario_names(one) if each in scenario_names(other)):
            verdict = compare(repeats_ms(one, name), repeats_ms(other, name))
            verdicts.append(verdict.word)
            line = f"{'+'.join(one['models'])}, {name}: {setting_label(one)} -> {setting_label(other)}: {verdict.word}"
            if verdict.word == "unusable":
                print_line(f"{line}; the noise is unknown with one repeat: measure with --repeats 3")
                continue
            low, high = verdict.interval
            print_line(
                f"{line}; median x {verdict.ratio:.3f} (95 %: {low:.3f} to {high:.3f}), "
                f"noise {100.0 * verdict.noise:.1f} %"
            )
    for letter, document in (("A", a), ("B", b)):
        if not document["complete"]:
            print_line(f"{letter} was interrupted: only what was measured before is compared")
        for disturbance in document["disturbances"][:5]:
            print_line(f"{letter} was disturbed: {disturbance}")
    if not verdicts:
        raise ReportError("the reports share no setting and scenario; measure the same models, settings and scenarios")
    if "unusable" in verdicts:
        raise ReportError("not everything could be compared; measure with --repeats 3")
    return 1 if "slower" in verdicts else 0


def _pairs(a: Sequence[dict[str, Any]], b: Sequence[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """The settings to compare: equal ones, or, if each report has only one, two settings of the same models."""
    # Reports of older versions have no "full_turn"; without it, only the quarter ahead was measured.
    keys = ("models", "provider", "precision", "n_threads", "full_turn")
    asked_a, asked_b = ([[setting.get(key) or None for key in keys] for setting in settings] for settings in (a, b))
    same = [(a[j], b[k]) for j, one in enumerate(asked_a) for k, other in enumerate(asked_b) if one == other]
    if same or len(a) != 1 or len(b) != 1:
        return same
    return [(a[0], b[0])] if a[0]["models"] == b[0]["models"] else []
