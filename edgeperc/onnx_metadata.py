"""Read one metadata entry of an .onnx file, without onnx or onnxruntime.

An .onnx file is a protobuf message, a sequence of fields. Each field begins with its number and, for most types, its
length. Only ``metadata_props`` is read. The graph with the weights is one field, which is skipped.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from .errors import CardError, ModelFileError

__all__ = ["read_metadata"]

METADATA_PROPS = 14  # field number in ModelProto; an entry has a key (field 1) and a value (field 2)
MAX_FIELDS = 10_000  # a model has about twenty; a file of empty fields would take minutes to read


def read_metadata(path: str | os.PathLike[str], key: str) -> str | None:
    """Read the text of a metadata entry.

    Parameters
    ----------
    path : str or Path
        An .onnx file.
    key : str

    Returns
    -------
    str or None
        The last value if the key occurs several times, as in onnxruntime. None if the key is absent.

    Raises
    ------
    ModelFileError
        The file cannot be read.
    CardError
        The file is truncated or not an .onnx file, or the entry is not UTF-8 text.
    """
    wanted, text = key.encode(), None
    try:
        with Path(path).open("rb") as file:
            for number, _, end in _fields(file, os.fstat(file.fileno()).st_size):
                if number == METADATA_PROPS:
                    entry = _entry(file, end, wanted)
                    text = text if entry is None else entry.decode("utf-8")
    except OSError as exc:
        raise ModelFileError(f"{os.fspath(path)} cannot be read: {exc.strerror or exc}") from exc
    except ValueError as exc:
        raise CardError(
            f"{os.fspath(path)} is not a complete .onnx file ({exc}); copy or export the model again"
        ) from exc
    return text


def _entry(file: BinaryIO, end: int, wanted: bytes) -> bytes | None:
    """The value of the entry that ends at ``end``; None if the entry has another key."""
    found, value = b"", (0, 0)
    for number, start, stop in _fields(file, end):
        if number == 1:
            found = file.read(stop - start) if stop - start == len(wanted) else b""
        elif number == 2:
            value = start, stop
    if found != wanted:
        return None
    file.seek(value[0])
    return file.read(value[1] - value[0])


def _fields(file: BinaryIO, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield number, start and end of each field with a length, from the current position to ``end``."""
    n_fields = 0
    while file.tell() < end:
        tag, n_fields = _varint(file), n_fields + 1
        wire_type = tag & 7
        if wire_type not in (0, 1, 2, 5) or tag < 8 or n_fields > MAX_FIELDS:
            raise ValueError(f"no field begins at byte {file.tell() - 1}")
        if wire_type == 0:
            _varint(file)
            continue
        length = _varint(file) if wire_type == 2 else 8 if wire_type == 1 else 4
        start = file.tell()
        if start + length > end:
            raise ValueError(f"it ends within the field at byte {start}")
        if wire_type == 2:
            yield tag >> 3, start, start + length
        file.seek(start + length)


def _varint(file: BinaryIO) -> int:
    value = 0
    for shift in range(0, 70, 7):
        byte = file.read(1)
        if not byte:
            raise ValueError("it ends within a number")
        value |= (byte[0] & 0x7F) << shift
        if byte[0] < 0x80:
            return value
    raise ValueError(f"the number at byte {file.tell()} has more than ten bytes")
