"""Figures of a drive without labels."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cli_helpers import POINTSEG, Shell
from edgeperc import Box, OptionError, Perception, PointsError, Tracker
from edgeperc.cli.evaluation.unlabeled import ConsistencySink
from edgeperc.evaluation.consistency import Consistency
from edgeperc.records import PerceivedScan
from edgeperc.types.frame import moved_boxes
from edgeperc.types.sensor import get_sensor

STANDING = np.eye(4)
PARKED = Box("car", 0.9, (20.0, 5.0, -0.9), (4.2, 1.8, 1.5), 0.4)
NOWHERE = {
    "n_objects": 0,
    "n_scans": 0,
    "detected": None,
    "class": None,
    "heading": None,
    "n_detections": 0,
    "lone": None,
}


def points_on(*boxes: Box, n: int = 12) -> NDArray[np.float32]:
    """A road, and points in the upper half of boxes."""
    rng = np.random.default_rng(1)
    road = np.column_stack([rng.uniform(-40.0, 40.0, (4000, 2)), np.full(4000, -1.73), np.full(4000, 0.3)])
    parts = [road]
    for box in boxes:
        along, across, up = (0.9 * (rng.random((n, 3)) - (0.5, 0.5, 0.0)) * (*box.size[:2], 0.5 * box.size[2])).T
        cos, sin = math.cos(box.yaw), math.sin(box.yaw)
        xy = np.column_stack([along * cos - across * sin, along * sin + across * cos])
        parts.append(np.column_stack([xy + box.center[:2], box.center[2] + up, np.full(n, 0.3)]))
    return np.concatenate(parts).astype(np.float32)


def perceived(points: NDArray[np.float32], stamp_s: float, *boxes: Box) -> Perception:
    return Perception(len(points), 0, None, None, boxes, {}, {}, (), stamp_s)


def changed(box: Box, **values: Any) -> Box:
    return Box(**{name: values.get(name, getattr(box, name)) for name in ("label", "score", "center", "size", "yaw")})


def test_figures_are_those_counted_by_hand() -> None:
    """A parked car returns points from the third scan on, and is detected from the seventh to the last but two: once as
    a van, twice with its rear ahead, and once not at all. Something else is detected once.
    """
    consistency, tracker = Consistency(), Tracker()
    for k in range(20):
        boxes = [PARKED] if 6 <= k < 18 and k != 12 else []
        boxes = [changed(box, label="van" if k == 9 else "car", yaw=0.4 + math.pi * (k in (10, 11))) for box in boxes]
        boxes += [Box("pedestrian", 0.5, (8.0, -9.0, -0.9), (0.8, 0.6, 1.7), 0.0)] if k == 3 else []
        points = points_on(PARKED, n=12 if k >= 2 else 2)
        perception = perceived(points, 0.1 * k, *boxes)
        consistency.add(perception, points, tracker(perception, STANDING), f"scan {k}")
    with pytest.warns(UserWarning, match="late or doubled"):
        consistency.add(perception, points, tracker(perception, STANDING))
    figures = consistency.figures()
    assert (figures["n_scans"], figures["n_drives"], [*figures["classes"]]) == (20, 1, ["car", "pedestrian", "van"])
    car = {"n_objects": 1, "n_scans": 18, "detected": 11 / 18, "class": 10 / 11, "heading": 9 / 11}
    car |= {"n_detections": 10, "lone": 0.0}
    assert figures["classes"]["car"] == {
        band: car if band in ("all", "15-30 m") else NOWHERE
        for band in ("all", "0-15 m", "15-30 m", "30-45 m", "45-60 m")
    }
    assert figures["classes"]["van"]["all"] == {**NOWHERE, "n_detections": 1, "lone": 0.0}
    assert figures["classes"]["pedestrian"]["0-15 m"] == {**NOWHERE, "n_detections": 1, "lone": 1.0}
    missed = {2, 3, 4, 5, 12, 18, 19}
    assert figures["scans"] == [{"scan": f"scan {k}", "missed": k in missed, "lone": k == 3} for k in range(20)]


@pytest.mark.parametrize("far_m", [0.0, 5e6])
def test_what_stands_is_looked_for_where_the_sensor_is(far_m: float) -> None:
    """From a sensor that drives a curve, in a map whose origin may be far; after three seconds no longer."""
    consistency, tracker = Consistency(), Tracker()
    for k in range(60):
        turn, pose = 0.01 * k, np.eye(4)
        pose[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
        pose[:3, 3] = far_m + 0.3 * k, far_m, 0.0
        (box,) = moved_boxes([PARKED], (pose[:3, :3].T, -pose[:3, :3].T @ (pose[:3, 3] - (far_m, far_m, 0.0))))
        points = points_on(box)
        perception = perceived(points, 0.1 * k, *([box] if k < 15 else []))
        consistency.add(perception, points, tracker(perception, pose))
    row = consistency.figures()["classes"]["car"]["all"]
    assert (row["n_scans"], row["detected"]) == (45, 15 / 45)


def test_what_drives_is_not_looked_for() -> None:
    """Where a car may be before its first and after its last detection is not known."""
    consistency, tracker = Consistency(), Tracker()
    for k in range(30):
        box = changed(PARKED, center=(5.0 + 0.5 * k, 5.0, -0.9), yaw=0.0)
        points = points_on(box)
        perception = perceived(points, 0.1 * k, *([box] if 10 <= k < 20 else []))
        consistency.add(perception, points, tracker(perception, STANDING))
    row = consistency.figures()["classes"]["car"]["all"]
    assert (row["n_scans"], row["detected"]) == (10, 1.0)


def test_errors_name_the_reason() -> None:
    consistency, points = Consistency(), points_on()
    perception = perceived(points, 0.0)
    tracks = Tracker()(perception)
    assert consistency.figures() == {"n_scans": 0, "n_drives": 0, "classes": {}, "scans": []}
    for bad, error in [
        ((None, points, tracks), OptionError),
        ((perception, points[:5], tracks), PointsError),
        ((perception, points, [*tracks]), OptionError),
        ((perception, points, None), OptionError),
    ]:
        with pytest.raises(error):
            consistency.add(*bad)
    assert consistency.figures()["n_scans"] == 0


FIRST = 4  # scans without a detection


class Seeing:
    """Perceives a parked car in all scans but the first four."""

    def __init__(self, models: Any, *, sensor: str, **_: Any) -> None:
        self.sensor, self.cards, self.n = get_sensor(sensor), (POINTSEG,), 0

    def __call__(self, points: NDArray[np.float32], stamp_s: float | None = None, **_: Any) -> Perception:
        self.n += 1
        return perceived(points, stamp_s or 0.0, *([PARKED] if FIRST < self.n <= 10 else []))


def test_the_command_writes_and_prints_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell) -> None:
    monkeypatch.setitem(sys.modules, "edgeperc.perceiver", SimpleNamespace(Perceiver=Seeing))
    drive, file = tmp_path / "drive", tmp_path / "made/consistency.json"
    drive.mkdir()
    for k in range(10):
        points_on(PARKED).tofile(drive / f"{k:06d}.bin")
    printed = shell.err("run", drive, "--sensor", "hdl-64e", "--track", "--consistency", file, code=0)
    assert "consistency of 10 scans of 1 drive, without labels [%]\n" in printed
    (line,) = (line for line in printed.splitlines() if line.split()[:2] == ["car", "all"])
    assert line.split()[2:] == ["1", "10", "60.0", "100.0", "100.0", "6", "0.0"]
    assert f"look first at {drive}/000000.bin (1 missed, 0 lone), " in printed
    assert json.loads(file.read_text())["classes"]["car"]["15-30 m"]["detected"] == 0.6
    printed = shell.err("run", drive / "000000.bin", "--sensor", "hdl-64e", "--track", "--consistency", file, code=0)
    assert "consistency of 1 scan of 1 drive, without labels [%]: nothing was detected" in printed
    ConsistencySink(file).close()  # without a scan, those before stay
    assert json.loads(file.read_text())["n_scans"] == 1
    monkeypatch.setattr("test_consistency.FIRST", 0)
    printed = shell.err("run", drive, "--sensor", "hdl-64e", "--track", "--consistency", file, code=0)
    assert "100.0" in printed
    assert "look first" not in printed  # nothing contradicts itself
    for options in ([], ["--track", "--live"]):
        refused = "--consistency needs --track, and no --live"
        assert refused in shell.err("run", drive, *options, "--consistency", file)
    sink = ConsistencySink(tmp_path / "stopped.json")
    perception = perceived(points_on(), 0.0)
    sink.write(PerceivedScan("a.bin", 0.0, points_on(), perception, Tracker()(perception), get_sensor("hdl-64e")))
    with pytest.warns(RuntimeWarning, match="stopped.json"):
        sink.close(whole=False)
    assert json.loads((tmp_path / "stopped.json.part").read_text())["n_scans"] == 1
