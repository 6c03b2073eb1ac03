"""How well positions that are hidden on purpose are bridged, and whether the covariance says so (recordings).

``rtk`` a car's satellite fixes, 15 s of every minute from 100 s on, against the fixes that were hidden; ``mh01`` a
multirotor's prism, 10 s of every half minute, from 30 s and again from 40 s on, against the motion capture's track;
``euroc`` a prism made of the truth, 0.08 s late with 3 mm of noise, hidden for 20 s at 30 and at 60 s, and the IMU
gone for a second at 55 s. Nothing is told: clocks, arms and noise are found from the log.

outage         RMS of the 3-D error while positions are hidden, m
over_sd        that over what the covariance says of it: 1 expected
gap, ..        the same of the second without the IMU
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.accuracy import known_estimators
from benchmarks.rows import Row
from tbmfg.errors import EstimationError, TbmfgError
from tbmfg.timeseries import NS

Stretch = tuple[str, float, float]  # sensor, start, end in s
COVERED = (0.7, 1.3)  # of over_sd
PRISM = {"prism": "synthetic", "latency": 0.08, "noise": 0.003}


@dataclass(frozen=True, slots=True)
class Case:
    """A recording's dataset and what that is told, what is hidden, and what its error may be at most [m]."""

    dataset: str
    hidden: tuple[Stretch, ...]
    most_m: float | None = None
    options: dict[str, Any] = field(default_factory=dict)


def every(sensor: str, first_s: float, step_s: float, length_s: float, count: int) -> tuple[Stretch, ...]:
    """``count`` stretches."""
    return tuple((sensor, first_s + k * step_s, first_s + k * step_s + length_s) for k in range(count))


CASES = {
    "rtk": {"rtk": Case("rtk-drive", every("gnss", 100.0, 60.0, 15.0, 8), 0.30)},
    "mh01": {f"mh01 from {at} s": Case("euroc", every("prism", at, 30.0, 10.0, 5), 0.08) for at in (30, 40)},
    "euroc": {"euroc": Case("euroc", (*every("prism", 30.0, 30.0, 20.0, 2), ("imu", 55.0, 56.0)), options=PRISM)},
}


def options(parser: argparse.ArgumentParser) -> None:
    for name, cases in CASES.items():
        dataset = next(iter(cases.values())).dataset
        parser.add_argument(
            f"--{name}", type=Path, action="append", default=[], metavar="SRC", help=f"as datasets import {dataset}"
        )
    parser.add_argument("--estimators", default="batch,ins", metavar="A,B", help="(batch,ins)")


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows of the recordings that are named."""
    sources = {name: getattr(given, name) for name in CASES if getattr(given, name)}
    if not sources:
        raise TbmfgError(f"name a recording: {', '.join(f'--{name} SRC' for name in CASES)}")
    names = known_estimators(given)
    return [
        row
        for kind, paths in sources.items()
        for source in paths
        for name, case in CASES[kind].items()
        for row in rows_of(name if len(paths) == 1 else f"{name} {source.stem}", case, source, names)
    ]


def rows_of(scenario: str, case: Case, source: Path, names: tuple[str, ...]) -> Iterator[Row]:
    """Rows of one recording; why an estimator cannot is told on stderr. What is asked is asked of ``batch``."""
    import datasets
    from tbmfg.evaluation.metrics import evaluate, expected
    from tbmfg.pipeline import open_session

    with TemporaryDirectory() as folder:
        log = Path(folder) / "log.mcap"
        datasets.load(case.dataset, source, **case.options).write(log)
        session = open_session(log, outages=case.hidden)
        t0_ns = session.prepared.t0_ns
        for name in names:
            try:
                result = session.estimate(name)[0]
            except EstimationError as error:
                print(f"{scenario}, {name}: {error}", file=sys.stderr)
                continue
            truth = session.truth(result)
            for metric, is_gap, most in (("outage", False, case.most_m), ("gap", True, None)):
                stretches = [
                    (t0_ns + round(start * NS), t0_ns + round(end * NS))
                    for sensor, start, end in case.hidden
                    if (sensor == "imu") == is_gap
                ]
                if not stretches:
                    continue
                error_m, sd_m = (
                    of(result.trajectory, truth, stretches)["outage_position_rms_m"] for of in (evaluate, expected)
                )
                asked = name == "batch"
                bound = (None, most) if asked and most else None
                yield Row(scenario, name, metric, "m", error_m, None, len(stretches), bound)
                covered = COVERED if asked and most else None
                yield Row(scenario, name, f"{metric}_over_sd", "", error_m / sd_m, None, len(stretches), covered)
