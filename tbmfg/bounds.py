"""How accurate any estimator of a log can be: the posterior Cramer-Rao bound, for smoothing and for filtering.

No estimator that is right in the mean has a smaller error covariance than the inverse of the information that rows and
priors hold, linearised at the true states: Van Trees (1968) sec. 2.4; for a chain in time Tichavsky, Muravchik &
Nehorai (1998). The models are those of the problem, every row with its full weight: where rows are gross errors, and
where the noise is not what the rig says, no estimator need reach it.

- Smoothing, what the whole log says of a keyframe: the marginals of all rows together.
- Filtering, what the rows up to a keyframe say of it: the same elimination, stopped there. It begins from
  ``Prior.filter_cov``: a heading that was found from the log is taken for known before, as the filters take it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tbmfg.evaluation.metrics import truth_at
from tbmfg.filters import ins
from tbmfg.geometry import matrix_from_quat
from tbmfg.outcome import trajectory
from tbmfg.problem import Problem, breakdown_explained
from tbmfg.smoother import graph
from tbmfg.smoother.chain import Block, eliminate, newest
from tbmfg.smoother.graph import States
from tbmfg.state import Trajectory, Truth
from tbmfg.timeseries import Floats


@dataclass(frozen=True, slots=True)
class Bounds:
    """The states that the models were linearised at, each with the least covariance that its error can have: of an
    estimator that knows the whole log, and of one that knows the past."""

    smoothing: Trajectory
    filtering: Trajectory


def cramer_rao(problem: Problem, truth: Truth) -> Bounds:
    """Bounds at the keyframes of ``problem``. Raises EstimationError where the models break down."""
    with breakdown_explained("the Cramer-Rao bound"):
        states = states_along(problem, truth)
        smoothing, filtering = covariances(problem, states)
    return Bounds(trajectory(problem, states.x, smoothing), trajectory(problem, states.x, filtering))


def states_along(problem: Problem, truth: Truth) -> States:
    """Pose and velocity of the truth where there is one. What it does not tell (biases, calibrations, an attitude or a
    velocity that is not in it, keyframes that it does not cover) is as ``ins`` estimates it: the information depends
    on these but weakly."""
    found = ins.run(problem)
    x = found.x.copy()
    covered, true = truth_at(truth, problem.t_ns)
    if true.quat_xyzw is not None:
        x[covered, :9] = matrix_from_quat(true.quat_xyzw).reshape(-1, 9)
    R = x[covered, :9].reshape(-1, 3, 3)
    x[covered, 9:12] = true.position_n - R @ truth.arm_b - problem.origin_n
    if true.velocity_n is not None and not truth.arm_b.any():
        x[covered, 12:15] = true.velocity_n
    return States(x, found.c)


def covariances(problem: Problem, states: States) -> tuple[Floats, Floats]:
    """Bounds for smoothing and for filtering at ``states``, (n, 15 + e, 15 + e) each."""
    free = problem.parameters.free
    n, d, m = len(states.x), problem.size, len(free)
    rows = unit_rows(problem, states)
    whole, past = (
        graph.prior_rows(problem.parameters, cov, free) for cov in (problem.prior.cov, problem.prior.filter_cov)
    )
    smoothing, _ = eliminate([*rows, whole], n, d, m).covariances()
    return smoothing, newest([*rows, past], n, d, m)


def unit_rows(problem: Problem, states: States) -> list[Block]:
    """All whitened rows but the prior's, linearised at ``states`` and not weighted by any loss."""
    x, free = states.x, problem.parameters.free
    m = len(free)
    blocks = [graph.imu_block(graph.imu_graph(problem, x), x, graph.no_bias(len(x)), m)]
    if len(problem.drift_walk):
        blocks.append(graph.drift_block(problem, np.diff(problem.keyframes_s), states, m))
    return blocks + [graph.sensor_block(replace(rows, loss="none"), states, free)[0] for rows in problem.rows]
