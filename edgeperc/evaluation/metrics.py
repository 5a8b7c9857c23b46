"""The papers' tables: how right labels and boxes are (PointSeg 5.1, SSADNet 3.3 and appendix A)."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import PointsError
from ..geometry import bounding_rectangles, oriented_iou
from ..perception import Box

__all__ = ["BoxEvaluator", "BoxScores", "Confusion", "ProbabilitySweep", "average_precision"]

EVERYWHERE = (0.0, math.inf)


class Confusion:
    """Counts of predicted against true labels, over any number of scans or images.

    A class that neither occurs nor is predicted has no score: NaN.

    Parameters
    ----------
    classes : sequence of str
    ignore : int
        Truth with this label is not counted.

    Attributes
    ----------
    counts : (C, C) int64
        Rows are the truth, columns the prediction.
    """

    def __init__(self, classes: Sequence[str], *, ignore: int = 255) -> None:
        self.classes = tuple(classes)
        self.ignore = ignore
        self.counts = np.zeros((len(self.classes), len(self.classes)), dtype=np.int64)

    def update(self, predicted: ArrayLike, truth: ArrayLike) -> None:
        """Count the labels of one scan or image.

        Parameters
        ----------
        predicted, truth : array_like of int
            Of the same shape; indices into ``classes``, in ``truth`` also ``ignore``.

        Raises
        ------
        PointsError
            Shapes disagree, or a counted label is none of the classes.
        """
        guess, right = np.asarray(predicted), np.asarray(truth)
        if guess.shape != right.shape:
            raise PointsError(f"got predicted {guess.shape} and truth {right.shape}; expected the same shape")
        counted = right != self.ignore
        guess, right = guess[counted].astype(np.int64), right[counted].astype(np.int64)
        n = len(self.classes)
        for name, labels in (("predicted", guess), ("truth", right)):
            if labels.size and not 0 <= labels.min() <= labels.max() < n:
                raise PointsError(
                    f"got {name} labels from {labels.min()} to {labels.max()}; expected 0..{n - 1} ({n} classes)"
                )
        self.counts += np.bincount(right * n + guess, minlength=n * n).reshape(n, n)

    def __add__(self, other: Confusion) -> Confusion:
        """What counting both one's labels and the other's would have given."""
        if (self.classes, self.ignore) != (other.classes, other.ignore):
            raise PointsError(f"got counts of {self.classes} and of {other.classes}; expected the same classes")
        both = Confusion(self.classes, ignore=self.ignore)
        both.counts = self.counts + other.counts
        return both

    def merged(self, groups: Mapping[str, Sequence[str]]) -> Confusion:
        """Counts of coarser classes: each key stands for the classes it lists. Classes listed nowhere are left out."""
        member = np.array([[name in group for name in self.classes] for group in groups.values()], dtype=np.int64)
        coarse = Confusion(tuple(groups), ignore=self.ignore)
        coarse.counts = member @ self.counts @ member.T
        return coarse

    def precision(self) -> NDArray[np.float64]:
        """Share of what was predicted as a class that is one, (C,): P of PointSeg 5.1, equation A3 of SSADNet."""
        return _share(np.diag(self.counts), self.counts.sum(axis=0))

    def recall(self) -> NDArray[np.float64]:
        """Share of a class that was predicted as one, (C,): R of PointSeg 5.1."""
        return _share(np.diag(self.counts), self.counts.sum(axis=1))

    def iou(self) -> NDArray[np.float64]:
        """Intersection over union, (C,): IoU of PointSeg 5.1, equation A1 of SSADNet."""
        hits = np.diag(self.counts)
        return _share(hits, self.counts.sum(axis=0) + self.counts.sum(axis=1) - hits)

    def accuracy(self) -> float:
        """Share of all labels that are right (SSADNet table 4, ACC)."""
        return float(_share(np.trace(self.counts), self.counts.sum()))

    def mean_iou(self) -> float:
        """Mean of `iou` over the classes that have one (SSADNet table 4, mIoU)."""
        return _mean(self.iou())

    def weighted_precision(self) -> float:
        """`precision` weighted by how often the classes occur (SSADNet table 3's definition of its mAP)."""
        found = self.precision()
        weights = self.counts.sum(axis=1) * ~np.isnan(found)
        return float(_share(np.nansum(found * weights), weights.sum()))


def average_precision(scores: ArrayLike, hits: ArrayLike, n_truth: int) -> float:
    """Mean of the best precision at recalls 0, 0.1 .. 1 (SSADNet appendix A, equation A4).

    Parameters
    ----------
    scores : (n,) array_like of float
        Of all predictions; of equal scores the earlier counts as the better.
    hits : (n,) array_like of bool
        Whether each is right.
    n_truth : int
        How many there were to find.

    Returns
    -------
    float
        In 0..1; NaN where there was nothing to find.

    Raises
    ------
    PointsError
        ``scores`` and ``hits`` differ in length.
    """
    values, right = np.asarray(scores, dtype=np.float64), np.asarray(hits, dtype=np.bool_)
    if values.ndim != 1 or values.shape != right.shape:
        raise PointsError(f"got scores {values.shape} and hits {right.shape}; expected two lists of one length")
    if n_truth == 0:
        return float("nan")
    found = np.cumsum(right[np.argsort(-values, kind="stable")], dtype=np.int64)
    return _eleven_points(found, np.arange(1, len(found) + 1), n_truth)


def _eleven_points(found: NDArray[np.int64], predicted: NDArray[np.int64], n_truth: int) -> float:
    """Mean of the best precision at recalls 0, 0.1 .. 1, from both counts at ever lower thresholds."""
    best_from_here = np.maximum.accumulate((found / np.maximum(predicted, 1))[::-1])[::-1]
    # Whole numbers: 0.1 * 3 is not 0.3, and a recall of just 3 in 10 must reach it.
    reached = np.searchsorted(found * 10, np.arange(11) * n_truth)
    return float(np.append(best_from_here, 0.0)[reached].mean())


class ProbabilitySweep:
    """How right one class is at every threshold of its probability, over any number of images (KITTI road, LoDNN).

    Attributes
    ----------
    counts : (2, 256) int64
        Of what is not of the class, and of what is, by probability in steps of 1/255.
    """

    def __init__(self) -> None:
        self.counts = np.zeros((2, 256), dtype=np.int64)

    def update(self, probability: ArrayLike, truth: ArrayLike) -> None:
        """Count one image.

        Parameters
        ----------
        probability : array_like of float
            Of the class, in 0..1.
        truth : array_like of bool
            Of the same shape. Leave out whatever is not to be judged.

        Raises
        ------
        PointsError
            Shapes disagree, or a probability is none.
        """
        values, right = np.asarray(probability, dtype=np.float64), np.asarray(truth, dtype=np.bool_)
        if values.shape != right.shape or not ((values >= 0.0) & (values <= 1.0)).all():
            raise PointsError(
                f"got probabilities {values.shape} and truth {right.shape}; expected one shape, and all in 0..1"
            )
        level = np.rint(values * 255.0).astype(np.int64)
        self.counts += np.bincount((right * 256 + level).ravel(), minlength=512).reshape(2, 256)

    def __add__(self, other: ProbabilitySweep) -> ProbabilitySweep:
        """What counting both one's images and the other's would have given."""
        both = ProbabilitySweep()
        both.counts = self.counts + other.counts
        return both

    def max_f1(self) -> float:
        """Best F1 over the thresholds (KITTI road's MaxF); NaN where there was nothing of the class."""
        found, predicted = self._above()
        n_truth = self.counts[1].sum()
        return float(np.max(2.0 * found / (predicted + n_truth))) if n_truth else float("nan")

    def average_precision(self) -> float:
        """Mean of the best precision at recalls 0, 0.1 .. 1; NaN where there was nothing of the class."""
        n_truth = int(self.counts[1].sum())
        return _eleven_points(*self._above(), n_truth) if n_truth else float("nan")

    def _above(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """What is rightly, and what is at all, taken for the class at each threshold, from the highest down."""
        found = np.cumsum(self.counts[1, ::-1])
        return found, np.cumsum(self.counts.sum(axis=0)[::-1])


@dataclass(frozen=True, slots=True)
class BoxScores:
    """How right the boxes of one class, or of all, are.

    Attributes
    ----------
    ap : float
        `average_precision`; NaN where there was no box to find.
    precision, recall : float
        Over all boxes given; NaN where nothing was predicted, or nothing there to find.
    mean_iou_50, mean_iou_70 : float
        Mean overlap of the boxes that overlap their truth by at least 0.5, or 0.7 (SSADNet table 5); NaN where no
        box does.
    n_truth, n_predicted, n_hits : int
        Without those ignored.
    """

    ap: float
    precision: float
    recall: float
    mean_iou_50: float
    mean_iou_70: float
    n_truth: int
    n_predicted: int
    n_hits: int


@dataclass(slots=True)
class _Matches:
    scores: list[float] = field(default_factory=list)
    overlaps: list[float] = field(default_factory=list)  # with the truth that the box was matched to; 0 for none
    ranges_m: list[float] = field(default_factory=list)  # of that truth from the sensor; of the box itself for none
    truth_m: list[float] = field(default_factory=list)

    def __add__(self, other: _Matches) -> _Matches:
        return _Matches(
            self.scores + other.scores,
            self.overlaps + other.overlaps,
            self.ranges_m + other.ranges_m,
            self.truth_m + other.truth_m,
        )


class BoxEvaluator:
    """Compares predicted boxes with true ones, over any number of scans.

    In every scan predictions pick their truth in the order of their scores: the free one that they overlap most
    (the earlier on ties), if by the threshold or more. A prediction that has none counts for nothing where it
    overlaps an ignored truth by the threshold, or where at least half of it lies in an ignored region; else it is
    wrong.

    Parameters
    ----------
    iou_threshold : float
        Overlap of footprints, seen from above, that makes a hit.
    oriented : bool
        Compare the footprints as they stand; False compares their axis-aligned bounds, as SSADNet has them.
    together : collection of str, optional
        Classes that `overall` puts together; all by default.

    Raises
    ------
    PointsError
        The threshold does not lie above 0 and up to 1.
    """

    def __init__(
        self, iou_threshold: float = 0.5, *, oriented: bool = True, together: Collection[str] | None = None
    ) -> None:
        if not 0.0 < iou_threshold <= 1.0:
            raise PointsError(f"iou_threshold is {iou_threshold}; expected a number above 0 and up to 1")
        self.iou_threshold = iou_threshold
        self.oriented = oriented
        self.together = together
        self._classes: dict[str, _Matches] = {}
        self._all = _Matches()

    def update(
        self,
        predicted: Iterable[Box],
        truth: Iterable[Box],
        *,
        ignored: Iterable[Box] = (),
        ignored_regions: ArrayLike = (),
    ) -> list[tuple[Box | None, Box | None]]:
        """Count the boxes of one scan.

        Parameters
        ----------
        predicted, truth : iterable of Box
        ignored : iterable of Box
            Objects that need not be found and may be: out of view, hardly hit, of a neighbouring class. They serve
            predictions of any class.
        ignored_regions : (r, 5) array_like
            x, y, length, width [m], yaw [rad] of ground where nothing is known.

        Returns
        -------
        list of (Box or None, Box or None)
            Predictions and the truth each was matched to, whatever their classes; None beside a wrong prediction and
            beside a truth that was missed. Excused predictions are left out.
        """
        guesses = sorted(predicted, key=lambda box: -box.score)
        rights, spares = list(truth), list(ignored)
        overlap = oriented_iou(self._rectangles(guesses), self._rectangles(rights))
        excused = (oriented_iou(self._rectangles(guesses), self._rectangles(spares)) >= self.iou_threshold).any(axis=1)
        excused |= _share_inside(_rectangles(guesses), np.asarray(ignored_regions, dtype=np.float64)) >= 0.5
        for label in dict.fromkeys(box.label for box in (*guesses, *rights)):
            matches = self._classes.setdefault(label, _Matches())
            self._match(matches, guesses, rights, overlap, excused, {label})
        self._match(self._all, guesses, rights, overlap, excused, self.together)
        return self._match(_Matches(), guesses, rights, overlap, excused)

    def __add__(self, other: BoxEvaluator) -> BoxEvaluator:
        """What updating with one's scans and then with the other's would have given."""
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
        """Scores of every class seen so far, each compared with its own kind only.

        ``within_m`` keeps the truth from the nearer up to the farther distance from the sensor [m], seen from above,
        the predictions that were matched to such truth, and the wrong predictions whose own centre lies there.
        """
        return {label: self._scores(matches, within_m) for label, matches in self._classes.items()}

    def overall(self, within_m: tuple[float, float] = EVERYWHERE) -> BoxScores:
        """Scores of all boxes, or of those of ``together``, as if they were of one class."""
        return self._scores(self._all, within_m)

    def mean_ap(self, within_m: tuple[float, float] = EVERYWHERE) -> float:
        """Mean AP over the classes that there were to find (SSADNet appendix A, mAP)."""
        return _mean(np.array([scores.ap for scores in self.per_class(within_m).values()]))

    def _rectangles(self, boxes: list[Box]) -> NDArray[np.float64]:
        rectangles = _rectangles(boxes)
        return rectangles if self.oriented else bounding_rectangles(rectangles)

    def _match(
        self,
        matches: _Matches,
        guesses: list[Box],
        rights: list[Box],
        overlap: NDArray[np.float64],
        excused: NDArray[np.bool_],
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
        matches.truth_m += [_range_m(box) for box in rights]
        for i, box in enumerate(guesses):
            best = int(np.argmax(free[i])) if rights else -1
            if best >= 0 and free[i, best] >= self.iou_threshold:
                matches.overlaps.append(float(free[i, best]))
                free[:, best] = -1.0
                pairs.append((box, missed.pop(best)))
            elif excused[i]:
                continue
            else:
                matches.overlaps.append(0.0)
                pairs.append((box, None))
            matches.scores.append(box.score)
            matches.ranges_m.append(_range_m(pairs[-1][1] or box))
        return [*pairs, *((None, box) for box in missed.values())]

    def _scores(self, matches: _Matches, within_m: tuple[float, float]) -> BoxScores:
        near, far = within_m
        ranges_m, truth_m = np.array(matches.ranges_m), np.array(matches.truth_m)
        kept = (ranges_m >= near) & (ranges_m < far)
        scores, overlaps = np.array(matches.scores)[kept], np.array(matches.overlaps)[kept]
        n_truth = int(np.count_nonzero((truth_m >= near) & (truth_m < far)))
        hits = overlaps >= self.iou_threshold
        n_hits = int(np.count_nonzero(hits))
        return BoxScores(
            ap=average_precision(scores, hits, n_truth),
            precision=float(_share(n_hits, len(hits))),
            recall=float(_share(n_hits, n_truth)),
            mean_iou_50=_mean(overlaps[overlaps >= max(0.5, self.iou_threshold)]),
            mean_iou_70=_mean(overlaps[overlaps >= max(0.7, self.iou_threshold)]),
            n_truth=n_truth,
            n_predicted=len(hits),
            n_hits=n_hits,
        )


def _range_m(box: Box) -> float:
    return math.hypot(box.center[0], box.center[1])


def _rectangles(boxes: list[Box]) -> NDArray[np.float64]:
    rows = [(box.center[0], box.center[1], box.size[0], box.size[1], box.yaw) for box in boxes]
    return np.array(rows, dtype=np.float64).reshape(-1, 5)


def _share_inside(rectangles: NDArray[np.float64], regions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Largest share of each rectangle's area that lies in one region, (n,)."""
    if len(rectangles) == 0 or regions.size == 0:
        return np.zeros(len(rectangles))
    iou = oriented_iou(rectangles, regions)
    areas = rectangles[:, 2] * rectangles[:, 3]
    both = areas[:, None] + (regions[:, 2] * regions[:, 3])[None, :]
    shared = iou / (1.0 + iou) * both  # as iou = shared / (both - shared)
    return np.asarray(np.max(shared / np.maximum(areas, np.finfo(np.float64).tiny)[:, None], axis=1))


def _share(part: ArrayLike, whole: ArrayLike) -> NDArray[np.float64]:
    """Quotient, NaN where ``whole`` is 0."""
    part, whole = np.asarray(part, dtype=np.float64), np.asarray(whole, dtype=np.float64)
    return np.divide(part, whole, out=np.full(whole.shape, np.nan), where=whole > 0.0)


def _mean(values: NDArray[np.float64]) -> float:
    """Mean of the values that are numbers; NaN where there are none."""
    numbers = values[~np.isnan(values)]
    return float(numbers.mean()) if numbers.size else float("nan")
