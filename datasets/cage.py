"""The attitude unit of the shaft boring machine on a cage that goes down a shaft 430 m deep (sbm, section 8).

It speeds up over 15 s, goes on at 3.90 m/s to the bottom or at 1.33 m/s for 300 s, and slows down over 15 s. The guide
rails shake it, the more the faster it goes. There is no laser on board: depth comes from the barometer alone, and how
warm the air in the shaft is, is not known to better than ``air_sd_k``, which cannot be told from a scale of depth.
"""

from __future__ import annotations

import numpy as np

from datasets import shaft
from datasets.motion import Lines, Motion, Spline, integral, lines, smooth_step
from datasets.simulate import Simulation, stream
from tbmfg.rig import Rig, override
from tbmfg.timeseries import Floats

RAMP_S = 15.0
FAST_MPS, SLOW_MPS = 3.90, 1.33
FAST_S = 430.0 / FAST_MPS + RAMP_S  # to the bottom: 95.3 s between the ramps
SLOW_S = 300.0 + 2 * RAMP_S


def rig() -> Rig:
    """The shaft boring machine's rig without its laser, free to go down the shaft."""
    machine = override(shaft.rig(), ["motion.radius_m=450", "motion.speed_mps=4", "keyframes.max_gap_s=0.2"])
    kept = {name: sensor for name, sensor in machine.sensors.items() if name != "laser"}
    return machine.model_copy(update={"sensors": kept, "name": "cage"})


def fast(
    machine: Rig,
    *,
    seed: int,
    duration: float = FAST_S,
    vibration: float = 1.0,
    air_sd_k: float = 2.0,
    nominal: int = 0,
) -> Simulation:
    """A cage going down 430 m at 3.90 m/s."""
    return ride("cage-fast", FAST_MPS, FAST_S, machine, seed, duration, vibration, air_sd_k, nominal)


def slow(
    machine: Rig,
    *,
    seed: int,
    duration: float = SLOW_S,
    vibration: float = 1.0,
    air_sd_k: float = 2.0,
    nominal: int = 0,
) -> Simulation:
    """A cage going down 419 m at 1.33 m/s."""
    return ride("cage-slow", SLOW_MPS, SLOW_S, machine, seed, duration, vibration, air_sd_k, nominal)


def ride(
    name: str,
    speed_mps: float,
    whole_s: float,
    machine: Rig,
    seed: int,
    duration: float,
    vibration: float,
    air_sd_k: float,
    nominal: int,
) -> Simulation:
    """Down at ``speed_mps``, standing after ``whole_s``."""
    t_s = shaft.times(duration)
    speed = pace(t_s, speed_mps, whole_s)
    shaking = rails(t_s, vibration * (not nominal) * speed, stream(seed, "vibration"))
    motion = Motion(down(t_s, speed), (shaking,))
    return shaft.record(name, motion, machine, seed, duration, 0.0, 0.0, air_sd_k, nominal, without="laser")


def pace(t_s: Floats, speed_mps: float, whole_s: float) -> Floats:
    """Speed of a ride of ``whole_s``, m/s, (n,)."""
    return speed_mps * smooth_step(t_s / RAMP_S) * smooth_step((whole_s - t_s) / RAMP_S)


def down(t_s: Floats, speed: Floats) -> Spline:
    """The undisturbed way at ``speed`` (n,) m/s, level and straight."""
    path = np.zeros((len(t_s), 6))
    path[:, 2] = -integral(t_s, speed)
    return Spline(t_s, path)


def rails(t_s: Floats, speed: Floats, rng: np.random.Generator) -> Lines:
    """The guide rails: 2 to 60 Hz, per m/s 0.1 m/s^2 across and 0.05 m/s^2 along them and 0.1 deg/s, rms per axis."""
    count = 32
    even = np.full((count, 3), np.sqrt(2 / count))
    return lines(
        frequency_hz=2.0 + 58.0 * (np.arange(count) + rng.random(count)) / count,
        acceleration=even * [0.1, 0.1, 0.05],
        rate=0.1 * shaft.DEG * even,
        envelope=Spline(t_s, speed[:, None]),
        rng=rng,
    )
