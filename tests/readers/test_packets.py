"""Packet captures: where the network's headers end, and who sent what."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writers import (
    LINKS,
    check_same,
    in_ip,
    join,
    pcap_head,
    pcap_record,
    records_of,
    vlp16_packets,
    write_link,
    write_pcap,
)
from lidar_writers import MODELS, blocks_of, packets_of, ranges
from test_captures import error_of
from test_captures import ouster as ouster

from edgeperc import PointsError
from edgeperc.readers import packets, ports
from edgeperc.readers.captures import read_scans, sensor_of
from edgeperc.readers.pcap import pcap_packets
from edgeperc.readers.senders import Senders

pytestmark = pytest.mark.usefixtures("in_this_process")

VLAN = bytes(12) + b"\x81\x00\x00\x05\x08\x00"
MPLS = bytes(12) + b"\x88\x47\x00\x01\x01\x40"  # in which nobody looks for a sender


@pytest.mark.parametrize(("link", "head"), [*LINKS.items(), (1, VLAN), (1, MPLS)])
def test_a_velodyne_behind_any_link(tmp_path: Path, link: int, head: bytes) -> None:
    path = write_link(tmp_path / "link.pcap", link, vlp16_packets(1.2), head)
    assert check_same(read_scans(path), read_scans(write_pcap(tmp_path / "a.pcap", vlp16_packets(1.2)))) == 2
    assert sensor_of(path).name == "vlp-16"


def payloads_of(kind: str) -> list[bytes]:
    """Packets of a sensor; those of a pandarxt-16 are of 64 columns."""
    model = MODELS["pandarxt-16"]
    return vlp16_packets(1.2) if kind == "velodyne" else packets_of(model, blocks_of(model, *ranges(model, 512)))


@pytest.mark.parametrize("most", [96, 300, 500])
@pytest.mark.parametrize("kind", ["velodyne", "hesai"])
def test_packets_that_were_not_kept_to_their_end_are_named(tmp_path: Path, kind: str, most: int) -> None:
    path = write_link(tmp_path / "a.pcap", 1, payloads_of(kind))
    records = records_of(path.read_bytes())
    cut = (each[:8] + struct.pack("<I", min(len(each) - 16, most)) + each[12 : 16 + most] for each in records)
    path.write_bytes(pcap_head() + b"".join(cut))
    assert "packets of the capture were not kept to their end" in error_of(path)
    with pytest.raises(PointsError, match="tcpdump -s 0"):
        sensor_of(path)


@pytest.mark.parametrize("kind", ["velodyne", "hesai"])
@pytest.mark.parametrize("link", [1, 113, 276])
def test_packets_that_were_captured_twice_count_once(tmp_path: Path, kind: str, link: int) -> None:
    """As from a mirrored port, or ``tcpdump -i any`` beside a bridge."""
    path = write_link(tmp_path / "once.pcap", link, payloads_of(kind))
    expected = list(read_scans(path))
    path.write_bytes(pcap_head(link) + b"".join(each + each for each in records_of(path.read_bytes())))
    check_same(read_scans(path), expected, clock=False)


def write_6(path: Path, payloads: Sequence[bytes], sender: str, most: int = 10_000) -> Path:
    """UDP in IPv6 in fragments of at most so many bytes."""
    content = pcap_head()
    addresses = socket.inet_pton(socket.AF_INET6, sender) + socket.inet_pton(socket.AF_INET6, "ff02::1")
    for k, payload in enumerate(payloads):
        udp = struct.pack(">HHHH", 2368, 2368, 8 + len(payload), 0) + payload
        for begin in range(0, len(udp), most):
            part, more = udp[begin : begin + most], begin + most < len(udp)
            kind = 17
            if begin or more:
                kind, part = 44, struct.pack(">BBHI", 17, 0, begin | more, k) + part
            frame = bytes(12) + b"\x86\xdd" + struct.pack(">IHBB", 6 << 28, len(part), kind, 64) + addresses + part
            content += pcap_record(k, frame)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("kind", ["velodyne", "hesai"])
@pytest.mark.parametrize("most", [10_000, 600, 64])
def test_packets_of_ipv6(tmp_path: Path, kind: str, most: int) -> None:
    expected = list(read_scans(write_link(tmp_path / "4.pcap", 1, payloads_of(kind))))
    one = write_6(tmp_path / "6.pcap", payloads_of(kind), "fe80::1", most)
    two = join(tmp_path / "two.pcap", [one, write_6(tmp_path / "b.pcap", payloads_of(kind), "fe80::2", most)])
    assert "there are fe80::1, fe80::2; choose one" in error_of(two)
    assert sensor_of(one) == sensor_of(tmp_path / "4.pcap")
    for path, topic in ((one, None), (two, "fe80::2")):
        check_same(read_scans(path, topic=topic), expected, clock=False)


@pytest.mark.parametrize(
    ("link", "head", "first", "behind"),
    [(1, LINKS[1], 800, b""), (1, VLAN, 1208, b""), (113, LINKS[113], 16, b""), (1, LINKS[1], 0, b"\1\2\3\4"),
     (1, LINKS[1], 600, bytes(18))],
)  # fmt: skip
def test_a_velodyne_in_fragments_or_with_bytes_behind(
    tmp_path: Path, link: int, head: bytes, first: int, behind: bytes
) -> None:
    """A narrow link divides packets after so many bytes; some cards capture the checksum of a frame, or padding."""
    packets = vlp16_packets(1.2)
    content = pcap_head(link)
    for k, payload in enumerate(packets):
        ip, udp = in_ip(payload, k)[:20], in_ip(payload, k)[20:]
        for start, end in ((0, first), (first, len(udp))) if first else ((0, len(udp)),):
            place = start // 8 | (0x2000 if end < len(udp) else 0)
            part = ip[:2] + struct.pack(">HHH", 20 + end - start, k, place) + ip[8:] + udp[start:end]
            content += pcap_record(k, head + part + behind)
    path = tmp_path / "other.pcap"
    path.write_bytes(content)
    assert check_same(read_scans(path), read_scans(write_link(tmp_path / "whole.pcap", 1, packets))) == 2
    assert Senders(path, lambda: None).velodynes == ["192.168.1.201"]


@pytest.mark.parametrize("link", [113, 276, 101])
def test_an_ouster_behind_any_link(ouster: Path, tmp_path: Path, link: int) -> None:
    records = records_of((ouster / "sphere.pcap").read_bytes())
    path = tmp_path / "link.pcap"
    path.write_bytes(pcap_head(link) + b"".join(pcap_record(0, LINKS[link] + each[30:]) for each in records))
    path.with_suffix(".json").write_text((ouster / "sphere.json").read_text())
    check_same(read_scans(path), read_scans(ouster / "sphere.pcap"), clock=False)


@pytest.mark.parametrize(
    "senders",
    [
        ("10.0.0.1", "10.0.0.2"),
        ("10.0.0.9", "10.0.0.10", "192.168.1.201"),
        ("10.0.0.1:2368", "10.0.0.1:2369"),
        ("10.0.0.1:2368", "10.0.0.1:8308", "10.0.0.2"),
    ],
)
@pytest.mark.parametrize("link", [1, 113])
def test_several_velodynes_are_told_apart(tmp_path: Path, link: int, senders: tuple[str, ...]) -> None:
    packets = vlp16_packets(1.2)
    path = write_link(tmp_path / "two.pcap", link, packets, **{f"sender_{k}": s for k, s in enumerate(senders)})
    assert Senders(path, lambda: None).velodynes == sorted(senders)
    expected = [len(points) for _, points in read_scans(write_pcap(tmp_path / "one.pcap", packets))]
    error = error_of(path)
    assert f"expected one LiDAR, there are {', '.join(sorted(senders))}; choose one" in error
    for sender in senders:
        assert [len(points) for _, points in read_scans(path, topic=sender)] == expected
    assert "no LiDAR '10.1.1.1'" in error_of(path, topic="10.1.1.1")


@pytest.mark.parametrize(("link", "other"), [(1, "10.0.0.2"), (113, "10.0.0.1:2369"), (101, "10.0.0.2")])
def test_a_velodyne_that_begins_late_is_told_apart(tmp_path: Path, link: int, other: str) -> None:
    packets = vlp16_packets(30.0)
    path = write_link(tmp_path / "two.pcap", link, packets, begin=2100, one="10.0.0.1:2368", two=other)
    first, second = Senders(path, lambda: None).velodynes
    assert "expected one LiDAR, there are 10.0.0.1" in error_of(path)
    expected = [len(points) for _, points in read_scans(write_pcap(tmp_path / "one.pcap", packets))]
    assert [len(points) for _, points in read_scans(path, topic=first)] == expected
    assert sum(len(points) for _, points in read_scans(path, topic=second)) == (len(packets) - 2100) * 12 * 32
    assert sensor_of(path, topic=second) == sensor_of(path, topic=first)


def test_a_few_damaged_addresses_are_no_sensors(tmp_path: Path) -> None:
    path = write_link(tmp_path / "a.pcap", 1, vlp16_packets(30.0), begin=2200, one="10.0.0.1", two="74.0.0.1")
    assert Senders(path, lambda: None).velodynes == ["10.0.0.1"]


@pytest.mark.parametrize("name", ["velodyne", "pandarxt-32"])
def test_a_capture_is_counted_once(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever a topic is: before the first scan, packets are read once, but for the first ones."""
    if name == "velodyne":
        payloads = vlp16_packets(4.0) * 4
    else:
        payloads = packets_of(MODELS[name], blocks_of(MODELS[name], *ranges(MODELS[name], 1800))) * 5
    path = write_link(tmp_path / "two.pcap", 1, payloads, one="10.0.0.1", two="10.0.0.2")
    n_read = 0

    def counted(*arguments: Any, **options: Any) -> Iterator[Any]:
        nonlocal n_read
        for packet in pcap_packets(*arguments, **options):
            n_read += 1
            yield packet

    monkeypatch.setattr(packets, "pcap_packets", counted)
    monkeypatch.setattr(packets, "SNIFFED_PACKETS", 50)
    n, n_first = 2 * len(payloads), 1100  # what shows the model, and is in the first turn
    scans = read_scans(path, topic="10.0.0.2")
    next(scans)
    assert n < n_read < n + n_first
    assert len(list(scans)) > 3
    assert n_read < 2 * n + n_first


@pytest.mark.parametrize("begin_us", [0, 3_599_700_000], ids=["hour", "turn of the hour"])
@pytest.mark.parametrize("shift", [1, 3, 20])
def test_packets_that_overtake_one_another_split_no_scan(tmp_path: Path, begin_us: int, shift: int) -> None:
    content = [bytearray(packet) for packet in vlp16_packets(4.0)]
    for packet in content:
        (time_us,) = struct.unpack_from("<I", packet, 1200)
        struct.pack_into("<I", packet, 1200, (time_us - 1_000_000 + begin_us) % 3_600_000_000)
    ordered = [bytes(packet) for packet in content]
    expected = list(read_scans(write_pcap(tmp_path / "ordered.pcap", ordered)))
    late = ordered.copy()
    for k in range(5, len(late) - shift, 41):
        late.insert(k + shift, late.pop(k))
    check_same(read_scans(write_pcap(tmp_path / "late.pcap", late)), expected, clock=False)


def test_packets_behind_a_step_of_the_clock_stay_behind() -> None:
    times_us = [*range(0, 30_000, 1000), *range(3_000_000, 3_030_000, 1000), *range(500_000, 530_000, 1000)]
    payloads = [b"\xff\xee" + bytes(1198) + struct.pack("<I", time_us) + b"\x37\x22" for time_us in times_us]
    sent = [packets.Datagram("10.0.0.1", 2368, 1.0 + k, memoryview(each)) for k, each in enumerate(payloads)]
    assert list(packets.in_order(sent)) == sent
    gps = packets.Datagram("10.0.0.1", 8308, 0.5, memoryview(bytes(512)))
    assert sorted(packets.in_order([*sent[:3], gps]), key=lambda each: each.stamp_s) == [gps, *sent[:3]]


def test_neither_another_sensor_nor_what_is_none_disturbs(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A Velodyne that begins later at the port; packets of other programs after a silence; packets that come twice."""
    monkeypatch.setattr(ports, "FIRST_S", 0.0)
    own, other = ([ports.Datagram(f"{m}", 1, 0.0, memoryview(b)) for b in vlp16_packets(4.0, m)] for m in (8, 9))
    junk = own[0]._replace(payload=memoryview(bytes(700)))
    came = chain(*zip(own, own, other, strict=True), [None, junk, junk, None], own, [None])
    monkeypatch.setattr(ports.listen(source), "take", lambda _: next(came))
    with pytest.warns(UserWarning, match="no scans for now, and edgeperc waits: no points of a LiDAR that is") as said:
        away = [np.linalg.norm(points[:, :3], axis=1).round() for _, points in islice(read_scans(source), 4)]
    assert (len(said), [(len(each), each.max()) for each in away]) == (1, [(28_800, 8.0)] * 4)
