"""What the shaft boring machine's filters are given: every sample in their paper's axes, and what it tells beforehand.

Wang et al., Sensors 2019, 19, 5007. Frames as in :mod:`tbmfg.filters.frd`; horizontal displacement counts from the
laser's line, which is n's z axis, and depth from the start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyfit, polyval

from tbmfg.earth import north_direction
from tbmfg.filters.frd import angles_of, euler_rates, measured_angles, rotation_ra
from tbmfg.geometry import FLIP, rotation_z, skew
from tbmfg.inertial.steps import step_index
from tbmfg.inertial.strapdown import rotations
from tbmfg.problem import Problem
from tbmfg.rig import kind_of
from tbmfg.state import POS, ROT, VEL
from tbmfg.timeseries import Floats

WIDTHS = {"magnetometer": 3, "laser": 2, "barometer": 2}  # columns of each sensor's readings
R_AIR = 287.05  # J/kg/K, dry air
FIRST = 20  # pressures whose median is that of the start
TICK_S = 1e-6  # stamps closer than this are equal
SPEED_S = 1.0  # over which depths are differentiated
START_S = 10.0  # over which the field's dip is averaged
HELD = 2.5  # periods of a sensor after which its last reading is too old to be held
STRETCH_S = 10.0  # over which the readings' spread about the gyro is taken


@dataclass(frozen=True, slots=True)
class Readings:
    """The samples of every step in the paper's axes, and how the log starts.

    ``omega``, ``f`` (n, 3) rates and specific force in a; ``dt`` (n,); ``field`` (n, 3), ``spot`` (n, 2) m, ``depth``
    (n,) m, ``speed`` (n,) m/s, NaN in steps without a sample; ``period_s`` and ``sigma`` of each kind's samples.
    ``R_nr`` takes r to n. ``X`` (9,), ``P`` (9, 9): state of :mod:`tbmfg.filters.euler_ekf` at the first edge.
    ``arm_b`` is the detector's; ``used`` counts the samples taken, by sensor.
    """

    omega: Floats
    f: Floats
    dt: Floats
    field: Floats
    spot: Floats
    depth: Floats
    speed: Floats
    period_s: dict[str, float]
    sigma: dict[str, float]
    R_nr: Floats
    X: Floats
    P: Floats
    gravity: float
    arm_b: Floats
    used: dict[str, int]

    @property
    def angles(self) -> Floats:
        """(15): roll, pitch, yaw of every step, the last where there is a field, (n, 3)."""
        return measured_angles(-self.f, self.field)

    @property
    def gyro_angles(self) -> Floats:
        """Angles by the gyro alone at the end of every step, (n, 3)."""
        edges = np.concatenate([[0.0], np.cumsum(self.dt)])
        C_a0 = rotations(edges, self.omega, np.zeros(3))[1:]
        return np.array([angles_of(C) for C in rotation_ra(self.X[:3]).T @ C_a0])


def readings(problem: Problem, air_k: float) -> Readings:
    """A problem's samples and prior in the paper's frames; of two sensors of a kind the first."""
    rig, inertial, x = problem.rig, problem.inertial, problem.prior.x
    last = int(problem.keyframe_edges[-1])
    edges = inertial.steps.edges_s[: last + 1]
    omega, f = (inertial.gyro[:last] - x[18:21]) @ FLIP, (inertial.acc[:last] - x[15:18]) @ FLIP
    gravity = float(-inertial.gravity_n[2])
    values = {kind: np.full((last, width), np.nan) for kind, width in WIDTHS.items()}
    period_s, sigma, used = {}, {}, {}
    north, arm_b = north_direction(rig.origin.x_axis_azimuth), np.zeros(3)
    for name, samples in problem.samples.items():
        kind, sensor = kind_of(name), rig.sensors[name]
        if kind not in values or kind in sigma:
            continue
        t_s = samples.t_s - getattr(sensor, "clock_offset", 0.0)
        if kind == "magnetometer":
            columns = (samples.values - sensor.hard_iron) @ sensor.R_bm.T @ FLIP
            north -= sensor.declination
        elif kind == "laser":
            columns, arm_b = samples.values @ (FLIP @ sensor.T_bd.R)[:2, :2].T, sensor.T_bd.xyz
        else:
            columns = _depths(samples.values, t_s, air_k, gravity)
        inside = t_s <= edges[-1]
        # a sample at the border of two steps ends the first
        values[kind] = _by_step(step_index(inertial.steps, t_s[inside] - TICK_S), columns[inside], last)
        period_s[kind], sigma[kind], used[name] = float(np.median(np.diff(t_s))), sensor.sigma, int(inside.sum())
    R_nr = rotation_z(north) @ FLIP
    X, P = _start(problem, R_nr, arm_b)
    return Readings(
        omega, f, np.diff(edges), values["magnetometer"], values["laser"], values["barometer"][:, 0],
        values["barometer"][:, 1], period_s, sigma, R_nr, X, P, gravity, arm_b, used,
    )  # fmt: skip


def _depths(height: Floats, t_s: Floats, air_k: float, gravity: float) -> Floats:
    """Depth below the start, d_z = R_air T / g ln(p / p_0), and its speed over ``SPEED_S``, NaN before; (n, 2).

    ``height`` (n,) is that of the standard atmosphere, which tells the pressure: p ~ (1 - h / 44330.77)^5.25588.
    """
    log_p = 5.25588 * np.log(1.0 - height / 44330.77)
    depth = R_AIR * air_k / gravity * (log_p - np.median(log_p[:FIRST]))
    speed = (depth - np.interp(t_s - SPEED_S, t_s, depth)) / SPEED_S
    return np.column_stack([depth, np.where(t_s < t_s[0] + SPEED_S, np.nan, speed)])


def _by_step(step: np.ndarray, values: Floats, count: int) -> Floats:
    """Mean of the samples in each step, NaN where there is none; (count, k). A NaN among them leaves one."""
    number = np.bincount(step, minlength=count)
    sums = np.stack([np.bincount(step, column, count) for column in values.T], axis=1)
    return sums / np.where(number == 0, np.nan, number)[:, None]


def _start(problem: Problem, R_nr: Floats, arm_b: Floats) -> tuple[Floats, Floats]:
    """The prior as a state of nine and its covariance; depth starts at zero."""
    x = problem.prior.x
    R_nb = x[:9].reshape(3, 3)
    angles = angles_of(R_nr.T @ R_nb @ FLIP)
    on_line = x[9:12] + R_nb @ arm_b + problem.origin_n  # the line is n's z axis
    d = R_nr.T @ on_line
    X = np.concatenate([angles, [d[0], d[1], 0.0], R_nr.T @ x[12:15]])
    M = np.linalg.inv(to_navigation(X, R_nr, arm_b))
    return X, M @ problem.prior.filter_cov[:9, :9] @ M.T


def to_navigation(X: Floats, R_nr: Floats, arm_b: Floats) -> Floats:
    """Jacobian (9, 9) of rotation in b, position and velocity in n to the state of nine."""
    M = np.zeros((9, 9))
    R_nb = R_nr @ rotation_ra(X[:3]).T @ FLIP
    M[ROT, :3] = np.linalg.inv(euler_rates(X[0], X[1]) @ FLIP)  # (6): d_angles = E d_a
    M[POS, 3:6], M[VEL, 6:9] = R_nr, R_nr
    level = np.diag([1.0, 1.0, 0.0])  # the detector's arm moves the spot, not the barometer
    M[POS, :3] = level @ R_nb @ skew(arm_b) @ M[ROT, :3]
    return M


# ---- what they tell beforehand ----


def reference_field(given: Readings) -> tuple[float, float]:
    """h_n, h_d of the unit field in r: its angle to gravity over the log's start, carried there by the gyro."""
    edges = np.concatenate([[0.0], np.cumsum(given.dt)])
    n = int(np.searchsorted(edges[1:], max(START_S, given.dt[0])))
    C_0a = rotations(edges[: n + 1], given.omega[:n], np.zeros(3))[:-1]
    down, field = (np.nanmean(np.einsum("tij,tj->ti", C_0a, values[:n]), axis=0) for values in (-given.f, given.field))
    h_d = float(down @ field / np.linalg.norm(down) / np.linalg.norm(field))
    return float(np.sqrt(1.0 - h_d**2)), h_d


def held(values: Floats, dt: Floats, period_s: float) -> Floats:
    """Each step's sample, or the last one while it is no older than ``HELD`` periods; (n, k)."""
    end = np.cumsum(dt)
    last = np.maximum.accumulate(np.where(np.isnan(values[:, 0]), -1, np.arange(len(values))))
    stale = (last < 0) | (end - end[last] > HELD * period_s)
    return np.where(stale[:, None], np.nan, values[last])


def spread(given: Readings, angles: Floats) -> Floats:
    """What a user could know of the readings' noise, sd (3,): their spread about the gyro's angles, which take out what
    really turns; linear drift removed, median over stretches. At a standstill it is the readings' own spread."""
    t = np.cumsum(given.dt)
    off = angles - given.gyro_angles
    off -= 2.0 * np.pi * np.round(off / (2.0 * np.pi))
    stretch = (t / STRETCH_S).astype(int)
    variances = [
        [_about_a_line(t[rows], off[rows, axis]) for axis in range(3)]
        for rows in (stretch == number for number in range(stretch[-1] + 1))
        if rows.sum() > FIRST
    ]
    return np.sqrt(np.nanmedian(variances, axis=0)) if variances else np.full(3, np.deg2rad(1.0))


def _about_a_line(t: Floats, values: Floats) -> float:
    """Variance of values (n,), NaN left out, about the line through them; NaN of fewer than three."""
    known = ~np.isnan(values)
    if known.sum() < 3:
        return np.nan
    t, values = t[known] - t[known].mean(), np.unwrap(values[known])
    return float(np.mean((values - polyval(t, polyfit(t, values, 1))) ** 2))
