"""PCD files (Point Cloud Library)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..errors import PointsError
from ..system.kernels import njit
from ..types.points import Bytes, plain_name
from . import tables

_PCD_TYPES = {f"{kind}{size}": f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)} | {
    "F4": "<f4",
    "F8": "<f8",
}


def begins_like_pcd(head: bytes) -> bool:
    """Whether the first lines are those of a PCD header."""
    for line in head.splitlines():
        tokens = line.split()
        if tokens and not tokens[0].startswith(b"#"):
            return tokens[0] in (b"VERSION", b"FIELDS", b"COLUMNS")
        if line.startswith(b"# .PCD"):
            return True
    return False


class _PcdHeader(NamedTuple):
    names: tuple[str, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    n_points: int
    encoding: str
    n_bytes: int


def _parse_pcd_header(head: bytes) -> _PcdHeader:
    lines, n_bytes = tables.header_lines(head, "DATA", "PCD")
    entries = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    names = entries.get("FIELDS", entries.get("COLUMNS", []))
    try:
        sizes = [tables.whole_number(token) for token in entries.get("SIZE", [])]
        counts = [tables.whole_number(token) for token in entries.get("COUNT", ["1"] * len(names))]
        width, height = (
            tables.whole_number(entries[key][0]) if key in entries else None for key in ("WIDTH", "HEIGHT")
        )
        n_points = tables.whole_number(entries["POINTS"][0]) if "POINTS" in entries else None
    except (ValueError, IndexError) as exc:
        raise PointsError(f"the PCD header has an entry that must be a number and is not ({exc})") from exc
    kinds = entries.get("TYPE", [])
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise PointsError("the PCD header's FIELDS, SIZE, TYPE and COUNT lines must be of equal length")
    types = [_PCD_TYPES.get(f"{kind}{size}", "") for kind, size in zip(kinds, sizes, strict=True)]
    if not all(types):
        raise PointsError(
            f"the PCD header has a field of an unknown TYPE and SIZE: {' '.join(kinds)} / {' '.join(map(str, sizes))}"
        )
    if any(not 1 <= count <= tables.MAX_HEADER_BYTES for count in counts):
        raise PointsError(f"the PCD header's COUNT must be at least 1, got {' '.join(map(str, counts))}")
    organized = None if width is None else width * (1 if height is None else height)
    if n_points is None and organized is not None and organized < 1 << 63:
        n_points = organized
    if n_points is None or n_points < 0 or organized not in (None, n_points):
        raise PointsError(f"the PCD header declares {width} x {height} points and POINTS {n_points}; they must agree")
    encoding = entries["DATA"][0].lower() if entries["DATA"] else ""
    return _PcdHeader(tuple(names), tuple(types), tuple(counts), n_points, encoding, n_bytes)


def parse_pcd(data: Bytes, head: bytes, remission_field: str | None) -> tables.Columns:
    """Parse a PCD file: ascii, binary or binary_compressed; ``head`` is its beginning, with the whole header."""
    header = _parse_pcd_header(head)
    n, body, record, n_values = header.n_points, data[header.n_bytes :], 0, 0
    # Of each field of one value: its type and first byte in a record, and its place among the values of a row.
    places: dict[str, tuple[str, int]] = {}
    ranks: dict[str, int] = {}
    for name, kind, count in zip(map(plain_name, header.names), header.types, header.counts, strict=True):
        if count == 1 and name not in places:  # padding fields are all called "_"
            places[name], ranks[name] = (kind, record), n_values
        record += np.dtype(kind).itemsize * count
        n_values += count
    if header.encoding == "ascii":
        return tables.parse_table(body, 0, n, ranks, header.names, remission_field)
    if header.encoding == "binary":
        return tables.parse_records(body, n, places, record, header.names)
    if header.encoding != "binary_compressed":
        raise PointsError(f"PCD data is ascii, binary or binary_compressed, got {header.encoding!r}")
    unpacked = _unpack_pcd(body, n * record)  # field by field
    fields = {k: tables.column(unpacked, kind, n, n * at, np.dtype(kind).itemsize) for k, (kind, at) in places.items()}
    return tables.Columns(n, fields, header.names)


def _unpack_pcd(body: Bytes, n_bytes: int) -> Bytes:
    if n_bytes == 0:
        return np.empty(0, dtype=np.uint8)
    if body.size < 8:
        raise PointsError("cut short: no compressed data follows the PCD header")
    packed_size, size = (int(v) for v in body[:8].view("<u4"))
    if packed_size > body.size - 8:
        raise PointsError(f"cut short: {packed_size} bytes of compressed data declared, {body.size - 8} are there")
    # The longest LZF reference takes 3 bytes and gives 264, so a larger claim is false; check before allocating.
    if size != n_bytes or size > 88 * packed_size:
        raise PointsError(f"{packed_size} compressed bytes claim to unpack to {size}; the fields need {n_bytes}")
    if size > tables.MAX_SCAN_BYTES:
        raise PointsError(f"the compressed data unpacks to {size:,} bytes; expected at most {tables.MAX_SCAN_BYTES:,}")
    unpacked = np.empty(size, dtype=np.uint8)
    if fill_unpacked_lzf(body[8 : 8 + packed_size], unpacked) != size:
        raise PointsError("the compressed data is damaged")
    return unpacked


@njit(cache=True, nogil=True)
def fill_unpacked_lzf(packed: Bytes, unpacked: Bytes) -> int:
    """Decompress LZF data into ``unpacked``.

    Returns: Bytes written; -1 if a reference leaves the data or the output.
    """
    n_in = packed.shape[0]
    n_out = unpacked.shape[0]
    i = 0
    o = 0
    while i < n_in:
        control = np.int64(packed[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > n_in or o + length > n_out:
                return -1
            for _ in range(length):
                unpacked[o] = packed[i]
                o += 1
                i += 1
            continue
        length = control >> 5
        if length == 7:
            if i >= n_in:
                return -1
            length += np.int64(packed[i])
            i += 1
        if i >= n_in:
            return -1
        back = o - ((control & 31) << 8) - np.int64(packed[i]) - 1
        i += 1
        length += 2
        if back < 0 or o + length > n_out:
            return -1
        for _ in range(length):  # byte by byte: a reference may overlap what it writes
            unpacked[o] = unpacked[back]
            o += 1
            back += 1
    return o
