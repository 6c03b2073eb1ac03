"""What a recording holds and what is wrong with it, before anything is estimated from it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tbmfg.mcap.reader import scan
from tbmfg.mcap.streams import Stream
from tbmfg.timeseries import Log, Series, StreamCounts, Times, Transform

GAP = 5.0  # an interval longer than this many medians is a gap
_FAR_S = 1.0  # a stamp further than this from the log time comes from another clock
_DRIFT_S = 0.1  # a change of the offset over the log beyond this is a drifting clock
_WRONG_UNITS = (
    ("acc", (0.8, 1.2), "in g, where ROS has m/s^2"),
    ("field", (0.1, 1.5), "in gauss or normalised, where ROS has tesla"),
    ("field", (10.0, 150.0), "in microtesla, where ROS has tesla"),
    ("pressure", (50.0, 150.0), "in kPa, where ROS has Pa"),
    ("pressure", (500.0, 1500.0), "in hPa, where ROS has Pa"),
)
_POSES = ("Odometry", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "PointStamped")
_TRUTH_NAMES = ("truth", "groundtruth", "reference", "mocap", "vicon")
_LASER_NAMES = ("laser", "spot", "detector", "psd")
_ROLES = {
    "Imu": "imu",
    "MagneticField": "magnetometer",
    "FluidPressure": "barometer",
    "NavSatFix": "gnss",
    "PointCloud2": "lidar",
    "PointStamped": "prism",
    "TwistStamped": "odometer",
    "TwistWithCovarianceStamped": "odometer",
    "Odometry": "odometer",
    "TFMessage": "transforms",
}


@dataclass(frozen=True, slots=True)
class Gap:
    """An interval without samples: its length in s, and its begin in s from the first IMU sample (without
    an IMU: from the topic's own first sample)."""

    start_s: float
    length_s: float


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic. Types that tbmfg does not read go by log times, and have no ``counts`` and ``log_delay_s``.

    ``rate_hz`` and ``interval_s`` (mean rate, median interval) are NaN below two samples. ``gaps``: the
    longest first. ``log_delay_s``: smallest, median and largest log time minus stamp. ``problems``: of clock and units.
    """

    topic: str
    type: str
    role: str
    messages: int
    frame_id: str
    rate_hz: float
    interval_s: float
    gaps: tuple[Gap, ...]
    log_delay_s: tuple[float, float, float] | None
    counts: StreamCounts | None
    problems: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Description:
    """A recording. ``start_ns`` and ``end_ns`` are the first and last log times; ``attachments`` name -> bytes."""

    path: str
    start_ns: int
    end_ns: int
    topics: tuple[TopicInfo, ...]
    transforms: tuple[Transform, ...]
    attachments: dict[str, int]
    unknown: dict[str, str]
    damage: tuple[str, ...]


def guess_role(topic: str, type: str) -> str:
    """What a topic is likely to be to the rig, from its ROS type and name; "unknown" if nothing fits.

    One of imu, prism, laser, odometer, magnetometer, barometer, gnss, lidar, truth, transforms.
    """
    if topic.startswith("/tbmfg/"):
        return "unknown"  # an estimate of ours in a copy of a log measures nothing
    kind, name = type.rpartition("/")[2], topic.lower().replace("_", "")
    if kind in _POSES and any(word in name for word in _TRUTH_NAMES):
        return "truth"
    if kind == "PointStamped" and any(word in name for word in _LASER_NAMES):
        return "laser"
    return _ROLES.get(kind, "unknown")


def describe(path: str | os.PathLike, *, progress: Callable[[float], None] | None = None) -> Description:
    """Read a recording once and describe it; arguments and errors as ``read_log``."""
    recording = scan(path, progress=progress)
    log = recording.log()
    log_ns = np.concatenate([stream.log_ns() for stream in recording.streams.values()])
    imu = [series.t_ns[0] for series in log.series.values() if guess_role("", series.type) == "imu" and len(series)]
    origin_ns = int(min(imu)) if imu else None
    return Description(
        log.path,
        int(log_ns.min()),
        int(log_ns.max()),
        tuple(_topic(stream, log, origin_ns) for _, stream in sorted(recording.streams.items())),
        log.transforms,
        {name: len(data) for name, data in log.attachments.items()},
        log.unknown,
        log.damage,
    )


def _topic(stream: Stream, log: Log, origin_ns: int | None) -> TopicInfo:
    received_ns, log_ns = stream.stamps()
    source = log.series.get(stream.topic) or log.clouds.get(stream.topic)
    t_ns = source.t_ns if source is not None else np.sort(stream.log_ns())
    rate_hz, interval_s, gaps = _rhythm(t_ns[t_ns != 0], origin_ns)
    delay = (log_ns - received_ns) * 1e-9
    return TopicInfo(
        stream.topic,
        stream.type,
        guess_role(stream.topic, stream.type),
        len(stream.log_ns()),
        source.frame_id if source is not None else "",
        rate_hz,
        interval_s,
        gaps if source is not None else (),  # log times come in bursts that mean nothing
        (float(delay.min()), float(np.median(delay)), float(delay.max())) if len(delay) else None,
        source.counts if source is not None else None,
        clock_problems(received_ns, log_ns) + unit_problems(log.series.get(stream.topic)),
    )


def _rhythm(t_ns: Times, origin_ns: int | None) -> tuple[float, float, tuple[Gap, ...]]:
    """Mean rate, median interval and gaps of sorted stamps."""
    if len(t_ns) < 2:
        return np.nan, np.nan, ()
    steps = np.diff(t_ns) * 1e-9
    median = float(np.median(steps))
    longest_first = np.argsort(-steps, kind="stable")[: int((steps > GAP * median).sum())]
    origin_ns = int(t_ns[0]) if origin_ns is None else origin_ns
    gaps = tuple(Gap((int(t_ns[i]) - origin_ns) * 1e-9, float(steps[i])) for i in longest_first)
    total = steps.sum()
    return (float(len(steps) / total) if total > 0 else np.nan), median, gaps


def clock_problems(t_ns: Times, log_ns: Times) -> tuple[str, ...]:
    """What is wrong with the stamps (n,) of messages logged at ``log_ns`` (n,), in the order they came."""
    problems = []
    zero = t_ns == 0
    if zero.any():
        problems.append(f"{zero.sum()} of {len(t_ns)} stamps are zero")
    t_ns, log_ns = t_ns[~zero], log_ns[~zero]
    if len(t_ns) < 2:
        return tuple(problems)
    steps = np.diff(t_ns) * 1e-9
    if (steps < 0).any():
        problems.append(f"stamps jump back {(steps < 0).sum()} times, by up to {_duration(-steps.min())}")
    ahead = steps - np.diff(log_ns) * 1e-9
    if ahead.max() > _FAR_S:
        when = (log_ns[np.argmax(ahead) + 1] - log_ns[0]) * 1e-9
        problems.append(f"stamps jump ahead of the log times by {_duration(ahead.max())}, {when:.1f} s into the topic")
    delay = (log_ns - t_ns) * 1e-9
    typical = float(np.median(delay))
    if abs(typical) > _FAR_S:
        side = "before" if typical > 0 else "after"
        problems.append(f"stamps lie {_duration(abs(typical))} {side} the log times: not the recorder's clock")
    tenth = max(len(delay) // 10, 1)
    change = float(np.median(delay[-tenth:]) - np.median(delay[:tenth]))
    if abs(change) > _DRIFT_S:
        problems.append(f"the offset to the log times changes by {change:+.3f} s from the first to the last tenth")
    return tuple(problems)


def unit_problems(series: Series | None) -> tuple[str, ...]:
    """Units that drivers get wrong, told from the typical size of the values."""
    for column, (low, high), found in _WRONG_UNITS:
        values = series.columns.get(column, ()) if series else ()
        if len(values):
            typical = float(np.median(np.linalg.norm(values.reshape(len(values), -1), axis=1)))
            if low < typical < high:
                return (f"{column} is typically {typical:.3g}: {found}",)
    return ()


def info_text(about: Description) -> str:
    """The description of a recording as plain text."""
    lines = [
        about.path,
        f"{sum(topic.messages for topic in about.topics)} messages on {len(about.topics)} topics, "
        f"{(about.end_ns - about.start_ns) * 1e-9:.1f} s from {_utc(about.start_ns)}",
        "",
        *_table(about.topics),
    ]
    notes = [f"{topic.topic}: {note}" for topic in about.topics for note in _notes(topic)]
    frames = [
        f"{one.parent} <- {one.child}: {_numbers(one.xyz)} m, xyzw {_numbers(one.quat_xyzw)}"
        for one in about.transforms
    ]
    sections = {
        "Attention": notes,
        "Skipped (no model for the type)": [f"{topic}: {type}" for topic, type in sorted(about.unknown.items())],
        "Static transforms (parent <- child)": frames,
        "Attachments": [f"{name}: {size} bytes" for name, size in about.attachments.items()],
        "Damage": list(about.damage),
    }
    for title, entries in sections.items():
        if entries:
            lines += ["", title, *(f"  {entry}" for entry in entries)]
    return "\n".join(lines)


def _table(topics: tuple[TopicInfo, ...]) -> list[str]:
    rows = [("topic", "type", "role", "messages", "rate Hz", "median ms", "gaps", "longest s", "log - stamp ms")]
    for topic in topics:
        rows.append(
            (
                topic.topic,
                topic.type.replace("/msg/", "/"),
                topic.role,
                str(topic.messages),
                f"{topic.rate_hz:.2f}" if topic.rate_hz == topic.rate_hz else "-",
                f"{topic.interval_s * 1e3:.2f}" if topic.interval_s == topic.interval_s else "-",
                str(len(topic.gaps)) if topic.counts else "-",
                f"{topic.gaps[0].length_s:.3f}" if topic.gaps else "-",
                f"{topic.log_delay_s[1] * 1e3:.2f}" if topic.log_delay_s else "-",
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(
            cell.ljust(width) if column < 3 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _notes(topic: TopicInfo) -> list[str]:
    """Everything about a topic that someone should look at."""
    notes = list(topic.problems)
    if topic.counts:
        found = {
            "repeat a stamp": topic.counts.duplicate,
            "hold a NaN or infinity": topic.counts.nonfinite,
            "bear a stamp that cannot be right; they are left out": topic.counts.misdated,
            "cannot be decoded": topic.counts.undecodable,
        }
        notes += [f"{count} of {topic.messages} messages {what}" for what, count in found.items() if count]
    if topic.gaps:
        shown = ", ".join(f"{gap.length_s:.2f} s at {gap.start_s:.2f} s" for gap in topic.gaps[:3])
        notes.append(f"gaps above {GAP:.0f} median intervals: {len(topic.gaps)}; longest: {shown}")
    return notes


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def _duration(value_s: float) -> str:
    """Seconds in a unit that reads well."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("s", 1.0)):
        if value_s >= size:
            return f"{value_s / size:.1f} {unit}"
    return f"{value_s * 1e3:.1f} ms"


def _utc(t_ns: int) -> str:
    return np.datetime_as_string(np.datetime64(t_ns, "ns"), unit="ms").replace("T", " ") + " UTC"
