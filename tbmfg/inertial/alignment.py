"""Where the machine starts: still stretches, gyro bias, levelling, and heading from a position sensor's motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tbmfg.geometry import level, rotation_z
from tbmfg.inertial.steps import Steps
from tbmfg.inertial.strapdown import rotations
from tbmfg.timeseries import Floats

BLOCK_S = 1.0  # stillness is judged on means over this time, so that vibration averages out
STILL_RATE = 3e-3  # rad/s: change of the mean rate from block to block
STILL_FORCE = 0.05  # m/s^2: change of the mean specific force from block to block
SHORTEST_BLOCKS = 3


def still_intervals(steps: Steps) -> list[tuple[float, float]]:
    """Stretches (start, end) in s in which neither the mean rate nor the mean specific force changes.

    A body at constant velocity looks the same: only a position sensor or an odometer can confirm rest.
    """
    size = max(1, round(BLOCK_S / steps.period_s))
    count = len(steps) // size
    if count < SHORTEST_BLOCKS:
        return []
    gyro = steps.gyro[: count * size].reshape(count, size, 3).mean(axis=1)
    acc = steps.acc[: count * size].reshape(count, size, 3).mean(axis=1)
    steady = (np.linalg.norm(np.diff(gyro, axis=0), axis=1) < STILL_RATE) & (
        np.linalg.norm(np.diff(acc, axis=0), axis=1) < STILL_FORCE
    )
    edges = np.flatnonzero(np.diff(np.concatenate([[0], steady.astype(int), [0]])))
    found = []
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first + 1 >= SHORTEST_BLOCKS:
            found.append((float(steps.edges_s[first * size]), float(steps.edges_s[min((last + 1) * size, len(steps))])))
    return found


def rows_between(steps: Steps, start_s: float, end_s: float) -> slice:
    """Steps that lie inside start..end."""
    return slice(int(np.searchsorted(steps.edges_s, start_s)), int(np.searchsorted(steps.edges_s, end_s)) - 1)


def level_at_start(steps: Steps, R_0t: Floats, still: list[tuple[float, float]], window_s: float = 20.0) -> Floats:
    """R_nb at the first edge with zero turn about the vertical, (3, 3).

    The specific force, carried to the first edge by the gyro (``R_0t`` (n + 1, 3, 3)), is averaged over the
    first still stretch, or over the first ``window_s``: there the error is change of velocity / (g x window).
    """
    start, end = next(((s, e) for s, e in still if s < 60.0), (0.0, window_s))
    rows = rows_between(steps, start, end)
    return level(np.einsum("tij,tj->ti", R_0t[:-1][rows], steps.acc[rows]).mean(axis=0))


def gyrocompass(
    steps: Steps, R_0t: Floats, still: list[tuple[float, float]], R_level: Floats, earth_n: Floats
) -> float:
    """Turn about the vertical [rad] from the levelled start frame to n: still, it feels Earth's rate only."""
    rows = rows_between(steps, *max(still, key=lambda s: s[1] - s[0]))
    felt = R_level @ R_0t[rows.start] @ mean_rate(steps, rows)
    return float(np.arctan2(earth_n[1], earth_n[0]) - np.arctan2(felt[1], felt[0]))


def mean_rate(steps: Steps, rows: slice) -> Floats:
    """Mean rate of a shaking body that stays where it is, (3,) rad/s.

    Under a Hann window, which a vibration that does not end with its stretch hardly leaks through. And it is the
    rotation vector phi that comes back, whose rate is w + phi x w / 2: the mean of w alone errs by the coning, which
    for 0.5 deg/s at 24.5 Hz about two axes is a tenth of a degree of heading. First order in phi.
    """
    rate, dt = steps.gyro[rows], steps.dt_of(rows)[:, None]
    weight = np.sin(np.pi * (np.arange(len(rate)) + 0.5) / len(rate)) ** 2
    weight /= weight.sum()
    mean = weight @ rate
    phi = np.cumsum((rate - mean) * dt, axis=0)
    return mean + 0.5 * weight @ np.cross(phi - weight @ phi, rate - mean)


def gyrocompass_bound(gyro_bias_sd: float, earth_n: Floats) -> float:
    """Least sd of a gyrocompass heading [rad]: bias / (w_ie cos latitude); infinite where no Earth rate is modelled."""
    north = float(np.linalg.norm(earth_n[:2]))
    return gyro_bias_sd / north if north > 0 else np.inf


@dataclass(frozen=True, slots=True)
class MotionFit:
    """Heading (angle from the levelled start frame to n about the vertical, rad), its sd, and the clock offset [s]."""

    heading: float
    heading_sd: float
    clock_offset_s: float


def fit_motion(
    steps: Steps,
    bias_gyro: Floats,
    R_level: Floats,
    t_s: Floats,
    position_n: Floats,
    offsets_s: Floats,
    gravity: float,
    window_s: float = 8.0,
    max_windows: int = 60,
) -> MotionFit | None:
    """Heading and clock offset of a position sensor by fitting its motion to the inertial one, window by window.

    In a window, with S the double integral of the specific force carried to its start by the gyro and
    levelled, p(t) = p0 + v0 t + c t^2/2 + Rz(heading) S(t) is linear in p0, v0, c (which takes up tilt and bias),
    cos and sin of the heading. The offset of ``offsets_s`` with the least total log residual wins. ``t_s`` are
    stamps in s since ``steps.t0_ns``. Returns None when no window turns the motion into a heading.
    """
    known_s = 0.5 * float(np.min(offsets_s) + np.max(offsets_s))  # windows shrink by what is open, not by this
    t_s, offsets_s = t_s - known_s, offsets_s - known_s
    moving = _windows(t_s, position_n, window_s, max_windows, steps.end_s, offsets_s)
    if not moving:
        return None
    R_0t = rotations(steps.edges_s, steps.gyro, bias_gyro)
    profiles, headings = np.zeros(len(offsets_s)), []
    for start, rows in moving:
        inertial = _levelled_motion(steps, R_0t, start, window_s, gravity)
        fits = [_fit_window(inertial, t_s[rows] - start - offset, position_n[rows]) for offset in offsets_s]
        profiles += [len(rows) * np.log(fit[2]) for fit in fits]
        # heading of the window's levelled frame -> heading of the start's
        R_ln = R_level @ R_0t[inertial.first] @ inertial.R_lb.T
        turn = np.arctan2(R_ln[1, 0] - R_ln[0, 1], R_ln[0, 0] + R_ln[1, 1])
        headings.append([(heading - turn, sd) for heading, sd, _ in fits])
    best = int(np.argmin(profiles))
    angle, sd = np.array([h[best] for h in headings]).T
    keep = sd < np.deg2rad(20.0)
    if not keep.any():
        return None
    weight = 1.0 / (sd[keep] ** 2 + np.deg2rad(1.0) ** 2)
    mean = np.sum(weight * np.exp(1j * angle[keep])) / weight.sum()
    spread = np.sqrt(max(-2.0 * np.log(min(abs(mean), 1.0)), 0.0))
    heading_sd = float(np.hypot(spread, 1.0 / np.sqrt(weight.sum())))
    return MotionFit(float(np.angle(mean)), heading_sd, known_s + float(_vertex(offsets_s, profiles, best)))


def _windows(t_s, position_n, window_s, max_windows, end_s, offsets_s):
    """The windows with the most motion: [(start_s, rows of the fixes)], fixes inside for every offset."""
    found = []
    margin = float(np.max(np.abs(offsets_s)))
    for start in np.arange(margin, end_s - window_s - margin, window_s / 2):
        first = np.searchsorted(t_s, start + margin)
        rows = np.arange(first, np.searchsorted(t_s, start + window_s - margin, side="right"))
        if len(rows) < 12:
            continue
        t = t_s[rows] - t_s[rows].mean()
        shape = np.vander(t, 3)  # constant velocity and constant acceleration say nothing about heading
        bend = position_n[rows] - shape @ np.linalg.lstsq(shape, position_n[rows], rcond=None)[0]
        found.append((float(np.sqrt(np.mean(bend[:, :2] ** 2))), float(start), rows))
    found = sorted((f for f in found if f[0] > 0.01), reverse=True)[:max_windows]
    return [(start, rows) for _, start, rows in sorted(found, key=lambda f: f[1])]


@dataclass(frozen=True, slots=True)
class _Inertial:
    first: int  # step at which the window starts
    R_lb: Floats  # levelled frame from body at that step
    t: Floats  # edges relative to the window's start
    S: Floats  # displacement by specific force less gravity, in the levelled frame


def _levelled_motion(steps: Steps, R_0t: Floats, start: float, window_s: float, gravity: float) -> _Inertial:
    rows = rows_between(steps, start, start + window_s)
    dt = steps.dt_of(rows)[:, None]
    force = np.einsum("ij,tjk,tk->ti", R_0t[rows.start].T, R_0t[:-1][rows], steps.acc[rows])
    R_lb = level(force.mean(axis=0))
    a = force @ R_lb.T - [0.0, 0.0, gravity]
    v = np.vstack([np.zeros(3), np.cumsum(a * dt, axis=0)])
    S = np.vstack([np.zeros(3), np.cumsum(v[:-1] * dt + 0.5 * a * dt**2, axis=0)])
    return _Inertial(rows.start, R_lb, steps.edges_s[rows.start : rows.stop + 1] - start, S)


def _fit_window(inertial: _Inertial, t: Floats, position_n: Floats) -> tuple[float, float, float]:
    """Heading of the levelled frame, its sd, and the residual's variance; ``t`` s since the window's start."""
    S = np.stack([np.interp(t, inertial.t, inertial.S[:, a]) for a in range(3)], axis=1)
    Q, _ = np.linalg.qr(np.stack([np.ones(len(t)), t, t**2 / 2], axis=1))
    return _rotate_onto(S - Q @ (Q.T @ S), position_n - Q @ (Q.T @ position_n), taken=10)


def turn_between(S: Floats, z: Floats, largest_sd: float) -> tuple[float, float] | None:
    """Turn about the vertical that takes the way ``S`` (n, 3) onto ``z`` (n, 3), both about their means, and its sd
    [rad]; None where the sd is above ``largest_sd``."""
    heading, sd, _ = _rotate_onto(S, z, taken=4)
    return (heading, sd) if sd < largest_sd else None


def _rotate_onto(S: Floats, z: Floats, taken: int) -> tuple[float, float, float]:
    """Least squares of z = Rz(heading) S: heading, its sd and the residual's variance; ``taken`` degrees of freedom
    went into what was removed from both, the heading among them."""
    # (x, y) = [[Sx, -Sy], [Sy, Sx]] (cos, sin): orthogonal columns of equal length
    energy = max(float(np.sum(S[:, :2] ** 2)), 1e-12)
    cos = np.sum(S[:, :2] * z[:, :2]) / energy
    sin = np.sum(S[:, 0] * z[:, 1] - S[:, 1] * z[:, 0]) / energy
    heading = float(np.arctan2(sin, cos))
    variance = float(np.sum((z - S @ rotation_z(heading).T) ** 2)) / max(S.size - taken, 1) + 1e-12
    return heading, float(np.sqrt(variance / energy)), variance


def _vertex(x: Floats, y: Floats, best: int) -> float:
    """Minimum of the parabola through the best point and its neighbours."""
    if best in (0, len(x) - 1):
        return x[best]
    (a, b, c), h = y[best - 1 : best + 2], x[best + 1] - x[best]
    return x[best] + 0.5 * h * (a - c) / (a - 2 * b + c)
