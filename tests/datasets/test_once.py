"""ONCE, written here as it is published, is read with x ahead."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cli_helpers import Shell
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.errors import PointsError
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import SimulatedScan, simulate
from strategies import JSON

KINDS = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian", "cyclist": "Cyclist"}
TIMES = ("1616343527200", "1616343527700", "1616343528200")


@pytest.fixture(scope="module")
def street() -> SimulatedScan:
    return simulate(random_scene(3), "pandar40p", seed=3)


def once(root: Path, street: SimulatedScan) -> Path:
    """A sequence of three frames, of which one has no boxes and one was not annotated; x is to the left, y back."""
    boxes = [box for box in street.boxes if box.label in KINDS]
    rows = [
        [box.center[1], -box.center[0], box.center[2], *box.size, box.yaw - 0.5 * math.pi + 2.0 * math.pi]
        for box in boxes
    ]
    annotations = {"names": [KINDS[box.label] for box in boxes], "boxes_3d": rows, "boxes_2d": {"cam01": [[-1.0] * 4]}}
    frames: list[dict[str, Any]] = [{"frame_id": time, "pose": [0, 0, 0, 1, 0, 0, 0]} for time in TIMES]
    frames[0]["annos"], frames[1]["annos"] = annotations, {"names": [], "boxes_3d": []}
    folder = root / "data" / "000076"
    (folder / "lidar_roof").mkdir(parents=True)
    (folder / "000076.json").write_text(json.dumps({"meta_info": {}, "calib": {}, "frames": frames}))
    x, y, z, remission = street.points.T
    for time in TIMES:
        np.column_stack([y, -x, z, 255.0 * remission]).astype(np.float32).tofile(folder / "lidar_roof" / f"{time}.bin")
    return root


def test_it_is_read_as_it_is(tmp_path: Path, street: SimulatedScan, shell: Shell) -> None:
    folder = ScanFolder.parse(f"{once(tmp_path, street)}:once")
    name = f"000076_{TIMES[0]}"
    assert folder.drives == {name: "000076"}
    frame = folder.frame(name)
    np.testing.assert_array_equal(frame.points[:, :3], street.points[:, :3])
    np.testing.assert_allclose(frame.points[:, 3], 255.0 * street.points[:, 3], rtol=1e-6)
    true = [box for box in street.boxes if box.label in KINDS]
    assert len(frame.boxes or ()) == len(true) > 5
    for box, expected in zip(frame.boxes or (), true, strict=True):
        assert box.label == expected.label
        np.testing.assert_allclose((*box.center, *box.size), (*expected.center, *expected.size), atol=1e-9)
        assert math.cos(box.yaw - expected.yaw) > 1.0 - 1e-9
    assert ScanFolder(tmp_path / "data", "once").drives == folder.drives
    (tmp_path / "train").mkdir()  # a split may have a folder of its own
    (tmp_path / "data").rename(tmp_path / "train" / "data")
    assert ScanFolder(tmp_path, "once").drives == folder.drives
    assert "vehicle" in shell.out("eval", f"{tmp_path}:once", "--split", "all")


def test_a_part_of_the_files_is_enough(tmp_path: Path, street: SimulatedScan) -> None:
    document = once(tmp_path, street) / "data" / "000076" / "000076.json"
    content = json.loads(document.read_text())
    content["frames"][2]["annos"] = content["frames"][0]["annos"]
    document.write_text(json.dumps(content))
    (document.parent / "lidar_roof" / f"{TIMES[0]}.bin").unlink()
    with pytest.warns(UserWarning, match=f"of 2 annotated scans 1 are there, and not .*/{TIMES[0]}.bin"):
        assert [*ScanFolder(tmp_path, "once").drives] == [f"000076_{TIMES[2]}"]
    (document.parent / "lidar_roof" / f"{TIMES[2]}.bin").unlink()
    with pytest.raises(PointsError, match="of 2 annotated scans 0 are there"):
        ScanFolder(tmp_path, "once")


Change = Callable[[dict[str, Any]], object]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda frame: frame.pop("annos"), r"no annotated frame of ONCE; expected SEQ/SEQ\.json"),
        (lambda frame: frame.pop("frame_id"), "a frame that is not ONCE's .KeyError"),
        (lambda frame: frame.update(frame_id="../../1"), "frame_id '../../1', which is no time"),
        (lambda frame: frame["annos"].pop("names"), "expected frame_id, and names and boxes_3d in annos"),
        (lambda frame: frame["annos"]["names"].pop(), "zip.. argument"),
        (
            lambda frame: frame["annos"]["names"].insert(0, None) or frame["annos"]["names"].pop(),
            "a class that is no text",
        ),
        (lambda frame: frame["annos"]["boxes_3d"][0].pop(), f"a box of {TIMES[0]} is none of ONCE's"),
        (lambda frame: frame["annos"]["boxes_3d"][0].__setitem__(3, 0.0), "expected finite numbers and sizes above 0"),
        (lambda frame: frame["annos"]["boxes_3d"][0].__setitem__(6, "north"), f"a box of {TIMES[0]}"),
    ],
)
def test_damaged_documents_are_refused(change: Change, said: str, tmp_path: Path, street: SimulatedScan) -> None:
    document = once(tmp_path, street) / "data" / "000076" / "000076.json"
    content = json.loads(document.read_text())
    change(content["frames"][0])
    document.write_text(json.dumps(content))
    with pytest.raises(PointsError, match=said):
        ScanFolder(tmp_path, "once").frame(f"000076_{TIMES[0]}")


def test_a_cut_scan_is_refused(tmp_path: Path, street: SimulatedScan) -> None:
    scan = once(tmp_path, street) / "data" / "000076" / "lidar_roof" / f"{TIMES[0]}.bin"
    scan.write_bytes(scan.read_bytes()[:-6])
    with pytest.raises(PointsError, match=f"{TIMES[0]}.bin"):
        ScanFolder(tmp_path, "once").frame(f"000076_{TIMES[0]}")


@given(
    frame=st.dictionaries(st.sampled_from(["frame_id", "annos"]), JSON),
    annotations=st.dictionaries(st.sampled_from(["names", "boxes_3d"]), JSON),
)
@settings(max_examples=60)
def test_any_document_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, frame: dict[str, Any], annotations: dict[str, Any]
) -> None:
    folder = tmp_path_factory.mktemp("any") / "000001"
    (folder / "lidar_roof").mkdir(parents=True)
    np.ones((3, 4), np.float32).tofile(folder / "lidar_roof" / "1.bin")
    rows = {"names": ["Car"], "boxes_3d": [[9, 0, 0, 4, 2, 1, 0]]} | annotations
    (folder / "000001.json").write_text(json.dumps({"frames": [{"frame_id": "1", "annos": rows} | frame]}))
    try:
        opened = ScanFolder(folder.parent, "once")
        assert all(opened.frame(name).boxes is not None for name in opened.drives)
    except PointsError:
        pass
