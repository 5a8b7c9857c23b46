"""The ``edgeperc-bench`` command: ``run``, ``compare``, ``matrix``, ``scaling``, ``soak`` and ``peers``.

Without a command it is ``run``, or ``matrix`` where ``--providers`` or ``--precisions`` is among the words. Exit codes:
0 all is well (``compare``: no difference, or faster), 1 ``compare``: slower, 2 nothing could be done or compared,
130 interrupted, after what was measured is written.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from edgeperc import EdgepercError, __version__
from edgeperc.tuning import settings_path
from edgeperc.zoo import DEFAULT

from .commands.compare import compare_command
from .commands.matrix import matrix_command
from .commands.peers import peers_command
from .commands.run import run_command
from .commands.scaling import scaling_command
from .commands.soak import soak_command
from .options import (
    CAR_COUNTS,
    DEFAULT_SCENARIOS,
    POINT_COUNTS,
    SINGLE_STREAM,
    at_least,
    car_counts,
    complain,
    image_sizes,
    point_counts,
    precisions,
    providers,
    scenario,
    seconds,
    thread_counts,
)

__all__ = ["main"]

COMMANDS = ("run", "compare", "matrix", "scaling", "soak", "peers")


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
    words = sys.argv[1:] if argv is None else list(argv)
    if not words or words[0] not in (*COMMANDS, "-h", "--help", "--version"):
        wanted = any(word.startswith(("--providers", "--precisions")) for word in words)
        words = ["matrix" if wanted else "run", *words]
    arguments = _parser().parse_args(words, argparse.Namespace(typed=shlex.join(["edgeperc-bench", *words])))
    try:
        code: int = arguments.command(arguments)
        sys.stdout.flush()
        return code
    except (EdgepercError, OSError) as exc:
        complain(exc)
        return 2
    except KeyboardInterrupt:
        complain("interrupted")
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="edgeperc-bench", description="How long a scan takes on this machine, from the scan to the answer."
    )
    parser.add_argument("--version", action="version", version=f"edgeperc {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    common = argparse.ArgumentParser(add_help=False)
    common.add_argument(
        "--model",
        action="append",
        metavar="NAME",
        help=f"a shipped model or an .onnx with a card; may be repeated (default: {' and '.join(DEFAULT)})",
    )
    common.add_argument(
        "--sensor", default="hdl-64e", metavar="NAME", help="what took the scans (default: %(default)s)"
    )
    common.add_argument("--json", type=Path, metavar="FILE", help="everything, all samples included")
    scans = argparse.ArgumentParser(add_help=False)
    scans.add_argument(
        "--input", nargs="+", type=Path, metavar="SCANS", help="your own scans or folders (default: simulated scans)"
    )
    scans.add_argument(
        "--scans", type=at_least(1), default=8, metavar="N", help="simulated scans (default: %(default)s)"
    )
    scans.add_argument("--markdown", type=Path, metavar="FILE")
    scans.add_argument("--html", type=Path, metavar="FILE", help="a page with plots (needs the extra 'view')")
    engine = argparse.ArgumentParser(add_help=False)
    engine.add_argument("--provider", default="auto", metavar="P", help="cpu, openvino:bf16, cuda, ... (default: auto)")
    engine.add_argument("--threads", type=at_least(1), metavar="N", help="threads inside a model (default: its choice)")

    def limits(command: argparse.ArgumentParser, min_scans: int, min_seconds: float, repeats: int) -> None:
        command.add_argument(
            "--min-scans", type=at_least(1), default=min_scans, metavar="N", help="default: %(default)s"
        )
        command.add_argument(
            "--min-seconds", type=seconds, default=min_seconds, metavar="S", help="default: %(default)s"
        )
        command.add_argument(
            "--warm-up", type=at_least(0), default=20, metavar="N", help="scans (default: %(default)s)"
        )
        command.add_argument(
            "--repeats", type=at_least(1), default=repeats, metavar="N", help="fresh processes (default: %(default)s)"
        )

    run = commands.add_parser("run", parents=[common, scans, engine], help="measure one setting")
    limits(run, 100, 10.0, 3)
    run.add_argument(
        "--scenario",
        action="append",
        type=scenario,
        metavar="S",
        help=f"{SINGLE_STREAM}, paced:HZ, offline, offline:PROCESSES, cold-start; may be repeated "
        f"(default: {', '.join(DEFAULT_SCENARIOS)})",
    )
    run.add_argument("--loadgen", type=Path, metavar="DIR", help="also have MLPerf LoadGen drive it, its logs in DIR")
    run.set_defaults(command=run_command)

    versus = commands.add_parser("compare", help="is B faster or slower than A, as far as their noise lets one say")
    versus.add_argument("a", type=Path, metavar="A.json")
    versus.add_argument("b", type=Path, metavar="B.json")
    versus.set_defaults(command=compare_command)

    matrix = commands.add_parser("matrix", parents=[common, scans], help="measure many settings, recommend one")
    limits(matrix, 50, 3.0, 2)
    matrix.add_argument("--providers", type=providers, default=["all"], metavar="A,B|all", help="default: all")
    matrix.add_argument("--precisions", type=precisions, default=["all"], metavar="A,B|all", help="default: all")
    matrix.add_argument(
        "--threads", type=thread_counts, default=[1, os.cpu_count() or 1], metavar="1,2,4", help="default: 1 and all"
    )
    matrix.add_argument(
        "--recommend", type=Path, nargs="?", const=settings_path(), metavar="FILE",
        help=f"keep the recommendation where Perceiver(provider='auto') finds it ({settings_path()}), or in FILE",
    )  # fmt: skip
    matrix.set_defaults(command=matrix_command)

    scaling = commands.add_parser("scaling", parents=[common, engine], help="how the cost grows")
    limits(scaling, 20, 1.0, 1)
    scaling.add_argument("--points", type=point_counts, default=list(POINT_COUNTS), metavar="N,N", help="points a scan")
    scaling.add_argument("--cars", type=car_counts, default=list(CAR_COUNTS), metavar="N,N", help="objects, 28 at most")
    scaling.add_argument(
        "--sizes",
        type=image_sizes,
        default=[50, 100, 200, 400],
        metavar="N,N",
        help="images, in per cent of the model's own, its weights at random (needs the extra 'export')",
    )
    scaling.add_argument("--processes", type=thread_counts, metavar="N,N", help="default: 1, 2, 4 .. as cores")
    scaling.add_argument("--plot", type=Path, metavar="FILE", help=".svg or .png (needs the extra 'view')")
    scaling.add_argument("--markdown", type=Path, metavar="FILE")
    scaling.set_defaults(command=scaling_command, html=None)

    soak = commands.add_parser("soak", parents=[common, engine], help="does memory grow over a long run")
    soak.add_argument("--scans", type=at_least(1000), default=20_000, metavar="N", help="default: %(default)s")
    soak.add_argument("--markdown", type=Path, metavar="FILE")
    soak.set_defaults(command=soak_command, html=None)

    peers = commands.add_parser(
        "peers",
        parents=[common, scans, engine],
        help="edgeperc beside torch, other engines and numpy, and the machine's own limits (extra 'peers')",
    )
    peers.add_argument(
        "--rounds", type=at_least(1), default=25, metavar="N", help="turns of each, all scans (default: %(default)s)"
    )
    peers.set_defaults(command=peers_command)
    return parser


if __name__ == "__main__":
    sys.exit(main())
