"""Empirical mode decomposition by PyEMD, with the inner parts of its sifting compiled.

The library sifts, and decides what is a mode; what takes its time are four of its steps, replaced by the same
arithmetic in compiled loops: extrema and zero crossings, their mirror images beyond the ends, the cubic spline through
them (not-a-knot), and the test of convergence. Where samples repeat or are zero, or extrema are few, the library's own
run.
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

    def prepare_points_simple(self, T, S, max_pos, max_val, min_pos, min_val):
        """As the library's: maxima (2, .) and minima (2, .), ``nbsym`` of each mirrored at either end."""
        if min(len(max_pos), len(min_pos)) < self.nbsym + 2:
            return super().prepare_points_simple(T, S, max_pos, max_val, min_pos, min_val)
        return _mirrored(T, S, max_pos.astype(np.int64), min_pos.astype(np.int64), self.nbsym)

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
def _mirrored(T, S, highs, lows, size):
    """Times and values of maxima (2, .) and minima (2, .), ``size`` of each mirrored at either end."""
    last = len(S) - 1
    left_highs, left_lows, left = _images(T, S, highs, lows, size, 0)
    right_highs, right_lows, right = _images(T, S, highs[::-1], lows[::-1], size, last)
    return (
        _joined(T, S, left_highs, left, highs, right_highs, right),
        _joined(T, S, left_lows, left, lows, right_lows, right),
    )


@njit(cache=True)
def _images(T, S, highs, lows, size, end):
    """Which maxima and minima, both in order from ``end``, are mirrored beyond it, and where. The mirror stands on the
    outermost extremum where the end lies on its side of the next one, else at the end, which then counts as that."""
    high = abs(highs[0] - end) < abs(lows[0] - end)
    outer, inner = (highs, lows) if high else (lows, highs)
    if (S[end] > S[inner[0]]) == high and S[end] != S[inner[0]]:
        outers, inners, mirror = outer[1 : size + 1].copy(), inner[:size].copy(), outer[0]
        reach = 2.0 * T[mirror] - np.array([T[outers[-1]], T[inners[-1]]]) - T[end]
        if (end == 0 and reach.max() > 0.0) or (end > 0 and reach.min() < 0.0):  # the images stay inside
            outers, mirror = outer[:size].copy(), end
    else:
        outers, inners, mirror = outer[:size].copy(), np.empty(size, np.int64), end
        inners[0], inners[1:] = end, inner[: size - 1]
    return (outers, inners, mirror) if high else (inners, outers, mirror)


@njit(cache=True)
def _joined(T, S, left, left_mirror, inside, right, right_mirror):
    """Images, extrema and images in the order of time, (2, .): of several at one time the last."""
    t = np.concatenate((2.0 * T[left_mirror] - T[left[::-1]], T[inside], 2.0 * T[right_mirror] - T[right]))
    values = S[np.concatenate((left[::-1], inside, right))]
    out, n = np.empty((2, len(t))), 0
    for k in range(len(t)):
        n -= int(n > 0 and out[0, n - 1] == t[k])
        out[0, n], out[1, n] = t[k], values[k]
        n += 1
    return out[:, :n].copy()


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
