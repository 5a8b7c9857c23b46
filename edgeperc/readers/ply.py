"""PLY files."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..types.points import Bytes, Ints64, plain_name
from .tables import Columns, cut_short, header_lines, parse_records, parse_table, whole_number

_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


@dataclass(frozen=True)
class _PlyElement:
    name: str
    count: int
    properties: list[tuple[str, str, str]]  # name, type, type of a list's length or ""

    @property
    def has_lists(self) -> bool:
        return any(length_type for _, _, length_type in self.properties)


def _parse_ply_header(head: bytes) -> tuple[str, list[_PlyElement], int]:
    encoding = ""
    elements: list[_PlyElement] = []
    lines, n_bytes = header_lines(head, "end_header", "PLY")
    for tokens in lines:
        try:
            match tokens:
                case ["format", kind, *_]:
                    encoding = kind
                case ["element", name, count]:
                    if whole_number(count) < 0:
                        raise ValueError("a negative count")
                    elements.append(_PlyElement(name, whole_number(count), []))
                case ["property", "list", length_type, kind, name]:
                    if _PLY_TYPES[length_type][0] == "f":
                        raise ValueError("a list's length must be whole")
                    elements[-1].properties.append((name, _PLY_TYPES[kind], _PLY_TYPES[length_type]))
                case ["property", kind, name]:
                    elements[-1].properties.append((name, _PLY_TYPES[kind], ""))
                case ["ply" | "end_header"] | [] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError("an unknown line")
        except (ValueError, KeyError, IndexError) as exc:
            raise PointsError(f"the PLY header line {' '.join(tokens)[:80]!r} cannot be read ({exc})") from exc
    return encoding, elements, n_bytes


def parse_ply(data: Bytes, head: bytes, remission_field: str | None) -> Columns:
    """Parse the vertices of a PLY file, ascii or binary; ``head`` is its beginning, with the whole header."""
    encoding, elements, start = _parse_ply_header(head)
    before: list[_PlyElement] = []
    for vertex in elements:
        if vertex.name == "vertex":
            break
        before.append(vertex)
    else:
        raise PointsError("the PLY file has no vertex element")
    body, is_last = data[start:], not any(element.count for element in elements[len(before) + 1 :])
    names = [name for name, _, _ in vertex.properties]
    places: dict[str, int] = {}
    for k, (name, _, length_type) in enumerate(vertex.properties):
        if not length_type:
            places.setdefault(plain_name(name), k)
    if encoding == "ascii":
        if vertex.has_lists:
            raise PointsError("a PLY text file with lists among a vertex' properties; save it as binary")
        n_before = sum(e.count for e in before)
        return parse_table(body, n_before, vertex.count, places, names, remission_field, is_last=is_last)
    if encoding not in ("binary_little_endian", "binary_big_endian"):
        raise PointsError(f"PLY data is ascii, binary_little_endian or binary_big_endian, got {encoding!r}")
    order = "<" if encoding == "binary_little_endian" else ">"
    offset = 0
    for element in before:
        offset = _row_starts(body, offset, element, order)[1]
    kinds = [order + kind for _, kind, _ in vertex.properties]
    if not vertex.has_lists:
        *firsts, record = accumulate((np.dtype(kind).itemsize for kind in kinds), initial=0)
        of_record = {name: (kinds[k], firsts[k]) for name, k in places.items()}
        return parse_records(body[offset:], vertex.count, of_record, record, names, is_last=is_last)
    starts, _ = _row_starts(body, offset, vertex, order)
    assert starts is not None
    fields: dict[str, NDArray[Any]] = {}
    for name, k in places.items():
        octets = starts[:, k, None] + np.arange(np.dtype(kinds[k]).itemsize)
        fields[name] = body[octets].reshape(-1).view(kinds[k])
    return Columns(vertex.count, fields, names)


def _row_starts(body: Bytes, offset: int, element: _PlyElement, order: str) -> tuple[Ints64 | None, int]:
    """Start of each property of each row, None if all rows have one length; and the end of the element."""
    if not element.has_lists:
        record = sum(int(np.dtype(kind).itemsize) for _, kind, _ in element.properties)
        end = offset + element.count * record
        if end > body.size:
            raise cut_short(element.count, record, body.size - offset)
        return None, end
    byte_order: Literal["little", "big"] = "little" if order == "<" else "big"
    steps = [
        (np.dtype(kind).itemsize, np.dtype(length or "u1").itemsize if length else 0)
        for _, kind, length in element.properties
    ]
    least = sum(length_size or size for size, length_size in steps)
    if offset + element.count * least > body.size:
        raise cut_short(element.count, least, body.size - offset)
    starts = np.empty((element.count, len(steps)), dtype=np.int64)
    for row in range(element.count):
        for k, (size, length_size) in enumerate(steps):
            starts[row, k] = offset
            if length_size:
                offset += length_size + size * int.from_bytes(body[offset : offset + length_size].tobytes(), byte_order)
            else:
                offset += size
            if offset > body.size:
                raise PointsError(f"cut short: row {row} of {element.count} of {element.name!r} ends past the file")
    return starts, offset
