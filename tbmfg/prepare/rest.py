"""Where the machine stands, and how much it shakes there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tbmfg.inertial import alignment
from tbmfg.inertial.steps import Steps
from tbmfg.measure import Samples, within
from tbmfg.rig import Odometer, PositionSensor, Rig
from tbmfg.timeseries import Floats

# rad/s: a mean rate that differs by more from that of the other still stretches is a steady turn, no bias: 0.06 deg/s
TURNING = 1e-3


@dataclass(frozen=True, slots=True)
class Rest:
    """Stretches (start, end) in s in which the machine stands, and the vibration there: rms of its speed [m/s] and of
    its angle [rad], per axis."""

    intervals: list[tuple[float, float]]
    speed: float
    angle: float


NONE = Rest([], 0.0, 0.0)


def find(rig: Rig, samples: dict[str, Samples], steps: Steps, still: list[tuple[float, float]]) -> Rest:
    """Rest in those of the inertially ``still`` stretches that nothing contradicts."""
    confirmed = _confirmed(rig, samples, steps, _unturning(steps, still))
    return Rest(confirmed, *(_vibration(steps, signal, confirmed) for signal in (steps.acc, steps.gyro)))


def sure(
    rig: Rig, samples: dict[str, Samples], steps: Steps, still: list[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Stretches in which a machine may be taken to feel the Earth's rate alone: confirmed rest, or all ``still`` ones
    where no sensor could confirm it. On an uneven floor slow driving looks still and turns a hundred times faster."""
    able = any(isinstance(rig.sensors[name], PositionSensor | Odometer) for name in samples)
    return _confirmed(rig, samples, steps, _unturning(steps, still)) if able else still


def _unturning(steps: Steps, still: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Stretches without those of a steady turn: their mean rate is not what the gyro shows in most of the others."""
    if not still:
        return []
    rates = np.array([steps.gyro[alignment.rows_between(steps, *stretch)].mean(axis=0) for stretch in still])
    weight = np.maximum(np.round([end - start for start, end in still]), 1).astype(int)
    usual = np.median(np.repeat(rates, weight, axis=0), axis=0)
    return [s for s, rate in zip(still, rates, strict=True) if np.linalg.norm(rate - usual) < TURNING]


def _confirmed(
    rig: Rig, samples: dict[str, Samples], steps: Steps, still: list[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Still stretches, cut to the time in which a position sensor or an odometer says that the machine stands.

    Within the block next to a motion it may have begun, at centimetres a second, without changing the block's mean by
    what is taken for noise: such a block is left out.
    """
    confirmed = []
    for start, end in still:
        opens, closes = steps.edges_s[0], steps.end_s - alignment.BLOCK_S  # blocks are whole: the last may be cut off
        for name, s in samples.items():
            sensor = rig.sensors[name]
            t = s.t_s - getattr(sensor, "clock_offset", 0.0)
            rows = within(t, start, end)
            count = rows.stop - rows.start
            if count < 3:
                continue
            values = s.values[rows]
            if isinstance(sensor, PositionSensor):
                spread = np.abs(values - np.median(values, axis=0)).max(axis=1)
                resting = bool(np.all(spread < 5.0 * s.sigma[rows].max(axis=1)))
            elif isinstance(sensor, Odometer):
                resting = bool(abs(np.mean(values)) < 3.0 * sensor.sigma / np.sqrt(count) + 1e-3)
            else:
                continue
            # the stamps' offset may be unknown: leave its spread free on either side
            margin = 3.0 * getattr(sensor, "clock_offset_sd", 0.0)
            first = float(t[rows][0]) + max(margin, alignment.BLOCK_S * (start > opens))
            last = float(t[rows][-1]) - max(margin, alignment.BLOCK_S * (end < closes))
            if resting and last > first:
                confirmed.append((first, last))
            break
    return confirmed


def _vibration(steps: Steps, signal: Floats, intervals: list[tuple[float, float]]) -> float:
    """RMS per axis of the integral of ``signal`` (n, 3), specific force or rate, while standing: what a standing
    machine's speed or attitude must be allowed."""
    squares = []
    for start, end in intervals:
        rows = alignment.rows_between(steps, start, min(end, start + 10.0))
        part = signal[rows]
        if len(part) < 10:
            continue
        v = np.cumsum((part - part.mean(axis=0)) * steps.dt_of(rows)[:, None], axis=0)
        # drift of the mean over a second is no vibration
        size = max(1, min(round(1.0 / steps.period_s), len(part)))
        smooth = np.stack([np.convolve(v[:, a], np.ones(size) / size, mode="same") for a in range(3)], axis=1)
        squares.append(np.mean((v - smooth)[size:-size] ** 2) if len(v) > 3 * size else np.mean((v - smooth) ** 2))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0
