"""The problem for given clocks and noise: keyframes, rows, first state and prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tbmfg import measure
from tbmfg.errors import EstimationError
from tbmfg.fields import MICRO_TESLA
from tbmfg.measure import Clock
from tbmfg.prepare.samples import ALONE, is_position
from tbmfg.prepare.scans import lidar_rows
from tbmfg.prepare.start import Setup
from tbmfg.problem import CLOCK, STRENGTH, Inertial, Parameters, Prior, Problem
from tbmfg.rig import Barometer, Laser, Lidar, Magnetometer, Odometer, PositionSensor, kind_of
from tbmfg.state import BG, NAV, ROT
from tbmfg.timeseries import Floats

ON_TIME = Clock(0.0)
GYROCOMPASS_SLACK = np.deg2rad(0.1)  # of the coarse heading beside the bias: noise and motion of the still stretch


def build(setup: Setup, clocks: dict[str, Clock], factors: Floats, end_s: float | None = None) -> Problem:
    """The problem for given clocks and noise factors (gyro, accelerometer), up to ``end_s``."""
    rig, steps = setup.rig, setup.steps
    end_s = steps.end_s if end_s is None else min(end_s, steps.end_s)
    samples = {
        name: s.select(rows)
        for name, s in setup.samples.items()
        if (rows := clocks.get(name, ON_TIME).true(s.t_s) <= end_s).sum() >= 2
    }
    mean, begin = setup.parameters.mean.copy(), setup.parameters.mean.copy()
    for name, clock in clocks.items():
        own = clock_of(setup.parameters, name)
        mean[own] -= clock.offset_s, clock.drift
        begin[own] = 0.0
    parameters = replace(setup.parameters, mean=mean, start=begin)

    fixes = [clocks[name].true(s.t_s) for name, s in samples.items() if is_position(rig, name)]
    scans = [s.t_s for name, s in samples.items() if isinstance(rig.sensors[name], Lidar)]
    surveyed = measure.survey_times(rig.survey, steps)
    fixes_s = np.sort(np.concatenate([*fixes, *scans, surveyed]))
    edges = measure.keyframe_edges(rig.keyframes, steps.edges_s, end_s, fixes_s)
    keyframes = steps.edges_s[edges]
    position, velocity = first_state(setup, clocks)
    rows, drift_names, drift_walk, drift_sd, drift_start = [], [], [], [], []
    for name, s in samples.items():
        sensor, calib = rig.sensors[name], parameters.slice(name)
        if isinstance(sensor, PositionSensor):
            rows.append(measure.position_rows(sensor, s, clocks[name], keyframes, setup.frame, setup.origin_n, calib))
        elif isinstance(sensor, Odometer):
            rows.append(measure.odometer_rows(sensor, s, keyframes, setup.frame, calib))
        elif isinstance(sensor, Magnetometer):
            azimuth = rig.origin.x_axis_azimuth
            horizontal = MICRO_TESLA * parameters.prior(f"{name}.{STRENGTH}")
            rows.append(measure.magnetometer_rows(sensor, s, keyframes, setup.frame, azimuth, calib, horizontal))
        elif isinstance(sensor, Lidar):
            rows.append(lidar_rows(sensor, s, keyframes, setup, calib))
        elif isinstance(sensor, Laser):
            rows.append(
                measure.laser_rows(
                    sensor, s, keyframes, setup.frame, setup.acc, rig.origin.gravity, setup.origin_n, calib
                )
            )
        elif isinstance(sensor, Barometer):
            rows.append(
                measure.barometer_rows(sensor, s, keyframes, setup.origin_n, len(drift_names), position[2], calib)
            )
            drift_names.append(f"{name}.bias")
            drift_walk.append(sensor.bias_walk)
            drift_sd.append(max(sensor.bias_sd, 1e-6))
            drift_start.append(float(np.median(s.values[:20])))
    if (standing := setup.standing).intervals:
        speed = np.hypot(rig.zero_velocity.sigma, standing.speed)
        rows.append(measure.velocity_rows(keyframes, standing.intervals, np.full(3, speed)))
        turned = measure.rotation_rows(keyframes, standing.intervals, rig.zero_velocity.turn, standing.angle)
        rows += [turned] if len(turned) else []
    if len(marks := measure.survey_rows(rig.survey, surveyed, keyframes, setup.origin_n)):
        rows.append(marks)
    if rig.motion is not None:
        rows.append(measure.bounded_rows(keyframes, position, rig.motion.radius, rig.motion.speed))
    if not any(kind_of(r.sensor) not in ("zero_velocity", "zero_rotation") for r in rows):
        raise EstimationError(ALONE)

    imu = rig.imu
    inertial = Inertial(
        steps, setup.gyro, setup.acc,
        (factors[0] * imu.gyro_density) ** 2, (factors[1] * imu.acc_density) ** 2,
        imu.gyro_walk**2, imu.acc_walk**2, rig.origin.rate_n, np.array([0.0, 0.0, -rig.origin.gravity]),
    )  # fmt: skip
    drift = np.array(drift_start) - setup.origin_n[2] - position[2] if drift_names else np.zeros(0)
    x = np.concatenate([setup.R_start.ravel(), position, velocity, np.zeros(3), setup.bias_gyro, drift])
    prior = prior_of(setup, x, np.array(drift_sd), bool(fixes) or "start" in [point.at for point in rig.survey])
    return Problem(
        rig, inertial, edges, rows, parameters, tuple(drift_names), np.array(drift_walk), prior, setup.origin_n,
        dict(clocks), samples, setup.counts, {}, [], setup.warnings,
    )  # fmt: skip


def clock_of(parameters: Parameters, sensor: str) -> slice:
    """Where the clock of ``sensor`` lies among ``parameters``: offset and drift."""
    first = parameters.names.index(f"{sensor}.{CLOCK[0]}")
    return slice(first, first + len(CLOCK))


def first_state(setup: Setup, clocks: dict[str, Clock]) -> tuple[Floats, Floats]:
    """Position (from the origin) and velocity in n at the first edge: from the rig, else from the first fixes,
    else from a point surveyed at the start."""
    rig = setup.rig
    position, velocity = rig.initial.position, rig.initial.velocity
    for name, s in setup.samples.items():
        if not is_position(rig, name):
            continue
        t = clocks[name].true(s.t_s) - setup.steps.edges_s[0]
        rows = t < t[0] + 2.0
        degree = 1 if rows.sum() >= 5 and t[0] < 1.0 else 0
        fit = np.polynomial.polynomial.polyfit(t[rows], s.values[rows], degree)
        position = fit[0] - setup.R_start @ rig.sensors[name].arm if position is None else position
        velocity = fit[1] if velocity is None and degree else velocity
        break
    for point in rig.survey:
        position = point.position if position is None and point.at == "start" else position
    position = np.zeros(3) if position is None else position - setup.origin_n
    return position, np.zeros(3) if velocity is None else velocity


def prior_of(setup: Setup, x: Floats, drift_sd: Floats, has_fixes: bool) -> Prior:
    """Covariance of the first state; attitude sds are about n's axes and turned into b."""
    rig = setup.rig
    start, R = rig.initial, x[:9].reshape(3, 3)

    def covariance(yaw_sd: float) -> Floats:
        sd_n = np.array([start.tilt_sd, start.tilt_sd, yaw_sd])
        cov = np.zeros((NAV + len(drift_sd), NAV + len(drift_sd)))
        cov[:3, :3] = R.T @ np.diag(sd_n**2) @ R
        # without a given position the first fix is it: the prior must then not compete with the fixes
        position_sd = start.position_sd if start.position is not None or not has_fixes else max(start.position_sd, 10.0)
        sd = np.repeat([position_sd, start.velocity_sd, rig.imu.acc_bias_sd, rig.imu.gyro_bias_sd], 3)
        cov[3:, 3:] = np.diag(np.concatenate([sd, drift_sd]) ** 2)
        return cov

    filter_cov = covariance(setup.yaw_sd)
    if setup.gyrocompassed:
        # the heading was found with the gyro, so its error is the bias's: d_rot = -up_b (east_b . d_bg) / w_north
        earth_n = rig.origin.rate_n
        east_b = R.T @ np.cross(earth_n, [0.0, 0.0, 1.0]) / np.linalg.norm(earth_n[:2]) ** 2
        cross = -np.outer(R[2], east_b) * rig.imu.gyro_bias_sd**2
        filter_cov[ROT, BG], filter_cov[BG, ROT] = cross, cross.T
        filter_cov[ROT, ROT] += np.outer(R[2], R[2]) * GYROCOMPASS_SLACK**2
    return Prior(x, covariance(start.yaw_sd), filter_cov)
