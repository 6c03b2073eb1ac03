"""Command line and pipeline: exit codes, one-line errors, options as given, and nothing drawn in a pipe."""

import io
import json
import os
import re
import shlex
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.main import get_command
from typer.testing import CliRunner

from tbmfg import cli, pipeline
from tbmfg.cli import options, terminal
from tbmfg.cli.terminal import Level, Terminal
from tbmfg.errors import EstimationError, LogError, TbmfgError, reason
from tbmfg.rig import parse_rig
from tbmfg.state import Calibrated, Counts, Result, Trajectory
from tbmfg.timeseries import Log, Series

EPOCH_NS = 1_700_000_000_000_000_000
RIG = """name: toy
origin: {latitude_deg: 47}
sensors: {imu: {topic: /imu}, prism: {topic: /prism}, odometer: {topic: /odometry}}
"""
ROOT = Path(__file__).parent.parent


def poses(n: int = 50, shift: float = 0.0) -> Trajectory:
    s = np.linspace(0.0, 1.0, n)[:, None]
    return Trajectory(
        t_ns=EPOCH_NS + np.arange(n) * 200_000_000,
        position_n=np.hstack([10 * s + shift, 3 * s**2, np.sin(s)]),
        quat_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
        velocity_n=np.zeros((n, 3)),
        bias_acc=np.zeros((n, 3)),
        bias_gyro=np.zeros((n, 3)),
        cov=np.tile(np.eye(15), (n, 1, 1)),
    )


def sure(sd: float) -> Trajectory:
    """The poses with position and rotation known to ``sd`` in each axis, m and rad."""
    return replace(poses(), cov=np.tile(sd**2 * np.eye(15), (50, 1, 1)))


def toy_log() -> Log:
    true = poses()
    columns = {"position": true.position_n, "quat_xyzw": true.quat_xyzw}
    truth = Series("/truth", "geometry_msgs/msg/PoseStamped", true.t_ns, columns)
    return Log("toy.mcap", {"/truth": truth}, attachments={"rig.yaml": RIG.encode()})


def toy_estimate(name, prepared, *, progress=None) -> Result:
    if progress:
        progress("solving", 1.0)
    return Result(
        name,
        poses(shift=0.5),
        smoothed=poses() if name == "fixed-lag" else None,
        calibration={
            "prism_lever_arm_m": Calibrated((0.1, 0.2, 0.3), (0.001, 0.002, 0.003), True, (True, True, False)),
            "noise_factor": Calibrated(2.0, 0.0, False),
        },
        counts={"prism": Counts(received=50, used=48, gated=2)},
        warnings=["odometer: not estimated"],
    )


@pytest.fixture
def toy(monkeypatch):
    """The stages replaced by fakes; the calls that reach them are recorded."""
    calls = SimpleNamespace(prepare=[], parts=[], logs={"toy.mcap": toy_log()})

    def read_log(path, *, progress=None, **part):
        calls.parts.append(part)
        if str(path) not in calls.logs:
            raise LogError(f"{path}: no such file")
        return calls.logs[str(path)]

    def prepare(log, rig, *, outages=(), without=(), progress=None):
        calls.prepare.append({"rig": rig, "outages": outages, "without": without, "progress": progress})
        return SimpleNamespace(t0_ns=EPOCH_NS, rig=rig, samples={}, warnings=["imu: 3 samples lost"])

    entry = SimpleNamespace(summary="Smoother.", needs=("imu", "prism"), source="tbmfg", whole=False)
    names = {"batch": SimpleNamespace(**{**vars(entry), "whole": True}), "fixed-lag": entry}
    fakes = SimpleNamespace(ESTIMATORS=names, estimate=lambda *args, **options: calls.estimate(*args, **options))
    calls.estimate = toy_estimate
    fakes.check_switches = lambda rig: None
    fakes.unmet = lambda name, prepared: None
    calls.bounds = lambda prepared, truth: SimpleNamespace(smoothing=sure(0.1), filtering=sure(0.4))
    bounds = SimpleNamespace(cramer_rao=lambda *args: calls.bounds(*args))
    monkeypatch.setitem(sys.modules, "tbmfg.estimators", fakes)
    monkeypatch.setitem(sys.modules, "tbmfg.bounds", bounds)
    monkeypatch.setitem(sys.modules, "tbmfg.prepare", SimpleNamespace(prepare=prepare))
    monkeypatch.setattr("tbmfg.mcap.read_log", read_log)
    monkeypatch.setattr("tbmfg.mcap.read_attachments", lambda path: read_log(path).attachments)
    return calls


def tbmfg(*arguments: str):
    return CliRunner().invoke(cli.app, list(arguments), prog_name="tbmfg")


# ---- running ----


def test_run_writes_and_prints(toy, tmp_path):
    ran = tbmfg("run", "toy.mcap", "-o", str(tmp_path / "out"))
    assert ran.exit_code == 0, ran.output
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    design = "tbmfg_version log estimator keyframes duration_s wall_s realtime_factor peak_rss_mb calibration sensors"
    assert [key for key in summary if key in design.split()] == design.split()
    assert summary["warnings"] == ["imu: 3 samples lost", "odometer: not estimated"]
    assert summary["truth"] == "/truth"
    assert summary["metrics"]["position_rms_m"] == pytest.approx(0.5)
    assert summary["metrics"]["ape_rms_m"] == pytest.approx(0.0, abs=1e-9)
    assert "metrics_smoothed" not in summary
    for shown in (
        "50 keyframes over 9.8 s",
        "prism_lever_arm_m",
        "0.1 0.2 0.3",
        "yes yes no",
        "gated",
        "position_rms_m",
        "/truth",
    ):
        assert shown in ran.stdout
    assert "warning: odometer: not estimated" in ran.stdout
    assert f"results: {tmp_path / 'out'}" in ran.stdout
    assert parse_rig((tmp_path / "out" / "rig.yaml").read_text(), "rig.yaml").name == "toy"


def test_a_report_is_written_where_it_is_asked_for(toy, tmp_path):
    assert tbmfg("run", "toy.mcap", "-o", str(tmp_path / "plain")).exit_code == 0
    assert not (tmp_path / "plain" / "report.html").exists()
    assert tbmfg("run", "toy.mcap", "-o", str(tmp_path / "told"), "--report").exit_code == 0
    assert "Errors against the truth" in (tmp_path / "told" / "report.html").read_text("utf-8")
    ran = tbmfg("compare", "toy.mcap", "-o", str(tmp_path), "--estimators", "batch,fixed-lag")
    assert f"to read: {tmp_path / 'report.html'}" in ran.stdout
    assert re.search(r"told by the log +batch +fixed-lag *\nprism_lever_arm_m +yes yes no +yes yes no", ran.stdout)
    report = (tmp_path / "report.html").read_text("utf-8")
    assert all(label in report for label in ("batch", "fixed-lag (causal)", "fixed-lag (last)"))
    (tmp_path / "compare.json").unlink()
    assert "report.html: exists already" in fault("compare", "toy.mcap", "-o", str(tmp_path), "--estimators", "batch")


def test_smoothed_trajectories_have_their_own_metrics(toy, tmp_path):
    assert tbmfg("run", "toy.mcap", "-o", str(tmp_path), "--estimator", "fixed-lag").exit_code == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["metrics_smoothed"]["position_rms_m"] == 0.0
    assert (tmp_path / "smoothed.tum").exists()


def test_compare_holds_errors_to_the_bound_of_the_past_or_of_the_whole_log(toy, tmp_path):
    ran = tbmfg("compare", "toy.mcap", "-o", str(tmp_path), "--estimators", "batch,fixed-lag")
    assert ran.exit_code == 0, ran.output
    compared = json.loads((tmp_path / "compare.json").read_text())
    # the toy is 0.5 m off; three axes of 0.1 and of 0.4 m
    for metrics, bound in ((compared["batch"]["metrics"], 0.1), (compared["fixed-lag"]["metrics"], 0.4)):
        assert metrics["bound_position_rms_m"] == pytest.approx(np.sqrt(3) * bound)
        assert metrics["position_over_bound"] == pytest.approx(0.5 / np.sqrt(3) / bound)
        assert metrics["attitude_over_bound"] == pytest.approx(0.0)
        assert "velocity_over_bound" not in metrics, "the truth has no velocity"
    last = compared["fixed-lag"]["metrics_smoothed"]
    assert last["bound_position_rms_m"] == pytest.approx(np.sqrt(3) * 0.1)
    assert "position / bound" in ran.stdout
    assert "bound: Cramer-Rao" in ran.stdout
    assert "2.89" in (tmp_path / "report.html").read_text("utf-8")


def test_a_bound_that_cannot_be_made_is_said_and_stops_nobody(toy, tmp_path):
    asked = []

    def fails(*args):
        asked.append(args)
        raise EstimationError("the Cramer-Rao bound broke down")

    toy.bounds = fails
    ran = tbmfg("compare", "toy.mcap", "-o", str(tmp_path), "--estimators", "batch,fixed-lag")
    assert ran.exit_code == 0, ran.output
    assert len(asked) == 1
    assert "warning: errors are not compared with their bound: the Cramer-Rao bound broke down" in ran.stdout
    assert "bound_position_rms_m" not in json.loads((tmp_path / "compare.json").read_text())["batch"]["metrics"]


def test_options_reach_the_stages(toy, tmp_path):
    ran = tbmfg(
        *("run", "toy.mcap", "-o", str(tmp_path), "--truth", "none"),
        *("--outage", "prism:2:4.5", "--outage", "prism:6:7", "--without", "odometer"),
        *("--set", "sensors.prism.sigma_mm=7", "--set", "lag_s=3", "--start", "1.5", "--end", "60"),
    )
    assert ran.exit_code == 0, ran.output
    (call,) = toy.prepare
    assert call["outages"] == (("prism", 2.0, 4.5), ("prism", 6.0, 7.0))
    assert call["without"] == ("odometer",)
    read = toy.parts[-1]
    assert (read["start_s"], read["end_s"]) == (1.5, 60.0)
    assert [topic for topic in ("/imu", "/prism", "/camera", "/truth") if read["topics"](topic)] == ["/imu", "/prism"]
    assert call["rig"].sensors["prism"].sigma_mm == 7
    assert call["rig"].lag_s == 3
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["options"]["set"] == ["sensors.prism.sigma_mm=7", "lag_s=3"]
    assert summary["metrics"] is None


def test_what_the_rig_leaves_open_is_said_apart_from_warnings(toy, tmp_path):
    open_ended = ("--set", "origin.latitude_deg=null", "--set", "initial.yaw_deg=30")
    for number, command in enumerate(("run", "compare")):
        estimators = ("--estimators", "batch,fixed-lag") if command == "compare" else ()
        ran = tbmfg(command, "toy.mcap", "-o", str(tmp_path / str(number)), *open_ended, *estimators)
        lines = ran.stdout.splitlines()
        assert lines.count("assumed origin.latitude_deg: not given: no Earth rate, gravity 9.80665 m/s^2") == 1
        assert lines.count("assumed initial.yaw_deg: 30 counts for nothing, as yaw_sd_deg is 180") == 1
        assert lines.count("warning: imu: 3 samples lost") == 1


def test_only_keeps_the_imu(toy, tmp_path):
    assert tbmfg("run", "toy.mcap", "-o", str(tmp_path), "--only", "prism").exit_code == 0
    assert toy.prepare[0]["without"] == ("odometer",)


def test_outages_are_seconds_from_the_first_imu_sample(toy, monkeypatch):
    toy.estimate = lambda name, prepared, *, progress=None: Result(name, half_shifted)
    half_shifted = poses()
    half_shifted.position_n[25:, 0] += 2.0  # from 5.0 s on
    summary = pipeline.run("toy.mcap", outages=[("prism", 4.0, 5.9)])
    assert summary["metrics"]["outage_position_rms_m"] == pytest.approx(2.0 * np.sqrt(5 / 10))


def test_python_users_get_the_summary_without_files(toy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert pipeline.run("toy.mcap", rig=parse_rig(RIG, "here"))["keyframes"] == 50
    assert list(tmp_path.iterdir()) == []


def test_a_pipe_gets_no_progress(toy, tmp_path):
    ran = tbmfg("run", "toy.mcap", "-o", str(tmp_path))
    assert toy.prepare[0]["progress"] is None
    assert ran.stderr == ""


def test_estimators_lists_names_needs_and_source(toy):
    ran = tbmfg("estimators")
    assert ran.exit_code == 0
    assert all(word in ran.stdout for word in ("batch", "fixed-lag", "imu, prism", "Smoother."))


# ---- how much is said ----


def test_quiet_says_nothing_and_json_nothing_else(toy, tmp_path):
    quiet = tbmfg("run", "toy.mcap", "-o", str(tmp_path / "quiet"), "--quiet")
    assert (quiet.exit_code, quiet.output) == (0, "")
    for arguments, file in (
        (["run", "toy.mcap", "-o", str(tmp_path / "run")], "summary.json"),
        (["compare", "toy.mcap", "-o", str(tmp_path / "both"), "--estimators", "batch,fixed-lag"], "compare.json"),
    ):
        told = tbmfg(*arguments, "--json")
        assert told.stderr == ""
        assert json.loads(told.stdout) == json.loads((Path(arguments[3]) / file).read_text())
    assert list(json.loads(tbmfg("estimators", "--json").stdout)) == ["batch", "fixed-lag"]
    assert "absent.mcap: no such file" in fault("run", "absent.mcap", "-o", str(tmp_path / "no"), "--json")
    assert "absent.mcap: no such file" in fault("run", "absent.mcap", "-o", str(tmp_path / "no"), "--quiet")


def test_levels_say_the_stages(toy, tmp_path):
    ran = tbmfg("run", "toy.mcap", "-o", str(tmp_path), "--log-level", "info")
    assert [line.split(":")[1] for line in ran.stderr.splitlines()] == [" reading", " solving"]
    assert tbmfg("run", "toy.mcap", "-o", str(tmp_path), "--quiet", "--debug").exit_code == 2


def test_the_bar_shows_stage_and_what_remains(monkeypatch):
    drawn = io.StringIO()
    drawn.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", drawn)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("NO_COLOR", raising=False)
    for colour in (True, False):
        drawn.seek(0)
        drawn.truncate()
        with Terminal().progress("reading") as progress:
            for share in (0.2, 0.4, 0.6):
                progress("solving", share)
                time.sleep(0.11)  # the bar is drawn ten times a second
        assert "solving" in drawn.getvalue()
        assert "left" in drawn.getvalue()
        assert bool(re.search(r"\x1b\[[\d;]*3\dm", drawn.getvalue())) is colour
        monkeypatch.setenv("NO_COLOR", "1")


def test_the_first_run_says_what_it_waits_for(monkeypatch, tmp_path):
    screen = io.StringIO()
    screen.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for level, said in ((Level.error, False), (Level.warning, True)):
        with Terminal(level).progress("reading"):
            pass
        assert ("first run here" in screen.getvalue()) is said
    (tmp_path / "kalman.predict.nbi").touch()
    screen.truncate(0)
    with Terminal().progress("reading"):
        pass
    assert "first run" not in screen.getvalue()


def test_colour_is_for_terminals(monkeypatch):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert terminal.coloured("x", "red", SimpleNamespace(isatty=lambda: False)) == "x"
    screen = SimpleNamespace(isatty=lambda: True)
    assert terminal.coloured("x", "red", screen) != "x"
    monkeypatch.setenv("NO_COLOR", "1")
    assert terminal.coloured("x", "red", screen) == "x"


@pytest.mark.parametrize("name", [command.name for command in cli.app.registered_commands])
def test_every_command_has_examples_that_parse(name):
    """And none of them names a file that an example before it has made."""
    commands = get_command(cli.app).commands
    told = tbmfg(name, "--help").stdout
    examples = told.split("Examples:\n")[1].split("\n\n")[0].splitlines()
    for example in examples:
        program, other, *words = shlex.split(re.split(r" {3,}|\|| > ", example.strip())[0])
        assert program == "tbmfg"
        commands[other].make_context(other, words)
    assert any(example.split()[1] == name for example in examples)


def test_completion_knows_estimators_and_rigs():
    assert "ins" in options.estimator_names("i")
    assert "batch,ins" in options.estimator_names("batch,i")
    assert options.rig_names("tb") == ["tbm"]
    shown = subprocess.run(
        [sys.executable, "-m", "tbmfg", "--show-completion", "bash"], capture_output=True, text=True, cwd=ROOT
    )
    assert "_TBMFG_COMPLETE" in shown.stdout


# ---- faults ----


def fault(*arguments: str) -> str:
    """The message of a run that fails with exit code 1, in one line on stderr and nothing on stdout."""
    ran = tbmfg(*arguments)
    assert ran.exit_code == 1, ran.output
    assert ran.stdout == ""
    assert ran.stderr.count("\n") == 1
    return ran.stderr


def test_faults_of_the_input_take_one_line(toy, tmp_path):
    out = str(tmp_path / "out")
    assert "absent.mcap: no such file" in fault("run", "absent.mcap", "-o", out)
    assert "neither a file nor a shipped rig" in fault("run", "toy.mcap", "-o", out, "--rig", "nonsense")
    assert "the rig toy has no such sensor" in fault("run", "toy.mcap", "-o", out, "--without", "prisma")
    assert "every estimator needs the IMU" in fault("run", "toy.mcap", "-o", out, "--without", "imu")
    assert "--only gnss" in fault("run", "toy.mcap", "-o", out, "--only", "prism,gnss")
    assert "sigma" in fault("run", "toy.mcap", "-o", out, "--set", "sensors.prism.sigma=7")
    assert "--truth /nope" in fault("run", "toy.mcap", "-o", out, "--truth", "/nope")
    assert not (tmp_path / "out").exists()


def test_a_log_without_rig_and_imu_is_refused(toy, tmp_path):
    toy.logs["bare.mcap"] = Log("bare.mcap", {})
    assert "bare.mcap: no sensor_msgs/Imu to estimate from" in fault("run", "bare.mcap", "-o", str(tmp_path / "out"))


def test_existing_results_are_refused_before_any_work(toy, tmp_path):
    assert tbmfg("run", "toy.mcap", "-o", str(tmp_path)).exit_code == 0
    assert "--force" in fault("run", "toy.mcap", "-o", str(tmp_path))
    assert len(toy.prepare) == 1
    assert tbmfg("run", "toy.mcap", "-o", str(tmp_path), "--force").exit_code == 0


def test_the_unexpected_takes_one_line_and_debug_shows_it(toy, tmp_path):
    def broken(*args, **options):
        raise ZeroDivisionError("first line\nsecond line")

    toy.estimate = broken
    line = fault("run", "toy.mcap", "-o", str(tmp_path))
    assert "internal error: ZeroDivisionError: first line second line; rerun with --debug" in line
    ran = tbmfg("run", "toy.mcap", "-o", str(tmp_path), "--debug")
    assert ran.exit_code == 1
    assert "Traceback" in ran.stderr


def test_a_file_that_is_not_there_is_named(toy, tmp_path):
    ran = tbmfg("batch", str(tmp_path / "absent.mcap"), "-o", str(tmp_path / "out"), "--jobs", "1")
    assert ran.exit_code == 1
    assert (
        f"failed: {tmp_path}/absent.mcap: {tmp_path}/absent.mcap: no such file or directory; check the name"
        in ran.stdout
    )
    assert reason(OSError(28, "No space left on device", "out/x")) == "out/x: no space left on device"


def test_a_map_without_a_result_says_what_makes_one():
    said = fault("map", "toy.mcap", "--trajectory", "x", "-o", "m.ply")
    assert "x: holds no result; make one: tbmfg run toy.mcap -o x" in said


def test_warnings_name_the_estimators_that_give_them(toy, tmp_path):
    plain = toy_estimate

    def estimate(name, prepared, *, progress=None):
        result = plain(name, prepared)
        result.warnings.append(f"of {name}")
        return result

    toy.estimate = estimate
    said = tbmfg("compare", "toy.mcap", "-o", str(tmp_path), "--estimators", "batch,fixed-lag").stdout.splitlines()
    assert "warning: odometer: not estimated" in said
    assert "warning: batch: of batch" in said
    assert "warning: fixed-lag: of fixed-lag" in said


def test_an_unknown_estimator_is_an_error_in_python_too(toy):
    with pytest.raises(TbmfgError, match="there are batch, fixed-lag"):
        pipeline.run("toy.mcap", estimator="nope")


# ---- usage ----


@pytest.mark.parametrize(
    "wrong",
    [
        ["--outage", "prism:4:2"],
        ["--start", "-1"],
        ["--start", "5", "--end", "5"],
        ["--outage", "prism:1"],
        ["--outage", "1:2"],
        ["--outage", "prism:a:b"],
        ["--outage", "prism:1:nan"],
        ["--set", "lag_s"],
        ["--set", "=3"],
        ["--estimator", "nope"],
        ["--nonsense"],
        ["second.mcap"],
    ],
)
def test_wrong_usage_is_exit_code_2(toy, tmp_path, wrong):
    ran = tbmfg("run", "toy.mcap", "-o", str(tmp_path / "out"), *wrong)
    assert ran.exit_code == 2
    assert "Traceback" not in ran.output
    assert toy.prepare == []


@pytest.mark.parametrize("arguments", [[], ["run"], ["run", "toy.mcap"], ["nonsense"], ["info"]])
def test_missing_arguments_are_exit_code_2(arguments):
    assert tbmfg(*arguments).exit_code == 2


def test_an_outage_names_sensor_and_seconds():
    assert options.parse_outage("prism-left:-1.5:2e1") == ("prism-left", -1.5, 20.0)


# ---- as a process ----


def process(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-m", "tbmfg", *arguments], capture_output=True, text=True, cwd=ROOT)


def test_help_answers_at_once():
    """It imports nothing heavy; half a second is what a user takes for at once."""
    listed = "import sys, tbmfg.cli; print([m for m in ('numpy', 'scipy', 'gtsam', 'pydantic') if m in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", listed], capture_output=True, text=True, cwd=ROOT, check=True)
    assert ran.stdout.strip() == "[]"
    taken = []
    for _ in range(3):
        before = os.times()
        ran = process("--help")
        after = os.times()
        taken.append(after.children_user - before.children_user + after.children_system - before.children_system)
    assert ran.returncode == 0
    assert "run" in ran.stdout
    assert min(taken) < 0.5  # of the processor, which others may be busy with


def test_version_and_exit_codes_of_the_process(tmp_path):
    assert process("--version").stdout.startswith("tbmfg ")
    assert process("run").returncode == 2
    ran = process("info", str(tmp_path / "absent.mcap"))
    assert ran.returncode == 1
    assert ran.stderr.count("\n") == 1
    assert "absent.mcap" in ran.stderr
