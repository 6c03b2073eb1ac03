"""Series of every type for the MCAP tests, and the stock decoder to hold our columns against."""

import os
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tbmfg.timeseries import NS, Series

START_NS = 1_700_000_000 * NS

WIDTHS = {
    "sensor_msgs/msg/Imu": {"gyro": 3, "acc": 3, "quat_xyzw": 4},
    "sensor_msgs/msg/MagneticField": {"field": 3},
    "sensor_msgs/msg/FluidPressure": {"pressure": 1, "variance": 1},
    "sensor_msgs/msg/NavSatFix": {"llh": 3, "cov": 9, "cov_type": 1, "status": 1},
    "geometry_msgs/msg/PointStamped": {"point": 3},
    "geometry_msgs/msg/TwistStamped": {"linear": 3, "angular": 3},
    "geometry_msgs/msg/TwistWithCovarianceStamped": {"linear": 3, "angular": 3, "cov": 36},
    "geometry_msgs/msg/PoseStamped": {"position": 3, "quat_xyzw": 4},
    "geometry_msgs/msg/PoseWithCovarianceStamped": {"position": 3, "quat_xyzw": 4, "cov": 36},
    "geometry_msgs/msg/TransformStamped": {"position": 3, "quat_xyzw": 4},
    "nav_msgs/msg/Odometry": {
        "position": 3,
        "quat_xyzw": 4,
        "pose_cov": 36,
        "linear": 3,
        "angular": 3,
        "twist_cov": 36,
    },
}
CHILD_FRAMES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped")


def topic_of(type: str) -> str:
    return "/" + type.rpartition("/")[2].lower()


def sample(type: str, n: int, seed: int = 0, frame_id: str = "sensor") -> Series:
    """Random values at irregular stamps."""
    rng = np.random.default_rng(seed)
    columns = {
        name: rng.normal(size=(n, width) if width > 1 else n) * 10.0 ** rng.integers(-6, 6)
        for name, width in WIDTHS[type].items()
    }
    if "status" in columns:
        columns["status"] = rng.integers(-1, 3, n).astype(float)
        columns["cov_type"] = rng.integers(0, 4, n).astype(float)
    if "quat_xyzw" in columns:
        columns["quat_xyzw"] /= np.linalg.norm(columns["quat_xyzw"], axis=1, keepdims=True)
    t_ns = START_NS + rng.integers(1, 20_000_000, n).cumsum()
    return Series(topic_of(type), type, t_ns, columns, frame_id, "child" if type in CHILD_FRAMES else "")


def samples(n: int = 50) -> list[Series]:
    return [sample(type, n + 7 * i, seed=i) for i, type in enumerate(WIDTHS)]


def assert_same(read: Series, written: Series) -> None:
    """Bit for bit, frames and types included."""
    assert (read.topic, read.type, read.frame_id) == (written.topic, written.type, written.frame_id)
    assert read.child_frame_id == written.child_frame_id
    np.testing.assert_array_equal(read.t_ns, written.t_ns, strict=True)
    assert set(read.columns) == set(written.columns)
    for name, values in written.columns.items():
        np.testing.assert_array_equal(read[name], values, strict=True)


def data(name: str) -> Path:
    """A real recording, or a skip."""
    root = os.environ.get("TBMFG_DATA")
    if not root:
        pytest.skip("TBMFG_DATA is not set: no recordings to read")
    return Path(root) / "mcap" / name


def stock_decoded(path: Path, topics: set[str]) -> dict[str, list]:
    """topic -> messages in the order of the file, decoded by mcap-ros2-support."""
    messages = defaultdict(list)
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics=topics, log_time_order=False):
            messages[channel.topic].append(message)
    return messages


def stock_columns(type: str, message) -> dict[str, list[float]]:
    """The columns of one message, spelled out field by field."""
    kind = type.rpartition("/")[2]
    if kind == "Imu":
        return {
            "gyro": xyz(message.angular_velocity),
            "acc": xyz(message.linear_acceleration),
            "quat_xyzw": xyzw(message.orientation),
        }
    if kind == "MagneticField":
        return {"field": xyz(message.magnetic_field)}
    if kind == "FluidPressure":
        return {"pressure": message.fluid_pressure, "variance": message.variance}
    if kind == "NavSatFix":
        llh = [message.latitude, message.longitude, message.altitude]
        return {
            "llh": llh,
            "cov": list(message.position_covariance),
            "cov_type": message.position_covariance_type,
            "status": message.status.status,
        }
    if kind == "PointStamped":
        return {"point": xyz(message.point)}
    if kind == "TwistStamped":
        return {"linear": xyz(message.twist.linear), "angular": xyz(message.twist.angular)}
    if kind == "TwistWithCovarianceStamped":
        twist = message.twist
        return {
            "linear": xyz(twist.twist.linear),
            "angular": xyz(twist.twist.angular),
            "cov": list(twist.covariance),
        }
    if kind == "PoseStamped":
        return pose(message.pose)
    if kind == "PoseWithCovarianceStamped":
        return {**pose(message.pose.pose), "cov": list(message.pose.covariance)}
    if kind == "TransformStamped":
        return {"position": xyz(message.transform.translation), "quat_xyzw": xyzw(message.transform.rotation)}
    assert kind == "Odometry"
    return {
        **pose(message.pose.pose),
        "pose_cov": list(message.pose.covariance),
        "linear": xyz(message.twist.twist.linear),
        "angular": xyz(message.twist.twist.angular),
        "twist_cov": list(message.twist.covariance),
    }


def xyz(vector) -> list[float]:
    return [vector.x, vector.y, vector.z]


def xyzw(quaternion) -> list[float]:
    return [quaternion.x, quaternion.y, quaternion.z, quaternion.w]


def pose(message) -> dict[str, list[float]]:
    return {"position": xyz(message.position), "quat_xyzw": xyzw(message.orientation)}
