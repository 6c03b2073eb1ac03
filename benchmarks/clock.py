"""What the clock of a car's inertial unit is against its satellite receiver's, by what each sees of the motion.

``SRC`` is the packaged npz of the dataset ``rtk-drive``. No estimator is asked: changes of speed are held against the
forward accelerometer, over a third of the drive each, for the two clocks that the recording has.

velocity_late    by which the velocities that the receiver states come after those that its positions make, s: half
                 the interval between fixes where a velocity is the mean since the fix before
by_positions@n   stamp of the inertial unit minus true time by the speed between positions, s, in the n-th third
by_velocities@n  the same by the stated velocities
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.rows import Row
from datasets.recordings import G, read_npz
from tbmfg.earth import n_from_llh
from tbmfg.rig import load_rig
from tbmfg.timeseries import Floats

REACH_S, GRID_S = 0.5, 0.01
PARTS = 3
CLOCKS = ("unit", "logger")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", type=Path, metavar="SRC", help="the npz of rtk-drive, or the folder that holds it")


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows by clock."""
    arrays = read_npz(given.source)
    fixes_s, velocity = arrays["gnss_t"], arrays["gnss_v_neu"][:, [1, 0, 2]]
    llh = arrays["gnss_llh_deg_m"] * [np.pi / 180, np.pi / 180, 1.0]
    track = n_from_llh(llh, llh[0], np.pi / 2)
    rig = load_rig("rtk-drive")
    ahead = G * (arrays["imu_acc_g"] @ rig.imu.T_bi.R.T)[:, 0]
    unit_s = arrays["imu_t"][0] + arrays["imu_clock_s"] - arrays["imu_clock_s"][0]

    between_s = 0.5 * (fixes_s[1:] + fixes_s[:-1])
    speed = np.linalg.norm(np.diff(track[:, :2], axis=0), axis=1) / np.diff(fixes_s)
    stated = np.linalg.norm(velocity[:, :2], axis=1)
    rows = [Row("rtk-drive", "receiver", "velocity_late", "s", velocity_late(fixes_s, track, velocity), None, 1)]
    for clock, imu_s in zip(CLOCKS, (unit_s, arrays["imu_t"]), strict=True):
        for name, t_s, speeds in (("positions", between_s, speed), ("velocities", fixes_s, stated)):
            for part, own in enumerate(np.array_split(np.arange(len(t_s)), PARTS), start=1):
                late = offset(t_s[own], speeds[own], imu_s, ahead)
                rows.append(Row("rtk-drive", clock, f"by_{name}@{part}", "s", late, None, len(own)))
    return rows


def velocity_late(t_s: Floats, position: Floats, velocity: Floats) -> float:
    """Lag [s] of velocities (n, 3) behind the derivative of positions (n, 3): least median square in the plane."""
    path, inner = CubicSpline(t_s, position), (t_s > t_s[0] + 2 * REACH_S) & (t_s < t_s[-1] - 2 * REACH_S)

    def cost(lag: float) -> float:
        return float(np.median(np.sum((velocity[inner] - path(t_s[inner] - lag, 1))[:, :2] ** 2, axis=1)))

    return _lowest(cost)


def offset(t_s: Floats, speed: Floats, imu_s: Floats, ahead: Floats) -> float:
    """Stamps ``imu_s`` minus true time [s], so that changes of ``speed`` (n,) are the integral of the specific force
    ``ahead`` but for a constant, which a slope and the bias make."""
    gained = np.concatenate([[0.0], np.cumsum(ahead[:-1] * np.diff(imu_s))])

    def cost(late: float) -> float:
        left = np.diff(speed) - np.diff(np.interp(t_s + late, imu_s, gained))
        return float(np.var(left))

    return _lowest(cost)


def _lowest(cost: Callable[[float], float]) -> float:
    """Where ``cost`` is lowest within the reach: grid, then a parabola."""
    grid = np.arange(-REACH_S, REACH_S + GRID_S / 2, GRID_S)
    costs = np.array([cost(late) for late in grid])
    k = int(np.clip(np.argmin(costs), 1, len(grid) - 2))
    a, b, c = costs[k - 1 : k + 2]
    return float(grid[k] + 0.5 * GRID_S * (a - c) / (a - 2.0 * b + c))
