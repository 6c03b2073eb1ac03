"""The dual-coordinate method: Table 1 as printed, the rule behind it, and noisy trajectories through all its states."""

import json
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tbmfg.dual import LEVELS, STOP, angles_of, classify, direction, settled_signs, timeline, vague
from tbmfg.mcap import write_log
from tbmfg.measure import Samples
from tbmfg.pipeline import run
from tbmfg.rig import Deviation, Laser, override
from tbmfg.state import Trajectory
from tbmfg.timeseries import Series
from tests.problems import FLIGHT_RIG, flight

# Table 1 row by row: spot (a, b); then (beta, alpha), direction and case of Fig. 8
TABLE_1 = """
++: ++ upper right 1, -- lower left 7, 00 displacement only 17
-+: +- lower right 3, -+ upper left 5, 00 displacement only 19
--: ++ upper right 2, -- lower left 8, 00 displacement only 21
+-: +- lower right 4, -+ upper left 6, 00 displacement only 23
+0: -0 left 13, +0 right 15, 00 displacement only 24
-0: -0 left 14, +0 right 16, 00 displacement only 20
0+: 0+ up 9, 0- down 11, 00 displacement only 18
0-: 0+ up 10, 0- down 12, 00 displacement only 22
00: ++ upper right 25, +- lower right 26, -+ upper left 27, -- lower left 28, 0+ up 29, 0- down 30, -0 left 31, +0 right 32, 00 none 0
"""  # noqa: E501
SIGN = {"+": 1, "-": -1, "0": 0}
ALL = np.array(list(product((-1, 0, 1), repeat=4)))
ANGLE, SPOT = np.deg2rad(0.2), 1e-3  # the default tolerances
RULE = Deviation()
TOLERANCE = np.array([SPOT, SPOT, ANGLE, ANGLE, ANGLE])


def printed():
    """Table 1 as {signs of a, b, beta, alpha: (direction, case)}."""
    table = {}
    for line in TABLE_1.strip().splitlines():
        spot, states = line.split(": ")
        for state in states.split(", "):
            tilt, *words, case = state.split()
            table[tuple(SIGN[sign] for sign in spot + tilt)] = (" ".join(words), int(case))
    return table


@pytest.mark.parametrize("yaw", [-1, 0, 1])
def test_all_81_combinations_are_those_of_table_1(yaw):
    table = printed()
    assert len(table) == 33
    assert sorted(case for _, case in table.values()) == list(range(33))
    found = classify(np.column_stack([ALL, np.full(81, yaw)]))
    for signs, case, level in zip(ALL, found.case, found.level, strict=True):
        words, number = table.get(tuple(signs), (None, -1))
        assert case == number, signs
        if words is not None:
            assert direction(np.append(signs, yaw)) == words, signs
        expected = "stop" if yaw else ("normal" if number >= 0 else "troubleshoot")
        assert LEVELS[level] == expected, signs


def test_the_table_is_a_rule():
    """Normal where the spot is in the centre, or the tilt's signs are none, the spot's, or all of them opposite."""
    found = classify(np.column_stack([ALL, np.zeros(81, dtype=int)]))
    spot, tilt = ALL[:, :2], ALL[:, 2:]
    normal = ~spot.any(axis=1) | ~tilt.any(axis=1) | (tilt == spot).all(axis=1) | (tilt == -spot).all(axis=1)
    assert normal.sum() == 33
    assert np.array_equal(found.case >= 0, normal)


# ---- noise ----


def walk_through_all(seed, share, rate_hz=10.0, stay_s=6.0):
    """Every state of Table 1 and every abnormal one in random order without yaw, ``stay_s`` each, with white noise of
    ``share`` of each tolerance: true signs (n, 5), values (n, 5), times (n,)."""
    rng = np.random.default_rng(seed)
    signs = np.repeat(rng.permutation(ALL), int(stay_s * rate_hz), axis=0)
    signs = np.column_stack([signs, np.zeros(len(signs), dtype=int)])
    values = (4.0 * signs + share * rng.standard_normal(signs.shape)) * TOLERANCE
    return signs, values, np.arange(len(signs)) / rate_hz


def scores(signs, values, t_s, release, window_s):
    """Share of samples classified as they are, share of false stops, and changes of state per true change."""
    found = classify(settled_signs(values, t_s, TOLERANCE, release, window_s))
    true = classify(signs)
    changes = [np.any(np.diff(s, axis=0) != 0, axis=1).sum() for s in (found.signs, signs)]
    right = (found.case == true.case) & (found.level == true.level)
    return right.mean(), (found.level == STOP).mean(), changes[0] / changes[1]


def test_without_noise_every_sample_is_classified_as_it_is():
    assert scores(*walk_through_all(0, 0.0), 1.0, 0.0) == (1.0, 0.0, 1.0)
    assert scores(*walk_through_all(0, 0.0), RULE.release, RULE.window) == (1.0, 0.0, 1.0)


@pytest.mark.parametrize("seed", range(3))
def test_hysteresis_keeps_a_noisy_trajectory_from_flickering(seed):
    """Noise of half the tolerance leaves it 4.6 % of the time: 0.046 false stops, (1 - 0.046) per zero sign right."""
    world = walk_through_all(seed, 0.5)
    right, stops, changes = scores(*world, 1.0, 0.0)
    zeros = (world[0][:, :4] == 0).sum(axis=1) + 1
    # a wrong sign may leave an abnormal state abnormal, a false stop is always wrong
    assert np.mean(0.9545**zeros) - 0.01 < right < 1 - stops
    assert stops == pytest.approx(0.0455, abs=0.01)
    assert changes > 5
    steady, stops, changes = scores(*world, RULE.release, RULE.window)
    assert 1 - steady < 0.35 * (1 - right), "what is left lies within two samples of a true change"
    assert stops == 0.0
    assert changes < 2


def test_a_change_is_found_where_it_began_and_a_short_one_is_not():
    t_s = np.arange(100) * 0.1
    values = np.zeros((100, 1))
    values[20:25] = 3.0
    values[40:] = 3.0
    values[60:65] = -3.0
    signs = settled_signs(values, t_s, np.ones(1), 0.5, 1.2)[:, 0]
    assert np.array_equal(signs, np.repeat([0, 1], [40, 60]))


def test_the_band_is_entered_at_the_tolerance_and_left_below_the_release():
    t_s = np.arange(6.0)
    values = np.array([[0.0], [0.9], [1.1], [0.6], [0.4], [-1.1]])
    assert settled_signs(values, t_s, np.ones(1), 0.5, 0.0)[:, 0].tolist() == [0, 0, 1, 1, 0, -1]


# ---- angles and the timeline ----


def printed_rotation(alpha, beta, gamma):
    """(1), C_r^a element by element, and from it R_nb with n z-up and b forward-left-up."""
    (sa, sb, sg), (ca, cb, cg) = np.sin([alpha, beta, gamma]), np.cos([alpha, beta, gamma])
    C_ra = [
        [cb * cg, cb * sg, -sb],
        [sa * sb * cg - ca * sg, sa * sb * sg + ca * cg, sa * cb],
        [ca * sb * cg + sa * sg, ca * sb * sg - sa * cg, ca * cb],
    ]
    return np.transpose(C_ra) * np.outer([1, -1, -1], [1, -1, -1])


def test_angles_are_those_of_the_papers_rotation():
    """Bow up is a positive pitch, and clockwise a positive yaw, though b's z axis points up."""
    rng = np.random.default_rng(0)
    angles = rng.uniform([-3, -1.5, -3], [3, 1.5, 3], (50, 3))
    R_nb = np.array([printed_rotation(*row) for row in angles])
    assert_allclose(angles_of(R_nb, 0.0), angles, atol=1e-12)
    bow_up = angles_of(printed_rotation(0.0, 0.1, 0.0)[None], 0.0)
    assert printed_rotation(0.0, 0.1, 0.0)[2, 0] > 0
    assert bow_up[0, 1] == pytest.approx(0.1)
    # a machine that looks along the reference has no yaw
    assert angles_of(printed_rotation(0.0, 0.0, -0.4)[None], 0.4)[0, 2] == pytest.approx(0.0, abs=1e-12)


def standing(angles_deg, t_s):
    """A trajectory with these angles (n, 3) in the paper's axes."""
    from tbmfg.geometry import quat_from_matrix

    R = np.array([printed_rotation(*np.deg2rad(row)) for row in angles_deg])
    n, zero = len(t_s), np.zeros((len(t_s), 3))
    t_ns = np.round(np.asarray(t_s) * 1e9).astype(np.int64)
    return Trajectory(t_ns, zero, quat_from_matrix(R), zero, zero, zero, np.zeros((n, 15, 15)))


def test_timeline_names_the_states_in_order_and_leaves_out_what_nobody_saw():
    t_s = np.arange(0.0, 40.0, 0.5)
    angles = np.zeros((len(t_s), 3))
    angles[t_s >= 10, :2] = [1.0, 2.0]  # roll and pitch
    angles[t_s >= 30, 2] = -3.0
    spot_t = np.arange(0.0, 40.0, 0.1)
    spot = np.where(spot_t[:, None] < 20.25, [4e-3, 2e-3], [-4e-3, 2e-3])
    dusty = (spot_t > 32) & (spot_t < 36)
    spots = Samples("laser", spot_t[~dusty], spot[~dusty])
    # the detector's own axes are forward-right-down: a half turn about the forward axis from b's
    sensor = Laser(topic="/laser", T_bd={"rpy_deg": (180.0, 0.0, 0.0)})
    found = timeline(standing(angles, t_s), spots, sensor, RULE, 0)
    states = [(i["case"], i["direction"], i["level"]) for i in found["timeline"]]
    assert states == [
        (17, "displacement only", "normal"),
        (1, "upper right", "normal"),
        (None, "upper right", "troubleshoot"),
        (None, "upper right", "stop"),
        (None, "upper right", "stop"),
    ]
    borders = [(i["start_s"], i["end_s"]) for i in found["timeline"]]
    assert_allclose(borders, [(0, 10), (10, 20), (20, 30), (30, 32), (36, 39.5)], atol=0.5)
    assert_allclose(found["timeline"][1]["roll_pitch_yaw_deg"], [1.0, 2.0, 0.0], atol=1e-9)
    assert_allclose(found["timeline"][1]["spot_mm"], [4.0, 2.0], atol=0.2)
    assert sum(found["level_s"].values()) == pytest.approx(35.5, abs=1.0)
    turned = replace_mounting(sensor, (0.0, 0.0, 0.0))
    assert_allclose(timeline(standing(angles, t_s), spots, turned, RULE, 0)["timeline"][1]["spot_mm"], [4.0, -2.0],
                    atol=0.2)  # fmt: skip


def replace_mounting(sensor, rpy_deg):
    return sensor.model_copy(update={"T_bd": sensor.T_bd.model_copy(update={"rpy_deg": rpy_deg})})


def test_any_estimators_summary_has_the_timeline_of_a_machine_with_a_laser(tmp_path):
    simulation = flight(0, 8.0)
    laser = Laser(topic="/laser")
    t_ns = simulation.start_ns + np.arange(0, 8_000_000_000, 100_000_000)
    point = [2e-3, 0.0, 0.0] + 1e-6 * np.random.default_rng(0).standard_normal((80, 3))
    spots = Series("/laser", "geometry_msgs/msg/PointStamped", t_ns, {"point": point})
    rig = simulation.rig.model_copy(update={"sensors": {**simulation.rig.sensors, "laser": laser}})
    log = replace(simulation, log_series=(*simulation.log_series, spots), rig=rig)
    write_log(tmp_path / "log.mcap", log.log_series, attachments={"rig.yaml": log.rig_text.encode()})
    summary = run(tmp_path / "log.mcap", estimator="ins", output=tmp_path / "out")
    intervals = json.loads((tmp_path / "out" / "summary.json").read_text())["deviation"]["timeline"]
    assert intervals == summary["deviation"]["timeline"]
    # it looks 40 degrees away from n's x axis: the machine should have stopped before it began
    assert {interval["level"] for interval in intervals} == {"stop"}
    assert_allclose(intervals[0]["spot_mm"], [2.0, 0.0], atol=1e-3)
    simulation.write(tmp_path / "without.mcap")
    assert "deviation" not in run(tmp_path / "without.mcap", estimator="ins")


def test_an_angle_known_too_poorly_for_its_tolerance_is_said():
    """0.1 deg is 2.05 sds of 0.0487 deg: outside in 4 % of the time; in 1 % it would be outside 2.576 sds."""
    trajectory = standing(np.zeros((5, 3)), np.arange(5.0))
    trajectory.cov[:, 2, 2] = np.deg2rad(0.0487) ** 2
    assert vague(trajectory, RULE) == []
    [line] = vague(trajectory, RULE.model_copy(update={"yaw_tolerance_deg": 0.1}))
    assert line.startswith("deviation: yaw is known to 0.049 deg (1 sd), its tolerance is 0.1 deg")
    assert line.endswith("outside 4% of the time; set deviation.yaw_tolerance_deg to 0.13 or more")


def test_bands_are_the_rigs():
    from tbmfg.rig import parse_rig

    rig = override(parse_rig(FLIGHT_RIG, "flight"), ["deviation.spot_tolerance_mm=2", "deviation.window_s=0"])
    assert (rig.deviation.spot_tolerance, rig.deviation.window) == pytest.approx((2e-3, 0.0))
    assert (RULE.angle_tolerance, RULE.spot_tolerance) == pytest.approx((np.deg2rad(0.2), 1e-3))
