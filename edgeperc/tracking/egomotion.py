"""Estimate the sensor's motion on the ground by a robust rigid fit to tracked objects, if no poses are passed.

The fit finds the motion that moves most detections to the places that their tracks predict. Objects that do not move as
their tracks predict are outliers with little weight.
"""

from __future__ import annotations

import math

import numpy as np

from ..system.kernels import njit
from ..types.points import Floats
from .ukf import fill_inverse

MAX_ROUNDS = 12
MAX_PROPOSALS = 256


@njit(cache=True, nogil=True)
def fit_motion(
    landmarks: Floats, detections: Floats, prior: Floats, prior_variances: Floats, motion: Floats, covariance: Floats
) -> int:
    """Fit the rigid motion that moves detections to the predicted positions of tracks; returns how many were matched.

    Each pair of track and detection proposes a shift and a turn that move the detection to the track. Proposals within
    three standard deviations of the prior are tried, at most 256. A Gauss-Newton iteration starts from the proposal
    with the largest `support`. It matches each track to its nearest detection, with Geman and McClure's weight 1 / (1 +
    r2 / 9)^2, where r is the distance in standard deviations.

    landmarks, detections : (n, 4) x, y [m] in the previous and the current sensor frame, the variance of each
        coordinate [m2], and the group of classes that may be confused.
    prior, motion : x, y [m] and turn [rad] of the sensor in its previous frame; the prior if no detection fits a track.
    """
    # Element by element: to copy an array, numba compiles a broadcast with its error messages, for 3 s.
    for a in range(3):
        motion[a] = prior[a]
    best = support(landmarks, detections, prior, prior_variances, motion)
    proposal = np.empty(3)
    cos, sin = math.cos(prior[2]), math.sin(prior[2])
    reach = 3.0 * math.sqrt(prior_variances[0] + prior_variances[1])
    n_proposals = 0
    for i in range(len(landmarks)):
        for j in range(len(detections)):
            x, y = detections[j, 0], detections[j, 1]
            if landmarks[i, 3] != detections[j, 3]:
                continue
            # A shift or a turn alone: for far landmarks, a small turn has more effect than any plausible shift.
            shift_x = landmarks[i, 0] - prior[0] - (cos * x - sin * y)
            shift_y = landmarks[i, 1] - prior[1] - (sin * x + cos * y)
            turn = math.atan2(landmarks[i, 1] - prior[1], landmarks[i, 0] - prior[0]) - math.atan2(y, x) - prior[2]
            turn -= 2.0 * math.pi * np.floor(turn / (2.0 * math.pi) + 0.5)  # math.floor raises on NaN
            for by_turn in (False, True):
                for a in range(3):
                    proposal[a] = prior[a]
                if by_turn:
                    proposal[2] += turn
                    near = abs(turn) < 3.0 * math.sqrt(prior_variances[2])
                else:
                    proposal[0] += shift_x
                    proposal[1] += shift_y
                    near = math.hypot(shift_x, shift_y) < reach + 3.0 * math.sqrt(landmarks[i, 2])
                if near and n_proposals < MAX_PROPOSALS:
                    n_proposals += 1
                    fit = support(landmarks, detections, prior, prior_variances, proposal)
                    if fit > best:
                        best = fit
                        for a in range(3):
                            motion[a] = proposal[a]

    information = np.empty((3, 3))
    slope = np.empty(3)
    n_pairs = 0
    for _ in range(MAX_ROUNDS):
        n_pairs = 0
        information[:] = 0.0
        for a in range(3):
            information[a, a] = 1.0 / prior_variances[a]
            slope[a] = (prior[a] - motion[a]) / prior_variances[a]
        cos, sin = math.cos(motion[2]), math.sin(motion[2])
        for i in range(len(landmarks)):
            nearest, squared = nearest_detection(landmarks[i], detections, motion)
            if nearest < 0 or squared > 25.0:
                continue
            n_pairs += 1
            x, y = detections[nearest, 0], detections[nearest, 1]
            turned_x, turned_y = cos * x - sin * y, sin * x + cos * y
            weight = 1.0 / (1.0 + squared / 9.0) ** 2 / (landmarks[i, 2] + detections[nearest, 2])
            off_x = landmarks[i, 0] - motion[0] - turned_x
            off_y = landmarks[i, 1] - motion[1] - turned_y
            # Derivatives of the detection's position by x, y and turn: (1, 0), (0, 1), (-turned_y, turned_x).
            slope[0] += weight * off_x
            slope[1] += weight * off_y
            slope[2] += weight * (off_y * turned_x - off_x * turned_y)
            information[0, 0] += weight
            information[1, 1] += weight
            information[0, 2] -= weight * turned_y
            information[1, 2] += weight * turned_x
            information[2, 2] += weight * (turned_x * turned_x + turned_y * turned_y)
        information[2, 0], information[2, 1] = information[0, 2], information[1, 2]
        fill_inverse(information, covariance)
        step = 0.0
        for a in range(3):
            change = covariance[a, 0] * slope[0] + covariance[a, 1] * slope[1] + covariance[a, 2] * slope[2]
            motion[a] += change
            step = max(step, abs(change))
        if step < 1e-9:
            break
    return n_pairs


@njit(cache=True, nogil=True)
def support(landmarks: Floats, detections: Floats, prior: Floats, prior_variances: Floats, motion: Floats) -> float:
    """Score a motion: minus its distance from the prior, minus the robust distances of all tracks; at most 0.

    The robust distance is Geman and McClure's r2 / (1 + r2 / 9) / 2. It is below 4.5, the cost of a track without a
    detection.
    """
    total = 0.0
    for a in range(3):
        total -= 0.5 * (motion[a] - prior[a]) ** 2 / prior_variances[a]
    for i in range(len(landmarks)):
        nearest, squared = nearest_detection(landmarks[i], detections, motion)
        total -= 4.5 if nearest < 0 else 0.5 * squared / (1.0 + squared / 9.0)
    return total


@njit(cache=True, nogil=True)
def nearest_detection(landmark: Floats, detections: Floats, motion: Floats) -> tuple[int, float]:
    """Find the detection nearest to a landmark (4,) under a motion (3,).

    Returns its index, -1 if there is none of the same group, and the squared distance in variances.
    """
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    nearest, smallest = -1, np.inf
    for j in range(len(detections)):
        if landmark[3] != detections[j, 3]:
            continue
        off_x = landmark[0] - motion[0] - (cos * detections[j, 0] - sin * detections[j, 1])
        off_y = landmark[1] - motion[1] - (sin * detections[j, 0] + cos * detections[j, 1])
        squared = (off_x * off_x + off_y * off_y) / (landmark[2] + detections[j, 2])
        if squared < smallest:
            nearest, smallest = j, squared
    return nearest, smallest
