"""Tracks in hindsight: fixed-interval smoothing of a whole recording (Rauch, Tung and Striebel, 1965)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from ..errors import TrackingError
from ..system.fields import Fields
from ..types.points import Ints64, Records
from .lives import MOST_MOVED, TRACK, mark_rivals
from .tracker import SHAPE_WALK_M, combine, mix, predict
from .tracks import Tracks, strength_of
from .ukf import fill_crosses

_TRACKS = Fields("the recording", TrackingError)


def smooth_tracks(recording: Iterable[Tracks]) -> list[Tracks]:
    """Estimate the tracks of a whole recording anew, at each scan from all scans: from those after it, too.

    In hindsight a track begins with its first detection, ends with its last one, and goes on where none was between
    them. Its places, headings and speeds are smoothed, and it has one class, that of most scans, one size and one
    front. What was never reported stays out.

    Parameters
    ----------
    recording : iterable of Tracks
        What one `Tracker` returned, in this order, between two calls of `Tracker.reset`.

    Returns
    -------
    list of Tracks
        One for each, with its time, pose, session and ids, and the scores that were known at its time.

    Raises
    ------
    TrackingError
        These are no `Tracks` of one recording in order, or were smoothed before.

    Examples
    --------
    >>> tracker = Tracker()                                            # doctest: +SKIP
    >>> online = [tracker(perception) for perception in perceptions]   # doctest: +SKIP
    >>> for tracks in smooth_tracks(online):                           # doctest: +SKIP
    ...     print(tracks.stamp_s, [track.box for track in tracks])
    """
    answers = [*_TRACKS.iterator("recording", recording, "what a Tracker returned for each scan, as it was")]
    if not all(isinstance(tracks, Tracks) and len(tracks.every) >= len(tracks) for tracks in answers):
        raise TrackingError(
            "got no Tracks, or smoothed ones; expected what a Tracker returned for each scan, as it was"
        )
    smoothed = list(answers)
    reported = np.unique(np.concatenate([np.zeros(0, np.int64), *(tracks.ids for tracks in answers)]))
    for session in {tracks.session for tracks in answers if not tracks.is_late}:
        scans = [k for k, tracks in enumerate(answers) if tracks.session == session and not tracks.is_late]
        for k, tracks in zip(scans, _smoothed([answers[k] for k in scans], reported), strict=True):
            smoothed[k] = tracks
    return smoothed


def _smoothed(online: Sequence[Tracks], reported: Ints64) -> list[Tracks]:
    """The scans of one session with those tracks that were ``reported`` at any time."""
    names, class_table = online[-1].class_names, online[-1].class_table
    after, after_s, found, seen = np.zeros(0, TRACK), math.inf, [], np.zeros(0, np.int64)
    for tracks in reversed(online):
        rows = tracks.every[np.isin(tracks.every["id"], reported)]
        goes_on = np.isin(rows["id"], after["id"])
        begun = goes_on | (rows["misses"] == 0)
        rows, goes_on = rows[begun], goes_on[begun]
        later = after[np.isin(after["id"], rows["id"])]  # ids rise in every scan
        is_reused = np.isin(rows["id"][~goes_on], seen).any() or (later["age_s"] <= rows["age_s"][goes_on]).any()
        if not tracks.stamp_s < after_s or is_reused or tracks.class_names != names[: len(tracks.class_names)]:
            times = f"got a scan at {tracks.stamp_s} s before one at {after_s} s"
            raise TrackingError(f"{times}; expected one recording, of one Tracker and without a reset")
        rows[goes_on] = _retraced(rows[goes_on], later, class_table, after_s - tracks.stamp_s)
        after, after_s, seen = rows, tracks.stamp_s, np.union1d(seen, rows["id"])
        found.append(rows)
    smoothed = []
    for tracks, rows in zip(online, reversed(_of_lives(found)), strict=True):
        shown = np.ones(len(rows), np.bool_)
        strongest_first = np.argsort(-strength_of(rows), kind="stable")
        mark_rivals(rows["state"].copy(), rows["shape"].copy(), strongest_first, shown)
        n_out = len(tracks) + tracks.n_tentative - int(shown.sum())
        of_scan = tracks.stamp_s, tracks.T_world_sensor, n_out, tracks.n_approximated, tracks.session
        smoothed.append(Tracks(rows[shown], names, class_table, *of_scan))
    return smoothed


def _of_lives(found: Sequence[Records]) -> list[Records]:
    """Each track with the class of most scans, one size, the mean by precision, and one front, the mean of what its
    scans knew.
    """
    every = np.concatenate(found)
    ids, last, number = np.unique(every["id"], return_index=True, return_inverse=True)
    moved = every["fronts"][last, 0][number]  # after a long stand, a mean would not know where an object drives to
    votes = np.zeros((len(ids), 1 + every["label"].max(initial=0)))
    np.add.at(votes, (number, every["label"]), 1.0)
    every["label"] = votes.argmax(axis=1)[number]
    precision = 1.0 / every["shape_variance"][:, 1:]
    for values, weights in ((every["shape"][:, 1:], precision), (every["fronts"], np.ones_like(precision))):
        for value, weight in zip(values.T, weights.T, strict=True):  # views
            value[:] = (np.bincount(number, weight * value) / np.bincount(number, weight))[number]
    every["fronts"][:, 0] = np.where(np.abs(moved) < MOST_MOVED, every["fronts"][:, 0], moved)
    return np.split(every, np.cumsum([len(rows) for rows in found])[:-1])


def _retraced(tracks: Records, later: Records, class_table: Records, dt: float) -> Records:
    """Tracks at a scan, from their estimates there and the smoothed ones ``later``, after ``dt`` [s]: with the gain
    G = C P'^-1 of the predicted covariance P' and its covariance C with the state, x + G (x_later - x'), and
    P + G (P_later - P') G^T.
    """
    of = class_table[tracks["label"]]
    mixed = mix(tracks, of, dt)
    moved = predict(mixed, of, dt)
    (state, covariance), (expected, spread) = combine(*mixed), combine(*moved)
    by_mode = np.empty_like(mixed.covariances)
    fill_crosses(mixed.means, mixed.covariances, dt, by_mode)
    by_mode += (mixed.means - state[:, None])[..., None] * (moved.means - expected[:, None])[..., None, :]
    cross = np.einsum("nj,njab->nab", mixed.prior, by_mode)
    gain = np.linalg.solve(spread, cross.swapaxes(-1, -2)).swapaxes(-1, -2)
    result = tracks.copy()
    result["state"] = state + (gain @ (later["state"] - expected)[..., None])[..., 0]
    result["covariance"] = covariance + gain @ (later["covariance"] - spread) @ gain.swapaxes(-1, -2)
    walked = tracks["shape_variance"] + SHAPE_WALK_M**2 * dt
    share = tracks["shape_variance"] / walked
    result["shape"] += share * (later["shape"] - tracks["shape"])
    result["shape_variance"] += share**2 * (later["shape_variance"] - walked)
    return result
