"""Benchmarks: the statistics on draws whose answer is known, the commands on tiny runs, and the gate both ways."""

import json
import os
import time
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import datasets
from benchmarks import accuracy, gate, gyrocompass, lidar, outliers, pace, page, runs, scans, speed
from benchmarks.__main__ import main
from benchmarks.gate import Tolerance, compare
from benchmarks.rows import Row, print_tables, read_rows, to_text
from benchmarks.workers import run_all
from tbmfg.rig import dump_rig, override

KEYS = ["scenario", "estimator", "metric", "unit", "mean", "sd", "n", "bound", "published"]


def drawn(rng, count, spread=1.0, estimator="toy"):
    """Runs of an estimator whose errors are ``spread`` times what its covariance says; three epochs."""
    out = []
    for seed in range(count):
        normalised = spread * rng.standard_normal((3, 6))
        nees = np.sum(normalised**2, axis=1)
        parts = {"position": np.sum(normalised[:, 3:] ** 2, axis=1)}
        z = {"scale": spread * rng.standard_normal()}
        metrics = {("position", "mm"): 2.0 + seed % 2}
        epochs_s = np.array([10.0, 20.0, 30.0])
        out.append(
            runs.Measured("draws", estimator, seed, metrics, {"position": 5.0}, epochs_s, nees, parts, normalised, z)
        )
    return out


def by_metric(rows):
    return {row.metric: row for row in rows}


# ---- statistics ----


def test_consistent_draws_pass_and_their_shares_are_gaussian():
    rows = by_metric(accuracy.summarise(drawn(np.random.default_rng(1), 400), alpha=0.01 / 3))
    for time_s in (10, 20, 30):
        cell = rows[f"nees_pose@{time_s}s"]
        assert cell.bound == pytest.approx(tuple(chi2.ppf([0.005 / 3, 1 - 0.005 / 3], 2400) / 2400))
        assert cell.inside
        assert cell.n == 400
    # share of 7200 draws: sd below 0.6 %
    for k, share in ((1, 68.27), (2, 95.45), (3, 99.73)):
        assert rows[f"within_{k}sd"].mean == pytest.approx(share, abs=1.8)
    assert rows["nees_position"].mean == pytest.approx(1.0, abs=0.07)
    assert rows["z_scale"].mean == pytest.approx(0.0, abs=0.15)
    assert rows["z_scale"].sd == pytest.approx(1.0, abs=0.11)
    assert rows["calibrations_within_3sd"].mean == pytest.approx(99.73, abs=0.8), "400 draws: 0.26 % sd"
    assert rows["position"].mean == pytest.approx(2.5)
    assert rows["position"].bound == (None, 5.0)
    assert rows["failed"].mean == 0


@pytest.mark.parametrize("spread", [0.7, 1.4])
def test_covariances_wrong_by_40_percent_are_found_in_30_runs(spread):
    rows = accuracy.summarise(drawn(np.random.default_rng(2), 30, spread), alpha=0.01 / 24)
    assert not any(row.inside for row in rows if row.metric.startswith("nees_pose"))


def test_false_alarms_of_a_whole_command_are_one_percent():
    from tbmfg.evaluation.metrics import chi_square_bounds

    commands, cells = 4000, 24
    low, high = chi_square_bounds(30, 6, accuracy.CHANCE / cells)
    means = np.random.default_rng(3).chisquare(6 * 30, (commands, cells)) / 30
    alarms = np.mean(np.any((means < low) | (means > high), axis=1))
    assert alarms == pytest.approx(0.01, abs=4 * np.sqrt(0.01 / commands))


def test_errors_over_their_bound_are_pooled_with_their_doubt():
    """Of errors drawn with the bound's own covariance, three components a run, the pooled ratio is 1, and the lower
    limit of 95 % lies above it in 5 % of the studies."""
    rng = np.random.default_rng(6)
    studies = [np.sqrt(rng.chisquare(3, 50) / 3) for _ in range(2000)]
    found = [accuracy.over_bound("s", "batch", "position", list(ratios), 1.05) for ratios in studies]
    assert np.mean([mean.mean for mean, _ in found]) == pytest.approx(1.0, abs=0.01)
    spread = np.std([mean.mean for mean, _ in found])
    assert np.mean([mean.sd for mean, _ in found]) / np.sqrt(50) == pytest.approx(spread, rel=0.1)
    assert np.mean([low.mean > 1.0 for _, low in found]) == pytest.approx(0.05, abs=0.03)
    mean, low = found[0]
    assert mean.bound == (None, pytest.approx(1.05 + 2 * mean.sd / np.sqrt(50)))
    assert low.bound == (None, 1.05)
    [worse, lowest] = accuracy.over_bound("s", "batch", "position", list(1.5 * studies[0]), 1.05)
    assert not worse.inside
    assert not lowest.inside
    assert [row.bound for row in accuracy.over_bound("s", "isam2", "position", [1.0, 1.1], None)] == [None]


def test_epochs_end_with_the_log_and_are_the_nearest_keyframes():
    stamps = np.array([0, 9, 11, 19, 22, 30]) * 10**9
    assert runs.epochs(stamps, 30.0, 3).tolist() == [1, 3, 5]


def test_a_metric_that_some_runs_lack_is_of_the_others():
    good = drawn(np.random.default_rng(4), 3)
    good[1].metrics["nis_zero_velocity", "per dof"] = 0.9
    row = by_metric(accuracy.summarise(good, 0.01))["nis_zero_velocity"]
    assert (row.mean, row.n) == (0.9, 1)


def test_failed_seeds_are_counted_and_left_out():
    good = drawn(np.random.default_rng(4), 3)
    rows = by_metric(accuracy.summarise([*good, replace(good[0], seed=9, failure="no prism")], 0.01))
    assert (rows["failed"].mean, rows["failed"].n, rows["failed"].inside) == (1, 4, False)
    assert rows["position"].n == 3


def test_biases_are_those_of_the_sample_that_ends_at_the_keyframe():
    simulation = datasets.make("tbm-drive", seed=1, duration=2.0)
    stamps = simulation.clean["imu"].t_ns
    bias_acc, bias_gyro = runs.true_biases(simulation, stamps[[3, 700]] + 1000)
    np.testing.assert_array_equal(bias_acc, simulation.drawn["imu"]["bias_acc"][[3, 700]])
    np.testing.assert_array_equal(bias_gyro, simulation.drawn["imu"]["bias_gyro"][[3, 700]])


# ---- gyrocompass ----


def test_a_gyrocompass_is_held_to_theory_and_to_its_own_sd():
    rng = np.random.default_rng(8)
    honest = [
        gyrocompass.Found("ins", seed, 8e-3 * z, 8e-3, 8.05e-3) for seed, z in enumerate(rng.standard_normal(100))
    ]
    rows = by_metric(gyrocompass.summarise(honest))
    assert rows["heading"].mean == pytest.approx(8.0, rel=0.25)
    assert all(row.inside is not False for row in rows.values())
    sure = by_metric(gyrocompass.summarise([replace(one, sd=4e-3) for one in honest]))
    assert not sure["heading_sd"].inside
    assert not sure["heading_within_3sd"].inside
    assert not by_metric(gyrocompass.summarise([*honest, replace(honest[0], failure="no north")]))["failed"].inside


def test_gyrocompass_runs():
    [found] = gyrocompass.run(gyrocompass.Job(1, 60.0, ("ins",)))
    assert not found.failure
    assert abs(found.error) < 4.0 * found.sd
    assert found.sd > 0.9 * found.theory, "nobody knows north better than the gyro's bias lets"


# ---- rows ----


def test_rows_return_from_json_and_print_plainly(capsys, tmp_path):
    rows = [
        Row("s", "batch", "position", "mm", 4.0, 1.0, 3, (None, 5.0)),
        Row("s", "ins", "position", "mm", 6.0, 1.0, 3, (None, 5.0)),
        Row("s", "ins", "yaw", "deg", None, None, 3, None, 0.2),
    ]
    (tmp_path / "rows.json").write_text(to_text(rows))
    assert read_rows(tmp_path / "rows.json") == rows
    assert list(json.loads(to_text(rows))[0]) == KEYS
    print_tables(rows)
    out = capsys.readouterr().out.splitlines()
    assert out[1].split() == ["metric", "unit", "batch", "ins", "n", "bound"]
    assert [line.split() for line in out if "published" in line] == [["published", "deg", "0.2"]]
    assert "4 ± 1" in out[2]
    assert "6 ± 1 !" in out[2]
    assert out[-1] == "1 of 2 means lie in their bounds"
    assert not any("\x1b" in line for line in out)


# ---- gate ----


def test_a_page_draws_what_is_judged_and_lists_all():
    rows = [
        *(Row("cut <1>", "ins", f"nees@{t:g}s", "per dof", 1.0, 0.2, 9, (0.5, 1.6)) for t in (10.0, 20.0)),
        Row("cut <1>", "ins", "position", "mm", 3.0, 0.5, 9, (None, 5.0)),
        Row("cut <1>", "ins", "ape", "mm", 2.0, 0.5, 9),
        Row("cut <1>", "ins", "failed", "seeds", 0, None, 9, (None, 0)),
    ]
    over_time, judged = page.charts(rows)
    [series] = over_time[0]
    assert (series["x"], series["y"]) == ([10.0, 20.0], [1.0, 1.0])
    assert series["error_y"]["array"][0] == pytest.approx(1.96 * 0.2 / 3)
    assert [box["y1"] for box in over_time[1]["shapes"]] == [1.6, 1.6]
    assert judged[0][0]["x"] == ["position"]
    text = page.page("a title", rows)
    assert "cut &lt;1&gt;" in text
    assert all(f"<th>{metric}</th>" in text for metric in ("nees@10s", "position", "ape", "failed"))
    assert text.count("Plotly.newPlot(") >= 2


def test_tolerance():
    assert Tolerance(0.1).holds(1.09, 1.0)
    assert not Tolerance(0.1).holds(0.89, 1.0)
    assert Tolerance(0.1, one_sided=True).holds(0.2, 1.0)
    assert not Tolerance(0.1, 0.05, one_sided=True).holds(1.16, 1.0)


def test_compare_names_what_is_worse_and_what_is_gone():
    old = [Row("s", "batch", m, u, 1.0, 0.1, 6) for m, u in (("position", "mm"), ("nees_pose@10s", ""), ("ape", "mm"))]
    new = [replace(old[0], mean=1.2), replace(old[1], mean=0.95)]
    faults = compare(new, old, accuracy.tolerance)
    assert len(faults) == 2
    assert faults[0].startswith("s batch position: 1.2 against 1 mm")
    assert faults[1].startswith("s batch ape: missing")


# ---- workers ----


def test_jobs_have_one_thread_and_a_failing_one_ends_the_others(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    assert run_all(os.getenv, ["OMP_NUM_THREADS"] * 3, 2, "three") == ["1"] * 3
    assert os.environ["OMP_NUM_THREADS"] == "7"
    started = time.monotonic()
    with pytest.raises(TypeError):
        run_all(time.sleep, ["no number", *[0.1] * 1000], 2, "all of them would take 50 s")
    assert time.monotonic() - started < 25.0


# ---- commands ----


@pytest.mark.slow
def test_accuracy_runs_and_becomes_a_baseline_that_it_then_holds(capsys, monkeypatch, tmp_path):
    tiny = {"scenario": ["tbm-drive"], "seeds": 2, "duration": 6.0, "epochs": 2}
    for key, value in tiny.items():
        monkeypatch.setitem(accuracy.GATE, key, value)
    baseline, out = tmp_path / "baseline.json", tmp_path / "rows.json"
    files = ["--baseline", str(baseline), "--json", str(out)]
    assert main(["accuracy", "--update-baseline", *files]) == 0
    rows = read_rows(out)
    assert {row.estimator for row in rows} == set(accuracy.GATE["estimators"].split(","))
    metrics = {row.metric for row in rows}
    assert {"position", "ape", "prism_point", "yaw", "tilt", "velocity", "nees_pose@3s", "nees_pose@6s"} <= metrics
    assert {"position_over_bound", "attitude_over_bound", "tilt_over_bound", "velocity_over_bound"} <= metrics
    assert {"within_1sd", "z_prism_arm_x", "z_odometer_scale", "z_bias_gyro_z", "nis_prism"} <= metrics
    assert all(row.n == 2 or row.metric == "calibrations_within_3sd" for row in rows)
    assert all(row.mean is not None for row in rows)
    assert json.loads(baseline.read_text())["accuracy"]["options"]["seeds"] == 2

    asked = []
    monkeypatch.setattr(accuracy, "measure", lambda given: asked.append(given) or rows)
    assert main(["accuracy", "--gate", *files]) == 0
    assert (asked[0].seeds, asked[0].duration, asked[0].scenario) == (2, 6.0, ["tbm-drive"])
    worse = [replace(row, mean=1.2 * row.mean) if row.metric == "prism_point" else row for row in rows]
    monkeypatch.setattr(accuracy, "measure", lambda given: worse)
    assert main(["accuracy", "--gate", *files]) == 1
    assert "prism_point" in capsys.readouterr().out


def test_gate_without_a_baseline_says_how_to_make_one(capsys, tmp_path):
    assert main(["accuracy", "--gate", "--baseline", str(tmp_path / "none.json")]) == 1
    assert "--update-baseline" in capsys.readouterr().err


@pytest.mark.parametrize("wrong", [["--estimators", "oracle"], ["--scenario", "moon"], ["--seeds", "0"]])
def test_wrong_options_are_told_in_one_line(capsys, wrong):
    assert main(["accuracy", *wrong]) == 1
    assert capsys.readouterr().err.startswith("error: ")


def test_committed_baseline_fits_the_gate():
    held, rows = gate.load(gate.BASELINE, "accuracy")
    assert held == accuracy.GATE
    assert all(accuracy.tolerance(row) for row in rows)


def test_speed_without_a_recording_is_skipped(capsys, monkeypatch):
    monkeypatch.delenv("TBMFG_DATA", raising=False)
    assert main(["speed"]) == 0
    assert "TBMFG_DATA" in capsys.readouterr().out


def test_script_and_smoother_solve_the_same_problem(tmp_path):
    """With prism and IMU only, on a machine that does not shake, the yardstick measures the same work.

    The gyro is a worse one than the machine's own, whose bias walk is too small for the Cholesky of ``Marginals``.
    """
    worse = ("sensors.imu.gyro_walk=1e-5", "sensors.imu.acc_walk=1e-3", "sensors.imu.noise_factor=10.0")
    simulation = datasets.make("tbm-drive", seed=3, duration=12.0, vibration=0.0, settings=worse)
    log, rig = tmp_path / "drive.mcap", tmp_path / "rig.yaml"
    simulation.write(log)
    sensors = {name: simulation.rig.sensors[name] for name in ("imu", "prism")}
    machine = simulation.rig.model_copy(update={"sensors": sensors})
    rig.write_text(dump_rig(override(machine, ["zero_velocity.enabled=false"])))
    rows = speed.measure(Namespace(log=log, rig=str(rig), assignments=[], repeat=1))
    found = {(row.estimator, row.metric): row for row in rows}
    assert found["tbmfg", "position_difference"].mean < 0.05
    assert found["tbmfg", "position_sd_ratio"].mean == pytest.approx(1.0, abs=0.01)
    stages = [found["tbmfg", stage].mean for stage in speed.SHOWN]
    assert min(stages) > 0
    assert sum(stages[:-1]) <= stages[-1]
    assert found["tbmfg", "total / bare"].bound == (None, speed.LIMIT)


def test_outliers_are_paired_with_the_fixes_that_were_made_wrong():
    job = outliers.Job(seed=0, duration_s=20.0, size_m=2.0, shares=(0.3,), estimators=("batch",))
    found = outliers.run(job)
    clean, hit = found[0.0, "batch"], found[0.3, "batch"]
    assert clean["wrong"] == 0
    assert hit["wrong"] == hit["gated_wrong"] > 10
    assert hit["wrong"] + hit["sound"] == clean["sound"]
    rows = {row.metric: row for row in outliers.summarised("x", 0.3, "batch", [found, found])}
    assert rows["gated_wrong"].mean == 100.0
    assert rows["gated_wrong"].inside
    assert rows["position_loss"].mean == pytest.approx(100.0 * (hit["position"] / clean["position"] - 1.0))
    worse = {**found, (0.3, "batch"): hit | {"gated_wrong": 0.98 * hit["wrong"], "position": 2.0 * clean["position"]}}
    rows = {row.metric: row for row in outliers.summarised("x", 0.3, "batch", [worse])}
    assert not rows["gated_wrong"].inside
    assert not rows["position_loss"].inside


def test_pace_of_the_costly_steps(monkeypatch):
    monkeypatch.setattr(pace, "COLUMNS", 120)
    rows = pace.measure(Namespace(emd=5.0, drive=3.0, scans=20))
    found = {(row.estimator, row.metric): row for row in rows}
    assert found["emd", "times_real_time"].mean > 1
    assert found["lidar", "cost"].n == found["bare", "cost"].n == 30
    ratio = found["lidar", "cost"].mean / found["bare", "cost"].mean
    assert found["lidar", "ratio"].mean == pytest.approx(ratio)
    assert found["lidar", "growth"].mean >= 0


def test_the_worst_of_many_is_told_by_the_covariance():
    assert lidar.worst_told(np.ones((1, 3))) == pytest.approx(np.sqrt(chi2.ppf(0.95, 3)), rel=0.02)
    ten = chi2.ppf(0.95**0.1, 1)  # all ten below
    assert lidar.worst_told(np.tile([2.0, 0.0, 0.0], (10, 1))) == pytest.approx(2.0 * np.sqrt(ten), rel=0.02)


def test_scans_that_are_lost_and_flagged():
    truth = np.tile(np.eye(4), (10, 1, 1))
    truth[:, 0, 3] = 0.5 * np.arange(10)

    def register(points, t_s):
        T = truth[int(t_s)].copy()
        T[1, 3] = 0.4 if t_s >= 6 else 0.0
        return T, t_s in (2, 7)

    found = scans._run(register, iter([np.ones((5, 3))] * 10), np.arange(10.0), truth, True)
    assert (found["lost"], found["late"]) == (6, 1)
    assert found["flagged"] == pytest.approx(100 / 6)
    straight = scans._run(
        lambda points, t_s: (truth[int(t_s)], False), iter([np.ones((5, 3))] * 10), np.arange(10.0), truth, True
    )
    assert (straight["lost"], straight["late"], straight["flagged"]) == (10, 0, 0)
    rows = {(row.estimator, row.metric): row for row in scans._rows("x", {"ours": [straight], "KISS-ICP": [found]})}
    assert rows["ours", "lost"].inside
    assert rows["ours", "late"].inside
    assert ("KISS-ICP", "late") not in rows
