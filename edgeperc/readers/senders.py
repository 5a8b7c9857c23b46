"""Who sent the packets of a capture: one count of them says which LiDARs there are, and what they are called."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import PointsError
from .ouster import metadata_beside, read_metadata, reading
from .packets import DIFOP, GPS_BYTES, Datagrams, is_of_velodyne, sender_names

if TYPE_CHECKING:
    from .mems_packets import MemsFormat
    from .ouster_packets import Layout
    from .spinning_packets import Format

_OTHER_BYTES = 600  # what LiDARs send of their GPS is shorter
_LIVOX, _VELODYNE, _OUSTER = "livox", "Velodyne", "Ouster"
_LIVOX_SIZES = (1380, 804, 996)
_BY_CHANCE = 20  # packets of other sensors that may begin like these


class Whose(NamedTuple):
    """One of the sensors of a recording: what the file of its calibration is called after."""

    name: str = ""  # its address or topic
    all: Sequence[str] = ()  # those of all
    alike: Sequence[str] = ()  # of those of which a calibration may be, too, as far as the recording tells


ALONE = Whose()


def in_files(name: str) -> str:
    """An address or a topic as a part of the name of a file."""
    return re.sub(r"[^\w.]+", "_", name).strip("_")


class Lidar(NamedTuple):
    """What sends most packets of those that are neither a Velodyne's nor an Ouster's."""

    row: Format | MemsFormat | None  # the format of its packets; None: Livox
    senders: list[str]  # of these makers, as `packets.sender_names` calls them
    first: str  # address and port of the one with the most packets
    alike: Sequence[str] = ()  # those of which a calibration beside the capture may be, by the number of its lasers

    def whose(self, sender: str | None) -> Whose:
        """What the calibration of a sender is called after; None: of the first."""
        address = self.first.rpartition(":")[0]
        return Whose(sender or (address if address in self.senders else self.first), self.senders, self.alike)


class Senders:
    """The LiDARs whose packets are among the first of a pcap file, or among all: they are counted in one pass.

    names : of all LiDARs, with one for all Ousters.
    velodynes, ousters : those of Velodynes; serial numbers of Ousters, by the metadata beside the file.
    n_packets, cut : packets that were looked at, and what is wrong where the file ends early.

    Raises PointsError: No packet was captured to its end.
    """

    def __init__(self, path: Path, alive: Callable[[], None], most: int | None = None) -> None:
        self._counts = Counter[tuple[str | None, tuple[str, int]]]()  # by kind, None: not known, address and port
        self._rows: dict[str, Format | MemsFormat] = {}  # formats by the names of their models
        layouts: list[Layout] = []
        with suppress(PointsError):  # no metadata, or some that cannot be read
            layouts = layouts_beside(path)
        sizes = set[int]()
        ouster_bytes = {layout.packet_bytes for layout in layouts}
        datagrams = Datagrams(path, alive, most)
        for datagram in datagrams:
            size, kind = len(datagram.payload), None
            if is_of_velodyne(datagram):
                kind = _VELODYNE
            elif size in ouster_bytes:
                kind = _OUSTER
                sizes.add(size)
            elif bytes(datagram.payload[:8]) == DIFOP:
                continue
            elif size > GPS_BYTES:
                kind = self._kind_of(datagram.payload)
            if kind is not None or size > _OTHER_BYTES:
                self._counts[kind, (datagram.sender, datagram.port)] += 1
        if not self._counts and datagrams.n_cut > _BY_CHANCE:
            raise PointsError(
                f"{datagrams.n_cut:,} packets of the capture were not kept to their end, as with a limit of tcpdump or "
                "Wireshark: capture whole packets (tcpdump -s 0)"
            )
        self.n_packets, self.cut = datagrams.n_packets, datagrams.cut
        self.names = self._names(lambda kind: True)
        self.velodynes = self._names(lambda kind: kind == _VELODYNE)
        self.ousters = [layout.name for layout in layouts if layout.packet_bytes in sizes]

    def _kind_of(self, payload: memoryview) -> str | None:
        """`_LIVOX`, or the model of a LiDAR or what one that is not decoded is called; None: not known."""
        format_of, name_of, points_of, mems_format_of = _recognizers()
        if (row := mems_format_of(payload) or format_of(payload)) is not None:
            return str(self._rows.setdefault(row.name, row).name)
        if points_of(payload) is not None:
            return _LIVOX
        # Version 0, length of the packet; 96 points and more.
        length = int.from_bytes(payload[1:3], "little")
        if len(payload) in _LIVOX_SIZES and payload[0] == 0 and length in (0, len(payload)):
            return "Livox sensor"
        name: str | None = name_of(payload)
        return name

    def _names(self, is_wanted: Callable[[str], bool]) -> list[str]:
        known = Counter[tuple[str, int]]()
        for (kind, source), n in self._counts.items():
            if kind is not None and is_wanted(kind):
                known[(_OUSTER, 0) if kind == _OUSTER else source] += n
        return sender_names(known)

    def lidar(self, topic: str | None) -> Lidar | None:
        """The LiDAR of another maker than Velodyne and Ouster; None if there is none.

        topic : if it is a sender, that one.
        Raises PointsError: It is one that is not decoded.
        """
        names = self._names(lambda kind: kind not in (_VELODYNE, _OUSTER))
        kinds, sources = Counter[str | None](), dict[str | None, Counter[tuple[str, int]]]()
        for (kind, source), n in self._counts.items():
            is_one = topic not in names or topic in (source[0], f"{source[0]}:{source[1]}")
            if is_one and kind not in (_VELODYNE, _OUSTER):
                kinds[kind] += n
                sources.setdefault(kind, Counter())[source] += n
        n_unknown = kinds.pop(None, 0)
        kind, n = max(kinds.items(), key=lambda item: item[1], default=(None, 0))
        if kind is None or n <= min(n_unknown, _BY_CHANCE):
            return None
        if kind in self._rows or kind == _LIVOX:
            (address, port), _ = sources[kind].most_common(1)[0]
            row = self._rows.get(kind)
            return Lidar(row, names, f"{address}:{port}", [] if row is None else self._alike(row))
        if any(other in (_VELODYNE, _OUSTER) for other, _ in self._counts):
            return None
        raise PointsError(not_decoded(kind))

    def _alike(self, row: Format | MemsFormat) -> list[str]:
        """The senders whose calibrations are files as that of a format."""
        from .spinning_packets import Format  # numba

        if not isinstance(row, Format):
            return []
        like = {name for name, other in self._rows.items() if isinstance(other, Format) and other.shares_files(row)}
        return self._names(like.__contains__)


def not_decoded(name: str) -> str:
    """What to say of a capture of a sensor that is known by its packets alone."""
    return (
        f"a capture of a {name}, which cannot be decoded; the documentation lists those that are. Convert it with "
        f"{name.split()[0]}'s driver, to sensor_msgs/PointCloud2 in a ROS bag or to .pcd files"
    )


@cache
def _recognizers() -> tuple[Callable[[memoryview], Any], ...]:
    from .livox_packets import points_of  # numba, which Velodynes do without
    from .mems_packets import mems_format_of
    from .spinning_packets import format_of, name_of

    return format_of, name_of, points_of, mems_format_of


def layouts_beside(path: Path) -> list[Layout]:
    """What the metadata beside a capture says of Ousters' packets. Raises PointsError."""
    files = metadata_beside(path)
    from .ouster_packets import layout_of  # numba

    layouts = []
    for file in files:
        content = read_metadata(file)
        with reading(f"the metadata {file.name}"):
            layouts.append(layout_of(content))
    return layouts
