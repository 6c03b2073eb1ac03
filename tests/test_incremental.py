"""The online solvers: the same problem through GTSAM's incremental solvers ends where batch does."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X
from numpy.testing import assert_allclose

from tbmfg.estimators import estimate
from tbmfg.filters import ins
from tbmfg.prepare import prepare
from tbmfg.smoother import batch, incremental, window
from tbmfg.smoother.factors import Factors, Step, pose_chart
from tests import problems

DIMENSION = {"x": 6, "v": 3, "b": 6}  # of the variables by their letter; the odometer's scale has 1


@pytest.fixture(scope="module")
def problem():
    simulation = problems.drive(seed=4, duration=20.0)
    return prepare(problems.log_of(simulation.log_series), simulation.rig)


@pytest.fixture(scope="module")
def smoothed(problem):
    filtered = ins.run(problem)
    return batch.solve(problem, filtered.x, filtered.c)


@pytest.fixture(autouse=True)
def fine(monkeypatch):
    """The sds here are a millimetre and a tenth of a milliradian: linearise anew from far below the default on."""
    monkeypatch.setattr(incremental, "RELINEARIZE", 1e-4)


def test_isam2_ends_where_batch_does(problem, smoothed):
    online = incremental.run(problem)
    assert online.reanchored == []
    # 5 % of an sd: what iSAM2 leaves where it is until it moves by RELINEARIZE
    sd = np.sqrt(np.einsum("kii->ki", smoothed.cov))
    distance = np.abs(problems.state_errors(online.last_x, smoothed.x)) / sd
    assert distance.max() < 0.05, f"{distance.max():.3f} sd at {np.unravel_index(distance.argmax(), distance.shape)}"
    free = problem.parameters.free
    assert_allclose(online.c[free], smoothed.c[free], atol=0.05 * np.sqrt(smoothed.c_cov[free, free]).min())


def test_newest_estimate_is_that_of_the_whole_past(problem, smoothed):
    # the last keyframe has no future: causal and smoothed agree there, covariance included
    online = incremental.run(problem)
    assert_allclose(online.causal_x[-1], online.last_x[-1], atol=1e-4)
    assert_allclose(np.diag(online.causal_cov[-1]), np.diag(smoothed.cov[-1]), rtol=0.05)


def test_window_longer_than_the_log_is_isam2(problem):
    # without losses, whose weights the window iterates and iSAM2 takes as they come
    problem = replace(problem, rows=[replace(rows, loss="none") for rows in problem.rows])
    moving, whole = window.run(problem, 1000.0), incremental.run(problem)
    assert_allclose(moving.causal_x, whole.causal_x, atol=1e-3)


def test_last_estimate_of_the_window_beats_the_causal_one(problem):
    simulation = problems.drive(seed=4, duration=20.0)
    online, true = window.run(problem, 5.0), problems.true_states(simulation, problem)
    causal, last = (
        np.sqrt(np.mean(problems.state_errors(x, true)[:, 2] ** 2)) for x in (online.causal_x, online.last_x)
    )
    assert last < causal
    assert all(np.isfinite(nis).all() for nis in online.nis.values())


def test_counts_add_up_and_both_trajectories_come(problem):
    result = estimate("fixed-lag", problem)
    assert len(result.trajectory) == len(result.smoothed) == len(problem.keyframe_edges)
    assert all(count.parts() == count.received for count in result.counts.values())


def test_failed_window_starts_again_and_says_so(problem, monkeypatch):
    solve, calls = window._Window.solve, []

    def fail_once(self):
        calls.append(self.first)
        if len(calls) == 30:
            raise ArithmeticError("3 unknowns of the window are not determined")
        solve(self)

    monkeypatch.setattr(window._Window, "solve", fail_once)
    result = estimate("fixed-lag", problem)
    assert np.isfinite(result.trajectory.position_n).all()
    [line] = [w for w in result.warnings if "started again" in w]
    assert "not determined" in line
    assert f"{problem.keyframes_s[29]:.1f} s" in line


def test_failed_isam2_starts_again_and_says_so(problem, monkeypatch):
    record, calls = incremental._record, []

    def fail_once(isam, factors, k, out, e):
        calls.append(k)
        if len(calls) == 30:
            raise RuntimeError("Indeterminate linear system (Symbol: x29)")
        record(isam, factors, k, out, e)

    monkeypatch.setattr(incremental, "_record", fail_once)
    result = estimate("isam2", problem)
    assert np.isfinite(result.trajectory.position_n).all()
    [line] = [w for w in result.warnings if "started again" in w]
    assert "Indeterminate" in line
    assert f"{problem.keyframes_s[29]:.1f} s" in line


def test_custom_factors_have_the_jacobians_of_their_residuals(problem):
    x = ins.run(problem).x
    factors = Factors(problem)
    values, step = gtsam.Values(), Step(gtsam.NonlinearFactorGraph(), gtsam.Values())
    k = len(x) // 2
    for q in (k - 1, k):
        values.insert(X(q), gtsam.Pose3(gtsam.Rot3(x[q, :9].reshape(3, 3)), x[q, 9:12]))
        values.insert(V(q), x[q, 12:15])
        values.insert(B(q), gtsam.imuBias.ConstantBias(x[q, 15:18], x[q, 18:21]))
    factors.measurements(k, x[k], step)
    values.insert(step.values)
    customs = [step.graph.at(n) for n in range(step.graph.size())]
    customs = [factor for factor in customs if isinstance(factor, gtsam.CustomFactor)]
    assert len(customs) == 2, "odometer and magnetometer"
    delta = 1e-6
    for factor in customs:
        linear = factor.linearize(values)
        analytic, numeric = linear.getA().copy(), []  # a view: it lives no longer than its factor
        for key in factor.keys():  # noqa: SIM118 - a method of GTSAM's, no mapping
            for direction in np.eye(DIMENSION.get(chr(gtsam.Symbol(key).chr()), 1)):
                ends = []
                for sign in (delta, -delta):
                    move = gtsam.VectorValues()
                    move.insert(key, sign * direction)
                    ends.append(factor.whitenedError(values.retract(move)))
                numeric.append((ends[0] - ends[1]) / (2 * delta))
        # whitened rows reach a few hundred per unit: rounding eps r / delta and truncation stay far below 1e-3 of that
        assert_allclose(analytic, np.array(numeric).T, atol=1e-3 * np.abs(analytic).max())


def test_pose_chart_turns_the_position_into_n():
    x = np.concatenate([gtsam.Rot3.RzRyRx(0.3, -0.2, 1.1).matrix().ravel(), np.zeros(12)])
    assert_allclose(pose_chart(x)[3:, 3:], x[:9].reshape(3, 3))
    assert_allclose(pose_chart(x)[:3, :3], np.eye(3))
