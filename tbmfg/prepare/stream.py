"""What became of a sensor's messages on the way: said with numbers and times, for every sensor alike."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from tbmfg.mcap.info import GAP
from tbmfg.rig import Rig
from tbmfg.state import Interval
from tbmfg.timeseries import Log, StreamCounts, seconds

SAID = {
    "duplicate": "repeat a stamp; the first of each is kept",
    "disordered": "bear a stamp before that of the message they follow; sorted by stamp",
    "nonfinite": "hold a NaN or infinity; left out",
    "misdated": "bear a stamp that cannot be right; left out",
    "undecodable": "cannot be decoded; left out",
}


def losses(log: Log, rig: Rig, without: tuple[str, ...], t0_ns: int) -> list[str]:
    """A line for whatever was wrong with the messages of a sensor; times in s since ``t0_ns``."""
    said = []
    for name, sensor in rig.sensors.items():
        source = log.series.get(sensor.topic, log.clouds.get(sensor.topic))
        if source is None or name in without:
            continue
        counts: StreamCounts = source.counts
        for what in (f.name for f in fields(counts) if f.name in SAID):
            if count := getattr(counts, what):
                first_ns = counts.first_ns.get(what)
                when = "" if first_ns is None else f", the first at {(first_ns - t0_ns) * 1e-9:.2f} s"
                total = counts.received + counts.undecodable
                said.append(f"{name}: {count} of {total} messages on {sensor.topic} {SAID[what]}{when}")
    return said


def gaps(
    log: Log, rig: Rig, without: tuple[str, ...], outages: tuple[tuple[str, float, float], ...], t0_ns: int
) -> tuple[list[Interval], list[str]]:
    """Stretches in which a sensor beside the IMU fell silent, and a line for each sensor that did.

    Silent: for more than ``GAP`` of its usual intervals, and for longer than keyframes lie apart. What an outage that
    was asked for hides is no gap.
    """
    found, said = [], []
    for name, sensor in rig.sensors.items():
        source = log.series.get(sensor.topic, log.clouds.get(sensor.topic))
        if source is None or name in without or name == "imu" or len(source) < 2:
            continue
        t = seconds(source.t_ns, t0_ns)
        spacing = np.diff(t)
        limit = max(GAP * float(np.median(spacing)), rig.keyframes.max_gap)
        hidden = [(start, end) for sensor_, start, end in outages if sensor_ == name]
        rows = [k for k in np.flatnonzero(spacing > limit) if not any(a < t[k + 1] and b > t[k] for a, b in hidden)]
        if not rows:
            continue
        found += [Interval(name, "gap", int(source.t_ns[k]), int(source.t_ns[k + 1])) for k in rows]
        longest = max(rows, key=lambda k: spacing[k])
        said.append(
            f"{name}: gaps: {len(rows)}, {spacing[rows].sum():.3g} s together, the longest {spacing[longest]:.3g} s at "
            f"{t[longest]:.2f} s; the estimate goes without it there"
        )
    return found, said
