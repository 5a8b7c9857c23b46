"""Helper processes at the first start: they change how long it takes, and nothing else."""

from __future__ import annotations

import gc
import json
import multiprocessing.spawn
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numba
import pytest

from edgeperc import warm_up
from edgeperc.system.compiling import RARE, fewer_collections
from edgeperc.system.lanes import Stopwatch
from edgeperc.warm_up import PARTS, Helpers

MOST_OTHERS = 62

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled with the JIT off")

# What is compiled, and what is counted for the line on the terminal.
NOTED = """
from numba.core import event
from edgeperc import Perceiver, perceiver, warm_up
from edgeperc.system import compilation

def name_of(kernel):
    return f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"

class Compilations(event.Listener):
    def __init__(self):
        self.names = []
    def on_start(self, found):
        self.names.append(name_of(found.data["dispatcher"]))
    def on_end(self, found):
        pass

def noted(needs, of=compilation.kernels_of):
    needs = [*needs]
    called.update(f"edgeperc.{name}" for need in needs for name in compilation.KERNELS[need].split())
    counted.update(name_of(kernel) for kernel in of(needs))
    return of(needs)

called, counted, compilations = set(), set(), Compilations()
perceiver.kernels_of = noted
event.register("numba:compile", compilations)
"""

FIRST = f"""
import sys
with open(sys.argv[1] + "/begun", "a") as begun:
    begun.write("this module was run\\n")

import hashlib, json
import numpy as np
{NOTED}
warm_up.usable_cores = lambda: int(sys.argv[2])
warm_up.MIN_WAIT_S = 600.0  # however busy this computer is

perceive = Perceiver(provider="cpu", n_threads=1, on_mismatch="warn")
constructed = list(compilations.names)
turn, down = np.meshgrid(np.linspace(-np.pi, np.pi, 600, endpoint=False), np.radians(np.linspace(1.2, 24.9, 40)))
radius = 1.73 / np.tan(down)
columns = radius * np.cos(turn), radius * np.sin(turn), np.full_like(turn, -1.73), 0.3 + 0.1 * np.sin(turn)
found = perceive(np.stack(columns, -1).reshape(-1, 4))
answer = hashlib.sha256(found.points.labels.tobytes() + found.top_view.labels.tobytes() + repr(found.boxes).encode())
print(json.dumps([constructed, compilations.names[len(constructed):], answer.hexdigest(), sorted(counted)]))
"""
LATER = f"""
import json, sys
{NOTED}
warm_up.usable_cores = lambda: 1
Perceiver(provider="cpu", n_threads=1, **json.loads(sys.argv[1]))
used = {{name_of(kernel) for kernel in compilation.kernels_of(compilation.KERNELS) if kernel.signatures}}
used |= {{name for name in compilations.names if name.startswith("edgeperc.")}}
print(json.dumps([sorted(called), sorted(used), sorted(counted)]))
"""


def start(folder: Path, n_cores: int, **environment: str) -> tuple[list[str], list[str], str, list[str]]:
    """What a process compiled for a perceiver, what for a call, the call's result, and which kernels it counted."""
    folder.mkdir(exist_ok=True)
    (folder / "main.py").write_text(FIRST)
    environment = {**os.environ, "EDGEPERC_CACHE_DIR": str(folder / "user"), **environment}
    command = [sys.executable, "-W", "ignore", str(folder / "main.py"), str(folder), str(n_cores)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return tuple(json.loads(done.stdout))


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[list[str], list[str], str, list[str]]]:
    """The folder of a first start with a helper, and what it said. It takes long: all processes of a run share it."""
    from filelock import FileLock

    folder = tmp_path_factory.getbasetemp()
    folder = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "first-start"
    with FileLock(folder.with_suffix(".lock")):
        if not (folder / "said.json").exists():
            said = start(folder, 2, NUMBA_CACHE_DIR=str(folder / "cache"))
            (folder / "said.json").write_text(json.dumps(said))
    return folder, tuple(json.loads((folder / "said.json").read_text()))


def test_what_is_counted_is_what_is_compiled_once(first: tuple[Path, Any]) -> None:
    """By the process or its helper, and for one set of types."""
    folder, (own, called, _, counted) = first
    assert called == []
    kernels = [file.name.rpartition("-")[0] for file in (folder / "cache").rglob("*.kernel")]
    assert sorted(kernels) == sorted(".".join(name.split(".")[-2:]) for name in counted)
    assert {name for name in own if name.startswith("edgeperc.")} <= {*counted}
    # Each takes 0.03 s at least. More than these are a sign of kernels that are compiled for several types.
    assert len([name for name in own if not name.startswith("edgeperc.")]) <= MOST_OTHERS


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"models": "lodnn", "on_mismatch": "ignore"}, id="road"),
        pytest.param({"boxes_from": "network", "full_turn": True}, id="full turn"),
        pytest.param({"models": "pointseg", "sensor": "vlp-16", "agree": False}, id="coarse sensor"),
        pytest.param({"models": "a detector", "full_turn": True}, id="detector"),
    ],
)
def test_what_is_counted_is_what_is_used(first: tuple[Path, Any], options: dict[str, Any], tmp_path: Path) -> None:
    """Every kernel that Python is said to call is called, and no other; what is loaded hides the kernels it calls."""
    if options.get("models") == "a detector":
        torch = pytest.importorskip("torch")
        networks = pytest.importorskip("pillar_networks")
        network = networks.PillarNet("anchors").eval()
        torch.nn.init.constant_(network.heads[0].bias, -2.19)  # objects are rare, as detectors begin
        options = {**options, "models": str(networks.exported(network, tmp_path / "detector.onnx"))}
    shutil.copytree(first[0] / "cache", tmp_path / "cache")
    for file in (tmp_path / "cache").rglob("*.fill_returns-*"):
        file.unlink()  # nothing is counted as long as nothing is missing
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-W", "ignore", "-c", LATER, json.dumps(options)]
    # Elsewhere: `-c` would import what lies in the working directory, whose kernels are not those of the first start.
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    called, used, counted = map(set, json.loads(done.stdout))
    assert called <= used <= counted


def test_helpers_fill_the_same_cache_and_change_no_result(cold: None, first: tuple[Path, Any], tmp_path: Path) -> None:
    folder, (helped, _, answer, _) = first
    own = {f"{part.largest.py_func.__module__}.{part.largest.py_func.__name__}": name for name, part in PARTS.items()}
    # Both may begin with the ground at once.
    assert {own[name] for name in helped if name in own} - {"ground"} == set(Helpers([*PARTS]).own_parts) - {"ground"}
    assert (folder / "begun").read_text().count("\n") == 1, "a helper ran the caller's main module"
    assert not [*folder.rglob("*.part")]
    assert start(folder, 2, NUMBA_CACHE_DIR=str(folder / "cache"))[:3] == ([], [], answer)
    assert start(tmp_path / "alone", 1)[2] == answer  # with the kernels of all other tests


@pytest.fixture
def cold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two cores, and nothing in the cache."""
    monkeypatch.setattr(warm_up, "is_cold", lambda _: True)
    monkeypatch.setattr(warm_up, "usable_cores", lambda: 2)


@pytest.fixture
def helpers(cold: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Helpers]]:
    """Helpers that run some code; none may be left after the test."""
    made: list[Helpers] = []

    def make(code: str) -> Helpers:
        monkeypatch.setattr(warm_up, "START", code)
        made.append(Helpers(["top_view"]))
        return made[-1]

    yield make
    assert all(not each.running for each in made)


HANGS = "import time; time.sleep(600)"


def test_a_helper_that_hangs_is_killed(helpers: Callable[[str], Helpers], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_up, "MIN_WAIT_S", 0.1)
    with helpers(HANGS) as running:
        (process,) = running.running
        running.wait()
        assert process.returncode is not None
        assert process.returncode != 0


def test_a_helper_that_fails_is_reported(helpers: Callable[[str], Helpers], caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="edgeperc.warm_up")
    with helpers("raise SystemExit(3)") as running:
        running.wait()
    assert "ended with 3; they are compiled here" in caplog.text


@pytest.mark.parametrize("raised", [KeyboardInterrupt, MemoryError, SystemExit])
def test_no_helper_is_left_where_construction_is_interrupted(
    helpers: Callable[[str], Helpers], raised: type[BaseException]
) -> None:
    processes = []

    def interrupted() -> None:
        with helpers(HANGS) as running:
            processes.extend(running.running)
            raise raised

    with pytest.raises(raised):
        interrupted()
    (process,) = processes
    assert process.returncode is not None
    assert process.stdin.closed


def test_what_cannot_start_is_reported(
    helpers: Callable[[str], Helpers], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", logger="edgeperc.warm_up")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python3"))
    with helpers(HANGS) as running:
        assert not running.running
        running.wait()
    assert "no helper process" in caplog.text


@pytest.mark.parametrize(
    ("name", "value"), [*product(["executable"], ["/usr/bin/robot", "/opt/uwsgi", "", None]), ("frozen", True)]
)
def test_an_application_that_embeds_python_or_is_frozen_is_not_started_again(
    helpers: Callable[[str], Helpers], monkeypatch: pytest.MonkeyPatch, name: str, value: object
) -> None:
    monkeypatch.setattr(sys, name, value, raising=name != "frozen")
    monkeypatch.setattr(multiprocessing.spawn, "get_executable", lambda: sys.executable)
    with helpers(HANGS) as running:
        assert not running.running


@pytest.mark.parametrize("n_cores", range(1, 7))
def test_helpers_share_the_work(cold: None, monkeypatch: pytest.MonkeyPatch, n_cores: int) -> None:
    monkeypatch.setattr(warm_up, "usable_cores", lambda: n_cores)
    helpers = Helpers([*PARTS])
    assert len(helpers.shares) == min(n_cores - 1, 3)
    parts = [*helpers.own_parts, *(part for share in helpers.shares for part in share)]
    assert sorted(parts) == sorted(PARTS)
    seconds = [sum(PARTS[part].seconds for part in share) for share in (helpers.own_parts, *helpers.shares)]
    seconds[0] += warm_up.OTHERS_S
    assert max(seconds) <= {1: 23.0, 2: 12.0}.get(n_cores, 8.5)


def test_no_helper_where_the_cache_cannot_be_written_or_holds_the_kernels(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(warm_up, "usable_cores", lambda: 2)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "new" / "cache"))
    cache = PARTS["top_view"].largest._cache
    assert Helpers(["top_view"]).shares == [["top_view"]]
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "file"))
    assert Helpers(["top_view"]).shares == []
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    folder = next(cache.folders())
    folder.mkdir(0o755, parents=True)
    file = folder / f"{cache.name}-0123456789abcdef.kernel"
    for content, is_cold in ((b"", True), (bytes(64), True), (bytes(32) + cache.stamp(), False)):
        file.write_bytes(content)
        assert bool(Helpers(["top_view"]).shares) is is_cold


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="/proc shows which files a process has open")
def test_a_helper_inherits_no_files(helpers: Callable[[str], Helpers], tmp_path: Path) -> None:
    with (tmp_path / "mine").open("wb") as mine:
        os.set_inheritable(mine.fileno(), True)
        with helpers(HANGS) as running:
            (process,) = running.running
            opened = [each.readlink() for each in Path(f"/proc/{process.pid}/fd").iterdir()]
    assert len(opened) >= 3
    assert not [path for path in opened if path.is_relative_to(tmp_path)]


def _help_once() -> None:
    warm_up.is_cold = lambda _: True  # type: ignore[assignment]
    warm_up.usable_cores = lambda: 2
    warm_up.START = "raise SystemExit(0)"
    with Helpers(["top_view"]) as running:
        assert running.running
        running.wait()


def test_a_daemonic_process_has_helpers_too() -> None:
    process = multiprocessing.get_context("spawn").Process(target=_help_once, daemon=True)
    process.start()
    process.join(120)
    assert process.exitcode == 0


PARENT = """
import signal, time
from edgeperc import warm_up
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
warm_up.is_cold = lambda _: True
warm_up.usable_cores = lambda: 2
warm_up.START = '''
import sys, time
sys.path[:] = sys.argv[2:]
from edgeperc import warm_up
warm_up.PARTS = {"top_view": warm_up.Part(lambda: time.sleep(600), None, 1.0)}
warm_up.main(sys.argv[1])
'''
with warm_up.Helpers(["top_view"]) as running:
    print(running.running[0].pid, flush=True)
    while True:
        time.sleep(0.1)  # a signal that arrives just before a sleep does not end it
"""


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(os.name != "posix", reason="the test looks for processes as POSIX does")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT] if os.name == "posix" else [])
def test_no_helper_outlives_a_process_that_is_killed(how: signal.Signals) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as parent:
        try:
            helper = int(parent.stdout.readline())
            assert _is_running(helper)
            parent.send_signal(how)
            parent.wait(60)
        finally:
            parent.kill()
    until = time.monotonic() + 60.0
    while _is_running(helper) and time.monotonic() < until:
        time.sleep(0.05)
    assert not _is_running(helper)


def test_a_helper_ends_in_any_case(monkeypatch: pytest.MonkeyPatch) -> None:
    code = """
import sys, time
from edgeperc import warm_up
warm_up.MAX_S = 0.2
warm_up.PARTS = {"top_view": warm_up.Part(lambda: time.sleep(600), None, 1.0)}
warm_up.main("top_view")
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE) as process:
        try:
            assert process.wait(120) != 0
        finally:
            process.kill()


def test_garbage_is_collected_as_before_afterwards() -> None:
    before: Any = gc.get_threshold()
    with fewer_collections():
        with fewer_collections():
            assert gc.get_threshold()[0] == RARE
        assert gc.get_threshold()[0] == RARE
    assert gc.get_threshold() == before
    try:
        gc.set_threshold(0)
        with fewer_collections():
            assert gc.get_threshold()[0] == 0
    finally:
        gc.set_threshold(*before)


def test_labels_to_compile_with_are_those_of_the_network() -> None:
    """Of a network of trucks alone, kernels read beyond their tables: it could be opened now and then."""
    network = SimpleNamespace(card=SimpleNamespace(classes=("background", "truck")))
    points, labels = warm_up.car_and_person()
    points[:, 3] = labels.labels
    rehearsed = warm_up.RehearsedRange(cast(Any, network)).label(points, None, Stopwatch())
    assert {*rehearsed.labels.tolist()} == {0, 1}
