"""Recorded drives without any position: how far off the end is, in per cent of the way (recordings not part of this).

``comma`` a car for a minute, its wheel speeds, inertia and magnetometer, against the poses that come with it; ``husky``
a robot for six and a half minutes, its wheels' odometer and inertia, against its satellite fixes of metres. Satellite
fixes are hidden from the estimators. Which way n's axes lie is not known without them: every path is turned about its
start so that it fits the reference in the horizontal over the first tenth of the way.

dead reckoning  wheel speed along the gyro's heading, here in numpy: the turn about the vertical that the accelerometers
                show at the mean, less the gyro's mean while the wheels stand
end             horizontal distance from the reference at the end, over the way
rms             horizontal error over the log, over the way
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.rows import Row
from tbmfg.errors import EstimationError, TbmfgError
from tbmfg.timeseries import Floats, Series, seconds

if TYPE_CHECKING:
    from datasets.recordings import Recording

RECORDINGS = {"comma": {"gyro": "device"}, "husky": {}}  # what each importer is told
MAGNETIC = {"comma": ("sensors.magnetometer={topic: /magnetometer, declination_sd_deg: 180}",)}
ESTIMATORS = "shearer-sins-od,shearer-ckf,shearer-ckf-ar,shearer-afkf,ins,fixed-lag,batch"
TURNED = 0.1  # of the way
STANDING_MPS = 0.01


def options(parser: argparse.ArgumentParser) -> None:
    for name in RECORDINGS:
        parser.add_argument(f"--{name}", type=Path, metavar="NPZ", help=f"the recording, as datasets import {name}")
    parser.add_argument("--estimators", default=ESTIMATORS, metavar="A,B", help=f"({ESTIMATORS})")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments", help="of the rigs"
    )


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows of the recordings that are named."""
    sources = {name: getattr(given, name) for name in RECORDINGS if getattr(given, name)}
    if not sources:
        raise TbmfgError(f"name a recording: {', '.join(f'--{name} NPZ' for name in RECORDINGS)}")
    return [
        row
        for name, source in sources.items()
        for row in one_drive(name, source, given.estimators.split(","), given.assignments)
    ]


def one_drive(name: str, source: Path, estimators: list[str], assignments: list[str]) -> list[Row]:
    """Dead reckoning and the estimators; why one cannot is told on stderr."""
    from tbmfg.pipeline import open_session

    recording = importlib.import_module(f"datasets.recordings.{name}").load(source, **RECORDINGS[name])
    series = {part.topic: part for part in recording.log_series}
    at_s, reference = _reference(recording, series)
    way = _way(recording, series)
    rows = _rows(name, "dead reckoning", *reckoned(recording, series), at_s, reference, way)
    with TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        recording.write(log)
        overrides = [*MAGNETIC.get(name, ()), *assignments]
        session = open_session(log, without=("gnss",), overrides=overrides)
        for estimator in estimators:
            try:
                path = session.estimate(estimator)[0].trajectory
            except EstimationError as error:
                print(f"{name}, {estimator}: {error}", file=sys.stderr)
                continue
            t_s = seconds(path.t_ns, recording.log_series[0].t_ns[0])
            rows += _rows(name, estimator, t_s, path.position_n[:, :2], at_s, reference, way)
    return rows


def reckoned(recording: Recording, series: dict[str, Series]) -> tuple[Floats, Floats]:
    """Times (n,) s since the first IMU sample, and horizontal positions (n, 2) m."""
    imu, wheels = series[recording.rig.imu.topic], series[recording.rig.sensors["odometer"].topic]
    t_s, wheels_s = seconds(imu.t_ns, imu.t_ns[0]), seconds(wheels.t_ns, imu.t_ns[0])
    speed = np.interp(t_s, wheels_s, wheels["linear"][:, 0])
    up = imu["acc"].mean(axis=0) / np.linalg.norm(imu["acc"].mean(axis=0))
    standing = np.abs(speed) < STANDING_MPS
    rate = (imu["gyro"] - (imu["gyro"][standing].mean(axis=0) if standing.any() else 0.0)) @ up
    dt = np.diff(t_s, append=t_s[-1])
    heading = np.cumsum(rate * dt)
    step = (speed * dt)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    return t_s, np.cumsum(step, axis=0)


def _way(recording: Recording, series: dict[str, Series]) -> float:
    """Length by the wheels, m."""
    wheels = series[recording.rig.sensors["odometer"].topic]
    return float(np.trapezoid(np.abs(wheels["linear"][:, 0]), seconds(wheels.t_ns, wheels.t_ns[0])))


def _reference(recording: Recording, series: dict[str, Series]) -> tuple[Floats, Floats]:
    """Times (m,) s since the first IMU sample and horizontal positions (m, 2) m: the truth, or the satellite fixes."""
    from tbmfg import earth

    zero_ns = series[recording.rig.imu.topic].t_ns[0]
    if recording.rig.truth is not None:
        truth = series[recording.rig.truth.topic]
        return seconds(truth.t_ns, zero_ns), truth["position"][:, :2]
    fixes = series[recording.rig.sensors["gnss"].topic]
    llh = fixes["llh"][fixes["status"] >= 0] * [np.pi / 180, np.pi / 180, 1.0]
    ecef = np.array([earth.ecef_from_llh(one) for one in llh])
    across = (ecef - ecef[0]) @ earth.R_ne(llh[0, 0], llh[0, 1], 0.0).T
    return seconds(fixes.t_ns[fixes["status"] >= 0], zero_ns), across[:, :2]


def _rows(
    name: str, estimator: str, t_s: Floats, path: Floats, at_s: Floats, reference: Floats, way_m: float
) -> list[Row]:
    """Errors of a ``path`` at times ``t_s``, turned about its start onto the reference."""
    both = (at_s >= t_s[0]) & (at_s <= t_s[-1])
    found = np.column_stack([np.interp(at_s[both], t_s, path[:, axis]) for axis in range(2)]) @ [1.0, 1j]
    true = reference[both] @ [1.0, 1j]
    found, true = found - found[0], true - true[0]
    gone = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(found)))])
    first = gone <= TURNED * gone[-1]
    turn = np.vdot(found[first], true[first])
    error = np.abs(found * turn / np.abs(turn) - true)
    values = {"end": error[-1], "rms": np.sqrt(np.mean(error**2))}
    return [
        Row(name, estimator, metric, "% of way", 100.0 * float(value) / way_m, None, 1)
        for metric, value in values.items()
    ]
