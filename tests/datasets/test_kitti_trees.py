"""KITTI's raw drives and tracking sequences, and View of Delft, written here as they are downloaded, are read."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgeperc.datasets.kitti import KittiCalibration
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.errors import PointsError
from edgeperc.evaluation.truth import folder_truth
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.mounting import Mounting
from edgeperc.types.perception import Box

# The camera looks 2 degrees down and a little to the left, so its axes are not the sensor's.
TILT, TURN = math.radians(2.0), math.radians(1.0)
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
ABOUT_Y = np.array([[math.cos(TILT), 0, math.sin(TILT)], [0, 1, 0], [-math.sin(TILT), 0, math.cos(TILT)]])
ABOUT_Z = np.array([[math.cos(TURN), -math.sin(TURN), 0], [math.sin(TURN), math.cos(TURN), 0], [0, 0, 1]])
R, T = AXES @ np.linalg.inv(ABOUT_Z @ ABOUT_Y), np.array([0.02, -0.08, -0.27])
P2 = "721.5 0 609.5 0 0 721.5 172.8 0 0 0 1 0"
OF_SEQUENCE = (
    f"P2: {P2}\nR_rect 1 0 0 0 1 0 0 0 1\nTr_velo_cam {' '.join(map(repr, np.column_stack([R, T]).ravel().tolist()))}\n"
)
KINDS = {"car": "Car", "van": "Van", "truck": "Truck", "pedestrian": "Pedestrian", "cyclist": "Cyclist"}
DONTCARE = "DontCare -1 -1 -10 100 150 140 180 -1000 -1000 -1000 -10 -1 -1 -1"
SEEDS = (1, 4)


def calibrated(path: Path) -> KittiCalibration:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(OF_SEQUENCE)
    return KittiCalibration.read(path)


def scan_of(seed: int, path: Path) -> list[Box]:
    """Write a scan; the boxes of its objects."""
    scan = simulated_scan(seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    scan.points.tofile(path)
    return [box for box in scan.boxes if box.label in KINDS]


def label(box: Box, calibration: KittiCalibration) -> str:
    """KITTI's row of a box: its place is that of the middle of the bottom face, in the camera's frame."""
    ahead, left, up, length, width, height, yaw = calibration.in_camera(
        np.array([[*box.center, *box.size, box.yaw]])
    ).tolist()[0]
    return (
        f"{KINDS[box.label]} 0 0 0 300 150 400 250 {height!r} {width!r} {length!r} {-left!r} {-up + 0.5 * height!r} "
        f"{ahead!r} {math.remainder(-yaw - 0.5 * math.pi, 2.0 * math.pi)!r}"
    )


def assert_same(found: tuple[Box, ...] | None, boxes: list[Box], atol: float = 1e-3) -> None:
    """`level_heading` leaves out how far a heading goes up or down in the camera: 0.001 rad with two degrees."""
    assert found is not None
    assert [box.label for box in found] == [box.label for box in boxes]
    for one, other in zip(found, boxes, strict=True):
        np.testing.assert_allclose([*one.center, *one.size], [*other.center, *other.size], atol=atol)
        assert abs(math.remainder(one.yaw - other.yaw, 2.0 * math.pi)) < 2e-3


def tracking(root: Path) -> list[list[Box]]:
    """A set of tracking with a sequence of two labeled frames, and one after them without an object."""
    training = root / "training"
    calibration = calibrated(training / "calib/0009.txt")
    boxes = [scan_of(seed, training / f"velodyne/0009/{k:06d}.bin") for k, seed in enumerate(SEEDS)]
    scan_of(7, training / "velodyne/0009/000002.bin")
    rows = [f"{k} {n} {label(box, calibration)}" for k, of in enumerate(boxes) for n, box in enumerate(of)]
    (training / "label_02").mkdir()
    (training / "label_02/0009.txt").write_text("\n".join([*rows, f"1 -1 {DONTCARE}"]) + "\n")
    return boxes


def test_sequences_of_tracking_are_read(tmp_path: Path) -> None:
    boxes = tracking(tmp_path)
    folder = ScanFolder(tmp_path, "kitti-tracking")
    assert folder.drives == dict.fromkeys((f"0009_{k:06d}" for k in range(3)), "2011_09_26_drive_0036")
    assert folder.names("train") == [*folder.drives]  # of a drive of the folds
    for k, wanted in enumerate(boxes):
        frame = folder.frame(f"0009_{k:06d}")
        np.testing.assert_array_equal(frame.points, simulated_scan(SEEDS[k]).points)
        assert_same(frame.boxes, wanted)
        assert frame.unlabeled is not None
        assert len(frame.unlabeled) == k
        assert frame.image_labels is not None
        assert frame.image_labels.kinds == (*(box.label for box in wanted), *["dontcare"] * k)
    assert frame.known_at(np.array([[20.0, 0.0, 0.0], [-20.0, 0.0, 0.0]])).tolist() == [True, False]
    assert folder.frame("0009_000002").boxes == ()
    truth = folder_truth(frame, Mounting(1.73, 0.0, 0.0), None)
    assert truth.front is not None
    assert ScanFolder(tmp_path / "training", "kitti-tracking").drives == folder.drives
    (tmp_path / "training/velodyne/0009/000002.bin").unlink()
    assert len(ScanFolder(tmp_path, "kitti-tracking").drives) == 2


def test_a_sequence_of_no_known_drive_has_its_own(tmp_path: Path) -> None:
    tracking(tmp_path)
    for part in ("velodyne/{}", "label_02/{}.txt", "calib/{}.txt"):
        (tmp_path / "training" / part.format("0009")).rename(tmp_path / "training" / part.format("mine"))
    assert {*ScanFolder(tmp_path, "kitti-tracking").drives.values()} == {"kitti_tracking_mine"}


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("x 1 Car 0 0 0 1 1 2 2 1 1 1 1 1 1 1", "line 2: expected the number of a frame, got 'x'"),
        ("0 1 Car 0 0 0 1 1 2 2 1 1 1", "line 2: expected a class and 14 finite numbers, got 10"),
        ("0 1 Car 0 0 0 1 1 2 2 -1 1 1 1 1 1 1", "expected a height, width and length above 0 m"),
        ("0 1 Wagon 0 0 0 1 1 2 2 1 1 1 1 1 9 1", "no class for 'wagon'"),
        ("0", "expected a class and 14 finite numbers, got 0"),
    ],
)
def test_broken_labels_of_tracking_are_refused(line: str, told: str, tmp_path: Path) -> None:
    tracking(tmp_path)
    file = tmp_path / "training/label_02/0009.txt"
    file.write_text(f"{file.read_text().splitlines()[0]}\n{line}\n")
    with pytest.raises(PointsError, match=re.escape(told)):
        ScanFolder(tmp_path, "kitti-tracking").frame("0009_000000")


def tracklets(of_frames: list[list[Box]]) -> str:
    """KITTI's file of tracklets, one of each box."""
    items = []
    for k, boxes in enumerate(of_frames):
        for box in boxes:
            length, width, height = box.size
            x, y, z = box.center
            pose = f"<tx>{x}</tx><ty>{y}</ty><tz>{z - 0.5 * height}</tz><rx>0</rx><ry>0</ry><rz>{box.yaw}</rz>"
            items.append(
                f"<item><objectType>{KINDS[box.label]}</objectType><h>{height}</h><w>{width}</w><l>{length}</l>"
                f"<first_frame>{k}</first_frame><poses><count>1</count><item_version>2</item_version>"
                f"<item>{pose}<state>2</state><occlusion>0</occlusion></item></poses><finished>1</finished></item>"
            )
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
        f'<boost_serialization version="9"><tracklets class_id="0"><count>{len(items)}</count>'
        f"<item_version>1</item_version>{''.join(items)}</tracklets></boost_serialization>\n"
    )


def raw(root: Path, name: str = "2011_09_26/2011_09_26_drive_0017_sync") -> list[list[Box]]:
    """A drive of two scans."""
    drive = root / name
    boxes = [scan_of(seed, drive / f"velodyne_points/data/{k:010d}.bin") for k, seed in enumerate(SEEDS)]
    (drive / "tracklet_labels.xml").write_text(tracklets(boxes))
    numbers = " ".join(map(repr, R.ravel().tolist())), " ".join(map(repr, T.tolist()))
    (drive.parent / "calib_velo_to_cam.txt").write_text("calib_time: 15-Mar-2012\nR: {}\nT: {}\n".format(*numbers))
    (drive.parent / "calib_cam_to_cam.txt").write_text(f"R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: {P2}\n")
    return boxes


@pytest.mark.parametrize("below", ["", "2011_09_26", "2011_09_26/2011_09_26_drive_0017_sync"])
def test_tracklets_of_raw_drives_are_read(below: str, tmp_path: Path) -> None:
    boxes = raw(tmp_path)
    folder = ScanFolder(tmp_path / below, "kitti-raw")
    assert {*folder.drives.values()} == {"2011_09_26_drive_0017"}
    for k, (name, wanted) in enumerate(zip(folder.drives, boxes, strict=True)):
        assert name == f"2011_09_26_drive_0017_sync_{k:010d}"
        frame = folder.frame(name)
        assert_same(frame.boxes, wanted, 1e-9)
        assert frame.known_at(np.array([[20.0, 0.0, 0.0], [-20.0, 0.0, 0.0]])).tolist() == [True, False]


def test_a_drive_that_cvat_exports_is_labeled_all_around(tmp_path: Path) -> None:
    """It has no calibration, and names of its own, in a list."""
    boxes = raw(tmp_path, "export/mine")
    for file in (tmp_path / "export").glob("calib*"):
        file.unlink()
    data = tmp_path / "export/mine/velodyne_points/data"
    for k, name in enumerate(("left", "right")):
        (data / f"{k:010d}.bin").rename(data / f"{name}.bin")
    (tmp_path / "export/mine/frame_list.txt").write_text("0 a/left\n1 right\n7 gone\n")
    folder = ScanFolder(tmp_path, "kitti-raw")
    assert folder.drives == {"mine_left": "mine", "mine_right": "mine"}
    frame = folder.frame("mine_right")
    assert_same(frame.boxes, boxes[1], 1e-9)
    assert frame.known_at(np.array([[-20.0, 0.0, 0.0]])).all()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda text: text[:300], "no element found|unclosed|mismatched"),
        (lambda text: text.replace("<h>", "<h>-", 1), "a '[A-Z][a-z]+' of [0-9.]+ x [0-9.]+ x -"),
        (lambda text: text.replace("<rz>", "<rz>nan", 1), "rz is 'nan"),
        (lambda text: text.replace("<rz>", "<rz>nan</rz><rz>", 1), "rz is 'nan'"),
        (lambda text: text.replace("<first_frame>0", "<first_frame>x", 1), "invalid literal"),
        (lambda text: re.sub(r"<objectType>\w+", "<objectType> ", text), "a ' ' of"),
        (lambda text: text.replace("<!DOCTYPE boost_serialization>", '<!DOCTYPE b [<!ENTITY a "b">]>'), "entities"),
        (lambda text: text.replace("<tx>", "<ty>").replace("</tx>", "</ty>"), "tx is None"),
    ],
)
def test_broken_tracklets_are_refused(change: object, told: str, tmp_path: Path) -> None:
    raw(tmp_path)
    (file,) = tmp_path.rglob("tracklet_labels.xml")
    file.write_text(change(file.read_text()))  # type: ignore[operator]
    folder = ScanFolder(tmp_path, "kitti-raw")
    with pytest.raises(PointsError, match=f"has no tracklets of KITTI .*({told})"):
        folder.frame(next(iter(folder.drives)))


@settings(max_examples=30)
@given(data=st.data())
def test_any_bytes_are_tracklets_or_refused(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    root = tmp_path_factory.mktemp("any")
    drive = root / "drive"
    (drive / "velodyne_points/data").mkdir(parents=True)
    np.ones((3, 4), np.float32).tofile(drive / "velodyne_points/data/0000000000.bin")
    text = bytearray(tracklets([[Box("car", 1.0, (9.0, 0.0, 0.0), (4.0, 2.0, 1.5), 0.1)]]).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        k = data.draw(st.integers(0, len(text) - 1))
        text[k : k + data.draw(st.integers(0, 20))] = data.draw(st.binary(max_size=6))
    (drive / "tracklet_labels.xml").write_bytes(bytes(text))
    folder = ScanFolder(root, "kitti-raw")
    try:
        folder.frame("drive_0000000000")
    except PointsError as exc:
        assert "tracklet_labels.xml" in str(exc) or "no class for" in str(exc) or "expected less" in str(exc)  # noqa: PT017


def test_view_of_delft_is_read_as_published(tmp_path: Path) -> None:
    """Its places are the camera's, but its boxes stand upright and turn in the frame of the LiDAR."""
    training = tmp_path / "lidar/training"
    boxes = scan_of(SEEDS[0], training / "velodyne/00549.bin")
    calibration = calibrated(training / "calib/00549.txt")
    rows = []
    for box in boxes:
        length, width, height = box.size
        bottom = calibration.T_cam_velo @ [*box.center[:2], box.center[2] - 0.5 * height, 1.0]
        turn = -box.yaw - 0.5 * math.pi  # beyond a half turn, as theirs
        rows.append(
            f"{KINDS[box.label].replace('Truck', 'truck')} 0 0 0 300 150 400 250 {height} {width} {length} {bottom[0]} "
            f"{bottom[1]} {bottom[2]} {turn} 1"
        )
    (training / "label_2").mkdir()
    (training / "label_2/00549.txt").write_text("\n".join(rows))
    (training / "label_2/00550.txt").write_text("")
    wanted = [box for box in boxes if box.label != "van"]  # a class that it does not tell
    with pytest.warns(UserWarning, match="of 2 labeled scans 1 are there"):
        folder = ScanFolder(tmp_path, "vod")
    found = folder.frame("00549").boxes
    assert found is not None
    assert_same(tuple(box for box in found if box.label != "ignore"), wanted, 1e-9)


@pytest.mark.parametrize(
    ("layout", "told"),
    [
        ("kitti-raw", r"no tracklet_labels\.xml; expected DRIVE/tracklet_labels\.xml"),
        ("kitti-tracking", r"no label_02/SEQ\.txt"),
        ("vod", "no lidar/training/label_2"),
    ],
)
def test_other_folders_are_refused(layout: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(PointsError, match=told):
        ScanFolder(tmp_path, layout)


def test_scans_of_drives_that_are_not_there_are_told(tmp_path: Path) -> None:
    raw(tmp_path)
    for file in tmp_path.rglob("*.bin"):
        file.unlink()
    with pytest.raises(PointsError, match="scans of tracklets 0 are there"):
        ScanFolder(tmp_path, "kitti-raw")
    tracking(tmp_path / "t")
    for file in tmp_path.rglob("*.bin"):
        file.unlink()
    with pytest.raises(PointsError, match="labeled sequences' scans 0 are there"):
        ScanFolder(tmp_path / "t", "kitti-tracking")
