"""LiDAR scans: their times, their compensation, what their registration tells and what it does not, and bad ones."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import datasets
from benchmarks.runs import calibration_z, in_memory, true_states
from tbmfg.errors import LogError
from tbmfg.estimators import estimate
from tbmfg.evaluation.metrics import trajectory_errors
from tbmfg.geometry import exp_so3, log_so3
from tbmfg.lidar import clouds, registration
from tbmfg.lidar.motion import Blind, Inertia, compensate
from tbmfg.lidar.odometry import Odometry, Slides, slides, whitening
from tbmfg.lidar.surfels import SurfelMap
from tbmfg.prepare import prepare
from tbmfg.rig import Lidar

T_NS = 1_700_000_000_123_456_789
AFTER_S = np.linspace(0.0, 0.0999, 50)
SENSOR = Lidar(topic="/points")


def fields(**more):
    rng = np.random.default_rng(1)
    return {axis: rng.uniform(1.0, 9.0, 50).astype(np.float32) for axis in "xyz"} | more


# ---- clouds ----


@pytest.mark.parametrize(
    ("name", "values", "precision"),
    [
        ("time", AFTER_S.astype(np.float32), 1e-8),
        ("time", (AFTER_S * 1e3).astype(np.float32), 1e-8),
        ("offset_time", (AFTER_S * 1e6).astype(np.uint32), 1e-6),
        ("t", np.round(AFTER_S * 1e9).astype(np.uint32), 1e-9),
        ("timestamp", T_NS + np.round(AFTER_S * 1e9).astype(np.int64), 1e-9),
        ("timestamp", T_NS * 1e-9 + AFTER_S, 5e-7),  # a float64 second of this century resolves 0.24 us
        ("timestamp", 4e16 + AFTER_S * 1e9, 1e-8),  # ns since another clock's start
    ],
)
def test_times_of_any_unit(name, values, precision):
    scan = clouds.read(T_NS, fields(**{name: values}), SENSOR, 0.1)
    assert scan.fault == ""
    assert_allclose(scan.after_s, AFTER_S, atol=precision)


def test_times_that_tell_nothing():
    for values, why in ((np.full(50, 7.0), "one time"), (np.full(50, np.nan), "no finite"), (AFTER_S * 50, "span")):
        scan = clouds.read(T_NS, fields(time=values), replace_unit("s"), 0.1)
        assert scan.after_s is None
        assert why in scan.fault
    assert clouds.read(T_NS, fields(), SENSOR, 0.1).fault == ""


def replace_unit(unit: str) -> Lidar:
    return SENSOR.model_copy(update={"time_unit": unit})


def test_fields_named_in_the_rig():
    own = SENSOR.model_copy(update={"time_field": "when", "time_unit": "ms"})
    assert_allclose(clouds.read(T_NS, fields(when=AFTER_S), own, 0.1).after_s, AFTER_S * 1e-3)
    with pytest.raises(LogError, match="no field when"):
        clouds.read(T_NS, fields(), own, 0.1)
    with pytest.raises(LogError, match="without x, y and z"):
        clouds.read(T_NS, {"range": AFTER_S}, SENSOR, 0.1)


def test_points_left_out_are_counted():
    cloud = fields(time=AFTER_S.copy())
    cloud["x"][3], cloud["time"][4] = np.nan, np.inf
    for axis in "xyz":
        cloud[axis][:2], cloud[axis][7], cloud[axis][8] = 0.0, 0.1, 500.0
    scan = clouds.read(T_NS, cloud, SENSOR, 0.1)
    assert (scan.nonfinite, scan.zero, scan.beyond, len(scan.points), len(scan.after_s)) == (2, 2, 2, 44, 44)


SCAN = np.tile(np.linspace(0.0, 0.0999, 40), 3)  # three beams
CLOCKS = {  # s after the stamp to what a driver writes
    "time": lambda s: s,
    "offset_time": lambda s: np.clip(s * 1e6, 0, 2**32 - 1).astype(np.uint32),
    "t": lambda s: np.round(s * 1e9),
    "timestamp": lambda s: T_NS * 1e-9 + s,
    "timestamps": lambda s: T_NS + np.round(np.clip(s, -9e8, 7e9) * 1e9).astype(np.int64),
}
INDEX = st.integers(0, len(SCAN) - 1)
# periods before the first or after the last point, to stamps that were never set
AWAY = st.floats(1.1, 1e10).map(lambda periods: 0.1 + 0.1 * periods) | st.floats(1.1, 1e10).map(lambda p: -0.1 * p)


@given(
    clock=st.sampled_from(sorted(CLOCKS)),
    off=st.dictionaries(INDEX, AWAY, max_size=12),
    dead=st.dictionaries(INDEX, st.tuples(st.sampled_from([np.nan, 0.0]), AWAY), max_size=60),
)
def test_a_bad_time_takes_its_point_and_no_other(clock, off, dead):
    xyz, after_s = np.full((len(SCAN), 3), 3.0), SCAN.copy()
    if clock == "offset_time":  # no sign
        off, dead = {k: abs(s) + 0.2 for k, s in off.items()}, {k: (v, abs(s) + 0.2) for k, (v, s) in dead.items()}
    for k, s in off.items():
        after_s[k] = s
    for k, (value, s) in dead.items():
        xyz[k], after_s[k] = value, s
    scan = clouds.read(T_NS, dict(zip("xyz", xyz.T, strict=True)) | {clock: CLOCKS[clock](after_s)}, SENSOR, 0.1)
    kept = np.setdiff1d(np.arange(len(SCAN)), [*off, *dead])
    assert (scan.fault, scan.astray) == ("", len(off.keys() - dead.keys()))
    assert scan.nonfinite + scan.zero == len(dead)
    assert_allclose(scan.after_s, SCAN[kept], atol=2e-6)
    assert len(scan.points) == len(kept)


@given(
    times=st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=30).map(np.array)
    | st.lists(st.integers(0, 2**64 - 1), max_size=30).map(lambda ints: np.array(ints, dtype=np.uint64)),
    unit=st.sampled_from(["auto", "s", "ns"]),
)
def test_whatever_times_give_a_scan(times, unit):
    cloud = {axis: np.full(len(times), 3.0) for axis in "xyz"} | {"time": times}
    scan = clouds.read(T_NS, cloud, replace_unit(unit), 0.1)
    assert len(scan.points) + scan.astray + scan.nonfinite == len(times)
    if scan.after_s is not None:
        assert len(scan.after_s) == len(scan.points)
        assert 0.0 <= np.ptp(scan.after_s) <= 0.3 * (1 + 1e-6)
        assert np.abs(scan.after_s).max() <= 0.6 * (1 + 1e-6)


# ---- motion compensation ----


@cache
def tunnel(walls: str = "smooth", duration: float = 5.0):
    return datasets.make("tbm-tunnel", seed=2, duration=duration, walls=walls, columns=150, imu_rate_hz=200.0)


def test_compensated_points_lie_on_the_walls_from_the_last_pose():
    simulation = tunnel()
    mounting, t_s = simulation.rig.sensors["lidar"].T_bl, np.arange(0.0, 5.0, 0.005)
    truth = simulation.truth(t_s)
    motion = Inertia(t_s, truth.R, truth.position, mounting.R, mounting.xyz)
    t_ns, cloud = list(simulation.clean["lidar"])[40]
    start_s = (t_ns - simulation.start_ns) * 1e-9
    points, own = np.column_stack([cloud[axis] for axis in "xyz"]).astype(float), start_s + cloud["time"]
    moved = compensate(points, own, own.max(), motion, np.zeros(3), np.zeros(3))
    true = simulation.truth(own)
    last = simulation.truth(own.max()[None])
    in_n = true.position + np.einsum("nij,nj->ni", true.R, points @ mounting.R.T + mounting.xyz)
    back = last.position + (moved @ mounting.R.T + mounting.xyz) @ last.R[0].T
    # nearest attitude within an IMU period: 2.5 ms of 1 deg/s over 100 m; without compensation centimetres
    assert np.abs(back - in_n).max() < 5e-3
    raw = last.position + (points @ mounting.R.T + mounting.xyz) @ last.R[0].T
    assert np.abs(raw - in_n).max() > 2e-2


# ---- registration ----


def tube(rng, count: int, sigma: float, length: float = 20.0):
    """Points on the walls of a box of 3.8 x 2.8 m, open along x, with noise along the rays from its middle."""
    x, y, z = rng.uniform(-length, length, count), rng.uniform(-1.9, 1.9, count), rng.uniform(-1.4, 1.4, count)
    wall, side = rng.integers(0, 2, count), rng.choice([-1.0, 1.0], count)
    y, z = np.where(wall == 0, 1.9 * side, y), np.where(wall == 1, 1.4 * side, z)
    points = np.column_stack([x, y, z])
    return points * (1 + sigma * rng.standard_normal(count) / np.linalg.norm(points, axis=1))[:, None]


def test_a_tunnel_tells_all_but_the_way_along_it():
    rng = np.random.default_rng(4)
    planes = SurfelMap(0.5)
    planes.add(tube(rng, 60_000, 0.02), np.zeros(3))
    R, p = exp_so3(np.array([0.01, -0.02, 0.015])), np.array([0.3, 0.04, -0.05])
    scan = (tube(rng, 3000, 0.02) - p) @ R
    prior = (np.eye(3), np.array([0.2, 0.0, 0.0]))
    found = registration.align(scan, prior, prior, planes, 1.0)
    assert found.weak.shape[1] == 1
    assert abs(found.weak[3, 0]) > 0.9 * np.linalg.norm(found.weak[3:, 0])
    assert found.p[0] == pytest.approx(0.2, abs=0.02)  # stays at the prior, 0.1 m from the truth
    # 20 mm over sqrt(1500) points a direction is 0.5 mm
    assert_allclose(found.p[1:], p[1:], atol=4e-3)
    assert_allclose(found.R, R, atol=2e-3)
    assert found.overlap > 0.95
    S = whitening(found.information)
    assert np.linalg.svd(S)[1][-1] < 1e-12 * np.linalg.svd(S)[1][0]


@pytest.mark.parametrize("seed", range(2))
def test_a_scan_of_a_single_plane_tells_three_directions(seed):
    """Half a million points some hundred metres off, all on one plane of vague normal: its noise has three directions
    that none of it lies in, and rounding of the others."""
    rng = np.random.default_rng(seed)
    E = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    points = rng.uniform(-40.0, 40.0, (500_000, 2)) @ E[:2] + 5.0 * E[2] + 60.0
    planes = SurfelMap(200.0)
    planes.add(points[:10], np.zeros(3))
    row = np.flatnonzero(planes.moments[:, 0])
    planes.surfels[row] = np.concatenate([points.mean(axis=0), E[2], 0.1 * E[0], 0.1 * E[1], [100.0, 1.0, 1.0]])
    prior = (np.eye(3), np.zeros(3))
    found = registration.align(points + 0.05 * E[2], prior, prior, planes, 1.0)
    assert found.weak.shape[1] == 3
    assert E[2] @ (found.p + np.cross(log_so3(found.R), points.mean(axis=0))) == pytest.approx(-0.05, abs=1e-3)
    assert np.isfinite(found.information).all()


def test_what_a_tunnel_hides_is_not_told_by_many_scans_either():
    """Each scan takes the tunnel's axis from its own noisy normals: no two agree but in that nothing moves."""
    rng = np.random.default_rng(14)
    odometry, told, step, scans = Odometry(SENSOR, Blind()), 0.0, 0.05, 25
    for k in range(scans):
        points = tube(rng, 20_000, 0.02)  # an endless tunnel looks the same from everywhere
        pose = odometry.register(clouds.Scan(0, points[np.abs(points[:, 0]) < 15.0], None, 0, 0, 0), 0.1 * k)
        assert pose.weak == (1 if k else 6)
        told += np.sum((pose.root @ np.concatenate([np.zeros(3), pose.R.T @ [step, 0.0, 0.0]])) ** 2)
    # squared sds by which all together contradict the true way: no slide is told better than it is predicted
    assert told < 2 * scans * (step / Blind().slide(0.0, 0.1)) ** 2


def test_an_end_wall_tells_the_way_along():
    rng = np.random.default_rng(5)

    def closed(count):
        points = tube(rng, count, 0.02, 9.7)
        points[: count // 8] = np.column_stack(
            [
                9.7 + 0.02 * rng.standard_normal(count // 8),
                rng.uniform(-1.9, 1.9, count // 8),
                rng.uniform(-1.4, 1.4, count // 8),
            ]
        )
        return points

    planes = SurfelMap(0.5)
    planes.add(closed(60_000), np.zeros(3))
    prior = (np.eye(3), np.zeros(3))
    found = registration.align(closed(3000) - [0.1, 0.0, 0.0], prior, prior, planes, 1.0)
    assert found.weak.shape[1] == 0
    assert_allclose(found.p, [0.1, 0.0, 0.0], atol=5e-3)


def rays(rng, elevation_deg, azimuth_deg, turn):
    """Points where rays from the origin meet the floor at -2 m and a wall at y = 2.5, with range noise of 30 mm,
    turned by the rotation vector ``turn``."""
    elevation, azimuth = (np.radians(part).ravel() for part in np.meshgrid(elevation_deg, azimuth_deg, indexing="ij"))
    u = np.column_stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    reach = np.minimum(-2.0 / np.minimum(u[:, 2], -1e-9), 2.5 / np.maximum(u[:, 1], 1e-9))
    return u * (reach + 0.03 * rng.standard_normal(len(u)))[:, None] @ exp_so3(np.array(turn)).T


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [0.05, -0.1, 0.4]])
def test_a_standing_lidar_makes_no_walls_of_its_rings(turn):
    """Rings 2 degrees apart, twenty times in the same places: one on the floor, and where it meets the wall."""
    rng = np.random.default_rng(15)
    planes = SurfelMap(0.5)
    for _ in range(20):
        far = rays(rng, [-12.0, -10.0, -8.0], np.arange(-30.0, 30.0, 1.2), turn)
        near = rays(rng, np.arange(-15.0, 16.0, 2.0), np.arange(60.0, 120.0, 1.2), turn)
        planes.add(np.concatenate([far, near]), np.zeros(3))
    firm = planes.surfels[planes.surfels[:, 14] > 0.0]
    axis = exp_so3(np.array(turn))[:, 0]
    along = firm[:, 3:6] @ axis
    sd = np.sqrt(sum((firm[:, k : k + 3] @ axis) ** 2 for k in (6, 9)))
    assert len(firm) > 10  # the wall beside it, where rings are near each other
    # neither floor nor wall points along the tunnel: no firm plane says so beyond its own sd; 4 sd: 0.3 % of 50 planes
    assert np.abs(along / sd).max() < 4.0


# ---- what is no scan ----


def test_bad_scans_are_survived():
    odometry = Odometry(SENSOR, Blind())
    rng = np.random.default_rng(6)
    good = tube(rng, 4000, 0.02, 8.0)

    def scan(points, after_s=None):
        return clouds.Scan(0, points, after_s, 0, 0, 0)

    assert odometry.register(scan(np.zeros((0, 3))), 0.0) is None
    assert odometry.register(scan(good[:20]), 0.1) is None
    assert odometry.register(scan(good), 0.2).healthy
    assert odometry.register(scan(good), 0.2) is None  # the same again
    assert odometry.register(scan(np.tile(good[:1], (500, 1))), 0.3) is not None
    assert odometry.register(scan(good @ np.diag([1.0, -1.0, -1.0])), 0.4) is not None  # upside down
    last = odometry.register(scan(good), 0.5)
    assert last.healthy
    assert np.isfinite(last.root).all()


def test_long_in_dust_the_attitude_stays_a_rotation():
    """What a long sum of gyro steps has of rounding must not grow with every scan that is merely predicted."""
    rng, t_s = np.random.default_rng(11), np.arange(0.0, 20.0, 0.05)
    R_0b = exp_so3(np.array([0.01, 0.02, 0.1]) * t_s[:, None]) * (1 + 1e-12)
    odometry = Odometry(SENSOR, Inertia(t_s, R_0b, None, np.eye(3), np.zeros(3)))
    for k in range(150):
        dust = rng.uniform(-3.0, 3.0, (120, 3))
        pose = odometry.register(clouds.Scan(0, dust, None, 0, 0, 0), 0.1 * k)
    assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-11)
    assert_allclose(pose.R, exp_so3(np.array([0.01, 0.02, 0.1]) * 14.9), atol=0.05)


# ---- in the graph ----


def test_steps_join_the_graph():
    simulation = tunnel("smooth", 6.0)
    problem = prepare(in_memory(simulation), simulation.rig)
    result = estimate("batch", problem)
    counts = result.counts["lidar"]
    assert counts.received == counts.parts() == 60
    assert counts.used > 50
    truth = true_states(simulation, result.trajectory.t_ns)
    errors = trajectory_errors(result.trajectory, truth)
    # 6 dof; a draw of a chi-square of 6 beyond 30 has a chance of 4e-5
    assert errors.nees[-1] < 30.0


def test_the_mounting_is_found_within_its_sd():
    scores, settings = [], ("sensors.lidar.T_bl_xyz_sd_m=0.1", "sensors.lidar.T_bl_rpy_sd_deg=5")
    for seed in range(2):
        simulation = datasets.make(
            "tbm-roadway",
            seed=seed,
            duration=24.0,
            columns=120,
            imu_rate_hz=200.0,
            lidar_rate_hz=5.0,
            settings=settings,
        )
        result = estimate("batch", prepare(in_memory(simulation), simulation.rig))
        z = calibration_z(simulation, result)
        scores += [score for name, score in z.items() if name.startswith("lidar_")]
        assert min(result.calibration["lidar_mounting_turn_deg"].sd) < 2.0  # the log has told it
    assert len(scores) == 12
    # chi-square of 12, in 1 of 10^4 cases beyond 39
    assert np.sum(np.square(scores)) < 39.0


def test_scans_without_a_mounting_or_times_are_said():
    simulation = tunnel("smooth", 5.0)
    log = in_memory(simulation)

    class Equal:
        topic, frame_id = "/points", "lidar"
        t_ns, counts = simulation.clouds[0].t_ns, simulation.clouds[0].counts

        def __len__(self):
            return len(self.t_ns)

        def __iter__(self):
            for t_ns, cloud in simulation.clouds[0]:
                x = cloud["x"].copy()
                x[::5] = np.nan
                yield t_ns, cloud | {"time": np.zeros_like(cloud["time"]), "x": x}

    problem = prepare(replace(log, clouds={"/points": Equal()}), simulation.rig)
    assert any("one time" in warning for warning in problem.warnings)
    assert any("20% not finite" in warning for warning in problem.warnings)
    assert any("a direction untold" in warning for warning in problem.warnings)
    assert any(rows.sensor == "lidar" for rows in problem.rows)


def room(rng, count: int):
    """Points on the walls, the floor and a block of a room of 8 x 6 x 3 m, (n, 3) m."""
    points = rng.uniform([-4.0, -3.0, -1.0], [4.0, 3.0, 2.0], (count, 3))
    face = rng.integers(0, 4, count)
    points[face == 0, 2] = -1.0
    points[face == 1, 0] = 4.0
    points[face == 2, 1] = 3.0
    points[face == 3] = points[face == 3] * [0.25, 0.25, 1.0] - [2.5, 1.5, 0.0]
    points[face == 3, 1] = -1.0
    return points + 0.01 * rng.standard_normal((count, 3))


def test_a_turn_that_nobody_foretold_is_found():
    rng = np.random.default_rng(7)
    odometry = Odometry(SENSOR, Blind())
    for k in range(6):
        assert odometry.register(clouds.Scan(0, room(rng, 6000), None, 0, 0, 0), 0.5 * k).healthy
    R = exp_so3(np.array([0.0, 0.0, np.deg2rad(50.0)]))
    pose = odometry.register(clouds.Scan(0, room(rng, 6000) @ R, None, 0, 0, 0), 3.0)
    assert pose.healthy
    assert_allclose(pose.R, R, atol=0.01)


def test_a_scan_of_another_place_is_flagged_and_begins_a_map():
    rng = np.random.default_rng(8)
    odometry = Odometry(SENSOR, Blind())
    for k in range(6):
        odometry.register(clouds.Scan(0, room(rng, 6000), None, 0, 0, 0), 0.5 * k)
    heap = np.clip(rng.standard_normal((6000, 3)), -3.0, 3.0)
    pose = odometry.register(clouds.Scan(0, heap, None, 0, 0, 0), 3.0)
    assert not pose.healthy
    assert not pose.root.any()  # no step into it is told


def test_a_lost_scan_is_no_end_of_a_step():
    rng = np.random.default_rng(9)
    odometry = Odometry(SENSOR, Blind())
    for k in range(4):
        odometry.register(clouds.Scan(0, room(rng, 6000), None, 0, 0, 0), 0.1 * k)
    cloud = clouds.Scan(0, rng.uniform(-3.0, 3.0, (3000, 3)), None, 0, 0, 0)
    astray = odometry.register(cloud, 0.4)
    back = odometry.register(clouds.Scan(0, room(rng, 6000), None, 0, 0, 0), 0.5)
    assert not astray.healthy
    assert not astray.placed
    # the map stood still meanwhile: the step from the last placed scan is told
    assert back.healthy
    assert back.root.any()


def test_slides_are_translations_found_in_whatever_mixture_of_weak_directions():
    rng = np.random.default_rng(2)
    along, roll = np.zeros((6, 2)).T
    along[3], roll[0], roll[3:] = 1.0, 1.0, np.cross([0.0, 1.0, -0.5], [1.0, 0.0, 0.0])  # of a pipe: it rolls as well
    mixture = np.column_stack([along, roll]) @ rng.normal(size=(2, 2))
    assert_allclose(np.abs(slides(mixture)), [[1.0], [0.0], [0.0]], atol=1e-9)
    assert slides(roll[:, None]).shape == (3, 0)
    assert slides(np.zeros((6, 0))).shape == (3, 0)
    noisy = along + np.append(rng.normal(size=3) * 7e-3, np.zeros(3))
    assert_allclose(np.abs(slides(noisy[:, None])), [[1.0], [0.0], [0.0]], atol=1e-9)
    plane = np.eye(6)[:, [2, 3, 4]] @ rng.normal(size=(3, 3))
    assert_allclose(slides(plane) @ slides(plane).T, np.diag([1.0, 1.0, 0.0]), atol=1e-9)


def scattered(count: int, turn_per_scan: float = 0.0):
    """Informations and weak directions of a way along a tunnel, as noisy normals find it, and its true direction."""
    rng = np.random.default_rng(3)
    for k in range(count):
        direction = np.array([np.cos(k * turn_per_scan), np.sin(k * turn_per_scan), 0.0])
        weak = np.concatenate([rng.normal(size=3) * 7e-3, direction + rng.normal(size=3) * 5e-3])
        weak /= np.linalg.norm(weak)
        held = np.eye(6) - np.outer(weak, weak)
        yield held @ np.diag([900.0, 450.0, 250.0, 90.0, 90.0, 90.0]) ** 2 @ held, weak[:, None], direction


def test_scans_open_each_in_its_own_direction_say_little_of_a_shared_one():
    usual, alone, together = Slides(), 0.0, 0.0
    for k, (information, weak, direction) in enumerate(scattered(200)):
        told = usual.leave_open(np.eye(3), information, weak)
        if k >= 20:
            alone += direction @ information[3:, 3:] @ direction
            together += direction @ told[3:, 3:] @ direction
    # what is left goes with the variance of a mean of twenty, and without the turns' share
    assert together < alone / 20


def test_what_the_walls_do_tell_is_kept_in_a_curve():
    usual = Slides()
    for information, weak, direction in scattered(60, np.deg2rad(1.0)):
        told = usual.leave_open(np.eye(3), information, weak)
        across = np.array([-direction[1], direction[0], 0.0])
        for side in (across, np.array([0.0, 0.0, 1.0])):
            assert side @ told[3:, 3:] @ side > 0.98 * (side @ information[3:, 3:] @ side)
        found = np.linalg.eigh(told[3:, 3:])[1][:, 0]
        assert abs(found @ direction) > np.cos(np.deg2rad(4.0))
