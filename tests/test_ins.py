"""The error-state filter: truth without noise, batch's last epoch, gates that close and open again."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tbmfg.estimators import estimate
from tbmfg.filters import ins
from tbmfg.prepare import prepare
from tbmfg.rig import override
from tbmfg.smoother import batch
from tests.problems import clean_log, drive, flight, flight_problem, log_of, state_errors, true_rig, true_states

NO_LOSS = ("sensors.prism.loss=none", "sensors.magnetometer.loss=none")


def rows_of(problem, sensor):
    return next(rows for rows in problem.rows if rows.sensor == sensor)


def sds(cov):
    return np.sqrt(np.diagonal(cov, axis1=1, axis2=2))


# ---- without noise ----


@pytest.mark.parametrize("world", ["flight", "drive"])
@pytest.mark.parametrize("estimator", ["ins", "batch"])
def test_perfect_sensors_and_a_true_prior_give_the_truth(world, estimator):
    """What is left is what the models leave out (see their tests), and small beside the sensors' noise."""
    simulation = flight(0, 20.0, stand_s=-5.0) if world == "flight" else drive(0, 30.0, slide=0.0)
    problem = prepare(clean_log(simulation), true_rig(simulation))
    found = ins.run(problem)
    if estimator == "batch":
        found = batch.solve(problem, found.x, found.c)
        assert found.converged
    error = state_errors(found.x, true_states(simulation, problem, biases=False))
    assert np.abs(error / sds(found.cov)).max() < 0.1
    for rows in problem.rows:
        assert found.nis[rows.sensor].max() < 0.02
    free = problem.parameters.free
    assert np.abs((found.c - problem.parameters.mean)[free] / np.sqrt(np.diag(found.c_cov))[free]).max() < 0.1


def test_a_wrong_prior_is_overcome_within_its_sds():
    """Perfect sensors; position, velocity, attitude, arm and clock start where the rig's priors drew them."""
    simulation = flight(3, 30.0, ("sensors.prism.clock_offset_s=0",))
    problem = prepare(log_of(list(simulation.clean.values())), simulation.rig)
    found = ins.run(problem)
    error = state_errors(found.x, true_states(simulation, problem, biases=False))
    normalised = error / sds(found.cov)
    assert np.abs(normalised[0, 3:6]).max() < 4
    # without noise the posterior is pulled by the prior only: a fraction of a sd once the sensors outweigh it
    assert np.abs(normalised[-50:]).max() < 2
    assert np.linalg.norm(error[-50:, 3:6], axis=1).max() < 5e-3


# ---- beside the batch solution ----


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("world", ["flight", "drive"])
def test_last_epoch_is_that_of_the_batch_solution(world, seed):
    """In the linear case they are the same; here they differ by where they linearise, a fraction of a sd."""
    if world == "flight":
        problem = flight_problem(seed, 20.0, NO_LOSS)
    else:
        simulation = drive(seed, 20.0, (*NO_LOSS, "sensors.odometer.loss=none"))
        problem = prepare(log_of(simulation.log_series), simulation.rig)
    filtered = ins.run(problem)
    assert not any(gated.any() for gated in filtered.gated.values())
    smoothed = batch.solve(problem, filtered.x, filtered.c)
    sd = sds(smoothed.cov)[-1]
    assert np.abs(state_errors(filtered.x[-1:], smoothed.x[-1:])[0] / sd).max() < 0.15
    correlation = smoothed.cov[-1] / np.outer(sd, sd)
    assert_allclose(filtered.cov[-1] / np.outer(sd, sd), correlation, atol=0.02)
    free = problem.parameters.free
    c_sd = np.sqrt(np.diag(smoothed.c_cov))[free]
    assert np.abs((filtered.c - smoothed.c)[free] / c_sd).max() < 0.3
    assert_allclose(filtered.c_cov[np.ix_(free, free)] / np.outer(c_sd, c_sd),
                    smoothed.c_cov[np.ix_(free, free)] / np.outer(c_sd, c_sd), atol=0.02)  # fmt: skip


def test_smoothing_never_knows_less():
    problem = flight_problem(1, 20.0, NO_LOSS)
    filtered = ins.run(problem)
    smoothed = batch.solve(problem, filtered.x, filtered.c)
    assert (sds(smoothed.cov) / sds(filtered.cov)).max() < 1.01
    assert np.linalg.eigvalsh(smoothed.cov / sds(smoothed.cov)[:, :, None] / sds(smoothed.cov)[:, None]).min() > 0


def test_covariances_are_symmetric_and_positive():
    filtered = ins.run(flight_problem(0, 20.0))
    scaled = filtered.cov / sds(filtered.cov)[:, :, None] / sds(filtered.cov)[:, None]
    assert_allclose(scaled, np.swapaxes(scaled, 1, 2), atol=1e-12)
    assert np.linalg.eigvalsh(scaled).min() > 0


def test_a_displacement_is_measured_from_where_the_last_keyframe_is_now_known_to_be():
    """The first fix moves the machine by 6 cm, and the keyframe before it as well: no way has been driven."""
    simulation = drive(0, 20.0, slide=0.0)
    rig = true_rig(simulation)
    away = np.add(rig.initial.position, [0.06, -0.03, 0.02]).tolist()
    problem = prepare(clean_log(simulation), override(rig, [f"initial.position_m={away}"]))
    assert problem.keyframe_edges[0] not in problem.keyframe_edges[rows_of(problem, "prism").j]
    found = ins.run(problem)
    assert not found.gated["odometer"].any()
    assert found.nis["odometer"].max() < 0.1
    assert np.linalg.norm(found.x[1, 9:12] - found.x[0, 9:12]) > 0.05


def test_parameters_may_be_held():
    problem = flight_problem(0, 20.0)
    held = ins.run(problem, fixed=("arm_x", "arm_y", "arm_z", "declination"))
    names = problem.parameters.names
    for k, name in enumerate(names):
        if not name.endswith("clock_offset"):
            assert held.c[k] == problem.parameters.start[k]
            assert held.c_cov[k, k] == 0
    offset = names.index("prism.clock_offset")
    assert 0 < held.c_cov[offset, offset] < problem.parameters.sd[offset] ** 2


# ---- gates ----


def with_prism(problem, change):
    """The problem with the prism's fixes moved by ``change`` (n, 3) m."""
    rows = [replace(r, z=r.z + change) if r.sensor == "prism" else r for r in problem.rows]
    return replace(problem, rows=rows)


def prism_of(problem):
    return rows_of(problem, "prism")


def test_a_gross_outlier_is_gated_and_does_no_harm():
    problem = flight_problem(1, 20.0)
    change = np.zeros((len(prism_of(problem)), 3))
    change[120] = [0.0, 1.0, 0.0]
    clean, spoilt = ins.run(problem), ins.run(with_prism(problem, change))
    assert np.flatnonzero(spoilt.gated["prism"]).tolist() == [120]
    assert spoilt.nis["prism"][120] > 1e3
    k = prism_of(problem).j[120]
    # a fix is missing instead: within its own sd at once, and gone later
    assert np.abs(spoilt.x[:k] - clean.x[:k]).max() == 0
    assert np.linalg.norm(spoilt.x[k, 9:12] - clean.x[k, 9:12]) < 0.02
    assert np.linalg.norm(spoilt.x[-1, 9:12] - clean.x[-1, 9:12]) < 2e-3
    assert spoilt.reopened["prism"] == 0


def test_the_gate_opens_when_it_is_the_state_that_is_wrong():
    """The station is set up anew and its frame is shifted by a metre: after ten rejections the filter follows."""
    problem = flight_problem(1, 20.0)
    change = np.zeros((len(prism_of(problem)), 3))
    change[100:] = [1.0, 0.0, 0.0]
    found = ins.run(with_prism(problem, change))
    gated = found.gated["prism"]
    assert gated[100 : 100 + ins.REOPEN].all()
    assert not gated[100 + ins.REOPEN]
    assert found.reopened["prism"] >= 1
    result = estimate("ins", with_prism(problem, change))
    marked = [interval for interval in result.intervals if interval.kind == "reopened"]
    assert len(marked) == found.reopened["prism"]
    t_ns = problem.t_ns[prism_of(problem).j]
    assert (marked[0].sensor, marked[0].start_ns) == ("prism", t_ns[100])
    assert marked[0].end_ns == t_ns[100 + ins.REOPEN]
    plain = ins.run(problem)
    # it follows; attitude and biases, which had to give way too, take longer than these ten seconds to come back
    assert_allclose(found.x[-1, 9:12] - plain.x[-1, 9:12], [1.0, 0.0, 0.0], atol=0.4)


def test_likelihood_cost_prefers_the_true_noise():
    """Scaled process noise costs more, to either side."""
    problem = flight_problem(1, 20.0)

    def cost(factor):
        inertial = problem.inertial
        scaled = replace(inertial, white_gyro=factor**2 * inertial.white_gyro, white_acc=factor**2 * inertial.white_acc)
        return ins.run(replace(problem, inertial=scaled)).cost

    costs = [cost(factor) for factor in (0.2, 1.0, 5.0)]
    assert costs[1] < min(costs[0], costs[2]) - 10
