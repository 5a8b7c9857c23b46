"""What an installation promises: it starts without an onnxruntime."""

from __future__ import annotations

from checkout import printed

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


def test_without_onnxruntime_a_perceiver_names_the_install_command() -> None:
    assert "pip install 'edgeperc[cpu]'" in printed(USE_WITHOUT_ONNXRUNTIME, "any.onnx")
