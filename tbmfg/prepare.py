"""From a log and a rig to the problem that every estimator solves: once per log, alike for all.

Time repair, initial alignment, keyframes and rows; and, where the rig asks for it, the clock offset and the
noise factor of the IMU, found from the log itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from tbmfg import earth, gnss, measure
from tbmfg.errors import EstimationError, LogError, RigError
from tbmfg.filters import ins
from tbmfg.geometry import rotation_from_rpy, rotation_z, yaw_of
from tbmfg.inertial import alignment, sanity
from tbmfg.inertial.noise import spectral_floor
from tbmfg.inertial.steps import Steps, compensate, make_steps, to_ns
from tbmfg.inertial.strapdown import rotations
from tbmfg.mcap.clouds import TYPE as CLOUDS
from tbmfg.mcap.info import guess_role
from tbmfg.measure import GyroFrame, Samples
from tbmfg.problem import Inertial, Parameters, Prior, Problem, breakdown_explained
from tbmfg.rig import Barometer, Magnetometer, Odometer, PositionSensor, Prism, Rig, Sensor, kind_of
from tbmfg.state import BG, NAV, ROT, Calibrated, Counts, Interval
from tbmfg.timeseries import Floats, Log, Series, seconds

Prepared = Problem

VALUES = {  # column of the series that each kind of sensor measures with
    "prism": lambda series: series["point"],
    "gnss": lambda series: series["point"],
    "odometer": lambda series: series["linear"][:, 0],
    "magnetometer": lambda series: series["field"],
    "barometer": lambda series: pressure_height(series["pressure"]),
}
ALONE = (
    "nothing but the IMU to go by; an estimate needs a prism, gnss, odometer, magnetometer or barometer as well, "
    "or a motion bound in the rig"
)
LEAST_IMU = 3
SEARCH_S = 300.0  # offset and noise factor are found on at most this much of a log
GYROCOMPASS = np.deg2rad(15.0)  # a gyro whose bias leaves a larger doubt than this cannot find north
GYROCOMPASS_SLACK = np.deg2rad(0.1)  # of the coarse heading beside the bias: noise and motion of the still stretch
FACTOR_RANGE = (1.0, 1e3)  # a data sheet is the best that a unit does; beyond the upper end it is not the unit
SCALE_PRIOR_LOG2 = 0.7  # sd of log2 of the noise against the spectrum's floor, for logs that hardly say


@dataclass(slots=True)
class _Setup:
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
    still: list[tuple[float, float]]
    still_sigma: Floats
    bias_gyro: Floats
    origin_n: Floats
    counts: dict[str, Counts]
    warnings: list[str] = field(default_factory=list)


def pressure_height(pressure: Floats) -> Floats:
    """Height in the standard atmosphere [m] for pressure [Pa]; ISO 2533, troposphere."""
    return 44330.77 * (1.0 - (pressure / 101325.0) ** 0.190263)


def prepare(
    log: Log,
    rig: Rig,
    *,
    outages: tuple[tuple[str, float, float], ...] = (),
    without: tuple[str, ...] = (),
    progress: Callable[[str, float], None] | None = None,
) -> Problem:
    """Everything an estimator needs.

    ``outages`` are (sensor, start, end) in s from the first IMU sample, stamps as recorded; ``without`` names sensors
    to leave aside. Raises LogError without IMU samples, RigError for names that the rig does not have.
    """
    tell = progress or (lambda stage, share: None)
    tell("prepare", 0.0)
    for name in [sensor for sensor, _, _ in outages] + list(without):
        if name not in rig.sensors:
            raise RigError(f"no sensor {name!r} in rig {rig.name!r}; it has {', '.join(rig.sensors)}")
    log, rig, said = gnss.into_n(log, rig)
    warnings: list[str] = [*log.damage, *_losses(log, rig, without), *said]
    steps, imu_counts = _imu_steps(log, rig, outages, warnings)
    missing: list[str] = []
    samples, counts = _samples(log, rig, steps, outages, without, missing)
    if not samples and rig.motion is None:
        raise EstimationError("; ".join([f"{log.path}: {ALONE}", *missing]))
    warnings += missing
    counts = {"imu": imu_counts, **counts}
    with breakdown_explained("preparing the estimate"):
        setup = _align(rig, steps, samples, counts, warnings)
        offsets = {name: rig.sensors[name].clock_offset for name in samples if _is_position(rig, name)}
        problem = _search(setup, offsets, tell)
    problem.intervals = [
        *(Interval("imu", "gap", *(int(t) for t in to_ns(steps, np.array(gap)))) for gap in steps.gaps),
        *(Interval(name, "outage", *(int(t) for t in to_ns(steps, np.array([a, b])))) for name, a, b in outages),
        *(Interval("zero_velocity", "standing", *(int(t) for t in to_ns(steps, np.array(s)))) for s in setup.still),
    ]
    tell("prepare", 1.0)
    return problem


def _is_position(rig: Rig, name: str) -> bool:
    return isinstance(rig.sensors[name], PositionSensor)


def _imu_steps(
    log: Log, rig: Rig, outages: tuple[tuple[str, float, float], ...], warnings: list[str]
) -> tuple[Steps, Counts]:
    """Integration steps of the IMU, in SI and b axes."""
    topic = rig.imu.topic
    series = log.series.get(topic)
    if series is None:
        raise LogError(f"{log.path}: imu: {_absence(log, 'imu', topic)}; every estimator needs an IMU")
    if "gyro" not in series.columns:
        raise LogError(f"{log.path}: imu: {topic} is {series.type}, {_instead(log, 'imu')}; set sensors.imu.topic")
    c = series.counts
    units = {"gyro": rig.imu.gyro_scale, "acc": rig.imu.acc_scale}
    series = replace(series, columns={column: scale * series[column] for column, scale in units.items()})
    if (wrong := sanity.impossible(series)).any():
        limits = " rad/s or ".join(f"{limit:g}" for limit in sanity.POSSIBLE.values())
        warnings.append(f"imu: {wrong.sum()} of {len(series)} samples are beyond {limits} m/s^2; left out")
        series = series.select(~wrong)
    hidden = _hidden("imu", seconds(series.t_ns, series.t_ns[0] if len(series) else 0), outages)
    series = series.select(~hidden)
    if len(series) < LEAST_IMU:
        lost = {"hold NaN": c.nonfinite, "repeat a stamp": c.duplicate, "bear a wrong stamp": c.misdated}
        why = ", ".join(f"{count} {what}" for what, count in lost.items() if count) or "there are no more"
        raise LogError(f"{log.path}: {topic}: {len(series)} usable of {c.received} IMU samples ({why}); check the IMU")
    counts = Counts(
        received=c.received,
        used=len(series),
        duplicate=c.duplicate,
        nonfinite=c.nonfinite,
        outage=int(hidden.sum()),
    )
    steps = make_steps(series, rig.imu.T_bi.R, rig.imu.stamp)
    if (fault := sanity.fault(steps)) is not None:
        raise LogError(f"{log.path}: {topic}: {fault}")
    if stretches := sanity.stuck(series):
        t = seconds(series.t_ns, steps.t0_ns)
        first, last = max(stretches, key=lambda s: t[s[1]] - t[s[0]])
        warnings.append(
            f"imu: hangs on one reading: stretches: {len(stretches)}, the longest {t[last] - t[first]:.2f} s at "
            f"{t[first]:.2f} s; nothing it says there is true"
        )
    if steps.gaps:
        lengths = [end - start for start, end in steps.gaps]
        longest = int(np.argmax(lengths))
        warnings.append(
            f"imu: gaps: {len(lengths)}, {sum(lengths):.3g} s together, the longest {lengths[longest]:.3g} s at "
            f"{steps.gaps[longest][0]:.2f} s; bridged by interpolation, with its error as noise"
        )
    return steps, counts


def _samples(log, rig, steps, outages, without, warnings) -> tuple[dict[str, Samples], dict[str, Counts]]:
    """Usable samples by sensor, and the counts so far (used is filled in by the estimators)."""
    samples, counts = {}, {}
    for name, sensor in rig.sensors.items():
        kind = kind_of(name)
        if kind == "imu":
            continue
        series = log.series.get(sensor.topic)
        if series is None and sensor.topic not in log.clouds:
            warnings.append(f"{name}: {_absence(log, kind, sensor.topic)}; it is not used")
            continue
        series = log.clouds[sensor.topic] if series is None else series
        c = series.counts
        counts[name] = count = Counts(received=c.received, duplicate=c.duplicate, nonfinite=c.nonfinite)
        if name in without or kind not in VALUES:
            if name not in without:
                warnings.append(
                    f"{name}: no model for this kind of sensor yet; its {len(series)} messages are not used"
                )
            count.unused = len(series)
            continue
        t = seconds(series.t_ns, steps.t0_ns)
        out = _hidden(name, t, outages)
        offset, spread = getattr(sensor, "clock_offset", 0.0), 3.0 * getattr(sensor, "clock_offset_sd", 0.0)
        inside = (t - offset - spread >= steps.edges_s[0]) & (t - offset + spread <= steps.end_s)
        count.outage = int(out.sum())
        count.unused = int((~out & ~inside).sum())
        keep = ~out & inside
        if keep.sum() < 2:
            apart = f"; its stamps begin {t[0]:.1f} s from the IMU's" if len(t) and not inside.any() else ""
            warnings.append(
                f"{name}: {int(keep.sum())} of {len(t)} samples lie in the IMU span and outside outages, which is "
                f"not enough{apart}; it is not used"
            )
            count.unused += int(keep.sum())
            continue
        try:
            values = np.ascontiguousarray(VALUES[kind](series))
        except KeyError:
            raise LogError(f"{log.path}: {name}: {sensor.topic} is {series.type}, {_instead(log, kind)}") from None
        samples[name] = Samples(name, t, values, _sigma(sensor, series)).select(keep)
    return samples, counts


def _hidden(name: str, t_s: Floats, outages: tuple[tuple[str, float, float], ...]) -> np.ndarray:
    """Which samples of the sensor ``name`` lie in an outage of its own, (n,) bool."""
    out = np.zeros(len(t_s), dtype=bool)
    for sensor, start, end in outages:
        if sensor == name:
            out |= (t_s >= start) & (t_s < end)
    return out


def _losses(log: Log, rig: Rig, without: tuple[str, ...]) -> list[str]:
    """What the reader left out of the sensors' messages and the counts do not name."""
    said = []
    for name, sensor in rig.sensors.items():
        source = log.series.get(sensor.topic, log.clouds.get(sensor.topic))
        if source is None or name in without:
            continue
        for count, what in (
            (source.counts.misdated, "bear a stamp that cannot be right"),
            (source.counts.undecodable, "cannot be decoded"),
        ):
            if count:
                total = source.counts.received + source.counts.undecodable
                said.append(f"{name}: {count} of {total} messages on {sensor.topic} {what}; left out")
    return said


def _absence(log: Log, kind: str, topic: str) -> str:
    """Why there are no samples of a topic, and what could be meant."""
    if topic in log.unknown:
        return f"{topic} is {log.unknown[topic]}, which is not read"
    return f"no messages on {topic}, {_instead(log, kind)}"


def _instead(log: Log, kind: str) -> str:
    """The topics of the log that a kind of sensor could be."""
    types = {topic: series.type for topic, series in log.series.items()} | dict.fromkeys(log.clouds, CLOUDS)
    alike = sorted(topic for topic, type in types.items() if guess_role(topic, type) == kind)
    return f"{kind} topics in the log: {', '.join(alike) or 'none'}"


def _sigma(sensor: Sensor, series: Series) -> Floats | None:
    """Standard deviation per axis of n of positions [m], (n, 3): the fix's own, or a total station's at that range."""
    if isinstance(sensor, Prism):
        return np.repeat(sensor.sigma_at(series["point"])[:, None], 3, axis=1)
    return series["sigma"] if isinstance(sensor, PositionSensor) else None


def _parameters(rig: Rig, samples: dict[str, Samples]) -> Parameters:
    """The constant calibrations of the sensors at hand, with the rig's priors."""
    entries: list[tuple[str, float, float]] = []
    for name in samples:
        sensor = rig.sensors[name]
        if isinstance(sensor, PositionSensor):
            entries += [(f"{name}.arm_{axis}", sensor.arm[k], sensor.arm_sd) for k, axis in enumerate("xyz")]
            entries += [(f"{name}.clock_offset", sensor.clock_offset, sensor.clock_offset_sd)]
        elif isinstance(sensor, Odometer):
            entries += [(f"{name}.scale", sensor.scale, sensor.scale_sd)]
            entries += [(f"{name}.{axis}", getattr(sensor, axis), sensor.mounting_sd) for axis in ("yaw", "pitch")]
        elif isinstance(sensor, Magnetometer):
            entries += [(f"{name}.declination", sensor.declination, sensor.declination_sd)]
    names, mean, sd = zip(*entries, strict=True) if entries else ((), (), ())
    return Parameters(tuple(names), np.array(mean, float), np.array(sd, float), np.array(mean, float))


def _align(
    rig: Rig, steps: Steps, samples: dict[str, Samples], counts: dict[str, Counts], warnings: list[str]
) -> _Setup:
    """Initial attitude, gyro bias, and where the machine stands."""
    still = alignment.still_intervals(steps)
    bias_gyro = np.zeros(3)
    # a tight bias prior must not swallow the Earth rate that a good gyro would find north with
    if still and rig.imu.gyro_bias_sd > 5.0 * earth.RATE:
        longest = max(still, key=lambda s: s[1] - s[0])
        bias_gyro = steps.gyro[alignment.rows_between(steps, *longest)].mean(axis=0)
    gyro, acc = compensate(steps, bias_gyro, np.zeros(3))
    R_0t = rotations(steps.edges_s, gyro, bias_gyro)
    frame = GyroFrame(steps, R_0t, gyro - bias_gyro, bias_gyro)
    R_level = alignment.level_at_start(steps, R_0t, still)

    start = rig.initial
    R_level = _with_given_tilt(R_level, start.roll, start.pitch)
    position = next((s for name, s in samples.items() if _is_position(rig, name)), None)
    bound = alignment.gyrocompass_bound(rig.imu.gyro_bias_sd, rig.origin.rate_n)
    R_start, yaw_sd, gyrocompassed = R_level, start.yaw_sd, False
    if start.yaw is not None:
        R_start = rotation_z(start.yaw - float(yaw_of(R_level))) @ R_level
    elif (found := _magnetic_heading(rig, samples, frame, R_level)) is not None:
        R_start, yaw_sd = rotation_z(found) @ R_level, min(yaw_sd, np.deg2rad(10.0))
    elif still and bound < GYROCOMPASS:
        turn = alignment.gyrocompass(steps, R_0t, still, R_level, rig.origin.rate_n)
        R_start, yaw_sd, gyrocompassed = rotation_z(turn) @ R_level, bound, True
        warnings.append(
            f"heading by gyrocompass: at first no better than bias / (w cos lat) = {np.rad2deg(bound):.2g} deg (1 sd)"
        )
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

    confirmed = _confirmed_rest(rig, samples, still) if rig.zero_velocity.enabled else []
    sigma = np.hypot(rig.zero_velocity.sigma, _vibration_speed(steps, confirmed))
    origin_n = np.round(np.median(position.values[:50], axis=0)) if position is not None else np.zeros(3)
    return _Setup(
        rig, steps, frame, gyro, acc, samples, _parameters(rig, samples), R_start, yaw_sd, gyrocompassed, confirmed,
        np.full(3, sigma), bias_gyro, origin_n, counts, warnings,
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


def _magnetic_heading(rig: Rig, samples: dict[str, Samples], frame: GyroFrame, R_level: Floats) -> float | None:
    """Turn about the vertical from the levelled start frame to n by the first ten seconds of magnetometer, or None."""
    for name, s in samples.items():
        sensor = rig.sensors[name]
        if isinstance(sensor, Magnetometer):
            rows = s.t_s < s.t_s[0] + 10.0
            b = (s.values[rows] - sensor.hard_iron) @ sensor.R_bm.T
            h = np.einsum("nij,nj->ni", frame.at(s.t_s[rows] - sensor.clock_offset), b).mean(axis=0) @ R_level.T
            north = earth.north_direction(rig.origin.x_axis_azimuth) - sensor.declination
            return float(north - np.arctan2(h[1], h[0]))
    return None


def _confirmed_rest(
    rig: Rig, samples: dict[str, Samples], still: list[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Still stretches, cut to the time in which a position sensor or an odometer says that the machine stands."""
    confirmed = []
    for start, end in still:
        for name, s in samples.items():
            sensor = rig.sensors[name]
            t = s.t_s - getattr(sensor, "clock_offset", 0.0)
            rows = (t >= start) & (t <= end)
            if rows.sum() < 3:
                continue
            values = s.values[rows]
            if isinstance(sensor, PositionSensor):
                spread = np.abs(values - np.median(values, axis=0)).max(axis=1)
                resting = bool(np.all(spread < 5.0 * s.sigma[rows].max(axis=1)))
            elif isinstance(sensor, Odometer):
                resting = bool(abs(np.mean(values)) < 3.0 * sensor.sigma / np.sqrt(rows.sum()) + 1e-3)
            else:
                continue
            # the stamps' offset may be unknown: leave its spread free on either side
            margin = 3.0 * getattr(sensor, "clock_offset_sd", 0.0)
            first, last = float(t[rows][0]) + margin, float(t[rows][-1]) - margin
            if resting and last > first:
                confirmed.append((first, last))
            break
    return confirmed


def _vibration_speed(steps: Steps, intervals: list[tuple[float, float]]) -> float:
    """RMS of the vibration's velocity per axis [m/s] while standing: what a zero velocity must allow for."""
    squares = []
    for start, end in intervals:
        rows = alignment.rows_between(steps, start, min(end, start + 10.0))
        force = steps.acc[rows]
        if len(force) < 10:
            continue
        v = np.cumsum((force - force.mean(axis=0)) * steps.dt[rows][:, None], axis=0)
        # drift of the mean over a second is no vibration
        size = max(1, round(1.0 / steps.period_s))
        smooth = np.stack([np.convolve(v[:, a], np.ones(size) / size, mode="same") for a in range(3)], axis=1)
        squares.append(np.mean((v - smooth)[size:-size] ** 2) if len(v) > 3 * size else np.mean((v - smooth) ** 2))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


def _build(setup: _Setup, offsets: dict[str, float], factors: Floats, end_s: float | None = None) -> Problem:
    """The problem for given clock offsets and noise factors (gyro, accelerometer), up to ``end_s``."""
    rig, steps = setup.rig, setup.steps
    end_s = steps.end_s if end_s is None else min(end_s, steps.end_s)
    samples = {
        name: s.select(rows)
        for name, s in setup.samples.items()
        if (rows := s.t_s - offsets.get(name, 0.0) <= end_s).sum() >= 2
    }
    mean, begin = setup.parameters.mean.copy(), setup.parameters.mean.copy()
    for name, offset in offsets.items():
        k = setup.parameters.names.index(f"{name}.clock_offset")
        mean[k], begin[k] = mean[k] - offset, 0.0
    parameters = replace(setup.parameters, mean=mean, start=begin)

    fixes = [s.t_s - offsets[name] for name, s in samples.items() if _is_position(rig, name)]
    fixes_s = np.sort(np.concatenate(fixes)) if fixes else np.zeros(0)
    edges = measure.keyframe_edges(rig.keyframes, steps.edges_s, end_s, fixes_s)
    keyframes = steps.edges_s[edges]
    rows, drift_names, drift_walk, drift_sd, drift_start = [], [], [], [], []
    for name, s in samples.items():
        sensor, calib = rig.sensors[name], parameters.slice(name)
        if isinstance(sensor, PositionSensor):
            rows.append(measure.position_rows(sensor, s, offsets[name], keyframes, setup.frame, setup.origin_n, calib))
        elif isinstance(sensor, Odometer):
            rows.append(measure.odometer_rows(sensor, s, keyframes, setup.frame, calib))
        elif isinstance(sensor, Magnetometer):
            rows.append(measure.magnetometer_rows(sensor, s, keyframes, setup.frame, rig.origin.x_axis_azimuth, calib))
        elif isinstance(sensor, Barometer):
            rows.append(measure.barometer_rows(sensor, s, keyframes, setup.origin_n, len(drift_names)))
            drift_names.append(f"{name}.bias")
            drift_walk.append(sensor.bias_walk)
            drift_sd.append(max(sensor.bias_sd, 1e-6))
            drift_start.append(float(np.median(s.values[:20])))
    if setup.still:
        rows.append(measure.velocity_rows(keyframes, setup.still, setup.still_sigma))
    position, velocity = _start(setup, offsets)
    if rig.motion is not None:
        rows.append(measure.bounded_rows(keyframes, position, rig.motion.radius, rig.motion.speed))
    if not any(kind_of(r.sensor) != "zero_velocity" for r in rows):
        raise EstimationError(ALONE)

    imu = rig.imu
    inertial = Inertial(
        steps, setup.gyro, setup.acc,
        (factors[0] * imu.gyro_density) ** 2, (factors[1] * imu.acc_density) ** 2,
        imu.gyro_walk**2, imu.acc_walk**2, rig.origin.rate_n, np.array([0.0, 0.0, -rig.origin.gravity]),
    )  # fmt: skip
    drift = np.array(drift_start) - setup.origin_n[2] - position[2] if drift_names else np.zeros(0)
    x = np.concatenate([setup.R_start.ravel(), position, velocity, np.zeros(3), setup.bias_gyro, drift])
    prior = _prior(setup, x, np.array(drift_sd), bool(fixes))
    return Problem(
        rig, inertial, edges, rows, parameters, tuple(drift_names), np.array(drift_walk), prior, setup.origin_n,
        dict(offsets), setup.counts, {}, [], setup.warnings,
    )  # fmt: skip


def _start(setup: _Setup, offsets: dict[str, float]) -> tuple[Floats, Floats]:
    """Position (from the origin) and velocity in n at the first edge: from the rig, else from the first fixes."""
    rig = setup.rig
    position, velocity = rig.initial.position, rig.initial.velocity
    for name, s in setup.samples.items():
        if not _is_position(rig, name):
            continue
        t = s.t_s - offsets[name] - setup.steps.edges_s[0]
        rows = t < t[0] + 2.0
        degree = 1 if rows.sum() >= 5 and t[0] < 1.0 else 0
        fit = np.polynomial.polynomial.polyfit(t[rows], s.values[rows], degree)
        position = fit[0] - setup.R_start @ rig.sensors[name].arm if position is None else position
        velocity = fit[1] if velocity is None and degree else velocity
        break
    position = np.zeros(3) if position is None else position - setup.origin_n
    return position, np.zeros(3) if velocity is None else velocity


def _prior(setup: _Setup, x: Floats, drift_sd: Floats, has_fixes: bool) -> Prior:
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


def _search(setup: _Setup, offsets: dict[str, float], tell: Callable[[str, float], None]) -> Problem:
    """Clock offsets and noise factors from the log, alternating, then the problem at what was found.

    A constant's last estimate by a filter holds all that the log says about it, so the offsets are states of ``ins``;
    keyframes move with them until they stand. Noise: the IMU's own spectrum says how much noisier than the data
    sheet gyro and accelerometer can be at most; one scale on both minimises the filter's likelihood cost.
    """
    imu = setup.rig.imu
    auto = imu.noise_factor == "auto"
    floors = spectral_floor(setup.steps) if auto else (imu.gyro_density, imu.acc_density)
    split = np.clip([floors[0] / imu.gyro_density, floors[1] / imu.acc_density], *FACTOR_RANGE)
    scale, sd = (1.0 if auto else float(imu.noise_factor)), 0.0
    names = setup.parameters.names
    unknown = [n for n in offsets if setup.parameters.sd[names.index(f"{n}.clock_offset")] > 0]
    for name in unknown:
        offsets[name] = _coarse_offset(setup, name)
    for turn in range(2 if auto and unknown else 1):
        if unknown:
            offset_sd = _settle_offsets(setup, offsets, scale * split, unknown)
        if auto:
            scale, sd = _noise_scale(setup, offsets, split, scale)
        tell("prepare", 0.5 + 0.25 * turn)
    factors = np.maximum(scale * split, 1.0) if auto else scale * split
    problem = _build(setup, offsets, factors)
    named = {"noise_factor_gyro": factors[0], "noise_factor_acc": factors[1], "noise_factor": np.sqrt(np.prod(factors))}
    for key, value in named.items():
        problem.calibration[key] = Calibrated(float(value), float(value * sd / scale), auto)
    for name in unknown:
        problem.calibration[f"{name}_clock_offset_s"] = Calibrated(offsets[name], offset_sd[name], True)
    return problem


def _settle_offsets(setup: _Setup, offsets: dict[str, float], factors: Floats, unknown: list[str]) -> dict[str, float]:
    """Move the keyframes with the offsets that ``ins`` estimates until they stand, in place; their sds in s."""
    for _ in range(4):
        problem = _build(setup, offsets, factors, SEARCH_S)
        filtered = ins.run(problem)
        where = {name: problem.parameters.names.index(f"{name}.clock_offset") for name in unknown}
        for name, k in where.items():
            offsets[name] += float(filtered.c[k])
        if max(abs(filtered.c[k]) for k in where.values()) < 1e-4:
            break
    return {name: float(np.sqrt(filtered.c_cov[k, k])) for name, k in where.items()}


def _coarse_offset(setup: _Setup, name: str) -> float:
    """Clock offset by fitting the sensor's motion to the inertial one over three sd of the prior."""
    sensor, s = setup.rig.sensors[name], setup.samples[name]
    spread = 3.0 * sensor.clock_offset_sd
    grid = sensor.clock_offset + np.linspace(-spread, spread, 2 * max(2, int(np.ceil(spread / 0.02))) + 1)
    R_level = setup.R_start
    fit = alignment.fit_motion(setup.steps, setup.bias_gyro, R_level, s.t_s, s.values, grid, setup.rig.origin.gravity)
    if fit is None:
        setup.warnings.append(
            f"{name}: clock offset not observable: the machine hardly moved; it stays at the rig's value"
        )
        return sensor.clock_offset
    return fit.clock_offset_s


def _noise_scale(setup: _Setup, offsets: dict[str, float], split: Floats, start: float) -> tuple[float, float]:
    """Scale on ``split`` that minimises the cost of ``ins`` (-2 log likelihood), and its sd from the curvature in
    the logarithm; at least what the data sheet says, at most what the spectrum allows."""
    costs: dict[float, float] = {}

    def cost(log2: float) -> float:
        if log2 not in costs:
            problem = _build(setup, offsets, 2.0**log2 * split, SEARCH_S)
            costs[log2] = ins.run(problem, fixed=("clock_offset",)).cost + (log2 / SCALE_PRIOR_LOG2) ** 2
        return costs[log2]

    step, best = 0.5, round(2.0 * np.log2(start)) / 2.0
    while (lower := min((best - step, best + step), key=cost)) is not None and cost(lower) < cost(best):
        best = lower
    a, b, c = (cost(best + k) for k in (-step, 0.0, step))
    curvature = (a - 2.0 * b + c) / step**2
    vertex = best + 0.5 * step * (a - c) / (a - 2.0 * b + c)
    scale = 2.0**vertex
    return float(scale), float(scale * np.sqrt(2.0 / curvature) * np.log(2.0))
