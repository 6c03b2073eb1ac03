"""Kalman algebra: pure functions (compiled), shared by every filter.

Rows are whitened, so that their noise is one; an ``R`` (k, k) replaces it where a filter finds another than the rig's.
"""

from __future__ import annotations

import numpy as np
from numba import njit

REOPEN = 10  # rows of one sensor gated in a row after which it is the state that is wrong


@njit(cache=True)
def predict(P, Phi, Q):
    """Time update: P of (n, n), of which the first states go by ``Phi`` (m, m) with noise ``Q``; the rest stays."""
    m = len(Phi)
    out = P.copy()
    out[:m] = Phi @ out[:m]
    out[:, :m] = np.ascontiguousarray(out[:, :m]) @ Phi.T
    out[:m, :m] += Q
    return out


@njit(cache=True)
def innovation(P, H, r):
    """Squared normalised innovation r^T S^-1 r and log det S for whitened rows: S = H P H^T + I."""
    S = H @ P @ H.T + np.eye(len(r))
    L = np.linalg.cholesky(S)
    y = np.linalg.solve(L, r)
    return y @ y, 2.0 * np.sum(np.log(np.diag(L)))


@njit(cache=True)
def correct(P, H, r, R=None):
    """Joseph update with rows ``H`` (k, n), residual ``r`` = h(x) - z (k,), R = I unless given: error, covariance.

    K = P H^T S^-1; dx = -K r; P+ = (I - K H) P (I - K H)^T + K R K^T, multiplied out.
    """
    PHt = P @ H.T
    S = H @ PHt + (np.eye(len(r)) if R is None else R)
    K = np.linalg.solve(S, PHt.T).T
    A = K @ (PHt - 0.5 * K @ S).T
    P1 = P - A - A.T
    return -(K @ r), 0.5 * (P1 + P1.T)


@njit(cache=True)
def explaining(P, H, r, nis):
    """Covariance of a state that is to explain the innovation ``r`` (k,), whose square is ``nis`` > k: widened along
    the likeliest error that would, u = P H^T (H P H^T)^-1 r with H u = r, and as far as makes that square k, its mean.

    With P + b u u^T the innovation spreads by S + b r r^T, and its square is nis / (1 + b nis).
    """
    PHt = P @ H.T
    u = PHt @ (np.linalg.pinv(H @ PHt) @ r)
    return P + (1.0 / len(r) - 1.0 / nis) * np.outer(u, u)


@njit(cache=True)
def innovation_noise(residuals, HPHt, floor):
    """Noise of rows by what their innovations leave after the state's doubt: R = C - H P H^T, (k, k).

    C is the mean of e e^T over a window of ``residuals`` (N, k), about no mean; eigenvalues are held at ``floor`` from
    below, 1 being the rig's noise. Mehra (1972); shearer (32) with H12: C itself estimates S = H P H^T + R.
    """
    C = residuals.T @ residuals / len(residuals)
    values, vectors = np.linalg.eigh(C - HPHt)
    return (vectors * np.maximum(values, floor)) @ vectors.T
