"""Odometers and magnetometers that fail: found, said, left out and counted, and nothing found where nothing is."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import datasets
from tbmfg.estimators import estimate, unmet
from tbmfg.prepare import health, prepare
from tbmfg.rig import override
from tests.problems import drive, log_of


def times(count, rate_hz=10.0):
    return (1 + np.arange(count)) / rate_hz


# ---- odometer ----


@pytest.mark.parametrize("rate_hz", [1.0, 10.0, 100.0])
def test_a_roll_over_is_left_out(rate_hz):
    """A 16 bit counter of millimetres loses 65.5 m within one period."""
    t = times(200, rate_hz)
    true = np.where(t * rate_hz > 100, -0.7, 1.1)  # it reverses at once, which the check must bear
    speed = true + 0.02 * np.random.default_rng(1).standard_normal(200)
    speed[[3, 50, 120]] += -65.536 * rate_hz * np.array([1, 1, -1])
    if rate_hz == 1.0:
        speed[[3, 50, 120]] *= 3  # 65 m/s from one second to the next are 6.7 g: within what is let pass
    sound, [line] = health.odometer(t, speed, 0.02)
    assert np.flatnonzero(~sound).tolist() == [3, 50, 120]
    assert line.startswith("3 of 200 speeds jump as no machine can, at ")


@given(st.integers(0, 40), st.integers(0, 2**32 - 1))
def test_no_speeds_of_a_machine_are_left_out(count, seed):
    """However it starts, stops and turns round with up to a g, and whatever its noise."""
    rng = np.random.default_rng(seed)
    speed = np.cumsum(rng.uniform(-9.8, 9.8, count) * 0.1) + rng.normal(0, 0.5, count)
    sound, said = health.odometer(times(count), speed, 0.5)
    assert sound.all()
    assert not said


def test_speeds_in_another_unit_are_not_taken_for_jumps():
    """Noise of a hundred metres per second is no roll-over: nothing is left of such a log, and that is not said so."""
    speed = 1e4 * np.random.default_rng(2).standard_normal(100)
    sound, said = health.odometer(times(100), speed, 0.02)
    assert sound.all()
    assert not said


# ---- magnetometer ----


def field(count=300, noise=3e-7, quantum=0.0, seed=3):
    """A horizontal field of 20 uT that turns once, T."""
    angle = np.linspace(0, 2 * np.pi, count)
    clean = 2e-5 * np.column_stack([np.cos(angle), -np.sin(angle), np.full(count, -2.1)])
    values = clean + noise * np.random.default_rng(seed).standard_normal((count, 3))
    return np.round(values / quantum) * quantum if quantum else values


@pytest.mark.parametrize("quantum", [0.0, 1e-7, 1e-6])
@pytest.mark.parametrize("turning", [True, False])
def test_a_sound_magnetometer(quantum, turning):
    values = field(quantum=quantum) if turning else field()[:1] + field(quantum=quantum) - field(noise=0.0)
    sound, said = health.magnetometer(times(300), np.round(values / quantum) * quantum if quantum else values)
    assert sound.all()
    assert not said


def test_a_magnetometer_that_hangs():
    values = field()
    values[100:140] = values[100]
    values[200:205] = values[200]  # five the same are chance
    sound, [line] = health.magnetometer(times(300), values)
    assert np.flatnonzero(~sound).tolist() == list(range(101, 140))
    assert line == (
        "hangs on one reading: 39 of 300 samples repeat the one before, the longest time from 10.1 to 14.0 s; left out"
    )


@pytest.mark.parametrize("quantum", [0.0, 1e-7])
def test_a_saturated_magnetometer(quantum):
    values = field(quantum=quantum)
    true = values[:, 0].copy()
    values[:, 0] = np.minimum(values[:, 0], 1.2e-5)
    sound, [line] = health.magnetometer(times(300), values)
    assert not sound[true > 1.2e-5].any()
    assert sound[true < 1.19e-5].all()
    assert line.startswith("its x axis is at the end of its scale, 12 uT, in ")


def test_a_dead_axis_is_said_and_kept():
    values = field()
    values[:, 1] = 8e-4
    sound, [line] = health.magnetometer(times(300), values)
    assert sound.all()
    assert line.startswith("its y axis reads 800 uT in all 300 samples: dead")


# ---- in a log ----


def spoilt(topic, column, change):
    """The log of a drive with one column of one topic changed in place by ``change``."""
    simulation = drive(0, 30.0, imu_rate_hz=100.0)
    series = []
    for s in simulation.log_series:
        if s.topic == topic:
            values = s[column].copy()
            change(values)
            s = replace(s, columns={**s.columns, column: values})
        series.append(s)
    return prepare(log_of(series), simulation.rig, without=("prism",))


def test_a_roll_over_in_a_log_is_counted_and_does_no_harm():
    def roll_over(linear):
        linear[[200, 400], 0] -= 655.36

    clean, rolled = spoilt("/odometer", "linear", lambda linear: None), spoilt("/odometer", "linear", roll_over)
    assert any("odometer: 2 of 600 speeds jump" in line for line in rolled.warnings)
    for name in ("shearer-ckf", "ins"):
        result, plain = estimate(name, rolled), estimate(name, clean)
        counts = result.counts["odometer"]
        assert counts.parts() == counts.received == 600
        assert counts.unused >= 2
        # two samples of 0.02 m/s are missing, which was worth 1 mm each
        shift = result.trajectory.position_n[-1] - plain.trajectory.position_n[-1]
        assert np.linalg.norm(shift) < 0.02


def test_a_constant_magnetometer_is_not_used():
    def hang(values):
        values[:] = values[0]

    problem = spoilt("/imu/mag", "field", hang)
    [line] = [line for line in problem.warnings if "magnetometer" in line]
    assert line.startswith("magnetometer: hangs on one reading: 599 of 600 samples")
    assert unmet("shearer-ckf", problem) == "needs magnetometer"
    counts = estimate("shearer-sins-od", problem).counts["magnetometer"]
    assert counts.unused == counts.received == 601


@pytest.mark.parametrize("declination_deg", [6.0, -6.0])
def test_a_declination_of_the_wrong_sign_is_said(declination_deg):
    """The site has -6 degrees. The two headings are then 12 degrees apart."""
    simulation = datasets.make("shearer-cut", seed=0, duration=15.0)
    rig = override(simulation.rig, [f"sensors.magnetometer.declination_deg={declination_deg}"])
    lines = [line for line in prepare(log_of(simulation.log_series), rig).warnings if "magnetometer" in line]
    if declination_deg < 0:
        assert not lines
    else:
        [line] = lines
        assert "deg from initial.yaw_deg" in line
        assert "with declination_deg=-6 it would be" in line


def test_a_magnetometer_beside_steel_is_said():
    simulation = datasets.make("shearer-cut", seed=0, duration=15.0)
    rig = override(simulation.rig, ["sensors.magnetometer.rpy_deg=[0, 0, 20]"])
    [line] = [line for line in prepare(log_of(simulation.log_series), rig).warnings if "magnetometer" in line]
    assert line.endswith("check declination, mounting and hard iron, and what steel is near")
