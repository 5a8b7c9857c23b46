"""Kernels for birth, update and reporting of tracks."""

from __future__ import annotations

import math

import numpy as np

from ..system.kernels import njit
from ..types.points import Floats, Ints64, Mask, Records
from .jpda import Detections

# Complete state of a track. The tracker replaces it as a whole, so a scan that raises an error changes nothing.
TRACK = np.dtype(
    [
        *((name, np.int64) for name in ("id", "label", "group", "source", "hits", "misses")),
        *((name, np.float64) for name in ("label_weight", "score", "logit_sum", "last_logit", "chances")),
        *((name, np.float64) for name in ("age_s", "missed_s", "existence")),
        ("states", np.float64, (3, 5)),
        ("covariances", np.float64, (3, 5, 5)),
        ("modes", np.float64, 3),
        ("state", np.float64, 5),
        ("covariance", np.float64, (5, 5)),
        ("shape", np.float64, 4),
        ("shape_variance", np.float64, 4),
        ("fronts", np.float64, 3),
    ]
)

# Fields that `ClassParameters` and CLASS have in common.
SCALARS = (
    *("still_mps", "keep_motion_s", "range_m", "detection", "gate", "memory_s"),
    *("moving_mps", "latest", "far_logit", "coasting_logit"),
)

# Parameters of a class, as the kernels use them.
CLASS = np.dtype(
    [
        ("group", np.int64),
        ("noise", np.float64, 5),
        ("sigmas", np.float64, 3),
        ("shape", np.float64, 4),
        ("birth", np.float64, 2),
        *((name, np.float64) for name in ("odds", "birth_logit", "sure_logit", *SCALARS)),
    ]
)

# Existence is the log odds that the object exists: a track is reported above 0 and deleted below LEAST_EXISTENCE. A
# detection adds its score, and EXPECTED because it lies in the gate. Without the maximum, an object that was tracked
# for a long time would be reported for a long time after it left.
EXPECTED, MOST_EXISTENCE, LEAST_EXISTENCE = 1.0, 5.0, -6.0

# Log odds that the heading of a track points to its front. A scan in which it moves adds MOVED, so after eight such
# scans motion has all its weight, 0.98. Detections with a known front have more weight in the end than motion, because
# vehicles also reverse. One detection counts up to TOLD, because the same error recurs from scan to scan.
MOVED, MOST_MOVED = 0.5, 4.0
TOLD, MOST_TOLD = 2.0, 8.0

# A box may be larger than its object, so no track counts as completely hidden.
MOST_HIDDEN = 0.9


@njit(cache=True, nogil=True)
def fill_newborn(first_id: int, detections: Detections, classes: Records, tracks: Records) -> None:
    """Begin a track at each detection, from ``first_id`` on, with speed 0; ``tracks`` are all 0 beforehand."""
    places, shapes, logits, fronts = detections.places, detections.shapes, detections.logits, detections.fronts
    for i in range(len(tracks)):
        track, of = tracks[i], classes[i]
        farther = 1.0 + detections.ranges[i] / of["range_m"]
        x, y, heading = places[i, 0], places[i, 1], places[i, 2]
        cos, sin = math.cos(heading), math.sin(heading)
        along, across, turn = of["sigmas"][0] * farther, of["sigmas"][1] * farther, of["sigmas"][2] * farther
        track["id"], track["label"], track["group"] = first_id + i, detections.kinds[i], of["group"]
        track["hits"], track["chances"], track["label_weight"], track["source"] = 1, 1.0, 1.0, detections.sources[i]
        track["fronts"][1], track["fronts"][2] = min(max(fronts[i], -TOLD), TOLD), 1.0
        track["logit_sum"] = track["last_logit"] = logits[i]
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
def mark_out_of_view(tracks: Records, pose: Floats, right: float, width: float, reported: Mask) -> None:
    """Exclude undetected tracks from the report if a corner of the footprint is outside the field of view of the sensor
    at ``pose``: that begins at the azimuth ``right`` and is so wide [rad].
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
            turns = (azimuth - right) / (2.0 * math.pi)
            if not (turns - np.floor(turns)) * 2.0 * math.pi <= width:  # math.floor raises on NaN
                reported[i] = False


@njit(cache=True, nogil=True)
def fill_hidden(state: Floats, shape: Floats, seen: Mask, sensor: Floats, hidden: Floats) -> None:
    """Compute the share of each track that other tracks hide from the sensor: of nine rays over the width of the
    footprint, those that meet a nearer track. Tracks that were ``seen`` can hide others, and are not hidden.
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
def mark_rivals(state: Floats, shape: Floats, order: Ints64, reported: Mask) -> None:
    """Exclude a track from the report if its center lies in the footprint of one before it in ``order``, or vice versa.

    Two objects cannot occupy one place. A cyclist, for example, is often detected as a pedestrian too.
    """
    # Strongest first, so the flags of all stronger tracks are final.
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
            if abs(dx) > reach or abs(dy) > reach:  # excludes nearly all pairs; ten times faster
                continue
            for i in (weak, strong):
                cos, sin = math.cos(state[i, 3]), math.sin(state[i, 3])
                if abs(dx * cos + dy * sin) < 0.5 * shape[i, 1] and abs(dy * cos - dx * sin) < 0.5 * shape[i, 2]:
                    reported[weak] = False


@njit(cache=True, nogil=True)
def update_shapes(beta: Floats, shapes: Floats, sigmas: Floats, walk: Floats, shape: Floats, variance: Floats) -> None:
    """Smooth the height of the center and the size by Kalman filters, in place; ``walk`` has the standard deviations of
    their random walks between the scans [m].
    """
    for i in range(len(shape)):
        seen = np.zeros(4)
        for j in range(len(shapes)):
            if beta[i, j + 1] == 0.0:
                continue
            for a in range(4):
                seen[a] += beta[i, j + 1] * shapes[j, a]
        detected = 1.0 - beta[i, 0]
        for a in range(4):
            variance[i, a] += walk[a] * walk[a]
            gain = variance[i, a] / (variance[i, a] + sigmas[i, a] * sigmas[i, a])
            shape[i, a] += gain * (seen[a] - detected * shape[i, a])
            variance[i, a] *= 1.0 - gain * detected


@njit(cache=True, nogil=True)
def update_fronts(
    state: Floats,
    speed_sigma: Floats,
    moving_mps: Floats,
    beta: Floats,
    detections: Floats,
    told: Floats,
    fronts: Floats,
) -> None:
    """Collect evidence that the heading of each track points to its front and not to its rear; in place.

    moving_mps : a track moves if its speed is higher than this, and than three standard deviations.
    told : log odds that the heading of the detection points to the front; 0 if that is unknown.
    fronts : (n, 3) log odds from motion, in -4..4: objects move forward. Log odds from the detections, in -8..8.
        Balance of the detections' headings, in -10..10, for detections that do not say whether they know the front.
    """
    for i in range(len(fronts)):
        speed = abs(state[i, 2])
        if speed > moving_mps[i] and speed > 3.0 * speed_sigma[i]:
            step = MOVED if state[i, 2] > 0.0 else -MOVED
            fronts[i, 0] = min(max(fronts[i, 0] + step, -MOST_MOVED), MOST_MOVED)
        for j in range(len(detections)):
            if beta[i, j + 1] == 0.0:
                continue
            along = math.cos(detections[j, 2] - state[i, 3])
            fronts[i, 1] += beta[i, j + 1] * min(max(told[j], -TOLD), TOLD) * (1.0 if along > 0.0 else -1.0)
            fronts[i, 2] += beta[i, j + 1] * along
        fronts[i, 1] = min(max(fronts[i, 1], -MOST_TOLD), MOST_TOLD)
        fronts[i, 2] = min(max(fronts[i, 2], -10.0), 10.0)


@njit(cache=True, nogil=True)
def update_lives(
    tracks: Records, classes: Records, beta: Floats, hidden: Floats, logits: Floats, kinds: Ints64, dt: float
) -> None:
    """Update hits, misses and detection of each track, its label by majority, and its existence; in place. ``logits``
    and ``kinds`` are the log odds of the detections' scores, and their classes.
    """
    for i in range(len(tracks)):
        track, of = tracks[i], classes[i]
        track["age_s"] += dt
        if beta[i, 0] >= 0.5:
            track["chances"] += 1.0 - MOST_HIDDEN * hidden[i]
            track["misses"] += 1
            track["source"] = -1
            track["missed_s"] += dt
            # Likelihood ratio of a miss: the numerator assumes that the object exists; without an object it is 1.
            track["existence"] += math.log(1.0 - of["detection"] * (1.0 - MOST_HIDDEN * hidden[i]))
            continue
        best = 0
        for k in range(1, beta.shape[1] - 1):  # np.argmax would import scipy where the kernel is loaded
            if beta[i, k + 1] > beta[i, best + 1]:
                best = k
        track["misses"], track["missed_s"], track["source"] = 0, 0.0, best
        track["hits"] += 1
        track["chances"] += 1.0
        track["logit_sum"] += logits[best]
        track["last_logit"] = logits[best]
        # Boyer-Moore majority vote: other labels count down, and replace the label below 0.
        weight = track["label_weight"] + (1.0 if track["label"] == kinds[best] else -1.0)
        if weight < 0.0:
            track["label"] = kinds[best]
        track["label_weight"] = min(abs(weight), 20.0)
        # A repeated detection leads to at least the existence of a first one.
        existence = max(track["existence"], -of["sure_logit"]) + max(logits[best], 0.0) + EXPECTED
        track["existence"] = min(existence, MOST_EXISTENCE)
