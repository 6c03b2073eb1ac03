"""Fewer points for a plot, none of the extremes lost; and arrays as plotly's JavaScript takes them."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from tbmfg.timeseries import Floats

STRETCHES = 500  # of a trace: a panel is about twice as many pixels wide
GAP_RATIO, GAP_MIN_S = 5.0, 2.0  # longer intervals than these (times the median, and seconds) interrupt a line
FINE_ENOUGH = 1e-4  # of a trace's range: rounding that no plot shows


def extremes(values: Floats, stretches: int = STRETCHES) -> np.ndarray:
    """Rows of ``values`` (n,) or (n, k) that hold the lowest and the highest of every column in each of ``stretches``
    equal parts, and both ends; all rows where that would not be fewer."""
    columns = values[:, None] if values.ndim == 1 else values
    n, k = columns.shape
    if n <= 2 * k * stretches:
        return np.arange(n)
    size = -(-n // stretches)
    padded = np.full((stretches * size, k), np.nan)
    padded[:n] = columns
    parts = padded.reshape(stretches, size, k)
    start = size * np.arange(stretches)[:, None]
    low = start + np.where(np.isnan(parts), np.inf, parts).argmin(axis=1)
    high = start + np.where(np.isnan(parts), -np.inf, parts).argmax(axis=1)
    return np.unique(np.clip([0, n - 1, *low.ravel(), *high.ravel()], 0, n - 1))


def segments(t_s: Floats) -> np.ndarray:
    """Number of the uninterrupted stretch that each of the times (n,) belongs to."""
    if len(t_s) < 2:
        return np.zeros(len(t_s), dtype=int)
    intervals = np.diff(t_s)
    gap = intervals > max(GAP_RATIO * float(np.median(intervals)), GAP_MIN_S)
    return np.concatenate([[0], np.cumsum(gap)])


def broken(segment: np.ndarray, *columns: Floats) -> list[Floats]:
    """``columns`` (n,) with a NaN between segments, where plotly lifts the pen."""
    at = np.flatnonzero(np.diff(segment)) + 1
    return [np.insert(np.asarray(column, dtype=float), at, np.nan) for column in columns]


def band(segment: np.ndarray, x: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """The outline of the area between ``low`` and ``high``, one closed piece per segment, NaN between them."""
    xs, ys = [], []
    for one in np.unique(segment):
        rows = segment == one
        xs += [x[rows], x[rows][::-1], [np.nan]]
        ys += [high[rows], low[rows][::-1], [np.nan]]
    return np.concatenate(xs or [np.zeros(0)]), np.concatenate(ys or [np.zeros(0)])


def packed(values: Floats) -> dict[str, Any]:
    """An array as base64 of its bytes, in single precision where a plot cannot tell the difference."""
    values = np.asarray(values, dtype=np.float64)
    finite = values[np.isfinite(values)]
    if not len(finite):
        single = True
    else:
        with np.errstate(over="ignore"):
            rounding = np.spacing(np.float32(np.abs(finite).max()))
        single = bool(rounding <= FINE_ENOUGH * np.ptp(finite)) or not finite.any()
    kind = "<f4" if single else "<f8"
    return {"dtype": kind[1:], "bdata": base64.b64encode(values.astype(kind).tobytes()).decode()}
