"""Whether a LiDAR turns as the gyro does: a clock that is wrong or steps, or a wrong mounting, shows in the turns.

The steps of the odometry and the gyro's over the same times are one rotation seen in two frames (Kelly, Sukhatme 2011).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tbmfg.chance import chi_square_point
from tbmfg.diagnosis import observed
from tbmfg.geometry import exp_so3, log_so3, rpy_from_rotation, skew
from tbmfg.inertial.steps import Steps, to_ns
from tbmfg.measure import GyroFrame, Samples
from tbmfg.rig import Lidar
from tbmfg.state import Calibrated, Interval
from tbmfg.timeseries import Floats

SPAN_S = 1.0  # over which turns are compared, and averaged
LEAST = 10  # such spans: of equal turns, or of unequal ones as many as their squares make
ITERATIONS = 20
STILL = 1e-6  # rad and s
BOUND = 3.0  # times the usual residual from which a span loses weight
WIDE = np.repeat([np.pi, 0.1], 3)  # rad, rad/s: sds of what no turn shows
PULL = 0.01  # share of the turns with which the rig's mounting counts where they leave it open

LATEST_S = 2.0  # lateness that is looked for: what is turned in some seconds tells no other
APART_S = 0.1  # in such pieces
RARELY = 1e-4  # of logs whose clock keeps its step, in how many one may be found
ASTRAY = 4.0  # times the usual residual that a span is held against a lateness with: it alone is no step
PASSES = 3

CONTRADICTION = 3.0  # sds between rig and log from which it is said
LATE_S, TURNED = 0.005, np.deg2rad(1.0)  # and what is too little to matter


@dataclass(frozen=True, slots=True)
class Turning:
    """Found beside the rig's values: ``turn`` (3,) rad, the LiDAR's axes are R_bl Exp(turn), and ``late_s`` (m,), by
    which its stamps are later than the rig says; with their sds. Of a clock that steps there are several, each from one
    of the times ``from_s`` (m,) on."""

    turn: Floats
    turn_sd: Floats
    late_s: Floats
    late_sd: Floats
    from_s: Floats

    @property
    def steps(self) -> list[tuple[float, float, float]]:
        """Of its clock: time, size and sd of each, s."""
        sizes, sds = np.diff(self.late_s), np.hypot(self.late_sd[1:], self.late_sd[:-1])
        return list(zip(self.from_s[1:].tolist(), sizes.tolist(), sds.tolist(), strict=True))


@dataclass(frozen=True, slots=True)
class Spans:
    """Turns over spans of time by the scans, ``seen`` (n, 3) in the LiDAR's axes, whitened by ``W`` (n, 6, 3), and by
    the gyro, each the mean of neighbouring spans: from ``start_s`` to ``end_s`` (n, span)."""

    frame: GyroFrame
    start_s: Floats
    end_s: Floats
    seen: Floats
    W: Floats

    def turned_b(self, late_s: Floats | float) -> Floats:
        """By the gyro, (n, 3) rad, when the stamps are late by ``late_s``, one for all or (n,)."""
        late_s = np.broadcast_to(late_s, len(self.seen))[:, None]
        start_s, end_s = (self.start_s - late_s).ravel(), (self.end_s - late_s).ravel()
        return _turned(self.frame, start_s, end_s).reshape(*self.start_s.shape, 3).mean(axis=1)

    def residuals(self, own: Floats) -> Floats:
        """Of turns (..., n, 3) by the gyro in the LiDAR's axes, (..., n, 6)."""
        return (self.W @ (self.seen - own)[..., None])[..., 0]


def against_gyro(sensor: Lidar, poses: Samples, frame: GyroFrame) -> Turning | None:
    """Mounting and clock by the turns alone, least squares with the gyro's bias; None where too few spans turn, or too
    few poses tell theirs, or where another lateness would explain them as well. The usual residual is that of the spans
    that turn: while it stands, scans agree better.

    ``poses`` as :func:`tbmfg.prepare.scans.register` makes them. What no turn shows has a large sd. The gyro has
    carried the points within each scan: what vibrates agrees with it whatever the clock, and is averaged out.
    """
    spans = _spans(poses, frame)
    if spans is None:
        return None
    still_b = spans.turned_b(0.0)
    turns = np.sum(still_b**2, axis=1)
    if turns.sum() ** 2 < LEAST * (turns @ turns):
        return None
    lates = np.arange(-LATEST_S, LATEST_S + APART_S / 2, APART_S)
    turned_b = np.array([spans.turned_b(late_s) for late_s in lates])
    ways = [sensor.T_bl.R, _roughly(sensor.T_bl.R, still_b, spans.seen)]
    fits = [_fitted(spans, turns, lates, turned_b, way) for way in ways]
    fit = min(fits, key=lambda one: one.usual)
    if not fit.unique:
        return None
    middle_s = 0.5 * (spans.start_s + spans.end_s).mean(axis=1)
    first = np.flatnonzero(np.diff(fit.stretch)) + 1
    from_s = np.append(poses.t_s[0], 0.5 * (middle_s[first - 1] + middle_s[first]))
    return Turning(log_so3(sensor.T_bl.R.T @ fit.R_bl), fit.sd[:3], fit.late_s, fit.sd[6:], from_s)


def _spans(poses: Samples, frame: GyroFrame) -> Spans | None:
    """Those in which every pose tells its turn; None of too few."""
    roots, R = poses.values[:, 12:].reshape(-1, 6, 6), poses.values[:, :9].reshape(-1, 3, 3)
    span = max(1, round(SPAN_S / float(np.median(np.diff(poses.t_s)))))
    untold = np.cumsum(np.abs(roots).max(axis=(1, 2)) == 0)
    first = np.flatnonzero(untold[span:] == untold[:-span])
    first = first[: len(first) // span * span]
    if len(first) < LEAST * span:
        return None
    last = first + span

    def together(values: Floats) -> Floats:
        return values.reshape(len(first) // span, span, *values.shape[1:])

    seen = together(log_so3(R[first].swapaxes(1, 2) @ R[last])).mean(axis=1)
    W = together(_of_rotation(roots[last])).mean(axis=1)
    return Spans(frame, together(poses.t_s[first]), together(poses.t_s[last]), seen, W)


@dataclass(frozen=True, slots=True)
class Fit:
    """Mounting R_bl, lateness of every stretch, sds of [turn, gyro bias, lateness]; the ``stretch`` that each span
    belongs to; the ``usual`` residual; and whether no other lateness of any stretch fits."""

    R_bl: Floats
    late_s: Floats
    sd: Floats
    stretch: NDArray
    usual: float
    unique: bool


def _fitted(spans: Spans, turns: Floats, lates: Floats, turned_b: Floats, R_bl: Floats) -> Fit:
    """From a first mounting, in turns: which stretches of time the clock keeps its lateness over, and least squares.

    ``turned_b`` (l, n, 3) are the gyro's turns at the latenesses ``lates`` (l,). A lateness that is no better than
    another by chance is better over some stretch by more than z^2 with probability Phi(-z) at most, whatever the turns;
    of n spans and l latenesses that may begin with any, z is the point that is passed in ``RARELY`` of logs.
    """
    n, late_s = len(turns), np.zeros(0)
    limit = float(chi_square_point(1.0 - 2.0 * RARELY / (n * len(lates)), 1))
    for _ in range(PASSES):
        before_s, all_s = late_s, np.append(lates, late_s)
        all_b = np.concatenate([turned_b, *(spans.turned_b(one)[None] for one in late_s)])
        size = np.linalg.norm(spans.residuals(all_b @ R_bl), axis=2).T
        usual = max(min(_quantile(one, turns, 0.25) for one in size.T) / 1.10, 1.0)  # quartile of a chi of three
        cost = np.minimum(size / usual, ASTRAY) ** 2
        which = _kept(cost, limit)
        stretch = np.cumsum(np.append(0, np.diff(which) != 0))
        late_s = all_s[which[np.unique(stretch, return_index=True)[1]]]
        usual, R_bl, late_s, sd = _least_squares(spans, turns, R_bl, late_s, stretch)
        while (near := np.abs(np.diff(late_s)) < APART_S).any():  # a drift, or between two of ``lates``: no step
            joined = np.append(0, np.cumsum(~near))
            stretch, late_s = joined[stretch], late_s[np.unique(joined, return_index=True)[1]]
            usual, R_bl, late_s, sd = _least_squares(spans, turns, R_bl, late_s, stretch)
        if len(late_s) == len(before_s) and np.abs(late_s - before_s).max() < STILL:
            break
    own = spans.residuals(spans.turned_b(late_s[stretch]) @ R_bl)
    own_cost = np.minimum(np.linalg.norm(own, axis=1) / usual, ASTRAY) ** 2
    size = np.linalg.norm(spans.residuals(turned_b @ R_bl), axis=2).T
    cost = np.minimum(size / usual, ASTRAY) ** 2
    unique = bool((np.abs(late_s) < LATEST_S).all())
    for k, (late, late_sd) in enumerate(zip(late_s, sd[6:], strict=True)):
        other = np.abs(lates - late) > max(APART_S, 2.0 * np.sqrt(limit) * late_sd)  # beyond the doubt of this one
        worse = cost[stretch == k].sum(axis=0) - own_cost[stretch == k].sum()
        unique &= bool((worse[other] > limit).all())
    return Fit(R_bl, late_s, sd, stretch, usual, unique)


def _kept(cost: Floats, limit: float) -> NDArray:
    """Which of the columns is kept in each row of ``cost`` (n, l) when a change costs ``limit``: Viterbi (1967)."""
    total, back = cost[0], []
    for row in cost[1:]:
        best = int(np.argmin(total))
        changed = total > total[best] + limit
        back.append(np.where(changed, best, np.arange(len(total))))
        total = np.where(changed, total[best] + limit, total) + row
    which = [int(np.argmin(total))]
    for before in reversed(back):
        which.append(int(before[which[-1]]))
    return np.array(which[::-1])


def _least_squares(
    spans: Spans, turns: Floats, R_bl: Floats, late_s: Floats, stretch: NDArray
) -> tuple[float, Floats, Floats, Floats]:
    """Usual residual, mounting, lateness of every stretch, and sds of [turn, gyro bias, lateness]."""
    frame, prior = spans.frame, np.append(WIDE, np.full(len(late_s), LATEST_S))
    dt = (spans.end_s - spans.start_s).mean(axis=1)[:, None, None]
    at = np.eye(len(late_s))[stretch]  # (n, m): which lateness is a span's
    for _ in range(ITERATIONS):
        late = late_s[stretch][:, None]
        own = spans.turned_b(late[:, 0]) @ R_bl
        rates_b = [frame.rate((t_s - late).ravel()).reshape(*t_s.shape, 3) for t_s in (spans.start_s, spans.end_s)]
        faster_b = (rates_b[1] - rates_b[0]).mean(axis=1)
        bias = np.broadcast_to(R_bl.T, (len(own), 3, 3)) * dt
        A = spans.W @ np.concatenate([skew(own), bias, -(faster_b @ R_bl)[:, :, None] * at[:, None]], axis=2)
        r = spans.residuals(own)
        size = np.linalg.norm(r, axis=1)
        usual = max(_quantile(size, turns, 0.5) / 1.54, 1.0)  # the median of a chi of three
        weight = np.minimum(1.0, BOUND * usual / np.maximum(size, 1e-12)) / usual**2
        cov = np.linalg.inv(np.einsum("n,nki,nkj->ij", weight, A, A) + np.diag(prior**-2.0))
        step = cov @ np.einsum("n,nki,nk->i", weight, A, r)
        R_bl, late_s = R_bl @ exp_so3(step[:3]), np.clip(late_s + step[6:], -LATEST_S, LATEST_S)
        if max(np.abs(step[:3]).max(), np.abs(step[6:]).max()) < STILL:
            break
    return usual, R_bl, late_s, np.sqrt(np.diag(cov))


def _quantile(values: Floats, weights: Floats, share: float) -> float:
    """The value with this share of the weight below it."""
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(weights[order]), share * weights.sum())])


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
    """What the turns say of the mounting, and of a clock that does not step, beside what the estimate goes by."""
    turn, turn_sd = (tuple(np.rad2deg(part).tolist()) for part in (found.turn, found.turn_sd))
    seen = tuple(observed(found.turn_sd, sensor.rpy_sd).tolist()) if sensor.rpy_sd else None
    told = {f"{name}_turn_by_gyro_deg": Calibrated(turn, turn_sd, True, seen)}
    if len(found.late_s) == 1:
        offset, sd = sensor.clock_offset + float(found.late_s[0]), float(found.late_sd[0])
        told = {f"{name}_clock_offset_by_gyro_s": Calibrated(offset, sd, True)} | told
    return told


def since_steps(name: str, found: Turning, steps: Steps) -> list[Interval]:
    """From each step of its clock to the next, or to the end."""
    ends_s = pairwise([*found.from_s[1:], steps.end_s])
    return [Interval(name, "clock", *(int(t) for t in to_ns(steps, np.array(ends)))) for ends in ends_s]


def contradictions(name: str, sensor: Lidar, found: Turning) -> list[str]:
    """Clock and mounting where the turns contradict the rig clearly and by an amount that matters."""
    lines = []
    late_s, late_sd = found.late_s[0], found.late_sd[0]
    if found.steps:
        said = " and ".join(f"by {size:+.2f} ± {sd:.2f} s at about {at_s:.0f} s" for at_s, size, sd in found.steps)
        offsets = ", ".join(f"{sensor.clock_offset + late:.2f}" for late in found.late_s)
        lines.append(
            f"its clock steps {said}: its turns show it; estimate the parts one by one (--start, --end), with "
            f"sensors.{name}.clock_offset_s={offsets} in this order, or all of it without {name}"
        )
    elif abs(late_s) > max(CONTRADICTION * late_sd, LATE_S):
        lines.append(
            f"its turns come {1e3 * late_s:.0f} ± {1e3 * late_sd:.0f} ms later than the gyro's; "
            f"sensors.{name}.clock_offset_s={sensor.clock_offset + late_s:.3f} would explain it"
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
