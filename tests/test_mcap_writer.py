"""Writing logs and trajectories: bit for bit there and back, readable by others, never half written."""

import os
import time

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_samples import CHILD_FRAMES, START_NS, assert_same, sample, samples, stock_decoded
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from tbmfg.errors import LogError
from tbmfg.geometry import exp_so3, log_so3, matrix_from_quat, quat_from_matrix
from tbmfg.mcap import read_log, write_log, write_trajectory
from tbmfg.mcap.schemas import _MEMBERS, definition
from tbmfg.mcap.trajectory import body_twist, ros_pose_cov
from tbmfg.state import NAV, POS, ROT, VEL, Trajectory
from tbmfg.timeseries import Series, Transform

VARIANTS = [
    {},
    {"compression": "lz4"},
    {"compression": "none"},
    {"chunked": False},
    {"chunk_size": 1000},
]
STATIC = (Transform("base_link", "prism", (1.0, 2.0, 3.0), (0.5, -0.5, 0.5, -0.5)),)


@pytest.mark.parametrize("target", ["x.mcap", "bag"])
@pytest.mark.parametrize("options", VARIANTS)
def test_what_is_written_is_read(tmp_path, target, options):
    written = samples()
    files = {"rig.yaml": b"name: tbm\n", "empty": b""}
    write_log(tmp_path / target, written, transforms=STATIC, attachments=files, **options)
    log = read_log(tmp_path / target)
    assert log.damage == ()
    assert set(log.series) == {series.topic for series in written}
    for series in written:
        assert_same(log.series[series.topic], series)
    assert log.transforms == STATIC
    assert log.attachments == files
    assert log.unknown == {}


def test_a_folder_is_a_bag_to_others(tmp_path):
    written = samples()
    write_log(tmp_path / "bag", written, transforms=STATIC)
    assert sorted(os.listdir(tmp_path / "bag")) == ["bag_0.mcap", "metadata.yaml"]
    with AnyReader([tmp_path / "bag"]) as bag:
        assert bag.message_count == sum(map(len, written)) + 1
        assert {c.topic: c.msgtype for c in bag.connections} == {
            **{series.topic: series.type for series in written},
            "/tf_static": "tf2_msgs/msg/TFMessage",
        }
        (latched,) = next(c for c in bag.connections if c.topic == "/tf_static").ext.offered_qos_profiles
        assert latched.durability.name == "TRANSIENT_LOCAL"
        for connection, log_ns, raw in bag.messages():
            message = bag.deserialize(raw, connection.msgtype)
            if connection.topic != "/tf_static":
                assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == log_ns
        assert bag.start_time == min(series.t_ns[0] for series in written)
        assert bag.end_time == max(series.t_ns[-1] for series in written) + 1  # an exclusive bound there


def test_metadata_of_a_folder(tmp_path):
    imu = sample("sensor_msgs/msg/Imu", 10)
    write_log(tmp_path / "some" / "bag", [imu])
    information = yaml.safe_load((tmp_path / "some" / "bag" / "metadata.yaml").read_text())
    information = information["rosbag2_bagfile_information"]
    assert information["message_count"] == 10
    assert information["starting_time"]["nanoseconds_since_epoch"] == imu.t_ns[0]
    assert information["duration"]["nanoseconds"] == imu.t_ns[-1] - imu.t_ns[0]
    assert information["relative_file_paths"] == ["bag_0.mcap"]


def test_messages_are_in_the_order_of_log_times(tmp_path):
    imu, point = sample("sensor_msgs/msg/Imu", 60), sample("geometry_msgs/msg/PointStamped", 20)
    late = point.t_ns + 80_000_000
    write_log(tmp_path / "x.mcap", [imu, point], log_ns={point.topic: late})
    with open(tmp_path / "x.mcap", "rb") as file:
        messages = list(make_reader(file).iter_messages(log_time_order=False))
    log_times = [message.log_time for _, _, message in messages]
    assert log_times == sorted(log_times)
    assert [m.log_time for _, c, m in messages if c.topic == point.topic] == late.tolist()
    assert [m.sequence for _, c, m in messages if c.topic == point.topic] == list(range(20))
    assert_same(read_log(tmp_path / "x.mcap").series[point.topic], point)


def test_definitions_and_encodings_are_those_of_ros2(tmp_path):
    write_log(tmp_path / "x.mcap", samples(), transforms=STATIC)
    with open(tmp_path / "x.mcap", "rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert all(channel.message_encoding == "cdr" for channel in summary.channels.values())
    assert all("offered_qos_profiles" in channel.metadata for channel in summary.channels.values())
    assert all(schema.encoding == "ros2msg" for schema in summary.schemas.values())


@pytest.mark.parametrize("name", sorted(_MEMBERS))
def test_definitions_have_the_fields_of_the_distributed_ones(name):
    """Names, types, order and constants, as another implementation knows them."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    package, message = name.split("/")
    ours, _, _ = definition(f"{package}/msg/{message}").partition("\n====")
    distributed, _ = store.generate_msgdef(f"{package}/msg/{message}", ros_version=2)
    theirs, _, _ = distributed.partition("\n====")
    assert members(ours, package) == members(theirs, package)


def members(text, package):
    """The members in order, without defaults, and the constants, whose order does not matter."""
    fields, constants = [], set()
    for line in filter(None, text.splitlines()):
        kind, _, rest = line.strip().partition(" ")
        if "/" not in kind and kind[0].isupper():
            kind = f"{package}/{kind}"
        if "=" in rest:
            constants.add((kind, rest.replace(" ", "")))
        else:
            fields.append((kind, rest.split()[0]))
    return fields, constants


# ---- never half written ----


def test_a_failing_source_leaves_what_was_there(tmp_path):
    imu = sample("sensor_msgs/msg/Imu", 10)

    def series():
        yield imu
        raise RuntimeError("the simulator stopped")

    class Broken:
        topic, t_ns, frame_id = "/points", imu.t_ns, "lidar"

        def __len__(self):
            return len(self.t_ns)

        def __iter__(self):
            yield int(self.t_ns[0]), {"x": np.zeros(3)}
            raise RuntimeError("the simulator stopped")

    write_log(tmp_path / "x.mcap", [imu])
    before = (tmp_path / "x.mcap").read_bytes()
    for arguments in ({"series": series()}, {"series": [imu], "clouds": [Broken()]}):
        with pytest.raises(RuntimeError, match="the simulator stopped"):
            write_log(tmp_path / "x.mcap", **arguments)
    assert os.listdir(tmp_path) == ["x.mcap"]
    assert (tmp_path / "x.mcap").read_bytes() == before


def test_what_cannot_be_written_is_said_in_one_line(tmp_path):
    with pytest.raises(LogError, match=r"nowhere/x.mcap: cannot be written \(No such file"):
        write_log(tmp_path / "nowhere" / "x.mcap", samples())
    scan = Series("/scan", "sensor_msgs/msg/LaserScan", np.arange(2), {"ranges": np.zeros(2)})
    with pytest.raises(LogError, match="/scan: sensor_msgs/msg/LaserScan cannot be written; known types: geometry"):
        write_log(tmp_path / "x.mcap", [scan])


# ---- trajectories ----


def trajectory(n, seed=0):
    """A smooth random motion with full covariances."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 0.1
    rotvec = 0.8 * np.column_stack([np.sin(0.3 * t), np.cos(0.2 * t), 0.1 * t])
    root = rng.normal(scale=0.1, size=(n, NAV, NAV))
    return Trajectory(
        START_NS + np.arange(n) * 100_000_000,
        rng.normal(size=(n, 3)).cumsum(axis=0),
        quat_from_matrix(exp_so3(rotvec)),
        rng.normal(size=(n, 3)),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        root @ root.transpose(0, 2, 1),
    )


def test_trajectory_as_odometry_and_transforms(tmp_path):
    written = trajectory(50)
    path = tmp_path / "result.mcap"
    write_trajectory(path, written, diagnostics={"estimator": "batch", "keyframes": "50"})
    series = read_log(path).series["/tbmfg/odometry"]
    assert (series.frame_id, series.child_frame_id) == ("map", "base_link")
    np.testing.assert_array_equal(series.t_ns, written.t_ns)
    np.testing.assert_array_equal(series["position"], written.position_n)
    np.testing.assert_array_equal(series["quat_xyzw"], written.quat_xyzw)
    np.testing.assert_array_equal(series["pose_cov"], ros_pose_cov(written).reshape(50, 36))
    twist, twist_cov = body_twist(written)
    np.testing.assert_array_equal(np.hstack([series["linear"], series["angular"]]), twist)
    np.testing.assert_array_equal(series["twist_cov"], twist_cov.reshape(50, 36))

    stock = stock_decoded(path, {"/tf", "/diagnostics"})
    assert len(stock["/tf"]) == 50
    for i, message in enumerate(stock["/tf"]):
        (one,) = message.transforms
        assert (one.header.frame_id, one.child_frame_id) == ("map", "base_link")
        move, turn = one.transform.translation, one.transform.rotation
        assert [move.x, move.y, move.z] == written.position_n[i].tolist()
        assert [turn.x, turn.y, turn.z, turn.w] == written.quat_xyzw[i].tolist()
    (diagnostics,) = stock["/diagnostics"]
    (status,) = diagnostics.status
    assert status.name == "tbmfg"
    assert {one.key: one.value for one in status.values} == {"estimator": "batch", "keyframes": "50"}


@pytest.mark.parametrize("n", [0, 1])
def test_very_short_trajectories(tmp_path, n):
    write_trajectory(tmp_path / "x.mcap", trajectory(n), diagnostics={"a": "b"})
    with open(tmp_path / "x.mcap", "rb") as file:
        assert len(list(make_reader(file).iter_messages())) == 4 * n


def test_pose_covariance_is_that_of_the_errors_about_n():
    """Errors drawn in our coordinates, measured in those of ROS."""
    one = trajectory(1, seed=3)
    small = 1e-6 * one.cov[0]  # so that second order does not show
    draws = np.random.default_rng(4).multivariate_normal(np.zeros(NAV), small, 200_000)
    R_nb = matrix_from_quat(one.quat_xyzw[0])
    R_estimated = R_nb @ exp_so3(draws[:, ROT])
    about_n = log_so3(R_estimated @ R_nb.T)
    measured = np.cov(np.hstack([draws[:, POS], about_n]).T)
    expected = 1e-6 * ros_pose_cov(one)[0]
    # A sampled covariance has a relative error of sqrt(2/n) = 0.3 % of its largest terms; allow five times.
    np.testing.assert_allclose(measured, expected, atol=5 * np.sqrt(2 / len(draws)) * expected.max())


def test_velocity_covariance_is_that_of_the_errors_in_b():
    one = trajectory(1, seed=5)
    small = 1e-6 * one.cov[0]
    draws = np.random.default_rng(6).multivariate_normal(np.zeros(NAV), small, 200_000)
    R_nb = matrix_from_quat(one.quat_xyzw[0])
    R_estimated = R_nb @ exp_so3(draws[:, ROT])
    velocity_b = np.einsum("nji,nj->ni", R_estimated, one.velocity_n[0] + draws[:, VEL])
    twist, twist_cov = body_twist(one)
    expected = 1e-6 * twist_cov[0, :3, :3]
    np.testing.assert_allclose(velocity_b.mean(axis=0), twist[0, :3], atol=1e-4)
    np.testing.assert_allclose(np.cov(velocity_b.T), expected, atol=5 * np.sqrt(2 / len(draws)) * expected.max())


def test_angular_rate_of_a_constant_turn():
    n, omega_b = 20, np.array([0.2, -0.1, 0.4])
    t_ns = START_NS + np.cumsum(np.random.default_rng(0).integers(50_000_000, 200_000_000, n))
    start = Rotation.from_euler("ZYX", [1.0, 0.3, -0.2]).as_matrix()
    R_nb = start @ exp_so3((t_ns - t_ns[0])[:, None] * 1e-9 * omega_b)
    zeros = np.zeros((n, 3))
    turning = Trajectory(t_ns, zeros, quat_from_matrix(R_nb), zeros, zeros, zeros, np.zeros((n, NAV, NAV)))
    twist, _ = body_twist(turning)
    np.testing.assert_allclose(twist[:, 3:], np.tile(omega_b, (n, 1)), atol=1e-9)


def test_twenty_minutes_of_keyframes_are_written_in_a_second_or_two(tmp_path):
    start = time.perf_counter()
    write_trajectory(tmp_path / "x.mcap", trajectory(12_000))
    assert time.perf_counter() - start < 4  # about 0.5 s on an idle core


def test_child_frames_are_those_of_the_samples():
    assert {s.type for s in samples(1) if s.child_frame_id} == set(CHILD_FRAMES)
