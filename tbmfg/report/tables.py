"""The tables of a report, as HTML; every text that comes from a log or a rig is escaped here."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from math import floor, log10
from typing import Any

from tbmfg.comparison import columns, ran, rows, told
from tbmfg.report.content import Report
from tbmfg.report.panels import Pen
from tbmfg.report.words import nees_bounds

NORMAL, STATES = "normal", 20  # the level that needs no words, and how many of the others are listed
PARTS = ("used", "gated", "late", "duplicate", "nonfinite", "outage", "unused")


def table(header: Sequence[str], body: Sequence[Sequence[str]], kind: str = "") -> str:
    """A table of cells that are HTML already; ``kind`` is a class of its style."""
    if not body:
        return ""
    head = "".join(f"<th scope=col>{cell}</th>" for cell in header)
    lines = "".join(
        f"<tr><th scope=row>{first}</th>{''.join(f'<td>{cell}</td>' for cell in others)}</tr>"
        for first, *others in body
    )
    rows_html = f"<thead><tr>{head}</tr></thead><tbody>{lines}</tbody>"
    return f"<div class=wide><table class='{kind}'>{rows_html}</table></div>"


def comparison(report: Report, pen: dict[str, Pen]) -> str:
    """A row for each trajectory: accuracy with the ratio to the best, consistency with its bounds, time."""
    found = rows(report.summaries)
    shown = columns(found)
    body = []
    for row in found:
        cells = []
        for column in shown:
            value = column.of(row.metrics)
            if value is None:
                cells.append("–")
            elif column.key == "nees_mean":
                bounds = nees_bounds(row.metrics)
                cells.append(f"{value:.3g}" + (f" <small>{bounds[0]:.2g} to {bounds[1]:.2g}</small>" if bounds else ""))
            elif column.key.endswith("_over_bound"):
                cells.append(f"{value:.3g}")
            else:
                best = min(v for other in found if (v := column.of(other.metrics)) is not None)
                ratio = f" <small>× {value / best:.3g}</small>" if 0 < best < value else " <small>best</small>"
                cells.append(f"{value:.3g}" + (ratio if len(found) > 1 else ""))
        body.append([swatch(pen.get(row.label), row.label), *cells, f"{row.own_s:.2f}"])
    header = ["estimator", *(escape(column.title) for column in shown), "own time s"]
    first = next(iter(ran(report.summaries).values()))
    notes = [f"Reading and preparing, once for all: {first['shared_s']:.2f} s."]
    if first["metrics"] is not None:
        notes.append(
            "APE is taken after a rigid alignment to the truth, everything else without. NEES is the mean squared "
            f"normalised error of the pose, {first['metrics']['nees_dof']} where errors and covariance agree; beside "
            "it where it lies by chance in 99 % of runs as correlated as this one. Over its Cramer-Rao bound, from the "
            "whole log or for a causal trajectory from the past alone, an error is about 1 where nothing is lost."
        )
    else:
        notes.append("Without a truth there are no errors to set side by side; how sure each says it is stands above.")
    return table(header, body, "stacked") + f"<p class=note>{escape(' '.join(notes))}</p>"


def calibrations(report: Report, pen: dict[str, Pen]) -> str:
    """A row for each calibration, a column for each estimator."""
    summaries = ran(report.summaries)
    names = list(dict.fromkeys(name for summary in summaries.values() for name in summary["calibration"]))
    body = []
    for name in names:
        own = {estimator: summary["calibration"].get(name) for estimator, summary in summaries.items()}
        body.append([escape(titled(name)), *map(_calibrated, own.values()), _told(own)])
    header = ["calibration", *(swatch(_first_pen(pen, name), name) for name in summaries), "told by the log"]
    return table(header, body)


def _told(own: dict[str, dict[str, Any] | None]) -> str:
    """The estimators' verdicts on one calibration, number under number; their names where they differ."""
    by_verdict: dict[str, list[str]] = {}
    for estimator, entry in own.items():
        if entry is not None:
            by_verdict.setdefault("<br>".join(told(entry)), []).append(estimator)
    verdicts = {verdict: names for verdict, names in by_verdict.items() if set(verdict.split("<br>")) != {"-"}}
    if len(verdicts) < 2:
        return next(iter(verdicts), "–")
    return "<br>".join(f"<small>{escape(', '.join(names))}:</small><br>{said}" for said, names in verdicts.items())


def _calibrated(entry: dict[str, Any] | None) -> str:
    if entry is None:
        return "–"
    values, sds = (x if isinstance(x, list | tuple) else [x] for x in (entry["value"], entry["sd"]))
    if not entry["estimated"]:
        return f"{', '.join(number(x) for x in values)} <small>given, not estimated</small>"
    return "<br>".join(known(value, sd) for value, sd in zip(values, sds, strict=True))


UNITS = {
    "m": "m",
    "s": "s",
    "deg": "deg",
    "ut": "µT",
    "mm": "mm",
    "kpkm": "K/km",
}  # what a calibration's name ends with


def titled(name: str) -> str:
    """``prism_lever_arm_m`` as prism lever arm, m."""
    words, _, unit = name.rpartition("_")
    return f"{words.replace('_', ' ')}, {UNITS[unit]}" if unit in UNITS else name.replace("_", " ")


def known(value: float, sd: float) -> str:
    """A value and its standard deviation, to the second digit of the latter."""
    if not 0 < sd < float("inf"):
        return f"{number(value)} <small>± {number(sd)}</small>"
    digits = 1 - floor(log10(sd))
    if not 0 <= digits <= 9:
        return f"{value:.4g} <small>± {sd:.2g}</small>"
    return f"{value:.{digits}f} <small>± {sd:.{digits}f}</small>"


def counts(report: Report) -> str:
    """Where every sample went, by sensor and estimator; estimators that agree share a row."""
    summaries = ran(report.summaries)
    shown = [part for part in PARTS if any(c[part] for s in summaries.values() for c in s["sensors"].values())]
    body = []
    for sensor in dict.fromkeys(name for summary in summaries.values() for name in summary["sensors"]):
        by_counts: dict[tuple[str, ...], list[str]] = {}
        for name, summary in summaries.items():
            if sensor in summary["sensors"]:
                own = summary["sensors"][sensor]
                by_counts.setdefault(tuple(str(own[part]) for part in ("received", *shown)), []).append(name)
        for cells, names in by_counts.items():
            body.append([escape(sensor), escape("all" if len(by_counts) == 1 else ", ".join(names)), *cells])
    return table(["sensor", "estimator", "received", *shown], body)


def deviations(report: Report, pen: dict[str, Pen]) -> str:
    """What the figure of a shaft machine's deviation shows when it is pointed at: how long each estimator was at which
    level, and what the first says while it is not normal."""
    of = {name: s["deviation"] for name, s in report.summaries.items() if s.get("deviation")}
    if not of:
        return ""
    levels = list(dict.fromkeys(level for one in of.values() for level in one["level_s"]))
    spent = table(
        ["seconds", *levels],
        [
            [swatch(_first_pen(pen, name), name), *(f"{one['level_s'].get(level, 0.0):.1f}" for level in levels)]
            for name, one in of.items()
        ],
    )
    name, first = next(iter(of.items()))
    states = [state for state in first["timeline"] if state["level"] != NORMAL]
    longest = sorted(sorted(states, key=lambda s: s["start_s"] - s["end_s"])[:STATES], key=lambda s: s["start_s"])
    keys = [key for key in (longest[0] if longest else ()) if key not in ("start_s", "end_s")]
    listed = table(
        ["from – to, s", *(escape(titled(key)) for key in keys)],
        [[f"{s['start_s']:.1f} – {s['end_s']:.1f}", *(escape(worded(s[key])) for key in keys)] for s in longest],
    )
    if not listed:
        return spent
    some = f", the longest {STATES} of {len(states)} stretches" if len(states) > STATES else ""
    return f"{spent}<h3>{escape(name)} outside of normal{some}</h3>{listed}"


def worded(value: Any) -> str:
    """What a state holds, as a reader takes it in."""
    if isinstance(value, list | tuple):
        return ", ".join(map(worded, value))
    if value is None:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def swatch(pen: Pen | None, label: str) -> str:
    """A name with the colour and stroke that it has in the figures."""
    if pen is None:
        return escape(label)
    style = "dotted" if pen.dash == "dot" else "solid" if pen.dash == "solid" else "dashed"
    return f'<span class=swatch style="border-top:3px {style} {pen.colour}"></span>{escape(label)}'


def _first_pen(pen: dict[str, Pen], estimator: str) -> Pen | None:
    return pen.get(estimator) or pen.get(f"{estimator} (last)")


def number(value: float | None) -> str:
    """A figure as a reader takes it in: four digits."""
    return "–" if value is None else f"{value:.4g}"
