"""Columns of samples in time order, and the log that holds them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class StreamCounts:
    """What happened to the messages of one topic while they were read.

    ``received`` messages were decoded; of these ``duplicate`` repeated a stamp, ``disordered`` came with
    a stamp before their predecessor's (kept, sorted), ``nonfinite`` held a NaN or infinity, and the stamp of
    ``misdated`` ones is not to be believed. Duplicates, non-finite and misdated rows are not in the series.
    ``undecodable`` never became rows. ``first_ns`` holds the stamp of the first of each that has one, by name.
    """

    received: int = 0
    duplicate: int = 0
    disordered: int = 0
    nonfinite: int = 0
    misdated: int = 0
    undecodable: int = 0
    first_ns: dict[str, int] = field(default_factory=dict, compare=False)


@dataclass(frozen=True, slots=True)
class Series:
    """Samples of one topic, sorted by header stamp, stamps unique.

    ``t_ns`` (n,) int64 header stamps; ``columns`` name -> (n,) or (n, k) float64 in SI units and in
    the axes of the message; ``type`` the ROS name, such as ``sensor_msgs/msg/Imu``.
    """

    topic: str
    type: str
    t_ns: Times
    columns: dict[str, Floats]
    frame_id: str = ""
    child_frame_id: str = ""
    counts: StreamCounts = field(default_factory=StreamCounts)

    def __len__(self) -> int:
        return len(self.t_ns)

    def __getitem__(self, column: str) -> Floats:
        return self.columns[column]

    def select(self, rows: NDArray) -> Series:
        """The same series with only these rows (index array or mask)."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        return Series(self.topic, self.type, self.t_ns[rows], columns, self.frame_id, self.child_frame_id, self.counts)


class Clouds(Protocol):
    """Scans of one topic, decoded one at a time: they are never all in memory."""

    topic: str
    t_ns: Times
    frame_id: str
    counts: StreamCounts

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[tuple[int, dict[str, NDArray]]]: ...


@dataclass(frozen=True, slots=True)
class Transform:
    """A static transform from /tf_static: ``parent`` <- ``child``."""

    parent: str
    child: str
    xyz: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Log:
    """A recording: series by topic, clouds by topic (lazy), and what was lost on the way.

    ``unknown`` maps each topic that was skipped to its type, ``unread`` those that were not asked for; ``damage``
    holds one line for every part of the file that could not be read.
    """

    path: str
    series: dict[str, Series]
    clouds: dict[str, Clouds] = field(default_factory=dict)
    transforms: tuple[Transform, ...] = ()
    attachments: dict[str, bytes] = field(default_factory=dict)
    unknown: dict[str, str] = field(default_factory=dict)
    damage: tuple[str, ...] = ()
    unread: dict[str, str] = field(default_factory=dict)


def seconds(t_ns: Times, origin_ns: int) -> Floats:
    """Float seconds since ``origin_ns``: the only way from stamps to floats."""
    return (np.asarray(t_ns, dtype=np.int64) - np.int64(origin_ns)) * 1e-9
