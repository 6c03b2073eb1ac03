"""Batch smoothing: Gauss-Newton over the whole log, damped when a step does not pay.

What no row determines is held where it is by the weakest prior that can be told from rounding, and named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tbmfg.errors import EstimationError
from tbmfg.inertial.strapdown import correct_path, correct_states
from tbmfg.problem import CLOCK, Problem
from tbmfg.sensors import Rows
from tbmfg.smoother import graph, losses
from tbmfg.smoother.chain import RANK, Block, Elimination, eliminate, lengths
from tbmfg.smoother.graph import States
from tbmfg.state import NAV
from tbmfg.timeseries import Floats

MAX_ITERATIONS = 100  # by weights of outliers that follow the state it converges linearly
STAGE_ITERATIONS = 2  # at each loss on the way to the truncated square
CLOCK_REACH_S = 0.02  # of a clock beyond the one found by ``prepare``: the prism's model is first order in it
# a step that does not pay is tried along the path, which reaches farther where nothing holds the heading, and shorter
TRIES = ((correct_states, 1.0), (correct_path, 1.0), (correct_path, 0.3))
WEAKEST = 100.0 * RANK  # of a column's length: an sd of 1e10 times what the firmest rows alone would leave
ROUNDS = 5  # in which unknowns that no row determines are looked for: one that is held shows the next
CONVERGED = 1e-3  # largest step, in posterior sds or relative to the cost, that ends the iteration


@dataclass(frozen=True, slots=True)
class Smoothed:
    """States (n, 21 + e) with covariances (n, 15 + e, 15 + e), calibrations with covariance, and by sensor and row the
    squared normalised residuals at the solution; ``held``: (keyframe, index), keyframe -1 for a free constant, of the
    unknowns that no row determines."""

    x: Floats
    cov: Floats
    c: Floats
    c_cov: Floats
    nis: dict[str, Floats]
    iterations: int
    converged: bool
    held: tuple[tuple[int, int], ...] = ()


def solve(problem: Problem, x: Floats, c: Floats, progress: Callable[[float], None] | None = None) -> Smoothed:
    """Most likely states and calibrations given all rows of ``problem``; starts from ``x`` (n, 21 + e) and ``c`` (m,).

    Raises EstimationError where not even a weak prior makes the unknowns determined.
    """
    descent = _Descent(problem, States(x.copy(), c.copy()), progress)
    converged = descent.run(MAX_ITERATIONS)
    doubted = [r for r in problem.rows if r.loss == "gnc" and (descent.nis[r.sensor] > losses.gate(r.dof)).any()]
    if doubted:
        mu = min(losses.first_mu(descent.nis[r.sensor], r.dof) for r in doubted)
        while mu < losses.LAST_MU and not descent.decided(doubted, mu):
            descent.run(STAGE_ITERATIONS, mu)
            mu *= losses.GROWTH
        converged = descent.run(MAX_ITERATIONS, losses.LAST_MU)
    states, free = descent.states, problem.parameters.free
    chain, held = _eliminated(problem, descent.blocks, len(free))
    cov, c_cov = _covariances(problem, chain, free)
    return Smoothed(states.x, cov, states.c, c_cov, descent.nis, descent.iterations, converged, held)


class _Descent:
    """Gauss-Newton from step to step, with what the present states make of the problem."""

    def __init__(self, problem: Problem, states: States, progress: Callable[[float], None] | None) -> None:
        self.problem, self.states, self.progress = problem, states, progress
        self.imu = graph.imu_graph(problem, states.x), graph.no_bias(len(states.x))
        names = problem.parameters.names
        self.clocks = [k for k in problem.parameters.free if names[k].endswith(CLOCK)]
        span = problem.keyframes_s[-1]
        self.reach = np.array([CLOCK_REACH_S / (span if names[k].endswith("drift") else 1.0) for k in self.clocks])
        self.iterations = 0
        self.blocks, self.nis = [], {}

    def run(self, most: int, mu: float | None = None) -> bool:
        """At most ``most`` steps under the loss at ``mu``; whether they converged."""
        problem, free = self.problem, self.problem.parameters.free
        n, d, m = len(self.states.x), problem.size, len(free)
        self.blocks, self.nis, cost = _linearise(problem, self.imu, self.states, free, mu)
        damping = 0.0
        for _ in range(most):
            self.iterations += 1
            chain, _ = _eliminated(problem, self.blocks + _damping(self.blocks, damping, n, d, m), m)
            dx, dc = chain.solve()
            del chain  # it is as large as all rows, which the next linearisation holds twice
            for correct, part in TRIES:
                c = self.states.c.copy()
                c[free] += part * dc
                c[self.clocks] = np.clip(c[self.clocks], -self.reach, self.reach)
                candidate = States(correct(self.states.x, part * dx), c)
                blocks, nis, new_cost = _linearise(problem, self.imu, candidate, free, mu)
                if paid := bool(np.isfinite(new_cost) and new_cost <= cost * (1 + 1e-9) + 1e-9):
                    break
            if self.progress is not None:
                self.progress(self.iterations / (self.iterations + 3))
            if paid:
                converged = damping < 1e-6 and cost - new_cost < CONVERGED * 1e-3 * (1.0 + cost)
                self.states, self.blocks, self.nis, cost = candidate, blocks, nis, new_cost
                if converged:
                    return True
                damping = 0.0 if damping < 1e-6 else damping * 0.1
            else:
                damping = max(10.0 * damping, 1e-4)
                if damping > 1e8:
                    return False
        return False

    def decided(self, doubted: list[Rows], mu: float) -> bool:
        """Whether every row of the sensors in doubt counts in full or not at all."""
        weights = np.concatenate([losses.weight(self.nis[r.sensor], r.loss, r.dof, mu) for r in doubted])
        return bool(np.all((weights < 1e-3) | (weights > 1.0 - 1e-3)))


def at(problem: Problem, x: Floats, c: Floats) -> Smoothed:
    """Covariances and residuals of the whole graph at given states: those of a solver that ends there."""
    free, states = problem.parameters.free, States(x, c)
    imu = graph.imu_graph(problem, x), graph.no_bias(len(x))
    blocks, nis, _ = _linearise(problem, imu, states, free)
    chain, held = _eliminated(problem, blocks, len(free))
    cov, c_cov = _covariances(problem, chain, free)
    return Smoothed(x, cov, c, c_cov, nis, 0, True, held)


def residual_traces(problem: Problem, x: Floats, c: Floats, sensor: str, which: slice) -> tuple[float, float]:
    """tr R_ss and tr(R_ss^2) of the adjustment of all rows at a solution, over components ``which`` of the rows of
    ``sensor``: R = I - H is what it leaves of an error. By a random probe of signs (Hutchinson 1990), whose error is
    that of one draw of noise, or less."""
    free, states = problem.parameters.free, States(x, c)
    imu = graph.imu_graph(problem, x), graph.no_bias(len(x))
    blocks, _, _ = _linearise(problem, imu, states, free)
    own = len(blocks) - len(problem.rows) + [rows.sensor for rows in problem.rows].index(sensor)
    signs = np.zeros_like(blocks[own].b)
    signs[:, which] = np.random.default_rng(0).choice([-1.0, 1.0], size=signs[:, which].shape)
    probed = [replace(block, b=signs if k == own else np.zeros_like(block.b)) for k, block in enumerate(blocks)]
    dx, dc = eliminate(probed, len(x), problem.size, len(free)).solve()
    block = blocks[own]
    fitted = np.einsum("rka,ra->rk", block.A_i, dx[block.i]) + block.A_c @ dc
    if block.A_j is not None:
        fitted += np.einsum("rka,ra->rk", block.A_j, dx[block.i + 1])
    left = (signs - fitted)[:, which]
    return float(np.sum(signs[:, which] * left)), float(np.sum(left**2))


def _covariances(problem: Problem, chain: Elimination, free: np.ndarray) -> tuple[Floats, Floats]:
    """Covariances of all keyframes, and of all constants (zero for known ones)."""
    m = len(problem.parameters.names)
    cov, free_cov = chain.covariances()
    c_cov = np.zeros((m, m))
    c_cov[np.ix_(free, free)] = free_cov
    return cov, c_cov


def _linearise(
    problem: Problem, imu, states: States, free, mu: float | None = None
) -> tuple[list[Block], dict[str, Floats], float]:
    """All whitened rows at ``states``, weighted by their losses; squared normalised residuals by sensor; the cost."""
    m, e = len(free), len(problem.drift_walk)
    prior = graph.prior_rows(problem.parameters, problem.prior.cov, free)
    mean = States(problem.prior.x[None], problem.parameters.mean)
    blocks = [graph.imu_block(imu[0], states.x, imu[1], m), graph.about(prior, mean, states, free)]
    if e:
        blocks.append(graph.drift_block(problem, np.diff(problem.keyframes_s), states, m))
    cost = 0.5 * sum(float(np.sum(block.b**2)) for block in blocks)
    nis = {}
    for rows in problem.rows:
        block, nis[rows.sensor] = graph.sensor_block(rows, states, free, mu)
        blocks.append(block)
        cost += losses.cost(nis[rows.sensor], rows.loss, rows.dof, mu)
    return blocks, nis, cost


def _eliminated(problem: Problem, blocks: list[Block], m: int) -> tuple[Elimination, tuple[tuple[int, int], ...]]:
    """The chain of all rows, and the unknowns that are held by weak priors because no row determines them."""
    n, d = len(problem.keyframe_edges), problem.size
    chain, held = eliminate(blocks, n, d, m), ()
    for _ in range(ROUNDS):
        missing = chain.undetermined()
        if not missing:
            return chain, held
        held = tuple(sorted({*held, *missing}))
        chain = eliminate([*blocks, _weak(chain, _vectors(held))], n, d, m)
    if missing := chain.undetermined():
        raise EstimationError(
            f"not determined: {in_words(problem, missing)}; add a sensor that sees it, or a prior in the rig "
            "(initial.*_sd, sensors.*.*_sd)"
        )
    return chain, held


def _vectors(held: tuple[tuple[int, int], ...]) -> list[tuple[int, int]]:
    """Of unknowns of keyframes the whole vectors, at the first keyframe too: what rounding makes of a direction on the
    way along the chain would else get into all else."""
    out = set()
    for k, i in held:
        whole = range(i - i % 3, i - i % 3 + 3) if k >= 0 and i < NAV else (i,)
        out |= {(at, one) for at in {min(k, 0), k} for one in whole}
    return sorted(out)


def _weak(chain: Elimination, held: list[tuple[int, int]]) -> Block:
    """A row for each of the unknowns ``held`` that keeps it where it is."""
    n, d, m = len(held), chain.d, chain.m
    A, A_c = np.zeros((n, 1, d)), np.zeros((n, 1, m))
    for row, (k, i) in enumerate(held):
        if k < 0:
            A_c[row, 0, i] = WEAKEST * chain.border_scale[i]
        else:
            A[row, 0, i] = WEAKEST * chain.scale[k, i]
    return Block(np.array([max(k, 0) for k, _ in held]), A, None, A_c, np.zeros((n, 1)))


def in_words(problem: Problem, unknowns: Sequence[tuple[int, int]]) -> str:
    """Unknowns (keyframe, index), keyframe -1 for a free constant, by kind and time."""
    names = ("attitude", "position", "velocity", "accelerometer bias", "gyro bias", "drifting calibration")
    free = [problem.parameters.names[k] for k in problem.parameters.free]
    what = sorted({free[i] if k < 0 else names[min(i // 3, 5)] for k, i in unknowns})
    times = [problem.keyframes_s[k] for k, _ in unknowns if k >= 0] or [problem.keyframes_s[-1]]
    return f"{', '.join(what)}, {min(times):.1f}-{max(times):.1f} s ({len(unknowns)} unknowns)"


def _damping(blocks: list[Block], damping: float, n: int, d: int, m: int) -> list[Block]:
    """Levenberg-Marquardt rows sqrt(damping x diagonal of the information) dx = 0; Nocedal & Wright (2006) ch. 10.3."""
    if damping == 0.0:
        return []
    column_lengths, _ = lengths(blocks, n, d, m)
    A = np.sqrt(damping) * column_lengths[:, :, None] * np.eye(d)
    return [Block(np.arange(n), A, None, np.zeros((n, d, m)), np.zeros((n, d)))]
