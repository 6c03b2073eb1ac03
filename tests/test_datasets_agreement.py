"""Two independent descriptions of the same sensors agree on truth: the simulator's, and the estimators' models."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import datasets
from tbmfg import earth, sensors


@pytest.fixture(scope="module")
def drive():
    """A minute with every calibration off its nominal value; the body does not shake on its tracks."""
    settings = (
        "origin.x_axis_azimuth_deg=25",
        "sensors.magnetometer.declination_deg=4",
        "sensors.prism.arm_sd_m=0.3",
        "sensors.odometer.scale_sd=0.05",
        "sensors.odometer.arm_m=[-0.4, 0.2, -1.1]",
    )
    return datasets.make("tbm-drive", seed=2, duration=60.0, vibration=0.0, settings=settings)


def packed(drive, t_s):
    """States at ``t_s`` (n,) as the models take them: R, position, velocity, biases; (n, 21)."""
    truth = drive.truth(t_s)
    zero = np.zeros((len(t_s), 6))
    return np.hstack([truth.R.reshape(-1, 9), truth.position, truth.velocity, zero])


def seconds_of(drive, series):
    return (series.t_ns - drive.start_ns) * 1e-9


def test_prism(drive):
    clean = drive.clean["prism"]
    t_s, lag_s = seconds_of(drive, clean), 0.01
    x = packed(drive, t_s - lag_s)
    data = np.column_stack([np.full(len(t_s), lag_s), drive.truth(t_s - lag_s).omega, t_s])
    residual, *_ = sensors.prism(clean["point"], data, x, x, np.append(drive.drawn["prism"]["arm_m"], [0.0, 0.0]))
    # first order in the lag: half an acceleration of at most 0.2 m/s^2, with the arm's turning in and out
    assert_allclose(residual, 0.0, atol=0.5 * 0.2 * lag_s**2)


def test_odometer(drive):
    log, clean = drive.log_series[2], drive.clean["odometer"]
    assert log.topic == "/odometer"
    scale, dt = drive.drawn["odometer"]["scale"], 0.05
    arm = np.array(drive.rig.sensors["odometer"].arm_m)
    speed = (1 + scale) * clean["linear"][:, 0]  # what the odometer indicates, without noise
    starts_s = np.arange(0.0, 60.0)
    x, y = packed(drive, starts_s), packed(drive, starts_s + 1)
    R_start = drive.truth(starts_s).R
    R_middle = drive.truth((np.arange(1200) + 0.5) * dt).R.reshape(60, 20, 3, 3)
    way = np.einsum("nji,nmj,nm->nmi", R_start, R_middle[:, :, :, 0], speed.reshape(60, 20) * dt)
    D = way.sum(axis=1)
    B = np.einsum("nmi,m->ni", way, (np.arange(20) + 0.5) * dt)
    data = np.hstack([np.tile(arm, (60, 1)), B, np.zeros((60, 3)), D])
    residual, *_ = sensors.odometer(D, data, x, y, np.array([scale, 0.0, 0.0]))
    # turning (0.06 rad/s) and speeding up (0.12 m/s^2) together within a sample: dt^3 / 12 of their product, 20 samples
    assert_allclose(residual, 0.0, atol=20 * 0.06 * 0.12 * dt**3 / 12)
    travelled = np.linalg.norm(y[:, 9:12] - x[:, 9:12], axis=1)
    assert travelled.max() > 0.09


def test_magnetometer(drive):
    clean = drive.clean["magnetometer"]
    x = packed(drive, seconds_of(drive, clean))
    north = np.full((len(x), 1), earth.north_direction(np.radians(25.0)))
    residual, *_ = sensors.magnetometer(clean["field"], north, x, x, np.array([np.radians(4.0)]))
    assert_allclose(residual, 0.0, atol=1e-12)
