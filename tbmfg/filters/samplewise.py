"""What filters share that take every sample when it comes, at the IMU edge nearest to it, rather than by keyframe."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from tbmfg.inertial.strapdown import BG_
from tbmfg.measure import GyroFrame, Samples, gyro_frame
from tbmfg.problem import Parameters, Problem
from tbmfg.rig import kind_of
from tbmfg.sensors import Rows
from tbmfg.timeseries import Floats

ToRows = Callable[[str, Samples, GyroFrame, slice], Rows]  # of a sensor; the slice is where its calibrations are


def view(
    problem: Problem,
    kinds: Iterable[str],
    to_rows: ToRows,
    known: Callable[[Parameters], Parameters] = lambda parameters: parameters,
) -> Problem:
    """The problem with the samples of sensors of these ``kinds`` alone, made into rows by ``to_rows``, and with their
    calibrations, which ``known`` may change; nothing drifts."""
    kinds, before, inertial = set(kinds), problem.parameters, problem.inertial
    samples = {name: s for name, s in problem.samples.items() if kind_of(name) in kinds}
    own = [k for k, name in enumerate(before.names) if name.rpartition(".")[0] in samples]
    names = tuple(before.names[k] for k in own)
    parameters = known(Parameters(names, before.mean[own], before.sd[own], before.start[own]))
    frame = gyro_frame(inertial.steps, inertial.gyro, problem.prior.x[BG_])
    rows = [to_rows(name, s, frame, parameters.slice(name)) for name, s in samples.items()]
    return replace(problem, rows=rows, samples=samples, parameters=parameters, drift_names=(), drift_walk=np.zeros(0))


def epochs(problem: Problem) -> np.ndarray:
    """The IMU edges at which a keyframe lies or a row is due, in order."""
    return np.union1d(problem.keyframe_edges, np.concatenate([[], *(rows.i for rows in problem.rows)]).astype(int))


def due(rows: Iterable[Rows], at: np.ndarray) -> list[list[tuple[Rows, int]]]:
    """The rows that belong to each of the epochs ``at``."""
    found: list[list[tuple[Rows, int]]] = [[] for _ in at]
    for one in rows:
        for r, number in enumerate(np.searchsorted(at, one.i)):
            found[number].append((one, r))
    return found


def linearise(rows: Rows, r: int, x: Floats, c: Floats, free: np.ndarray) -> tuple[Floats, Floats]:
    """Whitened residual of one row and its Jacobian to [state, free calibrations]."""
    one = x[None]
    residual, Ji, _, Jc = (part[0] for part in rows.evaluate_at(one, one, c, slice(r, r + 1)))
    calibrations = np.zeros((len(residual), len(c)))
    calibrations[:, rows.calib] = Jc
    return residual, np.hstack([Ji, calibrations[:, free]])
