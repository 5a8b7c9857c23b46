"""What an installation promises: it starts without an onnxruntime.

The check runs in a fresh interpreter, on a copy of the package in a folder of its own.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import edgeperc

PACKAGE = Path(edgeperc.__file__).parent

USE_WITHOUT_ONNXRUNTIME = """
import sys
sys.modules["onnxruntime"] = None  # what `import onnxruntime` finds where it is not installed: ImportError
import numpy as np
import edgeperc

for name in edgeperc.__all__:
    getattr(edgeperc, name)
try:
    edgeperc.Perceiver(sys.argv[1])
except edgeperc.MissingExtraError as error:
    print(error)
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder to put on the path, with a copy of the package that nobody has used yet."""
    site = tmp_path / "site"
    shutil.copytree(PACKAGE, site / "edgeperc", ignore=shutil.ignore_patterns("__pycache__"))
    return site


def run(site: Path, code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the copy first on its path, and with no settings of numba or edgeperc but those given."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("EDGEPERC_", "NUMBA_"))}
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=site,
        env=inherited | {"PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
    )


def test_without_onnxruntime_a_perceiver_names_the_install_command(site: Path) -> None:
    done = run(site, USE_WITHOUT_ONNXRUNTIME, "any.onnx")
    assert done.returncode == 0, done.stderr
    assert "pip install 'edgeperc[cpu]'" in done.stdout
