"""The same problem as GTSAM factors, keyframe by keyframe, for the incremental solvers.

Native factors where one fits (IMU, prism, zero velocity, priors); the shared models inside a CustomFactor elsewhere.
Clocks are those found by ``prepare``.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam import noiseModel
from gtsam.symbol_shorthand import A, B, C, D, V, X

from tbmfg.problem import CLOCK, Problem
from tbmfg.sensors import Rows
from tbmfg.smoother.graph import preintegrate
from tbmfg.smoother.losses import threshold
from tbmfg.state import BA, NAV, POS, ROT, VEL
from tbmfg.timeseries import Floats

BIAS = slice(BA.start, NAV)
FREE_M = 1e3  # sd of a position that a factor of a whole pose is not meant to hold
# which parts of the keyframes i and j a model depends on, in the order of its factor's keys
PARTS = {
    "odometer": ("XB", "X"),
    "magnetometer": ("X", ""),
    "magnetic_field": ("X", ""),
    "barometer": ("XVD", ""),
    "laser": ("XV", ""),
    "position": ("X", ""),
    "bounded": ("XV", ""),
    "lidar": ("XV", "XV"),
}
SYMBOLS = {"X": X, "V": V, "B": B, "D": D}
BLOCKS = {"X": slice(0, 6), "V": VEL, "B": BIAS, "D": slice(NAV, None)}


@dataclass(frozen=True, slots=True)
class Step:
    """What one keyframe adds: factors, and first guesses of the new variables."""

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values


class Factors:
    """Factors of ``problem`` by keyframe."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        n = len(problem.keyframe_edges)
        self.starts = [np.searchsorted(rows.j, np.arange(n + 1)) for rows in problem.rows]
        free = problem.parameters.free
        self.free = [free[(free >= r.calib.start) & (free < r.calib.stop)] for r in problem.rows]
        names = problem.parameters.names
        self.free = [[k for k in own if not names[k].endswith(CLOCK)] for own in self.free]
        self.known: set[int] = set()

    def constant_key(self, sensor: int) -> int | None:
        """Key of a sensor's estimated calibrations, or None."""
        if not self.free[sensor]:
            return None
        return A(sensor) if self.problem.rows[sensor].model == "prism" else C(sensor)

    def constant_parameters(self, sensor: int) -> list[int]:
        """Indices of the parameters behind ``constant_key``: an arm is one point, its known axes among them."""
        rows = self.problem.rows[sensor]
        return list(range(rows.calib.start, rows.calib.start + 3)) if rows.model == "prism" else self.free[sensor]

    def keys(self, k: int) -> list[int]:
        """Keys of keyframe k."""
        return [X(k), V(k), B(k)] + ([D(k)] if len(self.problem.drift_walk) else [])

    def anchor(self, k: int, x: Floats, cov: Floats) -> Step:
        """Prior of keyframe k: state (21 + e,) and covariance (15 + e, 15 + e) in our chart; correlations across
        pose, velocity, biases and drifts are dropped."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        insert_state(values, k, x)
        turn = pose_chart(x)
        pose = turn.T @ cov[:6, :6] @ turn
        graph.add(gtsam.PriorFactorPose3(X(k), values.atPose3(X(k)), noiseModel.Gaussian.Covariance(pose)))
        graph.add(gtsam.PriorFactorVector(V(k), x[12:15], noiseModel.Gaussian.Covariance(cov[VEL, VEL])))
        bias = noiseModel.Gaussian.Covariance(cov[BIAS, BIAS])
        graph.add(gtsam.PriorFactorConstantBias(B(k), gtsam.imuBias.ConstantBias(x[15:18], x[18:21]), bias))
        if len(self.problem.drift_walk):
            drift = noiseModel.Gaussian.Covariance(cov[NAV:, NAV:])
            graph.add(gtsam.PriorFactorVector(D(k), x[21:], drift))
        self.known.clear()
        return Step(graph, values)

    def motion(self, k: int, x_before: Floats, step: Step) -> None:
        """Add the IMU factor from keyframe k - 1, preintegrated at the biases of ``x_before``, and its guess of k."""
        pim = preintegrate(self.problem, k - 1, x_before)
        step.graph.add(gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), pim))
        bias = gtsam.imuBias.ConstantBias(x_before[15:18], x_before[18:21])
        before = gtsam.NavState(gtsam.Rot3(x_before[:9].reshape(3, 3)), x_before[9:12], x_before[12:15])
        after = pim.predict(before, bias)
        x = np.concatenate([after.attitude().matrix().ravel(), after.position(), after.velocity(), x_before[15:]])
        insert_state(step.values, k, x)
        if len(self.problem.drift_walk):
            t = self.problem.keyframes_s
            sigma = np.maximum(self.problem.drift_walk * np.sqrt(t[k] - t[k - 1]), 1e-9)
            zero = np.zeros(len(sigma))
            step.graph.add(gtsam.BetweenFactorVector(D(k - 1), D(k), zero, noiseModel.Diagonal.Sigmas(sigma)))

    def measurements(self, k: int, x_guess: Floats, step: Step, anchored: bool = False) -> None:
        """Add the rows of keyframe k; ``anchored`` leaves out those that reach back to k - 1."""
        for sensor, rows in enumerate(self.problem.rows):
            for r in range(self.starts[sensor][k], self.starts[sensor][k + 1]):
                if anchored and rows.i[r] != rows.j[r]:
                    continue
                step.graph.add(self._factor(sensor, rows, r, x_guess))
                key = self.constant_key(sensor)
                if key is not None:
                    self._constant(sensor, key, step)

    def _constant(self, sensor: int, key: int, step: Step) -> None:
        """A calibration with its prior, when it first appears."""
        if key in self.known:
            return
        self.known.add(key)
        parameters, which = self.problem.parameters, self.constant_parameters(sensor)
        # a known axis of an arm is held by a sd far below any sensor
        noise = noiseModel.Diagonal.Sigmas(np.maximum(parameters.sd[which], 1e-6))
        step.values.insert(key, parameters.start[which])
        prior = gtsam.PriorFactorPoint3 if len(which) == 3 else gtsam.PriorFactorVector
        step.graph.add(prior(key, parameters.mean[which], noise))

    def _factor(self, sensor: int, rows: Rows, r: int, x: Floats) -> gtsam.NonlinearFactor:
        k, key = int(rows.j[r]), self.constant_key(sensor)
        if rows.model == "velocity":
            return gtsam.PriorFactorVector(V(k), rows.z[r], robust(rows.sigma[r], rows.loss))
        if rows.model == "rotation":
            noise = robust(np.append(rows.sigma[r], np.full(3, FREE_M)), rows.loss)
            return gtsam.BetweenFactorPose3(X(int(rows.i[r])), X(k), gtsam.Pose3(), noise)
        if rows.model == "prism":
            noise, z = robust(rows.sigma[r], rows.loss), self._at_keyframe(rows, r, x)
            if key is None:
                return gtsam.GPSFactorArm(X(k), z, self.problem.parameters.start[rows.calib][:3], noise)
            return gtsam.GPSFactorArmCalib(X(k), key, z, noise)
        return self._custom(sensor, rows, r)

    def _at_keyframe(self, rows: Rows, r: int, x: Floats) -> Floats:
        """A fix carried over its lag, half an IMU period at most, to the keyframe by the guessed velocity."""
        arm, lag = self.problem.parameters.start[rows.calib][:3], rows.data[r, 0]
        velocity = x[12:15] + x[:9].reshape(3, 3) @ np.cross(rows.data[r, 1:4], arm)
        return rows.z[r] - velocity * lag

    def _custom(self, sensor: int, rows: Rows, r: int) -> gtsam.CustomFactor:
        """A row of a shared model as a factor: whitened by the model, so of unit noise."""
        parts = [("i", part) for part in PARTS[rows.model][0]] + [("j", part) for part in PARTS[rows.model][1]]
        i, j, key, free = int(rows.i[r]), int(rows.j[r]), self.constant_key(sensor), self.free[sensor]
        keys = [SYMBOLS[part](i if side == "i" else j) for side, part in parts] + ([key] if key is not None else [])
        start, e, one = self.problem.parameters.start, len(self.problem.drift_walk), slice(r, r + 1)
        local = [k - rows.calib.start for k in free]

        def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Floats] | None) -> Floats:
            x = {"i": _read(values, i, PARTS[rows.model][0], e)}
            x["j"] = x["i"] if i == j else _read(values, j, PARTS[rows.model][1], e)
            c = start.copy()
            if key is not None:
                c[free] = values.atVector(key)
            residual, Ji, Jj, Jc = rows.evaluate_at(x["i"][None], x["j"][None], c, one)
            if H is not None:
                for n, (side, part) in enumerate(parts):
                    J = (Ji if side == "i" else Jj)[0][:, BLOCKS[part]]
                    H[n] = np.asfortranarray(J @ pose_chart(x[side]) if part == "X" else J)
                if key is not None:
                    H[-1] = np.asfortranarray(Jc[0][:, local])
            return residual[0]

        return gtsam.CustomFactor(robust(np.ones(rows.dof), rows.loss), keys, error)


def robust(sigma: Floats, loss: str) -> gtsam.noiseModel.Base:
    """Diagonal noise under a loss, with the thresholds of ``losses.weight``."""
    noise = noiseModel.Diagonal.Sigmas(sigma)
    if loss == "none":
        return noise
    estimator = noiseModel.mEstimator.Huber if loss == "huber" else noiseModel.mEstimator.Cauchy
    return noiseModel.Robust.Create(estimator.Create(threshold(len(sigma))), noise)


def pose_chart(x: Floats) -> Floats:
    """GTSAM's pose error [rot, pos in b] to ours [rot, pos in n] at state ``x``; (6, 6)."""
    out = np.eye(6)
    out[POS, POS] = x[:9].reshape(3, 3)
    return out


def insert_state(values: gtsam.Values, k: int, x: Floats) -> None:
    """Insert keyframe k's state (21 + e,)."""
    values.insert(X(k), gtsam.Pose3(gtsam.Rot3(x[:9].reshape(3, 3)), x[9:12]))
    values.insert(V(k), x[12:15])
    values.insert(B(k), gtsam.imuBias.ConstantBias(x[15:18], x[18:21]))
    if len(x) > 21:
        values.insert(D(k), x[21:])


def read_state(source: gtsam.Values | gtsam.ISAM2, k: int, e: int) -> Floats:
    """Keyframe k's state (21 + e,) from values."""
    return _read(source, k, "XVBD" if e else "XVB", e)


def _read(values: gtsam.Values, k: int, parts: str, e: int) -> Floats:
    x = np.zeros(21 + e)
    if "X" in parts:
        pose = values.atPose3(X(k))
        x[:9], x[9:12] = pose.rotation().matrix().ravel(), pose.translation()
    if "V" in parts:
        x[12:15] = values.atVector(V(k))
    if "B" in parts:
        x[15:21] = values.atConstantBias(B(k)).vector()
    if "D" in parts:
        x[21:] = values.atVector(D(k))
    return x


def to_our_chart(cov: Floats, x: Floats) -> Floats:
    """Joint covariance [pose, velocity, bias, drift] of GTSAM to ours, (15 + e, 15 + e)."""
    turn = np.eye(len(cov))
    turn[ROT.start : POS.stop, ROT.start : POS.stop] = pose_chart(x)
    return turn @ cov @ turn.T
