"""Reading a part of a recording: topics, a stretch of time, columns; and what is then not even unpacked."""

import numpy as np
import pytest

from tbmfg.errors import LogError
from tbmfg.mcap import container, read_attachments, read_log, write_log
from tbmfg.timeseries import Series, Transform

IMU, ODOMETRY, START_NS = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry", 1_700_000_000_000_000_000


@pytest.fixture
def path(tmp_path, request):
    """Ten seconds of an IMU at 100 Hz beside odometry in the second half, in many chunks unless told otherwise."""
    t_ns = START_NS + np.arange(1000) * 10_000_000
    rng = np.random.default_rng(1)
    imu = Series("/imu", IMU, t_ns, {"gyro": rng.normal(size=(1000, 3)), "acc": rng.normal(size=(1000, 3))})
    pose = {"position": rng.normal(size=(500, 3)), "pose_cov": rng.normal(size=(500, 36)), "linear": np.ones((500, 3))}
    path = tmp_path / "x.mcap"
    transform = Transform("base", "imu", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
    options = {"chunk_size": 4096, **getattr(request, "param", {})}
    write_log(
        path,
        [imu, Series("/odometry", ODOMETRY, t_ns[500:], pose)],
        transforms=[transform],
        attachments={"rig.yaml": b"name: x"},
        **options,
    )
    return path


@pytest.fixture
def unpacked(monkeypatch):
    """How many chunks have been unpacked."""
    calls = []
    original = container._unpack
    monkeypatch.setattr(container, "_unpack", lambda body: (calls.append(1), original(body))[1])
    return calls


LAYOUTS_OF_FILES = [{}, {"chunked": False}, {"compression": "none"}, {"compression": "lz4"}]


@pytest.mark.parametrize("path", LAYOUTS_OF_FILES, indirect=True, ids=str)
def test_a_stretch_of_time_is_that_of_the_whole(path):
    whole, part = read_log(path), read_log(path, start_s=2.0, end_s=7.005)
    for topic, rows in (("/imu", slice(200, 701)), ("/odometry", slice(0, 201))):
        np.testing.assert_array_equal(part.series[topic].t_ns, whole.series[topic].t_ns[rows])
        for name, values in whole.series[topic].columns.items():
            np.testing.assert_array_equal(part.series[topic][name], values[rows])
    assert part.transforms == whole.transforms
    assert part.attachments == whole.attachments


def test_only_chunks_that_are_needed_are_unpacked(path, unpacked):
    read_log(path)
    chunks = len(unpacked)
    assert chunks > 50
    del unpacked[:]
    read_log(path, start_s=9.0)
    assert 0 < len(unpacked) < 0.25 * chunks
    del unpacked[:]
    log = read_log(path, ["/odometry"])
    assert list(log.series) == ["/odometry"]
    assert log.unread == {"/imu": IMU}
    assert 0 < len(unpacked) < 0.95 * chunks
    del unpacked[:]
    assert read_attachments(path) == {"rig.yaml": b"name: x"}
    assert not unpacked


def test_topics_may_be_told_by_a_function(path):
    assert list(read_log(path, lambda topic: topic.endswith("imu")).series) == ["/imu"]


def test_columns_that_are_left_out(path):
    whole, part = (
        read_log(path).series["/odometry"],
        read_log(path, leave=["pose_cov", "twist_cov"]).series["/odometry"],
    )
    assert set(whole.columns) - set(part.columns) == {"pose_cov", "twist_cov"}
    np.testing.assert_array_equal(part["position"], whole["position"])


def test_a_stretch_without_messages_is_said(path):
    with pytest.raises(LogError, match="no message between 20 and inf s"):
        read_log(path, start_s=20.0)
