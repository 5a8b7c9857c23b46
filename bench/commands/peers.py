"""``edgeperc-bench peers``: edgeperc beside other engines and the limits of the machine."""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

from .common import new_document, prepare_input

__all__ = ["peers_command"]

# peers


def peers_command(arguments: argparse.Namespace) -> int:
    from ..peers import contenders as peers

    with new_document("peers", arguments) as (document, live), tempfile.TemporaryDirectory() as folder:
        given = prepare_input(arguments, Path(folder), document, live)
        peers.run(
            document,
            given.files,
            Path(folder),
            models=arguments.model or peers.default_models(),
            provider=arguments.provider,
            sensor=arguments.sensor,
            n_threads=arguments.threads or document["machine"]["usable_cores"] or os.cpu_count() or 1,
            n_rounds=arguments.rounds,
            say=live.say,
        )
    return 0
