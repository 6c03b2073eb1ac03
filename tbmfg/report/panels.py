"""Plotly figures as plain dictionaries: panels over one time axis, lines and bands in an estimator's colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np

from tbmfg.report.thin import band, broken, extremes, packed, segments
from tbmfg.state import Truth
from tbmfg.timeseries import Floats

# Okabe and Ito's colours, told apart by colour-blind eyes; the yellow is left out, which vanishes on white.
BLACK = "#000000"
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES = ("solid", "dash", "dashdot", "longdash")
GRID, INK = "#e3e3e3", "#222222"
PANEL_PX, TITLE_PX, MARGIN_PX = 150, 24, 95
SIGMAS = 3.0
TIME = "seconds from the first IMU sample"


@dataclass(frozen=True, slots=True)
class Pen:
    """How an estimator's trajectory is drawn, in every figure alike."""

    name: str
    group: str
    colour: str
    dash: str
    rank: int = 0
    width: float = 1.6

    def line(self) -> dict[str, Any]:
        return {"color": self.colour, "dash": self.dash, "width": self.width}


@dataclass(slots=True)
class Figure:
    """A figure: plotly's data and layout, the heading above it and the words below.

    ``most`` is the largest number of samples that one point drawn stands for; ``table``: HTML that follows.
    """

    title: str
    caption: str
    data: list[dict[str, Any]] = field(default_factory=list)
    layout: dict[str, Any] = field(default_factory=dict)
    most: float = 1.0
    table: str = ""

    def thinned(self, before: int, after: int) -> None:
        """Note that ``after`` points stand for ``before``."""
        self.most = max(self.most, before / max(after, 1))

    def words(self) -> str:
        """The caption, with what was left out to draw it."""
        if self.most <= 1.0:
            return self.caption
        return f"{self.caption} Drawn with one point in {self.most:.2g}, the lowest and highest of every stretch kept."


def pens(labels: Sequence[tuple[str, str, bool]]) -> dict[str, Pen]:
    """Pens by label, from (label, estimator, smoothed): one colour for each estimator, dots for the causal one of two
    trajectories."""
    names = list(dict.fromkeys(estimator for _, estimator, _ in labels))
    twice = {estimator for _, estimator, smoothed in labels if smoothed}
    found = {}
    for label, estimator, smoothed in labels:
        number = names.index(estimator)
        dash = DASHES[number // len(COLOURS) % len(DASHES)]
        if estimator in twice and not smoothed:
            dash = "dot"
        found[label] = Pen(escape(label), escape(label), COLOURS[number % len(COLOURS)], dash, len(found) + 1)
    return found


def layout(height: int, **more: Any) -> dict[str, Any]:
    """What all figures share."""
    return {
        "height": height,
        "autosize": True,
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "margin": {"l": 75, "r": 20, "t": 45, "b": 50},
        "hovermode": "closest",
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom", "yref": "paper"},
        **more,
    }


def axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis with its title."""
    return {"title": {"text": title}, "gridcolor": GRID, "zerolinecolor": "#b0b0b0", "linecolor": INK, **more}


def stacked(titles: Sequence[str], x_title: str, panel_px: int = PANEL_PX, **y_options: Any) -> dict[str, Any]:
    """Layout of panels below each other over one x axis; the panel of index k has the y axis ``axis_name(k)``."""
    count = len(titles)
    head = TITLE_PX / (count * panel_px)  # room for its title over each panel
    axes, notes = {}, []
    for k, title in enumerate(titles):
        top = 1 - k / count - head
        axes[f"yaxis{k + 1 if k else ''}"] = axis("", domain=[max(1 - (k + 1) / count, 0.0), top], **y_options)
        place = {"x": 0, "xref": "paper", "xanchor": "left", "y": top, "yref": "paper", "yanchor": "bottom"}
        notes.append({"text": f"<b>{title}</b>", "showarrow": False, **place})
    below = axis(x_title, anchor=axis_name(count - 1), zeroline=False)
    return layout(count * panel_px + MARGIN_PX, xaxis=below, hovermode="x", annotations=notes, **axes)


def log_ticks(low: float, high: float) -> dict[str, Any]:
    """A logarithmic axis from ``low`` to ``high`` with a few ticks on it: powers of ten, 1-2-5, or finer ones."""
    margin = 0.05 * max(np.log10(high / low), 0.3)
    first, last = np.log10(low) - margin, np.log10(high) + margin
    powers = 10.0 ** np.arange(np.floor(first), np.ceil(last) + 1)
    finer = (([1.0], 3), ([1.0, 2.0, 5.0], 2), (np.arange(1.0, 10.0), 2), (np.arange(10.0, 100.0) / 10, 2))
    for steps, enough in finer:
        ticks = np.outer(powers, steps).ravel()
        ticks = ticks[(ticks > 10**first) & (ticks < 10**last)]
        if len(ticks) >= enough:
            break
    shown = ticks if len(ticks) > 1 else np.array([low, high])
    return {
        "type": "log",
        "range": [float(first), float(last)],
        "tickvals": shown.tolist(),
        "ticktext": [f"{tick:.10g}" for tick in shown],
    }


def axis_name(panel: int) -> str:
    """plotly's name for a panel's y axis."""
    return f"y{panel + 1 if panel else ''}"


def add_line(
    figure: Figure, pen: Pen, t_s: Floats, y: Floats, panel: int = 0, *, shown: bool = False, unit: str = ""
) -> None:
    """A line over time, pen lifted where there is nothing; ``shown`` puts it into the legend."""
    rows = extremes(y)
    figure.thinned(len(y), len(rows))
    xs, ys = broken(segments(t_s)[rows], t_s[rows], y[rows])
    figure.data.append(
        {
            "type": "scatter", "mode": "lines", "name": pen.name, "legendgroup": pen.group, "showlegend": shown,
            "x": packed(xs), "y": packed(ys), "yaxis": axis_name(panel), "line": pen.line(), "legendrank": pen.rank,
            "hovertemplate": f"%{{y:.4g}}{unit}",
        }
    )  # fmt: skip


def add_band(figure: Figure, pen: Pen, t_s: Floats, centre: Floats, half: Floats, panel: int = 0) -> None:
    """The area of ``centre`` plus and minus ``half``."""
    rows = extremes(np.column_stack([centre - half, centre + half]))
    x, y = band(segments(t_s)[rows], t_s[rows], (centre - half)[rows], (centre + half)[rows])
    figure.data.append(
        {
            "type": "scatter", "mode": "lines", "fill": "toself", "name": pen.name, "legendgroup": pen.group,
            "showlegend": False, "x": packed(x), "y": packed(y), "yaxis": axis_name(panel), "hoverinfo": "skip",
            "line": {"color": pen.colour, "width": 0.4}, "fillcolor": faint(pen.colour), "connectgaps": False,
        }
    )  # fmt: skip


def faint(colour: str, opacity: float = 0.13) -> str:
    """A colour to fill with."""
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity})"


def labelled(names: Sequence[str]) -> list[str]:
    """Names from logs and rigs as plotly shows them, in words: it reads some HTML in every label."""
    return [escape(name.replace("_", " ")) for name in names]


def point_of_truth(truth: Truth) -> str:
    """Whose positions a truth with an arm holds."""
    arm = ", ".join(f"{x:.3f}" for x in truth.arm_b)
    return f"The truth is that of a point at ({arm}) m from the IMU; errors are taken at that point."
