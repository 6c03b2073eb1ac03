"""Smoothing online over the last seconds: Gauss-Newton on a window of keyframes at every new one.

The window is a short chain of the batch smoother's own rows. What the QR elimination of its oldest keyframe carries
on is what that keyframe leaves when its time is up: linear rows on its neighbour and the constants (Dong-Si & Mourikis
2011, in square-root form). Constants stay. IMU factors are linearised anew where their states have moved; all other
rows, with the weights of their losses, at every update. Clock offsets are those found by ``prepare``.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from tbmfg.errors import EstimationError
from tbmfg.inertial.strapdown import correct_states, difference
from tbmfg.problem import Problem
from tbmfg.smoother import graph, losses
from tbmfg.smoother.chain import Block, Elimination, eliminate, marginal
from tbmfg.smoother.graph import States
from tbmfg.smoother.online import REANCHOR_INFLATION, Online
from tbmfg.timeseries import Floats

# Change of rotation [rad] and of velocity [m/s] from which an IMU factor is linearised anew: its terms of second
# order, rotation times velocity, are below 0.1 mm/s then.
MOVED_ROT, MOVED_VEL = 3e-3, 3e-2
MOST_ITERATIONS = 4
BUNCH = 0.125  # of the lag that a keyframe may stay beyond it: they leave together, which costs less


class _Window:
    """Keyframes ``first`` .. ``first + len(x) - 1`` of a problem, and the rows that those before them have left."""

    def __init__(self, problem: Problem, free: np.ndarray, first: int, x: Floats, cov: Floats) -> None:
        """Start at keyframe ``first`` with state ``x`` (21 + e,), covariance ``cov``, and the rig's calibrations."""
        d = problem.size
        self.problem, self.free, self.first = problem, free, first
        self.x, self.c = x[None].copy(), problem.parameters.start.copy()
        self.left = graph.prior_rows(problem.parameters, cov, free)
        self.left_at = States(self.x.copy(), problem.parameters.mean.copy())
        self.factors: list[gtsam.NonlinearFactorGraph] = []
        self.imu_at = np.zeros((0, 2, len(x)))  # where the IMU factors are linearised
        self.imu = Block(
            np.zeros(0, dtype=int), *np.zeros((2, 0, 15, d)), np.zeros((0, 15, len(free))), np.zeros((0, 15))
        )
        self.times, self.zero, self.noise = problem.keyframes_s, graph.no_bias(2), graph.noise_of(problem)
        self.out = {rows.sensor: np.zeros(len(rows), dtype=bool) for rows in problem.rows}
        self.chain: Elimination | None = None  # as solved last

    def extend(self) -> None:
        """Add the next keyframe, where the IMU says that it is."""
        x, k = self.x[-1], self.first + len(self.x)
        pim = graph.preintegrate(self.problem, k - 1, x, self.noise)
        before = gtsam.NavState(gtsam.Rot3(x[:9].reshape(3, 3)), x[9:12], x[12:15])
        after = pim.predict(before, gtsam.imuBias.ConstantBias(x[15:18], x[18:21]))
        x = np.concatenate([after.attitude().matrix().ravel(), after.position(), after.velocity(), x[15:]])
        self.x = np.vstack([self.x, x])
        factor = gtsam.NonlinearFactorGraph()
        factor.add(gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), pim))
        self.factors.append(factor)
        self.imu_at = np.concatenate([self.imu_at, self.x[None, -2:]])
        new, old = graph.imu_block(factor, self.x[-2:], self.zero, len(self.free)), self.imu
        pairs = ((old.A_i, new.A_i), (old.A_j, new.A_j), (old.A_c, new.A_c), (old.b, new.b))
        self.imu = Block(np.arange(len(self.factors)), *(np.concatenate(pair) for pair in pairs))

    def solve(self) -> None:
        """Gauss-Newton until neither a loss nor an IMU factor asks for more. Raises ArithmeticError where an unknown is
        not determined."""
        newest = len(self.x) - 1
        for _ in range(MOST_ITERATIONS):
            blocks, doubted = self._blocks(newest)
            chain = eliminate(blocks, newest + 1, self.problem.size, len(self.free))
            if missing := chain.undetermined():
                raise ArithmeticError(f"{len(missing)} unknowns of the window are not determined")
            dx, dc = chain.solve()
            self.x = correct_states(self.x, dx)
            self.c[self.free] += dc
            if not np.isfinite(self.x).all():
                raise ArithmeticError(f"the state at keyframe {self.first + newest} is not finite")
            if not self._relinearise() and not doubted:
                break
        self.chain = chain

    def shut_out(self, k: int, cov: Floats) -> None:
        """Leave out rows of keyframe k, the newest, that its prediction contradicts beyond the gate, from sensors
        whose loss is gnc: they may be biased for long, and no window is long enough to tell later. ``cov`` is that of
        the keyframe before."""
        for rows in self.problem.rows:
            own = slice(*np.searchsorted(rows.j, [k, k + 1]))
            if rows.loss != "gnc" or own.start == own.stop or rows.i[own.start] != k:
                continue
            x = np.repeat(self.x[-1:], own.stop - own.start, axis=0)
            r, J, *_ = rows.evaluate_at(x, x, self.c, own)
            S = J @ cov @ J.transpose(0, 2, 1) + np.eye(rows.dof)
            nis = np.einsum("ni,nij,nj->n", r, np.linalg.inv(S), r)
            self.out[rows.sensor][own] = nis > losses.gate(rows.dof)

    def leave(self, count: int, out: Online) -> None:
        """Let the oldest ``count`` keyframes leave, one at least stays; kept in ``out`` as they were solved last."""
        self._keep(count, out)
        self.left = marginal(self._blocks(count)[0], count + 1, self.problem.size, len(self.free))
        self.left_at = States(self.x[count : count + 1].copy(), self.c.copy())
        self.x, self.first = self.x[count:], self.first + count
        self.factors, self.imu_at, imu = self.factors[count:], self.imu_at[count:], self.imu
        self.imu = Block(imu.i[:-count], imu.A_i[count:], imu.A_j[count:], imu.A_c[count:], imu.b[count:])

    def close(self, out: Online, solved: int) -> None:
        """Keep the first ``solved`` keyframes of the window, and the constants, as the last ones."""
        out.c, out.c_cov[np.ix_(self.free, self.free)] = self.c.copy(), self._keep(solved, out)

    def _keep(self, count: int, out: Online) -> Floats:
        """Oldest ``count`` keyframes into ``out``, with their rows' residuals; the covariance of the constants."""
        cov, c_cov = self.chain.covariances()
        for n, k in enumerate(range(self.first, self.first + count)):
            out.last_x[k], out.last_cov[k] = self.x[n], cov[n]
            out.residuals(self.problem, k, self.c)
        return c_cov

    def _relinearise(self) -> bool:
        """Linearise the IMU factors whose states have moved; whether there were any."""
        if not self.factors:
            return False
        change = np.abs(np.stack([self.x[:-1], self.x[1:]], axis=1) - self.imu_at)
        moved = (change[:, :, :9].max(axis=(1, 2)) > MOVED_ROT) | (change[:, :, 12:15].max(axis=(1, 2)) > MOVED_VEL)
        for n in np.flatnonzero(moved):
            self.imu_at[n] = self.x[n : n + 2]
            block = graph.imu_block(self.factors[n], self.imu_at[n], self.zero, len(self.free))
            self.imu.A_i[n], self.imu.A_j[n], self.imu.b[n] = block.A_i[0], block.A_j[0], block.b[0]
        return bool(moved.any())

    def _blocks(self, last: int) -> tuple[list[Block], bool]:
        """All rows on the window's keyframes 0 .. ``last`` about their present states, and whether a loss takes weight
        from a row of the last one: such a weight follows the state, and has to be found by iterating."""
        m, states = len(self.free), States(self.x[: last + 1], self.c)
        blocks = [graph.about(self.left, self.left_at, states, self.free)]
        if last:
            imu, at = self.imu, self.imu_at[:last]
            b = imu.b[:last] - np.einsum("kij,kj->ki", imu.A_i[:last], difference(states.x[:-1], at[:, 0]))
            b -= np.einsum("kij,kj->ki", imu.A_j[:last], difference(states.x[1:], at[:, 1]))
            blocks.append(Block(imu.i[:last], imu.A_i[:last], imu.A_j[:last], imu.A_c[:last], b))
            if len(self.problem.drift_walk):
                elapsed = np.diff(self.times[self.first : self.first + last + 1])
                blocks.append(graph.drift_block(self.problem, elapsed, states, m))
        doubted = False
        for every in self.problem.rows:
            rows = every.between(self.first, self.first + last, self.out[every.sensor])
            if len(rows):
                block, nis = graph.sensor_block(rows, states, self.free)
                blocks.append(block)
                doubted |= rows.loss != "none" and bool(np.any(nis[rows.j == last] > losses.threshold(rows.dof) ** 2))
        return blocks, doubted


def run(problem: Problem, lag_s: float, progress: Callable[[float], None] | None = None) -> Online:
    """Smooth online over ``lag_s`` seconds. Raises EstimationError where the start is not determined."""
    times, names = problem.keyframes_s, problem.parameters.names
    free = np.array([k for k in problem.parameters.free if not names[k].endswith("clock_offset")], dtype=int)
    out = Online.empty(problem)
    window = _Window(problem, free, 0, problem.prior.x, problem.prior.filter_cov)
    for k in range(len(times)):
        if k > 0:
            if times[window.first] < times[k] - (1.0 + BUNCH) * lag_s:
                leaving = np.searchsorted(times, times[k] - lag_s) - window.first
                window.leave(min(leaving, k - 1 - window.first), out)
            window.extend()
            window.shut_out(k, out.causal_cov[k - 1])
        guess = window.x[-1]
        try:
            window.solve()
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            if k == 0:
                raise EstimationError(f"not determined at the start: {error}; give priors in the rig") from error
            window.close(out, k - window.first)
            window = _Window(problem, free, k, guess, out.causal_cov[k - 1] * REANCHOR_INFLATION)
            window.solve()
            out.reanchored.append((k, str(error)))
        out.causal_x[k], out.causal_cov[k] = window.x[-1], window.chain.covariances(k - window.first)[0][0]
        if progress is not None:
            progress(k / len(times))
    window.close(out, len(window.x))
    return out
