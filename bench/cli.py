"""The ``edgeperc-bench`` command: ``run``, ``compare``, ``matrix``, ``scaling``, ``soak`` and ``peers``.

Without a command it is ``run``, or ``matrix`` if ``--providers`` or ``--precisions`` is among the options. Exit codes:
0 success (``compare``: no difference, or faster), 1 ``compare``: slower, 2 nothing could be measured or compared,
130 interrupted, after the results so far are written, 141 the program that reads the output closed it, 143 terminated.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence

from edgeperc import __version__
from edgeperc.cli.program import Parser, run_program

from .commands import compare, matrix, peers, run, scaling, soak

COMMANDS = {"run": run, "compare": compare, "matrix": matrix, "scaling": scaling, "soak": soak, "peers": peers}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, by default that of this process; wrong usage raises argparse's ``SystemExit(2)``."""
    typed = with_command(sys.argv[1:] if argv is None else argv)
    return run_program("edgeperc-bench", lambda: _run(typed))


def _run(typed: list[str]) -> int:
    command_line = shlex.join(["edgeperc-bench", *typed])
    arguments = build_parser().parse_args(typed, argparse.Namespace(command_line=command_line))
    return arguments.run(arguments)


def with_command(typed: Sequence[str]) -> list[str]:
    """The arguments, with the default command in front if none was typed."""
    if typed and (typed[0] in ("-h", "--help", "--version") or not typed[0].startswith("-")):
        return list(typed)
    several = any(option.startswith(("--providers", "--precisions")) for option in typed)
    return ["matrix" if several else "run", *typed]


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of the command line."""
    parser = Parser(
        prog="edgeperc-bench",
        description="Measure how long edgeperc takes on this computer, from a scan to the result.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"edgeperc {__version__}")
    subparsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for command in COMMANDS.values():
        command.add_parser(subparsers)
    return parser


if __name__ == "__main__":
    sys.exit(main())
