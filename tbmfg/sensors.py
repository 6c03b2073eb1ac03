"""What each sensor should read: one model per sensor, shared by the filter and the factor graph.

A model takes n rows at once: measured values ``z``, auxiliary ``data``, the states ``xi`` (n, 21 + e)
and ``xj`` (the same array for a measurement at one time), and the sensor's own calibrations ``c``.
It returns the residual h(x) - z, (n, k), and its Jacobians to the error states at i and j, (n, k, 15 + e),
and to ``c``, (n, k, len(c)). States as in ``inertial.strapdown``, followed by e drifting
calibrations. Compiled, so that one row in a filter costs microseconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from tbmfg.geometry import exp_so3, log_so3, skew
from tbmfg.timeseries import Floats


@njit(cache=True)
def _rotate(x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """R v for a packed state."""
    return np.array(
        [
            x[0] * v[0] + x[1] * v[1] + x[2] * v[2],
            x[3] * v[0] + x[4] * v[1] + x[5] * v[2],
            x[6] * v[0] + x[7] * v[1] + x[8] * v[2],
        ]
    )


@njit(cache=True)
def _unrotate(x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """R^T v for a packed state."""
    return np.array(
        [
            x[0] * v[0] + x[3] * v[1] + x[6] * v[2],
            x[1] * v[0] + x[4] * v[1] + x[7] * v[2],
            x[2] * v[0] + x[5] * v[1] + x[8] * v[2],
        ]
    )


@njit(cache=True)
def _wrapped(angle):
    """The same angle within half a turn of 0."""
    return angle - 2.0 * np.pi * np.round(angle / (2.0 * np.pi))


@njit(cache=True)
def _add_minus_R_skew(J: np.ndarray, x: np.ndarray, v: np.ndarray, scale: float) -> None:
    """J += scale * d(R v)/d_rot = -scale R [v]x, in place; J (3, 3)."""
    for a in range(3):
        r0, r1, r2 = x[3 * a], x[3 * a + 1], x[3 * a + 2]
        J[a, 0] -= scale * (r1 * v[2] - r2 * v[1])
        J[a, 1] -= scale * (r2 * v[0] - r0 * v[2])
        J[a, 2] -= scale * (r0 * v[1] - r1 * v[0])


@njit(cache=True)
def prism(z, data, xi, xj, c):
    """Prism (or antenna) position in n at the true time of the fix.

    z (3): position [m]. data (5): lag of the fix behind its keyframe [s], angular rate in b [rad/s], time t of the fix.
    c (5): lever arm in b [m], clock offset [s] and drift [s/s] in excess of those the keyframes were placed with.
    h = p + R l + (v + R (w x l)) (lag - offset - drift t): the last term is first order in a few milliseconds.
    """
    n, d = len(z), xi.shape[1] - 6
    r, Ji, Jc = np.empty((n, 3)), np.zeros((n, 3, d)), np.zeros((n, 3, 5))
    arm = c[:3]
    for k in range(n):
        x, lag, w = xi[k], data[k, 0] - c[3] - c[4] * data[k, 4], data[k, 1:4]
        sweep = np.array([w[1] * arm[2] - w[2] * arm[1], w[2] * arm[0] - w[0] * arm[2], w[0] * arm[1] - w[1] * arm[0]])
        lever = _rotate(x, arm + sweep * lag)
        velocity = x[12:15] + _rotate(x, sweep)
        _add_minus_R_skew(Ji[k, :, 0:3], x, arm + sweep * lag, 1.0)
        for a in range(3):
            r[k, a] = x[9 + a] + lever[a] + x[12 + a] * lag - z[k, a]
            Ji[k, a, 3 + a] = 1.0
            Ji[k, a, 6 + a] = lag
            Jc[k, a, 3] = -velocity[a]
            Jc[k, a, 4] = -velocity[a] * data[k, 4]
            for b in range(3):
                Jc[k, a, b] = x[3 * a + b]
        _add_minus_R_skew(Jc[k, :, 0:3], x, w, -lag)
    return r, Ji, np.zeros((n, 3, 0)), Jc


@njit(cache=True)
def _into_wheel(c: np.ndarray):
    """E^T for the wheel's axes E = Rz(yaw) Ry(pitch) in b, its derivatives to yaw and pitch; c: scale, yaw, pitch."""
    cy, sy, cp, sp = np.cos(c[1]), np.sin(c[1]), np.cos(c[2]), np.sin(c[2])
    Et = np.array([[cy * cp, sy * cp, -sp], [-sy, cy, 0.0], [cy * sp, sy * sp, cp]])
    by_yaw = np.array([[-sy * cp, cy * cp, 0.0], [-cy, -sy, 0.0], [-sy * sp, cy * sp, 0.0]])
    by_pitch = np.array([[-cy * sp, -sy * sp, -cp], [0.0, 0.0, 0.0], [cy * cp, sy * cp, -sp]])
    return Et, by_yaw, by_pitch


@njit(cache=True)
def odometer(z, data, xi, xj, c):
    """Displacement of the contact point over an interval, in the wheel's axes at its start.

    z (3): D = sum E^T R_i^T R(t) E e_x v dt over the indicated speed v. data (12): the contact point's arm l in b,
    B = sum R_i^T R(t) E e_x v (t - t_i) dt, the gyro bias b_0 that both were computed with, and D~, which is D with
    the speed smoothed over seconds. c (3): scale s, mounting yaw and pitch [rad], E = Rz(yaw) Ry(pitch).
    h = E^T (u - [B]x (b_g - b_0)) + s / (1 + s) D~, u = R_i^T (p_j + R_j l - p_i) - l; no sliding sideways, no
    lifting. Multiplied onto u or D instead, the body's vibration or the odometer's noise would pass for scale
    (errors in variables); D~ holds next to nothing of either.
    """
    n, d = len(z), xi.shape[1] - 6
    r, Ji, Jj, Jc = np.empty((n, 3)), np.zeros((n, 3, d)), np.zeros((n, 3, d)), np.zeros((n, 3, 3))
    Et, Et_yaw, Et_pitch = _into_wheel(c)
    share = c[0] / (1.0 + c[0])
    for k in range(n):
        x, y, arm, B = xi[k], xj[k], data[k, :3], data[k, 3:6]
        whole = _unrotate(x, y[9:12] + _rotate(y, arm) - x[9:12])
        bias = x[18:21] - data[k, 6:9]
        drift = np.array(
            [B[1] * bias[2] - B[2] * bias[1], B[2] * bias[0] - B[0] * bias[2], B[0] * bias[1] - B[1] * bias[0]]
        )
        way = whole - arm - drift
        turn_i = np.array([[0.0, -whole[2], whole[1]], [whole[2], 0.0, -whole[0]], [-whole[1], whole[0], 0.0]])
        skew_B = np.array([[0.0, -B[2], B[1]], [B[2], 0.0, -B[0]], [-B[1], B[0], 0.0]])
        turn_n, turn_j = np.zeros((3, 3)), np.zeros((3, 3))
        _add_minus_R_skew(turn_n, y, arm, 1.0)
        for b in range(3):
            turn_j[:, b] = _unrotate(x, turn_n[:, b])
        for a in range(3):
            r[k, a] = share * data[k, 9 + a] - z[k, a]
            Jc[k, a, 0] = data[k, 9 + a] / (1.0 + c[0]) ** 2
            for q in range(3):
                r[k, a] += Et[a, q] * way[q]
                Jc[k, a, 1] += Et_yaw[a, q] * way[q]
                Jc[k, a, 2] += Et_pitch[a, q] * way[q]
                for b in range(3):
                    Ji[k, a, b] += Et[a, q] * turn_i[q, b]
                    Jj[k, a, b] += Et[a, q] * turn_j[q, b]
                    Ji[k, a, 3 + b] -= Et[a, q] * x[3 * b + q]
                    Jj[k, a, 3 + b] += Et[a, q] * x[3 * b + q]
                    Ji[k, a, 12 + b] -= Et[a, q] * skew_B[q, b]
    return r, Ji, Jj, Jc


@njit(cache=True)
def wheel(z, data, xi, xj, c):
    """Velocity of the odometer's contact point in the wheel's axes: forward as indicated, none sideways or upwards.

    z (1): indicated speed [m/s]. data (7): the contact point's arm l in b, the angular rate w in b as measured, and z~,
    the speed smoothed over seconds. c (3): scale s, mounting yaw and pitch [rad], E = Rz(yaw) Ry(pitch).
    r = E^T (R^T v + (w - b_g) x l) - [z - s / (1 + s) z~, 0, 0]: shearer (7), (8), (11) turned from n into the wheel's
    axes, where the noise R_1 is diagonal. For z~ see ``odometer``; the paper has z, whose noise passes for scale.
    """
    n, d = len(z), xi.shape[1] - 6
    r, Ji, Jc = np.zeros((n, 3)), np.zeros((n, 3, d)), np.zeros((n, 3, 3))
    Et, Et_yaw, Et_pitch = _into_wheel(c)
    for k in range(n):
        x, arm, w = xi[k], data[k, :3], data[k, 3:6] - xi[k, 18:21]
        u = _unrotate(x, x[12:15])
        turn_u = np.array([[0.0, -u[2], u[1]], [u[2], 0.0, -u[0]], [-u[1], u[0], 0.0]])
        skew_arm = np.array([[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]])
        for q in range(3):
            contact = u[q] - (skew_arm[q, 0] * w[0] + skew_arm[q, 1] * w[1] + skew_arm[q, 2] * w[2])
            for a in range(3):
                r[k, a] += Et[a, q] * contact
                Jc[k, a, 1] += Et_yaw[a, q] * contact
                Jc[k, a, 2] += Et_pitch[a, q] * contact
                for b in range(3):
                    Ji[k, a, b] += Et[a, q] * turn_u[q, b]
                    Ji[k, a, 6 + b] += Et[a, q] * x[3 * b + q]
                    Ji[k, a, 12 + b] += Et[a, q] * skew_arm[q, b]
        r[k, 0] += c[0] / (1.0 + c[0]) * data[k, 6] - z[k, 0]
        Jc[k, 0, 0] = data[k, 6] / (1.0 + c[0]) ** 2
    return r, Ji, np.zeros((n, 3, 0)), Jc


@njit(cache=True)
def magnetometer(z, data, xi, xj, c):
    """Direction of the horizontal magnetic field, an angle in n: steel bends the vertical component most.

    z (3): field in b, with the machine's own subtracted; data (1): angle of magnetic north in n [rad]. c (.): first the
    error of the declination, east positive [rad]. The full vector is rotated by the estimated attitude, so that a tilt
    error couples in with tan(dip): shearer (23), erratum H9.
    """
    n, d = len(z), xi.shape[1] - 6
    r, Ji, Jc = np.empty((n, 1)), np.zeros((n, 1, d)), np.zeros((n, 1, len(c)))
    for k in range(n):
        h, turn = _rotate(xi[k], z[k]), np.zeros((3, 3))
        _add_minus_R_skew(turn, xi[k], z[k], 1.0)
        r[k, 0], Jc[k, 0, 0] = _wrapped(np.arctan2(h[1], h[0]) - data[k, 0] + c[0]), 1.0
        for b in range(3):
            Ji[k, 0, b] = (h[0] * turn[1, b] - h[1] * turn[0, b]) / (h[0] * h[0] + h[1] * h[1])
    return r, Ji, np.zeros((n, 1, 0)), Jc


@njit(cache=True)
def magnetic_field(z, data, xi, xj, c):
    """Direction of the horizontal magnetic field, against that of the Earth's and the machine's own, to be found.

    z (3): field in b [T]. data (11): angle of magnetic north in n [rad], then C (9, row by row), which takes the own
    field from the sensor's axes, microtesla, to what it adds to z, then the length [T] that counts as one. c (5): error
    of the declination [rad], what of the own field is not yet subtracted, and the Earth's horizontal field H
    [microtesla]. With h measured and p the sum of both fields, horizontally, the residual is the angle from p to h
    times |h|.

    Noise turns a long field less than a short one, hence |h|: of what was measured. Taken off the measurement, the own
    field would be favoured that makes the rest long; and noise would get into what tells it from the declination, which
    on a machine that turns little is not much.
    """
    n, d = len(z), xi.shape[1] - 6
    r, Ji, Jc = np.empty((n, 1)), np.zeros((n, 1, d)), np.empty((n, 1, 5))
    H = 1e-6 * c[4]
    for k in range(n):
        north, C, one = data[k, 0] - c[0], data[k, 1:10].copy().reshape(3, 3), data[k, 10]
        own = C @ c[1:4]
        h, p, turn, turn_p = _rotate(xi[k], z[k]), _rotate(xi[k], own), np.zeros((3, 3)), np.zeros((3, 3))
        _add_minus_R_skew(turn, xi[k], z[k], 1.0)
        _add_minus_R_skew(turn_p, xi[k], own, 1.0)
        p[0] += H * np.cos(north)
        p[1] += H * np.sin(north)
        length, square = np.sqrt(h[0] * h[0] + h[1] * h[1]), p[0] * p[0] + p[1] * p[1]
        share, angle = length / one, _wrapped(np.arctan2(h[1], h[0]) - np.arctan2(p[1], p[0]))
        r[k, 0] = share * angle
        Jc[k, 0, 0] = share * H * (p[0] * np.cos(north) + p[1] * np.sin(north)) / square
        Jc[k, 0, 4] = -share * 1e-6 * (p[0] * np.sin(north) - p[1] * np.cos(north)) / square
        for b in range(3):
            part = _rotate(xi[k], C[:, b])
            Jc[k, 0, 1 + b] = -share * (p[0] * part[1] - p[1] * part[0]) / square
            turned = (h[0] * turn[1, b] - h[1] * turn[0, b]) / (length * length)
            turned -= (p[0] * turn_p[1, b] - p[1] * turn_p[0, b]) / square
            longer = (h[0] * turn[0, b] + h[1] * turn[1, b]) / (length * one)
            Ji[k, 0, b] = share * turned + longer * angle
    return r, Ji, np.zeros((n, 1, 0)), Jc


@njit(cache=True)
def barometer(z, data, xi, xj, c):
    """Pressure height: h = z + s (z - z_0) + l / 2T ((z - z_m)^2 - (z_0 - z_m)^2) + bias with z = p_z + v_z lag.

    z (1) [m]; data (4): mean lag [s], index of the bias among the drifting calibrations, z_0 [m] at which the bias is
    counted, z_m at which the scale holds; c (2): scale s, the air's density against the one that pressure was turned
    into height with, and l [K/m], by how much faster it cools with height. T is 288.15 K.
    """
    n, d = len(z), xi.shape[1] - 6
    r, Ji, Jc = np.empty((n, 1)), np.zeros((n, 1, d)), np.empty((n, 1, 2))
    for k in range(n):
        x, drift = xi[k], int(data[k, 1])
        height = x[11] + x[14] * data[k, 0]
        off, begin = height - data[k, 3], data[k, 2] - data[k, 3]
        Jc[k, 0, 0], Jc[k, 0, 1] = height - data[k, 2], (off * off - begin * begin) / (2.0 * 288.15)
        r[k, 0] = height + c[0] * Jc[k, 0, 0] + c[1] * Jc[k, 0, 1] + x[21 + drift] - z[k, 0]
        slope = 1.0 + c[0] + c[1] * off / 288.15
        Ji[k, 0, 5], Ji[k, 0, 8], Ji[k, 0, 15 + drift] = slope, slope * data[k, 0], 1.0
    return r, Ji, np.zeros((n, 1, 0)), Jc


@njit(cache=True)
def laser(z, data, xi, xj, c):
    """Spot on a detector, where the laser's line meets the detector's plane; in the detector's x and y.

    z (2): spot [m]. data (13): mean lag behind the keyframe [s], fall g lag^2 / 2 in it [m] (z of n), the detector's
    origin l and axes e_x, e_y in b, carried by the IMU over the lag, and x, y of n where the line passes z = 0.
    c (4): tilt (t_x, t_y) of the line, direction k = (t_x, t_y, 1); zero of the reading in the detector's axes [m].
    With o = p + v lag + fall + R l, normal m = e_x x e_y and the line at q + s k: m . R^T (q + s k - o) = 0, and
    h = (e_x, e_y) . R^T (q + s k - o) + zero.
    """
    n, d = len(z), xi.shape[1] - 6
    r, Ji, Jc = np.empty((n, 2)), np.zeros((n, 2, d)), np.zeros((n, 2, 4))
    k_n = np.array([c[0], c[1], 1.0])
    for row in range(n):
        x, lag, arm = xi[row], data[row, 0], data[row, 2:5]
        e_x, e_y = data[row, 5:8], data[row, 8:11]
        m = np.cross(e_x, e_y)
        down = x[9:12] + x[12:15] * lag
        down[2] += data[row, 1]
        down[:2] -= data[row, 11:13]
        from_line_b = _unrotate(x, down) + arm  # o - q
        k_b = _unrotate(x, k_n)
        s = (m @ from_line_b) / (m @ k_b)
        w = s * k_b - from_line_b
        for a in range(2):
            e = e_x if a == 0 else e_y
            share = (e @ k_b) / (m @ k_b)
            across = share * m - e  # what a shift of the detector does to the reading, in b
            turn = np.cross(e, w) - share * np.cross(m, w) + np.cross(arm, across)
            across_n = _rotate(x, across)
            r[row, a] = e @ w + c[2 + a] - z[row, a]
            for b in range(3):
                Ji[row, a, b], Ji[row, a, 3 + b], Ji[row, a, 6 + b] = turn[b], across_n[b], across_n[b] * lag
            Jc[row, a, 0], Jc[row, a, 1], Jc[row, a, 2 + a] = -s * across_n[0], -s * across_n[1], 1.0
    return r, Ji, np.zeros((n, 2, 0)), Jc


@njit(cache=True)
def _direct(z, xi, state, error):
    """Residual and Jacobians of z (k), the state's own numbers from ``state`` on, at ``error`` in the error state."""
    n, k = z.shape
    Ji = np.zeros((n, k, xi.shape[1] - 6))
    for a in range(k):
        Ji[:, a, error + a] = 1.0
    return xi[:, state : state + k] - z, Ji, np.zeros((n, k, 0)), np.zeros((n, k, 0))


@njit(cache=True)
def position(z, data, xi, xj, c):
    """Position of b in n [m]: z (3), a surveyed point."""
    return _direct(z, xi, 9, 3)


@njit(cache=True)
def velocity(z, data, xi, xj, c):
    """Velocity in n [m/s]: z (3); zero while the machine stands."""
    return _direct(z, xi, 12, 6)


def rotation(z, data, xi, xj, c):
    """No turn between two keyframes while the machine stands: r = Log(R_i^T R_j). z (0), data (0), c (0)."""
    n, d = len(xi), xi.shape[1] - 6
    R = xi[:, :9].reshape(n, 3, 3).swapaxes(1, 2) @ xj[:, :9].reshape(n, 3, 3)
    turn = log_so3(R)
    half = np.eye(3) + 0.5 * skew(turn) + skew(turn) @ skew(turn) / 12  # of Log, to the second order
    Ji, Jj = np.zeros((n, 3, d)), np.zeros((n, 3, d))
    Ji[:, :, :3], Jj[:, :, :3] = -half @ R.swapaxes(1, 2), half
    return turn, Ji, Jj, np.zeros((n, 3, 0))


@njit(cache=True)
def bounded(z, data, xi, xj, c):
    """A body that stays near a place: z (6): centre in n [m], then zero velocity [m/s]."""
    return _direct(z, xi, 9, 3)


def lidar(z, data, xi, xj, c):
    """Pose of a LiDAR at one scan as seen from the scan before, whitened by the square root of its information.

    z (12): R (9, row by row) and p [m]. data (71): for the scans at i and j how the body moves on from its keyframe to
    the scan, a time dt, s (3) in b with p + v dt + R s, and a rotation C (9); then the mounting's known rotation
    R_bl (9) and the root S (36). c (6): LiDAR in b [m], and a rotation vector d: its axes are R_bl Exp(d).
    r = S [Log(R^T R_h), R^T (p_h - p)]: the error of the pose at j as a right perturbation.
    """
    n, d = len(z), xi.shape[1] - 6
    R_bl = data[:, 26:35].reshape(n, 3, 3) @ exp_so3(c[3:])
    ends = []
    for x, own in ((xi, data[:, :13]), (xj, data[:, 13:26])):
        R, s, C = x[:, :9].reshape(n, 3, 3), own[:, 1:4], own[:, 4:].reshape(n, 3, 3)
        carried = R @ C
        at = x[:, 9:12] + x[:, 12:15] * own[:, :1] + (R @ s[:, :, None])[:, :, 0] + carried @ c[:3]
        # what a turn of the keyframe does to the LiDAR: its axes by C_l, its place by lever
        C_l = (C @ R_bl).swapaxes(1, 2)
        lever = -R @ (skew(s) + skew(C @ c[:3]))
        ends.append((carried @ R_bl, at, own[:, :1, None], C_l, lever, carried))
    (R_li, p_i, dt_i, C_i, lever_i, A_i), (R_lj, p_j, dt_j, C_j, lever_j, A_j) = ends
    to_i, Z = R_li.swapaxes(1, 2), z[:, :9].reshape(n, 3, 3).swapaxes(1, 2)
    R_h, p_h = to_i @ R_lj, (to_i @ (p_j - p_i)[:, :, None])[:, :, 0]
    turn = log_so3(Z @ R_h)
    back, Z_to_i = R_h.swapaxes(1, 2), Z @ to_i
    half = np.eye(3) + 0.5 * skew(turn) + skew(turn) @ skew(turn) / 12  # of Log, to the second order

    e = np.hstack([turn, (Z @ (p_h - z[:, 9:])[:, :, None])[:, :, 0]])
    Ji, Jj, Jc = np.zeros((n, 6, d)), np.zeros((n, 6, d)), np.zeros((n, 6, 6))
    Ji[:, :3, :3] = -half @ back @ C_i
    Ji[:, 3:, :3] = Z @ skew(p_h) @ C_i - Z_to_i @ lever_i
    Ji[:, 3:, 3:6], Ji[:, 3:, 6:9] = -Z_to_i, -Z_to_i * dt_i
    Jj[:, :3, :3] = half @ C_j
    Jj[:, 3:, :3] = Z_to_i @ lever_j
    Jj[:, 3:, 3:6], Jj[:, 3:, 6:9] = Z_to_i, Z_to_i * dt_j
    onto = np.eye(3) - 0.5 * skew(c[3:])  # of Exp, to the first order: mountings are known to degrees
    Jc[:, 3:, :3] = Z_to_i @ (A_j - A_i)
    Jc[:, :3, 3:] = half @ (np.eye(3) - back) @ onto
    Jc[:, 3:, 3:] = Z @ skew(p_h) @ onto
    S = data[:, 35:].reshape(n, 6, 6)
    return (S @ e[:, :, None])[:, :, 0], S @ Ji, S @ Jj, S @ Jc


@njit(cache=True)
def _whiten(r, Ji, Jj, Jc, sigma):
    """Divide residuals (n, k) and Jacobians (n, k, .) by ``sigma`` (n, k), in place."""
    for n in range(r.shape[0]):
        for k in range(r.shape[1]):
            r[n, k] /= sigma[n, k]
            Ji[n, k] /= sigma[n, k]
            Jj[n, k] /= sigma[n, k]
            Jc[n, k] /= sigma[n, k]


MODELS: dict[str, Callable] = {
    f.__name__: f
    for f in (
        *(prism, odometer, wheel, magnetometer, magnetic_field, barometer, laser, position, velocity, rotation),
        *(bounded, lidar),
    )
}


@dataclass(frozen=True, slots=True)
class Rows:
    """Measurements of one sensor: row r links keyframes ``i[r]`` and ``j[r]`` (equal for one time), i in order.
    For filters that take every sample when it comes they are IMU edges in place of keyframes.

    ``z`` (n, .), ``data`` (n, .) as the model wants them; ``sigma`` (n, k); ``calib`` where the sensor's calibrations
    lie in the calibration vector; ``samples`` (n,) messages behind each row; ``loss`` none, huber or cauchy.
    """

    sensor: str
    model: str
    i: np.ndarray
    j: np.ndarray
    z: Floats
    data: Floats
    sigma: Floats
    calib: slice
    samples: np.ndarray
    loss: str = "none"

    def __len__(self) -> int:
        return len(self.i)

    @property
    def dof(self) -> int:
        return self.sigma.shape[1]

    def between(self, first: int, last: int, out: np.ndarray) -> Rows:
        """The rows on keyframes ``first`` to ``last`` alone, counted from ``first``, without those in ``out`` (n,)."""
        own = slice(np.searchsorted(self.i, first), np.searchsorted(self.j, last, side="right"))
        if out[own].any():
            own = np.arange(own.start, own.stop)[~out[own]]
        parts = (self.z[own], self.data[own], self.sigma[own], self.calib, self.samples[own], self.loss)
        return Rows(self.sensor, self.model, self.i[own] - first, self.j[own] - first, *parts)

    def evaluate(self, x: Floats, c: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Whitened residuals and Jacobians at the keyframe states ``x`` (N, 21 + e) and calibrations ``c``."""
        return self.evaluate_at(x[self.i], x[self.j], c)

    def evaluate_at(
        self, xi: Floats, xj: Floats, c: Floats, rows: slice = slice(None)
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """The same for the given rows, whose states are given one by one."""
        parts = MODELS[self.model](self.z[rows], self.data[rows], xi, xj, c[self.calib])
        _whiten(*parts, self.sigma[rows])
        return parts
