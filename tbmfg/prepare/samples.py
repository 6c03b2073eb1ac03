"""From topics to usable samples: units, clocks, outages, and what was lost on the way, counted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tbmfg.errors import LogError
from tbmfg.inertial import sanity
from tbmfg.inertial.steps import Steps, make_steps
from tbmfg.mcap.clouds import TYPE as CLOUDS
from tbmfg.mcap.info import guess_role
from tbmfg.measure import Samples
from tbmfg.prepare import health, units
from tbmfg.rig import Gnss, PositionSensor, Rig, Sensor, kind_of
from tbmfg.state import Counts
from tbmfg.timeseries import Floats, Log, Series, seconds

VALUES = {  # column of the series that each kind of sensor measures with
    "prism": lambda series: series["point"],
    "gnss": lambda series: series["point"],
    "odometer": lambda series: series["linear"][:, 0],
    "magnetometer": lambda series: series["field"],
    "barometer": lambda series: pressure_height(series["pressure"]),
    "laser": lambda series: series["point"][:, :2],
}
ALONE = (
    "nothing but the IMU to go by; an estimate needs a prism, gnss, odometer, magnetometer, barometer, laser or lidar "
    "too, or a motion bound in the rig"
)
LEAST_IMU = 3


def pressure_height(pressure: Floats) -> Floats:
    """Height in the standard atmosphere [m] for pressure [Pa]; ISO 2533, troposphere."""
    return 44330.77 * (1.0 - (pressure / 101325.0) ** 0.190263)


def is_position(rig: Rig, name: str) -> bool:
    return isinstance(rig.sensors[name], PositionSensor)


def imu_steps(
    log: Log, rig: Rig, outages: tuple[tuple[str, float, float], ...], warnings: list[str]
) -> tuple[Steps, Counts]:
    """Integration steps of the IMU, in SI and b axes."""
    topic = rig.imu.topic
    series = log.series.get(topic)
    if series is None:
        raise LogError(f"{log.path}: imu: {absence(log, 'imu', topic)}; every estimator needs an IMU")
    if "gyro" not in series.columns:
        raise LogError(f"{log.path}: imu: {topic} is {series.type}, {instead(log, 'imu')}; set sensors.imu.topic")
    c = series.counts
    scales = {"gyro": rig.imu.gyro_scale, "acc": rig.imu.acc_scale}
    series = replace(series, columns={column: scale * series[column] for column, scale in scales.items()})
    if (wrong := sanity.impossible(series)).any():
        limits = " rad/s or ".join(f"{limit:g}" for limit in sanity.POSSIBLE.values())
        warnings.append(f"imu: {wrong.sum()} of {len(series)} samples are beyond {limits} m/s^2; left out")
        series = series.select(~wrong)
    outage = hidden("imu", seconds(series.t_ns, series.t_ns[0] if len(series) else 0), outages)
    series = series.select(~outage)
    if len(series) < LEAST_IMU:
        lost = {"hold NaN": c.nonfinite, "repeat a stamp": c.duplicate, "bear a wrong stamp": c.misdated}
        why = ", ".join(f"{count} {what}" for what, count in lost.items() if count) or "there are no more"
        raise LogError(f"{log.path}: {topic}: {len(series)} usable of {c.received} IMU samples ({why}); check the IMU")
    if (fault := sanity.fault(make_steps(series, rig.imu.T_bi.R, rig.imu.stamp))) is not None:
        raise LogError(f"{log.path}: {topic}: {fault}")
    if stretches := sanity.stuck(series):
        t = seconds(series.t_ns, int(series.t_ns[0]))
        first, last = max(stretches, key=lambda s: t[s[1]] - t[s[0]])
        repeats = np.concatenate([np.arange(a + 1, b + 1) for a, b in stretches])
        series = series.select(np.setdiff1d(np.arange(len(series)), repeats))
        warnings.append(
            f"imu: hangs on one reading: stretches: {len(stretches)}, the longest {t[last] - t[first]:.2f} s at "
            f"{t[first]:.2f} s; its {len(repeats)} repeats are left out"
        )
        if len(series) < LEAST_IMU:
            raise LogError(f"{log.path}: {topic}: {warnings[-1]}, and {len(series)} samples remain; check the IMU")
    for axis, end, at in sanity.saturated(series):
        first = float(seconds(series.t_ns, int(series.t_ns[0]))[np.argmax(at)])
        unit = "rad/s" if axis.startswith("gyro") else "m/s^2"
        warnings.append(
            f"imu: {axis} is at the end of its scale, {end:.4g} {unit}, in {at.sum()} of {len(series)} samples, the "
            f"first at {first:.1f} s: what it felt beyond is lost, and the sds do not know of it"
        )
    steps = make_steps(series, rig.imu.T_bi.R, rig.imu.stamp)
    counts = Counts(
        received=c.received,
        used=len(series),
        duplicate=c.duplicate,
        nonfinite=c.nonfinite,
        outage=int(outage.sum()),
    )
    if steps.gaps:
        lengths = [end - start for start, end in steps.gaps]
        longest = int(np.argmax(lengths))
        warnings.append(
            f"imu: gaps: {len(lengths)}, {sum(lengths):.3g} s together, the longest {lengths[longest]:.3g} s at "
            f"{steps.gaps[longest][0]:.2f} s; bridged by interpolation, with its error as noise"
        )
    return steps, counts


def usable_samples(log, rig, steps, outages, without, warnings) -> tuple[dict[str, Samples], dict[str, Counts]]:
    """Usable samples by sensor, and the counts so far (used is filled in by the estimators)."""
    samples, counts = {}, {}
    for name, sensor in rig.sensors.items():
        kind = kind_of(name)
        if kind == "imu":
            continue
        series = log.series.get(sensor.topic)
        if series is None and sensor.topic not in log.clouds:
            warnings.append(f"{name}: {absence(log, kind, sensor.topic)}; it is not used")
            continue
        series = log.clouds[sensor.topic] if series is None else series
        c = series.counts
        counts[name] = count = Counts(received=c.received, duplicate=c.duplicate, nonfinite=c.nonfinite)
        if kind == "lidar" and name not in without:
            continue  # not columns, but scans to be registered: ``scans``
        read = readings(kind, sensor)
        if name in without or read is None:
            if name not in without:
                warnings.append(
                    f"{name}: no model for this kind of sensor yet; its {len(series)} messages are not used"
                )
            count.unused = len(series)
            continue
        t = seconds(series.t_ns, steps.t0_ns)
        out = hidden(name, t, outages)
        t = t - getattr(sensor, "clock_drift", 0.0) * t  # what is known of it; from here on the rest is meant
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
            values = np.ascontiguousarray(read(units.in_si(log.path, name, sensor, series)))
        except KeyError:
            raise LogError(f"{log.path}: {name}: {sensor.topic} is {series.type}, {instead(log, kind)}") from None
        found = Samples(name, t, values, sigma_of(sensor, series, values)).select(keep)
        sound, said = health.check(sensor, found)
        warnings += [f"{name}: {line}" for line in said]
        if sound.sum() >= 2:
            samples[name] = found.select(sound)
    return samples, counts


def hidden(name: str, t_s: Floats, outages: tuple[tuple[str, float, float], ...]) -> np.ndarray:
    """Which samples of the sensor ``name`` lie in an outage of its own, (n,) bool."""
    out = np.zeros(len(t_s), dtype=bool)
    for sensor, start, end in outages:
        if sensor == name:
            out |= (t_s >= start) & (t_s < end)
    return out


def absence(log: Log, kind: str, topic: str) -> str:
    """Why there are no samples of a topic, and what could be meant."""
    if topic in log.unknown:
        return f"{topic} is {log.unknown[topic]}, which is not read"
    return f"no messages on {topic}, {instead(log, kind)}"


def instead(log: Log, kind: str) -> str:
    """The topics of the log that a kind of sensor could be."""
    types = {topic: series.type for topic, series in log.series.items()} | dict.fromkeys(log.clouds, CLOUDS)
    types |= log.unread
    alike = sorted(topic for topic, type in types.items() if guess_role(topic, type) == kind)
    return f"{kind} topics in the log: {', '.join(alike) or 'none'}"


def readings(kind: str, sensor: Sensor) -> Callable[[Series], Floats] | None:
    """What a sensor measures with, from its series; None for a kind without a model."""
    return VALUES.get(kind, position if isinstance(sensor, PositionSensor) else None)


def position(series: Series) -> Floats:
    """(n, 3) m, of a message with a point or a pose."""
    return series["point" if "point" in series.columns else "position"]


def sigma_of(sensor: Sensor, series: Series, values: Floats) -> Floats | None:
    """Standard deviation per axis of n of positions [m], (n, 3): the fix's own, or the sensor's there."""
    if not isinstance(sensor, PositionSensor):
        return None
    if isinstance(sensor, Gnss):
        return sensor.times * series["sigma"]
    return sensor.times * np.tile(np.reshape(sensor.sigma_at(values), (len(values), -1)), (1, 3))[:, :3]
