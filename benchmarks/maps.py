"""How sharp a map along the estimate is beside one along the truth, in clean air and in dust, and what is left of dust.

Simulated logs of ``tbm-roadway``; each map as ``tbmfg map`` makes it, from a log on disk. Means over the seeds:

thickness              median sd of the points across the surface in a voxel of 0.25 m
ratio                  of that to the map along the truth
entropy                mean map entropy, in nats above that of the map along the truth
in_air                 share of the returns that were left out
off_before, off_walls  share of the returns, and of those in the map, farther than 0.15 m from the true walls
found                  share of the returns farther than that from the walls that were left out; along the truth
lost                   share of the returns at the walls that were left out; along the truth
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.rows import Row
from benchmarks.runs import true_states
from benchmarks.workers import run_all
from tbmfg.timeseries import Floats

if TYPE_CHECKING:
    from datasets.simulate import Simulation
    from tbmfg.lidar.air import Air
    from tbmfg.mapping import Placed
    from tbmfg.problem import Problem
    from tbmfg.state import Trajectory

OFF_M = 0.15  # five sds of the range noise
ASKED = (None, 1.1)  # of the ratio
UNITS = {"thickness": "mm", "ratio": "", "entropy": "nats"}  # else %


@dataclass(frozen=True, slots=True)
class Job:
    """One log, the estimators whose maps are made, and the folder of the pictures or None."""

    dust: float
    seed: int
    duration_s: float
    options: dict[str, Any]
    estimators: tuple[str, ...]
    pictures: Path | None


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dust", action="append", type=float, metavar="K", help="1/m; repeatable (0, 0.05, 0.2, 0.5)")
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="how many logs (2)")
    parser.add_argument("--duration", type=float, default=20.0, metavar="S", help="of each log (20)")
    parser.add_argument("--columns", type=int, default=300, metavar="N", help="of 16 points in a scan (300)")
    parser.add_argument("--imu-rate", type=float, default=200.0, metavar="HZ", help="(200)")
    parser.add_argument("--estimators", default="batch", metavar="A,B", help="(batch)")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="of the first seed's maps, as PNG")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows of every amount of dust."""
    dusts, names = given.dust or [0.0, 0.05, 0.2, 0.5], tuple(given.estimators.split(","))
    dataset = {"columns": given.columns, "imu_rate_hz": given.imu_rate}
    if given.pictures:
        given.pictures.mkdir(parents=True, exist_ok=True)
    jobs = [
        Job(dust, seed, given.duration, dataset, names, None if seed else given.pictures)
        for dust in dusts
        for seed in range(given.seeds)
    ]
    done = run_all(run, jobs, given.jobs, "maps")
    rows = []
    for dust in dusts:
        results = [result for job, result in zip(jobs, done, strict=True) if job.dust == dust]
        rows += [
            _row(f"dust {dust:g}" if dust else "clean", name, metric, [result[name][metric] for result in results])
            for name in ("truth", *names)
            for metric in results[0][name]
        ]
    return rows


def run(job: Job) -> dict[str, dict[str, float]]:
    """What is told of the maps of one log, by estimator."""
    import datasets
    from datasets.lidar import raycasting
    from datasets.tbm_roadway import world
    from tbmfg import mapping
    from tbmfg.lidar import raster
    from tbmfg.mcap import read_log
    from tbmfg.prepare import prepare

    simulation = datasets.make("tbm-roadway", seed=job.seed, duration=job.duration_s, dust=job.dust, **job.options)
    walls, out = raycasting(world(job.seed)), {}
    with TemporaryDirectory() as folder:
        simulation.write(Path(folder) / "log.mcap")
        log = read_log(Path(folder) / "log.mcap")
        problem = prepare(log, simulation.rig)
        for name, path in _paths(simulation, problem, job.estimators).items():
            scans = partial(mapping.scans_in_n, log, simulation.rig, path)
            made = mapping.mapped(scans)
            sharp, thickness = made.sharpness, 1e3 * made.sharpness.thickness_m
            if name == "truth":
                best, best_mm = sharp, thickness
                out[name] = _told_apart(scans(), made.air, walls)
            out[name] = {
                "thickness": thickness,
                "ratio": thickness / best_mm,
                "entropy": sharp.entropy - best.entropy,
                "in_air": 100.0 * made.in_air / made.returns,
                **out.get(name, {}),
                "off_walls": 100.0 * float(_off(made.points, walls).mean()),
            }
            if job.pictures:
                file = job.pictures / f"dust{job.dust:g}-{name}.png"
                file.write_bytes(raster.png(raster.picture(made.points, path.position_n)))
    return out


def _paths(simulation: Simulation, problem: Problem, estimators: tuple[str, ...]) -> dict[str, Trajectory]:
    """The true trajectory at the keyframes, first, and the estimated ones."""
    from tbmfg.estimators import estimate

    paths = {name: estimate(name, problem).trajectory for name in estimators}
    path = paths[estimators[0]]
    true = true_states(simulation, path.t_ns)
    true_path = replace(path, position_n=true.position_n, quat_xyzw=true.quat_xyzw, velocity_n=true.velocity_n)
    return {"truth": true_path, **paths}


def _told_apart(scans: Iterator[Placed], air: Air, walls) -> dict[str, float]:
    """Of all returns, how the air's are told from the walls', in %."""
    counts = Counter()
    for scan in scans:
        off, out = _off(scan.points, walls), air.holds(scan.points)
        counts.update(off=off.sum(), found=(off & out).sum(), at=(~off).sum(), lost=(~off & out).sum())
    return {
        "off_before": 100.0 * counts["off"] / (counts["off"] + counts["at"]),
        "found": 100.0 * counts["found"] / max(counts["off"], 1),
        "lost": 100.0 * counts["lost"] / max(counts["at"], 1),
    }


def _off(points: Floats, walls) -> np.ndarray:
    """Which points (n, 3) lie off the walls."""
    return walls.compute_distance(points.astype(np.float32)).numpy() > OFF_M


def _row(scenario: str, name: str, metric: str, values: list[float]) -> Row:
    bound = ASKED if metric == "ratio" and name == "batch" else None
    sd = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Row(scenario, name, metric, UNITS.get(metric, "%"), float(np.mean(values)), sd, len(values), bound)
