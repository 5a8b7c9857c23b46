"""What an installation promises: it starts without an onnxruntime, and names the extra that is missing."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from checkout import printed
from edgeperc.errors import MissingExtraError
from edgeperc.readers.packet_messages import VelodyneStream
from edgeperc.ros2.zenoh_graph import ZenohGraph
from edgeperc.sinks.foxglove import McapSink, ServeSink
from edgeperc.sinks.rerun import RerunSink
from edgeperc.sinks.rosbag import BagSink
from edgeperc.system.ray_cluster import map_on_ray

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


@pytest.mark.parametrize(
    ("module", "extra", "use"),
    [
        ("foxglove", "foxglove", lambda folder: McapSink(folder / "a")),
        ("foxglove", "foxglove", lambda _: ServeSink()),
        ("ray", "ray", lambda _: list(map_on_ray(int, (), [1]))),
        ("rerun", "rerun", lambda folder: RerunSink(folder / "a")),
        ("rosbags.rosbag2", "ros", lambda folder: BagSink(folder / "bag")),
        ("velodyne_decoder", "velodyne", lambda _: VelodyneStream()),
        ("zenoh", "ros2", lambda _: ZenohGraph()),
    ],
)
def test_a_missing_extra_is_named(
    module: str, extra: str, use: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [module, *(name for name in sys.modules if name.startswith(f"{module}."))]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=rf"edgeperc\[{extra}\]"):
        use(tmp_path)
    assert not [*tmp_path.iterdir()]
