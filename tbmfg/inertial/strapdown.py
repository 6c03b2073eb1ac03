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
    """Exp of one rotation vector (3,) -> (3, 3); Rodrigues, series below 1e-4 rad."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if angle2 < 1e-8:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    x, y, z = w[0], w[1], w[2]
    out = np.empty((3, 3))
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[2, 2] = 1.0 - b * (x * x + y * y)
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x
    return out


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
def _apply(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.array(
        [
            A[0, 0] * x[0] + A[0, 1] * x[1] + A[0, 2] * x[2],
            A[1, 0] * x[0] + A[1, 1] * x[1] + A[1, 2] * x[2],
            A[2, 0] * x[0] + A[2, 1] * x[1] + A[2, 2] * x[2],
        ]
    )


@njit(cache=True)
def _mul_skew(A: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A [v]x, (3, 3)."""
    out = np.empty((3, 3))
    for i in range(3):
        out[i, 0] = A[i, 1] * v[2] - A[i, 2] * v[1]
        out[i, 1] = A[i, 2] * v[0] - A[i, 0] * v[2]
        out[i, 2] = A[i, 0] * v[1] - A[i, 1] * v[0]
    return out


@njit(cache=True)
def mechanise_step(R, p, v, rate, force, dt, earth_n, gravity_n):
    """One step with compensated rate and force (biases removed); returns R, p, v at its end.

    R' = Exp(-w_ie dt) R Exp(rate dt); v' = v + (Exp(-w_ie dt / 2) R f + g - 2 w_ie x v) dt; p' = p + (v + v') dt / 2:
    tbm_mse (9), (11), (12) with z up. ``force`` is resolved in b at the step's start, n turns on by half a step.
    """
    a = _apply(_mul(exp_rotation(-0.5 * dt * earth_n), R), force)
    ax = a[0] + gravity_n[0] - 2.0 * (earth_n[1] * v[2] - earth_n[2] * v[1])
    ay = a[1] + gravity_n[1] - 2.0 * (earth_n[2] * v[0] - earth_n[0] * v[2])
    az = a[2] + gravity_n[2] - 2.0 * (earth_n[0] * v[1] - earth_n[1] * v[0])
    v1 = np.array([v[0] + ax * dt, v[1] + ay * dt, v[2] + az * dt])
    p1 = p + 0.5 * dt * (v + v1)
    R1 = _mul(_mul(exp_rotation(-earth_n * dt), R), exp_rotation(rate * dt))
    return R1, p1, v1


@njit(cache=True)
def mechanise(x0, edges, gyro, acc, earth_n, gravity_n):
    """States at every edge, (n + 1, 21), from ``x0`` (21,) at the first; rates as from ``compensate``."""
    n = len(gyro)
    out = np.empty((n + 1, STATE))
    out[0] = x0
    R, p, v = x0[:9].copy().reshape(3, 3), x0[9:12].copy(), x0[12:15].copy()
    for k in range(n):
        dt = edges[k + 1] - edges[k]
        R, p, v = mechanise_step(R, p, v, gyro[k] - x0[18:21], acc[k] - x0[15:18], dt, earth_n, gravity_n)
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
    ba, bg = x0[15:18], x0[18:21]
    Phi, Q = np.eye(15), np.zeros((15, 15))
    for k in range(first, last):
        dt = edges[k + 1] - edges[k]
        rate, force = gyro[k] - bg, acc[k] - ba
        Rf = _mul_skew(R, force)  # R [f]x
        E = exp_rotation(-rate * dt)

        # F = [[E, 0, 0, 0, -dt], [-Rf dt^2/2, 1, dt, -R dt^2/2, 0], [-Rf dt, 0, 1, -R dt, 0], 1, 1] on both Phi and Q
        for pass_ in range(3):
            # pass 0: Phi <- F Phi; passes 1, 2: Q <- F (F Q)^T, Q being symmetric
            M = Phi if pass_ == 0 else Q
            for j in range(15):
                th0, th1, th2 = M[0, j], M[1, j], M[2, j]
                for i in range(3):
                    fv = Rf[i, 0] * th0 + Rf[i, 1] * th1 + Rf[i, 2] * th2
                    fa = R[i, 0] * M[9, j] + R[i, 1] * M[10, j] + R[i, 2] * M[11, j]
                    M[3 + i, j] += dt * M[6 + i, j] - 0.5 * dt * dt * (fv + fa)
                    M[6 + i, j] -= dt * (fv + fa)
                for i in range(3):
                    M[i, j] = E[i, 0] * th0 + E[i, 1] * th1 + E[i, 2] * th2 - dt * M[12 + i, j]
            if pass_ == 1:
                Q = Q.T.copy()
        ga, aa = psd_gyro[k], psd_acc[k]
        for i in range(3):
            Q[i, i] += ga * dt
            Q[3 + i, 3 + i] += aa * dt**3 / 3.0
            Q[6 + i, 6 + i] += aa * dt
            Q[3 + i, 6 + i] += aa * dt**2 / 2.0
            Q[6 + i, 3 + i] += aa * dt**2 / 2.0
            Q[9 + i, 9 + i] += psd_ba * dt
            Q[12 + i, 12 + i] += psd_bg * dt
        R, p, v = mechanise_step(R, p, v, rate, force, dt, earth_n, gravity_n)
    x1 = x0.copy()
    x1[:9] = R.reshape(9)
    x1[9:12] = p
    x1[12:15] = v
    return x1, Phi, Q


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
