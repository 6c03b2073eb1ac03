"""Covariances are honest: normalised errors of independent runs at fixed epochs, all drawn from the priors."""

import numpy as np
import pytest
from scipy.stats import chi2

import datasets
from tbmfg.estimators import estimate
from tbmfg.evaluation.metrics import nees
from tbmfg.prepare import prepare
from tests.problems import drive, flight, log_of, state_errors, true_states

SEEDS = range(100, 110)
EPOCHS_S = (8.0, 17.0, 29.0)
ESTIMATORS = ("ins", "batch")


def nominal(dataset, **options):
    """A machine's log with every error as its rig says."""

    def make(seed, duration):
        settings = ("sensors.imu.noise_factor=1",)
        return datasets.make(dataset, seed=seed, duration=duration, settings=settings, **options)

    return make


# The drive loses its prism for six seconds about the second epoch, the sinking machine its laser.
WORLDS = {
    "drive": (drive, (("prism", 12.0, 18.0),)),
    "flight": (flight, ()),
    "shearer": (nominal("shearer-cut"), ()),
    "shaft": (nominal("shaft-descend", nominal=1), (("laser", 12.0, 18.0),)),
}
CALIBRATIONS = {
    "shearer": {"odometer_scale": ("odometer", "scale")},
    "shaft": {"laser_tilt_deg": ("laser", "tilt_deg"), "barometer_scale": ("barometer", "scale")},
    "drive": {"prism_lever_arm_m": ("prism", "arm_m"), "odometer_scale": ("odometer", "scale")},
    "flight": {
        "prism_lever_arm_m": ("prism", "arm_m"),
        "prism_clock_offset_s": ("prism", "clock_offset_s"),
        "magnetometer_declination_deg": ("magnetometer", "declination_deg"),
    },
}
# per world and estimator: pose and whole state at every epoch, and every calibration
CELLS = len(ESTIMATORS) * sum(2 * len(EPOCHS_S) + len(calibrations) for calibrations in CALIBRATIONS.values())
ALPHA = 0.01 / CELLS  # the risk of one false alarm is shared by all


def drawn_of(simulation):
    """What was drawn, in the units of the calibrations."""
    told = {name: dict(values) for name, values in simulation.drawn.items()}
    if "laser" in told:
        told["laser"]["tilt_deg"] = np.degrees(told["laser"]["tilt_n"])
    if "barometer" in told:
        # at sea level, where the standard atmosphere has 288.15 K: the column is some 20 m high
        told["barometer"]["scale"] = 288.15 / told["barometer"]["air_k"] - 1.0
    return told


def squared(world, seed):
    """(estimator, what) -> squared normalised error and its degrees of freedom, of one run."""
    make, outages = WORLDS[world]
    simulation = make(seed, 30.0)
    problem = prepare(log_of(simulation.log_series), simulation.rig, outages=outages)
    truth = true_states(simulation, problem)
    out = {}
    for name in ESTIMATORS:
        result = estimate(name, problem)
        path = result.trajectory
        biases = path.bias_acc, path.bias_gyro
        x = np.hstack([path.rotations().reshape(-1, 9), path.position_n - problem.origin_n, path.velocity_n, *biases])
        error = state_errors(x, truth)
        for epoch in EPOCHS_S:
            k = int(np.argmin(np.abs(problem.keyframes_s - epoch)))
            for what, size in (("pose", 6), ("state", 15)):
                value = nees(error[k : k + 1, :size], path.cov[k : k + 1, :size, :size])[0]
                out[name, f"{what} at {epoch:g} s"] = (value, size)
        for key, (sensor, drawn) in CALIBRATIONS[world].items():
            found, true = result.calibration[key], np.atleast_1d(drawn_of(simulation)[sensor][drawn])
            assert found.estimated
            z = (np.atleast_1d(found.value) - true) / np.atleast_1d(found.sd)
            out[name, key] = (float(z @ z), len(z))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_normalised_errors_are_chi_square(world):
    runs = [squared(world, seed) for seed in SEEDS]
    faults = []
    for cell in runs[0]:
        values, sizes = zip(*(run[cell] for run in runs), strict=True)
        dof = sum(sizes)
        low, high = chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], dof) / dof
        mean = np.sum(values) / dof
        if not low < mean < high:
            faults.append(f"{cell[0]}, {cell[1]}: {mean:.2f} outside {low:.2f}..{high:.2f}")
    assert not faults, "; ".join(faults)
