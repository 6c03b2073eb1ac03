"""How many independent samples a correlated series is worth."""

from __future__ import annotations

import numpy as np

from tbmfg.timeseries import Floats, Times

WINDOW = 6.0  # correlation times to sum over: what is cut off is below e^-6 of the sum
MAX_LAGS = 1_000_000  # bounds the memory where a few samples span a very long time


def effective_samples(t_ns: Times, values: Floats) -> float:
    """Duration / (2 x correlation time): between 1 and the number of samples.

    An exponential correlation exp(-t / T) has correlation time T; uncorrelated samples count fully.
    """
    n = len(values)
    if n < 3:
        return float(n)
    spacing = float(np.median(np.diff(t_ns))) * 1e-9
    duration = float(t_ns[-1] - t_ns[0]) * 1e-9 + spacing  # n regular samples stand for n intervals
    return float(np.clip(duration / (2.0 * correlation_time(t_ns, values)), 1.0, n))


def correlation_time(t_ns: Times, values: Floats) -> float:
    """Integral of the autocorrelation over positive lags, s, by the trapezoidal rule.

    Samples are laid on a grid of the median interval, empty cells left out of every product, so that
    irregular stamps and gaps need no invented values. The integral ends at the first lag that is 6 times
    the integral up to it: beyond, the autocorrelation is noise (Sokal 1997, sec. 3). A run too short for
    that is integrated over half its length, and its estimate is then a lower limit. Alternating samples
    count as uncorrelated, not as more than themselves: half the spacing is the least.
    """
    spacing = max(float(np.median(np.diff(t_ns))), float(t_ns[-1] - t_ns[0]) / MAX_LAGS)
    cell = np.rint((t_ns - t_ns[0]) / spacing).astype(np.int64)
    count = np.bincount(cell).astype(float)
    total = np.bincount(cell, weights=values - values.mean())
    products, pairs = _lagged_sums(total), np.rint(_lagged_sums(count))
    lags = max(len(count) // 2, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance = np.where(pairs > 0, products / pairs, 0.0)[:lags]
    if covariance[0] <= 0:  # a constant series holds one sample
        return (t_ns[-1] - t_ns[0]) * 1e-9
    integral = np.cumsum(covariance / covariance[0]) - 0.5
    settled = np.arange(lags) >= WINDOW * integral
    end = int(np.argmax(settled)) if settled.any() else lags - 1
    return max(float(integral[end]), 0.5) * spacing * 1e-9


def _lagged_sums(x: Floats) -> Floats:
    """Sum over i of x[i] x[i + k] for every lag k >= 0, by FFT; (n,) -> (n,)."""
    n = len(x)
    spectrum = np.fft.rfft(x, 2 * n)
    return np.fft.irfft(np.abs(spectrum) ** 2, 2 * n)[:n]
