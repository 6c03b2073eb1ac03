"""Attitude algebra of the shaft machine's filters: every equation against an independent computation."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from tbmfg.filters import frd
from tests.problems import EPS

ANGLES = np.random.default_rng(0).uniform([-3.0, -1.4, -3.0], [3.0, 1.4, 3.0], (20, 3))
OMEGA = np.array([0.4, -0.7, 0.3])


def C_ar(angles):
    """scipy's rotation about moving axes, yaw first: the machine's attitude, a to r."""
    return Rotation.from_euler("ZYX", angles[::-1]).as_matrix()


def scipy_of(q):
    return Rotation.from_quat(np.roll(q, -1))


@pytest.mark.parametrize("angles", ANGLES)
def test_matrix_angles_and_quaternion_agree(angles):
    """(1), (4), (5), (8), (10)."""
    assert_allclose(frd.rotation_ra(angles), C_ar(angles).T, atol=8 * EPS)
    assert_allclose(frd.angles_of(C_ar(angles)), angles, atol=1e-14)
    assert_allclose(frd.rotation_ar(frd.quaternion(angles)), C_ar(angles), atol=8 * EPS)


@pytest.mark.parametrize("angles", ANGLES[:6])
def test_euler_rates_are_those_of_the_turning_machine(angles):
    """(6) against central differences: truncation h^2 / 6 times a third derivative below 1e3 at 80 degrees of pitch."""
    h = 1e-5
    ends = [frd.angles_of(C_ar(angles) @ Rotation.from_rotvec(s * h * OMEGA).as_matrix()) for s in (1, -1)]
    assert_allclose(frd.euler_rates(*angles[:2]) @ OMEGA, (ends[0] - ends[1]) / (2 * h), atol=1e-7)


def test_product_and_rate_are_hamiltons():
    """(11): scipy composes rotations by the same product."""
    p, q = (Rotation.random(random_state=seed) for seed in (1, 2))
    ours = frd.product(np.roll(p.as_quat(), 1), np.roll(q.as_quat(), 1))
    assert abs(ours @ np.roll((p * q).as_quat(), 1)) == pytest.approx(1.0, abs=8 * EPS)
    assert_allclose(scipy_of(ours).as_matrix(), (p * q).as_matrix(), atol=8 * EPS)
    q0, h = frd.quaternion(ANGLES[0]), 1e-6
    moved = frd.quaternion(frd.angles_of(C_ar(ANGLES[0]) @ Rotation.from_rotvec(h * OMEGA).as_matrix()))
    moved *= np.sign(moved @ q0)
    assert_allclose((moved - q0) / h, frd.quaternion_rate(q0, OMEGA), atol=1e-6)


@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_advance_is_exact_for_a_constant_rate(size):
    q = frd.quaternion(ANGLES[1])
    expected = C_ar(ANGLES[1]) @ Rotation.from_rotvec(0.7 * size * OMEGA).as_matrix()
    assert_allclose(frd.rotation_ar(frd.advance(q, size * OMEGA, 0.7)), expected, atol=8 * EPS)


def test_runge_kutta_is_of_fourth_order():
    """(12) over one second of a coning motion, h halved four times."""

    def omega(t):
        return np.array([np.cos(3 * t), np.sin(3 * t), 0.5 * t])

    exact = solve_ivp(lambda t, q: frd.quaternion_rate(q, omega(t)), (0, 1), [1.0, 0, 0, 0], rtol=1e-13, atol=1e-14)
    errors = []
    for steps in (8, 16, 32, 64):
        q, T = np.array([1.0, 0, 0, 0]), 0.5 / steps
        for k in range(steps):
            q = frd.advance_rk4(q, *(omega((2 * k + j) * T) for j in range(3)), T)
        errors.append(np.linalg.norm(q - exact.y[:, -1]))
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert_allclose(slopes, 4.0, atol=0.2)


@pytest.mark.parametrize("angles", ANGLES)
def test_predicted_gravity_and_field(angles):
    """(16), (17)."""
    q = frd.quaternion(angles)
    assert_allclose(frd.gravity_in_a(q), C_ar(angles).T @ [0, 0, 1], atol=8 * EPS)
    assert_allclose(frd.field_in_a(q, 0.53, 0.85), C_ar(angles).T @ [0.53, 0, 0.85], atol=8 * EPS)


def test_measured_angles_are_the_true_ones():
    """(15) with its corrections, from exact gravity and field at any attitude; no field, no yaw."""
    a_s = np.array([C_ar(angles).T @ [0, 0, 9.8] for angles in ANGLES])
    m_s = np.array([C_ar(angles).T @ [26e-6, 0, 42e-6] for angles in ANGLES])
    # pitch within +-90 degrees is all that (15) can tell
    assert_allclose(frd.measured_angles(a_s, m_s), ANGLES, atol=1e-13)
    m_s[3] = np.nan
    found = frd.measured_angles(a_s, m_s)
    assert np.isnan(found[3]).tolist() == [False, False, True]
