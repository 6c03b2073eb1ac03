"""The Cramer-Rao bounds against the filter's Riccati, GTSAM's Marginals, and what the truth leaves open."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose

from tbmfg import bounds
from tbmfg.filters import ins
from tbmfg.geometry import quat_from_matrix
from tbmfg.prepare import prepare
from tbmfg.smoother.graph import States
from tbmfg.state import Truth
from tests.problems import (
    ERRORS,
    NATIVE,
    clean_log,
    flight,
    flight_problem,
    gtsam_graph,
    gtsam_marginal,
    native_problem,
    state_errors,
    true_rig,
    true_states,
    worst,
)


def sds(cov):
    return np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))


def truth_of(simulation, problem, arm_b=(0.0, 0.0, 0.0), rows=slice(None)):
    """The simulation's truth at the keyframes, of a point at ``arm_b``."""
    x = true_states(simulation, problem)[rows]
    R = x[:, :9].reshape(-1, 3, 3)
    at = x[:, 9:12] + problem.origin_n + R @ np.array(arm_b)
    return Truth(problem.t_ns[rows], at, quat_from_matrix(R), x[:, 12:15], np.array(arm_b))


def test_the_last_keyframe_knows_the_whole_log_either_way():
    problem = flight_problem(0, 8.0)
    x = true_states(flight(0, 8.0), problem)
    smoothing, filtering = bounds.covariances(problem, States(x, problem.parameters.mean))
    scale = np.outer(sds(smoothing[-1]), sds(smoothing[-1]))
    assert_allclose(filtering[-1] / scale, smoothing[-1] / scale, atol=1e-9)
    # and never is a keyframe better known by less
    gained = np.linalg.eigvalsh((filtering - smoothing) / (sds(filtering)[:, :, None] * sds(filtering)[:, None, :]))
    assert gained.min() > -1e-9
    assert gained.max() > 0.5


def test_filtering_bound_is_the_riccati_of_the_filter_at_truth():
    """Perfect sensors and priors: the filter stays at the truth, so that it linearises there."""
    simulation = flight(0, 12.0)
    problem = prepare(clean_log(simulation), true_rig(simulation))
    found = ins.run(problem)
    x = true_states(simulation, problem, biases=False)
    strayed = np.abs(state_errors(found.x, x)).max(axis=0) / sds(found.cov).max(axis=0)
    assert strayed.max() < 0.2
    _, filtering = bounds.covariances(problem, States(x, found.c))
    # GTSAM's factor and the filter's prediction agree to the first order of a period in an interval of some 20 periods
    for k in (0, 5, 40, len(x) - 1):
        scale = np.outer(sds(found.cov[k]), sds(found.cov[k]))
        assert not (fault := worst(filtering[k] / scale, found.cov[k] / scale, 0.1, ERRORS, ERRORS)), f"{k}: {fault}"
    assert_allclose(sds(filtering), sds(found.cov), rtol=0.05)


@pytest.mark.parametrize("last", [7, 30, None])
def test_bounds_are_gtsams_marginals(last):
    """Of the whole graph, and of the graph cut off after the newest keyframe."""
    problem = native_problem()
    x = true_states(flight(1, 6.0, NATIVE), problem)
    # GTSAM's prior of the pose is linearised at the state, ours at its mean: bring both together
    problem = replace(problem, prior=replace(problem.prior, x=x[0]))
    smoothing, filtering = bounds.covariances(problem, States(x, problem.parameters.mean))
    g, values, _ = gtsam_graph(problem, x, problem.parameters.mean, last)
    marginals = gtsam.Marginals(g, values)
    for k in [last] if last else (0, 13, 30, len(x) - 1):
        ours = filtering[k] if last else smoothing[k]
        found, expected_ = (c / np.outer(sds(ours), sds(ours)) for c in (ours, gtsam_marginal(marginals, k, x[k])))
        # Marginals is Cholesky: half the digits
        assert not (fault := worst(found, expected_, 2e-3, ERRORS, ERRORS)), f"keyframe {k}: {fault}"


def test_losses_do_not_count():
    problem = flight_problem(0, 8.0)
    states = States(true_states(flight(0, 8.0), problem), problem.parameters.mean + 0.05)  # far off: all rows doubted
    robust = replace(problem, rows=[replace(rows, loss="cauchy") for rows in problem.rows])
    for one, two in zip(bounds.covariances(problem, states), bounds.covariances(robust, states), strict=True):
        assert_allclose(one, two, rtol=1e-12)


def test_what_the_truth_does_not_tell_hardly_matters():
    """Biases and calibrations from the filter in place of the true ones; no velocity; a point; half of it."""
    simulation, problem = flight(0, 20.0), flight_problem(0, 20.0)
    x = true_states(simulation, problem)
    drawn, c = simulation.drawn["prism"], problem.parameters.mean.copy()
    c[problem.parameters.slice("prism")] = [
        *drawn["arm_m"],
        drawn["clock_offset_s"] - problem.clocks["prism"].offset_s,
        1e-6 * drawn["clock_drift_ppm"] - problem.clocks["prism"].drift,
    ]
    exact = bounds.covariances(problem, States(x, c))
    truth = truth_of(simulation, problem)
    half = slice(0, len(x) // 2)
    for known in (
        truth,
        replace(truth, velocity_n=None),
        truth_of(simulation, problem, arm_b=(0.3, -0.2, 0.5)),
        truth_of(simulation, problem, rows=half),
    ):
        found = bounds.cramer_rao(problem, known)
        for cov, path in zip(exact, (found.smoothing, found.filtering), strict=True):
            assert_allclose(sds(path.cov)[half], sds(cov)[half], rtol=0.05)
        assert_allclose(found.smoothing.position_n[half], truth.position_n[half], atol=1e-9)
        assert_allclose(found.smoothing.rotations()[half].reshape(-1, 9), x[half, :9], atol=1e-9)
