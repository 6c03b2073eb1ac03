"""The shearer paper's filters on logs: identities, consistency, and input that is not as it should be."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2

import datasets
from tbmfg.errors import EstimationError
from tbmfg.estimators import estimate, unmet
from tbmfg.evaluation.metrics import nees
from tbmfg.filters import shearer
from tbmfg.filters.shearer import DESIGNS, Adaptive, Federated, Magnetic
from tbmfg.prepare import prepare
from tbmfg.problem import Problem
from tests.problems import clean_log, drive, log_of, state_errors, true_rig, true_states


@cache
def problem(seed: int = 0, duration: float = 30.0, settings: tuple[str, ...] = ()) -> Problem:
    """A drive with IMU, odometer and magnetometer; the prism is not seen."""
    simulation = drive(seed, duration, settings, imu_rate_hz=100.0)
    return prepare(log_of(simulation.log_series), simulation.rig, without=("prism",))


def run(name, problem, switches=None):
    return shearer.run(shearer.view(problem, DESIGNS[name]), DESIGNS[name], switches)


def in_sds(found, beside):
    """Largest difference of states in sds of the second, and of covariances in units of its diagonal."""
    sd = np.sqrt(np.diagonal(beside.cov, axis1=1, axis2=2))
    covariances = (found.cov - beside.cov) / sd[:, :, None] / sd[:, None]
    return np.abs(state_errors(found.x, beside.x) / sd).max(), np.abs(covariances).max()


# ---- identities ----


CALIBRATED = ("sensors.magnetometer.declination_sd_deg=1",)


@pytest.mark.parametrize("settings", [(), CALIBRATED])
@pytest.mark.parametrize("beta", ["fixed", "printed", "inverse"])
def test_a_federation_with_fixed_noise_is_the_centralised_filter(beta, settings):
    """H17: whatever the shares, and so is all that the paper credits to them; calibrations and all, to rounding."""
    central = run("shearer-ckf", problem(settings=settings))
    federated = run("shearer-afkf", problem(settings=settings), Federated(r_adapt="off", beta=beta))
    assert max(in_sds(federated, central)) < 1e-9
    assert_allclose(federated.c, central.c, atol=1e-10)
    for sensor, nis in central.nis.items():
        assert_allclose(federated.nis[sensor], nis, rtol=1e-6, atol=1e-9)
    assert (np.ptp(federated.shares) > 0.01) == (beta != "fixed")


def test_process_noise_as_printed_is_not():
    """H13: given whole to both it counts half in the fusion; little here, where the gyro has next to none."""
    central = run("shearer-ckf", problem())
    printed = run("shearer-afkf", problem(), Federated(r_adapt="off", share_q=False))
    assert max(in_sds(printed, central)) > 0.01
    assert np.all(np.diag(printed.cov[-1]) < np.diag(central.cov[-1]))


def test_without_magnetometer_the_centralised_filter_is_sins_od():
    whole = problem()
    alone = replace(whole, samples={"odometer": whole.samples["odometer"]})
    central, od = run("shearer-ckf", alone), run("shearer-sins-od", whole)
    assert_array_equal(central.x, od.x)
    assert_array_equal(central.cov, od.cov)


def test_noise_off_is_the_plain_filter_and_a_window_that_never_fills_as_well():
    plain = run("shearer-ckf", problem())
    for switches in (Adaptive(r_adapt="off"), Adaptive(window=100_000)):
        found = run("shearer-ckf-ar", problem(), switches)
        assert_array_equal(found.x, plain.x)
        assert all((noise == 1).all() for noise in found.noise.values())


def test_inertial_navigation_alone_uses_nothing_else():
    found = estimate("shearer-sins", problem())
    for sensor, counts in found.counts.items():
        assert counts.used == (counts.received if sensor == "imu" else 0)
        assert counts.parts() == counts.received
    assert found.calibration.keys() == problem().calibration.keys()


# ---- truth ----


@pytest.mark.parametrize("name", ["shearer-sins-od", "shearer-ckf", "shearer-afkf"])
def test_perfect_sensors_and_a_true_prior_give_the_truth(name):
    simulation = drive(0, 30.0, slide=0.0)
    clean = prepare(clean_log(simulation), true_rig(simulation), without=("prism",))
    found = run(name, clean)
    error = state_errors(found.x, true_states(simulation, clean, biases=False))
    sd = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    assert np.abs(error / sd).max() < 0.1
    # the mean over a period is the speed at its middle, but for the IMU edge that stands for it: 2.5 ms of 0.1 m/s^2
    assert max(np.nanmax(nis) for nis in found.nis.values()) < 0.05


SEEDS = range(200, 206)
EPOCHS_S = (8.0, 24.0, 38.0)  # on the way, standing where the cut ends, on the way back
CELLS = [(name, epoch, size) for name in ("shearer-sins-od", "shearer-ckf") for epoch in EPOCHS_S for size in (6, 15)]


@pytest.mark.slow
def test_normalised_errors_are_chi_square_there_and_back():
    """A short face: the machine cuts it, stands, and goes back without turning round, so with a negative speed."""
    values = {cell: [] for cell in CELLS}
    for seed in SEEDS:
        simulation = datasets.make("shearer-panel", seed=seed, duration=40.0, face_m=20.0, bend_m=8.0, web_m=0.4)
        cut = prepare(log_of(simulation.log_series), simulation.rig)
        assert cut.samples["odometer"].values.min() < -0.8
        truth = true_states(simulation, cut)
        found = {name: run(name, cut) for name in dict.fromkeys(name for name, _, _ in CELLS)}
        for name, epoch, size in CELLS:
            k = int(np.argmin(np.abs(cut.keyframes_s - epoch)))
            error = state_errors(found[name].x[k : k + 1], truth[k : k + 1])[:, :size]
            values[name, epoch, size] += nees(error, found[name].cov[k : k + 1, :size, :size]).tolist()
    alpha = 0.01 / len(CELLS)  # the risk of one false alarm is shared by all
    faults = []
    for (name, epoch, size), squares in values.items():
        low, high = chi2.ppf([alpha / 2, 1 - alpha / 2], size * len(SEEDS)) / size / len(SEEDS)
        mean = np.mean(squares) / size
        if not low < mean < high:
            faults.append(f"{name}, {size} states at {epoch:g} s: {mean:.2f} outside {low:.2f}..{high:.2f}")
    assert not faults, "; ".join(faults)


@pytest.mark.parametrize("name", ["shearer-ckf-ar", "shearer-afkf"])
def test_a_magnetic_fault_is_weighed_down(name):
    """A field that turns by 20 degrees from 10 to 30 s: the fixed noise follows it, the adaptive one does not."""
    simulation = datasets.make("shearer-magfault", seed=0, duration=32.0, fault="offset")
    cut = prepare(log_of(simulation.log_series), simulation.rig)
    truth = true_states(simulation, cut)
    up_b = truth[:, 6:9]

    def yaw_error(found):
        return np.degrees(np.abs(np.sum(up_b * state_errors(found.x, truth)[:, :3], axis=1)).max())

    adaptive = run(name, cut, DESIGNS[name].switches())
    assert yaw_error(run("shearer-ckf", cut)) > 15
    assert yaw_error(adaptive) < 4
    t = view_times(cut, "magnetometer")
    assert adaptive.noise["magnetometer"][(t > 13) & (t < 28)].min() > 3
    assert adaptive.noise["magnetometer"][t < 9].max() < 2.5


def view_times(problem, sensor):
    """Seconds of one sensor's rows as the filters see them."""
    [rows] = [rows for rows in shearer.view(problem, DESIGNS["shearer-ckf"]).rows if rows.sensor == sensor]
    return problem.inertial.steps.edges_s[rows.i]


def test_magnetic_yaw_alone_hides_the_tilt():
    """H9: without the tilt's columns the filter takes the tilt's part, with tan(dip), for yaw: it is too sure of it."""
    full = run("shearer-ckf", problem(), Magnetic())
    yaw_only = run("shearer-ckf", problem(), Magnetic(mag_jacobian="yaw_only"))
    k = 20  # once the magnetometer is worth more than the prior

    def yaw_sd(found):
        up_b = found.x[k, 6:9]
        return np.sqrt(up_b @ found.cov[k, :3, :3] @ up_b)

    assert yaw_sd(yaw_only) < yaw_sd(full)


# ---- what is missing ----


def test_what_a_filter_needs_is_asked_for():
    simulation = drive(0, 30.0, imu_rate_hz=100.0)
    for absent, names in {
        "odometer": ("shearer-sins-od", "shearer-ckf", "shearer-afkf"),
        "magnetometer": ("shearer-ckf", "shearer-ckf-ar", "shearer-afkf"),
    }.items():
        lacking = prepare(log_of(simulation.log_series), simulation.rig, without=(absent,))
        for name in names:
            assert unmet(name, lacking) == f"needs {absent}"
            with pytest.raises(EstimationError, match=rf"^{name} needs {absent}, .*tbmfg info") as caught:
                estimate(name, lacking)
            assert "\n" not in str(caught.value)
        assert unmet("shearer-sins", lacking) is None


def test_a_bias_that_bends_the_whole_path_is_found_all_the_same():
    """Without rest, heading or position a degree per second turns the path by 85 degrees: far beyond where a position
    corrected by its tangent still fits."""
    settings = ("sensors.imu.gyro_bias_sd_dps=1", "sensors.imu.acc_bias_sd_mps2=0.2", "initial.tilt_sd_deg=5")
    simulation = datasets.make("shearer-cut", seed=4, duration=85.0, settings=settings)
    result = estimate("batch", prepare(log_of(simulation.log_series), simulation.rig, without=("magnetometer",)))
    assert not [line for line in result.warnings if "did not converge" in line]
    scale = result.calibration["odometer_scale"]
    assert abs(scale.value - simulation.drawn["odometer"]["scale"]) < 3.0 * scale.sd
