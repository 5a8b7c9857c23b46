"""Which LiDAR of Hesai, RoboSense or Livox sent the packets of a capture, and the angles of a spinning one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import PointsError
from .livox_packets import LivoxStream, points_of
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
_LIVOX = "livox"
_LIVOX_SIZES = (1380, 804, 996)
_STEPS = 200  # packets that show how far apart columns are
_ALIKE = {"helios-32", "helios-16"}  # by their packets; the angles tell them apart


class Lidar(NamedTuple):
    """What sends most of the first packets."""

    row: Format | None  # the format of a spinning sensor; None: Livox
    senders: list[str]  # such sensors, as `packets.sender_names` calls them
    first: str  # address and port of the one with the most packets

    @property
    def title(self) -> str:
        """The model."""
        return "Livox sensor" if self.row is None else self.row.title


def lidar_of(path: Path) -> Lidar | None:
    """The LiDAR of a pcap file, beside a Velodyne's packets or without; None if it is none of these makers'.

    Raises PointsError: It is one that is not decoded.
    """
    names, senders, rows = Counter[str | None](), dict[str, Counter[tuple[str, int]]](), dict[str, Format]()
    for datagram in islice(Datagrams(path, lambda: None), SNIFFED_PACKETS):
        if bytes(datagram.payload[:8]) == DIFOP or is_of_velodyne(datagram):
            continue
        row = format_of(datagram.payload)
        name = _name_of(datagram.payload) if row is None else row.name
        if row is not None:
            rows.setdefault(row.name, row)
        if name is not None or len(datagram.payload) > _OTHER_BYTES:
            names[name] += 1
            senders.setdefault(name or "", Counter())[datagram.sender, datagram.port] += 1
    name, n = max(names.items(), key=lambda item: item[1], default=(None, 0))
    if name is None or 2 * n <= names.total():  # packets of other sensors may begin like these by chance
        return None
    if name in rows or name == _LIVOX:
        (address, port), _ = senders[name].most_common(1)[0]
        return Lidar(rows.get(name), sender_names(senders[name]), f"{address}:{port}")
    raise PointsError(
        f"a capture of a {name}, which cannot be decoded; the documentation lists those that are. Convert it with "
        f"{name.split()[0]}'s driver, to a ROS bag or to .pcd files"
    )


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


def _of_format(
    path: Path,
    row: Format,
    sender: str | None,
    alive: Callable[[], None],
    seen: Counter[tuple[str, int]] | None = None,
) -> Iterator[memoryview]:
    """The packets of a sensor, all of one size.

    seen : gets the packets of each address and port.
    """
    size = 0
    for datagram in Datagrams(path, alive):
        found = format_of(datagram.payload)
        if found is None or (found != row and {found.name, row.name} != _ALIKE):
            continue
        if seen is not None:
            seen[datagram.sender, datagram.port] += 1
        if not datagram.is_from(sender):
            continue
        size = size or len(datagram.payload)
        if len(datagram.payload) == size:
            yield datagram.payload


def turns_of(
    path: Path, lidar: Lidar, sender: str | None, alive: Callable[[], None], warn: Callable[[str], None]
) -> Iterator[TimedScan]:
    """The turns of a spinning sensor, or what a Livox sees in tenths of a second; without a ``sender``, those of the
    only one among the first packets, and a warning names those that begin later.
    """
    seen = Counter[tuple[str, int]]()
    first = sender or lidar.first
    if lidar.row is not None:
        row, angles = open_spinning(path, lidar.row, sender, alive)
        stream = SpinningStream(row, angles)
        for payload in _of_format(path, row, first, alive, seen):
            yield from stream.add(payload)
        yield from stream.end()
    else:
        livox = LivoxStream()
        for datagram in Datagrams(path, alive):
            points = points_of(datagram.payload)
            if points is not None:
                seen[datagram.sender, datagram.port] += 1
                if datagram.is_from(first):
                    yield from livox.add(points)
        yield from livox.end()
    names = sender_names(seen)
    if sender is None and len(names) > 1:
        warn(
            f"{path}: the scans are those of {first} alone; later, there are packets of several sensors, "
            f"{', '.join(names)}: choose one by topic (--topic)"
        )
