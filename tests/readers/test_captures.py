"""Captures become scans, or `PointsError` says why not: synthetic ones made here, and real ones where there are any."""

from __future__ import annotations

import random
import struct
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from capture_writers import (
    CLOUD,
    TYPES,
    check_same,
    cloud_of,
    field,
    join,
    mcap_channel,
    mcap_message,
    ouster_frame,
    ouster_info,
    ros_cloud,
    vlp16_packets,
    write_link,
    write_ouster,
    write_pcap,
    write_records,
)

import edgeperc
from edgeperc.errors import MissingExtraError, PointsError
from edgeperc.readers.captures import is_capture, read_scans, scan_files
from edgeperc.readers.clouds import cloud_points
from edgeperc.readers.decoders import decode
from edgeperc.system.clock import nanoseconds_of
from edgeperc.types.sensor import SENSORS

pytestmark = pytest.mark.usefixtures("in_this_process")

POINTS = np.array(
    [[12.5, -3.25, -1.75, 0.25], [40.0, 8.5, 2.0, 99.0], [np.nan, 1.0, 1.0, 0.5], [5.0, np.inf, 0.0, 255.0]], np.float32
)


def check_told_apart(both: Path, alone: Mapping[str, Path]) -> None:
    """By its name, each sensor of a capture of several gives the points and the profile of its capture alone."""
    for topic, path in alone.items():
        check_same(read_scans(both, topic=topic), read_scans(path), clock=False)
        assert edgeperc.sensor_of(both, topic=topic) == edgeperc.sensor_of(path)


def check_beside(folder: Path, sent: Mapping[str, tuple[str, Sequence[bytes]]], metadata: str = "") -> None:
    """Sensors in one capture are told apart, whichever comes first: sender and packets by topic, an Ouster's last."""
    alone = {
        topic: write_link(folder / f"{k}.pcap", 1, packets, one=sender)
        for k, (topic, (sender, packets)) in enumerate(sent.items())
    }
    if metadata:
        for path in (folder / "both.pcap", [*alone.values()][-1]):
            path.with_suffix(".json").write_text(metadata)
    for parts in (alone.values(), reversed(alone.values())):
        both = join(folder / "both.pcap", parts)
        assert f"expected one LiDAR, there are {', '.join(alone)}; choose one" in error_of(both)
        check_told_apart(both, alone)


def error_of(path: Path, **options: Any) -> str:
    """What is said of a capture of which nothing can be read."""
    with pytest.raises(PointsError) as caught:
        next(read_scans(path, **options))
    assert str(path) in str(caught.value)
    return str(caught.value)


def decode_here(path: Path) -> Iterator[Any]:
    """Decode in this process, where a test can replace libraries."""
    return decode(path, path.suffix, None, None, lambda text: None, lambda: None)


def read_until_error(path: Path) -> tuple[list[Any], str]:
    scans: list[Any] = []
    with pytest.raises(PointsError) as caught:
        scans.extend(read_scans(path))
    return scans, str(caught.value)


FLOATS = (("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"))


def cloud(
    points: np.ndarray,
    layout: Sequence[tuple[str, str]] = FLOATS,
    *,
    order: str = "<",
    padding: int = 0,
    height: int = 1,
    row_padding: int = 0,
) -> SimpleNamespace:
    """A message's attributes, its bytes packed by struct, field by field."""
    columns = {"x": 0, "y": 1, "z": 2, "intensity": 3}
    codes = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
    fields, offset = [], 0
    for name, kind in layout:
        fields.append(field(name, offset, kind))
        offset += int(kind[1])
    step = offset + padding
    width = len(points) // height
    data = bytearray()
    for k, point in enumerate(points):
        for name, kind in layout:
            value = point[columns[name]] if name in columns else 7
            data += struct.pack(order + codes[kind], value if kind[0] == "f" else int(value))
        data += b"\xab" * padding
        if (k + 1) % width == 0:
            data += b"\xcd" * row_padding
    return cloud_of(fields, (height, width), step, bytes(data), row_padding, order)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("remission", [*TYPES])
@pytest.mark.parametrize("coordinate", ["f4", "f8"])
def test_clouds_of_any_type(order: str, remission: str, coordinate: str) -> None:
    points = POINTS.copy()
    points[:, 3] = [0, 1, 100, 127]
    layout = (("ring", "u2"), ("intensity", remission), ("z", coordinate), ("t", "f8"), ("x", coordinate), ("y", "f4"))
    got = cloud_points(cloud(points, layout, order=order, padding=5))
    assert got.dtype == np.float32
    assert got.flags.c_contiguous
    np.testing.assert_array_equal(got, points)


def test_clouds_of_whole_numbers() -> None:
    points = np.array([[1, -2, 3, 4], [-500, 600, -7, 8]], np.float32)
    layout = (("x", "i2"), ("y", "i4"), ("z", "i2"), ("intensity", "u1"))
    np.testing.assert_array_equal(cloud_points(cloud(points, layout)), points)


@pytest.mark.parametrize("row_padding", [0, 3, 16])
def test_organized_clouds_are_read_row_by_row(row_padding: int) -> None:
    message = cloud(POINTS, FLOATS, padding=4, height=2, row_padding=row_padding)
    np.testing.assert_array_equal(cloud_points(message), POINTS)
    message.data = message.data[: len(message.data) - row_padding]  # the last row's padding may be left out
    np.testing.assert_array_equal(cloud_points(message), POINTS)


def test_other_kinds_of_bytes_and_fields() -> None:
    message = cloud(POINTS, FLOATS, padding=12)
    message.fields += [field("descriptor", 16, "f4", count=3), field("x", 0, "f4", count=0)]
    for data in (message.data, bytearray(message.data), np.frombuffer(message.data, np.uint8)):
        message.data = data
        np.testing.assert_array_equal(cloud_points(message), POINTS)
    message.row_step = 0  # as some drivers write where there is one row
    np.testing.assert_array_equal(cloud_points(message), POINTS)


def test_remission_field_is_used() -> None:
    message = cloud(POINTS, (*FLOATS, ("reflectivity", "u2")))
    assert cloud_points(message, remission_field="reflectivity")[:, 3].tolist() == [7.0] * 4
    np.testing.assert_array_equal(cloud_points(message)[:, 3], POINTS[:, 3])
    assert cloud_points(cloud(POINTS, FLOATS[:3]))[:, 3].tolist() == [0.0] * 4
    with pytest.raises(PointsError, match="no numeric field 'echo'"):
        cloud_points(message, remission_field="echo")


@pytest.mark.parametrize("shape", [(0, 0), (1, 0), (0, 7)])
def test_empty_cloud_is_a_scan(shape: tuple[int, int]) -> None:
    message = cloud(POINTS)
    message.height, message.width = shape
    message.data = b""
    assert cloud_points(message).shape == (0, 4)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"data": b"\0" * 63}, "holds 63 bytes; expected 64"),
        ({"width": 5}, "expected 80"),
        ({"width": -1}, "declares 1 x -1 points"),
        ({"height": 3, "row_step": 8}, "in rows of 8"),
        ({"width": 2**60}, "holds 64 bytes"),
        ({"point_step": 8}, "layout is impossible"),
        ({"point_step": 0}, "layout is impossible"),
        ({"fields": []}, "no numeric field x, y, z"),
        ({"fields": [field("x", 0, "f4"), field("y", 4, "f4")]}, "no numeric field z among x, y"),
        ({"fields": [field("x", 0, "f4", 2), field("y", 4, "f4"), field("z", 8, "f4")]}, "no numeric field x"),
        ({"fields": [field("x", 2**40, "f4")]}, "layout is impossible"),
        ({"fields": [field("x", -4, "f4")]}, "layout is impossible"),
        ({"fields": [field("x", 2**31 - 1, "f4")]}, "'x' at byte 2147483647 is not within the 16 bytes of a point"),
        ({"fields": [*map(field, "xyz", (0, 4, 8), ["f4"] * 3), field("intensity", 2**31 - 4, "f8")]}, "is not within"),
        ({"fields": [field("x", 13, "f4")]}, "is not within"),
        ({"fields": None}, "layout is impossible"),
        ({"data": None}, "layout is impossible"),
        ({"height": "many"}, "layout is impossible"),
    ],
)
def test_malformed_clouds_are_refused(changes: dict[str, Any], error: str) -> None:
    message = cloud(POINTS)
    vars(message).update(changes)
    with pytest.raises(PointsError, match=error):
        cloud_points(message)
    with pytest.raises(PointsError, match="layout is impossible"):
        cloud_points(object())


LIDAR, OTHER = "/lidar/points", "/imu/text"
LAYOUT: Sequence[tuple[str, str]] = FLOATS


def messages(typesys: Any, ros: int) -> tuple[Any, list[tuple[str, str, int, Any]]]:
    """A type store, and (topic, type, time of recording [ns], message): three clouds and a word between."""
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if ros == 1 else typesys.Stores.ROS2_HUMBLE)
    types = store.types
    sent = []
    for k in range(3):
        source = cloud(POINTS + np.float32(k), LAYOUT, order="<>"[k % 2], padding=2)
        message = ros_cloud(types, source, (100 + k, 500_000_000) if k < 2 else (0, 0), k if ros == 1 else None)
        sent.append((LIDAR, CLOUD, (200 + k) * 10**9, message))
        sent.append((OTHER, "std_msgs/msg/String", (200 + k) * 10**9 + 1, types["std_msgs/msg/String"]("word")))
    return store, sent


def write_bag1(
    path: Path, renamed: Callable[[int, str], str] = lambda k, topic: topic, compression: str | None = None
) -> Path:
    typesys, rosbag1 = pytest.importorskip("rosbags.typesys"), pytest.importorskip("rosbags.rosbag1")
    store, sent = messages(typesys, 1)
    bag = rosbag1.Writer(path)
    if compression is not None:
        bag.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with bag:
        connections: dict[str, Any] = {}
        for k, (name, kind, stamp_ns, message) in enumerate(sent):
            topic = renamed(k, name)
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(connections[topic], stamp_ns, store.serialize_ros1(message, kind))
    return path


def write_bag2(folder: Path) -> Path:
    typesys, rosbag2 = pytest.importorskip("rosbags.typesys"), pytest.importorskip("rosbags.rosbag2")
    store, sent = messages(typesys, 2)
    newer = {"version": 8} if hasattr(rosbag2, "StoragePlugin") else {}
    with rosbag2.Writer(folder, **newer) as bag:
        connections = {
            topic: bag.add_connection(topic, kind, typestore=store)
            for topic, kind in dict.fromkeys((topic, kind) for topic, kind, _, _ in sent)
        }
        for topic, kind, stamp_ns, message in sent:
            bag.write(connections[topic], stamp_ns, store.serialize_cdr(message, kind))
    return folder


def write_mcap(path: Path, profile: bytes = b"ros2") -> Path:
    """MCAP by its specification: header, schemas, channels and messages, without chunks or an index."""
    store, sent = messages(pytest.importorskip("rosbags.typesys"), 2)
    content, channels = b"", [*dict.fromkeys((topic, kind) for topic, kind, _, _ in sent)]
    for k, (topic, kind) in enumerate(channels, start=1):
        definition, _ = store.generate_msgdef(kind, ros_version=2)
        content += mcap_channel(k, topic, kind, definition=definition.encode())
    for n, (topic, kind, stamp_ns, message) in enumerate(sent):
        number = channels.index((topic, kind)) + 1
        content += mcap_message(number, n, stamp_ns, bytes(store.serialize_cdr(message, kind)))
    return write_records(path, content, profile)


def write_mcap_folder(folder: Path) -> Path:
    folder.mkdir()
    write_mcap(folder / "bag_0.mcap")
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  relative_file_paths: [bag_0.mcap]\n")
    return folder


BAGS = {"ros1.bag": write_bag1, "ros2": write_bag2, "one.mcap": write_mcap, "mcap": write_mcap_folder}


@pytest.mark.parametrize("name", [*BAGS])
def test_bags(tmp_path: Path, name: str) -> None:
    """Three clouds of alternating byte order; the last has no stamp of its own, and the recorder's stands in."""
    path = BAGS[name](tmp_path / name)
    assert is_capture(path)
    for topic in (None, LIDAR):
        scans = list(edgeperc.read_scans(str(path), topic=topic))
        assert [stamp for stamp, _ in scans] == pytest.approx([100.5, 101.5, 202.0])
        assert [nanoseconds_of(stamp) for stamp, _ in scans] == [100_500_000_000, 101_500_000_000, 202_000_000_000]
        for k, (_, points) in enumerate(scans):
            np.testing.assert_array_equal(points, POINTS + np.float32(k))
    error = error_of(path, topic="/camera/points")
    assert f"no topic of type sensor_msgs/PointCloud2 '/camera/points'; there are {LIDAR}" in error
    assert f"of other types {OTHER} (std_msgs/{'' if name == 'ros1.bag' else 'msg/'}String)" in error


def test_a_bag_with_several_lidars_asks_which(tmp_path: Path) -> None:
    path = write_bag1(tmp_path / "two.bag", lambda k, topic: "/rear/points" if k == 2 else topic)
    error = error_of(path)
    assert f"expected one topic of type sensor_msgs/PointCloud2, there are {LIDAR}, /rear/points" in error
    assert "choose one by topic (--topic)" in error
    assert [stamp for stamp, _ in read_scans(path, topic="/rear/points")] == pytest.approx([101.5])
    assert len(list(read_scans(path, topic=LIDAR))) == 2


def test_bag_without_lidar_lists_its_topics(tmp_path: Path) -> None:
    typesys, rosbag1 = pytest.importorskip("rosbags.typesys"), pytest.importorskip("rosbags.rosbag1")
    store, sent = messages(typesys, 1)
    path = tmp_path / "text.bag"
    with rosbag1.Writer(path) as bag:
        connection = bag.add_connection(OTHER, "std_msgs/msg/String", typestore=store)
        bag.write(connection, 1, store.serialize_ros1(sent[1][3], "std_msgs/msg/String"))
    error = error_of(path)
    assert "expected one topic of type sensor_msgs/PointCloud2, there is none" in error
    assert f"{OTHER} (std_msgs/String)" in error
    empty = tmp_path / "empty.bag"
    with rosbag1.Writer(empty) as bag:
        bag.add_connection(LIDAR, "sensor_msgs/msg/PointCloud2", typestore=store)
    assert "damaged" in (error := error_of(empty)) or "no message" in error


@pytest.mark.parametrize("endian", ["<", ">"])
def test_a_velodyne_capture(tmp_path: Path, endian: str) -> None:
    gps = b"$GPRMC".ljust(512, b"\0")
    packets = vlp16_packets(2.5)
    path = write_pcap(tmp_path / "vlp16.pcap", [gps, *packets, gps], endian)
    scans = list(read_scans(path))
    assert sum(len(points) for _, points in scans) == len(packets) * 12 * 32
    assert len(scans) == 3  # two turns, and half a one
    assert 28_000 < len(scans[0][1]) <= len(scans[1][1]) + 400
    stamps = [stamp for stamp, _ in scans]
    assert stamps == sorted({*stamps})
    for _, points in scans:
        assert points.dtype == np.float32
        assert points.shape[1] == 4
        np.testing.assert_allclose(np.linalg.norm(points[:, :3], axis=1), 10.0, atol=0.06)  # lasers sit off the origin
        assert {*points[:, 3].tolist()} == {77.0}
    elevation = np.degrees(np.arcsin(scans[1][1][:, 2] / 10.0))
    assert (elevation.min(), elevation.max()) == pytest.approx((-15.0, 15.0), abs=0.2)
    # Clockwise from straight ahead, as Velodyne counts, and y is to the left.
    first = scans[0][1]
    azimuth = np.degrees(np.arctan2(first[:3000, 1], first[:3000, 0]))
    assert azimuth[0] == pytest.approx(0.0, abs=0.5)
    assert azimuth[-1] == pytest.approx(-3000 / 32 * 0.4, abs=1.0)


def hdl_64e_packets(n: int, calibration: bytes) -> list[bytes]:
    """Packets whose last two bytes are, one after another, values of the state, then those of a calibration."""
    state = [*zip(b"HMSDNYGTV", (1, 2, 3, 4, 5, 24, 0, 20, 7), strict=True)]
    told = [state[k] if k < len(state) else (ord("1"), calibration[(k - len(state)) % 1820]) for k in range(n)]
    return [
        b"".join(
            (b"\xff\xee", b"\xff\xdd")[block % 2]
            + struct.pack("<H", (6 * k + block // 2) * 18 % 36000)
            + struct.pack("<HB", 5000 + block, 51 + k % 7) * 32
            for block in range(12)
        )
        + struct.pack("<IBB", 1_000_000 + 288 * k, *each)
        for k, each in enumerate(told)
    ]


def test_an_hdl_64e_is_calibrated_and_scaled_as_kitti_is(tmp_path: Path) -> None:
    """By what its packets tell of it, from anywhere in that, and as velodyne-decoder reads the file by itself."""
    velodyne = pytest.importorskip("velodyne_decoder")
    lasers = [struct.pack("<B9h2B", k, *range(9 * k, 9 * k + 7), 0, 0, 0, 255).ljust(28, b"\xff") for k in range(64)]
    unknown = b"UNIT#" + bytes(2) + b"".join(lasers) + bytes(19) + struct.pack("<H", 1820)
    known = unknown[:-28] + bytes([24, 5, 6, 7, 8, 9]) + unknown[-22:]  # when it was calibrated
    path = write_pcap(tmp_path / "hdl64.pcap", hdl_64e_packets(1900, known[900:] + known[:900]))
    scans = list(decode_here(path))
    for (stamp, expected), (stamp_s, points, times_s) in zip(velodyne.read_pcap(str(path)), scans, strict=True):
        assert stamp_s == stamp.device
        np.testing.assert_array_equal(points[:, :3], expected[:, :3])
        np.testing.assert_array_equal(points[:, 3], expected[:, 3] / np.float32(255.0))
        np.testing.assert_array_equal(times_s, stamp.device + expected[:, 4].astype(np.float64))
    assert len(scans) == 7
    assert {*np.round(255.0 * scans[1][1][:, 3]).tolist()} == {*range(51, 58)}
    for calibration, n, why in (
        (known, 100, "Not enough metadata bytes in stream: 91 < 1820"),
        (unknown, 1900, "Calibration info not available in the metadata"),
        (known.replace(lasers[0], lasers[1], 1), 1900, "Invalid calibration data"),
    ):
        write_pcap(path, hdl_64e_packets(n, calibration))
        assert f"exact model and calibration could not be determined: {why}" in error_of(path)


@pytest.mark.parametrize(
    ("name", "product", "flags"),
    [("vls-128", 0xA1, b"\xee\xdd\xcc\xbb"), ("vlp-16-hi-res", 0x24, b"\xee"), ("vlp-32c", 0x28, b"\xee")],
)
def test_a_velodyne_has_the_beams_of_its_profile(tmp_path: Path, name: str, product: int, flags: bytes) -> None:
    pytest.importorskip("velodyne_decoder")
    blocks = [bytes([0xFF, flags[k % len(flags)]]) for k in range(12)]
    packets = [
        b"".join(
            flag + struct.pack("<H", (12 * n + k) // len(flags) * 20 % 36000) + struct.pack("<HB", 30_000, 7) * 32
            for k, flag in enumerate(blocks)
        )
        + struct.pack("<IBB", 1_000_000 + 200 * n, 0x37, product)
        for n in range(60)
    ]
    path = write_pcap(tmp_path / "any.pcap", packets)
    assert edgeperc.sensor_of(path).name == name
    points = np.concatenate([points for _, points in read_scans(path)]).astype(np.float64)
    seen = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    off_deg = np.abs(seen[:, None] - np.array(SENSORS[name].elevations_deg))
    assert off_deg.min(axis=1).max() < 0.06
    assert off_deg.min(axis=0).max() < 0.06


@pytest.fixture(scope="module")
def ouster(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with sphere.pcap, its metadata and sphere.osf: three turns of 64 x 512, every other column empty."""
    folder, info = tmp_path_factory.mktemp("ouster"), ouster_info()
    for name in ("sphere.pcap", "sphere.osf"):
        write_ouster(folder / name, info, [ouster_frame(info, k) for k in range(3)])
    return folder


@pytest.mark.parametrize("name", ["sphere.pcap", "sphere.osf"])
def test_an_ouster_capture(ouster: Path, name: str) -> None:
    scans = list(read_scans(ouster / name))
    assert [stamp for stamp, _ in scans] == pytest.approx([5.0998, 6.0998, 7.0998], abs=1e-4)  # of the last column
    for k, (_, points) in enumerate(scans):
        assert points.dtype == np.float32
        assert points.shape == (64 * 256, 4)  # what did not return is left out
        np.testing.assert_allclose(np.linalg.norm(points[:, :3] - [0, 0, 0.036], axis=1), 10.0, atol=0.05)
        assert {*points[:, 3].tolist()} == {40.0 + k}
    # A turn begins behind the sensor's back, clockwise: first to the left.
    assert scans[0][1][:8, 0].max() < -9.0
    assert (scans[0][1][2:40, 1] > 0.0).all()
    signal = [points[0, 3] for _, points in read_scans(ouster / name, remission_field="signal")]
    assert signal == [4000.0, 4001.0, 4002.0]
    assert "no field 'ECHO' for the remission" in error_of(ouster / name, remission_field="echo")
    assert "no LiDAR '17'; there are 991" in error_of(ouster / name, topic="17")
    assert len(list(read_scans(ouster / name, topic="991"))) == 3


def test_an_ouster_capture_without_its_metadata(ouster: Path, tmp_path: Path) -> None:
    path = tmp_path / "alone.pcap"
    path.write_bytes((ouster / "sphere.pcap").read_bytes())
    error = error_of(path)
    assert "metadata" in error
    assert ".json file whose name has the same beginning" in error
    (tmp_path / "alone.json").write_text("{}")
    assert "cannot be read" in error_of(path)


def test_an_ouster_capture_that_is_cut_short(ouster: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.pcap"
    content = (ouster / "sphere.pcap").read_bytes()
    path.write_bytes(content[: int(0.6 * len(content))])
    (tmp_path / "cut.json").write_text((ouster / "sphere.json").read_text())
    scans, error = read_until_error(path)
    assert len(scans) == 2
    assert len(scans[0][1]) == 64 * 256 > len(scans[1][1]) > 0
    assert "cut short or damaged: the file ends inside packet 58, at byte" in error


def test_damaged_osf_is_refused_before_the_sdk_opens_it(ouster: Path, tmp_path: Path) -> None:
    """The SDK ends the process on some of these."""
    path, content = tmp_path / "damaged.osf", (ouster / "sphere.osf").read_bytes()
    chance = random.Random(0)
    for _ in range(60):
        damaged = bytearray(content)
        for _ in range(chance.choice((1, 3, 200))):
            at = chance.randrange(len(damaged))
            damaged[at] ^= chance.randrange(1, 256)
        path.write_bytes(damaged)
        with pytest.raises(PointsError, match="block"):
            next(decode_here(path))
    at = 0
    while at < len(content):  # cut between blocks
        for end in (at, at + 6):
            path.write_bytes(content[:end])
            with pytest.raises(PointsError, match=r"cut short|cannot be read"):
                next(decode_here(path))
        at += 8 + struct.unpack_from("<I", content, at)[0]


def test_packets_without_a_lidar_are_refused(tmp_path: Path, ouster: Path) -> None:
    path = write_pcap(tmp_path / "other.pcap", [b"name server" * 9] * 7)
    assert "no points of a LiDAR" in error_of(path)
    with pytest.raises(PointsError, match=r"other\.pcap: no points of a LiDAR"):
        edgeperc.sensor_of(path)
    path.with_suffix(".json").write_text((ouster / "sphere.json").read_text())
    assert "has 7 packets, none from a supported LiDAR" in error_of(path)


@pytest.mark.parametrize(
    ("name", "content", "error"),
    [
        ("empty.pcap", b"", "cut short: 0 bytes"),
        ("header.pcap", struct.pack("<IHHIIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1), "no points of a LiDAR"),
        ("half.pcap", b"\xd4\xc3\xb2\xa1\x02\0\x04\0", "cut short: 8 bytes"),
        ("text.pcap", b"no capture at all, but text", "not a pcap file by its first bytes"),
        ("new.pcapng", b"\n\r\r\n" + bytes(40), "cut short or damaged: a section does not say its byte order"),
        ("new.pcap", b"\n\r\r\n" + bytes(40), "cut short or damaged: a section does not say its byte order"),
        ("text.pcapng", b"no capture at all, but text", "not a pcap file by its first bytes"),
        ("text.bag", b"no bag at all", "damaged"),
        ("empty.bag", b"", "damaged"),
        ("text.mcap", b"no capture at all", "damaged"),
        ("text.osf", b"no capture at all", "damaged"),
        ("empty.osf", b"", "damaged"),
        ("empty.lvx2", b"", "cut short"),
        ("lfs.pcap", b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        ("lfs.mcap", b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        ("packed.bag", b"\x1f\x8b\x08" + bytes(40), "this is an archive"),
        ("page.db3", b"<!DOCTYPE html><html>not found</html>", "a download may have failed"),
        ("text.db3", b"no database", "damaged or cut short: it begins with b'no database'"),
    ],
)
def test_files_that_are_not_captures_are_refused(tmp_path: Path, name: str, content: bytes, error: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(PointsError, match=error):
        next(read_scans(path))


@pytest.mark.parametrize(
    ("name", "extra", "modules"),
    [
        ("vlp16.pcap", "velodyne", ("velodyne_decoder",)),
        ("frames.osf", "ouster", ("ouster", "ouster.sdk", "ouster.sdk.osf")),
    ],
)
def test_missing_extra_names_the_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, extra: str, modules: Sequence[str]
) -> None:
    path = tmp_path / name
    path.write_bytes(b"")
    if path.suffix == ".pcap":
        write_pcap(path, vlp16_packets(0.1))
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"pip install 'edgeperc\[{extra}\]'"):
        next(decode_here(path))


def test_a_scan_file_is_one_scan(tmp_path: Path) -> None:
    POINTS.tofile(tmp_path / "a.bin")
    ((stamp, points),) = list(read_scans(tmp_path / "a.bin"))
    assert stamp is None
    np.testing.assert_array_equal(points, POINTS)
    assert not is_capture(tmp_path / "a.bin")
    assert not is_capture(tmp_path)
    assert not is_capture(tmp_path / "absent")
    with pytest.raises(PointsError, match="there is no such file or folder"):
        read_scans(tmp_path / "absent.pcap")


def test_a_folder_is_read_by_name(tmp_path: Path) -> None:
    for k, name in enumerate(("b.npy", "a.NPY", ".hidden.npy", "c.npy")):
        with (tmp_path / name).open("wb") as file:
            np.save(file, np.full((k + 1, 4), k, np.float32))
    (tmp_path / "notes.txt").write_text("no scan")
    (tmp_path / "folder.bin").mkdir()
    assert [file.name for file in scan_files(tmp_path)] == ["a.NPY", "b.npy", "c.npy"]
    assert [len(points) for _, points in read_scans(tmp_path)] == [2, 1, 4]
    (tmp_path / "b.npy").write_bytes(b"damaged")
    scans, error = read_until_error(tmp_path)
    assert len(scans) == 1
    assert "b.npy" in error
    with pytest.raises(PointsError, match="no scan in this folder"):
        next(read_scans(tmp_path / "folder.bin"))


@pytest.mark.parametrize("read", [read_scans, edgeperc.sensor_of, scan_files])
def test_what_the_system_refuses_is_a_typed_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], Any]
) -> None:
    """The folders of others, and names that are too long."""
    assert not is_capture(tmp_path / ("a" * 300))
    with pytest.raises(PointsError, match=r"a: (the file cannot be read|there is no such file)"):
        read(tmp_path / ("a" * 300))
    monkeypatch.setattr(Path, "is_file", Mock(side_effect=PermissionError(13, "Permission denied")))
    (tmp_path / "b.bin").touch()
    with pytest.raises(PointsError, match=r"the folder cannot be read \(.*Permission denied"):
        read(tmp_path)


@pytest.mark.parametrize(
    "names", [("1", "2", "10"), ("scan_9", "scan_010", "scan_10"), ("3.25", "3.5", "20.125"), ("1_9", "1_10", "a")]
)
def test_a_drive_is_read_in_the_order_of_its_numbers(tmp_path: Path, names: Sequence[str]) -> None:
    for k, name in enumerate(names):
        np.save(tmp_path / f"{name}.npy", np.full((1, 4), k, np.float32))
    assert [points[0, 0] for _, points in read_scans(tmp_path)] == [0, 1, 2]


def test_a_link_to_nowhere_is_a_scan_that_is_missing(tmp_path: Path) -> None:
    """As in a data set of git-annex of which only some files were fetched."""
    np.save(tmp_path / "a.npy", np.ones((3, 4), np.float32))
    for name, target in (("b.npy", "annex/b"), ("c.pcap", "c.pcap")):
        (tmp_path / name).symlink_to(target)
    assert [file.name for file in scan_files(tmp_path)] == ["a.npy", "b.npy", "c.pcap"]
    scans, error = read_until_error(tmp_path)
    assert len(scans) == 1
    assert "b.npy: a link to annex/b, which is not there: fetch its file (git annex get" in error
    assert edgeperc.sensor_of(tmp_path) is None
    for read in (edgeperc.read_points, read_scans):
        with pytest.raises(PointsError, match=r"c\.pcap: a link to c\.pcap, which is not there"):
            read(tmp_path / "c.pcap")
        with pytest.raises(PointsError, match="standard input is not read"):
            read("-")


def test_first_bytes_decide_the_format(tmp_path: Path) -> None:
    path = write_bag1(tmp_path / "drive.bag").rename(tmp_path / "drive.bag.1")
    assert is_capture(path)
    assert "there is none" not in error_of(path, topic="/nowhere")


@pytest.mark.parametrize(
    ("name", "sensor", "sizes", "beams", "most"),
    [
        ("velodyne/sample_velodyne_hdl32", "hdl-32e", [58169, 58078, 30458], (-31.0, 11.0), 255.0),
        ("velodyne/sample_velodyne_vlp16_gps", "vlp-16", [18790, 18701, 18678, 17317], (-15.5, 15.5), 190.0),
        ("ouster/OS-0-128-U1_v2.3.0_1024x10", "os0-128", [97299], (-47.0, 47.0), 255.0),
        ("ouster/OS-1-64_1024x10_fw20", "os1-64", [16749], (-19.0, 19.0), 255.0),
    ],
)
def test_real_captures(
    data_root: Callable[[str], Path], name: str, sensor: str, sizes: list[int], beams: tuple[float, float], most: float
) -> None:
    path = data_root("other_sensors") / f"{name}.pcap"
    profile, scans = edgeperc.sensor_of(path), list(edgeperc.read_timed_scans(path))
    assert (profile.name, profile is SENSORS[sensor]) == (sensor, name.startswith("velodyne"))
    assert [len(scan.points) for scan in scans] == sizes
    assert max(scan.points[:, 3].max() for scan in scans) == most
    for stamp_s, points, times_s in scans:
        assert 0.01 < np.ptp(times_s) < 0.12
        packet_s = 0.0014 if sensor == "vlp-16" else 0.001  # in which a turn ends
        assert times_s.max() == pytest.approx(stamp_s, abs=packet_s)
        assert np.isfinite(points).all()
        distance = np.linalg.norm(points[:, :3], axis=1)
        far = distance > 1.0  # nearer, a laser's own place in the housing shows in its elevation
        elevation = np.degrees(np.arcsin(points[far, 2] / distance[far]))
        assert beams[0] < elevation.min() < elevation.max() < beams[1]
    stamps = np.array([scan.stamp_s for scan in scans], np.float64)
    assert ((np.diff(stamps) > 0.04) & (np.diff(stamps) < 0.13)).all()


def test_real_metadata_that_is_malformed(data_root: Callable[[str], Path], tmp_path: Path) -> None:
    folder = data_root("other_sensors") / "ouster"
    path = tmp_path / "os0.pcap"
    path.write_bytes((folder / "OS-0-128-U1_v2.3.0_1024x10.pcap").read_bytes())
    for metadata in sorted((folder / "metadata_malformed").glob("*.json")):
        path.with_suffix(".json").write_bytes(metadata.read_bytes())
        assert "LiDAR" in (error := error_of(path)) or "cannot be read" in error
