"""The rows that every benchmark makes: as a table, and as JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tbmfg.results import to_json


@dataclass(frozen=True, slots=True)
class Row:
    """One metric of one estimator in one scenario, over ``n`` runs or repetitions.

    ``mean`` and ``sd`` are over the n; ``bound`` is the interval (low, high) that ``mean`` should lie in, None for an
    open end, or None where nothing is asked; ``published`` is what the source of the method reports.
    """

    scenario: str
    estimator: str
    metric: str
    unit: str
    mean: float | None
    sd: float | None
    n: int
    bound: tuple[float | None, float | None] | None = None
    published: float | None = None

    @property
    def key(self) -> tuple[str, str, str]:
        """What makes the row unique among those of a run."""
        return self.scenario, self.estimator, self.metric

    @property
    def inside(self) -> bool | None:
        """Whether the mean lies in its bound; None without a bound. A mean that is missing does not."""
        if self.bound is None:
            return None
        low, high = self.bound
        return self.mean is not None and (low is None or low <= self.mean) and (high is None or self.mean <= high)


def to_text(rows: Iterable[Row]) -> str:
    """The rows as strict JSON."""
    return to_json([asdict(row) for row in rows])


def from_plain(rows: list[dict[str, Any]]) -> list[Row]:
    """Rows as they come from JSON."""
    return [Row(**row | {"bound": None if row["bound"] is None else tuple(row["bound"])}) for row in rows]


def read_rows(path: str | Path) -> list[Row]:
    """The rows of a file that ``--json`` wrote."""
    return from_plain(json.loads(Path(path).read_text("utf-8")))


# ---- tables ----


def print_tables(rows: list[Row]) -> None:
    """One table per scenario: a line per metric, a column per estimator; drawn by rich on a terminal only."""
    for scenario in dict.fromkeys(row.scenario for row in rows):
        header, lines = table_of([row for row in rows if row.scenario == scenario])
        if sys.stdout.isatty():
            _print_rich(scenario, header, lines)
        else:
            print(scenario, _aligned([header, *lines]), sep="\n", end="\n\n")
    judged = [row for row in rows if row.inside is not None]
    if judged:
        print(f"{sum(bool(row.inside) for row in judged)} of {len(judged)} means lie in their bounds")


def table_of(rows: list[Row]) -> tuple[list[str], list[list[str]]]:
    """Header and lines of one scenario. Estimators share a line where unit, number and bound agree; what is published
    stands in a line below."""
    estimators = list(dict.fromkeys(row.estimator for row in rows))
    cells: dict[tuple, dict[str, Row]] = {}
    for row in rows:
        cells.setdefault((row.metric, row.unit, row.n, row.bound), {})[row.estimator] = row
    lines = []
    for (metric, unit, n, bound), by_estimator in cells.items():
        lines.append([metric, unit, *(_cell(by_estimator.get(name)) for name in estimators), str(n), _bound(bound)])
        published = {name: row.published for name, row in by_estimator.items() if row.published is not None}
        if published:
            reported = (_number(published[name]) if name in published else "" for name in estimators)
            lines.append(["  published", unit, *reported, "", ""])
    return ["metric", "unit", *estimators, "n", "bound"], lines


def _cell(row: Row | None) -> str:
    """Mean and sd; an exclamation mark where the mean leaves its bound."""
    if row is None:
        return ""
    spread = "" if row.sd is None else f" ± {_number(row.sd)}"
    return f"{_number(row.mean)}{spread}{' !' if row.inside is False else ''}"


def _bound(bound: tuple[float | None, float | None] | None) -> str:
    if bound is None:
        return ""
    low, high = bound
    if low is None:
        return f"≤ {_number(high)}"
    return f"≥ {_number(low)}" if high is None else f"{_number(low)} – {_number(high)}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _aligned(lines: list[list[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def _print_rich(title: str, header: list[str], lines: list[list[str]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", header_style="bold", box=None, pad_edge=False)
    for column, name in enumerate(header):
        table.add_column(name, justify="right" if column > 1 else "left")
    for line in lines:
        table.add_row(*(f"[red]{cell}[/red]" if cell.endswith(" !") else cell for cell in line))
    Console(highlight=False).print(table)
