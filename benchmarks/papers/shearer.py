"""Yan & Wang (2021): SINS, SINS/OD and SINS/OD/MAG on a broken-line cut, and a magnetic disturbance.

Their Table 2 and magnetic test on simulated cuts, with what the paper leaves open: the initial errors are those of the
rig, not theirs, and decide how far pure inertial navigation drifts (scenario ``aligned``: a tenth of them). A
scale error of the odometer, 1 % of 80 m here, limits every method, for nothing measures distance (``scale ..``).

The adaptive federated filter was compared to a centralised one with fixed noise, which confounds two ingredients; here
every combination runs on the same disturbed logs (section 4.3). ``adaptive share`` is the part of what separates the
adaptive federated filter from the centralised one that adaptive noise alone gives the latter.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers import Plan
from benchmarks.papers.trials import Method, Metrics, Outcomes, Trial, confidence
from benchmarks.rows import Row

if TYPE_CHECKING:
    from datasets.simulate import Simulation
    from tbmfg.rig import Rig
    from tbmfg.state import Result, Truth

SINS, OD, MAG, AR, AFKF = "shearer-sins", "shearer-sins-od", "shearer-ckf", "shearer-ckf-ar", "shearer-afkf"
LADDER = (SINS, OD, MAG)
ONLINE = Method("fixed-lag", "fixed-lag", every=5)  # it takes as long as all others together
ALL = (*(Method(name, name) for name in (*LADDER, AR, AFKF, "ins", "batch")), ONLINE)
FEW = tuple(Method(name, name) for name in (*LADDER, "batch"))


def _switched(**switches: str) -> Method:
    """The federated filter with other switches."""
    label = ",".join(f"{key}={value}" for key, value in switches.items())
    return Method(f"afkf {label}", AFKF, tuple(f"estimators.{AFKF}.{key}={value}" for key, value in switches.items()))


ABLATION = (
    *(Method(name, name) for name in (OD, MAG, AR, AFKF)),
    _switched(r_adapt="off"),
    _switched(r_adapt="off", beta="printed"),
    _switched(beta="printed"),
    _switched(r_adapt="printed", beta="printed", share_q="false", mag_jacobian="yaw_only"),
    Method("ins", "ins"),
    Method("batch", "batch"),
)
SCALES = {"0.2 %": 0.002, "0 %": 0.0}
ALIGNED = (
    "initial.tilt_sd_deg=0.05",
    "initial.yaw_sd_deg=0.1",
    "sensors.imu.gyro_bias_sd_dps=0.002",
    "sensors.imu.acc_bias_sd_mps2=0.0004",
)
FAULTS = ("offset", "field", "spikes")

# Table 2, maximum error in m, and the magnetic test of section 5.2; its north values are misprinted (H19)
TABLE_2 = {
    (SINS, "max_east"): 3.9664, (OD, "max_east"): 0.9012, (MAG, "max_east"): 0.2195,
    (SINS, "max_north"): 6.2906, (OD, "max_north"): 1.2491, (MAG, "max_north"): 0.3246,
}  # fmt: skip
REDUCTIONS = {
    (OD, SINS, "max_east"): 77.28, (MAG, SINS, "max_east"): 94.47, (MAG, OD, "max_east"): 75.64,
    (OD, SINS, "max_north"): 80.14, (MAG, SINS, "max_north"): 94.84, (MAG, OD, "max_north"): 74.01,
}  # fmt: skip
MAGNETIC_TEST = {
    (MAG, "max_east"): 3.8268, (AFKF, "max_east"): 1.5452, (AFKF, "end_east"): 0.9866, (AFKF, "end_north"): 1.2015,
}  # fmt: skip
MAGNETIC_REDUCTION = 59.6

SURVEY_SD_M = 0.01
CLEAR = 5.0  # sds from which a spike has to be found
BOUNDS = {"fault_start": (None, 1.0), "fault_end": (None, 1.0), "spikes_found": (95.0, None)}


def measure(plan: Plan) -> list[Row]:
    """Rows of all scenarios of the paper."""
    outcomes = Outcomes.of(
        [trial for seed in plan.seeds for trial in trials(seed, plan.duration_s)], plan.jobs, "shearer"
    )
    return [*ladder(outcomes), *magnetic(outcomes)]


def trials(seed: int, duration_s: float | None) -> list[Trial]:
    """Every scenario with one seed: the same draws in all."""
    cut = partial(Trial, dataset="shearer-cut", seed=seed, duration_s=duration_s, metrics=errors)
    scales = [
        cut(f"scale {name}", methods=FEW, settings=(f"sensors.odometer.scale_sd={sd}",)) for name, sd in SCALES.items()
    ]
    faults = [
        Trial(fault, "shearer-magfault", seed, duration_s, ABLATION, fault_errors, options={"fault": fault})
        for fault in FAULTS
    ]
    return [
        cut("nominal", methods=ALL),
        cut("surveyed end", methods=(Method("batch", "batch"),), rig=surveyed_end),
        *scales,
        cut("aligned", methods=FEW, settings=ALIGNED),
        cut("mti30=printed", methods=FEW, options={"mti30": "printed"}),
        *faults,
    ]


def ladder(outcomes: Outcomes) -> list[Row]:
    """Table 2: what odometer and magnetometer take off the maximum error, and the smoother beside them."""
    rows = []
    for scenario in ("nominal", *(f"scale {name}" for name in SCALES), "aligned", "mti30=printed"):
        rows += outcomes.rows(scenario, TABLE_2, {})
        for (method, other, metric), published in REDUCTIONS.items():
            rows.append(outcomes.reduction(scenario, method, other, metric, published))
        rows += [outcomes.ordering(scenario, LADDER, metric) for metric in ("max_east", "max_north")]
        rows += against_batch(outcomes, scenario, ("rms_horizontal", "end_horizontal"))
    return [*rows, *over_bound(outcomes, "nominal", "batch"), *survey(outcomes)]


def survey(outcomes: Outcomes) -> list[Row]:
    """What a surveyed end of the way is worth to the smoother: the nominal logs without it, and with it."""
    without, with_it = (outcomes.mean(name, "batch", "rms_horizontal") for name in ("nominal", "surveyed end"))
    n = len(outcomes.by_seed("surveyed end", "batch", "rms_horizontal"))
    gain = Row("surveyed end", "batch", "rms_horizontal without / with", "", without / with_it, None, n, (3.0, None))
    return [*outcomes.rows("surveyed end", {}, {}), gain]


def over_bound(outcomes: Outcomes, scenario: str, method: str) -> list[Row]:
    """Squared error over the variance that the covariance gives it, which in a smoother of all that was measured is the
    Cramer-Rao bound but for where it was linearised: as a ratio of standard deviations with its confidence interval."""
    rms, sd = (outcomes.by_seed(scenario, method, name) for name in ("rms_horizontal", "sd_horizontal"))
    if len(rms) < 2:
        return []
    squared = np.array([(rms[seed] / sd[seed]) ** 2 for seed in rms])
    low, high = np.sqrt(np.maximum(confidence(squared), 0.0))
    name = "rms_horizontal / sd_horizontal"
    return [
        Row(scenario, method, name, "", float(np.sqrt(squared.mean())), None, len(rms)),
        Row(scenario, method, f"{name}, low", "", float(low), None, len(rms), (None, 1.05)),
        Row(scenario, method, f"{name}, high", "", float(high), None, len(rms)),
    ]


def magnetic(outcomes: Outcomes) -> list[Row]:
    """The disturbed field: which ingredient makes a filter robust, and who sees the fault."""
    rows = []
    for scenario in FAULTS:
        rows += outcomes.rows(scenario, MAGNETIC_TEST if scenario == "offset" else {}, BOUNDS)
        published = MAGNETIC_REDUCTION if scenario == "offset" else None
        for method in (AFKF, AR, "batch"):
            known = published if method == AFKF else None
            rows.append(outcomes.reduction(scenario, method, MAG, "max_east", known))
        rows.append(adaptive_share(outcomes, scenario))
        rows += against_batch(outcomes, scenario, ("rms_horizontal", "max_horizontal"))
    return rows


def against_batch(outcomes: Outcomes, scenario: str, metrics: tuple[str, ...]) -> list[Row]:
    others = [method for method in outcomes.methods(scenario) if method != "batch"]
    return [row for metric in metrics for other in others for row in outcomes.paired(scenario, "batch", other, metric)]


def adaptive_share(outcomes: Outcomes, scenario: str) -> Row:
    """Part of the step from the centralised filter to the adaptive federated one that adaptive noise takes alone."""
    fixed, adaptive, federated = (outcomes.mean(scenario, name, "max_horizontal") for name in (MAG, AR, AFKF))
    n = len(outcomes.by_seed(scenario, AR, "max_horizontal"))
    return Row(scenario, AR, "adaptive share", "%", 100.0 * (fixed - adaptive) / (fixed - federated), None, n)


def surveyed_end(simulation: Simulation, seed: int) -> Rig:
    """The log's rig and where the way ended, to a centimetre per axis."""
    from datasets.simulate import stream
    from tbmfg.rig import override

    end_s = (simulation.clean["imu"].t_ns[-1] - simulation.start_ns) * 1e-9
    position = simulation.truth(np.array([end_s])).position[0] + SURVEY_SD_M * stream(seed, "survey").standard_normal(3)
    point = f"{{at: end, position_m: {position.tolist()}, sigma_m: {SURVEY_SD_M}}}"
    return override(simulation.rig, [f"survey=[{point}]"])


def errors(simulation: Simulation, result: Result, truth: Truth) -> Metrics:
    """Along east and north, m, and of the heading, deg, at the keyframes; n's x axis lies where the rig says."""
    from tbmfg.evaluation.metrics import trajectory_errors
    from tbmfg.geometry import split_yaw_tilt

    found = trajectory_errors(result.trajectory, truth)
    azimuth = np.radians(simulation.rig.origin.x_axis_azimuth_deg)
    x, y = found.position_n[:, 0], found.position_n[:, 1]
    east, north = x * np.sin(azimuth) - y * np.cos(azimuth), x * np.cos(azimuth) + y * np.sin(azimuth)
    horizontal = np.hypot(east, north)
    yaw_deg = np.degrees(split_yaw_tilt(found.rotation_n)[0])
    said = np.einsum("kii->k", result.trajectory.cov[found.rows, 3:5, 3:5])
    return {
        "max_east": (float(np.abs(east).max()), "m"),
        "max_north": (float(np.abs(north).max()), "m"),
        "max_horizontal": (float(horizontal.max()), "m"),
        "end_east": (float(abs(east[-1])), "m"),
        "end_north": (float(abs(north[-1])), "m"),
        "end_horizontal": (float(horizontal[-1]), "m"),
        "rms_horizontal": (float(np.sqrt(np.mean(horizontal**2))), "m"),
        "sd_horizontal": (float(np.sqrt(np.mean(said))), "m"),
        "max_yaw": (float(np.abs(yaw_deg).max()), "deg"),
        "rms_yaw": (float(np.sqrt(np.mean(yaw_deg**2))), "deg"),
    }


def fault_errors(simulation: Simulation, result: Result, truth: Truth) -> Metrics:
    """Those, and how a fault was seen by estimators that judge single samples: how far the reported stretch's ends lie
    from the true ones, s, or which share of the clear spikes was set aside, and of the sound samples."""
    metrics = errors(simulation, result, truth)
    seen = result.innovations.get("magnetometer")
    if result.estimator.startswith("shearer") or seen is None:
        return metrics
    told = simulation.drawn["magnetometer"]
    t_s = (simulation.clean["magnetometer"].t_ns - simulation.start_ns) * 1e-9
    sds = np.abs(told["fault_yaw_deg"]) / simulation.rig.sensors["magnetometer"].sigma_deg
    gated = np.isin(np.round(t_s, 3), np.round((seen.t_ns[seen.gated] - simulation.start_ns) * 1e-9, 3))
    sound = (t_s < told["fault_s"][0]) | (t_s > told["fault_s"][1])
    metrics["sound_gated"] = 100.0 * float(np.mean(gated[sound])), "%"
    if len(told["spikes"]):
        clear = sds > CLEAR
        metrics["spikes_found"] = 100.0 * float(np.mean(gated[clear])), "%"
        return metrics
    wrong = t_s[sds > 3.0]
    if len(wrong):
        start_s, end_s = reported(simulation, result, wrong[0], wrong[-1])
        metrics["fault_start"] = abs(start_s - wrong[0]), "s"
        metrics["fault_end"] = abs(end_s - wrong[-1]), "s"
    return metrics


def reported(simulation: Simulation, result: Result, start_s: float, end_s: float) -> tuple[float, float]:
    """Ends of the first and the last stretch of the magnetometer that a result names within a fault: its effect on yaw
    may pass zero on the way, where nothing is wrong. Of no length at the end of the log where it names none."""
    named = [
        ((part.start_ns - simulation.start_ns) * 1e-9, (part.end_ns - simulation.start_ns) * 1e-9)
        for part in result.intervals
        if part.sensor == "magnetometer"
    ]
    within = [(first, last) for first, last in named if first < end_s and last > start_s]
    if not within:
        never = (result.trajectory.t_ns[-1] - simulation.start_ns) * 1e-9
        return never, never
    return min(first for first, _ in within), max(last for _, last in within)
