"""Files of captured packets: pcapng gives the packets and times of pcap, and damage is said."""

from __future__ import annotations

import io
import shutil
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from capture_writers import check_same, records_of, vlp16_packets, write_link
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_captures import error_of, read_until_error
from test_captures import ouster as ouster

from edgeperc.errors import PointsError
from edgeperc.readers.captures import read_scans, read_timed_scans, scan_files, sensor_of
from edgeperc.readers.packets import Datagrams
from edgeperc.readers.pcap import Captured, pcap_packets

pytestmark = pytest.mark.usefixtures("in_this_process")

INTERFACE, OLD, SIMPLE, ENHANCED = 1, 2, 3, 6
UNKNOWN = 0x0BAD
Packet = tuple[int, int, int, bytes]  # link, seconds, microseconds, bytes


def block(kind: int, body: bytes, order: str = "<", counted: bool = True) -> bytes:
    """A block; ``counted``: its length has the bytes that it is padded with."""
    padding = bytes(-len(body) % 4)
    length = struct.pack(f"{order}I", 12 + len(body) + len(padding) * counted)
    return struct.pack(f"{order}I", kind) + length + body + padding + length


def section(order: str = "<") -> bytes:
    return block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1), order)


def option(code: int, value: bytes, order: str = "<") -> bytes:
    return struct.pack(f"{order}HH", code, len(value)) + value + bytes(-len(value) % 4)


def interface(link: int, order: str = "<", options: bytes = b"", most: int = 0) -> bytes:
    return block(INTERFACE, struct.pack(f"{order}HHI", link, 0, most) + options, order)


def packet_block(
    ticks: int, data: bytes, order: str = "<", kind: int = ENHANCED, number: int = 0, counted: bool = True
) -> bytes:
    head = struct.pack(f"{order}I" if kind == ENHANCED else f"{order}HH", *[number, 517][: 1 + (kind == OLD)])
    sizes = struct.pack(f"{order}4I", ticks >> 32, ticks & 0xFFFFFFFF, len(data), len(data) + 5)
    comment = option(1, b"seen", order) if counted else b""
    return block(kind, head + sizes + data + bytes(-len(data) % 4) * counted + comment, order, counted)


def packets_in(content: bytes) -> list[Packet]:
    """The packets of a pcap file with microseconds."""
    (link,) = struct.unpack_from("<I", content, 20)
    return [(link, *struct.unpack_from("<II", each), each[16:]) for each in records_of(content)]


def as_pcapng(
    packets: Sequence[Packet], order: str = "<", resolution: int | None = None, offset_s: int = 0, kind: int = ENHANCED
) -> bytes:
    """Packets of pcap files in one section, an interface for each link type, with blocks between that are not read."""
    per_s = 10**6 if resolution is None else (2 ** (resolution & 127) if resolution & 128 else 10**resolution)
    options = option(2, b"eth0", order)
    options += b"" if resolution is None else option(9, bytes([resolution]), order)
    options += option(14, struct.pack(f"{order}q", offset_s), order) if offset_s else b""
    links = sorted({packet[0] for packet in packets})
    content = section(order) + b"".join(interface(link, order, options + option(0, b"", order)) for link in links)
    for k, (link, seconds, micros, data) in enumerate(packets):
        ticks = (seconds - offset_s) * per_s + (micros * per_s + 500_000) // 10**6
        content += block(UNKNOWN, bytes(k % 7), order) if k % 3 == 0 else b""
        content += packet_block(ticks, data, order, kind, links.index(link))
    return content


def read(content: bytes, path: Path, whole: bool = True) -> list[tuple[int, float, bytes]]:
    path.write_bytes(content)
    return [(link, stamp_s, bytes(data)) for link, stamp_s, data in pcap_packets(path, whole)]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_link(tmp_path / "cap.pcap", 1, vlp16_packets(1.2))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", [ENHANCED, OLD])
@pytest.mark.parametrize(("resolution", "offset_s"), [(None, 0), (6, 990), (9, 0), (9, -(10**9)), (12, 3), (16, 0)])
def test_packets_and_times_are_those_of_the_pcap(
    capture: Path, order: str, kind: int, resolution: int | None, offset_s: int
) -> None:
    expected = read(capture.read_bytes(), capture)
    assert expected[1][1] == 1000.001
    content = as_pcapng(packets_in(capture.read_bytes()), order, resolution, offset_s, kind)
    assert read(content, capture.with_suffix(".pcapng")) == expected


@pytest.mark.parametrize("power", [10, 20, 32, 53])
def test_a_resolution_of_a_power_of_two(capture: Path, power: int) -> None:
    expected = read(capture.read_bytes(), capture)
    found = read(as_pcapng(packets_in(capture.read_bytes()), resolution=0x80 | power), capture.with_suffix(".pcapng"))
    assert [each[::2] for each in found] == [each[::2] for each in expected]
    stamps, others = (np.array([stamp_s for _, stamp_s, _ in each]) for each in (found, expected))
    assert np.abs(stamps - others).max() <= 2.0 ** -(power + 1) + 1e-12


@pytest.mark.parametrize("links", [(1, 113), (101, 1, 276), (1, 113, 276, 0, 108, 12, 14, 228)])
@pytest.mark.parametrize("order", ["<", ">"])
def test_several_interfaces_and_sections(tmp_path: Path, links: Sequence[int], order: str) -> None:
    """Each packet is behind the header of its own interface; the second section is in the other byte order."""
    payloads = vlp16_packets(0.3)
    files = [write_link(tmp_path / f"{link}.pcap", link, payloads) for link in links]
    of_files = [packets_in(file.read_bytes()) for file in files]
    mixed = [of_files[k % len(links)][k] for k in range(len(payloads))]
    other = as_pcapng(of_files[-1], "<" if order == ">" else ">", 9)
    path = tmp_path / "two.pcapng"
    path.write_bytes(as_pcapng(mixed, order) + other)
    expected = [*Datagrams(write_link(tmp_path / "one.pcap", 1, payloads), lambda: None)]
    assert [*Datagrams(path, lambda: None)] == expected * 2
    assert len(expected) == len(payloads)


@pytest.mark.parametrize(("most", "length"), [(0, 40), (0, 41), (64, 64), (30, 100), (100, 99)])
@pytest.mark.parametrize("order", ["<", ">"])
def test_simple_packets_have_no_time(tmp_path: Path, most: int, length: int, order: str) -> None:
    data = bytes(range(length))
    kept = data[: most or length]
    content = section(order) + interface(1, order, most=most)
    content += 3 * block(SIMPLE, struct.pack(f"{order}I", length) + kept, order)
    assert read(content, tmp_path / "simple.pcapng") == [(1, 0.0, kept)] * 3


def test_a_writer_that_does_not_count_what_it_pads(tmp_path: Path) -> None:
    content = section() + interface(1)
    for length in (60, 61, 62, 63):
        content += packet_block(length * 10**6, b"\1" * length, counted=False)
    found = read(content, tmp_path / "odd.pcapng")
    assert found == [(1, float(length), b"\1" * length) for length in (60, 61, 62, 63)]


@pytest.mark.parametrize(
    ("options", "stamp_s"),
    [
        (option(9, b""), 2.5),  # none of the two options has its size
        (option(14, b"\1\2\3\4"), 2.5),
        (option(0, b"") + option(9, b"\x09"), 2.5),  # behind the end
        (struct.pack("<HH", 9, 60_000) + b"\x09\0\0\0", 2.5),
        (option(9, b"\xff") + option(14, struct.pack("<q", 7)), 7.0),  # 2**-127 s
        (option(9, b"\x7f") + option(14, struct.pack("<q", -(2**63))), -(2.0**63)),
    ],
)
def test_odd_options_of_an_interface(tmp_path: Path, options: bytes, stamp_s: float) -> None:
    content = section() + interface(1, options=options) + packet_block(2_500_000, b"abcd")
    assert read(content, tmp_path / "odd.pcapng") == [(1, stamp_s, b"abcd")]


START = section() + interface(1) + packet_block(1, b"abcd")
SAID = "all packets before it were read"


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (START[:-1], f"the file ends inside packet 1, at byte {len(START) - 1}"),
        (START + section()[:11], f"the file ends inside packet 2, at byte {len(START) + 11}"),
        (START + bytes(40), "the two lengths of a block differ"),  # the rest of a disk's block
        (START + struct.pack("<II", UNKNOWN, 0xFFFFFFFF) + bytes(90), "the file ends inside packet 2"),
        (START + struct.pack("<II", UNKNOWN, 4) + bytes(90), "the two lengths of a block differ"),
        (START + block(UNKNOWN, bytes(8))[:-4] + b"\x18\0\0\0", "the two lengths of a block differ"),
        (START + packet_block(1, b"abcd", number=1), f"no interface is described for packet 2, at byte {len(START)}"),
        (START + section() + packet_block(1, b"abcd"), "no interface is described for packet 2"),
        (section() + block(SIMPLE, bytes(8)), "no interface is described for packet 1"),
        (START + block(ENHANCED, bytes(16)), "a block is too short for packet 2"),
        (START + block(OLD, bytes(16)), "a block is too short for packet 2"),
        (START + block(SIMPLE, b""), "a block is too short for packet 2"),
        (START + block(ENHANCED, struct.pack("<5I", 0, 0, 0, 0xFFFFFFFF, 9) + b"abcd"), "too short for packet 2"),
        (START + block(INTERFACE, bytes(4)), "a block is too short for an interface"),
        (START + block(0x0A0D0D0A, bytes(16)), "does not say its byte order, in front of packet 2"),
        (b"\n\r\r\n" + bytes(40), "does not say its byte order, in front of packet 1"),
    ],
)
def test_damage_is_said_and_what_came_before_is_read(tmp_path: Path, content: bytes, error: str) -> None:
    path, found = tmp_path / "damaged.pcapng", list[Captured]()
    path.write_bytes(content)
    with pytest.raises(PointsError, match=error) as caught:
        found.extend(pcap_packets(path))
    assert SAID in str(caught.value)
    assert len(found) == (" 1," not in str(caught.value))
    if found:
        assert [*pcap_packets(path, whole=False)] == found
    assert error in error_of(path) or "no points of a LiDAR" in error_of(path)


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    order=st.sampled_from("<>"),
    places=st.lists(st.tuples(st.integers(0, 900), st.binary(min_size=1, max_size=8)), max_size=4),
    cut=st.integers(0, 900),
)
def test_damaged_bytes(tmp_path: Path, order: str, places: list[tuple[int, bytes]], cut: int) -> None:
    """Packets as they are in the file, or `PointsError`; a cut gives the packets before it."""
    packets = [(1, 1000, k, bytes(range(40 + k))) for k in range(8)]
    whole = as_pcapng(packets, order)
    content = bytearray(whole)
    for place, value in places:
        at = place % len(whole)
        content[at : at + len(value)] = value[: len(whole) - at]
    path, found = tmp_path / "damaged.pcapng", list[Captured]()
    path.write_bytes(content[: len(content) - cut % len(content)])
    try:
        found.extend(pcap_packets(path))
    except PointsError as exc:
        said = str(exc)
        assert "cut short" in said or "not a pcap file" in said
    for link, stamp_s, data in found:
        assert 0 <= link < 1 << 16
        assert np.isfinite(stamp_s)
        assert bytes(data) in bytes(content)
    if not places:
        assert [bytes(data) for _, _, data in found] == [data for *_, data in packets[: len(found)]]
        assert len(found) == len(packets) if cut % len(content) == 0 else len(found) < len(packets)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("link", "name"), [(1, "drive.pcapng"), (113, "drive.PCAPNG"), (101, "drive.pcap")])
def test_a_velodyne(tmp_path: Path, order: str, link: int, name: str) -> None:
    source = write_link(tmp_path / "source.pcap", link, vlp16_packets(1.2))
    (tmp_path / "new").mkdir()
    path = tmp_path / "new" / name
    path.write_bytes(as_pcapng(packets_in(source.read_bytes()), order, 9))
    assert_same(path, source)
    assert scan_files(path.parent) == [path]
    content = path.read_bytes()
    path.write_bytes(content[: int(0.95 * len(content))])
    scans, error = read_until_error(path)
    assert len(scans) == 2
    assert "cut short or damaged: the file ends inside packet" in error


def test_an_ouster(ouster: Path, tmp_path: Path) -> None:
    path = tmp_path / "sphere.pcapng"
    path.write_bytes(as_pcapng(packets_in((ouster / "sphere.pcap").read_bytes()), resolution=0x80 | 30))
    shutil.copy(ouster / "sphere.json", tmp_path)
    assert_same(path, ouster / "sphere.pcap")


def test_a_file_of_another_writer(capture: Path) -> None:
    dpkt = pytest.importorskip("dpkt.pcapng")
    stream, packets = io.BytesIO(), packets_in(capture.read_bytes())
    writer = dpkt.Writer(stream)
    for _, seconds, micros, data in packets:
        writer.writepkt(data, seconds + micros / 1e6)
    assert read(stream.getvalue(), capture.with_suffix(".pcapng")) == read(capture.read_bytes(), capture)
    ours = as_pcapng(packets, resolution=9)
    theirs = [(stamp_s, bytes(data)) for stamp_s, data in dpkt.Reader(io.BytesIO(ours))]
    assert [data for _, data in theirs] == [data for *_, data in packets]


def assert_same(path: Path, source: Path) -> None:
    """Both give the same scans, to the bit, and the same sensor."""
    expected = [*read_timed_scans(source)]
    check_same(read_timed_scans(path), expected)
    assert [len(points) for _, points in read_scans(path)] == [len(scan.points) for scan in expected]
    assert sensor_of(path) == sensor_of(source)
