"""Scans on a map: the iterated update, its consistency, what walls do not tell, and logs that are not right."""

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

import datasets
from benchmarks.runs import held, in_memory, true_states
from tbmfg.errors import EstimationError
from tbmfg.estimators import estimate, unmet
from tbmfg.evaluation.metrics import nees, trajectory_errors
from tbmfg.filters.kalman import correct
from tbmfg.filters.scanmap import CLONE, LOST, OnMap, ScanMap, Swept, moved, relative
from tbmfg.geometry import exp_so3, log_so3
from tbmfg.inertial.strapdown import correct_state
from tbmfg.lidar import features
from tbmfg.lidar.clouds import Scans
from tbmfg.lidar.surfels import SurfelMap
from tbmfg.prepare import prepare
from tbmfg.rig import Lidar, override
from tbmfg.state import NAV
from tests.test_features import SIGMA_M, wall

EXACT = OnMap(adaptive=False, scan_sd_m=1e-6, scan_sd_deg=1e-5)
SIZE = NAV + CLONE


def room(rng, count, share=1.0, half=(4.25, 2.75, 2.25)):
    """Points on the six walls of a box, on the middle ``share`` of each, (6 count, 3).

    The walls lie in the middle of voxels: where one lies on a border, its noise decides which points thinning leaves.
    """
    parts = []
    for axis in range(3):
        for side in (-1, 1):
            points = share * rng.uniform(-1, 1, (count, 3)) * half
            points[:, axis] = side * half[axis]
            parts.append(points)
    return np.concatenate(parts)


@cache
def known_map():
    table = SurfelMap(0.5, full=np.inf)
    table.add(room(np.random.default_rng(0), 20_000), np.zeros(3))
    return table


def on_map(switches=EXACT, own_map=None):
    """A filter's part that stands on a known map, in n's axes and without error."""
    scans = ScanMap("lidar", Scans(Lidar(topic="/points"), [], np.zeros(0), np.zeros(0, bool), 0.1), None, switches)
    scans.map = deepcopy(own_map or known_map())
    scans.pose = state(np.zeros(6))
    return scans


def state(d):
    x = np.zeros(21)
    x[:9] = np.eye(3).ravel()
    return correct_state(x, np.concatenate([d, np.zeros(NAV - 6)]))


def prior(scale=1.0):
    """Covariance with everything correlated but the map's pose, which is known."""
    rng = np.random.default_rng(1)
    A = rng.standard_normal((NAV, NAV)) * np.repeat([0.01, 0.02, 0.02, 1e-3, 1e-4], 3)[:, None] * scale
    P = np.zeros((SIZE, SIZE))
    P[:NAV, :NAV] = A @ A.T
    return P


def seen_from(x, count=60, seed=0, noise=0.0):
    """Points of the room's walls, away from its corners, in the body's axes."""
    points = room(np.random.default_rng(seed), count, 0.6)
    axis = np.repeat(np.arange(6) // 2, count)
    points[np.arange(len(points)), axis] += noise * np.random.default_rng(seed + 1).standard_normal(len(points))
    return Swept(0, 1, (points - x[9:12]) @ x[:9].reshape(3, 3), None)


# ---- the update ----


def test_six_rows_are_all_rows():
    """(39) and (41) with every distance of a scan, against the update, where all is linear: a displacement alone."""
    scans, P, x = on_map(), prior(), state(np.zeros(6))
    P[:3], P[:, :3] = 0.0, 0.0
    scan = seen_from(state(np.array([0, 0, 0, 0.02, -0.01, 0.015])), noise=SIGMA_M)
    dx, P1 = scans.update(scan, x, P)
    points = features.thinned(scan.points, 0.5)
    found = features.near(points, known_map())
    r, J, _ = features.distances(points, np.eye(3), np.zeros(3), found)
    D = np.zeros((len(r), SIZE))
    D[:, :6] = J
    expected, P_expected = correct(P, D / EXACT.sigma, r / EXACT.sigma)
    assert np.abs(expected[3:6]).max() > 0.01
    assert_allclose(dx, expected, atol=2e-6)  # the least sd of a scan, 1e-6 m
    sd = np.sqrt(np.diag(P_expected)) + 1e-9
    assert np.abs((P1 - P_expected) / np.outer(sd, sd)).max() < 1e-3


def test_the_iteration_ends_at_the_minimum_of_the_objective():
    """(36) with E21: no state beside the last one costs less, however far the way was (E22)."""
    scans, P = on_map(OnMap(adaptive=False, scan_sd_m=0.01, scan_sd_deg=0.1)), prior(4.0)
    x, P[:3], P[:, :3] = state(np.zeros(6)), 0.0, 0.0
    P[:3, :3] = 0.05**2 * np.eye(3)
    scan = seen_from(state(np.array([0.06, -0.05, 0.08, 0.05, -0.04, 0.06])))
    dx, P1 = scans.update(scan, x, P)
    points = features.thinned(scan.points, 0.5)
    R, p, _ = relative(x, state(np.zeros(6)), dx)
    found = features.near(points @ R.T + p, known_map())
    S, _ = scans._told(points, R, p, found)

    def cost(d):
        R, p, _ = relative(x, state(np.zeros(6)), d)
        off = S @ scans._told(points, R, p, found)[1]
        return d[:NAV] @ np.linalg.solve(P[:NAV, :NAV], d[:NAV]) + off @ off

    assert np.abs(dx[:6]).max() > 0.05
    sd = np.sqrt(np.diag(P1))
    # one sd away from the minimum of a quadratic, along any axis, the cost is higher by at least 1
    for k in range(6):
        for side in (-1, 1):
            assert cost(dx + side * sd[k] * np.eye(SIZE)[k]) - cost(dx) > 0.7
    assert_allclose(R, exp_so3(np.array([0.06, -0.05, 0.08])), atol=5e-3)


def test_relative_pose_and_its_derivative():
    x, pose, n = (
        state(np.array([0.3, -0.2, 0.5, 1.0, 2.0, -1.0])),
        state(np.array([-0.2, 0.4, 0.9, 3.0, -1.0, 0.5])),
        SIZE,
    )
    R, p, D = relative(x, pose, np.zeros(n))
    numeric, step = np.zeros((6, n)), 1e-6
    for k in range(n):
        ends = [relative(x, pose, s * step * np.eye(n)[k]) for s in (1, -1)]
        turns, ways = ([log_so3(R.T @ one[0]) for one in ends], [one[1] for one in ends])
        numeric[:, k] = np.concatenate([turns[0] - turns[1], ways[0] - ways[1]]) / (2 * step)
    assert_allclose(D, numeric, atol=1e-8)
    assert_allclose(moved(pose, np.zeros(6)), pose)
    assert_allclose(R @ np.zeros(3) + p, pose[:9].reshape(3, 3).T @ (x[9:12] - pose[9:12]))


def test_normalised_errors_are_chi_square_on_a_known_map():
    P, count = prior(), 60
    root = np.linalg.cholesky(P[:6, :6])
    errors, covs = [], []
    for seed in range(count):
        true = state(root @ np.random.default_rng(seed).standard_normal(6))
        dx, P1 = on_map().update(seen_from(true, 100, 1000 + 2 * seed, SIGMA_M), state(np.zeros(6)), P)
        found = state(dx[:6])
        R, R_true = found[:9].reshape(3, 3), true[:9].reshape(3, 3)
        errors.append(np.concatenate([log_so3(R_true.T @ R), found[9:12] - true[9:12]]))
        covs.append(P1[:6, :6])
    mean = nees(np.array(errors), np.array(covs)).mean() / 6
    low, high = chi2.ppf([0.005, 0.995], 6 * count) / (6 * count)
    assert low < mean < high


def test_what_the_walls_do_not_tell_is_left_to_the_prior():
    """Floor and side walls alone: noise of the normals must not hold the way along them."""
    rng = np.random.default_rng(2)
    points = np.concatenate([wall(axis, side * 2.0, rng, size=6.0) for axis in (1, 2) for side in (-1, 1)])
    table = SurfelMap(0.5)
    table.add(points, np.zeros(3))
    scan = Swept(0, 1, features.thinned(points[rng.permutation(len(points))], 0.5) - [0.3, 0.02, 0.01], None)
    P = prior()
    P[:6, :6] = np.diag(np.repeat([0.001, 0.05], 3) ** 2)
    P[:6, 6:], P[6:, :6] = 0.0, 0.0
    dx, P1 = on_map(OnMap(), table).update(scan, state(np.zeros(6)), P)
    assert abs(dx[3]) < 0.02
    assert P1[3, 3] > 0.99 * P[3, 3]
    assert_allclose(dx[4:6], [0.02, 0.01], atol=0.01)
    sure = on_map(OnMap(adaptive=False), table).update(scan, state(np.zeros(6)), P)[1]
    assert sure[3, 3] < 0.8 * P[3, 3]  # without the weighting it learns what it cannot know


def test_scans_without_hold_change_nothing_and_begin_a_new_map_in_the_end():
    scans, x, P = on_map(OnMap()), state(np.zeros(6)), prior()
    dust = Swept(0, 1, np.random.default_rng(3).uniform(-30, -20, (500, 3)), None)
    for _ in range(LOST):
        dx, P1 = scans.update(dust, x, P)
        assert not dx.any()
        assert P1 is P
    assert scans.unheld == LOST
    _, P1 = scans.update(dust, x, P)
    assert scans.begun == 1
    assert_allclose(P1[-6:, -6:], P[:6, :6])  # the new map is known as well as the body was


# ---- whole logs ----

RATES = {"imu_rate_hz": 100.0, "lidar_rate_hz": 5.0, "columns": 300}
ALL = ("tbm-mse", "tbm-mse-star", "tbm-lins")


@cache
def simulation():
    return datasets.make("tbm-clean", seed=0, duration=16.0, vibration=0.0, **RATES)


@cache
def log():
    return held(in_memory(simulation()))


@cache
def problem():
    return prepare(log(), simulation().rig)


def with_scans(change):
    """The problem with its clouds changed by ``change(k, fields)``."""
    own = problem().scans["lidar"]
    source = [(t_ns, change(k, fields)) for k, (t_ns, fields) in enumerate(own.source)]
    return replace(problem(), scans={"lidar": replace(own, source=source)})


def dusty(k, fields):
    """Echoes of dust about the LiDAR and nothing else."""
    rng = np.random.default_rng(k)
    return fields | {axis: rng.uniform(-3.0, 3.0, len(fields["x"])).astype(np.float32) for axis in "xyz"}


@cache
def drive(name):
    return estimate(name, problem())


@pytest.mark.parametrize("name", ALL)
def test_a_drive_in_clean_air(name):
    found = drive(name)
    errors = trajectory_errors(found.trajectory, true_states(simulation(), found.trajectory.t_ns))
    assert np.linalg.norm(errors.position_n, axis=1).max() < (0.1 if name == "tbm-lins" else 0.05)
    assert np.degrees(np.linalg.norm(errors.rotation_n, axis=1)).max() < 1.0
    assert errors.nees[-1] < chi2.ppf(0.999, 6)
    counts = found.counts["lidar"]
    assert counts.used == len(problem().scans["lidar"]) == counts.received - 1  # the first begins before the IMU
    prism = found.counts["prism"]
    assert prism.used + prism.gated == (0 if name == "tbm-lins" else prism.received)
    assert prism.gated < 4
    assert len(found.innovations["lidar"].nis) == counts.used - 1  # the first began the map


def test_enhancement_is_said_and_stars_have_none():
    said = {name: " ".join(drive(name).warnings) for name in ("tbm-mse", "tbm-mse-star")}
    assert "mode decomposition" in said["tbm-mse"]
    assert "tilt held by gravity" in said["tbm-mse"]
    assert "mode decomposition" not in said["tbm-mse-star"]


def test_dust_from_the_first_scan_leaves_the_unit_and_the_prism():
    found = estimate("tbm-mse-star", with_scans(dusty))
    errors = trajectory_errors(found.trajectory, true_states(simulation(), found.trajectory.t_ns))
    assert np.linalg.norm(errors.position_n, axis=1).max() < 0.05
    counts = found.counts["lidar"]
    assert counts.parts() == counts.received
    assert counts.gated > 0.5 * counts.received
    assert any("find no hold on the map" in line for line in found.warnings)


def test_empty_scans_are_counted():
    none = with_scans(lambda k, fields: {name: v[:0] for name, v in fields.items()} if 20 <= k < 40 else fields)
    found = estimate("tbm-lins", none)
    counts = found.counts["lidar"]
    assert (counts.used, counts.unused) == (counts.received - 21, 21)
    assert any("20 of 79 scans hold too few points" in line for line in found.warnings)


def test_a_prism_that_contradicts_the_map_for_long_is_believed_again():
    """Say the map has slipped by half a metre while the prism was lost: it is begun anew and said."""
    own = problem()
    prism = own.samples["prism"]
    values = prism.values + np.where(prism.t_s > 8.0, 0.5, 0.0)[:, None] * [0.0, 1.0, 0.0]
    found = estimate("tbm-mse-star", replace(own, samples={**own.samples, "prism": replace(prism, values=values)}))
    assert found.innovations["prism"].gated.sum() == 10
    assert any("given up 1 times" in line for line in found.warnings)
    end = trajectory_errors(found.trajectory, true_states(simulation(), found.trajectory.t_ns)).position_n[-1]
    assert_allclose(end, [0.0, 0.5, 0.0], atol=0.03)


def moving(since_s):
    """The log from then on, when the machine moves: the rig's start is wrong in place and speed."""
    t_ns = simulation().start_ns + round(since_s * 1e9)
    series = {topic: own.select(own.t_ns >= t_ns) for topic, own in log().series.items()}
    clouds = {}
    for topic, own in log().clouds.items():
        kept = tuple(scan for scan in own.scans if scan[0] >= t_ns)
        clouds[topic] = replace(own, t_ns=np.array([stamp for stamp, _ in kept]), scans=kept)
    return replace(log(), series=series, clouds=clouds)


@pytest.mark.parametrize("name", ["tbm-ins-ts", "tbm-mse", "tbm-rrr-mf"])
def test_a_start_in_motion_is_found_by_the_fixes(name):
    found = estimate(name, prepare(moving(6.0), simulation().rig))
    end = trajectory_errors(found.trajectory, true_states(simulation(), found.trajectory.t_ns)).position_n[-1]
    assert np.linalg.norm(end) < 0.03
    assert found.counts["prism"].gated >= 10
    assert any("10 rejections in a row" in line or "10 fixes of the prism in a row" in line for line in found.warnings)


@pytest.mark.parametrize("name", [*ALL, "tbm-rrr-mf"])
def test_a_prism_lost_for_most_of_the_log_is_counted(name):
    lost = prepare(log(), simulation().rig, outages=(("prism", 4.0, 14.0),))
    found = estimate(name, lost)
    assert found.counts["prism"].outage == 50
    errors = trajectory_errors(found.trajectory, true_states(simulation(), found.trajectory.t_ns))
    assert np.linalg.norm(errors.position_n, axis=1).max() < 0.15
    assert errors.nees[-1] < 2 * chi2.ppf(
        0.999, 6
    )  # a prism that contradicts the map by its drift is gated for a while


def test_an_imu_at_the_end_of_its_scale_is_said():
    topic = simulation().rig.imu.topic
    imu = log().series[topic]
    size = np.abs(imu["acc"][:, :2]).max(axis=0)
    acc = imu["acc"].copy()
    acc[:, :2] = np.clip(acc[:, :2], -0.5 * size, 0.5 * size)
    own = replace(log(), series=log().series | {topic: replace(imu, columns=imu.columns | {"acc": acc})})
    struck = prepare(own, simulation().rig)
    assert any("imu: acc x is at the end of its scale" in line for line in struck.warnings)
    assert not any("end of its scale" in line for line in problem().warnings)
    for name in ("tbm-ins-ts", "tbm-lins"):
        found = estimate(name, struck)
        errors = trajectory_errors(found.trajectory, true_states(simulation(), found.trajectory.t_ns))
        assert np.linalg.norm(errors.position_n, axis=1).max() < 0.15


def test_what_they_need():
    prism_only = prepare(log(), simulation().rig, without=("lidar",))
    assert unmet("tbm-mse", prism_only) == "needs lidar"
    with pytest.raises(EstimationError, match=r"^tbm-lins needs lidar, .*tbmfg info"):
        estimate("tbm-lins", prism_only)
    lidar_only = replace(problem(), samples={k: v for k, v in problem().samples.items() if k != "prism"})
    assert unmet("tbm-mse-star", lidar_only) == "needs prism"
    assert unmet("tbm-lins", lidar_only) is None


def test_switches_reach_the_filter():
    settings = ("estimators.tbm-lins.feature_test=printed", "estimators.tbm-lins.adaptive=false")
    told = estimate("tbm-lins", replace(problem(), rig=override(problem().rig, settings)))
    assert np.abs(told.trajectory.position_n - drive("tbm-lins").trajectory.position_n).max() > 1e-4
