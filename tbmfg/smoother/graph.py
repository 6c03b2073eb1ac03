"""The factor graph of a problem: IMU factors in GTSAM, every other sensor through its shared model."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from tbmfg.inertial.strapdown import difference
from tbmfg.problem import Parameters, Problem
from tbmfg.sensors import Rows
from tbmfg.smoother import losses
from tbmfg.smoother.chain import Block
from tbmfg.state import NAV, POS
from tbmfg.timeseries import Floats

INTEGRATION_PSD = 1e-12  # m^2/s: keeps a one-sample interval's covariance regular, far below any sensor
# columns of a CombinedImuFactor's Jacobian (pose, velocity at i; at j; bias at i; at j) in our order
COLUMNS = np.r_[0:9, 18:24, 9:18, 24:30]


@dataclass(frozen=True, slots=True)
class States:
    """Keyframe states ``x`` (n, 21 + e) and constant calibrations ``c``."""

    x: Floats
    c: Floats


def imu_graph(problem: Problem, x: Floats) -> gtsam.NonlinearFactorGraph:
    """CombinedImuFactor between neighbours, preintegrated at the biases of ``x`` (n, 21 + e)."""
    graph = gtsam.NonlinearFactorGraph()
    base = noise_of(problem)
    for k in range(len(problem.keyframe_edges) - 1):
        pim = preintegrate(problem, k, x[k], base)
        graph.add(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), pim))
    return graph


def preintegrate(
    problem: Problem, k: int, x: Floats, base: gtsam.PreintegrationCombinedParams | None = None
) -> gtsam.PreintegratedCombinedMeasurements:
    """IMU between keyframes k and k + 1 at the biases of ``x`` (21 + e,); ``base``: parameters without extra noise."""
    inertial = problem.inertial
    rows = slice(*problem.keyframe_edges[k : k + 2])
    dt = np.diff(inertial.steps.edges_s[rows.start : rows.stop + 1])
    # steps that stand in for lost samples: their extra noise, spread over the interval
    extra = [float(v[rows] @ dt / dt.sum()) for v in (inertial.steps.extra_gyro, inertial.steps.extra_acc)]
    parameters = base if base is not None and not any(extra) else noise_of(problem, *extra)
    pim = gtsam.PreintegratedCombinedMeasurements(parameters, gtsam.imuBias.ConstantBias(x[15:18], x[18:21]))
    for acc, gyro, step in zip(inertial.acc[rows], inertial.gyro[rows], dt, strict=True):
        pim.integrateMeasurement(acc, gyro, step)
    return pim


def noise_of(problem: Problem, extra_gyro: float = 0.0, extra_acc: float = 0.0) -> gtsam.PreintegrationCombinedParams:
    """The IMU's noise and field for GTSAM, with the extra noise of steps that stand in for lost samples."""
    inertial = problem.inertial
    p = gtsam.PreintegrationCombinedParams(inertial.gravity_n)
    p.setGyroscopeCovariance(np.eye(3) * (inertial.white_gyro + extra_gyro))
    p.setAccelerometerCovariance(np.eye(3) * (inertial.white_acc + extra_acc))
    p.setIntegrationCovariance(np.eye(3) * INTEGRATION_PSD)
    p.setBiasAccCovariance(np.eye(3) * inertial.psd_ba)
    p.setBiasOmegaCovariance(np.eye(3) * inertial.psd_bg)
    if np.any(inertial.earth_n):
        p.setOmegaCoriolis(inertial.earth_n)
    return p


def no_bias(n: int) -> gtsam.Values:
    """Zero biases of n keyframes: inserting a bias costs 30 us, moving one by retraction 1.5 us."""
    out = gtsam.Values()
    for k in range(n):
        out.insert(B(k), gtsam.imuBias.ConstantBias())
    return out


def values(x: Floats, zero: gtsam.Values) -> gtsam.Values:
    """GTSAM values of the keyframe states (n, 21 + e); ``zero`` from ``no_bias``."""
    biases = gtsam.VectorValues()
    for k, bias in enumerate(x[:, 15:21]):
        biases.insert(B(k), bias)
    out = zero.retract(biases)
    for k, row in enumerate(x):
        out.insert(X(k), gtsam.Pose3(gtsam.Rot3(row[:9].reshape(3, 3)), row[9:12]))
        out.insert(V(k), row[12:15])
    return out


def imu_block(graph: gtsam.NonlinearFactorGraph, x: Floats, zero: gtsam.Values, m: int) -> Block:
    """The IMU factors linearised at ``x``, whitened, in our chart (position in n; GTSAM has it in b)."""
    e = x.shape[1] - 21
    linear = graph.linearize(values(x, zero))
    n = graph.size()
    A, b = np.empty((n, 15, 30)), np.empty((n, 15))
    for k in range(n):
        factor = linear.at(k)
        A[k], b[k] = factor.getA(), factor.getb()
    del linear  # some kilobytes a factor
    R = x[:, :9].reshape(-1, 3, 3)
    sides = []
    for columns, rotation in ((COLUMNS[:NAV], R[:-1]), (COLUMNS[NAV:], R[1:])):
        side = np.zeros((n, NAV, NAV + e))
        side[:, :, :NAV] = A[:, :, columns]
        side[:, :, POS] = side[:, :, POS] @ rotation.transpose(0, 2, 1)
        sides.append(side)
    return Block(np.arange(n), sides[0], sides[1], np.zeros((n, 15, m)), b)


def sensor_block(rows: Rows, states: States, free: np.ndarray, mu: float | None = None) -> tuple[Block, Floats]:
    """A sensor's rows linearised and weighted by their loss, and their squared normalised residuals (n,)."""
    r, Ji, Jj, Jc = rows.evaluate(states.x, states.c)
    nis = np.sum(r**2, axis=1)
    A_c = np.zeros((len(r), r.shape[1], len(states.c)))
    A_c[:, :, rows.calib] = Jc
    A_c = A_c[:, :, free]
    if rows.loss != "none":
        root = np.sqrt(losses.weight(nis, rows.loss, rows.dof, mu))[:, None]
        r *= root
        for J in (Ji, Jj, A_c):
            J *= root[:, :, None]
    return Block(rows.i, Ji, Jj if Jj.shape[2] else None, A_c, -r), nis


def drift_block(problem: Problem, elapsed_s: Floats, states: States, m: int) -> Block:
    """Random walk of the drifting calibrations between neighbours, ``elapsed_s`` (n - 1,) apart."""
    n, d, e = len(states.x) - 1, problem.size, len(problem.drift_walk)
    sigma = np.maximum(problem.drift_walk * np.sqrt(elapsed_s)[:, None], 1e-9)
    A_i, A_j = np.zeros((n, e, d)), np.zeros((n, e, d))
    which = np.arange(e)
    A_i[:, which, NAV + which], A_j[:, which, NAV + which] = -1.0 / sigma, 1.0 / sigma
    b = -(states.x[1:, 21:] - states.x[:-1, 21:]) / sigma
    return Block(np.arange(n), A_i, A_j, np.zeros((n, e, m)), b)


def prior_rows(parameters: Parameters, cov: Floats, free: np.ndarray) -> Block:
    """Prior with covariance ``cov`` of a first state's error, and of the free calibrations, about their means."""
    d, m = len(cov), len(free)
    A, A_c = np.zeros((1, d + m, d)), np.zeros((1, d + m, m))
    A[0, :d] = np.linalg.inv(np.linalg.cholesky(cov))
    A_c[0, d:] = np.diag(1.0 / parameters.sd[free])
    return Block(np.zeros(1, dtype=int), A, None, A_c, np.zeros((1, d + m)))


def about(rows: Block, at: States, states: States, free: np.ndarray) -> Block:
    """Linear rows on keyframe 0 that were made about ``at``, about the first of ``states``."""
    move, change = difference(states.x[:1], at.x[:1])[0], (states.c - at.c)[free]
    return Block(rows.i, rows.A_i, None, rows.A_c, rows.b - rows.A_i @ move - rows.A_c @ change)
