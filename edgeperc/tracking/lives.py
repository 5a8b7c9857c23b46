"""Birth, update and reporting of tracks (kernels)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = [
    "CLASS",
    "EXPECTED",
    "LEAST_EXISTENCE",
    "MOST_EXISTENCE",
    "MOST_HIDDEN",
    "TRACK",
    "fill_hidden",
    "fill_newborn",
    "mark_out_of_view",
    "mark_rivals",
    "update_lives",
    "update_shapes",
]

# State of a track. All of it is here, so a scan that raises an error leaves the tracker unchanged.
TRACK = np.dtype(
    [
        ("id", np.int64),
        ("label", np.int64),
        ("group", np.int64),
        ("label_weight", np.float64),
        ("states", np.float64, (3, 5)),
        ("covariances", np.float64, (3, 5, 5)),
        ("modes", np.float64, 3),
        ("state", np.float64, 5),
        ("covariance", np.float64, (5, 5)),
        ("shape", np.float64, 4),
        ("shape_variance", np.float64, 4),
        ("front", np.float64),
        ("logit_sum", np.float64),
        ("chances", np.float64),
        ("age_s", np.float64),
        ("missed_s", np.float64),
        ("hits", np.int64),
        ("misses", np.int64),
        ("existence", np.float64),
    ]
)

# Parameters of a class, as the kernels use them.
CLASS = np.dtype(
    [
        ("group", np.int64),
        ("noise", np.float64, 5),
        ("sigmas", np.float64, 3),
        ("shape", np.float64, 4),
        ("birth", np.float64, 2),
        *(
            (name, np.float64)
            for name in (
                "still_mps",
                "keep_motion_s",
                "range_m",
                "detection",
                "odds",
                "gate",
                "birth_logit",
                "sure_logit",
            )
        ),
        ("memory_s", np.float64),
    ]
)

# Existence is the log odds that the object is there: a track is reported above 0 and deleted below LEAST_EXISTENCE. A
# detection adds its score, and EXPECTED for lying in the gate. Without the maximum, an object that was tracked for long
# would be reported long after it is gone.
EXPECTED, MOST_EXISTENCE, LEAST_EXISTENCE = 1.0, 5.0, -6.0

# An occluding box may be a little larger than its object, so no track counts as wholly hidden.
MOST_HIDDEN = 0.9


@njit(cache=True, nogil=True)
def fill_newborn(
    first_id: int,
    kinds: NDArray[np.int64],
    classes: NDArray[np.void],
    detections: NDArray[np.float64],
    shapes: NDArray[np.float64],
    logits: NDArray[np.float64],
    ranges: NDArray[np.float64],
    tracks: NDArray[np.void],
) -> None:
    """Begin a track with each detection, with speed 0.

    Parameters
    ----------
    first_id : int
    kinds : (n,) int64
        Class of each detection.
    classes : (n,) record
        Parameters of each detection's class.
    detections : (n, 3) float64
        x, y [m], heading [rad].
    shapes : (n, 4) float64
        Height of the center, length, width, height [m].
    logits : (n,) float64
        Scores.
    ranges : (n,) float64
        Distances from the sensor [m].
    tracks : (n,) record, overwritten
        All fields 0 beforehand.
    """
    for i in range(len(tracks)):
        track, of = tracks[i], classes[i]
        farther = 1.0 + ranges[i] / of["range_m"]
        x, y, heading = detections[i, 0], detections[i, 1], detections[i, 2]
        cos, sin = math.cos(heading), math.sin(heading)
        along, across, turn = of["sigmas"][0] * farther, of["sigmas"][1] * farther, of["sigmas"][2] * farther
        track["id"], track["label"], track["group"] = first_id + i, kinds[i], of["group"]
        track["hits"], track["chances"], track["front"], track["label_weight"] = 1, 1.0, 1.0, 1.0
        track["logit_sum"] = logits[i]
        track["existence"] = min(logits[i] - of["sure_logit"], MOST_EXISTENCE)
        for a in range(4):
            track["shape"][a] = shapes[i, a]
            track["shape_variance"][a] = (of["shape"][a] * farther) ** 2
        for mode in range(3):
            track["modes"][mode] = 1.0 / 3.0
            state, spread = track["states"][mode], track["covariances"][mode]
            state[0], state[1], state[3] = x, y, heading
            spread[0, 0] = (along * cos) ** 2 + (across * sin) ** 2
            spread[1, 1] = (along * sin) ** 2 + (across * cos) ** 2
            spread[0, 1] = spread[1, 0] = (along**2 - across**2) * cos * sin
            spread[2, 2] = of["birth"][0] ** 2 if mode < 2 else of["still_mps"] ** 2
            spread[3, 3] = turn**2
            spread[4, 4] = of["birth"][1] ** 2
            for a in range(5):
                track["state"][a] = state[a]
                for b in range(5):
                    track["covariance"][a, b] += spread[a, b] / 3.0


@njit(cache=True, nogil=True)
def mark_out_of_view(
    tracks: NDArray[np.void], pose: NDArray[np.float64], left: float, right: float, reported: NDArray[np.bool_]
) -> None:
    """Do not report undetected tracks with a corner of the footprint outside the field of view.

    Parameters
    ----------
    tracks : (n,) record
    pose : (4, 4) float64
        T_world_sensor.
    left, right : float
        Azimuths of the edges [rad].
    reported : (n,) bool
        Set to False for these tracks.
    """
    for i in range(len(tracks)):
        if not reported[i] or tracks[i]["misses"] == 0:
            continue
        state, shape = tracks[i]["state"], tracks[i]["shape"]
        cos, sin = math.cos(state[3]), math.sin(state[3])
        for corner in range(4):
            along = 0.5 * shape[1] * (1.0 if corner < 2 else -1.0)
            across = 0.5 * shape[2] * (1.0 if corner % 2 == 0 else -1.0)
            x = state[0] + along * cos - across * sin - pose[0, 3]
            y = state[1] + along * sin + across * cos - pose[1, 3]
            azimuth = math.atan2(x * pose[0, 1] + y * pose[1, 1], x * pose[0, 0] + y * pose[1, 0])
            if not right <= azimuth <= left:
                reported[i] = False


@njit(cache=True, nogil=True)
def fill_hidden(
    state: NDArray[np.float64],
    shape: NDArray[np.float64],
    seen: NDArray[np.bool_],
    sensor: NDArray[np.float64],
    hidden: NDArray[np.float64],
) -> None:
    """Write the share of each track that others hide from the sensor.

    Parameters
    ----------
    state : (n, 5) float64
        x, y, v, heading, turn rate.
    shape : (n, 4) float64
        Height of the center, length, width, height.
    seen : (n,) bool
        Tracks detected in this scan; they hide others and count as visible.
    sensor : (2,) float64
        x, y [m].
    hidden : (n,) float64, overwritten
        In 0..1: share of nine rays over the width of the footprint.
    """
    n = len(hidden)
    azimuth, half, distance = np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        dx, dy = state[i, 0] - sensor[0], state[i, 1] - sensor[1]
        azimuth[i], distance[i] = math.atan2(dy, dx), math.hypot(dx, dy)
        turned = state[i, 3] - azimuth[i]
        width = shape[i, 1] * abs(math.sin(turned)) + shape[i, 2] * abs(math.cos(turned))
        half[i] = math.atan2(0.5 * width, distance[i])
    hidden[:] = 0.0
    for i in range(n):
        if seen[i]:
            continue
        for ray in range(9):
            at = azimuth[i] + half[i] * (0.25 * ray - 1.0)
            for j in range(n):
                off = at - azimuth[j]
                off -= 2.0 * math.pi * np.floor(off / (2.0 * math.pi) + 0.5)  # math.floor raises on NaN
                if seen[j] and distance[j] < distance[i] - 1.0 and abs(off) <= half[j]:
                    hidden[i] += 1.0 / 9.0
                    break


@njit(cache=True, nogil=True)
def mark_rivals(
    state: NDArray[np.float64], shape: NDArray[np.float64], strength: NDArray[np.float64], reported: NDArray[np.bool_]
) -> None:
    """Do not report a track if its center lies in the footprint of a stronger track, or the other way round.

    Two objects cannot share a place: a cyclist, for example, is often detected as a pedestrian too.

    Parameters
    ----------
    state : (n, 5) float64
        x, y, v, heading, turn rate.
    shape : (n, 4) float64
        Height of the center, length, width, height.
    strength : (n,) float64
        Of equally strong tracks, the first is reported.
    reported : (n,) bool
        Set to False for these tracks.
    """
    # In this order all stronger tracks come before a track, so their flags are final.
    order = np.argsort(-strength, kind="mergesort")
    for b in range(len(order)):
        weak = order[b]
        for a in range(b):
            strong = order[a]
            if not reported[weak]:
                break
            if not reported[strong]:
                continue
            dx, dy = state[weak, 0] - state[strong, 0], state[weak, 1] - state[strong, 1]
            reach = 0.5 * max(shape[weak, 1] + shape[weak, 2], shape[strong, 1] + shape[strong, 2])
            if abs(dx) > reach or abs(dy) > reach:  # true of nearly all pairs, and ten times faster
                continue
            for i in (weak, strong):
                cos, sin = math.cos(state[i, 3]), math.sin(state[i, 3])
                if abs(dx * cos + dy * sin) < 0.5 * shape[i, 1] and abs(dy * cos - dx * sin) < 0.5 * shape[i, 2]:
                    reported[weak] = False


@njit(cache=True, nogil=True)
def update_shapes(
    state: NDArray[np.float64],
    beta: NDArray[np.float64],
    detections: NDArray[np.float64],
    shapes: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    walk: NDArray[np.float64],
    shape: NDArray[np.float64],
    variance: NDArray[np.float64],
    front: NDArray[np.float64],
) -> None:
    """Smooth the height of the center and the size by Kalman filters, and vote for the front end; in place.

    Parameters
    ----------
    state : (n, 5) float64
        x, y, v, heading, turn rate after the update.
    beta : (n, m + 1) float64
        Probability that the track was not detected, and that each detection belongs to it.
    detections : (m, 3) float64
        x, y [m], heading [rad].
    shapes : (m, 4) float64
        Height of the center, length, width, height [m].
    sigmas : (n, 4) float64
        Standard deviations of ``shapes`` [m].
    walk : (4,) float64
        Standard deviations of their random walks between the scans [m].
    shape, variance : (n, 4) float64
    front : (n,) float64
        Votes, in -10..10; below 0 the heading points to the rear. Most objects move forward.
    """
    for i in range(len(front)):
        vote = 0.5 * math.tanh(state[i, 2] / 3.0)
        seen = np.zeros(4)
        for j in range(len(detections)):
            if beta[i, j + 1] == 0.0:
                continue
            vote += beta[i, j + 1] * math.cos(detections[j, 2] - state[i, 3])
            for a in range(4):
                seen[a] += beta[i, j + 1] * shapes[j, a]
        front[i] = min(max(front[i] + vote, -10.0), 10.0)
        detected = 1.0 - beta[i, 0]
        for a in range(4):
            variance[i, a] += walk[a] * walk[a]
            gain = variance[i, a] / (variance[i, a] + sigmas[i, a] * sigmas[i, a])
            shape[i, a] += gain * (seen[a] - detected * shape[i, a])
            variance[i, a] *= 1.0 - gain * detected


@njit(cache=True, nogil=True)
def update_lives(
    tracks: NDArray[np.void],
    classes: NDArray[np.void],
    beta: NDArray[np.float64],
    hidden: NDArray[np.float64],
    logits: NDArray[np.float64],
    kinds: NDArray[np.int64],
    dt: float,
) -> None:
    """Update hits and misses, the label by majority, and the existence of each track; in place.

    Parameters
    ----------
    tracks : (n,) record
    classes : (n,) record
        Parameters of each track's class.
    beta : (n, m + 1) float64
        Probability that the track was not detected, and that each detection belongs to it.
    hidden : (n,) float64
        From `fill_hidden`.
    logits : (m,) float64
        Scores of the detections.
    kinds : (m,) int64
        Classes of the detections.
    dt : float
    """
    for i in range(len(tracks)):
        track, of = tracks[i], classes[i]
        track["age_s"] += dt
        if beta[i, 0] >= 0.5:
            track["chances"] += 1.0 - MOST_HIDDEN * hidden[i]
            track["misses"] += 1
            track["missed_s"] += dt
            # Likelihood ratio of a miss: if the object is there, over 1 if it is not.
            track["existence"] += math.log(1.0 - of["detection"] * (1.0 - MOST_HIDDEN * hidden[i]))
            continue
        best = np.argmax(beta[i, 1:])
        track["misses"], track["missed_s"] = 0, 0.0
        track["hits"] += 1
        track["chances"] += 1.0
        track["logit_sum"] += logits[best]
        # Boyer-Moore majority vote: a label is replaced when the others outnumber it.
        weight = track["label_weight"] + (1.0 if track["label"] == kinds[best] else -1.0)
        if weight < 0.0:
            track["label"] = kinds[best]
        track["label_weight"] = min(abs(weight), 20.0)
        # A repeated detection counts no less than a first one.
        existence = max(track["existence"], -of["sure_logit"]) + max(logits[best], 0.0) + EXPECTED
        track["existence"] = min(existence, MOST_EXISTENCE)
