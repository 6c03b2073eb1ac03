"""One simulated log through every estimator, and what its hidden truth says of the results."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tbmfg.errors import TbmfgError
from tbmfg.state import POS
from tbmfg.timeseries import Floats, Log, StreamCounts, Times

if TYPE_CHECKING:
    from datasets.simulate import Simulation
    from tbmfg.bounds import Bounds
    from tbmfg.problem import Problem
    from tbmfg.state import Result, Truth

ERRORS = {  # metric, unit and factor of what tbmfg.evaluation.evaluate returns
    "position_rms_m": ("position", "mm", 1e3),
    "ape_rms_m": ("ape", "mm", 1e3),
    "attitude_rms_deg": ("attitude", "deg", 1.0),
    "yaw_rms_deg": ("yaw", "deg", 1.0),
    "tilt_rms_deg": ("tilt", "deg", 1.0),
    "velocity_rms_mps": ("velocity", "mm/s", 1e3),
}
# what the simulators draw: the name and the unit that its calibration has
DRAWN = {
    "arm_m": ("lever_arm_m", 1.0),
    "clock_offset_s": ("clock_offset_s", 1.0),
    "clock_drift_ppm": ("clock_drift_ppm", 1.0),
    "scale": ("scale", 1.0),
    "yaw_pitch_deg": ("mounting_yaw_pitch_deg", 1.0),
    "declination_deg": ("declination_deg", 1.0),
    "lapse_kpkm": ("lapse_kpkm", 1.0),
    "hard_iron_ut": ("hard_iron_ut", 1.0),
    "tilt_n": ("tilt_deg", np.rad2deg(1.0)),
    "zero_m": ("offset_m", 1.0),
    "xyz_m": ("mounting_m", 1.0),
    "turn_deg": ("mounting_turn_deg", 1.0),
}
PARTS = {"rotation": 0, "position": 3, "velocity": 6, "bias_acc": 9, "bias_gyro": 12}  # where each begins in cov


@dataclass(frozen=True, slots=True)
class Job:
    """A log to simulate, ``settings`` and ``options`` as :func:`datasets.make` takes them, and who estimates it."""

    scenario: str
    dataset: str
    settings: tuple[str, ...]
    options: dict[str, Any]
    seed: int
    duration_s: float
    estimators: tuple[str, ...]
    without: tuple[str, ...]
    epochs: int


@dataclass(frozen=True, slots=True)
class Measured:
    """One estimator on one log.

    ``metrics``: values by (metric, unit); ``limits`` upper bounds of some of them. At the epochs: ``nees`` of the pose
    (k,), ``parts`` the NEES of three components each (k,), ``normalised`` errors of rotation and position over
    their sds (k, 6). ``z``: errors of the calibrations over their sds. ``failure``: why there is nothing.
    """

    scenario: str
    estimator: str
    seed: int
    metrics: dict[tuple[str, str], float]
    limits: dict[str, float]
    epochs_s: Floats
    nees: Floats
    parts: dict[str, Floats]
    normalised: Floats
    z: dict[str, float]
    failure: str = ""
    over: dict[str, float] = field(default_factory=dict)


def run(job: Job) -> list[Measured]:
    """Simulate, prepare once, estimate with each, measure."""
    import datasets
    from tbmfg.bounds import cramer_rao
    from tbmfg.estimators import estimate
    from tbmfg.prepare import prepare

    simulation = datasets.make(
        job.dataset, seed=job.seed, duration=job.duration_s, settings=job.settings, **job.options
    )
    measured = []
    problem = bounds = None
    for name in job.estimators:
        try:
            problem = problem or prepare(in_memory(simulation), simulation.rig, without=job.without)
            bounds = bounds or cramer_rao(problem, true_states(simulation, problem.t_ns))
            measured.append(measure(job, simulation, problem, bounds, estimate(name, problem)))
        except TbmfgError as error:
            none = np.zeros(0)
            measured.append(Measured(job.scenario, name, job.seed, {}, {}, none, none, {}, none, {}, str(error)))
    return measured


def in_memory(simulation: Simulation) -> Log:
    """The simulated log as the reader would give it."""
    series = {s.topic: replace(s, counts=StreamCounts(received=len(s))) for s in simulation.log_series}
    return Log(simulation.name, series, {clouds.topic: clouds for clouds in simulation.clouds})


@dataclass(frozen=True, slots=True)
class Held:
    """Clouds that were decoded once and are kept, at 22 bytes a point: to be read by one estimator after the other."""

    topic: str
    t_ns: Times
    frame_id: str
    counts: StreamCounts
    scans: tuple[tuple[int, dict[str, np.ndarray]], ...] = field(repr=False)

    def __len__(self) -> int:
        return len(self.t_ns)

    def __iter__(self) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        return iter(self.scans)


def held(log: Log) -> Log:
    """The log with its clouds held in memory."""
    clouds = {
        topic: Held(topic, source.t_ns, source.frame_id, source.counts, tuple(source))
        for topic, source in log.clouds.items()
    }
    return replace(log, clouds=clouds)


def points_of(fields: dict[str, np.ndarray]) -> Floats:
    """The points of a cloud, (n, 3), all of them."""
    return np.column_stack([fields[axis] for axis in "xyz"]).astype(float)


def measure(job: Job, simulation: Simulation, problem: Problem, bounds: Bounds, result: Result) -> Measured:
    """Errors of ``result`` against the simulation's truth at the keyframes themselves, not interpolated."""
    from tbmfg.estimators import ESTIMATORS
    from tbmfg.evaluation.metrics import evaluate, expected, nees, trajectory_errors

    path = result.trajectory
    truth = true_states(simulation, path.t_ns)
    found = evaluate(path, truth)
    metrics = {(name, unit): factor * found[key] for key, (name, unit, factor) in ERRORS.items()}
    said = np.trace(path.cov[:, POS, POS], axis1=1, axis2=2)
    metrics["position_sd", "mm"] = 1e3 * float(np.sqrt(np.mean(said)))
    limits = {}
    for name, (rms, noise) in point_errors(simulation, problem, result, truth).items():
        metrics[f"{name}_point", "mm"] = 1e3 * rms
        limits |= {f"{name}_point": 1e3 * noise, "position": 1e3 * noise}
    for name, factor in result.calibration.items():
        if name.startswith("noise_factor_"):
            metrics[name, ""] = float(factor.value)
    for name, innovations in result.innovations.items():
        accepted = innovations.nis[~innovations.gated]
        metrics[f"nis_{name}", "per dof"] = float(np.mean(accepted)) / innovations.dof
        metrics[f"gated_{name}", "%"] = 100.0 * float(np.mean(innovations.gated))

    bound = bounds.smoothing if ESTIMATORS[result.estimator].whole else bounds.filtering
    least = expected(bound, true_states(simulation, bound.t_ns))
    errors = trajectory_errors(path, truth)
    at = epochs(path.t_ns - simulation.start_ns, job.duration_s, job.epochs)
    bias_acc, bias_gyro = true_biases(simulation, path.t_ns)
    stacked = np.hstack(
        [errors.rotation_b, errors.position_n, errors.velocity_n, path.bias_acc - bias_acc, path.bias_gyro - bias_gyro]
    )
    sd = np.sqrt(np.einsum("kii->ki", path.cov))
    return Measured(
        job.scenario,
        result.estimator,
        job.seed,
        metrics,
        limits,
        epochs_s=job.duration_s * np.arange(1, job.epochs + 1) / job.epochs,
        nees=errors.nees[at],
        parts={
            name: nees(stacked[at, first : first + 3], path.cov[at, first : first + 3, first : first + 3])
            for name, first in PARTS.items()
        },
        normalised=stacked[at, :6] / sd[at, :6],
        z=calibration_z(simulation, result) | {
            f"bias_gyro_{axis}": float(stacked[-1, 12 + k] / sd[-1, 12 + k]) for k, axis in enumerate("xyz")
        },
        over={name: found[key] / least[key] for key, (name, *_) in ERRORS.items() if least.get(key)},
    )  # fmt: skip


def epochs(since_start_ns: np.ndarray, duration_s: float, count: int) -> np.ndarray:
    """Keyframes nearest to ``count`` times that divide the log evenly, the last at its end."""
    times = duration_s * np.arange(1, count + 1) / count
    return np.abs(since_start_ns[:, None] * 1e-9 - times).argmin(axis=0)


def true_states(simulation: Simulation, t_ns: np.ndarray) -> Truth:
    """The exact truth at the stamps."""
    from tbmfg.geometry import quat_from_matrix
    from tbmfg.state import Truth

    true = simulation.truth((t_ns - simulation.start_ns) * 1e-9)
    return Truth(t_ns, true.position, quat_from_matrix(true.R), true.velocity)


def true_biases(simulation: Simulation, t_ns: np.ndarray) -> tuple[Floats, Floats]:
    """Accelerometer and gyro bias in the sample that ends nearest to each stamp, (n, 3) each."""
    stamps = simulation.clean["imu"].t_ns
    after = np.searchsorted(stamps, t_ns).clip(1, len(stamps) - 1)
    row = np.where(t_ns - stamps[after - 1] < stamps[after] - t_ns, after - 1, after)
    drawn = simulation.drawn["imu"]
    return drawn["bias_acc"][row], drawn["bias_gyro"][row]


def point_errors(
    simulation: Simulation, problem: Problem, result: Result, truth: Truth
) -> dict[str, tuple[float, float]]:
    """RMS error of each tracked point, position + R arm with the estimated arm (for a filter its last), and the RMS
    noise of the sensor that tracks it, sqrt(3) sd, both in m."""
    from tbmfg.geometry import matrix_from_quat

    path, found = result.trajectory, {}
    for name, sensor in simulation.rig.sensors.items():
        arm = result.calibration.get(f"{name}_lever_arm_m")
        if arm is None:
            continue
        true = truth.position_n + matrix_from_quat(truth.quat_xyzw) @ simulation.drawn[name]["arm_m"]
        error = path.position_n + path.rotations() @ np.array(arm.value) - true
        rms = [np.sqrt(np.mean(square)) for square in (np.sum(error**2, axis=1), 3.0 * sensor.sigma_at(true) ** 2)]
        found[name] = float(rms[0]), float(rms[1])
    return found


def calibration_z(simulation: Simulation, result: Result) -> dict[str, float]:
    """(estimate - drawn) / sd of every calibration that is estimated and whose true value was drawn."""
    z = {}
    for sensor, drawn in simulation.drawn.items():
        for drawn_name, (name, unit) in DRAWN.items():
            found = result.calibration.get(f"{sensor}_{name}")
            if drawn_name not in drawn or found is None or not found.estimated:
                continue
            scores = np.atleast_1d((np.array(found.value) - unit * np.array(drawn[drawn_name])) / np.array(found.sd))
            labels = [f"_{axis}" for axis in "xyz"[: len(scores)]] if len(scores) > 1 else [""]
            z |= {
                f"{sensor}_{drawn_name.removesuffix('_m')}{label}": float(s)
                for label, s in zip(labels, scores, strict=True)
            }
    return z
