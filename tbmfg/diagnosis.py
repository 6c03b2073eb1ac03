"""What limits a result, in words: which calibration, heading or sensor, from when to when, and why."""

from __future__ import annotations

import numpy as np

from tbmfg.problem import Problem
from tbmfg.state import ROT, Innovations, Interval, Trajectory
from tbmfg.timeseries import Floats

UNOBSERVED = 0.9  # posterior over prior sd from which a calibration counts as not observed
VAGUE_HEADING = np.deg2rad(10.0)
STRETCH = 3  # gated rows in a row from which a stretch of them is worth naming


def unobserved(problem: Problem, path: Trajectory, sd: Floats) -> list[str]:
    """Calibrations that the log says nothing of, ``sd`` (m,) being their posterior, and the motion that was missing."""
    parameters = problem.parameters
    lines = []
    for k in parameters.free:
        if sd[k] > UNOBSERVED * parameters.sd[k]:
            what = parameters.names[k].rpartition(".")[2]
            lines.append(
                f"{parameters.names[k]} is not observable on this log: its sd stays {sd[k]:.3g} of the prior's "
                f"{parameters.sd[k]:.3g}; {_motion(path, what)}"
            )
    return lines


def _motion(path: Trajectory, what: str) -> str:
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
    if what == "clock_offset":
        return f"an offset shows in changes of speed, and the machine was never faster than {speed.max():.2g} m/s"
    way = float(np.sum(np.linalg.norm(np.diff(path.position_n, axis=0), axis=1)))
    return (
        f"it shows in distances between known places or headings, and the machine went {way:.1f} m in {seconds:.0f} s"
    )


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


def gated_in_words(stretches: list[Interval], origin_ns: int) -> list[str]:
    """One line per sensor: how many stretches were gated, and the longest."""
    lines = []
    for sensor in dict.fromkeys(stretch.sensor for stretch in stretches):
        own = [s for s in stretches if s.sensor == sensor]
        longest = max(own, key=lambda s: s.end_ns - s.start_ns)
        start, end = (longest.start_ns - origin_ns) * 1e-9, (longest.end_ns - origin_ns) * 1e-9
        lines.append(
            f"{sensor}: gated for {STRETCH} or more rows on end {len(own)} times, the longest {start:.1f}-{end:.1f} s; "
            "what it says there contradicts the rest"
        )
    return lines
