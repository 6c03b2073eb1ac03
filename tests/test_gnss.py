"""Satellite fixes: the ellipsoid, the navigation frame, their accuracy; from there on they are a prism's fixes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import datasets
from tbmfg import earth, gnss
from tbmfg.errors import LogError, RigError
from tbmfg.evaluation.metrics import at_point, trajectory_errors
from tbmfg.geometry import exp_so3, matrix_from_quat, quat_from_matrix
from tbmfg.given import truth_for
from tbmfg.mcap import read_log, write_log
from tbmfg.prepare import prepare
from tbmfg.rig import load_rig, override, parse_rig
from tbmfg.state import POS, ROT, Calibrated, Trajectory
from tbmfg.timeseries import NS, Log, Series

ORIGIN_LLH = np.array([0.7, -1.8, 1600.0])
DEGREES = np.array([180 / np.pi, 180 / np.pi, 1.0])
NORTHWARD = np.array([1e-6, 0.0, 0.0])
ASIDE = np.array([10.0, 20.0, 30.0])
EAST_NORTH_UP_SD = np.array([0.02, 0.01, 0.05])
START_NS = 1_700_000_000 * NS

RIG = "sensors: {imu: {topic: /imu}, gnss: {topic: /fix}}\n"


# ---- the ellipsoid ----


def test_earth_fixed_coordinates_are_the_published_ones():
    """EPSG guidance note 373-7-2, methods 9602 (geocentric) and 9837 (topocentric), to their printed digits."""
    north_sea = np.array([np.radians(53 + 48 / 60 + 33.82 / 3600), np.radians(2 + 7 / 60 + 46.38 / 3600), 73.0])
    assert_allclose(earth.ecef_from_llh(north_sea), [3771793.968, 140253.342, 5124304.349], atol=1e-3)
    origin = np.array([np.radians(55.0), np.radians(5.0), 200.0])
    assert_allclose(earth.n_from_llh(north_sea, origin, np.pi / 2), [-189013.869, -128642.040, -4220.171], atol=1e-3)


def test_pole_and_equator():
    assert_allclose(earth.ecef_from_llh(np.array([0.0, 0.0, 5.0])), [6378142.0, 0.0, 0.0], atol=1e-9)
    pole = np.array([0.0, 0.0, 6356752.314245 + 7.0])
    assert_allclose(earth.ecef_from_llh(np.array([np.pi / 2, 0.0, 7.0])), pole, atol=1e-6)
    assert_allclose(earth.llh_from_ecef(pole), [np.pi / 2, 0.0, 7.0], atol=1e-6)


@given(
    latitude=st.floats(-np.pi / 2, np.pi / 2),
    longitude=st.floats(-np.pi, np.pi),
    height=st.floats(-12e3, 9e3),
    azimuth=st.floats(-10, 10),
)
def test_round_trips(latitude, longitude, height, azimuth):
    """To 10 nm: the rounding of coordinates of 6.4e6 m is 1 nm."""
    ecef = earth.ecef_from_llh(np.array([latitude, longitude, height]))
    assert_allclose(earth.ecef_from_llh(earth.llh_from_ecef(ecef)), ecef, atol=1e-8)
    position_n = np.array([-1200.0, 3400.0, -250.0])
    llh = earth.llh_from_n(position_n, np.array([latitude, longitude, height]), azimuth)
    assert_allclose(earth.n_from_llh(llh, np.array([latitude, longitude, height]), azimuth), position_n, atol=1e-8)


def test_axes_of_n_agree_with_the_earth_rate_and_with_north():
    azimuth = 0.4
    R = earth.R_ne(ORIGIN_LLH[0], ORIGIN_LLH[1], azimuth)
    assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert_allclose(R @ [0.0, 0.0, earth.RATE], earth.rate_n(ORIGIN_LLH[0], azimuth), atol=1e-19)
    north = earth.n_from_llh(ORIGIN_LLH + NORTHWARD, ORIGIN_LLH, azimuth)
    assert np.arctan2(north[1], north[0]) == pytest.approx(earth.north_direction(azimuth), abs=1e-6)


# ---- fixes in n ----


def log_of(position_n, azimuth=np.pi / 2, **columns) -> Log:
    """A log with these positions (n, 3) as fixes, and an IMU that says nothing."""
    n = len(position_n)
    llh = earth.llh_from_n(np.asarray(position_n), ORIGIN_LLH, azimuth) * DEGREES
    cov = np.tile(np.diag(EAST_NORTH_UP_SD**2).ravel(), (n, 1))
    given = {"llh": llh, "cov": cov, "cov_type": np.full(n, 2.0), "status": np.zeros(n)} | columns
    t_ns = START_NS + NS * np.arange(n)
    series = Series("/fix", "sensor_msgs/msg/NavSatFix", t_ns, given)
    return Log("log.mcap", {"/fix": series})


def points(n: int = 5) -> np.ndarray:
    return np.arange(3.0 * n).reshape(n, 3) - [[0.0, 1.0, 2.0]]  # the first at the origin


def test_n_lies_at_the_first_fix_unless_the_rig_places_it():
    log, rig, said = gnss.into_n(log_of(points() + ASIDE), parse_rig(RIG, "rig"))
    assert_allclose(log.series["/fix"]["point"], points() - points()[0], atol=1e-3)  # 30 m of tangent plane apart
    assert [line for line in said if "origin is not given" in line]
    assert rig.origin.latitude == pytest.approx(ORIGIN_LLH[0], abs=1e-5)
    assert rig.origin.rate_n.any()

    latitude, longitude, height = ORIGIN_LLH * DEGREES
    placed = f"origin: {{latitude_deg: {latitude}, longitude_deg: {longitude}, height_m: {height}}}\n" + RIG
    log, rig, said = gnss.into_n(log_of(points() + ASIDE), parse_rig(placed, "rig"))
    assert_allclose(log.series["/fix"]["point"], points() + ASIDE, atol=1e-7)
    assert not said
    assert rig == parse_rig(placed, "rig")


def test_x_axis_of_n_is_where_the_rig_says():
    north_x = "origin: {x_axis_azimuth_deg: 0}\n" + RIG
    east_north_up = points()
    log, _, _ = gnss.into_n(log_of(east_north_up), parse_rig(north_x, "rig"))
    first = east_north_up[0]
    expected = (east_north_up - first)[:, [1, 0, 2]] * [1, -1, 1]  # north, west, up
    assert_allclose(log.series["/fix"]["point"], expected, atol=1e-5)
    assert_allclose(log.series["/fix"]["sigma"], np.tile([0.01, 0.02, 0.05], (5, 1)))


def test_rig_far_from_the_fixes_is_told():
    _, rig, said = gnss.into_n(log_of(points()), parse_rig("origin: {latitude_deg: 47.4}\n" + RIG, "rig"))
    assert len(said) == 1
    assert "origin.latitude_deg 47.4 is not where the fixes are; taken is 40.107046" in said[0]
    assert rig.origin.longitude_deg == pytest.approx(np.degrees(ORIGIN_LLH[1]), abs=1e-4)


def test_messages_without_a_fix_are_dropped_and_said():
    status = np.array([-1.0, 0.0, 1.0, 2.0, -1.0])
    log, rig, said = gnss.into_n(log_of(points(), status=status), parse_rig(RIG, "rig"))
    assert len(log.series["/fix"]) == 3
    assert "gnss: 2 of 5 messages hold no fix" in said
    assert_allclose(log.series["/fix"]["point"][0], 0.0, atol=1e-9)  # the first with a fix
    log, _, said = gnss.into_n(log_of(points(), status=np.full(5, -1.0)), rig)
    assert len(log.series["/fix"]) == 0
    assert said == ["gnss: 5 of 5 messages hold no fix"]


def test_accuracy_is_the_rigs_else_the_fixs_own_else_assumed():
    fixed = parse_rig(RIG.replace("/fix}", "/fix, sigma_m: 0.3}"), "rig")
    assert_allclose(gnss.into_n(log_of(points()), fixed)[0].series["/fix"]["sigma"], 0.3)

    diagonal = "origin: {x_axis_azimuth_deg: 45}\n" + RIG
    sigma = gnss.into_n(log_of(points()), parse_rig(diagonal, "rig"))[0].series["/fix"]["sigma"]
    horizontal = np.sqrt((0.02**2 + 0.01**2) / 2)
    assert_allclose(sigma, np.tile([horizontal, horizontal, 0.05], (5, 1)))

    unknown = np.array([2.0, 0.0, 3.0, 1.0, 2.0])
    cov = log_of(points()).series["/fix"]["cov"].copy()
    cov[4] = 0.0  # known, says the message, and zero
    log, _, said = gnss.into_n(log_of(points(), cov_type=unknown, cov=cov), parse_rig(RIG, "rig"))
    assert_allclose(log.series["/fix"]["sigma"][[0, 2, 3]], np.tile(EAST_NORTH_UP_SD, (3, 1)))
    assert_allclose(log.series["/fix"]["sigma"][[1, 4]], np.tile(gnss.ASSUMED_SIGMA_ENU, (2, 1)))
    assert any("2 of 5 fixes do not say how accurate they are" in line for line in said)


def test_a_prism_beside_needs_a_common_origin():
    both = parse_rig(RIG.replace("/fix}", "/fix}, prism: {topic: /prism}"), "rig")
    with pytest.raises(RigError, match="where a prism and gnss share it"):
        gnss.into_n(log_of(points()), both)


def test_another_type_is_refused():
    log = log_of(points())
    log.series["/fix"] = Series("/fix", "geometry_msgs/msg/PointStamped", log.series["/fix"].t_ns, {"point": points()})
    with pytest.raises(LogError, match=r"/fix is geometry_msgs/msg/PointStamped; it should be sensor_msgs/msg/NavSatF"):
        gnss.into_n(log, parse_rig(RIG, "rig"))


# ---- the same problem as with a prism ----


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """A simulated drive as log and rig: with its prism, and with the same track as fixes of an antenna."""
    simulation = datasets.make("tbm-drive", seed=3, duration=12.0, imu_rate_hz=100.0)
    prism_rig = simulation.rig.model_copy(
        update={"sensors": {name: simulation.rig.sensors[name] for name in ("imu", "prism")}}
    )
    prism = prism_rig.sensors["prism"]
    latitude, longitude, height = map(float, ORIGIN_LLH * DEGREES)
    place = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}
    gnss_fields = {"topic": "/fix", "arm_m": prism.arm_m, "arm_sd_m": prism.arm_sd_m, "sigma_m": 0.003}
    sensors = {"imu": prism_rig.imu, "gnss": gnss.Gnss(**gnss_fields)}
    origin = prism_rig.origin.model_copy(update=place)
    prism_rig = prism_rig.model_copy(
        update={
            "origin": origin,
            "sensors": {"imu": prism_rig.imu, "prism": prism.model_copy(update={"sigma_ppm": 0.0})},
        }
    )
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    track = next(series for series in simulation.log_series if series.topic == prism.topic)
    llh = earth.llh_from_n(track["point"], ORIGIN_LLH, origin.x_axis_azimuth) * DEGREES
    status = np.zeros(len(track))
    status[5] = -1
    fixes = Series("/fix", "sensor_msgs/msg/NavSatFix", track.t_ns, {"llh": llh, "status": status})
    write_log(path, [*simulation.log_series, fixes])
    log = read_log(path)
    kept = np.arange(len(track)) != 5
    log.series[prism.topic] = replace(log.series[prism.topic].select(kept))
    return log, prism_rig, prism_rig.model_copy(update={"sensors": sensors})


def test_a_fix_makes_the_rows_that_a_prism_makes(drives):
    log, prism_rig, gnss_rig = drives
    by_prism, by_gnss = prepare(log, prism_rig), prepare(log, gnss_rig)
    assert_allclose(by_gnss.keyframes_s, by_prism.keyframes_s)
    expected = next(rows for rows in by_prism.rows if rows.sensor == "prism")
    rows = next(rows for rows in by_gnss.rows if rows.sensor == "gnss")
    assert (rows.model, rows.loss) == (expected.model, gnss_rig.sensors["gnss"].loss)
    # coordinates of 6.4e6 m in degrees are rounded to a nanometre or two
    assert_allclose(rows.z, expected.z, atol=1e-8)
    assert_allclose(rows.data, expected.data)
    assert_allclose(rows.sigma, expected.sigma)
    assert [name.replace("gnss", "prism") for name in by_gnss.parameters.names] == list(by_prism.parameters.names)


def test_the_noise_of_fixes_is_found(drives):
    log, _, rig = drives
    found = prepare(log, override(rig, ["sensors.gnss.noise_factor=auto", "sensors.imu.noise_factor=1"]))
    factor = found.calibration["gnss_noise_factor"]
    assert factor.sd < 0.15
    assert factor.value == pytest.approx(1.0, abs=3.3 * factor.sd)


def test_every_fix_is_counted_once(drives):
    from tbmfg.estimators import estimate

    log, _, rig = drives
    counts = estimate("ins", prepare(log, rig, outages=(("gnss", 3.0, 5.0),))).counts["gnss"]
    assert counts.parts() == counts.received == 60
    assert counts.unused >= 1  # the one without a fix
    assert counts.outage == 10


# ---- a truth that is the track of a point ----


def trajectory(n: int = 50) -> Trajectory:
    rng = np.random.default_rng(4)
    R = exp_so3(rng.standard_normal((n, 3)))
    root = rng.standard_normal((n, 15, 15))
    t_ns = START_NS + 100_000_000 * np.arange(n)
    zero = np.zeros((n, 3))
    cov = root @ root.transpose(0, 2, 1)
    return Trajectory(t_ns, rng.standard_normal((n, 3)), quat_from_matrix(R), zero, zero, zero, cov)


def test_covariance_of_a_point_is_that_of_its_perturbed_positions():
    arm, at = np.array([0.7, -0.4, 1.9]), trajectory(1)
    moved = at_point(at, arm)
    R = matrix_from_quat(at.quat_xyzw)[0]
    assert_allclose(moved.position_n[0], at.position_n[0] + R @ arm)
    rng = np.random.default_rng(7)
    small = 1e-8 * at.cov[0]
    d = rng.multivariate_normal(np.zeros(15), small, size=200_000)
    p = at.position_n[0] + d[:, POS] + (R @ exp_so3(d[:, ROT])) @ arm
    # an entry's relative error is about sqrt(2 / 200 000) = 0.3 % of the variances; four times that
    scale = 1e-8 * np.sqrt(np.outer(*2 * [np.diag(moved.cov[0, POS, POS])]))
    assert_allclose(np.cov(p.T) / scale, 1e-8 * moved.cov[0, POS, POS] / scale, atol=0.013)


ARM = np.array([0.7, -0.4, 1.9])


def track(at: Trajectory, late_ns: int) -> Log:
    """The exact track of a point at ARM as truth, stamped late."""
    point = at.position_n + matrix_from_quat(at.quat_xyzw) @ ARM
    series = Series("/truth", "geometry_msgs/msg/PoseStamped", at.t_ns + late_ns, {"position": point})
    return Log("log.mcap", {"/truth": series})


def test_truth_of_a_point_with_an_arm_is_met_exactly():
    at = trajectory()
    rig = parse_rig(RIG + "truth: {topic: /truth, arm_m: [0.7, -0.4, 1.9]}", "rig")
    truth = truth_for("/truth", track(at, 0), rig, {}, 0)
    errors = trajectory_errors(at, truth)
    assert len(errors.rows) == len(at)
    assert_allclose(errors.position_n, 0.0, atol=1e-12)
    without_arm = trajectory_errors(at, replace(truth, arm_b=np.zeros(3)))
    assert_allclose(np.linalg.norm(without_arm.position_n, axis=1), np.linalg.norm(ARM))


def test_truth_of_a_sensors_point_takes_arm_and_clock_as_found():
    """Stamps 0.2 s early, two keyframes; without the sensor its entry in the rig counts."""
    at = trajectory()
    found = {
        "gnss_clock_offset_s": Calibrated(-0.2, 0.01, True),
        "gnss_clock_drift_ppm": Calibrated(0.0, 0.0, False),
        "gnss_lever_arm_m": Calibrated(tuple(ARM), (0.01, 0.01, 0.01), True),
    }
    for entry, calibration in (("", found), (", arm_m: [0.7, -0.4, 1.9], clock_offset_s: -0.2", {})):
        rig = parse_rig(RIG.replace("/fix}", f"/fix{entry}}}") + "truth: {topic: /truth, sensor: gnss}", "rig")
        errors = trajectory_errors(at, truth_for("/truth", track(at, -NS // 5), rig, calibration, 0))
        assert len(errors.rows) == len(at)
        assert_allclose(errors.position_n, 0.0, atol=1e-12)


def test_faults_of_origin_and_truth():
    with pytest.raises(RigError, match=r"truth\.sensor: should be a sensor of positions \(gnss\)"):
        parse_rig(RIG + "truth: {topic: /truth, sensor: prism}", "rig")
    with pytest.raises(RigError, match=r"truth\.arm_m: should be left out, it is that of gnss"):
        parse_rig(RIG + "truth: {topic: /truth, sensor: gnss, arm_m: [0, 0, 1]}", "rig")
    with pytest.raises(RigError, match=r"origin\.longitude_deg: should come with latitude_deg"):
        parse_rig(RIG + "origin: {longitude_deg: 8}", "rig")


def test_rtk_drive_levels_what_its_unit_reads_at_rest():
    """The unit lies at an angle on the roof; turned into b it feels gravity along z at rest, but for the slope."""
    felt_b = load_rig("rtk-drive").imu.T_bi.R @ [0.118, 0.031, 1.006]
    assert np.degrees(np.arccos(felt_b[2] / np.linalg.norm(felt_b))) < 3.0
