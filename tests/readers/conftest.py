"""Captures that the tests decode without a process of their own."""

from __future__ import annotations

import json
import socket
import threading
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:  # pytest imports this file before it counts the calls of kernels
    from lidar_writers import Sender


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Captures are decoded here: a process takes a second to start. That it replies the same is for `test_apart`, and
    of descriptions for a test in `test_identify`. Where a library that decodes them is missing, tests are skipped.
    """
    # Here, because pytest imports this file before it counts the calls of kernels.
    from edgeperc.errors import MissingExtraError
    from edgeperc.readers import captures
    from edgeperc.readers.decoders import decode, describe
    from edgeperc.readers.times import TimedScan

    def decoded(path: Path, kind: str, topic: str | None, remission_field: str | None, times: bool) -> Iterator[Any]:
        def warn(text: str) -> None:
            warnings.warn(text, UserWarning, stacklevel=2)

        try:
            for one in decode(path, kind, topic, remission_field, warn, lambda: None, times=times):
                yield TimedScan(one.stamp_s, one.points.copy(), one.times_s if times else None)
        except MissingExtraError as exc:
            if isinstance(exc.__cause__, ModuleNotFoundError):
                pytest.skip(str(exc))
            raise

    def described(path: Path, kind: str, topic: str | None) -> Any:
        return json.loads(json.dumps(describe(path, kind, topic, lambda: None)))

    monkeypatch.setattr(captures, "decode_apart", decoded)
    monkeypatch.setattr(captures, "describe_apart", described)


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("", 0))
        return int(one.getsockname()[1])


@pytest.fixture
def source(port: int) -> Iterator[Path]:
    """The ports, which this process listens to no more after the test."""
    from edgeperc.readers import ports

    yield (path := Path(f"udp:{port}"))
    ports.release(path)


@pytest.fixture
def send(port: int) -> Iterator[Sender]:
    """Sends packets again and again, 2,000 a second."""
    over = threading.Event()

    def run(packets: Sequence[bytes]) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            for packet in takewhile(lambda _: not over.wait(0.0005), cycle(packets)):
                one.sendto(packet, ("127.0.0.1", port))

    with ThreadPoolExecutor() as pool:
        yield lambda packets: pool.submit(run, packets)
        over.set()
