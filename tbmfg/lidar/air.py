"""Which returns hang in the air: those of dust, and of what passed by.

A wall ends the rays that come to it, air lets them through, and so does dust: most rays through the place of one of its
echoes go on. So a voxel is air where more rays went on than ended. A ray that grazes a wall runs close to it before it
ends; the last tenth of a ray therefore says nothing, nor does its last piece, in which noise, roughness and an error
of the trajectory would make a wall transparent. Free space as in Hornung et al. (2013), by counts.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tbmfg.lidar.surfels import EMPTY, find, key_of
from tbmfg.timeseries import Floats

VOXEL_M = 0.15
SILENT_M, SILENT = 0.4, 0.1  # of a ray's end: length, and share of its range
EVERY = 5  # one ray of so many is followed: neighbours tell the same


class Air:
    """Rays that ended in each voxel, and those that went on through it; memory goes with the space that returns fill.

    All returns first, then all rays: of a voxel that nothing ended in there is nothing to know.
    """

    def __init__(self) -> None:
        self.keys = np.full(1 << 14, EMPTY)
        self.ended, self.passed = np.zeros((2, len(self.keys)))
        self.used = self.scans = 0

    def add_returns(self, points: Floats) -> None:
        """Count those of one scan, (n, 3) m."""
        while self.used + len(points) > len(self.keys) // 2:
            self._grow()
        self.used += _end(points, self.keys, self.ended)

    def add_rays(self, points: Floats, origins: Floats) -> None:
        """Follow those of one scan from ``origins`` to ``points``, (n, 3) m each."""
        _pass(points, origins, self.scans % EVERY, self.keys, self.passed)
        self.scans += 1

    def holds(self, points: Floats) -> np.ndarray:
        """Which of ``points`` (n, 3) m hang in the air."""
        return _through(points, self.keys, self.ended, self.passed)

    def _grow(self) -> None:
        old = self.keys, self.ended, self.passed
        self.keys = np.full(2 * len(old[0]), EMPTY)
        self.ended, self.passed = np.zeros((2, len(self.keys)))
        _move(*old, self.keys, self.ended, self.passed)


@njit(cache=True)
def _move(old_keys, old_ended, old_passed, keys, ended, passed):
    for n in range(len(old_keys)):
        if old_keys[n] != EMPTY:
            row = find(old_keys[n], keys)
            keys[row], ended[row], passed[row] = old_keys[n], old_ended[n], old_passed[n]


@njit(cache=True)
def _end(points, keys, ended):
    """Count returns; how many voxels are new."""
    used = 0
    for n in range(len(points)):
        key = key_of(points[n, 0], points[n, 1], points[n, 2], VOXEL_M)
        row = find(key, keys)
        if keys[row] == EMPTY:
            keys[row] = key
            used += 1
        ended[row] += 1.0
    return used


@njit(cache=True)
def _pass(points, origins, first, keys, passed):
    """Count, once a voxel's length, where rays go on, every one that is followed for those that are not."""
    for n in range(first, len(points), EVERY):
        x, y, z = origins[n]
        dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
        reach = np.sqrt(dx * dx + dy * dy + dz * dz)
        for k in range(int((reach - max(SILENT_M, SILENT * reach)) / VOXEL_M)):
            s = (k + 0.5) * VOXEL_M / reach
            row = find(key_of(x + s * dx, y + s * dy, z + s * dz, VOXEL_M), keys)
            if keys[row] != EMPTY:
                passed[row] += EVERY


@njit(cache=True)
def _through(points, keys, ended, passed):
    air = np.zeros(len(points), np.bool_)
    for n in range(len(points)):
        row = find(key_of(points[n, 0], points[n, 1], points[n, 2], VOXEL_M), keys)
        air[n] = passed[row] > ended[row]
    return air
