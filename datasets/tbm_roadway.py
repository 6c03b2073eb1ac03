"""The roadheader of ``tbm`` in a closed roadway of 25 x 5 x 4 m with rough walls, seen by a LiDAR, in air or in dust.

The drive, its vibration and its other sensors are those of ``tbm-drive``. Dust (k = 0.05 to 0.5 1/m, thick) hides walls
from the LiDAR, puts echoes before it, and hides the prism: the station looks through some metres of it.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from datasets import tbm
from datasets.lidar import Dust, lidar
from datasets.motion import Motion
from datasets.sensors import imu, magnetometer, odometer, prism
from datasets.simulate import Simulation, simulate, stream
from datasets.tbm_tunnel import LIDAR
from datasets.worlds import Mesh, roadway
from tbmfg.rig import Rig, override
from tbmfg.timeseries import Floats

LOW, HIGH = np.array([32.0, -2.0, tbm.START[2] - 0.1]), np.array([57.0, 3.0, tbm.START[2] + 3.9])
ROUGH_M = 0.04
DUSTY_M = 10.0  # of the station's line of sight
RISE_S = 2.0


def rig() -> Rig:
    """The rig of the drive with a LiDAR."""
    return override(tbm.rig(), [LIDAR])


def make(
    machine: Rig,
    *,
    seed: int,
    duration: float = 120.0,
    dust: float = 0.0,
    dust_begin: float = 0.35,
    dust_end: float = 0.75,
    vibration: float = 1.0,
    imu_rate_hz: float = 475.0,
    prism_rate_hz: float = 5.0,
    odometer_rate_hz: float = 20.0,
    magnetometer_rate_hz: float = 20.0,
    lidar_rate_hz: float = 10.0,
    columns: int = 1800,
    truth_rate_hz: float | None = None,
) -> Simulation:
    """The drive of tbm-drive in a roadway that a LiDAR sees, in clean air or in dust.

    ``dust`` is the extinction in 1/m, in the air between the shares ``dust_begin`` and ``dust_end`` of the log.
    """
    plan = tbm.Plan.over(duration)
    extinction, visibility = air(dust, dust_begin * duration, dust_end * duration)
    sensors = {
        "imu": partial(imu, rate_hz=imu_rate_hz),
        "prism": partial(prism, rate_hz=prism_rate_hz, visibility=visibility),
        "odometer": partial(odometer, rate_hz=odometer_rate_hz),
        "magnetometer": partial(magnetometer, rate_hz=magnetometer_rate_hz),
        "lidar": partial(lidar, world=world(seed), rate_hz=lidar_rate_hz, columns=columns, dust=extinction),
    }
    travel = tbm.path(plan, machine.sensors["odometer"].arm, 0.0, stream(seed, "slide"))
    motion = Motion(travel, tbm.shaking(plan, vibration, stream(seed, "vibration")) if vibration else ())
    return simulate(
        "tbm-roadway",
        motion,
        machine,
        sensors,
        seed=seed,
        duration_s=duration,
        truth_rate_hz=truth_rate_hz or imu_rate_hz,
    )


def air(dust: float, begin_s: float, end_s: float) -> tuple[Dust | None, Dust | None]:
    """Extinction 1/m of the air, ``dust`` between two times, and the share of fixes that come through it; None and None
    of clean air."""
    if not dust:
        return None, None

    def extinction(t_s: Floats) -> Floats:
        return dust * tbm.smooth_step((t_s - begin_s) / RISE_S) * tbm.smooth_step((end_s - t_s) / RISE_S)

    return extinction, lambda t_s: np.exp(-2 * extinction(t_s) * DUSTY_M)


def world(seed: int) -> Mesh:
    """The roadway; its roughness is drawn."""
    return roadway(LOW, HIGH, ROUGH_M, stream(seed, "roadway"))
