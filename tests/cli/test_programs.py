"""The three programs print texts from outside safely, and end as a shell expects."""

from __future__ import annotations

import argparse
import importlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from edgeperc.cli.output import print_columns, print_error, print_line, print_rows, table_lines
from edgeperc.cli.program import Parser, run_program
from edgeperc.errors import PointsError
from edgeperc.system.printable import printable

PROGRAMS = ("edgeperc", "edgeperc-bench", "edgeperc-export")
ESCAPES = "a\x1b[2J\x1b]0;title\x07\x9b31m\x7f\u202egpj\u2066\u2028\x00b"
ANY = st.text(st.characters(exclude_categories=()))  # lone surrogates too
posix = pytest.mark.skipif(os.name != "posix", reason="signals and pipes differ elsewhere")


def is_safe(out: str) -> bool:
    return all(line.isprintable() for line in out.split("\n"))


@given(ANY)
@example("C:\\Straße 漢字 Ж é 😀 $x_1$ {0} %s")
def test_any_text_becomes_printable(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    shown.encode()
    assert printable(shown) == shown
    assert (shown == text) == text.isprintable()


@given(st.recursive(ANY | st.integers(), lambda inner: st.lists(inner) | st.dictionaries(ANY, inner), max_leaves=8))
def test_json_stays_the_same(value: Any) -> None:
    assert json.loads(printable(json.dumps(value))) == value


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[31m", "\\u001b[31m"),
        ("a\nb\r\tc", "a\\u000ab\\u000d\\u0009c"),
        ("\x9b\x7f", "\\u009b\\u007f"),
        ("\u202egpj.exe", "\\u202egpj.exe"),
        (os.fsdecode(b"\xff.bin"), "\\udcff.bin"),
        ("\U000e0041", "\\U000e0041"),
        (Path("a\x07"), "a\\u0007"),
    ],
)
def test_other_characters_are_shown_by_number(text: object, shown: str) -> None:
    assert printable(text) == shown


@given(st.text(st.characters(exclude_categories=()), min_size=1))
def test_every_way_to_print_is_safe(text: str) -> None:
    out, shown = io.StringIO(), sys.stdout
    sys.stdout, errors, sys.stderr = out, sys.stderr, out
    try:
        print_line(text)
        print_error(text)
        print_rows([(text, text), ("name", text)])
        print_columns((text, "b"), [(text, text)])
    finally:
        sys.stdout, sys.stderr = shown, errors
    lines = out.getvalue().split("\n")
    assert len(lines) == 2 + 2 + 2 + 1
    assert is_safe(out.getvalue())
    assert all(map(str.isprintable, table_lines("title", [(text, "k")], [((text, text), {"k": 0.5})])))


def test_columns_are_aligned_with_what_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    print_rows([("\x1b", "first"), ("name", "second")])
    print_columns(("a", "b"), [("\x1b\x1b", "first"), ("name", "second")])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].index("first") == lines[1].index("second")
    assert lines[3].index("first") == lines[4].index("second") == lines[2].index("b")


def test_a_parser_quotes_safely(capsys: pytest.CaptureFixture[str]) -> None:
    parser = Parser(prog="program")
    parser.add_subparsers(required=True).add_parser("command").add_argument("path")
    for given_arguments in (["command", "a", ESCAPES], [ESCAPES], ["command", "a", f"--{ESCAPES}"]):
        with pytest.raises(SystemExit) as caught:
            parser.parse_args(given_arguments)
        assert caught.value.code == 2
        assert is_safe(capsys.readouterr().err)
    assert isinstance(parser, argparse.ArgumentParser)


def test_errors_and_warnings_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def command() -> int:
        warnings.warn(f"careful\nwith {ESCAPES}", UserWarning, stacklevel=1)
        raise PointsError(f"{ESCAPES}\nis damaged")

    with warnings.catch_warnings():
        warnings.simplefilter("default")
        shown = warnings.showwarning
        assert run_program("program", command) == 2
        assert warnings.showwarning is shown
    captured = capsys.readouterr()
    assert captured.out == ""
    assert is_safe(captured.err)
    assert [line.split()[:2] for line in captured.err.splitlines()] == [
        ["program:", "warning:"],
        ["program:", printable("a\x1b[2J\x1b]0;title\x07\x9b31m\x7f\u202egpj\u2066")],
    ]


@posix
def test_signals_raise_and_their_handlers_are_restored(foreground: None, capsys: pytest.CaptureFixture[str]) -> None:
    done: list[str] = []

    def command(number: int) -> int:
        try:
            signal.raise_signal(number)
            return 0
        finally:
            if number == signal.SIGHUP:  # a shell sends it, and so does its end
                signal.raise_signal(number)
            done.append("closed")

    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        assert run_program("program", partial(command, number)) == 128 + number
    assert done == ["closed"] * 3
    assert capsys.readouterr().err == "program: interrupted\nprogram: terminated\nprogram: terminated\n"
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@posix
def test_a_signal_waits_for_the_end_of_an_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A native module would turn the exception into an ImportError, and LLVM's callbacks would lose it."""
    (tmp_path / "imported_slowly.py").write_text(
        "import signal, time\nsignal.raise_signal(signal.SIGTERM)\ntime.sleep(0.3)\ndone = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    done: list[bool] = []

    def command() -> int:
        module = importlib.import_module("imported_slowly")
        done.append(module.done)
        threading.Event().wait(60.0)
        return 0

    assert run_program("program", command) == 143
    assert done == [True]


@posix
@pytest.mark.parametrize("error", [SystemError, PointsError, OSError, None])
def test_a_signal_that_code_in_between_changes_is_still_its_end(
    error: type[Exception] | None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Native code that calls Python raises a SystemError in place of what a signal raised there, or loses it."""

    def command() -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        except SystemExit as exc:
            if error is not None:
                raise error("returned a result with an exception set") from exc
        return 1

    assert run_program("program", command) == 143
    assert capsys.readouterr().err == "program: terminated\n"


@posix
def test_a_host_keeps_its_own_handler() -> None:
    caught: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: caught.append(number))
    try:

        def command() -> int:
            signal.raise_signal(signal.SIGTERM)
            return 7

        assert run_program("program", command) == 7
    finally:
        signal.signal(signal.SIGTERM, before)
    assert caught == [signal.SIGTERM]


@posix
def test_a_folder_that_is_gone_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    (folder := tmp_path / "gone").mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    assert run_program("program", lambda: len(Path().resolve().parts)) == 2
    assert capsys.readouterr().err == "program: the current folder was removed; change to another one\n"


@pytest.mark.parametrize("error", [MemoryError(), MemoryError("Unable to allocate 8 GiB")])
def test_without_memory_a_program_says_so(error: MemoryError, capsys: Any) -> None:
    """It ended with a traceback, and with the exit code of scans that failed."""
    assert run_program("program", Mock(side_effect=error)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"program: there is not enough memory(: Unable to allocate 8 GiB)?; raise the .* limit.*", line)


def test_a_file_where_a_folder_has_to_be(tmp_path: Path, capsys: Any) -> None:
    (file := tmp_path / "file").touch()
    for folder in (file, file / "below"):
        assert run_program("program", partial(folder.mkdir, parents=True, exist_ok=True)) == 2
        error = capsys.readouterr().err
        assert (
            error
            == f"program: {folder}: a file is where a folder has to be; expected a folder, or a name that is free\n"
        )


def test_a_program_runs_in_any_thread() -> None:
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(run_program("program", lambda: 3)))
    thread.start()
    thread.join()
    assert codes == [3]


@posix
def test_a_broken_pipe_to_a_process_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    """Only a closed stdout or stderr is quiet."""
    assert run_program("program", Mock(side_effect=BrokenPipeError(32, "Broken pipe"))) == 2
    assert "Broken pipe" in capsys.readouterr().err


MAINS = {"edgeperc": "edgeperc.cli", "edgeperc-bench": "edgeperc_bench.cli", "edgeperc-export": "edgeperc_export.cli"}


def start(program: str, *arguments: str, before: str = "", **how: Any) -> subprocess.Popen[bytes]:
    code = f"import sys; {before}\nfrom {MAINS[program]} import main\nsys.exit(main(sys.argv[1:]))"
    how = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | how
    return subprocess.Popen([sys.executable, "-c", code, *arguments], **how)


def commanded(act: str) -> str:
    return (
        "import argparse, time\n"
        "from edgeperc.cli.output import print_error, print_line, print_result, progress\n"
        f"def act(*_):\n    {act}\n"
        "class Known(argparse.Namespace): command = run = act\n"
        "argparse.ArgumentParser.parse_args = lambda *_, **__: Known()"
    )


WAITING = commanded("print('runs', flush=True); time.sleep(600)")


@posix
@pytest.mark.parametrize(
    ("program", "number"), [*((program, signal.SIGTERM) for program in PROGRAMS), ("edgeperc", signal.SIGINT)]
)
def test_every_program_ends_by_a_signal_in_one_line(program: str, number: int) -> None:
    code, word = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}[number]
    # A shell starts programs in the background with SIGINT ignored.
    with_signals = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    with start(program, before=WAITING, preexec_fn=with_signals) as process:
        assert process.stdout.readline() == b"runs\n"
        time.sleep(0.2)
        process.send_signal(number)
        _, errors = process.communicate(timeout=120)
    assert (process.returncode, errors.decode()) == (code, f"{program}: {word}\n")


@posix
@pytest.mark.parametrize(
    ("program", "stream"), [*((program, "stdout") for program in PROGRAMS), ("edgeperc", "stderr")]
)
def test_every_program_is_quiet_when_nobody_reads(program: str, stream: str) -> None:
    talk = "print_line" if stream == "stdout" else "print_error"
    with start(program, before=commanded(f"for _ in range(10_000): {talk}('line')")) as process:
        closed, other = (process.stdout, process.stderr) if stream == "stdout" else (process.stderr, process.stdout)
        closed.close()
        assert other.read() == b""
    assert process.returncode == 141


@posix
@pytest.mark.parametrize("program", PROGRAMS)
def test_help_is_quiet_when_nobody_reads(program: str) -> None:
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with start(program, "--help", env=buffered) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


@posix
@pytest.mark.parametrize(
    ("program", "closed"), [*((program, [1]) for program in PROGRAMS), ("edgeperc", [2]), ("edgeperc", [0, 1, 2])]
)
def test_closed_streams_take_what_is_printed_and_no_file_their_numbers(program: str, closed: list[int]) -> None:
    talk = "print_line('line', gray=True), print_result('line'), print_error('line')"
    act = f"with progress() as show, open('/dev/null') as file: show(1, 2), {talk}; return 4 + file.fileno()"
    how = dict.fromkeys(("stdin", "stdout", "stderr")) | {"preexec_fn": lambda: [os.close(each) for each in closed]}
    with start(program, before=commanded(act), **how) as process:
        assert process.wait(120) > 6


@posix
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere file names are Unicode")
@pytest.mark.parametrize(
    ("program", "arguments", "encoding"),
    [
        ("edgeperc", ["info", "NAME"], "utf-8"),
        ("edgeperc", ["run", "NAME"], "ascii"),
        ("edgeperc", ["NAME"], "utf-8"),
        ("edgeperc", ["models", "--NAME"], "ascii"),
        ("edgeperc-bench", ["compare", "NAME", "NAME"], "utf-8"),
        ("edgeperc-bench", ["compare", "a", "b", "NAME"], "ascii"),
        ("edgeperc-export", ["database-check", "NAME"], "utf-8"),
        ("edgeperc-export", ["card", "NAME", "NAME", "NAME"], "ascii"),
        ("edgeperc-export", ["NAME"], "utf-8"),
    ],
)
def test_names_of_files_cannot_control_the_terminal(
    program: str, arguments: list[str], encoding: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for command, module in (("database-check", "PIL"), ("card", "onnx")):
        if command in arguments:
            pytest.importorskip(module)
    name = ESCAPES.replace("\x00", "").encode() + b"\xff\n.bin"
    (tmp_path / os.fsdecode(name)).write_bytes(b"no scan")
    typed = [os.fsdecode(argument.encode().replace(b"NAME", name)) for argument in arguments]
    monkeypatch.chdir(tmp_path)
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding, write_through=True))
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(written, encoding, "backslashreplace", write_through=True))
    try:
        code = importlib.import_module(MAINS[program]).main(typed)
    except SystemExit as exc:  # argparse
        code = exc.code
    assert code in (1, 2)
    shown = written.getvalue().decode(encoding)
    assert "Traceback" not in shown
    assert is_safe(shown)
    assert "\\u001b[2J" in shown or "\\x1b[2J" in shown
