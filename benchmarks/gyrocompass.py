"""North found by the gyro alone: how far off, and whether the covariance and theory say so.

A roadheader with a fibre-optic unit stands still, its heading unknown, the gyro's bias drawn anew for every seed. What
the bias feigns of the Earth's rate to the east is all that is left after minutes: bias / (w cos lat), Groves (2013)
sec. 5.6.2. At the end of each log:

heading            error, RMS over the seeds
heading_sd         what the covariance says of it; bound: theory within 10 %
heading_within_3sd share of seeds whose error is within 3 of these sd; bound: 99 %
failed             seeds without a result
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

import numpy as np

from benchmarks.rows import Row
from benchmarks.runs import in_memory, true_states
from benchmarks.workers import run_all
from tbmfg.errors import TbmfgError

SCENARIO = "tbm-static"
OPTIONS = {"imu_rate_hz": 50.0, "prism_rate_hz": 1.0}
TOLERANCE = 0.1  # of the sd against theory
SHARE = 99.0  # % within 3 sd


@dataclass(frozen=True, slots=True)
class Job:
    """A log to simulate, and who estimates it."""

    seed: int
    duration_s: float
    estimators: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Found:
    """Heading at the end of one log, and what theory says of it, all in rad; ``failure``: why there is none."""

    estimator: str
    seed: int
    error: float
    sd: float
    theory: float
    failure: str = ""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=4, metavar="N", help="how many logs (4; a study takes 100)")
    parser.add_argument("--duration", type=float, default=600.0, metavar="S", help="of each log (600)")
    parser.add_argument("--estimators", default="batch,ins", metavar="A,B", help="(batch,ins)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows of all estimators; failed seeds are told on stderr."""
    if min(given.seeds, given.jobs) < 1:
        raise TbmfgError(f"--seeds {given.seeds} --jobs {given.jobs}: each should be 1 or more")
    names = tuple(given.estimators.split(","))
    jobs = [Job(seed, given.duration, names) for seed in range(given.seeds)]
    found = [one for group in run_all(run, jobs, given.jobs, "gyrocompass") for one in group]
    for one in found:
        if one.failure:
            print(f"{SCENARIO}, {one.estimator}, seed {one.seed}: {one.failure}", file=sys.stderr)
    return [row for name in names for row in summarise([one for one in found if one.estimator == name])]


def run(job: Job) -> list[Found]:
    """Simulate, estimate with each, look at the last heading."""
    import datasets
    from tbmfg.estimators import estimate
    from tbmfg.evaluation.metrics import trajectory_errors
    from tbmfg.geometry import split_yaw_tilt
    from tbmfg.inertial.alignment import gyrocompass_bound
    from tbmfg.prepare import prepare

    simulation = datasets.make(SCENARIO, seed=job.seed, duration=job.duration_s, **OPTIONS)
    rig, found = simulation.rig, []
    theory = gyrocompass_bound(rig.imu.gyro_bias_sd, rig.origin.rate_n)
    problem = None
    for name in job.estimators:
        try:
            problem = problem or prepare(in_memory(simulation), rig)
            path = estimate(name, problem).trajectory
        except TbmfgError as error:
            found.append(Found(name, job.seed, np.nan, np.nan, theory, str(error)))
            continue
        errors = trajectory_errors(path, true_states(simulation, path.t_ns))
        yaw, _ = split_yaw_tilt(errors.rotation_n)
        up_b = path.rotations()[-1, 2]
        found.append(Found(name, job.seed, float(yaw[-1]), float(np.sqrt(up_b @ path.cov[-1, :3, :3] @ up_b)), theory))
    return found


def summarise(found: list[Found]) -> list[Row]:
    """The rows of one estimator."""
    good, estimator = [one for one in found if not one.failure], found[0].estimator
    failed = len(found) - len(good)
    rows = [Row(SCENARIO, estimator, "failed", "seeds", failed, None, len(found), (None, 0))]
    if not good:
        return rows
    error, sd = np.array([one.error for one in good]), np.array([one.sd for one in good])
    theory, n = 1e3 * good[0].theory, len(good)
    limits = (1.0 - TOLERANCE) * theory, (1.0 + TOLERANCE) * theory
    return [
        *rows,
        Row(SCENARIO, estimator, "heading", "mrad", 1e3 * float(np.sqrt(np.mean(error**2))), None, n),
        Row(SCENARIO, estimator, "heading_sd", "mrad", 1e3 * float(sd.mean()), 1e3 * float(sd.std()), n, limits),
        Row(
            SCENARIO, estimator, "heading_within_3sd", "%", 100.0 * float(np.mean(np.abs(error) < 3.0 * sd)), None, n,
            (SHARE, None),
        ),
    ]  # fmt: skip
