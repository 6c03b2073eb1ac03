"""How noisy the IMU is on this machine, from its own samples."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tbmfg.inertial.steps import Steps
from tbmfg.timeseries import Floats

SEGMENT = 256  # samples per periodogram
BANDS = 16
AT_ONCE = 1024  # segments: what is in memory beside the spectra


def spectral_floor(steps: Steps) -> tuple[float, float]:
    """Density of the quietest band of the spectrum: gyro [rad/s/sqrt(Hz)], accelerometer [m/s^2/sqrt(Hz)].

    White noise, and the vibration that aliases into it, fills all frequencies alike; motion does not. So the
    quietest of 16 bands bounds the white noise from above, and on a machine it is what a data sheet leaves out.
    Two-sided density, RMS over the axes; medians over segments (Welch), so that a few shocks do not count.
    """
    return _floor(steps.gyro, steps.period_s), _floor(steps.acc, steps.period_s)


def _floor(samples: Floats, period_s: float) -> float:
    length = min(SEGMENT, len(samples))
    psd = spectrum(samples, period_s, length)
    width = max(1, (len(psd) - 1) // BANDS)
    bands = psd[1 : 1 + width * ((len(psd) - 1) // width)].reshape(-1, width, 3).mean(axis=(1, 2))
    return float(np.sqrt(bands.min() / 2.0))


def spectrum(samples: Floats, period_s: float, length: int) -> Floats:
    """One-sided density (length // 2 + 1, axes) [unit^2/Hz] of ``samples`` (n, axes) by Welch's method: segments that
    overlap by half, each without its straight line, under a Hann window, and their median.

    As ``scipy.signal.welch`` with these options, which fits every segment's line by a least squares of its own.
    """
    segments = sliding_window_view(samples, length, axis=0)[:: length - length // 2]  # (segments, axes, length)
    line, _ = np.linalg.qr(np.vander(np.arange(length), 2))
    window = np.sin(np.pi * np.arange(length) / length) ** 2
    power = np.empty((*segments.shape[:2], length // 2 + 1))
    for start in range(0, len(segments), AT_ONCE):
        part = segments[start : start + AT_ONCE]
        power[start : start + AT_ONCE] = np.abs(np.fft.rfft((part - part @ line @ line.T) * window)) ** 2
    power[:, :, 1 : (length + 1) // 2] *= 2.0
    # the median of n independent exponentials, of mean one, is 1 - 1/2 + 1/3 - ... + 1/n, n odd
    odd = 2 * ((len(segments) - 1) // 2) + 1
    bias = np.sum((-1.0) ** np.arange(odd) / np.arange(1, odd + 1))
    return np.median(power, axis=0).T * period_s / np.sum(window**2) / bias
