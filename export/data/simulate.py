"""Simulated scans: to train on, to verify an export on, and to describe the expected input in its card."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from tqdm import tqdm

from edgeperc.datasets.kitti import KittiObjects, layouts
from edgeperc.preprocess.fitness import FitnessProfile
from edgeperc.readers.files import read_points
from edgeperc.readers.images import read_image
from edgeperc.simulation.camera import forward_camera, render
from edgeperc.simulation.samples import in_models_frame, simulated_scan
from edgeperc.types.perception import Box
from edgeperc.types.sensor import SensorProfile, get_sensor

from .processes import mapped
from .scans import TRAINING_SENSOR, LabeledScan, opened


def simulate(
    out: Path,
    n: int,
    *,
    first: int = 0,
    layouts_root: Path | None = None,
    sensor: str = "hdl-64e",
    where: str = "street",
    n_workers: int = 0,
) -> None:
    """Write ``n`` labeled scans, of seeds from ``first``, into ``out``; of streets, every other one has the boxes of a
    scan of KITTI's ``layouts_root``. Existing files are kept, so a stopped run resumes; ValueError if they are of
    another sensor or place, or with layouts and now without. The scans are the same for any ``n_workers``.
    """
    if layouts_root is not None and where != "street":
        raise ValueError(f"layouts are those of streets, and the place is a {where}; leave them out")
    out.mkdir(parents=True, exist_ok=True)
    real = list(layouts(layouts_root)) if layouts_root else []
    place = f"{where} with layouts" if real else where
    profile = get_sensor(sensor)
    _check_kept(out, range(first, first + n), profile.upright(profile.mounting), place)
    missing = [seed for seed in range(first, first + n) if not _path(out, seed).exists()]
    write = partial(_simulate, out=out, layouts=real, sensor=profile, where=where, place=place)
    with mapped(write, missing, n_workers) as done:
        for _ in tqdm(done, desc="simulating", unit="scan", total=len(missing)):
            pass


def simulated_files(folder: Path) -> list[Path]:
    """The scans that `simulate` wrote into a folder; ValueError without one, which a mistyped name has not either."""
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise ValueError(f"{folder} holds no simulated scan; expected a folder written by edgeperc-export simulate")
    return files


def _path(out: Path, seed: int) -> Path:
    return out / f"{seed:06d}.npz"


def _check_kept(out: Path, seeds: range, sensor: SensorProfile, place: str) -> None:
    for path in filter(Path.exists, (_path(out, seed) for seed in seeds)):
        with opened(path) as data:
            profile, taken_at = (str(data[name]) if name in data else "" for name in ("sensor", "place"))
        kept = SensorProfile.from_json(profile) if profile else TRAINING_SENSOR
        if kept != sensor:
            other = "another " * (kept.name == sensor.name)
            raise ValueError(
                f"{path} is a scan of {other}{kept.name}, and would be kept; take another folder for {sensor.name}"
            )
        if taken_at not in (place, ""):  # earlier versions did not write it
            raise ValueError(f"{path} is a scan of a {taken_at}, and would be kept; take another folder for a {place}")


def _simulate(
    seed: int, *, out: Path, layouts: Sequence[Sequence[Box]], sensor: SensorProfile, where: str, place: str
) -> None:
    # 4,973 is prime: neighboring seeds take layouts of different drives.
    boxes = layouts[seed * 4973 % len(layouts)] if layouts and seed % 2 else None
    simulated = simulated_scan(seed, sensor, boxes, where=where, clumped_leaves=True)
    scan = LabeledScan.from_simulation(in_models_frame(simulated, sensor))
    if sensor != TRAINING_SENSOR:
        scan = replace(scan, sensor=sensor.upright(sensor.mounting))
    scan.save(_path(out, seed), place)


def parity_samples(task: str, paths: Sequence[Path] = ()) -> list[NDArray[Any]]:
    """Scans, or a camera's images, to verify an export on: the given files, and four simulated ones in no training
    set.
    """
    scans = [simulated_scan(seed) for seed in range(10**9, 10**9 + 4)]
    if task != "camera":
        return [*map(read_points, paths), *(scan.points for scan in scans)]
    camera = forward_camera(480, 360)
    streets = (render(scan.scene, camera, scan.T_world_sensor, seed) for seed, scan in enumerate(scans, start=10**9))
    return [*map(read_image, paths), *(street.rgb for street in streets)]


def fitness_of(kitti: Path | None) -> FitnessProfile:
    """What inputs are compared with at runtime: the profile of KITTI's training scans, or of 32 simulated ones."""
    if kitti is None:
        return FitnessProfile.from_scans(simulated_scan(10**9 + k).points for k in range(32))
    objects = KittiObjects(kitti)
    names = objects.names("train", grades="AB")
    return FitnessProfile.from_scans(objects.frame(n).points for n in names[:: max(1, len(names) // 64)])
