"""Jobs in processes: in parallel, with one native thread each, and again where a worker died."""

import os
import signal
from concurrent.futures import BrokenExecutor
from pathlib import Path

import pytest

from tbmfg import workers


def threads(_: int) -> tuple[str, ...]:
    return tuple(os.environ[name] for name in workers.THREADS)


def dies(job: tuple[Path, str]) -> str:
    """Leaves a mark and is killed: "once" only where there is no mark yet, "always" every time, "never" not."""
    mark, when = job
    first = not mark.exists()
    with mark.open("a") as file:
        file.write("x")
    if when == "always" or (when == "once" and first):
        os.kill(os.getpid(), signal.SIGKILL)
    return when


def test_workers_have_one_thread_and_leave_the_environment_alone(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with workers.processes(1) as pool:
        [(_, future)] = workers.run(threads, [0], pool)
    assert future.result() == ("1",) * len(workers.THREADS)
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_job_whose_worker_dies_runs_again_and_only_the_one_to_blame_fails(tmp_path):
    jobs = [(tmp_path / f"{number}-{when}", when) for number, when in enumerate(["once", "never", "always", "never"])]
    with workers.processes(2) as pool:
        ended = {job[0].name: future for job, future in workers.run(dies, jobs, pool)}
    assert sorted(ended) == sorted(mark.name for mark, _ in jobs)
    blamed = ended.pop("2-always")
    assert isinstance(blamed.exception(), BrokenExecutor)
    # once where the death of another came before its start
    assert (tmp_path / "2-always").read_text() in ("x", "xx")
    assert (ended.pop("0-once").exception() is None) == ((tmp_path / "0-once").read_text() == "xx")
    assert all(future.exception() is None for future in ended.values())


def test_a_job_that_raises_is_an_answer(tmp_path):
    with workers.processes(1) as pool:
        ended = dict(workers.run(os.stat, [str(tmp_path / "absent"), str(tmp_path)], pool))
    assert isinstance(ended[str(tmp_path / "absent")].exception(), FileNotFoundError)
    assert ended[str(tmp_path)].exception() is None


def test_a_scheduler_that_does_not_answer_is_said(monkeypatch):
    pytest.importorskip("distributed", reason="Dask is not installed")
    monkeypatch.setattr(workers, "CONNECT_S", 0.2)
    with (
        pytest.raises(workers.TbmfgError, match=r"tcp://127.0.0.1:9: no Dask scheduler answers"),
        workers.cluster("tcp://127.0.0.1:9"),
    ):
        pass
