"""What limits a result is said in words, with the times and the motion that was missing."""

from __future__ import annotations

import numpy as np
import pytest

from tbmfg.diagnosis import gated_in_words, gated_stretches, gated_together, motion
from tbmfg.estimators import estimate
from tbmfg.geometry import quat_from_matrix, rotation_z
from tbmfg.prepare import prepare
from tbmfg.results import summarise
from tbmfg.state import Innovations, Interval, Trajectory
from tests import problems


def innovations(gated: list[int]) -> Innovations:
    t_ns = 1_000_000_000 * np.arange(len(gated), dtype=np.int64)
    return Innovations(t_ns, np.where(gated, 50.0, 3.0), 3, np.array(gated, dtype=bool))


def test_only_stretches_are_named():
    series = {"prism": innovations([0, 1, 1, 0, 1, 1, 1, 0, 0, 1, 1, 1, 1])}
    found = gated_stretches(series)
    assert [(s.start_ns // 10**9, s.end_ns // 10**9) for s in found] == [(4, 6), (9, 12)]
    [line] = gated_in_words(series, found, 1_000_000_000)
    assert "9 of 13 rows gated, where chance gates 0.013: the first at 0.0 s" in line
    assert "3 or more on end 2 times, the longest from 8.0 to 11.0 s" in line
    assert gated_stretches({"prism": innovations([1, 1, 0, 1])}) == []


def test_what_chance_gates_is_not_named():
    series = innovations([0, 1, *[0] * 998])
    series.nis[1] = 17.0  # one of a thousand lies beyond 16.3
    assert gated_in_words({"prism": series}, [], 0) == []
    series.nis[1] = 40.0
    [line] = gated_in_words({"prism": series}, [], 0)
    assert line.startswith(
        "prism: 1 of 1000 rows gated, where chance gates 1: the first at 1.0 s, the farthest off by 6.3"
    )


def test_sensors_gated_together_point_at_the_imu():
    def stretch(sensor, start, end):
        return Interval(sensor, "gated", start * 10**9, end * 10**9)

    assert gated_together([stretch("prism", 1, 5), stretch("odometer", 6, 8)], 0) == []
    [line] = gated_together([stretch("prism", 2, 9), stretch("odometer", 4, 6), stretch("magnetometer", 5, 8)], 10**9)
    assert line.startswith("imu: magnetometer and odometer and prism are gated together from 3.0 to 7.0 s")


@pytest.mark.parametrize(
    ("what", "advice", "did"),
    [
        ("arm_z", "across the axes that the machine turns about", "90.0 deg about the vertical"),
        ("clock_offset", "in changes of speed", "never faster than 2 m/s"),
        ("scale", "in distances between places", "20.0 m in 10 s"),
        ("yaw", "in the course between fixes", "20.0 m in 10 s"),
        ("declination", "against a heading from elsewhere", "20.0 m in 10 s"),
        ("iron_y", "turn it about all axes", "turned by 90.0 deg at most"),
        ("mount_x", "where the machine turns, about two axes", "turned by 90.0 deg at most"),
        ("turn_z", "in turns about two axes", "turned by 90.0 deg at most"),
        ("tilt_x", "over a long way along the line", "20.0 m in 10 s"),
        ("offset_y", "in turns about the line", "turned by 90.0 deg at most"),
        ("of_somebody_else", "in motion that the machine did not make", "20.0 m in 10 s"),
    ],
)
def test_each_calibration_is_told_the_motion_that_shows_it(what, advice, did):
    t_s = np.linspace(0.0, 10.0, 101)
    nothing, R = np.zeros((101, 3)), np.array([rotation_z(np.pi / 20 * t) for t in t_s])
    way = np.stack([2.0 * t_s, *nothing.T[:2]], axis=1)
    speed = np.tile([2.0, 0.0, 0.0], (101, 1))
    t_ns = (t_s * 1e9).astype(np.int64)
    path = Trajectory(t_ns, way, quat_from_matrix(R), speed, nothing, nothing, np.zeros((101, 15, 15)))
    words = motion(path, what)
    assert advice in words
    assert did in words


def test_an_arm_that_cannot_be_seen_is_explained_by_the_motion():
    simulation = problems.drive(seed=4, duration=20.0)
    problem = prepare(problems.log_of(simulation.log_series), simulation.rig)
    result = estimate("batch", problem)
    [line] = [w for w in result.warnings if w.startswith("prism.arm_z")]
    yaw = np.unwrap(np.arctan2(*result.trajectory.rotations()[:, [1, 0], 0].T))
    assert f"{np.rad2deg(np.ptp(yaw)):.1f} deg about the vertical" in line

    series = summarise(result, problem.t0_ns)["innovations"]["prism"]["over_time"]
    assert len(series["end_s"]) == len(series["nis_per_dof"]) == len(series["gated"]) == 60
    assert np.nanmean(np.array(series["nis_per_dof"], dtype=float)) == pytest.approx(1.0, abs=0.3)
