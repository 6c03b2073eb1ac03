"""Simulated experiments with known truth: ``python -m datasets list`` and ``python -m datasets make NAME -o FILE``.

Shared with tbmfg: time series, the rig and the writing of MCAP. Not shared, so that a wrong sign on one side is
seen: rotations, gravity and Earth rate, integration, sensor models. Nothing here imports ``tbmfg.geometry``,
``tbmfg.earth``, ``tbmfg.inertial`` or ``tbmfg.sensors``.

- ``motion``    truth as a function of time, with exact derivatives
- ``simulate``  the place on Earth, means over sampling periods, the rig whose priors everything is drawn from
- ``sensors``   ideal sensors on a motion, and their noise
- ``tbm``       a machine: how it moves, how it shakes, what it carries
"""

from __future__ import annotations

import importlib
import inspect
from typing import TYPE_CHECKING, Any

from tbmfg.errors import TbmfgError
from tbmfg.rig import Rig, override

if TYPE_CHECKING:
    from datasets.simulate import Simulation

# Each module has ``rig()``, the rig whose priors it draws from, and ``make(rig, *, seed, duration, **options)``.
MACHINES = {
    "tbm-drive": "datasets.tbm",
}


def make(
    name: str,
    *,
    seed: int = 0,
    duration: float = 120.0,
    rig: Rig | None = None,
    settings: tuple[str, ...] = (),
    **options: Any,
) -> Simulation:
    """Simulate ``name`` for ``duration`` s.

    ``rig`` replaces the machine's own, ``settings`` (``sensors.prism.sigma_mm=2``) change single values of it.
    """
    if name not in MACHINES:
        raise TbmfgError(f"{name}: no such dataset; there are {', '.join(MACHINES)}")
    if duration <= 0:
        raise TbmfgError(f"{name}: a duration of {duration:g} s; it should be above 0")
    module = importlib.import_module(MACHINES[name])
    unknown = sorted(set(options) - set(defaults(name)))
    if unknown:
        raise TbmfgError(f"{name}: no option {', '.join(unknown)}; there are {', '.join(defaults(name))}")
    return module.make(override(rig or module.rig(), settings), seed=seed, duration=duration, **options)


def defaults(name: str) -> dict[str, Any]:
    """The options of one dataset and their defaults."""
    parameters = inspect.signature(importlib.import_module(MACHINES[name]).make).parameters.values()
    return {parameter.name: parameter.default for parameter in parameters if parameter.default is not parameter.empty}
