"""A trajectory as an MCAP file that Foxglove and evo open: odometry, /tf and diagnostics."""

from __future__ import annotations

import heapq
import os
from collections.abc import Mapping

import numpy as np

from tbmfg.geometry import log_so3, matrix_from_quat, skew
from tbmfg.mcap.cdr import CdrWriter
from tbmfg.mcap.layouts import LAYOUTS, ONE_TRANSFORM
from tbmfg.mcap.streams import TRANSFORMS
from tbmfg.mcap.writer import Compression, encoded, write_messages
from tbmfg.state import POS, ROT, VEL, Trajectory
from tbmfg.timeseries import Floats, seconds

ODOMETRY = "nav_msgs/msg/Odometry"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


def write_trajectory(
    path: str | os.PathLike,
    trajectory: Trajectory,
    *,
    diagnostics: Mapping[str, str] | None = None,
    topic: str = "/tbmfg/odometry",
    frame_id: str = "map",
    child_frame_id: str = "base_link",
    compression: Compression = "zstd",
) -> None:
    """Write nav_msgs/Odometry to ``topic``, the same poses to /tf, and ``diagnostics`` to /diagnostics.

    ``frame_id`` is n, ``child_frame_id`` is b. Log times are the stamps. Raises LogError where the file
    cannot be written.
    """
    strings = {"frame_id": frame_id, "child_frame_id": child_frame_id}
    pose = {"position": trajectory.position_n, "quat_xyzw": trajectory.quat_xyzw}
    twist, twist_cov = body_twist(trajectory)
    odometry = {
        **pose,
        "pose_cov": ros_pose_cov(trajectory).reshape(-1, 36),
        "linear": twist[:, :3],
        "angular": twist[:, 3:],
        "twist_cov": twist_cov.reshape(-1, 36),
    }
    types = {topic: ODOMETRY, "/tf": TRANSFORMS}
    streams = [
        encoded(topic, LAYOUTS[ODOMETRY], trajectory.t_ns, trajectory.t_ns, odometry, strings),
        encoded("/tf", ONE_TRANSFORM, trajectory.t_ns, trajectory.t_ns, pose, strings),
    ]
    if diagnostics and len(trajectory):
        types["/diagnostics"] = DIAGNOSTICS
        t_ns = int(trajectory.t_ns[0])
        streams.append(iter([(t_ns, "/diagnostics", encode_diagnostics(t_ns, diagnostics))]))
    write_messages(path, types, heapq.merge(*streams, key=lambda message: message[0]), {}, compression)


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


def encode_diagnostics(t_ns: int, values: Mapping[str, str]) -> bytes:
    """A diagnostic_msgs/DiagnosticArray with one status, named tbmfg, at level OK."""
    cdr = CdrWriter().header(t_ns, "").scalars("I", 1)
    cdr.scalars("B", 0).string("tbmfg").string("").string("").scalars("I", len(values))
    for key, value in values.items():
        cdr.string(key).string(value)
    return cdr.message()
