"""Attitude algebra of the shaft boring machine's filters: Euler angles and quaternions of its paper (compiled).

Wang et al., Sensors 2019, 19, 5007, corrected; (n) are its equations, S its errata. r has X along magnetic north, Y to
the right, Z down; the machine a is forward-right-down. Angles are roll alpha, pitch beta, yaw gamma [rad]; C_ra takes
r to a, C_ar back; a quaternion q is that of C_ar, Hamilton's, scalar first.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def rotation_ra(angles):
    """(1) C_ra = Rx(alpha) Ry(beta) Rz(gamma), passive; (3,) -> (3, 3)."""
    sa, sb, sg = np.sin(angles[0]), np.sin(angles[1]), np.sin(angles[2])
    ca, cb, cg = np.cos(angles[0]), np.cos(angles[1]), np.cos(angles[2])
    return np.array(
        [
            [cb * cg, cb * sg, -sb],
            [sa * sb * cg - ca * sg, sa * sb * sg + ca * cg, sa * cb],
            [ca * sb * cg + sa * sg, ca * sb * sg - sa * cg, ca * cb],
        ]
    )


@njit(cache=True)
def angles_of(C_ar):
    """(4), (5) by atan2 (S2), yaw in (-pi, pi]; (3, 3) -> (3,)."""
    return np.array(
        [
            np.arctan2(C_ar[2, 1], C_ar[2, 2]),
            np.arcsin(min(1.0, max(-1.0, -C_ar[2, 0]))),
            np.arctan2(C_ar[1, 0], C_ar[0, 0]),
        ]
    )


@njit(cache=True)
def euler_rates(alpha, beta):
    """(6) E with [alpha', beta', gamma'] = E omega_a, (3, 3); singular at 90 degrees of pitch."""
    sa, ca, cb, tb = np.sin(alpha), np.cos(alpha), np.cos(beta), np.tan(beta)
    return np.array([[1.0, sa * tb, ca * tb], [0.0, ca, -sa], [0.0, sa / cb, ca / cb]])


@njit(cache=True)
def rotation_ar(q):
    """(8) C_ar; (4,) -> (3, 3)."""
    w, x, y, z = q
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


@njit(cache=True)
def quaternion(angles):
    """(10) with roll and pitch in their places (S3); (3,) -> (4,)."""
    sa, sb, sg = np.sin(angles[0] / 2), np.sin(angles[1] / 2), np.sin(angles[2] / 2)
    ca, cb, cg = np.cos(angles[0] / 2), np.cos(angles[1] / 2), np.cos(angles[2] / 2)
    return np.array(
        [
            ca * cb * cg + sa * sb * sg,
            sa * cb * cg - ca * sb * sg,
            ca * sb * cg + sa * cb * sg,
            ca * cb * sg - sa * sb * cg,
        ]
    )


@njit(cache=True)
def product(p, q):
    """Hamilton's product of quaternions (4,)."""
    return np.array(
        [
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        ]
    )


@njit(cache=True)
def quaternion_rate(q, omega):
    """(11) q' = 1/2 q (x) [0, omega], omega (3,) in a."""
    return 0.5 * product(q, np.array([0.0, omega[0], omega[1], omega[2]]))


@njit(cache=True)
def advance(q, omega, T):
    """q (x) exp(1/2 omega T): exact for a constant rate; then normalised."""
    half = 0.5 * T * omega
    angle = np.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    s = 1.0 - angle**2 / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    q1 = product(q, np.array([np.cos(angle), s * half[0], s * half[1], s * half[2]]))
    return q1 / np.sqrt(np.sum(q1 * q1))


@njit(cache=True)
def advance_rk4(q, omega_0, omega_1, omega_2, T):
    """(12) Runge-Kutta over h = 2 T with the rates at t, t + T and t + 2 T (S5); then normalised (18)."""
    K1 = quaternion_rate(q, omega_0)
    K2 = quaternion_rate(q + T * K1, omega_1)
    K3 = quaternion_rate(q + T * K2, omega_1)
    K4 = quaternion_rate(q + 2.0 * T * K3, omega_2)
    q1 = q + T / 3.0 * (K1 + 2.0 * K2 + 2.0 * K3 + K4)
    return q1 / np.sqrt(np.sum(q1 * q1))


@njit(cache=True)
def gravity_in_a(q):
    """(16) C_ra [0, 0, 1] with a plus in its second element (S11); (4,) -> (3,)."""
    w, x, y, z = q
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])


@njit(cache=True)
def field_in_a(q, h_n, h_d):
    """(17) C_ra [h_n, 0, h_d]; (4,) -> (3,)."""
    return h_n * rotation_ar(q)[0] + h_d * gravity_in_a(q)


@njit(cache=True)
def measured_angles(a_s, m_s):
    """(15) from accelerometer and magnetometer, (n, 3) each -> (n, 3), NaN where they are.

    a_s = -f, +g on Z at rest, as the paper has it (S8); arctan2 throughout (S10); the yaw's sign corrected (S9).
    """
    out = np.empty_like(a_s)
    for k in range(len(a_s)):
        ax, ay, az = a_s[k]
        mx, my, mz = m_s[k]
        alpha, beta = np.arctan2(ay, az), np.arctan2(-ax, np.hypot(ay, az))
        across = my * np.cos(alpha) - mz * np.sin(alpha)
        ahead = mx * np.cos(beta) + (my * np.sin(alpha) + mz * np.cos(alpha)) * np.sin(beta)
        out[k] = alpha, beta, np.arctan2(-across, ahead)
    return out
