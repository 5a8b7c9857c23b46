"""Pre-labels: read as the tools read them, and read back for training."""

from __future__ import annotations

import json
import math
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cli_helpers import POINTSEG, Shell, run, thinned
from edgeperc import Box, CalibrationError, ImageLabels, OptionError, Perception, PointsError, Tracker, Tracks
from edgeperc.camera.calibration import read_kitti_calibration
from edgeperc.datasets.annotations import read_labelcloud, read_sustechpoints
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.records import PerceivedScan
from edgeperc.sinks.prelabels import KINDS, PrelabelSink
from edgeperc.types.sensor import get_sensor
from scenes import urban

Row = tuple[str, list[float]]
"""A class, and x, y, z, length, width, height [m], yaw [rad]."""

CALIBRATION = """P0: 707.0493 0 604.0814 0 0 707.0493 180.5066 0 0 0 1 0
P2: 707.0493 0 604.0814 45.75831 0 707.0493 180.5066 -0.3454157 0 0 1 0.004981016
R0_rect: 0.9999128 0.01009263 -0.008511932 -0.01012729 0.9999406 -0.004037671 0.008470675 0.00412352 0.9999556
Tr_velo_to_cam: 0.006927964 -0.9999722 -0.002757829 -0.02457729 -0.001162982 0.002749836 -0.9999955 -0.06127237
"""
CALIBRATION = CALIBRATION.rstrip("\n") + " 0.9999753 0.006931141 -0.001143899 -0.3321029\n"


def box(label: str, x: float, y: float, yaw: float, size: tuple[float, float, float] = (4.2, 1.8, 1.5)) -> Box:
    return Box(label, 0.99, (x, y, -0.9), size, yaw)


BOXES = (
    box("car", 14.0, 2.0, 0.3),
    box("pedestrian", 8.0, -3.0, -3.0, (0.8, 0.6, 1.8)),
    box("cyclist", -9.0, 4.0, 1.6, (1.8, 0.6, 1.7)),
    box("forklift truck", 20.0, -6.0, -1.4),
)
POINTS = np.zeros((5, 4), np.float32)


def perceived(name: str, boxes: tuple[Box, ...] = BOXES, tracks: Tracks | None = None) -> PerceivedScan:
    perception = Perception(5, 0, None, None, boxes, {}, {}, (), None)
    return PerceivedScan(name, 0.1, POINTS, perception, tracks, get_sensor("hdl-64e"))


def rows_of(boxes: Any) -> list[Row]:
    return [(each.label, [*each.center, *each.size, each.yaw]) for each in boxes]


def written(folder: Path, kind: str, *scans: PerceivedScan, calib: Path | None = None) -> Path:
    sink = PrelabelSink(folder, kind, calib=calib)
    for scan in scans:
        sink.write(scan)
    sink.close()
    if kind == "cvat":
        with zipfile.ZipFile(folder / "annotations.zip") as archive:
            assert archive.testzip() is None
            archive.extractall(folder)
    return folder


def read_as_labelcloud(folder: Path, name: str) -> list[Row]:
    """labelCloud's ``centroid_rel``: its file of classes must know every class."""
    classes = json.loads((folder / "labels/_classes.json").read_text())
    assert classes.keys() >= {"classes", "default", "type", "format"}
    assert (classes["type"], classes["format"]) == ("object_detection", "centroid_rel")
    known = {each["name"]: each["id"] for each in classes["classes"]}
    assert sorted(known.values()) == [*range(len(known))]
    assert all(len(each["color"]) == 7 and int(each["color"][1:], 16) >= 0 for each in classes["classes"])
    assert classes["default"] in known.values()
    found: list[Row] = []
    for each in json.loads((folder / f"labels/{name}.json").read_text())["objects"]:
        assert each["name"] in known
        x, y, z = each["centroid"].values()
        length, width, height = (each["dimensions"][side] for side in ("length", "width", "height"))
        about_x, about_y, about_z = each["rotations"].values()  # in the order of the file
        assert (about_x, about_y) == (0, 0)
        found.append((each["name"], [x, y, z, length, width, height, about_z]))
    return found


def read_as_cvat(folder: Path, name: str) -> list[Row]:
    """Datumaro's JSON: cuboids with position, rotation about x, y, z and scale along x, y, z."""
    document = json.loads((folder / "annotations/default.json").read_text())
    labels = [each["name"] for each in document["categories"]["label"]["labels"]]
    (item,) = (item for item in document["items"] if item["id"] == name)
    found = []
    for each in item["annotations"]:
        assert each["type"] == "cuboid_3d"
        assert each["rotation"][:2] == [0.0, 0.0]
        if not each["attributes"].get("outside"):
            found.append((labels[each["label_id"]], [*each["position"], *each["scale"], each["rotation"][2]]))
    return found


def read_as_kitti(folder: Path, name: str) -> list[Row]:
    """KITTI's object labels and calibration, by matrices of four rows."""
    values = dict(line.split(":") for line in (folder / f"calib/{name}.txt").read_text().splitlines())
    matrices = {key: np.array(text.split(), float) for key, text in values.items()}
    rectify, T_velo = np.eye(4), np.eye(4)
    rectify[:3, :3], T_velo[:3] = matrices["R0_rect"].reshape(3, 3), matrices["Tr_velo_to_cam"].reshape(3, 4)
    back = np.linalg.inv(rectify @ T_velo)
    found: list[Row] = []
    for line in (folder / f"label_2/{name}.txt").read_text().splitlines():
        kind, *numbers = line.split()
        assert len(numbers) == 14
        cut, hidden, alpha, left, top, right, bottom, height, width, length, x, y, z, turn = map(float, numbers)
        assert 0.0 <= cut <= 1.0
        assert hidden == 3
        assert math.cos(alpha - (turn - math.atan2(x, z))) > 0.999
        assert 0.0 <= left <= right <= 1241.0
        assert 0.0 <= top <= bottom <= 374.0
        bottom_center, front = back @ [x, y, z, 1.0], back[:3, :3] @ [math.cos(turn), 0.0, -math.sin(turn)]
        center = back @ [x, y - height / 2.0, z, 1.0]
        assert bottom_center[2] < center[2]
        found.append((kind, [*center[:3], length, width, height, math.atan2(front[1], front[0])]))
    return found


def read_as_sustechpoints(folder: Path, name: str) -> list[Row]:
    """SUSTechPOINTS: boxes by position, scale and rotation about x, y, z."""
    found: list[Row] = []
    for each in json.loads((folder / f"label/{name}.json").read_text()):
        assert isinstance(each["obj_id"], str)
        place, size, turn = ([each["psr"][part][axis] for axis in "xyz"] for part in ("position", "scale", "rotation"))
        assert turn[:2] == [0, 0]
        found.append((each["obj_type"], [*place, *size, turn[2]]))
    return found


READERS = {
    "labelcloud": read_as_labelcloud,
    "cvat": read_as_cvat,
    "kitti": read_as_kitti,
    "sustechpoints": read_as_sustechpoints,
}
NAMES = {
    **dict.fromkeys(("labelcloud", "cvat"), ("car", "pedestrian", "cyclist", "forklift truck")),
    "kitti": ("Car", "Pedestrian", "Cyclist", "Forklift_truck"),
    "sustechpoints": ("Car", "Pedestrian", "BicycleRider", "Forklift_truck"),
}


def check_rows(found: list[Row], expected: list[Row], tolerance: float = 2e-4) -> None:
    assert [name for name, _ in found] == [name for name, _ in expected]
    for (_, values), (_, right) in zip(found, expected, strict=True):
        np.testing.assert_allclose(values[:6], right[:6], atol=tolerance)
        assert math.cos(values[6] - right[6]) > 1.0 - tolerance**2


@pytest.mark.parametrize("kind", KINDS)
def test_labels_are_read_as_the_tools_read_them(tmp_path: Path, kind: str) -> None:
    scans = perceived("velodyne/000003.bin"), perceived("velodyne/000004.bin", ()), perceived("drive.pcap/000005")
    folder = written(tmp_path, kind, *scans)
    expected = [(name, values) for name, (_, values) in zip(NAMES[kind], rows_of(BOXES), strict=True)]
    check_rows(READERS[kind](folder, "000003"), expected)
    assert READERS[kind](folder, "000004") == []
    check_rows(READERS[kind](folder, "000005"), expected)


@pytest.mark.parametrize(("kind", "calib"), [*((kind, None) for kind in KINDS), ("kitti", CALIBRATION)])
def test_labels_of_a_scan_in_a_map_lie_in_the_map(tmp_path: Path, kind: str, calib: str | None) -> None:
    scan, origin, of_camera = perceived("utm.pcd"), (512345.25, 5412345.5, 113.0), tmp_path / "calib.txt"
    of_camera.write_text(calib or "")
    perception = replace(scan.perception, origin_m=origin)
    scan = replace(scan, perception=perception)
    folder = written(tmp_path, kind, scan, calib=of_camera if calib else None)
    rows = zip(NAMES[kind], rows_of(perception.map_boxes), strict=True)
    tolerance = 2e-2 if calib else 2e-4  # a box is level in the camera's frame
    check_rows(READERS[kind](folder, "utm"), [(name, values) for name, (_, values) in rows], tolerance)


def test_datumaro_reads_cvats_labels(tmp_path: Path) -> None:
    """By the library with which CVAT imports this format."""
    Dataset = pytest.importorskip("datumaro").Dataset
    tracker, scans = Tracker(), []
    for k in range(6):
        boxes = BOXES[:2] if k < 4 else BOXES[:1]
        scans.append(perceived(f"{k:06d}.bin", boxes, tracker.update(boxes, 0.1 * k, np.eye(4))))
    written(tmp_path, "cvat", *scans)
    found = Dataset.import_from(str(tmp_path), "datumaro")
    names = [each.name for each in found.categories()[next(iter(found.categories()))].items]
    items = sorted(found, key=lambda item: item.attributes["frame"])
    assert [item.id for item in items] == [f"{k:06d}" for k in range(6)]
    assert [sum(not each.attributes["outside"] for each in item.annotations) for item in items] == [2] * 4 + [1] * 2
    assert [sum(each.attributes["outside"] for each in item.annotations) for item in items] == [0] * 4 + [1, 0]
    (car,) = items[-1].annotations
    assert (car.type.name, names[car.label], car.attributes["track_id"]) == ("cuboid_3d", "car", 1)
    check_rows([("car", [*car.position, *car.scale, car.rotation[2]])], rows_of(BOXES[:1]), 0.1)
    plain = written(tmp_path / "plain", "cvat", perceived("000003.bin"))
    (item,) = Dataset.import_from(str(plain), "datumaro")
    rows = [[*each.position, *each.scale, each.rotation[2]] for each in item.annotations]
    check_rows([(name, row) for (name, _), row in zip(rows_of(BOXES), rows, strict=True)], rows_of(BOXES))


PLACES = st.tuples(*(st.floats(-60.0, 60.0) for _ in range(2)), st.floats(-3.0, 3.0))
SIZES = st.tuples(*(st.floats(0.3, 15.0) for _ in range(3)))
ANY_BOXES = st.lists(
    st.builds(Box, st.sampled_from(["car", "truck", "pedestrian"]), st.just(0.9), PLACES, SIZES, st.floats(-3.2, 3.2)),
    max_size=4,
    unique_by=lambda box: round(box.center[0], 2),  # copies come back once
)
DESCRIPTION = {
    "schema": 1,
    "sensor": "hdl-64e",
    "boxes": {"Car": "car", "Truck": "truck", "Pedestrian": "pedestrian", "BicycleRider": "cyclist", "*": "ignore"},
}


def training_folder(folder: Path, kind: str, *names: str) -> ScanFolder:
    (folder / "velodyne").mkdir(exist_ok=True)
    for name in names:
        POINTS.tofile(folder / f"velodyne/{name}.bin")
    (folder / "scans.json").write_text(json.dumps({**DESCRIPTION, "box_format": kind}))
    return ScanFolder(folder)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(ANY_BOXES)
def test_boxes_come_back_for_training(tmp_path: Path, kind: str, boxes: list[Box]) -> None:
    folder = written(Path(mkdtemp(dir=tmp_path)), kind, perceived("000003.bin", tuple(boxes)))
    frame = training_folder(folder, kind, "000003").frame("000003")
    check_rows(rows_of(frame.boxes), rows_of(boxes))


@pytest.mark.parametrize("kind", KINDS)
def test_tracks_keep_their_ids_and_end(tmp_path: Path, kind: str) -> None:
    """A car ahead leaves, another one stays; a track that was not detected gets no label."""
    tracker, scans = Tracker(), []
    for k in range(8):
        boxes = (box("car", 12.0, 0.0, 0.0), *([box("car", 20.0, 6.0, 0.0)] if k < 4 else []))
        scans.append(perceived(f"{k:06d}.bin", boxes, tracker.update(boxes, 0.1 * k, np.eye(4))))
    folder = written(tmp_path, kind, *scans)
    counts = [len(READERS[kind](folder, f"{k:06d}")) for k in range(8)]
    assert counts == [2, 2, 2, 2, 1, 1, 1, 1]
    if kind == "sustechpoints":
        first, last = (json.loads((folder / f"label/{k:06d}.json").read_text()) for k in (0, 7))
        assert [each["obj_id"] for each in first] == ["1", "2"]
        assert [each["obj_id"] for each in last] == ["1"]
    if kind == "cvat":
        items = json.loads((folder / "annotations/default.json").read_text())["items"]
        assert [item["attr"]["frame"] for item in items] == [*range(8)]
        flags = [
            {each["attributes"]["track_id"]: each["attributes"]["outside"] for each in item["annotations"]}
            for item in items
        ]
        assert flags == [{1: False, 2: False}] * 4 + [{1: False, 2: True}] + [{1: False}] * 3


@pytest.mark.filterwarnings("ignore:got a scan at:UserWarning")
def test_labels_of_a_drive_come_when_it_is_over(tmp_path: Path) -> None:
    """Smoothed, and where a car was not detected for a scan, too; those of a live source come at once. Scan 5 has a
    wrong stamp, and is no end.
    """
    tracker, sink, ahead = Tracker(), PrelabelSink(tmp_path, "sustechpoints"), (box("car", 12.0, 0.0, 0.0),)
    places = [tmp_path / f"label/{k:06d}.json" for k in range(11)]
    for k in range(10):
        boxes = () if k == 4 else (replace(ahead[0], size=(4.0 + 0.1 * k, 1.6, 1.5)),)
        tracks = tracker.update(boxes, 0.1 * k + 100.0 * (k in (5, 8, 9)), np.eye(4))
        if k == 9:
            assert not any(map(Path.exists, places))
            places[2].parent.mkdir()
            places[2].write_text("corrected by hand")
        sink.write(perceived(f"{k:06d}.bin", boxes, tracks))  # the next drive's scan has no fault in it
    labels = [READERS["sustechpoints"](tmp_path, f"{k:06d}") for k in range(8) if k not in (2, 5)]
    assert [len(of_scan) for of_scan in labels] == [1] * 6
    assert len({of_scan[0][1][3] for of_scan in labels}) == 1  # one size
    sink.write(replace(perceived("000010.bin", ahead, tracks), health="OK"))
    warned = pytest.warns(RuntimeWarning, match="a drive stopped after 2 scans: labels come")
    with warned, pytest.raises(OptionError, match=r"000002\.json exists with other content"):
        sink.close(whole=False)
    assert [place.exists() for place in places[8:]] == [False, False, True]


def test_kitti_labels_lie_in_the_image_of_their_camera(tmp_path: Path) -> None:
    calib = tmp_path / "calib.txt"
    calib.write_text(CALIBRATION)
    far = box("van", 30.0, 1.0, 0.1)
    folder = written(tmp_path / "out", "kitti", perceived("a.bin", (far, *BOXES)), calib=calib)
    check_rows(
        READERS["kitti"](folder, "a"),
        [("Van", rows_of([far])[0][1]), *zip(NAMES["kitti"], [row for _, row in rows_of(BOXES)], strict=True)],
    )
    assert (folder / "calib/a.txt").read_text() == CALIBRATION
    lines = (folder / "label_2/a.txt").read_text().splitlines()
    left, top, right, bottom = map(float, lines[0].split()[4:8])
    # By hand: the middle of the box is 30 m ahead and 1 m to the left, 0.9 m below the sensor.
    assert left < 604.0 - 707.0 * 1.0 / 30.0 < right
    assert top < 180.5 + 707.0 * 0.85 / 30.0 < bottom
    assert right - left == pytest.approx(707.0 * 1.8 / 28.0, rel=0.3)
    behind = lines[3].split()
    assert behind[:2] == ["Cyclist", "1.00"]
    assert behind[4:8] == ["0.00"] * 4
    # Beside the camera: its far end, at x = 3.1 m and y = 1.6 m, is in the image.
    beside = written(tmp_path / "beside", "kitti", perceived("a.bin", (box("car", 1.0, 2.5, 0.0),)), calib=calib)
    left, _, right, _ = map(float, (beside / "label_2/a.txt").read_text().split()[4:8])
    assert (left, right) == (0.0, pytest.approx(604.0 - 707.0 * 1.6 / 2.77, abs=20.0))
    calibs = tmp_path / "calibs"
    calibs.mkdir()
    (calibs / "b.txt").write_text(CALIBRATION)
    one = written(tmp_path / "each", "kitti", perceived("b.bin"), calib=calibs)
    assert (one / "calib/b.txt").read_text() == CALIBRATION
    with pytest.raises(CalibrationError, match="add it, pass one file for all scans"):
        written(tmp_path / "none", "kitti", perceived("c.bin"), calib=calibs)
    values = dict(line.split(": ") for line in CALIBRATION.splitlines())
    (calibs / "calib_cam_to_cam.txt").write_text(f"R_rect_00: {values['R0_rect']}\nP_rect_02: {values['P2']}\n")
    from_velo = np.array(values["Tr_velo_to_cam"].split()).reshape(3, 4)
    lines = [f"{key}: {' '.join(part.ravel())}" for key, part in (("R", from_velo[:, :3]), ("T", from_velo[:, 3]))]
    (calibs / "calib_velo_to_cam.txt").write_text("\n".join(lines))
    day = written(tmp_path / "day", "kitti", perceived("a.bin"), calib=calibs)
    for found, expected in zip(*map(read_kitti_calibration, (day / "calib/a.txt", calib)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    calib.write_text("P2: 1")
    with pytest.raises(CalibrationError, match="expected P2, R0_rect"):
        written(tmp_path / "wrong", "kitti", perceived("a.bin"), calib=calib)


def test_boxes_come_back_from_a_camera_that_looks_aside_and_down(tmp_path: Path) -> None:
    aside, down = math.radians(50.0), math.radians(20.0)
    cos, sin = math.cos(aside), math.sin(aside)
    level = np.array([[sin, -cos, 0.0], [0.0, 0.0, -1.0], [cos, sin, 0.0]])
    turn = [[1.0, 0.0, 0.0], [0.0, math.cos(down), -math.sin(down)], [0.0, math.sin(down), math.cos(down)]]
    place = " ".join(map(str, np.column_stack([turn @ level, [0.1, -0.2, 0.3]]).ravel()))
    (calib := tmp_path / "calib.txt").write_text(
        f"P2: 700 0 620.5 0 0 700 187 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {place}\n"
    )
    folder = written(tmp_path / "out", "kitti", perceived("a.bin", BOXES[:2]), calib=calib)
    frame = training_folder(folder, "kitti", "a").frame("a")
    check_rows(rows_of(frame.boxes), rows_of(BOXES[:2]))
    assert sum(frame.azimuths) / 2.0 == pytest.approx(aside, abs=2e-3)


def test_boxes_of_kitti_are_cut_to_the_image_that_was_perceived(tmp_path: Path) -> None:
    calib = tmp_path / "calib.txt"
    calib.write_text(CALIBRATION.replace("604.0814", "960").replace("180.5066", "600"))
    scan = perceived("a.bin", BOXES[:1])
    image = ImageLabels(np.zeros((1200, 1920), np.uint8), ("road",))
    seen = replace(scan, perception=replace(scan.perception, image=image))
    folder = written(tmp_path, "kitti", seen, calib=calib)
    _, top, _, bottom = map(float, (folder / "label_2/a.txt").read_text().split()[4:8])
    assert top < 600.0 + 707.0 * 0.85 / 14.0 < bottom
    with pytest.warns(UserWarning, match="center at 960, 600, far from the middle of the image of 1242 x 375"):
        written(tmp_path / "other", "kitti", scan, calib=calib)


def test_errors_name_the_reason(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="expected one of labelcloud, cvat, kitti, sustechpoints"):
        PrelabelSink(tmp_path, "segments")
    with pytest.raises(OptionError, match="need no calibration"):
        PrelabelSink(tmp_path, "cvat", calib=tmp_path / "calib.txt")
    for kind in KINDS:
        sink = PrelabelSink(tmp_path / kind, kind)
        sink.write(perceived("a/x.bin"))
        with pytest.raises(OptionError, match=r"is already the file of a/x\.bin"):
            sink.write(perceived("b/x.bin"))
        sink.close()
        sink.close()
        assert not [*(tmp_path / kind).glob(".*")]
        assert len(READERS[kind](written(tmp_path / kind, kind, perceived("a/x.bin")), "x")) == len(BOXES)


@pytest.mark.parametrize("file", ["labels/x.json", "label/x.json", "label_2/x.txt", "calib/x.txt"])
def test_labels_that_are_there_stay(tmp_path: Path, file: str) -> None:
    """They may be corrected by hand, or the truth of the data set."""
    kind = {"labels": "labelcloud", "label": "sustechpoints"}.get(file.split("/")[0], "kitti")
    written(tmp_path, kind, perceived("x.bin"))
    (tmp_path / file).write_text("corrected")
    with pytest.raises(OptionError, match="perhaps corrected by hand"):
        written(tmp_path, kind, perceived("x.bin"))
    assert (tmp_path / file).read_text() == "corrected"


def test_classes_of_labelcloud_that_are_there_stay(tmp_path: Path) -> None:
    path = written(tmp_path, "labelcloud", perceived("x.bin")) / "labels/_classes.json"
    document = json.loads(path.read_text())
    document["classes"] = [{"name": "tram", "id": 7, "color": "#000000"}, *document["classes"][:2]]
    path.write_text(json.dumps(document))
    written(tmp_path, "labelcloud", perceived("y.bin"))
    classes = json.loads(path.read_text())["classes"]
    assert classes[:3] == document["classes"]
    assert [(each["name"], each["id"]) for each in classes[3:5]] == [("truck", 8), ("pedestrian", 9)]
    for text, reason in (("centroid_abs", "centroid_rel would be written"), ('"format', "no classes of labelCloud")):
        path.write_text(json.dumps(document).replace("centroid_rel", text) if text[0] != '"' else text)
        with pytest.raises(OptionError, match=reason):
            PrelabelSink(tmp_path, "labelcloud")


def test_degrees_of_labelcloud_are_read_by_its_file_of_classes(tmp_path: Path) -> None:
    folder = written(tmp_path, "labelcloud", perceived("x.bin"))
    path, settings_of = folder / "labels/x.json", folder / "labels/_classes.json"
    document = json.loads(path.read_text())
    document["objects"][0]["rotations"]["z"] = 200.0
    path.write_text(json.dumps(document))
    with pytest.raises(PointsError, match="as in degrees"):
        read_labelcloud(path)
    settings_of.write_text(settings_of.read_text().replace("centroid_rel", "centroid_abs"))
    assert read_labelcloud(path)[0].yaw == pytest.approx(math.radians(-160.0))
    settings_of.write_text(settings_of.read_text().replace("centroid_abs", "vertices"))
    with pytest.raises(PointsError, match="save the labels as centroid_rel"):
        read_labelcloud(path)
    settings_of.unlink()
    with pytest.raises(PointsError, match="as in degrees"):
        read_labelcloud(path)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "kitti"])
@pytest.mark.parametrize(
    "change", [("4.2", "0.0"), ("4.2", "NaN"), ("4.2", '"long"'), ("0.3", "1e999"), ("[", "{"), ("0.0", "1.0")]
)
def test_a_malformed_file_is_an_error_that_names_it(tmp_path: Path, kind: str, change: tuple[str, str]) -> None:
    folder = written(tmp_path, kind, perceived("x.bin", (BOXES[0],)))
    path = {"labelcloud": "labels/x.json", "cvat": "annotations/default.json", "sustechpoints": "label/x.json"}[kind]
    text = (folder / path).read_text()
    changed = text.replace(*change)
    assert changed != text
    (folder / path).write_text(changed)
    with pytest.raises(PointsError, match=r"x\.json|default\.json"):
        training_folder(folder, kind, "x").frame("x")


def test_cvats_names_may_have_folders_and_scans_without_boxes_have_none(tmp_path: Path) -> None:
    folder = written(tmp_path, "cvat", perceived("x.bin"), perceived("y.bin", ()))
    path = folder / "annotations/default.json"
    path.write_text(path.read_text().replace('"id": "x"', '"id": "velodyne/x"'))
    scans = training_folder(folder, "cvat", "x", "y", "z")
    assert [*scans.drives] == ["x", "y"]  # z is not in the task
    assert scans.frame("y").boxes == ()
    path.write_text(path.read_text().replace('"id": "y"', '"id": "other/x"'))
    with pytest.raises(PointsError, match="two scans called x"):
        ScanFolder(folder)
    path.unlink()
    with pytest.raises(PointsError, match=r"default\.json cannot be read"):
        ScanFolder(folder)


def test_a_tilted_box_is_an_error(tmp_path: Path) -> None:
    folder = written(tmp_path, "sustechpoints", perceived("x.bin", (BOXES[0],)))
    path = folder / "label/x.json"
    (each,) = json.loads(path.read_text())
    for tilt, right in ((0.05, True), (-0.3, True), (0.5, False)):
        each["psr"]["rotation"]["x"] = tilt
        path.write_text(json.dumps([each]))
        if right:
            assert read_sustechpoints(path)[0].yaw == pytest.approx(0.3)
        else:
            with pytest.raises(PointsError, match="tilted by 29 degrees"):
                read_sustechpoints(path)


class Seeing:
    """Perceives `BOXES`."""

    def __init__(self, models: Any, *, sensor: str, **_: Any) -> None:
        self.sensor, self.cards = get_sensor(sensor), (POINTSEG,)

    def __call__(self, points: NDArray[np.float32], stamp_s: float | None = None, **_: Any) -> Perception:
        return Perception(len(points), 0, None, None, BOXES, {}, {}, (), stamp_s)


def test_the_command_writes_labels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell) -> None:
    monkeypatch.setitem(sys.modules, "edgeperc.perceiver", SimpleNamespace(Perceiver=Seeing))
    (tmp_path / "drive").mkdir()
    for k in range(3):
        POINTS.tofile(tmp_path / f"drive/{k:06d}.bin")
    for kind in KINDS:
        out = tmp_path / kind
        assert run("run", tmp_path / "drive", "--labels-for", kind, "--out", out) == 0
        if kind == "cvat":
            zipfile.ZipFile(out / "annotations.zip").extractall(out)
        assert [len(READERS[kind](out, f"{k:06d}")) for k in range(3)] == [4, 4, 4]
    calib = tmp_path / "calib.txt"
    calib.write_text(CALIBRATION)
    assert run("run", tmp_path / "drive", "--labels-for", "kitti", "--calib", calib, "--out", tmp_path / "k") == 0
    assert (tmp_path / "k/calib/000002.txt").read_text() == CALIBRATION
    for out in ([], ["--out", "s3://bucket/labels"]):
        assert shell.err("run", tmp_path / "drive", "--labels-for", "kitti", *out)


@pytest.mark.filterwarnings("default:no scan to train on has a label of pedestrian, cyclist")
def test_corrected_labels_train_a_network(tmp_path: Path) -> None:
    """From the scans of a drive: pre-labels, one correction, the description, and a step of a training."""
    pytest.importorskip("torch")
    from edgeperc_export import cli as export

    mine = tmp_path / "mine"
    (mine / "velodyne").mkdir(parents=True)
    scans = []
    for seed in (3, 4):
        scan = urban(seed, thinned())
        path = mine / f"velodyne/{seed}.bin"
        scan.points.tofile(path)
        cars = tuple(box for box, n in zip(scan.boxes, scan.box_points, strict=True) if box.label == "car" and n > 50)
        perception = Perception(len(scan.points), 0, None, None, cars, {}, {}, (), None)
        scans.append(PerceivedScan(str(path), 0.1 * seed, scan.points, perception, None, get_sensor("hdl-64e")))
    written(mine, "labelcloud", *scans)
    path = mine / "labels/3.json"
    document = json.loads(path.read_text())
    corrected = document["objects"][0]
    corrected["name"], corrected["centroid"]["x"] = "truck", round(corrected["centroid"]["x"] + 0.25, 3)
    path.write_text(json.dumps(document))
    classes = {"car": "car", "van": "van", "truck": "truck", "pedestrian": "pedestrian", "cyclist": "cyclist"}
    description = {"schema": 1, "name": "mine", "sensor": "hdl-64e", "box_format": "labelcloud", "boxes": classes}
    (mine / "scans.json").write_text(json.dumps(description))
    (first, *_) = ScanFolder(mine).frame("3").boxes or ()
    assert first.label == "truck"
    assert first.center[0] == pytest.approx(corrected["centroid"]["x"])
    assert np.count_nonzero(ScanFolder(mine).frame("4").labels() == 1) > 50
    run_of = ["train", "pointseg", str(tmp_path / "run"), "--scans", str(mine), "--steps", "1", "--batch", "1"]
    assert export.main([*run_of, "--threads", "1", "--workers", "0"]) == 0
    lines = (tmp_path / "run/log.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["step"] == 1
    assert (tmp_path / "run/checkpoint.pt").exists()
