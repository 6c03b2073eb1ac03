"""Result files: exact stamps, nothing half written, nothing lost; and the truth they are compared with."""

import json
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation

from tbmfg import results
from tbmfg.errors import TbmfgError
from tbmfg.mcap import read_log
from tbmfg.results import (
    FILES,
    find_truth,
    load_truth,
    read_result_npz,
    read_tum,
    refuse_existing,
    summarise,
    to_json,
    write_atomically,
    write_result,
    write_tum,
)
from tbmfg.state import Calibrated, Counts, Health, Innovations, Interval, Result, Trajectory
from tbmfg.timeseries import Log, Series

EPOCH_NS = 1_403_636_579_763_555_584


def trajectory(n: int = 20) -> Trajectory:
    rng = np.random.default_rng(0)
    return Trajectory(
        t_ns=EPOCH_NS + np.arange(n) * 99_999_999,
        position_n=rng.normal(size=(n, 3)) * 1000,
        quat_xyzw=Rotation.random(n, rng=rng).as_quat(),
        velocity_n=rng.normal(size=(n, 3)),
        bias_acc=rng.normal(size=(n, 3)),
        bias_gyro=rng.normal(size=(n, 3)),
        cov=np.tile(np.eye(15), (n, 1, 1)),
    )


def result(smoothed: bool = False) -> Result:
    return Result("batch", trajectory(), smoothed=trajectory() if smoothed else None)


def names_in(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# ---- TUM and npz ----


def test_tum_round_trip_keeps_stamps_exactly(tmp_path):
    written = trajectory()
    write_tum(tmp_path / "a.tum", written.t_ns, written.position_n, written.quat_xyzw)
    read = read_tum(tmp_path / "a.tum")
    assert_array_equal(read.t_ns, written.t_ns)
    assert np.abs(read.position_n - written.position_n).max() <= 0.51e-9
    assert np.abs(read.quat_xyzw - written.quat_xyzw).max() <= 0.51e-9
    assert (tmp_path / "a.tum").read_text().startswith("1403636579.763555584 ")


def test_tum_formats_stamps_around_zero(tmp_path):
    t_ns = np.array([-1_500_000_000, -1, 0, 7])
    write_tum(tmp_path / "a.tum", t_ns, np.zeros((4, 3)), np.tile([0.0, 0, 0, 1], (4, 1)))
    stamps = [line.split()[0] for line in (tmp_path / "a.tum").read_text().splitlines()]
    assert stamps == ["-1.500000000", "-0.000000001", "0.000000000", "0.000000007"]
    assert_array_equal(read_tum(tmp_path / "a.tum").t_ns, t_ns)


def test_tum_of_others_is_read(tmp_path):
    (tmp_path / "a.tum").write_text(
        "# t x y z qx qy qz qw\n\n1.403636579763555584e9 1 2 3 0 0 0 1\n0.5\t4 5 6 0 0 0 1  # early\n"
        "0.5 9 9 9 0 0 0 1\n2.5 nan 0 0 0 0 0 1\n"
    )
    read = read_tum(tmp_path / "a.tum")
    assert_array_equal(read.t_ns, [500_000_000, EPOCH_NS])
    assert_array_equal(read.position_n, [[4, 5, 6], [1, 2, 3]])


def test_zero_quaternions_are_no_attitude(tmp_path):
    (tmp_path / "a.tum").write_text("1 1 2 3 0 0 0 0\n2 1 2 3 0 0 0 0\n")
    assert read_tum(tmp_path / "a.tum").quat_xyzw is None


@pytest.mark.parametrize("line", ["1 2 3", "1,2,3,4,5,6,7,8", "one 1 2 3 0 0 0 1", "inf 1 2 3 0 0 0 1"])
def test_what_is_not_tum_is_refused_with_its_line(tmp_path, line):
    (tmp_path / "a.tum").write_text(f"# header\n{line}\n")
    with pytest.raises(TbmfgError, match=r"a\.tum:2: not a TUM pose"):
        read_tum(tmp_path / "a.tum")


def test_npz_round_trip(tmp_path):
    write_result(tmp_path / "out", result(), {}, "name: rig\n")
    read, written = read_result_npz(tmp_path / "out" / "result.npz"), trajectory()
    for field in fields(Trajectory):
        assert_array_equal(getattr(read, field.name), getattr(written, field.name))
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(TbmfgError, match="not a readable npz"):
        read_result_npz(tmp_path / "bad.npz")


# ---- the folder ----


def test_every_file_is_written(tmp_path):
    scanned = result(smoothed=True)
    scanned.health = {"lidar": Health(scanned.trajectory.t_ns, *np.zeros((5, len(scanned.trajectory))))}
    write_result(tmp_path / "new" / "out", scanned, {"a": 1}, "name: rig\n", report="<p>")
    assert names_in(tmp_path / "new" / "out") == sorted(FILES)
    assert json.loads((tmp_path / "new" / "out" / "summary.json").read_text()) == {"a": 1}


def test_the_mcap_holds_poses_and_what_happened(tmp_path):
    done = result()
    done.counts["prism"] = Counts(received=10, used=9, gated=1)
    done.calibration["noise_factor"] = Calibrated(np.float64(5.0), 0.0, False)
    done.warnings.append("imu: 3 samples lost")
    write_result(tmp_path, done, {}, "name: rig\n")
    odometry = read_log(tmp_path / "result.mcap").series["/tbmfg/odometry"]
    assert_array_equal(odometry.t_ns, done.trajectory.t_ns)
    with open(tmp_path / "result.mcap", "rb") as file:
        messages = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(["/diagnostics"])
        values = {entry.key: entry.value for *_, message in messages for entry in message.status[0].values}
    assert values == {
        "estimator": "batch",
        "noise_factor": "5.0, not estimated",
        "prism": "received 10, used 9, gated 1",
        "warning 1": "imu: 3 samples lost",
    }


def test_results_are_not_overwritten_without_force(tmp_path):
    write_result(tmp_path, result(smoothed=True), {"run": 1}, "name: rig\n")
    with pytest.raises(TbmfgError, match=r"already holds trajectory\.tum, .*--force") as refusal:
        write_result(tmp_path, result(), {"run": 2}, "name: rig\n")
    assert "\n" not in str(refusal.value)
    write_result(tmp_path, result(), {"run": 2}, "name: rig\n", force=True)
    assert json.loads((tmp_path / "summary.json").read_text()) == {"run": 2}
    assert "smoothed.tum" not in names_in(tmp_path)  # of the first run: it would not belong to this one


def test_files_of_others_stay(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    write_result(tmp_path, result(), {}, "name: rig\n")
    write_result(tmp_path, result(), {}, "name: rig\n", force=True)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(TbmfgError, match="is a file"):
        refuse_existing(tmp_path / "out", force=True)


def test_a_crash_while_writing_leaves_the_old_results(tmp_path, monkeypatch):
    write_result(tmp_path / "old", result(), {"run": 1}, "name: rig\n")

    def crash(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(results, "to_json", crash)  # the last file
    with pytest.raises(KeyboardInterrupt):
        write_result(tmp_path / "old", result(), {"run": 2}, "name: rig\n", force=True)
    assert json.loads((tmp_path / "old" / "summary.json").read_text()) == {"run": 1}
    assert len(names_in(tmp_path / "old")) == 5
    with pytest.raises(KeyboardInterrupt):
        write_result(tmp_path / "new", result(), {"run": 2}, "name: rig\n")
    assert not (tmp_path / "new").exists()


def test_a_kill_while_moving_leaves_no_summary(tmp_path, monkeypatch):
    """Whole files only, and without the summary nobody takes them for a complete result."""
    write_result(tmp_path, result(), {"run": 1}, "name: rig\n")
    moved = []

    def killed_at_the_third(source, target):
        if len(moved) == 2:
            raise SystemExit
        moved.append(source.rename(target))

    monkeypatch.setattr(results.Path, "replace", killed_at_the_third)
    with pytest.raises(SystemExit):
        write_result(tmp_path, result(), {"run": 2}, "name: rig\n", force=True)
    assert names_in(tmp_path) == ["result.npz", "trajectory.tum"]


def test_scratch_lies_inside_the_folder(tmp_path):
    """So that moving never crosses a file system, and never needs a writable parent."""
    seen = []
    write_atomically(tmp_path / "out", ["a"], lambda folder: (seen.append(folder), (folder / "a").write_text("x")))
    assert seen[0].parent == tmp_path / "out"
    assert names_in(tmp_path / "out") == ["a"]


# ---- the summary ----


def test_json_has_null_for_what_is_not_a_number():
    text = to_json({"nan": float("nan"), "row": np.array([1.0, np.inf]), "n": np.int64(3), "f": np.float32(0.5)})
    assert json.loads(text, parse_constant=pytest.fail) == {"nan": None, "row": [1.0, None], "n": 3, "f": 0.5}
    assert text.index("nan") < text.index("row") < text.index('"n"')


def test_summary_of_a_result():
    done = result()
    done.calibration["prism_lever_arm_m"] = Calibrated((0.1, 0.2, 0.3), (0.01, 0.01, float("nan")), True)
    done.counts["prism"] = Counts(received=10, used=9, gated=1)
    done.innovations["prism"] = Innovations(
        done.trajectory.t_ns[:3], np.array([3.0, 6.0, 90.0]), 3, np.array([False, False, True])
    )
    done.innovations["laser"] = Innovations(done.trajectory.t_ns[:0], np.array([]), 2, np.array([]))
    done.intervals.append(Interval("prism", "outage", EPOCH_NS + 1_000_000_000, EPOCH_NS + 2_500_000_000))
    summary = json.loads(to_json(summarise(done, EPOCH_NS)))
    assert summary["calibration"]["prism_lever_arm_m"] == {
        "value": [0.1, 0.2, 0.3],
        "sd": [0.01, 0.01, None],
        "estimated": True,
        "observed": None,
    }
    assert summary["sensors"]["prism"]["gated"] == 1
    over_time = summary["innovations"]["prism"].pop("over_time")
    assert summary["innovations"]["prism"] == {
        "updates": 3, "gated": 1, "dof": 3, "nis_per_dof": 1.5, "correlation": None, "correlation_sd": None,
    }  # fmt: skip
    assert over_time["nis_per_dof"] == [1.0, 2.0, 30.0]
    assert over_time["gated"] == [0.0, 0.0, 1.0]
    assert summary["innovations"]["laser"]["nis_per_dof"] is None
    assert summary["intervals"] == [{"sensor": "prism", "kind": "outage", "start_s": 1.0, "end_s": 2.5}]


# ---- truth ----

ODOMETRY, POSE, POINT = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PointStamped"


def recording(**kinds: str) -> Log:
    """One series per topic (its slashes written as underscores): 10 poses, yaw 90 degrees, moving forward at 2 m/s."""
    t_ns = EPOCH_NS + np.arange(10) * 100_000_000
    position = np.outer(np.arange(10) * 0.2, [0.0, 1.0, 0.0])
    columns = {"position": position, "quat_xyzw": np.tile([0, 0, np.sqrt(0.5), np.sqrt(0.5)], (10, 1))}
    by_type = {
        POSE: columns,
        ODOMETRY: {**columns, "linear": np.tile([2.0, 0, 0], (10, 1)), "angular": np.zeros((10, 3))},
        POINT: {"point": position},
    }
    topics = {name.replace("_", "/"): kind for name, kind in kinds.items()}
    return Log("x.mcap", {topic: Series(topic, kind, t_ns, by_type[kind]) for topic, kind in topics.items()})


def rig(topic: str | None = None):
    return SimpleNamespace(truth=topic and SimpleNamespace(topic=topic))


def test_truth_is_found_by_rig_then_by_name():
    log = recording(_prism=POINT, _vicon=POSE, _a_Truth=POSE, _b_ground_truth=ODOMETRY, _c_truth=POINT)
    assert find_truth("auto", log, rig("/vicon")) == "/vicon"
    assert find_truth("auto", log, rig("/absent")) == "/b/ground/truth"
    assert find_truth("auto", log, rig()) == "/b/ground/truth"
    assert find_truth("auto", recording(_prism=POINT), rig()) is None
    assert find_truth("none", log, rig("/vicon")) is None
    assert find_truth("/prism", log, rig("/vicon")) == "/prism"


def test_absent_truth_is_refused_with_what_there_is():
    with pytest.raises(TbmfgError, match=r"--truth /nope: neither a topic .* nor a file; .*: /prism, /vicon"):
        find_truth("/nope", recording(_prism=POINT, _vicon=POSE), rig())


def test_odometry_velocity_is_turned_to_n():
    truth = load_truth("/truth", recording(_truth=ODOMETRY))
    assert np.abs(truth.velocity_n - [0.0, 2.0, 0.0]).max() < 1e-12


def test_truth_without_attitude_or_velocity():
    assert load_truth("/truth", recording(_truth=POSE)).velocity_n is None
    truth = load_truth("/truth", recording(_truth=POINT))
    assert truth.quat_xyzw is None
    assert len(truth.t_ns) == 10


@pytest.mark.parametrize("unfilled", [0.0, np.nan])
def test_a_velocity_that_is_never_filled_in_is_none(unfilled):
    log = recording(_truth=ODOMETRY)
    log.series["/truth"].columns["linear"] = np.full((10, 3), unfilled)
    truth = load_truth("/truth", log)
    assert truth.velocity_n is None
    assert len(truth.t_ns) == 10


def test_truth_from_files(tmp_path):
    written = trajectory()
    write_tum(tmp_path / "a.tum", written.t_ns, written.position_n, written.quat_xyzw)
    np.savez(tmp_path / "a.npz", t_ns=written.t_ns[::-1], position_n=written.position_n[::-1])
    log = recording()
    assert find_truth(str(tmp_path / "a.tum"), log, rig()) == str(tmp_path / "a.tum")
    assert len(load_truth(str(tmp_path / "a.tum"), log).t_ns) == 20
    truth = load_truth(str(tmp_path / "a.npz"), log)
    assert_array_equal(truth.position_n, written.position_n)
    assert truth.quat_xyzw is None


def test_a_series_without_positions_is_no_truth():
    log = recording(_truth=POSE)
    imu = replace(log.series["/truth"], topic="/imu", columns={"gyro": np.zeros((10, 3))})
    with pytest.raises(TbmfgError, match="holds no positions"):
        load_truth("/imu", replace(log, series={"/imu": imu}))
