"""Packet captures: the UDP datagrams in their packets, and those that are whole."""

from __future__ import annotations

import heapq
import ipaddress
import math
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from .pcap import PCAP_MAGIC, CutShortError, pcap_packets
from .ports import Datagram, is_port, listen

LVX_MAGIC = b"livox_tech"
"""First bytes of Livox' own files."""

# First bytes of captures.
_MAGIC = {
    **dict.fromkeys(PCAP_MAGIC, ".pcap"),
    b"#ROSBAG V": ".bag",
    b"\x89MCAP0\r\n": ".mcap",
    b"SQLite format 3\0": ".db3",
    LVX_MAGIC: ".lvx2",
}

# Bytes in front of the IP header and the place of the EtherType, by the link type: Ethernet, Linux cooked 1 and 2.
_LINKS = {1: (14, 12), 113: (16, 14), 276: (20, 0)}
_FRAGMENT = 44  # header of IPv6
_LOOPBACK_LINKS, _RAW_LINKS = (0, 108), (12, 14, 101, 228)  # four bytes in front of the IP header, none

VELODYNE_BYTES = 1206
GPS_BYTES = 512  # of a Velodyne's packet with its position
DIFOP = bytes.fromhex("a5ff005a11115555")
"""The first bytes of what RoboSense's sensors say of themselves."""
_FLAG = b"\xff\xee"  # 0xEEFF, with which the first of twelve blocks begins

# The last byte of a Velodyne's packet, behind the return mode: the model's beam angles. The first VLS-128 had others.
_PRODUCTS = {
    0x21: "hdl-32e",
    0x22: "vlp-16",
    0x23: "VLP-32A or VLP-32B",
    0x24: "vlp-16-hi-res",
    0x28: "vlp-32c",
    0x63: "VLS-128",
    0xA1: "vls-128",
}
_RETURN_MODES = (0x37, 0x38, 0x39, 0x3A, 0x3B)

# A packet that comes later than the next ones is at most so late, and so many wait for it.
_OVERTAKEN_S, _OVERTAKING = 0.05, 32
_HOUR_S = 3600.0

# Enough to find a LiDAR's packet among those of a GPS, and quick to read.
SNIFFED_PACKETS = 2000

# Of a sensor's packets; of a damaged address, there are fewer.
_LEAST_SHARE, _FEWEST_PACKETS = 0.05, 60

# Datagrams of which fragments are awaited; more than a few at the same time are damage.
_PENDING = 256


def capture_kind(head: bytes) -> str | None:
    """The kind of a capture with these first bytes, by its suffix; None if they are of none."""
    if head[8:11] == b"OSF":
        return ".osf"
    return next((kind for magic, kind in _MAGIC.items() if head.startswith(magic)), None)


class _EndsEarlyError(ValueError):
    """A packet was not captured to its end."""


class _Fragment(NamedTuple):
    source: bytes  # addresses and identification: the same for all fragments of a datagram
    sender: memoryview
    start: int
    more: bool
    payload: memoryview


class Datagrams:
    """The whole UDP datagrams of a pcap file, put together from fragments, each once; other packets are left out. Of
    ports, the first ones, or all until there is silence.

    most : packets of the file that are looked at; None: all.
    endless : of ports, not the first ones alone.
    n_bad : so far, those that are empty, incomplete, or contradict themselves.
    n_cut : packets of them that end early.
    n_packets, cut : of the file so far, and what is wrong where it ends early.
    """

    def __init__(
        self, path: Path, alive: Callable[[], None], most: int | None = None, *, endless: bool = False
    ) -> None:
        self._path, self._alive, self._most, self._endless = path, alive, most, endless
        self.n_bad = self.n_cut = self.n_packets = 0
        self.cut: CutShortError | None = None
        self._pending: dict[bytes, list[memoryview]] = {}  # by source: fragments so far

    def __iter__(self) -> Iterator[Datagram]:
        before: tuple[memoryview | str | int, ...] = ()
        if is_port(self._path):
            listener = listen(self._path)
            for datagram in listener.run(self._alive) if self._endless else listener.first(self._alive):
                if self.n_packets % 10_000 == 0:
                    self._alive()
                self.n_packets += 1
                if (datagram.payload, datagram.sender, datagram.port) != before:
                    yield datagram
                before = datagram.payload, datagram.sender, datagram.port
            return
        try:
            for link, stamp_s, packet in islice(pcap_packets(self._path), self._most):
                if self.n_packets % 10_000 == 0:
                    self._alive()
                self.n_packets += 1
                try:
                    part = _fragment(packet, link)
                    payload = None if part is None else self._whole(part)
                except ValueError as exc:
                    self.n_bad += 1
                    self.n_cut += isinstance(exc, _EndsEarlyError)
                    continue
                if part is not None and payload is not None:
                    port, length = struct.unpack_from(">2xHH", payload)
                    if length != len(payload) or length == 8:
                        self.n_bad += 1
                        continue
                    if length > GPS_BYTES and (part.sender, payload) == before:  # on two interfaces, or mirrored
                        continue
                    before = part.sender, payload
                    yield Datagram(_address(bytes(part.sender)), port, stamp_s, payload[8:])
            self.n_bad += len(self._pending)
        except CutShortError as exc:  # whoever reads the whole file says it
            self.cut = exc

    def _whole(self, part: _Fragment) -> memoryview | None:
        """The datagram that ends with a fragment, None if it is not there yet; ValueError if a part is missing."""
        parts = self._pending.pop(part.source, [])
        if part.start == 0 and parts:  # a second beginning: the first datagram lacks its end
            self.n_bad += 1
            parts = []
        if part.start != sum(map(len, parts)) or (not parts and len(part.payload) < 8):
            raise ValueError
        parts.append(part.payload)
        if not part.more:
            return parts[0] if len(parts) == 1 else memoryview(b"".join(parts))
        self._pending[part.source] = parts
        if len(self._pending) > _PENDING:
            del self._pending[next(iter(self._pending))]
            self.n_bad += 1
        return None


def sender_names(counts: Mapping[tuple[str, int], int]) -> list[str]:
    """Names of the sensors that send packets: the address, with the port where those of one address go to several.

    counts : packets by address and port; few are damaged, unless they are as many as in a tenth of a second.
    """
    fewest = min(_FEWEST_PACKETS, _LEAST_SHARE * max(counts.values(), default=0))
    known = [source for source, n in counts.items() if n >= fewest]
    ports = Counter(address for address, _ in known)
    return sorted(address if ports[address] == 1 else f"{address}:{port}" for address, port in known)


def velodyne_packets(path: Path, sender: str | None = None) -> Iterator[memoryview]:
    """A Velodyne's packets among the first of a pcap file, or of a sender, of 1206 bytes each.

    sender : one of `Senders.velodynes`; None: all.
    """
    datagrams = Datagrams(path, lambda: None, SNIFFED_PACKETS if sender is None else None)
    known = (each.payload for each in datagrams if is_of_velodyne(each) and each.is_from(sender))
    yield from islice(known, SNIFFED_PACKETS)
    yield from (packet for _, packet in _bare_velodyne_packets(path, SNIFFED_PACKETS))


def velodyne_captured(
    path: Path, alive: Callable[[], None], sender: str | None, *, endless: bool = False
) -> Iterator[tuple[float, memoryview]]:
    """When each packet of a Velodyne, of a sender or all, was captured, and the packet, in the order of its clock."""
    are_sent = False
    datagrams = Datagrams(path, alive, endless=endless)
    for datagram in in_order(each for each in datagrams if each.is_from(sender)):
        if len(datagram.payload) == VELODYNE_BYTES:
            are_sent = True
            yield datagram.stamp_s, datagram.payload
    if not are_sent:
        yield from _bare_velodyne_packets(path)


class Newest:
    """Tells packets that others have overtaken, by the sensor's clock: they begin no scan."""

    _s = -math.inf

    def has_overtaken(self, now_s: float) -> bool:
        """Whether a packet of this time is late; a clock that goes back farther was set."""
        is_late = 0.0 < self._s - now_s < _OVERTAKEN_S
        self._s = self._s if is_late else now_s
        return is_late


def _turned_s(datagram: Datagram, before_s: float) -> float:
    """The time of a Velodyne's packet, which begins anew each hour, as near to that of one before as it can be [s]."""
    now_s = 1e-6 * int.from_bytes(datagram.payload[1200:1204], "little")
    return before_s + (now_s - before_s + 0.5 * _HOUR_S) % _HOUR_S - 0.5 * _HOUR_S


def in_order(datagrams: Iterable[Datagram]) -> Iterator[Datagram]:
    """A Velodyne's packets in the order of its clock, where a network or a capture let them overtake one another."""
    waiting, latest_s = list[tuple[float, int, Datagram]](), 0.0
    for k, datagram in enumerate(datagrams):
        if not is_of_velodyne(datagram):
            yield datagram
            continue
        now_s = _turned_s(datagram, latest_s)
        if abs(now_s - latest_s) > _OVERTAKEN_S:  # the clock was set
            yield from (each for *_, each in sorted(waiting))
            waiting = []
            latest_s = now_s
        latest_s = max(latest_s, now_s)
        heapq.heappush(waiting, (now_s, k, datagram))
        if len(waiting) > _OVERTAKING:
            yield heapq.heappop(waiting)[-1]
    yield from (each for *_, each in sorted(waiting))


def velodyne_name(packet: memoryview) -> str | None:
    """The model of a Velodyne, None if the packet does not name it."""
    blocks = {bytes(packet[k : k + 2]) for k in range(0, 1200, 100)}
    if blocks & {b"\xff\xcc", b"\xff\xbb"}:
        return _PRODUCTS[0xA1 if packet[-1] == 0xA1 else 0x63]
    if b"\xff\xdd" in blocks:  # the second half of the lasers; the last bytes hold its status instead
        return "hdl-64e"
    return _PRODUCTS.get(packet[-1]) if packet[-2] in _RETURN_MODES else None


def is_of_velodyne(datagram: Datagram) -> bool:
    """Whether it is a Velodyne's by its size and its first bytes."""
    return len(datagram.payload) == VELODYNE_BYTES and bytes(datagram.payload[:2]) == _FLAG


def _bare_velodyne_packets(path: Path, most: int | None = None) -> Iterator[tuple[float, memoryview]]:
    """When those among the first, or all, were captured whose sender is not known, and the packets."""
    captured = () if is_port(path) else pcap_packets(path, whole=False)
    for link, stamp_s, packet in islice(captured, most):
        if len(packet) > VELODYNE_BYTES and bytes(packet[-VELODYNE_BYTES : 2 - VELODYNE_BYTES]) == _FLAG:
            try:
                at = _ip_at(packet, link)
            except ValueError:
                at = None
            if at is None or len(packet) < at + 28 + VELODYNE_BYTES:
                yield stamp_s, packet[-VELODYNE_BYTES:]


def _ip_at(packet: memoryview, link: int) -> int | None:
    """Where the header of IP begins in a packet, None if there is none; ValueError if it is cut inside the link's."""
    if link in _LINKS:
        offset, kind = _LINKS[link]
        if len(packet) < offset:
            raise ValueError("cut inside the link's header")
        while bytes(packet[kind : kind + 2]) in (b"\x81\x00", b"\x88\xa8") and len(packet) >= offset + 4:  # a VLAN
            offset, kind = offset + 4, kind + 4
        return offset if bytes(packet[kind : kind + 2]) in (b"\x08\x00", b"\x86\xdd") else None
    if link in _LOOPBACK_LINKS:
        return 4
    return 0 if link in _RAW_LINKS else None


def _fragment(packet: memoryview, link: int) -> _Fragment | None:
    """The part of a UDP datagram in a packet, None if it holds none; ValueError if lengths contradict."""
    offset = _ip_at(packet, link)
    if offset is None:
        return None
    if len(packet) < offset + 20:
        raise ValueError("cut inside the IP header")
    if packet[offset] >> 4 == 6:
        return _fragment_6(packet[offset:])
    if packet[offset] >> 4 != 4 or packet[offset + 9] != 17:
        return None
    header = 4 * (packet[offset] & 15)
    total, identification, place = struct.unpack_from(">HHH", packet, offset + 2)
    if 20 <= header < total and total > len(packet) - offset:
        raise _EndsEarlyError("the record is shorter than the length in the IP header")
    if not 20 <= header < total:
        raise ValueError("the length in the IP header contradicts the record")
    source = bytes(packet[offset + 12 : offset + 20]) + identification.to_bytes(2, "big")
    payload = packet[offset + header : offset + total]
    return _Fragment(source, packet[offset + 12 : offset + 16], 8 * (place & 0x1FFF), bool(place & 0x2000), payload)


def _fragment_6(packet: memoryview) -> _Fragment | None:
    """The same of a packet that begins with the header of IPv6."""
    if len(packet) < 48:
        raise ValueError("cut inside the IP header")
    kind, total = packet[6], 40 + int.from_bytes(packet[4:6], "big")
    if total > len(packet):
        raise _EndsEarlyError("the record is shorter than the length in the IP header")
    begin, place, identification = 40, 0, b""
    if kind == _FRAGMENT:
        kind, begin, place, identification = packet[40], 48, int.from_bytes(packet[42:44], "big"), bytes(packet[44:48])
    if kind != 17:
        return None
    source = bytes(packet[8:40]) + identification
    return _Fragment(source, packet[8:24], place & 0xFFF8, bool(place & 1), packet[begin:total])


@lru_cache(maxsize=256)
def _address(packed: bytes) -> str:
    return str(ipaddress.ip_address(packed))
