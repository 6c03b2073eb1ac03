"""From a log and a rig to the problem that every estimator solves: once per log, alike for all.

Time repair, initial alignment, keyframes and rows; and, where the rig asks for it, inertial enhancement, and clock
offsets and drifts and the noise factor of the IMU, found from the log itself.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tbmfg import gnss
from tbmfg.errors import EstimationError, RigError
from tbmfg.inertial.steps import to_ns
from tbmfg.measure import Clock
from tbmfg.prepare import enhance, magnetic, scans, search, stream
from tbmfg.prepare.samples import ALONE, imu_steps, is_position, usable_samples
from tbmfg.prepare.start import align, parameters_of
from tbmfg.problem import Problem, breakdown_explained
from tbmfg.rig import Rig
from tbmfg.state import Interval
from tbmfg.timeseries import Log


def prepare(
    log: Log,
    rig: Rig,
    *,
    outages: tuple[tuple[str, float, float], ...] = (),
    without: tuple[str, ...] = (),
    progress: Callable[[str, float], None] | None = None,
) -> Problem:
    """Everything an estimator needs.

    ``outages`` are (sensor, start, end) in s from the first IMU sample, stamps as recorded; ``without`` names sensors
    to leave aside. Raises LogError without IMU samples, RigError for names that the rig does not have.
    """
    tell = progress or (lambda stage, share: None)
    tell("prepare", 0.0)
    for name in [sensor for sensor, _, _ in outages] + list(without):
        if name not in rig.sensors:
            raise RigError(f"no sensor {name!r} in rig {rig.name!r}; it has {', '.join(rig.sensors)}")
    log, rig, said = gnss.into_n(log, rig)
    warnings: list[str] = [*log.damage, *said]
    measured, imu_counts = imu_steps(log, rig, outages, warnings)
    silent, gaps = stream.gaps(log, rig, without, outages, measured.t0_ns)
    warnings += [*stream.losses(log, rig, without, measured.t0_ns), *gaps]
    steps = enhance.denoised(rig, measured, warnings)
    missing: list[str] = []
    samples, counts = usable_samples(log, rig, steps, outages, without, missing)
    lidars = scans.present(log, rig, without)
    if not samples and not lidars and rig.motion is None:
        raise EstimationError("; ".join([f"{log.path}: {ALONE}", *missing]))
    warnings += missing
    counts = {"imu": imu_counts, **counts}
    with breakdown_explained("preparing the estimate"):
        setup = align(rig, steps, samples, counts, warnings)
        told = enhance.levelled(setup)
        for name in lidars:
            scans.register(log, name, setup, outages, lambda share: tell("LiDAR odometry", share))
        setup.parameters = parameters_of(rig, setup.samples, setup.frame, setup.R_start)
        delays = magnetic.onto_gyro_clock(setup)
        clocks = {name: Clock(rig.sensors[name].clock_offset) for name in samples if is_position(rig, name)}
        problem = search.find(setup, clocks, tell)
        problem.calibration |= told | delays | setup.calibration
        problem.measured, problem.scans, problem.health = measured, setup.scans, setup.health
    problem.intervals = [
        *setup.intervals,
        *silent,
        *(Interval("imu", "gap", *(int(t) for t in to_ns(steps, np.array(gap)))) for gap in steps.gaps),
        *(Interval(name, "outage", *(int(t) for t in to_ns(steps, np.array([a, b])))) for name, a, b in outages),
        *(
            Interval("zero_velocity", "standing", *(int(t) for t in to_ns(steps, np.array(s))))
            for s in setup.standing.intervals
        ),
    ]
    tell("prepare", 1.0)
    return problem
