"""What a run goes by: the rig, which of its sensors and topics, and the truth."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tbmfg.errors import RigError, TbmfgError
from tbmfg.results import load_truth
from tbmfg.rig import Rig, load_rig, override, parse_rig
from tbmfg.state import Calibrated, Truth
from tbmfg.timeseries import NS, Log

if TYPE_CHECKING:
    from tbmfg.storage import Place

ATTACHED_RIG = "rig.yaml"


def given_rig(
    rig: Rig | str | Path | None, attachments: Mapping[str, bytes], log_path: str | Place, overrides: Sequence[str] = ()
) -> Rig | None:
    """The rig given, else the one attached to the log, with ``overrides`` applied; None where there is neither."""
    if rig is None and ATTACHED_RIG in attachments:
        source = f"{log_path}: attachment {ATTACHED_RIG}"
        try:
            rig = parse_rig(attachments[ATTACHED_RIG].decode("utf-8"), source)
        except UnicodeDecodeError as error:
            raise RigError(f"{source}: cannot be read: not UTF-8 text") from error
    elif rig is not None and not isinstance(rig, Rig):
        rig = load_rig(rig)
    return override(rig, overrides) if rig is not None and overrides else rig


def inferred_rig(log: Log, overrides: Sequence[str] = ()) -> tuple[Rig, list[str]]:
    """A rig inferred from what the log shows, with ``overrides`` applied, and what was assumed for it."""
    from tbmfg.inference import infer

    inferred = infer(log)
    return override(inferred.rig, overrides) if overrides else inferred.rig, inferred.lines()


def topics_for(rig: Rig, truth: str) -> Callable[[str], bool] | None:
    """What tells the topics that a run reads: the rig's sensors and its truth; None for all of them.

    A ``truth`` that is named may be any topic, and what else could be meant is said where it is none.
    """
    if truth not in ("auto", "none"):
        return None
    known = {sensor.topic for sensor in rig.sensors.values()} | ({rig.truth.topic} if rig.truth is not None else set())
    return lambda topic: topic in known or (truth == "auto" and "truth" in topic.lower())


def dropped_sensors(rig: Rig, without: Collection[str], only: Collection[str]) -> tuple[str, ...]:
    """The sensors of ``rig`` that ``without`` and ``only`` leave out."""
    for option, names in (("--without", without), ("--only", only)):
        for name in names:
            if name not in rig.sensors:
                known = ", ".join(rig.sensors)
                raise TbmfgError(f"{option} {name}: the rig {rig.name} has no such sensor; it has {known}")
    if "imu" in without:
        raise TbmfgError("--without imu: every estimator needs the IMU")
    kept = {"imu", *only} if only else set(rig.sensors)
    return tuple(name for name in rig.sensors if name not in kept or name in without)


def truth_for(reference: str, log: Log, rig: Rig, calibration: Mapping[str, Calibrated], t0_ns: int) -> Truth:
    """What ``results.find_truth`` found. The rig's own truth gets its arm, and is brought to the IMU's clock, whose
    first stamp is ``t0_ns``.

    Both are as the estimator found them where a sensor sees the same point: what is compared is then where that
    sensor would have seen it.
    """
    truth = load_truth(reference, log)
    if rig.truth is None or reference != rig.truth.topic:
        return truth
    name = rig.truth.sensor
    if name is None:
        return replace(truth, arm_b=rig.truth.arm)
    offset_s, drift, arm_b = (getattr(rig.sensors[name], what) for what in ("clock_offset", "clock_drift", "arm"))
    if f"{name}_clock_offset_s" in calibration:  # else the sensor was left out
        offset_s = calibration[f"{name}_clock_offset_s"].value
        drift = 1e-6 * calibration[f"{name}_clock_drift_ppm"].value
        arm_b = np.array(calibration[f"{name}_lever_arm_m"].value)
    late_ns = np.round(offset_s * NS + drift * (truth.t_ns - t0_ns)).astype(np.int64)
    return replace(truth, t_ns=truth.t_ns - late_ns, arm_b=arm_b)
