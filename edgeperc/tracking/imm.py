"""The interacting multiple model: interaction, mode probabilities, combination (KUL-Seg 6 and Figure 10)."""

from __future__ import annotations

from ..system.kernels import njit
from ..types.points import Floats


@njit(cache=True, nogil=True)
def fill_interaction(
    states: Floats,
    covariances: Floats,
    probabilities: Floats,
    stay: Floats,
    mixed: Floats,
    mixed_covariances: Floats,
    prior: Floats,
) -> None:
    """Mix the estimates of n tracks by k motion models by a Markov chain (KUL-Seg's "interaction"); a track keeps its
    model with probability ``stay``, and the others share the rest.

    mixed : initial state of each filter: x0_j = sum_i w_ij x_i with w_ij = p_ij mu_i / prior_j.
    mixed_covariances : sum_i w_ij (P_i + (x_i - x0_j)(x_i - x0_j)')
    prior : prior_j = sum_i p_ij mu_i
    """
    n, k, s = states.shape
    for t in range(n):
        leave = (1.0 - stay[t]) / (k - 1)
        for j in range(k):
            prior[t, j] = 0.0
            for i in range(k):
                prior[t, j] += (stay[t] if i == j else leave) * probabilities[t, i]
            mixed[t, j] = 0.0
            mixed_covariances[t, j] = 0.0
            for i in range(k):
                weight = (stay[t] if i == j else leave) * probabilities[t, i] / prior[t, j]
                for a in range(s):
                    mixed[t, j, a] += weight * states[t, i, a]
            for i in range(k):
                weight = (stay[t] if i == j else leave) * probabilities[t, i] / prior[t, j]
                for a in range(s):
                    for b in range(s):
                        off = (states[t, i, a] - mixed[t, j, a]) * (states[t, i, b] - mixed[t, j, b])
                        mixed_covariances[t, j, a, b] += weight * (covariances[t, i, a, b] + off)


@njit(cache=True, nogil=True)
def fill_mode_probabilities(
    prior: Floats, likelihoods: Floats, beta: Floats, shares: Floats, probabilities: Floats
) -> None:
    """Update the probability of each motion model by the association (KUL-Seg's "mode probability update").

    Bayes' rule for motion model j and detection d: P(j, d) = beta_d prior_j L_jd / sum_i prior_i L_id. The sum over d
    is the probability of model j. P(j, d) divided by that sum is the association that the filter of model j uses.

    likelihoods : (n, k, m) of each detection under each motion model; 0 outside the gate.
    shares : (n, k, m + 1) association for each motion model; sums to 1 over the last axis.
    """
    n, k, m = likelihoods.shape
    for t in range(n):
        for j in range(k):
            shares[t, j, 0] = beta[t, 0] * prior[t, j]
            for d in range(m):
                shares[t, j, d + 1] = 0.0
        for d in range(m):
            if beta[t, d + 1] == 0.0:  # skips most pairs
                continue
            total = 0.0
            for j in range(k):
                total += prior[t, j] * likelihoods[t, j, d]
            for j in range(k):
                if total > 0.0:
                    shares[t, j, d + 1] = beta[t, d + 1] * prior[t, j] * likelihoods[t, j, d] / total
        for j in range(k):
            total = 0.0
            for d in range(m + 1):
                total += shares[t, j, d]
            if total > 0.0:
                for d in range(m + 1):
                    shares[t, j, d] /= total
            else:
                shares[t, j, 0] = 1.0
            # A model with probability 0 could never recover, and its association would be 0 / 0.
            probabilities[t, j] = max(total, 1e-12)
        total = 0.0
        for j in range(k):
            total += probabilities[t, j]
        for j in range(k):
            probabilities[t, j] /= total


@njit(cache=True, nogil=True)
def fill_combined(
    states: Floats, covariances: Floats, probabilities: Floats, state: Floats, covariance: Floats
) -> None:
    """Combine the estimates of the motion models into one for each track (KUL-Seg's "combination"): x = sum_j mu_j x_j,
    and sum_j mu_j (P_j + (x_j - x)(x_j - x)').
    """
    n, k, s = states.shape
    state[:] = 0.0
    covariance[:] = 0.0
    for t in range(n):
        for j in range(k):
            for a in range(s):
                state[t, a] += probabilities[t, j] * states[t, j, a]
        for j in range(k):
            for a in range(s):
                for b in range(s):
                    off = (states[t, j, a] - state[t, a]) * (states[t, j, b] - state[t, b])
                    covariance[t, a, b] += probabilities[t, j] * (covariances[t, j, a, b] + off)
