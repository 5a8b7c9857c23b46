"""Times of points from captures and scan files: of a sensor that moves in a room, whose walls become straight."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from capture_writers import ouster_frame, ouster_info, write_clouds, write_ouster, write_pcap
from hypothesis import given
from hypothesis import strategies as st
from lidar_writers import T0_S, livox_packets
from numpy.typing import NDArray
from test_files import npy, pcd_of, ply_of, save
from test_motion import write_tum

import edgeperc
import twins.motion
from cli_helpers import Shell, run
from edgeperc import Motion, TimedScan, Tracker, Trajectory, accumulate, deskew, read_timed_scans
from edgeperc.cli.straighten import Straightener
from edgeperc.errors import OptionError, PointsError, StampError
from edgeperc.readers.times import of_plausible_duration, point_times, time_name

pytestmark = pytest.mark.usefixtures("in_this_process")

MOTION = Motion((18.0, 0.5, 0.0), (0.02, -0.03, 0.6))
HALF_X_M, HALF_Y_M = 20.0, 15.0


def seen_from(times: NDArray[np.float64], at_s: float, directions: NDArray[np.float64], offsets: Any = 0.0) -> Any:
    """Ranges (n,) at which rays of a moving sensor meet the walls of the room; the sensor's frame at ``at_s`` is the
    room's. ``directions`` (n, 3) and the rays' origins ``offsets`` are in the sensor's frame at the time of each."""
    screw = twins.motion.screw(MOTION.velocity_mps, MOTION.rate_radps)
    moments, inverse = np.unique(times, return_inverse=True)
    poses = twins.motion.exponential(screw * (moments - at_s)[:, None, None])[inverse.ravel()]
    way = np.einsum("nij,nj->ni", poses[:, :3, :3], directions)
    start = np.einsum("nij,nj->ni", poses[:, :3, :3], np.broadcast_to(offsets, directions.shape)) + poses[:, :3, 3]
    with np.errstate(divide="ignore"):
        to_x = (np.sign(way[:, 0]) * HALF_X_M - start[:, 0]) / way[:, 0]
        to_y = (np.sign(way[:, 1]) * HALF_Y_M - start[:, 1]) / way[:, 1]
    return np.fmin(to_x, to_y)


def off_the_walls(points: NDArray[Any]) -> float:
    """Largest distance of a point from its wall [m]."""
    x, y = np.abs(points[:, 0]), np.abs(points[:, 1])
    return float(np.minimum(np.abs(x - HALF_X_M), np.abs(y - HALF_Y_M)).max())


def turn(at_s: float, n: int = 900) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A turn of 0.1 s that ends at ``at_s``: points (n, 4) in the sensor's frame at their times (n,)."""
    times = at_s + np.linspace(-0.1, 0.0, n)
    angle = np.linspace(math.pi, -math.pi, n, endpoint=False)
    directions = np.column_stack([np.cos(angle), np.sin(angle), 0.05 * np.cos(5 * angle)])
    return np.column_stack([directions * seen_from(times, at_s, directions)[:, None], np.full(n, 0.5)]), times


def check_straight(found: edgeperc.TimedScan, at_s: float, tolerance_m: float) -> None:
    assert found.times_s.shape == (len(found.points),)
    assert found.times_s.dtype == np.float64
    assert off_the_walls(found.points) > 0.7
    assert off_the_walls(deskew(found.points, found.times_s, MOTION, at_s=at_s)) < tolerance_m


@given(
    st.sampled_from([1.0, 1e-3, 1e-6, 1e-9]),
    st.floats(0.0021, 1.9),
    st.sampled_from([0.0, 40.0, 1.7e9]),
    st.sampled_from([None, 123.5]),
)
def test_the_duration_shows_the_unit(unit: float, duration_s: float, start_s: float, stamp_s: float | None) -> None:
    times = start_s + np.linspace(0.0, duration_s, 50)
    points = np.ones((50, 4), np.float32)
    found = point_times({"t": times / unit}, points, stamp_s)
    np.testing.assert_allclose(found, times if start_s else times + (stamp_s or 0.0), rtol=1e-12, atol=1e-6)


def test_points_without_return_do_not_hide_the_unit() -> None:
    points = np.ones((6, 4), np.float32)
    points[0, :3], points[1, 0] = 0.0, np.nan
    times = np.array([0.0, 7.0, 1.7e9, 1.7e9 + 0.05, 1.7e9 + 0.1, np.nan])
    found = point_times({"timestamp": times}, points, 5.0)
    np.testing.assert_array_equal(found, [np.nan, np.nan, *times[2:]])  # nor do they begin the scan in 1970


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"ring": np.arange(5)},
        {"t": np.zeros(5)},
        {"time": np.full(5, np.nan)},
        {"time": np.array([0, 0, 0, 0, 1e-12])},
        {"timestamp": np.full(5, 1.7e9, np.float32)},
        {"t": np.array([0, 1, 2, 3, 3e12])},
    ],
)
def test_fields_that_are_no_times_give_none(fields: dict[str, NDArray[Any]]) -> None:
    assert point_times(fields, np.ones((5, 4), np.float32), 1.0) is None
    assert point_times({name: values[:0] for name, values in fields.items()}, np.ones((0, 4), np.float32), 1.0) is None


@pytest.mark.parametrize(
    ("damage", "places"),
    [(3_604_361_924, [17]), (1_904_361_924, [0]), (4_294_967_295, [5, 99, 1999]), (2**32 - 7, [*range(19)])],
)
@pytest.mark.parametrize("start", [0, 1_700_000_000])
def test_a_damaged_time_costs_its_point_alone(damage: int, places: list[int], start: int) -> None:
    nanoseconds = np.linspace(start, start + 1e8, 2000).astype("u4")
    nanoseconds[places] = damage
    times = point_times({"t": nanoseconds}, np.ones((2000, 4), np.float32), 50.0)
    assert np.nonzero(np.isnan(times))[0].tolist() == places
    rest = ~np.isnan(times)
    expected = np.linspace(start, start + 1e8, 2000) * 1e-9 + 50.0
    np.testing.assert_allclose(times[rest], expected[rest], atol=1e-6)


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("clock_s", [1.0, 60.0, 3600.0, 86400.0, 604800.0])
@pytest.mark.parametrize(("before_s", "duration_s"), [(0.05, 0.1), (0.01, 0.1), (0.095, 0.1), (0.03, 0.05)])
def test_a_clock_that_begins_anew_goes_on(unit: float, clock_s: float, before_s: float, duration_s: float) -> None:
    went = np.linspace(0.0, duration_s, 2000)
    times = point_times({"t": (clock_s - before_s + went) % clock_s / unit}, np.ones((2000, 4), np.float32), None)
    np.testing.assert_allclose(times, clock_s - before_s + went, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-6, 1e-9])
@pytest.mark.parametrize("first_us", [0, -40_000, -50_000, -90_000])
def test_a_counter_of_32_bits_that_overflows_goes_on(unit: float, first_us: int) -> None:
    """Also times from the end of a scan, which are negative, in a field that holds none."""
    counts = (first_us + np.linspace(0, 1e5, 3000).astype(np.int64)) * round(1e-6 / unit)
    times = point_times({"offset_time": counts.astype(np.uint32)}, np.ones((3000, 4), np.float32), None)
    np.testing.assert_allclose(times - times[0], np.linspace(0.0, 0.1, 3000), atol=2e-6)


@pytest.mark.parametrize("value", [0.0, -1.0, 2.0**63])
@pytest.mark.parametrize("share", [0.03, 0.5, 0.9])
def test_a_value_that_stands_for_no_time_costs_its_points_alone(value: float, share: float) -> None:
    times = 1.7e9 + np.linspace(0.0, 0.1, 4000)
    lack = np.random.default_rng(4).random(4000) < share
    found = point_times({"timestamp": np.where(lack, value, times)}, np.ones((4000, 4), np.float32), 5.0)
    np.testing.assert_allclose(np.nan_to_num(found), np.where(lack, 0.0, times), rtol=0, atol=1e-6)


def test_two_instants_are_both_kept() -> None:
    """Two sensors that see all at once: neither stands for no time."""
    times = np.repeat([0.0, 0.05], 500)
    np.testing.assert_array_equal(point_times({"t": times}, np.ones((1000, 4), np.float32), None), times)


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
def test_times_that_are_not_finite_cost_their_points_alone(bad: float) -> None:
    times = np.linspace(0.0, 0.1, 1000)
    times[::90] = bad
    found = point_times({"t": times}, np.ones((1000, 4), np.float32), 7.0)
    np.testing.assert_array_equal(found, np.where(np.isfinite(times), times + 7.0, np.nan))


@pytest.mark.parametrize("count", [10.0, 0.1, 4e3, 1.5e4])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_times_that_contradict_the_turn_are_refused(count: float, direction: float) -> None:
    """Shares of a turn and odd units: the azimuth turns once in 1 s, 10 ms, 0.4 s and 1.5 s."""
    angle = direction * np.linspace(0.0, 2 * np.pi, 5000)
    points = np.column_stack([9 * np.cos(angle), 9 * np.sin(angle), 0 * angle, 0 * angle]).astype(np.float32)
    turn_s = np.linspace(0.0, 0.1, 5000)
    assert point_times({"t": turn_s}, points, None) is not None
    with pytest.raises(PointsError, match=r"by the field 't', a turn of the sensor takes .* in another unit"):
        point_times({"t": turn_s * count}, points, None)
    # A sensor that does not turn may take any time.
    still = np.random.default_rng(3).permutation(points)
    assert point_times({"t": turn_s * 10.0}, still, None) is not None


@pytest.mark.parametrize(("duration_s", "interval_s"), [(1.0, 0.1), (0.2, 0.1), (0.19, 0.05), (1.9, 1.0)])
def test_scans_that_last_longer_than_their_interval_are_refused(duration_s: float, interval_s: float) -> None:
    def scans(duration_s: float, stamps_s: Iterable[float]) -> Iterator[edgeperc.TimedScan]:
        for stamp_s in stamps_s:
            times = stamp_s + np.array([0.0, np.nan, duration_s])
            yield edgeperc.TimedScan(stamp_s, np.ones((3, 4), np.float32), times)

    stamps_s = [50.0 + interval_s * k for k in range(6)]
    with pytest.raises(PointsError, match=r"span .* s, and a scan comes every .* s: the times are in another unit"):
        list(of_plausible_duration(scans(duration_s, stamps_s)))
    assert len(list(of_plausible_duration(scans(interval_s, stamps_s)))) == 6
    late = [*stamps_s[:3], stamps_s[3] - 0.9 * interval_s, *stamps_s[4:], 49.0]  # one message early, a clock set back
    assert len(list(of_plausible_duration(scans(interval_s, late)))) == 7
    nothing = [edgeperc.TimedScan(s, np.empty((0, 4), np.float32), np.empty(0)) for s in stamps_s]  # a covered sensor
    assert list(of_plausible_duration(nothing)) == nothing


def test_the_best_known_field_counts() -> None:
    assert time_name(["x", "time_offset", "timestamp", "t"]) == "t"
    assert time_name(["x", "ring"]) is None


TABLE = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")]


def table(times: NDArray[Any], points: NDArray[np.float64], name: str, kind: str) -> NDArray[Any]:
    rows = np.zeros(len(points), [*TABLE, (name, kind)])
    for k, (axis, _) in enumerate(TABLE):
        rows[axis] = points[:, k]
    rows[name] = times
    return rows


@pytest.mark.parametrize(
    ("name", "kind", "count", "end_s"),
    [
        ("t", "<u4", 1e9, 0.1),
        ("time", "<f4", 1.0, 0.1),
        ("timestamp", "<f8", 1.0, 1700.1),
        ("Time", "<f8", 1e3, 0.1),
    ],
)
@pytest.mark.parametrize("suffix", ["ascii.pcd", "binary.pcd", "ply", "npy"])
def test_scan_files(tmp_path: Path, name: str, kind: str, count: float, end_s: float, suffix: str) -> None:
    points, times = turn(end_s)
    rows = table(np.round(times * count, 6), points, name, kind)
    content = {
        "npy": npy(rows), "ply": ply_of(rows), "ascii.pcd": pcd_of(rows, "ascii"), "binary.pcd": pcd_of(rows)
    }  # fmt: skip
    path = save(tmp_path, f"scan.{suffix}", content[suffix])
    (found,) = list(read_timed_scans(path))
    assert found.stamp_s == pytest.approx(end_s if end_s > 2.0 else None)
    np.testing.assert_array_equal(found.points, points.astype(np.float32))
    np.testing.assert_array_equal(edgeperc.read_points(path), found.points)
    np.testing.assert_allclose(found.times_s, times, atol=1e-6)
    check_straight(found, end_s, 1e-3)


def test_files_without_times(tmp_path: Path) -> None:
    points = turn(0.1)[0].astype(np.float32)
    points.tofile(tmp_path / "a.bin")
    np.save(tmp_path / "b.npy", points)
    save(tmp_path, "c.pcd", pcd_of(table(np.zeros(len(points)), points.astype(float), "ring", "<u4")))
    scans = list(read_timed_scans(tmp_path))
    assert [scan.times_s for scan in scans] == [None] * 3
    for scan in scans:
        np.testing.assert_array_equal(scan.points, points)


@pytest.mark.parametrize(
    ("name", "kind", "stored"),
    [
        ("t", "<u4", lambda times, stamp_s: np.round((times - stamp_s) * 1e9)),
        ("time", "<f4", lambda times, stamp_s: times - stamp_s),
        ("timestamp", "<f8", lambda times, stamp_s: times),
        ("timestamp", "<f8", lambda times, stamp_s: times * 1e9),
        ("offset_time", "<u4", lambda times, stamp_s: np.round((times - stamp_s) * 1e9)),
    ],
    ids=["ouster", "velodyne", "hesai", "livox", "livox offsets"],
)
def test_bags(tmp_path: Path, name: str, kind: str, stored: Callable[[Any, float], Any]) -> None:
    """The stamp is that of the scan's beginning, as drivers set it."""
    ends = [1700.0, 1700.1]
    turns = [turn(end) for end in ends]
    stamps = [float(times[0]) for _, times in turns]
    path = write_clouds(
        tmp_path / "drive.bag",
        [(s, table(stored(times, s), points, name, kind)) for s, (points, times) in zip(stamps, turns, strict=True)],
    )
    found = list(read_timed_scans(path))
    assert [scan.stamp_s for scan in found] == pytest.approx(stamps)
    for scan, end, (_, times) in zip(found, ends, turns, strict=True):
        np.testing.assert_allclose(scan.times_s, times, atol=1e-6)
        check_straight(scan, end, 1e-3)
    for timed, (stamp_s, points) in zip(found, edgeperc.read_scans(path), strict=True):
        assert stamp_s == timed.stamp_s
        np.testing.assert_array_equal(points, timed.points)


VLP16_FIRING_S, VLP16_LASER_S, VLP16_START_S = 55.296e-6, 2.304e-6, 1.0
VLP16_DEG = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])


def moving_vlp16(at_s: float, n_packets: int = 75) -> list[bytes]:
    """Packets of a VLP-16 that moves in the room: a turn of 0.0995 s and 10 Hz."""
    packets = []
    for k in range(n_packets):
        stamp_us = round(1e6 * VLP16_START_S) + 1327 * k
        block, firing, laser = np.meshgrid(np.arange(12), np.arange(2), np.arange(16), indexing="ij")
        since_s = (2 * block + firing) * VLP16_FIRING_S + laser * VLP16_LASER_S
        times = stamp_us * 1e-6 + since_s
        azimuth = np.radians(-(12 * k * 0.4 + since_s / VLP16_FIRING_S * 0.2))
        elevation = np.radians(VLP16_DEG[laser])
        directions = np.stack(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1
        )
        ranges = seen_from(times.ravel(), at_s, directions.reshape(-1, 3)).reshape(12, 32)
        body = b""
        for b in range(12):
            body += b"\xff\xee" + struct.pack("<H", (12 * k + b) * 40 % 36000)
            body += b"".join(struct.pack("<HB", round(r / 0.002), 77) for r in ranges[b])
        packets.append(body + struct.pack("<IBB", stamp_us, 0x37, 0x22))
    return packets


def test_a_velodyne_that_moves(tmp_path: Path) -> None:
    at_s = VLP16_START_S + 0.05
    scans = list(read_timed_scans(write_pcap(tmp_path / "vlp16.pcap", moving_vlp16(at_s))))
    first = scans[0]
    assert first.stamp_s == pytest.approx(VLP16_START_S + 0.0995, abs=0.002)
    assert first.times_s[0] == pytest.approx(VLP16_START_S, abs=1e-5)
    assert first.times_s[-1] == pytest.approx(first.stamp_s, abs=0.002)
    check_straight(first, at_s, 0.1)  # the lasers sit some centimeters off the origin


@pytest.mark.compiled
@pytest.mark.parametrize("name", ["room.pcap", "room.osf"])
def test_an_ouster_that_moves(tmp_path: Path, name: str) -> None:
    info = ouster_info()
    frame = ouster_frame(info)
    lut = pytest.importorskip("ouster.sdk.core").XYZLut(info, False)
    near, far = (lut(np.full((64, 512), mm, np.uint32)).reshape(-1, 3) for mm in (10_000, 20_000))
    at_s = 5.05
    times = np.broadcast_to(frame.timestamp * 1e-9, (64, 512)).ravel()
    # At range r [mm] a point lies at near + (r - 10,000) * step.
    step = (far - near) / 10_000
    ranges = seen_from(times, at_s, step, near - 10_000 * step)
    frame.field("RANGE")[:] = np.round(ranges).reshape(64, 512)
    frame.field("RANGE")[:, 1::7] = 0
    (found,) = list(read_timed_scans(write_ouster(tmp_path / name, info, [frame])))
    assert found.stamp_s == found.times_s.max()
    assert len(found.points) == 64 * (512 - 73)
    check_straight(found, at_s, 0.01)


def drive(path: Path, ends: Sequence[float], name: str = "time") -> Path:
    """A bag of turns that end then, of the sensor that moves in one room; the stamps are those of the ends."""
    scans = []
    for end in ends:
        points, times = turn(end)
        scans.append((end, table(times - end, points, name, "<f4")))
    return write_clouds(path, scans)


def pose_at(t: float) -> NDArray[np.float64]:
    return twins.motion.exponential(twins.motion.screw(MOTION.velocity_mps, MOTION.rate_radps) * t)


def test_scans_are_straightened_by_poses(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.bag", [1700.0, 1700.1])
    times = 1699.5 + 0.1 * np.arange(10)
    poses = write_tum(tmp_path / "poses.txt", times, [pose_at(t - 1699.5) for t in times])
    straightener = Straightener(Trajectory.from_tum(poses), deskews=True)
    for scan in read_timed_scans(path):
        assert off_the_walls(straightener.straighten(*scan)) < 1e-3
    write_tum(poses, times + 5.0, [pose_at(t) for t in 0.1 * np.arange(10)])
    with pytest.raises(edgeperc.StampError, match="poses around it"):
        Straightener(Trajectory.from_tum(poses), deskews=True).straighten(*scan)
    straightener = Straightener(true_trajectory(), deskews=True)
    for stamp_s in (None, 0.2):  # a file with times from 0 may be on a clock that begins there; two are not
        straightener.straighten(stamp_s, scan.points, scan.times_s - scan.times_s[0])
    with pytest.raises(edgeperc.StampError, match="begin anew with each scan"):
        straightener.straighten(None, scan.points, scan.times_s - scan.times_s[0] + 0.001)


@pytest.mark.compiled
def test_scans_are_straightened_by_the_tracks_before(tmp_path: Path) -> None:
    """The tracker knows the motion from the second scan on."""
    straightener, straight = Straightener(None, deskews=True), []
    for k, scan in enumerate(read_timed_scans(drive(tmp_path / "drive.bag", [1700.0, 1700.1, 1700.2, 1700.3]))):
        if k == 0:
            with pytest.warns(UserWarning, match="first two scans stay"):
                points = straightener.straighten(*scan)
        else:
            points = straightener.straighten(*scan)
        straight.append(off_the_walls(points) < 1e-3)
        straightener.follow(tracks_at(scan.stamp_s, pose_at(0.1 * k)))
    assert straight == [False, False, True, True]


@pytest.mark.parametrize("stamp_s", [1699.9999, 1700.0, 1700.1003, 5.0])
def test_scans_are_straight_at_their_stamps(stamp_s: float) -> None:
    """Those of drivers are rounded and their first beams dropped: such scans were a turn's motion off, now and then."""
    points, times = turn(1700.1)
    motion = Motion.between(pose_at(0.0), 0.0, pose_at(0.1), 0.1)
    straightener = Straightener(None, deskews=True)
    for k in range(2):
        straightener.follow(tracks_at(0.1 * k, pose_at(0.1 * k)))
    wanted = deskew(points, times, motion, at_s=float(times.max()) if stamp_s == 5.0 else stamp_s)
    np.testing.assert_array_equal(straightener.straighten(stamp_s, points, times), wanted)


def tracks_at(stamp_s: float | None, pose: NDArray[np.float64], session: int = 0, *, is_late: bool = False) -> Any:
    return SimpleNamespace(T_world_sensor=pose, stamp_s=stamp_s, session=session, is_late=is_late)


@pytest.mark.compiled
@pytest.mark.filterwarnings("ignore:--deskew")
def test_late_scans_and_those_of_another_session_give_no_motion(tmp_path: Path) -> None:
    (scan,) = read_timed_scans(drive(tmp_path / "drive.bag", [1700.2]))
    first, second = tracks_at(1700.0, pose_at(0.0)), tracks_at(1700.1, pose_at(0.1))
    late, wrong = tracks_at(1700.0, np.eye(4), is_late=True), tracks_at(1e9, np.eye(4), 1)
    for followed, is_straight in (
        ([first, second], True),
        ([first, late, second, late], True),
        ([first, wrong], False),
        ([first, second, wrong], False),
        ([first, wrong, second], False),
        ([first, second, wrong, first, second], True),
    ):
        straightener = Straightener(None, deskews=True)
        for tracks in followed:
            straightener.follow(tracks)
        assert (off_the_walls(straightener.straighten(*scan)) < 1e-3) == is_straight


def test_scans_without_times_are_not_straightened() -> None:
    with pytest.raises(edgeperc.PointsError, match=r"the scan has no times of points: .* leave out --deskew"):
        Straightener(None, deskews=True).straighten(1.0, np.zeros((8, 4), np.float32), None)
    points = np.zeros((8, 4), np.float32)
    assert Straightener(None, deskews=True).straighten(1.0, points, np.full(8, np.nan)) is points


def test_a_scan_that_the_poses_do_not_cover_fails_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others are tracked by the poses: what stands was said to drive, at the error of the tracker's estimate."""
    pytest.importorskip("onnxruntime")
    path = drive(tmp_path / "drive.bag", [1700.0, 1800.0, 1700.2])
    times = 1699.5 + 0.1 * np.arange(10)
    write_tum(tmp_path / "poses.txt", times, [pose_at(t - 1699.5) for t in times])
    options = ["--sensor", "hdl-64e", "--on-mismatch", "ignore", "--model", "pointseg", "--json", "--track"]
    update, poses = Tracker.update, list[Any]()

    def recorded(tracker: Tracker, boxes: Any, stamp_s: float, pose: Any = None, **how: Any) -> Any:
        poses.append(pose)
        return update(tracker, boxes, stamp_s, pose, **how)

    monkeypatch.setattr(Tracker, "update", recorded)
    assert run("run", path, "--deskew", "--poses", tmp_path / "poses.txt", *options) == 1
    np.testing.assert_allclose(poses[-2:], [np.eye(4), np.linalg.inv(pose_at(0.5)) @ pose_at(0.7)], atol=1e-6)
    answers = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert ["error" in answer for answer in answers] == [False, False, True]  # the bag's messages come by time


@pytest.mark.filterwarnings("default:--deskew")
@pytest.mark.parametrize("by", ["--poses", "--track"])
def test_run_with_deskew(by: str, tmp_path: Path, shell: Shell) -> None:
    pytest.importorskip("onnxruntime")
    path = drive(tmp_path / "drive.bag", [1700.0, 1700.1, 1700.2])
    times = 1699.5 + 0.1 * np.arange(10)
    write_tum(tmp_path / "poses.txt", times, [pose_at(t - 1699.5) for t in times])
    options = ["--poses", tmp_path / "poses.txt"] if by == "--poses" else ["--track"]
    options += ["--model", "pointseg", "--sensor", "hdl-64e", "--on-mismatch", "ignore"]
    options += ["--ply", "--out", tmp_path / "out"]
    assert ("first two scans" in shell.err("run", path, "--deskew", *options, code=0)) == (by == "--track")
    off = [off_the_walls(edgeperc.read_points(file)) for file in sorted((tmp_path / "out").rglob("*.ply"))]
    assert len(off) == 3
    if by == "--poses":
        assert max(off) < 1e-3


def parts_of(n: int, part_s: float = 0.1, k: int = 300) -> list[TimedScan]:
    """Parts of what a moving sensor sees of the room, which is the frame of the last point."""
    times = np.linspace(0.0, n * part_s, n * k, endpoint=False)
    angle = 61.0 * times
    directions = np.column_stack([np.cos(angle), np.sin(angle), 0.05 * np.cos(5 * angle)])
    ranges = seen_from(times, float(times[-1]), directions)
    points = np.column_stack([directions * ranges[:, None], np.full(len(times), 0.5)]).astype(np.float32)
    parts = zip(np.split(points, n), np.split(times, n), strict=True)
    return [TimedScan(float(moments[-1]), some, moments) for some, moments in parts]


def true_trajectory() -> Trajectory:
    times = np.linspace(-0.1, 1.1, 13)
    return Trajectory(times, np.array([pose_at(t) for t in times]))


@pytest.mark.parametrize("motion", [MOTION, true_trajectory()], ids=["motion", "trajectory"])
@pytest.mark.parametrize("accumulate_s", [0.2, 0.5, 1.0])
def test_gathered_scans_of_a_sensor_that_moves_are_straight(motion: Any, accumulate_s: float) -> None:
    parts = parts_of(10)
    *_, last = accumulate(parts, accumulate_s, motion)
    assert last.stamp_s == parts[-1].stamp_s
    assert len(last.points) == pytest.approx(3000 * accumulate_s, abs=1)
    assert off_the_walls(last.points) < 2e-3
    *_, bent = accumulate(parts, accumulate_s)
    assert off_the_walls(bent.points) > 10.0 * accumulate_s


@pytest.mark.compiled
@pytest.mark.filterwarnings("default::UserWarning")
def test_a_livox_that_moves_is_run_straight(tmp_path: Path, shell: Shell) -> None:
    """Packets of 0.3 s in the room, gathered and straightened by poses."""
    pytest.importorskip("onnxruntime")
    times = T0_S + np.arange(96 * 625) / 200_000.0
    angle = 211.0 * (times - T0_S)
    directions = np.column_stack([np.cos(angle), np.sin(angle), 0.3 * np.sin(5.3 * angle)])
    points = directions * seen_from(times, float(times[-1]), directions)[:, None]
    path = write_pcap(tmp_path / "a.pcap", livox_packets(1, points, np.full(len(points), 99), False))
    ends = times[-1] + np.linspace(-0.5, 0.1, 13)
    write_tum(tmp_path / "poses.txt", ends, [pose_at(t - times[-1]) for t in ends])
    given = ["--sensor", "mid-360", "--accumulate", 0.2, "--on-mismatch", "ignore", "--model", "pointseg"]
    out = ["--deskew", "--poses", tmp_path / "poses.txt", "--ply", "--out", tmp_path / "out"]
    assert "seen from one place" not in shell.err("run", path, *given, *out, code=0)
    last = edgeperc.read_points(sorted((tmp_path / "out").rglob("*.ply"))[-1])
    assert len(last) == pytest.approx(40_000, rel=0.06)
    assert off_the_walls(last) < 0.02


@given(
    gaps_s=st.lists(st.floats(0.01, 0.5), min_size=1, max_size=12),
    counts=st.lists(st.integers(0, 6), min_size=12, max_size=12),
    accumulate_s=st.floats(0.05, 1.0),
    is_timed=st.booleans(),
)
def test_gathered_scans_have_the_points_of_that_time(
    gaps_s: list[float], counts: list[int], accumulate_s: float, is_timed: bool
) -> None:
    stamps = np.cumsum(gaps_s).tolist()
    scans, every = [], np.empty((0, 2))
    for k, (stamp_s, n) in enumerate(zip(stamps, counts, strict=False)):
        times = np.full(n, stamp_s)
        scans.append(TimedScan(stamp_s, np.full((n, 4), k, np.float32), times if is_timed else None))
        every = np.vstack([every, np.column_stack([times, np.full(n, k)])])
    buffer = np.empty((6, 4), np.float32)  # of a driver that fills it again and again
    delivered = (scan._replace(points=np.positive(scan.points, buffer[: len(scan.points)])) for scan in scans)
    found = list(accumulate(delivered, accumulate_s))
    assert bool(found) == bool(sum(counts[: len(stamps)]))
    for scan in found:
        expected = every[(every[:, 0] <= scan.stamp_s) & (every[:, 0] > scan.stamp_s - accumulate_s)]
        np.testing.assert_array_equal(np.column_stack([scan.times_s, scan.points[:, 0]]), expected)
        assert len(expected) > 0


def test_gathering_begins_anew_after_a_step_back_of_the_clock() -> None:
    def scan(stamp_s: float) -> TimedScan:
        return TimedScan(stamp_s, np.full((1, 2), stamp_s, [(axis, "f4") for axis in "xyz"]), None)  # of rows of points

    found = [points[::2, 0].tolist() for _, points, _ in accumulate(map(scan, (8.0, 8.5, 1.0, 1.5, 2.0)), 1.0)]
    assert found == [[1.5, 2.0]]  # 1 s old is too old
    found = [points[::2, 0].tolist() for _, points, _ in accumulate(map(scan, (8.0, 8.5, 8.75)), 5.0)]
    assert found == [[8.0, 8.5, 8.75]]  # shorter than the time: all at the end
    damaged = TimedScan(8.0, np.full((6, 4), 8.0, np.float32), np.array([8.0, np.inf, -np.inf] * 2))
    found = [points[::2, 0].tolist() for _, points, _ in accumulate([damaged, scan(8.5), scan(8.9375)], 1.0)]
    assert found == [[8.0, 8.0, 8.0, 8.5, 8.9375]]


def test_what_cannot_be_gathered() -> None:
    scan = TimedScan(None, np.ones((3, 4), np.float32), None)
    for stamp_s in (None, math.nan):  # it would be left out, and all of such a source
        with pytest.raises(StampError, match=rf"neither times of its points nor a stamp \({stamp_s}\)"):
            next(accumulate([scan._replace(stamp_s=stamp_s)], np.float32(0.5)))
    for wrong in (TimedScan(0.0, np.ones((3, 4), np.float32), np.zeros(2)), (0.0, np.ones((3, 4), np.float32))):
        with pytest.raises(PointsError, match=r"one value a point|expected each scan as edgeperc.TimedScan"):
            next(accumulate([wrong], 0.5))  # type: ignore[list-item]
    for value in (0.0, -1.0, 11.0, math.nan, "1", True):
        with pytest.raises(OptionError, match=r"accumulate_s is .*expected a number from 0.01 to 10"):
            next(accumulate([scan], value))  # type: ignore[arg-type]
    for motion in ((1.0, 0.0, 0.0), np.eye(4), "poses.txt"):
        with pytest.raises(OptionError, match=r"(?s)motion is .*expected a Motion, a Trajectory or None"):
            next(accumulate([scan], 0.5, motion))  # type: ignore[arg-type]
    for unit, holds in ((1.7e18, "got times of 1.7e\\+18 s"), (np.float32(1.7e9), "float32 holds to 1.3e\\+02 s")):
        with pytest.raises(StampError, match=f"{holds}.*expected float64"):  # of all scans, none is 0.1 s later
            next(accumulate([TimedScan(None, np.ones((1, 4), np.float32), np.full(1, unit))] * 2, 0.1))
    with pytest.raises(StampError, match="begin anew with each scan"):
        list(accumulate([TimedScan(None, np.ones((2, 4), np.float32), np.array([k, 0.1])) for k in (0.0, 0.01)], 0.1))
    with pytest.raises(StampError, match="expected poses around it"):
        next(accumulate([TimedScan(7.0, np.ones((3, 4), np.float32), None)], 0.5, true_trajectory()))
    assert list(accumulate([TimedScan(0.0, np.ones((2, 4), np.float32), np.full(2, np.nan))], 0.5)) == []
