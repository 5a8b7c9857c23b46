"""The README's Python runs as it stands."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import edgeperc
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate

README = (Path(__file__).resolve().parent.parent / "README.md").read_text(encoding="utf-8")


def test_the_example_runs_on_a_scan_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (example,) = re.findall(r"```python\n(import edgeperc\n.*?)```", README, flags=re.DOTALL)
    assert len([line for line in example.splitlines() if line.strip()]) <= 10
    simulate(random_scene(4, "urban"), "hdl-64e", seed=4).points.tofile(tmp_path / "scan.bin")
    monkeypatch.chdir(tmp_path)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(example, "README.md", "exec"), {})
    lines = printed.getvalue().splitlines()
    assert lines[0].startswith("{'background': ")
    assert float(lines[1]) > 50.0
    assert "ExecutionProvider (" in lines[-1]


def test_the_live_example_runs_on_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (example,) = re.findall(r"```python\n(with edgeperc\.stream.*?)```", README, flags=re.DOTALL)
    (tmp_path / "velodyne").mkdir()
    np.zeros((3, 4), np.float32).tofile(tmp_path / "velodyne" / "0.bin")
    monkeypatch.chdir(tmp_path)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        perceive = lambda points, stamp_s: SimpleNamespace(boxes=len(points))  # noqa: E731
        exec(compile(example, "README.md", "exec"), {"edgeperc": edgeperc, "perceive": perceive})
    (line,) = printed.getvalue().splitlines()
    assert line.split()[1] in {"OK", "LATE", "STALE"}
    assert line.split()[2:] == ["0", "3"]


def test_every_picture_and_link_is_there() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (Path(__file__).resolve().parent.parent / target).exists(), target
