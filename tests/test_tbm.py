"""The INS / total station filter: truth, consistency, the lever arm's worth, biases, and input that is not right."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

from tbmfg.errors import EstimationError, RigError
from tbmfg.estimators import estimate, unmet
from tbmfg.evaluation.metrics import nees
from tbmfg.filters import tbm
from tbmfg.filters.tbm import InsTs, Prediction
from tbmfg.measure import Samples
from tbmfg.prepare import prepare
from tbmfg.problem import Parameters
from tbmfg.rig import override
from tbmfg.sensors import Rows
from tbmfg.smoother import rrr
from tbmfg.state import BG, Counts
from tests.problems import clean_log, drive, log_of, state_errors, true_rig, true_states

ALONE = ("odometer", "magnetometer")


@cache
def problem(seed: int = 0, duration: float = 30.0):
    simulation = drive(seed, duration, imu_rate_hz=100.0)
    return prepare(log_of(simulation.log_series), simulation.rig, without=ALONE)


def run(problem, **switches):
    return tbm.run(tbm.view(problem, InsTs(**switches)), InsTs(**switches))


# ---- truth ----


def test_perfect_sensors_and_a_true_prior_give_the_truth():
    simulation = drive(0, 30.0, slide=0.0)
    clean = prepare(clean_log(simulation), true_rig(simulation), without=ALONE)
    found = run(clean)
    error = state_errors(found.x, true_states(simulation, clean, biases=False))
    sd = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    assert np.abs(error / sd).max() < 0.1
    assert found.nis["prism"].max() < 0.05
    assert not found.gated["prism"].any()


SEEDS = range(300, 308)
EPOCHS_S = (6.0, 16.0, 30.0)  # standing, driving, having turned
CELLS = [(epoch, size) for epoch in EPOCHS_S for size in (6, 15)]


@pytest.mark.slow
def test_normalised_errors_are_chi_square():
    values = {cell: [] for cell in CELLS}
    for seed in SEEDS:
        own = problem(seed)
        truth, found = true_states(drive(seed, 30.0, imu_rate_hz=100.0), own), run(own)
        for epoch, size in CELLS:
            k = int(np.argmin(np.abs(own.keyframes_s - epoch)))
            error = state_errors(found.x[k : k + 1], truth[k : k + 1])[:, :size]
            values[epoch, size] += nees(error, found.cov[k : k + 1, :size, :size]).tolist()
    alpha = 0.01 / len(CELLS)  # the risk of one false alarm is shared by all
    faults = []
    for (epoch, size), squares in values.items():
        low, high = chi2.ppf([alpha / 2, 1 - alpha / 2], size * len(SEEDS)) / size / len(SEEDS)
        mean = np.mean(squares) / size
        if not low < mean < high:
            faults.append(f"{size} states at {epoch:g} s: {mean:.2f} outside {low:.2f}..{high:.2f}")
    assert not faults, "; ".join(faults)


def test_without_the_lever_arm_the_body_is_where_the_prism_is():
    """0.91 m off: with a sound prior of the attitude the filter cannot hide it."""
    truth = true_states(drive(0, 30.0, imu_rate_hz=100.0), problem())
    off = [np.linalg.norm(state_errors(run(problem(), arm=arm).x, truth)[-1, 3:6]) for arm in ("estimated", "none")]
    assert off[0] < 0.03
    assert off[1] > 0.5


def test_a_fixed_arm_is_not_estimated():
    fixed, found = (estimate("tbm-ins-ts", with_switch(f"arm={arm}")) for arm in ("fixed", "estimated"))
    assert not fixed.calibration["prism_lever_arm_m"].estimated
    assert found.calibration["prism_lever_arm_m"].estimated
    # a known arm leaves less doubt of the position
    assert np.trace(fixed.trajectory.cov[-1, 3:6, 3:6]) < np.trace(found.trajectory.cov[-1, 3:6, 3:6])


def with_switch(*settings):
    return replace(problem(), rig=override(problem().rig, [f"estimators.tbm-ins-ts.{one}" for one in settings]))


# ---- biases ----


def test_gauss_markov_biases_fade_and_their_variance_stays():
    """E11: the printed sign grows them. After 600 s of 300 s there is exp(-2) of them left."""
    own = problem()
    small = np.diag(np.r_[np.zeros(9), np.full(3, own.rig.imu.acc_bias_sd**2), np.full(3, own.rig.imu.gyro_bias_sd**2)])
    x = own.prior.x[:21].copy()
    x[18:21] = 1e-6
    seconds, predicted = 20.0, Prediction(own, 10.0)
    last = int(np.searchsorted(own.inertial.steps.edges_s, seconds))
    moved, P = predicted(x, small, 0, last)
    elapsed = own.inertial.steps.edges_s[last] - own.inertial.steps.edges_s[0]
    assert_allclose(moved[18:21], 1e-6 * np.exp(-elapsed / 10.0), rtol=1e-9)
    # in pieces of 0.1 s: noise acts inside a piece and fades from its end
    assert_allclose(np.diag(P)[BG], own.rig.imu.gyro_bias_sd**2, rtol=0.011)


# ---- with LiDAR odometry ----


def odometry(truth, sigma_m=0.01):
    """Perfect steps from keyframe to keyframe, as rows of a LiDAR that lies in b."""
    R, p, n = truth[:, :9].reshape(-1, 3, 3), truth[:, 9:12], len(truth) - 1
    back = R[:-1].swapaxes(1, 2)
    z = np.hstack([(back @ R[1:]).reshape(n, 9), (back @ (p[1:] - p[:-1])[:, :, None])[:, :, 0]])
    still = np.concatenate([np.zeros(4), np.eye(3).ravel()])
    data = np.tile(np.concatenate([still, still, np.eye(3).ravel(), np.eye(6).ravel()]), (n, 1))
    i = np.arange(n)
    rows = Rows("lidar", "lidar", i, i + 1, z, data, np.ones((n, 6)), slice(0, 6), np.ones(n, dtype=int))
    return rrr.trusted(rows, rrr.RrrMf(sigma_m=sigma_m, sigma_deg=0.01))


def test_without_steps_the_graph_is_the_filter():
    filtered = run(problem())
    alone = rrr.solve(filtered.x, filtered.cov, [], np.zeros(6))
    assert_allclose(alone.x, filtered.x, atol=1e-12)
    sd = np.sqrt(np.diagonal(filtered.cov, axis1=1, axis2=2))
    assert np.abs((alone.cov - filtered.cov) / sd[:, :, None] / sd[:, None]).max() < 1e-9


def test_perfect_steps_smooth_the_filter():
    filtered, truth = run(problem()), true_states(drive(0, 30.0, imu_rate_hz=100.0), problem())
    fused = rrr.solve(filtered.x, filtered.cov, [odometry(truth, 1e-4)], np.zeros(6))
    off = [np.diff(state_errors(x, truth)[:, 3:6], axis=0) for x in (filtered.x, fused.x)]
    assert np.std(off[1]) < 0.1 * np.std(off[0])
    assert fused.nis["lidar"].mean() < 6
    assert np.all(
        np.trace(fused.cov[:, 3:6, 3:6], axis1=1, axis2=2) < np.trace(filtered.cov[:, 3:6, 3:6], axis1=1, axis2=2)
    )


def test_it_believes_whatever_the_odometry_says():
    """No robust loss: steps that are 20 cm wrong at 1 cm move the whole, and it is said."""
    own = problem()
    truth = true_states(drive(0, 30.0, imu_rate_hz=100.0), own)
    steps = odometry(truth)
    steps.z[60:80, 9] += 0.2
    names = own.parameters.names + tuple(f"lidar.mount_{a}" for a in "xyz") + tuple(f"lidar.turn_{a}" for a in "xyz")
    zero = np.zeros(6)
    parameters = Parameters(names, *(np.r_[part, zero] for part in (own.parameters.mean, own.parameters.sd)),
                            np.r_[own.parameters.start, zero])  # fmt: skip
    steps = replace(steps, calib=slice(len(names) - 6, len(names)))
    counts = {**own.counts, "lidar": Counts(received=len(steps))}
    wrong = replace(
        own, rows=[*own.rows, steps], parameters=parameters, counts=counts,
        samples={**own.samples, "lidar": Samples("lidar", own.keyframes_s[1:], steps.z)},
    )  # fmt: skip
    found = estimate("tbm-rrr-mf", wrong)
    assert found.counts["lidar"].used == len(steps)
    assert found.counts["prism"].parts() == found.counts["prism"].received
    assert any("lidar: " in line and "contradict" in line for line in found.warnings)
    assert any("covariance is too small" in line for line in found.warnings)
    assert np.abs(state_errors_of(found, truth, own)).max() > 0.02


def state_errors_of(found, truth, problem):
    return found.trajectory.position_n - problem.origin_n - truth[:, 9:12]


# ---- what is wrong ----


def test_fixes_of_another_place_are_gated_and_counted():
    own = problem()
    prism = own.samples["prism"]
    values = prism.values.copy()
    values[40:45] += [0.5, 0.0, 0.0]
    struck = replace(own, samples={**own.samples, "prism": replace(prism, values=values)})
    found = estimate("tbm-ins-ts", struck)
    assert found.innovations["prism"].gated[40:45].all()
    counts = found.counts["prism"]
    assert counts.gated == found.innovations["prism"].gated.sum() < 10
    assert counts.parts() == counts.received
    truth = true_states(drive(0, 30.0, imu_rate_hz=100.0), own)[:, 9:12] + own.origin_n
    assert np.abs(found.trajectory.position_n - truth).max() < 0.1


def test_a_prism_that_is_lost_for_long_is_carried_by_the_unit():
    simulation = drive(0, 60.0, imu_rate_hz=100.0)
    lost = prepare(log_of(simulation.log_series), simulation.rig, without=ALONE, outages=(("prism", 20.0, 50.0),))
    found = run(lost)
    truth = true_states(simulation, lost)
    k = int(np.argmin(np.abs(lost.keyframes_s - 49.0)))
    error, cov = state_errors(found.x[k : k + 1], truth[k : k + 1])[:, 3:6], found.cov[k : k + 1, 3:6, 3:6]
    assert np.sqrt(cov[0, 0, 0]) > 3 * np.sqrt(found.cov[k - 60, 3, 3])
    assert nees(error, cov)[0] < chi2.ppf(0.999, 3)


def test_what_it_needs_and_knows():
    simulation = drive(0, 30.0, imu_rate_hz=100.0)
    lacking = prepare(log_of(simulation.log_series), simulation.rig, without=("prism",))
    assert unmet("tbm-ins-ts", lacking) == "needs prism"
    with pytest.raises(EstimationError, match=r"^tbm-ins-ts needs prism, .*tbmfg info"):
        estimate("tbm-ins-ts", lacking)
    with pytest.raises(RigError, match=r"estimators\.tbm-ins-ts\.tau_s: should be greater than 0"):
        estimate("tbm-ins-ts", with_switch("tau_s=0"))
