"""Ideal sensors on a motion, and their noise.

Every noise has exactly the density in the rig, and everything hidden (bias, arm, offset, scale) is a draw from
the rig's prior. A sensor is a function of the scene, its part of the rig and its own random stream.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.special import ndtr

from datasets.motion import Kinematics, rotate_back
from datasets.simulate import START_NS, Scene, Sensed, period_means, ticks
from tbmfg.rig import Barometer, Imu, Laser, Magnetometer, Odometer, Prism
from tbmfg.timeseries import NS, Floats, Series, Times

DRIVE_HZ = 48.6  # an inverter a little below the mains; read 50 times a second, its field beats at 1.4 Hz
LOAD_HZ = 0.05  # of a motor's load
AIR_K = 295.15  # what a thermometer in the shaft says
AIR_GAS = 287.05  # of dry air, J/kg/K
WARMING = 9.8e-3  # of air that sinks without heat, K/m
STANDARD_WARMING = 6.5e-3  # of the atmosphere that pressure is turned into height with, K/m

# Times (n,) s, R_nb (n, 3, 3), the Earth's field in n (3,) T -> what is added to it in n, (n, 3) T, and what was drawn.
Disturbance = Callable[[Floats, Floats, Floats], tuple[Floats, dict[str, Any]]]


def imu(scene: Scene, sensor: Imu, rng: np.random.Generator, *, rate_hz: float) -> Sensed:
    """Means over each period of the angular rate and the specific force in the turning body axes.

    A unit that integrates its body-axis rates does the same: coning and sculling are left to the reader of the
    log. ``bias_gyro`` and ``bias_acc`` of ``drawn`` are (n, 3), in b, per sample.
    """
    edges_ns = ticks(scene.duration_s, rate_hz)
    ideal = period_means(scene.inertial, edges_ns)
    dt = 1 / rate_hz
    density, walk, bias_sd = (
        np.repeat(pair, 3)
        for pair in (
            (sensor.times * sensor.gyro_density, sensor.times * sensor.acc_density),
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
    scene: Scene,
    sensor: Prism,
    rng: np.random.Generator,
    *,
    rate_hz: float,
    jitter_s: float = 0.005,
    gaps: int = 0,
    visibility: Callable[[Floats], Floats] | None = None,
) -> Sensed:
    """Positions of the prism at instants that jitter about the nominal ones; the stamps know the jitter.

    ``gaps`` interruptions of 2 to 6 s lie anywhere in the log; ``visibility`` is the chance of a fix at times (n,) s.
    """
    arm = sensor.arm + sensor.arm_sd * rng.standard_normal(3)
    offset = sensor.clock_offset + sensor.clock_offset_sd * rng.standard_normal()
    gap_start, gap_length = rng.random((gaps, 2)).T * [[scene.duration_s], [4.0]] + [[0.0], [2.0]]
    jitter, *noise = rng.standard_normal((int(scene.duration_s * rate_hz), 4)).T
    t_s = (np.arange(len(jitter)) + 0.5) / rate_hz + jitter_s * jitter
    hidden = ((t_s[:, None] > gap_start) & (t_s[:, None] < gap_start + gap_length)).any(axis=1)
    seen = ~hidden & (t_s > 0) & (t_s < scene.duration_s)
    if visibility is not None:
        seen &= rng.random(len(t_s)) < visibility(t_s)
    t_ns = np.round(t_s[seen] * NS).astype(np.int64)

    position, _ = scene.motion(t_ns * 1e-9).at_point(arm)
    distance = np.linalg.norm(position - np.array(sensor.station_m), axis=1, keepdims=True)
    sigma = sensor.times * (1e-3 * sensor.sigma_mm + 1e-6 * sensor.sigma_ppm * distance)

    drift_ppm = sensor.clock_drift_ppm + sensor.clock_drift_sd_ppm * rng.standard_normal()
    late_ns = np.round(offset * NS + 1e-6 * drift_ppm * t_ns).astype(np.int64)

    def series(stamps: Times, point: Floats) -> Series:
        return Series(sensor.topic, "geometry_msgs/msg/PointStamped", START_NS + stamps, {"point": point}, "n")

    measured = position + sigma * np.column_stack(noise)[seen]
    drawn = {"arm_m": arm, "clock_offset_s": offset, "clock_drift_ppm": drift_ppm}
    return Sensed(series(t_ns + late_ns, measured), series(t_ns, position), drawn)


def odometer(
    scene: Scene,
    sensor: Odometer,
    rng: np.random.Generator,
    *,
    rate_hz: float,
    tick_m: float = 0.0,
    slips: int = 0,
    yaw_pitch_deg: tuple[float, float] = (0.0, 0.0),
) -> Sensed:
    """Mean forward speed of the contact point over each period, stamped at its end.

    The tracks roll with the undisturbed machine: an odometer does not feel the body's vibration. The forward axis
    is b's x axis turned by ``yaw_pitch_deg``; its other components are not measured and given as zero. An encoder
    counts whole ticks of ``tick_m``, 0 as many as it likes. In each of ``slips`` stretches of 1 to 3 s, ``slips_s``
    (k, 2) of ``drawn``, it turns 20 to 50 % too far.
    """
    edges_ns = ticks(scene.duration_s, rate_hz)
    yaw, pitch = np.radians(yaw_pitch_deg)
    ahead_b = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])

    def speed(t_s: Floats) -> Floats:
        travel = scene.motion.undisturbed(t_s)
        _, velocity_n = travel.at_point(sensor.arm)
        return rotate_back(travel.R, velocity_n) @ ahead_b[:, None]

    true = period_means(speed, edges_ns, panel_s=1 / rate_hz)[:, 0]
    scale = sensor.scale + sensor.scale_sd * rng.standard_normal()
    measured = (1 + scale) * true + sensor.times * sensor.sigma_mps * rng.standard_normal(len(true))
    drawn: dict[str, Any] = {"scale": scale, "yaw_pitch_deg": yaw_pitch_deg}
    if slips > 0:
        at, length, excess = rng.random((slips, 3)).T * [[scene.duration_s], [2.0], [0.3]] + [[0.0], [1.0], [0.2]]
        end_s = edges_ns[1:, None] * 1e-9
        measured += true * (((end_s > at) & (end_s < at + length)) @ excess)
        drawn["slips_s"] = np.column_stack([at, at + length])
    if tick_m > 0:
        measured = np.diff(np.floor(np.cumsum(measured / rate_hz) / tick_m), prepend=0.0) * tick_m * rate_hz

    def series(offset_s: float, forward: Floats) -> Series:
        stamps = START_NS + edges_ns[1:] + round(offset_s * NS)
        columns = {"linear": np.pad(forward[:, None], ((0, 0), (0, 2))), "angular": np.zeros((len(forward), 3))}
        return Series(sensor.topic, "geometry_msgs/msg/TwistStamped", stamps, columns, "odometer")

    return Sensed(series(sensor.clock_offset_s, measured), series(0.0, true), drawn)


def magnetometer(
    scene: Scene,
    sensor: Magnetometer,
    rng: np.random.Generator,
    *,
    rate_hz: float,
    field_t: float = 50e-6,
    dip_deg: float = 65.0,
    noise_t: float | None = None,
    motor_t: float = 0.0,
    residual_ut: float = 0.0,
    disturb: Disturbance | None = None,
) -> Sensed:
    """The Earth's field, T, and what the machine and its surroundings add to it in the log, not in ``clean``.

    The noise is white on every axis, ``noise_t`` or what gives the horizontal direction the rig's sigma. The field of
    an electric motor alternates along a direction of the body drawn anew, between half and one and a half times
    ``motor_t`` with the load; sampled, it beats at a few hertz. ``residual_ut`` is the size of a field that goes with
    the machine and that the rig does not know; ``disturb`` adds another.
    """
    t_ns = ticks(scene.duration_s, rate_hz)
    declination_deg = sensor.declination_deg + sensor.declination_sd_deg * rng.standard_normal()
    north, up = scene.north_up_n
    declination, dip = np.radians(declination_deg), np.radians(dip_deg)
    magnetic_north = np.cos(declination) * north + np.sin(declination) * np.cross(north, up)  # north x up is east
    field_n = field_t * (np.cos(dip) * magnetic_north - np.sin(dip) * up)
    # in b first, then in the sensor's axes; the machine's own field is fixed in the latter
    motion = scene.motion(t_ns * 1e-9)
    clean = field_n @ motion.R @ sensor.R_bm + 1e-6 * np.array(sensor.hard_iron_ut)
    sigma = sensor.times * (np.radians(sensor.sigma_deg) * field_t * np.cos(dip) if noise_t is None else noise_t)
    white = rng.standard_normal(clean.shape)
    axis, phase = rng.standard_normal(3), 2 * np.pi * rng.random(2)
    load = 1 + 0.5 * np.sin(2 * np.pi * LOAD_HZ * t_ns * 1e-9 + phase[0])
    motor = motor_t * load * np.cos(2 * np.pi * DRIVE_HZ * t_ns * 1e-9 + phase[1])

    def series(offset_s: float, values: Floats) -> Series:
        stamps = START_NS + t_ns + round(offset_s * NS)
        return Series(sensor.topic, "sensor_msgs/msg/MagneticField", stamps, {"field": values}, "imu")

    measured = clean + sigma * white + motor[:, None] * axis / np.linalg.norm(axis) @ sensor.R_bm
    drawn: dict[str, Any] = {"declination_deg": declination_deg}
    if residual_ut > 0:
        direction = rng.standard_normal(3)
        drawn["residual_ut"] = residual_ut * direction / np.linalg.norm(direction)
        measured += 1e-6 * drawn["residual_ut"]
    if sensor.hard_iron_sd_ut:
        iron_ut = sensor.hard_iron_sd_ut * rng.standard_normal(3)
        drawn["hard_iron_ut"] = np.array(sensor.hard_iron_ut) + iron_ut
        measured += 1e-6 * iron_ut
    if disturb is not None:
        added_n, told = disturb(t_ns * 1e-9, motion.R, field_n)
        measured += rotate_back(motion.R, added_n) @ sensor.R_bm
        drawn |= told
    return Sensed(series(sensor.clock_offset_s, measured), series(0.0, clean), drawn)


def barometer(
    scene: Scene,
    sensor: Barometer,
    rng: np.random.Generator,
    *,
    rate_hz: float,
    update_hz: float,
    noise_pa: float | None,
    drift_pa_per_h: float,
) -> Sensed:
    """Air pressure, Pa, in a shaft whose air is not as warm as its thermometer says: ``air_k`` of ``drawn``, by which
    heights have a scale error of the rig's sd. It warms downwards by WARMING.

    The unit converts ``update_hz`` times a second and is read ``rate_hz`` times. ``drift_pa_per_h`` is the sd of the
    weather's trend. Without ``noise_pa`` every error is the rig's: each reading is fresh, its noise white, its drift
    a random walk, and the air warms as the rig's ``lapse_sd_kpkm`` allows.
    """
    t_ns = ticks(scene.duration_s, rate_hz)
    depth = -scene.motion(t_ns * 1e-9).position[:, 2]
    warmth, weather, trend = rng.standard_normal(3)
    white, steps = rng.standard_normal((len(t_ns), 2)).T
    lapse = rng.standard_normal()
    air_k = AIR_K / (1.0 + sensor.scale_sd * warmth)
    middle_m = (depth.min() + depth.max()) / 2
    gravity = -scene.gravity_n[2]
    per_metre = 101325.0 * gravity / (AIR_GAS * AIR_K)
    collar_pa = 101325.0 + per_metre * sensor.bias_sd_m * weather

    def series(offset_s: float, pascals: Floats) -> Series:
        stamps = START_NS + t_ns + round(offset_s * NS)
        return Series(sensor.topic, "sensor_msgs/msg/FluidPressure", stamps, {"pressure": pascals}, "barometer")

    warming = STANDARD_WARMING + sensor.lapse_sd * lapse if noise_pa is None else WARMING
    column = partial(
        shaft_pressure, collar_pa=collar_pa, air_k=air_k, middle_m=middle_m, gravity=gravity, warming=warming
    )
    clean = column(depth)
    if noise_pa is None:
        walk = sensor.bias_walk / np.sqrt(rate_hz) * np.cumsum(steps)
        error_m = sensor.times * sensor.sigma_m * white + walk
        measured, offset_s = clean + per_metre * error_m, sensor.clock_offset_s
    else:
        converted = np.floor(np.arange(len(t_ns)) * update_hz / rate_hz + 1e-9).astype(int)
        t_s = converted / update_hz
        then = -scene.motion(t_s).position[:, 2]
        drift = drift_pa_per_h / 3600 * trend * t_s
        measured, offset_s = column(then) + drift + noise_pa * white[converted], 0.0
    drawn = {
        "air_k": air_k,
        "collar_pa": collar_pa,
        "warming": warming,
        # against pressure turned into height with the standard atmosphere, 288.15 K and 6.5 K/km
        "scale": 288.15 / air_k - 1.0,
        "lapse_kpkm": 1e3 * (warming - STANDARD_WARMING),
    }
    return Sensed(series(offset_s, measured), series(0.0, clean), drawn)


def shaft_pressure(
    depth: Floats, collar_pa: float, air_k: float, middle_m: float, gravity: float, warming: float = WARMING
) -> Floats:
    """Pressure, Pa, at ``depth`` (n,) m in a column of dry air, ``air_k`` warm at ``middle_m``.

    Hydrostatics, dp = p g / (R T) dh, in air that warms by ``warming`` K/m on its way down.
    """
    warmth = air_k + warming * (depth - middle_m)
    at_collar = air_k - warming * middle_m
    return collar_pa * (warmth / at_collar) ** (gravity / (AIR_GAS * warming))


def laser(
    scene: Scene,
    sensor: Laser,
    rng: np.random.Generator,
    *,
    rate_hz: float,
    dropout: float,
    resolution_m: float = 0.02e-3,
    half_width_m: float = 0.03,
) -> Sensed:
    """The spot of a plumb laser on a detector, x and y in its axes, m: where line and tilted plane meet.

    The line goes through n's origin, out of plumb by ``tilt_n`` of ``drawn``, m/m in n's x and y; the reading's zero is
    off by ``zero_m``. The spot jitters with the rig's sigma, is read in steps and no farther out than the detector is
    wide; dust hides a share ``dropout`` of the readings, which then are not sent.
    """
    t_ns = ticks(scene.duration_s, rate_hz)
    truth = scene.motion(t_ns * 1e-9)
    tilt, zero = np.array([[sensor.tilt_sd], [sensor.offset_sd]]) * rng.standard_normal((2, 2))
    *white, dust = rng.standard_normal((len(t_ns), 3)).T
    spot = spot_on_detector(truth, np.array(sensor.T_bd.xyz_m), sensor.T_bd.R, np.append(tilt, 1.0))
    noisy = spot + zero + 1e-3 * sensor.times * sensor.sigma_mm * np.column_stack(white)
    read = np.clip(resolution_m * np.round(noisy / resolution_m), -half_width_m, half_width_m)
    seen = ndtr(dust) >= dropout

    def series(rows: np.ndarray, xy: Floats) -> Series:
        points = np.pad(xy[rows], ((0, 0), (0, 1)))
        return Series(
            sensor.topic, "geometry_msgs/msg/PointStamped", START_NS + t_ns[rows], {"point": points}, "detector"
        )

    return Sensed(series(seen, read), series(np.ones_like(seen), spot), {"tilt_n": tilt, "zero_m": zero})


def spot_on_detector(truth: Kinematics, xyz_b: Floats, R_bd: Floats, along_n: Floats) -> Floats:
    """Where the line through n's origin along ``along_n`` (3,) meets the detector's plane, (n, 2) in its axes.

    Three equations, three unknowns: origin + R (x, y, 0) = s along.
    """
    origin_n, _ = truth.at_point(xyz_b)
    R_nd = truth.R @ R_bd
    unknowns = np.concatenate([R_nd[:, :, :2], np.broadcast_to(-along_n, origin_n.shape)[:, :, None]], axis=2)
    return np.linalg.solve(unknowns, -origin_n[:, :, None])[:, :2, 0]
