"""How far an estimate is from the truth, and whether its covariance says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tbmfg.chance import chi_square_point
from tbmfg.evaluation.correlation import effective_samples
from tbmfg.geometry import skew, split_yaw_tilt
from tbmfg.state import POS, ROT, VEL, Trajectory, Truth
from tbmfg.timeseries import Floats, Times

GAP_RATIO = 5.0  # a truth interval this many times the median is a gap ...
GAP_MIN_S = 0.1  # ... unless it is short: jitter of a fast truth is not a gap


@dataclass(frozen=True, slots=True)
class Errors:
    """Estimate minus truth at the m evaluated keyframes, in time order.

    ``rows`` (m,) are their indices in the trajectory. ``position_n`` (m, 3) m is the plain difference,
    ``aligned_n`` (m, 3) m the one after the rigid alignment of the estimate to the truth. ``rotation_b``
    (m, 3) rad is d in R_est = R_true Exp(d), ``rotation_n`` the same vector resolved in n by R_true;
    both are None without true attitude. ``velocity_n`` (m, 3) m/s is None without true velocity.
    ``nees`` (m,) has ``nees_dof`` degrees of freedom and is NaN where the covariance is singular.
    """

    rows: np.ndarray
    t_ns: Times
    position_n: Floats
    aligned_n: Floats
    rotation_b: Floats | None
    rotation_n: Floats | None
    velocity_n: Floats | None
    nees: Floats
    nees_dof: int


def evaluate(trajectory: Trajectory, truth: Truth, outages: Sequence[tuple[int, int]] = ()) -> dict[str, float | None]:
    """The metrics of one trajectory; a value is None where the truth (or a broken estimate) leaves it undefined.

    Only ``ape_*`` align the estimate to the truth (rotation and translation, no scale). ``position_rms_m``,
    ``outage_position_rms_m`` and the NEES compare coordinates as they are: they mean something when truth
    and estimate are given in the same frame n, which the rig asserts. ``outages`` are (start, end) stamps
    in ns, both included. ``velocity_rms_mps`` needs a true velocity; positions are not differentiated.
    Where the truth is that of a point with an arm, so are the positions compared; no velocity is, because a
    trajectory holds no angular rate.
    ``evaluated`` counts the keyframes that the truth covers; ``nees_evaluated`` those of them with a
    covariance that can be inverted; ``nees_n_eff`` is the number of independent samples among these.
    """
    errors = trajectory_errors(trajectory, truth)
    yaw = tilt = None
    if errors.rotation_n is not None:
        yaw, tilt = split_yaw_tilt(errors.rotation_n)
    usable = np.isfinite(errors.nees)
    metrics = {
        "ape_rms_m": _rms(errors.aligned_n),
        "ape_max_m": float(np.linalg.norm(errors.aligned_n, axis=1).max(initial=0.0)) if len(errors.rows) else None,
        "position_rms_m": _rms(errors.position_n),
        "attitude_rms_deg": _rms(errors.rotation_b, np.rad2deg(1.0)),
        "yaw_rms_deg": _rms(yaw, np.rad2deg(1.0)),
        "tilt_rms_deg": _rms(tilt, np.rad2deg(1.0)),
        "velocity_rms_mps": _rms(errors.velocity_n),
        "outage_position_rms_m": _rms(errors.position_n[_inside(errors.t_ns, outages)]),
        "nees_mean": float(errors.nees[usable].mean()) if usable.any() else None,
        "nees_n_eff": effective_samples(errors.t_ns[usable], errors.nees[usable]) if usable.any() else None,
        "nees_dof": errors.nees_dof,
        "evaluated": len(errors.rows),
        "nees_evaluated": int(usable.sum()),
    }
    return {name: value if value is not None and np.isfinite(value) else None for name, value in metrics.items()}


def expected(trajectory: Trajectory, truth: Truth, outages: Sequence[tuple[int, int]] = ()) -> dict[str, float | None]:
    """What the covariance of ``trajectory`` says of the RMS errors under the same names in :func:`evaluate`, at the
    keyframes that the truth covers: roots of mean traces."""
    if truth.arm_b.any():
        trajectory, truth = at_point(trajectory, truth.arm_b), replace(truth, velocity_n=None)
    covered, true = truth_at(truth, trajectory.t_ns)
    variances = np.diagonal(trajectory.cov[covered], axis1=1, axis2=2)
    told = {"position_rms_m": _root(variances[:, POS])}
    told["outage_position_rms_m"] = _root(variances[_inside(true.t_ns, outages), POS])
    if true.quat_xyzw is not None:
        R = Rotation.from_quat(true.quat_xyzw).as_matrix()
        about_n = np.einsum("kij,kjl,kil->ki", R, trajectory.cov[covered, ROT, ROT], R)
        degree = np.rad2deg(1.0)
        told["attitude_rms_deg"] = _root(variances[:, ROT], degree)
        told["yaw_rms_deg"], told["tilt_rms_deg"] = _root(about_n[:, 2:], degree), _root(about_n[:, :2], degree)
    if true.velocity_n is not None:
        told["velocity_rms_mps"] = _root(variances[:, VEL])
    return {name: value if value is not None and np.isfinite(value) else None for name, value in told.items()}


def over(metrics: dict[str, float | None], bound: dict[str, float | None]) -> dict[str, float | None]:
    """The bounds under names of their own, ``bound_position_rms_m``, and every error over its own,
    ``position_over_bound``."""
    told = {f"bound_{name}": value for name, value in bound.items()}
    for name, value in bound.items():
        ratio = metrics[name] / value if value and metrics.get(name) is not None else None
        told[f"{name.partition('_rms_')[0]}_over_bound"] = ratio
    return told


def trajectory_errors(trajectory: Trajectory, truth: Truth) -> Errors:
    """Errors at the keyframes that the truth covers."""
    if truth.arm_b.any():
        trajectory, truth = at_point(trajectory, truth.arm_b), replace(truth, velocity_n=None)
    covered, true = truth_at(truth, trajectory.t_ns)
    rows = np.flatnonzero(covered)
    estimate_n = trajectory.position_n[rows]
    position_n = estimate_n - true.position_n
    R, p = align(estimate_n, true.position_n)
    rotation_b = rotation_n = velocity_n = None
    if true.quat_xyzw is not None:
        R_true = Rotation.from_quat(true.quat_xyzw)
        rotation_b = _rotation_error(R_true, trajectory.quat_xyzw[rows])
        rotation_n = R_true.apply(rotation_b)
    if true.velocity_n is not None:
        velocity_n = trajectory.velocity_n[rows] - true.velocity_n
    if rotation_b is None:
        error, cov = position_n, trajectory.cov[rows, POS, POS]
    else:
        error, cov = np.hstack([rotation_b, position_n]), trajectory.cov[rows, :6, :6]
    return Errors(
        rows=rows,
        t_ns=trajectory.t_ns[rows],
        position_n=position_n,
        aligned_n=estimate_n @ R.T + p - true.position_n,
        rotation_b=rotation_b,
        rotation_n=rotation_n,
        velocity_n=velocity_n,
        nees=nees(error, cov),
        nees_dof=error.shape[1],
    )


def at_point(trajectory: Trajectory, arm_b: Floats) -> Trajectory:
    """The trajectory with positions p + R arm, those of a point at ``arm_b`` (3,) m, and the covariance of these."""
    R = trajectory.rotations()
    J = np.tile(np.eye(trajectory.cov.shape[1]), (len(trajectory), 1, 1))
    J[:, POS, ROT] = -R @ skew(arm_b)
    cov = J @ trajectory.cov @ J.transpose(0, 2, 1)
    return replace(trajectory, position_n=trajectory.position_n + R @ arm_b, cov=cov)


def truth_at(truth: Truth, t_ns: Times) -> tuple[np.ndarray, Truth]:
    """Which of the stamps the truth covers, (n,) bool, and the truth interpolated at those.

    Outside its span, and inside a gap (an interval above 5 times the median and above 0.1 s), there is no
    truth. Position: cubic Hermite where the velocity is known, else linear, whose error is up to
    acceleration x interval^2 / 8 (0.5 mm at 50 Hz and 10 m/s^2); a stamp of the truth itself gives
    exactly that sample. Attitude: constant turn rate between the two samples (slerp). Velocity: linear.
    """
    if len(truth.t_ns) < 2:
        nothing = np.zeros(len(t_ns), dtype=bool)
        return nothing, _rows(truth, np.array([], dtype=int))
    left = np.clip(np.searchsorted(truth.t_ns, t_ns, side="right") - 1, 0, len(truth.t_ns) - 2)
    intervals = np.diff(truth.t_ns) * 1e-9
    gap = intervals > max(GAP_RATIO * np.median(intervals), GAP_MIN_S)
    from_left, to_right = t_ns - truth.t_ns[left], truth.t_ns[left + 1] - t_ns
    sampled = (from_left == 0) | (to_right == 0)
    covered = (from_left >= 0) & (to_right >= 0) & (sampled | ~gap[left])
    left = left[covered]
    return covered, _between(_rows(truth, left), _rows(truth, left + 1), t_ns[covered])


def _between(a: Truth, b: Truth, t_ns: Times) -> Truth:
    """Truth at stamps (m,) between its samples a and b, row by row."""
    dt = (b.t_ns - a.t_ns)[:, None] * 1e-9
    u = (t_ns - a.t_ns)[:, None] * 1e-9 / dt
    position_n = (1 - u) * a.position_n + u * b.position_n
    quat_xyzw = velocity_n = None
    if a.velocity_n is not None and b.velocity_n is not None:
        velocity_n = (1 - u) * a.velocity_n + u * b.velocity_n
        # Hermite, written as what the end velocities add to the chord: zero at both ends.
        chord = b.position_n - a.position_n
        bend = (1 - u) * (a.velocity_n * dt - chord) - u * (b.velocity_n * dt - chord)
        position_n = position_n + u * (1 - u) * bend
    if a.quat_xyzw is not None and b.quat_xyzw is not None:
        R_a, R_b = Rotation.from_quat(a.quat_xyzw), Rotation.from_quat(b.quat_xyzw)
        quat_xyzw = (R_a * Rotation.from_rotvec(u * (R_a.inv() * R_b).as_rotvec())).as_quat()
    return Truth(t_ns, position_n, quat_xyzw, velocity_n)


def align(estimate: Floats, truth: Floats) -> tuple[Floats, Floats]:
    """R (3, 3) and p (3,) that minimise the sum of |R estimate + p - truth|^2; both inputs (m, 3) m.

    Umeyama (1991), eq. 40-42 with the scale fixed to 1. Points on a line leave the turn about it open and
    one point leaves R open; the distances that remain do not depend on the choice.
    """
    if not len(estimate) or not np.isfinite(estimate).all():
        return np.eye(3), np.full(3, np.nan)
    centre_estimate, centre_truth = estimate.mean(axis=0), truth.mean(axis=0)
    U, _, Vt = np.linalg.svd((truth - centre_truth).T @ (estimate - centre_estimate))
    proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ proper @ Vt
    return R, centre_truth - R @ centre_estimate


def nees(error: Floats, cov: Floats) -> Floats:
    """e^T P^-1 e; (m, k), (m, k, k) -> (m,). NaN where P is not positive definite or anything is not finite."""
    sd = np.sqrt(np.clip(np.diagonal(cov, axis1=1, axis2=2), 0.0, None))
    usable = np.isfinite(error).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)) & (sd > 0).all(axis=1)
    out = np.full(len(error), np.nan)
    # Radians and metres differ by orders of magnitude: judge definiteness on the correlations.
    sd = sd[usable]
    values, vectors = np.linalg.eigh(cov[usable] / (sd[:, :, None] * sd[:, None, :]))
    projected = np.einsum("mij,mi->mj", vectors, error[usable] / sd)
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = (projected**2 / values).sum(axis=1)
    out[usable] = np.where(values[:, 0] > 1e-12, squared, np.nan)
    return out


def chi_square_bounds(n: float, dof: int, alpha: float = 0.01) -> tuple[float, float]:
    """Interval that holds the mean of ``n`` independent NEES values of ``dof`` with probability 1 - ``alpha``.

    Bar-Shalom, Li, Kirubarajan (2001) sec. 5.4.2. ``n`` may be fractional: an effective number of samples.
    """
    low, high = chi_square_point(np.array([alpha / 2.0, 1.0 - alpha / 2.0]), n * dof) / n
    return float(low), float(high)


def _rms(values: Floats | None, unit: float = 1.0) -> float | None:
    """Root of the mean squared norm of rows (m, k) or values (m,), times ``unit``; None without any."""
    if values is None or not len(values):
        return None
    return float(unit * np.sqrt((values**2).sum() / len(values)))


def _root(variances: Floats, unit: float = 1.0) -> float | None:
    """Root of the mean over rows of the sums of ``variances`` (m, k), times ``unit``; None without any."""
    return float(unit * np.sqrt(variances.sum() / len(variances))) if len(variances) else None


def _inside(t_ns: Times, outages: Sequence[tuple[int, int]]) -> np.ndarray:
    """Which stamps lie in one of the (start, end), both included."""
    inside = np.zeros(len(t_ns), dtype=bool)
    for start, end in outages:
        inside |= (t_ns >= start) & (t_ns <= end)
    return inside


def _rotation_error(R_true: Rotation, quat_xyzw: Floats) -> Floats:
    """d in R_est = R_true Exp(d), (m, 3) rad; NaN where the estimate is no rotation (a filter that diverged)."""
    norm = np.linalg.norm(quat_xyzw, axis=1)
    broken = ~(np.isfinite(norm) & (norm > 0))
    R_est = Rotation.from_quat(np.where(broken[:, None], [0.0, 0.0, 0.0, 1.0], quat_xyzw))
    return np.where(broken[:, None], np.nan, (R_true.inv() * R_est).as_rotvec())


def _rows(truth: Truth, rows: np.ndarray) -> Truth:
    quat = None if truth.quat_xyzw is None else truth.quat_xyzw[rows]
    velocity = None if truth.velocity_n is None else truth.velocity_n[rows]
    return Truth(truth.t_ns[rows], truth.position_n[rows], quat, velocity)
