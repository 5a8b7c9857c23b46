"""Messages of drivers that hold a LiDAR's packets: of Velodyne, Ouster, Hesai and RoboSense; others are named."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..errors import PointsError
from ..system.extras import require
from ..types.points import as_points
from .clouds import CLOUD_READERS, Header, MessageReader, Stamp, cdr_reader, ros1_reader
from .mcap import Channel
from .packets import DIFOP, VELODYNE_BYTES, velodyne_name
from .senders import ALONE, Whose
from .times import TimedScan


class VelodyneScan(NamedTuple):
    """``velodyne_msgs/VelodyneScan``: about a turn; when each packet came [ns], and its bytes."""

    header: Header
    packets: tuple[tuple[int, memoryview], ...]


class OusterPacket(NamedTuple):
    """``ouster_sensor_msgs/PacketMsg``: one packet. It has no header."""

    header: Header
    content: memoryview
    metadata: str = ""


class LidarPackets(NamedTuple):
    """Packets of Hesai's or RoboSense's: when each came [ns], 0: not said, and its bytes."""

    header: Header
    packets: tuple[tuple[int, memoryview], ...]
    unit: memoryview | None = None  # what a RoboSense says of itself (DIFOP), of any message
    whose: Whose = ALONE


Packets = VelodyneScan | OusterPacket | LidarPackets


class _Layout(NamedTuple):
    """A message with packets."""

    has_header: bool = True
    has_many: bool = True  # a list of packets
    flags: int = 0  # bytes in front of a packet
    has_stamps: bool = True
    n_bytes: int = 0  # of a packet; 0: each says it
    says_size: bool = False  # behind a packet, how many of its bytes it has


# By the type of the message; drivers of other versions write some otherwise: the first is taken that fits.
_LAYOUTS = {
    "pandar_msgs/PandarScan": (_Layout(n_bytes=1500, says_size=True),),
    "hesai_lidar/PandarScan": (_Layout(says_size=True), _Layout(n_bytes=1500, says_size=True)),
    "hesai_ros_driver/UdpFrame": tuple(
        _Layout(has_header=header, has_stamps=stamps, says_size=True)
        for header in (True, False)
        for stamps in (True, False)
    ),
    "nebula_msgs/NebulaPackets": (_Layout(),),
    "rslidar_msg/RslidarPacket": (
        _Layout(has_many=False, flags=2, has_stamps=False),
        _Layout(has_header=False, has_many=False, n_bytes=1248),
    ),
    "rslidar_msg/RslidarScan": (_Layout(n_bytes=1248),),
    "rslidar_msgs/rslidarScan": (_Layout(n_bytes=1248),),
    "robosense_msgs/RobosenseScan": (_Layout(n_bytes=1248, says_size=True),),
}
# What a RoboSense says of itself, in a topic of its own.
ROBOSENSE = (DIFOP[:4], b"\x55\xaa\x05\x0a", b"\x55\xaa\x05\x5a")
"""The first bytes of RoboSense's packets."""
_OF_UNITS = {"rslidar_msgs/rslidarPacket", "rslidar_msg/RslidarPacket", "robosense_msgs/RobosenseInfoPacket"}


def _ouster_packet(read: MessageReader) -> OusterPacket:
    return OusterPacket(Header(Stamp(0, 0), ""), read.take(read.value("I")))


def _velodyne_scan(read: MessageReader) -> VelodyneScan:
    header, n_packets = read.header(), read.value("I")
    if n_packets > read.left // VELODYNE_BYTES:
        raise PointsError(f"a message is damaged: it declares {n_packets:,} packets")
    packets = []
    for _ in range(n_packets):
        stamp = read.stamp()
        packets.append((10**9 * stamp.sec + stamp.nanosec, read.take(VELODYNE_BYTES)))
    return VelodyneScan(header, tuple(packets))


def _lidar_packets(content: memoryview, start: Callable[[memoryview], MessageReader], name: str) -> Packets:
    for layout in _LAYOUTS[name]:
        with suppress(PointsError):
            read = start(content)
            message = _by_layout(read, layout)
            if read.left < 4:
                return message
    raise PointsError(f"a message is damaged: its {len(content):,} bytes are not of a {name}")


def _by_layout(read: MessageReader, layout: _Layout) -> Packets:
    header = read.header() if layout.has_header else Header(Stamp(0, 0), "")
    packets = []
    for _ in range(read.value("I") if layout.has_many else 1):
        read.take(layout.flags)
        stamp = read.stamp() if layout.has_stamps else Stamp(0, 0)
        content = read.take(layout.n_bytes or read.value("I"))
        size = read.value("I") if layout.says_size else len(content)
        packets.append((10**9 * stamp.sec + stamp.nanosec, content[:size]))
    if all(len(packet) == VELODYNE_BYTES for _, packet in packets) and packets:
        return VelodyneScan(header, tuple(packets))
    return LidarPackets(header, tuple(packets))


PACKET_READERS: MappingProxyType[tuple[str, str], Callable[[memoryview], Packets]] = MappingProxyType(
    {
        ("ouster_sensor_msgs/msg/PacketMsg", "cdr"): lambda content: _ouster_packet(cdr_reader(content)),
        ("ouster_ros/msg/PacketMsg", "cdr"): lambda content: _ouster_packet(cdr_reader(content)),
        ("ouster_ros/PacketMsg", "ros1"): lambda content: _ouster_packet(ros1_reader(content)),
        ("velodyne_msgs/msg/VelodyneScan", "cdr"): lambda content: _velodyne_scan(cdr_reader(content)),
        ("velodyne_msgs/VelodyneScan", "ros1"): lambda content: _velodyne_scan(ros1_reader(content)),
        **{
            (name.replace("/", "/msg/"), "cdr"): partial(_lidar_packets, start=cdr_reader, name=name)
            for name in _LAYOUTS
        },
        **{(name, "ros1"): partial(_lidar_packets, start=ros1_reader, name=name) for name in _LAYOUTS},
    }
)
"""What reads a message of packets of a type in an encoding."""

# Types of messages that are not decoded, by their packages, and what makes clouds of them.
_OTHERS = (
    (r"(pandar_msgs|hesai\w*)/", "packets of a Hesai sensor", "Hesai's driver (HesaiLidar_ROS_2.0)"),
    (r"nebula_msgs/", "packets for Nebula", "Nebula's ROS nodes"),
    (r"(rslidar\w*|robosense\w*)/", "packets of a RoboSense sensor", "RoboSense's driver (rslidar_sdk)"),
    (r"livox_\w+/", "points in Livox' own type", "Livox' driver with xfer_format 0"),
)


def packets_of_others(channels: Iterable[Channel]) -> list[str]:
    """For each topic with such messages a sentence: whose they are, and what makes point clouds of them."""
    said = []
    for channel in sorted(channel for channel in channels if channel[1:] not in {**CLOUD_READERS, **PACKET_READERS}):
        for pattern, what, driver in _OTHERS:
            if re.match(pattern, channel.msgtype):
                said.append(
                    f"topic {channel.topic} holds {what} ({channel.msgtype}), which cannot be decoded: play the bag "
                    f"through {driver}, and record its sensor_msgs/PointCloud2"
                )
    return said


def has_points(channel: Channel) -> bool:
    """Whether messages hold packets with points: an Ouster's with motion, and what a RoboSense says of itself, may have
    the same type, and imu or difop in their topic.
    """
    name = channel.topic.rpartition("/")[2]
    is_other = (channel.msgtype.endswith("PacketMsg") and "imu" in name) or (is_of_unit(channel) and "difop" in name)
    return channel[1:] in PACKET_READERS and not is_other


def is_of_unit(channel: Channel) -> bool:
    """Whether messages may be what a RoboSense says of itself."""
    return channel.msgtype.replace("/msg/", "/") in _OF_UNITS


def unit_in(content: memoryview) -> memoryview | None:
    """The packet in a message with what a RoboSense says of itself (DIFOP), 1248 bytes; None if there is none."""
    at = bytes(content).find(DIFOP)
    return content[at : at + 1248] if 0 <= at <= len(content) - 1248 else None


def is_metadata_of(channel: Channel, topic: str) -> bool:
    """Whether an Ouster's driver writes the metadata of a topic's packets into a channel, as a text."""
    is_text = channel[1:] in (("std_msgs/msg/String", "cdr"), ("std_msgs/String", "ros1"))
    return is_text and channel.topic == f"{topic.rpartition('/')[0]}/metadata"


def read_text(channel: Channel, content: memoryview) -> str:
    """A message ``std_msgs/String``. Raises PointsError."""
    return (cdr_reader(content) if channel.encoding == "cdr" else ros1_reader(content)).text()


class _Turns:
    """Turns from messages with packets, on the clock of the computer that recorded the bag."""

    _stream: Any = None
    _last_s = 0.0

    def end(self) -> Iterator[TimedScan]:
        """The last turn, which may be a part."""
        if self._stream is not None:
            yield from map(self._of_computer, self._stream.end())

    def _of_computer(self, scan: TimedScan) -> TimedScan:
        assert scan.times_s is not None
        assert scan.stamp_s is not None
        return TimedScan(self._last_s, scan.points, scan.times_s - scan.stamp_s + self._last_s)


class OusterMessages(_Turns):
    """Turns of an Ouster."""

    def __init__(self, metadata: str, remission_field: str | None) -> None:
        from .ouster_packets import OusterStream, layout_of  # numba, which other messages do without

        try:
            self._layout = layout_of(json.loads(metadata))
        except (ValueError, RecursionError) as exc:
            raise PointsError(f"the Ouster's metadata in the bag cannot be read: {exc}") from exc
        self._stream = OusterStream(self._layout, remission_field)

    def add(self, message: OusterPacket, stamp_s: float) -> Iterator[TimedScan]:
        """The turns that end in a message."""
        self._last_s = stamp_s
        if len(message.content) == self._layout.packet_bytes and self._stream.is_of_sensor(message.content):
            yield from map(self._of_computer, self._stream.add(bytes(message.content)))


class LidarMessages(_Turns):
    """Scans of a Hesai or RoboSense; what spins has its angles in a file beside the bag, or in a packet of the unit."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def add(self, message: LidarPackets, stamp_s: float) -> Iterator[TimedScan]:
        """The turns that end in a message. Raises PointsError: The angles are not known, or the packets not decoded."""
        from .lidars import stream_of  # numba

        units = [] if message.unit is None else [message.unit]
        for stamp_ns, packet in message.packets:
            self._stream = self._stream or stream_of(self._path, packet, units, message.whose)
            if self._stream is not None and self._stream.row.fits(packet):
                yield from map(self._of_computer, self._stream.add(packet))
                self._last_s = 1e-9 * stamp_ns if stamp_ns else stamp_s


class VelodyneStream:
    """Turns of a Velodyne from its packets.

    clock : ``"device"``, the sensor's, or ``"host"``: of the computer that recorded a bag, as of all its messages.
    purpose : the beginning of the error where the library is missing.
    """

    def __init__(self, clock: str = "host", purpose: str = "Reading a Velodyne's packets") -> None:
        self._velodyne = require("velodyne_decoder", "velodyne", purpose, package="velodyne-decoder")
        self._clock, self._brightest = clock, 1.0
        self._decoder = self._velodyne.StreamDecoder(self._velodyne.Config())

    def calibrate(self, packets: Iterable[memoryview]) -> None:
        """Take what each HDL-64E has of its own from its packets, which hold it byte by byte. Raises ValueError."""
        try:
            status = self._velodyne.hdl64e.read_status_info(packets)
            if status["Calibration Time"] is None:
                raise ValueError("Calibration info not available in the metadata")
            said = self._velodyne.hdl64e.status_info_to_calib_dict(status)
            if [laser["laser_id"] for laser in said["lasers"]] != [*range(64)]:
                raise ValueError("Invalid calibration data")
        except ValueError as exc:
            raise ValueError(
                f"Data is from a HDL-64E, but the exact model and calibration could not be determined: {exc}"
            ) from exc
        model = getattr(self._velodyne.Model, f"HDL64E_{status['Model']}")
        calibration = self._velodyne.Calibration.from_string(json.dumps(said, default=str))  # JSON is YAML
        self._decoder = self._velodyne.StreamDecoder(self._velodyne.Config(model=model, calibration=calibration))
        self._brightest = 255.0  # as in KITTI's files

    def add(self, stamp_s: float, packet: memoryview) -> Iterator[TimedScan]:
        """The turn that ends in a packet, which came then."""
        yield from self._turn(self._decoder.decode(stamp_s, packet))

    def add_message(self, message: VelodyneScan) -> Iterator[TimedScan]:
        """The turns that end in a message, which need not begin and end where a turn does."""
        if any(velodyne_name(packet) == "hdl-64e" for _, packet in message.packets[:1]):
            raise PointsError(
                "the packets are of an HDL-64E, and each has a calibration of its own: play the bag through "
                "velodyne_pointcloud, and record its sensor_msgs/PointCloud2"
            )
        for stamp_ns, packet in message.packets:
            yield from self.add(1e-9 * stamp_ns, packet)

    def end(self) -> Iterator[TimedScan]:
        """The last turn, which may be a part."""
        yield from self._turn(self._decoder.finish())

    def _turn(self, decoded: Any) -> Iterator[TimedScan]:
        if decoded is not None:
            stamp, points = decoded
            stamp_s, scan = getattr(stamp, self._clock), as_points(points[:, :4])
            scan[:, 3] /= self._brightest
            yield TimedScan(stamp_s, scan, stamp_s + points[:, 4].astype(np.float64))
