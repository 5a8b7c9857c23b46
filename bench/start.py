"""A process that starts, perceives one scan and prints how long each step took.

Run as ``python -m edgeperc_bench.start JSON``.
"""

from __future__ import annotations

import time

BEGAN_S = time.perf_counter()

import json
import sys


def main() -> None:
    """Print one line of JSON; the argument has ``spawned_s`` (the parent's clock), ``scan`` and Perceiver's options."""
    request = json.loads(sys.argv[1])
    stamps_s = [request.pop("spawned_s"), BEGAN_S]
    from edgeperc import Perceiver, read_points

    stamps_s.append(time.perf_counter())
    points = read_points(request.pop("scan"))
    stamps_s.append(time.perf_counter())
    perceive = Perceiver(**request)
    stamps_s.append(time.perf_counter())
    perceive(points)
    stamps_s.append(time.perf_counter())
    from .context import peak_rss_mb

    names = ("interpreter_s", "import_s", "read_s", "construct_s", "first_call_s")
    steps = {name: end - begin for name, begin, end in zip(names, stamps_s[:-1], stamps_s[1:], strict=True)}
    print(json.dumps(steps | {"total_s": stamps_s[-1] - stamps_s[0], "peak_rss_mb": peak_rss_mb()}))


if __name__ == "__main__":
    main()
