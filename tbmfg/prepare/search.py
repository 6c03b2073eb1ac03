"""Clocks and the noise of the IMU on this machine, found from the log itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tbmfg.diagnosis import observed
from tbmfg.filters import ins
from tbmfg.inertial import alignment
from tbmfg.inertial.noise import spectral_floor
from tbmfg.measure import Clock
from tbmfg.prepare import noise
from tbmfg.prepare.build import build, clock_of
from tbmfg.prepare.start import Setup
from tbmfg.problem import CLOCK, Problem
from tbmfg.smoother import batch
from tbmfg.state import Calibrated
from tbmfg.timeseries import Floats

TURNS = 3  # of finding the noise of the IMU beside that of the others, which are known the better for it
REACH_SD = 3.0  # sds of its prior within which a clock is looked for
SEARCH_S = 300.0  # offset and noise factor are found on at most this much of a log, a drift on all of it
FACTOR_RANGE = (1.0, 1e3)  # a data sheet is the best that a unit does; beyond the upper end it is not the unit
SCALE_PRIOR_LOG2 = 0.7  # sd of log2 of the noise against the spectrum's floor, for logs that hardly say


def find(setup: Setup, clocks: dict[str, Clock], tell: Callable[[str, float], None]) -> Problem:
    """Clocks and noise factors from the log, alternating, then the problem at what was found.

    A constant's last estimate by a filter holds all that the log says about it, so the clocks are states of ``ins``;
    keyframes move with them until they stand. Noise: the IMU's own spectrum says how much noisier than the data
    sheet gyro and accelerometer can be at most; one scale on both minimises the filter's likelihood cost.
    """
    imu = setup.rig.imu
    auto = imu.noise_factor == "auto"
    floors = spectral_floor(setup.steps) if auto else (imu.gyro_density, imu.acc_density)
    split = np.clip([floors[0] / imu.gyro_density, floors[1] / imu.acc_density], *FACTOR_RANGE)
    scale, sd = (1.0 if auto else float(imu.noise_factor)), 0.0
    prior_sd = {name: setup.parameters.sd[clock_of(setup.parameters, name)] for name in clocks}
    unknown = [name for name in clocks if prior_sd[name].any()]
    for name in unknown:
        if prior_sd[name][0] > 0:
            clocks[name] = Clock(_coarse_offset(setup, name))
    noisy = [name for name in setup.samples if setup.rig.sensors[name].noise_factor == "auto"]
    found: dict[str, Calibrated] = {}
    for turn in range(TURNS if auto and noisy else 2 if auto and unknown else 1):
        if unknown:
            clock_sd = _settle(setup, clocks, scale * split, unknown)
        if auto:
            scale, sd = _noise_scale(setup, clocks, split, scale)
        if noisy:
            beside = noise.factors(build(setup, clocks, scale * split, SEARCH_S), noisy)
            found = {name: _times(found.get(name), factor) for name, factor in beside.items()}
            _rescale(setup, {name: factor.value for name, factor in beside.items()})
        tell("prepare", 0.5 + 0.25 * turn / 2)
    factors = np.maximum(scale * split, 1.0) if auto else scale * split
    if unknown:
        clock_sd = _smooth(setup, clocks, factors, unknown)
    drifting = [name for name in unknown if prior_sd[name][1] > 0]
    if drifting and setup.steps.end_s > SEARCH_S:
        clock_sd |= _settle(setup, clocks, factors, drifting, setup.steps.end_s, turns=2)
    problem = build(setup, clocks, factors)
    named = {"noise_factor_gyro": factors[0], "noise_factor_acc": factors[1], "noise_factor": np.sqrt(np.prod(factors))}
    for key, value in named.items():
        problem.calibration[key] = Calibrated(float(value), float(value * sd / scale), auto)
    problem.calibration |= {f"{name}_noise_factor": factor for name, factor in found.items()}
    for name in unknown:
        told = setup.rig.sensors[name].clock_drift
        parts = ("clock_offset_s", clocks[name].offset_s, 1.0), ("clock_drift_ppm", clocks[name].drift + told, 1e6)
        for (key, value, factor), own, prior in zip(parts, clock_sd[name], prior_sd[name], strict=True):
            if prior > 0:
                seen = bool(observed(own, prior))
                problem.calibration[f"{name}_{key}"] = Calibrated(factor * value, factor * float(own), True, seen)
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


def _settle(
    setup: Setup, clocks: dict[str, Clock], factors: Floats, unknown: list[str], end_s: float = SEARCH_S, turns: int = 4
) -> dict[str, Floats]:
    """Move the keyframes with the clocks that ``ins`` estimates up to ``end_s`` until they stand, in place; the sds of
    offset [s] and drift, (2,) by sensor.

    The filter takes the present clock for the prior's mean. Where that lies ``mu`` from it, the estimate moves by
    covariance x prior information x mu: nothing where the log tells the clock, back to the prior where it does not.
    """
    parameters, span = setup.parameters, min(end_s, setup.steps.end_s)
    sds = {}
    for _ in range(turns):
        filtered = ins.run(build(setup, clocks, factors, end_s))
        moved = 0.0
        for name in unknown:
            own = clock_of(parameters, name)
            mean, sd = parameters.mean[own], parameters.sd[own]
            now = np.array([clocks[name].offset_s, clocks[name].drift])
            cov = filtered.c_cov[own, own]
            information = np.divide(1.0, sd**2, out=np.zeros(2), where=sd > 0)
            found = now + filtered.c[own] + cov @ (information * (mean - now))
            found = np.clip(found, mean - REACH_SD * sd, mean + REACH_SD * sd)
            clocks[name], sds[name] = Clock(*found.tolist()), np.sqrt(np.diag(cov))
            change = found - now
            moved = max(moved, abs(change[0]), abs(change[0] + change[1] * span))
        if moved < 1e-4:
            break
    for name in unknown:
        _say_if_held(setup, name, clocks[name])
    return sds


def _say_if_held(setup: Setup, name: str, clock: Clock) -> None:
    """Say where a clock ran to the end of its prior."""
    own = clock_of(setup.parameters, name)
    mean, sd = setup.parameters.mean[own], setup.parameters.sd[own]
    told = (("offset", clock.offset_s, "s", 1.0), ("drift", clock.drift, "ppm", 1e6))
    for k, (what, value, unit, factor) in enumerate(told):
        if sd[k] > 0 and abs(value - mean[k]) > 0.999 * REACH_SD * sd[k]:
            line = (
                f"{name}: the clock {what} ran to {REACH_SD:.0f} sd of its prior, {factor * value:.3f} {unit}, and is "
                f"held there; check sensors.{name}.clock_{what}_{unit} and its sd, the lever arm and the sensor's sigma"
            )
            if line not in setup.warnings:
                setup.warnings.append(line)


def _smooth(setup: Setup, clocks: dict[str, Clock], factors: Floats, unknown: list[str]) -> dict[str, Floats]:
    """Move the keyframes to the clocks that the smoother finds, in place; their sds as in ``_settle``.

    A filter linearises once, and its offset errs by what its first states erred. Online solvers hold the clock: only
    at the smoother's do they end where ``batch`` does.
    """
    problem = build(setup, clocks, factors, SEARCH_S)
    filtered = ins.run(problem)
    smoothed = batch.solve(problem, filtered.x, filtered.c)
    sds = {}
    for name in unknown:
        own = clock_of(problem.parameters, name)
        offset_s, drift = smoothed.c[own].tolist()
        clocks[name] = Clock(clocks[name].offset_s + offset_s, clocks[name].drift + drift)
        sds[name] = np.sqrt(np.diag(smoothed.c_cov[own, own]))
    return sds


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


def _noise_scale(setup: Setup, clocks: dict[str, Clock], split: Floats, start: float) -> tuple[float, float]:
    """Scale on ``split`` that minimises the cost of ``ins`` (-2 log likelihood), and its sd from the curvature in
    the logarithm; a weak prior draws it to what the spectrum says."""
    costs: dict[float, float] = {}

    def cost(log2: float) -> float:
        if log2 not in costs:
            problem = build(setup, clocks, 2.0**log2 * split, SEARCH_S)
            costs[log2] = ins.run(problem, fixed=CLOCK).cost + (log2 / SCALE_PRIOR_LOG2) ** 2
        return costs[log2]

    step, best = 0.5, round(2.0 * np.log2(start)) / 2.0
    while (lower := min((best - step, best + step), key=cost)) is not None and cost(lower) < cost(best):
        best = lower
    a, b, c = (cost(best + k) for k in (-step, 0.0, step))
    curvature = (a - 2.0 * b + c) / step**2
    vertex = best + 0.5 * step * (a - c) / (a - 2.0 * b + c)
    scale = 2.0**vertex
    return float(scale), float(scale * np.sqrt(2.0 / curvature) * np.log(2.0))
