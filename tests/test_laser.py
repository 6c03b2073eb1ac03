"""The laser's spot: the model at the truth of an independent simulator, and what is found and left out of a log."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

import datasets
from tbmfg import sensors
from tbmfg.estimators import estimate
from tbmfg.prepare import prepare
from tbmfg.problem import Problem
from tbmfg.rig import override
from tests.problems import clean_log, log_of, true_states

CALIBRATED = ("sensors.laser.tilt_sd_deg=0.02", "sensors.laser.offset_sd_mm=1", "sensors.imu.noise_factor=1")


@cache
def simulation(name: str, seed: int = 0, duration: float = 20.0, **options: float):
    return datasets.make(name, seed=seed, duration=duration, **options)


def problem_of(recorded, *settings: str) -> Problem:
    return prepare(log_of(recorded.log_series), override(recorded.rig, settings))


def test_rows_hold_at_truth_while_the_machine_rocks():
    """Spots between keyframes 0.2 s apart are averaged there without a trace of the motion in between."""
    world = simulation("shaft-dynamic", nominal=1)
    problem = prepare(
        clean_log(world), override(world.rig, ["sensors.imu.noise_factor=1", "sensors.barometer.bias_sd_m=100"])
    )
    rows = next(rows for rows in problem.rows if rows.sensor == "laser")
    x = np.hstack([true_states(world, problem, biases=False), np.zeros((len(problem.keyframe_edges), 1))])
    residual, *_ = rows.evaluate(x, problem.parameters.mean)
    # clean spots are those of a plumb line
    assert np.abs(residual * rows.sigma).max() < 2e-5
    assert rows.samples.sum() == problem.counts["laser"].received - problem.counts["laser"].unused


def test_plumb_line_tilt_and_zero_by_hand():
    """Level and turned by nothing, 2 m below z = 0: the line has moved by 2 m x tilt, and y right is minus y of n."""
    x = np.concatenate([np.eye(3).ravel(), [0.003, 0.004, -2.0], np.zeros(9)])[None]
    data = np.array([[0.0, 0.0, 0, 0, 0, 1, 0, 0, 0, -1, 0, 0, 0]])
    spot, *_ = sensors.laser(np.zeros((1, 2)), data, x, x, np.array([1e-3, 2e-3, 5e-4, 0.0]))
    assert_allclose(spot[0], [-0.003 - 2e-3 + 5e-4, 0.004 + 4e-3], atol=1e-15)


def test_spots_off_the_detector_are_left_out_and_counted():
    world = simulation("shaft-dynamic", nominal=1)
    spots = next(s for s in world.log_series if s.topic == "/laser/spot")["point"][:, :2]
    limit_mm = 1e3 * float(np.quantile(np.abs(spots).max(axis=1), 0.9))
    problem = problem_of(world, f"sensors.laser.half_width_mm={limit_mm}", "sensors.imu.noise_factor=1")
    off = int((np.abs(spots) >= 0.999e-3 * limit_mm).any(axis=1).sum())
    count = problem.counts["laser"]
    assert off > 0
    assert any(line.startswith("laser: ") and f"in {off} of" in line for line in problem.warnings)
    rows = next(rows for rows in problem.rows if rows.sensor == "laser")
    assert rows.samples.sum() == count.received - count.unused - off


@pytest.mark.parametrize("estimator", ["batch", "ins", "fixed-lag"])
def test_the_spot_holds_the_machine_on_its_line(estimator):
    world = simulation("shaft-dynamic", nominal=1)
    result = estimate(estimator, problem_of(world, *CALIBRATED))
    path, t_s = result.trajectory, (result.trajectory.t_ns - world.start_ns) * 1e-9
    aside = path.position_n[:, :2] - world.truth(t_s).position[:, :2]
    assert np.sqrt(np.mean(aside**2)) < 1.5e-3  # a detector's zero known to 1 mm
    assert result.counts["laser"].used > 0.98 * result.counts["laser"].received - 20
    for name in ("tilt", "offset"):
        assert any(name in key for key in result.calibration), name
