"""Batch smoothing: its factors against GTSAM's own graph, its losses, and what it says of outliers and rank."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, B, V, X
from numpy.testing import assert_allclose
from scipy.stats import chi2

from tbmfg.errors import EstimationError
from tbmfg.estimators import estimate
from tbmfg.filters import ins
from tbmfg.inertial.strapdown import correct_states, propagate
from tbmfg.problem import GATE, Parameters
from tbmfg.sensors import Rows
from tbmfg.smoother import batch, graph, losses
from tests.problems import ERRORS, flight_problem, gtsam_graph, gtsam_marginal, native_problem, state_errors, worst

LOSSES = ("none", "huber", "cauchy")


def rows_of(problem, sensor):
    return next(rows for rows in problem.rows if rows.sensor == sensor)


def with_rows(problem, sensor, rows):
    return replace(problem, rows=[rows if r.sensor == sensor else r for r in problem.rows])


def solved(problem):
    start = ins.run(problem)
    return batch.solve(problem, start.x, start.c)


def sds(cov):
    return np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))


# ---- losses ----


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("dof", [1, 3, 6])
def test_weight_is_the_slope_of_the_cost(loss, dof):
    """rho(s) of the normalised residual s: the weight is rho'(s) / s = 2 d rho / d s^2."""
    k2 = losses.threshold(dof) ** 2
    for nis in (1e-6, 0.3 * k2, 0.999 * k2, 1.001 * k2, 3 * k2, 500 * k2):
        h = 1e-5 * nis
        slope = (losses.cost(np.array([nis + h]), loss, dof) - losses.cost(np.array([nis - h]), loss, dof)) / h
        found = losses.weight(np.array([nis]), loss, dof)[0]
        # truncation h^2 rho''' / 3 is below 1e-9 of it, rounding eps rho / h
        assert found == pytest.approx(slope, rel=1e-8)
        assert 0 < found <= 1


@pytest.mark.parametrize("mu", [0.01, 1.0, 100.0])
@pytest.mark.parametrize("dof", [1, 3])
def test_graduated_weight_is_the_slope_of_its_cost(mu, dof):
    c2 = chi2.ppf(GATE, dof)
    low, high = mu / (mu + 1) * c2, (mu + 1) / mu * c2
    for nis in (0.5 * low, 0.9 * low + 0.1 * high, 0.2 * low + 0.8 * high, 1.5 * high):
        h = 1e-5 * nis
        ends = [losses.cost(np.array([nis + side * h]), "gnc", dof, mu) for side in (1, -1)]
        assert losses.weight(np.array([nis]), "gnc", dof, mu)[0] == pytest.approx((ends[0] - ends[1]) / h, abs=1e-6)
    assert losses.weight(np.array([1.1 * high]), "gnc", dof, mu)[0] == 0
    assert losses.cost(np.array([1.1 * high]), "gnc", dof, mu) == pytest.approx(0.5 * c2)


def test_first_of_the_graduated_losses_counts_every_row():
    nis = np.array([0.1, 5.0, 1600.0])
    assert np.all(losses.weight(nis, "gnc", 1, losses.first_mu(nis, 1)) > 0)


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_are_half_the_square_for_good_rows_and_add_up(loss):
    small = np.array([1e-4, 2e-4, 5e-5])
    assert losses.cost(small, loss, 3) == pytest.approx(0.5 * small.sum(), rel=1e-4)
    many = np.array([0.1, 3.0, 7.0, 60.0, 1e4])
    one_by_one = sum(losses.cost(many[k : k + 1], loss, 3) for k in range(5))
    assert losses.cost(many, loss, 3) == pytest.approx(one_by_one, rel=1e-12)
    assert losses.cost(many, loss, 3) <= 0.5 * many.sum()


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("sensor", ["prism", "magnetometer"])
def test_weighted_rows_have_the_gradient_of_the_loss(loss, sensor):
    problem = flight_problem(0, 8.0)
    rows = replace(rows_of(problem, sensor), loss=loss)
    rng, free = np.random.default_rng(0), problem.parameters.free
    x = np.tile(problem.prior.x, (len(problem.keyframe_edges), 1))  # far from the measurements: all weights matter
    c = problem.parameters.mean + 0.01
    block, nis = graph.sensor_block(rows, graph.States(x, c), free)
    assert (nis > losses.threshold(rows.dof) ** 2).any()
    direction, turn = rng.standard_normal((len(x), 15)), rng.standard_normal(len(free))

    def cost(step):
        moved = c.copy()
        moved[free] += step * turn
        _, nis = graph.sensor_block(rows, graph.States(correct_states(x, step * direction), moved), free)
        return losses.cost(nis, loss, rows.dof)

    h = 1e-6
    numeric = (cost(h) - cost(-h)) / (2 * h)
    linear = np.einsum("rkd,rd->rk", block.A_i, direction[block.i]) + block.A_c @ turn
    assert -np.sum(linear * block.b) == pytest.approx(numeric, rel=1e-6)


# ---- IMU factors ----


def test_cost_of_the_imu_is_that_of_gtsams_graph():
    problem = flight_problem(0, 8.0)
    x = ins.run(problem).x + 0.0
    x = correct_states(x, 1e-3 * np.random.default_rng(1).standard_normal((len(x), 15)))
    imu, zero = graph.imu_graph(problem, x), graph.no_bias(len(x))
    block = graph.imu_block(imu, x, zero, 0)
    error = imu.error(graph.values(x, zero))
    assert 0.5 * np.sum(block.b**2) == pytest.approx(error, rel=1e-9)
    assert error > 100


def test_values_are_the_states():
    x = ins.run(flight_problem(0, 8.0)).x[:5]
    values = graph.values(x, graph.no_bias(5))
    for k, row in enumerate(x):
        assert_allclose(values.atPose3(X(k)).rotation().matrix().ravel(), row[:9], atol=1e-12)
        assert_allclose(values.atPose3(X(k)).translation(), row[9:12])
        assert_allclose(values.atVector(V(k)), row[12:15])
        assert_allclose(values.atConstantBias(B(k)).vector(), row[15:21], atol=1e-15)


def test_imu_block_against_differences_of_gtsams_errors():
    """In our chart: rotation in b, position and velocity in n. GTSAM's own derivatives are part of what is tested."""
    problem = flight_problem(0, 8.0)
    x = ins.run(problem).x
    x = correct_states(x, 1e-4 * np.random.default_rng(2).standard_normal((len(x), 15)))
    imu, zero = graph.imu_graph(problem, x), graph.no_bias(len(x))
    block, k, h = graph.imu_block(imu, x, zero, 0), 30, 1e-6

    def residual(which, d):
        moved = x.copy()
        moved[k + which] = correct_states(x[k + which : k + which + 1], d[None])[0]
        return -graph.imu_block(imu, moved, zero, 0).b[k]

    for which, J in ((0, block.A_i[k]), (1, block.A_j[k])):
        numeric = np.stack([(residual(which, d) - residual(which, -d)) / (2 * h) for d in h * np.eye(15)], axis=1)
        # relative to the length of a column: truncation h, rounding of whitened residuals of size 10 over h
        tolerance = 1e-5 * np.linalg.norm(J, axis=0) + 4 * 2.2e-16 * np.abs(block.b[k]).max() / h
        fault = worst(J, numeric, tolerance[None] + 1e-9 * np.abs(J).max(), [f"r[{r}]" for r in range(15)], ERRORS)
        assert not fault, f"keyframe {'ij'[which]}: {fault}"


def test_imu_factor_says_the_same_as_the_filters_prediction():
    """-A_j^-1 A_i is the filter's transition, (A_j^T A_j)^-1 its process noise, A_j^-1 b what they differ in."""
    problem = flight_problem(0, 20.0)
    x, inertial, k = ins.run(problem).x.copy(), problem.inertial, 80
    first, last = problem.keyframe_edges[k : k + 2]
    noise = inertial.psd_gyro, inertial.psd_acc, inertial.psd_bg, inertial.psd_ba, inertial.earth_n, inertial.gravity_n
    x[k + 1], Phi, Q = propagate(x[k], first, last, inertial.steps.edges_s, inertial.gyro, inertial.acc, *noise)
    block = graph.imu_block(graph.imu_graph(problem, x), x, graph.no_bias(len(x)), 0)
    A_i, A_j = block.A_i[k], block.A_j[k]
    S = np.linalg.inv(A_j)
    sd = sds(Q)
    dt, count = 0.005, last - first
    T, rate = dt * count, np.linalg.norm(inertial.gyro[first:last], axis=1).max()
    first_order = 1.5 / count + rate * dt
    assert pytest.approx(0.1, abs=0.011) == T
    assert not (fault := worst(S @ S.T / np.outer(sd, sd), Q / np.outer(sd, sd), first_order, ERRORS, ERRORS)), fault
    # a transition moves what one second of sensors leaves open by less than the noise of this one interval
    scale = np.repeat([1e-2, 1e-2, 1e-2, 1e-2, 1e-3], 3)
    found, expected = -S @ A_i * scale / sd[:, None], Phi * scale / sd[:, None]
    assert not (fault := worst(found, expected, first_order, ERRORS, ERRORS)), fault
    assert np.abs(S @ block.b[k] / sd).max() < 0.01


# ---- GTSAM's own graph ----


@pytest.fixture(scope="module")
def native():
    """A problem whose sensors GTSAM has factors for, its solution, and the same as GTSAM's graph."""
    problem = native_problem()
    found = solved(problem)
    return problem, found, *gtsam_graph(problem, found.x, found.c)


def test_batch_ends_where_gtsam_ends(native):
    problem, found, g, values, arm = native
    assert 25 < len(problem.keyframe_edges) < 70
    optimised = gtsam.LevenbergMarquardtOptimizer(g, values).optimize()
    assert g.error(values) == pytest.approx(g.error(optimised), abs=1e-3)
    x = found.x.copy()
    for k in range(len(x)):
        pose = optimised.atPose3(X(k))
        x[k, :9], x[k, 9:12] = pose.rotation().matrix().ravel(), pose.translation()
        x[k, 12:15], x[k, 15:21] = optimised.atVector(V(k)), optimised.atConstantBias(B(k)).vector()
    # charts of the pose's prior differ in second order of its error, a degree
    assert np.abs(state_errors(x, found.x) / sds(found.cov)).max() < 0.02
    assert np.abs((optimised.atPoint3(A(0)) - found.c[arm]) / sds(found.c_cov)[arm]).max() < 0.02


def test_covariances_are_gtsams_marginals(native):
    _, found, g, values, arm = native
    marginals = gtsam.Marginals(g, values)
    for k in range(0, len(found.x), 7):
        sd = sds(found.cov[k])
        found_k, expected = (c / np.outer(sd, sd) for c in (found.cov[k], gtsam_marginal(marginals, k, found.x[k])))
        # Marginals is Cholesky: half the digits; the prior's chart as above
        assert not (fault := worst(found_k, expected, 2e-3, ERRORS, ERRORS)), f"keyframe {k}: {fault}"
    sd = sds(found.c_cov)[arm]
    theirs = marginals.marginalCovariance(A(0))
    assert_allclose(found.c_cov[arm, arm] / np.outer(sd, sd), theirs / np.outer(sd, sd), atol=2e-3)


# ---- the solution ----


def total_cost(problem, x, c):
    free = problem.parameters.free
    imu = graph.imu_graph(problem, x), graph.no_bias(len(x))
    return batch._linearise(problem, imu, graph.States(x, c), free)[2]


def test_the_solution_is_a_minimum_wherever_it_starts():
    problem = flight_problem(2, 12.0)
    start = ins.run(problem)
    found = batch.solve(problem, start.x, start.c)
    assert found.converged
    rng, sd = np.random.default_rng(3), sds(found.cov)
    away = correct_states(start.x, 5.0 * sd * rng.standard_normal(sd.shape))
    other = batch.solve(problem, away, start.c)
    assert other.converged
    assert np.abs(state_errors(other.x, found.x) / sd).max() < 0.03
    least = total_cost(problem, found.x, found.c)
    for _ in range(5):
        moved = correct_states(found.x, 0.3 * sd * rng.standard_normal(sd.shape))
        assert total_cost(problem, moved, found.c) > least


def test_covariances_and_residuals_at_given_states_are_those_of_the_solution():
    problem = flight_problem(2, 12.0)
    found = solved(problem)
    again = batch.at(problem, found.x, found.c)
    assert_allclose(sds(again.cov) / sds(found.cov), 1.0, atol=1e-3)
    for sensor, nis in found.nis.items():
        assert_allclose(again.nis[sensor], nis, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_outliers_are_gated_whatever_weight_the_loss_gave_them(loss):
    problem = flight_problem(2, 12.0)
    prism = rows_of(problem, "prism")
    z = prism.z.copy()
    bad = [20, 50, 51, 90]
    z[bad] += [[0.5, 0, 0], [0, -0.3, 0.2], [0.1, 0.1, 0.1], [0, 0, 5.0]]
    spoilt = with_rows(problem, "prism", replace(prism, z=z, loss=loss))
    result, clean = estimate("batch", spoilt), estimate("batch", problem)
    assert np.flatnonzero(result.innovations["prism"].gated).tolist() == bad
    counts = result.counts["prism"]
    assert counts.gated == len(bad)
    assert counts.used + counts.gated + counts.unused == counts.received
    assert result.innovations["prism"].nis[bad].min() > chi2.ppf(GATE, 3)
    difference = np.linalg.norm(result.trajectory.position_n - clean.trajectory.position_n, axis=1)
    # a fix of 3 mm is pulled by 2.8 sds at the most under Huber, and shared with its neighbours
    assert difference.max() < (8e-3 if loss == "huber" else 5e-3)


def test_without_a_loss_outliers_pull():
    problem = flight_problem(2, 12.0)
    prism = rows_of(problem, "prism")
    z = prism.z.copy()
    z[50] += [0.0, 0.5, 0.0]
    spoilt = with_rows(problem, "prism", replace(prism, z=z, loss="none"))
    moved = solved(spoilt).x[prism.j[50], 9:12] - solved(problem).x[prism.j[50], 9:12]
    # of half a metre; neighbours and IMU hold against it, and share it with the attitude. Under Huber it is 2 mm.
    assert np.linalg.norm(moved) > 0.05


def adrift(sd_m):
    """A flight without fixes, its first position known to ``sd_m``; what it is for the filter stays a metre."""
    problem = flight_problem(2, 12.0)
    cov = problem.prior.cov.copy()
    cov[3:6, 3:6] = sd_m**2 * np.eye(3)
    rows = [rows for rows in problem.rows if rows.model not in ("prism", "bounded")]
    return replace(problem, rows=rows, prior=replace(problem.prior, cov=cov))


def test_what_is_not_determined_is_held_named_and_marked():
    """No fixes, and next to no prior on the position: all else is as if it were known to a metre."""
    problem, metre = adrift(1e8), adrift(1.0)
    result, known = estimate("batch", problem), estimate("batch", metre)
    [line] = [line for line in result.warnings if line.startswith("no row determines position, ")]
    assert "prior in the rig" in line
    [marked] = [interval for interval in result.intervals if interval.kind == "undetermined"]
    assert (marked.sensor, marked.start_ns, marked.end_ns) == ("batch", problem.t_ns[0], problem.t_ns[-1])
    start, c = ins.run(problem).x, problem.parameters.start
    sd, sd_known = (sds(batch.at(one, start, c).cov) for one in (problem, metre))
    assert min(sd[:, 3:6].min(), sds(result.trajectory.cov)[:, 3:6].min()) > 1e4
    others = np.r_[0:3, 6:15]
    assert_allclose(sd[:, others], sd_known[:, others], rtol=5e-3)
    step, step_known = (np.diff(r.trajectory.position_n, axis=0) for r in (result, known))
    assert_allclose(step, step_known, atol=1e-4)
    assert np.linalg.norm(result.trajectory.position_n - start[:, 9:12], axis=1).max() < sd[:, 3:6].min()


def test_what_no_prior_can_determine_is_refused_in_one_line():
    problem = adrift(1.0)
    rows = rows_of(problem, "magnetometer")
    broken = with_rows(problem, "magnetometer", replace(rows, sigma=np.full_like(rows.sigma, np.nan)))
    start = ins.run(problem)
    with pytest.raises(EstimationError, match=r"^not determined: .* \(\d+ unknowns\); .*prior in the rig") as refused:
        batch.solve(broken, start.x, start.c)
    assert "\n" not in str(refused.value)


def test_iterations_that_do_not_converge_are_said_and_marked(monkeypatch):
    monkeypatch.setattr(batch, "MAX_ITERATIONS", 1)
    problem = flight_problem(2, 12.0)
    result = estimate("batch", problem)
    assert any(line.startswith("batch did not converge in 1 iterations") for line in result.warnings)
    [marked] = [interval for interval in result.intervals if interval.kind == "unconverged"]
    assert (marked.sensor, marked.start_ns, marked.end_ns) == ("batch", problem.t_ns[0], problem.t_ns[-1])


# ---- drifting calibrations ----


def barometer_rows(problem, truth_z, bias, rng):
    n = len(problem.keyframe_edges)
    k, one = np.arange(n), np.ones(n, dtype=int)
    z = (truth_z + bias + 0.1 * rng.standard_normal(n))[:, None]
    scale = slice(len(problem.parameters.names), len(problem.parameters.names) + 2)
    return Rows("barometer", "barometer", k, k, z, np.zeros((n, 4)), np.full((n, 1), 0.1), scale, one)


def test_a_drifting_bias_is_followed():
    """A barometer whose bias walks a metre, beside a prism that knows the height."""
    plain = flight_problem(2, 12.0)
    n, rng = len(plain.keyframe_edges), np.random.default_rng(4)
    walk, dt = 0.3, np.diff(plain.keyframes_s)
    bias = 2.0 + np.concatenate([[0.0], np.cumsum(walk * np.sqrt(dt) * rng.standard_normal(n - 1))])
    height = solved(plain).x[:, 11]
    prior, known = plain.prior, plain.parameters
    known = Parameters(
        (*known.names, "barometer.scale", "barometer.lapse"),
        *(np.append(v, [0.0, 0.0]) for v in (known.mean, known.sd, known.start)),
    )
    cov = np.zeros((16, 16))
    cov[:15, :15], cov[15, 15] = prior.cov, 5.0**2
    problem = replace(
        plain,
        rows=[*plain.rows, barometer_rows(plain, height, bias, rng)],
        parameters=known,
        drift_names=("barometer.bias",),
        drift_walk=np.array([walk]),
        prior=replace(prior, x=np.append(prior.x, 0.0), cov=cov, filter_cov=cov),
    )
    filtered = ins.run(problem)
    smoothed = batch.solve(problem, filtered.x, filtered.c)
    for found in (filtered, smoothed):
        normalised = (found.x[:, 21] - bias) / sds(found.cov)[:, 15]
        assert np.abs(normalised[1:]).max() < 4.5
        assert 0.5 < np.mean(normalised[1:] ** 2) < 2.0
    last = filtered.x[-1, 21] - smoothed.x[-1, 21]
    assert abs(last) < 0.1 * sds(smoothed.cov)[-1, 15]
    assert sds(smoothed.cov)[n // 2, 15] < 0.9 * sds(filtered.cov)[n // 2, 15]
