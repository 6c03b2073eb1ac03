"""Allan variance of a standing IMU: its white noise, the instability of its bias and its random walk.

IEEE Std 952-1997, annex C; overlapping estimate. For samples that are means over their period, in unit and s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from tbmfg.errors import LogError
from tbmfg.fields import DEG, MICRO_G
from tbmfg.inertial.alignment import rows_between, still_intervals
from tbmfg.inertial.steps import Steps
from tbmfg.rig import Imu
from tbmfg.timeseries import Floats

FEWEST = 9  # independent averages of the longest averaging time
PER_OCTAVE = 3
SHORTEST_S = 10.0  # of a stretch that says anything of a bias
SEEN = 0.1  # least share that a term has in the variance at some averaging time; below, it is not seen


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of one triad, rms over its axes: white ``density`` [unit/sqrt(Hz)], bias ``instability`` [unit] and random
    ``walk`` of the bias [unit/sqrt(s)], None where the stretch is too short or too noisy to show it."""

    density: float | None
    instability: float | None
    walk: float | None
    relative_sd: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the three, as a share of each


@dataclass(frozen=True, slots=True)
class Static:
    """Gyro and accelerometer over the standing stretch ``start_s`` to ``end_s`` since the log's first IMU sample."""

    start_s: float
    end_s: float
    gyro: Noise
    acc: Noise


def static(steps: Steps) -> Static:
    """From the longest still stretch. Raises LogError where there is none of ``SHORTEST_S``."""
    still = still_intervals(steps)
    longest = max(still, key=lambda s: s[1] - s[0], default=(0.0, 0.0))
    if longest[1] - longest[0] < SHORTEST_S:
        raise LogError(
            f"no Allan variance: the IMU is never still for {SHORTEST_S:g} s (the longest stretch has "
            f"{longest[1] - longest[0]:.1f} s); record the machine standing, engines off, for an hour"
        )
    rows = rows_between(steps, *longest)
    return Static(*longest, noise(steps.gyro[rows], steps.period_s), noise(steps.acc[rows], steps.period_s))


def against_rig(found: Static, imu: Imu) -> list[tuple[str, float | None, float | None, float | None]]:
    """(key of the rig, what was found, its sd, what the rig has) in the rig's units; bias instability has no key."""
    gyro, acc = found.gyro, found.acc
    return [
        ("gyro_density_dps_rthz", *_in(gyro, 0, DEG), imu.gyro_density_dps_rthz),
        ("gyro bias instability, deg/s", *_in(gyro, 1, DEG), None),
        ("gyro_walk", *_in(gyro, 2), imu.gyro_walk),
        ("acc_density_ug_rthz", *_in(acc, 0, MICRO_G), imu.acc_density_ug_rthz),
        ("acc bias instability, m/s^2", *_in(acc, 1), None),
        ("acc_walk", *_in(acc, 2), imu.acc_walk),
    ]


def _in(noise: Noise, which: int, unit: float = 1.0) -> tuple[float | None, float | None]:
    """One of the figures of a triad and its sd."""
    value = (noise.density, noise.instability, noise.walk)[which]
    return (None, None) if value is None else (value / unit, value / unit * noise.relative_sd[which])


def variance(samples: Floats, period_s: float) -> tuple[Floats, Floats]:
    """Averaging times (m,) s and the Allan variance there, mean over the axes of ``samples`` (n, k), (m,)."""
    n = len(samples)
    octaves = np.log2(max(n // FEWEST, 1))
    sizes = np.unique(np.round(2.0 ** np.arange(0.0, octaves + 1e-9, 1.0 / PER_OCTAVE)).astype(int))
    total = np.concatenate([np.zeros((1, samples.shape[1])), np.cumsum(samples - samples.mean(axis=0), axis=0)])
    found = []
    for m in sizes:
        change = total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m]
        found.append(np.mean(change**2) / (2.0 * m**2))
    return sizes * period_s, np.array(found)


def noise(samples: Floats, period_s: float) -> Noise:
    """Fit of N^2/tau + 2 ln 2/pi B^2 + K^2 tau/3, and of Q^2/tau^2, which takes up vibration and rounding.

    Non-negative least squares on the relative error; the longer the averaging time, the fewer averages there are. The
    sds are those of the fit from Allan deviations known to 1 / sqrt(2 (n / m - 1)) of themselves, by n samples on each
    axis in averages of m (IEEE Std 952-1997, C.1.7), of which those less than two octaves apart go together.
    """
    tau, found = variance(samples, period_s)
    terms = np.stack([1.0 / tau, np.full(len(tau), 2.0 * np.log(2.0) / np.pi), tau / 3.0, 1.0 / tau**2], axis=1)
    weight = np.sqrt(len(samples) * period_s / tau) / np.maximum(found, np.finfo(float).tiny)
    scale = np.max(terms, axis=0)
    share, _ = nnls(terms / scale * weight[:, None], found * weight)
    parts = share / scale * terms
    seen = (parts > SEEN * parts.sum(axis=1, keepdims=True)).any(axis=0)
    sizes = np.sqrt(share / scale)
    octaves = np.log2(tau / tau[0])
    error = found * np.sqrt(2.0 / ((len(samples) * period_s / tau - 1.0) * samples.shape[1]))
    shared = np.maximum(1.0 - 0.5 * np.abs(octaves[:, None] - octaves), 0.0)
    active = share > 0
    gain = np.linalg.pinv((terms / scale * weight[:, None])[:, active]) * (weight * error)
    relative = np.zeros(len(share))
    relative[active] = 0.5 * np.sqrt(np.einsum("ki,ij,kj->k", gain, shared, gain)) / share[active]
    figures = (float(size) if shown else None for size, shown in zip(sizes[:3], seen[:3], strict=True))
    return Noise(*figures, relative_sd=tuple(relative[:3].tolist()))
