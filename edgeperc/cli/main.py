"""The ``edgeperc`` command: one program, one level of subcommands, each in a file of its own.

Exit codes: 0 success, 1 some scans failed (each is reported, the others are processed), 2 the command could not run
(usage, model, provider, a missing extra), 130 interrupted, 141 the program that reads the output closed it, 143
terminated.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence

# Commands import numpy, numba, onnxruntime and matplotlib inside functions, so that --help is fast.
from .. import __version__
from ..errors import EdgepercError
from . import completion, demo, doctor, fit_sensor, info, lists, ros2, run
from .arguments import with_whole_options
from .evaluation import painting, scans, sensors, tracking
from .output import in_options
from .program import Parser, run_program


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, by default this process's; return the exit code. Raises argparse's SystemExit."""
    given = sys.argv[1:] if argv is None else list(argv)

    def message(exc: Exception) -> str:
        return in_options(str(exc)) if isinstance(exc, EdgepercError) else str(exc)

    return run_program("edgeperc", lambda: _run(given), message)


def _run(given: list[str]) -> int:
    parser = build_parser()
    if any("\0" in argument for argument in given):  # from Python; no shell passes it on
        parser.error("an argument has a null character, which no file name and no value can have")
    known = argparse.Namespace(typed=shlex.join(["edgeperc", *given]), parser=parser)
    arguments = parser.parse_args(with_whole_options(given), known)
    return arguments.command(arguments)


def build_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    parser = Parser(
        prog="edgeperc",
        description="From a LiDAR scan to drivable area, boxes, a class for every point, and tracks.",
        epilog="'edgeperc COMMAND --help' explains a command. Start with: edgeperc demo",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version", action="version", version=f"edgeperc {__version__}", help="print the version and exit"
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    evaluations = (scans, sensors, tracking, painting)
    for module in (demo, run, ros2, info, doctor, lists, *evaluations, fit_sensor, completion):
        module.add_parser(commands)
    return parser
