"""The papers' experiments: comparisons on numbers whose answer is known, how faults are judged, and a tiny run."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import datasets
from benchmarks.__main__ import main
from benchmarks.papers import Plan, sbm, shearer, tbm, tbm_drives
from benchmarks.papers.trials import Method, Outcome, Outcomes, Trial, confidence, run
from benchmarks.rows import read_rows
from benchmarks.runs import true_states
from tbmfg.evaluation.metrics import chi_square_bounds
from tbmfg.geometry import matrix_from_quat
from tbmfg.state import Innovations, Interval, Result, Trajectory
from tests.test_datasets_sensors import assert_chi_square

ERRORS = {"plain": [10.0, 12.0, 8.0, 11.0], "better": [4.0, 5.0, 3.5, 5.5], "best": [2.0, 2.5, 1.5, 2.0]}


@pytest.fixture
def ladder():
    """Three methods on four logs."""
    nees = (6.0, 12.0, 6.0)
    return Outcomes(
        [
            Outcome("cut", method, seed, {"max": (value, "m")}, (10.0, 20.0, 30.0), nees)
            for method, values in ERRORS.items()
            for seed, value in enumerate(values)
        ]
    )


# ---- comparisons ----


def test_rows_hold_means_what_is_published_and_consistency(ladder):
    rows = {row.key: row for row in ladder.rows("cut", {("better", "max"): 9.0}, {"max": (None, 5.0)})}
    better = rows["cut", "better", "max"]
    assert (better.mean, better.published, better.n, better.inside) == (4.5, 9.0, 4, True)
    assert not rows["cut", "plain", "max"].inside
    assert rows["cut", "better", "max / published"].mean == 0.5
    assert ("cut", "best", "max / published") not in rows
    assert rows["cut", "best", "failed"].mean == 0
    nees = rows["cut", "best", "nees_pose@20s"]
    assert nees.mean == 2.0
    # one false alarm in a hundred is shared by three epochs of three methods
    assert nees.bound == pytest.approx(tuple(np.array(chi_square_bounds(4, 6, 0.01 / 9)) / 6))


def test_reductions_and_ordering(ladder):
    assert ladder.reduction("cut", "better", "plain", "max", 60.0).mean == pytest.approx(100 * (1 - 18.0 / 41.0))
    assert ladder.ordering("cut", ["plain", "better", "best"], "max").inside
    assert not ladder.ordering("cut", ["plain", "best", "better"], "max").inside


def test_pairs_are_compared_log_by_log(ladder):
    mean, low, high = ladder.paired("cut", "best", "better", "max")
    gain = np.array(ERRORS["better"]) - np.array(ERRORS["best"])
    assert mean.mean == pytest.approx(gain.mean())
    reach = 3.182446 * gain.std(ddof=1) / 2.0  # Student's t with 3 degrees of freedom, two-sided 95 %
    assert (low.mean, high.mean) == pytest.approx((gain.mean() - reach, gain.mean() + reach), rel=1e-6)
    assert low.inside
    assert not ladder.paired("cut", "better", "best", "max")[1].inside
    assert not ladder.paired("cut", "better", "best", "max", hold="not worse")[2].inside
    assert ladder.paired("cut", "best", "better", "max", hold="not worse")[2].inside
    assert {row.inside for row in ladder.paired("cut", "better", "best", "max", hold="nothing")} == {None}
    lone = Outcomes([one for one in ladder.outcomes if one.method != "best" or one.seed == 0])
    assert lone.paired("cut", "best", "better", "max") == []


def test_confidence_interval_holds_the_mean_as_often_as_it_says():
    draws = np.random.default_rng(1).standard_normal((4000, 6)) + 3.0
    inside = np.mean([low < 3.0 < high for low, high in map(confidence, draws)])
    assert inside == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / 4000))


def test_failed_logs_are_counted_and_left_out(ladder):
    outcomes = Outcomes([*ladder.outcomes, Outcome("cut", "plain", 4, {}, failure="not determined")])
    rows = {row.key: row for row in outcomes.rows("cut", {}, {})}
    assert (rows["cut", "plain", "failed"].mean, rows["cut", "plain", "failed"].inside) == (1, False)
    assert rows["cut", "plain", "max"].n == 4
    assert outcomes.paired("cut", "better", "plain", "max")[0].n == 4


def test_errors_over_their_bound():
    runs = [
        Outcome("nominal", "batch", seed, {"rms_horizontal": (rms, "m"), "sd_horizontal": (0.5, "m")})
        for seed, rms in enumerate([0.3, 0.4, 0.5])
    ]
    ratio, low, high = shearer.over_bound(Outcomes(runs), "nominal", "batch")
    assert ratio.mean == pytest.approx(np.sqrt((0.36 + 0.64 + 1.0) / 3))
    assert low.mean < ratio.mean < high.mean
    assert low.inside
    assert shearer.over_bound(Outcomes(runs[:1]), "nominal", "batch") == []


def test_surveyed_end_is_the_end_within_its_sd():
    errors = []
    for seed in range(30):
        simulation = datasets.make("shearer-cut", seed=seed, duration=2.0)
        [point] = shearer.surveyed_end(simulation, seed).survey
        assert point.at == "end"
        errors.append((np.array(point.position_m) - simulation.truth(np.array([2.0])).position[0]) / point.sigma_m)
    assert_chi_square(np.array(errors))


# ---- magnetic faults ----


def seen(simulation, gated, intervals=()):
    """A result of an estimator that sets samples ``gated`` (n,) aside and names ``intervals`` (start, end) in s."""
    t_ns = simulation.clean["magnetometer"].t_ns
    named = [Interval("magnetometer", "gated", *(simulation.start_ns + round(t * 1e9) for t in s)) for s in intervals]
    return SimpleNamespace(
        estimator="batch",
        trajectory=SimpleNamespace(t_ns=t_ns),
        intervals=[Interval("odometer", "gated", simulation.start_ns, simulation.start_ns + 85 * 10**9), *named],
        innovations={"magnetometer": Innovations(t_ns, np.zeros(len(t_ns)), 1, gated)},
    )


@pytest.fixture(scope="module", params=["offset", "spikes"])
def disturbed(request):
    return request.param, datasets.make("shearer-magfault", seed=1, duration=40.0, fault=request.param)


def test_what_is_seen_of_a_fault_is_judged_by_what_was_done(disturbed, monkeypatch):
    fault, simulation = disturbed
    monkeypatch.setattr(shearer, "errors", lambda *_: {})
    count = len(simulation.clean["magnetometer"])
    told = simulation.drawn["magnetometer"]
    if fault == "spikes":
        clear = np.abs(told["fault_yaw_deg"]) > 5 * 0.5
        half = clear & (np.cumsum(clear) % 2 == 0)
        found = shearer.fault_errors(simulation, seen(simulation, half), None)
        assert found["spikes_found"][0] == pytest.approx(50.0, abs=100.0 / clear.sum())
        assert found["sound_gated"][0] == 0.0
        return
    gated = np.zeros(count, dtype=bool)
    gated[:50] = True  # the first five of the twenty sound seconds
    # two pieces that lie close together are one stretch; another far away is not
    result = seen(simulation, gated, [(11.0, 18.0), (18.4, 29.0), (2.0, 5.0)])
    found = shearer.fault_errors(simulation, result, None)
    # 20 degrees within a second: 3 sds of 0.5 degrees are first exceeded at 10.1 s, last at 29.9 s
    assert found["fault_start"][0] == pytest.approx(0.9)
    assert found["fault_end"][0] == pytest.approx(0.9)
    assert found["sound_gated"][0] == pytest.approx(100.0 * 50 / 200, abs=0.5)
    nothing = shearer.fault_errors(simulation, seen(simulation, gated), None)
    assert nothing["fault_start"][0] > 20.0


# ---- the command ----


@pytest.mark.slow
def test_shearer_paper_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shearer, "ALL", shearer.FEW)
    monkeypatch.setattr(shearer, "ABLATION", tuple(Method(name, name) for name in ("shearer-ckf", "shearer-afkf")))
    monkeypatch.setattr(shearer, "SCALES", {})
    out = tmp_path / "rows.json"
    assert (
        main(["papers", "--paper", "shearer", "--seeds", "2", "--duration", "12", "--jobs", "1", "--json", str(out)])
        == 0
    )
    rows = {row.key: row for row in read_rows(out)}
    assert {key[0] for key in rows} == {
        "nominal",
        "surveyed end",
        "aligned",
        "mti30=printed",
        "offset",
        "field",
        "spikes",
    }
    assert all(row.mean == 0 for row in rows.values() if row.metric == "failed")
    assert rows["nominal", "shearer-sins", "max_east"].published == 3.9664
    assert rows["nominal", "shearer-ckf", "max_north less than shearer-sins-od"].published == 74.01
    assert rows["offset", "shearer-afkf", "max_east less than shearer-ckf"].published == 59.6
    # 20 degrees are felt within the second and a half that they are there
    yaw = {scenario: rows[scenario, "shearer-ckf", "rms_yaw"].mean for scenario in ("nominal", "offset")}
    assert yaw["offset"] > 2 * yaw["nominal"]
    assert "nees_pose@12s" in capsys.readouterr().out


@pytest.mark.slow
def test_shaft_machine_paper_runs(tmp_path, monkeypatch):
    few = {"dynamic": ("shaft-dynamic", {}, sbm.FEW), "fast cage": ("cage-fast", {}, sbm.FEW)}
    monkeypatch.setattr(sbm, "SCENARIOS", few)
    out = tmp_path / "rows.json"
    arguments = ["papers", "--paper", "sbm", "--seeds", "1", "--duration", "12", "--jobs", "1", "--json", str(out)]
    assert main(arguments) == 0
    rows = {row.key: row for row in read_rows(out)}
    assert {key[0] for key in rows} == {"dynamic", "fast cage", "cost"}
    assert all(row.mean == 0 for row in rows.values() if row.metric == "failed")
    assert rows["dynamic", "sbm-cf", "yaw"].published == 3.52
    assert rows["dynamic", "sbm-ekf", "yaw over sbm-cfekf"].published == pytest.approx(2.73 / 1.16)
    assert rows["dynamic", "batch", "pitch over best filter"].bound[1] >= 0.5
    assert rows["dynamic", "batch", "yaw over best filter"].bound[1] >= 1.0
    assert rows["dynamic", "batch", "roll_true"].mean == pytest.approx(0.5, rel=0.4)  # not a whole period in 12 s
    assert rows["fast cage", "sbm-cfekf", "speed"].published == 0.06
    assert ("fast cage", "batch", "roll") not in rows
    # two Kalman filter steps of 9 states against a handful of cross products: more, by how much is the machine's
    assert rows["cost", "sbm-ekf", "per step over sbm-cf"].mean > 1


def test_errors_of_the_shaft_machine_are_those_of_angles_detector_and_depth():
    """An estimate that is wrong by a known amount: 1 degree of roll, 2 of pitch, 3 of yaw, 4 cm, 5 m and 6 m/s."""
    simulation = datasets.make("shaft-descend", seed=1, duration=2.0, nominal=1)
    t_ns = simulation.start_ns + np.arange(0, 2_000_000_000, 100_000_000)
    truth = true_states(simulation, t_ns)
    angles = sbm.angles_deg(matrix_from_quat(truth.quat_xyzw)) + np.array([3.0, 2.0, 1.0])
    R = Rotation.from_euler("ZYX", angles, degrees=True)
    detector = np.array([0.0, 0.0, 0.1])
    held = truth.position_n + matrix_from_quat(truth.quat_xyzw) @ detector - R.as_matrix() @ detector
    position = np.column_stack([held[:, :2] + [0.024, 0.032], truth.position_n[:, 2] - 5.0])
    n = len(t_ns)
    path = Trajectory(
        t_ns, position, R.as_quat(), truth.velocity_n - [0, 0, 6.0], np.zeros((n, 3)), np.zeros((n, 3)),
        np.zeros((n, 15, 15)),
    )  # fmt: skip
    found = sbm.errors(simulation, Result("ins", path), truth)
    expected = {"roll": 1.0, "pitch": 2.0, "yaw": 3.0, "displacement": 4.0, "depth": 5.0, "speed": 6.0}
    told = {"classified": 0.0, "false_stop": 100.0}  # it stands upright, and the yaw says that it should stop
    assert {name: value for name, (value, _) in found.items()} == pytest.approx(expected | told)


def test_the_pump_turns_the_heading_of_a_mean_and_not_of_a_rotation():
    rows = {row.key: row for row in tbm.static(Plan(range(1), 8.0, 1))}
    turned = {name: rows["static", name, "yaw, pump on - off"] for name in (tbm.PLAIN, tbm.PRINTED, tbm.ROTATION)}
    assert turned[tbm.PLAIN].published == 0.38
    assert turned[tbm.ROTATION].mean < 0.2 * turned[tbm.PLAIN].mean
    # modes of a skewed waveform take many times the Earth's rate with them
    assert turned[tbm.PRINTED].mean > 1.0
    reduction = rows["static", tbm.ROTATION, "less than the mean"]
    assert reduction.mean == pytest.approx(100 * (1 - turned[tbm.ROTATION].mean / turned[tbm.PLAIN].mean))
    assert reduction.inside


def test_the_roadheaders_drives_are_measured():
    """On a drive without its LiDAR, which takes longer than all else."""
    methods = tuple(method for method in tbm_drives.METHODS if method.estimator in ("tbm-ins-ts", "ins", "batch"))
    options = {"imu_rate_hz": 100.0}
    trial = Trial("dust", "tbm-drive", 0, 12.0, methods, tbm_drives.errors, options=options, least=tbm_drives.least)
    rows = {row.key: row for row in Outcomes(run(trial)).rows("dust", {}, {})}
    # the arm alone is known to 5 mm an axis; and one log is one draw of it
    bound = rows["dust", "batch", "position_rms_bound"].mean
    assert 0.005 < bound < 0.012
    assert rows["dust", "batch", "position_rms"].mean < bound * np.sqrt(chi2.ppf(0.9999, 3) / 3)
    assert ("dust", "ins", "position_rms_bound") not in rows
    assert rows["dust", "tbm-ins-ts", "failed"].mean == 0
    assert 0 < rows["dust", "tbm-ins-ts", "position_rms"].mean < 0.1
    assert rows["dust", "ins", "over 0.3 m"].mean == 0


def test_the_smoother_is_held_to_half_of_the_best_filter_or_to_what_the_log_can_tell():
    def rows(batch, bound, best):
        found = [outcome("dust", "batch", "hidden_rms", batch), outcome("dust", "batch", "hidden_rms_bound", bound)]
        found += [
            outcome("dust", name, "hidden_rms", best * (2 - (name == tbm_drives.STAR))) for name in tbm_drives.FILTERS
        ]
        over_bound, over_best = tbm_drives.over_best_filter(Outcomes(found), "dust")
        return over_bound.mean, over_best.mean, over_best.bound[1]

    assert rows(0.03, 0.02, 0.1) == pytest.approx((1.5, 0.3, 0.5))
    assert rows(0.009, 0.0086, 0.01) == pytest.approx((0.009 / 0.0086, 0.9, 1.05 * 0.86))


def outcome(scenario, method, metric, value):
    return Outcome(scenario, method, 0, {metric: (value, "m")})


def test_the_published_ordering_is_looked_for_log_by_log():
    names = (tbm_drives.MSE, tbm_drives.RRR, tbm_drives.LINS)

    def seen(scenario, metric, *values):
        found = Outcomes([outcome(scenario, name, metric, v) for name, v in zip(names, values, strict=True)])
        return tbm_drives.ordering(found, scenario).mean

    assert seen("clean", "z_max", 0.015, 0.018, 0.1) == 100
    assert seen("clean", "z_max", 0.015, 0.05, 0.1) == 0  # not alike
    assert seen("clean", "z_max", 0.015, 0.018, 0.01) == 0
    assert seen("dust 0.2", "position_max", 0.1, 5.0, 2.0) == 100
    assert seen("dust 0.2", "position_max", 0.4, 5.0, 2.0) == 0
    assert seen("dust 0.2", "position_max", 0.1, 5.0, 0.2) == 0
    levels = Outcomes(
        [
            outcome(tbm_drives.dusty(k), "ins", "position_max", v)
            for k, v in zip(tbm_drives.DUST, (0.1, 0.4, 9), strict=True)
        ]
    )
    assert tbm_drives.level(levels, "ins").mean == 0.2
    assert tbm_drives.level(levels, "batch").mean is None


def test_lins_is_measured_against_the_other_filter_as_in_the_tables():
    t_ns = np.arange(40) * 100_000_000
    straight = np.column_stack([0.01 * np.arange(40), np.zeros((40, 2))])

    def result(name, position):
        quat = np.tile([0.0, 0.0, 0.0, 1.0], (40, 1))
        return Result(name, Trajectory(t_ns, position, quat, *np.zeros((3, 40, 3)), np.zeros((40, 15, 15))))

    results = {name: result(name, straight * share) for name, share in ((tbm_drives.MSE, 1.0), (tbm_drives.LINS, 2.0))}
    found = tbm_drives.between(results)[tbm_drives.LINS]
    assert found["ape to tbm-mse, max"][0] == pytest.approx(0.39)
    assert found["ape to tbm-mse, min"][0] == 0
    assert found["rpe to tbm-mse, mean"][0] == pytest.approx(0.1)
    assert found["rpe to tbm-mse, sd"][0] == pytest.approx(0, abs=1e-12)
    assert tbm_drives.between({tbm_drives.LINS: results[tbm_drives.LINS]}) == {}


def test_wrong_papers_and_numbers_are_refused(capsys):
    assert main(["papers", "--seeds", "0"]) == 1
    assert capsys.readouterr().err.startswith("error: ")
    with pytest.raises(SystemExit):
        main(["papers", "--paper", "moon"])
