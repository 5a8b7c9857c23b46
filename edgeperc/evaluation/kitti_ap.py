"""Average precision of boxes as KITTI's object benchmark defines it (``evaluate_object.cpp`` of its development kit).

Boxes are compared from above (bird's eye) and in 3-D. In the image of KITTI's camera the benchmark's levels apply
(easy, moderate, hard): limits of the height in the image, of occlusion and of truncation. Where all objects around the
sensor are labeled, the same matching is used without these limits.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..datasets.kitti import IMAGE_SIZE, IMAGE_SIZES, KittiCalibration, KittiLabels
from ..types.perception import Box
from ..types.points import Floats, Mask
from . import metrics

# Smallest IoU of a match, the benchmark's own and a looser one, and neighboring classes that a detector may find.
CLASSES = {
    "car": ((0.7, 0.5), ("van",)),
    "pedestrian": ((0.5, 0.25), ("person_sitting",)),
    "cyclist": ((0.5, 0.25), ()),
}
# Smallest height in the image [px], largest occlusion and truncation of an object to find.
LEVELS = {"easy": (40, 0, 0.15), "moderate": (25, 1, 0.3), "hard": (25, 2, 0.5)}
ALL_ROUND = "all round"
RANGES = {"0-15 m": (0.0, 15.0), "15-30 m": (15.0, 30.0), "30-45 m": (30.0, 45.0), "45-80 m": (45.0, 80.0)}
RANGE_IOU = 0.5
BIRDS_EYE, IN_3D = "bird's eye", "3-D"


@dataclass(frozen=True, slots=True)
class Counts:
    """Matches of one scan, for one class and one rule."""

    objects: tuple[metrics.ObjectKey, ...]  # one for each object to find
    hits: tuple[float, ...]  # scores of the first pass: of the best detection of each object
    steps: tuple[tuple[float, int, int], ...]  # change of true and false positives as the threshold falls to a score


@dataclass(frozen=True)
class FrontTruth:
    """Labels of a KITTI scan and what is needed to see boxes as the camera does."""

    labels: KittiLabels
    calibration: KittiCalibration
    image_size: tuple[int, int] = IMAGE_SIZE


@dataclass(frozen=True, slots=True)
class Candidate:
    """How well the best of all candidates covers an object: IoU from above; distance from the sensor [m]."""

    object: metrics.ObjectKey
    label: str
    range_m: float
    iou: float


def image_size_of(drive: str) -> tuple[int, int]:
    """Width and height of the images of a raw drive [px], by its day; the most common size if the day is unknown."""
    return IMAGE_SIZES.get(drive[:10], IMAGE_SIZE)


def count_in_image(truth: FrontTruth, boxes: Sequence[Box], drive: str) -> metrics.Listed:
    """Count the matches of one scan as KITTI's benchmark does. Detections that the image does not show are left out, as
    in a submission. DontCare has no 3-D boxes, so it excuses no detection from above and in 3-D.
    """
    kinds, numbers = truth.labels.objects
    placed = truth.calibration.sensor_boxes(numbers[:, 7:14])
    right_m = np.hypot(placed[:, 0], placed[:, 1])
    objects = [_key(drive, kind, row) for kind, row in zip(kinds, numbers, strict=True)]
    guesses = metrics.box_rows(boxes)
    seen = truth.calibration.image_rectangles(guesses, truth.image_size)
    shown = ((seen[:, 2:] - seen[:, :2]) > 0.0).all(axis=1)
    guesses, seen, boxes = guesses[shown], seen[shown], [boxes[k] for k in np.flatnonzero(shown).tolist()]
    # The development kit keeps whole pixels of a detection's height, and the exact height of an object.
    guess_px, guess_m = np.floor(seen[:, 3] - seen[:, 1]), np.hypot(guesses[:, 0], guesses[:, 1])
    levels = {level: (_hidden(numbers, level), guess_px < least_px) for level, (least_px, _, _) in LEVELS.items()}
    overlaps = _overlaps(truth.calibration.in_camera(guesses), _level_rows(numbers[:, 7:14]))
    return _count(levels, boxes, guess_m, objects, (*kinds,), right_m, overlaps)


def count_all_round(boxes: Sequence[Box], to_find: Sequence[Box], ignored: Sequence[Box], drive: str) -> metrics.Listed:
    """Count the matches of a scan without limits in the image; ignored, neighbors and ``ignore`` may be found."""
    every = [*to_find, *ignored]
    guesses, rights = metrics.box_rows(boxes), metrics.box_rows(every)
    guess_m, right_m = (np.hypot(rows[:, 0], rows[:, 1]) for rows in (guesses, rights))
    levels = {ALL_ROUND: (np.arange(len(every)) >= len(to_find), np.zeros(len(boxes), np.bool_))}
    objects, kinds = [metrics.object_key(drive, box) for box in every], tuple(box.label for box in every)
    return _count(levels, boxes, guess_m, objects, kinds, right_m, _overlaps(guesses, rights), "ignore")


def _count(
    levels: Mapping[str, tuple[Mask, Mask]],
    boxes: Sequence[Box],
    guess_m: Floats,
    objects: Sequence[metrics.ObjectKey],
    kinds: Sequence[str],
    right_m: Floats,
    overlaps: Mapping[str, Floats],
    *also: str,
) -> metrics.Listed:
    """Count the matches of one scan by class, kind of overlap with its threshold, and level or range.

    levels : which objects are hidden, and which detections are too small; ranges are of the last one.
    also : labels of objects that may be found, beside those of neighbors.
    """
    table, (*_, last), labels = metrics.Listed(), levels.values(), np.array([box.label for box in boxes], np.str_)
    for label, overlap_name, least_iou, level, (near, far) in _rules(levels):
        hidden, small = levels.get(level, last)
        may_be = (label, *CLASSES[label][1], *also)
        columns = np.flatnonzero([kind in may_be for kind in kinds]).tolist()
        rows = np.flatnonzero(small | (labels == label)).tolist()
        away = hidden | (right_m < near) | (right_m >= far)
        optional = [bool(away[k]) or kinds[k] != label for k in columns]
        excused = ((guess_m < near) | (guess_m >= far))[rows].tolist()
        own = overlaps[overlap_name][np.ix_(rows, columns)], [boxes[k].score for k in rows], least_iou
        counts = count_matches(*own, [objects[k] for k in columns], optional, small[rows].tolist(), excused)
        table[label, f"{overlap_name} {least_iou:g}", level] = (counts,)
    return table


def best_candidates(truth: FrontTruth, candidates: Sequence[Box], drive: str) -> list[Candidate]:
    """The best candidate, of any class and score, for each "moderate" object of `CLASSES`; IoU 0 without one."""
    kinds, numbers = truth.labels.objects
    placed = truth.calibration.sensor_boxes(numbers[:, 7:14])
    best = np.zeros(len(kinds))
    if candidates:
        guesses = truth.calibration.in_camera(metrics.box_rows(candidates))
        best = _overlaps(guesses, _level_rows(numbers[:, 7:14]))[BIRDS_EYE].max(axis=0)
    return [
        Candidate(_key(drive, kinds[k], numbers[k]), kinds[k], float(np.hypot(*placed[k, :2])), float(best[k]))
        for k in np.flatnonzero(~_hidden(numbers, "moderate")).tolist()
        if kinds[k] in CLASSES
    ]


def count_matches(
    overlaps: Floats,
    scores: Sequence[float],
    least_iou: float,
    objects: Sequence[metrics.ObjectKey],
    optional: Sequence[bool],
    small: Sequence[bool],
    excused: Sequence[bool],
) -> Counts:
    """Match detections (n) to objects (m) in the kit's two passes, at every threshold at which they change. Objects
    choose in order: by score, then by overlap among those above the threshold, preferring what is not small.
    """
    candidates = [
        [(j, float(overlaps[j, k])) for j in np.flatnonzero(overlaps[:, k] > least_iou).tolist()]
        for k in range(len(objects))
    ]
    hits: list[float] = []
    taken: set[int] = set()
    for k, near in enumerate(candidates):
        free = [j for j, _ in near if j not in taken]
        if free:
            best = max(free, key=lambda j: scores[j])
            taken.add(best)
            if not optional[k] and not small[best]:
                hits.append(scores[best])
    steps, last = [], (0, 0)
    for threshold in sorted(set(scores), reverse=True):
        counted = _second_pass(candidates, scores, threshold, optional, small, excused)
        if counted != last:
            steps.append((threshold, counted[0] - last[0], counted[1] - last[1]))
            last = counted
    to_find = tuple(key for key, spare in zip(objects, optional, strict=True) if not spare)
    return Counts(to_find, tuple(hits), tuple(steps))


def _second_pass(
    candidates: Sequence[Sequence[tuple[int, float]]],
    scores: Sequence[float],
    threshold: float,
    optional: Sequence[bool],
    small: Sequence[bool],
    excused: Sequence[bool],
) -> tuple[int, int]:
    """Number of true and of false positives among the detections with at least this score."""
    n_hits = 0
    taken: set[int] = set()
    for k, near in enumerate(candidates):
        free = [(j, iou) for j, iou in near if j not in taken and scores[j] >= threshold]
        large = [(j, iou) for j, iou in free if not small[j]]
        if not free:
            continue
        best = max(large, key=lambda pair: pair[1])[0] if large else free[0][0]
        taken.add(best)
        n_hits += not optional[k] and bool(large)
    n_false = sum(
        score >= threshold and not small[j] and not excused[j] and j not in taken for j, score in enumerate(scores)
    )
    return n_hits, n_false


def average_precisions(counts: Sequence[Counts]) -> tuple[float, float, float]:
    """AP at 40 and at 11 recall positions as the kit computes it (with fewer than 41 objects the positions left count
    as 0), and at recalls 1/40 .. 1 read from the whole curve. All are NaN without objects.
    """
    n_truth = sum(len(count.objects) for count in counts)
    if n_truth == 0:
        return math.nan, math.nan, math.nan
    hits = np.sort(np.array([score for count in counts for score in count.hits], np.float64))[::-1]
    steps = np.array([step for count in counts for step in count.steps], np.float64).reshape(-1, 3)
    steps = steps[np.argsort(-steps[:, 0], kind="stable")]
    n_hits, n_false = np.cumsum(steps[:, 1:], axis=0).astype(np.int64).T
    curve = np.zeros(metrics.N_POSITIONS + 1)
    thresholds = hits[[*metrics.recall_positions(len(hits), n_truth)]]
    last = np.searchsorted(-steps[:, 0], -thresholds, side="right") - 1
    curve[: len(last)] = n_hits[last] / np.maximum(n_hits[last] + n_false[last], 1)
    curve = np.maximum.accumulate(curve[::-1])[::-1]
    ends = metrics.ends_of_equal(steps[:, 0])
    levels = np.arange(1, metrics.N_POSITIONS + 1)
    ap = metrics.interpolated_precision(n_hits[ends], (n_hits + n_false)[ends], n_truth, levels, metrics.N_POSITIONS)
    return float(curve[1:].mean()), float(curve[::4].mean()), ap


def _rules(levels: Iterable[str]) -> Iterator[tuple[str, str, float, str, tuple[float, float]]]:
    """Class, kind of overlap, smallest IoU, level or range, and range of distances of each row."""
    for label, (least_ious, _) in CLASSES.items():
        for least_iou in least_ious:
            for overlap_name in (BIRDS_EYE, IN_3D):
                for level in levels:
                    yield label, overlap_name, least_iou, level, metrics.EVERYWHERE
        for band, within_m in RANGES.items():
            yield label, BIRDS_EYE, RANGE_IOU, band, within_m


def _hidden(numbers: Floats, level: str) -> Mask:
    """Which objects exceed a limit of the level."""
    least_px, most_occluded, most_truncated = LEVELS[level]
    hidden = (numbers[:, 1] > most_occluded) | (numbers[:, 0] > most_truncated)
    return np.asarray(hidden | (numbers[:, 6] - numbers[:, 4] <= least_px), np.bool_)


def _key(drive: str, kind: str, numbers: Floats) -> metrics.ObjectKey:
    height, width, length = numbers[7:10].tolist()
    return metrics.object_key(drive, Box(kind, 1.0, (0.0, 0.0, 0.0), (length, width, height), 0.0))


def _level_rows(numbers: Floats) -> Floats:
    """Labels (n, 7) in the camera's frame as `KittiCalibration.in_camera` returns boxes."""
    height, width, length, x, y, z, turn = numbers.T
    yaw = np.arctan2(-np.cos(turn), -np.sin(turn))
    return np.column_stack([z, -x, height / 2.0 - y, length, width, height, yaw])


def _overlaps(a: Floats, b: Floats) -> Mapping[str, Floats]:
    return dict(zip((BIRDS_EYE, IN_3D), metrics.box_overlaps(a, b), strict=True))
