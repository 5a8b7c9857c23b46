"""Which scans lie below a path, and what their names tell."""

from __future__ import annotations

import argparse
import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from cli_helpers import Shell, write_scan
from edgeperc import PointsError, read_scans
from edgeperc.cli.scans import find_scans, warn_of_rate

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
def test_the_direction_of_nuscenes_is_asked_for(tmp_path: Path, shell: Shell) -> None:
    scan = write_scan(tmp_path / "0.pcd.bin")
    assert "pass --turn -90" in shell.err("run", scan, "--sensor", "nuscenes", "--anyway", code=0)
    for turn in ("-90", "0", "street"):
        assert "--turn -90" not in shell.err("run", scan, "--sensor", "nuscenes", f"--turn={turn}", "--anyway", code=0)
