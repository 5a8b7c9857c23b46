"""Use one extra in an environment that has it alone: ``python tests/smoke.py EXTRA``.

Imports what the extra installs, so that no test is skipped for want of it, installs that without which its tests do
nothing, such as onnxruntime, and runs the tests that use it. They need filelock, hypothesis, pytest and
pytest-xdist.
"""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

# Modules that an extra brings, and arguments of pytest: tests that use them. The extras docs and test are whole jobs.
# BESIDE has what these tests want, too.
SMOKE: dict[str, tuple[list[str], list[str]]] = {
    "all": (["fsspec", "rerun", "shtab", "zenoh"], ["tests/sinks/test_viewers.py", "tests/ros2/test_ros2_messages.py"]),
    "bags": (["lz4", "zstandard"], ["tests/readers/test_bags.py", "tests/readers/test_clouds.py"]),
    "bench": (["psutil"], ["tests/bench/test_bench_measure.py"]),
    "camera": (["PIL"], ["tests/camera/test_camera.py"]),
    "completion": (["shtab"], ["tests/cli/test_cli_info.py", "-k", "complet"]),
    "jit": (["numba"], ["tests/system/test_kernels.py"]),
    "cpu": (["onnxruntime"], ["tests/inference/test_session.py", "tests/cli/test_doctor.py"]),
    "database": (
        ["faster_coco_eval", "filelock", "PIL", "shapely", "tqdm"],
        ["tests/export/test_database.py", "-k", "not ray"],
    ),
    "export": (["torch", "onnx", "onnxscript"], ["tests/export/test_networks.py", "tests/export/test_losses.py"]),
    "argoverse": (["pyarrow"], ["tests/datasets/test_trees.py", "tests/datasets/test_waymo.py", "-k", "logs or waymo"]),
    "foxglove": (["foxglove"], ["tests/sinks/test_viewers.py", "-k", "foxglove or mcap"]),
    "geometry": (["open3d", "pypatchworkpp", "sklearn"], ["tests/bench/test_peers.py", "-k", "ground"]),
    "gpu": (["onnxruntime"], ["tests/inference/test_session.py"]),
    "io": (["lz4", "velodyne_decoder", "zstandard"], ["tests/readers/test_captures.py", "tests/readers/test_times.py"]),
    "loadgen": (["mlperf_loadgen"], ["tests/bench/test_bench_measure.py", "-k", "loadgen"]),
    "openvino": (["onnxruntime"], ["tests/inference/test_session.py", "tests/cli/test_doctor.py"]),
    "ouster": (
        ["ouster.sdk"],
        ["tests/readers/test_captures.py", "tests/readers/test_times.py", "-k", "ouster or osf"],
    ),
    "peers": (["openvino", "stonesoup", "torch"], ["tests/bench/test_peers.py"]),
    "progress": (["tqdm"], ["tests/cli/test_cli.py", "-k", "progress"]),
    "ray": (["ray"], ["tests/system/test_ray_cluster.py", "-k", "ray or process"]),
    "remote": (["fsspec"], ["tests/system/test_ray_cluster.py", "-k", "memory or fetched or protocol"]),
    "rerun": (["rerun"], ["tests/sinks/test_viewers.py", "-k", "rerun or rrd"]),
    "robot": (["onnxruntime", "zenoh", "velodyne_decoder"], ["tests/ros2/test_ros2_node.py"]),
    "ros": (
        ["lz4", "rosbags", "zstandard"],
        ["tests/readers/test_bags.py", "tests/readers/test_times.py", "-k", "bag or mcap"],
    ),
    "ros2": (["rosbags", "zenoh"], ["tests/ros2/test_ros2_messages.py", "tests/ros2/test_ros2_node.py"]),
    "slam": (["kiss_icp"], ["tests/bench/test_slam.py", "tests/readers/test_scan_odometry.py"]),
    "tensorboard": (["tensorboard", "torch"], ["tests/export/test_log.py"]),
    "velodyne": (
        ["velodyne_decoder"],
        ["tests/readers/test_captures.py", "tests/readers/test_times.py", "-k", "velodyne"],
    ),
    "view": (["matplotlib", "PIL"], ["tests/view/test_pictures.py"]),
    "viewers": (["foxglove", "matplotlib", "rerun"], ["tests/sinks/test_viewers.py"]),
}
BESIDE = {
    "camera": ["--editable", ".[cpu]"],
    "database": ["--editable", ".[cpu,export]"],
    "foxglove": ["mcap>=1.2", "protobuf>=4"],
    "viewers": ["mcap>=1.2", "protobuf>=4"],
    "all": ["mcap>=1.2", "protobuf>=4"],
    "loadgen": ["--editable", ".[bench,cpu]"],
    "ray": ["--editable", ".[cpu]"],
    "remote": ["--editable", ".[cpu]"],
}


def main(extra: str) -> int:
    """Import what the extra brings and run its tests; the exit code of pytest."""
    modules, arguments = SMOKE[extra]
    for name in modules:
        importlib.import_module(name)
    if extra in BESIDE:
        pip = [sys.executable, "-m", "pip", "install", "--quiet", *BESIDE[extra]]
        subprocess.run(pip, cwd=Path(__file__).parent.parent, check=True)
    # Newer packages below the lowest ones deprecate what these use; elsewhere every warning is an error.
    quiet = ["-W", "ignore::DeprecationWarning"]
    command = [sys.executable, "-m", "pytest", "-q", *quiet, *arguments]
    return subprocess.run(command, cwd=Path(__file__).parent.parent).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
