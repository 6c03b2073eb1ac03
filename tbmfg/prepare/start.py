"""How the machine starts: attitude, heading, gyro bias, and where it stands still."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tbmfg import earth
from tbmfg.fields import MICRO_TESLA
from tbmfg.geometry import rotation_from_rpy, rotation_z, wrap, yaw_of
from tbmfg.inertial import alignment
from tbmfg.inertial.steps import Steps, compensate
from tbmfg.lidar.clouds import Scans
from tbmfg.measure import GyroFrame, Samples, gyro_frame, horizontal_field
from tbmfg.prepare import rest
from tbmfg.prepare.rest import Rest
from tbmfg.prepare.samples import is_position
from tbmfg.problem import STRENGTH, Parameters
from tbmfg.rig import Barometer, Laser, Lidar, Magnetometer, Odometer, PositionSensor, Rig
from tbmfg.state import Calibrated, Counts, Health, Interval
from tbmfg.timeseries import Floats

COURSE_S = 120.0  # of driving that a heading is taken from
COURSE_SD = np.deg2rad(5.0)  # a way that leaves a larger doubt than this is no course
CONTRADICTION = 4.0  # sds between a given heading and the magnetic one from which it is said
GYROCOMPASS = np.deg2rad(15.0)  # a gyro whose bias leaves a larger doubt than this cannot find north


@dataclass(slots=True)
class Setup:
    """What stays the same while offset and noise factor are searched."""

    rig: Rig
    steps: Steps
    frame: GyroFrame
    gyro: Floats
    acc: Floats
    samples: dict[str, Samples]
    parameters: Parameters
    R_start: Floats
    yaw_sd: float
    gyrocompassed: bool
    standing: Rest
    bias_gyro: Floats
    origin_n: Floats
    counts: dict[str, Counts]
    warnings: list[str] = field(default_factory=list)
    calibration: dict[str, Calibrated] = field(default_factory=dict)
    intervals: list[Interval] = field(default_factory=list)
    scans: dict[str, Scans] = field(default_factory=dict)
    health: dict[str, Health] = field(default_factory=dict)


def align(rig: Rig, steps: Steps, samples: dict[str, Samples], counts: dict[str, Counts], warnings: list[str]) -> Setup:
    """Initial attitude, gyro bias, and where the machine stands."""
    still = alignment.still_intervals(steps)
    bias_gyro = np.zeros(3)
    # a tight bias prior must not swallow the Earth rate that a good gyro would find north with
    if still and rig.imu.gyro_bias_sd > 5.0 * earth.RATE:
        longest = max(still, key=lambda s: s[1] - s[0])
        bias_gyro = steps.gyro[alignment.rows_between(steps, *longest)].mean(axis=0)
    gyro, acc = compensate(steps, bias_gyro, np.zeros(3))
    frame = gyro_frame(steps, gyro, bias_gyro)
    R_0t = frame.R_0t
    R_level = alignment.level_at_start(steps, R_0t, still)

    start = rig.initial
    R_level = _with_given_tilt(R_level, start.roll, start.pitch)
    position = next((s for name, s in samples.items() if is_position(rig, name)), None)
    bound = alignment.gyrocompass_bound(rig.imu.gyro_bias_sd, rig.origin.rate_n)
    R_start, yaw_sd, gyrocompassed = R_level, start.yaw_sd, False
    if start.yaw is not None:
        R_start = rotation_z(start.yaw - float(yaw_of(R_level))) @ R_level
        warnings += _against_magnetometer(rig, samples, frame, R_start)
    elif (magnetic := _magnetic_heading(rig, samples, frame, R_level)) is not None:
        R_start, yaw_sd = rotation_z(magnetic[0]) @ R_level, min(yaw_sd, np.deg2rad(10.0))
    elif bound < GYROCOMPASS and (resting := rest.sure(rig, samples, steps, still)):
        turn = alignment.gyrocompass(steps, R_0t, resting, R_level, rig.origin.rate_n)
        R_start, yaw_sd, gyrocompassed = rotation_z(turn) @ R_level, bound, True
        warnings.append(
            f"heading by gyrocompass: at first no better than bias / (w cos lat) = {np.rad2deg(bound):.2g} deg (1 sd)"
        )
    elif (course := _course_heading(rig, samples, frame, R_level)) is not None:
        R_start, yaw_sd = rotation_z(course[0]) @ R_level, max(2.0 * course[1], np.deg2rad(2.0))
    elif position is not None:
        sensor = rig.sensors[position.sensor]
        spread = 3.0 * sensor.clock_offset_sd
        offsets = sensor.clock_offset + (np.arange(-spread, spread + 1e-9, 0.02) if spread else np.zeros(1))
        fit = alignment.fit_motion(
            steps, bias_gyro, R_level, position.t_s, position.values, offsets, rig.origin.gravity
        )
        if fit is None:
            warnings.append(
                "heading is not observable: no stretch of 8 s has motion enough to give it; set initial.yaw_deg"
            )
        else:
            R_start, yaw_sd = rotation_z(fit.heading) @ R_level, max(2.0 * fit.heading_sd, np.deg2rad(5.0))
    else:
        warnings.append("heading is a guess: no magnetometer, no position sensor, no initial.yaw_deg; it is set to 0")

    standing = rest.find(rig, samples, steps, still) if rig.zero_velocity.enabled else rest.NONE
    origin_n = np.round(np.median(position.values[:50], axis=0)) if position is not None else np.zeros(3)
    return Setup(
        rig, steps, frame, gyro, acc, samples, parameters_of(rig, samples, frame, R_start), R_start, yaw_sd,
        gyrocompassed, standing, bias_gyro, origin_n, counts, warnings,
    )  # fmt: skip


def _with_given_tilt(R_level: Floats, roll: float | None, pitch: float | None) -> Floats:
    """The levelled start attitude with roll and pitch from the rig, where it gives them."""
    if roll is None and pitch is None:
        return R_level
    found = np.array(
        [np.arctan2(R_level[2, 1], R_level[2, 2]), -np.arcsin(np.clip(R_level[2, 0], -1, 1)), yaw_of(R_level)]
    )
    given = np.array([found[0] if roll is None else roll, found[1] if pitch is None else pitch, found[2]])
    return rotation_from_rpy(given)


def _magnetic_heading(
    rig: Rig, samples: dict[str, Samples], frame: GyroFrame, R_level: Floats
) -> tuple[float, str, float] | None:
    """Turn about the vertical from the levelled start frame to n by the first ten seconds of magnetometer, the sensor's
    name and the tangent of the dip; None without one."""
    for name, s in samples.items():
        sensor = rig.sensors[name]
        if isinstance(sensor, Magnetometer):
            rows = s.t_s < s.t_s[0] + 10.0
            b = (s.values[rows] - sensor.hard_iron) @ sensor.R_bm.T
            h = np.einsum("nij,nj->ni", frame.at(s.t_s[rows] - sensor.clock_offset), b).mean(axis=0) @ R_level.T
            north = earth.north_direction(rig.origin.x_axis_azimuth) - sensor.declination
            return float(north - np.arctan2(h[1], h[0])), name, float(-h[2] / np.hypot(h[0], h[1]))
    return None


def _against_magnetometer(rig: Rig, samples: dict[str, Samples], frame: GyroFrame, R_start: Floats) -> list[str]:
    """Say where a given heading and the magnetometer contradict each other, and whether turning round the sign of the
    declination would reconcile them. A tilt error turns the magnetic heading by up to tan(dip) times itself (H9)."""
    magnetic = _magnetic_heading(rig, samples, frame, R_start)
    if magnetic is None:
        return []
    turn, name, tan_dip = magnetic
    sensor, start = rig.sensors[name], rig.initial
    sd = np.linalg.norm([start.yaw_sd, sensor.sigma, sensor.declination_sd, tan_dip * start.tilt_sd])
    turn, turned = wrap(np.array([turn, turn + 2.0 * sensor.declination]))
    if abs(turn) < CONTRADICTION * sd:
        return []
    reason = "check declination, mounting and hard iron, and what steel is near"
    if abs(turned) < 0.5 * abs(turn):
        reason = (
            f"with declination_deg={-sensor.declination_deg:g} it would be {np.rad2deg(abs(turned)):.1f} deg: east is "
            "positive"
        )
    apart = f"{np.rad2deg(abs(turn)):.1f} deg from initial.yaw_deg, {abs(turn) / sd:.0f} sd"
    return [f"{name}: its heading over the first 10 s is {apart}; {reason}"]


def _course_heading(
    rig: Rig, samples: dict[str, Samples], frame: GyroFrame, R_level: Floats
) -> tuple[float, float] | None:
    """Turn about the vertical from the levelled start frame to n, and its sd [rad]: the way by odometer and gyro laid
    onto that of the tracked point, over the log's first two minutes. None without both, or without a way to compare."""
    tracked = next((s for name, s in samples.items() if is_position(rig, name)), None)
    wheel = next((s for name, s in samples.items() if isinstance(rig.sensors[name], Odometer)), None)
    if tracked is None or wheel is None:
        return None
    point, odometer = rig.sensors[tracked.sensor], rig.sensors[wheel.sensor]
    t, dt = wheel.t_s - odometer.clock_offset, np.diff(wheel.t_s, prepend=wheel.t_s[0])
    ahead_b = rotation_from_rpy(np.array([0.0, odometer.pitch, odometer.yaw]))[:, 0]
    way = np.cumsum(frame.at(t) @ ahead_b * (wheel.values * dt)[:, None], axis=0)
    fixes = tracked.t_s - point.clock_offset
    rows = (fixes >= t[0]) & (fixes <= min(t[-1], t[0] + COURSE_S))
    if rows.sum() < 3:
        return None
    fixes, z = fixes[rows], tracked.values[rows]
    S = np.stack([np.interp(fixes, t, way[:, axis]) for axis in range(3)], axis=1)
    S = (S + frame.at(fixes) @ (point.arm - odometer.arm)) @ R_level.T
    return alignment.turn_between(S - S.mean(axis=0), z - z.mean(axis=0), COURSE_SD)


def parameters_of(rig: Rig, samples: dict[str, Samples], frame: GyroFrame, R_start: Floats) -> Parameters:
    """The constant calibrations of the sensors at hand, with the rig's priors; of the Earth's horizontal field, that a
    machine's own is told by, with what the log begins with, at ``R_start`` (3, 3)."""
    entries: list[tuple[str, float, float]] = []
    for name in samples:
        sensor = rig.sensors[name]
        if isinstance(sensor, PositionSensor):
            entries += [(f"{name}.arm_{axis}", sensor.arm[k], sensor.arm_sd) for k, axis in enumerate("xyz")]
            entries += [(f"{name}.clock_offset", sensor.clock_offset, sensor.clock_offset_sd)]
            entries += [(f"{name}.clock_drift", 0.0, sensor.clock_drift_sd)]  # beside the one in the rig
        elif isinstance(sensor, Odometer):
            entries += [(f"{name}.scale", sensor.scale, sensor.scale_sd)]
            entries += [(f"{name}.{axis}", getattr(sensor, axis), sensor.mounting_sd) for axis in ("yaw", "pitch")]
        elif isinstance(sensor, Magnetometer):
            entries += [(f"{name}.declination", sensor.declination, sensor.declination_sd)]
            entries += [(f"{name}.iron_{axis}", 0.0, sensor.hard_iron_sd_ut) for axis in "xyz"]
            if sensor.hard_iron_sd_ut:
                found = horizontal_field(sensor, samples[name], frame, R_start, rig.initial.tilt_sd)
                entries += [(f"{name}.{STRENGTH}", found[0] / MICRO_TESLA, found[1] / MICRO_TESLA)]
        elif isinstance(sensor, Lidar):
            entries += [(f"{name}.mount_{axis}", sensor.T_bl.xyz[k], sensor.xyz_sd) for k, axis in enumerate("xyz")]
            entries += [(f"{name}.turn_{axis}", 0.0, sensor.rpy_sd) for axis in "xyz"]
        elif isinstance(sensor, Barometer):
            entries += [(f"{name}.scale", sensor.scale_at(float(np.median(samples[name].values))), sensor.scale_sd)]
            entries += [(f"{name}.lapse", 0.0, sensor.lapse_sd)]
        elif isinstance(sensor, Laser):
            entries += [(f"{name}.tilt_{axis}", sensor.tilt[k], sensor.tilt_sd) for k, axis in enumerate("xy")]
            entries += [(f"{name}.offset_{axis}", 0.0, sensor.offset_sd) for axis in "xy"]
    names, mean, sd = zip(*entries, strict=True) if entries else ((), (), ())
    return Parameters(tuple(names), np.array(mean, float), np.array(sd, float), np.array(mean, float))
