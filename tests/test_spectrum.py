"""The IMU's spectrum, beside SciPy's of the same name."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import welch

from tbmfg.inertial.noise import AT_ONCE, spectrum


@pytest.mark.parametrize("length", [3, 255, 256])
@pytest.mark.parametrize("segments", [1.0, 1.5, 4.0, 0.6 * AT_ONCE])
def test_spectrum_is_that_of_scipy(length, segments):
    count = round(length * segments)
    samples = np.cumsum(np.random.default_rng(length).normal(size=(count, 3)), axis=0)
    _, expected = welch(samples, 200.0, nperseg=length, axis=0, detrend="linear", average="median")
    assert_allclose(spectrum(samples, 1 / 200.0, length)[1:], expected[1:], rtol=1e-9)


def test_density_of_white_noise():
    """One-sided: twice the two-sided density sigma^2 dt, which every frequency has."""
    samples = np.random.default_rng(0).normal(scale=0.3, size=(200_000, 2))
    density = spectrum(samples, 0.005, 256)[1:-1]
    # the median of N = 1560 segments, half of them new: sd of its mean over 127 bins below 1 / sqrt(780 x 127)
    assert_allclose(density.mean(axis=0), 2 * 0.3**2 * 0.005, rtol=4 / np.sqrt(780 * 127))
