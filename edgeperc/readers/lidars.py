"""The turns of a LiDAR by Hesai, RoboSense or Livox in a capture, and the angles of a spinning one."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from ..errors import PointsError
from .livox_packets import LivoxStream, points_of
from .packets import Datagrams
from .senders import Lidar
from .spinning_packets import (
    FORMATS,
    Angles,
    Format,
    SpinningStream,
    angles_of_difop,
    format_of,
    has_16_lasers,
    read_angles,
)
from .times import TimedScan

_STEPS = 200  # packets that show how far apart columns are
_ALIKE = {"helios-32", "helios-16"}  # by their packets; the angles tell them apart


def open_spinning(path: Path, row: Format, sender: str | None, alive: Callable[[], None]) -> tuple[Format, Angles]:
    """The format and angles of a spinning sensor; PointsError if neither the capture nor a file beside it has them."""
    files = sorted(path.absolute().parent.glob("*.csv"))
    # Of drive.pcap drive.csv, else drive_angles.csv; drive2.csv is of another capture.
    own = [file for file in files if re.fullmatch(re.escape(path.stem) + r"([\W_].*)?", file.stem)]
    file = min(own, key=lambda each: len(each.stem), default=None)
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
