"""Sensors that do not spin, in simulated streets: accuracy by the time that a scan is gathered, standing and driving.

Run as ``python -m edgeperc_bench.solid_state [--scans N] [--sensors mid-360 hap avia]``; a VLP-16 in the same place of
the same streets stands beside. ``--turn hap`` times four of them around a vehicle against one scan of as many
points.
Prints tables of Markdown.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from edgeperc import Mounting, Perceiver, TimedScan, Trajectory, accumulate, merge
from edgeperc.cli.arguments import positive
from edgeperc.cli.program import run_program
from edgeperc.evaluation.metrics import BoxEvaluator
from edgeperc.simulation import SimulatedScan, random_scene, simulate, simulate_sequence
from edgeperc.simulation.samples import FIRST_SEED
from edgeperc.types.choices import VEHICLES
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.points import Bytes, Floats, Floats32
from edgeperc.types.sensor import SensorProfile, get_sensor

from .accuracy import NearFigures, profile_of
from .samples import elapsed_ms

TIMES_S = (0.1, 0.2, 0.5)
SPEEDS_MPS = (0.0, 10.0)
_RATE_HZ = 100.0  # of the places that a gathered scan is taken from
Taken = tuple[Floats32, Bytes, SimulatedScan, list[int]]


class Figures(NearFigures):
    """Counts over streets: classes of points, and boxes of vehicles all around."""

    def __init__(self) -> None:
        super().__init__(BoxEvaluator(together=VEHICLES))
        self.n_points: list[int] = []

    def row(self) -> str:
        """Mean and single IoU of points and AP50 of vehicles, in per cent."""
        iou = 100.0 * np.array(self.points.iou()[1:])
        ap = 100.0 * self.evaluators[0].overall().ap
        return (
            f"{np.mean(self.n_points):,.0f} | {' / '.join(f'{v:.0f}' for v in iou)} | {np.nanmean(iou):.1f} | {ap:.0f}"
        )


def gathered(seed: int, sensor: SensorProfile, accumulate_s: float, speed_mps: float) -> Taken:
    """Points, their labels, the last part of the scan, and the number of points on each of its boxes."""
    n = round(accumulate_s * _RATE_HZ)
    parts = list(simulate_sequence(random_scene(seed), sensor, n, _RATE_HZ, speed_mps, seed))
    times, poses = np.array([part[0] for part in parts]), np.array([part[1] for part in parts])
    timed = (TimedScan(stamp_s, scan.points, None) for stamp_s, _, scan in parts)
    points = [each.points for each in accumulate(timed, accumulate_s, Trajectory(times, poses))][-1]
    returns = np.sum([scan.box_points for _, _, scan in parts], axis=0).tolist()
    return points, np.concatenate([scan.labels for _, _, scan in parts]), parts[-1][2], returns


def spun(seed: int, sensor: SensorProfile, duration_s: float, speed_mps: float) -> Taken:
    """The same of a spinning sensor, at the end of that time."""
    *_, (_, _, scan) = simulate_sequence(random_scene(seed), sensor, 2, 1.0 / duration_s, speed_mps, seed)
    return scan.points, scan.labels, scan, list(scan.box_points)


def row_of(sensor: SensorProfile, accumulate_s: float, speed_mps: float, n_scans: int) -> str:
    """The figures of a sensor in some streets."""
    perceive = Perceiver(sensor=sensor, provider="cpu", mounting=MODEL_MOUNTING, on_mismatch="ignore", full_turn=True)
    figures = Figures()
    for k in range(n_scans):
        take = gathered if sensor.pattern is not None else spun
        points, labels, last, returns = take(FIRST_SEED + k, sensor, accumulate_s, speed_mps)
        points[:, 3] *= 255.0
        figures.count(perceive(points), points, labels, zip(last.boxes, returns, strict=True))
        figures.n_points.append(len(points))
    return figures.row()


def sensors_of(names: Sequence[str]) -> Iterator[tuple[str, SensorProfile, float]]:
    """Title, profile and time of each row; the simulator gives all of them the remission of the training sensor."""
    yield "vlp-16", replace(get_sensor("vlp-16"), remission=None), 0.1
    for name in names:
        profile = profile_of(name)
        for accumulate_s in TIMES_S:
            yield f"{name}, {accumulate_s:g} s", profile.accumulated(accumulate_s), accumulate_s


def around(seed: int, sensor: SensorProfile) -> tuple[list[Floats32], list[Floats]]:
    """Scans of four sensors at the sides of a vehicle in a street, and their poses on it."""
    scene = random_scene(seed)
    T_vehicle_sensor = []
    for x, y, yaw_deg in [(2.2, 0.0, 0.0), (0.0, 0.9, 90.0), (-2.2, 0.0, 180.0), (0.0, -0.9, -90.0)]:
        T_vehicle_sensor.append(np.eye(4))
        T_vehicle_sensor[-1][:3, :3] = Mounting(yaw_deg=yaw_deg).rotation()
        T_vehicle_sensor[-1][:3, 3] = x, y, 1.7
    T_world_vehicle = np.eye(4)
    T_world_vehicle[2, 3] = scene.ground_height(0.0, 0.0)
    scans = [simulate(scene, sensor, seed, T_world_vehicle @ pose) for pose in T_vehicle_sensor]
    return [scan.points * np.array([1, 1, 1, 255], np.float32) for scan in scans], T_vehicle_sensor


def time_turn(name: str, n_turns: int) -> str:
    """Median times [ms] of four sensors as one turn, and of single scans of as many points in turns: of a sensor of the
    same kind that sees all around, and of an HDL-64E, whose range image has no gaps to fill.
    """
    profile = get_sensor(name)
    assert profile.pattern is not None
    scans, poses = around(FIRST_SEED, profile)
    n, raised = sum(map(len, scans)), np.eye(4)
    raised[2, 3] = 1.73
    wide = replace(profile, pattern=replace(profile.pattern, width_deg=360.0))
    duration_s = 6.0 * profile.pattern.accumulate_s
    alike = simulate(random_scene(FIRST_SEED), wide, 0, duration_s=duration_s).points * np.array([1, 1, 1, 255])
    hdl = simulate(random_scene(FIRST_SEED), "hdl-64e", 0).points
    of_kind, of_hdl = (
        Perceiver(sensor=sensor, mounting=mounting, on_mismatch="ignore", full_turn=True)
        for sensor, mounting in ((profile, Mounting(0.0, 0.0, 0.0)), ("hdl-64e", MODEL_MOUNTING))
    )
    chosen = np.random.default_rng(0).permutation(np.resize(np.arange(len(alike)), n))
    one, of_other = merge([alike[chosen]], [raised]), np.resize(hdl, (n, 4))
    calls = (lambda: of_kind(merge(scans, poses))), partial(of_kind, one), partial(of_hdl, of_other)
    takes = np.array([[elapsed_ms(call) for call in calls] for _ in range(n_turns)])
    four, same, other = np.median(takes, axis=0).tolist()
    ratios = np.median(takes[:, :1] / takes[:, 1:], axis=0).tolist()
    return f"| {name} | {n:,} | {four:.0f} | {same:.0f} | {other:.0f} | {ratios[0]:.2f}; {ratios[1]:.2f} |"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser("edgeperc_bench.solid_state", description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--scans", type=positive, default=24, metavar="N", help="streets (default: 24)")
    parser.add_argument("--sensors", nargs="*", default=["mid-360", "mid-360-hanging"], metavar="NAME")
    parser.add_argument("--turn", nargs="*", metavar="NAME", help="only time four of these sensors as one turn")
    parser.add_argument("--turns", type=positive, default=40, metavar="N", help="scans that are timed (default: 40)")
    given = parser.parse_args(arguments)
    if given.turn is not None:
        print("| four | points | merged, ms | one of the kind, ms | one HDL-64E, ms | ratios |")
        print("|---|---|---|---|---|---|")
        for name in given.turn or ["hap", "avia"]:
            print(time_turn(name, given.turns), flush=True)
        return
    print("| sensor | speed | points | IoU car / pedestrian / cyclist | mean IoU | AP50 vehicles |")
    print("|---|---|---|---|---|---|")
    for title, sensor, accumulate_s in sensors_of(given.sensors):
        for speed_mps in SPEEDS_MPS:
            row = row_of(sensor, accumulate_s, speed_mps, given.scans)
            print(f"| {title} | {speed_mps:g} m/s | {row} |", flush=True)


if __name__ == "__main__":
    raise SystemExit(run_program("edgeperc_bench.solid_state", main))
