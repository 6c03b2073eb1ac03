"""Strapdown mechanisation in n with Earth rate, and the propagation of its errors (compiled).

A state is a row of 21 numbers, R_nb (9, row by row), position_n, velocity_n, bias_acc, bias_gyro.
Its error has 15, in the order of the package docstring: true = estimate (+) error with
R_true = R Exp(d), the rest additive.
"""

from __future__ import annotations

import numpy as np
from numba import njit

R_, P_, V_, BA_, BG_ = slice(0, 9), slice(9, 12), slice(12, 15), slice(15, 18), slice(18, 21)
STATE = 21


@njit(cache=True)
def exp_rotation(w: np.ndarray) -> np.ndarray:
    """Exp of one rotation vector (3,) -> (3, 3)."""
    out = np.empty((3, 3))
    _exp(out, w[0], w[1], w[2])
    return out


@njit(cache=True)
def _exp(out, x, y, z):
    """Exp of a rotation vector into ``out`` (3, 3); Rodrigues, series below 1e-4 rad."""
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[2, 2] = 1.0 - b * (x * x + y * y)
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x


@njit(cache=True)
def _mul(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Product of small matrices without the overhead of BLAS."""
    n, m, k = A.shape[0], B.shape[1], B.shape[0]
    C = np.zeros((n, m))
    for i in range(n):
        for q in range(k):
            a = A[i, q]
            for j in range(m):
                C[i, j] += a * B[q, j]
    return C


@njit(cache=True)
def _step(R, p, v, back, force, dt, earth_n, gravity_n, work):
    """One step with compensated rate and force (biases removed), ``back`` being Exp(-rate dt): R, p, v in place.

    R' = Exp(-w_ie dt) R Exp(rate dt); v' = v + (Exp(-w_ie dt / 2) R f + g - 2 w_ie x v) dt; p' = p + (v + v') dt / 2:
    tbm_mse (9), (11), (12) with z up. ``force`` is resolved in b at the step's start, n turns on by half a step.
    ``work`` (2, 3, 3) is scratch: a step is too short to ask for memory.
    """
    turn, turned = work[0], work[1]
    w0, w1, w2 = earth_n[0], earth_n[1], earth_n[2]
    v0, v1, v2 = v[0], v[1], v[2]
    f0 = R[0, 0] * force[0] + R[0, 1] * force[1] + R[0, 2] * force[2]
    f1 = R[1, 0] * force[0] + R[1, 1] * force[1] + R[1, 2] * force[2]
    f2 = R[2, 0] * force[0] + R[2, 1] * force[1] + R[2, 2] * force[2]
    _exp(turn, -0.5 * dt * w0, -0.5 * dt * w1, -0.5 * dt * w2)
    v[0] += dt * (turn[0, 0] * f0 + turn[0, 1] * f1 + turn[0, 2] * f2 + gravity_n[0] - 2.0 * (w1 * v2 - w2 * v1))
    v[1] += dt * (turn[1, 0] * f0 + turn[1, 1] * f1 + turn[1, 2] * f2 + gravity_n[1] - 2.0 * (w2 * v0 - w0 * v2))
    v[2] += dt * (turn[2, 0] * f0 + turn[2, 1] * f1 + turn[2, 2] * f2 + gravity_n[2] - 2.0 * (w0 * v1 - w1 * v0))
    p[0] += 0.5 * dt * (v0 + v[0])
    p[1] += 0.5 * dt * (v1 + v[1])
    p[2] += 0.5 * dt * (v2 + v[2])
    _exp(turn, -dt * w0, -dt * w1, -dt * w2)
    for i in range(3):
        for j in range(3):
            turned[i, j] = R[i, 0] * back[j, 0] + R[i, 1] * back[j, 1] + R[i, 2] * back[j, 2]
    for i in range(3):
        for j in range(3):
            R[i, j] = turn[i, 0] * turned[0, j] + turn[i, 1] * turned[1, j] + turn[i, 2] * turned[2, j]


@njit(cache=True)
def mechanise(x0, edges, gyro, acc, earth_n, gravity_n):
    """States at every edge, (n + 1, 21), from ``x0`` (21,) at the first; rates as from ``compensate``."""
    n = len(gyro)
    out = np.empty((n + 1, STATE))
    out[0] = x0
    R, p, v = x0[:9].copy().reshape(3, 3), x0[9:12].copy(), x0[12:15].copy()
    back, work, rate, force = np.empty((3, 3)), np.empty((2, 3, 3)), np.empty(3), np.empty(3)
    for k in range(n):
        dt = edges[k + 1] - edges[k]
        for i in range(3):
            rate[i], force[i] = gyro[k, i] - x0[18 + i], acc[k, i] - x0[15 + i]
        _exp(back, -dt * rate[0], -dt * rate[1], -dt * rate[2])
        _step(R, p, v, back, force, dt, earth_n, gravity_n, work)
        out[k + 1, :9] = R.reshape(9)
        out[k + 1, 9:12] = p
        out[k + 1, 12:15] = v
        out[k + 1, 15:] = x0[15:]
    return out


@njit(cache=True)
def propagate(x0, first, last, edges, gyro, acc, psd_gyro, psd_acc, psd_bg, psd_ba, earth_n, gravity_n):
    """Predict from edge ``first`` to edge ``last``: state (21,), transition Phi (15, 15) and process noise Q (15, 15).

    ``psd_gyro`` (n,) and ``psd_acc`` (n,) are the white noise of each step [unit^2/Hz], ``psd_bg`` and
    ``psd_ba`` the bias random walks. Errors: d_rot' = -[w]x d_rot - d_bg - n_g, d_v' = -R [f]x d_rot - R d_ba - R n_a,
    d_p' = d_v; Groves (2013) ch. 14 with a right perturbation.
    """
    R, p, v = x0[:9].copy().reshape(3, 3), x0[9:12].copy(), x0[12:15].copy()
    Phi, Q, Q_other = np.eye(15), np.zeros((15, 15)), np.empty((15, 15))
    back, work, force, Rf = np.empty((3, 3)), np.empty((2, 3, 3)), np.empty(3), np.empty((3, 3))
    for k in range(first, last):
        dt = edges[k + 1] - edges[k]
        for i in range(3):
            force[i] = acc[k, i] - x0[15 + i]
        _exp(back, dt * (x0[18] - gyro[k, 0]), dt * (x0[19] - gyro[k, 1]), dt * (x0[20] - gyro[k, 2]))
        for i in range(3):  # R [f]x
            Rf[i, 0] = R[i, 1] * force[2] - R[i, 2] * force[1]
            Rf[i, 1] = R[i, 2] * force[0] - R[i, 0] * force[2]
            Rf[i, 2] = R[i, 0] * force[1] - R[i, 1] * force[0]
        _carry(Phi, back, Rf, R, dt)
        _carry(Q, back, Rf, R, dt)  # F Q F^T = F (F Q)^T, Q being symmetric
        for i in range(15):
            for j in range(15):
                Q_other[i, j] = Q[j, i]
        Q, Q_other = Q_other, Q
        _carry(Q, back, Rf, R, dt)
        ga, aa = psd_gyro[k], psd_acc[k]
        for i in range(3):
            Q[i, i] += ga * dt
            Q[3 + i, 3 + i] += aa * dt**3 / 3.0
            Q[6 + i, 6 + i] += aa * dt
            Q[3 + i, 6 + i] += aa * dt**2 / 2.0
            Q[6 + i, 3 + i] += aa * dt**2 / 2.0
            Q[9 + i, 9 + i] += psd_ba * dt
            Q[12 + i, 12 + i] += psd_bg * dt
        _step(R, p, v, back, force, dt, earth_n, gravity_n, work)
    x1 = x0.copy()
    x1[:9] = R.reshape(9)
    x1[9:12] = p
    x1[12:15] = v
    return x1, Phi, Q


@njit(cache=True)
def _carry(M, back, Rf, R, dt):
    """M <- F M of one step: F = [[back, 0, 0, 0, -dt], [-Rf dt^2/2, 1, dt, -R dt^2/2, 0], [-Rf dt, 0, 1, -R dt, 0], 1,
    1]."""
    half = 0.5 * dt * dt
    for i in range(3):
        a0, a1, a2, b0, b1, b2 = Rf[i, 0], Rf[i, 1], Rf[i, 2], R[i, 0], R[i, 1], R[i, 2]
        for j in range(15):
            force = a0 * M[0, j] + a1 * M[1, j] + a2 * M[2, j] + b0 * M[9, j] + b1 * M[10, j] + b2 * M[11, j]
            M[3 + i, j] += dt * M[6 + i, j] - half * force
            M[6 + i, j] -= dt * force
    for j in range(15):
        r0, r1, r2 = M[0, j], M[1, j], M[2, j]
        for i in range(3):
            M[i, j] = back[i, 0] * r0 + back[i, 1] * r1 + back[i, 2] * r2 - dt * M[12 + i, j]


@njit(cache=True)
def rotations(edges, gyro, bias_gyro):
    """Attitude by gyro alone at every edge relative to the first, (n + 1, 3, 3)."""
    out = np.empty((len(edges), 3, 3))
    out[0] = np.eye(3)
    for k in range(len(gyro)):
        out[k + 1] = _mul(out[k], exp_rotation((gyro[k] - bias_gyro) * (edges[k + 1] - edges[k])))
    return out


@njit(cache=True)
def correct_state(x: np.ndarray, d: np.ndarray) -> np.ndarray:
    """x (+) d: R Exp(d_rot), the rest additive; ``x`` (21 + e,), ``d`` (15 + e,)."""
    out = x.copy()
    out[:9] = _mul(x[:9].copy().reshape(3, 3), exp_rotation(d[:3])).reshape(9)
    out[9:] += d[3:]
    return out


@njit(cache=True)
def correct_states(x: np.ndarray, d: np.ndarray) -> np.ndarray:
    """``correct_state`` for n states: (n, 21 + e), (n, 15 + e)."""
    out = np.empty_like(x)
    for k in range(len(x)):
        out[k] = correct_state(x[k], d[k])
    return out


def correct_path(x: np.ndarray, d: np.ndarray) -> np.ndarray:
    """``correct_states`` to first order in ``d`` (n, 15 + e), along the path (n, 21 + e) from its first state on: the
    velocities and the steps from state to state change in b and turn with it, so that a path bends and keeps its form
    where additive positions would tear it."""
    out = correct_states(x, d)
    R, R_new = (states[:, :9].reshape(-1, 3, 3) for states in (x, out))

    def turned(vector_n: np.ndarray, change_n: np.ndarray, k: slice) -> np.ndarray:
        vector_b, change_b = (np.einsum("nji,nj->ni", R[k], v) for v in (vector_n, change_n))
        return np.einsum("nij,nj->ni", R_new[k], vector_b + change_b - np.cross(d[k, :3], vector_b))

    steps = turned(np.diff(x[:, 9:12], axis=0), np.diff(d[:, 3:6], axis=0), slice(None, -1))
    out[1:, 9:12] = out[0, 9:12] + np.cumsum(steps, axis=0)
    out[:, 12:15] = turned(x[:, 12:15], d[:, 6:9], slice(None))
    return out


@njit(cache=True)
def log_rotation(R: np.ndarray) -> np.ndarray:
    """Log of one rotation matrix (3, 3) -> (3,), norm at most pi; by the quaternion's largest part (Shepperd 1978)."""
    parts = np.array([R[0, 0] + R[1, 1] + R[2, 2], R[0, 0], R[1, 1], R[2, 2]])
    largest = np.argmax(parts)
    q = np.empty(4)  # w, x, y, z, times a common factor
    if largest == 0:
        q[0] = 1.0 + parts[0]
        q[1], q[2], q[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = 1.0 - parts[0] + 2.0 * R[i, i]
        q[1 + j], q[1 + k] = R[j, i] + R[i, j], R[k, i] + R[i, k]
    if q[0] < 0.0:
        q = -q
    sine = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    factor = 2.0 / q[0] if sine < 1e-12 * q[0] else 2.0 * np.arctan2(sine, q[0]) / sine
    return factor * q[1:]


@njit(cache=True)
def difference(x: np.ndarray, x0: np.ndarray) -> np.ndarray:
    """x (-) x0, the inverse of ``correct_states``: (n, 21 + e) each -> (n, 15 + e)."""
    out = np.empty((len(x), x.shape[1] - 6))
    for k in range(len(x)):
        R, R0 = x[k, :9].copy().reshape(3, 3), x0[k, :9].copy().reshape(3, 3)
        out[k, :3] = log_rotation(_mul(R0.T.copy(), R))
        out[k, 3:] = x[k, 9:] - x0[k, 9:]
    return out
