"""The live node: bad clouds, newest first, stamps, diagnostics; over Zenoh between processes, and by rclpy's calls."""

from __future__ import annotations

import math
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rosbags")

from ros2_helpers import FIELDS, MESSAGES, Perceive, cloud, odometry, street, street_kinds

from edgeperc import Box, ModelFileError, OptionError, Perception, PointsError, RollingGrid, Tracker
from edgeperc.readers.clouds import cloud_points
from edgeperc.records import PerceivedScan
from edgeperc.ros2 import node as node_module
from edgeperc.ros2.graph import full_name
from edgeperc.ros2.messages import CLOUD, DIAGNOSTICS, OUTPUTS
from edgeperc.ros2.node import PerceptionNode
from edgeperc.ros2.odometry import ODOMETRY, Rolling
from edgeperc.types.sensor import get_sensor
from waiting import TIMEOUT_S, until

SLOW_HZ = 0.01  # no answer is late


class FakeGraph:
    """A graph in this process: what is published is kept by topic, and clouds are given by hand."""

    def __init__(self, missing: str = "") -> None:
        self.name, self.closed, self.missing = "/here/edgeperc", 0, missing
        self.published: dict[str, list[bytes]] = {}
        self.types: dict[str, str] = {}
        self.wanted = True
        self.give: Callable[[bytes], None]
        self.odometry: Callable[[bytes], None]
        self.change: Callable[[str], object] | None = None

    def parameter(self, name: str, default: Any) -> Any:
        return default

    def advertise(self, topic: str, message_type: str) -> Any:
        if self.missing and self.missing in message_type:
            raise OptionError(f"{self.missing} is not installed")
        self.types[topic] = message_type
        kept, graph = self.published.setdefault(topic, []), self

        class Output:
            is_wanted = property(lambda _: graph.wanted)

            def publish(self, data: bytes) -> None:
                kept.append(data)

        return Output()

    def subscribe(self, topic: str, message_type: str, receive: Callable[[bytes], None]) -> None:
        if message_type == CLOUD:
            self.give = receive
        else:
            assert (topic, message_type) == ("/odom", ODOMETRY)
            self.odometry = receive

    def manage(self, change: Callable[[str], object]) -> bool:
        self.change = change
        return True

    def close(self) -> None:
        self.closed += 1


@contextmanager
def running(perceive: Any = None, **options: Any) -> Iterator[tuple[FakeGraph, PerceptionNode, Iterator[Any]]]:
    """A graph, a node in it, and what comes of its clouds."""
    graph = FakeGraph()
    with PerceptionNode(graph, lambda _: perceive or Perceive(), **{"rate_hz": SLOW_HZ, **options}) as node:
        yield graph, node, iter(node)


def answered(clouds: Iterable[bytes], perceive: Any = None, **options: Any) -> tuple[FakeGraph, list[Any]]:
    """The graph, and what comes of each of some clouds."""
    answers = []
    with running(perceive, **options) as (graph, _, outcomes):
        for each in clouds:
            graph.give(each)
            answers.append(next(outcomes))
    return graph, answers


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Diagnostics come often, so that no test waits a second."""
    monkeypatch.setattr(node_module, "REPORT_EVERY_S", 0.02)


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    names = ("edgeperc-source", "edgeperc-diagnostics", "edgeperc-rclpy")
    until(lambda: not [t for t in threading.enumerate() if t.name in names])


POINTS = np.array([[10.0, 1.0, -1.0, 0.5], [np.nan, 0.0, 0.0, 0.1], [5.0, -2.0, 0.25, 1.0]], np.float32)


def last_status(graph: FakeGraph) -> Any:
    return MESSAGES.decode(graph.published["/diagnostics"][-1], DIAGNOSTICS).status[0]


def test_a_cloud_is_answered_with_its_stamp_and_frame() -> None:
    graph, perceive, described = FakeGraph(), Perceive(), []

    def perceiver_for(found: Mapping[str, Any]) -> Any:
        described.append(found)
        return perceive

    with PerceptionNode(graph, perceiver_for, topic="/lidar/points", rate_hz=SLOW_HZ) as node:
        outcomes = iter(node)
        for k in range(2):
            graph.give(cloud(POINTS, 1_700_000_000_123_456_789 + k))
            scan = next(outcomes)
            np.testing.assert_array_equal(scan.points, POINTS)
            assert (scan.name, scan.health, scan.sensor.name) == (f"/lidar/points/{k:06d}", "OK", "hdl-64e")
    assert described == [
        {"topic": "/lidar/points", "frame": "velodyne", "fields": [n for n, _ in FIELDS], "elevations_deg": []}
    ]
    assert graph.closed == 1
    answer = MESSAGES.decode(graph.published["/edgeperc/points"][0], CLOUD)
    stamp = answer.header.stamp
    assert (stamp.sec, stamp.nanosec, answer.header.frame_id) == (1_700_000_000, 123_456_789, "velodyne")
    np.testing.assert_array_equal(cloud_points(answer), POINTS)
    assert graph.types == {
        "/diagnostics": DIAGNOSTICS,
        **{f"/edgeperc/{name}": kind for name, kind in OUTPUTS.items() if name != "diagnostics"},
        "/edgeperc/ground_points": CLOUD,
        "/edgeperc/obstacle_points": CLOUD,
    }


def test_frames_and_names_of_ones_own() -> None:
    options: dict[str, Any] = {"frame_id": "base", "grid_frame_id": "ground", "prefix": "/a/", "outputs": ["occupancy"]}
    graph, _ = answered([cloud(POINTS)], **options)
    assert graph.types.keys() == {"/a/occupancy"}
    (grid,) = (MESSAGES.decode(raw, OUTPUTS["occupancy"]) for raw in graph.published["/a/occupancy"])
    assert grid.header.frame_id == "ground"


def test_nothing_is_made_that_nobody_wants() -> None:
    with running() as (graph, _, outcomes):
        graph.wanted = False
        graph.give(cloud(POINTS))
        next(outcomes)
    assert not any(kept for topic, kept in graph.published.items() if topic != "/diagnostics")


HOSTILE = {
    "not CDR": (b"garbage", "not a sensor_msgs/msg/PointCloud2"),
    "nothing": (b"", "not a sensor_msgs/msg/PointCloud2"),
    "half": (cloud(POINTS)[:60], "not a sensor_msgs/msg/PointCloud2"),
    "no fields": (cloud(POINTS, fields=[]), "layout is impossible|no numeric field"),
    "steps too small": (cloud(POINTS, point_step=3), "layout is impossible"),
    "step of 0": (cloud(POINTS, point_step=0), "layout is impossible"),
    "rows that overlap": (cloud(POINTS, height=3, width=2, row_step=4), "declares 3 x 2 points"),
    "more points than bytes": (cloud(POINTS, width=1000), "declares 1 x 1000 points"),
    "huge": (cloud(POINTS, width=2**32 - 1, height=2**32 - 1), "declares 4,294,967,295 x 4,294,967,295 points"),
    "a huge step": (cloud(POINTS, point_step=2**32 - 1), "layout is impossible"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_bad_cloud_is_an_error_and_the_next_is_perceived(name: str, quick: None) -> None:
    data, said = HOSTILE[name]
    with running() as (graph, node, outcomes):
        graph.give(data)
        error = next(outcomes)
        assert isinstance(error, PointsError)
        assert re.search(said, str(error))
        until(lambda: graph.published["/diagnostics"] and last_status(graph).level == 2)
        status = last_status(graph)
        assert status.message == f"PointsError: {error}"
        assert {v.key: v.value for v in status.values}["clouds failed"] == "1"
        graph.give(cloud(POINTS))
        assert isinstance(next(outcomes), PerceivedScan)
        until(lambda: last_status(graph).level == 0)
        assert (node.n_scans, node.n_failed, node.n_dropped) == (2, 1, 0)


def test_a_cloud_of_16_million_points_in_few_bytes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three coordinates may share one byte, so bytes alone limit nothing."""
    monkeypatch.setattr(node_module, "MAX_SCAN_BYTES", 1600)
    one = MESSAGES.types["sensor_msgs/msg/PointField"]
    fields = [one(name=axis, offset=0, datatype=1, count=1) for axis in "xyz"]
    with running() as (graph, _, outcomes):
        graph.give(cloud(POINTS, fields=fields, width=101, point_step=1, data=np.zeros(101, np.uint8)))
        assert "expected at most 100" in str(next(outcomes))
        graph.give(cloud(np.zeros((101, 4))))
        assert "expected at most 1,600" in str(next(outcomes))


def test_big_endian_empty_and_nan_clouds_are_clouds() -> None:
    nothing = np.full((4, 4), np.nan, np.float32)
    _, answers = answered([cloud(POINTS, is_bigendian=True), cloud(POINTS[:0]), cloud(nothing)])
    for scan, expected in zip(answers, (POINTS, POINTS[:0], nothing), strict=True):
        assert isinstance(scan, PerceivedScan), scan
        np.testing.assert_array_equal(scan.points, expected)


def test_damaged_bytes_never_end_the_node() -> None:
    with running(outputs=("points", "markers")) as (graph, _, outcomes):

        @given(st.data())
        def check(data: st.DataObject) -> None:
            damaged = bytearray(cloud(POINTS))
            for _ in range(data.draw(st.integers(0, 6))):
                damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
            graph.give(bytes(damaged[: data.draw(st.integers(0, len(damaged)))]))
            assert isinstance(next(outcomes), PerceivedScan | PointsError)
            graph.give(bytes(damaged))
            assert isinstance(next(outcomes), PerceivedScan | PointsError)
            graph.give(cloud(POINTS))
            assert isinstance(next(outcomes), PerceivedScan)

        check()


def test_the_newest_cloud_wins() -> None:
    graph, began, go_on, first = FakeGraph(), threading.Event(), threading.Event(), cloud(POINTS, 10**9)
    n_references = sys.getrefcount(first)

    class Slow(Perceive):
        def __call__(self, points: np.ndarray, *, stamp_s: float) -> Perception:
            began.set()
            assert go_on.wait(TIMEOUT_S)
            return super().__call__(points, stamp_s=stamp_s)

    with PerceptionNode(graph, lambda _: Slow()) as node:
        got: list[Any] = []
        worker = threading.Thread(target=lambda: got.extend(next(outcomes) for _ in range(2)))
        outcomes = iter(node)
        worker.start()
        graph.give(first)
        assert began.wait(TIMEOUT_S)
        for k in range(1, 6):
            graph.give(cloud(POINTS, 10**9 + k * 10**8))
        until(lambda: node.n_scans == 6)
        go_on.set()
        worker.join(TIMEOUT_S)
        assert [scan.stamp_s for scan in got] == [1.0, 1.5]
        assert (node.n_scans, node.n_dropped) == (6, 4)
        assert sys.getrefcount(first) == n_references  # not kept, as it would be of a sensor that does not spin


@pytest.mark.filterwarnings("ignore:got a scan at")
def test_stamps_that_repeat_or_jump_are_answered_and_tracked_anew() -> None:
    poison_ns = (2**31 - 1) * 10**9 + 4 * 10**9
    stamps_ns = [s * 10**9 for s in (100, 101, 101, 50, 51)] + [poison_ns, 52 * 10**9, -(10**9), 53 * 10**9]
    graph, answers = answered((cloud(POINTS, stamp_ns) for stamp_ns in stamps_ns), tracker=Tracker())
    sessions = [(answer.tracks.session, answer.tracks.is_late) for answer in answers]
    assert sessions == [(0, False), (0, False), (0, True), *[(n, False) for n in (1, 1, 2, 1, 3, 1)]]
    for raw, stamp_ns in zip(graph.published["/edgeperc/points"], stamps_ns, strict=True):
        stamp = MESSAGES.decode(raw, CLOUD).header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns


@pytest.mark.filterwarnings("ignore:got a scan at")
def test_of_a_cloud_that_comes_twice_the_boxes_are_published() -> None:
    class Car(Perceive):
        def __call__(self, points: np.ndarray, *, stamp_s: float) -> Perception:
            box = Box("car", 0.9, (10.0, 2.0, -0.9), (4.2, 1.8, 1.5), 0.0)
            return replace(super().__call__(points, stamp_s=stamp_s), boxes=(box,))

    stamps_ns = (10**9, 11 * 10**8, 11 * 10**8)
    graph, _ = answered((cloud(POINTS, stamp_ns) for stamp_ns in stamps_ns), Car(), tracker=Tracker())
    first, tracked, twice = (
        MESSAGES.decode(raw, OUTPUTS["detections"]).detections for raw in graph.published["/edgeperc/detections"]
    )
    assert (len(first), len(tracked), len(twice)) == (0, 1, 1)
    assert [found[0].id for found in (tracked, twice)] == ["1", ""]


@pytest.mark.parametrize(
    ("gather_s", "stamps", "n"),
    [(0.2, [10, 11, 12, 5], [3, 6, 6, 3]), (10.0, [0, 0, 0], [3, 6, 9])],  # 0: the time is that of this computer
)
def test_clouds_of_a_sensor_that_does_not_spin_are_gathered(gather_s: float, stamps: list[int], n: list[int]) -> None:
    """As those of a file are: alone, each has a part of the points that its profile says."""
    perceive = Perceive()
    perceive.sensor = get_sensor("mid-360").accumulated(gather_s)
    graph, outcomes = answered([cloud(POINTS + k, 10**8 * stamp) for k, stamp in enumerate(stamps)], perceive)
    assert [scan.perception.n_points for scan in outcomes] == n
    np.testing.assert_array_equal(outcomes[2].points[-6:], np.concatenate([POINTS + 1, POINTS + 2]))
    parts = [MESSAGES.decode(data, CLOUD) for data in graph.published["/edgeperc/ground_points"]]
    assert all(part.width <= len(POINTS) for part in parts)


def test_a_cloud_of_another_frame_is_an_error_and_the_first_sensor_goes_on() -> None:
    _, answers = answered(cloud(POINTS, frame_id=frame) for frame in ("front", "rear", "front"))
    assert [isinstance(answer, PerceivedScan) for answer in answers] == [True, False, True]
    assert "frame 'rear', and the first one 'front'" in str(answers[1])


def test_a_cloud_without_a_stamp_has_that_of_its_arrival() -> None:
    perceive, before = Perceive(), time.time()
    answered([cloud(POINTS, 0)], perceive)
    assert before - 1e-3 <= perceive.stamps[0] <= time.time() + 1e-3


def test_what_no_cloud_heals_is_raised() -> None:
    graph = FakeGraph()
    with PerceptionNode(graph, Mock(side_effect=ModelFileError("no such model"))) as node:
        graph.give(cloud(POINTS))
        with pytest.raises(ModelFileError):
            next(iter(node))


def test_closing_ends_the_iteration() -> None:
    with PerceptionNode(FakeGraph(), lambda _: Perceive(), rate_hz=SLOW_HZ) as node:
        worker = threading.Thread(target=lambda: [*node])
        worker.start()
    worker.join(TIMEOUT_S)
    assert not worker.is_alive()
    assert [*node] == []


def test_diagnostics_tell_of_silence(quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    with running(rate_hz=100.0) as (graph, _, outcomes):
        until(lambda: graph.published["/diagnostics"])
        assert (last_status(graph).level, last_status(graph).message) == (3, "no scan yet")
        graph.give(cloud(POINTS))
        next(outcomes)
        until(lambda: last_status(graph).level == 3 and last_status(graph).message != "no scan yet")
        status = last_status(graph)
        assert (status.name, status.message) == ("edgeperc: perception", "STALE: no answer of late")
        values = {v.key: v.value for v in status.values}
        assert (values["clouds received"], values["clouds dropped"], values["answers"]) == ("1", "0", "1")
        assert (values["infer [ms]"], values["provider of m"], values["labels"]) == (
            "1.0",
            "cpu",
            "0 background, 1 car",
        )


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8"])
@pytest.mark.parametrize("height", [1, 2])
def test_a_point_is_ground_or_obstacle_or_dropped(kind: str, height: int) -> None:
    """With all its fields, byte by byte; organized or not, with padding at the end of rows."""
    points = street()
    fields = [(name, kind) for name in ("x", "y", "z")] + [("ring", "<u2"), ("time", "<f8"), ("rest", "V3")]
    table = np.zeros(len(points), fields)
    for column, name in enumerate("xyz"):
        table[name] = points[:, column]
    table["ring"], table["time"] = np.arange(len(points)), np.arange(len(points)) * 1e-6
    table["rest"] = np.random.default_rng(1).bytes(3)
    make, sizes = MESSAGES.types["sensor_msgs/msg/PointField"], {"<f4": 7, ">f4": 7, "<f8": 8, "<u2": 4}
    described = [
        make(name=name, offset=table.dtype.fields[name][1], datatype=sizes.get(code, 8), count=1)  # type: ignore[index]
        for name, code in fields
        if name != "rest"
    ]
    step, width = table.dtype.itemsize, len(points) // height
    rows = table.view(np.uint8).reshape(height, -1)
    padded = np.hstack([rows, np.full((height, 5 * (height - 1)), 255, np.uint8)])
    with running() as (graph, _, outcomes):
        shape = {"height": height, "width": width, "point_step": step, "row_step": padded.shape[1]}
        data = cloud(points, 77, is_bigendian=kind == ">f4", fields=described, data=padded.ravel(), **shape)
        graph.give(data)
        scan = next(outcomes)
        assert isinstance(scan, PerceivedScan), scan
    parts = []
    for name in ("ground_points", "obstacle_points"):
        part = MESSAGES.decode(graph.published[f"/edgeperc/{name}"][0], CLOUD)
        assert (part.header.frame_id, part.header.stamp.nanosec, part.is_bigendian) == ("velodyne", 77, kind == ">f4")
        assert [(f.name, f.offset, f.datatype) for f in part.fields] == [
            (f.name, f.offset, f.datatype) for f in described
        ]
        assert (part.height, part.width * step, part.row_step) == (1, part.data.size, part.data.size)
        parts.append(part.data.view(table.dtype))
    ground, obstacle = (np.sort([int(row["time"].round(6) * 1e6 + 0.5) for row in part]) for part in parts)
    assert not {*ground} & {*obstacle}
    for part, numbers in zip(parts, (ground, obstacle), strict=True):
        assert part.tobytes() == table[numbers].tobytes()
    kinds = street_kinds()
    assert {*kinds} == {"ground", "obstacle", "neither"}
    np.testing.assert_array_equal(ground, np.flatnonzero(kinds == "ground"))
    np.testing.assert_array_equal(obstacle, np.flatnonzero(kinds == "obstacle"))


def test_topics_have_names_of_ones_own() -> None:
    graph = FakeGraph()
    outputs = ["ground_points=/ground", "obstacle_points=/nonground_points", "tracked_objects=objects", "markers"]
    PerceptionNode(graph, lambda _: Perceive(), outputs=outputs, prefix="/x").close()
    assert graph.types == {
        "/ground": CLOUD,
        "/nonground_points": CLOUD,
        "objects": "autoware_perception_msgs/msg/TrackedObjects",
        "/x/markers": OUTPUTS["markers"],
    }


def test_the_grid_with_memory_and_the_tracks_follow_the_odometry(quick: None) -> None:
    """A sensor 1 m ahead of the vehicle's middle, turned to the left, on a vehicle that turns as it drives."""
    points, n = street(), 4
    rolling = Rolling(sensor_pose=(1.0, 0.0, 1.73, 0.0, 0.0, 90.0), grid=RollingGrid(size_m=60.0, cell_m=0.5))
    with running(rolling=rolling, tracker=Tracker()) as (graph, _, outcomes):
        for k in range(n):
            stamp_ns = 10**9 + k * 10**8
            graph.odometry(odometry(stamp_ns - 5 * 10**7, 10.0 + k - 0.5, 20.0, 0.0))
            graph.odometry(odometry(stamp_ns + 5 * 10**7, 10.0 + k + 0.5, 20.0, 0.0))
            graph.give(cloud(points, stamp_ns))
            np.testing.assert_allclose(next(outcomes).tracks.T_world_sensor[:3, 3], [11.0 + k, 20.0, 1.73], atol=1e-6)
            graph.odometry(b"no odometry")
        graph.give(cloud(points, 10**10))
        assert next(outcomes).tracks is None  # without a pose
        until(lambda: "does not place the newest cloud: no pose at the time" in last_status(graph).message)
        assert "no pose at the time of the cloud" in [each.value for each in last_status(graph).values]
    grids = [MESSAGES.decode(raw, OUTPUTS["occupancy"]) for raw in graph.published["/edgeperc/rolling"]]
    assert len(grids) == n
    assert {grid.header.frame_id for grid in grids} == {"odom"}
    assert [grid.header.stamp.nanosec for grid in grids] == [k * 10**8 for k in range(n)]
    for k, grid in enumerate(grids):
        cells = grid.data.reshape(grid.info.height, grid.info.width)
        # The wall 12 m ahead of the sensor lies 12 m to the left of the vehicle.
        x, y = grid.info.origin.position.x, grid.info.origin.position.y
        column, row = int((10.0 + k + 1.0 - x) / 0.5), int((20.0 + 12.1 - y) / 0.5)
        assert 100 in cells[row - 1 : row + 2, column]
        assert cells[row - 8, column] == 0
        assert grid.info.origin.position.z == pytest.approx(0.0)


@pytest.mark.parametrize("poses", ["topic", "scans"])
def test_earlier_clouds_lie_where_the_newest_has_them(poses: str) -> None:
    """A wall 12 m ahead, to which the vehicle drives. Of a topic's poses, that of the second cloud is the first that is
    known in time: where the sensor is above the vehicle shows the first one.
    """
    if poses == "scans":
        pytest.importorskip("kiss_icp", reason="the extra slam is not installed")
    points, perceive, n = street(), Perceive(), 6
    options = {"rolling": Rolling(sensor_pose=(0.0,) * 6)} if poses == "topic" else {}
    with running(perceive, n_sweeps=3, tracker=Tracker(), **options) as (graph, node, outcomes):
        for k in range(n):
            stamp_ns, moved = 10**9 + k * 10**8, points - np.float32([0.3 * k, 0.0, 0.0, 0.0])
            if poses == "topic":
                graph.odometry(odometry(stamp_ns, 0.3 * k, 0.0, 0.0))
            graph.give(cloud(moved, stamp_ns))
            answer = next(outcomes)
            alone = 2 if poses == "topic" else 1
            assert bool(len(perceive.earlier[k])) == (k >= alone)
            assert (answer.tracks is not None) == (k >= alone - 1)
        if poses == "topic":
            ahead = perceive.earlier[-1][
                (np.abs(perceive.earlier[-1][:, 1]) < 2.5) & (perceive.earlier[-1][:, 0] > 9.0)
            ]
            np.testing.assert_allclose(ahead[ahead[:, 2] > -1.4, 0], 12.1 - 0.3 * (n - 1), atol=1e-3)
        for change in ("deactivate", "cleanup", "configure", "activate"):
            node.change_state(change)
        graph.give(cloud(moved, stamp_ns + 10**8))
        next(outcomes)
        assert not len(perceive.earlier[-1])


def test_a_life_in_states(quick: None) -> None:
    graph, made, tracker = FakeGraph(), [], Tracker()

    def perceiver_for(_: Mapping[str, Any]) -> Any:
        made.append(Perceive())
        return made[-1]

    with PerceptionNode(graph, perceiver_for, tracker=tracker, lifecycle=True, rate_hz=SLOW_HZ) as node:
        outcomes = iter(node)
        assert (node.state, node.is_managed) == ("unconfigured", True)
        assert graph.types.keys() == {"/diagnostics"}
        until(lambda: graph.published["/diagnostics"])
        assert (last_status(graph).level, last_status(graph).message) == (0, "unconfigured")
        graph.change("configure")
        assert node.state == "inactive"
        assert "/edgeperc/points" in graph.types
        graph.give(cloud(POINTS, 1))
        assert node.change_state("activate") == "active"
        graph.give(cloud(POINTS, 2))
        assert isinstance(next(outcomes), PerceivedScan)
        assert (len(made), node.n_scans) == (1, 1)
        graph.change("deactivate")
        graph.give(cloud(POINTS, 3))
        until(lambda: last_status(graph).message == "inactive")
        graph.change("cleanup")
        graph.change("configure")
        graph.change("activate")
        graph.give(cloud(POINTS, 4))
        assert isinstance(next(outcomes), PerceivedScan)
        assert (len(made), node.n_scans) == (2, 2)
        stamps = [MESSAGES.decode(raw, CLOUD).header.stamp.nanosec for raw in graph.published["/edgeperc/points"]]
        assert stamps == [2, 4]
        assert node.change_state("shutdown") == "finalized"
        assert [*outcomes] == []
    assert graph.closed == 1


@pytest.mark.parametrize(
    ("way", "wrong"),
    [
        ([], "activate"),
        ([], "cleanup"),
        ([], "explode"),
        (["configure"], "configure"),
        (["configure", "activate"], "cleanup"),
        (["shutdown"], "configure"),
    ],
)
def test_transitions_that_there_are_not(way: list[str], wrong: str) -> None:
    with PerceptionNode(FakeGraph(), lambda _: Perceive(), lifecycle=True) as node:
        for transition in way:
            node.change_state(transition)
        before = node.state
        with pytest.raises(OptionError, match=f"'{wrong}' does not begin at {before}"):
            node.change_state(wrong)
        assert node.state == before


def test_diagnostics_tell_rates_and_latencies(quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    with running() as (graph, _, outcomes):
        monkeypatch.setattr(node_module, "REPORT_EVERY_S", 0.3)
        until(lambda: graph.published["/diagnostics"])
        for k in range(20):
            graph.give(cloud(POINTS, 10**9 + k))
            next(outcomes)

        def values() -> list[dict[str, str]]:
            statuses = [MESSAGES.decode(raw, DIAGNOSTICS).status[0] for raw in graph.published["/diagnostics"]]
            return [{v.key: v.value for v in status.values} for status in statuses]

        until(lambda: values()[-1]["answers"] == "20" and values()[-1]["answers [Hz]"] == "0.0")
    found = values()
    assert max(float(each["clouds [Hz]"]) for each in found) > 5.0
    assert max(float(each["answers [Hz]"]) for each in found) > 5.0
    assert "latency p50 [ms]" not in found[0]
    assert 0 <= int(found[-1]["latency p50 [ms]"]) <= int(found[-1]["latency p99 [ms]"]) < 1e3 * TIMEOUT_S
    assert (found[-1]["clouds dropped"], found[-1]["state"]) == ("0", "active")


def test_the_page_configures_nav2_for_this_node() -> None:
    """The YAML of the page: topics and frames are the node's, parameters those of the layers' sources."""
    yaml = pytest.importorskip("yaml")
    known = {
        "nav2_ground_consistency_costmap_plugin::GroundConsistencyLayer": {
            *("ground_points_topic", "nonground_points_topic", "tf_timeout", "ground_inc", "nonground_inc"),
            *("ground_decay", "nonground_decay", "nonground_occ_thresh", "nonground_prob_thresh", "max_score"),
            *("min_clearance", "robot_height", "footprint_clearing_enabled", "enable_kpi_logging", "max_data_range"),
        },
        "nav2_costmap_2d::StaticLayer": {
            *("enabled", "map_topic", "map_subscribe_transient_local", "subscribe_to_updates", "transform_tolerance")
        },
        "nav2_costmap_2d::InflationLayer": {"enabled", "inflation_radius", "cost_scaling_factor"},
    }
    graph = FakeGraph()
    PerceptionNode(graph, lambda _: Perceive(), rolling=Rolling()).close()
    page = (Path(__file__).parents[2] / "docs/howto/ros2.md").read_text("utf-8")
    blocks = [yaml.safe_load(text) for text in re.findall(r"^```yaml\n(.*?)^```$", page, flags=re.M | re.S)]
    assert len(blocks) == 3
    topics = set()
    for block in blocks[1:]:
        costmap = block["local_costmap"]["local_costmap"]["ros__parameters"]
        assert (costmap["global_frame"], costmap["rolling_window"]) == ("odom", True)
        for layer in (costmap[name] for name in costmap["plugins"]):
            assert {*layer} - {"plugin"} <= known[layer["plugin"]]
            topics |= {value for name, value in layer.items() if name.endswith("_topic")}
            # A latched map would be asked for, which the node does not offer.
            assert layer.get("map_subscribe_transient_local", False) is False
    assert topics == {"/edgeperc/ground_points", "/edgeperc/obstacle_points", "/edgeperc/rolling"}
    assert topics < {*graph.types}
    manager = blocks[0]["lifecycle_manager_edgeperc"]["ros__parameters"]
    assert (manager["node_names"], manager["bond_timeout"]) == (["edgeperc"], 0.0)


def test_without_vision_msgs_there_are_no_detections_and_a_warning() -> None:
    graph = FakeGraph(missing="vision_msgs")
    with pytest.warns(UserWarning, match="no detections are published"):
        PerceptionNode(graph, lambda _: Perceive()).close()
    assert "/edgeperc/detections" not in graph.types
    assert "/edgeperc/markers" in graph.types


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"outputs": ("boxes",)}, "expected some of points"),
        ({"outputs": ("points=",)}, "not a name of ROS 2"),
        ({"outputs": ("points=a b",)}, "not a name of ROS 2"),
        ({"outputs": ("diagnostics=/mine",)}, "outputs has 'diagnostics=/mine'"),
        ({"outputs": ("rolling",)}, "needs poses"),
        ({"outputs": ("points", "points=/a")}, "two topics, /edgeperc/points and /a"),
        ({"prefix": "/"}, "share the topic /points;"),
        ({"outputs": ("points=/a", "markers=/a")}, "share the topic /a;"),
        ({"topic": "mine", "outputs": ("points=/here/mine",)}, "share the topic /here/mine;"),
        ({"rate_hz": 0.0}, "rate_hz is 0"),
        ({"rate_hz": math.nan}, "rate_hz is nan"),
        ({"n_sweeps": 1}, "n_sweeps is 1; expected a whole number from 2 to 20"),
        ({"n_sweeps": 5}, "n_sweeps needs a tracker"),
    ],
)
def test_options_of_no_node(options: dict[str, Any], said: str) -> None:
    with pytest.raises(OptionError, match=said):
        PerceptionNode(FakeGraph(), lambda _: Perceive(), **options)


@pytest.mark.parametrize(
    ("name", "namespace", "full"),
    [
        ("/points", "/", "/points"),
        ("points", "/", "/points"),
        ("points", "/front", "/front/points"),
        ("/a/b_1", "/x", "/a/b_1"),
    ],
)
def test_names_are_resolved(name: str, namespace: str, full: str) -> None:
    assert full_name(name, namespace) == full


@pytest.mark.parametrize("name", ["", "/", "/a/", "a b", "/1st", "a__b", "/a//b", "/a/*", "~/points"])
def test_names_that_ros_does_not_allow(name: str) -> None:
    with pytest.raises(OptionError, match="not a name of ROS 2"):
        full_name(name)
