"""The sensor models: Jacobians against differences, zero residual at truth, and GTSAM's own factors."""

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad

from tbmfg import sensors
from tbmfg.geometry import exp_so3, rotation_from_rpy
from tbmfg.inertial.strapdown import correct_state
from tbmfg.sensors import MODELS, Rows
from tests.problems import EPS, ERRORS, worst

STEP = 1e-5  # of the central differences
DRIFTS = 2

# States with nothing zero and nothing symmetric.
X_I = np.concatenate(
    [exp_so3(np.array([0.3, -0.2, 1.1])).ravel(), [40, -70, 12], [1.7, -0.6, 0.4], [0.11, -0.07, 0.05],
     [0.013, -0.021, 0.034], [-0.7, 0.45]]
)  # fmt: skip
X_J = np.concatenate(
    [exp_so3(np.array([-0.15, 0.4, 1.6])).ravel(), [43, -68, 12.7], [1.1, 0.9, -0.3], [0.12, -0.05, 0.06],
     [0.017, -0.019, 0.03], [-0.8, 0.5]]
)  # fmt: skip

R_BD = rotation_from_rpy(np.array([np.pi, 0.1, 0.3]))  # of a detector that looks down

# measured values, auxiliary data, calibrations, and a bound on the third derivatives of h (its size or curvature)
CASES = {
    "prism": ([39.1, -70.4, 13.2], [0.013, 0.7, -1.1, 0.9, 7.0], [0.31, -0.52, 0.83, 0.006, 1e-3], 80.0),
    "odometer": (
        [3.1, 0.2, -0.4],
        [-0.4, 0.3, -1.1, 1.6, -0.3, 0.5, 0.01, -0.02, 0.015, 3.2, 0.15, -0.35],
        [0.07, 0.21, -0.13],
        80.0,
    ),
    "wheel": ([1.3], [-0.4, 0.3, -1.1, 0.7, -1.1, 0.9, 1.1], [0.07, 0.21, -0.13], 10.0),
    # the field dips by about 60 degrees: the third derivative of the angle grows as 2 tan(dip)^3
    "magnetometer": ([14.0, -17.0, -31.0], [0.4], [0.05], 20.0),
    "magnetic_field": (
        [1.4e-5, -1.7e-5, -3.1e-5],
        [0.4, *(1.3e-6 * R_BD).ravel(), 1.9e-5],
        [0.05, 0.8, -0.5, 1.1, 19.0],
        20.0,
    ),
    "barometer": ([11.2], [0.04, 1.0, 3.0, -2.0], [0.02, 1.3], 20.0),
    "position": ([39.0, -69.0, 11.0], [], [], 80.0),
    # tilted by some 20 degrees, 15 m above z = 0: third derivatives grow as the distance over cos^4
    "laser": (
        [0.3, -0.2],
        [0.04, -0.008, 0.2, -0.1, 0.4, *(R_BD @ [1, 0, 0]), *(R_BD @ [0, 1, 0]), 38.0, -69.0],
        [0.02, -0.03, 0.004, 0.006],
        4000.0,
    ),
    "velocity": ([0.2, -0.1, 0.3], [], [], 5.0),
    "bounded": ([38.0, -69.0, 11.0, 0.1, 0.2, 0.3], [], [], 80.0),
}
BINARY = {"odometer"}
CALIBRATIONS = {
    "prism": ["arm.x", "arm.y", "arm.z", "offset", "drift"],
    "odometer": ["scale", "yaw", "pitch"],
    "wheel": ["scale", "yaw", "pitch"],
    "magnetometer": ["declination"],
    "magnetic_field": ["declination", "iron.x", "iron.y", "iron.z", "strength"],
    "barometer": ["scale", "lapse"],
    "laser": ["tilt.x", "tilt.y", "offset.x", "offset.y"],
}


def evaluate(model, xi, xj, c):
    """One row: residual (k,), Jacobians (k, .) to i, j and the calibrations."""
    z, data, *_ = CASES[model]
    row = [np.array(v, dtype=float).reshape(1, -1) for v in (z, data)]
    return [part[0] for part in MODELS[model](*row, xi[None], xj[None], np.asarray(c, dtype=float))]


def differences(function, size):
    """Central differences of ``function`` (d -> residual) about zero, (k, size)."""
    steps = STEP * np.eye(size)
    return np.stack([(function(d) - function(-d)) / (2 * STEP) for d in steps], axis=1)


def tolerance(model):
    """Truncation h^2 / 6 times the third derivative, and the rounding of two values of that size; twice their sum."""
    size = CASES[model][3]
    return 2 * (STEP**2 / 6 * size + EPS * size / STEP)


def test_every_model_is_tested():
    assert {*CASES, "rotation", "lidar"} == set(MODELS)  # the last has a file of its own


@pytest.mark.parametrize("model", CASES)
def test_jacobian_to_the_state(model):
    c = CASES[model][2]
    _, Ji, Jj, _ = evaluate(model, X_I, X_J, c)
    names = [*ERRORS, *(f"drift.{k}" for k in range(DRIFTS))]
    rows = [f"h[{k}]" for k in range(len(Ji))]
    if model in BINARY:
        at_i = differences(lambda d: evaluate(model, correct_state(X_I, d), X_J, c)[0], len(names))
        at_j = differences(lambda d: evaluate(model, X_I, correct_state(X_J, d), c)[0], len(names))
        assert not (fault := worst(Jj, at_j, tolerance(model), rows, names)), f"{model}, state at j: {fault}"
    else:
        assert Jj.shape == (len(Ji), 0), "a measurement at one time has no second state"
        at_i = differences(lambda d: evaluate(model, *[correct_state(X_I, d)] * 2, c)[0], len(names))
    assert not (fault := worst(Ji, at_i, tolerance(model), rows, names)), f"{model}, state at i: {fault}"


@pytest.mark.parametrize("model", CALIBRATIONS)
def test_jacobian_to_the_calibrations(model):
    c = np.array(CASES[model][2])
    Jc = evaluate(model, X_I, X_J, c)[3]
    numeric = differences(lambda d: evaluate(model, X_I, X_J, c + d)[0], len(c))
    fault = worst(Jc, numeric, tolerance(model), [f"h[{k}]" for k in range(len(Jc))], CALIBRATIONS[model])
    assert not fault, f"{model}: {fault}"


@pytest.mark.parametrize("model", CASES)
def test_no_rows_are_no_trouble(model):
    z, data, c, _ = CASES[model]
    parts = MODELS[model](
        np.zeros((0, len(z))), np.zeros((0, len(data))), *[np.zeros((0, 21 + DRIFTS))] * 2, np.array(c)
    )
    assert [len(part) for part in parts] == [0, 0, 0, 0]
    assert parts[1].shape[2] == 15 + DRIFTS
    assert parts[3].shape[2] == len(c)


@pytest.mark.parametrize("model", CASES)
def test_rows_do_not_touch_each_other(model):
    z, data, c, _ = CASES[model]
    xi, xj = np.stack([X_I, X_J]), np.stack([X_J, X_I])
    both = MODELS[model](*[np.tile(np.array(v, float), (2, 1)) for v in (z, data)], xi, xj, np.array(c, float))
    first = evaluate(model, X_I, X_J, c)
    second = evaluate(model, X_J, X_I, c)
    for together, one, two in zip(both, first, second, strict=True):
        assert_array_equal(together, np.stack([one, two]))


# ---- prism ----


def jacobian(factor, values):
    """The columns of a GTSAM factor with unit noise."""
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    return graph.linearize(values).jacobian()[0]


def test_prism_is_the_gps_factor_with_arm():
    z, data, c = np.array(CASES["prism"][0]), [0.0, 0.7, -1.1, 0.9, 50.0], np.array([0.31, -0.52, 0.83, 0.0, 0.0])
    residual, Ji, _, Jc = (part[0] for part in sensors.prism(z[None], np.array([data]), X_I[None], X_I[None], c))
    R = X_I[:9].reshape(3, 3)
    pose, unit = gtsam.Pose3(gtsam.Rot3(R), X_I[9:12]), gtsam.noiseModel.Unit.Create(3)

    known = gtsam.GPSFactorArm(0, z, c[:3], unit)
    atol = 8 * EPS * 80.0  # three products and sums of numbers up to 80
    assert_allclose(residual, known.evaluateError(pose), atol=atol)
    values = gtsam.Values()
    values.insert(0, pose)
    A = jacobian(known, values)
    # GTSAM moves the position by R d, we in n
    assert_allclose(Ji[:, :6], np.hstack([A[:, :3], A[:, 3:6] @ R.T]), atol=atol)
    assert not Ji[:, 6:].any()

    unknown = gtsam.GPSFactorArmCalib(0, 1, z, unit)
    assert_allclose(residual, unknown.evaluateError(pose, c[:3]), atol=atol)
    values.insert(1, c[:3])
    A = jacobian(unknown, values)
    assert_allclose(Jc[:, :3], A[:, 6:], atol=atol)


def test_prism_between_keyframes_follows_a_turning_flying_body():
    """Body at constant velocity and rate about a fixed axis: h differs from the truth by the square of the lag."""
    lag, w, arm = 2e-3, np.array([0.7, -1.1, 0.9]), np.array([0.31, -0.52, 0.83])
    R = X_I[:9].reshape(3, 3)
    point = X_I[9:12] + X_I[12:15] * lag + R @ exp_so3(w * lag) @ arm
    for indicated, *clock in ((lag, 0.0, 0.0), (lag + 0.05, 0.05, 0.0), (lag + 0.05, 0.02, 1e-4)):
        data = np.array([[indicated, *w, 300.0]])
        residual, *_ = sensors.prism(point[None], data, X_I[None], X_I[None], np.array([*arm, *clock]))
        assert_allclose(residual[0], 0.0, atol=0.5 * (w @ w) * np.linalg.norm(arm) * lag**2)


# ---- odometer ----


@pytest.mark.parametrize("scale", [0.0, 0.08, -0.3])
def test_odometer_on_a_straight_way(scale):
    """A wheel that points 12 degrees left and 7 down of b's x axis rolls 3 m along its own axis."""
    yaw, pitch, distance, arm = np.radians(12.0), np.radians(7.0), 3.0, np.array([-0.4, 0.3, -1.1])
    R, E = X_I[:9].reshape(3, 3), rotation_from_rpy(np.array([0.0, pitch, yaw]))
    x_j = X_I.copy()
    x_j[9:12] += R @ E[:, 0] * distance
    D = (1 + scale) * np.array([distance, 0.0, 0.0])  # as indicated
    bias = X_I[18:21]
    data = np.concatenate([arm, E[:, 0] * distance / 2, bias, D])[None]
    residual, *_ = sensors.odometer(D[None], data, X_I[None], x_j[None], np.array([scale, yaw, pitch]))
    assert_allclose(residual, 0.0, atol=20 * EPS * 80.0)


def test_odometer_of_a_body_that_turns_on_the_spot():
    """The contact point stands still; the IMU swings about it."""
    arm = np.array([-0.4, 0.3, -1.1])
    R, turn = X_I[:9].reshape(3, 3), exp_so3(np.array([0.0, 0.0, 1.2]))
    x_j = X_I.copy()
    x_j[:9] = (R @ turn).ravel()
    x_j[9:12] = X_I[9:12] + R @ arm - R @ turn @ arm
    data = np.concatenate([arm, np.zeros(3), X_I[18:21], np.zeros(3)])[None]
    residual, *_ = sensors.odometer(np.zeros((1, 3)), data, X_I[None], x_j[None], np.array([0.02, 0.1, 0.2]))
    assert_allclose(residual, 0.0, atol=20 * EPS * 80.0)


def test_odometer_allows_for_a_gyro_bias_found_later():
    """Driving straight in truth; the way was added up with a gyro bias that is wrong by ``error``."""
    error, T, v, steps = np.array([2e-3, -3e-3, 4e-3]), 1.0, 0.8, 2000
    t = (np.arange(steps) + 0.5) * T / steps
    # the gyro read the bias, which was taken for a turn: R_i^T R(t) = Exp(error t)
    ahead = exp_so3(error * t[:, None])[:, :, 0] * v * T / steps
    D, B = ahead.sum(axis=0), (ahead * t[:, None]).sum(axis=0)
    x_j = X_I.copy()
    x_j[9:12] += X_I[:9].reshape(3, 3) @ [v * T, 0.0, 0.0]
    b_0 = X_I[18:21] - error
    data = np.concatenate([np.zeros(3), B, b_0, D])[None]
    residual, *_ = sensors.odometer(D[None], data, X_I[None], x_j[None], np.zeros(3))
    second_order = v * T * (np.linalg.norm(error) * T) ** 2
    assert_allclose(residual, 0.0, atol=second_order)
    assert np.linalg.norm(D - [v * T, 0, 0]) > 50 * second_order, "the bias matters in this test"


@pytest.mark.parametrize("scale", [0.0, 0.08, -0.3])
@pytest.mark.parametrize("speed", [1.7, -1.7])
def test_wheel_on_a_turning_body(scale, speed):
    """The contact point rolls along an axis 12 degrees left and 7 down of b's x axis, the body turns about it."""
    yaw, pitch, arm, w = np.radians(12.0), np.radians(7.0), np.array([-0.4, 0.3, -1.1]), np.array([0.7, -1.1, 0.9])
    R, E = X_I[:9].reshape(3, 3), rotation_from_rpy(np.array([0.0, pitch, yaw]))
    x = X_I.copy()
    x[12:15] = R @ (speed * E[:, 0] - np.cross(w, arm))
    indicated = (1 + scale) * speed
    data = np.concatenate([arm, w + x[18:21], [indicated]])[None]
    residual, *_ = sensors.wheel(np.array([[indicated]]), data, x[None], x[None], np.array([scale, yaw, pitch]))
    assert_allclose(residual, 0.0, atol=20 * EPS * 3.0)


# ---- magnetometer, barometer, bounds ----


def test_magnetometer_at_truth_and_across_the_branch_cut():
    north, declination, dip = 2.9, 0.3, np.radians(64.0)
    R = X_I[:9].reshape(3, 3)
    direction = north - declination
    field_n = np.array([np.cos(dip) * np.cos(direction), np.cos(dip) * np.sin(direction), -np.sin(dip)])
    for turn in (0.0, 0.2, 1.0, -3.0):  # direction + turn passes +-pi
        states = X_I[None], X_I[None]
        field_b = R.T @ exp_so3(np.array([0.0, 0.0, turn])) @ field_n * 48e-6
        residual, *_ = sensors.magnetometer(field_b[None], np.array([[north]]), *states, np.array([declination]))
        assert residual[0, 0] == pytest.approx(turn, abs=1e-14)
        H, iron_ut = 48e-6 * np.cos(dip), np.array([3.0, -8.0, 5.0])
        data, c = np.array([[north, *(1e-6 * R_BD).ravel(), 0.5 * H]]), np.array([declination, 0.0, 0.0, 0.0, 1e6 * H])
        residual, *_ = sensors.magnetic_field(field_b[None], data, *states, c)
        assert residual[0, 0] == pytest.approx(2.0 * turn, abs=1e-13)
    c[1:4] = iron_ut
    at_truth = R.T @ field_n * 48e-6 + R_BD @ iron_ut * 1e-6
    assert sensors.magnetic_field(at_truth[None], data, *states, c)[0] == pytest.approx(0.0, abs=1e-14)


def test_barometer_bound_and_velocity_at_truth():
    above = X_I[11] + 0.04 * X_I[14] - 3.0
    # scale 1.02 at 5 m, and from there on 0.5 / 288.15 more for each metre: added up from 3 m on
    bent = quad(lambda z: 1.02 + 0.5 / 288.15 * (z - 5.0), 3.0, 3.0 + above)[0]
    height, data = 3.0 + bent + X_I[22], np.array([[0.04, 1.0, 3.0, 5.0]])
    residual, *_ = sensors.barometer(np.array([[height]]), data, X_I[None], X_I[None], np.array([0.02, 0.5]))
    assert residual[0, 0] == pytest.approx(0.0, abs=4 * EPS * 12)
    for model, z in (("velocity", X_I[12:15]), ("bounded", X_I[9:15])):
        residual, *_ = MODELS[model](z[None], np.zeros((1, 0)), X_I[None], X_I[None], np.zeros(0))
        assert not residual.any()


# ---- rows ----


def test_rows_take_their_states_and_calibrations_and_whiten():
    z, data, c, _ = CASES["odometer"]
    sigma = np.array([[0.5, 0.25, 2.0], [0.1, 0.2, 0.4]])
    i = np.array([1, 2])
    rows = Rows("odometer", "odometer", i, i + 1, *(np.tile(v, (2, 1)) for v in (z, data)), sigma, slice(2, 5), i)
    x, calibrations = np.stack([np.full_like(X_I, np.nan), X_I, X_J, X_I]), np.array([9.0, 9.0, *c])
    whitened = rows.evaluate(x, calibrations)
    for k, pair in enumerate([(X_I, X_J), (X_J, X_I)]):
        residual, *jacobians = evaluate("odometer", *pair, c)
        assert_allclose(whitened[0][k], residual / sigma[k], rtol=4 * EPS)
        for got, J in zip(whitened[1:], jacobians, strict=True):
            assert_allclose(got[k], J / sigma[k][:, None], rtol=4 * EPS)
    one = rows.evaluate_at(x[2:3], x[3:4], calibrations, slice(1, 2))
    assert_array_equal(one[0], whitened[0][1:])
    assert (len(rows), rows.dof) == (2, 3)


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.3])
def test_rotation_while_standing(size):
    turn = size * np.array([0.6, -0.64, 0.48])
    x_j = correct_state(X_I, np.concatenate([turn, np.zeros(15 + DRIFTS - 3)]))
    row = [np.zeros((1, 0))] * 2
    r, Ji, Jj, Jc = (part[0] for part in MODELS["rotation"](*row, X_I[None], x_j[None], np.zeros(0)))
    assert_allclose(r, turn, atol=1e-12)
    assert Jc.size == 0

    def at(d, side):
        xi, xj = (correct_state(X_I, d), x_j) if side == "i" else (X_I, correct_state(x_j, d))
        return MODELS["rotation"](*row, xi[None], xj[None], np.zeros(0))[0][0]

    # the series of the inverse Jacobian of Exp ends before turn^4 / 720
    bound = size**4 / 720 + 2 * (STEP**2 / 6 + EPS / STEP)
    for J, side in ((Ji, "i"), (Jj, "j")):
        assert_allclose(J, differences(lambda d, side=side: at(d, side), J.shape[1]), atol=bound)
