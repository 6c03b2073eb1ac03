"""Kalman algebra: against the information form, and over long runs and wide scales."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal

from tbmfg.filters.kalman import correct, explaining, innovation, innovation_noise, predict
from tests.problems import EPS


def problem(seed, n=9, k=3, scale=None):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    scale = np.ones(n) if scale is None else scale
    P = scale[:, None] * (A @ A.T + np.eye(n)) * scale
    return 0.5 * (P + P.T), rng.standard_normal((k, n)) / scale, rng.standard_normal(k)


@pytest.mark.parametrize("k", [1, 3, 6])
def test_innovation_is_that_of_a_normal_distribution(k):
    P, H, r = problem(1, k=k)
    nis, logdet = innovation(P, H, r)
    S = H @ P @ H.T + np.eye(k)
    logpdf = multivariate_normal(np.zeros(k), S).logpdf(r)
    assert -0.5 * (nis + logdet + k * np.log(2 * np.pi)) == pytest.approx(logpdf, rel=1e-12)
    assert nis == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-12)


@pytest.mark.parametrize("k", [1, 3, 6])
def test_correction_is_the_information_form(k):
    """P+ = (P^-1 + H^T H)^-1 and dx = -P+ H^T r, the least squares of prior and rows."""
    P, H, r = problem(2, k=k)
    dx, P1 = correct(P, H, r)
    expected = np.linalg.inv(np.linalg.inv(P) + H.T @ H)
    rounding = 100 * EPS * np.linalg.cond(P)
    assert_allclose(P1, expected, rtol=rounding, atol=rounding * np.abs(expected).max())
    assert_allclose(dx, -expected @ H.T @ r, rtol=rounding, atol=rounding)


def test_a_given_noise_is_that_of_whitened_rows():
    P, H, r = problem(7)
    A = np.random.default_rng(8).standard_normal((3, 3))
    R = A @ A.T + np.eye(3)
    white = np.linalg.inv(np.linalg.cholesky(R))
    for given, whitened in zip(correct(P, H, r, R), correct(P, white @ H, white @ r), strict=True):
        assert_allclose(given, whitened, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("k", [1, 3, 6])
def test_a_state_that_explains_an_innovation_is_wider_along_one_error(k):
    P, H, r = problem(3, k=k)
    r *= 100.0
    wider = explaining(P, H, r, innovation(P, H, r)[0])
    assert innovation(wider, H, r)[0] == pytest.approx(k, rel=1e-9)
    assert np.sum(np.linalg.eigvalsh(wider - P) > 1e-9 * np.trace(wider)) == 1
    # the correction of a widened state meets the row but for its noise
    assert np.linalg.norm(r + H @ correct(wider, H, r)[0]) < 0.01 * np.linalg.norm(r)


def test_prediction_moves_the_first_states_only():
    P, _, _ = problem(9)
    rng = np.random.default_rng(10)
    Phi, Q = rng.standard_normal((5, 5)), np.diag(rng.random(5))
    whole, noise = np.eye(9), np.zeros((9, 9))
    whole[:5, :5], noise[:5, :5] = Phi, Q
    assert_allclose(predict(P, Phi, Q), whole @ P @ whole.T + noise, rtol=1e-13, atol=1e-13)


def test_noise_from_innovations_of_a_stationary_stream():
    """Mehra's estimate of R with its floor off, averaged over 10 000 epochs, is R.

    Innovations e of the right filter are white with covariance S. The mean of all windows' C weighs e_j e_j^T by
    w_j, how many windows hold it over windows x length, so each entry has the variance (S_aa S_bb + S_ab^2) sum w_j^2.
    """
    rng = np.random.default_rng(11)
    Phi, Q = np.array([[1.0, 0.1], [-0.2, 0.95]]), np.diag([0.02, 0.1])
    H, R = np.array([[1.0, 0.0], [0.5, 2.0]]), np.array([[1.0, 0.3], [0.3, 2.0]])
    P = np.eye(2)
    for _ in range(500):  # to the steady state
        _, after = correct(P, H, np.zeros(2), R)
        P = predict(after, Phi, Q)
    true = np.linalg.cholesky(P) @ rng.standard_normal(2)
    x, epochs, window = np.zeros(2), 10_000, 20
    e = np.empty((epochs + window - 1, 2))
    for k in range(len(e)):
        e[k] = H @ (x - true) - np.linalg.cholesky(R) @ rng.standard_normal(2)
        x = Phi @ (x + correct(P, H, e[k], R)[0])
        true = Phi @ true + np.sqrt(np.diag(Q)) * rng.standard_normal(2)
    found = [innovation_noise(e[k : k + window], H @ P @ H.T, -np.inf) for k in range(epochs)]
    S = H @ P @ H.T + R
    weights = np.convolve(np.ones(epochs), np.ones(window)) / (epochs * window)
    error = np.sqrt((np.outer(np.diag(S), np.diag(S)) + S**2) * np.sum(weights**2))
    assert np.abs((np.mean(found, axis=0) - R) / error).max() < 3
    # H12: without subtracting, it is S that is found, and that is another matrix
    assert np.abs((np.mean(found, axis=0) + H @ P @ H.T - R) / error).max() > 20


def test_noise_from_innovations_is_never_below_the_floor():
    e = np.random.default_rng(12).standard_normal((20, 3)) * [0.1, 1.0, 30.0]
    R = innovation_noise(e, 0.5 * np.eye(3), 1.0)
    values = np.linalg.eigvalsh(R)
    assert values.min() == pytest.approx(1.0, abs=1e-12)
    assert values.max() == pytest.approx(np.linalg.eigvalsh(e.T @ e / 20)[-1] - 0.5, rel=1e-9)


def test_rows_together_or_one_by_one():
    P, H, r = problem(3, k=4)
    together = correct(P, H, r)
    x, one = np.zeros(len(P)), P
    for row, value in zip(H, r, strict=True):
        dx, one = correct(one, row[None], np.array([value]) + row @ x)
        x = x + dx
    assert_allclose(x, together[0], atol=1e-12)
    assert_allclose(one, together[1], atol=1e-12)


def test_covariance_stays_symmetric_and_positive_over_a_long_run():
    """States from metres to gyro biases, rows from useless to far better than the state, ten thousand times."""
    scale = np.array([1e-2, 1e-2, 1.0, 1.0, 1e-4, 1e-4, 1e-8, 1e-8, 1e-8])
    P, _, _ = problem(4, scale=scale)
    rng = np.random.default_rng(5)
    grow = np.diag((1e-4 * scale) ** 2)
    for _ in range(10_000):
        H = 10.0 ** rng.uniform(-3, 5) * rng.standard_normal((3, len(P))) / scale
        _, P = correct(P, H, rng.standard_normal(3))
        assert np.array_equal(P, P.T)
        P = P + grow
    values = np.linalg.eigvalsh(P / np.outer(scale, scale))
    assert values.min() > 0.5e-8, "never below what is added each time"


def test_an_exact_row_fixes_what_it_sees():
    """A row of sd 1e-9 on a state of sd 1: (I - K H) P alone would leave rounding in place of 1e-18."""
    P, _, _ = problem(6)
    H = np.zeros((1, len(P)))
    H[0, 2] = 1e9
    dx, P1 = correct(P, H, np.array([-0.3e9]))
    assert dx[2] == pytest.approx(0.3, rel=1e-9)
    assert 0 <= P1[2, 2] < 10 * EPS * P[2, 2]
    assert np.linalg.eigvalsh(P1).min() > -10 * EPS * np.abs(P).max()
