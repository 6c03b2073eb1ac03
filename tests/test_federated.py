"""The federated part on matrices alone: fusion, shares, and what the shares are worth."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tbmfg.filters.federated import Federation, fuse, shares
from tbmfg.filters.kalman import correct, predict

SCALE = np.array([1e-3, 1e-2, 1.0, 10.0, 1e-5, 1e-6])  # radians, metres and biases side by side


def covariance(rng):
    A = rng.standard_normal((6, 6))
    return SCALE[:, None] * (A @ A.T + 0.1 * np.eye(6)) * SCALE


def test_fusion_is_the_sum_of_information():
    rng = np.random.default_rng(1)
    estimates = [(SCALE * rng.standard_normal(6), covariance(rng)) for _ in range(3)]
    X, P = fuse(estimates)
    # in units of the states, where numpy's inverse is good to 1e-10
    inverses = [np.linalg.inv(Pi / np.outer(SCALE, SCALE)) for _, Pi in estimates]
    expected = np.linalg.inv(sum(inverses))
    assert_allclose(P / np.outer(SCALE, SCALE), expected, rtol=1e-9, atol=1e-9)
    whole = expected @ sum(inverse @ (Xi / SCALE) for inverse, (Xi, _) in zip(inverses, estimates, strict=True))
    assert_allclose(X / SCALE, whole, rtol=1e-9, atol=1e-9)


def world(seed):
    """Transition, process noise, and one sensor for each of two local filters."""
    rng = np.random.default_rng(seed)
    Phi = np.eye(6) + 0.05 * rng.standard_normal((6, 6)) * SCALE[:, None] / SCALE
    return covariance(rng), Phi, 1e-3 * covariance(rng), [rng.standard_normal((2, 6)) / SCALE for _ in range(2)], rng


def federated(seed, epochs, beta, rule="fixed", share_q=True):
    """Errors and covariances of the whole after each epoch, and the shares; beside them the centralised filter's."""
    P, Phi, Q, H, rng = world(seed)
    federation = Federation(P, beta, rule, share_q)
    out = []
    for _ in range(epochs):
        r = [rng.standard_normal(2) for _ in H]
        federation.predict(Phi, Q)
        X = federation.update([correct(Pi, Hi, ri) for Pi, Hi, ri in zip(federation.P, H, r, strict=True)])
        x, P = correct(predict(P, Phi, Q), np.concatenate(H), np.concatenate(r))
        out.append((X / SCALE, federation.fused() / np.outer(SCALE, SCALE), federation.beta, x / SCALE, P))
    return [np.array(part) for part in zip(*out, strict=True)]


@pytest.mark.parametrize("rule", ["fixed", "printed", "inverse"])
@pytest.mark.parametrize("beta", [(0.5, 0.5), (0.2, 0.8)])
def test_shares_are_worth_nothing_with_shared_process_noise(beta, rule):
    """H13, H17: the fusion is the centralised estimate, whatever the shares and however they change."""
    X, P, beta, x, central = federated(2, 200, beta, rule)
    assert_allclose(X, x, atol=1e-9)
    assert_allclose(P, central / np.outer(SCALE, SCALE), atol=1e-9)
    assert (np.ptp(beta[:, 0]) > 0.01) == (rule != "fixed")


def test_process_noise_as_printed_is_overconfident():
    """H13: given to both whole it is shared by no one, and the fusion takes the common error for two."""
    _, P, _, _, central = federated(2, 200, (0.5, 0.5), share_q=False)
    ratio = np.diag(P[-1]) * SCALE**2 / np.diag(central[-1])
    assert np.all(ratio < 0.95)


def test_printed_shares_alternate():
    """H16: P_i is P_g / beta_i after a reset, so that without information the traces turn the shares round."""
    P, Phi, Q, _, _ = world(3)
    federation = Federation(P, (0.3, 0.7), "printed")
    seen = []
    for _ in range(6):
        federation.predict(Phi, Q)
        federation.update([(np.zeros(6), Pi) for Pi in federation.P])
        seen.append(federation.beta[0])
    assert_allclose(seen, [0.7, 0.3] * 3, atol=1e-12)


def test_inverse_shares_stay_where_they_are_without_information():
    """The opposite fault of H16: nothing brings them back."""
    P, Phi, Q, _, _ = world(3)
    federation = Federation(P, (0.3, 0.7), "inverse")
    for _ in range(6):
        federation.predict(Phi, Q)
        federation.update([(np.zeros(6), Pi) for Pi in federation.P])
    assert_allclose(federation.beta, [0.3, 0.7], atol=1e-12)


def test_shares_have_no_unit_and_never_vanish():
    P = [np.diag([1.0, 4.0]), np.diag([9.0, 36.0])]
    assert_allclose(shares("printed", P, np.array([1.0, 2.0]), np.array([0.5, 0.5])), [0.1, 0.9])
    assert_allclose(shares("inverse", P, np.array([1.0, 2.0]), np.array([0.5, 0.5])), [0.9, 0.1])
    metres = [Pi * np.outer([1.0, 1e3], [1.0, 1e3]) for Pi in P]
    assert_allclose(shares("printed", metres, np.array([1.0, 2e3]), np.array([0.5, 0.5])), [0.1, 0.9])
    extreme = shares("inverse", [np.eye(2), 1e9 * np.eye(2)], np.ones(2), np.array([0.5, 0.5]))
    assert extreme.sum() == pytest.approx(1.0)
    assert extreme.min() > 5e-4
