"""KITTI's files become truth: boxes in the sensor frame, labels of points and cells, drives kept apart."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("tqdm")

from edgeperc.datasets.kitti import (
    Frame,
    KittiCalibration,
    KittiObjects,
    RoadFrame,
    SemanticKitti,
    label_objects,
    layouts,
    read_labeled,
    read_labels,
)
from edgeperc.datasets.splits import FOLDS, TEST_DRIVES, VALIDATION_DRIVES, fold_of, in_split
from edgeperc.errors import OptionError, PointsError
from edgeperc.simulation.samples import IGNORE, simulated_scan
from edgeperc.simulation.scene import TOP_VIEW_CLASSES
from edgeperc.types.geometry import draw_footprints, inside
from edgeperc.types.perception import Box
from edgeperc.types.sensor import SensorProfile, get_sensor
from edgeperc.types.views import TopViewGeometry
from edgeperc_export.data.augment import augmented
from edgeperc_export.data.roads import ground_plane, sure_surface
from edgeperc_export.data.scans import SURFACE, LabeledScan, mirrored, turned

VIEW = TopViewGeometry()
# The camera looks along the sensor's x axis: camera x is -y, camera y is -z, camera z is x; 0.27 m ahead of it.
CALIBRATION = """P2: 721.5 0 609.5 0 0 721.5 172.9 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
"""


@pytest.fixture
def calibration(tmp_path: Path) -> KittiCalibration:
    path = tmp_path / "calib.txt"
    path.write_text(CALIBRATION)
    return KittiCalibration.read(path)


def objects(tmp_path: Path, calibration: KittiCalibration, *lines: str) -> tuple[tuple[Box, ...], np.ndarray]:
    path = tmp_path / "label.txt"
    path.write_text("\n".join(lines) + "\n")
    return label_objects(read_labels(path), calibration)


def test_a_box_comes_into_the_sensor_frame(tmp_path: Path, calibration: KittiCalibration) -> None:
    # 1.5 m high, 1.6 m wide, 4 m long, facing right; 20 m ahead of the sensor, 3 m to the right.
    boxes, unlabeled = objects(
        tmp_path,
        calibration,
        "Car 0 0 0 600 150 700 250 1.5 1.6 4.0 3.0 1.65 19.73 0.0",
        "DontCare -1 -1 -10 10 20 30 40 -1 -1 -1 -1000 -1000 -1000 -10",
    )
    (box,) = boxes
    assert (box.label, box.size) == ("car", (4.0, 1.6, 1.5))
    assert box.center == pytest.approx((20.0, -3.0, -1.73 + 0.75), abs=1e-6)
    assert box.yaw == pytest.approx(-math.pi / 2)  # ry = 0 is the camera's x axis: to the right
    np.testing.assert_array_equal(unlabeled, [[10, 20, 30, 40]])


@pytest.mark.parametrize("turn", [-2.0, -math.pi / 2, 0.3, 3.0])
def test_headings_turn_the_right_way(tmp_path: Path, calibration: KittiCalibration, turn: float) -> None:
    ((box,), _) = objects(tmp_path, calibration, f"Car 0 0 0 0 0 0 0 1.5 1.6 4.0 0 1.65 20 {turn}")
    # KITTI's angle grows about the camera's y axis, which points down.
    assert math.cos(box.yaw - (-turn - math.pi / 2)) == pytest.approx(1.0)


def frame(calibration: KittiCalibration, points: np.ndarray, *boxes: Box, unlabeled: tuple = ()) -> Frame:
    rectangles = np.array(unlabeled, np.float64).reshape(-1, 4)
    return Frame("0", "drive", "A", np.asarray(points, np.float32), boxes, rectangles, calibration)


def test_points_get_the_class_of_their_box(calibration: KittiCalibration) -> None:
    car = Box("van", 1.0, (20.0, 0.0, -1.0), (4.0, 2.0, 1.5), math.pi / 4)
    rider = Box("cyclist", 1.0, (10.0, 2.0, -0.8), (1.8, 0.6, 1.8), 0.0)
    tram = Box("tram", 1.0, (40.0, 0.0, 0.0), (10.0, 3.0, 3.0), 0.0)
    points = [
        [20, 0, -1, 0],
        [21.2, 1.2, -1, 0],  # along the van's heading
        [21.2, -1.2, -1, 0],  # across it: outside
        [10, 2, -0.8, 0],
        [40, 0, 0, 0],  # nobody said what a tram is
        [-20, 0, -1, 0],  # behind the camera
        [5, 10, -1, 0],  # beside its view
        [30, 0, -1.7, 0],
    ]
    labels = frame(calibration, np.array(points), car, rider, tram).point_labels()
    np.testing.assert_array_equal(labels, [1, 1, 0, 3, IGNORE, IGNORE, IGNORE, 0])


def test_nothing_is_known_where_nobody_labeled(calibration: KittiCalibration) -> None:
    point = np.array([[20.0, 0.0, -1.0, 0.0]])
    (pixel,), _ = calibration.to_image(point)
    around = (pixel[0] - 5, pixel[1] - 5, pixel[0] + 5, pixel[1] + 5)
    assert frame(calibration, point).point_labels()[0] == 0
    assert frame(calibration, point, unlabeled=around).point_labels()[0] == IGNORE
    car = Box("car", 1.0, (20.0, 0.0, -1.0), (4.0, 2.0, 1.5), 0.0)
    assert frame(calibration, point, car, unlabeled=around).point_labels()[0] == 1


@pytest.mark.parametrize("yaw", [0.0, 0.5, math.pi / 2, -2.2])
def test_drawn_footprints_agree_with_points_in_boxes(yaw: float) -> None:
    box = Box("truck", 1.0, (26.337, 1.713, 0.0), (9.02, 2.51, 3.0), yaw)
    surface = np.ones((VIEW.height, VIEW.width), np.uint8)
    draw_footprints(surface, [box, replace(box, label="pedestrian", center=(40.0, 0.0, 0.0))], VIEW, TOP_VIEW_CLASSES)
    rows, cols = np.indices(surface.shape)
    centers = np.stack([46 - (rows + 0.5) * 0.1, 10 - (cols + 0.5) * 0.1, 0 * rows], axis=-1).reshape(-1, 3)
    np.testing.assert_array_equal(surface.ravel() == 4, inside(box, centers))
    assert set(np.unique(surface)) == {1, 4}


def test_footprints_at_the_edge_are_cut() -> None:
    surface = np.zeros((VIEW.height, VIEW.width), np.uint8)
    for center in ((46.0, 0.0), (6.0, 10.0), (100.0, 0.0), (20.0, -10.0)):
        draw_footprints(surface, [Box("car", 1.0, (*center, 0.0), (4.0, 2.0, 1.5), 0.0)], VIEW, TOP_VIEW_CLASSES)
    assert surface[0, 95:105].all()
    assert surface[-1, 0] == 2
    assert surface[255:262, -1].all()
    assert 500 < np.count_nonzero(surface) < 1300


def test_most_returns_of_a_cell_decide() -> None:
    def cell(col: int, *labels: int) -> list[tuple[float, float, float, float, int]]:
        return [(20.05, 9.95 - 0.1 * col, -1.7, 0.0, label) for label in labels]

    rows = cell(0, 1, 1, 0) + cell(1, 1, 0) + cell(2, 2, 2, 1) + cell(3, 1, 2, 0) + cell(4, IGNORE) + cell(5, 1, IGNORE)
    rows += [(20.05, 9.95, 3.0, 0.0, 0)] * 9 + [(50.0, 0.0, -1.7, 0.0, 1)]  # above the view, and beyond it
    table = np.array(rows)
    one = RoadFrame("00/0", "drive", table[:, :4].astype(np.float32), table[:, 4].astype(np.uint8))
    truth = one.top_view(VIEW)
    assert truth[259, :7].tolist() == [1, 0, 2, 0, IGNORE, 1, IGNORE]
    assert np.count_nonzero(truth != IGNORE) == 5


def test_semantickitti_files(tmp_path: Path) -> None:
    with pytest.raises(PointsError, match="SemanticKITTI"):
        SemanticKitti(tmp_path)
    raw = np.array([0, 40, 60, 10, 13, 18, 20, 252, 257, 258, 259, 30, 48, 72, (7 << 16) + 10], np.uint32)
    for name in ("00/000003", "08/000001", "77/000000"):
        sequence, stem = name.split("/")
        for part in ("velodyne", "labels"):
            (tmp_path / "sequences" / sequence / part).mkdir(parents=True)
        np.zeros((15, 4), np.float32).tofile(tmp_path / "sequences" / sequence / "velodyne" / f"{stem}.bin")
        raw.tofile(tmp_path / "sequences" / sequence / "labels" / f"{stem}.label")
    (tmp_path / "sequences/00/labels/._000003.label").touch()
    sequences = SemanticKitti(tmp_path)
    assert sequences.names("all") == ["00/000003", "08/000001", "77/000000"]
    assert sequences.names("test") == sequences.names("all")  # one is a test drive, the others nobody's
    assert sequences.names("train") == ["08/000001", "77/000000"]
    assert sequences.frame("08/000001").drive == "2011_09_30_drive_0028"
    one = sequences.frame("77/000000")
    assert (one.name, one.drive) == ("77/000000", "77")
    assert one.labels.tolist() == [IGNORE, 1, 1, 2, 2, 2, 2, 2, 2, 2, 2, 0, 0, 0, 2]
    raw[1:].tofile(tmp_path / "sequences/77/labels/000000.label")
    with pytest.raises(PointsError, match="14 labels for a scan of 15 points"):
        sequences.frame("77/000000")
    (raw % 20).tofile(tmp_path / "sequences/77/labels/000000.label")  # as of training: nothing was road, in silence
    with pytest.raises(PointsError, match="no class for 2, 8, 12, 17, 19; expected SemanticKITTI's raw numbers"):
        sequences.frame("77/000000")


@pytest.fixture(scope="module")
def scan() -> LabeledScan:
    return LabeledScan.from_simulation(simulated_scan(3))


def agreement(scan: LabeledScan) -> float:
    """Share of vehicle points that lie in the box they are of."""
    vehicles = [b for b in scan.boxes if b.label in ("car", "van", "truck")]
    inboxes = np.zeros(len(scan.points), bool)
    for box in vehicles:
        inboxes |= inside(box, scan.points, 0.15)
    return float(inboxes[scan.labels == 1].mean())


def test_changes_keep_labels_true(scan: LabeledScan) -> None:
    assert agreement(scan) > 0.98
    for seed in range(4):
        assert agreement(augmented(scan, np.random.default_rng(seed))) > 0.97


@pytest.mark.parametrize("change", [lambda s: s, mirrored, lambda s: turned(s, 0.4), lambda s: mirrored(turned(s, -2))])
def test_the_surface_follows_the_points(scan: LabeledScan, change: Callable[[LabeledScan], LabeledScan]) -> None:  # type: ignore[no-untyped-def]
    marked = np.zeros_like(scan.surface)
    marked[150:200, 220:300] = 1  # x 10..20 m, y -10..6 m
    scan = replace(scan, surface=marked, boxes=(), counts=())
    corners = np.array([[10, -10], [20, -10], [20, 6], [10, 6]], np.float32)
    as_points = np.c_[corners, np.zeros((4, 2), np.float32)]
    moved = change(replace(scan, points=as_points))
    wide = replace(VIEW, x_range_m=(-30.0, 30.0), y_range_m=(-30.0, 30.0))
    truth = moved.top_view_truth(wide)
    rows, cols = np.nonzero(truth == 1)
    middle = np.array([30 - (rows.mean() + 0.5) * 0.1, 30 - (cols.mean() + 0.5) * 0.1])
    np.testing.assert_allclose(middle, moved.points[:, :2].mean(axis=0), atol=0.15)
    assert np.count_nonzero(truth == 1) == pytest.approx(16_000, rel=0.03)


def test_a_mirrored_turned_scan_turned_and_mirrored_back(scan: LabeledScan) -> None:
    back = turned(mirrored(mirrored(turned(scan, 0.7))), -0.7)
    np.testing.assert_allclose(back.points, scan.points, atol=1e-4)
    assert not back.mirrored
    assert back.turn == pytest.approx(0.0)


@pytest.mark.parametrize("sensor", [None, get_sensor("vlp-16")])
def test_scans_are_stored_and_read_back(scan: LabeledScan, sensor: SensorProfile | None, tmp_path: Path) -> None:
    replace(scan, sensor=sensor).save(tmp_path / "scan.npz")
    again = LabeledScan.load(tmp_path / "scan.npz")
    np.testing.assert_array_equal(again.points, scan.points)
    np.testing.assert_array_equal(again.labels, scan.labels)
    np.testing.assert_array_equal(again.surface, scan.surface)
    assert (again.counts, again.sensor) == (scan.counts, sensor)
    assert [b.label for b in again.boxes] == [b.label for b in scan.boxes]
    assert list(tmp_path.iterdir()) == [tmp_path / "scan.npz"]


def test_same_seed_same_change(scan: LabeledScan) -> None:
    one, other = (augmented(scan, np.random.default_rng((1, 2))) for _ in range(2))
    np.testing.assert_array_equal(one.points, other.points)


def test_the_sure_road_is_road() -> None:
    claimed = right = 0
    for seed in range(5):
        scan = LabeledScan.from_simulation(simulated_scan(seed))
        sure = sure_surface(scan.points)
        assert sure.shape == (SURFACE.height, SURFACE.width)
        claimed += np.count_nonzero(sure == 1)
        right += np.count_nonzero((sure == 1) & (scan.surface == 1))
        assert abs(ground_plane(scan.points)[2] + 1.73) < 0.15
    assert claimed > 300
    assert right > 0.97 * claimed


def test_no_ground_no_claim() -> None:
    assert ground_plane(np.zeros((0, 4), np.float32)) is None
    assert (sure_surface(np.zeros((0, 4), np.float32)) == IGNORE).all()


def test_every_table_of_frames_is_read_and_unknown_drives_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "training/label_2").mkdir(parents=True)
    for name in ("000000", "000001", "000002", "._000000"):  # the last one of macOS, on a disk of another system
        (tmp_path / f"training/label_2/{name}.txt").touch()
    assert KittiObjects(tmp_path).names("test") == ["000000", "000001", "000002"]  # no table: drives of their own
    (tmp_path / "frames.csv").write_text("name, drive, grade\n000000, 2011_09_26_drive_0011_sync, A\n")
    (tmp_path / "frames-2.csv").write_text("name,drive,grade\n000001,2011_09_26_drive_0001,B\n")
    objects = KittiObjects(tmp_path)
    assert objects.drives == {"000000": "2011_09_26_drive_0011", "000001": "2011_09_26_drive_0001"}
    assert objects.names("test", grades="AB") == ["000000"]
    (tmp_path / "frames-2.csv").write_text("name,drive,grade\n000001,2011_09_26_drive_0001\n")
    assert KittiObjects(tmp_path).names("validation") == ["000001"]  # not graded
    assert objects.names("validation", grades="AB") == ["000001"]
    assert objects.names("all", grades="AB") == ["000000", "000001"]  # nobody knows the drive of 000002
    with pytest.raises(PointsError, match="no labeled scan '000002'"):
        objects.frame("000002")
    for text in ("name,drive\n000002,\n", "name,day\n000002,26\n"):
        (tmp_path / "frames-2.csv").write_text(text)
        with pytest.raises(PointsError, match="expected columns name and drive"):
            KittiObjects(tmp_path)
    (tmp_path / "frames-2.csv").unlink()
    (tmp_path / "frames.csv").write_text("name,drive\n1,26\n")  # as spreadsheets write 000001
    with pytest.raises(PointsError, match=r"no training/label_2/\*\.txt of a scan in frames\*\.csv, such as '1'"):
        KittiObjects(tmp_path)


def test_every_named_drive_has_one_place() -> None:
    for drive in {*TEST_DRIVES, *(d for fold in FOLDS for d in fold)}:
        for fold in range(len(FOLDS)):
            assert [in_split(drive, s, fold) for s in ("train", "validation", "test")].count(True) == 1
        assert not in_split(drive, "validation")
    for drive in VALIDATION_DRIVES:
        assert [in_split(drive, s) for s in ("train", "validation", "test", "all")] == [False, True, False, True]
        assert not in_split(drive, "validation", 0)
    assert [in_split("mine", s) for s in ("train", "validation", "test", "all")] == [True, False, True, True]
    with pytest.raises(OptionError, match="expected train, validation, test or all"):
        in_split("mine", "both")
    with pytest.raises(OptionError, match="expected 0 to 2"):
        in_split("mine", "train", 3)


def test_drives_are_never_shared(kitti_root: Path) -> None:
    objects = KittiObjects(kitti_root)
    drive = objects.drives
    train, test = (objects.names(s, grades="AB") for s in ("train", "test"))
    validation = objects.names("validation", grades="AB")
    assert sorted(train + validation + test) == sorted(objects.names("all", grades="AB"))
    assert len(train + validation + test) == 228 + 167  # frames.csv and frames-2.csv
    assert {drive[n] for n in test} == TEST_DRIVES - {"2011_10_03_drive_0027"}
    assert {drive[n] for n in validation} == VALIDATION_DRIVES
    assert not {drive[n] for n in train} & (TEST_DRIVES | VALIDATION_DRIVES)
    for fold in range(len(FOLDS)):
        left, held_back = (objects.names(s, fold=fold, grades="AB") for s in ("train", "validation"))
        assert sorted(left + held_back) == sorted(train)
        assert {fold_of(drive[n]) for n in held_back} == {fold}
        assert fold not in {fold_of(drive[n]) for n in left}


def test_layouts_of_test_drives_are_left_out(data_root: Callable[[str], Path]) -> None:  # type: ignore[no-untyped-def]
    root = data_root("kitti_labels_7481")
    assert any(d in (root / "frames.csv").read_text() for d in TEST_DRIVES)
    rows = (root / "frames.csv").read_text().splitlines()[1:]
    kept = [r for r in rows if not any(d in r for d in TEST_DRIVES)]
    assert next(layouts(root)) == read_labeled(root, kept[0].split(",")[0])[0]
    assert sum(1 for _ in itertools.islice(layouts(root), 50)) == 50


@pytest.mark.parametrize("drive", [min(TEST_DRIVES), "2011_09_26_drive_0001"])  # without a layout; without labels
def test_a_folder_without_layouts_is_an_error(tmp_path: Path, drive: str) -> None:
    (tmp_path / "frames.csv").write_text(f"name,drive\n000000,{drive}\n")
    for folder in (tmp_path, tmp_path / "mistyped"):  # else scenes are drawn without layouts, for hours
        with pytest.raises(PointsError, match=r"lacks label_2, or frames\.csv"):
            next(layouts(folder))


def test_real_boxes_are_full_of_points(kitti_root: Path) -> None:
    objects = KittiObjects(kitti_root)
    empty = 0
    for name in ("000000", "000160", "000264"):
        one = objects.frame(name)
        empty += sum(not inside(b, one.points, 0.1).any() for b in one.boxes)
        labels = one.point_labels()
        assert (labels == 1).sum() > 100
        assert 0.1 < (labels != IGNORE).mean() < 0.4  # the camera sees less than a quarter of the turn
    assert empty <= 2


def test_road_truth_of_observed_cells(semantickitti_root: Path) -> None:
    sequences = SemanticKitti(semantickitti_root)
    assert sequences.names("test") == sequences.names("all")
    assert not sequences.names("train")
    one = sequences.frame(sequences.names("test")[0])
    assert one.drive == "2011_10_03_drive_0027"
    truth = one.top_view(VIEW)
    assert truth.shape == (400, 200)
    assert 3000 < (truth != IGNORE).sum() < 12_000
    assert 0.2 < (truth[truth != IGNORE] == 1).mean() < 0.9
    assert set(np.unique(truth)) <= {0, 1, 2, IGNORE}


CAR_LINE = "Car 0 0 0 500 150 700 300 1.5 1.6 3.9 1.0 1.7 12.0 1.57"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (CAR_LINE + "\nCar 0 0 0 415 34 876 356", r"line 2: expected a class and 14 finite numbers, got 7"),
        (CAR_LINE.replace("12.0", "far"), r"line 1: could not convert string to float: 'far'"),
        ("\n\n" + CAR_LINE.replace("12.0", "nan"), r"line 3: .* one that is not finite"),
        (CAR_LINE.replace("12.0", "1e999"), r"line 1: .* one that is not finite"),
        (CAR_LINE.replace("12.0", "1e300"), r"line 1: .* below 1e8"),  # numpy warned of it
        ("Car", r"line 1: .* got 0$"),
        (CAR_LINE.replace("1.5 1.6 3.9", "-1 -1 -1"), r"line 1: .* above 0 m, got -1, -1, -1; .* DontCare"),
        (CAR_LINE.replace("1.5 1.6 3.9", "0 0 0"), r"line 1: expected a height, width and length above 0 m"),
        (CAR_LINE + "\n" + CAR_LINE.replace("3.9", "1e7"), r"line 2: .* got 1\.5, 1\.6, 1e\+07"),
        (CAR_LINE.replace("1.57", "90"), r"line 1: expected a direction in radians, got 90, as if in degrees"),
        (CAR_LINE.replace("1.57", "-179.5"), r"line 1: .* as if in degrees"),
        (CAR_LINE.replace(" ", ","), r"line 1: .* got 0"),
        ("\ufeff" + CAR_LINE + "\n\x00", r"line 2: "),
        (CAR_LINE.encode("utf-16"), "the labels cannot be read"),
        # Left, top, width and height: nothing lay in such a region, and no such object was counted.
        ("DontCare -1 -1 -10 503 169 90 190 -1 -1 -1 -1 -1 -1 -10", "line 1: expected left, top, right and bottom"),
        (CAR_LINE.replace("700 300", "700 100"), r"line 1: .* of a rectangle, got 500, 150, 700 and 100"),
    ],
)
def test_malformed_labels_name_the_line(text: str | bytes, error: str, tmp_path: Path) -> None:
    path = tmp_path / "000001.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(PointsError, match=rf"000001\.txt(, |: ){error}"):
        read_labels(path)


@pytest.mark.parametrize("end", ["\n", "\r\n", "", " 0.97\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_labels_as_other_tools_write_them(mark: str, end: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes((mark + CAR_LINE + end).encode())
    labels = read_labels(tmp_path / "a.txt")
    (tmp_path / "b.txt").write_text("DontCare -1 -1 -10 503 169 590 190 -1 -1 -1 -1000 -1000 -1000 -10\n")
    assert read_labels(tmp_path / "b.txt").kinds == ("dontcare",)
    (tmp_path / "c.txt").write_text(f"{CAR_LINE.replace('500 150 700', '0 150 -9')}\n" * 3)  # outside of the image
    assert read_labels(tmp_path / "c.txt").kinds == ("car",)  # once, as nothing can find its copies
    assert labels.kinds == ("car",)
    np.testing.assert_array_equal(labels.numbers, [[float(word) for word in CAR_LINE.split()[1:]]])
