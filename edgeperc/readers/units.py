"""Asks a live sensor what its packets do not say: where a Hesai's lasers look, and an Ouster's metadata."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import NamedTuple

from ..errors import PointsError

PTC_PORT, HTTP_PORT = 9347, 80
PATIENCE_S = 3.0
MOST_BYTES = 1 << 20
# Of Hesai's command protocol: its magic, the command to tell the calibration, and no payload.
_MAGIC, _TELL_CALIBRATION = b"\x47\x74", 5


class Told(NamedTuple):
    """What a sensor said, in place of the file of the unit beside a capture."""

    name: str
    content: bytes

    def read_bytes(self) -> bytes:
        """As of a file."""
        return self.content


def hesai_calibration(address: str) -> Told:
    """What Hesai's driver keeps as the .csv or .dat of the unit. Raises PointsError."""
    return _told(address, PTC_PORT, _calibration)


def ouster_metadata(address: str) -> Told:
    """What ouster-sdk keeps as the .json of the unit. Raises PointsError."""
    return _told(address, HTTP_PORT, _metadata)


def _told(address: str, port: int, ask: Callable[[str, int], bytes]) -> Told:
    """What a sensor answers in time, however slowly it sends."""
    found = list[bytes | Exception]()

    def run() -> None:
        try:
            found.append(ask(address, port))
        except Exception as exc:
            found.append(exc)

    asking = threading.Thread(target=run, name="edgeperc-unit", daemon=True)
    asking.start()
    asking.join(PATIENCE_S)
    answer = found[0] if found else TimeoutError(f"none in {PATIENCE_S:g} s")
    if isinstance(answer, bytes) and len(answer) <= MOST_BYTES:
        return Told(f"that {address} told at TCP port {port}", answer)
    reason = f"more than {MOST_BYTES:,} bytes" if isinstance(answer, bytes) else answer
    raise PointsError(f"The sensor was asked at {address}, TCP port {port}, and gave no answer of use ({reason})")


def _calibration(address: str, port: int) -> bytes:
    import socket  # for live sensors alone

    with socket.create_connection((address, port), PATIENCE_S) as link, link.makefile("rb") as answer:
        link.sendall(_MAGIC + bytes([_TELL_CALIBRATION, 0]) + bytes(4))
        head = answer.read(8)
        if len(head) < 8 or head[:3] != _MAGIC + bytes([_TELL_CALIBRATION]) or head[3]:
            raise ValueError(f"it begins with {head.hex(' ') or 'nothing'}")
        n = int.from_bytes(head[4:], "big")
        content = answer.read(min(n, MOST_BYTES + 1))
        if len(content) < min(n, MOST_BYTES + 1):
            raise ValueError(f"{len(content):,} bytes of {n:,}")
        return content


def _metadata(address: str, port: int) -> bytes:
    from http.client import HTTPConnection

    link = HTTPConnection(address, port, timeout=PATIENCE_S)
    try:
        link.request("GET", "/api/v1/sensor/metadata")
        answer = link.getresponse()
        if answer.status != 200:
            raise ValueError(f"HTTP status {answer.status}")
        return answer.read(MOST_BYTES + 1)
    finally:
        link.close()
