"""What a comparison shows of each trajectory, on the terminal and in the report."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

Summaries = dict[str, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Column:
    """One figure of a comparison: its title with the unit, the key of the metrics, and the factor to that unit."""

    title: str
    key: str
    factor: float = 1.0

    def of(self, metrics: dict[str, Any]) -> float | None:
        """The figure in the title's unit, None where there is none."""
        value = metrics.get(self.key)
        return None if value is None else value * self.factor


COLUMNS = (
    Column("APE mm", "ape_rms_m", 1e3),
    Column("position mm", "position_rms_m", 1e3),
    Column("outage mm", "outage_position_rms_m", 1e3),
    Column("attitude deg", "attitude_rms_deg"),
    Column("yaw deg", "yaw_rms_deg"),
    Column("velocity mm/s", "velocity_rms_mps", 1e3),
    Column("position / bound", "position_over_bound"),
    Column("attitude / bound", "attitude_over_bound"),
    Column("NEES", "nees_mean"),
)


@dataclass(frozen=True, slots=True)
class Row:
    """One trajectory: an online solver has a causal one and its last estimates."""

    label: str
    estimator: str
    smoothed: bool
    metrics: dict[str, Any]
    own_s: float


def told(entry: dict[str, Any] | None) -> list[str]:
    """Whether the log told a calibration beyond its prior, number by number: yes, no, or - where that is not asked."""
    observed = (entry or {}).get("observed")
    parts = observed if isinstance(observed, list | tuple) else [observed]
    return [{True: "yes", False: "no", None: "-"}[part] for part in parts]


def ran(summaries: Summaries) -> Summaries:
    """The estimators that gave a result."""
    return {name: summary for name, summary in summaries.items() if "not_run" not in summary}


def not_run(summaries: Summaries) -> dict[str, str]:
    """Why each of the others did not."""
    return {name: summary["not_run"] for name, summary in summaries.items() if "not_run" in summary}


def rows(summaries: Summaries) -> list[Row]:
    """One row per trajectory, in the order of the estimators; ``own_s`` leaves out what they share."""
    found = []
    for name, summary in ran(summaries).items():
        own_s = summary["wall_s"] - summary["shared_s"]
        smoothed = summary.get("metrics_smoothed")
        found.append(Row(f"{name} (causal)" if smoothed else name, name, False, summary["metrics"] or {}, own_s))
        if smoothed:
            found.append(Row(f"{name} (last)", name, True, smoothed, own_s))
    return found


def columns(found: list[Row]) -> list[Column]:
    """The columns that any of the rows fills."""
    return [column for column in COLUMNS if any(column.of(row.metrics) is not None for row in found)]


def together(lines: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Lines, each once, and the names of those that say it, from (name, line)."""
    by_line: dict[str, list[str]] = {}
    for name, line in lines:
        by_line.setdefault(line, []).append(name)
    return by_line
