"""From a log to a folder of results: what the command line, batch jobs and Python users all call."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tbmfg import __version__, storage
from tbmfg.errors import EstimationError, TbmfgError
from tbmfg.given import dropped_sensors, given_rig, inferred_rig, topics_for, truth_for
from tbmfg.results import (
    REPORT,
    find_truth,
    refuse_existing,
    refuse_existing_file,
    summarise,
    to_json,
    write_result,
    write_text,
)
from tbmfg.rig import Imu, Rig, dump_rig
from tbmfg.state import Result, Truth
from tbmfg.timeseries import NS, Floats, Log

if TYPE_CHECKING:
    from tbmfg.bounds import Bounds
    from tbmfg.inertial.allan import Static
    from tbmfg.problem import Problem
    from tbmfg.report import Report
    from tbmfg.storage import Place

Progress = Callable[[str, float], None]
Outage = tuple[str, float, float]

COMPARISON = "compare.json"
UNUSED = ("pose_cov", "twist_cov")  # columns of odometry, most of its bytes: no sensor and no truth takes them


@dataclass(frozen=True, slots=True)
class Session:
    """One log, prepared once: what every estimator of a run or a comparison is given. ``bounds`` holds what accuracy
    is possible, or why that is not known, once it has been asked for."""

    log: Log
    log_path: str
    prepared: Problem
    reference: str | None
    assumed: tuple[str, ...]
    options: dict[str, Any]
    shared_s: float
    bounds: list[Bounds | str] = field(default_factory=list)

    def estimate(self, name: str, progress: Progress | None = None) -> tuple[Result, dict[str, Any]]:
        """Result and summary of one estimator. ``wall_s`` runs from opening the log to the result, reading and
        preparing (``shared_s``) among it: without evaluating, writing and the imports that can be done before."""
        from tbmfg.estimators import estimate
        from tbmfg.evaluation.metrics import evaluate

        started = time.perf_counter()
        result = estimate(name, self.prepared, progress=progress)
        wall_s = self.shared_s + time.perf_counter() - started

        deviation, vague = self._deviation(result)
        result.warnings = list(dict.fromkeys([*self.assumed, *self.prepared.warnings, *result.warnings, *vague]))
        span_ns = int(result.trajectory.t_ns[-1] - result.trajectory.t_ns[0])
        summary: dict[str, Any] = {
            "tbmfg_version": __version__,
            "log": self.log_path,
            "rig": self.prepared.rig.name,
            "estimator": name,
            "truth": self.reference,
            "options": self.options,
            "keyframes": len(result.trajectory),
            "duration_s": span_ns / NS,
            "wall_s": wall_s,
            "shared_s": self.shared_s,
            "realtime_factor": span_ns / NS / wall_s,
            "peak_rss_mb": peak_rss_mb(),
            **summarise(result, self.prepared.t0_ns),
            **deviation,
            "metrics": None,
        }
        poses = self.truth(result)
        if poses is not None:
            summary["metrics"] = evaluate(result.trajectory, poses, self._lost())
            if result.smoothed is not None:
                summary["metrics_smoothed"] = evaluate(result.smoothed, poses, self._lost())
        return result, summary

    def hold_to_bound(self, result: Result, summary: dict[str, Any]) -> None:
        """Add to the metrics of ``summary`` the Cramer-Rao bounds of this log and the errors over them.

        The bounds are made once, at the truth of the first result; where they cannot be, a warning says why.
        """
        poses = self.truth(result)
        if poses is None:
            return
        from tbmfg.bounds import cramer_rao
        from tbmfg.estimators import ESTIMATORS
        from tbmfg.evaluation.metrics import expected, over

        if not self.bounds:
            try:
                self.bounds.append(cramer_rao(self.prepared, poses))
            except EstimationError as error:
                self.bounds.append(f"errors are not compared with their bound: {error}")
        bounds = self.bounds[0]
        if isinstance(bounds, str):
            summary["warnings"] = [*summary["warnings"], bounds]
            return
        causal = bounds.smoothing if ESTIMATORS[result.estimator].whole else bounds.filtering
        for key, bound in (("metrics", causal), ("metrics_smoothed", bounds.smoothing)):
            if key in summary:
                summary[key] |= over(summary[key], expected(bound, poses, self._lost()))

    def _lost(self) -> list[tuple[int, int]]:
        """The outages that were asked for, as stamps."""
        t0_ns = self.prepared.t0_ns
        return [(t0_ns + round(start * NS), t0_ns + round(end * NS)) for _, start, end in self.options["outages"]]

    def truth(self, result: Result) -> Truth | None:
        """What ``result`` is compared with, None where there is nothing."""
        if self.reference is None:
            return None
        return truth_for(self.reference, self.log, self.prepared.rig, result.calibration, self.prepared.t0_ns)

    def report(self) -> Report:
        """A report on this log that holds no result yet."""
        from tbmfg.report import Report, stamps_of

        problem = self.prepared
        return Report(
            title=f"{problem.rig.name}: {Path(self.log_path).name}",
            rig_yaml=dump_rig(problem.rig),
            t0_ns=problem.t0_ns,
            stamps_s=stamps_of(self.log, problem.rig, problem.t0_ns),
            found=tuple(problem.warnings),
            assumed=self.assumed,
        )

    def sketch(self, result: Result) -> tuple[Floats | None, str]:
        """The map that the scans make along ``result``, (k, 3) m in n, and what it is; None where there are none."""
        if not self.log.clouds:
            return None, ""
        from tbmfg.mapping import sketch

        return sketch(self.log, self.prepared.rig, result)

    def _deviation(self, result: Result) -> tuple[dict[str, Any], list[str]]:
        """What the dual-coordinate method says of a machine with a laser, {"deviation": ...}, nothing of others; and
        which of its angles are known too poorly for that."""
        lasers = self.prepared.rig.of_kind("laser")
        name = next((name for name in lasers if name in self.prepared.samples), None)
        if name is None:
            return {}, []
        from tbmfg.dual import timeline, vague

        spots, rule = self.prepared.samples[name], self.prepared.rig.deviation
        told = timeline(result.trajectory, spots, lasers[name], rule, self.prepared.t0_ns)
        return {"deviation": told}, vague(result.trajectory, rule)


def open_session(
    log_path: str | Place | Log,
    *,
    rig: Rig | str | Path | None = None,
    truth: str = "auto",
    outages: Sequence[Outage] = (),
    without: Collection[str] = (),
    only: Collection[str] = (),
    overrides: Sequence[str] = (),
    start_s: float | None = None,
    end_s: float | None = None,
    progress: Progress | None = None,
) -> Session:
    """Read and prepare a log; the arguments are those of :func:`run_result`."""
    from tbmfg.estimators import check_switches
    from tbmfg.mcap import read_attachments, read_log
    from tbmfg.prepare import prepare

    started = time.perf_counter()
    log = log_path
    if isinstance(log, Log):
        if (start_s, end_s) != (None, None):
            raise TbmfgError(f"{log.path}: start_s and end_s choose what is read, and this log has been read")
        rig = given_rig(rig, log.attachments, log.path, overrides)
    else:
        rig = given_rig(rig, {} if rig is not None else read_attachments(log_path), log_path, overrides)
        part: dict[str, Any] = {"start_s": start_s, "end_s": end_s}
        if rig is not None:
            part |= {"topics": topics_for(rig, truth), "leave": UNUSED}
        log = read_log(log_path, progress=partial(progress, "reading") if progress else None, **part)
        if rig is None:  # a log that was cut lists no attachments and may have some
            rig = given_rig(None, log.attachments, log.path, overrides)
    if rig is not None:
        assumed = rig.assumptions()
    else:
        rig, assumed = inferred_rig(log, overrides)
    check_switches(rig)
    dropped = dropped_sensors(rig, without, only)
    reference = find_truth(truth, log, rig)
    try:
        prepared = prepare(log, rig, outages=tuple(outages), without=dropped, progress=progress)
    except EstimationError as error:
        left_out = [line for line in assumed if not line.startswith("assumed")]
        raise EstimationError("; ".join([str(error), *left_out])) from error
    options = {
        "outages": list(outages),
        "without": dropped,
        "set": list(overrides),
        "start_s": start_s,
        "end_s": end_s,
    }
    shared_s = time.perf_counter() - started
    path = log_path.path if isinstance(log_path, Log) else str(log_path)
    return Session(log, path, prepared, reference, tuple(assumed), options, shared_s)


def run(log_path: str | Place | Log, **options: Any) -> dict[str, Any]:
    """The summary of :func:`run_result` alone."""
    return run_result(log_path, **options)[1]


def run_result(
    log_path: str | Place | Log,
    *,
    estimator: str = "batch",
    output: str | Place | None = None,
    report: bool = False,
    into: str | Path | None = None,
    force: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> tuple[Result, dict[str, Any]]:
    """Estimate one log: the result and its summary, the content of summary.json. With ``output`` write all files, with
    ``report`` report.html among them, with ``into`` a copy of the log that holds the poses too.

    ``options``: ``rig``, a Rig, a shipped name or a file; None takes the one attached to the log, else infers one.
    ``truth``: auto, none, a topic or a file. ``outages``: (sensor, start, end) in seconds from the first IMU sample,
    stamps as recorded. ``without`` drops sensors, ``only`` keeps just these and the IMU. ``overrides``:
    ``key.path=value`` over the rig. ``start_s``, ``end_s``: only what was logged between, in seconds from the first
    message of the recording; outages then count from the first IMU sample of this part. ``progress`` is called with
    the stage and the done fraction of it.
    """
    known_estimators([estimator])
    if output is not None:
        refuse_existing(output, force)
    if into is not None:
        refuse_existing_file(into, force)
    session = open_session(log_path, progress=progress, **options)
    result, summary = session.estimate(estimator, progress)
    if output is not None:
        text, (map_n, label) = None, session.sketch(result)
        if report:
            told = session.report()
            told.add(result, summary, session.truth(result))
            told.map_n, told.map_label = map_n, label
            text = told.html()
        rig = dump_rig(session.prepared.rig)
        write_result(output, result, summary, rig, report=text, map_n=map_n, force=force)
    if into is not None:
        from tbmfg.mcap import write_into

        write_into(session.log_path, into, result.smoothed or result.trajectory, session.prepared.rig.imu.topic)
    return result, summary


def compare(
    log_path: str | Place | Log,
    *,
    estimators: Sequence[str],
    output: str | Place | None = None,
    force: bool = False,
    progress: Progress | None = None,
    each: Callable[[str, Result], object] | None = None,
    **options: Any,
) -> dict[str, dict[str, Any]]:
    """Run several estimators on one prepared log: {estimator: summary}, or {"not_run": why} for one that could not.

    Where there is a truth, errors are also given over their Cramer-Rao bounds (``tbmfg.bounds``).
    With ``output`` every estimator's files go to a folder of its name, compare.json and report.html beside them.
    ``each`` is called with every estimator's name and result. The other arguments are those of :func:`run_result`.
    Raises TbmfgError when none ran.
    """
    from tbmfg.estimators import unmet

    known_estimators(estimators)
    if output is not None:
        output = storage.place(output)
        for name in (COMPARISON, REPORT):
            refuse_existing_file(output / name, force)
        for name in estimators:
            refuse_existing(output / name, force)
    session = open_session(log_path, progress=progress, **options)
    summaries: dict[str, dict[str, Any]] = {}
    report = session.report()
    for name in dict.fromkeys(estimators):
        reason = unmet(name, session.prepared)
        if reason is None:
            try:
                result, summaries[name] = session.estimate(name, progress)
                session.hold_to_bound(result, summaries[name])
            except EstimationError as error:
                reason = str(error)
        if reason is None and each is not None:
            each(name, result)
        if reason is not None:
            summaries[name] = report.summaries[name] = {"not_run": reason}
        elif output is not None:
            report.add(result, summaries[name], session.truth(result))
            map_n, label = session.sketch(result)
            if report.map_n is None:
                report.map_n, report.map_label = map_n, label
            rig = dump_rig(session.prepared.rig)
            write_result(output / name, result, summaries[name], rig, map_n=map_n, force=force)
    if all("not_run" in summary for summary in summaries.values()):
        reasons = "; ".join(f"{name}: {summary['not_run']}" for name, summary in summaries.items())
        raise TbmfgError(f"{session.log_path}: none ran: {reasons}")
    if output is not None:
        write_text(output / REPORT, report.html(), force=force)
        write_text(output / COMPARISON, to_json(summaries), force=force)
    return summaries


def known_estimators(names: Sequence[str]) -> None:
    """Raise for a name that does not exist."""
    from tbmfg.estimators import ESTIMATORS

    for name in names:
        if name not in ESTIMATORS:
            raise TbmfgError(f"no estimator {name!r}; there are {', '.join(ESTIMATORS)}")


def init(log_path: str | Place, output: str | Place, *, force: bool = False) -> list[str]:
    """Write a starter rig for a log to the file ``output`` and return what was assumed in it, line by line."""
    from tbmfg.inference import infer, starter
    from tbmfg.mcap import read_log

    output = storage.place(output)
    refuse_existing_file(output, force)
    log = read_log(log_path)
    inferred = infer(log)
    write_text(output, starter(inferred, log.path), force=force)
    return [*log.damage, *inferred.lines()]


def allan(log_path: str | Place, rig: Rig | str | Path | None = None) -> tuple[Static, Imu]:
    """Noise of the IMU where it stands, and what the rig (given, attached or inferred) says of the unit."""
    from tbmfg.inertial.allan import static
    from tbmfg.mcap import read_log
    from tbmfg.prepare.samples import imu_steps

    log = read_log(log_path)
    rig = given_rig(rig, log.attachments, log.path) or inferred_rig(log)[0]
    steps, _ = imu_steps(log, rig, (), [])
    return static(steps), rig.imu


def peak_rss_mb() -> float | None:
    """Largest memory of this process so far, in 10^6 bytes; None where the system does not say."""
    try:  # Linux hands ru_maxrss on from whoever started the process; its high-water mark is the process's own
        status = Path("/proc/self/status").read_text("ascii")
        return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM:")) * 1024 / 1e6
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:  # Windows
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6
