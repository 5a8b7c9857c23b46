"""``python -m tests.arm [SCAN ...]``: run edgeperc on aarch64 under qemu, and compare its answers with x86."""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc import read_points
from edgeperc.simulation.samples import simulated_scan
from edgeperc.zoo import DEFAULT, choose, resolve

from .compare import COLUMNS, compare, read
from .environment import CPUS, ONE_THREAD, REPOSITORY, Environment, missing_tools

FIRST_SEED = 5 * 10**9  # no other part of the project uses these seeds
PERCEIVED_ON = "neoverse-n1"
# Tests of the kernels behind a perception, which compare them with their slow twins.
TESTS = [
    Path(__file__).resolve().parent.parent / folder / f"test_{name}.py"
    for folder, names in (
        ("agreement", "rules"), ("ground", "leveling observed planes"), ("inference", "blocks decode projection"),
        ("objects", "cluster refine"), ("preprocess", "condition"), ("road", "ahead outline"),
        ("types", "geometry sensor"),
    )
    for name in names.split()
]  # fmt: skip


def main() -> int:
    """Return 0 if nothing differs or if a program is missing, which is printed."""
    parser = argparse.ArgumentParser(prog="python -m tests.arm", description=__doc__)
    parser.add_argument("scans", nargs="*", type=Path, metavar="SCAN", help="default: KITTI's in EDGEPERC_TEST_DATA")
    parser.add_argument("--simulated", type=int, default=6, help="number of simulated scans (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "build/arm")
    parser.add_argument("--no-tests", action="store_true", help="compare the answers only")
    arguments = parser.parse_args()
    if missing := missing_tools():
        packages = " ".join(missing.values())
        print(f"SKIPPED: no {', '.join(missing)} on this computer. On Debian: apt-get install {packages}")
        return 0
    environment = Environment(arguments.out)
    versions = environment.prepare()
    qemu = subprocess.run(["qemu-aarch64", "--version"], capture_output=True, text=True).stdout.splitlines()[0]
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    print(f"{qemu}; Python {environment.python}, {listed}", flush=True)

    source = environment.folder / "scans.npz"
    files = arguments.scans or real_scans()
    scans = [simulated_scan(FIRST_SEED + k).points for k in range(arguments.simulated)]
    scans += [read_points(file) for file in files]
    named: dict[str, Any] = {f"scan{k}": scan for k, scan in enumerate(scans)}
    np.savez(source, **named)
    print(f"{arguments.simulated} simulated and {len(files)} real scans", flush=True)

    program = str(Path(__file__).with_name("answers.py"))
    here, inputs = environment.folder / "here-scans.npz", environment.folder / "here-networks.npz"
    own = {**os.environ, **ONE_THREAD}
    subprocess.run([sys.executable, program, "scans", str(source), str(here)], env=own, check=True)
    subprocess.run([sys.executable, program, "networks", str(here), str(inputs)], env=own, check=True)

    rows: list[list[str]] = []
    faults: list[str] = []
    for cpu in CPUS:
        kinds = ("scans", "networks") if cpu == PERCEIVED_ON else ("networks",)
        for kind in kinds:
            started, target = cpu_s(), environment.folder / f"{cpu}-{kind}.npz"
            target.unlink(missing_ok=True)
            code = environment.run(cpu, [program, kind, str(here if kind == "networks" else source), str(target)])
            print(f"{cpu}, {kind}: {cpu_s() - started:.0f} s of one core", flush=True)
            if code:
                faults.append(f"{cpu}, {kind}: exit code {code}")
                continue
            auto = {name: choose(resolve(name), "cpu", "auto", CPUS[cpu][1].split())[1] for name in DEFAULT}
            more, wrong = compare(cpu, read(inputs if kind == "networks" else here), read(target), kind, auto)
            rows, faults = rows + more, faults + wrong
    if not arguments.no_tests:
        started, pytest = cpu_s(), ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "kernel"]
        if environment.run(PERCEIVED_ON, [*pytest, *map(str, TESTS)]):
            faults.append("tests failed")
        print(f"{PERCEIVED_ON}, tests: {cpu_s() - started:.0f} s of one core", flush=True)
    print(table(rows))
    for fault in faults:
        print(f"FAILED: {fault}")
    print(f"aarch64 under qemu, compared with {platform.machine()}: {len(faults)} faults")
    return 1 if faults else 0


def real_scans() -> list[Path]:
    """Six of KITTI's scans in EDGEPERC_TEST_DATA, evenly spread; none if it is not set."""
    if "EDGEPERC_TEST_DATA" not in os.environ:
        return []
    files = sorted(Path(os.environ["EDGEPERC_TEST_DATA"], "kitti3d/training/velodyne").glob("*.bin"))
    return files[:: max(1, len(files) // 6)][:6]


def cpu_s() -> float:
    """Time of processors that the programs so far have used [s]."""
    used = os.times()
    return used.children_user + used.children_system


def table(rows: list[list[str]]) -> str:
    """A Markdown table of the comparison."""
    lines = [COLUMNS, ("---",) * len(COLUMNS), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    sys.exit(main())
