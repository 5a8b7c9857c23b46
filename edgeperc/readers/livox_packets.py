"""Livox' points: packets of both protocols, and .lvx2 files. They are gathered over tenths of a second."""

from __future__ import annotations

import calendar
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..errors import PointsError
from ..system.kernels import njit
from ..types.points import Bytes, Floats32, Ints64
from .packets import LVX_MAGIC, Newest
from .times import TimedScan

SCAN_S = 0.1  # the sensors turn or sweep ten times a second


class _Kind(NamedTuple):
    """How points are written."""

    stride: int  # bytes from one to the next
    returns: int  # points of one moment
    layout: int  # bytes of x, y and z: 4 or 2; 3: distance, zenith angle and azimuth


_WIDE, _NARROW, _POLAR = 4, 2, 3
# By the data types of the new protocol (Mid-360, HAP; .lvx2), and of the old one (Mid-40 to Avia).
NEW_KINDS: Mapping[int, _Kind] = MappingProxyType(
    {1: _Kind(14, 1, _WIDE), 2: _Kind(8, 1, _NARROW), 3: _Kind(10, 1, _POLAR), 0x11: _Kind(14, 2, _WIDE)}
)
OLD_KINDS: Mapping[int, _Kind] = MappingProxyType(
    {0: _Kind(13, 1, _WIDE), 1: _Kind(9, 1, _POLAR), 2: _Kind(14, 1, _WIDE), 3: _Kind(10, 1, _POLAR),
     4: _Kind(14, 2, _WIDE), 7: _Kind(14, 3, _WIDE)}
)  # fmt: skip
_NEW_HEADER, _OLD_HEADER, _PACKAGE = 36, 18, 27
_OLD_POINTS = {0: 100, 1: 100, 2: 96, 3: 96, 4: 96, 7: 90}

# An .lvx2 file: headers of the file, of the device and of a frame.
_FILE_BYTES, _DEVICE_BYTES, _FRAME_BYTES = 29, 63, 24
_USUAL_GAP_S = 96 / 200_000.0  # between packets of a Mid-360
_LONGEST_GAP_S = 0.01


class Points(NamedTuple):
    """The points of a packet: when the first was measured, how long they took (0: not said), and their bytes."""

    time_s: float
    duration_s: float
    kind: _Kind
    content: bytes


def points_of(payload: memoryview) -> Points | None:
    """The points that a packet carries; None if it is no packet of points, or of a kind that is not decoded."""
    if len(payload) < _OLD_HEADER:
        return None
    if payload[0] == 0 and len(payload) > _NEW_HEADER:
        length, tenths_us, n, kind = *struct.unpack_from("<HHH", payload, 1), NEW_KINDS.get(payload[10])
        (stamp_ns,) = struct.unpack_from("<Q", payload, 28)
        content = payload[_NEW_HEADER:]
        if kind is None or length not in (0, len(payload)) or n * kind.stride * kind.returns != len(content) or not n:
            return None
        return Points(1e-9 * stamp_ns, 1e-7 * tenths_us, kind, bytes(content))
    kind, content = OLD_KINDS.get(payload[9]), payload[_OLD_HEADER:]
    if payload[0] != 5 or kind is None or len(content) != _OLD_POINTS[payload[9]] * kind.stride:
        return None
    return Points(_old_time(payload[8], bytes(payload[10:18])), 0.0, kind, bytes(content))


def _old_time(kind: int, stamp: bytes) -> float:
    if kind == 3 and 1 <= stamp[1] <= 12:  # of a GPS: the hour, and microseconds in it
        hour = calendar.timegm((2000 + stamp[0], stamp[1], stamp[2], stamp[3], 0, 0))
        return hour + 1e-6 * int.from_bytes(stamp[4:], "little")
    return 1e-9 * int.from_bytes(stamp, "little")


@njit(cache=True, nogil=True)
def fill_points(content: Bytes, stride: int, layout: int, points: Floats32, which: Ints64) -> int:
    """Put the points that returned into an array, and their numbers in the content into ``which``; returns how many.

    layout : 4: x, y, z in mm of 4 bytes; 2: in cm of 2 bytes; 3: mm of 4 bytes, zenith angle and azimuth of 2 bytes.
    """
    n = 0
    for k in range(len(which)):
        at = k * stride
        values = (np.int64(0), np.int64(0), np.int64(0))
        a, b, c = values
        if layout == 3:
            for j in range(4):
                a |= np.int64(content[at + j]) << (8 * j)
            b = np.int64(content[at + 4]) | np.int64(content[at + 5]) << 8
            c = np.int64(content[at + 6]) | np.int64(content[at + 7]) << 8
            remission = content[at + 8]
            if a == 0:
                continue
            zenith, azimuth = np.radians(0.01 * b), np.radians(0.01 * c)
            flat = 1e-3 * a * np.sin(zenith)
            points[n, 0], points[n, 1] = flat * np.cos(azimuth), flat * np.sin(azimuth)
            points[n, 2] = 1e-3 * a * np.cos(zenith)
        else:
            top = np.int64(1) << (8 * layout - 1)
            for j in range(layout):
                a |= np.int64(content[at + j]) << (8 * j)
                b |= np.int64(content[at + layout + j]) << (8 * j)
                c |= np.int64(content[at + 2 * layout + j]) << (8 * j)
            remission = content[at + 3 * layout]
            a, b, c = (a ^ top) - top, (b ^ top) - top, (c ^ top) - top
            if a == 0 and b == 0 and c == 0:
                continue
            unit = 1e-3 if layout == 4 else 1e-2
            points[n, 0], points[n, 1], points[n, 2] = unit * a, unit * b, unit * c
        points[n, 3] = remission
        which[n] = k
        n += 1
    return n


class LivoxStream:
    """Scans from packets of points: all of a tenth of a second."""

    def __init__(self) -> None:
        self._packets: list[Points] = []
        self._newest = Newest()

    def add(self, packet: Points) -> Iterator[TimedScan]:
        """The scan that ends before a packet; one that comes late is of the scan that it comes in."""
        first, is_late = self._packets[0] if self._packets else packet, self._newest.has_overtaken(packet.time_s)
        is_of_scan = is_late or first.time_s <= packet.time_s < first.time_s + SCAN_S - 1e-6
        if not is_of_scan or packet.kind != first.kind:
            yield from self.end()
        self._packets.append(packet)

    def end(self) -> Iterator[TimedScan]:
        """The last scan, which may be a part."""
        packets, self._packets = self._packets, []
        if not packets:
            return
        kind = packets[0].kind
        content = np.frombuffer(b"".join(packet.content for packet in packets), np.uint8)
        n_points = np.array([len(packet.content) // kind.stride for packet in packets])
        starts_s = np.array([packet.time_s for packet in packets])
        gaps_s = np.diff(starts_s)
        gaps_s = gaps_s[(gaps_s > 0.0) & (gaps_s < _LONGEST_GAP_S)]
        gap_s = float(np.median(gaps_s)) if len(gaps_s) else _USUAL_GAP_S
        durations_s = np.array([packet.duration_s or gap_s for packet in packets])
        firsts = np.cumsum(n_points) - n_points
        rank = (np.arange(n_points.sum()) - np.repeat(firsts, n_points)) // kind.returns
        times_s = np.repeat(starts_s, n_points) + rank * np.repeat(durations_s * kind.returns / n_points, n_points)
        points, which = np.empty((len(rank), 4), np.float32), np.empty(len(rank), np.int64)
        n = fill_points(content, kind.stride, kind.layout, points, which)
        yield TimedScan(float(times_s.max()), points[:n].copy(), times_s[which[:n]])


def lvx2_sensors(path: Path) -> list[str]:
    """The serial numbers of the sensors in an .lvx2 file."""
    return [serial for serial, _ in _devices(np.memmap(path, np.uint8, "r").data)]


def _devices(data: memoryview) -> list[tuple[str, int]]:
    """Serial number and id of each sensor."""
    if len(data) < _FILE_BYTES or bytes(data[:10]) != LVX_MAGIC:
        raise PointsError("cut short: expected an .lvx2 file, which begins with 29 bytes about its sensors")
    if data[16] != 2:
        raise PointsError(
            f"an .lvx file of version {data[16]}, which is not read; save it as .lvx2 with Livox Viewer 2"
        )
    devices = []
    for at in range(_FILE_BYTES, _FILE_BYTES + data[28] * _DEVICE_BYTES, _DEVICE_BYTES):
        if at + _DEVICE_BYTES > len(data):
            raise PointsError("cut short: the .lvx2 file ends in the list of its sensors")
        serial = bytes(data[at : at + 16]).partition(b"\0")[0].decode("ascii", "replace")
        devices.append((serial, int.from_bytes(data[at + 32 : at + 36], "little")))
    return devices


def lvx2_scans(path: Path, chosen: int, alive: Callable[[], None]) -> Iterator[TimedScan]:
    """The scans of one sensor, by its place among `lvx2_sensors`; PointsError comes after those before a damage."""
    data = np.memmap(path, np.uint8, "r").data
    devices, stream = _devices(data), LivoxStream()
    only = devices[chosen][1] if len(devices) > 1 else None
    try:
        for points in _packages(data, _FILE_BYTES + len(devices) * _DEVICE_BYTES, only, alive):
            yield from stream.add(points)
    except PointsError:
        yield from stream.end()
        raise
    yield from stream.end()


def _packages(data: memoryview, at: int, only: int | None, alive: Callable[[], None]) -> Iterator[Points]:
    """The points in the frames of an .lvx2 file, of one sensor or all."""
    while at < len(data):
        alive()
        end = int.from_bytes(data[at + 8 : at + 16], "little") if at + _FRAME_BYTES <= len(data) else 0
        if not at + _FRAME_BYTES <= end <= len(data):
            raise PointsError(f"cut short or damaged: the frame at byte {at:,} of {len(data):,} is not whole")
        at += _FRAME_BYTES
        while at < end:
            length = int.from_bytes(data[at + 18 : at + 22], "little") if at + _PACKAGE <= end else len(data)
            if at + _PACKAGE + length > end:
                raise PointsError(f"damaged: the package at byte {at:,} is longer than its frame")
            kind, sensor = NEW_KINDS.get(data[at + 17]), int.from_bytes(data[at + 1 : at + 5], "little")
            content = data[at + _PACKAGE : at + _PACKAGE + length]
            if kind is not None and only in (None, sensor) and length and length % (kind.stride * kind.returns) == 0:
                stamp_s = 1e-9 * int.from_bytes(data[at + 7 : at + 15], "little")
                yield Points(stamp_s, 0.0, kind, bytes(content))
            at += _PACKAGE + length
