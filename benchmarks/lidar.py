"""What a LiDAR is worth in a tunnel that tells nothing of the way along it, and whether the estimate knows.

Simulated logs of ``tbm-tunnel`` in three settings: ``calibrated``, an odometer known to 0.3 %; ``vague``, the same with
a prior of 1.5 %; ``inertial``, no odometer. Beside the estimators stands ``fixed``: ``batch`` with KISS-ICP as it
comes, its poses taken with 1 cm and 0.1 deg in every direction. Over the seeds, at the end of the logs:

end_error              distance from the truth in % of the way; worst_end_error the largest, asked to be below 1 %, or
                       where that is more worst_told: what by their covariances it stays below in 95 % of such commands
end_rms, end_sd        its RMS, and what the covariance says of it: the first heading, 0.3 deg, is 0.5 % across
along, along_sd        RMS error along the tunnel, and what the covariance says of it
along_z                square of that error over its sd: 1 expected; bounds by chance in 1 % of the commands together
kiss_way               share of the true way that KISS-ICP alone sees
weak                   share of the scans in which a direction was found to be untold
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.rows import Row
from benchmarks.runs import in_memory, points_of, true_states
from benchmarks.workers import run_all
from tbmfg.state import POS
from tbmfg.timeseries import Floats

if TYPE_CHECKING:
    from datasets.simulate import Simulation
    from tbmfg.problem import Problem

SCENARIOS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {  # settings of the rig, sensors left out
    "calibrated": ((), ()),
    "vague": (("sensors.odometer.scale_sd=0.015",), ()),
    "inertial": ((), ("odometer",)),
}
FIXED_SD = np.repeat([np.deg2rad(0.1), 0.01], 3)
CHANCE = 0.01
WORST = 1.0  # % of the way
CONFIDENCE, DRAWS = 0.95, 20_000


@dataclass(frozen=True, slots=True)
class Job:
    """One log and who estimates it."""

    scenario: str
    seed: int
    duration_s: float
    options: dict[str, Any]
    estimators: tuple[str, ...]


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scenario", action="append", choices=list(SCENARIOS), help="repeatable (all)")
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="how many logs (10)")
    parser.add_argument("--first-seed", type=int, default=0, metavar="N")
    parser.add_argument("--duration", type=float, default=60.0, metavar="S", help="of each log (60)")
    parser.add_argument("--columns", type=int, default=600, metavar="N", help="of 16 points in a scan (600)")
    parser.add_argument("--walls", default="smooth", help="smooth or ribbed (smooth)")
    parser.add_argument("--imu-rate", type=float, default=200.0, metavar="HZ", help="(200)")
    parser.add_argument("--estimators", default="batch,ins", metavar="A,B", help="(batch,ins)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows of all scenarios."""
    scenarios = given.scenario or list(SCENARIOS)
    dataset = {"columns": given.columns, "walls": given.walls, "imu_rate_hz": given.imu_rate}
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    names = tuple(given.estimators.split(","))
    jobs = [Job(scenario, seed, given.duration, dataset, names) for scenario in scenarios for seed in seeds]
    done = run_all(run, jobs, given.jobs, "lidar")
    rows = []
    for scenario in scenarios:
        results = [result for job, result in zip(jobs, done, strict=True) if job.scenario == scenario]
        for name in (*names, "fixed"):
            rows += _rows(scenario, name, [result[name] for result in results], len(scenarios) * len(names))
        shared = [result["scans"] for result in results]
        for metric in ("kiss_way", "weak"):
            rows.append(_row(scenario, "KISS-ICP", metric, "%", [100.0 * one[metric] for one in shared]))
    return rows


def run(job: Job) -> dict[str, dict[str, float]]:
    """Errors at the end of one log, by estimator, and of its scans."""
    import datasets
    from tbmfg.estimators import estimate
    from tbmfg.prepare import prepare

    settings, without = SCENARIOS[job.scenario]
    simulation = datasets.make("tbm-tunnel", seed=job.seed, duration=job.duration_s, settings=settings, **job.options)
    problem = prepare(in_memory(simulation), simulation.rig, without=without)
    [lidar] = [rows for rows in problem.rows if rows.model == "lidar"]
    T_kiss = kiss_poses(simulation)
    truth = simulation.truth(np.array([0.0, job.duration_s])).position
    way = float(np.linalg.norm(truth[1] - truth[0]))
    roots = problem.samples[lidar.sensor].values[:, 12:].reshape(-1, 6, 6)
    weak = float(np.mean(np.linalg.matrix_rank(roots[1:], rtol=1e-9) < 6))
    out = {"scans": {"kiss_way": float(np.linalg.norm(T_kiss[-1, :3, 3])) / way, "weak": weak}}
    for name in job.estimators:
        out[name] = _at_end(simulation, estimate(name, problem), way)
    out["fixed"] = _at_end(simulation, estimate("batch", with_fixed_steps(problem, T_kiss)), way)
    return out


def kiss_poses(simulation: Simulation) -> Floats:
    """KISS-ICP by itself on the scans, with its own motion compensation: (n, 4, 4) at the scans' last points."""
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.mapping.voxel_size = simulation.rig.sensors["lidar"].voxel
    kiss, poses = KissICP(config), []
    for _, fields in simulation.clouds[0]:
        kiss.register_frame(points_of(fields), fields["time"].astype(float))
        poses.append(kiss.last_pose)
    return np.array(poses)


def with_fixed_steps(problem: Problem, T: Floats) -> Problem:
    """The problem with the steps between poses ``T`` (n, 4, 4) in place of its own, all alike certain. Only a scan
    that outlasts the IMU's samples may be missing in it."""
    rows = []
    for one in problem.rows:
        if one.model == "lidar":
            scans = problem.samples[one.sensor]
            which = np.flatnonzero(scans.values[1:, 12:].any(axis=1))
            if not len(T) - 1 <= len(scans.t_s) <= len(T) or len(which) != len(one):
                raise ValueError(f"{len(T)} poses and {len(one)} rows do not belong to {len(scans.t_s)} scans")
            step = np.linalg.inv(T[which]) @ T[which + 1]
            data = one.data.copy()
            data[:, 35:] = np.diag(1 / FIXED_SD).ravel()
            one = replace(one, z=np.hstack([step[:, :3, :3].reshape(-1, 9), step[:, :3, 3]]), data=data)
        rows.append(one)
    return replace(problem, rows=rows)


def _at_end(simulation: Simulation, result, way: float) -> dict[str, float]:
    path = result.trajectory
    error = path.position_n[-1] - true_states(simulation, path.t_ns[-1:]).position_n[0]
    along_sd = float(np.sqrt(path.cov[-1, 3, 3]))  # the tunnel lies along n's x axis
    sds = 100.0 / way * np.sqrt(np.linalg.eigvalsh(path.cov[-1, POS, POS]))
    told = {f"end_sd_{k}": float(sd) for k, sd in enumerate(sds)}  # along the axes of the ellipsoid
    return {"end": 100.0 * float(np.linalg.norm(error)) / way, "along": float(error[0]), "along_sd": along_sd, **told}


def worst_told(sds: Floats) -> float:
    """What the largest of n distances stays below with CONFIDENCE, their errors normal with sds (n, 3)."""
    drawn = np.random.default_rng(0).standard_normal((DRAWS, *sds.shape)) * sds
    return float(np.quantile(np.linalg.norm(drawn, axis=2).max(axis=1), CONFIDENCE))


def _rows(scenario: str, name: str, results: list[dict[str, float]], cells: int) -> list[Row]:
    from tbmfg.evaluation.metrics import chi_square_bounds

    end, along, sd = (np.array([result[key] for result in results]) for key in ("end", "along", "along_sd"))
    told = np.array([[result[f"end_sd_{k}"] for k in range(3)] for result in results])
    worst = worst_told(told)
    asked = (None, max(WORST, worst)) if scenario == "calibrated" and name != "fixed" else None
    low, high = chi_square_bounds(len(results), 1, CHANCE / cells)
    return [
        _row(scenario, name, "end_error", "%", end),
        Row(scenario, name, "worst_end_error", "%", float(end.max()), None, len(end), asked),
        Row(scenario, name, "worst_told", "%", worst, None, len(end)),
        Row(scenario, name, "end_rms", "%", float(np.sqrt(np.mean(end**2))), None, len(end)),
        Row(scenario, name, "end_sd", "%", float(np.sqrt(np.mean(np.sum(told**2, axis=1)))), None, len(end)),
        Row(scenario, name, "along", "m", float(np.sqrt(np.mean(along**2))), None, len(end)),
        Row(scenario, name, "along_sd", "m", float(np.sqrt(np.mean(sd**2))), None, len(end)),
        _row(scenario, name, "along_z", "", (along / sd) ** 2, None if name == "fixed" else (low, high)),
    ]


def _row(scenario: str, name: str, metric: str, unit: str, values, bound=None) -> Row:
    values = np.asarray(values, dtype=float)
    sd = float(values.std(ddof=1)) if len(values) > 1 else None
    return Row(scenario, name, metric, unit, float(values.mean()), sd, len(values), bound)
