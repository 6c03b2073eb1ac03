"""Real recordings, through the whole pipeline: what was measured with them must not get lost again."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks import attitude, height, reckoning
from tbmfg.mcap import read_log
from tbmfg.pipeline import compare, run
from tbmfg.prepare import prepare
from tbmfg.rig import parse_rig
from tests.mcap_samples import data

pytestmark = pytest.mark.slow

EUROC = "euroc_mh01_imu_leica.mcap"
OUTAGES = tuple(("prism", float(start), float(start + 10)) for start in (40, 70, 100, 130, 160))
PRISM_IN_IMU = (0.0749, -0.0185, -0.1202)  # m: where the recordings' calibration has it


def test_euroc_machine_hall_with_a_tracked_prism():
    """A total station's prism on a multirotor; neither heading, arm nor clock offset is given."""
    summary = run(data(EUROC), rig="euroc-leica", estimator="batch")
    metrics, calibration = summary["metrics"], summary["calibration"]
    assert metrics["ape_rms_m"] <= 0.008
    assert metrics["attitude_rms_deg"] <= 0.6
    assert 0.130 <= calibration["prism_clock_offset_s"]["value"] <= 0.150
    assert_allclose(calibration["prism_lever_arm_m"]["value"], PRISM_IN_IMU, atol=7e-3)
    for name, count in summary["sensors"].items():
        assert sum(value for part, value in count.items() if part != "received") == count["received"], name
    assert summary["sensors"]["prism"]["used"] > 0.9 * summary["sensors"]["prism"]["received"]


def test_euroc_without_the_prism_for_ten_seconds_five_times():
    """What smoothing buys: both ends of an outage hold it."""
    summaries = compare(data(EUROC), estimators=("batch", "ins"), rig="euroc-leica", outages=OUTAGES)
    rms = {name: summary["metrics"]["outage_position_rms_m"] for name, summary in summaries.items()}
    for summary in summaries.values():
        assert summary["sensors"]["prism"]["outage"] > 5 * 10 * 10
    assert rms["batch"] <= 0.09  # the bound of this log is 0.075
    assert rms["batch"] <= 0.5 * rms["ins"]


def test_husky_odometer_with_the_jitter_of_its_stamps():
    """Stamps from 0.098 to 0.109 s apart: every interval but those with a lost sample counts."""
    log = read_log(data("husky_imu_odom_fix.mcap"))
    text = "sensors: {imu: {topic: /imu/data}, odometer: {topic: /husky_velocity_controller/odom}}"
    problem = prepare(log, parse_rig(text, "husky"))
    rows = next(rows for rows in problem.rows if rows.sensor == "odometer")
    spacing = np.diff(log.series["/husky_velocity_controller/odom"].t_ns) * 1e-9
    lost = int(np.sum(spacing > 1.5 * np.median(spacing)))
    assert len(rows) >= len(problem.keyframe_edges) - 1 - 2 * lost - 2
    assert rows.samples.sum() > 0.98 * len(spacing)


def test_hand_held_unit_in_a_disturbed_field():
    """BROAD: IMU and magnetometer alone, shipped rig, the dataset's own errors. All trials: benchmarks attitude."""
    trial = data("").parent / "broad_attitude_mag" / "25_disturbed_tapping_B.npz"
    rows = attitude.one_trial(trial, ["batch", "ins"], [])
    error = {(row.estimator, row.metric): row.mean for row in rows}
    assert error["batch", "total"] <= 1.15
    assert error["batch", "inclination"] <= 0.5
    assert error["batch", "nees"] <= 5.0  # per dof; scale factors and misalignment are no white noise
    assert error["ins", "total"] <= 2.2


def test_without_positions_smoothing_is_not_worse_than_dead_reckoning():
    """Wheels and gyro, no heading and no rest at the start: a gyro bias of a degree per second bends the whole path,
    and a solver that stops before it is straight again is off by ten times as much."""
    source = data("").parent / "husky_odom_imu_gps" / "husky.npz"
    share = {(row.estimator, row.metric): row.mean for row in reckoning.one_drive("husky", source, ["batch"], [])}
    reference = 100.0 * 0.9 / 359.0  # % of the way: the fixes' own sd
    for metric in ("end", "rms"):
        assert share["batch", metric] < share["dead reckoning", metric] + reference
        assert 0.1 < share["dead reckoning", metric] < 5.0


def test_a_phones_barometer_tells_height_as_its_satellite_fixes_do():
    """Fixes are of metres: smoothing cannot come closer to them than the readings do, and must not lose them."""
    source = data("").parent / "phone_baro_mag_gps" / "eth_2023-03-17.npz"
    given = SimpleNamespace(source=source, estimators="batch", assignments=[])
    found = {(row.estimator, row.metric): row.mean for row in height.measure(given)}
    assert found["batch", "difference"] < 1.02 * found["barometer", "difference"] < 1.5
    assert found["batch", "correlation"] > 0.95
