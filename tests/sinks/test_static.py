"""Scans without what moves, in the format of the scan."""

from __future__ import annotations

import math
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cli_helpers import POINTSEG, Shell, run
from edgeperc import Box, OptionError, Perception, PointLabels, PointsError, Tracker, Tracks, read_points
from edgeperc.cli.main import build_parser
from edgeperc.cli.sinks import Sinks
from edgeperc.records import PerceivedScan
from edgeperc.sinks.static import StaticSink
from edgeperc.system.remote import location
from edgeperc.types.sensor import get_sensor

AHEAD = Box("car", 0.99, (12.0, 0.0, -0.9), (4.0, 1.8, 1.5), 0.0)
BESIDE = Box("car", 0.99, (9.0, 6.0, -0.9), (4.0, 1.8, 1.5), 0.0)


def scan_points() -> NDArray[np.float32]:
    """Points of a car ahead, of one beside, of a road below, and one that is not finite."""
    rng = np.random.default_rng(0)
    cars = [rng.uniform([-1.9, -0.8, -0.7, 0.0], [1.9, 0.8, 0.7, 1.0], (30, 4)) for _ in range(2)]
    cars[0][:, :3] += AHEAD.center
    cars[1][:, :3] += BESIDE.center
    road = rng.uniform([3.0, -9.0, -2.5, 0.0], [30.0, 9.0, -2.4, 1.0], (200, 4))
    whole = np.concatenate([*cars, road, [[math.nan, 0.0, 0.0, 0.5]]])
    return rng.permutation(whole).astype(np.float32)


def tracks_of(k: int) -> Tracks:
    """The car ahead drives as fast as the sensor; the one beside is parked."""
    tracker = Tracker()
    for i in range(k + 1):
        pose = np.eye(4)
        pose[0, 3] = 0.8 * i
        boxes = [AHEAD, Box("car", 0.99, (9.0 + 0.8 * (k - i), 6.0, -0.9), (4.0, 1.8, 1.5), 0.0)]
        tracks = tracker.update(boxes, 0.1 * i, pose)
    return tracks


POINTS, TRACKS = scan_points(), tracks_of(15)


def perceived(name: str, tracks: Tracks | None = TRACKS, points: NDArray[np.float32] = POINTS) -> PerceivedScan:
    labels = PointLabels(np.zeros(len(points), np.uint8), np.ones(len(points), np.bool_), POINTSEG.classes)
    perception = Perception(len(points), 1, labels, None, (AHEAD, BESIDE), {}, {}, (), None)
    return PerceivedScan(name, 0.1, points, perception, tracks, get_sensor("hdl-64e"))


def expected(*boxes: Box) -> NDArray[np.float32]:
    gone = np.zeros(len(POINTS), np.bool_)
    for box in boxes:
        half = np.array(box.size) / 2.0 + 0.3  # the car in the track is a little larger or smaller than the box
        gone |= (np.abs(POINTS[:, :3] - np.array(box.center)) <= half).all(axis=1)
    return POINTS[~gone]


@pytest.mark.parametrize(
    ("name", "written"),
    [
        *((f"a/{name}", name) for name in ("7.bin", "7.npy", "7.npz", "7.PCD", "7.ply")),
        *(("drive.pcap/000003", "000003.bin"), ("image_2/street.png", "street.bin")),
    ],
)
def test_a_file_has_the_name_and_the_format_of_the_scans(tmp_path: Path, name: str, written: str) -> None:
    sink = StaticSink(tmp_path / "out")
    sink.write(perceived(name))
    sink.close()
    (file,) = (tmp_path / "out").iterdir()
    assert file.name == written
    np.testing.assert_array_equal(read_points(file), expected(AHEAD))
    assert (sink.n_points, sink.n_removed) == (261, 261 - len(expected(AHEAD)))
    assert sink.n_removed >= 30


@pytest.mark.parametrize("name", ["7.npy", "7.npz", "7.pcd", "7.ply", "7.bin"])
def test_points_of_a_map_stay_in_the_map(tmp_path: Path, name: str) -> None:
    origin = (512345.25, 5412345.5, 113.0) if name != "7.bin" else (100.0, -50.0, 2.0)
    scan = perceived(name)
    StaticSink(tmp_path).write(replace(scan, perception=replace(scan.perception, origin_m=origin)))
    np.testing.assert_allclose(read_points(tmp_path / name, origin_m=origin), expected(AHEAD), atol=1e-5)


def test_what_could_move_goes_too_if_it_is_wished(tmp_path: Path) -> None:
    for tracks in (None, TRACKS):
        sink = StaticSink(tmp_path, without="movable")
        sink.write(perceived("x.bin", tracks))
        np.testing.assert_array_equal(read_points(tmp_path / "x.bin"), expected(AHEAD, BESIDE))


def test_of_a_scan_that_came_twice_what_could_move_goes(tmp_path: Path) -> None:
    tracker = Tracker()
    tracker.update([], 1.0)
    with pytest.warns(UserWarning, match="late or doubled"):
        late = tracker.update([], 1.0)
    for without, tracks in (("moving", late), ("movable", None)):
        StaticSink(tmp_path / without, without=without).write(perceived("x.bin", tracks))  # type: ignore[arg-type]
    assert (tmp_path / "moving" / "x.bin").read_bytes() == (tmp_path / "movable" / "x.bin").read_bytes()


@pytest.mark.parametrize("values", [4, 5, 6])
@pytest.mark.parametrize("url", ["", "memory:/"])
def test_the_ring_of_nuscenes_files_stays(tmp_path: Path, url: str, values: int) -> None:
    """With the coordinates of the scan, which has been straightened."""
    if url:
        pytest.importorskip("fsspec")
    source, rings = location(f"{url}{tmp_path}/sweep.pcd.bin"), np.arange(len(POINTS), dtype=np.float32)
    columns = np.column_stack([POINTS + np.float32([0.5, 0.0, 0.0, 0.0]), rings, rings])[:, :values]
    source.write_bytes(columns.tobytes())
    sink = StaticSink(tmp_path / "out")
    sink.write(perceived(str(source)))
    rows = np.fromfile(tmp_path / "out/sweep.pcd.bin", np.float32).reshape(-1, values)
    np.testing.assert_array_equal(rows[:, :4], expected(AHEAD))
    if values > 4:
        np.testing.assert_array_equal(POINTS[rows[:, 4].astype(int)], rows[:, :4])
    source.write_bytes(source.read_bytes()[:-20])
    with pytest.raises(PointsError, match="expected as many for each"):
        sink.write(perceived(str(source)))


def test_errors_name_the_reason(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="expected 'moving' or 'movable'"):
        StaticSink(tmp_path, without="cars")  # type: ignore[arg-type]
    sink = StaticSink(tmp_path)
    with pytest.raises(OptionError, match="--track"):
        sink.write(perceived("x.bin", None))
    sink.write(perceived("a/x.bin"))
    sink.write(perceived("a/x.bin"))  # the same scan again replaces its file
    with pytest.raises(OptionError, match=r"already the file of a/x\.bin"):
        sink.write(perceived("b/x.bin"))
    with pytest.raises(OptionError, match="is the scan itself"):
        sink.write(perceived(str(tmp_path / "y.bin")))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.bin"]


class Standing:
    """Perceives a car that drives with the sensor, and four that are parked beside its way."""

    def __init__(self, models: Any, *, sensor: str, **_: Any) -> None:
        self.sensor, self.cards, self._k = get_sensor(sensor), (POINTSEG,), 0

    def __call__(self, points: NDArray[np.float32], stamp_s: float | None = None, **_: Any) -> Perception:
        parked = [
            Box("car", 0.99, (x - 0.8 * self._k, y, -0.9), (4.0, 1.8, 1.5), 0.0)
            for x, y in ((20, 6), (27, -6), (34, 6), (41, -6))
        ]
        self._k += 1
        return Perception(len(points), 1, None, None, (AHEAD, *parked), {}, {}, (), stamp_s)


def test_the_command_writes_every_scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell) -> None:
    monkeypatch.setitem(sys.modules, "edgeperc.perceiver", SimpleNamespace(Perceiver=Standing))
    (tmp_path / "drive").mkdir()
    for k in range(12):
        POINTS.tofile(tmp_path / f"drive/{k:06d}.bin")
    assert run("run", tmp_path / "drive", "--track", "--static", tmp_path / "out") == 0
    written = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in written] == [f"{k:06d}.bin" for k in range(12)]
    assert written[0].read_bytes() == POINTS.tobytes()  # as yet nothing is known to move
    np.testing.assert_array_equal(read_points(written[-1]), expected(AHEAD))
    assert run("run", tmp_path / "drive", "--movable", "--static", tmp_path / "movable") == 0
    assert len(read_points(tmp_path / "movable/000000.bin")) == len(expected(AHEAD))
    assert run("run", tmp_path / "drive", "--movable", "--static", tmp_path / "out") == 1  # as of another drive
    assert (tmp_path / "out/000000.bin").read_bytes() == POINTS.tobytes()
    assert run("run", tmp_path / "drive", "--movable", "--static", tmp_path / "drive") == 1
    assert (tmp_path / "drive/000003.bin").read_bytes() == POINTS.tobytes()
    for wrong in (["--static", tmp_path / "out"], ["--movable"]):
        assert shell.err("run", tmp_path / "drive", *wrong)


@pytest.mark.parametrize("paths", [("a", "b"), ("b", "a"), ("000001.csv", "a")])
@pytest.mark.parametrize("options", ["--static a --movable", "--labels-for kitti --out out"])
def test_scans_whose_files_have_one_name_are_told_before_the_run(
    paths: tuple[str, str], options: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in "ab":
        Path(folder).mkdir()
        POINTS.tofile(f"{folder}/000001.bin")
    Path("000001.csv").write_text("x,y,z,intensity\n1,2,3,0.5\n")  # becomes 000001.bin
    assert "would both be called 000001" in shell.err("run", *paths, *options.split())
    assert Path("a/000001.bin").read_bytes() == POINTS.tobytes()
    Path("calib").mkdir()  # of which each lacks its own
    if "kitti" in options:
        assert "calib/000001.txt, the calibration of" in shell.err("run", "b", *options.split(), "--calib", "calib")


def sinks_of(folder: Path, *options: object) -> Sinks:
    return Sinks(build_parser().parse_args(["run", str(folder), *map(str, options)]))


def test_a_sink_made_before_one_that_cannot_be_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []
    monkeypatch.setattr("edgeperc.sinks.page.PageSink.close", lambda self, whole: closed.append(self))
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError, match="file"):
        sinks_of(tmp_path, "--play", tmp_path / "play.html", "--static", tmp_path / "file", "--movable")
    assert len(closed) == 1


def test_a_sink_that_fails_costs_the_others_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each gets every scan and is closed; the run is told the first error of a scan, and how many files failed."""
    options = ["--play", tmp_path / "play.html", "--static", tmp_path / "static", "--movable"]
    with sinks_of(tmp_path, *options) as sinks:
        for k in range(3):
            scan = perceived(f"{k}.bin", None)
            if k == 1:
                (tmp_path / "static").rename(tmp_path / "away")
                with pytest.raises(FileNotFoundError, match="static"):
                    sinks.write(scan)
                (tmp_path / "away").rename(tmp_path / "static")
            else:
                sinks.write(scan)
        (tmp_path / "play.html").mkdir()  # a page cannot replace a folder
    assert {file.name for file in (tmp_path / "static").iterdir()} == {"0.bin", "2.bin"}
    assert sinks.n_failed == 1
    assert "play.html" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("live", "error", "names"),
    [
        (False, None, {"play.html"}),
        (False, KeyboardInterrupt, {"play.html.part"}),
        (False, PointsError, {"play.html.part"}),
        (True, KeyboardInterrupt, {"play.html"}),
        (True, SystemExit, {"play.html"}),
        (True, OSError, {"play.html.part"}),
    ],
)
@pytest.mark.filterwarnings("ignore:.*was not written to its end:RuntimeWarning")
def test_only_a_live_source_is_whole_when_it_is_interrupted(
    tmp_path: Path, live: bool, error: type[BaseException] | None, names: set[str]
) -> None:
    options = ["--play", tmp_path / "play.html", *(["--live"] if live else [])]
    with suppress(*(() if error is None else (error,))), sinks_of(tmp_path, *options) as sinks:
        sinks.write(perceived("0.bin", None))
        if error is not None:
            raise error
    assert {file.name for file in tmp_path.iterdir()} == names
