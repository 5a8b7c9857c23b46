"""Tracking: filters and association against twins, filterpy and enumeration; the life of tracks; the figures."""

from __future__ import annotations

import itertools
import json
import math
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import edgeperc
import twins.tracking
from edgeperc import Box, StampError, Tracker, TrackingError, cli
from edgeperc.evaluation.datasets import scan_hash
from edgeperc.evaluation.tracking import evaluate_kitti, read_sequence, sequence_names, sequence_scans, track_sequence
from edgeperc.evaluation.tracking_metrics import (
    FrameTracks,
    FrameTruth,
    box_iou,
    count_breaks,
    evaluate_tracks,
    fill_assignment,
    fill_pairs,
    recall_thresholds,
)
from edgeperc.perception import Perception
from edgeperc.sensor import get_sensor
from edgeperc.tracking import egomotion, ukf
from edgeperc.tracking.egomotion import fit_motion, nearest_detection, support
from edgeperc.tracking.imm import fill_combined, fill_interaction, fill_mode_probabilities
from edgeperc.tracking.jpda import MAX_EVENTS, fill_association, fill_by_propagation, fill_likelihoods
from edgeperc.tracking.lives import (
    EXPECTED,
    MOST_EXISTENCE,
    MOST_HIDDEN,
    TRACK,
    fill_hidden,
    fill_newborn,
    mark_out_of_view,
    mark_rivals,
    update_lives,
    update_shapes,
)
from edgeperc.tracking.tracks import PARAMETERS
from edgeperc.tracking.ukf import (
    CONSTANT_VELOCITY,
    CTRV,
    fill_cholesky,
    fill_predictions,
    fill_updates,
    half_turn,
)
from edgeperc_bench.peers.tracking import crossing, every_second_beam

NOISE = np.array([2.0, 0.4, 0.3, 0.1, 0.2])
SIGMAS = np.array([0.2, 0.1, 0.08])
STANDING = np.eye(4)  # without poses, the motion of a single object cannot be separated from the sensor's


def rng_of(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def covariances(rng: np.random.Generator, *shape: int) -> np.ndarray:
    roots = rng.normal(0.0, 0.3, (*shape, 5, 5))
    return roots @ np.swapaxes(roots, -1, -2) + 0.01 * np.eye(5)


def some_tracks(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    states = rng.normal(0.0, 1.0, (n, 3, 5)) * [2.0, 2.0, 5.0, 1.0, 0.5]
    states[rng.random((n, 3)) < 0.2, 4] = 0.0
    return states, covariances(rng, n, 3)


def predict(states: np.ndarray, covariance: np.ndarray, noise: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    means, predicted = np.empty_like(states), np.empty_like(covariance)
    fill_predictions(states, covariance, noise, dt, means, predicted)
    return means, predicted


def update(means, predicted, detections, sigmas, beta) -> tuple[np.ndarray, np.ndarray]:
    states, covariance = np.empty_like(means), np.empty_like(predicted)
    fill_updates(means, predicted, detections, sigmas, beta, states, covariance)
    return states, covariance


# --- filters ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 6])
def test_predictions_are_those_of_the_twin(n: int) -> None:
    rng = rng_of(n)
    states, covariance = some_tracks(rng, n)
    noise = np.tile(NOISE, (n, 1))
    for dt in (0.0, 0.1, 1.3):
        means, predicted = predict(states, covariance, noise, dt)
        for i, mode in np.ndindex(n, 3):
            mean, cov = twins.tracking.unscented_prediction(mode, states[i, mode], covariance[i, mode], NOISE, dt)
            np.testing.assert_allclose(means[i, mode], mean, atol=1e-9)
            np.testing.assert_allclose(predicted[i, mode], cov, atol=1e-9)


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 2), (1, 0), (1, 1), (4, 5)])
def test_updates_are_those_of_the_twin(n: int, m: int) -> None:
    rng = rng_of(10 * n + m)
    means, predicted = some_tracks(rng, n)
    detections = rng.normal(0.0, 2.0, (m, 3))
    beta = rng.dirichlet(np.ones(m + 1), (n, 3))
    sigmas = np.tile(SIGMAS, (n, 1))
    states, covariance = update(means, predicted, detections, sigmas, beta)
    for i, mode in np.ndindex(n, 3):
        mean, cov = twins.tracking.pda_update(means[i, mode], predicted[i, mode], SIGMAS, detections, beta[i, mode])
        np.testing.assert_allclose(states[i, mode], mean, atol=1e-9)
        np.testing.assert_allclose(covariance[i, mode], cov, atol=1e-9)


def filterpy_filter(mode: int, state: np.ndarray, covariance: np.ndarray, dt: float):
    """filterpy's unscented filter of one motion; a straight line's is a plain Kalman filter where it is linear."""
    kalman = pytest.importorskip("filterpy.kalman")
    filtered = kalman.UnscentedKalmanFilter(
        dim_x=5,
        dim_z=3,
        dt=dt,
        fx=lambda x, dt: twins.tracking.moved(mode, x, dt),
        hx=lambda x: x[[0, 1, 3]],
        points=kalman.JulierSigmaPoints(5, kappa=1.0),
    )
    filtered.x, filtered.P = state.copy(), covariance.copy()
    return filtered


@pytest.mark.parametrize("mode", [0, 1, 2])
def test_each_motion_filters_as_filterpys(mode: int) -> None:
    """Straight lines, turns and random steps, to 1e-6 over many scans: linear where the heading is certain."""
    rng, dt = rng_of(mode), 0.1
    state, covariance = np.array([3.0, -1.0, 8.0, 0.4, 0.3]), np.diag([0.5, 0.5, 4.0, 0.1, 0.05])
    theirs = filterpy_filter(mode, state, covariance, dt)
    ours, spread = np.tile(state, (1, 3, 1)), np.tile(covariance, (1, 3, 1, 1))
    truth = state.copy()
    for _ in range(10 if numba.config.DISABLE_JIT else 50):
        truth = twins.tracking.moved(CTRV, truth, dt)
        detection = truth[[0, 1, 3]] + rng.normal(0.0, 1.0, 3) * [0.1, 0.1, 0.02]
        theirs.Q = twins.tracking.process_noise(mode, theirs.x[3], NOISE, dt)
        theirs.predict()
        means, predicted = predict(ours, spread, NOISE[None], dt)
        np.testing.assert_allclose(means[0, mode], theirs.x, atol=1e-6)
        np.testing.assert_allclose(predicted[0, mode], theirs.P, atol=1e-6)
        _, S = twins.tracking.innovation(means[0, mode], predicted[0, mode], SIGMAS, detection)
        theirs.update(detection, R=S - predicted[0, mode][np.ix_([0, 1, 3], [0, 1, 3])])
        if abs(detection[2] - means[0, mode, 3]) > 3.0 * math.sqrt(S[2, 2]):
            pytest.fail("the reference is to stay within what is never cut")
        ours, spread = update(means, predicted, detection[None], SIGMAS[None], np.tile([0.0, 1.0], (1, 3, 1)))
        np.testing.assert_allclose(ours[0, mode], theirs.x, atol=1e-6)
        np.testing.assert_allclose(spread[0, mode], theirs.P, atol=1e-6)


def test_a_straight_line_is_filtered_as_by_filterpys_linear_filter() -> None:
    kalman = pytest.importorskip("filterpy.kalman")
    dt = 0.1
    theirs = kalman.KalmanFilter(dim_x=5, dim_z=3)
    theirs.F = np.array([[1, 0, dt, 0, 0], [0, 1, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 0.0]])
    theirs.H = np.eye(5)[[0, 1, 3]]
    theirs.R = np.diag(SIGMAS**2)
    noise = NOISE * [1, 0, 1, 0, 1]  # a heading that is known and stays makes the motion linear
    theirs.x, theirs.P = np.array([0.0, 1.0, 6.0, 0.0, 0.0]), np.diag([1.0, 1.0, 9.0, 0.0, 0.0])
    theirs.Q = twins.tracking.process_noise(CONSTANT_VELOCITY, 0.0, noise, dt)
    ours, spread = np.tile(theirs.x, (1, 3, 1)), np.tile(theirs.P, (1, 3, 1, 1))
    for k in range(60):
        detection = np.array([0.65 * k + 0.1 * math.sin(k), 1.0 + 0.1 * math.cos(k), 0.0])
        theirs.predict()
        theirs.update(detection)
        means, predicted = predict(ours, spread, noise[None], dt)
        ours, spread = update(means, predicted, detection[None], SIGMAS[None], np.tile([0.0, 1.0], (1, 3, 1)))
        np.testing.assert_allclose(ours[0, CONSTANT_VELOCITY], theirs.x, atol=1e-6)
        np.testing.assert_allclose(spread[0, CONSTANT_VELOCITY], theirs.P, atol=1e-6)


def test_all_motions_together_are_filterpys_imm() -> None:
    """Interaction, prediction, mode probabilities and combination, over a drive that turns and stops."""
    kalman = pytest.importorskip("filterpy.kalman")
    rng, dt, stay = rng_of(5), 0.1, 0.95
    state, covariance = np.array([0.0, 0.0, 5.0, 0.1, 0.0]), np.diag([0.1, 0.1, 4.0, 0.05, 0.05])
    filters = [filterpy_filter(mode, state, covariance, dt) for mode in range(3)]
    chain = np.where(np.eye(3, dtype=bool), stay, (1.0 - stay) / 2.0)
    theirs = kalman.IMMEstimator(filters, np.ones(3) / 3.0, chain)
    ours, spread = np.tile(state, (1, 3, 1)), np.tile(covariance, (1, 3, 1, 1))
    modes, prior = np.ones((1, 3)) / 3.0, np.empty((1, 3))
    truth = state.copy()
    for k in range(60):
        truth[4] = 0.4 if 20 <= k < 40 else 0.0
        truth[2] = 5.0 if k < 40 else 0.0
        truth = twins.tracking.moved(CTRV, truth, dt)
        detection = truth[[0, 1, 3]] + rng.normal(0.0, 1.0, 3) * [0.05, 0.05, 0.02]

        mixed, mixed_spread = np.empty_like(ours), np.empty_like(spread)
        fill_interaction(ours, spread, modes, np.array([stay]), mixed, mixed_spread, prior)
        means, predicted = predict(mixed, mixed_spread, NOISE[None], dt)
        gates, likelihoods, weights = np.array([1e3]), np.empty((1, 3, 1)), np.empty((1, 1))
        group = np.zeros(1, np.int64)
        fill_likelihoods(
            means,
            predicted,
            SIGMAS[None],
            prior,
            np.ones(1),
            group,
            detection[None],
            group,
            gates,
            likelihoods,
            weights,
        )
        shares = np.empty((1, 3, 2))
        fill_mode_probabilities(prior, likelihoods, np.array([[0.0, 1.0]]), shares, modes)
        ours, spread = update(means, predicted, detection[None], SIGMAS[None], shares)
        combined, total = np.empty((1, 5)), np.empty((1, 5, 5))
        fill_combined(ours, spread, modes, combined, total)

        # filterpy mixes before its filters predict, and R lies along the predicted heading.
        headings = [sum(w * f.x[3] for w, f in zip(column, filters, strict=True)) for column in theirs.omega.T]
        for mode, one in enumerate(filters):
            one.Q = twins.tracking.process_noise(mode, headings[mode], NOISE, dt)
        theirs.predict()
        for one in filters:
            _, S = twins.tracking.innovation(one.x, one.P, SIGMAS, detection)
            one.R = S - one.P[np.ix_([0, 1, 3], [0, 1, 3])]
        theirs.update(detection)
        np.testing.assert_allclose(modes[0], theirs.mu, atol=1e-6)
        np.testing.assert_allclose(combined[0], theirs.x, atol=1e-6)
        np.testing.assert_allclose(total[0], theirs.P, atol=1e-6)


def test_a_track_that_is_not_finite_leaves_the_others_unchanged() -> None:
    rng = rng_of(9)
    states, covariance = some_tracks(rng, 3)
    states[1, :, 3], covariance[1, 2] = np.nan, np.nan
    means, predicted = predict(states, covariance, np.tile(NOISE, (3, 1)), 0.1)
    detections, beta = rng.normal(0.0, 2.0, (2, 3)), rng.dirichlet(np.ones(3), (3, 3))
    detections[1], beta[:, :, 2] = np.nan, 0.0  # a detection that is nobody's
    updated, spread = update(means, predicted, detections, np.tile(SIGMAS, (3, 1)), beta)
    for i, mode in itertools.product((0, 2), range(3)):
        mean, cov = twins.tracking.unscented_prediction(mode, states[i, mode], covariance[i, mode], NOISE, 0.1)
        np.testing.assert_allclose(means[i, mode], mean, atol=1e-9)
        np.testing.assert_allclose(predicted[i, mode], cov, atol=1e-9)
        mean, cov = twins.tracking.pda_update(mean, cov, SIGMAS, detections[:1], beta[i, mode, :2])
        np.testing.assert_allclose(updated[i, mode], mean, atol=1e-9)
        np.testing.assert_allclose(spread[i, mode], cov, atol=1e-9)
    assert np.isnan(updated[1]).any()


def test_small_matrices_are_those_of_numpy_the_twins_own() -> None:
    rng = rng_of(2)
    for matrix in covariances(rng, 6):
        root, inverse = np.empty((5, 5)), np.empty((3, 3))
        fill_cholesky(matrix, root)
        np.testing.assert_allclose(root, np.linalg.cholesky(matrix), atol=1e-12)
        for invert in (ukf.fill_inverse, egomotion.fill_inverse):
            invert(matrix[:3, :3].copy(), inverse)
            np.testing.assert_allclose(inverse, np.linalg.inv(matrix[:3, :3]), rtol=1e-8, atol=1e-9)
    fill_cholesky(np.diag([4.0, 0.0, -1e-18, 9.0, 1.0]), root)  # directions without variance
    np.testing.assert_array_equal(root, np.diag([2.0, 0.0, 0.0, 3.0, 1.0]))
    for angle in (*rng.uniform(-20.0, 20.0, 20), 0.0, math.pi / 2):
        assert half_turn(angle) == pytest.approx((angle + math.pi / 2) % math.pi - math.pi / 2, abs=1e-12)
    assert math.isnan(half_turn(math.nan))


@pytest.mark.parametrize("n", [0, 1, 5])
def test_the_imm_is_its_twin(n: int) -> None:
    rng = rng_of(n)
    states, spread = some_tracks(rng, n)
    probabilities, stay = rng.dirichlet(np.ones(3), n), rng.uniform(0.5, 1.0, n)
    mixed, mixed_spread, prior = np.empty_like(states), np.empty_like(spread), np.empty((n, 3))
    fill_interaction(states, spread, probabilities, stay, mixed, mixed_spread, prior)
    state, covariance = np.empty((n, 5)), np.empty((n, 5, 5))
    fill_combined(states, spread, probabilities, state, covariance)
    likelihoods = rng.uniform(0.0, 2.0, (n, 3, 4)) * (rng.random((n, 1, 4)) < 0.6)
    beta = rng.dirichlet(np.ones(5), n)
    beta[:, 1:] *= likelihoods.any(axis=1)
    beta /= beta.sum(axis=1, keepdims=True)
    shares, modes = np.empty((n, 3, 5)), np.empty((n, 3))
    fill_mode_probabilities(prior, likelihoods, beta, shares, modes)
    for i in range(n):
        twin = twins.tracking.interaction(states[i], spread[i], probabilities[i], stay[i])
        for got, wanted in zip((mixed[i], mixed_spread[i], prior[i]), twin, strict=True):
            np.testing.assert_allclose(got, wanted, atol=1e-9)
        for got, wanted in zip(
            (state[i], covariance[i]), twins.tracking.combination(states[i], spread[i], probabilities[i]), strict=True
        ):
            np.testing.assert_allclose(got, wanted, atol=1e-9)
        for got, wanted in zip(
            (shares[i], modes[i]), twins.tracking.mode_probabilities(prior[i], likelihoods[i], beta[i]), strict=True
        ):
            np.testing.assert_allclose(got, wanted, atol=1e-9)


# --- association -----------------------------------------------------------------------------------------------------


def associate(weights: np.ndarray, max_events: int = MAX_EVENTS) -> tuple[np.ndarray, int]:
    beta = np.empty((weights.shape[0], weights.shape[1] + 1))
    return beta, fill_association(weights, max_events, beta)


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 3), (3, 0), (1, 1), (5, 6)])
def test_likelihoods_are_those_of_the_twin(n: int, m: int) -> None:
    rng = rng_of(n + 7 * m)
    means, predicted = some_tracks(rng, n)
    means[:, 1:] = means[:, :1] + rng.normal(0.0, 0.2, (n, 2, 5))
    detections = rng.normal(0.0, 2.0, (m, 3))
    groups, theirs = rng.integers(0, 2, n), rng.integers(0, 2, m)
    sigmas, prior, odds = np.tile(SIGMAS, (n, 1)), rng.dirichlet(np.ones(3), n), rng.uniform(1.0, 9.0, n)
    gates, got, weights = np.full(n, 3.0), np.empty((n, 3, m)), np.empty((n, m))
    fill_likelihoods(means, predicted, sigmas, prior, odds, groups, detections, theirs, gates, got, weights)
    wanted = twins.tracking.likelihoods(means, predicted, sigmas, groups, detections, theirs, gates)
    np.testing.assert_allclose(got, wanted, atol=1e-12)
    np.testing.assert_allclose(weights, odds[:, None] * np.einsum("nk,nkm->nm", prior, wanted), atol=1e-12)
    detections[:1] = np.nan  # the tracker never lets it in; it must not spread either way
    fill_likelihoods(means, predicted, sigmas, prior, odds, groups, detections, theirs, gates, got, weights)
    assert not got[:, :, :1].any()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 10**6))
def test_association_is_the_sum_over_all_joint_events(n: int, m: int, seed: int) -> None:
    rng = rng_of(seed)
    weights = np.exp(rng.normal(0.0, 3.0, (n, m))) * (rng.random((n, m)) < 0.7)
    beta, n_approximated = associate(weights)
    assert n_approximated == 0
    np.testing.assert_allclose(beta, twins.tracking.association(weights), rtol=1e-9, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 4), st.integers(1, 4), st.integers(0, 10**6))
def test_belief_propagation_is_its_twin_and_near_the_truth(n: int, m: int, seed: int) -> None:
    rng = rng_of(seed)
    weights = np.exp(rng.normal(0.0, 2.0, (n, m))) * (rng.random((n, m)) < 0.7)
    beta, n_approximated = associate(weights, max_events=0)
    assert n_approximated == n
    np.testing.assert_allclose(beta.sum(axis=1), 1.0, atol=1e-9)
    assert (beta[:, 1:].sum(axis=0) < 1.0 + 1e-5).all()
    twin = twins.tracking.propagation(weights)
    np.testing.assert_allclose(beta, twin, atol=1e-4)
    exact = twins.tracking.association(weights)
    assert np.abs(beta - exact).max() < 0.2
    if (weights > 0).sum() < n + m - len(clusters(weights)) + 1:  # no loop: nothing is approximated
        np.testing.assert_allclose(beta, exact, atol=1e-5)


def clusters(weights: np.ndarray) -> set[frozenset[int]]:
    """Connected parts of the bipartite graph of tracks (counted from 0) and detections (from 100)."""
    parts = [{i} for i in range(weights.shape[0])] + [{100 + j} for j in range(weights.shape[1])]
    for i, j in zip(*np.nonzero(weights), strict=True):
        joined = [part for part in parts if i in part or 100 + j in part]
        parts = [part for part in parts if part not in joined] + [set().union(*joined)]
    return {frozenset(part) for part in parts}


def test_belief_propagation_is_mostly_near() -> None:
    rng, gaps = rng_of(3), []
    for _ in range(100):
        weights = np.exp(rng.normal(1.0, 2.0, (4, 4))) * (rng.random((4, 4)) < 0.6)
        gaps.append(np.abs(associate(weights, 0)[0] - twins.tracking.association(weights)).mean())
    assert np.mean(gaps) < 0.01


def test_clusters_are_solved_apart_and_large_ones_approximated() -> None:
    rng = rng_of(0)
    large = 20 if numba.config.DISABLE_JIT else 200
    alone, pair = slice(large, large + 30), slice(large + 30, large + 32)
    weights = np.zeros((large + 32, large + 32))
    weights[:large, :large] = rng.uniform(0.1, 5.0, (large, large))  # everything could be everything
    np.fill_diagonal(weights[alone, alone], 3.0)
    weights[pair, pair] = [[1.0, 2.0], [0.0, 4.0]]
    beta, n_approximated = associate(weights)
    assert n_approximated == large
    np.testing.assert_allclose(beta.sum(axis=1), 1.0)
    np.testing.assert_allclose(beta[alone, 0], 0.25)
    where = [0, large + 31, large + 32]
    np.testing.assert_allclose(beta[pair][:, where], twins.tracking.association(weights[pair, pair]))


def test_two_certain_pairs_do_not_mix() -> None:
    beta, _ = associate(np.array([[1e15, 1.0], [1.0, 1e15]]))
    np.testing.assert_allclose(beta[:, 1:], np.eye(2), atol=1e-9)
    scratch = np.zeros((2, 3))
    fill_by_propagation(np.array([[1e15, 1.0], [1.0, 1e15]]), np.arange(2), np.arange(2), scratch)
    np.testing.assert_allclose(scratch[:, 1:], np.eye(2), atol=1e-6)


# --- the sensor's own motion -----------------------------------------------------------------------------------------


def some_places(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.column_stack([rng.uniform(-20.0, 20.0, (n, 2)), rng.uniform(0.05, 1.0, n), rng.integers(0, 2, n)])


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 3), (3, 0), (1, 1), (8, 9), (20, 20)])
def test_the_fit_of_the_motion_is_its_twin(n: int, m: int) -> None:
    rng = rng_of(n + 10 * m)
    prior, spread = np.array([0.5, 0.0, 0.02]), np.array([1.0, 0.1, 0.01])
    for strange in (False, True):
        places = some_places(rng, n), some_places(rng, m)
        if strange and m:
            places[1][::3, 0] = np.nan  # the tracker lets none in; it must be nobody's detection
        for _ in range(5):
            motion = prior + rng.normal(0.0, 1.0, 3) * [1.0, 0.3, 0.1]
            wanted = twins.tracking.motion_support(*places, prior, spread, motion)
            assert support(*places, prior, spread, motion) == pytest.approx(wanted)
            which, squared = twins.tracking.nearest(*places, motion)
            for landmark, index, distance in zip(places[0], which, squared, strict=True):
                assert nearest_detection(landmark, places[1], motion) == (index, pytest.approx(distance))
        motion, covariance = np.empty(3), np.empty((3, 3))
        n_pairs = fit_motion(*places, prior, spread, motion, covariance)
        wanted_motion, wanted_covariance, wanted_pairs = twins.tracking.fitted_motion(*places, prior, spread)
        np.testing.assert_allclose(motion, wanted_motion, atol=1e-8)
        np.testing.assert_allclose(covariance, wanted_covariance, rtol=1e-6, atol=1e-12)
        assert n_pairs == wanted_pairs
        if n == 0 or m == 0:
            np.testing.assert_allclose(motion, prior)


def fitted(places: np.ndarray, detections: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, int]:
    marked = [np.column_stack([of, np.full(len(of), 0.02), np.zeros(len(of))]) for of in (places, detections)]
    motion, covariance = np.empty(3), np.empty((3, 3))
    return motion, fit_motion(*marked, np.zeros(3), spread**2, motion, covariance)


def test_the_fit_finds_the_motion_among_objects_that_move() -> None:
    rng = rng_of(4)
    true = np.array([1.7, 0.1, 0.04])
    places = rng.uniform(-30.0, 30.0, (12, 2))
    cos, sin = math.cos(true[2]), math.sin(true[2])
    detections = (places - true[:2]) @ np.array([[cos, -sin], [sin, cos]]) + rng.normal(0.0, 0.02, (12, 2))
    detections[:4] += rng.uniform(1.0, 3.0, (4, 2))  # a third of them drives off
    motion, n_pairs = fitted(places, detections, np.array([1.5, 0.1, 0.03]))
    assert n_pairs >= 8
    assert (np.abs(motion - true) < [0.05, 0.05, 0.004]).all()


def test_one_far_landmark_that_moves_aside_speaks_for_a_turn() -> None:
    turn = 0.08  # moves it by twenty of its standard deviations
    landmark = np.array([[40.0, 10.0]])
    detection = landmark @ np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    motion, n_pairs = fitted(landmark, detection, np.array([0.5, 0.1, 0.05]))
    assert n_pairs == 1
    assert motion[2] == pytest.approx(turn, abs=0.01)
    assert (np.abs(motion[:2]) < 0.3).all()


def drive(n_scans: int, seed: int = 0):
    """A street of parked cars and an oncoming one, seen from a car that pulls off and turns: boxes and poses."""
    rng = rng_of(seed)
    parked = np.column_stack([rng.uniform(5.0, 90.0, 24), rng.choice([-6.0, 6.0, 9.0], 24)])
    x = y = heading = 0.0
    for k in range(n_scans):
        speed, turn = min(10.0, 0.5 * k), 0.15 if 40 <= k < 60 else 0.0
        x, y, heading = x + 0.1 * speed * math.cos(heading), y + 0.1 * speed * math.sin(heading), heading + 0.1 * turn
        pose = np.eye(4)
        pose[:2, :2] = [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
        pose[:2, 3] = x, y
        oncoming = np.array([[120.0 - 1.2 * k, 2.0]])
        there = (np.vstack([parked, oncoming]) - [x, y]) @ pose[:2, :2] + rng.normal(0.0, 0.04, (25, 2))
        seen = np.flatnonzero((np.hypot(*there.T) < 50.0) & (rng.random(25) < 0.95))
        turned = np.where(np.arange(25) == 24, math.pi, 0.0) - heading + rng.normal(0.0, 0.01, 25)
        yield [box("car", *there[j], yaw=turned[j]) for j in seen], pose


def box(label: str, x: float, y: float, *, yaw: float = 0.0, score: float = 0.9, z: float = -0.9) -> Box:
    sizes = {"pedestrian": (0.8, 0.6, 1.7), "cyclist": (1.8, 0.6, 1.7)}
    return Box(label, score, (float(x), float(y), z), sizes.get(label, (4.2, 1.8, 1.5)), float(yaw))


def test_without_poses_the_sensors_motion_is_found() -> None:
    tracker, posed = Tracker(), Tracker()
    for k, (boxes, pose) in enumerate(drive(100)):
        tracks = tracker.update(boxes, 0.1 * k)
        known = posed.update(boxes, 0.1 * k, pose)
    off = tracks.T_world_sensor[:2, 3] - pose[:2, 3]
    assert np.hypot(*off) < 2.0  # of some 90 m driven
    turned = math.atan2(tracks.T_world_sensor[1, 0], tracks.T_world_sensor[0, 0])
    assert abs(turned - math.atan2(pose[1, 0], pose[0, 0])) < 0.03
    assert len(known) > 3
    for track in known:
        assert np.hypot(*track.velocity) < 1.0


def test_with_poses_what_stands_still_stands_still_in_the_world() -> None:
    tracker, paths, speeds = Tracker(), {}, {}
    for k, (boxes, pose) in enumerate(drive(60)):
        for track in tracker.update(boxes, 0.1 * k, pose):
            paths.setdefault(track.id, []).append(track.world_box.center[:2])
            speeds[track.id] = track.state[2]
            x, y, _ = (np.linalg.inv(pose) @ [*track.world_box.center, 1.0])[:3]
            assert track.box.center[:2] == pytest.approx((x, y))
    moved = {name: np.hypot(*(np.array(path[-1]) - path[0])) for name, path in paths.items() if len(path) > 10}
    assert sorted(moved.values())[-2] < 0.4  # all but the oncoming car
    (oncoming,) = [name for name, distance in moved.items() if distance > 5.0]
    assert abs(speeds[oncoming]) == pytest.approx(12.0, abs=0.5)


# --- the life of a track ---------------------------------------------------------------------------------------------


def test_birth_confirmation_coasting_memory_and_death() -> None:
    tracker = Tracker()
    assert len(tracker.update([box("car", 10.0, 0.0, score=0.8)], 0.0, STANDING)) == 0  # one look is not enough
    (track,) = tracker.update([box("car", 10.5, 0.0, score=0.8)], 0.1, STANDING)
    assert (track.id, track.label, track.hits, track.coasting) == (1, "car", 2, False)
    for k in range(2, 12):
        (track,) = tracker.update([box("car", 10.0 + 0.5 * k, 0.0, score=0.8)], 0.1 * k, STANDING)
    assert track.velocity == pytest.approx((5.0, 0.0), abs=0.3)
    assert track.age_s == pytest.approx(1.1)
    for k in range(12, 15):  # overlooked, in plain sight
        (track,) = tracker.update([], 0.1 * k, STANDING)
        assert track.coasting
        assert track.box.center[0] == pytest.approx(10.0 + 0.5 * k, abs=0.3)
    for k in range(15, 18):
        assert len(tracker.update([], 0.1 * k, STANDING)) == 0  # too often to be reported
    (track,) = tracker.update([box("car", 19.0, 0.0, score=0.95)], 1.8, STANDING)
    assert track.id == 1  # but not forgotten
    assert len(tracker.update([], 4.5, STANDING)) == 0
    tracker.update([box("car", 21.0, 0.0)], 4.6, STANDING)
    (track,) = tracker.update([box("car", 21.0, 0.0)], 4.7, STANDING)
    assert track.id == 2


def test_a_hidden_track_is_reported_for_longer() -> None:
    """One pedestrian walks past behind a car for a second; another one is no longer found beside it."""
    tracker = Tracker()
    for k in range(33):
        y = -3.2 + 0.2 * k
        boxes = [box("car", 10.0, 0.0, score=0.99)]
        boxes += [box("pedestrian", 14.0, y, yaw=math.pi / 2)] if abs(y) > 1.2 else []
        boxes += [box("pedestrian", 14.0, 8.0)] if k < 8 else []
        tracks = tracker.update(boxes, 0.1 * k, STANDING)
        walking = [track for track in tracks if track.label == "pedestrian" and track.box.center[1] < 6.0]
        assert len(walking) == (k > 0)
        assert len(tracks) == 1 + (0 if k == 0 else 2 if k < 11 else 1)
    assert walking[0].id == 2
    assert walking[0].box.center[1] == pytest.approx(y, abs=0.2)


def test_a_track_is_worth_more_hidden_than_overlooked() -> None:
    scores = []
    for x in (10.0, 30.0):  # before the pedestrian, and behind
        tracker = Tracker()
        for k in range(12):
            boxes = [box("car", x, 0.0, score=0.99)]
            boxes += [box("pedestrian", 14.0, 0.0)] if k < 9 else []
            tracks = tracker.update(boxes, 0.1 * k, STANDING)
        scores.append(tracks.scores[tracks.labels.index("pedestrian")])
    assert scores[0] > scores[1] + 0.02


def test_a_sure_detection_is_reported_at_once_and_a_doubtful_one_begins_no_track() -> None:
    parameters = {"car": replace(PARAMETERS["car"], birth_score=0.3)}
    tracker = Tracker(parameters)
    tracks = tracker.update([box("car", 10.0, 0.0, score=0.99), box("car", 20.0, 0.0, score=0.2)], 0.0, STANDING)
    assert [track.box.center[0] for track in tracks] == [10.0]
    assert tracks.n_tentative == 0
    assert 0.5 < tracks[0].score < 0.99


def test_the_score_grows_with_every_detection_and_shrinks_without() -> None:
    tracker = Tracker()
    scores = [tracker.update([box("car", 10.0, 0.0, score=0.98)], 0.1 * k, STANDING)[0].score for k in range(10)]
    assert scores == sorted(scores)
    assert tracker.update([], 1.0, STANDING)[0].score < scores[-1]


def test_a_box_seen_from_behind_is_the_same_box() -> None:
    tracker = Tracker()
    for k in range(20):
        tracks = tracker.update([box("car", 10.0 + k, 0.0, yaw=math.pi if k % 3 == 2 else 0.0)], 0.1 * k, STANDING)
    (track,) = tracks
    assert track.box.yaw == pytest.approx(0.0, abs=0.05)
    assert track.velocity == pytest.approx((10.0, 0.0), abs=0.5)
    tracker = Tracker()
    for k in range(20):  # found the wrong way round more often than not, but it drives
        tracks = tracker.update([box("car", 10.0 + k, 0.0, yaw=0.0 if k % 5 < 2 else math.pi)], 0.1 * k, STANDING)
    assert abs(tracks[0].box.yaw) == pytest.approx(0.0, abs=0.1)


def test_labels_of_one_group_share_a_track_and_the_majority_names_it() -> None:
    tracker = Tracker()
    for k in range(9):
        tracks = tracker.update([box("van" if k % 3 else "car", 10.0, 0.0)], 0.1 * k, STANDING)
        assert len(tracks) <= 1
    assert (tracks[0].id, tracks[0].label) == (1, "van")
    tracker = Tracker()
    for k in range(5):
        tracks = tracker.update([box("tram", 10.0, 0.0), box("car", 10.0, 8.0)], 0.1 * k, STANDING)
    assert tracks.labels == ["tram", "car"]


def test_an_object_detected_as_two_classes_is_reported_once() -> None:
    tracker = Tracker()
    for k in range(6):
        boxes = [box("pedestrian", 10.0, 0.0, score=0.8), box("cyclist", 10.1, 0.0, score=0.95)]
        tracks = tracker.update(boxes, 0.1 * k, STANDING)
    assert tracks.labels == ["cyclist"]
    assert tracks.n_tentative == 1


def test_a_track_that_leaves_the_field_of_view_is_no_longer_reported() -> None:
    tracker, all_around = Tracker(field_of_view_deg=(45.0, -45.0)), Tracker()
    for k in range(8):
        boxes = [box("car", 12.0 - k, 9.0)] if k < 5 else []
        seen, reported = tracker.update(boxes, 0.1 * k, STANDING), all_around.update(boxes, 0.1 * k, STANDING)
        assert len(seen) == len(reported) == (k > 0) or k >= 5
    assert len(seen) == 0
    assert len(reported) == 1


def test_crossing_pedestrians_keep_their_identities() -> None:
    tracker, rng, owners = Tracker(), rng_of(2), [set(), set()]
    for k in range(60):
        s = -3.0 + 0.1 * k
        places = np.array([[10.0 + s, s], [10.0 + s, -s]]) + rng.normal(0.0, 0.03, (2, 2))
        hidden = 28 <= k <= 32  # one stands before the other
        boxes = [box("pedestrian", *places[0], yaw=math.pi / 4)]
        boxes += [] if hidden else [box("pedestrian", *places[1], yaw=-math.pi / 4)]
        tracks = tracker.update(boxes, 0.1 * k, STANDING)
        if not 25 <= k <= 35:
            for track in tracks:
                off = np.hypot(*(places - track.box.center[:2]).T)
                assert off.min() < 0.5
                owners[int(off.argmin())].add(track.id)
    assert [len(of) for of in owners] == [1, 1]
    assert owners[0] != owners[1]


def test_two_hundred_crossing_targets_in_clutter() -> None:
    """Half of them overlooked now and then, a hundred false alarms a scan: bounded, and most keep one identity."""
    tracker = Tracker(max_tracks=500)
    owners: list[list[int]] = [[] for _ in range(200)]
    for k, (boxes, places) in enumerate(crossing(40)):
        tracks = tracker.update(boxes, 0.1 * k, STANDING)
        assert len(tracks) + tracks.n_tentative <= 500
        assert np.isfinite(tracks.boxes).all()
        if k > 10:
            off = np.hypot(*(places[:, None] - tracks.boxes[None, :, :2]).transpose(2, 0, 1))
            for j in np.flatnonzero(off.min(axis=1) < 1.0):
                owners[j].append(int(tracks.ids[off[j].argmin()]))
    kept = [max(map(of.count, of)) / 29 for of in owners if of]
    assert np.mean(kept) > 0.8
    assert len(kept) > 190


def test_memory_stays_flat() -> None:
    rng, tracker = rng_of(8), Tracker(max_tracks=64)
    sizes = []
    tracemalloc.start()
    try:
        for k in range(250):
            boxes = [box("car", *rng.uniform(-40.0, 40.0, 2), yaw=rng.uniform(-3.0, 3.0)) for _ in range(12)]
            tracks = tracker.update(boxes, 0.1 * k)
            assert len(tracks) + tracks.n_tentative <= 64
            if k in (100, 249):
                del tracks
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert sizes[1] - sizes[0] < 20_000


# --- errors ----------------------------------------------------------------------------------------------------------

BAD_BOXES = [
    replace(box("car", 10.0, 0.0), center=(math.nan, 0.0, 0.0)),
    replace(box("car", 10.0, 0.0), size=(4.0, math.inf, 1.5)),
    replace(box("car", 10.0, 0.0), size=(4.0, 0.0, 1.5)),
    replace(box("car", 10.0, 0.0), yaw=math.nan),
    replace(box("car", 10.0, 0.0), score=1.5),
    replace(box("car", 10.0, 0.0), score=math.nan),
    "car",
]
MIRRORED = np.diag([1.0, -1.0, 1.0, 1.0])


def same(a: edgeperc.Tracks, b: edgeperc.Tracks) -> bool:
    return a.ids.tolist() == b.ids.tolist() and np.array_equal(a.boxes, b.boxes) and np.array_equal(a.scores, b.scores)


@pytest.mark.parametrize("posed", [False, True])
def test_errors_leave_the_tracker_as_it_was(posed: bool) -> None:
    tracker, untroubled = Tracker(), Tracker()
    for k, (boxes, pose) in enumerate(drive(25)):
        given_pose = pose if posed else None
        reported = tracker.update(boxes, 0.1 * k, given_pose)
        assert same(reported, untroubled.update(boxes, 0.1 * k, given_pose))
        for bad in BAD_BOXES:
            with pytest.raises(TrackingError, match="got"):
                tracker.update([*boxes, bad], 0.1 * k + 0.05, given_pose)  # type: ignore[list-item]
        for stamp_s in (0.1 * k, 0.1 * k - 0.05, -1.0, math.nan, math.inf):
            with pytest.raises(StampError, match="got a scan at"):
                tracker.update(boxes, stamp_s, given_pose)
        with pytest.raises(TrackingError, match="unlike those before"):
            tracker.update(boxes, 0.1 * k + 0.05, None if posed else pose)
    for wrong in (np.eye(3), 2.0 * np.eye(4), MIRRORED, np.full((4, 4), np.nan), "pose"):
        with pytest.raises(TrackingError, match="T_world_sensor"):
            Tracker().update([], 0.0, wrong)


def test_what_comes_out_is_the_callers() -> None:
    tracker, untroubled = Tracker(), Tracker()
    for k, (boxes, _) in enumerate(drive(12)):
        tracks = tracker.update(boxes, 0.1 * k)
        assert same(tracks, untroubled.update(boxes, 0.1 * k))
        tracks.T_world_sensor[:] = tracks.boxes[:] = tracks.ids[:] = 0
        for track in tracks:
            track.state[:] = track.covariance[:] = 0.0


def test_empty_scans_gaps_and_a_new_recording() -> None:
    tracker = Tracker()
    assert len(tracker.update([], 5.0)) == 0
    for k in range(3):
        tracks = tracker.update([box("car", 10.0, 0.0)], 5.1 + 0.1 * k)
    assert len(tracks) == 1
    assert len(tracker.update([], 1e6)) == 0  # days later
    assert len(tracker.update([box("car", 10.0, 0.0, score=0.99)], 1e6 + 1e-6)) == 1
    tracker.reset()
    (track,) = tracker.update([box("car", 10.0, 0.0, score=1.0)], 0.0, np.eye(4))
    assert track.id == 1
    tracker.update([box("car", 10.0, 0.0, score=0.0)], 0.1, np.eye(4))


def test_a_tracker_takes_perceptions() -> None:
    def perception(stamp_s: float | None) -> Perception:
        return Perception(5, 0, None, None, (box("car", 10.0, 0.0),), {}, {}, (), stamp_s)

    tracker = Tracker()
    assert len(tracker(perception(1.0))) == 0
    tracks = tracker(perception(1.1))
    assert tracks[0].label == tracks[-1].label == "car"
    assert [track.id for track in tracks[:1]] == [1]
    assert tracks.stamp_s == 1.1
    assert sum(tracks[0].modes.values()) == pytest.approx(1.0)
    with pytest.raises(StampError, match="no stamp_s"):
        tracker(perception(None))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_any_boxes_at_any_times_make_finite_tracks(seed: int) -> None:
    rng, tracker, stamp_s = rng_of(seed), Tracker(), 0.0
    known: set[int] = set()
    for _ in range(15):
        stamp_s += float(10.0 ** rng.uniform(-6, 1.5))
        n = int(rng.integers(0, 8))
        boxes = [
            Box(
                str(rng.choice(["car", "van", "pedestrian", "cyclist", "dog"])),
                float(rng.random()),
                tuple(10.0 ** rng.uniform(-3, 5) * rng.normal(0.0, 1.0, 3)),
                tuple(10.0 ** rng.uniform(-2, 2, 3)),
                float(rng.uniform(-9.0, 9.0)),
            )
            for _ in range(n)
        ]
        tracks = tracker.update(boxes * int(rng.integers(1, 3)), stamp_s)
        assert np.isfinite(tracks.boxes).all()
        assert (tracks.boxes[:, 3:6] > 0.0).all()
        assert ((tracks.scores >= 0.0) & (tracks.scores <= 1.0)).all()
        assert len({*tracks.ids.tolist()}) == len(tracks)
        for track in tracks:
            assert np.isfinite(track.covariance).all()
            assert (np.linalg.eigvalsh(track.covariance) > -1e-6 * np.trace(track.covariance)).all()
        known |= {*tracks.ids.tolist()}
    assert all(name >= 1 for name in known)


@pytest.mark.parametrize(("n", "m"), [(0, 0), (1, 0), (0, 2), (5, 4), (20, 3)])
def test_shapes_hiding_and_rivals_are_those_of_the_twins(n: int, m: int) -> None:
    rng = rng_of(n + m)
    state, detections = rng.normal(0.0, 1.0, (n, 5)), rng.normal(0.0, 1.0, (m, 3))
    beta, shapes, sigmas = rng.dirichlet(np.ones(m + 1), n), rng.uniform(1, 3, (m, 4)), rng.uniform(0.1, 1, (n, 4))
    shape, variance, front = rng.uniform(1, 3, (n, 4)), rng.uniform(0.1, 1, (n, 4)), rng.uniform(-10, 10, n)
    walk = np.array([0.1, 0.2, 0.3, 0.4])
    wanted = twins.tracking.updated_shapes(state, beta, detections, shapes, sigmas, walk, shape, variance, front)
    update_shapes(state, beta, detections, shapes, sigmas, walk, shape, variance, front)
    for got, want in zip((shape, variance, front), wanted, strict=True):
        np.testing.assert_allclose(got, want)
    seen, sensor, shares = rng.random(n) < 0.7, np.array([3.0, -8.0]), np.empty(n)
    fill_hidden(10.0 * state, shape, seen, sensor, shares)
    np.testing.assert_allclose(shares, twins.tracking.hidden(10.0 * state, shape, seen, sensor))
    strength, reported = rng.permutation(n).astype(float), rng.random(n) < 0.8
    wanted_rows = twins.tracking.rivals(state, shape, strength, reported)
    mark_rivals(state, shape, strength, reported)
    assert np.flatnonzero(reported).tolist() == wanted_rows


@pytest.mark.parametrize(("n", "m"), [(0, 0), (1, 0), (0, 2), (6, 4)])
def test_births_lives_and_views_are_those_of_the_twins(n: int, m: int) -> None:
    rng = rng_of(7 * n + m)
    tracker = Tracker()
    kinds = tracker._kinds(["car", "pedestrian", "cyclist"])[rng.integers(0, 3, n)]
    of = tracker._classes[kinds]
    detections, shapes = rng.normal(0.0, 9.0, (n, 3)), rng.uniform(0.5, 4.0, (n, 4))
    born = kinds, of, detections, shapes, rng.normal(0.0, 3.0, n), rng.uniform(0.0, 60.0, n)
    wanted = twins.tracking.newborn(5, *born, MOST_EXISTENCE, TRACK)
    tracks = np.zeros(n, TRACK)
    fill_newborn(5, *born, tracks)
    assert_same_tracks(tracks, wanted)

    for _ in range(4):
        beta = rng.dirichlet(np.full(m + 1, 0.2), n)
        seen = beta, rng.random(n), rng.normal(0.0, 3.0, m), rng.integers(0, 3, m), 0.1
        wanted = twins.tracking.lives(tracks, of, *seen, MOST_HIDDEN, EXPECTED, MOST_EXISTENCE)
        update_lives(tracks, of, *seen)
        assert_same_tracks(tracks, wanted)

    pose = np.array([[0.8, -0.6, 0, 3.0], [0.6, 0.8, 0, -4.0], [0, 0, 1, 0], [0, 0, 0, 1]])
    reported = rng.random(n) < 0.8
    stays = reported & ((tracks["misses"] == 0) | twins.tracking.in_view(tracks, pose, 0.9, -0.7))
    mark_out_of_view(tracks, pose, 0.9, -0.7, reported)
    assert reported.tolist() == stays.tolist()


def assert_same_tracks(tracks: np.ndarray, wanted: np.ndarray) -> None:
    for name in tracks.dtype.names:
        np.testing.assert_allclose(tracks[name], wanted[name], atol=1e-9, err_msg=name)


# --- the figures -----------------------------------------------------------------------------------------------------


def row(x: float, y: float = 0.0) -> list[float]:
    return [x, y, 0.0, 4.0, 2.0, 1.5, 0.0]


def truth_of(*objects: tuple[int, float], ignored: tuple[int, ...] = ()) -> FrameTruth:
    ids = np.array([name for name, _ in objects], np.int64)
    boxes = np.array([row(x) for _, x in objects]).reshape(-1, 7)
    return FrameTruth(ids, boxes, np.isin(ids, ignored))


def tracks_of(*objects: tuple[int, float], score: float = 0.9, excused: tuple[int, ...] = ()) -> FrameTracks:
    ids = np.array([name for name, _ in objects], np.int64)
    boxes = np.array([row(x) for _, x in objects]).reshape(-1, 7)
    return FrameTracks(ids, boxes, np.full(len(ids), score), np.isin(ids, excused))


def test_box_iou() -> None:
    a = [row(0.0), [0.0, 0.0, 0.75, 4.0, 2.0, 1.5, 0.0], [0.0, 0.0, 0.0, 4.0, 2.0, 1.5, math.pi]]
    iou = box_iou(a, [row(0.0), row(2.0), row(9.0), [math.nan] * 7])
    np.testing.assert_allclose(iou[0], [1.0, 1.0 / 3.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(iou[1, 0], 0.5 / 1.5)
    np.testing.assert_allclose(iou[2], iou[0], atol=1e-9)
    assert box_iou(np.zeros((0, 7)), a).shape == (0, 3)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 10**6))
def test_assignment_gains_the_most(n: int, m: int, seed: int) -> None:
    rng = rng_of(seed)
    gain = rng.random((n, m)) * (rng.random((n, m)) < 0.7)
    column = np.empty(n, np.int64)
    fill_assignment(gain, column)
    made = np.flatnonzero(column >= 0)
    assert len({*column[made].tolist()}) == len(made)
    assert (gain[made, column[made]] > 0.0).all()
    assert gain[made, column[made]].sum() == pytest.approx(twins.tracking.best_gain(gain))
    frames = [gain, gain.T, gain[:1], gain[:, :1]]
    pair = np.empty(sum(len(each) for each in frames), np.int64)
    gains = np.concatenate([each.ravel() for each in frames])
    fill_pairs(np.array([each.shape for each in frames]), gains, pair)
    pairs, begun = iter(pair.tolist()), 0
    for each in frames:
        own = [k for k in itertools.islice(pairs, len(each)) if k >= 0]
        assert all(begun <= k < begun + each.size for k in own)
        assert gains[own].sum() == pytest.approx(twins.tracking.best_gain(each))
        begun += each.size


def test_gains_that_are_not_finite_or_not_positive_make_no_pair() -> None:
    gain = np.array([[np.nan, 0.5], [-1.0, np.nan]])
    column = np.empty(2, np.int64)
    fill_assignment(gain, column)
    assert column.tolist() == [1, -1]
    assert twins.tracking.best_gain(np.maximum(np.nan_to_num(gain), 0.0)) == 0.5


def test_pairs_are_made_within_a_frame() -> None:
    gain = np.array([[0.3, 0.0], [0.9, 0.3], [0.0, 0.2]])
    pair = np.empty(5, np.int64)
    fill_pairs(np.array([[3, 2], [1, 0], [0, 4], [1, 1]]), np.array([*gain.ravel(), 0.5]), pair)
    assert pair.tolist() == [-1, 2, 5, -1, 6]


def test_matches_are_as_many_as_can_be() -> None:
    """The best pair of all would leave the other box and the other track with nothing."""
    truth = truth_of((1, 0.0), (2, 2.0))
    tracks = tracks_of((5, 1.2), (6, 3.9))
    iou = box_iou(truth.boxes, tracks.boxes)
    assert iou[1, 0] > max(iou[0, 0], iou[1, 1]) > 0.25 > iou[0, 1]
    best = evaluate_tracks([([truth] * 3, [tracks] * 3)]).best
    assert (best.n_found, best.n_missed, best.n_false) == (6, 0, 0)
    assert best.motp == pytest.approx((iou[0, 0] + iou[1, 1]) / 2.0)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(-1, 2), st.booleans()), max_size=30))
def test_breaks_are_counted_as_the_twin_does(frames: list[tuple[int, int, bool]]) -> None:
    truth, ids = (np.array([frame[k] for frame in frames], np.int64) for k in (0, 1))
    ignored = np.array([frame[2] for frame in frames], bool)
    assert count_breaks(truth, ids, ignored) == twins.tracking.breaks(truth, ids, ignored)


def test_breaks_by_hand() -> None:
    def count(ids: list[int], ignored: tuple[int, ...] = ()) -> tuple[int, int]:
        hidden = np.isin(np.arange(len(ids)), ignored)
        return count_breaks(np.zeros(len(ids), np.int64), np.array(ids), hidden)

    assert count([1, 1, 1, 1]) == (0, 0)
    assert count([1, 1, 2, 2]) == (1, 1)
    assert count([1, 1, -1, 1, 1]) == (0, 1)  # lost and taken up again
    assert count([1, 1, -1, 2, 2]) == (0, 1)
    assert count([1, 1, -1, -1]) == (0, 0)
    assert count([1, 1, 2, 2], ignored=(1,)) == (0, 0)  # an ignored box makes a new beginning


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-5.0, 5.0), max_size=120), st.integers(0, 40))
def test_recall_thresholds_are_those_of_kittis_walk(scores: list[float], n_missed: int) -> None:
    thresholds, recalls = recall_thresholds(scores, len(scores) + n_missed)
    wanted, wanted_recalls = twins.tracking.thresholds_by_walking(scores, len(scores) + n_missed)
    assert thresholds.tolist() == wanted
    np.testing.assert_allclose(recalls, wanted_recalls)


def test_a_perfect_tracker_has_full_marks() -> None:
    frames = [truth_of((1, k), (2, 20.0 + k)) for k in range(50)]
    tracks = [tracks_of((7, k), (8, 20.0 + k)) for k in range(50)]
    scores = evaluate_tracks([(frames, tracks)])
    assert (scores.best.mota, scores.best.motp, scores.samota) == pytest.approx((1.0, 1.0, 1.0))
    assert (scores.hota.hota, scores.hota.deta, scores.hota.assa) == pytest.approx((1.0, 1.0, 1.0))
    assert (scores.n_frames, scores.n_objects) == (50, 2)
    # At recall r MOTA is r, so its mean over 1/40 .. 1 is 41/80; the first two tracks enter together.
    assert scores.amotp == pytest.approx(1.0)


def test_clear_by_hand() -> None:
    """Missed, false, switched, ignored and excused boxes, counted on paper."""
    truth = [truth_of((1, 0.0), (2, 30.0), (3, 60.0), ignored=(3,)) for _ in range(10)]
    tracks = []
    for k in range(10):
        objects = [(5 if k < 5 else 6, 0.0), (7, 60.0), (8, 90.0), (9, 120.0)]  # switch, ignored, false, excused
        tracks.append(tracks_of(*objects, excused=(9,)))
    scores = evaluate_tracks([(truth, tracks)])
    best = scores.best
    assert (best.n_truth, best.n_found, best.n_false, best.n_missed) == (20, 20, 10, 10)
    assert (best.n_switches, best.n_fragments) == (1, 1)
    assert best.mota == pytest.approx(1.0 - 21.0 / 20.0)
    assert best.motp == pytest.approx(1.0)
    assert best.scaled_mota(0.5) == 0.0
    assert replace(best, n_false=1).scaled_mota(0.5) == pytest.approx(1.0 - (12.0 - 10.0) / 10.0)
    # TP 10, FN 10, FP 10; the object's ten matches fall to two tracks of five frames.
    assert scores.hota.deta == pytest.approx(1.0 / 3.0)
    assert scores.hota.assa == pytest.approx(0.5)
    assert scores.hota.hota == pytest.approx(math.sqrt(0.5 / 3.0))


def test_scores_part_good_tracks_from_bad_ones() -> None:
    truth = [truth_of((1, 0.0)) for _ in range(80)]
    good, bad = [tracks_of((5, 0.0), score=0.9)] * 80, [tracks_of((6, 50.0), score=0.3)] * 80
    both = [
        FrameTracks(*(np.concatenate([getattr(a, f), getattr(b, f)]) for f in ("ids", "boxes", "scores", "excused")))
        for a, b in zip(good, bad, strict=True)
    ]
    scores = evaluate_tracks([(truth, both)])
    assert (scores.best.mota, scores.best.n_false, scores.samota) == pytest.approx((1.0, 0, 1.0))
    assert scores.best.threshold == pytest.approx(0.9)


def test_nothing_at_all_has_no_marks() -> None:
    empty = [truth_of()] * 3, [tracks_of()] * 3
    scores = evaluate_tracks([empty])
    assert math.isnan(scores.best.mota)
    assert math.isnan(scores.hota.hota)
    assert scores.samota == 0.0
    missed = evaluate_tracks([([truth_of((1, 0.0))] * 3, [tracks_of()] * 3)])
    assert (missed.best.mota, missed.best.n_missed, missed.hota.hota) == (0.0, 3, 0.0)
    with pytest.raises(TrackingError, match="got 2 frames"):
        evaluate_tracks([([truth_of()] * 3, [tracks_of()] * 2)])


def test_clear_agrees_with_motmetrics() -> None:
    motmetrics = pytest.importorskip("motmetrics")
    rng = rng_of(1)
    truth, tracks, theirs = [], [], motmetrics.MOTAccumulator(auto_id=True)
    for k in range(60):
        there = [(j, 12.0 * j + 0.2 * k) for j in range(5)]
        found = [(j + 10 * (k > 30 and j == 2), x + rng.normal(0.0, 0.2)) for j, x in there if rng.random() < 0.9]
        found += [(100 + k, -50.0 - 5.0 * k)] if rng.random() < 0.3 else []
        truth.append(truth_of(*there))
        tracks.append(tracks_of(*found))
        distance = 1.0 - box_iou(truth[-1].boxes, tracks[-1].boxes)
        theirs.update(truth[-1].ids, tracks[-1].ids, np.where(distance <= 0.75, distance, np.nan))
    wanted = motmetrics.metrics.create().compute(
        theirs, metrics=["num_false_positives", "num_misses", "num_switches", "motp"], name="all"
    )
    ours = evaluate_tracks([(truth, tracks)]).best
    assert ours.n_false == wanted["num_false_positives"]["all"]
    assert ours.n_missed == wanted["num_misses"]["all"]
    assert wanted["num_switches"]["all"] == 1
    assert ours.motp == pytest.approx(1.0 - wanted["motp"]["all"])


# --- KITTI -----------------------------------------------------------------------------------------------------------

CALIBRATION = """P2: 700.0 0.0 600.0 0.0 0.0 700.0 180.0 0.0 0.0 0.0 1.0 0.0
R0_rect: 1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0
Tr_velo_to_cam: 0.0 -1.0 0.0 0.0 0.0 0.0 -1.0 0.0 1.0 0.0 0.0 0.0
"""


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """A sequence of a car that drives ahead, a van beside it, and a pedestrian whom nobody labeled."""
    for folder in ("calib", "label_02", *(f"detections/pointrcnn_{of}" for of in ("Car", "Pedestrian", "Cyclist"))):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "calib/0000.txt").write_text(CALIBRATION)
    labels, cars, pedestrians = [], [], []
    for k in range(20):
        z = 15.0 + 0.5 * k
        labels += [
            f"{k} 1 Car 0 0 0.0 100 100 300 200 1.5 1.8 4.2 0.0 1.7 {z} -1.57",
            f"{k} 2 Van 0 0 0.0 100 100 300 200 2.0 1.9 5.0 6.0 1.7 {z} -1.57",
            f"{k} -1 DontCare -1 -1 -10 0 100 200 300 -1000 -1000 -1000 -1000 -1000 -1000 -1000",
        ]
        cars.append(f"{k},2,100,100,300,200,5.0,1.5,1.8,4.2,0.0,1.7,{z},-1.57,0.0")
        cars.append(f"{k},2,100,100,300,200,4.0,2.0,1.9,5.0,6.0,1.7,{z},-1.57,0.0")
        pedestrians.append(f"{k},1,100,100,300,200,3.0,1.7,0.6,0.8,-10.0,1.7,14.0,0.0,0.0")
    (tmp_path / "label_02/0000.txt").write_text("\n".join(labels) + "\n")
    (tmp_path / "detections/pointrcnn_Car/0000.txt").write_text("\n".join(cars))
    (tmp_path / "detections/pointrcnn_Pedestrian/0000.txt").write_text("\n".join(pedestrians))
    (tmp_path / "detections/pointrcnn_Cyclist/0000.txt").write_text("")
    return tmp_path


def test_kitti_sequences_are_read_into_the_sensors_frame(kitti: Path) -> None:
    sequence = read_sequence(kitti, "0000")
    assert len(sequence.detections) == 20
    first = sequence.detections[0][0]
    assert first.center == pytest.approx((15.0, 0.0, -0.95))
    assert first.size == (4.2, 1.8, 1.5)
    assert first.yaw == pytest.approx(0.0, abs=1e-3)
    assert first.score == pytest.approx(1.0 / (1.0 + math.exp(-5.0)))
    truth = sequence.truth["car"][0]
    assert truth.ignored.tolist() == [False, True]
    np.testing.assert_allclose(truth.boxes[0, :3], first.center)
    assert len(sequence.truth["pedestrian"][0].ids) == 0


def test_kitti_is_evaluated_by_its_rules(kitti: Path) -> None:
    seen = []
    figures = evaluate_kitti(kitti, on_sequence=lambda done, total: seen.append((done, total)))
    car, pedestrian = figures["classes"]["car"], figures["classes"]["pedestrian"]
    assert (car["best"]["n_truth"], car["best"]["n_false"], car["best"]["n_switches"]) == (20, 0, 0)
    assert car["best"]["mota"] == 1.0
    assert car["hota"]["assa"] > 0.9
    assert pedestrian["best"]["n_false"] == 0  # it stands where nothing was labeled
    assert (seen, figures["sequences"]) == ([(1, 1)], ["0000"])


def test_kitti_errors(kitti: Path, tmp_path: Path) -> None:
    with pytest.raises(TrackingError, match="no label_02"):
        evaluate_kitti(tmp_path / "elsewhere")
    (kitti / "detections/pointrcnn_Car/0000.txt").write_text("0,2,100\n")
    with pytest.raises(TrackingError, match="15 comma-separated"):
        read_sequence(kitti, "0000")
    (kitti / "label_02/0000.txt").write_text("0 1 Car\n")
    with pytest.raises(TrackingError, match="17 columns"):
        read_sequence(kitti, "0000")


def test_eval_tracking_prints_the_tables(kitti: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["eval-tracking", str(kitti), "--json", str(kitti / "out/figures.json")]
    assert cli.main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("1 sequence, given detections, 3-D IoU 0.25;")
    words = [line.split() for line in lines]
    assert ["car", "100.0"] in [line[:1] + line[4:5] for line in words if len(line) > 8]
    assert any(line[:7] == ["sAMOTA", "AMOTA", "AMOTP", "MOTA", "MOTP", "HOTA", "DetA"] for line in words)
    figures = json.loads((kitti / "out/figures.json").read_text())
    assert figures["classes"]["cyclist"]["best"]["mota"] is None
    assert figures["command"].startswith("edgeperc eval-tracking")
    assert cli.main(["eval-tracking", str(kitti / "calib")]) == 2
    assert "no label_02" in capsys.readouterr().err


def test_a_models_boxes_are_evaluated(kitti: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What run --json prints takes the place of the detections, which need not be there."""
    detections = read_sequence(kitti, "0000").detections
    lines = [{"scan": "x", "boxes": [replace(one, label="van").to_dict() for one in of]} for of in detections]
    for of in ("Car", "Pedestrian", "Cyclist"):
        (kitti / f"detections/pointrcnn_{of}/0000.txt").unlink()
    boxes = kitti / "boxes.jsonl"
    boxes.write_text("\n".join(map(json.dumps, lines)))
    arguments = [
        "eval-tracking",
        str(kitti),
        "--sequences",
        "0000",
        "--boxes",
        str(boxes),
        "--classes",
        "vehicle",
        "car",
    ]
    assert cli.main([*arguments, "--json", str(kitti / "figures.json")]) == 0
    figures = json.loads((kitti / "figures.json").read_text())["classes"]
    assert figures["vehicle"]["best"]["mota"] > 0.9  # the car and the van
    assert figures["vehicle"]["best"]["n_truth"] == 40
    assert figures["car"]["best"]["n_missed"] == 20  # all were labeled as vans
    boxes.write_text("\n".join(map(json.dumps, lines[:-1])))
    assert cli.main(arguments) == 2
    assert "19 frames for 20" in capsys.readouterr().err
    boxes.write_text('{"scan": "x"}')
    assert cli.main(arguments) == 2
    assert "holds no boxes" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        cli.main([*arguments[:2], "--boxes", str(boxes)])


@pytest.fixture
def drive_root(kitti: Path, tmp_path: Path) -> Path:
    """The same sequence as an object set with track ids: a label and a scan a frame, of two drives."""
    root = tmp_path / "objects"
    for folder in ("label_2", "track_id", "calib", "velodyne"):
        (root / "training" / folder).mkdir(parents=True)
    by_frame: dict[int, list[list[str]]] = {}
    for line in (kitti / "label_02/0000.txt").read_text().splitlines():
        words = line.split()
        by_frame.setdefault(int(words[0]), []).append(words)
    rows = ["name,drive"]
    for k, labels in by_frame.items():
        name = f"{100 + k:06}"
        rows.append(f"{name},my_drive")
        (root / f"training/label_2/{name}.txt").write_text("".join(" ".join(words[2:]) + "\n" for words in labels))
        (root / f"training/track_id/{name}.txt").write_text("".join(words[1] + "\n" for words in labels))
        (root / f"training/calib/{name}.txt").write_text(CALIBRATION)
        (root / f"training/velodyne/{name}.bin").write_bytes(np.full((3, 4), 0.5 + k, np.float32).tobytes())
    (root / "frames.csv").write_text("\n".join([*rows, "000000,unlabeled_drive"]) + "\n")
    return root


def test_an_object_set_with_track_ids_is_the_same_sequence(kitti: Path, drive_root: Path) -> None:
    assert sequence_names(drive_root) == ["my_drive"]
    scans = sequence_scans(drive_root, "my_drive")
    assert [path.stem for path in scans.values()] == [f"{100 + k:06}" for k in range(20)]
    given = read_sequence(kitti, "0000")
    same = read_sequence(drive_root, "my_drive", boxes=given.detections)
    for of in ("car", "pedestrian"):
        for a, b in zip(given.truth[of], same.truth[of], strict=True):
            np.testing.assert_array_equal(a.ids, b.ids)
            np.testing.assert_array_equal(a.boxes, b.boxes)
            np.testing.assert_array_equal(a.ignored, b.ignored)
    (drive_root / "training/track_id/000103.txt").write_text("1\n")
    with pytest.raises(TrackingError, match="3 labels, and 1 track ids"):
        read_sequence(drive_root, "my_drive", boxes=given.detections)


def test_a_drive_is_perceived_and_tracked(
    kitti: Path, drive_root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From scans to the table in one command; a scan that a model was trained on is refused."""
    found = read_sequence(kitti, "0000").detections
    card = SimpleNamespace(name="seer", version="1.0", training={})

    def perceive(points: np.ndarray) -> SimpleNamespace:
        return SimpleNamespace(boxes=found[int(points[0, 0])])

    perceive.cards = (card,)
    monkeypatch.setattr("edgeperc.cli.eval_tracking.make_perceiver", lambda *_, **__: perceive)
    arguments = ["eval-tracking", str(drive_root), "--classes", "car", "--json", str(drive_root / "f.json")]
    assert cli.main(arguments) == 0
    assert "1 sequence, boxes of seer 1.0" in capsys.readouterr().out
    best = json.loads((drive_root / "f.json").read_text())["classes"]["car"]["best"]
    assert (best["n_truth"], best["n_missed"], best["n_false"]) == (20, 0, 0)

    # Beside KITTI's own sequences, --model takes the place of the detections that are there.
    assert cli.main(["eval-tracking", str(kitti), "--model", "seer"]) == 2
    assert "no scans of 0000" in capsys.readouterr().err
    (kitti / "velodyne/0000").mkdir(parents=True)
    for k, path in sequence_scans(drive_root, "my_drive").items():
        (kitti / f"velodyne/0000/{k:06}.bin").write_bytes(path.read_bytes())
    (kitti / "velodyne/0000/000003.bin").unlink()  # as in KITTI's sequence 0001
    assert cli.main(["eval-tracking", str(kitti), "--model", "seer", "--classes", "car"]) == 0

    card.training = {"frames": {"x": scan_hash(np.full((3, 4), 4.5, np.float32))}}
    assert cli.main(arguments) == 2
    assert "seer 1.0 was trained on scan 000104" in capsys.readouterr().err


def test_a_coarser_sensors_drive_has_every_second_beam(drive_root: Path, tmp_path: Path) -> None:
    turn = np.radians(np.arange(0.5, 360.0, 30.0))
    beams = [np.column_stack([9.0 * np.cos(turn), 9.0 * np.sin(turn), 0 * turn - k, 0 * turn + 0.5]) for k in range(5)]
    for path in sequence_scans(drive_root, "my_drive").values():
        np.concatenate(beams).astype(np.float32).tofile(path)
    every_second_beam(drive_root, tmp_path / "coarse")
    scans = sequence_scans(tmp_path / "coarse", "my_drive")
    assert len(scans) == 20
    points = np.fromfile(scans[7], np.float32).reshape(-1, 4)
    assert points[:, 2].tolist() == [0.0] * 12 + [-2.0] * 12 + [-4.0] * 12
    assert (points[:, 3] == 63.75).all()
    sensor = get_sensor(tmp_path / "coarse/sensor.json")
    assert (len(sensor.elevations_deg), sensor.remission_range) == (32, (0.0, 255.0))


def test_real_sequences_are_tracked_well(data_root) -> None:
    """Sequence 0004 with PointRCNN's detections; the figures of the whole set are in the documents."""
    figures = evaluate_kitti(data_root("tracking"), sequences=["0004"])["classes"]["car"]
    assert figures["best"]["mota"] > 0.85
    assert figures["best"]["n_switches"] == 0
    assert figures["hota"]["hota"] > 0.6


# --- pictures and the command line -----------------------------------------------------------------------------------


def test_tracks_are_animated(kitti: Path, tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    from edgeperc.view.tracks import draw_tracks

    tracks, _ = track_sequence(read_sequence(kitti, "0000"))
    content = draw_tracks(tracks, tmp_path / "tracks.gif", title="a drive")
    assert (tmp_path / "tracks.gif").read_bytes() == content
    with image.open(tmp_path / "tracks.gif") as animation:
        assert animation.n_frames == 20
        first = np.asarray(animation.convert("RGB")).copy()
        animation.seek(19)
        assert (np.asarray(animation.convert("RGB")) != first).any()
        assert animation.info["duration"] == 1000
    for few in ([], tracks[:1]):
        with pytest.raises(TrackingError, match="two or more"):
            draw_tracks(few, tmp_path / "none.gif")
    assert not (tmp_path / "none.gif").exists()
