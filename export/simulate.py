"""Simulated scans: to train on, to verify an export on, and to describe the expected input in its card."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from edgeperc.evaluation.datasets import KittiObjects, layouts
from edgeperc.fitness import FitnessProfile
from edgeperc.readers.files import read_points
from edgeperc.simulation.samples import simulated_scan

from .scans import LabeledScan

__all__ = ["fitness_of", "parity_scans", "simulate"]


def simulate(out: Path, n: int, *, first: int = 0, layouts_root: Path | None = None, sensor: str = "hdl-64e") -> None:
    """Write ``n`` labeled scans into ``out``. Existing files are kept, so a stopped run resumes.

    Parameters
    ----------
    out : Path
    n : int
    first : int
        Number and seed of the first scan.
    layouts_root : Path, optional
        Folder of KITTI's labels; every other scene gets the boxes of one of its scans.
    sensor : str
        Name of the sensor to simulate.
    """
    out.mkdir(parents=True, exist_ok=True)
    real = list(layouts(layouts_root)) if layouts_root else []
    for seed in tqdm(range(first, first + n), desc="simulating", unit="scan"):
        path = out / f"{seed:06d}.npz"
        if not path.exists():
            # 4,973 is prime: neighboring seeds take layouts of different drives.
            boxes = real[seed * 4973 % len(real)] if real and seed % 2 else None
            LabeledScan.from_simulation(simulated_scan(seed, sensor, boxes)).save(path)


def parity_scans(paths: Sequence[Path]) -> list[NDArray[np.float32]]:
    """Scans to verify an export on: the given files, and four simulated scans that are in no training set."""
    return [read_points(p) for p in paths] + [simulated_scan(10**9 + k).points for k in range(4)]


def fitness_of(kitti: Path | None) -> FitnessProfile:
    """The fitness profile of the training scans: KITTI's, or, if ``kitti`` is None, 32 simulated ones.

    At runtime, inputs are compared with it.
    """
    if kitti is None:
        return FitnessProfile.from_scans(simulated_scan(10**9 + k).points for k in range(32))
    objects = KittiObjects(kitti)
    names = objects.names("train", grades="AB")
    return FitnessProfile.from_scans(objects.frame(n).points for n in names[:: max(1, len(names) // 64)])
