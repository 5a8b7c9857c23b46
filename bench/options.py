"""The options of the command line: those that several commands share, and the types of their values."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

from edgeperc.inference.providers import PROVIDERS
from edgeperc.system.names import nearest
from edgeperc.types.choices import DEFAULT_MODELS as DEFAULT
from edgeperc.types.choices import PRECISIONS

SINGLE_STREAM = "single-stream"
Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


# Options that several commands share, each group as a parent parser


def model_options() -> argparse.ArgumentParser:
    """``--model`` and ``--sensor``."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument(
        "--model",
        action="append",
        metavar="NAME",
        help="a shipped model (ssadnet), one variant of it (ssadnet:int8) or the path of an .onnx file; may be "
        f"repeated (default: {', '.join(DEFAULT)})",
    )
    parser.add_argument(
        "--sensor",
        default="hdl-64e",
        metavar="NAME",
        help="the sensor that recorded the scans: a name that 'edgeperc sensors' lists, or a .json file "
        "(default: %(default)s)",
    )
    return parser


def scan_options() -> argparse.ArgumentParser:
    """``--input`` and ``--scans``."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument(
        "--input",
        nargs="+",
        type=Path,
        metavar="SCANS",
        help="measure with these scan files, or all scan files of these folders (default: simulated scans)",
    )
    parser.add_argument(
        "--scans",
        type=at_least(1),
        default=8,
        metavar="N",
        help="the number of simulated scans, used in turn (default: %(default)s)",
    )
    return parser


def engine_options() -> argparse.ArgumentParser:
    """``--provider``, ``--precision`` and ``--threads``."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument(
        "--provider",
        type=provider,
        default="auto",
        metavar="P",
        help=f"the execution provider that runs the models: auto, {', '.join(PROVIDERS)} (default: %(default)s)",
    )
    parser.add_argument(
        "--precision",
        choices=("auto", *PRECISIONS),
        default="auto",
        metavar="P",
        help=f"the precision in which the models run: auto, {', '.join(PRECISIONS)} (default: %(default)s)",
    )
    parser.add_argument(
        "--threads",
        type=at_least(1),
        metavar="N",
        help="the number of threads inside a model (default: the provider's choice)",
    )
    return parser


def output_options(html: bool = True) -> argparse.ArgumentParser:
    """``--json``, ``--markdown`` and, if the command has a page, ``--html``."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the report, with every sample, to this file")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables as Markdown to this file")
    if html:
        parser.add_argument(
            "--html", type=Path, metavar="FILE", help="write a page with plots to this file (needs the extra 'view')"
        )
    return parser


def add_limits(parser: argparse.ArgumentParser, min_scans: int, min_seconds: float, repeats: int) -> None:
    """``--min-scans``, ``--min-seconds``, ``--warm-up`` and ``--repeats`` with a command's own defaults."""
    parser.add_argument(
        "--min-scans",
        type=at_least(1),
        default=min_scans,
        metavar="N",
        help="measure at least this many scans in each scenario (default: %(default)s)",
    )
    parser.add_argument(
        "--min-seconds",
        type=seconds,
        default=min_seconds,
        metavar="S",
        help="measure each scenario for at least this long (default: %(default)s)",
    )
    parser.add_argument(
        "--warm-up",
        type=at_least(0),
        default=20,
        metavar="N",
        help="scans before the first one that counts (default: %(default)s)",
    )
    parser.add_argument(
        "--repeats",
        type=at_least(1),
        default=repeats,
        metavar="N",
        help="repeat the measurement in this many fresh processes; their spread is the noise (default: %(default)s)",
    )


# Types of values


def at_least(least: int) -> Callable[[str], int]:
    """The type of a whole number from ``least``."""

    def number(text: str) -> int:
        if not text.lstrip("-").isdigit() or int(text) < least:
            raise argparse.ArgumentTypeError(f"got {text!r}; expected a whole number from {least}")
        return int(text)

    return number


def seconds(text: str) -> float:
    """The type of a duration."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"got {text!r}; expected seconds")
    return value


def numbers(least: int, most: int | None = None) -> Callable[[str], list[int]]:
    """The type of whole numbers with commas between them; repeated ones count once."""

    def parse(text: str) -> list[int]:
        values = [int(part) for part in text.split(",") if part.isdigit()]
        upper = math.inf if most is None else most
        if len(values) != len(text.split(",")) or not all(least <= n <= upper for n in values):
            limits = f"from {least}" if most is None else f"from {least} to {most}"
            raise argparse.ArgumentTypeError(f"got {text!r}; expected whole numbers {limits}, with commas between them")
        return list(dict.fromkeys(values))

    return parse


def choices(known: Sequence[str]) -> Callable[[str], list[str]]:
    """The type of ``all``, or some of the known names with commas between them."""

    def parse(text: str) -> list[str]:
        names = text.split(",")
        for name in names:
            if name not in (*known, "all"):
                close = nearest(name, known)
                raise argparse.ArgumentTypeError(f"got {name!r}{close}; expected all, or some of {', '.join(known)}")
        return list(known) if "all" in names else list(dict.fromkeys(names))

    return parse


def provider(text: str) -> str:
    """The type of ``--provider``."""
    name, _, precision = text.partition(":")
    if precision:
        raise argparse.ArgumentTypeError(
            f"got {text!r}; the precision is an option of its own: --provider {name} --precision {precision}"
        )
    if name not in ("auto", *PROVIDERS):
        raise argparse.ArgumentTypeError(
            f"got {text!r}{nearest(name, PROVIDERS)}; expected auto or one of {', '.join(PROVIDERS)}"
        )
    return name


def scenario(text: str) -> str:
    """The type of ``--scenario``."""
    kind, _, value = text.partition(":")
    try:
        fits = (
            text in (SINGLE_STREAM, "offline", "cold-start")
            or (kind == "paced" and 0.0 < float(value) < math.inf)
            or (kind == "offline" and int(value) > 0)
        )
    except ValueError:
        fits = False
    if not fits:
        raise argparse.ArgumentTypeError(
            f"got {text!r}; expected {SINGLE_STREAM}, paced:HZ, offline, offline:PROCESSES or cold-start"
        )
    return text
