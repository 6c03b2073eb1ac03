"""Strapdown and its error propagation against differences, an independent integration, GTSAM, and closed forms."""

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from tbmfg import earth
from tbmfg.geometry import exp_so3, log_so3, skew
from tbmfg.inertial.steps import compensate, make_steps
from tbmfg.inertial.strapdown import (
    correct_path,
    correct_state,
    correct_states,
    difference,
    exp_rotation,
    log_rotation,
    mechanise,
    propagate,
    rotations,
)
from tests.problems import EPS, ERRORS, imu_series, state_errors, worst

G = 9.81
GRAVITY = np.array([0.0, 0.0, -G])
EARTH = earth.rate_n(np.radians(47.0), np.radians(30.0))
DT, COUNT = 0.002, 150
SPAN = DT * COUNT
PSD = (3e-8, 2e-6, 5e-9, 4e-7)  # gyro, accelerometer, gyro bias, accelerometer bias
X0 = np.concatenate(
    [exp_so3(np.array([0.3, -0.2, 1.1])).ravel(), [4, -7, 1.2], [1.7, -0.6, 0.4], [0.11, -0.07, 0.05],
     [0.013, -0.021, 0.034]]
)  # fmt: skip


def motion(count=COUNT):
    """Edges, rates and forces that change in every axis: 1 rad/s and 12 m/s^2 in size."""
    t = (np.arange(count) + 0.5) * DT
    gyro = np.column_stack([0.6 + 0.2 * np.sin(9 * t), -0.5 + 0.3 * np.cos(7 * t), 0.7 + 0.1 * np.sin(5 * t + 1)])
    acc = np.column_stack([1.5 + np.sin(11 * t), -2.0 + np.cos(6 * t), 10.0 + np.sin(8 * t + 2)])
    return np.arange(count + 1) * DT, gyro, acc


EDGES, GYRO, ACC = motion()
RATE = np.linalg.norm(GYRO - X0[18:21], axis=1).max()
FORCE = np.linalg.norm(ACC - X0[15:18], axis=1).max()


def predict(x0, first=0, last=COUNT):
    white = [np.full(COUNT, psd) for psd in PSD[:2]]
    return propagate(x0, first, last, EDGES, GYRO, ACC, *white, *PSD[2:], EARTH, GRAVITY)


# ---- rotations and corrections ----


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 0.99e-4, 1.01e-4, 1e-2, 1.0, 3.0, np.pi, 5.0])
def test_exponential(angle):
    w = angle * np.array([0.36, -0.48, 0.8])
    R = exp_rotation(w)
    assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=8 * EPS)
    assert_allclose(R @ R.T, np.eye(3), atol=8 * EPS)


def test_corrections_turn_in_the_body_and_add_elsewhere():
    x, d = np.append(X0, [0.3, -0.4]), np.linspace(-0.8, 0.9, 17)
    moved = correct_state(x, d)
    assert_allclose(moved[:9].reshape(3, 3), x[:9].reshape(3, 3) @ exp_so3(d[:3]), atol=4 * EPS)
    assert_array_equal(moved[9:], x[9:] + d[3:])
    assert_allclose(state_errors(moved[None, :21], x[None, :21])[0], d[:15], atol=40 * EPS)
    pair = correct_states(np.stack([x, moved]), np.stack([d, -d]))
    assert_array_equal(pair, [moved, correct_state(moved, -d)])
    assert_allclose(pair[1], x, atol=16 * EPS)


def test_rotations_by_gyro_alone():
    bias = X0[18:21]
    expected = Rotation.identity()
    for rate in GYRO:
        expected = expected * Rotation.from_rotvec((rate - bias) * DT)
    R = rotations(EDGES, GYRO, bias)
    assert_array_equal(R[0], np.eye(3))
    assert_allclose(R[-1], expected.as_matrix(), atol=4 * EPS * COUNT)


# ---- prediction ----


def test_propagation_takes_the_way_of_the_mechanisation():
    x = mechanise(X0, EDGES, GYRO, ACC, EARTH, GRAVITY)
    half, *_ = predict(X0, 0, 60)
    end, *_ = predict(half, 60, COUNT)
    assert_allclose(half, x[60], atol=1e-13)
    assert_allclose(end, x[-1], atol=1e-13)
    assert_array_equal(x[:, 15:], np.tile(X0[15:], (COUNT + 1, 1)))


def test_steady_turn_on_a_turning_earth():
    """Closed form: a body that stands in n for an hour feels the Earth turn, and stays."""
    R = X0[:9].reshape(3, 3)
    x0 = np.concatenate([R.ravel(), np.zeros(12)])
    n = 36_000
    gyro, acc = np.tile(R.T @ EARTH, (n, 1)), np.tile(-R.T @ GRAVITY, (n, 1))
    # force is resolved at the step's start: the mean over a step, as the IMU gives it, turned back by half a step
    dt = 0.1
    acc += np.cross(gyro, acc) * dt / 2
    x = mechanise(x0, dt * np.arange(n + 1), gyro, acc, EARTH, GRAVITY)[-1]
    T, w = dt * n, earth.RATE
    turn = np.linalg.norm(log_so3(R.T @ x[:9].reshape(3, 3)))
    assert turn < 40 * EPS * n
    # second order in the turn of a step, as a tilt of g; and rounding of the attitude
    speed = G * ((w * dt) ** 2 / 6 + 40 * EPS * n) * T
    assert np.linalg.norm(x[12:15]) < speed
    assert np.linalg.norm(x[9:12]) < speed * T / 2


def test_circle_closes():
    """One turn in 20 s at 2 m/s about a vertical axis on an Earth that stands: rate and force are constant in b."""
    T, v = 20.0, 2.0
    w = 2 * np.pi / T
    n = 2000
    dt = T / n
    gyro = np.tile([0.0, 0.0, w], (n, 1))
    mean = np.tile([0.0, w * v, G], (n, 1))
    steps = make_steps(imu_series(gyro, mean, round(dt * 1e9)), np.eye(3), "end")
    rate, force = compensate(steps, np.zeros(3), np.zeros(3))
    x0 = np.concatenate([np.eye(3).ravel(), np.zeros(3), [v, 0.0, 0.0], np.zeros(6)])
    x = mechanise(x0, steps.edges_s, rate, force, np.zeros(3), GRAVITY)[-1]
    assert_allclose(x[:9], x0[:9], atol=4 * EPS * n)
    # cross of rate and force over half a step is the rotation to second order: the rest is (w dt)^2 / 6 of w v
    speed = w * v * (w * dt) ** 2 / 6 * T
    assert np.linalg.norm(x[12:15] - x0[12:15]) < speed
    # positions are added up by trapezoids: v'' dt^2 / 12, and the speed's error
    assert np.linalg.norm(x[9:12]) < w**2 * v * dt**2 / 12 * T + speed * T


# ---- error propagation ----


def test_transition_against_differences():
    """Phi is of first order in a step: the bound on each block says what it leaves out."""
    _, Phi, _ = predict(X0)
    h = 1e-5
    d = h * np.eye(15)
    ends = [[predict(correct_state(X0, s * row))[0] for row in d] for s in (1, -1)]
    numeric = (state_errors(*map(np.array, ends)) / (2 * h)).T

    T = SPAN
    rounding = 2 * (EPS * 10 / h + h**2 / 6 * (1 + FORCE * T))  # of the differences, every entry
    late = RATE * DT / 2  # a bias turns with the body inside a step: relative
    coriolis = 2 * earth.RATE * T  # -2 w x d_v and the turn of n are left out: relative
    bound = np.full((5, 5), rounding)
    bound[:3, 4] += late * np.array([T, FORCE * T**3 / 6, FORCE * T**2 / 2])
    bound[1:3, 0] += coriolis * FORCE * np.array([T**2 / 2, T])
    bound[1:3, 2] += coriolis * np.array([T, 1.0])
    bound[1:3, 3] += coriolis * np.array([T**2 / 2, T])
    bound[1:3, 4] += coriolis * FORCE * np.array([T**3 / 6, T**2 / 2])
    # the attitude of a step's start is held through the step
    bound[1:3, 4] += FORCE * DT * np.array([T**2 / 2, T])
    fault = worst(Phi, numeric, np.kron(bound, np.ones((3, 3))), ERRORS, ERRORS)
    assert not fault, fault


def test_process_noise_against_an_independent_integration():
    """dQ/dt = F Q + Q F^T + G G^T with rate and force interpolated in time: nothing of the code under test."""
    bg, ba = X0[18:21], X0[15:18]
    middle = (EDGES[:-1] + EDGES[1:]) / 2

    def at(t, values):
        return np.array([np.interp(t, middle, values[:, a]) for a in range(3)])

    def derivative(t, y):
        R, Q = y[:9].reshape(3, 3), y[9:].reshape(15, 15)
        w, f = at(t, GYRO) - bg, at(t, ACC) - ba
        F = np.zeros((15, 15))
        F[0:3, 0:3], F[0:3, 12:15] = -skew(w), -np.eye(3)
        F[3:6, 6:9] = np.eye(3)
        F[6:9, 0:3], F[6:9, 9:12] = -R @ skew(f), -R
        white = np.diag(np.repeat([PSD[0], 0.0, PSD[1], PSD[3], PSD[2]], 3))
        return np.concatenate([(R @ skew(w)).ravel(), (F @ Q + Q @ F.T + white).ravel()])

    y0 = np.concatenate([X0[:9], np.zeros(225)])
    expected = solve_ivp(derivative, (0, SPAN), y0, rtol=1e-9, atol=1e-18, max_step=DT).y[9:, -1].reshape(15, 15)
    _, _, Q = predict(X0)
    sd = np.sqrt(np.diag(expected))
    # noise comes in once per step: half a step late for what it drives, a step and a half for what that drives
    late = 1.5 * DT / SPAN * 3 + RATE * DT
    fault = worst(Q / np.outer(sd, sd), expected / np.outer(sd, sd), late, ERRORS, ERRORS)
    assert not fault, fault
    assert_allclose(Q / np.outer(sd, sd), Q.T / np.outer(sd, sd), atol=EPS * COUNT)
    assert np.linalg.eigvalsh(Q / np.outer(sd, sd)).min() > 0


def test_noise_of_single_steps_enters_where_it_arises():
    """Noise in one step alone reaches the end through the transition of the steps after it."""
    only = 40
    white = np.zeros((2, COUNT))
    white[:, only] = PSD[:2]
    _, _, Q = propagate(X0, 0, COUNT, EDGES, GYRO, ACC, *white, 0.0, 0.0, EARTH, GRAVITY)
    at, *_ = predict(X0, 0, only + 1)
    _, Phi, _ = predict(at, only + 1, COUNT)
    first = np.zeros((15, 15))
    first[:3, :3], first[6:9, 6:9] = PSD[0] * DT * np.eye(3), PSD[1] * DT * np.eye(3)
    first[3:6, 3:6] = PSD[1] * DT**3 / 3 * np.eye(3)
    first[3:6, 6:9] = first[6:9, 3:6] = PSD[1] * DT**2 / 2 * np.eye(3)
    sd = np.sqrt(np.maximum(np.diag(Q), 1e-30))
    assert_allclose(Q / np.outer(sd, sd), Phi @ first @ Phi.T / np.outer(sd, sd), atol=1e-12)


# ---- GTSAM ----


@pytest.mark.parametrize("coriolis", [False, True])
def test_prediction_and_noise_agree_with_gtsam(coriolis):
    parameters = gtsam.PreintegrationCombinedParams(GRAVITY)
    parameters.setGyroscopeCovariance(PSD[0] * np.eye(3))
    parameters.setAccelerometerCovariance(PSD[1] * np.eye(3))
    parameters.setBiasOmegaCovariance(PSD[2] * np.eye(3))
    parameters.setBiasAccCovariance(PSD[3] * np.eye(3))
    parameters.setIntegrationCovariance(1e-16 * np.eye(3))
    rate_n = EARTH if coriolis else np.zeros(3)
    if coriolis:
        parameters.setOmegaCoriolis(EARTH)
    bias = gtsam.imuBias.ConstantBias(X0[15:18], X0[18:21])
    pim = gtsam.PreintegratedCombinedMeasurements(parameters, bias)
    count = 50
    T = count * DT
    for gyro, acc in zip(GYRO[:count], ACC[:count], strict=True):
        pim.integrateMeasurement(acc, gyro, DT)
    start = gtsam.NavState(gtsam.Rot3(X0[:9].reshape(3, 3)), X0[9:12], X0[12:15])
    theirs = pim.predict(start, bias)
    white = [np.full(COUNT, psd) for psd in PSD[:2]]
    ours, _, Q = propagate(X0, 0, count, EDGES, GYRO, ACC, *white, *PSD[2:], rate_n, GRAVITY)

    turn = log_so3(theirs.attitude().matrix().T @ ours[:9].reshape(3, 3))
    # GTSAM takes the Earth's turn off the whole rotation vector and leaves the force where it was at the start;
    # and it adds each step to the rotation vector in first order: the next is rate^2 dt^2 theta / 12
    w = np.linalg.norm(rate_n)
    angle = w * T * RATE * T / 2 + RATE**3 * DT * T**2 / 24
    assert np.linalg.norm(turn) < angle
    assert np.linalg.norm(theirs.velocity() - ours[12:15]) < (w * T / 2 + angle) * FORCE * T
    assert np.linalg.norm(theirs.position() - ours[9:12]) < (w * T / 2 + angle) * FORCE * T**2 / 2

    # GTSAM: rotation vector, position and velocity from the start, in the start's axes; bias at i less bias at j
    R_i = X0[:9].reshape(3, 3)
    J = np.zeros((15, 15))
    J[:3, :3] = right_jacobian(gtsam.Rot3.Logmap(pim.deltaRij()))
    J[3:6, 3:6] = J[6:9, 6:9] = R_i
    J[9:, 9:] = -np.eye(6)
    expected = J @ pim.preintMeasCov() @ J.T
    sd = np.sqrt(np.diag(expected))
    late = 1.5 * DT / T + RATE * DT  # both of first order in a step
    fault = worst(Q / np.outer(sd, sd), expected / np.outer(sd, sd), late, ERRORS, ERRORS)
    assert not fault, fault


def right_jacobian(theta):
    """Exp(theta + d) = Exp(theta) Exp(J d), by the series of (1 - exp(-ad)) / ad."""
    J, term = np.eye(3), np.eye(3)
    for k in range(2, 14):
        term = term @ -skew(theta) / k
        J = J + term
    return J


# ---- coning and sculling ----


def coned(a, frequency, dt, count):
    """Mean body rates (n, 3) of an axis that goes round a cone of half angle ``a``, and the attitude (n + 1, 3, 3).

    The quaternion is (cos a/2, sin a/2 cos Wt, sin a/2 sin Wt, 0): body rate (-W sin a sin Wt, W sin a cos Wt,
    -2 W sin^2 a/2), whose integrals are exact.
    """
    W, t = 2 * np.pi * frequency, dt * np.arange(count + 1)
    angle = np.column_stack([np.sin(a) * np.cos(W * t), np.sin(a) * np.sin(W * t), -2 * np.sin(a / 2) ** 2 * W * t])
    quat = np.column_stack([np.sin(a / 2) * np.cos(W * t), np.sin(a / 2) * np.sin(W * t), 0 * t, 0 * t + np.cos(a / 2)])
    return np.diff(angle, axis=0) / dt, Rotation.from_quat(quat)


def test_coning_against_its_closed_form():
    a, frequency, dt, count = 1e-3, 40.0, 0.002, 5000
    gyro, truth = coned(a, frequency, dt, count)
    steps = make_steps(imu_series(gyro, np.zeros((count, 3)), 2_000_000), np.eye(3), "end")
    compensated, _ = compensate(steps, np.zeros(3), np.zeros(3))

    def drift(rates):
        R = truth[0] * Rotation.from_matrix(rotations(steps.edges_s, rates, np.zeros(3))[-1])
        return (truth[-1].inv() * R).as_rotvec()

    turn = 2 * np.pi * frequency * dt
    # a step misses the area between the way round the cone and its chord
    missed = a**2 / 2 * (turn - np.sin(turn))
    found = a**2 / 3 * np.sin(turn / 2) ** 2 * np.sin(turn)  # cross product of neighbours over 12
    assert abs(drift(gyro)[2]) == pytest.approx(count * missed, rel=1e-3)
    assert abs(drift(compensated)[2]) == pytest.approx(count * (missed - found), rel=1e-2)
    assert missed - found == pytest.approx(a**2 * turn**5 / 60, rel=0.1), "fifth order in the turn per step"


def test_sculling_against_its_closed_form():
    """Rocking about x in time with shaking along y pushes along z by half the product of their amplitudes."""
    a, force, frequency, dt, count = 1e-3, 5.0, 40.0, 0.002, 5000
    W, edges = 2 * np.pi * frequency, dt * np.arange(count + 1)
    gyro, acc = np.zeros((2, count, 3))
    gyro[:, 0] = np.diff(a * np.sin(W * edges)) / dt
    acc[:, 1] = np.diff(-force / W * np.cos(W * edges)) / dt  # mean of force sin Wt in b
    steps = make_steps(imu_series(gyro, acc, 2_000_000), np.eye(3), "end")
    rate, compensated = compensate(steps, np.zeros(3), np.zeros(3))
    x0 = np.concatenate([np.eye(3).ravel(), np.zeros(12)])

    def pushed(rates, forces):
        return mechanise(x0, steps.edges_s, rates, forces, np.zeros(3), np.zeros(3))[-1][14]

    T, turn = count * dt, W * dt  # a whole number of periods
    expected = a * force / 2 * T
    assert pushed(rate, compensated) == pytest.approx(expected, rel=turn**4 / 60 * 2)
    assert abs(pushed(gyro, acc) - expected) > turn**2 / 12 * expected


def test_compensation_is_done_at_the_biases_and_leaves_them_in():
    steps = make_steps(imu_series(GYRO, ACC, 2_000_000), np.eye(3), "end")
    bias_gyro, bias_acc = np.array([0.01, -0.02, 0.03]), np.array([0.1, -0.3, 0.2])
    biased = make_steps(imu_series(GYRO + bias_gyro, ACC + bias_acc, 2_000_000), np.eye(3), "end")
    for plain, shifted, bias in zip(
        compensate(steps, np.zeros(3), np.zeros(3)),
        compensate(biased, bias_gyro, bias_acc),
        (bias_gyro, bias_acc),
        strict=True,
    ):
        assert_allclose(shifted - bias, plain, atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-13, 1e-8, 1e-3, 1.0, 2.5, np.pi - 1e-6, np.pi])
def test_log_is_the_inverse_of_exp(angle):
    rng = np.random.default_rng(0)
    for axis in [*np.eye(3), *-np.eye(3), *rng.standard_normal((20, 3))]:
        turn = angle * axis / np.linalg.norm(axis)
        found = log_rotation(exp_rotation(turn))
        # near a half turn the axis is what the matrix says of it, to the square root of rounding, and its sign is free
        assert_allclose(exp_rotation(found), exp_rotation(turn), atol=20 * EPS)
        assert np.linalg.norm(found) == pytest.approx(angle, abs=1e-7 if angle > 3 else 20 * EPS)


def test_difference_undoes_a_correction():
    rng = np.random.default_rng(1)
    x0 = np.tile(np.append(X0, [0.4, -0.2]), (5, 1))
    d = rng.standard_normal((5, 17))
    assert_allclose(difference(correct_states(x0, d), x0), d, atol=1e-13)


# ---- corrections of a whole path ----


def test_a_path_corrected_along_itself_is_corrected_alike_to_first_order():
    rng = np.random.default_rng(8)
    x = correct_states(np.tile(X0, (12, 1)), rng.standard_normal((12, 15)))
    d = rng.standard_normal((12, 15))
    apart = [np.abs(difference(correct_path(x, size * d), correct_states(x, size * d))).max() for size in (1e-3, 1e-4)]
    assert apart[0] < 1e-3
    assert apart[1] == pytest.approx(apart[0] / 100, rel=0.05)  # second order


def test_a_path_turned_about_its_start_keeps_its_form():
    """Turning all states about the vertical is one correction, however far, and no step changes its length."""
    rng = np.random.default_rng(3)
    x = correct_states(np.tile(X0, (12, 1)), rng.standard_normal((12, 15)))
    turn = 1.5 * np.array([0.0, 0.0, 1.0])
    d = np.zeros((12, 15))
    d[:, :3] = np.einsum("nji,j->ni", x[:, :9].reshape(-1, 3, 3), turn)
    d[:, 3:6], d[:, 6:9] = np.cross(turn, x[:, 9:12] - x[0, 9:12]), np.cross(turn, x[:, 12:15])
    turned, Z = correct_path(x, d), exp_so3(turn)
    assert_allclose(turned[:, 9:12], x[0, 9:12] + (x[:, 9:12] - x[0, 9:12]) @ Z.T, atol=1e-13)
    assert_allclose(turned[:, 12:15], x[:, 12:15] @ Z.T, atol=1e-14)
    assert_allclose(turned[:, :9].reshape(-1, 3, 3), Z @ x[:, :9].reshape(-1, 3, 3), atol=1e-14)
