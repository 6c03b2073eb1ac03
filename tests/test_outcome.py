"""What a result says: counts that add up whatever happened to the samples, and calibrations by their names."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tbmfg.estimators import estimate
from tbmfg.mcap import read_log, write_log
from tbmfg.outcome import calibrations, trajectory
from tbmfg.prepare import prepare
from tbmfg.rig import override
from tbmfg.timeseries import NS, Series
from tests.problems import drive, flight, flight_problem, log_of

PARTS = ("used", "gated", "late", "duplicate", "nonfinite", "outage", "unused")


def assert_counted(result, log, rig):
    """Every message of every sensor of the rig that the log has is in exactly one part."""
    present = {name for name, sensor in rig.sensors.items() if sensor.topic in log.series}
    assert set(result.counts) == present
    for name, count in result.counts.items():
        parts = {part: getattr(count, part) for part in PARTS}
        assert sum(parts.values()) == count.received == log.series[rig.sensors[name].topic].counts.received, name
        assert min(parts.values()) >= 0, f"{name}: {parts}"


@cache
def short_drive():
    return drive(5, 12.0, imu_rate_hz=100.0)


def damaged(series: Series, rng) -> Series:
    """The series with values that are NaN, stamps that repeat, and messages that are missing."""
    n = len(series)
    columns = {name: values.copy() for name, values in series.columns.items()}
    broken, repeated, missing = np.array_split(rng.permutation(np.arange(2, n))[: max(3, n // 20)], 3)
    for values in columns.values():
        values[broken] = np.nan
    t_ns = series.t_ns.copy()
    t_ns[repeated] = t_ns[repeated - 1]
    keep = np.setdiff1d(np.arange(n), missing)
    return replace(series, t_ns=t_ns, columns=columns).select(keep)


# ---- counts ----


@pytest.mark.parametrize("estimator", ["ins", "batch"])
def test_counts_add_up_after_damage_outages_and_outliers(tmp_path, estimator):
    """Through the file: what the reader leaves out is counted where the estimator leaves off."""
    simulation, rng = short_drive(), np.random.default_rng(0)
    rig = simulation.rig
    broken = [damaged(series, rng) for series in simulation.log_series if series.topic != rig.truth.topic]
    prism = next(k for k, series in enumerate(broken) if series.topic == "/prism/position")
    broken[prism]["point"][20] += [0.0, 2.0, 0.0]
    write_log(tmp_path / "log.mcap", broken)
    log = read_log(tmp_path / "log.mcap")
    outages = (("prism", 3.0, 4.0), ("odometer", 5.0, 6.5), ("magnetometer", 2.0, 2.5), ("imu", 8.0, 8.1))
    result = estimate(estimator, prepare(log, rig, outages=outages))
    assert_counted(result, log, rig)
    for name, start, end in outages:
        count = result.counts[name]
        rate_hz = {"imu": 100, "prism": 5, "odometer": 20, "magnetometer": 20}[name]
        assert count.outage == pytest.approx((end - start) * rate_hz, abs=0.1 * (end - start) * rate_hz + 1)
        assert count.nonfinite > 0
        assert count.duplicate > 0
        assert count.used > 0.5 * count.received
    assert result.counts["prism"].gated >= 1
    assert np.isfinite(result.trajectory.position_n).all()


@settings(max_examples=15, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(["prism", "odometer", "magnetometer"]), st.floats(-1, 12), st.floats(0.01, 9)),
        max_size=4,
    ),
    st.sets(st.sampled_from(["odometer", "magnetometer"])),
)
def test_counts_add_up_for_any_outages_and_sensors_left_aside(drawn, without):
    simulation = short_drive()
    log = log_of(simulation.log_series)
    outages = tuple((name, start, start + length) for name, start, length in drawn)
    # somebody has to see the position
    outages = tuple(o for o in outages if o[0] != "prism" or o[2] - o[1] < 4)
    result = estimate("ins", prepare(log, simulation.rig, outages=outages, without=tuple(without)))
    assert_counted(result, log, simulation.rig)
    for name in without:
        count = result.counts[name]
        assert (count.used, count.unused) == (0, count.received)


def test_samples_outside_the_imu_are_unused():
    simulation = short_drive()
    log = log_of(simulation.log_series)
    prism = log.series["/prism/position"]
    early = np.arange(prism.t_ns[0] - 3 * NS, prism.t_ns[0] - NS, NS // 5)
    t_ns = np.concatenate([early, prism.t_ns])
    point = np.vstack([np.tile(prism["point"][0], (len(early), 1)), prism["point"]])
    counts = replace(prism.counts, received=len(t_ns))
    log.series["/prism/position"] = replace(prism, t_ns=t_ns, columns={"point": point}, counts=counts)
    result = estimate("ins", prepare(log, simulation.rig))
    assert_counted(result, log, simulation.rig)
    assert result.counts["prism"].unused >= len(early)


def test_a_sensor_without_enough_samples_is_said_and_unused():
    simulation = short_drive()
    log = log_of(simulation.log_series)
    problem = prepare(log, simulation.rig, outages=(("odometer", -9.0, 99.0),))
    assert any(line.startswith("odometer: 0 of") for line in problem.warnings)
    result = estimate("ins", problem)
    assert_counted(result, log, simulation.rig)
    assert result.counts["odometer"].outage == result.counts["odometer"].received
    assert "odometer_scale" not in result.calibration


def test_estimating_twice_counts_once():
    problem = flight_problem(0, 8.0)
    first, second = estimate("ins", problem), estimate("ins", problem)
    assert first.counts == second.counts
    assert all(count.used == 0 for count in problem.counts.values() if count is not problem.counts["imu"])


# ---- calibrations ----


def test_calibrations_have_their_names_and_units():
    simulation = drive(5, 12.0, ("sensors.prism.clock_offset_sd_s=0.01", "sensors.magnetometer.declination_deg=2"))
    rig = override(simulation.rig, ["sensors.odometer.mounting_sd_deg=0.5"])
    problem = prepare(log_of(simulation.log_series), rig)
    result = estimate("batch", problem)
    found = result.calibration
    assert set(found) == {
        "prism_lever_arm_m", "prism_clock_offset_s", "prism_clock_drift_ppm", "odometer_scale",
        "odometer_mounting_yaw_pitch_deg", "magnetometer_declination_deg", "magnetometer_hard_iron_ut",
        "noise_factor", "noise_factor_gyro", "noise_factor_acc",
    }  # fmt: skip
    estimated = {name for name, value in found.items() if value.estimated}
    assert estimated == {
        "prism_lever_arm_m", "prism_clock_offset_s", "odometer_scale", "odometer_mounting_yaw_pitch_deg",
    }  # fmt: skip
    for name in estimated:
        assert np.all(np.array(found[name].sd) > 0), name
        assert np.shape(found[name].observed) == np.shape(found[name].sd), name
    assert found["magnetometer_declination_deg"].observed is None
    assert found["magnetometer_declination_deg"].value == pytest.approx(2.0)
    assert found["magnetometer_declination_deg"].sd == 0
    assert found["noise_factor"].value == pytest.approx(1.0)
    arm = found["prism_lever_arm_m"]
    assert len(arm.value) == len(arm.sd) == 3
    assert_allclose(arm.value, simulation.drawn["prism"]["arm_m"], atol=5 * max(arm.sd))


@pytest.mark.parametrize("estimator", ["ins", "batch"])
def test_clock_offset_is_the_whole_one_with_its_sd(estimator):
    """Not the excess over the one that the keyframes were placed with."""
    simulation = flight(2, 20.0)
    result = estimate(estimator, prepare(log_of(simulation.log_series), simulation.rig))
    offset = result.calibration["prism_clock_offset_s"]
    assert offset.estimated
    assert 0 < offset.sd < 2e-3
    assert offset.observed
    assert offset.value == pytest.approx(simulation.drawn["prism"]["clock_offset_s"], abs=5 * offset.sd)
    assert abs(simulation.drawn["prism"]["clock_offset_s"]) > 5 * offset.sd, "not zero"


def test_calibrations_in_degrees():
    problem = flight_problem(0, 8.0)
    names = problem.parameters.names
    c, sd = problem.parameters.mean.copy(), problem.parameters.sd.copy()
    k = names.index("magnetometer.declination")
    c[k], sd[k] = 0.1, 0.02
    declination = calibrations(problem, c, sd)["magnetometer_declination_deg"]
    assert (declination.value, declination.sd) == pytest.approx((np.degrees(0.1), np.degrees(0.02)))


def test_hard_iron_is_the_whole_one_in_microtesla():
    known = ("sensors.magnetometer.hard_iron_ut=[5,-3,8]", "sensors.magnetometer.hard_iron_sd_ut=2")
    problem = flight_problem(0, 8.0, known)
    first, last = (problem.parameters.names.index(f"magnetometer.iron_{axis}") for axis in "xz")
    c, sd = problem.parameters.mean.copy(), problem.parameters.sd.copy()
    c[first], sd[last] = 0.5, 0.1
    iron = calibrations(problem, c, sd)["magnetometer_hard_iron_ut"]
    assert (iron.value, iron.sd) == ((5.5, -3.0, 8.0), (2.0, 2.0, 0.1))


def test_what_the_log_did_not_say_is_said():
    """A machine that stands shows nothing of its prism's arm."""
    simulation = drive(1, 8.0, ("sensors.prism.arm_sd_m=0.3", "initial.position_sd_m=1"))
    standing = [series.select(series.t_ns < series.t_ns[0] + NS) for series in simulation.log_series]
    result = estimate("batch", prepare(log_of(standing), simulation.rig))
    assert any("prism.arm_x is not observable" in line for line in result.warnings)
    assert result.calibration["prism_lever_arm_m"].observed == (False, False, False)
    assert result.calibration["odometer_scale"].observed is False
    assert any("odometer.scale is not observable" in line for line in result.warnings)


# ---- trajectory ----


def test_trajectory_is_in_n_at_the_stamps_of_the_keyframes():
    problem = flight_problem(0, 8.0)
    n = len(problem.keyframe_edges)
    x = np.tile(problem.prior.x, (n, 1))
    cov = np.tile(problem.prior.cov, (n, 1, 1))
    path = trajectory(problem, x, cov)
    assert_allclose(path.position_n, x[:, 9:12] + problem.origin_n)
    assert_allclose(path.rotations().reshape(n, 9), x[:, :9], atol=1e-14)
    assert path.cov.shape == (n, 15, 15)
    edges = problem.inertial.steps.edges_s[problem.keyframe_edges]
    assert_allclose((path.t_ns - problem.t0_ns) * 1e-9, edges, atol=1e-9)


def test_vague_heading_is_said():
    simulation = flight(0, 20.0)
    rig = override(simulation.rig, ["initial.yaw_sd_deg=180", "initial.position_sd_m=10"])
    standing = [series.select(series.t_ns < series.t_ns[0] + 4 * NS) for series in simulation.log_series]
    result = estimate("batch", prepare(log_of(standing), rig, without=("magnetometer",)))
    assert any("heading is known to" in line for line in result.warnings)
    moving = estimate("batch", prepare(log_of(simulation.log_series), simulation.rig))
    assert not any("heading is known to" in line for line in moving.warnings)
