"""MCAP files: records in the file's order, chunks checked and unpacked within limits."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..errors import PointsError
from .clouds import ros1_reader
from .inflate import inflate, inflated_message
from .tables import MAX_BYTES

MCAP_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 1, 2, 3, 4, 5, 6, 15
ALIVE_EVERY = 64  # records
Message = tuple[int, int, memoryview]  # number of the channel, time of recording [ns], bytes


class Channel(NamedTuple):
    """A topic and the type of its messages."""

    topic: str
    msgtype: str
    encoding: str


class BagFile(Protocol):
    """One file of a bag."""

    def topics(self) -> set[Channel]:
        """Its topics, as far as it is whole."""

    def messages_of(self, channel: Channel) -> Iterator[tuple[int, memoryview]]:
        """Time of recording [ns] and bytes of each message, in the file's order; PointsError where it is damaged."""


class McapFile(BagFile):
    """One .mcap file, read from front to back; an index is not needed.

    alive : called for each chunk and now and then between, as the next message of a topic may be far.
    Raises PointsError: it does not begin as an MCAP file, or is damaged before its first channel.
    """

    def __init__(self, path: Path, alive: Callable[[], None]) -> None:
        self._alive = alive
        self._schemas: dict[int, str] = {}
        self._is_named = True  # whether the schema of each channel was known when the channel was
        self._channels: dict[int, Channel] = {}  # those of the summary, or those among the messages
        self._data = np.memmap(path, np.uint8, "r").data if path.stat().st_size >= 45 else memoryview(b"")
        if self._data[:8] != MCAP_MAGIC:
            raise PointsError("the file is damaged or cut short: it does not begin as an MCAP file")
        kind, _ = next(_records(self._data, 8), (0, None))
        if kind != _HEADER:
            raise PointsError("the file is damaged: it does not begin with the header of an MCAP file")
        footer = bytes(self._data[-37:])
        self._is_whole = footer[:9] == struct.pack("<BQ", _FOOTER, 20) and footer[29:] == MCAP_MAGIC
        summary, _, crc = unpack("<QQI", footer, 9) if self._is_whole else (0, 0, 0)
        self._data = self._data[:-37] if self._is_whole else self._data
        if 0 < summary <= len(self._data) and crc in (0, zlib.crc32(footer[:25], zlib.crc32(self._data[summary:]))):
            try:
                for kind, content in _records(self._data, summary):
                    self._learn(kind, content)
            except PointsError:
                self._is_named = False
        if not (self._channels and self._is_named):  # a summary may be damaged, or not repeat all that stands before it
            read_through(self._messages(), self._channels)

    def topics(self) -> set[Channel]:
        return set(self._channels.values())

    def messages_of(self, channel: Channel) -> Iterator[tuple[int, memoryview]]:
        for number, stamp_ns, data in self._messages():
            if self._channels.get(number) == channel:
                yield stamp_ns, inflated_message(data)

    def _messages(self) -> Iterator[Message]:
        """Channel's number, time of recording [ns] and bytes: chunk by chunk, within a chunk in the order of time."""
        for k, (kind, content) in enumerate(_records(self._data, 8)):
            if kind == _CHUNK or k % ALIVE_EVERY == 0:
                self._alive()
            if kind == _CHUNK:
                yield from by_time(self._of_records(_records(memoryview(_unpacked(content)), 0, is_chunk=True)))
            elif kind == _DATA_END:
                return
            else:
                yield from self._of_records([(kind, content)])
        if not self._is_whole:  # as by a recorder that lost power
            raise PointsError("the file is damaged or cut short: it does not end as an MCAP file")

    def _of_records(self, records: Iterable[tuple[int, memoryview]]) -> Iterator[Message]:
        for kind, content in records:
            if kind == _MESSAGE:
                channel, _, stamp_ns, _ = unpack("<HIQQ", content)
                yield channel, stamp_ns, content[22:]
            else:
                self._learn(kind, content)

    def _learn(self, kind: int, content: memoryview) -> None:
        if kind not in (_SCHEMA, _CHANNEL):
            return
        read = ros1_reader(content)  # texts have their lengths in front, as in messages of ROS 1
        number = read.value("H")
        if kind == _SCHEMA:
            self._schemas[number] = read.text()
        else:
            schema = read.value("H")
            self._is_named &= schema == 0 or schema in self._schemas  # 0: there is none
            self._channels[number] = Channel(read.text(), self._schemas.get(schema, ""), read.text())


def read_through(messages: Iterator[Message], channels: Mapping[int, Channel]) -> None:
    """Read messages for the channels among them; damage is raised behind the first channel when they are read again."""
    try:
        for _ in messages:
            pass
    except PointsError:
        if not channels:
            raise


def by_time(messages: Iterator[Message]) -> Iterator[Message]:
    """The messages of a chunk in the order of time; damage is raised after those before it."""
    whole, damage = list[Message](), None
    try:
        whole.extend(messages)
    except PointsError as exc:
        damage = exc
    yield from sorted(whole, key=lambda message: message[1])
    if damage is not None:
        raise damage


def _records(data: memoryview, offset: int, *, is_chunk: bool = False) -> Iterator[tuple[int, memoryview]]:
    """The kind and content of each record of a file or a chunk; those that are not needed are skipped."""
    while offset < len(data):
        kind, length = struct.unpack_from("<BQ", data, offset) if offset + 9 <= len(data) else (0, len(data))
        end = offset + 9 + length
        if end > len(data):
            what = "a chunk is damaged: it ends inside a record"
            if not is_chunk:
                what = f"the file is damaged or cut short: the record at byte {offset:,} is not whole"
            raise PointsError(what)
        if kind == 0 and not is_chunk:  # a file system fills with zeros what was not written when power was lost
            raise PointsError(f"the file is damaged or cut short: there are zeros in place of a record at {offset:,}")
        if kind in (_HEADER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END):
            if length > MAX_BYTES:
                raise PointsError(f"the record at byte {offset:,} has {length:,} bytes; expected at most {MAX_BYTES:,}")
            yield kind, data[offset + 9 : end]
        offset = end


def _unpacked(chunk: memoryview) -> bytes:
    """The records of a chunk as bytes, once length and CRC-32 are right."""
    read = ros1_reader(chunk[16:])
    size, crc, method, packed_size = read.value("Q"), read.value("I"), read.text(), read.value("Q")
    if size > MAX_BYTES:
        raise PointsError(f"a chunk claims to unpack to {size:,} bytes; expected at most {MAX_BYTES:,}")
    if packed_size != read.left:
        raise PointsError(f"a chunk is damaged: it declares {packed_size:,} bytes and holds {read.left:,}")
    content = inflate(bytes(read.take(packed_size)), method, size)
    if len(content) != size:
        raise PointsError(f"a chunk is damaged: it unpacks to {len(content):,} bytes and declares {size:,}")
    if crc and zlib.crc32(content) != crc:
        raise PointsError("a chunk is damaged: its CRC-32 is wrong")
    return content


def unpack(code: str, content: memoryview | bytes, offset: int = 0) -> tuple[Any, ...]:
    """Numbers at a place of a record; PointsError if it ends before."""
    try:
        return struct.unpack_from(code, content, offset)
    except struct.error as exc:
        raise PointsError(f"a record is damaged: {exc}") from exc
