"""A rig from what a log shows: topics, message types, magnitudes, rates and /tf_static; every guess is said."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tbmfg.errors import LogError
from tbmfg.fields import Node
from tbmfg.geometry import matrix_from_quat, rpy_from_rotation
from tbmfg.gnss import stated_sigma
from tbmfg.inertial import sanity
from tbmfg.inertial.steps import make_steps
from tbmfg.mcap.info import guess_role, unit_problems
from tbmfg.rig import Mounting, Rig
from tbmfg.timeseries import Floats, Log, Series, Transform, seconds
from tbmfg.yamltext import inline

BASE = "base_link"  # REP-105: the body of the machine; REP-103: forward, left, up
LEAST = 3  # messages that make a sensor
EARTH_FIELD_T = (20e-6, 70e-6)
SIDEWAYS = 0.3  # share of the forward speed that an odometer may show sideways before it is no odometer
CLEAR = 0.3  # correlation of speed and specific force from which the forward axis is told by it
UPRIGHT = np.cos(np.deg2rad(45.0))
ANTENNA_ARM_SD_M, PRISM_ARM_SD_M, DRAWN_SD_M = 1.0, 0.5, 0.02  # unknown on a vehicle; and as a drawing states it
COARSE_M = 0.1  # fixes worse than this wander for minutes, and would be taken for an arm or a clock offset
ARRIVAL_SD_S = 0.1  # two clocks without a common trigger, or a message that took its time
DECLINATION_SD_DEG = 10.0  # on most of the Earth
SCALE_SD = 0.02  # wear, slip, pressure
MOUNTING_SD_DEG = 3.0  # of an IMU that was screwed on without looking twice
OTHER_DEVICES = ("camera", "realsense", "oak", "zed", "lidar", "ouster", "os_imu", "livox", "velodyne", "phone")
ESTIMATES = ("filtered", "fused", "ekf", "ukf", "slam", "lio", "vio", "estimate", "amcl", "icp")
COMMANDS = ("cmd", "command", "setpoint", "desired", "goal", "clicked")


@dataclass(frozen=True, slots=True)
class Assumption:
    """A guess: the ``key`` of the rig that it fills or leaves open, and why."""

    key: str
    reason: str

    def __str__(self) -> str:
        return f"assumed {self.key}: {self.reason}"


@dataclass(slots=True)
class Inferred:
    """A rig, what was assumed for it, and why which topics (topic -> reason) have no place in it."""

    rig: Rig
    assumptions: list[Assumption]
    unused: dict[str, str]

    def lines(self) -> list[str]:
        """All of it as text for the user."""
        return [*map(str, self.assumptions), *(f"not used: {topic}: {reason}" for topic, reason in self.unused.items())]


@dataclass(slots=True)
class _Draft:
    """The rig while it is put together."""

    log: Log
    imu: Series
    R_bi: Floats
    linked: bool
    frames: _Frames
    sensors: dict[str, dict] = field(default_factory=dict)
    said: list[Assumption] = field(default_factory=list)
    unused: dict[str, str] = field(default_factory=dict)

    def say(self, key: str, reason: str) -> None:
        self.said.append(Assumption(key, reason))

    def leave(self, topic: str, reason: str) -> None:
        self.unused[topic] = reason

    def arm(self, frame: str) -> list[float] | None:
        """Origin of ``frame`` in b [m]; None where nothing links it to the IMU."""
        T = self.frames.between(self.imu.frame_id, frame)
        return None if T is None else _rounded(self.R_bi @ T[:3, 3])

    def rpy(self, frame: str) -> list[float] | None:
        """Rotation from the axes of ``frame`` to b [deg]; None where nothing links it to the IMU."""
        T = self.frames.between(self.imu.frame_id, frame)
        return None if T is None else _rpy_deg(self.R_bi @ T[:3, :3])


class _Frames:
    """Static transforms as a graph."""

    def __init__(self, transforms: Iterable[Transform]) -> None:
        self._neighbours: dict[str, dict[str, Floats]] = {}
        for one in transforms:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = matrix_from_quat(np.array(one.quat_xyzw)), one.xyz
            parent, child = _bare(one.parent), _bare(one.child)
            self._neighbours.setdefault(parent, {})[child] = T
            self._neighbours.setdefault(child, {})[parent] = np.linalg.inv(T)

    def between(self, a: str, b: str) -> Floats | None:
        """T_ab, (4, 4): takes coordinates in ``b`` to those in ``a``; None where the two are not linked."""
        a, b = _bare(a), _bare(b)
        found, queue = {a: np.eye(4)}, [a]
        for here in queue:
            for name, T in self._neighbours.get(here, {}).items():
                if name not in found:
                    found[name] = found[here] @ T
                    queue.append(name)
        return found.get(b)

    def linked(self, frame: str) -> list[str]:
        """All frames that are linked to ``frame``, itself among them."""
        return [_bare(frame), *(name for name in self._neighbours if self.between(frame, name) is not None)]


def infer(log: Log) -> Inferred:
    """The rig that the log suggests. Raises LogError where there is no usable IMU."""
    by_role: dict[str, list[Series]] = {}
    for topic in sorted(log.series):
        series = log.series[topic]
        by_role.setdefault(guess_role(topic, series.type), []).append(series)
    imu, others = _choose_imu(log, by_role.pop("imu", []))
    frames = _Frames(log.transforms)
    base = next((name for name in frames.linked(imu.frame_id) if name.rpartition("/")[2] == BASE), None)
    T = None if base is None else frames.between(base, imu.frame_id)
    draft = _Draft(log, imu, np.eye(3) if T is None else T[:3, :3], T is not None, frames)
    _imu(draft, base)
    for series in others:
        draft.leave(series.topic, f"another IMU ({len(series)} messages); {imu.topic} is taken")
    for kind, fill in (("prism", _prism), ("gnss", _gnss), ("odometer", _odometer), ("magnetometer", _magnetometer),
                       ("barometer", _barometer), ("laser", _laser)):  # fmt: skip
        _one_of(draft, kind, by_role.pop(kind, []), fill)
    _lidar(draft)
    rest: dict = {"name": re.sub(r"\W+", "-", Path(log.path).stem).strip("-") or "inferred", "origin": _origin(draft)}
    if truth := _truth(draft, by_role.pop("truth", [])):
        rest["truth"] = {"topic": truth}
    for series in (one for several in by_role.values() for one in several):
        draft.leave(series.topic, f"{_short(series.type)} tells nothing that has a model")
    for topic, type in sorted(log.unknown.items()):
        hint = "; a magnetic field is read as sensor_msgs/MagneticField" if "magn" in topic.lower() else ""
        draft.leave(topic, f"{_short(type)} is not read{hint}")
    _unknowns(draft)
    return Inferred(Rig.model_validate({**rest, "sensors": draft.sensors}), draft.said, draft.unused)


# ---- sensors ----


def _choose_imu(log: Log, candidates: list[Series]) -> tuple[Series, list[Series]]:
    """The IMU of the machine, and the other ones."""
    usable = [s for s in candidates if len(s) >= LEAST]
    if not usable:
        empty = [f"{s.topic} ({_losses(s)})" for s in candidates]
        unread = [f"{topic} ({type})" for topic, type in sorted(log.unknown.items()) if "Imu" in type]
        have = [f"{s.topic} ({_short(s.type)})" for _, s in sorted(log.series.items())]
        have += [f"{topic} ({_short(type) or 'no type'}, not read)" for topic, type in sorted(log.unknown.items())]
        why = f"unusable: {', '.join(empty + unread)}" if empty or unread else f"it has {_listed(have)}"
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


def _losses(series: Series) -> str:
    """How many messages there were, and why so few are left."""
    c = series.counts
    lost = {"hold NaN": c.nonfinite, "bear a wrong stamp": c.misdated, "cannot be decoded": c.undecodable}
    reasons = [f"{count} {what}" for what, count in lost.items() if count]
    return ", ".join([f"{len(series)} usable of {c.received + c.undecodable} messages", *reasons])


def _imu(draft: _Draft, base: str | None) -> None:
    imu = draft.imu
    draft.sensors["imu"] = {
        "topic": imu.topic,
        "T_bi": {"rpy_deg": _rpy_deg(draft.R_bi)},
        "noise_factor": "auto",
    }
    draft.say("sensors.imu.topic", f"{_short(imu.type)}, {_rate(imu)}, frame {imu.frame_id or 'not named'}")
    if (problem := sanity.fault(make_steps(imu, np.eye(3), "end"))) is not None:
        draft.say("sensors.imu", problem)
    up = _up(draft)
    if base is not None:
        draft.say("sensors.imu.T_bi", f"/tf_static: b has the axes of {base}, its origin at {imu.frame_id}")
    else:
        draft.say("sensors.imu.T_bi", f"nothing links {imu.frame_id or 'the IMU'} to {BASE}: b is the IMU's own frame")
    if up[2] < UPRIGHT:
        draft.say("sensors.imu.T_bi", f"b's {_axis(up)} axis points up, not z")
    draft.say("sensors.imu.stamp", "end of the sampling period, as most drivers stamp")
    draft.say("sensors.imu.gyro_density_dps_rthz", "an industrial MEMS unit's; noise_factor auto fits it to the log")


def _one_of(draft: _Draft, kind: str, candidates: list[Series], fill: Callable[[_Draft, Series], str | None]) -> None:
    """Of several topics for a kind the one with most messages that ``fill`` takes; all others are said."""
    for series in sorted(candidates, key=lambda s: -len(s)):
        if kind in draft.sensors:
            taken = draft.sensors[kind]["topic"]
            draft.leave(series.topic, f"{taken} is the {kind}; add this as {kind}-2 if it is another one")
        elif len(series) < LEAST:
            draft.leave(series.topic, _losses(series))
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


def _prism(draft: _Draft, series: Series) -> str | None:
    mounted = next((f for f in draft.frames.linked(draft.imu.frame_id) if "prism" in f.lower()), None)
    arm = draft.arm(mounted) if mounted else None
    draft.sensors["prism"] = {
        "topic": series.topic,
        "arm_m": arm or [0.0, 0.0, 0.0],
        "arm_sd_m": DRAWN_SD_M if arm else PRISM_ARM_SD_M,
        "clock_offset_sd_s": ARRIVAL_SD_S,
    }
    draft.say("sensors.prism.topic", f"{_short(series.type)}, {_rate(series)}, positions of a prism")
    where = f"/tf_static: at {mounted}" if mounted else "not in the log: estimated"
    draft.say("sensors.prism.arm_m", where)
    draft.say("sensors.prism.clock_offset_sd_s", "a total station stamps by its own clock: estimated")
    draft.say("sensors.prism.sigma_mm", "kinematic tracking, 3 mm + 1.5 ppm of the distance from n's origin")
    return None


def _gnss(draft: _Draft, series: Series) -> str | None:
    if "prism" in draft.sensors:
        return "the log does not say how the prism's frame lies on Earth; it gives the latitude"
    if not _with_fix(series).any():
        return f"none of {len(series)} messages holds a fix"
    drawn = _bare(series.frame_id) != _bare(draft.imu.frame_id)  # a combined unit gives its own frame to both
    arm = draft.arm(series.frame_id) if drawn else None
    sigma = float(np.median(stated_sigma(series.select(_with_fix(series)), 0.0)[0]))
    draft.say("sensors.gnss.topic", f"{_short(series.type)}, {_rate(series)}, typically good to {sigma:.2g} m")
    sensor: dict = {"topic": series.topic, "arm_m": arm or [0.0, 0.0, 0.0]}
    if arm:
        draft.say("sensors.gnss.arm_m", f"/tf_static: at {series.frame_id}")
    else:
        draft.say("sensors.gnss.arm_m", "not in the log: " + ("at the IMU" if sigma > COARSE_M else "estimated"))
    if sigma <= COARSE_M:
        sensor |= {"arm_sd_m": DRAWN_SD_M if arm else ANTENNA_ARM_SD_M, "clock_offset_sd_s": ARRIVAL_SD_S}
        draft.say("sensors.gnss.clock_offset_sd_s", "many receivers' fixes are stamped on arrival: estimated")
    draft.sensors["gnss"] = sensor
    return None


def _odometer(draft: _Draft, series: Series) -> str | None:
    if "linear" not in series.columns:
        return "it holds no velocity"
    speed = np.sqrt(np.mean(series["linear"] ** 2, axis=0))
    if max(speed[1:]) > SIDEWAYS * speed[0] and max(speed) > 0:
        return f"velocity forward, left, up is {_numbers(speed)} m/s rms: with as much to the side it is no odometer's"
    told = _forward_axis(draft, series)
    if told is None and not draft.linked and _up(draft)[2] < UPRIGHT:
        return "the IMU is not upright and nothing in the log says which of its axes points forward; set T_bi"
    frame = series.child_frame_id or series.frame_id
    arm = draft.arm(frame)
    sensor: dict = {"topic": series.topic, "arm_m": arm or [0.0, 0.0, 0.0]}
    draft.say("sensors.odometer.topic", f"{_short(series.type)}, {_rate(series)}, its forward speed")
    where = f"/tf_static: contact at the origin of {frame}" if arm else "not in the log: contact below the IMU"
    draft.say("sensors.odometer.arm_m", where)
    if told is not None and not draft.linked:
        sensor["yaw_deg"], sensor["pitch_deg"] = told.mounting
        draft.say("sensors.odometer.yaw_deg", f"forward is b's {told.axis} axis, where its acceleration is felt")
    else:
        whose = BASE if draft.linked else "the IMU, for want of anything better"
        draft.say("sensors.odometer.yaw_deg", f"forward is the x axis of {whose}")
    if told is not None and draft.linked and told.axis != "x":
        draft.say("sensors.odometer.yaw_deg", f"but its acceleration is felt along b's {told.axis}: check /tf_static")
    if (sigma := _stated_speed_sd(series)) is not None:
        sensor["sigma_mps"] = sigma
        draft.say("sensors.odometer.sigma_mps", "median of the messages' covariance")
    if {"prism", "gnss"} & set(draft.sensors):
        sensor["scale_sd"] = SCALE_SD
        draft.say("sensors.odometer.scale_sd", "not in the log: estimated against the positions")
        if not draft.linked and not sensor.get("pitch_deg"):
            sensor["mounting_sd_deg"] = MOUNTING_SD_DEG
            draft.say("sensors.odometer.mounting_sd_deg", "not in the log: estimated against the positions")
    draft.sensors["odometer"] = sensor
    return None


@dataclass(frozen=True, slots=True)
class _Forward:
    """An axis of b, and the yaw and pitch [deg] of an odometer whose forward axis it is."""

    axis: str
    mounting: tuple[float, float]


_FORWARD = {
    (0, 1): _Forward("x", (0.0, 0.0)),
    (0, -1): _Forward("-x", (180.0, 0.0)),
    (1, 1): _Forward("y", (90.0, 0.0)),
    (1, -1): _Forward("-y", (-90.0, 0.0)),
    (2, 1): _Forward("z", (0.0, -90.0)),
    (2, -1): _Forward("-z", (0.0, 90.0)),
}


def _forward_axis(draft: _Draft, series: Series) -> _Forward | None:
    """The axis of b along which the odometer's acceleration is felt; None where that is not clear."""
    imu = draft.imu
    t0_ns = max(imu.t_ns[0], series.t_ns[0])
    t_imu, t = seconds(imu.t_ns, t0_ns), seconds(series.t_ns, t0_ns)
    edges = np.arange(0.0, min(t_imu[-1], t[-1]), 1.0)
    rows = np.searchsorted(t_imu, edges)
    full = np.diff(rows) > 0
    if full.sum() < 10:
        return None
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu["acc"] @ draft.R_bi.T, axis=0)])
    force = np.diff(total[rows], axis=0)[full] / np.diff(rows)[full, None]
    gain = np.diff(np.interp(edges, t, series["linear"][:, 0]))[full]
    horizontal = np.abs(_up(draft)) < UPRIGHT
    moved = np.ptp(gain) > 0
    felt = np.array([np.corrcoef(gain, f)[0, 1] if moved and np.ptp(f) else 0.0 for f in force.T]) * horizontal
    best = int(np.argmax(np.abs(felt)))
    if abs(felt[best]) < max(CLEAR, 2.0 * np.sort(np.abs(felt))[-2]):
        return None
    return _FORWARD[best, int(np.sign(felt[best]))]


def _stated_speed_sd(series: Series) -> float | None:
    """Standard deviation of the forward speed as the messages state it, where that can be true."""
    cov = series.columns.get("twist_cov", series.columns.get("cov"))
    if cov is None:
        return None
    sigma = float(np.sqrt(max(np.median(cov[:, 0]), 0.0)))
    return float(f"{sigma:.3g}") if 1e-4 < sigma < 1.0 else None


def _magnetometer(draft: _Draft, series: Series) -> str | None:
    typical = float(np.median(np.linalg.norm(series["field"], axis=1)))
    low, high = EARTH_FIELD_T
    if not low < typical < high:
        return f"its field is typically {typical * 1e6:.3g} uT, the Earth's is {low * 1e6:.0f} to {high * 1e6:.0f} uT"
    rpy = draft.rpy(series.frame_id)
    draft.sensors["magnetometer"] = {
        "topic": series.topic,
        "rpy_deg": rpy or _rpy_deg(draft.R_bi),
        "declination_sd_deg": DECLINATION_SD_DEG,
    }
    draft.say("sensors.magnetometer.topic", f"{_short(series.type)}, {_rate(series)}, {typical * 1e6:.0f} uT")
    axes = f"/tf_static: axes of {series.frame_id}" if rpy else "nothing links its frame to the IMU: axes of the IMU"
    draft.say("sensors.magnetometer.rpy_deg", "the IMU's own frame" if series.frame_id == draft.imu.frame_id else axes)
    draft.say("sensors.magnetometer.declination_deg", "not in the log: magnetic north is taken for north, estimated")
    draft.say("sensors.magnetometer.hard_iron_ut", "taken as calibrated: the machine has no field of its own")
    return None


def _barometer(draft: _Draft, series: Series) -> str | None:
    draft.sensors["barometer"] = {"topic": series.topic}
    hpa = float(np.median(series["pressure"])) / 100
    draft.say("sensors.barometer.topic", f"{_short(series.type)}, {_rate(series)}, {hpa:.0f} hPa")
    return None


def _laser(draft: _Draft, series: Series) -> str | None:
    draft.sensors["laser"] = {"topic": series.topic, "T_bd": _mounting(draft, "laser.T_bd", series.frame_id)}
    draft.say("sensors.laser.topic", f"{_short(series.type)}, {_rate(series)}, spot on a detector")
    return None


def _lidar(draft: _Draft) -> None:
    """The cloud topic with the most scans."""
    for topic, clouds in sorted(draft.log.clouds.items(), key=lambda item: -len(item[1])):
        if "lidar" in draft.sensors:
            taken = draft.sensors["lidar"]["topic"]
            draft.leave(topic, f"{taken} is the lidar; add this as lidar-2 if it is another one")
        elif len(clouds) < LEAST:
            draft.leave(topic, f"{len(clouds)} usable scans")
        else:
            draft.sensors["lidar"] = {"topic": topic, "T_bl": _mounting(draft, "lidar.T_bl", clouds.frame_id)}
            draft.say("sensors.lidar.topic", f"{len(clouds)} scans")


def _mounting(draft: _Draft, key: str, frame: str) -> dict:
    """Pose of a sensor in b, from /tf_static; else at the IMU with its axes."""
    arm, rpy = draft.arm(frame), draft.rpy(frame)
    if arm is None:
        draft.say(
            f"sensors.{key}", f"nothing links {frame or 'its frame'} to the IMU: taken to have its place and axes"
        )
        return {}
    draft.say(f"sensors.{key}", f"/tf_static: at {frame}")
    return {"xyz_m": arm, "rpy_deg": rpy}


# ---- what is not a sensor ----


def _origin(draft: _Draft) -> dict:
    """Latitude by satellite; how n lies."""
    origin = {}
    for topic, series in sorted(draft.log.series.items()):
        if "llh" in series.columns and _with_fix(series).any():
            origin["latitude_deg"] = round(float(np.median(series["llh"][_with_fix(series), 0])), 4)
            draft.say("origin.latitude_deg", f"of {topic}")
            break
    else:
        draft.say("origin.latitude_deg", "not in the log: no Earth rate, standard gravity")
    if "gnss" not in draft.sensors and {"prism", "magnetometer"} & set(draft.sensors):
        draft.say("origin.x_axis_azimuth_deg", "n's x axis points east (REP-103); the log does not say")
    return origin


def _with_fix(series: Series) -> np.ndarray:
    """Rows of a NavSatFix series with a fix on Earth."""
    latitude, longitude, _ = series["llh"].T
    return (series["status"] >= 0) & (np.abs(latitude) <= 90) & (latitude**2 + longitude**2 > 0)


def _truth(draft: _Draft, candidates: list[Series]) -> str | None:
    """Topic to compare with: of several the one with the most columns."""
    usable = sorted((s for s in candidates if len(s)), key=lambda s: (-len(s.columns), s.topic))
    for series in usable[1:]:
        draft.leave(series.topic, f"{usable[0].topic} is the truth")
    if not usable:
        return None
    draft.say("truth.topic", f"{usable[0].topic}: by its name a reference; compared with, never used")
    return usable[0].topic


def _unknowns(draft: _Draft) -> None:
    """What this log cannot tell, by the sensors that it lacks."""
    have = set(draft.sensors)
    fixed = {"prism", "gnss"} & have
    if not fixed:
        bound = "the distance travelled is the odometer's" if "odometer" in have else "nothing bounds its growing error"
        draft.say("initial.position_m", f"no prism and no gnss: position counts from the start, and {bound}")
    if not fixed and "magnetometer" not in have:
        draft.say("initial.yaw_deg", "no prism, gnss or magnetometer: heading counts from the start, where it is 0")


# ---- a starter file ----


def starter(inferred: Inferred, log_path: str) -> str:
    """The rig as a file to edit: every key with its meaning, and beside it why it was guessed."""
    reasons: dict[str, list[str]] = {}
    for one in inferred.assumptions:
        reasons.setdefault(one.key, []).append(one.reason)
    lines = [
        f"# Written by `tbmfg init` from {_comment(Path(log_path).name)}.",
        "# GUESSED: from what the log shows, or in place of what it does not say: check it. The rest are defaults.",
    ]
    lines += _lines(inferred.rig.model_dump(mode="json"), inferred.rig, (), reasons)
    if inferred.unused:
        lines += ["", "# Topics that are not used:"]
        lines += [f"#   {_comment(topic)}: {_comment(reason)}" for topic, reason in inferred.unused.items()]
    return "\n".join(lines) + "\n"


def _lines(data: dict, model: Any, path: tuple[str, ...], reasons: dict[str, list[str]]) -> Iterator[str]:
    """YAML of ``data`` key by key, beside each its ``reasons``, or what it means."""
    indent = "  " * len(path)
    for key, value in data.items():
        here = (*path, key)
        below = model[key] if isinstance(model, dict) else getattr(model, key)
        guessed = "; ".join(map(_comment, reasons.get(".".join(here), [])))
        meaning = type(model).model_fields[key].description if isinstance(model, Node) else ""
        comment = f"  # GUESSED: {guessed}" if guessed else f"  # {meaning}" if meaning else ""
        if key == "sensors" or (isinstance(below, Node) and not isinstance(below, Mounting)):
            yield f"{indent}{key}:{comment}"
            yield from _lines(value, below, here, reasons)
        else:
            yield f"{indent}{inline({key: value})}{comment}"


# ---- words and numbers ----


def _up(draft: _Draft) -> Floats:
    """Direction of the typical specific force in b: up, (3,)."""
    force = draft.R_bi @ np.median(draft.imu["acc"], axis=0)
    return force / max(float(np.linalg.norm(force)), 1e-9)


def _axis(direction: Floats) -> str:
    best = int(np.argmax(np.abs(direction)))
    return ("-" if direction[best] < 0 else "") + "xyz"[best]


def _bare(frame: str) -> str:
    return frame.lstrip("/")


def _short(type: str) -> str:
    return type.replace("/msg/", "/")


def _rate(series: Series) -> str:
    span = (series.t_ns[-1] - series.t_ns[0]) * 1e-9
    return f"{len(series)} messages" + (f", {(len(series) - 1) / span:.3g} Hz" if span > 0 else "")


def _rpy_deg(R: Floats) -> list[float]:
    return _rounded(np.rad2deg(rpy_from_rotation(R)))


def _rounded(values: Floats) -> list[float]:
    return [round(float(x), 6) + 0.0 for x in values]


def _numbers(values: Floats) -> str:
    return ", ".join(f"{x:.2g}" for x in values)


def _listed(words: list[str], most: int = 6) -> str:
    return ", ".join(words[:most]) + (f" and {len(words) - most} more topics" if len(words) > most else "") or "nothing"


def _comment(text: str) -> str:
    """Text that stays on one line."""
    return " ".join(text.split())
