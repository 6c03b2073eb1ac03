"""What smoothing online gives: two trajectories, and where a solver had to start again."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tbmfg.problem import Problem
from tbmfg.timeseries import Floats

REANCHOR_INFLATION = 4.0  # of the covariance that a failed solver is started again from


@dataclass(slots=True)
class Online:
    """Causal states (n, 21 + e) and covariances (each keyframe as estimated when it was the newest), last estimates,
    and constants; by sensor and row the squared normalised residuals at the last estimate; ``reanchored`` lists
    (keyframe, reason)."""

    causal_x: Floats
    causal_cov: Floats
    last_x: Floats
    last_cov: Floats
    c: Floats
    c_cov: Floats
    nis: dict[str, Floats]
    reanchored: list[tuple[int, str]] = field(default_factory=list)

    @staticmethod
    def empty(problem: Problem) -> Online:
        """Room for the estimates of ``problem``."""
        n, d, m = len(problem.keyframe_edges), problem.size, len(problem.parameters.names)
        nis = {rows.sensor: np.full(len(rows), np.nan) for rows in problem.rows}
        return Online(
            np.empty((n, d + 6)), np.empty((n, d, d)), np.empty((n, d + 6)), np.empty((n, d, d)),
            problem.parameters.start.copy(), np.zeros((m, m)), nis,
        )  # fmt: skip

    def residuals(self, problem: Problem, keyframes: slice, c: Floats) -> None:
        """Squared normalised residuals of the keyframes' rows at the last estimates, in place."""
        for rows in problem.rows:
            own = slice(*np.searchsorted(rows.j, [keyframes.start, keyframes.stop]))
            if own.start < own.stop:
                r = rows.evaluate_at(self.last_x[rows.i[own]], self.last_x[rows.j[own]], c, own)[0]
                self.nis[rows.sensor][own] = np.sum(r**2, axis=1)
