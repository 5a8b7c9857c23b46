"""Output of the commands: lines, warnings, progress bars, tables and JSON files."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, TextIO

from ..errors import OptionError
from ..system.atomic import write_atomic
from ..system.names import SCAN_SUFFIXES
from ..system.printable import printable

FEW = " (n<10)"  # `edgeperc.evaluation.tables.FEWEST_OBJECTS`
"""Next to names of classes with few objects."""


def one_line(text: object) -> str:
    """Text without line breaks."""
    return " ".join(str(text).split())


def print_line(text: str, file: TextIO | None = None, *, gray: bool = False) -> None:
    """Print a line, by default on stdout, above any progress bar; a gray one is gray on a terminal without NO_COLOR."""
    tqdm = getattr(sys.modules.get("tqdm"), "tqdm", None)  # imported only while a bar is drawn
    shown = printable(text)
    if gray and (file or sys.stdout).isatty() and not os.environ.get("NO_COLOR"):
        shown = f"\x1b[90m{shown}\x1b[0m"
    with contextlib.nullcontext() if tqdm is None else tqdm.external_write_mode(sys.stdout):
        try:
            print(shown, file=file, flush=True)
        except OSError as exc:
            # Where errors cannot be written, nobody can be told, and the work goes on.
            if file is None or file is not sys.stderr or isinstance(exc, BrokenPipeError):
                raise


def print_result(text: str) -> None:
    """Print a line on stdout; of one that does not fit on a full disk, nothing stays or waits. Raises OSError."""
    try:
        number = sys.stdout.fileno()
    except (AttributeError, OSError, ValueError):  # no stream, or one without a file
        number = -1
    if number < 0 or os.isatty(number):
        print_line(text)
        return
    sys.stdout.flush()
    data = f"{printable(text)}{os.linesep}".encode(sys.stdout.encoding or "utf-8", sys.stdout.errors or "strict")
    size, n = os.fstat(number).st_size, 0
    try:
        while n < len(data):
            n += os.write(number, data[n:])
    except OSError:
        if n and os.fstat(number).st_size == size + n:  # a file, and nobody else has written to it
            os.ftruncate(number, size)
            os.lseek(number, -n, os.SEEK_CUR)
        raise


# Arguments of the library and the options that set them.
_OPTIONS = {
    "agree": "--no-agreement",
    "adapt": "--adapt",
    "boxes_from": "--boxes-from",
    "fold": "--fold",
    "full_turn": "--full-turn",
    "models": "--model",
    "origin_m": "--origin",
    "n_threads": "--threads",
    "on_mismatch": "--on-mismatch",
    "precision": "--precision",
    "provider": "--provider",
    "rate_hz": "--rate",
    "score_threshold": "--score-threshold",
    "road_by": "--road-by",
    "sensor": "--sensor",
    "split": "--split",
    "topic": "--topic",
}


def in_options(message: str) -> str:
    """Replace the library's argument names by options: ``provider 'cuda' is``, ``n_threads is 0``,
    ``precision="bf16"``, and options that are named beside; the same word elsewhere in a sentence is not changed.
    """
    of_data = r"sensor= a profile (?:whose remission_range is|with the remission_range of this data,)"
    message = re.sub(rf"{of_data} \(([^,]+), ([^)]+)\)", r"--remission-range \1 \2", message)
    names = "|".join(_OPTIONS)
    message = re.sub(r"pass \w+=\S* \(on the command line ([^)]*)\)", r"pass \1", message)
    message = re.sub(r"\b\w+= (?:or (--[\w-]+)|\((--[\w-]+)\))", lambda m: m[1] or m[2], message)
    message = re.sub(rf"(?<![\w-])({names})= ", lambda m: f"{_OPTIONS[m[1]]} ", message)
    message = re.sub(rf"(?<![\w-])({names})=(['\"]?)([\w.:-]+)\2", lambda m: f"{_OPTIONS[m[1]]} {m[3]}", message)
    return re.sub(rf"(?<![\w-])(?<!the )({names})(?= is | are | '| \[)", lambda m: _OPTIONS[m[1]], message)


def print_error(text: object, program: str = "edgeperc") -> None:
    """Print one line on stderr, with the program's name."""
    print_line(f"{program}: {one_line(text)}", sys.stderr)


def show_warning(
    message: Warning | str, category: type[Warning], *_: Any, program: str = "edgeperc", **__: Any
) -> None:
    """Print a warning as one line, in place of `warnings.showwarning`."""
    print_error(f"warning: {message}", program)


@contextlib.contextmanager
def progress(unit: str = "scan") -> Iterator[Callable[[int, int], None]]:
    """Yield ``show(done, total)``, which draws a bar on stderr if that is a terminal and tqdm is installed."""
    with contextlib.ExitStack() as stack:
        bars: list[Any] = []

        def show(done: int, total: int) -> None:
            """Draw the bar; the first call sets its length."""
            if not bars and total > 1 and sys.stderr.isatty():
                with contextlib.suppress(ImportError):
                    tqdm = import_module("tqdm").tqdm
                    bars.append(stack.enter_context(tqdm(total=total, unit=unit, leave=False, file=sys.stderr)))
            for bar in bars:
                bar.update(done - bar.n)

        yield show


def print_rows(rows: Sequence[tuple[str, str]]) -> None:
    """Print names and values as two aligned columns."""
    shown = [(printable(name), value) for name, value in rows]
    width = max(len(name) for name, _ in shown) + 2
    for name, value in shown:
        print_line(f"{name:<{width}}{value}".rstrip())


def print_columns(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table: headings and left-aligned columns."""
    lines = [[printable(cell) for cell in line] for line in (headings, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        print_line("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())


@contextlib.contextmanager
def lines_last(lines: Sequence[str], *, gray: bool = False) -> Iterator[None]:
    """Print lines after what is written to files, done or not: what reads them, such as ``head``, may close stdout.
    ``gray``: those with `FEW` are gray.
    """
    try:
        yield
    finally:
        for line in lines:
            print_line(line, gray=gray and FEW in line)


def make_folder(folder: Path, option: str) -> None:
    """Make a folder of results. Raises OptionError, which names its option."""
    _make(folder, option)
    if not os.access(folder, os.W_OK):
        raise OptionError(f"{option}: the folder {folder} is read-only; expected one that can be written")


def _make(folder: Path, option: str) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise OptionError(
            f"{option}: the folder {folder} cannot be made ({exc.strerror}); expected a folder, or a name that is free "
            "in one that can be written"
        ) from exc


def make_places(*files: Path | None) -> None:
    """Make the folders of files that are written at the end, and refuse what cannot be one, a scan that is there, or
    a file of two options: before the work, which may take hours. Raises OptionError.
    """
    given = [file for file in files if file is not None]
    for file in given:
        _make(file.parent, str(file))
        if file.is_dir():
            raise OptionError(f"{file} is a folder; expected the name of a file, which may be in it")
        if (file.suffix.lower() in SCAN_SUFFIXES and file.exists()) or given.count(file) > 1:
            raise OptionError(f"{file} is a scan, or of two options, and would be overwritten; choose another name")
        if not file.exists() and not os.access(file.parent, os.W_OK):
            raise OptionError(f"{file} cannot be written: its folder is read-only; expected a file in another one")


def write_figures(arguments: argparse.Namespace, figures: Mapping[str, Any]) -> None:
    """Write all figures, and the command line that produced them, to the file of ``--json``, if it was passed."""
    path: Path | None = arguments.json
    if path is not None:
        text = json.dumps({"command": arguments.typed, **figures}, indent=1, allow_nan=False)
        write_atomic(path, f"{text}\n".encode())


def without_nan(value: Any) -> Any:
    """Copy with None in place of NaN and infinity, which JSON lacks."""
    if isinstance(value, Mapping):
        return {key: without_nan(inner) for key, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table_lines(
    title: str, columns: Sequence[tuple[str, str]], rows: Sequence[tuple[tuple[str, str], Mapping[str, Any]]]
) -> list[str]:
    """A table: columns (heading, key), rows of two names, a repeated first one shown once, and figures by key."""
    if not rows:
        return []
    cells = [["", "", *(printable(heading) for heading, _ in columns)]]
    cells += [[*map(printable, names), *(_cell(row.get(key)) for _, key in columns)] for names, row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for k in range(len(cells) - 1, 1, -1):
        if cells[k][0] == cells[k - 1][0]:
            cells[k][0] = ""
    lines = []
    for cell in cells:
        left = "  ".join(text.ljust(width) for text, width in zip(cell[:2], widths[:2], strict=True))
        right = "  ".join(text.rjust(width) for text, width in zip(cell[2:], widths[2:], strict=True))
        lines.append(f"  {left}  {right}".rstrip())
    return ["", title, *lines]


def _cell(value: Any) -> str:
    """Format a value: shares and their intervals in per cent, counts and texts unchanged."""
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return "-".join(map(_cell, value))
    return f"{100.0 * value:.1f}" if isinstance(value, float) else f"{value:,}"
