"""Complementary filter of the shaft boring machine: attitude by feedback, the rest by observers (compiled).

Wang et al., Sensors 2019, 19, 5007, (14)-(20), corrected. Frames as in :mod:`tbmfg.filters.frd`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tbmfg.filters.frd import advance, advance_rk4, angles_of, field_in_a, gravity_in_a, rotation_ar, rotation_ra

# Gains [1/s, 1/s^2] of the observers d' = V + k1 (d_m - d), V' = a + k2 (d_m - d): the paper tabulates displacement and
# speed of this filter and does not define them.
HORIZONTAL, VERTICAL = (6.0, 9.0), (0.6, 0.09)


@njit(cache=True)
def _cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True)
def _unit(v):
    """v / |v|; zero stays zero, which is how a reading that is not there does nothing."""
    size = np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    return v / size if size > 0 else v


@njit(cache=True)
def feedback(q, a_s, m_s, h_n, h_d, yaw_only):
    """(19) e = a_s' x a_f + m_s' x m_f. The field drives roll and pitch too (S12), unless ``yaw_only`` leaves of it
    what turns about the predicted vertical."""
    a_f = gravity_in_a(q)
    by_field = _cross(_unit(m_s), field_in_a(q, h_n, h_d))
    if yaw_only:
        by_field = np.sum(by_field * a_f) * a_f
    return _cross(_unit(a_s), a_f) + by_field


@njit(cache=True)
def attitude(q, omega_s, a_s, m_s, dt, h_n, h_d, k_p, k_i, yaw_only, rk4):
    """Angles at every edge (n + 1, 3) and the feedback eta of every step (n, 3), from ``q`` (4,) at the first edge.

    ``omega_s``, ``a_s``, ``m_s`` (n, 3) are the readings of each step, ``dt`` (n,) its length; m_s of zero: none.
    """
    n = len(omega_s)
    angles, eta, total = np.empty((n + 1, 3)), np.empty((n, 3)), np.zeros(3)
    angles[0] = angles_of(rotation_ar(q))
    for k in range(n):
        e = feedback(q, a_s[k], m_s[k], h_n, h_d, yaw_only)
        total += e * dt[k]
        eta[k] = k_p * e + k_i * total  # (20)
        if not rk4:
            q = advance(q, omega_s[k] + eta[k], dt[k])
        elif k % 2 == 1:  # every second sample, as printed: readings are taken as the rates at their stamps
            before = max(k - 2, 0)
            q = advance_rk4(
                q,
                omega_s[before] + eta[before],
                omega_s[k - 1] + eta[k - 1],
                omega_s[k] + eta[k],
                0.5 * (dt[k - 1] + dt[k]),
            )
        angles[k + 1] = angles_of(rotation_ar(q))
    return angles, eta


@njit(cache=True)
def displacement(ab, gamma, psd_sign):
    """Of the machine in r from the spot (a, b) on its detector, turned by the yaw: where the machine moves +x, the spot
    moves -x (``psd_sign`` -1)."""
    c, s = np.cos(gamma), np.sin(gamma)
    return psd_sign * (c * ab[0] - s * ab[1]), psd_sign * (s * ab[0] + c * ab[1])


@njit(cache=True)
def observers(d, V, angles, f, spot, depth, dt, gravity, psd_sign):
    """Displacement and velocity in r at every edge, (n + 1, 3) each, from ``d`` and ``V`` (3,) at the first.

    ``angles`` (n + 1, 3) at the edges, ``f`` (n, 3) specific force in a, ``spot`` (n, 2) and ``depth`` (n,) [m], NaN
    where there is none.
    """
    n = len(f)
    ds, Vs = np.empty((n + 1, 3)), np.empty((n + 1, 3))
    ds[0], Vs[0] = d, V
    for k in range(n):
        off = np.zeros(3)  # d_m - d
        if not np.isnan(spot[k, 0]):
            x, y = displacement(spot[k], angles[k, 2], psd_sign)
            off[0], off[1] = x - ds[k, 0], y - ds[k, 1]
        if not np.isnan(depth[k]):
            off[2] = depth[k] - ds[k, 2]
        a = rotation_ra(angles[k]).T @ f[k]
        a[2] += gravity  # (21) with f the specific force (S8, S14)
        for axis in range(3):
            k1, k2 = VERTICAL if axis == 2 else HORIZONTAL
            ds[k + 1, axis] = ds[k, axis] + dt[k] * (Vs[k, axis] + k1 * off[axis])
            Vs[k + 1, axis] = Vs[k, axis] + dt[k] * (a[axis] + k2 * off[axis])
    return ds, Vs
