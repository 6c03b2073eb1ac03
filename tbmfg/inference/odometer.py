"""An odometer from its speeds: whether it is one, and which axis of b is its forward one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tbmfg.inference.draft import BASE, UPRIGHT, Draft, numbers, rate, short
from tbmfg.timeseries import Series, seconds

SIDEWAYS = 0.3  # share of the forward speed that an odometer may show sideways before it is no odometer
CLEAR = 0.3  # correlation of speed and specific force from which the forward axis is told by it
SCALE_SD = 0.02  # wear, slip, pressure
MOUNTING_SD_DEG = 3.0  # of an IMU that was screwed on without looking twice


def odometer(draft: Draft, series: Series) -> str | None:
    if "linear" not in series.columns:
        return "it holds no velocity"
    speed = np.sqrt(np.mean(series["linear"] ** 2, axis=0))
    if max(speed[1:]) > SIDEWAYS * speed[0] and max(speed) > 0:
        return f"velocity forward, left, up is {numbers(speed)} m/s rms: with as much to the side it is no odometer's"
    told = _forward_axis(draft, series)
    if told is None and not draft.linked and draft.up[2] < UPRIGHT:
        return "the IMU is not upright and nothing in the log says which of its axes points forward; set T_bi"
    frame = series.child_frame_id or series.frame_id
    arm = draft.arm(frame)
    sensor: dict = {"topic": series.topic, "arm_m": arm or [0.0, 0.0, 0.0]}
    draft.say("sensors.odometer.topic", f"{short(series.type)}, {rate(series)}, its forward speed")
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


def _forward_axis(draft: Draft, series: Series) -> _Forward | None:
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
    horizontal = np.abs(draft.up) < UPRIGHT
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
