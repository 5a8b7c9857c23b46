"""Motion during a scan and scans of several sensors: kernels against their twins, and worlds that are known."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

import twins.motion
from edgeperc import (
    Motion,
    Mounting,
    OptionError,
    PointsError,
    SensorError,
    StampError,
    TrackingError,
    Trajectory,
    deskew,
    merge,
)
from edgeperc.preprocess.motion import fill_deskewed
from edgeperc.types.frame import quaternion

RATES = st.tuples(*3 * [st.floats(-4.0, 4.0)])
NUMBERS = st.one_of(st.floats(-90, 90, width=32), st.sampled_from([math.nan, math.inf, -math.inf]))


@given(st.integers(0, 9), RATES, RATES, st.data())
def test_points_are_moved_as_by_the_twin(n: int, velocity: Any, rate: Any, data: st.DataObject) -> None:
    points = data.draw(npst.arrays(np.float32, (n, 4), elements=NUMBERS))
    after_s = data.draw(npst.arrays(np.float64, n, elements=st.one_of(st.floats(-0.5, 0.5), st.just(math.nan))))
    moved = np.empty_like(points)
    fill_deskewed(points, after_s, np.array(velocity), np.array(rate), moved)
    expected = twins.motion.deskewed(points, after_s, velocity, rate)
    good = np.isfinite(points[:, :3]).all(axis=1) & np.isfinite(after_s)
    np.testing.assert_allclose(moved[good], expected[good], rtol=1e-6, atol=1e-5)
    assert not np.isfinite(moved[~good, :3]).all(axis=1).any()


def test_who_stands_may_write_no_pose_for_minutes() -> None:
    """But a pose more than a minute after another one is no motion of a scan."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    assert Trajectory(np.array([0.0, 120.0]), poses).motion(50.0, 50.1) == Motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    with pytest.raises(StampError, match="120 s apart"):
        Motion.between(poses[0], 0.0, poses[1], 120.0)


@given(RATES, RATES, st.floats(0.05, 0.4))
def test_the_motion_between_two_poses(velocity: Any, rate: Any, seconds: float) -> None:
    start = twins.motion.exponential(twins.motion.screw((30.0, -7.0, 2.0), (0.3, -0.2, 1.4)))
    end = start @ twins.motion.exponential(twins.motion.screw(velocity, rate) * seconds)
    found = Motion.between(start, 5.0, end, 5.0 + seconds)
    np.testing.assert_allclose(found.velocity_mps, velocity, atol=1e-6)
    np.testing.assert_allclose(found.rate_radps, rate, atol=1e-6)


def room(n: int = 3600) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points on the walls of a room 40 x 30 m, in the order in which a spinning sensor meets them, and their times."""
    turn = np.linspace(math.pi, -math.pi, n, endpoint=False)
    reach = np.minimum(20.0 / np.maximum(np.abs(np.cos(turn)), 1e-9), 15.0 / np.maximum(np.abs(np.sin(turn)), 1e-9))
    return np.column_stack([reach * np.cos(turn), reach * np.sin(turn), 0.2 * np.cos(5 * turn)]), np.linspace(0, 0.1, n)


@pytest.mark.parametrize("at_s", [None, 1000.0, 1000.05])
def test_walls_are_straight_again(at_s: float | None) -> None:
    world, times = room()
    times = times + 1000.0
    motion = Motion((18.0, 0.5, 0.0), (0.02, -0.03, 0.6))
    screw = twins.motion.screw(motion.velocity_mps, motion.rate_radps)
    # What the sensor sees while it moves: each point in the frame of its own time. The world is its frame at at_s.
    at = times.max() if at_s is None else at_s
    seen = np.array(
        [
            np.linalg.solve(twins.motion.exponential(screw * (t - at)), [*p, 1.0])[:3]
            for p, t in zip(world, times, strict=True)
        ]
    )
    assert np.abs(seen - world).max() > 0.7
    scan = np.column_stack([seen, np.full(len(seen), 0.5)]).astype(np.float32)
    found = deskew(scan, times, motion, at_s=at_s)
    np.testing.assert_allclose(found[:, :3], world, atol=1e-4)
    assert (found[:, 3] == 0.5).all()
    assert found.dtype == np.float32
    assert deskew(np.empty((0, 4)), [], motion).shape == (0, 4)


@given(RATES, st.integers(1, 4), st.integers(0, 99))
def test_merged_scans_lie_in_the_vehicles_frame(rate: Any, n_sensors: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    vehicle = [random.uniform(-50, 50, (random.integers(0, 20), 3)) for _ in range(n_sensors)]
    poses = [twins.motion.exponential(twins.motion.screw((k, -0.5 * k, 1.6), rate)) for k in range(n_sensors)]
    scans = [
        np.column_stack([(p - T[:3, 3]) @ T[:3, :3], np.full(len(p), k)])
        for k, (p, T) in enumerate(zip(vehicle, poses, strict=True))
    ]
    merged = merge(iter(scans), iter(poses), min_range_m=np.zeros(n_sensors))
    np.testing.assert_allclose(merged[:, :3], np.concatenate(vehicle), atol=1e-4)
    assert merged[:, 3].tolist() == [k for k, p in enumerate(vehicle) for _ in p]


def test_errors_name_the_reason() -> None:
    world, times = room(9)
    still = Motion((0, 0, 0))
    for wrong in (times[1:], times[:, None], "soon", np.ma.array(times, mask=True), times.astype("m8[s]")):
        with pytest.raises(PointsError, match="got times"):
            deskew(world, wrong, still)
    with pytest.raises(PointsError):
        deskew(world[:, :2], times, still)
    for at_s in (math.nan, "a"):
        with pytest.raises(StampError, match=f"at_s is {at_s!r}"):
            deskew(world, times, still, at_s=at_s)
    for unit, at_s in ((1e3, None), (1e9, None), (1.0, 1.7e9)):  # another unit, or another clock
        with pytest.raises(StampError, match="expected seconds on one clock"):
            deskew(world, times * unit, still, at_s=at_s)
    with pytest.raises(StampError, match=r"of 1\.76e\+09 s, which float32 holds to 1\.3e\+02 s"):
        deskew(world, (times + 1.76e9).astype(np.float32), still)
    with pytest.raises(OptionError, match="expected a Motion"):
        deskew(world, times, (1, 0, 0))  # type: ignore[arg-type]
    for velocity in ((1, 2), "abc", (math.nan, 0, 0), (1e5, 0, 0), None):
        with pytest.raises(OptionError, match=r"velocity_mps.* is .*expected a .*number"):
            Motion(velocity)  # type: ignore[arg-type]
    with pytest.raises(dataclasses.FrozenInstanceError):
        still.velocity_mps = (1, 0, 0)  # type: ignore[misc]
    eye = np.eye(4)
    for stamps in ((1.0, 1.0), (2.0, 1.0), (0.0, math.nan), (0.0, math.inf), (0.0, None)):
        with pytest.raises(StampError, match=r"expected a second one that is later|second_s is None"):
            Motion.between(eye, stamps[0], eye, stamps[1])
    with pytest.raises(StampError, match=r"1e\+08 s apart.*another unit"):
        Motion.between(eye, 1.8e18, eye, 1.8e18 + 1e8)
    with pytest.raises(TrackingError, match="180 degrees"):
        Motion.between(eye, 0.0, np.diag([-1.0, -1.0, 1.0, 1.0]), 1.0)
    for wrong, message in ((np.stack([eye] * 3), "of shape"), (np.stack([eye, 2 * eye]), "not rigid")):
        with pytest.raises(TrackingError, match=message):
            Trajectory(np.arange(2.0), wrong)
    with pytest.raises(PointsError, match="no scan"):
        merge([], [])
    utm = np.vstack([[1.0, 0.0, 0.0, 5e6], eye[1:]])
    for poses, said in (([eye], "1 poses for 2 scans"), ([eye, utm], r"\[1\] puts the sensor at 5,000,000 m.*5 mm")):
        with pytest.raises(SensorError, match=said):
            merge([world, world], poses)


def write_tum(path: Path, times: Any, poses: Any) -> Path:
    lines = ["# time x y z qx qy qz qw"]
    for t, T in zip(times, poses, strict=True):
        lines.append(" ".join(f"{value:.17g}" for value in (t, *T[:3, 3], *quaternion(T[:3, :3]))))
    path.write_text("\n".join(lines))
    return path


@given(st.tuples(*3 * [st.floats(-3.0, 3.0)]), RATES)
def test_poses_are_read_as_they_were_written(rate: Any, velocity: Any) -> None:
    screw = twins.motion.screw(velocity, np.array(rate) / 3.0)
    poses = [twins.motion.exponential(screw * t) for t in (0.0, 0.5, 1.0)]
    with tempfile.TemporaryDirectory() as folder:
        path = write_tum(Path(folder) / "poses.txt", (10.0, 10.5, 11.0), poses)
        found = Trajectory.from_tum(path, quaternion="xyzw", maps_from="sensor")
    np.testing.assert_allclose(found.T_world_sensor, poses, atol=1e-12)
    for first_s, last_s in ((10.1, 10.2), (10.4, 10.6), (9.9, 10.0), (11.0, 11.2), (10.5, 10.5)):
        motion = found.motion(first_s, last_s)
        np.testing.assert_allclose(motion.velocity_mps, velocity, atol=1e-9)
        np.testing.assert_allclose(motion.rate_radps, np.array(rate) / 3.0, atol=1e-9)
    for t in (-0.1, 0.0, 0.2, 0.5, 0.9, 1.0, 1.2):  # on the arc of the motion, not on its chord
        np.testing.assert_allclose(found.pose(10.0 + t), twins.motion.exponential(screw * t), atol=1e-9)


def test_the_poses_around_a_scan_count() -> None:
    """A sensor that stands, drives at 10 m/s for a second and stands again."""
    x = np.array([0.0, 0.0, 10.0, 10.0])
    poses = np.broadcast_to(np.eye(4), (4, 4, 4)).copy()
    poses[:, 0, 3] = x
    drive = Trajectory(np.arange(4.0), poses)
    assert [drive.motion(t, t + 0.1).velocity_mps[0] for t in (0.2, 1.0, 1.5, 1.9, 2.0)] == [0, 10, 10, 10, 0]
    assert drive.motion(0.95, 1.05).velocity_mps[0] == pytest.approx(5.0)
    assert [drive.pose(t)[0, 3] for t in (0.5, 1.25, 2.0, 3.1)] == pytest.approx([0.0, 2.5, 10.0, 10.0])
    gaps = Trajectory(np.arange(4.0) * 3.0, poses)  # no pose for 3 s
    assert gaps.motion(1.0, 1.1).velocity_mps[0] == 0.0
    with pytest.raises(StampError, match=r"no pose from 3\.000 to 6\.000 s, and the sensor moved"):
        gaps.motion(4.0, 4.1)


@pytest.mark.parametrize(
    ("first_s", "last_s"), [(-1.0, 0.5), (0.5, 9.0), (math.nan, 1.0), (0.0, math.nan), (1.7e9, 1.7e9), (0.8, 0.7)]
)
def test_poses_of_another_time_are_refused(first_s: float, last_s: float) -> None:
    with pytest.raises(StampError, match=r"the poses are of 0\.000\.\.1\.000 s"):
        Trajectory(np.arange(2.0), np.stack([np.eye(4)] * 2)).motion(first_s, last_s)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", "cannot be read as poses|2 or more|two or more"),
        ("# only a comment\n", "no line of numbers"),
        ("\x1c\n", "no line of numbers"),
        ("no numbers", "cannot be read as poses"),
        ("#timestamp, p_x\n1403636580838555648,4.6,-1.7,0.7,0.5,-0.1,-0.8,-0.1\n", "commas, as EuRoC's"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "12 numbers in a line, as KITTI's poses, which have no times"),
        ("0 0 0 0 0 0 0", "7 numbers in a line"),
        ("0 0 0 0 0 0 0 1", "two or more"),
        ("0 0 0 0 0 0 0 2\n1 0 0 0 0 0 0 1", "line 1 has not length 1"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 nan", "line 2 has not length 1"),
        ("0 0 0 0 0 0 0 1\n1 inf 0 0 0 0 0 1", "line 2 .* not finite"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0", "cannot be read as poses"),
    ],
)
def test_files_that_are_no_poses_are_refused(text: str, error: str, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(TrackingError, match=error):
        Trajectory.from_tum(tmp_path / "poses.txt")
    with pytest.raises(TrackingError, match="cannot be read"):
        Trajectory.from_tum(tmp_path / "absent.txt")


def turned_by(x: Any, y: Any, yaw: Any) -> NDArray[np.float64]:
    """Poses on a plane."""
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :2, :2] = np.moveaxis([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]], -1, 0)
    poses[:, 0, 3], poses[:, 1, 3] = x, y
    return poses


def drive(turn_radps: float, speed_mps: float = 10.0, heading: float = 0.0, T_vehicle_sensor: Any = None) -> Any:
    """Times and poses of a sensor on a vehicle that drives an arc for 3 s; by default x is ahead and z is up."""
    times = 0.1 * np.arange(30)
    step = speed_mps * times * np.sinc(0.5 * turn_radps * times / np.pi)  # the chord of the arc
    yaw, way = heading + turn_radps * times, heading + 0.5 * turn_radps * times
    poses = turned_by(step * np.cos(way), step * np.sin(way), yaw)
    return times, poses @ (np.eye(4) if T_vehicle_sensor is None else T_vehicle_sensor)


PLACE = np.array([[0.02, -1.0, 0.0, 0.03], [0.0, 0.0, -1.0, -0.08], [1.0, 0.02, 0.0, -0.27], [0.0, 0.0, 0.0, 1.0]])
PLACE[:3, :3] /= math.hypot(1.0, 0.02)  # of a sensor in a camera that looks a little to the left
PLACE[1, 2] = -1.0


def write_kitti(path: Path, poses: Any) -> Path:
    path.write_text("\n".join(" ".join(map(repr, pose[:3].ravel().tolist())) for pose in poses) + "\n")
    return path


@pytest.mark.parametrize("turn_radps", [0.0, 0.4])
def test_poses_in_the_format_of_kitti(turn_radps: float, tmp_path: Path) -> None:
    """They are the sensor's, or those of a camera in which the sensor has a place; and never taken for the other."""
    assert np.linalg.det(PLACE[:3, :3]) == pytest.approx(1.0)
    times, poses = drive(turn_radps)
    own = write_kitti(tmp_path / "own.txt", poses)
    found = Trajectory.from_kitti(own, times)
    np.testing.assert_array_equal(found.times_s, times)
    np.testing.assert_allclose(found.T_world_sensor, poses, atol=1e-9)
    camera = write_kitti(tmp_path / "camera.txt", PLACE @ poses @ np.linalg.inv(PLACE))
    found = Trajectory.from_kitti(camera, times, T_camera_sensor=PLACE)
    np.testing.assert_allclose(found.T_world_sensor, poses, atol=1e-9)
    with pytest.raises(TrackingError, match=r"poses of a camera .* pass T_camera_sensor"):
        Trajectory.from_kitti(camera, times)
    with pytest.raises(TrackingError, match="poses of the sensor; leave T_camera_sensor out"):
        Trajectory.from_kitti(own, times, T_camera_sensor=PLACE)
    with pytest.raises(StampError, match="has 30 poses; expected a time for each, got 29"):
        Trajectory.from_kitti(own, times[1:])
    with pytest.raises(StampError, match="that rise"):
        Trajectory.from_kitti(own, times[::-1])


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", "no line of numbers"),
        ("0 0 0 0 0 0 0 1\n" * 2, "8 numbers in a line, as TUM's.*; expected lines of the upper three rows"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "not a rotation|rotation"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0\n" * 2, "finite"),
    ],
)
def test_files_that_are_no_poses_of_kitti_are_refused(text: str, error: str, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(TrackingError, match=error):
        Trajectory.from_kitti(tmp_path / "poses.txt", [0.0, 0.1])


def write_w_first(path: Path, times: Any, poses: Any) -> Path:
    lines = write_tum(path, times, poses).read_text().splitlines()[1:]
    rows = [line.split() for line in lines]
    path.write_text("\n".join(" ".join([*row[:4], row[7], *row[4:7]]) for row in rows))
    return path


@pytest.mark.parametrize(("meters", "seconds"), [(1000.0, 1.0), (1.0, 0.01), (100.0, 1.0), (3.28, 0.1)])
@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_poses_in_other_units_are_refused(meters: float, seconds: float, turn: float, tmp_path: Path) -> None:
    """Straightened by them, points would move by as much too far."""
    times, poses = drive(turn)
    np.testing.assert_array_equal(Trajectory.from_tum(write_tum(tmp_path / "a.txt", times, poses)).times_s, times)
    poses = np.array(poses)
    poses[:, :3, 3] *= meters
    with pytest.raises(
        TrackingError, match=r"b\.txt: by its poses, the sensor moves at [\d,]+ m/s; expected positions in m"
    ):
        Trajectory.from_tum(write_tum(tmp_path / "b.txt", times * seconds, poses))


def test_a_byte_order_mark_is_no_pose(tmp_path: Path) -> None:
    path = write_tum(tmp_path / "a.txt", *drive(0.2))
    expected = Trajectory.from_tum(path).T_world_sensor
    path.write_text("\ufeff" + path.read_text(), encoding="utf-8")
    np.testing.assert_array_equal(Trajectory.from_tum(path).T_world_sensor, expected)


HANGING = np.diag([1.0, -1.0, -1.0, 1.0])
CAMERA = np.array([[0, 0, 1.0, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize("heading", [0.0, 1.5, 3.1, -2.0])
@pytest.mark.parametrize("turn", [0.0, 0.4, -1.0])
@pytest.mark.parametrize("speed", [10.0, 0.0])
def test_quaternions_with_w_first_are_not_read_as_w_last(
    turn: float, heading: float, speed: float, tmp_path: Path
) -> None:
    times, poses = drive(turn, speed, heading)
    last = Trajectory.from_tum(write_tum(tmp_path / "last.txt", times, poses))
    np.testing.assert_allclose(last.T_world_sensor, poses, atol=1e-12)
    path = write_w_first(tmp_path / "first.txt", times, poses)
    found = Trajectory.from_tum(path, quaternion="wxyz")
    np.testing.assert_allclose(found.T_world_sensor, poses, atol=1e-12)
    if speed == 0.0 and abs(heading) > 3.0:
        return  # both readings are upright
    to_and_fro = np.append(times, 3.0 + times), np.append(poses, poses[::-1], axis=0)
    back = write_w_first(tmp_path / "to_and_fro_first.txt", *to_and_fro)
    for each in [path, back][: 2 if turn == heading == 0.0 else 1]:
        with pytest.raises(TrackingError, match=r"first\.txt: read as x, y, z, w, .* as w, x, y, z, .*--quaternion"):
            Trajectory.from_tum(each)


def weave(heading: float, T_vehicle_sensor: Any, place: tuple[float, float] = (0.0, 0.0)) -> Any:
    """As `drive`, to the left and to the right by turns."""
    t = 0.01 * np.arange(600)
    yaw = heading + 1.2 * np.sin(2.0 * t)
    x, y = place[0] + np.cumsum(0.1 * np.cos(yaw)), place[1] + np.cumsum(0.1 * np.sin(yaw))
    poses = turned_by(x, y, yaw)
    return t[::10], poses[::10] @ T_vehicle_sensor


@pytest.mark.parametrize("place", [(0.0, 0.0), (30.0, -70.0), (5e5, 4e6)], ids=["start", "near", "map"])
@pytest.mark.parametrize("heading", [0.5, 1.5, -2.0])
@pytest.mark.parametrize("T_vehicle_sensor", [np.eye(4), CAMERA], ids=["lidar", "camera"])
@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_inverse_poses_are_not_read_as_poses(
    place: tuple[float, float], heading: float, T_vehicle_sensor: Any, order: Any, tmp_path: Path
) -> None:
    times, poses = weave(heading, T_vehicle_sensor, place)
    write = write_tum if order == "xyzw" else write_w_first
    path = write(tmp_path / "inverse.txt", times, np.linalg.inv(poses))
    found = Trajectory.from_tum(path, quaternion=order, maps_from="world")
    np.testing.assert_allclose(found.T_world_sensor, poses, atol=1e-6)
    for said in (order, None):
        with pytest.raises(TrackingError, match=r"read as .* and from the world to the sensor, .* --poses-from"):
            Trajectory.from_tum(path, quaternion=said)
    path = write(tmp_path / "poses.txt", times, poses)
    np.testing.assert_allclose(Trajectory.from_tum(path, quaternion=order).T_world_sensor, poses, atol=1e-6)


BACKWARD = np.diag([-1.0, -1.0, 1.0, 1.0])


@pytest.mark.parametrize("T_vehicle_sensor", [BACKWARD, np.eye(4)], ids=["back", "ahead"])
@pytest.mark.parametrize(("bend", "noise_m"), [(0.03, 0.0), (0.3, 0.0), (1.2, 0.03), (0.0, 0.03)])
def test_poses_that_begin_at_identity_may_be_those_of_a_sensor_that_looks_back(
    T_vehicle_sensor: Any, bend: float, noise_m: float, tmp_path: Path
) -> None:
    """The inverse of a straight way, and of one that bends evenly, is such a way: how straight it is differs."""
    rng = np.random.default_rng(1)
    t = 0.1 * np.arange(100)
    yaw = bend * np.sin(2.0 * np.pi * t / t[-1])
    noise = rng.normal(0.0, noise_m, (len(t), 2)), rng.normal(0.0, 0.1 * noise_m, len(t))
    way = np.cumsum(np.stack([np.cos(yaw), np.sin(yaw)], axis=1), axis=0) + noise[0]
    poses = turned_by(*way.T, yaw + noise[1]) @ T_vehicle_sensor
    poses = np.linalg.inv(poses[0]) @ poses
    found = Trajectory.from_tum(write_tum(tmp_path / "poses.txt", t, poses))
    np.testing.assert_allclose(found.T_world_sensor, poses, atol=1e-6)
    with pytest.raises(TrackingError, match=r"read as .* and from the world to the sensor, .* --poses-from"):
        Trajectory.from_tum(write_tum(tmp_path / "inverse.txt", t, np.linalg.inv(poses)))


@pytest.mark.parametrize("T_vehicle_sensor", [BACKWARD, np.eye(4), HANGING @ CAMERA])
@pytest.mark.parametrize("heading", [0.1, 1.5, 3.1])
def test_sensors_that_look_elsewhere_are_told_by_turns(heading: float, T_vehicle_sensor: Any, tmp_path: Path) -> None:
    times, poses = weave(heading, T_vehicle_sensor)
    read = Trajectory.from_tum(write_tum(tmp_path / "poses.txt", times, poses))
    np.testing.assert_allclose(read.T_world_sensor, poses, atol=1e-9)
    with pytest.raises(OptionError, match="expected 'sensor' or 'world'"):
        Trajectory.from_tum(tmp_path / "poses.txt", maps_from="vehicle")  # type: ignore[arg-type]


@pytest.mark.parametrize("turn", [0.0, 0.4])
@pytest.mark.parametrize(
    "mounting", [Mounting(), Mounting(yaw_deg=-90.0), Mounting(roll_deg=180.0), Mounting(1.7, 180.0, 3.0, 130.0)]
)
def test_a_mounting_tells_which_way_is_ahead(mounting: Mounting, turn: float, tmp_path: Path) -> None:
    """Both ways of an even bend keep their direction in the sensor."""
    T_vehicle_sensor = np.eye(4)
    T_vehicle_sensor[:3, :3] = mounting.rotation()
    times, poses = drive(turn, 10.0, 0.7, T_vehicle_sensor)
    path = write_tum(tmp_path / "poses.txt", times, poses)
    np.testing.assert_allclose(Trajectory.from_tum(path, mounting=mounting).T_world_sensor, poses, atol=1e-9)
    path = write_tum(tmp_path / "inverse.txt", times, np.linalg.inv(poses))
    with pytest.raises(TrackingError, match=r"and from the world to the sensor, 0 deg from up .* --poses-from"):
        Trajectory.from_tum(path, mounting=mounting)


@pytest.mark.parametrize("T_vehicle_sensor", [CAMERA, HANGING @ CAMERA], ids=["camera", "camera upside down"])
def test_cameras_may_look_along_z(T_vehicle_sensor: Any, tmp_path: Path) -> None:
    times, poses = drive(0.4, 10.0, 0.7, T_vehicle_sensor)
    found = Trajectory.from_tum(write_tum(tmp_path / "last.txt", times, poses))
    np.testing.assert_allclose(found.T_world_sensor, poses, atol=1e-12)
    if T_vehicle_sensor is CAMERA:
        path = write_w_first(tmp_path / "first.txt", times, poses)
        with pytest.raises(TrackingError, match="read as w, x, y, z"):
            Trajectory.from_tum(path)


def test_a_sensor_that_hangs_is_read_when_the_order_is_said(tmp_path: Path) -> None:
    times, poses = drive(0.0, 10.0, 0.0, HANGING)
    path = tmp_path / "last.txt"
    path.write_text("\n".join(f"{t} {T[0, 3]} 0 0 1 0 0 0" for t, T in zip(times, poses, strict=True)))
    with pytest.raises(TrackingError, match="180 deg from up"):
        Trajectory.from_tum(path)
    np.testing.assert_allclose(Trajectory.from_tum(path, quaternion="xyzw").T_world_sensor, poses, atol=1e-12)
    with pytest.raises(OptionError, match="expected 'xyzw' or 'wxyz'"):
        Trajectory.from_tum(path, quaternion="wzyx")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "line"), [("# t\n1 {0}\n\n2 {0}\n2 {0}", 5), ("1 {0}\n0 {0}", 2), ("0 {0}\n#\nnan {0}", 3)]
)
def test_times_that_do_not_rise_name_the_line(text: str, line: int, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(text.format("0 0 0 0 0 0 1"))
    with pytest.raises(StampError, match=rf"poses\.txt: the time of line {line} is not later"):
        Trajectory.from_tum(tmp_path / "poses.txt")
