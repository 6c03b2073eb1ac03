"""The shaft machine's filters: loops that close as the paper says, errata that show, and the truth from clean logs."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

import datasets
from tbmfg.errors import EstimationError, RigError
from tbmfg.estimators import check_switches, estimate
from tbmfg.evaluation.metrics import evaluate
from tbmfg.filters import complementary, euler_ekf, frd, sbm
from tbmfg.filters.sbm_readings import held, readings, spread
from tbmfg.prepare import prepare
from tbmfg.rig import override
from tbmfg.state import Truth
from tests.problems import clean_log, log_of, state_errors, true_states, worst
from tests.test_outcome import assert_counted

RATE = 50.0
T = 1 / RATE
G = 9.8
DIP = np.deg2rad(58.0)
FIELD = np.array([np.cos(DIP), 0.0, np.sin(DIP)])
NAMES = ["roll", "pitch", "yaw", "d_x", "d_y", "d_z", "V_x", "V_y", "V_z"]
STATE = np.array([0.3, -0.4, 1.1, 0.2, -0.1, 5.0, 0.4, 0.6, 1.3])
OMEGA, FORCE = np.array([0.2, -0.5, 0.7]), np.array([1.0, -2.0, -9.0])


# ---- the complementary filter's loops ----


def follow(tilt, start=(0.0, 0.0, 0.0), field=FIELD, k_i=0.06, yaw_only=True):
    """Angles of the filter without a gyro; its accelerometer sees the roll ``tilt`` (n,), its field is constant."""
    n = len(tilt)
    a_s = G * np.column_stack([np.zeros(n), np.sin(tilt), np.cos(tilt)])
    still, dt = np.zeros((n, 3)), np.full(n, T)
    m_s = np.tile(field, (n, 1))
    q = frd.quaternion(np.array(start))
    return complementary.attitude(q, still, a_s, m_s, dt, FIELD[0], FIELD[2], 3.0, k_i, yaw_only, False)[0]


@pytest.mark.parametrize(("turns_per_minute", "gain"), [(10, 0.95), (40, 0.58)])
def test_cutterhead_lines_pass_as_the_transfer_function_says(turns_per_minute, gain):
    """(14): G_L = Cc / (s + Cc), Cc = 3 + 0.06 / s; sampled, s is (exp(j w T) - 1) / T."""
    w = 2 * np.pi * turns_per_minute / 60
    t = T * np.arange(6000)
    roll = follow(0.01 * np.sin(w * t))[1:, 0]
    late = t > 60
    passed = 2 * np.abs(np.mean(roll[late] * np.exp(-1j * w * t[late]))) / 0.01
    s = (np.exp(1j * w * T) - 1) / T
    Cc = 3.0 + 0.06 / s
    assert passed == pytest.approx(abs(Cc / (s + Cc)), abs=3e-3)
    assert passed == pytest.approx(gain, abs=0.02)


def test_feedback_halves_a_roll_error_and_the_printed_sign_doubles_it():
    """S11: from 5.7 degrees, 0.3 after a second; with (16) as printed the roll runs away."""
    right = follow(np.zeros(50), start=(0.1, 0, 0), k_i=0.0)
    assert np.rad2deg(right[-1, 0]) == pytest.approx(5.73 * np.exp(-3.0), abs=0.05)
    q = frd.quaternion(np.array([0.1, 0.0, 0.0]))
    for _ in range(50):
        printed = frd.gravity_in_a(q) * [1, -1, 1]
        q = frd.advance(q, 3.0 * np.cross([0.0, 0.0, 1.0], printed), T)
    assert np.rad2deg(frd.angles_of(frd.rotation_ar(q))[0]) > 20


def test_yaw_follows_the_field_with_the_gain_of_its_horizontal_part():
    """The loop gain is K_p h_n^2, 0.28 K_p at a dip of 58 degrees."""
    yaw = follow(np.zeros(100), start=(0, 0, 0.05), k_i=0.0)[:, 2]
    assert yaw[-1] / yaw[0] == pytest.approx(np.exp(-3.0 * FIELD[0] ** 2 * 2.0), rel=0.02)


@pytest.mark.parametrize("yaw_only", [True, False])
def test_a_disturbed_field_reaches_roll_and_pitch_as_printed(yaw_only):
    """S12."""
    angles = follow(np.zeros(200), field=FIELD + np.array([0.0, 0.2, 0.1]), yaw_only=yaw_only)
    tilt = np.abs(angles[:, :2]).max()
    assert np.abs(angles[:, 2]).max() > 0.1
    assert tilt < 1e-9 if yaw_only else tilt > 0.02


def test_observers_find_displacement_and_speed():
    """(s + 0.3)^2 vertically, (s + 3)^2 horizontally: a wrong speed e0 leaves e0 exp(-0.3 t) (1 + 0.3 t)."""
    n = 1500
    t = T * np.arange(n + 1)
    spot = -np.column_stack([0.01 * t[1:], 0.0 * t[1:]])  # the machine moves forward, the spot back
    f = np.tile([0.0, 0.0, -G], (n, 1))
    d, V = complementary.observers(
        np.zeros(3), np.zeros(3), np.zeros((n + 1, 3)), f, spot, 1.33 * t[1:], np.full(n, T), G, -1
    )
    assert_allclose(V[-1], [0.01, 0.0, 1.33], atol=5e-3)
    assert_allclose(d[-1], [0.3, 0.0, 1.33 * 30], atol=0.04)
    expected = -1.33 * np.exp(-0.3 * t) * (1 + 0.3 * t)
    assert_allclose(V[:, 2] - 1.33, expected, atol=0.03)
    assert_allclose(complementary.displacement(np.array([2.0, 1.0]), np.pi / 2, -1), [1.0, -2.0], atol=1e-12)


# ---- the extended Kalman filter's ----


@pytest.mark.parametrize("states", [9, 7])
def test_jacobian_is_that_of_the_prediction(states):
    """(24) against central differences; the seven states have neither inputs' columns nor the turning acceleration."""
    h = 1e-5
    ahead, behind = (
        [euler_ekf.predict_state(STATE + e, OMEGA, FORCE, T, G) for e in sign * h * np.eye(9)] for sign in (1, -1)
    )
    numeric = np.transpose(np.subtract(ahead, behind)) / (2 * h)
    if states == 7:
        numeric[6:, :3] = 0.0
        numeric[[3, 4], [6, 7]] = 0.0
    found = euler_ekf.jacobian(STATE, OMEGA, FORCE, T, states, False)
    # truncation h^2 / 6 times third derivatives of T f / cos^3, below 1; rounding eps |X| / h
    assert not worst(found, numeric, 1e-9, NAMES, NAMES)
    printed = euler_ekf.jacobian(STATE, OMEGA, FORCE, T, states, True)
    assert np.argwhere(found != printed).tolist() == [[5, 8]]


def ekf(z, X=None, omega=(0.0, 0.0, 0.0), P=None, states=9, predict_printed=False, jac_printed=False):
    """States after every step on level ground: readings ``z`` (n, 7), rate ``omega``, specific force of rest."""
    n = len(z)
    X, P = np.zeros(9) if X is None else X, np.eye(9) * 1e-2 if P is None else P
    sd = np.array([0.02, 0.02, 0.02, 1e-4, 1e-4, 0.1, 0.2])
    rows = np.full(n, 1e-6), np.full(n, 1e-5)
    return euler_ekf.run(
        X, P, np.tile(omega, (n, 1)), np.tile([0.0, 0.0, -G], (n, 1)), z, sd, np.full(n, T), *rows, G, -1, states,
        predict_printed, jac_printed, np.arange(n + 1),
    )  # fmt: skip


def test_speed_is_learnt_from_the_barometer_but_not_with_the_printed_jacobian():
    """S18: it goes down at 1.33 m/s and starts from 0.4."""
    n = 2000
    z = np.full((n, 7), np.nan)
    z[:, :3], z[:, 5] = 0.0, 1.33 * T * np.arange(1, n + 1)
    X = np.zeros(9)
    X[8] = 0.4
    right, _, _ = ekf(z, X)
    assert right[-1, 8] == pytest.approx(1.33, abs=0.01)
    printed, P, _ = ekf(z, X, jac_printed=True)
    assert printed[-1, 8] == pytest.approx(0.4, abs=1e-9)
    assert P[-1, 8, 8] > P[0, 8, 8]
    assert abs(printed[-1, 5] - z[-1, 5]) > 10 * abs(right[-1, 5] - z[-1, 5])


def test_gyro_is_not_used_by_the_printed_prediction_on_level_ground():
    """S19: Phi X drops T [omega, V, a]."""
    z = np.full((100, 7), np.nan)
    assert_allclose(ekf(z, omega=(0.0, 0.0, 0.1))[0][-1, 2], 0.1 * 100 * T, rtol=1e-12)
    assert ekf(z, omega=(0.0, 0.0, 0.1), predict_printed=True)[0][-1, 2] == 0.0


def test_seven_states_leave_the_horizontal_speed_alone():
    """S15: the spot stands still, the speed that the filter starts with stays."""
    z = np.full((500, 7), np.nan)
    z[:, :5] = 0.0
    X = np.zeros(9)
    X[6] = 0.05
    assert ekf(z, X)[0][-1, 6] == pytest.approx(0.0, abs=1e-3)
    assert ekf(z, X, P=np.diag([1e-2] * 6 + [0, 0, 1e-2]), states=7)[0][-1, 6] == pytest.approx(0.05, abs=1e-9)


def test_yaw_innovations_are_wrapped():
    """(28): it looks south, a degree to either side."""
    z = np.full((50, 7), np.nan)
    z[:, 2] = -np.pi + np.deg2rad(1.0)
    X = np.zeros(9)
    X[2] = np.pi - np.deg2rad(1.0)
    yaw = ekf(z, X)[0][:, 2]
    assert np.abs(np.cos(yaw) + 1).max() < 2e-4
    assert yaw[-1] == pytest.approx(-np.pi + np.deg2rad(1.0), abs=np.deg2rad(0.3))


def test_a_pitch_near_90_degrees_ends_the_filter():
    z = np.full((100, 7), np.nan)
    X = np.zeros(9)
    X[1] = 1.5
    _, _, singular = ekf(z, X, omega=(0.0, 1.0, 0.0))
    assert singular == 3  # 1.5 + 0.06 is beyond 89 degrees, 1.5533


# ---- readings ----


def test_held_readings_grow_old():
    values = np.full((10, 1), np.nan)
    values[[1, 2]] = [[1.0], [2.0]]
    assert_allclose(held(values, np.full(10, 0.1), 0.1)[:, 0], [np.nan, 1, 2, 2, 2] + [np.nan] * 5)


def test_spread_is_that_of_the_noise_whatever_the_machine_does():
    _, problem = shaft("shaft-dynamic", clean=True)
    given = readings(problem, 288.15)
    noise = np.random.default_rng(0).standard_normal(given.f.shape) * np.deg2rad([0.5, 1.0, 2.0])
    assert_allclose(spread(given, given.angles + noise), np.deg2rad([0.5, 1.0, 2.0]), rtol=0.1)


# ---- logs ----


@cache
def shaft(name="shaft-dynamic", duration=20.0, settings=(), clean=False):
    """A simulation and its problem; with ``clean`` by perfect sensors, started from the truth."""
    simulation = datasets.make(name, seed=3, duration=duration, settings=("sensors.imu.noise_factor=1", *settings))
    if not clean:
        return simulation, prepare(log_of(simulation.log_series), simulation.rig)
    problem = prepare(clean_log(simulation), simulation.rig)
    x = problem.prior.x.copy()
    x[:21] = true_states(simulation, problem, biases=False)[0]
    return simulation, replace(problem, prior=replace(problem.prior, x=x))


def rms(errors):
    """Of rotation [deg], position [m] and velocity [m/s], (9,)."""
    return np.sqrt(np.mean(errors[:, :9] ** 2, axis=0)) * np.repeat([np.rad2deg(1.0), 1.0, 1.0], 3)


@pytest.mark.parametrize("settings", [(), ("origin.x_axis_azimuth_deg=70", "sensors.magnetometer.declination_deg=5")])
@pytest.mark.parametrize("name", list(sbm.FILTERS))
def test_perfect_sensors_give_the_truth_in_n(name, settings):
    """What is left: it rocks by 0.5 degrees at up to 0.19 Hz, a metre above its pivot: accelerations of 12 mm/s^2 or
    0.07 degrees of tilt, times the dip's tangent of 1.6 in yaw; and an observer's lag of 3 mm in 0.3 s."""
    simulation, problem = shaft(settings=settings, clean=True)
    filter_, model = sbm.FILTERS[name]
    found = filter_(problem, model(air_c=22.0))
    error = rms(state_errors(found.x, true_states(simulation, problem, biases=False)))
    assert (error[:3] < [0.07, 0.07, 0.11]).all()
    assert error[3:5].max() < 1e-3
    assert error[5] < 0.01
    assert error[6:].max() < 0.01


@pytest.mark.parametrize(
    ("name", "key", "values"),
    [
        ("sbm-cf", "mag_mode", ("printed", "yaw_only")),
        ("sbm-cf", "integrator", ("exp", "rk4")),
        ("sbm-cf", "psd_sign", (-1, 1)),
        ("sbm-ekf", "states", (9, 7)),
        ("sbm-ekf", "predict", ("correct", "printed")),
        ("sbm-ekf", "jac", ("correct", "printed")),
        ("sbm-ekf", "vz", ("none", "baro_diff")),
        ("sbm-ekf", "air_c", (22, 15)),
        ("sbm-cfekf", "coupling", ("rate", "angle")),
        ("sbm-cfekf", "mag_mode", ("printed", "yaw_only")),
    ],
)
def test_switches_of_the_rig_reach_the_filter(name, key, values):
    _, problem = shaft("shaft-descend")
    found = []
    for value in values:
        rig = override(problem.rig, [f"estimators.{name}.{key}={value}"])
        check_switches(rig)
        found.append(estimate(name, replace(problem, rig=rig)).trajectory)
    default = estimate(name, problem).trajectory
    apart = [
        max(np.abs(other.position_n - default.position_n).max(), np.abs(other.quat_xyzw - default.quat_xyzw).max())
        for other in found
    ]
    assert apart[0] == 0.0, "the first value is that of the shipped rig"
    assert apart[1] > 1e-6


def test_unknown_switches_are_refused():
    _, problem = shaft("shaft-descend")
    for wrong in ("estimators.sbm-ekf.coupling=rate", "estimators.sbm-cf.k_p=-1", "estimators.sbm-cfekf.states=8"):
        with pytest.raises(RigError, match=r"estimators\.sbm"):
            check_switches(override(problem.rig, [wrong]))


@pytest.mark.parametrize("name", list(sbm.FILTERS))
def test_every_sample_is_counted(name):
    simulation = shaft("shaft-descend")[0]
    log = log_of(simulation.log_series)
    problem = prepare(log, simulation.rig, outages=(("laser", 5.0, 8.0), ("barometer", 2.0, 3.0)))
    result = estimate(name, problem)
    assert_counted(result, log, simulation.rig)
    for sensor in ("magnetometer", "laser", "barometer"):
        count = result.counts[sensor]
        assert count.used > 0.8 * (count.received - count.outage)
        assert count.gated == 0
    assert result.counts["laser"].outage > 100


def test_without_covariance_there_is_no_nees():
    simulation, problem = shaft("shaft-descend")
    result = estimate("sbm-cf", problem)
    assert not result.trajectory.cov.any()
    assert any("no covariance" in line for line in result.warnings)
    t_s = np.arange(0.0, 20.0, 0.02)
    path = simulation.truth(t_s)
    from scipy.spatial.transform import Rotation

    quat = Rotation.from_matrix(path.R).as_quat()
    truth = Truth(simulation.start_ns + np.round(t_s * 1e9).astype(np.int64), path.position, quat, path.velocity)
    metrics = evaluate(result.trajectory, truth)
    assert metrics["nees_mean"] is None
    assert metrics["attitude_rms_deg"] < 3
    assert evaluate(estimate("sbm-ekf", problem).trajectory, truth)["nees_mean"] > 0


def test_without_laser_and_barometer_attitude_is_left():
    simulation, _ = shaft("shaft-descend")
    problem = prepare(log_of(simulation.log_series), simulation.rig, without=("laser", "barometer"))
    for name in sbm.FILTERS:
        result = estimate(name, problem)
        assert sum("integrated acceleration" in line for line in result.warnings) == 2
        assert result.counts["laser"].unused == result.counts["laser"].received


def test_a_pitch_near_90_degrees_is_said_in_one_line():
    _, problem = shaft("shaft-descend")
    steps = problem.inertial.steps
    pitch = np.deg2rad(9.0) * steps.edges_s[1:]
    acc = G * np.column_stack([np.sin(pitch), np.zeros(len(steps)), np.cos(pitch)])
    gyro = problem.prior.x[18:21] + np.tile([0.0, -np.deg2rad(9.0), 0.0], (len(steps), 1))  # bow up is minus about y
    inertial = replace(problem.inertial, gyro=gyro, acc=acc)
    with pytest.raises(EstimationError, match=r"the pitch came within a degree of 90 at 9\.. s"):
        estimate("sbm-ekf", replace(problem, inertial=inertial))
