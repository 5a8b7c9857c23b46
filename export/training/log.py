"""The log of a training run: a line for each checkpoint, as JSON, as CSV and as TensorBoard's scalars."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edgeperc.system.extras import require


class TrainingLog:
    """Writes ``log.jsonl``, ``log.csv`` (names as of TensorBoard, ``validation/car``) and, if asked, event files into a
    run's folder, where a resumed run goes on; nothing without a folder. Raises MissingExtraError.
    """

    def __init__(self, folder: Path | None, *, tensorboard: bool = False) -> None:
        self._events: Any = None
        if tensorboard and folder is not None:
            require("tensorboard", "tensorboard", "--tensorboard")
            self._events = require("torch.utils.tensorboard", "tensorboard", "--tensorboard").SummaryWriter(str(folder))
        path = Path(os.devnull) if folder is None else folder / "log.jsonl"
        self._lines = path.open("a", encoding="utf-8")
        self._table = None if folder is None else folder / "log.csv"

    def write(self, line: Mapping[str, Any]) -> None:
        """Add the figures of a checkpoint; ``line["step"]`` is its step."""
        self._lines.write(json.dumps(line) + "\n")
        self._lines.flush()
        row = flat(line)
        if self._table is not None:
            is_new = not self._table.exists()
            with self._table.open("a", encoding="utf-8", newline="") as file:
                table = csv.writer(file)
                if is_new:
                    table.writerow(row)
                table.writerow(row.values())
        if self._events is not None:
            for name, value in row.items():
                if value is not None:
                    self._events.add_scalar(name, value, line["step"])
            self._events.flush()

    def __enter__(self) -> TrainingLog:
        return self

    def __exit__(self, *error: object) -> None:
        self._lines.close()
        if self._events is not None:
            self._events.close()


def flat(figures: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested figures under names with slashes."""
    row: dict[str, Any] = {}
    for name, value in figures.items():
        row |= flat(value, f"{prefix}{name}/") if isinstance(value, Mapping) else {prefix + name: value}
    return row
