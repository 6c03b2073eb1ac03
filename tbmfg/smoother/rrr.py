"""RRR-MF, as Liu, Wang & Tao (TBM-MSE) compare with it: a filter's poses and LiDAR odometry in one factor graph.

The paper says of it that a filter of inertial unit and total station gives one factor and LiDAR odometry the other, and
that it "relies on the accuracy of LiDAR odometry". So: a prior at every keyframe, which is the filter's state with its
covariance, and every step of the odometry with one fixed covariance and no robust loss, whatever the walls tell. The
filter's states share their fixes; as independent priors they count them many times, and the covariance is too small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from tbmfg.fields import DEG, Node, Positive, si
from tbmfg.inertial.strapdown import correct_states, difference
from tbmfg.sensors import Rows
from tbmfg.smoother.chain import Block, eliminate
from tbmfg.smoother.graph import States, sensor_block
from tbmfg.timeseries import Floats

MOST = 10
CONVERGED = 1e-3  # largest step in prior sds that ends the iteration
ROOT = slice(35, 71)  # of the model's data: the square root of a step's information
NONE = np.zeros(0, dtype=int)


class RrrMf(Node):
    """Switches of ``tbm-rrr-mf``; the paper gives no covariance of its odometry."""

    sigma_m: Positive = Field(0.01, description="Of every step of the LiDAR odometry, per axis.")
    sigma_deg: Positive = Field(0.1, description="Of every step's turn, per axis.")

    sigma = si("sigma_m")
    turn = si("sigma_deg", DEG)


@dataclass(frozen=True, slots=True)
class Fused:
    """States (n, 21) and covariances (n, 15, 15), the steps' squared normalised residuals by LiDAR, and whether the
    last of MOST iterations had converged."""

    x: Floats
    cov: Floats
    nis: dict[str, Floats]
    converged: bool


def trusted(rows: Rows, switches: RrrMf) -> Rows:
    """Steps of LiDAR odometry with the switches' covariance in place of their own."""
    data = rows.data.copy()
    data[:, ROOT] = np.diag(1.0 / np.repeat([switches.turn, switches.sigma], 3)).ravel()
    return replace(rows, data=data, sigma=np.ones_like(rows.sigma), loss="none")


def solve(x: Floats, cov: Floats, steps: list[Rows], c: Floats) -> Fused:
    """Gauss-Newton from the priors' means ``x`` (n, 21) with covariances ``cov`` (n, 15, 15); calibrations ``c`` are
    known."""
    n, d = len(x), cov.shape[1]
    root = np.linalg.inv(np.linalg.cholesky(cov))
    sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    states = States(x, c)
    for _ in range(MOST):
        off = -(root @ difference(states.x, x)[:, :, None])[:, :, 0]
        blocks, nis = [Block(np.arange(n), root, None, np.zeros((n, d, 0)), off)], {}
        for rows in steps:
            block, nis[rows.sensor] = sensor_block(rows, states, NONE)
            blocks.append(block)
        chain = eliminate(blocks, n, d, 0)
        dx, _ = chain.solve()
        states = States(correct_states(states.x, dx), c)
        if converged := bool(np.abs(dx / sd).max() < CONVERGED):
            break
    return Fused(states.x, chain.covariances()[0], nis, converged)
