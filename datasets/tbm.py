"""A roadheader in a roadway, tracked by a total station (tbm_mse, section 7).

It stands, starts its pump, drives at 0.1 m/s straight and in bends, turns on the spot, stands and reverses, on a
floor that slopes by up to 2 degrees. The odometer's contact point is the centre between the tracks, about which
a tracked machine turns: in the undisturbed travel it neither slides sideways nor leaves the floor.

``vibration=0 slide=1`` follows the estimators' model: every error is a draw from the rig, except that a standing
machine does not slide at all.

- Vibration is real motion of the body, and breaks three assumptions: that the motion is smooth within an IMU
  period (small at 475 Hz, but lines above half the rate alias), that the prism moves as the machine does, and
  that the tracks under the odometer move with the body (it shakes on them by millimetres).
- ``slide`` is a factor on the rig's ``lateral_sigma_mps``, for sliding sideways and lifting while the tracks
  move. Without it that sigma is an allowance for the shaking only, and generous in a quiet log.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import cycle

import numpy as np
from scipy.spatial.transform import Rotation

from datasets.motion import Lines, Motion, Spline, integral, lines, rigid, rotate, smooth_step
from datasets.sensors import imu, magnetometer, odometer, prism
from datasets.simulate import Simulation, simulate, stream
from tbmfg.errors import RigError
from tbmfg.rig import Odometer, Rig, load_rig, override
from tbmfg.timeseries import Floats

STEP_S = 0.05  # of the path's samples; the spline through them is the truth
RAMP_S = 1.5  # at both ends of a move
STAND_S = 15.0  # at the start; the pump starts at two thirds of it
START = np.array([40.0, 0.5, -1.2])  # contact point in n, the total station being at the origin, m
START_YAW_DEG = 6.0

# One round of 105 s: duration s, distance m, turn to the left deg. Then the machine does all of it backwards in
# reverse order, which brings it back to its start, and begins anew: so it stays in the roadway in any log.
ROUND = (
    (20.0, 1.85, 0.0),
    (20.0, 1.85, 25.0),
    (5.0, 0.0, 0.0),
    (14.0, 0.0, -40.0),
    (16.0, 1.45, 10.0),
    (5.0, 0.0, 0.0),
    (17.0, -1.55, -12.0),
    (8.0, 0.0, 17.0),
)

# The floor: height m, wave vector rad/m (wavelengths 4.5, 6.3 and 9 m) and phase rad of three waves.
FLOOR_M = np.array([0.012, 0.016, 0.020])
FLOOR_WAVE = np.array([[1.35, 0.35], [0.80, -0.60], [0.25, 0.65]])
FLOOR_PHASE = np.array([0.4, 1.9, 4.1])

DEG = np.pi / 180


# What the shipped rig leaves open: a surveyed start on a standing machine, and the tracks below the IMU.
SETTING = (
    "initial.yaw_sd_deg=0.3",
    "initial.tilt_sd_deg=0.1",
    "initial.position_sd_m=0.02",
    "initial.velocity_sd_mps=0.01",
    "sensors.odometer.arm_m=[-0.4, 0.0, -1.1]",
)


def rig() -> Rig:
    """The rig that the drive's priors and noises are drawn from."""
    return override(load_rig("tbm"), SETTING)


def make(
    machine: Rig,
    *,
    seed: int,
    duration: float = 120.0,
    vibration: float = 1.0,
    slide: float = 0.0,
    imu_rate_hz: float = 475.0,
    prism_rate_hz: float = 5.0,
    prism_gaps: int = 0,
    odometer_rate_hz: float = 20.0,
    magnetometer_rate_hz: float = 20.0,
    truth_rate_hz: float | None = None,
) -> Simulation:
    """A roadheader in a roadway, tracked by a total station.

    ``prism_gaps`` is how often dust hides the prism for seconds. Truth is written at the IMU's stamps unless
    ``truth_rate_hz`` says otherwise: interpolated over a vibration of 24.5 Hz and more, a slower one errs by more
    than the estimates.
    """
    sensors = {
        "imu": partial(imu, rate_hz=imu_rate_hz),
        "prism": partial(prism, rate_hz=prism_rate_hz, gaps=prism_gaps),
        "magnetometer": partial(magnetometer, rate_hz=magnetometer_rate_hz),
    }
    if "odometer" not in machine.sensors:
        raise RigError("tbm-drive: the rig has no sensor called odometer; its arm_m says where the machine stands")
    tracks: Odometer = machine.sensors["odometer"]
    turned = tracks.mounting_sd_deg * stream(seed, "mounting").standard_normal(2)
    yaw_deg, pitch_deg = tracks.yaw_deg + turned[0], tracks.pitch_deg + turned[1]
    sensors["odometer"] = partial(odometer, rate_hz=odometer_rate_hz, yaw_pitch_deg=(yaw_deg, pitch_deg))
    mounting = None  # of the IMU in the machine, whose x axis the tracks run along
    if yaw_deg or pitch_deg:
        mounting = Rotation.from_euler("ZY", [yaw_deg, pitch_deg], degrees=True).inv().as_matrix()
    plan = Plan.over(duration)
    slide_density = slide * tracks.lateral_sigma / np.sqrt(odometer_rate_hz)
    contact_m = tracks.arm if mounting is None else mounting @ tracks.arm
    travel = path(plan, contact_m, slide_density, stream(seed, "slide"))
    shaken = shaking(plan, vibration, stream(seed, "vibration")) if vibration else ()
    motion = Motion(travel, shaken, mounting)
    return simulate(
        "tbm-drive",
        motion,
        machine,
        sensors,
        seed=seed,
        duration_s=duration,
        truth_rate_hz=truth_rate_hz or imu_rate_hz,
    )


@dataclass(frozen=True, slots=True)
class Plan:
    """What the machine is told to do at times ``t_s`` (n,).

    ``speed`` m/s forward, ``turn_rate`` rad/s to the left, and how far tracks (``moving``) and ``pump`` run, 0 to 1.
    """

    t_s: Floats
    speed: Floats
    turn_rate: Floats
    moving: Floats
    pump: Floats

    @staticmethod
    def standing(duration_s: float) -> Plan:
        """Nothing moves and nothing runs."""
        t_s = np.arange(-1.0, duration_s + 1.0 + STEP_S, STEP_S)
        return Plan(t_s, *np.zeros((4, len(t_s))))

    @staticmethod
    def over(duration_s: float, moves: tuple[tuple[float, float, float], ...] = ROUND) -> Plan:
        """Standing, then ``moves`` there and back; from a second before the log to a second after it."""
        t_s = np.arange(-1.0, duration_s + 1.0 + STEP_S, STEP_S)
        speed, turn_rate, moving = np.zeros((3, len(t_s)))
        stand_s = min(STAND_S, duration_s / 8)  # a short log shows motion too
        back = tuple((length, -metres, -turn) for length, metres, turn in reversed(moves))
        begin = stand_s
        for length, metres, turn in cycle(moves + back):
            if begin >= t_s[-1]:
                break
            here = slice(*np.searchsorted(t_s, [begin, begin + length]))
            pace = smooth_step((t_s[here] - begin) / RAMP_S) * smooth_step((begin + length - t_s[here]) / RAMP_S)
            speed[here] = pace * metres / (length - RAMP_S)
            turn_rate[here] = pace * turn * DEG / (length - RAMP_S)
            moving[here] = pace * bool(metres or turn)
            begin += length
        return Plan(t_s, speed, turn_rate, moving, smooth_step((t_s - stand_s * 2 / 3) / RAMP_S))


def path(
    plan: Plan,
    contact_m: Floats,
    slide_density: float,
    rng: np.random.Generator,
    start: Floats = START,
    start_yaw_deg: float = START_YAW_DEG,
) -> Spline:
    """The IMU's undisturbed way (x, y, z, roll, pitch, yaw), the machine standing on ``contact_m`` (3,).

    ``slide_density`` is the white noise of the contact point's sideways and upward speed, m/s/sqrt(Hz).
    """
    yaw = start_yaw_deg * DEG + integral(plan.t_s, plan.turn_rate)
    x, y = (start[axis] + integral(plan.t_s, plan.speed * part(yaw)) for axis, part in enumerate((np.cos, np.sin)))
    height, slope = floor(np.column_stack([x, y]))
    ahead = slope[:, 0] * np.cos(yaw) + slope[:, 1] * np.sin(yaw)
    left = slope[:, 1] * np.cos(yaw) - slope[:, 0] * np.sin(yaw)
    # x axis along the track, z axis normal to the floor
    pitch, roll = -np.arctan(ahead), np.arctan(left / np.hypot(1, ahead))
    tracks = np.column_stack([x, y, start[2] + height, roll, pitch, yaw])
    R = rigid(tracks, tracks, tracks).R
    slid = slide_density / np.sqrt(STEP_S) * plan.moving[:, None] * rng.standard_normal((len(plan.t_s), 2))
    tracks[:, :3] += STEP_S * np.cumsum(rotate(R, np.pad(slid, ((0, 0), (1, 0)))), axis=0) - R @ contact_m
    return Spline(plan.t_s, tracks)


def floor(point: Floats) -> tuple[Floats, Floats]:
    """Height (n,) m and gradient (n, 2) of the floor at ``point`` (n, 2), both zero in the mean."""
    phase = point @ FLOOR_WAVE.T + FLOOR_PHASE
    return np.cos(phase) @ FLOOR_M, -np.sin(phase) * FLOOR_M @ FLOOR_WAVE


def shaking(plan: Plan, vibration: float, rng: np.random.Generator) -> tuple[Lines, Lines]:
    """The oil pump, and the crawler while the tracks move; ``vibration`` multiplies every amplitude.

    Pump: 24.5 Hz and harmonics to 220.5 Hz, falling with their number. Crawler: the beat of its links at 0.6 Hz,
    and a band of 3 to 60 Hz with 0.3 m/s^2 and 0.1 deg/s rms on every axis.
    """
    order = np.arange(1, 10)[:, None]
    pump = lines(
        frequency_hz=24.5 * order[:, 0],
        acceleration=vibration * np.array([1.0, 0.4, 0.6]) / order,
        rate=vibration * DEG * np.array([0.5, 0.3, 0.2]) / order,
        envelope=Spline(plan.t_s, plan.pump[:, None]),
        rng=rng,
    )
    count = 32
    band_hz = 3.0 + 57.0 * (np.arange(count) + rng.random(count)) / count
    even = np.full((count, 3), np.sqrt(2 / count))  # amplitude of each line for 1 rms in all
    crawler = lines(
        frequency_hz=np.concatenate([[0.6], band_hz]),
        acceleration=vibration * np.vstack([[0.05, 0.02, 0.03], 0.3 * even]),
        rate=vibration * DEG * np.vstack([[0.05, 0.1, 0.02], 0.1 * even]),
        envelope=Spline(plan.t_s, plan.moving[:, None]),
        rng=rng,
    )
    return pump, crawler
