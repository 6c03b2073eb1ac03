"""TBM-MSE itself, its ablation and LINS: the filter of :mod:`tbmfg.filters.tbm` with scans laid on a map.

Liu, Wang & Tao (TBM-MSE), sections 2 to 5. ``tbm-mse`` is given what their inertial enhancement makes of the samples,
by the rig's settings or else by the defaults; ``tbm-mse-star`` and ``tbm-lins`` the samples as recorded, without
coning and sculling. ``tbm-lins`` has no total station; the paper says no more of it, so all else is the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from tbmfg.filters import tbm
from tbmfg.filters.scanmap import OnMap, ScanMap
from tbmfg.filters.tbm import Filtered, InsTs
from tbmfg.inertial import enhancement
from tbmfg.inertial.steps import compensate
from tbmfg.inertial.strapdown import BA_, BG_
from tbmfg.problem import Inertial, Problem
from tbmfg.rig import Enhancement


class Mse(OnMap, InsTs):
    """Switches of ``tbm-mse`` and ``tbm-mse-star``."""


class Lins(OnMap):
    """Switches of ``tbm-lins``."""


@dataclass(frozen=True, slots=True)
class Design:
    """Kinds of sensors whose fixes are taken, whether the samples are enhanced, and the model of the switches."""

    kinds: tuple[str, ...]
    enhanced: bool
    switches: type[OnMap]


DESIGNS = {
    "tbm-mse": Design(("prism",), True, Mse),
    "tbm-mse-star": Design(("prism",), False, Mse),
    "tbm-lins": Design((), False, Lins),
}


@dataclass(frozen=True, slots=True)
class Run:
    """The filter's output, the problem as it saw it, what became of the scans, and what is to be said."""

    filtered: Filtered
    seen: Problem
    scans: ScanMap
    warnings: list[str]


def run(problem: Problem, design: Design, switches: Mse | Lins, progress: Callable[[float], None] | None = None) -> Run:
    """Filter a problem that has scans, those of its first LiDAR."""
    inertial, warnings = (enhanced if design.enhanced else plain)(problem)
    coupled = switches if isinstance(switches, InsTs) else InsTs()
    seen = tbm.view(replace(problem, inertial=inertial), coupled, design.kinds)
    name, source = next(iter(problem.scans.items()))
    scans = ScanMap(name, source, inertial, switches)
    filtered = tbm.run(seen, coupled, progress, scans)
    return Run(filtered, seen, scans, [*warnings, *(f"{name}: {line}" for line in _of_scans(scans))])


def plain(problem: Problem) -> tuple[Inertial, list[str]]:
    """The samples as recorded; nothing to say."""
    steps = problem.measured
    return replace(problem.inertial, steps=steps, gyro=steps.gyro, acc=steps.acc), []


def enhanced(problem: Problem) -> tuple[Inertial, list[str]]:
    """The samples enhanced, unless the rig has them so for all, and what was done to them."""
    inertial, prior, steps = problem.inertial, problem.prior.x, problem.measured
    if problem.rig.imu.enhancement is not None:
        return inertial, []
    wanted = Enhancement()
    steps, changed = enhancement.denoise(steps, wanted.emd_threshold, wanted.window, wanted.give_back)
    gyro, acc = compensate(steps, prior[BG_], prior[BA_])
    steps, gyro, levelled = enhancement.level(
        steps, gyro, acc, prior[:9].reshape(3, 3), prior[BG_], inertial.earth_n, -inertial.gravity_n[2], wanted
    )
    return replace(inertial, steps=steps, gyro=gyro, acc=acc), [str(changed), str(levelled)]


def _of_scans(scans: ScanMap) -> list[str]:
    """What became of the scans, where it is not as usual."""
    count, lines = len(scans.scans), []
    if scans.few:
        lines.append(f"{scans.few} of {count} scans hold too few points to be laid on the map")
    if scans.unheld:
        anew = scans.begun - 1 - scans.given_up
        lines.append(
            f"{scans.unheld} of {count} scans find no hold on the map: the other sensors alone go on there"
            + (f", and {anew} times the map was begun anew" if anew > 0 else "")
        )
    if scans.given_up:
        lines.append(
            f"the map was given up {scans.given_up} times, after {tbm.REOPEN} fixes of the prism in a row "
            "contradicted it"
        )
    return lines
