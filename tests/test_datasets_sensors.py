"""The simulated sensors: closure of the inertial unit, exact noise, honest priors, independent streams."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import datasets
from datasets import sensors, tbm
from datasets.motion import Kinematics
from datasets.simulate import Scene, draw_prior, period_means, stream, ticks
from tbmfg import earth
from tbmfg.errors import RigError, TbmfgError
from tbmfg.inertial.steps import compensate, make_steps
from tbmfg.inertial.strapdown import mechanise
from tbmfg.rig import override, parse_rig

SETTINGS = (
    "sensors.prism.clock_offset_sd_s=0.05",
    "sensors.magnetometer.declination_deg=4",
    "origin.x_axis_azimuth_deg=25",
)


@cache
def drive(seed=3, duration=60.0, settings=SETTINGS, **options):
    return datasets.make("tbm-drive", seed=seed, duration=duration, settings=settings, **options)


def scene(simulation, duration=60.0):
    return Scene(simulation.truth, simulation.rig.origin, duration)


def seconds_of(simulation, series):
    return (series.t_ns - simulation.start_ns) * 1e-9


def log_of(simulation, topic):
    return next(series for series in simulation.log_series if series.topic == topic)


def assert_chi_square(normalised):
    """Independent standard normal values, whatever the shape: their squares' sum lies in its central 99.8 %."""
    low, high = chi2.ppf([0.001, 0.999], df=normalised.size)
    assert low < np.sum(normalised**2) < high


# ---- inertial unit ----


def test_the_place_on_earth_agrees_with_the_package():
    for latitude_deg, height_m, azimuth_deg in [(34.3, 0.0, 90.0), (-51.0, -900.0, 25.0), (0.0, 300.0, -140.0)]:
        origin = tbm.rig().origin.model_copy(
            update={"latitude_deg": latitude_deg, "height_m": height_m, "x_axis_azimuth_deg": azimuth_deg}
        )
        here = Scene(drive().truth, origin, 1.0)
        # the two free-air formulas differ by 3 (h / a)^2 g, 6e-7 m/s^2 at 900 m
        assert_allclose(-here.gravity_n[2], earth.gravity(np.radians(latitude_deg), height_m), atol=6e-7)
        expected = earth.rate_n(np.radians(latitude_deg), np.radians(azimuth_deg))
        assert_allclose(
            here.earth_rate_n, expected, atol=2e-11
        )  # sidereal day against a rounded constant: 1.2e-7 of it


def test_naive_integration_of_the_ideal_unit_returns_to_truth():
    """Rotate, average, add up, in an inertial frame: nothing of the package, and nothing of the simulator."""
    simulation = drive(duration=24.0, imu_rate_hz=2375.0)
    imu, here = simulation.clean["imu"], scene(simulation)
    dt = 1 / 2375.0
    t = np.arange(len(imu) + 1) * dt
    start = simulation.truth(np.zeros(1))
    increments = Rotation.from_rotvec(imu["gyro"] * dt).as_matrix()
    R_ib = np.empty((len(t), 3, 3))
    R_ib[0] = start.R[0]
    for k, increment in enumerate(increments):
        R_ib[k + 1] = R_ib[k] @ increment
    R_nb = Rotation.from_rotvec(-np.outer(t, here.earth_rate_n)).as_matrix() @ R_ib

    velocity, position = np.empty((2, len(t), 3))
    velocity[0], position[0] = start.velocity[0], start.position[0]
    force_n = np.einsum("nij,nj->ni", (R_nb[:-1] + R_nb[1:]) / 2, imu["acc"])
    coriolis = -2 * np.cross(here.earth_rate_n, np.eye(3)).T
    for k in range(len(imu)):
        acceleration = force_n[k] + here.gravity_n + coriolis @ velocity[k]
        velocity[k + 1] = velocity[k] + acceleration * dt
        position[k + 1] = position[k] + (velocity[k] + velocity[k + 1]) * dt / 2

    truth = simulation.truth(t)
    # within a step rate (0.03 rad/s) and force (slope 1400 m/s^3) vary together: at most dt^2 / 12 of their product
    sculling = 0.03 * 1400 * dt**2 / 12
    # coning: rate times change of rate, 0.03 rad/s and 14 rad/s^2, over the same
    coning = 0.03 * 14 * dt**2 / 12
    assert_allclose(velocity, truth.velocity, atol=sculling * 24 + coning * 9.8 * 24**2 / 2)
    assert_allclose(position, truth.position, atol=sculling * 24**2 / 2 + coning * 9.8 * 24**3 / 6)
    turn = Rotation.from_matrix(np.swapaxes(truth.R, 1, 2) @ R_nb).magnitude()
    assert turn.max() < coning * 24


def test_strapdown_of_the_package_returns_to_truth():
    simulation = drive(duration=60.0)
    steps = make_steps(simulation.clean["imu"], np.eye(3), "end")
    gyro, acc = compensate(steps, np.zeros(3), np.zeros(3))
    start, origin = simulation.truth(np.zeros(1)), simulation.rig.origin
    x0 = np.concatenate([start.R[0].ravel(), start.position[0], start.velocity[0], np.zeros(6)])
    x = mechanise(x0, steps.edges_s, gyro, acc, origin.rate_n, np.array([0.0, 0.0, -origin.gravity]))[1:]
    truth = simulation.truth(seconds_of(simulation, simulation.clean["imu"]))
    # half a step of Earth rotation of gravity, w_ie g dt / 2 = 6.3e-7 m/s^2, makes 1.1 mm and 4e-5 m/s in a minute;
    # what pump and crawler do within a step as much again
    assert np.linalg.norm(x[:, 9:12] - truth.position, axis=1).max() < 2e-3
    assert np.linalg.norm(x[:, 12:15] - truth.velocity, axis=1).max() < 1e-4
    turn = Rotation.from_matrix(np.swapaxes(truth.R, 1, 2) @ x[:, :9].reshape(-1, 3, 3)).magnitude()
    assert turn.max() < 2e-7


def test_means_over_a_period_have_converged():
    here = scene(drive())
    edges_ns = ticks(60.0, 475.0)[15_000:17_000]
    coarse, fine = (period_means(here.inertial, edges_ns, panel_s=panel) for panel in (2.2e-3, 1.1e-3))
    assert (np.abs(coarse - fine).max(axis=0) / fine.std(axis=0)).max() < 1e-6
    assert np.abs(fine - here.inertial(edges_ns[1:] * 1e-9)).max() > 0.1  # a sample in time would not do


@pytest.mark.parametrize(("stamp", "shift"), [("start", 0.0), ("centre", 0.5), ("end", 1.0)])
def test_stamps_lie_where_the_rig_says(stamp, shift):
    simulation = drive(duration=1.0, settings=(f"sensors.imu.stamp={stamp}",))
    assert_allclose(seconds_of(simulation, simulation.clean["imu"]), (np.arange(475) + shift) / 475, atol=2e-9)


def test_unit_lying_on_its_side_measures_in_its_own_axes():
    turned = drive(duration=2.0, settings=("sensors.imu.T_bi.rpy_deg=[10, -20, 70]",))
    upright = drive(duration=2.0, settings=())
    R_bi = Rotation.from_euler("ZYX", [70, -20, 10], degrees=True).as_matrix()
    for column in ("gyro", "acc"):
        assert_allclose(turned.clean["imu"][column] @ R_bi.T, upright.clean["imu"][column], atol=1e-13)
        assert_allclose(turned.log_series[0][column] @ R_bi.T, upright.log_series[0][column], atol=1e-13)


def test_noise_of_the_unit_is_white_with_the_density_of_the_rig():
    simulation, rig = drive(), tbm.rig().imu
    for column, bias, density in [("gyro", "bias_gyro", rig.gyro_density), ("acc", "bias_acc", rig.acc_density)]:
        log, clean = log_of(simulation, rig.topic), simulation.clean["imu"]
        noise = log[column] - clean[column] - simulation.drawn["imu"][bias]
        assert_chi_square(noise / (density * np.sqrt(475)))
        # Allan: means over 1 s have the density as their sd, if nothing is correlated
        assert_chi_square(noise.reshape(60, 475, 3).mean(axis=1) / density)
        walk = {"gyro": rig.gyro_walk, "acc": rig.acc_walk}[column]
        assert_chi_square(np.diff(simulation.drawn["imu"][bias], axis=0) * np.sqrt(475) / walk)


# ---- draws from the priors ----


def test_calibrations_are_draws_from_the_rig():
    rig, here = override(tbm.rig(), [*SETTINGS, "sensors.magnetometer.declination_sd_deg=1.5"]), scene(drive(), 0.1)
    bias, arm, offset, scale, declination = [], [], [], [], []
    for seed in range(200):
        imu = sensors.imu(here, rig.imu, stream(seed, "imu"), rate_hz=100.0).drawn
        bias.append(np.hstack([imu["bias_gyro"][0] / rig.imu.gyro_bias_sd, imu["bias_acc"][0] / rig.imu.acc_bias_sd]))
        prism = sensors.prism(here, rig.sensors["prism"], stream(seed, "prism"), rate_hz=10.0).drawn
        arm.append((prism["arm_m"] - [0.0918, 0.8221, 0.384]) / 0.005)
        offset.append(prism["clock_offset_s"] / 0.05)
        odometer = sensors.odometer(here, rig.sensors["odometer"], stream(seed, "odometer"), rate_hz=10.0)
        scale.append(odometer.drawn["scale"] / 0.01)
        compass = sensors.magnetometer(here, rig.sensors["magnetometer"], stream(seed, "magnetometer"), rate_hz=10.0)
        declination.append((compass.drawn["declination_deg"] - 4) / 1.5)
    for drawn in (bias, arm, offset, scale, declination):
        assert_chi_square(np.array(drawn))
        assert np.abs(np.mean(drawn, axis=0)).max() < 4 / np.sqrt(200)


def test_start_of_the_rig_is_the_true_one_with_errors_drawn_from_its_sds():
    rig = tbm.rig()
    R = Rotation.from_euler("ZYX", [100.0, 20.0, -30.0], degrees=True).as_matrix()
    start = Kinematics(*np.array([[[40.0, 1.0, -2.0]], [[0.3, 0.2, 0.1]], [[0.0] * 3]]), R[None], *np.zeros((2, 1, 3)))
    turn, shift, speed = [], [], []
    for seed in range(200):
        given = draw_prior(rig, start, stream(seed, "initial"))
        ypr = [given["yaw_deg"], given["pitch_deg"], given["roll_deg"]]
        error_n = (Rotation.from_euler("ZYX", ypr, degrees=True) * Rotation.from_matrix(R).inv()).as_rotvec(
            degrees=True
        )
        turn.append(error_n / [0.1, 0.1, 0.3])
        shift.append((np.array(given["position_m"]) - start.position[0]) / 0.02)
        speed.append((np.array(given["velocity_mps"]) - start.velocity[0]) / 0.01)
    for drawn in (turn, shift, speed):
        assert_chi_square(np.array(drawn))


# ---- prism, odometer, magnetometer ----


def test_prism_residual_at_truth_is_the_noise():
    simulation = drive()
    log, drawn = log_of(simulation, "/prism/position"), simulation.drawn["prism"]
    at_truth, _ = simulation.truth(seconds_of(simulation, log) - drawn["clock_offset_s"]).at_point(drawn["arm_m"])
    assert_allclose(at_truth, simulation.clean["prism"]["point"], atol=1e-9)
    assert_chi_square((log["point"] - at_truth) / (3e-3 + 1.5e-6 * np.linalg.norm(at_truth, axis=1, keepdims=True)))
    assert_allclose(np.diff(log.t_ns) * 1e-9, 0.2, atol=0.05)
    assert np.std(np.diff(log.t_ns)) > 1e6


def test_prism_gaps():
    fixes, all_fixes = (drive(prism_gaps=gaps).clean["prism"] for gaps in (2, 0))
    assert len(all_fixes) == 300
    assert 300 - 2 * 31 <= len(fixes) <= 300 - 9
    assert np.diff(fixes.t_ns).max() > 1.9e9


def test_odometer_adds_up_to_the_distance_driven():
    simulation = drive()
    clean, log = simulation.clean["odometer"]["linear"], log_of(simulation, "/odometer")["linear"]
    contact = np.array(simulation.rig.sensors["odometer"].arm_m)
    fine = np.linspace(0, 60, 60_001)
    point, _ = simulation.truth.undisturbed(fine).at_point(contact)
    length = np.linalg.norm(np.diff(point, axis=0), axis=1).sum()  # a minute in, it has not reversed
    # chords are shorter than arcs by (turn per step)^2 / 24
    assert_allclose(clean[:, 0].sum() * 0.05, length, rtol=1e-8)
    assert length > 3
    noise = log[:, 0] - (1 + simulation.drawn["odometer"]["scale"]) * clean[:, 0]
    assert_chi_square(noise / 0.02)
    assert not log[:, 1:].any()


def test_an_inertial_unit_that_is_mounted_askew():
    """The same drive in other axes: b's x axis is turned against the way by what is drawn, and the IMU with it."""
    given = ("sensors.odometer.yaw_deg=3", "sensors.odometer.pitch_deg=-5", "sensors.odometer.mounting_sd_deg=0.5")
    straight, askew = (drive(duration=25.0, settings=settings, vibration=0.0) for settings in ((), given))
    yaw_deg, pitch_deg = askew.drawn["odometer"]["yaw_pitch_deg"]
    assert 0 < abs(yaw_deg - 3) < 2
    assert 0 < abs(pitch_deg + 5) < 2
    E = Rotation.from_euler("ZY", [yaw_deg, pitch_deg], degrees=True)  # the way's axes to b
    t_s = np.linspace(10.0, 20.0, 50)
    travel = askew.truth(t_s)
    way_b = np.einsum("nji,nj->ni", travel.R, travel.at_point(np.array(askew.rig.sensors["odometer"].arm_m))[1])
    assert_allclose(E.apply(way_b, inverse=True)[:, 1:], 0.0, atol=1e-9)
    assert_allclose(travel.omega, E.apply(straight.truth(t_s).omega), atol=1e-6)  # the tilts follow another path
    assert_allclose(askew.clean["odometer"]["linear"], straight.clean["odometer"]["linear"], atol=1e-6)


def test_slide_is_as_large_as_the_rig_says():
    simulation = drive(slide=1.0, vibration=0.0)
    contact = np.array(simulation.rig.sensors["odometer"].arm_m)
    edges_ns = ticks(60.0, 20.0)

    def velocity_b(t_s):
        travel = simulation.truth(t_s)
        return np.einsum("nji,nj->ni", travel.R, travel.at_point(contact)[1])

    mean = period_means(velocity_b, edges_ns, panel_s=0.05)
    in_full_motion = (edges_ns[1:] > 10e9) & (edges_ns[1:] < 26e9)  # the first move, 7.5 to 27.5 s, without its ramps
    assert_chi_square(mean[in_full_motion, 1:] / 0.02)
    standing = edges_ns[1:] < 6e9
    assert np.abs(mean[standing]).max() < 1e-5


def test_magnetometer_points_north_and_down():
    simulation = drive()
    log, clean = log_of(simulation, "/imu/mag")["field"], simulation.clean["magnetometer"]
    R = simulation.truth(seconds_of(simulation, clean)).R
    true_n, field_n = (np.einsum("nij,nj->ni", R, field) for field in (clean["field"], log))
    assert_allclose(np.linalg.norm(true_n, axis=1), 50e-6, rtol=1e-12)
    assert_allclose(np.degrees(np.arcsin(-true_n[:, 2] / 50e-6)), 65.0, atol=1e-9)
    # n's x axis lies at azimuth 25, magnetic north at 4: counter-clockwise from x by 21
    assert_allclose(np.degrees(np.arctan2(true_n[:, 1], true_n[:, 0])), 21.0, atol=1e-9)
    direction = np.degrees(np.arctan2(field_n[:, 1], field_n[:, 0])) - 21.0
    assert_chi_square(direction / 3.0)


# ---- the log as a whole ----


def test_same_seed_same_log():
    first, again = (datasets.make("tbm-drive", seed=3, duration=8.0) for _ in range(2))
    other = datasets.make("tbm-drive", seed=4, duration=8.0)
    assert first.rig_text == again.rig_text != other.rig_text
    for one, two, three in zip(first.log_series, again.log_series, other.log_series, strict=True):
        for name, column in one.columns.items():
            assert_array_equal(column, two[name])
        assert any(not np.array_equal(one[name], three[name]) for name in one.columns)


def test_one_sensor_does_not_change_another():
    before = drive(duration=8.0)
    settings = (*SETTINGS, "sensors.prism.sigma_mm=9", "sensors.imu.gyro_density_dps_rthz=0.1")
    after = drive(duration=8.0, settings=settings, prism_rate_hz=2.0, odometer_rate_hz=50.0)
    assert_array_equal(before.log_series[0]["acc"], after.log_series[0]["acc"])
    for topic, column in [("/imu/mag", "field"), ("/truth/odometry", "position")]:
        assert_array_equal(log_of(before, topic)[column], log_of(after, topic)[column])
    assert before.drawn["prism"]["clock_offset_s"] == after.drawn["prism"]["clock_offset_s"]
    assert before.drawn["odometer"] == after.drawn["odometer"]


def test_truth_topic_is_the_truth():
    simulation = drive()
    log = log_of(simulation, "/truth/odometry")
    truth = simulation.truth(seconds_of(simulation, log))
    assert_allclose(log["position"], truth.position, atol=1e-12)
    assert_allclose(Rotation.from_quat(log["quat_xyzw"]).as_matrix(), truth.R, atol=1e-12)
    assert_allclose(np.einsum("nij,nj->ni", truth.R, log["linear"]), truth.velocity, atol=1e-12)
    assert_allclose(log["angular"], truth.omega, atol=1e-12)


def test_without_vibration_the_body_follows_the_path():
    simulation = drive(duration=8.0, vibration=0.0)
    t = np.linspace(0, 8, 50)
    assert_array_equal(simulation.truth(t).position, simulation.truth.undisturbed(t).position)


def test_rig_attached_parses_and_holds_what_was_simulated():
    simulation = drive()
    rig = parse_rig(simulation.rig_text, "rig.yaml")
    assert rig == simulation.rig
    assert set(rig.sensors) == {"imu", "prism", "odometer", "magnetometer"} == set(simulation.clean)
    start = simulation.truth(np.zeros(1))
    assert np.abs(rig.initial.position - start.position[0]).max() < 5 * rig.initial.position_sd


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "tbm"}, "no such dataset"),
        ({"duration": -1.0}, "above 0"),
        ({"wobble": 1}, "no option wobble"),
        ({"settings": ("origin.latitude_deg=null",)}, "latitude_deg is not given"),
    ],
)
def test_what_cannot_be_simulated_is_refused_in_one_line(arguments, message):
    with pytest.raises(TbmfgError, match=message) as refused:
        datasets.make(**{"name": "tbm-drive", "duration": 5.0, **arguments})
    assert "\n" not in str(refused.value)


def test_a_rig_without_tracks_is_refused():
    rig = tbm.rig()
    kept = {name: sensor for name, sensor in rig.sensors.items() if name != "odometer"}
    with pytest.raises(RigError, match="odometer"):
        datasets.make("tbm-drive", duration=5.0, rig=rig.model_copy(update={"sensors": kept}))
