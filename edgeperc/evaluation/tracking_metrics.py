"""How right tracks are: CLEAR-MOT, its averages over recall (AB3DMOT), HOTA.

A box is a row ``x, y, z, length, width, height, yaw``: middle [m], extents [m], heading about +z from +x [rad].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ..errors import TrackingError
from ..geometry import oriented_iou, shared_area

__all__ = [
    "Clear",
    "FrameTracks",
    "FrameTruth",
    "Hota",
    "TrackingScores",
    "box_iou",
    "count_breaks",
    "evaluate_tracks",
    "fill_assignment",
    "fill_pairs",
    "recall_thresholds",
]

N_RECALLS = 40
HOTA_ALPHAS = np.linspace(0.05, 0.95, 19)


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """What there is in one frame.

    Attributes
    ----------
    ids : (n,) int64
        Which object each box is of; the same from frame to frame.
    boxes : (n, 7) float64
    ignored : (n,) bool
        Objects that need not be found and may be: hidden, cut by the image, of a neighbouring class.
    """

    ids: NDArray[np.int64]
    boxes: NDArray[np.float64]
    ignored: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class FrameTracks:
    """What a tracker said of one frame.

    Attributes
    ----------
    ids : (m,) int64
    boxes : (m, 7) float64
    scores : (m,) float64
        A track is judged by the mean of its scores over all its frames.
    excused : (m,) bool
        Boxes that are no mistake where they match nothing: too small to be seen, or where nothing was labelled.
    """

    ids: NDArray[np.int64]
    boxes: NDArray[np.float64]
    scores: NDArray[np.float64]
    excused: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Clear:
    """CLEAR-MOT counts of the tracks above one score; KUL-Seg's Table 7 calls them false alarms, missed and ID SW.

    Attributes
    ----------
    threshold : float
        Smallest mean score of the tracks that were counted.
    n_truth : int
        Boxes to be found, without those ignored.
    n_found : int
        Matched boxes, with those ignored.
    n_false, n_missed : int
        False alarms and missed detections.
    n_switches, n_fragments : int
        How often an object changed its track from one frame to the next; how often its track was taken up again.
    mota, motp : float
        Accuracy, 1 - (missed + false + switches) / truth; mean overlap of the matches. NaN where nothing was there.
    """

    threshold: float
    n_truth: int
    n_found: int
    n_false: int
    n_missed: int
    n_switches: int
    n_fragments: int
    mota: float
    motp: float

    def scaled_mota(self, recall: float) -> float:
        """MOTA of which the objects beyond ``recall`` are not held against the tracker, in 0..1 (AB3DMOT, sMOTA)."""
        errors = self.n_missed + self.n_false + self.n_switches - (1.0 - recall) * self.n_truth
        return min(1.0, max(0.0, 1.0 - errors / (recall * self.n_truth)))


@dataclass(frozen=True, slots=True)
class Hota:
    """Higher order tracking accuracy, means over the overlaps 0.05, 0.10 .. 0.95 (Luiten et al., IJCV 2020).

    Attributes
    ----------
    hota, deta, assa : float
        The whole, its detection and its association accuracy, in 0..1; NaN where nothing was there.
    """

    hota: float
    deta: float
    assa: float


@dataclass(frozen=True, slots=True)
class TrackingScores:
    """Every figure of one class.

    Attributes
    ----------
    samota, amota, amotp : float
        Means over forty recalls of the scaled MOTA, of MOTA and of MOTP (AB3DMOT); recalls that are never reached
        count as 0.
    told : Clear
        Of every track, whatever its score: what a user of the tracker sees.
    best : Clear
        At the score threshold with the highest MOTA.
    hota : Hota
        There too.
    n_frames, n_objects : int
        Frames judged, objects (tracks of the truth) in them that are not ignored throughout.
    """

    samota: float
    amota: float
    amotp: float
    told: Clear
    best: Clear
    hota: Hota
    n_frames: int
    n_objects: int


def box_iou(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Share of space that every box of ``a`` has in common with every one of ``b``: 3-D intersection over union.

    Parameters
    ----------
    a : (n, 7) array_like
    b : (m, 7) array_like

    Returns
    -------
    (n, m) float64
        In 0..1; 0 where a box is not finite or has no volume.
    """
    first = np.asarray(a, dtype=np.float64).reshape(-1, 7)
    second = np.asarray(b, dtype=np.float64).reshape(-1, 7)
    footprints = first[:, [0, 1, 3, 4, 6]], second[:, [0, 1, 3, 4, 6]]
    with np.errstate(invalid="ignore", divide="ignore"):
        shared = shared_area(oriented_iou(*footprints), *footprints)
        top = np.minimum.outer(first[:, 2] + first[:, 5] / 2.0, second[:, 2] + second[:, 5] / 2.0)
        bottom = np.maximum.outer(first[:, 2] - first[:, 5] / 2.0, second[:, 2] - second[:, 5] / 2.0)
        shared *= np.maximum(top - bottom, 0.0)
        volumes = np.add.outer(first[:, 3:6].prod(axis=1), second[:, 3:6].prod(axis=1))
        iou = shared / (volumes - shared)
    return np.nan_to_num(iou, nan=0.0, posinf=0.0, neginf=0.0)


def recall_thresholds(scores: ArrayLike, n_truth: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Scores at which the recall comes nearest to 1/40, 2/40 .. 1 (AB3DMOT's protocol, after KITTI's).

    Parameters
    ----------
    scores : (n,) array_like
        Of the tracks that were matched, one for each match.
    n_truth : int
        Matches there could have been.

    Returns
    -------
    thresholds, recalls : (k,) float64
        k up to 40, thresholds falling. The lowest score stands for the first recall that is not reached.
    """
    falling = np.sort(np.asarray(scores, dtype=np.float64))[::-1]
    at: list[int] = []
    for k in range(N_RECALLS + 1):
        # Of the ranks on both sides of the recall wanted, the nearer; every rank serves once.
        rank = max(at[-1] + 1 if at else 0, math.ceil(k * n_truth / N_RECALLS - 1.5))
        if rank >= len(falling) - 1:
            if len(falling) and (not at or at[-1] < len(falling) - 1):
                at.append(len(falling) - 1)
            break
        at.append(rank)
    return falling[at[1:]], np.arange(1, len(at)) / N_RECALLS


def evaluate_tracks(
    sequences: Sequence[tuple[Sequence[FrameTruth], Sequence[FrameTracks]]], iou_threshold: float = 0.25
) -> TrackingScores:
    """Hold the tracks of any number of sequences against the truth, as AB3DMOT's protocol does.

    In each frame truth and tracks are paired so that as many overlap by ``iou_threshold`` as can, and among such
    pairings so that they overlap most. All tracks take part first; then, for forty recalls, those whose mean score
    reaches the threshold of that recall.

    Parameters
    ----------
    sequences : sequence of (sequence of FrameTruth, sequence of FrameTracks)
        Frames in order, as many of the one as of the other.
    iou_threshold : float
        3-D overlap that makes a match.

    Returns
    -------
    TrackingScores

    Raises
    ------
    TrackingError
        A sequence has not as many frames of tracks as of truth.
    """
    packed = [_Packed(truth, tracks, iou_threshold) for truth, tracks in sequences]
    everything, scores = _clear(packed, -math.inf)
    n_matchable = everything.n_found + everything.n_missed
    thresholds, recalls = recall_thresholds(scores, n_matchable)
    best, samota, amota, amotp = everything, 0.0, 0.0, 0.0
    for k, (threshold, recall) in enumerate(zip(thresholds, recalls, strict=True)):
        clear, _ = _clear(packed, threshold)
        samota += clear.scaled_mota(recall) / N_RECALLS
        amota += clear.mota / N_RECALLS
        amotp += clear.motp / N_RECALLS
        if k == 0 or clear.mota > best.mota:
            best = clear
    return TrackingScores(
        samota=samota,
        amota=amota,
        amotp=amotp,
        told=everything,
        best=best,
        hota=_hota(packed, best.threshold),
        n_frames=sum(len(of.shapes) for of in packed),
        n_objects=sum(len({*of.truth[~of.ignored].tolist()}) for of in packed),
    )


class _Packed:
    """The frames of one sequence end to end, ids counted from 0, and every pair of truth and track of one frame."""

    def __init__(self, truth: Sequence[FrameTruth], tracks: Sequence[FrameTracks], iou_threshold: float) -> None:
        if len(truth) != len(tracks):
            raise TrackingError(f"got {len(tracks)} frames of tracks for {len(truth)} of truth; pass one a frame")
        self.iou_threshold = iou_threshold
        n_truth, n_tracks = ([len(frame.ids) for frame in frames] for frames in (truth, tracks))
        self.shapes = np.array([n_truth, n_tracks], np.int64).T.reshape(-1, 2)
        self.truth, _ = _counted([frame.ids for frame in truth])
        self.track, self.n_tracks = _counted([frame.ids for frame in tracks])
        self.ignored = np.concatenate([np.zeros(0, np.bool_), *(frame.ignored for frame in truth)])
        self.excused = np.concatenate([np.zeros(0, np.bool_), *(frame.excused for frame in tracks)])
        overlaps = [box_iou(a.boxes, b.boxes).ravel() for a, b in zip(truth, tracks, strict=True)]
        self.iou = np.concatenate([np.zeros(0), *overlaps])
        # Rows of each pair among all true boxes and among all tracks' boxes, in the order of the overlaps.
        self.row = np.repeat(np.arange(len(self.truth)), np.repeat(n_tracks, n_truth))
        first = np.repeat(np.cumsum([0, *n_tracks])[:-1], np.multiply(n_truth, n_tracks))
        begun = np.repeat(np.cumsum([0, *np.repeat(n_tracks, n_truth)])[:-1], np.repeat(n_tracks, n_truth))
        self.column = first + np.arange(len(self.iou)) - begun
        scores = np.concatenate([np.zeros(0), *(frame.scores for frame in tracks)])
        counts = np.bincount(self.track, minlength=self.n_tracks)
        self.mean_score = np.bincount(self.track, scores, self.n_tracks) / np.maximum(counts, 1)

    def matched(self, threshold: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The pairs made, and which tracks' boxes counted."""
        kept = (self.mean_score >= threshold)[self.track]
        most = 1.0 + float(self.shapes[:, 0].max(initial=0))  # so one pair more outweighs any overlap
        may = kept[self.column] & (self.iou >= self.iou_threshold)
        return self.assigned(np.where(may, most + self.iou, 0.0)), kept

    def assigned(self, gain: NDArray[np.float64]) -> NDArray[np.int64]:
        """Pairs that bring the most gain in every frame, each box in one at most."""
        pair = np.empty(len(self.truth), np.int64)
        fill_pairs(self.shapes, gain, pair)
        return pair[pair >= 0]


def _counted(ids: Sequence[NDArray[np.int64]]) -> tuple[NDArray[np.int64], int]:
    names, counted = np.unique(np.concatenate([np.zeros(0, np.int64), *ids]), return_inverse=True)
    return counted.astype(np.int64), len(names)


def _clear(packed: Sequence[_Packed], threshold: float) -> tuple[Clear, NDArray[np.float64]]:
    """Counts of the tracks whose mean score reaches the threshold, and the scores of all matches."""
    n_truth = n_found = n_false = n_missed = n_switches = n_fragments = 0
    total_overlap = 0.0
    scores = [np.zeros(0)]
    for of in packed:
        pair, unmatched = of.matched(threshold)
        unmatched[of.column[pair]] = False
        ids = np.full(len(of.truth), -1)
        ids[of.row[pair]] = of.track[of.column[pair]]
        switches, fragments = count_breaks(of.truth, ids, of.ignored)
        n_truth += int(np.count_nonzero(~of.ignored))
        n_found += len(pair)
        n_missed += int(np.count_nonzero((ids < 0) & ~of.ignored))
        n_false += int(np.count_nonzero(unmatched & ~of.excused))
        n_switches += switches
        n_fragments += fragments
        total_overlap += float(of.iou[pair].sum())
        scores.append(of.mean_score[of.track[of.column[pair]]])
    mota = 1.0 - (n_missed + n_false + n_switches) / n_truth if n_truth else math.nan
    motp = total_overlap / n_found if n_found else math.nan
    counts = n_truth, n_found, n_false, n_missed, n_switches, n_fragments
    return Clear(float(threshold), *counts, mota, motp), np.concatenate(scores)


def _hota(packed: Sequence[_Packed], threshold: float) -> Hota:
    """Ignored truth, what was matched to it, and what is excused take no part."""
    n_found, n_truth, n_tracked = np.zeros(len(HOTA_ALPHAS)), 0, 0
    associated = np.zeros(len(HOTA_ALPHAS))
    for of in packed:
        pair, kept = of.matched(threshold)
        real, judged = ~of.ignored, kept & ~of.excused
        judged[of.column[pair]] = real[of.row[pair]]
        in_truth = np.bincount(of.truth[real], minlength=int(of.truth.max(initial=-1)) + 1).astype(np.float64)
        in_track = np.bincount(of.track[judged], minlength=of.n_tracks).astype(np.float64)
        either = in_truth[:, None] + in_track[None, :]

        # How well each object and each track go together over the whole sequence: HOTA's global alignment.
        shared = of.iou * real[of.row] * judged[of.column]
        of_truth = np.bincount(of.row, shared, len(of.truth))[of.row]
        of_track = np.bincount(of.column, shared, len(of.track))[of.column]
        names = of.truth[of.row], of.track[of.column]
        together = np.zeros(either.shape)
        np.add.at(together, names, shared / np.maximum(of_truth + of_track - shared, 1e-12))
        alignment = together / np.maximum(either - together, 1e-12)

        made = of.assigned(alignment[names] * shared)
        for k, alpha in enumerate(HOTA_ALPHAS):
            found = made[of.iou[made] >= alpha - 1e-12]
            counts = np.zeros(either.shape)
            np.add.at(counts, (names[0][found], names[1][found]), 1.0)
            n_found[k] += len(found)
            associated[k] += (counts * counts / np.maximum(either - counts, 1.0)).sum()
        n_truth += int(np.count_nonzero(real))
        n_tracked += int(np.count_nonzero(judged))
    if n_truth + n_tracked == 0:
        return Hota(math.nan, math.nan, math.nan)
    detection = n_found / (n_truth + n_tracked - n_found)
    association = associated / np.maximum(n_found, 1.0)
    return Hota(float(np.sqrt(detection * association).mean()), float(detection.mean()), float(association.mean()))


@njit(cache=True, nogil=True)
def fill_assignment(gain: NDArray[np.float64], column: NDArray[np.int64]) -> None:
    """Write the column of each row, so that the gains sum to the most; -1 for rows better left alone.

    Shortest augmenting paths (Jonker and Volgenant 1987) over the columns and one spare for each row.

    Parameters
    ----------
    gain : (n, m) float64
        Pairs with no gain above 0 are never made.
    column : (n,) int64, overwritten
    """
    n, m = gain.shape
    width = m + n
    row_price = np.zeros(n + 1)
    price = np.zeros(width + 1)
    owner = np.full(width + 1, -1, np.int64)  # the last column is where each search starts
    for start in range(n):
        owner[width] = start
        reached = np.full(width, np.inf)
        came_from = np.full(width, width, np.int64)
        done = np.zeros(width + 1, np.bool_)
        at = width
        while True:
            done[at] = True
            row = owner[at]
            step = np.inf
            nearest = -1
            for j in range(width):
                if done[j]:
                    continue
                cost = -gain[row, j] if j < m and gain[row, j] > 0.0 else (0.0 if j == m + row else np.inf)
                cost -= row_price[row] + price[j]
                if cost < reached[j]:
                    reached[j] = cost
                    came_from[j] = at
                if reached[j] < step:
                    step = reached[j]
                    nearest = j
            for j in range(width + 1):
                if done[j]:
                    row_price[owner[j]] += step
                    price[j] -= step
                elif j < width:
                    reached[j] -= step
            at = nearest
            if owner[at] < 0:
                break
        while at != width:
            owner[at] = owner[came_from[at]]
            at = came_from[at]
    column[:] = -1
    for j in range(m):
        if owner[j] >= 0:
            column[owner[j]] = j


@njit(cache=True, nogil=True)
def fill_pairs(shapes: NDArray[np.int64], gain: NDArray[np.float64], pair: NDArray[np.int64]) -> None:
    """Pair truth and tracks of every frame so that the gains sum to the most.

    Parameters
    ----------
    shapes : (frames, 2) int64
        True boxes and tracks' boxes of each frame.
    gain : (pairs,) float64
        Of every pair of one frame, truth by truth; none of 0 is made.
    pair : (truths,) int64, overwritten
        Which pair was made with each true box; -1 for none.
    """
    first, begun = 0, 0
    for n, m in shapes:
        column = np.empty(n, np.int64)
        fill_assignment(gain[begun : begun + n * m].reshape(n, m), column)
        for i in range(n):
            pair[first + i] = begun + i * m + column[i] if column[i] >= 0 else -1
        first += n
        begun += n * m


@njit(cache=True, nogil=True)
def count_breaks(truth: NDArray[np.int64], ids: NDArray[np.int64], ignored: NDArray[np.bool_]) -> tuple[int, int]:
    """ID switches and fragments, counted as KITTI's and AB3DMOT's evaluation do.

    Parameters
    ----------
    truth : (n,) int64
        Object of each true box, frame after frame.
    ids : (n,) int64
        Track that it was matched to; -1 for none.
    ignored : (n,) bool

    Returns
    -------
    switches, fragments : int
        A switch: tracked in this frame and the last, by different tracks. A fragment: taken up by another track, or
        again, and kept for the next frame too. An ignored box makes a new beginning.
    """
    switches = 0
    fragments = 0
    for one in range(truth.max() + 1 if len(truth) else 0):
        own = np.flatnonzero(truth == one)
        hidden = True
        for i in own:
            hidden = hidden and ignored[i]
        if hidden:
            continue
        last = ids[own[0]]
        for f in range(1, len(own)):
            now, before = ids[own[f]], ids[own[f - 1]]
            if ignored[own[f]]:
                last = -1
                continue
            if last != -1 and now != -1:
                stays = f == len(own) - 1 or ids[own[f + 1]] != -1
                switches += last != now and before != -1
                fragments += before != now and stays
            if now != -1:
                last = now
    return switches, fragments
