"""The simulated LiDAR: where its points lie, how motion distorts a scan, and what dust takes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import datasets
from datasets.tbm import START
from datasets.tbm_roadway import DUSTY_M
from tbmfg.errors import TbmfgError
from tbmfg.geometry import exp_so3
from tbmfg.mcap import read_log

SMALL = {"columns": 60, "imu_rate_hz": 50.0}


def tunnel(duration: float = 4.0, seed: int = 0, **options):
    return datasets.make("tbm-tunnel", seed=seed, duration=duration, **SMALL | options)


def in_n(simulation, t_s, points_l):
    """Points of a scan in n by the true poses at ``t_s``, one time or one for each."""
    truth, mounting = simulation.truth(np.atleast_1d(t_s)), simulation.rig.sensors["lidar"].T_bl
    return truth.position + np.einsum("nij,nj->ni", truth.R, points_l @ mounting.R.T + mounting.xyz)


def xyz(fields):
    return np.column_stack([fields[axis] for axis in "xyz"]).astype(float)


def test_points_lie_on_the_walls_seen_from_their_own_times():
    simulation = tunnel()
    t_ns, fields = list(simulation.clean["lidar"])[30]
    start_s = (t_ns - simulation.start_ns) * 1e-9
    own = start_s + fields["time"]
    assert 0.09 < np.ptp(fields["time"]) < 0.1

    def height_over_walls(points_n):
        """Distance from the straight walls and the floor, for points low enough to be on either."""
        low = points_n[:, 2] < START[2] - 0.05 + 1.4
        y, z = points_n[low, 1], points_n[low, 2] - (START[2] - 0.05)
        return np.minimum(np.abs(np.abs(y) - 2.5), np.abs(z))

    # rays and hits are float32 over 100 m: 1e-5 m; half that again where they graze
    assert height_over_walls(in_n(simulation, own, xyz(fields))).max() < 1e-3
    # a roadheader at 0.5 m/s, swaying: the scan's start is the wrong pose by millimetres at least
    assert height_over_walls(in_n(simulation, start_s, xyz(fields))).max() > 5e-3


def test_the_mounting_is_drawn_from_the_rigs_prior_and_nothing_else_changes():
    exact, loose = (
        tunnel(1.0),
        tunnel(1.0, settings=("sensors.lidar.T_bl_xyz_sd_m=0.1", "sensors.lidar.T_bl_rpy_sd_deg=2")),
    )
    mounting, drawn = exact.rig.sensors["lidar"].T_bl, loose.drawn["lidar"]
    assert_array_equal(exact.drawn["lidar"]["xyz_m"], mounting.xyz)
    assert_array_equal(exact.drawn["lidar"]["turn_deg"], np.zeros(3))
    assert_array_equal(exact.clouds[0].R_bl, mounting.R)
    assert 0.01 < np.linalg.norm(drawn["xyz_m"] - mounting.xyz) < 0.5
    assert 0.2 < np.linalg.norm(drawn["turn_deg"]) < 10.0
    for a, b in zip(exact.log_series, loose.log_series, strict=True):
        assert all(np.array_equal(a[name], b[name]) for name in a.columns)
    # the same walls from the drawn place: the floor lies where it was
    truth, R_bl = loose.truth(np.zeros(1)), mounting.R @ exp_so3(np.radians(drawn["turn_deg"]))
    _, fields = next(iter(loose.clean["lidar"]))
    first = fields["time"] < 1e-3
    points_n = truth.position + (xyz(fields)[first] @ R_bl.T + drawn["xyz_m"]) @ truth.R[0].T
    low = points_n[points_n[:, 2] < START[2] - 0.05 + 1.4]
    assert np.minimum(np.abs(np.abs(low[:, 1]) - 2.5), np.abs(low[:, 2] - (START[2] - 0.05))).max() < 5e-3


def test_scans_repeat_and_a_clean_one_has_no_noise():
    simulation = tunnel(1.0)
    first, second = list(simulation.clouds[0]), list(simulation.clouds[0])
    assert len(first) == 10
    for (t_a, a), (t_b, b) in zip(first, second, strict=True):
        assert t_a == t_b
        assert all(np.array_equal(a[name], b[name]) for name in a)
    (_, noisy), (_, clean) = first[3], list(simulation.clean["lidar"])[3]
    # both hold the rays within reach; of noise along a ray 3 cm remain
    ranges = [{(r, t): d for r, t, d in zip(f["ring"], f["time"], np.linalg.norm(xyz(f), axis=1), strict=True)}
              for f in (noisy, clean)]  # fmt: skip
    error = np.array([ranges[0][key] - ranges[1][key] for key in ranges[0].keys() & ranges[1].keys()])
    assert abs(error.mean()) < 4 * 0.03 / np.sqrt(len(error))
    assert error.std() == pytest.approx(0.03, rel=4 / np.sqrt(2 * len(error)))


def test_ribs_are_in_the_ribbed_tunnel_only():
    for walls, inside in (("smooth", 0.0), ("ribbed", 0.15)):
        simulation = tunnel(0.5, walls=walls)
        t_ns, fields = next(iter(simulation.clean["lidar"]))
        points = in_n(simulation, (t_ns - simulation.start_ns) * 1e-9 + fields["time"], xyz(fields))
        wall = points[np.abs(points[:, 2] - START[2] - 0.7) < 0.5]
        assert np.ptp(np.abs(wall[np.abs(wall[:, 1]) > 2.3, 1])) == pytest.approx(inside, abs=2e-3)


def test_dust_takes_light_by_beer_and_lambert():
    k = 0.2
    make = {"seed": 1, "duration": 2.0, "dust": k, "dust_begin": -2.0, "dust_end": 3.0, **SMALL}
    simulation = datasets.make("tbm-roadway", **make)
    expected, seen, false = 0.0, 0, 0
    variance = 0.0
    for (_, dusty), (_, clean) in zip(simulation.clouds[0], simulation.clean["lidar"], strict=True):
        chance = np.exp(-2 * k * np.linalg.norm(xyz(clean), axis=1))
        expected, variance = expected + chance.sum(), variance + (chance * (1 - chance)).sum()
        seen += int((dusty["intensity"] > 50).sum())
        false += int((dusty["intensity"] < 50).sum())
    assert abs(seen - expected) < 4 * np.sqrt(variance)
    assert false > 0
    share = len(simulation.clean["prism"].t_ns) / 10
    assert share < np.exp(-2 * k * DUSTY_M) + 0.35


def test_log_holds_the_clouds(tmp_path):
    simulation = tunnel(0.5)
    simulation.write(tmp_path / "log.mcap")
    log = read_log(tmp_path / "log.mcap")
    assert_array_equal(log.clouds["/points"].t_ns, simulation.clouds[0].t_ns)
    for (_, read), (_, made) in zip(log.clouds["/points"], simulation.clouds[0], strict=True):
        assert_allclose(xyz(read), xyz(made), rtol=0)


def test_walls_that_do_not_exist():
    with pytest.raises(TbmfgError, match="smooth or ribbed"):
        tunnel(walls="soft")
