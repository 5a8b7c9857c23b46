"""A simulated KITTI object set, a network that finds its road, and drawn roads, for tests of the top-view database."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import onnx

from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.card import CARD_KEY, InputSpec, ModelCard, OutputSpec
from edgeperc.types.perception import Box
from edgeperc.types.views import TopViewGeometry

if TYPE_CHECKING:
    from edgeperc_export.database.scenes import Plan

DRIVES = ("0005", "0005", "0005", "0048", "0029", "0013", "0014", "0011")
TRAPEZIUM = [[40.0, 399.5], [90.0, 10.0], [120.0, 10.0], [160.0, 399.5]]
INPUT = InputSpec("top_view", ("distance", "remission", "height"), (0.0, 0.0, -2.5), (47.07, 1.0, 5.0))


def simulated_kitti(root: Path, drives: Sequence[str] = DRIVES, seeds: Sequence[int] = range(10, 18)) -> Path:
    """A simulated KITTI object set, by default with seven scenes of training drives and one of a test drive."""
    for part in ("velodyne", "label_2", "calib"):
        (root / "training" / part).mkdir(parents=True)
    # The camera is tilted a little, like KITTI's.
    calibration = "P2: 700 0 620 0 0 700 180 0 0 0 1 0\nR0_rect: 1 0 0 0 0.99995 -0.01 0 0.01 0.99995\n"
    calibration += "Tr_velo_to_cam: 0 -1 0 0.1 0 0 -1 -0.08 1 0 0 -0.27\n"
    rows = ["name,drive"]
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, 0.99995, -0.01], [0, 0.01, 0.99995]]
    T_cam_velo = T @ [[0, -1, 0, 0.1], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]]
    for k, (drive, seed) in enumerate(zip(drives, seeds, strict=True)):
        scan = simulated_scan(10**9 + seed)
        scan.points.tofile(root / "training/velodyne" / f"{k:06d}.bin")
        rows.append(f"{k:06d},2011_09_26_drive_{drive}")
        lines = ["DontCare -1 -1 -10 500 170 590 190 -1 -1 -1 -1000 -1000 -1000 -10"]
        for box in [*scan.boxes, Box("truck", 1.0, (30.0, 6.5, 0.0), (9.0, 2.5, 3.0), 0.1 * k)]:
            if box.center[0] > 1.0:
                x, y, z = (T_cam_velo @ [*box.center, 1.0])[:3]
                length, width, height = box.size
                shape = f"{height} {width} {length} {x} {y + height / 2} {z} {-box.yaw - np.pi / 2}"
                lines.append(f"{box.label.capitalize()} 0 0 0 0 0 0 0 {shape}")
        (root / "training/label_2" / f"{k:06d}.txt").write_text("\n".join(lines) + "\n")
        (root / "training/calib" / f"{k:06d}.txt").write_text(calibration)
    (root / "frames.csv").write_text("\n".join(rows) + "\n")
    return root


def road_network(path: Path, view: TopViewGeometry, classes: tuple[str, ...] = ("background", "drivable")) -> Path:
    """One convolution that calls low ground drivable."""
    weight = np.zeros((2, 3, 1, 1), np.float32)
    weight[1, 2] = -3.0
    tensors = [onnx.numpy_helper.from_array(weight, "w"), onnx.numpy_helper.from_array(np.float32([0, 0.7]), "b")]
    shapes = [("top_view", 3), ("segmentation", 2)]
    (given, answer) = (
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, n, view.height, view.width])
        for name, n in shapes
    )
    node = onnx.helper.make_node("Conv", ["top_view", "w", "b"], ["segmentation"], kernel_shape=[1, 1])
    graph = onnx.helper.make_graph([node], "road", [given], [answer], tensors)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    outputs = (OutputSpec("segmentation", "class_logits"),)
    card = ModelCard(name="low", version="1.0.0", view=view, input=INPUT, outputs=outputs, classes=classes)
    model.metadata_props.add(key=CARD_KEY, value=card.to_json())
    onnx.save(model, path)
    return path


def plan_of(kitti: Path, out: Path, model: str, **changes: object) -> Plan:
    from edgeperc_export.database.scenes import Plan  # here, as it needs the packages of the database

    return replace(Plan(kitti, out, model, provider="cpu", variations=3), **changes)  # type: ignore[arg-type]


def drawn(**changes: object) -> str:
    image = {"id": 1, "file_name": "a/000001.png", "width": 200, "height": 400}
    annotation = {"id": 1, "image_id": 1, "category_id": 2, "segmentation": [[10, 20, 30, 20, 30, 60, 10, 60]]}
    content: dict[str, object] = {
        "images": [image | changes.pop("image", {})],  # type: ignore[operator]
        "categories": [{"id": 1, "name": "background"}, {"id": 2, "name": "Road"}],
        "annotations": [annotation | changes.pop("annotation", {})],  # type: ignore[operator]
    }
    return json.dumps(content | changes)
