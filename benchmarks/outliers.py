"""What fixes of a wrong reflector cost: roadheader logs whose errors are all drawn from the rig, without and with them.

``SHARE`` of the prism's fixes are of one other point, ``SIZE`` away, as ``python -m datasets corrupt`` makes them with
``--fault gross``; the same seeds, and so the same noise, in all scenarios.

position       RMS error of the body over the keyframes; ``position_loss`` by how much it grows against the logs without
point, ..loss  the same of the prism itself, which holds no doubt of the lever arm
gated_wrong    share of the wrong fixes farther than 5 sd from where the prism was that were gated
gated_sound    share of the sound fixes that were gated; chance gates 0.1 %
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.accuracy import SCENARIOS, known_estimators
from benchmarks.rows import Row
from benchmarks.runs import point_errors, true_states
from benchmarks.workers import run_all
from datasets.__main__ import sort
from tbmfg.errors import TbmfgError

SCENARIO, SENSOR = "tbm-drive-nominal", "prism"
LOSS = {0.1: 10.0, 0.3: 50.0}  # % of accuracy that may be lost to a share of the fixes
FAR_SD = 5.0
WRONG_GATED, SOUND_GATED = 99.0, 1.0  # %


@dataclass(frozen=True, slots=True)
class Job:
    """One log, without and with each share of wrong fixes, and who estimates it."""

    seed: int
    duration_s: float
    size_m: float
    shares: tuple[float, ...]
    estimators: tuple[str, ...]


Found = dict[tuple[float, str], dict[str, float]]  # by share and estimator: RMS errors, and fixes by what they were


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="how many logs (20)")
    parser.add_argument("--duration", type=float, default=120.0, metavar="S", help="of each log (120)")
    parser.add_argument("--size", type=float, default=2.0, metavar="M", help="how far off the other reflector is (2)")
    parser.add_argument("--share", type=float, action="append", metavar="P", help="repeatable (0.1 and 0.3)")
    parser.add_argument("--estimators", default="batch,ins", metavar="A,B", help="(batch,ins)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows by share and estimator."""
    if min(given.seeds, given.jobs) < 1:
        raise TbmfgError(f"--seeds {given.seeds} --jobs {given.jobs}: each should be 1 or more")
    shares, names = tuple(given.share or LOSS), known_estimators(given)
    jobs = [Job(seed, given.duration, given.size, shares, names) for seed in range(given.seeds)]
    found = run_all(run, jobs, given.jobs, "outliers")
    rows = []
    for share in (0.0, *shares):
        scenario = f"{share:.0%} of the fixes, {given.size:g} m off" if share else "no wrong fix"
        for name in names:
            rows += summarised(scenario, share, name, found)
    return rows


def summarised(scenario: str, share: float, name: str, found: list[Found]) -> list[Row]:
    """The rows of one estimator at one share; ``found`` by log. Those of ``batch`` are held to what is asked."""
    own, clean, n = [one[share, name] for one in found], [one[0.0, name] for one in found], len(found)
    asked = name == "batch"
    rows = []
    for metric in ("position", "point"):
        values = np.array([one[metric] for one in own])
        sd = float(values.std(ddof=1)) if n > 1 else None
        rows.append(Row(scenario, name, metric, "mm", float(values.mean()), sd, n))
        if share:
            before = np.array([one[metric] for one in clean])
            loss = 100.0 * float(np.sqrt(np.mean(values**2) / np.mean(before**2)) - 1.0)
            bound = (None, LOSS[share]) if asked and share in LOSS else None
            rows.append(Row(scenario, name, f"{metric}_loss", "%", loss, None, n, bound))
    for kind, bound in (("wrong", (WRONG_GATED, None)), ("sound", (None, SOUND_GATED))):
        gated, total = (sum(one[f"{part}{kind}"] for one in own) for part in ("gated_", ""))
        if total:
            held = bound if asked else None
            rows.append(Row(scenario, name, f"gated_{kind}", "%", 100.0 * gated / total, None, int(total), held))
    return rows


def run(job: Job) -> Found:
    """Simulate once; corrupt, estimate and measure at each share."""
    import datasets
    from datasets import faults
    from tbmfg.pipeline import open_session

    dataset, assignments = SCENARIOS[SCENARIO]
    settings, options = sort(dataset, list(assignments))
    simulation = datasets.make(dataset, seed=job.seed, duration=job.duration_s, settings=settings, **options)
    found = {}
    with TemporaryDirectory() as folder:
        clean, log = Path(folder) / "clean.mcap", Path(folder) / "log.mcap"
        simulation.write(clean)
        for share in (0.0, *job.shares):
            wrong = faults.Fault("gross", parameters={"share": share, "size": job.size_m})
            [told] = faults.corrupt(clean, log, [wrong], seed=job.seed)
            session = open_session(str(log))
            for name in job.estimators:
                found[share, name] = measured(simulation, session, session.estimate(name)[0], told["stamps_ns"])
    return found


def measured(simulation, session, result, wrong_ns: list[int]) -> dict[str, float]:
    """RMS errors [mm], and how many fixes were wrong and sound, and of those gated; those in between are none."""
    truth = true_states(simulation, result.trajectory.t_ns)
    off = np.linalg.norm(result.trajectory.position_n - truth.position_n, axis=1)
    point, _ = point_errors(simulation, session.prepared, result, truth)[SENSOR]
    found = {"position": 1e3 * float(np.sqrt(np.mean(off**2))), "point": 1e3 * point}
    samples, clean = session.prepared.samples[SENSOR], simulation.clean[SENSOR]
    gated = result.innovations[SENSOR].gated
    if not len(gated) == len(samples.values) == len(clean):
        raise TbmfgError(f"{len(clean)} fixes, {len(samples.values)} prepared, {len(gated)} used: they do not pair")
    far = np.linalg.norm(samples.values - clean["point"], axis=1) > FAR_SD * samples.sigma.max(axis=1)
    hit = np.isin(np.rint(samples.t_s * 1e9).astype(int) + session.prepared.t0_ns, wrong_ns)
    for kind, rows in (("wrong", hit & far), ("sound", ~hit)):
        found |= {kind: float(rows.sum()), f"gated_{kind}": float(gated[rows].sum())}
    return found
