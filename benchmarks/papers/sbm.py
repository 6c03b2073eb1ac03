"""Wang, Liu, Liu, Fu, Zhu (2019): a shaft boring machine's three filters, Tables 2 to 5, and the smoother beside them.

RMS over each log: pitch, roll and yaw (Table 2), displacement of the detector across the shaft (Table 3), depth and
speed of the cage (Tables 3 and 4). Of ``batch`` also ``.._true``, the RMS of the truth itself, which is the error of a
constant, and ``.._sd``, what its covariance says of its error.

classified             of the time that the dual coordinates' case and level are those of the true angles and spot, and
false_stop             of the time that they say stop and the true ones do not; both by the measured spot

.. over sbm-cfekf      the mean over that of the paper's proposed filter: what its tables can be compared by
.. in order            pairs of the three filters that stand as in the paper
.. over best filter    the mean over that of the best of the three. Its bound is what a smoother should reach where
                       something moves, one half (yaw: 1), and for a causal estimator 1; or 1.1 times what the
                       covariance of ``batch`` says that the log can tell, where that is more
cost                   Table 5: of one step over one of sbm-cf

While the machine stands or cuts on the spot a constant is a good estimate of its angles. ``shaft-dynamic``,
``shaft-descend`` and the cages are to be judged by; ``surveyed`` cages know the depth at the end to 5 cm.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING
from unittest.mock import patch

import numpy as np

from benchmarks.papers import Plan
from benchmarks.papers.trials import Method, Metrics, Outcomes, Trial
from benchmarks.rows import Row

if TYPE_CHECKING:
    from datasets.simulate import Simulation
    from tbmfg.problem import Problem
    from tbmfg.state import Result, Trajectory, Truth
    from tbmfg.timeseries import Floats

THREE = CF, EKF, CFEKF = "sbm-cf", "sbm-ekf", "sbm-cfekf"


def _switched(estimator: str, key: str, value: str) -> Method:
    return Method(f"{estimator} {key}={value}", estimator, (f"estimators.{estimator}.{key}={value}",))


FEW = tuple(Method(name, name) for name in (*THREE, "ins", "batch"))
ALL = (
    *FEW,
    Method("fixed-lag", "fixed-lag", every=4),  # it takes longer than all others together
    _switched(CFEKF, "coupling", "angle"),
    _switched(CF, "mag_mode", "yaw_only"),
    _switched(EKF, "predict", "printed"),
    _switched(EKF, "jac", "printed"),
)
UNITS = {"pitch": "deg", "roll": "deg", "yaw": "deg", "displacement": "cm", "depth": "m", "speed": "m/s"}
PLACE = ("pitch", "roll", "yaw", "displacement")
MEASURED = {  # by dataset
    "shaft-static": PLACE,
    "shaft-low": PLACE,
    "shaft-high": PLACE,
    "shaft-dynamic": PLACE,
    "shaft-descend": tuple(UNITS),
    "cage-fast": ("depth", "speed"),
    "cage-slow": ("depth", "speed"),
}
SCENARIOS: dict[str, tuple[str, dict[str, float], tuple[Method, ...]]] = {  # dataset, its options, who estimates it
    "static": ("shaft-static", {}, ALL),
    "low": ("shaft-low", {}, ALL),
    "high": ("shaft-high", {}, ALL),
    "dynamic": ("shaft-dynamic", {}, ALL),
    "descend": ("shaft-descend", {}, ALL),
    "fast cage": ("cage-fast", {}, ALL),
    "slow cage": ("cage-slow", {}, ALL),
    "fast cage, surveyed": ("cage-fast", {"survey_sd_m": 0.05}, FEW),
    "slow cage, surveyed": ("cage-slow", {"survey_sd_m": 0.05}, FEW),
}
JUDGED = ("dynamic", "descend", "fast cage", "slow cage", "fast cage, surveyed", "slow cage, surveyed")
SHARE = {"yaw": 1.0}  # of the best filter's error that a smoother should stay below; one half of the others

# Tables 2 to 4: of sbm-cf, sbm-ekf, sbm-cfekf
PUBLISHED = {
    "static": {"pitch": (0.07, 0.05, 0.02), "roll": (0.08, 0.07, 0.04), "yaw": (0.12, 0.11, 0.07)},
    "low": {
        "pitch": (1.93, 1.54, 0.26), "roll": (1.87, 1.48, 0.24), "yaw": (2.11, 1.75, 0.37),
        "displacement": (0.11, 0.06, 0.02),
    },
    "high": {
        "pitch": (3.13, 2.42, 0.51), "roll": (3.24, 2.35, 0.56), "yaw": (3.17, 2.47, 0.75),
        "displacement": (0.24, 0.15, 0.07),
    },
    "dynamic": {"pitch": (0.35, 0.26, 0.14), "roll": (0.47, 0.38, 0.23), "yaw": (3.52, 2.73, 1.16)},
    "fast cage": {"depth": (4.64, 3.22, 1.36), "speed": (0.23, 0.17, 0.06)},
    "slow cage": {"depth": (3.37, 2.15, 0.53), "speed": (0.16, 0.11, 0.03)},
}  # fmt: skip
COST = {EKF: 29.0, CFEKF: 31.0}  # Table 5, on the TMS320F28335
REPEATS = 7


def measure(plan: Plan) -> list[Row]:
    """Rows of Tables 2 to 5."""
    trials = [
        Trial(scenario, dataset, seed, plan.duration_s, methods, errors, options=options)
        for seed in plan.seeds
        for scenario, (dataset, options, methods) in SCENARIOS.items()
    ]
    outcomes = Outcomes.of(trials, plan.jobs, "sbm")
    rows = []
    for scenario, (dataset, _, _) in SCENARIOS.items():
        tables = PUBLISHED.get(scenario, {})
        published = {(name, metric): tables[metric][k] for metric in tables for k, name in enumerate(THREE)}
        rows += outcomes.rows(scenario, published, {})
        for metric in MEASURED[dataset]:
            rows += among_filters(outcomes, scenario, metric, tables.get(metric))
            rows += over_best_filter(outcomes, scenario, metric)
    return rows + cost()


def among_filters(outcomes: Outcomes, scenario: str, metric: str, published: tuple[float, ...] | None) -> list[Row]:
    """Ratios to the proposed filter, and how many of the three pairs stand as published."""
    mean = {name: outcomes.mean(scenario, name, metric) for name in THREE}
    n = len(outcomes.by_seed(scenario, CFEKF, metric))
    known = dict(zip(THREE, published, strict=True)) if published else {}
    rows = [
        Row(scenario, name, f"{metric} over {CFEKF}", "", mean[name] / mean[CFEKF], None, n, None,
            known[name] / known[CFEKF] if known else None)
        for name in (CF, EKF)
    ]  # fmt: skip
    if known:
        same = [mean[a] > mean[b] for a, b in ((CF, EKF), (EKF, CFEKF), (CF, CFEKF))]  # in all of the paper's tables
        rows.append(Row(scenario, CFEKF, f"{metric} in order", "of 3", float(sum(same)), None, n, None, 3.0))
    return rows


def over_best_filter(outcomes: Outcomes, scenario: str, metric: str) -> list[Row]:
    """The other estimators beside the best of the three."""
    best = min(outcomes.mean(scenario, name, metric) for name in THREE)
    floor = 1.1 * outcomes.mean(scenario, "batch", f"{metric}_sd") / best
    rows = []
    for name, share in (("ins", None), ("fixed-lag", 1.0), ("batch", SHARE.get(metric, 0.5))):
        n = len(outcomes.by_seed(scenario, name, metric))
        if not n:
            continue
        bound = (None, max(share, floor)) if share is not None and scenario in JUDGED else None
        ratio = outcomes.mean(scenario, name, metric) / best
        rows.append(Row(scenario, name, f"{metric} over best filter", "", ratio, None, n, bound))
    return rows


def errors(simulation: Simulation, result: Result, truth: Truth) -> Metrics:
    """RMS of what its dataset is measured by; of batch also that of the truth's angles and what the covariance says."""
    from tbmfg.geometry import matrix_from_quat

    path, R_true, detector = result.trajectory, matrix_from_quat(truth.quat_xyzw), detector_b(simulation)
    R, true = path.rotations(), angles_deg(R_true)
    off = angles_deg(R) - true
    off -= 360.0 * np.round(off / 360.0)
    across = path.position_n + R @ detector - truth.position_n - R_true @ detector
    found = {
        "pitch": off[:, 1],
        "roll": off[:, 2],
        "yaw": off[:, 0],
        "displacement": 100.0 * np.hypot(across[:, 0], across[:, 1]),
        "depth": path.position_n[:, 2] - truth.position_n[:, 2],
        "speed": path.velocity_n[:, 2] - truth.velocity_n[:, 2],
    }
    if result.estimator == "batch":
        found |= {f"{axis}_true": true[:, k] for axis, k in (("pitch", 1), ("roll", 2), ("yaw", 0))}
        found |= {f"{metric}_sd": sd for metric, sd in sds(result, detector).items()}
    asked = {name: name.partition("_")[0] for name in found if name.partition("_")[0] in MEASURED[simulation.name]}
    rms = {name: (float(np.sqrt(np.mean(found[name] ** 2))), UNITS[metric]) for name, metric in asked.items()}
    return rms | dual_coordinates(simulation, path, truth)


def dual_coordinates(simulation: Simulation, path: Trajectory, truth: Truth) -> Metrics:
    """How well a trajectory tells the machine's state; nothing of one without a laser."""
    from tbmfg.dual import STOP, deviation
    from tbmfg.measure import Samples
    from tbmfg.timeseries import seconds

    if not (lasers := simulation.rig.of_kind("laser")):
        return {}
    [(name, laser)] = lasers.items()
    measured = next(series for series in simulation.log_series if series.topic == laser.topic)
    states = []
    for series, at in ((measured, path), (simulation.clean[name], replace(path, quat_xyzw=truth.quat_xyzw))):
        spots = Samples(name, seconds(series.t_ns, path.t_ns[0]), series["point"][:, :2])
        states.append(deviation(at, spots, laser, simulation.rig.deviation, path.t_ns[0]))
    found, true = states
    both = np.isin(true.t_s, found.t_s)
    case, level = true.state.case[both], true.state.level[both]
    right = (found.state.case == case) & (found.state.level == level)
    stop = (found.state.level == STOP) & (level != STOP)
    return {"classified": (100.0 * float(right.mean()), "%"), "false_stop": (100.0 * float(stop.mean()), "%")}


def sds(result: Result, detector: Floats) -> dict[str, Floats]:
    """What the covariance says of the errors, (n,) each, of a machine close to level."""
    from tbmfg.evaluation.metrics import at_point

    cov = np.diagonal(result.trajectory.cov, axis1=1, axis2=2)
    at_detector = np.diagonal(at_point(result.trajectory, detector).cov, axis1=1, axis2=2)
    return {
        "roll": np.degrees(np.sqrt(cov[:, 0])),
        "pitch": np.degrees(np.sqrt(cov[:, 1])),
        "yaw": np.degrees(np.sqrt(cov[:, 2])),
        "displacement": 100.0 * np.sqrt(at_detector[:, 3] + at_detector[:, 4]),
        "depth": np.sqrt(cov[:, 5]),
        "speed": np.sqrt(cov[:, 8]),
    }


def detector_b(simulation: Simulation) -> Floats:
    """Where the laser's detector is in b, (3,) m; zero on a cage, which has none."""
    lasers = list(simulation.rig.of_kind("laser").values())
    return lasers[0].T_bd.xyz if lasers else np.zeros(3)


def angles_deg(R: Floats) -> Floats:
    """Yaw, pitch, roll, (n, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_euler("ZYX", degrees=True)


# ---- Table 5 ----


def cost() -> list[Row]:
    """The compiled loops of each filter on one log, the fastest of several runs."""
    import datasets
    from benchmarks.runs import in_memory
    from tbmfg.prepare import prepare

    simulation = datasets.make("shaft-dynamic", seed=0, duration=20.0)
    problem = prepare(in_memory(simulation), simulation.rig)
    steps = int(problem.keyframe_edges[-1])
    seconds = {name: min(loops_s(name, problem) for _ in range(REPEATS)) for name in THREE}
    rows = [Row("cost", name, "per step", "us", 1e6 * seconds[name] / steps, None, REPEATS) for name in THREE]
    return rows + [
        Row("cost", name, f"per step over {CF}", "", seconds[name] / seconds[CF], None, REPEATS, None, published)
        for name, published in COST.items()
    ]


def loops_s(name: str, problem: Problem) -> float:
    """Time that an estimator spends in its compiled loops: what a controller would run; no reading, no output."""
    from tbmfg.estimators import estimate
    from tbmfg.filters import complementary, euler_ekf

    spent = []

    def timed(loop: Callable) -> Callable:
        def run(*arguments):
            begin = time.perf_counter()
            done = loop(*arguments)
            spent.append(time.perf_counter() - begin)
            return done

        return run

    with ExitStack() as stack:
        for module, loop in ((complementary, "attitude"), (complementary, "observers"), (euler_ekf, "run")):
            stack.enter_context(patch.object(module, loop, timed(getattr(module, loop))))
        estimate(name, problem)
    return sum(spent)
