"""Whether a LiDAR turns as the gyro does: clock and mounting found from made-up turns, with honest sds."""

from __future__ import annotations

import numpy as np
import pytest

from tbmfg.geometry import exp_so3, log_so3, rotation_from_rpy
from tbmfg.inertial.steps import Steps
from tbmfg.measure import Samples, gyro_frame
from tbmfg.prepare.turning import against_gyro, calibrations, contradictions, since_steps
from tbmfg.rig import Lidar

SIGMA = 5e-4  # rad, of a pose
DT = 0.005


def frame_of(axes=(0.5, 0.3, 0.8), end_s=60.0, standing_s=0.0, rates=(1.1, 0.7, 0.4)):
    """Turning to and fro about three axes at different rates, after standing."""
    edges = np.arange(0.0, end_s + DT / 2, DT)
    middle = edges[:-1] + DT / 2
    rate = np.stack([a * np.cos(w * middle) for a, w in zip(axes, rates, strict=True)], axis=1)
    rate[middle < standing_s] = 0.0
    none = np.zeros(len(middle))
    steps = Steps(0, edges, rate, np.zeros_like(rate), none, none, DT, ())
    return gyro_frame(steps, rate, np.zeros(3))


def poses_of(frame, R_bl, late_s, seed=0, told=True, loud_s=0.0, loud=1.0):
    """Noise is ``loud`` times what the roots tell from ``loud_s`` on."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.5, frame.steps.edges_s[-1] - 0.5, 0.1)
    sigma = SIGMA * np.where(t < loud_s, 1.0, loud)[:, None]
    R = frame.at(t) @ R_bl @ exp_so3(sigma * rng.standard_normal((len(t), 3)))
    root = np.diag([1 / SIGMA] * 3 + [1e3] * 3) * told
    values = np.hstack([R.reshape(-1, 9), np.zeros((len(t), 3)), np.tile(root.ravel(), (len(t), 1))])
    return Samples("lidar", t + late_s, values)


def lidar(rpy_deg=(0.0, 0.0, 0.0)) -> Lidar:
    return Lidar(topic="/points", T_bl={"rpy_deg": list(rpy_deg)})


@pytest.mark.parametrize(
    ("rpy_deg", "late_s"), [((0, 0, 0), 0.0), ((2, -1, 5), 0.04), ((180, 0, 0), -0.03), ((0, 0, 90), 0.1)]
)
def test_clock_and_mounting_are_found(rpy_deg, late_s):
    frame, R_bl = frame_of(), rotation_from_rpy(np.deg2rad(np.array(rpy_deg, float)))
    errors = []
    for seed in range(12):
        found = against_gyro(lidar(), poses_of(frame, R_bl, late_s, seed), frame)
        turn = log_so3(exp_so3(found.turn).T @ R_bl)
        errors.append(np.append(turn / found.turn_sd, (found.late_s - late_s) / found.late_sd))
        assert np.abs(turn).max() < np.deg2rad(0.3)
        assert abs(found.late_s - late_s) < 3e-3
    # 48 squares, 1 expected of each: chi-square of 48 in 1 of 10^4 cases beyond 93; sds may be large, never small
    assert np.sum(np.square(errors)) < 93.0


def stepping(poses, size_s, at_s):
    """The same scans with a clock that steps at a time, in the order of their stamps."""
    t = poses.t_s + np.where(poses.t_s < at_s, 0.0, size_s)
    _, order = np.unique(t, return_index=True)
    return Samples(poses.sensor, t[order], poses.values[order])


@pytest.mark.parametrize("size_s", [0.5, -0.5, 0.13, -1.7])
def test_a_step_of_the_clock_is_told_from_a_lateness(size_s):
    frame, right = frame_of(), rotation_from_rpy(np.deg2rad([0.5, -1.0, 1.5]))
    sensor = lidar((0.5, -1.0, 1.5))
    for late_s, at_s in ((0.0, 30.0), (0.04, 20.0)):
        found = against_gyro(sensor, stepping(poses_of(frame, right, late_s), size_s, at_s), frame)
        [(time_s, size, sd)] = found.steps
        assert abs(time_s - at_s) < 2.5  # spans of 1 s, averaged over 1 s, one of them across the step
        assert abs(size - size_s) < max(4.0 * sd, 3e-3)
        assert sd < 0.01
        [interval] = since_steps("lidar", found, frame.steps)
        assert (interval.kind, interval.end_ns) == ("clock", round(60.0 * 1e9))
        assert interval.start_ns == pytest.approx(1e9 * time_s, abs=1.0)
        [line] = contradictions("lidar", sensor, found)
        assert f"steps by {size_s:+.2f}" in line
        assert "lidar_clock_offset_by_gyro_s" not in calibrations("lidar", sensor, found)


def test_a_sound_clock_steps_in_no_log():
    sensor = lidar()
    for seed in range(10):
        axes = np.random.default_rng(seed).uniform(0.0005, 0.5, 3)
        frame = frame_of(tuple(axes))
        found = against_gyro(sensor, poses_of(frame, np.eye(3), 0.0, seed), frame)
        assert found is None or found.steps == []


def test_turns_that_repeat_tell_no_clock():
    frame = frame_of(axes=(0.0, 0.0, 0.5), rates=(1.0, 1.0, 2.0 * np.pi / 1.6))
    assert against_gyro(lidar(), poses_of(frame, np.eye(3), 0.0), frame) is None


def test_what_contradicts_the_rig_is_said():
    frame = frame_of()
    right = rotation_from_rpy(np.deg2rad([0.5, -1.0, 1.5]))
    sensor = lidar((0.5, -1.0, 1.5))
    assert contradictions("lidar", sensor, against_gyro(sensor, poses_of(frame, right, 0.0), frame)) == []
    clock, mounting = contradictions(
        "lidar", lidar((0.5, -1.0, 41.5)), against_gyro(lidar((0.5, -1.0, 41.5)), poses_of(frame, right, 0.08), frame)
    )
    assert "clock_offset_s=0.08" in clock
    assert "40.0 deg" in mounting
    assert "rpy_deg=[0.5, -1.0, 1.5]" in mounting


def test_turns_about_one_axis_leave_the_mounting_about_it_open():
    frame = frame_of(axes=(0.0, 0.0, 0.8))
    found = against_gyro(lidar(), poses_of(frame, np.eye(3), 0.0), frame)
    assert found.turn_sd[2] > 1.0
    assert found.turn_sd[:2].max() < np.deg2rad(0.3)
    doubted = Lidar(topic="/points", T_bl_rpy_sd_deg=2.0)
    assert calibrations("lidar", doubted, found)["lidar_turn_by_gyro_deg"].observed == (True, True, False)
    assert calibrations("lidar", lidar(), found)["lidar_turn_by_gyro_deg"].observed is None, "no prior to beat"
    assert contradictions("lidar", lidar(), found) == []


def test_scans_that_agree_better_while_it_stands_are_no_measure_of_turns():
    scores, lines = [], []
    for seed in range(10):
        frame = frame_of(axes=(0.0015, 0.001, 0.0024), end_s=120.0, standing_s=96.0)
        found = against_gyro(lidar(), poses_of(frame, np.eye(3), 0.0, seed, loud_s=96.0, loud=10.0), frame)
        scores.append(np.append(found.turn / found.turn_sd, found.late_s / found.late_sd))
        lines += contradictions("lidar", lidar(), found)
    # 40 squares, 1 expected of each: chi-square of 40 in 1 of 10^4 cases beyond 82
    assert np.sum(np.square(scores)) < 82.0
    assert lines == []


def test_a_log_that_hardly_turns_tells_nothing():
    frame = frame_of(end_s=60.0, standing_s=56.0)
    assert against_gyro(lidar(), poses_of(frame, np.eye(3), 0.0), frame) is None


def test_nothing_told_is_nothing_found():
    frame = frame_of()
    assert against_gyro(lidar(), poses_of(frame, np.eye(3), 0.0, told=False), frame) is None
    assert against_gyro(lidar(), poses_of(frame_of(end_s=4.0), np.eye(3), 0.0), frame) is None
