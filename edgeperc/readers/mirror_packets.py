"""Packets of Hesai's AT128: its mirrors turn, and what one of them sweeps is a frame.

A block has the angle of the motor. The correction file of the unit says where each mirror begins and ends, and where
each laser looks. Angles are in 1/256 of a hundredth of a degree.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import PointsError
from ..types.points import Floats, Ints64
from .packets import Newest
from .spinning_packets import Format, time_of
from .times import TimedScan
from .units import Told

_DEGREE = 25_600
_TURN = 360 * _DEGREE
_MOTOR = struct.Struct("<HB")  # hundredths of a degree, and 256ths of one
_N_LASERS, _N_STEPS, _STEP = 128, 180, 2 * _DEGREE  # a correction every two degrees of the motor
_MOST_MIRRORS = 8
_MOST_PACKETS = 10_000  # of a frame, which has 600; 1,200 with two returns
_BLOCK_US, _LATE_US = 41.666, 50.915  # from block to block, and from the last block to the time of the packet


class Mirrors(NamedTuple):
    """A unit's correction file: the motor's angle where each mirror begins and ends, (2, lasers) azimuth and elevation,
    and how far they are off at each step of the motor, (2, lasers, steps).
    """

    begins: list[int]
    ends: list[int]
    lasers: Ints64
    off: Ints64

    def at(self, motor: int) -> int:
        """Which mirror is in front of the lasers at this angle of the motor; -1: none."""
        for mirror, (begin, end) in enumerate(zip(self.begins, self.ends, strict=True)):
            if motor < _TURN and (motor - begin) % _TURN <= (end - begin) % _TURN:
                return mirror
        return -1


def read_mirrors(path: Path | Told) -> Mirrors:
    """Raises PointsError: It is not the correction file of an AT128, of version 1.5."""
    content = path.read_bytes()[: 1 << 20]
    begin = max(content.find(b"\xee\xff"), 0)
    head = content[begin : begin + 16].ljust(16, b"\0")
    n, resolution = head[6], head[15]
    size = 16 + 8 * n + 8 * _N_LASERS + 2 * _N_LASERS * _N_STEPS
    rest = content[begin + 16 : begin + size]
    known = b"\xee\xff\1\5" + bytes([_N_LASERS])
    if not (head.startswith(known) and 0 < n <= _MOST_MIRRORS and resolution):
        raise PointsError(
            f"{path.name} is not a correction file of a Hesai AT128: it begins with {head.hex(' ')}; expected "
            f"{known.hex(' ')} for version 1.5 and 128 lasers, 1 to {_MOST_MIRRORS} mirrors and a resolution"
        )
    if len(rest) != size - 16:
        raise PointsError(f"{path.name} has {len(content):,} bytes of {begin + size:,}; it is cut short")
    words, off = np.frombuffer(rest[: 8 * (n + _N_LASERS)], "<i4"), np.frombuffer(rest[8 * (n + _N_LASERS) :], np.int8)
    angles = resolution * words.astype(np.int64)
    steps = 256 * resolution * off.astype(np.int64).reshape(2, _N_LASERS, _N_STEPS)
    return Mirrors(angles[:n].tolist(), angles[n : 2 * n].tolist(), angles[2 * n :].reshape(2, _N_LASERS), steps)


class _Packet(NamedTuple):
    content: bytes
    time_s: float
    motor: list[int]  # its angles at the blocks
    shown: list[bool]  # blocks of this frame


class MirrorStream:
    """Frames from the packets of an AT128."""

    def __init__(self, row: Format, mirrors: Mirrors) -> None:
        self.row, self._mirrors = row, mirrors
        self._off = np.moveaxis(mirrors.off, 2, 0).copy()
        self._packets, self._mirror, self._size, self._newest = list[_Packet](), -1, 0, Newest()

    def add(self, payload: memoryview) -> Iterator[TimedScan]:
        """The frames that end in a packet of the format: where another mirror begins. All have the size of the first;
        others are left out, and what comes late of a mirror before.
        """
        self._size = self._size or len(payload)
        if len(payload) != self._size:
            return
        row, mirrors = self.row, self._mirrors
        angles = (_MOTOR.unpack_from(payload, at) for at in row.blocks_at)
        motor = [256 * hundredths + fine for hundredths, fine in angles]
        seen, time_s = [mirrors.at(angle) for angle in motor], time_of(row.clock, payload)
        is_late = self._newest.has_overtaken(time_s)
        for mirror in dict.fromkeys(seen):
            if mirror < 0 or (is_late and mirror != self._mirror):
                continue
            if mirror != self._mirror or len(self._packets) >= _MOST_PACKETS:
                yield from self.end()
            self._mirror = mirror
            self._packets.append(_Packet(bytes(payload), time_s, motor, [each == mirror for each in seen]))

    def end(self) -> Iterator[TimedScan]:
        """The last frame, which may be a part."""
        packets, self._packets = self._packets, []
        if not packets:
            return
        row = self.row
        content = np.frombuffer(b"".join(each.content for each in packets), np.uint8).reshape(len(packets), -1)
        blocks = content[:, row.header : row.blocks_at.stop].reshape(-1, row.block_bytes)
        returns = blocks[:, row.first :].reshape(len(packets), row.n_blocks, _N_LASERS, row.channel_bytes)
        units = returns[..., 0].astype(np.int64) | returns[..., 1].astype(np.int64) << 8
        motor = np.array([each.motor for each in packets])
        is_second = (motor[:, 1] == motor[:, 0])[:, None]  # of two returns
        units[:, 1][is_second & (units[:, 1] == units[:, 0])] = 0
        late_us = np.where(is_second, [0.0, 0.0], [_BLOCK_US, 0.0]) + _LATE_US
        times_s = np.array([each.time_s for each in packets])[:, None] - 1e-6 * late_us
        fired_s = times_s[..., None] + 1e-6 * np.array(row.fires_us)
        shown = (units > 0) & np.array([each.shown for each in packets])[..., None]
        azimuth, elevation = (angles[shown] for angles in np.moveaxis(self._directions(motor), 2, 0))
        ranges = 1e-3 * packets[0].content[row.mm_at] * units[shown]
        flat = ranges * np.cos(elevation)
        values = (flat * np.sin(azimuth), flat * np.cos(azimuth), ranges * np.sin(elevation), returns[..., 2][shown])
        scan, fired_s = np.stack(values, axis=1).astype(np.float32), fired_s[shown]
        yield TimedScan(float(fired_s.max() if len(scan) else times_s[0, 1]), scan, fired_s)

    def _directions(self, motor: Ints64) -> Floats:
        """Azimuth and elevation of each laser [rad], (packets, blocks, 2, lasers), by the motor's angle; a mirror turns
        a ray by twice its own.
        """
        step, rest = np.divmod(motor, _STEP)
        share = (rest / _STEP)[..., None, None]
        near, far = (self._off[(step + k) % _N_STEPS] for k in (0, 1))
        off = (1.0 - share) * near + share * far
        azimuth, elevation = self._mirrors.lasers
        swept = 2 * (motor - self._mirrors.begins[self._mirror])[..., None]
        exact = np.stack(np.broadcast_arrays(swept - azimuth, elevation), axis=2)
        return np.radians(exact + off) / _DEGREE
