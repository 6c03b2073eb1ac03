"""Attitude of a hand-held unit by IMU and magnetometer alone, against cameras (BROAD; recordings not part of this).

Each trial goes through an MCAP log and the rig ``broad``, like any log. Errors as the dataset defines them, Laidig,
Caruso, Cereatti, Seel (2021), over the keyframes in its phases of movement where the cameras saw the unit:

total         angle of the rotation between truth and estimate, RMS
heading       its part about the vertical
inclination   the tilt that is left
nees          squared error over its covariance, the three together, per degree of freedom: 1 expected
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.rows import Row
from tbmfg.errors import TbmfgError

MEAN = "mean"


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sources", nargs="+", type=Path, metavar="NPZ", help="trials, or folders of them")
    parser.add_argument("--estimators", default="batch,ins", metavar="A,B", help="(batch,ins)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments", help="of the rig"
    )


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows by trial, and the means over the trials."""
    files = [
        file for source in given.sources for file in (sorted(source.glob("*.npz")) if source.is_dir() else [source])
    ]
    if not files:
        raise TbmfgError(f"{', '.join(map(str, given.sources))}: no npz file")
    rows = [row for file in files for row in one_trial(file, given.estimators.split(","), given.assignments)]
    return rows + list(_means(rows)) if len(files) > 1 else rows


def one_trial(file: Path, estimators: list[str], assignments: list[str]) -> list[Row]:
    from datasets.recordings import broad
    from tbmfg.evaluation.metrics import nees, trajectory_errors
    from tbmfg.geometry import split_yaw_tilt
    from tbmfg.pipeline import open_session
    from tbmfg.state import ROT

    with TemporaryDirectory() as folder:
        log = Path(folder) / "trial.mcap"
        broad.load(file).write(log)
        session = open_session(log, overrides=assignments)
        rows = []
        for name in estimators:
            result, _ = session.estimate(name)
            truth = session.truth(result)
            errors = trajectory_errors(result.trajectory, truth)
            heading, inclination = split_yaw_tilt(errors.rotation_n)
            parts = {"total": np.linalg.norm(errors.rotation_b, axis=1), "heading": heading, "inclination": inclination}
            values = {(part, "deg"): np.degrees(np.sqrt(np.mean(error**2))) for part, error in parts.items()}
            cov = result.trajectory.cov[errors.rows, ROT, ROT]
            values["nees", "per dof"] = np.mean(nees(errors.rotation_b, cov)) / 3.0
            rows += [Row(file.stem, name, *key, float(value), None, 1) for key, value in values.items()]
    return rows


def _means(rows: list[Row]) -> Iterator[Row]:
    """Mean and sd over the trials of each metric."""
    for estimator, metric, unit in dict.fromkeys((row.estimator, row.metric, row.unit) for row in rows):
        values = [row.mean for row in rows if (row.estimator, row.metric) == (estimator, metric)]
        yield Row(MEAN, estimator, metric, unit, float(np.mean(values)), float(np.std(values, ddof=1)), len(values))
