"""A machine's own magnetic field, drawn from the rig's prior and left in the readings, is found as the body turns."""

import numpy as np
import pytest
from scipy.stats import chi2

from tbmfg.estimators import estimate
from tbmfg.prepare import prepare
from tests.problems import flight, log_of

SEEDS = range(4)
SD_UT = 5.0
ALPHA = 0.005  # of two estimators


@pytest.mark.parametrize("estimator", ["batch", "ins"])
def test_hard_iron_is_estimated_and_its_sd_is_honest(estimator):
    total = 0.0
    for seed in SEEDS:
        simulation = flight(seed, 20.0, (f"sensors.magnetometer.hard_iron_sd_ut={SD_UT}",))
        found = estimate(estimator, prepare(log_of(simulation.log_series), simulation.rig))
        iron = found.calibration["magnetometer_hard_iron_ut"]
        assert iron.estimated
        assert max(iron.sd[:2]) < 0.5 * SD_UT  # the vertical component shows in tilts alone
        error = np.array(iron.value) - simulation.drawn["magnetometer"]["hard_iron_ut"]
        total += float(np.sum((error / iron.sd) ** 2))
    low, high = chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], 3 * len(SEEDS))
    assert low < total < high
