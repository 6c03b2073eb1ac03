"""What odometers, magnetometers, barometers and lasers say against their own health: before estimating, and so for
every estimator alike.

Each check returns which samples are sound, (n,) bool, and a line for every fault that it has found.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from tbmfg.fields import MICRO_TESLA, MM, STANDARD_GRAVITY
from tbmfg.measure import Samples
from tbmfg.rig import Barometer, Laser, Magnetometer, Odometer, Sensor
from tbmfg.timeseries import Floats

FASTEST = 5 * STANDARD_GRAVITY  # m/s^2: no machine's speed changes faster; an encoder's that rolls over does
NOISE = 10.0  # sds of an odometer's noise that are no jump either
STUCK = 10  # readings in a row that are equal to the last digit
CHANCE = 1e-3  # with which readings that do not hang would repeat as long
PILE = 3  # times as many readings at the end of the scale as at the next value inside: noise thins out, limits do not
HUNG_S = 2.0  # for longer than this no spot stays the same to the last digit
EDGE = 1e-3  # of the detector's half width: a spot that near its edge, or beyond, is not on it
LEVELS = 10  # different readings from which an axis shows how noise thins out

Sound = tuple[NDArray[np.bool_], list[str]]


def check(sensor: Sensor, samples: Samples) -> Sound:
    """The check of this kind of sensor; sensors without one are sound."""
    if isinstance(sensor, Odometer):
        return odometer(samples.t_s, samples.values, sensor.sigma)
    if isinstance(sensor, Magnetometer):
        return magnetometer(samples.t_s, samples.values)
    if isinstance(sensor, Barometer):
        return barometer(samples.t_s, samples.values)
    if isinstance(sensor, Laser):
        return laser(samples.t_s, samples.values, sensor.half_width)
    return np.ones(len(samples.t_s), dtype=bool), []


def odometer(t_s: Floats, speed: Floats, sigma: float) -> Sound:
    """Leaves out speeds (n,) that jump, and those of an encoder that hangs on one. What cannot be told from zero may
    repeat for long: the machine stands."""
    hung, said = hangs(t_s, speed, np.abs(speed) < sigma)
    moving, jumps = _jumps(t_s, speed, sigma)
    return ~hung & moving, [*said, *jumps]


def _jumps(t_s: Floats, speed: Floats, sigma: float) -> Sound:
    """Leaves out speeds (n,) far from the median of the five about them: an encoder's roll-over, a broken message.

    None where most are so: then the unit is wrong, or the clock.
    """
    if len(speed) < 5:
        return np.ones(len(speed), dtype=bool), []
    around = np.median(sliding_window_view(np.pad(speed, 2, mode="reflect"), 5), axis=1)
    period = np.median(np.diff(t_s))
    wrong = np.abs(speed - around) > 2 * period * FASTEST + NOISE * sigma
    if not wrong.any() or 2 * wrong.sum() >= len(wrong):
        return np.ones(len(speed), dtype=bool), []
    worst = np.argmax(np.abs(speed - around))
    return ~wrong, [
        f"{wrong.sum()} of {len(speed)} speeds jump as no machine can, at {t_s[worst]:.1f} s from {around[worst]:.3g} "
        f"to {speed[worst]:.4g} m/s and back (an encoder that rolls over?); left out"
    ]


def magnetometer(t_s: Floats, field: Floats) -> Sound:
    """Leaves out fields (n, 3) that repeat to the last digit, but the first, and those at the end of an axis's scale.

    A reading with noise does not repeat. An axis that never changes while the others do is said and kept.
    """
    sound, said = np.ones(len(field), dtype=bool), []
    same = np.concatenate([[False], (np.diff(field, axis=0) == 0).all(axis=1)])
    hung = np.zeros(len(field), dtype=bool)
    longest = (0, 0)
    for first, last in _runs(same):
        if last - first >= STUCK - 1:
            hung[first:last] = True
            longest = max(longest, (first, last), key=lambda run: run[1] - run[0])
    if hung.any():
        sound &= ~hung
        said.append(
            f"hangs on one reading: {hung.sum()} of {len(field)} samples repeat the one before, the longest time from "
            f"{t_s[longest[0] - 1]:.1f} to {t_s[longest[1] - 1]:.1f} s; left out"
        )
    for axis, name in enumerate("xyz"):
        values, counts = np.unique(field[~hung, axis], return_counts=True)
        if len(values) == 1 and len(field) > STUCK and not hung.any():
            said.append(
                f"its {name} axis reads {values[0] / MICRO_TESLA:.4g} uT in all {len(field)} samples: dead or at the "
                "end of its scale; unless the field has no such part, leave the sensor out"
            )
        for end, inner in ((0, 1), (-1, -2)):
            if len(values) < LEVELS or counts[end] < STUCK or counts[end] < PILE * counts[inner]:
                continue
            limit = (field[:, axis] == values[end]) & ~hung
            if max(last - first for first, last in _runs(limit)) >= STUCK:
                sound &= ~limit
                said.append(
                    f"its {name} axis is at the end of its scale, {values[end] / MICRO_TESLA:.4g} uT, in {limit.sum()} "
                    f"of {len(field)} samples, the first at {t_s[np.argmax(limit)]:.1f} s; left out"
                )
    return sound, said


def barometer(t_s: Floats, height: Floats) -> Sound:
    """Leaves out all heights (n,) where they are one, and those on which it hangs: one that is read faster than it
    converts repeats some."""
    if len(height) < STUCK or np.ptp(height) > 0:
        hung, said = hangs(t_s, height, np.zeros(len(height), dtype=bool))
        return ~hung, said
    return np.zeros(len(height), dtype=bool), [
        f"all {len(height)} samples are the same, {height[0]:.2f} m in the standard atmosphere: it is stuck; left out"
    ]


def hangs(t_s: Floats, values: Floats, resting: NDArray[np.bool_]) -> Sound:
    """The readings (n,) in the longest run that repeats to the last digit, but its first, where it is longer than the
    other readings explain; and a line. Runs of ``resting`` readings are none.

    With a share p of repeats outside the run, one as long as r comes about n p^r times by chance.
    """
    repeats = np.concatenate([[False], (np.diff(values) == 0) & ~resting[1:]])
    hung = np.zeros(len(values), dtype=bool)
    if not repeats.any():
        return hung, []
    first, last = max(_runs(repeats), key=lambda run: run[1] - run[0])
    run = last - first
    share = (repeats.sum() - run + 1) / (len(values) - run + 1)
    if run < STUCK or np.log(len(values)) + run * np.log(share) > np.log(CHANCE):
        return hung, []
    hung[first:last] = True
    return hung, [
        f"hangs on one reading: {run} of {len(values)} samples repeat the one before from {t_s[first - 1]:.1f} to "
        f"{t_s[last - 1]:.1f} s; left out"
    ]


def laser(t_s: Floats, spot: Floats, half_width: float | None) -> Sound:
    """Leaves out spots (n, 2) m beside the detector, and those after the first of a spot that hangs."""
    said, beside, hung = [], np.zeros(len(spot), dtype=bool), np.zeros(len(spot), dtype=bool)
    if half_width is not None:
        beside = (np.abs(spot) >= (1 - EDGE) * half_width).any(axis=1)
    if beside.any():
        said.append(
            f"the spot is at the detector's edge ({half_width / MM:g} mm) or beyond in {beside.sum()} of {len(spot)} "
            f"samples, the first at {t_s[np.argmax(beside)]:.1f} s; left out"
        )
    for first, last in _runs(np.concatenate([[False], (np.diff(spot, axis=0) == 0).all(axis=1)])):
        hung[first:last] = last - first >= STUCK and t_s[last - 1] - t_s[first - 1] > HUNG_S
    hung &= ~beside
    if hung.any():
        said.append(
            f"the spot hangs: {hung.sum()} of {len(spot)} samples repeat the one before for over {HUNG_S:g} s on end, "
            f"the first at {t_s[np.argmax(hung)]:.1f} s; left out"
        )
    return ~(beside | hung), said


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First index and the one after the last of each stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
