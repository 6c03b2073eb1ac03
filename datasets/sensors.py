"""Ideal sensors on a motion, and their noise.

Every noise has exactly the density in the rig, and everything hidden (bias, arm, offset, scale) is a draw from
the rig's prior. A sensor is a function of the scene, its part of the rig and its own random stream.
"""

from __future__ import annotations

import numpy as np

from datasets.motion import rotate_back
from datasets.simulate import START_NS, Scene, Sensed, period_means, ticks
from tbmfg.rig import Imu, Magnetometer, Odometer, Prism
from tbmfg.timeseries import NS, Floats, Series


def imu(scene: Scene, sensor: Imu, rng: np.random.Generator, *, rate_hz: float) -> Sensed:
    """Means over each period of the angular rate and the specific force in the turning body axes.

    A unit that integrates its body-axis rates does the same: coning and sculling are left to the reader of the
    log. ``bias_gyro`` and ``bias_acc`` of ``drawn`` are (n, 3), in b, per sample.
    """
    edges_ns = ticks(scene.duration_s, rate_hz)
    ideal = period_means(scene.inertial, edges_ns)
    dt = 1 / rate_hz
    factor = 1.0 if sensor.noise_factor == "auto" else sensor.noise_factor
    density, walk, bias_sd = (
        np.repeat(pair, 3)
        for pair in (
            (factor * sensor.gyro_density, factor * sensor.acc_density),
            (sensor.gyro_walk, sensor.acc_walk),
            (sensor.gyro_bias_sd, sensor.acc_bias_sd),
        )
    )
    start = bias_sd * rng.standard_normal(6)
    # one array row by row, so that a longer log begins with the shorter one
    white, steps = np.split(rng.standard_normal((len(ideal), 12)), 2, axis=1)
    bias = start + np.cumsum(walk * np.sqrt(dt) * steps, axis=0)
    measured = ideal + bias + density / np.sqrt(dt) * white

    first, last = edges_ns[:-1], edges_ns[1:]
    stamps = START_NS + {"start": first, "centre": (first + last) // 2, "end": last}[sensor.stamp]

    def series(values_b: Floats) -> Series:
        gyro, acc = (part @ sensor.T_bi.R for part in np.split(values_b, 2, axis=1))
        return Series(sensor.topic, "sensor_msgs/msg/Imu", stamps, {"gyro": gyro, "acc": acc}, "imu")

    return Sensed(series(measured), series(ideal), {"bias_gyro": bias[:, :3], "bias_acc": bias[:, 3:]})


def prism(
    scene: Scene, sensor: Prism, rng: np.random.Generator, *, rate_hz: float, jitter_s: float = 0.005, gaps: int = 0
) -> Sensed:
    """Positions of the prism at instants that jitter about the nominal ones; the stamps know the jitter.

    ``gaps`` interruptions of 2 to 6 s lie anywhere in the log.
    """
    arm = sensor.arm + sensor.arm_sd * rng.standard_normal(3)
    offset = sensor.clock_offset + sensor.clock_offset_sd * rng.standard_normal()
    gap_start, gap_length = rng.random((gaps, 2)).T * [[scene.duration_s], [4.0]] + [[0.0], [2.0]]
    jitter, *noise = rng.standard_normal((int(scene.duration_s * rate_hz), 4)).T
    t_s = (np.arange(len(jitter)) + 0.5) / rate_hz + jitter_s * jitter
    hidden = ((t_s[:, None] > gap_start) & (t_s[:, None] < gap_start + gap_length)).any(axis=1)
    seen = ~hidden & (t_s > 0) & (t_s < scene.duration_s)
    t_ns = np.round(t_s[seen] * NS).astype(np.int64)

    position, _ = scene.motion(t_ns * 1e-9).at_point(arm)
    distance = np.linalg.norm(position - np.array(sensor.station_m), axis=1, keepdims=True)
    sigma = 1e-3 * sensor.sigma_mm + 1e-6 * sensor.sigma_ppm * distance

    def series(offset_s: float, point: Floats) -> Series:
        stamps = START_NS + t_ns + round(offset_s * NS)
        return Series(sensor.topic, "geometry_msgs/msg/PointStamped", stamps, {"point": point}, "n")

    measured = position + sigma * np.column_stack(noise)[seen]
    return Sensed(series(offset, measured), series(0.0, position), {"arm_m": arm, "clock_offset_s": offset})


def odometer(scene: Scene, sensor: Odometer, rng: np.random.Generator, *, rate_hz: float) -> Sensed:
    """Mean forward speed of the contact point over each period, stamped at its end.

    The tracks roll with the undisturbed machine: an odometer does not feel the body's vibration. The forward axis
    is b's x axis; its other components are not measured and given as zero.
    """
    edges_ns = ticks(scene.duration_s, rate_hz)

    def speed(t_s: Floats) -> Floats:
        travel = scene.motion.undisturbed(t_s)
        _, velocity_n = travel.at_point(sensor.arm)
        return rotate_back(travel.R, velocity_n)[:, :1]

    true = period_means(speed, edges_ns, panel_s=1 / rate_hz)[:, 0]
    scale = sensor.scale + sensor.scale_sd * rng.standard_normal()
    measured = (1 + scale) * true + sensor.sigma_mps * rng.standard_normal(len(true))

    def series(offset_s: float, forward: Floats) -> Series:
        stamps = START_NS + edges_ns[1:] + round(offset_s * NS)
        columns = {"linear": np.pad(forward[:, None], ((0, 0), (0, 2))), "angular": np.zeros((len(forward), 3))}
        return Series(sensor.topic, "geometry_msgs/msg/TwistStamped", stamps, columns, "odometer")

    return Sensed(series(sensor.clock_offset_s, measured), series(0.0, true), {"scale": scale})


def magnetometer(
    scene: Scene,
    sensor: Magnetometer,
    rng: np.random.Generator,
    *,
    rate_hz: float,
    field_t: float = 50e-6,
    dip_deg: float = 65.0,
) -> Sensed:
    """The Earth's field, T, with white noise on every axis that gives the horizontal direction the rig's sigma."""
    t_ns = ticks(scene.duration_s, rate_hz)
    declination_deg = sensor.declination_deg + sensor.declination_sd_deg * rng.standard_normal()
    north, up = scene.north_up_n
    declination, dip = np.radians(declination_deg), np.radians(dip_deg)
    magnetic_north = np.cos(declination) * north + np.sin(declination) * np.cross(north, up)  # north x up is east
    field_n = field_t * (np.cos(dip) * magnetic_north - np.sin(dip) * up)
    # in b first, then in the sensor's axes; the machine's own field is fixed in the latter
    clean = field_n @ scene.motion(t_ns * 1e-9).R @ sensor.R_bm + 1e-6 * np.array(sensor.hard_iron_ut)
    sigma = np.radians(sensor.sigma_deg) * field_t * np.cos(dip)

    def series(offset_s: float, values: Floats) -> Series:
        stamps = START_NS + t_ns + round(offset_s * NS)
        return Series(sensor.topic, "sensor_msgs/msg/MagneticField", stamps, {"field": values}, "imu")

    measured = clean + sigma * rng.standard_normal(clean.shape)
    return Sensed(series(sensor.clock_offset_s, measured), series(0.0, clean), {"declination_deg": declination_deg})
