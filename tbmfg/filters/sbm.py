"""The three estimators of the shaft boring machine's paper.

Wang, Liu, Liu, Fu, Zhu, Sensors 2019, 19, 5007, corrected. Attitude from gyro, accelerometer and magnetometer,
horizontal displacement from the laser's spot on the detector, depth from the barometer. Every sample is taken when it
comes, none is gated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from tbmfg.errors import EstimationError
from tbmfg.fields import Node, Number, Positive
from tbmfg.filters import complementary, euler_ekf
from tbmfg.filters.frd import quaternion, rotation_ra
from tbmfg.filters.sbm_readings import SPEED_S, Readings, held, readings, reference_field, spread, to_navigation
from tbmfg.geometry import FLIP
from tbmfg.problem import Problem
from tbmfg.state import NAV
from tbmfg.timeseries import Floats

BIAS_ALLOWANCE = 2.0  # times the sd of the gyro's bias, per root second: the filters know no bias


# ---- what the rig may set under estimators.NAME ----


class Switches(Node):
    """What all three know."""

    psd_sign: Literal[-1, 1] = Field(-1, description="Of the displacement over the spot; 1: as the paper reads it.")
    air_c: Number = Field(15.0, description="Mean temperature of the air column, degrees Celsius; section 5's T_mean.")

    @property
    def air_k(self) -> float:
        """The same in kelvin."""
        return self.air_c + 273.15


class Feedback(Switches):
    """The complementary filter's."""

    k_p: Positive = Field(3.0, description="Proportional gain, 1/s.")
    k_i: Positive = Field(0.06, description="Integral gain, 1/s^2.")
    mag_mode: Literal["printed", "yaw_only"] = Field("printed", description="Whether the field drives roll and pitch.")
    integrator: Literal["exp", "rk4"] = Field("exp", description="Every sample exactly, or (12) every second one.")


class Kalman(Switches):
    """The extended Kalman filter's."""

    states: Literal[9, 7] = Field(9, description="7: V_x and V_y are inputs, as in (22).")
    predict: Literal["correct", "printed"] = Field("correct", description="(25): f(X, u), or Phi X as printed (S19).")
    jac: Literal["correct", "printed"] = Field("correct", description="(24): printed lacks d(d_z)/d(V_z) (S18).")
    vz: Literal["none", "baro_diff"] = Field("none", description="Whether V_z is observed, by differenced depths.")


class Combined(Kalman, Feedback):
    """Both, and how they meet."""

    coupling: Literal["rate", "angle"] = Field(
        "rate", description="The feedback corrects the EKF's rates, or its angles are the EKF's readings."
    )


# ---- the filters ----


@dataclass(frozen=True, slots=True)
class Run:
    """States (n, 21) and covariances (n, 15, 15) at the keyframes; ``cov`` None: the filter has none."""

    x: Floats
    cov: Floats | None
    used: dict[str, int]
    warnings: list[str]


def complementary_filter(problem: Problem, switches: Feedback) -> Run:
    """``sbm-cf``, section 4."""
    given = readings(problem, switches.air_k)
    angles, _ = _attitude(given, switches)
    spot = held(given.spot, given.dt, given.period_s.get("laser", 0.0))
    depth = held(given.depth[:, None], given.dt, given.period_s.get("barometer", 0.0))[:, 0]
    d, V = complementary.observers(
        given.X[3:6], given.X[6:9], angles, given.f, spot, depth, given.dt, given.gravity, switches.psd_sign
    )
    at = problem.keyframe_edges
    x = _in_navigation(problem, given, np.hstack([angles, d, V])[at])
    return Run(x, None, given.used, _missing(given))


def extended_kalman_filter(problem: Problem, switches: Kalman) -> Run:
    """``sbm-ekf``, section 5: R from the spread of the readings about the gyro."""
    given = readings(problem, switches.air_k)
    return _kalman(problem, given, switches, given.omega, given.angles, spread(given, given.angles))


def combined_filter(problem: Problem, switches: Combined) -> Run:
    """``sbm-cfekf``, section 6. With ``coupling: angle`` the complementary filter's errors last 1 / K_p: R is inflated
    by the samples in two of these times."""
    given = readings(problem, switches.air_k)
    angles, eta = _attitude(given, switches)
    if switches.coupling == "rate":
        return _kalman(problem, given, switches, given.omega + eta, given.angles, spread(given, given.angles))
    lasting = max(1.0, 2.0 / (switches.k_p * float(np.median(given.dt))))
    return _kalman(problem, given, switches, given.omega, angles[1:], spread(given, angles[1:]) * np.sqrt(lasting))


def _attitude(given: Readings, switches: Feedback) -> tuple[Floats, Floats]:
    """Angles (n + 1, 3) and feedback (n, 3) of the complementary filter."""
    field = np.nan_to_num(held(given.field, given.dt, given.period_s["magnetometer"]))
    h_n, h_d = reference_field(given)
    return complementary.attitude(
        quaternion(given.X[:3]), given.omega, -given.f, field, given.dt, h_n, h_d, switches.k_p, switches.k_i,
        switches.mag_mode == "yaw_only", switches.integrator == "rk4",
    )  # fmt: skip


def _kalman(problem: Problem, given: Readings, switches: Kalman, omega: Floats, angles: Floats, sd: Floats) -> Run:
    """The extended Kalman filter on the given rates and angle readings (n, 3) of sd (3,)."""
    inertial, n = problem.inertial, len(omega)
    speed = given.speed if switches.vz == "baro_diff" else np.full(n, np.nan)
    spot_sd, depth_sd = given.sigma.get("laser", 1.0), given.sigma.get("barometer", 1.0)
    X, P, singular = euler_ekf.run(
        given.X, given.P, omega, given.f, np.column_stack([angles, given.spot, given.depth, speed]),
        np.array([*sd, spot_sd, spot_sd, depth_sd, np.sqrt(2.0) * depth_sd / SPEED_S]), given.dt,
        inertial.psd_gyro[:n] + (BIAS_ALLOWANCE * problem.rig.imu.gyro_bias_sd) ** 2, inertial.psd_acc[:n],
        given.gravity, switches.psd_sign, switches.states, switches.predict == "printed", switches.jac == "printed",
        problem.keyframe_edges,
    )  # fmt: skip
    if singular >= 0:
        raise EstimationError(
            f"the pitch came within a degree of 90 at {inertial.steps.edges_s[singular]:.1f} s, where Euler angles "
            "have no rates; check the IMU's mounting T_bi, or use ins or batch, which have no such place"
        )
    cov = np.zeros((len(X), NAV, NAV))
    for k in range(len(X)):
        M = to_navigation(X[k], given.R_nr, given.arm_b)
        cov[k, :9, :9] = M @ P[k] @ M.T
    return Run(_in_navigation(problem, given, X), cov, given.used, _missing(given))


def _in_navigation(problem: Problem, given: Readings, X: Floats) -> Floats:
    """States of nine (m, 9) as those of the package, (m, 21); biases are the prior's."""
    x = np.tile(problem.prior.x[:21], (len(X), 1))
    R = np.array([given.R_nr @ rotation_ra(angles).T @ FLIP for angles in X[:, :3]])
    x[:, :9] = R.reshape(-1, 9)
    x[:, 9:12] = X[:, 3:6] @ given.R_nr.T - R @ given.arm_b - problem.origin_n
    x[:, 11] = problem.prior.x[11] - X[:, 5]
    x[:, 12:15] = X[:, 6:9] @ given.R_nr.T
    return x


def _missing(given: Readings) -> list[str]:
    """What the displacement lacks."""
    lacks = {"laser": "horizontal displacement", "barometer": "depth"}
    return [
        f"no {kind}: {what} is integrated acceleration and soon worthless"
        for kind, what in lacks.items()
        if kind not in given.sigma
    ]


FILTERS = {
    "sbm-cf": (complementary_filter, Feedback),
    "sbm-ekf": (extended_kalman_filter, Kalman),
    "sbm-cfekf": (combined_filter, Combined),
}
