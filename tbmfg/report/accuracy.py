"""How well: errors against the truth, what the estimators claim, and what the sensors said to it."""

from __future__ import annotations

from dataclasses import replace
from html import escape

import numpy as np

from tbmfg.chance import chi_square_point
from tbmfg.problem import GATE
from tbmfg.report.content import Report, deviations, error_rotation_sd
from tbmfg.report.panels import (
    SIGMAS,
    TIME,
    Figure,
    Pen,
    add_band,
    add_line,
    axis_name,
    labelled,
    log_ticks,
    point_of_truth,
    stacked,
)
from tbmfg.report.thin import packed
from tbmfg.state import POS, Innovations
from tbmfg.timeseries import Floats

NEAR = 2.5  # of the best estimate's reach, what the errors of all are shown in
NIS_STRETCHES = 200
GATED_DRAWN = 400  # of one sensor and estimator


def errors(report: Report, pen: dict[str, Pen]) -> Figure | None:
    """Estimate minus truth with the bands that the estimator claims."""
    compared = [track for track in report.tracks if track.errors is not None and len(track.errors.rows)]
    if not compared:
        return None
    attitude = all(track.errors.rotation_n is not None for track in compared)
    figure = Figure(
        "Errors against the truth",
        "Estimate minus truth, coordinates as they are (not aligned), with the ± 3 sigma that each estimator claims: a "
        "line outside its own band means an estimator surer than it should be."
        + (f" {point_of_truth(report.truth)}" if report.truth.arm_b.any() else ""),
    )
    titles = ["x, mm", "y, mm", "z, mm"] + ["tilt about x, deg", "tilt about y, deg", "heading, deg"] * attitude
    figure.layout = stacked(titles, TIME, 125)
    widest, narrow = np.zeros(len(titles)), np.full(len(titles), np.inf)
    for track in reversed(compared):
        e = track.errors
        t_s = (e.t_ns - report.t0_ns) * 1e-9
        values, sd = 1e3 * e.position_n, 1e3 * deviations(track.error_cov[:, POS, POS])
        if attitude:
            values = np.hstack([values, np.rad2deg(e.rotation_n)])
            sd = np.hstack([sd, np.rad2deg(error_rotation_sd(track))])
        reach = np.maximum(np.abs(values), SIGMAS * sd)
        widest = np.maximum(widest, np.nanmax(reach, axis=0))
        narrow = np.minimum(narrow, np.nanquantile(reach, 0.99, axis=0))
        for panel in range(len(titles)):
            add_band(figure, pen[track.label], t_s, np.zeros(len(t_s)), SIGMAS * sd[:, panel], panel)
            add_line(figure, pen[track.label], t_s, values[:, panel], panel, shown=panel == 0)
    if (widest > NEAR * narrow).any():
        figure.caption += " The largest errors lie outside of what is shown at first: double-click for all."
    for panel in range(len(titles)):
        reach = 1.05 * min(widest[panel], NEAR * narrow[panel])
        figure.layout[f"yaxis{panel + 1 if panel else ''}"]["range"] = [-reach, reach]
    return figure


def how_sure(report: Report, pen: dict[str, Pen]) -> Figure:
    """The standard deviations that the estimators claim."""
    figure = Figure(
        "How sure each estimator is",
        "Its own standard deviations (1 sigma): of the position in space, of the heading, and of the tilt.",
    )
    titles = ["position, mm", "heading, deg", "tilt, deg"]
    figure.layout = stacked(titles, TIME)
    low, high = np.full(len(titles), np.inf), np.zeros(len(titles))
    for track in reversed(report.tracks):
        t_s = (track.path.t_ns - report.t0_ns) * 1e-9
        turns = np.rad2deg(track.rotation_sd())
        position = 1e3 * np.linalg.norm(track.position_sd(), axis=1)
        for panel, y in enumerate([position, turns[:, 2], np.linalg.norm(turns[:, :2], axis=1)]):
            known = np.isfinite(y) & (y > 0)
            low[panel], high[panel] = min(low[panel], y[known].min(initial=np.inf)), y[known].max(initial=high[panel])
            add_line(figure, pen[track.label], t_s, np.where(known, y, np.nan), panel, shown=panel == 0)
    for panel in np.flatnonzero(high > 0):
        figure.layout[f"yaxis{panel + 1 if panel else ''}"] |= log_ticks(low[panel], high[panel])
    return figure


def innovations(report: Report, pen: dict[str, Pen]) -> Figure | None:
    """Normalised residuals per sensor, and what was gated."""
    sensors = list(dict.fromkeys(sensor for series in report.innovations.values() for sensor in series))
    if not sensors:
        return None
    figure = Figure(
        "Innovations and gated measurements",
        f"Root mean square of the normalised residuals in {NIS_STRETCHES} equal stretches of time: 1 (solid line) "
        "where noise and model agree, above it where a sensor contradicts the rest by more than its sigma. Crosses: "
        f"measurements beyond the {100 * GATE:.1f} % gate (dashed line), which a filter leaves out and a smoother "
        "weakens. Filters show what the sensor said before it was used, smoothers what remains.",
    )
    figure.layout = stacked(labelled(sensors), TIME, 110, rangemode="tozero")
    figure.layout["shapes"] = []
    own = {name: next(p for p in pen.values() if p.group.startswith(escape(name))) for name in report.innovations}
    shown: set[str] = set()
    for panel, sensor in enumerate(sensors):
        dof = next(series[sensor].dof for series in report.innovations.values() if sensor in series)
        for level, dash in ((1.0, "solid"), (float(np.sqrt(chi_square_point(GATE, dof) / dof)), "dash")):
            line = {"color": "#777777", "width": 1, "dash": dash}
            where = {"x0": 0, "x1": 1, "xref": "paper", "y0": level, "y1": level, "yref": axis_name(panel)}
            figure.layout["shapes"].append({"type": "line", "line": line, **where})
        for estimator, series in reversed(report.innovations.items()):
            if sensor in series and len(series[sensor].t_ns):
                _innovations_of(figure, report, own[estimator], estimator, series[sensor], panel, shown)
    return figure


def _innovations_of(
    figure: Figure, report: Report, pen: Pen, estimator: str, series: Innovations, panel: int, shown: set[str]
) -> None:
    t_s = (series.t_ns - report.t0_ns) * 1e-9
    size = np.sqrt(np.maximum(series.nis, 0.0) / series.dof)
    gated = np.asarray(series.gated, dtype=bool)
    pen = replace(pen, name=escape(estimator), group=escape(estimator), dash="solid" if pen.dash == "dot" else pen.dash)
    mean_t, mean = stretch_rms(t_s[~gated], size[~gated])
    add_line(figure, pen, mean_t, mean, panel, shown=estimator not in shown)
    shown.add(estimator)
    if not gated.any():
        return
    every = -(-int(gated.sum()) // GATED_DRAWN)
    figure.thinned(int(gated.sum()), -(-int(gated.sum()) // every))
    marker = {"color": pen.colour, "symbol": "x-thin", "size": 7, "line": {"color": pen.colour, "width": 1.5}}
    figure.data.append(
        {
            "type": "scatter", "mode": "markers", "name": pen.name, "legendgroup": pen.group, "showlegend": False,
            "x": packed(t_s[gated][::every]), "y": packed(size[gated][::every]), "yaxis": axis_name(panel),
            "marker": marker, "hovertemplate": "gated, %{y:.3g}", "cliponaxis": False,
        }
    )  # fmt: skip


def stretch_rms(t_s: Floats, size: Floats) -> tuple[Floats, Floats]:
    """Times and root mean squares of ``size`` in equal stretches of time, without the empty ones."""
    if not len(t_s):
        return np.zeros(0), np.zeros(0)
    edges = np.linspace(t_s[0], t_s[-1], min(NIS_STRETCHES, len(t_s)) + 1)
    which = np.clip(np.searchsorted(edges, t_s, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(which, minlength=len(edges) - 1)
    total = np.bincount(which, size**2, minlength=len(edges) - 1)
    held = count > 0
    return (0.5 * (edges[1:] + edges[:-1]))[held], np.sqrt(total[held] / count[held])
