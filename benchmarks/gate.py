"""A committed baseline of machine-independent metrics, and whether a new run holds it.

The file maps a benchmark's name to ``options`` (those of its run) and ``rows``. A run is repeated with the same
options, so the same seeds: what differs is the program.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.rows import Row, from_plain
from tbmfg.errors import TbmfgError
from tbmfg.results import to_json

BASELINE = Path(__file__).with_name("baseline.json")


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far a mean may move from the baseline's: ``relative`` x baseline + ``absolute``; ``one_sided``: only up."""

    relative: float
    absolute: float = 0.0
    one_sided: bool = False

    def holds(self, value: float, baseline: float) -> bool:
        moved = value - baseline if self.one_sided else abs(value - baseline)
        return moved <= self.relative * abs(baseline) + self.absolute


def load(path: Path, benchmark: str) -> tuple[dict[str, Any], list[Row]]:
    """Options and rows of one benchmark's baseline."""
    if not path.is_file():
        raise TbmfgError(f"{path}: no such baseline; make it with --update-baseline")
    entries = json.loads(path.read_text("utf-8"))
    if benchmark not in entries:
        raise TbmfgError(f"{path}: holds no {benchmark}, only {', '.join(entries)}; add it with --update-baseline")
    return entries[benchmark]["options"], from_plain(entries[benchmark]["rows"])


def save(path: Path, benchmark: str, options: dict[str, Any], rows: list[Row]) -> None:
    """Replace one benchmark's baseline and leave the others."""
    entries = json.loads(path.read_text("utf-8")) if path.is_file() else {}
    entries[benchmark] = {"options": options, "rows": [asdict(row) for row in rows]}
    path.write_text(to_json(entries), "utf-8")


def compare(rows: list[Row], baseline: list[Row], tolerance: Callable[[Row], Tolerance | None]) -> list[str]:
    """One line per row of the baseline that the new rows do not hold; a row that has gone is not held."""
    new = {row.key: row for row in rows}
    faults = []
    for old in baseline:
        allowed = tolerance(old)
        if allowed is None or old.mean is None:
            continue
        name = " ".join(old.key)
        row = new.get(old.key)
        if row is None or row.mean is None:
            faults.append(f"{name}: missing; the baseline has {old.mean:.4g}")
        elif not allowed.holds(row.mean, old.mean):
            moved = f"{row.mean:.4g} against {old.mean:.4g}"
            side = "+" if allowed.one_sided else "±"
            faults.append(
                f"{name}: {moved} {old.unit}, allowed {side}{allowed.relative:.0%} {side}{allowed.absolute:g}"
            )
    return faults
