"""Sensors that are found in the points of scans, beside those that took them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets.scan_folder import ScanFolder
from ..errors import PointsError, SensorError
from ..preprocess.sensor_estimate import MOST_SCANS, estimate_sensor
from ..readers.captures import known_sensor, read_scans
from ..simulation.samples import FIRST_SEED, simulated_scan
from ..types.points import Points
from ..types.sensor import SensorProfile, get_sensor

RIGHT_DEG = 0.1  # of an elevation


def find_sensors(datasets: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Find the sensor of each set: of its first three scans, each alone, and of all. An estimate is right if its beams
    are all within 0.1 degrees of one of the sensor each, without a gap. Raises PointsError, SensorError.
    """
    return {dataset: _of_one(*_source(dataset)) for dataset in datasets}


def _of_one(sensor: SensorProfile, scans: Iterator[Points]) -> dict[str, Any]:
    taken = list(islice(scans, MOST_SCANS))
    found: dict[str, None] = {}
    counts, off_deg = {"right": 0, "cannot_tell": 0, "wrong": 0}, list[float]()
    for some in ([[scan] for scan in taken] + [taken])[: len(taken) + (len(taken) > 1)]:
        try:
            profile = estimate_sensor(some).profile
        except SensorError:
            counts["cannot_tell"] += 1
            continue
        found[profile.name] = None
        error_deg, is_whole = compare_beams(profile, sensor)
        off_deg.append(error_deg)
        counts["right" if error_deg <= RIGHT_DEG and is_whole else "wrong"] += 1
    most_deg = round(max(off_deg), 3) if off_deg else None
    return {"sensor": sensor.name, "found": [*found], "n_scans": len(taken), **counts, "off_deg": most_deg}


def compare_beams(found: SensorProfile, sensor: SensorProfile) -> tuple[float, bool]:
    """Largest difference between the beams found and those next to them [deg]; whether none between them is missing."""
    off = np.abs(np.array(found.elevations_deg)[:, None] - np.array(sensor.elevations_deg))
    nearest = off.argmin(axis=1)
    return float(off.min(axis=1).max()), bool((np.diff(nearest) == 1).all())


def _source(dataset: str) -> tuple[SensorProfile, Iterator[Points]]:
    """The sensor of a set, and its scans."""
    name, equals, source = dataset.partition("=")
    if source == "simulation":
        sensor = get_sensor(name)
        return sensor, (simulated_scan(FIRST_SEED + k, sensor).points for k in range(MOST_SCANS))
    path = Path(source if equals else name)
    if equals:
        return get_sensor(name), (points for _, points in read_scans(path))
    if path.exists() and (known := known_sensor(path)) is not None:
        return known.profile, (points for _, points in read_scans(path))
    try:
        folder = ScanFolder.parse(dataset)
    except PointsError as exc:
        raise PointsError(
            f"{exc}. Expected SENSOR=simulation, SENSOR=PATH of scans, a capture, or labeled scans: a folder with "
            "scans.json, or FOLDER:LAYOUT"
        ) from exc
    return folder.layout.sensor, (folder.frame(name).points for name in folder.names("all"))
