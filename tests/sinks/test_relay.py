"""Viewers of a run: bounded in number and in what waits for them, and never in the way of the run's end."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from edgeperc.cli.program import run_program
from edgeperc.cli.sinks import SINKS, Sinks
from edgeperc.sinks import relay as relay_module
from edgeperc.sinks.foxglove import McapSink, ServeSink
from edgeperc.sinks.relay import MAX_VIEWERS, Relay
from edgeperc.sinks.run_file import RunFile
from edgeperc.system.lanes import returns

PATIENCE_S = 60.0  # of a test whose fault would be to wait for ever


class Server:
    """Greets each connection, then does as the test says."""

    def __init__(self, answer: Callable[[socket.socket], None]) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._answer = answer
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            self._answer(connection)

    def close(self) -> None:
        self._listener.close()


def echo(connection: socket.socket) -> None:
    while data := connection.recv(2**16):
        connection.sendall(data)


def flood(connection: socket.socket) -> None:
    while True:
        connection.sendall(bytes(2**16))


Opener = Callable[[Callable[[socket.socket], None]], "tuple[Relay, Callable[[], socket.socket]]"]


@pytest.fixture
def relayed() -> Iterator[Opener]:
    """A function from what the server does to a relay and what connects to it."""
    with ExitStack() as stack:

        def make(answer: Callable[[socket.socket], None]) -> tuple[Relay, Callable[[], socket.socket]]:
            server = Server(answer)
            stack.callback(server.close)
            listener = socket.create_server(("127.0.0.1", 0))
            address = listener.getsockname()
            relay = Relay(listener, server.port)
            stack.callback(relay.close)
            return relay, lambda: stack.enter_context(socket.create_connection(address, timeout=PATIENCE_S))

        yield make


def read(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := connection.recv(size - len(data))):
        data += more
    return data


def has_ended(connection: socket.socket) -> bool:
    try:
        while connection.recv(2**16):
            pass
    except ConnectionResetError:
        pass
    return True


def test_bytes_pass_unchanged_both_ways(relayed: Opener) -> None:
    _, connect = relayed(echo)
    viewers, sent = [connect() for _ in range(3)], bytes(range(256)) * 4000
    for viewer in viewers:
        threading.Thread(target=viewer.sendall, args=(sent,), daemon=True).start()
    assert all(read(viewer, len(sent)) == sent for viewer in viewers)


def test_the_viewers_are_bounded_and_a_place_becomes_free(relayed: Opener) -> None:
    relay, connect = relayed(echo)
    viewers = [connect() for _ in range(MAX_VIEWERS)]
    for viewer in viewers:
        viewer.sendall(b"hello")
        assert read(viewer, 5) == b"hello"
    assert connect().recv(12) == b"HTTP/1.1 503"
    assert relay.n_refused == 1
    viewers.pop().close()
    while True:  # until the relay has seen that it left
        try:
            newest = connect()
            newest.sendall(b"hello")
            if read(newest, 5) == b"hello":
                break
        except ConnectionError:
            pass


def test_who_says_nothing_or_reads_nothing_is_dropped(relayed: Opener, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relay_module, "GREETING_S", 0.1)
    monkeypatch.setattr(relay_module, "STALLED_S", 0.1)
    _, connect = relayed(echo)
    assert has_ended(connect())
    relay, connect = relayed(flood)
    deaf = connect()
    while not relay.viewers:
        time.sleep(0.01)
    while relay.viewers:
        time.sleep(0.05)
    assert has_ended(deaf)


def test_a_viewer_that_sends_without_end_is_dropped(relayed: Opener, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relay_module, "MAX_RECEIVED", 10_000)
    _, connect = relayed(echo)
    viewer = connect()
    with contextlib.suppress(ConnectionError):
        viewer.sendall(bytes(20_000))
    assert has_ended(viewer)


@pytest.mark.parametrize("answer", [echo, flood])
def test_a_relay_closes_with_viewers_connected(
    relayed: Opener, answer: Callable[[socket.socket], None], caplog: pytest.LogCaptureFixture
) -> None:
    relay, connect = relayed(answer)
    viewers = [connect() for _ in range(3)]
    for viewer in viewers:
        viewer.sendall(b"hello")
        assert viewer.recv(5)
    relay.end(0.1)
    assert returns(relay.close, PATIENCE_S)
    assert all(map(has_ended, viewers))
    assert not caplog.records  # a callback's error is only logged
    relay.close()  # again, without effect
    with pytest.raises(ConnectionError):
        connect()


def test_a_server_stops_while_a_viewer_is_silent() -> None:
    pytest.importorskip("foxglove")
    sink = ServeSink(port=0)
    port = int(sink.url.rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as silent:
        assert returns(sink.close, PATIENCE_S)
        assert has_ended(silent)


def test_calls_that_wait_for_ever_are_left_behind() -> None:
    never = threading.Event()
    assert not returns(never.wait, 0.05)
    never.set()
    assert returns(lambda: None, PATIENCE_S)
    with pytest.raises(ZeroDivisionError):
        returns(lambda: 1 // 0, PATIENCE_S)


def test_files_are_finished_before_what_is_served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("foxglove")
    closed: list[str] = []
    ended = ServeSink.close

    def close(sink: Any, whole: bool) -> None:
        closed.append(f"{type(sink).__name__} {whole}")
        if isinstance(sink, ServeSink):
            ended(sink)

    monkeypatch.setattr(McapSink, "close", close)
    monkeypatch.setattr(ServeSink, "close", close)
    arguments = argparse.Namespace(**dict.fromkeys(SINKS), live=False, gif=False)
    arguments.mcap, arguments.serve = tmp_path / "run.mcap", ("127.0.0.1", 0)
    with Sinks(arguments):
        assert not closed
    assert closed == ["McapSink True", "ServeSink True"]


@pytest.mark.skipif(os.name != "posix", reason="signals differ elsewhere")
def test_a_signal_acts_after_what_a_library_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Native code loses an exception of the file that it writes to."""
    whole: list[bool] = []

    class File:
        def write(self, data: bytes) -> None:
            signal.raise_signal(signal.SIGTERM)
            whole.append(True)

    monkeypatch.setattr(Path, "open", lambda *_: File())
    file = RunFile(tmp_path / "file")

    def command() -> int:
        assert file.write(b"12") == 2
        time.sleep(PATIENCE_S)
        return 0

    assert run_program("edgeperc", command) == 143
    assert whole == [True]
