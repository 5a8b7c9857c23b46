"""Helpers for several formats: columns of binary records, rows of text, numbers in headers."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..types.points import Bytes, remission_name
from .times import time_name

MAX_HEADER_BYTES = 65536

# Limit for the memory that decoding a capture takes, and for what one of its chunks unpacks to: 2 GiB.
MAX_BYTES = 1 << 31

# Limit for a scan: 16 million points of KITTI's files, where a turn of the densest sensors has half a million. Reading
# so much text takes 2 GiB of memory.
MAX_SCAN_BYTES = 1 << 28

_LEAST_ROW_BYTES = 6  # of text: three digits, two blanks and the end


class Columns(NamedTuple):
    """The fields of a scan, for `edgeperc.types.points.assemble`."""

    n: int  # number of points
    fields: Mapping[str, NDArray[Any]]  # columns by `edgeperc.types.points.plain_name`
    names: Sequence[str]  # all fields of the source
    # Points that the header declares, and that a file that was cut short lacks; below 0, those that it holds more.
    n_missing: int = 0


def column(data: Bytes, kind: str, n: int, offset: int, stride: int) -> NDArray[Any]:
    """View of one field of binary records, (n,); ``offset`` and ``stride`` in bytes."""
    if n == 0:
        return np.empty(0, dtype=kind)
    column: NDArray[Any] = np.ndarray((n,), kind, data.data, offset, (stride,))
    return column


def header_lines(head: bytes, last: str, kind: str) -> tuple[list[list[str]], int]:
    """Words of each line of a header that ends with the line ``last``, and its length in bytes."""
    lines: list[list[str]] = []
    start = 0
    while not lines or lines[-1][:1] != [last]:
        end = head.find(b"\n", start)
        if end < 0:
            raise PointsError(f"the {kind} header has no {last} line; the file is cut short or not a {kind} file")
        lines.append(head[start:end].decode("latin-1").split())
        start = end + 1
    return lines, start


def whole_number(text: str) -> int:
    """Parse an integer of a header; ValueError if it does not fit 64 bits."""
    value = int(text)
    if abs(value) >= 1 << 63:
        raise ValueError("a number beyond 64 bits")
    return value


def parse_records(
    body: Bytes,
    n: int,
    places: Mapping[str, tuple[str, int]],
    record: int,
    names: Sequence[str],
    *,
    is_last: bool = True,
) -> Columns:
    """Parse n records of ``record`` bytes, as far as they are whole; ``places`` has each field's type and first byte.

    Raises PointsError: None is whole, or more are declared than a scan has.
    """
    n_there = n
    if n * record > body.size:
        n_there = body.size // record
        if not n_there or n * record > MAX_SCAN_BYTES:
            raise cut_short(n, record, body.size)
    fields = {name: column(body, kind, n_there, first, record) for name, (kind, first) in places.items()}
    return Columns(n_there, fields, names, n - (body.size // record if is_last and record else n_there))


def cut_short(n: int, record: int, size: int) -> PointsError:
    """The error for a file that ends before the points its header declares."""
    return PointsError(
        f"cut short: the header declares {n} points of {record} bytes, but {size} bytes follow it ({size // record} "
        "points)"
    )


def parse_table(
    body: Bytes,
    skipped_rows: int,
    n: int,
    places: Mapping[str, int],
    names: Sequence[str],
    remission_field: str | None,
    *,
    is_last: bool = True,
) -> Columns:
    """Parse coordinates, remission and time from rows of text; ``places`` has each field's position in a row, and no
    row of something else follows those that are the last.
    """
    wanted = {name: places[name] for name in "xyz" if name in places}
    for name in (remission_name(places, remission_field), time_name(places)):
        if name is not None:
            wanted[name] = places[name]
    ends = np.flatnonzero(body == 10) + 1
    n_ended = len(ends)
    n_more = 0
    if is_last and skipped_rows + n <= n_ended:
        behind = body[ends[skipped_rows + n - 1] if skipped_rows + n else 0 :]
        n_more = sum(bool(row.strip()) for row in behind.tobytes().splitlines())
    if not {"x", "y", "z"} <= wanted.keys() or n == 0:
        return Columns(0, {name: np.empty(0) for name in wanted}, names, -n_more)
    if len(body[ends[-1] if n_ended else 0 :].tobytes().split()) > max(wanted.values()):
        ends = np.append(ends, body.size)  # the last row needs no end, but after a cut it may be half a number
    n_there = n if skipped_rows + n <= len(ends) else n_ended - skipped_rows
    if n_there < 1 or n * _LEAST_ROW_BYTES > MAX_SCAN_BYTES:
        raise PointsError(f"cut short: {skipped_rows + n} rows declared, {len(ends)} are there")
    raw = body[ends[skipped_rows - 1] if skipped_rows else 0 : ends[skipped_rows + n_there - 1]].tobytes()
    text = raw.decode("latin-1")
    if not text.strip():  # of what numpy takes for blanks, too, such as the separators of ASCII
        raise PointsError(f"cut short: {n} rows declared, none are there")
    try:
        rows = np.loadtxt(io.StringIO(text), np.float64, comments=None, usecols=list(wanted.values()), ndmin=2)
    except (ValueError, OverflowError) as exc:
        raise PointsError(f"a row of text does not hold numbers: {exc}") from exc
    if len(rows) != n_there:
        raise PointsError(f"cut short: {n} rows declared, {len(rows)} of numbers are there")
    return Columns(n_there, dict(zip(wanted, rows.T, strict=True)), names, n - n_there if n_there < n else -n_more)
