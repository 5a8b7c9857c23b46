"""What every command does: start a document, write it, prepare the scans."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgeperc.tuning import fingerprint

from .. import context, report

if TYPE_CHECKING:
    from ..inputs import Input

__all__ = ["new_document", "prepare_input"]


@contextmanager
def new_document(kind: str, arguments: argparse.Namespace) -> Iterator[tuple[dict[str, Any], report.LiveTable]]:
    """A report to be filled in; what is in it is shown and written however the measuring ends."""
    if arguments.html:
        report.require_matplotlib()
    for file in filter(None, (arguments.json, arguments.markdown, arguments.html)):
        file.parent.mkdir(parents=True, exist_ok=True)
    hardware = context.machine()
    document: dict[str, Any] = {
        "schema": report.SCHEMA,
        "kind": kind,
        "command": arguments.typed,
        "complete": False,
        "machine": hardware | {"fingerprint": fingerprint(), "load_average": context.conditions()["load_average"]},
        "software": context.software(),
        "input": None,
        "spoilers": context.standing_spoilers(hardware, context.busiest()),
        "settings": [],
        "skipped": [],
        "recommended": [],
        "tables": [],
        "soak": None,
    }
    live = report.LiveTable()
    for words in document["spoilers"]:
        live.say(f"note: {words}")
    try:
        yield document, live
        document["complete"] = True
    finally:
        live.clear()
        if any(setting["repeats"] for setting in document["settings"]) or document["tables"]:
            _write(document, arguments)


def _write(document: Mapping[str, Any], arguments: argparse.Namespace) -> None:
    parts = report.sections(document)
    title = f"edgeperc-bench {document['kind']}: {document['machine']['cpu']}"
    print(report.text(parts))
    if arguments.json:
        report.write_report(document, arguments.json)
    if arguments.markdown:
        arguments.markdown.write_text(report.markdown(parts, title), encoding="utf-8")
    if arguments.html:
        page = report.html_page(parts, title, report.pictures(document))
        arguments.html.write_text(page, encoding="utf-8")


def prepare_input(
    arguments: argparse.Namespace, folder: Path, document: dict[str, Any], live: report.LiveTable
) -> Input:
    from .. import inputs

    if arguments.input:
        given = inputs.read(folder, arguments.input, arguments.sensor)
    else:
        live.say(f"simulating {arguments.scans} scans")
        given = inputs.simulate(folder, arguments.scans, arguments.sensor)
    document["input"] = given.told
    return given
