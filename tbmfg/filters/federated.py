"""A federated Kalman filter: local filters with the same state, their fusion, and how it is shared out again.

It knows no sensor: what a local filter measures is its own affair. Carlson (1990), as in the shearer paper, (27)-(35).
With the process noise shared like the covariance, Q_i = Q / beta_i (erratum H13), and a fixed noise of measurements,
the fusion is the centralised filter's estimate, whatever the shares are (H17). A federation of one is a centralised
filter.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from tbmfg.filters.kalman import correct, predict
from tbmfg.timeseries import Floats

Rule = Literal["fixed", "printed", "inverse"]

LEAST_SHARE = 1e-3  # the inverse rule lets the better filter take all (H16); a share of nothing is no covariance


def fuse(estimates: list[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """(35): P_g = (sum P_i^-1)^-1, X_g = P_g sum P_i^-1 X_i, for local states (n,) with covariances (n, n).

    Each further estimate is a measurement of the whole state with its covariance as noise: nothing is inverted but
    sums of covariances, in units of their diagonal.
    """
    X, P = estimates[0]
    for other, covariance in estimates[1:]:
        unit = np.sqrt(np.diag(P + covariance))
        scale = np.outer(unit, unit)
        dx, P = correct(P / scale, np.eye(len(X)), (X - other) / unit, covariance / scale)
        X, P = X + unit * dx, P * scale
    return X, P


def shares(rule: Rule, covariances: list[Floats], unit: Floats, before: Floats) -> Floats:
    """(33): the shares beta (m,), of sum one. ``fixed`` keeps those of ``before``.

    ``printed``: in proportion to tr(P_i), the worse filter gets more, and as P_i is P_g / beta_i after a reset, shares
    alternate (H15, H16). ``inverse``: in proportion to 1 / tr(P_i), the usual direction. Traces are taken with states
    in units of ``unit`` (n,), as radians and metres do not add up.
    """
    if rule == "fixed":
        return before
    traces = np.array([np.sum(np.diag(P) / unit**2) for P in covariances])
    weight = traces if rule == "printed" else 1.0 / traces
    beta = np.maximum(weight / weight.sum(), LEAST_SHARE)
    return beta / beta.sum()


class Federation:
    """``P`` the local covariances (n, n), ``beta`` (m,) their shares. Local states are errors: zero after a reset."""

    def __init__(self, P: Floats, beta: Floats, rule: Rule = "fixed", share_q: bool = True) -> None:
        """``P`` (n, n) is the covariance of the whole at the start; ``share_q=False`` is (28) as printed."""
        self.beta, self.rule, self.share_q = np.asarray(beta, dtype=float), rule, share_q
        self.unit = np.sqrt(np.diag(P))
        self.P = [P / share for share in self.beta]

    def predict(self, Phi: Floats, Q: Floats) -> None:
        """(28): the time update of every local filter."""
        self.P = [predict(P, Phi, Q / share if self.share_q else Q) for P, share in zip(self.P, self.beta, strict=True)]

    def fused(self) -> Floats:
        """Covariance of the whole while all local states are zero, (n, n)."""
        zero = np.zeros(len(self.unit))
        return fuse([(zero, P) for P in self.P])[1]

    def update(self, local: list[tuple[Floats, Floats]]) -> Floats:
        """Fuse the local filters' errors and covariances (35), choose the shares (33), hand the fusion out again (34).
        Returns the error of the whole, (n,), for the closed loop."""
        X, P = fuse(local)
        self.beta = shares(self.rule, [covariance for _, covariance in local], self.unit, self.beta)
        self.P = [P / share for share in self.beta]
        return X
