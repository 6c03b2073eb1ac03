"""The roadheader paper's scenes: what moves, what is seen, and what is the same between them."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

import datasets
from tbmfg.geometry import yaw_of

SPARSE = {"imu_rate_hz": 50.0, "lidar_rate_hz": 1.0, "columns": 60}


def test_the_clean_scene_goes_forward_and_back():
    scene = datasets.make("tbm-clean", seed=0, vibration=0.0, **SPARSE)
    assert list(scene.rig.sensors) == ["imu", "prism", "lidar"]
    t = np.array([0.0, 15.0 + 48.5 + 3.0, 123.9])
    p = scene.truth(t).position
    # 4.7 m on a floor that slopes by up to 2 degrees, the IMU 1.1 m above it
    assert np.linalg.norm(p[1, :2] - p[0, :2]) > 4.6
    assert_allclose(np.linalg.norm(p[1] - p[0]), 4.7, atol=2 * 1.1 * np.sin(np.radians(3.0)))
    assert_allclose(p[2], p[0], atol=1e-3)


def test_dust_hides_the_prism_and_the_turn_is_undone():
    clear, thick = (datasets.make("tbm-dust", seed=0, vibration=0.0, dust=k, **SPARSE) for k in (0.0, 0.5))
    fixes = [(next(s for s in one.log_series if s.topic == "/prism/position").t_ns - one.start_ns) * 1e-9
             for one in (clear, thick)]  # fmt: skip
    inside = [(t > 66.0) & (t < 132.0) for t in fixes]
    assert inside[0].sum() > 320
    assert inside[1].sum() < 3
    assert abs(np.sum(~inside[0]) - np.sum(~inside[1])) < 35  # the rest of the dust, from 63 to 135 s
    yaw = yaw_of(clear.truth(np.array([0.0, 95.0, 179.5])).R)
    assert_allclose(yaw[1] - yaw[0], np.radians(90.0), atol=np.radians(3.0))
    assert_allclose(yaw[2], yaw[0], atol=np.radians(1.0))


def test_the_ablation_knows_no_heading_and_shakes_from_the_start():
    scene = datasets.make("tbm-ablation", seed=0, duration=40.0, dust=0.0, **SPARSE)
    assert scene.rig.initial.yaw_deg is None
    assert np.ptp(scene.truth(np.linspace(0.5, 1.0, 200)).velocity[:, 0]) > 5e-3


def test_the_pump_shakes_a_standing_machine_and_changes_nothing_else():
    off, on = (datasets.make("tbm-static", seed=3, duration=4.0, pump=pump) for pump in (0.0, 1.0))
    imu = [one.log_series[0]["acc"] - one.clean["imu"]["acc"] for one in (off, on)]
    assert_allclose(imu[1], imu[0], atol=1e-9)
    shaking = on.clean["imu"]["acc"] - off.clean["imu"]["acc"]
    # 1 m/s^2 and its harmonics 1/k along x: rms of sum 1/(2 k^2) to 9
    assert_allclose(np.std(shaking[:, 0]), np.sqrt(0.5 * np.sum(1 / np.arange(1, 10) ** 2)), rtol=0.1)
    assert_array_equal(on.rig.initial.yaw_deg, off.rig.initial.yaw_deg)
