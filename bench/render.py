"""A report as text, Markdown or an HTML page, and the table that grows while a measurement runs."""

from __future__ import annotations

import html
import math
import re
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TextIO

from edgeperc.cli.output import print_line
from edgeperc.system.printable import printable

from .samples import summary

TEXT_WIDTH = 24  # a column with a longer cell is a text column, aligned left
QUANTILES = ("p50", "p90", "p99", "p99.9", "max")


@dataclass(frozen=True)
class Section:
    """A section of a report: sentences, then a table whose first row is its head."""

    title: str
    sentences: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


def _printable(part: Section) -> Section:
    rows = [[printable(cell) for cell in row] for row in part.rows]
    return Section(printable(part.title), [printable(sentence) for sentence in part.sentences], rows)


def text(parts: Iterable[Section]) -> str:
    """Format sections for a terminal."""
    lines: list[str] = []
    for part in map(_printable, parts):
        lines += ["", part.title, *(f"  {sentence}" for sentence in part.sentences)]
        lines += _aligned(part.rows)
    return "\n".join(lines[1:])


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    if not rows:
        return []
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = [">" if k and width <= TEXT_WIDTH else "<" for k, width in enumerate(widths)]
    form = "  ".join(["", *(f"{{:{side}{width}}}" for side, width in zip(sides, widths, strict=True))])
    return [form.format(*row).rstrip() for row in rows]


def markdown(parts: Iterable[Section], title: str) -> str:
    """Format sections as Markdown."""

    def plain(cell: str) -> str:
        return re.sub(r"([\\`*_{}\[\]<>|#])", r"\\\1", cell)

    lines = [f"# {plain(printable(title))}"]
    for part in map(_printable, parts):
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
td:first-child,th:first-child,.text{text-align:left}
svg{max-width:100%;height:auto}"""

# The page runs no script and loads nothing; its drawings have style attributes, and may embed a picture.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"


def html_page(parts: Iterable[Section], title: str, pictures: Sequence[str] = ()) -> str:
    """Format sections as an HTML page without external files; ``<svg>`` pictures are shown after the second section."""
    escape, title = html.escape, printable(title)
    body = [f"<h1>{escape(title)}</h1>"]
    for k, part in enumerate(map(_printable, parts)):
        body.append(f"<h2>{escape(part.title)}</h2>")
        body += [f"<p>{escape(sentence)}</p>" for sentence in part.sentences]
        if part.rows:
            rows = ("".join(_cell("td" if k else "th", cell) for cell in row) for k, row in enumerate(part.rows))
            body.append(f"<table>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>")
        if k == 1:
            body += [f"<figure>{picture}</figure>" for picture in pictures]
    policy = f'<meta http-equiv="Content-Security-Policy" content="{POLICY}"/>'
    head = f'<meta charset="utf-8"/>{policy}<title>{escape(title)}</title><style>{STYLE}</style>'
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>\n' + "\n".join(body) + "\n</body></html>\n"


def _cell(tag: str, text: str) -> str:
    style = ' class="text"' if len(text) > TEXT_WIDTH else ""
    return f"<{tag}{style}>{html.escape(text)}</{tag}>"


def number(value: float | None, digits: int = 2) -> str:
    """Format a number of a table; a dash if it is unknown or if there are too few samples."""
    return "-" if value is None or math.isnan(value) else f"{value:,.{digits}f}"


def share(value: float | None, digits: int = 1) -> str:
    """Format a share in per cent; a dash if it is unknown."""
    return "-" if value is None or math.isnan(value) else f"{100.0 * value:.{digits}f} %"


@dataclass
class LiveTable:
    """The samples so far, redrawn on a terminal; elsewhere only the notes are printed."""

    stream: TextIO = field(default_factory=lambda: sys.stderr)
    ms: dict[str, list[float]] = field(default_factory=dict)
    _lines: int = 0
    _next_s: float = 0.0

    def __call__(self, name: str, ms: Sequence[float]) -> None:
        """Add the milliseconds of some calls of a scenario, and draw the table twice a second."""
        self.ms.setdefault(name, []).extend(ms)
        now = time.perf_counter()
        if self.stream.isatty() and now >= self._next_s:
            self._next_s = now + 0.5
            self.clear()
            rows = [["scenario", "scans", *QUANTILES, "last"]]
            for stage, values in self.ms.items():
                figures = summary(values)
                last = values[-1] if values else None
                rows.append([stage, f"{len(values):,}", *(number(figures[q]) for q in QUANTILES), number(last)])
            lines = _aligned(rows)
            self.stream.write("\n".join(lines) + "\n")
            self.stream.flush()
            self._lines = len(lines)

    def note(self, line: str) -> None:
        """Print a line that stays."""
        self.clear()
        print_line(f"edgeperc-bench: {line}", self.stream)

    def clear(self) -> None:
        """Erase the table."""
        if self._lines:
            self.stream.write(f"\x1b[{self._lines}A\x1b[J")
            self.stream.flush()
        self._lines = 0
