"""Many logs, each a job of its own: what to run is found from the arguments, what is finished is kept.

A job carries names and configuration, never data: the worker opens the log and writes the results itself. Beside the
results it leaves ``job.json``, which says what they were made from. A job with the same log, rig, estimators, options
and version of tbmfg that has finished is kept; one that has not is done again.
"""

from __future__ import annotations

import csv
import io
import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from glob import glob, has_magic
from pathlib import Path, PurePath, PurePosixPath
from typing import Any
from urllib.parse import urlsplit

from tbmfg import __version__, pipeline, storage, workers
from tbmfg.errors import TbmfgError, reason
from tbmfg.mcap.reader import recording_files
from tbmfg.results import SUMMARY, refuse_existing, to_json
from tbmfg.rig import Rig, dump_rig, load_rig, override, parse_rig
from tbmfg.storage import Place

JOB = "job.json"
TABLE = "batch.csv"
SUMMARIES = "batch.json"
FIGURES = ("keyframes", "duration_s", "wall_s", "realtime_factor", "peak_rss_mb")  # of a summary
METRICS = ("ape_rms_m", "position_rms_m", "attitude_rms_deg", "nees_mean")  # against the truth, where there is one
DONE, KEPT, FAILED = "done", "kept", "failed"


@dataclass(frozen=True, slots=True)
class Job:
    """One log. ``rig`` is the text of a rig file, None where the log brings its own; ``options`` are those of
    :func:`tbmfg.pipeline.run`."""

    name: str
    log: str
    output: str
    rig: str | None
    estimators: tuple[str, ...]
    options: dict[str, Any] = field(default_factory=dict)
    force: bool = False
    version: str = __version__

    def inputs(self) -> dict[str, Any]:
        """What the results depend on, as it reads back from JSON."""
        truth = storage.place(self.options.get("truth", "auto"))
        made_from = {
            "tbmfg_version": self.version,
            "log": [storage.fingerprint(file) for file in recording_files(self.log)],
            "rig": self.rig,
            "estimators": self.estimators,
            "options": self.options,
            "truth": storage.fingerprint(truth) if truth.is_file() else None,
        }
        return json.loads(to_json(made_from))


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one log: ``status`` is done, kept or failed, with the ``reason``; by estimator its figures."""

    name: str
    log: str
    output: str
    status: str
    reason: str = ""
    results: tuple[dict[str, Any], ...] = ()


def run(
    logs: Sequence[str | os.PathLike],
    *,
    output: str | Place,
    estimators: Sequence[str] = ("batch",),
    rig: Rig | str | Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    force: bool = False,
    tell: Callable[[Outcome, int, int], None] | None = None,
    on: AbstractContextManager[workers.Workers] | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Run the estimators on every log that :func:`find_logs` finds; returns what batch.json holds.

    Results go to a folder per log, as ``run`` writes them for one estimator and ``compare`` for several. ``jobs`` logs
    are done at a time (None: one per processor), or those that the workers of a Dask ``scheduler`` take; ``on``
    gives other workers. ``force`` replaces results of other inputs. ``tell`` hears each outcome, its number and how
    many there are. ``options`` are those of :func:`tbmfg.pipeline.run`. A log that fails does not stop the others.

    Raises TbmfgError where there is nothing to do, or where the rig is at fault.
    """
    started = time.time()
    pipeline.known_estimators(estimators)
    if rig is not None:
        rig = dump_rig(checked(rig, options.get("overrides", ())))
    output = storage.absolute(storage.place(output))  # workers may be elsewhere
    found = find_logs(logs, output)
    todo = [
        Job(name, log, str(output / name), rig, tuple(dict.fromkeys(estimators)), options, force)
        for name, log in named(found).items()
    ]
    outcomes: dict[str, Outcome] = {}
    on = on or (workers.cluster(scheduler) if scheduler else workers.processes(min(jobs or processors(), len(todo))))
    try:
        with on as pool:
            for job, future in workers.run(do, todo, pool):
                error = future.exception()
                outcomes[job.name] = failed(job, error) if error else future.result()
                if tell:
                    tell(outcomes[job.name], len(outcomes), len(todo))
    finally:  # also where it is interrupted: what is finished is listed
        report = {
            "tbmfg_version": __version__,
            "wall_s": time.time() - started,
            "estimators": list(dict.fromkeys(estimators)),
            "options": options,
            "logs_found": len(todo),
            **{status: sum(o.status == status for o in outcomes.values()) for status in (DONE, KEPT, FAILED)},
            "logs": [asdict(outcomes[job.name]) for job in todo if job.name in outcomes],
        }
        if outcomes:
            storage.write_text(output / SUMMARIES, to_json(report))
            storage.write_text(output / TABLE, table(report["logs"]))
    return report


def processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def checked(rig: Rig | str | Path, overrides: Iterable[str]) -> Rig:
    """The rig given, loaded; what is wrong with it or with the overrides is said once, before any log is opened."""
    from tbmfg.estimators import check_switches

    loaded = rig if isinstance(rig, Rig) else load_rig(rig)
    check_switches(override(loaded, list(overrides)))
    return loaded


# ---- one job ----


def do(job: Job) -> Outcome:
    """Run one job in a worker. Never raises: what goes wrong is the reason of a failed one."""
    try:
        return _do(job)
    except Exception as error:
        return failed(job, error)


def _do(job: Job) -> Outcome:
    if job.version != __version__:
        raise TbmfgError(f"this worker has tbmfg {__version__}, the batch was started by {job.version}")
    output = storage.place(job.output)
    inputs, before = job.inputs(), _read(output / JOB)
    finished = before.get("finished", False)
    last = output / (SUMMARY if len(job.estimators) == 1 else pipeline.COMPARISON)
    if finished and before["inputs"] == inputs and last.exists():
        return Outcome(job.name, job.log, job.output, KEPT, results=tuple(before["results"]))
    if finished and not job.force:
        other = ", ".join(key for key in inputs if inputs[key] != before["inputs"].get(key)) or "missing files"
        raise TbmfgError(f"{output}: holds results of other inputs ({other}); give another folder, or --force")
    if not before:
        refuse_existing(output, job.force)
    _write(output / JOB, {"finished": False, "inputs": inputs})
    rig = None if job.rig is None else parse_rig(job.rig, "the rig of this batch")
    common = {"rig": rig, "output": output, "force": True, **job.options}
    if len(job.estimators) == 1:
        summaries = {job.estimators[0]: pipeline.run(job.log, estimator=job.estimators[0], **common)}
    else:
        summaries = pipeline.compare(job.log, estimators=job.estimators, **common)
    results = tuple(figures(name, summary) for name, summary in summaries.items())
    _write(output / JOB, {"finished": True, "inputs": inputs, "results": results})
    return Outcome(job.name, job.log, job.output, DONE, results=results)


def failed(job: Job, error: BaseException) -> Outcome:
    if isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker":  # the latter is Dask's
        error = TbmfgError("the worker process died twice (out of memory, or killed); try it alone with tbmfg run")
    return Outcome(job.name, job.log, job.output, FAILED, reason(error))


def figures(estimator: str, summary: dict[str, Any]) -> dict[str, Any]:
    """The part of a summary that a table of many logs shows."""
    if "not_run" in summary:
        return {"estimator": estimator, "not_run": summary["not_run"]}
    metrics = summary["metrics"] or {}
    return {
        "estimator": estimator,
        **{name: summary[name] for name in FIGURES},
        "warnings": len(summary["warnings"]),
        **{name: metrics.get(name) for name in METRICS},
    }


def _read(file: Place) -> dict[str, Any]:
    """What a job left; nothing where there is no such file, or none that can be read."""
    try:
        return json.loads(file.read_text("utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return {}


def _write(file: Place, content: dict[str, Any]) -> None:
    storage.write_text(file, to_json(content))


def table(logs: Iterable[dict[str, Any]]) -> str:
    """Outcomes as CSV: a row per log and estimator, a single one for a log that failed."""
    columns = ("name", "log", "status", "reason", "estimator", "not_run", *FIGURES, "warnings", *METRICS)
    out = io.StringIO(newline="")
    writer = csv.DictWriter(out, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for log in logs:
        writer.writerows([{**log, **result} for result in log["results"] or [{}]])
    return out.getvalue()


# ---- which logs ----


def find_logs(arguments: Iterable[str | os.PathLike], output: Place) -> list[str]:
    """Logs that files, rosbag2 folders, folders of logs, patterns and URLs name, each once, in the order given.

    A folder is searched through all levels; results (folders with a summary.json), hidden folders and ``output`` are
    passed over. Raises TbmfgError for an argument that names no log; a file that is not there fails as a job.
    """
    found: dict[str, None] = {}
    output = storage.absolute(output)
    for argument in map(str, arguments):
        logs = [log for at in _expanded(argument) for log in _logs_at(storage.absolute(at), output)]
        if not logs:
            raise TbmfgError(f"{argument}: no .mcap file and no rosbag2 folder there")
        found.update(dict.fromkeys(map(str, logs)))
    return list(found)


def _expanded(argument: str) -> list[Place]:
    """The places that a pattern matches, or the one that is named; a name that exists is not a pattern."""
    at = storage.place(argument)
    if not has_magic(argument) or at.exists():
        return [at]
    if isinstance(at, Path):
        return [Path(match) for match in sorted(glob(str(at), recursive=True))]
    return [storage.place(at.fs.unstrip_protocol(match)) for match in sorted(at.fs.glob(at.path))]


def _logs_at(at: Place, output: Place) -> Iterator[Place]:
    if not storage.is_folder(at) or (at / "metadata.yaml").is_file():
        yield at
        return
    if (at / SUMMARY).is_file():
        return
    for entry in sorted(at.iterdir(), key=str):
        folder = storage.is_folder(entry)
        if entry.name.startswith(".") or entry == output or (folder and entry.is_symlink()):  # a link may lead back
            continue
        if folder or entry.suffix == ".mcap":
            yield from _logs_at(entry, output)


def named(logs: Sequence[str]) -> dict[str, str]:
    """A name for each log, unique whatever the case of its letters: the file's, with as many of its folders before it
    as it takes."""
    parts = {log: _parts(log) for log in logs}
    depth = dict.fromkeys(logs, 1)
    while True:
        names = {log: "-".join(parts[log][-depth[log] :]) for log in logs}
        often = Counter(name.casefold() for name in names.values())
        alike = [log for log in logs if often[names[log].casefold()] > 1]
        deeper = [log for log in alike if depth[log] < len(parts[log])]
        if not deeper:
            break
        for log in deeper:
            depth[log] += 1
    for number, log in enumerate(alike, 1):  # folders that differ by a dash or a capital only
        names[log] = f"{names[log]}-{number}"
    return {names[log]: log for log in logs}


def _parts(log: str) -> list[str]:
    """Folders of a log and its name without .mcap; of a URL the host or bucket comes first."""
    url = urlsplit(log) if "://" in log else None
    at = PurePosixPath(url.netloc, url.path.lstrip("/")) if url else PurePath(log)
    *folders, name = at.relative_to(at.anchor).parts
    return [*folders, name.removesuffix(".mcap")]
