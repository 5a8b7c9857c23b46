"""Perceivers in processes: fork, spawn, signals, full disks, missing homes. Each behavior is described in the
documentation, in "Embed edgeperc in a process".
"""

from __future__ import annotations

import copy
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from checkout import printed
from cli_helpers import run
from edgeperc import EdgepercError, Perceiver
from edgeperc.inference.providers import available_providers
from edgeperc.inference.session import Session
from edgeperc.simulation import random_scene, simulate
from waiting import until

posix = pytest.mark.skipif(os.name != "posix", reason="forks, signals and limits differ elsewhere")


@pytest.fixture(scope="module")
def scan() -> NDArray[np.float32]:
    return simulate(random_scene(5), "hdl-64e", 5).points


@pytest.fixture
def folder(scan: NDArray[np.float32], tmp_path: Path) -> Path:
    """A folder with two scans of a fifth of the points."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for k in range(2):
        scan[::5].tofile(folder / f"{k:06d}.bin")
    return folder


def python(code: str, *arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run Python; a process that hangs fails the test."""
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


FORK = """
import json, os, sys, threading, warnings
import numpy as np
import edgeperc
from edgeperc.inference import session as sessions

warnings.simplefilter("ignore")
sessions.usable_cores = lambda: 2
scan = np.random.default_rng(0).normal(0.0, 10.0, (20_000, 4)).astype(np.float32)
scan[:, 2] = -1.7

def labels(found):
    return [view.labels.tobytes() for view in (found.points, found.top_view) if view is not None]

def fork(when, options):
    perceive = edgeperc.Perceiver(on_mismatch="ignore", **{"models": "pointseg", **options})
    right = labels(perceive(scan))
    assert len(right) == len(perceive.sessions)
    assert all(each.shares_cores for each in perceive.sessions) == (len(right) == 2)
    session = perceive.sessions[0]
    begun, finish = threading.Event(), threading.Event()
    real = session.inference

    class Slow:
        def run_with_iobinding(self, binding):
            begun.set()
            finish.wait()
            real.run_with_iobinding(binding)

    if when == "in a call":
        session.inference = Slow()
        thread = threading.Thread(target=perceive, args=(scan,))
        thread.start()
        begun.wait()
    elif when == "under the lock":
        held = perceive._calls.one()
        held.__enter__()
    child = os.fork()
    if child == 0:
        session.inference = real
        try:
            print("equal" if labels(perceive(scan)) == right else "different")
        except edgeperc.InferenceError as error:
            print(error)
        sys.stdout.flush()
        os._exit(0)
    os.waitpid(child, 0)
    if when == "in a call":
        finish.set()
        thread.join()
    elif when == "under the lock":
        held.__exit__(None, None, None)
    assert labels(perceive(scan)) == right

for case in json.loads(sys.argv[1]):
    fork(*case)
"""


@posix
def test_a_fork_works_without_threads_and_is_refused_at_once_where_it_cannot_work() -> None:
    works: list[tuple[str, dict[str, Any]]] = [
        ("between calls", {"provider": "cpu", "n_threads": 1}),
        ("under the lock", {"provider": "cpu", "n_threads": 1}),
        ("between calls", {"provider": "cpu", "models": ["ssadnet", "pointseg"]}),  # at once, with a thread for each
    ]
    refused: list[tuple[str, dict[str, Any]]] = [
        ("in a call", {"provider": "cpu", "n_threads": 1}),
        ("between calls", {"provider": "cpu", "n_threads": 2}),
        ("between calls", {"provider": "cpu"}),
        ("between calls", {"provider": "openvino", "n_threads": 1}),
    ]
    refused = [case for case in refused if case[1]["provider"] in available_providers()]
    answers = printed(FORK, json.dumps([*works, *refused]), timeout=120).splitlines()
    assert answers[: len(works)] == ["equal"] * len(works)
    why = "construct the Perceiver in the process that calls it"
    assert [why in answer for answer in answers[len(works) :]] == [True] * len(refused)


MADE = """
import gc, multiprocessing, os, sys, threading, time, warnings
import numpy as np
import edgeperc

warnings.simplefilter("ignore")
scan = np.random.default_rng(0).normal(0.0, 10.0, (20_000, 4)).astype(np.float32)

def make(n_threads):
    perceive = edgeperc.Perceiver("pointseg", provider="cpu", n_threads=n_threads, on_mismatch="ignore")
    perceive(scan)
    return perceive
"""
END = f"""{MADE}
perceive = make(2)
for how in ("exit", "dropped", "forked again", "with its own", "cyclic"):
    child = os.fork()
    if child == 0:
        if how == "dropped":
            del perceive
            gc.collect()
        elif how == "forked again" and os.fork():
            os.wait()
        elif how == "with its own":
            perceive = make(2)
        elif how == "cyclic":
            cycle = [perceive]
            cycle.append(cycle)
            del perceive, cycle
            gc.collect()
        print(how, flush=True)
        sys.exit(0)
    _, status = os.waitpid(child, 0)
    assert status == 0, (how, status)
process = multiprocessing.get_context("fork").Process(target=print, args=("multiprocessing",))
process.start()
process.join()
sys.exit(process.exitcode)
"""


@posix
def test_a_fork_ends() -> None:
    """Its copies of threads, of which there are none, are not waited for."""
    hows = ["exit", "dropped", "forked again", "forked again", "with its own", "cyclic", "multiprocessing"]
    assert printed(END, timeout=120).splitlines() == hows


DAEMON = f"""{MADE}
def perceive_until_the_end():
    perceive = make(1)
    begun = threading.Event()

    def work():
        while True:
            begun.set()
            perceive(scan)

    threading.Thread(target=work, daemon=True).start()
    begun.wait()

make(1)  # imports what is needed, and is gone
*others_s, wait_s = 0.0, 0.007, 0.017
for other_s in others_s if hasattr(os, "fork") else ():
    child = os.fork()
    if child == 0:
        wait_s = other_s
        break
    _, status = os.waitpid(child, 0)
    assert status == 0, (other_s, status)
perceive_until_the_end()
time.sleep(wait_s)
"""

IN_A_CALL = """
import atexit, os, sys, threading, time
from edgeperc.system.interpreter import native_call

begun = threading.Event()

def work():
    with native_call():
        begun.set()
        time.sleep(0.5)
        os.write(1, b"call ended\\n")
    with native_call():
        os.write(1, b"never\\n")

def at_the_end():
    with native_call():
        os.write(1, b"at the end\\n")

if sys.argv[1] == "fork" and os.fork():
    os.wait()
else:
    atexit.register(at_the_end)  # runs after what edgeperc does at the end
    threading.Thread(target=work, daemon=True).start()
    begun.wait()
    if sys.argv[1] == "fork, in the call" and os.fork():
        os.wait()
"""


@pytest.mark.parametrize("how", ["plain", "fork", "fork, in the call"] if os.name == "posix" else ["plain"])
def test_the_interpreter_ends_after_a_call(how: str) -> None:
    """That of a daemon thread; another one never begins, but in the main thread. A fork waits for no call of others."""
    done = python(IN_A_CALL, how)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    lines = ["call ended", "at the end"]
    assert done.stdout.splitlines() == (["at the end", *lines] if how == "fork, in the call" else lines)


def test_a_daemon_thread_in_a_call_ends_with_the_interpreter() -> None:
    """Whatever it does then. Forks that have a perceiver of their own stand for other processes."""
    printed(DAEMON, timeout=120)


def test_perceivers_are_not_pickled_or_copied() -> None:
    perceive = Perceiver("pointseg", provider="cpu", n_threads=1)
    for thing in (perceive, perceive.sessions[0]):
        for attempt in (pickle.dumps, copy.copy, copy.deepcopy):
            with pytest.raises(EdgepercError, match="cannot be pickled or copied; construct"):
                attempt(thing)


SPAWN = """
import multiprocessing, sys, warnings
import numpy as np

def work(scan):
    import edgeperc
    warnings.simplefilter("ignore")
    perceive = edgeperc.Perceiver("pointseg", provider="cpu", n_threads=1, on_mismatch="ignore")
    return perceive(scan).points.labels

if __name__ == "__main__":
    import edgeperc
    perceive = edgeperc.Perceiver("pointseg", provider="cpu", n_threads=1, on_mismatch="ignore")
    scan = np.ones((100, 4), np.float32)
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        assert (pool.apply(work, (scan,)) == perceive(scan).points.labels).all()
"""


def test_spawned_processes_construct_their_own(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SPAWN)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_a_failed_run_is_not_a_running_one(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session("pointseg", "cpu", n_threads=1)
    real = session.inference

    class Broken:
        def run_with_iobinding(self, _: object) -> None:
            raise RuntimeError("no memory")

    session.inference = Broken()
    with pytest.raises(EdgepercError, match="no memory"):
        session.run()
    session.inference = real
    monkeypatch.setattr(os, "getpid", lambda: 1)  # as in a child
    session.run()


QUIET = ["--provider", "cpu", "--threads", "1", "--on-mismatch", "ignore"]


def edgeperc_run(*arguments: object, limit: Callable[[], None] = lambda: None, **options: Any) -> subprocess.Popen[str]:
    def with_signals() -> None:  # a shell starts programs in the background with SIGINT ignored
        signal.signal(signal.SIGINT, signal.default_int_handler)
        limit()

    # -B, because Python would keep the half of a .pyc file that is larger than a limit, and fail with it from then on.
    command = [sys.executable, "-B", "-m", "edgeperc", "run", *map(str, arguments)]
    command += QUIET
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options
    return subprocess.Popen(command, preexec_fn=with_signals, **options)


def children(pid: int) -> list[int]:
    return [int(child) for file in Path(f"/proc/{pid}/task").glob("*/children") for child in file.read_text().split()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="no /proc")
@pytest.mark.parametrize(("number", "code"), [(15, 143), (9, -9)])  # SIGTERM, SIGKILL
def test_a_signal_ends_the_process_that_decodes_a_capture(tmp_path: Path, number: int, code: int) -> None:
    pytest.importorskip("rosbags")
    from test_captures import write_bag2

    process = edgeperc_run(write_bag2(tmp_path / "bag"), "--live", "--model", "pointseg")
    try:
        until(lambda: children(process.pid) or process.poll() is not None)
        decoders = children(process.pid)
        assert decoders, process.communicate()
    finally:
        process.send_signal(number)
        process.communicate(timeout=120)
    assert process.returncode == code
    lines = [Path(f"/proc/{pid}/cmdline") for pid in decoders]
    until(lambda: not any(line.exists() and line.read_bytes() for line in lines))


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """Files have a greatest size here, as with a quota."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)  # as -B above
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)


def check_failed(code: int, printed: tuple[str, str], out: Path, reason: str) -> None:
    """Each scan has its error, on one line, the same reason once, and no part of a file is left."""
    records, errors = printed
    assert code == 1, errors
    assert f"{reason}: '{out}/" in errors
    assert "Traceback" not in errors
    assert [reason in json.loads(line)["error"] for line in records.splitlines()] == [True, True]
    first, second = (line for line in errors.splitlines() if ".bin" in line)
    assert reason in first
    assert f": the same as {first.split(': ')[1]}" in second
    assert not [file for file in out.rglob("*") if file.is_file() and file.name != "filler"]


@posix
@pytest.mark.parametrize("kind", ["--labels", "--ply", "--html", "--png"])
def test_files_that_are_too_large_fail_their_scan(
    folder: Path, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if kind == "--png":
        pytest.importorskip("matplotlib")
    with files_up_to(4096):
        code = run("run", folder, "--json", "--model", "pointseg", kind, "--out", tmp_path / "out", *QUIET)
    check_failed(code, capsys.readouterr(), tmp_path / "out", "File too large")


def test_full_disk_fails_its_scan(
    folder: Path, small_disk: Callable[[int], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    out = small_disk(64)
    (out / "filler").write_bytes(bytes(40 << 10))
    code = run("run", folder, "--json", "--model", "pointseg", "--labels", "--out", out, *QUIET)
    check_failed(code, capsys.readouterr(), out, "No space left on device")


WHOLE_RUN = {
    "bag": ("--bag bag", "rosbags"),
    "mcap": ("--mcap run.mcap", "foxglove"),
    "rrd": ("--rrd run.rrd", "rerun"),
    "page": ("--play run.html", None),
    "cvat": ("--labels-for cvat --out labels", None),
    "static": ("--static static --movable", None),
    "labelcloud": ("--labels-for labelcloud --out labels", None),
    "kitti": ("--labels-for kitti --out labels", None),
    "gif": ("--track --gif --out pictures", "matplotlib"),
}
"""Options of what is written of a whole run, and what each needs."""

SMALL = ("kitti", "labelcloud", "cvat")
"""Those whose files are smaller than the limit."""

THREADED = ("mcap", "rrd")
"""Those that a library writes in threads of its own: each needs a process that ends."""


@posix
@pytest.mark.parametrize(
    ("sink", "limit"), [(sink, limit) for sink in WHOLE_RUN for limit in (0, 1500) if not (limit and sink in SMALL)]
)
@pytest.mark.filterwarnings("ignore:.*was not written to its end:RuntimeWarning")
def test_what_cannot_be_written_is_said_and_is_no_result(
    folder: Path,
    tmp_path: Path,
    sink: str,
    limit: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of any error of writing."""
    resource = pytest.importorskip("resource")
    options, package = WHOLE_RUN[sink]
    if package is not None:
        pytest.importorskip(package)
    out = tmp_path / "out"
    out.mkdir()
    largest = (limit, resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    if sink in THREADED:
        process = edgeperc_run(
            folder,
            "--json",
            *options.split(),
            cwd=out,
            limit=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, largest),
        )
        records, errors = process.communicate(timeout=120)
        code = process.returncode
    else:
        monkeypatch.chdir(out)
        with files_up_to(limit):
            code = run("run", folder, "--json", *options.split(), *QUIET)
        records, errors = capsys.readouterr()
    assert code in (1, 2), errors  # 2: before the first scan
    assert "Traceback" not in errors
    assert "Errno" in errors
    assert len(records.splitlines()) == (2 if code == 1 else 0)
    left = [file.relative_to(out) for file in out.rglob("*") if file.is_file()]
    assert all(".part" in str(file) and not str(file).startswith(".") for file in left)


@pytest.mark.parametrize("append", [False, True])
def test_lines_that_do_not_fit_leave_no_half(
    folder: Path, small_disk: Callable[[int], Path], append: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """A result that cannot be printed is an error of its scan; what is printed has whole lines."""
    disk = small_disk(64)
    lines = disk / "lines.jsonl"
    with lines.open("a" if append else "w") as stdout, redirect_stdout(stdout):
        if append:
            print("{}", flush=True)
        (disk / "filler").write_bytes(bytes(56 << 10))
        scans = [folder / f"copy{k}.bin" for k in range(12)]
        for copy in scans:
            copy.hardlink_to(folder / "000000.bin")
        code = run("run", *scans, "--json", "--model", "pointseg", *QUIET)
    errors = capsys.readouterr().err
    assert code == 1, errors
    assert "Traceback" not in errors
    assert "cannot be printed: [Errno 28] No space left on device" in errors
    held = lines.read_bytes()
    assert held.endswith(b"\n")
    records = [json.loads(line) for line in held.splitlines()]
    assert records[0] == {} or not append
    assert 2 <= len(records) < 12


@posix
@pytest.mark.parametrize(("number", "code"), [(2, 130), (15, 143), (9, -9)])  # SIGINT, SIGTERM, SIGKILL
def test_a_signal_leaves_whole_files_and_an_older_run_as_it_is(
    scan: NDArray[np.float32], tmp_path: Path, number: int, code: int
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    options, targets = ["--labels --ply --out ."], set()
    if number != 9:  # a killed process also leaves what it has of a whole run
        options.append("--play run.html --labels-for cvat")
        targets = {"run.html", "annotations.zip"}
        for name in ("mcap", "rrd"):
            if find_spec(str(WHOLE_RUN[name][1])):
                options.append(WHOLE_RUN[name][0])
                targets.add(f"run.{name}")
    for name in targets:
        (out / name).write_bytes(b"of an older run")
    scans = [tmp_path / "scan.bin"]
    scan.tofile(scans[0])
    for k in range(300):
        scans.append(tmp_path / f"copy{k}.bin")
        scans[-1].hardlink_to(scans[0])
    process = edgeperc_run(*scans, "--model", "pointseg", *" ".join(options).split(), cwd=out)
    for _ in range(3):
        assert process.stdout.readline()
    time.sleep(0.05)
    process.send_signal(number)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == code, errors
    assert "Traceback" not in errors
    assert errors.count(" was not written to its end; ") == len(targets)
    assert all((out / name).read_bytes() == b"of an older run" for name in targets)
    others = [file for file in out.iterdir() if file.name not in targets | {f"{name}.part" for name in targets}]
    labels, clouds = ([file for file in others if file.suffix == suffix] for suffix in (".label", ".ply"))
    assert 3 <= len(labels) < 300
    assert {file.stat().st_size for file in labels} == {4 * len(scan)}
    assert len({file.stat().st_size for file in clouds}) == 1
    # A process that is killed cannot delete the file that it is writing; it has no name of a result.
    others = [file for file in others if file not in (*labels, *clouds)]
    assert [file.suffix for file in others] in ([[], [".part"]] if number == 9 else [[]])
    assert all((out / f"{name}.part").exists() for name in targets)


HOMES = ("HOME", "USERPROFILE", "LOCALAPPDATA", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME")
WITHOUT_PASSWD = """
import sys
try:
    import pwd
    def getpwuid(uid):
        raise KeyError(uid)
    pwd.getpwuid = getpwuid
except ImportError:
    pass
from edgeperc.cli import main
sys.exit(main(["models"]) or main(sys.argv[1:]))
"""


def nothing(_: Path) -> dict[str, str]:
    return {}


def read_only(folder: Path) -> dict[str, str]:
    """Homes that cannot be made, because a file is in their place; permissions would not stop root."""
    (folder / "file").write_bytes(b"")
    return dict.fromkeys(HOMES, str(folder / "file" / "home"))


@pytest.mark.parametrize("home", [nothing, read_only])
def test_without_a_home_everything_works(folder: Path, tmp_path: Path, home: Callable[[Path], dict[str, str]]) -> None:
    kept = {name: value for name, value in os.environ.items() if name not in (*HOMES, "EDGEPERC_CACHE_DIR")}
    arguments = ["run", str(folder), "--json", "--model", "pointseg", "--labels", "--out", str(tmp_path / "out")]
    done = python(WITHOUT_PASSWD, *arguments, env=kept | home(tmp_path), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    models, records = (done.stdout.splitlines()[part] for part in (slice(-2), slice(-2, None)))
    assert len(models) >= 2
    assert not any("error" in json.loads(record) for record in records)
    assert len([*tmp_path.glob("out/*.label")]) == 2
    left = {"scans", "out", "file"}
    assert {file.name for file in tmp_path.iterdir()} <= left  # no folder "~" or ".cache"


def test_without_a_home_kernels_are_compiled_and_it_is_said(tmp_path: Path) -> None:
    """Of a package that cannot be written, too."""
    import numba

    if numba.config.DISABLE_JIT:
        pytest.skip("nothing is compiled with the JIT off")
    package = Path(sys.modules["edgeperc"].__file__ or "").parent
    shutil.copytree(package, tmp_path / "edgeperc", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "edgeperc" / "types" / "__pycache__").write_bytes(b"")
    code = WITHOUT_PASSWD.partition("from edgeperc")[0] + (
        "import numpy as np\n"
        "from edgeperc.types.geometry import oriented_iou\n"
        "print(oriented_iou(np.ones((1, 5)), np.ones((1, 5))))\n"
    )
    kept = {name: value for name, value in os.environ.items() if name not in (*HOMES, "EDGEPERC_CACHE_DIR")}
    kept = {name: value for name, value in kept.items() if not name.startswith("NUMBA_")}
    done = python(code, env=kept | {"PYTHONPATH": str(tmp_path)}, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "[[1.]]\n"), done.stderr
    (line,) = done.stderr.splitlines()
    assert "compiled kernels are not kept" in line
    assert str(tmp_path / "edgeperc" / "types" / "__pycache__") in line
