"""Bags of drivers that recorded packets: decoded as from a capture; those that are not are named."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writers import check_same, mcap_channel, mcap_message, sized, vlp16_packets, write_pcap, write_records
from hypothesis import given
from hypothesis import strategies as st
from lidar_writers import MODELS, blocks_of, calibration, difop, packets_of, ranges, unit_angles
from test_captures import LIDAR, messages
from test_identify import velodyne
from test_ouster_packets import METADATA, random_packets
from test_ouster_packets import record as write_capture

from cli_helpers import Shell
from edgeperc import PointsError, SensorError, read_scans, read_timed_scans, sensor_of
from edgeperc.readers.clouds import CLOUD_READERS
from edgeperc.readers.packet_messages import PACKET_READERS, LidarPackets, OusterPacket, VelodyneScan
from edgeperc.types.sensor import SENSORS

pytestmark = pytest.mark.usefixtures("in_this_process")

SCAN = "velodyne_msgs/msg/VelodyneScan"
PACKETS = "/velodyne_packets"


def ros2_message(packets: Sequence[bytes], first: int, order: str = "<") -> bytes:
    """CDR by its specification: numbers at multiples of their size, a fixed array without its length."""
    content = struct.pack(order + "iI", 1000, 10**6 * first) + struct.pack(order + "I", 9) + b"velodyne\0"
    content += bytes(-len(content) % 4) + struct.pack(order + "I", len(packets))
    for k, packet in enumerate(packets, start=first):
        content += bytes(-len(content) % 4) + struct.pack(order + "iI", 1000, 10**6 * k) + packet
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + content


def ros1_message(packets: Sequence[bytes], first: int) -> bytes:
    content = struct.pack("<IIII", 7, 1000, 10**6 * first, 8) + b"velodyne" + struct.pack("<I", len(packets))
    return content + b"".join(
        struct.pack("<II", 1000, 10**6 * k) + packet for k, packet in enumerate(packets, start=first)
    )


def mcap_of(path: Path, topics: Sequence[tuple[str, str, str, Sequence[bytes]]], step_ns: int = 1) -> Path:
    """MCAP without an index: topic, type, encoding and messages."""
    content = b""
    for k, (topic, kind, encoding, sent) in enumerate(topics, start=1):
        content += mcap_channel(k, topic, kind, encoding)
        content += b"".join(mcap_message(k, n, 10**12 + step_ns * n, message) for n, message in enumerate(sent))
    return write_records(path, content)


def ros1_bag(path: Path, topics: Sequence[tuple[str, str, str, Sequence[bytes]]], step_ns: int = 1) -> Path:
    def fields(**values: bytes) -> bytes:
        return sized(b"".join(sized(name.encode() + b"=" + value) for name, value in values.items()))

    content = (
        b"#ROSBAG V2.0\n" + fields(op=b"\3", index_pos=bytes(8), conn_count=bytes(4), chunk_count=bytes(4)) + sized(b"")
    )
    for k, (topic, kind, _, sent) in enumerate(topics):
        number = struct.pack("<I", k)
        content += fields(op=b"\7", conn=number, topic=topic.encode()) + fields(
            topic=topic.encode(), type=kind.encode()
        )
        for n, message in enumerate(sent):
            content += fields(op=b"\2", conn=number, time=struct.pack("<II", 1000, step_ns * n)) + sized(message)
    # The index, which is empty, begins at the end of the file.
    path.write_bytes(content.replace(b"index_pos=" + bytes(8), b"index_pos=" + struct.pack("<Q", len(content)), 1))
    return path


def split(packets: Sequence[bytes], size: int, message: Callable[[Sequence[bytes], int], bytes]) -> list[bytes]:
    return [message(packets[k : k + size], k) for k in range(0, len(packets), size)]


WRITERS: dict[str, Callable[[Path, Sequence[bytes], int], Path]] = {
    "ROS 2": lambda folder, packets, size: mcap_of(
        folder / "a.mcap", [(PACKETS, SCAN, "cdr", split(packets, size, ros2_message))]
    ),
    "big-endian": lambda folder, packets, size: mcap_of(
        folder / "b.mcap", [(PACKETS, SCAN, "cdr", split(packets, size, lambda some, k: ros2_message(some, k, ">")))]
    ),
    "ROS 1": lambda folder, packets, size: ros1_bag(
        folder / "c.bag", [(PACKETS, "velodyne_msgs/VelodyneScan", "ros1", split(packets, size, ros1_message))]
    ),
    "ROS 1 in MCAP": lambda folder, packets, size: mcap_of(
        folder / "d.mcap", [(PACKETS, "velodyne_msgs/VelodyneScan", "ros1", split(packets, size, ros1_message))]
    ),
}


def check_turns(path: Path, of_capture: Sequence[Any]) -> list[Any]:
    """The turns of a bag are those of a capture, on the clock of the messages."""
    of_bag = [*read_timed_scans(path)]
    assert check_same(of_bag, of_capture, clock=False) == 3
    for one, other in zip(of_bag, of_capture, strict=True):
        assert 1000.0 <= one.stamp_s < 1001.0
        np.testing.assert_allclose(one.times_s - one.stamp_s, other.times_s - other.stamp_s, atol=1e-6)
    return of_bag


@pytest.mark.parametrize("size", [1, 76, 1000])
@pytest.mark.parametrize("writer", WRITERS)
def test_packets_give_the_turns_of_a_capture(tmp_path: Path, writer: str, size: int) -> None:
    """However many of them the driver put into a message; with the clock of the messages."""
    packets = vlp16_packets(2.5)
    of_capture = [*read_timed_scans(write_pcap(tmp_path / "a.pcap", packets))]
    path = WRITERS[writer](tmp_path, packets, size)
    of_bag = check_turns(path, of_capture)
    assert [scan.stamp_s for scan in of_bag] == sorted(scan.stamp_s for scan in of_bag)  # type: ignore[type-var]
    assert sensor_of(path) is SENSORS["vlp-16"]


def test_the_driver_of_ros_writes_what_is_read(tmp_path: Path) -> None:
    """The layout by rosbags, from the definitions of the messages."""
    typesys = pytest.importorskip("rosbags.typesys")
    packets = vlp16_packets(0.1)
    for version, make, empty in ((1, ros1_message, "ROS1_NOETIC"), (2, ros2_message, "ROS2_HUMBLE")):
        store = typesys.get_typestore(typesys.Stores[empty])
        time = "time" if version == 1 else "builtin_interfaces/Time"
        store.register(
            typesys.get_types_from_msg(f"{time} stamp\nuint8[1206] data\n", "velodyne_msgs/msg/VelodynePacket")
        )
        store.register(
            typesys.get_types_from_msg("std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n", SCAN)
        )
        types = store.types

        def stamp(k: int, types: Any = types) -> Any:
            return types["builtin_interfaces/msg/Time"](sec=1000, nanosec=10**6 * k)

        packed = [
            types["velodyne_msgs/msg/VelodynePacket"](stamp=stamp(k), data=np.frombuffer(packet, np.uint8))
            for k, packet in enumerate(packets, start=3)
        ]
        counter = {"seq": 7} if version == 1 else {}
        header = types["std_msgs/msg/Header"](stamp=stamp(3), frame_id="velodyne", **counter)
        message = types[SCAN](header=header, packets=packed)
        written = store.serialize_ros1(message, SCAN) if version == 1 else store.serialize_cdr(message, SCAN)
        assert bytes(written) == make(packets, 3)


@pytest.mark.parametrize("key", [key for key in PACKET_READERS if key[0].endswith("VelodyneScan")])
@given(data=st.data())
def test_damaged_messages(key: tuple[str, str], data: st.DataObject) -> None:
    make = ros1_message if key[1] == "ros1" else ros2_message
    content = bytearray(make(vlp16_packets(0.05), 0))
    whole = PACKET_READERS[key](memoryview(bytes(content)))
    assert isinstance(whole, VelodyneScan)
    assert whole.header.frame_id == "velodyne"
    assert [bytes(packet) for _, packet in whole.packets] == vlp16_packets(0.05)
    for at in data.draw(st.lists(st.integers(0, 60), max_size=4)):
        content[at] = data.draw(st.integers(0, 255))
    cut = bytes(content[: data.draw(st.integers(0, len(content)))])
    with suppress(PointsError):
        found = PACKET_READERS[key](memoryview(cut))
        assert isinstance(found, VelodyneScan)
        assert all(len(packet) == 1206 for _, packet in found.packets)
        assert 1206 * len(found.packets) <= len(cut)


def test_clouds_come_first_and_a_topic_chooses(tmp_path: Path) -> None:
    store, sent = messages(pytest.importorskip("rosbags.typesys"), 2)
    clouds = [bytes(store.serialize_cdr(m, kind)) for _, kind, _, m in sent if kind.endswith("PointCloud2")]
    packets = split(vlp16_packets(1.2), 75, ros2_message)
    both = [(LIDAR, "sensor_msgs/msg/PointCloud2", "cdr", clouds), (PACKETS, SCAN, "cdr", packets)]
    path = mcap_of(tmp_path / "both.mcap", both)
    assert len([*read_scans(path)]) == len(clouds)
    assert sum(len(points) for _, points in read_scans(path, topic=PACKETS)) == len(vlp16_packets(1.2)) * 12 * 32
    two = mcap_of(tmp_path / "two.mcap", [("/left", SCAN, "cdr", packets), ("/right", SCAN, "cdr", packets[:1])])
    with pytest.raises(PointsError, match="there are /left, /right; choose one by topic"):
        next(iter(read_scans(two)))
    assert sum(len(points) for _, points in read_scans(two, topic="/right")) == 75 * 12 * 32


HEADER, MANY = "std_msgs/Header header\n", "{package}/{packet}[] packets\n"
# Type of the message, of its packets, their fields, and whose they are; the drivers' definitions.
LIDARS = {
    "pandar_msgs": ("PandarScan", "PandarPacket", "{time} stamp\nuint8[1500] data\nuint32 size\n", "pandarxt-32"),
    "hesai_lidar": ("PandarScan", "PandarPacket", "{time} stamp\nuint8[] data\nuint32 size\n", "pandar40p"),
    "hesai_ros_driver": ("UdpFrame", "UdpPacket", "{time} stamp\nuint8[] data\nuint32 size\n", "pandarxt-16"),
    "hesai_ros_driver, short": ("UdpFrame", "UdpPacket", "uint8[] data\nuint32 size\n", "ot128"),
    "nebula_msgs": ("NebulaPackets", "NebulaPacket", "{time} stamp\nuint8[] data\n", "pandarqt-64"),
    "rslidar_msg": ("RslidarPacket", "", "uint8 is_difop\nuint8 is_frame_begin\nuint8[] data\n", "helios-32"),
    "rslidar_msg, older": ("RslidarScan", "RslidarPacket", "{time} stamp\nuint8[1248] data\n", "rs-airy"),
    "rslidar_msgs": ("rslidarScan", "rslidarPacket", "{time} stamp\nuint8[1248] data\n", "rs-16"),
    "robosense_msgs": ("RobosenseScan", "RobosensePacket", "{time} stamp\nuint8[1248] data\nuint32 size\n", "rs-32"),
}


class Driver:
    """Messages of a driver, serialized by rosbags from their definitions."""

    def __init__(self, name: str, version: int) -> None:
        typesys = pytest.importorskip("rosbags.typesys")
        kind, packet, fields, self.model = LIDARS[name]
        package = name.partition(",")[0]
        self.version, self.packet, self.has_header = version, f"{package}/msg/{packet}", "short" not in name
        self.kind = f"{package}/msg/{kind}"
        self.store = typesys.get_typestore(typesys.Stores["ROS1_NOETIC" if version == 1 else "ROS2_HUMBLE"])
        fields = fields.format(time="time" if version == 1 else "builtin_interfaces/Time")
        body = MANY.format(package=package, packet=packet) if packet else fields
        if packet:
            self.store.register(typesys.get_types_from_msg(fields, self.packet))
        self.store.register(typesys.get_types_from_msg((HEADER if self.has_header else "") + body, self.kind))
        self.fixed = next((n for n in (1500, 1248) if f"[{n}]" in fields), 0)

    def type_of(self, kind: str) -> str:
        return kind if self.version == 2 else kind.replace("/msg/", "/")

    def write(self, kind: str, message: Any) -> bytes:
        written = (self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr)(message, kind)
        return bytes(written)

    def message(self, packets: Sequence[bytes], first: int) -> bytes:
        """Of packets that came every millisecond."""
        types = self.store.types

        def stamp(k: int) -> Any:
            return types["builtin_interfaces/msg/Time"](sec=1000, nanosec=10**6 * k)

        counter = {"seq": 7} if self.version == 1 else {}
        header = types["std_msgs/msg/Header"](stamp=stamp(first), frame_id="lidar", **counter)
        headers = {"header": header} if self.has_header else {}
        if not self.packet.rpartition("/")[2]:
            is_difop = packets[0][:1] == b"\xa5"
            data = np.frombuffer(packets[0], np.uint8)
            return self.write(self.kind, types[self.kind](is_difop=is_difop, is_frame_begin=0, data=data, **headers))
        made = []
        for k, packet in enumerate(packets, start=first):
            data = np.frombuffer(packet.ljust(self.fixed, b"\0"), np.uint8)
            values = {"stamp": stamp(k), "data": data, "size": len(packet)}
            kind = types[self.packet]
            made.append(kind(**{name: values[name] for name in kind.__dataclass_fields__ if name in values}))
        return self.write(self.kind, types[self.kind](packets=made, **headers))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", LIDARS)
def test_packets_of_other_drivers_give_the_turns_of_a_capture(tmp_path: Path, name: str, version: int) -> None:
    """With the angles of the unit: of a file beside the bag, or in packets of the topic, or in a topic of their own."""
    driver = Driver(name, version)
    model = MODELS[driver.model]
    firings = 2 if model.second == "firing" else 1
    blocks = blocks_of(model, *ranges(model, round(2.5 * 360 / model.step_deg) * firings))
    packets, angles = packets_of(model, blocks), unit_angles(model)
    says = [difop(model, angles)] if model.layout == ">" else []
    if not says and not model.name.startswith("pandarxt"):
        (tmp_path / "a.csv").write_text(calibration(angles))
    of_capture = [*read_timed_scans(write_pcap(tmp_path / "a.pcap", says + packets))]
    encoding, write = ("ros1", ros1_bag) if version == 1 else ("cdr", mcap_of)
    imu = bytes.fromhex("aa555a05").ljust(51, b"\0")  # of an Airy, among the packets with points
    size, own = (1, [imu, *says]) if not driver.packet.rpartition("/")[2] else (37, [])
    topics = [(PACKETS, driver.type_of(driver.kind), encoding, split(own + packets, size, driver.message))]
    if says and not own:
        kind = driver.packet if "robosense" not in name else "robosense_msgs/msg/RobosenseInfoPacket"
        head = b"" if version == 1 else b"\0\1\0\0"
        topics.append((f"{PACKETS}_difop", driver.type_of(kind), encoding, [head + bytes(8) + says[0]]))
    path = write(tmp_path / ("a.bag" if version == 1 else "a.mcap"), topics, 10**6 * size)
    of_bag = [*read_timed_scans(path)]
    assert check_same(of_bag, of_capture, clock=False) == 3
    for one, other in zip(of_bag, of_capture, strict=True):
        assert 1000.0 <= one.stamp_s < 1010.0
        np.testing.assert_allclose(one.times_s - one.stamp_s, other.times_s - other.stamp_s, atol=1e-6)
    sensor = sensor_of(path)
    assert sensor == sensor_of(tmp_path / "a.pcap")
    if says:
        without = [message for message in topics[0][3] if says[0] not in message]
        bare = write(tmp_path / "bare", [(*topics[0][:3], without)], 10**6)
        with pytest.raises(PointsError, match=r"angles of the lasers of this RoboSense .* are not known.*bare\.csv"):
            next(iter(read_scans(bare)))


def test_each_topic_of_packets_has_its_own_calibration(tmp_path: Path) -> None:
    """The angles of one sensor were those of the other, too."""
    driver, topics = Driver("hesai_ros_driver, short", 2), ["/front/packets", "/rear/packets"]
    files = [tmp_path / "a_front_packets.csv", tmp_path / "a_rear_packets.csv"]
    sent = []
    for topic, name in zip(topics, ("ot128", "jt128"), strict=True):
        model = MODELS[name]
        packets = packets_of(model, blocks_of(model, *ranges(model, round(450 / model.step_deg))))
        sent.append((topic, driver.kind, "cdr", split(packets, 37, driver.message)))
    path = mcap_of(tmp_path / "a.mcap", sent, 10**6)
    (tmp_path / "a.csv").write_text(calibration(unit_angles(MODELS["jt128"])))
    for topic, file in zip(topics, files, strict=True):
        for read in (lambda t: next(iter(read_scans(path, topic=t))), lambda t: sensor_of(path, topic=t)):
            with pytest.raises(PointsError, match=rf"a\.csv does not say of which sensor .* as {file.name}"):
                read(topic)
    for topic, file, name in zip(topics, files, ("ot128", "jt128"), strict=True):
        file.write_text(calibration(unit_angles(MODELS[name])))
        sensor = sensor_of(path, topic=topic)
        assert sensor is not None
        assert sensor.name == name
        up_deg = max(
            np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))).max() for _, p in read_scans(path, topic=topic)
        )
        assert up_deg == pytest.approx(sensor.fov_up_deg, abs=0.01)


@cache
def one_message(name: str) -> tuple[str, list[bytes], bytes]:
    """Its type, packets and bytes."""
    driver = Driver(name, 2)
    model = MODELS[driver.model]
    packets = packets_of(model, blocks_of(model, *ranges(model, 4 * model.blocks)))[:2]
    return driver.kind, packets, driver.message(packets[: 1 if not driver.packet.rpartition("/")[2] else 2], 0)


@pytest.mark.parametrize("name", LIDARS)
@given(data=st.data())
def test_damaged_messages_of_other_drivers(name: str, data: st.DataObject) -> None:
    kind, packets, sent = one_message(name)
    content, read = bytearray(sent), PACKET_READERS[kind, "cdr"]
    whole = read(memoryview(sent))
    assert isinstance(whole, LidarPackets)
    assert [bytes(packet) for _, packet in whole.packets] == packets[: len(whole.packets)]
    for at in data.draw(st.lists(st.integers(0, 60), max_size=4)):
        content[at] = data.draw(st.integers(0, 255))
    with suppress(PointsError):
        found = read(memoryview(bytes(content[: data.draw(st.integers(0, len(content)))])))
        assert sum(len(packet) for _, packet in found.packets) <= len(content)  # type: ignore[union-attr]


def test_a_velodynes_packets_of_nebula_are_a_velodynes(tmp_path: Path) -> None:
    packets = vlp16_packets(1.2)
    driver = Driver("nebula_msgs", 2)
    path = mcap_of(tmp_path / "a.mcap", [(PACKETS, driver.kind, "cdr", split(packets, 75, driver.message))])
    assert sum(len(points) for _, points in read_scans(path)) == len(packets) * 12 * 32
    assert sensor_of(path) is SENSORS["vlp-16"]


def test_a_sensor_that_is_not_decoded_is_named(tmp_path: Path) -> None:
    packet = bytes((0xEE, 0xFF, 4, 7, 0, 0, 128, 2, 0, 4, 1, 0)).ljust(1118, b"\0")
    driver = Driver("hesai_ros_driver", 2)
    path = mcap_of(tmp_path / "a.mcap", [(PACKETS, driver.kind, "cdr", [driver.message([packet], 0)])])
    for call in (lambda: next(iter(read_scans(path))), lambda: sensor_of(path)):
        with pytest.raises(PointsError, match="a capture of a Hesai ATX, which cannot be decoded"):
            call()


LIVOX_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
LIVOX_FIELDS = "uint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2", "livox_interfaces"])
def test_points_in_livox_own_type(tmp_path: Path, package: str, version: int) -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores["ROS1_NOETIC" if version == 1 else "ROS2_HUMBLE"])
    kind, of_point = f"{package}/msg/CustomMsg", f"{package}/msg/CustomPoint"
    store.register(typesys.get_types_from_msg(LIVOX_POINT, of_point))
    store.register(typesys.get_types_from_msg(f"{HEADER}{LIVOX_FIELDS}{package}/CustomPoint[] points\n", kind))
    types, rng = store.types, np.random.default_rng(3)
    sent, scans = [], []
    for k, n in enumerate((200, 0, 201)):
        xyz = rng.normal(0.0, 9.0, (n, 3)).astype(np.float32)
        remission, offsets = rng.integers(0, 256, n), np.sort(rng.integers(0, 10**8, n))
        points = [
            types[of_point](offset_time=int(t), x=x, y=y, z=z, reflectivity=int(r), tag=0, line=k)
            for t, (x, y, z), r in zip(offsets, xyz.tolist(), remission, strict=True)
        ]
        stamp = types["builtin_interfaces/msg/Time"](sec=1000, nanosec=10**8 * k)
        counter = {"seq": k} if version == 1 else {}
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="livox_frame", **counter)
        about = {"timebase": 10**12 + 10**8 * k, "point_num": n, "lidar_id": 1, "rsvd": np.zeros(3, np.uint8)}
        message = types[kind](header=header, points=points, **about)
        sent.append(bytes((store.serialize_ros1 if version == 1 else store.serialize_cdr)(message, kind)))
        scans.append((xyz, remission, 1000.0 + 0.1 * k + 1e-9 * offsets))
    path = tmp_path / ("a.bag" if version == 1 else "a.mcap")
    if version == 1:
        ros1_bag(path, [("/livox/lidar", f"{package}/CustomMsg", "ros1", sent)], 10**8)
    else:
        mcap_of(path, [("/livox/lidar", kind, "cdr", sent)], 10**8)
    found = [*read_timed_scans(path)]
    assert len(found) == 3
    for scan, (xyz, remission, times_s) in zip(found, scans, strict=True):
        np.testing.assert_array_equal(scan.points[:, :3], xyz)
        np.testing.assert_array_equal(scan.points[:, 3], remission)
        if len(xyz):
            np.testing.assert_allclose(scan.times_s, times_s, atol=1e-6)
    with pytest.raises(SensorError, match=r"of a Livox sensor, which does not spin, .*--sensor: mid-360"):
        sensor_of(path)
    with pytest.raises(PointsError, match="damaged"):
        CLOUD_READERS[(kind, "cdr") if version == 2 else (f"{package}/CustomMsg", "ros1")](memoryview(sent[0][:-1]))


OTHERS = {
    "pandar_msgs/PandarJumboPacket": "Hesai",
    "hesai_ros_driver/msg/LossPacket": "Hesai",
    "nebula_msgs/msg/RawPacketStamped": "Nebula",
    "robosense_msgs/msg/MsopPacket": "RoboSense",
    "livox_msgs/msg/LidarScan": "Livox",
}


@pytest.mark.parametrize("kind", OTHERS)
def test_other_packets_are_named_with_what_to_do(kind: str, tmp_path: Path, shell: Shell) -> None:
    path = mcap_of(
        tmp_path / "a.mcap", [("/packets", kind, "cdr", [bytes(9)]), ("/imu", "sensor_msgs/msg/Imu", "cdr", [])]
    )
    text = rf"topic /packets holds .*{OTHERS[kind]}.*\({kind}\).*record its sensor_msgs/PointCloud2"
    for call in (lambda: next(iter(read_scans(path))), lambda: sensor_of(path)):
        with pytest.raises(PointsError, match=text):
            call()
    assert OTHERS[kind] in shell.err("run", path, "--sensor", "pandar64", "--model", "pointseg", code=1)
    clouds = [("/points", "sensor_msgs/msg/PointCloud2", "cdr", []), ("/packets", kind, "cdr", [])]
    with pytest.raises(PointsError, match=text):
        next(iter(read_scans(mcap_of(tmp_path / "b.mcap", clouds), topic="/packets")))


def test_an_hdl64_in_a_bag_says_what_to_do(tmp_path: Path) -> None:
    packets = velodyne(0x05, 0x48, [b"\xff\xee", b"\xff\xdd"])
    path = WRITERS["ROS 2"](tmp_path, packets, 75)
    with pytest.raises(PointsError, match=r"HDL-64E.*velodyne_pointcloud"):
        next(iter(read_scans(path)))
    assert sensor_of(path) is SENSORS["hdl-64e"]


def test_packets_that_do_not_name_their_model(tmp_path: Path) -> None:
    with pytest.raises(SensorError, match="do not name the model"):
        sensor_of(WRITERS["ROS 1"](tmp_path, velodyne(0), 75))


def test_the_scans_before_the_damage_come(tmp_path: Path) -> None:
    packets = vlp16_packets(2.5)
    path = WRITERS["ROS 2"](tmp_path, packets, 75)
    path.write_bytes(path.read_bytes()[:-2000])
    scans = []
    with pytest.raises(PointsError, match="cut short"):  # noqa: PT012
        for _, points in read_scans(path):
            scans.append(points)
    assert sum(map(len, scans)) == 75 * (len(packets) // 75) * 12 * 32


def ouster_bag(folder: Path, version: str, packets: Sequence[bytes], metadata: str) -> Path:
    """Packets of the LiDAR and of its motion, and the metadata, as ouster-ros writes them."""
    kind = {
        "1": "ouster_ros/PacketMsg",
        "2": "ouster_sensor_msgs/msg/PacketMsg",
        "2, older": "ouster_ros/msg/PacketMsg",
    }[version]
    head = b"" if version == "1" else b"\0\1\0\0"
    text = metadata.encode() + (b"" if version == "1" else b"\0")
    encoding, of_text = ("ros1", "std_msgs/String") if version == "1" else ("cdr", "std_msgs/msg/String")
    topics = [
        ("/ouster/imu_packets", kind, encoding, [head + sized(bytes(48))]),
        ("/ouster/lidar_packets", kind, encoding, [head + sized(packet) for packet in packets]),
        *([("/ouster/metadata", of_text, encoding, [head + sized(text)])] if metadata else []),
    ]
    step_ns = 10**8 // 32  # a turn has 32 packets
    write, name = (ros1_bag, "a.bag") if version == "1" else (mcap_of, "a.mcap")
    return write(folder / name, topics, step_ns)


@pytest.mark.parametrize("version", ["1", "2", "2, older"])
def test_an_ousters_packets_give_the_turns_of_a_capture(tmp_path: Path, version: str) -> None:
    """With the clock of the messages."""
    packets = [packet for turn in random_packets(METADATA, 3, 4) for packet in turn]
    of_capture = [*read_timed_scans(write_capture(tmp_path, METADATA, packets))]
    path = ouster_bag(tmp_path, version, [bytes(packet.buf) for packet in packets], json.dumps(METADATA))
    of_bag = check_turns(path, of_capture)
    assert [len(points) for _, points in read_scans(path, remission_field="signal")] == [len(s.points) for s in of_bag]
    assert sensor_of(path).name == "os1-8"


@pytest.mark.parametrize(
    ("metadata", "error"),
    [
        ("", "has no metadata of the sensor; expected it as a text, topic /ouster/metadata"),
        ("{", "the Ouster's metadata in the bag cannot be read"),
        ("{}", "beam_altitude_angles is None; expected a list"),
    ],
)
def test_an_ousters_packets_without_metadata(tmp_path: Path, metadata: str, error: str) -> None:
    with pytest.raises(PointsError, match=error):
        next(iter(read_scans(ouster_bag(tmp_path, "2", [bytes(1000)], metadata))))


@pytest.mark.parametrize("key", [key for key in PACKET_READERS if key[0].endswith("PacketMsg")])
@given(content=st.binary(max_size=40), cut=st.integers(0, 8))
def test_damaged_packets_of_an_ouster(key: tuple[str, str], content: bytes, cut: int) -> None:
    head = b"" if key[1] == "ros1" else b"\0\1\0\0"
    whole = PACKET_READERS[key](memoryview(head + sized(content)))
    assert isinstance(whole, OusterPacket)
    assert bytes(whole.content) == content
    with suppress(PointsError):
        PACKET_READERS[key](memoryview((head + sized(content))[: len(head) + cut]))
    with pytest.raises(PointsError, match="damaged"):
        PACKET_READERS[key](memoryview(head + sized(content)[:-1] if content else head + b"\1"))
