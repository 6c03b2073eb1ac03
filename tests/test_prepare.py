"""From a log and a rig to the problem: heading, clock offset, noise, rest, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from datasets import sensors
from datasets.simulate import simulate
from tbmfg.errors import EstimationError, LogError, RigError
from tbmfg.estimators import estimate
from tbmfg.geometry import log_so3
from tbmfg.inertial.alignment import still_intervals
from tbmfg.inertial.steps import make_steps
from tbmfg.prepare import prepare, rest
from tbmfg.rig import override, parse_rig
from tbmfg.timeseries import NS
from tests.problems import (
    FLIGHT_RIG,
    drive,
    flight,
    flight_path,
    imu_series,
    log_of,
    state_errors,
    true_rig,
    true_states,
)


def prepared(simulation, *settings, **options):
    """The problem of a simulated log under changed settings of its rig."""
    return prepare(log_of(simulation.log_series), override(simulation.rig, settings), **options)


def start_error(simulation, problem):
    """Attitude of the prior's first state less the truth, about n's axes [rad]."""
    R, R_true = problem.prior.x[:9].reshape(3, 3), true_states(simulation, problem)[0, :9].reshape(3, 3)
    return log_so3(R @ R_true.T)


def yaw_sd(problem, cov):
    R = problem.prior.x[:9].reshape(3, 3)
    return float(np.sqrt((R @ cov[:3, :3] @ R.T)[2, 2]))


def rows_of(problem, sensor):
    return next(rows for rows in problem.rows if rows.sensor == sensor)


UNKNOWN_HEADING = ("initial.yaw_deg=null", "initial.yaw_sd_deg=180", "initial.roll_deg=null", "initial.pitch_deg=null")


# ---- the first state ----


def test_what_the_rig_gives_is_the_prior():
    simulation = flight(0, 10.0)
    problem = prepared(simulation)
    rig, x = simulation.rig, problem.prior.x
    assert np.abs(start_error(simulation, problem)).max() < np.radians(4 * 2.0)
    assert_allclose(x[9:12] + problem.origin_n, rig.initial.position)
    assert_allclose(x[12:15], rig.initial.velocity)
    sd = np.sqrt(np.diag(problem.prior.cov))
    assert_allclose(sd[3:], np.repeat([0.05, 0.05, rig.imu.acc_bias_sd, rig.imu.gyro_bias_sd], 3))
    assert yaw_sd(problem, problem.prior.cov) == pytest.approx(np.radians(2.0))
    assert_array_equal(problem.prior.cov, problem.prior.filter_cov)
    # sds are about n's axes: tilt and yaw do not mix there
    R = x[:9].reshape(3, 3)
    assert_allclose(R @ problem.prior.cov[:3, :3] @ R.T, np.diag(np.radians([1.0, 1.0, 2.0]) ** 2), atol=1e-18)


def test_heading_by_the_magnetometer():
    simulation = flight(1, 20.0)
    problem = prepared(simulation, *UNKNOWN_HEADING)
    error = start_error(simulation, problem)
    # declination of 1 deg, 2 deg of noise over 200 samples; levelling with 3 mg of bias
    assert abs(error[2]) < np.radians(4 * 1.1)
    assert np.linalg.norm(error[:2]) < 4 * 0.03 / 9.8 + 1e-3
    assert yaw_sd(problem, problem.prior.filter_cov) <= np.radians(10.0)
    assert yaw_sd(problem, problem.prior.cov) == pytest.approx(np.pi), "the graph does not take the guess for knowledge"


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_heading_by_the_motion_of_the_prism(seed):
    simulation = flight(seed, 40.0)
    problem = prepared(simulation, *UNKNOWN_HEADING, without=("magnetometer",))
    found = abs(start_error(simulation, problem)[2])
    assert found < 3 * yaw_sd(problem, problem.prior.filter_cov)
    assert yaw_sd(problem, problem.prior.filter_cov) < np.radians(25.0)
    result = estimate("batch", problem)
    truth = true_states(simulation, problem)
    error = log_so3(result.trajectory.rotations() @ np.swapaxes(truth[:, :9].reshape(-1, 3, 3), 1, 2))
    assert np.abs(error[:, 2]).max() < np.radians(0.5)


def test_without_a_given_position_the_first_fixes_give_it():
    simulation = flight(0, 10.0)
    problem = prepared(simulation, "initial.position_m=null", "initial.velocity_mps=null")
    error = problem.prior.x[9:15] - true_states(simulation, problem)[0, 9:15]
    # standing: two seconds of fixes, an arm of 0.6 m that is turned by 2 degrees and wrong by 2 cm
    assert np.linalg.norm(error[:3]) < 0.6 * np.radians(4 * 2.5) + 4 * 0.03
    assert np.linalg.norm(error[3:]) < 0.02
    assert np.sqrt(problem.prior.cov[3, 3]) >= 10.0, "the prior does not compete with the fixes it was made from"


def test_nothing_moves_on_the_same_input():
    simulation = flight(0, 10.0)
    one, two = (prepared(simulation) for _ in range(2))
    assert_array_equal(one.prior.x, two.prior.x)
    assert_array_equal(one.t_ns, two.t_ns)
    assert one.clocks == two.clocks
    for a, b in zip(one.rows, two.rows, strict=True):
        assert_array_equal(a.z, b.z)
    assert one.counts == two.counts


# ---- mounting and stamps of the IMU ----


def test_stamps_of_the_imu_mean_what_the_rig_says():
    """At a metre per second a period of 5 ms shows: the clock offset is not estimated here."""

    def error(stamp, told):
        settings = (f"sensors.imu.stamp={stamp}", "sensors.prism.clock_offset_sd_s=0")
        simulation = flight(1, 15.0, settings)
        problem = prepare(log_of(simulation.log_series), true_rig_at(simulation, (f"sensors.imu.stamp={told}",)))
        found = estimate("batch", problem).trajectory.position_n
        truth = simulation.truth((problem.t_ns - simulation.start_ns) * 1e-9)
        return found - truth.position

    # the same periods hold the same samples: keyframes, at their edges, may differ by a rounding of stamps
    sizes = [np.sqrt(np.mean(error(stamp, stamp) ** 2)) for stamp in ("start", "centre", "end")]
    assert_allclose(sizes, sizes[0], rtol=0.02)
    assert np.sqrt(np.mean(error("start", "end") ** 2)) > 1.1 * sizes[0]


def true_rig_at(simulation, settings):
    offset = simulation.drawn["prism"]["clock_offset_s"]
    return override(true_rig(simulation), (*settings, f"sensors.prism.clock_offset_s={offset}"))


def test_an_imu_on_its_side_makes_the_same_problem():
    upright = flight(1, 10.0)
    turned = flight(1, 10.0, ("sensors.imu.T_bi.rpy_deg=[90, -20, 70]",))
    assert np.abs(upright.log_series[0]["acc"] - turned.log_series[0]["acc"]).max() > 1
    one, two = prepared(upright), prepared(turned)
    assert_allclose(two.inertial.gyro, one.inertial.gyro, atol=1e-12)
    assert_allclose(two.prior.x, one.prior.x, atol=1e-9)


# ---- clock offset and noise ----


@pytest.mark.parametrize(("seed", "offset_s"), [(1, 0.15), (2, -0.22), (3, 0.0)])
def test_clock_offset_is_found_over_its_prior(seed, offset_s):
    simulation = flight(seed, 30.0)
    shifted = [
        replace(s, t_ns=s.t_ns + round(offset_s * NS)) if s.topic == "/prism" else s for s in simulation.log_series
    ]
    rig = override(simulation.rig, ["sensors.prism.clock_offset_s=0", "sensors.prism.clock_offset_sd_s=0.1"])
    problem = prepare(log_of(shifted), rig)
    true = simulation.drawn["prism"]["clock_offset_s"] + offset_s
    found = problem.calibration["prism_clock_offset_s"]
    assert found.estimated
    assert found.value == pytest.approx(true, abs=5 * found.sd + 2e-4)
    assert found.sd < 1e-3
    # keyframes lie where the fixes were taken: half an IMU period
    lag = rows_of(problem, "prism").data[:, 0]
    assert np.median(np.abs(lag)) < 0.0026


def test_a_clock_far_off_but_known():
    """Stamps of another clock, ten seconds late; the heading comes from the motion."""
    simulation = flight(2, 40.0)
    shifted = [replace(s, t_ns=s.t_ns + 10 * NS) if s.topic == "/prism" else s for s in simulation.log_series]
    rig = override(simulation.rig, [*UNKNOWN_HEADING, "sensors.prism.clock_offset_s=10.01"])
    problem = prepare(log_of(shifted), rig, without=("magnetometer",))
    assert not any("heading is not observable" in line for line in problem.warnings)
    found = problem.calibration["prism_clock_offset_s"]
    assert found.value == pytest.approx(10 + simulation.drawn["prism"]["clock_offset_s"], abs=5 * found.sd + 2e-4)


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_noise_factor_is_found(factor):
    simulation = flight(1, 40.0, (f"sensors.imu.noise_factor={factor}",))
    problem = prepared(simulation, "sensors.imu.noise_factor=auto")
    found = problem.calibration["noise_factor"]
    assert found.estimated
    # the quietest of 16 bands is a little below the mean, and never below the data sheet
    assert found.value == pytest.approx(factor, rel=0.25)
    assert problem.inertial.white_acc == pytest.approx(
        (problem.calibration["noise_factor_acc"].value * problem.rig.imu.acc_density) ** 2
    )


def test_noise_of_gyro_and_accelerometer_apart():
    simulation = flight(1, 40.0, ("sensors.imu.acc_density_ug_rthz=1000",))
    problem = prepared(simulation, "sensors.imu.acc_density_ug_rthz=100", "sensors.imu.noise_factor=auto")
    gyro, acc = (problem.calibration[f"noise_factor_{what}"].value for what in ("gyro", "acc"))
    assert gyro == pytest.approx(1.0, rel=0.35)
    assert acc == pytest.approx(10.0, rel=0.35)


def test_a_given_noise_factor_is_taken():
    problem = prepared(flight(0, 10.0), "sensors.imu.noise_factor=3")
    assert problem.calibration["noise_factor"].value == pytest.approx(3.0)
    assert not problem.calibration["noise_factor"].estimated
    assert problem.inertial.white_gyro == pytest.approx((3 * problem.rig.imu.gyro_density) ** 2)


# ---- standing ----


def test_zero_velocity_only_where_the_machine_stands():
    simulation = drive(4, 60.0)
    problem = prepared(simulation)
    still = rows_of(problem, "zero_velocity")
    velocity = true_states(simulation, problem)[:, 12:15]
    # rest is judged over a second: the first moments of a move pass for it, within three of the rig's 5 mm/s
    assert np.linalg.norm(velocity[still.i], axis=1).max() < 0.015
    assert np.mean(problem.keyframes_s[still.i] < 7.4) > 0
    standing = problem.keyframes_s < 6.5
    assert np.isin(np.flatnonzero(standing), still.i).mean() > 0.8
    assert any(interval.kind == "standing" for interval in problem.intervals)


def test_constant_speed_is_not_taken_for_rest():
    """On an air bearing: the IMU feels nothing, the prism sees the way."""
    simulation = flight(0, 12.0, stand_s=40.0)  # it stands throughout
    moving = []
    for series in simulation.log_series:
        if series.topic == "/prism":
            t = (series.t_ns - series.t_ns[0]) * 1e-9
            series = replace(series, columns={"point": series["point"] + t[:, None] * [0.1, 0.0, 0.0]})
        moving.append(series)
    assert not any(rows.sensor == "zero_velocity" for rows in prepare(log_of(moving), simulation.rig).rows)
    assert any(rows.sensor == "zero_velocity" for rows in prepared(simulation).rows)


def test_steady_turn_is_no_rest():
    """A platform that turns at a steady rate looks still to its IMU, and a prism on its axis does not move."""
    rate = np.zeros((6000, 3))
    rate[2000:3000, 2] = 0.02  # 5 s at 1.1 deg/s, between two rests at 200 Hz
    gyro = rate + np.array([0.01, -0.02, 0.005]) + 1e-4 * np.random.default_rng(0).standard_normal(rate.shape)
    steps = make_steps(imu_series(gyro, np.tile([0.0, 0.0, 9.81], (6000, 1))), np.eye(3), "end")
    still = still_intervals(steps)
    kept = rest._unturning(steps, still)
    assert any(a < 12.0 < b for a, b in still)
    assert kept == [s for s in still if not s[0] < 12.0 < s[1]]
    assert len(kept) >= 2


def test_zero_velocity_may_be_turned_off():
    problem = prepared(drive(4, 20.0), "zero_velocity.enabled=false")
    assert not any(rows.sensor == "zero_velocity" for rows in problem.rows)


# ---- outages, gaps, and the choice of sensors ----


def test_outages_and_gaps_are_intervals_and_filled_with_keyframes():
    simulation = flight(1, 20.0)
    problem = prepared(simulation, outages=(("prism", 8.0, 12.0), ("imu", 15.0, 15.2)))
    kinds = {(interval.sensor, interval.kind) for interval in problem.intervals}
    assert {("prism", "outage"), ("imu", "outage"), ("imu", "gap")} <= kinds
    assert np.diff(problem.keyframes_s).max() <= 0.5 + 0.006
    t = problem.keyframes_s[rows_of(problem, "prism").j]
    assert not ((t > 8.1) & (t < 11.9)).any()
    extra = problem.inertial.steps.extra_acc > 0
    assert extra.sum() == 40
    assert problem.counts["imu"].outage == 40
    assert_array_equal(problem.inertial.psd_acc[~extra], problem.inertial.white_acc)


def test_two_prisms():
    """A second one on the tail, with an arm and a clock of its own."""
    second = "  prism-tail: {topic: /tail, arm_m: [-1.0, 0.1, 0.4], arm_sd_m: 0.02, clock_offset_sd_s: 0.01}\n"
    rig = parse_rig(FLIGHT_RIG + second, "flight")
    kinds = {
        "imu": lambda *a: sensors.imu(*a, rate_hz=200.0),
        "prism": lambda *a: sensors.prism(*a, rate_hz=5.0),
        "magnetometer": lambda *a: sensors.magnetometer(*a, rate_hz=10.0),
    }
    simulation = simulate("two", flight_path(4.0, 20.0), rig, kinds, seed=3, duration_s=20.0, truth_rate_hz=50.0)
    problem = prepare(log_of(simulation.log_series), simulation.rig)
    result = estimate("batch", problem)
    for name in ("prism", "prism-tail"):
        arm, offset = (result.calibration[f"{name}_{what}"] for what in ("lever_arm_m", "clock_offset_s"))
        z = (np.array(arm.value) - simulation.drawn[name]["arm_m"]) / np.array(arm.sd)
        assert np.abs(z).max() < 4.5
        assert abs(offset.value - simulation.drawn[name]["clock_offset_s"]) < 4.5 * offset.sd + 2e-4
        assert result.counts[name].used > 90
    path = result.trajectory
    x = np.hstack([path.rotations().reshape(-1, 9), path.position_n - problem.origin_n, path.velocity_n,
                   path.bias_acc, path.bias_gyro])  # fmt: skip
    error = state_errors(x, true_states(simulation, problem))
    sd = np.sqrt(np.diagonal(path.cov, axis1=1, axis2=2))
    assert np.abs(error / sd).max() < 5


def test_a_motion_bound_alone_is_enough():
    simulation = flight(0, 10.0)
    motion = ("motion.radius_m=5", "motion.speed_mps=4")
    problem = prepared(simulation, *motion, without=("prism", "magnetometer"))
    assert {rows.sensor for rows in problem.rows} == {"motion"}
    result = estimate("batch", problem)
    assert np.isfinite(result.trajectory.position_n).all()


# ---- refused in one line ----


def test_names_that_the_rig_does_not_have_are_refused():
    simulation = flight(0, 10.0)
    for options in ({"outages": (("gnss", 1.0, 2.0),)}, {"without": ("gnss",)}):
        with pytest.raises(RigError, match=r"no sensor 'gnss'.*imu, prism, magnetometer"):
            prepared(simulation, **options)


def test_a_log_without_its_imu_is_refused():
    simulation = flight(0, 10.0)
    with pytest.raises(LogError, match=r"/imu"):
        prepare(log_of(simulation.log_series[1:]), simulation.rig)


def test_nothing_but_the_imu_is_refused():
    with pytest.raises(EstimationError, match="nothing but the IMU"):
        prepared(flight(0, 10.0), without=("prism", "magnetometer"))


def test_an_imu_away_from_its_own_origin_is_refused():
    simulation = flight(0, 10.0)
    with pytest.raises(RigError, match=r"T_bi\.xyz_m"):
        prepared(simulation, "sensors.imu.T_bi.xyz_m=[0.1, 0, 0]")


def test_a_keyframe_lies_at_every_surveyed_point():
    simulation = flight(0, 6.0)
    points = ("at: end, position_m: [3, 2, 1]", "at: start, position_m: [1, 2, 3]", "at: 2.22, position_m: [2, 2, 2]")
    survey = f"survey=[{', '.join(f'{{{point}, sigma_m: 0.01}}' for point in points)}]"
    problem = prepared(simulation, survey)
    rows = next(rows for rows in problem.rows if rows.sensor == "survey")
    half_a_sample = 0.5 * problem.inertial.steps.period_s
    assert_allclose(problem.keyframes_s[rows.i], [0.0, 2.22, problem.keyframes_s[-1]], atol=half_a_sample + 0.005)
    assert_allclose(rows.z + problem.origin_n, [[1, 2, 3], [2, 2, 2], [3, 2, 1]])
    with pytest.raises(RigError, match=r"survey\.0\.at: 7 s is outside the log"):
        prepared(simulation, "survey=[{at: 7, position_m: [0, 0, 0], sigma_m: 1}]")
