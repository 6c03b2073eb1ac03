"""Kalman algebra: against the information form, and over long runs and wide scales."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal

from tbmfg.filters.kalman import correct, innovation
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
