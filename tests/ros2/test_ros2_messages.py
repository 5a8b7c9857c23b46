"""Messages of ROS 2, and bags of them: values, frames, stamps and hashes, read back by rosbags."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rosbags")

from ros2_helpers import street

import edgeperc
from cli_helpers import POINTSEG, Shell, run, write_scan
from edgeperc.readers.clouds import cloud_points
from edgeperc.records import PerceivedScan
from edgeperc.ros2.messages import CLOUD, OUTPUTS, RosMessages, nanoseconds
from edgeperc.sinks.rosbag import TOPICS, BagSink
from edgeperc.types.sensor import get_sensor
from scenes import rotation_of

# Published hashes: what ROS 2 Kilted's own packages answer (Node.get_publishers_info_by_topic of rclpy 9.1.2).
HASHES = {
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "visualization_msgs/msg/MarkerArray": "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
    "nav_msgs/msg/OccupancyGrid": "8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    # As a client of ROS 2 in Elixir has it, which zenoh's keys must match.
    "vision_msgs/msg/Detection3DArray": "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
}
BOXES = (
    edgeperc.Box("car", 0.9, (12.0, 3.0, -0.9), (4.2, 1.8, 1.6), 0.3),
    edgeperc.Box("pedestrian", 0.6, (8.0, -4.0, -0.8), (0.6, 0.5, 1.8), -2.0),
)
MESSAGES = RosMessages("lidar_top")
POINTS = street()


def perceived(
    stamp_s: float = 12.5, tracks: edgeperc.Tracks | None = None, points: np.ndarray = POINTS, **changes: Any
) -> PerceivedScan:
    labels = (np.arange(len(points)) % 4).astype(np.uint8)
    cells = np.ones((400, 200), np.uint8)
    cells[:, :60] = 0
    perception = edgeperc.Perception(
        n_points=len(points),
        n_dropped=2,
        points=edgeperc.PointLabels(labels, labels != 2, POINTSEG.classes),
        top_view=edgeperc.TopView(cells, ("background", "drivable"), 0.1, (6.0, 46.0), (-10.0, 10.0), cells >= 0),
        boxes=BOXES,
        stage_ms={"project": 1.25, "infer": 30.0},
        providers={"pointseg": "pointseg int8, CPUExecutionProvider"},
        fitness=("few points",),
        stamp_s=stamp_s,
    )
    perception = replace(perception, **changes)
    return PerceivedScan("scan", stamp_s, points, perception, tracks, get_sensor("hdl-64e"))


def tracked(k: int) -> edgeperc.Tracks:
    """The tracks of the k-th scan of a car that drives ahead of a standing sensor, and of a parked one."""
    tracker = edgeperc.Tracker()
    for i in range(k + 1):
        cars = [
            replace(BOXES[0], center=(10.0 + 0.5 * i, 0.0, -0.9), yaw=0.0),
            replace(BOXES[0], center=(9.0, 6.0, -0.9)),
        ]
        tracks = tracker.update(cars, 0.1 * i, np.eye(4))
    return tracks


def again(message: Any) -> Any:
    """The message after its way through CDR."""
    return MESSAGES.decode(MESSAGES.encode(message), message.__msgtype__)


def position(pose: Any) -> tuple[float, float, float]:
    return (pose.position.x, pose.position.y, pose.position.z)


def rotation(pose: Any) -> np.ndarray:
    """Matrix of a pose's quaternion."""
    turn = [getattr(pose.orientation, axis) for axis in "xyzw"]
    assert np.dot(turn, turn) == pytest.approx(1.0)
    return rotation_of(*turn)


@pytest.mark.parametrize("name", HASHES)
def test_hashes_of_types_are_those_of_ros(name: str) -> None:
    assert MESSAGES.type_hash(name) == f"RIHS01_{HASHES[name]}"


def test_points_and_classes_arrive_unchanged() -> None:
    scan = perceived()
    cloud = again(MESSAGES.points(scan))
    assert (cloud.header.frame_id, cloud.header.stamp.sec, cloud.header.stamp.nanosec) == ("lidar_top", 12, 500_000_000)
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (1, len(POINTS), 20, 20 * len(POINTS))
    assert not cloud.is_bigendian
    assert not cloud.is_dense
    assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
        ("intensity", 12, 7, 1),
        ("label", 16, 2, 1),
        ("in_view", 17, 2, 1),
    ]
    np.testing.assert_array_equal(cloud_points(cloud), POINTS)
    found = scan.perception.points
    rows = cloud.data.reshape(-1, 20)
    np.testing.assert_array_equal(rows[:, 16], found.labels)
    np.testing.assert_array_equal(rows[:, 17], found.in_view)


def test_scans_without_points_labels_or_remission() -> None:
    empty = perceived(points=np.zeros((0, 4), np.float32))
    cloud = again(MESSAGES.points(empty))
    assert (cloud.width, cloud.data.size, cloud.is_dense) == (0, 0, True)
    assert again(MESSAGES.occupancy(empty)).data.min() == -1
    bare = replace(perceived(), points=POINTS[:, :3])
    bare = replace(bare, perception=replace(bare.perception, points=None, top_view=None, boxes=()))
    cloud = again(MESSAGES.points(bare))
    np.testing.assert_array_equal(cloud_points(cloud)[:, :3], POINTS[:, :3])
    assert not cloud.data.reshape(-1, 20)[:, 12:].any()
    assert not np.any(again(MESSAGES.occupancy(bare)).data == 0)
    assert len(again(MESSAGES.markers(bare)).markers) == 1
    assert not again(MESSAGES.detections(bare)).detections


def test_markers_of_boxes() -> None:
    first, *others = again(MESSAGES.markers(perceived())).markers
    assert first.action == 3  # DELETEALL
    assert [(m.ns, m.id, m.type, m.action) for m in others] == [("boxes", 0, 1, 0), ("boxes", 1, 1, 0)]
    for marker, box in zip(others, BOXES, strict=True):
        assert position(marker.pose) == box.center
        assert (marker.scale.x, marker.scale.y, marker.scale.z) == box.size
        ahead = rotation(marker.pose)[:, 0]
        np.testing.assert_allclose(ahead, [math.cos(box.yaw), math.sin(box.yaw), 0.0], atol=1e-12)
        assert (marker.lifetime.sec, marker.lifetime.nanosec) == (0, 500_000_000)
        assert 0.0 < marker.color.a < 1.0
        assert marker.header.frame_id == "lidar_top"
    assert (others[0].color.r, others[0].color.g) != (others[1].color.r, others[1].color.g)


def test_markers_of_tracks_keep_their_ids() -> None:
    ids = []
    for k in (6, 7):
        tracks = tracked(k)
        markers = again(MESSAGES.markers(perceived(tracks=tracks))).markers
        by_name = {
            name: [m for m in markers if m.ns == name] for name in ("tracks", "track_labels", "track_velocities")
        }
        assert [m.id for m in by_name["tracks"]] == [m.id for m in by_name["track_labels"]] == [t.id for t in tracks]
        ids.append([m.id for m in by_name["tracks"]])
        moving = [t for t in tracks if math.hypot(*t.velocity) > 0.5]
        assert len(moving) == 1
        (arrow,) = by_name["track_velocities"]
        way = [arrow.points[1].x - arrow.points[0].x, arrow.points[1].y - arrow.points[0].y]
        assert arrow.id == moving[0].id
        np.testing.assert_allclose(way, moving[0].velocity)
        for track, edges, text in zip(tracks, by_name["tracks"], by_name["track_labels"], strict=True):
            assert text.text.startswith(f"{track.label} {track.id} ")
            corners = np.array([[p.x, p.y, p.z] for p in edges.points])
            assert corners.shape == (24, 3)
            lengths = np.linalg.norm(corners[::2] - corners[1::2], axis=1)
            np.testing.assert_allclose(np.sort(lengths), np.sort(np.repeat(track.size, 4)))
            seen = corners @ rotation(edges.pose).T + position(edges.pose)
            footprint = {tuple(np.round(c, 6)) for c in seen[:, :2]}
            assert footprint == {tuple(np.round(c, 6)) for c in track.box.corners()}
    assert ids[0] == ids[1]


@pytest.mark.parametrize(
    "mounting",
    [
        edgeperc.Mounting(1.73, 0.0, 0.66, 0.0),
        edgeperc.Mounting(2.1, 3.0, -8.0, 0.0),
        edgeperc.Mounting(0.6, -20.0, 5.0, -90.0),
    ],
)
def test_the_grid_lies_where_its_cells_are(mounting: edgeperc.Mounting) -> None:
    """The pose of its origin maps cells into the frame of the scan; `ModelFrame` maps them back."""
    frame = edgeperc.ModelFrame(mounting)
    points = POINTS[np.isfinite(POINTS).all(axis=1)]
    points[:, :3] = (points[:, :3] - frame.t) @ frame.R
    scan = perceived(points=points, mounting=mounting, boxes=())
    message = again(MESSAGES.occupancy(scan))
    values = edgeperc.occupancy_grid(scan.perception, points).values()
    np.testing.assert_array_equal(message.data.reshape(message.info.height, message.info.width), values)
    assert {-1, 0, 100} == {*values.ravel().tolist()}
    assert message.info.resolution == pytest.approx(0.2)
    row, column = np.argwhere(values == 100)[0]
    cell = np.array([(column + 0.5) * 0.2, (row + 0.5) * 0.2, 0.0])
    in_scan = rotation(message.info.origin) @ cell + position(message.info.origin)
    in_model = frame.R @ in_scan + frame.t
    np.testing.assert_allclose(in_model, [6.0 + cell[0], -10.0 + cell[1], -1.73], atol=1e-9)


def test_the_grid_in_a_frame_on_the_road() -> None:
    messages = RosMessages("lidar", grid_frame_id="base_footprint", off_road=50, cell_m=0.5)
    message = messages.occupancy(perceived())
    assert message.header.frame_id == "base_footprint"
    assert position(message.info.origin) == (6.0, -10.0, 0.0)
    np.testing.assert_array_equal(rotation(message.info.origin), np.eye(3))
    assert (message.info.width, message.info.height) == (80, 40)
    assert {-1, 0, 50, 100} >= {*message.data.tolist()}


def test_detections_are_the_tracks_or_the_boxes() -> None:
    found = again(MESSAGES.detections(perceived())).detections
    assert [d.results[0].hypothesis.class_id for d in found] == ["car", "pedestrian"]
    assert [d.results[0].hypothesis.score for d in found] == [0.9, 0.6]
    assert [(d.id, position(d.bbox.center), d.bbox.size.x) for d in found] == [("", b.center, b.size[0]) for b in BOXES]
    tracks = tracked(6)
    found = again(MESSAGES.detections(perceived(tracks=tracks))).detections
    assert [d.id for d in found] == [str(track.id) for track in tracks]


# Packages and fields as published (docs.ros.org, autoware_perception_msgs of Humble and Jazzy).
AUTOWARE = {
    "ObjectClassification": "uint8 label;float32 probability",
    "Shape": "uint8 type;geometry_msgs/Polygon footprint;geometry_msgs/Vector3 dimensions",
    "DetectedObjects": "std_msgs/Header header;DetectedObject[] objects",
    "DetectedObject": "float32 existence_probability;ObjectClassification[] classification;"
    "DetectedObjectKinematics kinematics;Shape shape",
    "DetectedObjectKinematics": "geometry_msgs/PoseWithCovariance pose_with_covariance;bool has_position_covariance;"
    "uint8 orientation_availability;geometry_msgs/TwistWithCovariance twist_with_covariance;bool has_twist;"
    "bool has_twist_covariance",
    "TrackedObjects": "std_msgs/Header header;TrackedObject[] objects",
    "TrackedObject": "unique_identifier_msgs/UUID object_id;float32 existence_probability;"
    "ObjectClassification[] classification;TrackedObjectKinematics kinematics;Shape shape",
    "TrackedObjectKinematics": "geometry_msgs/PoseWithCovariance pose_with_covariance;"
    "geometry_msgs/TwistWithCovariance twist_with_covariance;"
    "geometry_msgs/AccelWithCovariance acceleration_with_covariance;uint8 orientation_availability;bool is_stationary",
    "PredictedObjects": "std_msgs/Header header;PredictedObject[] objects",
    "PredictedObject": "unique_identifier_msgs/UUID object_id;float32 existence_probability;"
    "ObjectClassification[] classification;PredictedObjectKinematics kinematics;Shape shape",
    "PredictedObjectKinematics": "geometry_msgs/PoseWithCovariance initial_pose_with_covariance;"
    "geometry_msgs/TwistWithCovariance initial_twist_with_covariance;"
    "geometry_msgs/AccelWithCovariance initial_acceleration_with_covariance;PredictedPath[] predicted_paths",
    "PredictedPath": "geometry_msgs/Pose[] path;builtin_interfaces/Duration time_step;float32 confidence",
}


def test_the_types_of_autoware_are_those_of_its_package() -> None:
    """Names, types and order of the fields make a type's hash (REP-2016); rosbags' are compared with ROS's above."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in AUTOWARE.items():
        store.register(get_types_from_msg(text.replace(";", "\n"), f"autoware_perception_msgs/msg/{name}"))
    for name in AUTOWARE:
        full = f"autoware_perception_msgs/msg/{name}"
        assert MESSAGES.type_hash(full) == store.hash_rihs01(full), name
    fields = [
        {"name": name, "type": {"type_id": number, "capacity": 0, "string_capacity": 0, "nested_type_name": ""}}
        for name, number in (("label", 3), ("probability", 10))
    ]
    name = "autoware_perception_msgs/msg/ObjectClassification"
    described = {"type_description": {"type_name": name, "fields": fields}, "referenced_type_descriptions": []}
    assert MESSAGES.type_hash(name) == "RIHS01_" + hashlib.sha256(json.dumps(described).encode()).hexdigest()


def test_objects_of_autoware() -> None:
    scan = perceived(tracks=tracked(6))
    assert scan.tracks is not None
    found = again(MESSAGES.detected_objects(scan))
    assert (found.header.frame_id, found.header.stamp.sec) == ("lidar_top", 12)
    assert [o.classification[0].label for o in found.objects] == [1, 7]
    assert [o.existence_probability for o in found.objects] == pytest.approx([0.9, 0.6])
    for each, box in zip(found.objects, BOXES, strict=True):
        assert position(each.kinematics.pose_with_covariance.pose) == box.center
        assert (each.shape.type, each.shape.dimensions.x, each.shape.dimensions.z) == (0, box.size[0], box.size[2])
        assert (each.kinematics.has_twist, each.kinematics.orientation_availability) == (False, 1)
    tracks = again(MESSAGES.tracked_objects(scan)).objects
    paths = again(MESSAGES.predicted_objects(scan)).objects
    assert [o.kinematics.is_stationary for o in tracks] == [math.hypot(*t.velocity) < 1.0 for t in scan.tracks]
    assert {o.kinematics.is_stationary for o in tracks} == {True, False}
    for track, each, path in zip(scan.tracks, tracks, paths, strict=True):
        turned = rotation(each.kinematics.pose_with_covariance.pose)[:2, :2]
        twist = each.kinematics.twist_with_covariance.twist.linear
        np.testing.assert_allclose(turned @ [twist.x, twist.y], track.velocity, atol=1e-9)
        covariance = each.kinematics.pose_with_covariance.covariance.reshape(6, 6)
        np.testing.assert_allclose(covariance[:2, :2], track.covariance[:2, :2])
        assert covariance[5, 5] == track.covariance[3, 3]
        assert bytes(each.object_id.uuid) == bytes(path.object_id.uuid)
        (way,) = path.kinematics.predicted_paths
        assert (way.confidence, way.time_step.sec, way.time_step.nanosec, len(way.path)) == (1.0, 0, 500_000_000, 11)
        for k, pose in enumerate(way.path):
            np.testing.assert_allclose(position(pose), track.predicted(0.5 * k).center)


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(180.0, 0.0), (0.0, 30.0), (170.0, 20.0)])
def test_motion_seen_by_a_sensor_that_is_tilted_or_upside_down(roll_deg: float, pitch_deg: float) -> None:
    T, tracker, step_s, turn_rps = np.eye(4), edgeperc.Tracker(), 0.1, 0.3
    T[:3, :3] = R = edgeperc.Mounting(None, roll_deg, pitch_deg).rotation()
    at = np.array([10.0, 0.0, -1.0])
    for k in range(40):
        heading = -0.9 + k * step_s * turn_rps
        ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
        seen = R.T @ ahead
        car = edgeperc.Box("car", 0.97, tuple((R.T @ at).tolist()), (4.0, 1.8, 1.5), math.atan2(seen[1], seen[0]), 0.99)
        tracks = tracker.update([car], k * step_s, T)
        at = at + step_s * 10.0 * ahead
    scan = perceived(tracks=tracks)
    (each,), (path,) = (make(scan).objects for make in (MESSAGES.tracked_objects, MESSAGES.predicted_objects))
    twist = each.kinematics.twist_with_covariance.twist
    along = rotation(each.kinematics.pose_with_covariance.pose) @ [twist.linear.x, twist.linear.y, twist.linear.z]
    np.testing.assert_allclose(R @ along, 10.0 * ahead, atol=0.6)
    assert twist.angular.z == pytest.approx(turn_rps * R[2, 2], abs=0.06)
    first, last = (np.array(position(path.kinematics.predicted_paths[0].path[k])) for k in (0, 6))
    turned = heading + np.array([0.0, 3.0 * turn_rps])  # on an arc of 33 m
    arc = 10.0 / turn_rps * np.array([*np.diff(np.sin(turned)), *-np.diff(np.cos(turned)), 0.0])
    np.testing.assert_allclose(R @ (last - first), arc, atol=2.0)
    texts = [marker.text for marker in MESSAGES.markers(scan).markers if marker.ns == "track_labels"]
    assert float(texts[0].split()[2]) == pytest.approx(10.0, abs=0.3)


@pytest.mark.parametrize(
    ("label", "number"),
    [("car", 1), ("van", 1), ("truck", 2), ("bus", 3), ("cyclist", 6), ("pedestrian", 7), ("tram", 0), ("sofa", 0)],
)
def test_classes_of_autoware(label: str, number: int) -> None:
    scan = perceived(boxes=(replace(BOXES[0], label=label, front=0.8),))
    (found,) = again(MESSAGES.detected_objects(scan)).objects
    assert [(c.label, c.probability) for c in found.classification] == [(number, 1.0)]
    assert found.kinematics.orientation_availability == 2


def test_ids_of_autoware_last_as_long_as_tracks() -> None:
    scans = [perceived(tracks=tracked(k)) for k in (5, 6)]
    first, second = ([bytes(o.object_id.uuid) for o in MESSAGES.tracked_objects(scan).objects] for scan in scans)
    assert first == second
    assert len({*first}) == 2
    none = perceived()
    assert not MESSAGES.tracked_objects(none).objects
    assert not MESSAGES.predicted_objects(none).objects


def test_diagnostics() -> None:
    message = again(MESSAGES.diagnostics(replace(perceived(), health="LATE"), values={"dropped": 3}))
    (status,) = message.status
    assert (status.level, status.name, status.message, status.hardware_id) == (
        1,
        "edgeperc: perception",
        "LATE",
        "hdl-64e",
    )
    values = {v.key: v.value for v in status.values}
    assert values == {
        "dropped": "3",
        "points": str(len(POINTS)),
        "points not finite": "2",
        "boxes": "2",
        "drivable [m2]": "560.0",
        "project [ms]": "1.2",
        "infer [ms]": "30.0",
        "provider of pointseg": "pointseg int8, CPUExecutionProvider",
        "labels": "0 background, 1 car, 2 pedestrian, 3 cyclist",
        "unlike the training scans 1": "few points",
    }
    wet = edgeperc.SensorHealth(has_drops=True, n_drops=7, findings=("It rains.",))
    scan = perceived()
    for health, level in (("OK", 1), ("LATE", 1), ("STALE", 3)):
        rainy = replace(scan, perception=replace(scan.perception, health=wet), health=health)
        (status,) = again(MESSAGES.diagnostics(rainy)).status
        values = {v.key: v.value for v in status.values}
        assert (status.level, values["sensor 1"], values["drops left out"]) == (level, "It rains.", "7")
    (none,) = MESSAGES.diagnostics(None).status
    assert (none.level, none.message, none.values) == (3, "no scan yet", [])


@given(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_stamps_keep_their_nanoseconds(stamp_ns: int) -> None:
    stamp = again(MESSAGES.markers(perceived(), stamp_ns)).markers[0].header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns


@pytest.mark.parametrize("stamp_s", [math.nan, math.inf, 1e10, -1e10])
def test_stamps_that_ros_cannot_hold(stamp_s: float) -> None:
    with pytest.raises(edgeperc.PointsError, match=r"stamp|time"):
        MESSAGES.points(perceived(stamp_s))


@given(st.binary(max_size=300))
def test_bytes_that_are_no_message(data: bytes) -> None:
    with pytest.raises(edgeperc.PointsError, match="expected one in CDR"):
        MESSAGES.decode(data, CLOUD)


def read_bag(folder: Path) -> list[tuple[str, str, int, bytes]]:
    """Topic, type, time [ns] and bytes of each message, by rosbags' reader."""
    from rosbags.rosbag2 import Reader

    with Reader(folder) as reader:
        return [(c.topic, c.msgtype, stamp, bytes(raw)) for c, stamp, raw in reader.messages()]


def storages() -> list[str]:
    import inspect

    from rosbags.rosbag2 import Writer

    return ["sqlite3", "mcap"] if "storage_plugin" in inspect.signature(Writer).parameters else ["sqlite3"]


@pytest.mark.parametrize("storage", storages())
def test_a_bag_holds_what_went_in(tmp_path: Path, storage: Any) -> None:
    scans = [perceived(100.0 + 0.1 * k, tracked(k + 5)) for k in range(3)]
    sink = BagSink(tmp_path / "bag", storage=storage, frame_id="lidar_top")
    for scan in scans:
        sink.write(scan)
    sink.close()
    sink.close()
    held = read_bag(tmp_path / "bag")
    assert len(held) == 3 * len(OUTPUTS)
    for name, kind in OUTPUTS.items():
        of_topic = [(kind_, stamp, raw) for topic, kind_, stamp, raw in held if topic == TOPICS[name]]
        expected = [(kind, nanoseconds(s.stamp_s), MESSAGES.encode(getattr(MESSAGES, name)(s))) for s in scans]
        assert of_topic == expected
    for (stamp_s, points), scan in zip(edgeperc.read_scans(tmp_path / "bag"), scans, strict=True):
        assert stamp_s == pytest.approx(scan.stamp_s, abs=1e-6)
        np.testing.assert_array_equal(points, POINTS)


def test_a_bag_overwrites_nothing(tmp_path: Path) -> None:
    for there in (tmp_path / "folder", tmp_path / "file"):
        there.mkdir() if there.name == "folder" else there.write_text("")
        with pytest.raises(edgeperc.OptionError, match="exists; a bag does not overwrite"):
            BagSink(there)
    for name in ("drive #2", "drive?", "50%25"):  # in a URI, the end of a path, or another character
        with pytest.raises(edgeperc.OptionError, match="rosbags writes no sqlite3 at"):
            BagSink(tmp_path / name / "bag")


def test_without_a_scan_there_is_no_bag(tmp_path: Path) -> None:
    BagSink(tmp_path / "bag").close()
    sink = BagSink(tmp_path / "bag")
    with pytest.raises(edgeperc.PointsError):
        sink.write(perceived(math.nan))
    sink.close()
    assert not (tmp_path / "bag").exists()


def test_a_scan_that_cannot_be_written_leaves_the_bag_whole(tmp_path: Path) -> None:
    sink = BagSink(tmp_path / "bag")
    sink.write(perceived(1.0))
    with pytest.raises(edgeperc.PointsError):
        sink.write(perceived(1e10))
    sink.write(perceived(2.0))
    sink.close()
    assert len(read_bag(tmp_path / "bag")) == 2 * len(OUTPUTS)


@pytest.mark.parametrize("storage", storages())
@pytest.mark.parametrize("size_kib", [64, 400])
def test_a_full_disk_leaves_a_part_with_the_scans_before(
    tmp_path: Path, small_disk: Callable[[int], Path], storage: Any, size_kib: int
) -> None:
    sink, n = BagSink(small_disk(size_kib) / "bag", storage=storage), 0
    scan = perceived(1.0)
    with pytest.raises(OSError, match=r"full|No space"):  # noqa: PT012
        for n in range(1000):
            sink.write(replace(scan, stamp_s=float(n)))
    with pytest.raises(OSError, match=r"full|No space"):
        sink.write(scan)
    with pytest.warns(RuntimeWarning, match=r"bag\.part"):
        sink.close()
    (part,) = (tmp_path / "disk").iterdir()
    assert part.name == "bag.part"
    assert not (part / "metadata.yaml").exists()  # they would promise what is not there
    if storage == "sqlite3" and n:
        assert [stamp_s for stamp_s, _ in edgeperc.read_scans(part)] == [*map(float, range(n))]


def test_an_old_rosbags_writes_no_mcap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Writer:
        def __init__(self, path: Path) -> None: ...

    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", SimpleNamespace(Writer=Writer))
    with pytest.raises(edgeperc.OptionError, match="sqlite3"):
        BagSink(tmp_path / "bag", storage="mcap")


def test_from_scans_to_a_bag_and_from_the_bag_to_a_bag(tmp_path: Path, shell: Shell) -> None:
    """The command line, with the shipped models; a bag is an input as well."""
    pytest.importorskip("onnxruntime")
    for name in ("drive/0.bin", "drive/1.bin"):
        write_scan(tmp_path / name, 500)
    options = ("--sensor", "hdl-64e", "--on-mismatch", "ignore", "--mount-height", "1.73")
    first, second = tmp_path / "first", tmp_path / "second"
    assert run("run", tmp_path / "drive", *options, "--track", "--bag", first) == 0
    assert run("run", first, *options, "--topic", TOPICS["points"], "--bag", second, "--bag-frame", "velodyne") == 0
    assert "exists; a bag does not overwrite it" in shell.err("run", first, *options, "--bag", second)
    bags = [read_bag(first), read_bag(second)]
    assert [len(bag) for bag in bags] == [2 * len(OUTPUTS)] * 2
    clouds = [[MESSAGES.decode(raw, CLOUD) for topic, _, _, raw in bag if topic == TOPICS["points"]] for bag in bags]
    assert [cloud.header.frame_id for each in clouds for cloud in each] == ["lidar"] * 2 + ["velodyne"] * 2
    for before, after in zip(*clouds, strict=True):
        assert bytes(before.data) == bytes(after.data)
        assert before.header.stamp == after.header.stamp
    np.testing.assert_array_equal(
        cloud_points(clouds[0][0]), np.fromfile(tmp_path / "drive/0.bin", np.float32).reshape(-1, 4)
    )
