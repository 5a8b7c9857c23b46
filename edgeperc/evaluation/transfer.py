"""Other sensors: the accuracy of a model that was not trained on them, with and without adaptation (KUL-Seg, Table 6),
and which of them are found in the points of scans.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets.layout import class_number
from ..datasets.scan_folder import ScanFolder, ScanFrame
from ..datasets.splits import names_of
from ..errors import ModelError, PointsError, SensorError, SplitError
from ..perceiver import ADAPTATIONS, Perceiver
from ..preprocess.sensor_estimate import MOST_SCANS, estimate_sensor
from ..preprocess.sensor_fit import fit_sensor
from ..readers.captures import known_sensor, read_scans
from ..simulation.samples import FIRST_SEED, IGNORE, in_models_frame, labels_by_boxes, simulated_scan
from ..simulation.scene import POINT_CLASSES
from ..system.pool import map_in_processes, taken
from ..types.choices import AUTO_SENSOR
from ..types.perception import Box
from ..types.points import Labels, Points
from ..types.sensor import SensorProfile, get_sensor
from ..zoo import DEFAULT
from .judge import Judge, Perceiving, check_scans, check_unseen, renamed, training_scans_of
from .metrics import FEWEST_RETURNS, Confusion, ObjectKey, object_key
from .tables import FEWEST_OBJECTS, figures
from .truth import seeds_of

N_FITTED = 8  # scenes for a remission function, from seeds before the evaluated ones
FARTHEST_M = 50.0
RIGHT_DEG = 0.1  # of an elevation

# Train ids of PCLSegmentation's range images: Road to Vegetation, Person, Two-wheeler, Car, Truck, Bus, None.
IMAGE_LABELS = np.array([0, 0, 0, 0, 0, 2, IGNORE, 1, 1, 1, IGNORE], np.uint8)

# The simulator gives every sensor the remission of an HDL-64E. These measured pairs (remission, raw value) turn it into
# the raw value of another sensor: Ouster's signal by KUL-Seg's Table 4; Velodyne's calibrated byte by equal quantiles
# of 13 nuScenes scans (HDL-32E) and of `edgeperc.preprocess.sensor_fit.REFERENCES`.
OUSTER_SIGNAL = (9000.0, (0.0, 0.0148, 0.022, 0.426, 0.4838, 1.0), (0.0, 45.91, 113.28, 376.01, 714.5, 9000.0))
VELODYNE_BYTE = (
    255.0,
    (0.0, 0.01, 0.09, 0.16, 0.21, 0.27, 0.31, 0.34, 0.38, 0.41, 0.45, 0.54, 1.0),
    (2.0, 5.0, 7.0, 11.0, 15.0, 19.0, 27.0, 32.0, 43.0, 49.0, 56.0, 76.0, 255.0),
)


@dataclass(frozen=True, eq=False)
class Scan:
    """A labeled scan of another sensor."""

    name: str
    points: Points  # x, y, z [m] in the sensor frame, raw remission
    labels: Labels  # index into `POINT_CLASSES`, `IGNORE` where unknown
    # labeled ones within 50 m by class; None if only points or pixels are labeled
    objects: frozenset[tuple[str, ObjectKey]] | None
    drive: str = ""  # the scans of one follow one another, and have one mounting


_DataSet = tuple[SensorProfile, int, Callable[[], Iterator[Scan]], "ScanFolder | None"]
"""Sensor, number of scans, a function that reads them, and their folder if they have boxes."""


def compare(
    datasets: Sequence[str],
    model: str | Path = "pointseg",
    *,
    provider: str = "cpu",
    precision: str = "auto",
    workers: int | None = None,
    on_scan: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """IoU of points by class for each dataset and each of `ADAPTATIONS`, of labeled scans with boxes also their
    figures. Scans are perceived as a user's; the function of a simulated sensor is fitted to other scenes.
    """
    sets = {name: _dataset(name) for name in datasets}
    for sensor, _, _, folder in sets.values():
        if folder is not None:
            check_scans(folder, sensor, names_of(folder, "test"))
    sizes = {name: (len(ADAPTATIONS) + (folder is not None)) * n for name, (_, n, _, folder) in sets.items()}
    total, done, result = sum(sizes.values()), 0, dict[str, Any]()

    def count(n: int = 1) -> None:
        nonlocal done
        done += n
        on_scan(done, total)

    answers: Iterator[Any] = (_compare_one(model, provider, precision, each, count) for each in sets.values())
    if has_workers := (workers or 1) > 1:
        answers = map_in_processes(partial, (_named, model, provider, precision), [*sets], workers=workers)
    for name, answer in zip(sets, answers, strict=True):
        result[name] = taken(answer, name)
        if has_workers:
            count(sizes[name])
    return result


def _named(model: str | Path, provider: str, precision: str, name: str) -> dict[str, Any]:
    """The figures of a data set in a worker process."""
    return _compare_one(model, provider, precision, _dataset(name), lambda: None)


def _compare_one(
    model: str | Path, provider: str, precision: str, dataset: _DataSet, count: Callable[[], None]
) -> dict[str, Any]:
    """The figures of a data set; ``count`` is called after each scan."""
    sensor, n_scans, read, folder = dataset
    perceivers = {
        adaptation: Perceiver(
            model,
            sensor=sensor,
            provider=provider,
            precision=precision,
            on_mismatch="ignore",
            adapt=adaptation,
            boxes_from="network",  # only points are evaluated
            full_turn=True,
        )
        for adaptation in ADAPTATIONS
    }
    counts = {adaptation: Confusion(POINT_CLASSES) for adaptation in ADAPTATIONS}
    trained_on = training_scans_of(perceivers["none"].cards)
    objects: set[tuple[str, ObjectKey]] | None = set()
    drive: str | None = None
    for scan in read():
        check_unseen(trained_on, scan.name, scan.drive or scan.name, scan.points)
        is_other, drive = drive not in (None, scan.drive), scan.drive
        for adaptation, perceive in perceivers.items():
            if is_other:
                perceive.reset_mounting()
            _count(counts[adaptation], perceive, scan)
            count()
        objects = None if objects is None or scan.objects is None else objects | scan.objects
    function = sensor.remission
    result: dict[str, Any] = {
        "n_scans": n_scans,
        "network": perceivers["none"].cards[0].name,
        "function": None
        if function is None
        else f"{function.kind} {', '.join(f'{c:.4g}' for c in function.coefficients)}",
        **_distinct(objects),
        **{adaptation: _row(confusion) for adaptation, confusion in counts.items()},
    }
    if folder is not None:
        top_view, _, of_objects = DEFAULT
        judge = Judge([top_view, model, of_objects], Perceiving(provider, precision), sensor=sensor)
        records = []
        try:
            for frame in _frames(folder):
                records.append(judge.record_boxes(frame))
                count()
        except SplitError as exc:  # of the network of objects: points were measured
            return {**result, "no_boxes": str(exc)}
        measured = figures(records)
        result["boxes"] = {key: measured[key] for key in ("kitti", "centers") if key in measured}
    return result


def _distinct(objects: set[tuple[str, ObjectKey]] | None) -> dict[str, Any]:
    if objects is None:
        return {"n_objects": None, "few": []}
    n_objects = {name: sum(kind == name for kind, _ in objects) for name in POINT_CLASSES[1:]}
    return {"n_objects": n_objects, "few": [name for name, n in n_objects.items() if 0 < n < FEWEST_OBJECTS]}


def _count(confusion: Confusion, perceive: Perceiver, scan: Scan) -> None:
    predicted = perceive(scan.points).points
    if predicted is None:
        raise ModelError(f"{perceive.cards[0].name} labels no points; pass a range-image model")
    near = np.hypot(scan.points[:, 0], scan.points[:, 1]) < FARTHEST_M
    known = predicted.in_view & near & (scan.labels != IGNORE)
    confusion.update(renamed(predicted.labels[known], predicted.classes, POINT_CLASSES), scan.labels[known])


def _row(confusion: Confusion) -> dict[str, Any]:
    n_points = dict(zip(POINT_CLASSES, confusion.counts.sum(axis=1).tolist(), strict=True))
    iou = dict(zip(POINT_CLASSES, confusion.iou().tolist(), strict=True))
    known = {name: iou[name] if n_points[name] else None for name in POINT_CLASSES}
    objects = [iou[name] for name in POINT_CLASSES[1:] if n_points[name]]
    return {"iou": known, "mean_iou": sum(objects) / len(objects) if objects else None, "n_points": n_points}


def _dataset(name: str) -> _DataSet:
    sensor_name, equals, source = name.partition("=")
    if not equals:
        return _of_folder(_folder(name))
    if sensor_name == AUTO_SENSOR:
        folder = _folder(source)
        first = [frame.points for frame in islice(_frames(folder), MOST_SCANS)]
        return _of_folder(folder, replace(estimate_sensor(first).profile, mounting=folder.layout.sensor.mounting))
    sensor = get_sensor(sensor_name)
    if source.partition(":")[0] == "simulation":
        seeds = seeds_of(source)
        sensor = replace(sensor, remission_range=(0.0, _raw_model(sensor)[0]), remission=None)
        fitted, _ = fit_sensor([_simulated(sensor, FIRST_SEED - 1 - k).points for k in range(N_FITTED)], sensor)
        return fitted, len(seeds), lambda: (_simulated(sensor, seed) for seed in seeds), None
    images = sorted(Path(source).glob("*.npy"))
    if images:
        return sensor, len(images), lambda: map(_from_image, images), None
    return _of_folder(_folder(source), sensor)


def _of_folder(folder: ScanFolder, sensor: SensorProfile | None = None) -> _DataSet:
    with_boxes = folder if folder.layout.boxes else None
    return (
        sensor or folder.layout.sensor,
        len(names_of(folder, "test")),
        lambda: map(_of_frame, _frames(folder)),
        with_boxes,
    )


def _folder(source: str, others: str = "SENSOR=simulation:N, SENSOR=FOLDER of range images NAME.npy") -> ScanFolder:
    try:
        return ScanFolder.parse(source)
    except PointsError as exc:
        raise PointsError(
            f"{exc}. Expected {others}, or labeled scans: a folder with scans.json, or FOLDER:LAYOUT"
        ) from exc


def _frames(folder: ScanFolder) -> Iterator[ScanFrame]:
    return map(folder.frame, names_of(folder, "test"))


def _of_frame(frame: ScanFrame) -> Scan:
    if frame.boxes is None:
        return Scan(frame.name, frame.points, frame.labels(), None, frame.drive)
    objects = _objects(frame.drive, zip(frame.boxes, frame.returns, strict=True))
    return Scan(frame.name, frame.points, frame.labels(by="boxes"), objects, frame.drive)


def _objects(drive: str, boxes: Iterable[tuple[Box, int]]) -> frozenset[tuple[str, ObjectKey]]:
    """Distinct objects of boxes and their numbers of returns."""
    numbered = [(class_number(box.label, POINT_CLASSES), box, n) for box, n in boxes]
    return frozenset(
        (POINT_CLASSES[kind], object_key(drive, box))
        for kind, box, n in numbered
        if kind not in (0, IGNORE) and n >= FEWEST_RETURNS and np.hypot(*box.center[:2]) < FARTHEST_M
    )


def _raw_model(sensor: SensorProfile) -> tuple[float, tuple[float, ...], tuple[float, ...]]:
    return OUSTER_SIGNAL if sensor.name.startswith("os") else VELODYNE_BYTE


def _simulated(sensor: SensorProfile, seed: int) -> Scan:
    scan = simulated_scan(seed, sensor)
    _, remissions, raws = _raw_model(sensor)
    rng = np.random.default_rng((seed, 5))
    points = scan.points.copy()
    # Undo the rounding to 0.01, and add 10 % of noise.
    spread = points[:, 3] + rng.uniform(-0.005, 0.005, len(points))
    raw = np.interp(spread, remissions, raws) * rng.lognormal(0.0, 0.1, len(points))
    points[:, 3] = np.minimum(np.rint(raw), raws[-1])
    objects = _objects(f"scene {seed}", zip(scan.boxes, scan.box_points, strict=True))
    return Scan(f"scene {seed}", points, labels_by_boxes(in_models_frame(scan, sensor)), objects)


def _from_image(path: Path) -> Scan:
    image = np.load(path, allow_pickle=False)
    if image.ndim != 3 or image.shape[2] != 6:
        raise PointsError(
            f"{path}: an array of shape {image.shape}; expected (H, W, 6): x, y, z, remission, range, label"
        )
    pixels = image[image[..., 4] > 0.0]
    labels = pixels[:, 5].astype(np.int64)
    if labels.size and not 0 <= labels.min() <= labels.max() < len(IMAGE_LABELS):
        raise PointsError(
            f"{path}: labels from {labels.min()} to {labels.max()}; expected 0 to {len(IMAGE_LABELS) - 1}"
        )
    return Scan(path.stem, np.ascontiguousarray(pixels[:, :4], np.float32), IMAGE_LABELS[labels], None)


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
            estimate = estimate_sensor(some)
        except SensorError:
            counts["cannot_tell"] += 1
            continue
        found[estimate.profile.name] = None
        if estimate.doubt:
            counts["cannot_tell"] += 1
            continue
        error_deg, is_whole = compare_beams(estimate.profile, sensor)
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
    folder = _folder(dataset, "SENSOR=simulation, SENSOR=PATH of scans, a capture")
    return folder.layout.sensor, (folder.frame(name).points for name in folder.names("all"))
