"""Packets that come at ports of this computer are read as a capture of them is."""

from __future__ import annotations

import socket
import time
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from capture_writers import write_pcap
from lidar_writers import MODELS, Sender, blocks_of, calibration, difop, packets_of, ranges, unit_angles

from edgeperc import PointsError, read_timed_scans, sensor_of, stream
from edgeperc.readers import ports
from edgeperc.readers.packets import Datagrams

MODEL = MODELS["pandar40p"]


def silent() -> None:
    """No sign of life is wanted."""


def test_turns_at_a_port_are_those_of_a_capture(
    tmp_path: Path, port: int, send: Sender, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Decoded in a process of their own; the calibration has the number of the port."""
    monkeypatch.chdir(tmp_path)
    for name in ("drive", port):
        Path(f"{name}.csv").write_text(calibration(unit_angles(MODEL)))
    sent = packets_of(MODEL, blocks_of(MODEL, *ranges(MODEL, 3600)))
    of_capture = [*read_timed_scans(write_pcap(tmp_path / "drive.pcap", sent))]
    send(sent)
    assert sensor_of(f"udp:{port}") == sensor_of(tmp_path / "drive.pcap") is not None
    with closing(read_timed_scans(f"udp://127.0.0.1:{port}")) as scans:  # type: ignore[type-var]
        whole = (s.points for s in scans if any(np.array_equal(s.points, each.points) for each in of_capture))
        first, second, *_ = islice(whole, 4)
    assert not np.array_equal(first, second)


def test_where_the_angles_come_is_said(port: int, send: Sender) -> None:
    model = MODELS["rs-32"]
    send(packets_of(model, blocks_of(model, *ranges(model, 1800))))
    with pytest.raises(PointsError, match=rf"^udp:{port}: .* Listen to its port, too: udp:{port},7788"):
        sensor_of(f"udp:{port}")
    send([difop(model, unit_angles(model))])
    assert getattr(sensor_of(f"udp:{port}"), "name", None) == "rs-32"


def test_a_port_that_is_released_is_free(source: Path) -> None:
    """At once, not when the thread that waits for packets looks up: half a second later."""
    found = set()
    for _ in range(5):
        found.add(ports.listen(source))
        time.sleep(0.02)
        ports.release(source)
    assert len(found) == 5


@pytest.mark.usefixtures("in_this_process")
def test_a_stream_takes_ports(port: int, source: Path, send: Sender) -> None:
    """As they come, whatever the times in the packets."""
    send(packets_of(MODELS["pandarxt-16"], blocks_of(MODELS["pandarxt-16"], *ranges(MODELS["pandarxt-16"], 2000))))
    with stream(str(source), lambda points, stamp_s: points) as live:  # type: ignore[arg-type, return-value]
        answers = [live.take(30.0) for _ in range(3)]
    assert all(answer is not None and len(answer.perception) > 100 for answer in answers)  # type: ignore[arg-type]


def test_a_run_of_packets_ends_with_silence_or_where_they_are_taken_too_late(
    source: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the next one begins with what comes then."""
    monkeypatch.setattr(ports, "FIRST_S", 0.1)
    signs, read = list[int](), list[bytes]()
    ports.listen(source)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.sendto(b"first", ("127.0.0.1", port))
        assert [bytes(each.payload) for each in Datagrams(source, silent)] == [b"first"]
        assert [bytes(each.payload) for each in Datagrams(source, silent)] == [b"first"]  # as often as is wanted
        for each in Datagrams(source, lambda: signs.append(1), endless=True):
            read.append(bytes(each.payload))
            if len(read) < 4:
                one.sendto(b"%d" % len(read), ("127.0.0.1", port))
        assert read == [b"first", b"1", b"2", b"3"]
        assert signs
        one.sendto(b"another run", ("127.0.0.1", port))
        (datagram,) = Datagrams(source, silent)
        assert (*datagram[:2], bytes(datagram.payload)) == ("127.0.0.1", port, b"another run")
        monkeypatch.setattr(ports, "LATE_S", 0.05)
        datagrams = iter(Datagrams(source, silent, endless=True))
        assert bytes(next(datagrams).payload) == b"another run"
        for content in (b"late", b"new"):
            one.sendto(content, ("127.0.0.1", port))
            time.sleep(0.3)
        assert [bytes(each.payload) for each in Datagrams(source, silent)] == [b"another run"]
        assert [*datagrams] == []
        assert [bytes(each.payload) for each in Datagrams(source, silent)] == [b"new"]


def test_a_port_that_is_taken_is_said(source: Path, port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("", port))
        with pytest.raises(PointsError, match=rf"^udp:{port}: port {port} cannot be listened to \(.*\); another"):
            sensor_of(source)


@pytest.mark.parametrize(
    "name", ["udp:", "udp:lidar", "udp:0", "udp:70000", "udp:1.2.3:2368", "udp:2368,", "udp:2368/a"]
)
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(PointsError, match=r"udp:.*: expected ports as udp:2368, udp:6699,7788 or udp:ADDRESS:2368"):
        sensor_of(name)


def test_a_port_at_which_nothing_comes_is_said(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "PATIENCE_S", 0.1)
    monkeypatch.setattr(ports, "SILENCE_S", 0.1)
    with pytest.raises(PointsError, match=r"^udp:\d+: no packet came in 0.1 s. Let the sensor send to"):
        sensor_of(source)


@pytest.mark.parametrize(
    ("text", "file"),
    [("udp:2368", "2368"), ("udp://:2368", "2368"), ("udp:6699,7788", "6699"), ("udp:239.0.0.5:7502", "7502")],
)
def test_files_of_a_unit_have_the_number_of_the_first_port(text: str, file: str) -> None:
    path = Path(text)
    assert ports.is_port(path)
    assert ports.named(path) == Path(file)
    assert ports.named(Path("a/drive.pcap")) == Path("a/drive.pcap")


def test_what_is_sent_to_a_group_is_read(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "FIRST_S", 0.1)
    path = Path(f"udp:239.255.0.7:{port}")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        try:
            one.sendto(b"before", ("239.255.0.7", port))
        except OSError:
            pytest.skip("this computer has no network for groups")
        try:
            ports.listen(path)
            one.sendto(b"to all", ("239.255.0.7", port))
            assert [bytes(each.payload) for each in Datagrams(path, silent)] == [b"to all"]
        finally:
            ports.release(path)
