"""The description of a log: rates, gaps, roles, and what is wrong with the clocks."""

import numpy as np
import pytest
from mcap_samples import START_NS, data, sample

from tbmfg.mcap import describe, info_text, write_log
from tbmfg.mcap.info import Gap, clock_problems, guess_role, unit_problems
from tbmfg.timeseries import NS, Series, StreamCounts, Transform

IMU, POINT = "sensor_msgs/msg/Imu", "geometry_msgs/msg/PointStamped"


def series(t_s, topic="/prism", start_ns=START_NS):
    t_ns = start_ns + np.round(np.asarray(t_s) * NS).astype(np.int64)
    return Series(topic, POINT, t_ns, {"point": np.ones((len(t_ns), 3))}, "station")


def only_topic(path):
    (topic,) = describe(path).topics
    return topic


# ---- real recordings ----


def test_euroc():
    about = describe(data("euroc_mh01_imu_leica.mcap"))
    assert {topic.topic: topic.role for topic in about.topics} == {
        "/imu0": "imu",
        "/leica/position": "prism",
        "/truth/pose": "truth",
    }
    imu, prism, _ = about.topics
    assert (imu.messages, prism.messages) == (36820, 3099)
    assert imu.rate_hz == pytest.approx(200, abs=0.01)
    assert imu.interval_s == pytest.approx(0.005, abs=1e-6)
    assert imu.log_delay_s == (0, 0, 0)
    assert imu.problems == ()
    assert prism.gaps[0].length_s == pytest.approx(0.647, abs=1e-3)
    assert (about.end_ns - about.start_ns) * 1e-9 == pytest.approx(187.76, abs=0.01)


def test_husky():
    about = describe(data("husky_imu_odom_fix.mcap"))
    assert [topic.role for topic in about.topics] == ["gnss", "odometer", "imu"]
    assert about.topics[2].log_delay_s[1] == pytest.approx(0.025, abs=0.002)


def test_xsens():
    about = describe(data("xsens_mtig_imu_mag_gps_scan.mcap"))
    velocity = next(topic for topic in about.topics if topic.topic == "/velocity")
    assert velocity.counts == StreamCounts(received=712, duplicate=356)
    assert velocity.rate_hz == pytest.approx(20, abs=0.1)
    info = next(topic for topic in about.topics if topic.topic == "/info_gps")
    assert (info.role, info.messages, info.counts) == ("unknown", 356, None)
    assert "/info_gps" in about.unknown


def test_simulated_clock_is_noticed():
    about = describe(data("nav2_turtlebot.mcap"))
    odometry = next(topic for topic in about.topics if topic.topic == "/odom")
    assert any("stamps lie 20581.4 days before the log times" in problem for problem in odometry.problems)
    assert len(about.transforms) == 29


@pytest.mark.parametrize(
    "name",
    [
        "euroc_mh01_imu_leica.mcap",
        "husky_imu_odom_fix.mcap",
        "nav2_turtlebot.mcap",
        "xsens_mtig_imu_mag_gps_scan.mcap",
    ],
)
def test_text_names_every_topic(name):
    text = info_text(describe(data(name)))
    for topic in describe(data(name)).topics:
        assert sum(line.split()[:1] == [topic.topic] for line in text.splitlines()) == 1
    assert "nan" not in text


# ---- made to measure ----


@pytest.mark.parametrize(
    ("topic", "type", "role"),
    [
        ("/imu/data", "sensor_msgs/msg/Imu", "imu"),
        ("/leica/position", "geometry_msgs/msg/PointStamped", "prism"),
        ("/laser_spot", "geometry_msgs/msg/PointStamped", "laser"),
        ("/wheel/odom", "nav_msgs/msg/Odometry", "odometer"),
        ("/truth/odometry", "nav_msgs/msg/Odometry", "truth"),
        ("/ground_truth", "geometry_msgs/msg/PoseStamped", "truth"),
        ("/pose", "geometry_msgs/msg/PoseStamped", "unknown"),
        ("/wheel", "geometry_msgs/msg/TwistStamped", "odometer"),
        ("/wheel", "geometry_msgs/msg/TwistWithCovarianceStamped", "odometer"),
        ("/mag", "sensor_msgs/msg/MagneticField", "magnetometer"),
        ("/baro", "sensor_msgs/msg/FluidPressure", "barometer"),
        ("/fix", "sensor_msgs/msg/NavSatFix", "gnss"),
        ("/points", "sensor_msgs/msg/PointCloud2", "lidar"),
        ("/truth/imu", "sensor_msgs/msg/Imu", "imu"),
        ("/rosout", "rcl_interfaces/msg/Log", "unknown"),
    ],
)
def test_roles(topic, type, role):
    assert guess_role(topic, type) == role


def test_gaps_count_from_the_first_imu_sample(tmp_path):
    t_s = np.delete(np.arange(100) * 0.1, np.r_[20:30, 50:56])
    imu = sample(IMU, 400)
    write_log(tmp_path / "x.mcap", [series(t_s, start_ns=int(imu.t_ns[0]) + 2 * NS), imu])
    prism = next(topic for topic in describe(tmp_path / "x.mcap").topics if topic.role == "prism")
    assert prism.gaps == (Gap(pytest.approx(3.9), pytest.approx(1.1)), Gap(pytest.approx(6.9), pytest.approx(0.7)))
    assert prism.interval_s == pytest.approx(0.1)
    assert "longest: 1.10 s at 3.90 s, 0.70 s at 6.90 s" in info_text(describe(tmp_path / "x.mcap"))


def test_gaps_without_an_imu_count_from_the_topic(tmp_path):
    write_log(tmp_path / "x.mcap", [series([0, 1, 2, 3, 9, 10])])
    assert only_topic(tmp_path / "x.mcap").gaps == (Gap(3.0, 6.0),)


def test_a_single_message_has_no_rate(tmp_path):
    write_log(tmp_path / "x.mcap", [series([0])])
    topic = only_topic(tmp_path / "x.mcap")
    assert np.isnan([topic.rate_hz, topic.interval_s]).all()
    assert "nan" not in info_text(describe(tmp_path / "x.mcap"))


def test_delay_and_counts(tmp_path):
    prism = series(np.arange(20) * 0.1)
    prism["point"][4] = np.nan
    log_ns = prism.t_ns + np.linspace(10e6, 30e6, 20).astype(np.int64)
    write_log(tmp_path / "x.mcap", [prism], log_ns={"/prism": log_ns})
    topic = only_topic(tmp_path / "x.mcap")
    assert topic.log_delay_s == pytest.approx((0.01, 0.02, 0.03), abs=1e-6)
    assert topic.counts == StreamCounts(received=20, nonfinite=1)
    assert topic.problems == ()
    assert "1 of 20 messages hold a NaN or infinity" in info_text(describe(tmp_path / "x.mcap"))


def test_text_lists_transforms_attachments_and_damage(tmp_path):
    path = tmp_path / "x.mcap"
    transform = Transform("base_link", "prism", (1.0, 2.5, 3.0), (0.0, 0.0, 0.0, 1.0))
    write_log(path, [sample(IMU, 300)], transforms=[transform], attachments={"rig.yaml": b"12345"}, chunk_size=9000)
    broken = bytearray(path.read_bytes())
    broken[len(broken) // 2] ^= 1
    path.write_bytes(broken)
    text = info_text(describe(path))
    assert "base_link <- prism: 1 2.5 3 m, xyzw 0 0 0 1" in text
    assert "rig.yaml: 5 bytes" in text
    assert "skipped: " in text
    assert "/tf_static" in text


@pytest.mark.parametrize(
    ("type", "column", "size", "said"),
    [
        (IMU, "acc", 1.0, "in g"),
        ("sensor_msgs/msg/MagneticField", "field", 0.48, "in gauss"),
        ("sensor_msgs/msg/MagneticField", "field", 48.0, "in microtesla"),
        ("sensor_msgs/msg/FluidPressure", "pressure", 101.3, "in kPa"),
        ("sensor_msgs/msg/FluidPressure", "pressure", 1013.0, "in hPa"),
        (IMU, "acc", 9.8, ""),
        ("sensor_msgs/msg/MagneticField", "field", 48e-6, ""),
        ("sensor_msgs/msg/FluidPressure", "pressure", 101_300.0, ""),
    ],
)
def test_wrong_units(type, column, size, said):
    series = sample(type, 30)
    values = series[column].reshape(30, -1)
    series.columns[column] = (size * values / np.linalg.norm(values, axis=1, keepdims=True)).reshape(
        series[column].shape
    )
    problems = unit_problems(series)
    assert len(problems) == bool(said)
    assert said in "".join(problems)


# ---- clocks ----

T_NS = START_NS + np.arange(100) * 100_000_000


def test_a_sound_clock_has_no_problems():
    jitter_ns = np.random.default_rng(0).integers(0, 50_000_000, 100)
    assert clock_problems(T_NS, T_NS + jitter_ns) == ()


@pytest.mark.parametrize("n", [0, 1])
def test_too_few_stamps_to_judge(n):
    assert clock_problems(T_NS[:n], T_NS[:n]) == ()


def test_zero_stamps():
    stamps = T_NS.copy()
    stamps[[3, 50]] = 0
    assert clock_problems(stamps, T_NS) == ("2 of 100 stamps are zero",)
    assert clock_problems(np.zeros_like(T_NS), T_NS) == ("100 of 100 stamps are zero",)


def test_stamps_that_jump_back():
    stamps = T_NS.copy()
    stamps[60] -= 350_000_000
    assert clock_problems(stamps, T_NS) == ("stamps jump back 1 times, by up to 250.0 ms",)


def test_stamps_that_jump_ahead():
    stamps = T_NS.copy()
    stamps[40:] += 5 * NS
    assert clock_problems(stamps, T_NS)[0] == "stamps jump ahead of the log times by 5.0 s, 4.0 s into the topic"


def test_stamps_of_another_clock():
    assert clock_problems(T_NS - 7200 * NS, T_NS) == (
        "stamps lie 2.0 h before the log times: not the recorder's clock",
    )
    assert clock_problems(T_NS + 30 * NS, T_NS) == ("stamps lie 30.0 s after the log times: not the recorder's clock",)


def test_a_clock_that_drifts():
    drift_ns = np.linspace(0, 0.5 * NS, 100).astype(np.int64)
    (problem,) = clock_problems(T_NS - drift_ns, T_NS)
    assert problem == "the offset to the log times changes by +0.455 s from the first to the last tenth"
