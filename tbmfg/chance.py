"""Probabilities of chi-square and Poisson numbers, by scipy's special functions: importing its statistics would slow
every start."""

from __future__ import annotations

from scipy.special import gammainc, gammaincc, gammaincinv

from tbmfg.timeseries import Floats


def chi_square_point(probability: float | Floats, dof: float) -> float | Floats:
    """Number that a chi-square of ``dof`` degrees of freedom stays below with ``probability``."""
    return 2.0 * gammaincinv(dof / 2.0, probability)


def chi_square_below(value: float | Floats, dof: float) -> float | Floats:
    """Probability that a chi-square of ``dof`` degrees of freedom stays below ``value``."""
    return gammainc(dof / 2.0, value / 2.0)


def chi_square_beyond(value: float | Floats, dof: float) -> float | Floats:
    """Probability that it does not; exact where that is tiny."""
    return gammaincc(dof / 2.0, value / 2.0)


def poisson_at_least(count: int, mean: float) -> float:
    """Probability of ``count`` events or more where ``mean`` are expected."""
    return float(gammainc(count, mean)) if count > 0 else 1.0
