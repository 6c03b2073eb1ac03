"""From the fields of a PointCloud2 to points with times: whichever fields and units a driver writes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tbmfg.errors import LogError
from tbmfg.rig import Lidar
from tbmfg.timeseries import NS, Floats

TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
EPOCH_S = 1e7  # times beyond four months are no offsets from a scan's start
LONGEST_PERIODS = 3.0  # a scan does not last longer than this many periods


@dataclass(slots=True)
class Scan:
    """Points (n, 3) m in the LiDAR's axes, their times (n,) s after the header stamp or None where they tell nothing.

    ``nonfinite``, ``zero`` and ``beyond`` points (out of range) were left out; ``fault`` says what is wrong with times.
    """

    t_ns: int
    points: Floats
    after_s: Floats | None
    nonfinite: int
    zero: int
    beyond: int
    fault: str = ""


@dataclass(frozen=True, slots=True)
class Scans:
    """The scans of one LiDAR that are to be used, read from the log one by one in every iteration.

    ``start_s`` (n,) are the true times of all header stamps, ``wanted`` (n,) which of them to read, ``period_s`` the
    usual time between them. Yields the time of the stamp and the scan; raises LogError as :func:`read`.
    """

    sensor: Lidar
    source: Iterable[tuple[int, dict[str, NDArray]]] = field(repr=False)
    start_s: Floats
    wanted: NDArray
    period_s: float

    def __len__(self) -> int:
        return int(self.wanted.sum())

    def __iter__(self) -> Iterator[tuple[float, Scan]]:
        for k, (t_ns, fields) in enumerate(self.source):
            if self.wanted[k]:
                yield float(self.start_s[k]), read(t_ns, fields, self.sensor, self.period_s)


def read(t_ns: int, fields: dict[str, NDArray], sensor: Lidar, period_s: float) -> Scan:
    """One cloud; ``period_s`` is the usual time between scans, which tells the unit of the points' own times.

    Raises LogError where the fields are not those of a cloud, or the rig names one that it has not.
    """
    if not {"x", "y", "z"} <= fields.keys():
        raise LogError(f"{sensor.topic}: a cloud without x, y and z; its fields are {', '.join(fields) or 'none'}")
    points = np.column_stack([fields[axis] for axis in "xyz"]).astype(float)
    after_s, fault = _times(t_ns, fields, sensor, period_s)
    finite = np.isfinite(points).all(axis=1)
    if after_s is not None:
        finite &= np.isfinite(after_s)
    square = np.einsum("ni,ni->n", points, points)
    zero = finite & (square == 0.0)
    inside = (square >= sensor.min_range**2) & (square <= sensor.max_range**2)
    keep = finite & ~zero & inside
    return Scan(
        t_ns, points[keep], None if after_s is None else after_s[keep],
        int((~finite).sum()), int(zero.sum()), int((finite & ~zero & ~inside).sum()), fault,
    )  # fmt: skip


def _times(t_ns: int, fields: dict[str, NDArray], sensor: Lidar, period_s: float) -> tuple[Floats | None, str]:
    """Times of the points after the header stamp, or None and why."""
    name = sensor.time_field or next((field for field in TIME_FIELDS if field in fields), None)
    if name is None:
        return None, ""
    if name not in fields:
        raise LogError(f"{sensor.topic}: no field {name} in the cloud; there are {', '.join(fields)}")
    raw = fields[name]
    values = raw.astype(float)
    finite = values[np.isfinite(values)]
    if len(finite) < 2:
        return None, "no finite times"
    first, span = finite.min(), np.ptp(finite)
    if span == 0.0:
        return None, "all points have one time"
    if sensor.time_unit == "auto":
        unit = min(UNITS.values(), key=lambda u: abs(np.log(span * u / period_s)))
    else:
        unit = UNITS[sensor.time_unit]
    if not span * unit <= LONGEST_PERIODS * period_s:
        return None, f"times span {span * unit:.3g} s of a period of {period_s:.3g} s"
    if abs(first) * unit < EPOCH_S and abs(first) * unit <= LONGEST_PERIODS * period_s:
        return values * unit, ""
    # absolute times: integers keep their nanoseconds; those of another clock begin at the stamp
    if np.issubdtype(raw.dtype, np.integer):
        whole, rest_ns = divmod(t_ns, round(unit * NS))
        after_s = (raw.astype(np.int64) - whole) * unit - rest_ns / NS
    else:
        after_s = values * unit - t_ns / NS
    if abs(np.nanmin(after_s)) > LONGEST_PERIODS * period_s:
        return (values - first) * unit, ""
    return after_s, ""
