"""What an installation promises: it starts without an onnxruntime, and its compiled kernels outlive the process.

Every check runs in a fresh interpreter, on a copy of the package in a folder of its own.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import pytest

import edgeperc

PACKAGE = Path(edgeperc.__file__).parent

# Projects a handful of points and reports what numba's cache did.
USE_KERNELS = """
import json, pathlib
import numpy as np
from numba.core.dispatcher import Dispatcher
from edgeperc.inference import projection
from edgeperc.types.card import InputSpec
from edgeperc.types.views import TopViewGeometry

channels = ("distance", "remission", "height")
view = TopViewGeometry()
points = np.random.default_rng(7).uniform(-2.0, 40.0, (1000, 4)).astype(np.float32)
projected = projection.make_projector(view, InputSpec("image", channels, (0.0,) * 3, (1.0,) * 3)).project(points)
kernels = [thing for thing in vars(projection).values() if isinstance(thing, Dispatcher) and thing.signatures]
print(json.dumps({
    "package": projection.__file__,
    "kernels": len(kernels),
    "hits": sum(sum(kernel.stats.cache_hits.values()) for kernel in kernels),
    "misses": sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels),
    "folders": sorted({str(pathlib.Path(kernel.stats.cache_path)) for kernel in kernels}),
    "sum": float(projected.image.sum(dtype=np.float64)),
}))
"""

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

needs_compiler = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled with the JIT off")


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder to put on the path, with a copy of the package that nobody has used yet."""
    site = tmp_path / "site"
    shutil.copytree(PACKAGE, site / "edgeperc", ignore=shutil.ignore_patterns("__pycache__"))
    return site


def run(site: Path, code: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the copy first on its path, and with no settings of numba or edgeperc but those given."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("EDGEPERC_", "NUMBA_"))}
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=site,
        env=inherited | {"PYTHONPATH": str(site)} | environment,
        capture_output=True,
        text=True,
    )


def use_kernels(site: Path, **environment: str) -> dict[str, Any]:
    done = run(site, USE_KERNELS, **environment)
    assert done.returncode == 0, done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    assert Path(report["package"]).is_relative_to(site), "another copy of edgeperc was imported"
    assert report["kernels"] > 0
    return report


@needs_compiler
def test_the_second_process_compiles_nothing_and_an_edited_kernel_is_compiled_again(site: Path) -> None:
    first, second = use_kernels(site), use_kernels(site)
    assert (first["hits"], first["misses"]) == (0, first["kernels"])
    assert (second["hits"], second["misses"]) == (second["kernels"], 0)
    assert second["sum"] == first["sum"]
    assert first["folders"] == [str(site / "edgeperc" / "inference" / "__pycache__")]
    source = site / "edgeperc" / "inference" / "projection.py"
    text = source.read_text("utf-8")
    source.write_text(text + "\n# edited\n", "utf-8")
    assert use_kernels(site)["misses"] == 0  # the same machine code
    assert "\nPIXEL_BLOCK = " in text
    source.write_text(text.replace("\nPIXEL_BLOCK = ", "\nPIXEL_BLOCK = 2 * "), "utf-8")
    edited = use_kernels(site)
    assert edited["misses"] == 1  # that of the kernel that reads it
    assert edited["sum"] == first["sum"]


def test_without_onnxruntime_a_perceiver_names_the_install_command(site: Path) -> None:
    done = run(site, USE_WITHOUT_ONNXRUNTIME, "any.onnx")
    assert done.returncode == 0, done.stderr
    assert "pip install 'edgeperc[cpu]'" in done.stdout
