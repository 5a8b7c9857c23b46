"""Sensors that do not spin, in simulated streets: accuracy by the time that a scan is gathered, standing and driving.

Run as ``python -m edgeperc_bench.solid_state [--scans N] [--sensors mid-360 hap avia]``; a VLP-16 in the same place of
the same streets stands beside. ``--turn`` times four sensors around a vehicle against one scan of as many points.
Prints tables of Markdown.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edgeperc import Perceiver, TimedScan, Trajectory, accumulate
from edgeperc.evaluation.metrics import BoxEvaluator, Confusion, boxes_to_find
from edgeperc.simulation import POINT_CLASSES, SimulatedScan, random_scene, simulate_sequence
from edgeperc.simulation.samples import FIRST_SEED
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.perception import Perception
from edgeperc.types.sensor import SensorProfile, get_sensor

TIMES_S = (0.1, 0.2, 0.5)
SPEEDS_MPS = (0.0, 10.0)
FARTHEST_M = 50.0
VEHICLES = ("car", "van", "truck")
_RATE_HZ = 100.0  # of the places that a gathered scan is taken from


class Figures:
    """Counts over streets: classes of points, and boxes of vehicles all around."""

    def __init__(self) -> None:
        self.points, self.boxes, self.n_points = Confusion(POINT_CLASSES), BoxEvaluator(together=VEHICLES), [0]

    def add(self, perception: Perception, points: NDArray[np.float32], labels: NDArray[np.uint8], last: SimulatedScan,
            returns: Sequence[int]) -> None:  # fmt: skip
        """Count a scan, whose boxes are those of the last part."""
        found = perception.require_points()
        near = found.in_view & (np.hypot(points[:, 0], points[:, 1]) < FARTHEST_M)
        numbers = np.array([POINT_CLASSES.index(c) if c in POINT_CLASSES else 0 for c in found.classes], np.uint8)
        self.points.update(numbers[found.labels[near]], labels[near])
        boxes = [(box, n) for box, n in zip(last.boxes, returns, strict=True) if np.hypot(*box.center[:2]) < FARTHEST_M]
        to_find, ignored = boxes_to_find(boxes, None, VEHICLES)
        self.boxes.update([b for b in perception.boxes if b.label in VEHICLES], to_find, ignored=ignored)
        self.n_points.append(len(points))

    def row(self) -> str:
        """Mean and single IoU of points and AP50 of vehicles, in per cent."""
        iou = 100.0 * np.array(self.points.iou()[1:])
        ap = 100.0 * self.boxes.overall().ap
        return (
            f"{np.sum(self.n_points) / max(1, len(self.n_points) - 1):,.0f} | {' / '.join(f'{v:.0f}' for v in iou)} | "
            f"{np.nanmean(iou):.1f} | {ap:.0f}"
        )


def gathered(
    seed: int, sensor: SensorProfile, accumulate_s: float, speed_mps: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8], SimulatedScan, list[int]]:
    """Points, their labels, the last part of the scan, and the number of points on each of its boxes."""
    n = round(accumulate_s * _RATE_HZ)
    parts = list(simulate_sequence(random_scene(seed), sensor, n, _RATE_HZ, speed_mps, seed))
    times, poses = np.array([part[0] for part in parts]), np.array([part[1] for part in parts])
    timed = (TimedScan(stamp_s, scan.points, None) for stamp_s, _, scan in parts)
    points = [each.points for each in accumulate(timed, accumulate_s, Trajectory(times, poses))][-1]
    returns = np.sum([scan.box_points for _, _, scan in parts], axis=0).tolist()
    return points, np.concatenate([scan.labels for _, _, scan in parts]), parts[-1][2], returns


def spun(
    seed: int, sensor: SensorProfile, duration_s: float, speed_mps: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8], SimulatedScan, list[int]]:
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
        figures.add(perceive(points), points, labels, last, returns)
    return figures.row()


def sensors_of(names: Sequence[str]) -> Iterator[tuple[str, SensorProfile, float]]:
    """Title, profile and time of each row; the simulator gives all of them the remission of the training sensor."""
    yield "vlp-16", replace(get_sensor("vlp-16"), remission=None), 0.1
    for name in names:
        profile = get_sensor(name.removesuffix("-hanging"))
        if name.endswith("-hanging"):  # as it sees the street: upside down
            profile = replace(profile, elevations_deg=tuple(-deg for deg in reversed(profile.elevations_deg)))
        for accumulate_s in TIMES_S:
            yield f"{name}, {accumulate_s:g} s", profile.accumulated(accumulate_s), accumulate_s


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table."""
    parser = argparse.ArgumentParser("edgeperc_bench.solid_state", description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--scans", type=int, default=24, metavar="N", help="streets (default: 24)")
    parser.add_argument("--sensors", nargs="*", default=["mid-360", "mid-360-hanging"], metavar="NAME")
    given = parser.parse_args(arguments)
    print(
        "| sensor | speed | points | IoU car / pedestrian / cyclist | mean IoU | AP50 vehicles |\n|---|---|---|---|---|---|"
    )
    for title, sensor, accumulate_s in sensors_of(given.sensors):
        for speed_mps in SPEEDS_MPS:
            row = row_of(sensor, accumulate_s, speed_mps, given.scans)
            print(f"| {title} | {speed_mps:g} m/s | {row} |", flush=True)


if __name__ == "__main__":
    main()
