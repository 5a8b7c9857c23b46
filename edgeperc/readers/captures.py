"""Read the scans of recordings: folders of scan files, Velodyne and Ouster captures, ROS 1 and 2 bags, MCAP."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingExtraError, PointsError
from ..extras import require
from ..points import as_points
from .files import read_points

__all__ = ["CAPTURE_SUFFIXES", "SCAN_SUFFIXES", "cloud_points", "is_capture", "read_scans", "scan_files"]

Scan = tuple[float | None, NDArray[np.float32]]
SCAN_SUFFIXES = (".bin", ".npy", ".npz", ".pcd", ".ply")
CAPTURE_SUFFIXES = (".bag", ".db3", ".mcap", ".osf", ".pcap", ".pcapng")

# First bytes of captures.
_MAGIC = {
    b"\xd4\xc3\xb2\xa1": ".pcap",
    b"\xa1\xb2\xc3\xd4": ".pcap",
    b"\x4d\x3c\xb2\xa1": ".pcap",
    b"\xa1\xb2\x3c\x4d": ".pcap",
    b"\x0a\x0d\x0d\x0a": ".pcapng",
    b"#ROSBAG V": ".bag",
    b"\x89MCAP0\r\n": ".mcap",
    b"SQLite format 3\0": ".db3",
}
_CLOUD = "sensor_msgs/msg/PointCloud2"

# PointField.datatype, from 1.
_CLOUD_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_VELODYNE_BYTES = 1206

# Enough to find a LiDAR's packet among those of a GPS, and quick to read.
_SNIFFED_PACKETS = 2000


def read_scans(
    source: str | os.PathLike[str], *, topic: str | None = None, remission_field: str | None = None
) -> Iterator[Scan]:
    """Read the scans of a recording, one after another.

    Parameters
    ----------
    source : str or path
        A scan file (`edgeperc.read_points`); a folder of scan files and captures, read in the order of their names; a
        Velodyne ``.pcap``; an Ouster ``.osf``, or ``.pcap`` with its metadata beside it in a ``.json`` file whose name
        has the same beginning; a ROS 1 ``.bag``, a ROS 2 bag's folder or one ``.mcap`` file. Bags are read for
        messages of type ``sensor_msgs/PointCloud2``. The first bytes of a file decide its format, not its name.
    topic : str, optional
        The topic to read if a bag has several with point clouds; the serial number of the sensor if an Ouster capture
        has several.
    remission_field : str, optional
        Name of the remission field, as in `edgeperc.read_points`; ``reflectivity`` by default for an Ouster capture.

    Yields
    ------
    stamp_s : float or None
        Time of the scan on the sensor's clock [s]: the end of the scan for a Velodyne and an Ouster, the header's stamp
        for a message. None for scan files.
    points : (n, 4) float32, C-contiguous
        x, y, z [m] in the sensor's frame, and the raw remission, which the `Perceiver` scales by its sensor's
        ``remission_range``: 0..255 for a Velodyne and an Ouster's reflectivity, but 0..1 for an HDL-64E, as in KITTI's
        files. The first and the last turn of a packet capture may be incomplete.

    Raises
    ------
    PointsError
        The source does not exist, is damaged, or holds no scan of a LiDAR. A truncated packet capture yields the scans
        before its end first; other damaged captures yield none.
    MissingExtraError
        The library that reads this kind of capture is not installed.
    """
    path = Path(source)
    if not path.exists():
        raise PointsError(
            f"{path}: there is no such file or folder; expected a scan, a folder of scans, a .pcap, .osf, .bag or .mcap"
        )
    kind = _kind(path)
    if kind == "folder":
        return _folder(path, topic, remission_field)
    if kind in (".pcap", ".osf"):
        return _naming(path, _packet_scans(path, kind, topic, remission_field))
    if kind in (".bag", ".mcap", "ros2"):
        return _naming(path, _bag_scans(path, kind, topic, remission_field))
    if kind == ".pcapng":
        raise PointsError(f"{path}: a pcapng file; expected pcap. Run: editcap -F pcap {path.name} {path.stem}.pcap")
    if kind == ".db3":
        raise PointsError(f"{path}: a .db3 is read with the folder it lies in; expected metadata.yaml beside it")
    return iter([(None, read_points(path, remission_field=remission_field))])


def is_capture(path: Path) -> bool:
    """Whether a path is a recording of many scans: a bag's folder, or a file with the first bytes of a capture."""
    return _kind(path) not in ("scan", "folder")


def scan_files(folder: Path) -> list[Path]:
    """The scans and captures in a folder, by name, without hidden files."""
    return sorted(
        entry
        for entry in folder.iterdir()
        if entry.suffix.lower() in SCAN_SUFFIXES + CAPTURE_SUFFIXES and entry.name[0] != "." and entry.is_file()
    )


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


def _kind(path: Path) -> str:
    """``"scan"``, ``"folder"``, ``"ros2"`` or one of `CAPTURE_SUFFIXES`, by content or else by name."""
    if path.is_dir():
        return "ros2" if (path / "metadata.yaml").is_file() else "folder"
    if not path.is_file():  # opening a pipe would block
        return "scan"
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as exc:
        raise PointsError(f"{path}: the file cannot be read ({exc})") from exc
    if head[8:11] == b"OSF":
        return ".osf"
    by_name = path.suffix.lower() if path.suffix.lower() in CAPTURE_SUFFIXES else "scan"
    return next((kind for magic, kind in _MAGIC.items() if head.startswith(magic)), by_name)


def _folder(folder: Path, topic: str | None, remission_field: str | None) -> Iterator[Scan]:
    files = scan_files(folder)
    if not files:
        raise PointsError(
            f"{folder}: no scan in this folder; expected {', '.join(SCAN_SUFFIXES + CAPTURE_SUFFIXES)}, or a ROS 2 "
            "bag's metadata.yaml"
        )
    for file in files:
        yield from read_scans(file, topic=topic, remission_field=remission_field)


def _naming(path: Path, scans: Iterator[Scan]) -> Iterator[Scan]:
    """The same scans; every error becomes a `PointsError` that names the file."""
    n_scans = 0
    try:
        for scan in scans:
            n_scans += 1
            yield scan
    except MissingExtraError:
        raise
    except PointsError as exc:
        raise PointsError(f"{path}: {exc}") from exc
    except Exception as exc:  # of three libraries, and of numpy, struct and sqlite on damaged files
        after = f"after {n_scans} scans " if n_scans else ""
        reason = " ".join(str(exc).split()) or type(exc).__name__
        raise PointsError(f"{path}: {after}the capture cannot be read ({reason}); it is damaged or cut short") from exc


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


def _packet_scans(path: Path, kind: str, topic: str | None, remission_field: str | None) -> Iterator[Scan]:
    if kind == ".osf":
        osf = require("ouster.sdk.osf", "io", "Reading an Ouster capture", package="ouster-sdk")
        _check_osf(path)
        scans = _ouster_scans(osf.OsfFrameSetSource(str(path)), topic, remission_field)
    elif any(_is_velodyne(packet) for packet in islice(_packets(path, whole=False), _SNIFFED_PACKETS)):
        scans = _velodyne_scans(path)
    else:
        pcap = require(
            "ouster.sdk.pcap", "io", "Reading a capture of another sensor than Velodyne's", package="ouster-sdk"
        )
        try:
            frames = pcap.PcapFrameSetSource(str(path))
        except Exception as exc:  # the SDK's errors share no base
            raise PointsError(
                f"not a Velodyne capture (packets of {_VELODYNE_BYTES} bytes), and cannot be read as Ouster's: "
                f"{' '.join(str(exc).split())} Expected the sensor's metadata beside it, in a .json file whose name "
                "has the same beginning"
            ) from exc
        scans = _ouster_scans(frames, topic, remission_field)
    n_scans = 0
    for scan in scans:
        n_scans += 1
        yield scan
    # Both libraries stop without an error if the file ends inside a packet, or has no packets of their sensors.
    n_packets = 0 if kind == ".osf" else sum(1 for _ in _packets(path))
    if not n_scans:
        held = "holds no scan" if kind == ".osf" else f"has {n_packets} packets, none from a supported LiDAR"
        raise PointsError(f"the capture {held}; expected a Velodyne capture, or an Ouster capture with its metadata")


def _packets(path: Path, whole: bool = True) -> Iterator[memoryview]:
    """The captured packets, with their network headers; `PointsError` if the file is incomplete."""
    size = path.stat().st_size
    if size < 24:
        raise PointsError(f"cut short: {size} bytes; expected a pcap file of 24 bytes and more")
    data = np.memmap(path, np.uint8, "r").data
    endian = "<" if bytes(data[:4]) in (b"\xd4\xc3\xb2\xa1", b"\x4d\x3c\xb2\xa1") else ">"
    if bytes(data[:4]) not in _MAGIC:
        raise PointsError("not a pcap file by its first bytes")
    header = struct.Struct(f"{endian}8xI4x")
    at, n_packets = 24, 0
    while at < size:
        end = at + 16 + (header.unpack_from(data, at)[0] if at + 16 <= size else size)
        if end > size and not whole:
            return
        if end > size:
            raise PointsError(
                f"cut short or damaged: the file ends inside packet {n_packets + 1}, at byte {size:,}; all packets "
                "before it were read"
            )
        yield data[at + 16 : end]
        at, n_packets = end, n_packets + 1


def _check_osf(path: Path) -> None:
    """Raise `PointsError` unless every checksum is right, because ouster-sdk 1.0 may crash on a damaged file."""
    data = np.memmap(path, np.uint8, "r").data
    kind, at, size = b"", 0, len(data)
    while at < size:
        # The length of the block, the block, CRC-32 of both.
        end = at + 4 + struct.unpack_from("<I", data, at)[0] if at + 8 <= size else size
        if end + 4 > size or zlib.crc32(data[at:end]) != struct.unpack_from("<I", data, end)[0]:
            raise PointsError(
                f"the .osf file is damaged or cut short: the block at byte {at:,} of {size:,} is not whole"
            )
        kind, at = bytes(data[at + 8 : at + 12]), end + 4
    if kind != b"OSF#":
        raise PointsError("the .osf file is cut short: its last block is not the metadata")


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
    storage = require("rosbags.rosbag2.storage_mcap", "io", "Reading a bag")
    humble = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    # AnyReader opens a single .mcap only from rosbags 0.10 on, but ouster-sdk 1.0 requires 0.9.
    alone = kind == ".mcap" and hasattr(storage, "MCAPFile")
    opened = (
        _McapFile(storage.MCAPFile(path), humble) if alone else highlevel.AnyReader([path], default_typestore=humble)
    )
    with opened as bag:
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


class _McapFile:
    """A reader of one .mcap file without the folder of its bag, with the interface of `AnyReader`."""

    def __init__(self, file: Any, typestore: Any) -> None:
        self.file, self.typestore = file, typestore
        self.connections: list[Any] = []

    def __enter__(self) -> _McapFile:
        try:
            self.file.open()
            self.file.get_schema_definitions()  # reads on to the channels where the file has no index
        except BaseException:
            self.__exit__()
            raise
        to_connection = import_module("rosbags.interfaces").Connection
        self.connections = [
            to_connection(channel.id, channel.topic, channel.schema, "", "", 0, None, self)
            for channel in self.file.channels.values()
        ]
        return self

    def __exit__(self, *_: object) -> None:
        if self.file.bio is not None:
            self.file.close()

    def messages(self, connections: Iterable[Any]) -> Iterator[tuple[Any, int, Any]]:
        yield from self.file.messages(connections)

    def deserialize(self, raw: Any, msgtype: str) -> Any:
        return self.typestore.deserialize_cdr(raw, msgtype)
