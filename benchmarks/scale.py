"""How time and memory grow with the length of a log, online updates with time, and a batch with its jobs.

One simulated roadheader's log (IMU at 200 Hz, prism at 5 Hz, odometer and magnetometer at 20 Hz), or another, is read
up to several lengths (``--end``), each in a process of its own with one native thread, after a short stretch that does
not count. Seconds are those of the processor, so that other work on the machine changes them little; on an idle machine
they are those of the clock. Writing is included. Logs are estimated without their truth.

read .. write            stages of ``tbmfg run``, in s and as multiples of real time; ``build`` is the preintegration,
                         ``filter`` also counts the runs that ``prepare`` makes
x real time              duration of the log over the seconds of the whole run
peak_rss                 largest memory of the process
growth of ..             exponent p of the fit a T^p over the lengths
update                   online, at ten keyframes a second and a lag of 5 s: ms from keyframe to keyframe
update, late / early     the 99th percentile in the last sixth over that in the first
jobs 2 / 1               a batch over copies of the log's first stretch: how many times faster two jobs are than one, by
                         the clock
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rows import Row
from benchmarks.speed import STAGES, clock, clocks
from tbmfg import workers
from tbmfg.errors import TbmfgError

LENGTHS = (7.5, 15.0, 30.0, 60.0)
WARM_S = 20.0  # of the log, run first: imports, compiled code, caches
GROWTH = 1.1  # exponents should be below
FASTER = {"batch": 120.0, "ins": 300.0}  # than real time, at least
MEMORY_MB = 1200.0
ONLINE = ("keyframes.max_gap_s=0.11", "lag_s=5")  # the rig's, where updates are timed
UPDATE_MS = 3.0  # of fixed-lag, in the mean
FLAT = 1.2  # the last stretch of an online estimator over its first
SPEEDUP = 1.7  # of two jobs on two processors
SHOWN = ("read", "prepare", "filter", "build", "solve", "covariance", "write")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--log", type=Path, metavar="FILE", help="another log, with its rig; else one is simulated")
    parser.add_argument(
        "--minutes", default=",".join(f"{m:g}" for m in LENGTHS), metavar="A,B,...", help="lengths of the log"
    )
    parser.add_argument("--estimators", default="batch,ins", metavar="A,B,...", help="(batch,ins)")
    parser.add_argument("--online", default="fixed-lag", metavar="A,B,...", help="whose updates are timed (fixed-lag)")
    parser.add_argument("--copies", type=int, default=4, metavar="N", help="logs of the batch; 0: no batch (4)")
    parser.add_argument("--copy-minutes", type=float, default=5.0, metavar="M", help="length of each (5)")


@dataclass(frozen=True, slots=True)
class Task:
    """One run in a process of its own: ``minutes`` of the log by one estimator."""

    log: str
    estimator: str
    minutes: float


def measure(given: argparse.Namespace) -> list[Row]:
    try:
        lengths = sorted(float(part) for part in given.minutes.split(","))
    except ValueError:
        lengths = []
    if not lengths or lengths[0] <= 0:
        raise TbmfgError(f"--minutes {given.minutes}: should be lengths above 0 between commas")
    with tempfile.TemporaryDirectory() as folder:
        log = given.log or simulated(Path(folder) / "drive.mcap", 60.0 * max(*lengths, given.copy_minutes))
        rows = []
        for estimator in names(given.estimators):
            spent = [alone(run, Task(str(log), estimator, minutes)) for minutes in lengths]
            rows += [row for one in spent for row in stage_rows(estimator, one)] + growth_rows(estimator, spent)
        for estimator in names(given.online):
            rows += update_rows(estimator, alone(updates, Task(str(log), estimator, lengths[-1])))
        if given.copies:
            rows += batch_rows(log, Path(folder), given.copies, given.copy_minutes)
    return rows


def names(text: str) -> list[str]:
    return [name for name in text.split(",") if name]


def simulated(path: Path, duration_s: float) -> Path:
    import datasets

    datasets.make("tbm-drive", duration=duration_s, imu_rate_hz=200.0).write(path)
    return path


def alone(function: Any, task: Task) -> dict[str, Any]:
    """``function`` of the task in a fresh process, whose memory then is that of the task."""
    with workers.processes(1) as pool:
        [(_, future)] = workers.run(function, [task], pool)
    return future.result()


# ---- lengths ----


def run(task: Task) -> dict[str, float]:
    """Processor seconds by stage, length in s, and peak memory in MB."""
    from tbmfg import pipeline

    def once(end_s: float) -> dict[str, Any]:
        with tempfile.TemporaryDirectory() as folder:
            return pipeline.run(task.log, estimator=task.estimator, truth="none", end_s=end_s, output=folder)

    once(WARM_S)
    with clocks(STAGES, time.process_time) as spent, clock(spent, "total", time.process_time):
        summary = once(60.0 * task.minutes)
    spent["solve"] = spent["smooth"] - spent["build"] - spent["covariance"]
    return {**spent, "length": summary["duration_s"], "peak_rss": pipeline.peak_rss_mb()}


def stage_rows(estimator: str, spent: dict[str, float]) -> list[Row]:
    length = spent["length"]
    scenario = f"{length / 60.0:.3g} min"
    stages = [stage for stage in SHOWN if spent[stage] > 0]
    hour = length > 3590.0  # what is asked is asked of an hour
    speeds = {f"{stage} speed": length / spent[stage] for stage in stages}
    return [
        *(Row(scenario, estimator, stage, "s", spent[stage], None, 1) for stage in [*stages, "total"]),
        *(Row(scenario, estimator, name, "x real time", speed, None, 1) for name, speed in speeds.items()),
        Row(
            scenario, estimator, "x real time", "", length / spent["total"], None, 1,
            (FASTER[estimator], None) if hour and estimator in FASTER else None,
        ),
        Row(scenario, estimator, "peak_rss", "MB", spent["peak_rss"], None, 1, (None, MEMORY_MB) if hour else None),
    ]  # fmt: skip


def growth_rows(estimator: str, spent: list[dict[str, float]]) -> list[Row]:
    """Exponents over the lengths; nothing to fit with a single one."""
    if len(spent) < 2:
        return []
    length = np.log([one["length"] for one in spent])
    scenario = f"{spent[0]['length'] / 60.0:.3g}-{spent[-1]['length'] / 60.0:.3g} min"
    rows = []
    for metric in (*SHOWN, "total", "peak_rss"):
        values = [one[metric] for one in spent]
        if min(values) > 0:
            exponent = float(np.polyfit(length, np.log(values), 1)[0])
            asked = (None, GROWTH) if metric in ("total", "peak_rss") else None
            rows.append(Row(scenario, estimator, f"growth of {metric}", "", exponent, None, len(spent), asked))
    return rows


# ---- online updates ----


def updates(task: Task) -> dict[str, Any]:
    """Processor ms per update, in the order of the keyframes, and the length in s."""
    from tbmfg import estimators, pipeline

    def session(end_s: float) -> pipeline.Session:
        return pipeline.open_session(task.log, truth="none", end_s=end_s, overrides=ONLINE)

    estimators.estimate(task.estimator, session(WARM_S).prepared)
    problem = session(60.0 * task.minutes).prepared
    told: list[tuple[float, float]] = []
    estimators.estimate(task.estimator, problem, progress=lambda _, share: told.append((share, time.process_time())))
    ms = 1e3 * np.diff([now for share, now in told if share < 1.0])
    return {"ms": ms.tolist(), "length": float(problem.keyframes_s[-1] - problem.keyframes_s[0])}


def update_rows(estimator: str, measured: dict[str, Any]) -> list[Row]:
    ms, scenario = np.array(measured["ms"]), f"{measured['length'] / 60.0:.3g} min"
    sixth = max(len(ms) // 6, 1)
    early, late = (float(np.percentile(part, 99)) for part in (ms[:sixth], ms[-sixth:]))
    mean, flat = ((None, UPDATE_MS), (None, FLAT)) if estimator == "fixed-lag" else (None, None)
    return [
        Row(scenario, estimator, "update, mean", "ms", float(ms.mean()), float(ms.std()), len(ms), mean),
        *(
            Row(scenario, estimator, f"update, {p} %", "ms", float(np.percentile(ms, p)), None, len(ms))
            for p in (50, 90, 99)
        ),
        Row(scenario, estimator, "update, late / early", "", late / early, None, sixth, flat),
    ]


# ---- a batch ----


def batch_rows(log: Path, folder: Path, copies: int, minutes: float) -> list[Row]:
    """Two jobs against one on the same logs; the clock's seconds, starting the processes included."""
    from tbmfg import batch

    logs = folder / "logs"
    logs.mkdir()
    for number in range(copies):
        shutil.copyfile(log, logs / f"{number}.mcap")
    spent = {}
    for jobs in (1, 2):
        with clock(spent, str(jobs)):
            report = batch.run([logs], output=folder / f"jobs{jobs}", jobs=jobs, truth="none", end_s=60.0 * minutes)
        if report[batch.FAILED]:
            raise TbmfgError(f"{log}: failed in a batch: {report['logs'][0]['reason']}")
    scenario = f"{copies} x {minutes:g} min"
    asked = (SPEEDUP, None) if batch.processors() >= 2 else None
    return [
        *(Row(scenario, "batch", f"jobs {jobs}", "s", seconds, None, 1) for jobs, seconds in spent.items()),
        Row(scenario, "batch", "jobs 2 / 1", "x", spent["1"] / spent["2"], None, 1, asked),
    ]
