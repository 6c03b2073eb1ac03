"""What users feed it: each fault is one line and exit code 1, or the sound part is used and the loss is counted."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.writer import Writer
from typer.testing import CliRunner

import datasets
from tbmfg import cli, estimators
from tbmfg.errors import EstimationError
from tbmfg.inertial import sanity
from tbmfg.inertial.steps import make_steps
from tbmfg.mcap import read_log, write_log
from tbmfg.mcap.layouts import LAYOUTS, encode
from tbmfg.problem import breakdown_explained
from tbmfg.timeseries import NS, Series

IMU, PRISM, ODOMETER, MAGNETOMETER = "/imu/data", "/prism/position", "/odometer", "/imu/mag"
G = 9.80665


@pytest.fixture(scope="module")
def drive():
    """Half a minute of a simulated machine, with a rig."""
    return datasets.make("tbm-drive", seed=1, duration=30.0)


@pytest.fixture
def write(drive, tmp_path):
    """Write the drive with topics changed (topic -> series), dropped (topic -> None) and log times as recorded."""

    def write(changes=(), *, rig=True, only=None, **options):
        changes = dict(changes)
        series = {one.topic: one for one in drive.log_series if only is None or one.topic in only}
        log_ns = {topic: one.t_ns for topic, one in series.items()}
        series = {topic: changes.get(topic, one) for topic, one in series.items()}
        attachments = {"rig.yaml": drive.rig_text.encode()} if rig else {}
        path = tmp_path / "log.mcap"
        kept = [one for one in series.values() if one is not None]
        times = {
            one.topic: log_ns[one.topic] for one in kept if one.topic in log_ns and len(log_ns[one.topic]) == len(one)
        }
        write_log(path, kept, attachments=attachments, log_ns=times, **options)
        return path

    return write


@pytest.fixture
def topic(drive):
    return {one.topic: one for one in drive.log_series}


def tbmfg(*arguments):
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments], prog_name="tbmfg")


def run(path, *options):
    """The summary of a run that succeeds; the quick filter, with the rig's own noise."""
    out = path.with_suffix(".out")
    quick = ("--estimator", "ins", "--set", "sensors.imu.noise_factor=1")
    ran = tbmfg("run", path, "-o", out, *quick, *options)
    assert ran.exit_code == 0, ran.output
    summary = json.loads((out / "summary.json").read_text())
    for counts in summary["sensors"].values():
        assert counts["received"] == sum(count for name, count in counts.items() if name != "received")
    for warning in summary["warnings"]:
        assert f"warning: {warning}" in ran.stdout
    return summary


def refused(path, *options, command="run"):
    """The one line of a command that refuses its input, without its beginning; nothing is left behind."""
    out = path.with_suffix(".out")
    ran = tbmfg(command, path, "-o", out, *options)
    assert ran.exit_code == 1, ran.output
    assert ran.stdout == ""
    assert ran.stderr.startswith("tbmfg: ")
    assert ran.stderr.count("\n") == 1
    assert "internal error" not in ran.stderr
    assert not out.exists()
    return ran.stderr


def only_warning(summary, beginning):
    (found,) = [warning for warning in summary["warnings"] if warning.startswith(beginning)]
    return found


def changed(series, **columns):
    return replace(series, columns={**series.columns, **columns})


def restamped(series, rows, t_ns):
    stamps = series.t_ns.copy()
    stamps[rows] = t_ns
    return replace(series, t_ns=stamps)


def set_rows(values, rows, value):
    values = values.copy()
    values[rows] = value
    return values


# ---- files ----


@pytest.mark.parametrize("command", ["run", "init"])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read (No such file or directory); check the name"),
        (b"", "is empty (0 bytes): the recorder wrote nothing; record again"),
        (b"time,ax,ay,az\n" * 10, "not an MCAP file (140 bytes, beginning with b'time,ax,'; record with: ros2 bag"),
        (b"SQLite format 3\0" + bytes(90), "not an MCAP file (a rosbag2 database; convert it with: ros2 bag convert"),
    ],
)
def test_what_is_no_recording(tmp_path, command, content, message):
    path = tmp_path / "log.mcap"
    if content is not None:
        path.write_bytes(content)
    assert message in refused(path, command=command)
    assert tbmfg("info", path).exit_code == 1


def test_a_recording_without_messages(write):
    assert "no message could be read from" in refused(write(only=()))


def test_a_cut_file_is_used_as_far_as_it_goes(write):
    path = write(chunk_size=1 << 16)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    summary = run(path)
    assert 5000 < summary["sensors"]["imu"]["used"] < 10_000
    assert "the file was cut" in only_warning(summary, "log.mcap: ")
    assert "the file was cut" in tbmfg("info", path).stdout


def test_a_file_without_index_is_used_whole(write):
    path = write()
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"\x0f\x04" + bytes(7))])  # before the end of its data section
    summary = run(path)
    assert summary["sensors"]["imu"]["used"] == 14_250
    assert "without a footer" in only_warning(summary, "log.mcap: ")


def test_a_corrupt_chunk_is_lost_and_counted(write, topic):
    path = write(chunk_size=1 << 16)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 + 5000] ^= 0xFF
    path.write_bytes(data)
    summary = run(path)
    lost = only_warning(summary, "log.mcap: chunk at byte")
    messages = int(lost.partition(" messages)")[0].rpartition(" ")[2])
    everything = sum(len(one) for one in topic.values())
    read = sum(len(one) for one in read_log(path).series.values())
    assert read + messages == everything
    assert "imu: gaps: 1, " in only_warning(summary, "imu: gaps")


def write_raw(path, imu, *, message_encoding="cdr", schema_encoding="ros2msg", name=None, text=b"", payload=None):
    """IMU messages under whatever declarations."""
    payloads = encode(LAYOUTS[imu.type], imu.t_ns, imu.columns, {"frame_id": "imu"})
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(imu.type if name is None else name, schema_encoding, text)
        channel = writer.register_channel(imu.topic, message_encoding, schema)
        for t_ns, true in zip(imu.t_ns.tolist(), payloads, strict=True):
            writer.add_message(channel, t_ns, bytes(true) if payload is None else payload, t_ns)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"message_encoding": "protobuf"}, "/imu/data (sensor_msgs/msg/Imu (message encoding 'protobuf'))"),
        ({"schema_encoding": "jsonschema"}, "/imu/data (sensor_msgs/msg/Imu (schema encoding 'jsonschema'))"),
        ({"name": ""}, "/imu/data (no type, not read)"),
        ({"name": "std_msgs/msg/String"}, "/imu/data (std_msgs/String, not read)"),
        ({"payload": b"\x00\x01\x00\x00\x07"}, "0 usable of 500 messages, 500 cannot be decoded"),
        ({"payload": b""}, "0 usable of 500 messages, 500 cannot be decoded"),
    ],
)
def test_messages_that_cannot_be_understood(tmp_path, topic, options, message):
    path = write_raw(tmp_path / "log.mcap", topic[IMU].select(slice(500)), **options)
    assert message in refused(path)
    assert "every estimator needs an IMU" in refused(path, command="init")
    assert tbmfg("info", path).exit_code == 0


@pytest.mark.parametrize("text", [b"", b"float64 x\nnot a definition !!", b"\xff\xfe"])
def test_a_wrong_definition_does_not_matter_to_a_known_type(tmp_path, topic, text):
    path = write_raw(tmp_path / "log.mcap", topic[IMU].select(slice(500)), text=text)
    assert len(read_log(path).series[IMU]) == 500
    assert "nothing but the IMU to go by" in refused(path)


# ---- the IMU ----


@pytest.mark.parametrize("rig", [True, False])
def test_no_imu(write, rig):
    message = refused(write({IMU: None}, rig=rig))
    assert "every estimator needs an IMU" in message
    assert (": no messages on /imu/data, imu topics in the log: none" in message) == rig
    assert ("it has /imu/mag (sensor_msgs/MagneticField)" in message) != rig


def test_an_imu_in_g_is_refused_until_the_rig_says_so(write, topic):
    path = write({IMU: changed(topic[IMU], acc=topic[IMU]["acc"] / G)})
    message = refused(path)
    assert "specific force is typically 0.999 m/s^2" in message
    assert message.endswith("it seems to be in g; if so, set sensors.imu.acc_unit=g\n")
    summary = run(path, "--set", "sensors.imu.acc_unit=g")
    assert summary["metrics"]["position_rms_m"] < 0.1


def test_an_imu_in_degrees_is_refused_until_the_rig_says_so(write, topic):
    rng = np.random.default_rng(0)
    rocking = 0.3 * np.sin(np.arange(len(topic[IMU])) / 475.0)  # rad, about x
    rate = np.gradient(rocking, 1 / 475.0)
    gyro = np.stack([rate, 0 * rate, 0 * rate], axis=1) + 1e-4 * rng.standard_normal((len(rate), 3))
    acc = G * np.stack([0 * rocking, np.sin(rocking), np.cos(rocking)], axis=1)
    degrees = changed(topic[IMU], gyro=np.rad2deg(gyro), acc=acc + 0.01 * rng.standard_normal(acc.shape))
    message = refused(write({IMU: degrees}))
    assert message.endswith("if so, set sensors.imu.gyro_unit=deg/s\n")
    radians = changed(degrees, gyro=gyro)
    assert sanity.fault(make_steps(radians, np.eye(3), "end")) is None


def test_other_units_and_missing_gravity(write, topic):
    acc = topic[IMU]["acc"]
    message = refused(write({IMU: changed(topic[IMU], acc=acc - acc.mean(axis=0))}))
    assert "gravity seems to be removed" in message
    assert "the unit is not m/s^2" in refused(write({IMU: changed(topic[IMU], acc=1000 / G * acc)}))
    assert "the unit is not m/s^2" in refused(write(), "--set", "sensors.imu.acc_unit=g")


@pytest.mark.parametrize(("column", "what"), [("gyro", "gyro"), ("acc", "accelerometer")])
def test_a_frozen_imu(write, topic, column, what):
    frozen = np.tile(topic[IMU][column][:1], (len(topic[IMU]), 1))
    message = refused(write({IMU: changed(topic[IMU], **{column: frozen})}))
    assert f"/imu/data: all samples of the {what} read " in message
    assert "it is stuck; check the sensor and its driver" in message


def test_repeats_of_an_imu_that_hangs_are_left_out_and_bridged(write, topic):
    stuck = {name: set_rows(topic[IMU][name], slice(9000, 10_000), topic[IMU][name][9000]) for name in ("gyro", "acc")}
    summary = run(write({IMU: changed(topic[IMU], **stuck)}))
    warning = only_warning(summary, "imu: hangs on one reading")
    assert "stretches: 1, the longest 2.10 s at 18.95 s; its 999 repeats are left out" in warning
    assert "imu: gaps: 1, 2.1 s together" in only_warning(summary, "imu: gaps")
    assert summary["sensors"]["imu"]["used"] == len(topic[IMU]) - 999
    assert summary["metrics"]["attitude_rms_deg"] < 0.5


def test_impossible_readings_are_left_out(write, topic):
    gyro = set_rows(topic[IMU]["gyro"], 5000, 1e200)
    acc = set_rows(topic[IMU]["acc"], 6000, 1e30)
    summary = run(write({IMU: changed(topic[IMU], gyro=gyro, acc=acc)}))
    assert "2 of 14250 samples are beyond 200 rad/s or 10000 m/s^2" in only_warning(summary, "imu: 2 of")
    assert (summary["sensors"]["imu"]["used"], summary["sensors"]["imu"]["unused"]) == (14_248, 2)
    assert summary["metrics"]["position_rms_m"] < 0.1


@pytest.mark.parametrize("rig", [True, False])
def test_an_imu_alone(write, rig):
    message = refused(write(only=(IMU,), rig=rig))
    assert "nothing but the IMU to go by; an estimate needs a prism, gnss, odometer, magnetometer" in message
    assert ("prism: no messages on /prism/position, prism topics in the log: none" in message) == rig


def test_nan_stretches_are_bridged_and_counted(write, topic):
    gyro = set_rows(topic[IMU]["gyro"], slice(9000, 9950), np.nan)
    point = set_rows(topic[PRISM]["point"], slice(40, 60), np.nan)
    summary = run(write({IMU: changed(topic[IMU], gyro=gyro), PRISM: changed(topic[PRISM], point=point)}))
    assert summary["sensors"]["imu"]["nonfinite"] == 950
    assert summary["sensors"]["prism"]["nonfinite"] == 20
    assert "imu: gaps: 1, 2 s together, the longest 2 s at 18.95 s" in only_warning(summary, "imu: gaps")
    assert summary["metrics"]["position_rms_m"] < 0.1


def test_nothing_but_nan(write, topic):
    message = refused(write({IMU: changed(topic[IMU], gyro=np.nan * topic[IMU]["gyro"])}))
    assert "0 usable of 14250 IMU samples (14250 hold NaN); check the IMU" in message


# ---- time ----


@pytest.mark.parametrize(
    ("rows", "shift_ns", "left_out"),
    [
        ([0, 500, 501, 9000], None, 4),
        (slice(12_000, None), 3 * 86_400 * NS, 2250),
        (slice(100), -40 * 365 * 86_400 * NS, 100),
        ([700], 100 * NS, 1),
        (slice(12_000, None), -2 * NS, 949),
    ],
)
def test_wrong_stamps_are_left_out_and_the_rest_is_used(write, topic, rows, shift_ns, left_out):
    imu = topic[IMU]
    path = write({IMU: restamped(imu, rows, 0 if shift_ns is None else imu.t_ns[rows] + shift_ns)})
    summary = run(path)
    assert summary["duration_s"] < 31
    assert summary["metrics"]["position_rms_m"] < 0.2
    counts = summary["sensors"]["imu"]
    assert counts["unused"] == left_out
    assert counts["used"] + counts["duplicate"] == 14_250 - left_out
    said = f"imu: {left_out} of 14250 messages on /imu/data bear a stamp that cannot be right; left out"
    assert said in summary["warnings"]
    assert f"{left_out} of 14250 messages bear a stamp that cannot be right" in tbmfg("info", path).stdout


def test_stamps_that_are_never_set(write, topic):
    message = refused(write({IMU: restamped(topic[IMU], slice(None), 0)}))
    assert "0 usable of 14250 IMU samples (14250 bear a wrong stamp)" in message


def test_wrong_stamps_of_another_sensor(write, topic):
    summary = run(write({PRISM: restamped(topic[PRISM], [0, 50], 0)}))
    assert summary["sensors"]["prism"]["unused"] == 2
    assert "prism: 2 of 150 messages on /prism/position bear a stamp" in only_warning(summary, "prism: 2")


def test_repeated_stamps_are_counted(write, topic):
    imu = topic[IMU]
    summary = run(write({IMU: restamped(imu, slice(1, None, 2), imu.t_ns[::2])}))
    assert summary["sensors"]["imu"]["duplicate"] == 7125


def test_a_pause_is_bridged_and_said(write, topic):
    imu = topic[IMU]
    summary = run(write({IMU: restamped(imu, slice(12_000, None), imu.t_ns[12_000:] + 60 * NS)}))
    assert "imu: gaps: 1, 60 s together" in only_warning(summary, "imu: gaps")


def test_a_sensor_on_another_clock(write, topic):
    prism = topic[PRISM]
    summary = run(write({PRISM: replace(prism, t_ns=prism.t_ns - 1000 * NS)}))
    assert summary["sensors"]["prism"]["unused"] == 150
    assert "its stamps begin -999.9 s from the IMU's; it is not used" in only_warning(summary, "prism: ")


# ---- length ----


@pytest.mark.parametrize("duration_s", [0.1, 0.5, 3.0])
def test_short_logs_have_an_end_but_no_traceback(write, topic, duration_s):
    cut = {name: one.select(one.t_ns < one.t_ns[0] + int(duration_s * NS)) for name, one in topic.items()}
    assert run(write(cut))["duration_s"] == pytest.approx(duration_s, abs=0.01)


def test_a_short_log_without_a_rig(write, topic):
    cut = {name: one.select(one.t_ns < one.t_ns[0] + NS // 10) for name, one in topic.items()}
    message = refused(write(cut, rig=False))
    assert "not used: /prism/position: 1 usable of 1 messages" in message


def test_two_imu_samples(write, topic):
    assert "2 usable of 2 IMU samples" in refused(write({IMU: topic[IMU].select(slice(2))}))


# ---- a rig that does not fit ----


def test_renamed_topics(write, topic):
    assert "imu topics in the log: /imu0" in refused(write({IMU: replace(topic[IMU], topic="/imu0")}))
    all_renamed = {PRISM: replace(topic[PRISM], topic="/leica"), ODOMETER: None, MAGNETOMETER: None}
    message = refused(write(all_renamed))
    assert "prism: no messages on /prism/position, prism topics in the log: /leica" in message
    summary = run(write({ODOMETER: replace(topic[ODOMETER], topic="/wheel/odom")}))
    said = "odometer: no messages on /odometer, odometer topics in the log: /wheel/odom; it is not used"
    assert said in summary["warnings"]


def test_swapped_topics(write, topic):
    path = write({PRISM: replace(topic[ODOMETER], topic=PRISM), ODOMETER: replace(topic[PRISM], topic=ODOMETER)})
    assert "prism: /prism/position is geometry_msgs/msg/TwistStamped, prism topics in the log: /odometer" in refused(
        path
    )
    assert "imu: /odometer is geometry_msgs/msg/PointStamped" in refused(
        path, "--set", "sensors.imu.topic=/odometer", "--set", "sensors.odometer.topic=/imu/data"
    )


def test_a_topic_of_a_type_that_is_not_read(tmp_path, topic):
    path = write_raw(tmp_path / "log.mcap", topic[IMU].select(slice(500)), name="my_msgs/msg/Imu")
    rig = tmp_path / "rig.yaml"
    rig.write_text("sensors: {imu: {topic: /imu/data}}")
    assert "imu: /imu/data is my_msgs/msg/Imu, which is not read" in refused(path, "--rig", rig)


# ---- hopeless problems ----


@pytest.mark.parametrize("estimator", ["ins", "batch"])
def test_contradicting_sensors_are_gated_and_said(write, topic, estimator):
    nonsense = 1e4 * np.random.default_rng(0).standard_normal(topic[PRISM]["point"].shape)
    summary = run(write({PRISM: changed(topic[PRISM], point=nonsense)}), "--estimator", estimator)
    counts = summary["sensors"]["prism"]
    assert only_warning(summary, f"prism: {counts['gated']} of 150 samples contradict the estimate")


@pytest.mark.parametrize(
    "error", [np.linalg.LinAlgError("Singular matrix"), RuntimeError("Indeterminant\n linear system"), OverflowError()]
)
def test_breakdowns_are_estimation_errors(error):
    expected = pytest.raises(EstimationError, match=r"^batch broke down \(.*\): the readings and the rig contradict")
    with expected, breakdown_explained("batch"):
        raise error


def test_results_that_are_no_numbers_are_refused(monkeypatch):
    n = 5
    good = {
        "position_n": np.zeros((n, 3)), "quat_xyzw": np.zeros((n, 4)), "velocity_n": np.zeros((n, 3)),
        "bias_acc": np.zeros((n, 3)), "bias_gyro": np.zeros((n, 3)), "cov": np.zeros((n, 15, 15)),
    }  # fmt: skip

    class Path(SimpleNamespace):
        def __len__(self):
            return n

    bad = Path(**{**good, "cov": set_rows(good["cov"], 3, np.nan)})
    result = SimpleNamespace(estimator="batch", trajectory=Path(**good), smoothed=bad, counts={}, warnings=[])
    entry = SimpleNamespace(run=lambda problem, progress: result, needs=())
    monkeypatch.setitem(estimators.ESTIMATORS, "batch", entry)
    problem = SimpleNamespace(keyframes_s=np.arange(n) * 2.0, samples={}, scans={})
    with pytest.raises(EstimationError, match=r"batch lost the state at 6\.0 s: it is not finite"):
        estimators.estimate("batch", problem)
    result.smoothed = None
    assert estimators.estimate("batch", problem) is result


# ---- nothing is overwritten ----


def test_a_refused_log_leaves_results_alone(write, topic):
    path = write()
    run(path)
    out = path.with_suffix(".out")
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    write({IMU: None})
    assert tbmfg("run", path, "-o", out, "--force").exit_code == 1
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before


# ---- the sanity checks themselves ----


def test_a_quiet_imu_in_si_units_is_sound():
    rng = np.random.default_rng(0)
    columns = {"gyro": 1e-4 * rng.standard_normal((3000, 3)), "acc": rng.normal([0.0, 0.0, G], 3.0, (3000, 3))}
    imu = Series("/imu", "sensor_msgs/msg/Imu", np.arange(1, 3001) * (NS // 100), columns)
    assert sanity.fault(make_steps(imu, np.eye(3), "end")) is None
    assert sanity.stuck(imu) == []
    assert not sanity.impossible(imu).any()
    raw = changed(imu, acc=1e5 * imu["acc"])
    assert not sanity.impossible(raw).any()  # all of them: the unit is wrong, and said so
