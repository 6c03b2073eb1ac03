"""A shaft boring machine with its attitude unit, barometer and laser detector on top (sbm, section 8).

It stands, cuts on the spot at 10 or 40 turns of the cutterhead a minute, turns about the shaft's axis while it rocks,
or sinks: then it goes where it points, the ground turns it away, and it is steered back every 40 s. It tilts about a
point 1 m below the unit, which so moves sideways.

While it stands or cuts on the spot, a constant is a good estimate of its attitude. ``shaft-dynamic`` and
``shaft-descend`` are the ones to judge estimators by.

The cutter's vibration is real motion of the body, lines at the cutterhead's frequency and its harmonics to 12 per turn,
whose displacement falls with their number and is, with the rig's detector, what the source's figures show (1.1 and
2.4 mm rms in both axes together), and a band of 20 to 200 Hz that fills up to 0.45 and 0.9 m/s^2 rms per axis. A unit
read 50 times a second takes means over its periods: it folds what remains of the band.

``nominal=1`` follows the estimators' model: no vibration, no motor, no dust, and every noise as the rig has it.
Otherwise the makers' figures hold where the rig has an allowance: 15 nT for the magnetometer
beside the motor's field, 0.012 mbar for the barometer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from datasets.motion import Lines, Motion, Signal, Spline, integral, lines, rigid, smooth_step
from datasets.sensors import barometer, imu, laser, magnetometer
from datasets.simulate import Simulation, simulate, stream
from tbmfg.rig import Rig, load_rig, override
from tbmfg.timeseries import Floats

RATE_HZ = 50.0
STEP_S = 0.05  # of the path's samples; the spline through them is the truth
PIVOT_B = np.array([0.0, 0.0, -1.0])  # what the machine tilts about
DIP_DEG = 58.0

DEG = np.pi / 180

# What the shipped rig leaves open: a start on a standing machine, levelled and held against a compass.
SETTING = (
    "initial.yaw_sd_deg=1",
    "initial.tilt_sd_deg=0.3",
    "initial.position_sd_m=0.005",
    "initial.velocity_sd_mps=0.05",
)


def rig() -> Rig:
    """The rig that priors and noises are drawn from."""
    return override(load_rig("shaft"), SETTING)


@dataclass(frozen=True, slots=True)
class Cutter:
    """How the cutterhead shakes the machine at ``rpm`` turns a minute; rms per axis of displacement at the lines, of
    acceleration in all, and of tilting."""

    rpm: float
    displacement_m: float
    acceleration: float
    rocking_deg: float


LOW = Cutter(rpm=10.0, displacement_m=0.8e-3, acceleration=0.45, rocking_deg=0.05)
HIGH = Cutter(rpm=40.0, displacement_m=1.7e-3, acceleration=0.9, rocking_deg=0.1)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The motor's field beside the magnetometer, the share of laser spots that dust hides, and ``nominal``: neither."""

    motor_ut: float
    dropout: float
    nominal: int = 0


QUIET, CUTTING = Surroundings(motor_ut=0.0, dropout=0.0), Surroundings(motor_ut=2.0, dropout=0.05)


def static(
    machine: Rig,
    *,
    seed: int,
    duration: float = 40.0,
    around: Surroundings = QUIET,
) -> Simulation:
    """A shaft boring machine standing level."""
    t_s = times(duration)
    motion = Motion(tilting(t_s, np.zeros((len(t_s), 3)), np.zeros((len(t_s), 3))))
    return record("shaft-static", motion, machine, seed, duration, around)


def low(
    machine: Rig,
    *,
    seed: int,
    duration: float = 40.0,
    vibration: float = 1.0,
    around: Surroundings = CUTTING,
) -> Simulation:
    """The shaft boring machine cutting on the spot at 10 turns a minute."""
    motion = on_the_spot(LOW, duration, vibration * (not around.nominal), stream(seed, "vibration"))
    return record("shaft-low", motion, machine, seed, duration, around)


def high(
    machine: Rig,
    *,
    seed: int,
    duration: float = 40.0,
    vibration: float = 1.0,
    around: Surroundings = CUTTING,
) -> Simulation:
    """The shaft boring machine cutting on the spot at 40 turns a minute."""
    motion = on_the_spot(HIGH, duration, vibration * (not around.nominal), stream(seed, "vibration"))
    return record("shaft-high", motion, machine, seed, duration, around)


def dynamic(
    machine: Rig,
    *,
    seed: int,
    duration: float = 80.0,
    rocking_deg: float = 0.5,
    around: Surroundings = CUTTING,
) -> Simulation:
    """The shaft boring machine turning to and fro within 17 degrees, rocking."""
    t_s, phase = times(duration), 2 * np.pi * stream(seed, "rocking").random((2, 2))
    wave = np.sin(2 * np.pi * np.multiply.outer(t_s, [[0.07, 0.19], [0.09, 0.16]]) + phase).sum(axis=2)
    rpy = np.column_stack([rocking_deg * DEG * wave, turning(t_s)])
    motion = Motion(tilting(t_s, np.zeros((len(t_s), 3)), rpy))
    return record("shaft-dynamic", motion, machine, seed, duration, around)


def descend(
    machine: Rig,
    *,
    seed: int,
    duration: float = 180.0,
    vibration: float = 1.0,
    around: Surroundings = CUTTING,
) -> Simulation:
    """The shaft boring machine sinking, drifting off and steered back."""
    t_s = times(duration)
    feed = 0.01 * smooth_step((t_s - 5.0) / 5.0)
    way, rpy = steered(t_s, feed, stream(seed, "ground"))
    cutting = Spline(t_s, (feed / 0.01)[:, None])
    shaking = cutter(LOW, vibration * (not around.nominal), cutting, stream(seed, "vibration"))
    motion = Motion(tilting(t_s, way, rpy), (shaking,))
    return record("shaft-descend", motion, machine, seed, duration, around)


def record(
    name: str,
    motion: Motion,
    machine: Rig,
    seed: int,
    duration: float,
    around: Surroundings,
    without: str = "",
) -> Simulation:
    """The log of ``motion``; ``without`` names a kind of sensor that is not on board."""
    own = not around.nominal
    sensors = {
        "imu": partial(imu, rate_hz=RATE_HZ),
        "magnetometer": partial(
            magnetometer,
            rate_hz=RATE_HZ,
            dip_deg=DIP_DEG,
            noise_t=15e-9 if own else None,
            motor_t=1e-6 * around.motor_ut * own,
        ),
        "barometer": partial(
            barometer,
            rate_hz=RATE_HZ,
            update_hz=20.0,
            noise_pa=1.2 if own else None,
            drift_pa_per_h=10.0,
        ),
        "laser": partial(laser, rate_hz=RATE_HZ, dropout=around.dropout * own),
    }
    sensors.pop(without, None)
    return simulate(name, motion, machine, sensors, seed=seed, duration_s=duration, truth_rate_hz=RATE_HZ)


def times(duration_s: float) -> Floats:
    """From a second before the log to a second after it."""
    return np.arange(-1.0, duration_s + 1.0 + STEP_S, STEP_S)


def tilting(t_s: Floats, way: Floats, rpy: Floats) -> Spline:
    """The unit's undisturbed way, the machine tilting by ``rpy`` (n, 3) about its pivot, which goes ``way`` (n, 3).

    Level and at ``way`` zero, the unit is at n's origin.
    """
    values = np.hstack([way, rpy])
    return Spline(t_s, np.hstack([PIVOT_B + way - rigid(values, values, values).R @ PIVOT_B, rpy]))


def on_the_spot(how: Cutter, duration_s: float, vibration: float, rng: np.random.Generator) -> Motion:
    """Level and in place but for the cutter."""
    t_s = times(duration_s)
    still = tilting(t_s, np.zeros((len(t_s), 3)), np.zeros((len(t_s), 3)))
    return Motion(still, (cutter(how, vibration, Spline(t_s, np.ones((len(t_s), 1))), rng),))


def turning(t_s: Floats) -> Floats:
    """Yaw, rad: 40 s of steps every 10 s, 40 s of 0.05 Hz with 17 degrees, and again."""
    t = t_s % 80.0
    steps = ((10.0, 10.0), (20.0, -18.0), (30.0, 25.0), (38.0, -17.0))
    yaw = sum(size * smooth_step((t - at) / 2.0) for at, size in steps)
    wave = smooth_step((t - 40.0) / 3.0) * smooth_step((80.0 - t) / 3.0)
    return DEG * (yaw + 17.0 * wave * np.sin(2 * np.pi * 0.05 * (t - 40.0)))


def steered(t_s: Floats, feed: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Way of the pivot (n, 3) m and roll, pitch, yaw (n, 3) of a machine that sinks by ``feed`` (n,) m/s.

    Every 40 s it is turned within 6 s to where it would be back on the laser's line after as much again; then the
    ground turns it away.
    """
    period_s, correction_s = 40.0, 6.0
    rpy, aside = np.zeros((len(t_s), 3)), np.zeros(2)
    for begin in np.arange(10.0, t_s[-1], period_s):
        here = slice(*np.searchsorted(t_s, [begin, begin + period_s]))
        before = rpy[here.start - 1].copy()
        back = np.array([-aside[1], aside[0]]) / (feed[here].mean() * period_s)
        aim = np.append(np.clip(back, -0.6 * DEG, 0.6 * DEG), 0.0)
        away = DEG * np.array([0.5, 0.5, 0.2]) * rng.standard_normal(3).clip(-1.5, 1.5)
        since = (t_s[here, None] - begin) / correction_s
        turned = (aim - before) * smooth_step(since)
        rpy[here] = before + turned + away * smooth_step((since - 1) * correction_s / (period_s - correction_s))
        rpy[here.stop :] = rpy[here.stop - 1]
        aside += STEP_S * (feed[here] @ np.column_stack([-rpy[here, 1], rpy[here, 0]]))
    values = np.hstack([np.zeros((len(t_s), 3)), rpy])
    down = -rigid(values, values, values).R[:, :, 2]
    way = np.column_stack([integral(t_s, feed * down[:, axis]) for axis in range(3)])
    return way, rpy


def cutter(how: Cutter, vibration: float, envelope: Signal, rng: np.random.Generator) -> Lines:
    """What the cutterhead does to the machine under ``envelope``; ``vibration`` multiplies every amplitude."""
    order = np.arange(1, 13)
    fall = np.sqrt(2 / np.sum(1.0 / order**2)) / order  # amplitudes whose squares add up to an rms of 1
    turn_hz = how.rpm / 60 * order
    acceleration = how.displacement_m * fall * (2 * np.pi * turn_hz) ** 2
    rate = how.rocking_deg * DEG * fall * 2 * np.pi * turn_hz
    count = 32
    band_hz = 20.0 + 180.0 * (np.arange(count) + rng.random(count)) / count
    rest = np.sqrt(how.acceleration**2 - np.sum(acceleration**2) / 2)
    even = np.full((count, 3), np.sqrt(2 / count))
    tilts = np.array([1.0, 1.0, 0.0])
    return lines(
        frequency_hz=np.concatenate([turn_hz, band_hz]),
        acceleration=vibration * np.vstack([np.outer(acceleration, np.ones(3)), rest * even]),
        rate=vibration * np.vstack([np.outer(rate, tilts), 0.1 * DEG * even]),
        envelope=envelope,
        rng=rng,
    )
