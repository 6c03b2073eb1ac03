"""Logs corrupted at random, through every estimator: each ends in a result without a NaN, or in one line.

``python -m benchmarks accuracy --corrupt``: per log a machine, simulated for a few seconds, and one to four faults of
``datasets.faults`` on any of its topics, each from anywhere to anywhere, all drawn from the seed.

ended      results, of which every file was read back
refused    logs that end in one line of TbmfgError: nothing sound is left, or it contradicts itself
crashed    anything else that was raised
hung       not done after ``LIMIT_S`` of computing
unsound    results with a number that is none, in any file, or with counts that do not add up
"""

from __future__ import annotations

import contextlib
import json
import signal
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import numpy as np

from benchmarks.rows import Row
from tbmfg.errors import TbmfgError

DATASETS = ("tbm-drive", "shearer-cut", "shaft-descend", "tbm-roadway")
SMALL = {"tbm-roadway": {"columns": 60, "lidar_rate_hz": 2.0}}  # scans that take no time
OUTCOMES = ("ended", "refused", "crashed", "hung", "unsound")
COUNTED = {"bursts", "length", "reach"}  # parameters of faults that are numbers of messages
UNASKED = ("outage_position_rms_m", ".observed")  # null without an outage, of what is not estimated
LIMIT_S = 120.0  # of computing, for a log of seconds


@dataclass(frozen=True, slots=True)
class Job:
    """A log and who estimates it."""

    dataset: str
    seed: int
    duration_s: float
    estimators: tuple[str, ...]
    options: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Ended:
    """How one estimator ended on one log, and the words."""

    dataset: str
    estimator: str
    seed: int
    outcome: str
    said: str = ""


class Hung(BaseException):
    """Raised by the clock: nothing on the way is to take it for an error of its own."""


def run(job: Job) -> list[Ended]:
    """Simulate, corrupt, estimate, read back."""
    import datasets
    from datasets import faults

    ended, options = [], SMALL.get(job.dataset, {}) | job.options
    with tempfile.TemporaryDirectory() as folder:
        clean, log = Path(folder) / "clean.mcap", Path(folder) / "log.mcap"
        datasets.make(job.dataset, seed=job.seed, duration=job.duration_s, **options).write(clean)
        wanted = drawn(clean, job.seed, job.duration_s)
        faults.corrupt(clean, log, wanted, seed=job.seed)
        told = " ".join(f"{fault.kind}:{fault.topic}" for fault in wanted)
        for name in job.estimators:
            outcome, said = attempt(log, name, Path(folder) / name)
            ended.append(Ended(job.dataset, name, job.seed, outcome, f"{said} ({told})" if said else ""))
    return ended


def drawn(clean: Path, seed: int, duration_s: float) -> list:
    """One to four faults on topics of the log."""
    from datasets import faults
    from tbmfg.mcap import read_log

    rng = np.random.default_rng([seed, 1])
    log = read_log(clean)
    topics = sorted(topic for topic in (*log.series, *log.clouds) if "truth" not in topic)
    wanted = []
    for _ in range(rng.integers(1, 5)):
        kind = str(rng.choice(list(faults.KINDS)))
        start_s, end_s = np.sort(rng.uniform(0.0, duration_s, 2))
        parameters = {name: value * 10.0 ** rng.uniform(-1.0, 1.0) for name, value in faults.parameters(kind).items()}
        for name in COUNTED & parameters.keys():
            parameters[name] = max(round(parameters[name]), 1)
        if "share" in parameters:
            parameters["share"] = min(parameters["share"], 1.0)
        able = [topic for topic in topics if topic in log.series or kind in faults.STAMPS]
        wanted.append(faults.Fault(kind, str(rng.choice(able)), float(start_s), float(end_s), parameters))
    return wanted


def attempt(log: Path, name: str, folder: Path) -> tuple[str, str]:
    """How ``name`` ends on ``log``, and what was said of it."""
    from tbmfg import pipeline

    try:
        with _clock(LIMIT_S):
            pipeline.run_result(str(log), estimator=name, output=str(folder), report=True)
    except Hung:
        return "hung", f"not done after {LIMIT_S:g} s"
    except TbmfgError as error:
        return ("refused", "") if "\n" not in str(error) else ("crashed", f"more than a line: {error}")
    except Exception as error:  # whatever it is, it is what is looked for
        return "crashed", f"{type(error).__name__}: {error}"
    fault = unsound(folder)
    return ("unsound", fault) if fault else ("ended", "")


def unsound(folder: Path) -> str | None:
    """The first number that is none in the files of a result, or counts that do not add up."""
    from tbmfg.mcap import read_log

    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as arrays:
            for name, values in arrays.items():
                if values.dtype.kind == "f" and not np.isfinite(values).all():
                    return f"{path.name}: {name}"
            if "cov" in arrays and (np.diagonal(arrays["cov"], axis1=1, axis2=2) < 0).any():
                return f"{path.name}: a variance below zero"
    for path in sorted(folder.glob("*.tum")):
        if not np.isfinite(np.loadtxt(path)).all():
            return path.name
    for series in read_log(folder / "result.mcap").series.values():
        if series.counts.nonfinite:
            return f"result.mcap: {series.topic}"
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    for part in ("calibration", "metrics", "metrics_smoothed"):
        missing = (name for name in _missing(summary.get(part) or {}) if not name.endswith(UNASKED))
        if (name := next(missing, None)) is not None:
            return f"summary.json: {part}.{name}"
    for sensor, counts in summary["sensors"].items():
        if counts["received"] != sum(value for part, value in counts.items() if part != "received"):
            return f"summary.json: the counts of {sensor} do not add up"
    return None


def _missing(values: dict) -> Iterator[str]:
    """Names of what JSON has null for: what was no number."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from (f"{name}.{inner}" for inner in _missing(value))
        elif value is None or (isinstance(value, list) and None in value):
            yield name


@contextlib.contextmanager
def _clock(seconds: float) -> Iterator[None]:
    """Raise Hung after so much computing; waiting for a turn on a busy machine is none."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise Hung

    before = signal.signal(signal.SIGVTALRM, ring)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


def rows(ended: list[Ended]) -> list[Row]:
    """How many ended how, by machine and estimator; the last three are held to none."""
    found = []
    for dataset, name in dict.fromkeys((one.dataset, one.estimator) for one in ended):
        own = [one.outcome for one in ended if (one.dataset, one.estimator) == (dataset, name)]
        for outcome in OUTCOMES:
            bound = None if outcome in ("ended", "refused") else (None, 0.0)
            found.append(Row(f"{dataset}, corrupted", name, outcome, "logs", own.count(outcome), None, len(own), bound))
    return found
