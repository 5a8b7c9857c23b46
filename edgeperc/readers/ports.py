"""Packets that sensors send to this computer now, read as a capture without an end: ``udp:2368``."""

from __future__ import annotations

import re
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..errors import PointsError

if TYPE_CHECKING:
    import socket

    from .units import Told

_SOURCE = re.compile(r"udp:/{0,2}(?:(\d+(?:\.\d+){3})?:)?(\d{1,5}(?:,\d{1,5})*)")
_MOST_BYTES = 65_535
_BUFFER_BYTES = 1 << 23  # of the system, for packets that nobody has taken yet; it may give fewer
# The first packets tell who sends: every sensor's say what it is, and RoboSense's where its lasers look, several times.
FIRST_S = 1.5
PATIENCE_S = 10.0  # until a packet comes, at first
SILENCE_S = 1.0  # behind it, a turn is another one
_TICK_S = 0.5  # until a thread sees that its port is closed
LATE_S = 1.0  # packets that wait so long are dropped with all that came since


class Datagram(NamedTuple):
    """What a UDP datagram carries."""

    sender: str  # the IPv4 or IPv6 address
    port: int  # that it was sent to
    stamp_s: float  # when its last part was captured
    payload: memoryview

    def is_from(self, sender: str | None) -> bool:
        """Whether it is one of a sender's, as `sender_names` calls them; None: any."""
        return sender in (None, self.sender, f"{self.sender}:{self.port}")


def is_port(path: Path) -> bool:
    """Whether a source names ports of this computer in place of a file."""
    return str(path).startswith("udp:")


def named(path: Path) -> Path:
    """A capture as the files beside it are called: those of ports have the number of the first one, here."""
    match = _SOURCE.fullmatch(str(path))
    return Path(match[2].partition(",")[0]) if match else path


def listen(path: Path) -> Listener:
    """What listens to the ports in this process. Raises PointsError."""
    if path not in _LISTENERS:
        _LISTENERS[path] = Listener(path)
    return _LISTENERS[path]


def release(path: Path) -> None:
    """Close the ports, if this process listens to them."""
    if path in _LISTENERS:
        _LISTENERS.pop(path).close()


class Listener:
    """Takes the packets of ports in threads of its own, which no decoder delays.

    A run of packets ends with a second of silence, and where they are taken too late.
    """

    def __init__(self, path: Path) -> None:
        match = _SOURCE.fullmatch(str(path))
        ports = [*map(int, match[2].split(","))] if match else []
        if not ports or not all(0 < port < 65_536 for port in ports):
            raise PointsError("expected ports as udp:2368, udp:6699,7788 or udp:ADDRESS:2368")
        self.begun = list[Datagram]()  # the first packets of the run that goes on
        self.told = dict[str, "Told | PointsError"]()  # what sensors said in this run, by address
        self._waiting, self._changed = deque[Datagram](), threading.Condition()
        self._is_new, self._is_late, self._closed = True, False, threading.Event()
        self._sockets, self._threads = list["socket.socket"](), list[threading.Thread]()
        for port in ports:
            try:
                self._sockets.append(_opened((match and match[1]) or "", port))
            except OSError as exc:
                self.close()
                raise PointsError(
                    f"port {port} cannot be listened to ({exc.strerror or exc}); another program may do so "
                    "already, or the address is not one of this computer"
                ) from exc
            self._threads.append(threading.Thread(target=self._receive, args=(port, self._sockets[-1]), daemon=True))
            self._threads[-1].start()

    def close(self) -> None:
        """Stop listening; the ports are free."""
        import socket

        self._closed.set()
        for each in self._sockets:
            with suppress(OSError):  # wakes the thread that waits for a packet and so keeps the port
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        for thread in self._threads:
            thread.join()

    def first(self, alive: Callable[[], None]) -> list[Datagram]:
        """The first packets of this run."""
        begun_s = time.monotonic()
        while not self.begun:
            if self._closed.is_set():
                raise OSError("the ports were closed")
            self._is_late = False
            alive()
            datagram = self.take(SILENCE_S)
            if datagram is not None:
                self._is_new, end_s = False, time.monotonic() + FIRST_S
                while datagram is not None:
                    self.begun.append(datagram)
                    left_s = end_s - time.monotonic()
                    datagram = self.take(left_s) if left_s > 0.0 else None
            elif self._is_new and time.monotonic() - begun_s > PATIENCE_S:
                raise PointsError(
                    f"no packet came in {PATIENCE_S:g} s. Let the sensor send to an address of this "
                    "computer and to this port, and the firewall pass UDP; tcpdump -i any udp shows what comes"
                )
        return self.begun

    def run(self, alive: Callable[[], None]) -> Iterator[Datagram]:
        """All packets of this run; the next call has those of the next one."""
        yield from self.first(alive)
        while (datagram := self.take(SILENCE_S)) is not None:
            yield datagram
        self.forget()
        self._is_late = False

    def forget(self) -> None:
        """Begin another run, maybe of another sensor."""
        self.begun, self.told = [], {}

    def take(self, wait_s: float) -> Datagram | None:
        """The next packet; None if none comes in time, or if some were dropped in this run."""
        with self._changed:
            is_there = self._changed.wait_for(lambda: self._waiting, max(wait_s, 0.0))
            return self._waiting.popleft() if is_there and not self._is_late else None

    def _receive(self, port: int, of_port: socket.socket) -> None:
        while not self._closed.is_set():
            try:
                payload, sender = of_port.recvfrom(_MOST_BYTES)
            except TimeoutError:
                continue
            except OSError:  # closed, or a network that is down and may come back
                self._closed.wait(_TICK_S)
                continue
            if self._closed.is_set():
                return
            now_s = time.time()
            with self._changed:
                if self._waiting and not 0.0 <= now_s - self._waiting[0].stamp_s < LATE_S:
                    self._waiting.clear()
                    self._is_late = True
                self._waiting.append(Datagram(sender[0], port, now_s, memoryview(payload)))
                self._changed.notify()


def _opened(address: str, port: int) -> socket.socket:
    """A socket for the packets to a port, at an address or at all, or of a group. Raises OSError."""
    import socket  # for a source of this kind alone

    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        with suppress(OSError):
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        if address and 224 <= int(address.partition(".")[0]) < 240:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a group may have several listeners
            group = struct.pack("4s4s", socket.inet_aton(address), bytes(4))
            opened.bind(("", port))
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        else:
            opened.bind((address, port))
        opened.settimeout(_TICK_S)
    except OSError:
        opened.close()
        raise
    return opened


_LISTENERS: dict[Path, Listener] = {}
