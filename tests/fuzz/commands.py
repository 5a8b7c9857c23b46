"""The command line: hostile names of files, values of options and contents, in a process forked for each case.

Allowed is a documented exit code with at most one line for each error; a traceback is a failure. Every 20th case starts
a process of its own, as a shell does.
"""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import time
import traceback
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import edgeperc.perceiver as perceiver_module
from edgeperc import Perceiver
from edgeperc.cli import main
from edgeperc.sensor import SENSORS

from .arrays import base_scan
from .mutate import mutated_bytes, mutated_json, noise
from .running import Case, check
from .scans import MadeUp, cards
from .tiny import GRAPH, model

__all__ = ["LIMIT_MB", "LIMIT_S", "Commands", "make"]

LIMIT_S, LIMIT_MB = 30.0, 2500.0
CODES = {0, 1, 2, 130, 141, 143}
NEW_PROCESS_EVERY = 20

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
    "--trusted", "--anyway", "--mount-height", "--turn",
]  # fmt: skip
USUAL = {
    "--sensor": [*SENSORS], "--model": ["lodnn"], "--on-mismatch": ["warn", "ignore"], "--provider": ["cpu", "auto"],
    "--precision": ["auto", "fp32"], "--threads": ["1"], "--adapt": ["none", "both"], "--boxes-from": ["network"],
    "--rate": ["10"], "--mount-height": ["1.5"], "--turn": ["90"],
}  # fmt: skip
TAKE_NONE = {"--json", "--png", "--html", "--labels", "--ply", "--track", "--full-turn", "--trusted", "--anyway"}


class Commands:
    """The kind ``commands``."""

    name, limit_s, limit_mb = "commands", LIMIT_S, LIMIT_MB

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
        return f"{arguments[0][:20] if arguments and arguments[0] in self.known else 'other'}: exit {code}"

    known = ("run", "info", "sensors", "models", "demo", "eval-tracking", "fit-sensor")

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
        command = case.pick(["run", "run", "run", "run", "info", "info", "sensors", "models", *self.known, "", "--x"])
        given = [command]
        if case.chance(0.9):
            given += files
        if command == "run" and case.chance(0.9):
            given += ["--model", "lodnn:int8", "--provider", "cpu", *(["--anyway"] if case.chance(0.7) else [])]
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
        output = case.folder.parent / f"{case.folder.name}.txt"
        pid = os.fork()
        if pid == 0:
            _be_command(arguments, case.folder, output)
        end = time.monotonic() + LIMIT_S - 5.0
        status = 0
        while True:
            done, status, usage = os.wait4(pid, os.WNOHANG)
            if done:
                case.peak_mb = usage.ru_maxrss / 1e3
                break
            if time.monotonic() > end:
                os.kill(pid, 9)
                os.waitpid(pid, 0)
                check(False, f"does not end: {arguments}")
            time.sleep(0.002)
        text = output.read_text("utf-8", "replace") if output.exists() else ""
        output.unlink(missing_ok=True)
        return os.waitstatus_to_exitcode(status), text

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


def _be_command(arguments: list[str], folder: Path, output: Path) -> None:
    """Run the command in this process and end it."""
    code: Any = 99
    text = io.StringIO()
    try:
        os.chdir(folder)
        null = os.open(os.devnull, os.O_RDWR)
        for descriptor in range(3):
            os.dup2(null, descriptor)
        with redirect_stdout(text), redirect_stderr(text):
            try:
                code = main(arguments)
            except SystemExit as exc:
                code = exc.code if isinstance(exc.code, int) else 0 if exc.code is None else 2
            except BaseException:
                text.write(traceback.format_exc())
        output.write_bytes(re.sub(r"\s+$", "", text.getvalue()).encode("utf-8", "replace"))
    finally:
        os._exit(code & 0xFF if isinstance(code, int) else 98)


# Imported before the processes are forked, which would each spend 0.1 s on them.
IMPORTED = (
    "edgeperc.evaluation.tracking", "edgeperc.listing", "edgeperc.readers.captures", "edgeperc.readers.images",
    "edgeperc.simulation.samples", "numba.np.arraymath", "onnxruntime",
)  # fmt: skip


def make(seed: int) -> Commands:
    for name in IMPORTED:
        import_module(name)
    # The kernels are compiled once, not in each process; a network's threads would not survive the fork.
    for each in cards()[:8:5]:
        made_up = [MadeUp(card) for card in each]
        with mock.patch.object(perceiver_module, "Session", side_effect=made_up):
            Perceiver([card.name for card in each], on_mismatch="ignore")(np.zeros((3, 4), np.float32))
    return Commands()
