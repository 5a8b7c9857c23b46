"""The curve of a training run: its validation figures over the number of samples seen."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path


def curve_table(run: Path, n_lines: int = 12) -> Iterator[str]:
    """Lines of a table of a run's ``log.jsonl``, at most so many, means of neighboring ones: samples, loss, validation
    figures in percent, and what the last quarter brought. Raises ValueError.
    """
    path = run / "log.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    if not rows:
        raise ValueError(f"{path} has no line; expected the folder of a training run")
    # A run that was stopped repeats the steps since its last checkpoint.
    rows = list({row["step"]: row for row in rows}.values())
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
        cells = [
            f"{part[-1].get('samples', part[-1]['step']):>12,}",
            f"{sum(r['loss'] for r in part) / len(part):>12.4f}",
        ]
        cells += [f"{value:>12.1f}" if (value := mean(part, name)) is not None else f"{'-':>12}" for name in names]
        yield "".join(cells)
    quarter = len(rows) // 4
    if quarter and names:
        gains = []
        for name in names:
            before, after = mean(rows[-2 * quarter : -quarter], name), mean(rows[-quarter:], name)
            gains.append("-".rjust(12) if before is None or after is None else f"{after - before:>+12.1f}")
        yield f"{'last quarter':>24}" + "".join(gains)
