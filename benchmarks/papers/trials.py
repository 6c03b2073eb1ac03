"""What the papers' experiments share: one log through several methods, and the comparison of methods log by log."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from benchmarks.rows import Row
from benchmarks.runs import epochs, held, in_memory, true_states
from benchmarks.workers import run_all
from tbmfg.errors import TbmfgError

if TYPE_CHECKING:
    from datasets.simulate import Simulation
    from tbmfg.rig import Rig
    from tbmfg.state import Result, Trajectory, Truth

Metrics = dict[str, tuple[float, str]]  # name -> value and unit

EPOCHS = 3  # times at which consistency is tested
CHANCE = 0.01  # of a false alarm in all NEES cells of an experiment together
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Method:
    """An estimator under the name ``label``, with ``settings`` of its switches; on every ``every``-th log only."""

    label: str
    estimator: str
    settings: tuple[str, ...] = ()
    every: int = 1


@dataclass(frozen=True, slots=True)
class Trial:
    """One log to simulate, ``settings`` and ``options`` as :func:`datasets.make` takes them, and who estimates it.

    ``metrics`` measures a result against the truth at its keyframes; ``rig`` says with the seed what the estimators are
    told, where that is not just the log's own rig; ``between`` measures the results against each other, by label;
    ``least`` measures the Cramer-Rao bound of smoothing, for the methods that know the whole log. All are
    functions of a module, so that another process finds them.
    """

    scenario: str
    dataset: str
    seed: int
    duration_s: float | None
    methods: tuple[Method, ...]
    metrics: Callable[[Simulation, Result, Truth], Metrics]
    settings: tuple[str, ...] = ()
    options: dict[str, Any] = field(default_factory=dict)
    rig: Callable[[Simulation, int], Rig] | None = None
    between: Callable[[dict[str, Result]], dict[str, Metrics]] | None = None
    least: Callable[[Simulation, Trajectory], Metrics] | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """One method on one log: its metrics, and the NEES of the 6-dof pose at ``epochs_s``. ``failure``: why not."""

    scenario: str
    method: str
    seed: int
    metrics: Metrics
    epochs_s: tuple[float, ...] = ()
    nees: tuple[float, ...] = ()
    failure: str = ""


def run(trial: Trial) -> list[Outcome]:
    """Simulate, prepare once, estimate with each method, measure."""
    import datasets
    from tbmfg.bounds import cramer_rao
    from tbmfg.estimators import ESTIMATORS, estimate
    from tbmfg.prepare import prepare
    from tbmfg.rig import override

    duration_s = datasets.own_duration(trial.dataset) if trial.duration_s is None else trial.duration_s
    simulation = datasets.make(
        trial.dataset, seed=trial.seed, duration=duration_s, settings=trial.settings, **trial.options
    )
    rig = simulation.rig if trial.rig is None else trial.rig(simulation, trial.seed)
    outcomes, results, problem = [], {}, None
    for method in trial.methods:
        if trial.seed % method.every:
            continue
        try:
            problem = problem or prepare(held(in_memory(simulation)), rig)
            result = estimate(method.estimator, replace(problem, rig=override(rig, method.settings)))
            outcomes.append(_measured(trial, method.label, simulation, result, duration_s))
            results[method.label] = result
        except TbmfgError as error:
            outcomes.append(Outcome(trial.scenario, method.label, trial.seed, {}, failure=str(error)))
    extra = trial.between(results) if trial.between is not None else {}
    whole = [method.label for method in trial.methods if ESTIMATORS[method.estimator].whole and method.label in results]
    if trial.least is not None and whole:
        bound = cramer_rao(problem, true_states(simulation, problem.t_ns)).smoothing
        extra |= {label: extra.get(label, {}) | trial.least(simulation, bound) for label in whole}
    return [replace(one, metrics=one.metrics | extra.get(one.method, {})) for one in outcomes]


def _measured(trial: Trial, label: str, simulation: Simulation, result: Result, duration_s: float) -> Outcome:
    from tbmfg.evaluation.metrics import trajectory_errors

    truth = true_states(simulation, result.trajectory.t_ns)
    at = epochs(truth.t_ns - simulation.start_ns, duration_s, EPOCHS)
    times = tuple(round(duration_s * k / EPOCHS, 1) for k in range(1, EPOCHS + 1))
    nees = tuple(trajectory_errors(result.trajectory, truth).nees[at].tolist())
    return Outcome(trial.scenario, label, trial.seed, trial.metrics(simulation, result, truth), times, nees)


class Outcomes:
    """The outcomes of many trials, and rows of them."""

    def __init__(self, outcomes: list[Outcome]) -> None:
        self.outcomes = outcomes
        self.alpha = CHANCE / max(EPOCHS * len({(one.scenario, one.method) for one in outcomes}), 1)

    @staticmethod
    def of(trials: list[Trial], jobs: int, title: str) -> Outcomes:
        """Run the trials; what fails is told on stderr."""
        outcomes = [one for group in run_all(run, trials, jobs, title) for one in group]
        for one in outcomes:
            if one.failure:
                print(f"{one.scenario}, {one.method}, seed {one.seed}: {one.failure}", file=sys.stderr)
        return Outcomes(outcomes)

    def methods(self, scenario: str) -> list[str]:
        """Labels of the methods in a scenario, in their order."""
        return list(dict.fromkeys(one.method for one in self.outcomes if one.scenario == scenario))

    def by_seed(self, scenario: str, method: str, metric: str) -> dict[int, float]:
        """A metric of one method by log; without those that failed, and empty where it has no such metric."""
        own = (one for one in self.outcomes if (one.scenario, one.method) == (scenario, method))
        return {one.seed: one.metrics[metric][0] for one in own if metric in one.metrics}

    def mean(self, scenario: str, method: str, metric: str) -> float:
        """Mean over the logs; NaN without any."""
        values = list(self.by_seed(scenario, method, metric).values())
        return float(np.mean(values)) if values else np.nan

    def rows(
        self,
        scenario: str,
        published: dict[tuple[str, str], float],
        bounds: dict[str, tuple[float | None, float | None]],
    ) -> list[Row]:
        """Every metric of every method: ``published`` by method and metric, ``bounds`` by metric; then consistency."""
        from tbmfg.evaluation.metrics import chi_square_bounds

        rows = []
        for method in self.methods(scenario):
            own = [one for one in self.outcomes if (one.scenario, one.method) == (scenario, method)]
            good = [one for one in own if not one.failure]
            failed = len(own) - len(good)
            rows.append(Row(scenario, method, "failed", "logs", failed, None, len(own), (None, 0)))
            if not good:
                continue
            for metric, (_, unit) in good[0].metrics.items():
                values = self.by_seed(scenario, method, metric).values()
                known = published.get((method, metric))
                rows.append(row(scenario, method, metric, unit, values, bounds.get(metric), known))
                if known is not None:
                    ratio = float(np.mean(list(values))) / known
                    rows.append(Row(scenario, method, f"{metric} / published", "", ratio, None, len(good)))
            low, high = chi_square_bounds(len(good), 6, self.alpha)
            for k, time_s in enumerate(good[0].epochs_s):
                values = [one.nees[k] / 6 for one in good]
                rows.append(row(scenario, method, f"nees_pose@{time_s:g}s", "per dof", values, (low / 6, high / 6)))
        return rows

    def reduction(self, scenario: str, method: str, other: str, metric: str, published: float | None = None) -> Row:
        """By how much the mean of a metric is smaller than that of an ``other`` method, %."""
        value = 100.0 * (1.0 - self.mean(scenario, method, metric) / self.mean(scenario, other, metric))
        n = len(self.by_seed(scenario, method, metric))
        return Row(scenario, method, f"{metric} less than {other}", "%", value, None, n, None, published)

    def ordering(self, scenario: str, methods: Iterable[str], metric: str) -> Row:
        """1 where the means of the methods fall from each to the next, else 0."""
        methods = list(methods)
        means = [self.mean(scenario, method, metric) for method in methods]
        n = len(self.by_seed(scenario, methods[0], metric))
        return Row(
            scenario, methods[-1], f"{metric}: {' > '.join(methods)}", "", float(falling(means)), None, n, (1, 1)
        )

    def paired(
        self,
        scenario: str,
        method: str,
        other: str,
        metric: str,
        other_scenario: str | None = None,
        hold: Literal["better", "not worse", "nothing"] = "better",
    ) -> list[Row]:
        """How much smaller a metric of ``method`` is than of ``other``, log by log, with its confidence interval: above
        0 ``method`` is better, and not worse while the higher end is. None where they share fewer than two logs."""
        mine, its = self.by_seed(scenario, method, metric), self.by_seed(other_scenario or scenario, other, metric)
        shared = sorted(set(mine) & set(its))
        if len(shared) < 2:
            return []
        gain = np.array([its[seed] - mine[seed] for seed in shared])
        low, high = confidence(gain)
        unit = next(one.metrics[metric][1] for one in self.outcomes if metric in one.metrics)
        name = f"{metric}: more than {method}"
        where = other if other_scenario in (None, scenario) else f"{other} ({other_scenario})"
        held = {"better": ((0, None), None), "not worse": (None, (0, None)), "nothing": (None, None)}[hold]
        return [
            row(scenario, where, name, unit, gain),
            Row(scenario, where, f"{name}, low", unit, low, None, len(gain), held[0]),
            Row(scenario, where, f"{name}, high", unit, high, None, len(gain), held[1]),
        ]


def row(scenario: str, method: str, metric: str, unit: str, values: Iterable[float], bound=None, published=None) -> Row:
    """Mean and sd of the values of independent logs."""
    values = np.array(list(values), float)
    sd = float(values.std(ddof=1)) if len(values) > 1 else None
    return Row(scenario, method, metric, unit, float(values.mean()), sd, len(values), bound, published)


def falling(values: list[float]) -> bool:
    """Whether each value is smaller than the one before."""
    return bool(np.all(np.diff(values) < 0))


def confidence(values: np.ndarray) -> tuple[float, float]:
    """Interval that holds the mean of the values' distribution with CONFIDENCE: Student's t."""
    from scipy.stats import t

    mean, reach = (
        values.mean(),
        t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)),
    )
    return float(mean - reach), float(mean + reach)
