"""Logs with known truth: simulated (``python -m datasets make NAME -o FILE``) or public recordings
(``python -m datasets import NAME SRC -o FILE``); ``python -m datasets list`` names them.

Shared with tbmfg: time series, the rig and the writing of MCAP. Not shared by the simulators, so that a wrong sign on
one side is seen: rotations, gravity and Earth rate, integration, sensor models. They import none of ``tbmfg.geometry``,
``tbmfg.earth``, ``tbmfg.inertial`` and ``tbmfg.sensors``; recordings take the ellipsoid from ``tbmfg.earth``.

- ``motion``    truth as a function of time, with exact derivatives
- ``simulate``  the place on Earth, means over sampling periods, the rig whose priors everything is drawn from
- ``sensors``   ideal sensors on a motion, and their noise
- ``tbm``       a machine: how it moves, how it shakes, what it carries; ``tbm_static``: the same standing still
- ``recordings``  what was really measured, from the npz it is packaged in
"""

from __future__ import annotations

import importlib
import inspect
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tbmfg.errors import TbmfgError
from tbmfg.rig import Rig, override

if TYPE_CHECKING:
    from datasets.recordings import Recording
    from datasets.simulate import Simulation

# Each module has ``rig()``, the rig whose priors it draws from, and ``make(rig, *, seed, duration, **options)``.
MACHINES = {
    "tbm-drive": "datasets.tbm",
    "tbm-static": "datasets.tbm_static",
}

# Each module has ``load(source, **options)``.
RECORDINGS = {
    "euroc": "datasets.recordings.euroc",
    "rtk-drive": "datasets.recordings.rtk_drive",
    "husky": "datasets.recordings.husky",
    "comma": "datasets.recordings.comma",
    "broad": "datasets.recordings.broad",
    "phone": "datasets.recordings.phone",
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
    module = module_of(name)
    _refuse_unknown(name, options)
    return module.make(override(rig or module.rig(), settings), seed=seed, duration=duration, **options)


def load(name: str, source: str | Path, *, settings: tuple[str, ...] = (), **options: Any) -> Recording:
    """The recording ``name`` from its npz, or the folder that holds it; ``settings`` change values of its rig."""
    if name not in RECORDINGS:
        raise TbmfgError(f"{name}: no such recording; there are {', '.join(RECORDINGS)}")
    _refuse_unknown(name, options)
    recording = module_of(name).load(source, **options)
    return replace(recording, rig=override(recording.rig, settings))


def _refuse_unknown(name: str, options: dict[str, Any]) -> None:
    if unknown := sorted(set(options) - set(defaults(name))):
        known = ", ".join(defaults(name)) or "none"
        raise TbmfgError(f"{name}: no option {', '.join(unknown)}; there are {known}")


def defaults(name: str) -> dict[str, Any]:
    """The options of one dataset and their defaults."""
    function = module_of(name).load if name in RECORDINGS else module_of(name).make
    parameters = inspect.signature(function).parameters.values()
    return {parameter.name: parameter.default for parameter in parameters if parameter.default is not parameter.empty}


def module_of(name: str) -> Any:
    """The module of a simulated or recorded dataset."""
    return importlib.import_module({**MACHINES, **RECORDINGS}[name])
