"""The estimation problem that one log and one rig make: what every estimator is given, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from tbmfg.errors import EstimationError
from tbmfg.inertial.steps import Steps, to_ns
from tbmfg.lidar.clouds import Scans
from tbmfg.measure import Clock, Samples
from tbmfg.rig import Rig
from tbmfg.sensors import Rows
from tbmfg.state import NAV, Calibrated, Counts, Health, Interval
from tbmfg.timeseries import Floats, Times

CLOCK = ("clock_offset", "clock_drift")  # parameters that say when a row was measured
STRENGTH = "strength"  # the parameter of a magnetometer that is the Earth's horizontal field [microtesla]
BREAKDOWN = (ArithmeticError, RuntimeError, np.linalg.LinAlgError)  # what numpy, compiled code and GTSAM fail with
GATE = 0.999  # probability inside a gate: rows beyond this chi-square point are counted as gated


@dataclass(frozen=True, slots=True)
class Parameters:
    """Constant calibrations side by side in one vector: names such as ``prism.arm_x``, prior mean and sd (0: known).

    ``start`` is where an estimator begins: the mean, but for clocks, which are counted from the one that the keyframes
    were placed with. A filter takes it for the mean.
    """

    names: tuple[str, ...]
    mean: Floats
    sd: Floats
    start: Floats

    @property
    def free(self) -> np.ndarray:
        """Indices of those that are estimated."""
        return np.flatnonzero(self.sd > 0)

    def slice(self, sensor: str) -> slice:
        """Where the calibrations of ``sensor`` lie."""
        own = [k for k, name in enumerate(self.names) if name.rpartition(".")[0] == sensor]
        return slice(own[0], own[-1] + 1) if own else slice(0, 0)

    def prior(self, name: str) -> float:
        """The prior mean of one, 0 where there is none of that name."""
        return float(self.mean[self.names.index(name)]) if name in self.names else 0.0


@dataclass(frozen=True, slots=True)
class Inertial:
    """Compensated steps with their noise, and the field they are integrated in.

    ``gyro`` and ``acc`` (n, 3) in b; ``white_gyro``, ``white_acc`` the IMU's white noise [unit^2/Hz], to which steps
    that stand in for lost samples add theirs; ``psd_bg``, ``psd_ba`` bias random walks; ``earth_n`` rad/s,
    ``gravity_n`` m/s^2, (3,).
    """

    steps: Steps
    gyro: Floats
    acc: Floats
    white_gyro: float
    white_acc: float
    psd_bg: float
    psd_ba: float
    earth_n: Floats
    gravity_n: Floats

    @property
    def psd_gyro(self) -> Floats:
        """White noise of the gyro by step, (n,)."""
        return self.white_gyro + self.steps.extra_gyro

    @property
    def psd_acc(self) -> Floats:
        """White noise of the accelerometer by step, (n,)."""
        return self.white_acc + self.steps.extra_acc


@dataclass(frozen=True, slots=True)
class Prior:
    """First state (21 + e,) and covariance (15 + e, 15 + e) of its error.

    ``filter_cov`` is what a filter must start from: the same, unless the rig does not know the heading. Then
    the heading was found from the log, and a filter, which linearises once, takes its sd from there.
    """

    x: Floats
    cov: Floats
    filter_cov: Floats


@dataclass(slots=True)
class Problem:
    """See the fields. Positions are relative to ``origin_n``, times in s since ``steps.t0_ns``.

    ``keyframe_edges`` (n,) are the IMU edges at which the keyframes lie.
    ``drift_walk`` (e,) are the random walks of the drifting calibrations ``drift_names``;
    ``clocks`` those that the rows were placed with; ``samples`` what the rows were made of, by sensor,
    for filters that take every sample when it comes. ``scans`` are those of every LiDAR, still in the log, and
    ``health`` how they fit; ``measured`` the IMU's steps before any enhancement.
    """

    rig: Rig
    inertial: Inertial
    keyframe_edges: np.ndarray
    rows: list[Rows]
    parameters: Parameters
    drift_names: tuple[str, ...]
    drift_walk: Floats
    prior: Prior
    origin_n: Floats
    clocks: dict[str, Clock]
    samples: dict[str, Samples] = field(default_factory=dict)
    counts: dict[str, Counts] = field(default_factory=dict)
    calibration: dict[str, Calibrated] = field(default_factory=dict)
    intervals: list[Interval] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    scans: dict[str, Scans] = field(default_factory=dict)
    health: dict[str, Health] = field(default_factory=dict)
    measured: Steps | None = None

    @property
    def t0_ns(self) -> int:
        """Stamp of the first IMU sample: the zero of all seconds."""
        return self.inertial.steps.t0_ns

    @property
    def keyframes_s(self) -> Floats:
        """Times of the keyframes, (n,)."""
        return self.inertial.steps.edges_s[self.keyframe_edges]

    @property
    def t_ns(self) -> Times:
        """Stamps of the keyframes, (n,)."""
        return to_ns(self.inertial.steps, self.keyframes_s)

    @property
    def size(self) -> int:
        """Dimension of one keyframe's error state."""
        return NAV + len(self.drift_walk)


@contextmanager
def breakdown_explained(what: str) -> Iterator[None]:
    """Turn a numerical breakdown of ``what``, in numpy or in GTSAM, into an EstimationError."""
    try:
        yield
    except BREAKDOWN as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise EstimationError(
            f"{what} broke down ({reason}): the readings and the rig contradict each other; check units, topics and "
            "priors, and find the sensor with --without"
        ) from error
