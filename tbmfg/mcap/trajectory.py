"""A trajectory as an MCAP file that Foxglove and evo open: odometry, path, /tf and diagnostics."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from tbmfg.geometry import log_so3, matrix_from_quat, skew
from tbmfg.mcap import clouds
from tbmfg.mcap.cdr import CdrWriter
from tbmfg.mcap.layouts import LAYOUTS, ONE_TRANSFORM
from tbmfg.mcap.streams import TRANSFORMS
from tbmfg.mcap.writer import Compression, Message, encoded, write_messages
from tbmfg.state import POS, ROT, VEL, Interval, Trajectory
from tbmfg.timeseries import Floats, seconds

ODOMETRY = "nav_msgs/msg/Odometry"
PATH = "nav_msgs/msg/Path"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
ODOMETRY_TOPIC, PATH_TOPIC, MAP_TOPIC = "/tbmfg/odometry", "/tbmfg/path", "/tbmfg/map"
OK, WARN = 0, 1  # levels of diagnostic_msgs/DiagnosticStatus


def write_trajectory(
    path: str | os.PathLike,
    trajectory: Trajectory,
    *,
    diagnostics: Mapping[str, str] | None = None,
    intervals: Sequence[Interval] = (),
    map_n: Floats | None = None,
    frame_id: str = "map",
    child_frame_id: str = "base_link",
    compression: Compression = "zstd",
) -> None:
    """Write nav_msgs/Odometry, all poses as one nav_msgs/Path, the same to /tf, and what happened to /diagnostics.

    ``diagnostics`` come as one status at the start; ``intervals`` as a status of their sensor that warns from the start
    to the end of each. ``map_n`` (k, 3) m comes as one PointCloud2 at the start. ``frame_id`` is n, ``child_frame_id``
    is b. Log times are the stamps. Raises LogError where the file cannot be written.
    """
    types, streams = trajectory_messages(trajectory, frame_id, child_frame_id)
    strings = {"frame_id": frame_id, "child_frame_id": child_frame_id}
    pose = {"position": trajectory.position_n, "quat_xyzw": trajectory.quat_xyzw}
    types["/tf"] = TRANSFORMS
    streams.append(encoded("/tf", ONE_TRANSFORM, trajectory.t_ns, trajectory.t_ns, pose, strings))
    if len(trajectory) and (diagnostics or intervals):
        types["/diagnostics"] = DIAGNOSTICS
        streams.append(_diagnostics(int(trajectory.t_ns[0]), diagnostics or {}, intervals))
    if len(trajectory) and map_n is not None:
        start_ns = int(trajectory.t_ns[0])
        fields = {axis: map_n[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
        types[MAP_TOPIC] = clouds.TYPE
        streams.append([(start_ns, MAP_TOPIC, clouds.encode_cloud(start_ns, frame_id, fields))])
    write_messages(path, types, heapq.merge(*streams, key=lambda message: message[0]), {}, compression)


def trajectory_messages(
    trajectory: Trajectory, frame_id: str = "map", child_frame_id: str = "base_link", delay_ns: int = 0
) -> tuple[dict[str, str], list[Iterable[Message]]]:
    """Types by topic, and the messages of each in order: odometry, and the whole path at its start.

    Log times are the stamps plus ``delay_ns``.
    """
    twist, twist_cov = body_twist(trajectory)
    odometry = {
        "position": trajectory.position_n,
        "quat_xyzw": trajectory.quat_xyzw,
        "pose_cov": ros_pose_cov(trajectory).reshape(-1, 36),
        "linear": twist[:, :3],
        "angular": twist[:, 3:],
        "twist_cov": twist_cov.reshape(-1, 36),
    }
    strings = {"frame_id": frame_id, "child_frame_id": child_frame_id}
    t_ns, log_ns = trajectory.t_ns, trajectory.t_ns + delay_ns
    streams: list[Iterable[Message]] = [
        encoded(ODOMETRY_TOPIC, LAYOUTS[ODOMETRY], t_ns, log_ns, odometry, strings),
        [(int(log_ns[0]), PATH_TOPIC, encode_path(trajectory, frame_id))] if len(trajectory) else [],
    ]
    return {ODOMETRY_TOPIC: ODOMETRY, PATH_TOPIC: PATH}, streams


def encode_path(trajectory: Trajectory, frame_id: str) -> bytes:
    """A nav_msgs/Path of all keyframes, stamped with the first."""
    cdr = CdrWriter().header(int(trajectory.t_ns[0]), frame_id).scalars("I", len(trajectory))
    poses = np.hstack([trajectory.position_n, trajectory.quat_xyzw]).tolist()
    for t_ns, pose in zip(trajectory.t_ns.tolist(), poses, strict=True):
        cdr.header(t_ns, frame_id).scalars("d", *pose)
    return cdr.message()


def ros_pose_cov(trajectory: Trajectory) -> Floats:
    """Pose covariance as ROS has it, (n, 6, 6): position, then rotation, both about the axes of n.

    A right perturbation d about b is R_nb d about n (the adjoint of the rotation).
    """
    jacobian = np.zeros((len(trajectory), 6, trajectory.cov.shape[-1]))
    jacobian[:, :3, POS] = np.eye(3)
    jacobian[:, 3:, ROT] = matrix_from_quat(trajectory.quat_xyzw)
    return jacobian @ trajectory.cov @ jacobian.transpose(0, 2, 1)


def body_twist(trajectory: Trajectory) -> tuple[Floats, Floats]:
    """Velocity and angular rate of b in n, both resolved in b, (n, 6) m/s and rad/s; covariance (n, 6, 6).

    v_b = R_nb^T v_n, so an attitude error d adds v_b x d. The rate is the mean over the neighbouring
    keyframes; their attitude errors are taken as independent, which bounds its variance from above.
    """
    n = len(trajectory)
    R_nb = matrix_from_quat(trajectory.quat_xyzw)
    R_bn = R_nb.transpose(0, 2, 1)
    velocity_b = (R_bn @ trajectory.velocity_n[:, :, None])[:, :, 0]
    jacobian = np.zeros((n, 3, trajectory.cov.shape[-1]))
    jacobian[:, :, ROT] = skew(velocity_b)
    jacobian[:, :, VEL] = R_bn
    cov = np.zeros((n, 6, 6))
    cov[:, :3, :3] = jacobian @ trajectory.cov @ jacobian.transpose(0, 2, 1)
    omega_b = np.zeros((n, 3))
    if n > 1:
        before, after = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
        t = seconds(trajectory.t_ns, trajectory.t_ns[0])
        dt = (t[after] - t[before])[:, None]
        omega_b = log_so3(R_bn[before] @ R_nb[after]) / dt
        rotation = trajectory.cov[:, ROT, ROT]
        cov[:, 3:, 3:] = (rotation[before] + rotation[after]) / dt[:, :, None] ** 2
    return np.hstack([velocity_b, omega_b]), cov


def _diagnostics(start_ns: int, values: Mapping[str, str], intervals: Sequence[Interval]) -> Iterator[Message]:
    """``values`` at the start, then a change of status at either end of every interval."""
    changes = [(interval.start_ns, WARN, interval.sensor, interval.kind) for interval in intervals]
    changes += [(interval.end_ns, OK, interval.sensor, f"{interval.kind} over") for interval in intervals]
    yield start_ns, "/diagnostics", encode_diagnostics(start_ns, OK, "tbmfg", "", values)
    for t_ns, level, sensor, text in sorted(changes):
        stamp_ns = max(t_ns, start_ns)  # an outage may begin before the first keyframe
        yield stamp_ns, "/diagnostics", encode_diagnostics(stamp_ns, level, f"tbmfg: {sensor}", text, {})


def encode_diagnostics(t_ns: int, level: int, name: str, message: str, values: Mapping[str, str]) -> bytes:
    """A diagnostic_msgs/DiagnosticArray with one status."""
    cdr = CdrWriter().header(t_ns, "").scalars("I", 1)
    cdr.scalars("B", level).string(name).string(message).string("").scalars("I", len(values))
    for key, value in values.items():
        cdr.string(key).string(value)
    return cdr.message()
