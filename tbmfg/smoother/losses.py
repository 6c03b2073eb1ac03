"""What a row far from the estimate counts: Huber, Cauchy, and truncated squares by graduated non-convexity.

A row's size is its squared normalised residual, ``nis``. A bias that lasts defeats Huber (every row pulls on) and
draws Cauchy; truncated squares leave it out altogether, but have many minima. Graduated non-convexity (Yang et al.,
"Graduated Non-Convexity for Robust Spatial Perception", 2020, sec. IV) begins with nearly the square, ``mu`` near 0,
and goes over to the truncated one.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from tbmfg.chance import chi_square_point
from tbmfg.problem import GATE
from tbmfg.timeseries import Floats

GROWTH = 2.0  # of mu from stage to stage
LAST_MU = 1e3  # the loss is the truncated square to a part in 1000


@cache
def threshold(dof: int) -> float:
    """Normalised residual from which Huber and Cauchy depart from the square: 95 % of good rows lie below."""
    return float(np.sqrt(chi_square_point(0.95, dof)))


@cache
def gate(dof: int) -> float:
    """Squared normalised residual beyond which a row is gated, and truncated squares end."""
    return float(chi_square_point(GATE, dof))


def weight(nis: Floats, loss: str, dof: int, mu: float | None = None) -> Floats:
    """IRLS weight of rows; ``gnc`` without ``mu`` is Cauchy."""
    if loss == "none":
        return np.ones_like(nis)
    s = np.sqrt(nis)
    if loss == "gnc" and mu is not None:
        c = np.sqrt(gate(dof))
        return np.clip(c / np.maximum(s, 1e-9) * np.sqrt(mu * (mu + 1.0)) - mu, 0.0, 1.0)  # eq. (14)
    k = threshold(dof)
    if loss == "huber":
        return k / np.maximum(s, k)
    return 1.0 / (1.0 + nis / k**2)


def cost(nis: Floats, loss: str, dof: int, mu: float | None = None) -> float:
    """Sum of the losses: half the square where a row is good."""
    if loss == "none":
        return 0.5 * float(nis.sum())
    s = np.sqrt(nis)
    if loss == "gnc" and mu is not None:
        square = gate(dof)
        between = 2.0 * np.sqrt(square) * s * np.sqrt(mu * (mu + 1.0)) - mu * (square + nis)  # eq. (12)
        good, bad = nis <= mu / (mu + 1.0) * square, nis >= (mu + 1.0) / mu * square
        return 0.5 * float(np.sum(np.where(good, nis, np.where(bad, square, between))))
    k = threshold(dof)
    if loss == "huber":
        return float(np.sum(np.where(s < k, 0.5 * nis, k * s - 0.5 * k**2)))
    return float(np.sum(0.5 * k**2 * np.log1p(nis / k**2)))


def first_mu(nis: Floats, dof: int) -> float:
    """Where to begin so that every row still counts; eq. (12) ff."""
    square = gate(dof)
    return float(square / max(2.0 * nis.max() - square, square))
