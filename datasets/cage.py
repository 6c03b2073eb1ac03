"""The attitude unit of the shaft boring machine on a cage that goes down a shaft 430 m deep (sbm, section 8).

It stands, speeds up over 15 s, goes on at 3.90 m/s to the bottom or at 1.33 m/s for 300 s, slows down over 15 s, and
stands. The guide rails shake it, the more the faster it goes. There is no laser on board: depth comes from the
barometer, and how warm the air in the shaft is, is not known to better than the rig says, which cannot be told from a
scale of depth. ``survey_sd_m`` above 0 puts a surveyed position at the log's end into the rig, a depth known so well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from datasets import shaft
from datasets.motion import Lines, Motion, Spline, integral, lines, smooth_step
from datasets.simulate import Simulation, stream
from tbmfg.rig import Rig, SurveyPoint, override
from tbmfg.timeseries import Floats

RAMP_S = 15.0
FAST_MPS, SLOW_MPS = 3.90, 1.33
STAND_S = 5.0  # at both ends
FAST_S = 430.0 / FAST_MPS + RAMP_S + 2 * STAND_S  # to the bottom: 95.3 s between the ramps
SLOW_S = 300.0 + 2 * RAMP_S + 2 * STAND_S


def rig() -> Rig:
    """The shaft boring machine's rig without its laser, free to go down the shaft."""
    machine = override(shaft.rig(), ["motion.radius_m=450", "motion.speed_mps=4", "keyframes.max_gap_s=0.5"])
    kept = {name: sensor for name, sensor in machine.sensors.items() if name != "laser"}
    return machine.model_copy(update={"sensors": kept, "name": "cage"})


@dataclass(frozen=True, slots=True)
class Way:
    """How the rails shake, how well the log's end is surveyed (0: not), and ``nominal``: without shaking."""

    vibration: float = 1.0
    survey_sd_m: float = 0.0
    nominal: int = 0


SHAKEN = Way()


def fast(machine: Rig, *, seed: int, duration: float = FAST_S, way: Way = SHAKEN) -> Simulation:
    """A cage going down 430 m at 3.90 m/s."""
    return ride("cage-fast", FAST_MPS, FAST_S, machine, seed, duration, way)


def slow(machine: Rig, *, seed: int, duration: float = SLOW_S, way: Way = SHAKEN) -> Simulation:
    """A cage going down 419 m at 1.33 m/s."""
    return ride("cage-slow", SLOW_MPS, SLOW_S, machine, seed, duration, way)


def ride(
    name: str,
    speed_mps: float,
    whole_s: float,
    machine: Rig,
    seed: int,
    duration: float,
    way: Way,
) -> Simulation:
    """Down at ``speed_mps`` within ``whole_s``."""
    t_s = shaft.times(duration)
    speed = pace(t_s, speed_mps, whole_s)
    shaking = rails(t_s, way.vibration * (not way.nominal) * speed, stream(seed, "vibration"))
    motion = Motion(down(t_s, speed), (shaking,))
    if way.survey_sd_m:
        end = motion(np.array([duration])).position[0] + way.survey_sd_m * stream(seed, "survey").standard_normal(3)
        mark = SurveyPoint(at="end", position_m=tuple(end.tolist()), sigma_m=way.survey_sd_m)
        machine = machine.model_copy(update={"survey": (mark,)})
    around = replace(shaft.QUIET, nominal=way.nominal)
    return shaft.record(name, motion, machine, seed, duration, around, without="laser")


def pace(t_s: Floats, speed_mps: float, whole_s: float) -> Floats:
    """Speed of a ride that ends, standing, at ``whole_s``; m/s, (n,)."""
    return speed_mps * smooth_step((t_s - STAND_S) / RAMP_S) * smooth_step((whole_s - STAND_S - t_s) / RAMP_S)


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
