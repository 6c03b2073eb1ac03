"""What limits a result is said in words, with the times and the motion that was missing."""

from __future__ import annotations

import numpy as np
import pytest

from tbmfg.diagnosis import gated_in_words, gated_stretches
from tbmfg.estimators import estimate
from tbmfg.prepare import prepare
from tbmfg.results import summarise
from tbmfg.state import Innovations
from tests import problems


def innovations(gated: list[int]) -> Innovations:
    t_ns = 1_000_000_000 * np.arange(len(gated), dtype=np.int64)
    return Innovations(t_ns, np.where(gated, 50.0, 3.0), 3, np.array(gated, dtype=bool))


def test_only_stretches_are_named():
    found = gated_stretches({"prism": innovations([0, 1, 1, 0, 1, 1, 1, 0, 0, 1, 1, 1, 1])})
    assert [(s.start_ns // 10**9, s.end_ns // 10**9) for s in found] == [(4, 6), (9, 12)]
    [line] = gated_in_words(found, 1_000_000_000)
    assert "2 times" in line
    assert "8.0-11.0 s" in line
    assert gated_stretches({"prism": innovations([1, 1, 0, 1])}) == []


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
