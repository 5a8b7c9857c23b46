"""Training samples of the object network: candidates of labeled scans, as the runtime finds and crops them.

A sample is a crop with more points than the network takes, and the object that its candidate covers. No score and no
label of another network is in it: those are overfitted on the training drives.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from edgeperc.ground.planes import find_ground
from edgeperc.ground.scan import Scan
from edgeperc.objects.candidates import MIN_DETECTOR_SCORE, Candidates, find_candidates, sort_into_cells
from edgeperc.objects.crops import crop_candidates
from edgeperc.perceiver import Perceiver
from edgeperc.simulation.samples import BOX_ABOVE_GROUND_M, IGNORE
from edgeperc.system.atomic import open_atomic
from edgeperc.types.geometry import oriented_iou, rectangles
from edgeperc.types.mounting import MODEL_HEIGHT_M, MODEL_MOUNTING
from edgeperc.types.perception import Box
from edgeperc.types.points import Floats, Floats32, Ints, Ints64, Labels, Mask, read_only

from ..cards import BOX_SIZES, OBJECT_CLASSES, OBJECT_VIEW
from ..data.processes import mapped
from ..data.scans import TRAINING_SENSOR, LabeledScan
from .object_task import VEHICLE

DriveScan = tuple[str, Callable[[], LabeledScan]]
"""A drive, and what reads or makes a scan of it."""

DETECTOR = "ssadnet"
"""The model whose boxes are candidates."""

N_STORED = 192  # points of a crop; training draws from them
STORED_MARGIN_M = 1.5
MAX_NEGATIVES = {"real": 120, "simulated": 48}  # groups without an object, of each scan
PSEUDO_BOXES = 0.3  # share of the groups that also become a box of a vehicle's or a person's size
PSEUDO_ODDS = {"car": 0.6, "van": 0.15, "truck": 0.05, "pedestrian": 0.1, "cyclist": 0.1}
MIN_RETURNS = 3  # of an object that is a sample
PART = 100  # scans

GROUP, DETECTED, TRUE = 0, 1, 2  # origins of candidates
BACKGROUND = 0
UNKNOWN = -2  # nothing is known of what is there
NAMES = {name: k for k, name in enumerate(OBJECT_CLASSES)} | {
    "person_sitting": OBJECT_CLASSES.index("pedestrian"),
    "background": BACKGROUND,
    "construction vehicle": VEHICLE,
}


class ObjectSamples(NamedTuple):
    """Samples; all in the frame of the models."""

    points: NDArray[np.float16]  # (m, N_STORED, 4), as in `objects.crops.Crops`
    counts: Ints
    rectangles: Floats32  # (m, 5), of the candidates
    level: Floats32
    origin: NDArray[np.int8]  # `GROUP`, `DETECTED` or `TRUE`
    classes: NDArray[np.int8]  # index into the classes of objects, or `VEHICLE`
    truth: Floats32  # (m, 7), middle, length, width, height [m], yaw [rad]; 0 for background
    objects: Ints64  # one number for all samples of an object; for background, of a scan
    sources: NDArray[np.int8]  # numbers of the sources; `load_samples` knows them


def build_samples(
    folder: Path,
    name: str,
    scans: Sequence[DriveScan],
    *,
    real: bool,
    detector: bool = True,
    n_workers: int = 0,
    made_of: str = "",
) -> str:
    """Write the samples of scans of drives into ``folder``, in parts; finished ones of the same scans and labels are
    kept. ``made_of`` says which these are, `digest_of` the scans by default; returns it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    made_of, note = made_of or digest_of(scans), folder / f"{name}.sha256"
    if not note.exists() or note.read_text() != made_of:
        for stale in _parts(folder, name):
            stale.unlink()
        with open_atomic(note) as text:
            text.write(made_of.encode())
    parts = [scans[first : first + PART] for first in range(0, len(scans), PART)]
    missing = [(k, part) for k, part in enumerate(parts) if not (folder / f"{name}-{k:03d}.npz").exists()]
    write = partial(_write_part, folder=folder, name=name, real=real, detector=detector)
    with mapped(write, missing, n_workers) as done:
        for _ in tqdm(done, desc=f"candidates of {name}", unit="part", total=len(missing)):
            pass
    return made_of


def digest_of(scans: Sequence[DriveScan]) -> str:
    """The SHA-256 of scans, their drives and their labels, in hexadecimal digits."""
    digest = hashlib.sha256()
    for drive, make in scans:
        scan = make()
        digest.update(repr((drive, len(scan.points), scan.boxes, scan.counts, scan.sensor)).encode())
        digest.update(scan.points.tobytes() + scan.labels.tobytes())
    return digest.hexdigest()


def digest_of_files(files: Sequence[Path]) -> str:
    """The SHA-256 of files and their names, in hexadecimal digits: a quarter of the time of reading them as scans."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(repr((file.name, hashlib.sha256(file.read_bytes()).hexdigest())).encode())
    return digest.hexdigest()


def _parts(folder: Path, name: str) -> list[Path]:
    return sorted(folder.glob(f"{name}-[0-9][0-9][0-9].npz"))


def _write_part(part: tuple[int, Sequence[DriveScan]], *, folder: Path, name: str, real: bool, detector: bool) -> None:
    number, scans = part
    perceive = detector and Perceiver(
        DETECTOR,
        mounting=MODEL_MOUNTING,
        n_threads=1,
        precision="fp32",
        score_threshold=MIN_DETECTOR_SCORE,
        boxes_from="network",
        agree=False,
        on_mismatch="ignore",
        adapt="none",
    )
    samples = []
    for k, (drive, scan) in enumerate(scans):
        rng = np.random.default_rng((number, k, len(name)))
        samples.append(samples_of(scan(), f"{name}/{drive}", perceive or None, rng, real=real))
    joined = ObjectSamples(*(np.concatenate(arrays) for arrays in zip(*samples, strict=True)))
    with open_atomic(folder / f"{name}-{number:03d}.npz") as file:
        np.savez(file, **joined._asdict())


def load_samples(folder: Path, names: Sequence[str]) -> ObjectSamples:
    """Read the samples of sources; their numbers are the places of their names. Raises ValueError."""
    read = []
    for source, name in enumerate(names):
        files = _parts(folder, name)
        if not files:
            raise ValueError(f"{folder} has no samples of {name}; write them first")
        for file in files:
            with np.load(file, allow_pickle=False) as data:
                part = ObjectSamples(**{field: data[field] for field in ObjectSamples._fields})
            read.append(part._replace(sources=np.full(len(part.counts), source, np.int8)))
    return ObjectSamples(*(np.concatenate(arrays) for arrays in zip(*read, strict=True)))


def samples_of(
    labeled: LabeledScan, drive: str, perceive: Perceiver | None, rng: np.random.Generator, *, real: bool
) -> ObjectSamples:
    """The samples of one scan; ``perceive`` finds boxes in the top view."""
    points = read_only(labeled.points)
    scan = Scan.of(points, find_ground(points, mount_height_m=MODEL_HEIGHT_M))
    cells = sort_into_cells(scan, OBJECT_VIEW.height_range_m)
    detected = rectangles(perceive(points).boxes if perceive is not None else ())
    sensor = labeled.sensor or TRAINING_SENSOR
    groups = find_candidates(scan, cells, sensor.link_per_m).rectangles
    truths = [(box, n) for box, n in zip(labeled.boxes, labeled.counts, strict=True)]
    boxes = [box for box, _ in truths]
    known = np.array([n >= MIN_RETURNS and box.label in NAMES for box, n in truths], np.bool_)
    pseudo = _pseudo_boxes(groups[rng.permutation(len(groups))[: int(PSEUDO_BOXES * len(groups))]], rng)
    true = rectangles(box for box, use in zip(boxes, known, strict=True) if use and NAMES[box.label] != BACKGROUND)
    places = np.concatenate([groups, detected, pseudo, true])
    origin = np.repeat(
        np.array([GROUP, DETECTED, DETECTED, TRUE], np.int8), [len(groups), len(detected), len(pseudo), len(true)]
    )
    of_box = _assigned(scan, labeled.labels, places, boxes)
    crops = crop_candidates(scan, Candidates(places, cells), N_STORED, STORED_MARGIN_M)
    labels = np.array([NAMES.get(box.label, UNKNOWN) if n >= MIN_RETURNS else UNKNOWN for box, n in truths], np.int8)
    classes = np.where(of_box >= 0, np.append(labels, np.int8(0))[of_box], np.where(of_box == -1, BACKGROUND, UNKNOWN))
    keep = (classes != UNKNOWN) & (crops.counts >= MIN_RETURNS)
    negatives = np.flatnonzero(keep & (classes == BACKGROUND) & (origin == GROUP))
    keep[rng.permutation(negatives)[MAX_NEGATIVES["real" if real else "simulated"] :]] = False
    at = np.flatnonzero(keep)
    truth = np.array([[*box.center, *box.size, box.yaw] for box in boxes], np.float32).reshape(-1, 7)
    if not real:
        truth[:, 2] += BOX_ABOVE_GROUND_M  # as KITTI's boxes are
    truth = np.where((classes == BACKGROUND)[:, None], 0.0, np.concatenate([truth, np.zeros((1, 7))])[of_box])
    keys = np.array([hash_of(drive, box) for box in boxes] + [hash_of(drive, None)], np.int64)
    return ObjectSamples(
        crops.points[at].astype(np.float16),
        crops.counts[at],
        places[at].astype(np.float32),
        crops.level[at].astype(np.float32),
        origin[at],
        classes[at].astype(np.int8),
        truth[at].astype(np.float32),
        np.where(classes == BACKGROUND, keys[-1], keys[of_box])[at],
        np.zeros(len(at), np.int8),
    )


def hash_of(drive: str, box: Box | None) -> int:
    """A number of an object in all scans of a drive, by its class and its size, or of the drive's background."""
    key = (drive, "", 0.0) if box is None else (drive, box.label, *(round(side, 2) for side in box.size))
    return int.from_bytes(hashlib.sha256(repr(key).encode()).digest()[:8], "little", signed=True)


def _pseudo_boxes(groups: Floats, rng: np.random.Generator) -> Floats:
    """Rectangles of usual sizes whose near corner is that of a group: what a detector that errs would find there."""
    places = groups[np.max(groups[:, 2:4], axis=1, initial=0.0) < 8.0].copy() if len(groups) else groups
    names = rng.choice([*PSEUDO_ODDS], len(places), p=[*PSEUDO_ODDS.values()])
    for place, name in zip(places, names, strict=True):
        length, width, _ = np.array(BOX_SIZES[str(name)]) * np.exp(rng.normal(0.0, 0.08, 3))
        place[4] += rng.normal(0.0, 0.1) + (math.pi / 2.0 if rng.random() < 0.3 else 0.0)
        cos, sin = math.cos(place[4]), math.sin(place[4])
        ahead, left = cos * place[0] + sin * place[1], cos * place[1] - sin * place[0]
        grown = [max(length - place[2], 0.0), max(width - place[3], 0.0)]
        along, across = 0.5 * math.copysign(grown[0], ahead), 0.5 * math.copysign(grown[1], left)
        place[0] += cos * along - sin * across + rng.normal(0.0, 0.2)
        place[1] += sin * along + cos * across + rng.normal(0.0, 0.2)
        place[2:4] = length, width
    return places


def _assigned(scan: Scan, labels: Labels, places: Floats, boxes: Sequence[Box]) -> Ints64:
    """The row of the object that each candidate covers: IoU above 0.4, or 0.6 of its points and 0.3 of the object's;
    -1: none, -2: unknown or a part of one, which shares less than that but more than a tenth or a quarter.
    """
    unknown = read_only(np.column_stack([scan.points[:, :3], labels == IGNORE]))
    marked = Scan.of(unknown, scan.ground)
    cells = sort_into_cells(scan, (0.15, 4.0))
    crops = crop_candidates(marked, Candidates(places, cells), 64, 0.05)
    of_box = np.where(crops.points[:, :, 3].mean(axis=1) > 0.5, -2, -1)
    if not boxes or not len(places):
        return of_box
    true = rectangles(boxes)
    iou = oriented_iou(places, true)
    above = scan.points[cells.rows, :2].astype(np.float64)
    shared = np.zeros(iou.shape)
    n_true = np.zeros(len(true))
    for k, box in enumerate(true):
        inside = _within(above, box, 0.1)
        n_true[k] = np.count_nonzero(inside)
        own = above[inside]
        for row in np.flatnonzero(np.hypot(*(places[:, :2] - box[:2]).T) < 10.0).tolist() if len(own) else ():
            shared[row, k] = np.count_nonzero(_within(own, places[row], 0.05))
    of_place, of_true = shared / np.maximum(crops.counts, 1)[:, None], shared / np.maximum(n_true, 1.0)
    covers = (iou > 0.4) | ((of_place > 0.6) & (of_true > 0.3))
    some = (iou > 0.1) | (of_place > 0.25) | (of_true > 0.25)
    best = np.where(covers, iou + of_place + of_true, -1.0).argmax(axis=1)
    return np.where(covers.any(axis=1), best, np.where(some.any(axis=1), -2, of_box))


def _within(xy: Floats, rectangle: Floats, margin_m: float) -> Mask:
    """Which points (n, 2) are in a rectangle grown by a margin."""
    x, y, length, width, yaw = rectangle.tolist()
    dx, dy, cos, sin = xy[:, 0] - x, xy[:, 1] - y, math.cos(yaw), math.sin(yaw)
    along, across = np.abs(cos * dx + sin * dy), np.abs(cos * dy - sin * dx)
    return (along < 0.5 * length + margin_m) & (across < 0.5 * width + margin_m)
