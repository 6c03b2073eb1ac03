"""Truth: its derivatives are those of its values, and motions compose as transforms do."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from datasets import tbm
from datasets.motion import Lines, Motion, Spline, compose, lines, rigid

H = 1e-5  # s, step of central differences


def everything_moves() -> Motion:
    """A motion with nothing zero, aligned or small: wide turns, large shaking."""
    rng = np.random.default_rng(5)
    knots = np.linspace(-1.0, 5.0, 61)
    waves = rng.normal(size=(6, 6)) @ np.cos(np.outer(rng.uniform(0.5, 3.0, 6), knots) + rng.uniform(0, 6, (6, 1)))
    envelope = Spline(knots, 1 + 0.5 * np.sin(knots)[:, None])
    size = rng.uniform(0.2, 0.5, (4, 6))
    shaking = lines([3.0, 7.0, 11.0, 19.0], 50 * size[:, :3], 5 * size[:, 3:], envelope, rng)
    return Motion(Spline(knots, 0.4 * waves.T), (shaking, shaking))


def drive() -> Motion:
    plan = tbm.Plan.over(40.0)
    rng = np.random.default_rng(1)
    return Motion(tbm.path(plan, np.array([-0.4, 0.1, -1.1]), 0.004, rng), tbm.shaking(plan, 1.0, rng))


@pytest.mark.parametrize(("motion", "span_s", "third"), [(everything_moves(), 4.0, 2e7), (drive(), 39.0, 1e7)])
def test_derivatives_are_those_of_the_values(motion, span_s, third):
    t = np.random.default_rng(0).uniform(0.1, span_s, 300)
    before, here, after = (motion(t + shift) for shift in (-H, 0.0, H))
    # central differences leave h^2 / 6 times the third derivative, and rounding; `third` is the largest, that of
    # omega: the drive's pump has 0.5 deg/s / k at 24.5 k Hz, k = 1..9, in all 9e6 rad/s^4
    tolerance = H**2 / 6 * third + 1e-14 / H
    assert_allclose((after.position - before.position) / (2 * H), here.velocity, atol=tolerance)
    assert_allclose((after.velocity - before.velocity) / (2 * H), here.acceleration, atol=tolerance)
    assert_allclose((after.omega - before.omega) / (2 * H), here.alpha, atol=tolerance)
    turn = Rotation.from_matrix(np.swapaxes(before.R, 1, 2) @ after.R).as_rotvec()
    assert_allclose(turn / (2 * H), here.omega, atol=tolerance)


def test_rigid_is_yaw_pitch_roll():
    rpy = np.random.default_rng(2).uniform(-1, 1, (20, 3))
    values = np.hstack([np.zeros((20, 3)), rpy])
    expected = Rotation.from_euler("ZYX", rpy[:, ::-1]).as_matrix()
    assert_allclose(rigid(values, values, values).R, expected, atol=1e-15)


def test_compose_is_the_product_of_transforms():
    motion = everything_moves()
    t = np.linspace(0, 4, 9)
    outer, inner = motion(t), motion(t[::-1])
    both = compose(outer, inner)
    for k in range(len(t)):
        assert_allclose(both.R[k], outer.R[k] @ inner.R[k], atol=1e-15)
        assert_allclose(both.position[k], outer.position[k] + outer.R[k] @ inner.position[k], atol=1e-15)


def test_a_point_on_the_body_moves_as_its_position_says():
    motion, arm = everything_moves(), np.array([0.3, -1.1, 0.7])
    t = np.linspace(0.2, 3.8, 40)
    (low, _), (_, velocity), (high, _) = (motion(t + shift).at_point(arm) for shift in (-H, 0.0, H))
    assert_allclose((high - low) / (2 * H), velocity, atol=H**2 / 6 * 5e6 + 1e-14 / H)


def test_lines_have_the_amplitudes_that_were_asked_for():
    steady = Spline(np.linspace(-1, 11, 13), np.ones((13, 1)))
    shaking = lines([5.0, 24.0], [[1.0, 0.5, 0.2]] * 2, [[0.1, 0.2, 0.3]] * 2, steady, np.random.default_rng(0))
    assert isinstance(shaking, Lines)
    _, rate, acceleration = shaking(np.arange(0, 10, 1e-3))  # whole periods of both lines
    # the mean square of a line is half its squared amplitude
    assert_allclose(acceleration[:, :3].std(axis=0), [1.0, 0.5, 0.2], rtol=1e-6)
    assert_allclose(rate[:, 3:].std(axis=0), [0.1, 0.2, 0.3], rtol=1e-6)


def test_the_machine_drives_as_its_tracks_allow():
    """The contact point moves along the body's x axis: the path's spline leaves microns per second beside it."""
    contact = np.array([-0.4, 0.1, -1.1])
    plan = tbm.Plan.over(240.0)
    motion = Motion(tbm.path(plan, contact, 0.0, np.random.default_rng(0)))
    t = np.linspace(0, 240, 10_001)
    travel = motion(t)
    _, velocity_n = travel.at_point(contact)
    velocity_b = np.einsum("nji,nj->ni", travel.R, velocity_n)
    assert np.abs(velocity_b[:, 1:]).max() < 5e-6
    assert_allclose(velocity_b[:, 0], np.interp(t, plan.t_s, plan.speed), atol=2e-4)  # slope and interpolation
    standing = t < 14
    assert np.abs(velocity_n[standing]).max() < 1e-9
    yaw = np.degrees(np.unwrap(np.arctan2(travel.R[:, 1, 0], travel.R[:, 0, 0])))
    assert np.ptp(yaw) > 30
    slope = np.degrees(np.arccos(travel.R[:, 2, 2]))
    assert 1.0 < slope.max() < 2.5


def test_two_rounds_bring_the_machine_back():
    motion = Motion(tbm.path(tbm.Plan.over(300.0), np.zeros(3), 0.0, np.random.default_rng(0)))
    there, back = (motion(np.array([t])) for t in (5.0, 15.0 + 2 * 105.0 + 0.1))
    # the moves begin between two samples of the path only if their times are no multiples of its step
    assert_allclose(back.position, there.position, atol=1e-5)
    assert_allclose(back.R, there.R, atol=1e-5)
