"""Captures and bags that several tests read: packets and MCAP by their specifications, the rest by other libraries."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

CLOUD = "sensor_msgs/msg/PointCloud2"
TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
MCAP_MAGIC = b"\x89MCAP0\r\n"

# Headers in front of the IP header, by the link type.
LINKS = {
    1: bytes(12) + b"\x08\x00",
    113: bytes(14) + b"\x08\x00",
    276: b"\x08\x00" + bytes(18),
    0: struct.pack("<I", 2),
    108: struct.pack(">I", 2),
    12: b"", 14: b"", 101: b"", 228: b"",
}  # fmt: skip


def check_same(found: Iterable[Any], expected: Iterable[Any], *, clock: bool = True) -> int:
    """Check that both give the same scans, to the bit, with ``clock`` at the same times; how many."""
    ours, theirs = list(found), list(expected)
    assert len(ours) == len(theirs) > 0
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one[1], other[1])
        if clock:
            assert one[0] == other[0]
            np.testing.assert_array_equal(one[2:], other[2:])
    return len(ours)


# --- packets ---------------------------------------------------------------------------------------------------------


def pcap_head(link: int = 1, order: str = "<") -> bytes:
    return struct.pack(order + "IHHIIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)


def pcap_record(k: int, frame: bytes, order: str = "<") -> bytes:
    """The record of a packet, which came k ms after 1000 s."""
    return struct.pack(order + "IIII", 1000 + k // 1000, 1000 * (k % 1000), len(frame), len(frame)) + frame


def records_of(content: bytes) -> list[bytes]:
    """The records of a pcap file, each with its header of 16 bytes."""
    at, found = 24, []
    while at + 16 <= len(content):
        end = at + 16 + struct.unpack_from("<I", content, at + 8)[0]
        found.append(content[at:end])
        at = end
    return found


def let_overtake(path: Path, first: int = 1) -> Path:
    """Every second packet of a capture comes behind the next one."""
    records = records_of(content := path.read_bytes())
    for k in range(first, len(records) - 1, 2):
        records[k : k + 2] = records[k + 1], records[k]
    path.write_bytes(content[:24] + b"".join(records))
    return path


def in_ip(payload: bytes, k: int = 0, sender: str = "192.168.1.201") -> bytes:
    """The k-th datagram of UDP of a sender, ``ADDRESS[:PORT]``, in IPv4."""
    address, _, port = sender.partition(":")
    udp = struct.pack(">HHHH", 2368, int(port or 2368), 8 + len(payload), 0) + payload
    head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), k % 65536, 0, 64, 17, 0)
    return head + socket.inet_aton(address) + b"\xff" * 4 + udp


def write_link(
    path: Path, link: int, payloads: Sequence[bytes], head: bytes | None = None, begin: int = 0, **sent: str
) -> Path:
    """UDP in IPv4 behind a link's header, 1 ms apart; by turns from each of several addresses, ``ADDRESS[:PORT]``.

    begin : how many packets the first sends alone.
    """
    senders, head = [*sent.values()] or ["192.168.1.201"], LINKS[link] if head is None else head
    records = (
        pcap_record(k, head + in_ip(payload, k, sender))
        for k, payload in enumerate(payloads)
        for sender in (senders if k >= begin else senders[:1])
    )
    path.write_bytes(pcap_head(link) + b"".join(records))
    return path


def write_pcap(path: Path, payloads: Sequence[bytes], order: str = "<") -> Path:
    """UDP in IPv4 in Ethernet, 1 ms apart."""
    records = (pcap_record(k, LINKS[1] + in_ip(payload, k), order) for k, payload in enumerate(payloads))
    path.write_bytes(pcap_head(1, order) + b"".join(records))
    return path


def join(path: Path, parts: Iterable[Path]) -> Path:
    """Write a capture of the packets of others, one after the other."""
    path.write_bytes(b"".join(part.read_bytes()[24 * (k > 0) :] for k, part in enumerate(parts)))
    return path


def vlp16_packets(n_turns: float, meters: float = 10.0, intensity: int = 77) -> list[bytes]:
    """A VLP-16 in a sphere: 12 blocks of two firings of 16 lasers a packet, 0.4 degrees from block to block."""
    hundredths = np.arange(int(n_turns * 900)) * 40
    returns = struct.pack("<HB", round(meters / 0.002), intensity) * 32
    packets = []
    for k in range(0, len(hundredths) - 11, 12):
        blocks = b"".join(b"\xff\xee" + struct.pack("<H", h % 36000) + returns for h in hundredths[k : k + 12])
        packets.append(blocks + struct.pack("<IBB", 1_000_000 + 1327 * (k // 12), 0x37, 0x22))
    return packets


def ouster_info() -> Any:
    """Of an Ouster with 64 beams and 512 columns, as ouster-sdk describes it."""
    core = pytest.importorskip("ouster.sdk.core")
    info = core.SensorInfo.from_default(core.LidarMode._512x10)
    info.sn = 991
    info.format.udp_profile_lidar = core.UDPProfileLidar.RNG19_RFL8_SIG16_NIR16
    info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503
    return info


def ouster_frame(info: Any, k: int = 0) -> Any:
    """The turn k of a sphere of 10 m, from 5 + k s on; every other column is empty."""
    core = pytest.importorskip("ouster.sdk.core")
    frame = core.LidarFrame(info)
    frame.frame_id = k + 1
    frame.field("RANGE")[:, 1::2] = 10_000  # mm
    frame.field("REFLECTIVITY")[:] = 40 + k
    frame.field("SIGNAL")[:] = 4000 + k
    frame.timestamp[:] = np.arange(512) * 195_312 + (5 + k) * 10**9
    frame.measurement_id[:] = np.arange(512)
    frame.packet_timestamp[:] = 10**18
    frame.status[:] = 1
    return frame


def write_ouster(path: Path, info: Any, frames: Sequence[Any], most: int | None = None) -> Path:
    """An .osf file, or a .pcap of the first packets with its metadata beside."""
    core, pcap, osf = (pytest.importorskip(f"ouster.sdk.{name}") for name in ("core", "pcap", "osf"))
    if path.suffix == ".osf":
        with osf.Writer(str(path), info) as writer:
            for frame in frames:
                writer.save(0, frame)
        return path
    layout = core.PacketFormat(info)
    packets = [p for frame in frames for p in core.frame_to_packets(frame, layout, info.init_id, info.sn)][:most]
    assert pcap.record(packets, str(path)) == len(packets)
    path.with_suffix(".json").write_text(info.to_json_string())
    return path


# --- bags ------------------------------------------------------------------------------------------------------------


def sized(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def record(opcode: int, content: bytes) -> bytes:
    return bytes([opcode]) + struct.pack("<Q", len(content)) + content


def mcap_channel(
    k: int, topic: str, kind: str, encoding: str = "cdr", definition: bytes = b"", schema: int | None = None
) -> bytes:
    """The records of a channel's schema and of the channel."""
    number, form = k if schema is None else schema, b"ros2msg" if definition else b""
    content = record(3, struct.pack("<H", number) + sized(kind.encode()) + sized(form) + sized(definition))
    return content + record(
        4, struct.pack("<HH", k, number) + sized(topic.encode()) + sized(encoding.encode()) + sized(b"")
    )


def mcap_message(channel: int, n: int, stamp_ns: int, content: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", channel, n, stamp_ns, stamp_ns) + content)


def write_records(path: Path, content: bytes, profile: bytes = b"", summary: bytes = b"") -> Path:
    """An MCAP file of these records, without chunks or an index."""
    content = MCAP_MAGIC + record(1, sized(profile) + sized(b"test")) + content + record(15, bytes(4))
    place = len(content) if summary else 0
    path.write_bytes(content + summary + record(2, struct.pack("<QQI", place, 0, 0)) + MCAP_MAGIC)
    return path


def field(name: str, offset: int, kind: str, count: int = 1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=TYPES[kind], count=count)


def cloud_of(
    fields: Sequence[Any], shape: tuple[int, int], step: int, data: bytes, row_padding: int = 0, order: str = "<"
) -> SimpleNamespace:
    """The attributes of a message of rows and columns of points."""
    return SimpleNamespace(
        height=shape[0], width=shape[1], fields=fields, is_bigendian=order == ">", point_step=step,
        row_step=shape[1] * step + row_padding, data=data, is_dense=False,
    )  # fmt: skip


def ros_cloud(types: Any, cloud: Any, stamp: tuple[int, int], seq: int | None = None) -> Any:
    """A cloud's attributes as a message of rosbags; ``seq``: of ROS 1."""
    header = types["std_msgs/msg/Header"](
        *([] if seq is None else [seq]), types["builtin_interfaces/msg/Time"](*stamp), "lidar"
    )
    fields = [types["sensor_msgs/msg/PointField"](f.name, f.offset, f.datatype, f.count) for f in cloud.fields]
    return types[CLOUD](
        header, cloud.height, cloud.width, fields, cloud.is_bigendian, cloud.point_step, cloud.row_step,
        np.frombuffer(cloud.data, np.uint8), False,
    )  # fmt: skip


def write_clouds(path: Path, scans: Iterable[tuple[float, NDArray[Any]]]) -> Path:
    """A ROS 1 bag of structured arrays, (n,) or (rows, columns), with these stamps."""
    typesys, rosbag1 = pytest.importorskip("rosbags.typesys"), pytest.importorskip("rosbags.rosbag1")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    with rosbag1.Writer(path) as bag:
        connection = bag.add_connection("/points", CLOUD, typestore=store)
        for k, (stamp_s, given) in enumerate(scans):
            rows, kind = np.atleast_2d(given), given.dtype
            fields = [field(name, kind.fields[name][1], kind[name].str[1:]) for name in kind.names]
            cloud = cloud_of(fields, rows.shape, kind.itemsize, rows.tobytes())
            message = ros_cloud(store.types, cloud, (int(stamp_s), round(stamp_s % 1 * 1e9)), k)
            bag.write(connection, round(stamp_s * 1e9), store.serialize_ros1(message, CLOUD))
    return path
