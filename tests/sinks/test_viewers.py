"""Runs in the formats of viewers, read back by the formats' own readers."""

from __future__ import annotations

import base64
import json
import math
import os
import socket
import struct
import threading
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_pages import HOSTILE, perceived
from test_pictures import CAR, VAN, a_perception, a_scan, has_webgl, opened, opened_in_webgl, scene_of, unpacked

from cli_helpers import Shell, thinned
from edgeperc import Mounting, Tracker, read_scans
from edgeperc.errors import OptionError, PointsError
from edgeperc.records import PerceivedScan, Sink
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate_sequence
from edgeperc.sinks.foxglove import McapSink, ServeSink
from edgeperc.sinks.page import PageSink
from edgeperc.sinks.prelabels import PrelabelSink
from edgeperc.sinks.rerun import RerunSink
from edgeperc.sinks.rosbag import BagSink
from edgeperc.sinks.scene import colored_points, nanoseconds
from edgeperc.types.frame import ModelFrame, quaternion
from edgeperc.types.perception import Box
from edgeperc.types.sensor import get_sensor
from edgeperc.view import DrivePage
from edgeperc.view.colors import CLASS_COLORS
from edgeperc.view.content import box_corners
from scenes import rotation_of
from waiting import until

SENSOR = get_sensor("hdl-64e")
TILTED = Mounting(2.1, 5.0, -3.0, 90.0)


def a_run(n: int = 8, mounting: Mounting | None = None) -> list[PerceivedScan]:
    """Scans with a car that drives by, a van that stands, and their tracks; the sensor moves in the tracker's frame."""
    tracker, found = Tracker(), []
    for k in range(n):
        points = a_scan()[k:]
        moving = replace(CAR, center=(20.0 - k, 3.0, -0.9), front=0.9)
        boxes = (moving, VAN, Box("pedestrian", 0.7, (12.0, -3.0, -0.9), (0.5, 0.5, 1.7), 0.1))
        perception = replace(
            a_perception(a_scan()), n_points=len(points), boxes=boxes[: 2 + k % 2], stamp_s=10.0 + 0.1 * k
        )
        labels = perception.points
        labels = replace(labels, labels=labels.labels[k:], in_view=labels.in_view[k:])
        perception = replace(perception, points=labels, mounting=mounting or perception.mounting)
        pose = np.eye(4)
        pose[:2, 3] = 0.5 * k, 0.1 * k
        pose[:2, :2] = [[math.cos(0.01 * k), -math.sin(0.01 * k)], [math.sin(0.01 * k), math.cos(0.01 * k)]]
        tracks = tracker(perception, pose)
        found.append(PerceivedScan(f"drive/{k:03d}.bin", 10.0 + 0.1 * k, points, perception, tracks, SENSOR, "OK"))
    assert len(found[-1].tracks or ()) >= 2
    return found


def write(sink: Sink, scans: list[PerceivedScan]) -> None:
    for scan in scans:
        sink.write(scan)
    sink.close()


def decoded(schema: Any, data: bytes) -> Any:
    """A message, by the schema that the file or the server names."""
    if schema.encoding == "jsonschema":
        return json.loads(data)
    descriptor_pb2 = pytest.importorskip("google.protobuf.descriptor_pb2")
    from google.protobuf import descriptor_pool, message_factory

    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(data)


def read_mcap(path: Path) -> dict[str, list[tuple[int, Any, dict[str, str]]]]:
    """Messages of each topic: log time [ns], message, metadata of the channel."""
    reader = pytest.importorskip("mcap.reader")
    found: dict[str, list[tuple[int, Any, dict[str, str]]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file, validate_crcs=True).iter_messages():
            assert message.log_time == message.publish_time
            one = message.log_time, decoded(schema, message.data), channel.metadata
            found.setdefault(channel.topic, []).append(one)
    return found


def rows_of(packed: Any, stride: int) -> np.ndarray:
    """The packed elements of a message, by the fields that it describes."""
    kinds = {1: "u1", 7: "<f4"}
    fields = packed.fields
    dtype = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": [kinds[field.type] for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": stride,
        }
    )
    return np.frombuffer(packed.data, dtype)


def turned_by(rotation: Any) -> np.ndarray:
    """Matrix of a quaternion message."""
    return rotation_of(rotation.x, rotation.y, rotation.z, rotation.w)


def place(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


@pytest.fixture(scope="module")
def foxglove() -> None:
    pytest.importorskip("foxglove")


@pytest.mark.usefixtures("foxglove")
@pytest.mark.parametrize("mounting", [None, TILTED])
def test_mcap_holds_what_went_in(tmp_path: Path, mounting: Mounting | None) -> None:
    scans = a_run(mounting=mounting)
    write(McapSink(tmp_path / "run.mcap"), scans)
    topics = read_mcap(tmp_path / "run.mcap")
    assert {*topics} == {"/points", "/boxes", "/tracks", "/drivable", "/status", "/tf"}
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]
    for scan, (stamp_s, points) in zip(scans, read_scans(tmp_path / "run.mcap"), strict=True):
        assert stamp_s == pytest.approx(scan.stamp_s)
        np.testing.assert_array_equal(points, scan.points)
    for topic, messages in topics.items():
        assert [log_time for log_time, _, _ in messages] == [round(scan.stamp_s * 1e9) for scan in scans], topic
    for k, scan in enumerate(scans):
        check_points(scan, *topics["/points"][k][1:])
        check_boxes(scan, topics["/boxes"][k][1])
        check_tracks(scans[: k + 1], topics["/tracks"][k][1])
        check_drivable(scan, topics["/drivable"][k][1])
        check_frames(scan, topics["/tf"][k][1])
        status = topics["/status"][k][1]
        assert status["scan"] == scan.name
        assert (status["n_points"], status["n_boxes"]) == (len(scan.points), len(scan.perception.boxes))
        assert status["n_tracks"] == len(scan.tracks or ())
        assert status["stage_ms"] == scan.perception.stage_ms
        assert status["health"] == "OK"


def check_points(scan: PerceivedScan, message: Any, metadata: dict[str, str]) -> None:
    assert message.frame_id == "lidar"
    assert message.timestamp.ToNanoseconds() == round(scan.stamp_s * 1e9)
    rows = rows_of(message, message.point_stride)
    assert len(rows) == len(scan.points)
    for column, name in enumerate(("x", "y", "z", "remission")):
        np.testing.assert_array_equal(rows[name], scan.points[:, column])
    found = scan.perception.points
    np.testing.assert_array_equal(rows["class"], found.labels)
    assert json.loads(metadata["classes"]) == [*found.classes]
    colors = np.column_stack([rows[name] for name in ("red", "green", "blue")])
    for k, name in enumerate(found.classes[1:], 1):
        painted = {"#" + bytes(color).hex() for color in colors[found.labels == k]}
        assert painted == ({CLASS_COLORS[name]} if (found.labels == k).any() else set())
    background = {"#" + bytes(color).hex() for color in colors[found.labels == 0]}
    assert background == {CLASS_COLORS["background"], CLASS_COLORS["drivable"]}


def check_boxes(scan: PerceivedScan, message: Any) -> None:
    boxes = scan.perception.boxes
    assert [one.type for one in message.deletions] == [1]  # all
    assert len(message.entities) == len(boxes)
    assert len({entity.id for entity in message.entities}) == len(boxes)
    for k, (entity, box) in enumerate(zip(message.entities, boxes, strict=True)):
        (cube,) = entity.cubes
        assert entity.frame_id == "lidar"
        np.testing.assert_allclose(place(cube.pose.position), box.center)
        np.testing.assert_allclose(place(cube.size), box.size)
        np.testing.assert_allclose(turned_by(cube.pose.orientation)[:, 0], [math.cos(box.yaw), math.sin(box.yaw), 0])
        assert [text.text for text in entity.texts] == [f"{box.label} {box.score:.2f}"]
        assert len(entity.arrows) == (box.front is not None)
        color = [round(255 * value) for value in (cube.color.r, cube.color.g, cube.color.b)]
        assert f"#{bytes(color).hex()}" == CLASS_COLORS[box.label]
        sources = [int(id_) for id_, source in zip(scan.tracks.ids, scan.tracks.sources, strict=True) if source == k]
        assert entity.id == (f"track {sources[0]}" if sources else f"box {k}")


def check_tracks(scans: list[PerceivedScan], message: Any) -> None:
    tracks = scans[-1].tracks
    assert [entity.id for entity in message.entities] == [f"track {id_}" for id_ in tracks.ids]
    for entity, track in zip(message.entities, tracks, strict=True):
        assert entity.frame_id == "odom"
        edges, trail = entity.lines
        corners = {tuple(np.round(place(point), 6)) for point in edges.points}
        assert corners == {tuple(np.round(corner, 6)) for corner in box_corners(track.world_box)}
        past: list[Any] = []
        for scan in scans:
            seen = [other.world_box.center for other in scan.tracks or () if other.id == track.id]
            past = past + seen if seen else []
        np.testing.assert_allclose([place(point) for point in trail.points], past)
        assert entity.texts[0].text.startswith(f"#{track.id} {track.label} ")


def check_drivable(scan: PerceivedScan, message: Any) -> None:
    view = scan.perception.top_view
    assert message.frame_id == "base_link"
    cells = rows_of(message, message.cell_stride).reshape(-1, message.column_count)
    assert message.row_stride == message.cell_stride * message.column_count
    assert cells.shape == view.labels.shape[::-1]
    assert cells["drivable"].sum() == view.drivable.sum()
    for row, col in ((200, 100), (399, 0), (260, 65), (0, 199), (151, 61)):
        x, y = view.to_meters(row, col)
        column = int((x - message.pose.position.x) / message.cell_size.x)
        cell = cells[int((y - message.pose.position.y) / message.cell_size.y), column]
        assert cell["drivable"] == view.drivable[row, col]
        assert cell["class"] == view.labels[row, col]
        assert (cell["alpha"] > 0) == view.drivable[row, col]


def check_frames(scan: PerceivedScan, message: Any) -> None:
    """A point of the scan comes to the models' frame and to the tracker's."""
    by_child = {one.child_frame_id: one for one in message.transforms}
    assert {child: one.parent_frame_id for child, one in by_child.items()} == {
        "lidar": "base_link",
        "base_link": "odom",
    }
    p = np.array([3.0, -2.0, 0.5])
    frame, assert_close = ModelFrame(scan.perception.mounting), np.testing.assert_allclose
    in_base = turned_by(by_child["lidar"].rotation) @ p + place(by_child["lidar"].translation)
    assert_close(in_base, frame.R @ p + frame.t, atol=1e-9)
    in_world = turned_by(by_child["base_link"].rotation) @ in_base + place(by_child["base_link"].translation)
    assert_close(in_world, (scan.tracks.T_world_sensor @ [*p, 1.0])[:3], atol=1e-9)


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: sum(v * v for v in q) > 0.01))
def test_quaternion_of_any_rotation(numbers: list[float]) -> None:
    known = np.array(numbers) / np.linalg.norm(numbers)
    found = quaternion(rotation_of(*known))
    np.testing.assert_allclose(np.abs(np.dot(found, known)), 1.0)
    assert found[3] >= 0.0


@pytest.mark.usefixtures("foxglove")
def test_mcap_of_other_answers(tmp_path: Path) -> None:
    """Without a tracker, without classes of points, without a top view, without points; points of three columns."""
    (scan,) = a_run(8)[-1:]
    whole = replace(scan.perception, fitness=(), boxes=())
    scans = [
        replace(scan, tracks=None, health=None),
        replace(scan, perception=replace(whole, points=None), stamp_s=11.0),
        replace(scan, perception=replace(whole, top_view=None), stamp_s=12.0),
        replace(scan, points=scan.points[:, :3].astype(np.float64), stamp_s=13.0),
        replace(scan, points=scan.points[:0], perception=replace(whole, n_points=0, points=None), stamp_s=14.0),
    ]
    write(McapSink(tmp_path / "run.mcap"), scans)
    topics = read_mcap(tmp_path / "run.mcap")
    counts = [len(rows_of(message, message.point_stride)) for _, message, _ in topics["/points"]]
    assert counts == [len(one.points) for one in scans]
    assert len(topics["/tracks"]) == len(topics["/drivable"]) == 4
    assert len(topics["/tf"][0][1].transforms) == 1
    assert "n_tracks" not in topics["/status"][0][1]


@pytest.mark.usefixtures("foxglove")
def test_arrows_of_tracks_seen_by_a_tilted_sensor_are_as_long_as_their_way(tmp_path: Path) -> None:
    tracker, R, pose = Tracker(), Mounting(None, 0.0, 30.0).rotation(), np.eye(4)
    pose[:3, :3] = R
    for k in range(20):
        car = replace(CAR, center=tuple((R.T @ [5.0 + k, 2.0, -1.0]).tolist()), yaw=0.0, front=0.99)
        tracks = tracker.update([car], 10.0 + 0.1 * k, pose)
    write(McapSink(tmp_path / "run.mcap"), [replace(a_run()[0], tracks=tracks)])
    ((_, message, _),) = read_mcap(tmp_path / "run.mcap")["/tracks"]
    assert message.entities[0].arrows[0].shaft_length == pytest.approx(10.0, abs=0.3)
    assert " 10.0 m/s" in message.entities[0].texts[0].text


@pytest.mark.usefixtures("foxglove")
def test_names_are_only_text_in_mcap(tmp_path: Path) -> None:
    points = a_scan()
    scan = PerceivedScan(HOSTILE[13], 0.0, points, perceived(points, ("plain", *HOSTILE)), None, SENSOR)
    write(McapSink(tmp_path / "run.mcap"), [scan])
    topics = read_mcap(tmp_path / "run.mcap")
    assert all(entity.texts[0].text.isprintable() for entity in topics["/boxes"][0][1].entities)
    assert topics["/status"][0][1]["scan"].isprintable()


@pytest.mark.usefixtures("foxglove")
def test_mcap_refuses_and_keeps_the_old_file(tmp_path: Path) -> None:
    target, (scan,) = tmp_path / "run.mcap", a_run(8)[-1:]
    target.write_bytes(b"old")
    McapSink(target).close()
    assert target.read_bytes() == b"old"  # a run without an answer
    with pytest.raises(FileNotFoundError, match="folder"):
        McapSink(tmp_path / "absent" / "run.mcap")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(OptionError, match="pipe is a pipe"):
            McapSink(tmp_path / "pipe")
    sink = McapSink(target)
    with pytest.raises(PointsError, match="points and a perception"):
        sink.write(replace(scan, points=scan.points[1:]))
    for stamp_s in (-1.0, math.nan, math.inf, 2.0**32):
        with pytest.raises(PointsError, match="time"):
            sink.write(replace(scan, stamp_s=stamp_s))
    write(sink, [scan])
    assert len(read_mcap(target)["/points"]) == 1


class Viewer:
    """A client of Foxglove's WebSocket protocol, from a socket (RFC 6455)."""

    def __init__(self, url: str) -> None:
        host, _, port = url.removeprefix("ws://").rpartition(":")
        self._socket = socket.create_connection((host, int(port)), timeout=20.0)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [
            "GET / HTTP/1.1",
            f"Host: {host}:{port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Protocol: foxglove.sdk.v1",
        ]
        self._socket.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        self._file = self._socket.makefile("rb")
        assert b" 101 " in self._file.readline()
        while self._file.readline() not in (b"\r\n", b""):
            pass

    def receive(self) -> tuple[int, bytes]:
        """Opcode and payload of the next message."""
        kind, payload = 0, b""
        while True:
            first, second = self._file.read(2)
            size = second & 0x7F
            if size > 125:
                size = int.from_bytes(self._file.read(2 if size == 126 else 8), "big")
            kind, payload = kind or first & 0x0F, payload + self._file.read(size)
            if first & 0x80:
                return kind, payload

    def send(self, message: dict[str, Any]) -> None:
        data = json.dumps(message).encode()
        assert len(data) < 2**16
        head = bytes([0x81, 0x80 | len(data)]) if len(data) < 126 else b"\x81\xfe" + struct.pack(">H", len(data))
        self._socket.sendall(head + bytes(4) + data)  # a mask of zeros changes nothing

    def close(self) -> None:
        self._file.close()
        self._socket.close()


@pytest.fixture
def served() -> Iterator[Any]:
    pytest.importorskip("foxglove")
    sink = ServeSink(port=0)
    yield sink
    sink.close()


def test_a_viewer_receives_a_run(served: Any) -> None:
    scans = a_run()
    served.write(scans[0])  # nobody watches yet
    viewer, done, sender = Viewer(served.url), threading.Event(), None
    try:
        channels: dict[str, Any] = {}
        while len(channels) < 6:
            kind, payload = viewer.receive()
            if kind == 1 and json.loads(payload)["op"] == "advertise":
                channels |= {one["topic"]: one for one in json.loads(payload)["channels"]}
        wanted = [{"id": k, "channelId": one["id"]} for k, one in enumerate(channels.values())]
        viewer.send({"op": "subscribe", "subscriptions": wanted})
        found: dict[str, Any] = {}
        # Scans are sent until one arrives, because a scan before the subscription is not sent to this viewer.
        topics = [*channels]

        def send() -> None:
            for k in range(1, 200):
                served.write(replace(scans[1 + k % 7], stamp_s=10.0 + k))
                if done.wait(0.2):
                    return

        sender = threading.Thread(target=send)
        sender.start()
        while len(found) < 6:
            kind, payload = viewer.receive()
            if kind == 2 and payload[0] == 1:
                number, log_time = struct.unpack("<IQ", payload[1:13])
                found[topics[number]] = log_time, payload[13:]
        assert {*found} == {*channels}

        class Schema:
            encoding = channels["/points"]["schemaEncoding"]
            name = channels["/points"]["schemaName"]
            data = base64.b64decode(channels["/points"]["schema"])

        assert (Schema.encoding, Schema.name) == ("protobuf", "foxglove.PointCloud")
        log_time, data = found["/points"]
        sent = scans[1 + (log_time // 10**9 - 10) % 7]
        check_points(replace(sent, stamp_s=log_time / 1e9), decoded(Schema, data), channels["/points"]["metadata"])
        assert channels["/status"]["schemaName"] == "edgeperc.Status"
    finally:
        done.set()
        if sender is not None:
            sender.join()
        viewer.close()


def test_serving_is_local_and_a_taken_port_is_an_error(served: Any) -> None:
    host, _, port = served.url.removeprefix("ws://").rpartition(":")
    assert host == "127.0.0.1"
    with pytest.raises(OptionError, match=rf"{port}.*a free port"):
        ServeSink(port=int(port))
    with pytest.raises(OptionError, match="an address of this computer"):
        ServeSink("192.0.2.1", 0)
    # Only the loopback interface listens.
    other = socket.socket()
    try:
        other.bind(("127.0.0.2", int(port)))
    finally:
        other.close()


def read_rrd(path: Path) -> dict[str, dict[str, list[Any]]]:
    """Components of each entity of a recording, a list of one entry a log time."""
    chunk = pytest.importorskip("rerun.chunk")
    found: dict[str, dict[str, list[Any]]] = {}
    for part in chunk.RrdReader(path).stream():
        batch = part.to_record_batch()
        columns = found.setdefault(part.entity_path, {})
        for name in batch.schema.names:
            columns.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


def component(entity: dict[str, list[Any]], name: str) -> list[Any]:
    (key,) = [key for key in entity if key.rpartition(":")[2] == name]
    return [value for value in entity[key] if value is not None]


@pytest.mark.parametrize("mounting", [None, TILTED])
def test_rrd_holds_what_went_in(tmp_path: Path, mounting: Mounting | None) -> None:
    pytest.importorskip("rerun")
    scans = a_run(mounting=mounting)
    write(RerunSink(tmp_path / "run.rrd"), scans)
    assert [p.name for p in tmp_path.iterdir()] == ["run.rrd"]
    entities = read_rrd(tmp_path / "run.rrd")
    points = entities["/world/lidar/points"]
    context = component(entities["/world"], "context")[-1][0]
    names = {row["class_id"]: row["class_description"]["info"]["label"] for row in context}
    for k, scan in enumerate(scans):
        finite = scan.points[np.isfinite(scan.points).all(axis=1)]
        np.testing.assert_array_equal(component(points, "positions")[k], finite[:, :3])
        np.testing.assert_array_equal(component(points, "remission")[k], finite[:, 3])
        found = scan.perception.points
        labels = found.labels[np.isfinite(scan.points).all(axis=1)]
        assert [names[id_] for id_ in component(points, "class_ids")[k]] == [found.classes[v] for v in labels]
        # A box that a track has is apart, for the view shows the track's in its place.
        sources = scan.tracks.sources if scan.tracks is not None else ()
        for name, is_tracked in (("boxes", False), ("tracked", True)):
            boxes = entities[f"/world/lidar/{name}"]
            wanted = [box for i, box in enumerate(scan.perception.boxes) if (i in sources) == is_tracked]
            rows = [np.array(component(boxes, part)[k]).reshape(-1, 3) for part in ("centers", "half_sizes")]
            np.testing.assert_allclose(rows[0], np.reshape([box.center for box in wanted], (-1, 3)), rtol=1e-6)
            np.testing.assert_allclose(2 * rows[1], np.reshape([box.size for box in wanted], (-1, 3)), rtol=1e-6)
            turns = np.array(component(boxes, "quaternions")[k]).reshape(-1, 4)
            np.testing.assert_allclose(2 * np.arctan2(turns[:, 2], turns[:, 3]), [box.yaw for box in wanted], rtol=1e-6)
    assert any(component(entities["/world/lidar/tracked"], "centers"))
    assert {tuple(row) for row in component(entities["/world/trails"], "show_labels")} == {(False,)}
    shown = [scan.tracks for scan in scans if scan.tracks]
    centers = [row for row in component(entities["/world/tracks"], "centers") if row]
    assert [len(row) for row in centers] == [len(tracks) for tracks in shown]
    for row, tracks in zip(centers, shown, strict=True):
        np.testing.assert_allclose(row, [track.world_box.center for track in tracks], rtol=1e-5, atol=1e-5)
    mesh = entities["/world/lidar/drivable"]
    for k, scan in enumerate(scans):
        view, frame = scan.perception.top_view, ModelFrame(scan.perception.mounting)
        corners = np.array(component(mesh, "vertex_positions")[k]) @ frame.R.T + frame.t
        triangles = corners[np.array(component(mesh, "triangle_indices")[k])]
        sides = triangles[:, 1:, :2] - triangles[:, :1, :2]
        area = np.abs(np.linalg.det(sides)).sum() / 2
        assert area == pytest.approx(view.drivable_area_m2, rel=1e-3)
        np.testing.assert_allclose(corners[:, 2], -1.73, atol=1e-4)
    stamps = [value for value in points["stamp"]]
    assert {round(value.total_seconds(), 6) for value in stamps} == {round(scan.stamp_s, 6) for scan in scans}


@pytest.mark.parametrize(("name", "size_kib"), [("run.mcap", 512), ("run.rrd", 1024)])
def test_a_full_disk_is_an_error(name: str, size_kib: int, small_disk: Any) -> None:
    pytest.importorskip("foxglove" if name == "run.mcap" else "rerun")
    make = McapSink if name == "run.mcap" else RerunSink
    folder, scans = small_disk(size_kib), a_run()
    (folder / name).write_bytes(b"old")
    sink = make(folder / name)
    with pytest.raises(OSError, match="No space"):  # noqa: PT012
        for k in range(100):
            sink.write(replace(scans[k % 8], stamp_s=float(k)))
    with pytest.raises(OSError, match="No space"):
        sink.write(scans[0])
    with pytest.warns(RuntimeWarning, match=rf"{name}\.part"):
        sink.close()
    assert {p.name for p in folder.iterdir()} == {name, f"{name}.part"}
    assert (folder / name).read_bytes() == b"old"
    if name == "run.mcap":
        reading: Any = read_scans(folder / "run.mcap.part")
        with closing(reading):
            np.testing.assert_array_equal(next(reading)[1][:, :3], scans[0].points[:, :3])  # what there is of it


def read_page(path: Path) -> list[Any]:
    scans: list[Any] = scene_of(path)["scans"]
    return scans


def read_cvat(path: Path) -> list[Any]:
    with zipfile.ZipFile(path) as archive:
        items: list[Any] = json.loads(archive.read("annotations/default.json"))["items"]
    return items


def sinks_of_a_run(folder: Path) -> Iterator[tuple[Sink, str, Callable[[Path], list[Any]]]]:
    """Each sink that writes one file of a run; the file's name, and a list of its scans."""
    yield PageSink(folder / "run.html"), "run.html", read_page
    yield PrelabelSink(folder, "cvat"), "annotations.zip", read_cvat
    if find_spec("foxglove"):
        yield McapSink(folder / "run.mcap"), "run.mcap", lambda path: read_mcap(path)["/points"]
    if find_spec("rerun"):
        yield RerunSink(folder / "run.rrd"), "run.rrd", lambda path: read_rrd(path)["/world/lidar/points"]["stamp"]
    if find_spec("rosbags"):
        yield BagSink(folder / "bag"), "bag", lambda path: [*read_scans(path)]


@pytest.mark.parametrize("before", [b"of an older run", None])
def test_a_run_that_ends_early_replaces_nothing(tmp_path: Path, before: bytes | None) -> None:
    scans = a_run(3)
    for sink, name, read in sinks_of_a_run(tmp_path):
        target = tmp_path / name
        if before is not None and name != "bag":
            target.write_bytes(before)
        for scan in scans:
            sink.write(scan)
        with pytest.warns(RuntimeWarning, match=f"{name}.part"):
            sink.close(whole=False)
        assert len({str(each) for each in read(tmp_path / f"{name}.part")}) == 3  # and the part can be read
        assert (target.read_bytes() if target.exists() else None) == (None if name == "bag" else before)
        sink.close()
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".")]


def test_classes_of_a_run_that_ends_early_replace_no_list(tmp_path: Path) -> None:
    sink = PrelabelSink(tmp_path, "labelcloud")
    sink.write(a_run()[0])
    (tmp_path / "labels/_classes.json").write_text("of an older run")
    with pytest.warns(RuntimeWarning, match=r"_classes\.json\.part"):
        sink.close(whole=False)
    assert (tmp_path / "labels/_classes.json").read_text() == "of an older run"
    assert json.loads((tmp_path / "labels/_classes.json.part").read_text())["classes"]


def test_a_page_plays_the_drive(tmp_path: Path) -> None:
    scans = a_run(mounting=TILTED)
    write(PageSink(tmp_path / "drive.html"), scans)
    scene = scene_of(tmp_path / "drive.html")
    assert scene["times"] == pytest.approx([0.1 * k for k in range(8)])
    names = [one["name"] for one in scene["classes"]]
    for scan, shown in zip(scans, scene["scans"], strict=True):
        frame = ModelFrame(scan.perception.mounting)
        xyz, label = unpacked(shown)
        moved = frame.move(scan.points)
        moved = moved[np.isfinite(moved).all(axis=1)]
        assert len(xyz) == len(label) == len(moved)  # all are kept
        order = [np.lexsort(each.T) for each in (xyz, np.round(moved[:, :3], 2))]
        np.testing.assert_allclose(xyz[order[0]], moved[order[1], :3], atol=0.011)
        assert (label == names.index("pedestrian")).sum() == 100
        assert shown["name"] == scan.name
        # The boxes of tracks in place of theirs, and those of tracks that were not detected.
        n_coasting = int((scan.tracks.sources < 0).sum())
        assert len(shown["boxes"]) == len(scan.perception.boxes) + n_coasting
        assert sum(box["text"].startswith("#") for box in shown["boxes"]) == len(scan.tracks)
        # The trail ends where the track's box is.
        pose = np.array(shown["pose"])
        for (id_, *world), track in zip(shown["tracks"], scan.tracks, strict=True):
            assert id_ == track.id
            (box,) = frame.move_boxes([track.box])
            np.testing.assert_allclose(pose @ [*world, 1.0], box.center, atol=0.02)


def test_a_long_drive_stays_within_its_limit(tmp_path: Path) -> None:
    """Points are halved down to 3,000, then scans are left out; objects and far points are kept for longer."""
    points = np.tile(a_scan()[:-1], (4, 1)) * np.float32([1, 1, 1, 1])
    perception = a_perception(a_scan())
    labels = np.tile(perception.require_points().labels[:-1], 4)
    found = replace(perception.require_points(), labels=labels, in_view=np.ones(len(labels), bool))
    perception = replace(perception, n_points=len(points), n_dropped=0, points=found)
    page, limit = DrivePage(max_bytes=500_000), 500_000
    states = []
    for k in range(40):
        page.add(perception, points, 0.4 * k, name=str(k))
        states.append((page.n_points, page.every))
        assert page.n_bytes <= limit
    assert states[0] == (192_000, 1)
    assert [*dict.fromkeys(states)][-5:] == [(12_000, 1), (6000, 1), (3000, 1), (3000, 2), (3000, 4)]
    page.write(tmp_path / "drive.html")
    assert (tmp_path / "drive.html").stat().st_size <= limit + 40_000  # and the page itself
    scene = scene_of(tmp_path / "drive.html")
    assert [scan["name"] for scan in scene["scans"]] == [str(k) for k in range(0, 40, 4)]
    assert scene["times"] == [round(0.4 * k, 3) for k in range(0, 40, 4)]
    xyz, label = unpacked(scene["scans"][0])
    assert len(label) == 3000
    car = [one["name"] for one in scene["classes"]].index("car")
    assert (label == car).mean() > 1.5 * (labels == 1).mean()
    assert np.median(np.hypot(*xyz[label == 0, :2].T)) > np.median(np.hypot(*points[labels == 0, :2].T)) + 3.0


def test_times_of_a_page(tmp_path: Path) -> None:
    """Pauses are cut to a second, late scans take no time, none runs backwards. Each kind of warning is told."""
    page = DrivePage()
    for k, stamp_s in enumerate((5.0, 5.1, 4.95, 5.2, 100.0, 99.0, math.nan, 99.2)):
        page.add(replace(a_perception(a_scan()), fitness=(f"{k} rows", *["a room"] * (k > 6))), a_scan(), stamp_s)
    page.write(tmp_path / "drive.html")
    times = scene_of(tmp_path / "drive.html")["times"]
    assert times[:5] == pytest.approx([0.0, 0.1, 0.101, 0.201, 1.201])
    told = (tmp_path / "drive.html").read_text().split("<p class=warning>")[1:]
    assert [text.partition("<")[0] for text in told] == ["0 rows", "a room"]
    assert all(a < b for a, b in pairwise(times))


def test_no_scan_no_page(tmp_path: Path) -> None:
    PageSink(tmp_path / "drive.html").close()
    assert not [*tmp_path.iterdir()]


def test_names_are_only_text_on_the_page_of_a_drive(browser: Any, tmp_path: Path) -> None:
    points, path = a_scan()[5990:6700], tmp_path / "drive.html"
    pages = []
    for names in (HOSTILE, tuple(f"name {k}" for k in range(len(HOSTILE)))):
        page = DrivePage(title=names[0])
        for k, name in enumerate(names):
            perception = perceived(points, ("plain", *names))
            page.add(replace(perception, fitness=names[:5]), points, 0.02 * k, name=name)
        page.write(path)
        pages.append(path.read_text())
        assert pages[-1].count("<script") == 2
        if names is HOSTILE:
            (tmp_path / "hostile.html").write_text(pages[-1])
    shown, wrong = opened(browser, tmp_path / "hostile.html")
    if has_webgl(shown):
        for _ in HOSTILE:
            shown.keyboard.press(".")
        assert "18 of 18" in shown.inner_text("#now")
    assert shown.evaluate("window.stolen") is None
    assert not wrong
    shown.close()


def test_the_play_bar_plays(browser: Any, tmp_path: Path) -> None:
    # A second between scans, so that a slow browser is far from the end when the test pauses.
    write(PageSink(tmp_path / "drive.html"), [replace(scan, stamp_s=float(k)) for k, scan in enumerate(a_run())])
    page, wrong = opened_in_webgl(browser, tmp_path / "drive.html", viewport={"width": 1000, "height": 700})

    def at() -> int:
        return int(page.input_value("#at"))

    assert page.is_visible("#play")
    assert at() == 0
    page.keyboard.press(".")
    page.keyboard.press(".")
    page.keyboard.press(",")
    assert at() == 1
    assert "2 of 8 · drive/001.bin" in page.inner_text("#now")
    page.keyboard.press("End")
    assert at() == 7
    page.keyboard.press("Home")
    assert at() == 0
    facts = page.inner_text("#classes label >> nth=0")
    page.select_option("#speed", "0.25")
    page.keyboard.press("0")  # the list of speeds has the focus; other keys still work
    page.click("#toggle")
    until(lambda: at() >= 1)
    page.click("#toggle")
    paused = at()
    assert 1 <= paused < 7
    page.wait_for_timeout(600)
    assert at() == paused
    page.select_option("#speed", "4")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press(" ")
    until(lambda: at() == 7)
    until(lambda: page.inner_text("#toggle") == "▶")  # stops at the end
    page.select_option("#speed", "0.25")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press(" ")
    until(lambda: at() < 7)  # and begins again
    page.select_option("#speed", "4")
    until(lambda: at() == 7)
    assert page.inner_text("#classes label >> nth=0") != facts  # facts of another scan
    page.locator("#at").fill("3")
    assert "4 of 8" in page.inner_text("#now")
    assert not wrong
    page.close()


@pytest.mark.parametrize(("width", "height"), [(360, 640), (390, 844), (844, 390), (820, 1180)])
def test_the_page_on_a_touch_screen(browser: Any, tmp_path: Path, width: int, height: int) -> None:
    """The scene is free, everything is on the screen and reached by a finger."""
    path, screen = tmp_path / "a rather long name of a drive.html", {"width": width, "height": height}
    write(PageSink(path), a_run())
    page, wrong = opened_in_webgl(browser, path, viewport=screen, has_touch=True, is_mobile=True)

    def rectangle(name: str) -> tuple[float, float, float, float]:
        box = page.locator(name).bounding_box()
        return box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]

    small = min(width, height) < 700
    panel, bar, keys = (rectangle(name) for name in ("#panel", "#play", "footer"))
    assert page.evaluate("document.getElementById('panel').open") == (not small)
    assert panel[3] <= bar[1] <= bar[3] <= keys[1] <= keys[3] <= height
    if small:
        assert (panel[2] - panel[0]) * (panel[3] - panel[1]) < 0.15 * width * height
        assert bar[1] - panel[3] > 0.45 * height
    assert page.evaluate("document.documentElement.scrollWidth") == width
    assert "right-drag" not in page.inner_text("footer")
    for name in ("#back", "#toggle", "#ahead", "#at", "#speed", "#now"):
        left, top, right, bottom = rectangle(name)
        assert 0 <= left < right <= width
        assert bar[1] <= top < bottom <= bar[3]
    left, top, right, bottom = rectangle("#toggle")
    assert min(right - left, bottom - top) >= 40
    page.tap("#ahead")
    assert "2 of 8" in page.inner_text("#now")
    if small:
        page.tap("summary")
    opened = rectangle("#panel")
    assert 0 <= opened[0] < opened[2] <= width
    assert opened[3] <= bar[1]
    page.tap("#views button >> nth=1")
    page.tap("#layers label >> nth=0")
    assert not page.is_checked("#layers input >> nth=0")
    page.tap("summary")
    assert not page.evaluate("document.getElementById('panel').open")
    assert not wrong
    page.close()


def test_a_page_of_one_scan_has_no_play_bar(browser: Any, tmp_path: Path) -> None:
    write(PageSink(tmp_path / "drive.html"), a_run(8)[-1:])
    page, wrong = opened(browser, tmp_path / "drive.html")
    assert not page.is_visible("#play")
    assert "1 scan (all)" in page.content()
    assert not wrong
    page.close()


def test_a_drive_on_the_command_line(tmp_path: Path, shell: Shell) -> None:
    pytest.importorskip("foxglove")
    drive = tmp_path / "drive"
    drive.mkdir()
    counts = []
    for k, (_, _, scan) in enumerate(
        simulate_sequence(random_scene(4, "urban"), thinned(), 3, ego_speed_mps=5.0, seed=4)
    ):
        scan.points.tofile(drive / f"{k}.bin")
        counts.append(len(scan.points))
    options = ["--track", "--json", "--mcap", str(tmp_path / "run.mcap"), "--play", str(tmp_path / "run.html")]
    printed = shell.both("run", drive, *options, "--serve", "127.0.0.1:0")
    assert "open ws://127.0.0.1:" in printed.err
    records = [json.loads(line) for line in printed.out.splitlines()]
    topics = read_mcap(tmp_path / "run.mcap")
    assert [len(rows_of(one, one.point_stride)) for _, one, _ in topics["/points"]] == counts
    assert [len(one.entities) for _, one, _ in topics["/boxes"]] == [len(record["boxes"]) for record in records]
    assert [len(one.entities) for _, one, _ in topics["/tracks"]] == [len(record["tracks"]) for record in records]
    assert len(scene_of(tmp_path / "run.html")["scans"]) == 3
    assert "3 scans (all), with all points" in (tmp_path / "run.html").read_text()


@pytest.mark.parametrize("value", ["drive/", "localhost", "host:port", ":70000", "1.2.3.4:-1"])
def test_addresses_are_checked(value: str, tmp_path: Path, shell: Shell) -> None:
    (tmp_path / "0.bin").write_bytes(bytes(16))
    assert "expected HOST:PORT" in shell.err("run", tmp_path / "0.bin", "--serve", value)


def test_colors_and_times() -> None:
    (scan,) = a_run(8)[-1:]
    points, labels, classes, colors = colored_points(replace(scan, perception=replace(scan.perception, points=None)))
    assert classes == ("background",)
    assert not labels.any()
    assert len(points) == len(colors)
    assert nanoseconds(replace(scan, stamp_s=1.7e9)) == 1_700_000_000_000_000_000
