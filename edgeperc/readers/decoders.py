"""Decoding of captures by native libraries; `worker` runs it in a process of its own."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingExtraError, PointsError
from ..system.extras import require
from ..types.points import as_points, table_columns
from .inflate import inflate, inflate_file, most_bytes
from .mcap import McapFile
from .ouster import check_osf, open_capture
from .packets import pcap_packets, refuse_hesai, velodyne_packets
from .tables import MAX_BYTES
from .times import TimedScan, point_times

_Item = TypeVar("_Item")

_CLOUD = "sensor_msgs/msg/PointCloud2"

# PointField.datatype, from 1.
_CLOUD_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_MOST_RINGS = 256

# Nearer, a laser's own place in the housing shows in its elevation.
_ELEVATION_FROM_M = 3.0


def decode(
    path: Path,
    kind: str,
    topic: str | None,
    remission_field: str | None,
    warn: Callable[[str], None],
    alive: Callable[[], None],
    *,
    times: bool = True,
) -> Iterator[TimedScan]:
    """The scans of a capture, decoded in this process.

    topic, remission_field : as in `edgeperc.read_scans`.
    warn : called with a sentence about what was left out.
    alive : called now and then while a large file is checked before its first scan.
    times : false leaves out the times of points.
    Raises PointsError, MissingExtraError.
    """
    scans = (
        _packet_scans(path, kind, topic, remission_field, warn, alive)
        if kind in (".pcap", ".osf")
        else _bag_scans(path, kind, topic, remission_field, alive, times)
    )
    for stamp_s, points, times_s in _with_typed_errors(path, scans):
        yield TimedScan(stamp_s, points, times_s if times else None)


def describe(path: Path, kind: str, topic: str | None, alive: Callable[[], None]) -> dict[str, Any]:
    """What a capture says about its sensor, as JSON types; `identify` draws the conclusion.

    topic : as in `edgeperc.read_scans`.
    alive : as in `decode`.
    Returns: ``metadata`` of an Ouster, as text; or ``topic``, ``frame``, ``fields`` and ``elevations_deg`` of a point
        cloud: the median elevation of each ring or, without rings, of each row of an organized cloud [deg], None
        where a ring has no return; empty without both.
    Raises PointsError, MissingExtraError.
    """

    def found() -> Iterator[dict[str, Any]]:
        if kind == ".osf":
            frames = _open_osf(path)
            chosen = frames.sensor_info[_choose("sensor", [str(info.sn) for info in frames.sensor_info], topic)]
            yield {"metadata": chosen.to_json_string()}
        else:
            for name, message, _ in _clouds(path, kind, topic, alive):
                yield describe_cloud(name, message)

    return next(_with_typed_errors(path, found()))


def describe_cloud(topic: str, message: Any) -> dict[str, Any]:
    """What a ROS ``sensor_msgs/PointCloud2`` message says about its sensor; see `describe`.

    Raises PointsError.
    """
    return {
        "topic": topic,
        "frame": str(message.header.frame_id),
        "fields": [str(f.name) for f in message.fields],
        "elevations_deg": _ring_elevations(message),
    }


def _with_typed_errors(path: Path, items: Iterator[_Item]) -> Iterator[_Item]:
    n_scans = 0
    try:
        for item in items:
            n_scans += 1
            yield item
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

    message : object; with the message's attributes: height, width, fields, is_bigendian, point_step, row_step, data.
        Organized or not; fields in any order, of any type, padded or not.
    remission_field : as in `edgeperc.read_points`; by default ``reflectivity`` if the fields are those of Ouster's
        driver.
    Returns (n, 4) float32, C-contiguous: Row by row. Points that are not finite stay in place.
    Raises PointsError.
    """
    cloud = _as_table(message)
    if remission_field is None and is_ouster_cloud(cloud.dtype.names or ()):
        remission_field = "reflectivity"
    return as_points(cloud, remission_field=remission_field)


def _as_table(message: Any) -> NDArray[Any]:
    """The points of a cloud as a structured array, (height, width)."""
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
    return cloud


def is_ouster_cloud(names: Sequence[str]) -> bool:
    """Whether these are the fields of Ouster's driver; its ``intensity`` is a count of photons."""
    return "reflectivity" in names and not {"range", "ambient", "noise", "near_ir", "signal"}.isdisjoint(names)


def _ring_elevations(message: Any) -> list[float | None]:
    """See `describe`."""
    cloud = _as_table(message)
    names = cloud.dtype.names or ()
    if "ring" in names:
        ring = cloud["ring"].ravel().astype(np.float64)
    elif cloud.ndim == 2 and 1 < len(cloud) <= _MOST_RINGS:
        ring = np.repeat(np.arange(len(cloud), dtype=np.float64), cloud.shape[1])
    else:
        return []
    points = as_points(cloud).astype(np.float64)
    across = np.hypot(points[:, 0], points[:, 1])
    with np.errstate(invalid="ignore"):
        far = np.isfinite(points).all(axis=1) & (across > _ELEVATION_FROM_M)
        n_rings = int(ring[(ring >= 0.0) & (ring < _MOST_RINGS)].max(initial=-1.0)) + 1
    elevation, ring = np.degrees(np.arctan2(points[far, 2], across[far])), ring[far]
    return [round(float(np.median(elevation[ring == k])), 3) if np.any(ring == k) else None for k in range(n_rings)]


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
) -> Iterator[TimedScan]:
    scans: Iterator[TimedScan] = iter(())
    if kind == ".osf":
        scans = _ouster_scans(_open_osf(path), topic, remission_field)
    elif next(velodyne_packets(path), None) is not None:
        scans = _velodyne_scans(path)
    else:
        refuse_hesai(path)
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
        content = "holds no scan" if kind == ".osf" else f"has {n_packets} packets, none from a supported LiDAR"
        raise PointsError(f"the capture {content}; expected a Velodyne capture, or an Ouster capture with its metadata")


def _open_osf(path: Path) -> Any:
    osf = require("ouster.sdk.osf", "ouster", "Reading an Ouster capture", package="ouster-sdk")
    check_osf(path)
    return osf.OsfFrameSetSource(str(path))


def _velodyne_scans(path: Path) -> Iterator[TimedScan]:
    velodyne = require("velodyne_decoder", "velodyne", "Reading a Velodyne capture", package="velodyne-decoder")
    config = velodyne.Config()
    for stamp, points in velodyne.read_pcap(str(path), config):
        scan = as_points(points[:, :4])
        # After the first scan the decoder knows the model of the sensor.
        if config.model is not None and config.model.name.startswith("HDL64E"):
            scan[:, 3] /= 255.0
        yield TimedScan(stamp.device, scan, stamp.device + points[:, 4].astype(np.float64))


def _ouster_scans(frames: Any, topic: str | None, remission_field: str | None) -> Iterator[TimedScan]:
    core = require("ouster.sdk.core", "ouster", "Reading an Ouster capture", package="ouster-sdk")
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
        column = np.nonzero(returned)[1]
        yield TimedScan(float(frame.timestamp.max()) * 1e-9, scan, frame.timestamp[column] * 1e-9)


# --- bags ------------------------------------------------------------------------------------------------------------


def _bag_scans(
    path: Path, kind: str, topic: str | None, remission_field: str | None, alive: Callable[[], None], times: bool
) -> Iterator[TimedScan]:
    for _, message, stamp_s in _clouds(path, kind, topic, alive):
        points = cloud_points(message, remission_field=remission_field)
        times_s = point_times(table_columns(_as_table(message)), points, stamp_s) if times else None
        yield TimedScan(stamp_s, points, times_s)


def _clouds(path: Path, kind: str, topic: str | None, alive: Callable[[], None]) -> Iterator[tuple[str, Any, float]]:
    """Topic, message and stamp [s] of each point cloud."""
    highlevel = require("rosbags.highlevel", "ros", "Reading a bag")
    typesys = require("rosbags.typesys", "ros", "Reading a bag")
    humble = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    packed, files = False, [path] if kind == ".mcap" else []
    if kind == "ros2":
        path, packed, files = _plain_bag(path, alive)
    opened = _McapBag(files, humble) if files else highlevel.AnyReader([path], default_typestore=humble)
    with opened as bag:
        for reader in getattr(bag, "readers", []):
            limit_chunks(reader)
        clouds = [c for c in bag.connections if c.msgtype == _CLOUD]
        others = sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections if c.msgtype != _CLOUD})
        names = sorted({c.topic for c in clouds})
        beside = f"; of other types {', '.join(others)}" if others else ""
        chosen = names[_choose("topic of type sensor_msgs/PointCloud2", names, topic, beside)]
        n_scans = 0
        for connection, stamp_ns, raw in bag.messages([c for c in clouds if c.topic == chosen]):
            message = bag.deserialize(inflate(bytes(raw), "zstd") if packed else raw, connection.msgtype)
            stamp = message.header.stamp
            stamp_s = stamp.sec + 1e-9 * stamp.nanosec
            n_scans += 1
            yield chosen, message, stamp_s or 1e-9 * stamp_ns
        if not n_scans:
            raise PointsError(f"topic {chosen} has no message; expected point clouds")


def _plain_bag(folder: Path, alive: Callable[[], None]) -> tuple[Path, bool, list[Path]]:
    """A ROS 2 bag without compression, for readers that would unpack without limits.

    Returns folder: The bag's own; or a temporary one, whose files are unpacked, or links to those with compressed
        messages.
    Returns packed: Whether its messages are compressed all the same.
    Returns files: Its MCAP files, if nothing in it is compressed; empty if it has files of another format.
    """
    yaml = require("ruamel.yaml", "ros", "Reading a bag", package="ruamel.yaml")
    information = yaml.YAML(typ="safe").load(folder / "metadata.yaml")["rosbag2_bagfile_information"]
    files = [folder / PurePath(name).name for name in information["relative_file_paths"]]
    mode = str(information.get("compression_mode") or "none").lower()
    if mode not in ("file", "message"):
        return folder, False, files if information["storage_identifier"] == "mcap" else []
    target = Path(tempfile.mkdtemp())
    names = [file.stem if mode == "file" else file.name for file in files]
    left = min(most_bytes(sum(file.stat().st_size for file in files)), shutil.disk_usage(target).free // 2)
    for file, name in zip(files, names, strict=True):
        if mode == "file":
            left -= inflate_file(file, target / name, left, alive)
            continue
        try:
            (target / name).symlink_to(file.absolute())
        except OSError:  # Windows allows links to few users
            shutil.copy(file, target / name)
    plain = {**information, "compression_mode": "", "compression_format": "", "relative_file_paths": names}
    text = json.dumps({"rosbag2_bagfile_information": plain}, default=str)  # JSON is YAML
    (target / "metadata.yaml").write_text(text, encoding="utf-8")
    return target, mode == "message", []


def limit_chunks(reader: Any) -> None:
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
