"""Decompression that stops at a limit, so that a small damaged or hostile file cannot fill the memory."""

from __future__ import annotations

import bz2
import io
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import PointsError
from ..system.extras import require
from .tables import MAX_BYTES

# Scans pack less than 20 to 1. Clouds without a return pack better, but are smaller than 64 MiB.
_MOST_RATIO, _ALWAYS_BYTES = 100, 1 << 26

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def most_bytes(n_packed: int) -> int:
    """Most bytes that so many compressed bytes may unpack to."""
    return max(_MOST_RATIO * n_packed, _ALWAYS_BYTES)


def inflate(packed: bytes, method: str, limit: int | None = None) -> bytes:
    """Decompress bytes (``"lz4"``: the frame format; ``""``: plain) up to a limit, and never more than `most_bytes`."""
    limit = min(MAX_BYTES if limit is None else limit, most_bytes(len(packed)) if method else MAX_BYTES)
    if method == "":
        content = packed
    elif method in ("deflate", "gzip", "bz2", "lz4", "zstd"):
        try:
            content = _decompressor(method)(packed, limit + 1)
        except (PointsError, ImportError, MemoryError):
            raise
        except EOFError as exc:
            raise PointsError(f"the {method} data is cut short") from exc
        except Exception as exc:  # each library has its own errors
            raise PointsError(f"the {method} data is damaged: {exc}") from exc
    else:
        raise PointsError(f"unknown compression {method!r}; expected lz4, zstd or bz2")
    if len(content) > limit:
        raise PointsError(f"{len(packed):,} compressed bytes unpack to more than {limit:,}, so they are not unpacked")
    return content


def inflated_message(data: memoryview) -> memoryview:
    """A message of a bag, which rosbag2 may have compressed by itself."""
    return memoryview(inflate(bytes(data), "zstd")) if bytes(data[:4]) == _ZSTD_MAGIC else data


def inflate_file(packed: Path, target: Path, limit: int, alive: Callable[[], None]) -> int:
    """Decompress a zstd file into another one, but no more bytes than a limit; their number."""
    zstd = require("zstandard", "bags", "Reading zstd data")
    n = 0
    with packed.open("rb") as source, target.open("wb") as out:
        reader = zstd.ZstdDecompressor().stream_reader(source, read_across_frames=True)
        try:
            while piece := reader.read(1 << 20):
                n += len(piece)
                if n > limit:
                    size = packed.stat().st_size
                    raise PointsError(f"{size:,} compressed bytes unpack to more than {limit:,}, which is not done")
                out.write(piece)
                if n % (1 << 28) < len(piece):
                    alive()
        except zstd.ZstdError as exc:
            raise PointsError(f"the zstd data is damaged: {exc}") from exc
    return n


def _decompressor(method: str) -> Any:
    """A function from the compressed bytes and a number to at most so many bytes."""
    if method == "deflate":
        return zlib.decompressobj(-15).decompress
    if method == "gzip":
        return zlib.decompressobj(31).decompress
    if method == "bz2":  # several streams may follow one another, as parallel compressors write them
        return lambda packed, most: _in_pieces(bz2.BZ2File(io.BytesIO(packed)).read, most)
    if method == "lz4":
        lz4 = require("lz4.frame", "bags", "Reading lz4 data")
        return lambda packed, most: _in_pieces(lz4.LZ4FrameFile(io.BytesIO(packed)).read, most)
    zstd = require("zstandard", "bags", "Reading zstd data")
    return lambda packed, most: _in_pieces(zstd.ZstdDecompressor().stream_reader(packed).read, most)


def _in_pieces(read: Callable[[int], bytes], most: int) -> bytes:
    """Read to the end or the limit; these libraries allocate what a single call asks for."""
    pieces, n = [], 0
    while n < most and (piece := read(min(1 << 20, most - n))):
        pieces.append(piece)
        n += len(piece)
    return b"".join(pieces)
