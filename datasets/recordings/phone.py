"""Phone with barometer, magnetometer and satellite fixes: carried about at 50 Hz, or in a car at 1 Hz.

Which of the two packaged recordings it is, its arrays tell. There is no truth. The one at 1 Hz is for barometric height
and for reading: nothing can be integrated at that rate.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datasets.recordings import Arrays, Recording, fixes, imu, magnetic, pressure, read_npz, rig_of, stamps
from tbmfg.timeseries import Floats, Series, Times

VERTICAL = 2.0  # standard deviation of a fix's height over its horizontal one, where the phone does not say


def load(source: str | Path) -> Recording:
    """One recording; axes are the phone's (right, up along the screen, out of it)."""
    arrays = read_npz(source)
    rig = rig_of("phone")
    t0_ns = int(stamps(np.asarray(arrays["t0_unix"])))
    topics = {name: sensor.topic for name, sensor in rig.sensors.items()}
    return Recording(_table(arrays, topics, t0_ns) if "data" in arrays else _streams(arrays, topics, t0_ns), rig)


def _streams(arrays: Arrays, topics: dict[str, str], t0_ns: int) -> tuple[Series, ...]:
    """Each sensor with its own stamps; accelerations are interpolated to those of the gyro."""
    gyro_s, acc_s, acc = arrays["gyr_t"], arrays["acc_t"], arrays["acc"]
    inside = (gyro_s >= acc_s[0]) & (gyro_s <= acc_s[-1])
    acc = np.column_stack([np.interp(gyro_s[inside], acc_s, acc[:, axis]) for axis in range(3)])
    baro, gps = (dict(zip(arrays[f"{name}_cols"], arrays[name].T, strict=True)) for name in ("baro", "gps"))
    return (
        imu(topics["imu"], stamps(gyro_s[inside], t0_ns), arrays["gyr"][inside], acc),
        magnetic(topics["magnetometer"], stamps(arrays["mag_t"], t0_ns), arrays["mag"]),
        pressure(topics["barometer"], stamps(arrays["baro_t"], t0_ns), baro["pressure"]),
        _fixes(topics["gnss"], stamps(arrays["gps_t"], t0_ns), gps),
    )


def _table(arrays: Arrays, topics: dict[str, str], t0_ns: int) -> tuple[Series, ...]:
    """Everything in one table with common stamps."""
    t_ns, table = stamps(arrays["t"], t0_ns), dict(zip(arrays["cols"], arrays["data"].T, strict=True))
    gyro, acc, field = (np.column_stack([table[f"{name}_{axis}"] for axis in "xyz"]) for name in ("gyro", "acc", "mag"))
    return (
        imu(topics["imu"], t_ns, gyro, acc),
        magnetic(topics["magnetometer"], t_ns, field),
        pressure(topics["barometer"], t_ns, table["pressure"]),
        _fixes(topics["gnss"], t_ns, table),
    )


def _fixes(topic: str, t_ns: Times, gps: dict[str, Floats]) -> Series:
    """Fixes that say how accurate they are; -1 and NaN mean that they do not."""
    horizontal = gps["horizontalAccuracy"]
    vertical = gps.get("verticalAccuracy", np.full_like(horizontal, -1.0))
    vertical = np.where(vertical > 0, vertical, VERTICAL * horizontal)
    llh = np.column_stack([gps["latitude"], gps["longitude"], gps["altitude"]])
    good = np.isfinite(llh).all(axis=1) & (horizontal > 0)
    return fixes(topic, t_ns[good], llh[good], np.column_stack([horizontal, horizontal, vertical])[good])
