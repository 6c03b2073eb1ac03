"""What others make of our files: rosbags, evo as a separate process, Foxglove's layout; copies that lose nothing."""

import json
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_samples import START_NS, sample, samples
from rosbags.highlevel import AnyReader

from tbmfg.errors import LogError
from tbmfg.evaluation.metrics import evaluate
from tbmfg.geometry import exp_so3, quat_from_matrix
from tbmfg.mcap import read_log, write_into, write_log, write_trajectory
from tbmfg.mcap.info import guess_role
from tbmfg.results import write_tum
from tbmfg.state import NAV, Interval, Trajectory, Truth
from tbmfg.timeseries import Series, Transform

ROOT = Path(__file__).parents[1]


def trajectory(n: int = 300) -> Trajectory:
    rng = np.random.default_rng(1)
    t = np.arange(n) * 0.1
    return Trajectory(
        START_NS + np.arange(n) * 100_000_000,
        np.column_stack([t, np.sin(t), 0.1 * t]) + 0.01 * rng.standard_normal((n, 3)),
        quat_from_matrix(exp_so3(np.column_stack([0 * t, 0.1 * np.sin(t), 0.2 * t]))),
        rng.standard_normal((n, 3)),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        np.tile(np.eye(NAV), (n, 1, 1)),
    )


def truth_of(path: Trajectory) -> Series:
    """The same, turned, shifted and disturbed, as a pose topic."""
    R = exp_so3(np.array([0.1, -0.2, 0.7]))
    position = path.position_n @ R.T + [100.0, -50.0, 3.0]
    position += 0.02 * np.random.default_rng(2).standard_normal(position.shape)
    columns = {"position": position, "quat_xyzw": path.quat_xyzw}
    return Series("/truth/pose", "geometry_msgs/msg/PoseStamped", path.t_ns, columns, "map")


# ---- rosbags ----


def test_rosbags_reads_the_result_with_the_types_it_carries(tmp_path):
    path = trajectory(20)
    events = [Interval("prism", "outage", int(path.t_ns[3]), int(path.t_ns[8])), Interval("imu", "gap", 0, 5)]
    write_trajectory(tmp_path / "result.mcap", path, diagnostics={"estimator": "batch"}, intervals=events)
    with AnyReader([tmp_path / "result.mcap"]) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert counts == {"/tbmfg/odometry": 20, "/tbmfg/path": 1, "/tf": 20, "/diagnostics": 5}
        read = {topic: [] for topic in counts}
        for connection, t_ns, raw in reader.messages():
            read[connection.topic].append((t_ns, reader.deserialize(raw, connection.msgtype)))
    ((_, whole),) = read["/tbmfg/path"]
    assert whole.header.frame_id == "map"
    assert [pose.header.stamp.sec * 10**9 + pose.header.stamp.nanosec for pose in whole.poses] == path.t_ns.tolist()
    assert [[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in whole.poses] == path.position_n.tolist()
    told = [(t_ns, s.status[0].name, s.status[0].level, s.status[0].message) for t_ns, s in read["/diagnostics"][1:]]
    start = int(path.t_ns[0])
    assert told == [
        (start, "tbmfg: imu", 1, "gap"),
        (start, "tbmfg: imu", 0, "gap over"),
        (events[0].start_ns, "tbmfg: prism", 1, "outage"),
        (events[0].end_ns, "tbmfg: prism", 0, "outage over"),
    ]


def test_profile_and_qos_are_those_of_rosbag2(tmp_path):
    still = Transform("base_link", "imu", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    write_log(tmp_path / "bag", [truth_of(trajectory(5))], transforms=[still])
    with open(tmp_path / "bag" / "bag_0.mcap", "rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    with AnyReader([tmp_path / "bag"]) as reader:
        offered = {connection.topic: connection.ext.offered_qos_profiles for connection in reader.connections}
    assert [profile.durability.name for profile in offered["/tf_static"]] == ["TRANSIENT_LOCAL"]


# ---- Foxglove ----


def test_the_layout_asks_for_what_a_result_holds(tmp_path):
    """Every topic and field that the layout names is in a result; panels and their places agree."""
    layout = json.loads((ROOT / "docs" / "foxglove-layout.json").read_text("utf-8"))

    def places(node) -> list[str]:
        return [node] if isinstance(node, str) else places(node["first"]) + places(node["second"])

    assert sorted(places(layout["layout"])) == sorted(layout["configById"])
    write_trajectory(tmp_path / "r.mcap", trajectory(3), diagnostics={"estimator": "batch"})
    with AnyReader([tmp_path / "r.mcap"]) as reader:
        messages = {c.topic: reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()}
    panels = layout["configById"].values()
    assert set(layout["configById"]["3D!path"]["topics"]) <= set(messages)
    assert layout["configById"]["DiagnosticSummary!sensors"]["topicToRender"] in messages
    paths = [path["value"] for panel in panels for path in panel.get("paths", ())]
    assert len(paths) == 7
    for path in paths:
        topic, *fields = path.removesuffix(".@sqrt").split(".")
        value = messages[topic]
        for field in fields:
            name, index = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", field).groups()
            value = getattr(value, name) if index is None else getattr(value, name)[int(index)]
        assert isinstance(value, float)


# ---- evo ----


def evo(tool: str) -> str | None:
    return shutil.which(tool) or shutil.which(tool, path=str(Path(sys.executable).parent))


@pytest.mark.skipif(evo("evo_ape") is None, reason="no evo to compare with")
@pytest.mark.parametrize("kind", ["tum", "mcap"])
def test_evo_finds_our_ape(tmp_path, kind):
    """Aligned as ours is; both files are exact to a nanometre, so the two agree far below a micrometre."""
    path = trajectory()
    true = truth_of(path)
    if kind == "tum":
        write_tum(tmp_path / "true.tum", true.t_ns, true["position"], true["quat_xyzw"])
        write_tum(tmp_path / "ours.tum", path.t_ns, path.position_n, path.quat_xyzw)
        files = ["true.tum", "ours.tum"]
    else:
        write_log(tmp_path / "log.mcap", [true])
        write_into(tmp_path / "log.mcap", tmp_path / "both.mcap", path, "/truth/pose")
        files = ["both.mcap", "/truth/pose", "/tbmfg/odometry"]
    command = [evo("evo_ape"), kind, *files, "--align", "--save_results", "ape.zip", "--no_warnings"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, timeout=120)
    with zipfile.ZipFile(tmp_path / "ape.zip") as results:
        theirs = json.loads(results.read("stats.json"))
    ours = evaluate(path, Truth(true.t_ns, true["position"], true["quat_xyzw"]))
    assert theirs["rmse"] == pytest.approx(ours["ape_rms_m"], abs=1e-6)
    assert theirs["max"] == pytest.approx(ours["ape_max_m"], abs=1e-6)
    assert ours["ape_rms_m"] > 0.01


@pytest.mark.skipif(evo("evo_traj") is None, reason="no evo to read with")
@pytest.mark.parametrize("kind", ["tum", "mcap"])
def test_evo_finds_our_poses_whole(tmp_path, kind):
    path = trajectory()
    if kind == "tum":
        write_tum(tmp_path / "ours.tum", path.t_ns, path.position_n, path.quat_xyzw)
        files = ["ours.tum"]
    else:
        write_trajectory(tmp_path / "result.mcap", path, diagnostics={"estimator": "batch"})
        files = ["result.mcap", "/tbmfg/odometry"]
    command = [evo("evo_traj"), kind, *files, "--full_check", "--no_warnings"]
    told = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True, timeout=120).stdout
    found = dict(re.findall(r"^\t([^\t]+)\t(.+)$", told, re.MULTILINE))
    assert int(found["nr. of poses"]) == len(path)
    steps = np.linalg.norm(np.diff(path.position_n, axis=0), axis=1)
    assert float(found["path length (m)"]) == pytest.approx(steps.sum(), abs=1e-6)
    assert float(found["t_start (s)"]) == pytest.approx(path.t_ns[0] * 1e-9, abs=1e-6)
    checks = ("SE(3) conform", "array shapes", "nr. of stamps", "quaternions", "timestamps")
    assert [found[check] for check in checks] == ["yes", "ok", "ok", "ok", "ok"]


# ---- poses back into a copy of the log ----


def everything(path: Path) -> list:
    with open(path, "rb") as file:
        return [
            (
                *(schema.name, schema.encoding, schema.data, channel.topic, channel.message_encoding, channel.metadata),
                *(record.log_time, record.publish_time, record.sequence, record.data),
            )
            for schema, channel, record in make_reader(file).iter_messages()
        ]


def test_a_copy_keeps_every_message_and_adds_the_poses(tmp_path):
    log = samples(40)
    late = {one.topic: one.t_ns + 7_000_000_000 for one in log}
    write_log(tmp_path / "log.mcap", log, attachments={"rig.yaml": b"name: x"}, log_ns=late)
    write_into(tmp_path / "log.mcap", tmp_path / "copy.mcap", trajectory(30), "/imu")
    before, after = everything(tmp_path / "log.mcap"), everything(tmp_path / "copy.mcap")
    assert [one for one in after if not one[3].startswith("/tbmfg/")] == before
    added = [one for one in after if one[3] == "/tbmfg/odometry"]
    assert [one[6] - 7_000_000_000 for one in added] == trajectory(30).t_ns.tolist()  # logged as late as the IMU
    copy = read_log(tmp_path / "copy.mcap")
    assert copy.attachments == {"rig.yaml": b"name: x"}
    np.testing.assert_array_equal(copy.series["/tbmfg/odometry"]["position"], trajectory(30).position_n)
    assert guess_role("/tbmfg/odometry", "nav_msgs/msg/Odometry") == "unknown"  # it is no odometer of the machine


def test_a_folder_of_files_becomes_one(tmp_path):
    write_log(tmp_path / "bag", [sample("sensor_msgs/msg/Imu", 50)])
    write_into(tmp_path / "bag", tmp_path / "copy.mcap", trajectory(5), "/imu")
    copied = [one for one in everything(tmp_path / "copy.mcap") if one[3] == "/imu"]
    assert copied == everything(tmp_path / "bag" / "bag_0.mcap")


def test_a_recording_of_others_is_copied_as_it_is(tmp_path):
    """Without a schema, out of order, with metadata and a type nobody knows."""
    with open(tmp_path / "log.mcap", "wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="someone")
        bare = writer.register_channel("/bare", "json", 0, {"a": "b"})
        for log_ns in (5, 3, 9):
            writer.add_message(bare, log_ns, b"{}", log_ns - 1, 77)
        writer.add_metadata("who", {"name": "x"})
        writer.finish()
    write_into(tmp_path / "log.mcap", tmp_path / "copy.mcap", trajectory(2), "/imu")
    with open(tmp_path / "copy.mcap", "rb") as file:
        reader = make_reader(file)
        kept = [(m.log_time, m.publish_time, m.sequence, m.data) for _, _, m in reader.iter_messages(["/bare"])]
        assert kept == [(3, 2, 77, b"{}"), (5, 4, 77, b"{}"), (9, 8, 77, b"{}")]
        assert [(one.name, one.metadata) for one in reader.iter_metadata()] == [("who", {"name": "x"})]


def test_what_cannot_be_copied_whole_is_refused(tmp_path):
    source = tmp_path / "log.mcap"
    write_log(source, [sample("sensor_msgs/msg/Imu", 500)])
    with pytest.raises(LogError, match="is the recording itself"):
        write_into(source, source, trajectory(2), "/imu")
    with pytest.raises(LogError, match=r"ends in \.mcap"):
        write_into(source, tmp_path / "copy", trajectory(2), "/imu")
    write_into(source, tmp_path / "once.mcap", trajectory(2), "/imu")
    with pytest.raises(LogError, match="holds /tbmfg/odometry already"):
        write_into(tmp_path / "once.mcap", tmp_path / "twice.mcap", trajectory(2), "/imu")
    data = bytearray(source.read_bytes())
    data[len(data) // 2] ^= 0xFF
    source.write_bytes(data)
    with pytest.raises(LogError, match="a copy would not be whole"):
        write_into(source, tmp_path / "copy.mcap", trajectory(2), "/imu")
    assert not (tmp_path / "copy.mcap").exists()
