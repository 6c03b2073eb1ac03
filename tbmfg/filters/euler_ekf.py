"""Extended Kalman filter of the shaft boring machine: Euler angles, displacement and velocity (compiled).

Wang et al., Sensors 2019, 19, 5007, (21)-(29), corrected. Frames as in :mod:`tbmfg.filters.frd`. The state X is roll,
pitch, yaw, d (3) and V (3) in r: nine, of which the seven of (22) leave V_x and V_y as inputs that nothing corrects
(S15). Readings z are roll, pitch, yaw, the spot (a, b), depth and V_z.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tbmfg.filters.complementary import displacement
from tbmfg.filters.frd import euler_rates, rotation_ra
from tbmfg.filters.kalman import correct

V_X, V_Y, V_Z, D_Z = 6, 7, 8, 5
STATE_OF = np.array([0, 1, 2, 3, 4, D_Z, V_Z])  # what each reading is one of
UPRIGHT = np.cos(np.deg2rad(89.0))  # the cosine of the pitch below which the angles have no rates


@njit(cache=True)
def predict_state(X, omega, f, T, gravity):
    """(22), (25) as f(X, u) (S19): angles by (6), d by V, V by (21) with the specific force ``f`` in a (S8)."""
    a = rotation_ra(X[:3]).T @ f
    a[2] += gravity
    out = X.copy()
    out[:3] += T * (euler_rates(X[0], X[1]) @ omega)
    out[3:6] += T * X[6:9]
    out[6:9] += T * a
    return out


@njit(cache=True)
def jacobian(X, omega, f, T, states, printed):
    """(24), (9, 9). Nine states have the rows of V_x and V_y and the turn of the acceleration with the attitude;
    ``printed`` lacks d(d_z)/d(V_z) (S18)."""
    sa, ca, sb, cb = np.sin(X[0]), np.cos(X[0]), np.sin(X[1]), np.cos(X[1])
    across, along = ca * omega[1] - sa * omega[2], sa * omega[1] + ca * omega[2]
    Phi = np.eye(9)
    Phi[0, 0] += T * across * sb / cb
    Phi[0, 1] = T * along / cb**2
    Phi[1, 0] = -T * along
    Phi[2, 0] = T * across / cb
    Phi[2, 1] = T * along * sb / cb**2
    if not printed:
        Phi[D_Z, V_Z] = T
    if states == 9:
        Phi[3, V_X], Phi[4, V_Y] = T, T
        C_ar = rotation_ra(X[:3]).T
        a = C_ar @ f
        axes = np.zeros((3, 3))  # in r, about which roll, pitch and yaw turn
        axes[0] = C_ar[:, 0]
        axes[1] = np.array([-np.sin(X[2]), np.cos(X[2]), 0.0])
        axes[2, 2] = 1.0
        for j in range(3):
            Phi[6, j] = T * (axes[j, 1] * a[2] - axes[j, 2] * a[1])
            Phi[7, j] = T * (axes[j, 2] * a[0] - axes[j, 0] * a[2])
            Phi[8, j] = T * (axes[j, 0] * a[1] - axes[j, 1] * a[0])
    return Phi


@njit(cache=True)
def process_noise(X, T, psd_gyro, psd_acc, states):
    """Q of one step: white rates through (6), white accelerations on V and, apart, on d; none on a V that is an input.

    The paper gives none; with the correlation of d and V in it, the printed (24) would learn V_z after all.
    """
    E = euler_rates(X[0], X[1])
    Q = np.zeros((9, 9))
    Q[:3, :3] = psd_gyro * T * E @ E.T
    for j in range(3):
        Q[3 + j, 3 + j] = psd_acc * T**3 / 3.0
        if states == 9 or j == 2:
            Q[6 + j, 6 + j] = psd_acc * T
    return Q


@njit(cache=True)
def run(X, P, omega, f, z, sd, dt, psd_gyro, psd_acc, gravity, psd_sign, states, predict_printed, jac_printed, edges):
    """States (m, 9) and covariances (m, 9, 9) at ``edges`` (m,), from ``X`` and ``P`` at the first; and the edge where
    the pitch came within a degree of 90, at which the filter ends, or -1.

    ``omega``, ``f`` (n, 3) the rates and specific forces of each step, ``z`` (n, 7) its readings, NaN where there is
    none, of sd ``sd`` (7,); ``psd_gyro``, ``psd_acc`` (n,) the white noise.
    """
    Xs, Ps = np.zeros((len(edges), 9)), np.zeros((len(edges), 9, 9))
    Xs[0], Ps[0] = X, P
    out = 1
    for k in range(len(omega)):
        Phi = jacobian(X, omega[k], f[k], dt[k], states, jac_printed)
        Q = process_noise(X, dt[k], psd_gyro[k], psd_acc[k], states)
        X = Phi @ X if predict_printed else predict_state(X, omega[k], f[k], dt[k], gravity)  # (25)
        P = Phi @ P @ Phi.T + Q  # (26)
        there = np.flatnonzero(~np.isnan(z[k]))
        H, r = np.zeros((len(there), 9)), np.zeros(len(there))
        for row, j in enumerate(there):
            value, state = z[k, j], STATE_OF[j]
            if j == 3 or j == 4:
                value = displacement(z[k, 3:5], X[2], psd_sign)[j - 3]
            H[row, state] = 1.0 / sd[j]
            r[row] = X[state] - value
            if j < 3:
                r[row] -= 2.0 * np.pi * np.round(r[row] / (2.0 * np.pi))  # (28)
            r[row] /= sd[j]
        if len(there):
            dx, P = correct(P, H, r)  # (27), (29)
            X = X + dx
        X[2] -= 2.0 * np.pi * np.round(X[2] / (2.0 * np.pi))
        if not np.abs(np.cos(X[1])) > UPRIGHT:
            return Xs, Ps, k + 1
        if k + 1 == edges[out]:
            Xs[out], Ps[out] = X, P
            out += 1
            if out == len(edges):
                break
    return Xs, Ps, -1
