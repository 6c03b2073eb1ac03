"""Worlds and problems for the tests of the estimation core: a lively flight and a quiet drive with known truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, B, V, X
from scipy.spatial.transform import Rotation

import datasets
from datasets import sensors
from datasets.motion import Lines, Motion, Spline
from datasets.simulate import Simulation, simulate
from tbmfg.prepare import prepare
from tbmfg.problem import Problem
from tbmfg.rig import Rig, override, parse_rig
from tbmfg.smoother import graph
from tbmfg.timeseries import Floats, Log, Series, StreamCounts

EPS = np.finfo(float).eps

FLIGHT_RIG = """
name: flight
origin: {latitude_deg: 47.0, x_axis_azimuth_deg: 30}
initial: {yaw_sd_deg: 2, tilt_sd_deg: 1, position_sd_m: 0.05, velocity_sd_mps: 0.05}
keyframes: {max_rate_hz: 25, max_gap_s: 0.5}
sensors:
  imu:
    topic: /imu
    gyro_density_dps_rthz: 0.005
    acc_density_ug_rthz: 100
    gyro_walk: 1.0e-5
    acc_walk: 1.0e-4
    gyro_bias_sd_dps: 0.05
    acc_bias_sd_mps2: 0.03
  prism: {topic: /prism, arm_m: [0.3, -0.2, 0.5], arm_sd_m: 0.02, clock_offset_s: 0.01, clock_offset_sd_s: 0.01}
  magnetometer: {topic: /mag, sigma_deg: 2, declination_deg: 3, declination_sd_deg: 1}
"""

# Each line of the flight shakes all six of (x, y, z, roll, pitch, yaw); phases as drawn here, once.
FREQUENCY_HZ = np.array([0.11, 0.23, 0.41, 0.73])
SIZE = np.array(
    [[2.0, 2.5, 0.8, 0.2, 0.2, 0.9], [0.6, 0.5, 0.3, 0.1, 0.1, 0.3]] + [[0.1, 0.1, 0.1, 0.05, 0.05, 0.1]] * 2
)
PHASE = np.exp(2j * np.pi * np.random.default_rng(5).random(SIZE.shape))


def flight_path(stand_s: float, duration_s: float) -> Motion:
    """Standing away from every axis for ``stand_s``, then moving in all six degrees of freedom."""
    t = np.arange(-1.0, duration_s + 1.5, 0.05)
    share = np.clip((t - stand_s) / 2.0, 0.0, 1.0)
    waves = Lines(FREQUENCY_HZ, SIZE * PHASE, Spline(t, (share**3 * (10 - 15 * share + 6 * share**2))[:, None]))
    at = np.array([20.0, -9.0, 4.0, 0.08, -0.12, 0.7])

    def path(t_s: Floats) -> tuple[Floats, Floats, Floats]:
        value, rate, acceleration = waves(t_s)
        return at + value, rate, acceleration

    return Motion(path)


@cache
def flight(
    seed: int = 0,
    duration: float = 20.0,
    settings: tuple[str, ...] = (),
    *,
    stand_s: float = 4.0,
    imu_rate_hz: float = 200.0,
    prism_rate_hz: float = 10.0,
) -> Simulation:
    """A body in lively motion with IMU, prism and magnetometer, all drawn from the rig."""
    kinds = {
        "imu": lambda *a: sensors.imu(*a, rate_hz=imu_rate_hz),
        "prism": lambda *a: sensors.prism(*a, rate_hz=prism_rate_hz),
        "magnetometer": lambda *a: sensors.magnetometer(*a, rate_hz=20.0),
    }
    rig = override(parse_rig(FLIGHT_RIG, "flight"), settings)
    path = flight_path(stand_s, duration)
    return simulate("flight", path, rig, kinds, seed=seed, duration_s=duration, truth_rate_hz=50.0)


@cache
def drive(seed: int = 0, duration: float = 30.0, settings: tuple[str, ...] = (), **options: float) -> Simulation:
    """The roadheader as the estimators model it: no vibration, and it slides as the rig says; IMU at 200 Hz."""
    options = {"vibration": 0.0, "slide": 1.0, "imu_rate_hz": 200.0, **options}
    known = ("sensors.imu.noise_factor=1", *settings)
    return datasets.make("tbm-drive", seed=seed, duration=duration, settings=known, **options)


def log_of(series: tuple[Series, ...] | list[Series]) -> Log:
    """A log as the reader would return it, every message received and none lost."""
    return Log("simulated", {s.topic: replace(s, counts=StreamCounts(received=len(s))) for s in series})


def clean_log(simulation: Simulation) -> Log:
    """The same recording by perfect sensors: no noise, no bias, no scale, no clock offset."""
    return log_of(list(simulation.clean.values()))


@cache
def flight_problem(seed: int = 0, duration: float = 20.0, settings: tuple[str, ...] = ()) -> Problem:
    """The prepared problem of a flight: not to be changed in place."""
    simulation = flight(seed, duration, settings)
    return prepare(log_of(simulation.log_series), simulation.rig)


def true_states(simulation: Simulation, problem: Problem, biases: bool = True) -> Floats:
    """Truth at the problem's keyframes as the estimators hold it, (n, 21): R, position, velocity, biases."""
    t_s = problem.keyframes_s + (problem.t0_ns - simulation.start_ns) * 1e-9
    truth = simulation.truth(t_s)
    x = np.zeros((len(t_s), 21))
    x[:, :9] = truth.R.reshape(-1, 9)
    x[:, 9:12], x[:, 12:15] = truth.position - problem.origin_n, truth.velocity
    if biases:
        drawn = simulation.drawn["imu"]
        rows = np.clip(problem.keyframe_edges - 1, 0, len(drawn["bias_acc"]) - 1)
        x[:, 15:18], x[:, 18:21] = drawn["bias_acc"][rows], drawn["bias_gyro"][rows]
    return x


def state_errors(x: Floats, true: Floats) -> Floats:
    """Estimate (-) truth in the order of the package docstring; (n, 21) each -> (n, 15)."""
    from tbmfg.geometry import log_so3

    R, R_true = x[:, :9].reshape(-1, 3, 3), true[:, :9].reshape(-1, 3, 3)
    return np.hstack([log_so3(np.swapaxes(R_true, 1, 2) @ R), x[:, 9:21] - true[:, 9:21]])


def imu_series(gyro: Floats, acc: Floats, period_ns: int = 5_000_000, t_ns: np.ndarray | None = None) -> Series:
    """An Imu topic with the given samples, (n, 3) each, at a regular rate unless stamps are given."""
    t_ns = 1_700_000_000_000_000_000 + period_ns * np.arange(1, len(gyro) + 1) if t_ns is None else t_ns
    columns = {"gyro": np.array(gyro, float), "acc": np.array(acc, float)}
    return Series("/imu", "sensor_msgs/msg/Imu", np.asarray(t_ns, dtype=np.int64), columns, "imu")


def worst(found: Floats, expected: Floats, tolerance: float | Floats, rows: list[str], columns: list[str]) -> str:
    """What to say of two matrices that differ by more than ``tolerance``: the worst entry. Empty if they agree."""
    excess = np.abs(found - expected) / tolerance
    excess = np.where(np.isfinite(excess), excess, np.inf)
    i, j = np.unravel_index(np.argmax(excess), excess.shape)
    if excess[i, j] <= 1.0:
        return ""
    return (
        f"d {rows[i]} / d {columns[j]}: {found[i, j]:.10g}, should be {expected[i, j]:.10g}; "
        f"{excess[i, j]:.3g} times the tolerance; {int(np.sum(excess > 1))} of {excess.size} entries are wrong"
    )


def axes(*names: str) -> list[str]:
    """rot -> rot.x, rot.y, rot.z and so on."""
    return [f"{name}.{axis}" for name in names for axis in "xyz"]


ERRORS = axes("rot", "pos", "vel", "acc bias", "gyro bias")


def true_rig(simulation: Simulation) -> Rig:
    """The simulation's rig with every prior mean at the truth; the sds stay."""
    start, rig, drawn = simulation.truth(np.zeros(1)), simulation.rig, simulation.drawn
    yaw, pitch, roll = np.degrees(Rotation.from_matrix(start.R[0]).as_euler("ZYX"))
    settings = [
        f"initial.yaw_deg={yaw}",
        f"initial.pitch_deg={pitch}",
        f"initial.roll_deg={roll}",
        f"initial.position_m={start.position[0].tolist()}",
        f"initial.velocity_mps={start.velocity[0].tolist()}",
        f"sensors.prism.arm_m={drawn['prism']['arm_m'].tolist()}",
        "sensors.prism.clock_offset_s=0",
        f"sensors.magnetometer.declination_deg={drawn['magnetometer']['declination_deg']}",
    ]
    return override(rig, settings)


NATIVE = ("sensors.prism.clock_offset_sd_s=0", "sensors.prism.clock_offset_s=0", "sensors.prism.loss=none")


def native_problem() -> Problem:
    """A flight whose sensors GTSAM has factors for: prism and its arm, some 50 keyframes."""
    problem = flight_problem(1, 6.0, NATIVE)
    prism = next(rows for rows in problem.rows if rows.sensor == "prism")
    prism = replace(prism, data=prism.data * [0.0, 1.0, 1.0, 1.0, 1.0])
    return replace(problem, rows=[prism], prior=replace(problem.prior, cov=problem.prior.filter_cov))


def gtsam_graph(
    problem: Problem, x: Floats, c: Floats, last: int | None = None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, slice]:
    """``native_problem`` up to keyframe ``last`` as a graph of GTSAM's own factors, its values at the states ``x``
    (n, 21) and calibrations ``c``, and where the arm, A(0), lies in ``c``."""
    last = len(x) - 1 if last is None else last
    short = replace(problem, keyframe_edges=problem.keyframe_edges[: last + 1])
    [prism], x = problem.rows, x[: last + 1]
    prior, parameters = problem.prior, problem.parameters
    g = graph.imu_graph(short, x)
    turn = np.eye(6)
    turn[3:, 3:] = prior.x[:9].reshape(3, 3)
    pose = gtsam.Pose3(gtsam.Rot3(prior.x[:9].reshape(3, 3)), prior.x[9:12])
    gaussian, sigmas = gtsam.noiseModel.Gaussian.Covariance, gtsam.noiseModel.Diagonal.Sigmas
    g.add(gtsam.PriorFactorPose3(X(0), pose, gaussian(turn.T @ prior.cov[:6, :6] @ turn)))
    g.add(gtsam.PriorFactorVector(V(0), prior.x[12:15], gaussian(prior.cov[6:9, 6:9])))
    bias = gtsam.imuBias.ConstantBias(prior.x[15:18], prior.x[18:21])
    g.add(gtsam.PriorFactorConstantBias(B(0), bias, gaussian(prior.cov[9:, 9:])))
    arm = slice(parameters.names.index("prism.arm_x"), parameters.names.index("prism.arm_x") + 3)
    g.add(gtsam.PriorFactorPoint3(A(0), parameters.mean[arm], sigmas(parameters.sd[arm])))
    for k, z, sigma in zip(prism.j, prism.z, prism.sigma, strict=True):
        if k <= last:
            g.add(gtsam.GPSFactorArmCalib(X(int(k)), A(0), z, sigmas(sigma)))
    values = graph.values(x, graph.no_bias(len(x)))
    values.insert(A(0), c[arm])
    return g, values, arm


def gtsam_marginal(marginals: gtsam.Marginals, k: int, x: Floats) -> Floats:
    """Joint covariance of keyframe k, (15, 15), in our chart at its state ``x`` (21,)."""
    keys = gtsam.KeyVector([X(k), V(k), B(k)])
    joint = marginals.jointMarginalCovariance(keys)
    turn = np.eye(15)
    turn[3:6, 3:6] = x[:9].reshape(3, 3)
    return turn @ np.block([[joint.at(a, b) for b in keys] for a in keys]) @ turn.T
