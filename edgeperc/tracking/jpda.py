"""Joint probabilistic data association of detections with tracks (KUL-Seg 6).

Tracks that share detections form a cluster, and each cluster is solved separately. A cluster with few joint events is
solved exactly, by enumeration. A larger one is approximated by loopy belief propagation, which bounds the time of a
scan (Williams and Lau, "Approximate evaluation of marginal association probabilities with belief propagation", IEEE
Trans. AES 2014).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..system.kernels import njit
from ..types.points import Floats, Ints64

MAX_EVENTS = 4096
MAX_ROUNDS = 200
TOLERANCE = 1e-6
LARGEST_WEIGHT = 1e15  # keeps the products of a cluster finite


class Predictions(NamedTuple):
    """Tracks as they are expected at the time of a scan."""

    means: Floats  # (n, 3, 5); x, y [m], v [m/s], heading [rad], turn rate [rad/s] by motion model
    covariances: Floats  # (n, 3, 5, 5)
    prior: Floats  # (n, 3), probability of each motion model


class Gates(NamedTuple):
    """Which detections may belong to each track."""

    sigmas: Floats  # (n, 3), along and across the heading of a detection [m] and of its heading [rad]
    odds: Floats  # (n,), P_D / ((1 - P_D) lambda) [m2 rad]: probability of detection, density of clutter
    groups: Ints64  # (n,), classes that may be confused; detections of other groups are never associated
    limits: Floats  # (n,), largest Mahalanobis distance of a position from the nearest motion model


class Detections(NamedTuple):
    """The boxes of one scan."""

    places: Floats  # (m, 3); x, y [m], heading [rad] in the frame of the tracks
    shapes: Floats  # (m, 4); height of the center, length, width, height [m]
    logits: Floats  # (m,), log odds of the scores
    fronts: Floats  # (m,), log odds that the heading points to the front; 0 if that is unknown
    kinds: Ints64  # (m,), class
    groups: Ints64  # (m,), group of classes
    ranges: Floats  # (m,), distance from the sensor [m]
    sources: Ints64  # (m,), index in the scan


@njit(cache=True, nogil=True)
def fill_likelihoods(
    tracks: Predictions, gates: Gates, detections: Detections, likelihoods: Floats, weights: Floats
) -> None:
    """Compute the likelihood of each detection under each motion model of each track (n, 3, m) [1/(m2 rad)], 0 outside
    the gate, and the association weights odds_t sum_k prior_tk L_tkj.

    Headings are compared modulo pi, because a box looks the same from behind. Detectors are sometimes wrong by 90
    degrees, so deviations are limited to three standard deviations.
    """
    means, predicted, prior = tracks
    sigmas, odds, groups, limits = gates
    places = detections.places
    n, m = len(groups), len(places)
    likelihoods[:] = 0.0
    weights[:] = 0.0
    # For each motion model: covariance of the position, regression of the heading on the position, variance, limit and
    # norm. Computed once: most pairs are outside the gate and need no sine, root or exponential.
    forms = np.empty((3, 9))
    for i in range(n):
        gate, reach, apart = limits[i], 0.0, 0.0
        for mode in range(3):
            mean, cov, form = means[i, mode], predicted[i, mode], forms[mode]
            cos, sin = math.cos(mean[3]), math.sin(mean[3])
            along, across = sigmas[i, 0] * sigmas[i, 0], sigmas[i, 1] * sigmas[i, 1]
            a = cov[0, 0] + along * cos * cos + across * sin * sin
            b = cov[0, 1] + (along - across) * cos * sin
            d = cov[1, 1] + along * sin * sin + across * cos * cos
            c, e = cov[0, 3], cov[1, 3]
            f = cov[3, 3] + sigmas[i, 2] * sigmas[i, 2]
            place = a * d - b * b
            # Mean and variance of the heading, given the position.
            pull_x = (c * d - e * b) / place
            pull_y = (e * a - c * b) / place
            left = f - pull_x * c - pull_y * e
            form[0], form[1], form[2], form[3] = a, b, d, place
            form[4], form[5], form[6], form[7] = pull_x, pull_y, left, 3.0 * math.sqrt(f)
            form[8] = 1.0 / math.sqrt((2.0 * math.pi) ** 3 * place * left)
            reach = max(reach, a + d)
            apart = max(apart, math.hypot(mean[0] - means[i, 0, 0], mean[1] - means[i, 0, 1]))
        reach = (gate * math.sqrt(reach) + apart) ** 2
        for j in range(m):
            dx = places[j, 0] - means[i, 0, 0]
            dy = places[j, 1] - means[i, 0, 1]
            if groups[i] != detections.groups[j] or dx * dx + dy * dy > reach:
                continue
            inside = False
            for mode in range(3):
                a, b, d, place = forms[mode, 0], forms[mode, 1], forms[mode, 2], forms[mode, 3]
                dx = places[j, 0] - means[i, mode, 0]
                dy = places[j, 1] - means[i, mode, 1]
                inside = inside or d * dx * dx - 2.0 * b * dx * dy + a * dy * dy <= gate * gate * place
            if not inside:
                continue
            for mode in range(3):
                a, b, d, place = forms[mode, 0], forms[mode, 1], forms[mode, 2], forms[mode, 3]
                dx = places[j, 0] - means[i, mode, 0]
                dy = places[j, 1] - means[i, mode, 1]
                squared = (d * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / place
                limit = forms[mode, 7]
                turn = places[j, 2] - means[i, mode, 3]
                turn -= math.pi * np.floor(turn / math.pi + 0.5)  # math.floor raises on NaN
                turn = min(max(turn, -limit), limit) - forms[mode, 4] * dx - forms[mode, 5] * dy
                squared += turn * turn / forms[mode, 6]
                likelihoods[i, mode, j] = math.exp(-0.5 * squared) * forms[mode, 8]
                weights[i, j] += odds[i] * prior[i, mode] * likelihoods[i, mode, j]
            weights[i, j] = min(weights[i, j], LARGEST_WEIGHT)


@njit(cache=True, nogil=True)
def fill_association(weights: Floats, max_events: int, beta: Floats) -> int:
    """Compute the marginal association probabilities; returns how many tracks were solved by belief propagation.

    A joint event assigns at most one detection to each track and at most one track to each detection. Its probability
    is proportional to the product of the weights of its pairs.

    weights : (n, m) likelihood ratio of "the detection belongs to the track" to "the track was missed and the detection
        is clutter"; 0 outside the gate.
    max_events : clusters with a higher bound on the number of joint events are solved by belief propagation.
    beta : (n, m + 1) column 0: probability that the track was not detected. Others: that the detection belongs to it.
        Rows sum to 1.
    """
    n, m = weights.shape
    beta[:] = 0.0
    done = np.zeros(n, np.bool_)
    taken = np.zeros(m, np.bool_)
    rows = np.empty(n, np.int64)
    columns = np.empty(m, np.int64)
    n_approximated = 0
    for first in range(n):
        if done[first]:
            continue
        # The cluster: all tracks and detections that gated pairs connect with this track.
        done[first] = True
        rows[0] = first
        n_rows, n_columns, at = 1, 0, 0
        events = 1.0
        while at < n_rows:
            choices = 1.0
            for j in range(m):
                if weights[rows[at], j] <= 0.0:
                    continue
                choices += 1.0
                if not taken[j]:
                    taken[j] = True
                    columns[n_columns] = j
                    n_columns += 1
                    for i in range(n):
                        if not done[i] and weights[i, j] > 0.0:
                            done[i] = True
                            rows[n_rows] = i
                            n_rows += 1
            events *= choices
            at += 1
        if events <= max_events:
            fill_by_events(weights, rows[:n_rows], columns[:n_columns], beta)
        else:
            n_approximated += n_rows
            fill_by_propagation(weights, rows[:n_rows], columns[:n_columns], beta)
    return n_approximated


@njit(cache=True, nogil=True)
def fill_by_events(weights: Floats, rows: Ints64, columns: Ints64, beta: Floats) -> None:
    """Solve one cluster of tracks (rows) and detections (columns) exactly: enumerate its joint events, depth first."""
    n = len(rows)
    choice = np.full(n, -2, np.int64)  # -2: not begun; -1: missed; else an index into columns
    used = np.zeros(len(columns), np.bool_)
    product = np.ones(n + 1)
    total = 0.0
    depth = 0
    while depth >= 0:
        i = rows[depth]
        if choice[depth] >= 0:
            used[choice[depth]] = False
        choice[depth] += 1
        while choice[depth] >= 0 and choice[depth] < len(columns):
            if not used[choice[depth]] and weights[i, columns[choice[depth]]] > 0.0:
                break
            choice[depth] += 1
        if choice[depth] == len(columns):
            choice[depth] = -2
            depth -= 1
            continue
        product[depth + 1] = product[depth]
        if choice[depth] >= 0:
            used[choice[depth]] = True
            product[depth + 1] *= weights[i, columns[choice[depth]]]
        if depth < n - 1:
            depth += 1
            continue
        total += product[n]
        for k in range(n):
            column = columns[choice[k]] + 1 if choice[k] >= 0 else 0
            beta[rows[k], column] += product[n]
    for k in range(n):
        for column in range(beta.shape[1]):
            beta[rows[k], column] /= total


@njit(cache=True, nogil=True)
def fill_by_propagation(weights: Floats, rows: Ints64, columns: Ints64, beta: Floats) -> None:
    """Approximate the marginals of one cluster by messages between tracks and detections.

    Messages: mu_ij = w_ij / (1 + sum_j' w_ij' nu_j'i) over the other detections j', and nu_ji = 1 / (1 + sum_i' mu_i'j)
    over the other tracks i'. Rounds end when no nu changes by more than 1e-6, or after 200. beta_ij is proportional to
    w_ij nu_ji.
    """
    # Only gated pairs, which are few in a large cluster.
    n_pairs = 0
    for i in range(len(rows)):
        for j in range(len(columns)):
            n_pairs += weights[rows[i], columns[j]] > 0.0
    row, column = np.empty(n_pairs, np.int64), np.empty(n_pairs, np.int64)
    n_pairs = 0
    for i in rows:
        for j in columns:
            if weights[i, j] > 0.0:
                row[n_pairs], column[n_pairs] = i, j
                n_pairs += 1
    to_track, to_detection = np.ones(n_pairs), np.empty(n_pairs)
    of_row, of_column = np.empty(weights.shape[0]), np.empty(weights.shape[1])
    for _ in range(MAX_ROUNDS):
        of_row[:] = 1.0
        for k in range(n_pairs):
            of_row[row[k]] += weights[row[k], column[k]] * to_track[k]
        of_column[:] = 1.0
        for k in range(n_pairs):
            weight = weights[row[k], column[k]]
            to_detection[k] = weight / max(of_row[row[k]] - weight * to_track[k], 1.0)
            of_column[column[k]] += to_detection[k]
        change = 0.0
        for k in range(n_pairs):
            message = 1.0 / max(of_column[column[k]] - to_detection[k], 1.0)
            change = max(change, abs(message - to_track[k]))
            to_track[k] = message
        if change < TOLERANCE:
            break
    of_row[:] = 1.0
    for k in range(n_pairs):
        of_row[row[k]] += weights[row[k], column[k]] * to_track[k]
    for i in rows:
        beta[i, 0] = 1.0 / of_row[i]
    for k in range(n_pairs):
        beta[row[k], column[k] + 1] = weights[row[k], column[k]] * to_track[k] / of_row[row[k]]
