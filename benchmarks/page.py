"""The rows of a benchmark as one HTML page: what is judged drawn against its bounds, and every row as a table."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html import escape
from typing import Any

import numpy as np

from benchmarks.rows import Row, table_of
from tbmfg.report.page import STYLE
from tbmfg.report.panels import COLOURS, axis, layout

OVER_TIME = re.compile(r"(.+)@([\d.]+)s")  # a metric at several times
HEIGHT_PX = 340
CONFIDENCE = 1.96  # standard errors to either side of a mean: 95 %

Chart = tuple[list[dict[str, Any]], dict[str, Any]]  # plotly's data and layout


def page(title: str, rows: list[Row]) -> str:
    """The document; plotly's JavaScript is in it."""
    from plotly.io import to_html

    parts, first = [], True
    for scenario in dict.fromkeys(row.scenario for row in rows):
        own = [row for row in rows if row.scenario == scenario]
        parts.append(f"<h2>{escape(scenario)}</h2>")
        for data, drawn in charts(own):
            figure = {"data": data, "layout": drawn}
            parts.append(to_html(figure, full_html=False, include_plotlyjs=first, validate=False))
            first = False
        header, lines = table_of(own)
        body = "".join(f"<tr>{_cells(line[:1], 'th')}{_cells(line[1:], 'td')}</tr>" for line in lines)
        head = f"<thead><tr>{_cells(header, 'th')}</tr></thead>"
        parts.append(f"<div class=wide><table>{head}{body}</table></div>")
    return "".join(
        [
            "<!doctype html>\n<html lang=en><head><meta charset=utf-8>",
            f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body><h1>{escape(title)}</h1>\n",
            "<p class=note>Bars are 95 % intervals of the means over n logs; grey is where a mean should lie. ",
            "In tables ± is the sd over the logs; ! is outside of its bound.</p>\n",
            *parts,
            "</body></html>\n",
        ]
    )


def _cells(texts: list[str], kind: str) -> str:
    return "".join(f"<{kind}>{escape(text)}</{kind}>" for text in texts)


def charts(rows: list[Row]) -> Iterator[Chart]:
    """Of one scenario: a chart for each metric that is known at several times, and one per unit for what is judged;
    of what there should be none the table is enough."""
    timed = {row.key: OVER_TIME.fullmatch(row.metric) for row in rows}
    for name in dict.fromkeys(found[1] for found in timed.values() if found):
        own = [(float(found[2]), row) for row in rows if (found := timed[row.key]) and found[1] == name]
        yield _chart(own, f"{name} [{own[0][1].unit}]" if own[0][1].unit else name, "seconds")
    judged = [row for row in rows if row.bound not in (None, (None, 0)) and not timed[row.key] and row.mean is not None]
    for unit in dict.fromkeys(row.unit for row in judged):
        own = [(row.metric, row) for row in judged if row.unit == unit]
        yield _chart(own, unit or "ratio", "")


def _chart(points: list[tuple[Any, Row]], up: str, along: str) -> Chart:
    """Means with their intervals by estimator, and the bounds behind them; ``points`` are (place, row)."""
    places = list(dict.fromkeys(place for place, _ in points))
    data = []
    for number, name in enumerate(dict.fromkeys(row.estimator for _, row in points)):
        own = [(place, row) for place, row in points if row.estimator == name]
        colour = COLOURS[number % len(COLOURS)]
        reach = [CONFIDENCE * (row.sd or 0.0) / np.sqrt(row.n) for _, row in own]
        data.append({
            "type": "scatter", "name": name, "mode": "lines+markers" if along else "markers",
            "x": [place for place, _ in own], "y": [row.mean for _, row in own],
            "error_y": {"type": "data", "array": reach, "thickness": 1.2}, "marker": {"color": colour, "size": 8},
            "line": {"color": colour, "width": 1},
        })  # fmt: skip
    width = 0.4 if not along else 0.4 * min(np.diff(places), default=1.0)
    boxes = []
    for place, row in points:
        if row.bound is not None:
            at = place if along else places.index(place)
            low, high = row.bound
            boxes.append({
                "type": "rect", "layer": "below", "x0": at - width, "x1": at + width, "line": {"width": 0},
                "y0": _edge(points, low, -1), "y1": _edge(points, high, 1), "fillcolor": "rgba(120,120,120,0.12)",
            })  # fmt: skip
    sideways = axis(along, categoryorder="array", categoryarray=places) if not along else axis(along)
    return data, layout(HEIGHT_PX, shapes=boxes, xaxis=sideways, yaxis=axis(up))


def _edge(points: list[tuple[Any, Row]], limit: float | None, side: int) -> float:
    """Where a bound ends that is open to that side: beyond all means."""
    if limit is not None:
        return limit
    ends = [end for _, row in points for end in (row.mean, *(row.bound or ())) if end is not None]
    return (max if side > 0 else min)(ends) + side * 0.1 * (np.ptp(ends) or 1.0)
