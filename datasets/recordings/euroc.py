"""Multirotor: MEMS inertial unit at 200 Hz, the prism that a total station tracks, pose truth (EuRoC).

``prism`` is ``recorded`` (a recording without one gets none) or ``synthetic``: the truth at ``arm`` m, ``rate_hz``
times a second with jitter, ``noise`` m of white noise per axis, stamps ``latency`` s late. The rest stays real.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from datasets.recordings import Arrays, Recording, imu, poses, read_npz, stamps
from tbmfg.errors import TbmfgError
from tbmfg.rig import load_rig
from tbmfg.timeseries import Floats, Series, Times

JITTER = 0.1  # of the interval between fixes, one sd


def load(
    source: str | Path,
    prism: str = "recorded",
    arm: tuple[float, float, float] = (0.075, -0.018, -0.12),
    latency: float = 0.1,
    noise: float = 0.003,
    rate_hz: float = 16.0,
    seed: int = 0,
) -> Recording:
    """One flight. Arms and truth are in IMU axes, as the rig's b is."""
    if prism not in ("recorded", "synthetic"):
        raise TbmfgError(f"euroc: prism should be recorded or synthetic, not {prism!r}")
    arrays = read_npz(source)
    rig = load_rig("euroc-leica")
    t0_ns = int(arrays["t0_ns"])
    series = [
        imu(rig.imu.topic, stamps(arrays["imu_t"], t0_ns), arrays["imu_gyr"], arrays["imu_acc"]),
        _truth(rig.truth.topic, stamps(arrays["truth_t"], t0_ns), arrays),
    ]
    topic = rig.sensors["prism"].topic
    if prism == "synthetic":
        rng = np.random.default_rng(seed)
        t, points = _track(arrays, np.array(arm), rate_hz, rng)
        points = points + noise * rng.standard_normal(points.shape)
        series.append(_points(topic, stamps(t + latency, t0_ns), points))
    elif "prism_t" in arrays:
        series.append(_points(topic, stamps(arrays["prism_t"], t0_ns), arrays["prism_p"]))
    return Recording(tuple(series), rig)


def _truth(topic: str, t_ns: Times, arrays: Arrays) -> Series:
    """Poses; with the velocity, turned to b, where the recording has it."""
    position, quat = arrays["truth_p"], arrays["truth_q_xyzw"]
    if "truth_v" not in arrays:
        return poses(topic, t_ns, position, quat)
    velocity_b = Rotation.from_quat(quat).apply(arrays["truth_v"], inverse=True)
    columns = {"position": position, "quat_xyzw": quat, "linear": velocity_b, "angular": np.zeros_like(position)}
    return Series(topic, "nav_msgs/msg/Odometry", t_ns, columns, "n", "b")


def _points(topic: str, t_ns: Times, position: Floats) -> Series:
    return Series(topic, "geometry_msgs/msg/PointStamped", t_ns, {"point": position}, "n")


def _track(arrays: Arrays, arm: Floats, rate_hz: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Times (n,) s and positions (n, 3) m of a point at ``arm`` by the truth."""
    t, position = arrays["truth_t"], arrays["truth_p"]
    count = int((t[-1] - t[0]) * rate_hz)
    at = t[0] + (np.arange(count) + 0.5 + JITTER * rng.standard_normal(count)) / rate_hz
    at = np.sort(at[(at > t[0]) & (at < t[-1])])
    attitude = Slerp(t, Rotation.from_quat(arrays["truth_q_xyzw"]))(at)
    return at, CubicSpline(t, position)(at) + attitude.apply(arm)
