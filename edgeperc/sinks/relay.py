"""A bounded door to a server inside this program: so many viewers, so much waiting for each, and an end in time."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time

MAX_VIEWERS = 8
_CHUNK = 2**18
_BUFFER = 2**20  # of the kernel, for each socket
MAX_RECEIVED = 4 * 2**20  # a viewer sends names of topics and answers to pings
GREETING_S = 10.0  # until the server has answered the handshake
STALLED_S = 30.0  # without taking the chunk that waits
_FULL = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\n"
    b"as many viewers as edgeperc serves are connected\n"
)


class Relay:
    """Passes bytes between at most `MAX_VIEWERS` viewers and a server on 127.0.0.1, in one thread, reading only what a
    viewer takes. One ends that greets nobody in 10 s, does not take 256 kB in 30 s or sends over 4 MB.
    """

    def __init__(self, listener: socket.socket, port: int) -> None:
        self.n_refused = 0
        self.viewers: dict[asyncio.Task[None], bool] = {}  # whether the server has greeted each
        self._listener, self._port = listener, port
        listener.setblocking(False)
        self._loop, self._ending = asyncio.SelectorEventLoop(), asyncio.Event()
        self._loop.add_reader(listener, self._accept)
        self._thread = threading.Thread(target=self._run, name="edgeperc viewers", daemon=True)
        self._thread.start()

    def end(self, grace_s: float) -> None:
        """Accept nobody any more, and end all connections after so many seconds; returns immediately."""
        with contextlib.suppress(RuntimeError):  # it has ended
            self._loop.call_soon_threadsafe(self._end, grace_s)

    def close(self) -> None:
        """End all connections, now or when those that `end` gave time have had it."""
        self.end(0.0)
        self._thread.join()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._until_ended())
        finally:
            self._loop.close()

    async def _until_ended(self) -> None:
        await self._ending.wait()
        while self.viewers:
            await asyncio.wait([*self.viewers])

    def _end(self, grace_s: float) -> None:
        if self._ending.is_set():  # viewers keep the time that they were given
            return
        self._ending.set()
        self._loop.remove_reader(self._listener)
        self._listener.close()
        for viewer, is_greeted in self.viewers.items():
            self._loop.call_later(grace_s if is_greeted else 0.0, viewer.cancel)

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:  # it has left, or there are too many open files
            time.sleep(0.02)
            return
        client.setblocking(False)
        if len(self.viewers) >= MAX_VIEWERS:
            self.n_refused += 1
            with client, contextlib.suppress(OSError):
                client.send(_FULL)
                client.shutdown(socket.SHUT_WR)
            return
        viewer = self._loop.create_task(self._serve(client))
        self.viewers[viewer] = False
        viewer.add_done_callback(lambda _: client.close())
        viewer.add_done_callback(self.viewers.pop)

    async def _serve(self, client: socket.socket) -> None:
        """Pass on what the viewer and the server send, until one of them ends."""
        viewer = asyncio.current_task()
        assert viewer is not None
        with socket.socket() as server, contextlib.suppress(OSError):
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
            server.setblocking(False)
            await self._loop.sock_connect(server, ("127.0.0.1", self._port))
            both = self._up(client, server), self._down(server, client, viewer)
            ways = [self._loop.create_task(way) for way in both]
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)

    async def _up(self, client: socket.socket, server: socket.socket) -> None:
        n_received = 0
        while data := await self._loop.sock_recv(client, _CHUNK):
            n_received += len(data)
            if n_received > MAX_RECEIVED:
                return
            await self._loop.sock_sendall(server, data)

    async def _down(self, server: socket.socket, client: socket.socket, viewer: asyncio.Task[None]) -> None:
        limit = self._loop.call_later(GREETING_S, viewer.cancel)
        while data := await self._loop.sock_recv(server, _CHUNK):
            self.viewers[viewer] = True
            limit.cancel()
            limit = self._loop.call_later(STALLED_S, viewer.cancel)
            await self._loop.sock_sendall(client, data)
            limit.cancel()
