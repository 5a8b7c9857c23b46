"""Scans to measure with: simulated ones with ground truth, or the user's own."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc import Box, PointsError, SensorError, read_points
from edgeperc.cli.scans import sensor_in
from edgeperc.preprocess.sensor_estimate import MOST_SCANS, has_enough_points
from edgeperc.simulation.samples import FIRST_SEED, simulated_scan
from edgeperc.simulation.scene import SimulatedScan
from edgeperc.system.names import SCAN_SUFFIXES
from edgeperc.system.printable import many
from edgeperc.types.choices import AUTO_SENSOR, DEFAULT_SENSOR
from edgeperc.types.points import Floats32, Points
from edgeperc.types.sensor import SENSORS, get_sensor


@dataclass(frozen=True)
class Input:
    """Scans as files for measuring processes."""

    files: tuple[Path, ...]  # .npy, (n, 4) float32 in the sensor's raw unit of remission
    truth: tuple[SimulatedScan, ...]  # empty if there is none
    record: dict[str, Any]  # for the report; two reports with the same ``sha256`` are of the same scans


def simulated_input(folder: Path, n: int, sensor: str) -> Input:
    """The first scans of `edgeperc eval simulation`; no model was trained on their scenes."""
    truth = [simulated_scan(FIRST_SEED + k, sensor) for k in range(n)]
    scans = [raw(scan.points, sensor) for scan in truth]
    source = f"{n} simulated scans, seeds {FIRST_SEED} to {FIRST_SEED + n - 1}"
    return _stored(folder, scans, tuple(truth), source, sensor)


def raw(points: Points, sensor: str) -> Floats32:
    """Convert the remission of simulated points from 0..1 to the sensor's raw unit."""
    profile = get_sensor(sensor)
    points = points.copy()
    points[:, 3] = points[:, 3] / np.float32(profile.remission_scale) - np.float32(profile.remission_offset)
    return points


def read_input(folder: Path, paths: Sequence[Path], sensor: str) -> tuple[Input, str]:
    """The user's scans: files, and all scan files of folders; and their sensor, for a `Perceiver`: the given one, or of
    "auto" the file of that which their points show. Raises PointsError where there is no scan, SensorError.
    """
    if sensor != AUTO_SENSOR:
        get_sensor(sensor)
    files: list[Path] = []
    for path in paths:
        found = sorted(p for p in path.iterdir() if p.suffix.lower() in SCAN_SUFFIXES) if path.is_dir() else [path]
        if not found:
            raise PointsError(f"{path} holds no scan; expected files that end in {', '.join(SCAN_SUFFIXES)}")
        files += found
    scans = [np.ascontiguousarray(read_points(file)) for file in files]
    by_folder: dict[Path, list[Floats32]] = {}  # `edgeperc run` finds the sensor of each folder
    for file, scan in zip(files, scans, strict=True):
        if sensor == AUTO_SENSOR and has_enough_points(scan):
            by_folder.setdefault(file.parent, []).append(scan)
    source = f"{many(len(files), 'scan')}: {', '.join(file.name for file in files[:8])}"
    name = sensor = DEFAULT_SENSOR if sensor == AUTO_SENSOR and not by_folder else sensor  # as `edgeperc run` takes it
    if sensor == AUTO_SENSOR:
        seen = {where: sensor_in(some[:MOST_SCANS]) for where, some in by_folder.items()}
        sure = {where: each for where, each in seen.items() if not each.doubt}
        if len({each.profile.name for each in sure.values()}) > 1:
            names = ", ".join(f"{where} of {each.profile.name}" for where, each in sure.items())
            raise SensorError(f"the scans are of several sensors: {names}; measure those of each on their own")
        for where, estimate in seen.items():
            estimate.tell_doubt("warn", f"{where}: ")
        estimate = next(iter((sure or seen).values()))
        name = sensor = estimate.profile.name
        if estimate.profile not in SENSORS.values():
            sensor = str(folder / f"{name}.json")
            Path(sensor).write_text(estimate.profile.to_json(), encoding="utf-8")
    return _stored(folder, scans, (), source + (" ..." if len(files) > 8 else ""), name), sensor


def store(folder: Path, name: str, points: Points) -> Path:
    """Write points to a file in ``folder``, which is temporary."""
    file = folder / f"{name}.npy"
    try:
        np.save(file, points)
    except OSError as exc:  # of a full disk, numpy says two numbers
        raise OSError(f"{file} cannot be written ({exc}); set TMPDIR to a folder with more space") from exc
    return file


def _stored(
    folder: Path, scans: Sequence[Floats32], truth: tuple[SimulatedScan, ...], source: str, sensor: str
) -> Input:
    files = tuple(store(folder, f"{k:06d}", scan) for k, scan in enumerate(scans))
    record = {
        "source": source,
        "sensor": sensor,
        "n_points": [len(scan) for scan in scans],
        "sha256": hashlib.sha256(b"".join(hashlib.sha256(scan.tobytes()).digest() for scan in scans)).hexdigest(),
    }
    return Input(files, truth, record)


def sized(n_points: int, sensor: str) -> Floats32:
    """Make a scan of ``n_points`` points, sampled from one simulated scan or from several merged ones."""
    scans: list[Floats32] = []
    while sum(map(len, scans)) < n_points:
        scans.append(simulated_scan(FIRST_SEED + len(scans), sensor).points)
    points = np.concatenate(scans)
    # In the sensor's own order, which decides how caches are used.
    rows = np.sort(np.random.default_rng(0).choice(len(points), n_points, replace=False))
    return raw(points[rows], sensor)


def crowd(n_cars: int, sensor: str) -> Floats32:
    """Make a scan of a street with up to 28 cars in the top view, in rows of four, the nearest first."""
    size = (4.2, 1.8, 1.6)
    places = [(9.0 + 5.5 * row, y) for row in range(7) for y in (2.5, -2.5, 7.5, -7.5)][:n_cars]
    boxes = [Box("car", 1.0, (x, y, -1.73 + size[2] / 2.0), size, 0.0) for x, y in places]
    return raw(simulated_scan(FIRST_SEED, sensor, boxes).points, sensor)
