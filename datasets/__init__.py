"""Logs with known truth: simulated (``python -m datasets make NAME -o FILE``) or public recordings
(``python -m datasets import NAME SRC -o FILE``); ``python -m datasets list`` names them.

Shared with tbmfg: time series, the rig and the writing of MCAP. Not shared by the simulators, so that a wrong sign on
one side is seen: rotations, gravity and Earth rate, integration, sensor models. They import none of ``tbmfg.geometry``,
``tbmfg.earth``, ``tbmfg.inertial`` and ``tbmfg.sensors``; recordings take the ellipsoid from ``tbmfg.earth``.

- ``motion``    truth as a function of time, with exact derivatives
- ``simulate``  the place on Earth, means over sampling periods, the rig whose priors everything is drawn from
- ``sensors``   ideal sensors on a motion, and their noise
- ``tbm``       a machine: how it moves, how it shakes, what it carries; ``tbm_static``: the same standing still
- ``shearer``   another; ``shearer_magfault``: the same beside steel; ``shearer_panel``: along the face and back
- ``shaft``     a shaft boring machine, standing, cutting, turning, sinking; ``cage``: its unit on a cage in the shaft
- ``worlds``, ``lidar``  places underground, and how a LiDAR sees them: ``tbm_tunnel``, ``tbm_roadway``;
  ``tbm_scenes``, ``tbm_ablation``: the experiments of a paper there
- ``faults``    what goes wrong, done to a log on purpose: ``python -m datasets corrupt LOG -o FILE --fault KIND``
- ``recordings``  what was really measured, from the npz it is packaged in
"""

from __future__ import annotations

import importlib
import inspect
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tbmfg.errors import TbmfgError
from tbmfg.rig import Rig, override

if TYPE_CHECKING:
    from datasets.recordings import Recording
    from datasets.simulate import Simulation

# Each is a function ``make(rig, *, seed, duration, ...)`` whose default duration is the dataset's own length, in a
# module that has ``rig()``, the rig whose priors it draws from. Its other parameters are its options. Those that
# several datasets share are the fields of a dataclass, and a parameter whose default is one stands for all of them.
MACHINES = {
    "tbm-drive": "datasets.tbm:make",
    "tbm-static": "datasets.tbm_static:make",
    "shaft-static": "datasets.shaft:static",
    "shaft-low": "datasets.shaft:low",
    "shaft-high": "datasets.shaft:high",
    "shaft-dynamic": "datasets.shaft:dynamic",
    "shaft-descend": "datasets.shaft:descend",
    "cage-fast": "datasets.cage:fast",
    "cage-slow": "datasets.cage:slow",
    "tbm-tunnel": "datasets.tbm_tunnel:make",
    "tbm-roadway": "datasets.tbm_roadway:make",
    "tbm-clean": "datasets.tbm_scenes:clean",
    "tbm-dust": "datasets.tbm_scenes:dust",
    "tbm-ablation": "datasets.tbm_ablation:make",
    "shearer-cut": "datasets.shearer:make",
    "shearer-magfault": "datasets.shearer_magfault:make",
    "shearer-panel": "datasets.shearer_panel:make",
}

# Each module has ``load(source, **options)``.
RECORDINGS = {
    "euroc": "datasets.recordings.euroc",
    "rtk-drive": "datasets.recordings.rtk_drive",
    "husky": "datasets.recordings.husky",
    "comma": "datasets.recordings.comma",
    "broad": "datasets.recordings.broad",
    "phone": "datasets.recordings.phone",
    "kitti-lidar": "datasets.recordings.kitti_lidar",
    "balm-lidar": "datasets.recordings.balm_lidar",
}


def make(
    name: str,
    *,
    seed: int = 0,
    duration: float | None = None,
    rig: Rig | None = None,
    settings: tuple[str, ...] = (),
    **options: Any,
) -> Simulation:
    """Simulate ``name`` for ``duration`` s, or for its own length.

    ``rig`` replaces the machine's own, ``settings`` (``sensors.prism.sigma_mm=2``) change single values of it.
    """
    if name not in MACHINES:
        raise TbmfgError(f"{name}: no such dataset; there are {', '.join(MACHINES)}")
    duration = own_duration(name) if duration is None else duration
    if not duration > 0:
        raise TbmfgError(f"{name}: a duration of {duration:g} s; it should be above 0")
    _refuse_unknown(name, options)
    machine = override(rig or _module(MACHINES[name]).rig(), settings)
    return function(name)(machine, seed=seed, duration=duration, **_grouped(name, options))


def load(name: str, source: str | Path, *, settings: tuple[str, ...] = (), **options: Any) -> Recording:
    """The recording ``name`` from its npz, or the folder that holds it; ``settings`` change values of its rig."""
    if name not in RECORDINGS:
        raise TbmfgError(f"{name}: no such recording; there are {', '.join(RECORDINGS)}")
    _refuse_unknown(name, options)
    recording = function(name)(source, **_grouped(name, options))
    return replace(recording, rig=override(recording.rig, settings))


def _refuse_unknown(name: str, options: dict[str, Any]) -> None:
    if unknown := sorted(set(options) - set(defaults(name))):
        known = ", ".join(defaults(name)) or "none"
        raise TbmfgError(f"{name}: no option {', '.join(unknown)}; there are {known}")


def defaults(name: str) -> dict[str, Any]:
    """The options of one dataset and their defaults."""
    found: dict[str, Any] = {}
    for key, value in _given(name).items():
        found |= asdict(value) if is_dataclass(value) else {key: value}
    return found


def _grouped(name: str, options: dict[str, Any]) -> dict[str, Any]:
    """``options`` as the function takes them: those of a dataclass as one."""
    taken = dict(options)
    for key, group in _given(name).items():
        if is_dataclass(group):
            taken[key] = replace(group, **{f.name: taken.pop(f.name) for f in fields(group) if f.name in taken})
    return taken


def _given(name: str) -> dict[str, Any]:
    """The parameters that have a default, but for the duration."""
    given = {parameter.name: parameter.default for parameter in _parameters(name)}
    return {key: value for key, value in given.items() if value is not inspect.Parameter.empty and key != "duration"}


def own_duration(name: str) -> float:
    """How long a simulated dataset is where nothing else is asked, s."""
    return next(parameter.default for parameter in _parameters(name) if parameter.name == "duration")


def summary(name: str) -> str:
    """What a dataset is, in one line."""
    told = function(name) if name in MACHINES else _module(RECORDINGS[name])
    return (told.__doc__ or "").partition("\n")[0]


def function(name: str) -> Any:
    """What makes or loads a dataset."""
    place = MACHINES.get(name) or f"{RECORDINGS[name]}:load"
    return getattr(_module(place), place.partition(":")[2])


def _module(place: str) -> Any:
    return importlib.import_module(place.partition(":")[0])


def _parameters(name: str) -> list[inspect.Parameter]:
    return list(inspect.signature(function(name)).parameters.values())
