"""From samples to rows: keyframes, what belongs to which, and what is carried there, against a known motion."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from tbmfg import earth, measure
from tbmfg.inertial.steps import compensate, make_steps
from tbmfg.inertial.strapdown import rotations
from tbmfg.measure import GyroFrame, Samples
from tbmfg.rig import Barometer, Keyframes, Magnetometer, Odometer, Prism
from tests.problems import drive, flight, imu_series

# ---- keyframes ----

EDGES_S = np.arange(2001) * 0.005


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.floats(-1.0, 11.0), max_size=60),
    st.sampled_from([2.0, 5.0, 25.0, 1000.0]),
    st.sampled_from([0.05, 0.3, 1.0, 20.0]),
    st.floats(0.01, 12.0),
)
def test_keyframes_keep_to_the_rule(fixes, rate_hz, gap_s, end_s):
    fixes_s = np.sort(np.array(fixes))
    found = measure.keyframe_edges(Keyframes(max_rate_hz=rate_hz, max_gap_s=gap_s), EDGES_S, end_s, fixes_s)
    last = int(np.argmin(np.abs(EDGES_S - end_s)))
    assert found[0] == 0
    assert found[-1] == last
    assert np.all(np.diff(found) > 0)
    times = EDGES_S[found]
    # filled to the longest gap: pieces are whole steps, so one of them may be a step longer
    assert np.diff(times).max() <= gap_s + 0.005 + 1e-9
    inside = fixes_s[(fixes_s > 0) & (fixes_s < EDGES_S[last])]
    if len(inside):
        distance = np.abs(times[measure.nearest(times, inside)] - inside)
        # a fix that is nobody's own keyframe lies within a period of the highest rate of one
        assert distance.max() <= max(1.0 / rate_hz, 0.0025) + 0.0025 + 1e-9
    if len(inside) and np.diff(np.concatenate([[0.0], inside])).min() > 1.0 / rate_hz + 0.005:
        assert distance.max() <= 0.0025 + 1e-9, "every fix of its own has a keyframe within half a step"
    expected = 1 + len(inside) + 10.0 / gap_s + 1
    assert len(found) <= min(2 * expected, len(EDGES_S)) + 2


def test_dense_fixes_are_thinned_and_gaps_filled():
    rule = Keyframes(max_rate_hz=10.0, max_gap_s=0.5)
    fixes = np.concatenate([np.arange(0.5, 2.0, 0.02), np.arange(6.0, 10.0, 0.02)])
    times = EDGES_S[measure.keyframe_edges(rule, EDGES_S, 10.0, fixes)]
    assert np.diff(times).max() <= 0.5 + 1e-9
    dense = times[(times > 0.6) & (times < 2.0)]
    assert_allclose(np.diff(dense), 0.1, atol=0.0101)
    gap = times[(times > 2.0) & (times < 6.0)]
    assert np.diff(gap).min() > 0.4, "as few as the rule allows"


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(0, 10), min_size=2, max_size=20, unique=True), st.lists(st.floats(-3, 13), max_size=20))
def test_nearest_is_nearest(keyframes, times):
    keyframes_s, t_s = np.sort(np.array(keyframes)), np.array(times)
    k = measure.nearest(keyframes_s, t_s)
    distance = np.abs(keyframes_s[None] - t_s[:, None])
    assert_array_equal(distance[np.arange(len(t_s)), k], distance.min(axis=1) if len(t_s) else [])


# ---- carried by the gyro ----


def frame_of(imu, bias_gyro):
    steps = make_steps(imu, np.eye(3), "end")
    gyro, _ = compensate(steps, bias_gyro, np.zeros(3))
    return GyroFrame(steps, rotations(steps.edges_s, gyro, bias_gyro), gyro - bias_gyro, bias_gyro)


@pytest.fixture(scope="module")
def world():
    """A flight of perfect sensors: simulation, its gyro frame, and where the frame's zero lies in seconds of truth."""
    simulation = flight(duration=20.0)
    frame = frame_of(simulation.clean["imu"], np.zeros(3))
    return simulation, frame, (frame.steps.t0_ns - simulation.start_ns) * 1e-9


def states(simulation, t_s, origin_n):
    truth = simulation.truth(t_s)
    zero = np.zeros((len(t_s), 6))
    return np.hstack([truth.R.reshape(-1, 9), truth.position - origin_n, truth.velocity, zero])


def test_gyro_frame_follows_the_body(world):
    simulation, frame, zero_s = world
    t_s = np.sort(np.random.default_rng(0).uniform(0.0, 19.9, 50))
    R = frame.at(t_s)
    truth = simulation.truth(np.append(frame.steps.edges_s[0], t_s) + zero_s)
    expected = np.swapaxes(truth.R[:1], 1, 2) @ truth.R[1:]
    # the Earth turns by 1.5e-3 rad in 20 s, which the gyro sees; a sample's rate is held: alpha dt^2 / 8
    assert np.abs(R - expected).max() < earth.RATE * 20 + np.linalg.norm(truth.alpha, axis=1).max() * 0.005**2 / 8
    rate = frame.rate(t_s)
    alpha_change = 0.02**2 / 6 * 40.0  # second derivative of the rate: 3 rad/s^3 and less
    assert np.abs(rate - simulation.truth(t_s + zero_s).omega).max() < alpha_change + earth.RATE


def test_rate_is_finite_at_and_beyond_the_ends(world):
    _, frame, _ = world
    ends = np.array([-3.0, frame.steps.edges_s[0], 0.0, frame.steps.end_s, frame.steps.end_s + 3.0])
    assert np.isfinite(frame.rate(ends)).all()


def test_prism_rows_hold_at_truth(world):
    simulation, frame, zero_s = world
    clean, arm = simulation.clean["prism"], simulation.drawn["prism"]["arm_m"]
    clock, origin_n = measure.Clock(0.07, 1e-3), np.array([18.0, -10.0, 5.0])
    t_s = ((clean.t_ns - frame.steps.t0_ns) * 1e-9 + clock.offset_s) / (1.0 - clock.drift)
    keyframes = np.linspace(frame.steps.edges_s[0], frame.steps.end_s, 1000)  # every 20 ms
    sensor = Prism(topic="/prism", sigma_mm=2, sigma_ppm=1, station_m=(1.0, 2.0, 3.0))
    sigma = np.repeat(sensor.sigma_at(clean["point"])[:, None], 3, axis=1)
    samples = Samples("prism", t_s, clean["point"], sigma)
    rows = measure.position_rows(sensor, samples, clock, keyframes, frame, origin_n, slice(0, 5))
    x = states(simulation, keyframes + zero_s, origin_n)
    residual, *_ = replace(rows, sigma=np.ones_like(sigma)).evaluate(x, np.append(arm, [0.0, 0.0]))
    # half the acceleration of the prism, 12 m/s^2 at the most, over the lag of 10 ms
    assert np.abs(residual).max() < 0.5 * 12.0 * 0.01**2
    assert_allclose(rows.sigma[:, 0], 2e-3 + 1e-6 * np.linalg.norm(clean["point"] - [1, 2, 3], axis=1), rtol=1e-12)
    assert_array_equal(rows.i, rows.j)
    assert np.all(np.diff(rows.i) >= 0)
    assert rows.samples.sum() == len(clean)


def test_magnetometer_rows_average_what_belongs_to_a_keyframe(world):
    simulation, frame, zero_s = world
    clean, declination = (
        simulation.clean["magnetometer"],
        np.radians(simulation.drawn["magnetometer"]["declination_deg"]),
    )
    sensor = Magnetometer(topic="/mag", sigma_deg=2.0, clock_offset_s=0.03)
    t_s = (clean.t_ns - frame.steps.t0_ns) * 1e-9 + 0.03
    keyframes = np.linspace(frame.steps.edges_s[0], frame.steps.end_s, 81)  # every 250 ms: five samples each
    rows = measure.magnetometer_rows(
        sensor, Samples("magnetometer", t_s, clean["field"]), keyframes, frame, np.radians(30.0), slice(0, 4)
    )
    x = states(simulation, keyframes + zero_s, np.zeros(3))
    residual, *_ = rows.evaluate(x, np.array([declination, 0.0, 0.0, 0.0]))
    residual = residual * rows.sigma
    # the Earth turns within an eighth of a second; the rate is held within a sample
    assert np.abs(residual).max() < 3 * (earth.RATE * 0.125 + 3.0 * 0.005**2 / 8 * 5)
    assert rows.samples.sum() == len(clean)
    assert_allclose(rows.sigma[:, 0], np.radians(2.0) / np.sqrt(rows.samples))
    assert rows.samples[3] == 5


def test_magnetometer_mounting_and_hard_iron():
    simulation = flight(duration=10.0)
    frame = frame_of(simulation.clean["imu"], np.zeros(3))
    field = simulation.clean["magnetometer"]["field"]
    t_s = (simulation.clean["magnetometer"].t_ns - frame.steps.t0_ns) * 1e-9
    keyframes = np.linspace(0, 9.9, 40)
    plain = Magnetometer(topic="/mag")
    mounted = Magnetometer(topic="/mag", hard_iron_ut=(5.0, -3.0, 8.0), rpy_deg=(10.0, 20.0, -50.0))
    as_measured = field @ mounted.R_bm + 1e-6 * np.array([5.0, -3.0, 8.0])
    one = measure.magnetometer_rows(plain, Samples("m", t_s, field), keyframes, frame, 0.5, slice(0, 1))
    two = measure.magnetometer_rows(mounted, Samples("m", t_s, as_measured), keyframes, frame, 0.5, slice(0, 1))
    assert_allclose(two.z, one.z, atol=1e-18)
    # left in the readings and given as a calibration it comes to the same, however the body turns between keyframes
    unknown = mounted.model_copy(update={"hard_iron_ut": (0.0, 0.0, 0.0), "hard_iron_sd_ut": 5.0})
    three = measure.magnetometer_rows(unknown, Samples("m", t_s, as_measured), keyframes, frame, 0.5, slice(0, 4))
    own = three.data[:, 1:10].reshape(-1, 3, 3) @ [5.0, -3.0, 8.0]
    assert_allclose(three.z - own, one.z, atol=1e-18)
    # what does not turn with the body is the Earth's: 50 microtesla that dip by 65 degrees
    R_start = simulation.truth(np.array([0.0])).R[0]
    H, sd = measure.horizontal_field(unknown, Samples("m", t_s, as_measured), frame, R_start, 0.0)
    assert_allclose(H, 50e-6 * np.cos(np.radians(65.0)), atol=3 * sd)
    assert sd < 0.1 * 5e-6
    _, doubted = measure.horizontal_field(unknown, Samples("m", t_s, as_measured), frame, R_start, 0.01)
    assert_allclose(doubted**2 - sd**2, (0.01 * 50e-6 * np.sin(np.radians(65.0))) ** 2, rtol=0.05)


def test_barometer_rows_hold_at_truth(world):
    simulation, frame, zero_s = world
    t_s = np.arange(0.5, 19.5, 0.04)
    heights = simulation.truth(t_s + zero_s).position[:, 2] + 7.5
    sensor = Barometer(topic="/baro", sigma_m=0.2, clock_offset_s=-0.01)
    keyframes = np.linspace(frame.steps.edges_s[0], frame.steps.end_s, 201)
    origin_n = np.array([0.0, 0.0, 3.0])
    rows = measure.barometer_rows(
        sensor, Samples("barometer", t_s - 0.01, heights), keyframes, origin_n, 0, 1.5, slice(0, 2)
    )
    x = np.hstack([states(simulation, keyframes + zero_s, origin_n), np.full((201, 1), 7.5)])
    residual, *_ = rows.evaluate(x, np.zeros(2))
    # mean over a tenth of a second: the vertical acceleration is below 6 m/s^2
    assert np.abs(residual * rows.sigma).max() < 0.5 * 6.0 * 0.05**2
    assert rows.samples.sum() == len(t_s)


# ---- odometer ----


def odometer_rows(simulation, keyframes, stamps_ns=None, sensor=None, bias_gyro=None, samples=slice(None), speed=None):
    """Rows of the drive's odometer without noise, and the states at the keyframes."""
    bias_gyro = np.zeros(3) if bias_gyro is None else bias_gyro
    imu = simulation.clean["imu"]
    imu = imu_series(imu["gyro"] + bias_gyro, imu["acc"], t_ns=imu.t_ns)
    frame = frame_of(imu, bias_gyro)
    clean = simulation.clean["odometer"]
    sensor = sensor or simulation.rig.sensors["odometer"]
    t_ns = (clean.t_ns if stamps_ns is None else stamps_ns)[samples]
    speed = (clean["linear"][:, 0] if speed is None else speed)[samples]
    t_s = (t_ns - frame.steps.t0_ns) * 1e-9
    rows = measure.odometer_rows(sensor, Samples("odometer", t_s, speed), keyframes, frame, slice(0, 3))
    x = states(simulation, keyframes + (frame.steps.t0_ns - simulation.start_ns) * 1e-9, np.zeros(3))
    x[:, 18:21] = bias_gyro
    return rows, x


KEYFRAMES = np.arange(0.0, 29.6, 0.2) - 0.005  # the first IMU period begins before its stamp: on the odometer's edges


def test_odometer_rows_hold_at_truth():
    simulation = drive(slide=0.0)
    rows, x = odometer_rows(simulation, KEYFRAMES)
    assert_array_equal(rows.i, np.arange(len(KEYFRAMES) - 1))
    assert_array_equal(rows.j, rows.i + 1)
    residual, *_ = rows.evaluate(x, np.zeros(3))
    # keyframes lie on edges of the odometer: nothing but turning within its samples of 50 ms (see the agreement
    # test), and the Earth's turn, which the gyro takes along: within 0.2 s at 0.11 m/s
    assert np.abs(residual * rows.sigma).max() < 4 * 0.06 * 0.12 * 0.05**3 / 12 + earth.RATE * 0.2 * 0.022 + 1e-7
    assert_array_equal(rows.samples, 4)
    assert_allclose(rows.sigma[:, 0], 0.02 * np.sqrt(0.05 * 0.2), rtol=1e-9)
    assert np.abs(rows.z[:, 0]).max() > 0.02


@pytest.mark.parametrize("jitter_s", [0.0, 1e-3, 5e-3])
def test_jitter_of_stamps_loses_no_interval(jitter_s):
    simulation = drive(slide=0.0)
    t_ns = simulation.clean["odometer"].t_ns
    jitter = np.random.default_rng(3).normal(0.0, jitter_s, len(t_ns))
    jitter = np.clip(jitter, -0.012, 0.012)  # two of them make a quarter of a period: no lost sample
    rows, x = odometer_rows(simulation, KEYFRAMES[1:-1], t_ns + np.round(1e9 * jitter).astype(np.int64))
    assert len(rows) == len(KEYFRAMES) - 3
    residual, *_ = rows.evaluate(x, np.zeros(3))
    # a speed held too long or too short: its change from sample to sample, 0.12 m/s^2 over 50 ms, times the jitter
    assert np.abs(residual * rows.sigma).max() < 1e-6 + 2 * 0.12 * 0.05 * 0.024


def test_intervals_without_samples_are_left_out():
    simulation = drive(slide=0.0)
    count = len(simulation.clean["odometer"])
    keep = np.setdiff1d(np.arange(count), [*range(100, 140), 300])  # 5.05 to 7.05 s, and one sample at 15.05 s
    rows, x = odometer_rows(simulation, KEYFRAMES, samples=keep)
    lost = np.setdiff1d(np.arange(len(KEYFRAMES) - 1), rows.i)
    starts, ends = KEYFRAMES[lost], KEYFRAMES[lost + 1]
    assert starts[0] < 5.0 <= ends[0]
    assert np.sum(starts < 10) == 10, "2 s"
    assert np.sum(starts > 10) == 1
    residual, *_ = rows.evaluate(x, np.zeros(3))
    assert np.abs(residual * rows.sigma).max() < 2e-6
    assert rows.samples.sum() <= len(keep)


def test_odometer_scale_is_that_of_the_rows():
    simulation = drive(slide=0.0)
    speed = 1.03 * simulation.clean["odometer"]["linear"][:, 0]
    rows, x = odometer_rows(simulation, KEYFRAMES, speed=speed)
    moving = np.abs(rows.z[:, 0]) > 0.015
    residual, _, _, Jc = (part[moving] for part in rows.evaluate(x, np.zeros(3)))
    scale = np.linalg.lstsq(Jc[:, :, 0].reshape(-1, 1), -residual.reshape(-1))[0][0]
    # the speed it is judged on is a mean over four seconds of ramps and turns
    assert scale == pytest.approx(0.03, rel=0.1)


def test_odometer_rows_of_a_biased_gyro_turn_with_its_later_estimate():
    """D is added up with a bias that is wrong; at the true one the residual is of second order."""
    simulation, error = drive(slide=0.0), np.array([1e-3, -2e-3, 3e-3])
    plain, x = odometer_rows(simulation, KEYFRAMES)
    biased, _ = odometer_rows(simulation, KEYFRAMES, bias_gyro=error)
    assert_allclose(biased.z, plain.z, atol=1e-12)  # it is removed
    assert_allclose(biased.data[:, 6:9], np.tile(error, (len(biased), 1)))
    x[:, 18:21] = error
    residual, *_ = biased.evaluate(x, np.zeros(3))
    assert np.abs(residual * biased.sigma).max() < 2e-6


def test_odometer_that_points_elsewhere():
    """A wheel turned by its mounting reads the same along its own axis: the way is given in the wheel's axes."""
    simulation = drive(slide=0.0)
    sensor = Odometer(topic="/odometer", yaw_deg=30.0, pitch_deg=-10.0)
    rows, _ = odometer_rows(simulation, KEYFRAMES, sensor=sensor)
    plain, _ = odometer_rows(simulation, KEYFRAMES, sensor=Odometer(topic="/odometer"))
    assert_allclose(np.linalg.norm(rows.z, axis=1), np.linalg.norm(plain.z, axis=1), rtol=1e-3, atol=1e-9)
    # in its own axes the way is forward, but for what the machine turns in 0.2 s
    assert np.abs(rows.z[:, 1:]).max() < 0.06 * 0.2 * 0.022


def test_speeds_in_bursts_cover_all_the_time():
    """83 Hz on a bus: pairs 2 ms apart, then 22 ms; none is lost, so the ways add up."""
    ends = np.sort(np.concatenate([np.arange(0.024, 6.0, 0.024), np.arange(0.026, 6.0, 0.024)]))
    start, end, _ = measure.periods(Odometer(topic="/o"), Samples("odometer", ends, np.ones(len(ends))))
    assert_allclose(start[1:], end[:-1])
    lost = np.delete(ends, slice(100, 120))  # 0.24 s
    start, end, period = measure.periods(Odometer(topic="/o"), Samples("odometer", lost, np.ones(len(lost))))
    assert end[100] - start[100] == pytest.approx(period)


# ---- standing and bounds ----


def test_zero_velocity_inside_still_intervals_only():
    keyframes = np.arange(0.0, 10.0, 0.5)
    rows = measure.velocity_rows(keyframes, [(0.9, 2.6), (7.0, 8.0)], np.array([0.01, 0.02, 0.03]))
    assert_allclose(keyframes[rows.i], [1.0, 1.5, 2.0, 2.5, 7.0, 7.5, 8.0])
    assert_allclose(rows.sigma[0], [0.01, 0.02, 0.03])
    assert not rows.z.any()
    assert len(measure.velocity_rows(keyframes, [(0.1, 0.2)], np.ones(3))) == 0


def test_zero_rotation_between_keyframes_of_one_stretch():
    keyframes = np.arange(0.0, 10.0, 0.5)
    rows = measure.rotation_rows(keyframes, [(0.9, 2.1), (2.4, 2.6), (7.0, 8.0)], walk=0.01, shaking=0.003)
    assert_allclose(keyframes[rows.i], [1.0, 1.5, 7.0, 7.5])
    assert_array_equal(rows.j, rows.i + 1)
    assert_allclose(rows.sigma, np.sqrt(0.01**2 * 0.5 + 2 * 0.003**2))


def test_bound_at_every_keyframe():
    rows = measure.bounded_rows(np.arange(4.0), np.array([1.0, 2.0, 3.0]), 0.5, 2.0)
    assert_allclose(rows.z[3], [1, 2, 3, 0, 0, 0])
    assert_allclose(rows.sigma[3], [0.5, 0.5, 0.5, 2, 2, 2])
    assert_array_equal(rows.i, np.arange(4))


def test_a_bound_weighs_the_same_at_any_rate_of_keyframes():
    """Over a second, ten times the keyframes tell no more about where a body dwells that crosses its volume in 2 s."""
    information = []
    for rate in (1.0, 10.0, 100.0):
        rows = measure.bounded_rows(np.arange(0.0, 20.0, 1.0 / rate), np.zeros(3), 0.5, 0.25)
        information.append(np.sum(rows.sigma[:, 0] ** -2.0))
    # a first-order Gauss-Markov process of sd 0.5 m and time 2 s has at low frequency the density 2 x 0.5^2 x 2
    assert_allclose(information, 20.0 / (2 * 0.5**2 * 2), rtol=1e-9)


def test_what_disturbs_a_compass_does_not_average_away():
    simulation = flight(duration=10.0)
    frame = frame_of(simulation.clean["imu"], np.zeros(3))
    field = simulation.clean["magnetometer"]
    t_s = (field.t_ns - frame.steps.t0_ns) * 1e-9
    sensor = Magnetometer(topic="/mag", sigma_deg=2.0, disturbance_deg=3.0, disturbance_s=1.0)
    for interval in (0.05, 0.25):
        keyframes = np.arange(0.0, 9.9, interval)
        rows = measure.magnetometer_rows(sensor, Samples("m", t_s, field["field"]), keyframes, frame, 0.5, slice(0, 1))
        expected = np.radians(np.sqrt(2.0**2 / rows.samples + 3.0**2 * 2.0 / interval))
        assert_allclose(rows.sigma[:, 0], expected, rtol=1e-9)


def test_running_mean_is_centred_and_fair_at_the_ends():
    ramp = np.arange(20.0)
    assert_allclose(measure._running_mean(ramp, 5)[2:-2], ramp[2:-2])
    assert_allclose(measure._running_mean(np.ones(20), 7), 1.0)
    assert_allclose(measure._running_mean(ramp[:3], 50), [0.5, 1.0, 1.5])
