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
    machine: Rig,
    *,
    seed: int,
    duration: float = 180.0,
    dust: float = 0.2,
    setup: tbm_scenes.Setup = tbm_scenes.SETUP,
) -> Simulation:
    """That machine, its heading unknown and its pump running from the beginning."""
    air = tbm_roadway.air(dust, 0.35 * duration, 0.75 * duration)
    moves = tbm_scenes.TURN
    return tbm_scenes.scene(
        "tbm-ablation", machine, moves, seed=seed, duration=duration, setup=setup, air=air, pump_first=True
    )
