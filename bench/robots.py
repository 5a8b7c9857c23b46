"""Low and high sensors, robots: is a scan accepted, how far off is its mounting, and what is found in it.

Run as ``python -m edgeperc_bench.robots [--scans N] [--sensors NAME ...] [--heights M ...] [--places NAME ...]``. Each
scan is of another simulated street, and perceived alone: with the mounting given, and with it to be estimated.
Prints a table of Markdown.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from edgeperc import Mounting, Perceiver
from edgeperc.cli.arguments import positive
from edgeperc.cli.program import run_program
from edgeperc.evaluation.metrics import BoxEvaluator, Confusion
from edgeperc.preprocess.findings import Finding
from edgeperc.simulation import POINT_CLASSES, TOP_VIEW_CLASSES, Scene, SimulatedScan, random_scene, simulate
from edgeperc.simulation.raycast import SLOPE_Y
from edgeperc.simulation.samples import FIRST_SEED
from edgeperc.simulation.scene import sensor_pose
from edgeperc.types.choices import VEHICLES
from edgeperc.types.perception import Perception
from edgeperc.types.sensor import SensorProfile
from edgeperc.types.views import TopViewGeometry

from .accuracy import NearFigures, profile_of

PLACES = ("road", "pavement", "slope", "half", "box", "box-given")
SENSORS = ("vlp-16", "os1-64", "hdl-64e", "mid-360")
HEIGHTS_M = (0.3, 0.5, 0.8, 1.2, 1.73, 3.0)
SLOPE_DEG = 6.5  # across the street; a robot stands on it, so that houses and people lean
BOX_BEHIND_M, HALF_BOX_M = 0.6, 1.0  # how far behind the sensor the side of a box is, and half its width
OFF_M, OFF_DEG = 0.3, 3.0  # a mounting that is farther off is wrong


def sensor_of(name: str) -> SensorProfile:
    """A sensor with the remission of the simulator; "-hanging": as it sees the street upside down."""
    profile = replace(profile_of(name), remission=None, remission_range=(0.0, 1.0))
    return profile.accumulated(0.2) if profile.pattern is not None else profile


def beside(scene: Scene) -> tuple[float, float]:
    """A place on the pavement, 0.8 m beside the road, clear of objects."""
    for x in np.arange(0.0, 30.0, 1.5).tolist():
        for side in (-1.0, 1.0):
            y = next(y for y in np.arange(0.0, 60.0, 0.25) if not scene.on_road(x, side * y))
            place = x, side * float(y + 0.8)
            if all(math.dist(each.center[:2], place) > 1.0 + max(each.size[:2]) / 2.0 for each in scene.objects):
                return place
    return 0.0, 0.0


def scan_of(seed: int, sensor: SensorProfile, height_m: float, place: str) -> SimulatedScan:
    """A scan of a level sensor so high above the ground of a street."""
    scene, roll = random_scene(seed, "urban" if place == "pavement" else None), 0.0
    if place == "slope":
        terrain, roll = scene.terrain.copy(), math.radians(SLOPE_DEG)
        terrain[SLOPE_Y] += math.tan(roll)
        risen = [(x, y, z + math.tan(roll) * y) for x, y, z in (each.center for each in scene.objects)]
        objects = [replace(each, center=center) for each, center in zip(scene.objects, risen, strict=True)]
        primitives, fixed = scene.primitives.copy(), scene.primitives[:, 19] < 0
        primitives[fixed, 6] += math.tan(roll) * primitives[fixed, 5]
        scene = replace(scene, terrain=terrain, objects=tuple(objects), primitives=primitives)
    x, y = beside(scene) if place == "pavement" else (0.0, 0.0)
    pose = sensor_pose(scene, replace(sensor, mounting=Mounting(height_m)), x, y, roll=roll)
    scan = simulate(scene, sensor, seed, pose, ego_shadow=height_m >= 1.5)
    behind = scan.points[:, 0] < 0.0
    if place == "half":
        return replace(scan, points=scan.points[~behind], labels=scan.labels[~behind], objects=scan.objects[~behind])
    if place.startswith("box"):
        points, labels, objects = scan.points.copy(), scan.labels.copy(), scan.objects.copy()
        hidden = behind & (np.abs(points[:, 1]) * BOX_BEHIND_M < -points[:, 0] * HALF_BOX_M)
        hidden &= points[:, 0] < -BOX_BEHIND_M
        points[hidden, :3] *= BOX_BEHIND_M / -points[hidden, :1]
        points[hidden, 3], labels[hidden], objects[hidden] = 0.3, 0, -1
        return replace(scan, points=points, labels=labels, objects=objects)
    return scan


class Figures(NearFigures):
    """Counts over streets."""

    def __init__(self) -> None:
        super().__init__(BoxEvaluator(0.5, together=VEHICLES), BoxEvaluator(0.25, together=("pedestrian",)))
        self.road = Confusion(("other", "road"))
        self.off: list[tuple[float, float, float]] = []
        self.n_refused = self.n_wrong = self.n_silent = 0

    def add(self, perception: Perception, scan: SimulatedScan, height_m: float) -> None:
        """Count a scan of a level sensor."""
        mounting = perception.mounting
        off = np.abs([(mounting.height_m or 0.0) - height_m, mounting.roll_deg or 0.0, mounting.pitch_deg or 0.0])
        self.off.append(tuple(off.tolist()))
        wrong = bool(off[0] > OFF_M or off[1:].max() > OFF_DEG)
        self.n_refused += any(isinstance(finding, Finding) and finding.gross for finding in perception.fitness)
        self.n_wrong += wrong
        self.n_silent += wrong and not any("mount" in finding for finding in perception.fitness)
        returns = np.bincount(scan.objects[scan.objects >= 0], minlength=len(scan.boxes)).tolist()
        self.count(perception, scan.points, scan.labels, zip(scan.boxes, returns, strict=True))
        view = perception.require_top_view()
        true = scan.top_view_labels(TopViewGeometry()) == TOP_VIEW_CLASSES.index("drivable")
        self.road.update(view.road.astype(np.uint8), true.astype(np.uint8))

    def row(self) -> str:
        """Counts, median and largest errors of the mounting, and accuracy in per cent."""
        off = np.array(self.off)
        errors = " | ".join(
            f"{np.median(each):.{d}f}; {each.max():.{d}f}" for each, d in zip(off.T, (2, 1, 1), strict=True)
        )
        iou = dict(zip(POINT_CLASSES, 100.0 * np.array(self.points.iou()), strict=True))
        aps = " / ".join(f"{100.0 * each.overall().ap:.0f}" for each in self.evaluators)
        return (
            f"{len(off) - self.n_refused} of {len(off)} | {self.n_wrong} / {self.n_silent} | {errors} | "
            f"{iou['car']:.0f} / {iou['pedestrian']:.0f} | {aps} | {100.0 * self.road.iou()[1]:.0f}"
        )


def rows_of(name: str, height_m: float, place: str, n_scans: int) -> list[str]:
    """The figures of a sensor in some streets, with the mounting given and found."""
    sensor = sensor_of(name)
    if place == "box-given":
        sensor = replace(sensor, ego_box=((-2.0, 0.1 - BOX_BEHIND_M), (-HALF_BOX_M, HALF_BOX_M), (-2.0, 2.0)))
    known = {"given": Mounting(height_m, 0.0, 0.0), "found": Mounting()}
    figures = {word: Figures() for word in known}
    for k in range(n_scans):
        scan = scan_of(FIRST_SEED + k, sensor, height_m, place)
        for word, mounting in known.items():
            perceive = Perceiver(sensor=sensor, mounting=mounting, on_mismatch="warn", full_turn=True)  # checks anew
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                figures[word].add(perceive(scan.points), scan, height_m)
    return [f"| {name} | {height_m:g} m, {place} | {word} | {each.row()} |" for word, each in figures.items()]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser("edgeperc_bench.robots", description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--scans", type=positive, default=12, metavar="N", help="streets (default: 12)")
    parser.add_argument("--sensors", nargs="+", default=[*SENSORS], metavar="NAME")
    parser.add_argument("--heights", nargs="+", type=float, default=[*HEIGHTS_M], metavar="M")
    parser.add_argument("--places", nargs="+", default=["road"], choices=PLACES)
    given = parser.parse_args(arguments)
    print("| sensor | mounting | | accepted | wrong / in silence | height, m | roll, deg | pitch, deg |"
          " IoU car / pedestrian | AP50 vehicles / AP25 pedestrians | road |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for name, height_m, place in product(given.sensors, given.heights, given.places):
        print(*rows_of(name, height_m, place, given.scans), sep="\n", flush=True)


if __name__ == "__main__":
    raise SystemExit(run_program("edgeperc_bench.robots", main))
