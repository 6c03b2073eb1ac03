"""The clocks of a drive by what inertial unit and receiver see of the motion."""

import numpy as np
import pytest

from benchmarks import clock
from benchmarks.__main__ import main


def speed(t_s):
    """m/s, with starts and stops."""
    return 8.0 + 5.0 * np.sin(0.5 * t_s) + 2.0 * np.sin(1.3 * t_s + 1.0)


def way(t_s):
    """Its integral."""
    return 8.0 * t_s - 10.0 * np.cos(0.5 * t_s) - 2.0 / 1.3 * np.cos(1.3 * t_s + 1.0)


@pytest.fixture
def drive():
    """A straight drive eastwards: stamps of the unit are 0.14 s late, velocities are means since the fix before."""
    rng = np.random.default_rng(1)
    imu_s, t = np.arange(0.0, 120.0, 0.01), np.arange(1.0, 119.0, 0.25)
    ahead = np.gradient(speed(imu_s), imu_s) + 0.3 + 0.2 * rng.standard_normal(len(imu_s))
    x = way(t) + 0.01 * rng.standard_normal(len(t))
    mean = (x - np.concatenate([[x[0] - 0.25 * speed(t[0])], x[:-1]])) / 0.25
    return imu_s + 0.14, ahead, t, x, mean


def test_offsets_and_a_late_velocity_are_found(drive):
    imu_s, ahead, t, x, mean = drive
    between = 0.5 * (t[1:] + t[:-1])
    assert clock.offset(between, np.diff(x) / np.diff(t), imu_s, ahead) == pytest.approx(0.14, abs=0.01)
    assert clock.offset(t, mean, imu_s, ahead) == pytest.approx(0.14 - 0.125, abs=0.01)
    plane = np.column_stack([np.zeros(len(t)), x, np.zeros(len(t))])
    velocity = np.column_stack([np.zeros(len(t)), mean, np.zeros(len(t))])
    assert clock.velocity_late(t, plane, velocity) == pytest.approx(0.125, abs=0.01)


def test_a_recording_that_is_not_there_is_told_in_one_line(capsys, tmp_path):
    assert main(["clock", str(tmp_path / "none.npz")]) == 1
    assert capsys.readouterr().err.startswith("error: ")
