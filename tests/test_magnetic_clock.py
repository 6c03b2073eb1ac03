"""A magnetometer's clock offset, found from its field and the gyro: simulated delays with other noise and hard iron."""

from dataclasses import replace

import numpy as np
import pytest

from tbmfg.prepare import prepare
from tbmfg.rig import override
from tests.problems import flight, log_of


def found(offset_s, *settings, sd_s=0.02):
    """Prepared problem of a flight whose compass stamps ``offset_s`` late."""
    simulation = flight(
        3, 30.0, ("sensors.magnetometer.sigma_deg=1", f"sensors.magnetometer.clock_offset_s={offset_s}")
    )
    known = ["sensors.magnetometer.clock_offset_s=0", f"sensors.magnetometer.clock_offset_sd_s={sd_s}", *settings]
    return prepare(log_of(simulation.log_series), override(simulation.rig, known))


@pytest.mark.parametrize("offset_s", [-0.03, 0.013])
def test_a_late_compass_is_found_late_and_its_rows_are_placed_so(offset_s):
    late = found(offset_s)
    calibration = late.calibration["magnetometer_clock_offset_s"]
    assert calibration.estimated
    assert abs(calibration.value - offset_s) < 4.0 * calibration.sd
    assert calibration.sd < 0.3 * 0.02  # of the prior
    assert calibration.observed is True
    rows = next(rows for rows in late.rows if rows.sensor == "magnetometer")
    # 20 Hz of samples against a keyframe at every fix: those that belong together are the same with the clock known
    known = found(offset_s, f"sensors.magnetometer.clock_offset_s={calibration.value}", sd_s=0)
    told = next(rows for rows in known.rows if rows.sensor == "magnetometer")
    # an open offset leaves its spread free at the log's ends
    inner, same = slice(2, -2), np.isin(told.i, rows.i[2:-2])
    np.testing.assert_array_equal(rows.i[inner], told.i[same])
    np.testing.assert_allclose(rows.z[inner], told.z[same], rtol=1e-9)


def test_hard_iron_is_not_taken_for_a_delay():
    simulation = flight(3, 30.0, ("sensors.magnetometer.sigma_deg=1",))
    series = list(simulation.log_series)
    at = next(k for k, s in enumerate(series) if s.topic == "/mag")
    iron = {"field": series[at]["field"] + np.array([8e-6, -5e-6, 3e-6])}
    series[at] = replace(series[at], columns=iron)
    rig = override(simulation.rig, ["sensors.magnetometer.clock_offset_sd_s=0.02"])
    calibration = prepare(log_of(series), rig).calibration["magnetometer_clock_offset_s"]
    assert abs(calibration.value) < 4.0 * calibration.sd < 4.0 * 0.3 * 0.02


def test_an_offset_beyond_the_prior_is_held_and_said():
    problem = found(0.1, sd_s=0.01)
    assert problem.calibration["magnetometer_clock_offset_s"].value == pytest.approx(0.03, abs=1e-3)
    assert any("magnetometer: the clock offset ran to 3 sd" in line for line in problem.warnings)
