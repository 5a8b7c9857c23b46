"""The scans that training, export and proof draw from: simulated by the thousand, real where there are any."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from edgeperc.perception import Box
from edgeperc.points import read_points
from edgeperc.sensors import FitnessProfile
from edgeperc.simulation import SimulatedScan, random_scene, scene_from_boxes, sensor_pose
from edgeperc.simulation import simulate as cast

from .augment import LabelledScan
from .kitti import KittiObjects, layouts

__all__ = ["fitness_of", "parity_scans", "simulate", "simulated_scan"]


def simulated_scan(seed: int, sensor: str = "hdl-64e", boxes: Sequence[Box] | None = None) -> SimulatedScan:
    """One scan of a scene of its own, the vehicle a little off its lane, pitched and rolled as on a real road.

    ``boxes`` gives the scene a real layout; without, everything is drawn from the seed.
    """
    rng = np.random.default_rng((seed, 1))
    if boxes is None:
        scene = random_scene(seed)
        x, y, yaw = rng.normal(0.0, 4.0), rng.normal(0.0, 0.5), rng.normal(0.0, 0.05)
    else:
        scene, x, y, yaw = scene_from_boxes(boxes, seed), 0.0, 0.0, 0.0
    pitch, roll = rng.normal(0.0, 0.008, size=2)
    pose = sensor_pose(scene, sensor, x, y, yaw=yaw, pitch=pitch, roll=roll)
    return cast(scene, sensor, seed, pose)


def simulate(out: Path, n: int, *, first: int = 0, layouts_root: Path | None = None, sensor: str = "hdl-64e") -> None:
    """Write ``n`` labelled scans into ``out``, every other one with a real layout where there are any.

    Files already there are left alone, so a stopped run goes on where it was.
    """
    out.mkdir(parents=True, exist_ok=True)
    real = list(layouts(layouts_root)) if layouts_root else []
    for seed in tqdm(range(first, first + n), desc="simulating", unit="scan"):
        path = out / f"{seed:06d}.npz"
        if not path.exists():
            # 4,973 is a prime: neighbouring seeds take layouts of different drives.
            boxes = real[seed * 4973 % len(real)] if real and seed % 2 else None
            LabelledScan.from_simulation(simulated_scan(seed, sensor, boxes)).save(path)


def parity_scans(paths: Sequence[Path]) -> list[NDArray[np.float32]]:
    """Scans to prove an export on: those given, and four simulated ones that no training run drew."""
    return [read_points(p) for p in paths] + [simulated_scan(10**9 + k).points for k in range(4)]


def fitness_of(kitti: Path | None) -> FitnessProfile:
    """What training scans look like: the real ones, or simulated ones where there are none."""
    if kitti is None:
        return FitnessProfile.from_scans(simulated_scan(10**9 + k).points for k in range(32))
    objects = KittiObjects(kitti)
    names = objects.names("train", crops=False)
    return FitnessProfile.from_scans(objects.frame(n).points for n in names[:: max(1, len(names) // 64)])
