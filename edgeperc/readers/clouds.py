"""Point cloud messages: of ROS 1 and 2 (``sensor_msgs/PointCloud2``), Livox' and Foxglove's, from bytes to points."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..types.points import Floats32, MapError, as_float64, as_points

# PointField.datatype, from 1.
_CLOUD_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
# foxglove.PackedElementField.NumericType, from 1, as PointField.datatype.
_FOXGLOVE_TYPES = (2, 1, 4, 3, 6, 5, 7, 8)
_MOST_RINGS = 256
_MOST_FIELDS = 1024

# Nearer, a laser's own place in the housing shows in its elevation.
_ELEVATION_FROM_M = 3.0


@dataclass(frozen=True, slots=True)
class PackedField:
    """``sensor_msgs/PointField``."""

    name: str
    offset: int
    datatype: int
    count: int


# Of Livox' own messages: the packages that define one, by encoding, and the fields of a point.
_LIVOX_PACKAGES = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
_LIVOX_CDR = tuple((f"{package}/msg/CustomMsg", "cdr") for package in _LIVOX_PACKAGES)
_LIVOX_ROS1 = tuple((f"{package}/CustomMsg", "ros1") for package in _LIVOX_PACKAGES)
_LIVOX_FIELDS = (
    PackedField("offset_time", 0, 6, 1),
    *(PackedField(name, 4 * k, 7, 1) for k, name in enumerate("xyz", start=1)),
    *(PackedField(name, k, 2, 1) for k, name in enumerate(("reflectivity", "tag", "line"), start=16)),
)


class Stamp(NamedTuple):
    """``builtin_interfaces/Time``."""

    sec: int
    nanosec: int


class Header(NamedTuple):
    """``std_msgs/Header``."""

    stamp: Stamp
    frame_id: str


class Cloud(NamedTuple):
    """``sensor_msgs/PointCloud2``."""

    header: Header
    height: int
    width: int
    fields: tuple[PackedField, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: memoryview


class MessageReader:
    """Values of a message of ROS, one after another; those of CDR (ROS 2) are aligned to their size."""

    def __init__(self, content: memoryview, order: str, *, aligned: bool) -> None:
        self._content, self._order, self.aligned, self._at = content, order, aligned, 0

    @property
    def is_bigendian(self) -> bool:
        """Whether the first byte of a number is the largest."""
        return self._order == ">"

    @property
    def left(self) -> int:
        """Bytes that are not read yet."""
        return len(self._content) - self._at

    def value(self, code: str) -> int:
        """A number, by its code in `struct`."""
        size = struct.calcsize(code)
        if self.aligned:
            self._at += -self._at % size
        (value,) = struct.unpack(self._order + code, self.take(size))
        return int(value)

    def take(self, n_bytes: int) -> memoryview:
        """So many bytes."""
        end = self._at + n_bytes
        if end > len(self._content):
            raise PointsError(f"a message is damaged: it ends at byte {len(self._content):,} of {end:,} or more")
        self._at, taken = end, self._content[self._at : end]
        return taken

    def text(self) -> str:
        """A ``string``."""
        return bytes(self.take(self.value("I"))).rstrip(b"\0").decode("utf-8", "replace")

    def stamp(self) -> Stamp:
        """A ``time``."""
        return Stamp(self.value("i" if self.aligned else "I"), self.value("I"))

    def header(self) -> Header:
        """A ``std_msgs/Header``."""
        if not self.aligned:
            self.value("I")  # ROS 1 counts messages
        return Header(self.stamp(), self.text())


def cdr_reader(content: memoryview) -> MessageReader:
    """Of a message in CDR, behind its header. Raises PointsError."""
    if len(content) < 4 or bytes(content[:2]) not in (b"\0\0", b"\0\1"):
        raise PointsError(f"a message is damaged: it begins with {bytes(content[:4])!r}; expected the header of CDR")
    return MessageReader(content[4:], "<" if content[1] else ">", aligned=True)


def ros1_reader(content: memoryview) -> MessageReader:
    """Of a message of ROS 1."""
    return MessageReader(content, "<", aligned=False)


def _ros_cloud(read: MessageReader) -> Cloud:
    header = read.header()
    height, width, n_fields = (read.value("I") for _ in range(3))
    if n_fields > _MOST_FIELDS:
        raise PointsError(f"a message is damaged: it declares {n_fields:,} fields")
    fields = tuple(PackedField(read.text(), read.value("I"), read.value("B"), read.value("I")) for _ in range(n_fields))
    is_bigendian, point_step, row_step = bool(read.value("B")), read.value("I"), read.value("I")
    data = read.take(read.value("I"))
    return Cloud(header, height, width, fields, is_bigendian, point_step, row_step, data)


def _livox_cloud(read: MessageReader) -> Cloud:
    """``CustomMsg`` of Livox' drivers, as a cloud: points of 19 bytes, in CDR at every fourth byte."""
    header = read.header()
    read.value("Q")  # the time of the first point, as in the header
    read.take(8)  # the number of points, as below; which LiDAR
    n, step = read.value("I"), 20 if read.aligned else 19
    data = bytes(read.take(max(n * step - step + 19, 0))).ljust(n * step, b"\0")
    return Cloud(header, 1, n, _LIVOX_FIELDS, read.is_bigendian, step, n * step, memoryview(data))


def _protobuf(content: memoryview) -> Iterator[tuple[int, Any]]:
    """Number and value of each field: an int, or the bytes of a text or message."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while at < len(content) and shift < 64:
            byte = content[at]
            at, value, shift = at + 1, value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value
        raise PointsError("a message is damaged: a number of protobuf does not end")

    while at < len(content):
        key = varint()
        if key & 7 == 0:
            yield key >> 3, varint()
            continue
        if key & 7 not in (1, 2, 5):
            raise PointsError(f"a message is damaged: protobuf has no wire type {key & 7}")
        size = varint() if key & 7 == 2 else {1: 8, 5: 4}[key & 7]
        if at + size > len(content):
            raise PointsError("a message is damaged: a field of protobuf ends past it")
        part = content[at : at + size]
        at += size
        yield key >> 3, part if key & 7 == 2 else int.from_bytes(part, "little")


def _foxglove_cloud(content: memoryview) -> Cloud:
    """``foxglove.PointCloud``: timestamp 1, frame 2, pose 3, stride 4, fields 5, data 6; points are not posed."""
    stamp = {1: 0, 2: 0}
    frame_id, stride, data, fields = "", 0, memoryview(b""), []
    try:
        for number, value in _protobuf(content):
            if number == 1:
                stamp.update((k, int(v)) for k, v in _protobuf(value))
            elif number == 2:
                frame_id = value.tobytes().decode("utf-8", "replace")
            elif number == 4:
                stride = int(value)
            elif number == 5:
                parts = {1: memoryview(b""), 2: 0, 3: 0, **dict(_protobuf(value))}
                kind = _FOXGLOVE_TYPES[parts[3] - 1] if 1 <= parts[3] <= len(_FOXGLOVE_TYPES) else 0
                fields.append(PackedField(parts[1].tobytes().decode("utf-8", "replace"), int(parts[2]), kind, 1))
            elif number == 6:
                data = value.cast("B")
    except (AttributeError, TypeError, ValueError) as exc:
        raise PointsError(f"a message is damaged: it is not a foxglove.PointCloud ({exc})") from exc
    n = len(data) // stride if stride else 0
    return Cloud(Header(Stamp(stamp[1], stamp[2]), frame_id), 1, n, tuple(fields), False, stride, n * stride, data)


CLOUD_READERS: MappingProxyType[tuple[str, str], Callable[[memoryview], Cloud]] = MappingProxyType(
    {
        ("sensor_msgs/msg/PointCloud2", "cdr"): lambda content: _ros_cloud(cdr_reader(content)),
        ("sensor_msgs/PointCloud2", "ros1"): lambda content: _ros_cloud(ros1_reader(content)),
        ("foxglove.PointCloud", "protobuf"): _foxglove_cloud,
        **dict.fromkeys(_LIVOX_CDR, lambda content: _livox_cloud(cdr_reader(content))),
        **dict.fromkeys(_LIVOX_ROS1, lambda content: _livox_cloud(ros1_reader(content))),
    }
)
"""What reads a point cloud of a type in an encoding."""


def describe_cloud(topic: str, message: Any) -> dict[str, Any]:
    """What a point cloud message says about its sensor; see `decoders.describe`."""
    return {
        "topic": topic,
        "frame": str(message.header.frame_id),
        "fields": [str(f.name) for f in message.fields],
        "elevations_deg": _ring_elevations(message),
    }


def cloud_points(message: Any, *, remission_field: str | None = None) -> Floats32:
    """Convert a ROS ``sensor_msgs/PointCloud2`` message, from any library, to points.

    message : object; with the message's attributes: height, width, fields, is_bigendian, point_step, row_step, data.
        Organized or not; fields in any order, of any type, padded or not.
    remission_field : as in `edgeperc.read_points`; by default ``reflectivity`` if the fields are those of Ouster's
        driver.
    Returns (n, 4) float32, C-contiguous: Row by row. Points that are not finite stay in place.
    Raises PointsError.
    """
    cloud = cloud_table(message)
    if remission_field is None and is_ouster_cloud(cloud.dtype.names or ()):
        remission_field = "reflectivity"
    try:
        return as_points(cloud, remission_field=remission_field)
    except MapError as exc:
        raise PointsError(
            f"the clouds have coordinates of a map (frame {message.header.frame_id!r}), which float32 would round; "
            "take those of the sensor, before they are moved, or save each as a .npy, for origin_m= or --origin X Y Z"
        ) from exc


def cloud_table(message: Any) -> NDArray[Any]:
    """The points of a cloud as a structured array, (height, width).

    Of a cloud in one row, ``row_step`` is not used. Drivers write 0, the number of points, or that of another row
    there: a cloud of several rows whose ``data`` holds exactly its points has them row by row.
    """
    try:
        height, width, step = int(message.height), int(message.width), int(message.point_step)
        row_step = int(message.row_step) if height > 1 else width * step
        data = np.frombuffer(message.data, np.uint8)
        if height > 1 and row_step < width * step and data.size == height * width * step:
            row_step = width * step
        # A field with several values per point, such as a descriptor, is not a coordinate.
        fields = {f.name: f for f in message.fields if f.count in (0, 1) and 1 <= f.datatype <= len(_CLOUD_TYPES)}
        for f in fields.values():  # numpy's own check of this overflows at 2**31, and then it reads foreign memory
            if not 0 <= f.offset <= step - int(_CLOUD_TYPES[f.datatype - 1][1]):
                raise ValueError(f"the field {f.name!r} at byte {f.offset} is not within the {step} bytes of a point")
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
    """Median elevation of each ring or, without rings, of each row of an organized cloud [deg]."""
    cloud = cloud_table(message)
    if "ring" in (cloud.dtype.names or ()):
        ring = as_float64(cloud["ring"].ravel())
    elif 1 < len(cloud) <= _MOST_RINGS:
        ring = np.repeat(np.arange(len(cloud), dtype=np.float64), cloud.shape[1])
    else:
        return []
    points = as_float64(cloud_points(message))
    across = np.hypot(points[:, 0], points[:, 1])
    with np.errstate(invalid="ignore"):
        far = np.isfinite(points).all(axis=1) & (across > _ELEVATION_FROM_M)
        n_rings = int(ring[(ring >= 0.0) & (ring < _MOST_RINGS)].max(initial=-1.0)) + 1
    elevation, ring = np.degrees(np.arctan2(points[far, 2], across[far])), ring[far]
    return [round(float(np.median(elevation[ring == k])), 3) if np.any(ring == k) else None for k in range(n_rings)]
