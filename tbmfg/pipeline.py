"""From a log to a folder of results: what the command line, batch jobs and Python users all call."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from tbmfg import __version__
from tbmfg.errors import RigError, TbmfgError
from tbmfg.results import (
    find_truth,
    load_truth,
    refuse_existing,
    refuse_existing_file,
    summarise,
    write_result,
    write_text,
)
from tbmfg.rig import Rig, dump_rig, load_rig, override, parse_rig
from tbmfg.state import Calibrated, Truth
from tbmfg.timeseries import NS, Log

Progress = Callable[[str, float], None]
Outage = tuple[str, float, float]

ATTACHED_RIG = "rig.yaml"


def run(
    log_path: str | Path,
    *,
    rig: Rig | str | Path | None = None,
    estimator: str = "batch",
    truth: str = "auto",
    output: str | Path | None = None,
    outages: Sequence[Outage] = (),
    without: Collection[str] = (),
    only: Collection[str] = (),
    overrides: Sequence[str] = (),
    force: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Estimate one log and return its summary, the content of summary.json; with ``output`` write all files.

    ``rig``: a Rig, a shipped name or a file; None takes the one attached to the log, else infers one.
    ``outages``: (sensor, start, end) in seconds from the first IMU sample, stamps as recorded. ``without`` drops
    sensors, ``only`` keeps just these and the IMU. ``overrides``: ``key.path=value`` over the rig. ``progress`` is
    called with the stage and the done fraction of it. ``wall_s`` is the time from opening the log to the result:
    without evaluating, writing and the imports that can be done before.
    """
    from tbmfg.estimators import ESTIMATORS, estimate
    from tbmfg.evaluation.metrics import evaluate
    from tbmfg.mcap import read_log
    from tbmfg.prepare import prepare

    if estimator not in ESTIMATORS:
        raise TbmfgError(f"no estimator {estimator!r}; there are {', '.join(ESTIMATORS)}")
    if output is not None:
        refuse_existing(output, force)

    started = time.perf_counter()
    log = read_log(log_path, progress=partial(progress, "reading") if progress else None)
    rig, assumed = rig_for(log, rig, overrides)
    without = dropped_sensors(rig, without, only)
    reference = find_truth(truth, log, rig)
    prepared = prepare(log, rig, outages=tuple(outages), without=without, progress=progress)
    result = estimate(estimator, prepared, progress=progress)
    wall_s = time.perf_counter() - started

    result.warnings = list(dict.fromkeys([*assumed, *prepared.warnings, *result.warnings]))
    span_ns = int(result.trajectory.t_ns[-1] - result.trajectory.t_ns[0])
    summary: dict[str, Any] = {
        "tbmfg_version": __version__,
        "log": str(log_path),
        "rig": prepared.rig.name,
        "estimator": estimator,
        "truth": reference,
        "options": {"outages": list(outages), "without": without, "set": list(overrides)},
        "keyframes": len(result.trajectory),
        "duration_s": span_ns / NS,
        "wall_s": wall_s,
        "realtime_factor": span_ns / NS / wall_s,
        "peak_rss_mb": None,
        **summarise(result, prepared.t0_ns),
        "metrics": None,
    }
    if reference is not None:
        poses = truth_for(reference, log, prepared.rig, result.calibration)
        lost = [(prepared.t0_ns + round(start * NS), prepared.t0_ns + round(end * NS)) for _, start, end in outages]
        summary["metrics"] = evaluate(result.trajectory, poses, lost)
        if result.smoothed is not None:
            summary["metrics_smoothed"] = evaluate(result.smoothed, poses, lost)
    summary["peak_rss_mb"] = peak_rss_mb()
    if output is not None:
        write_result(output, result, summary, dump_rig(prepared.rig), force=force)
    return summary


def rig_for(log: Log, rig: Rig | str | Path | None, overrides: Sequence[str] = ()) -> tuple[Rig, list[str]]:
    """The rig given, else the one attached to the log, else one inferred from it, with ``overrides`` applied; and
    what was assumed for an inferred one."""
    assumed: list[str] = []
    if rig is None and ATTACHED_RIG in log.attachments:
        source = f"{log.path}: attachment {ATTACHED_RIG}"
        try:
            rig = parse_rig(log.attachments[ATTACHED_RIG].decode("utf-8"), source)
        except UnicodeDecodeError as error:
            raise RigError(f"{source}: cannot be read: not UTF-8 text") from error
    elif rig is None:
        from tbmfg.inference import infer

        inferred = infer(log)
        rig, assumed = inferred.rig, inferred.lines()
    elif not isinstance(rig, Rig):
        rig = load_rig(rig)
    return override(rig, overrides) if overrides else rig, assumed


def init(log_path: str | Path, output: str | Path, *, force: bool = False) -> list[str]:
    """Write a starter rig for a log to the file ``output`` and return what was assumed in it, line by line."""
    from tbmfg.inference import infer, starter
    from tbmfg.mcap import read_log

    output = Path(output)
    refuse_existing_file(output, force)
    log = read_log(log_path)
    inferred = infer(log)
    write_text(output, starter(inferred, log.path), force=force)
    return [*log.damage, *inferred.lines()]


def dropped_sensors(rig: Rig, without: Collection[str], only: Collection[str]) -> tuple[str, ...]:
    """The sensors of ``rig`` that ``without`` and ``only`` leave out."""
    for option, names in (("--without", without), ("--only", only)):
        for name in names:
            if name not in rig.sensors:
                known = ", ".join(rig.sensors)
                raise TbmfgError(f"{option} {name}: the rig {rig.name} has no such sensor; it has {known}")
    if "imu" in without:
        raise TbmfgError("--without imu: every estimator needs the IMU")
    kept = {"imu", *only} if only else set(rig.sensors)
    return tuple(name for name in rig.sensors if name not in kept or name in without)


def truth_for(reference: str, log: Log, rig: Rig, calibration: Mapping[str, Calibrated]) -> Truth:
    """What :func:`find_truth` found. The rig's own truth is brought to the IMU's clock, and has the rig's arm."""
    truth = load_truth(reference, log)
    if rig.truth is None or reference != rig.truth.topic:
        return truth
    offset_s = 0.0
    if clock := rig.truth.clock:
        found = calibration.get(f"{clock}_clock_offset_s")
        offset_s = rig.sensors[clock].clock_offset if found is None else found.value
    return replace(truth, t_ns=truth.t_ns - round(offset_s * NS), arm_b=rig.truth.arm)


def peak_rss_mb() -> float | None:
    """Largest memory of this process so far, in 10^6 bytes; None where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024) / 1e6
