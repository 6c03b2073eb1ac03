"""From states, covariances and residuals to a Result: calibrations, counts and what must be said."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from tbmfg import diagnosis, residuals
from tbmfg.chance import chi_square_point
from tbmfg.geometry import exp_so3, quat_from_matrix, rpy_from_rotation
from tbmfg.problem import CLOCK, GATE, STRENGTH, Problem
from tbmfg.rig import Rig
from tbmfg.state import NAV, Calibrated, Counts, Innovations, Result, Trajectory
from tbmfg.timeseries import Floats, Times

CONTRADICTING = 0.02  # share of rows beyond the gate, of which chance puts 0.1 % there, from which it is said

DEG = 180.0 / np.pi
# the first of the parameters that make one calibration: how many they are, its public name, and its unit
PUBLIC = {
    "arm_x": (3, "lever_arm_m", 1.0),
    "clock_offset": (1, "clock_offset_s", 1.0),
    "clock_drift": (1, "clock_drift_ppm", 1e6),
    "yaw": (2, "mounting_yaw_pitch_deg", DEG),
    "declination": (1, "declination_deg", DEG),
    "iron_x": (3, "hard_iron_ut", 1.0),
    STRENGTH: (1, "horizontal_field_ut", 1.0),
    "mount_x": (3, "mounting_m", 1.0),
    "turn_x": (3, "mounting_turn_deg", DEG),
    "tilt_x": (2, "tilt_deg", DEG),
    "offset_x": (2, "offset_m", 1.0),
    "scale": (1, "scale", 1.0),
    "lapse": (1, "lapse_kpkm", 1e3),
}


def trajectory(problem: Problem, x: Floats, cov: Floats) -> Trajectory:
    """States (n, 21 + e) and covariances (n, 15 + e, 15 + e) at the keyframes as a trajectory in n."""
    return Trajectory(
        t_ns=problem.t_ns,
        position_n=x[:, 9:12] + problem.origin_n,
        quat_xyzw=quat_from_matrix(x[:, :9].reshape(-1, 3, 3)),
        velocity_n=x[:, 12:15].copy(),
        bias_acc=x[:, 15:18].copy(),
        bias_gyro=x[:, 18:21].copy(),
        cov=np.ascontiguousarray(cov[:, :NAV, :NAV]),
    )


def result(
    problem: Problem,
    estimator: str,
    x: Floats,
    cov: Floats,
    c: Floats,
    c_cov: Floats,
    nis: dict[str, Floats],
    gated: dict[str, np.ndarray],
    row_times_ns: Times | None = None,
    last_x: Floats | None = None,
) -> Result:
    """What an estimator returns, from its states, calibrations ``c`` (m,) with covariance, and rows' NIS and gates.

    The problem's rows lie at keyframes, or, if ``row_times_ns`` is given, at these stamps. ``last_x`` (n, 21 + e): the
    last estimates, that know the whole log or much of it, where there are any.
    """
    path = trajectory(problem, x, cov)
    sd = np.sqrt(np.maximum(np.diag(c_cov), 0.0))
    at = x if last_x is None else last_x
    biased = residuals.biased(problem, at, c, causal=last_x is None) if row_times_ns is None else []
    row_times_ns = path.t_ns if row_times_ns is None else row_times_ns
    innovations = {
        rows.sensor: Innovations(row_times_ns[rows.j], nis[rows.sensor], rows.dof, gated[rows.sensor])
        for rows in problem.rows
    }
    told = residuals.correlation(problem, at, c, gated) if last_x is not None else {}
    for sensor, one in told.items():
        innovations[sensor] = replace(innovations[sensor], correlation=one.value, correlation_sd=one.sd)
    stretches = diagnosis.gated_stretches(innovations)
    return Result(
        estimator=estimator,
        trajectory=path,
        calibration={**calibrations(problem, c, sd), **_drifts(problem, x, cov)},
        counts=_counts(problem, gated),
        innovations=innovations,
        health=problem.health,
        intervals=[*problem.intervals, *stretches, *(one.stretch for one in biased)],
        warnings=[
            *diagnosis.unobserved(problem, path, sd),
            *diagnosis.vague_heading(path),
            *diagnosis.gated_in_words(innovations, stretches, problem.t0_ns),
            *diagnosis.gated_together(stretches, problem.t0_ns),
            *residuals.biased_in_words(biased, problem.t0_ns),
            *residuals.correlated_in_words(problem, told),
        ],
    )


def of_samples(problem: Problem, estimator: str, x: Floats, cov: Floats | None, used: dict[str, int]) -> Result:
    """What a filter returns that takes ``used`` samples of each sensor as they come and gates none.

    ``cov`` None: it has no covariance, and zeros stand in its place, as in ROS messages; no NEES is made of them.
    """
    path = trajectory(problem, x, np.zeros((len(x), NAV, NAV)) if cov is None else cov)
    counts = {name: replace(count, used=used.get(name, count.used)) for name, count in problem.counts.items()}
    said = (
        [f"{estimator} has no covariance: zeros stand in its place"] if cov is None else diagnosis.vague_heading(path)
    )
    return Result(
        estimator=estimator,
        trajectory=path,
        calibration=dict(problem.calibration),
        counts=_completed(counts),
        intervals=list(problem.intervals),
        health=problem.health,
        warnings=said,
    )


def beyond_gate(problem: Problem, nis: dict[str, Floats]) -> dict[str, np.ndarray]:
    """Which rows lie beyond the gate, by sensor."""
    return {rows.sensor: nis[rows.sensor] > chi_square_point(GATE, rows.dof) for rows in problem.rows}


def ungated(beyond: dict[str, np.ndarray]) -> list[str]:
    """Say for a filter without gates where a gate would have spoken far more often than by chance."""
    return [
        f"{sensor}: {np.mean(rows):.0%} of its samples contradict the estimate (beyond the {GATE:.1%} gate of other "
        "estimators); this filter has no gate and took them all"
        for sensor, rows in beyond.items()
        if np.mean(rows) > CONTRADICTING
    ]


def calibrations(problem: Problem, c: Floats, sd: Floats) -> dict[str, Calibrated]:
    """Parameters under their public names: vectors together, units in the name. A clock that this estimator has not
    estimated (sd 0) is the one that ``prepare`` found."""
    parameters = problem.parameters
    free, prior_sd = set(parameters.free), parameters.sd
    found: dict[str, Calibrated] = dict(problem.calibration)
    for k, name in enumerate(parameters.names):
        sensor, _, what = name.rpartition(".")
        if what not in PUBLIC:
            continue
        count, public, unit = PUBLIC[what]
        part, value = slice(k, k + count), c[k : k + count]
        if what in CLOCK:
            if sd[k] == 0.0 and f"{sensor}_{public}" in found:
                continue
            clock, told = problem.clocks[sensor], problem.rig.sensors[sensor].clock_drift
            value = value + (clock.offset_s if what == "clock_offset" else clock.drift + told)
        elif what == "iron_x":
            value = value + problem.rig.sensors[sensor].hard_iron_ut
        estimated = k in free
        observed = diagnosis.observed(sd[part], prior_sd[part]) if estimated else None
        found[f"{sensor}_{public}"] = Calibrated(
            _shaped(unit * value), _shaped(unit * sd[part]), estimated, None if observed is None else _shaped(observed)
        )
    return found


def as_found(rig: Rig, calibration: Mapping[str, Calibrated]) -> Rig:
    """``rig`` with its LiDARs mounted as a result's ``calibration`` found them, as :func:`tbmfg.sensors.lidar` has it:
    in b at the place found, their axes R_bl Exp(d) by the turn found."""
    sensors = dict(rig.sensors)
    for name, sensor in rig.of_kind("lidar").items():
        place, turn = (calibration.get(f"{name}_{PUBLIC[what][1]}") for what in ("mount_x", "turn_x"))
        found: dict[str, tuple[float, ...]] = {}
        if place is not None and place.estimated:
            found["xyz_m"] = tuple(place.value)
        if turn is not None and turn.estimated:
            R_bl = sensor.T_bl.R @ exp_so3(np.array(turn.value) / DEG)
            found["rpy_deg"] = tuple((rpy_from_rotation(R_bl) * DEG).tolist())
        sensors[name] = sensor.model_copy(update={"T_bl": sensor.T_bl.model_copy(update=found)})
    return rig.model_copy(update={"sensors": sensors})


def _shaped(values: np.ndarray) -> Any:
    """A number where there is one, else a tuple."""
    plain = values.tolist()
    return plain[0] if len(plain) == 1 else tuple(plain)


def _drifts(problem: Problem, x: Floats, cov: Floats) -> dict[str, Calibrated]:
    """Drifting calibrations at the last keyframe, where their prior has walked for as long as the log."""
    last = np.sqrt(np.diag(cov[-1])[NAV:])
    walked = problem.drift_walk**2 * (problem.keyframes_s[-1] - problem.keyframes_s[0])
    seen = diagnosis.observed(last, np.sqrt(np.diag(problem.prior.cov)[NAV:] + walked))
    return {
        f"{name.replace('.', '_')}_m": Calibrated(x[-1, 21 + k], last[k], True, bool(seen[k]))
        for k, name in enumerate(problem.drift_names)
    }


def _counts(problem: Problem, gated: dict[str, np.ndarray]) -> dict[str, Counts]:
    """Complete the counts: rows hold their samples, what is left over has not been used."""
    counts = {name: copy(count) for name, count in problem.counts.items()}
    for rows in problem.rows:
        if rows.sensor in counts:
            count = counts[rows.sensor]
            count.gated = int(rows.samples[gated[rows.sensor]].sum())
            count.used = int(rows.samples.sum()) - count.gated
    return _completed(counts)


def _completed(counts: dict[str, Counts]) -> dict[str, Counts]:
    """With what is in no other part as unused."""
    return {
        name: replace(count, unused=count.unused + count.received - count.parts()) for name, count in counts.items()
    }
