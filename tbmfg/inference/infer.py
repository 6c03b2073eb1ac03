"""A rig from what a log shows: topics, message types, magnitudes, rates and /tf_static; every guess is said."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tbmfg.errors import LogError
from tbmfg.inertial import sanity
from tbmfg.inertial.steps import make_steps
from tbmfg.inference.draft import BASE, UPRIGHT, Draft, Frames, Inferred, axis_of, listed, losses, rate, rpy_deg, short
from tbmfg.inference.odometer import odometer
from tbmfg.inference.sensors import LEAST, barometer, gnss, laser, lidar, magnetometer, prism, with_fix
from tbmfg.mcap.info import guess_role, unit_problems
from tbmfg.rig import Rig
from tbmfg.timeseries import Log, Series

OTHER_DEVICES = ("camera", "realsense", "oak", "zed", "lidar", "ouster", "os_imu", "livox", "velodyne", "phone")
ESTIMATES = ("filtered", "fused", "ekf", "ukf", "slam", "lio", "vio", "estimate", "amcl", "icp")
COMMANDS = ("cmd", "command", "setpoint", "desired", "goal", "clicked")


def infer(log: Log) -> Inferred:
    """The rig that the log suggests. Raises LogError where there is no usable IMU."""
    by_role: dict[str, list[Series]] = {}
    for topic in sorted(log.series):
        series = log.series[topic]
        by_role.setdefault(guess_role(topic, series.type), []).append(series)
    imu, others = _choose_imu(log, by_role.pop("imu", []))
    frames = Frames(log.transforms)
    base = next((name for name in frames.linked(imu.frame_id) if name.rpartition("/")[2] == BASE), None)
    T = None if base is None else frames.between(base, imu.frame_id)
    draft = Draft(log, imu, np.eye(3) if T is None else T[:3, :3], T is not None, frames)
    _imu(draft, base)
    for series in others:
        draft.leave(series.topic, f"another IMU ({len(series)} messages); {imu.topic} is taken")
    for kind, fill in (("prism", prism), ("gnss", gnss), ("odometer", odometer), ("magnetometer", magnetometer),
                       ("barometer", barometer), ("laser", laser)):  # fmt: skip
        _one_of(draft, kind, by_role.pop(kind, []), fill)
    lidar(draft)
    rest: dict = {"name": re.sub(r"\W+", "-", Path(log.path).stem).strip("-") or "inferred", "origin": _origin(draft)}
    if truth := _truth(draft, by_role.pop("truth", [])):
        rest["truth"] = {"topic": truth}
    for series in (one for several in by_role.values() for one in several):
        draft.leave(series.topic, f"{short(series.type)} tells nothing that has a model")
    for topic, type in sorted(log.unknown.items()):
        hint = "; a magnetic field is read as sensor_msgs/MagneticField" if "magn" in topic.lower() else ""
        draft.leave(topic, f"{short(type)} is not read{hint}")
    _unknowns(draft)
    return Inferred(Rig.model_validate({**rest, "sensors": draft.sensors}), draft.said, draft.unused)


def _choose_imu(log: Log, candidates: list[Series]) -> tuple[Series, list[Series]]:
    """The IMU of the machine, and the other ones."""
    usable = [s for s in candidates if len(s) >= LEAST]
    if not usable:
        empty = [f"{s.topic} ({losses(s)})" for s in candidates]
        unread = [f"{topic} ({type})" for topic, type in sorted(log.unknown.items()) if "Imu" in type]
        have = [f"{s.topic} ({short(s.type)})" for _, s in sorted(log.series.items())]
        have += [f"{topic} ({short(type) or 'no type'}, not read)" for topic, type in sorted(log.unknown.items())]
        why = f"unusable: {', '.join(empty + unread)}" if empty or unread else f"it has {listed(have)}"
        raise LogError(f"{log.path}: no sensor_msgs/Imu to estimate from, {why}; every estimator needs an IMU")

    def rank(series: Series) -> tuple[bool, bool, int]:
        name = (series.topic + series.frame_id).lower()
        return (
            sanity.fault(make_steps(series, np.eye(3), "end")) is None,
            not any(word in name for word in OTHER_DEVICES),
            len(series),
        )

    best = usable[0] if len(usable) == 1 else max(usable, key=rank)
    return best, [s for s in candidates if s is not best]


def _imu(draft: Draft, base: str | None) -> None:
    imu = draft.imu
    draft.sensors["imu"] = {
        "topic": imu.topic,
        "T_bi": {"rpy_deg": rpy_deg(draft.R_bi)},
        "noise_factor": "auto",
    }
    draft.say("sensors.imu.topic", f"{short(imu.type)}, {rate(imu)}, frame {imu.frame_id or 'not named'}")
    if (problem := sanity.fault(make_steps(imu, np.eye(3), "end"))) is not None:
        draft.say("sensors.imu", problem)
    if base is not None:
        draft.say("sensors.imu.T_bi", f"/tf_static: b has the axes of {base}, its origin at {imu.frame_id}")
    else:
        draft.say("sensors.imu.T_bi", f"nothing links {imu.frame_id or 'the IMU'} to {BASE}: b is the IMU's own frame")
    if draft.up[2] < UPRIGHT:
        draft.say("sensors.imu.T_bi", f"b's {axis_of(draft.up)} axis points up, not z")
    draft.say("sensors.imu.stamp", "end of the sampling period, as most drivers stamp")
    draft.say("sensors.imu.gyro_density_dps_rthz", "an industrial MEMS unit's; noise_factor auto fits it to the log")


def _one_of(draft: Draft, kind: str, candidates: list[Series], fill: Callable[[Draft, Series], str | None]) -> None:
    """Of several topics for a kind the one with most messages that ``fill`` takes; all others are said."""
    for series in sorted(candidates, key=lambda s: -len(s)):
        if kind in draft.sensors:
            taken = draft.sensors[kind]["topic"]
            draft.leave(series.topic, f"{taken} is the {kind}; add this as {kind}-2 if it is another one")
        elif len(series) < LEAST:
            draft.leave(series.topic, losses(series))
        elif (reason := _no_measurement(series) or fill(draft, series)) is not None:
            draft.leave(series.topic, reason)


def _no_measurement(series: Series) -> str | None:
    """Why a topic holds something else than what a sensor measured, by its name."""
    name = series.topic.lower()
    if any(word in name for word in COMMANDS):
        return "by its name a command"
    words = re.split(r"[/_\-.]", name)
    if any(word in words for word in ESTIMATES):
        return "by its name another estimator's result"
    problems = unit_problems(series)
    return problems[0] if problems else None


def _origin(draft: Draft) -> dict:
    """Latitude by satellite; how n lies."""
    origin = {}
    for topic, series in sorted(draft.log.series.items()):
        if "llh" in series.columns and with_fix(series).any():
            origin["latitude_deg"] = round(float(np.median(series["llh"][with_fix(series), 0])), 4)
            draft.say("origin.latitude_deg", f"of {topic}")
            break
    else:
        draft.say("origin.latitude_deg", "not in the log: no Earth rate, standard gravity")
    if "gnss" not in draft.sensors and {"prism", "magnetometer"} & set(draft.sensors):
        draft.say("origin.x_axis_azimuth_deg", "n's x axis points east (REP-103); the log does not say")
    return origin


def _truth(draft: Draft, candidates: list[Series]) -> str | None:
    """Topic to compare with: of several the one with the most columns."""
    usable = sorted((s for s in candidates if len(s)), key=lambda s: (-len(s.columns), s.topic))
    for series in usable[1:]:
        draft.leave(series.topic, f"{usable[0].topic} is the truth")
    if not usable:
        return None
    draft.say("truth.topic", f"{usable[0].topic}: by its name a reference; compared with, never used")
    return usable[0].topic


def _unknowns(draft: Draft) -> None:
    """What this log cannot tell, by the sensors that it lacks."""
    have = set(draft.sensors)
    fixed = {"prism", "gnss"} & have
    if not fixed:
        bound = "the distance travelled is the odometer's" if "odometer" in have else "nothing bounds its growing error"
        draft.say("initial.position_m", f"no prism and no gnss: position counts from the start, and {bound}")
    if not fixed and "magnetometer" not in have:
        draft.say("initial.yaw_deg", "no prism, gnss or magnetometer: heading counts from the start, where it is 0")
