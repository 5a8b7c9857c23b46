"""Ouster captures: the sensor's metadata, and the checksums of .osf files, which ouster-sdk reads."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PointsError
from ..system.fields import Fields
from .ports import is_port, listen, named
from .units import Told, ouster_metadata

FIELDS = Fields("the metadata", PointsError)
# Sensors have up to 128 beams, 4,096 columns in a turn and 32 columns in a packet.
_MOST_BEAMS, _MOST_COLUMNS = 1024, 65536
_MOST_JSON_BYTES = 1 << 24
_OTHERS_BYTES = 1500  # other sensors' packets fit into a frame of Ethernet; an Ouster's have 2,304 bytes and more


def metadata_beside(path: Path) -> Sequence[Path | Told]:
    """The .json files whose names have the longest beginning in common with the capture's, as ouster-sdk chooses, but
    for sensor profiles, which `edgeperc info --write` may have put there. Without one, a live sensor is asked.
    """
    alike: dict[int, list[Path]] = {}
    name = named(path).name
    for file in sorted(named(path).absolute().parent.iterdir()):
        n = len(os.path.commonprefix([file.name, name]))  # noqa: RUF071 - of the characters
        if n and file.suffix.lower() == ".json" and file.is_file():
            alike.setdefault(n, []).append(file)
    for n in sorted(alike, reverse=True):
        if files := [file for file in alike[n] if not _is_profile(file)]:
            return files
    told = _told(path) if is_port(path) else []
    if found := [each for each in told if isinstance(each, Told)]:
        return found
    raise PointsError(
        "no points of a LiDAR that is known (one that starts sends none), unless they are an Ouster's: there is no "
        f"metadata next to it. {''.join(f'{exc}. ' for exc in told)}"
        "Expected a .json file whose name has the same beginning"
    )


def _told(port: Path) -> list[Told | PointsError]:
    """What each sensor says whose packets are as long as an Ouster's alone."""
    listener = listen(port)
    for sender in dict.fromkeys(each.sender for each in listener.begun if len(each.payload) > _OTHERS_BYTES):
        if sender not in listener.told:
            try:
                listener.told[sender] = ouster_metadata(sender)
            except PointsError as exc:
                listener.told[sender] = exc
    return [*listener.told.values()]


def _is_profile(file: Path) -> bool:
    """Whether a .json file is a sensor profile of edgeperc."""
    return file.stat().st_size <= _MOST_JSON_BYTES and b'"elevations_deg"' in file.read_bytes()


def read_metadata(path: Path | Told) -> dict[str, Any]:
    """The text of a sensor's metadata, once it is checked."""
    if isinstance(path, Path) and path.stat().st_size > _MOST_JSON_BYTES:
        raise PointsError(f"the metadata {path.name} is larger than {_MOST_JSON_BYTES:,} bytes")
    with reading(f"the metadata {path.name}"):
        try:
            content = json.loads(path.read_bytes().decode("utf-8-sig", "replace"))
        except (ValueError, RecursionError) as exc:
            raise PointsError(f"it is not JSON ({exc})") from exc
        check_metadata(content)
        return content


@contextmanager
def reading(source: str) -> Iterator[None]:
    """Name the metadata in errors."""
    try:
        yield
    except PointsError as exc:
        raise PointsError(f"{source} cannot be read: {exc}") from exc


def object_in(content: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """An object in metadata, empty where there is none."""
    value = content.get(name)
    return value if isinstance(value, dict) else {}


def check_metadata(content: Any) -> None:
    """Raise `PointsError` unless the numbers that arrays are made by, as far as they are there, are possible."""
    if not isinstance(content, dict):
        raise PointsError(f"expected an object, got {type(content).__name__}")
    layout = content.get("lidar_data_format", content.get("data_format", {}))
    if not isinstance(layout, dict):
        raise PointsError("data_format: expected an object")
    most = {"columns_per_packet": 1024, "pixels_per_column": _MOST_BEAMS, "columns_per_frame": _MOST_COLUMNS}
    for name, limit in most.items():
        if name in layout:
            FIELDS.whole(name, layout[name], 1, limit)
    columns, beams = layout.get("columns_per_frame", _MOST_COLUMNS), layout.get("pixels_per_column")
    if layout.get("columns_per_packet", 1) > columns:
        raise PointsError(f"columns_per_packet: {layout['columns_per_packet']} is above columns_per_frame, {columns}")
    for edge in FIELDS.entry(tuple[int, int], layout.get("column_window", [0, 0]), "column_window"):
        FIELDS.whole("column_window", edge, 0, columns - 1)
    angles = content.get("beam_intrinsics", {})
    for holder in (content, angles if isinstance(angles, dict) else {}):
        for name in ("beam_altitude_angles", "beam_azimuth_angles"):
            if name in holder:
                beams = _checked_beams(name, holder[name], beams)
    shifts = layout.get("pixel_shift_by_row")
    if shifts is not None:
        _checked_beams("pixel_shift_by_row", shifts, beams)
        for shift in shifts:
            FIELDS.whole("pixel_shift_by_row", shift, -columns, columns)


def _checked_beams(name: str, values: Any, n: int | None) -> int:
    """The length of a list with a number for each beam."""
    if not isinstance(values, list) or not 1 <= len(values) <= _MOST_BEAMS or n not in (None, len(values)):
        got = f"{len(values)}" if isinstance(values, list) else type(values).__name__
        raise PointsError(
            f"{name}: expected a list of {n or f'1 to {_MOST_BEAMS}'} numbers, one for each beam, got {got}"
        )
    for value in values:  # early firmware has a list of numbers for each beam
        FIELDS.numbers(name, value if isinstance(value, list) else [value], low=-_MOST_COLUMNS, high=_MOST_COLUMNS)
    return len(values)


def check_osf(path: Path) -> None:
    """Raise `PointsError` unless every checksum is right."""
    data = np.memmap(path, np.uint8, "r").data
    kind, offset, size = b"", 0, len(data)
    while offset < size:
        # The length of the block, the block, CRC-32 of both.
        end = offset + 4 + struct.unpack_from("<I", data, offset)[0] if offset + 8 <= size else size
        if end + 4 > size or zlib.crc32(data[offset:end]) != struct.unpack_from("<I", data, end)[0]:
            raise PointsError(
                f"the .osf file is damaged or cut short: the block at byte {offset:,} of {size:,} is not whole"
            )
        kind, offset = bytes(data[offset + 8 : offset + 12]), end + 4
    if kind != b"OSF#":
        raise PointsError("the .osf file is cut short: its last block is not the metadata")
