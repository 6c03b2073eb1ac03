"""Public recordings as logs: units, stamps, rigs and truths; from arrays made here, and from the real ones."""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import datasets
from benchmarks import outages
from datasets.__main__ import main
from tbmfg import earth
from tbmfg.errors import TbmfgError
from tbmfg.mcap import read_log
from tbmfg.rig import parse_rig
from tbmfg.timeseries import NS, Log

G = 9.80665
T0_NS = 1_400_000_000_000_000_128  # no float64 holds it


def save(folder: Path, **arrays) -> Path:
    path = folder / "recording.npz"
    np.savez(path, **arrays)
    return path


def imported(name: str, source: Path, *settings: str) -> Log:
    """What the command writes, read back."""
    path = source.with_suffix(".mcap") if source.is_file() else source / "recording.mcap"
    options = [part for setting in settings for part in ("--set", setting)]
    assert main(["import", name, str(source), "-o", str(path), *options]) == 0
    return read_log(path)


def rig_in(log: Log):
    return parse_rig(log.attachments["rig.yaml"].decode(), "rig.yaml")


# ---- each layout, tiny ----


def flight(**more) -> dict:
    """Half a second of turning flight with truth."""
    t = 0.005 * np.arange(100)
    R = Rotation.from_rotvec(np.column_stack([0.3 * t, 0.1 + t, -0.5 * t]))
    position = np.column_stack([2 * t, np.sin(t), 1 + t**2])
    return {
        "t0_ns": np.int64(T0_NS),
        "imu_t": t,
        "imu_gyr": np.tile([0.1, 0.2, 0.3], (100, 1)),
        "imu_acc": np.tile([9.0, -0.3, -2.0], (100, 1)),
        "truth_t": t,
        "truth_p": position,
        "truth_q_xyzw": R.as_quat(),
    } | more


def test_euroc_with_its_prism(tmp_path):
    prism = {"prism_t": np.array([-0.1, 0.05, 0.1]), "prism_p": np.arange(9.0).reshape(3, 3)}
    log = imported("euroc", save(tmp_path, **flight(**prism)))
    assert_array_equal(log.series["/imu0"].t_ns, T0_NS + 5_000_000 * np.arange(100))
    assert_allclose(log.series["/imu0"]["acc"][3], [9.0, -0.3, -2.0])
    assert_array_equal(log.series["/leica/position"].t_ns, T0_NS + np.array([-100, 50, 100]) * 1_000_000)
    assert_allclose(log.series["/leica/position"]["point"], prism["prism_p"])
    assert log.series["/truth/pose"].type == "geometry_msgs/msg/PoseStamped"
    assert rig_in(log).name == "euroc-leica"


def test_euroc_without_a_prism_has_none_in_its_rig(tmp_path):
    log = imported("euroc", save(tmp_path, **flight()))
    assert "/leica/position" not in log.series
    assert list(rig_in(log).sensors) == ["imu"]


def test_synthetic_prism_lies_at_its_arm_and_comes_late(tmp_path):
    velocity = np.column_stack([np.full(100, 2.0), np.cos(0.005 * np.arange(100)), 0.01 * np.arange(100)])
    arrays = flight(truth_v=velocity)
    source = save(tmp_path, **arrays)
    arm, settings = np.array([0.3, -0.2, 0.1]), ("prism=synthetic", "arm=0.3,-0.2,0.1", "latency=0.25", "rate_hz=40")
    log = imported("euroc", source, *settings, "noise=0")
    fixes, truth = log.series["/leica/position"], log.series["/truth/pose"]
    t = (fixes.t_ns - T0_NS) * 1e-9 - 0.25
    assert 15 <= len(fixes) <= 20
    R = Rotation.from_rotvec(np.column_stack([0.3 * t, 0.1 + t, -0.5 * t]))
    expected = np.column_stack([2 * t, np.sin(t), 1 + t**2]) + R.apply(arm)
    assert_allclose(fixes["point"], expected, atol=1e-5)  # the attitude between two samples is a geodesic, not a line
    assert_allclose(Rotation.from_quat(truth["quat_xyzw"]).apply(truth["linear"]), velocity, atol=1e-12)
    noisy = imported("euroc", source, *settings, "noise=0.01").series["/leica/position"]["point"] - fixes["point"]
    assert 0.006 < noisy.std() < 0.014


def test_rtk_drive_in_ros_units_and_with_a_track_for_truth(tmp_path):
    n = 8
    llh = np.column_stack([40.1 + 1e-5 * np.arange(n), np.full(n, -105.1), 1600.0 + np.arange(n)])
    log = imported(
        "rtk-drive",
        save(
            tmp_path,
            t0_gpst_unix=1.75e9,
            imu_t=3.0 + 0.0110 * np.arange(40),
            imu_clock_s=261.0 + 0.0100 * np.arange(40),
            imu_acc_g=np.tile([0.1, 0.0, 1.0], (40, 1)),
            imu_gyr_degps=np.tile([0.0, 90.0, 0.0], (40, 1)),
            gnss_t=0.25 * np.arange(n),
            gnss_llh_deg_m=llh,
            gnss_Q=np.array([1, 1, 2, 1, 5, 1, 0, 1], dtype=np.int8),
            gnss_sd_neu=np.tile([0.01, 0.02, 0.03], (n, 1)),
        ),
    )
    imu, fixes, truth = (log.series[topic] for topic in ("/imu/data", "/gnss/fix", "/truth/antenna"))
    assert_allclose(imu["acc"][0], [0.1 * G, 0.0, G])
    assert_allclose(imu["gyro"][0], [0.0, np.pi / 2, 0.0])
    assert_array_equal(imu.t_ns, 1_750_000_003 * NS + 10_000_000 * np.arange(40))
    assert_array_equal(fixes["status"], [2, 2, 2, 2, 0, 2, -1, 2])
    assert_allclose(fixes["cov"].reshape(-1, 3, 3), np.tile(np.diag([4e-4, 1e-4, 9e-4]), (n, 1, 1)))
    assert set(fixes["cov_type"]) == {2.0}
    assert "quat_xyzw" not in truth.columns
    assert_array_equal(truth.t_ns, fixes.t_ns[[0, 1, 3, 5, 7]])
    assert_allclose(truth["position"][0], 0.0, atol=1e-9)
    assert_allclose(truth["position"][-1, [0, 2]], [0.0, 7.0], atol=1e-2)
    assert truth["position"][-1, 1] == pytest.approx(7e-5 * np.pi / 180 * 6.36e6, rel=5e-3)
    rig = rig_in(log)
    assert rig.truth.sensor == "gnss"

    source = tmp_path / "recording.npz"
    assert_array_equal(
        imported("rtk-drive", source, "clock=logger").series["/imu/data"].t_ns,
        1_750_000_003 * NS + 11_000_000 * np.arange(40),
    )


def test_husky_keeps_both_clocks(tmp_path):
    arrays = {"t0_unix": 1.4e9}
    for name, n in (("imu", 6), ("odom", 4), ("gps", 3)):
        arrays |= {f"{name}_t": 0.1 * np.arange(n), f"{name}_trec": 0.1 * np.arange(n) + 0.03}
    arrays |= {"imu_acc": np.ones((6, 3)), "imu_gyr": np.zeros((6, 3))}
    arrays |= {"odom_xy": np.ones((4, 2)), "odom_qzw": np.tile([0.0, 1.0], (4, 1)), "odom_vx": np.arange(4.0)}
    arrays |= {"odom_vy": np.zeros(4), "odom_wz": np.full(4, 0.2)}
    arrays |= {"gps_llh": np.tile([42.0, -71.0, 5.0], (3, 1)), "gps_status": np.array([1, -1, 1])}
    arrays["gps_var"] = np.tile([0.81, 0.81, 3.24], (3, 1))
    log = imported("husky", save(tmp_path, **arrays))
    odometer = log.series["/husky_velocity_controller/odom"]
    assert_allclose(odometer["linear"][:, 0], np.arange(4.0))
    assert_allclose(odometer["angular"][:, 2], 0.2)
    assert_array_equal(log.series["/fix"]["status"], [1, -1, 1])
    assert_allclose(log.series["/fix"]["cov"][0, [0, 4, 8]], [0.81, 0.81, 3.24])
    # y of the unit is up, its z backward
    assert_allclose(rig_in(log).imu.T_bi.R, [[0, 0, -1], [-1, 0, 0], [0, 1, 0]], atol=1e-15)


def test_comma_turns_the_camera_into_n(tmp_path):
    llh = np.array([37.7, -122.5, 30.0])
    radians = np.radians(llh) * [1, 1, 0] + llh * [0, 0, 1]
    R_ne = earth.R_ne(radians[0], radians[1], np.pi / 2)
    looking_east = np.diag([1.0, -1.0, -1.0])  # forward-right-down to east-north-up
    wxyz = Rotation.from_matrix(R_ne.T @ looking_east).as_quat()[[3, 0, 1, 2]]
    east = R_ne.T @ [1.0, 0.0, 0.0]
    start = earth.ecef_from_llh(radians)
    n = 5
    t = 46408.0 + 0.1 * np.arange(n)
    arrays = {
        name: t
        for name in (
            "imu_accelerometer_t",
            "imu_gyro_t",
            "can_wheel_speed_t",
            "imu_magnetometer_t",
            "gnss_live_gnss_ublox_t",
            "pose_frame_times",
        )
    }
    arrays |= {
        "imu_accelerometer": np.tile([0.0, 0.0, -G], (n, 1)),
        "imu_gyro_uncalibrated": np.zeros((n, 3)),
        "can_wheel_speed": np.tile([9.0, 11.0, 9.5, 10.5], (n, 1)),
        "imu_magnetometer": np.tile([20.0, 0.0, 40.0], (n, 1)),
        "gnss_live_gnss_ublox": np.tile([llh[0], llh[1], 10.0, 1.5e12, llh[2], 90.0], (n, 1)),
        "pose_frame_orientations": np.tile(wxyz, (n, 1)),
        "pose_frame_positions": start + np.outer(np.arange(n), east),
        "pose_frame_velocities": np.tile(10.0 * east, (n, 1)),
    }
    log = imported("comma", save(tmp_path, **arrays))
    assert_allclose(log.series["/odometer"]["linear"][:, 0], 10.0)
    assert_allclose(log.series["/magnetometer"]["field"][0], [20e-6, 0.0, 40e-6])
    truth = log.series["/truth/camera"]
    assert_allclose(truth["position"], np.outer(np.arange(n), [1.0, 0.0, 0.0]), atol=1e-8)
    assert_allclose(Rotation.from_quat(truth["quat_xyzw"]).as_matrix(), np.tile(np.eye(3), (n, 1, 1)), atol=1e-12)
    assert_allclose(truth["linear"], np.tile([10.0, 0.0, 0.0], (n, 1)), atol=1e-12)
    assert_allclose(rig_in(log).imu.T_bi.R @ log.series["/imu/data"]["acc"][0], [0.0, 0.0, G], atol=1e-12)


def test_broad_truth_is_what_the_authors_evaluate(tmp_path):
    n = 20
    wxyz = np.tile(np.array([0.8, 0.0, 0.6, 0.0], np.float32), (n, 1))
    wxyz[4] = np.nan
    position = np.tile(np.array([1.0, 2.0, 3.0], np.float32), (n, 1))
    arrays = {"fs": 285.71428571, "gyr": np.ones((n, 3), np.float32), "acc": np.ones((n, 3), np.float32)}
    arrays |= {"mag": np.full((n, 3), 50, np.float32), "truth_q_wxyz": wxyz, "truth_p": position}
    log = imported("broad", save(tmp_path, **arrays, movement=np.arange(n) >= 3))
    imu, truth = log.series["/imu/data"], log.series["/truth/pose"]
    assert_allclose(np.diff(imu.t_ns), NS / 285.71428571, atol=1.0)
    assert_array_equal(truth.t_ns, imu.t_ns[[3, *range(5, n)]])
    assert_allclose(truth["quat_xyzw"], np.tile([0.0, 0.6, 0.0, 0.8], (16, 1)), atol=1e-7)
    assert_allclose(truth["position"], 0.0)
    assert_allclose(log.series["/imu/mag"]["field"], 50e-6)


def test_phone_with_a_clock_for_each_sensor(tmp_path):
    t = 0.02 * np.arange(30)
    gps = np.array([[5.0, 1.0, 90.0, 580.0, 8.5, 47.4], [-1.0, 1.0, 90.0, 580.0, 8.5, 47.4]])
    log = imported(
        "phone",
        save(
            tmp_path,
            t0_unix=1.679e9,
            acc_t=t,
            acc=np.column_stack([t, t, np.full(30, G)]),
            gyr_t=t + 0.015,
            gyr=np.ones((30, 3)),
            mag_t=t,
            mag=np.full((30, 3), 40.0),
            baro_t=t[::10],
            baro=np.column_stack([np.zeros(3), [947.0, 947.1, 947.2]]),
            baro_cols=np.array(["relativeAltitude", "pressure"]),
            gps_t=np.array([0.1, 0.4]),
            gps=gps,
            gps_cols=np.array(["horizontalAccuracy", "speed", "bearing", "altitude", "longitude", "latitude"]),
        ),
    )
    assert_allclose(log.series["/imu/data"]["acc"][:, 0], t[:29] + 0.015)  # at the gyro's stamps, inside
    assert_allclose(log.series["/barometer"]["pressure"], [94700.0, 94710.0, 94720.0])
    assert_allclose(log.series["/gnss/fix"]["llh"], [[47.4, 8.5, 580.0]])
    assert_allclose(log.series["/gnss/fix"]["cov"][0, [0, 4, 8]], [25.0, 25.0, 100.0])


def test_phone_in_one_table(tmp_path):
    cols = [f"{name}_{axis}" for name in ("acc", "gyro", "mag") for axis in "zyx"]
    cols += ["pressure", "latitude", "longitude", "altitude", "horizontalAccuracy", "verticalAccuracy"]
    row = [9.8, 0.2, 0.1, 0.03, 0.02, 0.01, 30.0, 20.0, 10.0, 1007.6, 40.0, -75.2, 50.0, 4.0, 3.0]
    table = np.tile(row, (3, 1))
    table[1, cols.index("latitude")] = np.nan
    log = imported("phone", save(tmp_path, t0_unix=1.75e9, t=np.arange(3.0), data=table, cols=np.array(cols)))
    assert_allclose(log.series["/imu/data"]["acc"][0], [0.1, 0.2, 9.8])
    assert_allclose(log.series["/imu/data"]["gyro"][0], [0.01, 0.02, 0.03])
    assert_allclose(log.series["/magnetometer"]["field"][0], [10e-6, 20e-6, 30e-6])
    assert_allclose(log.series["/barometer"]["pressure"], 100760.0)
    assert len(log.series["/gnss/fix"]) == 2
    assert_allclose(log.series["/gnss/fix"]["cov"][0, [0, 4, 8]], [16.0, 16.0, 9.0])


# ---- faults ----


def test_faults_are_one_line_and_exit_1(tmp_path, capsys):
    source = save(tmp_path, imu_t=np.arange(3.0))
    text = tmp_path / "text.npz"
    text.write_text("no archive")
    two = tmp_path / "two"
    two.mkdir()
    for name in ("a", "b"):
        np.savez(two / f"{name}.npz", x=np.zeros(1))
    for arguments, message in (
        (["kitti", str(source)], "kitti: no such recording; there are euroc, rtk-drive"),
        (["husky", str(source)], "recording.npz: lacks the array t0_unix; it holds imu_t"),
        (["husky", str(text)], "text.npz: is not a readable npz file"),
        (["husky", str(tmp_path / "none.npz")], "none.npz: is not a readable npz file"),
        (["husky", str(two)], "two: 2 npz files (a.npz, b.npz); name one"),
        (["euroc", str(source), "--set", "prism=drawn"], "prism should be recorded or synthetic, not 'drawn'"),
        (["euroc", str(source), "--set", "arm=1,2"], "arm should be numbers such as 0.075,-0.018,-0.12"),
        (["husky", str(source), "--set", "arm=1,2"], "husky: no option arm; there are none"),
        (["rtk-drive", str(source), "--set", "clock=sun"], "clock should be unit or logger, not 'sun'"),
    ):
        assert main(["import", *arguments, "-o", str(tmp_path / "x.mcap")]) == 1
        printed = capsys.readouterr().err
        assert message in printed
        assert printed.count("\n") == 1
    assert not (tmp_path / "x.mcap").exists()


def test_packed_scans(tmp_path):
    rng = np.random.default_rng(3)
    xyz_q, offsets = rng.integers(-9000, 9000, (7, 3)).astype(np.int16), np.array([0, 3, 7])
    t_s = np.array([0.0, 0.5])
    turn = Rotation.from_rotvec([[0, 0, 0], [0, 0.1, 0.4]])
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = turn.as_matrix(), [[0, 0, 0], [1, 2, 3]]
    arrays = {"xyz_q": xyz_q, "offsets": offsets, "scale": 0.002, "intensity": np.arange(7, dtype=np.uint8)}
    save(tmp_path, **arrays, scan_t=t_s, t0_unix=1.63e9, ref_T=T)
    log = imported("balm-lidar", tmp_path)
    scans = list(log.clouds["/points"])
    assert [t_ns - 1_630_000_000 * NS for t_ns, _ in scans] == [0, NS // 2]
    assert_allclose(np.column_stack([scans[1][1][axis] for axis in "xyz"]), xyz_q[3:] * 0.002, rtol=1e-6)
    assert_array_equal(scans[0][1]["intensity"], [0, 1, 2])
    assert_allclose(log.series["/truth/pose"]["position"], T[:, :3, 3])
    assert_allclose(log.series["/truth/pose"]["quat_xyzw"], turn.as_quat(), atol=1e-15)
    assert rig_in(log).sensors["lidar"].topic == "/points"
    assert len(imported("kitti-lidar", tmp_path).clouds["/points"]) == 2


def test_settings_change_the_attached_rig(tmp_path):
    log = imported("euroc", save(tmp_path, **flight()), "sensors.imu.noise_factor=3")
    assert rig_in(log).imu.noise_factor == 3
    with pytest.raises(TbmfgError, match="unknown key"):
        datasets.load("euroc", tmp_path / "recording.npz", settings=("sensors.imu.noise=3",))


def test_list_names_every_recording(capsys):
    assert main(["list"]) == 0
    printed = capsys.readouterr().out
    for name in datasets.RECORDINGS:
        assert f"import {name} " in printed
    assert "arm=0.075,-0.018,-0.12" in printed


# ---- the real recordings ----


def real(path: str) -> Path:
    root = os.environ.get("TBMFG_DATA")
    if not root:
        pytest.skip("TBMFG_DATA is not set: no recordings to import")
    return Path(root) / path


@pytest.mark.parametrize(
    ("name", "source", "counts"),
    [
        ("euroc", "euroc_mh01_leica", {"/imu0": 36820, "/leica/position": 3099, "/truth/pose": 36382}),
        ("euroc", "euroc_imu_truth/V1_02_medium.npz", {"/imu0": 17100, "/truth/pose": 16702}),
        ("rtk-drive", "rtk_imu_drive0708", {"/imu/data": 54859, "/gnss/fix": 2197, "/truth/antenna": 2189}),
        ("husky", "husky_odom_imu_gps", {"/imu/data": 11865, "/husky_velocity_controller/odom": 3952, "/fix": 989}),
        ("comma", "comma2k19_wheel_imu", {"/imu/data": 6256, "/odometer": 4974, "/truth/camera": 1200}),
        ("broad", "broad_attitude_mag/02_undisturbed_slow_rotation_B.npz", {"/imu/data": 53240, "/imu/mag": 53240}),
        ("phone", "phone_baro_mag_gps", {"/barometer": 3853, "/gnss/fix": 1091, "/magnetometer": 34649}),
        ("phone", "phone_1hz_baro_drive", {"/imu/data": 6660, "/barometer": 6660}),
    ],
)
def test_real_recording_holds_what_its_description_says(name, source, counts):
    recording = datasets.load(name, real(source))
    held = {series.topic: len(series) for series in recording.log_series}
    assert counts.items() <= held.items()
    imu = next(series for series in recording.log_series if series.topic == recording.rig.imu.topic)
    assert 9.6 < np.median(np.linalg.norm(imu["acc"], axis=1)) < 10.3  # gravity, in the right unit
    assert (np.diff(imu.t_ns) > 0).all()


@pytest.mark.slow
def test_rtk_drive_bridges_outages_better_than_a_filter():
    """15 s without fixes every minute; the errors are against the fixes that were hidden."""
    case = outages.CASES["rtk"]["rtk"]
    rows = outages.rows_of("rtk", case, real("rtk_imu_drive0708"), ("batch", "ins"))
    found = {(row.estimator, row.metric): row for row in rows}
    assert found["batch", "outage"].inside
    assert found["batch", "outage"].mean < 0.25 * found["ins", "outage"].mean
    assert 0.5 < found["batch", "outage_over_sd"].mean < 1.3  # eight outages
