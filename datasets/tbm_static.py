"""The roadheader of ``tbm`` standing still, its heading unknown: north is to be found by the gyro alone.

Fibre-optic gyro and prism, no odometer and no magnetometer. The pump is off, or on for the whole log and shakes the
body as it does in ``tbm-drive``; all other draws are the same.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from datasets import tbm
from datasets.motion import Motion
from datasets.sensors import imu, prism
from datasets.simulate import Simulation, simulate, stream
from tbmfg.rig import Rig, override

SENSORS = ("imu", "prism")
CONTACT_B = np.array([-0.4, 0.0, -1.1])  # what it stands on


def rig() -> Rig:
    """The rig of the drive with an unknown heading and without what would tell it."""
    machine = override(tbm.rig(), ["initial.yaw_sd_deg=180", "sensors.imu.noise_factor=1"])
    kept = {name: sensor for name, sensor in machine.sensors.items() if name in SENSORS}
    return machine.model_copy(update={"sensors": kept})


def make(
    machine: Rig,
    *,
    seed: int,
    duration: float = 120.0,
    pump: float = 0.0,
    imu_rate_hz: float = 475.0,
    prism_rate_hz: float = 5.0,
) -> Simulation:
    """The same roadheader standing still, its heading unknown; ``pump`` multiplies the amplitudes of the oil pump."""
    plan = tbm.Plan.standing(duration)
    travel = tbm.path(plan, CONTACT_B, 0.0, stream(seed, "slide"))
    running = replace(plan, pump=np.ones(len(plan.t_s)))
    shaking = tbm.shaking(running, pump, stream(seed, "vibration"))[:1] if pump else ()
    return simulate(
        "tbm-static",
        Motion(travel, shaking),
        machine,
        {"imu": partial(imu, rate_hz=imu_rate_hz), "prism": partial(prism, rate_hz=prism_rate_hz, gaps=0)},
        seed=seed,
        duration_s=duration,
        truth_rate_hz=imu_rate_hz,
    )
