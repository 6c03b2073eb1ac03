"""What limits a result, in words: which calibration, heading or sensor, from when to when, and why."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from tbmfg.chance import chi_square_beyond, poisson_at_least
from tbmfg.geometry import log_so3
from tbmfg.problem import CLOCK, GATE, Problem
from tbmfg.rig import kind_of
from tbmfg.state import ROT, Innovations, Interval, Trajectory
from tbmfg.timeseries import Floats

UNOBSERVED = 0.9  # posterior over prior sd from which a calibration counts as not observed
VAGUE_HEADING = np.deg2rad(10.0)
STRETCH = 3  # gated rows in a row from which a stretch of them is worth naming
CHANCE = 1e-3  # with which rows that are as good as the rig says would look as bad


def observed(sd: Floats, prior_sd: Floats) -> np.ndarray:
    """Whether the log told calibrations more than their priors did, (m,) bool."""
    return sd <= UNOBSERVED * prior_sd


def unobserved(problem: Problem, path: Trajectory, sd: Floats) -> list[str]:
    """Calibrations that the log says nothing of, ``sd`` (m,) being their posterior, and the motion that was missing."""
    parameters = problem.parameters
    lines = []
    for k in parameters.free:
        sensor, _, what = parameters.names[k].rpartition(".")
        if what == "clock_drift" and sd[k] * problem.keyframes_s[-1] <= sd[k - 1]:
            continue  # it moves no stamp by more than the offset's own sd
        if kind_of(sensor) == "barometer":
            lines += _depth(problem, path, sensor, what, float(sd[k]))
        elif not observed(sd[k], parameters.sd[k]):
            lines.append(
                f"{parameters.names[k]} is not observable on this log: its sd stays "
                f"{sd[k] / parameters.sd[k]:.0%} of the prior's; {motion(path, what)}"
            )
    return lines


def _depth(problem: Problem, path: Trajectory, sensor: str, what: str, sd: float) -> list[str]:
    """Say where the air's temperature, a barometer's ``scale``, or its ``lapse`` with height costs more than the
    barometer's noise."""
    way = float(np.ptp(path.position_n[:, 2]))
    between = f"over the {way:.3g} m between highest and lowest"
    if what == "lapse":
        bulge = sd * way**2 / 8 / 288.15  # of a parabola through both ends
        line = f"how the air cools with height: to {1e3 * sd:.2g} K/km (1 sd), {bulge:.2g} m halfway {between}"
        remedy = "a point surveyed halfway"
    else:
        bulge = sd * way
        line = f"the air's temperature: its scale is known to {sd:.2%} (1 sd), {bulge:.2g} m {between}"
        remedy = "a point surveyed at another height"
    if bulge < problem.rig.sensors[sensor].sigma:
        return []
    return [f"{sensor}: depth is limited by {line}; {remedy}, gnss or a prism would tell it"]


def motion(path: Trajectory, what: str) -> str:
    """The motion that shows a calibration, as far as the machine made it."""
    R = path.rotations()
    seconds = (path.t_ns[-1] - path.t_ns[0]) * 1e-9
    if what.startswith("arm"):
        yaw = np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
        tilt = np.arccos(np.clip(R[:, 2] @ R[0, 2], -1.0, 1.0))
        return (
            f"an arm shows across the axes that the machine turns about, and in {seconds:.0f} s it turned by "
            f"{np.rad2deg(np.ptp(yaw)):.1f} deg about the vertical and by {np.rad2deg(tilt.max()):.1f} deg in tilt"
        )
    speed = np.linalg.norm(path.velocity_n, axis=1)
    if what in CLOCK:
        return f"an offset shows in changes of speed, and the machine was never faster than {speed.max():.2g} m/s"
    turned = np.rad2deg(np.linalg.norm(log_so3(R[0].T @ R), axis=1).max())
    way = float(np.sum(np.linalg.norm(np.diff(path.position_n, axis=0), axis=1)))
    went, turns = f"it went {way:.1f} m in {seconds:.0f} s", f"it turned by {turned:.1f} deg at most"
    kind = what.partition("_")[0]
    return ADVICE.get(kind, "it shows in motion that the machine did not make; {went}, {turns}").format(
        went=went, turns=turns
    )


# By kind of calibration: what would have shown it, and what the machine did.
ADVICE = {
    "scale": "it shows in distances between places that another sensor knows, and {went}",
    "yaw": "the wheel's direction shows in the course between fixes, and {went}",
    "pitch": "the wheel's direction shows in the course between fixes, and {went}",
    "declination": "it shows against a heading from elsewhere: a course under fixes, initial.yaw_deg or gyrocompassing "
    "at rest; {went}",
    "iron": "the machine's own field turns with it, the Earth's does not: turn it about all axes, full circles first; "
    "{turns}",
    "strength": "turning tells the Earth's field from the machine's own: about all axes, full circles first; {turns}",
    "mount": "the LiDAR's place shows where the machine turns, about two axes at least; {turns}",
    "turn": "the LiDAR's axes show in turns about two axes at least, one leaves the angle about itself open; {turns}",
    "tilt": "the line's tilt shows in how the spot moves over a long way along the line while the position is known "
    "otherwise; {went}",
    "offset": "the spot's zero turns with the machine, the line does not: it shows in turns about the line; {turns}",
}


def vague_heading(path: Trajectory) -> list[str]:
    """Say from when to when the heading is not known, and what would help."""
    R = path.rotations()
    up_b = R[:, 2, :]
    sd = np.sqrt(np.einsum("ki,kij,kj->k", up_b, path.cov[:, ROT, ROT], up_b))
    vague = sd > VAGUE_HEADING
    if not vague.any():
        return []
    t = (path.t_ns - path.t_ns[0]) * 1e-9
    span = t[vague]
    return [
        f"heading is known to {np.rad2deg(sd[vague].max()):.0f} deg only, {span[0]:.0f}-{span[-1]:.0f} s "
        f"({vague.mean():.0%} of the keyframes); a magnetometer, initial.yaw_deg with its sd, or curved motion seen by "
        "the prism would fix it"
    ]


def gated_stretches(innovations: dict[str, Innovations]) -> list[Interval]:
    """Times in which a sensor's rows lay beyond the gate one after the other."""
    found = []
    for sensor, series in innovations.items():
        edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(series.gated, dtype=int), [0]])))
        for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
            if last - first + 1 >= STRETCH:
                found.append(Interval(sensor, "gated", int(series.t_ns[first]), int(series.t_ns[last])))
    return found


def gated_in_words(innovations: dict[str, Innovations], stretches: list[Interval], origin_ns: int) -> list[str]:
    """One line per sensor of which more rows are gated, or one lies farther off, than chance explains: how many, when,
    how far, and the stretches among them."""
    lines = []
    for sensor, series in innovations.items():
        gated, nis, t = series.gated, np.nan_to_num(series.nis), (series.t_ns - origin_ns) * 1e-9
        expected = (1.0 - GATE) * len(gated)
        rare = poisson_at_least(gated.sum(), expected) < CHANCE
        if not gated.any() or not (rare or len(nis) * chi_square_beyond(nis[gated].max(), series.dof) < CHANCE):
            continue
        farthest = np.flatnonzero(gated)[np.argmax(nis[gated])]
        line = (
            f"{sensor}: {gated.sum()} of {len(gated)} rows gated, where chance gates {expected:.2g}: the first at "
            f"{t[np.argmax(gated)]:.1f} s, the farthest off by {np.sqrt(nis[farthest]):.2g} sd at {t[farthest]:.1f} s"
        )
        own = [s for s in stretches if s.sensor == sensor]
        if own:
            longest = max(own, key=lambda s: s.end_ns - s.start_ns)
            start, end = (longest.start_ns - origin_ns) * 1e-9, (longest.end_ns - origin_ns) * 1e-9
            which = "from" if len(own) == 1 else f"{len(own)} times, the longest from"
            line += f"; {STRETCH} or more on end {which} {start:.1f} to {end:.1f} s"
        lines.append(f"{line}; what it says there contradicts the rest")
    return lines


def gated_together(stretches: list[Interval], origin_ns: int) -> list[str]:
    """Say when several sensors are gated at once: what each of them is held against is the IMU."""
    edges = sorted({t for s in stretches for t in (s.start_ns, s.end_ns)})
    spans: list[tuple[int, int, set[str]]] = []
    for start, end in pairwise(edges):
        sensors = {s.sensor for s in stretches if s.start_ns <= start and s.end_ns >= end}
        if len(sensors) < 2:
            continue
        if spans and spans[-1][1] == start:
            spans[-1] = (spans[-1][0], end, spans[-1][2] | sensors)
        else:
            spans.append((start, end, sensors))
    if not spans:
        return []
    start, end, sensors = max(spans, key=lambda one: one[1] - one[0])
    which = "from" if len(spans) == 1 else f"{len(spans)} times, the longest from"
    return [
        f"imu: {' and '.join(sorted(sensors))} are gated together {which} {(start - origin_ns) * 1e-9:.1f} to "
        f"{(end - origin_ns) * 1e-9:.1f} s: what they contradict there is the IMU; "
        "look at its bias, its clock and its mounting"
    ]
