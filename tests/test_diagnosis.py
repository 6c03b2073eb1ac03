"""What limits a result is said in words, with the times and the motion that was missing."""

from __future__ import annotations

import numpy as np
import pytest

from tbmfg.diagnosis import gated_in_words, gated_stretches, gated_together
from tbmfg.estimators import estimate
from tbmfg.prepare import prepare
from tbmfg.results import summarise
from tbmfg.state import Innovations, Interval
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
