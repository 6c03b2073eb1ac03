"""Faults done to a log: told exactly, and survived by every estimator with counts that add up and the fault named."""

import json
import re

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.stats import chi2, norm

from benchmarks import corrupt
from benchmarks.runs import Held, true_states
from datasets import faults
from datasets.__main__ import main
from datasets.simulate import START_NS
from tbmfg import pipeline
from tbmfg.errors import LogError
from tbmfg.evaluation.metrics import trajectory_errors
from tbmfg.filters.ins import REOPEN
from tbmfg.mcap import read_log, write_log
from tbmfg.state import POS, ROT
from tbmfg.timeseries import Series, StreamCounts
from tests.problems import drive

PRISM, IMU, ODOMETER, MAGNETOMETER = "/prism/position", "/imu/data", "/odometer", "/imu/mag"
SECONDS = 16.0
ESTIMATORS = ("batch", "ins", "fixed-lag", "isam2")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A short drive as a file."""
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    drive(5, SECONDS).write(path)
    return path


def corrupted(log, tmp_path, *specs, seed=2):
    """The log with faults: its file, and what was told of the first of them."""
    out = tmp_path / "corrupt.mcap"
    told = faults.corrupt(log, out, [faults.parse(spec) for spec in specs], seed=seed)
    assert json.loads(read_log(out).attachments["faults.json"]) == {"seed": seed, "faults": told}
    return out, told[0]


def messages(path, topic=PRISM):
    """(log time, payload) of every message of a topic, and the payloads of all the others."""
    from tbmfg.mcap.into import records

    found = [(channel.topic, at, bytes(record.data)) for at, _, (_, channel, record) in records([path])]
    return [one[1:] for one in found if one[0] == topic], [one for one in found if one[0] != topic]


# ---- what is done ----


@pytest.mark.parametrize("kind", faults.KINDS)
def test_only_the_messages_told_of_are_changed(log, tmp_path, kind):
    out, told = corrupted(log, tmp_path, kind)
    again, _ = corrupted(log, tmp_path, kind)
    assert again.read_bytes() == out.read_bytes()
    before, others = messages(log)
    after, same = messages(out)
    assert others == same
    original = read_log(log).series[PRISM]
    hit = np.isin(original.t_ns, told["stamps_ns"])
    assert 0 < hit.sum() == len(told["stamps_ns"]) < told["messages"] == len(before)
    untouched = {payload for (_, payload), bad in zip(before, hit, strict=True) if not bad}
    assert untouched <= {payload for _, payload in after}
    if kind not in ("shuffle", "duplicate"):
        assert not {payload for (_, payload), bad in zip(before, hit, strict=True) if bad} & {p for _, p in after}


def test_each_kind_does_what_it_says(log, tmp_path):
    def read(spec):
        out, told = corrupted(log, tmp_path, spec)
        series = read_log(out).series[PRISM]
        return series, np.isin(original.t_ns, told["stamps_ns"]), told

    original = read_log(log).series[PRISM]
    series, hit, _ = read("gross:share=0.3,size=2")
    assert hit.mean() == pytest.approx(0.3, abs=0.15)
    away = series["point"][hit] - series["point"][hit].mean(axis=0)
    assert np.linalg.norm(away, axis=1).max() < 0.02, "all of one other reflector"
    assert np.linalg.norm(series["point"][hit] - original["point"][hit], axis=1).min() > 1.0
    series, hit, _ = read("bias:size=0.1,start=4,end=6")
    assert_array_equal(hit, (original.t_ns - original.t_ns[0] >= 4e9) & (original.t_ns - original.t_ns[0] <= 6e9))
    np.testing.assert_allclose(np.linalg.norm(series["point"][hit] - original["point"][hit], axis=1), 0.1)
    series, hit, _ = read("frozen:start=4,end=6")
    assert not np.ptp(series["point"][hit], axis=0).any()
    series, hit, _ = read("gap:start=4,end=6")
    assert_array_equal(series.t_ns, original.t_ns[~hit])
    series, hit, _ = read("clock:start=4,end=20,step=0.5")
    assert_array_equal(series.t_ns, original.t_ns + 500_000_000 * hit)
    series, hit, _ = read("nan:bursts=2,length=3")
    assert series.counts.nonfinite == hit.sum() <= 6
    series, hit, _ = read("duplicate:share=0.2")
    assert series.counts.duplicate == hit.sum()
    series, hit, _ = read("shuffle:reach=4")
    assert series.counts.disordered > 0
    assert_array_equal(series["point"], original["point"])


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    """A log with clouds, some at one log time."""
    path = tmp_path_factory.mktemp("scanned") / "scanned.mcap"
    stamps = START_NS + 100_000_000 * np.arange(40)
    clouds = [(int(t), {"x": np.full(50, float(k), np.float32), "y": np.zeros(50), "z": np.zeros(50)})
              for k, t in enumerate(stamps)]  # fmt: skip
    source = Held("/points", stamps, "lidar", StreamCounts(received=40), tuple(clouds))
    imu = Series("/imu", "sensor_msgs/msg/Imu", stamps, {"gyro": np.zeros((40, 3)), "acc": np.ones((40, 3))})
    write_log(path, [imu], clouds=[source], log_ns={"/points": np.repeat(stamps[::2], 2)})
    return path


def numbers(path):
    """Stamps of the clouds in the log, and which they were before."""
    clouds = read_log(path).clouds["/points"]
    read = [(t, int(fields["x"][0])) for t, fields in clouds]
    assert [t for t, _ in read] == clouds.t_ns.tolist()
    return np.array(read).T, clouds.counts


def test_clouds_take_what_needs_no_more_than_stamps(scanned, tmp_path):
    (stamps, _), _ = numbers(scanned)
    for spec in ("gap:start=1,end=2", "clock:start=1,end=9,step=0.5", "duplicate:share=0.3", "shuffle:reach=6"):
        out, told = corrupted(scanned, tmp_path, f"{spec.partition(':')[0]}:topic=/points,{spec.partition(':')[2]}")
        hit = np.isin(stamps, told["stamps_ns"])
        (found, which), counts = numbers(out)
        kind, kept = told["kind"], np.flatnonzero(~hit) if told["kind"] == "gap" else np.arange(40)
        assert 0 < hit.sum() < 40
        assert_array_equal(which, kept)
        assert_array_equal(found, stamps[kept] + (500_000_000 * hit if kind == "clock" else 0))
        assert counts.duplicate == (hit.sum() if kind == "duplicate" else 0)
        assert (counts.disordered > 0) == (kind == "shuffle")
        assert messages(out, "/points")[1] == messages(scanned, "/points")[1]


def test_clouds_have_no_values_to_change(scanned, tmp_path):
    with pytest.raises(LogError, match=r"clouds have no values that bias could change; give gap, clock"):
        corrupted(scanned, tmp_path, "bias:topic=/points")


def test_scans_corrupted_at_random_end_in_a_sound_result_or_in_one_line():
    [ended] = corrupt.run(corrupt.Job("tbm-roadway", 1, 6.0, ("ins",), {"imu_rate_hz": 100.0}))
    assert ended.outcome in ("ended", "refused"), ended.said


def test_several_faults_on_several_topics(log, tmp_path, capsys):
    out = tmp_path / "both.mcap"
    specs = ["--fault", "gap:start=4,end=6", "--fault", f"bias:topic={ODOMETER},size=0.2", "--fault", "nan"]
    assert main(["corrupt", str(log), "-o", str(out), "--seed", "3", *specs]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(",")[0] for line in lines] == [f"{PRISM}: gap", f"{ODOMETER}: bias", f"{PRISM}: nan"]
    told = json.loads(read_log(out).attachments["faults.json"])["faults"]
    assert told[2]["messages"] == told[0]["messages"] - len(told[0]["stamps_ns"])
    assert "rig.yaml" in read_log(out).attachments


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("fire", "no such kind; there are gross, bias"),
        ("gross:share=much", "share should be a number"),
        ("gross:step=1", "no key step; there are topic, start, end, share, size"),
        ("gap:topic=/none", "no topic /none to make wrong; there are /imu/mag, "),
    ],
)
def test_a_wrong_fault_is_one_line(log, tmp_path, capsys, spec, message):
    assert main(["corrupt", str(log), "-o", str(tmp_path / "x.mcap"), "--fault", spec]) == 1
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
    assert not list(tmp_path.iterdir())


# ---- what the estimators make of it ----

# Of a fault in up to a tenth of the fixes batch may lose a tenth of its accuracy, in up to a third a half. Who knows
# the past alone may follow a sensor that is wrong for long, and then errs by as much as it: by 0.1 m, by half a second
# at 0.1 m/s, or by three seconds at 0.1 m/s.
LOSSES = ((0.15, 1.1), (0.4, 1.5))  # share of the fixes, drawn as 0.1 and 0.3 of 80, and times the error without
GATED = "beyond the gate"
MATRIX = [
    ("gross:share=0.1", GATED, 0.0),
    ("gross:share=0.3", GATED, 0.0),
    ("bias:size=0.1,start=6,end=9", GATED, 0.1),
    ("frozen:start=6,end=9", GATED, 0.3),
    ("gap:start=6,end=9", "gaps: 1, ", 0.0),
    ("clock:start=6,end=9", GATED, 0.05),
    ("nan", "hold a NaN or infinity", 0.0),
    ("duplicate", "repeat a stamp", 0.0),
    ("shuffle", "sorted by stamp", 0.0),
]
# the longest faults last until 9 s, and a filter that has followed one takes ten fixes, two seconds, to doubt itself
EPOCHS_S = (11.6, 13.0, 15.9)
ALPHA = 0.01 / (len(EPOCHS_S) * 21)  # the risk of one false alarm is shared by all faults of prism and IMU
# sds from which a fix is surely beyond the gate: its square root, and 99.9 % of the fix's own noise and of what it is
# held against, another fix
SURELY = np.sqrt(chi2.ppf(0.999, 3)) + 2 * norm.ppf(0.999)


def estimated(path, names):
    """Result and summary by estimator; counts add up, everything is finite."""
    session = pipeline.open_session(str(path))
    for name in names:
        result, summary = session.estimate(name)
        for count in summary["sensors"].values():
            assert count["received"] == sum(value for part, value in count.items() if part != "received")
        for path_ in (result.trajectory, result.smoothed or result.trajectory):
            assert np.isfinite(path_.position_n).all()
            assert np.isfinite(path_.cov).all()
        yield name, result, summary


def covered(result):
    """Whether the errors of the pose at the epochs agree with the covariance."""
    path = result.trajectory
    errors = trajectory_errors(path, true_states(drive(5, SECONDS), path.t_ns))
    at = [np.argmin(np.abs((path.t_ns - path.t_ns[0]) * 1e-9 - epoch)) for epoch in EPOCHS_S]
    return bool((errors.nees[at] < chi2.ppf(1 - ALPHA, 6)).all())


@pytest.fixture(scope="module")
def clean_m(log):
    """Position error of each estimator without a fault."""
    return {name: summary["metrics"]["position_rms_m"] for name, _, summary in estimated(log, ESTIMATORS)}


def surely_wrong(log, path, told):
    """How many of the fixes told of lie that far from where the track had them at their stamp."""
    original, series = read_log(log).series[PRISM], read_log(path).series[PRISM]
    t = (series.t_ns - original.t_ns[0]) * 1e-9
    known = (original.t_ns - original.t_ns[0]) * 1e-9
    track = np.stack([np.interp(t, known, original["point"][:, axis]) for axis in range(3)], axis=1)
    sigma = pipeline.open_session(str(log)).prepared.rig.sensors["prism"].sigma_at(track)
    return int((np.linalg.norm(series["point"] - track, axis=1) > SURELY * sigma).sum())


@pytest.mark.parametrize(("spec", "words", "followed_m"), MATRIX)
def test_a_prism_that_fails(log, tmp_path, clean_m, spec, words, followed_m):
    path, told = corrupted(log, tmp_path, spec)
    hit, total = len(told["stamps_ns"]), told["messages"]
    loss = next(times for share, times in LOSSES if hit <= share * total or told["kind"] in ("duplicate", "shuffle"))
    wrong = surely_wrong(log, path, told) if words is GATED else 0
    for name, result, summary in estimated(path, ESTIMATORS):
        allowed = loss * clean_m[name] + (0.0 if name == "batch" else followed_m)
        assert summary["metrics"]["position_rms_m"] < allowed, name
        if name == "ins":
            assert covered(result)
        counts = summary["sensors"]["prism"]
        if words is GATED:
            assert counts["gated"] >= (wrong if followed_m == 0.0 or name == "batch" else min(wrong, REOPEN)), name
        if name == "batch" or not followed_m:  # of the sound ones at most one in a hundred; of fewer than that, one
            assert counts["gated"] <= (hit if words is GATED else 0) + max(0.01 * (total - hit), 1.0), name
        if words in ("hold a NaN or infinity", "repeat a stamp"):
            assert hit in (counts["nonfinite"], counts["duplicate"])
        said = [line for line in summary["warnings"] if line.startswith("prism: ")]
        if words is GATED:
            [line] = [line for line in said if "rows gated, where chance gates" in line]
            assert f"{result.innovations['prism'].gated.sum()} of {total} rows gated" in line
        else:
            [line] = [line for line in said if words in line]
        at_s = float(re.search(r"at (-?[\d.]+) s", line).group(1))
        stamps_s = (np.array(told["stamps_ns"]) - result.trajectory.t_ns[0]) * 1e-9
        assert stamps_s.min() - 1.0 < at_s < stamps_s.max() + 1.0


WORDS = {"gap": "gaps: ", "nan": "hold a NaN or infinity", "duplicate": "repeat a stamp", "shuffle": "sorted by stamp"}


@pytest.mark.parametrize(("topic", "sensor"), [(ODOMETER, "odometer"), (MAGNETOMETER, "magnetometer"), (IMU, "imu")])
@pytest.mark.parametrize("kind", faults.KINDS)
def test_every_fault_of_every_sensor_is_said(log, clean_warnings, tmp_path, kind, topic, sensor):
    """In a line with numbers that names the sensor, and that the clean log does not get."""
    path, _ = corrupted(log, tmp_path, f"{kind}:topic={topic}")
    said = pipeline.open_session(str(path)).prepared.warnings
    if kind not in WORDS:
        [(_, _, summary)] = estimated(path, ("batch",))
        said = summary["warnings"]
    lines = [line for line in said if line.startswith(f"{sensor}: ") and line not in clean_warnings]
    assert any(WORDS.get(kind, "") in line and re.search(r"\d s\b", line) for line in lines), said


@pytest.fixture(scope="module")
def clean_warnings(log):
    [(_, _, summary)] = estimated(log, ("batch",))
    return summary["warnings"]


@pytest.fixture(scope="module")
def allowed(log):
    """Largest position error [m] and attitude error [deg] by estimator that a lost second of IMU may leave.

    Meanwhile fixes tell the position five times a second, and an error of that kind lasts to the end as one of the arm
    does: it has three degrees of freedom, the variance of the clean log and that of a fix, and 99.9 % below."""
    prepared = pipeline.open_session(str(log)).prepared
    fix = 3.0 * np.mean(prepared.rig.sensors["prism"].sigma_at(prepared.samples["prism"].values) ** 2)
    times, found = np.sqrt(chi2.ppf(0.999, 3) / 3), {}
    for name, result, _ in estimated(log, ("batch", "ins")):
        said = np.einsum("kii->ki", result.trajectory.cov)
        position, attitude = (np.mean(np.sum(said[:, part], axis=1)) for part in (POS, ROT))
        found[name] = times * np.sqrt(position + fix), times * np.degrees(np.sqrt(attitude))
    return found


IMU_MATRIX = [
    ("gap:start=6,end=7", "gaps: 1"),
    ("frozen:start=6,end=7", "hangs on one reading"),
    ("clock:start=6,end=7", "gaps: 1"),
    ("nan:bursts=3,length=20", "gaps: "),
    ("duplicate", None),
    ("shuffle", None),
]


@pytest.mark.parametrize(("spec", "words"), IMU_MATRIX)
def test_an_imu_that_fails(log, tmp_path, allowed, spec, words):
    kind, _, rest = spec.partition(":")
    path, _ = corrupted(log, tmp_path, f"{kind}:topic={IMU}" + f",{rest}" * bool(rest))
    for name, result, summary in estimated(path, ("batch", "ins")):
        assert summary["metrics"]["position_rms_m"] < allowed[name][0], name
        assert summary["metrics"]["attitude_rms_deg"] < allowed[name][1], name
        assert covered(result), name
        assert words is None or any(line.startswith("imu: ") and words in line for line in summary["warnings"]), name


@pytest.mark.parametrize("seed", range(30))
def test_a_log_corrupted_at_random_ends_in_a_sound_result_or_in_one_line(seed):
    """As ``python -m benchmarks accuracy --corrupt`` does, each log by one estimator."""
    job = corrupt.Job("tbm-drive", seed, 10.0, (ESTIMATORS[seed % 2],), {"imu_rate_hz": 100.0})
    [ended] = corrupt.run(job)
    assert ended.outcome in ("ended", "refused"), ended.said


def test_what_is_unsound_is_found(log, tmp_path):
    outcome, _ = corrupt.attempt(log, "ins", tmp_path / "out")
    assert (outcome, corrupt.unsound(tmp_path / "out")) == ("ended", None)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    for change, fault in (
        ({"metrics": {**summary["metrics"], "ape_rms_m": None}}, "summary.json: metrics.ape_rms_m"),
        ({"sensors": {"prism": {"received": 2, "used": 1}}}, "summary.json: the counts of prism do not add up"),
    ):
        (tmp_path / "out" / "summary.json").write_text(json.dumps({**summary, **change}))
        assert corrupt.unsound(tmp_path / "out") == fault
    with np.load(tmp_path / "out" / "result.npz") as arrays:
        broken = {name: values.copy() for name, values in arrays.items()}
    broken["velocity_n"][3, 1] = np.nan
    np.savez(tmp_path / "out" / "result.npz", **broken)
    assert corrupt.unsound(tmp_path / "out") == "result.npz: velocity_n"


def test_a_hang_and_a_crash_are_told_apart(log, tmp_path, monkeypatch):
    def spin(*_, **__):
        while True:
            pass

    monkeypatch.setattr(corrupt, "LIMIT_S", 0.05)
    monkeypatch.setattr(pipeline, "run_result", spin)
    assert corrupt.attempt(log, "ins", tmp_path / "out")[0] == "hung"
    monkeypatch.setattr(pipeline, "run_result", lambda *_, **__: 1 / 0)
    assert corrupt.attempt(log, "ins", tmp_path / "out") == ("crashed", "ZeroDivisionError: division by zero")
