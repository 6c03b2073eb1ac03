"""Smoothing online over the whole past with GTSAM's iSAM2, one update per keyframe.

Kaess et al. (2012); QR throughout: where heading or biases are weak, Cholesky fails at once.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, D, V, X

from tbmfg.errors import EstimationError
from tbmfg.problem import Problem
from tbmfg.smoother.factors import Factors, Step, read_state, to_our_chart
from tbmfg.smoother.online import REANCHOR_INFLATION, Online
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


def run(problem: Problem, progress: Callable[[float], None] | None = None) -> Online:
    """Smooth online over the whole past. ``last_cov`` is left open: the batch smoother's linear algebra gives it at
    once. Raises EstimationError where the start is not determined."""
    factors, n, e = Factors(problem), len(problem.keyframe_edges), len(problem.drift_walk)
    out = Online.empty(problem)
    isam, oldest = gtsam.ISAM2(_isam_params()), 0
    step = factors.anchor(0, problem.prior.x, problem.prior.filter_cov)
    for k in range(n):
        if k > 0:
            step = Step(gtsam.NonlinearFactorGraph(), gtsam.Values())
            factors.motion(k, out.causal_x[k - 1], step)
        guess = read_state(step.values, k, e)
        factors.measurements(k, guess, step)
        try:
            isam.update(step.graph, step.values)
            _record(isam, factors, k, out, e)
        except RuntimeError as error:
            if k == 0:
                raise EstimationError(
                    f"not determined at the start: {_reason(error)}; give priors in the rig"
                ) from error
            out.last_x[oldest:k] = out.causal_x[oldest:k]
            oldest, isam = k, gtsam.ISAM2(_isam_params())
            step = factors.anchor(k, guess, out.causal_cov[k - 1] * REANCHOR_INFLATION)
            factors.measurements(k, guess, step, anchored=True)
            isam.update(step.graph, step.values)
            _record(isam, factors, k, out, e)
            out.reanchored.append((k, _reason(error)))
        if progress is not None:
            progress(k / n)
    _settle(isam)
    values = isam.calculateEstimate()
    out.c = _constants(isam, factors)
    for k in range(oldest, n):
        out.last_x[k] = read_state(values, k, e)
    out.residuals(problem, slice(0, n), out.c)
    for sensor in range(len(problem.rows)):
        key, which = factors.constant_key(sensor), factors.constant_parameters(sensor)
        if key in factors.known:
            out.c_cov[np.ix_(which, which)] = isam.marginalCovariance(key)
    return out


def _settle(isam: gtsam.ISAM2) -> None:
    """Iterate until nothing is relinearised any more."""
    for _ in range(SETTLE_UPDATES):
        if isam.update().getVariablesRelinearized() == 0:
            return


def _record(isam: gtsam.ISAM2, factors: Factors, k: int, out: Online, e: int) -> None:
    """Keep estimate and covariance of the newest keyframe."""
    values = gtsam.Values()
    values.insert(X(k), isam.calculateEstimatePose3(X(k)))
    values.insert(V(k), isam.calculateEstimateVector(V(k)))
    values.insert(B(k), isam.calculateEstimateConstantBias(B(k)))
    if e:
        values.insert(D(k), isam.calculateEstimateVector(D(k)))
    x = read_state(values, k, e)
    if not np.isfinite(x).all():
        raise RuntimeError(f"the state at keyframe {k} is not finite")
    keys = factors.keys(k)
    joint = isam.jointMarginalCovariance(keys)
    blocks = [[joint.at(a, b) for b in keys] for a in keys]
    out.causal_x[k], out.causal_cov[k] = x, to_our_chart(np.block(blocks), x)


def _constants(isam: gtsam.ISAM2, factors: Factors) -> Floats:
    """Calibrations as they are now, (m,)."""
    c = factors.problem.parameters.start.copy()
    for sensor, rows in enumerate(factors.problem.rows):
        key = factors.constant_key(sensor)
        if key in factors.known:
            read = isam.calculateEstimatePoint3 if rows.model == "prism" else isam.calculateEstimateVector
            c[factors.constant_parameters(sensor)] = read(key)
    return c


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
