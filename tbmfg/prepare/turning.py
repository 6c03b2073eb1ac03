"""Whether a LiDAR turns as the gyro does: a clock or a mounting that the rig has wrong shows in the steps.

The steps of the odometry and the gyro's over the same times are one rotation seen in two frames (Kelly, Sukhatme 2011).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tbmfg.diagnosis import observed
from tbmfg.geometry import exp_so3, log_so3, rpy_from_rotation, skew
from tbmfg.measure import GyroFrame, Samples
from tbmfg.rig import Lidar
from tbmfg.state import Calibrated
from tbmfg.timeseries import Floats

SPAN_S = 1.0  # over which turns are compared, and averaged
LEAST = 10  # such spans: of equal turns, or of unequal ones as many as their squares make
ITERATIONS = 20
STILL = 1e-6  # rad and s
BOUND = 3.0  # times the usual residual from which a span loses weight
WIDE = np.repeat([np.pi, 1.0, 0.1], [3, 1, 3])  # rad, s, rad/s: sds of what no turn shows
PULL = 0.01  # share of the turns with which the rig's mounting counts where they leave it open

CONTRADICTION = 3.0  # sds between rig and log from which it is said
LATE_S, TURNED = 0.005, np.deg2rad(1.0)  # and what is too little to matter


@dataclass(frozen=True, slots=True)
class Turning:
    """Found beside the rig's values: ``turn`` (3,) rad, the LiDAR's axes are R_bl Exp(turn), and ``late_s``, by which
    its stamps are later than the rig says; with their sds."""

    turn: Floats
    turn_sd: Floats
    late_s: float
    late_sd: float


def against_gyro(sensor: Lidar, poses: Samples, frame: GyroFrame) -> Turning | None:
    """Mounting and clock by the turns alone, least squares with the gyro's bias; None where too few spans turn, or too
    few poses tell theirs. The usual residual is that of the spans that turn: while it stands, scans agree better.

    ``poses`` as :func:`tbmfg.prepare.scans.register` makes them. What no turn shows has a large sd. The gyro has
    carried the points within each scan: what vibrates agrees with it whatever the clock, and is averaged out.
    """
    roots, R = poses.values[:, 12:].reshape(-1, 6, 6), poses.values[:, :9].reshape(-1, 3, 3)
    span = max(1, round(SPAN_S / float(np.median(np.diff(poses.t_s)))))
    untold = np.cumsum(np.abs(roots).max(axis=(1, 2)) == 0)
    first = np.flatnonzero(untold[span:] == untold[:-span])
    first = first[: len(first) // span * span]
    if len(first) < LEAST * span:
        return None
    last = first + span

    def averaged(values: Floats) -> Floats:
        return values.reshape(len(first) // span, span, *values.shape[1:]).mean(axis=1)

    start_s, end_s = poses.t_s[first], poses.t_s[last]
    W = averaged(_of_rotation(roots[last]))
    seen = averaged(log_so3(R[first].swapaxes(1, 2) @ R[last]))
    turns = np.sum(averaged(_turned(frame, start_s, end_s)) ** 2, axis=1)
    if turns.sum() ** 2 < LEAST * (turns @ turns):
        return None
    faster_b, dt = averaged(frame.rate(end_s) - frame.rate(start_s)), averaged(end_s - start_s)[:, None, None]
    ways = [sensor.T_bl.R, _roughly(sensor.T_bl.R, averaged(_turned(frame, start_s, end_s)), seen)]

    def solved(R_bl: Floats) -> tuple[float, Floats, float, Floats]:
        """Usual residual, mounting, lateness and covariance, from a first mounting."""
        late_s = 0.0
        for _ in range(ITERATIONS):
            own = averaged(_turned(frame, start_s - late_s, end_s - late_s)) @ R_bl
            bias = np.broadcast_to(R_bl.T, (len(own), 3, 3)) * dt
            A = W @ np.concatenate([skew(own), -(faster_b @ R_bl)[:, :, None], bias], axis=2)
            r = (W @ (seen - own)[:, :, None])[:, :, 0]
            size = np.linalg.norm(r, axis=1)
            usual = max(_median(size, turns) / 1.54, 1.0)  # the median of a chi of three
            weight = np.minimum(1.0, BOUND * usual / np.maximum(size, 1e-12)) / usual**2
            cov = np.linalg.inv(np.einsum("n,nki,nkj->ij", weight, A, A) + np.diag(WIDE**-2.0))
            step = cov @ np.einsum("n,nki,nk->i", weight, A, r)
            R_bl, late_s = R_bl @ exp_so3(step[:3]), late_s + step[3]
            if np.abs(step[:4]).max() < STILL:
                break
        return float(usual), R_bl, float(late_s), cov

    _, R_bl, late_s, cov = min((solved(way) for way in ways), key=lambda one: one[0])
    sd = np.sqrt(np.diag(cov))
    return Turning(log_so3(sensor.T_bl.R.T @ R_bl), sd[:3], late_s, float(sd[3]))


def _median(values: Floats, weights: Floats) -> float:
    """The value with half of the weight on either side."""
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())])


def _turned(frame: GyroFrame, first_s: Floats, last_s: Floats) -> Floats:
    """By gyro from one time to another in b, (n, 3) rad."""
    edges = frame.steps.edges_s
    R_first, R_last = (frame.at(np.clip(t_s, edges[0], edges[-1])) for t_s in (first_s, last_s))
    return log_so3(R_first.swapaxes(1, 2) @ R_last)


def _roughly(R_bl: Floats, turned_b: Floats, seen: Floats) -> Floats:
    """Rotation that takes ``seen`` (n, 3) to ``turned_b`` best: Wahba's problem by SVD (Markley 1988)."""
    U, _, V = np.linalg.svd(turned_b.T @ seen + PULL * np.sum(turned_b**2) * R_bl)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V


def _of_rotation(roots: Floats) -> Floats:
    """Roots (n, 6, 6) of the information of rotation and position to what they say of rotation alone, (n, 6, 3)."""
    Q, _ = np.linalg.qr(roots[:, :, 3:])
    return roots[:, :, :3] - Q @ (Q.swapaxes(1, 2) @ roots[:, :, :3])


def calibrations(name: str, sensor: Lidar, found: Turning) -> dict[str, Calibrated]:
    """What the turns say of clock and mounting, beside what the estimate goes by."""
    seen = tuple(observed(found.turn_sd, sensor.rpy_sd).tolist()) if sensor.rpy_sd else None
    return {
        f"{name}_clock_offset_by_gyro_s": Calibrated(sensor.clock_offset + found.late_s, found.late_sd, True),
        f"{name}_turn_by_gyro_deg": Calibrated(
            tuple(np.rad2deg(found.turn).tolist()), tuple(np.rad2deg(found.turn_sd).tolist()), True, seen
        ),
    }


def contradictions(name: str, sensor: Lidar, found: Turning) -> list[str]:
    """Clock and mounting where the turns contradict the rig clearly and by an amount that matters."""
    lines = []
    if abs(found.late_s) > max(CONTRADICTION * found.late_sd, LATE_S):
        lines.append(
            f"its turns come {1e3 * found.late_s:.0f} ± {1e3 * found.late_sd:.0f} ms later than the gyro's; "
            f"sensors.{name}.clock_offset_s={sensor.clock_offset + found.late_s:.3f} would explain it"
        )
    size = float(np.linalg.norm(found.turn))
    sd = np.hypot(found.turn_sd, sensor.rpy_sd)
    if size > TURNED and (np.abs(found.turn) > CONTRADICTION * sd).any():
        rpy = ", ".join(f"{np.rad2deg(a):.1f}" for a in rpy_from_rotation(sensor.T_bl.R @ exp_so3(found.turn)))
        told = " and ".join(f"{axis} to {np.rad2deg(s):.2g}" for axis, s in zip("xyz", found.turn_sd, strict=True))
        lines.append(
            f"its turns are the gyro's with the mounting turned by {np.rad2deg(size):.1f} deg (sd about {told} deg); "
            f"sensors.{name}.T_bl.rpy_deg=[{rpy}] would explain it"
        )
    return lines
