"""Inertial enhancement: vibration taken out of the samples by empirical mode decomposition, tilt held by gravity.

Liu, Wang & Tao (TBM-MSE), section 2, corrected; (n) are its equations, E its errata. Its z axes point down; here they
point up, so what it calls the predicted down, -C f / |f|, is up with the other sign.

A mode's middle is that of its envelopes, which for a waveform that is steeper on one side is not its mean: the modes of
a pump take some of the slow rate with them, many times the Earth's. So what was taken away is averaged over a window
and given back: beyond the paper, ``give_back``. And smoothed samples are no longer the truth plus white noise: what
was taken away may have been motion. Of that the filters are told as noise, see :func:`changed_density`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numba import njit

from tbmfg.fields import DEG, MICRO_G
from tbmfg.inertial.steps import Steps
from tbmfg.inertial.strapdown import exp_rotation
from tbmfg.rig import Enhancement
from tbmfg.timeseries import Floats

Rule = Literal["noise", "kept"]

GAUSS = 0.6745  # median of |x| over sd of a normal distribution
SAMPLE_HZ = 475.0  # the rate for which the correction's gain per sample is stated
SHORTEST = 16  # samples of a window that can be decomposed


@dataclass(frozen=True, slots=True)
class Changed:
    """What the decomposition did to the gyro [rad/s] and the accelerometer [m/s^2]: ``rms`` of the change per axis, and
    the white ``density`` [unit/sqrt(Hz)] that it leaves in the filters' model."""

    rms: tuple[float, float]
    density: tuple[float, float]
    window_s: float

    def __str__(self) -> str:
        (gyro, acc), (gyro_density, acc_density) = self.rms, self.density
        return (
            f"imu: enhanced by mode decomposition in windows of {self.window_s:g} s, so that an online estimate lags "
            f"by as much: {acc:.3g} m/s^2 and {gyro / DEG:.3g} deg/s rms taken away; what may have been motion of it "
            f"counts as noise of {acc_density / MICRO_G:.3g} ug and {gyro_density / DEG:.2g} deg/s per sqrt(Hz)"
        )


@dataclass(frozen=True, slots=True)
class Levelled:
    """What holding the tilt put into the gyro's rates [rad/s]: ``rms`` per axis, and the white ``density``."""

    rms: float
    density: float
    alpha_bar: float

    def __str__(self) -> str:
        return (
            f"imu: tilt held by gravity with alpha_bar {self.alpha_bar:g}: {self.rms / DEG:.2g} deg/s rms put into the "
            f"gyro's rates, counted as noise of {self.density / DEG:.2g} deg/s per sqrt(Hz); accelerating is taken for "
            "tilt"
        )


def denoise(steps: Steps, rule: Rule, window_s: float, give_back: bool = True) -> tuple[Steps, Changed]:
    """Steps with gyro and accelerometer :func:`enhanced`; their extra noise is that of :func:`changed_density`."""
    size = 2 * max(SHORTEST, round(0.5 * window_s / steps.period_s))
    gyro, acc = (enhanced(values, rule, size, give_back) for values in (steps.gyro, steps.acc))
    parts = gyro - steps.gyro, acc - steps.acc
    density = tuple(changed_density(part, steps.period_s, size) for part in parts)
    found = replace(
        steps, gyro=gyro, acc=acc,
        extra_gyro=steps.extra_gyro + density[0] ** 2, extra_acc=steps.extra_acc + density[1] ** 2,
    )  # fmt: skip
    return found, Changed(tuple(float(np.sqrt(np.mean(part**2))) for part in parts), density, window_s)


def enhanced(x: Floats, rule: Rule, size: int, give_back: bool) -> Floats:
    """x (n, k) through :func:`smooth`, column by column, and the running mean of what that took away."""
    out = np.stack([smooth(column, rule, size) for column in x.T], axis=1)
    return out + running_mean(x - out, size) if give_back else out


def smooth(x: Floats, rule: Rule, size: int) -> Floats:
    """x (n,) through :func:`threshold` in windows of ``size`` samples, each half over the next and faded into it.

    A value is final when the last window that holds it is full: the step is not causal, it lags by up to a window.
    """
    half = size // 2
    fade = hann(size)
    total, weight = np.zeros(len(x)), np.zeros(len(x))
    for first in range(-half, len(x), half):
        begin, end = max(first, 0), min(first + size, len(x))
        if end - begin < SHORTEST:
            continue
        share = fade[begin - first : end - first]
        total[begin:end] += share * threshold(x[begin:end], rule)
        weight[begin:end] += share
    return np.where(weight > 0, total / np.where(weight > 0, weight, 1.0), x)


def running_mean(x: Floats, size: int) -> Floats:
    """Mean of x (n, k) about each sample under a Hann window of ``size`` samples, shorter at the ends."""
    from scipy.signal import fftconvolve  # slow to import, and few rigs ask for it

    window = hann(size)[:, None]
    return fftconvolve(x, window, "same", axes=0) / fftconvolve(np.ones((len(x), 1)), window, "same", axes=0)


def hann(size: int) -> Floats:
    """The window, (size,): halves that overlap add to one."""
    return np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2


def threshold(x: Floats, rule: Rule) -> Floats:
    """(1)-(7): one window without its noise. ``noise``: of the modes faster than the one of least energy only what
    stands out is kept (E3); ``kept``: those are dropped and the others thresholded, as printed."""
    from tbmfg.inertial.modes import modes as decomposed

    modes, rest = decomposed(x)
    if len(modes) < 2:
        return x
    M = int(np.argmin(np.mean(modes[:-1] ** 2, axis=1)))  # (2), (3): the mode of least energy (E1)
    if rule == "kept":
        return sum(map(intervals, modes[M:]), rest)
    return sum(map(intervals, modes[:M]), modes[M:].sum(axis=0) + rest)


def intervals(mode: Floats) -> Floats:
    """(5)-(7): soft threshold of the oscillations of a mode (n,), each between zero crossings, by its peak."""
    T = np.median(np.abs(mode)) / GAUSS * np.sqrt(2.0 * np.log(len(mode)))
    starts = np.concatenate([[0], np.flatnonzero(np.signbit(mode[1:]) != np.signbit(mode[:-1])) + 1])
    peak = np.maximum.reduceat(np.abs(mode), starts)
    share = np.where(peak > T, 1.0 - T / np.maximum(peak, np.finfo(float).tiny), 0.0)
    return mode * np.repeat(share, np.diff(np.append(starts, len(mode))))


def changed_density(change: Floats, period_s: float, size: int) -> float:
    """White density, unit/sqrt(Hz), rms over the axes, of what a change (n, 3) of the samples does in the long run.

    A filter integrates its samples; vibration that was taken away integrates to nothing, motion and noise do not. Means
    under a Hann window of ``size`` samples keep what is slower than that, and S sum(w^2) dt / (sum(w) dt)^2 is their
    variance for a white noise of density S.
    """
    size = min(size, len(change))
    window = hann(size)
    firsts = range(0, len(change) - size + 1, max(1, size // 2))
    means = np.array([window @ change[first : first + size] for first in firsts]) / window.sum()
    return float(np.sqrt(np.mean(means**2) * window.sum() ** 2 * period_s / np.sum(window**2)))


# ---- tilt ----


def level(
    steps: Steps, gyro: Floats, acc: Floats, R_start: Floats, bias_gyro: Floats, earth_n: Floats, g: float,
    wanted: Enhancement,
) -> tuple[Steps, Floats, Levelled]:  # fmt: skip
    """Steps with the noise that :func:`gravity_correction` leaves in the filters' model, ``gyro`` with its rates."""
    rates = gravity_correction(steps, gyro, acc, R_start, bias_gyro, earth_n, g, wanted.alpha_bar)
    density = changed_density(rates, steps.period_s, max(1, round(wanted.window / steps.period_s)))
    told = Levelled(float(np.sqrt(np.mean(rates**2))), density, wanted.alpha_bar)
    return replace(steps, extra_gyro=steps.extra_gyro + density**2), gyro + rates, told


def gravity_correction(
    steps: Steps, gyro: Floats, acc: Floats, R_start: Floats, bias_gyro: Floats, earth_n: Floats, g: float, gain: float
) -> Floats:
    """(13)-(15): rates [rad/s] (n, 3), to be added to ``gyro``, that turn the attitude by a share of the angle between
    the specific force and the vertical, from ``R_start`` at the first edge on.

    ``gyro``, ``acc`` (n, 3) are compensated; ``gain`` is the share per sample of 475 Hz while |f| is gravity (E8; 1: as
    printed). Heading is not touched. The Earth's rate is in the attitude (E5): else it would be corrected away.
    """
    return _gravity_correction(steps.dt, gyro - bias_gyro, acc, R_start, earth_n, g, gain)


@njit(cache=True)
def _gravity_correction(dt, gyro, acc, R_start, earth_n, g, gain):
    out = np.empty_like(gyro)
    R = R_start.copy()
    for k in range(len(gyro)):
        R = exp_rotation(-earth_n * dt[k]) @ R @ exp_rotation(gyro[k] * dt[k])
        size = np.sqrt(np.sum(acc[k] ** 2))
        up = R @ acc[k] / max(size, 1e-9)
        e = np.abs(size - g) / g  # (14) with E7
        share = 1.0 - (1.0 - gain * 0.991 / (1.0 + np.exp((2500.0 * e - 370.0) / 40.0))) ** (dt[k] * SAMPLE_HZ)  # (13)
        sine = np.sqrt(up[0] ** 2 + up[1] ** 2)
        # (15) on the global attitude (E9): about up x z, which has no vertical part
        turn = share * np.arctan2(sine, up[2]) / max(sine, 1e-15) * np.array([up[1], -up[0], 0.0])
        R = exp_rotation(turn) @ R
        out[k] = R.T @ turn / dt[k]
    return out
