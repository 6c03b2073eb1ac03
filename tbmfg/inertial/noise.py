"""How noisy the IMU is on this machine, from its own samples."""

from __future__ import annotations

import numpy as np
from scipy.signal import welch

from tbmfg.inertial.steps import Steps
from tbmfg.timeseries import Floats

SEGMENT = 256  # samples per periodogram
BANDS = 16


def spectral_floor(steps: Steps) -> tuple[float, float]:
    """Density of the quietest band of the spectrum: gyro [rad/s/sqrt(Hz)], accelerometer [m/s^2/sqrt(Hz)].

    White noise, and the vibration that aliases into it, fills all frequencies alike; motion does not. So the
    quietest of 16 bands bounds the white noise from above, and on a machine it is what a data sheet leaves out.
    Two-sided density, RMS over the axes; medians over segments (Welch), so that a few shocks do not count.
    """
    return _floor(steps.gyro, steps.period_s), _floor(steps.acc, steps.period_s)


def _floor(samples: Floats, period_s: float) -> float:
    length = min(SEGMENT, len(samples))
    _, psd = welch(samples, 1.0 / period_s, nperseg=length, axis=0, detrend="linear", average="median")
    width = max(1, (len(psd) - 1) // BANDS)
    bands = psd[1 : 1 + width * ((len(psd) - 1) // width)].reshape(-1, width, 3).mean(axis=(1, 2))
    return float(np.sqrt(bands.min() / 2.0))
