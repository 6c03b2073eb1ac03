"""The same batch problem as a short GTSAM script would solve it: the yardstick of the speed benchmark.

It reads with ``mcap`` and ``mcap-ros2-support`` and puts ``CombinedImuFactor``, ``GPSFactorArmCalib`` and priors into
``LevenbergMarquardtOptimizer``, then takes every keyframe's covariance from ``Marginals``. Keyframes, initial values
and constants are handed to it; it does without coning corrections, standstill, odometer, gates, counts and warnings.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, V, X
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.stats import chi2

from tbmfg.problem import Problem
from tbmfg.state import BA, BG, POS, VEL
from tbmfg.timeseries import NS, Floats


@dataclass(frozen=True, slots=True)
class Solution:
    """Positions (n, 3) relative to the problem's origin, and covariances (n, 15, 15) with position in b."""

    position: Floats
    cov: Floats


def read(path: Path, imu_topic: str, prism_topic: str) -> tuple[Floats, Floats, np.ndarray, Floats]:
    """Stamps and readings (n, 6) of the IMU (acceleration, rate), stamps and points (m, 3) of the prism."""
    imu_ns, imu, prism_ns, prism = [], [], [], []
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics=[imu_topic, prism_topic]):
            stamp = message.header.stamp.sec * NS + message.header.stamp.nanosec
            if channel.topic == imu_topic:
                a, w = message.linear_acceleration, message.angular_velocity
                imu_ns.append(stamp)
                imu.append((a.x, a.y, a.z, w.x, w.y, w.z))
            else:
                prism_ns.append(stamp)
                prism.append((message.point.x, message.point.y, message.point.z))
    return np.array(imu_ns), np.array(imu), np.array(prism_ns), np.array(prism)


def run(path: Path, problem: Problem, x: Floats) -> Solution:
    """Solve ``path`` at the keyframes of ``problem``, starting from its states ``x`` (n, 21 + e).

    The rig must have one prism with a known clock offset, and an IMU stamped at the end of its period.
    """
    rig, inertial = problem.rig, problem.inertial
    sensor = rig.sensors["prism"]
    imu_ns, imu, prism_ns, prism = read(path, rig.imu.topic, sensor.topic)
    keyframes = problem.t_ns
    n = len(keyframes)
    dt = np.diff(imu_ns, prepend=imu_ns[0] - np.median(np.diff(imu_ns)).astype(int)) * 1e-9
    edges = np.searchsorted(imu_ns, keyframes, side="right")

    params = gtsam.PreintegrationCombinedParams(inertial.gravity_n)
    params.setGyroscopeCovariance(np.eye(3) * inertial.psd_gyro[0])
    params.setAccelerometerCovariance(np.eye(3) * inertial.psd_acc[0])
    params.setIntegrationCovariance(np.eye(3) * 1e-12)
    params.setBiasAccCovariance(np.eye(3) * inertial.psd_ba)
    params.setBiasOmegaCovariance(np.eye(3) * inertial.psd_bg)
    params.setOmegaCoriolis(inertial.earth_n)

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(n):
        bias = gtsam.imuBias.ConstantBias(x[k, 15:18], x[k, 18:21])
        values.insert(X(k), gtsam.Pose3(gtsam.Rot3(x[k, :9].reshape(3, 3)), x[k, 9:12]))
        values.insert(V(k), x[k, 12:15])
        values.insert(B(k), bias)
        if k + 1 < n:
            pim = gtsam.PreintegratedCombinedMeasurements(params, bias)
            for row in range(edges[k], edges[k + 1]):
                pim.integrateMeasurement(imu[row, :3], imu[row, 3:], dt[row])
            graph.add(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), pim))
    values.insert(L(0), sensor.arm)

    estimator = {"huber": gtsam.noiseModel.mEstimator.Huber, "cauchy": gtsam.noiseModel.mEstimator.Cauchy}[sensor.loss]
    loss = estimator.Create(np.sqrt(chi2.ppf(0.95, 3)))
    prism_ns = prism_ns - round(sensor.clock_offset * NS)
    nearest = np.searchsorted((keyframes[1:] + keyframes[:-1]) // 2, prism_ns)
    for stamp, k, point in zip(prism_ns, nearest, prism, strict=True):
        if keyframes[0] <= stamp <= keyframes[-1]:
            noise = gtsam.noiseModel.Isotropic.Sigma(3, sensor.sigma_at(point))
            robust = gtsam.noiseModel.Robust.Create(loss, noise)
            graph.add(gtsam.GPSFactorArmCalib(X(k), L(0), point - problem.origin_n, robust))

    prior, R = problem.prior, values.atPose3(X(0)).rotation().matrix()
    start = prior.x
    pose_cov = prior.cov[:6, :6].copy()
    pose_cov[POS, POS] = R.T @ pose_cov[POS, POS] @ R  # GTSAM has a pose's position error in b
    gaussian = gtsam.noiseModel.Gaussian.Covariance
    pose = gtsam.Pose3(gtsam.Rot3(start[:9].reshape(3, 3)), start[9:12])
    bias = gtsam.imuBias.ConstantBias(start[15:18], start[18:21])
    graph.add(gtsam.PriorFactorPose3(X(0), pose, gaussian(pose_cov)))
    graph.add(gtsam.PriorFactorVector(V(0), start[12:15], gaussian(prior.cov[VEL, VEL])))
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias, gaussian(prior.cov[BA.start : BG.stop, BA.start : BG.stop])))
    graph.add(gtsam.PriorFactorPoint3(L(0), sensor.arm, gtsam.noiseModel.Isotropic.Sigma(3, sensor.arm_sd)))

    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, values)
    cov = np.empty((n, 15, 15))
    for k in range(n):
        cov[k] = marginals.jointMarginalCovariance([X(k), V(k), B(k)]).fullMatrix()
    return Solution(np.array([values.atPose3(X(k)).translation() for k in range(n)]), cov)
