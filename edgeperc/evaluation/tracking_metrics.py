"""Tracking metrics: CLEAR-MOT, its averages over recall (AB3DMOT), HOTA.

A box is a row ``x, y, z, length, width, height, yaw``: center [m], extents [m], heading about +z from +x [rad].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..errors import TrackingError
from ..system.kernels import njit
from ..types.points import Floats, Ints64, Mask
from .metrics import N_POSITIONS, box_overlaps, recall_positions

HOTA_ALPHAS = np.linspace(0.05, 0.95, 19)


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """True objects of one frame."""

    ids: Ints64  # (n,), the same in all frames
    boxes: Floats  # (n, 7)
    ignored: Mask  # may be found but need not: occluded, truncated, or of a neighboring class


@dataclass(frozen=True, slots=True, eq=False)
class FrameTracks:
    """Tracks of one frame."""

    ids: Ints64
    boxes: Floats  # (m, 7)
    scores: Floats  # the score of a track is the mean over its frames
    excused: Mask  # no false positives: too small in the image, or in a region without labels


@dataclass(frozen=True, slots=True)
class Clear:
    """CLEAR-MOT counts of the tracks above one score (false alarms, missed and ID SW in KUL-Seg's Table 7)."""

    threshold: float  # lowest mean score of a counted track
    n_truth: int  # true boxes, without ignored ones
    n_found: int  # matched true boxes, with ignored ones
    n_false: int
    n_missed: int
    n_switches: int  # how often the track of an object changed between frames
    n_fragments: int  # how often it resumed after a gap
    mota: float  # 1 - (missed + false + switches) / truth; NaN without true boxes
    motp: float  # mean IoU of the matches; NaN without any

    def scaled_mota(self, recall: float) -> float:
        """MOTA that does not count objects beyond ``recall`` as missed, in 0..1 (AB3DMOT's sMOTA)."""
        errors = self.n_missed + self.n_false + self.n_switches - (1.0 - recall) * self.n_truth
        return min(1.0, max(0.0, 1.0 - errors / (recall * self.n_truth)))


@dataclass(frozen=True, slots=True)
class Hota:
    """Higher order tracking accuracy, of detection and of association: means over the IoU thresholds 0.05, 0.10 .. 0.95
    (Luiten et al., IJCV 2020); NaN if there are neither true boxes nor tracks.
    """

    hota: float
    deta: float
    assa: float


@dataclass(frozen=True, slots=True)
class TrackingScores:
    """All figures of one class; means over forty recalls are NaN without true boxes."""

    samota: float  # scaled MOTA (AB3DMOT); a recall that is never reached counts as 0
    amota: float
    amotp: float
    all_tracks: Clear  # with any score
    best: Clear  # at the score threshold with the highest MOTA
    hota: Hota  # at the same threshold
    n_frames: int
    n_objects: int  # that are not ignored in every frame


def box_iou(a: ArrayLike, b: ArrayLike) -> Floats:
    """3-D IoU (n, m) of boxes (n, 7) and (m, 7), in 0..1; 0 if a box is not finite or has no volume."""
    first, second = (np.asarray(boxes, np.float64).reshape(-1, 7) for boxes in (a, b))
    return box_overlaps(first, second)[1]


def recall_thresholds(scores: ArrayLike, n_truth: int) -> tuple[Floats, Floats]:
    """Scores of matches at which the recall is nearest to 1/40, 2/40 .. 1, and these recalls (AB3DMOT's protocol, after
    KITTI's). The lowest score is used for the first recall that is not reached.
    """
    falling = np.sort(np.asarray(scores, dtype=np.float64))[::-1]
    ranks = [*recall_positions(len(falling), n_truth)][1:]
    return falling[ranks], np.cumsum(np.full(len(ranks), 1.0 / N_POSITIONS))


def evaluate_tracks(
    sequences: Sequence[tuple[Sequence[FrameTruth], Sequence[FrameTracks]]],
    iou_threshold: float = 0.25,
    *,
    as_ab3dmot: bool = False,
) -> TrackingScores:
    """Evaluate tracks by AB3DMOT's protocol: in each frame most pairs reach ``iou_threshold``, then their sum of IoU is
    largest; of all tracks, and above the score threshold of each of forty recalls. Raises TrackingError.
    """
    # AB3DMOT's program (6a7fff5, Python below 3.12, whose sum rounds otherwise) reads scores of six digits and averages
    # means again for each threshold, so that about half of the tracks fall below their own: on ten sequences of KITTI 0
    # to 6 points of sAMOTA for cars. There, what was matched once is not excused later, and a track that finds an
    # object only in its last frame is a fragment.
    packed = [_Packed(truth, tracks, iou_threshold, as_ab3dmot) for truth, tracks in sequences]
    everything, scores = _clear(packed, -math.inf)
    n_matchable = everything.n_found + everything.n_missed
    thresholds, recalls = recall_thresholds(scores, n_matchable)
    sums, best = np.zeros(3), everything
    for k, (threshold, recall) in enumerate(zip(thresholds, recalls, strict=True)):
        clear = _at_threshold(packed, threshold)
        if everything.n_truth:
            sums += clear.scaled_mota(recall), clear.mota, clear.motp if clear.n_found else 0.0
        if clear.mota > (0.0 if as_ab3dmot and best is everything else -math.inf if k == 0 else best.mota):
            best = clear
    if as_ab3dmot:
        best = _at_threshold(packed, best.threshold)
    samota, amota, amotp = (sums / N_POSITIONS if everything.n_truth else np.full(3, math.nan)).tolist()
    return TrackingScores(
        samota=samota,
        amota=amota,
        amotp=amotp,
        all_tracks=everything,
        best=best,
        hota=_hota(packed, best.threshold),
        n_frames=sum(len(sequence.shapes) for sequence in packed),
        n_objects=sum(len({*sequence.truth[~sequence.ignored].tolist()}) for sequence in packed),
    )


class _Packed:
    """All frames of one sequence concatenated, with ids from 0 and all pairs of a true box and a track in one frame."""

    def __init__(
        self, truth: Sequence[FrameTruth], tracks: Sequence[FrameTracks], iou_threshold: float, as_ab3dmot: bool = False
    ) -> None:
        if len(truth) != len(tracks):
            raise TrackingError(f"got {len(tracks)} frames of tracks for {len(truth)} of truth; pass one for each")
        self.iou_threshold, self.as_ab3dmot = iou_threshold, as_ab3dmot
        n_truth, n_tracks = ([len(frame.ids) for frame in frames] for frames in (truth, tracks))
        self.shapes = np.array([n_truth, n_tracks], np.int64).T.reshape(-1, 2)
        self.truth, _ = _counted([frame.ids for frame in truth])
        self.track, self.n_tracks = _counted([frame.ids for frame in tracks])
        self.ignored = np.concatenate([np.zeros(0, np.bool_), *(frame.ignored for frame in truth)])
        self.excused = np.concatenate([np.zeros(0, np.bool_), *(frame.excused for frame in tracks)])
        overlaps = [box_iou(a.boxes, b.boxes).ravel() for a, b in zip(truth, tracks, strict=True)]
        self.iou = np.concatenate([np.zeros(0), *overlaps])
        # Rows of each pair among all true boxes and among all boxes of tracks, in the order of ``iou``.
        self.row = np.repeat(np.arange(len(self.truth)), np.repeat(n_tracks, n_truth))
        first = np.repeat(np.cumsum([0, *n_tracks])[:-1], np.multiply(n_truth, n_tracks))
        begun = np.repeat(np.cumsum([0, *np.repeat(n_tracks, n_truth)])[:-1], np.repeat(n_tracks, n_truth))
        self.column = first + np.arange(len(self.iou)) - begun
        scores = np.concatenate([np.zeros(0), *(frame.scores for frame in tracks)])
        if as_ab3dmot:  # np.round is off by one in the last digit for some numbers, which moves a threshold
            scores = np.array([float(f"{score:f}") for score in scores.tolist()], np.float64)
        self.mean_score = self.averaged(scores)
        if not as_ab3dmot:  # rounding would order tracks of one score by their lengths, and split them at thresholds
            lowest, highest = np.full(self.n_tracks, math.inf), np.full(self.n_tracks, -math.inf)
            np.minimum.at(lowest, self.track, scores)
            np.maximum.at(highest, self.track, scores)
            self.mean_score = np.clip(self.mean_score, lowest, highest)
        self.once_matched = np.zeros(len(self.track), np.bool_)

    def averaged(self, scores: Floats) -> Floats:
        """Mean score of each track; one term is added after the other, as in AB3DMOT's program."""
        counts = np.bincount(self.track, minlength=self.n_tracks)
        return np.asarray(np.bincount(self.track, scores, self.n_tracks) / np.maximum(counts, 1))

    def matched(self, threshold: float) -> tuple[Ints64, Mask]:
        """Indices of the matched pairs, and which boxes of tracks are above the threshold."""
        is_scored = (self.mean_score >= threshold)[self.track]
        most = 1.0 + float(self.shapes[:, 0].max(initial=0))  # one more pair outweighs any IoU
        may = is_scored[self.column] & (self.iou >= self.iou_threshold)
        return self.assigned(np.where(may, most + self.iou, 0.0)), is_scored

    def assigned(self, gain: Floats) -> Ints64:
        """Indices of the pairs with the largest sum of gains in each frame; each box is in at most one pair."""
        pair = np.empty(len(self.truth), np.int64)
        fill_pairs(self.shapes, gain, pair)
        return pair[pair >= 0]


def _counted(ids: Sequence[Ints64]) -> tuple[Ints64, int]:
    names, counted = np.unique(np.concatenate([np.zeros(0, np.int64), *ids]), return_inverse=True)
    return counted.astype(np.int64), len(names)


def _at_threshold(packed: Sequence[_Packed], threshold: float) -> Clear:
    for sequence in packed:
        if sequence.as_ab3dmot:
            sequence.mean_score = sequence.averaged(sequence.mean_score[sequence.track])
    return _clear(packed, threshold)[0]


def _clear(packed: Sequence[_Packed], threshold: float) -> tuple[Clear, Floats]:
    """CLEAR-MOT of the tracks with at least this mean score, and the scores of all matches."""
    n_truth = n_found = n_false = n_missed = n_switches = n_fragments = 0
    total_overlap = 0.0
    scores = [np.zeros(0)]
    for sequence in packed:
        pair, unmatched = sequence.matched(threshold)
        unmatched[sequence.column[pair]] = False
        ids = np.full(len(sequence.truth), -1)
        ids[sequence.row[pair]] = sequence.track[sequence.column[pair]]
        switches, fragments = count_breaks(sequence.truth, ids, sequence.ignored, sequence.as_ab3dmot)
        if sequence.as_ab3dmot:
            sequence.once_matched[sequence.column[pair]] = True
        n_truth += int(np.count_nonzero(~sequence.ignored))
        n_found += len(pair)
        n_missed += int(np.count_nonzero((ids < 0) & ~sequence.ignored))
        n_false += int(np.count_nonzero(unmatched & ~(sequence.excused & ~sequence.once_matched)))
        n_switches += switches
        n_fragments += fragments
        total_overlap += float(sequence.iou[pair].sum())
        scores.append(sequence.mean_score[sequence.track[sequence.column[pair]]])
    mota = 1.0 - (n_missed + n_false + n_switches) / n_truth if n_truth else math.nan
    motp = total_overlap / n_found if n_found else math.nan
    counts = n_truth, n_found, n_false, n_missed, n_switches, n_fragments
    return Clear(float(threshold), *counts, mota, motp), np.concatenate(scores)


def _hota(packed: Sequence[_Packed], threshold: float) -> Hota:
    """HOTA, without ignored true boxes, the tracks matched to them, and excused boxes of tracks."""
    n_found, n_truth, n_tracked = np.zeros(len(HOTA_ALPHAS)), 0, 0
    associated = np.zeros(len(HOTA_ALPHAS))
    for sequence in packed:
        pair, is_matched = sequence.matched(threshold)
        real, counted = ~sequence.ignored, is_matched & ~sequence.excused
        counted[sequence.column[pair]] = real[sequence.row[pair]]
        in_truth = np.bincount(sequence.truth[real], minlength=int(sequence.truth.max(initial=-1)) + 1).astype(
            np.float64
        )
        in_track = np.bincount(sequence.track[counted], minlength=sequence.n_tracks).astype(np.float64)
        either = in_truth[:, None] + in_track[None, :]

        # HOTA's global alignment: the overlap of each object with each track over the whole sequence.
        shared = sequence.iou * real[sequence.row] * counted[sequence.column]
        of_truth = np.bincount(sequence.row, shared, len(sequence.truth))[sequence.row]
        of_track = np.bincount(sequence.column, shared, len(sequence.track))[sequence.column]
        names = sequence.truth[sequence.row], sequence.track[sequence.column]
        together = np.zeros(either.shape)
        np.add.at(together, names, shared / np.maximum(of_truth + of_track - shared, 1e-12))
        alignment = together / np.maximum(either - together, 1e-12)

        made = sequence.assigned(alignment[names] * shared)
        for k, alpha in enumerate(HOTA_ALPHAS):
            hits = made[sequence.iou[made] >= alpha - 1e-12]
            counts = np.zeros(either.shape)
            np.add.at(counts, (names[0][hits], names[1][hits]), 1.0)
            n_found[k] += len(hits)
            associated[k] += (counts * counts / np.maximum(either - counts, 1.0)).sum()
        n_truth += int(np.count_nonzero(real))
        n_tracked += int(np.count_nonzero(counted))
    if n_truth + n_tracked == 0:
        return Hota(math.nan, math.nan, math.nan)
    detection = n_found / (n_truth + n_tracked - n_found)
    association = associated / np.maximum(n_found, 1.0)
    return Hota(float(np.sqrt(detection * association).mean()), float(detection.mean()), float(association.mean()))


@njit(cache=True, nogil=True)
def fill_assignment(gain: Floats, column: Ints64) -> None:
    """Write the column of each row, -1 for none, with the largest sum of gains (n, m) above 0: shortest augmenting
    paths (Jonker and Volgenant 1987) over the columns and a dummy column for each row.
    """
    n, m = gain.shape
    width = m + n
    row_price = np.zeros(n + 1)
    price = np.zeros(width + 1)
    owner = np.full(width + 1, -1, np.int64)  # each search starts at the last column
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
def fill_pairs(shapes: Ints64, gain: Floats, pair: Ints64) -> None:
    """Write the pair of each true box, -1 for none, for the largest sum of gains of each frame, of ``shapes`` (true
    boxes, tracks); gains are ordered by true box, those of 0 or less are never made.
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
def count_breaks(truth: Ints64, ids: Ints64, ignored: Mask, late: bool) -> tuple[int, int]:
    """ID switches (different tracks in this and the previous frame) and fragments (another track than before, or after
    a gap, that goes on) of objects; ignored boxes reset both. ``late``: the last frame alone is one, too.
    """
    switches = 0
    fragments = 0
    for one in range(truth.max() + 1 if len(truth) else 0):
        rows = np.flatnonzero(truth == one)
        hidden = True
        for i in rows:
            hidden = hidden and ignored[i]
        if hidden:
            continue
        last = ids[rows[0]]
        for f in range(1, len(rows)):
            now, before = ids[rows[f]], ids[rows[f - 1]]
            if ignored[rows[f]]:
                last = -1
                continue
            if last != -1 and now != -1:
                stays = f == len(rows) - 1 or ids[rows[f + 1]] != -1
                switches += last != now and before != -1
                fragments += before != now and stays
            elif late and f == len(rows) - 1 and now != -1 and before != now:
                fragments += 1  # no track since its first box, or since an ignored one
            if now != -1:
                last = now
    return switches, fragments
