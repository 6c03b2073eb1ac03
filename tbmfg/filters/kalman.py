"""Kalman algebra: pure functions (compiled)."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def innovation(P, H, r):
    """Squared normalised innovation r^T S^-1 r and log det S for whitened rows: S = H P H^T + I."""
    S = H @ P @ H.T + np.eye(len(r))
    L = np.linalg.cholesky(S)
    y = np.linalg.solve(L, r)
    return y @ y, 2.0 * np.sum(np.log(np.diag(L)))


@njit(cache=True)
def correct(P, H, r):
    """Joseph update with whitened rows ``H`` (k, n), residual ``r`` = h(x) - z (k,): error state and covariance.

    K = P H^T S^-1; dx = -K r; P+ = (I - K H) P (I - K H)^T + K K^T, multiplied out.
    """
    PHt = P @ H.T
    S = H @ PHt + np.eye(len(r))
    K = np.linalg.solve(S, PHt.T).T
    KPHt = K @ PHt.T
    P1 = P - KPHt - KPHt.T + K @ S @ K.T
    return -(K @ r), 0.5 * (P1 + P1.T)
