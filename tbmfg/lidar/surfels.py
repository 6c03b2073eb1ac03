"""A map of planes: in every voxel the mean, the normal and the flatness of the points that fell into it (compiled).

The table is hashed with open addressing: memory goes with the surface seen, a point costs some tens of nanoseconds.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tbmfg.timeseries import Floats

LEAST = 6  # points of a plane
FLAT = 0.1  # largest ratio of a plane's variance across to its smaller one along: sd 0.3
WIDE = 0.1  # least sd along a plane, in voxels
GROWN = 1.2  # times its points after which a plane is fitted anew
FULL = 100  # points after which a voxel takes no more: the map stands still
EMPTY = np.int64(-(2**62))


class SurfelMap:
    """Planes of ``voxel`` m in the frame of the points added.

    Columns of ``surfels``: mean (3), normal (3), the two axes in the plane (6), variances along the three (3, least
    first), points (1); variances are zero where a voxel holds no plane. A voxel takes no more than ``full`` points.
    """

    def __init__(self, voxel: float, full: float = FULL) -> None:
        self.voxel, self.full = voxel, float(full)
        self.keys = np.full(1 << 14, EMPTY)
        self.moments = np.zeros((len(self.keys), 10))
        self.surfels = np.zeros((len(self.keys), 16))
        self.used = 0

    def add(self, points: Floats) -> None:
        """Add points (n, 3) m."""
        while self.used + len(points) > len(self.keys) // 2:
            self._resize(np.ones(len(self.keys), dtype=bool), 2 * len(self.keys))
        rows, used = _add(points, self.voxel, self.full, self.keys, self.moments)
        self.used += used
        rows = np.unique(rows)
        rows = rows[self.moments[rows, 0] >= GROWN * self.surfels[rows, 15]]
        self.surfels[rows] = planes_of(self.moments[rows], self.voxel)

    def keep_near(self, centre: Floats, radius: float) -> None:
        """Forget what is farther than ``radius`` from ``centre`` (3,)."""
        filled = self.moments[:, 0] > 0
        mean = self.moments[:, 1:4] / np.maximum(self.moments[:, :1], 1.0)
        self._resize(filled & (np.sum((mean - centre) ** 2, axis=1) < radius**2), len(self.keys))

    def covariances(self, least: int) -> Floats:
        """Of the points in every voxel that holds ``least``, (n, 3, 3) m^2."""
        return _spread(self.moments[self.moments[:, 0] >= least], self.voxel)[1]

    def _resize(self, keep: np.ndarray, size: int) -> None:
        old = self.keys, self.moments, self.surfels
        self.keys = np.full(size, EMPTY)
        self.moments, self.surfels = np.zeros((size, 10)), np.zeros((size, 16))
        self.used = _refill(keep, *old, self.keys, self.moments, self.surfels)


@njit(cache=True)
def key_of(x, y, z, voxel):
    """Integer key of the voxel that holds a point: 21 bits an axis."""
    i, j, k = int(np.floor(x / voxel)), int(np.floor(y / voxel)), int(np.floor(z / voxel))
    return ((np.int64(i) & 0x1FFFFF) << 42) | ((np.int64(j) & 0x1FFFFF) << 21) | (np.int64(k) & 0x1FFFFF)


@njit(cache=True)
def find(key, keys):
    """Row of ``key``, or of the empty place where it belongs."""
    mask = len(keys) - 1
    h = key * np.int64(-7046029254386353131)
    row = (h ^ (h >> 29)) & mask
    while keys[row] != key and keys[row] != EMPTY:
        row = (row + 1) & mask
    return row


@njit(cache=True)
def _refill(keep, old_keys, old_moments, old_surfels, keys, moments, surfels):
    used = 0
    for n in range(len(old_keys)):
        if keep[n] and old_keys[n] != EMPTY:
            row = find(old_keys[n], keys)
            keys[row], moments[row], surfels[row] = old_keys[n], old_moments[n], old_surfels[n]
            used += 1
    return used


@njit(cache=True)
def _add(points, voxel, full, keys, moments):
    """Sums of 1, p, and d d' by voxel, d counted from the voxel's corner; the rows touched, and how many are new."""
    used, count, touched = 0, 0, np.empty(len(points), np.int64)
    d = np.empty(3)
    for n in range(len(points)):
        key = key_of(points[n, 0], points[n, 1], points[n, 2], voxel)
        row = find(key, keys)
        if keys[row] == EMPTY:
            keys[row] = key
            used += 1
        m = moments[row]
        if m[0] >= full:
            continue
        m[0] += 1.0
        at = 4
        for a in range(3):
            m[1 + a] += points[n, a]
            d[a] = points[n, a] - np.floor(points[n, a] / voxel) * voxel
        for a in range(3):
            for b in range(a, 3):
                m[at] += d[a] * d[b]
                at += 1
        touched[count] = row
        count += 1
    return touched[:count], used


def planes_of(moments: Floats, voxel: float) -> Floats:
    """Planes (n, 16) of voxels from their sums (n, 10)."""
    count = moments[:, :1]
    mean, cov = _spread(moments, voxel)
    value, vector = np.linalg.eigh(cov)
    flat = (count[:, 0] >= LEAST) & (value[:, 1] > (WIDE * voxel) ** 2) & (value[:, 0] < FLAT * value[:, 1])
    variance = np.where(flat[:, None], np.maximum(value, 1e-10), 0.0)
    return np.hstack([mean, vector.swapaxes(1, 2).reshape(-1, 9), variance, count])


def _spread(moments: Floats, voxel: float) -> tuple[Floats, Floats]:
    """Means (n, 3) and covariances (n, 3, 3) from the sums (n, 10) of voxels."""
    count = moments[:, :1]
    mean = moments[:, 1:4] / count
    d = mean - np.floor(mean / voxel) * voxel
    rows, columns = np.triu_indices(3)
    cov = np.empty((len(moments), 3, 3))
    cov[:, rows, columns] = cov[:, columns, rows] = moments[:, 4:] / count - d[:, rows] * d[:, columns]
    return mean, cov


@njit(cache=True)
def nearest_plane(x, y, z, voxel, keys, surfels):
    """Row of the plane whose mean is nearest to a point: its own voxel's, else of the 26 around it; -1 for none."""
    row = find(key_of(x, y, z, voxel), keys)
    if keys[row] != EMPTY and surfels[row, 12] > 0.0:
        return row
    best, closest = -1, (1.2 * voxel) ** 2
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                row = find(key_of(x + i * voxel, y + j * voxel, z + k * voxel, voxel), keys)
                if keys[row] == EMPTY or surfels[row, 12] <= 0.0:
                    continue
                d = (x - surfels[row, 0]) ** 2 + (y - surfels[row, 1]) ** 2 + (z - surfels[row, 2]) ** 2
                if d < closest:
                    best, closest = row, d
    return best
