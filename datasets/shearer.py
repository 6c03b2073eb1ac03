"""A longwall shearer cuts 40 m straight, 10 m sideways over the next 20 m, and on straight (shearer, section 6).

From standstill it goes at 1 m/s along the paper's yaw of 124.5 degrees, counter-clockwise from north, on a level
conveyor that it cannot leave: it points along its way. The scenario ends 20 m behind the bend, after 85 s; a shorter
log ends on the way, and in a longer one the last straight goes on.

The log is *nominal* unless an option says otherwise: every noise has the density in the rig, every initial error and
calibration is a draw from the rig's priors, and sideways and up the machine moves as the rig's ``lateral_sigma_mps``
allows, white from tenth to tenth of a second. What real machines do beside that:

- ``mti30=printed`` gives rig and log the gyro noise of the paper's table instead of the data sheet's (erratum H20)
- ``vibration=1`` shakes the body with 0.5 m/s^2 rms per axis in a band and lines of 0.7 and 20 Hz; the rig's
  ``sensors.imu.noise_factor`` should then be ``auto``
- ``odometer_tick_mm`` of the encoder, ``slips`` in which it turns too far, ``residual_ut`` of hard iron
- ``field_ut`` and ``dip_deg`` are those of the Earth's field; its declination is the rig's
- ``slide`` is a factor on the rig's ``lateral_sigma_mps``
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.interpolate import make_interp_spline

from datasets.motion import Lines, Motion, Spline, lines, rigid, rotate
from datasets.sensors import Disturbance, imu, magnetometer, odometer
from datasets.simulate import Simulation, simulate, stream
from datasets.tbm import smooth_step
from tbmfg.errors import RigError, TbmfgError
from tbmfg.rig import Odometer, Rig, load_rig, override
from tbmfg.timeseries import Floats

STEP_S = 0.1  # of the way's samples, and of the sliding: the period of the odometer
IMU_HZ, ODOMETER_HZ, MAGNETOMETER_HZ = 100.0, 10.0, 10.0
RAMP_S = 2.0  # from standstill to full speed
YAW_DEG = 124.5  # of the face, counter-clockwise from north
DEG = np.pi / 180
MTI30 = {"datasheet": (), "printed": ("sensors.imu.gyro_density_dps_rthz=0.1",)}


def rig() -> Rig:
    """The rig that priors and noises are drawn from: the shipped one, on a machine that does not shake."""
    return override(load_rig("shearer"), ["sensors.imu.noise_factor=1"])


@dataclass(frozen=True, slots=True)
class Conditions:
    """What is not nominal, and the Earth's field: the options of every log of this machine."""

    mti30: str = "datasheet"
    speed_mps: float = 1.0
    slide: float = 1.0
    vibration: float = 0.0
    odometer_tick_mm: float = 0.0
    slips: int = 0
    residual_ut: float = 0.0
    field_ut: float = 53.0
    dip_deg: float = 55.0


NOMINAL = Conditions()


def make(machine: Rig, *, seed: int, duration: float = 85.0, conditions: Conditions = NOMINAL) -> Simulation:
    """A longwall shearer cuts 40 m straight, 10 m aside over the next 20 m, and on straight."""
    return haul("shearer-cut", machine, CUT, seed=seed, duration=duration, conditions=conditions)


@dataclass(frozen=True, slots=True)
class Face:
    """The conveyor, seen from where a cut begins: straight for ``lead_m``, ``shift_m`` to the side over the next
    ``bend_m``, straight up to the end at ``length_m``. From there the next cut goes back, on the conveyor that has
    been shifted in the same way at that end."""

    shift_m: float
    lead_m: float
    bend_m: float
    length_m: float

    def aside(self, along: Floats) -> tuple[Floats, Floats]:
        """How far the conveyor lies aside at ``along`` (n,) m from where the cut begins, and its slope there."""
        x = np.clip((along - self.lead_m) / self.bend_m, 0.0, 1.0)
        return self.shift_m * smooth_step(x), self.shift_m / self.bend_m * 140 * (x * (1 - x)) ** 3

    def _bend(self) -> tuple[Floats, Floats]:
        """Along the face and along the conveyor, from the beginning of the bend to its end."""
        grid = np.linspace(0.0, self.bend_m, 2001)
        slope = self.aside(self.lead_m + grid)[1]
        return grid, make_interp_spline(grid, np.hypot(1.0, slope), k=5).antiderivative()(grid)

    @property
    def way_m(self) -> float:
        """Length of one cut along the conveyor."""
        return self.length_m - self.bend_m + self._bend()[1][-1]

    def along(self, way: Floats) -> Floats:
        """How far along the face (n,) m a ``way`` (n,) m along the conveyor leads."""
        grid, arc = self._bend()
        bent = make_interp_spline(arc, grid, k=5)(np.clip(way - self.lead_m, 0.0, arc[-1]))
        return np.minimum(way, self.lead_m) + bent + np.maximum(way - self.lead_m - arc[-1], 0.0)


CUT = Face(shift_m=10.0, lead_m=40.0, bend_m=20.0, length_m=1e6)  # longer than any log


def haul(
    name: str,
    machine: Rig,
    face: Face,
    *,
    seed: int,
    duration: float,
    conditions: Conditions,
    disturb: Disturbance | None = None,
) -> Simulation:
    """The log of a machine that cuts ``face`` there and back."""
    speed_mps = conditions.speed_mps
    if conditions.mti30 not in MTI30:
        raise TbmfgError(f"{name}: mti30={conditions.mti30}; there are {', '.join(MTI30)}")
    if speed_mps <= 0 or face.way_m < 2 * RAMP_S * speed_mps:
        raise TbmfgError(f"{name}: {speed_mps:g} m/s; it should be above 0, and reached and left within a cut")
    if "odometer" not in machine.sensors:
        raise RigError(f"{name}: the rig has no sensor called odometer; its arm_m says where the machine stands")
    machine = override(machine, MTI30[conditions.mti30])
    shoes: Odometer = machine.sensors["odometer"]
    if shoes.yaw_deg or shoes.pitch_deg or shoes.mounting_sd_deg:
        raise RigError(f"{name}: the shoes run along b's x axis; its odometer has no yaw, pitch or mounting sd")
    t_s = np.arange(-10, int(duration / STEP_S) + 20) * STEP_S
    slid = (
        conditions.slide
        * shoes.lateral_sigma
        / np.sqrt(ODOMETER_HZ * STEP_S)
        * stream(seed, "slide").standard_normal((len(t_s), 2))
    )
    heading = (YAW_DEG + machine.origin.x_axis_azimuth_deg) * DEG
    travel, pace = path(face, t_s, speed_mps, heading, shoes.arm, slid)
    shaking = cutting(t_s, pace, conditions.vibration, stream(seed, "vibration"))
    sensors = {
        "imu": partial(imu, rate_hz=IMU_HZ),
        "odometer": partial(
            odometer, rate_hz=ODOMETER_HZ, tick_m=1e-3 * conditions.odometer_tick_mm, slips=conditions.slips
        ),
        "magnetometer": partial(
            magnetometer,
            rate_hz=MAGNETOMETER_HZ,
            field_t=1e-6 * conditions.field_ut,
            dip_deg=conditions.dip_deg,
            residual_ut=conditions.residual_ut,
            disturb=disturb,
        ),
    }
    motion = Motion(travel, (shaking,) if conditions.vibration else ())
    return simulate(name, motion, machine, sensors, seed=seed, duration_s=duration, truth_rate_hz=IMU_HZ)


def path(
    face: Face, t_s: Floats, speed_mps: float, heading: float, contact_b: Floats, slid_mps: Floats
) -> tuple[Spline, Floats]:
    """The IMU's undisturbed way (x, y, z, roll, pitch, yaw), the machine standing on ``contact_b`` (3,), and its pace,
    speed over full speed, at ``t_s`` (n,). ``slid_mps`` (n, 2): how fast it slides to the left and lifts at full pace.
    """
    period_s = face.way_m / speed_mps + RAMP_S
    cut = np.floor(np.maximum(t_s, 0.0) / period_s)
    since = t_s - cut * period_s
    slow = since - (period_s - RAMP_S)
    pace = smooth_step(since / RAMP_S) - smooth_step(slow / RAMP_S)
    along = face.along(speed_mps * (ramped(since) - ramped(slow)))
    aside, slope = face.aside(along)
    back = cut % 2 == 1
    x = np.where(back, face.length_m - along, along)
    y = face.shift_m * cut + aside
    yaw = heading + np.arctan(np.where(back, -slope, slope))
    tracks = np.zeros((len(t_s), 6))
    tracks[:, 0], tracks[:, 1] = x * np.cos(heading) - y * np.sin(heading), x * np.sin(heading) + y * np.cos(heading)
    tracks[:, 5] = yaw
    R = rigid(tracks, tracks, tracks).R
    slid = np.pad(pace[:, None] * slid_mps, ((0, 0), (1, 0)))
    tracks[:, :3] += STEP_S * np.cumsum(rotate(R, slid), axis=0) - R @ contact_b
    return Spline(t_s, tracks), pace


def ramped(t_s: Floats) -> Floats:
    """Integral of smooth_step(t / RAMP_S) from 0 on, s."""
    x = np.clip(t_s / RAMP_S, 0.0, 1.0)
    return RAMP_S * x**5 * (7 - 14 * x + 10 * x**2 - 2.5 * x**3) + np.maximum(t_s - RAMP_S, 0.0)


def cutting(t_s: Floats, pace: Floats, vibration: float, rng: np.random.Generator) -> Lines:
    """What cutting shakes: a band of 3 to 45 Hz with 0.5 m/s^2 and 0.2 deg/s rms on every axis, and lines of 0.7 and
    20 Hz with 0.1 and 0.3 m/s^2; ``vibration`` multiplies every amplitude."""
    count = 32
    band_hz = 3.0 + 42.0 * (np.arange(count) + rng.random(count)) / count
    even = np.full((count, 3), np.sqrt(2 / count))  # amplitude of each line for 1 rms in all
    return lines(
        frequency_hz=np.concatenate([[0.7, 20.0], band_hz]),
        acceleration=vibration * np.vstack([np.full(3, 0.1), np.full(3, 0.3), 0.5 * even]),
        rate=vibration * DEG * np.vstack([np.full(3, 0.05), np.full(3, 0.1), 0.2 * even]),
        envelope=Spline(t_s, pace[:, None]),
        rng=rng,
    )
