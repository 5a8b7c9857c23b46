"""The ``edgeperc`` command: one program, one level of subcommands, each in a file of its own.

Exit codes: 0 all is well, 1 some scans failed (each is reported, the others are done), 2 nothing could be done
(usage, model, provider, a missing extra), 130 interrupted, 141 the reader of the output went away.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shlex
import sys
import warnings
from collections.abc import Sequence

# A help page has to come at once: numpy, numba, onnxruntime and matplotlib are imported where a command needs them.
from .. import __version__
from ..errors import EdgepercError
from . import completion, demo, eval, eval_sensors, eval_tracking, fit_sensor, info, lists, run
from .output import complain, show_warning

__all__ = ["build_parser", "in_options", "main"]

# Commands of two words that are one now.
_RENAMED = {
    "eval sensors": "eval-sensors",
    "eval tracking": "eval-tracking",
    "adapt fit": "fit-sensor",
}
# What the library calls an argument, and the option that sets it.
_OPTIONS = {
    "adapt": "--adapt",
    "boxes_from": "--boxes-from",
    "fold": "--fold",
    "full_turn": "--full-turn",
    "models": "--model",
    "n_threads": "--threads",
    "on_mismatch": "--on-mismatch",
    "precision": "--precision",
    "provider": "--provider",
    "rate_hz": "--rate",
    "road_by": "--road-by",
    "sensor": "--sensor",
    "split": "--split",
    "topic": "--topic",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; by default those of this process.

    Returns
    -------
    code : int
        The exit code; wrong usage leaves by argparse's ``SystemExit(2)``.
    """
    given = sys.argv[1:] if argv is None else list(argv)
    parser = build_parser()
    before = " ".join(given[:2])
    if before in _RENAMED:
        parser.error(f"{before!r} is now {_RENAMED[before]!r}: edgeperc {_RENAMED[before]} {shlex.join(given[2:])}")
    known = argparse.Namespace(typed=shlex.join(["edgeperc", *given]), parser=parser)
    arguments = parser.parse_args(given, known)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names need not fit the terminal's encoding
    try:
        with warnings.catch_warnings():
            warnings.showwarning = show_warning
            code: int = arguments.command(arguments)
            sys.stdout.flush()
            return code
    except EdgepercError as exc:
        complain(in_options(str(exc)))
        return 2
    except BrokenPipeError:
        # Python flushes stdout once more on its way out, and would complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as exc:
        complain(exc)
        return 2
    except KeyboardInterrupt:
        complain("interrupted")
        return 130


def build_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    parser = argparse.ArgumentParser(
        prog="edgeperc",
        description="A LiDAR scan in, perception out: drivable area, boxes, a class for every point, and tracks.",
        epilog="'edgeperc COMMAND --help' explains a command. Start with: edgeperc demo",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version", action="version", version=f"edgeperc {__version__}", help="print the version and exit"
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for module in (demo, run, info, lists, eval, eval_sensors, eval_tracking, fit_sensor, completion):
        module.add_parser(commands)
    return parser


def in_options(message: str) -> str:
    """A message of the library with command-line options in place of the arguments of its functions.

    ``provider 'cuda' is ...``, ``n_threads is 0`` and ``precision="bf16"`` become ``--provider 'cuda' is ...``,
    ``--threads is 0`` and ``--precision bf16``; the same word elsewhere in a sentence stays.
    """
    names = "|".join(_OPTIONS)
    message = re.sub(rf"(?<![\w-])({names})=(['\"]?)([\w.:-]+)\2", lambda m: f"{_OPTIONS[m[1]]} {m[3]}", message)
    return re.sub(rf"(?<![\w-])({names})(?= is | are | '| \[)", lambda m: _OPTIONS[m[1]], message)
