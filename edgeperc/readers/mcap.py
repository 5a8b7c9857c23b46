"""MCAP files: records in the file's order, chunks checked and unpacked within limits."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from ..errors import PointsError
from .inflate import inflate
from .tables import MAX_BYTES

MCAP_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 1, 2, 3, 4, 5, 6, 15


class Channel(NamedTuple):
    """A topic and the type of its messages."""

    topic: str
    msgtype: str
    encoding: str


class Message(NamedTuple):
    """A message as recorded: channel's number, time of recording [ns], bytes."""

    channel: int
    stamp_ns: int
    data: memoryview


class McapFile:
    """One .mcap file, read from front to back; an index is not needed.

    channels : dict of int to Channel; those of the summary, or those among the messages.
    Raises PointsError: it does not begin as an MCAP file, or is damaged before its first channel.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[int, str] = {}
        self.channels: dict[int, Channel] = {}
        with path.open("rb") as file:
            size = path.stat().st_size
            if size < 45 or file.read(8) != MCAP_MAGIC:
                raise PointsError("the file is damaged or cut short: it does not begin as an MCAP file")
            kind, _ = next(_records(file, 8, size), (0, None))
            if kind != _HEADER:
                raise PointsError("the file is damaged: it does not begin with the header of an MCAP file")
            file.seek(-37, 2)
            footer = file.read()
            self._is_whole = footer[:9] == struct.pack("<BQ", _FOOTER, 20) and footer[29:] == MCAP_MAGIC
            self._end = size - 37 if self._is_whole else size
            (summary,) = unpack("<Q", footer, 9) if self._is_whole else (0,)
            if summary > self._end:
                raise PointsError(f"the file is damaged: its summary is said to begin at byte {summary:,} of {size:,}")
            if summary:
                for kind, content in _records(file, summary, self._end):
                    self._learn(kind, content)
        if not self.channels:  # no summary: the channels stand among the messages
            try:
                for _ in self.messages():
                    pass
            except PointsError:  # raised again when the messages are read
                if not self.channels:
                    raise

    def messages(self) -> Iterator[Message]:
        """Every message: chunk by chunk, within a chunk in the order of time.

        Raises PointsError at the damage; what stands before it came. A recorder that lost power wrote no end.
        """
        with self._path.open("rb") as file:
            for kind, content in _records(file, 8, self._end):
                if kind == _CHUNK:
                    records = list(self._of_records(_split(_unpacked(content))))
                    yield from sorted(records, key=lambda message: message.stamp_ns)
                elif kind == _DATA_END:
                    return
                else:
                    yield from self._of_records(iter([(kind, content)]))
        if not self._is_whole:
            raise PointsError("the file is damaged or cut short: it does not end as an MCAP file")

    def _of_records(self, records: Iterator[tuple[int, memoryview]]) -> Iterator[Message]:
        for kind, content in records:
            if kind == _MESSAGE:
                channel, _, stamp_ns, _ = unpack("<HIQQ", content)
                yield Message(channel, stamp_ns, content[22:])
            else:
                self._learn(kind, content)

    def _learn(self, kind: int, content: memoryview) -> None:
        if kind == _SCHEMA:
            self._schemas[unpack("<H", content)[0]] = _text(content, 2)[0]
        elif kind == _CHANNEL:
            number, schema = unpack("<HH", content)
            topic, offset = _text(content, 4)
            self.channels[number] = Channel(topic, self._schemas.get(schema, ""), _text(content, offset)[0])


def _records(file: BinaryIO, offset: int, end: int) -> Iterator[tuple[int, memoryview]]:
    """The kind and content of each record; those that are not needed are skipped."""
    while offset < end:
        file.seek(offset)
        head = file.read(9)
        kind, length = struct.unpack("<BQ", head) if len(head) == 9 else (0, end)
        if offset + 9 + length > end:
            raise PointsError(f"the file is damaged or cut short: the record at byte {offset:,} is not whole")
        if kind == 0:  # a file system fills with zeros what was not written when power was lost
            raise PointsError(f"the file is damaged or cut short: there are zeros in place of a record at {offset:,}")
        if kind in (_HEADER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END):
            if length > MAX_BYTES:
                raise PointsError(f"the record at byte {offset:,} has {length:,} bytes; expected at most {MAX_BYTES:,}")
            yield kind, memoryview(file.read(length))
        offset += 9 + length


def _split(content: bytes) -> Iterator[tuple[int, memoryview]]:
    """The records of a chunk."""
    view, offset = memoryview(content), 0
    while offset < len(view):
        kind, length = struct.unpack_from("<BQ", view, offset) if offset + 9 <= len(view) else (0, len(view))
        if offset + 9 + length > len(view):
            raise PointsError("a chunk is damaged: it ends inside a record")
        yield kind, view[offset + 9 : offset + 9 + length]
        offset += 9 + length


def _unpacked(chunk: memoryview) -> bytes:
    """The records of a chunk as bytes, once length and CRC-32 are right."""
    size, crc = unpack("<16xQI", chunk)
    method, offset = _text(chunk, 28)
    (packed_size,) = unpack("<Q", chunk, offset)
    if size > MAX_BYTES:
        raise PointsError(f"a chunk claims to unpack to {size:,} bytes; expected at most {MAX_BYTES:,}")
    if packed_size != len(chunk) - offset - 8:
        raise PointsError(
            f"a chunk is damaged: it declares {packed_size:,} bytes and holds {len(chunk) - offset - 8:,}"
        )
    content = inflate(bytes(chunk[offset + 8 :]), method, size)
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


def _text(content: memoryview, offset: int) -> tuple[str, int]:
    """A string with its length in front, and the place behind it."""
    (length,) = unpack("<I", content, offset)
    end = offset + 4 + length
    if end > len(content):
        raise PointsError("a record is damaged: a text ends past it")
    return bytes(content[offset + 4 : end]).decode("utf-8", "replace"), end
