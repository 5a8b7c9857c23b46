"""Bags of ROS 1 and ROS 2: their files read from front to back, without an index, so that a damaged end costs no more.

Files of ROS 2 are found in the folder of the bag. ``metadata.yaml`` is not needed: a recorder writes it last, and its
version changes with every release of ROS.
"""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import numpy as np

from ..errors import PointsError
from ..system.names import by_number
from .inflate import inflate, inflate_file, inflated_message, most_bytes
from .mcap import ALIVE_EVERY, MCAP_MAGIC, BagFile, Channel, McapFile, Message, by_time, read_through, unpack
from .tables import MAX_BYTES

BAG_SUFFIXES = (".db3", ".mcap")
_ROS1_MAGIC = b"#ROSBAG V"
_STEPS = 100_000  # of sqlite's machine, about a millisecond, after which it is said to be alive


def bag_files(folder: Path) -> list[Path]:
    """The files of a ROS 2 bag's folder, in the order of recording: part 10 after part 9; empty if it is no bag.

    Hidden ones are left out: macOS writes ``._NAME`` beside each file on disks of other systems.
    """
    files = (file for file in folder.iterdir() if not file.name.startswith(".") and file.is_file())
    kept = (file for file in files if file.name.removesuffix(".zstd").endswith(BAG_SUFFIXES))
    return sorted(kept, key=by_number)


def open_bag(path: Path, folder: Path, alive: Callable[[], None]) -> tuple[list[BagFile], PointsError | None]:
    """Open the files of a bag: its folder, or one file. With them, what is wrong with the first that cannot be opened.

    folder : for files that are compressed as a whole, which are unpacked there within the limits of `inflate`.
    """
    files = bag_files(path) if path.is_dir() else [path]
    left = min(most_bytes(sum(file.stat().st_size for file in files)), shutil.disk_usage(folder).free // 2)
    opened, damage = list[BagFile](), None
    for file in files:
        plain = file
        try:
            if file.suffix == ".zstd":
                plain = folder / file.stem
                left -= inflate_file(file, plain, left, alive)
            opened.append(_open_file(plain, alive))
        except PointsError as exc:
            damage = damage or (PointsError(f"{file.name}: {exc}") if path.is_dir() else exc)
    missing = sorted(_declared(path) - {file.name for file in files}) if path.is_dir() else []
    if missing:
        names = ", ".join(missing)
        damage = damage or PointsError(f"the bag is not whole: {names} of its metadata.yaml is missing")
    return opened, damage


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


def _open_file(path: Path, alive: Callable[[], None]) -> BagFile:
    with path.open("rb") as content:
        head = content.read(16)
    if head.startswith(_ROS1_MAGIC):
        return Ros1Bag(path, alive)
    if head.startswith(b"SQLite format 3\0"):
        return SqliteBag(path, alive)
    if head.startswith(MCAP_MAGIC):
        return McapFile(path, alive)
    raise PointsError(
        f"the file is damaged or cut short: it begins with {head!r}; expected a bag of ROS 1, a database of ROS 2 or "
        "MCAP"
    )


class SqliteBag(BagFile):
    """A .db3 file of rosbag2 as `BagFile`."""

    def __init__(self, path: Path, alive: Callable[[], None]) -> None:
        self._path, self._alive = path, alive
        with closing(self._open()) as database:
            rows = self._rows(database, "SELECT name, type, serialization_format FROM topics")
            self._topics = {Channel(str(name), str(kind), str(encoding)) for name, kind, encoding in rows}

    def topics(self) -> set[Channel]:
        return self._topics

    def messages_of(self, channel: Channel) -> Iterator[tuple[int, memoryview]]:
        of_topic = "FROM messages WHERE topic_id IN (SELECT id FROM topics WHERE name = ?) ORDER BY"
        with closing(self._open()) as database:
            try:
                rows = list(self._rows(database, f"SELECT id {of_topic} timestamp", channel.topic))
            except PointsError:  # the index, or the end; as recorded then, up to the damage
                for stamp_ns, data in self._rows(database, f"SELECT timestamp, data {of_topic} id", channel.topic):
                    yield int(stamp_ns), inflated_message(memoryview(data))
                raise
            for row in rows:
                for stamp_ns, data in self._rows(database, "SELECT timestamp, data FROM messages WHERE id = ?", *row):
                    yield int(stamp_ns), inflated_message(memoryview(data))

    def _open(self) -> sqlite3.Connection:
        # Nothing is written beside the file. What a recorder had not yet copied from its log is read if it can be.
        has_log = self._path.with_name(self._path.name + "-wal").exists()
        mode = "mode=ro" if has_log else "mode=ro&immutable=1"
        database = sqlite3.connect(f"file:{quote(os.fsencode(self._path.absolute()))}?{mode}", uri=True)
        database.set_progress_handler(self._alive, _STEPS)
        return database

    @staticmethod
    def _rows(database: sqlite3.Connection, query: str, *values: object) -> Iterator[tuple[Any, ...]]:
        try:
            yield from database.execute(query, values)
        except sqlite3.Error as exc:
            raise PointsError(f"the file is damaged or cut short: {exc}") from exc


class Ros1Bag(BagFile):
    """A .bag file (format 2.0) as `BagFile`."""

    def __init__(self, path: Path, alive: Callable[[], None]) -> None:
        self._alive = alive
        self._data = np.memmap(path, np.uint8, "r").data
        line, ended, _ = bytes(self._data[:64]).partition(b"\n")
        if not ended:
            raise PointsError("the file is damaged or cut short: it ends inside its first line")
        if line != b"#ROSBAG V2.0":
            version = line[len(_ROS1_MAGIC) :].strip().decode("ascii", "replace")
            raise PointsError(f"a bag of version {version!r}; expected 2.0. Run: rosbag migrate")
        self._connections: dict[int, Channel] = {}
        try:
            for fields, content in _ros1_records(self._data, self._index()):
                self._learn(fields, content)
            if not self._connections:
                raise PointsError("the index of the bag names no topic")
        except PointsError:  # no index, or a damaged one: the connections stand among the messages, too
            read_through(self._messages(), self._connections)
        if not self._connections and len(self._data) <= 13:
            raise PointsError("the file is damaged or cut short: it ends behind its first line")

    def topics(self) -> set[Channel]:
        return set(self._connections.values())

    def messages_of(self, channel: Channel) -> Iterator[tuple[int, memoryview]]:
        for number, stamp_ns, data in self._messages():
            if self._connections.get(number) == channel:
                yield stamp_ns, data

    def _index(self) -> int:
        """Where the index begins, which is behind all messages; PointsError if the file ends before."""
        head, _ = next(_ros1_records(self._data, 13), ({}, None))
        (index,) = unpack("<Q", head.get("index_pos", bytes(8)))
        if not 13 < index <= len(self._data):
            raise PointsError("the file is damaged or cut short: it ends before its index, as if recording broke off")
        return int(index)

    def _messages(self) -> Iterator[Message]:
        for k, (fields, content) in enumerate(_ros1_records(self._data, 13)):
            if fields["op"] == b"\x05" or k % ALIVE_EVERY == 0:
                self._alive()
            if fields["op"] == b"\x05":
                method = fields.get("compression", b"").decode("ascii", "replace")
                (n_bytes,) = unpack("<I", fields.get("size", b""))
                chunk = inflate(bytes(content), "" if method == "none" else method, n_bytes)
                if len(chunk) != n_bytes:
                    raise PointsError(f"a chunk is damaged: it unpacks to {len(chunk):,} bytes, not to {n_bytes:,}")
                yield from by_time(self._of_records(_ros1_records(memoryview(chunk), 0, is_chunk=True)))
            else:
                yield from self._of_records([(fields, content)])
        self._index()

    def _of_records(self, records: Iterable[tuple[dict[str, bytes], memoryview]]) -> Iterator[Message]:
        for fields, content in records:
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


def _ros1_records(
    data: memoryview, at: int, *, is_chunk: bool = False
) -> Iterator[tuple[dict[str, bytes], memoryview]]:
    """Fields of the header and content of each record of a file or a chunk."""
    while at < len(data):
        start, parts = at, []
        for _ in range(2):
            length = unpack("<I", data, at)[0] if at + 4 <= len(data) else len(data)
            if at + 4 + length > len(data):
                what = "a chunk is damaged: it ends inside a record"
                if not is_chunk:
                    what = f"the file is damaged or cut short: the record at byte {at:,} is not whole"
                raise PointsError(what)
            if length > MAX_BYTES:
                raise PointsError(f"the record at byte {at:,} has {length:,} bytes; expected at most {MAX_BYTES:,}")
            parts.append(data[at + 4 : at + 4 + length])
            at += 4 + length
        fields = _ros1_fields(parts[0])
        if "op" not in fields and not is_chunk:  # zeros, as a file system leaves them when power is lost, among others
            raise PointsError(f"the file is damaged or cut short: there is no record at byte {start:,}")
        yield fields, parts[1]


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
