"""Many logs: which are found and how they are called, what is kept, what fails, and where it runs."""

import csv
import json
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from datasets.__main__ import main as make_dataset
from tbmfg import batch, cli, storage, workers
from tbmfg.errors import RigError, TbmfgError
from tbmfg.results import read_tum

SHORT = ["--duration", "6", "--set", "imu_rate_hz=50"]


def here() -> nullcontext:
    """Workers in this process: nothing is loaded anew, and memory:// is the same for all."""
    return nullcontext(workers.Workers(lambda: ThreadPoolExecutor(1), 1))


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Two short logs of the same name in different folders."""
    folder = tmp_path_factory.mktemp("logs")
    for seed, shift in enumerate(("day", "night")):
        (folder / shift).mkdir()
        assert make_dataset(["make", "tbm-drive", "-o", f"{folder}/{shift}/run.mcap", *SHORT, "--seed", f"{seed}"]) == 0
    return folder


@pytest.fixture
def logs(made, tmp_path) -> Path:
    return shutil.copytree(made, tmp_path / "logs")


def statuses(report: dict) -> dict[str, str]:
    return {log["name"]: log["status"] for log in report["logs"]}


# ---- which logs ----


def touched(*files: Path) -> None:
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()


def test_files_folders_and_patterns_name_logs_once(tmp_path):
    bag = tmp_path / "bag"
    touched(
        tmp_path / "a.mcap", tmp_path / "sub" / "b.mcap", tmp_path / "sub" / "notes.txt", tmp_path / ".x" / "c.mcap"
    )
    touched(
        bag / "metadata.yaml", bag / "bag_0.mcap", tmp_path / "old" / "summary.json", tmp_path / "old" / "result.mcap"
    )
    touched(tmp_path / "out" / "result.mcap")
    (tmp_path / "sub" / "loop").symlink_to(tmp_path)
    found = batch.find_logs([tmp_path, tmp_path / "a.mcap", bag, f"{tmp_path}/s*/*.mcap"], tmp_path / "out")
    assert found == [str(tmp_path / "a.mcap"), str(bag), str(tmp_path / "sub" / "b.mcap")]


def test_a_name_with_brackets_that_exists_is_no_pattern(tmp_path):
    touched(tmp_path / "run[1].mcap", tmp_path / "run1.mcap")
    assert batch.find_logs([tmp_path / "run[1].mcap"], tmp_path / "out") == [str(tmp_path / "run[1].mcap")]


@pytest.mark.parametrize("nothing", ["*.mcap", "."])
def test_an_argument_without_logs_is_refused(tmp_path, monkeypatch, nothing):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TbmfgError, match=r"no \.mcap file and no rosbag2 folder"):
        batch.find_logs([nothing], tmp_path / "out")


def test_names_take_as_many_folders_as_they_need():
    logs = ["/d/day/run.mcap", "/d/night/run.mcap", "/e/night/run.mcap", "/d/x.1.mcap", "/d/bag", "s3://b/day/RUN.mcap"]
    assert list(batch.named(logs)) == ["d-day-run", "d-night-run", "e-night-run", "x.1", "bag", "b-day-RUN"]
    alike = ["/a/b-c.mcap", "/a-b/c.mcap", "/a/b/c.mcap"]
    assert len(batch.named(alike)) == len(alike)


# ---- running ----


def test_a_failed_log_stops_nobody_and_finished_ones_are_kept(logs, tmp_path):
    (logs / "broken.mcap").write_bytes(b"nothing of the kind")
    out = tmp_path / "out"

    def again(**options) -> dict:
        return batch.run([logs], output=out, estimators=["ins"], on=here(), **options)

    report = again()
    assert statuses(report) == {"broken": "failed", "day-run": "done", "night-run": "done"}
    assert "not an MCAP file" in report["logs"][0]["reason"]
    assert json.loads((out / "batch.json").read_text()) == json.loads(json.dumps(report))
    rows = list(csv.DictReader((out / "batch.csv").open()))
    assert [row["status"] for row in rows] == ["failed", "done", "done"]
    assert float(rows[1]["ape_rms_m"]) == report["logs"][1]["results"][0]["ape_rms_m"] < 0.1
    before = (out / "day-run" / "trajectory.tum").stat().st_mtime_ns

    (out / "night-run" / "summary.json").unlink()  # as an interrupted run leaves it
    report = again()
    assert statuses(report) == {"broken": "failed", "day-run": "kept", "night-run": "failed"}
    assert "missing files" in report["logs"][2]["reason"]
    assert report["logs"][1]["results"][0]["keyframes"] > 10
    assert (out / "day-run" / "trajectory.tum").stat().st_mtime_ns == before
    assert statuses(again(force=True)) == {"broken": "failed", "day-run": "kept", "night-run": "done"}

    os.utime(logs / "day" / "run.mcap")
    report = again()
    assert statuses(report) == {"broken": "failed", "day-run": "failed", "night-run": "kept"}
    assert "results of other inputs (log)" in report["logs"][1]["reason"]
    report = again(overrides=["lag_s=3"])
    assert "results of other inputs (log, options)" in report["logs"][1]["reason"]
    assert "results of other inputs (options)" in report["logs"][2]["reason"]


def test_a_job_that_was_interrupted_is_done_again(logs, tmp_path, monkeypatch):
    job = batch.Job("run", str(logs / "day" / "run.mcap"), str(tmp_path / "out"), None, ("ins",))

    def killed(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(batch.pipeline, "run", killed)
        with pytest.raises(KeyboardInterrupt):
            batch.do(job)
    assert batch.do(job).status == "done"
    assert batch.do(job).status == "kept"


def test_results_of_somebody_else_are_not_replaced(logs, tmp_path):
    touched(tmp_path / "out" / "day-run" / "trajectory.tum")
    job = batch.Job("day-run", str(logs / "day" / "run.mcap"), str(tmp_path / "out" / "day-run"), None, ("ins",))
    outcome = batch.do(job)
    assert outcome.status == "failed"
    assert "already holds trajectory.tum" in outcome.reason


def test_a_worker_of_another_version_says_so(tmp_path):
    outcome = batch.do(batch.Job("x", "x.mcap", str(tmp_path / "x"), None, ("ins",), version="0.0.0"))
    assert "this worker has tbmfg" in outcome.reason


def test_a_wrong_rig_is_said_once_and_before_any_work(logs, tmp_path):
    with pytest.raises(RigError, match="sigma"):
        batch.run([logs], output=tmp_path / "out", rig="tbm", overrides=["sensors.prism.sigma=7"], on=here())
    assert not (tmp_path / "out").exists()


def test_several_estimators_have_a_folder_each(logs, tmp_path):
    report = batch.run([logs / "day"], output=tmp_path / "out", estimators=["ins", "batch"], on=here())
    assert [result["estimator"] for result in report["logs"][0]["results"]] == ["ins", "batch"]
    assert (tmp_path / "out" / "run" / "batch" / "trajectory.tum").exists()
    assert len(list(csv.DictReader((tmp_path / "out" / "batch.csv").open()))) == 2


@pytest.fixture(params=["memory", "s3"])
def store(request, monkeypatch) -> Iterator[str]:
    """A store's kind, with the buckets "fleet" and "results": in memory, or an S3 server on this machine."""
    if request.param == "memory":
        yield "memory"
        return
    moto = pytest.importorskip("moto.server", reason="moto is not installed: no S3-compatible server to ask")
    s3fs = pytest.importorskip("s3fs", reason="s3fs is not installed: s3:// cannot be opened")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "nobody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "nothing")
    s3fs.S3FileSystem.clear_instance_cache()
    for bucket in ("fleet", "results"):
        s3fs.S3FileSystem().mkdir(bucket)
    yield "s3"
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


def test_logs_and_results_at_urls(store, logs, tmp_path):
    for shift in ("day", "night"):
        at = storage.place(f"{store}://fleet/{shift}/run.mcap")
        at.parent.mkdir(parents=True, exist_ok=True)
        at.write_bytes((logs / shift / "run.mcap").read_bytes())

    def again(*arguments) -> dict:
        return batch.run(arguments, output=f"{store}://results", estimators=["ins"], on=here())

    assert statuses(again(f"{store}://fleet")) == {"day-run": "done", "night-run": "done"}
    assert statuses(again(f"{store}://fleet/*/run.mcap")) == {"day-run": "kept", "night-run": "kept"}
    batch.run([logs], output=(logs.parent / "local").as_uri(), estimators=["ins"], on=here())
    remote = storage.place(f"{store}://results/day-run")
    assert {file.name for file in remote.iterdir()} >= {"result.mcap", "result.npz", "summary.json", "job.json"}
    assert (remote / "trajectory.tum").read_bytes() == (logs.parent / "local/day-run/trajectory.tum").read_bytes()
    assert json.loads(storage.place(f"{store}://results/batch.json").read_text())["kept"] == 2
    storage.place(f"{store}://fleet/day/run.mcap").write_bytes((logs / "night" / "run.mcap").read_bytes())
    report = again(f"{store}://fleet")
    assert statuses(report) == {"day-run": "failed", "night-run": "kept"}
    assert "holds results of other inputs (log)" in report["logs"][0]["reason"]


def test_a_url_of_no_known_kind_is_said(tmp_path):
    with pytest.raises(TbmfgError, match=r"nowhere:// cannot be opened"):
        batch.run(["nowhere://a.mcap"], output=tmp_path)


# ---- as a command, and on workers elsewhere ----


def test_command_in_processes(logs, tmp_path):
    (logs / "broken.mcap").write_bytes(b"")
    arguments = ["batch", str(logs), "-o", str(tmp_path / "out"), "--estimator", "ins", "--jobs", "2"]
    ran = CliRunner().invoke(cli.app, arguments)
    assert ran.exit_code == 1, ran.output
    assert "[3/3]" in ran.stdout
    assert "2 done, 0 kept from before, 1 failed of 3 logs" in ran.stdout
    assert "broken.mcap: is empty (0 bytes)" in ran.stdout
    assert ran.stderr == ""
    (logs / "broken.mcap").unlink()
    ran = CliRunner().invoke(cli.app, [*arguments, "--jobs", "1"])
    assert ran.exit_code == 0, ran.output
    assert "0 done, 2 kept from before, 0 failed of 2 logs" in ran.stdout


def test_dask_gives_the_same_trajectory(logs, tmp_path):
    distributed = pytest.importorskip("distributed", reason="Dask is not installed: no scheduler to run on")
    log = logs / "day" / "run.mcap"
    batch.run([log], output=tmp_path / "here", estimators=["ins"], on=here())
    with distributed.LocalCluster(1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        report = batch.run([log], output=tmp_path / "there", estimators=["ins"], scheduler=address)
    assert statuses(report) == {"run": "done"}
    one, other = (tmp_path / place / "run" / "trajectory.tum" for place in ("here", "there"))
    assert one.read_bytes() == other.read_bytes()
    assert np.isfinite(read_tum(other).position_n).all()
