"""Captures that could end the process or fill the memory: they give scans and then `PointsError`, and nothing else."""

from __future__ import annotations

import bz2
import json
import multiprocessing.spawn
import os
import random
import signal
import sqlite3
import struct
import subprocess
import sys
import tempfile
import threading
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from itertools import accumulate
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from capture_writers import check_same, mcap_channel, mcap_message, record, records_of, sized, write_pcap, write_records
from test_captures import LIDAR, POINTS, messages, read_until_error, write_bag2
from test_captures import ouster as ouster

from edgeperc.errors import PointsError
from edgeperc.readers import apart, files
from edgeperc.readers.captures import read_scans
from edgeperc.readers.files import read_points
from edgeperc.readers.inflate import inflate
from edgeperc.readers.ouster import check_metadata

READY = "import os, signal, sys, time; from edgeperc.readers.worker import *\nout = sys.stdout.buffer\n"
READY = "import sys; sys.path[:] = sys.argv[1:]\n" + READY + "out.write(HEADER.pack(READY, 0, -1, 0)); out.flush()\n"


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """The processes that decode captures, as they are started."""
    processes: list[subprocess.Popen[bytes]] = []
    real = apart.start_process

    def start(folder: str) -> subprocess.Popen[bytes]:
        processes.append(real(folder))
        return processes[-1]

    monkeypatch.setattr(apart, "start_process", start)
    return processes


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal")
def test_a_process_that_is_killed(ouster: Path, started: list[subprocess.Popen[bytes]]) -> None:
    scans = read_scans(ouster / "sphere.pcap")
    _, first = next(scans)
    assert len(first) == 64 * 256
    os.kill(started[0].pid, signal.SIGKILL)  # it waits: a scan is larger than the pipe
    with pytest.raises(PointsError, match=r"sphere\.pcap: after 1 scan .* failed \(SIGKILL\)"):
        next(scans)
    assert started[0].returncode == -signal.SIGKILL


@pytest.mark.parametrize(
    ("end", "error"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", "failed" if os.name == "nt" else r"failed \(SIGSEGV\)"),
        ("out.write(b'x' * 100)", "failed"),
        ("out.write(HEADER.pack(SCAN, 0, -1, 1 << 40))", "failed"),
        ("out.write(HEADER.pack(SCAN, 0, -1, 64) + bytes(10))", "failed"),
        ("os._exit(3)", r"failed \(exit code 3\)"),
        ("out.write(b'x' * 100); out.flush(); time.sleep(60)", "failed"),
    ],
)
def test_a_process_that_ends_or_replies_nonsense(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, started: list[subprocess.Popen[bytes]], end: str, error: str
) -> None:
    monkeypatch.setattr(apart, "START", READY + end)
    with pytest.raises(PointsError, match=error):
        next(read_scans(write_pcap(tmp_path / "any.pcap", [])))
    assert started[0].returncode is not None


def test_a_process_that_does_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apart, "START", "import sys; sys.exit(7)")
    with pytest.raises(PointsError, match=r"did not start \(exit code 7\)"):
        next(read_scans(write_pcap(tmp_path / "any.pcap", [])))


@pytest.mark.parametrize(("name", "value"), [("executable", "/usr/bin/robot"), ("executable", None), ("frozen", True)])
def test_an_application_that_embeds_python_or_is_frozen_is_not_started_again(
    ouster: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: object
) -> None:
    python = sys.executable
    monkeypatch.setattr(sys, name, value, raising=name != "frozen")
    monkeypatch.setattr(multiprocessing.spawn, "get_executable", lambda: sys.executable)
    with pytest.raises(PointsError, match=r"application, .*, is none; name one .* multiprocessing\.set_executable"):
        next(read_scans(ouster / "sphere.pcap"))
    if name == "executable":
        monkeypatch.setattr(multiprocessing.spawn, "get_executable", lambda: python)
        assert len(list(read_scans(ouster / "sphere.pcap"))) == 3


def test_a_scan_that_takes_too_long(ouster: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    watch = apart.Watch(Mock())
    watch.since_s = -1e6  # since then this process was stopped, as by Ctrl-Z
    watch.over = Mock(wait=Mock(side_effect=[*[False] * 60, True]))
    watch.run()
    assert not watch.expired
    monkeypatch.setattr(apart, "SCAN_LIMIT_S", 0.01)  # less than importing the library takes
    with pytest.raises(PointsError, match=r"took longer than 0\.01 s"):
        next(read_scans(ouster / "sphere.pcap"))


def test_the_process_ends_with_the_iterator(
    ouster: Path, started: list[subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stderr", None)  # closed, and its number would be that of the replies
    scans = read_scans(ouster / "sphere.pcap")
    next(scans)
    assert started[0].poll() is None
    assert sys.platform != "linux" or Path(f"/proc/{started[0].pid}/fd/2").readlink() == Path(os.devnull)
    scans.close()  # type: ignore[attr-defined]
    assert started[0].returncode is not None
    list(read_scans(ouster / "sphere.pcap"))
    assert started[1].returncode is not None
    next(scans := read_scans(ouster / "sphere.pcap"))
    monkeypatch.setattr(os, "getpid", lambda: 1)  # as in a child
    with pytest.raises(PointsError, match=r"sphere\.pcap is read by process \d+; read it anew in its fork"):
        next(scans)


def test_from_threads(ouster: Path) -> None:
    counts: list[int] = []
    threads = [
        threading.Thread(target=lambda: counts.append(len(list(read_scans(ouster / "sphere.pcap"))))) for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counts == [3, 3]


def test_a_program_without_a_guard(ouster: Path, tmp_path: Path) -> None:
    """The program is not run again in the other process, and files of the folder it runs in are not imported there."""
    (tmp_path / "program.py").write_text(
        "import sys, edgeperc\nprint(len([points for _, points in edgeperc.read_scans(sys.argv[1])]))\n"
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "numpy.py").write_text("raise RuntimeError")
    done = subprocess.run(
        [sys.executable, tmp_path / "program.py", ouster / "sphere.pcap"], cwd=elsewhere, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (0, "3\n"), done.stderr


def datagram(payload: bytes, *, port: int = 7502, length: int | None = None, total: int | None = None) -> bytes:
    """A record of a UDP packet; lengths in its headers may be false."""
    udp = struct.pack(">HHHH", port, port, 8 + len(payload) if length is None else length, 0) + payload
    total = 20 + len(udp) if total is None else total
    ip = struct.pack(">BBHHHBBHII", 0x45, 0, total, 7, 0, 64, 17, 0, 0x7F000001, 0x7F000001) + udp
    frame = bytes(12) + b"\x08\x00" + ip
    return struct.pack("<IIII", 1000, 0, len(frame), len(frame)) + frame


BAD_PACKETS = {
    "empty": datagram(b""),
    "empty by its IP length": datagram(bytes(3000), total=28),
    "IP length past the record": datagram(bytes(100), total=9000),
    "UDP length": datagram(bytes(100), length=3000),
    "cut inside UDP": datagram(b"", length=0, total=21),
    "another size on the sensor's port": datagram(bytes(100)),
    "cut inside IP": struct.pack("<IIII", 1000, 0, 20, 20) + bytes(12) + b"\x08\x00" + bytes(6),
}


@pytest.mark.usefixtures("in_this_process")
def test_damaged_packets_of_an_ouster_are_dropped(ouster: Path, tmp_path: Path) -> None:
    """They may come anywhere, between the fragments of a good packet too; every scan is the same."""
    content = (ouster / "sphere.pcap").read_bytes()
    path = tmp_path / "damaged.pcap"
    path.with_suffix(".json").write_bytes((ouster / "sphere.json").read_bytes())
    records = records_of(content)
    for place in (len(records) // 2, 1, 0):
        records[place:place] = BAD_PACKETS.values()
    path.write_bytes(content[:24] + b"".join(records))
    with pytest.warns(UserWarning, match=f"dropped {3 * len(BAD_PACKETS)} damaged packets") as caught:
        scans = list(read_scans(path))
    assert len(caught) == 1
    check_same(scans, read_scans(ouster / "sphere.pcap"))


@pytest.mark.usefixtures("in_this_process")
def test_packets_of_others_are_no_damage(ouster: Path, tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    content = (ouster / "sphere.pcap").read_bytes()
    path = tmp_path / "shared.pcap"
    path.with_suffix(".json").write_bytes((ouster / "sphere.json").read_bytes())
    arp = struct.pack("<IIII", 1000, 0, 42, 42) + bytes(12) + b"\x08\x06" + bytes(28)
    path.write_bytes(content[:24] + arp + datagram(b"name server", port=53) + content[24:])
    assert len(list(read_scans(path))) == 3
    assert not recwarn.list


def in_fragments(packet: bytes, identification: int) -> list[bytes]:
    """The records of a datagram that was sent in three fragments."""
    frame = packet[16:]
    payload = frame[34:]
    found = []
    for at in range(0, len(payload), step := 8 * -(-len(payload) // 24)):
        part = payload[at : at + step]
        place = at // 8 | (0x2000 if at + step < len(payload) else 0)
        ip = frame[14:16] + struct.pack(">HHH", 20 + len(part), identification, place) + frame[22:34]
        found.append(packet[:8] + struct.pack("<II", 34 + len(part), 34 + len(part)) + frame[:14] + ip + part)
    return found


@pytest.mark.usefixtures("in_this_process")
def test_packets_in_fragments(ouster: Path, tmp_path: Path) -> None:
    content = (ouster / "sphere.pcap").read_bytes()
    records = [part for k, each in enumerate(records_of(content)) for part in in_fragments(each, k)]
    path = tmp_path / "fragments.pcap"
    path.with_suffix(".json").write_bytes((ouster / "sphere.json").read_bytes())
    path.write_bytes(content[:24] + b"".join(records))
    whole = [len(points) for _, points in read_scans(path)]
    assert whole == [64 * 256] * 3
    for missing in (3, 4, 5):  # the second packet's first fragment, its middle, its last
        path.write_bytes(content[:24] + b"".join(records[:missing] + records[missing + 1 :]))
        with pytest.warns(UserWarning, match=r"dropped \d damaged packets"):
            sizes = [len(points) for _, points in read_scans(path)]
        assert sizes[1:] == whole[1:]
        assert 0 < sizes[0] < whole[0]


METADATA = {
    "lidar_data_format": {
        "columns_per_frame": 1024,
        "columns_per_packet": 16,
        "pixels_per_column": 4,
        "column_window": [0, 1023],
        "pixel_shift_by_row": [0, 1, 2, -3],
    },
    "beam_intrinsics": {"beam_altitude_angles": [1.0, 2, 3, 4], "beam_azimuth_angles": [0.0] * 4},
}


@pytest.mark.parametrize(
    ("holder", "name", "value"),
    [
        ("lidar_data_format", "columns_per_packet", 0),
        ("lidar_data_format", "columns_per_packet", -16),
        ("lidar_data_format", "columns_per_packet", 1 << 40),
        ("lidar_data_format", "columns_per_packet", True),
        ("lidar_data_format", "columns_per_frame", 0),
        ("lidar_data_format", "columns_per_frame", 1e300),
        ("lidar_data_format", "columns_per_frame", "many"),
        ("lidar_data_format", "pixels_per_column", 0),
        ("lidar_data_format", "pixels_per_column", 1 << 30),
        ("lidar_data_format", "column_window", [0, 1024]),
        ("lidar_data_format", "column_window", [0]),
        ("lidar_data_format", "pixel_shift_by_row", [0, 1, 2]),
        ("lidar_data_format", "pixel_shift_by_row", [0, 1, 2, 1 << 20]),
        ("beam_intrinsics", "beam_altitude_angles", []),
        ("beam_intrinsics", "beam_altitude_angles", [1.0] * 5),
        ("beam_intrinsics", "beam_azimuth_angles", [0.0, 0.0, 0.0, float("nan")]),
        ("beam_intrinsics", "beam_azimuth_angles", "none"),
    ],
)
def test_impossible_metadata_names_the_field(holder: str, name: str, value: Any) -> None:
    check_metadata(METADATA)
    check_metadata({})
    with pytest.raises(PointsError, match=name):
        check_metadata({**METADATA, holder: {**METADATA[holder], name: value}})


@pytest.mark.usefixtures("in_this_process")
def test_metadata_that_would_end_the_process(ouster: Path, tmp_path: Path) -> None:
    path = tmp_path / "zero.pcap"
    path.write_bytes((ouster / "sphere.pcap").read_bytes())
    metadata = json.loads((ouster / "sphere.json").read_text())
    metadata["lidar_data_format"]["columns_per_packet"] = 0
    path.with_suffix(".json").write_text(json.dumps(metadata))
    scans, error = read_until_error(path)
    assert not scans
    assert "zero.json" in error
    assert "columns_per_packet" in error


def read_whole(path: Path) -> None:
    """Every scan and perhaps a `PointsError`; another error fails the test."""
    with suppress(PointsError):
        for _, points in read_scans(path):
            assert points.shape[1] == 4


def damage(content: bytes, chance: random.Random, near: int) -> bytes:
    """Change some bytes; most of them among the first ``near`` of a record, where headers are."""
    damaged = bytearray(content)
    places = [*accumulate(map(len, records_of(content)), initial=24)][:-1]
    for _ in range(chance.choice((1, 4, 30))):
        start = chance.choice(places) + chance.choice((8, 16, 16, 16))
        place = min(start + chance.randrange(near), len(damaged) - 1)
        damaged[place] = chance.choice((0, 255, chance.randrange(256)))
    return bytes(damaged)


@pytest.mark.filterwarnings("ignore:.*damaged packets:UserWarning")
@pytest.mark.parametrize("name", ["ouster/OS-0-128-U1_v2.3.0_1024x10", "velodyne/sample_velodyne_vlp16_gps"])
def test_real_captures_that_are_damaged(data_root: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    pytest.importorskip("velodyne_decoder" if name.startswith("velodyne") else "ouster.sdk.pcap")
    source = data_root("other_sensors") / name
    if source.with_name(f"{source.name}.json").is_file():
        (tmp_path / "copy.json").write_bytes(source.with_name(f"{source.name}.json").read_bytes())
    chance, content = random.Random(6), source.with_name(f"{source.name}.pcap").read_bytes()
    for _ in range(2):
        (tmp_path / "copy.pcap").write_bytes(damage(content, chance, 120))
        read_whole(tmp_path / "copy.pcap")


@pytest.mark.filterwarnings("ignore:.*damaged packets:UserWarning")
def test_packets_of_the_right_size_with_damaged_headers(ouster: Path, tmp_path: Path) -> None:
    """Packet type, frame, measurement and status are anything; the process that decodes may end, this one does not."""
    content = (ouster / "sphere.pcap").read_bytes()
    (tmp_path / "sphere.json").write_bytes((ouster / "sphere.json").read_bytes())
    chance = random.Random(8)
    for n_damaged in (1, 8, None):
        records = [bytearray(each) for each in records_of(content)]
        for each in chance.sample(records, n_damaged or len(records)):
            packet = 16 + 42
            column = packet + 32 + chance.randrange(16) * ((len(each) - packet - 64) // 16)
            for _ in range(chance.choice((1, 6))):
                place = chance.choice((packet + chance.randrange(32), column + chance.randrange(12)))
                each[place] = chance.choice((0, 255, chance.randrange(256)))
        (tmp_path / "sphere.pcap").write_bytes(content[:24] + b"".join(records))
        read_whole(tmp_path / "sphere.pcap")


def pack(content: bytes, method: str) -> bytes:
    if method == "lz4":
        return bytes(pytest.importorskip("lz4.frame").compress(content))
    if method == "zstd":
        return bytes(pytest.importorskip("zstandard").ZstdCompressor().compress(content))
    if method == "deflate":
        packer = zlib.compressobj(wbits=-15)
        return packer.compress(content) + packer.flush()
    return bz2.compress(content) if method == "bz2" else content


@pytest.mark.parametrize("method", ["", "deflate", "bz2", "lz4", "zstd"])
def test_inflating_stops_at_the_limit(method: str) -> None:
    content = random.Random(1).randbytes(5000) + bytes(3_000_000)
    packed = pack(content, method)
    assert inflate(packed, method, len(content)) == content
    with pytest.raises(PointsError, match=f"more than {len(content) - 1:,}"):
        inflate(packed, method, len(content) - 1)
    if method:
        with pytest.raises(PointsError, match=r"damaged|cut short"):
            inflate(b"\xff" * 50, method, 100)
    with pytest.raises(PointsError, match="unknown compression 'rar'"):
        inflate(packed, "rar", 100)


def test_several_bz2_streams() -> None:
    assert inflate(bz2.compress(b"one") + bz2.compress(b"two"), "bz2", 6) == b"onetwo"
    with pytest.raises(PointsError, match="cut short"):
        inflate(bz2.compress(b"one")[:-5], "bz2")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2])
def test_an_npz_that_claims_less_than_it_holds(tmp_path: Path, method: int) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("points.npy", bytes(40_000_000))
    content = path.read_bytes()
    assert content.count(struct.pack("<I", 40_000_000)) == 2
    path.write_bytes(content.replace(struct.pack("<I", 40_000_000), struct.pack("<I", 160)))
    with pytest.raises(PointsError, match="unpack to more than 160"):
        read_points(path)


def test_an_npz_of_bzip2_and_one_with_a_wrong_checksum(tmp_path: Path) -> None:
    plain = tmp_path / "points.npy"
    np.save(plain, POINTS)
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2):
        path = tmp_path / "points.npz"
        with zipfile.ZipFile(path, "w", method) as archive:
            archive.write(plain, "points.npy")
        np.testing.assert_array_equal(read_points(path), POINTS)
    crc = struct.pack("<I", zlib.crc32(plain.read_bytes()))
    path.write_bytes(path.read_bytes().replace(crc, bytes(4)))
    with pytest.raises(PointsError, match="CRC-32 is wrong"):
        read_points(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        archive.write(plain, "points.npy")
    with pytest.raises(PointsError, match="another method than deflate or bzip2"):
        read_points(path)


@pytest.mark.parametrize("name", ["huge.bin", "huge.txt", "huge.pcd"])
def test_huge_files_are_refused_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    with (tmp_path / name).open("wb") as file:
        file.truncate(100 << 30)  # sparse
    monkeypatch.setattr(files.np, "fromfile", None)
    with pytest.raises(PointsError, match="107,374,182,400 bytes are too much for one scan"):
        read_points(tmp_path / name)


def chunked_mcap(
    path: Path, method: str, *, crc: bool = True, damaged: int | None = None, summary: bool = True
) -> Path:
    """MCAP with a chunk for each of three clouds; one may have a changed byte behind its checksum."""
    store, sent = messages(pytest.importorskip("rosbags.typesys"), 2)
    kind = "sensor_msgs/msg/PointCloud2"
    definition = store.generate_msgdef(kind, ros_version=2)[0].encode()
    meta, content = mcap_channel(1, LIDAR, kind, definition=definition), b""
    clouds = [(stamp_ns, message) for topic, _, stamp_ns, message in sent if topic == LIDAR]
    for k, (stamp_ns, message) in enumerate(clouds):
        records = meta if k == 0 else b""
        records += mcap_message(1, k, stamp_ns, bytes(store.serialize_cdr(message, kind)))
        checksum = zlib.crc32(records) if crc else 0
        if k == damaged:
            records = records[:-9] + bytes([records[-9] ^ 1]) + records[-8:]
        packed = pack(records, method)
        head = struct.pack("<QQQI", stamp_ns, stamp_ns, len(records), checksum)
        content += record(6, head + sized(method.encode()) + struct.pack("<Q", len(packed)) + packed)
        content += record(7, struct.pack("<HI", 1, 0))  # where its messages are, which nobody needs
    return write_records(path, content, b"ros2", meta if summary else b"")


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("summary", [True, False])
@pytest.mark.parametrize("method", ["", "lz4", "zstd"])
def test_mcap_chunks(tmp_path: Path, method: str, summary: bool) -> None:
    for crc in (True, False):
        scans = list(read_scans(chunked_mcap(tmp_path / "whole.mcap", method, crc=crc, summary=summary)))
        assert [stamp for stamp, _ in scans] == pytest.approx([100.5, 101.5, 202.0])
        for k, (_, points) in enumerate(scans):
            np.testing.assert_array_equal(points, POINTS + np.float32(k))
    scans, error = read_until_error(chunked_mcap(tmp_path / "bad.mcap", method, damaged=2, summary=summary))
    assert len(scans) == 2
    assert "bad.mcap: after 2 scans a chunk is damaged: its CRC-32 is wrong" in error


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("method", ["lz4", "zstd"])
@pytest.mark.parametrize("claim", [100, 1 << 33])
def test_an_mcap_chunk_that_holds_more_than_it_says(tmp_path: Path, method: str, claim: int) -> None:
    path = chunked_mcap(tmp_path / "bomb.mcap", method)
    content = path.read_bytes()
    packed = pack(bytes(10_000_000), method)
    chunk = struct.pack("<QQQI", 1, 1, claim, 0) + sized(method.encode()) + struct.pack("<Q", len(packed)) + packed
    end = content.index(record(15, bytes(4)))
    content = content[:end] + record(6, chunk) + content[end:]
    (place,) = struct.unpack_from("<Q", content, len(content) - 28)
    path.write_bytes(content[:-28] + struct.pack("<Q", place + len(record(6, chunk))) + content[-20:])
    scans, error = read_until_error(path)
    assert len(scans) == 3
    assert "unpack to" in error


def compressed_bag(folder: Path, mode: str) -> Path:
    """The bag of `write_bag2` with its messages or its file compressed."""
    zstandard = pytest.importorskip("zstandard")
    write_bag2(folder)
    (database,) = folder.glob("*.db3")
    text = (folder / "metadata.yaml").read_text()
    for name, value in (("compression_format", "zstd"), ("compression_mode", mode)):
        text = "".join(
            f"  {name}: {value}\n" if line.strip().startswith(f"{name}:") else line for line in text.splitlines(True)
        )
    if mode == "file":
        text = text.replace(database.name, f"{database.name}.zstd")
        packed = zstandard.ZstdCompressor().compress(database.read_bytes())
        database.with_name(f"{database.name}.zstd").write_bytes(packed)
        database.unlink()
    else:
        connection = sqlite3.connect(database)
        for number, data in connection.execute("SELECT id, data FROM messages").fetchall():
            packed = zstandard.ZstdCompressor().compress(data)
            connection.execute("UPDATE messages SET data = ? WHERE id = ?", (packed, number))
        connection.commit()
        connection.close()
    (folder / "metadata.yaml").write_text(text)
    return folder


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("mode", ["message", "file"])
def test_a_bag_of_ros_2_that_is_compressed(tmp_path: Path, mode: str) -> None:
    scans = list(read_scans(compressed_bag(tmp_path / "bag", mode)))
    assert len(scans) == 3
    np.testing.assert_array_equal(scans[0][1], POINTS)


def zstd_zeros(n: int) -> bytes:
    packer = pytest.importorskip("zstandard").ZstdCompressor().compressobj()
    return b"".join(packer.compress(bytes(1 << 24)) for _ in range(n >> 24)) + packer.flush()


# A frame of one block, whose header says 8 GiB.
ZSTD_CLAIM = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 8 << 30) + b"\x03\0\0\0"


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("bomb", ["zeros", "claim"])
def test_messages_of_a_bag_stop_at_the_limit(tmp_path: Path, bomb: str) -> None:
    folder = compressed_bag(tmp_path / "bag", "message")
    (database,) = folder.glob("*.db3")
    packed = ZSTD_CLAIM if bomb == "claim" else zstd_zeros(1 << 28)
    connection = sqlite3.connect(database)
    (last,) = connection.execute("SELECT max(timestamp) FROM messages WHERE topic_id = 1").fetchone()
    connection.execute("UPDATE messages SET data = ? WHERE timestamp = ?", (packed, last))
    connection.commit()
    connection.close()
    scans, error = read_until_error(folder)
    assert len(scans) == 2
    assert ("unpack to more than 67,108,864" if bomb == "zeros" else "damaged") in error


@pytest.mark.usefixtures("in_this_process")
def test_files_of_a_bag_stop_at_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No more reaches the disk, and the temporary folder is deleted."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    folder = compressed_bag(tmp_path / "bag", "file")
    (file,) = folder.glob("*.zstd")
    file.write_bytes(zstd_zeros(1 << 30))
    scans, error = read_until_error(folder)
    assert not scans
    assert "compressed bytes unpack to more than 67,108,864, which is not done" in error
    assert not [*(tmp_path / "temporary").iterdir()]
    file.write_bytes(file.read_bytes()[:-9])
    assert "unpack to more" in read_until_error(folder)[1]
    file.write_bytes(b"no zstd")
    assert "the zstd data is damaged" in read_until_error(folder)[1]


def test_a_chunk_stops_at_a_ratio() -> None:
    """Whatever it claims: 100 times its size, and at least 64 MiB."""
    packed = zstd_zeros(1 << 27)
    assert len(packed) < 100_000
    with pytest.raises(PointsError, match="unpack to more than 67,108,864"):
        inflate(packed, "zstd", 1 << 30)


# Appended to the program of the process: what decoding does instead.
ALLOCATES = """
import numpy as np
from edgeperc.readers import decoders, worker
def scans(*_):
    yield None, np.zeros((1, 4), "f4"), None
    yield None, np.zeros((1 << 28, 4), "f4"), None
decoders._packet_scans = scans
worker.main()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux limits the memory of a process")
def test_decoding_that_takes_more_memory_than_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apart, "START", "import sys; sys.path[:] = sys.argv[1:]" + ALLOCATES)
    scans, error = read_until_error(write_pcap(tmp_path / "any.pcap", []))
    assert len(scans) == 1
    assert "after 1 scan decoding the capture takes more than 2,147,483,648 bytes of memory" in error


def test_a_scan_that_is_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = ALLOCATES.replace("1 << 28", "(1 << 24) + 1")
    monkeypatch.setattr(apart, "START", "import sys; sys.path[:] = sys.argv[1:]" + program)
    scans, error = read_until_error(write_pcap(tmp_path / "any.pcap", []))
    assert len(scans) == 1
    assert "a scan of 16,777,217 points is too large; expected at most 16,777,216" in error


def test_too_little_memory_for_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    POINTS.tofile(tmp_path / "a.bin")
    for name in ("fromfile", "abs"):
        with monkeypatch.context() as patch:
            patch.setattr(files.np, name, Mock(side_effect=MemoryError))
            with pytest.raises(PointsError, match=r"a\.bin: .*(cannot be read|more memory than there is)"):
                read_points(tmp_path / "a.bin")
