"""The two-point mounting calibration: how an odometer sits in b, from a way between two surveyed points.

Yan & Wang (2021) name the method and do not write it out. By inertial attitude R(t) and indicated speed v the way is
T = M e with M = sum R v dt and e = E e_x / (1 + scale), the wheel's axis in b: three equations for mounting yaw, pitch
and scale, solved without linearising and on any way that does not close on itself.
"""

from __future__ import annotations

import numpy as np

from tbmfg.errors import EstimationError
from tbmfg.geometry import rotation_from_rpy, skew
from tbmfg.inertial.strapdown import mechanise
from tbmfg.measure import GyroFrame, periods
from tbmfg.problem import Problem
from tbmfg.rig import SurveyPoint
from tbmfg.state import ROT, Calibrated
from tbmfg.timeseries import Floats

VAGUE = np.deg2rad(10.0)  # a way that leaves a larger doubt of the axis than this gives no mounting
POSSIBLE = 2.0  # an odometer that errs by more than this factor is not one


def two_point_mounting(
    problem: Problem, start: SurveyPoint, end: SurveyPoint, sensor: str = "odometer"
) -> dict[str, Calibrated]:
    """Mounting yaw and pitch [deg] and scale of ``sensor``, under the names of a result's calibration.

    The attitude is that of inertial navigation alone from the prior's start: keep the way short, minutes rather than
    hours. The sds hold the points, the odometer's noise and the prior's attitude: a heading that is wrong at the start
    cannot be told from a mounting yaw. Raises EstimationError without samples or without a way to speak of.
    """
    if sensor not in problem.samples:
        raise EstimationError(f"two-point mounting: {sensor}: no samples; the log has {', '.join(problem.samples)}")
    odometer, inertial = problem.rig.sensors[sensor], problem.inertial
    steps, x0 = inertial.steps, problem.prior.x[:21]
    first, last = (_moment(point.at, steps.edges_s) for point in (start, end))
    states = mechanise(x0, steps.edges_s, inertial.gyro, inertial.acc, inertial.earth_n, inertial.gravity_n)
    frame = GyroFrame(steps, states[:, :9].reshape(-1, 3, 3), inertial.gyro - x0[18:21], x0[18:21])

    begins, ends, _ = periods(odometer, problem.samples[sensor])
    begins, ends = np.clip(begins, first, last), np.clip(ends, first, last)
    dt = ends - begins
    if dt.sum() < 0.999 * (last - first) - dt.max():
        raise EstimationError(
            f"two-point mounting: {sensor} covers {dt.sum():.1f} s of the {last - first:.1f} s between the points; "
            "choose points between which it has no gaps"
        )
    R = frame.at(0.5 * (begins + ends))
    M = np.einsum("n,nij->ij", problem.samples[sensor].values * dt, R)
    R_ends = frame.at(np.array([first, last]))
    T = end.position - start.position + (R_ends[1] - R_ends[0]) @ odometer.arm

    wheel = R @ rotation_from_rpy(np.array([0.0, odometer.pitch, odometer.yaw]))
    per_sample = np.array([odometer.sigma, odometer.lateral_sigma, odometer.lateral_sigma])
    noise = np.einsum("nij,j,nkj,n->ik", wheel, per_sample**2, wheel, dt**2)
    # R_true = Exp(phi) R for an attitude error phi in n
    turned = skew(T) @ x0[:9].reshape(3, 3)
    cov_T = noise + (start.sigma**2 + end.sigma**2) * np.eye(3) + turned @ problem.prior.filter_cov[ROT, ROT] @ turned.T
    doubt = np.sqrt(start.sigma**2 + end.sigma**2 + np.trace(noise) / 3)
    way = (
        f"two-point mounting: the points are {np.linalg.norm(T):.2f} m apart after a way of "
        f"{np.sum(np.abs(problem.samples[sensor].values) * dt):.2f} m by {sensor}"
    )
    if np.linalg.svd(M, compute_uv=False)[-1] * VAGUE < doubt:
        raise EstimationError(f"{way}, known to {doubt:.2g} m; drive farther, and not in a loop")
    e = np.linalg.solve(M, T)
    if not 1 / POSSIBLE < np.linalg.norm(e) < POSSIBLE:
        raise EstimationError(f"{way}, which no mounting explains; check the points and the unit of the speed")
    cov = np.linalg.solve(M, np.linalg.solve(M, cov_T).T)
    size, level = np.linalg.norm(e), np.hypot(e[0], e[1])
    yaw, pitch = np.arctan2(e[1], e[0]), np.arctan2(-e[2], level)
    J = np.stack(
        [
            np.array([-e[1], e[0], 0.0]) / level**2,
            np.array([e[0] * e[2] / level, e[1] * e[2] / level, -level]) / size**2,
            -e / size**3,
        ]
    )
    sd = np.sqrt(np.diag(J @ cov @ J.T))
    return {
        f"{sensor}_mounting_yaw_pitch_deg": Calibrated(
            (float(np.rad2deg(yaw)), float(np.rad2deg(pitch))), tuple(np.rad2deg(sd[:2]).tolist()), True
        ),
        f"{sensor}_scale": Calibrated(float(1.0 / size - 1.0), float(sd[2]), True),
    }


def _moment(at: float | str, edges_s: Floats) -> float:
    """Seconds from the first IMU sample."""
    return float({"start": edges_s[0], "end": edges_s[-1]}.get(at, at))
