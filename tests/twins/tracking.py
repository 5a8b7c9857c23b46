"""Slow twins of the kernels of tracking and of its metrics."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from edgeperc.tracking.lives import EXPECTED, MOST_EXISTENCE, MOST_HIDDEN, TRACK


def moved(mode: Any, state: np.ndarray, dt: float) -> np.ndarray:
    """Twin of `edgeperc.tracking.ukf.move`."""
    x, y, v, heading, turn = state
    if mode == 0:
        return np.array([x + v * math.cos(heading) * dt, y + v * math.sin(heading) * dt, v, heading, 0.0])
    if mode == 2:
        return np.array([x, y, 0.0, heading, 0.0])
    if abs(turn) < 1e-4:
        middle = heading + turn * dt / 2
        x, y = x + v * dt * math.cos(middle), y + v * dt * math.sin(middle)
    else:
        x += v / turn * (math.sin(heading + turn * dt) - math.sin(heading))
        y -= v / turn * (math.cos(heading + turn * dt) - math.cos(heading))
    return np.array([x, y, v, heading + turn * dt, turn])


def process_noise(mode: Any, heading: float, noise: Any, dt: float) -> np.ndarray:
    """Twin of `edgeperc.tracking.ukf.fill_process_noise`."""
    acceleration, turn, walk, wander, speed = noise
    if mode == 2:
        return np.diag([walk**2 * dt, walk**2 * dt, speed**2, wander**2 * dt, 0.01 * turn**2])
    push = np.array([dt**2 / 2 * math.cos(heading), dt**2 / 2 * math.sin(heading), dt, 0, 0])
    swing = np.array([0, 0, 0, dt**2 / 2, dt])
    Q = acceleration**2 * np.outer(push, push) + np.diag([0.01 * walk**2 * dt] * 2 + [0, wander**2 * dt, 0])
    return Q + turn**2 * (np.outer(swing, swing) if mode == 1 else np.diag([0, 0, 0, 0, 0.01]))


def unscented_prediction(
    mode: Any, state: np.ndarray, covariance: np.ndarray, noise: Any, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.tracking.ukf.fill_predictions`, for one motion of one track."""
    root = np.linalg.cholesky(6.0 * covariance)
    points = [state, *(state + root.T), *(state - root.T)]
    weights = np.array([1 / 6] + [1 / 12] * 10)
    points = np.array([moved(mode, point, dt) for point in points])
    mean = weights @ points
    return mean, (points - mean).T @ np.diag(weights) @ (points - mean) + process_noise(mode, state[3], noise, dt)


def innovation(
    mean: np.ndarray, covariance: np.ndarray, sigmas: np.ndarray, detection: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A detection's deviation from a prediction, and its covariance: heading modulo pi, three deviations at most."""
    H = np.eye(5)[[0, 1, 3]]
    cos, sin = math.cos(mean[3]), math.sin(mean[3])
    turned = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    S = H @ covariance @ H.T + turned @ np.diag(np.square(sigmas)) @ turned.T
    off = detection - H @ mean
    off[2] = (off[2] + math.pi / 2) % math.pi - math.pi / 2
    off[2] = np.clip(off[2], -3 * math.sqrt(S[2, 2]), 3 * math.sqrt(S[2, 2]))
    return off, S


def pda_update(
    mean: np.ndarray, covariance: np.ndarray, sigmas: np.ndarray, detections: np.ndarray, beta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.tracking.ukf.fill_updates`, for one motion of one track: the books' PDA filter."""
    _, S = innovation(mean, covariance, sigmas, np.zeros(3))
    offs = [innovation(mean, covariance, sigmas, detection)[0] for detection in detections]
    K = covariance @ np.eye(5)[[0, 1, 3]].T @ np.linalg.inv(S)
    off = sum((b * o for b, o in zip(beta[1:], offs, strict=True)), np.zeros(3))
    spread = sum((b * np.outer(o, o) for b, o in zip(beta[1:], offs, strict=True)), np.zeros((3, 3)))
    updated = covariance - K @ S @ K.T
    total = beta[0] * covariance + (1 - beta[0]) * updated + K @ (spread - np.outer(off, off)) @ K.T
    return mean + K @ off, total


def likelihoods(tracks: Any, gates: Any, detections: Any) -> np.ndarray:
    """Twin of `edgeperc.tracking.jpda.fill_likelihoods`, without the weights."""
    (means, predicted, _), (sigmas, _, groups, limits) = tracks, gates
    out = np.zeros((len(groups), 3, len(detections.places)))
    for i, j in np.ndindex(len(groups), len(detections.places)):
        if groups[i] != detections.groups[j]:
            continue
        inside = False
        for mode in range(3):
            off, S = innovation(means[i, mode], predicted[i, mode], sigmas[i], detections.places[j])
            inside |= bool(off[:2] @ np.linalg.inv(S[:2, :2]) @ off[:2] <= limits[i] ** 2)
            density = math.sqrt((2 * math.pi) ** 3 * np.linalg.det(S))
            out[i, mode, j] = math.exp(-off @ np.linalg.inv(S) @ off / 2) / density
        out[i, :, j] *= inside
    return out


def association(weights: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc.tracking.jpda.fill_association`: every joint event written out."""
    n, m = weights.shape
    beta = np.zeros((n, m + 1))
    for event in itertools.product(range(-1, m), repeat=n):
        taken = [j for j in event if j >= 0]
        if len({*taken}) == len(taken):
            probability = math.prod(1.0 if j < 0 else weights[i, j] for i, j in enumerate(event))
            for i, j in enumerate(event):
                beta[i, j + 1] += probability
    return beta / beta.sum(axis=1, keepdims=True)


def propagation(weights: np.ndarray, rounds: int = 2000) -> np.ndarray:
    """Twin of `edgeperc.tracking.jpda.fill_by_propagation`."""
    to_track = np.ones(weights.shape)
    for _ in range(rounds):
        sent = weights * to_track
        to_detection = weights / (1 + sent.sum(axis=1, keepdims=True) - sent)
        to_track = 1 / (1 + to_detection.sum(axis=0) - to_detection)
    sent = weights * to_track
    total = 1 + sent.sum(axis=1, keepdims=True)
    return np.hstack([1 / total, sent / total])


def interaction(
    states: np.ndarray, covariances: np.ndarray, probabilities: np.ndarray, stay: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Twin of `edgeperc.tracking.imm.fill_interaction`, for one track."""
    k = len(states)
    chain = np.where(np.eye(k, dtype=bool), stay, (1 - stay) / (k - 1))
    prior = probabilities @ chain
    pairs = [combination(states, covariances, chain[:, j] * probabilities / prior[j]) for j in range(k)]
    return np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs]), prior


def combination(
    states: np.ndarray, covariances: np.ndarray, probabilities: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.tracking.imm.fill_combined`, for one track."""
    mean = probabilities @ states
    off = states - mean
    return mean, np.einsum("k,kab->ab", probabilities, covariances + off[:, :, None] * off[:, None, :])


def mode_probabilities(prior: np.ndarray, likelihoods: np.ndarray, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.tracking.imm.fill_mode_probabilities`, for one track: shares and probabilities."""
    mixture = prior @ likelihoods
    joint = np.hstack(
        [(beta[0] * prior)[:, None], beta[1:] * prior[:, None] * likelihoods / np.where(mixture > 0, mixture, 1.0)]
    )
    return joint / joint.sum(axis=1, keepdims=True), joint.sum(axis=1) / joint.sum()


def motion_support(
    landmarks: np.ndarray, detections: np.ndarray, prior: np.ndarray, spread: np.ndarray, motion: np.ndarray
) -> float:
    """Twin of `edgeperc.tracking.egomotion.support`."""
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    turned = detections[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + motion[:2]
    total = -0.5 * ((motion - prior) ** 2 / spread).sum()
    for x, y, variance, group in landmarks:
        r2 = ((turned - [x, y]) ** 2).sum(axis=1) / (variance + detections[:, 2])
        r2 = r2[(detections[:, 3] == group) & ~np.isnan(r2)]
        total -= 0.5 * r2.min() / (1 + r2.min() / 9) if len(r2) else 4.5
    return total


def nearest(landmarks: np.ndarray, detections: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.tracking.egomotion.nearest_detection`, for all landmarks: indices and squared distances."""
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    turned = detections[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + motion[:2]
    squared = ((landmarks[:, None, :2] - turned) ** 2).sum(axis=2) / (landmarks[:, None, 2] + detections[:, 2])
    squared = np.where((landmarks[:, None, 3] == detections[:, 3]) & ~np.isnan(squared), squared, np.inf)
    if len(detections) == 0:
        return np.full(len(landmarks), -1), np.full(len(landmarks), np.inf)
    smallest = squared.min(axis=1)
    return np.where(np.isinf(smallest), -1, squared.argmin(axis=1)), smallest


def fitted_motion(
    landmarks: np.ndarray, detections: np.ndarray, prior: np.ndarray, variances: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Twin of `edgeperc.tracking.egomotion.fit_motion`: motion, covariance and pairs."""
    proposals = [prior]
    cos, sin = math.cos(prior[2]), math.sin(prior[2])
    for landmark, detection in itertools.product(landmarks, detections):
        if landmark[3] != detection[3]:
            continue
        shift = landmark[:2] - prior[:2] - np.array([[cos, -sin], [sin, cos]]) @ detection[:2]
        turn = np.arctan2(landmark[1] - prior[1], landmark[0] - prior[0]) - np.arctan2(*detection[1::-1]) - prior[2]
        turn = np.angle(np.exp(1j * turn))
        if np.hypot(*shift) < 3 * math.sqrt(variances[0] + variances[1]) + 3 * math.sqrt(landmark[2]):
            proposals.append(prior + np.array([*shift, 0.0]))
        if abs(turn) < 3 * math.sqrt(variances[2]):
            proposals.append(prior + np.array([0.0, 0.0, turn]))
    fits = [motion_support(landmarks, detections, prior, variances, motion) for motion in proposals[:257]]
    motion = proposals[int(np.argmax(fits))]
    for _ in range(12):
        which, squared = nearest(landmarks, detections, motion)
        paired = (which >= 0) & (squared <= 25)
        x, y = detections[which[paired], :2].T if paired.any() else np.zeros((2, 0))
        cos, sin = math.cos(motion[2]), math.sin(motion[2])
        turned = np.stack([cos * x - sin * y, sin * x + cos * y])
        off = (landmarks[paired, :2] - motion[:2]).T - turned
        variance = landmarks[paired, 2] + detections[which[paired], 2] if paired.any() else np.zeros(0)
        weight = 1 / (1 + squared[paired] / 9) ** 2 / variance
        slopes = np.array([[[1, 0, -b], [0, 1, a]] for a, b in turned.T]).reshape(-1, 2, 3)
        information = np.diag(1 / variances) + np.einsum("k,kca,kcb->ab", weight, slopes, slopes)
        slope = (prior - motion) / variances + np.einsum("k,kca,ck->a", weight, slopes, off)
        covariance = np.linalg.inv(information)
        change = covariance @ slope
        motion = motion + change
        if np.abs(change).max() < 1e-9:
            break
    return motion, covariance, int(paired.sum())


def hidden(state: np.ndarray, shape: np.ndarray, seen: np.ndarray, sensor: tuple[float, float]) -> np.ndarray:
    """Twin of `edgeperc.tracking.lives.fill_hidden`."""
    off = state[:, :2] - sensor
    azimuth, distance = np.arctan2(off[:, 1], off[:, 0]), np.hypot(off[:, 0], off[:, 1])
    turned = state[:, 3] - azimuth
    half = np.arctan2(np.abs(shape[:, 1] * np.sin(turned)) + np.abs(shape[:, 2] * np.cos(turned)), 2 * distance)
    shares = np.zeros(len(state))
    for i in np.flatnonzero(~seen):
        rays = azimuth[i] + np.linspace(-half[i], half[i], 9)
        before = np.flatnonzero(seen & (distance < distance[i] - 1))
        apart = np.abs(np.angle(np.exp(1j * (rays[:, None] - azimuth[before]))))
        shares[i] = (apart <= half[before]).any(axis=1).mean()
    return shares


def updated_shapes(
    beta: np.ndarray, shapes: np.ndarray, sigmas: Any, walk: np.ndarray, shape: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.tracking.lives.update_shapes`: the new shape and variance."""
    variance = variance + walk**2
    detected = 1 - beta[:, :1]
    gain = variance / (variance + sigmas**2)
    return shape + gain * (beta[:, 1:] @ shapes - detected * shape), variance * (1 - gain * detected)


def updated_fronts(
    state: np.ndarray,
    speed_sigma: np.ndarray,
    moving_mps: float,
    beta: np.ndarray,
    detections: np.ndarray,
    told: np.ndarray,
    fronts: np.ndarray,
) -> np.ndarray:
    """Twin of `edgeperc.tracking.lives.update_fronts`: the new evidence."""
    speed = np.abs(state[:, 2])
    step = 0.5 * np.sign(state[:, 2]) * ((speed > moving_mps) & (speed > 3 * speed_sigma))
    along = np.cos(detections[None, :, 2] - state[:, 3:4])
    headings = (beta[:, 1:] * along).sum(axis=1)
    knew = (beta[:, 1:] * np.where(along > 0, 1, -1) * np.clip(told, -2, 2)).sum(axis=1)
    return np.clip(fronts + np.stack([step, knew, headings], axis=1), [-4, -8, -10], [4, 8, 10])


def lives(
    tracks: np.ndarray, classes: Any, beta: np.ndarray, hidden: np.ndarray, logits: np.ndarray, kinds: Any, dt: float
) -> np.ndarray:
    """Twin of `edgeperc.tracking.lives.update_lives`: the tracks as they are then."""
    tracks = tracks.copy()
    hit = beta[:, 0] < 0.5
    best = np.argmax(beta[hit, 1:], axis=1) if hit.any() else np.zeros(0, int)
    existence = tracks["existence"] + np.log1p(-classes["detection"] * (1 - MOST_HIDDEN * hidden))
    again = np.maximum(tracks["existence"][hit], -classes["sure_logit"][hit])
    existence[hit] = np.minimum(again + np.maximum(logits[best], 0) + EXPECTED, MOST_EXISTENCE)
    tracks["existence"] = existence
    tracks["chances"] += np.where(hit, 1, 1 - MOST_HIDDEN * hidden)
    tracks["age_s"] += dt
    tracks["hits"] += hit
    tracks["misses"] = np.where(hit, 0, tracks["misses"] + 1)
    tracks["missed_s"] = np.where(hit, 0, tracks["missed_s"] + dt)
    tracks["logit_sum"][hit] += logits[best]
    tracks["last_logit"][hit] = logits[best]
    tracks["source"] = -1
    tracks["source"][hit] = best
    weight = tracks["label_weight"][hit] + np.where(tracks["label"][hit] == kinds[best], 1, -1)
    tracks["label"][hit] = np.where(weight < 0, kinds[best], tracks["label"][hit])
    tracks["label_weight"][hit] = np.minimum(np.abs(weight), 20)
    return tracks


def newborn(first_id: int, detections: Any, classes: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc.tracking.lives.fill_newborn`."""
    places, shapes, logits, told, kinds, _, ranges, sources = detections
    tracks = np.zeros(len(kinds), TRACK)
    for track, kind, of, detection, shape, logit, front, distance in zip(
        tracks, kinds, classes, places, shapes, logits, told, ranges, strict=True
    ):
        farther = 1 + distance / of["range_m"]
        turned = np.array(
            [[math.cos(detection[2]), -math.sin(detection[2])], [math.sin(detection[2]), math.cos(detection[2])]]
        )
        spread = np.zeros((5, 5))
        spread[:2, :2] = turned @ np.diag((of["sigmas"][:2] * farther) ** 2) @ turned.T
        spread[[2, 3, 4], [2, 3, 4]] = of["birth"][0] ** 2, (of["sigmas"][2] * farther) ** 2, of["birth"][1] ** 2
        track["label"], track["group"], track["label_weight"] = kind, of["group"], 1
        track["fronts"] = 0, np.clip(front, -2, 2), 1
        track["states"][:, [0, 1, 3]] = detection
        track["covariances"] = spread
        track["covariances"][2, 2, 2] = of["still_mps"] ** 2
        track["modes"] = 1 / 3
        track["state"], track["covariance"] = combination(track["states"], track["covariances"], track["modes"])
        track["shape"], track["shape_variance"] = shape, (of["shape"] * farther) ** 2
        track["logit_sum"], track["last_logit"], track["chances"], track["hits"] = logit, logit, 1, 1
        track["existence"] = min(logit - of["sure_logit"], MOST_EXISTENCE)
    tracks["id"], tracks["source"] = first_id + np.arange(len(tracks)), sources
    return tracks


def in_view(tracks: np.ndarray, pose: np.ndarray, left: float, right: float) -> np.ndarray:
    """Twin of `edgeperc.tracking.lives.mark_out_of_view`, of tracks that were not detected."""
    along = 0.5 * tracks["shape"][:, 1:2] * [1, -1, -1, 1]
    across = 0.5 * tracks["shape"][:, 2:3] * [1, 1, -1, -1]
    corners = (along + 1j * across) * np.exp(1j * tracks["state"][:, 3:4]) + tracks["state"][:, 0:1]
    corners = corners + 1j * tracks["state"][:, 1:2] - (pose[0, 3] + 1j * pose[1, 3])
    azimuth = np.angle(corners / (pose[0, 0] + 1j * pose[1, 0]))
    return ((azimuth <= left) & (azimuth >= right)).all(axis=1)


def rivals(state: np.ndarray, shape: np.ndarray, strength: np.ndarray, reported: np.ndarray) -> list[int]:
    """Twin of `edgeperc.tracking.lives.mark_rivals`: rows of the tracks that stay."""
    kept = []
    for i in sorted(np.flatnonzero(reported), key=lambda i: -strength[i]):
        for j in kept:
            off = state[i, :2] - state[j, :2]
            for k in (i, j):
                ahead = np.array([math.cos(state[k, 3]), math.sin(state[k, 3])])
                aside = np.array([-ahead[1], ahead[0]])
                if abs(off @ ahead) < shape[k, 1] / 2 and abs(off @ aside) < shape[k, 2] / 2:
                    break
            else:
                continue
            break
        else:
            kept.append(i)
    return sorted(kept)


def breaks(truth: np.ndarray, ids: np.ndarray, ignored: np.ndarray, late: np.ndarray) -> tuple[int, Any]:
    """Twin of `edgeperc.evaluation.tracking_metrics.count_breaks`: ID switches and fragments, as KITTI counts them."""
    switches = fragments = 0
    for one in {*truth.tolist()}:
        own, hidden = ids[truth == one].tolist(), ignored[truth == one].tolist()
        if all(hidden):
            continue
        last = own[0]
        for f in range(1, len(own)):
            if hidden[f]:
                last = -1
                continue
            following = own[f + 1] if f + 1 < len(own) else own[f]
            switches += last != own[f] and -1 not in (last, own[f], own[f - 1])
            fragments += own[f - 1] != own[f] and -1 not in (last, own[f], following)
            fragments += late and f == len(own) - 1 and last == -1 and own[f] != -1 and own[f - 1] != own[f]
            last = own[f] if own[f] != -1 else last
    return switches, fragments


def best_gain(gain: np.ndarray) -> float:
    """Twin of `edgeperc.evaluation.tracking_metrics.fill_assignment`: the largest sum, over all assignments."""
    n, m = gain.shape
    padded = np.hstack([gain, np.zeros((n, n))])
    return max(
        (sum(padded[i, j] for i, j in enumerate(event)) for event in itertools.permutations(range(n + m), n)),
        default=0.0,
    )


def retraced(track: Any, later: Any, of: Any, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smoothed state and covariance of one track and its smoothed z, by one step back from those ``later``."""
    means, covariances, prior = interaction(
        track["states"], track["covariances"], track["modes"], math.exp(-dt / of["keep_motion_s"])
    )
    state, covariance = combination(means, covariances, prior)
    ahead = [unscented_prediction(j, means[j], covariances[j], of["noise"], dt) for j in range(3)]
    expected, spread = combination(np.array([a[0] for a in ahead]), np.array([a[1] for a in ahead]), prior)
    cross = np.zeros((5, 5))
    for j in range(3):
        offs = np.linalg.cholesky(6.0 * covariances[j]).T
        apart = [moved(j, means[j] + off, dt) - moved(j, means[j] - off, dt) for off in offs]
        cross += prior[j] * (offs.T @ np.array(apart) / 12 + np.outer(means[j] - state, ahead[j][0] - expected))
    gain = cross @ np.linalg.inv(spread)
    share = track["shape_variance"][0] / (track["shape_variance"][0] + 0.25 * dt)
    z = track["shape"][0] + share * (later["shape"][0] - track["shape"][0])
    off = later["covariance"] - spread
    return state + gain @ (later["state"] - expected), covariance + gain @ off @ gain.T, z
