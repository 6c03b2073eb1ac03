"""The shearer there and back along a whole face, cut after cut: the panel's advance, for hours if need be.

At the beginning of every cut the conveyor has been pushed by ``web_m`` towards the coal over ``bend_m``, and the
machine follows it. It never turns round: it cuts the way back in reverse. Ten cuts of ``face_m=150`` take 25 minutes.
The same machine, sensors and priors as in shearer-cut. (Scenario H-L.)
"""

from __future__ import annotations

from datasets import shearer
from datasets.simulate import Simulation
from tbmfg.errors import TbmfgError
from tbmfg.rig import Rig

LEAD_M = 5.0  # straight at the end of the face, before the bend

rig = shearer.rig


def make(
    machine: Rig,
    *,
    seed: int,
    duration: float = 3600.0,
    face_m: float = 150.0,
    web_m: float = 0.8,
    bend_m: float = 20.0,
    conditions: shearer.Conditions = shearer.NOMINAL,
) -> Simulation:
    """The shearer there and back along a whole face, cut after cut."""
    if not 0 < bend_m <= face_m - LEAD_M:
        raise TbmfgError(f"shearer-panel: a bend of {bend_m:g} m on a face of {face_m:g} m; it begins at {LEAD_M:g} m")
    face = shearer.Face(shift_m=web_m, lead_m=LEAD_M, bend_m=bend_m, length_m=face_m)
    return shearer.haul("shearer-panel", machine, face, seed=seed, duration=duration, conditions=conditions)
