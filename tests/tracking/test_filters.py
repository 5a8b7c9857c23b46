"""Filters and association of tracks against twins, filterpy and enumeration."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import twins.tracking
from edgeperc.tracking import jpda, ukf
from edgeperc.tracking.imm import fill_combined, fill_interaction, fill_mode_probabilities

NOISE = np.array([2.0, 0.4, 0.3, 0.1, 0.2])


SIGMAS = np.array([0.2, 0.1, 0.08])


def covariances(rng: np.random.Generator, *shape: int) -> np.ndarray:
    roots = rng.normal(0.0, 0.3, (*shape, 5, 5))
    return roots @ np.swapaxes(roots, -1, -2) + 0.01 * np.eye(5)


def some_tracks(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    states = rng.normal(0.0, 1.0, (n, 3, 5)) * [2.0, 2.0, 5.0, 1.0, 0.5]
    states[rng.random((n, 3)) < 0.2, 4] = 0.0
    return states, covariances(rng, n, 3)


def predict(states: np.ndarray, covariance: np.ndarray, noise: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    means, predicted = np.empty_like(states), np.empty_like(covariance)
    ukf.fill_predictions(states, covariance, noise, dt, means, predicted)
    return means, predicted


def update(
    means: np.ndarray, predicted: np.ndarray, detections: np.ndarray, sigmas: Any, beta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    states, covariance = np.empty_like(means), np.empty_like(predicted)
    ukf.fill_updates(means, predicted, detections, sigmas, beta, states, covariance)
    return states, covariance


@pytest.mark.parametrize("n", [0, 1, 6])
def test_predictions_are_those_of_the_twin(n: int) -> None:
    states, covariance = some_tracks(np.random.default_rng(n), n)
    noise = np.tile(NOISE, (n, 1))
    for dt in (0.0, 0.1, 1.3):
        means, predicted = predict(states, covariance, noise, dt)
        for i, mode in np.ndindex(n, 3):
            mean, cov = twins.tracking.unscented_prediction(mode, states[i, mode], covariance[i, mode], NOISE, dt)
            np.testing.assert_allclose(means[i, mode], mean, atol=1e-9)
            np.testing.assert_allclose(predicted[i, mode], cov, atol=1e-9)


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 2), (1, 0), (1, 1), (4, 5)])
def test_updates_are_those_of_the_twin(n: int, m: int) -> None:
    rng = np.random.default_rng(10 * n + m)
    means, predicted = some_tracks(rng, n)
    detections = rng.normal(0.0, 2.0, (m, 3))
    beta = rng.dirichlet(np.ones(m + 1), (n, 3))
    sigmas = np.tile(SIGMAS, (n, 1))
    states, covariance = update(means, predicted, detections, sigmas, beta)
    for i, mode in np.ndindex(n, 3):
        mean, cov = twins.tracking.pda_update(means[i, mode], predicted[i, mode], SIGMAS, detections, beta[i, mode])
        np.testing.assert_allclose(states[i, mode], mean, atol=1e-9)
        np.testing.assert_allclose(covariance[i, mode], cov, atol=1e-9)


def filterpy_filter(mode: int, state: np.ndarray, covariance: np.ndarray, dt: float) -> Any:
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
    rng, dt = np.random.default_rng(mode), 0.1
    state, covariance = np.array([3.0, -1.0, 8.0, 0.4, 0.3]), np.diag([0.5, 0.5, 4.0, 0.1, 0.05])
    theirs = filterpy_filter(mode, state, covariance, dt)
    ours, spread = np.tile(state, (1, 3, 1)), np.tile(covariance, (1, 3, 1, 1))
    truth = state.copy()
    for _ in range(10 if numba.config.DISABLE_JIT else 50):
        truth = twins.tracking.moved(ukf.CTRV, truth, dt)
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
    theirs.Q = twins.tracking.process_noise(ukf.CONSTANT_VELOCITY, 0.0, noise, dt)
    ours, spread = np.tile(theirs.x, (1, 3, 1)), np.tile(theirs.P, (1, 3, 1, 1))
    for k in range(60):
        detection = np.array([0.65 * k + 0.1 * math.sin(k), 1.0 + 0.1 * math.cos(k), 0.0])
        theirs.predict()
        theirs.update(detection)
        means, predicted = predict(ours, spread, noise[None], dt)
        ours, spread = update(means, predicted, detection[None], SIGMAS[None], np.tile([0.0, 1.0], (1, 3, 1)))
        np.testing.assert_allclose(ours[0, ukf.CONSTANT_VELOCITY], theirs.x, atol=1e-6)
        np.testing.assert_allclose(spread[0, ukf.CONSTANT_VELOCITY], theirs.P, atol=1e-6)


def test_all_motions_together_are_filterpys_imm() -> None:
    """Interaction, prediction, mode probabilities and combination, over a drive that turns and stops."""
    kalman = pytest.importorskip("filterpy.kalman")
    rng, dt, stay = np.random.default_rng(5), 0.1, 0.95
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
        truth = twins.tracking.moved(ukf.CTRV, truth, dt)
        detection = truth[[0, 1, 3]] + rng.normal(0.0, 1.0, 3) * [0.05, 0.05, 0.02]

        mixed, mixed_spread = np.empty_like(ours), np.empty_like(spread)
        fill_interaction(ours, spread, modes, np.array([stay]), mixed, mixed_spread, prior)
        means, predicted = predict(mixed, mixed_spread, NOISE[None], dt)
        likelihoods, weights, group = np.empty((1, 3, 1)), np.empty((1, 1)), np.zeros(1, np.int64)
        gates = jpda.Gates(SIGMAS[None], np.ones(1), group, np.array([1e3]))
        jpda.fill_likelihoods(
            jpda.Predictions(means, predicted, prior), gates, detected(detection[None], group), likelihoods, weights
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
    rng = np.random.default_rng(9)
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
    rng = np.random.default_rng(2)
    for matrix in covariances(rng, 6):
        root, inverse = np.empty((5, 5)), np.empty((3, 3))
        ukf.fill_cholesky(matrix, root)
        np.testing.assert_allclose(root, np.linalg.cholesky(matrix), atol=1e-12)
        ukf.fill_inverse(matrix[:3, :3].copy(), inverse)
        np.testing.assert_allclose(inverse, np.linalg.inv(matrix[:3, :3]), rtol=1e-8, atol=1e-9)
    ukf.fill_cholesky(np.diag([4.0, 0.0, -1e-18, 9.0, 1.0]), root)  # directions without variance
    np.testing.assert_array_equal(root, np.diag([2.0, 0.0, 0.0, 3.0, 1.0]))
    for angle in (*rng.uniform(-20.0, 20.0, 20), 0.0, math.pi / 2):
        assert ukf.half_turn(angle) == pytest.approx((angle + math.pi / 2) % math.pi - math.pi / 2, abs=1e-12)
    assert math.isnan(ukf.half_turn(math.nan))


@pytest.mark.parametrize("n", [0, 1, 5])
def test_the_imm_is_its_twin(n: int) -> None:
    rng = np.random.default_rng(n)
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


def detected(places: np.ndarray, groups: np.ndarray) -> jpda.Detections:
    """Detections of which only the place and the group matter."""
    n = len(places)
    nothing = np.full(n, np.nan)
    return jpda.Detections(places, np.full((n, 4), np.nan), nothing, nothing, groups, groups, nothing, groups)


def associate(weights: np.ndarray, max_events: int = jpda.MAX_EVENTS) -> tuple[np.ndarray, int]:
    beta = np.empty((weights.shape[0], weights.shape[1] + 1))
    return beta, jpda.fill_association(weights, max_events, beta)


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 3), (3, 0), (1, 1), (5, 6)])
def test_likelihoods_are_those_of_the_twin(n: int, m: int) -> None:
    rng = np.random.default_rng(n + 7 * m)
    means, predicted = some_tracks(rng, n)
    means[:, 1:] = means[:, :1] + rng.normal(0.0, 0.2, (n, 2, 5))
    detections = rng.normal(0.0, 2.0, (m, 3))
    groups, theirs = rng.integers(0, 2, n), rng.integers(0, 2, m)
    sigmas, prior, odds = np.tile(SIGMAS, (n, 1)), rng.dirichlet(np.ones(3), n), rng.uniform(1.0, 9.0, n)
    limits, got, weights = np.full(n, 3.0), np.empty((n, 3, m)), np.empty((n, m))
    given = (
        jpda.Predictions(means, predicted, prior),
        jpda.Gates(sigmas, odds, groups, limits),
        detected(detections, theirs),
    )
    jpda.fill_likelihoods(*given, got, weights)
    wanted = twins.tracking.likelihoods(*given)
    np.testing.assert_allclose(got, wanted, atol=1e-12)
    np.testing.assert_allclose(weights, odds[:, None] * np.einsum("nk,nkm->nm", prior, wanted), atol=1e-12)
    detections[:1] = np.nan  # the tracker never lets it in; it must not spread either way
    jpda.fill_likelihoods(*given, got, weights)
    assert not got[:, :, :1].any()


@settings(max_examples=60)
@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 10**6))
def test_association_is_the_sum_over_all_joint_events(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    weights = np.exp(rng.normal(0.0, 3.0, (n, m))) * (rng.random((n, m)) < 0.7)
    beta, n_approximated = associate(weights)
    assert n_approximated == 0
    np.testing.assert_allclose(beta, twins.tracking.association(weights), rtol=1e-9, atol=1e-12)


@settings(max_examples=60)
@given(st.integers(1, 4), st.integers(1, 4), st.integers(0, 10**6))
def test_belief_propagation_is_its_twin_and_near_the_truth(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    weights = np.exp(rng.normal(0.0, 2.0, (n, m))) * (rng.random((n, m)) < 0.7)
    beta, n_approximated = associate(weights, max_events=0)
    assert n_approximated == n
    np.testing.assert_allclose(beta.sum(axis=1), 1.0, atol=1e-9)
    assert (beta[:, 1:].sum(axis=0) < 1.0 + 1e-5).all()
    np.testing.assert_allclose(beta, twins.tracking.propagation(weights), atol=1e-4)
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
    rng, gaps = np.random.default_rng(3), []
    for _ in range(100):
        weights = np.exp(rng.normal(1.0, 2.0, (4, 4))) * (rng.random((4, 4)) < 0.6)
        gaps.append(np.abs(associate(weights, 0)[0] - twins.tracking.association(weights)).mean())
    assert np.mean(gaps) < 0.01


def test_clusters_are_solved_apart_and_large_ones_approximated() -> None:
    rng = np.random.default_rng(0)
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
    jpda.fill_by_propagation(np.array([[1e15, 1.0], [1.0, 1e15]]), np.arange(2), np.arange(2), scratch)
    np.testing.assert_allclose(scratch[:, 1:], np.eye(2), atol=1e-6)
