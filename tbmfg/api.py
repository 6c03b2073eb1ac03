"""tbmfg from Python: what the command line does, on objects instead of files.

import tbmfg

result = tbmfg.run("drive.mcap", rig="tbm")
result.trajectory.position_n, result.calibration["prism_lever_arm_m"].value, result.warnings
tbmfg.compare("drive.mcap", estimators=["batch", "ins"]).results["ins"].summary["metrics"]
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from os import PathLike

from tbmfg import pipeline
from tbmfg.comparison import not_run
from tbmfg.pipeline import Outage, Progress
from tbmfg.rig import Rig
from tbmfg.state import Result
from tbmfg.timeseries import Log


@dataclass(frozen=True, slots=True)
class Comparison:
    """Estimators side by side: a result for each that ran, and why each of the others did not."""

    results: dict[str, Result]
    not_run: dict[str, str]


def run(
    log: str | PathLike | Log,
    rig: Rig | str | PathLike | None = None,
    *,
    estimator: str = "batch",
    truth: str = "auto",
    outages: Sequence[Outage] = (),
    without: Collection[str] = (),
    only: Collection[str] = (),
    overrides: Sequence[str] = (),
    output: str | PathLike | None = None,
    report: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> Result:
    """Estimate the trajectory of one log.

    ``log``: an .mcap file, a rosbag2 folder, or what :func:`tbmfg.read_log` gave. ``rig``: a Rig, a shipped name or a
    file; None takes the one attached to the log, else infers one. ``truth``: auto, none, a topic or a file; it is
    compared with and never used. ``outages``: (sensor, start, end) in s from the first IMU sample, stamps as recorded.
    ``without`` drops sensors, ``only`` keeps just these and the IMU. ``overrides``: ``key.path=value`` over the rig.
    ``output``: a folder for all result files, report.html among them with ``report``. ``progress`` is called with the
    stage and its done fraction.

    ``Result.summary`` is the content of summary.json. Raises LogError, RigError or EstimationError, all of them
    TbmfgError, with one line that says what is at fault and what to do about it.
    """
    result, summary = pipeline.run_result(
        log, estimator=estimator, output=output, report=report, force=force, progress=progress,
        rig=rig, truth=truth, outages=outages, without=without, only=only, overrides=overrides,
    )  # fmt: skip
    result.summary = summary
    return result


def compare(
    log: str | PathLike | Log,
    rig: Rig | str | PathLike | None = None,
    *,
    estimators: Sequence[str] = ("batch", "fixed-lag", "ins"),
    truth: str = "auto",
    outages: Sequence[Outage] = (),
    without: Collection[str] = (),
    only: Collection[str] = (),
    overrides: Sequence[str] = (),
    output: str | PathLike | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Comparison:
    """Run several estimators on one prepared log; arguments and errors as :func:`run`, which see.

    With ``output`` every estimator's files go to a folder of its name, compare.json and report.html beside them. Raises
    TbmfgError when none ran.
    """
    results: dict[str, Result] = {}
    summaries = pipeline.compare(
        log, estimators=estimators, output=output, force=force, progress=progress, each=results.__setitem__,
        rig=rig, truth=truth, outages=outages, without=without, only=only, overrides=overrides,
    )  # fmt: skip
    for name, result in results.items():
        result.summary = summaries[name]
    return Comparison(results, not_run(summaries))
