"""Where the machine starts: still stretches, levelling, and heading and clock offset from its motion."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tbmfg.geometry import exp_so3, log_so3, rotation_from_rpy, rotation_z, wrap, yaw_of
from tbmfg.inertial import alignment
from tbmfg.inertial.steps import make_steps
from tbmfg.inertial.strapdown import rotations
from tbmfg.prepare import prepare
from tests.problems import drive, flight, imu_series, log_of

RATE_HZ = 200
G = 9.81
START_RPY = np.radians([4.0, -7.0, 40.0])


def steps_of(gyro, acc):
    return make_steps(imu_series(gyro, acc), np.eye(3), "end")


def standing(seconds, rng, R=None, bias=(2e-3, -1e-3, 3e-3)):
    """Samples of a machine at rest with its pump on: 1 m/s^2 of vibration at 25 and 60 Hz."""
    R = rotation_from_rpy(START_RPY) if R is None else R
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    shake = np.sin(2 * np.pi * 25 * t)[:, None] * [1.0, 0.4, 0.6] + np.sin(2 * np.pi * 60 * t)[:, None] * [
        0.2,
        0.7,
        0.1,
    ]
    acc = R.T @ [0.0, 0.0, G] + shake + 0.02 * rng.standard_normal((len(t), 3))
    return np.array(bias) + 2e-3 * rng.standard_normal((len(t), 3)), acc


def turning(seconds, rng):
    gyro, acc = standing(seconds, rng)
    t = np.arange(len(gyro))[:, None] / RATE_HZ
    return gyro + 0.1 * np.sin(2 * np.pi * 0.2 * t), acc + 0.5 * np.sin(2 * np.pi * 0.15 * t + 1)


# ---- standing ----


def test_still_stretches_are_found_beside_moving_ones():
    rng = np.random.default_rng(0)
    parts = [standing(10, rng), turning(12, rng), standing(8, rng), turning(6, rng)]
    steps = steps_of(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    (start, end), (again, until) = alignment.still_intervals(steps)
    # judged on means over a second
    assert start == pytest.approx(0.0, abs=0.01)
    assert end == pytest.approx(10.0, abs=1.01)
    assert again == pytest.approx(22.0, abs=1.01)
    assert until == pytest.approx(30.0, abs=1.01)


def test_short_stops_and_short_logs_are_not_still():
    rng = np.random.default_rng(1)
    parts = [turning(5, rng), standing(1.5, rng), turning(5, rng)]
    steps = steps_of(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    assert alignment.still_intervals(steps) == []
    assert alignment.still_intervals(steps_of(*standing(2.0, rng))) == []


def test_rows_between_lie_inside():
    steps = steps_of(*standing(2.0, np.random.default_rng(2)))
    for start, end in [(0.1, 0.9), (0.1025, 0.9012), (-5.0, 99.0)]:
        rows = alignment.rows_between(steps, start, end)
        assert steps.edges_s[rows.start] >= start - 1e-9
        assert steps.edges_s[rows.stop] <= end + 1e-9
        assert (
            steps.edges_s[rows.stop] - steps.edges_s[rows.start]
            >= min(end, steps.end_s) - max(start, 0) - 2.01 / RATE_HZ
        )


# ---- levelling ----


def test_levelling_at_rest():
    rng = np.random.default_rng(3)
    steps = steps_of(*standing(12.0, rng, bias=(0.0, 0.0, 0.0)))
    R_0t = rotations(steps.edges_s, steps.gyro, np.zeros(3))
    R = alignment.level_at_start(steps, R_0t, alignment.still_intervals(steps))
    truth = rotation_from_rpy(START_RPY)
    up_error = R.T[:, 2] - truth.T[:, 2]
    # 2400 samples of 0.02, and the attitude walks by 2e-3 sqrt(dt t) while they are averaged
    noise = 0.02 / G / np.sqrt(2400) + 2e-3 * np.sqrt(12.0 / RATE_HZ)
    assert np.linalg.norm(up_error) < 4 * noise
    # zero turn about the vertical: the smallest rotation that levels
    assert log_so3(R)[2] == pytest.approx(0.0, abs=1e-12)


def test_levelling_while_moving_carries_the_force_back_to_the_start():
    """In flight the mean of the force, carried back by the gyro, differs from gravity by the change of velocity."""
    simulation = flight(duration=30.0, stand_s=-5.0)
    steps = make_steps(simulation.clean["imu"], np.eye(3), "end")
    R_0t = rotations(steps.edges_s, steps.gyro, np.zeros(3))
    R = alignment.level_at_start(steps, R_0t, [], window_s=20.0)
    start, end = (simulation.truth(np.array([t])) for t in (0.0, 20.0))
    change = np.linalg.norm(end.velocity - start.velocity)
    earth_turn = 7.3e-5 * 20.0
    assert np.linalg.norm(R.T[:, 2] - start.R[0].T[:, 2]) < change / (G * 20.0) + earth_turn
    assert change / (G * 20.0) < 0.05, "the bound says something"


@pytest.mark.parametrize("rpy_deg", [(0, 0, 0), (180, 0, 0), (90, 0, 0), (0, 89.9, 30), (-120, 40, 170)])
def test_levelling_from_any_attitude(rpy_deg):
    R = rotation_from_rpy(np.radians(rpy_deg))
    steps = steps_of(*standing(5.0, np.random.default_rng(4), R, bias=(0, 0, 0)))
    found = alignment.level_at_start(steps, np.tile(np.eye(3), (len(steps) + 1, 1, 1)), [(0.0, 5.0)])
    assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert found @ R.T[:, 2] @ [0, 0, 1] > np.cos(1e-3)


# ---- heading and clock offset from motion ----


def fitted(settings=(), offsets=None, seed=1, shift_s=0.0, duration=40.0):
    """The fit to a flight, its true heading (turn of the levelled start) and true offset."""
    simulation = flight(seed, duration, settings)
    imu, prism = simulation.log_series[:2]
    steps = make_steps(imu, np.eye(3), "end")
    drawn = simulation.drawn
    bias = drawn["imu"]["bias_gyro"][0]
    R_0t = rotations(steps.edges_s, steps.gyro, bias)
    R_level = alignment.level_at_start(steps, R_0t, alignment.still_intervals(steps))
    t_s = (prism.t_ns - steps.t0_ns) * 1e-9 + shift_s
    offset = drawn["prism"]["clock_offset_s"] + shift_s
    offsets = shift_s + np.arange(-0.1, 0.1001, 0.02) if offsets is None else offsets
    fit = alignment.fit_motion(steps, bias, R_level, t_s, prism["point"], offsets, simulation.rig.origin.gravity)
    R_0 = simulation.truth(np.array([steps.edges_s[0] + (steps.t0_ns - simulation.start_ns) * 1e-9])).R[0]
    return fit, float(yaw_of(R_0 @ R_level.T)), offset


NO_ARM = ("sensors.prism.arm_m=[0, 0, 0]", "sensors.prism.arm_sd_m=0", "sensors.prism.clock_offset_sd_s=0.03")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_heading_and_clock_offset_from_motion(seed):
    fit, heading, offset = fitted(NO_ARM, seed=seed)
    error = float(wrap(fit.heading - heading))
    assert abs(error) < 4 * fit.heading_sd + np.radians(0.5)
    assert fit.heading_sd < np.radians(3.0)
    # 3 mm against speeds of a metre per second, and a parabola through points 20 ms apart
    assert abs(fit.clock_offset_s - offset) < 3e-3


def test_heading_with_a_lever_arm_that_is_not_known():
    """The first value for a filter only: half a metre of arm swings with the attitude."""
    fit, heading, offset = fitted()
    assert abs(wrap(fit.heading - heading)) < np.radians(10.0)
    assert abs(fit.clock_offset_s - offset) < 0.05


def test_a_clock_that_is_far_off_but_known():
    """Stamps late by 7 s, as the rig says: the same fit as without."""
    near, far = fitted(NO_ARM)[0], fitted(NO_ARM, shift_s=7.0)[0]
    assert far is not None, "the windows shrink by the offset's spread, not by its size"
    assert far.heading == pytest.approx(near.heading, abs=np.radians(0.5))
    assert far.clock_offset_s - 7.0 == pytest.approx(near.clock_offset_s, abs=1e-3)


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.0), (0.5, -0.3, 0.0)])
def test_no_heading_from_a_straight_way_at_constant_speed(velocity):
    rng = np.random.default_rng(6)
    steps = steps_of(*standing(30.0, rng))
    t_s = np.arange(0.5, 29.5, 0.1)
    position = t_s[:, None] * velocity + 0.003 * rng.standard_normal((len(t_s), 3))
    assert alignment.fit_motion(steps, np.zeros(3), np.eye(3), t_s, position, np.zeros(1), G) is None


def test_too_few_fixes_give_no_heading():
    simulation = flight(1, 40.0, NO_ARM)
    imu, prism = simulation.log_series[:2]
    steps = make_steps(imu, np.eye(3), "end")
    few = slice(None, None, 10)  # one a second: eight in a window
    t_s = (prism.t_ns[few] - steps.t0_ns) * 1e-9
    assert alignment.fit_motion(steps, np.zeros(3), np.eye(3), t_s, prism["point"][few], np.zeros(1), G) is None


def test_heading_turns_with_the_frame():
    """The same motion seen in a frame turned by 100 degrees."""
    simulation = flight(1, 40.0, NO_ARM)
    imu, prism = simulation.log_series[:2]
    steps = make_steps(imu, np.eye(3), "end")
    t_s = (prism.t_ns - steps.t0_ns) * 1e-9
    tilt = exp_so3(np.array([0.02, -0.03, 0.0]))
    turn = rotation_z(np.radians(100.0))
    one, other = (
        alignment.fit_motion(steps, np.zeros(3), tilt, t_s, positions, np.zeros(1), G)
        for positions in (prism["point"], prism["point"] @ turn.T)
    )
    assert wrap(other.heading - one.heading - np.radians(100.0)) == pytest.approx(0.0, abs=1e-9)
    assert other.heading_sd == pytest.approx(one.heading_sd, rel=1e-6)


def test_heading_from_the_way_of_odometer_and_prism():
    # the rig does not know the heading, the gyro cannot find north, and the drive is too gentle for its accelerations
    settings = ("initial.yaw_sd_deg=180", "sensors.imu.gyro_bias_sd_dps=0.01")
    simulation = drive(seed=2, duration=60.0, settings=settings)
    kept = [s for s in simulation.log_series if s.topic != "/imu/mag"]
    problem = prepare(log_of(kept), simulation.rig)
    R_true = simulation.truth(np.array([(problem.t0_ns - simulation.start_ns) * 1e-9])).R[0]
    turn = problem.prior.x[:9].reshape(3, 3) @ R_true.T
    error = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    assert abs(error) < 3.0 * np.sqrt(problem.prior.filter_cov[2, 2])
    assert abs(error) < np.deg2rad(3.0)


def test_the_mean_rate_of_a_coning_body_is_that_of_its_rotation():
    """About two axes, a quarter apart: the mean of the rates about the third is not that of the body's turning."""
    t, size = np.arange(4750) / 475.0, np.radians(0.5)
    omega = 2 * np.pi * 24.5
    gyro = 1e-5 + size * np.stack([np.cos(omega * t), np.sin(omega * t), np.zeros(len(t))], axis=1)
    steps = make_steps(imu_series(gyro, np.zeros((len(t), 3)), period_ns=round(1e9 / 475)), np.eye(3), "end")
    rows = slice(0, round(240.3 * 475 / 24.5))  # not whole turns
    # the cone's own rate, size^2 / (2 omega), is what a body needs to come back to where it was
    coning = size**2 / (2 * omega)
    assert coning > 2e-7
    assert np.abs(gyro[rows].mean(axis=0) - 1e-5).max() > 20 * coning
    assert_allclose(alignment.mean_rate(steps, rows), [1e-5, 1e-5, 1e-5 + coning], atol=0.02 * coning)
