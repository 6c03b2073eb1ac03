"""From IMU messages to integration steps: what each sample covers, and what stands in for lost ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tbmfg.errors import LogError
from tbmfg.timeseries import Floats, Series, Times, seconds

GAP = 1.5  # periods between stamps from which a sample counts as lost
MOST_LOST = 50  # lost samples for each one at hand from which the stamps are at fault


@dataclass(frozen=True, slots=True)
class Steps:
    """Contiguous integration steps of one IMU, in b axes.

    Step k covers ``edges_s[k] .. edges_s[k + 1]`` (seconds since ``t0_ns``) with mean angular rate
    ``gyro`` (n, 3) rad/s and mean specific force ``acc`` (n, 3) m/s^2. Steps that stand in for lost
    samples carry extra white noise: ``extra_gyro`` (n,) (rad/s)^2/Hz and ``extra_acc`` (n,) (m/s^2)^2/Hz.
    """

    t0_ns: int
    edges_s: Floats
    gyro: Floats
    acc: Floats
    extra_gyro: Floats
    extra_acc: Floats
    period_s: float
    gaps: tuple[tuple[float, float], ...]

    def __len__(self) -> int:
        return len(self.gyro)

    @property
    def dt(self) -> Floats:
        return np.diff(self.edges_s)

    def dt_of(self, rows: slice) -> Floats:
        """``dt`` of some steps, from one to another, without computing it for all."""
        return np.diff(self.edges_s[rows.start : rows.stop + 1])

    @property
    def end_s(self) -> float:
        return float(self.edges_s[-1])


def make_steps(imu: Series, R_bi: Floats, stamp: str) -> Steps:
    """Turn an IMU series into steps; ``stamp`` says where in its period a sample is stamped.

    Lost samples (dropped, or non-finite and removed by the reader) are replaced by interpolated
    steps whose extra noise is the error that the same interpolation makes where the data are known.
    """
    if len(imu) < 3:
        raise LogError(f"{imu.topic}: {len(imu)} usable IMU samples; at least 3 are needed; check the topic in the rig")
    t0_ns = int(imu.t_ns[0])
    t = seconds(imu.t_ns, t0_ns)
    spacing = np.diff(t)
    period = float(np.median(spacing))
    shift = {"end": 0.0, "centre": 0.5 * period, "start": period}[stamp]
    ends = t + shift
    gyro, acc = imu["gyro"] @ R_bi.T, imu["acc"] @ R_bi.T

    lost = np.flatnonzero(spacing > GAP * period)
    if len(lost) == 0:
        edges = np.concatenate([[ends[0] - period], ends])
        none = np.zeros(len(t))
        return Steps(t0_ns, edges, gyro, acc, none, none.copy(), period, ())

    missing = float(np.sum(spacing[lost])) / period
    if missing > MOST_LOST * len(imu):
        raise LogError(
            f"{imu.topic}: {len(imu)} samples a median {period:.3g} s apart, but for {t[-1]:.3g} s; stamps that come "
            "in bursts are times of arrival: record those of the measurement, or cut the log at its longest pause"
        )
    fill_t, gaps = [], []
    for k in lost:
        count = max(1, round(spacing[k] / period) - 1)
        # the known sample k + 1 keeps one period; the stretch before it is divided evenly
        fill_t.append(np.linspace(ends[k], ends[k + 1] - period, count + 1)[1:])
        gaps.append((float(ends[k]), float(ends[k + 1] - period)))
    filled = np.concatenate(fill_t)
    order = np.argsort(np.concatenate([ends, filled]), kind="stable")
    all_ends = np.concatenate([ends, filled])[order]
    columns = [np.stack([np.interp(all_ends, ends, v[:, a]) for a in range(3)], axis=1) for v in (gyro, acc)]
    extra = [np.zeros(len(all_ends)), np.zeros(len(all_ends))]
    for noise, known in zip(extra, (gyro, acc), strict=True):
        errors: dict[int, float] = {}  # by the number of samples lost
        for start, end in gaps:
            rows = slice(*np.searchsorted(all_ends, [start, end + 1e-9], side="right"))
            count = int(rows.stop - rows.start)
            if count not in errors:
                errors[count] = interpolation_error(known, count)
            # the error is taken as one constant over the gap: variance x length is its equivalent white density
            noise[rows] = errors[count] ** 2 * (end - start)
    edges = np.concatenate([[all_ends[0] - period], all_ends])
    return Steps(t0_ns, edges, columns[0], columns[1], extra[0], extra[1], period, tuple(gaps))


def interpolation_error(known: Floats, count: int) -> float:
    """RMS error per axis of replacing the mean of ``count`` samples by their two neighbours' mean."""
    count = min(count, max(1, len(known) // 3))
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(known, axis=0)])
    starts = np.arange(1, len(known) - count)
    mean = (total[starts + count] - total[starts]) / count
    error = mean - 0.5 * (known[starts - 1] + known[starts + count])
    return float(np.sqrt(np.mean(error**2))) if len(error) else float(np.std(known))


def compensate(steps: Steps, bias_gyro: Floats, bias_acc: Floats) -> tuple[Floats, Floats]:
    """Coning and sculling: rates that integrate exactly when taken as constant from the start of each step.

    Returns ``gyro`` and ``acc`` (n, 3): rotation vector per second, and velocity increment per second
    resolved at the step's start. Groves (2013) eqs. 5.84-5.98; tbm_mse (8), (11): with increments
    dth, dvl and those of the previous step,
    phi = dth + 1/12 dth' x dth,
    dv = dvl + 1/2 dth x dvl + 1/12 (dth' x dvl + dvl' x dth).
    The correction is computed at the given biases, which stay in the returned rates.
    """
    rate, force = steps.gyro - bias_gyro, steps.acc - bias_acc
    dt = steps.dt[:, None]
    previous_rate, previous_force = np.vstack([rate[:1], rate[:-1]]), np.vstack([force[:1], force[:-1]])
    gyro = steps.gyro + np.cross(previous_rate, rate) * dt / 12
    acc = (
        steps.acc
        + np.cross(rate, force) * dt / 2
        + (np.cross(previous_rate, force) + np.cross(previous_force, rate)) * dt / 12
    )
    return gyro, acc


def step_index(steps: Steps, t_s: Floats) -> np.ndarray:
    """Index of the step that contains each time, clipped to the steps at hand; int64 (n,)."""
    return np.clip(np.searchsorted(steps.edges_s, t_s, side="right") - 1, 0, len(steps) - 1)


def to_ns(steps: Steps, t_s: Floats) -> Times:
    """Stamps of times given in seconds since ``steps.t0_ns``."""
    return steps.t0_ns + np.round(np.asarray(t_s) * 1e9).astype(np.int64)
