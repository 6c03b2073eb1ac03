"""The shaft boring machine and the cage: what their sensors read, by other means than the simulator's."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import datasets
from datasets import cage, shaft
from datasets.motion import Kinematics, Motion
from datasets.sensors import shaft_pressure, spot_on_detector
from datasets.simulate import stream
from tests.test_datasets_sensors import assert_chi_square

DETECTOR = np.diag([1.0, -1.0, -1.0])  # x forward, y right, z down in forward-left-up
SHAFT = [name for name in datasets.MACHINES if name.startswith(("shaft", "cage"))]


@cache
def made(name, seed=1, duration=None, settings=(), **options):
    return datasets.make(name, seed=seed, duration=duration, settings=settings, **options)


def log_of(simulation, topic):
    return next(series for series in simulation.log_series if series.topic == topic)


def true_at(simulation, topic):
    return simulation.truth((log_of(simulation, topic).t_ns - simulation.start_ns) * 1e-9)


def pose(position=(0.0, 0.0, 0.0), roll_deg=0.0, pitch_deg=0.0, yaw_deg=0.0):
    R = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()
    zero = np.zeros((1, 3))
    return Kinematics(np.array([position], dtype=float), zero, zero, R[None], zero, zero)


# ---- at rest ----


def test_at_rest_the_unit_feels_gravity_the_turning_earth_and_the_field():
    simulation = made("shaft-static")
    imu, drawn = log_of(simulation, "/imu/data"), simulation.drawn["imu"]
    # g of WGS 84 at 34.3 degrees is 9.797; x points north and z up: the Earth turns about (cos, 0, sin) of the latitude
    acc, gyro = imu["acc"] - drawn["bias_acc"], np.degrees(imu["gyro"] - drawn["bias_gyro"])
    turn = 360 / 86164.1 * np.array([np.cos(np.radians(34.3)), 0.0, np.sin(np.radians(34.3))])
    assert_chi_square((acc - [0.0, 0.0, 9.7969]) / (180e-6 * 9.80665 * np.sqrt(50)))
    assert_chi_square((gyro - turn) / (0.007 * np.sqrt(50)))
    field = log_of(simulation, "/imu/mag")["field"]
    dip = np.radians(58.0)
    assert_chi_square((field - 50e-6 * np.array([np.cos(dip), 0.0, -np.sin(dip)])) / 15e-9)
    spot = log_of(simulation, "/laser/spot")["point"]
    # the detector resolves 0.02 mm, which adds the variance of a rounding
    assert_chi_square(spot[:, :2] / np.hypot(0.2e-3, 0.02e-3 / np.sqrt(12)))
    assert not spot[:, 2].any()
    assert_allclose(spot / 0.02e-3, np.round(spot / 0.02e-3), atol=1e-9)


# ---- the laser's spot ----


@pytest.mark.parametrize(
    ("body", "along", "xyz_b", "expected_mm"),
    [
        # 10 mm behind the line and 20 mm left of it: the line is met 10 mm ahead and 20 mm to the right
        (pose((-0.01, 0.02, -5.0)), (0, 0, 1), (0, 0, 0.1), (10.0, 20.0)),
        # the same place, turned left by 90 degrees: forward is west, where the line lies 20 mm behind, 10 mm right
        (pose((-0.01, 0.02, -5.0), yaw_deg=90), (0, 0, 1), (0, 0, 0.1), (-20.0, 10.0)),
        # rolled to the right by 30 degrees, the detector's centre is 50 mm right of the line; along the slope 57.7
        (pose(roll_deg=30), (0, 0, 1), (0, 0, 0.1), (0.0, -100 * np.tan(np.radians(30)))),
        # nose down by 30 degrees: the centre is 50 mm ahead
        (pose(pitch_deg=30), (0, 0, 1), (0, 0, 0.1), (-100 * np.tan(np.radians(30)), 0.0)),
        # 1 mm per m out of plumb to the north, 2 to the west; 10 m below, the line is on the other side
        (pose((0, 0, -10.1)), (0.001, 0.002, 1), (0, 0, 0.1), (-10.0, 20.0)),
    ],
)
def test_spot_by_hand(body, along, xyz_b, expected_mm):
    spot = spot_on_detector(body, np.array(xyz_b), DETECTOR, np.array(along, dtype=float))
    assert_allclose(1e3 * spot, [expected_mm], atol=1e-9)


def test_spot_lies_on_the_line_and_jitters_as_the_rig_says():
    simulation = made("shaft-dynamic", duration=20.0, settings=("sensors.laser.offset_sd_mm=1",), nominal=1)
    clean = simulation.clean["laser"]
    truth = true_at(simulation, "/laser/spot")
    point_n = truth.position + np.einsum("nij,nj->ni", truth.R, clean["point"] @ DETECTOR + [0, 0, 0.1])
    assert np.abs(point_n[:, 2]).max() > 0.09
    drawn = simulation.drawn["laser"]
    assert np.abs(drawn["zero_m"]).max() > 1e-4
    assert_allclose(point_n[:, :2], point_n[:, 2:] * drawn["tilt_n"], atol=1e-15)
    noise = log_of(simulation, "/laser/spot")["point"] - clean["point"]
    assert_chi_square((noise[:, :2] - drawn["zero_m"]) / np.hypot(0.2e-3, 0.02e-3 / np.sqrt(12)))


def test_spot_is_clipped_where_the_detector_ends():
    simulation = made("shaft-dynamic", duration=20.0, rocking_deg=3.0)
    clean, log = simulation.clean["laser"]["point"], log_of(simulation, "/laser/spot")["point"]
    assert np.abs(clean).max() > 0.035
    assert np.abs(log).max() == pytest.approx(0.03, abs=1e-15)


def test_dust_hides_one_spot_in_twenty():
    sent, all_ticks = len(log_of(made("shaft-dynamic"), "/laser/spot")), 4001
    assert abs(1 - sent / all_ticks - 0.05) < 4 * np.sqrt(0.05 * 0.95 / all_ticks)
    assert len(made("shaft-dynamic").clean["laser"]) == all_ticks


# ---- barometer ----


def test_pressure_is_that_of_a_column_of_air_at_rest():
    """Hydrostatics added up step by step, with the gas law."""
    depth = np.linspace(0.0, 430.0, 44)

    def per_metre(h, p):
        return p * 9.797 / (8.314462 / 0.0289652 * (295.15 + 9.8e-3 * (h - 215.0)))

    expected = solve_ivp(per_metre, (0.0, 430.0), [101325.0], t_eval=depth, rtol=1e-10, atol=1e-4).y[0]
    # the gas constant of dry air is rounded to 287.05 of 287.050: 1e-5 of 5200 Pa
    assert_allclose(shaft_pressure(depth, 101325.0, 295.15, 215.0, 9.797), expected, atol=0.05)
    assert np.diff(expected)[-1] / 10.0 == pytest.approx(12.25, abs=0.05)  # what section 5 of the source's spec says


def test_three_degrees_are_four_metres_at_the_bottom():
    cold, warm = (shaft_pressure(np.array([430.0]), 101325.0, k, 215.0, 9.797)[0] for k in (295.15, 298.15))
    assert (cold - warm) / 12.25 == pytest.approx(4.4, abs=0.1)


def test_barometer_is_read_more_often_than_it_converts():
    simulation = made("cage-fast", duration=40.0, vibration=0.0)
    log = log_of(simulation, "/barometer")
    changes = np.flatnonzero(np.diff(log["pressure"])) + 1
    assert len(changes) == 800  # 20 a second
    assert set(np.diff(changes)) == {2, 3}
    # a reading is up to 50 ms old, 25 ms in the mean less half a tick: at 3.9 m/s and 12 Pa/m half a pascal to one
    late = (simulation.clean["barometer"]["pressure"] - log["pressure"])[1000:]
    assert late.mean() == pytest.approx(0.02 * 3.9 * 12, abs=4 * 1.2 / np.sqrt(400))


def test_nominal_barometer_errs_as_the_rig_says():
    simulation = made("shaft-static", nominal=1)
    error_pa = log_of(simulation, "/barometer")["pressure"] - simulation.clean["barometer"]["pressure"]
    per_metre = 101325 * 9.797 / (287.05 * 295.15)
    # differences of white noise of 0.16 m are not independent of their neighbours: every other one is
    assert_chi_square(np.diff(error_pa)[::2] / per_metre / (np.sqrt(2) * 0.16))
    assert_array_equal(simulation.clean["barometer"].t_ns + 25_000_000, log_of(simulation, "/barometer").t_ns)


# ---- magnetometer ----


def test_motor_field_is_one_to_three_microtesla_along_one_axis():
    simulation = made("shaft-dynamic")
    own = log_of(simulation, "/imu/mag")["field"] - simulation.clean["magnetometer"]["field"]
    size = np.linalg.norm(own, axis=1) * 1e6
    crests = size[:4000].reshape(-1, 100).max(axis=1)  # of 2 s, in which the load hardly changes
    assert 0.9 < crests.min() < 1.3
    assert 2.8 < crests.max() < 3.1
    _, spread, _ = np.linalg.svd(own - own.mean(axis=0), full_matrices=False)
    assert_allclose(spread[1:] / np.sqrt(len(own)), 15e-9, rtol=0.1)


# ---- motion ----


@pytest.mark.parametrize(
    ("name", "acceleration", "displacement_mm", "rocking_deg"),
    [("shaft-low", 0.45, 0.8, 0.05), ("shaft-high", 0.9, 1.7, 0.1)],
)
def test_vibration_is_real_motion_of_the_size_that_is_stated(name, acceleration, displacement_mm, rocking_deg):
    t = np.arange(0.0, 36.0, 1e-3)  # whole turns of the cutterhead
    truth = made(name).truth(t)
    # neighbouring lines of the band, 5.6 Hz apart in the mean, beat over 36 s: less than 3 %
    assert_allclose(np.sqrt(np.mean(truth.acceleration**2, axis=0)), acceleration, rtol=0.03)
    assert_allclose(1e3 * np.std(truth.position, axis=0), displacement_mm, rtol=0.03)
    angles = Rotation.from_matrix(truth.R).as_euler("ZYX", degrees=True)
    assert_allclose(np.std(angles[:, 1:], axis=0), rocking_deg, rtol=0.03)
    assert np.std(angles[:, 0]) < 1e-3


def test_unit_folds_what_it_cannot_follow():
    """Means over 20 ms leave a fifth of a flat band of 20 to 200 Hz: the mean of sinc^2 over it is 0.042."""
    noise = made("shaft-low").clean["imu"]["acc"].std(axis=0)
    assert_allclose(noise, 0.45 * np.sqrt(0.042), rtol=0.25)


def test_machine_turns_within_17_degrees_and_rocks_by_half_a_degree():
    angles = Rotation.from_matrix(made("shaft-dynamic").truth(np.arange(0, 80, 0.01)).R).as_euler("ZYX", degrees=True)
    assert np.abs(angles[:, 0]).max() == pytest.approx(17.0, abs=0.1)
    assert_allclose(np.std(angles[:, 1:], axis=0), 0.5, rtol=0.1)


@pytest.mark.parametrize("seed", range(12))
def test_sinking_machine_goes_where_it_points_and_stays_on_its_laser(seed):
    t_s = shaft.times(360.0)
    feed = np.full(len(t_s), 0.01)
    way, rpy = shaft.steered(t_s, feed, stream(seed, "ground"))
    motion = Motion(shaft.tilting(t_s, way, rpy))
    t = np.linspace(0.0, 360.0, 721)
    truth = motion(t)
    pivot, velocity = truth.at_point(shaft.PIVOT_B)
    assert_allclose(velocity, -0.01 * truth.R[:, :, 2], atol=1e-6)
    assert 3.5 < pivot[0, 2] - pivot[-1, 2] < 3.6
    tilt_deg = np.degrees(np.arccos(truth.R[:, 2, 2]))
    assert 0.3 < tilt_deg.max() < 2.0
    spot = spot_on_detector(truth, np.array([0, 0, 0.1]), DETECTOR, np.array([0.0, 0.0, 1.0]))
    assert np.abs(spot).max() < 0.03


@pytest.mark.parametrize(("name", "speed", "length_m"), [("cage-fast", 3.90, 430.0), ("cage-slow", 1.33, 418.95)])
def test_cage_goes_down_as_far_as_the_spec_says(name, speed, length_m):
    whole = datasets.own_duration(name)
    t_s = shaft.times(whole)
    position, velocity, _ = cage.down(t_s, cage.pace(t_s, speed, whole))(np.array([5.0, 20.0, whole - 20.0, whole]))
    assert position[0, 2] - position[-1, 2] == pytest.approx(length_m, abs=1e-6)
    assert_allclose(velocity[:, 2], [0.0, -speed, -speed, 0.0], atol=1e-6)
    assert position[1, 2] == pytest.approx(-7.5 * speed, abs=1e-5)  # half of the way at full speed


def test_cage_knows_the_depth_that_was_surveyed():
    simulation = datasets.make("cage-fast", seed=1, duration=30.0, vibration=0.0, survey_sd_m=0.05)
    [mark] = simulation.rig.survey
    error = np.array(mark.position_m) - simulation.truth(np.array([30.0])).position[0]
    assert mark.at == "end"
    assert mark.sigma_m == 0.05
    assert 0.0 < np.abs(error).max() < 4 * 0.05
    assert not made("cage-fast", duration=40.0, vibration=0.0).rig.survey


# ---- the logs as a whole ----


def test_same_seed_same_log():
    first, again, other = (datasets.make("shaft-descend", seed=seed, duration=6.0) for seed in (3, 3, 4))
    for one, two, three in zip(first.log_series, again.log_series, other.log_series, strict=True):
        for name, column in one.columns.items():
            assert_array_equal(column, two[name])
        assert any(not np.array_equal(one[name], three[name]) for name in one.columns)


@pytest.mark.parametrize("name", SHAFT)
def test_every_log_has_its_sensors_and_its_rig(name):
    simulation = datasets.make(name, seed=2, duration=2.0)
    topics = {series.topic for series in simulation.log_series}
    expected = {"imu", "magnetometer", "barometer"} | ({"laser"} if name.startswith("shaft") else set())
    assert set(simulation.rig.sensors) == expected == set(simulation.clean)
    assert topics == {sensor.topic for sensor in simulation.rig.sensors.values()} | {"/truth/odometry"}
    assert simulation.name == name
    start = simulation.truth(np.zeros(1))
    given = simulation.rig.initial
    assert np.abs(given.position - start.position[0]).max() < 5 * given.position_sd


def test_own_lengths():
    lengths = {name: datasets.own_duration(name) for name in SHAFT}
    expected = {"static": 40, "low": 40, "high": 40, "dynamic": 80, "descend": 180}
    assert lengths == {f"shaft-{key}": value for key, value in expected.items()} | {
        "cage-fast": pytest.approx(135.26, abs=0.01),
        "cage-slow": 340,
    }
    assert log_of(made("shaft-static"), "/imu/data").t_ns[-1] - made("shaft-static").start_ns == 40_000_000_000
