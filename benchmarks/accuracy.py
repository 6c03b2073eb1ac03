"""How far estimates are from the truth of simulated logs, and whether their covariances say so.

Every seed is a new draw of all noises, of all calibrations and of the initial state from the rig's priors, prepared
once and given to each estimator. Per scenario and estimator, over the seeds:

position .. velocity   RMS errors over the keyframes; ``ape`` after rigid alignment. ``position`` is that of the body
                       and holds the part of the lever arm that the log cannot tell; its bound is the position
                       sensor's own noise, sqrt(3) sd
position_over_bound .. RMS errors over their Cramer-Rao bound, of smoothing or of filtering, pooled over the seeds: the
                       root of the mean squared ratio, 1 expected of what is efficient. ``_low`` is the lower end of
                       what it may be with 95 %; held to LIMITS where all errors are drawn from the model
position_sd            what the covariance says of ``position``, RMS
prism_point            RMS error of the tracked point, position + R arm with the estimated arm; bound as of ``position``
nees_pose@T            squared error of the 6-dof pose over its covariance at T s, divided by 6. The runs are
                       independent, so its mean lies in chi-square bounds; all such cells of the command together
                       leave theirs by chance in 1 % of the commands
nees_rotation ..       the same for three components each, mean over the epochs of a run: 1 expected
within_1sd ..          share of the errors of rotation and position within 1, 2, 3 sd: 68.3, 95.4, 99.7 % expected
calibrations_within_3sd  share of all calibrations of all seeds, 99.7 % expected, held to CALIBRATED
z_..                   error of a calibration over its sd: mean 0, sd 1 expected (gyro bias: at the end)
nis_.., gated_..       mean squared normalised residual per degree of freedom of what was accepted, and the share
                       that was not; below 1 in a smoother, whose residuals have had the data fitted to them
failed                 seeds without a result

``--corrupt`` asks instead what becomes of logs with faults drawn at random; see :mod:`benchmarks.corrupt`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable

import numpy as np

from benchmarks import corrupt
from benchmarks.gate import Tolerance
from benchmarks.rows import Row
from benchmarks.runs import Job, Measured, run
from benchmarks.workers import run_all
from datasets import MACHINES
from datasets.__main__ import sort
from tbmfg.errors import TbmfgError

SCENARIOS = {
    "tbm-drive": ("tbm-drive", ()),
    # every error a draw from the estimators' model
    "tbm-drive-nominal": ("tbm-drive", ("vibration=0", "slide=1", "sensors.imu.noise_factor=1")),
    # the same, of a machine whose sensors were bolted on without measuring
    "tbm-drive-unknown": (
        "tbm-drive",
        (
            "vibration=0",
            "slide=1",
            "sensors.imu.noise_factor=1",
            "sensors.prism.clock_offset_sd_s=0.02",
            "sensors.prism.clock_drift_sd_ppm=10",
            "sensors.odometer.mounting_sd_deg=0.5",
            "sensors.magnetometer.declination_sd_deg=2",
            "sensors.magnetometer.hard_iron_sd_ut=1",
        ),
    ),
    "shearer-cut": ("shearer-cut", ()),
    "shaft-dynamic-nominal": ("shaft-dynamic", ("nominal=1", "sensors.imu.noise_factor=1")),
    "shaft-descend-nominal": ("shaft-descend", ("nominal=1", "sensors.imu.noise_factor=1")),
}
NOMINAL = ("tbm-drive-nominal", "tbm-drive-unknown", "shearer-cut", "shaft-descend-nominal")
LIMITS = {"batch": 1.05, "ins": 1.15}  # of errors over their bounds
JUDGED = ("position", "attitude")
CONFIDENCE = 1.645  # standard errors below the mean that 95 % lie above
CALIBRATED = 99.0  # % of calibrations within 3 sd
CHANCE = 0.01  # of a false alarm in all NEES cells of a command together
GATE = {
    "scenario": ["tbm-drive", "tbm-drive-nominal", "shearer-cut", "shaft-descend-nominal"],
    "seeds": 6,
    "first_seed": 0,
    "duration": 30.0,
    "epochs": 3,
    "assignments": [],
    "corrupt": False,
    "without": "",
    "estimators": "batch,fixed-lag,ins",
}


def options(parser: argparse.ArgumentParser) -> None:
    names = ", ".join(SCENARIOS)
    parser.add_argument("--scenario", action="append", metavar="NAME", help=f"repeatable; or a dataset ({names})")
    parser.add_argument("--seeds", type=int, default=30, metavar="N", help="how many logs (30)")
    parser.add_argument("--first-seed", type=int, default=0, metavar="N")
    parser.add_argument("--duration", type=float, default=120.0, metavar="S", help="of each log (120)")
    parser.add_argument("--epochs", type=int, default=6, metavar="N", help="times at which consistency is tested (6)")
    parser.add_argument("--estimators", default="batch,ins", metavar="A,B", help="(batch,ins)")
    parser.add_argument("--without", default="", metavar="A,B", help="sensors that the estimators do not get")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")
    parser.add_argument("--corrupt", action="store_true", help="faults drawn at random: does every log end well?")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="assignments",
        help="over the scenario: an option of the dataset, or with dots a value of its rig",
    )


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows of all scenarios; failed seeds are told on stderr."""
    if given.corrupt:
        return survived(given)
    scenarios = given.scenario or list(SCENARIOS)
    jobs = [job for scenario in scenarios for job in make_jobs(scenario, given)]
    measured = [one for group in run_all(run, jobs, given.jobs, "accuracy") for one in group]
    for one in measured:
        if one.failure:
            print(f"{one.scenario}, {one.estimator}, seed {one.seed}: {one.failure}", file=sys.stderr)
    names = jobs[0].estimators
    alpha = CHANCE / (given.epochs * len(scenarios) * len(names))
    groups = [[one for one in measured if (one.scenario, one.estimator) == (s, e)] for s in scenarios for e in names]
    return [row for group in groups for row in summarise(group, alpha)]


def survived(given: argparse.Namespace) -> list[Row]:
    """What became of corrupted logs, machines by turns; what should not have is told on stderr."""
    names, seeds = known_estimators(given), range(given.first_seed, given.first_seed + given.seeds)
    machines = given.scenario or corrupt.DATASETS
    if unknown := [name for name in machines if name not in MACHINES]:
        raise TbmfgError(f"--corrupt: no dataset {', '.join(unknown)}; there are {', '.join(MACHINES)}")
    if min(given.seeds, given.jobs) < 1:
        raise TbmfgError(f"--seeds {given.seeds} --jobs {given.jobs}: each should be 1 or more")
    jobs = [corrupt.Job(machines[seed % len(machines)], seed, given.duration, names) for seed in seeds]
    ended = [one for group in run_all(corrupt.run, jobs, given.jobs, "corrupted logs") for one in group]
    for one in ended:
        if one.said:
            print(f"{one.dataset}, {one.estimator}, seed {one.seed}: {one.outcome}: {one.said}", file=sys.stderr)
    return corrupt.rows(ended)


def known_estimators(given: argparse.Namespace) -> tuple[str, ...]:
    """Those asked for. Raises TbmfgError for a name that does not exist."""
    from tbmfg.estimators import ESTIMATORS

    estimators = tuple(given.estimators.split(","))
    unknown = [name for name in estimators if name not in ESTIMATORS]
    if unknown:
        raise TbmfgError(f"no estimator {', '.join(unknown)}; there are {', '.join(ESTIMATORS)}")
    return estimators


def make_jobs(scenario: str, given: argparse.Namespace) -> list[Job]:
    """One job per seed."""
    estimators = known_estimators(given)
    if scenario not in SCENARIOS and scenario not in MACHINES:
        raise TbmfgError(f"{scenario}: no such scenario; there are {', '.join({**SCENARIOS, **MACHINES})}")
    if min(given.seeds, given.epochs, given.jobs) < 1:
        raise TbmfgError(f"--seeds {given.seeds} --epochs {given.epochs} --jobs {given.jobs}: each should be 1 or more")
    dataset, assignments = SCENARIOS.get(scenario, (scenario, ()))
    settings, parameters = sort(dataset, [*assignments, *given.assignments])
    without = tuple(name for name in given.without.split(",") if name)
    return [
        Job(scenario, dataset, settings, parameters, seed, given.duration, estimators, without, given.epochs)
        for seed in range(given.first_seed, given.first_seed + given.seeds)
    ]


def summarise(measured: list[Measured], alpha: float) -> list[Row]:
    """The rows of one estimator in one scenario; ``alpha`` is the chance of a false alarm in one NEES cell."""
    from tbmfg.evaluation.metrics import chi_square_bounds

    scenario, estimator = measured[0].scenario, measured[0].estimator
    good = [one for one in measured if not one.failure]

    def row(metric: str, unit: str, values: Iterable[float], bound=None) -> Row:
        values = np.array(list(values))
        sd = float(values.std(ddof=1)) if len(values) > 1 else None
        return Row(scenario, estimator, metric, unit, float(values.mean()), sd, len(values), bound)

    failed = len(measured) - len(good)
    rows = [Row(scenario, estimator, "failed", "seeds", failed, None, len(measured), (None, 0))]
    if not good:
        return rows
    first = good[0]
    for name, unit in dict.fromkeys(key for one in good for key in one.metrics):  # a sensor may be silent in some logs
        limits = [one.limits[name] for one in good if name in one.limits]
        bound = (None, float(np.mean(limits))) if limits else None
        rows.append(row(name, unit, (one.metrics[name, unit] for one in good if (name, unit) in one.metrics), bound))
    for name in first.over:
        judged = scenario in NOMINAL and name in JUDGED
        ratios = [one.over[name] for one in good]
        rows += over_bound(scenario, estimator, name, ratios, LIMITS.get(estimator) if judged else None)
    dof = first.normalised.shape[1]
    low, high = chi_square_bounds(len(good), dof, alpha)
    for k, time_s in enumerate(first.epochs_s):
        nees = (one.nees[k] / dof for one in good)
        rows.append(row(f"nees_pose@{time_s:g}s", "per dof", nees, (low / dof, high / dof)))
    for part in first.parts:
        rows.append(row(f"nees_{part}", "per dof", (one.parts[part].mean() / 3 for one in good)))
    for k in (1, 2, 3):
        within = (100.0 * np.mean(np.abs(one.normalised) < k) for one in good)
        rows.append(row(f"within_{k}sd", "%", within))
    for name in dict.fromkeys(key for one in good for key in one.z):
        rows.append(row(f"z_{name}", "sd", (one.z[name] for one in good if name in one.z)))
    scores = np.array([z for one in good for name, z in one.z.items() if not name.startswith("bias_")])
    if len(scores):
        share = 100.0 * float(np.mean(np.abs(scores) < 3.0))
        bound = (CALIBRATED, None) if scenario in NOMINAL else None
        rows.append(Row(scenario, estimator, "calibrations_within_3sd", "%", share, None, len(scores), bound))
    return rows


def over_bound(scenario: str, estimator: str, name: str, ratios: list[float], limit: float | None) -> list[Row]:
    """Errors over their bound, pooled. With a ``limit``, which holds for them with two standard errors added, the lower
    end of a 95 % confidence interval too, for which it holds as it is."""
    squares, n = np.square(ratios), len(ratios)
    pooled = float(np.sqrt(squares.mean()))
    if n < 2:
        return [Row(scenario, estimator, f"{name}_over_bound", "", pooled, None, n)]
    sd = float(squares.std(ddof=1)) / (2.0 * pooled)  # of a root, from that of what is under it
    error = sd / np.sqrt(n)
    bound = None if limit is None else (None, limit + 2.0 * error)
    rows = [Row(scenario, estimator, f"{name}_over_bound", "", pooled, sd, n, bound)]
    if limit is not None:
        low = pooled - CONFIDENCE * error
        rows.append(Row(scenario, estimator, f"{name}_over_bound_low", "", low, None, n, (None, limit)))
    return rows


def tolerance(row: Row) -> Tolerance:
    """Seeds repeat exactly; what is allowed is what rounding may do through a search or a gate."""
    if row.unit in ("mm", "mm/s", "deg") or "_over_bound" in row.metric:
        return Tolerance(0.05, 0.0, one_sided=True)
    if row.metric == "failed":
        return Tolerance(0.0, 0.0, one_sided=True)
    if row.unit == "%":
        return Tolerance(0.0, 2.0)
    if row.unit == "sd":
        return Tolerance(0.0, 0.1)
    return Tolerance(0.1, 0.01)
