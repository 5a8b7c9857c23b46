"""Which scans lie below a path, and what their names tell."""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cli_helpers import Shell, write_scan
from edgeperc import PointsError, StampError, Tracker, read_scans
from edgeperc.cli.scan_times import times_of, warn_of_rate
from edgeperc.cli.scans import find_scans

TOP = "n015-2018-07-24__LIDAR_TOP__{}.pcd.bin"  # as nuScenes calls them
START_US = 1532402927647951


def told(names: list[str], rate_hz: float = 10.0) -> str:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        how = argparse.Namespace(rate=rate_hz, topic=None, remission_field=None, columns=None, origin=None)
        warn_of_rate([Path("drive") / name for name in names], how)
    return " ".join(str(each.message) for each in said)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ([TOP.format(START_US + 500_000 * k) for k in range(4)], "0.5 s apart, and taken as 0.1 s apart"),
        ([TOP.format(START_US + 50_000 * k) for k in range(4)], "pass --rate 20"),
        ([f"{1616343528200 + 500 * k}.bin" for k in range(4)], "pass --rate 2"),
        ([f"{315966265259836000 + 200_000_000 * k}.npy" for k in range(4)], "pass --rate 5"),
        ([f"{1700000000 + 0.05 * k:.6f}.pcd" for k in range(4)], "pass --rate 20"),
        ([f"{1700000000 + 0.1 * k + 60 * (k > 1):.6f}.pcd" for k in range(4)], "60.1 s pass between 1700000000.1"),
        ([f"{k:06d}.bin" for k in (0, 1, 2, 3, 7, 8, 12)], "3 scans are missing between 000003.bin and 000007.bin"),
        ([f"a_{k}.bin" for k in range(4)] + [f"b_{k}.bin" for k in range(4)], "go back between a_3.bin and b_0.bin"),
    ],
)  # fmt: skip
def test_names_that_contradict_the_rate_are_told(names: list[str], said: str) -> None:
    assert said in told(names)


@pytest.mark.parametrize(
    "names",
    [
        [f"{k:010d}.bin" for k in range(4)],
        [f"{k:06d}.bin" for k in range(0, 40, 5)],  # numbers that count something else
        [f"{1700000000 + 0.11 * k:.6f}.pcd" for k in range(4)],
        [f"{20180724112245 + k}.bin" for k in range(4)],  # a date
        ["first.bin", "1.bin", "7.bin"],
        ["1.bin", "9.bin"],
        ["1.25.bin", "1.5.bin", "3.5.bin", "3.75.bin"],
        ["drive.pcap", "drive_9.pcap"],
        [],
    ],
)
def test_other_names_are_not_told(names: list[str]) -> None:
    assert told(names) == ""


@pytest.mark.filterwarnings("default")
def test_a_drive_with_a_gap_is_told_where_it_is_tracked(tmp_path: Path, shell: Shell) -> None:
    for k in (0, 1, 2, 5):
        write_scan(tmp_path / f"{k}.bin")
    assert "2 scans are missing between 2.bin and 5.bin" in shell.err("run", tmp_path, "--anyway", "--track", code=0)
    assert "missing" not in shell.err("run", tmp_path, "--anyway", code=0)


@pytest.mark.filterwarnings("default")
def test_times_of_points_that_contradict_the_rate_are_told(tmp_path: Path, shell: Shell) -> None:
    """A scan every 0.2 s, which takes 0.1 s; on a clock, or from the beginning of each scan."""
    kinds = [*((name, "f4") for name in ("x", "y", "z", "intensity")), ("timestamp", "f8")]
    for begin_s in (1.7e9, 0.0):
        for k in range(4):
            points = np.zeros(40, kinds)
            points["x"] = points["y"] = np.arange(40.0)
            points["timestamp"] = begin_s + (0.2 * k if begin_s else 0.0) + np.linspace(0.0, 0.1, 40)
            np.save(tmp_path / f"{k}.npy", points)
        said = shell.err("run", tmp_path, "--anyway", "--track", code=0)
        assert ("by the times of their points, scans are 0.2 s apart" in said) == (begin_s > 0.0)
        assert "--rate" not in shell.err("run", tmp_path, "--anyway", "--track", "--rate", "5", code=0)


@pytest.mark.parametrize(
    "below",
    [
        "training/velodyne",
        "sequences/00/velodyne",
        "00/velodyne",  # of sequences/
        "data",  # of velodyne_points/
        "velodyne_points/data",
        "2011_09_26_drive_0001_sync/velodyne_points/data",
        "2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data",
        "data_3d_raw/2013_05_28_drive_0000_sync/velodyne_points/data",
        "samples/LIDAR_TOP",
        "LIDAR_TOP",
        "lidar/training/velodyne",
        "data/000076/lidar_roof",
    ],
)
def test_the_root_of_a_data_set_is_read(below: str, tmp_path: Path, shell: Shell) -> None:
    scan = write_scan(tmp_path / below / "0000000000.bin")
    assert find_scans([tmp_path]).paths == [scan]
    (answer,) = shell.records("info", tmp_path, "--sensor", "hdl-64e", code=1)  # of 40 points
    assert answer["scan"] == str(scan.parent)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.csv", b"x,y,z\n1,2,3\n", "/*.csv"),
        ("a.TXT", b"1 2 3\n", "/*.TXT"),
        ("1.feather", b"ARROW1\0\0", "1.feather is a Feather (Arrow) table"),
        ("00.pkl.gz", b"\x1f\x8b\x08\x00", "edgeperc eval ROOT:pandaset reads it"),
        ("1.parquet", b"PAR1\0\0\0\0", "edgeperc eval ROOT:waymo reads it"),
        ("a.las", b"LASF", "pdal translate"),
    ],
)
def test_a_folder_without_scans_says_what_is_in_it(
    name: str, content: bytes, said: str, tmp_path: Path, shell: Shell
) -> None:
    """And the root of a data set whose scans are such files."""
    tmp_path = tmp_path / "001/lidar"
    tmp_path.mkdir(parents=True)
    (tmp_path / ".hidden.pkl").write_bytes(b"\x80\x04")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PointsError, match=r"no scan in this folder.*" + re.escape(said)):
        next(read_scans(tmp_path))
    for command in ("run", "info"):
        assert said in shell.err(command, tmp_path, code=1)
        assert said in shell.err(command, tmp_path.parents[1], code=1)
    assert said in shell.err("fit-sensor", tmp_path, "--sensor", "hdl-64e", "--out", tmp_path / "a.json", code=2)


@pytest.mark.filterwarnings("default")
def test_the_direction_of_sets_whose_x_is_not_ahead_is_asked_for(tmp_path: Path, shell: Shell) -> None:
    scan = write_scan(tmp_path / "0.pcd.bin")
    assert "pass --turn -90" in shell.err("run", scan, "--sensor", "nuscenes", "--anyway", code=0)
    assert "to the left, and x is taken for ahead; pass --turn 90" in shell.err(
        "run", scan, "--sensor", "once", "--anyway", code=0
    )
    for turn in ("-90", "0", "street"):
        assert "--turn -90" not in shell.err("run", scan, "--sensor", "nuscenes", f"--turn={turn}", "--anyway", code=0)


SCANS = [Path(f"drive/{number:010d}.bin") for number in (0, 1, 2, 4)]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.0\n0.1\n\n0.2\n0.4\n", [0.0, 0.1, 0.2, 0.4]),  # one for each
        ("# s\r\n-1.5\r\n-5e-1\r\n0\r\n1e1", [-1.5, -0.5, 0.0, 10.0]),
        ("0\n.1\n.2\n.3\n.4\n.5\n", [0.0, 0.1, 0.2, 0.4]),  # of each number
        (
            "".join(f"2011-09-26 13:02:{25 + k}.594360375\n" for k in range(5)),
            [1317042145.594360375 + k for k in (0, 1, 2, 4)],
        ),
    ],
    ids=["one for each", "signs", "of each number", "dates"],
)
def test_times_of_scan_files(tmp_path: Path, text: str, expected: list[float]) -> None:
    file = tmp_path / "times.txt"
    file.write_bytes(b"\xef\xbb\xbf" + text.encode())
    times = times_of(file, SCANS)
    assert [*times] == SCANS
    np.testing.assert_allclose([*times.values()], expected, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "scans", "said"),
    [
        ("0\n1\n2", SCANS, "3 times for 4 scans"),
        ("0\n1\n2\n3\n4\n5", [*SCANS[:3], Path("drive/last.bin")], "6 times for 4 scans"),
        ("0\n1\n1\n2", SCANS, "time 3 is 1"),
        ("0\nnan\n1\n2", SCANS, "time 2 is nan"),
        ("0 1 2 3", SCANS, "time 1 is 0 1 2 3"),
        ("2011-09-26\n13:02", SCANS, "time 2 is 13:02"),
        ("", SCANS, "0 times for 4 scans"),
        ("0\n1\n2\n3", [*SCANS[:3], Path("other/0.bin")], "of one folder"),
    ],
)
def test_times_that_are_of_no_use(tmp_path: Path, text: str, scans: list[Path], said: str) -> None:
    file = tmp_path / "times.txt"
    file.write_text(text)
    with pytest.raises(StampError, match=said):
        times_of(file, scans)


@given(st.text(alphabet="0123456789-:. eE\n\t#naif", max_size=60))
def test_any_times_are_read_or_a_typed_error(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "times.txt"
        file.write_text(text)
        try:
            times = [*times_of(file, SCANS[:2]).values()]
        except StampError:
            return
        assert times == sorted(times)
        assert np.isfinite(times).all()


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, float]]:
    """Time and x of the poses that the tracker is given."""
    update, seen = Tracker.update, list[tuple[float, float]]()

    def note(self: Tracker, boxes: Any, stamp_s: float, pose: Any = None, **how: Any) -> Any:
        if pose is not None:  # of the first one, which compiles
            seen.append((stamp_s, float(pose[0][3])))
        return update(self, boxes, stamp_s, pose, **how)

    monkeypatch.setattr(Tracker, "update", note)
    return seen


@pytest.mark.filterwarnings("default")
def test_scan_files_with_times_have_poses(tmp_path: Path, shell: Shell, seen: list[tuple[float, float]]) -> None:
    """Without times of their points, they are tracked, and several are looked at, at the poses of a file."""
    for number in (3, 4, 6):
        write_scan(tmp_path / "drive" / f"{number}.bin")
    (tmp_path / "times.txt").write_text("".join(f"{10.0 + 0.2 * k}\n" for k in range(8)))
    poses = "".join(f"{10.0 + 0.2 * k} {2.0 * k} 0 0 0 0 0 1\n" for k in range(8))
    (tmp_path / "poses.txt").write_text(poses)
    tracked = [tmp_path / "drive", "--anyway", "--track", "--poses", tmp_path / "poses.txt"]
    answers = shell.records("run", *tracked, "--times", tmp_path / "times.txt", "--sweeps", "3")
    assert [answer["stamp_s"] for answer in answers] == pytest.approx([10.6, 10.8, 11.2])
    np.testing.assert_allclose(seen, [(10.6, 0.0), (10.8, 2.0), (11.2, 6.0)], atol=1e-6)
    assert "the scan has no time, by which its pose is found; pass --times FILE" in shell.err("run", *tracked, code=1)
    (tmp_path / "drive.pcap").write_bytes(b"\xd4\xc3\xb2\xa1" + bytes(20))
    assert "is of the scan files" in shell.err("run", tmp_path / "drive.pcap", "--times", tmp_path / "times.txt")


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("scans_in", "file", "lines"),
    [
        ("velodyne_points/data", "timestamps.txt", [f"2011-09-26 13:02:25.{k}00000000" for k in (1, 3, 5, 7)]),
        ("velodyne", "times.txt", [f"{0.2 * k:e}" for k in range(4)]),
    ],
)
def test_the_times_of_kitti_are_found(scans_in: str, file: str, lines: list[str], tmp_path: Path, shell: Shell) -> None:
    """They lie beside the folder of the scans; without --track, or with another --rate, nothing needs them."""
    drive = tmp_path / "2011_09_26_drive_0001_sync"
    folder = drive / scans_in
    folder.mkdir(parents=True)
    for k in (0, 1, 3):
        write_scan(folder / f"{k:010d}.bin")
    beside = folder.parent / file
    beside.write_text("\n".join(lines))
    tracked = ["run", drive, "--json", "--anyway", "--track"]
    said = shell.both(*tracked)
    assert said.err.count(f"have the times of {beside}") == 1
    stamps_s = [json.loads(line)["stamp_s"] for line in said.out.splitlines()]
    np.testing.assert_allclose(np.diff(stamps_s), [0.2, 0.4], atol=1e-6)
    for options in (tracked[:-1], [*tracked, "--rate", "5"]):
        assert "have the times" not in shell.err(*options, code=0)
    beside.write_text("\n".join(lines[:2]))
    err = shell.err(*tracked, code=0)
    assert "the times beside the scans are not taken" in err
    assert "2 times for 3 scans" in err


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("of_camera", [True, False])
def test_poses_in_the_format_of_kitti_need_no_option(
    of_camera: bool, tmp_path: Path, shell: Shell, seen: list[tuple[float, float]]
) -> None:
    """The times and the calibration lie beside them, and whose they are is told by their way."""
    root, camera = tmp_path / "sequences/00", np.eye(4)
    camera[:3] = [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.08], [1.0, 0.0, 0.0, -0.27]]
    lines = []
    for k in range(4):
        write_scan(root / f"velodyne/{k:06d}.bin")
        pose = np.eye(4)
        pose[0, 3] = 2.0 * k
        lines.append(" ".join(map(str, (camera @ pose @ np.linalg.inv(camera) if of_camera else pose)[:3].ravel())))
    (root / "poses.txt").write_text("\n".join(lines))
    (root / "times.txt").write_text("".join(f"{0.2 * k:e}\n" for k in range(4)))
    place = " ".join(map(str, camera[:3].ravel()))
    (root / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nP2: 700 0 600 0 0 700 180 0 0 0 1 0\nTr: {place}\n")
    tracked = ["run", root, "--anyway", "--track", "--poses", root / "poses.txt"]
    err = shell.err(*tracked, code=0)
    assert ("are those of the camera of" if of_camera else "are those of the sensor, at") in err
    np.testing.assert_allclose(seen, [(0.2 * k, 2.0 * k) for k in range(4)], atol=1e-6)
    (root / "calib.txt").unlink()
    assert ("by their way, these are poses of a camera" in shell.err(*tracked, code=2 * of_camera)) == of_camera
    (root / "times.txt").unlink()
    assert "poses in KITTI's format have no times; pass those of the scans: --times FILE" in shell.err(*tracked)
    (root / "poses.txt").unlink()
    assert "poses.txt cannot be read as poses" in shell.err(*tracked)
