"""The experiments of the papers whose filters tbmfg has: their numbers, ours, and the smoother on the same logs.

Every seed is a new draw of all noises, of all calibrations and of the initial state. ``published`` is the paper's value
of the same quantity. Its metres were measured on other data and can be compared in order of magnitude alone; ratios
between methods on the same data can be compared.

Comparisons between methods are paired: the difference is taken seed by seed, and ``.. low`` and ``.. high`` are the
ends of its 95 % confidence interval.

A paper is a module with

- ``measure(plan)``   rows of its experiments; :class:`Plan` says how many logs and how long
"""

from __future__ import annotations

import argparse
import importlib
from dataclasses import dataclass

from benchmarks.rows import Row
from tbmfg.errors import TbmfgError

PAPERS = {
    "shearer": "benchmarks.papers.shearer",
    "sbm": "benchmarks.papers.sbm",
    "tbm": "benchmarks.papers.tbm",
}


@dataclass(frozen=True, slots=True)
class Plan:
    """``seeds`` of the logs, their duration in s or None for each dataset's own, and ``jobs``, how many processes."""

    seeds: range
    duration_s: float | None
    jobs: int


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--paper", action="append", choices=list(PAPERS), help=f"repeatable; all unless named ({', '.join(PAPERS)})"
    )
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="how many logs of each experiment (20)")
    parser.add_argument("--first-seed", type=int, default=0, metavar="N")
    parser.add_argument("--duration", type=float, metavar="S", help="of each log (the experiment's own)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows of the papers asked for."""
    if min(given.seeds, given.jobs) < 1:
        raise TbmfgError(f"--seeds {given.seeds} --jobs {given.jobs}: each should be 1 or more")
    plan = Plan(range(given.first_seed, given.first_seed + given.seeds), given.duration, given.jobs)
    modules = [importlib.import_module(PAPERS[name]) for name in given.paper or PAPERS]
    return [row for module in modules for row in module.measure(plan)]
