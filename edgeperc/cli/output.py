"""What the commands print: messages, progress, tables, files of figures."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from ..errors import MissingExtraError

__all__ = [
    "Progress",
    "complain",
    "counted_progress",
    "many",
    "one_line",
    "print_rows",
    "require_matplotlib",
    "require_pillow",
    "show_warning",
    "table_lines",
    "without_nan",
    "write_figures",
]


def one_line(words: object) -> str:
    """Text without line breaks."""
    return " ".join(str(words).split())


def complain(words: object) -> None:
    """Print one line on stderr."""
    print(f"edgeperc: {one_line(words)}", file=sys.stderr)


def show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print a warning as one line, in place of `warnings.showwarning`."""
    complain(f"warning: {message}")


def require_matplotlib() -> None:
    """Raise `MissingExtraError` before any work is done if matplotlib is absent."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as exc:
        raise MissingExtraError("matplotlib", "view", "Drawing a picture") from exc


def require_pillow() -> None:
    """Raise `MissingExtraError` before any work is done if Pillow is absent."""
    try:
        import PIL  # noqa: F401
    except ImportError as exc:
        raise MissingExtraError("pillow", "view", "Drawing an animation") from exc


class Progress:
    """A bar on stderr, where that is a terminal and there is more than one scan."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.live = total > 1 and sys.stderr.isatty()
        self.started = time.perf_counter()
        self.show(0)

    def show(self, done: int) -> None:
        """Draw the bar, with an estimate of the time left."""
        if not self.live:
            return
        left_s = (time.perf_counter() - self.started) / max(done, 1) * (self.total - done)
        bar = "#" * (30 * done // self.total)
        words = f", {left_s:.0f} s left" if done else ""
        sys.stderr.write(f"\r\x1b[K[{bar:<30}] {done}/{self.total}{words}")
        sys.stderr.flush()

    def clear(self) -> None:
        """Remove the bar from the line."""
        if self.live:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()


@contextlib.contextmanager
def counted_progress() -> Iterator[Callable[[int, int], None]]:
    """What shows how many are done, of how many: a bar that learns the latter when it is first called."""
    bars: list[Progress] = []

    def show(done: int, total: int) -> None:
        """Draw the bar, with an estimate of the time left."""
        bars[:] = bars or [Progress(total)]
        bars[0].show(done)

    yield show
    for bar in bars:
        bar.clear()


def print_rows(rows: Sequence[tuple[str, str]]) -> None:
    """Print names and values as two aligned columns."""
    width = max(len(name) for name, _ in rows) + 2
    for name, words in rows:
        print(f"{name:<{width}}{words}".rstrip())


# eval


def write_figures(arguments: argparse.Namespace, figures: Mapping[str, Any]) -> None:
    """Every figure, and the command that gave them, where ``--json`` says."""
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"command": arguments.typed, **figures}, indent=1, allow_nan=False)
        arguments.json.write_text(text + "\n", encoding="utf-8")


def without_nan(value: Any) -> Any:
    """The same with None for every number that is none, as JSON has it."""
    if isinstance(value, Mapping):
        return {key: without_nan(of) for key, of in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def many(n: int, noun: str) -> str:
    """A count with its noun in the right number."""
    return f"{n:,} {noun}{'s' * (n != 1)}"


def table_lines(
    title: str, columns: Sequence[tuple[str, str]], rows: Sequence[tuple[tuple[str, str], Mapping[str, Any]]]
) -> list[str]:
    """A table as lines of text: a title, headings, and rows with two names each."""
    if not rows:
        return []
    cells = [["", "", *(heading for heading, _ in columns)]]
    cells += [[*names, *(_cell(row.get(key)) for _, key in columns)] for names, row in rows]
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
    if value is None:
        return "-"
    if isinstance(value, list):
        return "-".join(f"{100.0 * bound:.1f}" for bound in value)
    return f"{100.0 * value:.1f}" if isinstance(value, float) else f"{value:,}"
