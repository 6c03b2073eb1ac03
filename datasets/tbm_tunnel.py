"""The roadheader of ``tbm`` driving down an endless tunnel by IMU, odometer and LiDAR alone.

It stands, then drives at 0.5 m/s along the axis, swaying by a degree or two. In a smooth tunnel no scan tells where
along the axis it was taken, in a ribbed one the arches do. The tunnel is open and longer than the LiDAR sees.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from datasets.lidar import LONGEST_M, lidar
from datasets.motion import Motion
from datasets.sensors import imu, odometer
from datasets.simulate import Simulation, simulate, stream
from datasets.tbm import DEG, START, STEP_S, Plan, path, shaking, smooth_step
from datasets.tbm import rig as drive_rig
from datasets.worlds import tunnel
from tbmfg.errors import TbmfgError
from tbmfg.rig import Rig, override

SPEED_MPS = 0.5
SWAY_DEG, SWAY_S = 1.5, 20.0
WALLS = ("smooth", "ribbed")

LIDAR = "sensors.lidar={topic: /points, T_bl: {xyz_m: [0.5, 0.0, 0.8], rpy_deg: [0.5, -1.0, 1.5]}}"
SETTING = (LIDAR, "sensors.odometer.scale_sd=0.003")
SENSORS = ("imu", "odometer", "lidar")


def rig() -> Rig:
    """The rig of the drive with a LiDAR, without prism and magnetometer, and with a calibrated odometer."""
    machine = override(drive_rig(), SETTING)
    return machine.model_copy(update={"sensors": {name: machine.sensors[name] for name in SENSORS}})


def make(
    machine: Rig,
    *,
    seed: int,
    duration: float = 60.0,
    walls: str = "smooth",
    vibration: float = 1.0,
    imu_rate_hz: float = 475.0,
    odometer_rate_hz: float = 20.0,
    lidar_rate_hz: float = 10.0,
    columns: int = 1800,
    truth_rate_hz: float | None = None,
) -> Simulation:
    """A roadheader down an endless tunnel by IMU, odometer and LiDAR; walls smooth or ribbed.

    ``columns`` of 16 points in a scan.
    """
    if walls not in WALLS:
        raise TbmfgError(f"tbm-tunnel: walls={walls}: should be {' or '.join(WALLS)}")
    plan = _plan(duration)
    travel = path(
        plan, machine.sensors["odometer"].arm, 0.0, stream(seed, "slide"), np.array([0.0, 0.0, START[2]]), 0.0
    )
    motion = Motion(travel, shaking(plan, vibration, stream(seed, "vibration")) if vibration else ())
    reach = LONGEST_M + 10.0
    world = tunnel(-reach, SPEED_MPS * duration + reach, walls == "ribbed", START[2] - 0.05)
    sensors = {
        "imu": partial(imu, rate_hz=imu_rate_hz),
        "odometer": partial(odometer, rate_hz=odometer_rate_hz),
        "lidar": partial(lidar, world=world, rate_hz=lidar_rate_hz, columns=columns),
    }
    return simulate(
        "tbm-tunnel",
        motion,
        machine,
        sensors,
        seed=seed,
        duration_s=duration,
        truth_rate_hz=truth_rate_hz or imu_rate_hz,
    )


def _plan(duration_s: float) -> Plan:
    """Standing for 5 s, less in a short log, then driving to the end."""
    t_s = np.arange(-1.0, duration_s + 1.0 + STEP_S, STEP_S)
    moving = smooth_step((t_s - min(5.0, duration_s / 8)) / 2.0)
    swing = SWAY_DEG * DEG * 2 * np.pi / SWAY_S
    return Plan(t_s, SPEED_MPS * moving, swing * np.cos(2 * np.pi * t_s / SWAY_S) * moving, moving, moving)
