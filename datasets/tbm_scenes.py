"""The experiments of Liu, Wang & Tao (TBM-MSE) in the roadway of ``tbm_roadway``: T-C in clean air, T-D in dust.

The machine has what theirs had: inertial unit, total station and LiDAR. It starts as in ``tbm-drive`` and drives at 0.1
m/s; their trajectory is not published but for its length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from datasets import tbm, tbm_roadway
from datasets.lidar import lidar
from datasets.motion import Motion
from datasets.sensors import imu, prism
from datasets.simulate import Simulation, simulate, stream
from datasets.tbm_static import CONTACT_B
from tbmfg.rig import Rig

SENSORS = ("imu", "prism", "lidar")
STRAIGHT = ((48.5, 4.70, 0.0), (6.0, 0.0, 0.0))  # forward, and the same way back
TURN = ((36.5, 3.5, 0.0), (31.5, 1.5, 60.0), (10.0, 0.0, 30.0), (4.0, 0.0, 0.0))  # forward and to the left, and back


def rig() -> Rig:
    """The rig of the roadway without odometer and magnetometer."""
    machine = tbm_roadway.rig()
    return machine.model_copy(update={"sensors": {name: machine.sensors[name] for name in SENSORS}})


@dataclass(frozen=True, slots=True)
class Setup:
    """How the machine shakes and how often its sensors measure; ``columns`` of 16 points in a scan."""

    vibration: float = 1.0
    imu_rate_hz: float = 475.0
    lidar_rate_hz: float = 10.0
    columns: int = 1800


SETUP = Setup()


def clean(machine: Rig, *, seed: int, duration: float = 125.0, setup: Setup = SETUP) -> Simulation:
    """The roadheader with LiDAR and total station, 4.7 m forward and back in clean air."""
    return scene("tbm-clean", machine, STRAIGHT, seed=seed, duration=duration, setup=setup)


def dust(
    machine: Rig,
    *,
    seed: int,
    duration: float = 180.0,
    dust: float = 0.2,
    dust_begin: float = 0.35,
    dust_end: float = 0.75,
    setup: Setup = SETUP,
) -> Simulation:
    """The same machine forward, to the left and back, in dust that hides walls and prism."""
    air = tbm_roadway.air(dust, dust_begin * duration, dust_end * duration)
    return scene("tbm-dust", machine, TURN, seed=seed, duration=duration, setup=setup, air=air)


def scene(
    name: str,
    machine: Rig,
    moves: tuple[tuple[float, float, float], ...],
    *,
    seed: int,
    duration: float,
    setup: Setup,
    air: tuple = (None, None),
    pump_first: bool = False,
) -> Simulation:
    """The machine over ``moves`` in ``air`` (of :func:`tbm_roadway.air`); with ``pump_first`` the pump runs from the
    beginning."""
    extinction, visibility = air
    plan = tbm.Plan.over(duration, moves)
    plan = replace(plan, pump=np.ones(len(plan.t_s))) if pump_first else plan
    travel = tbm.path(plan, CONTACT_B, 0.0, stream(seed, "slide"))
    world = tbm_roadway.world(seed)
    sensors = {
        "imu": partial(imu, rate_hz=setup.imu_rate_hz),
        "prism": partial(prism, rate_hz=5.0, visibility=visibility),
        "lidar": partial(lidar, world=world, rate_hz=setup.lidar_rate_hz, columns=setup.columns, dust=extinction),
    }
    shaking = tbm.shaking(plan, setup.vibration, stream(seed, "vibration")) if setup.vibration else ()
    return simulate(
        name, Motion(travel, shaking), machine, sensors, seed=seed, duration_s=duration, truth_rate_hz=setup.imu_rate_hz
    )
