"""Bags of ROS 1 and ROS 2: their files read from front to back, without an index, so that a damaged end costs no more.

Files of ROS 2 are found in the folder of the bag. ``metadata.yaml`` is not needed: a recorder writes it last, and its
version changes with every release of ROS.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, Protocol
from urllib.parse import quote

from ..errors import PointsError
from .inflate import inflate, inflate_file, most_bytes
from .mcap import MCAP_MAGIC, Channel, McapFile, unpack
from .tables import MAX_BYTES

BAG_SUFFIXES = (".db3", ".mcap")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ROS1_MAGIC = b"#ROSBAG V"


class BagFile(Protocol):
    """One file of a bag."""

    def topics(self) -> set[Channel]:
        """Its topics, as far as it is whole; PointsError if it is damaged before the first."""

    def messages_of(self, channel: Channel) -> Iterator[tuple[int, memoryview]]:
        """Time of recording [ns] and bytes of each message, in the file's order.

        Raises PointsError after the messages before the damage.
        """


def bag_files(folder: Path) -> list[Path]:
    """The files of a ROS 2 bag's folder, in the order of recording: part 10 after part 9; empty if it is no bag."""
    files = [file for file in folder.iterdir() if set(file.suffixes[-2:]) & set(BAG_SUFFIXES) and file.is_file()]
    kept = [file for file in files if file.suffix in BAG_SUFFIXES or file.suffix == ".zstd"]
    return sorted(kept, key=lambda file: _numbered(file.name))


def _numbered(name: str) -> list[str | int]:
    """Its texts and numbers by turns, for sorting: numbers stand at odd places."""
    return [int(part) if k % 2 else part for k, part in enumerate(re.split(r"(\d+)", name))]


def open_bag(path: Path, folder: Path, alive: Callable[[], None]) -> list[BagFile]:
    """Open the files of a bag: its folder, or one file.

    folder : for files that are compressed as a whole, which are unpacked there within the limits of `inflate`.
    """
    files = bag_files(path) if path.is_dir() else [path]
    left = min(most_bytes(sum(file.stat().st_size for file in files)), shutil.disk_usage(folder).free // 2)
    opened: list[BagFile] = []
    for file in files:
        plain = file
        try:
            if file.suffix == ".zstd":
                plain = folder / file.stem
                left -= inflate_file(file, plain, left, alive)
            opened.append(_open_file(plain))
        except PointsError as exc:
            opened.append(Unreadable(PointsError(f"{file.name}: {exc}") if path.is_dir() else exc))
    missing = sorted(_declared(path) - {file.name for file in files}) if path.is_dir() else []
    if missing:
        names = ", ".join(missing)
        opened.append(Unreadable(PointsError(f"the bag is not whole: {names} of its metadata.yaml is missing")))
    return opened


def _declared(folder: Path) -> set[str]:
    """Names of the files of a bag by its metadata.yaml, if there is one that can be read."""
    try:
        text = (folder / "metadata.yaml").read_bytes().decode("utf-8", "replace")
    except OSError:
        return set()
    # A list of YAML: a line for each name, or all between brackets.
    listed = re.search(r"relative_file_paths:[ ]*\r?\n((?:[ ]*- .*\n?)+)|relative_file_paths:\s*\[([^\]]*)\]", text)
    if listed is None:
        return set()
    names = re.findall(r"- (.*)", listed[1]) if listed[1] else listed[2].split(",")
    return {PurePosixPath(name.strip().strip("\"'")).name for name in names} - {""}


def _open_file(path: Path) -> BagFile:
    with path.open("rb") as content:
        head = content.read(16)
    if head.startswith(_ROS1_MAGIC):
        return Ros1Bag(path)
    if head.startswith(b"SQLite format 3\0"):
        return SqliteBag(path)
    if head.startswith(MCAP_MAGIC):
        return McapBag(path)
    raise PointsError(
        f"the file is damaged or cut short: it begins with {head!r}; expected a bag of ROS 1, a database of ROS 2 or "
        "MCAP"
    )


class Unreadable:
    """A `BagFile` that is damaged at its beginning."""

    def __init__(self, error: PointsError) -> None:
        self._error = error

    def topics(self) -> set[Channel]:
        """As `BagFile.topics`."""
        raise self._error

    def messages_of(self, channel: Channel) -> Iterator[tuple[int, memoryview]]:
        """As `BagFile.messages_of`."""
        raise self._error


class McapBag:
    """An .mcap file as `BagFile`."""

    def __init__(self, path: Path) -> None:
        self._file = McapFile(path)

    def topics(self) -> set[Channel]:
        """As `BagFile.topics`."""
        return set(self._file.channels.values())

    def messages_of(self, channel: Channel) -> Iterator[tuple[int, memoryview]]:
        """As `BagFile.messages_of`."""
        for number, stamp_ns, data in self._file.messages():
            if self._file.channels.get(number) == channel:
                yield stamp_ns, _plain(data)


class SqliteBag:
    """A .db3 file of rosbag2 as `BagFile`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def topics(self) -> set[Channel]:
        """As `BagFile.topics`."""
        with closing(self._open()) as database:
            rows = self._rows(database, "SELECT name, type, serialization_format FROM topics")
            return {Channel(str(name), str(kind), str(encoding)) for name, kind, encoding in rows}

    def messages_of(self, channel: Channel) -> Iterator[tuple[int, memoryview]]:
        """As `BagFile.messages_of`."""
        of_topic = "FROM messages WHERE topic_id IN (SELECT id FROM topics WHERE name = ?) ORDER BY"
        with closing(self._open()) as database:
            try:
                rows = list(self._rows(database, f"SELECT id {of_topic} timestamp", channel.topic))
            except PointsError:  # the index, or the end; as recorded then, up to the damage
                for stamp_ns, data in self._rows(database, f"SELECT timestamp, data {of_topic} id", channel.topic):
                    yield int(stamp_ns), _plain(memoryview(data))
                raise
            for row in rows:
                for stamp_ns, data in self._rows(database, "SELECT timestamp, data FROM messages WHERE id = ?", *row):
                    yield int(stamp_ns), _plain(memoryview(data))

    def _open(self) -> sqlite3.Connection:
        # Nothing is written beside the file. What a recorder had not yet copied from its log is read if it can be.
        has_log = self._path.with_name(self._path.name + "-wal").exists()
        mode = "mode=ro" if has_log else "mode=ro&immutable=1"
        return sqlite3.connect(f"file:{quote(str(self._path.absolute()))}?{mode}", uri=True)

    @staticmethod
    def _rows(database: sqlite3.Connection, query: str, *values: object) -> Iterator[tuple[Any, ...]]:
        try:
            yield from database.execute(query, values)
        except sqlite3.Error as exc:
            raise PointsError(f"the file is damaged or cut short: {exc}") from exc


class Ros1Bag:
    """A .bag file (format 2.0) as `BagFile`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with path.open("rb") as file:
            line = file.readline(64)
        if not line.endswith(b"\n"):
            raise PointsError("the file is damaged or cut short: it ends inside its first line")
        if line != b"#ROSBAG V2.0\n":
            version = line[len(_ROS1_MAGIC) :].strip().decode("ascii", "replace")
            raise PointsError(f"a bag of version {version!r}; expected 2.0. Run: rosbag migrate")
        self._connections: dict[int, Channel] = {}
        self._whole = False

    def topics(self) -> set[Channel]:
        """As `BagFile.topics`."""
        if not self._whole:
            try:
                with self._path.open("rb") as file:
                    self._learn_from_index(file)
            except PointsError:  # no index, or a damaged one: the connections stand among the messages, too
                try:
                    for _ in self._messages():
                        pass
                except PointsError:
                    if not self._connections:
                        raise
            if not self._connections and self._path.stat().st_size <= 13:
                raise PointsError("the file is damaged or cut short: it ends behind its first line")
            self._whole = True
        return set(self._connections.values())

    def messages_of(self, channel: Channel) -> Iterator[tuple[int, memoryview]]:
        """As `BagFile.messages_of`."""
        for number, stamp_ns, data in self._messages():
            if self._connections.get(number) == channel:
                yield stamp_ns, data

    def _learn_from_index(self, file: BinaryIO) -> None:
        for fields, content in _ros1_records(file, self._index(file), self._path.stat().st_size):
            self._learn(fields, content)
        if not self._connections:
            raise PointsError("the index of the bag names no topic")

    def _index(self, file: BinaryIO) -> int:
        """Where the index begins, which is behind all messages; PointsError if the file ends before."""
        size = self._path.stat().st_size
        head, _ = next(_ros1_records(file, 13, size), ({}, None))
        (index,) = unpack("<Q", head.get("index_pos", bytes(8)))
        if not 13 < index <= size:
            raise PointsError("the file is damaged or cut short: it ends before its index, as if recording broke off")
        return int(index)

    def _messages(self) -> Iterator[tuple[int, int, memoryview]]:
        size = self._path.stat().st_size
        with self._path.open("rb") as file:
            for fields, content in _ros1_records(file, 13, size):
                kind = fields.get("op")
                if kind == b"\x05":
                    method = fields.get("compression", b"").decode("ascii", "replace")
                    (n_bytes,) = unpack("<I", fields.get("size", b""))
                    chunk = inflate(bytes(content), "" if method == "none" else method, n_bytes)
                    if len(chunk) != n_bytes:
                        raise PointsError(f"a chunk is damaged: it unpacks to {len(chunk):,} bytes, not to {n_bytes:,}")
                    yield from self._of_chunk(memoryview(chunk))
                else:
                    yield from self._message(fields, content)
            self._index(file)

    def _of_chunk(self, chunk: memoryview) -> Iterator[tuple[int, int, memoryview]]:
        """Its messages in the order of time; damage is raised after those before it."""
        found, damage = list[tuple[int, int, memoryview]](), None
        try:
            for fields, content in _ros1_split(chunk):
                found.extend(self._message(fields, content))
        except PointsError as exc:
            damage = exc
        yield from sorted(found, key=lambda message: message[1])
        if damage is not None:
            raise damage

    def _message(self, fields: dict[str, bytes], content: memoryview) -> Iterator[tuple[int, int, memoryview]]:
        if fields.get("op") == b"\x02":
            (number,) = unpack("<I", fields.get("conn", b""))
            seconds, nanoseconds = unpack("<II", fields.get("time", b""))
            yield number, 10**9 * seconds + nanoseconds, content
        else:
            self._learn(fields, content)

    def _learn(self, fields: dict[str, bytes], content: memoryview) -> None:
        if fields.get("op") == b"\x07":
            (number,) = unpack("<I", fields.get("conn", b""))
            kind = _ros1_fields(content).get("type", b"").decode("utf-8", "replace")
            self._connections[number] = Channel(fields.get("topic", b"").decode("utf-8", "replace"), kind, "ros1")


def _plain(data: memoryview) -> memoryview:
    """A message that rosbag2 may have compressed by itself."""
    return memoryview(inflate(bytes(data), "zstd")) if bytes(data[:4]) == _ZSTD_MAGIC else data


def _ros1_records(file: BinaryIO, at: int, end: int) -> Iterator[tuple[dict[str, bytes], memoryview]]:
    """Fields of the header and content of each record."""
    while at < end:
        start = at
        file.seek(at)
        fields = _ros1_fields(_piece(file, at, end))
        at = file.tell()
        content = _piece(file, at, end)
        if "op" not in fields:  # zeros, as a file system leaves them when power is lost, among others
            raise PointsError(f"the file is damaged or cut short: there is no record at byte {start:,}")
        at = file.tell()
        yield fields, content


def _piece(file: BinaryIO, at: int, end: int) -> memoryview:
    size = file.read(4)
    length = unpack("<I", size)[0] if len(size) == 4 else end
    if at + 4 + length > end:
        raise PointsError(f"the file is damaged or cut short: the record at byte {at:,} is not whole")
    if length > MAX_BYTES:
        raise PointsError(f"the record at byte {at:,} has {length:,} bytes; expected at most {MAX_BYTES:,}")
    return memoryview(file.read(length))


def _ros1_split(view: memoryview) -> Iterator[tuple[dict[str, bytes], memoryview]]:
    at = 0
    while at < len(view):
        parts = []
        for _ in range(2):
            length = unpack("<I", view, at)[0] if at + 4 <= len(view) else len(view)
            if at + 4 + length > len(view):
                raise PointsError("a chunk is damaged: it ends inside a record")
            parts.append(view[at + 4 : at + 4 + length])
            at += 4 + length
        yield _ros1_fields(parts[0]), parts[1]


def _ros1_fields(view: memoryview) -> dict[str, bytes]:
    fields, at = {}, 0
    while at < len(view):
        length = unpack("<I", view, at)[0] if at + 4 <= len(view) else len(view)
        name, equals, value = bytes(view[at + 4 : at + 4 + length]).partition(b"=")
        if at + 4 + length > len(view) or not equals:
            raise PointsError("the header of a record is damaged")
        fields[name.decode("ascii", "replace")] = value
        at += 4 + length
    return fields
