"""Decoding of captures by native libraries; `worker` runs it in a process of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingExtraError, PointsError
from ..extras import require
from ..points import as_points
from .inflate import inflate
from .mcap import McapFile
from .ouster import check_osf, open_capture
from .packets import pcap_packets
from .tables import MAX_BYTES

__all__ = ["Scan", "cloud_points", "decode"]

Scan = tuple[float | None, NDArray[np.float32]]

_CLOUD = "sensor_msgs/msg/PointCloud2"

# PointField.datatype, from 1.
_CLOUD_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_VELODYNE_BYTES = 1206

# Enough to find a LiDAR's packet among those of a GPS, and quick to read.
_SNIFFED_PACKETS = 2000


def decode(
    path: Path,
    kind: str,
    topic: str | None,
    remission_field: str | None,
    warn: Callable[[str], None],
    alive: Callable[[], None],
) -> Iterator[Scan]:
    """The scans of a capture, decoded in this process.

    Parameters
    ----------
    path : Path
    kind : {".pcap", ".osf", ".bag", ".mcap", "ros2"}
    topic, remission_field : str, optional
        As in `edgeperc.read_scans`.
    warn : callable
        Called with a sentence about what was left out.
    alive : callable
        Called now and then while a large file is checked before its first scan.

    Raises
    ------
    PointsError
        Every error becomes one that names the file.
    MissingExtraError
    """
    n_scans = 0
    try:
        scans = (
            _packet_scans(path, kind, topic, remission_field, warn, alive)
            if kind in (".pcap", ".osf")
            else _bag_scans(path, kind, topic, remission_field)
        )
        for scan in scans:
            n_scans += 1
            yield scan
    except MissingExtraError:
        raise
    except PointsError as exc:
        raise PointsError(f"{path}: {exc}") from exc
    except MemoryError as exc:
        after = f"after {n_scans} scans " if n_scans else ""
        raise PointsError(f"{path}: {after}decoding the capture takes more than {MAX_BYTES:,} bytes of memory") from exc
    except Exception as exc:  # of three libraries, and of numpy, struct and sqlite on damaged files
        after = f"after {n_scans} scans " if n_scans else ""
        reason = " ".join(str(exc).split()) or type(exc).__name__
        raise PointsError(f"{path}: {after}the capture cannot be read ({reason}); it is damaged or cut short") from exc


def cloud_points(message: Any, *, remission_field: str | None = None) -> NDArray[np.float32]:
    """Convert a ROS ``sensor_msgs/PointCloud2`` message, from any library, to points.

    Parameters
    ----------
    message : object
        With the message's attributes: height, width, fields, is_bigendian, point_step, row_step, data. Organized or
        not; fields in any order, of any type, padded or not.
    remission_field : str, optional
        As in `edgeperc.read_points`.

    Returns
    -------
    (n, 4) float32, C-contiguous
        Row by row. Points that are not finite stay in place.

    Raises
    ------
    PointsError
        The message holds fewer bytes than it declares, or has no x, y and z.
    """
    try:
        height, width, step = int(message.height), int(message.width), int(message.point_step)
        row_step = int(message.row_step) if height > 1 else width * step
        data = np.frombuffer(message.data, np.uint8)
        # A field with several values per point, such as a descriptor, is not a coordinate.
        fields = {f.name: f for f in message.fields if f.count in (0, 1) and 1 <= f.datatype <= len(_CLOUD_TYPES)}
        order = ">" if message.is_bigendian else "<"
        dtype = np.dtype(
            {
                "names": [*fields],
                "formats": [order + _CLOUD_TYPES[f.datatype - 1] for f in fields.values()],
                "offsets": [f.offset for f in fields.values()],
                "itemsize": step,
            }
        )
    except (AttributeError, TypeError, ValueError, OverflowError) as exc:
        raise PointsError(f"the point cloud's layout is impossible: {exc}") from exc
    n_bytes = (height - 1) * row_step + width * step if height > 0 and width > 0 else 0
    if min(height, width) < 0 or row_step < width * step or data.size < n_bytes:
        raise PointsError(
            f"the point cloud declares {height} x {width} points of {step} bytes in rows of {row_step}, and holds "
            f"{data.size} bytes; expected {n_bytes}"
        )
    shape = (height, width) if n_bytes else (0, 0)
    cloud: NDArray[Any] = np.ndarray(shape, dtype, data, strides=(row_step, step) if n_bytes else None)
    return as_points(cloud, remission_field=remission_field)


def _choose(what: str, names: Sequence[str], wanted: str | None, others: str = "") -> int:
    """Index of the wanted name, or of the only name; otherwise a `PointsError` lists the names."""
    if wanted in names:
        return names.index(str(wanted))
    there = f"there are {', '.join(names)}" if names else "there is none"
    if wanted is not None:
        raise PointsError(f"no {what} {wanted!r}; {there}{others}")
    if len(names) != 1:
        raise PointsError(f"expected one {what}, {there}{others}{'; say which by topic=' if names else ''}")
    return 0


# --- packets ---------------------------------------------------------------------------------------------------------


def _packet_scans(
    path: Path,
    kind: str,
    topic: str | None,
    remission_field: str | None,
    warn: Callable[[str], None],
    alive: Callable[[], None],
) -> Iterator[Scan]:
    scans: Iterator[Scan] = iter(())
    if kind == ".osf":
        osf = require("ouster.sdk.osf", "io", "Reading an Ouster capture", package="ouster-sdk")
        check_osf(path)
        scans = _ouster_scans(osf.OsfFrameSetSource(str(path)), topic, remission_field)
    elif any(_is_velodyne(packet) for _, packet in islice(pcap_packets(path, whole=False), _SNIFFED_PACKETS)):
        scans = _velodyne_scans(path)
    else:
        frames = open_capture(path, warn, alive)
        if frames is not None:
            scans = _ouster_scans(frames, topic, remission_field)
    n_scans = 0
    for scan in scans:
        n_scans += 1
        yield scan
    # Both libraries stop without an error if the file ends inside a packet, or has no packets of their sensors.
    n_packets = 0 if kind == ".osf" else sum(1 for _ in pcap_packets(path))
    if not n_scans:
        held = "holds no scan" if kind == ".osf" else f"has {n_packets} packets, none from a supported LiDAR"
        raise PointsError(f"the capture {held}; expected a Velodyne capture, or an Ouster capture with its metadata")


def _is_velodyne(packet: memoryview) -> bool:
    # The first of twelve blocks begins with the flag 0xEEFF, behind the headers of Ethernet, IP and UDP.
    return len(packet) > _VELODYNE_BYTES and bytes(packet[-_VELODYNE_BYTES : 2 - _VELODYNE_BYTES]) == b"\xff\xee"


def _velodyne_scans(path: Path) -> Iterator[Scan]:
    velodyne = require("velodyne_decoder", "io", "Reading a Velodyne capture", package="velodyne-decoder")
    config = velodyne.Config()
    for stamp, points in velodyne.read_pcap(str(path), config):
        scan = as_points(points[:, :4])
        # After the first scan the decoder knows the model of the sensor.
        if config.model is not None and config.model.name.startswith("HDL64E"):
            scan[:, 3] /= 255.0
        yield stamp.device, scan


def _ouster_scans(frames: Any, topic: str | None, remission_field: str | None) -> Iterator[Scan]:
    core = require("ouster.sdk.core", "io", "Reading an Ouster capture", package="ouster-sdk")
    serials = [str(info.sn) for info in frames.sensor_info]
    chosen = _choose("sensor", serials, topic)
    to_xyz = core.XYZLut(frames.sensor_info[chosen], False)  # in the sensor's frame, not the vehicle's
    name = (remission_field or "reflectivity").upper()
    for frame_set in frames:
        frame = frame_set[chosen]
        if frame is None:  # no packet of this sensor in this turn
            continue
        if name not in frame.fields:
            raise PointsError(f"there is no field {name!r} for the remission, only {', '.join(frame.fields)}")
        returned = frame.field("RANGE") > 0
        scan = np.empty((np.count_nonzero(returned), 4), np.float32)
        scan[:, :3] = to_xyz(frame)[returned]
        scan[:, 3] = frame.field(name)[returned]
        yield float(frame.timestamp.max()) * 1e-9, scan


# --- bags ------------------------------------------------------------------------------------------------------------


def _bag_scans(path: Path, kind: str, topic: str | None, remission_field: str | None) -> Iterator[Scan]:
    highlevel = require("rosbags.highlevel", "io", "Reading a bag")
    typesys = require("rosbags.typesys", "io", "Reading a bag")
    rosbag2 = require("rosbags.rosbag2", "io", "Reading a bag")
    humble = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    files = [path] if kind == ".mcap" else _mcap_files(rosbag2.Reader(path)) if kind == "ros2" else []
    opened = _McapBag(files, humble) if files else highlevel.AnyReader([path], default_typestore=humble)
    with opened as bag:
        for reader in getattr(bag, "readers", []):
            _limit_chunks(reader)
        clouds = [c for c in bag.connections if c.msgtype == _CLOUD]
        others = sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections if c.msgtype != _CLOUD})
        names = sorted({c.topic for c in clouds})
        beside = f"; of other types {', '.join(others)}" if others else ""
        chosen = names[_choose("topic of type sensor_msgs/PointCloud2", names, topic, beside)]
        n_scans = 0
        for connection, stamp_ns, raw in bag.messages([c for c in clouds if c.topic == chosen]):
            message = bag.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            stamp_s = stamp.sec + 1e-9 * stamp.nanosec
            n_scans += 1
            yield stamp_s or 1e-9 * stamp_ns, cloud_points(message, remission_field=remission_field)
        if not n_scans:
            raise PointsError(f"topic {chosen} has no message; expected point clouds")


def _mcap_files(bag: Any) -> list[Path]:
    """The MCAP files of a ROS 2 bag's folder, none if it holds others or packs them once more."""
    plain = bag.metadata["storage_identifier"] == "mcap" and not bag.compression_mode
    return [*bag.paths] if plain else []


def _limit_chunks(reader: Any) -> None:
    """Give the chunks of a ROS 1 bag a decompressor that stops at the limit."""
    by_magic = {b"BZh": "bz2", b"\x04\x22\x4d": "lz4"}
    for place, chunk in getattr(reader, "chunks", {}).items():
        usual = chunk.decompressor

        def unpack(packed: bytes, usual: Callable[[bytes], bytes] = usual) -> bytes:
            # A chunk that is not packed begins with the length of a record's header, never these numbers.
            return inflate(packed, by_magic[packed[:3]]) if packed[:3] in by_magic else usual(packed)

        reader.chunks[place] = chunk._replace(decompressor=unpack)


class _McapBag:
    """MCAP files as `AnyReader` shows a bag."""

    def __init__(self, paths: Sequence[Path], typestore: Any) -> None:
        self._files, self._typestore = [McapFile(path) for path in paths], typestore
        self.connections = sorted({c for file in self._files for c in file.channels.values()})

    def __enter__(self) -> _McapBag:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def messages(self, connections: Sequence[Any]) -> Iterator[tuple[Any, int, Any]]:
        for file in self._files:
            for channel, stamp_ns, data in file.messages():
                if file.channels.get(channel) in connections:
                    yield file.channels[channel], stamp_ns, data

    def deserialize(self, raw: Any, msgtype: str) -> Any:
        return self._typestore.deserialize_cdr(bytes(raw), msgtype)
