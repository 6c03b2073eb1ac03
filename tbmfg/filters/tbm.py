"""The INS / total station filter of a roadheader, by Liu, Wang & Tao (TBM-MSE), section 3.

Numbers in brackets are the paper's equations, E its errata; the corrected form is meant throughout. The paper's error
is computed minus true with C_computed = exp(-[phi]x) C_true, z down; here it is that of ``inertial.strapdown``, true =
estimate (+) error with a rotation d in b, z up: phi = R d, all else changes sign. So (9)-(12), on increments with (8)
and the coning and sculling of (11), and (19)-(21) with E11-E13 are ``strapdown.propagate``, (22) with E14 and E15 is
``sensors.prism``, (25) is ``kalman.correct`` and (26) with E17 ``correct_state``.

Every fix is taken when it comes, at the IMU edge nearest to it and carried from there by the velocity. Nothing else is
used: no zero velocity, no other sensor. A prior of the heading is needed, for a slow machine's prism hardly tells it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import Field

from tbmfg.chance import chi_square_point
from tbmfg.fields import Node, Positive
from tbmfg.filters import samplewise
from tbmfg.filters.kalman import REOPEN, correct, innovation, predict
from tbmfg.filters.samplewise import linearise
from tbmfg.filters.scanmap import CLONE, ScanMap
from tbmfg.inertial.strapdown import BA_, BG_, correct_state, propagate
from tbmfg.measure import GyroFrame, Samples, position_rows
from tbmfg.problem import GATE, Parameters, Problem
from tbmfg.rig import Imu
from tbmfg.sensors import Rows
from tbmfg.state import BA, BG, NAV, POS
from tbmfg.timeseries import Floats

LONGEST_S = 0.1  # the covariance is carried over at most this long at once: bias walks act inside


class InsTs(Node):
    """Switches of ``tbm-ins-ts``."""

    arm: Literal["estimated", "fixed", "none"] = Field(
        "estimated",
        description="The lever arm: a state where the rig gives it a sd; known, as in the paper; left out, to see what "
        "it is worth.",
    )
    tau_s: Positive | None = Field(
        None, description="Correlation time of the biases (18), sds as in the rig; null: the rig's random walks."
    )


@dataclass(frozen=True, slots=True)
class Filtered:
    """States (n, 21) and covariances (n, 15, 15) at the keyframes, calibrations (m,) with covariance (m, m) at the end,
    NIS and gate flags by sensor and row, and how often each sensor's gate was opened."""

    x: Floats
    cov: Floats
    c: Floats
    c_cov: Floats
    nis: dict[str, Floats]
    gated: dict[str, np.ndarray]
    reopened: dict[str, int]


def view(problem: Problem, switches: InsTs, kinds: tuple[str, ...] = ("prism",)) -> Problem:
    """The problem as the filter sees it: the fixes of sensors of these kinds one by one, as rows at IMU edges."""
    edges_s, rig = problem.inertial.steps.edges_s, problem.rig

    def known(given: Parameters) -> Parameters:
        arms = np.array([".arm_" in name for name in given.names], dtype=bool)
        sd = np.where(arms & (switches.arm == "estimated"), given.sd, 0.0)  # clocks are those that prepare has found
        told = arms & (switches.arm == "none")
        return replace(given, mean=np.where(told, 0.0, given.mean), sd=sd, start=np.where(told, 0.0, given.start))

    def to_rows(name: str, s: Samples, frame: GyroFrame, calib: slice) -> Rows:
        return position_rows(rig.sensors[name], s, problem.clocks[name], edges_s, frame, problem.origin_n, calib)

    return samplewise.view(problem, kinds, to_rows, known)


def run(
    problem: Problem,
    switches: InsTs,
    progress: Callable[[float], None] | None = None,
    scans: ScanMap | None = None,
) -> Filtered:
    """Filter a problem as :func:`view` gives it, and with it ``scans``, which keep their own counts."""
    parameters, free, keyframes = problem.parameters, problem.parameters.free, problem.keyframe_edges
    x, c = problem.prior.x[:21].copy(), parameters.start.copy()
    own = NAV + len(free)
    P = np.zeros((own + CLONE * (scans is not None),) * 2)
    P[:NAV, :NAV] = problem.prior.filter_cov[:NAV, :NAV]
    P[NAV:own, NAV:own] = np.diag(parameters.sd[free] ** 2)
    predicted = Prediction(problem, switches.tau_s)
    nis = {rows.sensor: np.full(len(rows), np.nan) for rows in problem.rows}
    gated = {rows.sensor: np.zeros(len(rows), dtype=bool) for rows in problem.rows}
    in_a_row, reopened = dict.fromkeys(nis, 0), dict.fromkeys(nis, 0)
    gates = {rows.sensor: chi_square_point(GATE, rows.dof) for rows in problem.rows}
    epochs = samplewise.epochs(problem)
    due = samplewise.due(problem.rows, epochs)

    xs, covs, last = [], [], keyframes[0]
    for number, epoch in enumerate(epochs):
        for scan in scans.until(epoch) if scans is not None else ():
            x, P = predicted(x, P, last, scan.last)
            last = scan.last
            dx, P = scans.update(scan, x, P)
            x = correct_state(x, dx[:NAV])
            c[free] += dx[NAV:own]
            scans.passing(last, x)
        x, P = predicted(x, P, last, epoch)
        last = epoch
        for rows, r in due[number]:
            residual, H = linearise(rows, r, x, c, free)
            H = np.pad(H, ((0, 0), (0, len(P) - own)))  # of the scans' clone nothing
            nis[rows.sensor][r] = innovation(P, H, residual)[0]
            in_a_row[rows.sensor] += 1
            if nis[rows.sensor][r] > gates[rows.sensor]:
                if in_a_row[rows.sensor] <= REOPEN:
                    gated[rows.sensor][r] = True
                    continue
                reopened[rows.sensor] += 1
                off = residual * rows.sigma[r]
                P = P.copy()
                P[POS, POS] += np.eye(3) * (off @ off)
                if scans is not None:
                    scans.forsake()
            in_a_row[rows.sensor] = 0
            dx, P = correct(P, H, residual)  # (23)-(25)
            x = correct_state(x, dx[:NAV])  # (26)
            c[free] += dx[NAV:own]
            if scans is not None:
                scans.shifted(dx)
        if scans is not None:
            scans.passing(epoch, x)
        if epoch == keyframes[len(xs)]:
            xs.append(x)
            covs.append(P[:NAV, :NAV])
        if progress is not None and number % 1000 == 0:
            progress(number / len(epochs))
    c_cov = np.zeros((len(c), len(c)))
    c_cov[np.ix_(free, free)] = P[NAV:own, NAV:own]
    return Filtered(np.array(xs), np.array(covs), c, c_cov, nis, gated, reopened)


class Prediction:
    """(9)-(12), (19)-(21) over the steps of a problem. With ``tau_s`` the biases are Gauss-Markov, (18) with E11."""

    def __init__(self, problem: Problem, tau_s: float | None) -> None:
        self.inertial, self.tau_s = problem.inertial, tau_s
        imu: Imu = problem.rig.imu
        self.walks = problem.inertial.psd_bg, problem.inertial.psd_ba
        if tau_s is not None:  # so that the variance stays that of the rig's sds
            self.walks = 2.0 * imu.gyro_bias_sd**2 / tau_s, 2.0 * imu.acc_bias_sd**2 / tau_s

    def __call__(self, x: Floats, P: Floats, first: int, last: int) -> tuple[Floats, Floats]:
        """State and covariance at the edge ``last``, from those at ``first``."""
        inertial, edges_s = self.inertial, self.inertial.steps.edges_s
        noise = inertial.psd_gyro, inertial.psd_acc, *self.walks, inertial.earth_n, inertial.gravity_n
        pieces = max(1, int(np.ceil((edges_s[last] - edges_s[first]) / LONGEST_S - 1e-9)))
        for begin, end in pairwise(np.linspace(first, last, pieces + 1).astype(int)):
            x, Phi, Q = propagate(x, begin, end, edges_s, inertial.gyro, inertial.acc, *noise)
            if self.tau_s is not None:
                left = np.exp(-(edges_s[end] - edges_s[begin]) / self.tau_s)
                x[BA_], x[BG_] = left * x[BA_], left * x[BG_]
                for rows in (BA, BG):
                    Phi[rows], Q[rows] = left * Phi[rows], left * Q[rows]
                    Q[:, rows] *= left
            P = predict(P, Phi, Q)
        return x, P
