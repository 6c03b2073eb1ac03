"""A sensor's clock that runs fast or slow against the IMU's: drawn from its prior, found, and not worse than known."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from tbmfg.estimators import estimate
from tbmfg.evaluation.metrics import nees
from tbmfg.prepare import prepare
from tbmfg.prepare import search as clocks
from tbmfg.rig import override
from tests.problems import flight, log_of, state_errors, true_states

SD_PPM = 1000.0  # 20 ms in the flights of 20 s: what 5.6 ppm make of an hour
SEEDS = range(30, 33)
ESTIMATORS = ("batch", "ins", "fixed-lag", "isam2")
ALPHA = 0.01 / (3 * len(ESTIMATORS))  # the risk of one false alarm is shared by all


@cache
def drifting(seed, *settings):
    """A flight with a drifting prism, and the problem that it makes of the simulation's rig with ``settings``."""
    simulation = flight(seed, 20.0, (f"sensors.prism.clock_drift_sd_ppm={SD_PPM}",), prism_rate_hz=5.0)
    return simulation, prepare(log_of(simulation.log_series), override(simulation.rig, settings))


@cache
def errors(seed, estimator, *settings):
    """Error of position at the keyframes [m], NEES of the last pose, error of the drift over its sd, and that sd."""
    simulation, problem = drifting(seed, *settings)
    result = estimate(estimator, problem)
    path = result.smoothed or result.trajectory
    biases = path.bias_acc, path.bias_gyro
    x = np.hstack([path.rotations().reshape(-1, 9), path.position_n - problem.origin_n, path.velocity_n, *biases])
    error = state_errors(x, true_states(simulation, problem))
    drift = result.calibration["prism_clock_drift_ppm"]
    assert drift.observed is (True if drift.estimated else None)
    z = (drift.value - simulation.drawn["prism"]["clock_drift_ppm"]) / drift.sd if drift.estimated else np.nan
    return error[:, 3:6], nees(error[-1:, :6], path.cov[-1:, :6, :6])[0], z, drift.sd


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_drift_is_found_with_an_honest_sd(estimator):
    _, pose, z, sd = zip(*(errors(seed, estimator) for seed in SEEDS), strict=True)
    assert max(sd) < 0.1 * SD_PPM
    for squares, dof in ((np.square(z), len(SEEDS)), (pose, 6 * len(SEEDS))):
        low, high = chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], dof)
        assert low < np.sum(squares) < high


def test_a_drift_that_nobody_estimates_costs_more_than_one_that_is_found():
    rms = {}
    for told in ((), ("sensors.prism.clock_drift_sd_ppm=0",)):
        rms[told] = np.sqrt(np.mean([np.mean(errors(seed, "batch", *told)[0] ** 2) for seed in SEEDS]))
    assert rms[()] < 0.9 * rms["sensors.prism.clock_drift_sd_ppm=0",]


def test_a_known_drift_is_taken_out():
    """As told, the stamps are those of a clock that does not drift."""
    simulation = flight(3, 8.0, ("sensors.prism.clock_drift_ppm=500",))
    still = flight(3, 8.0)
    told, plain = (prepare(log_of(s.log_series), s.rig) for s in (simulation, still))
    assert simulation.drawn["prism"]["clock_drift_ppm"] == 500
    # 500 ppm of a stamp in place of a time: of an offset of 40 ms 0.02 ms
    assert told.samples["prism"].t_s == pytest.approx(plain.samples["prism"].t_s, abs=3e-5)
    found = estimate("batch", told).calibration["prism_clock_drift_ppm"]
    assert (found.value, found.estimated) == (500.0, False)


def test_of_a_long_log_the_drift_is_found_on_all_of_it(monkeypatch):
    """Offset and noise are searched on its beginning."""
    simulation, whole = drifting(SEEDS[0])
    monkeypatch.setattr(clocks, "SEARCH_S", 8.0)
    begun = prepare(log_of(simulation.log_series), simulation.rig)
    own, other = (problem.calibration["prism_clock_drift_ppm"] for problem in (whole, begun))
    assert other.sd == pytest.approx(own.sd, rel=0.1)
    assert abs(other.value - simulation.drawn["prism"]["clock_drift_ppm"]) < 4.0 * other.sd


def test_a_drift_beyond_its_prior_is_said():
    simulation = flight(4, 15.0, ("sensors.prism.clock_drift_ppm=3000",))
    rig = override(simulation.rig, ["sensors.prism.clock_drift_ppm=0", "sensors.prism.clock_drift_sd_ppm=100"])
    problem = prepare(log_of(simulation.log_series), rig)
    assert any("the clock drift ran to 3 sd of its prior, 300.000 ppm" in line for line in problem.warnings)
