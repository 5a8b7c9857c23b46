"""What no packet says is asked of the live sensor: angles of a Hesai, metadata of an Ouster."""

from __future__ import annotations

import json
import math
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from capture_writers import write_pcap
from lidar_writers import (
    MODELS,
    Sender,
    at128_correction,
    at128_packets,
    blocks_of,
    calibration,
    packets_of,
    ranges,
    unit_angles,
)
from test_mirror_packets import BEGINS, ENDS, drawn, sweep, unit
from test_ouster_packets import METADATA, changed, random_packets

from edgeperc import EdgepercError, PointsError, read_scans, sensor_of
from edgeperc.readers import ports, units

pytestmark = pytest.mark.usefixtures("in_this_process")

MODEL = MODELS["pandar40p"]
HEAD = bytes.fromhex("47740500")
Answer = Callable[[bytes, float], list[bytes]]


@pytest.fixture
def answer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Answer]:
    """Answers every question over TCP with these bytes, each after so long; returns what was asked."""
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port, over = server.getsockname()[1], threading.Event()
        monkeypatch.setattr(units, "PTC_PORT", port)
        monkeypatch.setattr(units, "HTTP_PORT", port)
        monkeypatch.setattr(ports, "FIRST_S", 0.3)

        def begin(content: bytes, each_s: float = 0.0) -> list[bytes]:
            asked = list[bytes]()
            monkeypatch.setattr(units, "PATIENCE_S", 0.3 if each_s else 30.0)

            def run() -> None:
                while not over.is_set():
                    try:
                        link, _ = server.accept()
                    except OSError:
                        return
                    with link:
                        asked.append(link.recv(1000))
                        for part in [content[k : k + 1] for k in range(len(content))] if each_s else [content]:
                            if over.wait(each_s):
                                break
                            link.sendall(part)

            threading.Thread(target=run, daemon=True).start()
            return asked

        yield begin
        over.set()
        with closing(socket.socket()) as last:
            last.connect_ex(("127.0.0.1", port))


def hesai(content: bytes) -> bytes:
    return HEAD + len(content).to_bytes(4, "big") + content


def http(status: str, content: bytes) -> bytes:
    return f"HTTP/1.1 {status}\r\nContent-Length: {len(content)}\r\n\r\n".encode() + content


def test_a_hesai_tells_its_angles(port: int, source: Path, send: Sender, answer: Answer, tmp_path: Path) -> None:
    """As the file of the unit says them, which is not asked for then."""
    text = calibration(unit_angles(MODEL))
    asked = answer(hesai(text.encode()), 0.0)
    sent = packets_of(MODEL, blocks_of(MODEL, *ranges(MODEL, 3600)))
    send(sent)
    found = sensor_of(source)
    assert asked == [bytes.fromhex("47740500 00000000")]
    (tmp_path / "drive.csv").write_text(text)
    assert found == sensor_of(write_pcap(tmp_path / "drive.pcap", sent)) is not None
    (tmp_path / f"{port}.csv").write_text(text)
    assert sensor_of(source) == found
    assert len(asked) == 1


def test_an_at128_tells_where_its_mirrors_are(source: Path, send: Sender, answer: Answer) -> None:
    asked = answer(hesai(at128_correction(BEGINS, ENDS, *unit())), 0.0)
    motor = [*sweep(0), *sweep(1), *sweep(2)]
    send(at128_packets(motor, *drawn(motor)))
    with closing(read_scans(source)) as scans:  # type: ignore[type-var]
        assert len(next(scans)[1]) > 100
    assert len(asked) == 1


def test_an_ouster_tells_its_metadata(source: Path, send: Sender, answer: Answer) -> None:
    asked = answer(http("200 OK", json.dumps(METADATA).encode()), 0.0)
    send(
        [bytes(packet.buf) for turn in random_packets(METADATA, 100, 1) for packet in turn]
    )  # too many for one that comes again to seem late
    sensor = sensor_of(source)
    assert sensor is not None
    np.testing.assert_allclose(sensor.elevations_deg, METADATA["beam_intrinsics"]["beam_altitude_angles"])
    assert len(asked) == 1  # of all that look at the first packets
    assert asked[0].startswith(b"GET /api/v1/sensor/metadata HTTP/1.1\r\n")
    with closing(read_scans(source)) as scans:  # type: ignore[type-var]
        assert len(next(scans)[1]) > 100


@pytest.mark.parametrize(
    ("content", "each_s", "said"),
    [
        (b"", 0.0, r"begins with nothing"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", 0.0, r"begins with 48 54 54 50"),
        (bytes.fromhex("4774050300000000"), 0.0, "begins with 47 74 05 03"),
        (hesai(b"1,2,3\n" * 10)[:-1], 0.0, "59 bytes of 60"),
        (HEAD + b"\xff" * 4 + bytes(units.MOST_BYTES + 1), 0.0, "more than 1,048,576 bytes"),
        (hesai(b"1,2,3\n" * 100), 0.05, "none in 0.3 s"),
        (hesai(b"1,2,3\n"), 0.0, r"that 127.0.0.1 told at TCP port \d+ has 1 rows"),
    ],
)
def test_what_is_no_calibration_is_said(
    content: bytes,
    each_s: float,
    said: str,
    source: Path,
    send: Sender,
    answer: Answer,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(units, "PATIENCE_S", 0.3 if each_s else 30.0)
    answer(content, each_s)
    send(packets_of(MODEL, blocks_of(MODEL, *ranges(MODEL, 1800))))
    with pytest.raises(PointsError, match=rf"Pandar40P are not known\. .*{said}.*current folder, as \d+\.csv"):
        sensor_of(source)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (http("404 Not Found", b"no"), "HTTP status 404"),
        (http("200 OK", b"<html>"), "told at TCP port .* it is not JSON"),
        (http("200 OK", json.dumps(changed(beam_intrinsics={})).encode()), "told at TCP port .* no usable beam angles"),
    ],
)
def test_what_is_no_metadata_is_said(content: bytes, said: str, source: Path, send: Sender, answer: Answer) -> None:
    answer(content, 0.0)
    send([bytes(packet.buf) for turn in random_packets(METADATA, 3, 1) for packet in turn])
    with pytest.raises(EdgepercError, match=said):
        sensor_of(source)


def test_who_does_not_listen_is_not_waited_for(source: Path, send: Sender, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))  # and does not listen
        monkeypatch.setattr(units, "PTC_PORT", one.getsockname()[1])
        send(packets_of(MODEL, blocks_of(MODEL, *ranges(MODEL, 1800))))
        with pytest.raises(PointsError, match=r"The sensor was asked at 127\.0\.0\.1, TCP port \d+, and gave no"):
            sensor_of(source)


def test_a_capture_asks_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(units, "PATIENCE_S", math.nan)
    path = write_pcap(tmp_path / "drive.pcap", packets_of(MODEL, blocks_of(MODEL, *ranges(MODEL, 1800))))
    with pytest.raises(PointsError, match=r"Put Hesai's calibration of the unit beside it, as drive\.csv"):
        sensor_of(path)
