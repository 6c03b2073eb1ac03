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
LONGEST_PERIODS = 3.0  # a scan does not last longer than this many periods
MOST_ASTRAY = 0.25  # share of the points that may lie apart from the others in time: beyond, who is to say which do


@dataclass(slots=True)
class Scan:
    """Points (n, 3) m in the LiDAR's axes, their times (n,) s after the header stamp or None where they tell nothing.

    ``nonfinite``, ``zero`` and ``beyond`` points (out of range) were left out, and ``astray`` ones, whose times are
    periods from all others; ``fault`` says what is wrong with times.
    """

    t_ns: int
    points: Floats
    after_s: Floats | None
    nonfinite: int
    zero: int
    beyond: int
    astray: int = 0
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
    finite = np.isfinite(points).all(axis=1)
    square = np.einsum("ni,ni->n", points, points)
    zero = finite & (square == 0.0)
    inside = (square >= sensor.min_range**2) & (square <= sensor.max_range**2)
    keep = np.flatnonzero(finite & ~zero & inside)
    scan = Scan(t_ns, points[keep], None, int((~finite).sum()), int(zero.sum()), int((finite & ~zero & ~inside).sum()))
    name = sensor.time_field or next((field for field in TIME_FIELDS if field in fields), None)
    if name is None:
        return scan
    if name not in fields:
        raise LogError(f"{sensor.topic}: no field {name} in the cloud; there are {', '.join(fields)}")
    with np.errstate(over="ignore", invalid="ignore"):  # garbage may be 1e308
        _give_times(scan, fields[name][keep], sensor, period_s)
    return scan


def _give_times(scan: Scan, raw: NDArray, sensor: Lidar, period_s: float) -> None:
    """The times of its points to a scan, and leave out points without one; or say what is wrong with them all."""
    values = raw.astype(float)
    finite = np.isfinite(values)
    own = np.unique(values[finite])
    if len(own) < 2:
        scan.fault = "" if not len(raw) else "all points have one time" if len(own) else "no finite times"
        return
    if sensor.time_unit == "auto":
        spread = 2.0 * np.subtract(*np.percentile(own, (75, 25)))
        unit = min(UNITS.values(), key=lambda u: abs(np.log(spread * u / period_s)))
    else:
        unit = UNITS[sensor.time_unit]
    first, last = _bulk(own, period_s / unit)
    among = finite & (values >= first) & (values <= last)
    astray = int(finite.sum() - among.sum())
    if astray > MOST_ASTRAY * finite.sum() or not (last - first) * unit <= LONGEST_PERIODS * period_s:
        scan.fault = f"times span {np.ptp(own) * unit:.3g} s of a period of {period_s:.3g} s"
        return
    if first == last:
        scan.fault = "all points have one time"
        return
    scan.after_s = _after_stamp(scan.t_ns, raw[among], unit, LONGEST_PERIODS * period_s)
    scan.points, scan.astray = scan.points[among], astray
    scan.nonfinite += int((~finite).sum())


def _bulk(own: Floats, period: float) -> tuple[float, float]:
    """First and last of the sorted times that are tied to the middle one by steps no longer than a period."""
    breaks, middle = np.flatnonzero(np.diff(own) > period), len(own) // 2
    k = np.searchsorted(breaks, middle)
    return own[breaks[k - 1] + 1 if k else 0], own[breaks[k] if k < len(breaks) else -1]


def _after_stamp(t_ns: int, raw: NDArray, unit: float, longest_s: float) -> Floats:
    """Times in ``unit`` to s after the header stamp, whichever clock and start they count from."""
    first = raw.min()
    if abs(float(first)) * unit <= longest_s:
        return raw.astype(float) * unit
    # absolute times: integers keep their nanoseconds; those of another clock begin at the stamp
    if np.issubdtype(raw.dtype, np.integer):
        whole, rest_ns = divmod(t_ns, round(unit * NS))
        after_s = (raw.astype(np.int64) - whole) * unit - rest_ns / NS
    else:
        after_s = raw.astype(float) * unit - t_ns / NS
    if abs(after_s.min()) > longest_s:
        return (raw - first).astype(float) * unit
    return after_s
