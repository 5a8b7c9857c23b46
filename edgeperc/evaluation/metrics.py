"""Confusion matrices, average precision, box matching and headings (PointSeg 5.1, SSADNet 3.3 and appendix A)."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import PointsError
from ..simulation.samples import IGNORE
from ..types.geometry import bounding_rectangles, oriented_iou, rectangles, shared_area
from ..types.perception import Box
from ..types.points import Floats, Ints64, Mask
from ..types.views import TopViewGeometry

EVERYWHERE = (0.0, math.inf)
FEWEST_RETURNS = 3  # an object with fewer returns cannot be distinguished from clutter
N_POSITIONS = 40  # recall positions of KITTI's curves, without recall 0
HEADING_RAD = math.pi / 4.0  # largest error of a correct heading

ObjectKey = tuple[str, str, float, float, float]


class Listed(dict[Any, tuple[Any, ...]]):
    """What was counted of scans, by key: adding joins what two of them list."""

    def __add__(self, other: Listed) -> Listed:
        return Listed({key: self.get(key, ()) + other.get(key, ()) for key in {**self, **other}})


class Confusion:
    """Counts (C, C) of predicted (columns) against true labels (rows), over scans or images; the true label `IGNORE`
    is not counted. A class without true and predicted labels has NaN scores.
    """

    def __init__(self, classes: Sequence[str], counts: NDArray[Any] | None = None) -> None:
        self.classes = tuple(classes)
        self.counts = np.zeros((len(classes), len(classes)), dtype=np.int64) if counts is None else counts

    def update(self, predicted: ArrayLike, truth: ArrayLike) -> None:
        """Count the labels of one scan or image, two arrays of one shape. Raises PointsError."""
        guess, right = np.asarray(predicted), np.asarray(truth)
        if guess.shape != right.shape:
            raise PointsError(f"got predicted {guess.shape} and truth {right.shape}; expected the same shape")
        counted = right != IGNORE
        guess, right = guess[counted].astype(np.int64), right[counted].astype(np.int64)
        n = len(self.classes)
        for name, labels in (("predicted", guess), ("truth", right)):
            if labels.size and not 0 <= labels.min() <= labels.max() < n:
                raise PointsError(
                    f"got {name} labels from {labels.min()} to {labels.max()}; expected 0..{n - 1} ({n} classes)"
                )
        self.counts += np.bincount(right * n + guess, minlength=n * n).reshape(n, n)

    def __add__(self, other: Confusion) -> Confusion:
        """Add the counts of both; raise `PointsError` if their classes differ."""
        if self.classes != other.classes:
            raise PointsError(f"got counts of {self.classes} and of {other.classes}; expected the same classes")
        return Confusion(self.classes, self.counts + other.counts)

    def merged(self, groups: Mapping[str, Sequence[str]]) -> Confusion:
        """Join classes: ``groups`` maps a new class to the classes that it joins. Classes in no group are dropped."""
        member = np.array([[name in group for name in self.classes] for group in groups.values()], dtype=np.int64)
        return Confusion(tuple(groups), member @ self.counts @ member.T)

    def precision(self) -> Floats:
        """Correct share of the predictions of each class, (C,) float64: P of PointSeg 5.1, equation A3 of SSADNet."""
        return _share(np.diag(self.counts), self.counts.sum(axis=0))

    def recall(self) -> Floats:
        """Correctly predicted share of the true labels of each class, (C,) float64: R of PointSeg 5.1."""
        return _share(np.diag(self.counts), self.counts.sum(axis=1))

    def iou(self) -> Floats:
        """Intersection over union of each class, (C,) float64: IoU of PointSeg 5.1, equation A1 of SSADNet."""
        hits = np.diag(self.counts)
        return _share(hits, self.counts.sum(axis=0) + self.counts.sum(axis=1) - hits)

    def accuracy(self) -> float:
        """Correct share of all labels (SSADNet table 4, ACC)."""
        return float(_share(np.trace(self.counts), self.counts.sum()))

    def mean_iou(self) -> float:
        """Mean of `iou` over the classes, without NaN (SSADNet table 4, mIoU)."""
        return mean(self.iou())

    def weighted_precision(self) -> float:
        """Mean of `precision`, weighted by the frequency of the classes (mAP as SSADNet table 3 defines it)."""
        precision = self.precision()
        weights = self.counts.sum(axis=1) * ~np.isnan(precision)
        return float(_share(np.nansum(precision * weights), weights.sum()))


def average_precision(scores: ArrayLike, hits: ArrayLike, n_truth: int) -> float:
    """Eleven-point average precision: mean of the best precision at recalls 0, 0.1 .. 1 (SSADNet equation A4), NaN
    without objects to find. Equal scores count together: which comes first is a matter of chance.
    """
    values, right = np.asarray(scores, dtype=np.float64), np.asarray(hits, dtype=np.bool_)
    if n_truth == 0:
        return float("nan")
    order = np.argsort(-values)
    ends = ends_of_equal(values[order])
    n_right = np.cumsum(right[order], dtype=np.int64)[ends]
    return interpolated_precision(n_right, ends + 1, n_truth, np.arange(11), 10)


def ends_of_equal(falling: Floats) -> Ints64:
    """The last row of each run of equal scores, which fall."""
    return np.flatnonzero(np.append(np.diff(falling) != 0.0, True)[: len(falling)])


def interpolated_precision(found: Ints64, predicted: Ints64, n_truth: int, levels: Ints64, n_levels: int) -> float:
    """Mean of the best precision at recalls ``levels / n_levels``; counts are (k,), over falling thresholds."""
    best_from_here = np.maximum.accumulate((found / np.maximum(predicted, 1))[::-1])[::-1]
    # In integers, because 0.1 * 3 > 0.3: a recall of exactly 3 in 10 must reach the level 0.3.
    reached = np.searchsorted(np.maximum.accumulate(found) * n_levels, levels * n_truth)
    return float(np.append(best_from_here, 0.0)[reached].mean())


class ProbabilitySweep:
    """Precision and recall of a class over all thresholds of its probability, from histograms (2, 256) of cells."""

    def __init__(self) -> None:
        self.counts = np.zeros((2, 256), dtype=np.int64)

    def update(self, probability: ArrayLike, truth: ArrayLike) -> None:
        """Count the probabilities, 0 to 1, of cells with known truth in one image."""
        level = np.rint(np.asarray(probability, dtype=np.float64) * 255.0).astype(np.int64)
        cell = np.asarray(truth, dtype=np.bool_) * 256 + level
        self.counts += np.bincount(cell.ravel(), minlength=512).reshape(2, 256)

    def __add__(self, other: ProbabilitySweep) -> ProbabilitySweep:
        """Add the counts of both."""
        both = ProbabilitySweep()
        both.counts = self.counts + other.counts
        return both

    def max_f1(self) -> float:
        """Best F1 over the thresholds (KITTI road's MaxF); NaN if the class does not occur."""
        n_right, predicted = self._above()
        n_truth = self.counts[1].sum()
        return float(np.max(2.0 * n_right / (predicted + n_truth))) if n_truth else float("nan")

    def average_precision(self) -> float:
        """Eleven-point average precision over the thresholds; NaN if the class does not occur."""
        n_truth = int(self.counts[1].sum())
        return interpolated_precision(*self._above(), n_truth, np.arange(11), 10) if n_truth else float("nan")

    def _above(self) -> tuple[Ints64, Ints64]:
        """True positives and positives, (256,) each, from the highest threshold to the lowest."""
        n_right = np.cumsum(self.counts[1, ::-1])
        return n_right, np.cumsum(self.counts.sum(axis=0)[::-1])


@dataclass(frozen=True, slots=True)
class BoxScores:
    """Scores of the boxes of one class, or of all classes together; NaN where nothing is counted."""

    ap: float  # `average_precision`
    precision: float  # of all predictions, with any score
    recall: float
    mean_iou_50: float  # of predictions with an IoU of at least 0.5 (SSADNet table 5)
    mean_iou_70: float
    heading: float  # share of hits within 45 degrees of the true yaw over the full turn; not finite is wrong
    axis: float  # modulo half a turn
    front_known: float  # share of the hits with a known `Box.front`
    n_truth: int  # ignored boxes are not counted
    n_predicted: int
    n_hits: int
    n_objects: int  # distinct objects (`object_key`) of the boxes to find
    n_found: int  # distinct objects of the hits
    n_drives: int


class _Guess(NamedTuple):
    """A predicted box."""

    score: float
    overlap: float  # IoU with the matched true box; 0 without a match
    range_m: float  # of the matched true box, else of the prediction
    turn: float  # error of the yaw, 0..pi; NaN without a match
    knows_front: bool
    object: ObjectKey | None  # of the matched true box


@dataclass(slots=True)
class _Matches:
    guesses: list[_Guess] = field(default_factory=list)
    objects: list[tuple[float, ObjectKey]] = field(default_factory=list)  # distance and object of every box to find

    def __add__(self, other: _Matches) -> _Matches:
        return _Matches(self.guesses + other.guesses, self.objects + other.objects)


class BoxEvaluator:
    """Matches predicted boxes to true boxes, over any number of scans: best score first, each to the free true box of
    the largest IoU from ``iou_threshold`` on. ``together``: classes that `overall` joins; all by default.
    """

    def __init__(
        self, iou_threshold: float = 0.5, *, oriented: bool = True, together: Collection[str] | None = None
    ) -> None:
        self.iou_threshold = iou_threshold
        self.oriented = oriented
        self.together = together
        self._classes: dict[str, _Matches] = {}
        self._all = _Matches()

    def update(
        self, predicted: Iterable[Box], truth: Iterable[Box], *, ignored: Iterable[Box] = (), drive: str = ""
    ) -> list[tuple[Box | None, Box | None]]:
        """Count the boxes of a scan, but those that match ``ignored``, and pair them of any class, or with None."""
        rights, spares, every = list(truth), list(ignored), list(predicted)
        overlap = oriented_iou(self._rectangles(every), self._rectangles(rights))
        order = np.lexsort((-overlap.max(axis=1, initial=0.0), [-box.score for box in every]))
        guesses, overlap = [every[k] for k in order.tolist()], overlap[order]
        spared = oriented_iou(self._rectangles(guesses), self._rectangles(spares)) >= self.iou_threshold
        excused = np.asarray(spared.any(axis=1))
        for label in dict.fromkeys(box.label for box in (*guesses, *rights)):
            self._match(self._classes.setdefault(label, _Matches()), guesses, rights, overlap, excused, drive, {label})
        self._match(self._all, guesses, rights, overlap, excused, drive, self.together)
        return self._match(_Matches(), guesses, rights, overlap, excused, drive)

    def __add__(self, other: BoxEvaluator) -> BoxEvaluator:
        """Add the scans of both; raise `PointsError` if their settings differ."""
        if (self.iou_threshold, self.oriented) != (other.iou_threshold, other.oriented):
            raise PointsError(
                f"got boxes matched at {self.iou_threshold} (oriented: {self.oriented}) and at {other.iou_threshold} "
                f"(oriented: {other.oriented}); expected the same"
            )
        both = BoxEvaluator(self.iou_threshold, oriented=self.oriented, together=self.together)
        for label in dict.fromkeys((*self._classes, *other._classes)):
            both._classes[label] = self._classes.get(label, _Matches()) + other._classes.get(label, _Matches())
        both._all = self._all + other._all
        return both

    def per_class(self, within_m: tuple[float, float] = EVERYWHERE) -> dict[str, BoxScores]:
        """Scores of every class so far, each matched within itself; of a range of distances only true boxes with their
        center in it, predictions matched to them, and false positives with their center in it.
        """
        return {label: self._scores(matches, within_m) for label, matches in self._classes.items()}

    def overall(self, within_m: tuple[float, float] = EVERYWHERE) -> BoxScores:
        """Scores of the boxes of the classes ``together``, by default all, as if they were one class."""
        return self._scores(self._all, within_m)

    def _rectangles(self, boxes: list[Box]) -> Floats:
        rows = rectangles(boxes)
        return rows if self.oriented else bounding_rectangles(rows)

    def _match(
        self,
        matches: _Matches,
        guesses: list[Box],
        rights: list[Box],
        overlap: Floats,
        excused: Mask,
        drive: str,
        labels: Collection[str] | None = None,
    ) -> list[tuple[Box | None, Box | None]]:
        if labels is not None:
            rows = [i for i, box in enumerate(guesses) if box.label in labels]
            columns = [j for j, box in enumerate(rights) if box.label in labels]
            guesses, rights = [guesses[i] for i in rows], [rights[j] for j in columns]
            overlap, excused = overlap[np.ix_(rows, columns)], excused[rows]
        free = overlap.copy()
        missed = dict(enumerate(rights))
        pairs: list[tuple[Box | None, Box | None]] = []
        matches.objects += [(_range_m(box), object_key(drive, box)) for box in rights]
        for i, box in enumerate(guesses):
            best = int(np.argmax(free[i])) if rights else -1
            overlap_of, right, key, turn = 0.0, None, None, math.nan
            if best >= 0 and free[i, best] >= self.iou_threshold:
                overlap_of, right = float(free[i, best]), missed.pop(best)
                free[:, best] = -1.0
                key, turn = object_key(drive, right), box.yaw - right.yaw
            elif excused[i]:
                continue
            pairs.append((box, right))
            turn = abs(math.remainder(turn, 2.0 * math.pi)) if math.isfinite(turn) else math.nan
            front = box.front is not None
            matches.guesses.append(_Guess(box.score, overlap_of, _range_m(right or box), turn, front, key))
        return [*pairs, *((None, box) for box in missed.values())]

    def _scores(self, matches: _Matches, within_m: tuple[float, float]) -> BoxScores:
        near, far = within_m
        guesses = [guess for guess in matches.guesses if near <= guess.range_m < far]
        overlaps = np.array([guess.overlap for guess in guesses])
        to_find = [key for range_m, key in matches.objects if near <= range_m < far]
        objects, n_truth = {*to_find}, len(to_find)
        hits = overlaps >= self.iou_threshold
        right = [guess for guess, hit in zip(guesses, hits.tolist(), strict=True) if hit]
        n_hits, turns = len(right), np.array([guess.turn for guess in right])
        return BoxScores(
            ap=average_precision([guess.score for guess in guesses], hits, n_truth),
            precision=float(_share(n_hits, len(hits))),
            recall=float(_share(n_hits, n_truth)),
            mean_iou_50=mean(overlaps[overlaps >= max(0.5, self.iou_threshold)]),
            mean_iou_70=mean(overlaps[overlaps >= max(0.7, self.iou_threshold)]),
            heading=float(_share(np.count_nonzero(turns <= HEADING_RAD), n_hits)),
            axis=float(_share(np.count_nonzero(np.minimum(turns, math.pi - turns) <= HEADING_RAD), n_hits)),
            front_known=float(_share(sum(guess.knows_front for guess in right), n_hits)),
            n_truth=n_truth,
            n_predicted=len(hits),
            n_hits=n_hits,
            n_objects=len(objects),
            n_found=len({guess.object for guess in right}),
            n_drives=len({drive for drive, *_ in objects}),
        )


def boxes_to_find(
    truth: Iterable[tuple[Box, int]],
    view: TopViewGeometry | None,
    classes: Collection[str],
    *,
    known: Callable[[Box], bool] = lambda box: True,
) -> tuple[list[Box], list[Box]]:
    """Split true boxes, with their numbers of returns, into those that a detector must find (of the classes, in the
    view, where the scan is labeled, with `FEWEST_RETURNS`) and all others, which it may find.
    """
    to_find: list[Box] = []
    ignored: list[Box] = []
    for box, returns in truth:
        counts = box.label in classes and (view is None or view.holds(*box.center[:2]))
        (to_find if counts and returns >= FEWEST_RETURNS and known(box) else ignored).append(box)
    return to_find, ignored


def box_rows(boxes: Iterable[Box]) -> Floats:
    """x, y, z of the center, length, width, height, yaw, (n, 7)."""
    return np.array([(*box.center, *box.size, box.yaw) for box in boxes], np.float64).reshape(-1, 7)


def box_overlaps(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """IoU of boxes (n, 7) and (m, 7) from above and in 3-D, (n, m) each; 0 in 3-D for boxes without a finite volume."""
    flat_a, flat_b = a[:, [0, 1, 3, 4, 6]], b[:, [0, 1, 3, 4, 6]]
    with np.errstate(divide="ignore", invalid="ignore"):
        from_above = oriented_iou(flat_a, flat_b)
        top = np.minimum.outer(a[:, 2] + a[:, 5] / 2.0, b[:, 2] + b[:, 5] / 2.0)
        bottom = np.maximum.outer(a[:, 2] - a[:, 5] / 2.0, b[:, 2] - b[:, 5] / 2.0)
        shared = shared_area(from_above, flat_a, flat_b) * np.maximum(top - bottom, 0.0)
        volumes = np.add.outer(a[:, 3:6].prod(axis=1), b[:, 3:6].prod(axis=1))
        return from_above, np.nan_to_num(shared / (volumes - shared), nan=0.0, posinf=0.0, neginf=0.0)


def recall_positions(n_hits: int, n_truth: int) -> Iterator[int]:
    """Which hits, best first, give the thresholds at the recalls 0, 1/40 .. 1 (``getThresholds`` of KITTI's kit)."""
    recall, k = 0.0, 0
    while k < n_hits:
        # All but a few of the hits that are skipped, without a loop over them.
        k = max(k, min(int(n_truth * recall - 1.5) - 2, n_hits - 1))
        # With equal distances rounding decides, so this is written as in KITTI's program.
        while k < n_hits - 1 and (k + 2) / n_truth - recall < recall - (k + 1) / n_truth:
            k += 1
        yield k
        recall += 1.0 / N_POSITIONS
        k += 1


def object_key(drive: str, box: Box) -> ObjectKey:
    """Identify an object in all scans of its drive by its label and its size in centimeters: labelers give it one. On
    KITTI's drive 0005 this counts the same 15 objects as the track numbers of its labels.
    """
    length, width, height = (round(side, 2) for side in box.size)
    return drive, box.label, length, width, height


def _range_m(box: Box) -> float:
    return math.hypot(box.center[0], box.center[1])


def _share(part: ArrayLike, whole: ArrayLike) -> Floats:
    """Quotient; NaN where ``whole`` is 0."""
    part, whole = np.asarray(part, dtype=np.float64), np.asarray(whole, dtype=np.float64)
    return np.divide(part, whole, out=np.full(whole.shape, np.nan), where=whole > 0.0)


def mean(values: ArrayLike) -> float:
    """Mean of the values that are not NaN; NaN if there are none."""
    numbers = np.asarray(values, dtype=np.float64)
    numbers = numbers[~np.isnan(numbers)]
    return float(numbers.mean()) if numbers.size else float("nan")
