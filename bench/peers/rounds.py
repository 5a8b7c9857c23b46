"""Timing of calls in rounds, for the commands of this package."""

from __future__ import annotations

import argparse
import platform
from collections.abc import Callable, Mapping

import numpy as np

from edgeperc.cli.arguments import Options, options
from edgeperc.types.points import Floats

from ..context import version_of
from ..samples import elapsed_ms

N_WARM_UP = 3


def measure(calls: Mapping[str, Callable[[], object]], n_rounds: int) -> dict[str, Floats]:
    """Milliseconds of each call in each round, by name; the first `N_WARM_UP` do not count. Each round makes every call
    in a new random order, so that caches and other processes affect all of them equally.
    """
    ms = {name: np.empty(N_WARM_UP + n_rounds) for name in calls}
    rng = np.random.default_rng(0)
    for k in range(N_WARM_UP + n_rounds):
        for name in rng.permutation(list(calls)):
            ms[name][k] = elapsed_ms(calls[name])
    return {name: of_call[N_WARM_UP:] for name, of_call in ms.items()}


def versions(**others: str) -> str:
    """Versions of numpy, numba, Python and other packages, and the processor's architecture."""
    packages = {"numpy": np.__version__, "numba": version_of("numba"), "Python": platform.python_version()} | others
    return ", ".join([*(f"{name} {version}" for name, version in packages.items()), platform.machine()])


def parser_of(module: str, text: str | None) -> tuple[argparse.ArgumentParser, Options]:
    """The parser of a module that is a command, described by the first line of its text, and what adds its options."""
    description = (text or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog=f"python -m edgeperc_bench.peers.{module}", description=description)
    return parser, options(parser)
