"""The sensor that a topic makes, or why it makes none."""

from __future__ import annotations

import numpy as np

from tbmfg.gnss import stated_sigma
from tbmfg.inference.draft import Draft, bare, rate, rpy_deg, short
from tbmfg.timeseries import Series

LEAST = 3  # messages that make a sensor
EARTH_FIELD_T = (20e-6, 70e-6)
ANTENNA_ARM_SD_M, PRISM_ARM_SD_M, DRAWN_SD_M = 1.0, 0.5, 0.02  # unknown on a vehicle; and as a drawing states it
COARSE_M = 0.1  # fixes worse than this wander for minutes, and would be taken for an arm or a clock offset
ARRIVAL_SD_S = 0.1  # two clocks without a common trigger, or a message that took its time
DECLINATION_SD_DEG = 10.0  # on most of the Earth


def prism(draft: Draft, series: Series) -> str | None:
    mounted = next((f for f in draft.frames.linked(draft.imu.frame_id) if "prism" in f.lower()), None)
    arm = draft.arm(mounted) if mounted else None
    draft.sensors["prism"] = {
        "topic": series.topic,
        "arm_m": arm or [0.0, 0.0, 0.0],
        "arm_sd_m": DRAWN_SD_M if arm else PRISM_ARM_SD_M,
        "clock_offset_sd_s": ARRIVAL_SD_S,
    }
    draft.say("sensors.prism.topic", f"{short(series.type)}, {rate(series)}, positions of a prism")
    where = f"/tf_static: at {mounted}" if mounted else "not in the log: estimated"
    draft.say("sensors.prism.arm_m", where)
    draft.say("sensors.prism.clock_offset_sd_s", "a total station stamps by its own clock: estimated")
    draft.say("sensors.prism.sigma_mm", "kinematic tracking, 3 mm + 1.5 ppm of the distance from n's origin")
    return None


def gnss(draft: Draft, series: Series) -> str | None:
    if "prism" in draft.sensors:
        return "the log does not say how the prism's frame lies on Earth; it gives the latitude"
    if not with_fix(series).any():
        return f"none of {len(series)} messages holds a fix"
    drawn = bare(series.frame_id) != bare(draft.imu.frame_id)  # a combined unit gives its own frame to both
    arm = draft.arm(series.frame_id) if drawn else None
    sigma = float(np.median(stated_sigma(series.select(with_fix(series)), 0.0)[0]))
    draft.say("sensors.gnss.topic", f"{short(series.type)}, {rate(series)}, typically good to {sigma:.2g} m")
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


def magnetometer(draft: Draft, series: Series) -> str | None:
    typical = float(np.median(np.linalg.norm(series["field"], axis=1)))
    low, high = EARTH_FIELD_T
    if not low < typical < high:
        return f"its field is typically {typical * 1e6:.3g} uT, the Earth's is {low * 1e6:.0f} to {high * 1e6:.0f} uT"
    rpy = draft.rpy(series.frame_id)
    draft.sensors["magnetometer"] = {
        "topic": series.topic,
        "rpy_deg": rpy or rpy_deg(draft.R_bi),
        "declination_sd_deg": DECLINATION_SD_DEG,
    }
    draft.say("sensors.magnetometer.topic", f"{short(series.type)}, {rate(series)}, {typical * 1e6:.0f} uT")
    axes = f"/tf_static: axes of {series.frame_id}" if rpy else "nothing links its frame to the IMU: axes of the IMU"
    draft.say("sensors.magnetometer.rpy_deg", "the IMU's own frame" if series.frame_id == draft.imu.frame_id else axes)
    draft.say("sensors.magnetometer.declination_deg", "not in the log: magnetic north is taken for north, estimated")
    draft.say("sensors.magnetometer.hard_iron_ut", "taken as calibrated: the machine has no field of its own")
    return None


def barometer(draft: Draft, series: Series) -> str | None:
    draft.sensors["barometer"] = {"topic": series.topic}
    hpa = float(np.median(series["pressure"])) / 100
    draft.say("sensors.barometer.topic", f"{short(series.type)}, {rate(series)}, {hpa:.0f} hPa")
    return None


def laser(draft: Draft, series: Series) -> str | None:
    draft.sensors["laser"] = {"topic": series.topic, "T_bd": _mounting(draft, "laser.T_bd", series.frame_id)}
    draft.say("sensors.laser.topic", f"{short(series.type)}, {rate(series)}, spot on a detector")
    return None


def lidar(draft: Draft) -> None:
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


def _mounting(draft: Draft, key: str, frame: str) -> dict:
    """Pose of a sensor in b, from /tf_static; else at the IMU with its axes."""
    arm, rpy = draft.arm(frame), draft.rpy(frame)
    if arm is None:
        draft.say(
            f"sensors.{key}", f"nothing links {frame or 'its frame'} to the IMU: taken to have its place and axes"
        )
        return {}
    draft.say(f"sensors.{key}", f"/tf_static: at {frame}")
    return {"xyz_m": arm, "rpy_deg": rpy}


def with_fix(series: Series) -> np.ndarray:
    """Rows of a NavSatFix series with a fix on Earth."""
    latitude, longitude, _ = series["llh"].T
    return (series["status"] >= 0) & (np.abs(latitude) <= 90) & (latitude**2 + longitude**2 > 0)
