"""Running a model opens no socket, and writes nothing but edgeperc's own cache into the user's folders."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from edgeperc.system.extras import without_telemetry

FOLDERS = {"HOME": ".", "XDG_CACHE_HOME": ".cache", "XDG_CONFIG_HOME": ".config", "XDG_DATA_HOME": ".local/share"}

# Sockets of Python are seen by an audit hook. Native code is stopped by the kernel: a filter ends the process if any of
# its threads creates a socket of the internet (families 2 and 10).
WATCH = """
import ctypes, os, struct, sys

def watch(event, arguments):
    if event in ("socket.__new__", "socket.connect", "socket.getaddrinfo"):
        print("socket:", event, arguments, flush=True)

sys.addaudithook(watch)
socket_call = int(sys.argv[1])
if socket_call:
    def line(code, k, yes=0, no=0):
        return struct.pack("=HBBI", code, yes, no, k)
    LOAD, EQUAL, RETURN = 0x20, 0x15, 0x06
    program = b"".join([
        line(LOAD, 0), line(EQUAL, socket_call, 0, 4),
        line(LOAD, 16), line(EQUAL, 2, 1, 0), line(EQUAL, 10, 0, 1),
        line(RETURN, 0x80000000), line(RETURN, 0x7FFF0000),
    ])
    held = ctypes.create_string_buffer(program)
    fprog = ctypes.create_string_buffer(struct.pack("@HP", len(program) // 8, ctypes.addressof(held)))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(38, 1, 0, 0, 0) or libc.prctl(22, 2, ctypes.byref(fprog), 0, 0):
        sys.exit("no filter: " + os.strerror(ctypes.get_errno()))
"""
RUN = """
import time
import numpy as np
from edgeperc import Perceiver

points = np.zeros((5000, 4), np.float32)
points[:, 0] = np.linspace(3.0, 40.0, 5000)
points[:, 1] = np.linspace(-1.0, 1.0, 5000) * points[:, 0]
points[:, 2] = -1.73
found = Perceiver(["pointseg"], on_mismatch="warn")(points)
time.sleep(1.0)  # for threads that work later
print(found.providers, os.environ["ORT_DISABLE_TELEMETRY"])
"""
OPEN = {"python": "import socket\nsocket.socket()", "native": "ctypes.CDLL(None).socket(2, 1, 0)", "none": ""}


def socket_call() -> int:
    """Number of the system call socket(2); 0 where no filter is written for it."""
    if sys.platform != "linux":
        return 0
    return {"x86_64": 41, "aarch64": 198}.get(platform.machine(), 0)


def watched(code: str, home: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh process with folders of its own, without sockets."""
    home.mkdir(exist_ok=True)
    left_out = {"ORT_DISABLE_TELEMETRY", "EDGEPERC_CACHE_DIR", *FOLDERS}
    kept = {name: value for name, value in os.environ.items() if name not in left_out}
    folders = {name: str(home / inside) for name, inside in FOLDERS.items()}
    command = [sys.executable, "-c", WATCH + code, str(socket_call())]
    return subprocess.run(command, capture_output=True, text=True, env=kept | folders | variables, cwd=home)


def test_a_run_opens_no_socket_and_writes_only_the_own_cache(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    done = watched(RUN, tmp_path / "home")
    assert done.returncode == 0, done.stderr
    assert "socket:" not in done.stdout
    assert done.stdout.endswith("} 1\n")
    written = [path.relative_to(tmp_path / "home").as_posix() for path in (tmp_path / "home").rglob("*")]
    own = ".cache/edgeperc" if sys.platform != "darwin" else "Library/Caches/edgeperc"
    assert [path for path in written if not path.startswith(own) and not own.startswith(path)] == []


@pytest.mark.skipif(socket_call() == 0, reason="there is a filter for Linux on x86-64 and aarch64 only")
@pytest.mark.parametrize("how", OPEN)
def test_the_watch_sees_a_socket(how: str, tmp_path: Path) -> None:
    done = watched(OPEN[how], tmp_path)
    assert (done.returncode == 0) == (how == "none"), done.stderr
    assert ("socket:" in done.stdout) == (how == "python")
    assert "no filter" not in done.stderr


def test_a_value_of_the_user_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "onnxruntime", raising=False)
    for given, expected in (("0", "0"), (None, "1")):
        if given is None:
            monkeypatch.delenv("ORT_DISABLE_TELEMETRY", raising=False)
        else:
            monkeypatch.setenv("ORT_DISABLE_TELEMETRY", given)
        without_telemetry()
        assert os.environ["ORT_DISABLE_TELEMETRY"] == expected


def test_an_onnxruntime_that_is_already_imported_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", sys)
    monkeypatch.delenv("ORT_DISABLE_TELEMETRY", raising=False)
    without_telemetry()
    assert "ORT_DISABLE_TELEMETRY" not in os.environ
