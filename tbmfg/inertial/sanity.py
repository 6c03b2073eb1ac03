"""What an IMU's own samples say against its units and its health, before anything is integrated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tbmfg.inertial.steps import Steps
from tbmfg.inertial.strapdown import rotations
from tbmfg.timeseries import Floats, Series

IN_G = (0.8, 1.2)  # typical specific force on Earth that was never multiplied by gravity
ON_EARTH = (5.0, 30.0)  # m/s^2: with vibration; below it gravity is missing, above it the unit is another
CALM_S = 0.2  # specific force is judged on means over this time, so that vibration does not count
WINDOW_S, EDGE_S = 10.0, 1.0  # gravity is followed over this time, and is a mean over that at either end
ASTRAY = np.deg2rad(30.0)  # gravity is not where the gyro says
BETTER = 3.0  # times smaller must the angle be in another unit
POSSIBLE = {"gyro": 200.0, "acc": 1e4}  # rad/s, m/s^2: no IMU measures more; a reading beyond is a broken message
STUCK = 10  # samples in a row that are equal in all six axes
PILE, RUN = 3, 3  # times as many samples at the end of a scale as at the next value inside, and how many in a row


def fault(steps: Steps) -> str | None:
    """Why these samples cannot be SI values of a working IMU on Earth, and what to do; None if they can."""
    for what, values in (("gyro", steps.gyro), ("accelerometer", steps.acc)):
        if not np.ptp(values, axis=0).any():
            same = " ".join(f"{x:.4g}" for x in values[0])
            return f"all samples of the {what} read {same}: it is stuck; check the sensor and its driver"
    size = max(1, min(round(CALM_S / steps.period_s), len(steps)))
    calm = _means(steps.acc, np.arange(0, len(steps) - size + 1, size), size)
    typical = float(np.median(np.linalg.norm(calm, axis=1)))
    if IN_G[0] < typical < IN_G[1]:
        return (
            f"specific force is typically {typical:.3g} m/s^2 where gravity alone is 9.8: it seems to be in g; if so, "
            "set sensors.imu.acc_unit=g"
        )
    if not ON_EARTH[0] < typical < ON_EARTH[1]:
        reason = "gravity seems to be removed" if typical < IN_G[0] else "the unit is not m/s^2"
        return (
            f"specific force is typically {typical:.3g} m/s^2 where gravity alone is 9.8: {reason}; record what the "
            "accelerometer measures, or set sensors.imu.acc_unit (m/s^2 or g)"
        )
    astray, along = gravity_astray(steps, 1.0), gravity_astray(steps, np.pi / 180)
    if astray > ASTRAY and BETTER * along < astray:
        return (
            f"the gyro turns gravity {np.rad2deg(astray):.0f} deg away from where the accelerometer sees it, and only "
            f"{np.rad2deg(along):.0f} deg if it is in deg/s; if so, set sensors.imu.gyro_unit=deg/s"
        )
    return None


def impossible(imu: Series) -> NDArray[np.bool_]:
    """Samples that no IMU can have measured, (n,). None where most are so: then the unit is wrong, not the samples."""
    wrong = np.zeros(len(imu), dtype=bool)
    for column, limit in POSSIBLE.items():
        wrong |= np.abs(imu[column]).max(axis=1) > limit
    return wrong & (2 * wrong.sum() < len(wrong))


def stuck(imu: Series) -> list[tuple[int, int]]:
    """Stretches (first, last row) in which the samples repeat exactly: the sensor hung."""
    same = np.ones(len(imu) - 1, dtype=bool)
    for column in POSSIBLE:
        same &= (np.diff(imu[column], axis=0) == 0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= STUCK]


def saturated(imu: Series) -> list[tuple[str, float, NDArray[np.bool_]]]:
    """Axes that reach an end of their scale: name, its value [SI], and which samples (n,) lie there. Noise thins out
    towards its largest values, a limit is where readings pile up."""
    found = []
    for column in POSSIBLE:
        for name, values in zip("xyz", imu[column].T, strict=True):
            for end in (values.max(), values.min()):
                at = values == end
                inside = np.abs(values[~at] - end)
                if at.sum() < STUCK or not len(inside) or at.sum() < PILE * np.sum(inside == inside.min()):
                    continue
                if np.convolve(at, np.ones(RUN), "valid").max() >= RUN:
                    found.append((f"{column} {name}", float(end), at))
    return found


def gravity_astray(steps: Steps, scale: float) -> float:
    """Angle [rad] between the gravity that the gyro, times ``scale``, carries through ten seconds and the one that
    the accelerometer then sees; median over the log. The gyro's median passes for its bias. 0 where the gyro cannot
    have turned far or the log is short."""
    size, edge = round(WINDOW_S / steps.period_s), max(1, round(EDGE_S / steps.period_s))
    turned = np.median(np.linalg.norm(steps.gyro, axis=1)) * WINDOW_S
    if len(steps) <= size + edge or turned < ASTRAY:
        return 0.0
    R_0t = rotations(steps.edges_s, scale * steps.gyro, scale * np.median(steps.gyro, axis=0))
    before = np.arange(0, len(steps) - size - edge, size)
    up_before, up_after = _means(steps.acc, before, edge), _means(steps.acc, before + size, edge)
    middle = before + edge // 2
    carried = np.einsum("nji,njk,nk->ni", R_0t[middle + size], R_0t[middle], up_before)
    cosine = np.sum(carried * up_after, axis=1) / np.linalg.norm(carried, axis=1) / np.linalg.norm(up_after, axis=1)
    return float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _means(values: Floats, starts: np.ndarray, count: int) -> Floats:
    """Means of ``count`` rows from each start."""
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(values, axis=0)])
    return (total[starts + count] - total[starts]) / count
