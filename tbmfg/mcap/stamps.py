"""Which header stamps cannot be the times of their messages: never set, of another day, or run through twice."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tbmfg.timeseries import NS, Times

_HOUR = 3600 * NS  # a recording has no pause of more than one to two hours; a clock that is set wrong does
_RERUN = 1 * NS  # messages overtake each other by less; what lies further back is a clock that was turned
_UNSET = 1 * NS  # a stamp of zero is one only where time begins there


def eras(stamps: Iterable[Times]) -> Times:
    """Hours since 1970 at which another era begins, sorted: hours without a stamp on any topic lie before it.

    A driver that starts before its clock is set, or a stamp that was never filled in, makes an era of its own.
    """
    hours = np.unique(np.concatenate([np.empty(0, np.int64), *(np.unique(t_ns // _HOUR) for t_ns in stamps)]))
    return hours[1:][np.diff(hours) > 1]


def misdated(t_ns: Times, log_ns: Times, starts: Times) -> NDArray[np.bool_]:
    """Which of the stamps (n,) of one topic, logged at ``log_ns`` (n,), are not to be believed.

    These are zeros that were never filled in, stamps outside the era of most of the topic's messages (``starts``
    from :func:`eras`), and where the clock ran through some time twice, the smaller part.
    """
    wrong = _unset(t_ns)
    era = np.searchsorted(starts, t_ns // _HOUR, side="right")
    if not wrong.all():
        wrong |= era != np.bincount(era[~wrong]).argmax()
    rows = np.flatnonzero(~wrong)
    if (np.diff(log_ns) < 0).any():  # a file that is not in order of time says nothing about the clock
        rows = rows[np.argsort(log_ns[rows], kind="stable")]
    wrong[rows[_rerun(t_ns[rows])]] = True
    return wrong


def _unset(t_ns: Times) -> NDArray[np.bool_]:
    zero = t_ns == 0
    others = t_ns[~zero]
    begins_there = zero.sum() == 1 and len(others) and 0 < others.min() < _UNSET
    return np.zeros_like(zero) if begins_there else zero


def _rerun(t_ns: Times) -> NDArray[np.bool_]:
    """Of stamps in the order they came: the stretches far behind an earlier one, or those far ahead of a later
    one, whichever are fewer. Nothing where the two do not overlap: there only the order was lost."""
    if len(t_ns) < 2:
        return np.zeros(len(t_ns), dtype=bool)
    behind = _far(np.maximum.accumulate(t_ns) - t_ns)
    if not behind.any() or t_ns[behind].max() < t_ns[~behind].min():
        return np.zeros_like(behind)
    ahead = _far(t_ns - np.minimum.accumulate(t_ns[::-1])[::-1])
    return ahead if ahead.sum() < behind.sum() else behind


def _far(excess: Times) -> NDArray[np.bool_]:
    """Stretches of positive ``excess`` that reach beyond what messages overtake each other by."""
    inside = excess > 0
    stretch = np.cumsum(np.diff(inside, prepend=False))
    return inside & np.isin(stretch, np.unique(stretch[excess > _RERUN]))
