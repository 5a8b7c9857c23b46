"""Average precision by the distance of box centers, and the errors of matched boxes, as nuScenes' detection task.

A detection matches the nearest unmatched object of its class whose center is less than a threshold away, from above.
AP is the area of the precision over recall beyond 0.1 of both, averaged over thresholds of 0.5, 1, 2 and 4 m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..types.perception import Box
from ..types.points import Floats
from .metrics import Listed, ends_of_equal, object_key

DISTANCES_M = (0.5, 1.0, 2.0, 4.0)
ERROR_DISTANCE_M = 2.0
CLASSES = {"car": 50.0, "truck": 50.0, "pedestrian": 40.0, "cyclist": 40.0}
"""Classes, and the distance from the sensor up to which they are evaluated [m]."""

MIN_RECALL = MIN_PRECISION = 0.1
LEVELS = np.linspace(0.0, 1.0, 101)
FIRST = round(100 * MIN_RECALL) + 1

# Score and whether it is a hit; with a hit, its errors of place [m], size (1 - IoU of aligned boxes) and heading [rad].
Guess = tuple[float, bool, float, float, float]


def count_centers(boxes: Sequence[Box], to_find: Sequence[Box], ignored: Sequence[Box], drive: str) -> Listed:
    """Match the detections of one scan, where objects are labeled, with those of `metrics.boxes_to_find`; one without a
    match does not count if an ignored object of its class or of the class ``ignore`` is as near as a match. Lists the
    objects to find by class, and each `Guess` by class and distance.
    """
    table = Listed()
    for label, farthest_m in CLASSES.items():
        rights = [box for box in to_find if box.label == label and math.hypot(*box.center[:2]) <= farthest_m]
        spares = [box for box in ignored if box.label in (label, "ignore")]
        guesses = [box for box in boxes if box.label == label and math.hypot(*box.center[:2]) <= farthest_m]
        nearest_m = _distances(guesses, rights).min(axis=1, initial=math.inf)
        order = np.lexsort((nearest_m, [-box.score for box in guesses]))
        guesses = [guesses[k] for k in order.tolist()]
        away_m, spare_m = _distances(guesses, rights), _distances(guesses, spares)
        table[label] = tuple(object_key(drive, box) for box in rights)
        for least_m in DISTANCES_M:
            table[label, least_m] = _matched(guesses, rights, away_m, spare_m, least_m)
    return table


def center_scores(table: Listed, label: str) -> dict[str, float]:
    """AP of one class, mean and by distance; mean errors of matches within 2 m of place [m], size and heading [rad],
    over recalls from 0.1 to the largest one, 1 if that is not reached. All are NaN without objects.
    """
    n_truth = len(table.get(label, ()))
    curves = {d: _curve(table.get((label, d), ()), n_truth) for d in DISTANCES_M}
    aps = {f"ap_{d:g}": _average_precision(curve[0]) if n_truth else math.nan for d, curve in curves.items()}
    errors = curves[ERROR_DISTANCE_M][1].tolist() if n_truth else [math.nan] * 3
    ap = float(np.mean([*aps.values()]))
    return {"ap": ap, **aps, **dict(zip(("ate", "ase", "aoe"), errors, strict=True))}


def _matched(
    guesses: Sequence[Box], rights: Sequence[Box], away_m: Floats, spare_m: Floats, least_m: float
) -> tuple[Guess, ...]:
    free = away_m.copy()
    matched: list[Guess] = []
    for k, guess in enumerate(guesses):
        best = int(np.argmin(free[k])) if rights else -1
        if best >= 0 and free[k, best] < least_m:
            free[:, best] = np.inf
            right = rights[best]
            turn = abs(math.remainder(guess.yaw - right.yaw, 2.0 * math.pi))
            matched.append((guess.score, True, float(away_m[k, best]), 1.0 - _aligned_iou(guess, right), turn))
        elif not (spare_m[k] < least_m).any():
            matched.append((guess.score, False, math.nan, math.nan, math.nan))
    return tuple(matched)


def _curve(guesses: Sequence[Guess], n_truth: int) -> tuple[Floats, Floats]:
    """Precision at `LEVELS` of recall (101,), and mean errors (3,)."""
    rows = np.array(guesses, np.float64).reshape(-1, 5)
    rows = rows[np.argsort(-rows[:, 0])]
    is_hit = rows[:, 1] > 0.0
    if n_truth == 0 or not is_hit.any():
        return np.zeros(len(LEVELS)), np.ones(3)
    ends, hits = ends_of_equal(rows[:, 0]), rows[is_hit]
    n_hits = np.cumsum(is_hit)[ends]
    recall, precision = n_hits / n_truth, n_hits / (ends + 1)
    at_levels = np.interp(LEVELS, recall, precision, right=0.0)
    score_at = np.interp(LEVELS, recall, rows[ends, 0], right=0.0)
    # Mean error of the hits with at least the score at each level of recall.
    last_hits = ends_of_equal(hits[:, 0])
    means = (np.cumsum(hits[:, 2:], axis=0) / np.arange(1, len(hits) + 1)[:, None])[last_hits]
    last = int(np.flatnonzero(score_at)[-1]) if score_at.any() else 0
    if last < FIRST:
        return at_levels, np.ones(3)
    scores = hits[last_hits, 0]
    errors = [np.interp(score_at[::-1], scores[::-1], column[::-1])[::-1] for column in means.T]
    return at_levels, np.array([error[FIRST : last + 1].mean() for error in errors])


def _average_precision(precision: Floats) -> float:
    return float(np.maximum(precision[FIRST:] - MIN_PRECISION, 0.0).mean()) / (1.0 - MIN_PRECISION)


def _distances(guesses: Sequence[Box], rights: Sequence[Box]) -> Floats:
    a, b = (np.array([box.center[:2] for box in part], np.float64).reshape(-1, 2) for part in (guesses, rights))
    return np.asarray(np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1)), np.float64)


def _aligned_iou(a: Box, b: Box) -> float:
    shared = math.prod(min(pair) for pair in zip(a.size, b.size, strict=True))
    return shared / (math.prod(a.size) + math.prod(b.size) - shared)
