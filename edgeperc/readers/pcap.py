"""Files of captured packets, pcap and pcapng: the packets in their records or blocks."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import PointsError

# First bytes of a pcap file, and the byte order that they stand for; those of a section of a pcapng file, and its own.
_ORDERS = {b"\xd4\xc3\xb2\xa1": "<", b"\xa1\xb2\xc3\xd4": ">", b"\x4d\x3c\xb2\xa1": "<", b"\xa1\xb2\x3c\x4d": ">"}
_SECTION = b"\x0a\x0d\x0d\x0a"
_SECTION_ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}

PCAP_MAGIC = (*_ORDERS, _SECTION)
"""First bytes of files of captured packets."""

# Blocks of pcapng that are read, and options of an interface.
_INTERFACE, _OLD, _SIMPLE, _ENHANCED, _NEW_SECTION = 1, 2, 3, 6, 0x0A0D0D0A
_RESOLUTION, _OFFSET = 9, 14


class Captured(NamedTuple):
    """A captured packet."""

    link: int  # link type of the interface
    stamp_s: float  # when it was captured; 0 if the file does not say
    data: memoryview  # the packet with its network headers


class _Interface(NamedTuple):
    link: int
    most: int  # bytes captured of a packet; 0: all
    ticks: int  # of a second
    offset: int  # of the stamps, in ticks


class CutShortError(PointsError):
    """The file ends inside a packet, or is damaged there."""


class _DamageError(Exception):
    """What is wrong in front of the word "packet", and at which byte."""


def pcap_packets(path: Path, whole: bool = True) -> Iterator[Captured]:
    """The packets of a file, up to where it is damaged or ends, which is a `CutShortError` if ``whole``."""
    size = path.stat().st_size
    if size < 24:
        raise PointsError(f"cut short: {size} bytes; expected a pcap file of 24 bytes and more")
    data = np.memmap(path, np.uint8, "r").data
    magic, n_packets = bytes(data[:4]), 0
    if magic not in PCAP_MAGIC:
        raise PointsError("not a pcap file by its first bytes")
    try:
        for packet in _of_blocks(data) if magic == _SECTION else _of_records(data):
            yield packet
            n_packets += 1
    except _DamageError as exc:
        if whole or not n_packets:
            what, at = exc.args
            raise CutShortError(
                f"cut short or damaged: {what} packet {n_packets + 1}, at byte {at:,}; all packets before it were read"
            ) from None


def _of_records(data: memoryview) -> Iterator[Captured]:
    """The packets of a pcap file."""
    size, at, magic = len(data), 24, bytes(data[:4])
    order, ticks = _ORDERS[magic], 10**9 if b"\x4d" in magic else 10**6
    link = struct.unpack_from(f"{order}I", data, 20)[0] & 0xFFFF
    header = struct.Struct(f"{order}III4x")
    while at < size:
        seconds, fraction, length = header.unpack_from(data, at) if at + 16 <= size else (0, 0, size)
        end = at + 16 + length
        if end > size:
            raise _DamageError("the file ends inside", size)
        yield Captured(link, (seconds * ticks + fraction) / ticks, data[at + 16 : end])
        at = end


def _of_blocks(data: memoryview) -> Iterator[Captured]:
    """The packets of a pcapng file."""
    interfaces = list[_Interface]()
    for at, order, kind, body in _blocks(data):
        if kind == _NEW_SECTION:
            interfaces = []
            enhanced, old = struct.Struct(f"{order}IIII4x"), struct.Struct(f"{order}H2xIII4x")
        elif kind == _INTERFACE:
            interfaces.append(_interface(body, order, at))
        if kind not in (_ENHANCED, _OLD, _SIMPLE):
            continue
        first = 4 if kind == _SIMPLE else 20
        if len(body) < first:
            raise _DamageError("a block is too short for", at)
        number = high = low = 0
        if kind == _SIMPLE:
            (length,) = struct.unpack_from(f"{order}I", body)
        else:
            number, high, low, length = (enhanced if kind == _ENHANCED else old).unpack_from(body)
        if number >= len(interfaces):
            raise _DamageError("no interface is described for", at)
        link, most, ticks, offset = interfaces[number]
        if kind == _SIMPLE:
            yield Captured(link, 0.0, body[4 : 4 + min(length, most or length)])
        elif length > len(body) - 20:
            raise _DamageError("a block is too short for", at)
        else:
            yield Captured(link, ((high << 32 | low) + offset) / ticks, body[20 : 20 + length])


def _blocks(data: memoryview) -> Iterator[tuple[int, str, int, memoryview]]:
    """Place, byte order, type and content of each block of a pcapng file."""
    size, at, order = len(data), 0, "<"
    while at < size:
        if data[at : at + 4] == _SECTION and at + 12 <= size:
            order = _SECTION_ORDERS.get(bytes(data[at + 8 : at + 12]), "")
            if not order:
                raise _DamageError("a section does not say its byte order, in front of", at)
            head, tail = struct.Struct(f"{order}II"), struct.Struct(f"{order}I")
        kind, length = head.unpack_from(data, at) if at + 12 <= size else (0, size)
        end = at + length + -length % 4  # some writers do not count what they pad
        if end > size:
            raise _DamageError("the file ends inside", size)
        if length < 12 or tail.unpack_from(data, end - 4)[0] != length:
            raise _DamageError("the two lengths of a block differ, in front of the end of", at)
        yield at, order, kind, data[at + 8 : end - 4]
        at = end


def _interface(body: memoryview, order: str, start: int) -> _Interface:
    """What a block says of an interface."""
    if len(body) < 8:
        raise _DamageError("a block is too short for an interface, in front of", start)
    link, most = struct.unpack_from(f"{order}H2xI", body)
    ticks, offset, at = 10**6, 0, 8
    while at + 4 <= len(body):
        code, length = struct.unpack_from(f"{order}HH", body, at)
        value, at = body[at + 4 : at + 4 + length], at + 4 + length + -length % 4
        if code == _RESOLUTION and len(value) == 1:
            ticks = 2 ** (value[0] & 127) if value[0] & 128 else 10 ** value[0]
        elif code == _OFFSET and len(value) == 8:
            (offset,) = struct.unpack(f"{order}q", value)
        elif code == 0:
            break
    return _Interface(link, most, ticks, offset * ticks)
