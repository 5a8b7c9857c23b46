"""A bounded door to a server inside this program: so many viewers, so much waiting for each, and an end in time."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
import time
from dataclasses import dataclass, field

MAX_VIEWERS = 8
_CHUNK = 2**18
_BUFFER = 2**20  # of the kernel, for each socket
MAX_RECEIVED = 4 * 2**20  # a viewer sends names of topics and answers to pings
GREETING_S = 10.0  # until the server has answered the handshake
STALLED_S = 30.0  # without reading what waits
TICK_S = 0.5
_FULL = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\n"
    b"as many viewers as edgeperc serves are connected\n"
)


@dataclass(eq=False)
class _Viewer:
    """A connection: the viewer's socket, that to the server, and what waits for each."""

    client: socket.socket
    server: socket.socket
    since_s: float = field(default_factory=time.monotonic)  # of the connection, then of the last bytes that it took
    to_client: memoryview = field(default_factory=lambda: memoryview(b""))
    to_server: memoryview = field(default_factory=lambda: memoryview(b""))
    n_received: int = 0
    is_greeted: bool = False
    is_ended: bool = False  # by the server


class Relay:
    """Passes bytes between at most `MAX_VIEWERS` viewers and a server on 127.0.0.1, in one thread, reading only what a
    viewer takes. One ends that greets nobody in 10 s, takes nothing for 30 s or sends over 4 MB.
    """

    def __init__(self, listener: socket.socket, port: int) -> None:
        self.n_refused = 0
        self._listener, self._port = listener, port
        self.viewers: list[_Viewer] = []
        self._wake, self._woken = socket.socketpair()
        self._ending_s: float | None = None
        self._selector = selectors.DefaultSelector()
        for each in (listener, self._woken):
            each.setblocking(False)
            self._selector.register(each, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="edgeperc viewers", daemon=True)
        self._thread.start()

    def end(self, grace_s: float) -> None:
        """Accept nobody any more, and end all connections after so many seconds; returns immediately."""
        self._ending_s = time.monotonic() + grace_s
        with contextlib.suppress(OSError):
            self._wake.send(b"x")

    def close(self) -> None:
        """End all connections."""
        self.end(0.0)
        self._thread.join()

    def _run(self) -> None:
        try:
            while self._ending_s is None or (self.viewers and time.monotonic() < self._ending_s):
                for key, events in self._selector.select(TICK_S if self._ending_s is None else 0.05):
                    if key.fileobj is self._listener:
                        self._accept()
                    elif key.fileobj is self._woken:
                        self._woken.recv(16)
                        self._stop_listening()
                    elif key.data in self.viewers:
                        self._pass(key.data, key.fileobj, events)
                self._drop_silent()
        finally:
            for viewer in [*self.viewers]:
                self._drop(viewer)
            self._stop_listening()
            self._selector.close()
            self._wake.close()
            self._woken.close()

    def _stop_listening(self) -> None:
        if self._listener.fileno() >= 0:
            self._selector.unregister(self._listener)
            self._listener.close()
        for viewer in [viewer for viewer in self.viewers if not viewer.is_greeted]:
            self._drop(viewer)

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:  # it has left, or there are too many open files
            time.sleep(0.02)
            return
        client.setblocking(False)
        try:
            if len(self.viewers) >= MAX_VIEWERS:
                self.n_refused += 1
                client.send(_FULL)
                client.shutdown(socket.SHUT_WR)
                client.close()
                return
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            server = socket.socket()
            server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
            server.settimeout(1.0)
            server.connect(("127.0.0.1", self._port))
            server.setblocking(False)
        except OSError:
            client.close()
            return
        self.viewers.append(viewer := _Viewer(client, server))
        self._watch(viewer)

    def _watch(self, viewer: _Viewer) -> None:
        """Wait for what can go on: a side is read when the other one has taken all."""
        read, write = selectors.EVENT_READ, selectors.EVENT_WRITE
        sides = (
            (viewer.client, (not viewer.to_server) * read | bool(viewer.to_client) * write),
            (viewer.server, (not viewer.to_client and not viewer.is_ended) * read | bool(viewer.to_server) * write),
        )
        for side, events in sides:
            known = side in self._selector.get_map()
            if not events and known:
                self._selector.unregister(side)
            elif events and not known:
                self._selector.register(side, events, viewer)
            elif events and self._selector.get_key(side).events != events:
                self._selector.modify(side, events, viewer)

    def _pass(self, viewer: _Viewer, side: object, events: int) -> None:
        is_client = side is viewer.client
        try:
            if events & selectors.EVENT_WRITE:
                if is_client:
                    viewer.to_client = viewer.to_client[viewer.client.send(viewer.to_client) :]
                    viewer.since_s = time.monotonic()
                else:
                    viewer.to_server = viewer.to_server[viewer.server.send(viewer.to_server) :]
            if events & selectors.EVENT_READ and is_client:
                viewer.to_server = memoryview(viewer.client.recv(_CHUNK))
                viewer.n_received += len(viewer.to_server)
                if not viewer.to_server or viewer.n_received > MAX_RECEIVED:
                    self._drop(viewer)
                    return
            elif events & selectors.EVENT_READ:
                viewer.to_client = memoryview(viewer.server.recv(_CHUNK))
                viewer.since_s = time.monotonic()
                viewer.is_greeted = True
                viewer.is_ended = not viewer.to_client
        except (BlockingIOError, InterruptedError):
            pass
        except OSError:
            self._drop(viewer)
            return
        if viewer.is_ended and not viewer.to_client:
            self._drop(viewer)
        else:
            self._watch(viewer)

    def _drop_silent(self) -> None:
        now = time.monotonic()
        for viewer in [*self.viewers]:
            limit_s = STALLED_S if viewer.is_greeted else GREETING_S
            if now - viewer.since_s > limit_s and (viewer.to_client or not viewer.is_greeted):
                self._drop(viewer)

    def _drop(self, viewer: _Viewer) -> None:
        self.viewers.remove(viewer)
        for side in (viewer.client, viewer.server):
            if side in self._selector.get_map():
                self._selector.unregister(side)
            side.close()
