"""Waymo's Perception set, written here as its version 2 is published, is read as it was meant."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli_helpers import Shell
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.errors import MissingExtraError, PointsError
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import SimulatedScan, simulate
from edgeperc.types.sensor import get_sensor

pa = pytest.importorskip("pyarrow", reason="the files are Parquet")
parquet = pytest.importorskip("pyarrow.parquet", reason="the files are Parquet")

KINDS = {"car": 1, "truck": 1, "pedestrian": 2, "cyclist": 4}
TOP, REAR = 1, 5
TOP_M = np.array([1.43, 0.1, 2.184])  # of the vehicle
SEGMENT, TIMES = "10017090168044687777_6380_000_6400_000", (1550083467346370, 1550083467446370)
NAMES = [f"{SEGMENT}_{time}" for time in TIMES]
# With an odd number of columns, the middle of one looks straight ahead, as a ray of the simulation does.
SENSOR = replace(get_sensor("waymo"), columns=1201)
VEHICLE_RPYXYZ = np.array([-0.03, 0.05, 2.0, 700.0, -900.0, 30.0])
STAMP, LASER = "key.frame_timestamp_micros", "key.laser_name"
RANGES = "[LiDARComponent].range_image_return1"
TRANSFORM, BEAMS = (f"[LiDARCalibrationComponent].{of}" for of in ("extrinsic.transform", "beam_inclination.values"))
POSE, CLASSES = "[VehiclePoseComponent].world_from_vehicle.transform", "[LiDARSegmentationLabelComponent]"
Table = dict[str, list[Any]]


def pose(roll: float, pitch: float, yaw: float, *place: float) -> np.ndarray:
    """Matrix (4, 4) of a turn about x, then about y, then about z."""
    matrix = np.eye(4)
    for angle, a, b in ((roll, 1, 2), (pitch, 2, 0), (yaw, 0, 1)):
        one = np.eye(4)
        one[[a, b], [a, b]], one[a, b], one[b, a] = math.cos(angle), -math.sin(angle), math.sin(angle)
        matrix = one @ matrix
    matrix[:3, 3] = place or (0.0, 0.0, 0.0)
    return matrix


@pytest.fixture(scope="module")
def street() -> SimulatedScan:
    return simulate(random_scene(3), SENSOR, seed=3, noise=False)


def pixels(street: SimulatedScan) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of each point in the range image, whose first column looks back and whose second to the right."""
    x, y, z, _ = street.points.T.astype(np.float64)
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    row = np.abs(elevation[:, None] - np.array(SENSOR.elevations_deg)).argmin(axis=1)
    return row, np.rint(0.5 * (SENSOR.columns * (1.0 - np.arctan2(y, x) / math.pi) - 1.0)).astype(int)


def segment(street: SimulatedScan) -> dict[str, Table]:
    """Two frames, of which the second has classes of points. Rows of the files are in other orders."""
    at, (x, y, z, remission) = pixels(street), street.points.T.astype(np.float64)
    image = np.full((SENSOR.n_beams, SENSOR.columns, 4), -1.0, np.float32)  # -1: no return, and in no zone
    image[at] = np.column_stack([np.sqrt(x * x + y * y + z * z), remission, 0.0 * x, 0.0 * x - 1.0])
    poses = np.broadcast_to(VEHICLE_RPYXYZ.astype(np.float32), (*image.shape[:2], 6))
    classes = np.zeros((*image.shape[:2], 2), np.int32)
    classes[..., 0], classes[:32, :, 1], classes[32:, :, 1] = 99, 14, 18  # of instances; building and road

    def images(name: str, *rows: tuple[int, int, np.ndarray]) -> Table:
        of, values = [time for time, _, _ in rows], [values.ravel() for *_, values in rows]
        shapes, lasers = [[*values.shape] for *_, values in rows], [laser for _, laser, _ in rows]
        return {STAMP: of, LASER: lasers, f"{name}.values": values, f"{name}.shape": shapes}

    small = np.ones((2, 3, 4), np.float32)
    boxes = [(time, box) for time in TIMES for box in street.boxes if box.label in KINDS]
    values = {"type": [KINDS[box.label] for _, box in boxes], "box.heading": [box.yaw for _, box in boxes]}
    values |= {f"box.center.{axis}": [box.center[k] + TOP_M[k] for _, box in boxes] for k, axis in enumerate("xyz")}
    values |= {f"box.size.{axis}": [box.size[k] for _, box in boxes] for k, axis in enumerate("xyz")}
    top, beams = pose(0.0, 0.0, 2.6, *TOP_M), np.radians(SENSOR.elevations_deg[::-1])
    lidars = [(time, laser, image if laser == TOP else small) for time in TIMES for laser in (REAR, TOP)]
    return {
        "lidar": images(RANGES, *lidars),
        "lidar_pose": images("[LiDARPoseComponent].range_image_return1", *((time, TOP, poses) for time in TIMES[::-1])),
        "lidar_segmentation": images(f"{CLASSES}.range_image_return1", (TIMES[1], TOP, classes)),
        "lidar_box": {STAMP: [time for time, _ in boxes]} | {f"[LiDARBoxComponent].{of}": values[of] for of in values},
        "lidar_calibration": {LASER: [REAR, TOP], TRANSFORM: [np.ones(16), top.ravel()], BEAMS: [None, beams]},
        "vehicle_pose": {STAMP: [*TIMES], POSE: [pose(*VEHICLE_RPYXYZ).ravel()] * 2},
    }


def write(folder: Path, content: dict[str, Table]) -> Path:
    """Files with types, compression and groups of rows as the published ones have them."""
    for part, table in content.items():
        arrays = {}
        for name, values in table.items():
            number = (
                pa.int32()
                if "shape" in name or CLASSES in name
                else pa.float64()
                if "image" not in name
                else pa.float32()
            )
            size = 16 if name.endswith("transform") else 3 if name.endswith("shape") else -1
            is_list = size > 0 or name.endswith("values")
            arrays[name] = pa.array(values, pa.list_(number, size) if is_list else None)
        (folder / part).mkdir(parents=True, exist_ok=True)
        parquet.write_table(
            pa.table(arrays), folder / part / f"{SEGMENT}.parquet", compression="brotli", row_group_size=3
        )
    return folder


def test_it_is_read_as_it_is(tmp_path: Path, street: SimulatedScan, shell: Shell) -> None:
    write(tmp_path / "training", segment(street))
    folder = ScanFolder.parse(f"{tmp_path}:waymo")
    assert folder.drives == dict.fromkeys(NAMES, SEGMENT)
    row, column = pixels(street)
    points = street.points[np.lexsort((column, row))]
    true = [box for box in street.boxes if box.label in KINDS]
    for name in (*NAMES, NAMES[0]):  # in the order of the file, and back
        frame = folder.frame(name)
        np.testing.assert_allclose(frame.points[:, :3], points[:, :3], atol=2e-3)
        np.testing.assert_allclose(frame.points[:, 3], np.tanh(points[:, 3]), atol=1e-6)
        assert frame.boxes is not None
        for box, expected in zip(frame.boxes, true, strict=True):
            assert box.label == expected.label.replace("truck", "car")
            np.testing.assert_allclose((*box.center, *box.size), (*expected.center, *expected.size), atol=1e-9)
            assert math.cos(box.yaw - expected.yaw) > 1.0 - 1e-9
        if name == NAMES[0]:
            assert frame.point_classes is None
        else:
            labels = frame.labels(("building", "road"), by="points")
            np.testing.assert_array_equal(labels, np.where(np.sort(row) < 32, 0, 1))
    assert ScanFolder(tmp_path / "training", "waymo").drives == folder.drives
    assert "vehicle" in shell.out("eval", f"{tmp_path}:waymo", "--split", "all")


def test_points_are_where_the_vehicle_was_when_they_were_measured(tmp_path: Path, street: SimulatedScan) -> None:
    """Each of the sixteen here, of a LiDAR that is tilted, by products of matrices alone."""
    content, moved = segment(street), np.random.default_rng(4).normal(0.0, [0.01] * 3 + [1.0] * 3, (4, 6, 6))
    poses, top, beams = VEHICLE_RPYXYZ + moved, pose(0.02, -0.03, 2.6, *TOP_M), np.array([-0.3, -0.1, 0.0, 0.04])
    image = np.full((4, 6, 4), -1.0)
    image[:, [0, 1, 3, 4], 0] = np.arange(5.0, 21.0).reshape(4, 4)
    image[1, 2], image[2, 5] = (9.0, 0.1, 0.0, 1.0), (np.inf, 0.1, 0.0, -1.0)  # in a zone without labels; nowhere
    for part, values in (("lidar", image), ("lidar_pose", poses)):
        name = next(key for key in content[part] if key.endswith("values"))
        content[part] |= {STAMP: [TIMES[0]], LASER: [TOP], name: [values.ravel()]}
        content[part][name.replace("values", "shape")] = [[*values.shape]]
    content["lidar_calibration"] = {LASER: [TOP], TRANSFORM: [top.ravel()], BEAMS: [beams]}
    del content["lidar_segmentation"]
    points = ScanFolder(write(tmp_path, content), "waymo").frame(NAMES[0]).points
    expected = []
    for row, column in np.argwhere((image[..., 0] > 0.0) & (image[..., 0] < 100.0) & (image[..., 3] < 0.0)).tolist():
        ray = pose(
            0.0, -beams[3 - row], math.pi - (column + 0.5) / 6.0 * 2.0 * math.pi - math.atan2(top[1, 0], top[0, 0])
        )
        in_top = ray @ [image[row, column, 0], 0.0, 0.0, 1.0]
        in_vehicle = np.linalg.inv(pose(*VEHICLE_RPYXYZ)) @ pose(*poses[row, column].astype(np.float32)) @ top @ in_top
        expected.append(in_vehicle[:3] - TOP_M)
    assert len(expected) == 16
    np.testing.assert_allclose(points[:, :3], expected, atol=1e-4)


def test_a_part_of_the_files_is_enough(tmp_path: Path, street: SimulatedScan) -> None:
    whole = ScanFolder(write(tmp_path / "whole", content := segment(street)), "waymo").frame(NAMES[1])
    root = write(
        tmp_path / "part", {part: content[part] for part in content if part not in ("lidar_pose", "lidar_box")}
    )
    with pytest.warns(UserWarning, match="of 1 files of lidar_pose 0 are there, and not .*; the others are left out"):
        folder = ScanFolder(root, "waymo")
    assert [*folder.drives] == NAMES[1:]  # those with labels
    frame = folder.frame(NAMES[1])
    assert frame.boxes is None
    np.testing.assert_allclose(frame.points, whole.points, atol=1e-3)  # of a vehicle that stands
    (root / "lidar_segmentation" / "other.parquet").write_bytes(b"")
    lacking = pytest.warns(UserWarning, match="of 2 files of lidar 1 are there, and not .*/lidar/other.parquet")
    with lacking, pytest.warns(UserWarning, match="files of lidar_pose"):
        assert [*ScanFolder(root, "waymo").drives] == NAMES[1:]
    (root / "lidar_calibration" / f"{SEGMENT}.parquet").unlink()
    with pytest.warns(UserWarning, match="files of lidar"), pytest.raises(PointsError, match="lidar_calibration 0 are"):
        ScanFolder(root, "waymo")
    with pytest.raises(PointsError, match=r"has no labels of Waymo; expected lidar_box/SEGMENT.parquet .* version 2"):
        ScanFolder(root / "lidar", "waymo")


Change = Callable[[dict[str, Table]], object]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda of: of["lidar"][LASER].__setitem__(slice(None), [REAR] * 4),
            "has no labeled frame of TOP; expected rows",
        ),
        (lambda of: of["lidar"].pop(f"{RANGES}.values"), r"lidar/.*cannot be read.*expected columns key\.laser_name"),
        (lambda of: of["lidar"][f"{RANGES}.shape"].__setitem__(3, [64, 1201, 3]), "3 channels; expected 4"),
        (lambda of: of["lidar"][f"{RANGES}.shape"].__setitem__(3, [64, 1200, 4]), "cannot reshape"),
        (lambda of: of["lidar"][f"{RANGES}.shape"].__setitem__(3, None), "is not as Waymo's"),
        (lambda of: of["lidar_calibration"][LASER].__setitem__(1, 2), "is not as Waymo's .StopIteration"),
        (lambda of: of["lidar_calibration"][TRANSFORM].__setitem__(1, np.ones(16)), "transform of .* is not rigid"),
        (lambda of: of["lidar_calibration"][BEAMS].__setitem__(1, [0.1] * 63), r".63,. inclinations; expected 64"),
        (lambda of: of["lidar_calibration"][BEAMS].__setitem__(1, [np.nan] * 64), "expected 64 finite ones"),
        (lambda of: of["lidar_calibration"][BEAMS].__setitem__(1, None), "is not as Waymo's .TypeError"),
        (lambda of: of["vehicle_pose"][POSE].__setitem__(1, [np.nan] * 16), "transform of .* finite numbers"),
        (lambda of: of["vehicle_pose"][STAMP].__setitem__(1, 7), "is not as Waymo's .StopIteration"),
        (lambda of: of["lidar_pose"][STAMP].__setitem__(0, 7), f"lidar_pose/.*has no row .1, {TIMES[1]}. of key.laser"),
        (lambda of: of["lidar_pose"]["[LiDARPoseComponent].range_image_return1.values"][0].fill(np.nan), "not finite"),
        (lambda of: of["lidar_box"]["[LiDARBoxComponent].box.size.y"].__setitem__(-1, 0.0), "sizes above 0"),
        (lambda of: of["lidar_box"]["[LiDARBoxComponent].type"].__setitem__(-1, 7), "is not as Waymo's .KeyError.7"),
        (
            lambda of: of["lidar_segmentation"][f"{CLASSES}.range_image_return1.values"][0].fill(77),
            r"no name for 77; add it to waymo\.json or, in the description, to point_names",
        ),
        (lambda of: of["lidar_segmentation"][f"{CLASSES}.range_image_return1.values"][0].fill(-1), "no name for 1844"),
    ],
)
def test_damaged_tables_are_refused(change: Change, said: str, tmp_path: Path, street: SimulatedScan) -> None:
    content = segment(street)
    content["lidar_pose"]["[LiDARPoseComponent].range_image_return1.values"][0] = np.tile(VEHICLE_RPYXYZ, 64 * 1201)
    change(content)
    with pytest.raises(PointsError, match=said):
        ScanFolder(write(tmp_path, content), "waymo").frame(NAMES[1])


def test_damaged_files_are_refused(tmp_path: Path, street: SimulatedScan, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, segment(street))
    for part in ("lidar", "lidar_calibration", "lidar_box", "lidar_pose", "vehicle_pose", "lidar_segmentation"):
        path = tmp_path / part / f"{SEGMENT}.parquet"
        content = path.read_bytes()
        halved = content[:300] + bytes(len(content) - 600) + content[-300:]
        for damaged in (b"", content[: len(content) // 2], b"PAR1" + bytes(900), halved):
            path.write_bytes(damaged)
            with pytest.raises(PointsError, match=f"{part}/{SEGMENT}.parquet cannot be read"):
                ScanFolder(tmp_path, "waymo").frame(NAMES[1])
        path.write_bytes(content)
    assert ScanFolder(tmp_path, "waymo").frame(NAMES[1]).boxes
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"edgeperc\[argoverse\]"):
        ScanFolder(tmp_path, "waymo")
