"""A rig from a log alone: roles, mounting from /tf_static, what is left out, and that every guess is said."""

import numpy as np
import pytest
from mcap_samples import START_NS, data
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from tbmfg import cli
from tbmfg.errors import LogError
from tbmfg.geometry import quat_from_matrix, rotation_from_rpy
from tbmfg.inference import infer, starter
from tbmfg.mcap import read_log, write_log
from tbmfg.rig import load_rig, parse_rig
from tbmfg.timeseries import NS, Log, Series, StreamCounts, Transform

DEG = np.pi / 180
LEVEL = np.eye(3)
ON_SIDE = rotation_from_rpy(np.array([90.0, 0.0, -90.0]) * DEG)  # IMU axes to base_link: y up, z backwards


def stamps(rate_hz, duration_s=60.0):
    return START_NS + (np.arange(round(duration_s * rate_hz)) * (NS / rate_hz)).astype(np.int64)


def speed(t_s):
    """Driving on and off, m/s; its derivative is the forward acceleration."""
    return 0.5 + 0.4 * np.sin(0.7 * t_s), 0.28 * np.cos(0.7 * t_s)


def imu(topic="/imu", frame="imu_link", R_base_imu=LEVEL, rate_hz=100.0, seed=0):
    rng = np.random.default_rng(seed)
    t_ns = stamps(rate_hz)
    force = np.tile([0.0, 0.0, 9.81], (len(t_ns), 1))
    force[:, 0] = speed((t_ns - START_NS) * 1e-9)[1]
    columns = {
        "gyro": 0.01 * rng.standard_normal(force.shape),
        "acc": force @ R_base_imu + 0.05 * rng.standard_normal(force.shape),
    }
    counts = StreamCounts(received=len(t_ns))
    return Series(topic, "sensor_msgs/msg/Imu", t_ns, columns, frame, counts=counts)


def odometry(topic="/wheel/odom", axis=0, cov=0.0, noise=0.0):
    t_ns = stamps(20.0)
    linear = noise * np.random.default_rng(1).standard_normal((len(t_ns), 3))
    linear[:, axis] += speed((t_ns - START_NS) * 1e-9)[0]
    columns = {"linear": linear, "angular": np.zeros_like(linear), "twist_cov": np.zeros((len(t_ns), 36))}
    columns["twist_cov"][:, 0] = cov
    return Series(topic, "nav_msgs/msg/Odometry", t_ns, columns, "odom", "base_link")


def points(topic="/prism", n=100):
    columns, counts = {"point": np.ones((n, 3))}, StreamCounts(received=n)
    return Series(topic, "geometry_msgs/msg/PointStamped", stamps(5.0)[:n], columns, "station", counts=counts)


def fixes(status=0.0, latitude=47.0, sigma=0.02):
    t_ns = stamps(2.0)
    llh = np.tile([latitude, 8.0, 400.0], (len(t_ns), 1))
    cov = np.tile(sigma**2 * np.eye(3).ravel(), (len(t_ns), 1))
    columns = {"llh": llh, "cov": cov, "cov_type": np.full(len(t_ns), 2.0), "status": np.full(len(t_ns), status)}
    return Series("/fix", "sensor_msgs/msg/NavSatFix", t_ns, columns, "antenna")


def field(size_t=50e-6, topic="/imu/mag"):
    columns = {"field": np.tile([0.5 * size_t, 0.0, -np.sqrt(0.75) * size_t], (200, 1))}
    return Series(topic, "sensor_msgs/msg/MagneticField", stamps(20.0)[:200], columns, "imu_link")


def pressure(size=95_000.0):
    return Series("/baro", "sensor_msgs/msg/FluidPressure", stamps(20.0)[:200], {"pressure": np.full(200, size)}, "b")


def log_of(*series, transforms=(), **more):
    return Log("drive.mcap", {one.topic: one for one in series}, transforms=tuple(transforms), **more)


def frame(parent, child, xyz=(0.0, 0.0, 0.0), R=LEVEL):
    return Transform(parent, child, tuple(xyz), tuple(quat_from_matrix(R)))


def said(inferred):
    return "\n".join(inferred.lines())


# ---- roles ----


def test_every_kind_finds_its_place():
    inferred = infer(log_of(imu(), points(), odometry(), field(), pressure()))
    assert {name: sensor.topic for name, sensor in inferred.rig.sensors.items()} == {
        "imu": "/imu",
        "prism": "/prism",
        "odometer": "/wheel/odom",
        "magnetometer": "/imu/mag",
        "barometer": "/baro",
    }
    assert inferred.rig.name == "drive"
    assert inferred.rig.imu.noise_factor == "auto"
    for name in inferred.rig.sensors:
        assert f"assumed sensors.{name}.topic: " in said(inferred)
    assert inferred.unused == {}


def test_latitude_and_antenna_by_satellite():
    inferred = infer(log_of(imu(), fixes()))
    assert inferred.rig.sensors["gnss"].topic == "/fix"
    assert inferred.rig.origin.latitude_deg == pytest.approx(47.0)


def test_coarse_fixes_calibrate_nothing():
    fine, coarse = (infer(log_of(imu(), fixes(sigma=sigma))).rig.sensors["gnss"] for sigma in (0.02, 2.0))
    assert fine.arm_sd_m > 0
    assert fine.clock_offset_sd_s > 0
    assert coarse.arm_sd_m == coarse.clock_offset_sd_s == 0.0


def test_without_a_fix_there_is_no_gnss():
    inferred = infer(log_of(imu(), fixes(status=-1.0), points()))
    assert "gnss" not in inferred.rig.sensors
    assert inferred.rig.origin.latitude_deg is None
    assert "no Earth rate" in said(inferred)


def test_beside_a_prism_fixes_give_the_latitude_only():
    inferred = infer(log_of(imu(), fixes(), points()))
    assert "gnss" not in inferred.rig.sensors
    assert inferred.rig.origin.latitude_deg == pytest.approx(47.0)
    assert "how the prism's frame lies on Earth" in inferred.unused["/fix"]


@pytest.mark.parametrize(
    ("series", "reason"),
    [
        (field(5e-6), "typically 5 uT"),
        (field(0.5), "in gauss"),
        (pressure(950.0), "in hPa"),
        (odometry("/cmd_vel"), "a command"),
        (odometry("/odometry/filtered"), "another estimator's result"),
        (odometry(noise=1.0), "no odometer's"),
        (points("/prism", n=2), "2 usable of 2 messages"),
    ],
)
def test_what_cannot_be_a_sensor_is_left_out_and_said(series, reason):
    inferred = infer(log_of(imu(), series))
    assert list(inferred.rig.sensors) == ["imu"]
    assert reason in inferred.unused[series.topic]
    assert f"not used: {series.topic}: " in said(inferred)


def test_topics_without_a_model_are_named():
    inferred = infer(log_of(imu(), points(), unknown={"/image": "sensor_msgs/msg/Image", "/magn": "x/msg/Vector"}))
    assert inferred.unused["/image"] == "sensor_msgs/Image is not read"
    assert "sensor_msgs/MagneticField" in inferred.unused["/magn"]


def test_of_two_the_longer_one_is_taken():
    inferred = infer(log_of(imu(), points("/prism/a", 50), points("/prism/b", 80)))
    assert inferred.rig.sensors["prism"].topic == "/prism/b"
    assert "/prism/b is the prism" in inferred.unused["/prism/a"]


def test_truth_is_compared_with_and_never_used():
    truth = Series("/ground_truth", "nav_msgs/msg/Odometry", stamps(5.0), dict(odometry().columns))
    inferred = infer(log_of(imu(), truth, points()))
    assert inferred.rig.truth.topic == "/ground_truth"
    assert "odometer" not in inferred.rig.sensors


def test_what_the_log_cannot_tell_is_said():
    assert "position counts from the start" in said(infer(log_of(imu(), odometry())))
    assert "heading counts from the start" in said(infer(log_of(imu(), odometry())))
    assert "counts from the start" not in said(infer(log_of(imu(), fixes())))


# ---- the IMU ----


def test_the_machines_imu_is_taken_not_that_of_a_camera():
    fast = imu("/camera/imu", "camera_imu", rate_hz=400.0)
    inferred = infer(log_of(fast, imu()))
    assert inferred.rig.imu.topic == "/imu"
    assert "another IMU" in inferred.unused["/camera/imu"]


def test_a_stuck_imu_is_passed_over():
    stuck = imu("/imu/a", rate_hz=200.0)
    stuck.columns["gyro"][:] = 0.0
    assert infer(log_of(stuck, imu("/imu/b"))).rig.imu.topic == "/imu/b"


def test_wrong_units_are_said_beside_the_imu():
    wrong = imu()
    wrong.columns["acc"][:] /= 9.80665
    inferred = infer(log_of(wrong, points()))
    assert "set sensors.imu.acc_unit=g" in said(inferred)
    assert inferred.rig.imu.acc_unit == "m/s^2"


def test_without_an_imu_the_log_is_refused_by_what_it_has():
    with pytest.raises(
        LogError, match=r"drive\.mcap: no sensor_msgs/Imu .* it has /prism \(geometry_msgs/PointStamped"
    ):
        infer(log_of(points()))
    with pytest.raises(LogError, match=r"unusable: /imu \(sensor_msgs/msg/Imu \(message encoding 'json'\)\)"):
        infer(log_of(points(), unknown={"/imu": "sensor_msgs/msg/Imu (message encoding 'json')"}))
    empty = imu().select(slice(0, 0))
    with pytest.raises(LogError, match="0 usable of 6000 messages"):
        infer(log_of(empty))


# ---- mounting ----


def test_static_transforms_turn_an_imu_on_its_side():
    transforms = [
        frame("base_link", "mast", (1.0, 0.0, 2.0)),
        frame("mast", "imu_link", (0.0, 0.5, 0.0), ON_SIDE),
        frame("base_link", "antenna", (0.0, 0.0, 3.0)),
    ]
    inferred = infer(log_of(imu(R_base_imu=ON_SIDE), odometry(), fixes(), field(), transforms=transforms))
    rig = inferred.rig
    assert_allclose(rig.imu.T_bi.R, ON_SIDE, atol=1e-6)
    assert_allclose(rig.sensors["odometer"].arm, [-1.0, -0.5, -2.0], atol=1e-6)
    assert_allclose(rig.sensors["gnss"].arm, [-1.0, -0.5, 1.0], atol=1e-6)
    assert rig.sensors["odometer"].yaw_deg == rig.sensors["odometer"].pitch_deg == 0.0
    assert_allclose(rig.sensors["magnetometer"].R_bm, ON_SIDE, atol=1e-6)
    assert "b has the axes of base_link" in said(inferred)
    assert "points up" not in said(inferred)


def test_a_prism_is_found_by_the_name_of_its_frame():
    transforms = [frame("base_link", "imu_link"), frame("base_link", "prism_mount", (0.1, 0.2, 0.3))]
    prism = infer(log_of(imu(), points(), transforms=transforms)).rig.sensors["prism"]
    assert prism.arm_m == (0.1, 0.2, 0.3)
    assert prism.arm_sd_m < infer(log_of(imu(), points())).rig.sensors["prism"].arm_sd_m


def test_namespaces_and_leading_slashes():
    transforms = [frame("/robot/base_link", "imu_link", R=ON_SIDE)]
    assert_allclose(infer(log_of(imu(frame="/imu_link"), transforms=transforms)).rig.imu.T_bi.R, ON_SIDE, atol=1e-6)


def test_without_transforms_forward_is_where_the_odometers_acceleration_is_felt():
    inferred = infer(log_of(imu(R_base_imu=ON_SIDE), odometry()))
    assert_allclose(inferred.rig.imu.T_bi.R, np.eye(3))
    odometer = inferred.rig.sensors["odometer"]
    forward_b = rotation_from_rpy(np.array([0.0, odometer.pitch, odometer.yaw]))[:, 0]
    assert_allclose(forward_b, ON_SIDE.T @ [1.0, 0.0, 0.0], atol=1e-9)
    assert "b's y axis points up, not z" in said(inferred)
    assert "forward is b's -z axis" in said(inferred)


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, -90.0, 180.0])
def test_forward_axis_of_an_upright_imu(yaw_deg):
    R = rotation_from_rpy(np.array([0.0, 0.0, -yaw_deg]) * DEG)
    assert infer(log_of(imu(R_base_imu=R), odometry())).rig.sensors["odometer"].yaw_deg == yaw_deg


def test_an_odometer_without_a_known_forward_axis_is_left_out():
    standing = odometry()
    standing.columns["linear"][:] = 0.0
    inferred = infer(log_of(imu(R_base_imu=ON_SIDE), standing))
    assert "which of its axes points forward" in inferred.unused["/wheel/odom"]
    assert "odometer" in infer(log_of(imu(), standing)).rig.sensors  # upright: forward is x


def test_transforms_that_the_motion_contradicts_are_said():
    R = rotation_from_rpy(np.array([0.0, 0.0, 90.0]) * DEG)
    inferred = infer(log_of(imu(R_base_imu=R), odometry(), transforms=[frame("base_link", "imu_link")]))
    assert "felt along b's -y: check /tf_static" in said(inferred)


def test_the_stated_accuracy_of_an_odometer():
    assert infer(log_of(imu(), odometry(cov=0.0025))).rig.sensors["odometer"].sigma_mps == pytest.approx(0.05)
    default = infer(log_of(imu(), odometry())).rig.sensors["odometer"].sigma_mps
    assert infer(log_of(imu(), odometry(cov=1e6))).rig.sensors["odometer"].sigma_mps == default


# ---- a starter file ----


def test_starter_reads_back_and_says_its_guesses():
    inferred = infer(log_of(imu(), points(), field(5e-6), unknown={"/a b\n": "x/msg/Y"}))
    text = starter(inferred, "drive.mcap")
    assert parse_rig(text, "rig.yaml") == inferred.rig
    lines = text.splitlines()
    assert "  prism:" in lines
    assert next(line for line in lines if "arm_sd_m:" in line).strip().startswith("arm_sd_m: 0.5")
    assert next(line for line in lines if "T_bi:" in line).endswith("# GUESSED: nothing links imu_link to base_link: "
                                                                    "b is the IMU's own frame")  # fmt: skip
    assert any(line.startswith("#   /imu/mag: its field is typically 5 uT") for line in lines)
    for one in inferred.assumptions:
        assert one.reason in text


@pytest.mark.parametrize("topic", ["/a: b", "/#imu", "/it's", '/"q"', "/" + "long" * 60, "/\u00fcber"])
def test_starter_survives_any_topic(topic):
    inferred = infer(log_of(imu(topic), points()))
    assert parse_rig(starter(inferred, "x.mcap"), "rig.yaml") == inferred.rig


def tbmfg(*arguments):
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments], prog_name="tbmfg")


def test_init_writes_once(tmp_path):
    log, rig = tmp_path / "drive.mcap", tmp_path / "rig.yaml"
    write_log(log, [imu(), points(), odometry()])
    ran = tbmfg("init", log, "-o", rig)
    assert ran.exit_code == 0, ran.output
    assert "assumed sensors.imu.T_bi: nothing links imu_link to base_link" in ran.stdout
    assert f"rig: {rig}" in ran.stdout
    assert list(load_rig(rig).sensors) == ["imu", "prism", "odometer"]
    rig.write_text("mine")
    ran = tbmfg("init", log, "-o", rig)
    assert ran.exit_code == 1
    assert ran.stderr == f"tbmfg: {rig}: exists already; give another name, or --force to replace it\n"
    assert rig.read_text() == "mine"
    assert tbmfg("init", log, "-o", rig, "--force").exit_code == 0
    assert tbmfg("init", log, "-o", tmp_path).exit_code == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive.mcap", "rig.yaml"]


# ---- real recordings ----


@pytest.mark.parametrize(
    ("name", "sensors"),
    [
        ("euroc_mh01_imu_leica.mcap", {"imu": "/imu0", "prism": "/leica/position"}),
        (
            "husky_imu_odom_fix.mcap",
            {"imu": "/imu/data", "gnss": "/fix", "odometer": "/husky_velocity_controller/odom"},
        ),
        ("xsens_mtig_imu_mag_gps_scan.mcap", {"imu": "/imu_data", "gnss": "/position_gps"}),
    ],
)
def test_recordings(name, sensors):
    inferred = infer(read_log(data(name)))
    assert {name: sensor.topic for name, sensor in inferred.rig.sensors.items()} == sensors
    assert parse_rig(starter(inferred, name), "rig.yaml") == inferred.rig


def test_husky_drives_along_its_imus_minus_z():
    inferred = infer(read_log(data("husky_imu_odom_fix.mcap")))
    assert inferred.rig.sensors["odometer"].pitch_deg == 90.0
    assert inferred.rig.origin.latitude_deg == pytest.approx(42.38, abs=0.01)
    assert "b's y axis points up" in said(inferred)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["euroc_mh01_imu_leica.mcap", "husky_imu_odom_fix.mcap", "xsens_mtig_imu_mag_gps_scan.mcap"]
)
def test_recordings_run_without_a_rig(name, tmp_path):
    ran = tbmfg("run", data(name), "-o", tmp_path / "out", "--estimator", "ins")
    assert ran.exit_code == 0, ran.output
    assert "assumed sensors.imu.T_bi" in ran.stdout
    assert tbmfg("run", data(name), "-o", tmp_path / "again", "--estimator", "ins", "--rig",
                 tmp_path / "out" / "rig.yaml").exit_code == 0  # fmt: skip


def test_a_recording_without_imu_is_refused_in_one_line(tmp_path):
    for command in ("run", "init"):
        ran = tbmfg(command, data("nav2_turtlebot.mcap"), "-o", tmp_path / "out")
        assert ran.exit_code == 1
        assert ran.stderr.count("\n") == 1
        assert "no sensor_msgs/Imu" in ran.stderr
        assert "/odom (nav_msgs/Odometry)" in ran.stderr
    assert not list(tmp_path.iterdir())
