"""Types of the command line's options: numbers, lists of numbers, scenarios, names."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from typing import Any

from edgeperc.session import PRECISIONS, PROVIDERS

__all__ = [
    "CAR_COUNTS",
    "DEFAULT_SCENARIOS",
    "POINT_COUNTS",
    "SINGLE_STREAM",
    "at_least",
    "car_counts",
    "complain",
    "image_sizes",
    "point_counts",
    "precisions",
    "providers",
    "scenario",
    "seconds",
    "thread_counts",
]

SINGLE_STREAM = "single-stream"
DEFAULT_SCENARIOS = (SINGLE_STREAM, "paced:10", "paced:20", "offline", "cold-start")
POINT_COUNTS = (10_000, 20_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000)
CAR_COUNTS = (0, 4, 8, 16, 28)


def complain(words: object) -> None:
    print(f"edgeperc-bench: {' '.join(str(words).split())}", file=sys.stderr)


def at_least(least: int) -> Any:
    def number(text: str) -> int:
        if not text.lstrip("-").isdigit() or int(text) < least:
            raise argparse.ArgumentTypeError(f"got {text!r}; expected a whole number from {least}")
        return int(text)

    return number


def seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"got {text!r}; expected seconds")
    return value


def _numbers(least: int, most: float = math.inf) -> Any:
    def numbers(text: str) -> list[int]:
        found = [int(word) for word in text.split(",") if word.isdigit()]
        if len(found) != len(text.split(",")) or not all(least <= n <= most for n in found):
            raise argparse.ArgumentTypeError(f"got {text!r}; expected whole numbers from {least}, with commas")
        return list(dict.fromkeys(found))

    return numbers


thread_counts, point_counts, car_counts = _numbers(1), _numbers(100), _numbers(0, CAR_COUNTS[-1])
image_sizes = _numbers(25, 1600)


def scenario(text: str) -> str:
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


def _words(known: Sequence[str]) -> Any:
    def words(text: str) -> list[str]:
        found = text.split(",")
        for word in found:
            if word not in (*known, "all"):
                raise argparse.ArgumentTypeError(f"got {word!r}; expected all, or some of {', '.join(known)}")
        return found

    return words


providers, precisions = _words(tuple(PROVIDERS)), _words(tuple(PRECISIONS))
