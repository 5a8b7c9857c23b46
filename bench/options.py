"""The options of the command line: those that several commands share, and the types of their values."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from edgeperc.cli.arguments import Options, count, finite_number, options, positive
from edgeperc.cli.output import in_options
from edgeperc.errors import ProviderError
from edgeperc.inference.providers import PROVIDERS, check_names
from edgeperc.system.names import nearest
from edgeperc.types.choices import AUTO_SENSOR, DEFAULT_SENSOR, PRECISIONS
from edgeperc.types.choices import DEFAULT_MODELS as DEFAULT

SINGLE_STREAM = "single-stream"


def add_command(
    subparsers: Any,
    name: str,
    command: Callable[[argparse.Namespace], int],
    shared: Sequence[str] = (),
    *,
    help: str,
    description: str,
) -> Options:
    """Declare a command with the groups of options that it shares with others ("model", "scans", "engine", "output" and
    "page"); returns what adds its own.
    """
    parser = subparsers.add_parser(name, help=help, description=description, allow_abbrev=False)
    parser.set_defaults(run=command)
    add = options(parser)
    if "model" in shared:
        add(
            "--model NAME",
            "a shipped model (ssadnet), one variant of it (ssadnet:int8) or the path of an .onnx file; may be "
            f"repeated (default: {', '.join(DEFAULT)})",
            action="append",
        )
        # Scans of one's own may be of another sensor: as that of KITTI, they would be filled or thinned otherwise.
        sensor, default = "a name that 'edgeperc sensors' lists, or a .json file (default: %(default)s)", DEFAULT_SENSOR
        if "scans" in shared:
            sensor = f"found in the points of --input (auto, the default; {DEFAULT_SENSOR} is simulated), or a name "
            sensor, default = f"{sensor}that 'edgeperc sensors' lists, or a .json file", AUTO_SENSOR
        add("--sensor NAME", f"the sensor that recorded the scans: {sensor}", default=default)
    if "scans" in shared:
        files = "measure with these scan files, or all scan files of these folders (default: simulated scans)"
        add("--input SCANS...", files, type=Path)
        simulated = "the number of simulated scans, used in turn (default: %(default)s)"
        add("--scans N", simulated, type=positive, default=8)
    if "engine" in shared:
        runs = f"the execution provider that runs the models: auto, {', '.join(PROVIDERS)} (default: %(default)s)"
        add("--provider P", runs, type=provider, default="auto")
        computed = f"the precision in which the models run: auto, {', '.join(PRECISIONS)} (default: %(default)s)"
        add("--precision P", computed, choices=("auto", *PRECISIONS), default="auto")
        add("--threads N", "the number of threads inside a model (default: the provider's choice)", type=positive)
    if "output" in shared:
        add("--json FILE", "write the report, with every sample, to this file")
        add("--markdown FILE", "write the tables as Markdown to this file")
    if "page" in shared:
        add("--html FILE", "write a page with plots to this file (needs the extra 'view')")
    return add


def add_limits(add: Options, min_scans: int, min_seconds: float, repeats: int) -> None:
    """``--min-scans``, ``--min-seconds``, ``--warm-up`` and ``--repeats`` with a command's own defaults."""
    least = "measure at least this many scans in each scenario (default: %(default)s)"
    add("--min-scans N", least, type=positive, default=min_scans)
    span = "measure each scenario for at least this long (default: %(default)s)"
    add("--min-seconds S", span, type=seconds, default=min_seconds)
    add("--warm-up N", "scans before the first one that counts (default: %(default)s)", type=count, default=20)
    again = "repeat the measurement in this many fresh processes; their spread is the noise (default: %(default)s)"
    add("--repeats N", again, type=positive, default=repeats)


# Types of values


def seconds(text: str) -> float:
    """The type of a duration."""
    if (value := finite_number(text)) < 0.0:
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
    try:
        check_names(text, "auto")
    except ProviderError as exc:
        raise argparse.ArgumentTypeError(in_options(str(exc))) from exc
    return text


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
