"""The clock of a magnetometer, from what it shares with the gyro: a field at rest in n turns as the body does.

Magnetometers filter and stamp late; at a degree in three milliseconds a delay of ten is what its heading is worth.
"""

from __future__ import annotations

import numpy as np

from tbmfg.diagnosis import observed
from tbmfg.measure import GyroFrame, Samples
from tbmfg.prepare.start import Setup
from tbmfg.rig import Magnetometer
from tbmfg.state import Calibrated
from tbmfg.timeseries import Floats

SPAN_S = 0.1  # over which the carried field should not change: long against the noise, short against a walk
LONGEST_S = 300.0  # of a log that the offset is looked for in
REACH_SD = 3.0
GRID_S = 0.005


def onto_gyro_clock(setup: Setup) -> dict[str, Calibrated]:
    """Look for the clock offsets that the rig leaves open and move the stamps of ``setup.samples`` by what was found
    beyond the rig's value, in place; the offsets by name of their calibration. Offsets that the log does not tell
    stay at their prior."""
    found = {}
    for name, s in setup.samples.items():
        sensor = setup.rig.sensors[name]
        if not isinstance(sensor, Magnetometer) or not sensor.clock_offset_sd:
            continue
        first = s.select(s.t_s < s.t_s[0] + LONGEST_S)
        offset, sd = clock_offset(sensor, first, setup.frame)
        setup.samples[name] = Samples(name, s.t_s - (offset - sensor.clock_offset), s.values)
        seen = bool(observed(sd, sensor.clock_offset_sd))
        found[f"{name}_clock_offset_s"] = Calibrated(offset, sd, True, seen)
        if abs(offset - sensor.clock_offset) > (REACH_SD - 0.01) * sensor.clock_offset_sd:
            setup.warnings.append(
                f"{name}: the clock offset ran to {REACH_SD:.0f} sd of its prior, {offset:.3f} s, and is held there; "
                f"check sensors.{name}.clock_offset_s and its sd"
            )
    return found


def clock_offset(sensor: Magnetometer, s: Samples, frame: GyroFrame) -> tuple[float, float]:
    """Offset of the stamps and its sd [s]: where the field, carried by the gyro, changes least over ``SPAN_S``.

    A field fixed in b, hard iron, turns with the body and is fitted beside it.
    """
    apart = max(1, round(SPAN_S / float(np.median(np.diff(s.t_s)))))
    field_b = (s.values - sensor.hard_iron) @ sensor.R_bm.T
    reach = REACH_SD * sensor.clock_offset_sd
    count = 2 * max(2, int(np.ceil(reach / GRID_S)))
    grid = np.linspace(-reach, reach, count + 1)
    if len(s.t_s) <= 4 * apart:
        return sensor.clock_offset, sensor.clock_offset_sd

    changes = np.array([_change(frame, s.t_s - sensor.clock_offset - offset, field_b, apart) for offset in grid])
    # spans that overlap say the same
    independent = 3.0 * len(s.t_s) / apart
    cost = independent * np.log(changes) + (grid / sensor.clock_offset_sd) ** 2
    k = int(np.clip(np.argmin(cost), 1, count - 1))
    step, (a, b, c) = grid[1] - grid[0], cost[k - 1 : k + 2]
    curvature = (a - 2.0 * b + c) / step**2
    vertex = np.clip(grid[k] + 0.5 * step * (a - c) / (a - 2.0 * b + c), -reach, reach)
    return float(sensor.clock_offset + vertex), float(np.sqrt(2.0 / curvature))


def _change(frame: GyroFrame, t_s: Floats, field_b: Floats, apart: int) -> float:
    """Mean square of the carried field's change over ``apart`` samples, less what a field fixed in b explains."""
    first = np.arange(0, len(t_s) - apart, max(1, apart // 4))
    R_first, R_last = frame.at(t_s[first]), frame.at(t_s[first + apart])
    change = np.einsum("nij,nj->ni", R_last, field_b[first + apart]) - np.einsum("nij,nj->ni", R_first, field_b[first])
    change, turn = change.ravel(), (R_last - R_first).reshape(-1, 3)
    fixed = np.linalg.solve(turn.T @ turn + 1e-9 * np.eye(3), turn.T @ change)
    return float(np.mean((change - turn @ fixed) ** 2))
