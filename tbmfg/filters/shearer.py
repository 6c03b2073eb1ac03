"""The filters of Yan & Wang (2021) for a shearer: SINS, SINS/OD and SINS/OD/MAG, centralised and federated.

Numbers in brackets are the paper's equations, H its errata: where they differ the corrected form is the default. The
paper writes errors as computed minus true, C_computed = (I - [phi]x) C_true in ENU axes; here the error model is that
of ``inertial.strapdown``, true = estimate (+) error with a rotation d in b: phi = R d, all else changes sign, and n may
be turned by the rig's azimuth. So (1)-(6) are ``propagate``, (17) with H6 is ``sensors.wheel``, and (23), (26) with
H7-H10 are ``sensors.magnetometer``: its angle counts counter-clockwise from n's x axis, declination east positive.

The state (12) holds the 15 errors and those calibrations of the filter's own sensors that the rig gives a sd: the
odometer's scale, and beyond the paper its mounting and the declination. Every sample is taken when it comes, at the IMU
edge nearest to it; an odometer's mean speed at the middle of its period. Nothing else is used: no zero velocity, no
fixes. The paper has no gate, so every sample counts as used; what a gate would have done is said.

All are one loop: a federation of local filters, which share one strapdown solution and correct it together. A
centralised filter is a federation of one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.linalg import block_diag

from tbmfg.fields import MICRO_TESLA, Flag, Node
from tbmfg.filters import samplewise
from tbmfg.filters.federated import Federation, Rule
from tbmfg.filters.kalman import correct, innovation, innovation_noise
from tbmfg.inertial.strapdown import correct_state, propagate
from tbmfg.measure import GyroFrame, Samples, magnetometer_rows, wheel_rows
from tbmfg.problem import STRENGTH, Problem
from tbmfg.rig import kind_of
from tbmfg.sensors import Rows
from tbmfg.state import NAV, ROT
from tbmfg.timeseries import Floats


class Magnetic(Node):
    """Switches of a filter with a magnetometer."""

    mag_jacobian: Literal["full", "yaw_only"] = Field(
        "full", description="yaw_only: the tilt's part in the magnetic yaw is left out, as in the paper (H9)."
    )


class Adaptive(Magnetic):
    """Switches of a filter that finds the noise of its measurements from their innovations."""

    r_adapt: Literal["innovation", "printed", "off"] = Field(
        "innovation", description="printed: (32) as it stands, which takes the innovations' covariance for R (H12)."
    )
    window: Annotated[int, Field(strict=True, ge=3)] = Field(
        20,
        description="Innovations of one sensor that its noise is found from; the rig's noise until there are as many.",
    )


class Federated(Adaptive):
    """Switches of the federated filter."""

    beta: Rule = Field("fixed", description="The shares: fixed at one half, printed (33), or inverse to the trace.")
    share_q: Flag = Field(True, description="false: every local filter gets the whole process noise, as printed (H13).")


@dataclass(frozen=True, slots=True)
class Design:
    """A filter of the paper: which kinds of sensors each local filter has, and what the rig may switch."""

    members: tuple[tuple[str, ...], ...]
    switches: type[Node]


DESIGNS = {
    "shearer-sins": Design(((),), Node),
    "shearer-sins-od": Design((("odometer",),), Node),
    "shearer-ckf": Design((("odometer", "magnetometer"),), Magnetic),
    "shearer-ckf-ar": Design((("odometer", "magnetometer"),), Adaptive),
    "shearer-afkf": Design((("odometer",), ("magnetometer",)), Federated),
}


@dataclass(frozen=True, slots=True)
class Filtered:
    """States (n, 21) and covariances (n, 15, 15) at the keyframes, calibrations (m,) with covariance (m, m) at the end.

    Per sensor and row: ``nis`` against the rig's noise, and ``noise``, the sd that it was taken with over the rig's
    (rms over its axes). ``shares`` (epochs, members) after each epoch with measurements.
    """

    x: Floats
    cov: Floats
    c: Floats
    c_cov: Floats
    nis: dict[str, Floats]
    noise: dict[str, Floats]
    shares: Floats


def view(problem: Problem, design: Design) -> Problem:
    """The problem as a filter of ``design`` sees it: its own sensors' samples one by one, as rows at IMU edges."""
    edges_s, rig = problem.inertial.steps.edges_s, problem.rig
    azimuth = rig.origin.x_axis_azimuth

    def to_rows(name: str, s: Samples, frame: GyroFrame, calib: slice) -> Rows:
        if kind_of(name) == "odometer":
            return wheel_rows(rig.sensors[name], s, edges_s, frame, calib)
        horizontal = MICRO_TESLA * problem.parameters.prior(f"{name}.{STRENGTH}")
        return magnetometer_rows(rig.sensors[name], s, edges_s, frame, azimuth, calib, horizontal)

    return samplewise.view(problem, (kind for member in design.members for kind in member), to_rows)


def run(
    problem: Problem, design: Design, switches: Node | None = None, progress: Callable[[float], None] | None = None
) -> Filtered:
    """Filter a problem as :func:`view` gives it. What ``switches`` do not name is that of a plain Kalman filter."""
    switches = Federated(**{"r_adapt": "off", **(switches.model_dump() if switches else {})})
    inertial, parameters, free = problem.inertial, problem.parameters, problem.parameters.free
    noise = inertial.psd_gyro, inertial.psd_acc, inertial.psd_bg, inertial.psd_ba, inertial.earth_n, inertial.gravity_n
    x, c = problem.prior.x[:21].copy(), parameters.start.copy()
    P = np.diag(np.concatenate([np.zeros(NAV), parameters.sd[free] ** 2]))
    P[:NAV, :NAV] = problem.prior.filter_cov[:NAV, :NAV]
    members = len(design.members)
    federation = Federation(P, np.full(members, 1.0 / members), switches.beta, switches.share_q)
    measurements = Measurements(problem, switches)

    keyframes = problem.keyframe_edges
    epochs = samplewise.epochs(problem)
    due = [
        samplewise.due((rows for rows in problem.rows if kind_of(rows.sensor) in kinds), epochs)
        for kinds in design.members
    ]
    xs, covs, history = np.empty((len(keyframes), 21)), np.empty((len(keyframes), NAV, NAV)), []
    last, output = keyframes[0], 0
    for number, epoch in enumerate(epochs):
        x, Phi, Q = propagate(x, last, epoch, inertial.steps.edges_s, inertial.gyro, inertial.acc, *noise)
        federation.predict(Phi, Q)
        last = epoch
        if any(own[number] for own in due):
            local = zip(federation.P, federation.beta, due, strict=True)
            dx = federation.update([measurements.update(P, beta, x, c, own[number]) for P, beta, own in local])
            x = correct_state(x, dx[:NAV])
            c[free] += dx[NAV:]
            history.append(federation.beta)
        if epoch == keyframes[output]:
            xs[output], covs[output] = x, federation.fused()[:NAV, :NAV]
            output += 1
        if progress is not None and number % 1000 == 0:
            progress(number / len(epochs))
    c_cov = np.zeros((len(c), len(c)))
    c_cov[np.ix_(free, free)] = federation.fused()[NAV:, NAV:]
    return Filtered(xs, covs, c, c_cov, measurements.nis, measurements.noise, np.array(history))


class Measurements:
    """The local filters' measurement updates, (29)-(32), about the strapdown solution that they share."""

    def __init__(self, problem: Problem, switches: Federated) -> None:
        self.rows, self.free, self.switches = problem.rows, problem.parameters.free, switches
        self.windows = {rows.sensor: deque(maxlen=switches.window) for rows in self.rows}
        self.nis = {rows.sensor: np.full(len(rows), np.nan) for rows in self.rows}
        self.noise = {rows.sensor: np.ones(len(rows)) for rows in self.rows}

    def update(
        self, P: Floats, beta: float, x: Floats, c: Floats, due: list[tuple[Rows, int]]
    ) -> tuple[Floats, Floats]:
        """One local filter's error and covariance after the rows that are due, all at once; ``beta`` is its share."""
        if not due:
            return np.zeros(len(P)), P
        residuals, H, R = [], [], []
        for rows, r in due:
            residual, columns = self._linearise(rows, r, x, c)
            residuals.append(residual)
            H.append(columns)
            R.append(self._noise(rows, r, residual, columns @ P @ columns.T))
            # the whole's covariance is beta P (34): what the rig's noise makes of the innovation
            self.nis[rows.sensor][r] = innovation(beta * P, columns, residual)[0]
        noise = R[0] if len(R) == 1 else block_diag(*R)
        return correct(P, np.concatenate(H), np.concatenate(residuals), noise)

    def _linearise(self, rows: Rows, r: int, x: Floats, c: Floats) -> tuple[Floats, Floats]:
        """Whitened residual of one row and its Jacobian to [state, free calibrations]."""
        residual, H = samplewise.linearise(rows, r, x, c, self.free)
        if kind_of(rows.sensor) == "magnetometer" and self.switches.mag_jacobian == "yaw_only":
            up_b = x[6:9]
            H[:, ROT] = np.outer(H[:, ROT] @ up_b, up_b)  # (26): of a rotation in n, the third element alone
        return residual, H

    def _noise(self, rows: Rows, r: int, residual: Floats, HPHt: Floats) -> Floats:
        """(32): covariance of the row's noise in units of the rig's; that itself until the window is full."""
        window = self.windows[rows.sensor]
        window.append(residual)
        if self.switches.r_adapt == "off" or len(window) < self.switches.window:
            return np.eye(len(residual))
        if self.switches.r_adapt == "printed":
            R = innovation_noise(np.array(window), np.zeros_like(HPHt), 0.0)
        else:
            R = innovation_noise(np.array(window), HPHt, 1.0)
        self.noise[rows.sensor][r] = np.sqrt(np.trace(R) / len(R))
        return R
