"""Livox' packets of both protocols, and .lvx2 files: what is written is read."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from capture_writers import let_overtake, write_link, write_pcap
from hypothesis import given, settings
from hypothesis import strategies as st
from lidar_writers import T0_S, livox_packets, lvx2_file
from numpy.typing import NDArray
from test_captures import error_of, read_until_error

import twins.packets
from cli_helpers import Shell, run
from edgeperc import Motion, SensorError, accumulate, deskew, read_scans, read_timed_scans, sensor_of
from edgeperc.readers.livox_packets import LivoxStream, fill_points, points_of
from edgeperc.readers.times import TimedScan
from edgeperc.simulation import random_scene, simulate
from edgeperc.simulation.samples import simulated_scan

pytestmark = pytest.mark.usefixtures("in_this_process")

Street = tuple[np.ndarray, np.ndarray]
KINDS = [(1, False), (2, False), (3, False), (0x11, False), (0, True), (1, True), (2, True), (3, True), (4, True)]


def scene(n: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points in whole millimeters, or centimeters; every seventh did not return."""
    points = simulated_scan(3, "vlp-16").points
    xyz = points[np.isfinite(points).all(axis=1), :3].astype(np.float64)
    xyz = np.round(np.resize(xyz, (n, 3)), 2)
    xyz[::7] = 0.0
    return xyz, np.arange(n) % 256


def joined(scans: list[TimedScan]) -> NDArray[np.float32]:
    return np.concatenate([scan.points for scan in scans])


@pytest.mark.parametrize(("kind", "is_old"), KINDS)
def test_what_is_written_is_read(tmp_path: Path, kind: int, is_old: bool) -> None:
    """Coordinates and reflectivity to the bit; angles to the hundredth of a degree that they are sent in."""
    xyz, remission = scene(96 * 500)
    packets = livox_packets(kind, xyz, remission, is_old)
    path = write_pcap(tmp_path / "a.pcap", packets)
    scans = list(read_timed_scans(path))
    used = len(packets) * (100 if is_old and kind < 2 else 96)
    returned = (xyz[:used] != 0.0).any(axis=1)
    points = joined(scans)
    np.testing.assert_array_equal(points[:, 3], remission[:used][returned])
    if (kind, is_old) in ((3, False), (1, True), (3, True)):
        far = np.linalg.norm(xyz[:used][returned], axis=1)
        np.testing.assert_allclose(np.linalg.norm(points[:, :3], axis=1), far, atol=6e-4)
        off = np.linalg.norm(points[:, :3] - xyz[:used][returned], axis=1)
        assert (off <= 1e-3 + far * np.radians(0.01)).all()
    else:
        np.testing.assert_array_equal(points[:, :3], xyz[:used][returned].astype(np.float32))
    assert len(scans) == 3  # of 209 packets, each 0.48 ms
    for k, scan in enumerate(scans):
        assert scan.times_s[0] == pytest.approx(T0_S + 0.00048 * 209 * k, abs=1e-5)
        assert (np.diff(scan.times_s) >= -1e-9).all()
        assert scan.times_s.max() <= scan.stamp_s  # type: ignore[operator]
        assert np.ptp(scan.times_s) < 0.1005
    assert len(list(read_timed_scans(let_overtake(path)))) == 3


@pytest.mark.parametrize("kind", [1, 2, 3])
def test_lvx2_files(tmp_path: Path, kind: int) -> None:
    packets = livox_packets(kind, *scene(96 * 500), False)
    of_capture = list(read_timed_scans(write_pcap(tmp_path / "a.pcap", packets)))
    path = tmp_path / "a.lvx2"
    path.write_bytes(lvx2_file(packets))
    of_file = list(read_timed_scans(path))
    for one, other in zip(of_file, of_capture, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_allclose(one.times_s, other.times_s, atol=1e-6)  # type: ignore[arg-type]
    two = tmp_path / "two.lvx2"
    two.write_bytes(lvx2_file(packets, ("47MDL01", "47MDL02")))
    assert "expected one LiDAR, there are 47MDL01, 47MDL02; choose one" in error_of(two)
    np.testing.assert_array_equal(
        joined(list(read_timed_scans(two, topic="47MDL02"))), joined(list(read_timed_scans(path)))
    )


def test_lvx2_files_that_are_cut_short(tmp_path: Path) -> None:
    path, content = tmp_path / "a.lvx2", lvx2_file(livox_packets(1, *scene(96 * 500), False))
    sizes = ((len(content) - 100, 2, "is not whole"), (200, 0, "is not whole"), (60, 0, "list of its"), (20, 0, "29 b"))
    for size, n, said in sizes:
        path.write_bytes(content[:size])
        scans, error = read_until_error(path)
        assert (len(scans), said in error) == (n, True), error
    path.write_bytes(content[:16] + b"\1" + content[17:])
    assert "an .lvx file of version 1, which is not read; save it as .lvx2" in error_of(path)


def test_a_livox_does_not_spin(tmp_path: Path, shell: Shell) -> None:
    packets = livox_packets(1, *scene(96 * 300), False)
    capture, file = write_pcap(tmp_path / "a.pcap", packets), tmp_path / "a.lvx2"
    file.write_bytes(lvx2_file(packets))
    for path in (capture, file):
        with pytest.raises(SensorError, match="of a Livox sensor, which does not spin"):
            sensor_of(path)
        assert "which does not spin" in (said := shell.err("run", path, code=1))
        assert "--sensor: mid-360, hap, avia" in said or "--sensor mid-360, hap, avia" in said


def test_two_in_one_capture(tmp_path: Path) -> None:
    packets = livox_packets(2, *scene(96 * 100), False)
    path = write_link(tmp_path / "two.pcap", 1, packets, one="192.168.1.112", two="192.168.1.130")
    assert "expected one LiDAR, there are 192.168.1.112, 192.168.1.130" in error_of(path)
    assert (
        sum(len(points) for _, points in read_scans(path, topic="192.168.1.112")) == (scene(9600)[0] != 0).any(1).sum()
    )


@settings(max_examples=100)
@given(st.binary(max_size=400), st.sampled_from([(13, 4), (14, 4), (8, 2), (9, 3), (10, 3)]))
def test_the_kernel_as_its_slow_twin(content: bytes, layout: tuple[int, int]) -> None:
    stride, kind = layout
    n = len(content) // stride
    points, which = np.full((n, 4), 7.0, np.float32), np.full(n, -1)
    found = fill_points(np.frombuffer(content, np.uint8), stride, kind, points, which)
    wanted, numbers = twins.packets.livox_points(content, stride, kind)
    assert found == len(wanted)
    np.testing.assert_allclose(points[:found], wanted, rtol=1e-6, atol=1e-4)
    np.testing.assert_array_equal(which[:found], numbers)
    assert (points[found:] == 7.0).all()


@cache
def one_packet(kind: int, is_old: bool) -> bytes:
    return livox_packets(kind, *scene(200), is_old)[0]


@settings(max_examples=100)
@given(st.lists(st.tuples(st.sampled_from(KINDS), st.integers(0, 60), st.binary(max_size=4)), max_size=8))
def test_packets_of_any_bytes(damages: list[tuple[tuple[int, bool], int, bytes]]) -> None:
    stream, scans, n = LivoxStream(), list[TimedScan](), 0
    for (kind, is_old), at, content in damages:
        packet = one_packet(kind, is_old)
        damaged = packet[:at] + content + packet[at + len(content) :]
        points = points_of(memoryview(damaged))
        assert points_of(memoryview(damaged[:-1])) is None
        if points is not None:
            n += len(points.content) // points.kind.stride
            scans += stream.add(points)
    scans += stream.end()
    assert sum(len(scan.points) for scan in scans) <= n
    for scan in scans:
        assert np.isfinite(scan.points).all()
        assert np.isfinite(scan.times_s).all()


def test_the_hour_of_a_gps() -> None:
    packet = bytearray(livox_packets(2, *scene(96), True)[0])
    packet[8], packet[10:18] = 3, bytes((25, 6, 15, 15)) + (400_000_000).to_bytes(4, "little")
    assert points_of(memoryview(packet)).time_s == pytest.approx(T0_S, abs=1e-6)


@pytest.fixture(scope="module")
def street() -> Street:
    """Points of a Mid-360 in a street, 0.3 s of packets."""
    points = np.resize(simulate(random_scene(2), "mid-360", 0, duration_s=1.0).points, (96 * 625, 4))
    return points[:, :3].astype(np.float64), np.rint(255.0 * points[:, 3]).astype(np.int64)


@pytest.mark.compiled
@pytest.mark.filterwarnings("default::UserWarning")
@pytest.mark.parametrize(
    ("name", "options", "gathered_s"), [("a.pcap", [], 0.2), ("a.lvx2", ["--accumulate", 0.1], 0.1)]
)
def test_a_capture_without_turns_is_run_gathered(
    tmp_path: Path, shell: Shell, street: Street, name: str, options: list[object], gathered_s: float
) -> None:
    pytest.importorskip("onnxruntime")
    packets, path = livox_packets(1, *street, False), tmp_path / name
    path = write_pcap(path, packets) if name.endswith("pcap") else path
    if name.endswith("lvx2"):
        path.write_bytes(lvx2_file(packets))
    given = ["--sensor", "mid-360", "--mount-height", 1.73, "--roll", 0, "--pitch", 0, "--json", *options]
    said = shell.both("run", path, *given)
    answers = [json.loads(line) for line in said.out.splitlines()]
    assert f"the points of the last {gathered_s:g} s are taken as seen from one place" in said.err
    expected = list(read_scans(path, accumulate_s=gathered_s))
    assert [answer["n_points"] for answer in answers] == [len(points) for _, points in expected]
    assert [answer["stamp_s"] for answer in answers] == [stamp_s for stamp_s, _ in expected]
    assert len(expected) >= 2
    assert np.mean([len(points) for _, points in expected]) > 0.9 * gathered_s * 200_000
    assert any(answer["boxes"] for answer in answers)
    answers = shell.records("run", tmp_path, "--live", *given)
    assert {answer["n_points"] for answer in answers} <= {len(points) for _, points in expected}


def test_gathered_captures_are_straightened_by_poses(tmp_path: Path, street: Street) -> None:
    """The house's own way: the times of the points go with them, for `deskew` and ``--deskew``."""
    path = write_pcap(tmp_path / "a.pcap", livox_packets(1, *street, False))
    motion = Motion((10.0, 0.0, 0.0))
    own, options = list(accumulate(read_timed_scans(path), 0.2, motion)), {"accumulate_s": 0.2}
    for straight, (_, points, times_s) in zip(own, read_timed_scans(path, **options), strict=True):  # type: ignore[arg-type]
        np.testing.assert_array_equal(straight.points, deskew(points, times_s, motion))
        assert np.abs(straight.points - points).max() == pytest.approx(10.0 * np.ptp(times_s), abs=0.01)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--sensor", "vlp-16", "--accumulate", "0.2"], "sensor 'vlp-16' spins: each of its turns is a scan"),
        (["--sensor", "mid-360", "--accumulate", "20"], "expected a number from 0.01 to 10"),
        (["--sensor", "hap", "--accumulate", "0.001"], "expected a number from 0.01 to 10"),
    ],
)
def test_what_is_not_gathered(tmp_path: Path, shell: Shell, options: list[str], said: str) -> None:
    path = write_pcap(tmp_path / "a.pcap", livox_packets(1, *scene(96 * 300), False))
    assert said in shell.err("run", path, *options)


@pytest.mark.parametrize("options", [[], ["--sensor", "auto"], ["--sensor", "auto", "--live"]])
def test_gathering_needs_the_name_of_the_sensor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    path = write_pcap(tmp_path / "a.pcap", livox_packets(1, *scene(96 * 300), False))
    with pytest.raises(SystemExit, match="2"):
        run("run", path, "--accumulate", "0.2", *options)
    assert "--accumulate needs --sensor with the name of one that does not spin" in capsys.readouterr().err
