"""What happened when: the sensors that were there, outages and gaps, standing; the states of a shaft machine."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import Any

import numpy as np

from tbmfg.report.content import Report
from tbmfg.report.panels import COLOURS, GRID, TIME, Figure, Pen, add_line, axis, labelled, layout, stacked
from tbmfg.report.tables import deviations, titled, worded
from tbmfg.report.thin import packed, segments
from tbmfg.timeseries import Floats

ROW_PX = 34
FINEST = 1 / 400  # of the time shown: what is shorter is drawn this long, what is closer is drawn as one
PRESENT = "#56B4E9"
KINDS = {"outage": "#D55E00", "gap": "#000000", "gated": "#E69F00", "standing": "#009E73", "restarted": "#0072B2"}
OTHER_KIND = "#CC79A7"
LEVELS = {"normal": "#009E73", "troubleshoot": "#E69F00", "stop": "#D55E00"}


def availability(report: Report, pen: dict[str, Pen]) -> Figure:
    """A row for each sensor: when it was recorded, and what happened to it."""
    intervals = [
        (name, interval) for name, summary in report.summaries.items() for interval in summary.get("intervals", ())
    ]
    rows = list(dict.fromkeys([*report.stamps_s, *(interval["sensor"] for _, interval in intervals)]))
    ends = [t_s[[0, -1]] for t_s in report.stamps_s.values() if len(t_s)]
    begin, end = (min(a for a, _ in ends), max(b for _, b in ends)) if ends else (0.0, 0.0)
    finest = FINEST * (end - begin)
    figure = Figure(
        "Sensors over time",
        f"When each sensor was recorded, and what happened to it. Stretches closer than {finest:.2g} s are drawn as "
        "one and shorter ones that long.",
    )
    for row, t_s in enumerate(report.stamps_s.values()):
        spans = merged(present(t_s), finest)
        figure.data.append(_bars("recorded", PRESENT, 14, [(row, *span) for span in spans], not row))
    kinds = list(dict.fromkeys(interval["kind"] for _, interval in intervals))
    for kind in kinds:
        bars = []
        for row, sensor in enumerate(rows):
            own = [i for _, i in intervals if i["sensor"] == sensor and i["kind"] == kind]
            bars += [(row, *span) for span in merged(((i["start_s"], i["end_s"]) for i in own), finest)]
        figure.data.append(_bars(escape(kind), KINDS.get(kind, OTHER_KIND), 7, bars, True))
    figure.layout = _rows(rows)
    figure.layout["xaxis"]["range"] = [begin, max(end, begin + 1.0)]  # of all stamps: a clock may be far off
    return figure


def health(report: Report, pen: dict[str, Pen]) -> Figure | None:
    """How every LiDAR's scans fit the map that they make."""
    if not report.health:
        return None
    figure = Figure(
        "How the scans fit",
        "Of every scan: the share of its points near surfaces of the map that lie on them, the noise of these, how "
        "many of six directions the walls do not tell, and the share of its nearer points that hang in the air, as "
        "dust does.",
    )
    titles = ["overlap, %", "residual, mm", "directions untold", "dust, %"]
    figure.layout = stacked(titles, TIME, 90, rangemode="tozero")
    for number, (lidar, told) in enumerate(report.health.items()):
        own, t_s = Pen(escape(lidar), escape(lidar), COLOURS[number % len(COLOURS)], "solid"), told.t_ns - report.t0_ns
        values = (100.0 * told.overlap, 1e3 * told.residual_m, told.weak.astype(float), 100.0 * told.dust)
        for panel, y in enumerate(values):
            add_line(figure, own, t_s * 1e-9, y, panel, shown=panel == 0)
    return figure


def deviation(report: Report, pen: dict[str, Pen]) -> Figure | None:
    """What the dual-coordinate method says over time, a row for each estimator: its level as colour."""
    told = {name: s["deviation"]["timeline"] for name, s in report.summaries.items() if s.get("deviation")}
    if not told:
        return None
    figure = Figure(
        "Deviation of the shaft machine",
        "Level by the dual-coordinate method. Point at a bar, or look below, for the case, the direction of the "
        "deviation, the spot on the detector and the angles.",
    )
    for level, colour in LEVELS.items():
        bars, texts = [], []
        for row, states in enumerate(told.values()):
            own = [state for state in states if state["level"] == level]
            bars += [(row, state["start_s"], state["end_s"]) for state in own]
            texts += [_state_in_words(state) for state in own]
        figure.data.append(_bars(escape(level), colour, 14, bars, True, texts))
    figure.layout = _rows(list(told))
    figure.table = deviations(report, pen)
    return figure


def present(t_s: Floats) -> list[tuple[float, float]]:
    """(start, end) of the stretches in which stamps follow each other at their usual pace."""
    if not len(t_s):
        return []
    cuts = np.flatnonzero(np.diff(segments(t_s))) + 1
    return [(float(part[0]), float(part[-1])) for part in np.split(t_s, cuts)]


def merged(spans: Iterable[tuple[float, float]], finest: float) -> list[tuple[float, float]]:
    """Spans in order, none shorter than ``finest`` and none closer than that."""
    out: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        end = max(end, start + finest)
        if out and start <= out[-1][1] + finest:
            out[-1] = out[-1][0], max(end, out[-1][1])
        else:
            out.append((start, end))
    return out


def _state_in_words(state: dict[str, Any]) -> str:
    """Whatever a state holds beside its level and time."""
    parts = []
    for key, value in state.items():
        if key in ("start_s", "end_s", "level"):
            continue
        parts.append(f"{titled(key)}: {worded(value)}")
    return escape(f"{state['start_s']:.1f}–{state['end_s']:.1f} s") + "<br>" + "<br>".join(escape(p) for p in parts)


def _bars(
    name: str,
    colour: str,
    width: int,
    bars: list[tuple[int, float, float]],
    shown: bool,
    texts: list[str] | None = None,
) -> dict[str, Any]:
    """Thick lines, one for each (row, start, end), as one trace."""
    x = np.array([[start, end, np.nan] for _, start, end in bars]).ravel()
    y = np.array([[row, row, np.nan] for row, _, _ in bars]).ravel()
    hover = [text for bar in (texts or [f"{a:.2f}–{b:.2f} s" for _, a, b in bars]) for text in (bar, bar, "")]
    return {
        "type": "scatter", "mode": "lines", "name": name, "legendgroup": name, "showlegend": shown,
        "x": packed(x), "y": packed(y), "line": {"color": colour, "width": width}, "connectgaps": False,
        "text": hover, "hovertemplate": "%{text}",
    }  # fmt: skip


def _rows(names: list[str]) -> dict[str, Any]:
    ticks = {"tickvals": list(range(len(names))), "ticktext": labelled(names), "range": [len(names) - 0.4, -0.6]}
    y = axis("", **ticks, automargin=True, zeroline=False)
    return layout(len(names) * ROW_PX + 120, xaxis=axis(TIME, gridcolor=GRID), yaxis=y)
