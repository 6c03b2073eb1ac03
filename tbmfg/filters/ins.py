"""The error-state Kalman filter with all sensors: the honest filter rival, and the source of initial values.

Between keyframes it mechanises every IMU step; at a keyframe it corrects with that keyframe's rows. A
clone of the previous keyframe's pose rides along, so that a displacement (odometer) is measured between
the two, as in the graph. Rows beyond the chi-square 99.9 % point are gated. A row
that tells much more than was known is linearised again where it has moved the state to.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from tbmfg.chance import chi_square_point
from tbmfg.filters.kalman import REOPEN, correct, explaining, innovation, predict
from tbmfg.inertial.strapdown import correct_state, difference, propagate
from tbmfg.problem import GATE, Problem
from tbmfg.sensors import Rows
from tbmfg.state import NAV
from tbmfg.timeseries import Floats

# Where a gate has to open, the state's covariance is to say so; but for a sensor whose loss is gnc, which may be biased
# for long and stays out until it agrees again.
FARTHEST = 1e10  # squared sds by which a fix may then be off: rounding of a state so wide would hide the rest of it
TAIL = (
    4.0  # degrees of freedom of the Student distribution that the likelihood is taken with: outliers must not rule it
)
# A row that tells so much more than was known moves the state to where its own Jacobian is another; it is then
# linearised again there. As log det S, S being what the row was expected to spread by, in its own variances.
WIDE = np.log(10.0)
ITERATIONS = 4
SETTLED = 0.01  # sds
LONGEST_S = 0.1  # the covariance is carried over at most this long at once: bias walks act inside


@dataclass(frozen=True, slots=True)
class Filtered:
    """States (n, 21 + e) and covariances (n, 15 + e, 15 + e) after each keyframe's rows, calibrations (m,) with
    covariance (m, m) at the end, per sensor NIS and gate flags by row, and the likelihood cost
    the sum of (TAIL + k) log(1 + nis / TAIL) + log det S."""

    x: Floats
    cov: Floats
    c: Floats
    c_cov: Floats
    nis: dict[str, Floats]
    gated: dict[str, np.ndarray]
    cost: float
    reopened: dict[str, int]


def run(problem: Problem, fixed: tuple[str, ...] = (), progress: Callable[[float], None] | None = None) -> Filtered:
    """Filter the whole problem. Parameters whose name ends in one of ``fixed`` are held at their start."""
    inertial, parameters, e = problem.inertial, problem.parameters, len(problem.drift_walk)
    steps = inertial.steps
    noise = inertial.psd_gyro, inertial.psd_acc, inertial.psd_bg, inertial.psd_ba, inertial.earth_n, inertial.gravity_n
    free = np.array(
        [k for k in parameters.free if not parameters.names[k].endswith(tuple(fixed) or ("\0",))], dtype=int
    )
    d, m, n = NAV + e, len(free), len(problem.keyframe_edges)
    calib = slice(d, d + m)

    x, c = problem.prior.x.copy(), parameters.start.copy()
    P = np.zeros((d + m + 6, d + m + 6))
    P[:d, :d] = problem.prior.filter_cov
    P[calib, calib] = np.diag(parameters.sd[free] ** 2)
    previous = x.copy()

    xs, covs = np.empty((n, len(x))), np.empty((n, d, d))
    nis = {rows.sensor: np.full(len(rows), np.nan) for rows in problem.rows}
    gated = {rows.sensor: np.zeros(len(rows), dtype=bool) for rows in problem.rows}
    in_a_row, reopened = dict.fromkeys(nis, 0), dict.fromkeys(nis, 0)
    places = np.full(len(c), -1)
    places[free] = np.arange(m)
    starts = {rows.sensor: np.searchsorted(rows.j, np.arange(n + 1)) for rows in problem.rows}
    gates = {rows.sensor: chi_square_point(GATE, rows.dof) for rows in problem.rows}
    # where among the free calibrations, or nowhere, those of a sensor are
    inputs = {rows.sensor: places[rows.calib] for rows in problem.rows}
    cost = 0.0

    for k in range(n):
        if k > 0:
            previous = x.copy()
            first, last = problem.keyframe_edges[k - 1 : k + 1]
            x, P = _advance(x, P, first, last, steps.edges_s, inertial.gyro, inertial.acc, *noise)
            elapsed = steps.edges_s[last] - steps.edges_s[first]
            P[np.arange(NAV, d), np.arange(NAV, d)] += problem.drift_walk**2 * elapsed
        for rows in problem.rows:
            sensor = rows.sensor
            for r in range(starts[sensor][k], starts[sensor][k + 1]):
                binary = rows.i[r] < k
                before = previous if binary else x
                parts = rows.evaluate_at(before[None], x[None], c, slice(r, r + 1))
                shut = gates[sensor]
                limit = FARTHEST if in_a_row[sensor] >= REOPEN and rows.loss != "gnc" else shut
                prior = x.copy(), previous.copy(), P, c.copy()
                P, value, logdet = _update(x, previous, P, c, *parts, free, inputs[sensor], shut, limit)
                if logdet > WIDE and value <= shut:
                    P = _iterate(rows, r, binary, *prior, x, previous, c, free, inputs[sensor])
                nis[sensor][r] = value
                cost += (TAIL + rows.dof) * np.log1p(value / TAIL) + logdet
                if value > limit:
                    gated[sensor][r] = True
                    in_a_row[sensor] += 1
                    continue
                reopened[sensor] += int(value > shut)
                in_a_row[sensor] = 0
        xs[k], covs[k] = x, P[:d, :d]
        if progress is not None and k % 500 == 0:
            progress(k / n)
    c_cov = np.zeros((len(c), len(c)))
    c_cov[np.ix_(free, free)] = P[calib, calib]
    return Filtered(xs, covs, c, c_cov, nis, gated, float(cost), reopened)


@njit(cache=True)
def _advance(x, P, first, last, edges, gyro, acc, psd_gyro, psd_acc, psd_bg, psd_ba, earth_n, gravity_n):
    """State ``x`` and covariance ``P`` (n, n) from edge ``first`` to edge ``last``; the last six of ``P``, the clone,
    become a copy of the pose that is left."""
    x, P, clone = x.copy(), P.copy(), len(P) - 6
    P[clone:] = P[:6].copy()
    P[:, clone:] = P[:, :6].copy()
    pieces = max(int(np.ceil((edges[last] - edges[first]) / LONGEST_S - 1e-9)), 1)
    for piece in range(pieces):
        start, end = first + (last - first) * piece // pieces, first + (last - first) * (piece + 1) // pieces
        x[:21], Phi, Q = propagate(
            x[:21], start, end, edges, gyro, acc, psd_gyro, psd_acc, psd_bg, psd_ba, earth_n, gravity_n
        )
        P = predict(P, Phi, Q)
    return x, P


def _iterate(
    rows: Rows, r: int, binary: bool, x0: Floats, previous0: Floats, P0: Floats, c0: Floats,
    x: Floats, previous: Floats, c: Floats, free: np.ndarray, places: np.ndarray,
) -> Floats:  # fmt: skip
    """Covariance after row ``r``, linearised anew where it has moved ``x``, ``previous`` and ``c``, which move on in
    place: Gauss-Newton from the prior ``.. 0``, the iterated extended Kalman filter (Bell and Cathey 1993)."""
    P = P0
    for _ in range(ITERATIONS):
        parts = rows.evaluate_at((previous if binary else x)[None], x[None], c, slice(r, r + 1))
        moved = np.concatenate(
            [difference(x[None], x0[None])[0], (c - c0)[free], difference(previous[None], previous0[None])[0, :6]]
        )
        x[:], previous[:], c[:] = x0, previous0, c0
        P, dx = _relinearised(x, previous, P0, c, *parts, free, places, moved)
        if np.all(np.abs(dx - moved) <= SETTLED * np.sqrt(np.diag(P0))):
            break
    return P


@njit(cache=True)
def _update(x, previous, P, c, residual, Ji, Jj, Jc, free, places, gate, limit):
    """Correct the state ``x``, the ``previous`` keyframe's pose and the constants ``c``, in place, by one row that was
    linearised there: covariance, its squared normalised innovation, and log det S. One beyond the ``limit`` is left
    out, one beyond the ``gate`` explained by a wider covariance."""
    r, H = residual[0], _jacobian(P, Ji, Jj, Jc, places)
    nis, logdet = innovation(P, H, r)
    if nis > limit:
        return P, nis, logdet
    dx, P1 = correct(explaining(P, H, r, nis) if nis > gate else P, H, r)
    if nis > gate:
        P1 += np.outer(dx, dx)  # or else it is the sensor that is wrong, and the state is where it was
    _move(x, previous, c, dx, free)
    return P1, nis, logdet


@njit(cache=True)
def _relinearised(x, previous, P, c, residual, Ji, Jj, Jc, free, places, moved):
    """The same for a row linearised where ``x``, ``previous`` and ``c`` have ``moved`` to: covariance, and the error
    by which they are corrected."""
    H = _jacobian(P, Ji, Jj, Jc, places)
    dx, P = correct(P, H, residual[0] - H @ moved)
    _move(x, previous, c, dx, free)
    return P, dx


@njit(cache=True)
def _jacobian(P, Ji, Jj, Jc, places):
    """Of one row to the errors of ``P``, [state, free constants, clone]; ``places`` says which of the free ones the
    columns of Jc are, -1 for known ones."""
    d, clone = Ji.shape[2], len(P) - 6
    H = np.zeros((Ji.shape[1], len(P)))
    if Jj.shape[2] > 0:
        H[:, clone:], H[:, :d] = Ji[0, :, :6], Jj[0]
        H[:, 6:d] += Ji[0, :, 6:]  # velocity and biases of the previous keyframe are taken as the present ones
    else:
        H[:, :d] = Ji[0]
    for column, place in enumerate(places):
        if place >= 0:
            H[:, d + place] = Jc[0, :, column]
    return H


@njit(cache=True)
def _move(x, previous, c, dx, free):
    """Correct the state, the constants and the pose of the previous keyframe, in place."""
    d = len(x) - 6
    clone = len(dx) - 6
    x[:] = correct_state(x, dx[:d])
    c[free] += dx[d:clone]
    pose = np.zeros(d)
    pose[:6] = dx[clone:]
    previous[:] = correct_state(previous, pose)
