"""Metrics against closed forms, against theory on seeded noise, and against evo."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tbmfg.evaluation.correlation import correlation_time, effective_samples
from tbmfg.evaluation.metrics import (
    align,
    chi_square_bounds,
    evaluate,
    expected,
    nees,
    over,
    trajectory_errors,
    truth_at,
)
from tbmfg.geometry import split_yaw_tilt
from tbmfg.results import write_tum
from tbmfg.state import POS, ROT, Trajectory, Truth

EPOCH_NS = 1_700_000_000_123_456_789


def drive(n: int = 200, dt: float = 0.1) -> Truth:
    """A climbing curve with turning attitude: nothing in it is zero or straight."""
    t = np.arange(n) * dt
    position = np.stack([20 * np.sin(0.1 * t), 15 * np.cos(0.13 * t), 0.3 * t + np.sin(0.4 * t)], axis=1)
    velocity = np.stack([2 * np.cos(0.1 * t), -1.95 * np.sin(0.13 * t), 0.3 + 0.4 * np.cos(0.4 * t)], axis=1)
    R = Rotation.from_euler("ZYX", np.stack([0.3 * t, 0.2 * np.sin(t), 0.1 * np.cos(t)], axis=1))
    return Truth(EPOCH_NS + np.rint(t * 1e9).astype(np.int64), position, R.as_quat(), velocity)


def estimate(truth: Truth, rotation_b=0.0, position_n=0.0, velocity_n=0.0, cov=None) -> Trajectory:
    """The truth with these errors; R_est = R_true Exp(rotation_b)."""
    n = len(truth.t_ns)
    rotvec = np.array(np.broadcast_to(rotation_b, (n, 3)))
    R = Rotation.from_quat(truth.quat_xyzw) * Rotation.from_rotvec(rotvec)
    return Trajectory(
        t_ns=truth.t_ns,
        position_n=truth.position_n + position_n,
        quat_xyzw=R.as_quat(),
        velocity_n=truth.velocity_n + velocity_n,
        bias_acc=np.zeros((n, 3)),
        bias_gyro=np.zeros((n, 3)),
        cov=np.broadcast_to(np.eye(15) if cov is None else cov, (n, 15, 15)),
    )


def test_constant_errors_give_their_size():
    truth = drive()
    metrics = evaluate(estimate(truth, position_n=[0.3, 0.0, 0.4], velocity_n=[0.0, 0.1, 0.0]), truth)
    assert metrics["position_rms_m"] == pytest.approx(0.5)
    assert metrics["ape_rms_m"] == pytest.approx(0.0, abs=1e-12)  # a shift is aligned away
    assert metrics["velocity_rms_mps"] == pytest.approx(0.1)
    assert metrics["attitude_rms_deg"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["evaluated"] == len(truth.t_ns)
    assert metrics["nees_mean"] == pytest.approx(0.25)
    assert metrics["outage_position_rms_m"] is None


def test_yaw_and_tilt_are_split_about_the_vertical_of_n():
    truth = drive()
    R_nb = Rotation.from_quat(truth.quat_xyzw)
    tilt, turn = (Rotation.from_rotvec(axis, degrees=True) for axis in ([0.3, -0.4, 0.0], [0.0, 0.0, 1.2]))
    turn_n = (tilt * turn).as_rotvec()
    metrics = evaluate(estimate(truth, rotation_b=R_nb.inv().apply(turn_n)), truth)
    assert metrics["yaw_rms_deg"] == pytest.approx(1.2)
    assert metrics["tilt_rms_deg"] == pytest.approx(0.5)
    assert metrics["attitude_rms_deg"] == pytest.approx(1.3, rel=1e-4)  # of a triangle on a sphere


def test_outages_select_their_keyframes():
    truth = drive(100)
    shift = np.zeros((100, 3))
    shift[20:30, 1] = 2.0
    inside = (int(truth.t_ns[20]), int(truth.t_ns[29]))
    assert evaluate(estimate(truth, position_n=shift), truth, [inside])["outage_position_rms_m"] == pytest.approx(2.0)


@pytest.mark.parametrize("arm_b", [(0.0, 0.0, 0.0), (30.0, -5.0, 8.0)])
def test_what_a_covariance_says_is_the_size_of_errors_drawn_from_it(arm_b):
    """Rotations of a degree about every axis of b by another sd, correlated with positions of decimetres."""
    truth, rng = drive(20_000, 0.01), np.random.default_rng(4)
    root = np.diag(np.repeat([0.01, 0.2, 0.1, 1e-3, 1e-5], 3) * np.tile([1.0, 2.0, 0.3], 5))
    root[POS, ROT] = 0.1 * rng.standard_normal((3, 3))
    drawn = rng.standard_normal((20_000, 15)) @ root.T
    path = estimate(truth, drawn[:, ROT], drawn[:, POS], drawn[:, 6:9], root @ root.T)
    outages = [(truth.t_ns[5000], truth.t_ns[9999])]
    moved = truth.position_n + Rotation.from_quat(truth.quat_xyzw).apply(arm_b)
    point = replace(truth, position_n=moved, arm_b=np.array(arm_b))
    metrics, said = evaluate(path, point, outages), expected(path, point, outages)
    names = {"position_rms_m", "outage_position_rms_m", "attitude_rms_deg", "yaw_rms_deg", "tilt_rms_deg"}
    assert set(said) == names | ({"velocity_rms_mps"} if not any(arm_b) else set())
    # 5000 draws: a mean square of one component has a relative sd of 2 %, its root of 1 %; arms bend what is linear
    for name, value in said.items():
        assert value == pytest.approx(metrics[name], rel=0.03), name
    ratios = over(metrics, said)
    assert ratios["bound_yaw_rms_deg"] == said["yaw_rms_deg"]
    assert ratios["yaw_over_bound"] == pytest.approx(metrics["yaw_rms_deg"] / said["yaw_rms_deg"])
    assert over(metrics, {"yaw_rms_deg": 0.0})["yaw_over_bound"] is None


def test_missing_truth_columns_are_null_and_leave_position_nees():
    truth = drive()
    bare = replace(truth, quat_xyzw=None, velocity_n=None)
    metrics = evaluate(estimate(truth, rotation_b=[0.5, 0, 0], position_n=[1.0, 1.0, 1.0]), bare)
    assert [metrics[k] for k in ("attitude_rms_deg", "yaw_rms_deg", "tilt_rms_deg", "velocity_rms_mps")] == [None] * 4
    assert metrics["nees_dof"] == 3
    assert metrics["nees_mean"] == pytest.approx(3.0)


def test_no_overlap_and_diverged_estimates_are_null_not_errors():
    truth = drive()
    early = replace(estimate(truth), t_ns=truth.t_ns - 10**12)
    metrics = evaluate(early, truth)
    assert metrics.pop("evaluated") == 0
    assert metrics.pop("nees_evaluated") == 0
    assert metrics.pop("nees_dof") == 6
    assert set(metrics.values()) == {None}
    broken = estimate(truth)
    broken.position_n[50] = np.nan
    broken.quat_xyzw[50] = np.nan
    metrics = evaluate(broken, truth)
    assert metrics["ape_rms_m"] is metrics["position_rms_m"] is metrics["attitude_rms_deg"] is None
    assert metrics["nees_evaluated"] == len(truth.t_ns) - 1


def test_interpolation_follows_the_curve_between_samples():
    fine, coarse = drive(1001, dt=0.02), drive(101, dt=0.2)
    covered, between = truth_at(coarse, fine.t_ns)
    assert covered.all()
    # Hermite: |p''''| h^4 / 384 with |p''''| <= 0.4^4 + ... < 0.04; a linear chord would be off by 1e-3.
    assert_allclose(between.position_n, fine.position_n, atol=0.04 * 0.2**4 / 384 * 1.1)
    turn = Rotation.from_quat(between.quat_xyzw).inv() * Rotation.from_quat(fine.quat_xyzw)
    assert turn.magnitude().max() < 0.25 * 0.2**2 / 8  # angular acceleration h^2 / 8
    _, linear = truth_at(replace(coarse, velocity_n=None), fine.t_ns)
    assert 3e-4 < np.abs(linear.position_n - fine.position_n).max() < 0.4 * 0.2**2 / 8
    assert_allclose(linear.position_n[::10], coarse.position_n, rtol=0, atol=0)


def test_keyframes_outside_the_truth_or_in_its_gaps_are_not_evaluated():
    truth = drive(200)
    kept = np.r_[20:80, 120:180]
    sparse = Truth(truth.t_ns[kept], truth.position_n[kept], truth.quat_xyzw[kept], truth.velocity_n[kept])
    errors = trajectory_errors(estimate(truth), sparse)
    assert_allclose(errors.rows, kept)


def test_alignment_recovers_a_transform():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(50, 3)) * [30, 20, 1]
    R = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    R_found, p_found = align(points, points @ R.T + [100.0, -5.0, 3.0])
    assert_allclose(R_found, R, atol=1e-12)
    assert_allclose(p_found, [100.0, -5.0, 3.0], atol=1e-11)


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_alignment_of_a_straight_line_is_a_rotation(rows):
    line = np.outer(np.arange(rows), [1.0, 2.0, 3.0])
    R, p = align(line, line[:, ::-1] + 7.0)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert_allclose(line @ R.T + p, line[:, ::-1] + 7.0, atol=1e-12)


def correlated_errors(rng, runs: int, cov) -> np.ndarray:
    return rng.multivariate_normal(np.zeros(len(cov)), cov, size=runs)


def pose_cov() -> np.ndarray:
    """Milliradians and decimetres, correlated."""
    mix = np.random.default_rng(2).normal(size=(6, 6))
    scale = np.diag([1e-3, 2e-3, 5e-3, 0.1, 0.2, 0.05])
    return scale @ (mix @ mix.T + np.eye(6)) @ scale


@pytest.mark.parametrize(("factor", "consistent"), [(1.0, True), (0.8, False), (1.25, False)])
def test_nees_tells_consistent_from_inconsistent_errors(factor, consistent):
    rng = np.random.default_rng(3)
    truth, cov = drive(1000), np.eye(15)
    cov[:6, :6] = pose_cov()
    drawn = correlated_errors(rng, 1000, cov[:6, :6])
    metrics = evaluate(estimate(truth, drawn[:, ROT], drawn[:, POS], cov=cov * factor), truth)
    low, high = chi_square_bounds(metrics["nees_n_eff"], 6, alpha=0.01)
    assert (low < metrics["nees_mean"] < high) == consistent
    assert metrics["nees_n_eff"] > 900  # independent draws count fully


def test_nees_leaves_singular_covariances_out():
    cov = np.stack([np.eye(6), np.diag([1, 1, 1, 1, 1, 0.0]), np.ones((6, 6)), np.full((6, 6), np.nan)])
    assert_allclose(nees(np.ones((4, 6)), cov), [6.0, np.nan, np.nan, np.nan])


def ar1(rng, n: int, a: float) -> np.ndarray:
    x = rng.standard_normal(n)
    for i in range(1, n):
        x[i] = a * x[i - 1] + np.sqrt(1 - a * a) * x[i]
    return x


@pytest.mark.parametrize("a", [0.0, 0.5, 0.9])
def test_effective_samples_of_an_autoregressive_series(a):
    rng = np.random.default_rng(4)
    t_ns = EPOCH_NS + np.arange(20_000) * 40_000_000
    found = effective_samples(t_ns, ar1(rng, 20_000, a))
    # Sokal: relative sd of the correlation time is sqrt(2 (2 M + 1) / n), M = 6 correlation times
    correlation = (1 + a) / (1 - a) / 2
    sd = np.sqrt(2 * (12 * correlation + 1) / 20_000)
    assert found == pytest.approx(20_000 / (2 * correlation), rel=3.5 * sd)


def test_correlation_time_does_not_depend_on_sampling():
    """The same process (T = 0.4 s), regular and with a third of its samples and a long stretch missing."""
    rng = np.random.default_rng(5)
    t_ns = EPOCH_NS + np.arange(100_000) * 20_000_000
    x = ar1(rng, len(t_ns), np.exp(-0.02 / 0.4))
    kept = rng.random(len(t_ns)) > 0.33
    kept[40_000:60_000] = False
    assert correlation_time(t_ns, x) == pytest.approx(0.4, rel=0.15)
    assert correlation_time(t_ns[kept], x[kept]) == pytest.approx(0.4, rel=0.2)


def test_effective_samples_at_the_edges():
    t_ns = np.arange(100) * 10**8
    assert effective_samples(t_ns, np.ones(100)) == 1.0
    assert effective_samples(t_ns, np.tile([-1.0, 1.0], 50)) == 100.0
    assert effective_samples(t_ns[:1], np.ones(1)) == 1.0


def test_chi_square_bounds_of_one_sample():
    # chi-square with 6 degrees of freedom: 0.5 % and 99.5 % points
    assert_allclose(chi_square_bounds(1, 6, 0.01), [0.6757, 18.5476], atol=1e-4)
    low, high = chi_square_bounds(1e4, 6)
    assert low == pytest.approx(6 - 2.576 * np.sqrt(12 / 1e4), abs=2e-3)
    assert high == pytest.approx(6 + 2.576 * np.sqrt(12 / 1e4), abs=2e-3)


def test_ape_equals_evo(tmp_path):
    evo_ape = Path(sys.executable).parent / "evo_ape"
    if not evo_ape.exists():
        pytest.skip("evo is not installed beside this Python: pip install evo")
    rng = np.random.default_rng(6)
    truth = drive(300)
    tilted = Rotation.from_rotvec([0.05, -0.02, 0.7]).apply(truth.position_n + rng.normal(0, 0.05, (300, 3)))
    found = replace(estimate(truth), position_n=tilted + np.array([5.0, -3.0, 1.0]))
    write_tum(tmp_path / "truth.tum", truth.t_ns, truth.position_n, truth.quat_xyzw)
    write_tum(tmp_path / "found.tum", found.t_ns, found.position_n, found.quat_xyzw)
    ran = subprocess.run(
        [evo_ape, "tum", "truth.tum", "found.tum", "-a"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    stated = dict(line.split() for line in ran.stdout.splitlines() if len(line.split()) == 2)
    metrics = evaluate(found, truth)
    assert metrics["ape_rms_m"] == pytest.approx(float(stated["rmse"]), abs=1e-6)
    assert metrics["ape_max_m"] == pytest.approx(float(stated["max"]), abs=1e-6)


def test_split_of_an_attitude_error_is_that_of_the_dataset():
    """Laidig et al. (2021): q = q_est q_true^-1 in n; heading 2 atan(z / w), inclination 2 acos sqrt(w^2 + z^2)."""
    rotvec = np.random.default_rng(1).normal(size=(200, 3)) * np.linspace(1e-6, 1.5, 200)[:, None]
    rotvec = rotvec[np.linalg.norm(rotvec, axis=1) < np.pi]
    z, w = Rotation.from_rotvec(rotvec).as_quat(canonical=True).T[2:]
    heading, inclination = split_yaw_tilt(rotvec)
    assert_allclose(np.abs(heading), 2 * np.arctan(np.abs(z / w)), rtol=1e-9)
    assert_allclose(np.cos(inclination / 2), np.sqrt(w**2 + z**2), rtol=1e-9)
