"""Empirical mode decomposition by PyEMD, with the inner parts of its sifting compiled.

The library sifts, and decides what is a mode; what takes its time are three of its steps, replaced by the same
arithmetic in compiled loops: extrema and zero crossings, the cubic spline through the extrema (not-a-knot), and the
test of convergence. Where samples repeat or are zero, or such a spline has too few knots, the library's own run.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from PyEMD import EMD

from tbmfg.timeseries import Floats

LEAST_KNOTS = 4  # of a not-a-knot spline


class Sifting(EMD):
    """PyEMD's decomposition with its defaults: the same modes but for rounding."""

    def find_extrema(self, T, S):
        """As the library's: positions and values of maxima and minima, and indices before zero crossings."""
        plain, maxima, minima, zeros = _turns(S)
        if not plain:
            return super().find_extrema(T, S)
        return T[maxima], S[maxima], T[minima], S[minima], zeros

    def spline_points(self, T, extrema):
        """As the library's: ``T``, and there the spline through ``extrema`` (2, n) that reach beyond it."""
        x = extrema[0]
        if len(x) < LEAST_KNOTS or x[0] > T[0] or x[-1] < T[-1]:
            return super().spline_points(T, extrema)
        return T, spline(x, extrema[1], T)

    def check_imf(self, imf_new, imf_old, eMax, eMin):
        """As the library's: whether the last step changed little, and maxima are above zero and minima below."""
        if eMax[1].min() < 0 or eMin[1].max() > 0:
            return False
        return _settled(imf_new, imf_old, self.svar_thr, self.std_thr, self.energy_ratio_thr)


def modes(x: Floats) -> tuple[Floats, Floats]:
    """Modes (k, n) of ``x`` (n,), the fastest first, and what is left of it (n,)."""
    sifting = Sifting()
    sifting.emd(x)
    return sifting.get_imfs_and_residue()


@njit(cache=True)
def _turns(S):
    """Whether no sample is zero or like the one before it; and then indices of maxima, minima and of samples before a
    change of sign."""
    n = len(S)
    maxima, minima, zeros = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    highs, lows, crossings = 0, 0, 0
    plain = S[0] != 0.0
    for k in range(1, n):
        if S[k] == 0.0 or S[k] == S[k - 1]:
            plain = False
            break
        if (S[k - 1] < 0.0) != (S[k] < 0.0):
            zeros[crossings] = k - 1
            crossings += 1
        if k < n - 1 and (S[k] > S[k - 1]) == (S[k] > S[k + 1]):
            if S[k] > S[k - 1]:
                maxima[highs] = k
                highs += 1
            else:
                minima[lows] = k
                lows += 1
    return plain, maxima[:highs], minima[:lows], zeros[:crossings]


@njit(cache=True)
def spline(x, y, t):
    """The cubic spline through ``y`` (n,) at ``x`` (n,), not-a-knot, at ascending ``t`` (m,) within."""
    n = len(x)
    h, slope = x[1:] - x[:-1], (y[1:] - y[:-1]) / (x[1:] - x[:-1])
    # derivatives s at the knots: lower, diagonal, upper of a tridiagonal system, eliminated downwards
    s, upper = np.empty(n), np.empty(n)
    wide = h[0] + h[1]
    upper[0] = wide / h[1]
    s[0] = ((h[0] + 2.0 * wide) * h[1] * slope[0] + h[0] ** 2 * slope[1]) / wide / h[1]
    for k in range(1, n - 1):
        pivot = 2.0 * (h[k - 1] + h[k]) - h[k] * upper[k - 1]
        upper[k] = h[k - 1] / pivot
        s[k] = (3.0 * (h[k] * slope[k - 1] + h[k - 1] * slope[k]) - h[k] * s[k - 1]) / pivot
    wide = h[n - 3] + h[n - 2]
    right = (h[n - 2] ** 2 * slope[n - 3] + (2.0 * wide + h[n - 2]) * h[n - 3] * slope[n - 2]) / wide
    s[n - 1] = (right - wide * s[n - 2]) / (h[n - 3] - wide * upper[n - 2])
    for k in range(n - 2, -1, -1):
        s[k] -= upper[k] * s[k + 1]
    out, k = np.empty(len(t)), -1
    c1 = c0 = 0.0
    for m in range(len(t)):
        while k < 0 or (k < n - 2 and t[m] >= x[k + 1]):
            k += 1
            bend = (s[k] + s[k + 1] - 2.0 * slope[k]) / h[k]
            c0, c1 = bend / h[k], (slope[k] - s[k]) / h[k] - bend
        z = t[m] - x[k]
        out[m] = y[k] + z * (s[k] + z * (c1 + z * c0))
    return out


@njit(cache=True, error_model="numpy")
def _settled(new, old, by_range, by_sample, by_energy):
    """Whether a step from ``old`` to ``new`` changed little by one of three measures."""
    energy, change, share, before = 0.0, 0.0, 0.0, 0.0
    for k in range(len(new)):
        d = new[k] - old[k]
        energy += new[k] ** 2
        change += d * d
        share += (d / new[k]) ** 2
        before += old[k] * old[k]
    if energy < 1e-10:
        return False
    return change / (old.max() - old.min()) < by_range or share < by_sample or change / before < by_energy
