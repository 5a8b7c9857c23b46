"""Dirt, rain, snow, fog, spray and exhaust in clean scans: which are warned of, and what drops do to the answers.

Run as ``python -m edgeperc_bench.conditions [KITTI] [--scans N]``; KITTI is the folder of its object benchmark, with
``training/velodyne``. Without it, only simulated streets are measured. ``--clean FOLDER SENSOR`` counts the scans of
clear air in a folder of ``.bin`` files that are warned of. Prints tables of Markdown.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from edgeperc import Perceiver, PointsError
from edgeperc.cli.arguments import positive
from edgeperc.cli.program import run_program
from edgeperc.datasets.kitti import read_drives
from edgeperc.preprocess.condition import condition
from edgeperc.preprocess.health import NORMAL_SCANS, Normal, check_health, without_drops
from edgeperc.readers.files import read_points
from edgeperc.simulation import weather
from edgeperc.simulation.samples import FIRST_SEED, simulated_scan
from edgeperc.system.lanes import Stopwatch
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.perception import Box, SensorHealth
from edgeperc.types.points import Floats32, read_only
from edgeperc.types.sensor import SensorProfile, get_sensor

Scan = Floats32
Condition = Callable[[Scan, float, int], Scan]


def _cloud(middle: tuple[float, float, float], radius_m: float, scan: Scan, per_m: float, seed: int) -> Scan:
    return weather.cloud(scan, middle, radius_m, per_m, seed=seed)


CONDITIONS: Mapping[str, tuple[Condition, tuple[float, ...], str]] = {
    "dirt over": (lambda scan, deg, seed: weather.dirty(scan, 60.0, 60.0 - deg, seed=seed), (15.0, 30.0, 60.0), "deg"),
    "rain": (lambda scan, rate, seed: weather.rain(scan, rate, seed=seed), (5.0, 25.0, 100.0), "mm/h"),
    "snow": (lambda scan, rate, seed: weather.snow(scan, rate, seed=seed), (0.5, 1.5, 2.5), "mm/h"),
    "fog, visibility": (lambda scan, far_m, seed: weather.fog(scan, far_m, seed=seed), (100.0, 50.0, 25.0), "m"),
    "spray ahead": (partial(_cloud, (8.0, 0.0, -1.0), 2.5), (0.1, 0.3, 1.0), "/m"),
    "exhaust behind": (partial(_cloud, (-4.0, -0.5, -1.2), 1.5), (0.1, 0.3, 1.0), "/m"),
}
_SAME_M = 2.0  # between the middles of boxes of one object


def streets(n: int) -> list[Scan]:
    """Simulated scans."""
    return [simulated_scan(FIRST_SEED + k).points for k in range(n)]


def kitti(folder: Path, n: int) -> list[Scan]:
    """Scans of KITTI, evenly over the files that are full turns."""
    files = sorted((folder / "training" / "velodyne").glob("*.bin"))
    whole = [path for path in files if (np.fromfile(path, np.float32)[::4] < 0.0).any()]
    if not whole:
        raise PointsError(f"{folder} holds no scan of a full turn; expected .bin files in its training/velodyne")
    return [read_points(path) for path in whole[:: max(1, len(whole) // n)][:n]]


def warned(health: SensorHealth) -> tuple[bool, bool, bool, bool]:
    """Whether of a blocked window, of drops, of a cloud, of fog."""
    return bool(health.blocked_deg), health.has_drops, health.has_cloud, health.has_fog


def print_warnings(name: str, scans: Sequence[Scan], sensor: SensorProfile) -> None:
    """A row for each condition: share of the scans that are warned of."""
    print(f"\n| {name}, {len(scans)} scans | first scan | later | blocked | drops | cloud | fog |")
    print("|---|---|---|---|---|---|---|")
    for kind, (apply, strengths, unit) in {"clear air": (lambda scan, *_: scan, (0.0,), ""), **CONDITIONS}.items():
        for strength in strengths:
            first, later = [], []
            for k, scan in enumerate(scans):
                normal = Normal()
                for j in range(NORMAL_SCANS):  # other places in clear air
                    other = condition(scans[(k + 7 * (1 + j)) % len(scans)], sensor)[0]
                    normal = check_health(other, sensor, normal)[1]
                bad = condition(apply(scan, strength, k), sensor)[0]
                first.append(warned(check_health(bad, sensor, Normal())[0]))
                later.append(warned(check_health(bad, sensor, normal)[0]))
            shares = [np.any(first, axis=1).mean(), np.any(later, axis=1).mean(), *np.mean(later, axis=0)]
            print(_row(kind, strength, unit, [f"{share:.0%}" for share in shares]), flush=True)


def print_answers(name: str, scans: Sequence[Scan], sensor: SensorProfile) -> None:
    """A row for each condition: drivable area and boxes that are nowhere in clear air, with drops and without them."""
    perceive = Perceiver(sensor=sensor)
    pipeline = perceive.pipeline
    assert pipeline is not None

    def answer(scan: Scan) -> tuple[float, Sequence[Box]]:
        parts = pipeline(read_only(scan), MODEL_MOUNTING, Stopwatch())
        return 0.0 if parts.top_view is None else parts.top_view.drivable_area_m2, parts.boxes

    clear = [condition(scan, sensor)[0] for scan in scans]
    usual = [answer(scan) for scan in clear]
    print(f"\n| {name}, {len(scans)} scans | drivable, all points | without drops | false boxes | without drops |")
    print("|---|---|---|---|---|")
    for kind, (apply, strengths, unit) in CONDITIONS.items():
        for strength in strengths if kind != "dirt over" else ():
            areas, boxes = np.zeros((len(scans), 2)), np.zeros((len(scans), 2))
            for k, (scan, (area, known)) in enumerate(zip(clear, usual, strict=True)):
                bad = condition(apply(scan, strength, k), sensor)[0]
                has_drops = check_health(bad, sensor, Normal())[0].has_drops
                answers = [answer(bad)]
                answers.append(answer(without_drops(bad, sensor)[0]) if has_drops else answers[0])
                for j, (found_area, found) in enumerate(answers):
                    areas[k, j] = found_area / max(area, 1.0)
                    centers = np.array([box.center[:2] for box in known]).reshape(-1, 2)
                    boxes[k, j] = sum(np.all(np.hypot(*(centers - b.center[:2]).T) >= _SAME_M) for b in found)
            shares = [f"{share:.0%}" for share in np.median(areas, axis=0)] + [f"{n:.2f}" for n in boxes.mean(axis=0)]
            print(_row(kind, strength, unit, shares), flush=True)


def print_clean(folder: Path, sensor: SensorProfile) -> None:
    """How many scans of clear air are warned of, each as the first one and as one of its drive."""
    if not (files := sorted(folder.glob("*.bin"))):
        raise PointsError(f"{folder} holds no scan; expected .bin files")
    tables = [table for above in (folder.parent, folder.parent.parent) for table in sorted(above.glob("frames*.csv"))]
    drives = {row["name"]: row["drive"] for table in tables for row in read_drives(table)}
    first, later, normals = [], [], dict[str, Normal]()
    for path in files:
        scan, drive = condition(read_points(path), sensor)[0], drives.get(path.stem, "")
        health, normals[drive] = check_health(scan, sensor, normals.get(drive, Normal()))
        first.append(warned(check_health(scan, sensor, Normal())[0]))
        later.append(warned(health))
    print(f"| {folder} | {len(files)} | {np.any(first, axis=1).sum()} | {np.any(later, axis=1).sum()} |", flush=True)


def _row(kind: str, strength: float, unit: str, cells: Iterable[str]) -> str:
    return " | ".join([f"| {kind} {strength:g} {unit}" if unit else f"| {kind}", *cells]) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", 1)[0])
    parser.add_argument("kitti", type=Path, nargs="?")
    parser.add_argument("--scans", type=positive, default=40)
    parser.add_argument("--clean", nargs=2, action="append", default=[], metavar=("FOLDER", "SENSOR"))
    arguments = parser.parse_args()
    if arguments.clean:
        print("| clear air | scans | warned of as a first scan | in its drive |\n|---|---|---|---|")
        for folder, sensor in arguments.clean:
            print_clean(Path(folder), get_sensor(sensor))
        return
    sensor = get_sensor("hdl-64e")
    sets = {"simulated streets": streets(arguments.scans)}
    if arguments.kitti is not None:
        sets["KITTI"] = kitti(arguments.kitti, arguments.scans)
    for name, scans in sets.items():
        print_warnings(name, scans, sensor)
    for name, scans in sets.items():
        print_answers(name, scans, sensor)


if __name__ == "__main__":
    raise SystemExit(run_program("edgeperc_bench.conditions", main))
