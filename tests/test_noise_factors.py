"""Noise factors of the sensors beside the IMU: found without truth, with an uncertainty that holds."""

import numpy as np
import pytest
from scipy.stats import binom, chi2

import datasets
from tbmfg.prepare import prepare
from tbmfg.rig import override
from tests.problems import drive, log_of

SENSORS = ("prism", "odometer", "magnetometer")
INSIDE_2SD = 0.9545


def found(seed, factors, *settings):
    """The problem of a drive with that much noise, whose rig has all to be found."""
    noisy = tuple(f"sensors.{name}.noise_factor={factor}" for name, factor in factors.items())
    simulation = drive(seed, 20.0, noisy, imu_rate_hz=100.0)
    rig = override(simulation.rig, [f"sensors.{name}.noise_factor=auto" for name in factors] + list(settings))
    return prepare(log_of(simulation.log_series), rig)


def test_half_and_three_times_the_noise_are_found_within_their_sds():
    z = []
    for seed in range(4):
        factors = dict(zip(SENSORS, np.roll([3.0, 0.5, 0.5] if seed % 2 else [0.5, 3.0, 3.0], seed // 2), strict=True))
        problem = found(seed, factors)
        for name, true in factors.items():
            factor = problem.calibration[f"{name}_noise_factor"]
            assert factor.estimated
            assert factor.sd < 0.12 * true, "hundreds of readings tell it to some per cent"
            assert problem.rig.sensors[name].noise_factor == factor.value, "filter and smoother go by it"
            z.append((factor.value - true) / factor.sd)
    z = np.array(z)
    assert (np.abs(z) > 2).sum() <= binom.ppf(0.999, len(z), 1 - INSIDE_2SD)
    assert np.sum(z**2) < chi2.ppf(0.999, len(z))


def test_barometer_and_laser_of_a_shaft():
    """A machine that rocks under a plumb line: what hangs and what is pressed, found beside each other."""
    z = []
    for seed, (barometer, laser) in enumerate(((3.0, 0.5), (0.5, 3.0), (3.0, 3.0))):
        true = {"barometer": barometer, "laser": laser}
        noisy = tuple(f"sensors.{name}.noise_factor={factor}" for name, factor in true.items())
        known = ("sensors.imu.noise_factor=1", *noisy)
        simulation = datasets.make("shaft-dynamic", seed=seed, duration=20.0, nominal=1, settings=known)
        rig = override(simulation.rig, [f"sensors.{name}.noise_factor=auto" for name in true])
        problem = prepare(log_of(simulation.log_series), rig)
        for name, factor in true.items():
            one = problem.calibration[f"{name}_noise_factor"]
            assert one.sd < 0.2 * factor
            z.append((one.value - factor) / one.sd)
    assert np.abs(z).max() < 3.3
    assert np.sum(np.square(z)) < chi2.ppf(0.999, len(z))


def test_the_imu_and_a_prism_beside_each_other():
    """Each alone would explain the other's noise in part."""
    problem = found(5, {"imu": 3.0, "prism": 3.0})
    prism, imu = (problem.calibration[f"{name}noise_factor"] for name in ("prism_", ""))
    assert prism.value == pytest.approx(3.0, abs=3 * prism.sd)
    assert imu.value == pytest.approx(3.0, rel=0.25), "as for an IMU alone"


def test_rows_and_samples_have_the_noise_that_was_found():
    plain, scaled = (
        found(
            6, {"prism": 1.0, "odometer": 1.0}, *(f"sensors.{name}.noise_factor={f}" for name in ("prism", "odometer"))
        )
        for f in (1.0, 2.0)
    )
    for name, columns in (("prism", slice(None)), ("odometer", slice(0, 1))):
        one, two = ({rows.sensor: rows for rows in problem.rows}[name] for problem in (plain, scaled))
        np.testing.assert_allclose(two.sigma[:, columns], 2.0 * one.sigma[:, columns])
    np.testing.assert_allclose(scaled.samples["prism"].sigma, 2.0 * plain.samples["prism"].sigma)


def test_outliers_are_no_noise():
    """A tenth of wrong fixes do not pass for three times the noise of the others."""
    simulation = drive(7, 20.0, (), imu_rate_hz=100.0)
    series = {s.topic: s for s in simulation.log_series}
    series["/prism/position"]["point"][::10] += 2.0
    rig = override(simulation.rig, ["sensors.prism.noise_factor=auto"])
    factor = prepare(log_of(list(series.values())), rig).calibration["prism_noise_factor"]
    assert factor.value == pytest.approx(1.0, abs=3 * factor.sd)
