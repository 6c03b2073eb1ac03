"""What a truth is worth: a flight made here whose truth is late, steps and is turned by what is known, or is clean."""

import os
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import euroc
from benchmarks.__main__ import main
from datasets.recordings import Arrays, G, read_npz
from tbmfg.errors import TbmfgError

INTERVAL_S, DURATION_S, REST_S = 0.005, 40.0, 4.0
LATE_S, ATTITUDE_LATE_S, TURN_DEG = 0.008, 0.004, 1.5
STEPS_MM = {2000: (0.0, 30.0, 0.0), 5003: (2.0, -1.0, 0.0), 6000: (-4.0, 0.0, 8.0)}


def started(t_s):
    """0 at rest, 1 in flight; its first two derivatives have no steps."""
    u = np.clip((t_s - REST_S) / 3.0, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def position(t_s):
    """m, with accelerations of some m/s^2."""
    amplitude, rate, phase = np.array([[1.3, 0.9, 0.4], [2.1, 1.7, 2.6], [0.4, 1.0, 2.0]])
    fast = amplitude * np.sin(np.multiply.outer(t_s, rate) + phase)
    slow = [3.0, 2.0, 0.5] * np.sin(np.multiply.outer(t_s, [0.5, 0.4, 0.7]))
    return started(t_s)[:, None] * (fast + slow)


def attitude(t_s):
    waves = [1.2 * np.sin(0.4 * t_s), 0.2 * np.sin(1.1 * t_s), 0.15 * np.sin(1.7 * t_s + 1.0)]
    return Rotation.from_euler("ZYX", np.stack(started(t_s) * waves, axis=-1))


def flight(late_s=0.0, attitude_late_s=0.0, turn_deg=0.0, steps=None):
    """Arrays of a recording: an inertial unit with noise and biases, each sample the mean up to its stamp."""
    rng = np.random.default_rng(1)
    t_s = np.arange(0.0, DURATION_S, INTERVAL_S)
    before, h = t_s - INTERVAL_S, 1e-3
    middle = t_s - 0.5 * INTERVAL_S
    acceleration = (position(middle + h) - 2.0 * position(middle) + position(middle - h)) / h**2
    force = attitude(middle).apply(np.add(acceleration, [0.0, 0.0, G]), inverse=True)
    rate = (attitude(before).inv() * attitude(t_s)).as_rotvec() / INTERVAL_S
    true = t_s[300:-300]
    path = position(true - late_s)
    for row, step in (steps or {}).items():
        path[row + 1 :] += 1e-3 * np.array(step)
    turned = Rotation.from_euler("z", -turn_deg, degrees=True) * attitude(true - attitude_late_s)
    arrays = {
        "t0_ns": np.int64(1_700_000_000_000_000_000),
        "imu_t": t_s,
        "imu_gyr": rate + [0.01, -0.02, 0.07] + 0.002 * rng.standard_normal(rate.shape),
        "imu_acc": force + [0.05, 0.1, -0.08] + 0.02 * rng.standard_normal(force.shape),
        "truth_t": true,
        "truth_p": path,
        "truth_q_xyzw": turned.as_quat(),
    }
    return Arrays(Path("flight.npz"), arrays)


def test_lateness_steps_and_turn_are_found_and_mended():
    arrays = flight(LATE_S, ATTITUDE_LATE_S, TURN_DEG, STEPS_MM)
    rows, jump = euroc.steps(arrays["truth_p"])
    assert rows.tolist() == list(STEPS_MM)
    assert 1e3 * jump == pytest.approx(np.array(list(STEPS_MM.values())), abs=0.01)
    for found in (euroc.worth(arrays, length_s) for length_s in euroc.WINDOWS_S):
        value, sd = found.late
        assert 0.0 < sd < 1e-3
        assert value == pytest.approx(LATE_S, abs=3.0 * sd)
        value, sd = found.attitude_late
        assert 0.0 < sd < 3e-4
        assert value == pytest.approx(ATTITUDE_LATE_S, abs=3.0 * sd)
        turn, sd = np.rad2deg(found.turn)
        assert np.all(sd < 0.2)
        assert np.all(np.abs(turn - [0.0, 0.0, TURN_DEG]) < 3.0 * sd)

    better, clean = euroc.mended(arrays, found), flight()
    shared = np.isin(np.round(clean["truth_t"], 6), np.round(better["truth_t"], 6))
    moved = better["truth_p"] - clean["truth_p"][shared]
    speed = 3.5  # m/s at the most
    assert np.abs(moved).max() < 3.0 * found.late[1] * speed + 1e-4
    rest = Rotation.from_quat(better["truth_q_xyzw"]) * Rotation.from_quat(clean["truth_q_xyzw"][shared]).inv()
    assert np.rad2deg(rest.magnitude().max()) < 0.3


def test_a_clean_truth_has_nothing_to_mend():
    arrays = flight()
    assert len(euroc.steps(arrays["truth_p"])[0]) == 0
    for found in (euroc.worth(arrays, length_s) for length_s in euroc.WINDOWS_S):
        for value, sd in (found.late, found.attitude_late, found.turn):
            assert np.all(np.abs(value) < 3.0 * sd)


def test_rows_of_both_truths(tmp_path, monkeypatch):
    """The prism of a truth that is late has the sum of both delays, and that of the mended its own."""
    monkeypatch.setattr(euroc, "WINDOWS_S", (2.0,))
    np.savez(tmp_path / "flight.npz", **flight(4 * LATE_S, ATTITUDE_LATE_S, TURN_DEG))
    rows = euroc.measure(Namespace(sources=[tmp_path / "flight.npz"], estimators="batch"))
    told = {row.key: row for row in rows}
    assert {row.scenario for row in rows} == {"flight", "flight, mended"}
    for metric in ("position", "attitude", "arm", "clock_offset"):
        assert told["flight, mended", "batch", metric].inside
    assert not told["flight", "batch", "attitude"].inside
    assert not told["flight", "batch", "clock_offset"].inside
    assert told["flight", "batch", "attitude"].mean == pytest.approx(TURN_DEG, abs=0.2)


@pytest.mark.parametrize(("end_s", "says"), [(3.0, "share 288 samples, three windows take 300"), (REST_S, "still")])
def test_input_at_fault_is_one_line(end_s, says):
    arrays = flight()
    part = arrays["imu_t"] < end_s
    for name in ("imu_t", "imu_gyr", "imu_acc"):
        arrays[name] = arrays[name][part]
    with pytest.raises(TbmfgError, match=says):
        euroc.worth(arrays, 0.5)


def test_a_file_that_is_missing_is_one_line(tmp_path, capsys):
    assert main(["euroc", str(tmp_path / "none.npz")]) == 1
    assert "none.npz" in capsys.readouterr().err


@pytest.mark.skipif("TBMFG_DATA" not in os.environ, reason="recordings are not part of the repository")
def test_machine_hall_truth_is_late_and_steps():
    arrays = read_npz(Path(os.environ["TBMFG_DATA"]) / "euroc_imu_truth" / "MH_03_medium.npz")
    assert len(euroc.steps(arrays["truth_p"])[0]) == 77
    late, sd = euroc.worth(arrays, 2.0).late
    assert 3.0 * sd < late < 0.02
