"""How a LiDAR moves within and between scans, by gyro and odometer: motion compensation, and where a scan is sought."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from tbmfg.geometry import exp_so3, log_so3
from tbmfg.timeseries import Floats

SLIP = 0.1  # share of a step by odometer that may be wrong
FASTEST = 10.0  # m/s: what the speed may be that nothing tells
NODE_S = 0.002  # between the poses that a scan is carried with


@dataclass(frozen=True, slots=True)
class Inertia:
    """Attitude R_0b (n, 3, 3) of the body at ``t_s`` (n,), and its way in 0, (n, 3) m, or None without an odometer.

    0 is the body's frame at the first time, turned on by gyro alone. ``R_bl``, ``xyz`` mount the LiDAR.
    """

    t_s: Floats
    R_0b: Floats
    way_0: Floats | None
    R_bl: Floats
    xyz: Floats

    def poses(self, t_s: Floats, velocity_0: Floats, rate_l: Floats) -> tuple[Floats, Floats]:
        """The LiDAR's R_0l (m, 3, 3) and p_0l (m, 3) at ``t_s`` (m,); without an odometer at ``velocity_0`` m/s.

        ``rate_l`` rad/s, how it turned last, is for who has no gyro."""
        k = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self.t_s) - 1)
        k -= t_s - self.t_s[k - 1] < self.t_s[k] - t_s  # the nearest: an IMU period is shorter than a node
        R = self.R_0b[k]
        if self.way_0 is None:
            way = velocity_0 * (t_s - t_s[0])[:, None]
        else:
            way = np.stack([np.interp(t_s, self.t_s, self.way_0[:, axis]) for axis in range(3)], axis=1)
        return R @ self.R_bl, way + R @ self.xyz

    def slide(self, first_s: float, last_s: float) -> float:
        """How far off a predicted step may be, m."""
        if self.way_0 is None:
            return FASTEST * (last_s - first_s)
        ends = [[np.interp(t, self.t_s, self.way_0[:, axis]) for axis in range(3)] for t in (first_s, last_s)]
        return SLIP * float(np.linalg.norm(np.subtract(*ends)))


@dataclass(frozen=True, slots=True)
class Blind:
    """Nothing is known of the motion but its last step: a LiDAR alone."""

    def poses(self, t_s: Floats, velocity_0: Floats, rate_l: Floats) -> tuple[Floats, Floats]:
        """As :meth:`Inertia.poses`; 0 is the LiDAR's frame at the first time."""
        after = (t_s - t_s[0])[:, None]
        return exp_so3(rate_l * after), velocity_0 * after

    def slide(self, first_s: float, last_s: float) -> float:
        """As :meth:`Inertia.slide`."""
        return FASTEST * (last_s - first_s)


def compensate(
    points: Floats, t_s: Floats, reference_s: float, motion: Inertia | Blind, velocity_0: Floats, rate_l: Floats
) -> Floats:
    """Points (n, 3), taken at ``t_s`` (n,), as they would have been seen at ``reference_s``; tbm_mse (27)-(29)."""
    nodes = np.linspace(t_s.min(), t_s.max(), max(2, int(np.ceil(np.ptp(t_s) / NODE_S)) + 1))
    R, p = motion.poses(np.append(reference_s, nodes), velocity_0, rate_l)
    turn = log_so3(R[0].T @ R[1:])
    shift = (p[1:] - p[0]) @ R[0]
    return _carry(np.ascontiguousarray(points), (t_s - nodes[0]) / (nodes[1] - nodes[0]), turn, shift)


@njit(cache=True)
def _carry(points, at, turn, shift):
    """Exp(turn) p + shift, both linear between nodes; ``at`` (n,) counts nodes."""
    out = np.empty_like(points)
    last = len(turn) - 2
    for n in range(len(points)):
        k = min(max(int(at[n]), 0), last)
        s = at[n] - k
        w0 = turn[k, 0] + s * (turn[k + 1, 0] - turn[k, 0])
        w1 = turn[k, 1] + s * (turn[k + 1, 1] - turn[k, 1])
        w2 = turn[k, 2] + s * (turn[k + 1, 2] - turn[k, 2])
        x, y, z = points[n]
        angle2 = w0 * w0 + w1 * w1 + w2 * w2
        angle = np.sqrt(angle2)
        a = np.sin(angle) / angle if angle > 1e-6 else 1.0 - angle2 / 6.0
        b = (1.0 - np.cos(angle)) / angle2 if angle > 1e-6 else 0.5
        c0, c1, c2 = w1 * z - w2 * y, w2 * x - w0 * z, w0 * y - w1 * x
        out[n, 0] = x + a * c0 + b * (w1 * c2 - w2 * c1) + shift[k, 0] + s * (shift[k + 1, 0] - shift[k, 0])
        out[n, 1] = y + a * c1 + b * (w2 * c0 - w0 * c2) + shift[k, 1] + s * (shift[k + 1, 1] - shift[k, 1])
        out[n, 2] = z + a * c2 + b * (w0 * c1 - w1 * c0) + shift[k, 2] + s * (shift[k + 1, 2] - shift[k, 2])
    return out
