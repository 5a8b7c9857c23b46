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

from .samples import summary

__all__ = ["QUANTILES", "LiveTable", "Section", "html_page", "markdown", "number", "share", "text"]

WORDY = 24  # characters from which a column holds words, not numbers
QUANTILES = ("p50", "p90", "p99", "p99.9", "max")


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
