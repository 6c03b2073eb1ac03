"""Where a sensor lies to one side is said with its axis, size and unit, as often by chance whatever its components."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

import datasets
from tbmfg import residuals
from tbmfg.estimators import estimate
from tbmfg.prepare import prepare
from tbmfg.sensors import Rows
from tests import problems
from tests.test_lidar_model import X_I, X_J, C, row


@pytest.fixture(scope="module")
def problem():
    """40 s of a roadheader, every sensor as the rig says."""
    simulation = problems.drive(seed=8, duration=40.0, imu_rate_hz=100.0)
    return prepare(problems.log_of(simulation.log_series), simulation.rig)


def with_z(problem, sensor, change):
    """The problem with the measured values of a sensor's rows moved by ``change`` from row to row."""
    rows = [replace(r, z=r.z + change(r), loss="cauchy") if r.sensor == sensor else r for r in problem.rows]
    return replace(problem, rows=rows)


def within(problem, rows, first_s, last_s):
    t_s = problem.keyframes_s[rows.j]
    return ((t_s >= first_s) & (t_s < last_s))[:, None]


def told(problem, sensor, name="batch"):
    """The lines on biases of ``sensor``, and the intervals of their stretches in s."""
    result = estimate(name, problem)
    own = [i for i in result.intervals if (i.sensor, i.kind) == (sensor, "biased")]
    spans = [((i.start_ns - problem.t0_ns) * 1e-9, (i.end_ns - problem.t0_ns) * 1e-9) for i in own]
    return [line for line in result.warnings if line.startswith(f"{sensor}: biased by ")], spans


def test_a_nominal_drive_has_no_bias(problem):
    assert not any("biased by" in line for line in estimate("batch", problem).warnings)


def test_a_station_that_is_knocked_is_told_by_axis_and_metres(problem):
    """0.1 m along x and y of n for ten seconds: the rest, IMU and odometer, knows better."""
    lines, spans = told(with_z(problem, "prism", lambda r: within(problem, r, 15, 25) * [0.1, -0.2, 0.0]), "prism")
    said = [re.match(r"prism: biased by (\S+) m along (.) of n from ", line).groups() for line in lines]
    assert [axis for _, axis in said] == ["x", "y"]
    assert [float(size) for size, _ in said] == pytest.approx([0.1, -0.2], abs=0.01)
    for start, end in spans:
        assert start == pytest.approx(15.0, abs=1.0)
        assert end == pytest.approx(25.0, abs=1.0)


def test_wheels_that_spin_are_told_as_a_speed(problem):
    def spun(rows):
        dt = problem.keyframes_s[rows.j] - problem.keyframes_s[rows.i]
        return within(problem, rows, 10, 20) * dt[:, None] * [0.3, 0.0, 0.0]

    [line], [(start, end)] = told(with_z(problem, "odometer", spun), "odometer")
    assert line.startswith("odometer: biased by +0.3 m/s ahead from ")
    assert (start, end) == (pytest.approx(10.0, abs=1.0), pytest.approx(20.0, abs=1.0))


def test_noise_that_drifts_is_no_white_noise(problem):
    """Half as large again as the rig says, 0.9 of it in the next: its mean over long is off by sqrt(19) times more."""
    rng = np.random.default_rng(1)

    def drifting(rows):
        white = 1.5 * np.sqrt(1 - 0.9**2) * rng.standard_normal(rows.z.shape)
        return rows.sigma * lfilter([1.0], [1.0, -0.9], white, axis=0)

    result = estimate("batch", with_z(problem, "prism", drifting))
    [line] = [line for line in result.warnings if "no white noise" in line]
    assert line.startswith("prism: its residuals")
    series = result.innovations["prism"]
    assert series.correlation > 5 * series.correlation_sd
    said = float(re.search(r"by a factor of about (\S+);", line)[1])
    assert 1.5 < said < np.sqrt(19 * 1.5**2 + 1), "the fit takes the slowest part of it"
    assert re.search(r"sensors\.prism\.noise_factor=(\S+)", line)


@pytest.mark.parametrize(
    ("dataset", "options"),
    [("tbm-drive", {"vibration": 0.0, "slide": 1.0}), ("shearer-cut", {}), ("shaft-descend", {})],
)
def test_noise_of_nominal_machines_is_white(dataset, options):
    known = ("sensors.imu.noise_factor=1",)
    simulation = datasets.make(dataset, seed=5, duration=40.0, settings=known, **options)
    result = estimate("batch", prepare(problems.log_of(simulation.log_series), simulation.rig))
    assert not any("no white noise" in line or "biased by" in line for line in result.warnings)
    assert all(
        series.correlation is not None for name, series in result.innovations.items() if name in simulation.rig.sensors
    )


def test_what_smoothing_has_not_seen_is_not_asked(problem):
    assert estimate("ins", problem).innovations["prism"].correlation is None


@pytest.mark.parametrize("components", [2, 3, 6])
def test_more_components_raise_no_more_false_alarms(problem, monkeypatch, components):
    """White residuals, and a limit low enough that alarms can be counted."""
    monkeypatch.setattr(residuals, "BIASED", 0.9)
    rng, count = np.random.default_rng(3), {}
    [prism] = [rows for rows in problem.rows if rows.sensor == "prism"]
    alone = replace(problem, rows=[replace(prism, model="barometer")])
    for k in (1, components):
        monkeypatch.setitem(residuals.AXES, "barometer", (1.0, tuple((str(axis), "m", 1.0) for axis in range(k))))
        monkeypatch.setattr(residuals, "parted", lambda p, rows, x, c, k=k: (rng.standard_normal((len(rows), k)),) * 2)
        count[k] = sum(len(residuals.biased(alone, None, None)) for _ in range(200))
    assert count[1] > 50
    # Poisson numbers, stretches not quite independent of each other
    assert abs(count[components] - count[1]) < 4 * np.sqrt(count[1] + count[components])


def test_scans_are_taken_back_from_their_information_to_turn_and_way():
    """Whitened they mix all six; a way along the tunnel that the walls do not tell is no bias."""
    error = np.array([0.01, -0.02, 0.015, 0.05, -0.03, 0.02])
    z, data = row(error)
    pair = SimpleNamespace(keyframes_s=np.array([3.0, 3.5]))
    one = np.ones(1, dtype=int)
    rows = Rows("lidar", "lidar", 0 * one, one, z, data, np.ones((1, 6)), slice(0, 6), one)
    x = np.array([X_I, X_J])
    _, size = residuals.parted(pair, rows, x, C)
    # UNTOLD holds them to nothing with 1e-6 of what the scans do
    np.testing.assert_allclose(size[0], -error / 0.5 / np.repeat([residuals.DEG, 1.0], 3), rtol=1e-5)
    blind = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    r, _ = residuals.parted(pair, replace(rows, data=np.hstack([data[:, :35], blind.reshape(1, 36)])), x, C)
    np.testing.assert_allclose(r[0], [*-error[:5], 0.0], rtol=1e-5)
