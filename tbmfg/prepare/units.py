"""What a magnetometer's, barometer's or laser's readings say against their unit, and the same in SI."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tbmfg.errors import LogError
from tbmfg.rig import Sensor, kind_of
from tbmfg.timeseries import Series

# By kind: what is measured, its column, the SI values that occur (the Earth's field with steel about, the air of a deep
# mine), and the units that drivers send.
UNITS = {
    "magnetometer": ("field", "field", (1e-5, 1e-3), {"T": 1.0, "G": 1e-4, "uT": 1e-6, "nT": 1e-9}),
    "barometer": ("pressure", "pressure", (3e4, 1.6e5), {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3}),
    "laser": ("distance of the spot from the centre", "point", (0.0, 0.5), {"m": 1.0, "mm": 1e-3}),
}


def in_si(where: str, name: str, sensor: Sensor, series: Series) -> Series:
    """The series in SI, its unit being the one that the rig states. Raises LogError, which begins with ``where``, if
    the readings look like another unit's."""
    quantity, column, (low, high), units = UNITS.get(kind_of(name), ("", "", (0.0, 0.0), {}))
    if column not in series.columns or not len(series):
        return series
    scaled = units[sensor.unit] * series[column]
    typical = float(np.median(np.linalg.norm(scaled.reshape(len(series), -1), axis=1)))
    if not low <= typical <= high and typical > 0:  # a reading of zero is no question of unit
        recorded, si = typical / units[sensor.unit], next(iter(units))
        likely = [unit for unit, scale in units.items() if low <= recorded * scale <= high]
        move = f"none of {', '.join(units)} explains it; check the sensor, or leave it out with --without {name}"
        if likely:
            move = f"it seems to be in {likely[0]}; if so, set sensors.{name}.unit={likely[0]}"
        raise LogError(
            f"{where}: {name}: the {quantity} is typically {typical:.3g} {si}, where {low:g} to {high:g} can be: {move}"
        )
    return replace(series, columns={**series.columns, column: scaled})
