"""How noisy each sensor is on this machine, from what the smoother leaves of its readings: no truth is needed.

Variance components by restricted maximum likelihood (Patterson, Thompson 1971): with the rows whitened, R = I - H what
the adjustment leaves of an error, and u = 2 log f of a sensor's factor f, the score is (r'r - tr R_ss) / 2 and its
information tr(R_ss^2) / 2 over the sensor's own rows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tbmfg.chance import chi_square_below, chi_square_point
from tbmfg.filters import ins
from tbmfg.problem import GATE, Problem
from tbmfg.sensors import Rows
from tbmfg.smoother import batch
from tbmfg.state import Calibrated
from tbmfg.timeseries import Floats

PRIOR_SD = 4.0 * np.log(2.0)  # of u, about the rig's own: a factor of 4
MOST = 10  # iterations
LEAST = 1e-4  # squared residual: a sensor without noise leaves none
SETTLED = 0.01  # of u
LEAP = 1.5  # of u in one iteration


def factors(problem: Problem, names: list[str]) -> dict[str, Calibrated]:
    """Factors on the noise of the sensors ``names`` as ``problem`` has it, with their sds.

    A row beyond the gate at the present factor is an outlier and left out, and a row inside is a little smaller than
    it would be without a gate.
    """
    filtered = ins.run(problem)
    smoothed = batch.solve(problem, filtered.x, filtered.c)
    x, c = smoothed.x, smoothed.c
    own = {rows.sensor: rows for rows in problem.rows if rows.sensor in names and len(rows)}
    # the median does not mind outliers, and so tells which rows are none to begin with
    median = {name: max(np.median(smoothed.nis[name]), LEAST) / chi_square_point(0.5, own[name].dof) for name in own}
    u = {name: float(np.log(value)) for name, value in median.items()}
    sd = dict.fromkeys(own, PRIOR_SD)
    for _ in range(MOST):
        scaled = [_scaled(rows, u.get(rows.sensor, 0.0)) for rows in problem.rows]
        nis = {rows.sensor: np.sum(rows.evaluate(x, c)[0] ** 2, axis=1) for rows in scaled}
        sound = [rows.between(0, len(x) - 1, nis[rows.sensor] > chi_square_point(GATE, rows.dof)) for rows in scaled]
        clean = replace(problem, rows=[replace(rows, loss="none") for rows in sound if len(rows)])
        smoothed = batch.solve(clean, x, c)
        x, c = smoothed.x, smoothed.c
        moved = 0.0
        for rows in clean.rows:
            name = rows.sensor
            if name not in own:
                continue
            which = noisy(rows)
            trace, square = batch.residual_traces(clean, x, c, name, which)
            r = rows.evaluate(x, c)[0][:, which]
            # share of the variance of rows that are inside the gate
            inside = chi_square_below(chi_square_point(GATE, rows.dof), rows.dof + 2) / GATE
            information = 0.5 * square + PRIOR_SD**-2.0
            step = (0.5 * (np.sum(r**2) / inside - trace) - u[name] * PRIOR_SD**-2.0) / information
            u[name] += float(np.clip(step, -LEAP, LEAP))
            sd[name] = information**-0.5
            moved = max(moved, abs(step))
        if moved < SETTLED:
            break
    found = {name: float(np.exp(0.5 * value)) for name, value in u.items()}
    return {name: Calibrated(f, 0.5 * f * float(sd[name]), True) for name, f in found.items()}


def noisy(rows: Rows) -> slice:
    """The components of a row that hold the sensor's own noise: that an odometer does not slide is no reading of it."""
    return slice(0, 1) if rows.model == "odometer" else slice(None)


def _scaled(rows: Rows, u: float) -> Rows:
    sigma: Floats = rows.sigma.copy()
    sigma[:, noisy(rows)] *= np.exp(0.5 * u)
    return replace(rows, sigma=sigma)
