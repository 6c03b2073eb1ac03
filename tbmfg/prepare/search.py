"""Clock offsets and the noise of the IMU on this machine, found from the log itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tbmfg.diagnosis import observed
from tbmfg.filters import ins
from tbmfg.inertial import alignment
from tbmfg.inertial.noise import spectral_floor
from tbmfg.prepare import noise
from tbmfg.prepare.build import build
from tbmfg.prepare.start import Setup
from tbmfg.problem import Problem
from tbmfg.smoother import batch
from tbmfg.state import Calibrated
from tbmfg.timeseries import Floats

TURNS = 3  # of finding the noise of the IMU beside that of the others, which are known the better for it
REACH_SD = 3.0  # sds of its prior within which a clock offset is looked for
SEARCH_S = 300.0  # offset and noise factor are found on at most this much of a log
FACTOR_RANGE = (1.0, 1e3)  # a data sheet is the best that a unit does; beyond the upper end it is not the unit
SCALE_PRIOR_LOG2 = 0.7  # sd of log2 of the noise against the spectrum's floor, for logs that hardly say


def find(setup: Setup, offsets: dict[str, float], tell: Callable[[str, float], None]) -> Problem:
    """Clock offsets and noise factors from the log, alternating, then the problem at what was found.

    A constant's last estimate by a filter holds all that the log says about it, so the offsets are states of ``ins``;
    keyframes move with them until they stand. Noise: the IMU's own spectrum says how much noisier than the data
    sheet gyro and accelerometer can be at most; one scale on both minimises the filter's likelihood cost.
    """
    imu = setup.rig.imu
    auto = imu.noise_factor == "auto"
    floors = spectral_floor(setup.steps) if auto else (imu.gyro_density, imu.acc_density)
    split = np.clip([floors[0] / imu.gyro_density, floors[1] / imu.acc_density], *FACTOR_RANGE)
    scale, sd = (1.0 if auto else float(imu.noise_factor)), 0.0
    names = setup.parameters.names
    unknown = [n for n in offsets if setup.parameters.sd[names.index(f"{n}.clock_offset")] > 0]
    prior_sd = {name: setup.parameters.sd[names.index(f"{name}.clock_offset")] for name in unknown}
    for name in unknown:
        offsets[name] = _coarse_offset(setup, name)
    noisy = [name for name in setup.samples if setup.rig.sensors[name].noise_factor == "auto"]
    found: dict[str, Calibrated] = {}
    for turn in range(TURNS if auto and noisy else 2 if auto and unknown else 1):
        if unknown:
            offset_sd = _settle_offsets(setup, offsets, scale * split, unknown)
        if auto:
            scale, sd = _noise_scale(setup, offsets, split, scale)
        if noisy:
            beside = noise.factors(build(setup, offsets, scale * split, SEARCH_S), noisy)
            found = {name: _times(found.get(name), factor) for name, factor in beside.items()}
            _rescale(setup, {name: factor.value for name, factor in beside.items()})
        tell("prepare", 0.5 + 0.25 * turn / 2)
    factors = np.maximum(scale * split, 1.0) if auto else scale * split
    if unknown:
        offset_sd = _smooth_offsets(setup, offsets, factors, unknown)
    problem = build(setup, offsets, factors)
    named = {"noise_factor_gyro": factors[0], "noise_factor_acc": factors[1], "noise_factor": np.sqrt(np.prod(factors))}
    for key, value in named.items():
        problem.calibration[key] = Calibrated(float(value), float(value * sd / scale), auto)
    problem.calibration |= {f"{name}_noise_factor": factor for name, factor in found.items()}
    for name in unknown:
        problem.calibration[f"{name}_clock_offset_s"] = Calibrated(
            offsets[name], offset_sd[name], True, bool(observed(offset_sd[name], prior_sd[name]))
        )
    return problem


def _times(before: Calibrated | None, factor: Calibrated) -> Calibrated:
    """``factor``, found on top of the one before."""
    times = 1.0 if before is None else before.value
    return Calibrated(times * factor.value, times * factor.sd, True)


def _rescale(setup: Setup, factors: dict[str, float]) -> None:
    """Multiply the noise of sensors, in their entries in the rig and in their samples, in place."""
    sensors = dict(setup.rig.sensors)
    for name, factor in factors.items():
        sensors[name] = sensors[name].model_copy(update={"noise_factor": factor * sensors[name].times})
        s = setup.samples[name]
        setup.samples[name] = s if s.sigma is None else replace(s, sigma=factor * s.sigma)
    setup.rig = setup.rig.model_copy(update={"sensors": sensors})


def _settle_offsets(setup: Setup, offsets: dict[str, float], factors: Floats, unknown: list[str]) -> dict[str, float]:
    """Move the keyframes with the offsets that ``ins`` estimates until they stand, in place; their sds in s.

    The filter takes the present offset for the prior's mean. Where that lies ``mu`` from it, the estimate moves by
    variance / prior variance x mu: nothing where the log tells the offset, back to the prior where it does not.
    """
    parameters = setup.parameters
    where = {name: parameters.names.index(f"{name}.clock_offset") for name in unknown}
    for _ in range(4):
        filtered = ins.run(build(setup, offsets, factors, SEARCH_S))
        moved = 0.0
        for name, k in where.items():
            mean, sd, now = parameters.mean[k], parameters.sd[k], offsets[name]
            step = filtered.c[k] + filtered.c_cov[k, k] / sd**2 * (mean - now)
            offsets[name] = float(np.clip(now + step, mean - REACH_SD * sd, mean + REACH_SD * sd))
            moved = max(moved, abs(offsets[name] - now))
        if moved < 1e-4:
            break
    for name, k in where.items():
        if abs(offsets[name] - parameters.mean[k]) > 0.999 * REACH_SD * parameters.sd[k]:
            line = (
                f"{name}: the clock offset ran to {REACH_SD:.0f} sd of its prior, {offsets[name]:.3f} s, and is held "
                f"there; check sensors.{name}.clock_offset_s and its sd, the lever arm and the sensor's sigma"
            )
            if line not in setup.warnings:
                setup.warnings.append(line)
    return {name: float(np.sqrt(filtered.c_cov[k, k])) for name, k in where.items()}


def _smooth_offsets(setup: Setup, offsets: dict[str, float], factors: Floats, unknown: list[str]) -> dict[str, float]:
    """Move the keyframes to the offsets that the smoother finds, in place; their sds in s.

    A filter linearises once, and its offset errs by what its first states erred. Online solvers hold the offset: only
    at the smoother's do they end where ``batch`` does.
    """
    problem = build(setup, offsets, factors, SEARCH_S)
    filtered = ins.run(problem)
    smoothed = batch.solve(problem, filtered.x, filtered.c)
    where = {name: problem.parameters.names.index(f"{name}.clock_offset") for name in unknown}
    for name, k in where.items():
        offsets[name] += float(smoothed.c[k])
    return {name: float(np.sqrt(smoothed.c_cov[k, k])) for name, k in where.items()}


def _coarse_offset(setup: Setup, name: str) -> float:
    """Clock offset by fitting the sensor's motion to the inertial one over three sd of the prior."""
    sensor, s = setup.rig.sensors[name], setup.samples[name]
    spread = REACH_SD * sensor.clock_offset_sd
    grid = sensor.clock_offset + np.linspace(-spread, spread, 2 * max(2, int(np.ceil(spread / 0.02))) + 1)
    R_level = setup.R_start
    fit = alignment.fit_motion(setup.steps, setup.bias_gyro, R_level, s.t_s, s.values, grid, setup.rig.origin.gravity)
    if fit is None:
        setup.warnings.append(
            f"{name}: clock offset not observable: the machine hardly moved; it stays at the rig's value"
        )
        return sensor.clock_offset
    return fit.clock_offset_s


def _noise_scale(setup: Setup, offsets: dict[str, float], split: Floats, start: float) -> tuple[float, float]:
    """Scale on ``split`` that minimises the cost of ``ins`` (-2 log likelihood), and its sd from the curvature in
    the logarithm; a weak prior draws it to what the spectrum says."""
    costs: dict[float, float] = {}

    def cost(log2: float) -> float:
        if log2 not in costs:
            problem = build(setup, offsets, 2.0**log2 * split, SEARCH_S)
            costs[log2] = ins.run(problem, fixed=("clock_offset",)).cost + (log2 / SCALE_PRIOR_LOG2) ** 2
        return costs[log2]

    step, best = 0.5, round(2.0 * np.log2(start)) / 2.0
    while (lower := min((best - step, best + step), key=cost)) is not None and cost(lower) < cost(best):
        best = lower
    a, b, c = (cost(best + k) for k in (-step, 0.0, step))
    curvature = (a - 2.0 * b + c) / step**2
    vertex = best + 0.5 * step * (a - c) / (a - 2.0 * b + c)
    scale = 2.0**vertex
    return float(scale), float(scale * np.sqrt(2.0 / curvature) * np.log(2.0))
