"""Labeled scans of other sensors as training scans: moved into the frame of the models, and seen as the runtime would.

`read_scan_set` turns a `ScanFolder` into `LabeledScan`s. `seen_by_network` projects any training scan; between the
beams of a coarser sensor it fills the range image as `edgeperc.Perceiver` does.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, reduce
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from edgeperc.datasets.kitti import scan_hash
from edgeperc.datasets.layout import IGNORED, class_number
from edgeperc.datasets.scan_folder import ScanFolder, ScanFrame
from edgeperc.errors import MountingError
from edgeperc.evaluation.truth import road_cells
from edgeperc.ground.leveling import MountingEstimator
from edgeperc.inference.crop import Crop
from edgeperc.inference.projection import Projection, RangeImageProjector, TopViewProjector, input_heights, project
from edgeperc.preprocess.condition import condition
from edgeperc.preprocess.interpolation import Interpolator
from edgeperc.preprocess.remission import NO_REMISSION, RemissionMatcher, is_missing, tell_beyond
from edgeperc.simulation.samples import IGNORE
from edgeperc.simulation.scene import POINT_CLASSES
from edgeperc.types.frame import OF_MODELS, ModelFrame
from edgeperc.types.geometry import draw_footprints
from edgeperc.types.mounting import Mounting
from edgeperc.types.points import Bytes, Heights, Ints, Labels, Points
from edgeperc.types.sensor import SensorProfile

from .roads import box_sums
from .scans import SURFACE, LabeledScan

NEAR_M = 0.5
interpolator_of = lru_cache(maxsize=64)(Interpolator)


class Labeled(NamedTuple):
    """Scans to train on or to watch."""

    scans: list[LabeledScan]
    weights: list[float]  # how often each is drawn: all scans of a drive together as the square root of their number
    hashes: dict[str, str]  # name, or ``SET/NAME`` -> `edgeperc.datasets.kitti.scan_hash`


def joined(parts: Sequence[Labeled]) -> Labeled:
    """The scans of all parts."""
    return Labeled(
        [scan for part in parts for scan in part.scans],
        [weight for part in parts for weight in part.weights],
        reduce(joined_hashes, (part.hashes for part in parts), {}),
    )


def read_scan_set(
    folder: ScanFolder, split: str, fold: int | None = None, *, classes: Sequence[str] = POINT_CLASSES
) -> Labeled:
    """Read the labeled scans of a split; objects of other classes than those of points are unknown (`IGNORE`). As in a
    `Perceiver`, what the description does not say of the mounting is estimated from the first scans of each drive, and
    the remission is matched to that of the training sensor.
    """
    layout, names = folder.layout, folder.names(split, fold=fold)
    n_scans = Counter(folder.drives[name] for name in names)
    estimators: dict[str, MountingEstimator] = {}
    matchers: dict[str, RemissionMatcher] = {}
    sensors: dict[str, SensorProfile] = {}  # of each drive, with the function that all its scans have led to
    frames = [folder.frame(name) for name in tqdm(names, desc=f"reading {layout.name}", leave=False)]
    for frame in frames:
        estimator = estimators.setdefault(frame.drive, MountingEstimator(layout.sensor.mounting))
        with suppress(MountingError):  # perhaps another scan of the drive shows the ground
            estimators[frame.drive] = estimator.add(frame.points)
        if not is_missing(frame.points):
            matcher = matchers.get(frame.drive, RemissionMatcher(layout.sensor))
            matchers[frame.drive], sensors[frame.drive], _ = matcher.add(frame.points)
    tell_beyond(folder.root, layout.sensor, ((frame.name, frame.points) for frame in frames))
    scans: list[LabeledScan] = []
    for frame in frames:
        estimator = estimators[frame.drive]
        if not estimator.known.is_known and not estimator.n_scans:
            raise MountingError(
                f"{folder.root}: no scan of drive {frame.drive} shows the ground; give height_m, roll_deg and "
                "pitch_deg as mounting in the description"
            )
        sensor = replace(layout.sensor, remission=NO_REMISSION) if is_missing(frame.points) else sensors[frame.drive]
        points, _ = condition(frame.points, sensor)
        scans.append(labeled_scan(frame, points, estimator.mounting(), classes))
    of_labels = {class_number(name, classes) for name in (*layout.boxes.values(), *layout.points.values())}
    is_labeled = any(frame.boxes is not None or frame.point_classes is not None for frame in frames)
    # Other sets and simulated scans show what this one lacks, and hide that its objects are taught as background.
    if is_labeled and of_labels - {0, IGNORE} and not any((scan.labels % IGNORE).any() for scan in scans):
        warnings.warn(
            f"{folder.root}: no point of its scans of split {split} ({len(scans)}) is of {', '.join(classes[1:])}; "
            "check that boxes and points of its description have the names in the label files, and that these are of "
            "the scans, in their frame",
            stacklevel=2,
        )
    weights = [n_scans[frame.drive] ** -0.5 for frame in frames]
    return Labeled(scans, weights, {f"{layout.name}/{frame.name}": scan_hash(frame.points) for frame in frames})


def check_trains(folder: ScanFolder, *splits: str, fold: int | None = None) -> None:
    """Raise ValueError for a set without a scan of any of these splits, which would be left out in silence."""
    if not any(folder.names(split, fold=fold) for split in splits):
        raise ValueError(
            f"{folder.root} has {len(folder.drives)} labeled scans, and none is for {' or '.join(splits)}: its "
            "description keeps their drives for testing; leave the set out, or change splits"
        )


def joined_hashes(earlier: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """The hashes of both by name; an earlier scan keeps its hash if another one now has its name."""
    others = {
        name if own.get(name, digest) == digest else f"{name} {digest}": digest for name, digest in earlier.items()
    }
    return others | {**own}


def labeled_scan(
    frame: ScanFrame, points: Points, mounting: Mounting, classes: Sequence[str] = POINT_CLASSES
) -> LabeledScan:
    """A scan, its remission as of `condition.condition`, with its truth in the frame of the models."""
    model = ModelFrame(mounting)
    boxes = model.move_boxes(frame.boxes or ())
    surface = np.full((SURFACE.height, SURFACE.width), IGNORE, np.uint8)
    cells = road_cells(frame, mounting, SURFACE)
    if cells is not None:
        # Road also where three known cells within 1.4 m are road and none is another: 99.6 % of what it adds is road.
        road, other = (box_sums(known.astype(np.int64)) for known in (cells == 1, (cells != 1) & (cells != IGNORE)))
        cells = np.where((cells == IGNORE) & (road >= 3) & (other == 0), np.uint8(1), cells)
        surface = np.where(cells <= 1, cells, IGNORE).astype(np.uint8)
        # Of the ground under an ignored object nothing is known; vehicles are drawn over the surface later.
        unclear = np.zeros_like(surface)
        ignored = [replace(box, label="car") for box in boxes if box.label == IGNORED]
        draw_footprints(unclear, ignored, SURFACE, ("", "car"))
        surface[unclear > 0] = IGNORE
    finite = np.isfinite(points).all(axis=1)
    low, high = frame.azimuths
    yaw = math.radians(mounting.yaw_deg or 0.0)
    full = high - low >= 2.0 * math.pi - 1e-9
    return LabeledScan(
        np.array(model.move(points)[finite]),
        frame.labels(classes)[finite],
        boxes,
        frame.returns,
        surface,
        (-math.pi, math.pi) if full else (low + yaw, high + yaw),
        sensor=frame.layout.sensor.upright(mounting),
        boxes_known=frame.boxes is not None,
    )


def seen_by_network(
    projector: TopViewProjector | RangeImageProjector, scan: LabeledScan, seen_from: ModelFrame = OF_MODELS
) -> tuple[LabeledScan, Projection]:
    """A training scan projected as the runtime projects a scan of its sensor, for a network with points
    ``seen_from`` there; with interpolated points, labeled by `_nearest_labels`, if the range image of a coarser sensor
    was filled. The projection's ``index`` refers to the points of the returned scan, ``pixel`` to the given ones.
    """
    points = np.ascontiguousarray(scan.points, np.float32)
    projected = project(projector, points, seen_from)
    if scan.sensor is None or isinstance(projector, TopViewProjector):
        return scan, projected
    interpolator = interpolator_of(projector.view, scan.sensor)
    if not interpolator.needed or not len(points):
        return scan, projected
    filled_in, filled = interpolator.fill(seen_from.move_back(points), projected.index)
    dense = seen_from.move(filled_in)
    image = np.empty(projector.shape, np.float32)
    projector.fill_image(filled_in, filled, image, _heights_of_view(projector, dense, len(points)))
    labels = np.full(len(dense), IGNORE, np.uint8)
    labels[: len(points)] = scan.labels
    new = filled >= len(points)
    labels[filled[new]] = _nearest_labels(dense, filled, projected.index, labels)[new]
    return replace(scan, points=dense, labels=labels), Projection(image, filled, projected.pixel)


def _heights_of_view(projector: RangeImageProjector, dense: Points, n: int) -> Heights | None:
    """Heights of ``n`` points, and of interpolated ones behind them, above the ground that is found with those which
    the runtime keeps for the view; NaN for others.
    """
    rows = Crop([projector.view]).select(dense[:n])[1]
    kept = np.arange(len(dense)) if rows is None else np.concatenate([rows, np.arange(n, len(dense))])
    found = input_heights(projector, np.ascontiguousarray(dense[kept]))
    if found is None:
        return None
    heights = np.full(len(dense), np.nan, np.float32)
    heights[kept] = found
    return heights


def _nearest_labels(points: Points, filled: Ints, index: Ints, labels: Labels) -> Bytes:
    """Label of the nearest of the next measured points left, right, above and below, (H, W) uint8; `IGNORE` without
    one, or beyond `NEAR_M` unless all are background: on the road, points between two rings are interpolated over
    meters.
    """
    place = points[filled, :3]
    best, nearest = np.full(index.shape, np.inf, np.float32), np.full(index.shape, IGNORE, np.uint8)
    highest = np.zeros_like(nearest)
    for axis in (0, 1):
        for step in (1, -1):
            way = (slice(None), slice(None, None, step)) if axis else (slice(None, None, step), slice(None))
            ahead = index[way]
            position = np.expand_dims(np.arange(ahead.shape[axis]), 1 - axis)
            last = np.maximum.accumulate(np.where(ahead >= 0, position, -1), axis=axis)
            row = np.where(last >= 0, np.take_along_axis(ahead, np.maximum(last, 0), axis=axis), -1)[way]
            apart = np.where(row >= 0, np.linalg.norm(points[row, :3] - place, axis=2), np.inf)
            closer = apart < best
            best[closer], nearest[closer] = apart[closer], labels[row][closer]
            highest = np.where(row >= 0, np.maximum(highest, labels[row]), highest)
    nearest[(best > NEAR_M) & (highest > 0)] = IGNORE
    return nearest
