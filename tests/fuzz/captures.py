"""Captures: damaged ones through `edgeperc.read_scans`.

The process that decodes captures is forked from this one, where the libraries are loaded already; otherwise it runs
what the product runs, `edgeperc.readers.worker.main` with its limits, and `edgeperc.readers.apart` reads its replies.
Every 1000th case starts the process as the product does. If that process dies, the answer is a `PointsError`, which is
allowed; such deaths are counted by signal.
"""

from __future__ import annotations

import gc
import json
import os
import re
import resource
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import traceback
import zlib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, NoReturn
from unittest import mock

import numpy as np
import test_pcap as pcap_tests
from capture_writers import records_of

from edgeperc.errors import PointsError
from edgeperc.readers import apart, worker
from edgeperc.readers.captures import read_scans
from edgeperc.readers.decoders import decode

from .mutate import mutated_bytes, mutated_json
from .running import Case, check, peak_mb, reset_peak
from .seeds import Seed, data_root, real_seeds, synthetic_seeds

LIMIT_S, LIMIT_MB = 65.0, 2700.0  # 60 s and 2 GiB of data for the process that decodes
END_TO_END_EVERY = 1000
# In place of 60 s. Some damaged .osf files never end in the library; the others take 4 ms.
FORKED_LIMIT_S, OSF_LIMIT_S = 0.2, 0.05
MOST_SCANS = 20
CAPTURES_OF_A_FORK = 50
REAL_SHARE = 0.1

LIBRARIES = (
    "ouster.sdk.core", "ouster.sdk.osf", "velodyne_decoder", "lz4.frame", "zstandard", "sqlite3",
    "multiprocessing.pool",
)  # fmt: skip


class Server:
    """A process forked from this one, which runs `edgeperc.readers.worker.main` for up to 50 captures.

    A fork takes as long as decoding a small capture.
    """

    def __init__(self) -> None:
        self.socket, theirs = socket.socketpair()
        self.n_captures = 0
        self.pid = os.fork()
        if self.pid == 0:
            self.socket.close()
            _serve(theirs)
        theirs.close()

    def end(self) -> tuple[int, float]:
        """Wait for its end; its exit code and highest memory [MB]."""
        self.socket.close()
        _, status, usage = os.wait4(self.pid, 0)
        return os.waitstatus_to_exitcode(status), usage.ru_maxrss / 1e3


class Forked:
    """Decodes one capture, and can be used as a `subprocess.Popen`."""

    server: ClassVar[Server | None] = None

    def __init__(self, folder: str) -> None:
        if Forked.server is None:
            Forked.server = Server()
        self.process, self.lock = Forked.server, threading.Lock()
        requests, self_in = os.pipe()
        self_out, replies = os.pipe()
        self.returncode: int | None = None
        self.peak_mb = 0.0
        socket.send_fds(self.process.socket, [folder.encode()], [requests, replies])
        os.close(requests)
        os.close(replies)
        self.stdin, self.stdout = os.fdopen(self_in, "wb"), os.fdopen(self_out, "rb")

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_: object) -> None:
        self.stdout.close()
        if not self.stdin.closed:
            self.stdin.close()
        self.wait()

    def kill(self) -> None:
        """Kill the process, unless it is about to be done with the capture."""
        self._look(0.01)
        if self.returncode is None:
            os.kill(self.process.pid, signal.SIGKILL)

    def poll(self) -> int | None:
        self._look(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        self._look(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired("worker", timeout or 0.0)
        return self.returncode

    def _look(self, timeout: float | None) -> None:
        """See whether the process has reported the end of the capture, or has ended itself."""
        with self.lock:
            if self.returncode is not None or not select.select([self.process.socket], [], [], timeout)[0]:
                return
            try:
                report = self.process.socket.recv(100)
            except ConnectionResetError:  # it was killed before it read the request
                report = b""
            self.process.n_captures += 1
            if report:
                self.returncode, self.peak_mb = 0, float(report)
            if not report or self.process.n_captures == CAPTURES_OF_A_FORK:
                code, peak = self.process.end()
                Forked.server = None
                if not report:
                    self.returncode, self.peak_mb = code, peak


def _serve(parent: socket.socket) -> NoReturn:
    """Decode captures until nobody asks any more."""
    code = 1
    try:
        os.setsid()
        quiet = os.open(os.devnull, os.O_RDWR)
        os.dup2(quiet, 2)
        while True:
            folder, descriptors, _, _ = socket.recv_fds(parent, 4096, 2)
            if not folder:
                os._exit(0)
            reset_peak()
            for source, target in zip(descriptors, (0, 1), strict=True):
                os.dup2(source, target)
                os.close(source)
            sys.stdin = os.fdopen(0, closefd=False)
            os.environ.update(dict.fromkeys(("TMPDIR", "TEMP", "TMP"), folder.decode()))
            tempfile.tempdir = None
            worker.main()
            for target in (0, 1):
                os.dup2(quiet, target)
            parent.send(str(peak_mb()).encode())
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


class Captures:
    """The kind ``captures``."""

    name, limit_s, limit_mb = "captures", LIMIT_S, LIMIT_MB

    def __init__(self) -> None:
        for library in LIBRARIES:
            import_module(library)
        with tempfile.TemporaryDirectory() as folder:
            self.seeds = synthetic_seeds(Path(folder))
            for seed in self.seeds:  # compiles the kernels, which no case should count
                if seed.kind in ("lidar", "lvx2", "ouster"):
                    alone = Path(tempfile.mkdtemp(dir=folder))
                    for name, content in seed.files.items():
                        (alone / name).write_bytes(content)
                    entry = alone / seed.entry
                    list(decode(entry, entry.suffix, None, None, lambda text: None, lambda: None))
        root = data_root()
        self.real = [] if root is None else real_seeds(root)
        self.process: Forked | None = None
        weights = {"ouster": 8, "velodyne": 3}
        self.weighted = [seed for seed in self.seeds for _ in range(weights.get(seed.kind, 1))]
        # What forked processes share is not to be copied because a collector wrote to it.
        gc.collect()
        gc.freeze()
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))

    def run(self, case: Case) -> str:
        seed = case.pick(self.real) if self.real and case.chance(REAL_SHARE) else case.pick(self.weighted)
        files = DAMAGES[seed.kind](dict(seed.files), case, seed)
        for name, content in files.items():
            path = case.folder / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
            if seed not in self.real:  # of real captures, the seed and index suffice
                case.evidence[name.replace("/", "_")] = content
        end_to_end = case.index % END_TO_END_EVERY == END_TO_END_EVERY - 1
        if end_to_end:
            return f"{seed.kind}, end to end: {self.read(case, case.folder / seed.entry)}"
        limit_s = OSF_LIMIT_S if seed.kind == "osf" else FORKED_LIMIT_S
        with mock.patch.multiple(apart, start_process=self.start, SCAN_LIMIT_S=limit_s):
            answer = self.read(case, case.folder / seed.entry)
        if self.process is not None:
            check(self.process.returncode is not None, "the process that decodes is left behind")
            case.peak_mb, self.process = self.process.peak_mb, None
        return f"{seed.kind}: {answer}"

    def start(self, folder: str) -> Any:
        self.process = Forked(folder)
        return self.process

    def read(self, case: Case, path: Path) -> str:
        options: dict[str, Any] = {}
        if case.chance(0.1):
            options["topic"] = case.pick(["/lidar/points", "991", "", "\0", "x" * 1000, "/imu/text"])
        if case.chance(0.1):
            options["remission_field"] = case.pick(["reflectivity", "signal", "", "RANGE", "x"])
        n_scans = 0
        try:
            for stamp_s, points in read_scans(path, **options):
                n_scans += 1
                check_scan(stamp_s, points)
                if n_scans >= MOST_SCANS:
                    break
        except PointsError as exc:
            died = re.search(r"failed \((.*?)\)", str(exc)) or re.search(r"(took longer|did not start)", str(exc))
            if died:
                case.died.append(died[1])
                return "died"
            check(str(path) in str(exc) or path.name in str(exc), f"a message without the file's name: {exc}")
            return "PointsError" if n_scans == 0 else "scans, then PointsError"
        return "scans" if n_scans else "no scan"


def check_scan(stamp_s: Any, points: Any) -> None:
    """Raise `Failure` unless a scan is one."""
    check(stamp_s is None or (isinstance(stamp_s, float) and stamp_s == stamp_s), f"a stamp of {stamp_s!r}")
    check(isinstance(points, np.ndarray) and points.dtype == np.float32, "dtype of the points")
    check(points.ndim == 2 and points.shape[1] == 4, f"points of shape {points.shape}")


Files = dict[str, bytes]


def _pcap(content: bytes, case: Case) -> bytes:
    rng, records = case.rng, records_of(content)
    head = content[:24]
    if rng.random() < 0.1:
        head = mutated_bytes(head, case, 2)
    for _ in range(int(rng.integers(1, 8))):
        if not records:
            break
        k, way = int(rng.integers(len(records))), int(rng.integers(10))
        if way <= 4:
            # Of Ethernet, IP and UDP, then of the columns.
            near = int(case.pick([16, 60, 60, 100, 400]))
            body = mutated_bytes(records[k][16:], case, 4, near=near)
            length = len(body) if rng.random() < 0.8 else int(rng.integers(0, 70_000))
            records[k] = records[k][:8] + struct.pack("<II", length, len(body)) + body
        elif way == 5:
            records[k] = mutated_bytes(records[k], case, 2, near=16)
        elif way == 6:
            del records[k]
        elif way == 7:
            records.insert(int(rng.integers(len(records) + 1)), records[k])
        elif way == 8:
            rng.shuffle(records)  # type: ignore[arg-type]
        else:
            fragment = bytearray(records[k])
            if len(fragment) > 38:
                fragment[36:38] = struct.pack(">H", int(rng.integers(65536)))  # flags and offset
            records[k] = bytes(fragment)
    content = head + b"".join(records)
    return content[: int(rng.integers(len(content) + 1))] if rng.random() < 0.05 else content


def _of_ouster(files: Files, case: Case, seed: Seed) -> Files:
    way = case.rng.random()
    if way < 0.65 and "cap.json" in files:
        files["cap.json"] = mutated_json(json.loads(files["cap.json"]), case)
    if way > 0.55:
        files["cap.pcap"] = _pcap(files["cap.pcap"], case)
    if case.chance(0.02):
        del files["cap.json"]
    return files


def _of_velodyne(files: Files, case: Case, seed: Seed) -> Files:
    return {**files, "cap.pcap": _pcap(files["cap.pcap"], case)}


def _of_lidar(files: Files, case: Case, seed: Seed) -> Files:
    damaged = {**files, "cap.pcap": _pcap(files["cap.pcap"], case)}
    if "cap.csv" in files and case.chance(0.2):
        damaged["cap.csv"] = mutated_bytes(files["cap.csv"], case, 4)
    return damaged


def _of_pcapng(files: Files, case: Case, seed: Seed) -> Files:
    """Blocks changed, most with lengths that fit and some with the header of their packet as it was; moved, or cut."""
    content, at, blocks = files["cap.pcap"], 0, list[bytes]()
    while at < len(content):
        end = at + int.from_bytes(content[at + 4 : at + 8], "little")
        blocks.append(content[at:end])
        at = end
    for _ in range(int(case.rng.integers(1, 8))):
        k, way = int(case.rng.integers(len(blocks))), int(case.rng.integers(8))
        if way <= 3:
            first = int(case.pick([8, 8, 28]))
            kind = int.from_bytes(blocks[k][:4], "little") if case.chance(0.9) else int(case.rng.integers(8))
            body = mutated_bytes(blocks[k][first:-4], case, 4, near=case.pick([8, 20, 60]))
            blocks[k] = pcap_tests.block(kind, blocks[k][8:first] + body)
        elif way == 4:
            blocks[k] = mutated_bytes(blocks[k], case, 2, near=12)
        elif way == 5:
            blocks.insert(int(case.rng.integers(len(blocks))), blocks[k])
        elif way == 6:
            case.rng.shuffle(blocks)  # type: ignore[arg-type]
        elif len(blocks) > 1:
            del blocks[k]
    content = b"".join(blocks)
    return {**files, "cap.pcap": content[: int(case.rng.integers(len(content)))] if case.chance(0.05) else content}


def _of_osf(files: Files, case: Case, seed: Seed) -> Files:
    content = bytearray(files["cap.osf"])
    blocks, at = [], 0
    while at + 4 <= len(content):
        end = at + 4 + struct.unpack_from("<I", content, at)[0]
        blocks.append((at, end))
        at = end + 4
    for _ in range(int(case.rng.integers(1, 6))):
        start, end = case.pick(blocks)
        near = min(end, start + int(case.pick([60, 400, 4000, 1 << 20])))
        if near <= start + 4:
            continue
        place, size = int(case.rng.integers(start + 4, near)), int(case.pick([1, 1, 4, 8]))
        value = case.pick([bytes(size), b"\xff" * size, case.rng.bytes(size), b"\xff" * (size - 1) + b"\x7f"])
        content[place : min(place + size, end)] = value[: max(0, min(place + size, end) - place)]
        if case.chance(0.95):
            content[end : end + 4] = struct.pack("<I", zlib.crc32(content[start:end]))
    return {"cap.osf": bytes(content)}


def _of_bytes(files: Files, case: Case, seed: Seed) -> Files:
    name = case.pick([*files])
    return {**files, name: mutated_bytes(files[name], case, 8, near=case.pick([0, 0, 200, 4000]))}


def _of_chunks(files: Files, case: Case, seed: Seed) -> Files:
    """A chunk's records changed before they are packed, with the checksum right, wrong or absent."""
    content = files["cap.mcap"]
    if case.chance(0.4):
        return _of_bytes(files, case, seed)
    out, at = bytearray(content[:8]), 8
    while at + 9 <= len(content) - 8:
        opcode, size = struct.unpack_from("<BQ", content, at)
        body = content[at + 9 : at + 9 + size]
        at += 9 + size
        if opcode == 6:
            body = _chunk(body, case)
        elif opcode == 2:
            body = struct.pack("<QQI", 0, 0, 0)  # places have moved
        elif case.chance(0.05):
            body = mutated_bytes(body, case, 2)
        out += bytes([opcode]) + struct.pack("<Q", len(body)) + body
    return {"cap.mcap": bytes(out + content[-8:])}


def _chunk(body: bytes, case: Case) -> bytes:
    from edgeperc.readers.inflate import inflate

    times, (size, crc, length) = body[:16], struct.unpack_from("<QII", body, 16)
    method = body[32 : 32 + length]
    packed = body[32 + length + 8 :]
    records = mutated_bytes(inflate(packed, method.decode(), size), case, 3, near=case.pick([0, 100, 1000]))
    crc = case.pick([zlib.crc32(records), zlib.crc32(records), 0, crc])
    if case.chance(0.1):
        method = case.pick([b"", b"lz4", b"zstd", b"rar", b"\xff"])
    packers: dict[bytes, Callable[[bytes], bytes]] = {
        b"lz4": lambda data: bytes(import_module("lz4.frame").compress(data)),
        b"zstd": lambda data: bytes(import_module("zstandard").ZstdCompressor().compress(data)),
    }
    packed = packers.get(method, bytes)(records)
    if case.chance(0.2):
        packed = mutated_bytes(packed, case, 2)
    size = len(records) if case.chance(0.8) else int(case.pick([0, 1, 1 << 20, 1 << 33, (1 << 64) - 1]))
    head = times + struct.pack("<QII", size, crc, len(method)) + method
    return bytes(head + struct.pack("<Q", len(packed)) + packed)


def _of_bag2(files: Files, case: Case, seed: Seed) -> Files:
    name = case.pick([*files])
    if name.endswith(".yaml") and case.chance(0.7):
        lines = files[name].split(b"\n")
        k = int(case.rng.integers(len(lines)))
        key, _, _ = lines[k].partition(b":")
        lines[k] = (
            key + b": " + case.pick([b"", b"-1", b"zstd", b"[", b"{}", b"&a [*a]", b"../../etc/passwd", b"!!python"])
        )
        return {**files, name: b"\n".join(lines)}
    return {**files, name: mutated_bytes(files[name], case, 8, near=case.pick([0, 0, 100, 4000]))}


DAMAGES: dict[str, Callable[[Files, Case, Seed], Files]] = {
    "ouster": _of_ouster,
    "velodyne": _of_velodyne,
    "lidar": _of_lidar,
    "lvx2": _of_bytes,
    "pcapng": _of_pcapng,
    "osf": _of_osf,
    "bag1": _of_bytes,
    "bag2": _of_bag2,
    "mcap": _of_bytes,
    "chunked": _of_chunks,
}


def make(seed: int) -> Captures:
    return Captures()
