"""Options of ``edgeperc run`` for what is written about a whole run: see `edgeperc.sinks`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..sinks import Sink

__all__ = ["SINKS", "add_sinks", "open_sinks", "wanted_sinks"]

SINKS: tuple[str, ...] = ()
"""Names of the options below as attributes of the arguments."""


def add_sinks(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument_group("files of the whole run")


def wanted_sinks(arguments: argparse.Namespace) -> list[str]:
    """Names of the passed options, in the order of `SINKS`."""
    return [name for name in SINKS if getattr(arguments, name) is not None]


def open_sinks(arguments: argparse.Namespace) -> list[Sink]:
    """Make the sinks of the passed options; errors of options and missing extras come here, before the first scan."""
    sinks: list[Sink] = []
    return sinks
