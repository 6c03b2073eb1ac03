"""The drive of ``tbm-dust`` begun with an unknown heading and the pump running: what inertial enhancement is for.

T-A of Liu, Wang & Tao (TBM-MSE). Without ``dust`` the prism is always seen.
"""

from __future__ import annotations

from datasets import tbm_roadway, tbm_scenes
from datasets.simulate import Simulation
from tbmfg.rig import Rig, override


def rig() -> Rig:
    """The rig of the dusty roadway with an unknown heading."""
    return override(tbm_scenes.rig(), ["initial.yaw_sd_deg=180"])


def make(
    machine: Rig, *, seed: int, duration: float = 180.0, dust: float = 0.2, vibration: float = 1.0,
    imu_rate_hz: float = 475.0, lidar_rate_hz: float = 10.0, columns: int = 1800,
) -> Simulation:  # fmt: skip
    """That machine, its heading unknown and its pump running from the beginning."""
    rates = {"imu_rate_hz": imu_rate_hz, "lidar_rate_hz": lidar_rate_hz, "columns": columns}
    air = tbm_roadway.air(dust, 0.35 * duration, 0.75 * duration)
    return tbm_scenes.scene(
        "tbm-ablation", machine, tbm_scenes.TURN, seed=seed, duration=duration, vibration=vibration, air=air,
        pump_first=True, **rates,
    )  # fmt: skip
