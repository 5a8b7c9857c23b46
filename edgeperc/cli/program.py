"""What the project's programs have in common: one-line errors, signals, closed pipes and their exit codes."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import select
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TextIO

from ..errors import EdgepercError
from ..system.names import nearest
from ..system.printable import printable
from .output import print_error, show_warning

# Modules with functions that native code calls.
_DELICATE = ("llvmlite.", "numba.core.serialize", "importlib._bootstrap", "edgeperc.sinks.run_file", "logging")


class Parser(argparse.ArgumentParser):
    """A parser that takes its last list of paths before, between and after options, and whose errors are two lines,
    name the nearest option, command or choice, and may quote any argument from elsewhere.
    """

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse; an unknown option of a command is that command's error."""
        known, unknown = super().parse_known_args(args, namespace)
        lists = [a for a in self._get_positional_actions() if a.nargs in ("+", "*")]
        if lists and all(Path(argument).exists() for argument in unknown):
            setattr(known, lists[-1].dest, [*getattr(known, lists[-1].dest), *self._get_values(lists[-1], unknown)])
            unknown = []
        if unknown:
            options = [argument.partition("=")[0] for argument in unknown if argument.startswith("--")]
            close = "".join(nearest(option, self._option_string_actions) for option in options)
            self.error(f"unrecognized arguments: {' '.join(unknown)}{close}")
        return known, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as exc:
            close = nearest(str(value), map(str, action.choices or ()))
            raise argparse.ArgumentError(action, exc.message + close) from exc

    def error(self, message: str) -> NoReturn:
        """Print the message and where the usage stands, and exit with code 2."""
        self.exit(2, f"{self.prog}: error: {printable(message)}\nSee {self.prog} --help\n")


class _TerminatedError(SystemExit):
    """SIGTERM or SIGHUP arrived. Like `KeyboardInterrupt` it runs every ``finally``: files and processes are closed."""


def run_program(program: str, command: Callable[[], int | None], message: Callable[[Exception], str] = str) -> int:
    """Run a program's command line, its warnings and errors (as ``message`` says them) one line each on stderr; 2 after
    an `EdgepercError`, `OSError` or `MemoryError`, 130 after SIGINT, 143 after SIGTERM, 129 after SIGHUP, 141 in
    silence if what reads it closed it.
    """
    _fill_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a file name may have characters that the terminal lacks
    raised: list[int] = []
    code = 0
    try:
        try:
            with _signals_raise(raised), warnings.catch_warnings():
                warnings.showwarning = partial(show_warning, program=program)
                try:
                    code = command() or 0
                finally:
                    sys.stdout.flush()
        except BaseException as exc:
            if isinstance(exc, KeyboardInterrupt) and not raised:  # by the process's own handler
                raised.append(signal.SIGINT)
            if not raised:  # else it may be what native code raised in place of the signal's
                if not isinstance(exc, EdgepercError | OSError | MemoryError):
                    raise
                if isinstance(exc, BrokenPipeError) and _unread():
                    return 141
                print_error(_of_system(exc) or message(exc), program)
                return 2
        if raised:
            print_error("interrupted" if raised[0] == signal.SIGINT else "terminated", program)
            return 128 + raised[0]
        return code
    except BrokenPipeError:
        if _unread():
            return 141
        raise


def _of_system(exc: Exception) -> str:
    """What happened and what to do, where the system's own words do not say it; else nothing."""
    if isinstance(exc, MemoryError):
        what = f": {exc}" if str(exc) else ""  # numba's says nothing
        return f"there is not enough memory{what}; raise the process's limit (ulimit -v, its container's)"
    if isinstance(exc, FileNotFoundError) and exc.filename is None:  # only `os.getcwd` says so
        return "the current folder was removed; change to another one"
    if isinstance(exc, FileExistsError | NotADirectoryError) and exc.filename is not None:
        return f"{exc.filename}: a file is where a folder has to be; expected a folder, or a name that is free"
    return ""


def _fill_streams() -> None:
    """Discard what is printed where a service has closed a stream: the next file would get its number, and the text."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            os.set_inheritable(number := os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free
            setattr(sys, name, os.fdopen(number, "w", errors="backslashreplace"))


def _unread() -> bool:
    """Whether the reader of stdout or stderr closed it. Such a stream is discarded from here on."""
    closed = [stream for stream in (sys.stdout, sys.stderr) if _is_closed_pipe(stream)]
    for stream in closed:  # Python flushes it again at exit, and would print an error
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), stream.fileno())
    return bool(closed)


def _is_closed_pipe(stream: TextIO) -> bool:
    """Whether the other end is closed. A `BrokenPipeError` can also come from a pipe to a process that died."""
    if not hasattr(select, "poll"):
        return stream is sys.stdout
    pipes = select.poll()
    try:
        pipes.register(stream.fileno(), 0)
    except (AttributeError, OSError):  # no stream, or one without a file
        return False
    return bool(pipes.poll(0))


@contextlib.contextmanager
def _signals_raise(raised: list[int]) -> Iterator[None]:
    """Let SIGINT, SIGTERM and SIGHUP raise, and collect those that did, unless the process has an answer to them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    owner, main_thread = os.getpid(), threading.get_ident()
    waiting: list[threading.Timer] = []
    hang_up = getattr(signal, "SIGHUP", None)  # the terminal has gone; Windows has none

    def answer(number: int, frame: FrameType | None) -> None:
        if os.getpid() != owner:  # a fork inherits this function; it ends as any process does
            signal.signal(number, defaults[number])
            signal.raise_signal(number)
        elif _is_delicate(frame):
            waiting[:] = [threading.Timer(0.05, _send_again, (number, main_thread))]
            waiting[0].daemon = True
            waiting[0].start()
        elif number != hang_up or number not in raised:  # a shell sends it, and so does its end
            raised.append(number)
            raise KeyboardInterrupt if number == signal.SIGINT else _TerminatedError(128 + number)

    answers = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, hang_up: signal.SIG_DFL}
    defaults: dict[int, Any] = {n: each for n, each in answers.items() if n and signal.getsignal(n) is each}
    for number in defaults:
        signal.signal(number, answer)
    try:
        yield
    finally:
        for number, handler in defaults.items():
            signal.signal(number, handler)
        for timer in waiting:
            timer.cancel()


def _is_delicate(frame: FrameType | None) -> bool:
    """Whether LLVM, or a library that writes a file or a log, called Python back, where an exception is lost and may
    crash; or an import of a native module is at work, which would turn it into an `ImportError`.
    """
    while frame is not None and frame.f_code is not run_program.__code__:
        if str(frame.f_globals.get("__name__")).startswith(_DELICATE):
            return True
        frame = frame.f_back
    return False


def _send_again(number: int, main_thread: int) -> None:
    if hasattr(signal, "pthread_kill"):  # only a signal to the main thread wakes it
        signal.pthread_kill(main_thread, number)
    else:
        signal.raise_signal(number)
