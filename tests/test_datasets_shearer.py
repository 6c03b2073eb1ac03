"""The simulated shearer: its way, what its sensors read at rest and on a straight, its noise, and its faults."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import datasets
from datasets import shearer
from datasets.__main__ import main
from tbmfg.errors import TbmfgError
from tbmfg.mcap import read_log
from tbmfg.rig import load_rig
from tests.test_datasets_sensors import assert_chi_square, log_of, seconds_of

HEADING = np.radians(124.5 + 90.0)  # counter-clockwise from east
AHEAD, LEFT = np.array([np.cos(HEADING), np.sin(HEADING)]), np.array([-np.sin(HEADING), np.cos(HEADING)])


@cache
def cut(name="shearer-cut", seed=5, duration=85.0, **options):
    return datasets.make(name, seed=seed, duration=duration, **options)


def along_and_aside(simulation, t_s):
    """Position from the start along the face's first direction and to its left, (n,) m each."""
    position = simulation.truth(t_s).position
    return position[:, :2] @ AHEAD, position[:, :2] @ LEFT, position[:, 2]


# ---- the way ----


def test_cut_is_straight_then_aside_then_straight():
    simulation = cut(slide=0.0)
    t_s = np.arange(0.0, 85.01, 0.05)
    along, aside, height = along_and_aside(simulation, t_s)
    assert_allclose(aside[along < 40.0], 0.0, atol=1e-6)
    assert_allclose(aside[along > 60.0], 10.0, atol=1e-6)
    assert_allclose(height, 0.0, atol=1e-9)
    assert aside[np.searchsorted(along, 50.0)] == pytest.approx(5.0, abs=0.1)  # half of the shift at half of the bend
    assert 79.0 < along[-1] < 81.0
    truth = simulation.truth(t_s)
    # west of south: the paper's yaw of 124.5 degrees counter-clockwise from north
    assert_allclose(AHEAD, [-np.sin(np.radians(124.5)), np.cos(np.radians(124.5))])
    assert_allclose(truth.R[along < 40.0][:, :2, 0], np.tile(AHEAD, ((along < 40.0).sum(), 1)), atol=1e-6)


def test_machine_points_along_its_way_at_one_metre_per_second():
    simulation = cut(slide=0.0)
    truth = simulation.truth(np.arange(0.0, 85.0, 0.31))
    velocity_b = np.einsum("nji,nj->ni", truth.R, truth.velocity)
    assert_allclose(velocity_b[:, 1:], 0.0, atol=1e-5)  # the spline through tenths of a second, in the bend
    assert_allclose(velocity_b[10:, 0], 1.0, atol=1e-5)
    assert_allclose(velocity_b[0], 0.0, atol=1e-5)


def test_panel_goes_there_and_back_and_advances():
    face, web = 30.0, 0.8
    simulation = cut("shearer-panel", duration=100.0, slide=0.0, face_m=face, web_m=web)
    # a bend of 0.8 m over 20 m is longer by its mean square slope / 2: (0.8 / 20)^2 x 700 / 429 / 2
    way = face + 20.0 * (web / 20.0) ** 2 * (700 / 429) / 2
    turns = (way + shearer.RAMP_S) * np.arange(4)
    along, aside, _ = along_and_aside(simulation, turns)
    assert_allclose(along, [0.0, face, 0.0, face], atol=1e-4)
    assert_allclose(aside, web * np.arange(4), atol=1e-4)
    moving = simulation.truth(np.arange(0.0, 100.0, 0.37))
    speed = np.einsum("nj,nj->n", moving.R[:, :, 0], moving.velocity)
    assert_allclose(np.abs(speed), np.linalg.norm(moving.velocity, axis=1), atol=1e-5)
    assert speed.min() == pytest.approx(-1.0, abs=1e-5)
    assert (moving.R[:, :2, 0] @ AHEAD > 0.99).all()  # it never turns round


def test_longer_log_begins_with_the_shorter_one():
    short, long = cut(duration=20.0), cut(duration=60.0)
    for one, other in zip(short.log_series, long.log_series, strict=True):
        if one.topic == "/truth/odometry":
            assert_allclose(other["position"][: len(one)], one["position"], atol=1e-9)
        else:
            for name, column in one.columns.items():
                assert_allclose(other[name][: len(one)], column, atol=1e-6)


def test_face_lies_on_the_earth_not_in_the_frame():
    turned = cut(duration=5.0, slide=0.0, settings=("origin.x_axis_azimuth_deg=25",))
    ahead = turned.truth(np.array([4.0])).velocity[0]
    east = ahead[0] * np.sin(np.radians(25)) - ahead[1] * np.cos(np.radians(25))
    north = ahead[0] * np.cos(np.radians(25)) + ahead[1] * np.sin(np.radians(25))
    assert_allclose([east, north], AHEAD, atol=1e-5)


def test_same_seed_same_log():
    first, again, other = (datasets.make("shearer-magfault", seed=seed, duration=12.0) for seed in (3, 3, 4))
    assert first.rig_text == again.rig_text != other.rig_text
    for one, two, three in zip(first.log_series, again.log_series, other.log_series, strict=True):
        assert all(np.array_equal(column, two[name]) for name, column in one.columns.items())
        assert any(not np.array_equal(column, three[name]) for name, column in one.columns.items())


def test_made_on_the_command_line(tmp_path, capsys):
    path = tmp_path / "fault.mcap"
    assert main(["make", "shearer-magfault", "-o", str(path), "--duration", "13", "--set", "fault=spikes"]) == 0
    assert "/odometer 130, /imu/mag 131" in capsys.readouterr().out
    read, simulated = read_log(path), cut("shearer-magfault", seed=0, duration=13.0, fault="spikes")
    assert_array_equal(read.series["/imu/mag"]["field"], log_of(simulated, "/imu/mag")["field"])
    assert len(simulated.drawn["magnetometer"]["spikes"]) > 0


# ---- sensors ----


def test_sensors_on_the_first_straight_read_what_can_be_written_down():
    simulation = cut(slide=0.0)
    latitude = np.radians(36.65)
    earth = 7.292115e-5 * np.array([0.0, np.cos(latitude), np.sin(latitude)])  # east, north, up
    forward, left = np.append(AHEAD, 0.0), np.append(LEFT, 0.0)
    imu = simulation.clean["imu"]
    straight = (seconds_of(simulation, imu) > 3.0) & (seconds_of(simulation, imu) < 35.0)
    expected = [earth @ forward, earth @ left, earth[2]]
    assert_allclose(imu["gyro"][straight], np.tile(expected, (straight.sum(), 1)), atol=1e-8)
    # normal gravity on the ellipsoid, and Coriolis at 1 m/s; the spline through the way leaves micrometres
    gravity = 9.780327 * (1 + 0.0053024 * np.sin(latitude) ** 2 - 0.0000058 * np.sin(2 * latitude) ** 2)
    coriolis = 2 * np.cross(earth, forward)
    expected = [coriolis @ forward, coriolis @ left, gravity + coriolis[2]]
    assert_allclose(imu["acc"][straight], np.tile(expected, (straight.sum(), 1)), atol=2e-5)
    odometer = simulation.clean["odometer"]["linear"]
    assert_allclose(odometer[30:350], np.tile([1.0, 0.0, 0.0], (320, 1)), atol=1e-7)
    # field of 53 uT, dip 55 degrees, 6 degrees west of north: from the forward axis 124.5 - 6 degrees clockwise
    horizontal, angle = 53e-6 * np.cos(np.radians(55)), np.radians(124.5 - 6.0)
    expected = [horizontal * np.cos(angle), -horizontal * np.sin(angle), -53e-6 * np.sin(np.radians(55))]
    assert_allclose(simulation.clean["magnetometer"]["field"][30:350], np.tile(expected, (320, 1)), atol=1e-11)


def test_nominal_noise_is_that_of_the_rig():
    simulation, rig = cut(), load_rig("shearer")
    for column, bias, density in [
        ("gyro", "bias_gyro", rig.imu.gyro_density),
        ("acc", "bias_acc", rig.imu.acc_density),
    ]:
        noise = simulation.log_series[0][column] - simulation.clean["imu"][column] - simulation.drawn["imu"][bias]
        assert_chi_square(noise / (density * 10.0))
    odometer = log_of(simulation, "/odometer")["linear"][:, 0]
    scale = simulation.drawn["odometer"]["scale"]
    assert_chi_square((odometer - (1 + scale) * simulation.clean["odometer"]["linear"][:, 0]) / 0.02)
    field, clean = log_of(simulation, "/imu/mag")["field"], simulation.clean["magnetometer"]["field"]
    assert_chi_square((field - clean) / (np.radians(0.5) * 53e-6 * np.cos(np.radians(55))))


def test_nominal_sliding_is_that_of_the_rig_sample_by_sample():
    simulation = cut()
    t_s = np.arange(3.0, 35.0, 0.1)
    along, aside, height = along_and_aside(simulation, t_s)
    slid = np.diff(np.column_stack([aside, height]), axis=0) / 0.1
    assert_chi_square(slid / 0.02)
    assert np.abs(np.mean(slid[1:] * slid[:-1], axis=0)).max() < 0.02**2 * 4 / np.sqrt(len(slid))
    assert along[-1] - along[0] == pytest.approx(31.9, abs=1e-5)


def test_initial_state_is_the_rigs_prior():
    yaw, tilt, position = [], [], []
    for seed in range(60):
        given = cut(seed=seed, duration=1.0).rig.initial
        yaw.append((given.yaw_deg - (124.5 + 90.0 - 360.0)) / 1.0)
        tilt.append([given.roll_deg / 0.5, given.pitch_deg / 0.5])
        position.append(np.array(given.position_m) / 0.01)
    for drawn in (yaw, tilt, position):
        assert_chi_square(np.array(drawn))


# ---- what is not nominal ----


def test_printed_imu_is_in_rig_and_log():
    simulation = cut(duration=20.0, mti30="printed")
    assert simulation.rig.imu.gyro_density_dps_rthz == 0.1
    noise = simulation.log_series[0]["gyro"] - simulation.clean["imu"]["gyro"] - simulation.drawn["imu"]["bias_gyro"]
    assert_chi_square(noise / np.radians(0.1) / 10.0)


def test_encoder_counts_whole_ticks_and_loses_none():
    fine, coarse = (
        log_of(cut(duration=30.0, odometer_tick_mm=tick), "/odometer")["linear"][:, 0] for tick in (0.0, 5.0)
    )
    ticks = coarse * 0.1 / 0.005
    assert_allclose(ticks, np.round(ticks), atol=1e-9)
    behind = np.cumsum(fine - coarse) * 0.1
    assert behind.min() > -1e-9
    assert behind.max() < 0.005 + 1e-9


def test_slips_are_where_they_are_told():
    plain, slipping = cut(), cut(slips=3)
    excess = (log_of(slipping, "/odometer")["linear"] - log_of(plain, "/odometer")["linear"])[:, 0]
    end_s = seconds_of(plain, plain.clean["odometer"])
    told = slipping.drawn["odometer"]["slips_s"]
    inside = ((end_s[:, None] > told[:, 0]) & (end_s[:, None] < told[:, 1])).any(axis=1)
    assert_array_equal(excess[end_s > 2.0] > 0.19, inside[end_s > 2.0])
    assert_array_equal(excess != 0, inside)


def test_residual_field_turns_with_the_machine():
    plain, magnetised = cut(), cut(residual_ut=0.5)
    extra = 1e6 * (log_of(magnetised, "/imu/mag")["field"] - log_of(plain, "/imu/mag")["field"])
    assert_allclose(extra, np.tile(magnetised.drawn["magnetometer"]["residual_ut"], (len(extra), 1)), atol=1e-9)
    assert_allclose(np.linalg.norm(extra, axis=1), 0.5, rtol=1e-9)


def test_vibration_is_as_large_as_it_says():
    still, shaking = cut(duration=30.0, slide=0.0), cut(duration=30.0, slide=0.0, vibration=1.0)
    t_s = np.arange(4.0, 30.0, 0.003)
    extra = shaking.truth(t_s).acceleration - still.truth(t_s).acceleration
    # band of 0.5 m/s^2 rms and lines with amplitudes of 0.1 and 0.3; the stronger one may beat with its two neighbours
    # of the band, 0.5 sqrt(2 / 32) each, more slowly than this lasts
    beat = 2 * 0.3 * 0.5 * np.sqrt(2 / 32)
    assert_allclose(extra.var(axis=0), 0.5**2 + (0.1**2 + 0.3**2) / 2, atol=beat)


# ---- magnetic faults ----


@pytest.mark.parametrize("fault", ["offset", "field", "spikes"])
def test_fault_is_what_it_is_told_to_be_and_nothing_else_changes(fault):
    plain, disturbed = cut(duration=40.0), cut("shearer-magfault", duration=40.0, fault=fault)
    assert disturbed.rig == plain.rig
    for one, other in zip(plain.log_series, disturbed.log_series, strict=True):
        for name, column in one.columns.items():
            assert np.array_equal(column, other[name]) == (one.topic != "/imu/mag")
    told = disturbed.drawn["magnetometer"]
    t_s = seconds_of(plain, plain.clean["magnetometer"])
    R = plain.truth(t_s).R
    true_n = np.einsum("nij,nj->ni", R, plain.clean["magnetometer"]["field"])
    added_b = log_of(disturbed, "/imu/mag")["field"] - log_of(plain, "/imu/mag")["field"]
    changed_n = true_n + np.einsum("nij,nj->ni", R, added_b)
    turn = np.angle(
        np.exp(1j * (np.arctan2(changed_n[:, 1], changed_n[:, 0]) - np.arctan2(true_n[:, 1], true_n[:, 0])))
    )
    assert_allclose(np.degrees(turn), told["fault_yaw_deg"], atol=1e-6)
    assert told["fault_s"] == (10.0, 30.0)
    assert not added_b[(t_s < 10.0) | (t_s > 30.0)].any()
    size = 1e6 * np.linalg.norm(added_b, axis=1)
    if fault == "offset":
        assert_allclose(told["fault_yaw_deg"][(t_s >= 11.0) & (t_s <= 29.0)], 20.0, atol=1e-9)
        assert told["fault_yaw_deg"][105] == pytest.approx(10.0)
        assert_allclose(added_b[:, 2], 0.0, atol=1e-12)
    elif fault == "field":
        assert 9.9 < size.max() < 30.0
        assert np.abs(np.diff(size)).max() < 30.0 * np.pi / 20.0 * 0.1 * 1.01  # it changes slowly
    else:
        assert_array_equal(np.flatnonzero(size), told["spikes"])
        assert 20 < len(told["spikes"]) < 62  # of 201 samples one in five: 40 with an sd of 5.7
        assert size[told["spikes"]].min() > 10.0 - 1e-6
        assert size.max() < 30.0 + 1e-6


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("shearer-cut", {"mti30": "better"}, "there are datasheet, printed"),
        ("shearer-cut", {"speed_mps": 0.0}, "should be above 0"),
        ("shearer-cut", {"settings": ("sensors.odometer.yaw_deg=3",)}, "no yaw, pitch or mounting"),
        ("shearer-magfault", {"fault": "flood"}, "there are offset, field, spikes"),
        ("shearer-panel", {"face_m": 15.0}, "a bend of 20 m on a face of 15 m"),
    ],
)
def test_impossible_options_are_refused(name, options, message):
    with pytest.raises(TbmfgError, match=message):
        datasets.make(name, seed=0, duration=5.0, **options)
