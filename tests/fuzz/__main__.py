"""``python -m tests.fuzz KIND ... [--cases N] [--seconds S] [--seed S] [--jobs J] [--out DIR] [--case INDEX]``."""

from __future__ import annotations

import argparse
import json
import logging
import mmap
import os
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path

# One thread in each library: the jobs share the processors.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
TESTS = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(TESTS), str(TESTS / "readers")]  # the tests' helpers

from edgeperc.system.atomic import write_atomic

from .running import Kind, State, attempt, new_case, run_job, summary_of, supervise

KINDS = ("scans", "captures", "readers", "packets", "images", "models", "trackers", "commands")
READERS = (
    "readers.pcd", "readers.ply", "readers.raw", "readers.npy", "readers.text", "readers.others", "readers.clouds",
    "readers.calibration", "readers.labels", "readers.poses", "readers.bag1", "readers.bag2", "readers.mcap",
    "readers.velodyne", "readers.lidar", "readers.lvx2", "readers.ouster", "readers.pcapng",
)  # fmt: skip
"""Parts of the kind ``readers``, each alone."""


def kind_of(name: str, seed: int) -> Kind:
    module, _, part = name.partition(".")
    made: Kind = import_module(f".{module}", __package__).make(seed, *[part] * bool(part))
    return made


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument(
        "kinds", nargs="*", choices=[*KINDS, *READERS, []], metavar="KIND", help=", ".join([*KINDS, *READERS])
    )
    parser.add_argument("--cases", type=int, default=1 << 40, help="cases of each kind (default: until the time is up)")
    parser.add_argument("--seconds", type=float, default=None, help="time for all kinds together (default: no limit)")
    parser.add_argument("--seed", type=int, default=None, help="default: the time")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "--out", type=Path, default=Path("build/fuzz"), help="counts and failed cases; continued if there"
    )
    parser.add_argument("--case", type=int, default=None, help="run this case alone, in this process")
    parser.add_argument("--table", action="store_true", help="print the counts in --out as Markdown, and run nothing")
    parser.add_argument("--here", action="store_true", help="run the cases in this process, which may end with them")
    parser.add_argument("--worker", nargs=4, default=None, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(arguments.out))
        return 0
    kinds = arguments.kinds or [*KINDS]
    logging.disable(logging.WARNING)  # what is told of damaged settings, a thousand times
    seed = int(time.time()) if arguments.seed is None else arguments.seed
    cache = arguments.out.absolute() / "cache"  # nothing of this computer's user is read or changed
    os.environ.setdefault("EDGEPERC_CACHE_DIR", str(cache))
    if arguments.here:
        state = run_job(
            lambda: kind_of(kinds[0], seed), State(kinds[0], seed), cases=arguments.cases, out=arguments.out
        )
        print(line(state), *map(json.dumps, state.failures), sep="\n", flush=True)
        os._exit(int(state.n_failures > 0))
    if arguments.case is not None:
        with tempfile.TemporaryDirectory() as folder:
            case = new_case(kinds[0], seed, arguments.case, Path(folder))
            outcome, failure, ms, mb = attempt(kind_of(kinds[0], seed), case)
            print(f"{outcome}, {ms:.1f} ms, {mb:.0f} MB", *case.died)
            print(failure["traceback"] or failure["error"] if failure else "no failure")
        return int(failure is not None)
    if arguments.worker is not None:
        file, shared, jobs, seconds = arguments.worker
        with open(shared, "r+b") as opened:  # noqa: PTH123
            now = mmap.mmap(opened.fileno(), 0)
            state = State.read(Path(file))
            run_job(
                lambda: kind_of(kinds[0], seed),
                *(state,),
                cases=arguments.cases,
                jobs=int(jobs),
                seconds=float(seconds),
                out=arguments.out,
                file=Path(file),
                now=now,
            )
        sys.stdout.flush()
        os._exit(0)  # a library would list what it leaked
    if arguments.seconds is None and arguments.cases == 1 << 40:
        parser.error("give --cases or --seconds")
    n_failures = 0
    print(f"seed {seed}", flush=True)
    for name in kinds:
        made = import_module(f".{name.partition('.')[0]}", __package__)
        command = [sys.executable, "-m", "tests.fuzz", name, "--cases", str(arguments.cases), "--seed", str(seed)]
        whole = supervise(
            [*command, "--out", str(arguments.out)],
            name,
            made.LIMIT_S,
            seed=seed,
            cases=arguments.cases,
            jobs=arguments.jobs,
            seconds=float("inf") if arguments.seconds is None else arguments.seconds / len(kinds),
            out=arguments.out,
            progress=lambda state: print(line(state), flush=True),
        )
        print(line(whole), flush=True)
        for failure in whole.failures[:20]:
            print("  ", json.dumps(failure), flush=True)
        write_atomic(arguments.out / f"{name}-{seed}.json", whole.to_json())
        n_failures += whole.n_failures
    return int(n_failures > 0)


def table(out: Path) -> str:
    """The runs of every kind in a folder, added up, as rows of a Markdown table; then how processes died."""
    rows, died = [], []
    for kind in (*KINDS, *READERS):
        states = [State.read(file) for file in sorted(out.glob(f"{kind}-*of*.json"))]
        if not states:
            continue
        whole = summary_of(states)
        slowest, highest = whole.slowest["ms"] / 1e3, whole.highest["mb"]
        rows.append(f"| `{kind}` | {whole.cases:,} | {whole.n_failures} | {slowest:.1f} s | {highest:.0f} MB |")
        died += [f"{how} {count:,}" for how, count in sorted(whole.died.items())]
    return "\n".join([*rows, f"died: {', '.join(died)}"])


def line(state: State) -> str:
    outcomes = ", ".join(f"{name} {count:,}" for name, count in state.outcomes.most_common())
    died = f"; died: {dict(state.died)}" if state.died else ""
    return (
        f"{state.kind} seed {state.seed}: {state.cases:,} cases, {state.n_failures} failures in {state.seconds:,.0f} s "
        f"({1e3 * state.seconds / max(state.cases, 1):.2f} ms each; slowest {state.slowest['ms']:.0f} ms in case "
        f"{state.slowest['case']:.0f}; at most {state.highest['mb']:.0f} MB in case {state.highest['case']:.0f}); "
        f"{outcomes}{died}"
    )


if __name__ == "__main__":
    sys.exit(main())
