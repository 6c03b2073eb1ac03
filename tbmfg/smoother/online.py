"""What smoothing online gives: two trajectories, and what is done where a solver fails.

A failed solver is started again at the keyframe it failed at, from where the IMU carries the estimate before it, with a
covariance that is widened until one holds. Where none does, the keyframe is what the IMU says, and it is tried again
at the next: the run goes on to its end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from tbmfg.inertial.strapdown import propagate
from tbmfg.problem import BREAKDOWN, CLOCK, Problem
from tbmfg.state import NAV
from tbmfg.timeseries import Floats

DOUBT = 4.0  # by which the covariance of an estimate is widened when the solver that made it fails
WIDER = (1.0, 16.0, 256.0)  # further, one after the other, until a solver holds


@dataclass(slots=True)
class Restart:
    """A solver failed behind keyframe ``before`` for this ``reason``, and held again at ``again``; None: never."""

    before: int
    reason: str
    again: int | None = None


@dataclass(slots=True)
class Online:
    """Causal states (n, 21 + e) and covariances (each keyframe as estimated when it was the newest), last estimates,
    and constants, which begin as the rig has them; by sensor and row the squared normalised residuals at the last
    estimate; ``restarts``; ``unclosed``: why the last estimates are in part the causal ones, and from where on."""

    causal_x: Floats
    causal_cov: Floats
    last_x: Floats
    last_cov: Floats
    c: Floats
    c_cov: Floats
    nis: dict[str, Floats]
    restarts: list[Restart] = field(default_factory=list)
    unclosed: Restart | None = None

    @staticmethod
    def empty(problem: Problem) -> Online:
        """Room for the estimates of ``problem``."""
        n, d, parameters = len(problem.keyframe_edges), problem.size, problem.parameters
        nis = {rows.sensor: np.full(len(rows), np.nan) for rows in problem.rows}
        clocks = np.array([name.endswith(CLOCK) for name in parameters.names], dtype=bool)  # are those of ``prepare``
        return Online(
            np.empty((n, d + 6)), np.empty((n, d, d)), np.empty((n, d + 6)), np.empty((n, d, d)),
            parameters.start.copy(), np.diag(np.where(clocks, 0.0, parameters.sd**2)), nis,
        )  # fmt: skip

    def residuals(self, problem: Problem, keyframes: slice, last: int, c: Floats) -> None:
        """Squared normalised residuals at ``last_x``, in place, of the rows that begin at these keyframes and end at
        ``last``, of the same solution, or before: the difference of two solutions would pass for a residual."""
        for rows in problem.rows:
            own = slice(*np.searchsorted(rows.i, [keyframes.start, keyframes.stop]))
            own = slice(own.start, min(own.stop, np.searchsorted(rows.j, last, side="right")))
            if own.start < own.stop:
                r = rows.evaluate_at(self.last_x[rows.i[own]], self.last_x[rows.j[own]], c, own)[0]
                self.nis[rows.sensor][own] = np.sum(r**2, axis=1)

    def causal_are_last(self, keyframes: slice) -> None:
        """Nothing later is known of these keyframes."""
        self.last_x[keyframes], self.last_cov[keyframes] = self.causal_x[keyframes], self.causal_cov[keyframes]


class Solver(Protocol):
    """What solves online: each gives state and covariance of keyframe k, or raises one of ``BREAKDOWN``."""

    def begin(self, k: int, x: Floats, cov: Floats) -> tuple[Floats, Floats]:
        """Forget everything and start at keyframe k with this prior and its rows."""

    def add(self, k: int) -> tuple[Floats, Floats]:
        """Add keyframe k, the one after the last, and its rows."""

    def forsake(self, k: int) -> None:
        """Keep the last estimates of what has been begun, up to keyframe k - 1."""


def follow(problem: Problem, solver: Solver, out: Online, progress: Callable[[float], None] | None) -> bool:
    """Every keyframe through ``solver`` into ``out``; whether it holds at the end."""
    n, holds = len(problem.keyframe_edges), False
    for k in range(n):
        if progress is not None:
            progress(k / n)
        doubt = 1.0
        if holds:
            try:
                _newest(out, k, *solver.add(k))
                continue
            except BREAKDOWN as error:
                solver.forsake(k)
                out.restarts.append(Restart(k - 1, said(error)))
                doubt = DOUBT
        holds = _begin(problem, solver, out, k, *_carried(problem, k, out, doubt))
    return holds


def _begin(problem: Problem, solver: Solver, out: Online, k: int, x: Floats, cov: Floats) -> bool:
    """Start ``solver`` at keyframe k, whether it holds; else the keyframe is as given."""
    for wider in WIDER:
        try:
            _newest(out, k, *solver.begin(k, x, wider * cov))
        except BREAKDOWN as error:
            if not out.restarts:
                out.restarts.append(Restart(k, said(error)))
            continue
        if out.restarts and out.restarts[-1].again is None:
            out.restarts[-1].again = k
        return True
    out.causal_x[k], out.causal_cov[k] = x, cov
    out.causal_are_last(slice(k, k + 1))
    out.residuals(problem, slice(k, k + 1), k, out.c)
    return False


def _newest(out: Online, k: int, x: Floats, cov: Floats) -> None:
    if not (np.isfinite(x).all() and np.isfinite(cov).all()):
        raise ArithmeticError(f"the state at keyframe {k} is not finite")
    out.causal_x[k], out.causal_cov[k] = x, cov


def _carried(problem: Problem, k: int, out: Online, doubt: float) -> tuple[Floats, Floats]:
    """State and covariance of keyframe k by the IMU alone: from the estimate before it, whose covariance counts
    ``doubt`` times; of the first the prior."""
    if k == 0:
        return problem.prior.x, problem.prior.filter_cov
    inertial = problem.inertial
    noise = inertial.psd_gyro, inertial.psd_acc, inertial.psd_bg, inertial.psd_ba, inertial.earth_n, inertial.gravity_n
    first, last = problem.keyframe_edges[k - 1 : k + 1]
    edges_s = inertial.steps.edges_s
    x, cov = out.causal_x[k - 1].copy(), doubt * out.causal_cov[k - 1]
    x[:21], Phi, Q = propagate(x[:21], first, last, edges_s, inertial.gyro, inertial.acc, *noise)
    cov[:NAV] = Phi @ cov[:NAV]
    cov[:, :NAV] = cov[:, :NAV] @ Phi.T
    cov[:NAV, :NAV] += Q
    cov[NAV:, NAV:] += np.diag(problem.drift_walk**2 * (edges_s[last] - edges_s[first]))
    return x, 0.5 * (cov + cov.T)


def said(error: Exception) -> str:
    """What a solver says of its failure, on one line."""
    return " ".join(str(error).split())[:160]
