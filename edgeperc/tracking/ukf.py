"""Unscented Kalman filters of three motion models (KUL-Seg 6 and Figure 10: prediction and measurement update).

The models are constant velocity, constant turn rate and velocity (CTRV) and random motion. All have the state
``x, y, v, heading, turn rate`` [m, m, m/s, rad, rad/s], where v is along the heading and may be negative, and the
measurement ``x, y, heading``.
"""

from __future__ import annotations

import math

import numpy as np

from ..system.kernels import njit
from ..types.points import Floats

CONSTANT_VELOCITY, CTRV, RANDOM_MOTION = 0, 1, 2
MODES = ("constant_velocity", "constant_turn", "random_motion")

# n + kappa of the unscented transform: the sigma points are x, with weight kappa / (n + kappa), and x plus and minus
# each column of the Cholesky root of (n + kappa) P. With kappa = 1 all weights are positive, so covariances stay
# positive definite.
SPREAD = 6.0
STRAIGHT_RAD_S = 1e-4  # below this turn rate, arc and chord differ by less than rounding errors


@njit(cache=True, nogil=True)
def fill_predictions(
    states: Floats, covariances: Floats, noise: Floats, dt: float, means: Floats, predicted: Floats
) -> None:
    """Predict each motion model of each track with sigma points (KUL-Seg's "prediction"): constant velocity, CTRV,
    random motion.

    noise : (n, 5) standard deviations: acceleration [m/s2], turn acceleration [rad/s2], random walk of the place
        [m/s^0.5], of the heading [rad/s^0.5], and speed of random motion [m/s].
    predicted : covariances, with additive process noise.
    """
    points = np.empty((11, 5))
    root = np.empty((5, 5))
    process = np.empty((5, 5))
    for i in range(states.shape[0]):
        for mode in range(3):
            fill_moved(mode, states[i, mode], covariances[i, mode], dt, root, points)
            mean, cov = means[i, mode], predicted[i, mode]
            mean[:] = 0.0
            for k in range(11):
                for a in range(5):
                    mean[a] += points[k, a] * (1.0 / SPREAD if k == 0 else 0.5 / SPREAD)
            fill_process_noise(mode, states[i, mode, 3], noise[i], dt, process)
            for a in range(5):
                for b in range(a + 1):
                    total = process[a, b]
                    for k in range(11):
                        weight = 1.0 / SPREAD if k == 0 else 0.5 / SPREAD
                        total += weight * (points[k, a] - mean[a]) * (points[k, b] - mean[b])
                    cov[a, b] = total
                    cov[b, a] = total


@njit(cache=True, nogil=True)
def fill_crosses(states: Floats, covariances: Floats, dt: float, crosses: Floats) -> None:
    """Compute covariances (n, 3, 5, 5) of states and predictions, by whose sigma points alone all stay positive."""
    points, root = np.empty((11, 5)), np.empty((5, 5))
    for i in range(states.shape[0]):
        for mode in range(3):
            fill_moved(mode, states[i, mode], covariances[i, mode], dt, root, points)
            for a in range(5):
                for b in range(5):
                    crosses[i, mode, a, b] = 0.0
                    for k in range(a + 1):
                        apart = points[k + 1, b] - points[k + 6, b]
                        crosses[i, mode, a, b] += 0.5 / math.sqrt(SPREAD) * root[a, k] * apart


@njit(cache=True, nogil=True)
def fill_moved(mode: int, state: Floats, covariance: Floats, dt: float, root: Floats, points: Floats) -> None:
    """Compute the Cholesky root (5, 5) of a covariance, and the sigma points (11, 5) moved by ``dt`` [s]."""
    fill_cholesky(covariance, root)
    for k in range(11):
        for a in range(5):
            points[k, a] = state[a]
            if k > 0:
                points[k, a] += (math.sqrt(SPREAD) if k < 6 else -math.sqrt(SPREAD)) * root[a, (k - 1) % 5]
        move(mode, points[k], dt)


@njit(cache=True, nogil=True)
def move(mode: int, state: Floats, dt: float) -> None:
    """Predict one state (5,) by ``dt`` [s], in place; the turn rate becomes 0 except with CTRV."""
    v, heading, turn = state[2], state[3], state[4]
    if mode == CONSTANT_VELOCITY:
        state[0] += v * math.cos(heading) * dt
        state[1] += v * math.sin(heading) * dt
        state[4] = 0.0
    elif mode == RANDOM_MOTION:
        state[2] = 0.0
        state[4] = 0.0
    else:
        after = heading + turn * dt
        if abs(turn) < STRAIGHT_RAD_S:
            middle = heading + 0.5 * turn * dt
            state[0] += v * math.cos(middle) * dt
            state[1] += v * math.sin(middle) * dt
        else:
            state[0] += v / turn * (math.sin(after) - math.sin(heading))
            state[1] += v / turn * (math.cos(heading) - math.cos(after))
        state[3] = after


@njit(cache=True, nogil=True)
def fill_process_noise(mode: int, heading: float, noise: Floats, dt: float, process: Floats) -> None:
    """Compute the process noise of one motion model: white accelerations, random walks of position and heading."""
    process[:] = 0.0
    acceleration, turn, walk, wander, speed = noise[0], noise[1], noise[2], noise[3], noise[4]
    process[3, 3] = wander * wander * dt
    if mode == RANDOM_MOTION:
        process[0, 0] = process[1, 1] = walk * walk * dt
        process[2, 2] = speed * speed
    else:
        # A hundredth of the walk in random motion, for errors of the motion model and of the estimated sensor motion.
        process[0, 0] = process[1, 1] = 0.01 * walk * walk * dt
        push = np.zeros(5)
        push[0] = 0.5 * dt * dt * math.cos(heading)
        push[1] = 0.5 * dt * dt * math.sin(heading)
        push[2] = dt
        for a in range(3):
            for b in range(3):
                process[a, b] += push[a] * push[b] * acceleration * acceleration
    if mode == CTRV:
        process[3, 3] += 0.25 * dt**4 * turn * turn
        process[3, 4] = process[4, 3] = 0.5 * dt**3 * turn * turn
        process[4, 4] = dt * dt * turn * turn
    else:
        process[4, 4] = 0.01 * turn * turn  # turn rate with which a turn begins


@njit(cache=True, nogil=True)
def fill_updates(
    means: Floats,
    predicted: Floats,
    detections: Floats,
    sigmas: Floats,
    beta: Floats,
    states: Floats,
    covariances: Floats,
) -> None:
    """Update each motion model of each track with all detections, weighted by their association (PDA filter).

    The measurement is part of the state, so the unscented cross-covariance and innovation covariance are exactly
    columns and a block of the predicted covariance. Headings are compared modulo pi, and deviations are limited to
    three standard deviations, as in `edgeperc.tracking.jpda.fill_likelihoods`.

    sigmas : (n, 3) standard deviations of a detection along and across its heading [m] and of its heading [rad].
    beta : (n, 3, m + 1) for each motion model, as in `edgeperc.tracking.jpda.fill_association`.
    """
    innovation = np.empty((3, 3))
    inverse = np.empty((3, 3))
    gain = np.empty((5, 3))
    off = np.empty(3)
    for i in range(means.shape[0]):
        for mode in range(3):
            mean, cov = means[i, mode], predicted[i, mode]
            fill_innovation(mean[3], cov, sigmas[i], innovation)
            fill_inverse(innovation, inverse)
            for a in range(5):
                for b in range(3):
                    gain[a, b] = cov[a, 0] * inverse[0, b] + cov[a, 1] * inverse[1, b] + cov[a, 3] * inverse[2, b]
            shift = np.zeros(3)
            spread = np.zeros((3, 3))
            limit = 3.0 * math.sqrt(innovation[2, 2])
            for j in range(detections.shape[0]):
                share = beta[i, mode, j + 1]
                if share == 0.0:
                    continue
                off[0], off[1] = detections[j, 0] - mean[0], detections[j, 1] - mean[1]
                off[2] = min(max(half_turn(detections[j, 2] - mean[3]), -limit), limit)
                for a in range(3):
                    shift[a] += share * off[a]
                    for b in range(a, 3):
                        spread[a, b] += share * off[a] * off[b]
            detected = 1.0 - beta[i, mode, 0]
            for a in range(3):
                for b in range(a, 3):
                    # gain @ (spread - detected * innovation) @ gain.T is the sum of the PDA filter's three terms.
                    spread[a, b] -= shift[a] * shift[b] + detected * innovation[a, b]
                    spread[b, a] = spread[a, b]
            for a in range(5):
                states[i, mode, a] = mean[a] + gain[a, 0] * shift[0] + gain[a, 1] * shift[1] + gain[a, 2] * shift[2]
                for b in range(a + 1):
                    total = cov[a, b]
                    for c in range(3):
                        for d in range(3):
                            total += gain[a, c] * spread[c, d] * gain[b, d]
                    covariances[i, mode, a, b] = total
                    covariances[i, mode, b, a] = total


@njit(cache=True, nogil=True)
def fill_innovation(heading: float, cov: Floats, sigmas: Floats, innovation: Floats) -> None:
    """Compute the innovation covariance (3, 3); the noise of a detection is along and across the heading."""
    cos, sin = math.cos(heading), math.sin(heading)
    along, across, turn = sigmas[0] * sigmas[0], sigmas[1] * sigmas[1], sigmas[2] * sigmas[2]
    innovation[0, 0] = cov[0, 0] + along * cos * cos + across * sin * sin
    innovation[1, 1] = cov[1, 1] + along * sin * sin + across * cos * cos
    innovation[2, 2] = cov[3, 3] + turn
    innovation[0, 1] = innovation[1, 0] = cov[0, 1] + (along - across) * cos * sin
    innovation[0, 2] = innovation[2, 0] = cov[0, 3]
    innovation[1, 2] = innovation[2, 1] = cov[1, 3]


@njit(cache=True, nogil=True)
def fill_inverse(matrix: Floats, inverse: Floats) -> None:
    """Invert a symmetric positive definite (3, 3) matrix into ``inverse``, by cofactors."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    inverse[0, 0] = (d * f - e * e) / determinant
    inverse[1, 1] = (a * f - c * c) / determinant
    inverse[2, 2] = (a * d - b * b) / determinant
    inverse[0, 1] = inverse[1, 0] = (c * e - b * f) / determinant
    inverse[0, 2] = inverse[2, 0] = (b * e - c * d) / determinant
    inverse[1, 2] = inverse[2, 1] = (b * c - a * e) / determinant


@njit(cache=True, nogil=True)
def fill_cholesky(matrix: Floats, root: Floats) -> None:
    """Compute the lower Cholesky root (5, 5); a pivot that is negative by rounding counts as 0."""
    root[:] = 0.0
    for a in range(5):
        for b in range(a + 1):
            total = matrix[a, b]
            for c in range(b):
                total -= root[a, c] * root[b, c]
            if a == b:
                root[a, a] = math.sqrt(max(total, 0.0))
            elif root[b, b] > 0.0:
                root[a, b] = total / root[b, b]


@njit(cache=True, nogil=True)
def half_turn(angle: float) -> float:
    """Angle [rad] modulo pi, in -pi/2..pi/2, because a box looks the same from behind."""
    return angle - math.pi * float(np.floor(angle / math.pi + 0.5))  # math.floor raises on NaN
