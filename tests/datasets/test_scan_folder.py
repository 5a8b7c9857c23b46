"""Labeled scans of any sensor: the plain layout, its description, evaluation and training from it."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("tqdm")

from checkout import REPOSITORY
from cli_helpers import Shell
from edgeperc import Perceiver
from edgeperc.datasets.kitti import KittiObjects, scan_hash
from edgeperc.datasets.layout import ScanLayout, class_number, known_layouts, read_layout
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.errors import MountingError, OptionError, PointsError, SensorError
from edgeperc.evaluation.evaluate import evaluate
from edgeperc.evaluation.judge import check_scans
from edgeperc.evaluation.transfer import compare
from edgeperc.evaluation.truth import cells_inside, folder_truth, road_cells
from edgeperc.inference.projection import make_projector
from edgeperc.preprocess.findings import check_fitness
from edgeperc.preprocess.fitness import FitnessProfile
from edgeperc.simulation.samples import IGNORE, simulated_scan
from edgeperc.simulation.scene import SCENE_CLASSES
from edgeperc.types.card import ModelCard
from edgeperc.types.choices import PUBLIC_SETS
from edgeperc.types.mounting import MODEL_MOUNTING, Mounting
from edgeperc.types.perception import Box
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import TopViewGeometry
from edgeperc.zoo import model_path
from edgeperc_export.data.scan_sets import joined_hashes, read_scan_set, seen_by_network
from edgeperc_export.data.scans import SURFACE
from strategies import JSON

BOXES = {"Car": "car", "Van": "van", "Rider": "ignore", "Cyclist": "cyclist", "Digger": "digger", "Cone": "background"}
NAMES = {"1": "Road", "2": "Car", "3": "Ghost", "4": "Tree"}
POINTS = {"Road": "drivable", "Car": "car", "Ghost": "ignore", "Tree": "background"}
DESCRIPTION = {"schema": 1, "sensor": "hdl-64e", "boxes": BOXES, "points": POINTS}

PLACES = np.array([[10, 0, -1, 0.5], [20, 0, -1, 0.5], [-15, 5, -1, 0.5], [30, 9, -1, 0.5]], np.float32)
LINES = "Car 10 0 -1 4 2 1.6 0 9\nRider 20 0 -1 1 1 1.8 0\n\nCyclist 20 0 -1 2 1 1.8 0.5 3\nDigger 30 9 -1 6 3 3 0\n"


def folder_of(root: Path, description: Any = DESCRIPTION, *, points: np.ndarray = PLACES, **files: str) -> Path:
    """A folder with one scan and the files, by their path below it with ``__`` for ``/`` and ``_dot_`` for ``.``."""
    (root / "velodyne").mkdir(parents=True, exist_ok=True)
    points.astype(np.float32).tofile(root / "velodyne" / "a.bin")
    (root / "scans.json").write_text(description if isinstance(description, str) else json.dumps(description))
    for name, text in files.items():
        path = root / name.replace("__", "/").replace("_dot_", ".")
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return root


def with_classes(root: Path, numbers: list[int], dtype: type = np.uint8, **changes: Any) -> Path:
    folder_of(root, {**DESCRIPTION, **changes}, semseg_classes_dot_json=json.dumps(NAMES))
    (root / "semseg").mkdir(exist_ok=True)
    np.array(numbers, dtype).tofile(root / "semseg" / ("a.u8" if dtype is np.uint8 else "a.label"))
    return root


def test_boxes_and_the_labels_of_points_by_them(tmp_path: Path) -> None:
    folder = ScanFolder(folder_of(tmp_path, label__a_dot_txt=LINES + "Cone 30 9 -1 6 3 3 0\n"))
    frame = folder.frame("a")
    assert [box.label for box in frame.boxes] == ["car", "ignore", "cyclist", "digger"]  # a cone is background
    assert frame.boxes[0] == Box("car", 1.0, (10, 0, -1), (4, 2, 1.6), 0.0)
    assert frame.returns == (1, 0, 1, 1)
    # The box of the rider alone lies in the cyclist's; a digger is no class of the shipped networks.
    assert frame.labels().tolist() == [1, 3, 0, IGNORE]
    assert frame.labels(("background", "digger", "cyclist")).tolist() == [IGNORE, 2, 0, 1]
    assert frame.labels(("background", "cyclist", "road")).tolist() == [IGNORE, 1, IGNORE, IGNORE]  # perhaps road
    assert frame.known_at(PLACES).all()
    with pytest.raises(PointsError, match="no labels by points"):
        frame.labels(by="points")
    with pytest.raises(PointsError, match="no labeled scan 'b'"):
        folder.frame("b")


def test_files_that_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    """As editors of Windows save them: the first box had a class of its own, which ``*`` takes."""
    root = folder_of(tmp_path, {**DESCRIPTION, "boxes": {"Car": "car", "*": "ignore"}}, label__a_dot_txt=LINES)
    with_classes(root, [1, 2, 3, 0], boxes={"Car": "car", "*": "ignore"})
    (root / "frames.csv").write_text("name,drive\r\na,monday\r\n")
    (root / "drivable").mkdir()
    (root / "drivable/a.json").write_text("[[[0, 0], [1, 1], [0, 1]]]")
    plain = ScanFolder(root).frame("a")
    for name in ("scans.json", "label/a.txt", "semseg_classes.json", "frames.csv", "drivable/a.json"):
        (root / name).write_bytes(b"\xef\xbb\xbf" + (root / name).read_bytes())
    frame = ScanFolder(root).frame("a")
    assert frame.boxes == plain.boxes
    assert frame.boxes[0].label == "car"
    np.testing.assert_array_equal(frame.labels(), plain.labels())
    assert (frame.drive, len(frame.drivable or ())) == ("monday", 1)


def test_class_numbers() -> None:
    names = ["background", "drivable", "car", "van", "person_sitting", "digger", "ignore"]
    assert [class_number(name) for name in names] == [0, 0, 1, 1, 2, IGNORE, IGNORE]
    own = ("background", "van", "drivable")
    assert [class_number(name, own) for name in names] == [0, 2, IGNORE, 1, IGNORE, IGNORE, IGNORE]
    names = ["road", "drivable", "building", "static object", "background", "car", "fence"]
    assert [class_number(name) for name in names] == [0, 0, 0, 0, 0, 1, IGNORE]
    assert [class_number(name, SCENE_CLASSES) for name in names] == [
        *[SCENE_CLASSES.index(name) for name in ("road", "road", "building")],
        *[IGNORE, 0, 1, IGNORE],
    ]
    half = ("background", "road")  # a building is no road, and nothing else is known of it
    assert [class_number(name, half) for name in names] == [1, 1, IGNORE, IGNORE, 0, IGNORE, IGNORE]


def test_truth_ends_where_nobody_labeled(tmp_path: Path) -> None:
    description = {**DESCRIPTION, "labeled_deg": [-30, 30], "labeled_m": 25, "min_points": 2}
    frame = ScanFolder(folder_of(tmp_path, description, label__a_dot_txt=LINES)).frame("a")
    assert frame.known_at(PLACES).tolist() == [True, True, False, False]
    assert frame.labels().tolist() == [1, 3, IGNORE, IGNORE]
    assert frame.returns == (0, 0, 0, 0)
    behind = {**DESCRIPTION, "labeled_deg": [150, 210]}
    frame = ScanFolder(folder_of(tmp_path, behind, label__a_dot_txt=LINES)).frame("a")
    assert frame.known_at(PLACES).tolist() == [False, False, True, False]
    assert not frame.known_at(np.full((1, 3), np.nan)).any()


def test_columns_in_another_order(tmp_path: Path) -> None:
    columns = ["x", "y", "z", "-", "w", "l", "h", "yaw", "class"]
    root = folder_of(
        tmp_path, {**DESCRIPTION, "box_columns": columns}, label__a_dot_txt="10 0 -1 99 2 4 1.6 0.5 Car more\n"
    )
    assert ScanFolder(root).frame("a").boxes == (Box("car", 1.0, (10, 0, -1), (4, 2, 1.6), 0.5),)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint32])
def test_classes_of_points(tmp_path: Path, dtype: type) -> None:
    numbers = [1, 2, 3, 0] if dtype is np.uint8 else [1, 2 + (7 << 16), 3, 0]
    frame = ScanFolder(with_classes(tmp_path, numbers, dtype)).frame("a")
    assert frame.boxes is None
    assert frame.labels().tolist() == [0, 1, IGNORE, IGNORE]  # 0 is unlabeled
    assert frame.road_labels().tolist() == [1, 2, IGNORE, IGNORE]
    assert not frame.known_at(PLACES).any()  # objects without boxes


def test_names_of_classes_in_the_description(tmp_path: Path) -> None:
    for points in ({"Tree": "vegetation", "Car": "car"}, {"Tree": "vegetation", "*": "car"}):
        own = {"point_names": {"9": "Tree", "300": "Car"}, "points": points}
        root = with_classes(tmp_path, [9, 300, 9, 300], np.uint32, **own)
        assert ScanFolder(root).frame("a").labels().tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize(
    ("numbers", "dtype", "changes", "message"),
    [
        ([1, 2], np.uint8, {}, "2 labels for a scan of 4 points"),
        ([1, 2, 3, 9], np.uint8, {}, "no name for 9"),
        ([1, 2, 3, 3], np.uint8, {"points": {"Road": "drivable"}}, "no class for 'Car'"),
        ([1, 2, 3, 3], np.uint8, {"points": {}}, "no 'points'"),
        ([1, 2, 3, 70_000], np.uint32, {"point_names": {"1": "Road"}}, "no name for 2"),
    ],
)
def test_classes_of_points_that_are_wrong(
    tmp_path: Path, numbers: list[int], dtype: type, changes: dict[str, Any], message: str
) -> None:
    root = with_classes(tmp_path, numbers, dtype, **changes)
    with pytest.raises(PointsError, match=message):
        ScanFolder(root).frame("a")


def test_label_files_of_half_a_number_and_names_that_are_none(tmp_path: Path) -> None:
    root = with_classes(tmp_path, [1, 2, 3, 4], np.uint32)
    (root / "semseg/a.label").write_bytes(b"12345")
    with pytest.raises(PointsError, match="5 bytes are not uint32 labels"):
        ScanFolder(root).frame("a")
    np.array([1, 2, 3, 4], np.uint32).tofile(root / "semseg/a.label")
    for text in ("[1]", "{", '{"-1": "Road"}', '{"1": 2}'):
        (root / "semseg_classes.json").write_text(text)
        with pytest.raises(PointsError, match="expected names by number"):
            ScanFolder(root).frame("a")
    (root / "semseg_classes.json").unlink()
    with pytest.raises(PointsError, match="cannot be read"):
        ScanFolder(root).frame("a")


BOXES = ("1 2 3", "1 2 3 4 5 six 0", "1 2 3 4 5 inf 0", "1 2 3 4 0 1 0", "nan 2 3 4 1 1 0", "1 2 3 4 2 1 90")
POLYGONS = ("{", "3", "[[[0, 0], [1, 1]]]", '[[["a", 0]]]', "[[[0,0],[1,1],[1e999,0]]]", "[7]")


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        *(("label__a_dot_txt", f"Car 10 0 -1 4 2 1.6 0\nCar {box}\n", r"a\.txt, line 2: .*expected") for box in BOXES),
        ("label__a_dot_txt", "Car 10 0 -1 4000 2000 1600 0\n", r"a\.txt: a car of 4000 m; expected less than 100 m"),
        *(("drivable__a_dot_json", text, "polygon") for text in POLYGONS),
        ("frames_dot_csv", "name,drive\n", "both filled"),
        ("frames_dot_csv", "name,drive\na,\n", "both filled"),
        ("frames_dot_csv", "name,drive\nb,x\n", "no drive of a"),
    ],
)
def test_files_that_are_wrong(tmp_path: Path, file: str, text: str, message: str) -> None:
    with pytest.raises(PointsError, match=message):
        ScanFolder(folder_of(tmp_path, **{"label__a_dot_txt": "", file: text})).frame("a")


def test_labels_that_are_there_twice_count_once_and_those_of_no_scan_are_told_of(tmp_path: Path) -> None:
    """The copy of an object was one that nothing can find; a label of a mistyped name was left out in silence."""
    root = folder_of(tmp_path, label__a_dot_txt=LINES + LINES, label__B_dot_TXT=LINES, semseg__c_dot_u8="1")
    with pytest.warns(UserWarning, match=r"has 2 label files of no scan or of .* left out, such as label/B\.TXT"):
        folder = ScanFolder(root)
    assert folder.frame("a").returns == (1, 0, 1, 1)


def test_boxes_of_a_class_that_is_not_mapped(tmp_path: Path) -> None:
    root = folder_of(tmp_path, label__a_dot_txt="Tank 10 0 -1 4 2 1.6 0\n")
    with pytest.raises(PointsError, match="no class for 'Tank'; add it to boxes"):
        ScanFolder(root).frame("a")
    folder_of(root, {**DESCRIPTION, "boxes": {"*": "truck"}})
    assert [box.label for box in ScanFolder(root).frame("a").boxes or ()] == ["truck"]
    folder_of(root, {"schema": 1, "sensor": "hdl-64e"})
    with pytest.raises(PointsError, match="no 'boxes'"):
        ScanFolder(root)


def test_kittis_own_labels(tmp_path: Path) -> None:
    files = {
        "label_2__a_dot_txt": "Car 0 0 0 600 150 700 250 1.6 2 4 0 1.72 9.73 -1.5708\n",
        "calib__a_dot_txt": "P2: 721.5 0 609.5 0 0 721.5 172.9 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
        "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n",
    }
    root = folder_of(tmp_path, {**DESCRIPTION, "box_format": "kitti"}, **files)
    frame = ScanFolder(root).frame("a")
    assert frame.labels().tolist() == [1, 0, IGNORE, 0]  # behind the camera nothing is labeled
    assert frame.azimuths == pytest.approx((-0.7196, 0.7012), abs=1e-3)


def test_kitti_labels_of_another_camera(tmp_path: Path) -> None:
    """Its image is wider than KITTI's: what lies on its right is labeled, too."""
    calibration = (
        "P2: 1000 0 960 0 0 1000 540 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    )
    label = "Car 0 0 0 1400 500 1700 700 1.6 2 4 6 1 10 -1.5708\n"
    own = {**DESCRIPTION, "box_format": "kitti"}
    points = np.array([[10, -6, -0.5, 0], [10, 6, 0, 0], [10, 0, -5, 0], [10, -12, 0, 0]], np.float32)
    files = {"label_2__a_dot_txt": label, "calib__a_dot_txt": calibration}
    root = folder_of(tmp_path, own, points=points, **files)
    with pytest.raises(PointsError, match=r'to pixel 1700, 700, beyond an image of 1242 x 375; .*"image_size"'):
        ScanFolder(root).frame("a")
    for wrong in ([1920], [0, 1080], [1920.5, 1080], "1920x1080"):
        with pytest.raises(PointsError, match="image_size"):
            ScanFolder(folder_of(tmp_path, {**own, "image_size": wrong}, points=points, **files))
    frame = ScanFolder(folder_of(tmp_path, {**own, "image_size": [1920, 1080]}, points=points, **files)).frame("a")
    assert frame.labels().tolist() == [1, 0, 0, IGNORE]
    assert frame.azimuths == pytest.approx((-math.atan(0.96), math.atan(0.96)))
    assert folder_truth(frame, MODEL_MOUNTING, None).front.image_size == (1920, 1080)
    (own_kitti := tmp_path / "set/training").mkdir(parents=True)
    for folder in ("label_2", "calib", "velodyne"):
        (root / folder).rename(own_kitti / folder)
    with pytest.raises(PointsError, match="beyond an image of 1242 x 375"):
        KittiObjects(own_kitti.parent).frame("a")


def test_scans_of_any_format(tmp_path: Path) -> None:
    root = folder_of(tmp_path, label__a_dot_txt="", label__b_dot_txt="")
    np.save(root / "velodyne/b.npy", PLACES)
    np.save(root / "velodyne/unlabeled.npy", PLACES)
    (root / "velodyne/.hidden").touch()
    folder = ScanFolder(root)
    assert folder.drives == {"a": "a", "b": "b"}
    np.testing.assert_array_equal(folder.frame("b").points, PLACES)
    np.save(root / "velodyne/a.npy", PLACES)
    with pytest.raises(PointsError, match="one name"):
        ScanFolder(root)
    (root / "velodyne/a.npy").rename(root / "velodyne/a.txt")
    with pytest.raises(PointsError, match="no scan by its name"):
        ScanFolder(root)


def test_the_tree_of_semantickitti(tmp_path: Path) -> None:
    with pytest.raises(PointsError, match="expected sequences/SEQ/velodyne"):
        ScanFolder(tmp_path, "semantickitti")
    for sequence in ("00", "08"):
        for part in ("velodyne", "labels"):
            (tmp_path / "sequences" / sequence / part).mkdir(parents=True)
        PLACES.tofile(tmp_path / "sequences" / sequence / "velodyne/000003.bin")
        numbers = np.array([10 + (7 << 16), 40, 254, 0], np.uint32)
        numbers.tofile(tmp_path / "sequences" / sequence / "labels/000003.label")
    folder = ScanFolder(tmp_path, "semantickitti")
    assert folder.drives == {"00/000003": "2011_10_03_drive_0027", "08/000003": "2011_09_30_drive_0028"}
    assert folder.names("train") == ["08/000003"]  # sequence 00 is a test drive
    frame = folder.frame("08/000003")
    assert frame.labels().tolist() == [1, 0, 2, IGNORE]
    assert frame.boxes is None
    with pytest.raises(PointsError, match="no labels by boxes"):
        frame.labels(by="boxes")
    (tmp_path / "scans.json").write_text(json.dumps({**DESCRIPTION, "files": "semantickitti"}))
    with pytest.raises(OptionError, match="is of another sensor"):  # the description's, not SemanticKITTI's
        evaluate([tmp_path], ["pointseg"], mounted=Mounting(2.0, 0.0, 0.0))


def test_folders_without_scans_labels_or_description(tmp_path: Path) -> None:
    with pytest.raises(PointsError, match="no such folder"):
        ScanFolder(tmp_path / "none")
    with pytest.raises(PointsError, match=r"no scans\.json.*FOLDER:pandaset"):
        ScanFolder(tmp_path)
    with pytest.raises(PointsError, match="no scans; expected velodyne/NAME"):
        ScanFolder(tmp_path, "ddad")
    with pytest.raises(PointsError, match="no labels for its scans"):
        ScanFolder(folder_of(tmp_path))
    for part in ("velodyne/000000.bin", "labels/0.label"):
        (tmp_path / "set/sequences/00" / part).parent.mkdir(parents=True)
        (tmp_path / "set/sequences/00" / part).write_bytes(b"0" * 16)
    with pytest.raises(PointsError, match=r"no labels for its scans .* expected sequences/SEQ/labels/NAME\.label"):
        ScanFolder(tmp_path / "set", "semantickitti")
    with pytest.raises(PointsError, match="no layout 'pandar'"):
        ScanFolder(tmp_path, "pandar")
    with pytest.raises(PointsError, match="no layout 'pandar'; expected av2"):
        ScanFolder.parse(f"{tmp_path}:pandar")
    with pytest.raises(PointsError, match="the description cannot be read"):
        ScanFolder.parse(f"{tmp_path}:{tmp_path / 'mine.json'}")


def test_a_layout_is_named_and_never_guessed(tmp_path: Path) -> None:
    root = folder_of(tmp_path / "pandaset", label__a_dot_txt="Car 10 0 -1 4 2 1.6 0\n")
    assert ScanFolder.parse(root).layout.name == "scans"
    assert ScanFolder.parse(f"{root}:lyft").layout.name == "lyft"
    assert ScanFolder.parse(f"{root}:{root / 'scans.json'}").layout == ScanFolder(root).layout


def test_drives_and_splits(tmp_path: Path) -> None:
    root = folder_of(tmp_path, **{f"label__{name}_dot_txt": "" for name in "abcd"})
    for name in "bcd":
        np.save(root / f"velodyne/{name}.npy", PLACES)
    assert ScanFolder(root).drives == {name: name for name in "abcd"}
    (root / "frames.csv").write_text("drive,name\ny,a\nx,b\nx,c\nz,d\n")
    splits = {"train": ["x"], "validation": ["z"]}
    folder_of(root, {**DESCRIPTION, "splits": splits})
    folder = ScanFolder(root)
    assert folder.names("all") == ["b", "c", "a", "d"]  # drive by drive
    assert folder.names("train") == ["b", "c", "a"]  # the description does not list y
    assert folder.names("validation") == ["d"]
    assert folder.names("validation", fold=0) == []
    assert folder.names("train", fold=0) == ["b", "c", "a"]
    assert folder.names("test") == ["a"]
    folder_of(root, {**DESCRIPTION, "splits": {"train": ["x"], "test": ["*"]}})
    assert ScanFolder(root).names("train") == ["b", "c"]
    assert ScanFolder(root).names("test") == ["a", "d"]
    folder_of(root, {**DESCRIPTION, "drives": "one"})
    assert set(ScanFolder(root).drives.values()) == {"scans"}
    folder_of(root, {**DESCRIPTION, "drives": "scan"})
    assert ScanFolder(root).drives == {name: name for name in "abcd"}
    with pytest.raises(ValueError, match="expected train, validation, test or all"):
        folder.names("both")


@pytest.mark.parametrize("network", ["pointseg", "objects"])
def test_a_set_that_is_kept_for_testing_is_not_left_out_of_training_in_silence(
    tmp_path: Path, network: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from edgeperc_export.cli import main

    root = folder_of(tmp_path, {**DESCRIPTION, "splits": {"test": ["*"]}}, label__a_dot_txt=LINES)
    assert main(["train", network, str(tmp_path / "run"), "--scans", str(root), "--steps", "1"]) == 2
    assert "has 1 labeled scans, and none is for train" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:.*(no scan to train on has a label|the remission does not fit)")
def test_a_training_tells_of_remissions_and_of_scans_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    from edgeperc_export.recipe import Recipe
    from edgeperc_export.training.samples import Watch
    from edgeperc_export.training.train import Data, Run, train

    splits = {"train": ["3"], "validation": ["4"]}
    root, _ = street(tmp_path, "hdl-64e", most=100, drives="scan", splits=splits)
    for file in (root / "velodyne/3.bin", root / "label/3.txt", root / "semseg/3.u8"):
        shutil.copy(file, file.with_stem("4"))
    description = json.loads((root / "scans.json").read_text())
    with (
        pytest.warns(UserWarning, match=r"of 1 of 1 scans, the remission does not fit the range 0 to 100 of hdl-64e"),
        pytest.raises(ValueError, match="validation scan street/4 is the training scan street/3, byte for byte"),
    ):
        train(Recipe("pointseg", edge=True), tmp_path / "run", Data(scan_sets=[ScanFolder(root)]))
    recipe = Recipe("pointseg", edge=True, width=0.1, steps=1, batch=1, n_pasted=0.0, n_negatives=0.0)
    (root / "velodyne/4.bin").write_bytes((root / "velodyne/3.bin").read_bytes()[:-16] + bytes(16))
    (root / "scans.json").write_text(json.dumps(description | {"splits": {"train": ["4"]}}))
    start = train(recipe, tmp_path / "start", Data(scan_sets=[ScanFolder(root)]))
    (root / "scans.json").write_text(json.dumps(description | {"splits": splits}))
    monkeypatch.setattr(Watch, "validate", lambda *_: (0.0, math.nan, {}))
    with (
        pytest.warns(UserWarning, match=r"1 of 1 validation scans or images, such as street/4, are of the training"),
        pytest.raises(FloatingPointError, match="the validation loss is nan at step 1; lower --learning-rate"),
    ):
        train(recipe, tmp_path / "after", Data(scan_sets=[ScanFolder(root)]), Run(start))
    assert not (tmp_path / "after/checkpoint.pt").exists()


@pytest.mark.parametrize("measure", [partial(evaluate, models=["pointseg"]), compare])
def test_an_evaluation_tells_of_another_unit_and_of_labels_of_another_scan(
    tmp_path: Path, measure: Callable[..., Any]
) -> None:
    root, _ = street(tmp_path, "hdl-64e", most=100, drives="scan", splits={"test": ["3"]})
    (root / "label/3.txt").write_text("".join(f"car {x} 0 0.4 4 2 1.6 0\n" for x in (5, 9, 13, 17)))
    with (
        pytest.warns(UserWarning, match=r"of 1 of 1 scans, the remission does not fit the range 0 to 100 of hdl-64e"),
        pytest.warns(UserWarning, match=r"nothing stands in 4 of 4 labeled boxes within 20 m, such as the car at x 5"),
    ):
        measure([str(root)])


def test_of_a_single_drive_labels_of_other_scans_are_told_too(tmp_path: Path) -> None:
    """Its first scan may hold few objects, or the right labels."""
    root, _ = street(tmp_path, "hdl-64e", (3, 4), drives="one", splits={"test": ["*"]})
    names = ScanFolder(root).names("test")
    check_scans(ScanFolder(root), None, names)
    (root / f"label/{names[-1]}.txt").write_text("".join(f"car {x} 0 0.4 4 2 1.6 0\n" for x in (5, 9, 13, 17)))
    with pytest.warns(UserWarning, match=r"nothing stands in 4 of \d+ labeled boxes"):
        check_scans(ScanFolder(root), None, names)


def test_a_scan_is_of_one_drive(tmp_path: Path) -> None:
    root = folder_of(tmp_path, label__a_dot_txt="")
    (root / "frames.csv").write_text("name,drive\na,monday\na,tuesday\n")
    with pytest.raises(PointsError, match="scan 'a' has two rows, of drives monday and tuesday"):
        ScanFolder(root)


def test_a_drive_that_splits_misspells_is_not_for_training(tmp_path: Path) -> None:
    root = folder_of(tmp_path, label__a_dot_txt="", label__b_dot_txt="")
    np.save(root / "velodyne/b.npy", PLACES)
    description = {**DESCRIPTION, "splits": {"train": ["monday"], "test": ["tuesday"]}}
    folder_of(root, description)
    with pytest.raises(PointsError, match=r"the drive 'monday', which has no labeled scan, and not the drive 'a'"):
        ScanFolder(root)  # nobody wrote frames.csv
    (root / "frames.csv").write_text("name,drive\na,monday\nb,tuesdays\n")
    for train in ("monday", "*"):  # all others were trained on, the misspelt drive of the test too
        folder_of(root, {**description, "splits": {"train": [train], "test": ["tuesday"]}})
        with pytest.raises(PointsError, match=r"the drive 'tuesday', which has no .* the drive '(tuesdays|mon)"):
            ScanFolder(root)
    folder_of(root, description)
    (root / "frames.csv").write_text("name,drive\na,tuesday\nb,tuesday\n")
    assert ScanFolder(root).names("train") == []  # the scans of Monday lie elsewhere
    (root / "frames.csv").write_text("name,drive\na,tuesday\nb,friday\n")
    folder_of(root, {**description, "splits": {"train": ["monday"], "test": ["*"]}})
    assert ScanFolder(root).names("test") == ["b", "a"]


def test_sets_of_one_name_are_told_apart(tmp_path: Path) -> None:
    """A card knows the scans of both; figures of drives that would count as one are refused."""
    folders = [ScanFolder(street(tmp_path / str(k))[0]) for k in range(2)]
    (file,) = (folders[1].root / "velodyne").iterdir()
    np.fromfile(file, np.float32).reshape(-1, 4)[::-1].tofile(file)
    one, other = (read_scan_set(folder, "train")[2] for folder in folders)
    assert one.keys() == other.keys()
    assert {*joined_hashes(one, other).values()} == {*one.values(), *other.values()}
    assert joined_hashes(one, one) == one
    with pytest.raises(PointsError, match="both called 'street', and both have a drive 'street'"):
        evaluate([folder.root for folder in folders], ["pointseg"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": 2}, "has schema 2"),
        ({"box": {}}, "unknown entries box"),
        ({"name": ""}, "name is ''"),
        ({"name": 3}, "name is 3"),
        ({"sensor": None}, "sensor is None"),
        ({"sensor": "hdl-65"}, "no sensor 'hdl-65'"),
        ({"sensor": "mine.json"}, "cannot be read"),
        ({"sensor": {"columns": 3}}, "sensor: expected 'like'"),
        ({"sensor": {"like": "hdl-64e", "beams": 3}}, "sensor is"),
        ({"sensor": {"like": "hdl-64e", "columns": "x"}}, "columns is 'x'; expected a number"),
        ({"sensor": {"name": "x", "elevations_deg": [0, 1], "columns": 9}}, "must strictly decrease"),
        ({"mounting": {"height": 2}}, "mounting has unknown entries height"),
        ({"mounting": {"height_m": "2"}}, "height_m is '2'"),
        ({"boxes": ["car"]}, "boxes is"),
        ({"boxes": {"Car": 1}}, "boxes is"),
        ({"boxes": {"Car": "Car"}}, "'Car' is mapped to 'Car'"),
        ({"boxes": {"Car": "car", "CAR": "car"}}, "boxes has a class twice"),
        ({"boxes": {"Road": "drivable"}}, "cannot be drivable"),
        ({"points": {"Car": ""}}, "points: 'Car' is mapped to ''"),
        ({"point_names": {"x": "Car"}}, "point_names"),
        ({"point_names": {"70000": "Car"}}, "point_names"),
        ({"files": "coco"}, "files is 'coco'"),
        ({"box_format": "coco"}, "box_format is 'coco'"),
        ({"box_format": []}, "box_format is"),
        ({"box_columns": ["class"]}, "expected x, y, z"),
        ({"box_columns": "class"}, "expected a list of texts"),
        ({"labeled_deg": [30, -30]}, "labeled_deg is"),
        ({"labeled_deg": [-300, 300]}, "labeled_deg is"),
        ({"labeled_deg": 30}, "expected a list of 2 numbers"),
        ({"labeled_deg": [True, 30]}, "expected a number"),
        ({"labeled_m": 0}, "labeled_m is 0"),
        ({"labeled_m": "far"}, "labeled_m is 'far'"),
        ({"min_points": -1}, "min_points is -1"),
        ({"min_points": 1.5}, "min_points is 1.5"),
        ({"drives": "all"}, "drives is 'all'"),
        ({"splits": ["x"]}, "splits is"),
        ({"splits": {"train": "x"}}, "expected a list of texts"),
        ({"splits": {"training": []}}, "splits is"),
        ({"splits": {"train": ["x"], "test": ["x"]}}, "lists x twice"),
    ],
)
def test_descriptions_that_are_wrong(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = folder_of(tmp_path, {**DESCRIPTION, **changes}) / "scans.json"
    with pytest.raises((PointsError, SensorError), match=message) as error:
        read_layout(path)
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize("text", ["", "[", "3", "null", "[" * 100_000, '{"schema": NaN}'])
def test_texts_that_are_no_description(text: str) -> None:
    with pytest.raises(PointsError, match="the description"):
        ScanLayout.from_json(text)


def test_a_sensor_of_its_own_and_what_is_known_of_its_mounting(tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_text(get_sensor("vlp-16").to_json())
    given = {**DESCRIPTION, "mounting": {"height_m": 2, "yaw_deg": -90}}
    sensor = ScanLayout.from_json(json.dumps({**given, "sensor": "mine.json"}), tmp_path).sensor
    assert sensor == replace(get_sensor("vlp-16"), mounting=Mounting(2.0, None, None, -90.0))
    like = {"like": "hdl-64e", "name": "byte", "remission_range": [0, 255]}
    sensor = ScanLayout.from_json(json.dumps({**DESCRIPTION, "sensor": like})).sensor
    assert sensor == replace(get_sensor("hdl-64e"), name="byte", remission_range=(0.0, 255.0))
    own = {"name": "own", "elevations_deg": [2, 0, -2], "columns": 900}
    assert ScanLayout.from_json(json.dumps({**DESCRIPTION, "sensor": own})).sensor.n_beams == 3


def test_the_description_in_the_documentation() -> None:
    page = (REPOSITORY / "docs/howto/train.md").read_text("utf-8")
    (block,) = re.findall(r"^```json\n(.*?)^```", page, flags=re.DOTALL | re.MULTILINE)
    layout = ScanLayout.from_json(block)
    assert layout.sensor.mounting == Mounting(1.9)
    assert layout.boxes["forklift"] == layout.points["forklift"] == "forklift"
    table = page.partition("| entry |")[2].partition("\n\n")[0]
    entries = re.findall(r"^\| (`.*?) \|", table, flags=re.MULTILINE)
    named = {name for entry in entries for name in re.findall(r"`(\w+)`", entry)}
    assert named | {"name", "about"} == {"schema", "about", "mounting", *(field.name for field in fields(ScanLayout))}


KEYS = st.sampled_from(
    [
        *("schema", "name", "about", "sensor", "mounting", "boxes", "box_format", "box_columns", "points"),
        *("point_names", "labeled_deg", "labeled_m", "min_points", "drives", "splits", "other"),
    ]
)
PARTS = st.sampled_from(
    [
        *({"like": "vlp-16"}, {"height_m": 1.0}, {"Car": "car"}, {"train": ["x"]}, [-30, 30], "one", "kitti", 7),
        *({"like": "vlp-16", "elevations_deg": [1e308, 1, "x"]}, "car", "*", "lyft"),
    ]
)


@settings(max_examples=300)
@given(st.dictionaries(KEYS, JSON | PARTS, max_size=5))
def test_any_description_is_read_or_refused(changes: dict[str, Any]) -> None:
    try:
        layout = ScanLayout.from_json(json.dumps({**DESCRIPTION, **changes}))
    except (PointsError, SensorError):
        return
    assert layout.min_points >= 0
    assert layout.labeled_m > 0.0
    assert all(isinstance(name, str) for name in (*layout.boxes.values(), *layout.points.values()))


@settings(max_examples=100)
@given(st.text(max_size=60))
def test_any_text_is_read_or_refused(text: str) -> None:
    with pytest.raises(PointsError):
        ScanLayout.from_json(text)


def test_descriptions_of_public_sets() -> None:
    kitti = ("kitti-raw", "kitti-tracking")
    others = ("lyft", "nuscenes", "once", "pandaset", "semantickitti", "vod", "waymo")
    assert known_layouts() == ("av2", "ddad", *kitti, *others)
    assert known_layouts() == PUBLIC_SETS
    for name in known_layouts():
        layout = read_layout(name)
        assert layout.name == name
        assert {"car", "pedestrian"} <= {*(layout.boxes or layout.points).values()}
    assert read_layout("vod").in_split("anything", "test")
    assert not read_layout("vod").in_split("anything", "train")
    assert read_layout("pandaset").in_split("pandaset_002", "train")
    assert not read_layout("pandaset").in_split("pandaset_002", "test")
    assert not read_layout("pandaset").in_split("pandaset_001", "train")
    assert read_layout("vod").labeled_deg == (-30.0, 30.0)


VIEW = TopViewGeometry()
SMALL = TopViewGeometry(x_range_m=(0.0, 4.0), y_range_m=(-2.0, 2.0), cell_m=0.5)
CORNER = st.tuples(st.floats(-1.0, 5.0), st.floats(-3.0, 3.0))


@settings(max_examples=60)
@given(st.lists(st.lists(CORNER, min_size=3, max_size=6), max_size=3))
def test_cells_in_polygons(polygons: list[list[tuple[float, float]]]) -> None:
    found = cells_inside([np.array(ring) for ring in polygons], SMALL)
    x, y = (centers.ravel().tolist() for centers in SMALL.cell_centers())
    for row, px in enumerate(x):
        for col, py in enumerate(y):
            inside = False
            for ring in polygons:
                crossings = 0
                for (x0, y0), (x1, y1) in zip(ring, [*ring[1:], ring[0]], strict=True):
                    if (x0 > px) != (x1 > px):
                        crossings += py < y0 + (px - x0) / (x1 - x0) * (y1 - y0)
                inside |= crossings % 2 == 1
            assert found[row, col] == inside


CARS = [Box("car", 1.0, (x, y, -0.95), (4.2, 1.8, 1.5), 0.1) for x, y in ((9, 4), (16, -4), (22, 4), (-12, 4), (30, 1))]


def street(
    root: Path, sensor: str = "vlp-32c", seeds: tuple[int, ...] = (3,), *, most: int = 255, **changes: Any
) -> tuple[Path, Any]:
    """Simulated scans of a sensor whose frame has its origin 0.4 m above the road, with labels of every kind; ``most``:
    remission that the description says is the highest, of 0..255.
    """
    for part in ("velodyne", "label", "semseg"):
        (root / part).mkdir(parents=True)
    shift = np.array([0.0, 0.0, get_sensor(sensor).mount_height_m - 0.4], np.float32)
    for seed in seeds:
        scan = simulated_scan(seed, sensor, CARS)
        points = scan.points.copy()
        points[:, :3] += shift
        points[:, 3] *= 255.0
        points.tofile(root / f"velodyne/{seed}.bin")
        lines = [
            " ".join(map(str, (box.label, *(np.array(box.center) + shift).round(3), *box.size, round(box.yaw, 4))))
            for box, n in zip(scan.boxes, scan.box_points, strict=True)
            if n
        ]
        (root / f"label/{seed}.txt").write_text("\n".join(lines))
        truth = scan.top_view_labels(SURFACE)
        row, col, covered = SURFACE.cells(points[:, 0], points[:, 1])
        on_road = (truth[row % SURFACE.height, col % SURFACE.width] == 1) & covered & (np.abs(points[:, 2] + 0.4) < 0.4)
        numbers = np.where(scan.labels > 0, scan.labels + 1, np.where(on_road, 1, 0)) + 1
        numbers.astype(np.uint8).tofile(root / f"semseg/{seed}.u8")
    names = {"1": "other", "2": "road", "3": "car", "4": "pedestrian", "5": "cyclist"}
    description = {
        "schema": 1,
        "name": "street",
        "sensor": {"like": sensor, "remission_range": [0, most]},
        "boxes": {name: name for name in ("car", "van", "truck", "pedestrian", "cyclist")} | {"*": "ignore"},
        "points": {"other": "background", "road": "drivable", "car": "car", "*": "ignore"}
        | {name: name for name in ("pedestrian", "cyclist")},
        "point_names": names,
        "drives": "one",
        **changes,
    }
    (root / "scans.json").write_text(json.dumps(description))
    return root, scan


def test_truth_lies_in_the_frame_of_the_models(tmp_path: Path) -> None:
    root, scan = street(tmp_path, "hdl-64e")
    frame = ScanFolder(root).frame("3")
    mounting = Mounting(0.4, 0.0, MODEL_MOUNTING.pitch_deg, 0.0)
    truth = folder_truth(frame, mounting, VIEW)
    np.testing.assert_allclose(truth.points[:, :3], scan.points[:, :3], atol=0.02)  # raised along the pitched axis
    np.testing.assert_array_equal(truth.labels, frame.labels())
    assert truth.boxes[0].center[2] == pytest.approx(frame.boxes[0].center[2] - 1.33, abs=0.01)
    assert truth.road == ("observed cells", "road")
    classes, cells = truth.cells["observed cells"]
    right = scan.top_view_labels(VIEW)
    both = (cells != IGNORE) & (cells != 2) & (right < 2)
    assert np.count_nonzero(both) > 500
    assert np.mean((cells == 1)[both] == (right == 1)[both]) > 0.85
    assert classes == ("other", "road", "vehicle")
    assert "vehicles from 3-D boxes" in truth.cells
    assert truth.known(np.array([[10.0, 0.0, 0.0]])).all()
    turned = folder_truth(frame, replace(mounting, yaw_deg=90.0), None)
    assert turned.points[0, 0] == pytest.approx(-truth.points[0, 1], abs=0.05)
    assert not turned.cells


def test_polygons_are_the_road_where_the_scan_sees_it(tmp_path: Path) -> None:
    root, _ = street(tmp_path, "hdl-64e")
    for path in (root / "semseg").iterdir():
        path.unlink()
    (root / "drivable").mkdir()
    (root / "drivable/3.json").write_text("[[[6, -3], [46, -3], [46, 3], [6, 3]]]")
    cells = road_cells(ScanFolder(root).frame("3"), Mounting(0.4, 0.0, MODEL_MOUNTING.pitch_deg, 0.0), VIEW)
    seen = cells != IGNORE
    assert 0.1 < seen.mean() < 1.0
    _, y = np.broadcast_arrays(*VIEW.cell_centers())
    empty = seen & (cells != 2)
    np.testing.assert_array_equal(cells[empty] == 1, np.abs(y[empty]) < 3.0)


def test_scans_to_train_on(tmp_path: Path) -> None:
    root, _ = street(tmp_path, seeds=(3, 4), min_points=3)
    folder = ScanFolder(root)
    scans, weights, hashes = read_scan_set(folder, "train")
    assert weights == pytest.approx([2**-0.5] * 2)
    assert hashes == {f"street/{name}": scan_hash(folder.frame(name).points) for name in ("3", "4")}
    for name, scan in zip(("3", "4"), scans, strict=True):
        frame = folder.frame(name)
        assert scan.sensor == folder.layout.sensor
        assert scan.azimuths == (-math.pi, math.pi)
        np.testing.assert_array_equal(scan.labels, frame.labels())
        assert 0.0 <= scan.points[:, 3].min() < scan.points[:, 3].max() <= 1.0
        road = scan.points[(frame.road_labels() == 1) & (np.hypot(*scan.points[:, :2].T) < 10.0)]
        assert np.median(road[:, 2]) == pytest.approx(-1.73, abs=0.25)  # the mounting was estimated
        assert scan.counts == frame.returns
        assert {0, 1, IGNORE} == {*np.unique(scan.surface)}
    own, _, _ = read_scan_set(folder, "train", classes=("background", "cyclist", "car"))
    assert set(np.unique(own[0].labels)) <= {0, 1, 2, IGNORE}
    assert np.count_nonzero(own[0].labels == 2) == np.count_nonzero(scans[0].labels == 1)
    assert read_scan_set(folder, "validation") == ([], [], {})
    np.save(root / "velodyne/5.npy", np.empty((0, 4), np.float32))  # its remission is in no other unit
    (root / "semseg/5.u8").touch()
    assert len(read_scan_set(ScanFolder(root), "train").scans) == 3
    with pytest.warns(UserWarning, match=r"no point of its scans of split train \(3\) is of pedestrian; check that"):
        read_scan_set(ScanFolder(root), "train", classes=("background", "pedestrian"))


def test_road_between_the_returns_is_road(tmp_path: Path) -> None:
    root, scan = street(tmp_path, "hdl-64e")
    folder = ScanFolder(root)
    (labeled,), _, _ = read_scan_set(folder, "all")
    measured = road_cells(folder.frame("3"), Mounting(0.4, 0.0, MODEL_MOUNTING.pitch_deg, 0.0), SURFACE)
    assert measured is not None
    truth = scan.top_view_labels(SURFACE)
    assert np.count_nonzero(labeled.surface == 1) > 1.5 * np.count_nonzero(measured == 1)
    assert np.mean(truth[labeled.surface == 1] == 1) > 0.95 * np.mean(truth[measured == 1] == 1)


def test_a_drive_without_ground_needs_a_mounting(tmp_path: Path) -> None:
    root = folder_of(tmp_path, label__a_dot_txt=LINES)
    with pytest.raises(MountingError, match="give height_m, roll_deg and pitch_deg"):
        read_scan_set(ScanFolder(root), "all")
    folder_of(root, {**DESCRIPTION, "mounting": MODEL_MOUNTING.to_dict(), "labeled_deg": [-30, 30]})
    (scan,), _, _ = read_scan_set(ScanFolder(root), "all")
    np.testing.assert_allclose(scan.points, PLACES, atol=1e-6)
    assert scan.azimuths == pytest.approx((-math.pi / 6, math.pi / 6))
    assert (scan.surface == IGNORE).all()


def test_a_sector_may_lie_behind(tmp_path: Path) -> None:
    """A sensor that looks back: its labels teach what lies behind the vehicle, on both sides."""
    root = folder_of(tmp_path, label__a_dot_txt=LINES)
    mounting = {**MODEL_MOUNTING.to_dict(), "yaw_deg": 180.0}
    folder_of(root, {**DESCRIPTION, "mounting": mounting, "labeled_deg": [-30, 30]})
    (scan,), _, _ = read_scan_set(ScanFolder(root), "all")
    geometry = TopViewGeometry(x_range_m=(-10.0, 10.0), y_range_m=(-10.0, 10.0))
    x, y = np.broadcast_arrays(*geometry.cell_centers())
    labeled = scan.labeled(geometry)
    np.testing.assert_array_equal(labeled, (x < 0.0) & (np.abs(y) < -x * math.tan(math.pi / 6)))
    assert labeled[y > 0.0].any()
    assert labeled[y < 0.0].any()


def test_training_sees_what_the_vehicle_sees(tmp_path: Path) -> None:
    """The image of a coarser sensor is the one that a Perceiver gives the network, and its pixels have labels."""
    root, _ = street(tmp_path)
    folder = ScanFolder(root)
    frame = folder.frame("3")
    (scan,), _, _ = read_scan_set(folder, "all")
    perceive = Perceiver("pointseg:fp32", sensor=folder.layout.sensor, provider="cpu", on_mismatch="ignore")
    perceive(frame.points)
    (session,) = perceive.sessions
    projector = make_projector(session.card.view, session.card.input)
    seen, projected = seen_by_network(projector, scan)
    np.testing.assert_allclose(projected.image, session.input, atol=1e-4)
    n = len(scan.points)
    interpolated = projected.index >= n
    assert np.count_nonzero(interpolated) > 1000
    assert len(seen.points) == len(seen.labels) > n
    np.testing.assert_array_equal(seen.labels[:n], scan.labels)
    new = seen.labels[projected.index[interpolated]]
    assert set(np.unique(new)) <= {*np.unique(scan.labels), IGNORE}
    assert np.mean(new == IGNORE) < 0.2
    # An interpolated point lies on the line between two measured ones, so near points of its class are close.
    own = seen.points[projected.index[interpolated]][new == 1]
    cars = scan.points[scan.labels == 1]
    for point in own[::20]:
        assert np.linalg.norm(cars[:, :3] - point[:3], axis=1).min() < 1.0
    for other in (replace(scan, sensor=None), replace(scan, sensor=get_sensor("hdl-64e"))):
        again, plain = seen_by_network(projector, other)
        assert again is other
        assert int(plain.index.max()) < n


def test_int8_is_calibrated_on_what_training_sees(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from edgeperc_export.release.quantize import calibration_scans
    from edgeperc_export.release.to_onnx import views

    root, _ = street(tmp_path)
    card = ModelCard.read(model_path("pointseg"))
    with pytest.raises(PointsError, match=r"3.bin is not as the network sees scans .* --scans FOLDER"):
        calibration_scans([root / "velodyne"], fitness=FitnessProfile.from_dict(card.fitness or {}))
    ((image, _),) = views(card, calibration_scans(sets=[ScanFolder(root)]).scans)
    (scan,), _, _ = read_scan_set(ScanFolder(root), "train")
    projected = seen_by_network(make_projector(card.view, card.input), scan)[1]
    np.testing.assert_array_equal(image, projected.image)


def test_folders_are_evaluated(tmp_path: Path, shell: Shell) -> None:
    root, _ = street(tmp_path / "set", "hdl-64e", (3, 4))
    for name in ("ssadnet-sim", "pointseg-sim"):
        assert (REPOSITORY / "models/research" / f"{name}.onnx").exists()
    out = tmp_path / "figures.json"
    models = ["--model", "ssadnet", "--model", "pointseg"]
    printed = shell.out("eval", root, *models, "--boxes-from", "both", "--json", out)
    assert "== street: 2 scans, 1 drive ==" in printed
    figures = json.loads(out.read_text())
    assert "real" not in figures
    found = figures["folders"]["street"]
    assert found["points"]["all"]["car"]["iou"] > 0.5
    assert found["road"]["all"]["f1"] > 0.8
    assert "pixels" not in found  # all sectors are evaluated, and only the last one's pixels are known
    assert "no scans of the validation drives" in shell.err("eval", root, "--split", "validation")
    (root / "scans.json").write_text((root / "scans.json").read_text().replace('"one"', '"table"'))
    counted = r"no frames\.csv, so each scan counts as a drive: .*: one, or scan if these are no neighbors"
    with pytest.warns(UserWarning, match=counted), pytest.raises(OptionError, match="mounted and road_by are for"):
        evaluate([root], ["pointseg"], mounted=Mounting(2.0, 0.0, 0.0))


@pytest.mark.filterwarnings("default:.*the remission does not fit")
def test_other_sensors_are_compared_by_the_same_reader(tmp_path: Path, shell: Shell) -> None:
    root, _ = street(tmp_path / "set", "hdl-64e")
    out = tmp_path / "figures.json"
    datasets = [str(root), f"hdl-64e={root}"]
    said = shell.err("eval-sensors", *datasets, "--json", out, code=0)
    assert "does not fit the range 0 to 1 of hdl-64e: that of 3 is up to 25" in said
    figures = json.loads(out.read_text())
    assert [figures[name]["n_scans"] for name in datasets] == [1, 1]
    assert figures[datasets[0]]["both"]["iou"]["car"] > 0.5
    for source in (str(tmp_path / "set/velodyne"), f"{root}:pandar"):
        assert "SENSOR=simulation:N" in shell.err("eval-sensors", source)
    kept = folder_of(tmp_path / "kept", {**DESCRIPTION, "splits": {"train": ["*"]}}, label__a_dot_txt=LINES)
    assert "has no scans of the test drives" in shell.err("eval-sensors", kept)


def test_public_sets(data_root: Callable[[str], Path]) -> None:
    pandaset = ScanFolder(data_root("pandaset"), "pandaset")
    assert [len(pandaset.names(split)) for split in ("train", "validation", "test", "all")] == [28, 0, 6, 34]
    frame = pandaset.frame("001_00")
    by_points, by_boxes = frame.labels(), frame.labels(by="boxes")
    both = (by_points != IGNORE) & (by_boxes != IGNORE)
    assert 0.95 < np.mean(by_points[both] == by_boxes[both]) < 1.0
    road = frame.points[frame.road_labels() == 1]
    assert np.median(road[np.hypot(*road[:, :2].T) < 10.0, 2]) == pytest.approx(-0.4, abs=0.3)
    for name, n_scans in {"av2": 3, "vod": 3, "ddad": 6, "lyft": 12}.items():
        folder = ScanFolder(data_root("other_roads") / name, name)
        assert (len(folder.names("train")), len(folder.names("test"))) == (0 if name == "vod" else n_scans, n_scans)
        scans, _, _ = read_scan_set(folder, "test")
        near = scans[0].points[(np.hypot(*scans[0].points[:, :2].T) < 12.0) & (np.abs(scans[0].points[:, 1]) < 3.0)]
        ground = near[near[:, 2] < -1.4]
        assert len(ground) > 100
        assert np.median(ground[:, 2]) == pytest.approx(-1.73, abs=0.2)
        if name == "vod":  # the box of a cyclist holds that of the rider
            assert not (scans[0].labels == 1).any()
            assert (scans[0].labels == 3).sum() > 500


@pytest.mark.filterwarnings("ignore:no scan to train on")
@pytest.mark.parametrize("sensor", ["vlp-16", "hdl-32e"])
def test_a_network_trained_on_a_sensor_does_not_call_it_foreign(tmp_path: Path, sensor: str) -> None:
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from edgeperc_export.recipe import Recipe
    from edgeperc_export.training.checkpoint import CheckpointError, read_checkpoint
    from edgeperc_export.training.train import Data, Run, train

    root, _ = street(tmp_path / "set", sensor, seeds=(3, 4))
    recipe = Recipe("pointseg", steps=1, batch=1, context_width=8, simulated_share=0.0, n_pasted=0.0)
    checkpoint = train(recipe, tmp_path / "run", Data(scan_sets=[ScanFolder(root)]), Run(n_threads=1))
    (scan, _), _, _ = read_scan_set(ScanFolder(root), "train")
    fitness = read_checkpoint(checkpoint)["fitness"]
    assert fitness.n_scans == 2
    assert check_fitness(scan.points, fitness, get_sensor(sensor)) == ()
    of_hdl = FitnessProfile.from_scans([simulated_scan(5).points])
    assert any("rows of points" in finding for finding in check_fitness(scan.points, of_hdl, get_sensor(sensor)))

    import torch

    state = torch.load(checkpoint, weights_only=True)
    torch.save({name: value for name, value in state.items() if name != "fitness"}, checkpoint)
    assert read_checkpoint(checkpoint)["fitness"] is None  # of an earlier version
    torch.save(state | {"fitness": '{"n_scans": 0}'}, checkpoint)
    with pytest.raises(CheckpointError, match="fitness"):
        read_checkpoint(checkpoint)
