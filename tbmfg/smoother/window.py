"""Smoothing online over the last seconds: Gauss-Newton on a window of keyframes at every new one.

The window is a short chain of the batch smoother's own rows. What the QR elimination of its oldest keyframe carries
on is what that keyframe leaves when its time is up: linear rows on its neighbour and the constants (Dong-Si & Mourikis
2011, in square-root form). Constants stay. Rows are linearised anew, and the weights of their losses found again, from
the first keyframe on whose residuals have moved; what lies before it is not eliminated again (fluid relinearisation,
Kaess et al. 2012, on a chain). Clocks are those found by ``prepare``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from tbmfg.inertial.strapdown import correct_states, difference
from tbmfg.problem import CLOCK, Problem
from tbmfg.smoother import graph, losses
from tbmfg.smoother.chain import Block, Elimination
from tbmfg.smoother.graph import States
from tbmfg.smoother.online import Online, follow
from tbmfg.smoother.sliding import Sliding
from tbmfg.state import NAV
from tbmfg.timeseries import Floats

# Change of rotation [rad] and of velocity [m/s] from which an IMU factor is linearised anew: its terms of second
# order, rotation times velocity, are below 0.1 mm/s then.
MOVED_ROT, MOVED_VEL = 3e-3, 3e-2
MOVED = 1.0  # sds of any other residual: what a loss weighs changes by a third then at most
MOST_ITERATIONS = 4
BUNCH = 0.125  # of the lag that a keyframe may stay beyond it: they leave together, which costs less


@dataclass(frozen=True, slots=True)
class _Solved:
    """A window as it was solved: its first keyframe, states, constants, and the elimination."""

    first: int
    x: Floats
    c: Floats
    chain: Elimination


class _Window:
    """Keyframes ``first`` .. ``first + len(x) - 1`` of a problem, and the rows that those before them have left.

    ``x`` and ``c`` are the estimates, ``at`` where the rows are linearised; IMU factors have places of their own.
    """

    def __init__(self, problem: Problem, free: np.ndarray, first: int, x: Floats, cov: Floats) -> None:
        """Start at keyframe ``first`` with state ``x`` (21 + e,), covariance ``cov``, and the rig's calibrations."""
        d, m = problem.size, len(free)
        self.problem, self.free, self.first = problem, free, first
        self.x, self.c = x[None].copy(), problem.parameters.start.copy()
        self.at = States(self.x.copy(), self.c.copy())
        self.left = graph.prior_rows(problem.parameters, cov, free)
        self.left_at = States(self.x.copy(), problem.parameters.mean.copy())
        self.factors: list[gtsam.NonlinearFactorGraph] = []
        self.imu_at = np.zeros((0, 2, len(x)))  # where the IMU factors are linearised
        self.imu = Block(np.zeros(0, dtype=int), *np.zeros((2, 0, NAV, d)), np.zeros((0, NAV, m)), np.zeros((0, NAV)))
        self.times, self.zero, self.noise = problem.keyframes_s, graph.no_bias(2), graph.noise_of(problem)
        self.out = {rows.sensor: np.zeros(len(rows), dtype=bool) for rows in problem.rows}
        self.reach = [int((rows.j > rows.i).any()) for rows in problem.rows]
        self.starts = [np.searchsorted(rows.i, np.arange(len(self.times) + 1)) for rows in problem.rows]
        self.sliding = Sliding(d, m, *_most_rows(problem))
        self.solved: _Solved | None = None

    def extend(self) -> None:
        """Add the next keyframe, where the IMU says that it is."""
        x, k = self.x[-1], self.first + len(self.x)
        pim = graph.preintegrate(self.problem, k - 1, x, self.noise)
        before = gtsam.NavState(gtsam.Rot3(x[:9].reshape(3, 3)), x[9:12], x[12:15])
        after = pim.predict(before, gtsam.imuBias.ConstantBias(x[15:18], x[18:21]))
        x = np.concatenate([after.attitude().matrix().ravel(), after.position(), after.velocity(), x[15:]])
        self.x, self.at = np.vstack([self.x, x]), States(np.vstack([self.at.x, x]), self.at.c)
        factor = gtsam.NonlinearFactorGraph()
        factor.add(gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), pim))
        self.factors.append(factor)
        self.imu_at = np.concatenate([self.imu_at, self.x[None, -2:]])
        new, old = graph.imu_block(factor, self.x[-2:], self.zero, len(self.free)), self.imu
        pairs = ((old.A_i, new.A_i), (old.A_j, new.A_j), (old.A_c, new.A_c), (old.b, new.b))
        self.imu = Block(np.arange(len(self.factors)), *(np.concatenate(pair) for pair in pairs))

    def solve(self) -> None:
        """Gauss-Newton from the newest keyframe's rows on, until no residual has moved. Raises ArithmeticError where an
        unknown is not determined."""
        n = len(self.x)
        first = n - 1
        for _ in range(MOST_ITERATIONS):
            self._linearise(first)
            chain = self.sliding.eliminate(max(first - 1, 0), n)
            if missing := chain.undetermined():
                raise ArithmeticError(f"{len(missing)} unknowns of the window are not determined")
            dx, dc = chain.solve()
            self.x, self.c = correct_states(self.at.x, dx), self.at.c.copy()
            self.c[self.free] += dc
            first = min([self.sliding.changed(dx, dc, NAV, MOVED), *np.flatnonzero(self._imu_moved())[:1]])
            if first == n:
                break
        self.solved = _Solved(self.first, self.x, self.c, chain)

    def shut_out(self, k: int, cov: Floats) -> None:
        """Leave out rows of keyframe k, the newest, that its prediction contradicts beyond the gate, from sensors
        whose loss is gnc: they may be biased for long, and no window is long enough to tell later. ``cov`` is that of
        the keyframe before."""
        for rows in self.problem.rows:
            if rows.loss != "gnc":
                continue
            own = slice(*np.searchsorted(rows.j, [k, k + 1]))
            if own.start == own.stop or rows.i[own.start] != k:
                continue
            x = np.repeat(self.x[-1:], own.stop - own.start, axis=0)
            r, J, *_ = rows.evaluate_at(x, x, self.c, own)
            S = J @ cov @ J.transpose(0, 2, 1) + np.eye(rows.dof)
            nis = np.einsum("ni,nij,nj->n", r, np.linalg.inv(S), r)
            self.out[rows.sensor][own] = nis > losses.gate(rows.dof)

    def leave(self, count: int, out: Online) -> None:
        """Let the oldest ``count`` keyframes leave, one at least stays; kept in ``out`` as they were solved last."""
        self._keep(count, out)
        d, rows = self.problem.size, self.sliding.leave(count)[None]
        self.left = Block(np.zeros(1, dtype=int), rows[:, :, :d], None, rows[:, :, d:-1], rows[:, :, -1])
        self.left_at = States(self.at.x[count : count + 1].copy(), self.at.c)
        self.x, self.at, self.first = self.x[count:], States(self.at.x[count:], self.at.c), self.first + count
        self.factors, self.imu_at, imu = self.factors[count:], self.imu_at[count:], self.imu
        self.imu = Block(imu.i[:-count], imu.A_i[count:], imu.A_j[count:], imu.A_c[count:], imu.b[count:])

    def close(self, out: Online, count: int) -> None:
        """Keep the first ``count`` keyframes of the window, and the constants, as the last ones."""
        out.c, out.c_cov[np.ix_(self.free, self.free)] = self.solved.c.copy(), self._keep(count, out)

    def _keep(self, count: int, out: Online) -> Floats:
        """Oldest ``count`` keyframes into ``out`` as solved last, with their rows' residuals; covariance of the
        constants."""
        solved, kept = self.solved, slice(self.first, self.first + count)
        gone = self.first - solved.first
        cov, c_cov = solved.chain.covariances(gone)
        begun = solved.x[gone : gone + count + 1]  # and where rows that begin at the last of them end
        out.last_x[self.first : self.first + len(begun)], out.last_cov[kept] = begun, cov[:count]
        out.residuals(self.problem, kept, self.first + len(begun) - 1, solved.c)
        return c_cov

    def _imu_moved(self) -> np.ndarray:
        """Whether the states of each IMU factor have moved since it was linearised."""
        change = np.abs(np.stack([self.x[:-1], self.x[1:]], axis=1) - self.imu_at)
        return (change[:, :, :9].max(axis=(1, 2)) > MOVED_ROT) | (change[:, :, 12:15].max(axis=(1, 2)) > MOVED_VEL)

    def _linearise(self, first: int) -> None:
        """Linearise the rows on the window's keyframes from ``first`` on, where these are now; on all of them at the
        present constants too."""
        self.at.x[first:] = self.x[first:]
        if first == 0:
            self.at = States(self.at.x, self.c.copy())
            left = graph.about(self.left, self.left_at, self.at, self.free)
            self.sliding.begin(left)
        self.sliding.make_room(len(self.x))
        self.sliding.clear(first)
        before = max(first - 1, 0)  # rows on neighbours may end at the first
        if before < len(self.factors):
            self._linearise_motion(before)
        last = self.first + len(self.x) - 1
        for every, reach, starts in zip(self.problem.rows, self.reach, self.starts, strict=True):
            start = before if reach else first
            if starts[self.first + start] < starts[last + 1 - reach]:
                rows = every.between(self.first + start, last, self.out[every.sensor])
                at = States(self.at.x[start:], self.at.c)
                self.sliding.place(graph.sensor_block(rows, at, self.free)[0], start)

    def _linearise_motion(self, start: int) -> None:
        """Motion from the window's keyframe ``start`` on: of the body, anew where it has moved, and of the drifts."""
        m = len(self.free)
        for n in start + np.flatnonzero(self._imu_moved()[start:]):
            self.imu_at[n] = self.x[n : n + 2]
            block = graph.imu_block(self.factors[n], self.imu_at[n], self.zero, m)
            self.imu.A_i[n], self.imu.A_j[n], self.imu.b[n] = block.A_i[0], block.A_j[0], block.b[0]
        A_i, A_j, A_c, b = (part[start:] for part in (self.imu.A_i, self.imu.A_j, self.imu.A_c, self.imu.b))
        b = b - np.einsum("kij,kj->ki", A_i, difference(self.at.x[start:-1], self.imu_at[start:, 0]))
        b -= np.einsum("kij,kj->ki", A_j, difference(self.at.x[start + 1 :], self.imu_at[start:, 1]))
        self.sliding.place(Block(np.arange(len(b)), A_i, A_j, A_c, b), start)
        if len(self.problem.drift_walk):
            elapsed = np.diff(self.times[self.first + start : self.first + len(self.x)])
            at = States(self.at.x[start:], self.at.c)
            self.sliding.place(graph.drift_block(self.problem, elapsed, at, m), start)


def _most_rows(problem: Problem) -> tuple[int, int]:
    """Rows that any keyframe has alone, and together with its next."""
    alone, next_too = np.zeros((2, len(problem.keyframe_edges)), dtype=int)
    next_too += NAV + len(problem.drift_walk)
    for rows in problem.rows:
        binary = rows.j > rows.i
        for total, own in ((alone, ~binary), (next_too, binary)):
            total += rows.dof * np.bincount(rows.i[own], minlength=len(total))
    return int(alone.max()), int(next_too.max())


class _Lagged:
    """The window as a solver: a new one at every start, of keyframes that are ``lag_s`` old at the most."""

    window: _Window

    def __init__(self, problem: Problem, lag_s: float, out: Online) -> None:
        self.problem, self.lag_s, self.out, self.times = problem, lag_s, out, problem.keyframes_s
        names = problem.parameters.names
        self.free = np.array([k for k in problem.parameters.free if not names[k].endswith(CLOCK)], dtype=int)

    def begin(self, k: int, x: Floats, cov: Floats) -> tuple[Floats, Floats]:
        self.window = _Window(self.problem, self.free, k, x, cov)
        return self._newest(k)

    def add(self, k: int) -> tuple[Floats, Floats]:
        window, now = self.window, self.times[k]
        if self.times[window.first] < now - (1.0 + BUNCH) * self.lag_s:
            leaving = np.searchsorted(self.times, now - self.lag_s) - window.first
            window.leave(min(leaving, k - 1 - window.first), self.out)
        window.extend()
        window.shut_out(k, self.out.causal_cov[k - 1])
        return self._newest(k)

    def forsake(self, k: int) -> None:
        self.window.close(self.out, k - self.window.first)

    def _newest(self, k: int) -> tuple[Floats, Floats]:
        self.window.solve()
        return self.window.x[-1], self.window.solved.chain.covariances(k - self.window.first)[0][0]


def run(problem: Problem, lag_s: float, progress: Callable[[float], None] | None = None) -> Online:
    """Smooth online over ``lag_s`` seconds."""
    out = Online.empty(problem)
    solver = _Lagged(problem, lag_s, out)
    if follow(problem, solver, out, progress):
        solver.forsake(len(problem.keyframe_edges))
    return out
