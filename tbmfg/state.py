"""What an estimator returns: a trajectory with its covariance, calibrations, counts and warnings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tbmfg.geometry import matrix_from_quat
from tbmfg.timeseries import Floats, Times

ROT, POS, VEL, BA, BG = (slice(i, i + 3) for i in range(0, 15, 3))
NAV = 15  # size of the navigation error state: rotation (b), position, velocity (n), acc bias, gyro bias


@dataclass(frozen=True, slots=True)
class Trajectory:
    """States at n keyframes: body b in the navigation frame n.

    ``t_ns`` (n,) int64; ``position_n`` (n, 3) m; ``quat_xyzw`` (n, 4) of R_nb; ``velocity_n`` (n, 3)
    m/s; ``bias_acc`` (n, 3) m/s^2 and ``bias_gyro`` (n, 3) rad/s in b; ``cov`` (n, 15, 15) in the
    order and frames of the package docstring, all zeros of an estimator that has none.
    """

    t_ns: Times
    position_n: Floats
    quat_xyzw: Floats
    velocity_n: Floats
    bias_acc: Floats
    bias_gyro: Floats
    cov: Floats

    def __len__(self) -> int:
        return len(self.t_ns)

    def rotations(self) -> Floats:
        """R_nb, (n, 3, 3)."""
        return matrix_from_quat(self.quat_xyzw)


@dataclass(frozen=True, slots=True)
class Truth:
    """Reference poses of b in n. ``quat_xyzw`` and ``velocity_n`` are None where the log has none.

    With ``arm_b`` (3,) m, positions and velocities are those of a point at this arm from the IMU.
    """

    t_ns: Times
    position_n: Floats
    quat_xyzw: Floats | None = None
    velocity_n: Floats | None = None
    arm_b: Floats = field(default_factory=lambda: np.zeros(3))


@dataclass(slots=True)
class Counts:
    """Where every sample of one sensor went; the parts sum to ``received`` exactly."""

    received: int = 0
    used: int = 0
    gated: int = 0
    late: int = 0
    duplicate: int = 0
    nonfinite: int = 0
    outage: int = 0
    unused: int = 0

    def parts(self) -> int:
        return self.used + self.gated + self.late + self.duplicate + self.nonfinite + self.outage + self.unused


@dataclass(frozen=True, slots=True)
class Calibrated:
    """A calibration value (float or tuple), its standard deviation, whether the log estimated it, and whether it is
    observable on the log: told by it beyond the prior; None where that is not asked."""

    value: float | tuple[float, ...]
    sd: float | tuple[float, ...]
    estimated: bool
    observed: bool | tuple[bool, ...] | None = None


@dataclass(frozen=True, slots=True)
class Innovations:
    """Squared normalised residuals of one sensor at its keyframes: ``nis`` (m,), ``dof``, ``gated`` (m,); their
    ``correlation`` from one to the next and by how much (1 sd) it is off zero by chance, None where it is not asked."""

    t_ns: Times
    nis: Floats
    dof: int
    gated: np.ndarray
    correlation: float | None = None
    correlation_sd: float | None = None


@dataclass(frozen=True, slots=True)
class Interval:
    """A stretch of time worth naming. Kinds of a sensor: outage, gap, lost, gated, biased, reopened, standing; of an
    estimator, whose name then stands for the sensor's: restarted, unconverged, undetermined."""

    sensor: str
    kind: str
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class Health:
    """How one LiDAR's scans, taken at ``t_ns`` (n,), fit the map that they make.

    ``overlap``: share of the points near planes of the map that lie on them; ``residual_m``: noise of their distances;
    ``weak``: how many directions the walls do not tell, of six; ``dust``: share of the nearer points that hang in the
    air; ``healthy``: whether the scan fits as scans usually do. (n,) each.
    """

    t_ns: Times
    overlap: Floats
    residual_m: Floats
    weak: np.ndarray
    dust: Floats
    healthy: np.ndarray


@dataclass(slots=True)
class Result:
    """What every estimator returns.

    ``trajectory`` is the plain (for online solvers: causal) one; ``smoothed`` the last estimates,
    where they differ. ``health`` is that of every LiDAR's scans,
    alike for all estimators. ``summary`` is the content of summary.json, once there is one.
    """

    estimator: str
    trajectory: Trajectory
    smoothed: Trajectory | None = None
    calibration: dict[str, Calibrated] = field(default_factory=dict)
    counts: dict[str, Counts] = field(default_factory=dict)
    innovations: dict[str, Innovations] = field(default_factory=dict)
    intervals: list[Interval] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    health: dict[str, Health] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)
