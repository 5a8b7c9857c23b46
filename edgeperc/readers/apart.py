"""Captures decoded in a process of their own, which a damaged capture may end without harm."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingExtraError, PointsError
from ..system.clock import Stamp
from ..system.interpreter import interpreter, interpreter_flags
from ..system.printable import many
from ..types.points import Floats, Points
from .tables import MAX_BYTES, MAX_SCAN_BYTES
from .times import TimedScan
from .worker import ALIVE, END, ERROR, FOUND, HEADER, MISSING, READY, SCAN, TIMES, WARNING

# Longest time to decode one scan [s]; the slowest library takes well under one.
SCAN_LIMIT_S = 60.0

# Longest text of a reply: an Ouster's metadata, or a message.
_MOST_TEXT_BYTES = 1 << 24

# The module path is that of this process; the current folder, which may hold foreign files, is not added to it.
START = "import sys; sys.path[:] = sys.argv[1:]; from edgeperc.readers.worker import main; main()"


def decode_apart(
    path: Path, kind: str, topic: str | None, remission_field: str | None, times: bool
) -> Iterator[TimedScan]:
    """Like `decoders.decode`, in a process of its own; without ``times``, those of the points are None.

    The process runs ahead by one scan and waits then, so the memory stays flat. It ends with the iterator.
    """
    request = {"path": str(path), "kind": kind, "topic": topic, "remission_field": remission_field, "times": times}
    return _serve(request, path, [])


def describe_apart(path: Path, kind: str, topic: str | None) -> dict[str, Any]:
    """Like `decoders.describe`, in a process of its own."""
    descriptions: list[Any] = []
    for _ in _serve({"path": str(path), "kind": kind, "topic": topic}, path, descriptions):
        break  # a scan was not asked for
    if not descriptions or not isinstance(descriptions[0], dict):
        raise PointsError(f"{path}: the process that decodes captures replied nonsense; the capture is damaged")
    description: dict[str, Any] = descriptions[0]
    return description


def _serve(request: dict[str, Any], path: Path, found: list[Any]) -> Iterator[TimedScan]:
    """The scans of a request's reply; a description is appended to ``found``."""
    request_line = json.dumps(request).encode() + b"\n"
    with (
        tempfile.TemporaryDirectory(prefix="edgeperc-", ignore_cleanup_errors=True) as folder,
        start_process(folder) as process,
        Watch(process) as watch,
    ):
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with suppress(OSError), process.stdin as stdin:  # its end is found when it does not reply
                stdin.write(request_line)
            yield from _replies(process, process.stdout, path, watch, found)
        finally:
            process.kill()


def start_process(folder: str) -> subprocess.Popen[bytes]:
    """Start the process that decodes captures. Raises PointsError."""
    python = interpreter()
    if python is None:
        raise PointsError(
            f"captures are decoded by a Python of its own, and this application, {sys.executable!r}, is none; name one "
            "of the same version with multiprocessing.set_executable(path)"
        )
    # Threads of these libraries would each take part of the memory limit.
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    # Here lies what libraries unpack, and it is deleted even if the process is killed.
    temporary = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), folder)
    flags = getattr(subprocess, "CREATE_NO_WINDOW", 0) | getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
    return subprocess.Popen(
        [python, *interpreter_flags(), "-W", "ignore", "-c", START, *sys.path],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL if sys.stderr is None else None,  # its number would become that of the replies
        env={**os.environ, **one_thread, **temporary},
        creationflags=flags,
        start_new_session=os.name == "posix",  # Ctrl-C is for this process, which then ends the other
    )


class Watch:
    """A thread that ends the process when a reply, awaited since ``since_s`` on the monotonic clock, takes too long;
    not every system can wait for a pipe with a limit. Time in which this process is stopped, as by Ctrl-Z, is none.
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.since_s: float | None = None
        self.expired = False
        self._process, self.over = process, threading.Event()
        self._thread = threading.Thread(target=self.run, name="edgeperc-capture", daemon=True)

    def run(self) -> None:
        """Wait beside those who read replies."""
        tick_s, waited_s, former_s = min(1.0, SCAN_LIMIT_S), 0.0, self.since_s
        while not self.over.wait(tick_s):
            waited_s = waited_s + tick_s if self.since_s == former_s else 0.0
            former_s = self.since_s
            if former_s is not None and waited_s > SCAN_LIMIT_S:
                self.expired = True
                self._process.kill()
                return

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self._thread.join()


def _replies(
    process: subprocess.Popen[bytes], replies: IO[bytes], path: Path, watch: Watch, found: list[Any]
) -> Iterator[TimedScan]:
    n_scans, ready, made_in = 0, False, os.getpid()
    times_s: Floats | None = None
    while True:
        if os.getpid() != made_in:  # scans would be missing there
            raise PointsError(f"{path} is read by process {made_in}; read it anew in its fork")
        watch.since_s = time.monotonic()
        header = replies.read(HEADER.size)
        if len(header) < HEADER.size:
            break
        kind, stamp, stamp_ns, n_bytes = HEADER.unpack(header)
        known = kind in (ALIVE, END, ERROR, FOUND, MISSING, READY, SCAN, TIMES, WARNING)
        if not known or not 0 <= n_bytes <= (MAX_SCAN_BYTES if kind in (SCAN, TIMES) else _MOST_TEXT_BYTES):
            break
        if kind == TIMES and n_bytes % 8 == 0:
            times_s = np.empty(n_bytes // 8, "<f8")
            if n_bytes and _fill(replies, times_s) < n_bytes:
                break
            continue
        if kind == SCAN and n_bytes % 16 == 0:
            points: Points = np.empty((n_bytes // 16, 4), "<f4")
            if n_bytes and _fill(replies, points) < n_bytes:
                break
            if times_s is not None and len(times_s) != len(points):
                break
            n_scans += 1
            watch.since_s = None
            stamp_s = stamp if stamp_ns < 0 else Stamp(stamp, stamp_ns)
            yield TimedScan(None if np.isnan(stamp) else stamp_s, points, times_s)
            times_s = None
            continue
        text = replies.read(n_bytes)
        if len(text) < n_bytes:
            break
        if kind == END:
            return
        if kind == ERROR:
            raise PointsError(text.decode("utf-8", "replace"))
        if kind in (FOUND, MISSING):
            try:
                content = json.loads(text)
            except (RecursionError, ValueError):
                break
            if kind == MISSING:
                raise MissingExtraError(*content)
            found.append(content)
            return
        if kind == WARNING:
            warnings.warn(text.decode("utf-8", "replace"), UserWarning, stacklevel=2)
        ready = ready or kind == READY
    # Broken off. A process that still runs has replied nonsense, so its memory is damaged.
    try:
        code = process.wait(1.0)
    except subprocess.TimeoutExpired:
        code = 0
    after = f"after {many(n_scans, 'scan')} " if n_scans else ""
    if watch.expired:
        raise PointsError(f"{path}: {after}decoding a scan took longer than {SCAN_LIMIT_S:g} s; the capture is damaged")
    if not ready:
        raise PointsError(f"{path}: the process that decodes captures did not start ({_ending(code)})")
    raise PointsError(
        f"{path}: {after}the library that decodes the capture failed ({_ending(code)}); the capture is damaged, or "
        f"decoding it takes more than {MAX_BYTES:,} bytes of memory"
    )


def _fill(replies: Any, values: NDArray[Any]) -> int:
    """Read into an array; fewer bytes than it has if the process ends."""
    n_bytes: int = replies.readinto(values.data.cast("B"))
    return n_bytes


def _ending(code: int) -> str:
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"exit code {code & 0xFFFFFFFF:#x}" if code < -64 or code > 255 else f"exit code {code}"
