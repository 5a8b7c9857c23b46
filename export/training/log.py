"""The log of a training run, a line for each checkpoint: JSON, CSV and scalars of TensorBoard; and its curve."""

from __future__ import annotations

import contextlib
import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from edgeperc.system.atomic import write_atomic
from edgeperc.system.extras import require


class TrainingLog:
    """Writes ``log.jsonl``, ``log.csv`` (names as of TensorBoard, ``validation/car``) and, if asked, event files into a
    run's folder, where a run goes on that is resumed with its checkpoint's ``curve``: lost lines come from there, and
    lines of later steps, which it makes again, or of another run, are removed. Raises MissingExtraError.
    """

    def __init__(self, folder: Path, curve: Sequence[Mapping[str, Any]] = (), *, tensorboard: bool = False) -> None:
        self._events: Any = None
        step = curve[-1]["step"] if curve else 0
        if tensorboard:
            require("tensorboard", "tensorboard", "--tensorboard")
            writer = require("torch.utils.tensorboard", "tensorboard", "--tensorboard").SummaryWriter
            self._events = writer(str(folder), purge_step=step + 1)
        path, self._table = folder / "log.jsonl", folder / "log.csv"
        written = {line["step"]: line for line in whole_lines(path)}
        kept = [written.get(line["step"], {**line, "samples_per_s": None}) for line in curve]
        write_atomic(path, "".join(json.dumps(line) + "\n" for line in kept).encode())
        self._table.unlink(missing_ok=True)
        for line in kept:
            self._add_row(flat(line))
        self._lines = path.open("a", encoding="utf-8")

    def write(self, line: Mapping[str, Any]) -> None:
        """Add the figures of a checkpoint; ``line["step"]`` is its step."""
        self._lines.write(json.dumps(line) + "\n")
        self._lines.flush()
        row = flat(line)
        self._add_row(row)
        if self._events is not None:
            for name, value in row.items():
                if value is not None:
                    self._events.add_scalar(name, value, line["step"])
            self._events.flush()

    def _add_row(self, row: Mapping[str, Any]) -> None:
        is_new = not self._table.exists()
        with self._table.open("a", encoding="utf-8", newline="") as file:
            table = csv.writer(file)
            if is_new:
                table.writerow(row)
            table.writerow(row.values())

    def __enter__(self) -> TrainingLog:
        return self

    def __exit__(self, *error: object) -> None:
        self._lines.close()
        if self._events is not None:
            self._events.close()


def whole_lines(path: Path) -> list[dict[str, Any]]:
    """The lines of ``log.jsonl``, if it exists; a part, as a kill or a full disk leaves, and other damage are none."""
    lines = []
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        with contextlib.suppress(json.JSONDecodeError):
            lines.append(json.loads(text))
    return [line for line in lines if isinstance(line, dict) and {"step", "loss"} <= line.keys()]


def flat(figures: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested figures under names with slashes."""
    row: dict[str, Any] = {}
    for name, value in figures.items():
        row |= flat(value, f"{prefix}{name}/") if isinstance(value, Mapping) else {prefix + name: value}
    return row


def curve_table(run: Path, n_lines: int = 12) -> Iterator[str]:
    """Lines of a table of a run's ``log.jsonl``, at most so many, means of neighboring ones: samples, loss, validation
    figures in percent, and what the last quarter brought. Raises ValueError.
    """
    path = run / "log.jsonl"
    if not (rows := whole_lines(path)):
        raise ValueError(f"{path} has no line; expected the folder of a training run")
    names = [name for name in rows[-1].get("validation", {}) if name != "background"]
    size = -(-len(rows) // max(1, n_lines))
    yield f"{run}: {len(rows)} lines of the log, means of {size}"
    yield "".join(f"{name:>12}" for name in ("samples", "loss", *names))

    def mean(part: list[dict[str, object]], name: str) -> float | None:
        found = [row.get("validation", {}).get(name) for row in part]  # type: ignore[attr-defined]  # a dict
        known = [value for value in found if value is not None]
        return 100.0 * sum(known) / len(known) if known else None

    for first in range(0, len(rows), size):
        part = rows[first : first + size]
        n_seen, loss = part[-1].get("samples", part[-1]["step"]), sum(r["loss"] for r in part) / len(part)
        cells = [f"{n_seen:>12,}", f"{loss:>12.4f}"]
        cells += [f"{value:>12.1f}" if (value := mean(part, name)) is not None else f"{'-':>12}" for name in names]
        yield "".join(cells)
    quarter = len(rows) // 4
    if quarter and names:
        gains = []
        for name in names:
            before, after = mean(rows[-2 * quarter : -quarter], name), mean(rows[-quarter:], name)
            gains.append("-".rjust(12) if before is None or after is None else f"{after - before:>+12.1f}")
        yield f"{'last quarter':>24}" + "".join(gains)
