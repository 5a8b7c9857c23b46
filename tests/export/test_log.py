"""The log of a training run: JSON, CSV and TensorBoard hold the same figures, and a resumed run goes on in them."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")

from edgeperc.errors import MissingExtraError
from edgeperc_export.training.log import TrainingLog, curve_table, flat

LINES: list[dict[str, Any]] = [
    {"step": 100, "loss": 1.5, "validation": {"car": 0.25, "mean": None}},
    {"step": 200, "loss": 0.75, "validation": {"car": 0.5, "mean": 0.125}},
]


def test_names_of_nested_figures_have_slashes() -> None:
    assert flat({"step": 1, "a": {"b": {"c": 2.0}, "d": None}}) == {"step": 1, "a/b/c": 2.0, "a/d": None}
    assert flat({}) == {}


def test_a_resumed_run_goes_on_in_its_files(tmp_path: Path) -> None:
    with TrainingLog(tmp_path) as log:
        log.write({"step": 100, "loss": 3.0})  # of an earlier run, without a checkpoint
    for k, line in enumerate(LINES):
        with TrainingLog(tmp_path, LINES[:k]) as log:
            log.write(line)
    damage = b'\xff\0{"step": 100, "lo\n[1]\n', b'\n{"step": 300, "loss": 0.5, "validation": {}}\n{"step": 40'
    (tmp_path / "log.jsonl").write_bytes(json.dumps(LINES[1]).encode().join(damage))
    with TrainingLog(tmp_path, LINES):
        pass
    kept = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert kept == [{**LINES[0], "samples_per_s": None}, LINES[1]]
    with (tmp_path / "log.csv").open(newline="") as file:
        rows = [*csv.reader(file)]
    assert rows == [
        ["step", "loss", "validation/car", "validation/mean", "samples_per_s"],
        ["100", "1.5", "0.25", "", ""],
        ["200", "0.75", "0.5", "0.125"],
    ]


def test_the_curve_of_a_run_is_a_table(tmp_path: Path) -> None:
    with TrainingLog(tmp_path) as log:
        for k in range(1, 5):
            log.write({"step": k, "samples": 8 * k, "loss": 1.0 / k, "validation": {"background": 0.5, "car": 0.1 * k}})
    with (tmp_path / "log.jsonl").open("a") as file:  # as after a kill
        file.write('{"step": 5, ')
    head, *rows = curve_table(tmp_path, 2)
    assert head == f"{tmp_path}: 4 lines of the log, means of 2"
    means = [["16", "0.7500", "15.0"], ["32", "0.2917", "35.0"]]
    assert [row.split() for row in rows] == [["samples", "loss", "car"], *means, ["last", "quarter", "+10.0"]]
    with pytest.raises(ValueError, match="has no line"):
        list(curve_table(tmp_path / "nothing"))


def test_tensorboard_reads_the_same_figures(tmp_path: Path) -> None:
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    for curve, lines in (((), [*LINES, {"step": 300, "loss": 9.0}]), (LINES[:1], LINES[1:])):
        with TrainingLog(tmp_path, curve, tensorboard=True) as log:
            for line in lines:
                log.write(line)
    events = reading.EventAccumulator(str(tmp_path))
    events.Reload()
    scalars = {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    assert scalars == {
        "step": [(100, 100.0), (200, 200.0)],
        "loss": [(100, 1.5), (200, 0.75)],
        "validation/car": [(100, 0.25), (200, 0.5)],
        "validation/mean": [(200, 0.125)],
    }


def test_a_missing_tensorboard_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'edgeperc\[tensorboard\]'"):
        TrainingLog(tmp_path, tensorboard=True)
