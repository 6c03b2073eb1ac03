"""A magnetometer beside steel: a bias that lasts is found, named and left out; the simulator says what it did."""

from dataclasses import replace

import numpy as np
import pytest

import datasets
from tbmfg.estimators import estimate
from tbmfg.geometry import log_so3
from tbmfg.prepare import prepare
from tbmfg.residuals import BIASED
from tests.problems import log_of, true_states

SECONDS = 40.0  # the fault lasts from 10 to 30 s


def faulty(fault):
    settings = ("sensors.imu.noise_factor=1", "sensors.magnetometer.loss=gnc")
    simulation = datasets.make("shearer-magfault", seed=3, duration=SECONDS, settings=settings, fault=fault)
    return simulation, prepare(log_of(simulation.log_series), simulation.rig)


@pytest.fixture(scope="module")
def offset():
    return faulty("offset")


def yaw_errors_deg(simulation, problem, path):
    true = true_states(simulation, problem)[:, :9].reshape(-1, 3, 3)
    return np.rad2deg(log_so3(path.rotations() @ np.swapaxes(true, 1, 2))[:, 2])


def stretches(problem, result):
    t0 = problem.t0_ns
    return [((i.start_ns - t0) * 1e-9, (i.end_ns - t0) * 1e-9) for i in result.intervals if i.kind == "biased"]


@pytest.mark.parametrize(("name", "rms_deg"), [("batch", 0.25), ("fixed-lag", 0.5), ("ins", 0.5)])
def test_offset_is_found_within_a_second_and_left_out(offset, name, rms_deg):
    simulation, problem = offset
    result = estimate(name, problem)
    [(start, end)] = stretches(problem, result)
    assert start == pytest.approx(10.0, abs=1.0)
    assert end == pytest.approx(30.0, abs=1.0)
    # across 20 s the gyro drifts by 0.03 deg/sqrt(s) x sqrt(20 s) = 0.13 deg, and by what its bias was not yet known
    assert np.sqrt(np.mean(yaw_errors_deg(simulation, problem, result.trajectory) ** 2)) < rms_deg
    assert any("magnetometer: biased by" in line for line in result.warnings)


def test_huber_would_have_followed_it(offset):
    simulation, problem = offset
    rows = [replace(r, loss="huber") if r.model == "magnetometer" else r for r in problem.rows]
    result = estimate("batch", replace(problem, rows=rows))
    # at least by a fifth of the 20 degrees of the fault
    assert np.abs(yaw_errors_deg(simulation, problem, result.trajectory)).max() > 20.0 / 5.0


def test_slow_field_is_found_once_it_passes_three_sigma():
    simulation, problem = faulty("field")
    result = estimate("batch", problem)
    told = simulation.drawn["magnetometer"]
    effect = np.abs(told["fault_yaw_deg"]) > BIASED * problem.rig.sensors["magnetometer"].sigma_deg
    [recorded] = [s for s in simulation.log_series if s.topic == problem.rig.sensors["magnetometer"].topic]
    first = (recorded.t_ns[np.argmax(effect)] - problem.t0_ns) * 1e-9
    assert min(abs(start - first) for start, _ in stretches(problem, result)) < 1.0


def test_spikes_are_gated_one_by_one_and_are_no_stretch():
    simulation, problem = faulty("spikes")
    result = estimate("batch", problem)
    told = simulation.drawn["magnetometer"]
    [recorded] = [s for s in simulation.log_series if s.topic == problem.rig.sensors["magnetometer"].topic]
    five_sigma = 5.0 * problem.rig.sensors["magnetometer"].sigma_deg
    large = [k for k in told["spikes"] if abs(told["fault_yaw_deg"][k]) > five_sigma]
    gated_ns = result.innovations["magnetometer"].t_ns[result.innovations["magnetometer"].gated]
    found = [np.abs(gated_ns - t).min() < 0.06e9 for t in recorded.t_ns[large]]
    assert len(large) > 10
    assert np.mean(found) >= 0.95
    assert stretches(problem, result) == []
