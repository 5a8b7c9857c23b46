"""nuScenes' tables and Argoverse 2's logs, written here as these sets have them, are read as they were meant."""

from __future__ import annotations

import contextlib
import json
import math
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cli_helpers import Shell
from edgeperc.datasets.scan_folder import ScanFolder, ScanFrame
from edgeperc.errors import MissingExtraError, PointsError
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate
from edgeperc.types.perception import Box
from strategies import JSON

Streets = list[tuple[np.ndarray, list[Box]]]
RIGHT = math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5)  # w, x, y, z of a quarter turn to the right
SEEN = {"car": "vehicle.car", "pedestrian": "human.pedestrian.adult", "cyclist": "vehicle.bicycle"}
AV2 = {"car": "REGULAR_VEHICLE", "pedestrian": "PEDESTRIAN", "cyclist": "BICYCLIST"}
EGO_M = np.array([1.0, 0.2, 1.84])  # the LiDAR in the vehicle


def product(a: Any, b: Any) -> np.ndarray:
    """Of two quaternions, w, x, y, z."""
    (w, *v), (u, *t) = a, b
    v, t = np.array(v), np.array(t)
    return np.array([w * u - v @ t, *(w * t + u * v + np.cross(v, t))])


def rotated(q: Any, v: Any) -> np.ndarray:
    w, x, y, z = q
    return product(product(q, [0.0, *v]), [w, -x, -y, -z])[1:]


def about_z(angle: float) -> tuple[float, float, float, float]:
    return math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle)


@pytest.fixture(scope="module")
def streets() -> Streets:
    """Scans with x ahead and the boxes of their vehicles and people."""
    scans = [simulate(random_scene(seed), "hdl-32e", seed=seed) for seed in (3, 4)]
    return [(scan.points, [box for box in scan.boxes if box.label in SEEN]) for scan in scans]


class Vehicle:
    """A vehicle in the world: tilted, far from its origin."""

    def __init__(self, k: int) -> None:
        self.place = np.array([600.0 + k, 1600.0, 3.0])
        tilt = math.cos(0.01), math.sin(0.01), 0.0, 0.0
        self.turn = product(about_z(2.0 + k), tilt)

    def world(self, box: Box, sensor_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Place and rotation in the world of a box in the frame whose axes are the vehicle's."""
        in_vehicle = np.array(box.center) + sensor_m
        return self.place + rotated(self.turn, in_vehicle), product(self.turn, about_z(box.yaw))


def nuscenes(root: Path, streets: Streets, **changes: list[dict[str, Any]]) -> Path:
    """A set of nuScenes: x of the LiDAR is to the right, a bicycle has a rider, and a camera and a sweep are beside."""
    kinds = [*SEEN.values()]
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": "s", "name": "scene-0061"}],
        "sensor": [
            {"token": "l", "channel": "LIDAR_TOP", "modality": "lidar"},
            {"token": "c", "channel": "CAM_FRONT", "modality": "camera"},
        ],
        "calibrated_sensor": [
            {"token": f"on-{of}", "sensor_token": of, "translation": EGO_M.tolist(), "rotation": RIGHT} for of in "lc"
        ],
        "attribute": [{"token": "r", "name": "cycle.with_rider"}, {"token": "n", "name": "cycle.without_rider"}],
        "category": [{"token": kind, "name": kind, "index": 17 + k} for k, kind in enumerate(kinds)]
        + [{"token": "n", "name": "noise", "index": 0}, {"token": "d", "name": "flat.driveable_surface", "index": 24}],
        "instance": [{"token": f"a-{kind}", "category_token": kind} for kind in kinds],
        **{name: [] for name in ("sample", "sample_data", "ego_pose", "sample_annotation", "lidarseg")},
    }
    for k, (points, boxes) in enumerate(streets):
        vehicle, file = Vehicle(k), f"samples/LIDAR_TOP/n015__LIDAR_TOP__{k}.pcd.bin"
        tables["sample"].append({"token": f"t{k}", "scene_token": "s"})
        tables["ego_pose"].append({"token": f"e{k}", "translation": [*vehicle.place], "rotation": [*vehicle.turn]})
        data = {"token": f"d{k}", "sample_token": f"t{k}", "ego_pose_token": f"e{k}", "is_key_frame": True}
        lidar = {"calibrated_sensor_token": "on-l", "filename": file}
        tables["sample_data"] += [
            data | lidar,
            data | {"token": f"c{k}", "calibrated_sensor_token": "on-c", "filename": f"samples/CAM_FRONT/{k}.jpg"},
            data | lidar | {"token": f"w{k}", "is_key_frame": False, "filename": file.replace("samples", "sweeps")},
        ]
        for box in boxes:
            place, turn = vehicle.world(box, EGO_M)
            length, width, height = box.size
            box_of = {"translation": [*place], "rotation": [*turn], "size": [width, length, height]}
            kind, ridden = SEEN[box.label], ["r"] if box.label == "cyclist" else []
            tables["sample_annotation"].append(
                {"token": "x", "sample_token": f"t{k}", "instance_token": f"a-{kind}", "attribute_tokens": ridden}
                | box_of
            )
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        x, y, z, remission = points.T
        np.column_stack([-y, x, z, remission * 255.0, np.zeros(len(x))]).astype(np.float32).tofile(root / file)
        (root / "lidarseg").mkdir(exist_ok=True)
        np.where(z < -1.6, 24, 0).astype(np.uint8).tofile(root / "lidarseg" / f"{k}.bin")
        tables["lidarseg"].append({"token": f"d{k}", "sample_data_token": f"d{k}", "filename": f"lidarseg/{k}.bin"})
    (root / "v1.0-mini").mkdir(parents=True, exist_ok=True)
    for name, rows in (tables | changes).items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows, indent=0))
    return root


def argoverse2(root: Path, streets: Streets) -> Path:
    """A log of Argoverse 2, with a sweep that nobody labeled."""
    feather = pytest.importorskip("pyarrow.feather")
    pyarrow = pytest.importorskip("pyarrow")

    def write(path: Path, columns: dict[str, Any]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        feather.write_feather(pyarrow.table(columns), str(path))

    log, turn, place = root / "val" / "7fab", ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")
    rows: list[dict[str, Any]] = []
    egos: list[dict[str, Any]] = []
    for k, (points, boxes) in enumerate([*streets, streets[0]]):
        stamp, vehicle = 10**18 + k, Vehicle(k)
        xyz = points[:, :3] + EGO_M
        write(
            log / "sensors" / "lidar" / f"{stamp}.feather",
            {name: xyz[:, axis].astype(np.float16) for axis, name in enumerate("xyz")}
            | {"intensity": (points[:, 3] * 255.0).astype(np.uint8), "laser_number": np.zeros(len(xyz), np.uint8)},
        )
        egos.append({"timestamp_ns": stamp, **dict(zip(turn + place, [*vehicle.turn, *vehicle.place], strict=True))})
        for box in boxes if k < len(streets) else []:
            size = dict(zip(("length_m", "width_m", "height_m"), box.size, strict=True))
            pose = dict(zip(turn + place, [*about_z(box.yaw), *(np.array(box.center) + EGO_M)], strict=True))
            rows.append({"timestamp_ns": stamp, "category": AV2.get(box.label), "num_interior_pts": 9, **size, **pose})
    sensors = {"sensor_name": ["ring_front_center", "up_lidar"], "qw": [1.0, 1.0]}
    sensors |= {name: [0.0, value] for name, value in zip(place, EGO_M.tolist(), strict=True)}
    write(log / "calibration" / "egovehicle_SE3_sensor.feather", sensors)
    for file, of in (("annotations", rows), ("city_SE3_egovehicle", egos)):
        write(log / f"{file}.feather", {name: [row[name] for row in of] for name in of[0]})
    corners = [Vehicle(0).place + rotated(Vehicle(0).turn, [x, y, 0.0]) for x, y in ((0, -3), (30, -3), (30, 4))]
    boundary = [dict(zip("xyz", corner.tolist(), strict=True)) for corner in corners]
    (log / "map").mkdir(exist_ok=True)
    areas = {"drivable_areas": {"1": {"area_boundary": boundary, "id": 1}}, "lane_segments": {}}
    (log / "map" / "log_map_archive_7fab____PIT_city_1.json").write_text(json.dumps(areas))
    return root


def check(frame: ScanFrame, points: np.ndarray, boxes: list[Box], within_m: float) -> None:
    """The scan of a street, with its boxes."""
    np.testing.assert_allclose(frame.points[:, :3], points[:, :3], atol=within_m)
    assert frame.boxes is not None
    assert [box.label for box in frame.boxes] == [box.label for box in boxes]
    for box, true in zip(frame.boxes, boxes, strict=True):
        np.testing.assert_allclose((*box.center, *box.size), (*true.center, *true.size), atol=1e-3)
        assert math.cos(box.yaw - true.yaw) > 1.0 - 1e-6


def test_nuscenes_is_read_from_its_tables(tmp_path: Path, streets: Streets) -> None:
    folder = ScanFolder.parse(f"{nuscenes(tmp_path, streets)}:nuscenes")
    assert folder.drives == {f"n015__LIDAR_TOP__{k}": "scene-0061" for k in range(2)}
    assert any(box.label == "cyclist" for _, boxes in streets for box in boxes)
    for k, (points, boxes) in enumerate(streets):
        frame = folder.frame(f"n015__LIDAR_TOP__{k}")
        check(frame, points, boxes, 1e-4)
        np.testing.assert_allclose(frame.points[:, 3], 255.0 * points[:, 3], rtol=1e-6)
        of_points = zip(frame.labels(("background", "road")).tolist(), (points[:, 2] < -1.6).tolist(), strict=True)
        assert {*of_points} == {(255, False), (1, True)}
    assert ScanFolder(tmp_path / "v1.0-mini", "nuscenes").drives == folder.drives


def test_argoverse2_is_read_from_its_logs(tmp_path: Path, streets: Streets) -> None:
    folder = ScanFolder.parse(f"{argoverse2(tmp_path, streets)}:av2")
    assert folder.drives == {f"7fab_{10**18 + k}": "7fab" for k in range(2)}
    for k, (points, boxes) in enumerate(streets):
        frame = folder.frame(f"7fab_{10**18 + k}")
        check(frame, points, boxes, 0.04)  # float16 rounds by 1.6 cm beyond 32 m
        np.testing.assert_allclose(frame.points[:, 3], points[:, 3], atol=1.01 / 255)
    (area,) = folder.frame(f"7fab_{10**18}").drivable or ()
    np.testing.assert_allclose(area + EGO_M, [(0, -3, 0), (30, -3, 0), (30, 4, 0)], atol=1e-6)
    folder.scans[f"7fab_{10**18}"].unlink()
    with pytest.warns(UserWarning, match="of 2 labeled scans 1 are there, and not .*/val/7fab/sensors"):
        ScanFolder(tmp_path, "av2")


@pytest.mark.parametrize(("of", "layout"), [(nuscenes, "nuscenes"), (argoverse2, "av2")])
def test_it_is_evaluated_as_it_is(
    of: Callable[..., Path], layout: str, tmp_path: Path, streets: Streets, shell: Shell
) -> None:
    root = of(tmp_path, streets)
    said = shell.out("eval", f"{root}:{layout}", "--json", tmp_path / "figures.json")
    assert "vehicle" in said
    assert layout in (tmp_path / "figures.json").read_text()


def test_files_in_the_plain_layout_are_read_with_the_same_name(tmp_path: Path) -> None:
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "label").mkdir()
    np.ones((3, 4), np.float32).tofile(tmp_path / "velodyne" / "a.bin")
    (tmp_path / "label" / "a.txt").write_text("BUS 10 0 0 12 3 3 0\n")
    for layout, label in (("av2", "truck"), ("lyft", "truck")):
        folder = ScanFolder.parse(f"{tmp_path}:{layout}")
        assert folder.layout.files == "plain"
        (box,) = folder.frame("a").boxes or ()
        assert box.label == label


def changed(table: str, rows: Any) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        (root / "v1.0-mini" / f"{table}.json").write_text(rows if isinstance(rows, str) else json.dumps(rows))

    return change


def replaced(path: Path, before: str, after: str) -> None:
    path.write_text(path.read_text().replace(before, after))


def test_other_sets_with_such_tables_are_read(tmp_path: Path, streets: Streets) -> None:
    """T4 lists LiDARs without scans, and classes without a number; Lyft's scans on Kaggle lie in train_lidar."""
    folder = ScanFolder(nuscenes(tmp_path, streets[:1]), "nuscenes")
    (expected,) = map(folder.frame, folder.drives)
    tables = (tmp_path / "v1.0-mini").rename(tmp_path / "train_data")
    (tmp_path / "samples").rename(tmp_path / "train_samples")
    (tables / "lidarseg.json").unlink()
    replaced(tables / "sensor.json", "LIDAR_TOP", "LIDAR_CONCAT")
    replaced(tables / "sensor.json", "camera", "lidar")
    replaced(tables / "sample_data.json", "on-c", "none")
    replaced(tables / "category.json", '"index": 17', '"index": null')
    layout = replace(folder.layout, boxes={"vehicle.bicycle": "cyclist", "*": "car"})
    (frame,) = map((other := ScanFolder(tables, layout)).frame, other.drives)
    np.testing.assert_array_equal(frame.points, expected.points)
    ridden, true = ([box.label == "cyclist" for box in each.boxes or ()] for each in (frame, expected))
    assert ridden == true != []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda root: (root / "v1.0-mini" / "sample_data.json").unlink(), "no tables of nuScenes"),
        (lambda root: nuscenes(root, []), "no key frame"),
        (
            lambda root: (root / "v1.1").mkdir() or (root / "v1.1" / "sample_data.json").write_text("[]"),
            "v1.0-mini, v1.1",
        ),
        (changed("sample_data", "[{"), "cannot be read"),
        (changed("sample_data", [{"token": 1}]), "row that is not nuScenes'"),
        (changed("ego_pose", []), "a row 'e0' that is not there"),
        (changed("scene", []), "sample.json has a row that is not nuScenes'"),
        (changed("sensor", [{"token": k, "channel": k, "modality": "lidar"} for k in "lc"]), "LiDARs c, l; expected"),
        (changed("category", [{"token": k, "name": k, "index": -1} for k in SEEN.values()]), "names by number"),
        (lambda root: replaced(root / "v1.0-mini/sample_data.json", "false", "true"), "two key frames are called n015"),
    ],
)
def test_damaged_tables_are_refused(change: Callable[[Path], Any], said: str, tmp_path: Path, streets: Streets) -> None:
    change(nuscenes(tmp_path, streets[:1]))
    with pytest.raises(PointsError, match=said):
        ScanFolder(tmp_path, "nuscenes")


def test_a_part_of_the_files_is_enough(tmp_path: Path, streets: Streets) -> None:
    """Whole sets are downloaded in parts; without boxes, points alone are labeled, and without both nothing is."""
    root = nuscenes(tmp_path, streets, sample_annotation=[])
    (root / "samples" / "LIDAR_TOP" / "n015__LIDAR_TOP__0.pcd.bin").unlink()
    with pytest.warns(UserWarning, match="of 2 labeled scans 1 are there, and not .*/samples/.*__0.pcd.bin"):
        folder = ScanFolder(root, "nuscenes")
    frame = folder.frame("n015__LIDAR_TOP__1")
    assert frame.boxes is None
    assert frame.point_classes is not None
    (root / "lidarseg" / "1.bin").write_bytes(b"cut")
    with pytest.raises(PointsError, match="3 labels for a scan of"):
        folder.frame("n015__LIDAR_TOP__1")
    (root / "lidarseg" / "1.bin").unlink()
    with pytest.warns(UserWarning, match="are there"), pytest.raises(PointsError, match="has no labels"):
        ScanFolder(root, "nuscenes")
    replaced(nuscenes(tmp_path / "unnamed", streets[:1]) / "v1.0-mini" / "category.json", "index", "number")
    with pytest.raises(PointsError, match=r"no name for 24; add it to category\.json"):
        ScanFolder(tmp_path / "unnamed", "nuscenes").frame("n015__LIDAR_TOP__0")


@given(
    table=st.sampled_from(["sample", "sample_data", "sample_annotation", "category", "ego_pose", "sensor", "lidarseg"]),
    rows=st.lists(JSON) | JSON,
    values=st.dictionaries(st.sampled_from(["token", "size", "rotation", "name", "index", "filename"]), JSON),
)
@settings(max_examples=80)
def test_any_table_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, table: str, rows: Any, values: dict[str, Any]
) -> None:
    """Of any values, and of true rows with some of another kind."""
    root = tmp_path_factory.mktemp("any")
    nuscenes(root, [(np.ones((3, 4), np.float32), [Box("car", 1.0, (9.0, 0.0, 0.0), (4.0, 2.0, 1.6), 0.0)])])
    path = root / "v1.0-mini" / f"{table}.json"
    path.write_text(json.dumps([row | values for row in json.loads(path.read_text())] if values else rows))
    with contextlib.suppress(PointsError), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = ScanFolder(root, "nuscenes")
        for name in folder.drives:
            folder.frame(name)


def test_damaged_logs_are_refused(tmp_path: Path, streets: Streets, monkeypatch: pytest.MonkeyPatch) -> None:
    root = argoverse2(tmp_path, streets[:1])
    folder, name = ScanFolder(root, "av2"), f"7fab_{10**18}"
    sweep = root / "val" / "7fab" / "sensors" / "lidar" / f"{10**18}.feather"
    content = sweep.read_bytes()
    for damaged in (b"", content[: len(content) // 2], b"ARROW1" + bytes(900)):
        sweep.write_bytes(damaged)
        with pytest.raises(PointsError, match=f"{10**18}.feather cannot be read"):
            folder.frame(name)
    argoverse2(tmp_path / "small", [(streets[0][0], [Box("car", 1.0, (9.0, 0.0, 0.0), (4.0, 0.0, 1.6), 0.0)])])
    with pytest.raises(PointsError, match=r"7fab: a 'REGULAR_VEHICLE' of 0 x 4 x 1\.6 m; expected sizes above 0"):
        ScanFolder(tmp_path / "small", "av2").frame(name)
    argoverse2(tmp_path / "small", [(streets[0][0], [replace(streets[0][1][0], label="none")])])
    with pytest.raises(PointsError, match="None in place of a text"):
        ScanFolder(tmp_path / "small", "av2").frame(name)  # labels that were changed are read again
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"edgeperc\[argoverse\]"):
        ScanFolder(root, "av2")
    with pytest.raises(PointsError, match=r"no annotations.feather"):
        ScanFolder(tmp_path / "val" / "7fab" / "map", "av2")
