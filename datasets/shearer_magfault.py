"""The shearer's cut with the magnetic field disturbed from 10 to 30 s; else the same log as shearer-cut.

- ``fault=offset``: its direction turns by 20 degrees within a second, and back in the last second
- ``fault=field``: a field of the machine grows to a draw of 10 to 30 uT and vanishes again, turning slowly
- ``fault=spikes``: one in five samples has a field of 10 to 30 uT in any direction added

``drawn["magnetometer"]`` tells what was done: ``fault_s`` (start, end), ``fault_yaw_deg`` (n,) the turn of the
horizontal field at every sample, counter-clockwise, and ``spikes`` (k,), indices of samples. (Scenario H-M.)
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from datasets import shearer
from datasets.motion import rotate
from datasets.simulate import Simulation, stream
from tbmfg.errors import TbmfgError
from tbmfg.rig import Rig
from tbmfg.timeseries import Floats

START_S, END_S = 10.0, 30.0
OFFSET_DEG, OFFSET_RAMP_S = 20.0, 1.0
FIELD_UT = 10.0, 30.0
SPIKED = 0.2  # share of the samples

rig = shearer.rig


def make(
    machine: Rig,
    *,
    seed: int,
    duration: float = 85.0,
    fault: str = "offset",
    conditions: shearer.Conditions = shearer.NOMINAL,
) -> Simulation:
    """The shearer's cut with a magnetic fault from 10 to 30 s: offset, field or spikes."""
    if fault not in FAULTS:
        raise TbmfgError(f"shearer-magfault: fault={fault}; there are {', '.join(FAULTS)}")
    disturb = partial(disturbed, fault, stream(seed, "fault"))
    return shearer.haul(
        "shearer-magfault", machine, shearer.CUT, seed=seed, duration=duration, conditions=conditions, disturb=disturb
    )


def disturbed(
    fault: str, rng: np.random.Generator, t_s: Floats, R_nb: Floats, field_n: Floats
) -> tuple[Floats, dict[str, Any]]:
    """What a fault adds to the field, in n, and what of it is told."""
    added_n = FAULTS[fault](rng, t_s, R_nb, field_n)
    total = field_n + added_n
    turn = np.arctan2(total[:, 1], total[:, 0]) - np.arctan2(field_n[1], field_n[0])
    spikes = np.flatnonzero(added_n.any(axis=1)) if fault == "spikes" else np.zeros(0, dtype=int)
    turn_deg = (np.degrees(turn) + 180.0) % 360.0 - 180.0
    return added_n, {"fault_s": (START_S, END_S), "fault_yaw_deg": turn_deg, "spikes": spikes}


def offset(rng: np.random.Generator, t_s: Floats, R_nb: Floats, field_n: Floats) -> Floats:
    """The horizontal field turns by 20 degrees, ramped."""
    share = np.clip(np.minimum(t_s - START_S, END_S - t_s) / OFFSET_RAMP_S, 0.0, 1.0)
    angle = np.radians(OFFSET_DEG) * share
    x, y, _ = field_n
    turned = np.column_stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)])
    return np.pad(turned - field_n[:2], ((0, 0), (0, 1)))


def field(rng: np.random.Generator, t_s: Floats, R_nb: Floats, field_n: Floats) -> Floats:
    """A field of the machine: within 30 degrees of its floor plane, it turns by up to 90 degrees while it is there."""
    u_size, u_azimuth, u_elevation, u_turn = rng.random(4)
    x = np.clip((t_s - START_S) / (END_S - START_S), 0.0, 1.0)
    size = (FIELD_UT[0] + (FIELD_UT[1] - FIELD_UT[0]) * u_size) * 1e-6 * np.sin(np.pi * x) ** 2
    azimuth = 2 * np.pi * u_azimuth + np.pi * (u_turn - 0.5) * x
    elevation = np.pi / 6 * (2 * u_elevation - 1)
    flat = np.cos(elevation)
    direction_b = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.full(len(x), np.sin(elevation))])
    return rotate(R_nb, size[:, None] * direction_b)


def spikes(rng: np.random.Generator, t_s: Floats, R_nb: Floats, field_n: Floats) -> Floats:
    """Single samples far off."""
    hit, size, *direction = np.hstack([rng.random((len(t_s), 2)), rng.standard_normal((len(t_s), 3))]).T
    inside = (t_s >= START_S) & (t_s <= END_S) & (hit < SPIKED)
    size = (FIELD_UT[0] + (FIELD_UT[1] - FIELD_UT[0]) * size) * 1e-6 * inside
    unit = np.stack(direction, axis=1)
    return (size / np.linalg.norm(unit, axis=1))[:, None] * unit


FAULTS = {"offset": offset, "field": field, "spikes": spikes}
