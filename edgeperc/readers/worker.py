"""The process that decodes or describes one capture: a request from standard input, replies to standard output.

Every reply is a header (`HEADER`: kind, stamp, number of bytes) and its bytes; `apart` reads them.
"""

from __future__ import annotations

import importlib
import json
import os
import struct
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..errors import MissingExtraError, PointsError
from .decoders import decode, describe
from .tables import MAX_BYTES, MAX_SCAN_BYTES

HEADER = struct.Struct("<cdqq")  # kind, stamp [s], the same [ns] or -1, bytes
ALIVE, END, ERROR, FOUND, MISSING, READY, SCAN, TIMES, WARNING = b"A", b"Z", b"E", b"F", b"M", b"R", b"S", b"T", b"W"


def main() -> None:
    """Serve the request: a JSON object with path, kind, topic; and remission_field and times, if it asks for scans.

    The times of a scan's points come before the scan, if they are asked for and known.
    """
    # What the libraries print must not come between the replies.
    replies = os.fdopen(os.dup(1), "wb", 0)
    os.dup2(2, 1)
    request = json.loads(sys.stdin.buffer.readline())
    _limit_memory()
    # A thread that takes packets waits so long for its turn while another one decodes; in 5 ms, 30 of them come.
    sys.setswitchinterval(1e-4)
    with suppress(BrokenPipeError):  # the reader has gone

        def reply(kind: bytes, content: memoryview | bytes = b"", stamp: float = np.nan) -> None:
            for part in (HEADER.pack(kind, stamp, getattr(stamp, "ns", -1), len(content)), content):
                view = memoryview(part)
                while len(view):
                    view = view[replies.write(view) :]

        reply(READY)
        capture = Path(request["path"]), request["kind"], request["topic"]
        try:
            if "remission_field" not in request:
                reply(FOUND, json.dumps(describe(*capture, lambda: reply(ALIVE))).encode())
                return
            for stamp_s, points, times_s in decode(
                *capture,
                request["remission_field"],
                lambda text: reply(WARNING, text.encode("utf-8", "replace")),
                lambda: reply(ALIVE),
                times=request["times"],
            ):
                if points.nbytes > MAX_SCAN_BYTES:
                    raise PointsError(
                        f"{request['path']}: a scan of {len(points):,} points is too large; expected at most "
                        f"{MAX_SCAN_BYTES // 16:,}"
                    )
                if times_s is not None:
                    reply(TIMES, np.ascontiguousarray(times_s, "<f8").data.cast("B") if times_s.size else b"")
                content = np.ascontiguousarray(points, "<f4").data.cast("B") if points.size else b""
                reply(SCAN, content, np.nan if stamp_s is None else stamp_s)
        except MissingExtraError as exc:
            reply(MISSING, json.dumps([exc.package, exc.extra, exc.purpose, exc.damaged]).encode())
        except PointsError as exc:
            reply(ERROR, str(exc).encode("utf-8", "replace"))
        else:
            reply(END)


def _limit_memory() -> None:
    """Where the system can: Linux counts the data, macOS accepts the limit without effect, Windows has none."""
    with suppress(ImportError, ValueError, OSError):
        resource = importlib.import_module("resource")
        _, most = resource.getrlimit(resource.RLIMIT_DATA)
        limit = MAX_BYTES if most == resource.RLIM_INFINITY else min(MAX_BYTES, most)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, most))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
