"""The dual-coordinate method: what a shaft machine's tilt and its laser spot together say of its deviation.

Wang et al., Sensors 2019, 19, 5007, section 3 and Table 1. Axes are the paper's: the shaft reference r has X along
the rig's ``deviation.reference_deg`` in n (n's own x axis unless the rig says otherwise; north has no part in it but
through ``origin.x_axis_azimuth_deg``), Y to the right, Z down; the machine a is forward-right-down. Roll alpha,
pitch beta (bow up positive) and yaw gamma (clockwise from above) take r to a by their eq. (1). The spot (a, b) is
the laser's on the detector, forward and to the right.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit
from scipy.special import ndtr, ndtri

from tbmfg.geometry import FLIP, rotation_z, wrap
from tbmfg.measure import Samples, nearest
from tbmfg.rig import Deviation, Laser
from tbmfg.state import Trajectory
from tbmfg.timeseries import Floats, seconds

NORMAL, TROUBLESHOOT, STOP = 0, 1, 2
LEVELS = ("normal", "troubleshoot", "stop")
NO_DEVIATION, ABNORMAL = 0, -1  # beside the case numbers 1..32
SPOT_GAP_S = 2.0  # without a spot for longer nothing is said
OFTEN = 0.01  # share of the time beyond a tolerance by the estimate's own error, from which that is said

# Table 1: signs of the spot (a, b) -> signs of (beta, alpha) -> case of Fig. 8. What is not here is abnormal.
CASES = {
    (1, 1): {(1, 1): 1, (-1, -1): 7, (0, 0): 17},
    (-1, 1): {(1, -1): 3, (-1, 1): 5, (0, 0): 19},
    (-1, -1): {(1, 1): 2, (-1, -1): 8, (0, 0): 21},
    (1, -1): {(1, -1): 4, (-1, 1): 6, (0, 0): 23},
    (1, 0): {(-1, 0): 13, (1, 0): 15, (0, 0): 24},
    (-1, 0): {(-1, 0): 14, (1, 0): 16, (0, 0): 20},
    (0, 1): {(0, 1): 9, (0, -1): 11, (0, 0): 18},
    (0, -1): {(0, 1): 10, (0, -1): 12, (0, 0): 22},
    (0, 0): {
        (1, 1): 25, (1, -1): 26, (-1, 1): 27, (-1, -1): 28, (0, 1): 29, (0, -1): 30, (-1, 0): 31, (1, 0): 32,
        (0, 0): NO_DEVIATION,
    },
}  # fmt: skip
CASE_OF = np.full((3, 3, 3, 3), ABNORMAL)  # by the signs of a, b, beta, alpha, each plus one
for _spot, _tilts in CASES.items():
    for _tilt, _case in _tilts.items():
        CASE_OF[tuple(np.add((*_spot, *_tilt), 1))] = _case


@dataclass(frozen=True, slots=True)
class Classified:
    """``signs`` (n, 5) of a, b, beta, alpha, gamma; ``case`` (n,) 1..32, 0 no deviation, -1 abnormal; ``level`` (n,)
    index into ``LEVELS``."""

    signs: np.ndarray
    case: np.ndarray
    level: np.ndarray


def classify(signs: np.ndarray) -> Classified:
    """Table 1 for signs (n, 5) of a, b, beta, alpha, gamma, each -1, 0 or 1. A yaw that is not zero always means stop;
    a combination that the table does not have means troubleshooting where the yaw is zero."""
    case = CASE_OF[tuple(np.asarray(signs)[:, :4].T + 1)]
    level = np.where(signs[:, 4] != 0, STOP, np.where(case == ABNORMAL, TROUBLESHOOT, NORMAL))
    return Classified(np.asarray(signs), case, level)


def direction(signs: np.ndarray) -> str:
    """Where the machine's bottom deviates to, seen from above, for one row of signs (5,): right with beta, up with
    alpha; "displacement only" and "none" where it does not tilt."""
    vertical, sideways = {1: "up", -1: "down"}.get(signs[3]), {1: "right", -1: "left"}.get(signs[2])
    if vertical and sideways:
        return f"{'upper' if vertical == 'up' else 'lower'} {sideways}"
    return vertical or sideways or ("displacement only" if signs[:2].any() else "none")


@njit(cache=True)
def settled_signs(values, t_s, tolerance, release, window_s):
    """Signs (n, m) of ``values`` (n, m) over times ``t_s`` (n,), zero within ``tolerance`` (m,).

    Judged on the running median over ``window_s``, which drops what lasts less than half of it and keeps edges where
    they are; a sign is entered beyond the tolerance and left below ``release`` times it. ``release`` 1 and
    ``window_s`` 0 take every value alone.
    """
    n, m = values.shape
    out = np.zeros((n, m), dtype=np.int64)
    for j in range(m):
        sign = first = last = 0
        for k in range(n):
            while t_s[first] < t_s[k] - 0.5 * window_s:
                first += 1
            while last < n and t_s[last] <= t_s[k] + 0.5 * window_s:
                last += 1
            x = np.median(values[first:last, j])
            band = tolerance[j] * (release if x * sign > 0 else 1.0)
            sign = int(x > band) - int(x < -band)
            out[k, j] = sign
    return out


def angles_of(R_nb: Floats, reference: float) -> Floats:
    """Roll, pitch, yaw [rad] of (4), (5) from R_nb (n, 3, 3); (n, 3). ``reference`` is the direction of r's X in n,
    counter-clockwise from n's x axis; erratum S2: by atan2, yaw in (-pi, pi]."""
    C_ar = FLIP @ rotation_z(-reference) @ R_nb @ FLIP
    roll = np.arctan2(C_ar[:, 2, 1], C_ar[:, 2, 2])
    pitch = np.arcsin(np.clip(-C_ar[:, 2, 0], -1.0, 1.0))
    return np.column_stack([roll, pitch, wrap(np.arctan2(C_ar[:, 1, 0], C_ar[:, 0, 0]))])


def spots_at(spots: Samples, sensor: Laser, keyframes_s: Floats) -> tuple[np.ndarray, Floats]:
    """The keyframes that see the spot, (m,), and the mean of (a, b) [m] there, forward and to the right, (m, 2)."""
    k = nearest(keyframes_s, spots.t_s - getattr(sensor, "clock_offset", 0.0))
    count = np.bincount(k, minlength=len(keyframes_s))
    seen = np.flatnonzero(count)
    ab = spots.values @ (FLIP @ sensor.T_bd.R)[:2, :2].T
    return seen, np.column_stack([np.bincount(k, weights=ab[:, axis])[seen] / count[seen] for axis in (0, 1)])


@dataclass(frozen=True, slots=True)
class Deviated:
    """Where a spot was seen: ``t_s`` (n,), the mean ``spot`` (n, 2) m, ``angles`` (n, 3) rad of roll, pitch and yaw,
    and the ``state`` that they make."""

    t_s: Floats
    spot: Floats
    angles: Floats
    state: Classified


def deviation(trajectory: Trajectory, spots: Samples, sensor: Laser, rule: Deviation, t0_ns: int) -> Deviated:
    """The dual coordinates at a trajectory's keyframes, times in s from ``t0_ns``."""
    t_all = seconds(trajectory.t_ns, t0_ns)
    seen, spot = spots_at(spots, sensor, t_all)
    t_s, angles = t_all[seen], angles_of(trajectory.rotations()[seen], rule.reference)
    tolerance = np.array([rule.spot_tolerance] * 2 + [rule.angle_tolerance] * 2 + [rule.yaw_tolerance])
    values = np.column_stack([spot, angles[:, [1, 0, 2]]])
    return Deviated(t_s, spot, angles, classify(settled_signs(values, t_s, tolerance, rule.release, rule.window)))


def timeline(trajectory: Trajectory, spots: Samples, sensor: Laser, rule: Deviation, t0_ns: int) -> dict[str, Any]:
    """The deviation over a trajectory's keyframes: seconds spent in each level, and the intervals of equal state.

    Of every interval: start and end in s from ``t0_ns``, case (null: not in the table), direction, level, and the means
    of spot (a, b) in mm and of roll, pitch, yaw in degrees, in the paper's axes. It ends where the next begins, or at
    the last keyframe before a time without spots.
    """
    found = deviation(trajectory, spots, sensor, rule, t0_ns)
    t_s, spot, angles, state = found.t_s, found.spot, found.angles, found.state
    lost = np.diff(t_s) > SPOT_GAP_S
    told = np.column_stack([state.case, state.level, state.signs[:, 2:4]])
    changed = (np.diff(told, axis=0) != 0).any(axis=1)
    borders = [0, *(np.flatnonzero(changed | lost) + 1), len(t_s)]
    intervals, spent = [], dict.fromkeys(LEVELS, 0.0)
    for first, last in pairwise(borders):
        end = last if last < len(t_s) and not lost[last - 1] else last - 1
        level, case = LEVELS[state.level[first]], int(state.case[first])
        spent[level] += float(t_s[end] - t_s[first])
        intervals.append(
            {
                "start_s": float(t_s[first]),
                "end_s": float(t_s[end]),
                "case": None if case == ABNORMAL else case,
                "direction": direction(state.signs[first]),
                "level": level,
                "spot_mm": (1e3 * spot[first:last].mean(axis=0)).tolist(),
                "roll_pitch_yaw_deg": np.rad2deg(angles[first:last].mean(axis=0)).tolist(),
            }
        )
    return {"level_s": spent, "timeline": intervals}


def vague(trajectory: Trajectory, rule: Deviation) -> list[str]:
    """Angles that are known too poorly for their tolerances, so that a machine without deviation would often seem to
    have one. Says nothing of a trajectory without covariance."""
    sd = np.median(np.sqrt(np.diagonal(trajectory.cov[:, :3, :3], axis1=1, axis2=2)), axis=0)  # of a machine near level
    lines = []
    for what, said, key in zip(("roll", "pitch", "yaw"), sd, ("angle", "angle", "yaw"), strict=True):
        tolerance = getattr(rule, f"{key}_tolerance")
        outside = 2.0 * ndtr(-tolerance / said) if said > 0 else 0.0
        if outside > OFTEN:
            lines.append(
                f"deviation: {what} is known to {np.rad2deg(said):.2g} deg (1 sd), its tolerance is "
                f"{np.rad2deg(tolerance):.2g} deg: without any deviation it would be outside {outside:.0%} of the time"
                f"; set deviation.{key}_tolerance_deg to {np.rad2deg(-said * ndtri(OFTEN / 2)):.2g} or more"
            )
    return lines
