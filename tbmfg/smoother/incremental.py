"""Online smoothing with iSAM2, over the whole past or a fixed lag; one update per keyframe.

Kaess et al. (2012); QR throughout: where heading or biases are weak, Cholesky fails at once. The causal
estimate of a keyframe is the one taken when it was the newest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import gtsam
import numpy as np

from tbmfg.errors import EstimationError
from tbmfg.problem import Problem
from tbmfg.smoother.factors import Factors, Step, read_state, to_our_chart
from tbmfg.timeseries import Floats

RELINEARIZE = 1e-2  # change of any variable, in its own unit, from which it is linearised anew
SETTLE_UPDATES = 10  # iterations after the last keyframe
REANCHOR_INFLATION = 4.0  # of the covariance that a failed solver is started again from


@dataclass(slots=True)
class Online:
    """Causal states (n, 21 + e) and covariances, last estimates, and constants; by sensor and row the squared
    normalised residuals at the last estimate; ``reanchored`` lists (keyframe, reason)."""

    causal_x: Floats
    causal_cov: Floats
    last_x: Floats
    last_cov: Floats
    c: Floats
    c_cov: Floats
    nis: dict[str, Floats]
    reanchored: list[tuple[int, str]] = field(default_factory=list)


class _Full:
    """iSAM2 over the whole past behind the interface of a window that never closes."""

    def __init__(self) -> None:
        self.isam = gtsam.ISAM2(_isam_params())

    def update(self, step: Step, t: float, keys: list[int]) -> None:
        self.isam.update(step.graph, step.values)

    def values(self) -> gtsam.Values:
        return self.isam.calculateEstimate()

    def leaving(self, t: float, newest: int, oldest: int, times: Floats) -> list[int]:
        return []


class _Window:
    """GTSAM's fixed-lag smoother; constants get a fresh stamp with every update, or they would be marginalised."""

    def __init__(self, lag_s: float) -> None:
        self.lag_s = lag_s
        self.constants: set[int] = set()
        self.smoother = gtsam.IncrementalFixedLagSmoother(lag_s, _isam_params())

    @property
    def isam(self) -> gtsam.ISAM2:
        return self.smoother.getISAM2()

    def update(self, step: Step, t: float, keys: list[int]) -> None:
        self.constants |= set(step.constants)
        self.smoother.update(step.graph, step.values, dict.fromkeys([*keys, *self.constants], t))

    def values(self) -> gtsam.Values:
        return self.smoother.calculateEstimate()

    def leaving(self, t: float, newest: int, oldest: int, times: Floats) -> list[int]:
        """Keyframes that the next update at time ``t`` marginalises."""
        return [k for k in range(oldest, newest) if times[k] < t - self.lag_s]


def _isam_params() -> gtsam.ISAM2Params:
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.setRelinearizeThreshold(RELINEARIZE)
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return params


def run(problem: Problem, lag_s: float | None, progress: Callable[[float], None] | None = None) -> Online:
    """Smooth online: over ``lag_s`` seconds, or over the whole past where it is None."""
    factors, times = Factors(problem), problem.keyframes_s
    n, e = len(times), len(problem.drift_walk)
    m = len(problem.parameters.names)
    nis = {rows.sensor: np.full(len(rows), np.nan) for rows in problem.rows}
    out = Online(
        np.empty((n, 21 + e)), np.empty((n, 15 + e, 15 + e)), np.empty((n, 21 + e)), np.empty((n, 15 + e, 15 + e)),
        problem.parameters.start.copy(), np.zeros((m, m)), nis,
    )  # fmt: skip

    def fresh() -> _Full | _Window:
        return _Full() if lag_s is None else _Window(lag_s)

    solver, oldest = fresh(), 0
    step = factors.anchor(0, problem.prior.x, problem.prior.filter_cov)
    for k in range(n):
        if k > 0:
            step = Step(gtsam.NonlinearFactorGraph(), gtsam.Values(), [])
            factors.motion(k, out.causal_x[k - 1], step)
            for old in solver.leaving(times[k], k, oldest, times):
                _record(solver, factors, old, out.last_x, out.last_cov, e)
                _residuals(factors, old, out, _constants(solver, factors))
                oldest = old + 1
        guess = read_state(step.values, k, e)
        factors.measurements(k, guess, step)
        try:
            solver.update(step, times[k], factors.keys(k))
            _record(solver, factors, k, out.causal_x, out.causal_cov, e)
        except RuntimeError as error:
            if k == 0:
                raise EstimationError(
                    f"not determined at the start: {_reason(error)}; give priors in the rig"
                ) from error
            for old in range(oldest, k):
                out.last_x[old], out.last_cov[old] = out.causal_x[old], out.causal_cov[old]
                _residuals(factors, old, out, out.c)
            oldest, solver = k, fresh()
            step = factors.anchor(k, guess, _spread(problem, out.causal_cov[k - 1]))
            factors.measurements(k, guess, step, anchored=True)
            solver.update(step, times[k], factors.keys(k))
            _record(solver, factors, k, out.causal_x, out.causal_cov, e)
            out.reanchored.append((k, _reason(error)))
        if progress is not None and k % 50 == 0:
            progress(k / n)
    if lag_s is None:
        _settle(solver)
    values = solver.values()
    out.c = _constants(solver, factors)
    for k in range(oldest, n):
        out.last_x[k] = read_state(values, k, e)
        _residuals(factors, k, out, out.c)
        if lag_s is not None:
            out.last_cov[k] = _covariance(solver, factors, k, out.last_x[k])
    for sensor in range(len(problem.rows)):
        key, which = factors.constant_key(sensor), factors.constant_parameters(sensor)
        if key in factors.known:
            out.c_cov[np.ix_(which, which)] = solver.isam.marginalCovariance(key)
    return out


def _settle(solver: _Full) -> None:
    """Iterate until nothing is relinearised any more."""
    for _ in range(SETTLE_UPDATES):
        if solver.isam.update().getVariablesRelinearized() == 0:
            return


def _record(solver: _Full | _Window, factors: Factors, k: int, xs: Floats, covs: Floats, e: int) -> None:
    """Estimate and covariance of keyframe k as they are now."""
    isam = solver.isam
    values = gtsam.Values()
    values.insert(gtsam.symbol("x", k), isam.calculateEstimatePose3(gtsam.symbol("x", k)))
    values.insert(gtsam.symbol("v", k), isam.calculateEstimateVector(gtsam.symbol("v", k)))
    values.insert(gtsam.symbol("b", k), isam.calculateEstimateConstantBias(gtsam.symbol("b", k)))
    if e:
        values.insert(gtsam.symbol("d", k), isam.calculateEstimateVector(gtsam.symbol("d", k)))
    xs[k] = read_state(values, k, e)
    if not np.isfinite(xs[k]).all():
        raise RuntimeError(f"the state at keyframe {k} is not finite")
    covs[k] = _covariance(solver, factors, k, xs[k])


def _covariance(solver: _Full | _Window, factors: Factors, k: int, x: Floats) -> Floats:
    """Joint covariance of keyframe k's variables in our chart."""
    keys = factors.keys(k)
    joint = solver.isam.jointMarginalCovariance(keys)
    blocks = [[joint.at(a, b) for b in keys] for a in keys]
    return to_our_chart(np.block(blocks), x)


def _constants(solver: _Full | _Window, factors: Factors) -> Floats:
    """Calibrations as they are now, (m,)."""
    c = factors.problem.parameters.start.copy()
    for sensor, rows in enumerate(factors.problem.rows):
        key = factors.constant_key(sensor)
        if key in factors.known:
            isam = solver.isam
            read = isam.calculateEstimatePoint3 if rows.model == "prism" else isam.calculateEstimateVector
            c[factors.constant_parameters(sensor)] = read(key)
    return c


def _residuals(factors: Factors, k: int, out: Online, c: Floats) -> None:
    """Squared normalised residuals of keyframe k's rows at the last estimates, in place."""
    for starts, rows in zip(factors.starts, factors.problem.rows, strict=True):
        own = slice(starts[k], starts[k + 1])
        if own.start < own.stop:
            r = rows.evaluate_at(out.last_x[rows.i[own]], out.last_x[rows.j[own]], c, own)[0]
            out.nis[rows.sensor][own] = np.sum(r**2, axis=1)


def _spread(problem: Problem, cov: Floats) -> Floats:
    """Covariance that a solver is started again with: the last one widened, never beyond the prior's correlation."""
    return cov * REANCHOR_INFLATION + 1e-12 * np.eye(len(cov))


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
