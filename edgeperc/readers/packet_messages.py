"""Messages of drivers that hold a LiDAR's packets: Velodyne's and Ouster's, which are decoded; others are named."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..errors import PointsError
from ..system.extras import require
from ..types.points import as_points
from .clouds import Header, MessageReader, Stamp, cdr_reader, ros1_reader
from .mcap import Channel
from .packets import VELODYNE_BYTES, velodyne_name
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


Packets = VelodyneScan | OusterPacket


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


PACKET_READERS: MappingProxyType[tuple[str, str], Callable[[memoryview], Packets]] = MappingProxyType(
    {
        ("ouster_sensor_msgs/msg/PacketMsg", "cdr"): lambda content: _ouster_packet(cdr_reader(content)),
        ("ouster_ros/msg/PacketMsg", "cdr"): lambda content: _ouster_packet(cdr_reader(content)),
        ("ouster_ros/PacketMsg", "ros1"): lambda content: _ouster_packet(ros1_reader(content)),
        ("velodyne_msgs/msg/VelodyneScan", "cdr"): lambda content: _velodyne_scan(cdr_reader(content)),
        ("velodyne_msgs/VelodyneScan", "ros1"): lambda content: _velodyne_scan(ros1_reader(content)),
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
    for channel in sorted(channels):
        for pattern, what, driver in _OTHERS:
            if re.match(pattern, channel.msgtype):
                said.append(
                    f"topic {channel.topic} holds {what} ({channel.msgtype}), which cannot be decoded: play the bag "
                    f"through {driver}, and record its sensor_msgs/PointCloud2"
                )
    return said


def has_points(channel: Channel) -> bool:
    """Whether messages hold packets with points: an Ouster's with motion have the same type, and imu in their topic."""
    is_decoded = channel[1:] in PACKET_READERS
    return is_decoded and not (channel.msgtype.endswith("PacketMsg") and "imu" in channel.topic.rpartition("/")[2])


def is_metadata_of(channel: Channel, topic: str) -> bool:
    """Whether an Ouster's driver writes the metadata of a topic's packets into a channel, as a text."""
    is_text = channel[1:] in (("std_msgs/msg/String", "cdr"), ("std_msgs/String", "ros1"))
    return is_text and channel.topic == f"{topic.rpartition('/')[0]}/metadata"


def read_text(channel: Channel, content: memoryview) -> str:
    """A message ``std_msgs/String``. Raises PointsError."""
    return (cdr_reader(content) if channel.encoding == "cdr" else ros1_reader(content)).text()


class OusterMessages:
    """Turns of an Ouster from messages, on the clock of the computer that recorded the bag."""

    def __init__(self, metadata: str, remission_field: str | None) -> None:
        from .ouster_packets import OusterStream, layout_of  # numba, which other messages do without

        try:
            self._layout = layout_of(json.loads(metadata))
        except (ValueError, RecursionError) as exc:
            raise PointsError(f"the Ouster's metadata in the bag cannot be read: {exc}") from exc
        self._stream, self._last_s = OusterStream(self._layout, remission_field), 0.0

    def add(self, message: OusterPacket, stamp_s: float) -> Iterator[TimedScan]:
        """The turns that end in a message."""
        self._last_s = stamp_s
        if len(message.content) == self._layout.packet_bytes and self._stream.is_of_sensor(message.content):
            yield from map(self._of_computer, self._stream.add(bytes(message.content)))

    def end(self) -> Iterator[TimedScan]:
        """The last turn, which may be a part."""
        yield from map(self._of_computer, self._stream.end())

    def _of_computer(self, scan: TimedScan) -> TimedScan:
        assert scan.times_s is not None
        assert scan.stamp_s is not None
        return TimedScan(self._last_s, scan.points, scan.times_s - scan.stamp_s + self._last_s)


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
