"""Steps of several commands: start and write a document, prepare the scans, measure several concurrent processes."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgeperc.cli.output import lines_last, make_places
from edgeperc.system.atomic import write_atomic
from edgeperc.system.extras import require
from edgeperc.system.machine import fingerprint
from edgeperc.types.choices import AUTO_SENSOR, DEFAULT_SENSOR
from edgeperc.zoo import DEFAULT

from .. import context, plots
from ..document import SCHEMA, write_report
from ..render import LiveTable, html_page, markdown, text
from ..report import sections
from ..scenarios import Limits
from ..worker import Job

if TYPE_CHECKING:
    from ..inputs import Input


@contextmanager
def new_document(kind: str, arguments: argparse.Namespace) -> Iterator[tuple[dict[str, Any], LiveTable, Path]]:
    """Start an empty report. Its content is printed and written at the end, even after an interruption."""
    html = getattr(arguments, "html", None)  # not every command has a page
    if html:
        require("matplotlib", "view", "A page with plots")
    make_places(arguments.json, arguments.markdown, html)
    hardware = context.machine()
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "kind": kind,
        "command": arguments.command_line,
        "complete": False,
        "machine": hardware | {"fingerprint": fingerprint(), "load_average": context.conditions()["load_average"]},
        "software": context.software(),
        "input": None,
        "disturbances": context.lasting_disturbances(hardware, context.busiest()),
        "settings": [],
        "skipped": [],
        "recommended": [],
        "tables": [],
        "soak": None,
    }
    live = LiveTable()
    for disturbance in document["disturbances"]:
        live.note(disturbance)
    try:
        with tempfile.TemporaryDirectory() as folder:
            yield document, live, Path(folder)
        document["complete"] = True
    finally:
        live.clear()
        if any(setting["repeats"] for setting in document["settings"]) or document["tables"]:
            parts, title = sections(document), f"edgeperc-bench {kind}: {hardware['cpu']}"
            with lines_last(text(parts).splitlines()):
                if arguments.json:
                    write_report(document, arguments.json)
                if arguments.markdown:
                    write_atomic(arguments.markdown, markdown(parts, title).encode())
                if html:
                    write_atomic(html, html_page(parts, title, plots.pictures(document)).encode())


def prepare_input(arguments: argparse.Namespace, folder: Path, document: dict[str, Any], live: LiveTable) -> Input:
    """Write the scans of ``--input`` or ``--scans`` to files in ``folder``, and record them in the report;
    ``--sensor auto`` becomes their sensor.
    """
    from .. import inputs

    if arguments.input:
        scans, arguments.sensor = inputs.read_input(folder, arguments.input, arguments.sensor)
    else:
        arguments.sensor = DEFAULT_SENSOR if arguments.sensor == AUTO_SENSOR else arguments.sensor
        live.note(f"simulating {arguments.scans} scans")
        scans = inputs.simulated_input(folder, arguments.scans, arguments.sensor)
    document["input"] = scans.record
    return scans


def job_of(arguments: argparse.Namespace) -> Job:
    """The job from ``--model``, ``--provider``, ``--precision``, ``--threads``, ``--sensor`` and ``--full-turn``."""
    given = arguments.provider, arguments.precision, arguments.threads, arguments.sensor
    full_turn = getattr(arguments, "full_turn", False)  # not every command has it
    return Job(tuple(arguments.model or DEFAULT), *given, full_turn)


def limits_of(arguments: argparse.Namespace) -> Limits:
    """The limits from ``--min-scans``, ``--min-seconds`` and ``--warm-up``."""
    return Limits(arguments.min_scans, arguments.min_seconds, arguments.warm_up)
