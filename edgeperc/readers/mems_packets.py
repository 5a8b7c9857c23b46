"""Packets of RoboSense's sensors whose mirror sweeps become scans: M1 and E1.

A packet says where each point is, so nothing need be known of the unit. A frame ends where packets are counted anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..types.points import Floats
from .packets import Newest
from .times import TimedScan

_MAGIC = bytes.fromhex("55aa5aa5")
_UNIT_M = 0.005
_MOST_PACKETS = 10_000  # of a frame; an M1 has 1,260 with two returns

_ANGLES = [("distance", ">u2"), ("pitch", ">u2"), ("yaw", ">u2"), ("reflectivity", "u1"), ("more", "V2")]
_VECTOR = [("distance", ">u2"), ("x", ">i2"), ("y", ">i2"), ("z", ">i2"), ("reflectivity", "u1"), ("more", "V1")]


class MemsFormat(NamedTuple):
    """Packets of one model."""

    name: str
    title: str  # the model, as its maker calls it
    packet: np.dtype[Any]
    ahead: Callable[[NDArray[Any]], Floats]  # of points: their directions, (..., 3)
    spins: bool = False  # as of `spinning_packets.Format`

    def fits(self, payload: memoryview) -> bool:
        """Whether it is a packet of this format."""
        return mems_format_of(payload) is self


def _packet(size: int, block: list[Any], n_blocks: int) -> np.dtype[Any]:
    names = ["number", "high", "low", "micros", "blocks"]
    formats = [">u2", ">u2", ">u4", ">u4", (np.dtype(block), n_blocks)]
    return np.dtype({"names": names, "formats": formats, "offsets": [4, 10, 12, 16, 32], "itemsize": size})


def _by_angles(points: NDArray[Any]) -> Floats:
    pitch, yaw = (np.radians(0.01 * (points[name].astype(np.float64) - 32768.0)) for name in ("pitch", "yaw"))
    return np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=-1)


def _by_vectors(points: NDArray[Any]) -> Floats:
    return np.stack([points[name] / 32768.0 for name in "xyz"], axis=-1)


_OF_M1 = _packet(1210, [("micros", "u1"), ("turn", "u1"), ("points", _ANGLES, 5)], 25)
_OF_E1 = _packet(1200, [("micros", ">u2"), ("points", _VECTOR, 1)], 96)
MEMS_FORMATS = MappingProxyType(
    {
        1210: MemsFormat("rs-m1", "RoboSense M1", _OF_M1, _by_angles),
        1200: MemsFormat("rs-e1", "RoboSense E1", _OF_E1, _by_vectors),
    }
)
"""By the bytes of a packet."""


def mems_format_of(payload: memoryview) -> MemsFormat | None:
    """The format of a packet with points; None if it is of another sensor."""
    return MEMS_FORMATS.get(len(payload)) if bytes(payload[:4]) == _MAGIC else None


class MemsStream:
    """Frames from packets of one format."""

    def __init__(self, row: MemsFormat) -> None:
        self.row, self._packets, self._last, self._newest = row, list[bytes](), -1, Newest()

    def add(self, payload: memoryview) -> Iterator[TimedScan]:
        """The frame that ends before a packet: where packets are counted anew. A late one is of that it comes in."""
        number = int.from_bytes(payload[4:6], "big")
        now_s = int.from_bytes(payload[10:16], "big") + 1e-6 * int.from_bytes(payload[16:20], "big")
        if self._newest.has_overtaken(now_s):
            number = self._last
        if number < self._last or len(self._packets) >= _MOST_PACKETS:
            yield from self.end()
        self._last = max(self._last, number)
        self._packets.append(bytes(payload))

    def end(self) -> Iterator[TimedScan]:
        """The last frame, which may be a part."""
        packets, self._packets, self._last = np.frombuffer(b"".join(self._packets), self.row.packet), [], -1
        if not len(packets):
            return
        points = packets["blocks"]["points"]
        seconds = packets["high"].astype(np.float64) * 2.0**32 + packets["low"]
        times_s = (seconds + 1e-6 * packets["micros"])[:, None] + 1e-6 * packets["blocks"]["micros"]
        shown = points["distance"] > 0
        kept = points[shown]
        scan = np.empty((len(kept), 4), np.float32)
        scan[:, :3] = _UNIT_M * kept["distance"].astype(np.float64)[:, None] * self.row.ahead(kept)
        scan[:, 3] = kept["reflectivity"]
        yield TimedScan(float(times_s.max()), scan, np.broadcast_to(times_s[..., None], shown.shape)[shown])
