"""The turns of a LiDAR by Hesai, RoboSense or Livox in a capture, and the angles of a spinning one."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PointsError
from .livox_packets import LivoxStream, points_of
from .mems_packets import MemsFormat, MemsStream, mems_format_of
from .mirror_packets import MirrorStream, read_mirrors
from .packets import Datagrams
from .ports import is_port, named
from .senders import ALONE, Lidar, Whose, in_files, not_decoded
from .spinning_packets import (
    ALIKE,
    FORMATS,
    Angles,
    Format,
    SpinningStream,
    angles_of_difop,
    format_of,
    has_16_lasers,
    name_of,
    read_angles,
    told_apart,
)
from .times import TimedScan
from .units import hesai_calibration

_STEPS = 200  # packets that show how far apart columns are
Stream = SpinningStream | MemsStream | MirrorStream


def open_spinning(
    path: Path, row: Format, payloads: Iterable[memoryview], whose: Whose = ALONE, unit: str | None = None
) -> tuple[Format, Angles]:
    """The format and angles of a spinning sensor; PointsError if neither its packets nor a file beside the capture has
    them, nor the sensor itself tells them, where it is at an address now.
    """
    said = Angles(np.array([[each, 0.0] for each in row.elevations_deg])) if row.elevations_deg else None
    for payload in () if row.is_hesai else payloads:
        if row.name == "helios-32" and angles_of_difop(FORMATS["helios-16"], payload) is not None:
            row = FORMATS["helios-16"] if has_16_lasers(payload) else row
        said = angles_of_difop(row, payload)
        if said is not None:
            break
    file = _file_of(path, ".csv", whose) if said is None or row.elevations_deg else None
    if file is not None:
        angles = read_angles(file, row)
        return told_apart(row, angles), angles
    if said is None and row.is_hesai and unit is not None:
        with _asked(f"the angles of the lasers of this {row.title} are not known", f"{_stem(path, whose)}.csv"):
            angles = read_angles(hesai_calibration(unit), row)
            return told_apart(row, angles), angles
    if said is None:
        there = "" if row.is_hesai else "There is no packet with the angles (DIFOP, port 7788). "
        if there and is_port(path):
            there += f"Listen to its port, too: {path},7788. Or: "
        titles = " or ".join(FORMATS[name].title for name in (row.name, ALIKE.get(row.name)) if name)
        what = "Hesai's calibration of the unit" if row.is_hesai else "a row 'elevation,azimuth' for each laser [deg]"
        raise PointsError(
            f"the angles of the lasers of this {titles} are not known. {there}Put {what} beside it, as "
            f"{_stem(path, whose)}.csv"
        )
    return row, said


@contextmanager
def _asked(unknown: str, name: str) -> Iterator[None]:
    """Say what to do where a live sensor does not answer, or what is of no use."""
    try:
        yield
    except PointsError as exc:
        raise PointsError(
            f"{unknown}. {exc}. Save the calibration of the unit from its web page into the current folder, as {name}"
        ) from exc


def unit_at(path: Path, sender: str) -> str | None:
    """Where a sender, an address with or without its port, can be asked: at ports, for it is there now."""
    return sender.partition(":")[0] if is_port(path) else None


def _stem(path: Path, whose: Whose) -> str:
    """What the file of a sensor's calibration is to be called, without its suffix."""
    return named(path).stem + (f"_{in_files(whose.name)}" if len(whose.all) > 1 else "")


def _file_of(path: Path, suffix: str, whose: Whose) -> Path | None:
    """Of drive.pcap drive.csv, else drive_angles.csv; of one of several sensors, drive_ADDRESS.csv or drive_TOPIC.csv;
    drive2.csv is of another capture. PointsError if a file may be of several sensors.
    """
    path = named(path)
    files = sorted(path.absolute().parent.glob(f"*{suffix}"))
    own = [file for file in files if re.fullmatch(re.escape(path.stem) + r"([\W_].*)?", file.stem)]
    names = [file.stem[len(path.stem) + 1 :] for file in own]
    if in_files(whose.name) in names:
        return own[names.index(in_files(whose.name))]
    of_others = {in_files(other) for other in whose.all}
    shared = [file for file, name in zip(own, names, strict=True) if name not in of_others]
    file = min(shared, key=lambda each: len(each.stem), default=None)
    if file is not None and len(whose.alike) > 1:
        raise PointsError(
            f"{file.name} does not say of which sensor it is, {' or '.join(whose.alike)}. Put the calibration of each "
            f"beside the recording; of this one, as {_stem(path, whose)}{suffix}"
        )
    return file


def columns_of(row: Format, payloads: Iterable[memoryview]) -> int:
    """How many columns a turn has, by the azimuths of the first packets; 0 if they do not show it."""
    stream, azimuths = SpinningStream(row, Angles(np.zeros((128, 2)))), list[float]()
    for payload in islice(filter(row.fits, payloads), _STEPS):
        azimuths += stream.azimuths_of(payload)
    steps = np.diff(azimuths) % 360.0
    steps = steps[(steps > 0.01) & (steps < 5.0)]
    firings = 2 if row.lasers == 16 else 1  # of a block
    return round(firings * 360.0 / float(np.median(steps))) if len(steps) else 0


def payloads_of(
    path: Path, sender: str | None, alive: Callable[[], None], *, endless: bool = False
) -> Iterator[memoryview]:
    """What the packets of a sender carry, None: of all."""
    datagrams = Datagrams(path, alive, endless=endless)
    return (datagram.payload for datagram in datagrams if datagram.is_from(sender))


def stream_of(path: Path, payload: memoryview, units: Iterable[memoryview], whose: Whose = ALONE) -> Stream | None:
    """`open_stream` of a sensor that sends such packets; None if it has no points.

    Raises PointsError: The packets of the sensor are not decoded, or `open_spinning`.
    """
    row = _known_format(payload)
    return None if row is None else open_stream(path, row, units, whose)


def _known_format(payload: memoryview) -> Format | MemsFormat | None:
    """The format of a packet with points; None if it has none. PointsError if it is known, and not decoded."""
    row: Format | MemsFormat | None = mems_format_of(payload) or format_of(payload)
    if row is None and (name := name_of(payload)) is not None:
        raise PointsError(not_decoded(name))
    return row


def open_stream(
    path: Path, row: Format | MemsFormat, units: Iterable[memoryview], whose: Whose = ALONE, unit: str | None = None
) -> Stream:
    """What makes scans of the packets of a format; PointsError as of `open_spinning`."""
    if isinstance(row, MemsFormat):
        return MemsStream(row)
    if row.spins:
        return SpinningStream(*open_spinning(path, row, units, whose, unit))
    file, unknown = _file_of(path, ".dat", whose), f"where the lasers of this {row.title} look is not known"
    if file is None and unit is not None:
        with _asked(unknown, f"{_stem(path, whose)}.dat"):
            return MirrorStream(row, read_mirrors(hesai_calibration(unit)))
    if file is None:
        raise PointsError(f"{unknown}. Put the correction file of the unit beside it, as {_stem(path, whose)}.dat")
    return MirrorStream(row, read_mirrors(file))


def describe_packets(
    path: Path, payloads: Sequence[memoryview], unit: memoryview | None, whose: Whose
) -> dict[str, Any]:
    """What packets in messages say about their sensor; see `decoders.describe`."""
    found = next((row for row in map(_known_format, payloads) if row is not None), None)
    if found is None:
        raise PointsError("the packets hold no points of a sensor that is known")
    if isinstance(found, MemsFormat) or not found.spins:
        return {"model": found.name}
    row, angles = open_spinning(path, found, [] if unit is None else [unit], whose)
    n = columns_of(row, payloads)
    return {"spinning": row.name, "lasers_deg": angles.lasers_deg.tolist(), "columns": n}


def turns_of(path: Path, lidar: Lidar, sender: str | None, alive: Callable[[], None]) -> Iterator[TimedScan]:
    """The turns of a spinning sensor, or what a Livox sees in tenths of a second.

    sender : None: the only one among the first packets.
    Raises PointsError: As `open_spinning`.
    """
    first = sender or lidar.first
    payloads = payloads_of(path, first, alive, endless=True)
    if lidar.row is None:
        livox = LivoxStream()
        for points in filter(None, map(points_of, payloads)):
            yield from livox.add(points)
        yield from livox.end()
        return
    units, unit = payloads_of(path, sender, alive), unit_at(path, first)
    stream = open_stream(path, lidar.row, units, lidar.whose(sender), unit)
    for payload in filter(stream.row.fits, payloads):
        yield from stream.add(payload)
    yield from stream.end()
