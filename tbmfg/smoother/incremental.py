"""Smoothing online over the whole past with GTSAM's iSAM2, one update per keyframe.

Kaess et al. (2012); QR throughout: where heading or biases are weak, Cholesky fails at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, D, V, X

from tbmfg.problem import BREAKDOWN, Prior, Problem
from tbmfg.smoother import batch
from tbmfg.smoother.factors import BLOCKS, Factors, Step, read_state, to_our_chart
from tbmfg.smoother.online import Online, Restart, follow, said
from tbmfg.timeseries import Floats

RELINEARIZE = 1e-2  # change of any variable, in its own unit, from which it is linearised anew
SETTLE_UPDATES = 10  # iterations after the last keyframe


def _isam_params() -> gtsam.ISAM2Params:
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.setRelinearizeThreshold(RELINEARIZE)
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return params


class _Whole:
    """iSAM2 as a solver: a new one at every start, ``first`` being its oldest keyframe and ``prior`` what is known of
    it."""

    isam: gtsam.ISAM2
    first: int
    prior: Prior

    def __init__(self, problem: Problem, out: Online) -> None:
        self.problem, self.out = problem, out
        self.factors, self.e = Factors(problem), len(problem.drift_walk)

    def begin(self, k: int, x: Floats, cov: Floats) -> tuple[Floats, Floats]:
        self.isam, self.first, self.prior = gtsam.ISAM2(_isam_params()), k, self.problem.prior
        if k > 0:
            cov = _by_variable(cov)
            self.prior = Prior(x, cov, cov)
        step = self.factors.anchor(k, x, cov)
        self.factors.measurements(k, x, step, anchored=True)
        return self._newest(k, step)

    def add(self, k: int) -> tuple[Floats, Floats]:
        step = Step(gtsam.NonlinearFactorGraph(), gtsam.Values())
        self.factors.motion(k, self.out.causal_x[k - 1], step)
        self.factors.measurements(k, read_state(step.values, k, self.e), step)
        return self._newest(k, step)

    def forsake(self, k: int) -> None:
        self.out.causal_are_last(slice(self.first, k))

    def _newest(self, k: int, step: Step) -> tuple[Floats, Floats]:
        self.isam.update(step.graph, step.values)
        return _newest(self.isam, self.factors, k, self.e)

    def close(self) -> None:
        """The last estimates of all keyframes since the last start, and the constants, with their covariances: the
        batch smoother's linear algebra gives them at once, from the rows since then."""
        problem, out, first, n = self.problem, self.out, self.first, len(self.problem.keyframe_edges)
        _settle(self.isam)
        values, c = self.isam.calculateEstimate(), _constants(self.isam, self.factors)
        x = np.array([read_state(values, k, self.e) for k in range(first, n)])
        c_cov = out.c_cov.copy()
        for sensor in range(len(problem.rows)):
            key, which = self.factors.constant_key(sensor), self.factors.constant_parameters(sensor)
            if key in self.factors.known:
                c_cov[np.ix_(which, which)] = self.isam.marginalCovariance(key)
        nothing = {rows.sensor: np.zeros(len(rows), dtype=bool) for rows in problem.rows}
        rows = [rows.between(first, n - 1, nothing[rows.sensor]) for rows in problem.rows]
        since = replace(problem, keyframe_edges=problem.keyframe_edges[first:], rows=rows, prior=self.prior)
        out.last_cov[first:] = batch.at(since, x, c).cov
        out.last_x[first:], out.c, out.c_cov = x, c, c_cov


def run(problem: Problem, progress: Callable[[float], None] | None = None) -> Online:
    """Smooth online over the whole past."""
    out, n = Online.empty(problem), len(problem.keyframe_edges)
    solver = _Whole(problem, out)
    if follow(problem, solver, out, progress):
        try:
            solver.close()
        except BREAKDOWN as error:
            solver.forsake(n)
            out.unclosed = Restart(solver.first, said(error))
    out.residuals(problem, slice(0, n), n - 1, out.c)
    return out


def _by_variable(cov: Floats) -> Floats:
    """A covariance of one keyframe as an anchor has it: none between pose, velocity, biases and drifts."""
    out = np.zeros_like(cov)
    for own in BLOCKS.values():
        out[own, own] = cov[own, own]
    return out


def _settle(isam: gtsam.ISAM2) -> None:
    """Iterate until nothing is relinearised any more."""
    for _ in range(SETTLE_UPDATES):
        if isam.update().getVariablesRelinearized() == 0:
            return


def _newest(isam: gtsam.ISAM2, factors: Factors, k: int, e: int) -> tuple[Floats, Floats]:
    """Estimate and covariance of the newest keyframe."""
    values = gtsam.Values()
    values.insert(X(k), isam.calculateEstimatePose3(X(k)))
    values.insert(V(k), isam.calculateEstimateVector(V(k)))
    values.insert(B(k), isam.calculateEstimateConstantBias(B(k)))
    if e:
        values.insert(D(k), isam.calculateEstimateVector(D(k)))
    x = read_state(values, k, e)
    keys = factors.keys(k)
    joint = isam.jointMarginalCovariance(keys)
    blocks = [[joint.at(a, b) for b in keys] for a in keys]
    return x, to_our_chart(np.block(blocks), x)


def _constants(isam: gtsam.ISAM2, factors: Factors) -> Floats:
    """Calibrations as they are now, (m,)."""
    c = factors.problem.parameters.start.copy()
    for sensor, rows in enumerate(factors.problem.rows):
        key = factors.constant_key(sensor)
        if key in factors.known:
            read = isam.calculateEstimatePoint3 if rows.model == "prism" else isam.calculateEstimateVector
            c[factors.constant_parameters(sensor)] = read(key)
    return c
