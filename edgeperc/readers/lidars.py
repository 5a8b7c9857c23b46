"""Which LiDAR of Hesai, RoboSense or Livox sent the packets of a capture, and the angles of a spinning one."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import PointsError
from .livox_packets import LivoxStream, points_of
from .ouster import metadata_beside, read_metadata
from .ouster_packets import Layout, layout_of
from .packets import SNIFFED_PACKETS, Datagrams, is_of_velodyne, sender_names
from .spinning_packets import (
    DIFOP,
    FORMATS,
    Angles,
    Format,
    SpinningStream,
    angles_of_difop,
    format_of,
    has_16_lasers,
    name_of,
    read_angles,
)
from .times import TimedScan

_OTHER_BYTES = 600  # what LiDARs send of their GPS is shorter
_LIVOX, _VELODYNE, _OUSTER = "livox", "Velodyne", "Ouster"
_OTHERS = {_VELODYNE, _OUSTER}  # that are decoded elsewhere
_Source = tuple[str | None, tuple[str, int]]  # kind, address and port
_LIVOX_SIZES = (1380, 804, 996)
_BY_CHANCE = 20  # packets of other sensors that may begin like these
_STEPS = 200  # packets that show how far apart columns are
_ALIKE = {"helios-32", "helios-16"}  # by their packets; the angles tell them apart


class Lidar(NamedTuple):
    """What sends most of the first packets."""

    row: Format | None  # the format of a spinning sensor; None: Livox
    senders: list[str]  # of these makers, as `packets.sender_names` calls them
    first: str  # address and port of the one with the most packets


def lidar_of(path: Path, topic: str | None = None) -> Lidar | None:
    """The LiDAR of a pcap file, beside a Velodyne's or an Ouster's packets or without; None if it is none of these
    makers'.

    topic : if it is a sender, that one; a whole file is searched for it.
    Raises PointsError: It is one that is not decoded.
    """
    counts, rows = _counted(path, lambda: None, SNIFFED_PACKETS if topic is None else None)
    is_beside = any(kind in _OTHERS for kind, _ in counts)
    counts = Counter({key: n for key, n in counts.items() if key[0] not in _OTHERS})
    names = _names(counts)
    kinds, sources = Counter[str | None](), dict[str | None, Counter[tuple[str, int]]]()
    for (kind, source), n in counts.items():
        if topic not in names or topic in (source[0], f"{source[0]}:{source[1]}"):
            kinds[kind] += n
            sources.setdefault(kind, Counter())[source] += n
    n_unknown = kinds.pop(None, 0)
    kind, n = max(kinds.items(), key=lambda item: item[1], default=(None, 0))
    if kind is None or n <= min(n_unknown, _BY_CHANCE):
        return None
    if kind in rows or kind == _LIVOX:
        (address, port), _ = sources[kind].most_common(1)[0]
        return Lidar(rows.get(kind), names, f"{address}:{port}")
    if is_beside:
        return None
    raise PointsError(
        f"a capture of a {kind}, which cannot be decoded; the documentation lists those that are. Convert it with "
        f"{kind.split()[0]}'s driver, to a ROS bag or to .pcd files"
    )


def all_senders(path: Path, alive: Callable[[], None]) -> list[str]:
    """What sends a LiDAR's packets in a whole pcap file, with one name for all Ousters."""
    return _names(_counted(path, alive, None)[0])


def _names(counts: Counter[_Source]) -> list[str]:
    known = Counter[tuple[str, int]]()
    for (kind, source), n in counts.items():
        if kind is not None:
            known[(_OUSTER, 0) if kind == _OUSTER else source] += n
    return sender_names(known)


def _counted(path: Path, alive: Callable[[], None], most: int | None) -> tuple[Counter[_Source], dict[str, Format]]:
    """How many packets each address and port has of each kind, None for unknown ones, and the formats of the kinds."""
    ouster_bytes = {layout.packet_bytes for layout in ousters_beside(path)}
    counts, rows = Counter[_Source](), dict[str, Format]()
    datagrams = Datagrams(path, alive, most)
    for datagram in datagrams:
        size = len(datagram.payload)
        if bytes(datagram.payload[:8]) == DIFOP:
            continue
        if is_of_velodyne(datagram):
            kind: str | None = _VELODYNE
        elif size in ouster_bytes:
            kind = _OUSTER
        elif (row := format_of(datagram.payload)) is not None:
            kind = row.name
            rows.setdefault(kind, row)
        else:
            kind = _name_of(datagram.payload)
        if kind is not None or size > _OTHER_BYTES:
            counts[kind, (datagram.sender, datagram.port)] += 1
    if not counts and datagrams.n_cut > _BY_CHANCE:
        raise PointsError(
            f"{datagrams.n_cut:,} packets of the capture were not kept to their end, as with a limit of tcpdump or "
            "Wireshark: capture whole packets (tcpdump -s 0)"
        )
    return counts, rows


def ousters_beside(path: Path) -> list[Layout]:
    """What the metadata beside a capture says of Ousters; empty if there is none, or one cannot be read."""
    with suppress(PointsError):
        return [layout_of(json.loads(read_metadata(file))) for file in metadata_beside(path)]
    return []


def _name_of(payload: memoryview) -> str | None:
    """`_LIVOX`, or what a LiDAR that is not decoded is called."""
    if points_of(payload) is not None:
        return _LIVOX
    # Version 0, length of the packet; 96 points and more.
    length = int.from_bytes(payload[1:3], "little")
    if len(payload) in _LIVOX_SIZES and payload[0] == 0 and length in (0, len(payload)):
        return "Livox sensor"
    return name_of(payload)


def open_spinning(path: Path, row: Format, sender: str | None, alive: Callable[[], None]) -> tuple[Format, Angles]:
    """The format and angles of a spinning sensor; PointsError if neither the capture nor a file beside it has them."""
    files = sorted(path.absolute().parent.glob("*.csv"))
    file = next((each for each in files if each.stem.startswith(path.stem)), None)
    said = Angles(np.array([[each, 0.0] for each in row.elevations_deg])) if row.elevations_deg else None
    for datagram in () if row.is_hesai else Datagrams(path, alive):
        if not datagram.is_from(sender):
            continue
        if row.name == "helios-32" and angles_of_difop(FORMATS["helios-16"], datagram.payload) is not None:
            row = FORMATS["helios-16"] if has_16_lasers(datagram.payload) else row
        said = angles_of_difop(row, datagram.payload)
        if said is not None:
            break
    if file is not None and (said is None or row.elevations_deg):
        return row, read_angles(file, row)
    if said is None:
        there = "" if row.is_hesai else "The capture has no packet with the angles (DIFOP, port 7788). "
        whose = "Hesai's calibration of the unit" if row.is_hesai else "a row 'elevation,azimuth' for each laser [deg]"
        raise PointsError(
            f"the angles of the lasers of this {row.title} are not known. {there}Put {whose} beside it, as "
            f"{path.stem}.csv"
        )
    return row, said


def columns_of(path: Path, row: Format, sender: str | None) -> int:
    """How many columns a turn has, by the azimuths of the first packets; 0 if they do not show it."""
    stream, azimuths = SpinningStream(row, Angles(np.zeros((128, 2)))), list[float]()
    for payload in islice(_of_format(path, row, sender, lambda: None), _STEPS):
        azimuths += stream.azimuths_of(payload)
    steps = np.diff(azimuths) % 360.0
    steps = steps[(steps > 0.01) & (steps < 5.0)]
    firings = 2 if row.lasers == 16 else 1  # of a block
    return round(firings * 360.0 / float(np.median(steps))) if len(steps) else 0


def _of_format(path: Path, row: Format, sender: str | None, alive: Callable[[], None]) -> Iterator[memoryview]:
    """The packets of a sensor, all of one size."""
    size = 0
    for datagram in Datagrams(path, alive):
        found = format_of(datagram.payload)
        if found is None or (found != row and {found.name, row.name} != _ALIKE) or not datagram.is_from(sender):
            continue
        size = size or len(datagram.payload)
        if len(datagram.payload) == size:
            yield datagram.payload


def turns_of(path: Path, lidar: Lidar, sender: str | None, alive: Callable[[], None]) -> Iterator[TimedScan]:
    """The turns of a spinning sensor, or what a Livox sees in tenths of a second.

    sender : None: the only one among the first packets.
    Raises PointsError: As `open_spinning`.
    """
    first = sender or lidar.first
    if lidar.row is not None:
        row, angles = open_spinning(path, lidar.row, sender, alive)
        stream = SpinningStream(row, angles)
        for payload in _of_format(path, row, first, alive):
            yield from stream.add(payload)
        yield from stream.end()
    else:
        livox = LivoxStream()
        for datagram in Datagrams(path, alive):
            points = points_of(datagram.payload) if datagram.is_from(first) else None
            if points is not None:
                yield from livox.add(points)
        yield from livox.end()
