"""Depth by air pressure: a cage in a shaft whose air is warmer than its thermometer says, simulated independently."""

from functools import cache

import numpy as np
import pytest

import datasets
from tbmfg.estimators import estimate
from tbmfg.prepare import prepare
from tbmfg.rig import override
from tests.problems import log_of

SETTINGS = ("sensors.imu.noise_factor=1",)


@cache
def ride(seed: int, survey_sd_m: float):
    options = {"vibration": 0.0, "survey_sd_m": survey_sd_m}
    return datasets.make("cage-fast", seed=seed, duration=40.0, **options)


def depth(simulation, estimator: str):
    """Result, and its error and sd of the last height [m]."""
    problem = prepare(log_of(simulation.log_series), override(simulation.rig, SETTINGS))
    result = estimate(estimator, problem)
    path = result.trajectory
    true = simulation.truth((path.t_ns - simulation.start_ns) * 1e-9).position[:, 2]
    return result, path.position_n[-1, 2] - true[-1], np.sqrt(path.cov[-1, 5, 5]), np.ptp(true)


@pytest.mark.parametrize("estimator", ["batch", "ins"])
def test_a_point_surveyed_at_the_bottom_tells_the_scale(estimator):
    simulation = ride(1, 0.05)
    result, error, sd, way = depth(simulation, estimator)
    assert abs(error) < 4.0 * sd
    assert sd < 0.06
    scale = result.calibration["barometer_scale"]
    # pressure falls with height as the air is dense: scale against 288.15 K at the height the readings seem to be at
    air_k = simulation.drawn["barometer"]["air_k"]
    assert scale.estimated
    assert scale.observed is True
    assert result.calibration["barometer_bias_m"].observed is True, "of 5 m that it may be off"
    assert abs(scale.value - (288.15 / air_k - 1.0)) < 4.0 * scale.sd + 0.001
    assert way > 20.0


def test_without_a_reference_depth_is_said_to_hang_on_the_temperature():
    result, error, sd, way = depth(ride(1, 0.0), "batch")
    assert 0.5 * 0.007 * way < sd
    assert abs(error) < 4.0 * sd
    assert any("depth is limited by the air's temperature" in line for line in result.warnings)


def test_between_surveyed_depths_the_airs_own_cooling_is_the_limit():
    """A shaft's dry air cools by 9.8 K/km, the standard atmosphere by 6.5: 3.3 / 288 / 1000 / 8 * 430^2 m halfway."""
    options = {"vibration": 0.0, "survey_sd_m": 0.05}
    simulation = datasets.make("cage-fast", seed=0, duration=135.3, **options)
    known, unknown = (
        estimate("batch", prepare(log_of(simulation.log_series), override(simulation.rig, (*SETTINGS, lapse))))
        for lapse in ("sensors.barometer.lapse_sd_kpkm=0", "sensors.barometer.lapse_sd_kpkm=3")
    )
    path = unknown.trajectory
    true = simulation.truth((path.t_ns - simulation.start_ns) * 1e-9).position[:, 2]
    halfway = int(np.argmin(np.abs(true + 215.0)))
    sd, sd_known = (np.sqrt(result.trajectory.cov[halfway, 5, 5]) for result in (unknown, known))
    assert abs(path.position_n[halfway, 2] - true[halfway]) < 2.0 * sd
    bulge = 3e-3 / 288.15 * 430.0**2 / 8
    assert 0.25 * bulge < np.sqrt(sd**2 - sd_known**2) < bulge  # the accelerometer tells a part of it
    assert any("depth is limited by how the air cools" in line for line in unknown.warnings)
