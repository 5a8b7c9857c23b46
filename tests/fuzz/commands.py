"""The command line: hostile names of files, values of options and contents, in a process forked from this one.

Allowed is a documented exit code with at most one line for each error; a traceback is a failure. A forked process runs
up to 100 commands, because a fork takes longer than most of them. They share the parser and the session of a model, and
captures are decoded in a process forked from theirs. Every 1000th case starts a process as a shell does, and shares
nothing.
"""

from __future__ import annotations

import functools
import io
import json
import os
import re
import select
import signal
import subprocess
import sys
import traceback
from contextlib import redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from typing import Any, NoReturn
from unittest import mock

import numpy as np

import edgeperc.perceiver as perceiver_module
from edgeperc.cli import main
from edgeperc.inference.session import Session
from edgeperc.readers import apart
from edgeperc.types.sensor import SENSORS

from .arrays import base_scan
from .captures import LIBRARIES, Forked
from .mutate import mutated_bytes, mutated_json, noise
from .running import Case, check, peak_mb, reset_peak
from .scans import MadeUp, cards, perceiver_of
from .tiny import GRAPH, model

LIMIT_S, LIMIT_MB = 30.0, 2500.0
CODES = {0, 1, 2, 130, 141, 143}
MODEL = "lodnn:int8"
SHARES = {
    "run": 50, "info": 30, "sensors": 20, "models": 20, "eval-tracking": 10, "fit-sensor": 10, "demo": 1, "": 10,
    "--x": 10,
}  # fmt: skip
COMMANDS = [command for command, share in SHARES.items() for _ in range(share)]
NEW_PROCESS_EVERY = 1000
COMMANDS_OF_A_FORK = 100

NAMES = [
    "scan.bin", "a b.bin", "-x.bin", "--json", "$(id).bin", ";ls.bin", "\n.bin", "\x1b[31m.bin", "ä☃.bin", "..bin",
    "%s.bin",
    "x" * 250 + ".bin", "\udcff.bin", "scan.pcap", "scan.onnx", "scan.npy", "scan.mcap", "scan.osf", "<script>.ply",
    "'\".bin", "con.bin", "scan", ".hidden.bin", "*.bin", "~.bin", "scan.bag", "scan.pcd",
]  # fmt: skip
STRANGE = [
    "", "-1", "0", "1e309", "nan", "9" * 400, "\0", "x" * 5000, "cpu", "pointseg", "lodnn:int8", "/dev/null",
    "/dev/zero", "/proc/self/mem", "/", ".", "..", "∞", "\udcff", "%n", "{0}", "both", "--", "vlp-16",
    "/nonexistent/x.json",
]  # fmt: skip
OPTIONS = [
    "--json", "--out", "--png", "--html", "--labels", "--ply", "--track", "--sensor", "--model", "--provider",
    "--precision", "--threads", "--topic", "--on-mismatch", "--adapt", "--boxes-from", "--full-turn", "--rate",
    "--trusted", "--anyway", "--mount-height", "--roll", "--pitch", "--turn",
]  # fmt: skip
USUAL = {
    "--sensor": [*SENSORS], "--model": ["lodnn"], "--on-mismatch": ["warn", "ignore"], "--provider": ["cpu", "auto"],
    "--precision": ["auto", "fp32"], "--threads": ["1"], "--adapt": ["none", "both"], "--boxes-from": ["network"],
    "--rate": ["10"], "--mount-height": ["1.5"], "--roll": ["-2"], "--pitch": ["3"], "--turn": ["90"],
}  # fmt: skip
TAKE_NONE = {"--json", "--png", "--html", "--labels", "--ply", "--track", "--full-turn", "--trusted", "--anyway"}


class Commands:
    """The kind ``commands``."""

    name, limit_s, limit_mb = "commands", LIMIT_S, LIMIT_MB
    process: Server | None = None

    def run(self, case: Case) -> str:
        files = [self.file(case) for _ in range(int(case.rng.integers(1, 3)))]
        arguments = self.arguments(case, [f for f in files if f])
        case.evidence["arguments.txt"] = repr(arguments).encode()
        if any("\0" in a for a in arguments):
            arguments = [a.replace("\0", "") for a in arguments] if case.chance(0.9) else arguments
        if case.index % NEW_PROCESS_EVERY == NEW_PROCESS_EVERY - 1:
            code, text = self.in_new_process(case, arguments)
        else:
            code, text = self.forked(case, arguments)
        check("Traceback" not in text, f"a traceback: {text[-1500:]}")
        check(code in CODES, f"exit code {code}: {text[-500:]}")
        check("\x1b" not in text, "an escape sequence is printed as it came")
        return f"{arguments[0][:20] if arguments and arguments[0] in SHARES else 'other'}: exit {code}"

    def file(self, case: Case) -> str:
        """A file with such a name: a scan, a model, a profile, noise; or a folder, a pipe, nothing."""
        path = case.folder / case.pick(NAMES)
        way = int(case.rng.integers(12))
        try:
            if path.exists():  # perhaps a pipe, which would wait
                return str(path)
            if way <= 5:
                scan = base_scan(case).tobytes()
                path.write_bytes(scan if case.chance(0.7) else mutated_bytes(scan or b"x", case))
            elif way == 6:
                path.write_bytes(model(GRAPH) if case.chance(0.5) else mutated_bytes(model(GRAPH), case))
            elif way == 7:
                path.write_bytes(mutated_json({"name": "x", "schema": 1, "remission": {"kind": []}}, case))
            elif way == 8:
                path.write_bytes(noise(case))
            elif way == 9:
                path.mkdir()
            elif way == 10:
                os.mkfifo(path)
        except (OSError, UnicodeError):
            return ""
        return str(path)

    def arguments(self, case: Case, files: list[str]) -> list[str]:
        command = case.pick(COMMANDS)
        given = [command]
        if case.chance(0.9):
            given += files
        if command == "run" and case.chance(0.9):
            given += ["--model", MODEL, "--provider", "cpu", *(["--anyway"] if case.chance(0.7) else [])]
        most = 4 if command == "run" or case.chance(0.1) else 1
        for _ in range(int(case.rng.integers(0, most))):
            option = case.pick(OPTIONS)
            given.append(option)
            if option == "--out":
                given.append(str(case.folder / "out") if case.chance(0.7) else case.pick(["/proc/x", "\udcff", ""]))
            elif option not in TAKE_NONE or case.chance(0.02):
                known = USUAL.get(option)
                given.append(case.pick(known) if known and case.chance(0.6) else case.pick([*STRANGE, *files]))
        if case.chance(0.1):
            given.insert(int(case.rng.integers(len(given) + 1)), case.pick(STRANGE))
        return given

    def forked(self, case: Case, arguments: list[str]) -> tuple[int, str]:
        if self.process is None:
            self.process = Server()
        process = self.process
        process.requests.write(json.dumps([arguments, str(case.folder)]).encode() + b"\n")
        process.requests.flush()
        ready, _, _ = select.select([process.replies], [], [], LIMIT_S - 5.0)
        reply = process.replies.readline() if ready else b""
        process.n_commands += 1
        if not reply or process.n_commands == COMMANDS_OF_A_FORK:
            code, self.process = process.end(), None
            check(ready, f"does not end: {arguments}")
            if not reply:
                return code, ""
        code, text, case.peak_mb = json.loads(reply)
        return code, text

    def in_new_process(self, case: Case, arguments: list[str]) -> tuple[int, str]:
        try:
            command = [sys.executable, "-m", "edgeperc", *arguments]
            done = subprocess.run(
                command, cwd=case.folder, capture_output=True, timeout=LIMIT_S, stdin=subprocess.DEVNULL
            )
        except ValueError:  # a null byte, which no shell passes on
            return 2, ""
        except OSError as exc:  # too long
            return 2, str(exc)
        return done.returncode, (done.stdout + done.stderr).decode("utf-8", "replace")


class Server:
    """A process forked from this one, which runs commands."""

    def __init__(self) -> None:
        requests, self_out = os.pipe()
        self_in, replies = os.pipe()
        self.n_commands = 0
        self.pid = os.fork()
        if self.pid == 0:
            os.close(self_in)
            os.close(self_out)
            _serve(requests, replies)
        os.close(requests)
        os.close(replies)
        self.requests, self.replies = os.fdopen(self_out, "wb"), os.fdopen(self_in, "rb")

    def end(self) -> int:
        """Kill the process, unless it has ended by itself; its exit code."""
        self.replies.close()
        with suppress(BrokenPipeError):
            self.requests.close()
        os.kill(self.pid, signal.SIGKILL)
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def _serve(requests: int, replies: int) -> NoReturn:
    """Run the commands that are asked for, until there are no more."""
    try:
        null = os.open(os.devnull, os.O_RDWR)
        for descriptor in range(3):
            os.dup2(null, descriptor)
        with os.fdopen(requests, "rb") as lines, os.fdopen(replies, "wb", 0) as out:
            for line in lines:
                arguments, folder = json.loads(line)
                os.chdir(folder)
                reset_peak()
                code, text = _run(arguments)
                out.write(json.dumps([code, text, peak_mb()]).encode() + b"\n")
    finally:
        os._exit(98)


def _run(arguments: list[str]) -> tuple[int, str]:
    text = io.StringIO()
    code: Any = 99
    with redirect_stdout(text), redirect_stderr(text):
        try:
            code = main(arguments)
        except SystemExit as exc:
            code = exc.code if isinstance(exc.code, int) else 0 if exc.code is None else 2
        except BaseException:
            text.write(traceback.format_exc())
    return code, re.sub(r"\s+$", "", text.getvalue())


# Imported before the processes are forked, which would each spend 0.1 s on them.
IMPORTED = (
    "edgeperc.evaluation.tracking", "edgeperc.inference.listing", "edgeperc.readers.captures",
    "edgeperc.readers.images", "edgeperc.simulation.samples", "numba.np.arraymath", "onnxruntime",
)  # fmt: skip


def make(seed: int) -> Commands:
    for name in (*IMPORTED, *LIBRARIES):
        with suppress(ModuleNotFoundError):  # of an extra
            import_module(name)
    # The kernels are compiled once, not in each process; a network's threads would not survive the fork.
    for each in cards()[:8:5]:
        perceiver_of(*map(MadeUp, each), on_mismatch="ignore")(np.zeros((3, 4), np.float32))
    made_once = functools.cache(Session)

    def session(model: str, *arguments: Any, **options: Any) -> Session:
        return (made_once if model == MODEL else Session)(model, *arguments, **options)

    # For the rest of this process: a parser takes 4 ms, a session 25 ms, a process that decodes captures 0.2 s.
    main_module = import_module("edgeperc.cli.main")  # the package's name `main` is the function
    mock.patch.object(main_module, "build_parser", functools.cache(main_module.build_parser)).start()
    mock.patch.object(perceiver_module, "Session", session).start()
    mock.patch.object(apart, "start_process", Forked).start()
    return Commands()
