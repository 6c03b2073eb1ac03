"""Inertial enhancement: modes, thresholds, what is told as noise, tilt by gravity; and noise by Allan variance."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from PyEMD import EMD
from typer.testing import CliRunner

import datasets
from tbmfg.cli import app
from tbmfg.errors import LogError
from tbmfg.geometry import exp_so3
from tbmfg.inertial import allan, enhancement, modes
from tbmfg.inertial.steps import Steps, make_steps
from tbmfg.inertial.strapdown import rotations
from tbmfg.prepare import prepare
from tbmfg.rig import override
from tests.problems import drive, imu_series, log_of

RATE = 475.0
WINDOW = 1900  # samples of 4 s
ZERO = np.zeros(3)


def pump(seconds: float, seed: int = 0):
    """A slow motion, the pump over it, and white noise."""
    t = np.arange(int(seconds * RATE)) / RATE
    slow = 0.3 * np.sin(2 * np.pi * 0.05 * t)
    lines = sum(np.sin(2 * np.pi * 24.5 * k * t + k) / k for k in range(1, 10))
    return slow, slow + lines + 0.1 * np.random.default_rng(seed).standard_normal(len(t))


# ---- modes ----


@pytest.mark.parametrize("kind", ["pump", "noise", "walk", "digitised", "short", "ramp"])
def test_modes_are_the_librarys(kind):
    """Digitised samples repeat and are zero; a ramp has no modes."""
    rng = np.random.default_rng(3)
    x = {
        "pump": pump(4.0)[1],
        "noise": rng.standard_normal(800),
        "walk": np.cumsum(rng.standard_normal(800)),
        "digitised": np.round(3 * rng.standard_normal(400)),
        "short": rng.standard_normal(16),
        "ramp": np.arange(100.0),
    }[kind]
    library = EMD()
    library.emd(x)
    for mine, expected in zip(modes.modes(x), library.get_imfs_and_residue(), strict=True):
        assert mine.shape == expected.shape
        assert_allclose(mine, expected, atol=1e-9 * np.abs(x).max())


def test_modes_of_signals_of_any_length_and_ends_are_the_librarys():
    rng = np.random.default_rng(1)
    for length in rng.integers(20, 400, size=40):
        noise = rng.normal(size=length)
        wave = np.sin(np.arange(length) * rng.uniform(0.05, 1.5) + rng.uniform(0.0, 6.0))
        for x in (noise, np.cumsum(noise), wave + 0.1 * noise):
            library = EMD()
            library.emd(x)
            for mine, expected in zip(modes.modes(x), library.get_imfs_and_residue(), strict=True):
                assert_allclose(mine, expected, atol=1e-9 * np.abs(x).max())


def test_the_pump_goes_and_the_motion_stays():
    slow, x = pump(12.0)
    inside = slice(WINDOW // 2, -WINDOW // 2)
    off = enhancement.smooth(x, "noise", WINDOW)[inside] - slow[inside]
    assert np.std(off) < 0.1 * np.std((x - slow)[inside])


def test_a_steady_sine_is_below_its_own_threshold():
    """E3: sd 3 / sqrt(2) / 0.6745 by the median, times sqrt(2 ln N): on modes that are kept this deletes motion."""
    assert not enhancement.intervals(3.0 * np.sin(2 * np.pi * np.arange(4750) / 475.0)).any()


def test_an_oscillation_is_kept_by_its_peak_or_goes_as_a_whole():
    mode = np.tile([0.0, 1.0, 0.0, -1.0], 100) + 0.01  # crosses zero
    mode[200] = 40.0
    found = enhancement.intervals(mode)
    T = np.median(np.abs(mode)) / 0.6745 * np.sqrt(2 * np.log(400))
    assert found[200] == pytest.approx(40.0 - T)
    assert not found[:190].any()
    assert not found[210:].any()


def test_the_modes_of_a_skewed_waveform_take_its_mean_and_it_is_given_back():
    """A pump's harmonics: a slow rate of a ten-thousandth of them is lost many times over, and then is not."""
    t = np.arange(int(12 * RATE)) / RATE
    lines = sum(np.sin(2 * np.pi * 24.5 * k * t + k) / k for k in range(1, 10))
    inside, weight = slice(WINDOW, -WINDOW), enhancement.hann(len(t) - 2 * WINDOW)
    lost, kept = (
        weight @ enhancement.enhanced((1e-4 + lines)[:, None], "noise", WINDOW, give_back)[inside, 0] / weight.sum()
        for give_back in (False, True)
    )
    assert abs(lost - 1e-4) > 1e-3
    assert abs(kept - 1e-4) < 1e-4


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 400), st.sampled_from(["noise", "kept"]), st.sampled_from([0.0, 1.0, 1e9]))
def test_any_length_gives_as_many_finite_values(count, rule, size):
    x = size * np.random.default_rng(count).standard_normal(count)
    found = enhancement.smooth(x, rule, 128)
    assert found.shape == x.shape
    assert np.isfinite(found).all()


def test_a_change_counts_as_the_white_noise_it_is_and_vibration_as_none():
    rng, density = np.random.default_rng(1), 0.02
    noise = density * np.sqrt(RATE) * rng.standard_normal((120 * 475, 3))
    found = enhancement.changed_density(noise, 1 / RATE, WINDOW)
    # 59 half-overlapping windows of 3 axes, about 110 independent values
    assert found == pytest.approx(density, rel=4 / np.sqrt(2 * 110))
    t = np.arange(120 * 475) / RATE
    shaking = np.tile(np.sin(2 * np.pi * 24.5 * t)[:, None], 3)
    assert enhancement.changed_density(shaking, 1 / RATE, WINDOW) < 1e-4


# ---- tilt ----


def still(seconds: float, R: np.ndarray, earth_n=ZERO) -> Steps:
    """Perfect samples of a body at rest with attitude ``R``."""
    count = int(seconds * RATE)
    gyro, acc = np.tile(R.T @ earth_n, (count, 1)), np.tile(R.T @ [0.0, 0.0, 9.81], (count, 1))
    return make_steps(imu_series(gyro, acc, period_ns=round(1e9 / RATE)), np.eye(3), "end")


def corrected(steps, R_start, earth_n=ZERO, gain=0.001):
    return enhancement.gravity_correction(steps, steps.gyro, steps.acc, R_start, np.zeros(3), earth_n, 9.81, gain)


def test_a_full_step_leaves_no_tilt_and_no_turn():
    """E9: applied to the global attitude; and the heading stays."""
    R = exp_so3(np.array([0.0, 0.0, 0.7]))
    tilted = exp_so3(np.array([0.02, -0.03, 0.0])) @ R
    steps = still(0.1, R)
    after = tilted @ exp_so3(corrected(steps, tilted, gain=1.0)[0] / RATE)
    assert_allclose(after @ R.T @ [0, 0, 1.0], [0, 0, 1.0], atol=0.02 * 0.04)  # (13): 0.991 of the angle
    turn = np.arctan2(after[1, 0], after[0, 0]) - 0.7
    assert abs(turn) < 0.02 * 0.03  # the product of the two angles


def test_the_earths_rate_is_no_tilt():
    """E5: at rest with the right attitude there is nothing to correct; without the Earth's rate all of it would go."""
    earth_n = np.array([0.0, 6e-5, 4e-5])
    R = exp_so3(np.array([0.01, 0.02, 1.0]))
    steps = still(20.0, R, earth_n)
    assert np.abs(corrected(steps, R, earth_n)).max() < 1e-9
    ignored = corrected(steps, R)[-1]
    assert_allclose(R @ ignored, [-0.0, -6e-5, 0.0], atol=2e-6)  # after ten time constants


def test_tilt_decays_with_the_stated_time_and_not_while_shaken():
    steps = still(2.1, np.eye(3))
    tilted = exp_so3(np.array([0.03, 0.0, 0.0]))
    end = tilted @ rotations(steps.edges_s, corrected(steps, tilted), np.zeros(3))[-1]
    assert np.arccos(end[2, 2]) == pytest.approx(0.03 * np.exp(-0.991 * 2.1 * RATE * 0.001), rel=0.02)
    shaken = replace(steps, acc=1.3 * steps.acc)  # e = 0.3: L = 7e-5
    assert np.abs(corrected(shaken, tilted)).max() < 0.03 * RATE * 0.001 * 1e-4


# ---- in a rig ----


def test_a_rig_switches_it_on_for_all_and_says_so():
    simulation = drive(0, 20.0)
    log = log_of(simulation.log_series)
    plain, off, on = (
        prepare(log, override(simulation.rig, [f"sensors.imu.enhancement={value}"]))
        for value in ("null", '{emd_threshold: "off", alpha_bar: 0}', "{}")
    )
    assert_array_equal(off.inertial.gyro, plain.inertial.gyro)
    assert off.warnings == plain.warnings
    said = [line for line in on.warnings if line.startswith("imu: ") and line not in plain.warnings]
    assert any("lags by" in line for line in said)
    assert any("alpha_bar 0.001" in line for line in said)
    assert on.calibration["tilt_correction_density_dps_rthz"].value > 0
    # quieter samples, more noise in the model: Q is told of what was taken away
    assert np.std(np.diff(on.inertial.acc, axis=0)) < 0.5 * np.std(np.diff(plain.inertial.acc, axis=0))
    assert on.inertial.psd_acc.min() > plain.inertial.psd_acc.max()
    assert on.inertial.psd_gyro.min() > plain.inertial.psd_gyro.max()


# ---- Allan variance ----


def test_white_noise_and_walk_are_found():
    rng, N, K, dt = np.random.default_rng(2), 0.01, 2e-4, 0.01
    white = N / np.sqrt(dt) * rng.standard_normal((360_000, 3))
    wander = np.cumsum(K * np.sqrt(dt) * rng.standard_normal((360_000, 3)), axis=0)
    tau, variance = allan.variance(white, dt)
    assert_allclose(variance[tau < 1.0], (N**2 / tau)[tau < 1.0], rtol=4 * np.sqrt(1.0 / 3600 / 3 * 2))
    found = allan.noise(white, dt)
    assert found.density == pytest.approx(N, rel=0.01)
    assert found.walk is None
    both = allan.noise(white + wander, dt)
    assert both.density == pytest.approx(N, rel=0.01)
    # some 36 independent averages an axis where the walk is seen
    assert both.walk == pytest.approx(K, rel=4 / np.sqrt(2 * 3 * 36))


def test_the_sds_of_density_and_walk_hold():
    N, K, dt, z = 0.01, 2e-4, 0.05, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        white = N / np.sqrt(dt) * rng.standard_normal((36_000, 3))
        found = allan.noise(white + np.cumsum(K * np.sqrt(dt) * rng.standard_normal((36_000, 3)), axis=0), dt)
        if found.walk is not None:
            errors = found.density / N - 1.0, found.walk / K - 1.0
            z.append(np.array(errors) / np.array(found.relative_sd)[[0, 2]])
    assert len(z) > 50
    # sixty draws tell their spread to 9 %, and the kernel of what averages share is good to a third
    spread = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all((spread > 0.6) & (spread < 1.4)), spread


def test_info_prints_the_noise_of_the_standing_machine(tmp_path):
    simulation = datasets.make("tbm-static", seed=0, duration=40.0, imu_rate_hz=100.0)
    log = tmp_path / "static.mcap"
    simulation.write(log)
    said = CliRunner().invoke(app, ["info", str(log), "--allan"])
    assert said.exit_code == 0
    [line] = [line for line in said.output.splitlines() if line.startswith("acc_density_ug_rthz")]
    found, sd, rig = map(float, line.split()[1:])
    assert 0 < sd < 0.1
    assert found == pytest.approx(10.0, abs=5 * sd)
    assert rig == 10.0


def test_a_machine_that_never_stands_has_no_static_noise():
    rng = np.random.default_rng(0)
    gyro = 0.1 * np.cumsum(rng.standard_normal((6000, 3)), axis=0) / 100
    steps = make_steps(imu_series(gyro, np.tile([0.0, 0.0, 9.81], (6000, 1))), np.eye(3), "end")
    with pytest.raises(LogError, match=r"never still for 10 s .* record the machine standing"):
        allan.static(steps)
