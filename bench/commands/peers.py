"""``edgeperc-bench peers``: compare edgeperc with other engines and with the limits of the machine."""

from __future__ import annotations

import argparse
from typing import Any

from edgeperc.cli.arguments import positive

from ..options import add_command, choices
from .common import new_document, prepare_input


def add_parser(subparsers: Any) -> None:
    add = add_command(
        subparsers,
        "peers",
        run_command,
        ("model", "scans", "engine", "output", "page"),
        help="compare edgeperc with torch, other engines and numpy (extra 'peers')",
        description="Measure edgeperc, the same networks in torch, torch.compile, onnxruntime, OpenVINO, MNN and ncnn "
        "with a pipeline in numpy, and the fastest matrix products and memory copies of this computer, all in turns. "
        "Then measure networks and methods of others beside edgeperc's whole answers. "
        "What is not installed is listed and left out.",
    )
    turns = "how often each contender takes its turn with all scans (default: %(default)s)"
    add("--rounds N", turns, type=positive, default=25)
    add(
        "--tables LIST",
        "engines: the models elsewhere; methods: SalsaNext, SqueezeSegV2, FIDNet, CENet, PointPillars, SFA3D and "
        "Patchwork++ beside the default models, in onnxruntime's CPU provider; or all (default: %(default)s)",
        type=choices(("engines", "methods")),
        default="all",
    )


def run_command(arguments: argparse.Namespace) -> int:
    """Measure every table, one after the other."""
    from ..peers.turns import run

    with new_document("peers", arguments) as (document, live, folder):
        scans = prepare_input(arguments, folder, document, live)
        run(document, scans.files, folder, arguments, live.note)
    return 0
