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
    assert online.restarts == []
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


def test_rows_across_the_windows_edge_are_judged_by_one_solution():
    """A machine at rest turns by nothing from keyframe to keyframe; its heading, known to 0.3 deg, goes on moving."""
    simulation = problems.drive(1, 60.0)
    found = estimate("fixed-lag", prepare(problems.log_of(simulation.log_series), simulation.rig))
    rest = found.innovations["zero_rotation"]
    assert len(rest.nis) > 20
    assert np.nanmax(rest.nis) < 1.0
    assert not np.isnan(rest.nis).any()
    assert not rest.gated.any()


def test_counts_add_up_and_both_trajectories_come(problem):
    result = estimate("fixed-lag", problem)
    assert len(result.trajectory) == len(result.smoothed) == len(problem.keyframe_edges)
    assert all(count.parts() == count.received for count in result.counts.values())


FAILED = 29  # the keyframe behind which a solver is made to fail
SOLVERS = {
    "fixed-lag": (window._Window, "solve", ArithmeticError("3 unknowns of the window are not determined")),
    "isam2": (incremental, "_newest", RuntimeError("Indeterminate linear system\n(Symbol: x29)")),
}


@pytest.fixture(scope="module")
def sound(problem):
    """What the solvers give where nothing fails."""
    return {name: estimate(name, problem) for name in SOLVERS}


def failing(monkeypatch, name, times, problem):
    """The result of a solver that fails so many times in a row, with the line that says so and what it marks."""
    home, attribute, error = SOLVERS[name]
    solve, calls = getattr(home, attribute), []

    def fail(*arguments):
        calls.append(1)
        if FAILED < len(calls) <= FAILED + times:
            raise error
        return solve(*arguments)

    monkeypatch.setattr(home, attribute, fail)
    result = estimate(name, problem)
    assert np.isfinite(result.smoothed.cov).all()
    assert all(count.parts() == count.received for count in result.counts.values())
    [line] = [w for w in result.warnings if " failed behind " in w]
    assert "not determined" in line or "Indeterminate linear system (Symbol: x29)" in line
    [marked] = [interval for interval in result.intervals if interval.kind == "restarted"]
    assert marked.sensor == name
    assert marked.start_ns == problem.t_ns[FAILED - 1]
    return result, line, marked


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("times", [1, 2])
def test_a_failed_solver_starts_again_says_so_and_marks_it(problem, sound, monkeypatch, name, times):
    """Once: from the estimate before it, in doubt; a second time: in more doubt."""
    result, line, marked = failing(monkeypatch, name, times, problem)
    assert f"started again at {problem.keyframes_s[FAILED]:.1f} s" in line
    assert marked.end_ns == problem.t_ns[FAILED]
    sd, undisturbed = (np.sqrt(np.einsum("kii->ki", r.smoothed.cov)) for r in (result, sound[name]))
    # what lies before is known by what had come until then; fixes have told of the rest by the end
    assert_allclose(result.smoothed.cov[FAILED - 1], result.trajectory.cov[FAILED - 1], rtol=1e-6, atol=1e-18)
    # 3 %: the others were linearised, and their losses weighed, at somewhat other states
    assert np.all(sd[:FAILED] > 0.97 * undisturbed[:FAILED])
    assert sd[FAILED, 2] > 1.2 * undisturbed[FAILED, 2], "the heading is no longer known from before"
    far = np.linalg.norm(result.trajectory.position_n[-1] - sound[name].trajectory.position_n[-1])
    assert far < 4 * np.sqrt(np.trace(result.trajectory.cov[-1, 3:6, 3:6]))


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("times", [30, 10**9])
def test_a_solver_that_goes_on_failing_leaves_it_to_the_imu(problem, sound, monkeypatch, name, times):
    result, line, marked = failing(monkeypatch, name, times, problem)
    again = FAILED + (times - 1) // 3 if times == 30 else len(problem.t_ns) - 1
    assert marked.end_ns == problem.t_ns[again]
    assert f"by the IMU alone until {problem.keyframes_s[again]:.1f} s" in line
    assert ("started again" in line) == (times == 30)
    alone = slice(FAILED, again)
    sd = np.sqrt(np.einsum("kii->k", result.trajectory.cov[alone, 3:6, 3:6]))
    assert np.all(np.diff(sd) > 0), "nothing but the IMU"
    off = np.linalg.norm(result.trajectory.position_n - sound[name].trajectory.position_n, axis=1)[alone]
    assert np.all(off < 4 * sd)
    if times > 30:
        assert result.calibration["prism_lever_arm_m"].sd[0] > 0


def test_closing_iterations_that_fail_leave_the_causal_estimates(problem, monkeypatch):
    def fail(isam):
        raise RuntimeError("Indeterminate linear system")

    monkeypatch.setattr(incremental, "_settle", fail)
    result = estimate("isam2", problem)
    assert_allclose(result.smoothed.position_n, result.trajectory.position_n)
    assert any("are the causal ones: its closing iterations failed" in line for line in result.warnings)
    [marked] = [interval for interval in result.intervals if interval.kind == "restarted"]
    assert (marked.start_ns, marked.end_ns) == (problem.t_ns[0], problem.t_ns[-1])


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
