"""The notebooks of the documentation run from top to bottom, and come without outputs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from checkout import REPOSITORY, files

NOTEBOOKS = files(".ipynb", "docs")


def cells(path: Path) -> list[dict[str, Any]]:
    return [cell for cell in json.loads(path.read_text("utf-8"))["cells"] if cell["cell_type"] == "code"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_a_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plots = pytest.importorskip("matplotlib.pyplot")
    plots.switch_backend("agg")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(cells(path), start=1):
        exec(compile("".join(cell["source"]), f"{path.name}, cell {number}", "exec"), names)
    assert plots.get_fignums()
    image = plots.gca().images[-1]  # of the grid: what no ray has shown does not look drivable
    assert image.cmap(image.norm(-1)) != image.cmap(image.norm(0))
    plots.close("all")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_a_notebook_holds_no_outputs(path: Path) -> None:
    found = cells(path)
    assert found
    assert not any(cell["outputs"] or cell["execution_count"] for cell in found)
